"""Linear Relation Network: the paper's object encoder (section 3.2, equation 1, figure 2 box C).

    z = LayerNorm(f_phi(sum_{i=1..K} g_theta(o_i, o_goal)))

One relation r_i = g_theta(o_i, o_goal) is computed per object, always with the goal, so the cost is
linear in K. The sum does not depend on the order of the objects, and any K will do.

Shapes: objects (B, K, D), goal (B, D) -> z (B, Z).
        B batch, K objects, D token width (the paper's d), Z width of z (its d_z).
Run:    python lrn.py        trains at K = 3, tests at K = 1 to 10, without a robot: 20 seconds
"""
import math

import torch
from torch import nn


def orthogonal(layer, gain=math.sqrt(2)):
    """Orthogonal weights, zero bias (ours: with PyTorch's default all z start out nearly alike)."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class LRN(nn.Module):
    """Encoder of equation 1. Nothing in it depends on K: one set of weights serves any number."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__()
        D, Z = token_dim, z_dim
        self.g = nn.Sequential(
            orthogonal(nn.Linear(2 * D, D)), nn.ReLU(),
            orthogonal(nn.Linear(D, D)), nn.ReLU(),
            orthogonal(nn.Linear(D, D)), nn.ReLU(),
            orthogonal(nn.Linear(D, D)),
        )
        self.f = orthogonal(nn.Linear(D, Z))
        self.norm = nn.LayerNorm(Z)

    def relations(self, objects, goal):
        """All r_i = g_theta(o_i, o_goal): objects (B, K, D), goal (B, D) -> (B, K, D)."""
        goals = goal[:, None].expand(-1, objects.shape[1], -1)             # (B, K, D), all the same
        return self.g(torch.cat([objects, goals], dim=2))      # (B, K, 2D) -> (B, K, D)

    def forward(self, objects, goal):
        """Equation 1: objects (B, K, D), goal (B, D) -> z (B, Z)."""
        r = self.relations(objects, goal)                      # (B, K, D), g_theta(o_i, o_goal)
        return self.norm(self.f(r.sum(dim=1)))                 # (B, Z), LayerNorm(f_phi(sum_i r_i))


# ---- variants: figure 5's ablations and two of ours

class LRNMean(LRN):
    """z = f_phi(mean_i r_i): a mean in place of sum and LayerNorm (figure 5, orange)."""

    def forward(self, objects, goal):
        return self.f(self.relations(objects, goal).mean(dim=1))           # (B, Z)


class LRNObjects(LRN):
    """No relations: r_i = g_theta(o_i) (figure 5, purple). As printed: z never sees the goal."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__(token_dim, z_dim)
        self.g[0] = orthogonal(nn.Linear(token_dim, token_dim))

    def relations(self, objects, goal):
        return self.g(objects)                                 # (B, K, D)


class LRNTokens(LRNObjects):
    """Not the paper's: no relations, but g_theta(o_goal) joins the sum, so that z sees the goal."""

    def relations(self, objects, goal):
        return self.g(torch.cat([objects, goal[:, None]], dim=1))          # (B, K+1, D)


class LRNMax(LRN):
    """Not the paper's: the largest r_i in each dimension in place of their sum.

    Ten distractors whose relations are equal then change z exactly as one of them would.
    """

    def forward(self, objects, goal):
        r = self.relations(objects, goal)                      # (B, K, D)
        return self.norm(self.f(r.amax(dim=1)))                # (B, Z)


# ---- the paper's question without a robot

def scene(B, K, crowd=None):
    """Objects (B, K, 3): x, y, name. Goal (B, 3): 0, 0, object 0's name. Object 0's place (B, 2).

    crowd=M: object 0 and M copies of others, drawn with replacement: (B, M+1, 3).
    """
    places = 2 * torch.rand(B, K, 2) - 1
    if crowd is not None:
        others = places[torch.arange(B)[:, None], torch.randint(1, K, (B, crowd))]
        places = torch.cat([places[:, :1], others], dim=1)     # (B, 1 + crowd, 2)
    shuffled = torch.rand(B, 21).argsort(dim=1)[:, :places.shape[1]]
    names = torch.linspace(-1, 1, 21)[shuffled]                # no two alike in a scene
    objects = torch.cat([places, names[..., None]], dim=2)
    goal = objects[:, 0] * torch.tensor([0.0, 0.0, 1.0])       # the name alone
    return objects, goal, places[:, 0]


def learn(loss, modules, updates):
    """Minimise loss(), which draws a fresh batch; Adam, with a linearly falling learning rate."""
    optimizer = torch.optim.Adam(nn.ModuleList(modules).parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, updates)
    for _ in range(updates):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
        schedule.step()


def demo(with_crowds, variant=LRN, updates=1000):
    """Learn at K = 3 where the named object is. {K: RMS error}; 1 is a blind guess."""
    torch.manual_seed(0)
    token, encoder, read = nn.Linear(3, 64), variant(), nn.Linear(25, 2)

    def loss(objects, goal, where):
        z = encoder(token(objects), token(goal))
        return (read(z) - where).square().mean() / (1 / 3)     # 1/3: variance of a coordinate

    def batch_loss():
        # M is uniform here; train.py draws it in two steps, so that RN learns to read soon.
        crowd = int(torch.randint(9, ())) if with_crowds and torch.rand(()) < 0.5 else None
        return loss(*scene(128, 3, crowd))

    learn(batch_loss, [token, encoder, read], updates)
    with torch.no_grad():
        return {K: loss(*scene(2000, K)).sqrt().item() for K in (1, 3, 5, 10)}


if __name__ == "__main__":
    torch.set_num_threads(1)             # as fast on networks this small
    print("RMS error (1: a blind guess) at K objects after training at K = 3")
    for name, with_crowds in (("equation 1 alone", False), ("with crowds", True)):
        errors = [f"K={K}: {error:.3f}" for K, error in demo(with_crowds).items()]
        print(f"{name:16s}", "   ".join(errors), flush=True)
