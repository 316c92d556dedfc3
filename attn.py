"""Self-attention encoder: the paper's baseline (appendix A.4, figure 2 box A).

    o_attn = softmax(q(o) k(o)^T / sqrt(D/H)) v(o)             in each of H heads
    z = LayerNorm(f_phi(sum_{i=1..K+1} o_attn_i))

The goal joins the K objects as token K+1, and every token attends to every token: (K+1)^2 weights
per head. As in the paper's equations there is no output projection and no residual.

Shapes: objects (B, K, D), goal (B, D), present (B, K) bool -> z (B, Z).
        B batch, K objects, D token width (the paper's d), Z width of z (its d_z), H heads.
        The paper's equation is for one head, so it divides by sqrt(D).
Run:    python attn.py
"""
import math

import torch
from torch import nn
from torch.nn.functional import pad


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


class ATTN(nn.Module):
    """Encoder of appendix A.4 with `heads` heads; nothing in it depends on K.

    token_dim   D. ValueError unless it is a multiple of `heads`.
    z_dim       Z
    heads       H; the paper does not print it
    """

    def __init__(self, token_dim=64, z_dim=25, heads=4):
        super().__init__()
        if heads < 1 or token_dim % heads:
            raise ValueError(f"token_dim must be a multiple of heads, got {token_dim} and {heads}")
        D, Z = token_dim, z_dim
        self.token_dim = D
        self.heads = heads
        self.q = orthogonal(nn.Linear(D, D))
        self.k = orthogonal(nn.Linear(D, D))
        self.v = orthogonal(nn.Linear(D, D))
        self.f = orthogonal(nn.Linear(D, Z))
        self.norm = nn.LayerNorm(Z)

    def split_heads(self, x):
        """(B, K+1, D) -> (B, H, K+1, D/H)."""
        B, count, D = x.shape
        return x.view(B, count, self.heads, D // self.heads).transpose(1, 2)

    def attend(self, objects, goal, present=None):
        """Attended tokens (B, K+1, D) and attention weights (B, H, K+1, K+1).

        Row i of the weights says what token i looks at; padding is never looked at.
        """
        check_shapes(self.token_dim, objects, goal, present)
        if present is not None:                                # NaN in padding would spread by @
            objects = objects.masked_fill(~present[..., None], 0.0)
        tokens = torch.cat([objects, goal[:, None]], dim=1)    # (B, K+1, D)
        q = self.split_heads(self.q(tokens))                   # (B, H, K+1, D/H)
        k = self.split_heads(self.k(tokens))                   # (B, H, K+1, D/H)
        v = self.split_heads(self.v(tokens))                   # (B, H, K+1, D/H)

        # softmax(q k^T / sqrt(D/H)) v
        score = q @ k.transpose(2, 3) / math.sqrt(q.shape[-1])             # (B, H, K+1, K+1)
        if present is not None:
            real = pad(present, (0, 1), value=True)            # (B, K+1), the goal is real
            score = score.masked_fill(~real[:, None, None], -math.inf)
        weights = score.softmax(dim=-1)                        # (B, H, K+1, K+1)
        per_head = weights @ v                                 # (B, H, K+1, D/H)
        attended = per_head.transpose(1, 2).reshape(tokens.shape)          # (B, K+1, D), joined
        return attended, weights

    def forward(self, objects, goal, present=None):
        """Second equation of A.4: objects (B, K, D), goal (B, D) -> z (B, Z).

        `present` (B, K) bool is for batches that mix numbers of objects (training has one K a
        batch): False marks padding, and z is as if it were not there. ValueError for other shapes.
        """
        attended, _ = self.attend(objects, goal, present)      # (B, K+1, D)
        if present is not None:                                # padding looked at others: drop it
            real = pad(present, (0, 1), value=True)            # (B, K+1)
            attended = attended.masked_fill(~real[..., None], 0.0)
        total = attended.sum(dim=1)                            # (B, D), sum_i o_attn_i
        return self.norm(self.f(total))                        # (B, Z), LayerNorm(f_phi(.))


if __name__ == "__main__":
    torch.manual_seed(0)
    encoder = ATTN()
    for K in (4, 6, 12):
        objects, goal = torch.randn(2, K, 64), torch.randn(2, 64)
        z = encoder(objects, goal)
        shuffled = encoder(objects[:, torch.randperm(K)], goal)
        _, weights = encoder.attend(objects, goal)
        change = (z - shuffled).abs().max()
        print(f"K={K:2d} objects: attention weights {tuple(weights.shape)}, z {tuple(z.shape)}, "
              f"largest change when the objects are shuffled: {change:.1e}")
