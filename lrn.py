"""Linear Relation Network: the paper's object encoder (section 3.2, figure 2 box C).

    z = LayerNorm(f_phi(sum_{i=1..K} g_theta(o_i, o_g)))

One relation r_i = g_theta(o_i, o_g) per object with the goal, so the cost is linear in K; the sum makes z independent of
the objects' order, and the normalisation keeps z in distribution when K changes. Ours, not the paper's: aggregate="max" takes
the largest r_i in each dimension in place of the sum; relations that are alike then count once, however many there are.

Shapes: objects (B, K, D), goal (B, D), present (B, K) bool -> z (B, Z). B batch, K objects, D token width, Z width of z.
Run:    python lrn.py
"""
import math

import torch
from torch import nn
from torch.nn.functional import linear


def orthogonal(layer, gain=math.sqrt(2)):
    """Orthogonal weights, zero bias. PyTorch's default shrinks the signal layer by layer, and z starts out constant."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class LRN(nn.Module):
    """Encoder of equation 1; nothing in it depends on K, so one set of weights serves any number of objects.

    token_dim, z_dim   D and Z (the paper: Z = 25)
    relations          False: the ablation without relations, g_theta(o_i) alone (figure 5, purple)
    layer_norm         False: the ablation z = f_phi(mean_i r_i) (figure 5, orange)
    aggregate          "sum" (the paper) or "max" (ours; needs a real object in every row). ValueError for anything else.
    """

    def __init__(self, token_dim=64, z_dim=25, relations=True, layer_norm=True, aggregate="sum"):
        super().__init__()
        if aggregate not in ("sum", "max") or aggregate == "max" and not layer_norm:
            raise ValueError(f"aggregate must be 'sum' or, with layer_norm, 'max', got {aggregate!r}")
        self.aggregate = aggregate
        D = token_dim
        self.first = orthogonal(nn.Linear(2 * D if relations else D, D))       # first of the four layers of g_theta
        self.g = nn.Sequential(nn.ReLU(), orthogonal(nn.Linear(D, D)), nn.ReLU(), orthogonal(nn.Linear(D, D)), nn.ReLU(),
                               orthogonal(nn.Linear(D, D)))
        self.f = orthogonal(nn.Linear(D, z_dim))
        self.norm = nn.LayerNorm(z_dim) if layer_norm else None

    def relations(self, objects, goal):
        """All r_i = g_theta(o_i, o_g): objects (B, K, D), goal (B, D) -> (B, K, D)."""
        D = objects.shape[-1]
        if self.first.in_features == D:                        # ablation: g_theta(o_i)
            return self.g(self.first(objects))
        # On a pair the first layer is W [o_i; o_g] + b = W_o o_i + (W_g o_g + b): the second half is computed once, not K times.
        W_o, W_g = self.first.weight.split(D, 1)
        return self.g(linear(objects, W_o) + linear(goal, W_g, self.first.bias)[:, None])     # (B, K, D) + (B, 1, D)

    def forward(self, objects, goal, present=None):
        """z (B, Z) of objects (B, K, D) and goal (B, D). `present` (B, K) bool: False marks padding, ignored exactly."""
        r = self.relations(objects, goal)                      # (B, K, D)
        if present is not None:
            r = r.masked_fill(~present[..., None], 0.0 if self.aggregate == "sum" else -math.inf)
        total = r.sum(1) if self.aggregate == "sum" else r.amax(1)     # (B, D)
        if self.norm is not None:
            return self.norm(self.f(total))                    # (B, Z)
        count = objects.shape[1] if present is None else present.sum(1, keepdim=True).clamp(min=1)
        return self.f(total / count)                           # (B, Z)


if __name__ == "__main__":
    torch.manual_seed(0)
    encoder = LRN()
    for K in (4, 6, 12):
        objects, goal, order = torch.randn(2, K, 64), torch.randn(2, 64), torch.randperm(K)
        z = encoder(objects, goal)
        gap = (z - encoder(objects[:, order], goal)).abs().max()
        print(f"K={K:2d} objects: {encoder.relations(objects, goal).shape[1]:3d} relations, z {tuple(z.shape)}, "
              f"largest change when the objects are permuted: {gap:.1e}")
