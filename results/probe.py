"""Does z tell where the cube is that the goal names?

    python results/probe.py results/push-lrn-n2-seed0 [RUN ...]           N = 2; 20 s a run
    python results/probe.py RUN --distractors 5

The agent stays as it is. A small network is trained by supervised learning to read the named
cube's place (x, y) from z, and a second one to read that of another cube. Both are trained on the
starts of 5000 episodes and asked in 1000 others. All have two or more cubes in the middle of the
arena, where targets are drawn: one of these is named at random, another is the other cube. So
nothing but the name tells the two apart, and a z that does not use it serves both equally.

Prints mean distances in mm, also that of the read-out that was trained with the agent, if there
was one, in the same states. (A z that does not know the order of the cubes cannot say which of the
others is meant. So the other cube's error stays high in any case; what tells is whether that of the
named cube is lower.)
"""
import argparse
import math
import os
import sys

import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import evaluate
from train import fail, load, make_env, mlp
from trifinger_env import GRASP_RADIUS, IDENTIFIER, POSITION, POSITION_SCALE

TRAINED, ASKED = 5000, 1000              # states
STEPS, BATCH = 1500, 256                 # of Adam


def in_the_middle(obs):
    """(..., N+1) bool: which cubes lie where targets are drawn?"""
    places = obs["cubes"][..., POSITION][..., :2] * POSITION_SCALE         # m
    return (places ** 2).sum(-1) < GRASP_RADIUS ** 2


def start_states(checkpoint, distractors, count):
    """First observations of `count` episodes with two cubes or more in the middle, as a batch."""
    env = make_env(checkpoint["task"], distractors, checkpoint["settings"])
    obs, _ = env.reset(seed=0)
    observations = []
    while len(observations) < count:
        if in_the_middle(obs).sum() > 1:
            observations.append(obs)
        obs, _ = env.reset()
    env.close()
    return evaluate.as_batch(observations)


def named_at_random(obs):
    """Observations whose goals name a random cube of the middle; its row and another's: (B,)."""
    cubes, goal = obs["cubes"], obs["goal"].clone()
    two = torch.multinomial(in_the_middle(obs).float(), 2)     # (B, 2) without repetition
    named, other = two.T
    goal[:, IDENTIFIER] = cubes[torch.arange(len(cubes)), named, IDENTIFIER]
    return {**obs, "goal": goal}, named, other


def reading_error(z, places):
    """Mean distance from places (B, 2) to where a network reads them from z (B, Z).

    It is trained on all but the last ASKED rows and asked in these.
    """
    torch.manual_seed(0)
    known, asked = slice(-ASKED), slice(-ASKED, None)
    z = (z - z[known].mean(dim=0)) / (z[known].std(dim=0) + 1e-6)
    network = mlp(z.shape[1], 128, 128, 2)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(STEPS):
        rows = torch.randint(len(z) - ASKED, (BATCH,))
        loss = (network(z[rows]) - places[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return mean_distance(network(z[asked]), places)


def mean_distance(read, places):
    """Mean distance of what is read for the asked rows, (ASKED, 2) or one place, from the truth."""
    return (read - places[-ASKED:]).norm(dim=1).mean().item()


def guess_error(places):
    """What the best constant guess errs by, roughly: the mean of the known places."""
    return mean_distance(places[:-ASKED].mean(dim=0), places)


@torch.no_grad()
def own_error(agent, z, places):
    """What the read-out that was trained with the agent errs by."""
    return mean_distance(agent.read_out(z[-ASKED:])[:, :2], places)


def probe(run, distractors):
    """Errors in mm: for the named cube, for another one, of a guess, and of the own read-out."""
    checkpoint, agent = load(run)
    torch.manual_seed(0)                                       # after load(), which draws weights
    obs, named, other = named_at_random(start_states(checkpoint, distractors, TRAINED + ASKED))
    with torch.no_grad():
        z = agent.encode(obs)
    places = obs["cubes"][..., POSITION][..., :2]              # (B, N+1, 2), about [-1, 1]
    rows = torch.arange(len(z))
    at_named, at_other = places[rows, named], places[rows, other]
    own = float("nan")
    if checkpoint["settings"]["auxiliary"] > 0:                # trained with a read-out
        own = own_error(agent, z, at_named)
    errors = reading_error(z, at_named), reading_error(z, at_other), guess_error(at_named), own
    return [1000 * POSITION_SCALE * error for error in errors]


def main():
    parser = argparse.ArgumentParser(description="Does z tell where the named cube is?")
    parser.error = fail
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--distractors", type=int, default=2, metavar="N", help="default 2")
    args = parser.parse_args()
    if args.distractors < 1:
        fail("without a distractor there is no other cube to name")
    torch.set_num_threads(1)
    print("| run | N | named cube (mm) | another cube | a guess | own read-out |")
    print("|---|---|---|---|---|---|")
    for run in args.runs:
        try:
            errors = probe(run, args.distractors)
        except ValueError as error:
            fail(str(error))
        name = os.path.basename(os.path.normpath(run))
        cells = " | ".join("-" if math.isnan(error) else f"{error:.0f}" for error in errors)
        print(f"| {name} | {args.distractors} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
