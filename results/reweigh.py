"""What if an agent were told which cubes are distractors?

    python results/reweigh.py results/push-lrn-n2-seed0          an LRN, RN or ATTN agent; a minute
    python results/reweigh.py RUN [RUN ...] --distractors 9 --episodes 100

LRN, RN and ATTN all sum one vector per token (or pair of tokens). Trained with T distractors and
played with N, each distractor's term is here counted T / N times, so that together they weigh as
much as in training. Prints the score and the read error as it is and reweighed. For LRN also
what each object adds to f's output, as a mean length.
"""
import argparse
import os
import sys

import torch

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
import evaluate
from train import fail, load, positive
from trifinger_env import IDENTIFIER_POOL


def distractor_tokens(obs):
    """(B, N+5) bool over cubes, fingers and goal: which tokens are distractors?"""
    is_distractor = ~evaluate.is_target(obs)
    B = len(is_distractor)
    others = torch.zeros(B, 4, dtype=torch.bool)               # three fingers, the goal
    return torch.cat([is_distractor, others], dim=1)


def token_weights(is_distractor, T, N):
    """(B, tokens): T / N for a distractor, 1 for every other token."""
    return torch.where(is_distractor, T / max(N, 1), 1.0)


def pair_weights(is_distractor, T, N):
    """(B, tokens, tokens), for the ordered pairs of RN.

    There are N (N - 1) pairs of two different distractors, T (T - 1) in training; a pair of a
    distractor with anything else, or with itself, weighs T / N.
    """
    i, j = is_distractor[:, :, None], is_distractor[:, None]
    is_same = torch.eye(is_distractor.shape[1], dtype=torch.bool)
    weights = torch.where(i | j, T / max(N, 1), 1.0)
    two_different = i & j & ~is_same
    return torch.where(two_different, T * (T - 1) / max(N * (N - 1), 1), weights)


def reweighed_z(agent, obs):
    """z (B, Z) with the distractors' terms weighed as in training."""
    objects, goal = agent.tokens(obs)
    is_distractor = distractor_tokens(obs)
    T, N = agent.distractors, obs["cubes"].shape[1] - 1
    encoder = agent.encoder
    if agent.kind == "rn":
        weights = pair_weights(is_distractor, T, N).flatten(1)             # (B, pairs)
        terms = encoder.relations(objects, goal).flatten(1, 2)             # (B, pairs, D)
    elif agent.kind == "attn":
        weights = token_weights(is_distractor, T, N)                       # (B, K+1)
        terms, _ = encoder.attend(objects, goal)                           # (B, K+1, D)
    else:                                                      # LRN: the goal is no term
        weights = token_weights(is_distractor[:, :-1], T, N)               # (B, K)
        terms = encoder.relations(objects, goal)                           # (B, K, D)
    total = (weights[..., None] * terms).sum(1)                # (B, D)
    return encoder.norm(encoder.f(total))


def print_score(name, checkpoint, agent, N, episodes):
    """Play the agent as it is now, and print a row."""
    played = evaluate.play(checkpoint, agent, N, range(episodes), sample_actions=False)
    row = evaluate.summary(N, played)
    print(f"{name}: success {row['success_aabb']:.2f} +- {row['ci95']:.2f}, "
          f"read error {1000 * row['read_error']:.1f} mm", flush=True)


@torch.inference_mode()
def print_lengths(checkpoint, agent, N, episodes):
    """What each object adds to f's output of an LRN agent at the start of episodes."""
    envs, observations = evaluate.start(checkpoint, N, range(episodes))
    for env in envs:
        env.close()
    obs = evaluate.as_batch(observations)
    r = agent.encoder.relations(*agent.tokens(obs))            # (B, K, D)
    added = r @ agent.encoder.f.weight.T                       # (B, K, Z)
    cubes, fingers = added[:, :N + 1], added[:, N + 1:]
    is_distractor = distractor_tokens(obs)[:, :N + 1]
    distractors, target = cubes[is_distractor], cubes[~is_distractor]
    print(f"lengths: a distractor {distractors.norm(dim=1).mean():.1f} "
          f"(their mean {distractors.mean(0).norm():.1f}), "
          f"the target {target.norm(dim=1).mean():.1f}, "
          f"all fingers {fingers.sum(1).norm(dim=1).mean():.1f}", flush=True)


def main():
    parser = argparse.ArgumentParser(
        description="Weigh distractors as in training (see the first lines of reweigh.py).")
    parser.error = fail
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folder of LRN, RN or ATTN")
    parser.add_argument("--distractors", type=int, choices=range(len(IDENTIFIER_POOL)), metavar="N",
                        help="N (default 9; for a run trained at 9: 2)")
    parser.add_argument("--episodes", type=positive, default=100, metavar="E")
    args = parser.parse_args()
    torch.set_num_threads(1)
    for run in args.runs:
        try:
            checkpoint, agent = load(run)
        except ValueError as error:
            fail(str(error))
        if agent.kind not in ("lrn", "rn", "attn"):
            fail(f"{run}: knows how to reweigh lrn, rn and attn, not {agent.kind}")
        if agent.kind == "lrn" and not agent.encoder.with_norm:
            fail(f"{run}: takes a mean of its relations; only sums can be reweighed")
        N = args.distractors
        if N is None:
            N = 2 if agent.distractors == 9 else 9
        print_score(f"{run} N={N} as it is", checkpoint, agent, N, args.episodes)
        agent.encode = lambda obs: reweighed_z(agent, obs)
        print_score(f"{run} N={N} distractors reweighed", checkpoint, agent, N, args.episodes)
        if agent.kind == "lrn":
            print_lengths(checkpoint, agent, N, args.episodes)


if __name__ == "__main__":
    main()
