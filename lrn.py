"""Linear Relation Network: the paper's object encoder (section 3.2, equation 1, figure 2 box C).

    z = LayerNorm(f_phi(sum_{i=1..K} g_theta(o_i, o_goal)))

One relation r_i = g_theta(o_i, o_goal) is computed per object, always with the goal, so the cost is
linear in K. The sum does not depend on the order of the objects, and LayerNorm is meant to keep z
in distribution when K changes: it fixes the scale of z.

Shapes: objects (B, K, D), goal (B, D), present (B, K) bool -> z (B, Z).
        B batch, K objects, D token width (the paper's d), Z width of z (its d_z); o_goal: its o_g.
Run:    python lrn.py
"""
import math

import torch
from torch import nn
from torch.nn.functional import linear


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


class LRN(nn.Module):
    """Encoder of equation 1. Nothing in it depends on K: one set of weights serves any number.

    token_dim    D
    z_dim        Z (the paper: 25)
    relations    False: no relations, r_i = g_theta(o_i) (ablation of figure 5, purple). As printed,
                 over the K objects: z then knows nothing of the goal
    layer_norm   False: z = f_phi(mean_i r_i), a mean in place of sum and LayerNorm (orange)
    """

    def __init__(self, token_dim=64, z_dim=25, relations=True, layer_norm=True):
        super().__init__()
        D, Z = token_dim, z_dim
        self.token_dim = D
        self.with_goal = relations                             # `relations` is a method here
        self.with_norm = layer_norm
        # g_theta has four layers: self.first, which stands apart (see relations()), and self.g.
        self.first = orthogonal(nn.Linear(2 * D if relations else D, D))
        self.g = nn.Sequential(
            nn.ReLU(), orthogonal(nn.Linear(D, D)),
            nn.ReLU(), orthogonal(nn.Linear(D, D)),
            nn.ReLU(), orthogonal(nn.Linear(D, D)),
        )
        self.f = orthogonal(nn.Linear(D, Z))
        self.norm = nn.LayerNorm(Z) if layer_norm else nn.Identity()

    def relations(self, objects, goal):
        """All r_i = g_theta(o_i, o_goal): objects (B, K, D), goal (B, D) -> (B, K, D)."""
        check_shapes(self.token_dim, objects, goal)
        if not self.with_goal:
            return self.g(self.first(objects))                 # (B, K, D), r_i = g_theta(o_i)

        # The cost is linear in K because each o_i is paired with the goal only. The first layer is
        # cheaper still: W [o_i; o_goal] + b = W_o o_i + (W_goal o_goal + b), and the bracket, the
        # same for every i, is computed once.
        W_o, W_goal = self.first.weight.split(self.token_dim, dim=1)       # (D, D) each
        from_objects = linear(objects, W_o)                    # (B, K, D)
        from_goal = linear(goal, W_goal, self.first.bias)      # (B, D)
        return self.g(from_objects + from_goal[:, None])       # (B, K, D)

    def pool(self, r, present):
        """sum_i r_i over the real objects: r (B, K, D) -> (B, D); without LayerNorm their mean."""
        if present is not None:
            r = r.masked_fill(~present[..., None], 0.0)
        total = r.sum(dim=1)                                   # (B, D)
        if self.with_norm:
            return total
        if present is None:
            return total / r.shape[1]
        count = present.sum(dim=1, keepdim=True).clamp(min=1)  # a row of padding: 0, not NaN
        return total / count

    def forward(self, objects, goal, present=None):
        """Equation 1: objects (B, K, D), goal (B, D) -> z (B, Z).

        `present` (B, K) bool is for batches that mix numbers of objects (training has one K a
        batch): False marks padding, and z is as if it were not there. ValueError for other shapes.
        """
        check_shapes(self.token_dim, objects, goal, present)
        if present is not None:                                # NaN there would spoil gradients
            objects = objects.masked_fill(~present[..., None], 0.0)
        r = self.relations(objects, goal)                      # (B, K, D), all g_theta(o_i, o_goal)
        pooled = self.pool(r, present)                         # (B, D), sum_i r_i
        return self.norm(self.f(pooled))                       # (B, Z), LayerNorm(f_phi(.))


class LRNMax(LRN):
    """Not the paper's: LRN with the largest r_i in each dimension in place of their sum.

    Ten distractors whose relations r_i are equal then change z exactly as one of them would; after
    a sum, the rest of the network has to make up for the other nine. Needs at least one real object
    in every row.
    """

    def __init__(self, token_dim=64, z_dim=25):                # without the paper's ablations
        super().__init__(token_dim, z_dim)

    def pool(self, r, present):
        """max_i r_i over the real objects: r (B, K, D) -> (B, D)."""
        if present is not None:
            r = r.masked_fill(~present[..., None], -math.inf)
        return r.amax(dim=1)


if __name__ == "__main__":
    torch.manual_seed(0)
    encoder = LRN()
    for K in (4, 6, 12):
        objects, goal = torch.randn(2, K, 64), torch.randn(2, 64)
        z = encoder(objects, goal)
        shuffled = encoder(objects[:, torch.randperm(K)], goal)
        count = encoder.relations(objects, goal).shape[1]
        change = (z - shuffled).abs().max()
        print(f"K={K:2d} objects: {count:3d} relations, z {tuple(z.shape)}, "
              f"largest change when the objects are shuffled: {change:.1e}")
