"""Train an agent with PPO on PushingCube or LiftingCube (the paper's sections 3.1 and 4.1, A.2).

    python train.py --encoder lrn                          LRN, PushingCube, 2 distractors
    python train.py --encoder attn --task lift --seed 3    in runs/lift-attn-n2-seed3
    python train.py --encoder lrn --resume                 go on, bit for bit as if never stopped
    python train.py --encoder lrn --paper --out runs/paper             the paper's numbers
    python train.py --encoder lrn --set z_dim=50 --out runs/z50        any of SETTINGS, by name
    torchrun --nproc-per-node 2 train.py --encoder rn      with --nnodes on several machines with
                                                           a common disk (on one: --ranks)

Data flow: observation -> a small MLP per type -> objects (B, K, D), goal (B, D) -> encoder
           -> z (B, Z) -> heads: mean (B, 9), value (B,)
A run folder holds checkpoint.pt, progress.csv (one row per update) and timing.csv (the columns
that depend on the machine).
"""
import argparse
import copy
import csv
import math
import os
import signal
import socket
import sys
import time
from datetime import timedelta
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import nn

from attn import ATTN
from lrn import LRN, LRNMax, orthogonal
from ppo import PPO
from rn import RN
from trifinger_env import (CUBE_WIDTH, FINGER_WIDTH, FINGERTIP, GOAL_WIDTH, IDENTIFIER,
                           IDENTIFIER_POOL, LINEAR, POSITION, SOLVED, TIME, TriFingerEnv)


class Setting(NamedTuple):
    default: Any
    paper: Any                           # what `--paper` sets
    why: str                             # source, and why the two differ


# A.1, A.2: printed in the paper's appendix. CW: not printed, from CausalWorld's training script;
# rlpyt: not printed, from the PPO library that the paper uses.
SETTINGS = {
    # The run
    "frames": Setting(3_000_000, 60_000_000, "environment steps in all; B.3 names 50 M, CW 60 M"),
    "envs": Setting(32, 48, "environments in all; CW: 20 x 6000 = 48 x 2500 steps a batch"),
    "steps": Setting(125, 2500, "T, steps of a rollout: one episode"),
    # The environment
    "episode_steps": Setting(125, 2500, "5 s, not 30 s (4.1): more episodes show more goals"),
    "substeps": Setting(5, 3, "25 Hz, not 83.3 (4.1, CW): held longer, noisy actions move more"),
    "timestep": Setting(0.008, 0.004, "s, of a physics step; CW: 0.004; 8 ms are sound (tested)"),
    "action_mode": Setting("integrated", "absolute", "targets that last keep a grip; CW: absolute"),
    "action_scale": Setting(0.1, 0.1, "rad, largest step of a joint target; absolute: not used"),
    "cube_mass": Setting(0.08, 0.02, "kg; CW's pushing and picking tasks: 0.02"),
    "finger_friction": Setting(1.0, 0.1, "IsaacGymEnvs; CW: 0.1, which holds no 0.08 kg"),
    "goal_yaw": Setting(0.0, math.pi / 4, "largest yaw, rad; 0: only the place counts (4.1: pose)"),
    "reward_overlap": Setting(100.0, 100.0, "alpha_1 (A.1)"),
    "reward_distance": Setting(5000.0, 250.0, "alpha_2 (A.1): 2 mm are worth 0.5; CW: 2500"),
    "reward_curiosity": Setting(0.0, 10.0, "alpha_3 (A.1): a penalty, smaller for a fast cube"),
    "reward_reach": Setting(2500.0, 0.0, "ours: fingertips to the cube, as in CW's script"),
    # PPO
    "lr": Setting(2e-3, 2.5e-4, "A.2; ours learns in fewer frames"),
    "lr_power": Setting(1.0, 1.0, "lr falls as (share of training left) ^ this; A.2: linearly"),
    "clip": Setting(0.2, 0.5, "A.2; ours as usual in PPO, and in CW"),
    "anneal_clip": Setting(False, True, "rlpyt anneals the clip range as it does lr"),
    "epochs": Setting(3, 4, "A.2; ours: fewer cost less time"),
    "minibatches": Setting(8, 40, "A.2; of 500 samples here, of 3000 with CW's batch"),
    "discount": Setting(0.98, 0.98, "A.2; at 25 Hz it looks 2 s ahead, at 83.3 Hz 0.6 s"),
    "lam": Setting(0.95, 0.95, "A.2"),
    "entropy": Setting(0.001, 0.01, "A.2; with normalised advantages 0.01 lets std grow"),
    "value_coef": Setting(0.5, 0.5, "A.2"),
    "max_grad_norm": Setting(0.5, 0.5, "A.2"),
    "adam_eps": Setting(1e-5, 1e-8, "rlpyt: 1e-8; ours as usual in PPO"),
    "normalize_advantages": Setting(True, False, "rlpyt: off; ours as usual in PPO"),
    "normalize_values": Setting(True, False, "or large returns drown the policy loss"),
    "auxiliary": Setting(30.0, 0.0, "ours: weight of the read-out loss, see Agent.auxiliary"),
    # The networks
    "token_dim": Setting(64, 128, "D; not printed; 64 takes half the time of our guess"),
    "z_dim": Setting(25, 25, "Z (section 5)"),
    "hidden": Setting(128, 128, "width of token MLPs and heads; a guess; CW: 256"),
    "heads": Setting(4, 4, "of ATTN; not printed: a guess"),
    "relations": Setting(True, True, "False: LRN without relations (figure 5)"),
    "layer_norm": Setting(True, True, "False: LRN with a mean instead (figure 5)"),
    "log_std": Setting(-0.7, 0.0, "log std of actions at the start; rlpyt: 0; -1 learns later"),
}
# LiftingCube takes longer, most of its score comes while the learning rate is small, and noise
# costs it more.
LIFT_SETTINGS = {"frames": 6_000_000, "lr_power": 2.0, "log_std": -1.0}
DEFAULTS = {name: setting.default for name, setting in SETTINGS.items()}
ENV_SETTINGS = ("episode_steps", "substeps", "timestep", "action_mode", "action_scale",
                "cube_mass", "finger_friction", "goal_yaw")
PPO_SETTINGS = ("steps", "epochs", "minibatches", "lr", "adam_eps", "clip", "discount", "lam",
                "entropy", "value_coef", "max_grad_norm", "lr_power", "anneal_clip",
                "normalize_advantages", "normalize_values", "auxiliary")

# A row of progress.csv: means over the episodes that ended in an update's rollout, with sampled
# actions (episodes, cut_short: counts). success_aabb is the environment's fractional_success, rho,
# at the last step, success_strict the same by true volumes, solved the share with rho >= 0.8. The
# columns from std on are of the learner.
PROGRESS = ("update", "frames", "episodes", "return", "length", "success_aabb", "success_strict",
            "solved", "cut_short", "std", "approx_kl", "clip_fraction", "explained_variance",
            "policy_loss", "value_loss", "auxiliary_loss", "entropy", "grad_norm", "lr")
TIMING = ("update", "frames", "seconds", "frames_per_second", "rollout_share")

# ---- the agent

POOL = torch.tensor(IDENTIFIER_POOL, dtype=torch.float32)
FACTS = 3 + 3 + 3 + 9                    # what the read-out reads from z, see Agent.auxiliary


def mlp(*widths, last_gain=math.sqrt(2)):
    """ReLU network through the given widths; orthogonal weights, zero biases, last layer linear."""
    gains = [math.sqrt(2)] * (len(widths) - 2) + [last_gain]
    layers = []
    for width, next_width, gain in zip(widths, widths[1:], gains):
        layers += [orthogonal(nn.Linear(width, next_width), gain), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class ConcatMLP(nn.Sequential):
    """The paper's naive baseline (figure 1, right): one MLP on the concatenated observation -> z.

    Its first layer has a fixed width, so it works at the N it was built for; ValueError at others.
    The paper says no more of it; two hidden layers and the LayerNorm are our choice.
    """

    def __init__(self, distractors, z_dim, hidden):
        width = CUBE_WIDTH * (distractors + 1) + FINGER_WIDTH * 3 + GOAL_WIDTH
        super().__init__(mlp(width, 2 * hidden, 2 * hidden, z_dim), nn.LayerNorm(z_dim))
        self.distractors = distractors

    def forward(self, obs):
        got = obs["cubes"].shape[1] - 1
        if got != self.distractors:
            raise ValueError(f"an mlp agent has a fixed input: it was trained with "
                             f"{self.distractors} distractors and cannot be used with {got}")
        return super().forward(torch.cat([value.flatten(1) for value in obs.values()], dim=1))


# Name -> class and the settings that it takes. To add your own encoder, add a line: any module
# with forward(objects (B, K, D), goal (B, D)) -> z (B, Z). (The MLP alone takes the observation.)
ENCODERS = {
    "lrn": (LRN, ("token_dim", "z_dim", "relations", "layer_norm")),
    "lrn-max": (LRNMax, ("token_dim", "z_dim")),
    "rn": (RN, ("token_dim", "z_dim")),
    "attn": (ATTN, ("token_dim", "z_dim", "heads")),
    "mlp": (ConcatMLP, ("distractors", "z_dim", "hidden")),
}


class Agent(nn.Module):
    """The paper's scaffold (section 3.1): an MLP per object type, an encoder, heads.

    obs {"cubes" (B, N+1, 18), "fingers" (B, 3, 10), "goal" (B, 12)}
    -> mean (B, 9), log_std (9,), value (B,)

    `encoder` is a name in ENCODERS; `distractors` is N in training; only "mlp" is built for it.
    """

    def __init__(self, encoder, distractors, settings):
        super().__init__()
        D, Z, hidden = settings["token_dim"], settings["z_dim"], settings["hidden"]
        self.kind, self.distractors = encoder, distractors     # kind: the name in ENCODERS
        if encoder != "mlp":
            self.cube = mlp(CUBE_WIDTH, hidden, D)
            self.finger = mlp(FINGER_WIDTH, hidden, D)
            self.goal = mlp(GOAL_WIDTH, hidden, D)
        make, names = ENCODERS[encoder]
        known = {**settings, "distractors": distractors}
        self.encoder = make(**{name: known[name] for name in names})
        self.policy = mlp(Z, hidden, hidden, 9, last_gain=0.01)
        self.value = mlp(Z, hidden, hidden, 1, last_gain=1.0)
        self.read_out = mlp(Z, hidden, FACTS)
        self.log_std = nn.Parameter(torch.full((9,), settings["log_std"]))

    def tokens(self, obs):
        """Objects (B, K, D), first the cubes, then the fingers, and the goal (B, D)."""
        cubes = self.cube(obs["cubes"])                        # (B, N+1, D)
        fingers = self.finger(obs["fingers"])                  # (B, 3, D)
        return torch.cat([cubes, fingers], dim=1), self.goal(obs["goal"])

    def encode(self, obs):
        """z (B, Z)."""
        if self.kind == "mlp":
            return self.encoder(obs)
        objects, goal = self.tokens(obs)
        return self.encoder(objects, goal)

    def forward(self, obs):
        z = self.encode(obs)
        return self.policy(z), self.log_std, self.value(z).squeeze(-1)

    def auxiliary(self, obs):
        """Read-out loss (ours): how well z tells what the task is about, in scaled units.

        A small head reads FACTS numbers from z: the target cube's position and velocity, the goal's
        position and the three fingertips; the loss is their mean squared error. A batch holds few
        episodes, so few answers to "which cube is meant?". Hence the question is asked anew: every
        sample gets fresh identifiers, a random cube as target and a goal from the shuffled batch.
        """
        cubes, goal = obs["cubes"].clone(), obs["goal"]
        B, count = cubes.shape[:2]
        rows, target = torch.arange(B), torch.randint(count, (B,))
        shuffled = torch.rand(B, len(POOL)).argsort(dim=1)
        identifiers = POOL[shuffled[:, :count]]                # (B, count), distinct in a row
        goal = goal[torch.randperm(B)]                         # a copy, as indexing makes one
        cubes[..., IDENTIFIER] = identifiers
        goal[:, IDENTIFIER] = identifiers[rows, target]
        z = self.encode({"cubes": cubes, "fingers": obs["fingers"], "goal": goal})
        meant = cubes[rows, target]                            # (B, CUBE_WIDTH)
        tips = obs["fingers"][..., FINGERTIP].flatten(1)       # (B, 9)
        facts = torch.cat([meant[:, POSITION], meant[:, LINEAR], goal[:, POSITION], tips], dim=1)
        return (self.read_out(z) - facts).square().mean()


# ---- environments and seeds

def make_env(task, distractors, settings, render_mode=None):
    """The environment of a run."""
    prefix = "reward_"
    weights = {name.removeprefix(prefix): value for name, value in settings.items()
               if name.startswith(prefix)}
    options = {name: settings[name] for name in ENV_SETTINGS}
    return TriFingerEnv(task, distractors, reward_weights=weights, render_mode=render_mode,
                        **options)


def derived_seed(*numbers):
    """One seed from several numbers, such as (run's seed, update, stream).

    Sums like seed + update would make seed 1 repeat seed 0 one update later; SeedSequence mixes
    the numbers. (It reads missing ones as 0: compare tuples of one length only.)
    """
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


# ---- files of a run

def checkpoint_file(path):
    """The checkpoint of a run folder; a file is one itself."""
    return os.path.join(path, "checkpoint.pt") if os.path.isdir(path) else path


def load(path):
    """Checkpoint dict of a file or run folder, and its agent.

    A setting that the checkpoint lacks takes its default. ValueError in one line if it is not a
    checkpoint of ours.
    """
    path = checkpoint_file(path)
    try:
        checkpoint = torch.load(path, weights_only=True, map_location="cpu")
        for key in ("task", "seed", "ranks", "update", "frames", "seconds"):   # others: below
            if key not in checkpoint:
                raise KeyError(key)
        checkpoint["settings"] = {**DEFAULTS, **checkpoint["settings"]}
        if checkpoint["encoder"] not in ENCODERS:
            raise ValueError(f"train.ENCODERS has no {checkpoint['encoder']!r}")
        agent = Agent(checkpoint["encoder"], checkpoint["distractors"], checkpoint["settings"])
        agent.load_state_dict(agent_weights(checkpoint["learner"]))
    except Exception as error:           # torch.load raises many kinds; the user needs one line
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path} is not a readable checkpoint of train.py "
                         f"({type(error).__name__}: {reason})") from None
    if not all(torch.isfinite(value).all() for value in checkpoint["learner"].values()):
        raise ValueError(f"{path} holds weights that are not finite")
    return checkpoint, agent.eval()      # for an encoder of your own, with dropout, say


def agent_weights(learner_weights):
    """The agent's part of a learner's state dict."""
    return {name.removeprefix("agent."): value for name, value in learner_weights.items()
            if name.startswith("agent.")}


def save(checkpoint, path):
    """Write a checkpoint so that a crash leaves the old or the new one, never half of it."""
    with open(path + ".tmp", "wb") as file:
        try:
            torch.save(checkpoint, file)
        except RuntimeError as error:    # torch's own, raised on the way out of a Ctrl-C
            if isinstance(error.__context__, KeyboardInterrupt):
                raise error.__context__ from None
            raise
        file.flush()
        os.fsync(file.fileno())
    os.replace(path + ".tmp", path)


def keep_rows(path, columns, update):
    """Cut a CSV back to its header and the rows up to `update`: a resumed run has no doubles."""
    rows = []
    if os.path.exists(path):
        with open(path, newline="") as file:
            for row in csv.reader(file):
                is_whole = len(row) == len(columns) and row[0].isdigit()
                if is_whole and int(row[0]) <= update:
                    rows.append(row)
    with open(path + ".tmp", "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])
    os.replace(path + ".tmp", path)


def add_row(path, columns, row):
    """Append one row (a dict) to a CSV."""
    line = [row[key] if isinstance(row[key], (int, str)) else f"{row[key]:.6g}" for key in columns]
    with open(path, "a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(line)


class Run:
    """The folder of a run and how far it has come; rank 0 alone writes to it."""

    def __init__(self, args, settings, learner):
        self.args, self.settings, self.learner = args, settings, learner
        self.update, self.seconds = 0, 0.0
        self.frames_per_update = settings["envs"] * settings["steps"]
        self.last_update = math.ceil(settings["frames"] / self.frames_per_update)
        self.saved_at = time.monotonic()
        self.saved_update = None         # that of the checkpoint in the folder

    def path(self, name):
        return os.path.join(self.args.out, name)

    def restore(self):
        """Take up weights, optimiser and counters from the last checkpoint."""
        checkpoint, _ = load(self.args.out)
        self.learner.load_state_dict(checkpoint["learner"])
        self.learner.optimizer.load_state_dict(checkpoint["optimizer"])
        self.update, self.seconds = checkpoint["update"], checkpoint["seconds"]
        self.saved_update = self.update

    def checkpoint(self):
        """All that is needed to go on. The random state of a run is its seed and its update."""
        return {
            "encoder": self.args.encoder,
            "task": self.args.task,
            "distractors": self.args.distractors,
            "seed": self.args.seed,
            "ranks": self.args.ranks,
            "settings": self.settings,
            "update": self.update,
            "frames": self.update * self.frames_per_update,
            "seconds": self.seconds,
            "learner": self.learner.state_dict(),
            "optimizer": self.learner.optimizer.state_dict(),
        }

    def save(self, checkpoint):
        """Replace the run's checkpoint, and remove scores: they are of the weights before."""
        if checkpoint["update"] == self.saved_update:          # stopped before anything was learned
            return
        for name in ("zeroshot.csv", "zeroshot-sampled.csv"):
            if os.path.exists(self.path(name)):
                os.remove(self.path(name))
        save(checkpoint, self.path("checkpoint.pt"))
        self.saved_at, self.saved_update = time.monotonic(), checkpoint["update"]

    def open_files(self):
        """Make the folder ready: a run can be resumed from its first moment on."""
        if not self.args.resume:
            self.save(self.checkpoint())
        keep_rows(self.path("progress.csv"), PROGRESS, self.update)
        keep_rows(self.path("timing.csv"), TIMING, self.update)

    def is_due(self):
        """Is it time for a checkpoint?"""
        return time.monotonic() - self.saved_at > self.args.save_minutes * 60

    def write(self, row, elapsed, rollout_seconds):
        """Add this update's rows to the CSVs and print its line."""
        row = {"update": self.update, "frames": self.update * self.frames_per_update, **row}
        speed = self.frames_per_update / elapsed
        add_row(self.path("progress.csv"), PROGRESS, row)
        add_row(self.path("timing.csv"), TIMING, {
            "update": self.update,
            "frames": row["frames"],
            "seconds": f"{self.seconds:.2f}",
            "frames_per_second": f"{speed:.0f}",
            "rollout_share": f"{rollout_seconds / elapsed:.3f}",
        })
        minutes_left = (self.last_update - self.update) * elapsed / 60
        print(f"update {self.update}/{self.last_update} "
              f"frames {row['frames']}/{self.last_update * self.frames_per_update} "
              f"frames/s {speed:.0f} return {row['return']:.1f} "
              f"success {row['success_aabb']:.3f} strict {row['success_strict']:.3f} "
              f"solved {row['solved']:.2f} cut_short {row['cut_short']} "
              f"kl {row['approx_kl']:.4f} clipped {row['clip_fraction']:.2f} "
              f"explained {row['explained_variance']:.2f} std {row['std']:.2f} "
              f"eta {minutes_left:.0f}min", flush=True)


# ---- training
#
# Rank 0 is the process that the user started. It alone writes files, prints, and catches Ctrl-C and
# SIGTERM; the other ranks ignore Ctrl-C, and rank 0 ends them. (Under torchrun that starts and ends
# all of them.)

STOPPED = 130                            # exit status after a Ctrl-C, as shells have it
NOISE_STREAM = 10 ** 6                   # stream e < 10^6: environment e; 10^6 + r: torch on rank r


def join_ranks(ranks):
    """Rank of this process, after the ranks have found each other."""
    torch.set_num_threads(1)
    if ranks > 1:
        dist.init_process_group("gloo", timeout=timedelta(minutes=10))
    return int(os.environ["RANK"]) if ranks > 1 else 0


def leave_ranks(ranks, stopped):
    """Leave together, so that nobody waits for a rank that is gone.

    A stop does not return: it ends this process, with the status of a Ctrl-C, and the others.
    """
    if ranks == 1 and stopped:
        sys.exit(STOPPED)
    if ranks == 1:
        return
    if stopped:
        for other in mp.active_children():
            other.kill()
    else:
        dist.barrier()
        dist.destroy_process_group()
    sys.stdout.flush()
    os._exit(STOPPED if stopped else 0)  # python's own shutdown may meet gloo's threads and abort


def catch_signals(rank):
    """Ctrl-C and SIGTERM become a KeyboardInterrupt in rank 0, which ends the run for all."""
    if rank == 0:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    else:                                # Ctrl-C reaches every process of a terminal
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def make_learner(args, settings):
    """PPO with its agent and this rank's environments; every rank starts from the same weights."""
    torch.manual_seed(args.seed)
    agent = Agent(args.encoder, args.distractors, settings)
    envs = [make_env(args.task, args.distractors, settings)
            for _ in range(settings["envs"] // args.ranks)]
    return PPO(agent, envs, **{name: settings[name] for name in PPO_SETTINGS})


def reseed(seed, update, rank, count):
    """Set torch's generator and return one seed per environment of this rank.

    All randomness of an update follows from (seed, update, stream): that is the whole random
    state of a run, so it resumes exactly.
    """
    torch.manual_seed(derived_seed(seed, update, NOISE_STREAM + rank))
    return [derived_seed(seed, update, rank * count + e) for e in range(count)]


EPISODE_SUMS = ("episodes", "return", "length", "success_aabb", "success_strict", "solved",
                "cut_short")


def episode_sums(episodes):
    """Sums over episodes (7,), in the order of EPISODE_SUMS."""
    rows = [[1.0, episode["return"], episode["length"],
             episode["info"]["fractional_success"], episode["info"]["fractional_success_strict"],
             episode["info"]["fractional_success"] >= SOLVED,
             episode["info"]["truncated_by"] != TIME] for episode in episodes]
    return torch.tensor(rows).sum(dim=0)


def summarize(sums):
    """Columns of progress.csv about the episodes of all ranks: means, but for two sums."""
    total = dict(zip(EPISODE_SUMS, sums.tolist()))
    means = dict(zip(EPISODE_SUMS, (sums / sums[0]).tolist()))
    return {**means, "episodes": int(total["episodes"]), "cut_short": int(total["cut_short"])}


def one_update(run, rank):
    """Play a batch, learn from it, and (rank 0) write down what came of it."""
    learner = run.learner
    begin = time.monotonic()
    seeds = reseed(run.args.seed, run.update, rank, len(learner.envs))
    episodes = learner.rollout(seeds)
    rollout_seconds = time.monotonic() - begin
    try:
        stats = learner.update(remaining=1 - run.update / run.last_update)
    except FloatingPointError as error:                        # on every rank alike: one says so
        if rank > 0:
            sys.exit(1)
        fail(f"update {run.update + 1}: {error}; the last checkpoint stays as it was", status=1)
    sums = episode_sums(episodes)
    if dist.is_initialized():
        dist.all_reduce(sums)
    elapsed = time.monotonic() - begin
    run.update += 1
    run.seconds += elapsed
    if rank == 0:
        std = learner.agent.log_std.exp().mean().item()
        run.write({**summarize(sums), "std": std, **stats}, elapsed, rollout_seconds)
        if run.update == run.last_update or run.is_due():
            run.save(run.checkpoint())


def train(args, settings):
    """Train on this rank until all frames are played or a signal stops the run.

    A stop does not wait for the update under way, which can take minutes with --paper: it is given
    up, and the run is saved as it was before it.
    """
    before = None
    try:
        rank = join_ranks(args.ranks)
        catch_signals(rank)
        learner = make_learner(args, settings)
        run = Run(args, settings, learner)
        if args.resume:                  # every rank reads the file: spawn would share the tensors
            run.restore()
        if rank == 0:
            run.open_files()
        before = copy.deepcopy(run.checkpoint())
        while run.update < run.last_update:
            one_update(run, rank)
            before = copy.deepcopy(run.checkpoint())
    except KeyboardInterrupt:            # in rank 0 alone
        if before is None:
            print("stopped before any update of this call")
            leave_ranks(args.ranks, stopped=True)              # does not return
        run.save(before)
    stopped = before["update"] < run.last_update
    if rank == 0:
        print(f"{'stopped' if stopped else 'finished'} after {before['update']} updates, "
              f"{before['seconds'] / 60:.1f} minutes: {run.path('checkpoint.pt')}")
    leave_ranks(args.ranks, stopped)


# ---- the command line

def fail(message, status=2):
    """End with one line and a status: 2 for bad input, as argparse does."""
    print(f"{os.path.basename(sys.argv[0])}: error: {message}", file=sys.stderr)
    sys.exit(status)


def positive(text):
    """An integer >= 1, as argparse's `type`."""
    number = int(text)
    if number < 1:
        raise ValueError
    return number


def minutes(text):
    """A number >= 0, as argparse's `type`."""
    number = float(text)
    if not 0 <= number < math.inf:
        raise ValueError
    return number


def read_command(argv=None):
    """The command's arguments, with the run folder and torchrun's ranks filled in."""
    parser = argparse.ArgumentParser(
        description="Train an agent with PPO (see the first lines of train.py).")
    parser.error = fail
    add = parser.add_argument
    add("--encoder", choices=ENCODERS, default="lrn",
        help="lrn-max is LRN with a maximum in place of the sum (default lrn)")
    add("--task", choices=("push", "lift"), default="push",
        help="PushingCube or LiftingCube (default push)")
    add("--distractors", type=int, default=2, metavar="N",
        help="cubes besides the target (default 2)")
    add("--seed", type=int, default=0, metavar="S",
        help="fixes every random number of the run (default 0)")
    add("--frames", type=int, metavar="F",
        help="environment steps in all, rounded up to whole updates "
             f"(default {DEFAULTS['frames']}, lift {LIFT_SETTINGS['frames']}, "
             f"--paper {SETTINGS['frames'].paper})")
    add("--out", metavar="DIR", help="run folder (default runs/TASK-ENCODER-nN-seedS)")
    add("--paper", action="store_true",
        help="the paper's numbers; where it prints none, its sources' or a guess")
    add("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE",
        help="change some of SETTINGS")
    add("--resume", action="store_true",
        help="go on from the run folder's checkpoint; repeat --encoder, --task, --distractors, "
             "--seed and --out")
    add("--overwrite", action="store_true", help="start anew in a folder that holds a run")
    add("--ranks", type=int, metavar="R",
        help="processes, ignored under torchrun (default one per core, or fewer if environments "
             "and batch ask for it)")
    add("--save-minutes", type=minutes, default=3.0, metavar="M",
        help="minutes between checkpoints (default 3)")
    args = parser.parse_args(argv)
    if args.out is None:
        name = f"{args.task}-{args.encoder}-n{args.distractors}-seed{args.seed}"
        args.out = os.path.join("runs", name)
    if not 0 <= args.seed < 2 ** 32:
        fail(f"--seed must be an integer from 0 to 2^32 - 1, got {args.seed}")
    if args.resume and args.overwrite:
        fail("--resume goes on with a run, --overwrite starts anew: give one of them")
    if dist.is_torchelastic_launched():                        # by torchrun
        args.ranks = int(os.environ["WORLD_SIZE"])
    return args


def read_settings(args):
    """SETTINGS, the paper's or the default ones, with the command's changes."""
    settings = {name: setting.paper if args.paper else setting.default
                for name, setting in SETTINGS.items()}
    if args.task == "lift" and not args.paper:
        settings.update(LIFT_SETTINGS)
    for item in args.set:
        name, _, text = item.partition("=")
        if name not in SETTINGS:
            fail(f"--set {item}: no such setting; the names are {', '.join(SETTINGS)}")
        refuse_if_without_effect(name, args.encoder)
        settings[name] = read_value(name, text, f"--set {item}")
    if args.frames is not None:
        settings["frames"] = read_value("frames", str(args.frames), f"--frames {args.frames}")
    return settings


def refuse_if_without_effect(name, encoder):
    """Settings of one encoder do nothing to another: say so instead of ignoring them."""
    takers = [kind for kind, (_, names) in ENCODERS.items() if name in names]
    if name == "token_dim":                                    # of whatever looks at tokens
        takers = [kind for kind in ENCODERS if kind != "mlp"]
    if name == "hidden":                                       # of the heads, too
        takers = list(ENCODERS)
    if takers and encoder not in takers:
        fail(f"--set {name}: without effect on {encoder}; it is a setting of {', '.join(takers)}")


def read_value(name, text, where):
    """A setting's value from text; it has the type of the default."""
    kind = type(SETTINGS[name].default)
    if kind is bool:
        if text not in ("True", "False"):
            fail(f"{where}: expected True or False")
        return text == "True"
    try:
        value = kind(text)
    except ValueError:
        fail(f"{where}: expected {name}=<{kind.__name__}>")
    if kind is int and value < 1:
        fail(f"{where}: expected an integer >= 1")
    if kind is float:
        may_be_negative = name.startswith("reward_") or name == "log_std"
        if not math.isfinite(value):
            fail(f"{where}: expected a finite number")
        if value < 0 and not may_be_negative:
            fail(f"{where}: expected a number >= 0")
        if value > 1 and name in ("discount", "lam"):
            fail(f"{where}: expected a number from 0 to 1")
        if abs(value) > 20 and name == "log_std":              # far beyond, exp() is infinite
            fail(f"{where}: expected a number from -20 to 20")
    return value


def check_resume(args, settings):
    """The settings of the run to go on with; fails if the command asks for another run."""
    file = os.path.join(args.out, "checkpoint.pt")
    try:
        checkpoint, _ = load(file)
    except ValueError as error:
        fail(f"--resume: {error}")
    if "optimizer" not in checkpoint:
        fail(f"--resume: {file} holds weights without the optimiser: it can be evaluated only")
    for name in ("encoder", "task", "distractors", "seed"):
        if checkpoint[name] != getattr(args, name):
            fail(f"--resume: {file} is a run with --{name} {checkpoint[name]}, "
                 f"not {getattr(args, name)}")
    started_with = checkpoint["settings"]
    changed = [f"{name}={started_with[name]}" for name in settings
               if settings[name] != started_with[name]]
    # Without settings --resume takes the run's own; a command with some must give all of them.
    if changed and (args.set or args.paper or args.frames is not None):
        fail(f"--resume: {file} was started with other settings: {', '.join(changed)}")
    if args.ranks not in (None, checkpoint["ranks"]):
        fail(f"--resume: {file} is a run on {checkpoint['ranks']} ranks, with {args.ranks} it "
             f"would become another run")
    args.ranks = checkpoint["ranks"]
    return started_with


def check_folder(args):
    """Fail if the run folder holds a run already."""
    rows = os.path.join(args.out, "progress.csv")
    # An empty progress.csv is what check_parts() leaves.
    has_rows = os.path.exists(rows) and os.path.getsize(rows) > 0
    has_checkpoint = os.path.exists(os.path.join(args.out, "checkpoint.pt"))
    if (has_rows or has_checkpoint) and not args.overwrite:
        fail(f"--out {args.out} already holds a run: add --resume to go on, --overwrite to start "
             f"anew, or choose another --out")


def cores():
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):                       # fewer than there are on a cluster
        return len(os.sched_getaffinity(0))
    return os.cpu_count()


def choose_ranks(settings):
    """One rank per core, or as many as divide environments and batch."""
    def divide(ranks):
        envs, rest = divmod(settings["envs"], ranks)
        return rest == 0 and envs * settings["steps"] % settings["minibatches"] == 0

    return max(filter(divide, range(1, cores() + 1)), default=1)


def check_parts(args, settings):
    """Let environment, agent and learner check their own arguments, and the folder be made."""
    if args.ranks < 1 or settings["envs"] % args.ranks:
        fail(f"--ranks {args.ranks} must divide the number of environments, {settings['envs']}")
    if settings["steps"] < settings["episode_steps"]:
        fail(f"rollouts of steps={settings['steps']} never see the end of an episode of "
             f"episode_steps={settings['episode_steps']}")
    try:
        make_env(args.task, args.distractors, settings).close()
        agent = Agent(args.encoder, args.distractors, settings)
        PPO(agent, [None] * (settings["envs"] // args.ranks), steps=settings["steps"],
            minibatches=settings["minibatches"])
    except ValueError as error:
        fail(str(error))
    try:
        os.makedirs(args.out, exist_ok=True)
        open(os.path.join(args.out, "progress.csv"), "a").close()
    except OSError as error:
        fail(f"--out {args.out} cannot be written: {error.strerror}")


def parse(argv=None):
    """Check everything that can be wrong before any process starts. Returns (args, settings)."""
    args = read_command(argv)
    settings = read_settings(args)
    if args.resume:
        settings = check_resume(args, settings)
    else:
        check_folder(args)
    if args.ranks is None:
        args.ranks = choose_ranks(settings)
    check_parts(args, settings)
    return args, settings


def start_rank(index, *arguments):
    """One of the ranks 1, 2, ...; rank 0 is the process that starts them."""
    os.environ["RANK"] = str(index + 1)
    train(*arguments)


def main():
    args, settings = parse()
    if dist.is_torchelastic_launched() or args.ranks == 1:
        return train(args, settings)
    with socket.socket() as probe:       # a free port for the ranks to meet at
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    os.environ.update(RANK="0", WORLD_SIZE=str(args.ranks), MASTER_ADDR="127.0.0.1",
                      MASTER_PORT=str(port))
    signal.signal(signal.SIGINT, signal.SIG_IGN)               # the others inherit it
    others = mp.start_processes(start_rank, (args, settings), args.ranks - 1, join=False,
                                daemon=True, start_method="spawn")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        train(args, settings)
    except RuntimeError as error:        # a rank that is gone breaks the others' connections
        try:
            others.join(timeout=10)      # not for ever: the error may be rank 0's own
        except mp.ProcessExitedException as exited:            # killed from outside
            fail(f"{exited}, so the run ends here; --resume goes on from the last checkpoint",
                 status=1)
        raise error


if __name__ == "__main__":
    main()
