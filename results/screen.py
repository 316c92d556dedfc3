"""Which linear encoder tells the target cube from others at numbers that it has not seen?

    python results/screen.py                    both training N, two seeds each: 45 minutes
    python results/screen.py --steps 200 --out glance.csv

Supervised, so that many encoders cost little: an agent of train.py learns its read-out loss alone
(Agent.auxiliary) on states of random play at N = 2 or 9. Then the mean distance from the target
cube to where the agent reads it is measured at several N, in states that it was not trained on.
That says which encoder learns quickly to find a target in a crowd, not which one learns to act.

Each pools the relations r (B, K, D) of lrn.py in its own way:
    sum       sum_i r_i, the paper's
    max       the largest r_i in each dimension
    gated     sum_i sigmoid(r_i0) r_i, the first number of r_i being its own gate
    softmax   sum_i w_i r_i, w = softmax(log K * q . r_i / sqrt(D)), q = W_q o_goal + b_q;
              log K keeps w from growing flat in a crowd
    alone     no relations: sum_i g(o_i) over the objects and the goal, figure 5's ablation with the
              goal let in (as printed, z knows nothing of it)
All K objects are real here, so the new ones need not look at `present`.
"""
import argparse
import csv
import math
import os
import sys

import torch
from torch import nn

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from evaluate import as_batch, read_errors
from lrn import LRN, LRNMax, orthogonal
from train import DEFAULTS, Agent, fail, make_env, positive

HERE = os.path.dirname(os.path.abspath(__file__))
TRAINED = (2, 9)                         # N
NUMBERS = (0, 2, 5, 9, 14, 19)           # N of the measurement
SEEDS = (0, 1)
BATCH = 500                              # as a minibatch of train.py
LR = 1e-3
OTHERS = 10_000                          # added to the seeds of states that nothing learns from
COLUMNS = ("encoder", "trained", "seed", *NUMBERS)


class LRNGated(LRN):
    """Each relation opens or shuts its own gate."""

    def pool(self, r, present):
        """sum_i sigmoid(r_i0) r_i: (B, K, D) -> (B, D)."""
        return (r[..., :1].sigmoid() * r).sum(dim=1)


class LRNSoftmax(LRN):
    """The goal asks which relations matter; the encoder takes their weighted mean."""

    def __init__(self):
        super().__init__()
        self.query = orthogonal(nn.Linear(self.token_dim, self.token_dim), gain=1.0)

    def forward(self, objects, goal, present=None):
        """objects (B, K, D), goal (B, D) -> z (B, Z)."""
        r = self.relations(objects, goal)                      # (B, K, D)
        _, K, D = r.shape
        scores = r @ self.query(goal)[:, :, None] / math.sqrt(D)           # (B, K, 1)
        w = (math.log(K) * scores).softmax(dim=1)
        return self.norm(self.f((w * r).sum(dim=1)))           # (B, Z)


class LRNAlone(LRN):
    """No relations: every object, and the goal as one more, is looked at alone."""

    def __init__(self):
        super().__init__(relations=False)

    def forward(self, objects, goal, present=None):
        """objects (B, K, D), goal (B, D) -> z (B, Z)."""
        tokens = torch.cat([objects, goal[:, None]], dim=1)    # (B, K+1, D)
        return super().forward(tokens, goal)


ENCODERS = {"sum": LRN, "max": LRNMax, "gated": LRNGated, "softmax": LRNSoftmax, "alone": LRNAlone}


def states(distractors, episodes, first_seed):
    """Observations of episodes of random play."""
    env = make_env("push", distractors, DEFAULTS)
    observations = []
    for seed in range(first_seed, first_seed + episodes):
        noise = torch.Generator().manual_seed(seed)
        observations.append(env.reset(seed=seed)[0])
        truncated = False                # the only end that this world has
        while not truncated:
            action = 0.5 * torch.randn(9, generator=noise)     # deviation of training at its start
            observation, _, _, truncated, _ = env.step(action.numpy())
            observations.append(observation)
    env.close()
    return observations


def trained_agent(encoder, distractors, obs, steps, seed):
    """An agent that has learned to read facts from z, nothing else."""
    torch.manual_seed(seed)
    agent = Agent("lrn", distractors, DEFAULTS)
    agent.encoder = ENCODERS[encoder]()
    optimizer = torch.optim.Adam(agent.parameters(), lr=LR)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps)
    count = len(obs["goal"])
    for _ in range(steps):
        rows = torch.randint(count, (BATCH,))
        loss = agent.auxiliary({key: value[rows] for key, value in obs.items()})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return agent


@torch.no_grad()
def millimetres(agent, observations):
    """Mean distance from the target cube to where the agent reads it."""
    z = agent.encode(as_batch(observations))
    return 1000 * read_errors(agent, observations, z).mean().item()


def main():
    parser = argparse.ArgumentParser(
        description="Compare ways to pool relations (see the first lines of screen.py).")
    parser.error = fail
    parser.add_argument("--steps", type=positive, default=3000, metavar="S", help="default 3000")
    parser.add_argument("--episodes", type=positive, default=200, metavar="E",
                        help="of random play to learn from; a fifth to measure (default 200)")
    parser.add_argument("--out", default=os.path.join(HERE, "screen.csv"), metavar="FILE",
                        help="default results/screen.csv")
    args = parser.parse_args()
    if not os.path.isdir(os.path.dirname(args.out) or "."):
        fail(f"--out {args.out}: there is no such folder")
    torch.set_num_threads(1)
    tests = {n: states(n, max(1, args.episodes // 5), OTHERS) for n in NUMBERS}
    print("| read error (mm) | trained at | seed | " + " | ".join(map(str, NUMBERS)) + " |")
    print("|---" * (3 + len(NUMBERS)) + "|")
    with open(args.out, "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for trained in TRAINED:
            obs = as_batch(states(trained, args.episodes, first_seed=0))
            for encoder in ENCODERS:
                for seed in SEEDS:
                    agent = trained_agent(encoder, trained, obs, args.steps, seed)
                    errors = [f"{millimetres(agent, tests[n]):.1f}" for n in NUMBERS]
                    table.writerow([encoder, trained, seed, *errors])
                    print("| " + " | ".join([encoder, str(trained), str(seed), *errors]) + " |",
                          flush=True)


if __name__ == "__main__":
    main()
