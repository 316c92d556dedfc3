"""How long do the encoders take for K objects?

    python results/encoder_speed.py                      forward and backward pass, a minute
    python results/encoder_speed.py --repeats 1

Median CPU time over the repeats, one thread, 64 samples, D = 64. The slope is that of log(time)
over log(K): 1 is linear, 2 quadratic. RN stops at 48 objects, where it has 2401 pairs a sample.
"""
import argparse
import os
import sys
import time

import numpy as np
import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
from attn import ATTN
from lrn import LRN
from rn import RN
from train import fail, positive

B, D = 64, 64
NUMBERS = (12, 24, 48, 96, 192)          # K


def milliseconds(encoder, K, repeats):
    """Median time of a forward and backward pass on K objects."""
    objects = torch.randn(B, K, D, requires_grad=True)
    goal = torch.randn(B, D)
    times = []
    for _ in range(repeats + 1):         # the first one warms up
        start = time.process_time()
        encoder(objects, goal).sum().backward()
        times.append(time.process_time() - start)
    return 1000 * np.median(times[1:])


def main():
    parser = argparse.ArgumentParser(description="How the encoders' time grows with K.")
    parser.error = fail
    parser.add_argument("--repeats", type=positive, default=25, metavar="R")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    for kind, numbers in {LRN: NUMBERS, ATTN: NUMBERS, RN: NUMBERS[:3]}.items():
        times = [milliseconds(kind(), K, args.repeats) for K in numbers]
        slope, _ = np.polyfit(np.log(numbers), np.log(times), 1)
        shown = ", ".join(f"K={K} {ms:.2f} ms" for K, ms in zip(numbers, times))
        print(f"{kind.__name__}: {shown}; slope {slope:.2f}", flush=True)


if __name__ == "__main__":
    main()
