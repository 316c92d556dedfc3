"""What makes a sum transfer? Variants of LRN in the demonstration of lrn.py, without a robot.

    python results/cures.py                     four minutes of one core: a table, and cures.csv

Each variant learns at K = 3 where the named object is and is asked at K = 1, 3, 5 and 10. Numbers
are RMS errors; a blind guess has 1.
"""
import csv
import functools
import os
import sys

import torch
from torch import nn

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
import lrn


class ReLU(lrn.LRN):
    """A ReLU behind g's last layer, so that a relation of zero is easy to learn."""

    def relations(self, objects, goal):
        return super().relations(objects, goal).relu()


class Gate(lrn.LRN):
    """Every relation times a sigmoid of object and goal."""

    def __init__(self):
        super().__init__()
        self.gate = nn.Linear(128, 1)

    def relations(self, objects, goal):
        pairs = torch.cat([objects, goal[:, None].expand_as(objects)], dim=2)      # (B, K, 2D)
        return super().relations(objects, goal) * self.gate(pairs).sigmoid()


class NullObject(lrn.LRN):
    """Less the relation of an object that is all zeros."""

    def relations(self, objects, goal):
        null = super().relations(torch.zeros_like(objects[:, :1]), goal)           # (B, 1, D)
        return super().relations(objects, goal) - null


class NoBiases(lrn.LRN):
    """No bias in g and f."""

    def __init__(self):
        super().__init__()
        for layer in (*self.g[::2], self.f):
            layer.bias = None


class Mean(lrn.LRN):
    """A mean in place of the sum, with the LayerNorm."""

    def forward(self, objects, goal):
        return self.norm(self.f(self.relations(objects, goal).mean(dim=1)))


VARIANTS = {"equation 1 alone": lrn.LRN, "ReLU behind g": ReLU, "sigmoid gate": Gate,
            "less a null object": NullObject, "no biases": NoBiases, "weight decay": lrn.LRN,
            "mean": Mean, "maximum": lrn.LRNMax, "with crowds": lrn.LRN}


def main():
    torch.set_num_threads(1)
    adam = torch.optim.Adam
    with open(os.path.join(HERE, "cures.csv"), "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("variant", "K=1", "K=3", "K=5", "K=10"))
        for name, variant in VARIANTS.items():
            decay = functools.partial(torch.optim.AdamW, weight_decay=0.1)
            torch.optim.Adam = decay if name == "weight decay" else adam
            errors = lrn.demo(name == "with crowds", variant)
            table.writerow((name, *[f"{error:.3f}" for error in errors.values()]))
            print(f"{name:20s}", *[f"{error:6.3f}" for error in errors.values()], flush=True)


if __name__ == "__main__":
    main()
