"""Relation Network over all pairs: the paper's quadratic comparison (appendix A.5, figure 2 box B).

    z = LayerNorm(f_phi(sum_{i=1..K+1} sum_{j=1..K+1} g_theta(o_i, o_j)))

The goal joins the K objects as token K+1; pairs are ordered and include a token with itself: (K+1)^2 relations.

Shapes: objects (B, K, D), goal (B, D), present (B, K) bool -> z (B, Z). B batch, K objects, D token width, Z width of z.
Run:    python rn.py
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


class RN(nn.Module):
    """Encoder of appendix A.5; nothing in it depends on K. `token_dim` is D, `z_dim` is Z."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__()
        D = token_dim
        self.first = orthogonal(nn.Linear(2 * D, D))           # first of the four layers of g_theta
        self.g = nn.Sequential(nn.ReLU(), orthogonal(nn.Linear(D, D)), nn.ReLU(), orthogonal(nn.Linear(D, D)), nn.ReLU(),
                               orthogonal(nn.Linear(D, D)))
        self.f = orthogonal(nn.Linear(D, z_dim))
        self.norm = nn.LayerNorm(z_dim)

    def relations(self, objects, goal):
        """All r_ij = g_theta(o_i, o_j) with the goal as the last token: -> (B, K+1, K+1, D)."""
        tokens = torch.cat([objects, goal[:, None]], 1)        # (B, K+1, D)
        # On a pair the first layer is W [o_i; o_j] + b = W_1 o_i + (W_2 o_j + b): each half is computed once per token.
        W_1, W_2 = self.first.weight.split(tokens.shape[-1], 1)
        return self.g(linear(tokens, W_1)[:, :, None] + linear(tokens, W_2, self.first.bias)[:, None])

    def forward(self, objects, goal, present=None):
        """z (B, Z) of objects (B, K, D) and goal (B, D). `present` (B, K) bool: False marks padding, ignored exactly."""
        r = self.relations(objects, goal)                      # (B, K+1, K+1, D)
        if present is not None:
            real = torch.cat([present, present.new_ones(len(present), 1)], 1)                  # (B, K+1), the goal is real
            r = r.masked_fill(~(real[:, :, None] & real[:, None])[..., None], 0.0)
        return self.norm(self.f(r.sum((1, 2))))                # (B, Z)


if __name__ == "__main__":
    torch.manual_seed(0)
    encoder = RN()
    for K in (4, 6, 12):
        objects, goal, order = torch.randn(2, K, 64), torch.randn(2, 64), torch.randperm(K)
        z = encoder(objects, goal)
        gap = (z - encoder(objects[:, order], goal)).abs().max()
        print(f"K={K:2d} objects: {encoder.relations(objects, goal)[0, ..., 0].numel():3d} relations, z {tuple(z.shape)}, "
              f"largest change when the objects are permuted: {gap:.1e}")
