"""Does z tell where the cube is that the goal names?

    python results/probe.py results/push-lrn-n2-seed0 [RUN ...]           N = 2; 15 s a run
    python results/probe.py RUN --distractors 5

The agent stays as it is. A small network is trained by supervised learning to read the named
cube's place (x, y) from z, and a second one to read that of another cube. Both are asked in states
they have not seen, the starts of 1000 episodes; they are trained on 5000 more. In all of them the
goal names any of the cubes, so that the law of places is the same for both. Prints mean distances
in mm: an agent that knows which cube is meant has a small one for the named cube alone.
"""
import argparse
import os
import sys

import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import evaluate
from train import fail, load, make_env, mlp
from trifinger_env import IDENTIFIER, POSITION, POSITION_SCALE

TRAINED, ASKED = 5000, 1000              # states
STEPS, BATCH = 1500, 256                 # of Adam


def named_at_random(obs):
    """Observations whose goals name a random cube; the rows of that cube and of the next: (B,)."""
    cubes, goal = obs["cubes"], obs["goal"].clone()
    B, count = cubes.shape[:2]
    named = torch.randint(count, (B,))
    goal[:, IDENTIFIER] = cubes[torch.arange(B), named, IDENTIFIER]
    return {**obs, "goal": goal}, named, (named + 1) % count


def start_states(checkpoint, distractors, count):
    """The first observations of `count` episodes, as a batch."""
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"])
    observations = [env.reset(seed=0 if i == 0 else None)[0] for i in range(count)]
    env.close()
    return evaluate.as_batch(observations)


def reading_error(z, places):
    """Mean distance from places (B, 2) to where a network reads them from z (B, Z).

    It is trained on all but the last ASKED rows and asked in these.
    """
    torch.manual_seed(0)
    known, asked = slice(-ASKED), slice(-ASKED, None)
    z = (z - z[known].mean(dim=0)) / (z[known].std(dim=0) + 1e-6)
    network = mlp(z.shape[1], 128, 128, 2)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(STEPS):
        rows = torch.randint(len(z) - ASKED, (BATCH,))
        loss = (network(z[rows]) - places[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return (network(z[asked]) - places[asked]).norm(dim=1).mean().item()


def guess_error(places):
    """What the best constant guess errs by, roughly: the mean of the known places."""
    return (places[-ASKED:] - places[:-ASKED].mean(dim=0)).norm(dim=1).mean().item()


def probe(run, distractors):
    """Reading errors for the named cube and for another one, and that of a guess, in mm."""
    torch.manual_seed(0)
    checkpoint, agent = load(run)
    obs, named, other = named_at_random(start_states(checkpoint, distractors, TRAINED + ASKED))
    with torch.no_grad():
        z = agent.encode(obs)
    places = obs["cubes"][..., POSITION][..., :2]              # (B, N+1, 2), about [-1, 1]
    rows = torch.arange(len(z))
    errors = (reading_error(z, places[rows, named]), reading_error(z, places[rows, other]),
              guess_error(places[rows, named]))
    return [1000 * POSITION_SCALE * error for error in errors]


def main():
    parser = argparse.ArgumentParser(description="Does z tell where the named cube is?")
    parser.error = fail
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--distractors", type=int, default=2, metavar="N", help="default 2")
    args = parser.parse_args()
    if args.distractors < 1:
        fail("without a distractor there is no other cube to name")
    torch.set_num_threads(1)
    print("| run | N | named cube (mm) | another cube | a guess |")
    print("|---|---|---|---|---|")
    for run in args.runs:
        try:
            errors = probe(run, args.distractors)
        except ValueError as error:
            fail(str(error))
        name = os.path.basename(os.path.normpath(run))
        cells = " | ".join(f"{error:.0f}" for error in errors)
        print(f"| {name} | {args.distractors} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
