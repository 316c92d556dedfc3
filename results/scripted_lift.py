"""Can LiftingCube be solved at all? A script without feedback, by inverse kinematics, at N = 0.

    python results/scripted_lift.py                   200 episodes: the table of results/README.md
    python results/scripted_lift.py --episodes 5      a quick look

The fingertips close round the cube, press inwards, and carry it to the goal in a straight line, in
75 of an episode's 125 actions; zero actions then hold it. Of several ways to take hold of the cube
(where on its sides, how high) the script takes the first one that needs no joint beyond its limits.
"""
import argparse
import os
import sys

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from grasp import joint_angles
from train import fail, positive
from trifinger_env import CUBE, JOINT_LOW, SOLVED, JOINT_HIGH, TriFingerEnv

AROUND, PRESSED = 0.08, CUBE / 2 - 0.02                        # tips' distance from the middle, m
TURNS = [sign * turn for turn in np.arange(0.0, 0.9, 0.15) for sign in (1, -1)]
HEIGHTS = (0.035, 0.045, 0.03, 0.055)                          # of the grasp, m
BANDS = ((0.0, 0.05), (0.05, 0.1), (0.1, 0.15), (0.15, 0.2))   # heights of a goal, m


def possible_angles(centre, radius, turn):
    """Nine angles for tips on a circle round `centre` (x, y, z); None: out of reach or limits."""
    try:
        angles = joint_angles(centre[:2], radius, centre[2], turn)
    except ValueError:
        return None
    is_within = all(low <= q <= high for q, low, high in zip(angles, JOINT_LOW * 3, JOINT_HIGH * 3))
    return angles if is_within else None


def waypoints(cube, goal, turn, height):
    """What the tips do: [(joint angles, number of actions)]; None if some angles are impossible."""
    above, beside = (*cube[:2], AROUND), (*cube[:2], height)
    offset = np.array([0.0, 0.0, height - CUBE / 2])           # of the grasp from the cube's middle
    way = [(possible_angles(above, AROUND, turn), 15), (possible_angles(beside, AROUND, turn), 10),
           (possible_angles(beside, PRESSED, turn), 25)]
    for share in np.arange(1, 26) / 25:
        at = np.add(cube, np.subtract(goal, cube) * share) + offset
        way.append((possible_angles(at, PRESSED, turn), 1))
    return None if any(angles is None for angles, _ in way) else way


def play(env, seed):
    """One episode. Returns the goal's height and the last step's info; None without a way."""
    env.reset(seed=seed)
    cube, goal = env._poses[env.target][0], env.goal[0]
    ways = (waypoints(cube, goal, turn, height) for height in HEIGHTS for turn in TURNS)
    way = next(filter(None, ways), None)
    if way is None:
        return goal[2], None
    for angles, actions in way:
        for left in range(actions, 0, -1):
            env.step(np.subtract(angles, env._joint_targets) / left / env.action_scale)
    truncated = False
    while not truncated:                                       # zero actions keep the grip
        _, _, _, truncated, info = env.step(np.zeros(9))
    return goal[2], info


def bands(heights):
    """[(label, which of the heights lie in it)] of every band that is not empty, and of all.

    Goals on the floor are all in one band: then of all alone.
    """
    found = [(f"{low:.2f} to {high:.2f} m", (low < heights) & (heights <= high))
             for low, high in BANDS]
    found = [(label, at) for label, at in found if at.any()]
    everything = [("all", np.ones(len(heights), bool))]
    return found + everything if len(found) > 1 else everything


def main():
    parser = argparse.ArgumentParser(description="LiftingCube by inverse kinematics.")
    parser.error = fail
    parser.add_argument("--episodes", type=positive, default=200, metavar="E", help="default 200")
    episodes = parser.parse_args().episodes
    env = TriFingerEnv("lift", 0)
    rows = []
    for seed in range(episodes):
        height, info = play(env, seed)
        scores = (0.0, 0.0) if info is None else (info["fractional_success"],
                                                  info["fractional_success_strict"])
        rows.append((height, *scores, info is not None))
    env.close()
    heights, success, strict, possible = np.array(rows, float).T
    print("goal's height | episodes | a way was found | success | strict | solved")
    for label, at in bands(heights):
        print(f"{label} | {at.sum()} | {possible[at].mean():.2f} | {success[at].mean():.2f} | "
              f"{strict[at].mean():.2f} | {(success[at] >= SOLVED).mean():.2f}")


if __name__ == "__main__":
    main()
