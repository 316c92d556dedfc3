"""Play trained agents zero-shot at other numbers of distractors and measure fractional success (section 4.3, figure 3 right).

    python evaluate.py RUN [RUN ...] --distractors 0-9 --episodes 200      table, and zeroshot.csv in each run folder
    python evaluate.py RUN --mean-actions                                  without sampling noise: zeroshot-mean.csv
    python evaluate.py RUN [RUN ...] --episodes 0 --plot curves.png        README's table and curves, from the CSV files alone
    python evaluate.py RUN --distractors 9 --episodes 0 --gif push.gif     a film of one episode

Episode j starts from the same seed at every N and for every agent: the goal and the target cube stand in the same places,
only the distractors differ. The seeds belong to no training run.
"""
import argparse
import csv
import multiprocessing
import os
import re
import signal

import numpy as np
import torch

from train import fail, load, make_env
from trifinger_env import CUBE, CUBE_SCALE

COLUMNS = ("distractors", "episodes", "success_aabb", "success_strict", "ci95", "ci95_strict", "solved", "cut_short",
           "blocked", "success_clear", "success_blocked", "z_drift", "read_error")
CHUNK = 25                                # episodes played side by side; fixed, so that results do not depend on the cores


def episode_seed(episode):
    """Seed of evaluation episode `episode`; the leading number keeps it apart from training's (seed, update, env)."""
    return int(np.random.SeedSequence((20220131, episode)).generate_state(1)[0])


def is_target(obs):
    """(N+1,) bool: which cube does the goal name?"""
    return obs["cubes"][:, -1] == obs["goal"][-1]


def is_blocked(obs):
    """Does a distractor's centre lie within a cube's width of the straight line from the target to the goal?"""
    here, goal = obs["cubes"][:, 4:6] * CUBE_SCALE[4], obs["goal"][4:6] * CUBE_SCALE[4]        # m
    target = is_target(obs)
    start, others = here[target][0], here[~target]                             # (2,), (N, 2)
    share = np.clip((others - start) @ (goal - start) / max(np.square(goal - start).sum(), 1e-12), 0, 1)
    return bool((np.linalg.norm(others - start - share[:, None] * (goal - start), axis=1) < CUBE).any())


@torch.inference_mode()
def play(path, numbers, first, count, mean_actions):
    """Play episodes first .. first+count-1 of the agent in `path` at every N in `numbers`: {N: a row of six numbers each}.

    rho, strict rho, was it cut short, was the way to the goal blocked at the start, and two measures of the first z: its
    drift, the distance from the z of the same episode at the training N over the mean distance between different episodes
    there; and how far from the target cube (m) the agent's read-out sees it (NaN if it was trained without one).
    """
    torch.set_num_threads(1)
    (checkpoint, agent), seeds, results = load(path), [episode_seed(first + e) for e in range(count)], {}

    def batch(observations):
        return {key: torch.from_numpy(np.stack([obs[key] for obs in observations])) for key in observations[0]}

    def start(n):
        envs = [make_env(checkpoint["task"], n, checkpoint["settings"]) for _ in seeds]
        observations = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds)]
        return envs, observations, agent.encode(batch(observations))           # z (B, Z)

    trained, _, z_trained = start(checkpoint["distractors"])
    for env in trained:
        env.close()
    spread = torch.cdist(z_trained, z_trained).sum() / max(count * (count - 1), 1)
    for n in numbers:
        envs, observations, z = start(n)
        drift = (z - z_trained).norm(dim=1) / spread
        targets = torch.from_numpy(np.stack([obs["cubes"][is_target(obs)][0, 4:7] for obs in observations]))
        miss = np.nan * z[:, 0] if not checkpoint["settings"]["auxiliary"] else (agent.read_out(z)[:, :3] - targets).norm(dim=1) * CUBE_SCALE[4]
        blocked, rows = [is_blocked(obs) for obs in observations], [None] * count
        noise = [np.random.default_rng(seed) for seed in seeds]
        while None in rows:
            mean, log_std, _ = agent(batch(observations))
            mean, std = mean.numpy(), log_std.exp().numpy()
            for e, env in enumerate(envs):
                if rows[e] is None:
                    action = mean[e] if mean_actions else mean[e] + std * noise[e].standard_normal(9)
                    observations[e], _, _, truncated, info = env.step(action)
                    if truncated:
                        rows[e] = (info["fractional_success"], info["fractional_success_strict"], info["truncated_by"] != "time",
                                   blocked[e], drift[e].item(), miss[e].item())
        for env in envs:
            env.close()
        results[n] = rows
    return results


def summary(distractors, results):
    """One row of zeroshot.csv; ci95 is the half width of the normal 95 % interval of the mean over episodes."""
    values = np.array(results, float)                                          # (episodes, 6)
    half = 1.96 * values.std(0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.full(6, np.nan)
    mean, rho, blocked = values.mean(0), values[:, 0], values[:, 3] > 0
    clear, behind = (rho[rows].mean() if rows.any() else np.nan for rows in (~blocked, blocked))
    return dict(zip(COLUMNS, (distractors, len(values), mean[0], mean[1], half[0], half[1], (rho >= 0.8).mean(), int(values[:, 2].sum()),
                              mean[3], clear, behind, mean[4], mean[5])))


def evaluate(run, distractors, episodes, mean_actions=False):
    """Play `episodes` episodes at every N in `distractors` on all cores; prints, writes and returns the rows."""
    checkpoint, _ = load(run)
    name = "zeroshot-mean.csv" if mean_actions else "zeroshot.csv"
    path = os.path.join(run, name)
    if os.path.exists(path) and tuple(read(run, name)) != COLUMNS:             # refused before the play, not after it
        raise ValueError(f"{path} has other columns than this version writes: remove it first")
    if checkpoint["encoder"] == "mlp" and any(n != checkpoint["distractors"] for n in distractors):
        print(f"{run}: an mlp has a fixed input, so it can be played at its own N = {checkpoint['distractors']} only")
        distractors = [n for n in distractors if n == checkpoint["distractors"]]
    if not distractors:
        return []
    chunks = [(run, distractors, first, min(CHUNK, episodes - first), mean_actions) for first in range(0, episodes, CHUNK)]
    print(f"{run}: {checkpoint['encoder']} trained on {checkpoint['task']} with {checkpoint['distractors']} distractors, "
          f"{checkpoint['frames']} frames, {'mean' if mean_actions else 'sampled'} actions")
    print("   N  episodes  success (axis-aligned)  success (strict)  solved  cut short   way clear  way blocked (share)   drift of z   read error (mm)")
    # Ctrl-C is for the main process alone: leaving the pool ends the others.
    with multiprocessing.get_context("spawn").Pool(min(os.cpu_count(), len(chunks)), signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        parts = pool.starmap(play, chunks, chunksize=1)
    rows = []
    for n in distractors:
        rows.append(summary(n, [row for part in parts for row in part[n]]))
        print("{distractors:4d} {episodes:9d}        {success_aabb:.3f} +- {ci95:.3f}    {success_strict:.3f} +- {ci95_strict:.3f}   "
              "{solved:.3f} {cut_short:10d}       {success_clear:.3f}        {success_blocked:.3f} ({blocked:.2f})        {z_drift:.3f} {mm:17.1f}"
              .format(**rows[-1], mm=1000 * rows[-1]["read_error"]), flush=True)
    if os.path.isdir(run):
        lines = {row["distractors"]: [str(row[key]) if isinstance(row[key], int) else f"{row[key]:.4f}" for key in COLUMNS] for row in rows}
        if os.path.exists(path):                               # rows of other N stay
            with open(path, newline="") as file:
                lines = {**{int(line[0]): line for line in list(csv.reader(file))[1:]}, **lines}
        with open(path, "w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *(lines[n] for n in sorted(lines))])
    return rows


def read(run, name):
    """Columns of a CSV of a run folder as float arrays; ValueError if the file is missing or empty."""
    path = os.path.join(run, name)
    try:
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    except (OSError, IndexError, TypeError, ValueError):
        raise ValueError(f"{path} is missing or not a CSV of this project") from None


def by_seed(runs):
    """Runs that differ only in the seed, together: {"push-lrn-n2": [folder, ...]}."""
    groups = {}
    for run in runs:
        groups.setdefault(re.sub(r"-seed\d+$", "", os.path.basename(os.path.normpath(run))), []).append(run)
    return groups


def evaluated(members):
    """Have all these runs been played?"""
    return all(os.path.exists(os.path.join(run, "zeroshot.csv")) for run in members)


def over_seeds(runs, key):
    """{N: (values, bar, half)} of a column of the runs' zeroshot.csv: each run's mean (S,), the half width of the 95 % interval of
    their mean over the episodes of these runs, and that over seeds (Student's t, wide for few; one run: over its episodes)."""
    cells, result = {}, {}
    for run in runs:
        rows = read(run, "zeroshot.csv")
        for i, n in enumerate(rows["distractors"]):
            share = rows["solved"][i]
            bar = {"success_aabb": rows["ci95"][i], "success_strict": rows["ci95_strict"][i],
                   "solved": 1.96 * np.sqrt(share * (1 - share) / rows["episodes"][i])}[key]
            cells.setdefault(int(n), []).append((rows[key][i], bar))
    for n in sorted(cells):
        values, bars = np.array(cells[n]).T
        S, bar = len(values), np.sqrt(np.square(bars).sum()) / len(bars)
        half = {2: 12.71, 3: 4.303, 4: 3.182, 5: 2.776}.get(S, 2.5) * values.std(ddof=1) / np.sqrt(S) if S > 1 else bar
        result[n] = values, bar, half
    return result


def table(runs):
    """Print README's tables of the runs that have been evaluated, one for each measure."""
    groups = {name: members for name, members in by_seed(runs).items() if evaluated(members)}
    if not groups:
        return print("no zeroshot.csv in these runs yet: evaluate them with --episodes 200 first")
    costs = {}
    for name, members in groups.items():
        frames, seconds = ([read(run, "timing.csv")[column][-1] for run in members] for column in ("frames", "seconds"))
        costs[name] = f"| {name} | {len(members)} | {np.mean(frames) / 1e6:.1f} | {', '.join(f'{s / 60:.0f}' for s in seconds)} | "
    for key, title in (("success_aabb", "axis-aligned"), ("success_strict", "strict"), ("solved", "solved")):
        columns = {name: over_seeds(members, key) for name, members in groups.items()}
        numbers = sorted({n for cells in columns.values() for n in cells})
        print(f"| {title} | seeds | million frames | minutes | " + " | ".join(f"N = {n}" for n in numbers) + " |")
        print("|---" * (4 + len(numbers)) + "|")
        for name, cells in columns.items():
            shown = {n: f"{values.mean():.2f} ± {half:.2f}" + (f"<br>{', '.join(f'{x:.2f}' for x in values)}" if len(values) > 1 else "")
                     for n, (values, _, half) in cells.items()}
            print(costs[name] + " | ".join(shown.get(n, "-") for n in numbers) + " |")
        print()


def plot(runs, path):
    """Training curves (left) and zero-shot curves (right, with 95 % intervals over episodes) of the runs, as in figure 3; a
    band spans the seeds."""
    try:
        import matplotlib
    except ImportError:
        raise ValueError("--plot needs matplotlib: pip install matplotlib") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for name, members in by_seed(runs).items():
        progress = [read(run, "progress.csv") for run in members]
        count = min(len(rows["frames"]) for rows in progress)
        window, color = min(20, count), None
        frames = progress[0]["frames"][window - 1:count] / 1e6
        for key, style in (("success_aabb", "-"), ("success_strict", ":")):
            smooth = [np.convolve(rows[key][:count], np.ones(window) / window, "valid") for rows in progress]
            line, = left.plot(frames, np.mean(smooth, 0), style, label=name if style == "-" else None, color=color)
            color = line.get_color()
            left.fill_between(frames, np.min(smooth, 0), np.max(smooth, 0), color=color, alpha=0.15, linewidth=0)
            if evaluated(members):
                cells = over_seeds(members, key)
                values, bars, _ = zip(*cells.values())
                right.errorbar(list(cells), [x.mean() for x in values], bars, linestyle=style, marker="o", markersize=3, capsize=3, color=color)
                right.fill_between(list(cells), [x.min() for x in values], [x.max() for x in values], color=color, alpha=0.15, linewidth=0)
    left.set(xlabel="million frames", ylabel="fractional success, last step", title=f"training (mean of {window} updates)")
    right.set(xlabel="distractors at test time", title="zero-shot (solid: axis-aligned, dotted: strict)")
    right.xaxis.get_major_locator().set_params(integer=True)
    for axes in (left, right):
        axes.set_ylim(0, 1)
        axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=120)
    print(f"wrote {path}")


@torch.inference_mode()
def film(run, distractors, path, episode=0):
    """Write one evaluation episode, played with sampled actions, as an animated GIF."""
    try:
        from PIL import Image
    except ImportError:
        raise ValueError("--gif needs pillow: pip install pillow") from None
    checkpoint, agent = load(run)
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"], render_mode="rgb_array")
    noise = np.random.default_rng(episode_seed(episode))
    (obs, info), frames, truncated = env.reset(seed=episode_seed(episode)), [], False
    every = max(1, round(0.08 / (env.substeps * env.timestep)))                # 12 pictures a second
    while not truncated:
        if len(frames) * every <= env._steps:
            frames.append(Image.fromarray(env.render(320, 240)))
        mean, log_std, _ = agent({key: torch.from_numpy(value)[None] for key, value in obs.items()})
        obs, _, _, truncated, info = env.step(mean[0].numpy() + log_std.exp().numpy() * noise.standard_normal(9))
    env.close()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=80, loop=0)
    print(f"wrote {path}: {distractors} distractors, fractional success {info['fractional_success']:.2f}")


def parse_range(text):
    """'0-9' or '2,5,14' or a mix: the sorted list of N."""
    try:
        numbers = set()
        for part in text.split(","):
            low, _, high = part.partition("-")
            numbers.update(range(int(low), int(high or low) + 1))
    except ValueError:
        fail(f"--distractors must look like 0-9 or 0,2,5, got {text!r}")
    if not numbers:
        fail(f"--distractors {text!r} names no number")
    return sorted(numbers)


def main():
    parser = argparse.ArgumentParser(description="Play trained agents zero-shot at other N (see the first lines of evaluate.py).")
    parser.error = fail
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folder of train.py")
    parser.add_argument("--distractors", default="0-9", metavar="LIST", help="numbers of distractors, as 0-9 or 0,2,14 (default 0-9)")
    parser.add_argument("--episodes", type=int, default=200, metavar="E", help="episodes at each N; 0: show what was measured before (default 200)")
    parser.add_argument("--mean-actions", action="store_true", help="play the mean of the policy instead of sampling")
    parser.add_argument("--plot", metavar="FILE", help="draw training and zero-shot curves of all runs from their CSV files")
    parser.add_argument("--gif", metavar="FILE", help="film an episode of the first run at the first N")
    args = parser.parse_args()
    numbers = parse_range(args.distractors)
    if args.episodes < 0:
        fail(f"--episodes must be at least 0, got {args.episodes}")
    for flag, path in (("--plot", args.plot), ("--gif", args.gif)):
        if path and not os.path.isdir(os.path.dirname(path) or "."):
            fail(f"{flag} {path}: there is no folder {os.path.dirname(path)}")
    try:
        for run in args.runs:
            checkpoint, _ = load(run)
            make_env(checkpoint["task"], numbers[-1], checkpoint["settings"]).close()      # refuses an N that is too large
        for run in args.runs if args.episodes else ():
            evaluate(run, numbers, args.episodes, args.mean_actions)
        if not args.episodes:
            table(args.runs)
        if args.plot:
            plot(args.runs, args.plot)
        if args.gif:
            film(args.runs[0], numbers[0], args.gif)
    except (ValueError, OSError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        fail("stopped; runs that were played to the end have their CSV", status=130)


if __name__ == "__main__":
    main()
