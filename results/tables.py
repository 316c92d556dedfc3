"""Print the tables of README.md and results/README.md from the files of the shipped runs.

    python results/tables.py

A cell is the mean success over a group's seeds ± half the range between the worst and the best of
them; a group is the runs whose names differ in the seed alone. A test holds that both texts have
these lines. Needs neither torch nor PyBullet.
"""
import csv
import glob
import os
import re

HERE = os.path.dirname(os.path.abspath(__file__))
WINDOW = 25                              # updates at the end that "in training" averages
ROWS = {                                 # of README's table -> groups in pushing and lifting
    "**LRN**": ("push-lrn-n2", "lift-lrn-n2"),
    "RN": ("push-rn-n2", "lift-rn-n2"),
    "ATTN": ("push-attn-n2", "lift-attn-n2"),
    "LRN without crowds": ("push-lrn-n2-nocrowd", "lift-lrn-n2-nocrowd"),
    "RN without crowds": ("push-rn-n2-nocrowd", "lift-rn-n2-nocrowd"),
    "ATTN without crowds": ("push-attn-n2-nocrowd", "lift-attn-n2-nocrowd"),
}
FEW, MANY = (0, 2, 5, 9), (0, 1, 2, 3, 5, 9, 14, 19)           # N in README; in the report


def read(run, name):
    """Rows (dicts of text) of a run's CSV."""
    with open(os.path.join(run, name), newline="") as file:
        return list(csv.DictReader(file))


def groups():
    """{group: its runs, by seed}."""
    found = {}
    for run in sorted(glob.glob(os.path.join(HERE, "runs", "*-seed*"))):
        found.setdefault(re.sub(r"-seed\d+$", "", os.path.basename(run)), []).append(run)
    return found


def scores(runs):
    """{N: success of every seed}, for the N that all were played at."""
    tables = [{int(row["distractors"]): float(row["success"]) for row in read(run, "zeroshot.csv")}
              for run in runs]
    return {N: [table[N] for table in tables]
            for N in tables[0] if all(N in table for table in tables)}


def in_training(run):
    """Success with sampled actions in the last WINDOW updates."""
    rows = read(run, "progress.csv")
    last, total, begin = int(rows[-1]["update"]), 0.0, 0
    for row in rows:                     # a row stands for the updates since the row before
        end = int(row["update"])
        total += float(row["success"]) * max(0, end - max(begin, last - WINDOW))
        begin = end
    return total / min(WINDOW, last)


def cell(values):
    """Mean ± half the range over seeds; nothing where there are none, no range for a single one."""
    if not values:
        return ""
    mean = f"{sum(values) / len(values):.2f}"
    return mean + f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else mean


def line(*cells):
    return "| " + " | ".join(cells) + " |"


def readme_table(found):
    """Lines of README's table: rows by encoder, pushing and lifting side by side."""
    numbers = [str(N) for N in FEW]
    yield line("success at N =", *numbers, "lifting:", *numbers)
    yield "|---" * (2 * len(FEW) + 2) + "|"
    for label, (push, lift) in ROWS.items():
        if push in found:
            pushed, lifted = (scores(found[g]) if g in found else {} for g in (push, lift))
            yield line(label, *[cell(pushed.get(N)) for N in FEW], "",
                       *[cell(lifted.get(N)) for N in FEW])


def report_table(found):
    """Lines of the report's table: every group with its seeds, frames and scores."""
    yield line("runs", "seeds", "M frames", "in training", *[f"at {N}" for N in MANY])
    yield "|---" * (4 + len(MANY)) + "|"
    for group, runs in found.items():
        by_number = scores(runs)
        frames = int(read(runs[0], "progress.csv")[-1]["frames"]) / 1e6
        yield line(group, str(len(runs)), f"{frames:.1f}", cell([*map(in_training, runs)]),
                   *[cell(by_number.get(N)) for N in MANY])


if __name__ == "__main__":
    for table in (readme_table, report_table):
        print("\n".join(table(groups())), end="\n\n")
