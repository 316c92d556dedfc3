"""Play trained agents zero-shot at other numbers of distractors (section 4.3, figure 3 right).

    python evaluate.py RUN                                   N = 0..9, 200 episodes each: a table
    python evaluate.py RUN [RUN ...] --distractors 0-9,14 --save       and RUN/zeroshot.csv
    python evaluate.py RUN --watch                           watch it play, live in a window
    python evaluate.py RUN RUN --gif push.gif --distractors 9          a film, side by side

Episode j starts from the same seed at every N and for every agent: goal, target cube and the first
distractors stand in the same places (unless a crowd has to be nudged, as in some episodes at N = 9
and nearly all at 14, or an agent was trained with another goal_yaw); identifiers, the target's row
and a lifting goal's height differ. The paper does not say whether its scores are of sampled actions
or of the policy's means; CausalWorld's evaluation plays the means, and so do we.

The table's columns are means over episodes: success, the share of the goal's axis-aligned box that
the cube's box covers at the last step, as in CausalWorld; strict, the same by the cubes' true
volumes; solved, the share of episodes with a success of 0.8 or more. +- is a 95 % interval.
"""
import argparse
import csv
import io
import multiprocessing
import os
import signal
import sys
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pybullet
import torch

from train import STOPPED, derived_seed, fail, load, make_env
from trifinger_env import DIVERGED, SOLVED, TIME

CHUNK = 25                               # episodes side by side; the last bits depend on it
EVALUATION = 20220131                    # in place of a run's seed: other episodes than training's
PICTURE_PERIOD = 0.08                    # s between two pictures of a film, about
PICTURE = 400, 300                       # width and height of one


# ---- playing

def episode_seed(episode):
    """Seed of evaluation episode `episode`."""
    return derived_seed(EVALUATION, episode, 0)


def as_batch(observations):
    return {key: torch.from_numpy(np.stack([obs[key] for obs in observations]))
            for key in observations[0]}


def actions(agent, observations):
    """Actions (B, 9): the policy's means."""
    mean, _, _ = agent(as_batch(observations))
    return mean.numpy()


def in_chunks(episodes):
    """A range of episodes as ranges of at most CHUNK, which are played side by side."""
    return [episodes[first:first + CHUNK] for first in range(0, len(episodes), CHUNK)]


def play(checkpoint, agent, distractors, episodes):
    """Play `episodes` (a range), chunk by chunk: the info of each last step."""
    return [end for chunk in in_chunks(episodes)
            for end in play_chunk(checkpoint, agent, distractors, chunk)]


@torch.inference_mode()
def play_chunk(checkpoint, agent, distractors, episodes):
    """Play `episodes` side by side to their ends: the info of each last step."""
    envs = [make_env(checkpoint["task"], distractors, checkpoint["settings"]) for _ in episodes]
    observations = [env.reset(seed=episode_seed(episode))[0]
                    for env, episode in zip(envs, episodes)]
    ends = [None] * len(envs)
    while None in ends:
        # Ended ones stay in the batch: a smaller one may round differently.
        for e, action in enumerate(actions(agent, observations)):
            if ends[e] is None:
                observations[e], _, _, truncated, info = envs[e].step(action)
                if truncated:
                    ends[e] = info
    for env in envs:
        env.close()
    return ends


# ---- the sweep over N

def work(content, distractors, episodes):
    """play_chunk() in another process. `content`: a checkpoint, as bytes: its file may change."""
    torch.set_num_threads(1)
    return play_chunk(*load(io.BytesIO(content)), distractors, episodes)


def sweep(content, numbers, episodes):
    """Play a checkpoint (bytes) at every N in `numbers`, chunk by chunk on all cores.

    Prints and returns rows of zeroshot.csv, each as soon as its N is done.
    """
    parts = in_chunks(range(episodes))
    pool = ProcessPoolExecutor(min(os.cpu_count(), len(numbers) * len(parts)),
                               multiprocessing.get_context("spawn"))
    print("   N  success           strict            solved", flush=True)
    rows, begin = [], time.monotonic()
    ctrl_c = signal.signal(signal.SIGINT, signal.SIG_IGN)      # for this process, not the workers
    played = {n: [pool.submit(work, content, n, part) for part in parts] for n in numbers}
    signal.signal(signal.SIGINT, ctrl_c)
    try:
        for n, chunks in played.items():
            row = summary(n, [end for chunk in chunks for end in chunk.result()])
            rows.append(row)
            minutes = (time.monotonic() - begin) / len(rows) * (len(numbers) - len(rows)) / 60
            print(f"{n:4d}  {row['success']:.3f} +- {row['ci95']:.3f}    "
                  f"{row['success_strict']:.3f} +- {row['ci95_strict']:.3f}    "
                  f"{row['solved']:.3f}   {minutes:.1f} min left", flush=True)
    except BaseException:                # a Ctrl-C, too, must not wait for what is being played
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
    return rows


def half_width(values):
    """Half width of the normal 95 % interval of a mean; NaN for a single value."""
    if len(values) < 2:
        return float("nan")
    return 1.96 * values.std(ddof=1) / np.sqrt(len(values))


def summary(distractors, ends):
    """One row of zeroshot.csv from the infos of last steps: means over episodes."""
    success = np.array([end["fractional_success"] for end in ends])
    strict = np.array([end["fractional_success_strict"] for end in ends])
    return {
        "distractors": distractors,
        "episodes": len(ends),
        "success": success.mean(),
        "ci95": half_width(success),
        "success_strict": strict.mean(),
        "ci95_strict": half_width(strict),
        "solved": (success >= SOLVED).mean(),
        "cut_short": sum(end["truncated_by"] != TIME for end in ends),
    }


def evaluate(run, args):
    """The table of one run, saved if asked for."""
    file = os.path.join(run, "checkpoint.pt") if os.path.isdir(run) else run
    checkpoint, _ = load(file)
    own = [checkpoint["distractors"]]
    numbers = args.distractors or (own if checkpoint["encoder"] == "mlp" else list(range(10)))
    make_env(checkpoint["task"], numbers[-1], checkpoint["settings"]).close()  # refuses too many
    if args.save and not (os.path.isdir(run) and os.access(run, os.W_OK)):
        raise ValueError(f"--save: {run} is no folder that can be written to")
    print(f"{run}: {checkpoint['encoder']} trained on {checkpoint['task']} with "
          f"{checkpoint['distractors']} distractors, {checkpoint['frames']} frames")
    with open(file, "rb") as opened:
        content = opened.read()
    rows = sweep(content, numbers, args.episodes)
    if args.save:
        if load(file)[0]["update"] != checkpoint["update"]:
            raise ValueError(f"{run} was trained on meanwhile: its scores are not saved")
        path = os.path.join(run, "zeroshot.csv")
        with open(path, "w", newline="") as opened:
            writer = csv.DictWriter(opened, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows({key: f"{value:.4f}" if isinstance(value, float) else value
                              for key, value in row.items()} for row in rows)
        print(f"wrote {path}")


# ---- watching

def play_live(agent, env, episode):
    """Play one evaluation episode; yields the info at the start and after every step."""
    obs, info = env.reset(seed=episode_seed(episode))
    yield info
    truncated = False
    while not truncated:
        [action] = actions(agent, [obs])
        obs, _, _, truncated, info = env.step(action)
        yield info


@torch.inference_mode()
def watch(run, distractors, episodes):
    """Play episodes in PyBullet's window, in real time, until it is closed or Ctrl-C."""
    checkpoint, agent = load(run)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        raise ValueError("--watch needs a screen, and DISPLAY is not set")
    signal.signal(signal.SIGINT, signal.SIG_DFL)               # or a window that never comes hangs
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"], "human")
    print(f"{run}, {distractors} distractors: target blue, goal green; Ctrl-C stops", flush=True)
    try:
        for episode in range(episodes):
            for info in play_live(agent, env, episode):
                pass
            print(f"episode {episode}: success {info['fractional_success']:.2f}", flush=True)
    except pybullet.error:
        print("the window was closed")


def shoot(checkpoint, agent, distractors, episode):
    """An evaluation episode: pictures (300, 400, 3) with captions, and ms from one to the next."""
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"], "rgb_array")
    seconds = env.substeps * env.timestep                      # of an action
    every = max(1, round(PICTURE_PERIOD / seconds))            # actions from picture to picture
    name = checkpoint["encoder"].upper()
    if not checkpoint["settings"]["crowd"]:
        name += " without crowds"
    shots = []
    for step, info in enumerate(play_live(agent, env, episode)):
        is_sound = info.get("truncated_by") != DIVERGED        # else there is no picture
        if is_sound and (step % every == 0 or "truncated_by" in info):
            score = info["fractional_success"]
            shots.append((env.render(*PICTURE), f"{name}, N = {distractors}, score {score:.2f}"))
    env.close()
    return shots, round(1000 * every * seconds)


@torch.inference_mode()
def film(runs, distractors, episodes, path):
    """Write evaluation episodes as an animated GIF, the runs side by side from the same starts."""
    try:
        from PIL import Image, ImageDraw
    except ImportError:
        raise ValueError("--gif needs pillow: pip install pillow") from None
    agents, pictures = [load(run) for run in runs], []
    for episode in range(episodes):
        panels, periods = zip(*[shoot(*agent, distractors, episode) for agent in agents])
        length = max(map(len, panels)) + 10                    # the end is shown for a while
        panels = [shots + shots[-1:] * (length - len(shots)) for shots in panels]
        for moment in zip(*panels):
            picture = Image.fromarray(np.concatenate([shot for shot, _ in moment], axis=1))
            for panel, (_, caption) in enumerate(moment):
                place = PICTURE[0] * panel + 8, PICTURE[1] - 24
                ImageDraw.Draw(picture).text(place, caption, "black", font_size=16)
            pictures.append(picture)
    colors = pictures[0].quantize(64)                          # the same in all: nothing flickers
    first, *others = [picture.quantize(palette=colors, dither=Image.Dither.NONE)
                      for picture in pictures]
    first.save(path, save_all=True, append_images=others, duration=periods[0], loop=0)
    print(f"wrote {path}: {episodes} episodes, {distractors} distractors")


# ---- the command line

def numbers(text):
    """'0-9' or '2,5,14' or a mix, as argparse's `type`: the sorted list of N."""
    found = set()
    for part in text.split(","):
        low, dash, high = part.partition("-")
        found.update(range(int(low), int(high if dash else low) + 1))
    if not found:
        raise ValueError
    return sorted(found)


def read_command():
    parser = argparse.ArgumentParser(
        description="Play trained agents zero-shot at other N (see the top of evaluate.py).")
    parser.error = fail
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run folder of train.py")
    add("--distractors", type=numbers, metavar="LIST",
        help="numbers of distractors, as 0-9 or 0,2,14 (default 0-9); to watch or film: "
             "the smallest of them (default: as trained)")
    add("--episodes", type=int, metavar="E",
        help="episodes at each N (default 200), or of a film (default 3)")
    add = parser.add_mutually_exclusive_group().add_argument
    add("--save", action="store_true", help="write the rows to RUN/zeroshot.csv")
    add("--watch", action="store_true", help="play the first run live in a window")
    add("--gif", metavar="FILE.gif", help="film the runs side by side")
    args = parser.parse_args()
    if args.episodes is None:
        args.episodes = 3 if args.gif else 200
    if args.episodes < 1:
        fail("--episodes must be at least 1")
    return args


def main():
    args = read_command()
    try:
        if args.watch or args.gif:
            run = args.runs[0]
            distractors = args.distractors[0] if args.distractors else load(run)[0]["distractors"]
            if args.gif:
                film(args.runs, distractors, args.episodes, args.gif)
            else:
                watch(run, distractors, args.episodes)
            return
        for run in args.runs:
            evaluate(run, args)
    except (ValueError, OSError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(STOPPED)


if __name__ == "__main__":
    main()
