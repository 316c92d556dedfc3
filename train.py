"""Train an agent with PPO on PushingCube or LiftingCube: environment + token MLPs + object encoder + heads (section 3.1).

    python train.py --encoder lrn                          LRN, PushingCube, 2 distractors, one rank per core
    python train.py --encoder attn --task lift --seed 3    another run, in runs/lift-attn-n2-seed3
    python train.py --encoder lrn --resume                 go on from the last checkpoint, bit for bit as if never stopped
    python train.py --encoder lrn --paper                  every number as the paper prints it
    python train.py --encoder lrn --set z_dim=50 --out runs/z50        any line of SETTINGS, by name
    torchrun --nproc-per-node 2 train.py --encoder lrn     the same file on several processes or machines

Data flow: observation -> a small MLP per type -> objects (B, K, D), goal (B, D) -> encoder -> z (B, Z) -> mean (B, 9), value (B,)
A run folder holds checkpoint.pt, progress.csv (one row per update) and timing.csv (the columns that depend on the machine).
"""
import argparse
import csv
import math
import os
import signal
import socket
import sys
import time
from datetime import timedelta

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import nn

from attn import ATTN
from lrn import LRN
from ppo import PPO
from rn import RN
from trifinger_env import IDENTIFIERS, TriFingerEnv

POOL = torch.tensor(IDENTIFIERS, dtype=torch.float32)
ENCODERS = ("lrn", "lrn-max", "rn", "attn", "mlp")
#                          default, paper      why they differ (paper: A.2 = printed; CW = not printed, from CausalWorld's script)
SETTINGS = {
    "frames":               (6_000_000, 60_000_000, "environment steps in all; the paper prints no number, CW trains 60 M"),
    "envs":                 (32, 48, "environments in all; CW: 20 x 6000 steps = 120 000 a batch, here 48 x 2500 = 120 000"),
    "steps":                (125, 2500, "steps of a rollout: one episode"),
    "episode_steps":        (125, 2500, "5 s instead of 30 s: a push takes 2-3 s, and more episodes show more goals"),
    "substeps":             (5, 3, "25 Hz instead of 83.3 Hz: exploration moves the fingers further per decision"),
    "timestep":             (0.008, 0.004, "s; 8 ms steps cost the same each and behave with implicit motors"),
    "action_mode":          ("delta", "absolute", "targets relative to the measured joints explore better; CW: absolute"),
    "goal_yaw":             (0.0, math.pi / 4, "an axis-aligned goal asks for the position only; see Reading notes in README"),
    "reward_overlap":       (100.0, 100.0, "alpha_1 (A.1)"),
    "reward_distance":      (5000.0, 250.0, "alpha_2 (A.1): tiny beside the others as printed, 2 mm = 0.5"),
    "reward_curiosity":     (0.0, 10.0, "alpha_3 (A.1): never positive, pays for throwing the cube about"),
    "reward_reach":         (2500.0, 0.0, "ours: fingertips towards the cube, as in CW's own rewards"),
    "lr":                   (2e-3, 2.5e-4, "A.2; with few epochs and small networks 2e-3 still keeps the KL of an update below 0.1"),
    "anneal_lr":            (True, True, "linear, A.2"),
    "clip":                 (0.2, 0.5, "A.2"),
    "anneal_clip":          (False, True, "rlpyt anneals both"),
    "epochs":               (3, 4, "A.2; 5 at lr 1e-3 need fewer frames, but the same minutes"),
    "minibatches":          (8, 40, "A.2; of 500 samples here, of 3000 there"),
    "discount":             (0.98, 0.98, "A.2; at 25 Hz it looks 2 s ahead, at 83.3 Hz 0.6 s"),
    "lam":                  (0.95, 0.95, "A.2"),
    "entropy":              (0.001, 0.01, "A.2; with normalised advantages 0.01 lets the standard deviation grow without bound"),
    "value_coef":           (0.5, 0.5, "A.2"),
    "max_grad_norm":        (0.5, 0.5, "A.2"),
    "adam_eps":             (1e-5, 1e-8, "rlpyt's default"),
    "normalize_advantages": (True, False, "rlpyt's default"),
    "normalize_values":     (True, False, "returns of some thousands otherwise take the whole gradient"),
    "auxiliary":            (30.0, 0.0, "weight of reading target, goal and fingertips from z; ours, speeds learning up most"),
    "token_dim":            (64, 128, "D; not printed; 64 learns as much from a frame here as 128 (0.50 against 0.52 at 1.4 M) in half the time"),
    "z_dim":                (25, 25, "Z (section 5)"),
    "hidden":               (128, 128, "width of token MLPs and heads; not printed"),
    "heads":                (4, 4, "ATTN; not printed"),
    "relations":            (True, True, "False: LRN without relations (figure 5)"),
    "layer_norm":           (True, True, "False: LRN with the mean in place of LayerNorm (figure 5)"),
    "log_std":              (-0.7, 0.0, "initial log standard deviation of the actions; rlpyt: 0"),
}
PROGRESS = ("update", "frames", "episodes", "return", "length", "success_aabb", "success_strict", "solved", "cut_short", "std",
            "approx_kl", "clip_fraction", "explained_variance", "policy_loss", "value_loss", "auxiliary_loss", "entropy",
            "grad_norm", "lr")
TIMING = ("update", "frames", "seconds", "frames_per_second", "rollout_share")


def mlp(*widths, last_gain=math.sqrt(2)):
    """ReLU network through the given widths with orthogonal weights and zero biases; the last layer is linear."""
    layers = []
    for i, (a, b) in enumerate(zip(widths, widths[1:])):
        layer = nn.Linear(a, b)
        nn.init.orthogonal_(layer.weight, last_gain if i == len(widths) - 2 else math.sqrt(2))
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    """The paper's scaffold (section 3.1): an MLP per object type, an encoder, heads for action and value.

    forward(obs) -> mean (B, 9), log_std (9,), value (B,) for obs {"cubes" (B, N+1, 18), "fingers" (B, 3, 10), "goal" (B, 12)}.
    encoder "mlp" is the naive baseline: one MLP on the concatenated observation. Its first layer has a fixed width, so it
    works at the N it was built for and raises ValueError at any other.
    """

    def __init__(self, encoder, distractors, settings):
        super().__init__()
        D, Z, H = settings["token_dim"], settings["z_dim"], settings["hidden"]
        self.kind, self.distractors = encoder, distractors
        if encoder == "mlp":
            self.encoder = nn.Sequential(mlp(18 * (distractors + 1) + 30 + 12, 2 * H, 2 * H, Z), nn.LayerNorm(Z))
        else:
            self.cube, self.finger, self.goal = mlp(18, H, D), mlp(10, H, D), mlp(12, H, D)
            self.encoder = (RN(D, Z) if encoder == "rn" else ATTN(D, Z, settings["heads"]) if encoder == "attn" else
                            LRN(D, Z, settings["relations"], settings["layer_norm"], "max" if encoder == "lrn-max" else "sum"))
        self.policy, self.value, self.read_out = mlp(Z, H, H, 9, last_gain=0.01), mlp(Z, H, H, 1, last_gain=1.0), mlp(Z, H, 18)
        self.log_std = nn.Parameter(torch.full((9,), settings["log_std"]))

    def tokens(self, obs):
        """Objects (B, K, D), first the cubes, then the fingers, and the goal (B, D)."""
        return torch.cat([self.cube(obs["cubes"]), self.finger(obs["fingers"])], 1), self.goal(obs["goal"])

    def encode(self, obs):
        """z (B, Z)."""
        if self.kind != "mlp":
            return self.encoder(*self.tokens(obs))
        if obs["cubes"].shape[1] != self.distractors + 1:
            raise ValueError(f"an mlp agent has a fixed input: it was trained with {self.distractors} distractors and cannot "
                             f"be used with {obs['cubes'].shape[1] - 1}")
        return self.encoder(torch.cat([value.flatten(1) for value in obs.values()], 1))

    def forward(self, obs):
        z = self.encode(obs)
        return self.policy(z), self.log_std, self.value(z).squeeze(-1)

    def auxiliary(self, obs):
        """Mean squared error of reading from z what the task is about, in scaled units: the target cube's position and
        velocity, the goal's position and the three fingertips (18 numbers).

        A batch holds few episodes, so few answers to "which cube is meant?". Hence the question is asked anew: every
        sample gets fresh identifiers, a random cube as target and the goal of another sample.
        """
        obs = {key: value[::4] for key, value in obs.items()}                  # a quarter will do
        B, count = obs["cubes"].shape[:2]
        rows, target = torch.arange(B), torch.randint(count, (B,))
        identifiers = POOL[torch.rand(B, len(POOL)).argsort(1)[:, :count]]                     # (B, N+1), distinct in a row
        cubes, goal = obs["cubes"].clone(), obs["goal"][torch.randperm(B)]
        cubes[..., -1], goal[:, -1] = identifiers, identifiers[rows, target]
        z, meant = self.encode({"cubes": cubes, "fingers": obs["fingers"], "goal": goal}), cubes[rows, target]     # (B, 18)
        facts = torch.cat([meant[:, 4:7], meant[:, 11:14], goal[:, 4:7], obs["fingers"][..., 7:].flatten(1)], 1)   # (B, 18)
        return (self.read_out(z) - facts).square().mean()


def make_env(task, distractors, settings, **options):
    """The environment of a run."""
    return TriFingerEnv(task, distractors, **{key: settings[key] for key in ("episode_steps", "substeps", "timestep", "action_mode", "goal_yaw")},
                        reward_weights={key[7:]: value for key, value in settings.items() if key.startswith("reward_")}, **options)


def load(path):
    """Checkpoint dict of a file or run folder, and its agent. ValueError in one line if it is not one of ours."""
    path = os.path.join(path, "checkpoint.pt") if os.path.isdir(path) else path
    try:
        checkpoint = torch.load(path, weights_only=True, map_location="cpu")
        missing = [key for key in ("task", "seed", "ranks", "update", "frames", "seconds", "optimizer") if key not in checkpoint]
        missing += [key for key in SETTINGS if key not in checkpoint["settings"]]
        if missing:
            raise KeyError(" ".join(missing))
        agent = Agent(checkpoint["encoder"], checkpoint["distractors"], checkpoint["settings"])
        agent.load_state_dict({key[6:]: value for key, value in checkpoint["learner"].items() if key.startswith("agent.")})
    except Exception as error:                                 # torch.load raises many kinds; all mean the same to the user
        raise ValueError(f"{path} is not a readable checkpoint of train.py ({type(error).__name__}: {' '.join(str(error).split())[:200]})") from None
    if not all(torch.isfinite(value).all() for value in checkpoint["learner"].values()):
        raise ValueError(f"{path} holds weights that are not finite")
    return checkpoint, agent


def save(checkpoint, path):
    """Write a checkpoint so that a crash at any moment leaves the old or the new one, never half of it."""
    with open(path + ".tmp", "wb") as file:
        torch.save(checkpoint, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(path + ".tmp", path)


def keep_rows(path, columns, update):
    """Cut a CSV back to its header and the rows up to `update`, so that a resumed run continues it without doubles."""
    rows = []
    if os.path.exists(path):
        with open(path, newline="") as file:
            rows = [row for row in csv.reader(file) if len(row) == len(columns) and row[0].isdigit() and int(row[0]) <= update]
    with open(path + ".tmp", "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])
    os.replace(path + ".tmp", path)


def train(args, settings):
    """Train on this rank; rank 0 writes. Returns when all frames are played or a signal asks to stop."""
    rank, ranks, stop = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)), []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.append(True))
    torch.set_num_threads(1)
    if ranks > 1:
        dist.init_process_group("gloo", timeout=timedelta(minutes=10))
    torch.manual_seed(args.seed)                               # every rank starts from the same weights
    agent = Agent(args.encoder, args.distractors, settings)
    envs = [make_env(args.task, args.distractors, settings) for _ in range(settings["envs"] // ranks)]
    learner = PPO(agent, envs, **{key: settings[key] for key in (
        "steps", "epochs", "minibatches", "lr", "adam_eps", "clip", "discount", "lam", "entropy", "value_coef", "max_grad_norm",
        "anneal_lr", "anneal_clip", "normalize_advantages", "normalize_values", "auxiliary")})
    update, seconds = 0, 0.0
    if args.resume:                                            # each rank reads for itself: spawned ranks would share the tensors
        checkpoint, _ = load(args.out)
        learner.load_state_dict(checkpoint["learner"])
        learner.optimizer.load_state_dict(checkpoint["optimizer"])
        update, seconds = checkpoint["update"], checkpoint["seconds"]
    per_update = settings["envs"] * settings["steps"]
    total = math.ceil(settings["frames"] / per_update)
    paths = {name: os.path.join(args.out, name) for name in ("checkpoint.pt", "progress.csv", "timing.csv")}

    def keep():
        save({"encoder": args.encoder, "task": args.task, "distractors": args.distractors, "seed": args.seed, "ranks": ranks, "settings": settings,
              "update": update, "frames": update * per_update, "seconds": seconds, "random_state": [args.seed, update],
              "learner": learner.state_dict(), "optimizer": learner.optimizer.state_dict()}, paths["checkpoint.pt"])

    if rank == 0:
        if not args.resume:
            keep()                                             # a run can be resumed from its first moment on
        keep_rows(paths["progress.csv"], PROGRESS, update)
        keep_rows(paths["timing.csv"], TIMING, update)
        for name in ("zeroshot.csv", "zeroshot-mean.csv"):     # what was measured on weights that are about to change
            if update < total and os.path.exists(os.path.join(args.out, name)):
                os.remove(os.path.join(args.out, name))
    saved = time.monotonic()
    while update < total:
        # All randomness of an update follows from (seed, update, rank): that is the whole random state of a run.
        begin = time.monotonic()
        seeds = [int(np.random.SeedSequence((args.seed, update, rank * len(envs) + e)).generate_state(1)[0]) for e in range(len(envs))]
        torch.manual_seed(int(np.random.SeedSequence((args.seed, update, 10 ** 6 + rank)).generate_state(1)[0]))
        episodes = learner.rollout(seeds)
        played = time.monotonic()
        try:
            stats = learner.update(1 - update / total)
        except FloatingPointError as error:                    # the same on every rank, as gradients are averaged
            fail(f"update {update + 1}: {error}; the last checkpoint stays as it was", status=1)
        update += 1
        sums = torch.tensor([[1.0, ret, length, info["fractional_success"], info["fractional_success_strict"],
                              info["fractional_success"] >= 0.8, info["truncated_by"] != "time"] for ret, length, info in episodes]
                            or [[0.0] * 7]).sum(0)
        sums = torch.cat([sums, torch.tensor([float(bool(stop))])])
        if ranks > 1:
            dist.all_reduce(sums)
        means = (sums[1:7] / sums[0]).tolist()
        elapsed = time.monotonic() - begin
        seconds += elapsed
        stopping = sums[7] > 0
        if rank == 0:
            row = {"update": update, "frames": update * per_update, "episodes": int(sums[0]),
                   **dict(zip(("return", "length", "success_aabb", "success_strict", "solved"), means)), "cut_short": int(sums[6]),
                   "std": agent.log_std.exp().mean().item(), **stats}
            for name, line in (("progress.csv", [row[key] if isinstance(row[key], int) else f"{row[key]:.6g}" for key in PROGRESS]),
                               ("timing.csv", [update, row["frames"], f"{seconds:.2f}", f"{per_update / elapsed:.0f}", f"{(played - begin) / elapsed:.3f}"])):
                with open(paths[name], "a", newline="") as file:
                    csv.writer(file, lineterminator="\n").writerow(line)
            print(f"update {update}/{total} frames {row['frames']}/{total * per_update} frames/s {per_update / elapsed:.0f} "
                  f"return {row['return']:.1f} success {row['success_aabb']:.3f} strict {row['success_strict']:.3f} "
                  f"solved {row['solved']:.2f} cut_short {row['cut_short']} kl {row['approx_kl']:.4f} clipped {row['clip_fraction']:.2f} "
                  f"explained {row['explained_variance']:.2f} std {row['std']:.2f} eta {(total - update) * elapsed / 60:.0f}min", flush=True)
            if stopping or update == total or time.monotonic() - saved > args.save_minutes * 60:
                keep()
                saved = time.monotonic()
        if stopping:
            break
    if rank == 0:
        print(f"{'finished' if update == total else 'stopped'} after {update} updates, {seconds / 60:.1f} minutes: {paths['checkpoint.pt']}")
    if ranks > 1:
        dist.barrier()                                         # leave together: nobody waits for a rank that is gone
        dist.destroy_process_group()
        sys.stdout.flush()
        os._exit(0)                                            # python's own shutdown may meet gloo's threads and abort


def start_rank(index, *arguments):
    """One of the ranks 1, 2, ...; rank 0 is the process that starts them."""
    os.environ["RANK"] = str(index + 1)
    train(*arguments)


def fail(message, status=2):
    """End with one line and status 2, as argparse does."""
    print(f"{os.path.basename(sys.argv[0])}: error: {message}", file=sys.stderr)
    sys.exit(status)


def parse(argv=None):
    """Check everything that can be wrong before any process starts. Returns (args, settings)."""
    parser = argparse.ArgumentParser(description="Train an agent with PPO (see the first lines of train.py).")
    parser.error = fail
    parser.add_argument("--encoder", choices=ENCODERS, default="lrn", help="object encoder; lrn-max is LRN with a maximum in place of the sum (default lrn)")
    parser.add_argument("--task", choices=("push", "lift"), default="push", help="PushingCube or LiftingCube (default push)")
    parser.add_argument("--distractors", type=int, default=2, metavar="N", help="cubes besides the target (default 2)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="fixes every random number of the run (default 0)")
    parser.add_argument("--frames", type=int, metavar="F", help=f"environment steps in all (default {SETTINGS['frames'][0]})")
    parser.add_argument("--out", metavar="DIR", help="run folder (default runs/TASK-ENCODER-nN-seedS)")
    parser.add_argument("--paper", action="store_true", help="every number as the paper prints it")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="change lines of SETTINGS")
    parser.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
    parser.add_argument("--overwrite", action="store_true", help="start anew in a folder that holds a run")
    parser.add_argument("--ranks", type=int, metavar="R", help="processes, ignored under torchrun (default one per core, if they divide the batch)")
    parser.add_argument("--save-minutes", type=float, default=3.0, metavar="M", help="minutes between checkpoints (default 3)")
    args = parser.parse_args(argv)
    args.out = args.out or os.path.join("runs", f"{args.task}-{args.encoder}-n{args.distractors}-seed{args.seed}")
    settings = {key: value[1 if args.paper else 0] for key, value in SETTINGS.items()}
    changes = [("--set", item) for item in args.set] + [("--frames", f"frames={args.frames}")] * (args.frames is not None)
    for flag, item in changes:
        key, _, text = item.partition("=")
        if key not in settings:
            fail(f"{flag} {item}: no such setting; the names are {', '.join(settings)}")
        kind, signed = type(settings[key]), key.startswith(("reward_", "log_std"))
        try:
            value = {"True": True, "False": False}[text] if kind is bool else kind(text)
        except (KeyError, ValueError):
            fail(f"{flag} {item}: expected {key}=<{kind.__name__}>")
        if kind in (int, float) and not (math.isfinite(value) and (signed or value >= (kind is int))):
            fail(f"{flag} {item}: expected {'an integer >= 1' if kind is int else 'a finite number' if signed else 'a number >= 0'}")
        settings[key] = value
    if "WORLD_SIZE" in os.environ:                             # started by torchrun
        args.ranks = int(os.environ["WORLD_SIZE"])
    file, rows = os.path.join(args.out, "checkpoint.pt"), os.path.join(args.out, "progress.csv")
    if args.resume and args.overwrite:
        fail("--resume goes on with a run, --overwrite starts anew: give one of them")
    if args.resume:
        try:
            checkpoint, _ = load(file)
        except ValueError as error:
            fail(f"--resume: {error}")
        for name in ("encoder", "task", "distractors", "seed"):
            if checkpoint[name] != getattr(args, name):
                fail(f"--resume: {file} is a run with --{name} {checkpoint[name]}, not {getattr(args, name)}")
        changed = [key for key in settings if settings[key] != checkpoint["settings"][key]]
        if changed and (args.set or args.paper or args.frames is not None):
            fail(f"--resume: {file} was started with other settings: " + ", ".join(f"{key}={checkpoint['settings'][key]}" for key in changed))
        if args.ranks not in (None, checkpoint["ranks"]):
            fail(f"--resume: {file} is a run on {checkpoint['ranks']} ranks, with {args.ranks} it would become another run")
        settings, args.ranks = checkpoint["settings"], checkpoint["ranks"]
    elif (os.path.exists(file) or os.path.exists(rows) and os.path.getsize(rows)) and not args.overwrite:
        fail(f"--out {args.out} already holds a run: add --resume to go on, --overwrite to start anew, or choose another --out")
    if args.seed < 0:
        fail(f"--seed must be an integer >= 0, got {args.seed}")
    if args.ranks is None:
        divides = [r for r in range(1, os.cpu_count() + 1) if settings["envs"] % r == 0
                   and settings["envs"] // r * settings["steps"] % settings["minibatches"] == 0]
        args.ranks = max(divides, default=1)
    if args.ranks < 1 or settings["envs"] % args.ranks:
        fail(f"--ranks {args.ranks} must divide the number of environments, {settings['envs']}")
    try:                                                       # let the parts check their own arguments
        make_env(args.task, args.distractors, settings).close()
        PPO(Agent(args.encoder, args.distractors, settings), [None] * (settings["envs"] // args.ranks), steps=settings["steps"],
            minibatches=settings["minibatches"])
    except ValueError as error:
        fail(str(error))
    try:
        os.makedirs(args.out, exist_ok=True)
        open(rows, "a").close()
    except OSError as error:
        fail(f"--out {args.out} cannot be written: {error.strerror}")
    return args, settings


def main():
    args, settings = parse()
    if "RANK" in os.environ or args.ranks == 1:
        return train(args, settings)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    os.environ.update(RANK="0", WORLD_SIZE=str(args.ranks), MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    others = mp.start_processes(start_rank, (args, settings), args.ranks - 1, join=False, start_method="spawn")
    try:
        train(args, settings)
    except RuntimeError as error:                              # a rank that is gone breaks the others' connections
        try:
            others.join()
        except mp.ProcessExitedException as exit:              # killed from outside; an error of its own shows itself
            fail(f"{exit}, so the run ends here; --resume goes on from the last checkpoint", status=1)
        raise error


if __name__ == "__main__":
    main()
