"""Draw the figures and print the tables of this folder from the CSV files of its runs.

    python results/figures.py              every figure: results/figure3.png and others
    python results/figures.py 3            one of them
    python results/figures.py table        the tables, in markdown
    python results/figures.py 3 --out .    into another folder

Figures have the numbers of the paper's. Needs matplotlib (the tables do not).
"""
import argparse
import csv
import glob
import os
import re
import sys
from typing import NamedTuple

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
MEASURES = {                             # column of zeroshot.csv -> title of its table
    "success_aabb": "axis-aligned",
    "success_strict": "strict",
    "solved": "solved",
}
# Student's t for a 95 % interval, by the number of seeds
STUDENT = {2: 12.71, 3: 4.303, 4: 3.182, 5: 2.776}
TASKS = {"push": "PushingCube", "lift": "LiftingCube"}
LINES = {                                # of figure 3: encoder -> label, colour
    "lrn": ("LRN", "#0072B2"),
    "rn": ("RN", "#009E73"),
    "attn": ("ATTN", "#CC3311"),
}
KINDS = {                                # of relations -> colour, those of the paper's figure 7
    "finger 0": "black",
    "finger 1": "saddlebrown",
    "finger 2": "red",
    "target": "green",
    "distractors": "blue",
}
WINDOW = 50                              # updates that a point of a training curve averages


# ---- reading

def fail(message):
    """End with one line and status 2."""
    print(f"figures.py: error: {message}", file=sys.stderr)
    sys.exit(2)


def read(run, name):
    """Columns of a CSV of a run folder as float arrays; ValueError if it is missing or empty."""
    path = os.path.join(run, name)
    try:
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    except (OSError, IndexError, TypeError, ValueError):
        raise ValueError(f"{path} is missing or not a CSV of this project") from None


def shipped_runs():
    """Run folders in this folder: task by task, encoder by encoder, seed by seed."""
    return [run for task in TASKS for encoder in LINES
            for run in sorted(glob.glob(f"{HERE}/{task}-{encoder}-n*-seed?"))]


def by_seed(runs):
    """Runs that differ only in the seed, together: {"push-lrn-n2": [folder, ...]}."""
    groups = {}
    for run in runs:
        name = os.path.basename(os.path.normpath(run))
        group = re.sub(r"-seed\d+$", "", name)
        groups.setdefault(group, []).append(run)
    return groups


# ---- several seeds at one N

class Cell(NamedTuple):
    """A measure at one N."""
    values: np.ndarray                   # each seed's mean over its episodes, (S,)
    bar: float                           # half width of the 95 % interval over all episodes
    half: float                          # of that over seeds; with one seed the same as `bar`


def bar_of(rows, i, measure):
    """Half width of the 95 % interval over episodes in row i of a zeroshot.csv."""
    if measure == "success_aabb":
        return rows["ci95"][i]
    if measure == "success_strict":
        return rows["ci95_strict"][i]
    share = rows["solved"][i]            # of a share p: 1.96 sqrt(p (1 - p) / n)
    return 1.96 * np.sqrt(share * (1 - share) / rows["episodes"][i])


def cell(values, bars):
    """Cell of the seeds' means and of their intervals' half widths."""
    values, bars = np.array(values), np.array(bars)
    S = len(values)
    bar = np.sqrt(np.square(bars).sum()) / S
    if S == 1:
        return Cell(values, bar, bar)
    half = STUDENT.get(S, 2.5) * values.std(ddof=1) / np.sqrt(S)
    return Cell(values, bar, half)


def over_seeds(runs, measure):
    """{N: Cell} of a measure over runs that differ in the seed alone."""
    values, bars = {}, {}
    for run in runs:
        rows = read(run, "zeroshot.csv")
        for i, n in enumerate(rows["distractors"].astype(int).tolist()):
            values.setdefault(n, []).append(rows[measure][i])
            bars.setdefault(n, []).append(bar_of(rows, i, measure))
    return {n: cell(values[n], bars[n]) for n in sorted(values)}


# ---- tables

def cell_text(cell):
    """'0.80 ± 0.25' and, for several seeds, each of them on a second line."""
    text = f"{cell.values.mean():.2f} ± {cell.half:.2f}"
    if len(cell.values) > 1:
        text += "<br>" + ", ".join(f"{value:.2f}" for value in cell.values)
    return text


def cost_texts(runs):
    """Cells that say what the runs cost: how many, million frames, minutes of each."""
    timings = [read(run, "timing.csv") for run in runs]
    frames = np.mean([timing["frames"][-1] for timing in timings]) / 1e6
    minutes = [f"{timing['seconds'][-1] / 60:.0f}" for timing in timings]
    return [str(len(runs)), f"{frames:.1f}", ", ".join(minutes)]


def line_of(cells):
    return "| " + " | ".join(cells) + " |"


def table(runs, measure):
    """Lines of the markdown table of one measure: a row for each group of runs."""
    groups = by_seed(runs)
    columns = {name: over_seeds(members, measure) for name, members in groups.items()}
    numbers = sorted({n for cells in columns.values() for n in cells})
    head = [MEASURES[measure], "seeds", "million frames", "minutes"]
    lines = [line_of(head + [f"N = {n}" for n in numbers]),
             "|---" * (len(head) + len(numbers)) + "|"]
    for name, cells in columns.items():
        shown = [cell_text(cells[n]) if n in cells else "-" for n in numbers]
        lines.append(line_of([name, *cost_texts(groups[name]), *shown]))
    return lines


def print_tables(runs):
    for measure in MEASURES:
        print("\n".join(table(runs, measure)), end="\n\n")


# ---- figures

def pyplot():
    """matplotlib.pyplot without a window."""
    try:
        import matplotlib
    except ImportError:
        raise ValueError("figures need matplotlib: pip install matplotlib") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot
    pyplot.rcParams.update({"font.size": 10, "axes.grid": True, "grid.alpha": 0.3})
    return pyplot


def smooth(rows, name):
    """Frames in millions and the means of a column over WINDOW updates; a row may stand for several
    updates (ship.py)."""
    count = max(round(WINDOW * len(rows["update"]) / rows["update"][-1]), 1)
    means = np.convolve(rows[name], np.ones(count) / count, "valid")
    return rows["frames"][count - 1:] / 1e6, means


def draw(axes, x, curves, label, color, marker=None):
    """The mean of curves (S, points), and a band from the lowest to the highest of them."""
    axes.plot(x, np.mean(curves, axis=0), color=color, label=label, marker=marker, markersize=4)
    lowest, highest = np.min(curves, axis=0), np.max(curves, axis=0)
    axes.fill_between(x, lowest, highest, color=color, alpha=0.15, linewidth=0)


def figure_3(folder):
    """Figure 3: training at 2 distractors (left), zero-shot at others (right); a row for a task."""
    plt = pyplot()
    groups = by_seed(shipped_runs())
    tasks = [task for task in TASKS if f"{task}-lrn-n2" in groups]
    figure, axes = plt.subplots(len(tasks), 2, figsize=(9, 4 * len(tasks)), layout="constrained",
                                squeeze=False)
    for task, (left, right) in zip(tasks, axes):
        for encoder, (label, color) in LINES.items():
            runs = groups.get(f"{task}-{encoder}-n2")
            if not runs:
                continue
            label += f", {len(runs)} seeds" if len(runs) > 1 else ", 1 seed"
            progress = [read(run, "progress.csv") for run in runs]
            frames, _ = smooth(progress[0], "success_aabb")
            curves = [smooth(rows, "success_aabb")[1] for rows in progress]
            draw(left, frames, curves, label, color)
            cells = over_seeds(runs, "success_aabb")
            values = np.array([cells[n].values for n in cells]).T          # (S, numbers)
            draw(right, list(cells), values, label, color, marker="o")
        left.set(title=f"{TASKS[task]}: training at N = 2", xlabel="million frames",
                 ylabel="fractional success (axis-aligned)", ylim=(0, 1))
        right.set(title=f"{TASKS[task]}: zero-shot", xlabel="N, distractors at test time",
                  ylim=(0, 1), xticks=[0, 2, 5, 9, 14, 19])
        left.legend(loc="lower right")
    save(figure, folder, "figure3.png")


def figure_7(folder):
    """Figure 7: LRN's relations in the plane, coloured by kind (t-SNE, N = 3 to 6)."""
    plt = pyplot()
    rows = read_text("figure7.csv")
    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    for kind, color in KINDS.items():
        places = np.array([[row["x"], row["y"]] for row in rows if row["kind"] == kind], float)
        axes.scatter(*places.T, s=4, color=color, label=kind)
    axes.set(title="Relations of LRN on PushingCube, N = 3 to 6", xticks=[], yticks=[])
    axes.legend(markerscale=3)
    save(figure, folder, "figure7.png")


def figure_8(folder):
    """Figure 8: mean norm of LRN's relations by kind over an episode, at N = 4 and 5."""
    plt = pyplot()
    rows = read_text("figure8.csv")
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained", sharey=True)
    for N, panel in zip((4, 5), axes):
        of_n = [row for row in rows if row["N"] == str(N)]
        seconds = [int(row["step"]) / 25 for row in of_n]
        for kind, color in KINDS.items():
            panel.plot(seconds, [float(row[kind]) for row in of_n], color=color, label=kind)
        panel.set(title=f"{N} distractors", xlabel="seconds", ylim=(0, None))
    axes[0].set(ylabel="mean norm of a relation")
    axes[0].legend()
    save(figure, folder, "figure8.png")


def read_text(name):
    """Rows (dicts of text) of a CSV in this folder."""
    with open(os.path.join(HERE, name), newline="") as file:
        return list(csv.DictReader(file))


def save(figure, folder, name):
    path = os.path.join(folder, name)
    figure.savefig(path, dpi=150)
    print(f"wrote {path}")


FIGURES = {"3": figure_3, "7": figure_7, "8": figure_8}        # number in the paper -> function


def main():
    parser = argparse.ArgumentParser(
        description="Figures and tables of the shipped runs (see the first lines of figures.py).")
    parser.error = fail
    parser.add_argument("what", nargs="*", help=f"{', '.join(FIGURES)} or table (default: figures)")
    parser.add_argument("--out", default=HERE, metavar="DIR", help="folder (default results)")
    args = parser.parse_args()
    for what in args.what:
        if what not in FIGURES and what != "table":
            fail(f"there is no figure {what}; there are {', '.join(FIGURES)} and table")
    try:
        for what in args.what or FIGURES:
            if what == "table":
                print_tables(shipped_runs())
            else:
                FIGURES[what](args.out)
    except (ValueError, OSError) as error:
        fail(str(error))


if __name__ == "__main__":
    main()
