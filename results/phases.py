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
def play(run, distractors, episodes):
    """Heights of the goals (E,) and what the episodes came to (E, columns)."""
    checkpoint, agent = load(run)
    heights, rows = [], []
    for part in evaluate.chunks(range(episodes)):
        envs, observations = evaluate.start(checkpoint, distractors, part)
        watched = [Watched(env) for env in envs]
        evaluate.to_the_end(agent, watched, observations)
        for env in watched:
            heights.append(env.height)
            rows.append([env.row[name] for name in COLUMNS])
            env.env.close()
    return np.array(heights), np.array(rows, float)


def main():
    parser = argparse.ArgumentParser(description="Phases of lifting by height of the goal.")
    parser.error = fail
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--distractors", type=int, default=2, metavar="N", help="default 2")
    parser.add_argument("--episodes", type=positive, default=200, metavar="E", help="default 200")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print("run | N | goal's height | episodes | " + " | ".join(COLUMNS))
    for run in args.runs:
        try:
            heights, rows = play(run, args.distractors, args.episodes)
        except ValueError as error:
            fail(str(error))
        for label, at in bands(heights):
            means = " | ".join(f"{mean:.2f}" for mean in rows[at].mean(axis=0))
            print(f"{os.path.basename(os.path.normpath(run))} | {args.distractors} | {label} | "
                  f"{at.sum()} | {means}", flush=True)


if __name__ == "__main__":
    main()
