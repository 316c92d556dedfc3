"""Self-attention encoder: the paper's baseline (appendix A.4, figure 2 box A).

    o_attn = softmax(q(o) k(o)^T / sqrt(d)) v(o)        z = LayerNorm(f_phi(sum_{i=1..K+1} o_attn_i))

The goal joins the K objects as token K+1, and every token attends to every token: (K+1)^2 weights per head.

Shapes: objects (B, K, D), goal (B, D), present (B, K) bool -> z (B, Z). B batch, K objects, D token width, Z width of z,
        H heads, d = D / H width of a head.
Run:    python attn.py
"""
import math

import torch
from torch import nn


def orthogonal(layer, gain=math.sqrt(2)):
    """Orthogonal weights, zero bias. PyTorch's default shrinks the signal layer by layer, and z starts out constant."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class ATTN(nn.Module):
    """Encoder of equations 3 and 4 (appendix A.4) with `heads` heads; nothing in it depends on K.

    token_dim, z_dim   D and Z. ValueError unless D is a multiple of `heads` (the paper does not print their number).
    """

    def __init__(self, token_dim=64, z_dim=25, heads=4):
        super().__init__()
        if heads < 1 or token_dim % heads:
            raise ValueError(f"token_dim must be a multiple of heads, got {token_dim} and {heads}")
        self.heads = heads
        self.q, self.k, self.v = (orthogonal(nn.Linear(token_dim, token_dim)) for _ in range(3))
        self.f = orthogonal(nn.Linear(token_dim, z_dim))
        self.norm = nn.LayerNorm(z_dim)

    def attend(self, objects, goal, present=None):
        """Attended tokens (B, K+1, D) and attention weights (B, H, K+1, K+1): row i is what token i looks at."""
        tokens = torch.cat([objects, goal[:, None]], 1)                                        # (B, K+1, D)
        B, T, D = tokens.shape
        q, k, v = (layer(tokens).view(B, T, self.heads, D // self.heads).transpose(1, 2)       # (B, H, K+1, d)
                   for layer in (self.q, self.k, self.v))
        score = q @ k.transpose(2, 3) / math.sqrt(D // self.heads)                             # (B, H, K+1, K+1)
        if present is not None:
            real = torch.cat([present, present.new_ones(B, 1)], 1)                             # (B, K+1), the goal is real
            score = score.masked_fill(~real[:, None, None], -math.inf)
        weights = score.softmax(-1)
        return (weights @ v).transpose(1, 2).reshape(B, T, D), weights

    def forward(self, objects, goal, present=None):
        """z (B, Z) of objects (B, K, D) and goal (B, D). `present` (B, K) bool: False marks padding, ignored exactly."""
        attended, _ = self.attend(objects, goal, present)                                      # (B, K+1, D)
        if present is not None:
            attended = torch.cat([attended[:, :-1].masked_fill(~present[..., None], 0.0), attended[:, -1:]], 1)
        return self.norm(self.f(attended.sum(1)))                                              # (B, Z)


if __name__ == "__main__":
    torch.manual_seed(0)
    encoder = ATTN()
    for K in (4, 6, 12):
        objects, goal, order = torch.randn(2, K, 64), torch.randn(2, 64), torch.randperm(K)
        z = encoder(objects, goal)
        gap = (z - encoder(objects[:, order], goal)).abs().max()
        print(f"K={K:2d} objects: attention weights {tuple(encoder.attend(objects, goal)[1].shape)}, z {tuple(z.shape)}, "
              f"largest change when the objects are permuted: {gap:.1e}")
