"""Print the tables of README.md and results/README.md from the files of the shipped runs.

    python results/tables.py

A cell is the mean success over a group's seeds ± half the range between the worst and the best of
them; a group is the runs whose names differ in the seed alone. A test holds that both texts have
these lines. Needs matplotlib, as figures.py does, which reads the runs.
"""
import glob
import os

from figures import RUNS, group_of, read, training_curve

ROWS = {                                 # of README's table -> groups in pushing and lifting
    "**LRN**": ("push-lrn-n2", "lift-lrn-n2"),
    "RN": ("push-rn-n2", "lift-rn-n2"),
    "ATTN": ("push-attn-n2", "lift-attn-n2"),
    "LRN without crowds": ("push-lrn-n2-nocrowd", "lift-lrn-n2-nocrowd"),
    "RN without crowds": ("push-rn-n2-nocrowd", "lift-rn-n2-nocrowd"),
    "ATTN without crowds": ("push-attn-n2-nocrowd", "lift-attn-n2-nocrowd"),
}
FEW, MANY = (0, 2, 5, 9), (0, 1, 2, 3, 5, 9, 14, 19)           # N in README; in the report


def groups():
    """{group: its runs, by seed}."""
    found = {}
    for run in sorted(glob.glob(os.path.join(RUNS, "*-seed*"))):
        found.setdefault(os.path.basename(group_of(run)), []).append(run)
    return found


def scores(runs):
    """{N: success of every seed}, for the N that all were played at."""
    tables = [read(run, "zeroshot.csv") for run in runs]
    by_number = [dict(zip(map(int, table["distractors"]), table["success"])) for table in tables]
    return {N: [seed[N] for seed in by_number]
            for N in by_number[0] if all(N in seed for seed in by_number)}


def cell(values):
    """Mean ± half the range over seeds; nothing where there are none, no range for a single one."""
    if not values:
        return ""
    mean, half_range = sum(values) / len(values), (max(values) - min(values)) / 2
    return f"{mean:.2f} ± {half_range:.2f}" if len(values) > 1 else f"{mean:.2f}"


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
        frames, ends = zip(*[(x[-1], y[-1])
                             for x, y in (training_curve(run, "success") for run in runs)])
        yield line(group, str(len(runs)), f"{max(frames):.1f}", cell(ends),
                   *[cell(by_number.get(N)) for N in MANY])


if __name__ == "__main__":
    for table in (readme_table, report_table):
        print("\n".join(table(groups())), end="\n\n")
