"""Look inside trained agents: the numbers behind figures 6, 7 and 8 (the paper's appendix).

    python results/inside.py                    all that the shipped runs allow
    python results/inside.py 8 --episodes 20    one of them, from fewer episodes

Plays episodes with the shipped runs push-{lrn,rn,attn}-n2-seed0 and writes beside this file

    figure6.csv         z at each N, embedded in the plane by t-SNE: encoder, distractors, x, y
    figure6-drift.csv   how far the z at each N are from those at 2: encoder, distractors, distance
    figure7.csv         LRN's relations at N = 3..6, embedded in the plane: kind, x, y
    figure8.csv         LRN's relations at N = 4 and 5: mean norm by kind and step

t-SNE needs scikit-learn. Episodes and actions are those of evaluate.py.
"""
import argparse
import csv
import os
import sys

import numpy as np
import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
import evaluate
from figures import KINDS, PAPER
from train import Agent, fail, load, positive
from trifinger_env import TIME

MOMENTS = 5                              # of an episode that t-SNE gets to see
POINTS = 5000                            # most points that t-SNE and distances are given
FIRST_DISTRACTOR = 4                     # index among relations_of(): after fingers and target


# ---- playing

@torch.inference_mode()
def record(run, distractors, episodes, measure):
    """measure(agent, obs) -> (B, ...) after every step of `episodes`: (steps, E, ...)."""
    checkpoint, agent = load(run)
    records = []
    for part in evaluate.chunks(episodes):
        envs, observations = evaluate.start(checkpoint, distractors, part)
        steps = []
        for _ in range(checkpoint["settings"]["episode_steps"]):
            actions = evaluate.actions(agent, observations)
            played = [env.step(action) for env, action in zip(envs, actions)]
            refuse_if_cut_short(played)
            observations = [obs for obs, *_ in played]
            steps.append(measure(agent, evaluate.as_batch(observations)).numpy())
        records.append(np.stack(steps))
        for env in envs:
            env.close()
    return np.concatenate(records, axis=1)


def refuse_if_cut_short(played):
    """ValueError if an episode ended before its time: it would have fewer steps than others."""
    for *_, truncated, info in played:
        if truncated and info["truncated_by"] != TIME:
            raise ValueError(f"an episode was cut short ({info['truncated_by']})")


def relations_of(agent, obs):
    """LRN's relations, fingers first, then the target, then distractors: (B, K, D)."""
    objects, goal = agent.tokens(obs)
    r = agent.encoder.relations(objects, goal)                 # (B, K, D), cubes first
    is_target = evaluate.is_target(obs)
    count = is_target.shape[1]
    fingers, target = r[:, count:], r[:, :count][is_target]
    others = r[:, :count][~is_target].view(len(r), count - 1, -1)
    return torch.cat([fingers, target[:, None], others], dim=1)


# ---- measures

def energy_distance(a, b):
    """Distance of two clouds of points (n, Z), (m, Z), in units of the distances within b.

    (2 E|a - b| - E|a - a'| - E|b - b'|) / E|b - b'| (Szekely, 2003): 0 for equal distributions.
    """
    a, b = torch.from_numpy(a), torch.from_numpy(b)
    within = torch.cdist(b, b).mean()
    return ((2 * torch.cdist(a, b).mean() - torch.cdist(a, a).mean() - within) / within).item()


def some(points, count):
    """At most `count` rows, drawn without repetition."""
    rows = np.random.default_rng(0).permutation(len(points))[:count]
    return points[rows]


def tsne():
    """scikit-learn's t-SNE into the plane; asked for before anything is played."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        raise ValueError("figures 6 and 7 need scikit-learn: pip install scikit-learn") from None
    return TSNE(random_state=0)


def moments(steps):
    """Moments evenly over an episode: (steps, E, ...) -> (MOMENTS * E, ...)."""
    at = np.linspace(0, len(steps) - 1, MOMENTS).astype(int)
    return steps[at].reshape(-1, *steps.shape[2:])


# ---- the figures' numbers

def figure_6(episodes):
    """z by N, encoder by encoder."""
    embedding = tsne()
    dots, drifts = [], []
    for encoder in PAPER:
        run = os.path.join(HERE, f"push-{encoder}-n2-seed0")
        if not os.path.exists(run):
            print(f"figure 6 without {encoder}: {run} is not there")
            continue
        numbers = range(10)
        steps = {N: record(run, N, episodes, Agent.encode) for N in numbers}
        whole = {N: some(z.reshape(-1, z.shape[-1]), POINTS) for N, z in steps.items()}
        drifts += [(encoder, N, f"{energy_distance(whole[N], whole[2]):.4f}") for N in numbers]
        sample = {N: some(moments(z), POINTS // len(numbers)) for N, z in steps.items()}
        places = embedding.fit_transform(np.concatenate(list(sample.values())))
        labels = [N for N in numbers for _ in sample[N]]
        dots += [(encoder, N, f"{x:.2f}", f"{y:.2f}") for N, (x, y) in zip(labels, places)]
    write("figure6.csv", ("encoder", "distractors", "x", "y"), dots)
    write("figure6-drift.csv", ("encoder", "distractors", "distance"), drifts)


def figure_7(episodes):
    """LRN's relations by kind, in the plane."""
    embedding = tsne()
    run = os.path.join(HERE, "push-lrn-n2-seed0")
    rows, kinds = [], []
    numbers = range(3, 7)
    for N in numbers:
        r = moments(record(run, N, episodes, relations_of))    # (n, K, D)
        r = some(r, POINTS // (len(numbers) * r.shape[1]))     # as many points at every N, about
        rows += list(r.reshape(-1, r.shape[-1]))
        of_one_state = [*list(KINDS)[:FIRST_DISTRACTOR], *["distractors"] * N]
        kinds += of_one_state * len(r)
    places = embedding.fit_transform(np.array(rows))
    write("figure7.csv", ("kind", "x", "y"),
          [(kind, f"{x:.2f}", f"{y:.2f}") for kind, (x, y) in zip(kinds, places)])


def figure_8(episodes):
    """Norms of LRN's relations by kind over an episode; of distractors, the mean of their norms."""
    run = os.path.join(HERE, "push-lrn-n2-seed0")
    rows = []
    for N in (4, 5):
        r = record(run, N, episodes, relations_of)             # (steps, E, K, D)
        norms = np.linalg.norm(r, axis=-1).mean(axis=1)        # (steps, K)
        for step, row in enumerate(norms, 1):
            values = [*row[:FIRST_DISTRACTOR], row[FIRST_DISTRACTOR:].mean()]
            rows.append((N, step, *(f"{value:.3f}" for value in values)))
    write("figure8.csv", ("N", "step", *KINDS), rows)


def write(name, columns, rows):
    path = os.path.join(HERE, name)
    with open(path, "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])
    print(f"wrote {path}")


FIGURES = {"8": figure_8, "6": figure_6, "7": figure_7}        # 8 needs no scikit-learn


def main():
    parser = argparse.ArgumentParser(description="Numbers behind figures 6, 7 and 8.")
    parser.error = fail
    parser.add_argument("figures", nargs="*", help=f"of {', '.join(FIGURES)} (default: all)")
    parser.add_argument("--episodes", type=positive, default=200, metavar="E", help="default 200")
    args = parser.parse_args()
    for figure in args.figures:
        if figure not in FIGURES:
            fail(f"there is no figure {figure} here; there are {', '.join(FIGURES)}")
    torch.set_num_threads(1)
    try:
        for figure in args.figures or FIGURES:
            FIGURES[figure](range(args.episodes))
    except (ValueError, OSError) as error:
        fail(str(error))


if __name__ == "__main__":
    main()
