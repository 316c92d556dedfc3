"""Where does the time of training go?

    python results/profile_training.py                   10 updates of LRN at N = 2, half a minute
    python results/profile_training.py --updates 1

Plays and learns as one rank of a default run does (16 of its 32 environments), with a clock around
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
from train import DEFAULTS, PPO_SETTINGS, Agent, make_env
from trifinger_env import TriFingerEnv

ENVS = 16
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


def train(updates):
    """Seconds of `updates` updates by function, in `spent`; one more update before warms up."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    envs = [make_env("push", 2, DEFAULTS) for _ in range(ENVS)]
    options = {name: DEFAULTS[name] for name in PPO_SETTINGS}
    learner = PPO(Agent("lrn", 2, DEFAULTS), envs, **options)
    for update in range(updates + 1):
        if update == 1:
            spent.update(dict.fromkeys(spent, 0.0))
        learner.rollout(range(ENVS * update, ENVS * (update + 1)))
        learner.update(left=1.0)
    for env in envs:
        env.close()


def main():
    parser = argparse.ArgumentParser(description="Where the time of training goes.")
    parser.add_argument("--updates", type=int, default=10, metavar="U")
    args = parser.parse_args()
    put_clock_on(pybullet, "stepSimulation")
    put_clock_on(TriFingerEnv, "step")
    put_clock_on(TriFingerEnv, "reset")
    put_clock_on(PPO, "rollout")
    put_clock_on(PPO, "update")
    train(args.updates)
    total = spent["rollout"] + spent["update"]
    parts = {
        "bare physics": spent["stepSimulation"],
        "rest of env.step": spent["step"] - spent["stepSimulation"],
        "fresh worlds": spent["reset"],
        "policy and bookkeeping": spent["rollout"] - spent["step"] - spent["reset"],
        "update": spent["update"],
    }
    frames = args.updates * ENVS * DEFAULTS["steps"]
    print(f"{1000 * total / frames:.2f} ms a frame, of which")
    for name, seconds in parts.items():
        print(f"{100 * seconds / total:5.0f} %  {name}")


if __name__ == "__main__":
    main()
