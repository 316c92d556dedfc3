"""Look inside trained agents in the episodes that evaluate.py plays.

    python results/inside.py RUN --distractors 0,2,9     a table by N
    python results/inside.py RUN --crowd 10-15           a table by crowd: 10 to 15 distractors
    python results/inside.py --figures                   the numbers of figures 6, 7, 8, relations

The table: success; the same where the way from target to goal was clear and where a distractor
blocked it; share of blocked ones; distance from the target cube to where the read-out sees it; for
LRN the length of the distractors' mean relation against the target's; for lifting success without
and with a distractor beside the target, and by the goal's height. All but success are of the start.
A crowd is made of scenes at the N of training, as Agent.crowd makes it: it judges the transfer
without a look at a test N. Action shift: by how much (RMS) the crowd changes the mean actions.
--figures plays results/runs/push-{lrn,rn,attn}-n2-seed0 and writes figure6.csv (z at each N in the
plane), figure6-drift.csv (distance of the z at N from those at 2; also of the runs without crowds),
figure7.csv (LRN's relations in the plane) and figure8.csv (their lengths) in results/;
figurerelations.csv is of all seeds of LRN with and without crowds. Needs scikit-learn.
"""
import argparse
import csv
import glob
import itertools
import os
import sys

import numpy as np
import torch

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))
import evaluate
from train import POOL, Agent, fail, load, make_env
from trifinger_env import CUBE, HIGHEST_GOAL, IDENTIFIER, POSITION, POSITION_SCALE

BANDS = [(low, low + 5) for low in range(0, round(100 * HIGHEST_GOAL), 5)]   # of heights, cm
KINDS = ("finger 0", "finger 1", "finger 2", "target")         # of relations, then distractors
LRN_GROUPS = ("push-lrn-n2", "push-lrn-n2-nocrowd")            # of runs, with crowds and without
POINTS = 5000                            # most points that t-SNE and distances are given


# ---- playing

def batch_of(observations):
    """Observations as one batch, in every scene the target as first cube."""
    obs = evaluate.as_batch(observations)
    is_other = obs["cubes"][..., IDENTIFIER] != obs["goal"][:, None, IDENTIFIER]       # (B, N+1)
    order = is_other.int().argsort(dim=1, stable=True)
    obs["cubes"] = obs["cubes"][torch.arange(len(order))[:, None], order]
    return obs


def starts(checkpoint, N, episodes):
    """The first observations of the episodes, as one batch."""
    env = make_env(checkpoint["task"], N, checkpoint["settings"])
    seeds = [evaluate.episode_seed(episode) for episode in range(episodes)]
    observations = [env.reset(seed=seed)[0] for seed in seeds]
    env.close()
    return batch_of(observations)


def record(group, N, episodes, measure):
    """measure(agent, obs) after every step of a group's seed 0: (steps, episodes, ...)."""
    checkpoint, agent = load(os.path.join(HERE, "runs", f"{group}-seed0"))
    env = make_env("push", N, checkpoint["settings"])
    measured = []
    for episode in range(episodes):
        obs, _ = env.reset(seed=evaluate.episode_seed(episode))
        played = []
        for _ in range(env.episode_steps):
            [action] = evaluate.actions(agent, [obs])
            obs, *_ = env.step(action)
            played.append(obs)
        measured.append(measure(agent, batch_of(played)))
    env.close()
    return torch.stack(measured, dim=1).numpy()


# ---- measures in B scenes, the target as first cube

def from_target(obs, others):
    """The way along the floor from the target cube to others (B, M, >= 12): (B, M, 2), m."""
    target = obs["cubes"][:, :1, POSITION]                     # (B, 1, 3)
    return (others[..., POSITION] - target)[..., :2] * POSITION_SCALE


def is_blocked(obs):
    """(B,) bool: does a distractor lie within a cube's width of the line from target to goal?"""
    way = from_target(obs, obs["goal"][:, None])               # (B, 1, 2)
    to_others = from_target(obs, obs["cubes"][:, 1:])          # (B, N, 2)
    share = (to_others * way).sum(2) / way.square().sum(2)     # (B, N), of the way
    nearest = share.clamp(0, 1)[..., None] * way               # (B, N, 2)
    return ((to_others - nearest).norm(dim=2) < CUBE).any(1)


def has_neighbour(obs):
    """(B,) bool: is the centre of a distractor within 10 cm of the target's?"""
    return (from_target(obs, obs["cubes"][:, 1:]).norm(dim=2) < 0.1).any(1)


def read_error(agent, obs):
    """Mean distance in mm from the target cube to where the read-out sees it."""
    seen = agent.read_out(agent.encode(obs))[:, :3]
    away = (seen - obs["cubes"][:, 0, POSITION]).norm(dim=1)
    return 1000 * POSITION_SCALE * away.mean()


def actions_of(agent, obs):
    """Mean actions (B, 9), clipped as the environment does."""
    return agent(obs)[0].clamp(-1, 1)


def relations_of(agent, obs):
    """LRN's relations, fingers first, then the target, then distractors: (B, K, D)."""
    return agent.encoder.relations(*agent.tokens(obs)).roll(3, dims=1)     # fingers were last


def distractors_share(agent, obs):
    """Length of the distractors' mean relation, in units of the target's mean relation's (LRN)."""
    r = relations_of(agent, obs)
    return r[:, 4:].mean((0, 1)).norm() / r[:, 3].mean(0).norm()


# ---- the tables

def by_number(checkpoint, agent, N, episodes):
    """A row of the table by N: {column: number}."""
    ends = evaluate.play(checkpoint, agent, N, range(episodes))
    success = torch.tensor([end["fractional_success"] for end in ends])
    obs = starts(checkpoint, N, episodes)
    blocked = is_blocked(obs)
    row = {
        "N": N,
        "success": success.mean(),
        "way clear": success[~blocked].mean(),
        "way blocked": success[blocked].mean(),
        "share blocked": blocked.float().mean(),
        "read error, mm": read_error(agent, obs),
    }
    if checkpoint["encoder"] == "lrn":
        row["relations"] = distractors_share(agent, obs)
    if checkpoint["task"] == "lift":
        near = has_neighbour(obs)
        row |= {"apart": success[~near].mean(), "beside": success[near].mean(),
                "share beside": near.float().mean()}
        height = 100 * POSITION_SCALE * obs["goal"][:, POSITION][:, 2]     # cm
        for low, high in BANDS:
            row[f"{low}-{high} cm"] = success[(height >= low) & (height < high)].mean()
    return row


def by_crowd(checkpoint, agent, M, episodes):
    """A row of the table by crowd: M of a scene's distractors, drawn with replacement."""
    obs = starts(checkpoint, checkpoint["distractors"], episodes)
    before = actions_of(agent, obs)
    B, count = obs["cubes"].shape[:2]
    if count == 1 or M >= len(POOL):
        raise ValueError(f"no crowd of {M}: it takes distractors in training, and at most 20")
    others = torch.randint(1, count, (B, M))
    drawn = torch.cat([torch.zeros(B, 1, dtype=int), others], dim=1)       # the target first
    obs["cubes"] = obs["cubes"][torch.arange(B)[:, None], drawn]           # (B, M+1, 18)
    identifiers = POOL[torch.rand(B, len(POOL)).argsort(dim=1)[:, :M + 1]]
    obs["cubes"][..., IDENTIFIER] = identifiers
    obs["goal"][:, IDENTIFIER] = identifiers[:, 0]
    shift = (actions_of(agent, obs) - before).square().mean().sqrt()
    return {"crowd": M, "read error, mm": read_error(agent, obs), "action shift": shift}


def print_table(run, args):
    checkpoint, agent = load(run)
    print(run)
    torch.manual_seed(0)
    look, numbers = (by_crowd, args.crowd) if args.crowd else (by_number, args.distractors)
    for number in numbers:
        row = look(checkpoint, agent, number, args.episodes)
        if number == numbers[0]:
            print("  ".join(f"{name:>7s}" for name in row))
        print("  ".join(f"{value:{max(len(name), 7)}.3g}" for name, value in row.items()),
              flush=True)


# ---- numbers of the figures

def energy_distance(a, b):
    """Distance of two clouds of points (n, Z), (m, Z): 0 for equal distributions (Szekely, 2003).

    (2 E|a - b| - E|a - a'| - E|b - b'|) / E|b - b'|
    """
    a, b = torch.from_numpy(a), torch.from_numpy(b)
    within = torch.cdist(b, b).mean()
    return ((2 * torch.cdist(a, b).mean() - torch.cdist(a, a).mean() - within) / within).item()


def some(points, count):
    """At most `count` rows, drawn without repetition."""
    return points[np.random.default_rng(0).permutation(len(points))[:count]]


def moments(steps):
    """Five moments evenly over an episode: (steps, E, ...) -> (5 E, ...)."""
    at = np.linspace(0, len(steps) - 1, 5).astype(int)
    return steps[at].reshape(-1, *steps.shape[2:])


def write(name, columns, rows):
    """A CSV in results/; floats with four decimals."""
    texts = [[f"{cell:.4f}" if isinstance(cell, float) else cell for cell in row] for row in rows]
    with open(os.path.join(HERE, name), "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *texts])
    print(f"wrote {name}", flush=True)


def embedded(labels, points):
    """Labels (tuples), each with the place of its point (n, Z) in the plane by t-SNE."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        fail("t-SNE needs scikit-learn: pip install scikit-learn")
    places = TSNE(random_state=0).fit_transform(points).tolist()
    return [(*label, x, y) for label, (x, y) in zip(labels, places)]


def figure_6(episodes, numbers=range(10)):
    """z by N, encoder by encoder, with crowds and without."""
    dots, drifts = [], []
    for encoder, crowd in itertools.product(("lrn", "rn", "attn"), ("", "-nocrowd")):
        group = f"push-{encoder}-n2{crowd}"
        z = {N: record(group, N, episodes, Agent.encode) for N in numbers}
        clouds = {N: some(z[N].reshape(-1, z[N].shape[-1]), POINTS) for N in numbers}
        drifts += [(group, N, energy_distance(clouds[N], clouds[2])) for N in numbers]
        if not crowd:
            samples = {N: some(moments(z[N]), POINTS // len(numbers)) for N in numbers}
            labels = [(encoder, N) for N in numbers for _ in samples[N]]
            dots += embedded(labels, np.concatenate(list(samples.values())))
    write("figure6.csv", ("encoder", "distractors", "x", "y"), dots)
    write("figure6-drift.csv", ("group", "distractors", "distance"), drifts)


def figure_7(episodes, numbers=range(3, 7)):
    """LRN's relations by kind, in the plane."""
    points, labels = [], []
    for N in numbers:
        r = moments(record("push-lrn-n2", N, episodes, relations_of))      # (n, K, D)
        r = some(r, POINTS // (len(numbers) * r.shape[1]))     # as many points at every N, about
        points += list(r.reshape(-1, r.shape[-1]))
        labels += [(kind,) for kind in (*KINDS, *["distractors"] * N)] * len(r)
    write("figure7.csv", ("kind", "x", "y"), embedded(labels, np.array(points)))


def figure_8(episodes):
    """Lengths of LRN's relations by kind over an episode at N = 5; of distractors, their mean."""
    rows, N = [], 5
    for group in LRN_GROUPS:
        r = record(group, N, episodes, relations_of)           # (steps, E, K, D)
        lengths = np.linalg.norm(r, axis=-1).mean(axis=1)      # (steps, K)
        for step, row in enumerate(lengths.tolist(), 1):
            rows.append((group, step / 25, *row[:4], sum(row[4:]) / N))     # 25 Hz
    write("figure8.csv", ("group", "seconds", *KINDS, "distractors"), rows)


def figure_relations(episodes):
    """What a distractor adds to LRN's sum, in every run with and without crowds."""
    rows = []
    for group in LRN_GROUPS:
        for run in sorted(glob.glob(os.path.join(HERE, "runs", f"{group}-seed*"))):
            checkpoint, agent = load(run)
            share = distractors_share(agent, starts(checkpoint, 9, episodes)).item()
            rows.append((os.path.basename(run), share))
    write("figurerelations.csv", ("run", "share"), rows)


def main():
    parser = argparse.ArgumentParser(description="Look inside agents (see the top of inside.py).")
    parser.error = fail
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN")
    add("--distractors", type=evaluate.numbers, default=[0, 2, 5, 9], metavar="LIST",
        help="N of the table, default 0,2,5,9")
    add("--crowd", type=evaluate.numbers, metavar="LIST", help="sizes of crowds, as 10-15")
    add("--episodes", type=int, default=200, metavar="E", help="default 200")
    add("--figures", action="store_true", help="write the CSVs of these figures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    try:
        for run in args.runs:
            print_table(run, args)
        if args.figures:
            for figure in (figure_relations, figure_8, figure_7, figure_6):    # quick ones first
                figure(args.episodes)
    except ValueError as error:
        fail(str(error))


if __name__ == "__main__":
    main()
