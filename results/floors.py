"""Between which scores do agents stand? An untrained agent below, a script that lifts above.

    python results/floors.py                    200 episodes each, some minutes: floors.csv

The untrained agent has LRN's weights before the first update.
The script is no agent: it knows where the target stands, computes joint angles by inverse
kinematics and looks at nothing afterwards. Three tips close round the cube, press it and carry it
to the goal in a straight line; zero actions then hold it. It takes the first grasp that needs no
joint beyond its limits, and plays without distractors, of which it knows nothing.
"""
import csv
import itertools
import math
import os
import sys

import numpy as np
import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
import evaluate
from inside import BANDS
from test_all import reach
from train import DEFAULTS, Agent
from trifinger_env import CUBE, FINGER_YAW, JOINT_HIGH, JOINT_LOW, TriFingerEnv

EPISODES = 200
APART, PRESSED = 0.08, CUBE / 2 - 0.02                         # of the tips from the middle, m
TURNS = sorted(np.arange(-5, 6) * 0.15, key=abs)               # of the grasp about the cube, rad
GRASP_HEIGHTS = (0.035, 0.045, 0.03, 0.055)                    # m


# ---- the script

def grasp(centre, radius, turn):
    """Joint angles (9,) with the tips on a circle; ValueError if it is out of reach."""
    bearings = [yaw + math.pi + turn for yaw in FINGER_YAW]
    angles = [q for k, at in enumerate(bearings)
              for q in reach(k, np.add(centre, (radius * math.cos(at), radius * math.sin(at), 0)))]
    if not all(low <= q <= high for q, low, high in zip(angles, JOINT_LOW * 3, JOINT_HIGH * 3)):
        raise ValueError("a joint is beyond its limits")
    return angles


def way_of(cube, goal, height, turn):
    """[(joint angles, actions to get there)] from beside the cube to the goal."""
    low = (*cube[:2], height)
    way = [(grasp((*cube[:2], APART), APART, turn), 15), (grasp(low, APART, turn), 10),
           (grasp(low, PRESSED, turn), 25)]
    carried = np.subtract(goal, cube)
    return way + [(grasp(np.add(low, share * carried), PRESSED, turn), 1)
                  for share in np.linspace(0.04, 1, 25)]


def first_way(cube, goal):
    """The first grasp that is possible, or None."""
    for height, turn in itertools.product(GRASP_HEIGHTS, TURNS):
        try:
            return way_of(cube, goal, height, turn)
        except ValueError:
            continue
    return None


def play_script(env, seed):
    """Height of the goal in m, and the score; 0 where no grasp is possible."""
    env.reset(seed=seed)
    goal = env.goal[0]
    way = first_way(env._poses[env.target][0], goal)
    if way is None:
        return goal[2], 0.0
    actions = [(angles, left) for angles, count in way for left in range(count, 0, -1)]
    for angles, left in actions:
        env.step(np.subtract(angles, env._joint_targets) / left / env.action_scale)
    for _ in range(env.episode_steps - len(actions)):
        *_, info = env.step(np.zeros(9))                       # the grip stays as it is
    return goal[2], info["fractional_success"]


# ---- the table

def script_rows():
    for task in ("push", "lift"):
        env = TriFingerEnv(task, distractors=0)
        played = [play_script(env, evaluate.episode_seed(e)) for e in range(EPISODES)]
        env.close()
        heights, scores = np.array(played).T
        yield f"script, {task}", 0, scores
        for low, high in BANDS if task == "lift" else ():
            in_band = (heights >= low / 100) & (heights < high / 100)
            yield f"script, {task}, goal {low} to {high} cm high", 0, scores[in_band]


def untrained_rows():
    torch.manual_seed(0)
    agent = Agent("lrn", 2, DEFAULTS)
    for task, N in itertools.product(("push", "lift"), (2, 9)):
        checkpoint = {"task": task, "settings": DEFAULTS}
        ends = evaluate.play(checkpoint, agent, N, range(EPISODES))
        yield f"untrained, {task}", N, np.array([end["fractional_success"] for end in ends])


def main():
    torch.set_num_threads(1)
    with open(os.path.join(HERE, "floors.csv"), "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("who", "distractors", "episodes", "success", "ci95"))
        for who, N, scores in itertools.chain(script_rows(), untrained_rows()):
            mean, half = scores.mean(), evaluate.half_width(scores)
            table.writerow((who, N, len(scores), f"{mean:.4f}", f"{half:.4f}"))
            print(f"{who:40s} N = {N}   {mean:.3f} +- {half:.3f}", flush=True)


if __name__ == "__main__":
    main()
