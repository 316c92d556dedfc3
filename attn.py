"""Self-attention encoder: the paper's baseline (appendix A.4, figure 2 box A).

    o_attn = softmax(q(o) k(o)^T / sqrt(D/H)) v(o)             equation 3, in each of H heads
    z = LayerNorm(f_phi(sum_{i=1..K+1} o_attn_i))              equation 4

The goal joins the K objects as token K+1, and every token attends to every token: (K+1)^2 weights
per head. As in the paper's equations there is no output projection and no residual; its o has
tokens as columns, ours as rows.

Shapes: objects (B, K, D), goal (B, D) -> z (B, Z).
        B batch, K objects, D token width (the paper's d), Z width of z (its d_z), H heads.
        The paper's equation is for one head, so it divides by sqrt(D).
Run:    python attn.py
"""
import math

import torch
from torch import nn


def orthogonal(layer, gain=math.sqrt(2)):
    """Orthogonal weights, zero bias (ours: with PyTorch's default all z start out nearly alike)."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class ATTN(nn.Module):
    """Encoder of appendix A.4; nothing in it depends on K.

    token_dim   D. ValueError unless it is a multiple of `heads`.
    z_dim       Z
    heads       H; the paper does not print it
    """

    def __init__(self, token_dim=64, z_dim=25, heads=4):
        super().__init__()
        if token_dim % heads:
            raise ValueError(f"token_dim must be a multiple of heads, got {token_dim} and {heads}")
        D, Z = token_dim, z_dim
        self.heads = heads
        self.q = orthogonal(nn.Linear(D, D))
        self.k = orthogonal(nn.Linear(D, D))
        self.v = orthogonal(nn.Linear(D, D))
        self.f = orthogonal(nn.Linear(D, Z))
        self.norm = nn.LayerNorm(Z)

    def split_heads(self, x):
        """(B, K+1, D) -> (B, H, K+1, D/H)."""
        return x.unflatten(2, (self.heads, -1)).transpose(1, 2)

    def attend(self, objects, goal):
        """Attended tokens (B, K+1, D), and attention weights (B, H, K+1, K+1): row i says what
        token i looks at."""
        tokens = torch.cat([objects, goal[:, None]], dim=1)    # (B, K+1, D)
        q = self.split_heads(self.q(tokens))                   # (B, H, K+1, D/H)
        k = self.split_heads(self.k(tokens))                   # (B, H, K+1, D/H)
        v = self.split_heads(self.v(tokens))                   # (B, H, K+1, D/H)
        score = q @ k.transpose(2, 3) / math.sqrt(q.shape[-1])             # (B, H, K+1, K+1)
        weights = score.softmax(dim=-1)                        # (B, H, K+1, K+1)
        per_head = weights @ v                                 # (B, H, K+1, D/H)
        return per_head.transpose(1, 2).flatten(2), weights    # (B, K+1, D), heads joined

    def forward(self, objects, goal):
        """Equation 4: objects (B, K, D), goal (B, D) -> z (B, Z)."""
        attended, _ = self.attend(objects, goal)               # (B, K+1, D)
        return self.norm(self.f(attended.sum(dim=1)))          # (B, Z), sum_i o_attn_i


if __name__ == "__main__":
    for K in (4, 6, 12):
        _, weights = ATTN().attend(torch.randn(1, K, 64), torch.randn(1, 64))
        print(f"K={K:2d} objects: attention weights of {tuple(weights.shape[1:])}")
