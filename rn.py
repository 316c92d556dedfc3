"""Relation Network over all pairs: the paper's quadratic comparison (appendix A.5, figure 2 box B).

    z = LayerNorm(f_phi(sum_{i=1..K+1} sum_{j=1..K+1} g_theta(o_i, o_j)))      equation 5

The goal joins the K objects as token K+1. Pairs are ordered and include a token with itself, so
there are (K+1)^2 relations (A.5, 4.2; section 3.2 says K^2).

Shapes: objects (B, K, D), goal (B, D) -> z (B, Z).
        B batch, K objects, D token width (the paper's d), Z width of z (its d_z).
Run:    python rn.py
"""
import math

import torch
from torch import nn
from torch.nn.functional import linear


def orthogonal(layer, gain=math.sqrt(2)):
    """Orthogonal weights, zero bias (ours: with PyTorch's default all z start out nearly alike)."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class RN(nn.Module):
    """Encoder of appendix A.5; nothing in it depends on K. `token_dim` is D, `z_dim` is Z."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__()
        D, Z = token_dim, z_dim
        # g_theta has four layers; the first stands apart, so that relations() can split it.
        self.first = orthogonal(nn.Linear(2 * D, D))
        self.g = nn.Sequential(
            nn.ReLU(), orthogonal(nn.Linear(D, D)),
            nn.ReLU(), orthogonal(nn.Linear(D, D)),
            nn.ReLU(), orthogonal(nn.Linear(D, D)),
        )
        self.f = orthogonal(nn.Linear(D, Z))
        self.norm = nn.LayerNorm(Z)

    def relations(self, objects, goal):
        """All r_ij = g_theta(o_i, o_j), the goal as last token: -> (B, K+1, K+1, D)."""
        tokens = torch.cat([objects, goal[:, None]], dim=1)    # (B, K+1, D)
        # The first layer on a pair is W [o_i; o_j] + b = W_1 o_i + (W_2 o_j + b).
        # Each half is computed once per token instead of once per pair.
        W_1, W_2 = self.first.weight.chunk(2, dim=1)           # (D, D) each
        from_i = linear(tokens, W_1)[:, :, None]               # (B, K+1, 1, D)
        from_j = linear(tokens, W_2, self.first.bias)[:, None]             # (B, 1, K+1, D)
        return self.g(from_i + from_j)                         # (B, K+1, K+1, D)

    def forward(self, objects, goal):
        """Equation 5: objects (B, K, D), goal (B, D) -> z (B, Z)."""
        r = self.relations(objects, goal)                      # (B, K+1, K+1, D)
        return self.norm(self.f(r.sum(dim=(1, 2))))            # (B, Z), sum_i sum_j r_ij


if __name__ == "__main__":
    for K in (4, 6, 12):
        count = RN().relations(torch.randn(1, K, 64), torch.randn(1, 64)).shape[1:3].numel()
        print(f"K={K:2d} objects: {count:3d} relations")
