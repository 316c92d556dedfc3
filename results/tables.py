"""Print the tables of README.md and results/README.md from the files of the shipped runs.

    python results/tables.py

A cell is the mean success over a group's seeds ± half the range between the worst and the best of
them; a group is the runs whose names differ in the seed alone. A test holds that both texts have
the lines of README's table and of those of claims and runs. Needs matplotlib, as figures.py does,
which reads the runs.
"""
import glob
import os

from figures import ABLATIONS, PAPER, RUNS, frames_to, group_of, read, training_curve

ROWS = {"**LRN**": "{}-lrn-n2", "RN": "{}-rn-n2", "ATTN": "{}-attn-n2",       # of README's table
        "LRN without crowds": "{}-lrn-n2-nocrowd"}
FEW, MANY = (0, 2, 5, 9), (0, 1, 2, 3, 5, 9, 14, 19)           # N in README; in the report
# Rows of the table of claims: the claim, the groups that it is measured in, the N of the score, or
# None for the million frames until success in training is 0.5, and our verdict (none before runs).
CLAIMS = (
    ("LRN and RN learn pushing \"almost perfectly\" (figure 3): at 2", "push-{}-n2", 2, "yes"),
    ("and lifting (3): at 2", "lift-{}-n2", 2, "yes"),
    ("ATTN learns later (3): million frames to 0.5", "push-{}-n2", None, "unclear"),
    ("LRN and RN keep their score, ATTN does not (3): pushing, at 9", "push-{}-n2", 9, "nearly"),
    ("the same without crowds", "push-{}-n2-nocrowd", 9, "no"),
    ("the same in lifting, with crowds", "lift-{}-n2", 9, "in part"),
    ("in lifting without crowds", "lift-{}-n2-nocrowd", 9, ""),
    ("LRN and RN work with fewer objects (3): pushing, at 0", "push-{}-n2", 0, "yes"),
    ("ATTN needs \"exactly two distractors\" (4.3): pushing, at 1", "push-{}-n2", 1, "no"),
    ("the transfer may hold beyond 9 (4.3): pushing, at 14", "push-{}-n2", 14, "in part"),
    ("LRN alone transfers from training at 1 (4): pushing, at 9", "push-{}-n1", 9, ""),
    ("LRN and RN transfer from training at 3 (4): pushing, at 9", "push-{}-n3", 9, ""),
    ("in the paper's world, with its reward: at 2", "push-{}-n2-paperworld", 2, ""),
    ("in the paper's world: at 9", "push-{}-n2-paperworld", 9, ""),
)


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
    return f"{mean:.2f}±{half_range:.2f}" if len(values) > 1 else f"{mean:.2f}"


def line(*cells):
    return "| " + " | ".join(cells) + " |"


def readme_table(found):
    """Lines of README's table: rows by encoder; pushing, then lifting if there are runs of it."""
    tasks = [task for task in ("push", "lift") if f"{task}-lrn-n2" in found]
    columns = [(task, N) for task in tasks for N in FEW]
    yield line("N", *[f"{task} {N}" if N == FEW[0] else str(N) for task, N in columns])
    yield "|---" * (len(columns) + 1) + "|"
    for label, name in ROWS.items():
        cells = [measured(found, name.format(task), N) for task, N in columns]
        if any(cells):
            yield line(label, *cells)


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


def measured(found, group, N):
    """The cell of a group's score at N, or with None of its million frames to 0.5 in training."""
    runs = found.get(group, [])
    if N is not None:
        return cell(scores(runs).get(N)) if runs else ""
    frames, is_reached = zip(*[frames_to(run, 0.5) for run in runs]) if runs else ((), ())
    return cell(frames) if all(is_reached) else "not in all"


def claims_table(found):
    """Lines of the report's table of claims; the verdicts are CLAIMS' own."""
    yield line("the paper says", "LRN", "RN", "ATTN", "verdict")
    yield "|---" * 5 + "|"
    for claim, group, N, verdict in CLAIMS:
        cells = [measured(found, group.format(encoder), N) for encoder in PAPER]
        if any(cells):
            yield line(claim, *cells, verdict)


def variants_table(found):
    """Lines of the table beside figure 5: variants of LRN and of the reward."""
    yield line("LRN in pushing", "seeds", "at 2", "at 9")
    yield "|---" * 4 + "|"
    parts, terms = ABLATIONS.values()
    for group, label in (terms | parts).items():               # the default is in both: once
        if group in found:
            cells = [measured(found, group, N) for N in (2, 9)]
            yield line(label, str(len(found[group])), *cells)


if __name__ == "__main__":
    runs_by_group = groups()
    for table in (readme_table, claims_table, variants_table, report_table):
        print("\n".join(table(runs_by_group)), end="\n\n")
