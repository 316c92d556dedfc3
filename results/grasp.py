"""Can a cube be held at all? A scripted three-finger grasp by mass and friction; nothing is learnt.

    python results/grasp.py                  60 tries a cell: the table of results/README.md
    python results/grasp.py --tries 2        a quick look

In each try the cube lies near the centre; three fingertips close round it at a random height, press
inwards by a random depth (inverse kinematics), and rise to 0.15 m. It counts as held if the cube
is above 0.12 m for the last two seconds. TriFingerEnv's defaults are 0.08 kg and 1.0.
"""
import argparse
import math
import os
import sys

import numpy as np
import pybullet as pb

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from train import fail, positive
from trifinger_env import (CUBE, FINGER_YAW, JOINT_LOW, JOINT_HIGH, TriFingerEnv,
                           inverse_kinematics, yaw_quaternion)

BEARINGS = [yaw + math.pi for yaw in FINGER_YAW]               # every finger grasps on its own side


def joint_angles(centre, radius, height, turn):
    """Nine angles that bring the tips to a circle round `centre` (x, y); ValueError: too far."""
    angles = []
    for k, bearing in enumerate(BEARINGS):
        x = centre[0] + radius * math.cos(bearing + turn)
        y = centre[1] + radius * math.sin(bearing + turn)
        angles += inverse_kinematics(k, (x, y, height))
    return angles


def tip_action(centre, radius, height, turn):
    """Action of mode "absolute" that brings the tips there."""
    angles = joint_angles(centre, radius, height, turn)
    return [2 * (q - low) / (high - low) - 1
            for q, low, high in zip(angles, JOINT_LOW * 3, JOINT_HIGH * 3)]


def grasp(env, centre, yaw, depth, height, turn, lift=0.15):
    """Close, press, rise and hold for two seconds; the cube's height at each step of the hold."""
    cube = env._cubes[env.target]
    pb.resetBasePositionAndOrientation(cube, [*centre, CUBE / 2], yaw_quaternion(yaw),
                                       physicsClientId=env._client)
    pressed = CUBE / 2 - depth
    second = round(1 / (env.substeps * env.timestep))
    closing = [(radius, height) for radius in np.linspace(0.075, pressed, second)]
    rising = [(pressed, z) for z in np.linspace(height, lift, second)]
    holding = [(pressed, lift)] * (2 * second)
    heights = []
    for radius, z in [(0.075, height)] * second + closing + rising + holding:
        env.step(tip_action(centre, radius, z, turn))
        heights.append(env._poses[env.target][0][2])
    return heights[-len(holding):]


def share_held(mass, friction, tries):
    """Share of tries in which the cube is held."""
    env = TriFingerEnv("lift", 0, action_mode="absolute", cube_mass=mass,
                       finger_friction=friction)
    held = 0
    for number in range(tries):
        rng = np.random.default_rng(number)
        env.reset(seed=number)
        heights = grasp(env, rng.uniform(-0.02, 0.02, 2), yaw=rng.uniform(-0.8, 0.8),
                        depth=rng.uniform(0.005, 0.04), height=rng.uniform(0.02, 0.045),
                        turn=rng.uniform(-0.3, 0.3))
        held += min(heights) > 0.12
    env.close()
    return held / tries


def main():
    parser = argparse.ArgumentParser(description="Scripted grasps by mass and friction.")
    parser.error = fail
    parser.add_argument("--tries", type=positive, default=60, metavar="T",
                        help="per cell (default 60)")
    tries = parser.parse_args().tries
    print("share held | friction 0.1 | 0.3 | 0.5 | 1.0")
    for mass in (0.08, 0.02):
        shares = [share_held(mass, friction, tries) for friction in (0.1, 0.3, 0.5, 1.0)]
        print(f"{mass} kg | " + " | ".join(f"{share:.2f}" for share in shares), flush=True)


if __name__ == "__main__":
    main()
