"""How far do lifting episodes come, by height of the goal?

    python results/phases.py results/lift-lrn-n2-seed0                    200 episodes at N = 2
    python results/phases.py RUN [RUN ...] --distractors 9 --episodes 100

Prints one row per band of goal heights: the score at the end (axis-aligned and strict), the best
score on the way, and the shares of episodes that came to each phase at some moment:
reached: all three fingertips within 6 cm of the target cube's centre; raised: that centre higher
than 5.5 cm (0.0325 on the floor); above: within 2 cm of the goal, seen from above; placed: overlap
of 0.8; kept: overlap of 0.8 at the end. Episodes and (mean) actions are those of evaluate.py.
"""
import argparse
import math
import os
import sys

import numpy as np
import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import evaluate
from scripted_lift import bands
from train import fail, load, positive
from trifinger_env import SOLVED

COLUMNS = ("success", "strict", "best", "reached", "raised", "above", "placed", "kept")


class Watched:
    """An environment that notes at each step which phases its episode has come to."""

    def __init__(self, env):
        self.env = env
        self.height = env.goal[0][2]
        self.row = dict.fromkeys(COLUMNS, 0.0)

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        env, row, rho = self.env, self.row, info["fractional_success"]
        place, goal = env._moment.position, env.goal[0]
        now = {
            "success": rho,
            "strict": info.get("fractional_success_strict", 0.0),
            "best": max(row["best"], rho),
            "reached": max(math.dist(tip, place) for tip in env._moment.tips) < 0.06,
            "raised": place[2] > 0.055,
            "above": math.dist(place[:2], goal[:2]) < 0.02,
            "placed": rho >= SOLVED,
            "kept": rho >= SOLVED,
        }
        for name in ("reached", "raised", "above", "placed"):
            now[name] = max(row[name], float(now[name]))
        row.update(now)
        return obs, reward, terminated, truncated, info


@torch.inference_mode()
def play(run, args, watch, sample_actions=False):
    """The episodes of `args`, each played to its end in a watch(env): a list of these."""
    try:
        checkpoint, agent = load(run)
        played = []
        for part in evaluate.chunks(range(args.episodes)):
            envs, observations = evaluate.start(checkpoint, args.distractors, part)
            watched = [watch(env) for env in envs]
            generators = evaluate.noise_of(part) if sample_actions else None
            evaluate.to_the_end(agent, watched, observations, generators)
            for env in envs:
                env.close()
            played += watched
    except ValueError as error:
        fail(str(error))
    return played


def read_command(description, episodes):
    """The command's arguments: runs, N and by default so many episodes."""
    parser = argparse.ArgumentParser(description=description)
    parser.error = fail
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN")
    add("--distractors", type=int, default=2, metavar="N", help="default 2")
    add("--episodes", type=positive, default=episodes, metavar="E", help=f"default {episodes}")
    return parser.parse_args()


def main():
    args = read_command("Phases of lifting by height of the goal.", episodes=200)
    torch.set_num_threads(1)
    print("run | N | goal's height | episodes | " + " | ".join(COLUMNS))
    for run in args.runs:
        played = play(run, args, Watched)
        heights = np.array([env.height for env in played])
        rows = np.array([[env.row[name] for name in COLUMNS] for env in played], float)
        for label, at in bands(heights):
            means = " | ".join(f"{mean:.2f}" for mean in rows[at].mean(axis=0))
            print(f"{os.path.basename(os.path.normpath(run))} | {args.distractors} | {label} | "
                  f"{at.sum()} | {means}", flush=True)


if __name__ == "__main__":
    main()
