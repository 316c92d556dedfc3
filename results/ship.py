"""Copy run folders into results/, small enough to ship.

    python results/ship.py runs/push-lrn-n2-seed0 runs/lift-lrn-n2-seed0
    python results/ship.py --curves results/search runs/noise-2 [...]     only NAME.csv

A checkpoint keeps the weights and loses the optimiser: it can be evaluated, not trained on. A CSV
with more than 300 rows is thinned: each row then stands for a window of updates, with the window's
last update, frames, seconds and lr, the sum of its episodes and the mean of everything else.
zeroshot.csv files are copied as they are. A run that is shipped with its scores is refused.
"""
import argparse
import csv
import glob
import math
import os
import shutil
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
from train import fail, load, save

ROWS = 300
LAST = ("update", "frames", "seconds", "lr")
SUMS = ("episodes", "cut_short")


def thinned(rows):
    """At most ROWS rows (dicts of text) that stand for windows of the given ones."""
    window = math.ceil(len(rows) / ROWS)
    if window <= 1:
        return rows
    return [together(rows[i:i + window]) for i in range(0, len(rows), window)]


def together(rows):
    """One row for several."""
    row = {}
    for name in rows[0]:
        values = [float(each[name]) for each in rows]
        if name in LAST:
            row[name] = rows[-1][name]
        elif name in SUMS:
            row[name] = round(sum(values))
        else:
            row[name] = f"{sum(values) / len(values):.6g}"
    return row


def thin_file(source, target):
    """Write a thinned copy of a CSV."""
    with open(source, newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    with open(target, "w", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames, lineterminator="\n")
        writer.writeheader()
        writer.writerows(thinned(rows))


def ship(run, folder):
    """Copy a run: checkpoint without optimiser, thinned curves, scores."""
    checkpoint, _ = load(run)
    if os.path.exists(os.path.join(folder, "zeroshot.csv")):
        raise ValueError(f"{folder} holds a run already: remove it first")
    os.makedirs(folder, exist_ok=True)
    checkpoint.pop("optimizer", None)
    save(checkpoint, os.path.join(folder, "checkpoint.pt"))
    for name in ("progress.csv", "timing.csv"):
        thin_file(os.path.join(run, name), os.path.join(folder, name))
    for path in glob.glob(os.path.join(run, "zeroshot*.csv")):
        shutil.copy(path, folder)


def main():
    parser = argparse.ArgumentParser(description="Copy runs into results/, without ballast.")
    parser.error = fail
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--curves", metavar="DIR", help="copy progress.csv alone, as DIR/NAME.csv")
    args = parser.parse_args()
    for run in args.runs:
        name = os.path.basename(os.path.normpath(run))
        try:
            if args.curves:
                os.makedirs(args.curves, exist_ok=True)
                thin_file(os.path.join(run, "progress.csv"),
                          os.path.join(args.curves, f"{name}.csv"))
            else:
                ship(run, os.path.join(HERE, name))
        except (OSError, ValueError, IndexError) as error:
            fail(str(error))


if __name__ == "__main__":
    main()
