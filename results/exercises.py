"""Answers to two of README's exercises: more relations, and recurrence.

    python results/exercises.py                 three minutes of one core: a table, exercises.csv

The question: how many other objects lie within 0.7 of the named one, among K = 5? A relation
g(o_i, o_goal) sees one object at a time; how they lie to each other is left to the MLP that reads
z, as in the agent. Numbers are RMS errors; a blind guess has 1.
"""
import os
import sys

import torch
from torch import nn

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
import lrn
from rn import RN

K, UPDATES = 5, 2000


class Triples(lrn.LRN):
    """Relations g(o_i, o_j, o_goal) of all ordered pairs. Quadratic in K."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__(token_dim, z_dim)
        self.g[0] = lrn.orthogonal(nn.Linear(3 * token_dim, token_dim))

    def relations(self, objects, goal):
        count = objects.shape[1]                               # K
        first = objects[:, :, None].expand(-1, -1, count, -1)              # (B, K, K, D)
        second = objects[:, None].expand(-1, count, -1, -1)
        goals = goal[:, None, None].expand_as(first)
        return self.g(torch.cat([first, second, goals], dim=3)).flatten(1, 2)      # (B, K^2, D)


class TwoRounds(lrn.LRN):
    """The first round's z goes into the goal token of a second one. Linear in K."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__(token_dim, z_dim)
        self.back = lrn.orthogonal(nn.Linear(z_dim, token_dim))

    def forward(self, objects, goal):
        z = super().forward(objects, goal)                     # (B, Z): where the named one is
        return super().forward(objects, goal + self.back(z))   # so g can compare each with it


def scene(B):
    """Objects (B, K, 3), goal (B, 3), and how many are near the named one (B, 1)."""
    objects, goal, where = lrn.scene(B, K)
    near = (objects[..., :2] - where[:, None]).norm(dim=2) < 0.7           # itself, too
    return objects, goal, near.sum(dim=1, keepdim=True) - 1.0


def error_of(encoder):
    """Learn the question; RMS error on fresh scenes, in units of the answers' deviation."""
    token = nn.Linear(3, 64)
    read = nn.Sequential(nn.Linear(25, 128), nn.ReLU(), nn.Linear(128, 1))
    deviation = scene(20_000)[2].std()

    def loss(objects, goal, near):
        return ((read(encoder(token(objects), token(goal))) - near) / deviation).square().mean()

    lrn.learn(lambda: loss(*scene(128)), [token, encoder, read], UPDATES)
    with torch.no_grad():
        return loss(*scene(4000)).sqrt().item()


if __name__ == "__main__":
    torch.set_num_threads(1)
    with open(os.path.join(HERE, "exercises.csv"), "w") as file:
        print("encoder,error", file=file)
        for encoder in (lrn.LRN, RN, Triples, TwoRounds):
            torch.manual_seed(0)
            error = error_of(encoder())
            print(f"{encoder.__name__:10s} {error:.2f}", flush=True)
            print(f"{encoder.__name__},{error:.3f}", file=file)
