"""Where does the time of training go?

    python results/profile_training.py                   10 updates of LRN at N = 2, half a minute
    python results/profile_training.py --paper --updates 1      with --paper's settings, minutes

Plays and learns as one of two ranks does (with half of a run's environments), with a clock around
the physics, env.step, env.reset, rollout() and update(). CPU time, so that what runs beside it
counts little.
"""
import argparse
import os
import sys
import time

import pybullet
import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from ppo import PPO
from train import fail, make_learner, positive, read_command, read_settings
from trifinger_env import TriFingerEnv

spent = {}                               # name of a function -> seconds spent in it


def put_clock_on(owner, name):
    """Replace owner.name by itself with a clock around it."""
    plain = getattr(owner, name)

    def timed(*args, **options):
        start = time.process_time()
        try:
            return plain(*args, **options)
        finally:
            spent[name] += time.process_time() - start

    spent[name] = 0.0
    setattr(owner, name, timed)


def train(updates, learner):
    """Play and learn `updates` times, after once more to warm up. Returns the frames of those.

    `spent` then holds the seconds by function.
    """
    E = len(learner.envs)
    for update in range(updates + 1):
        if update == 1:
            spent.update(dict.fromkeys(spent, 0.0))
        learner.rollout(range(E * update, E * (update + 1)))
        learner.update(remaining=1.0)
    for env in learner.envs:
        env.close()
    return updates * E * learner.steps


def main():
    parser = argparse.ArgumentParser(description="Where the time of training goes.")
    parser.error = fail
    parser.add_argument("--updates", type=positive, default=10, metavar="U")
    parser.add_argument("--paper", action="store_true", help="the paper's settings")
    args = parser.parse_args()
    command = read_command(["--ranks", "2"] + ["--paper"] * args.paper)
    settings = read_settings(command)
    torch.set_num_threads(1)
    put_clock_on(pybullet, "stepSimulation")
    put_clock_on(TriFingerEnv, "step")
    put_clock_on(TriFingerEnv, "reset")
    put_clock_on(PPO, "rollout")
    put_clock_on(PPO, "update")
    frames = train(args.updates, make_learner(command, settings))
    total = spent["rollout"] + spent["update"]
    parts = {
        "bare physics": spent["stepSimulation"],
        "rest of env.step": spent["step"] - spent["stepSimulation"],
        "fresh worlds": spent["reset"],
        "policy and bookkeeping": spent["rollout"] - spent["step"] - spent["reset"],
        "update": spent["update"],
    }
    print(f"{1000 * total / frames:.2f} ms a frame, of which")
    for name, seconds in parts.items():
        print(f"{100 * seconds / total:5.0f} %  {name}")


if __name__ == "__main__":
    main()
