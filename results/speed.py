"""How fast is this, and beside what? Contestants take turns in one process, on one core.

    python results/speed.py                     all three sections, some minutes
    python results/speed.py env                 the environment by N
    python results/speed.py train               our PPO and Stable-Baselines3's (which it needs)
    python results/speed.py encoders            LRN, RN and ATTN by the number of objects
    python results/speed.py train --rounds 1    fewer rounds

Times are CPU times, which other work on the machine disturbs less than the wall clock's.
Every number is a median over rounds, and so is every ratio: of two times in the same round.
step/physics is a step in units of the stepSimulation inside it, reset/step a seeded reset in steps.
"""
import argparse
import os
import sys
from time import process_time

import numpy as np
import pybullet
import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
from attn import ATTN
from lrn import LRN
from ppo import PPO
from rn import RN
from train import DEFAULTS, LEARNER, Agent, fail, make_env, reseed
from trifinger_env import TriFingerEnv


def seconds(function, *arguments):
    """CPU seconds of a call."""
    begin = process_time()
    function(*arguments)
    return process_time() - begin


# ---- the environment

CONTROLS = ((5, 0.008), (3, 0.004))      # ours and the paper's: substeps, timestep in s
STEPS = 100                              # of a timed episode


def measure_env(rounds):
    """Frames/s of random actions; a step in units of its bare physics, a reset in steps."""
    bare, physics = pybullet.stepSimulation, []
    pybullet.stepSimulation = lambda client: physics.append(seconds(bare, client))
    rng = np.random.default_rng(0)
    envs = {(control, N): TriFingerEnv("push", N, substeps=control[0], timestep=control[1])
            for control in CONTROLS for N in (0, 2, 5, 9)}
    found = {key: [] for key in envs}
    for seed in range(rounds):
        for key, env in envs.items():
            reset = seconds(lambda: env.reset(seed=seed))
            physics.clear()
            step = sum(seconds(env.step, action) for action in rng.uniform(-1, 1, (STEPS, 9)))
            found[key].append((STEPS / step, step / sum(physics), reset / step * STEPS))
    pybullet.stepSimulation = bare
    print("The environment\n   N  control   frames/s  step/physics  reset/step")
    for ((substeps, timestep), N), rows in found.items():
        rate, step, reset = np.median(rows, axis=0)
        print(f"{N:4d}  {substeps} x {1000 * timestep:.0f} ms {rate:9.0f} {step:13.2f} "
              f"{reset:11.1f}")


# ---- training

LOSSES = {                               # our contestants -> what differs from the defaults
    "ours, no read-out": {"auxiliary": 0.0},                   # does what SB3 does
    "ours, no crowds": {"crowd": 0},
    "ours": {},
}


def our_update(envs, changes):
    """A function that does one update of LRN at N = 2: plays a batch, learns from it."""
    settings = {**DEFAULTS, **changes}
    learner = PPO(Agent("lrn", 2, settings), envs, **{name: settings[name] for name in LEARNER})

    def update():
        learner.rollout(reseed(learner, seed=0, update=0, rank=0))
        learner.update(remaining=1.0)

    return update


def sb3_update(count):
    """The same by Stable-Baselines3's PPO, with the same net and batch."""
    from stable_baselines3 import PPO as SB3
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Encoder(BaseFeaturesExtractor):
        """Our token MLPs and LRN: observation -> z. SB3 makes heads of its own."""

        def __init__(self, space):
            super().__init__(space, DEFAULTS["z_dim"])
            self.agent = Agent("lrn", 2, DEFAULTS)
            del self.agent.policy, self.agent.value, self.agent.read_out, self.agent.log_std

        def forward(self, obs):
            return self.agent.encode(obs)

    batch, heads = count * DEFAULTS["steps"], [DEFAULTS["hidden"]] * 2
    model = SB3(
        "MultiInputPolicy", DummyVecEnv([lambda: make_env("push", 2, DEFAULTS)] * count),
        device="cpu", n_steps=DEFAULTS["steps"], n_epochs=DEFAULTS["epochs"],
        batch_size=batch // DEFAULTS["minibatches"], learning_rate=DEFAULTS["lr"],
        policy_kwargs=dict(
            features_extractor_class=Encoder, net_arch=dict(pi=heads, vf=heads),
            activation_fn=torch.nn.ReLU, log_std_init=DEFAULTS["log_std"]))
    return lambda: model.learn(batch, reset_num_timesteps=False)


def measure_train(rounds, count=DEFAULTS["envs"]):
    """Training frames/s, beside those of SB3."""
    try:
        contestants = {"SB3": sb3_update(count)}
    except ImportError:
        fail("the comparison needs Stable-Baselines3: pip install stable-baselines3")
    envs = [make_env("push", 2, DEFAULTS) for _ in range(count)]           # ours take turns in them
    for name, changes in LOSSES.items():
        contestants[name] = our_update(envs, changes)
    found = [[seconds(update) for update in contestants.values()] for _ in range(rounds + 1)]
    times = np.array(found[1:])          # the first round warms up
    print("Training LRN at N = 2\n                      frames/s  times SB3's")
    rates = np.median(count * DEFAULTS["steps"] / times, axis=0)
    ratios = np.median(times[:, :1] / times, axis=0)
    for name, rate, ratio in zip(contestants, rates, ratios):
        print(f"{name:20s} {rate:9.0f} {ratio:12.2f}")


# ---- encoders

NUMBERS = (12, 24, 48, 96, 192)          # K, objects
SAMPLES, WIDTH = 64, 64
ENCODERS = {"LRN": (LRN, NUMBERS), "ATTN": (ATTN, NUMBERS), "RN": (RN, NUMBERS[:3])}


def measure_encoders(rounds):
    """Milliseconds of a forward and backward pass by K."""
    found = {}
    for _ in range(rounds + 1):
        for K in NUMBERS:
            objects = torch.randn(SAMPLES, K, WIDTH, requires_grad=True)
            goal = torch.randn(SAMPLES, WIDTH)
            for name, (encoder, numbers) in ENCODERS.items():
                if K in numbers:
                    net = encoder()
                    spent = seconds(lambda: net(objects, goal).sum().backward())
                    found.setdefault((name, K), []).append(1000 * spent)
    print(f"Encoders: ms of a forward and backward pass on {SAMPLES} samples (times LRN's)")
    for name, (_, numbers) in ENCODERS.items():
        # The first round warms up.
        times = [np.median(found[name, K][1:]) for K in numbers]
        ratios = [np.median(np.divide(found[name, K][1:], found["LRN", K][1:])) for K in numbers]
        slope, _ = np.polyfit(np.log(numbers), np.log(times), 1)
        cells = [f"K={K} {ms:.2f} ({ratio:.1f})" for K, ms, ratio in zip(numbers, times, ratios)]
        print(f"{name:5s}", *cells, f"grows as K^{slope:.2f}", sep="  ")


# ---- the command line

SECTIONS = {"env": (measure_env, 21), "train": (measure_train, 5),         # with rounds
            "encoders": (measure_encoders, 25)}


def main():
    parser = argparse.ArgumentParser(description="Speed (see the first lines of speed.py).")
    parser.error = fail
    parser.add_argument("sections", nargs="*", help=f"of {', '.join(SECTIONS)} (default: all)")
    parser.add_argument("--rounds", type=int, metavar="R", help="default 21, 5 and 25")
    args = parser.parse_args()
    if not set(args.sections) <= set(SECTIONS):
        fail(f"the sections are {', '.join(SECTIONS)}")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    for name in args.sections or SECTIONS:
        measure, rounds = SECTIONS[name]
        measure(args.rounds or rounds)


if __name__ == "__main__":
    main()
