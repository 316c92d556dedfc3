"""Do the scores hold in other episodes? Plays shipped runs from starts never used before.

    python results/recheck.py                   five runs at random, at N = 2 and 9: ten minutes
    python results/recheck.py RUN [RUN ...]     runs of your choice

One line per run and N: the score in zeroshot.csv (episodes 0 to 199), that of as many other episodes,
and whether they differ by more than the 95 % interval of their difference: one in twenty should.
"""
import csv
import glob
import math
import os
import random
import sys

import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
import evaluate
from train import fail, load

FIRST = 1000                             # number of the first of the other episodes
NUMBERS = (2, 9)                         # of distractors
EPISODES, RUNS = 200, 5                  # played at each N; drawn


def scores_of(run):
    """{N: row of zeroshot.csv}."""
    with open(os.path.join(run, "zeroshot.csv"), newline="") as file:
        return {int(row["distractors"]): row for row in csv.DictReader(file)}


def compare(run, N, row):
    """Print a line."""
    checkpoint, agent = load(run)
    ends = evaluate.play(checkpoint, agent, N, range(FIRST, FIRST + EPISODES))
    again = evaluate.summary(N, ends)
    score, half = float(row["success"]), float(row["ci95"])
    is_within = abs(again["success"] - score) <= math.hypot(again["ci95"], half)
    print(f"{os.path.basename(os.path.normpath(run)):32s} N = {N}   {score:.3f} +- {half:.3f}   "
          f"{again['success']:.3f} +- {again['ci95']:.3f}   {'agree' if is_within else 'DIFFER'}",
          flush=True)


def main():
    torch.set_num_threads(1)
    shipped = glob.glob(os.path.join(HERE, "runs", "*", "checkpoint.pt"))
    drawn = random.sample(sorted(shipped), min(RUNS, len(shipped)))
    for run in sys.argv[1:] or map(os.path.dirname, drawn):
        for N, row in scores_of(run).items():
            if N in NUMBERS:
                compare(run, N, row)


if __name__ == "__main__":
    try:
        main()
    except (OSError, KeyError, ValueError) as error:
        fail(str(error))
