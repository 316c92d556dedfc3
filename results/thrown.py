"""Is the target cube pushed or thrown about?

    python results/thrown.py results/push-lrn-n2-seed0                    50 episodes at N = 2
    python results/thrown.py RUN [RUN ...] --episodes 20

Prints one row per run, means over its episodes, of each over its steps, played with sampled actions
as in training: the target cube's speed; the share of steps in which it is faster than FAST; the
share in which its centre lies further out than GRASP_RADIUS, where a finger can no longer get
behind it from every side; and the score at the end (axis-aligned).
"""
import math
import os
import sys

import numpy as np
import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from phases import play, read_command
from trifinger_env import GRASP_RADIUS

FAST = 0.3                               # m/s
COLUMNS = ("speed (m/s)", "fast", "far out", "success")


class Watched:
    """An environment that notes the way of its target cube."""

    def __init__(self, env):
        self.env = env
        self.places = [env._moment.position]                   # (T+1) x (3,), m
        self.success = 0.0

    def step(self, action):
        result = self.env.step(action)
        self.places.append(self.env._moment.position)
        self.success = result[-1]["fractional_success"]
        return result

    def row(self):
        """What the episode came to, in the order of COLUMNS."""
        seconds = self.env.substeps * self.env.timestep        # of a step
        moved = [math.dist(a, b) for a, b in zip(self.places, self.places[1:])]
        speed = np.array(moved) / seconds
        radius = np.array([math.hypot(x, y) for x, y, _ in self.places[1:]])
        return speed.mean(), (speed > FAST).mean(), (radius > GRASP_RADIUS).mean(), self.success


def main():
    args = read_command("Is the target cube pushed or thrown about?", episodes=50)
    torch.set_num_threads(1)
    print("| sampled actions | " + " | ".join(COLUMNS) + " |")
    print("|---" * (1 + len(COLUMNS)) + "|")
    for run in args.runs:
        rows = np.array([env.row() for env in play(run, args, Watched, sample_actions=True)])
        means = " | ".join(f"{mean:.2f}" for mean in rows.mean(axis=0))
        print(f"| {os.path.basename(os.path.normpath(run))} | {means} |", flush=True)


if __name__ == "__main__":
    main()
