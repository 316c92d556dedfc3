"""Do scores hold in other episodes? Plays shipped agents again from starts never used before.

    python results/recheck.py                   five runs at random, at N = 2 and 9: ten minutes
    python results/recheck.py RUN --episodes 50 a run of your choice

Each row: the score (axis-aligned) of zeroshot.csv, from episodes 0 .. 199; that of as many further
episodes; their difference in units of its own 95 % interval. Beyond 1 lies one in twenty.
"""
import argparse
import os
import sys

import numpy as np
import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import evaluate
from figures import read, shipped_runs
from train import fail, load, positive

FIRST = 1000                             # number of the first of the other episodes
NUMBERS = (2, 9)                         # of distractors
SEED = 0                                 # of the choice of runs


def play_others(run, distractors, episodes):
    """A row of zeroshot.csv from episodes FIRST, FIRST + 1, ..."""
    checkpoint, agent = load(run)
    played = []
    for part in evaluate.chunks(range(FIRST, FIRST + episodes)):
        played += evaluate.play(checkpoint, agent, distractors, part, sample_actions=False)
    return evaluate.summary(distractors, played)


def compare(run, distractors, episodes):
    """Print a row; nothing if the run was not played at that N."""
    table = read(run, "zeroshot.csv")
    at = np.flatnonzero(table["distractors"] == distractors)
    if not len(at):
        return
    score, bar = table["success_aabb"][at[0]], table["ci95"][at[0]]
    other = play_others(run, distractors, episodes)
    interval = np.hypot(bar, other["ci95"])
    print(f"{os.path.basename(os.path.normpath(run))} | N = {distractors} | "
          f"{score:.3f} +- {bar:.3f} | {other['success_aabb']:.3f} +- {other['ci95']:.3f} | "
          f"{abs(other['success_aabb'] - score) / interval:.2f}", flush=True)


def main():
    parser = argparse.ArgumentParser(
        description="Play shipped agents in other episodes (see the first lines of recheck.py).")
    parser.error = fail
    parser.add_argument("runs", nargs="*", metavar="RUN", help="default: five of the shipped ones")
    parser.add_argument("--episodes", type=positive, default=200, metavar="E", help="default 200")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print("run | N | in zeroshot.csv | in other episodes | difference / its interval")
    try:
        able = [run for run in shipped_runs()                  # an MLP plays its own N alone
                if set(NUMBERS) <= set(read(run, "zeroshot.csv")["distractors"])]
        shipped = np.random.default_rng(SEED).permutation(able)
        for run in args.runs or shipped[:5]:
            for distractors in NUMBERS:
                compare(run, distractors, args.episodes)
    except ValueError as error:
        fail(str(error))


if __name__ == "__main__":
    main()
