"""Draw the figures from the CSV files of runs. Their numbers are the paper's.

    python results/figures.py                   every figure whose runs are there
    python results/figures.py 3 readout         some of them
    python results/figures.py RUN [RUN ...]     learning and zero-shot curves of any runs: runs.png

Reads results/runs/TASK-ENCODER-nN[-VARIANT]-seedS (reproduce.sh makes them), and for figures 6, 7,
8 and relations what `python results/inside.py --figures` wrote. Writes results/figure3.png etc.
Runs that differ in the seed alone are a group: thin lines, and a thick one for their mean. A dotted
line marks the N of training. Needs matplotlib, but neither torch nor PyBullet.
"""
import argparse
import csv
import glob
import itertools
import os
import re
import sys

import numpy as np

try:
    import matplotlib.pyplot as plt
    from matplotlib.colors import to_rgba
except ImportError:
    sys.exit("this needs matplotlib: pip install matplotlib")

HERE = os.path.dirname(os.path.abspath(__file__))
RUNS = os.path.join(HERE, "runs")
WINDOW = 25                              # updates that a point of a training curve averages
ENCODERS = {"lrn": ("LRN", "#0072B2"), "rn": ("RN", "#009E73"), "attn": ("ATTN", "#CC3311"),
            "mlp": ("MLP", "#777777")}   # in all figures: blue, green, red, grey
LINES = {"RN": "--", "ATTN": "-."}       # for those who see no colours; others are solid
PAPER = ("lrn", "rn", "attn")            # the paper's encoders
OTHERS = ("#E69F00", "#AA4499", "black", "#56B4E9", "#8B5A2B",     # where an encoder's is taken
          "#999933", "#332288")
KINDS = {"finger 0": "black", "finger 1": "saddlebrown", "finger 2": "red", "target": "green",
         "distractors": "blue"}          # of relations -> colours of the paper's figure 7
TASKS = {                                # rows of figure 3 -> group of runs
    "PushingCube": "push-{}-n2",
    "LiftingCube": "lift-{}-n2",
    "Pushing, paper's world": "push-{}-n2-paperworld",
}
CROWDS = {"": "with crowds", "-nocrowd": "without crowds"}                 # end of a group's name
ABLATIONS = {                            # panels of figure 5 -> {group of runs: label}
    "Parts of LRN": {
        "push-lrn-n2": "LRN",
        "push-lrn-n2-objects": "without relations",
        "push-lrn-n2-tokens": "the same, with the goal's token",
        "push-lrn-n2-mean": "mean, no LayerNorm",
        "push-lrn-n2-maxnocrowd": "maximum, no crowds (ours)",
        "push-lrn-n2-z10": "z of 10 numbers, not 25",
        "push-lrn-n2-z50": "z of 50",
        "push-lrn-n2-z100": "z of 100",
    },
    "Terms of the reward": {
        "push-lrn-n2": "all",
        "push-lrn-n2-nooverlap": "without overlap",
        "push-lrn-n2-nodistance": "without distance",
        "push-lrn-n2-noreach": "without reach",
    },
}


# ---- reading

def runs_of(group):
    """The shipped runs of a group, seed by seed."""
    return sorted(glob.glob(os.path.join(RUNS, f"{group}-seed*")))


def group_of(run):
    """A run's path without its seed."""
    return re.sub(r"-seed\d+$", "", os.path.normpath(run))


def read(run, name):
    """Columns of a run's progress.csv or zeroshot.csv as float arrays."""
    path = os.path.join(run, name)
    try:
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    except (OSError, LookupError, TypeError, ValueError):
        raise ValueError(f"{path} is missing, empty or not a CSV of this version") from None


def read_rows(name):
    """Rows (dicts of text) of a CSV that inside.py wrote."""
    with open(os.path.join(HERE, name), newline="") as file:
        return list(csv.DictReader(file))


def numbers(rows, name):
    return [float(row[name]) for row in rows]


def of_encoders(name):
    """Runs, label and colour of each of the paper's encoders that has runs of this name."""
    for encoder in PAPER:
        runs = runs_of(name.format(encoder))
        if runs:
            yield runs, *ENCODERS[encoder]


# ---- curves: pairs of x and y

def training_curve(run, column):
    """Million frames, and a column of progress.csv as a mean over the last WINDOW updates."""
    rows = read(run, "progress.csv")
    # A row of a shipped run stands for several updates, so it counts for each of them.
    updates = np.concatenate([[0], rows["update"]])
    total = np.concatenate([[0], np.cumsum(rows[column] * np.diff(updates))])
    window = min(WINDOW, updates[-1])                          # a run may be shorter than that
    is_full = rows["update"] >= window
    end = rows["update"][is_full]
    sums = np.interp(end, updates, total) - np.interp(end - window, updates, total)
    return rows["frames"][is_full] / 1e6, sums / window


def frames_to(run, score):
    """Million frames until success in training reaches a score, True; or all frames, False."""
    frames, success = training_curve(run, "success")
    reached = frames[success >= score]
    return (reached[0], True) if len(reached) else (frames[-1], False)


# ---- drawing

def draw_seeds(axes, curves, label, color, marker=None):
    """Thin lines for the curves of the seeds, a thick one for their mean where all have a point."""
    if len(curves) > 1:                  # one curve is its own mean
        for x, y in curves:
            axes.plot(x, y, color=color, linewidth=0.7, alpha=0.5)
    points = [dict(zip(x, y)) for x, y in curves]
    shared = sorted(set.intersection(*map(set, points)))
    means = [np.mean([of_seed[x] for of_seed in points]) for x in shared]
    axes.plot(shared, means, color=color, linewidth=2, linestyle=LINES.get(label, "-"),
              marker=marker, markersize=4, label=label)


def draw_training(axes, runs, label, color, column="success"):
    draw_seeds(axes, [training_curve(run, column) for run in runs], label, color)
    axes.set(xlabel="million frames")
    axes.margins(x=0)                    # ends where the data do


def draw_zero_shot(axes, runs, label, color, marker="o", mark="0.4"):
    """Success by N at test time; `mark` is the colour of the dotted line at the N of training."""
    tables = [read(run, "zeroshot.csv") for run in runs]
    curves = [(table["distractors"], table["success"]) for table in tables]
    draw_seeds(axes, curves, label, color, marker)
    trained = re.search(r"-n(\d+)", os.path.basename(group_of(runs[0])))
    if trained:
        axes.axvline(int(trained[1]), color=mark, linestyle=":", linewidth=1.5)
    axes.set(xlabel="N, distractors at test time", ylim=(0, 1), xticks=(0, 2, 5, 9, 14, 19))
    axes.set_xlim(-0.3, axes.dataLim.x1 + 0.3)                 # ends where the data do


def one_legend(figure, ncols):
    """A legend for all panels, below them; each label once."""
    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels()):
            handles[label] = handle
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=ncols)


def colors_of(groups):
    """A colour for each group: its encoder's, or another if that is taken or not known."""
    colors, others = [], itertools.cycle(OTHERS)
    for group in groups:
        encoder = re.search(r"(?:push|lift)-(\w+)-n\d", os.path.basename(group))
        _, color = ENCODERS.get(encoder and encoder[1], (None, None))
        colors.append(next(others) if color is None or color in colors else color)
    return colors


# ---- the figures

def figure_1():
    """Figure 1, right: frames until success in training is 0.5 and 0.8, by the N of training."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
    for score, axes in zip((0.5, 0.8), panels):
        for encoder in ("mlp", "lrn"):
            draw_frames_to(axes, encoder, score)
        axes.set(title=f"PushingCube: frames to a success of {score}", xlabel="N in training",
                 xticks=range(4), ylim=(0, None))
    panels[0].set(ylabel="million frames (triangle: not reached)")
    one_legend(figure, 2)
    return figure


def draw_frames_to(axes, encoder, score):
    """A dot for each run, a triangle where it stopped short of the score; a line through means."""
    label, color = ENCODERS[encoder]
    means = {}
    for N in range(4):
        found = [frames_to(run, score) for run in runs_of(f"push-{encoder}-n{N}")]
        for frames, is_reached in found:
            axes.plot(N, frames, "o" if is_reached else "^", color=color, alpha=0.6)
        if found:
            is_known = all(is_reached for _, is_reached in found)
            means[N] = np.mean([frames for frames, _ in found]) if is_known else np.nan
    if means:
        axes.plot(list(means), list(means.values()), color=color, linewidth=2, label=label)


def figure_3():
    """Figure 3: training at N = 2 with crowds; zero-shot scores with and without."""
    tasks = [task for task, name in TASKS.items() if runs_of(name.format("lrn"))]
    figure, panels = plt.subplots(len(tasks), 3, figsize=(11, 3.5 * len(tasks)), squeeze=False,
                                  layout="constrained")
    for task, (left, *others) in zip(tasks, panels):
        for runs, label, color in of_encoders(TASKS[task]):
            draw_training(left, runs, label, color)
        left.set(title=f"{task}: training", ylabel="success", ylim=(0, 1))
        for (end, title), axes in zip(CROWDS.items(), others):
            for runs, label, color in of_encoders(TASKS[task] + end):
                draw_zero_shot(axes, runs, label, color)
            axes.set(title=f"zero-shot, {title}")
    one_legend(figure, 3)
    return figure


def figure_4():
    """Figure 4: zero-shot scores after training at N = 0 (pale), 1, 2 and 3 (dark)."""
    styles = {0: (0.35, "o"), 1: (0.5, "s"), 2: (0.75, "D"), 3: (1.0, "^")}    # opacity, marker
    figure, panels = plt.subplots(1, 3, figsize=(11, 4), layout="constrained", sharey=True)
    for encoder, axes in zip(PAPER, panels):
        label, color = ENCODERS[encoder]
        for N, (share, marker) in styles.items():
            runs = runs_of(f"push-{encoder}-n{N}")
            if runs:
                shade = to_rgba(color, share)
                draw_zero_shot(axes, runs, None, shade, marker, mark=shade)
        axes.set(title=label)
    panels[0].set(ylabel="zero-shot success")
    handles = [plt.Line2D([], [], color=to_rgba("black", share), marker=marker,
                          label=f"trained at N = {N}") for N, (share, marker) in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def figure_5():
    """Figure 5: zero-shot scores of LRN with parts of it, and of the reward, left out."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 5), layout="constrained", sharey=True)
    for (title, lines), axes in zip(ABLATIONS.items(), panels):
        for (group, label), color in zip(lines.items(), colors_of(lines)):
            runs = runs_of(group)
            if runs:
                draw_zero_shot(axes, runs, label, color)
        axes.set(title=title)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    panels[0].set(ylabel="zero-shot success")
    return figure


def figure_6():
    """Figure 6: z in the plane (t-SNE), coloured by N; how far its distribution moves with N."""
    dots, drifts = read_rows("figure6.csv"), read_rows("figure6-drift.csv")
    figure, panels = plt.subplots(2, 2, figsize=(9, 8), layout="constrained")
    for encoder, axes in zip(PAPER, panels.flat):
        label, color = ENCODERS[encoder]
        of_it = [row for row in dots if row["encoder"] == encoder]
        np.random.default_rng(0).shuffle(of_it)                # in order N = 9 would hide the rest
        points = axes.scatter(numbers(of_it, "x"), numbers(of_it, "y"), s=2, cmap="viridis",
                              c=numbers(of_it, "distractors"), vmin=0, vmax=9)
        axes.set(title=f"z of {label}", xticks=[], yticks=[])
        for crowd, line, text in (("", "o-", label), ("-nocrowd", "^:", f"{label}, no crowds")):
            moved = [row for row in drifts if row["group"] == f"push-{encoder}-n2{crowd}"]
            panels[1, 1].plot(numbers(moved, "distractors"), numbers(moved, "distance"), line,
                              color=color, label=text, markersize=4)
    figure.colorbar(points, ax=panels[1, 0], location="bottom", label="N")
    panels[1, 1].axvline(2, color="0.4", linestyle=":")
    panels[1, 1].set(title="energy distance of z at N from z at 2", xlabel="N", ylim=(0, None))
    panels[1, 1].legend()
    return figure


def figure_7():
    """Figure 7: LRN's relations in the plane (t-SNE, N = 3 to 6), coloured by kind."""
    rows = read_rows("figure7.csv")
    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    for kind, color in KINDS.items():
        of_kind = [row for row in rows if row["kind"] == kind]
        axes.scatter(numbers(of_kind, "x"), numbers(of_kind, "y"), s=4, color=color, label=kind)
    axes.set(title="Relations of LRN on PushingCube, N = 3 to 6", xticks=[], yticks=[])
    axes.legend(markerscale=3)
    return figure


def figure_8():
    """Figure 8: mean length of LRN's relations by kind over an episode at N = 5."""
    rows = read_rows("figure8.csv")
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
    for (end, title), axes in zip(CROWDS.items(), panels):
        of_run = [row for row in rows if row["group"] == f"push-lrn-n2{end}"]
        for kind, color in KINDS.items():
            axes.plot(numbers(of_run, "seconds"), numbers(of_run, kind), color=color, label=kind)
        axes.set(title=title, xlabel="seconds")
        axes.margins(x=0)
    panels[0].set(ylabel="mean length of a relation")
    one_legend(figure, 5)
    return figure


def figure_readout():
    """Not in the paper: how soon z encodes where the named cube is, with and without crowds."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
    for (end, title), axes in zip(CROWDS.items(), panels):
        for runs, label, color in of_encoders("push-{}-n2" + end):
            draw_training(axes, runs, label, color, column="auxiliary_loss")
        axes.set(title=f"PushingCube, {title}", yscale="log")
    panels[0].set(ylabel="read-out loss")
    one_legend(figure, 3)
    return figure


def figure_relations():
    """Not in the paper: what a distractor adds to LRN's sum, and the score among nine of them."""
    figure, axes = plt.subplots(figsize=(5.5, 3.8), layout="constrained")
    for is_plain, label, marker in ((False, "with crowds", "o"), (True, "without crowds", "^")):
        rows = [row for row in read_rows("figurerelations.csv")
                if ("-nocrowd" in row["run"]) == is_plain]
        scores = [success_at(os.path.join(RUNS, row["run"]), 9) for row in rows]
        axes.plot(numbers(rows, "share"), scores, marker, color=ENCODERS["lrn"][1],
                  fillstyle="none" if is_plain else "full", markersize=8, label=label)
    axes.set(xlabel="length of the distractors' mean relation / the target's", xlim=(0, None),
             ylabel="success at N = 9", ylim=(0, 1))
    axes.legend()
    return figure


def success_at(run, N):
    """A run's score at N distractors."""
    table = read(run, "zeroshot.csv")
    return table["success"][table["distractors"] == N][0]


def figure_of(runs):
    """Learning and zero-shot curves of any runs."""
    groups = {}
    for run in runs:
        groups.setdefault(group_of(run), []).append(run)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
    for (group, members), color in zip(groups.items(), colors_of(groups)):
        draw_training(left, members, group, color)
        played = [run for run in members if os.path.exists(os.path.join(run, "zeroshot.csv"))]
        if played:
            draw_zero_shot(right, played, group, color)
        else:
            print(f"{group} has no zero-shot curve: python evaluate.py RUN --save makes one")
    left.set(ylabel="success in training", ylim=(0, 1))
    right.set(ylabel="zero-shot success")
    one_legend(figure, 2)
    return figure


FIGURES = {
    "1": figure_1, "3": figure_3, "4": figure_4, "5": figure_5, "6": figure_6, "7": figure_7,
    "8": figure_8, "readout": figure_readout, "relations": figure_relations,
}


def draw(name):
    """Draw a figure of FIGURES, without panels that have no runs."""
    try:
        figure = FIGURES[name]()
    except (ValueError, FileNotFoundError) as error:
        print(f"figure {name} skipped: {error}")
        return
    for axes in figure.axes:
        axes.set_visible(bool(axes.lines or axes.collections))
    if not any(axes.get_visible() for axes in figure.axes):
        print(f"figure {name} skipped: none of its runs is in {RUNS}")
        return
    figure.savefig(os.path.join(HERE, f"figure{name}.png"))
    print(f"wrote figure{name}.png")


def main():
    parser = argparse.ArgumentParser(description="Draw figures (see the top of figures.py).")
    parser.add_argument("what", nargs="*", help=f"{', '.join(FIGURES)}, or run folders")
    what = parser.parse_args().what
    plt.rcParams.update({"font.size": 11, "axes.grid": True, "grid.alpha": 0.3,
                         "savefig.dpi": 150})
    if set(what) <= set(FIGURES):
        for name in what or FIGURES:
            draw(name)
        return
    try:
        figure_of(what).savefig("runs.png")
        print("wrote runs.png")
    except ValueError as error:
        sys.exit(f"figures.py: error: {error}")


if __name__ == "__main__":
    main()
