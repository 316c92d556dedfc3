"""Frames a second against Stable-Baselines3 (needs `pip install stable-baselines3`).

    python results/against_sb3.py                        4 updates each, a minute
    python results/against_sb3.py --updates 1 --envs 8

Both train LRN at N = 2 with the same environments, encoder, heads, batch, epochs and minibatches:
SB3's PPO with two torch threads over SubprocVecEnv, this repository with one rank per core. The
read-out is off (auxiliary=0), as SB3 has none. The first update of each warms up and is not
counted.
"""
import argparse
import functools
import os
import subprocess
import sys
import tempfile
import time

import torch

PARENT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
sys.path.insert(0, PARENT)
from figures import read
from train import DEFAULTS, Agent, fail, make_env, positive

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    from stable_baselines3.common.vec_env import SubprocVecEnv
except ImportError:
    fail("this comparison needs Stable-Baselines3: pip install stable-baselines3")


class Encoder(BaseFeaturesExtractor):
    """Our token MLPs and LRN as SB3's features extractor: observation -> z."""

    def __init__(self, space):
        super().__init__(space, DEFAULTS["z_dim"])
        self.agent = Agent("lrn", 2, DEFAULTS)
        # SB3 makes heads of its own.
        del self.agent.policy, self.agent.value, self.agent.read_out, self.agent.log_std

    def forward(self, obs):
        return self.agent.encode(obs)


def speed_of_sb3(updates, envs):
    """Frames a second of Stable-Baselines3's PPO."""
    torch.set_num_threads(2)
    batch, hidden = envs * DEFAULTS["steps"], DEFAULTS["hidden"]
    world = functools.partial(make_env, "push", 2, DEFAULTS)   # a gymnasium.Env
    model = PPO(
        "MultiInputPolicy", SubprocVecEnv([world] * envs), device="cpu",
        n_steps=DEFAULTS["steps"], batch_size=batch // DEFAULTS["minibatches"],
        n_epochs=DEFAULTS["epochs"], learning_rate=DEFAULTS["lr"],
        policy_kwargs=dict(
            features_extractor_class=Encoder, net_arch=dict(pi=[hidden] * 2, vf=[hidden] * 2),
            activation_fn=torch.nn.ReLU, log_std_init=DEFAULTS["log_std"]))
    model.learn(batch)
    start = time.monotonic()
    model.learn(updates * batch)
    elapsed = time.monotonic() - start
    model.env.close()
    return updates * batch / elapsed


def speed_of_this(updates, envs):
    """Frames a second of train.py."""
    batch = envs * DEFAULTS["steps"]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, os.path.join(PARENT, "train.py"), "--encoder", "lrn",
                        "--frames", str((updates + 1) * batch), "--out", folder,
                        "--set", "auxiliary=0", f"envs={envs}"],
                       check=True, stdout=subprocess.DEVNULL)
        seconds = read(folder, "timing.csv")["seconds"]
    return updates * batch / (seconds[-1] - seconds[0])


def main():
    parser = argparse.ArgumentParser(description="Frames a second against Stable-Baselines3.")
    parser.error = fail
    parser.add_argument("--updates", type=positive, default=4, metavar="U")
    parser.add_argument("--envs", type=positive, default=DEFAULTS["envs"], metavar="E")
    args = parser.parse_args()
    if args.envs % DEFAULTS["minibatches"]:
        fail(f"--envs must be a multiple of {DEFAULTS['minibatches']}, the number of minibatches")
    sb3 = speed_of_sb3(args.updates, args.envs)
    ours = speed_of_this(args.updates, args.envs)
    print(f"Stable-Baselines3 {sb3:.0f} frames/s, this repository {ours:.0f}: "
          f"{ours / sb3:.1f} times as many")


if __name__ == "__main__":
    main()
