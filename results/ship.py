"""Copy trained and evaluated runs to results/runs/, small enough to ship.

    python results/ship.py runs/push-lrn-n2-seed0 [RUN ...]

The checkpoint loses its optimiser: it can be evaluated, not trained on. progress.csv keeps at most
150 rows: each stands for a window of updates, with the window's last update, frames and lr, the sum
of its episodes and the mean of everything else. zeroshot.csv is copied as it is. A run that is
shipped already is refused.
"""
import csv
import math
import os
import shutil
import sys

import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
from train import fail, load

ROWS = 150
LAST = ("update", "frames", "lr")
SUMS = ("episodes", "cut_short")


def together(rows):
    """One row (dict of text) for several."""
    joined = dict(rows[-1])
    for name in joined.keys() - set(LAST):
        total = sum(float(row[name]) for row in rows)
        joined[name] = round(total) if name in SUMS else f"{total / len(rows):.6g}"
    return joined


def thin_file(source, target):
    """Write a progress.csv of at most ROWS rows."""
    with open(source, newline="") as file:
        rows = list(csv.DictReader(file))
    window = math.ceil(len(rows) / ROWS)
    with open(target, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(together(rows[i:i + window]) for i in range(0, len(rows), window))


def ship(run):
    folder = os.path.join(HERE, "runs", os.path.basename(os.path.normpath(run)))
    scores = os.path.join(run, "zeroshot.csv")
    if not os.path.exists(scores):
        fail(f"{run} has no scores: python evaluate.py {run} --save first")
    if os.path.exists(os.path.join(folder, "checkpoint.pt")):
        fail(f"{folder} holds a run already: remove it first")
    os.makedirs(folder, exist_ok=True)
    checkpoint, _ = load(run)
    checkpoint.pop("optimizer", None)
    thin_file(os.path.join(run, "progress.csv"), os.path.join(folder, "progress.csv"))
    shutil.copy(scores, folder)
    torch.save(checkpoint, os.path.join(folder, "checkpoint.pt"))          # last: now it is shipped


if __name__ == "__main__":
    for run in sys.argv[1:]:
        try:
            ship(run)
        except (OSError, ValueError) as error:
            fail(str(error))
