"""Train an agent with PPO on PushingCube or LiftingCube (the paper's sections 3.1 and 4.1, A.2).

    python train.py --encoder lrn                          LRN, PushingCube, 2 distractors
    python train.py --encoder attn --task lift --seed 3    in runs/lift-attn-n2-seed3
    python train.py --resume runs/push-lrn-n2-seed0        go on, bit for bit as if never stopped
    python train.py --encoder lrn --paper --out runs/paper             the paper's numbers
    python train.py --encoder lrn --set z_dim=50 --out runs/z50        any of SETTINGS, by name
    torchrun --standalone --nproc-per-node 2 train.py --encoder rn     two processes, one gradient

Data flow: observation -> a small MLP per type -> objects (B, K, D), goal (B, D) -> encoder
           -> z (B, Z) -> heads: mean (B, 9), value (B,)
A run folder holds progress.csv, one row per update, and checkpoint.pt, saved after every update.
"""
import argparse
import contextlib
import fcntl
import math
import os
import sys
import time
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.distributed as dist
from torch import nn

from attn import ATTN
from lrn import LRN, LRNMax, LRNMean, LRNObjects, LRNTokens, orthogonal
from ppo import PPO
from rn import RN
from trifinger_env import (CUBE_WIDTH, FINGER_WIDTH, FINGERTIP, GOAL_WIDTH, IDENTIFIER,
                           IDENTIFIER_POOL, LINEAR, POSITION, REWARD_WEIGHTS, SOLVED, TIME,
                           TriFingerEnv)


class Setting(NamedTuple):
    default: Any
    paper: Any                           # what `--paper` sets
    why: str                             # source, and why the two differ


# A.1, A.2: printed in the paper's appendix. CW: not printed, from CausalWorld's training script;
# rlpyt: not printed, from the PPO library that the paper uses.
RUN = {
    "frames": Setting(3_000_000, 60_000_000, "environment steps in all; B.3 names 50 M, CW 60 M"),
    "envs": Setting(32, 48, "environments in all; CW: 20 x 6000 = 48 x 2500 steps a batch"),
}
ENV = {
    "episode_steps": Setting(125, 2500, "5 s, not 30 s (4.1): more episodes show more goals"),
    "substeps": Setting(5, 3, "25 Hz, not 83.3 (4.1, CW): noise that is held longer explores more"),
    "timestep": Setting(0.008, 0.004, "s, of a physics step; CW: 0.004; 8 ms are sound (tested)"),
    "action_mode": Setting("integrated", "absolute", "CW: absolute; ours: no action, no move"),
    "action_scale": Setting(0.1, 0.1, "rad, largest step of a joint target; absolute: not used"),
    "motor": Setting("position", "torque", "CW's torque law; it shakes in steps of 8 ms"),
    "cube_mass": Setting(0.08, 0.02, "kg; CW's pushing and picking tasks: 0.02"),
    "finger_friction": Setting(1.0, 0.5, "IsaacGymEnvs; CW asks for 0.1, PyBullet keeps 0.5"),
    "goal_yaw": Setting(0.0, math.pi / 4, "largest yaw, rad; 0: only the place counts (4.1: pose)"),
}
# alpha_1, alpha_2, alpha_3 of A.1: they teach pushing, but lifting too slowly. 250 pays 0.5 for a
# way of 2 mm, our 5000 pays 10. Curiosity is a cost that falls with speed. "reach", tips to the
# cube, is from CW.
PAPER_REWARD = {"overlap": 100.0, "distance": 250.0, "curiosity": 10.0}
REWARD = {f"reward_{term}": Setting(weight, PAPER_REWARD.get(term, 0.0), "weight of the term")
          for term, weight in REWARD_WEIGHTS.items()}
LEARNER = {
    "steps": Setting(125, 2500, "T, steps of a rollout: one episode"),
    "lr": Setting(2e-3, 2.5e-4, "A.2; ours learns in fewer frames"),
    "lr_power": Setting(1.5, 1.0, "lr falls as (share of training left) ^ this; A.2: linearly"),
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
}
NETWORK = {
    "crowd": Setting(8, 0, "ours: most distractors in the read-out loss; 0: as many as there are"),
    "token_dim": Setting(64, 128, "D; not printed; 64 takes half the time of our guess"),
    "z_dim": Setting(25, 25, "Z (section 5)"),
    "hidden": Setting(128, 128, "width of token MLPs and heads; a guess; CW: 256"),
    "log_std": Setting(-0.7, 0.0, "log std of actions at the start; rlpyt: 0; with -1 slower"),
}
SETTINGS = {**RUN, **ENV, **REWARD, **LEARNER, **NETWORK}
# LiftingCube takes longer, most of its score comes while the learning rate is small, and noise
# costs it more.
LIFT_SETTINGS = {"frames": 6_000_000, "lr_power": 2.0, "log_std": -1.0}
DEFAULTS = {name: setting.default for name, setting in SETTINGS.items()}

# A row of progress.csv. Means over the episodes that ended in the update's rollout, with sampled
# actions (episodes and cut_short: counts): success is fractional_success at the last step,
# success_strict the same by true volumes, solved the share with success >= 0.8, cut_short how many
# ended before their time. std: of the actions, after the update. explained_variance: of the returns
# by the values, before it. lr: its learning rate. The others: means over its minibatches.
PROGRESS = ("update", "frames", "episodes", "return", "length", "success", "success_strict",
            "solved", "cut_short", "std", "approx_kl", "clip_fraction", "explained_variance",
            "policy_loss", "value_loss", "auxiliary_loss", "entropy", "grad_norm", "lr")

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


# To add your own encoder, add a line: any module made by Yours(token_dim, z_dim), with
# forward(objects (B, K, D), goal (B, D)) -> z (B, Z).
ENCODERS = {
    "lrn": LRN,
    "rn": RN,
    "attn": ATTN,
    "lrn-mean": LRNMean,
    "lrn-objects": LRNObjects,
    "lrn-tokens": LRNTokens,
    "lrn-max": LRNMax,
}


class Agent(nn.Module):
    """The paper's scaffold (section 3.1): an MLP per object type, an encoder, heads.

    obs {"cubes" (B, N+1, 18), "fingers" (B, 3, 10), "goal" (B, 12)}
    -> mean (B, 9), log_std (9,), value (B,)

    `encoder` is a name in ENCODERS, or "mlp"; `distractors`, N in training, matters to mlp alone.
    """

    def __init__(self, encoder, distractors, settings):
        super().__init__()
        D, Z, hidden = settings["token_dim"], settings["z_dim"], settings["hidden"]
        self.is_mlp, self.largest_crowd = encoder == "mlp", settings["crowd"]
        self.crowds = torch.Generator()                        # reseed() seeds all ranks' alike
        if self.is_mlp:
            self.encoder = ConcatMLP(distractors, Z, hidden)
        else:
            self.cube = mlp(CUBE_WIDTH, hidden, D)
            self.finger = mlp(FINGER_WIDTH, hidden, D)
            self.goal = mlp(GOAL_WIDTH, hidden, D)
            self.encoder = ENCODERS[encoder](D, Z)
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
        return self.encoder(obs) if self.is_mlp else self.encoder(*self.tokens(obs))

    def forward(self, obs):
        z = self.encode(obs)
        return self.policy(z), self.log_std, self.value(z).squeeze(-1)

    def auxiliary(self, obs):
        """Read-out loss (ours): how badly z encodes what the task is about, in scaled units.

        A small head reads FACTS numbers from z: the target cube's position and velocity, the goal's
        position and the three fingertips; the loss is their mean squared error. A batch holds few
        episodes, so few answers to "which cube is meant?". Hence the question is asked anew: every
        sample gets fresh identifiers, any of its cubes as target and a goal from another sample.
        Half of the minibatches show a crowd() in place of the scene's cubes.
        """
        obs = {name: values[::4] for name, values in obs.items()}          # a quarter will do
        cubes = obs["cubes"]
        B, count = cubes.shape[:2]
        rows, target = torch.arange(B), torch.randint(count, (B,))
        can_crowd = self.largest_crowd and count > 1 and not self.is_mlp
        if can_crowd and torch.rand((), generator=self.crowds) < 0.5:
            cubes, target = self.crowd(cubes, target)          # (B, M+1, 18)
        shuffled = torch.rand(B, len(POOL)).argsort(dim=1)[:, :cubes.shape[1]]
        identifiers = POOL[shuffled]                           # (B, M+1), distinct in a row
        cubes = torch.cat([cubes[..., :IDENTIFIER], identifiers[..., None]], dim=2)
        meant = cubes[rows, target]                            # (B, 18)
        goal = obs["goal"][torch.randperm(B)]                  # (B, 12)
        goal = torch.cat([goal[:, :IDENTIFIER], meant[:, IDENTIFIER:]], dim=1)
        z = self.encode({"cubes": cubes, "fingers": obs["fingers"], "goal": goal})
        tips = obs["fingers"][..., FINGERTIP].flatten(1)       # (B, 9)
        facts = torch.cat([meant[:, POSITION], meant[:, LINEAR], goal[:, POSITION], tips], dim=1)
        return (self.read_out(z) - facts).square().mean()

    def crowd(self, cubes, target):
        """The target among M copies of the scene's other cubes, drawn with replacement.

        cubes (B, N+1, 18), target (B,) -> crowd (B, M+1, 18), the target's index in it (B,).
        Copies of one cube differ in the identifier alone, which auxiliary() gives them.
        At a fixed N a constant, such as the bias of f_phi, can cancel whatever N distractors add to
        the sum. At a random M it cannot, so a distractor has to add nothing. M is uniform up to a
        number that is itself uniform: mostly small, so that RN learns to read soon, at times large.
        """
        B, count = cubes.shape[:2]
        most = int(torch.randint(self.largest_crowd + 1, (), generator=self.crowds))
        M = int(torch.randint(most + 1, (), generator=self.crowds))
        rows, column = torch.arange(B), torch.randint(M + 1, (B,))
        chosen = (target[:, None] + torch.randint(1, count, (B, M + 1))) % count   # never target
        chosen[rows, column] = target
        return cubes[rows[:, None], chosen], column


# ---- environments and seeds

def make_env(task, distractors, settings, render_mode=None):
    """The environment of a run."""
    weights = {name.removeprefix("reward_"): settings[name] for name in REWARD}
    return TriFingerEnv(task, distractors, reward_weights=weights, render_mode=render_mode,
                        **{name: settings[name] for name in ENV})


def derived_seed(*numbers):
    """One seed from several numbers, such as (run's seed, update, stream).

    Sums like seed + update would make seed 1 repeat seed 0 one update later; SeedSequence mixes
    the numbers. (It pads with zeros: always pass equally many.)
    """
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


NOISE_STREAM, CROWD_STREAM = 10 ** 6, 2 * 10 ** 6              # below: one stream an environment


def reseed(learner, seed, update, rank):
    """Set torch's generators and return one seed per environment of this rank.

    All randomness of an update follows from (seed, update, stream): that is the whole random
    state of a run, so it resumes exactly.
    """
    torch.manual_seed(derived_seed(seed, update, NOISE_STREAM + rank))
    learner.agent.crowds.manual_seed(derived_seed(seed, update, CROWD_STREAM))
    count = len(learner.envs)
    return [derived_seed(seed, update, rank * count + e) for e in range(count)]


# ---- files of a run

def load(source):
    """Checkpoint dict, and its agent, of a run folder, a checkpoint's path or an open file.

    A setting that the checkpoint lacks takes its default, a reward term 0. ValueError in one line
    if it is not a checkpoint of ours.
    """
    if isinstance(source, str) and os.path.isdir(source):
        source = os.path.join(source, "checkpoint.pt")
    try:
        checkpoint = torch.load(source, weights_only=True, map_location="cpu")
        no_reward = dict.fromkeys(REWARD, 0.0)
        checkpoint["settings"] = {**DEFAULTS, **no_reward, **checkpoint["settings"]}
        agent = Agent(checkpoint["encoder"], checkpoint["distractors"], checkpoint["settings"])
        prefix = "agent."
        agent.load_state_dict({name.removeprefix(prefix): value
                               for name, value in checkpoint["learner"].items()
                               if name.startswith(prefix)})
    except Exception as error:           # torch.load raises many kinds; the user needs one line
        reason = str(error).split(". ")[0].split("\n")[0]
        raise ValueError(f"{source} is not a readable checkpoint of train.py "
                         f"({type(error).__name__}: {reason})") from None
    return checkpoint, agent.eval()      # for an encoder of your own, with dropout, say


def open_progress(path, update):
    """Make progress.csv, or cut it to the rows that the checkpoint knows."""
    with open(path, "rb+" if update else "wb") as file:
        if update:
            file.truncate(sum(map(len, file.readlines()[:1 + update])))
        else:
            file.write((",".join(PROGRESS) + "\n").encode())


def add_row(path, row):
    """Append a row (dict) to progress.csv."""
    cells = [row[key] if isinstance(row[key], int) else f"{row[key]:.6g}" for key in PROGRESS]
    with open(path, "a") as file:
        print(*cells, sep=",", file=file, flush=True)
        os.fsync(file.fileno())


def save(checkpoint, folder):
    """Replace the checkpoint of a run, and remove the scores of the weights before.

    A crash leaves the old file or the new one, never half of it.
    """
    with contextlib.suppress(FileNotFoundError):
        os.remove(os.path.join(folder, "zeroshot.csv"))
    path = os.path.join(folder, "checkpoint.pt")
    with open(path + ".tmp", "wb") as file:
        torch.save(checkpoint, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(path + ".tmp", path)


# ---- training

def make_learner(args, settings):
    """PPO with its agent and this rank's environments; every rank starts from the same weights."""
    envs, rest = divmod(settings["envs"], args.ranks)
    if rest:
        raise ValueError(f"{args.ranks} processes cannot share envs={settings['envs']}")
    if settings["steps"] < settings["episode_steps"]:
        raise ValueError(f"rollouts of steps={settings['steps']} never see the end of an episode "
                         f"of episode_steps={settings['episode_steps']}")
    torch.manual_seed(args.seed)
    agent = Agent(args.encoder, args.distractors, settings)
    worlds = [make_env(args.task, args.distractors, settings) for _ in range(envs)]
    return PPO(agent, worlds, **{name: settings[name] for name in LEARNER})


def start(args, settings, learner):
    """The state of a run: a new one, or the one to go on with, whose weights the learner takes up.

    All that is needed to go on stands in it: a run's random state is its seed and its update.
    """
    if args.checkpoint is None:
        names = ("encoder", "task", "distractors", "seed", "ranks")
        return {**{name: getattr(args, name) for name in names}, "settings": settings, "update": 0,
                "frames": 0, "seconds": 0.0, "versions": {
                    "torch": str(torch.__version__), "numpy": np.__version__,
                    "pybullet": version("pybullet")}}
    learner.load_state_dict(args.checkpoint.pop("learner"))
    learner.optimizer.load_state_dict(args.checkpoint.pop("optimizer"))
    return args.checkpoint


def summarize(episodes):
    """Columns of progress.csv about the episodes of all ranks: means, but for two counts."""
    infos = [episode["info"] for episode in episodes]
    columns = {
        "episodes": [1.0 for _ in episodes],
        "return": [episode["return"] for episode in episodes],
        "length": [episode["length"] for episode in episodes],
        "success": [info["fractional_success"] for info in infos],
        "success_strict": [info["fractional_success_strict"] for info in infos],
        "solved": [info["fractional_success"] >= SOLVED for info in infos],
        "cut_short": [info["truncated_by"] != TIME for info in infos],
    }
    sums = torch.tensor([sum(values) for values in columns.values()])
    if dist.is_initialized():
        dist.all_reduce(sums)
    means = dict(zip(columns, (sums / sums[0]).tolist()))
    return {**means, "episodes": int(sums[0]), "cut_short": int(sums[-1])}


def train(folder, state, learner, rank):
    """Play a batch, learn from it, write down what came of it; again until all frames are played.

    `state` is the checkpoint without learner and optimiser: how far the run has come.
    FloatingPointError if the training diverges; the last checkpoint stays as it was.
    """
    settings, progress = state["settings"], os.path.join(folder, "progress.csv")
    batch = settings["envs"] * settings["steps"]               # frames of an update
    last_update = math.ceil(settings["frames"] / batch)
    if rank == 0:
        open_progress(progress, state["update"])
    while state["update"] < last_update:
        begin = time.monotonic()
        seeds = reseed(learner, state["seed"], state["update"], rank)
        episodes = learner.rollout(seeds)
        stats = learner.update(remaining=1 - state["update"] / last_update)
        row = {**summarize(episodes), "std": learner.agent.log_std.exp().mean().item(), **stats}
        elapsed = time.monotonic() - begin
        state["update"] += 1
        state["frames"] += batch
        state["seconds"] += elapsed
        if rank > 0:
            continue
        add_row(progress, {"update": state["update"], "frames": state["frames"], **row})
        save({**state, "learner": learner.state_dict(),
              "optimizer": learner.optimizer.state_dict()}, folder)
        left = (last_update - state["update"]) * state["seconds"] / state["update"] / 60
        print(f"{state['frames']:8d} frames  success {row['success']:.2f}  return "
              f"{row['return']:6.0f}  read-out {row['auxiliary_loss']:.4f}  "
              f"{batch / elapsed:5.0f} frames/s  {left:4.0f} min left", flush=True)


# ---- the command line

STOPPED = 130                            # exit status after a Ctrl-C, as shells have it


def fail(message):
    """End with one line and status 2, as argparse does for bad input."""
    print(f"{os.path.basename(sys.argv[0])}: error: {message}", file=sys.stderr)
    sys.exit(2)


def read_command(argv=None):
    """The command's arguments; with --resume those of the run."""
    parser = argparse.ArgumentParser(
        description="Train an agent with PPO (see the first lines of train.py).")
    parser.error = fail
    add = parser.add_argument
    add("--encoder", choices=[*ENCODERS, "mlp"], default="lrn",
        help="those that begin with lrn- are variants, see lrn.py (default lrn)")
    add("--task", choices=("push", "lift"), default="push",
        help="PushingCube or LiftingCube (default push)")
    add("--distractors", type=int, default=2, metavar="N",
        help="cubes besides the target (default 2)")
    add("--seed", type=int, default=0, metavar="S",
        help="fixes every random number of the run (default 0)")
    add("--out", metavar="DIR", help="run folder (default runs/TASK-ENCODER-nN-seedS)")
    add("--paper", action="store_true",
        help="the paper's numbers; where it prints none, its sources' or a guess")
    add("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE",
        help="change some of SETTINGS")
    add("--resume", metavar="RUN", help="go on with the run in this folder; takes no other option")
    args = parser.parse_args(argv)
    args.ranks = int(os.environ["WORLD_SIZE"]) if dist.is_torchelastic_launched() else 1
    args.checkpoint = None
    if args.resume:
        return resume(args, sys.argv[1:] if argv is None else argv)
    if not 0 <= args.seed < 2 ** 32:
        fail(f"--seed must be an integer from 0 to 2^32 - 1, got {args.seed}")
    args.out = args.out or os.path.join(
        "runs", f"{args.task}-{args.encoder}-n{args.distractors}-seed{args.seed}")
    return args, read_settings(args)


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
        settings[name] = read_value(item, name, text)
    if settings["crowd"] >= len(POOL):
        fail(f"crowd={settings['crowd']}: there are identifiers for {len(POOL) - 1} distractors")
    return settings


def read_value(item, name, text):
    """A setting's value from text; it has the type of the default."""
    kind = type(DEFAULTS[name])
    try:
        value = {"True": True, "False": False}[text] if kind is bool else kind(text)
    except (KeyError, ValueError):
        fail(f"--set {item}: expected {'True or False' if kind is bool else kind.__name__}")
    lowest = 0 if name == "crowd" else 1
    if kind is int and value < lowest:
        fail(f"--set {item}: expected an integer >= {lowest}")
    if kind is float and not math.isfinite(value):
        fail(f"--set {item}: expected a finite number")
    return value


def resume(args, given):
    """The command of the run to go on with: all of it stands in the checkpoint."""
    if given not in (["--resume", args.resume], [f"--resume={args.resume}"]):
        fail("--resume RUN takes no other option: a run goes on as it was started")
    if not os.path.exists(os.path.join(args.resume, "progress.csv")):
        fail(f"--resume {args.resume}: no such run folder")
    try:
        checkpoint, _ = load(args.resume)
    except ValueError as error:
        fail(f"--resume: {error}")
    if "optimizer" not in checkpoint:
        fail(f"--resume {args.resume}: weights without the optimiser can be evaluated only")
    if checkpoint["ranks"] != args.ranks:
        fail(f"--resume: for {checkpoint['ranks']} processes start it as torchrun --standalone "
             f"--nproc-per-node {checkpoint['ranks']} train.py --resume {args.resume}")
    for name in ("encoder", "task", "distractors", "seed"):
        setattr(args, name, checkpoint[name])
    args.out, args.checkpoint = args.resume, checkpoint
    return args, checkpoint["settings"]


def claim_folder(args):
    """Make the run folder and lock it as long as this process lives."""
    os.makedirs(args.out, exist_ok=True)
    try:
        fcntl.flock(os.open(args.out, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fail(f"{args.out} is in use: another process trains in it")
    if os.path.exists(os.path.join(args.out, "checkpoint.pt")) and not args.checkpoint:
        fail(f"{args.out} already holds a run: --resume {args.out} goes on with it, --out takes "
             f"another folder")


def main():
    args, settings = read_command()
    rank = int(os.environ["RANK"]) if args.ranks > 1 else 0
    torch.set_num_threads(1)             # more do not pay on networks this small
    try:
        learner = make_learner(args, settings)
        if rank == 0:
            claim_folder(args)
    except ValueError as error:
        fail(str(error))
    except OSError as error:
        fail(f"--out {args.out} cannot be written: {error.strerror}")
    if args.ranks > 1:
        dist.init_process_group("gloo")
    state = start(args, settings, learner)
    try:
        train(args.out, state, learner, rank)
    except (FloatingPointError, KeyboardInterrupt) as error:   # on every rank alike: one says so
        if rank == 0:
            print(f"{str(error) or 'stopped'}; whole updates are saved in {args.out}",
                  file=sys.stderr)
        sys.exit(STOPPED if isinstance(error, KeyboardInterrupt) else 1)
    if rank == 0:
        print(f"finished after {state['update']} updates, {state['seconds'] / 60:.1f} minutes: "
              f"{args.out}")
    if args.ranks > 1:
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
