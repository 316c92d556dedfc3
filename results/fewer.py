"""Train as train.py does, with a read-out loss that shows the encoder fewer cubes now and then.

    python results/fewer.py --encoder lrn --seed 1 --out runs/push-lrn-n2-fewer-seed1

Takes train.py's arguments. Training at one N does not ask that distractors weigh little in z, and
so an agent may fail at another N. Here every minibatch of the read-out loss (Agent.auxiliary)
shows the encoder a random part of the N+1 cubes, 1 to all of them, and z has to tell the same. The
policy always sees them all, and nobody ever sees more than N+1.
"""
import os
import sys

import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import train


class FewerCubes(train.Agent):
    """An Agent whose read-out loss is asked about some of the cubes."""

    def auxiliary(self, obs):
        cubes = obs["cubes"]                                   # (B, N+1, 18)
        shuffled = torch.randperm(cubes.shape[1])
        count = torch.randint(1, cubes.shape[1] + 1, ())
        return super().auxiliary({**obs, "cubes": cubes[:, shuffled[:count]]})


train.Agent = FewerCubes                 # at import, so that further ranks do the same

if __name__ == "__main__":
    train.main()
