"""Relation Network over all pairs: the paper's quadratic comparison (appendix A.5, figure 2 box B).

    z = LayerNorm(f_phi(sum_{i=1..K+1} sum_{j=1..K+1} g_theta(o_i, o_j)))

The goal joins the K objects as token K+1. Pairs are ordered and include a token with itself, so
there are (K+1)^2 relations.

Shapes: objects (B, K, D), goal (B, D), present (B, K) bool -> z (B, Z).
        B batch, K objects, D token width (the paper's d), Z width of z (its d_z).
Run:    python rn.py
"""
import math

import torch
from torch import nn
from torch.nn.functional import linear, pad


def orthogonal(layer, gain=math.sqrt(2)):
    """Set orthogonal weights and a zero bias; returns the layer.

    PyTorch's default shrinks the signal layer by layer, and z would start out nearly the same for
    every input. (Copied in lrn.py, rn.py and attn.py: each file stands alone.)
    """
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def check_shapes(D, objects, goal, present=None):
    """ValueError unless objects is (B, K, D), goal (B, D) and present, if given, (B, K) bool."""
    if objects.ndim != 3 or objects.shape[2] != D:
        raise ValueError(f"objects must be (B, K, D={D}), got {tuple(objects.shape)}")
    B, K, _ = objects.shape
    if goal.shape != (B, D):
        raise ValueError(f"goal must be (B, D) = {(B, D)}, got {tuple(goal.shape)}")
    if present is not None and (present.shape != (B, K) or present.dtype != torch.bool):
        got = f"{tuple(present.shape)} {present.dtype}"
        raise ValueError(f"present must be (B, K) = {(B, K)} of torch.bool, got {got}")


class RN(nn.Module):
    """Encoder of appendix A.5; nothing in it depends on K. `token_dim` is D, `z_dim` is Z."""

    def __init__(self, token_dim=64, z_dim=25):
        super().__init__()
        D, Z = token_dim, z_dim
        self.token_dim = D
        # g_theta has four layers: self.first, which stands apart (see relations()), and self.g.
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
        check_shapes(self.token_dim, objects, goal)
        tokens = torch.cat([objects, goal[:, None]], dim=1)    # (B, K+1, D)

        # The first layer on a pair is W [o_i; o_j] + b = W_1 o_i + (W_2 o_j + b).
        # Each half is computed once per token instead of once per pair.
        W_1, W_2 = self.first.weight.split(self.token_dim, dim=1)          # (D, D) each
        from_i = linear(tokens, W_1)[:, :, None]                           # (B, K+1, 1, D)
        from_j = linear(tokens, W_2, self.first.bias)[:, None]             # (B, 1, K+1, D)
        return self.g(from_i + from_j)                                     # (B, K+1, K+1, D)

    def forward(self, objects, goal, present=None):
        """Equation of A.5: objects (B, K, D), goal (B, D) -> z (B, Z).

        `present` (B, K) bool is for batches that mix numbers of objects (training has one K a
        batch): False marks padding, and z is as if it were not there. ValueError for other shapes.
        """
        check_shapes(self.token_dim, objects, goal, present)
        if present is not None:                                # NaN there would spoil gradients
            objects = objects.masked_fill(~present[..., None], 0.0)
        r = self.relations(objects, goal)                      # (B, K+1, K+1, D)
        if present is not None:
            real = pad(present, (0, 1), value=True)            # (B, K+1), the goal is real
            both_real = real[:, :, None] & real[:, None]       # (B, K+1, K+1)
            r = r.masked_fill(~both_real[..., None], 0.0)
        total = r.sum(dim=(1, 2))                              # (B, D), sum_i sum_j r_ij
        return self.norm(self.f(total))                        # (B, Z), LayerNorm(f_phi(.))


if __name__ == "__main__":
    torch.manual_seed(0)
    encoder = RN()
    for K in (4, 6, 12):
        objects, goal = torch.randn(2, K, 64), torch.randn(2, 64)
        z = encoder(objects, goal)
        shuffled = encoder(objects[:, torch.randperm(K)], goal)
        rows, columns = encoder.relations(objects, goal).shape[1:3]
        change = (z - shuffled).abs().max()
        print(f"K={K:2d} objects: {rows * columns:3d} relations, z {tuple(z.shape)}, "
              f"largest change when the objects are shuffled: {change:.1e}")
