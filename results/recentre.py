"""Give a trained LRN the zero that training at one N cannot find: its distractors' mean relation.

    python results/recentre.py results/lift-lrn-n2-seed0 runs/lift-recentred
    python evaluate.py runs/lift-recentred

f is affine, f(x) = W x + b. With K objects in training, f(sum_i r_i) stays the same if a vector c
is taken from every r_i (from the last bias of g) and K W c is added to b. So training at a single
K leaves c open, and z moves with every further distractor unless c makes their relations small.
This script moves the two biases so that distractors' relations are zero on the average over
episodes at the N of training (others than those of evaluate.py). It is told which cubes are
distractors; nothing is learned, no other N is looked at, and at the N of training z stays the same
up to rounding.
"""
import argparse
import os
import sys

import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import inside
from train import fail, load, positive, save

FIRST = 10_000                           # number of the first episode: far from evaluate.py's


def mean_distractor(run, distractors, episodes):
    """(D,) mean relation of a distractor over whole episodes."""
    which = range(FIRST, FIRST + episodes)
    r = inside.record(run, distractors, which, inside.relations_of)        # (steps, E, K, D)
    of_distractors = r[:, :, inside.FIRST_DISTRACTOR:]
    return torch.from_numpy(of_distractors.mean(axis=(0, 1, 2)))


def recentre(weights, c, K):
    """Take c (D,) from every relation; f's bias makes up for K of them. Changes `weights`."""
    last, f = "agent.encoder.g.5.bias", "agent.encoder.f"
    weights[last] -= c
    weights[f + ".bias"] += K * (weights[f + ".weight"] @ c)


def write_recentred(run, folder, episodes):
    """Write the recentred checkpoint of a run; returns c. ValueError for one that has no c."""
    checkpoint, agent = load(run)
    N = agent.distractors
    if agent.kind != "lrn" or not N or not agent.encoder.with_norm:
        raise ValueError(f"{run}: needs an lrn agent trained with distractors, and with LayerNorm")
    path = os.path.join(folder, "checkpoint.pt")
    if os.path.exists(path):
        raise ValueError(f"{path} is there already: name another folder")
    c = mean_distractor(run, N, episodes)
    recentre(checkpoint["learner"], c, K=N + 4)                # N + 1 cubes, three fingers
    checkpoint.pop("optimizer", None)                          # its moments are of other weights
    os.makedirs(folder, exist_ok=True)
    save(checkpoint, path)
    return c


def main():
    parser = argparse.ArgumentParser(
        description="Make the mean relation of a distractor zero (see the top of recentre.py).")
    parser.error = fail
    parser.add_argument("run", metavar="RUN", help="run folder of an LRN agent")
    parser.add_argument("out", metavar="DIR", help="folder for the changed checkpoint")
    parser.add_argument("--episodes", type=positive, default=25, metavar="E", help="default 25")
    args = parser.parse_args()
    torch.set_num_threads(1)
    try:
        c = write_recentred(args.run, args.out, args.episodes)
    except (ValueError, OSError) as error:
        fail(str(error))
    print(f"wrote {args.out}: a vector of length {c.norm():.2f} taken from every relation")


if __name__ == "__main__":
    main()
