"""Give a trained LRN the zero that training at one N cannot find: its distractors' relations.

    python results/recentre.py results/lift-lrn-n2-seed0 runs/lift-recentred
    python evaluate.py runs/lift-recentred

With K objects in training, f(sum_i r_i) stays the same if a vector c is taken from every r_i (from
the bias of g's last layer) and K f(c) is added to f's bias. So training at a single K leaves c open,
and any c but one makes z move with every further distractor. This script moves the bias so that
distractors' relations are zero on the average over episodes at the N of training. Nothing is
learned, no other N is looked at, and at the N of training the agent does the same as before.
"""
import argparse
import os
import sys

import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import inside
from train import fail, load, save


def mean_distractor(run, distractors, episodes):
    """(D,) mean relation of a distractor over whole episodes."""
    r = inside.watch(run, distractors, episodes, inside.relations_of)      # (steps, E, K, D)
    return torch.from_numpy(r[:, :, 4:].mean(axis=(0, 1, 2)))


def recentre(weights, c, K):
    """Take c (D,) from every relation; f's bias makes up for K of them. Changes `weights`."""
    last, f = "agent.encoder.g.5.bias", "agent.encoder.f"
    weights[last] -= c
    weights[f + ".bias"] += K * (weights[f + ".weight"] @ c)


def main():
    parser = argparse.ArgumentParser(
        description="Make the mean relation of a distractor zero (see the top of recentre.py).")
    parser.error = fail
    parser.add_argument("run", metavar="RUN", help="run folder of an LRN agent")
    parser.add_argument("out", metavar="DIR", help="folder for the changed checkpoint")
    parser.add_argument("--episodes", type=int, default=25, metavar="E", help="default 25")
    args = parser.parse_args()
    torch.set_num_threads(1)
    try:
        checkpoint, agent = load(args.run)
        if agent.kind != "lrn" or not agent.distractors:
            raise ValueError(f"{args.run}: needs an lrn agent trained with distractors")
        N = agent.distractors
        c = mean_distractor(args.run, N, args.episodes)
        recentre(checkpoint["learner"], c, N + 4)
        os.makedirs(args.out, exist_ok=True)
        save(checkpoint, os.path.join(args.out, "checkpoint.pt"))
    except (ValueError, OSError) as error:
        fail(str(error))
    print(f"wrote {args.out}: a vector of length {c.norm():.2f} taken from every relation")


if __name__ == "__main__":
    main()
