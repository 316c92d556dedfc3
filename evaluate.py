"""Play trained agents zero-shot at other numbers of distractors (section 4.3, figure 3 right).

    python evaluate.py RUN                                   N = 0..9, 200 episodes each: a table
    python evaluate.py RUN [RUN ...] --distractors 0-9,14 --save       and RUN/zeroshot.csv
    python evaluate.py RUN --sample-actions                  with the noise of training
    python evaluate.py RUN --watch                           watch it play, live in a window
    python evaluate.py RUN --gif push.gif --distractors 9    a film of one episode

Episode j starts from the same seed at every N and for every agent: goal, target cube and the first
distractors stand in the same places (unless a crowd has to be nudged, as in nearly all episodes at
N = 14, or an agent was trained with another goal_yaw). What is drawn after them differs:
identifiers, the target's row and a lifting goal's height. The seeds belong to no training run (but
one with --seed 20220131). The paper does not say whether its scores are of sampled actions or of
the policy's means; CausalWorld's evaluation plays the means, and so do we.

The table's columns, means over episodes: success, axis-aligned as in CausalWorld and strict, by
true volumes; solved, the share with 0.8 or more; cut short, how many ended before their time (a
cube left, or the physics diverged); success where the way from target to goal was clear and where a
distractor blocked it at the start; how far z at the start lies from where it lies at the N of
training; how far the place that the read-out sees lies from the target cube.
"""
import argparse
import csv
import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from typing import NamedTuple

import numpy as np
import pybullet
import torch

from train import STOPPED, checkpoint_file, cores, derived_seed, fail, load, make_env, positive
from trifinger_env import (CUBE, DIVERGED, IDENTIFIER, IDENTIFIER_POOL, POSITION, POSITION_SCALE,
                           SOLVED, TIME)

COLUMNS = ("distractors", "episodes", "success_aabb", "success_strict", "ci95", "ci95_strict",
           "solved", "cut_short", "blocked", "success_clear", "success_blocked", "z_drift",
           "read_error")
CHUNK = 25                               # episodes side by side; another number may change bits
EVALUATION = 20220131                    # keeps these seeds apart from training's
STARTS, NOISE = 0, 1                     # what an episode draws: see derived_seed()
PICTURE_PERIOD = 0.08                    # s between two pictures of a film, about


class Episode(NamedTuple):
    """What one episode came to."""
    success_aabb: float                  # fractional success at the last step, axis-aligned
    success_strict: float                # the same by true volumes
    cut_short: bool                      # ended for another reason than time
    blocked: bool                        # a distractor stood in the way at the start
    z_drift: float                       # at the start, see drift_of()
    read_error: float                    # m, at the start, see read_errors()


def episode_seed(episode):
    """Seed of evaluation episode `episode`."""
    return derived_seed(EVALUATION, episode, STARTS)


def is_target(obs):
    """(..., N+1) bool: which cube does the goal name? Of one observation or of a batch."""
    return obs["cubes"][..., IDENTIFIER] == obs["goal"][..., IDENTIFIER, None]


def is_blocked(obs):
    """Does a distractor's centre lie within a cube's width of the line from target to goal?"""
    target = is_target(obs)
    places = obs["cubes"][:, POSITION][:, :2] * POSITION_SCALE             # (N+1, 2), m
    goal = obs["goal"][POSITION][:2] * POSITION_SCALE
    cube, others = places[target][0], places[~target]
    way = goal - cube
    length_squared = max(np.square(way).sum(), 1e-12)
    share = np.clip((others - cube) @ way / length_squared, 0, 1)          # of the way, (N,)
    nearest = cube + share[:, None] * way                                  # (N, 2)
    return bool((np.linalg.norm(others - nearest, axis=1) < CUBE).any())


def chunks(episodes):
    """A range of episode numbers in parts of at most CHUNK."""
    return [episodes[first:first + CHUNK] for first in range(0, len(episodes), CHUNK)]


# ---- playing

def as_batch(observations):
    return {key: torch.from_numpy(np.stack([obs[key] for obs in observations]))
            for key in observations[0]}


def start(checkpoint, distractors, episodes):
    """Environments at the start of these episodes, and their observations."""
    envs = [make_env(checkpoint["task"], distractors, checkpoint["settings"]) for _ in episodes]
    observations = [env.reset(seed=episode_seed(episode))[0]
                    for env, episode in zip(envs, episodes)]
    return envs, observations


def trained_z(checkpoint, agent, episodes):
    """z (B, Z) at the start of these episodes at the N of training."""
    envs, observations = start(checkpoint, checkpoint["distractors"], episodes)
    for env in envs:
        env.close()
    return agent.encode(as_batch(observations))


def drift_of(z, z_trained):
    """How far each row of z (B, Z) lies from the same row of z_trained (B, Z): (B,).

    In units of the mean distance between two rows of z_trained.
    Identifiers and a lifting goal's height are drawn after the distractors, so they differ at
    another N and move z, too. NaN for a single row.
    """
    B = len(z)
    spread = torch.cdist(z_trained, z_trained).sum() / (B * (B - 1))
    return (z - z_trained).norm(dim=1) / spread


def read_errors(agent, observations, z):
    """Distances (m) from the target cube to where the agent's read-out sees it: (B,)."""
    targets = np.stack([obs["cubes"][is_target(obs)][0, POSITION] for obs in observations])
    seen = agent.read_out(z)[:, :3]
    return (seen - torch.from_numpy(targets)).norm(dim=1) * POSITION_SCALE


def noise_of(episodes):
    """One generator of action noise per episode, independent of the one that places the cubes."""
    return [np.random.default_rng(derived_seed(EVALUATION, episode, NOISE)) for episode in episodes]


def actions(agent, observations, generators=None):
    """Actions (B, 9): sampled with a generator per episode or, without any, the policy's means."""
    mean, log_std, _ = agent(as_batch(observations))
    if generators is None:
        return mean.numpy()
    std = log_std.exp().numpy()
    return [m + std * generator.standard_normal(9)
            for m, generator in zip(mean.numpy(), generators)]


def to_the_end(agent, envs, observations, generators=None):
    """Play every environment until its episode ends; the info of each last step."""
    ends = [None] * len(envs)
    while None in ends:
        # Ended ones go on in the batch: its size decides bits.
        chosen = actions(agent, observations, generators)
        for e, action in enumerate(chosen):
            if ends[e] is None:
                observations[e], _, _, truncated, info = envs[e].step(action)
                if truncated:
                    ends[e] = info
    return ends


@torch.inference_mode()
def play(checkpoint, agent, distractors, episodes, sample_actions):
    """Play `episodes` (a range) side by side: a list of Episodes."""
    envs, observations = start(checkpoint, distractors, episodes)
    blocked = [is_blocked(obs) for obs in observations]
    z = agent.encode(as_batch(observations))
    drift = drift_of(z, trained_z(checkpoint, agent, episodes)).tolist()
    error = [float("nan")] * len(episodes)
    if checkpoint["settings"]["auxiliary"] > 0:                # trained with a read-out
        error = read_errors(agent, observations, z).tolist()

    generators = noise_of(episodes) if sample_actions else None
    ends = to_the_end(agent, envs, observations, generators)
    for env in envs:
        env.close()
    return [Episode(
        success_aabb=info["fractional_success"],
        success_strict=info["fractional_success_strict"],
        cut_short=info["truncated_by"] != TIME,
        blocked=blocked[e],
        z_drift=drift[e],
        read_error=error[e],
    ) for e, info in enumerate(ends)]


def play_chunk(arguments):
    """play() in a process of its own, which has to load the agent anew."""
    path, distractors, episodes, sample_actions = arguments
    torch.set_num_threads(1)
    checkpoint, agent = load(path)
    return play(checkpoint, agent, distractors, episodes, sample_actions)


# ---- the sweep over N

def half_width(values):
    """Half width of the normal 95 % interval of a mean; NaN for a single value."""
    if len(values) < 2:
        return float("nan")
    return 1.96 * values.std(ddof=1) / np.sqrt(len(values))


def mean_or_nan(values):
    """Mean of an array; NaN, without a warning, if it is empty."""
    return values.mean() if len(values) else float("nan")


def summary(distractors, episodes):
    """One row of zeroshot.csv: means over episodes, with 95 % intervals."""
    column = dict(zip(Episode._fields, np.array(episodes, float).T))
    rho, strict = column["success_aabb"], column["success_strict"]
    drift = column["z_drift"]
    is_clear = column["blocked"] == 0
    return {
        "distractors": distractors,
        "episodes": len(episodes),
        "success_aabb": rho.mean(),
        "success_strict": strict.mean(),
        "ci95": half_width(rho),
        "ci95_strict": half_width(strict),
        "solved": (rho >= SOLVED).mean(),
        "cut_short": int(column["cut_short"].sum()),
        "blocked": column["blocked"].mean(),
        "success_clear": mean_or_nan(rho[is_clear]),
        "success_blocked": mean_or_nan(rho[~is_clear]),
        "z_drift": mean_or_nan(drift[~np.isnan(drift)]),
        "read_error": column["read_error"].mean(),
    }


HEADER = ("   N  success (axis-aligned)  success (strict)  solved  cut short   way clear  "
          "way blocked (share)  drift of z  read error (mm)")


def print_row(row, seconds_left):
    aligned = f"{row['success_aabb']:.3f} +- {row['ci95']:.3f}"
    strict = f"{row['success_strict']:.3f} +- {row['ci95_strict']:.3f}"
    blocked = f"{row['success_blocked']:.3f} ({row['blocked']:.2f})"
    left = f"about {seconds_left / 60:.1f} min left" if seconds_left else ""
    print(f"{row['distractors']:4d} {aligned:>23s} {strict:>17s} {row['solved']:7.3f} "
          f"{row['cut_short']:10d} {row['success_clear']:11.3f} {blocked:>20s} "
          f"{row['z_drift']:11.3f} {1000 * row['read_error']:16.1f}  {left}", flush=True)


def evaluate(run, numbers, episodes, sample_actions=False):
    """Play `episodes` episodes at every N in `numbers` on all cores.

    Prints and returns rows, each as soon as its N is done. A copy of the checkpoint is played, as a
    run that is still being trained replaces its own.
    """
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(checkpoint_file(run), os.path.join(folder, "checkpoint.pt"))
        checkpoint, _ = load(folder)
        numbers = playable(run, checkpoint, numbers)
        if not numbers:
            return []
        print(f"{run}: {checkpoint['encoder']} trained on {checkpoint['task']} with "
              f"{checkpoint['distractors']} distractors, {checkpoint['frames']} frames; "
              f"{episodes} episodes each, {'sampled' if sample_actions else 'mean'} actions")
        print(HEADER, flush=True)
        return play_all(folder, numbers, range(episodes), sample_actions)


def playable(run, checkpoint, numbers):
    """Those of the `numbers` of distractors that the agent can play at all."""
    trained = checkpoint["distractors"]
    if checkpoint["encoder"] != "mlp" or numbers == [trained]:
        return numbers
    print(f"{run}: an mlp has a fixed input, so it can be played at its own N = {trained} only")
    return [n for n in numbers if n == trained]


def play_all(path, numbers, episodes, sample_actions):
    """Rows of the agent in `path`, chunk by chunk on all cores."""
    parts = chunks(episodes)
    jobs = [(path, n, part, sample_actions) for n in numbers for part in parts]
    context = multiprocessing.get_context("spawn")
    rows, begin = [], time.monotonic()
    # Ctrl-C is for the main process alone: leaving the pool ends the others.
    with context.Pool(min(cores(), len(jobs)), initializer=signal.signal,
                      initargs=(signal.SIGINT, signal.SIG_IGN)) as pool:
        results = pool.imap(play_chunk, jobs)                  # in order, as they are done
        for n in numbers:
            played = [episode for _ in parts for episode in next(results)]
            rows.append(summary(n, played))
            seconds_each = (time.monotonic() - begin) / len(rows)
            print_row(rows[-1], seconds_each * (len(numbers) - len(rows)))
    return rows


def save_rows(path, rows):
    """Write rows into a zeroshot.csv that check_csv() has let pass; rows of other N stay."""
    lines = {}
    if os.path.exists(path):
        with open(path, newline="") as file:
            _, *old = csv.reader(file)
        lines = {int(line[0]): line for line in old}
    for row in rows:
        lines[row["distractors"]] = [
            str(row[key]) if isinstance(row[key], int) else f"{row[key]:.4f}" for key in COLUMNS]
    with open(path, "w", newline="") as file:
        ordered = [lines[n] for n in sorted(lines)]
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *ordered])
    print(f"wrote {path}")


def check_csv(run, name):
    """ValueError, before anything is played, if RUN/NAME cannot take the rows.

    That is if `run` is not a folder, or if a file is in the way that is not a zeroshot.csv.
    """
    if not os.path.isdir(run):
        raise ValueError(f"--save needs a run folder to write to, {run} is a file")
    path = os.path.join(run, name)
    if not os.path.exists(path):
        return
    with open(path, newline="") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    is_whole = all(len(row) == len(COLUMNS) and row[0].isdigit() for row in rows)
    if tuple(header) != COLUMNS or not is_whole:
        raise ValueError(f"{path} is not a zeroshot.csv of this version: remove it first")


# ---- watching

def play_live(agent, env, episode, sample_actions):
    """Play one evaluation episode; yields the info at the start and after every step."""
    generators = noise_of([episode]) if sample_actions else None
    obs, info = env.reset(seed=episode_seed(episode))
    yield info
    truncated = False
    while not truncated:
        [action] = actions(agent, [obs], generators)
        obs, _, _, truncated, info = env.step(action)
        yield info


@torch.inference_mode()
def watch(run, distractors, episodes, sample_actions):
    """Play episodes in PyBullet's window, in real time, until it is closed or Ctrl-C."""
    checkpoint, agent = load(run)
    signal.signal(signal.SIGINT, signal.SIG_DFL)               # or a window that never comes hangs
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"], render_mode="human")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print(f"{run} plays {episodes} episodes with {distractors} distractors; target blue, goal "
          f"green, distractors red; close the window or press Ctrl-C to stop", flush=True)
    try:
        for episode in range(episodes):
            for info in play_live(agent, env, episode, sample_actions):
                pass
            print(f"episode {episode}: fractional success {info['fractional_success']:.2f}",
                  flush=True)
        env.close()
    except pybullet.error:
        if pybullet.isConnected(env._client):
            raise
        print("the window was closed")
    except KeyboardInterrupt:
        print("stopped")


@torch.inference_mode()
def film(run, distractors, sample_actions, path):
    """Write the first evaluation episode as an animated GIF."""
    try:
        from PIL import Image
    except ImportError:
        raise ValueError("--gif needs pillow: pip install pillow") from None
    checkpoint, agent = load(run)
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"], "rgb_array")
    seconds = env.substeps * env.timestep                      # of an action
    every = max(1, round(PICTURE_PERIOD / seconds))            # actions from picture to picture
    pictures = []
    for step, info in enumerate(play_live(agent, env, 0, sample_actions)):
        has_picture = info.get("truncated_by") != DIVERGED     # of that there is nothing to draw
        if step % every == 0 and has_picture:
            pictures.append(Image.fromarray(env.render(320, 240)))
    env.close()
    pictures[0].save(path, save_all=True, append_images=pictures[1:],
                     duration=round(1000 * every * seconds), loop=0)
    print(f"wrote {path}: {distractors} distractors, fractional success "
          f"{info['fractional_success']:.2f}")


# ---- the command line

def parse_range(text):
    """'0-9' or '2,5,14' or a mix: the sorted list of N."""
    numbers = set()
    try:
        for part in text.split(","):
            low, dash, high = part.partition("-")
            first, last = int(low), int(high if dash else low)
            if last < first:
                raise ValueError
            last = min(last, first + len(IDENTIFIER_POOL))     # 0-999999999 must not fill memory
            numbers.update(range(first, last + 1))
    except ValueError:
        fail(f"--distractors must look like 0-9 or 0,2,5, got {text!r}")
    return sorted(numbers)


def read_command():
    parser = argparse.ArgumentParser(
        description="Play trained agents zero-shot at other N (see the top of evaluate.py).")
    parser.error = fail
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run folder of train.py")
    add("--distractors", metavar="LIST",
        help="numbers of distractors, as 0-9 or 0,2,14 (default 0-9); to watch or film: "
             "the smallest of them (default: as trained)")
    add("--episodes", type=positive, default=200, metavar="E",
        help="episodes at each N (default 200)")
    add("--sample-actions", action="store_true",
        help="sample actions as in training instead of playing the policy's means")
    add("--save", action="store_true",
        help="write the rows to RUN/zeroshot.csv (zeroshot-sampled.csv for sampled actions)")
    add("--watch", action="store_true", help="play the first run live in a window")
    add("--gif", metavar="FILE", help="film one episode of the first run")
    args = parser.parse_args()
    if args.gif and not args.gif.endswith(".gif"):
        fail(f"--gif {args.gif}: the file's name must end in .gif")
    if args.gif and not os.path.isdir(os.path.dirname(args.gif) or "."):
        fail(f"--gif {args.gif}: there is no folder {os.path.dirname(args.gif)}")
    if args.save and (args.watch or args.gif):
        fail("--save is for the table: not together with --watch or --gif")
    return args


def show(args):
    """--watch and --gif: the first run at the smallest N given, by default as it was trained."""
    run = args.runs[0]
    trained = load(run)[0]["distractors"]
    distractors = parse_range(args.distractors)[0] if args.distractors else trained
    if args.gif:
        film(run, distractors, args.sample_actions, args.gif)
    if args.watch:
        watch(run, distractors, args.episodes, args.sample_actions)


def sweep(args):
    """Evaluate all runs, after a look at whatever could go wrong."""
    numbers = parse_range(args.distractors or "0-9")
    name = "zeroshot-sampled.csv" if args.sample_actions else "zeroshot.csv"
    for run in args.runs:
        checkpoint, _ = load(run)
        make_env(checkpoint["task"], numbers[-1], checkpoint["settings"]).close()
        if args.save:
            check_csv(run, name)
    for run in args.runs:
        update = load(run)[0]["update"]
        rows = evaluate(run, numbers, args.episodes, args.sample_actions)
        if not (args.save and rows):
            continue
        if load(run)[0]["update"] != update:
            raise ValueError(f"{run} was trained on meanwhile: its scores are not saved")
        save_rows(os.path.join(run, name), rows)


def main():
    args = read_command()
    try:
        if args.watch or args.gif:
            show(args)
        else:
            sweep(args)
    except (ValueError, OSError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        fail("stopped; with --save, runs that were played to the end have their CSV", STOPPED)


if __name__ == "__main__":
    main()
