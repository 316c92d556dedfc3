"""Draw the figures and print the tables of this folder from the CSV files of its runs.

    python results/figures.py              every figure that there are numbers for
    python results/figures.py 3            one of them
    python results/figures.py table        the tables of all scores, tables.md
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
STUDENT = {2: 12.71, 3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571, 7: 2.447, 8: 2.365, 9: 2.306,
           10: 2.262}
BLUE, RED, GREEN, YELLOW = "#0072B2", "#CC3311", "#009E73", "#AA8800"
ENCODERS = {                             # of figures 3, 4 and 6 -> label, colour
    "lrn": ("LRN", BLUE),
    "rn": ("RN", GREEN),
    "attn": ("ATTN", RED),
    "lrn-max": ("LRN-max", YELLOW),
}
ABLATIONS = {                            # panels of figure 5: title -> {group of runs: label}
    "Relations, LayerNorm": {
        "push-lrn-n2": "LRN",
        "push-lrn-n2-norelations": "without relations",
        "push-lrn-n2-mean": "mean, no LayerNorm",
    },
    "Width of z": {
        "push-lrn-n2": "25",
        "push-lrn-n2-z10": "10",
        "push-lrn-n2-z50": "50",
        "push-lrn-n2-z100": "100",
    },
    "Reward: one term left out": {
        "push-lrn-n2": "all terms",
        "push-lrn-n2-nooverlap": "no overlap",
        "push-lrn-n2-nodistance": "no distance",
        "push-lrn-n2-noreach": "no reach",
    },
    "Reward: curiosity": {
        "push-lrn-n2": "without",
        "push-lrn-n2-curiosity": "with, weight 10",
        "push-lrn-n2-paperreward": "the paper's three terms",
        "push-lrn-n2-sparse": "overlap and curiosity alone",
    },
}
SECTIONS = {                             # of the tables -> groups of runs; the first match counts
    "Figure 1": "-mlp-",
    "Figure 3": "-n2$",
    "Figure 4": "push-.*-n[013]$",
    "Figure 5": "-n2-(norelations|mean|z[0-9]+|no(overlap|distance|reach)|curiosity|"
                "sparse|paperreward)$",
    "What we added": "-(noreadout|rawvalues|rawadvantages|absolute|paper[a-z]*)(-[a-z0-9]+)*$",
    "How far does lifting come": "lift-.*-n0$",
    "Beyond the paper": "",
}
KINDS = {                                # of relations -> colour, those of the paper's figure 7
    "finger 0": "black",
    "finger 1": "saddlebrown",
    "finger 2": "red",
    "target": "green",
    "distractors": "blue",
}
PAPER = ("attn", "rn", "lrn")            # the paper's encoders, in the order of its panels
WINDOW = 50                              # updates that a point of a training curve averages


# ---- reading

def fail(message):
    """End with one line and status 2. (train.fail would import torch, which no figure needs.)"""
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
    """Run folders in this folder: task by task, encoder by encoder, group by group."""
    return [run for task in ("push", "lift") for encoder in (*ENCODERS, "mlp")
            for run in sorted(glob.glob(f"{HERE}/{task}-{encoder}-n[0-9]*-seed?"),
                              key=lambda path: (group_of(path), path))]


def group_of(run):
    """A run's name without its seed: "push-lrn-n2"."""
    return re.sub(r"-seed\d+$", "", os.path.basename(os.path.normpath(run)))


def by_seed(runs):
    """Runs that differ only in the seed, together: {"push-lrn-n2": [folder, ...]}."""
    groups = {}
    for run in runs:
        groups.setdefault(group_of(run), []).append(run)
    return groups


# ---- several seeds at one N

class Cell(NamedTuple):
    """A measure at one N."""
    values: np.ndarray                   # each seed's mean over its episodes, (S,)
    half: float                          # half width of the 95 % interval over seeds; with one
                                         # seed of that over its episodes


def bar_of(rows, i, measure):
    """Half width of the 95 % interval over episodes in row i of a zeroshot.csv."""
    if measure == "success_aabb":
        return rows["ci95"][i]
    if measure == "success_strict":
        return rows["ci95_strict"][i]
    # Of a share (Agresti and Coull): as if two more episodes were solved and two were not.
    # 1.96 sqrt(p (1 - p) / n) alone would call 0 of 200 certain.
    n = rows["episodes"][i]
    share = (rows["solved"][i] * n + 2) / (n + 4)
    return 1.96 * np.sqrt(share * (1 - share) / (n + 4))


def cell(values, bars):
    """Cell of the seeds' means, each with a half width `bars` over its episodes."""
    values = np.array(values)
    S = len(values)
    half = bars[0] if S == 1 else STUDENT[S] * values.std(ddof=1) / np.sqrt(S)
    return Cell(values, half)


def over_seeds(runs, measure):
    """{N: Cell} of a measure over runs that differ in the seed alone, where all were played."""
    values, bars = {}, {}
    for run in runs:
        rows = read(run, "zeroshot.csv")
        for i, n in enumerate(rows["distractors"].astype(int).tolist()):
            values.setdefault(n, []).append(rows[measure][i])
            bars.setdefault(n, []).append(bar_of(rows, i, measure))
    of_all = [n for n in sorted(values) if len(values[n]) == len(runs)]
    return {n: cell(values[n], bars[n]) for n in of_all}


# ---- tables

def cell_text(cell):
    """'0.80 ± 0.25' and, for several seeds, each of them on a second line.

    Without an interval if it would be longer than the scale, as Student's t often makes it.
    """
    text = f"{cell.values.mean():.2f}"
    if cell.half < 0.5:
        text += f" ± {cell.half:.2f}"
    if len(cell.values) > 1:
        text += "<br>" + ", ".join(f"{value:.2f}" for value in cell.values)
    return text


def line_of(cells):
    return "| " + " | ".join(cells) + " |"


def table(runs, measure):
    """Lines of the markdown table of one measure: a row for each group of runs."""
    groups = by_seed(runs)
    columns = {name: over_seeds(members, measure) for name, members in groups.items()}
    numbers = sorted({n for cells in columns.values() for n in cells})
    head = [MEASURES[measure], *(f"N = {n}" for n in numbers)]
    lines = [line_of(head), "|---" * len(head) + "|"]
    for name, cells in columns.items():
        lines.append(line_of([name, *(cell_text(cells[n]) if n in cells else "-"
                                      for n in numbers)]))
    return lines


def training_table(runs):
    """Lines of the markdown table of what happened in training, seed by seed.

    Success is a mean of 25 updates, that of the sampled actions: at the end, and after how many
    million frames it first was 0.5 and 0.8.
    """
    head = ["in training", "seeds", "million frames", "minutes", "at the end", "0.5 after",
            "0.8 after"]
    lines = [line_of(head), "|---" * len(head) + "|"]
    for name, members in by_seed(runs).items():
        timings = [read(run, "timing.csv") for run in members]
        ends = [training_success(run)[1][-1] for run in members]
        lines.append(line_of([
            name,
            ", ".join(run[-1] for run in members),
            ", ".join(f"{timing['frames'][-1] / 1e6:.1f}" for timing in timings),
            ", ".join(f"{timing['seconds'][-1] / 60:.0f}" for timing in timings),
            ", ".join(f"{end:.2f}" for end in ends),
            frames_text(frames_to(members, 0.5)),
            frames_text(frames_to(members, 0.8)),
        ]))
    return lines


def frames_text(frames):
    """'1.6, never' of million frames, NaN for never."""
    return ", ".join("never" if np.isnan(each) else f"{each:.1f}" for each in frames)


def section_of(run):
    """The heading under which a run's rows are printed."""
    return next(title for title, pattern in SECTIONS.items() if re.search(pattern, group_of(run)))


def print_tables(runs):
    """Markdown: what results/tables.md holds, and of it results/README.md."""
    print("# All tables\n\nMade by `python results/figures.py table > results/tables.md`. "
          "[README.md](README.md) says what the words mean.\n")
    for title in SECTIONS:
        members = [run for run in runs if section_of(run) == title]
        if not members:
            continue
        tables = [training_table(members), *(table(members, measure) for measure in MEASURES)]
        print(f"## {title}")
        for lines in tables:
            print("\n" + "\n".join(lines))
        print()
    seconds = sum(read(run, "timing.csv")["seconds"][-1] for run in runs)
    print(f"{len(runs)} runs, {seconds / 3600:.0f} hours of one core")


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


def smooth(rows, name, window=WINDOW):
    """Frames in millions, and means of a column over the last `window` updates (or all of them).

    A row may stand for several updates (ship.py): it counts for each of them.
    """
    updates = np.concatenate([[0], rows["update"]])
    total = np.concatenate([[0], np.cumsum(rows[name] * np.diff(updates))])
    window = min(window, updates[-1])                          # a run may be shorter than that
    has_window = rows["update"] >= window
    ends = rows["update"][has_window]
    sums = np.interp(ends, updates, total) - np.interp(ends - window, updates, total)
    return rows["frames"][has_window] / 1e6, sums / window


def draw(axes, x, curves, label, color, marker=None):
    """The mean of curves (S, points), and a band from the lowest to the highest of them."""
    axes.plot(x, np.mean(curves, axis=0), color=color, label=label, marker=marker, markersize=4)
    lowest, highest = np.min(curves, axis=0), np.max(curves, axis=0)
    axes.fill_between(x, lowest, highest, color=color, alpha=0.15, linewidth=0)


def draw_zero_shot(axes, cells, label, color):
    """Scores {N: Cell} of several seeds at every N."""
    values = np.array([cell.values for cell in cells.values()]).T          # (S, numbers)
    draw(axes, list(cells), values, label, color, marker="o")


def with_seeds(label, runs):
    """A label that says how many runs stand behind the line."""
    return f"{label}, {len(runs)} seed{'s' if len(runs) > 1 else ''}"


def draw_groups(axes, groups, lines):
    """Zero-shot curves of some groups of runs, {group: label}; one without runs is said so."""
    for (group, label), color in zip(lines.items(), (BLUE, RED, GREEN, YELLOW)):
        if group in groups:
            cells = over_seeds(groups[group], "success_aabb")
            draw_zero_shot(axes, cells, with_seeds(label, groups[group]), color)
        else:
            axes.plot([], [], color=color, label=f"{label} (not run)")
    axes.set(xlabel="N, distractors at test time", xlim=(-0.4, 9.4), ylim=(0, 1), xticks=range(10))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2, fontsize=8)


def training_success(run):
    """Million frames, and the success in training as a mean of 25 updates."""
    return smooth(read(run, "progress.csv"), "success_aabb", window=25)


def frames_to(runs, threshold):
    """Million frames until training success (mean of 25 updates) reaches a threshold, run by run:
    NaN if it never does."""
    found = []
    for run in runs:
        frames, success = training_success(run)
        reached = np.flatnonzero(success >= threshold)
        found.append(frames[reached[0]] if len(reached) else np.nan)
    return np.array(found)


def draw_frames_to(panel, groups, threshold, row, label, million, name, marker, color):
    """A dot a run, at the N of its training; "not in 3 M" stands in line `row` from the top."""
    runs = [(N, run) for N in range(4) for run in groups.get(name.format(N), [])]
    places = [N for N, _ in runs]
    frames = frames_to([run for _, run in runs], threshold)
    label = f"{label}, {million} M frames" + ("" if runs else " (not run)")
    panel.plot(places, frames, marker, color=color, alpha=0.7, label=label)
    for N in {N for N, needed in zip(places, frames) if np.isnan(needed)}:
        panel.annotate(f"not in {million} M", (N, 1), (0, -14 * (row + 1)), color=color, ha="center",
                       xycoords=("data", "axes fraction"), textcoords="offset points")


def figure_1(folder):
    """Figure 1, right: frames until training success is 0.5 and 0.8, by the N of training.

    The MLP's long runs are other runs than its short ones, as the learning rate falls to 0 at the
    end of each.
    """
    plt = pyplot()
    groups = by_seed(shipped_runs())
    need_runs(groups, [f"push-mlp-n{N}" for N in range(3)])
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained", sharey=True)
    lines = (("MLP", 9, "push-mlp-n{}-long", "s", RED),
             ("MLP", 3, "push-mlp-n{}", "o", YELLOW),
             ("LRN", 3, "push-lrn-n{}", "o", BLUE))
    for threshold, panel in zip((0.5, 0.8), axes):
        for row, line in enumerate(lines):
            draw_frames_to(panel, groups, threshold, row, *line)
        panel.set(title=f"PushingCube: frames to reach {threshold}", xlabel="N in training",
                  xticks=range(4), xlim=(-0.5, 3.5))
        panel.margins(y=0.4)                                   # room for "not in 3 M"
    axes[0].set(ylabel="million frames, each run a dot", ylim=(0, None))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save(figure, folder, "figure1.png")


def figure_3(folder):
    """Figure 3: training at 2 distractors (left), zero-shot at others (right).

    A row for each task, and one for pushing in the paper's world, with the paper's reward.
    """
    plt = pyplot()
    groups = by_seed(shipped_runs())
    rows = {"PushingCube": "push-{}-n2", "LiftingCube": "lift-{}-n2",
            "Pushing, paper's world": "push-{}-n2-paperworld-long"}
    figure, axes = plt.subplots(len(rows), 2, figsize=(9, 4 * len(rows)), layout="constrained")
    for (title, name), (left, right) in zip(rows.items(), axes):
        for encoder, (label, color) in ENCODERS.items():
            runs = groups.get(name.format(encoder))
            if not runs:
                continue
            progress = [smooth(read(run, "progress.csv"), "success_aabb") for run in runs]
            curves = [success for _, success in progress]
            draw(left, progress[0][0], curves, with_seeds(label, runs), color)
            draw_zero_shot(right, over_seeds(runs, "success_aabb"), label, color)
        left.set(title=f"{title}: training at N = 2", xlabel="million frames",
                 ylabel="fractional success (axis-aligned)", ylim=(0, 1))
        right.set(title=f"{title}: zero-shot", xlabel="N, distractors at test time",
                  ylim=(0, 1), xticks=[0, 2, 5, 9, 14, 19])
        left.legend(loc="lower right")
        right.legend(loc="lower left", fontsize=8)
    save(figure, folder, "figure3.png")


def figure_4(folder):
    """Figure 4: zero-shot scores of agents trained at 0, 1, 2 and 3 distractors."""
    plt = pyplot()
    groups = by_seed(shipped_runs())
    need_runs(groups, [f"push-{encoder}-n{N}" for encoder in PAPER for N in (0, 1, 3)])
    figure, axes = plt.subplots(1, 3, figsize=(11, 4), layout="constrained", sharey=True)
    for encoder, panel in zip(PAPER, axes):
        draw_groups(panel, groups, {f"push-{encoder}-n{N}": f"trained at {N}" for N in range(4)})
        panel.set(title=ENCODERS[encoder][0])
    axes[0].set(ylabel="fractional success (axis-aligned)")
    save(figure, folder, "figure4.png")


def figure_5(folder):
    """Figure 5: zero-shot scores of LRN with parts of it, and of the reward, changed."""
    plt = pyplot()
    groups = by_seed(shipped_runs())
    need_runs(groups, [name for lines in ABLATIONS.values() for name in list(lines)[1:]])
    figure, axes = plt.subplots(2, 2, figsize=(9, 8), layout="constrained", sharey=True)
    for (title, lines), panel in zip(ABLATIONS.items(), axes.flat):
        draw_groups(panel, groups, lines)
        panel.set(title=title)
    for panel in axes[:, 0]:
        panel.set(ylabel="fractional success (axis-aligned)")
    save(figure, folder, "figure5.png")


def figure_6(folder):
    """Figure 6: z in the plane (t-SNE), coloured by N; how far its distribution moves with N."""
    plt = pyplot()
    dots, drifts = read_text("figure6.csv"), read_text("figure6-drift.csv")
    figure, axes = plt.subplots(2, 2, figsize=(9, 8), layout="constrained")
    for encoder, panel in zip(PAPER, axes.flat):
        label, color = ENCODERS[encoder]
        of_it = [row for row in dots if row["encoder"] == encoder]
        np.random.default_rng(0).shuffle(of_it)                # in order N = 9 would hide the rest
        places = np.array([[row["x"], row["y"]] for row in of_it], float).reshape(-1, 2)
        numbers = [int(row["distractors"]) for row in of_it]
        points = panel.scatter(*places.T, s=2, c=numbers, cmap="viridis", vmin=0, vmax=9)
        panel.set(title=f"z of {label}", xticks=[], yticks=[])
        moved = [row for row in drifts if row["encoder"] == encoder]
        axes[1, 1].plot([int(row["distractors"]) for row in moved],
                        [float(row["distance"]) for row in moved], "o-", color=color, label=label)
    figure.colorbar(points, ax=axes[1, 0], location="bottom", label="N")
    axes[1, 1].set(title="energy distance of z at N from z at 2", xlabel="N", xticks=range(10),
                   ylim=(0, None))
    axes[1, 1].legend()
    save(figure, folder, "figure6.png")


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
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    save(figure, folder, "figure8.png")


def read_text(name):
    """Rows (dicts of text) of a CSV in this folder."""
    try:
        with open(os.path.join(HERE, name), newline="") as file:
            return list(csv.DictReader(file))
    except FileNotFoundError:
        raise ValueError(f"{name} is not there: python results/inside.py makes it") from None


def need_runs(groups, names):
    """ValueError if none of the groups of runs is there."""
    if not set(groups) & set(names):
        raise ValueError(f"none of its runs is there, such as {names[0]}: see results/reproduce.sh")


def save(figure, folder, name):
    path = os.path.join(folder, name)
    figure.savefig(path, dpi=150)
    print(f"wrote {path}")


FIGURES = {                              # number in the paper -> function
    "1": figure_1, "3": figure_3, "4": figure_4, "5": figure_5, "6": figure_6, "7": figure_7,
    "8": figure_8,
}


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
    for what in args.what or FIGURES:
        try:
            if what == "table":
                print_tables(shipped_runs())
            else:
                FIGURES[what](args.out)
        except (ValueError, OSError) as error:
            if args.what:
                fail(f"figure {what}: {error}")
            print(f"no figure {what}: {error}")


if __name__ == "__main__":
    main()
