"""Tests of everything, each against something independent: a slow loop, torch's own layer,
PyBullet, a hand-computed case, or a planted defect that has to turn it red.

Run:    pytest -q                                        3 to 4 minutes on 2 cores
        SLOW=1 pytest -q -s -k "soak or killed_and or mutation"
                                 12 M environment steps, 40 kills, every planted defect: hours
"""
import ast
import csv
import functools
import glob
import io
import itertools
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pybullet as pb
import pytest
import torch
from torch import nn

import evaluate
import ppo
import train
import trifinger_env as tri
from attn import ATTN
from evaluate import as_batch
from lrn import LRN, LRNMax
from ppo import PPO, PointOnLine, TinyAgent, gae, normal_log_prob
from rn import RN
from trifinger_env import TriFingerEnv

SLOW = bool(os.environ.get("SLOW"))
HERE = os.path.dirname(os.path.abspath(__file__))
MODULES = ("lrn.py", "rn.py", "attn.py", "ppo.py", "trifinger_env.py", "train.py", "evaluate.py")
D = 64
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def same_numbers():
    """Each test starts with the same random numbers of torch, so that a red one can be repeated."""
    torch.manual_seed(0)


def run(*command, cwd=HERE, timeout=120, **more):
    """A command of the project in a process of its own; output as text."""
    return subprocess.run([sys.executable, *command], cwd=cwd, timeout=timeout,
                          capture_output=True, text=True, **more)


def read(path):
    with open(path, "rb") as file:
        return file.read()


def read_csv(path):
    """Rows of a CSV as dicts of numbers."""
    with open(path, newline="") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def files_below(folder):
    """Every file below a folder, with its content."""
    found = {}
    for at, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(at, name)
            found[path] = read(path)
    return found


def is_uniform(values, low=0.0, high=1.0):
    """Chi-square test of a uniform law; values outside [low, high] fail it.

    With 9 degrees of freedom 27.9 is exceeded by chance once in 1000.
    """
    counts, _ = np.histogram(values, 10, (low, high))
    expected = len(values) / 10
    return counts.sum() == len(values) and (np.square(counts - expected) / expected).sum() < 27.9


# ---------------------------------------------------------------- encoders

ENCODERS = {
    "lrn": LRN,
    "lrn without relations": lambda: LRN(relations=False),
    "lrn without LayerNorm": lambda: LRN(layer_norm=False),
    "lrn-max": LRNMax,
    "rn": RN,
    "attn": ATTN,
}
every_encoder = pytest.mark.parametrize("make", ENCODERS.values(), ids=ENCODERS)


def some(B, K, seed=0):
    """Objects (B, K, D) and goal (B, D)."""
    generator = torch.Generator().manual_seed(seed)
    objects = torch.randn(B, K, D, generator=generator)
    return objects, torch.randn(B, D, generator=generator)


def same(ours, expected):
    torch.testing.assert_close(ours, expected, atol=1e-5, rtol=1e-4)


def through(layer, x):
    return x @ layer.weight.T + layer.bias


def shaken(encoder):
    """The encoder with biases and LayerNorm away from 0 and 1, where they could hide a mistake."""
    with torch.no_grad():
        for p in encoder.parameters():
            if p.ndim == 1:
                p += 0.3 * torch.randn(len(p))
    return encoder


def g_slow(encoder, pair):
    """g_theta on one concatenated pair: four layers, without the split of the first one."""
    layers = [encoder.first, *(layer for layer in encoder.g if isinstance(layer, nn.Linear))]
    assert len(layers) == 4
    x = pair
    for layer in layers[:-1]:
        x = through(layer, x).clamp(min=0)
    return through(layers[-1], x)


def z_slow(encoder, total):
    """LayerNorm(f_phi(total)) of one sample, written out."""
    y = through(encoder.f, total)
    normalized = (y - y.mean()) / (y.var(correction=0) + 1e-5).sqrt()
    return normalized * encoder.norm.weight + encoder.norm.bias


def test_lrn_equals_the_loop_over_objects():
    encoder = shaken(LRN())
    objects, goal = some(3, 6)
    for b in range(3):
        total = sum(g_slow(encoder, torch.cat([objects[b, i], goal[b]])) for i in range(6))
        same(encoder(objects, goal)[b], z_slow(encoder, total))


def test_ablations_of_lrn_equal_their_formulas():
    objects, goal = some(2, 5)
    alone = shaken(LRN(relations=False))
    mean = shaken(LRN(layer_norm=False, z_dim=10))
    assert mean(objects, goal).shape == (2, 10)
    for b in range(2):
        total = sum(g_slow(alone, objects[b, i]) for i in range(5))
        same(alone(objects, goal)[b], z_slow(alone, total))
        total = sum(g_slow(mean, torch.cat([objects[b, i], goal[b]])) for i in range(5))
        same(mean(objects, goal)[b], through(mean.f, total / 5))


def test_lrn_with_a_maximum_equals_the_loop_and_counts_copies_once():
    encoder = shaken(LRNMax())
    objects, goal = some(3, 6)
    for b in range(3):
        r = [g_slow(encoder, torch.cat([objects[b, i], goal[b]])) for i in range(6)]
        largest = torch.stack([max(column) for column in zip(*r)])
        same(encoder(objects, goal)[b], z_slow(encoder, largest))
    seven_copies = objects[:, 2:3].expand(-1, 7, -1)
    more = torch.cat([objects, seven_copies], dim=1)
    same(encoder(more, goal), encoder(objects, goal))
    summed = LRN()
    assert (summed(more, goal) - summed(objects, goal)).abs().max() > 0.1


def test_rn_equals_the_double_loop_over_pairs():
    encoder = shaken(RN())
    objects, goal = some(2, 5)
    for b in range(2):
        tokens = [*objects[b], goal[b]]
        total = sum(g_slow(encoder, torch.cat([first, second]))
                    for first in tokens for second in tokens)
        same(encoder(objects, goal)[b], z_slow(encoder, total))


@pytest.mark.parametrize("heads", [1, 4])
def test_attention_equals_torch_multihead_attention(heads):
    encoder = shaken(ATTN(heads=heads))
    objects, goal = some(3, 6)
    torchs = nn.MultiheadAttention(D, heads, batch_first=True)
    parts = (encoder.q, encoder.k, encoder.v)
    with torch.no_grad():
        torchs.in_proj_weight.copy_(torch.cat([part.weight for part in parts]))
        torchs.in_proj_bias.copy_(torch.cat([part.bias for part in parts]))
        torchs.out_proj.weight.copy_(torch.eye(D))             # the paper has no output projection
        torchs.out_proj.bias.zero_()
    tokens = torch.cat([objects, goal[:, None]], dim=1)
    expected, weights = torchs(tokens, tokens, tokens, average_attn_weights=False)
    attended, ours = encoder.attend(objects, goal)
    same(attended, expected)
    same(ours, weights)
    for b in range(3):
        same(encoder(objects, goal)[b], z_slow(encoder, expected[b].sum(0)))


def test_attention_refuses_heads_that_do_not_divide_the_tokens():
    for heads in (0, 7):
        with pytest.raises(ValueError, match=f"multiple of heads, got 64 and {heads}"):
            ATTN(heads=heads)


@every_encoder
def test_encoder_ignores_order_and_padding_and_serves_any_number(make):
    encoder, other = shaken(make()), make()
    other.load_state_dict(encoder.state_dict())
    for K in range(1, 21):
        objects, goal = some(2, K, seed=K)
        z = encoder(objects, goal)
        assert z.shape == (2, 25) and torch.equal(z, other(objects, goal))
        shuffled = encoder(objects[:, torch.randperm(K)], goal)
        torch.testing.assert_close(z, shuffled, atol=1e-4, rtol=1e-4)
        padding = 1e3 * torch.randn(2, 5, D)
        padding[:, 3], padding[:, 4] = math.nan, math.inf
        padded = torch.cat([objects, padding], dim=1)
        present = torch.arange(K + 5).expand(2, -1) < K
        ignored = encoder(padded, goal, present)
        torch.testing.assert_close(z, ignored, atol=1e-4, rtol=1e-4)


@every_encoder
def test_padding_has_no_part_in_the_gradient(make):
    encoder = shaken(make())
    objects, goal = some(2, 6)
    encoder(objects, goal).square().sum().backward()
    expected = [p.grad.clone() for p in encoder.parameters()]
    encoder.zero_grad()
    padding = torch.full((2, 3, D), math.nan)
    present = torch.arange(9).expand(2, -1) < 6
    encoder(torch.cat([objects, padding], dim=1), goal, present).square().sum().backward()
    for p, gradient in zip(encoder.parameters(), expected):
        torch.testing.assert_close(p.grad, gradient, atol=1e-4, rtol=1e-4)


@every_encoder
def test_padding_may_differ_between_the_samples_of_a_batch(make):
    encoder = shaken(make())
    objects, goal = some(3, 6)
    present = torch.tensor([[1, 0, 1, 1, 0, 1], [0, 0, 0, 1, 0, 0], [1, 1, 1, 1, 1, 1]]).bool()
    z = encoder(objects, goal, present)
    for b in range(3):
        same(z[b:b + 1], encoder(objects[b:b + 1, present[b]], goal[b:b + 1]))


def test_a_mean_over_no_object_at_all_is_zero():
    encoder = shaken(LRN(layer_norm=False))
    nothing = torch.zeros(2, 6, dtype=torch.bool)
    same(encoder(*some(2, 6), nothing), encoder.f.bias.expand(2, -1))


@pytest.mark.parametrize("make", [LRN, LRNMax, RN, ATTN])
def test_wrong_shapes_are_refused_and_the_right_one_is_named(make):
    encoder = make()
    objects, goal = some(3, 5)
    present = torch.ones(3, 5, dtype=torch.bool)
    wide_objects, wide_goal = objects.repeat(1, 1, 2), goal.repeat(1, 2)
    for arguments, words in (
            ((objects[0], goal), "objects must be .B, K, D=64., got .5, 64."),
            ((objects[..., 1:], goal), "objects must be .B, K, D=64., got .3, 5, 63."),
            ((wide_objects, wide_goal), "objects must be .B, K, D=64., got .3, 5, 128."),
            ((objects, goal[:, None]), "goal must be .B, D. = .3, 64., got .3, 1, 64."),
            ((objects, goal[:, 1:]), "goal must be .B, D. = .3, 64., got .3, 63."),
            ((objects, goal[:1]), "goal must be .B, D. = .3, 64., got .1, 64."),
            ((objects, goal, present.float()), "present must be .B, K. = .3, 5. of torch.bool"),
            ((objects, goal, present[:, 1:]), "present must be .* got .3, 4. torch.bool"),
            ((objects, goal, present[:1]), "present must be .* got .1, 5. torch.bool"),
            ((objects, goal, present[..., None]), "present must be .* got .3, 5, 1. torch.bool")):
        with pytest.raises(ValueError, match=words):
            encoder(*arguments)
    encoder(objects, goal, present)


@pytest.mark.parametrize("make", [LRN, LRNMax, RN, ATTN])
def test_gradient_reaches_every_parameter(make):
    encoder = make()
    (encoder(*some(8, 6)) * torch.randn(8, 25)).sum().backward()
    for name, p in encoder.named_parameters():
        if name != "k.bias":             # adds the same score to every key, so softmax drops it
            assert p.grad.abs().max() > 1e-6, name


@every_encoder
def test_weights_start_orthogonal(make):
    """W W^T = 2 I (or W^T W, whichever is smaller) and b = 0, in every layer."""
    for name, layer in make().named_modules():
        if isinstance(layer, nn.Linear):
            W = layer.weight if layer.in_features >= layer.out_features else layer.weight.T
            same(W @ W.T, 2 * torch.eye(len(W)))
            assert not layer.bias.any(), name


def test_relations_grow_linearly_in_lrn_and_quadratically_in_rn():
    """Rows that pass through g_theta; the paper's 12 and 169 at 9 cubes and 3 fingers."""
    for encoder, expected in ((LRN(), {6: 6, 12: 12, 24: 24}), (RN(), {6: 49, 12: 169, 24: 625})):
        rows = []
        encoder.g[1].register_forward_hook(
            lambda module, inputs, output: rows.append(output.numel() // D))
        for K, count in expected.items():
            encoder(*some(1, K))
            assert rows[-1] == count


@pytest.mark.parametrize("kind", ["lrn", "lrn-max", "rn", "attn"])
def test_z_varies_with_the_state_from_the_start(kind):
    """PyTorch's default weights give LRN and RN a z that is nearly constant; ours must not."""
    agent = train.Agent(kind, 2, train.DEFAULTS)
    env = TriFingerEnv()
    obs = as_batch([env.reset(seed=seed)[0] for seed in range(40)])
    env.close()
    ours = agent.encode(obs).std(0).mean().item()
    for module in agent.modules():
        if isinstance(module, nn.Linear):
            module.reset_parameters()
    default = agent.encode(obs).std(0).mean().item()
    assert ours > 0.06 and ours > (2 if kind == "attn" else 5) * default, (ours, default)


# ---------------------------------------------------------------- the robot and the world

STILL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def env():
    env = TriFingerEnv()
    env.reset(seed=0)
    yield env
    env.close()


def turn(axis, angle):
    """Quaternion of a turn about an axis (3,) of length 1."""
    return tuple(math.sin(angle / 2) * np.array(axis, float)) + (math.cos(angle / 2),)


def put(env, cube, position, quaternion=STILL, velocity=(0, 0, 0), spin=(0, 0, 0)):
    """Place cube number `cube` somewhere, as PyBullet does it."""
    body = env._cubes[cube]
    pb.resetBasePositionAndOrientation(body, position, quaternion, **env._world)
    pb.resetBaseVelocity(body, velocity, spin, **env._world)


def pose_of(env, cube):
    """Position and quaternion of cube number `cube`, from PyBullet."""
    return pb.getBasePositionAndOrientation(env._cubes[cube], **env._world)


def joints(env):
    """Angle, velocity, forces and torque of the nine joints, from PyBullet."""
    return [state for finger in env._fingers
            for state in pb.getJointStates(finger, range(3), **env._world)]


def angles(env):
    """Joint angles (9,), from PyBullet."""
    return np.array([state[0] for state in joints(env)])


def set_joints(env, q):
    for j in range(9):
        pb.resetJointState(env._fingers[j // 3], j % 3, q[j], 0.0, **env._world)


def drive(env, bodies, targets):
    """Ask the joints of some bodies, taken in order, for angles."""
    each = len(targets) // len(bodies)
    for body, part in zip(bodies, np.reshape(targets, (len(bodies), each)).tolist()):
        pb.setJointMotorControlArray(body, range(each), pb.POSITION_CONTROL, targetPositions=part,
                                     forces=[0.36] * each, **env._world)


def let_run(env, steps):
    for _ in range(steps):
        pb.stepSimulation(**env._world)


def fingertip(env, k):
    """Tip of finger k from PyBullet's forward kinematics."""
    state = pb.getLinkState(env._fingers[k], 2, computeForwardKinematics=1, **env._world)
    return np.array(pb.multiplyTransforms(state[4], state[5], [0, -0.008, -0.16], STILL)[0])


def test_kinematics_against_pybullet(env):
    rng = np.random.default_rng(0)
    for q in rng.uniform(tri.JOINT_LOW * 3, tri.JOINT_HIGH * 3, (50, 9)):
        set_joints(env, q)
        for k in range(3):
            ours = tri.forward_kinematics(k, q[3 * k:3 * k + 3])
            np.testing.assert_allclose(ours, fingertip(env, k), atol=1e-6)


def test_kinematics_by_hand():
    """TriFingerEdu at rest: x = -0.16 (sin 0.55 + sin -0.15) - 0.0455, y = -0.05945,
    z = 0.34 - 0.16 (cos 0.55 + cos -0.15), then turned by -90 degrees for finger 0."""
    x, y, z = -0.105221, -0.05945, 0.045396
    np.testing.assert_allclose(tri.forward_kinematics(0, tri.REST), (y, -x, z), atol=1e-5)
    others = [np.array(tri.forward_kinematics(k, tri.REST)) for k in (1, 2)]
    distance = math.sqrt(3) * math.hypot(x, y)                 # a triangle of equal sides
    for tip in others:
        assert math.dist(tip, (y, -x, z)) == pytest.approx(distance, abs=1e-5)
    assert math.dist(*others) == pytest.approx(distance, abs=1e-5)


def test_inverse_kinematics_undoes_the_forward_ones():
    rng = np.random.default_rng(0)
    for q in rng.uniform([-1.0, -0.8, -2.4], [0.8, 0.8, -0.1], (50, 3)):
        for k in range(3):
            tip = tri.forward_kinematics(k, q)
            again = tri.forward_kinematics(k, tri.inverse_kinematics(k, tip))
            np.testing.assert_allclose(again, tip, atol=1e-9)
    for far in ((1.0, 0.0, 0.0), (0.0, 0.0, 0.34)):            # too far; inside the finger's plane
        with pytest.raises(ValueError, match="cannot reach"):
            tri.inverse_kinematics(0, far)


def test_masses_and_limits_are_those_of_trifinger_edu(env):
    """Numbers of TriFingerEdu's URDF, as PyBullet has taken them up."""
    masses, inertias = (0.14854, 0.14854, 0.0407), (4.1e-4, 4.1e-4, 1.6e-4)
    limits = ((-1.57, 1.0), (-1.2, 1.57), (-3.0, 3.0))
    for finger, j in itertools.product(env._fingers, range(3)):
        mass, _, inertia, *_ = pb.getDynamicsInfo(finger, j, **env._world)
        assert mass == pytest.approx(masses[j])
        assert max(inertia) == pytest.approx(inertias[j])
        info = pb.getJointInfo(finger, j, **env._world)
        damping, lower, upper, effort = info[6], *info[8:11]
        assert (lower, upper) == limits[j]
        assert effort == pytest.approx(0.36) and damping == 0
    assert len(env._fingers) == 3


@pytest.mark.parametrize("options, mass, friction", [
    ({}, 0.08, 1.0), ({"cube_mass": 0.02, "finger_friction": 0.1}, 0.02, 0.1)])
def test_mass_and_friction_are_those_asked_for(options, mass, friction):
    env = TriFingerEnv(distractors=1, **options)
    env.reset(seed=0)
    for cube in env._cubes:
        assert pb.getDynamicsInfo(cube, -1, **env._world)[:2] == (mass, 1.0)
    for finger, j in itertools.product(env._fingers, range(3)):
        assert pb.getDynamicsInfo(finger, j, **env._world)[1] == friction
    env.close()


@pytest.mark.parametrize("substeps, dt, rate", [(5, 0.008, 25), (3, 0.004, 83)])
def test_a_cube_falls_by_gravity_for_the_time_of_a_step(substeps, dt, rate):
    """h = g t^2 / 2; in discrete steps of dt it is g t (t + dt) / 2."""
    env = TriFingerEnv(distractors=0, substeps=substeps, timestep=dt)
    assert env.metadata["render_fps"] == rate
    env.reset(seed=0)
    put(env, 0, (0, 0, 0.7))
    env.step(np.zeros(9))
    fallen = 0.7 - pose_of(env, 0)[0][2]
    env.close()
    t = substeps * dt
    assert fallen == pytest.approx(9.81 * t * (t + dt) / 2, rel=1e-3)


@pytest.mark.parametrize("share, slides", [(0.9, False), (1.1, True)])
def test_friction_of_a_cube_on_the_floor(env, share, slides):
    """A cube slides once a sideways force exceeds mu m g, with mu = 1.0 x 0.5; it stays below."""
    env.reset(seed=1)
    put(env, 0, (0, 0, tri.CUBE / 2))
    for cube in (1, 2):
        put(env, cube, (0.15, 0.1, cube))
    set_joints(env, (0.0, 1.4, -1.0) * 3)
    force = share * 0.5 * 0.08 * 9.81
    for _ in range(60):
        at, _ = pose_of(env, 0)
        pb.applyExternalForce(env._cubes[0], -1, [force, 0, 0], at, pb.WORLD_FRAME, **env._world)
        pb.stepSimulation(**env._world)
    moved = pose_of(env, 0)[0][0]
    assert (moved > 0.01) == slides, moved


def test_the_wall_is_closed_and_stands_at_its_radius(env):
    """Rays from the middle: the nearest wall at 0.242 m, the farthest in 12 sides' corners."""
    env.reset(seed=0)
    for height in (0.1, 0.19):
        angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
        outside = 0.4 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        start = np.array([0, 0, height])
        set_joints(env, (-1.5, 1.5, 0.0) * 3)                  # fingers out of the way
        for cube in range(3):
            put(env, cube, (0, 0, 1 + cube))
        for body, _, share, *_ in pb.rayTestBatch([start] * 360, start + outside, **env._world):
            assert body not in (-1, *env._fingers)
            assert 0.242 - 1e-3 < 0.4 * share < 0.242 / math.cos(math.pi / 12) + 1e-3
    down = pb.rayTest([0.02, 0.03, 0.5], [0.02, 0.03, -0.5], **env._world)[0]
    assert down[3][2] == pytest.approx(0.0, abs=1e-6)


def test_fingers_push_with_at_most_their_torque(env):
    """The joint motors report what they apply: full speed asks for all of it, nothing for more."""
    env.reset(seed=0)
    largest = 0.0
    for t in range(20):
        env.step(np.full(9, (-1.0) ** (t // 2)))
        largest = max(largest, *(abs(state[3]) for state in joints(env)))
    assert largest == pytest.approx(0.36, rel=1e-3)


def as_one_body(env):
    """Take the three fingers out of the world and load one robot of nine joints in their place."""
    robot = ElementTree.Element("robot", name="trifinger")
    ElementTree.SubElement(robot, "link", name="base")
    for k, ((x, y, z), yaw) in enumerate(zip(tri.FINGER_MOUNT, tri.FINGER_YAW)):
        finger = ElementTree.fromstring(tri.finger_urdf())
        finger.remove(finger.find("link"))                     # its own base
        mount = finger.find("joint").find("origin")
        mount.set("xyz", f"{x} {y} {z}")
        mount.set("rpy", f"0 0 {yaw}")
        for part in finger.iter():
            for key in ("name", "link"):
                if part.get(key) in ("upper", "middle", "lower"):
                    part.set(key, f"{part.get(key)}{k}")
            if part.tag == "joint":
                part.set("name", f"{part.get('name')} of finger {k}")
        robot.extend(finger)
    for finger in env._fingers:
        pb.removeBody(finger, **env._world)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "robot.urdf")
        ElementTree.ElementTree(robot).write(path)
        flags = pb.URDF_USE_INERTIA_FROM_FILE | pb.URDF_USE_SELF_COLLISION
        body = pb.loadURDF(path, useFixedBase=1, flags=flags, **env._world)
    assert pb.getNumJoints(body, **env._world) == 9
    for j in range(9):
        assert pb.getJointInfo(body, j, **env._world)[12].decode().endswith(str(j // 3))
        pb.changeDynamics(body, j, lateralFriction=1.0, linearDamping=0, angularDamping=0,
                          jointDamping=0, **env._world)
        pb.resetJointState(body, j, tri.REST[j % 3], 0.0, **env._world)
    return body


@pytest.mark.parametrize("iterations, tolerance", [(500, 1e-12), (8, 1e-2)])
def test_three_fingers_move_as_one_robot_of_nine_joints_does(iterations, tolerance):
    """The base is fixed, so the dynamics are the same: equal to rounding once the solver has run
    until nothing changes, and within 10 mrad after our 8 iterations."""
    three, one = (TriFingerEnv(distractors=0) for _ in range(2))
    for env in (three, one):
        env.reset(seed=0)
        put(env, 0, (0.18, 0.0, tri.CUBE / 2))                 # out of the way
        pb.setPhysicsEngineParameter(numSolverIterations=iterations, solverResidualThreshold=0,
                                     **env._world)
    robot = as_one_body(one)
    rng = np.random.default_rng(0)
    target = np.array(tri.REST * 3)
    for _ in range(20):
        target = target + rng.uniform(-0.1, 0.1, 9)
        drive(three, three._fingers, target)
        drive(one, [robot], target)
        for env in (three, one):
            let_run(env, 5)
        states = pb.getJointStates(robot, range(9), **one._world)
        np.testing.assert_allclose(angles(three), [state[0] for state in states], atol=tolerance)
    assert np.abs(angles(three) - tri.REST * 3).max() > 0.2    # the fingers have moved
    three.close()
    one.close()


def test_cubes_rest_without_jitter():
    env = TriFingerEnv()
    env.reset(seed=0)
    let_run(env, 250)
    for cube in range(3):
        speeds = pb.getBaseVelocity(env._cubes[cube], **env._world)
        assert np.abs(speeds).max() < 1e-3
        assert abs(pose_of(env, cube)[0][2] - tri.CUBE / 2) < 1e-4
    env.close()


def test_fingers_at_full_speed_do_not_pass_through_cubes():
    """2 m/s in steps of 8 ms: how deep in a cube is a tip's centre? A cube is 65 mm wide."""
    env = TriFingerEnv(substeps=1, episode_steps=10 ** 6)
    deepest, touched = 0.0, 0
    for seed in range(6):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for t in range(500):
            if t % 25 == 0:
                bang = np.sign(rng.uniform(-1, 1, 9))
            env.step(bang)
            touched += any(pb.getContactPoints(finger, cube, **env._world)
                           for finger in env._fingers for cube in env._cubes)
            for position, quaternion in env._poses:
                local = np.subtract(env._moment.tips, position) @ tri.rotation(quaternion)
                inside = tri.CUBE / 2 - np.abs(local).max(axis=1)
                deepest = max(deepest, inside.max())
    env.close()
    assert touched > 50 and deepest < 0.005, (touched, deepest)


def pushed(timestep):
    """Where a cube ends that finger 0 pushes along x for a second, at 0.1 m/s."""
    env = TriFingerEnv(substeps=1, timestep=timestep)
    env.reset(seed=0)
    put(env, 0, (0, 0, tri.CUBE / 2))
    put(env, 1, (0.1, 0.15, tri.CUBE / 2))
    put(env, 2, (0.1, -0.15, tri.CUBE / 2))
    start, heading = np.array([-0.065, 0.01, 0.035]), np.array([0.1, 0.0, 0.0])
    lifted = (0.0, 1.4, -1.0) * 2                              # the other two fingers
    set_joints(env, [*tri.inverse_kinematics(0, start), *lifted])
    for step in range(round(1 / timestep)):
        pushing = tri.inverse_kinematics(0, start + step * timestep * heading)
        drive(env, env._fingers, [*pushing, *lifted])
        let_run(env, 1)
    end = np.array(pose_of(env, 0)[0])
    env.close()
    return end


def test_a_slow_push_carries_a_cube_as_far_in_long_steps_as_in_short_ones():
    long_steps, short_steps = pushed(0.008), pushed(0.002)
    assert short_steps[0] > 0.04
    assert np.linalg.norm(long_steps - short_steps) < 0.015


def reach_for(env, points, actions=25):
    """Let the commanded fingertips go to three points (3, 3) in as many actions."""
    wanted = [q for k in range(3) for q in tri.inverse_kinematics(k, points[k])]
    for left in range(actions, 0, -1):
        env.step(np.subtract(wanted, env._joint_targets) / left / env.action_scale)


def grasp_and_raise(task, depth=0.02, **physics):
    """Heights of the cube while it is held for two seconds by zero actions, after three fingertips
    have closed round it, pressed `depth` (m) inwards and risen to 0.15 m."""
    env = TriFingerEnv(task, 0, episode_steps=1000, **physics)
    env.reset(seed=0)
    put(env, 0, (0, 0, tri.CUBE / 2))
    sides = np.array([[x, y, 0] for x, y, _ in tri.FINGER_MOUNT]) / 0.0455     # unit vectors
    pressed = tri.CUBE / 2 - depth
    for radius, height in ((0.08, 0.03), (pressed, 0.03), (pressed, 0.15)):
        reach_for(env, radius * sides + [0, 0, height])
    heights = []
    for _ in range(50):
        env.step(np.zeros(9))
        heights.append(pose_of(env, 0)[0][2])
    env.close()
    return np.array(heights)


@pytest.mark.parametrize("task", ["push", "lift"])
def test_a_cube_can_be_lifted_and_held(task):
    """By inverse kinematics, nothing is learnt. With CausalWorld's friction nothing holds."""
    heights = grasp_and_raise(task)
    assert heights.min() > 0.14, heights.min()
    heights = grasp_and_raise(task, finger_friction=0.1)
    assert heights.max() < 0.05, heights.max()


def test_a_cube_is_held_in_long_steps_as_in_short_ones():
    long_steps = grasp_and_raise("lift", substeps=5, timestep=0.008)
    short_steps = grasp_and_raise("lift", substeps=20, timestep=0.002)
    assert short_steps.min() > 0.14
    assert np.abs(long_steps - short_steps)[25:].max() < 0.001             # after a second


# ---------------------------------------------------------------- the robot's picture

def drawn(link):
    """What is drawn of a link: lists (start, end, radius) in its frame; a ball has no length."""
    for visual in link.findall("visual"):
        place, shape = visual.find("origin"), visual.find("geometry")[0]
        centre = np.array(place.get("xyz").split(), float)
        _, pitch, yaw = map(float, place.get("rpy").split())
        half = float(shape.get("length", 0)) / 2
        along = np.array([math.sin(pitch) * math.cos(yaw), math.sin(pitch) * math.sin(yaw),
                          math.cos(pitch)])                    # the z axis after pitch and yaw
        yield centre - half * along, centre + half * along, float(shape.get("radius"))


def gap_to(point, link):
    """Distance (m) from a point to what is drawn of a link; 0 inside."""
    gaps = []
    for start, end, radius in drawn(link):
        way = end - start
        share = np.clip((point - start) @ way / max(way @ way, 1e-12), 0, 1)
        gaps.append(np.linalg.norm(point - start - share * way) - radius)
    return max(min(gaps), 0.0)


def hangs_together(link):
    """Do the drawn parts of a link touch each other, at most 3 mm apart?"""
    parts = list(drawn(link))
    share = np.linspace(0, 1, 50)[:, None]

    def touch(a, b):
        lines = [start + share * (end - start) for start, end, _ in (a, b)]
        apart = np.linalg.norm(lines[0][:, None] - lines[1][None], axis=2).min()
        return apart - a[2] - b[2] < 0.003

    reached = [parts.pop()]
    for _ in range(len(parts)):
        found = [i for i, part in enumerate(parts) if any(touch(part, at) for at in reached)]
        reached += [parts.pop(i) for i in reversed(found)]
    return not parts


def test_the_robots_drawn_parts_are_joined_from_the_mount_to_the_tip():
    robot = ElementTree.fromstring(tri.finger_urdf())
    links = {link.get("name"): link for link in robot.findall("link")}
    assert len(robot.findall("joint")) == 3
    for joint in robot.findall("joint"):
        place = np.array(joint.find("origin").get("xyz").split(), float)
        parent, child = (links[joint.find(end).get("link")] for end in ("parent", "child"))
        assert gap_to(place, parent) < 0.003, joint.get("name")
        assert gap_to(np.zeros(3), child) < 0.003, joint.get("name")
    assert all(map(hangs_together, links.values()))
    assert gap_to(np.array([0, -0.008, -0.16]), links["lower"]) == 0       # the tip
    away = np.array([0.05, 0.05, 0.0])
    assert gap_to(away, links["lower"]) > 0.03                 # and the measure can tell
    for x, y, _ in tri.FINGER_MOUNT:                           # bars meet in the robot's centre
        assert gap_to(np.array([math.hypot(x, y), 0, 0]), links["base"]) == 0


def test_only_lower_links_can_touch_things(env):
    for finger, j in itertools.product(env._fingers, range(-1, 3)):
        shapes = pb.getCollisionShapeData(finger, j, **env._world)
        assert len(shapes) == (j == 2)
        for shape in shapes:
            length, radius = shape[3][:2]
            assert (length, radius) == pytest.approx((0.16, 0.0095))


# ---------------------------------------------------------------- fractional success

def test_overlap_against_hand_computed_cases():
    side, z = tri.CUBE, tri.CUBE / 2
    goal = ((0.0, 0.0, z), STILL)
    eighth = turn((0, 0, 1), math.pi / 4)
    for cube, aabb, strict in (
            (goal, 1.0, 1.0),
            (((0.013, 0.0, z), STILL), 0.8, 0.8),              # 13 mm of 65 mm
            (((side / 2, side / 2, z + side / 2), STILL), 0.125, 0.125),
            (((side, 0.0, z), STILL), 0.0, 0.0),
            (((0.0, 0.0, z), eighth), 1.0, 2 * (math.sqrt(2) - 1)),        # square's octagon
            (((0.01, 0.0, z), eighth), 1.0, None),             # lenient: still 1.0, 1 cm off
            (((side / 2, side / 2, z), eighth), None, 0.25),   # two edges lie in a plane of goal's
            (((0.0, 0.0, z), turn((1, 0, 0), math.pi / 2)), 1.0, 1.0)):
        if aabb is not None:
            assert tri.aabb_overlap(cube, goal) == pytest.approx(aabb, abs=1e-9)
        if strict is not None:
            assert tri.oriented_overlap(cube, goal) == pytest.approx(strict, abs=1e-9)


def test_overlap_against_monte_carlo_volumes():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (100_000, 3))              # inside a cube of edge 1
    for _ in range(12):
        centres = rng.uniform(-0.025, 0.025, (2, 3))
        quaternions = rng.normal(size=(2, 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        cube, goal = zip(map(tuple, centres), map(tuple, quaternions))
        of_cube, of_goal = tri.rotation(cube[1]), tri.rotation(goal[1])

        world = points * tri.CUBE @ of_goal.T + goal[0]
        inside = np.abs((world - cube[0]) @ of_cube) < tri.CUBE / 2
        share = inside.all(axis=1).mean()
        assert tri.oriented_overlap(cube, goal) == pytest.approx(share, abs=0.006)

        half_goal = np.abs(of_goal).sum(1) * tri.CUBE / 2
        half_cube = np.abs(of_cube).sum(1) * tri.CUBE / 2
        world = points * 2 * half_goal + goal[0]
        share = (np.abs(world - cube[0]) < half_cube).all(axis=1).mean()
        assert tri.aabb_overlap(cube, goal) == pytest.approx(share, abs=0.006)


def test_success_is_measured_on_the_target_and_strictly_at_the_end():
    """The target lies on the goal, turned by 45 degrees: 1 by boxes, an octagon by volumes."""
    env = TriFingerEnv(episode_steps=2)
    for seed in range(4):
        env.reset(seed=seed)
        for cube in range(3):
            if cube != env.target:
                put(env, cube, (0.15, 0.1 * (-1) ** cube, 0.2))
        put(env, env.target, env.goal[0], turn((0, 0, 1), math.pi / 4))
        _, _, _, _, info = env.step(np.zeros(9))
        assert "fractional_success_strict" not in info and "truncated_by" not in info
        _, _, _, _, info = env.step(np.zeros(9))
        assert info["fractional_success"] == pytest.approx(1.0, abs=0.01)
        octagon = 2 * (math.sqrt(2) - 1)
        assert info["fractional_success_strict"] == pytest.approx(octagon, abs=0.01)
    env.close()


# ---------------------------------------------------------------- the start of an episode

def outline(x, y, yaw, points=14):
    """Points on the edges of a cube's square, seen from above (n, 2)."""
    edge = np.linspace(-0.5, 0.5, points) * tri.CUBE
    end = tri.CUBE * 0.49
    square = np.array([(u, v) for u in edge for v in edge if max(abs(u), abs(v)) > end])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return square @ np.array([[cos, sin], [-sin, cos]]) + [x, y]


def inside_square(points, x, y, yaw):
    """(n,) bool: which points (n, 2) lie in a cube's square?"""
    cos, sin = np.cos(yaw), np.sin(yaw)
    local = (points - [x, y]) @ np.array([[cos, -sin], [sin, cos]])
    return np.abs(local).max(axis=1) <= tri.CUBE / 2


@pytest.mark.parametrize("n", [0, 1, 2, 5, 9, 14, 20])
def test_nothing_overlaps_at_the_start(n):
    """No cube in another, on the goal, at a fingertip or beyond the wall, by points on edges."""
    env = TriFingerEnv(distractors=n)
    env._np_random = np.random.default_rng(0)
    tips = np.array([tri.forward_kinematics(k, tri.REST)[:2] for k in range(3)])
    for _ in range(1 if n > 14 else 30):                       # 20 distractors take seconds
        poses = env._place()
        assert poses.shape == (n + 2, 3)
        outlines = [outline(*pose) for pose in poses]
        for i, pose in enumerate(poses):
            others = [points for j, points in enumerate(outlines) if j != i]
            assert not inside_square(np.concatenate([*others, tips]), *pose).any()
            assert np.hypot(*outlines[i].T).max() < 0.242
    env.close()


def test_candidates_are_uniform_by_area_and_in_every_direction(env):
    env._np_random = np.random.default_rng(0)
    x, y, yaw, half = env._draw_squares(0.2, 0.5, count=5000).T
    assert is_uniform((x * x + y * y) / 0.2 ** 2)
    assert is_uniform(np.arctan2(y, x), -math.pi, math.pi)
    assert is_uniform(yaw, -0.5, 0.5)
    assert (half >= tri.CUBE / 2).all() and (half < tri.CUBE / 2 + 0.001).all()


@functools.cache
def starts(count, **options):
    """Starts of `count` episodes: goals and targets (count, 3) as x, y, yaw, goal's heights."""
    env = TriFingerEnv(**options)
    goals, targets, heights = [], [], []
    for episode in range(count):
        env.reset(seed=None if episode else 0)
        for found, (position, q) in ((goals, env.goal), (targets, pose_of(env, env.target))):
            found.append([*position[:2], 2 * math.atan2(q[2], q[3])])
        heights.append(env.goal[0][2])
    env.close()
    return np.array(goals), np.array(targets), np.array(heights)


def test_goals_are_uniform_where_a_finger_can_get_behind_them():
    """Against rejection by hand: uniform in a disc of 0.124 m, except on the three fingertips."""
    goals, _, heights = starts(2000, distractors=0)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.124, 0.124, (2, 200_000))
    possible = np.hypot(x, y) < 0.124
    for k in range(3):
        tip = tri.forward_kinematics(k, tri.REST)
        side = tri.CUBE / 2 + 0.0145                           # of a square around the tip
        possible &= (np.abs(x - tip[0]) > side) | (np.abs(y - tip[1]) > side)
    x, y = x[possible], y[possible]
    for ours, by_hand in ((goals[:, 0], x), (goals[:, 1], y),
                          (np.hypot(*goals[:, :2].T), np.hypot(x, y))):
        assert is_uniform(np.searchsorted(np.sort(by_hand), ours) / len(by_hand))
    assert not goals[:, 2].any() and (heights == tri.CUBE / 2).all()


def test_targets_start_where_goals_lie_and_are_turned():
    _, targets, _ = starts(2000, distractors=0)
    reach = np.hypot(*targets[:, :2].T)
    assert 0.95 * 0.124 < reach.max() < 0.124
    # A free target is turned anyhow; beside the goal some turns do not fit.
    assert np.abs(targets[:, 2]).max() <= math.pi / 4 + 1e-6
    assert np.abs(targets[:, 2]).mean() == pytest.approx(math.pi / 8, rel=0.05)
    assert np.mean(targets[:, 2]) == pytest.approx(0, abs=0.05)


def test_goals_are_turned_as_much_as_asked_for():
    goals, _, _ = starts(1000, distractors=0, goal_yaw=0.3)
    assert is_uniform(goals[:, 2], -0.3, 0.3)


def test_lifting_goals_reach_up_to_20_cm():
    _, _, heights = starts(1000, task="lift", distractors=0)
    assert is_uniform(heights, tri.CUBE / 2, 0.2)


def test_distractors_lie_anywhere_in_the_arena():
    """Uniform by area: more than half of them outside the disc of goal and target."""
    env = TriFingerEnv(distractors=1)
    radius = []
    for episode in range(500):
        env.reset(seed=None if episode else 0)
        radius.append(np.hypot(*pose_of(env, 1 - env.target)[0][:2]))
    env.close()
    assert max(radius) > 0.195 and min(radius) < 0.04
    assert np.mean(np.array(radius) > 0.124) > 0.55


def test_goal_target_and_first_distractors_do_not_depend_on_how_many_there_are():
    for seed in range(5):
        places = {}
        for n in (0, 2, 9):
            env = TriFingerEnv(distractors=n)
            env.reset(seed=seed)
            others = [cube for cube in range(n + 1) if cube != env.target]
            cubes = [pose_of(env, cube)[0][:2] for cube in (env.target, *others)]
            places[n] = np.array([env.goal[0][:2], *cubes])
            env.close()
        for n in (0, 2):
            assert np.abs(places[n] - places[9][:n + 2]).max() < 1e-9


@pytest.mark.parametrize("n", [0, 1, 2, 5, 9, 20])
def test_the_goal_names_the_target_and_no_other_cube(n):
    """Every index is the target equally often; identifiers are distinct and from the pool."""
    env = TriFingerEnv(distractors=n)
    env._np_random = np.random.default_rng(3)
    poses = env._place()
    env._place = lambda: poses                                 # 20 distractors take seconds
    pool = np.arange(-10, 11) / 10
    resets = max(60 * (n + 1), 300)
    drawn, used = [], []
    for _ in range(resets):
        obs, _ = env.reset()
        identifiers = obs["cubes"][:, -1]
        named = np.flatnonzero(identifiers == obs["goal"][-1])
        assert named.tolist() == [env.target]
        assert len(set(identifiers)) == n + 1
        assert np.abs(identifiers[:, None] - pool).min(axis=1).max() < 1e-6
        np.testing.assert_allclose(0.2 * obs["cubes"][env.target, 4:6], poses[1, :2], atol=1e-6)
        positions = [pose_of(env, cube)[0] for cube in range(n + 1)]         # row i is cube i
        np.testing.assert_allclose(0.2 * obs["cubes"][:, 4:7], positions, atol=1e-6)
        drawn.append(env.target)
        used += identifiers.tolist()
    counts = np.bincount(drawn, minlength=n + 1)
    expected = resets / (n + 1)
    spread = np.square(counts - expected).sum() / expected     # chi-square: n +- sqrt(2 n)
    assert spread <= n + 4 * math.sqrt(2 * n), counts
    shares = np.unique(np.round(used, 1), return_counts=True)[1] / len(used)
    assert len(shares) == 21 and shares.max() < 0.12           # 1 / 21 each
    obs = env.step(np.zeros(9))[0]
    assert obs["cubes"][env.target, -1] == obs["goal"][-1]
    env.close()


def test_every_episode_starts_at_rest(env):
    """Whatever happened before: cubes still on the floor, joints at the same angles, no speed."""
    for seed in (0, None):
        env.reset(seed=0)
        put(env, 0, (0, 0, 0.3), velocity=(1, 2, 3), spin=(4, 5, 6))
        env.step(np.ones(9))
        obs, info = env.reset(seed=seed)
        assert not obs["cubes"][:, 11:17].any() and not obs["fingers"][:, 3:6].any()
        np.testing.assert_allclose(angles(env), (0.0, 0.55, -0.7) * 3, atol=1e-9)
        for cube in range(3):
            (_, _, z), quaternion = pose_of(env, cube)
            assert z == pytest.approx(tri.CUBE / 2) and quaternion[:2] == (0, 0)
        rho = tri.aabb_overlap(pose_of(env, env.target), env.goal)
        assert info == {"fractional_success": pytest.approx(rho)}


# ---------------------------------------------------------------- a step

@pytest.mark.parametrize("n", [0, 2])
def test_same_seed_same_trajectory_bit_for_bit(n):
    def trajectory(env, seed):
        rng = np.random.default_rng(seed)
        observations = [env.reset(seed=seed)[0]]
        for _ in range(120):
            observations.append(env.step(np.sign(rng.uniform(-1, 1, 9)))[0])
        return np.array([np.concatenate([value.ravel() for value in obs.values()])
                         for obs in observations])

    used, fresh = TriFingerEnv(distractors=n), TriFingerEnv(distractors=n)
    for seed in (0, 1, 2):
        trajectory(used, seed)
    assert np.array_equal(trajectory(used, 7), trajectory(fresh, 7))
    assert not np.array_equal(trajectory(used, 7), trajectory(fresh, 8))
    used.close()
    fresh.close()


def moving(env):
    """An observation in which everything moves, and one cube's quaternion has a negative w."""
    env.reset(seed=3)
    for _ in range(5):
        env.step(np.full(9, 0.5))
    quaternion = turn((0, 0, 1), 1.2 * math.pi)
    put(env, 0, (0.02, 0.03, 0.2), quaternion, velocity=(0.1, 0.2, -0.3), spin=(3, 2, 1))
    put(env, 1, (-0.05, 0.01, 0.3), velocity=(-0.3, 0.1, 0.2), spin=(-1, 2, -3))
    obs, *_ = env.step(np.linspace(-1, 1, 9))
    assert quaternion[3] < 0 and pose_of(env, 0)[1][3] < 0     # PyBullet shows the sign as it was
    return obs


# Table 1 and what its numbers are divided by: 0.065 m, 0.2 m, 0.5 m/s, 10 rad/s, 1.5 rad are 1.
CUBE_UNITS = [1, *[0.065] * 3, *[0.2] * 3, *[1] * 4, *[0.5] * 3, *[10] * 3, 1]
FINGER_UNITS = [*[1.5] * 3, *[10] * 3, 1, *[0.2] * 3]
GOAL_UNITS = [1, *[0.065] * 3, *[0.2] * 3, *[1] * 4, 1]


def test_observation_is_table_1(env):
    """Every entry against PyBullet's own state, with the scaling undone by hand."""
    obs = moving(env)
    form = {key: (value.shape, value.dtype) for key, value in obs.items()}
    assert form == {"cubes": ((3, 18), np.float32), "fingers": ((3, 10), np.float32),
                    "goal": ((12,), np.float32)}
    size = [0.065] * 3
    for cube, row in enumerate(obs["cubes"] * CUBE_UNITS):
        position, quaternion = pose_of(env, cube)
        if quaternion[3] < 0:                                  # q and -q are the same turn
            quaternion = -np.array(quaternion)
        linear, angular = pb.getBaseVelocity(env._cubes[cube], **env._world)
        identifier = env._ids[cube]
        expected = [1, *size, *position, *quaternion, *linear, *angular, identifier]
        np.testing.assert_allclose(row, expected, atol=1e-5)
    rows = obs["fingers"] * FINGER_UNITS
    states = joints(env)
    for k, row in enumerate(rows):
        q = [state[0] for state in states[3 * k:3 * k + 3]]
        dq = [state[1] for state in states[3 * k:3 * k + 3]]
        np.testing.assert_allclose(row[:7], [*q, *dq, k - 1], atol=1e-5)
    set_joints(env, env._joint_targets)
    for k, row in enumerate(rows):                             # where the finger is told to be
        np.testing.assert_allclose(row[7:], fingertip(env, k), atol=1e-5)
    position, quaternion = env.goal
    expected = [1, *size, *position, *quaternion, env._ids[env.target]]
    np.testing.assert_allclose(obs["goal"] * GOAL_UNITS, expected, atol=1e-5)


def test_columns_are_picked_out_by_their_names(env):
    """What train.py and evaluate.py read by name; the columns themselves are tested above."""
    obs = moving(env)
    row = (obs["cubes"] * CUBE_UNITS)[1]
    position, quaternion = pose_of(env, 1)
    linear, angular = pb.getBaseVelocity(env._cubes[1], **env._world)
    for columns, expected in ((tri.SIZE, [0.065] * 3), (tri.POSITION, position),
                              (tri.QUATERNION, quaternion), (tri.LINEAR, linear),
                              (tri.ANGULAR, angular), (tri.IDENTIFIER, env._ids[1])):
        np.testing.assert_allclose(row[columns], expected, atol=1e-5)
    fingers = obs["fingers"] * FINGER_UNITS
    assert fingers[:, tri.FINGER_IDENTIFIER].tolist() == [-1, 0, 1]
    set_joints(env, env._joint_targets)
    np.testing.assert_allclose(fingers[2, tri.FINGERTIP], fingertip(env, 2), atol=1e-5)


@pytest.mark.parametrize("mode, options, scale", [
    ("integrated", {}, 0.1), ("integrated", {"action_scale": 0.06}, 0.06),
    ("delta", {"action_scale": 0.3}, 0.3), ("absolute", {}, None)])
def test_actions_ask_for_the_angles_they_should(monkeypatch, mode, options, scale):
    """What reaches PyBullet's motors: integrated adds to the last targets, at most 0.25 rad off
    the measured angles; delta adds to these; absolute spans the joint range."""
    asked = []
    monkeypatch.setattr(pb, "setJointMotorControlArray",
                        lambda *_, targetPositions, **__: asked.extend(targetPositions))
    low, high = np.array(tri.JOINT_LOW * 3), np.array(tri.JOINT_HIGH * 3)
    env = TriFingerEnv(distractors=0, action_mode=mode, **options)
    slope = np.linspace(-1, 1, 9)
    for episode in range(2):                                   # the second one starts afresh, too
        env.reset(seed=episode or None)
        target = np.array((0.0, 0.55, -0.7) * 3)
        for action in (np.zeros(9), np.ones(9), -np.ones(9), slope, slope, slope, slope, 0 * slope):
            q = angles(env)
            asked.clear()
            env.step(action)
            if mode == "integrated":
                target = np.clip(target + scale * action, q - 0.25, q + 0.25)
            elif mode == "delta":
                target = q + scale * action
            else:
                target = (low + high) / 2 + action * (high - low) / 2
            np.testing.assert_allclose(asked, target, atol=1e-9)
    set_joints(env, (0.9, -1.1, 2.9) * 3)
    env._read()
    asked.clear()
    env._joint_targets = list((0.95, -1.15, 2.95) * 3)
    env.step(np.array([1, -1, 1] * 3))
    np.testing.assert_allclose(asked, (1.0, -1.2, 3.0) * 3, atol=1e-9)     # the joints' limits
    env.close()


def test_fingertips_are_seen_where_they_are_told_to_be_if_targets_stay():
    """Targets that stay are a state: integrated mode shows them, the others what is measured."""
    for mode in ("integrated", "delta", "absolute"):
        env = TriFingerEnv(distractors=0, action_mode=mode)
        obs, _ = env.reset(seed=0)
        for _ in range(4):
            obs, *_ = env.step(np.linspace(-1, 1, 9))
        shown = obs["fingers"][:, 7:] * 0.2
        measured = [fingertip(env, k) for k in range(3)]
        is_measured = np.abs(shown - measured).max() < 1e-5
        assert is_measured == (mode != "integrated")
        env.close()


def test_actions_beyond_their_range_count_as_its_ends():
    far, near = TriFingerEnv(distractors=0), TriFingerEnv(distractors=0)
    far.reset(seed=5)
    near.reset(seed=5)
    action = np.array([50.0, -50.0, 50.0] * 3)
    ours, _, _, _, _ = far.step(action)
    expected, _, _, _, _ = near.step(np.sign(action))
    assert np.array_equal(ours["fingers"], expected["fingers"])
    far.close()
    near.close()


@pytest.mark.parametrize("weights", [
    {"overlap": 100.0, "distance": 250.0, "curiosity": 10.0, "reach": 7.0},
    {"overlap": 3.0},                                          # the others stay as they are
])
def test_reward_terms_add_up_and_follow_their_formulas(weights):
    """Equation 2 from PyBullet's state before and after; the target is knocked about."""
    env = TriFingerEnv(distractors=1, reward_weights=weights)
    env.reset(seed=0)
    by_default = {"overlap": 100.0, "distance": 5000.0, "curiosity": 0.0, "reach": 2500.0}
    weights = {**by_default, **weights}
    goal = env.goal[0]
    successes = []
    for t in range(30):
        put(env, env.target, np.add(goal, [0.002 * t, 0.001, 0.0]), velocity=(0.1, 0.2, 0.0))
        env._read()
        env._moment = env._measure()
        before, _ = pose_of(env, env.target)
        tips_before = [fingertip(env, k) for k in range(3)]
        _, reward, _, _, info = env.step(np.sin(np.arange(9) + t / 3))
        after, _ = pose_of(env, env.target)
        tips_after = [fingertip(env, k) for k in range(3)]
        rho = tri.aabb_overlap(pose_of(env, env.target), env.goal)
        expected = {
            "overlap": rho,
            "distance": math.dist(before, goal) - math.dist(after, goal),
            "curiosity": (1 - rho) ** 0.05 * math.log(math.dist(before, after) + 1e-5),
            "reach": np.linalg.norm(np.subtract(tips_before, before))
            - np.linalg.norm(np.subtract(tips_after, after)),
        }
        expected = {name: weights[name] * value for name, value in expected.items()}
        assert info["rewards"] == pytest.approx(expected, abs=2e-3)        # tips are float32
        assert reward == pytest.approx(sum(info["rewards"].values()), abs=1e-9)
        assert info["fractional_success"] == pytest.approx(rho)
        successes.append(rho)
    env.close()
    assert max(successes) > 0.7 and min(successes) < 0.3


def test_moments_of_consecutive_steps_follow_each_other():
    """A step's rewards start from where the last step ended: they add up over an episode."""
    env = TriFingerEnv(distractors=0, reward_weights={"distance": 1.0, "reach": 1.0})
    env.reset(seed=0)
    first, _ = pose_of(env, 0)
    start = math.dist(first, env.goal[0])
    total = sum(env.step(np.sin(np.arange(9) + t / 3))[4]["rewards"]["distance"]
                for t in range(40))
    last, _ = pose_of(env, 0)
    assert total == pytest.approx(start - math.dist(last, env.goal[0]), abs=1e-9)
    env.close()


# ---------------------------------------------------------------- the end of an episode

def test_episode_ends_after_its_steps():
    env = TriFingerEnv(episode_steps=5)
    for seed in (0, None):
        env.reset(seed=seed)
        results = [env.step(np.zeros(9)) for _ in range(5)]
        assert [result[3] for result in results] == [False] * 4 + [True]
        assert not any(result[2] for result in results)
        _, reward, terminated, truncated, info = results[-1]
        assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
        assert info["truncated_by"] == "time"
        assert 0 <= info["fractional_success_strict"] <= 1
    env.close()


@pytest.mark.parametrize("place, left", [
    ((0.28, 0.0, 0.5), True), ((0.26, 0.0, 0.5), False),       # 3 cm behind the wall's surface
    ((0.0, 0.0, 1.1), True), ((0.0, 0.0, 0.95), False), ((0.0, 0.0, -1.5), True),
])
def test_a_cube_beyond_the_arena_ends_the_episode(env, place, left):
    for cube in range(3):
        env.reset(seed=0)
        put(env, cube, place)
        _, _, terminated, truncated, info = env.step(np.zeros(9))
        assert not terminated and truncated == left
        assert (info.get("truncated_by") == "a cube left the arena") == left


@pytest.mark.parametrize("kind", ["linear velocity", "angular velocity", "joint"])
def test_diverged_physics_end_the_episode_and_the_next_one_is_sound(kind):
    env = TriFingerEnv(distractors=1)
    before, _ = env.reset(seed=0)
    nans = [float("nan")] * 3
    if kind == "linear velocity":
        put(env, 1, (0, 0, 0.1), velocity=nans)
    elif kind == "angular velocity":
        put(env, 1, (0, 0, 0.1), spin=nans)
    else:
        pb.resetJointState(env._fingers[1], 1, 0.0, float("nan"), **env._world)
    obs, reward, terminated, truncated, info = env.step(np.zeros(9))
    assert info["truncated_by"] == "the physics diverged" and truncated and not terminated
    assert reward == 0 and not any(info["rewards"].values())
    assert info["fractional_success"] == info["fractional_success_strict"] == 0
    assert all(np.array_equal(obs[key], before[key]) for key in before)    # the last sound one
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(9))
    env.reset()
    for _ in range(4):
        obs, *_ = env.step(np.zeros(9))
        assert all(np.isfinite(value).all() for value in obs.values())
    env.close()


def memory():
    """Resident memory of this process in MiB (Linux)."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2 ** 20


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads memory from /proc")
@pytest.mark.parametrize("kind", ["random", "bang-bang"])
@pytest.mark.parametrize("task", ["push", "lift"])
@pytest.mark.parametrize("n", [0, 2, 9])
def test_soak(n, task, kind):
    """Random actions, and full speed this way and that: finite numbers, named ends, flat memory."""
    steps = 1_000_000 if SLOW else 500
    env = TriFingerEnv(task, n, episode_steps=125)
    rng = np.random.default_rng(n)
    ends, held = {}, []
    env.reset(seed=0)
    for step in range(steps):
        if kind == "random":
            action = rng.uniform(-1, 1, 9)
        elif step % 10 == 0:
            action = np.sign(rng.uniform(-1, 1, 9))
        obs, reward, _, truncated, info = env.step(action)
        assert math.isfinite(reward + info["fractional_success"]), step
        assert all(np.isfinite(value).all() for value in obs.values()), step
        if truncated:
            assert math.isfinite(info["fractional_success_strict"])
            reason = info["truncated_by"]
            ends[reason] = ends.get(reason, 0) + 1
            env.reset(seed=step if step % 2 else None)
        if step % (steps // 10) == 0:
            held.append(memory())
    env.close()
    print(f"\n{task} N={n} {kind}: {steps} steps, ends {ends}, memory {held[1]:.1f} MiB after a "
          f"tenth, {held[-1]:.1f} at the end")
    assert set(ends) <= {"time", "a cube left the arena", "the physics diverged"}
    assert ends["time"] >= 0.9 * steps / 125
    assert held[-1] - held[1] < 3, held


@pytest.mark.parametrize("arguments, words", [
    ({"task": "fly"}, "task must be 'push' or 'lift', got 'fly'"),
    ({"distractors": -1}, "distractors"),
    ({"distractors": 1.5}, "distractors"),
    ({"distractors": True}, "distractors"),
    ({"distractors": 21}, "holds 21 cubes"),
    ({"reward_weights": {"joy": 1}}, "joy"),
    ({"episode_steps": 0}, "positive"),
    ({"substeps": 0}, "positive"), ({"substeps": 2.5}, "positive integers"),
    ({"timestep": 0.0}, "positive"),
    ({"action_mode": "torque"}, "action_mode"),
    ({"action_scale": 0.0}, "positive"),
    ({"cube_mass": -0.08}, "positive"),
    ({"finger_friction": float("nan")}, "positive"),
    ({"goal_yaw": -0.1}, "goal_yaw"), ({"goal_yaw": float("nan")}, "goal_yaw"),
    ({"render_mode": "ascii"}, "render_mode"),
])
def test_bad_arguments_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        TriFingerEnv(**arguments)


@pytest.mark.skipif(sys.platform != "linux", reason="DISPLAY is Linux's")
def test_a_window_without_a_screen_is_refused(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ValueError, match="DISPLAY"):
        TriFingerEnv(render_mode="human")


def test_actions_that_are_not_nine_finite_numbers_are_refused():
    env = TriFingerEnv(distractors=0)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(9))
    env.reset(seed=0)
    infinite = [np.inf] + [0] * 8
    for action in (np.full(9, np.nan), np.zeros(8), np.zeros((1, 9)), "left", None, infinite, 3):
        with pytest.raises(ValueError, match="nine finite numbers"):
            env.step(action)
    with pytest.raises(RuntimeError, match="render_mode"):
        env.render()
    env.render_mode = "human"                                  # a window would show it by itself
    assert env.render() is None
    env.close()
    env.close()                                                # twice is harmless


def test_picture_shows_target_goal_and_distractors_in_their_colours():
    env = TriFingerEnv(render_mode="rgb_array")
    for seed in (3, 4, None, None):
        env.reset(seed=seed)
        image = env.render().astype(int)
        assert image.shape == (360, 480, 3)
        r, g, b = image[..., 0], image[..., 1], image[..., 2]
        blue = (b > r + 60) & (b > g + 40)
        red = (r > g + 60) & (r > b + 60)
        green = (g > r + 25) & (g > b + 25)
        seen = blue.sum(), red.sum(), green.sum()
        assert min(seen) > 100, seen
        for cube in range(3):
            shape, = pb.getVisualShapeData(env._cubes[cube], **env._world)
            color = np.array(shape[7][:3])
            assert color.argmax() == (2 if cube == env.target else 0)
        goal, _ = pb.getBasePositionAndOrientation(env._goal_picture, **env._world)
        np.testing.assert_allclose(goal, env.goal[0], atol=1e-6)
    env.close()


# ---------------------------------------------------------------- Gymnasium

def optional(name):
    return pytest.importorskip(name, reason=f"{name} is not installed (optional)")


@pytest.mark.filterwarnings("ignore:.*not having a spec", "ignore:.*is.*infinity")
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_gymnasium_check_env(render_mode):
    optional("gymnasium")
    from gymnasium.utils.env_checker import check_env
    env = TriFingerEnv(render_mode=render_mode)
    check_env(env)
    env.reset(seed=5)
    assert env.np_random is env._np_random and env.np_random_seed == 5
    env.close()


def test_gymnasium_wrappers_and_vectors_take_the_environment():
    gymnasium = optional("gymnasium")
    from gymnasium.wrappers import FlattenObservation, TimeLimit
    flat = FlattenObservation(TimeLimit(TriFingerEnv(distractors=1), 7))
    obs, _ = flat.reset(seed=0)
    assert obs.shape == flat.observation_space.shape == (2 * 18 + 3 * 10 + 12,)
    ends = [flat.step(flat.action_space.sample())[3] for _ in range(7)]
    assert ends == [False] * 6 + [True]
    flat.close()

    both = gymnasium.vector.SyncVectorEnv([lambda: TriFingerEnv(distractors=1)] * 2)
    both.reset(seed=[3, 4])
    obs, rewards, *_ = both.step(np.full((2, 9), 0.5, np.float32))
    for e, seed in enumerate((3, 4)):                          # one by one: the same
        alone = TriFingerEnv(distractors=1)
        alone.reset(seed=seed)
        expected, reward, *_ = alone.step(np.full(9, 0.5))
        alone.close()
        assert rewards[e] == pytest.approx(reward)
        for key, value in expected.items():
            np.testing.assert_array_equal(obs[key][e], value)
    both.close()


def test_stable_baselines_trains_on_the_environment():
    stable_baselines3 = optional("stable_baselines3")
    env = TriFingerEnv(episode_steps=50)
    model = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=64, batch_size=64, n_epochs=1,
                                  device="cpu")
    model.learn(128)
    assert model.num_timesteps == 128
    action, _ = model.predict(env.reset(seed=0)[0])
    assert action.shape == (9,) and env.action_space.contains(action)
    env.close()


TRAJECTORY = """
import sys
if {blocked}:
    sys.modules["gymnasium"] = None                            # import gymnasium fails
import numpy as np
from trifinger_env import TriFingerEnv
env = TriFingerEnv(distractors=1)
env.reset(seed=3)
for t in range(20):
    obs, reward, *_ = env.step(np.sin(np.arange(9) + t / 3))
print(reward.hex(), obs["cubes"].tobytes().hex(), obs["fingers"].tobytes().hex())
print(hasattr(env, "action_space"))
"""


def test_environment_is_the_same_without_gymnasium():
    optional("gymnasium")
    with_it, without_it = (run("-c", TRAJECTORY.format(blocked=blocked)).stdout.splitlines()[-2:]
                           for blocked in (False, True))
    assert with_it[0] == without_it[0] and len(with_it[0]) > 400
    assert (with_it[1], without_it[1]) == ("True", "False")


# ---------------------------------------------------------------- PPO

def test_gae_against_a_hand_computed_table():
    """discount 0.5, lambda 0.5. Column 0 terminates at t=1, column 1 is truncated there; both
    episodes that follow are still under way after t=2.

    t=2: 3 + 0.5 * 6 - 1 = 5
    t=1: terminated 2 - 2 = 0, truncated 2 + 0.5 * 8 - 2 = 4
    t=0: 1 + 0.5 * 2 - 4 = -2, and 0.25 times what follows
    """
    twice = torch.ones(2)
    rewards = torch.outer(torch.tensor([1.0, 2.0, 3.0]), twice)
    values = torch.outer(torch.tensor([4.0, 2.0, 1.0]), twice)
    next_values = torch.outer(torch.tensor([2.0, 8.0, 6.0]), twice)
    terminated = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    done = torch.tensor([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]])
    expected = torch.tensor([[-2.0, -1.0], [0.0, 4.0], [5.0, 5.0]])
    ours = gae(rewards, values, next_values, terminated, done, discount=0.5, lam=0.5)
    torch.testing.assert_close(ours, expected)


def test_gae_is_the_discounted_sum_of_td_errors():
    """A_t = sum_l (gamma lambda)^l delta_{t+l}, with gamma and lambda that cannot be swapped."""
    rewards, values, next_values = torch.randn(3, 6, 2).unbind()
    nothing = torch.zeros(6, 2)
    ours = gae(rewards, values, next_values, nothing, nothing, discount=0.9, lam=0.3)
    delta = rewards + 0.9 * next_values - values
    for t in range(6):
        expected = sum((0.9 * 0.3) ** k * delta[t + k] for k in range(6 - t))
        torch.testing.assert_close(ours[t], expected)


def test_log_prob_against_torch_distributions():
    mean, log_std, actions = torch.randn(5, 9), torch.randn(9), torch.randn(5, 9)
    normal = torch.distributions.Normal(mean, log_std.exp())
    expected = normal.log_prob(actions).sum(-1)
    torch.testing.assert_close(normal_log_prob(actions, mean, log_std), expected)


class Fixed(nn.Module):
    """An agent whose mean, log_std and value are numbers that do not depend on what it sees."""

    def __init__(self, mean=0.5, log_std=-0.3, value=2.0, dtype=torch.float32):
        super().__init__()
        self.mean = nn.Parameter(torch.tensor([mean], dtype=dtype))
        self.log_std = nn.Parameter(torch.tensor([log_std], dtype=dtype))
        self.value = nn.Parameter(torch.tensor(value, dtype=dtype))

    def forward(self, obs):
        B = len(obs["x"])
        return self.mean.expand(B, 1), self.log_std, self.value.expand(B)

    def auxiliary(self, obs):
        return obs["x"].sum() + 0 * self.value


def test_loss_by_hand():
    """Ratios on both sides of both ends of the clip range, with advantages of both signs."""
    ratios = [0.5, 0.5, 0.9, 1.1, 1.35, 1.35, 1.9, 1.9]
    advantages = [2.0, -3.0, 1.0, -1.0, 2.0, -2.0, 4.0, -1.0]
    returns = [1.0, 2.0, 3.0, 4.0, 0.0, -1.0, 2.0, 5.0]
    learner = PPO(Fixed(), [None], minibatches=1, value_coef=0.7, entropy=0.03, auxiliary=5.0)
    actions = torch.linspace(-1, 1, 8)[:, None]
    new = torch.distributions.Normal(0.5, math.exp(-0.3)).log_prob(actions)[:, 0]
    old = new - torch.tensor(ratios).log()
    obs = {"x": torch.full((8, 2), 0.01)}
    loss, stats = learner.loss(obs, actions, old, torch.tensor(advantages), torch.tensor(returns),
                               clip=0.2)

    # min(ratio A, clipped A): 1.0 and -2.4; 0.9 and -1.1; 2.4 and -2.7; 4.8 and -1.9
    policy = -(1.0 - 2.4 + 0.9 - 1.1 + 2.4 - 2.7 + 4.8 - 1.9) / 8
    value = (1 + 0 + 1 + 4 + 4 + 9 + 0 + 9) / 8 / 2
    entropy = torch.distributions.Normal(0.5, math.exp(-0.3)).entropy().item()
    kl = np.mean([ratio - 1 - math.log(ratio) for ratio in ratios])
    expected = {"policy_loss": policy, "value_loss": value, "auxiliary_loss": 0.16,
                "entropy": entropy, "approx_kl": kl, "clip_fraction": 6 / 8}
    assert {key: x.item() for key, x in stats.items()} == pytest.approx(expected, abs=1e-5)
    total = policy + 0.7 * value - 0.03 * entropy + 5.0 * 0.16
    assert loss.item() == pytest.approx(total, abs=1e-5)


def test_gradient_of_the_loss_against_finite_differences():
    """Of the policy's and the value's share, by the agent's three numbers."""
    torch.manual_seed(1)
    batch = {"actions": torch.randn(16, 1), "old_log_prob": torch.randn(16) * 0.2 - 1.2,
             "advantages": torch.randn(16), "returns": torch.randn(16)}
    batch = {key: value.double() for key, value in batch.items()}
    obs = {"x": torch.zeros(16, 2)}

    def loss(*numbers):
        learner = PPO(Fixed(*numbers, dtype=torch.float64), [None], minibatches=1, entropy=0.1)
        return learner, learner.loss(obs, **batch, clip=0.2)[0]

    numbers = [0.5, -0.3, 2.0]
    learner, at = loss(*numbers)
    at.backward()
    for i in range(3):
        higher, lower = list(numbers), list(numbers)
        higher[i] += 1e-4
        lower[i] -= 1e-4
        slope = (loss(*higher)[1] - loss(*lower)[1]).item() / 2e-4
        assert learner.weights.grad[i].item() == pytest.approx(slope, abs=1e-6)
        assert abs(slope) > 0.01


class Counter:
    """Observation (t, episode), reward 10 * episode + t; each episode ends after `length` steps."""

    def __init__(self, terminates, length=3):
        self.terminates, self.length = terminates, length
        self.episode, self.actions = -1, []

    def reset(self, *, seed=None, options=None):
        self.t = 0
        self.episode += 1
        return self.observation(), {}

    def step(self, action):
        self.t += 1
        self.actions.append(action.copy())
        over = self.t == self.length
        reward = 10.0 * self.episode + self.t
        return (self.observation(), reward, over and self.terminates,
                over and not self.terminates, {"end of": self.episode})

    def observation(self):
        return {"x": np.array([self.t, self.episode], np.float32)}


@pytest.mark.parametrize("terminates", [True, False])
def test_rollout_stores_what_happened(terminates):
    """Rewards sit at their step; an episode's last value is that of its own last observation."""
    agent = TinyAgent()
    envs = [Counter(terminates), Counter(terminates, length=2)]
    learner = PPO(agent, envs, steps=5, minibatches=1, lam=1.0, discount=0.5,
                  normalize_values=False)
    episodes = learner.rollout([0, 0])
    seen = learner.observations["x"]
    assert seen[:, 0].tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1]]
    assert seen[:, 1].tolist() == [[0, 0], [1, 0], [0, 1], [1, 1], [0, 2]]
    expected = [(3.0, 2, 0), (6.0, 3, 0), (23.0, 2, 1)]        # 1+2; 1+2+3; 11+12
    assert [(e["return"], e["length"], e["info"]["end of"]) for e in episodes] == expected

    @torch.no_grad()
    def V(t, episode):
        return agent.value(torch.tensor([t, episode], dtype=torch.float32)).item()

    def discounted(rewards, future):
        return sum(0.5 ** k * reward for k, reward in enumerate([*rewards, future]))

    end = 0.0 if terminates else 1.0                           # a truncation has a future
    expected = [discounted([1, 2, 3], end * V(3, 0)), discounted([2, 3], end * V(3, 0)),
                discounted([3], end * V(3, 0)), discounted([11, 12], V(2, 1)),
                discounted([12], V(2, 1))]
    assert learner.batch["returns"][:, 0].tolist() == pytest.approx(expected, abs=1e-5)
    expected = [discounted([1, 2], end * V(2, 0)), discounted([2], end * V(2, 0)),
                discounted([11, 12], end * V(2, 1)), discounted([12], end * V(2, 1)),
                discounted([21], V(1, 2))]
    assert learner.batch["returns"][:, 1].tolist() == pytest.approx(expected, abs=1e-5)
    values = [[V(*x) for x in row] for row in seen.tolist()]
    advantages = learner.batch["returns"] - torch.tensor(values)
    torch.testing.assert_close(learner.batch["advantages"], advantages, atol=1e-5, rtol=1e-5)


def test_rollout_starts_every_environment_from_its_seed():
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(3)], steps=2, minibatches=1)
    for seeds in ([4, 5, 6], [1, 2, 4]):
        learner.rollout(seeds)
        for e, seed in enumerate(seeds):
            start = PointOnLine().reset(seed=seed)[0]["x"]
            assert learner.observations["x"][0, e].tolist() == start.tolist()


def test_rollout_samples_the_policy_and_stores_its_density():
    env = Counter(True, length=10 ** 6)
    agent = Fixed(mean=0.5, log_std=-0.3)
    learner = PPO(agent, [env], steps=4000, minibatches=1)
    torch.manual_seed(0)
    learner.rollout([0])
    actions = learner.batch["actions"][:, 0]                   # (T, 1)
    assert np.array_equal(np.array(env.actions, np.float32), actions.numpy())
    expected = torch.distributions.Normal(0.5, math.exp(-0.3))
    torch.testing.assert_close(learner.batch["old_log_prob"], expected.log_prob(actions))
    assert is_uniform(expected.cdf(actions).numpy())
    scaled = (actions[:, 0] - 0.5).numpy()
    assert abs(np.corrcoef(scaled[1:], scaled[:-1])[0, 1]) < 0.05          # fresh at every step


def test_explained_variance_by_hand():
    """1 - var(R - V) / var(R)."""
    learner = PPO(TinyAgent(), [Counter(True)], steps=20, minibatches=1, normalize_values=False)
    learner.rollout([0])
    with torch.no_grad():
        values = learner.agent.value(learner.observations["x"])[..., 0].numpy()
    returns = learner.batch["returns"].numpy()
    expected = 1 - np.var(returns - values) / np.var(returns)
    assert learner.update(1.0)["explained_variance"] == pytest.approx(expected, abs=1e-4)


def test_values_are_learned_in_units_of_their_running_moments():
    """The network says 2; with a mean of 3 and a mean square of 25 that means 3 + 2 * 4 = 11."""
    learner = PPO(Fixed(value=2.0), [Counter(False)], steps=3, minibatches=1, discount=0.5,
                  lam=1.0)
    learner.return_mean.fill_(3.0)
    learner.return_square.fill_(25.0)
    learner.rollout([0])
    returns = [1 + 0.5 * (2 + 0.5 * (3 + 0.5 * 11)), 2 + 0.5 * (3 + 0.5 * 11), 3 + 0.5 * 11]
    assert learner.batch["returns"][:, 0].tolist() == pytest.approx(returns, abs=1e-5)
    advantages = [value - 11 for value in returns]
    assert learner.batch["advantages"][:, 0].tolist() == pytest.approx(advantages, abs=1e-5)


def with_batch(returns, advantages=None, **options):
    """A learner that has just played these returns and advantages."""
    learner = PPO(Fixed(), [None], minibatches=1, **options)
    learner.batch = {"returns": returns[:, None],
                     "advantages": (returns if advantages is None else advantages)[:, None]}
    return learner


def test_running_moments_are_the_plain_mean_at_first_and_slow_after_100_batches():
    batches = torch.randn(3, 50) * torch.tensor([[1.0], [5.0], [2.0]]) + 7
    learner = with_batch(batches[0])
    for i in range(3):
        learner.batch["returns"] = batches[i][:, None]
        normalized = learner.normalized_batch()["returns"]
        so_far = batches[:i + 1].numpy()
        mean, square = so_far.mean(), np.square(so_far).mean()
        expected = (batches[i] - mean) / math.sqrt(square - mean ** 2)
        torch.testing.assert_close(normalized, expected, atol=1e-4, rtol=1e-4)
    learner.return_batches.fill_(1000.0)
    learner.return_mean.fill_(0.0)
    learner.return_square.fill_(1.0)
    learner.batch["returns"] = torch.full((50, 1), 10.0)
    learner.normalized_batch()
    assert learner.return_mean.item() == pytest.approx(0.1)
    assert learner.return_square.item() == pytest.approx(1 + 0.99)


def test_advantages_are_normalized_over_the_batch():
    advantages = torch.randn(50) * 30 + 4
    learner = with_batch(torch.randn(50), advantages)
    ours = learner.normalized_batch()["advantages"].numpy()
    expected = (advantages.numpy() - advantages.numpy().mean()) / advantages.numpy().std()
    np.testing.assert_allclose(ours, expected, atol=1e-4)


def test_normalization_can_be_switched_off():
    returns, advantages = torch.randn(2, 50) * 30 + 4
    learner = with_batch(returns, advantages, normalize_values=False, normalize_advantages=False)
    batch = learner.normalized_batch()
    assert torch.equal(batch["returns"], returns)
    assert torch.equal(batch["advantages"], advantages)


def test_every_sample_is_used_once_in_every_epoch():
    """In new parts each time; the diagnostics are the mean over all parts."""
    learner = PPO(TinyAgent(), [Counter(True, length=50) for _ in range(2)], steps=12, epochs=3,
                  minibatches=4)
    learner.rollout([0, 0])
    parts = []

    def step(obs, part, clip):
        assert len(part["returns"]) == len(obs["x"]) == 6
        parts.append(sorted(part["old_log_prob"].tolist()))
        return {"kl": torch.tensor(float(len(parts)))}

    learner.minibatch_step = step
    stats = learner.update(1.0)
    everything = sorted(learner.batch["old_log_prob"].flatten().tolist())
    assert len(parts) == 12 and stats["kl"] == pytest.approx(6.5)
    for epoch in range(3):
        assert sorted(sum(parts[4 * epoch:4 * epoch + 4], [])) == everything
    assert parts[:4] != parts[4:8]


def test_the_rows_of_a_part_belong_together():
    """Observation, action and density of a sample stay at the same row after the shuffle."""
    learner = PPO(TinyAgent(), [Counter(True, length=50)], steps=12, epochs=1, minibatches=2)
    learner.rollout([0])

    def step(obs, part, clip):
        mean, log_std, _ = learner.agent(obs)
        log_prob = normal_log_prob(part["actions"], mean, log_std)
        torch.testing.assert_close(log_prob, part["old_log_prob"])
        return {"fine": torch.ones(())}

    learner.minibatch_step = step
    assert learner.update(1.0)["fine"] == 1


@pytest.mark.parametrize("power, anneal", [(0, False), (1, True), (2, True)])
def test_learning_rate_and_clip_range_shrink_with_the_training_that_is_left(power, anneal):
    learner = PPO(TinyAgent(), [Counter(True)], steps=8, minibatches=1, epochs=1, lr=1e-3,
                  clip=0.2, lr_power=power, anneal_clip=anneal)
    learner.rollout([0])
    clips, loss = [], learner.loss

    def watched(obs, *, clip, **part):
        clips.append(clip)
        return loss(obs, clip=clip, **part)

    learner.loss = watched
    lr = {0: 1e-3, 1: 0.25e-3, 2: 0.0625e-3}[power]            # at a quarter left
    assert learner.update(0.25)["lr"] == pytest.approx(lr)
    assert learner.optimizer.param_groups[0]["lr"] == pytest.approx(lr)
    assert clips == [pytest.approx(0.05 if anneal else 0.2)]


def test_an_auxiliary_loss_without_weight_is_never_asked_for():
    agent = Fixed()
    agent.auxiliary = None                                     # calling it would fail
    learner = PPO(agent, [Counter(True)], steps=4, minibatches=1, epochs=1)
    learner.rollout([0])
    assert learner.update(1.0)["auxiliary_loss"] == 0


@pytest.mark.parametrize("largest", [0.2, 1e6])
def test_update_on_one_vector_of_weights_equals_torch_layer_by_layer(largest):
    """Three steps of update() against torch's own clipping and Adam over the list of parameters."""
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(4)], steps=8, epochs=3, minibatches=1,
                  lr=1e-2, adam_eps=1e-2, max_grad_norm=largest)
    learner.agent.load_state_dict(learner.agent.state_dict())  # must keep weights in the vector
    reference = TinyAgent()
    reference.load_state_dict(learner.agent.state_dict())
    learner.rollout([0, 1, 2, 3])
    stats = learner.update(1.0)

    part = {key: value.flatten(0, 1) for key, value in learner.batch.items()}
    for key in ("returns", "advantages"):
        part[key] = (part[key] - part[key].mean()) / part[key].std(correction=0)
    obs = {"x": learner.observations["x"].flatten(0, 1)}
    optimizer = torch.optim.Adam(reference.parameters(), lr=1e-2, eps=1e-2)
    loss_of, norms = PPO(reference, [None], minibatches=1).loss, []
    for _ in range(3):
        optimizer.zero_grad()
        loss, _ = loss_of(obs, **part, clip=0.2)
        loss.backward()
        norms.append(nn.utils.clip_grad_norm_(reference.parameters(), largest).item())
        optimizer.step()
    assert max(norms) > 0.2                                    # so that 0.2 does clip
    assert stats["grad_norm"] == pytest.approx(np.mean(norms), rel=1e-3)
    for ours, torchs in zip(learner.agent.parameters(), reference.parameters()):
        torch.testing.assert_close(ours, torchs, atol=1e-5, rtol=1e-4)


def test_ppo_solves_the_line():
    """Best possible: about 3.6 moves of 0.2 to a random target; at random it ends far away."""
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(8)], steps=64, lr=3e-3)
    gaps = []
    for update in range(25):
        episodes = learner.rollout([1000 * update + e for e in range(8)])
        stats = learner.update(1 - update / 25)
        gaps.append(np.mean([episode["info"]["gap"] for episode in episodes]))
    assert gaps[0] > 0.3 and np.mean(gaps[-5:]) < 0.1, gaps
    assert stats["approx_kl"] >= 0 and stats["explained_variance"] > 0.5


def test_ppo_refuses_a_batch_that_does_not_divide():
    with pytest.raises(ValueError, match="5 steps x 3 environments does not divide into 4"):
        PPO(TinyAgent(), [PointOnLine()] * 3, steps=5, minibatches=4)


def test_ppo_refuses_a_gradient_that_is_not_finite_and_keeps_the_weights():
    learner = PPO(TinyAgent(), [PointOnLine()], steps=16, minibatches=2)
    learner.rollout([0])
    learner.batch["returns"][3] = float("nan")
    before = [p.clone() for p in learner.agent.parameters()]
    with pytest.raises(FloatingPointError):
        learner.update(1.0)
    assert all(torch.equal(p, q) for p, q in zip(before, learner.agent.parameters()))


class Reusing(PointOnLine):
    """Shows its observations in one array of float64, as an environment may."""
    shown = None

    def observation(self):
        if self.shown is None:
            self.shown = np.zeros(2)
        self.shown[:] = super().observation()["x"]
        return {"x": self.shown}


def test_an_environment_may_reuse_its_array_of_any_type():
    batches = []
    for make in (PointOnLine, Reusing):
        torch.manual_seed(0)
        learner = PPO(TinyAgent(), [make(), make()], steps=32)
        learner.rollout([1, 2])
        batches.append(learner.batch)
    for key, expected in batches[0].items():
        assert torch.equal(batches[1][key], expected), key


TWO_RANKS = """
import os, sys
sys.path.insert(0, {here!r})
import torch
import torch.distributed as dist
from ppo import PPO, PointOnLine, TinyAgent


def make_learner(envs):
    torch.manual_seed(0)
    return PPO(TinyAgent(), [PointOnLine() for _ in range(envs)], steps=32, epochs=1,
               minibatches=1, lr=1e-2)


def gradient(learner):
    return torch.cat([p.grad.flatten() for p in learner.agent.parameters()])


def rank(r, path):
    dist.init_process_group("gloo", init_method="file://" + path, rank=r, world_size=2)
    both, mine = make_learner(4), make_learner(2)
    both.rollout([0, 1, 2, 3])
    mine.rollout([2 * r, 2 * r + 1])
    for ours, joined in ((mine.observations, both.observations), (mine.batch, both.batch)):
        for key, value in ours.items():                        # this rank's half of the batch
            value.copy_(joined[key][:, 2 * r:2 * r + 2])
    stats = mine.update(1.0)
    dist.destroy_process_group()
    expected = both.update(1.0)
    assert torch.allclose(gradient(mine), gradient(both), rtol=1e-4, atol=1e-6)
    assert gradient(both).abs().max() > 1e-3
    for name in ("return_mean", "return_square"):
        assert torch.allclose(getattr(mine, name), getattr(both, name), rtol=1e-4), name
    for name in ("policy_loss", "value_loss", "entropy", "grad_norm"):
        assert abs(stats[name] - expected[name]) < 1e-4, (name, stats, expected)
    os._exit(0)                                                # see the end of train.train()


if __name__ == "__main__":
    torch.multiprocessing.spawn(rank, ({store!r},), 2)
"""


def test_two_ranks_give_the_gradient_of_one_on_the_joined_batch(tmp_path):
    script = tmp_path / "two.py"
    script.write_text(TWO_RANKS.format(here=HERE, store=str(tmp_path / "store")))
    done = run(str(script))
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------- the agent

def observations(env, count=5, seed=0):
    """A batch of an environment's observations, one step after each of `count` resets."""
    rng = np.random.default_rng(seed)
    found = []
    for episode in range(count):
        env.reset(seed=seed + episode)
        found.append(env.step(rng.uniform(-1, 1, 9))[0])
    return as_batch(found)


def test_agent_is_an_mlp_per_type_an_encoder_and_two_heads(env):
    """One sample by hand: every cube through the cube MLP, every finger through the finger MLP."""
    agent = train.Agent("lrn", 2, {**train.DEFAULTS, "log_std": -1.3})
    obs = observations(env)
    mean, log_std, value = agent(obs)
    assert mean.shape == (5, 9) and value.shape == (5,)
    assert torch.equal(log_std, torch.full((9,), -1.3))
    for b in range(5):
        objects = [agent.cube(cube) for cube in obs["cubes"][b]]
        objects += [agent.finger(finger) for finger in obs["fingers"][b]]
        goal = agent.goal(obs["goal"][b])
        total = sum(g_slow(agent.encoder, torch.cat([o, goal])) for o in objects)
        z = z_slow(agent.encoder, total)
        same(mean[b], agent.policy(z))
        same(value[b], agent.value(z)[0])


def test_mlp_agent_sees_everything_and_has_a_fixed_input(env):
    agent = train.Agent("mlp", 2, train.DEFAULTS)
    obs = observations(env)
    _, _, value = agent(obs)
    for key in obs:
        changed = {**obs, key: obs[key] + 0.1}
        assert ((agent(changed)[2] - value).abs() > 1e-6).all(), key
    swapped = {**obs, "cubes": obs["cubes"][:, [2, 0, 1]]}
    assert (agent(swapped)[2] - value).abs().max() > 1e-6
    flat = torch.cat([obs["cubes"].flatten(1), obs["fingers"].flatten(1), obs["goal"]], dim=1)
    network, norm = agent.encoder
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    assert [layer.out_features for layer in layers] == [256, 256, 25]
    same(agent.encode(obs), norm(network(flat)))
    with pytest.raises(ValueError, match="trained with 2 distractors and cannot be used with 1"):
        agent({**obs, "cubes": obs["cubes"][:, :2]})


@pytest.mark.parametrize("widths, gain", [((18, 128, 64), math.sqrt(2)), ((25, 128, 9), 0.01)])
def test_mlps_are_orthogonal_and_end_in_a_linear_layer(widths, gain):
    network = train.mlp(*widths, last_gain=gain)
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    assert [layer.out_features for layer in layers] == list(widths[1:])
    x = torch.randn(7, widths[0])
    for layer in layers[:-1]:
        same(torch.linalg.svdvals(layer.weight) ** 2, torch.full((min(layer.weight.shape),), 2.0))
    last = torch.linalg.svdvals(layers[-1].weight)
    same(last, torch.full_like(last, gain))
    expected = through(layers[1], through(layers[0], x).clamp(min=0))
    same(network(x), expected)
    assert not any(layer.bias.any() for layer in layers)


def test_heads_start_small_so_that_the_first_policy_is_near_zero():
    agent = train.Agent("lrn", 2, train.DEFAULTS)
    for head, gain in ((agent.policy, 0.01), (agent.value, 1.0), (agent.read_out, math.sqrt(2))):
        values = torch.linalg.svdvals(head[-1].weight)
        same(values, torch.full_like(values, gain))


def encoder_of(kind, **settings):
    return train.Agent(kind, 3, {**train.DEFAULTS, **settings}).encoder


def test_settings_reach_the_encoder():
    assert type(encoder_of("lrn")) is LRN and type(encoder_of("lrn-max")) is LRNMax
    assert type(encoder_of("rn")) is RN and type(encoder_of("attn")) is ATTN
    for kind in ("lrn", "lrn-max", "rn", "attn", "mlp"):
        objects, goal = some(2, 4)
        made = encoder_of(kind, z_dim=10)
        if kind == "mlp":
            obs = {"cubes": torch.randn(2, 4, 18), "fingers": torch.randn(2, 3, 10),
                   "goal": torch.randn(2, 12)}
            assert made(obs).shape == (2, 10)
        else:
            assert made(objects, goal).shape == (2, 10)
            wide = encoder_of(kind, token_dim=128)(objects.repeat(1, 1, 2), goal.repeat(1, 2))
            assert wide.shape == (2, 25)


def test_settings_of_one_encoder_reach_it():
    objects, goal = some(2, 4)
    assert encoder_of("attn", heads=2).attend(objects, goal)[1].shape == (2, 2, 5, 5)
    blind = encoder_of("lrn", relations=False)
    assert torch.equal(blind(objects, goal), blind(objects, -goal))
    assert train.Agent("lrn", 3, {**train.DEFAULTS, "hidden": 32}).policy[0].out_features == 32
    flat = encoder_of("lrn", layer_norm=False)
    assert flat(100 * objects, 100 * goal).abs().max() > 50    # LayerNorm would hold it below 5


class Asked:
    """Stands in for Agent.encode: keeps what it is asked and what it answers, at random."""

    def __init__(self):
        self.obs, self.answers = [], []

    def __call__(self, obs):
        self.obs.append({key: value.clone() for key, value in obs.items()})
        self.answers.append(torch.randn(len(obs["goal"]), 18))
        return self.answers[-1]


def ask():
    """What auxiliary() gets, what encode() sees in two calls of it and answers, and the loss."""
    agent = train.Agent("lrn", 2, train.DEFAULTS)
    agent.encode, agent.read_out = Asked(), nn.Identity()
    torch.manual_seed(0)
    obs = {"cubes": torch.randn(1000, 3, 18), "fingers": torch.randn(1000, 3, 10),
           "goal": torch.randn(1000, 12)}
    before = {key: value.clone() for key, value in obs.items()}
    loss = agent.auxiliary(obs)
    agent.auxiliary(obs)
    assert all(torch.equal(obs[key], before[key]) for key in obs)          # a copy was changed
    first, second = agent.encode.obs
    return obs, first, second, agent.encode.answers[0], loss.item()


def test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers():
    obs, asked, again, _, _ = ask()
    identifiers = asked["cubes"][..., 17]
    assert asked["cubes"].shape == (1000, 3, 18)
    assert torch.equal(asked["cubes"][..., :17], obs["cubes"][..., :17])
    assert torch.equal(asked["fingers"], obs["fingers"])

    # Identifiers: from the pool, each equally often, distinct in a sample, anew in every call.
    # 45.3 and 13.8: what chi-square exceeds once in 1000 with 20 and with 2 degrees of freedom.
    assert (identifiers[..., None] - torch.arange(-10, 11) / 10).abs().min(-1)[0].max() < 1e-6
    assert all(len(set(row)) == 3 for row in identifiers.tolist())
    counts = np.unique(identifiers.numpy().round(1), return_counts=True)[1]
    assert len(counts) == 21 and np.square(counts - 3000 / 21).sum() / (3000 / 21) < 45.3
    assert (identifiers != again["cubes"][..., 17]).float().mean() > 0.9

    # Targets: named by the goal, each index equally often.
    named = identifiers == asked["goal"][:, 11:]
    assert (named.sum(1) == 1).all()
    counts = named.sum(0).numpy()
    assert np.square(counts - 1000 / 3).sum() / (1000 / 3) < 13.8

    # Goals: those of the batch, in another order.
    own, other = obs["goal"][:, 4:7], asked["goal"][:, 4:7]
    assert (own == other).all(1).float().mean() < 0.01
    assert sorted(own.tolist()) == sorted(other.tolist())


def test_read_out_loss_is_the_mean_squared_error_of_the_facts():
    """Of the cube that the goal names in what encode() sees, and of that goal: 18 numbers."""
    _, asked, _, answers, loss = ask()
    facts = []
    for b in range(1000):
        target = asked["cubes"][b, :, 17].tolist().index(asked["goal"][b, 11].item())
        meant = asked["cubes"][b, target]
        fingertips = asked["fingers"][b, :, 7:].flatten()
        facts.append([*meant[4:7], *meant[11:14], *asked["goal"][b, 4:7], *fingertips])
    errors = answers.numpy() - np.array(facts)
    assert loss == pytest.approx(np.square(errors).mean(), rel=1e-5)


def test_read_out_is_read_from_z(env):
    """The loss of a real agent, from its own z and read-out: its gradient reaches the encoder."""
    agent = train.Agent("lrn", 2, train.DEFAULTS)
    agent.auxiliary(observations(env, count=8)).backward()
    assert agent.encoder.f.weight.grad.abs().max() > 1e-4
    assert agent.read_out[0].weight.grad.abs().max() > 1e-4
    assert agent.policy[0].weight.grad is None


# ---------------------------------------------------------------- seeds, settings, environments

def test_derived_seeds_do_not_repeat_where_sums_would():
    seeds = {train.derived_seed(seed, update, stream)
             for seed in range(12) for update in range(12) for stream in range(12)}
    assert len(seeds) == 12 ** 3
    assert train.derived_seed(0, 1, 2) == 3_884_055_042  # on every machine


def test_every_rank_draws_other_episodes_and_other_noise():
    """Four environments on one rank or on two: the same seeds in all, and none for the noise."""
    every, noises = [], []
    for seed in range(2):
        for update in range(3):
            alone = train.reseed(seed, update, 0, 4)
            halves = []
            for rank in range(2):
                halves += train.reseed(seed, update, rank, 2)
                noises.append((torch.initial_seed(), torch.randn(1).item()))
            assert halves == alone
            every += alone
    assert len(set(every)) == len(every) == 24
    assert len({noise for _, noise in noises}) == len(noises) == 12
    assert not {seed for seed, _ in noises} & set(every)
    train.reseed(1, 2, 1, 2)
    assert torch.randn(1).item() == noises[-1][1]              # and the same again


def run_arguments(**changes):
    return SimpleNamespace(**{"encoder": "lrn", "task": "push", "distractors": 1, "seed": 0,
                              "ranks": 1, "out": "nowhere", "resume": False,
                              "save_minutes": 3.0, **changes})


def test_every_setting_reaches_the_learner_and_its_environments():
    """Each setting with a value of its own."""
    of_ppo = {"steps": 7, "epochs": 2, "minibatches": 3, "lr": 0.1, "clip": 0.3, "discount": 0.4,
              "lam": 0.5, "value_coef": 0.7, "max_grad_norm": 0.8, "lr_power": 1.5,
              "anneal_clip": True, "normalize_advantages": False, "normalize_values": False}
    of_env = {"episode_steps": 11, "substeps": 2, "timestep": 0.002, "action_mode": "absolute",
              "action_scale": 0.07, "cube_mass": 0.03, "finger_friction": 0.16, "goal_yaw": 0.12}
    others = {"envs": 6, "adam_eps": 0.2, "entropy": 0.6, "auxiliary": 0.9, "reward_overlap": 1.0,
              "reward_distance": 2.0, "reward_curiosity": 3.0, "reward_reach": 4.0}
    of_the_agent = {"token_dim", "z_dim", "hidden", "heads", "relations", "layer_norm", "log_std"}
    assert {*of_ppo, *of_env, *others} == set(train.SETTINGS) - of_the_agent - {"frames"}
    settings = {**train.DEFAULTS, **of_ppo, **of_env, **others}
    learner = train.make_learner(run_arguments(task="lift", ranks=2), settings)
    for name, value in of_ppo.items():
        assert getattr(learner, name) == value, name
    assert (learner.entropy_coef, learner.auxiliary_coef) == (0.6, 0.9)
    assert learner.optimizer.param_groups[0]["eps"] == 0.2
    assert len(learner.envs) == 3
    for env in learner.envs:
        assert env.task == "lift" and env.distractors == 1
        for name, value in of_env.items():
            assert getattr(env, name) == value, name
        assert env.reward_weights == {"overlap": 1, "distance": 2, "curiosity": 3, "reach": 4}
        env.close()


def test_the_environment_alone_is_the_one_of_a_run_with_default_settings():
    alone = TriFingerEnv()
    of_a_run = train.make_env("push", 2, train.DEFAULTS)
    for name in ("task", "distractors", "reward_weights", *train.ENV_SETTINGS):
        assert getattr(alone, name) == getattr(of_a_run, name), name
    alone.close()
    of_a_run.close()


def test_first_weights_depend_on_the_seed_alone():
    def first_weights(seed):
        settings = {**train.DEFAULTS, "envs": 1, "minibatches": 1}
        learner = train.make_learner(run_arguments(seed=seed), settings)
        learner.envs[0].close()
        return learner.weights

    assert torch.equal(first_weights(0), first_weights(0))
    assert not torch.equal(first_weights(0), first_weights(1))


def test_paper_sets_the_numbers_of_the_paper_and_of_its_sources(tmp_path):
    """Every setting by hand: A.1, A.2, the 2500 steps of 30 s, CausalWorld, rlpyt; --set on top."""
    printed = {"discount": 0.98, "entropy": 0.01, "lr": 0.00025, "value_coef": 0.5,
               "max_grad_norm": 0.5, "minibatches": 40, "lam": 0.95, "clip": 0.5, "epochs": 4,
               "lr_power": 1, "reward_overlap": 100, "reward_distance": 250,
               "reward_curiosity": 10, "reward_reach": 0, "auxiliary": 0, "z_dim": 25,
               "episode_steps": 2500, "relations": True, "layer_norm": True}
    of_its_sources = {"frames": 60_000_000, "envs": 48, "steps": 2500, "action_mode": "absolute",
                      "cube_mass": 0.02, "finger_friction": 0.1, "goal_yaw": math.pi / 4,
                      "anneal_clip": True, "adam_eps": 1e-8, "normalize_advantages": False,
                      "normalize_values": False, "log_std": 0.0}
    guesses = {"token_dim": 128, "hidden": 128, "heads": 4}
    out = str(tmp_path / "run")
    _, settings = train.parse(["--paper", "--out", out])
    for expected in (printed, of_its_sources, guesses):
        assert {name: settings[name] for name in expected} == expected
    without_effect = {"action_scale"}                          # on absolute targets
    assert set(settings) == {*printed, *of_its_sources, *guesses, "substeps", "timestep",
                             *without_effect}
    assert settings["substeps"] * settings["timestep"] == pytest.approx(30 / 2500)
    _, settings = train.parse(["--paper", "--out", out, "--set", "z_dim=50", "lr=0.1"])
    assert settings["z_dim"] == 50 and settings["lr"] == 0.1 and settings["clip"] == 0.5
    _, settings = train.parse(["--out", out, "--frames", "77", "--set", "lr_power=1"])
    assert settings == {**train.DEFAULTS, "frames": 77, "lr_power": 1.0}


def test_paper_trains_without_our_read_out(tmp_path, command):
    """Of what --paper changes, what a row of progress.csv tells."""
    out = tmp_path / "run"
    command("train.py --paper --ranks 1 --frames 200 --out", out, *SMALL)
    row, = read_csv(out / "progress.csv")
    assert row["auxiliary_loss"] == 0 and row["std"] == pytest.approx(1, abs=0.01)
    assert row["value_loss"] > 100                             # of raw returns
    assert row["return"] < -50 * 50                            # paid by the curiosity term


def test_lifting_has_frames_schedule_and_noise_of_its_own(tmp_path):
    out = str(tmp_path / "run")
    for words, power, log_std in (("", 1, -0.7), ("--task lift", 2, -1), ("--paper", 1, 0),
                                  ("--task lift --paper", 1, 0),
                                  ("--task lift --set lr_power=3 log_std=-2", 3, -2)):
        _, settings = train.parse(["--out", out, *words.split()])
        assert (settings["lr_power"], settings["log_std"]) == (power, log_std), words
    for words, frames in (("", 3_000_000), ("--task lift", 6_000_000), ("--paper", 60_000_000),
                          ("--task lift --paper", 60_000_000), ("--task lift --frames 9", 9),
                          ("--task lift --set frames=7", 7)):
        _, settings = train.parse(["--out", out, *words.split()])
        assert settings["frames"] == frames, words


def test_as_many_ranks_as_cores_and_batch_allow(monkeypatch):
    """6 environments, 50 steps, 4 minibatches: 1 or 3 ranks give whole parts, 2 or 6 do not."""
    settings = {"envs": 6, "steps": 50, "minibatches": 4}
    for cores, ranks in ((1, 1), (2, 1), (4, 3), (16, 3)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(cores))
        assert train.choose_ranks(settings) == ranks


def test_set_may_be_given_twice(tmp_path):
    _, settings = train.parse(["--out", str(tmp_path / "new"), "--set", "z_dim=7", "--set",
                               "auxiliary=2", "clip=0.3"])
    assert (settings["z_dim"], settings["auxiliary"], settings["clip"]) == (7, 2.0, 0.3)


# ---------------------------------------------------------------- training

SMALL = ["--set", "envs=4", "steps=50", "episode_steps=50", "minibatches=4"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short real training run on two ranks, with the reach term only."""
    out = str(tmp_path_factory.mktemp("run") / "lrn")
    done = run("train.py", "--encoder", "lrn", "--distractors", "0", "--ranks", "2",
               "--frames", "16000", "--out", out, "--set", "envs=8", "steps=50",
               "episode_steps=50", "minibatches=4", "lr=0.002", "reward_overlap=0",
               "reward_distance=0")
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture
def command(monkeypatch):
    """command("train.py --out x", ...) runs a program's main() in this process."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def call(*words):
        name, *rest = (part for word in words for part in str(word).split())
        monkeypatch.setattr(sys, "argv", [name, *rest])
        (train if name == "train.py" else evaluate).main()

    yield call
    for number, handler in handlers.items():
        signal.signal(number, handler)


class InThisProcess:
    """Stands in for multiprocessing's context and pool: calls come one by one, when asked for."""

    def Pool(self, *_, **__):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    imap = staticmethod(map)


@pytest.fixture
def in_this_process(monkeypatch):
    """Evaluation starts no other processes, which would take most of the time."""
    monkeypatch.setattr(evaluate.multiprocessing, "get_context", lambda kind: InThisProcess())


@torch.no_grad()
def mean_gap(agent, settings, episodes=24):
    """Mean distance (m) from fingertips to the cube's centre at the end of sampled episodes."""
    env = train.make_env("push", 0, settings)
    rng = np.random.default_rng(0)
    gaps = []
    for episode in range(episodes):
        obs, _ = env.reset(seed=1000 + episode)
        truncated = False
        while not truncated:
            mean, log_std, _ = agent(as_batch([obs]))
            action = mean[0].numpy() + log_std.exp().numpy() * rng.standard_normal(9)
            obs, _, _, truncated, _ = env.step(action)
        centre, _ = pose_of(env, 0)
        gaps.append(np.mean([math.dist(fingertip(env, k), centre) for k in range(3)]))
    env.close()
    return np.mean(gaps)


def test_training_lowers_the_distance_from_fingertips_to_cube(trained):
    checkpoint, agent = train.load(trained)
    torch.manual_seed(0)
    untrained = train.Agent("lrn", 0, checkpoint["settings"])
    before = mean_gap(untrained, checkpoint["settings"])
    after = mean_gap(agent, checkpoint["settings"])
    assert after < 0.85 * before, (before, after)


def test_progress_tells_of_every_update(trained):
    rows = read_csv(os.path.join(trained, "progress.csv"))
    assert [row["update"] for row in rows] == list(range(1, 41))
    assert [row["frames"] for row in rows] == [400 * row["update"] for row in rows]
    for row in rows:
        left = 1 - (row["update"] - 1) / 40
        assert row["lr"] == pytest.approx(0.002 * left, rel=1e-5)
        assert row["episodes"] == 8 and row["length"] <= 50
    _, agent = train.load(trained)
    assert rows[-1]["std"] == pytest.approx(agent.log_std.exp().mean().item(), rel=1e-4)
    timing = read_csv(os.path.join(trained, "timing.csv"))
    assert [row["frames"] for row in timing] == [row["frames"] for row in rows]
    seconds = np.diff([row["seconds"] for row in timing])
    rates = [row["frames_per_second"] for row in timing[1:]]
    np.testing.assert_allclose(seconds * rates, 400, rtol=0.2)             # both are rounded
    shares = [row["rollout_share"] for row in timing]
    assert 0.05 < np.median(shares) < 0.95                     # a busy machine may stall any one
    assert min(shares) >= 0 and max(shares) <= 1


def test_first_row_of_two_ranks_is_about_the_episodes_of_both(trained):
    """Both ranks' rollouts played once more here, one after the other."""
    checkpoint, _ = train.load(trained)
    episodes = []
    for rank in range(2):
        learner = train.make_learner(run_arguments(distractors=0, ranks=2), checkpoint["settings"])
        episodes += learner.rollout(train.reseed(0, 0, rank, 4))
        for env in learner.envs:
            env.close()
    row = read_csv(os.path.join(trained, "progress.csv"))[0]
    assert row["episodes"] == len(episodes) == 8
    expected = np.mean([episode["return"] for episode in episodes])
    assert row["return"] == pytest.approx(expected, rel=1e-4)


def test_every_update_plays_other_episodes_and_is_told_how_much_is_left(
        tmp_path, monkeypatch, command):
    """What train() asks of its learner; 600 frames in updates of 200, then one more for 601."""
    rollout, update = PPO.rollout, PPO.update
    seeds, noises, shares = [], [], []

    def watched_rollout(self, some_seeds):
        seeds.extend(some_seeds)
        noises.append(torch.initial_seed())
        return rollout(self, some_seeds)

    def watched_update(self, remaining):
        shares.append(remaining)
        return update(self, remaining)

    monkeypatch.setattr(PPO, "rollout", watched_rollout)
    monkeypatch.setattr(PPO, "update", watched_update)
    for seed in range(2):
        command("train.py --ranks 1 --frames 601 --seed", seed, "--out", tmp_path / str(seed),
                *SMALL)
    assert shares == [1.0, 0.75, 0.5, 0.25] * 2
    assert len(set(seeds)) == len(seeds) == 2 * 4 * 4
    assert len(set(noises)) == len(noises) == 2 * 4


def test_columns_about_episodes_by_hand():
    def episode(reward, length, rho, strict, reason):
        return {"return": reward, "length": length, "info": {
            "fractional_success": rho, "fractional_success_strict": strict,
            "truncated_by": reason}}

    sums = train.episode_sums([
        episode(10.0, 50, 0.8, 0.7, "time"), episode(-4.0, 20, 0.79, 0.1, "a cube left the arena"),
        episode(0.0, 50, 1.0, 0.9, "time"), episode(6.0, 8, 0.0, 0.0, "time")])
    expected = {"episodes": 4, "return": 3.0, "length": 32.0, "success_aabb": 2.59 / 4,
                "success_strict": 1.7 / 4, "solved": 0.5, "cut_short": 1}
    assert train.summarize(sums) == pytest.approx(expected)


def test_a_checkpoint_is_due_after_its_minutes(monkeypatch):
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0)
    due = train.Run(run_arguments(save_minutes=2.0), train.DEFAULTS, None).is_due
    for seconds, expected in ((119, False), (121, True)):
        monkeypatch.setattr(time, "monotonic", lambda: 1000.0 + seconds)
        assert due() == expected


@pytest.mark.parametrize("kind", ["lrn-max", "rn", "attn", "mlp"])
def test_other_encoders_train_and_are_evaluated(kind, tmp_path, command, in_this_process, capsys):
    out = tmp_path / "run"
    command("train.py --distractors 1 --ranks 1 --frames 200 --encoder", kind, "--out", out, *SMALL)
    command("evaluate.py --distractors 0,1 --episodes 2 --save", out)
    assert ("fixed input" in capsys.readouterr().out) == (kind == "mlp")
    rows = read_csv(out / "zeroshot.csv")
    assert [row["distractors"] for row in rows] == ([1] if kind == "mlp" else [0, 1])
    assert train.load(str(out))[1].kind == kind


OWN_ENCODER = """
import sys
import torch
sys.path.insert(0, {here!r})
import train


class Mine(torch.nn.Module):
    def __init__(self, token_dim, z_dim):
        super().__init__()
        self.out = torch.nn.Linear(2 * token_dim, z_dim)

    def forward(self, objects, goal):
        return self.out(torch.cat([objects.mean(1), goal], dim=1))


train.ENCODERS["mine"] = (Mine, ("token_dim", "z_dim"))

if __name__ == "__main__":
    train.main()
"""


def test_adding_an_encoder_of_ones_own_is_one_line(tmp_path, monkeypatch):
    """A script of one's own trains it, on two ranks; the checkpoint is read where it is known."""
    script, out = tmp_path / "own.py", str(tmp_path / "run")
    script.write_text(OWN_ENCODER.format(here=HERE))
    unknown = start_process(str(script), "--encoder", "theirs", "--out", str(tmp_path / "theirs"))
    done = run(str(script), "--encoder", "mine", "--ranks", "2", "--frames", "600", "--out", out,
               *SMALL, "z_dim=12")
    assert done.returncode == 0, done.stderr
    with pytest.raises(ValueError, match="mine"):
        train.load(out)
    monkeypatch.setattr(train, "ENCODERS", dict(train.ENCODERS))           # own.py adds to it
    monkeypatch.syspath_prepend(tmp_path)
    import own
    checkpoint, agent = train.load(out)
    assert checkpoint["update"] == 3 and type(agent.encoder) is own.Mine
    assert agent.encoder.out.weight.shape == (12, 128)
    torch.manual_seed(0)
    untrained = train.Agent("mine", 2, checkpoint["settings"])
    assert not torch.equal(agent.encoder.out.weight, untrained.encoder.out.weight)
    _, errors = unknown.communicate(timeout=60)
    assert unknown.returncode == 2 and "theirs" in errors and "Traceback" not in errors


# ---------------------------------------------------------------- stopping and resuming

needs_proc = pytest.mark.skipif(not os.path.exists("/proc/self/stat"),
                                reason="looks for processes in /proc")


def alive(group):
    """Processes of a process group that are not dead (state Z: dead, not yet collected)."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/stat") as file:
                state, _, pgrp = file.read().rpartition(")")[2].split()[:3]
        except OSError:                                        # gone in between
            continue
        if pgrp == str(group) and state != "Z":
            found.append(int(pid))
    return found


def wait_for_the_end_of(group):
    begin = time.monotonic()
    while alive(group):
        assert time.monotonic() - begin < 30, alive(group)
        time.sleep(0.05)


def start_process(*command, cwd=HERE, env=None):
    """A command under way, in a process group of its own."""
    return subprocess.Popen([sys.executable, *command], cwd=cwd, env=env, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, start_new_session=True)


def update_of(line):
    """The number of a line "update 3/16 ..."; None for other lines."""
    return int(line[7:].split("/")[0]) if line.startswith("update ") else None


def read_updates(process, count):
    """Read a run's output until it has told of `count` more updates; the last one's number."""
    last = 0
    while count:
        line = process.stdout.readline()
        if not line:                                           # the run is over
            break
        if update_of(line):
            last = update_of(line)
            count -= 1
    return last


def end_process(process, how, whole_group):
    """Send a signal, wait until nobody is left. Returns the rest of the output."""
    if whole_group:
        os.killpg(process.pid, how)
    else:
        os.kill(process.pid, how)
    rest, _ = process.communicate(timeout=60)
    wait_for_the_end_of(process.pid)
    return rest


def stop_run(process, ranks):
    """SIGTERM to the first process or Ctrl-C to all: the run ends well, in so many seconds."""
    begin = time.monotonic()
    if ranks == 1:
        rest = end_process(process, signal.SIGTERM, whole_group=False)
    else:
        rest = end_process(process, signal.SIGINT, whole_group=True)
    seconds = time.monotonic() - begin
    assert process.returncode == 130 and "stopped after" in rest and seconds < 10
    return seconds


def kill(process, folder, rng, while_writing):
    """kill -9 to all, at random or while a checkpoint is written. The last update told of."""
    seen = read_updates(process, int(rng.integers(0, 5)))
    if while_writing:
        while process.poll() is None and not os.path.exists(folder / "checkpoint.pt.tmp"):
            pass
    else:
        time.sleep(rng.uniform(0, 0.3))
    rest = end_process(process, signal.SIGKILL, whole_group=True)
    return max([seen, *filter(None, map(update_of, rest.splitlines()))])


class InterruptedFile(io.FileIO):
    """Ctrl-C comes with the third piece that is written."""

    pieces = 0

    def write(self, piece):
        self.pieces += 1
        if self.pieces == 3:
            raise KeyboardInterrupt
        return super().write(piece)


def test_a_stop_in_the_middle_of_a_checkpoint_stays_a_stop(tmp_path, monkeypatch):
    """torch.save, left by an exception, raises one of its own (RuntimeError, "unexpected pos")."""
    path = str(tmp_path / "checkpoint.pt")
    train.save({"x": torch.zeros(1000)}, path)
    monkeypatch.setattr(train, "open", InterruptedFile, raising=False)
    with pytest.raises(KeyboardInterrupt):
        train.save({"x": torch.ones(1000)}, path)
    assert torch.equal(torch.load(path)["x"], torch.zeros(1000))           # the old one


def save_changed(run_folder, out, changes, **settings):
    """Write a run's checkpoint with some of its entries, or settings, changed to folder `out`."""
    checkpoint = torch.load(os.path.join(run_folder, "checkpoint.pt"), weights_only=True)
    checkpoint["settings"].update(settings)
    train.save({**checkpoint, **changes}, os.path.join(out, "checkpoint.pt"))


@needs_proc
@pytest.mark.parametrize("delay", [0.2, 3.0])
def test_ctrl_c_before_the_first_update_ends_both_ranks(delay, tmp_path):
    """While the second rank is still importing, and later; 60 s are far below gloo's 10 minutes."""
    process = start_process("train.py", "--ranks", "2", "--out", str(tmp_path / "run"))
    while len(alive(process.pid)) < 3:                         # two ranks and a resource tracker
        time.sleep(0.01)
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)
    try:
        printed, errors = process.communicate(timeout=60)
        wait_for_the_end_of(process.pid)
    finally:
        for pid in alive(process.pid):
            os.kill(pid, signal.SIGKILL)
    assert process.returncode == 130 and "stopped" in printed and "Traceback" not in errors, errors


def assert_same_run(whole, cut):
    """Bit-equal weights, byte-equal progress.csv, and time goes on where it stopped."""
    expected, ours = (torch.load(folder / "checkpoint.pt", weights_only=True)
                      for folder in (whole, cut))
    assert expected["update"] == ours["update"]
    for key, value in expected["learner"].items():
        assert torch.equal(value, ours["learner"][key]), key
    assert read(whole / "progress.csv") == read(cut / "progress.csv")
    times = read_csv(cut / "timing.csv")
    assert [row["update"] for row in times] == list(range(1, ours["update"] + 1))
    assert (np.diff([row["seconds"] for row in times]) > 0).all()
    assert ours["seconds"] == pytest.approx(times[-1]["seconds"], abs=0.01)


@needs_proc
@pytest.mark.parametrize("ranks", [1, 2])
def test_stopped_killed_and_resumed_equals_never_stopped(ranks, tmp_path):
    """Stopped, then killed at random moments, every other one while a checkpoint is written, each
    time resumed: bit-equal weights and byte-equal progress.csv in the end."""
    kills = 20 if SLOW else 1
    updates = 8 + 8 * kills
    rng = np.random.default_rng(ranks)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    command = ["train.py", "--distractors", "1", "--ranks", str(ranks), "--save-minutes", "0",
               "--frames", str(200 * updates), *SMALL]
    never_stopped = start_process(*command, "--out", str(whole))

    process = start_process(*command, "--out", str(cut))
    seen = read_updates(process, 2)
    (cut / "zeroshot.csv").write_text("of the old weights")
    seconds = stop_run(process, ranks)
    inside = 0                                                 # kills during the writing
    for number in range(1, kills + 1):
        process = start_process(*command, "--out", str(cut), "--resume")
        seen = max(seen, kill(process, cut, rng, while_writing=number % 2 == 1))
        inside += os.path.exists(cut / "checkpoint.pt.tmp")
        kept = train.load(str(cut))[0]["update"]
        assert kept >= seen - 1                                # every update is saved here
    print(f"\n{ranks} ranks: stopped in {seconds:.1f} s; {kills} kills, {inside} inside the "
          f"writing, the last at update {kept}")

    done = run(*command, "--out", str(cut), "--resume", timeout=900)
    assert done.returncode == 0 and not os.path.exists(cut / "zeroshot.csv"), done.stderr
    _, errors = never_stopped.communicate(timeout=900)
    assert never_stopped.returncode == 0, errors
    assert train.load(str(whole))[0]["update"] == updates
    assert_same_run(whole, cut)


@pytest.mark.parametrize("options", ["", "--encoder rn --task lift", "--encoder attn",
                                     "--encoder mlp"])
def test_a_stop_in_the_middle_of_an_update_goes_back_to_its_beginning(
        options, tmp_path, capsys, monkeypatch, command):
    """Weights and moments of Adam have changed by then; what is saved is from before."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    words = ["train.py --ranks 1 --frames 800 --distractors 0", options, *SMALL, "--out"]
    command(*words, whole)
    step, calls = train.PPO.minibatch_step, []

    def interrupted(self, *rest):
        calls.append(rest)
        if len(calls) == 30:             # 12 minibatches an update: in the middle of the third
            raise KeyboardInterrupt
        return step(self, *rest)

    monkeypatch.setattr(train.PPO, "minibatch_step", interrupted)
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command(*words, cut)
    assert stop.value.code == 130 and "stopped after 2 updates" in capsys.readouterr().out
    assert train.load(str(cut))[0]["frames"] == 400
    command(*words, cut, "--resume")
    assert_same_run(whole, cut)


@needs_proc
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_stop_does_not_wait_for_a_long_update(ranks, tmp_path):
    """Ten minutes and more for a rollout here; it stops within seconds and leaves nobody behind."""
    out = tmp_path / "run"
    process = start_process("train.py", "--ranks", str(ranks), "--out", str(out), "--set", "envs=4",
                    "steps=500000", "minibatches=4")
    while not os.path.exists(out / "checkpoint.pt"):           # written as the run begins
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    stop_run(process, ranks)
    assert train.load(str(out))[0]["update"] == 0


def test_overwrite_starts_anew(tmp_path, command):
    """As if there had been no run before; scores of the old weights go."""
    fresh, again = tmp_path / "fresh", tmp_path / "again"
    command("train.py --ranks 1 --frames 200 --seed 1 --out", fresh, *SMALL)
    command("train.py --ranks 1 --frames 400 --out", again, *SMALL)
    (again / "zeroshot.csv").write_text("of the old weights")
    command("train.py --ranks 1 --frames 200 --seed 1 --overwrite --out", again, *SMALL)
    assert read(again / "progress.csv") == read(fresh / "progress.csv")
    assert sorted(os.listdir(again)) == sorted(os.listdir(fresh))
    assert train.load(str(again))[0]["seed"] == 1


def test_scores_go_when_the_weights_they_are_of_are_replaced(tmp_path, command, monkeypatch):
    """Somebody evaluates a run that is still being trained; evaluate.py --save keeps other N."""
    out = tmp_path / "run"
    write = train.Run.write

    def write_and_evaluate(run, *rest):
        write(run, *rest)
        if run.update == 1:
            (out / "zeroshot.csv").write_text("of these weights")

    monkeypatch.setattr(train.Run, "write", write_and_evaluate)
    command("train.py --ranks 1 --frames 600 --out", out, *SMALL)
    assert len(read_csv(out / "progress.csv")) == 3 and not os.path.exists(out / "zeroshot.csv")


def test_a_stop_before_anything_was_learned_keeps_the_scores(trained, tmp_path, command,
                                                             monkeypatch):
    """Ctrl-C comes in the first rollout after --resume."""
    def stop(learner, seeds):
        raise KeyboardInterrupt

    def leave(ranks, stopped):
        assert ranks == 1 and stopped
        raise SystemExit(train.STOPPED)

    out = tmp_path / "run"
    shutil.copytree(trained, out)
    (out / "zeroshot.csv").write_text("of these weights")
    save_changed(trained, out, {"ranks": 1}, frames=10 ** 6)
    before = files_below(out)
    monkeypatch.setattr(PPO, "rollout", stop)
    monkeypatch.setattr(train, "leave_ranks", leave)
    with pytest.raises(SystemExit):
        command("train.py --resume --distractors 0 --out", out)
    assert files_below(out) == before


def test_resuming_a_finished_run_changes_nothing(trained, tmp_path, command, capsys):
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    (out / "zeroshot.csv").write_text("of these weights")
    save_changed(trained, out, {"ranks": 1})                   # stay in this process
    before = files_below(out)
    command("train.py --resume --distractors 0 --out", out)
    assert "finished after 40 updates" in capsys.readouterr().out
    assert files_below(out) == before


def test_resume_drops_rows_after_the_checkpoint_and_torn_lines(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("update,score\n1,0.1\n2,0.2\n3,0.3\n4,0.4\n5,")
    train.keep_rows(str(path), ("update", "score"), 2)
    assert path.read_text() == "update,score\n1,0.1\n2,0.2\n"
    train.keep_rows(str(path), ("update", "score"), 0)
    assert path.read_text() == "update,score\n"
    train.add_row(str(path), ("update", "score"), {"score": 1 / 3, "update": 7, "more": 1})
    assert path.read_text() == "update,score\n7,0.333333\n"


def test_torchrun_starts_the_same_file(tmp_path):
    out = str(tmp_path / "run")
    done = run("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "train.py",
               "--frames", "400", "--out", out, *SMALL)
    assert done.returncode == 0, done.stderr
    checkpoint, _ = train.load(out)
    assert checkpoint["frames"] == 400 and checkpoint["ranks"] == 2


def test_variables_of_another_launcher_are_not_torchruns(tmp_path, command, monkeypatch):
    """Clusters set them for every job: this run has one rank all the same, and is written down."""
    for name, value in (("RANK", "1"), ("WORLD_SIZE", "2")):
        monkeypatch.setenv(name, value)
    assert train.read_command(["--ranks", "1"]).ranks == 1
    command("train.py --ranks 1 --frames 200 --out", tmp_path / "run", *SMALL)
    assert len(read_csv(tmp_path / "run" / "progress.csv")) == 1


@needs_proc
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_the_run_and_leaves_nobody_behind(victim, tmp_path):
    process = start_process("train.py", "--ranks", "2", "--out", str(tmp_path / "run"), *SMALL)
    read_updates(process, 2)
    other, = (pid for pid in alive(process.pid) if b"spawn_main" in read(f"/proc/{pid}/cmdline"))
    os.kill((process.pid, other)[victim], signal.SIGKILL)
    _, error = process.communicate(timeout=60)
    if victim == 1:
        assert process.returncode == 1 and "SIGKILL" in error and "--resume" in error, error
        assert "Traceback" not in error
    wait_for_the_end_of(process.pid)


def test_a_gradient_that_is_not_finite_ends_the_run_and_keeps_the_checkpoint(
        tmp_path, capsys, monkeypatch, command):
    out = tmp_path / "run"
    command("train.py --ranks 1 --frames 400 --distractors 0 --out", out, *SMALL)
    save_changed(out, out, {}, frames=800)                     # two more updates to play
    before = read(out / "checkpoint.pt")
    monkeypatch.setattr(train.Agent, "auxiliary",
                        lambda self, obs: self.log_std.sum() * float("nan"))
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command("train.py --distractors 0 --resume --out", out)
    assert stop.value.code == 1 and "update 3" in capsys.readouterr().err
    assert read(out / "checkpoint.pt") == before


def test_of_two_ranks_one_says_that_a_gradient_is_not_finite(tmp_path):
    done = run("train.py", "--ranks", "2", "--out", str(tmp_path / "run"), *SMALL,
               "reward_distance=1e300")
    assert done.returncode == 1 and done.stderr.count("not finite") == 1, done.stderr
    assert "Traceback" not in done.stderr


def test_a_checkpoint_that_lacks_a_setting_takes_the_default(trained, tmp_path, command):
    """As one of an older version would. Settings that it has stay as they are."""
    checkpoint, expected = train.load(trained)
    few = {name: value for name, value in checkpoint["settings"].items()
           if name not in ("reward_reach", "z_dim", "discount")}
    out = tmp_path / "run"
    os.mkdir(out)
    save_changed(trained, out, {"ranks": 1, "settings": few})
    loaded, agent = train.load(str(out))
    assert loaded["settings"]["reward_reach"] == 2500.0 and loaded["settings"]["discount"] == 0.98
    assert loaded["settings"]["z_dim"] == 25 and loaded["settings"]["envs"] == 8
    for ours, theirs in zip(agent.parameters(), expected.parameters()):
        assert torch.equal(ours, theirs)
    command("train.py --distractors 0 --resume --out", out)    # and it can be resumed


# ---------------------------------------------------------------- bad input

class Evil:
    def __reduce__(self):
        return os.mkdir, ("evil",)


@pytest.fixture
def bad(tmp_path, trained, monkeypatch):
    """Folder with a good run and every kind of broken one; also the working directory."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained, "good")
    good = torch.load(os.path.join("good", "checkpoint.pt"), weights_only=True)
    bare = {key: value for key, value in good.items() if key != "optimizer"}
    nan = {key: value * float("nan") for key, value in good["learner"].items()}
    for name, content in (
            ("list", [1, 2]),
            ("nan", {**good, "learner": nan}),
            ("other-z", {**good, "settings": {**good["settings"], "z_dim": 7}}),
            ("swapped", {**good, "encoder": "attn"}),
            ("unknown", {**good, "encoder": "gnn"}),
            ("no-seed", {key: value for key, value in good.items() if key != "seed"}),
            ("stranger", {"weights": good["learner"]}),
            ("code", Evil()),
            ("weights", bare)):
        os.mkdir(name)
        torch.save(content, os.path.join(name, "checkpoint.pt"))
    half = read(os.path.join("good", "checkpoint.pt"))[:5000]
    for name, content in (("half", half), ("empty", b""), ("text", b"no")):
        os.mkdir(name)
        with open(os.path.join(name, "checkpoint.pt"), "wb") as file:
            file.write(content)
    for name, content in (("torn", "distractors,episodes\n2,"), ("foreign", "a,b\n1,2\n")):
        shutil.copytree("good", name)
        with open(os.path.join(name, "zeroshot.csv"), "w") as file:
            file.write(content)
    os.mkdir("rows")
    shutil.copy(os.path.join("good", "progress.csv"), "rows")
    with open("file", "w") as file:
        file.write("not a folder")


NO_CHECKPOINT = "not a readable checkpoint"
BAD_INPUT = {                            # start of the command: ((its end, words of the error) ...)
    "train.py --out new": (
        ("--encoder gnn", "--encoder"),
        ("--task fly", "--task"),
        ("--distractors -1", "distractors"),
        ("--distractors 99", "distractors"),
        ("--distractors 1.5", "--distractors"),
        ("--distractors two", "--distractors"),
        ("--frames 0", "--frames"),
        ("--frames -5", "--frames"),
        ("--frames many", "--frames"),
        ("--seed -1", "--seed"),
        ("--seed x", "--seed"),
        (f"--seed {2 ** 32}", "--seed"),
        ("--ranks 0", "--ranks"),
        ("--ranks 3", "--ranks"),
        ("--save-minutes soon", "--save-minutes"),
        ("--save-minutes nan", "--save-minutes"),
        ("--save-minutes -1", "--save-minutes"),
        ("--speed 3", "--speed"),
        ("--resume", "new"),
        ("--resume --overwrite", "--overwrite"),
        ("--set joy=1", "joy"),
        ("--set z_dim", "z_dim"),
        ("--set z_dim=0", "z_dim"),
        ("--set z_dim=2.5", "z_dim"),
        ("--set relations=maybe", "relations"),
        ("--set lr=-1", "lr"),
        ("--set lr=nan", "lr"),
        ("--set log_std=inf", "log_std"),
        ("--set log_std=100", "log_std=100: expected a number from -20 to 20"),
        ("--set discount=1.01", "discount=1.01: expected a number from 0 to 1"),
        ("--set lam=2", "lam=2: expected a number from 0 to 1"),
        ("--set minibatches=7", "minibatches"),
        ("--set episode_steps=126", "never see the end of an episode"),
        ("--set z_dim=7 --set joy=1", "joy"),
        ("--set action_mode=torque", "action_mode"),
        ("--encoder attn --set heads=7", "heads"),
        ("--encoder rn --set relations=False", "--set relations: without effect on rn"),
        ("--encoder lrn-max --set layer_norm=False", "layer_norm: without effect on lrn-max"),
        ("--encoder lrn --set heads=2", "--set heads: without effect on lrn"),
        ("--encoder mlp --set token_dim=32", "--set token_dim: without effect on mlp"),
        ("--encoder mlp --set z_dim=5 heads=2", "--set heads: without effect on mlp"),
    ),
    "train.py --out": (
        ("file", "--out"),
        ("file/below", "--out"),
        ("good", "--overwrite"),
        ("rows", "--overwrite"),
    ),
    "train.py --resume --distractors 0 --out": (
        *((name, NO_CHECKPOINT) for name in (
            "list", "other-z", "swapped", "unknown", "no-seed", "stranger", "code", "half", "empty",
            "text", "rows", "file")),
        ("nan", "not finite"),
        ("weights", "without the optimiser"),
        ("good --encoder rn", "--encoder"),
        ("good --distractors 1", "--distractors"),
        ("good --seed 1", "--seed"),
        ("good --task lift", "--task"),
        ("good --set z_dim=7", "z_dim"),
        ("good --frames 7", "frames"),
        ("good --ranks 1", "ranks"),
    ),
    "evaluate.py --episodes 2 --save --distractors 0": (
        *((name, NO_CHECKPOINT) for name in ("none", "text", "half", "code", "file")),
        ("nan", "not finite"),
        ("", "RUN"),
        ("good --distractors x", "--distractors"),
        ("good --distractors 5-2", "--distractors"),
        ("good --distractors 5-", "--distractors"),
        ("good --distractors 30", "distractors"),
        ("good --episodes 0", "--episodes"),
        ("good --episodes some", "--episodes"),
        ("good none", NO_CHECKPOINT),
        ("good torn", "zeroshot.csv"),
        ("foreign", "zeroshot.csv"),
        ("good --gif nowhere/a.gif", "nowhere"),
        ("good --gif a.gif", "--save"),
        ("good --gif a.jpg", ".gif"),
        ("good --distractors 0-1000000000", "distractors"),
        ("good/checkpoint.pt", "--save needs a run folder"),
    ),
}


def test_bad_input_ends_with_one_line_and_status_2(bad, capsys, command, monkeypatch):
    """Each line names the flag or the file; nothing is started or written over, no traceback."""
    for module, name in ((train, "train"), (train, "mp"), (evaluate, "evaluate")):
        monkeypatch.setattr(module, name, None)                # to start anything would fail
    before = files_below(".")
    for first, cases in BAD_INPUT.items():
        for rest, words in cases:
            with pytest.raises(SystemExit) as stop:
                command(first, rest)
            error = [line for line in capsys.readouterr().err.splitlines()
                     if "pybullet build time" not in line]
            assert stop.value.code == 2 and len(error) == 1 and words in error[0], (rest, error)
    assert not os.path.exists("new") and not os.path.exists("evil")
    assert files_below(".") == before


def test_settings_with_an_effect_are_taken(tmp_path):
    for encoder, change in (("lrn", "relations=False"), ("attn", "heads=2"), ("mlp", "hidden=32"),
                            ("rn", "token_dim=32"), ("lrn-max", "z_dim=5"), ("lrn", "hidden=32")):
        _, settings = train.parse(["--encoder", encoder, "--set", change, "--out",
                                   str(tmp_path / "run")])
        name, _, value = change.partition("=")
        assert str(settings[name]) == value != str(train.DEFAULTS[name])


def test_nothing_is_unpickled_or_downloaded():
    """torch.load with weights_only; nothing is imported that runs code or reaches the network."""
    known = {"argparse", "copy", "csv", "datetime", "math", "multiprocessing", "os",
             "shutil", "signal", "socket", "sys", "tempfile", "time", "typing", "numpy", "torch",
             "pybullet", "gymnasium", "PIL", "lrn", "rn", "attn", "ppo", "train", "trifinger_env"}
    scripts = [name for name in os.listdir(os.path.join(HERE, "results")) if name.endswith(".py")]
    of_results = {"evaluate", "functools", "glob", "matplotlib", "re", "sklearn",
                  "stable_baselines3", "subprocess", *(name[:-3] for name in scripts)}
    for name in (*MODULES, *(os.path.join("results", name) for name in scripts)):
        allowed = known if name in MODULES else known | of_results
        for node in ast.walk(ast.parse(read(os.path.join(HERE, name)))):
            modules = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                modules = [node.module]
            assert {module.split(".")[0] for module in modules} <= allowed, (name, modules)
            if isinstance(node, ast.Call):
                call = ast.unparse(node)
                assert "allow_pickle" not in call
                if ast.unparse(node.func) == "torch.load":
                    assert "weights_only=True" in call, (name, call)


# ---------------------------------------------------------------- evaluation

class Simple(nn.Module):
    """An agent of few operations, all one by one, so that a batch of any size gives equal bits.

    Its means follow finger 0's angles; z is the goal's row. Its read-out says 0.3 m, 0.1 m, 0 m.
    """

    def __init__(self, log_std=-1.0):
        super().__init__()
        self.log_std = torch.full((9,), log_std)

    def forward(self, obs):
        fingers = obs["fingers"][:, 0, :9]
        return 0.5 - fingers, self.log_std, fingers[:, 0]

    def encode(self, obs):
        return obs["goal"][:, 4:7]

    def read_out(self, z):
        return torch.tensor([1.5, 0.5, 0.0]).expand(len(z), 3)


class Touchy(TriFingerEnv):
    """Its success depends on every action of an episode, also where no cube is touched."""

    def reset(self, **options):
        self.felt = 0.0
        return super().reset(**options)

    def step(self, action):
        *result, info = super().step(action)
        self.felt = 0.9 * self.felt + np.sum(action) / 100
        info["fractional_success"] += self.felt
        return *result, info


@pytest.fixture
def simple(monkeypatch):
    """A run "simple", trained with 1 distractor, whose agent is Simple and whose world Touchy."""
    settings = {**train.DEFAULTS, "episode_steps": 15, "goal_yaw": 0.4}
    checkpoint = {"task": "push", "distractors": 1, "encoder": "lrn", "frames": 7,
                  "settings": settings}
    agent = Simple()
    monkeypatch.setattr(evaluate, "load", lambda path: (checkpoint, agent))
    monkeypatch.setattr(evaluate, "checkpoint_file", lambda run: __file__)   # copied
    monkeypatch.setattr(train, "TriFingerEnv", Touchy)
    return checkpoint


def slow_play(task, settings, n, episodes, sample_actions):
    """evaluate.play() as a plain loop, one episode after the other."""
    agent, results = Simple(), []
    for episode in episodes:
        seed = int(np.random.SeedSequence([20220131, episode]).generate_state(1)[0])
        other = np.random.SeedSequence([20220131, episode, 1])
        noise = np.random.default_rng(int(other.generate_state(1)[0]))
        env = train.make_env(task, n, settings)
        obs, _ = env.reset(seed=seed)
        truncated = False
        target = np.array(pose_of(env, env.target)[0])
        while not truncated:
            mean, log_std, _ = agent(as_batch([obs]))
            action = mean[0].numpy()
            if sample_actions:
                action = action + math.exp(-1.0) * noise.standard_normal(9)
            obs, _, _, truncated, info = env.step(action)
        results.append((info["fractional_success"], info["fractional_success_strict"],
                        math.dist(target, (0.3, 0.1, 0.0))))
        env.close()
    return np.array(results)


@pytest.mark.parametrize("task, n, sample_actions", [
    ("push", 0, False), ("push", 2, False), ("push", 2, True), ("lift", 2, False)])
def test_play_equals_a_plain_loop_over_episodes(simple, task, n, sample_actions):
    simple["task"] = task
    ours = evaluate.play(simple, Simple(), n, range(3, 9), sample_actions)
    expected = slow_play(task, simple["settings"], n, range(3, 9), sample_actions)
    column = dict(zip(evaluate.Episode._fields, zip(*ours)))
    np.testing.assert_allclose(column["success_aabb"], expected[:, 0], atol=1e-5)
    np.testing.assert_allclose(column["success_strict"], expected[:, 1], atol=1e-5)
    np.testing.assert_allclose(column["read_error"], expected[:, 2], atol=1e-5)
    assert [episode.cut_short for episode in ours] == [False] * 6
    if task == "push":                                         # a lifting goal's height differs
        assert column["z_drift"] == (pytest.approx(0, abs=1e-6),) * 6
    assert len(set(expected[:, 2])) == 6                       # six different starts
    assert all(abs(episode.success_aabb - episode.success_strict) > 1e-3 for episode in ours)


def test_an_agent_without_read_out_has_no_read_error(simple):
    simple["settings"]["auxiliary"] = 0.0
    episodes = evaluate.play(simple, Simple(), 0, range(2), True)
    assert all(math.isnan(episode.read_error) for episode in episodes)


class Ends:
    """Stands in for an environment: an episode of `length` steps."""

    def __init__(self, length):
        self.length, self.steps = length, 0

    def step(self, action):
        self.steps += 1
        obs = {"fingers": np.full((3, 10), self.steps, np.float32)}
        return obs, 0.0, False, self.steps == self.length, {"steps": self.steps}


def test_every_environment_is_played_to_its_own_end_and_no_further():
    envs = [Ends(3), Ends(1), Ends(5)]
    first = [{"fingers": np.zeros((3, 10), np.float32)} for _ in envs]
    with torch.no_grad():
        infos = evaluate.to_the_end(Simple(), envs, first)
    assert [info["steps"] for info in infos] == [3, 1, 5]
    assert [env.steps for env in envs] == [3, 1, 5]


def test_an_episode_that_ends_for_another_reason_is_cut_short(simple, monkeypatch):
    reasons = iter(["time", "a cube left the arena", "the physics diverged"])
    monkeypatch.setattr(evaluate, "to_the_end", lambda *_: [
        {"fractional_success": 0.5, "fractional_success_strict": 0.25, "truncated_by": reason}
        for reason in reasons])
    blocked = iter([True, False, True])
    monkeypatch.setattr(evaluate, "is_blocked", lambda obs: next(blocked))
    episodes = evaluate.play(simple, Simple(), 0, range(3), False)
    assert [episode.cut_short for episode in episodes] == [False, True, True]
    assert [episode.blocked for episode in episodes] == [True, False, True]
    assert {(episode.success_aabb, episode.success_strict) for episode in episodes} == {(0.5, 0.25)}


def test_evaluation_starts_belong_to_no_training_run():
    seeds = {evaluate.episode_seed(episode) for episode in range(1000)}
    assert len(seeds) == 1000
    for seed in range(3):
        for update in range(50):
            assert not seeds & set(train.reseed(seed, update, 0, 32))


def test_drift_and_read_error_by_hand():
    """z of training: a triangle of sides 3, 4, 5. On average 4 apart."""
    z_trained = torch.tensor([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    z = z_trained + torch.tensor([[0.0, 0.0], [0.0, 2.0], [6.0, 8.0]])
    first = []
    for target in ([0.3, 0.1, 0.0], [0.0, 0.1, 0.0], [0.3, 0.1, 0.05]):
        obs = {"cubes": np.zeros((3, 18), np.float32), "goal": np.zeros(12, np.float32)}
        obs["cubes"][:, -1] = (0.5, -0.3, 0.1)
        obs["goal"][-1] = np.float32(-0.3)
        obs["cubes"][1, 4:7] = np.divide(target, 0.2)
        first.append(obs)
    drift = evaluate.drift_of(z, z_trained)
    assert drift.tolist() == pytest.approx([0.0, 2 / 4, 10 / 4])
    error = evaluate.read_errors(Simple(), first, z)
    assert error.tolist() == pytest.approx([0.0, 0.3, 0.05], abs=1e-6)


def test_a_chunk_of_one_episode_has_no_drift(simple):
    """Nothing to compare with: NaN, which a mean over more episodes leaves out."""
    one, = evaluate.play(simple, Simple(), 0, range(1), False)
    assert math.isnan(one.z_drift)
    more = [one._replace(z_drift=0.25), one, one._replace(z_drift=0.75)]
    assert evaluate.summary(0, more)["z_drift"] == 0.5
    assert math.isnan(evaluate.summary(0, [one])["z_drift"])


def test_blocked_ways_by_hand():
    """From (-0.1, 0) to (0.1, 0): blocked within 65 mm of the segment, not of the line."""
    obs = {"cubes": np.zeros((3, 18), np.float32), "goal": np.zeros(12, np.float32)}
    obs["cubes"][:, -1] = (-0.5, 0.0, 0.5)
    obs["goal"][-1] = 0.5
    obs["cubes"][2, 4:6] = np.divide([-0.1, 0.0], 0.2)
    obs["goal"][4:6] = np.divide([0.1, 0.0], 0.2)
    obs["cubes"][1, 4:6] = np.divide([0.0, -0.2], 0.2)
    for x, y, blocks in ((0.0, 0.06, True), (0.0, 0.07, False), (0.16, 0.0, True),
                         (0.17, 0.0, False), (-0.14, 0.04, True), (-0.15, 0.05, False)):
        obs["cubes"][0, 4:6] = np.divide([x, y], 0.2)
        assert evaluate.is_blocked(obs) == blocks, (x, y)
    assert evaluate.is_target(obs).tolist() == [False, False, True]


def test_a_trained_agent_drifts_at_other_numbers_and_reads_its_cube(trained):
    checkpoint, agent = train.load(trained)                    # it was trained with 0
    same_n = evaluate.play(checkpoint, agent, 0, range(4), False)
    other_n = evaluate.play(checkpoint, agent, 3, range(4), False)
    assert all(episode.z_drift == 0 for episode in same_n)
    assert all(episode.z_drift > 0.01 for episode in other_n)
    assert not any(episode.blocked for episode in same_n)
    errors = [episode.read_error for episode in same_n]
    assert 0.001 < max(errors) < 0.25                          # m; the arena's radius is 0.24


def test_summary_of_four_episodes_by_hand():
    """The squared deviations add up to 0.54 and 0.5; a row of one episode has no interval."""
    Episode = evaluate.Episode
    row = evaluate.summary(5, [
        Episode(1.0, 0.8, False, True, 0.1, 0.0), Episode(0.0, 0.0, True, False, 0.3, 0.0),
        Episode(0.8, 0.7, False, False, 0.1, 0.0), Episode(0.79, 0.1, False, False, 0.1, 0.1)])
    rho = [1.0, 0.0, 0.8, 0.79]
    spread = sum((value - 2.59 / 4) ** 2 for value in rho)
    expected = {
        "distractors": 5, "episodes": 4, "success_aabb": 2.59 / 4, "success_strict": 0.4,
        "ci95": 1.96 * math.sqrt(spread / 3) / 2, "ci95_strict": 1.96 * math.sqrt(0.5 / 3) / 2,
        "solved": 0.5, "cut_short": 1, "blocked": 0.25, "success_clear": 1.59 / 3,
        "success_blocked": 1.0, "z_drift": 0.15, "read_error": 0.025}
    assert row == pytest.approx(expected) and tuple(row) == evaluate.COLUMNS
    one = evaluate.summary(0, [Episode(1.0, 0.8, False, False, 0.1, 0.0)])
    assert math.isnan(one["ci95"]) and math.isnan(one["success_blocked"])


def test_a_row_is_printed_as_it_is(capsys):
    row = dict(zip(evaluate.COLUMNS, (9, 50, 0.71, 0.62, 0.03, 0.04, 0.55, 6, 0.25, 0.8, 0.4, 0.17,
                                      0.0123)))
    evaluate.print_row(row, 150.0)
    numbers = capsys.readouterr().out.split()
    assert numbers == ("9 0.710 +- 0.030 0.620 +- 0.040 0.550 6 0.800 0.400 (0.25) 0.170 12.3 "
                       "about 2.5 min left").split()


def test_a_run_that_trains_on_meanwhile_does_not_change_what_is_evaluated(
        trained, tmp_path, in_this_process, monkeypatch):
    """Its checkpoint is replaced after the look at it, before the first episode is played."""
    def read_errors(run):
        return [row["read_error"] for row in evaluate.evaluate(str(run), [0, 1], 2)]

    expected = read_errors(trained)
    copy = shutil.copytree(trained, tmp_path / "run")
    load = evaluate.load

    def load_and_replace(path):
        checkpoint, agent = load(path)
        later = {**checkpoint, "learner": {name: value + 0.1 for name, value
                                           in checkpoint["learner"].items()}}
        train.save(later, str(copy / "checkpoint.pt"))
        return checkpoint, agent

    monkeypatch.setattr(evaluate, "load", load_and_replace)
    assert read_errors(copy) == expected
    monkeypatch.undo()
    assert read_errors(copy) != expected


def test_evaluation_prints_each_n_as_it_is_done_with_the_time_left(
        simple, in_this_process, monkeypatch, capsys):
    """60 episodes are three chunks a minute long each: 9 minutes in all for three N."""
    clock, calls, printed = [0.0], [], []

    def play(checkpoint, agent, n, episodes, sample_actions):
        printed.extend(capsys.readouterr().out.splitlines())
        calls.append((n, episodes, len(printed)))
        clock[0] += 60.0
        return [evaluate.Episode(0.1 * n, 0.0, False, False, 0.0, 0.0)] * len(episodes)

    monkeypatch.setattr(evaluate, "play", play)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    rows = evaluate.evaluate("simple", [0, 2, 7], 60)
    printed += capsys.readouterr().out.splitlines()
    chunks = [range(0, 25), range(25, 50), range(50, 60)]
    assert [call[:2] for call in calls] == [(n, chunk) for n in (0, 2, 7) for chunk in chunks]
    assert [call[2] for call in calls] == [2] * 3 + [3] * 3 + [4] * 3      # two lines above
    assert [line.split()[0] for line in printed[2:]] == ["0", "2", "7"]
    assert "about 6.0 min left" in printed[2] and "about 3.0 min left" in printed[3]
    assert "left" not in printed[4]
    assert [row["success_aabb"] for row in rows] == pytest.approx([0.0, 0.2, 0.7])
    assert [row["episodes"] for row in rows] == [60, 60, 60]
    assert "mean actions" in printed[0] and "60 episodes each" in printed[0]


def test_evaluation_leaves_a_run_as_it_is_unless_asked_to_save(trained, tmp_path, command):
    """Other processes play; --save writes what is printed; other N stay, the same N is replaced."""
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    before = files_below(out)
    done = run("evaluate.py", str(out), "--episodes", "3", "--distractors", "0,3")
    assert done.returncode == 0 and files_below(out) == before, done.stderr
    printed = [line.split() for line in done.stdout.splitlines()[-2:]]
    assert [line[0] for line in printed] == ["0", "3"]
    read_error = float(printed[1][-1])                         # mm

    command("evaluate.py", out, "--episodes 3 --distractors 3 --save")
    saved, = read_csv(out / "zeroshot.csv")
    assert saved["read_error"] == pytest.approx(read_error / 1000, abs=1e-7)
    assert f"{saved['success_aabb']:.3f}" == printed[1][1] and saved["episodes"] == 3
    alone = evaluate.play(*train.load(str(out)), 3, range(3), False)       # in this process
    for name in ("success_aabb", "read_error"):
        expected = np.mean([getattr(episode, name) for episode in alone])
        assert saved[name] == pytest.approx(expected, abs=1e-4), name
    assert expected > 0.01                                     # the scores are 0 here
    assert set(files_below(out)) - set(before) == {str(out / "zeroshot.csv")}


def test_a_checkpoint_of_any_name_can_be_evaluated(
        trained, tmp_path, command, in_this_process, capsys):
    shutil.copy(os.path.join(trained, "checkpoint.pt"), tmp_path / "best.pt")
    lines = []
    for path in (trained, tmp_path / "best.pt"):
        command("evaluate.py", path, "--episodes 2 --distractors 1")
        lines.append(capsys.readouterr().out.splitlines()[-1])
    assert lines[0] == lines[1] and lines[0].split()[0] == "1"


def test_rows_are_saved_in_order_and_other_n_stay(tmp_path):
    path = str(tmp_path / "zeroshot.csv")

    def row(n, value):
        return {**dict.fromkeys(evaluate.COLUMNS, value), "distractors": n, "episodes": 7}

    evaluate.save_rows(path, [row(9, 0.25), row(2, 0.5)])
    evaluate.check_csv(tmp_path, "zeroshot.csv")
    evaluate.save_rows(path, [row(2, 0.75), row(0, 1 / 3)])
    lines = read(path).decode().splitlines()
    assert lines == [",".join(evaluate.COLUMNS), "0,7" + 11 * ",0.3333", "2,7" + 11 * ",0.7500",
                     "9,7" + 11 * ",0.2500"]


def test_sampled_actions_are_saved_apart(tmp_path, command, in_this_process):
    """By an agent whose scores tell sampled actions from mean ones."""
    out = tmp_path / "run"
    out.mkdir()
    shutil.copy(os.path.join(HERE, "results", "push-lrn-n2-seed1", "checkpoint.pt"), out)
    command("evaluate.py --sample-actions --save --distractors 2 --episodes 4", out)
    assert not os.path.exists(out / "zeroshot.csv")
    row, = read_csv(out / "zeroshot-sampled.csv")
    sampled, mean = (np.mean([episode.success_aabb for episode in evaluate.play(
        *train.load(str(out)), 2, range(4), sample_actions)]) for sample_actions in (True, False))
    assert row["success_aabb"] == pytest.approx(sampled, abs=1e-4)
    assert abs(sampled - mean) > 0.01


def test_ctrl_c_keeps_the_scores_of_runs_played_to_the_end(
        trained, tmp_path, command, in_this_process, monkeypatch, capsys):
    first, second = (shutil.copytree(trained, tmp_path / name) for name in ("first", "second"))
    evaluate_run = evaluate.evaluate

    def stopped_in_the_second(run, *rest):
        if run == str(second):
            raise KeyboardInterrupt
        return evaluate_run(run, *rest)

    monkeypatch.setattr(evaluate, "evaluate", stopped_in_the_second)
    with pytest.raises(SystemExit) as end:
        command("evaluate.py", first, second, "--distractors 0 --episodes 1 --save")
    assert end.value.code == 130 and "stopped" in capsys.readouterr().err
    assert len(read_csv(first / "zeroshot.csv")) == 1
    assert not os.path.exists(second / "zeroshot.csv")


def test_scores_are_not_saved_if_the_run_was_trained_on_meanwhile(
        trained, tmp_path, command, in_this_process, monkeypatch, capsys):
    out = shutil.copytree(trained, tmp_path / "run")
    evaluate_run = evaluate.evaluate

    def evaluate_and_train_on(run, *rest):
        rows = evaluate_run(run, *rest)
        save_changed(run, run, {"update": 41})
        return rows

    monkeypatch.setattr(evaluate, "evaluate", evaluate_and_train_on)
    with pytest.raises(SystemExit) as end:
        command("evaluate.py", out, "--distractors 0 --episodes 1 --save")
    assert end.value.code == 2 and "meanwhile" in capsys.readouterr().err
    assert not os.path.exists(out / "zeroshot.csv")


def test_commands_without_options_mean_what_the_readme_says(command, monkeypatch):
    calls = []
    monkeypatch.setattr(evaluate, "evaluate", lambda *given: calls.append(given) or [])
    monkeypatch.setattr(evaluate, "watch", lambda *given: calls.append(given))
    shipped = os.path.join(HERE, "results", "push-lrn-n2-seed1")
    command("evaluate.py", shipped)
    command("evaluate.py --watch", shipped)
    assert calls == [(shipped, list(range(10)), 200, False), (shipped, 2, 200, False)]


def test_ranges_of_distractors():
    for text, expected in (("0-3", [0, 1, 2, 3]), ("14,2,5", [2, 5, 14]), ("0-2,1-3,9",
                           [0, 1, 2, 3, 9]), ("7", [7]), ("5,25", [5, 25])):
        assert evaluate.parse_range(text) == expected


@pytest.mark.parametrize("played_task", ["push", "lift"])
def test_watching_plays_the_evaluated_episodes(played_task, simple, monkeypatch, capsys):
    """The window is replaced by none; what is printed is what play() says."""
    def make_env(task, distractors, settings, render_mode=None):
        assert (task, render_mode) == (played_task, "human")
        return train.make_env(task, distractors, settings)

    simple["task"] = played_task
    expected = slow_play(played_task, simple["settings"], 2, range(3), sample_actions=True)[:, 0]
    monkeypatch.setattr(evaluate, "make_env", make_env)
    evaluate.watch("simple", 2, 3, True)
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[-1] for line in lines] == [f"{rho:.2f}" for rho in expected]
    assert [line.split(":")[0] for line in lines] == ["episode 0", "episode 1", "episode 2"]


def test_ctrl_c_ends_watching(simple, monkeypatch, capsys):
    def stopped(*_):
        raise KeyboardInterrupt

    env = train.make_env("push", 2, simple["settings"])
    monkeypatch.setattr(evaluate, "make_env", lambda *_, **__: env)
    monkeypatch.setattr(evaluate, "play_live", stopped)
    try:
        evaluate.watch("simple", 2, 3, True)
    except KeyboardInterrupt:
        pytest.fail("it got through")                          # it would end pytest itself
    assert capsys.readouterr().out.endswith("stopped\n")


def test_closing_the_window_ends_watching(simple, monkeypatch, capsys):
    env = train.make_env("push", 2, simple["settings"])
    client = env._client

    def closed(*_):
        env.close()
        env._client = client             # what a window that the user closes leaves behind
        raise pb.error("Not connected to physics server.")

    monkeypatch.setattr(evaluate, "make_env", lambda *_, **__: env)
    monkeypatch.setattr(evaluate, "play_live", closed)
    evaluate.watch("simple", 2, 3, True)
    assert capsys.readouterr().out.endswith("the window was closed\n")
    env._client = None


@pytest.mark.parametrize("substeps, pictures, milliseconds", [(5, 8, 80), (20, 16, 160)])
def test_film_shows_one_episode(substeps, pictures, milliseconds, simple, tmp_path, capsys):
    """15 steps at 25 Hz: pictures of the start and of every other step; at 6.25 Hz of every one."""
    optional("PIL")
    from PIL import Image
    path = str(tmp_path / "a.gif")
    simple["settings"]["substeps"] = substeps
    evaluate.film("simple", 2, False, path)
    with Image.open(path) as film:
        assert film.n_frames == pictures and film.size == (320, 240)
        assert film.info["duration"] == milliseconds
        first = np.array(film.convert("RGB"), int)
        film.seek(pictures - 1)
        assert np.abs(np.array(film.convert("RGB"), int) - first).max() > 50
    rho, = slow_play("push", simple["settings"], 2, [0], sample_actions=False)[:, 0]
    assert f"fractional success {rho:.2f}" in capsys.readouterr().out


def test_a_film_ends_where_the_physics_diverge(simple, tmp_path, monkeypatch, capsys):
    """Step 4 would have a picture, but there is no world left to draw."""
    optional("PIL")
    from PIL import Image
    env = train.make_env("push", 2, simple["settings"], "rgb_array")
    steps = itertools.count(1)
    plain_step = env.step

    def step(action):
        if next(steps) == 4:
            put(env, 1, (0, 0, 0.1), velocity=[float("nan")] * 3)
        return plain_step(action)

    monkeypatch.setattr(env, "step", step)
    monkeypatch.setattr(evaluate, "make_env", lambda *_: env)
    evaluate.film("simple", 2, False, str(tmp_path / "a.gif"))
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 2                              # of the start and of step 2
    assert "wrote" in capsys.readouterr().out


def test_a_film_from_the_command_line(trained, tmp_path, command, capsys):
    optional("PIL")
    before = files_below(trained)
    command("evaluate.py", trained, "--gif", tmp_path / "a.gif", "--distractors 1")
    assert "1 distractors" in capsys.readouterr().out
    command("evaluate.py", trained, "--gif", tmp_path / "a.gif")
    assert "0 distractors" in capsys.readouterr().out          # as it was trained
    assert read(tmp_path / "a.gif")[:6] == b"GIF89a"
    assert files_below(trained) == before


# ---------------------------------------------------------------- results/

SCRIPTS = {                              # script: (arguments, words that it prints)
    "reweigh.py": (["RUN", "--distractors", "1", "--episodes", "2"],
                   ["as it is", "distractors reweighed", "lengths: a distractor"]),
    "profile_training.py": (["--updates", "1"], ["ms a frame", "bare physics", "update"]),
    "encoder_speed.py": (["--repeats", "1"], ["LRN: K=12", "ATTN: K=12", "RN: K=12", "slope"]),
    "grasp.py": (["--tries", "1"], ["0.08 kg | 0.00"]),
    "scripted_lift.py": (["--episodes", "2"], ["all | 2 | 1.00"]),
    "phases.py": (["RUN", "--distractors", "1", "--episodes", "2"],
                  ["lrn | 1 | all | 2"]),
    "thrown.py": (["RUN", "--distractors", "1", "--episodes", "2"], ["far out", "| lrn | 0."]),
    "probe.py": (["RUN", "--distractors", "1"], ["named cube (mm)", "| lrn | 1 | "]),
    "screen.py": (["--steps", "1", "--episodes", "1", "--out", os.devnull],
                  ["| sum | 2 | 0 |", "| softmax | 9 | 1 |"]),
    "recheck.py": (["results/push-lrn-n2-seed2", "--episodes", "2"],
                   ["push-lrn-n2-seed2 | N = 2 | 0.", "push-lrn-n2-seed2 | N = 9 | 0."]),
}


@pytest.fixture(scope="module")
def scripts(trained):
    """All of SCRIPTS, started side by side."""
    return {name: start_process(os.path.join("results", name),
                        *(trained if word == "RUN" else word for word in arguments))
            for name, (arguments, _) in SCRIPTS.items()}


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_of_results_run(name, scripts):
    printed, errors = scripts[name].communicate(timeout=300)
    assert scripts[name].returncode == 0, errors
    for word in SCRIPTS[name][1]:
        assert word in printed


@pytest.mark.skipif(not SLOW, reason="takes a minute: SLOW=1")
def test_comparison_with_stable_baselines_runs():
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (optional)")
    done = run("results/against_sb3.py", "--updates", "1", "--envs", "8", timeout=300)
    assert done.returncode == 0, done.stderr
    assert "times as many" in done.stdout


@pytest.fixture
def results_scripts(monkeypatch):
    """Let a test import the modules of results/."""
    monkeypatch.syspath_prepend(os.path.join(HERE, "results"))


@pytest.mark.parametrize("kind", ["lrn", "rn", "attn"])
def test_reweighing_changes_nothing_at_the_n_of_training(kind, results_scripts):
    import reweigh

    agent = train.Agent(kind, 2, train.DEFAULTS)
    env = train.make_env("push", 2, train.DEFAULTS)
    obs = observations(env, count=4)
    env.close()
    with torch.no_grad():
        torch.testing.assert_close(reweigh.reweighed_z(agent, obs), agent.encode(obs),
                                   atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", ["lrn", "attn"])
def test_reweighed_distractors_count_as_two_of_five(kind, results_scripts):
    """Trained at 2, played at 5, term by term. (Pairs of RN: two tests further down.)"""
    import reweigh

    agent = train.Agent(kind, 2, train.DEFAULTS)
    env = train.make_env("push", 5, train.DEFAULTS)
    obs = observations(env, count=4)
    env.close()
    encoder, (objects, goal) = agent.encoder, agent.tokens(obs)
    terms = encoder.relations(objects, goal) if kind == "lrn" else encoder.attend(objects, goal)[0]
    z = reweigh.reweighed_z(agent, obs)
    for b in range(4):
        total = torch.zeros(D)
        for i, term in enumerate(terms[b]):
            is_distractor = i < 6 and obs["cubes"][b, i, -1] != obs["goal"][b, -1]
            total = total + term * (2 / 5 if is_distractor else 1)
        same(z[b], z_slow(encoder, total))


@pytest.mark.parametrize("kind, layer_norm, reason", [
    ("lrn-max", True, "knows how to reweigh lrn, rn and attn"),
    ("lrn", False, "only sums can be reweighed")])
def test_what_is_no_sum_is_not_reweighed(kind, layer_norm, reason, results_scripts, monkeypatch,
                                         capsys):
    import reweigh

    agent = train.Agent(kind, 2, {**train.DEFAULTS, "layer_norm": layer_norm})
    monkeypatch.setattr(reweigh, "load", lambda run: ({}, agent))
    monkeypatch.setattr(sys, "argv", ["reweigh.py", "run"])
    with pytest.raises(SystemExit) as end:
        reweigh.main()
    assert end.value.code == 2 and reason in capsys.readouterr().err


def test_reweighed_pairs_weigh_as_much_as_in_training(results_scripts):
    """Weights of all pairs by kind, summed, do not depend on N: counted by hand."""
    import reweigh

    for N in (2, 5, 9):
        is_distractor = torch.zeros(1, N + 5, dtype=torch.bool)
        is_distractor[:, 1:N + 1] = True
        one, two = is_distractor[0], is_distractor[0][:, None]
        weights = reweigh.pair_weights(is_distractor, 2, N)[0]
        with_itself = weights.diagonal()[one].sum()
        assert abs(weights[one & two].sum() - with_itself - 2) < 1e-5      # T (T - 1)
        assert abs(with_itself - 2) < 1e-5                                 # T
        assert abs(weights[one ^ two].sum() - 2 * 2 * 5) < 1e-5            # T x 5 others, two ways
        assert weights[~one & ~two].sum() == 25


def write_run(folder, score, minutes):
    """A run folder with one evaluated N, as figures.py reads it. In training success was 0 for 100
    updates, then `score` for as many."""
    row = {**dict.fromkeys(evaluate.COLUMNS, 0.0), "distractors": 2, "episodes": 100,
           "success_aabb": score, "ci95": 0.03, "solved": score}
    folder.mkdir()
    lines = [",".join(row), ",".join(map(str, row.values()))]
    (folder / "zeroshot.csv").write_text("\n".join(lines) + "\n")
    (folder / "timing.csv").write_text(f"frames,seconds\n6000000,{60 * minutes}\n")
    lines = [f"{u},{4000 * u},{score * (u > 100)}" for u in range(1, 201)]
    (folder / "progress.csv").write_text("\n".join(["update,frames,success_aabb", *lines]) + "\n")
    return str(folder)


def test_table_puts_seeds_together(tmp_path, results_scripts):
    import figures

    lrn = [write_run(tmp_path / f"push-lrn-n2-seed{seed}", score, 30 + seed)
           for seed, score in enumerate((0.9, 0.7, 0.8))]
    mlp = write_run(tmp_path / "push-mlp-n2-seed0", 0.5, 30)
    aligned = figures.table([*lrn, mlp], "success_aabb")
    solved = figures.table([*lrn, mlp], "solved")
    assert aligned[0] == "| axis-aligned | N = 2 |"
    # Student's t with 2 degrees of freedom: 4.303 * 0.1 / sqrt(3)
    assert aligned[2] == "| push-lrn-n2 | 0.80 ± 0.25<br>0.90, 0.70, 0.80 |"
    assert aligned[3] == "| push-mlp-n2 | 0.50 ± 0.03 |"
    two = figures.table(lrn[:2], "success_aabb")
    assert two[2] == "| push-lrn-n2 | 0.80<br>0.90, 0.70 |"
    assert solved[0].startswith("| solved |")
    assert solved[3].endswith("| 0.50 ± 0.10 |")               # 1.96 sqrt(0.5 * 0.5 / 104)
    never = write_run(tmp_path / "push-mlp-n1-seed0", 0.0, 30)
    assert figures.table([never], "solved")[2].endswith("| 0.00 ± 0.03 |")       # p = 2 / 104

    with open(os.path.join(lrn[0], "zeroshot.csv"), "a") as file:        # one of three was played
        file.write(",".join(["9"] + ["0.0"] * (len(evaluate.COLUMNS) - 1)) + "\n")
    assert figures.table(lrn, "success_aabb") == [line for line in aligned if "mlp" not in line]
    assert figures.table(lrn[:1], "success_aabb")[0] == "| axis-aligned | N = 2 | N = 9 |"


def test_a_curve_of_a_short_run_is_its_mean(results_scripts):
    import figures

    rows = {"update": np.arange(1.0, 5.0), "frames": 4000 * np.arange(1.0, 5.0),
            "score": np.array([0.0, 0.2, 0.4, 0.6])}
    frames, means = figures.smooth(rows, "score", window=25)
    assert frames.tolist() == [0.016] and means == pytest.approx([0.3])


def test_a_row_counts_for_each_update_that_it_stands_for(results_scripts):
    """Rows for the updates 1 to 10, 11 to 30, 31 to 35; the last 25 are 6 to 30 and 11 to 35."""
    import figures

    rows = {"update": np.array([10.0, 30.0, 35.0]), "frames": np.array([1e6, 3e6, 3.5e6]),
            "score": np.array([0.0, 0.5, 1.0])}
    frames, means = figures.smooth(rows, "score", window=25)
    assert frames.tolist() == [3.0, 3.5]
    np.testing.assert_allclose(means, [20 * 0.5 / 25, (20 * 0.5 + 5 * 1.0) / 25])


def test_screened_encoders_pool_as_their_formulas_say(results_scripts):
    import screen
    objects, goal = some(2, 6)
    gated, softmax, alone = screen.LRNGated(), screen.LRNSoftmax(), screen.LRNAlone()
    for b in range(2):
        total = torch.zeros(64)
        for r in gated.relations(objects, goal)[b]:
            total += r / (1 + math.exp(-r[0].item()))
        torch.testing.assert_close(gated(objects, goal)[b], gated.norm(gated.f(total)))

        asked = softmax.query.weight @ goal[b] + softmax.query.bias
        relations = softmax.relations(objects, goal)[b]
        weights = [6 ** ((asked @ r).item() / 8) for r in relations]         # e^(log K x) = K^x
        total = sum(w * r for w, r in zip(weights, relations)) / sum(weights)
        torch.testing.assert_close(softmax(objects, goal)[b], softmax.norm(softmax.f(total)),
                                   atol=1e-4, rtol=1e-4)

        total = alone.g(alone.first(goal[b]))
        for o in objects[b]:
            total = total + alone.g(alone.first(o))
        torch.testing.assert_close(alone(objects, goal)[b], alone.norm(alone.f(total)),
                                   atol=1e-4, rtol=1e-4)


def test_a_thrown_cube_is_told_from_a_pushed_one(results_scripts):
    """Four steps of 40 ms, two of them fast, two that end far out (0.13 m), by hand."""
    import thrown

    class Moving:
        substeps, timestep = 5, 0.008
        places = iter([(0.07, 0, 0.03), (0.07, 0.06, 0.03), (0.07, 0.06, 0.04), (0.0, 0.13, 0.03),
                       (0.0, 0.13, 0.03)])
        _moment = SimpleNamespace(position=next(places))

        def step(self, action):
            self._moment = SimpleNamespace(position=next(self.places))
            return None, 0.0, False, False, {"fractional_success": 0.5}

    watched = thrown.Watched(Moving())
    for _ in range(4):
        watched.step(None)
    way = math.sqrt(0.07 ** 2 + 0.07 ** 2 + 0.01 ** 2)
    speed = (0.06 + 0.01 + way) / (4 * 0.04)
    np.testing.assert_allclose(watched.row(), (speed, 2 / 4, 2 / 4, 0.5))


def test_phases_of_an_episode_by_hand(results_scripts):
    """Reached, then raised while one tip is off, then carried to the goal and past it."""
    import phases

    class Lifting:
        goal = ((0.1, 0.0, 0.12), None)
        rho = iter([0.0, 0.0, 0.9, 0.6])
        moments = iter([((0.0, 0.0, 0.03), 0.05), ((0.0, 0.0, 0.06), 0.07),
                        ((0.09, 0.01, 0.12), 0.07), ((0.1, 0.0, 0.15), 0.07)])

        def step(self, action):
            place, away = next(self.moments)
            x, y, z = place
            tips = [(x + 0.05, y, z), (x, y + 0.05, z), (x, y, z + away)]
            self._moment = SimpleNamespace(position=place, tips=tips)
            return None, 0.0, False, False, {"fractional_success": next(self.rho),
                                             "fractional_success_strict": 0.5}

    watched = phases.Watched(Lifting())
    seen = []
    for _ in range(4):
        watched.step(None)
        seen.append([watched.row[name] for name in ("reached", "raised", "above", "placed", "kept",
                                                    "best", "success")])
    assert seen == [[1, 0, 0, 0, 0, 0.0, 0.0], [1, 1, 0, 0, 0, 0.0, 0.0],
                    [1, 1, 1, 1, 1, 0.9, 0.9], [1, 1, 1, 1, 0, 0.9, 0.6]]
    assert watched.row["strict"] == 0.5 and watched.height == 0.12


def test_figure_8_is_the_norm_of_every_kind_of_relation(results_scripts, monkeypatch):
    """Relations of known length stand in for those of the agent: 1, 2, 3, 4, then distractors."""
    import inside

    def record(run, N, episodes, seen):
        assert len(episodes) == 3
        lengths = torch.tensor([1.0, 2.0, 3.0, 4.0] + [10.0 * (i + 1) for i in range(N)])
        r = torch.zeros(2, 3, 4 + N, D)                        # 2 steps, 3 episodes
        r[..., 7] = lengths
        r[1] *= 2
        return r.numpy()

    written = []
    monkeypatch.setattr(inside, "record", record)
    monkeypatch.setattr(inside, "write", lambda *given: written.append(given))
    monkeypatch.setattr(sys, "argv", ["inside.py", "8", "--episodes", "3"])
    inside.main()
    (name, columns, rows), = written
    assert name == "figure8.csv"
    assert columns == ("N", "step", "finger 0", "finger 1", "finger 2", "target", "distractors")
    lengths = {4: (1, 2, 3, 4, 25), 5: (1, 2, 3, 4, 30)}
    assert [(N, step, *map(float, values)) for N, step, *values in rows] == [
        (N, step, *(step * length for length in lengths[N])) for N in (4, 5) for step in (1, 2)]


def test_a_probe_reads_what_z_holds_and_nothing_else(results_scripts):
    """z holds the first place, turned and stretched, and nothing of the second one."""
    import probe

    held, independent = torch.randn(2, 3000, 2)
    z = torch.cat([held @ torch.tensor([[3.0, 1.0], [-1.0, 2.0]]), torch.ones(3000, 1)], dim=1)
    guess = probe.guess_error(independent)
    assert abs(guess - math.sqrt(math.pi / 2)) < 0.1           # mean length of a 2-D normal
    assert probe.reading_error(z, held) < 0.1 * guess
    assert 0.9 * guess < probe.reading_error(z, independent) < 1.3 * guess


def test_a_probe_names_any_cube_of_the_middle_and_another_one_beside_it(results_scripts):
    import probe

    checkpoint = {"task": "push", "settings": train.DEFAULTS}
    states = probe.start_states(checkpoint, 3, 300)
    before = states["goal"].clone()
    obs, named, other = probe.named_at_random(states)
    places = 0.2 * states["cubes"][:, :, 4:6].numpy()          # m
    distance = np.linalg.norm(places, axis=2)
    ids = states["cubes"][:, :, -1]
    taken = 0
    for b in range(300):
        assert (distance[b] < 0.124).sum() >= 2
        assert distance[b, named[b]] < 0.124 and distance[b, other[b]] < 0.124
        assert obs["goal"][b, -1] == ids[b, named[b]] != ids[b, other[b]]
        taken += int(before[b, -1] == obs["goal"][b, -1])      # the target itself
    assert torch.equal(obs["goal"][:, :-1], before[:, :-1])
    assert torch.equal(states["goal"], before)                 # the states stay as they were
    share = (1 / (distance < 0.124).sum(axis=1)).mean()        # by chance
    assert abs(taken / 300 - share) < 4 * math.sqrt(share * (1 - share) / 300)


def test_a_recheck_compares_with_the_file_in_other_episodes(tmp_path, results_scripts,
                                                            monkeypatch, capsys):
    """0.90 +- 0.03 and 0.94 +- 0.04 differ by 0.04, and that by +- 0.05."""
    import recheck

    path = write_run(tmp_path / "push-lrn-n2-seed0", 0.9, 30)
    asked = []

    def play(checkpoint, agent, distractors, episodes, sample_actions):
        asked.extend(episodes)
        return list(episodes)

    monkeypatch.setattr(recheck, "load", lambda run: (None, None))
    monkeypatch.setattr(evaluate, "play", play)
    monkeypatch.setattr(evaluate, "summary",
                        lambda *_: {"success_aabb": 0.94, "ci95": 0.04})
    recheck.compare(path, 2, 60)
    recheck.compare(path, 9, 60)                               # write_run() has N = 2 only
    line, = capsys.readouterr().out.splitlines()
    assert line.endswith("| N = 2 | 0.900 +- 0.030 | 0.940 +- 0.040 | 0.80")
    assert asked == list(range(1000, 1060))


def test_frames_to_a_threshold_are_those_of_a_mean_over_25_updates(tmp_path, results_scripts):
    """Success 0 for 100 updates, then 1: a mean of 25 passes 0.5 with the 13th of the latter."""
    import figures

    runs = [write_run(tmp_path / f"push-lrn-n1-seed{seed}", score, 30)
            for seed, score in enumerate((1.0, 0.7))]
    np.testing.assert_allclose(figures.frames_to(runs, 0.5), 4000 * np.array([113, 118]) / 1e6)
    np.testing.assert_allclose(figures.frames_to(runs, 0.8), [4000 * 120 / 1e6, np.nan])
    assert figures.training_table(runs)[2] == (
        "| push-lrn-n1 | 0, 1 | 6.0, 6.0 | 30, 30 | 1.00, 0.70 | 0.5, 0.5 | 0.5, never |")


def test_every_table_stands_in_the_section_of_its_figure(results_scripts):
    import figures

    places = {
        "push-mlp-n2": "Figure 1",
        "lift-attn-n2": "Figure 3",
        "push-lrn-max-n2": "Figure 3",
        "push-rn-n3": "Figure 4",
        "push-lrn-n2-z100": "Figure 5",
        "push-rn-n2-noreadout": "What we added",
        "push-lrn-n2-paper-25hz": "What we added",
        "push-lrn-n2-paperworld-ppo": "What we added",
        "push-lrn-n2-papercontrol": "What we added",
        "push-attn-n2-noreadout-long": "What we added",
        "lift-lrn-n0": "How far does lifting come",
        "push-lrn-max-n9": "Beyond the paper",
    }
    for group, title in places.items():
        assert figures.section_of(f"results/{group}-seed0") == title, group
    of_figure_5 = {group for lines in figures.ABLATIONS.values() for group in lines}
    for group in of_figure_5 - {"push-lrn-n2"}:
        assert figures.section_of(group) == "Figure 5", group


def test_all_figures_are_drawn(tmp_path):
    done = run("results/figures.py", "9")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (optional)")
    done = run("results/figures.py", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    for number in "1345678":
        assert (tmp_path / f"figure{number}.png").read_bytes().startswith(b"\x89PNG")
    lines = done.stdout.splitlines()
    assert len(lines) == 7 and all(line.startswith("wrote ") for line in lines)


def table_rows(text, head="|"):
    """All rows of the Markdown tables whose first row starts so."""
    tables = re.findall(r"(?:^\|.*\n?)+", text, flags=re.MULTILINE)
    return [row for table in tables if table.startswith(head) for row in table.splitlines()]


def test_tables_of_the_notebook_are_those_of_the_files():
    text = read(os.path.join(HERE, "results", "README.md")).decode()
    notebook = table_rows(text)
    done = run("results/figures.py", "table")
    assert done.returncode == 0, done.stderr
    with open(os.path.join(HERE, "results", "tables.md")) as file:
        assert file.read() == done.stdout
    # The notebook has all but the tables of strict scores and of solved episodes.
    for printed in done.stdout.split("\n\n"):
        if not printed.startswith(("| strict", "| solved")):
            assert set(table_rows(printed)) <= set(notebook)
    for head in ("| in training |", "| axis-aligned |"):       # and no rows of runs that are gone
        assert set(table_rows(text, head)) <= set(table_rows(done.stdout, head))
    searched = run("results/search.py")
    assert searched.returncode == 0, searched.stderr
    assert len(table_rows(searched.stdout)) > 10
    with open(os.path.join(HERE, "results", "search", "README.md")) as file:
        assert set(table_rows(searched.stdout)) <= set(table_rows(file.read()))
    with open(os.path.join(HERE, "results", "screen.csv"), newline="") as file:   # takes too long
        _, *rows = csv.reader(file)
    assert len(rows) == 20 and {"| " + " | ".join(row) + " |" for row in rows} <= set(notebook)


def test_shipped_curves_stand_for_windows_of_updates(results_scripts, monkeypatch):
    """7 updates in at most 3 rows: windows of 3, 3 and 1."""
    import ship

    monkeypatch.setattr(ship, "ROWS", 3)
    rows = [{"update": f"{u}", "frames": f"{10 * u}", "episodes": "4", "success_aabb": f"{u / 10}"}
            for u in range(1, 8)]
    found = [{key: float(value) for key, value in row.items()} for row in ship.thinned(rows)]
    assert found == [{"update": 3, "frames": 30, "episodes": 12, "success_aabb": 0.2},
                     {"update": 6, "frames": 60, "episodes": 12, "success_aabb": 0.5},
                     {"update": 7, "frames": 70, "episodes": 4, "success_aabb": 0.7}]
    assert ship.thinned(rows[:3]) == rows[:3]


def test_a_shipped_run_has_the_same_weights_and_no_optimiser(trained, tmp_path, results_scripts):
    import ship

    ship.ship(trained, str(tmp_path / "shipped"))
    small, agent = train.load(str(tmp_path / "shipped"))
    whole, expected = train.load(trained)
    assert "optimizer" in whole and "optimizer" not in small
    assert small["settings"] == whole["settings"]
    for name, value in expected.state_dict().items():
        assert torch.equal(agent.state_dict()[name], value), name
    sizes = [os.path.getsize(os.path.join(folder, "checkpoint.pt"))
             for folder in (trained, tmp_path / "shipped")]
    assert sizes[1] < 0.5 * sizes[0]
    assert sorted(os.listdir(tmp_path / "shipped")) == ["checkpoint.pt", "progress.csv",
                                                        "timing.csv"]
    assert not agent.training                                  # no dropout in evaluation
    (tmp_path / "shipped" / "zeroshot.csv").touch()
    with pytest.raises(ValueError, match="holds a run already"):
        ship.ship(trained, str(tmp_path / "shipped"))


def test_curves_are_shipped_alone_if_asked_for(trained, tmp_path, results_scripts, monkeypatch,
                                               capsys):
    import ship

    monkeypatch.setattr(sys, "argv", ["ship.py", "--curves", str(tmp_path / "curves"), trained])
    ship.main()
    assert os.listdir(tmp_path / "curves") == ["lrn.csv"]      # `trained` is a folder "lrn"
    assert read_csv(tmp_path / "curves" / "lrn.csv") == read_csv(f"{trained}/progress.csv")
    monkeypatch.setattr(sys, "argv", ["ship.py", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit) as stopped:
        ship.main()
    assert stopped.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def reproduce(*words, cwd=HERE, env=None):
    return subprocess.run(["bash", "results/reproduce.sh", *words], cwd=cwd, capture_output=True,
                          text=True, env=env)


def test_every_shipped_run_has_its_command():
    """reproduce.sh names each run as train.py does, and knows which are done."""
    done = reproduce("--list")
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    names = [name for name, *_ in rows]
    assert len(set(names)) == len(names) >= 80
    for name, *words in rows:
        arguments = words[words.index("--task"):]
        plain, seed = train.read_command(arguments).out.rsplit("-", 1)
        assert name.endswith(f"-{seed}")
        if {"--set", "--frames", "--paper"} & set(arguments):  # a word says what is different
            assert os.path.join("runs", name).startswith(f"{plain}-")
        else:
            assert os.path.join("runs", name) == f"{plain}-{seed}"
        is_shipped = os.path.exists(os.path.join(HERE, "results", name, "zeroshot.csv"))
        assert (words[0] == "done") == is_shipped, name
    shipped = [name for name in os.listdir(os.path.join(HERE, "results")) if "-seed" in name]
    assert shipped and set(shipped) <= set(names)
    for name in shipped:                                       # the present code can play it
        checkpoint, _ = train.load(os.path.join(HERE, "results", name))
        task, encoder = checkpoint["task"], checkpoint["encoder"]
        assert name.startswith(f"{task}-{encoder}-n{checkpoint['distractors']}-")


def test_what_we_added_is_the_success_in_training_of_the_runs(results_scripts):
    import figures

    text = read(os.path.join(HERE, "results", "README.md")).decode()
    rows = [[cell.strip() for cell in row.split("|")[1:-1]]
            for row in table_rows(text, "| without | instead |")]
    *whats, run_column = rows[0]
    assert whats == ["without", "instead", "1 M", "1.6 M", "2 M", "3 M"] and run_column == "run"
    checked = 0
    for *_, at_1, at_16, at_2, at_3, name in rows[2:]:
        if not name.startswith("push-"):                       # a curve of the search alone
            continue
        frames, success = figures.training_success(os.path.join(HERE, "results", name))
        found = [f"{success[frames < millions + 1e-9][-1]:.2f}" for millions in (1, 1.6, 2, 3)]
        assert [at_1, at_16, at_2, at_3] == found, name
        checked += 1
    assert checked >= 15


def test_scores_of_the_readme_are_those_of_the_files():
    rows = table_rows(read(os.path.join(HERE, "README.md")).decode(), "| N |")
    groups = {"PushingCube, LRN": "push-lrn-n2", "PushingCube, LRN-max": "push-lrn-max-n2",
              "PushingCube in the paper's world, LRN": "push-lrn-n2-paperworld-long",
              "LiftingCube, LRN": "lift-lrn-n2"}
    for label, group in groups.items():
        runs = sorted(glob.glob(os.path.join(HERE, "results", f"{group}-seed?", "zeroshot.csv")))
        of_seeds = [{row["distractors"]: row["success_aabb"] for row in read_csv(path)}
                    for path in runs]
        cells = [", ".join(f"{scores[n]:.2f}".removeprefix("0") for scores in of_seeds)
                 for n in (0, 2, 5, 9, 14)]
        assert f"| {label} | {' | '.join(cells)} |" in rows
    assert rows[0] == "| N | 0 | 2 | 5 | 9 | 14 |" and len(rows) == 2 + len(groups)


def test_reproduce_lists_what_a_pattern_names_and_refuses_unknown_options():
    before, after = reproduce("--list", "lift-rn"), reproduce("lift-rn", "--list")
    assert before.stdout == after.stdout and before.stdout.count("\n") == 3
    for words in (["--help"], ["nosuch"], ["--list", "nosuch"], ["push", "lift"], ["--jobs"],
                  ["--jobs", "many"]):
        refused = reproduce(*words)
        assert refused.returncode == 2 and len(refused.stderr.splitlines()) == 1, words
    shipped = reproduce("^lift-rn-n2-seed0$")
    assert shipped.returncode == 0 and "remove results/NAME" in shipped.stdout


@pytest.mark.parametrize("name, arguments, numbers", [
    ("push-mlp-n1-seed0", "--task push --encoder mlp --distractors 1 --seed 0", "1"),
    ("push-rn-n1-seed0", "--task push --encoder rn --distractors 1 --seed 0", "0-9"),
    ("lift-rn-n2-seed1", "--task lift --encoder rn --distractors 2 --seed 1", "0-9,14,19")])
def test_reproduce_trains_evaluates_and_ships_a_run(name, arguments, numbers, tmp_path):
    """Instead of python a script that notes what it is asked for."""
    (tmp_path / "results").mkdir()
    shutil.copy(os.path.join(HERE, "results", "reproduce.sh"), tmp_path / "results")
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho \"$@\" >> calls\n")
    python.chmod(0o755)
    done = reproduce(f"^{name}$", cwd=tmp_path,
                     env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"})
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "calls").read_text().splitlines() == [
        f"train.py {arguments} --ranks 1 --out runs/{name}",
        f"evaluate.py runs/{name} --distractors {numbers} --save",
        f"results/ship.py runs/{name}"]


def test_reproduce_does_not_take_a_run_of_somebody_else_for_its_own(tmp_path):
    """Such as a short trial that train.py put into its default folder."""
    (tmp_path / "results").mkdir()
    shutil.copy(os.path.join(HERE, "results", "reproduce.sh"), tmp_path / "results")
    run_folder = tmp_path / "runs" / "push-lrn-n2-seed0"
    run_folder.mkdir(parents=True)
    (run_folder / "checkpoint.pt").touch()
    (run_folder / "progress.csv").write_text("update,frames\n1,4000\n")
    done = reproduce("push-lrn-n2-seed0", cwd=tmp_path)
    assert done.returncode != 0 and "not begun by this script" in done.stderr
    assert not (tmp_path / "runs" / "push-lrn-n2-seed0.log").exists()


def test_a_recentred_lrn_is_the_same_at_its_n_and_ignores_constant_distractors(results_scripts):
    import recentre

    agent = train.Agent("lrn", 2, train.DEFAULTS)
    encoder = agent.encoder
    torch.nn.init.normal_(encoder.g[5].bias)
    torch.nn.init.normal_(encoder.f.bias)
    objects, goal = some(4, 6)
    copies = objects[:, :1].expand(-1, 3, -1)                  # three more of the first object
    with torch.no_grad():
        before = encoder(objects, goal)
        c = encoder.relations(objects[:1], goal[:1])[0, 0]     # what scene 0's first object adds
        weights = {f"agent.{name}": value for name, value in agent.state_dict().items()}
        recentre.recentre(weights, c, 6)
        same(encoder(objects, goal), before)
        more = encoder(torch.cat([objects, copies], dim=1), goal)
    same(more[0], before[0])
    assert (more[1] - before[1]).abs().max() > 0.1             # there c is not what the first adds


def test_recentring_a_run_is_measured_in_other_episodes_and_overwrites_nothing(
        trained, tmp_path, results_scripts, monkeypatch, capsys):
    """What distractors add is zero on the average afterwards, in the episodes that were played."""
    import recentre

    checkpoint, _ = train.load(trained)
    assert "optimizer" in checkpoint
    checkpoint["distractors"] = 2                              # nothing in an LRN depends on N
    (tmp_path / "run").mkdir()
    train.save(checkpoint, str(tmp_path / "run" / "checkpoint.pt"))
    before = recentre.mean_distractor(str(tmp_path / "run"), 2, 2)
    words = ["recentre.py", str(tmp_path / "run"), str(tmp_path / "out"), "--episodes", "2"]
    monkeypatch.setattr(sys, "argv", words)
    recentre.main()
    assert f"a vector of length {before.norm():.2f}" in capsys.readouterr().out
    # The agent acts as before, so it plays the same episodes.
    after = recentre.mean_distractor(str(tmp_path / "out"), 2, 2)
    assert after.norm() < 1e-3 * before.norm()
    assert "optimizer" not in train.load(str(tmp_path / "out"))[0]
    with pytest.raises(ValueError, match="there already"):
        recentre.write_recentred(str(tmp_path / "run"), str(tmp_path / "out"), 2)

    for change in ({"encoder": "rn"}, {"distractors": 0},
                   {"settings": {**checkpoint["settings"], "layer_norm": False}}):
        other = {**checkpoint, **change}
        agent = train.Agent(other["encoder"], other["distractors"], other["settings"])
        monkeypatch.setattr(recentre, "load", lambda run: (other, agent))
        with pytest.raises(ValueError, match="needs an lrn agent"):
            recentre.write_recentred(trained, str(tmp_path / "none"), 2)


def test_relations_are_told_apart_by_kind(results_scripts):
    """Fingers, target, distractors, whichever cube the target is."""
    import inside

    agent = train.Agent("lrn", 3, train.DEFAULTS)
    env = train.make_env("push", 3, train.DEFAULTS)
    observations, targets = [], []
    for seed in range(6):
        observations.append(env.reset(seed=seed)[0])
        targets.append(env.target)
    env.close()
    assert len(set(targets)) > 1
    obs = as_batch(observations)
    found = inside.relations_of(agent, obs)
    relations = agent.encoder.relations(*agent.tokens(obs))    # cubes, then fingers
    for b, target in enumerate(targets):
        others = [i for i in range(4) if i != target]
        assert torch.equal(found[b], relations[b, [4, 5, 6, target, *others]])


def test_energy_distance_of_a_point_and_of_equal_clouds(results_scripts):
    import inside

    # b is {0, 1}: E|a - b| = 1/2, E|b - b'| = 1/2, so (1 - 0 - 1/2) / (1/2)
    assert inside.energy_distance(np.zeros((1, 1)), np.array([[0.0], [1.0]])) == pytest.approx(1)
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    assert inside.energy_distance(cloud, cloud[::-1].copy()) == pytest.approx(0, abs=1e-6)


# ---------------------------------------------------------------- every module

ALONE = ["lrn.py", "rn.py", "attn.py", "ppo.py", "trifinger_env.py"]


@pytest.fixture(scope="module")
def modules_alone(tmp_path_factory):
    """Each of ALONE, started in a folder that holds nothing else, all side by side."""
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}        # several fight over busy cores
    folders = {name: tmp_path_factory.mktemp("alone") for name in ALONE}
    for name, folder in folders.items():
        shutil.copy(os.path.join(HERE, name), folder)
    return {name: (folder, start_process(name, cwd=folder, env=one_thread))
            for name, folder in folders.items()}


@pytest.mark.parametrize("name", ALONE)
def test_module_works_alone_in_an_empty_folder(name, modules_alone):
    folder, process = modules_alone[name]
    printed, errors = process.communicate(timeout=300)
    assert process.returncode == 0 and len(printed.splitlines()) >= 3, errors
    assert sorted(os.listdir(folder)) in ([name], ["__pycache__", name])


def test_importing_prints_nothing():
    done = run("-c", "import " + ", ".join(name[:-3] for name in ALONE))
    assert done.returncode == 0 and not done.stdout, done


# ---------------------------------------------------------------- planted defects

# file: ((source that occurs once, what it becomes, test that must fail) ...)
MUTATIONS = {
    "lrn.py": (
        ("self.norm(self.f(", "(self.f(", "test_lrn_equals_the_loop_over_objects"),
        ("total = r.sum(dim=1)", "total = r.mean(dim=1)", "test_lrn_equals_the_loop_over_objects"),
        ("from_objects + from_goal[:, None]", "from_objects - from_goal[:, None]",
         "test_lrn_equals_the_loop_over_objects"),
        ("linear(goal, W_goal, self.first.bias)", "linear(goal, W_goal)",
         "test_lrn_equals_the_loop_over_objects"),
        ("return total / r.shape[1]", "return total", "test_ablations_of_lrn_equal_their_formulas"),
        ("nn.LayerNorm(Z) if layer_norm else nn.Identity()", "nn.LayerNorm(Z)",
         "test_ablations_of_lrn_equal_their_formulas"),
        (".clamp(min=1)", "", "test_a_mean_over_no_object_at_all_is_zero"),
        ("r = r.masked_fill(~present[..., None], 0.0)",
         "r = r.masked_fill(present[..., None], 0.0)",
         "test_encoder_ignores_order_and_padding_and_serves_any_number"),
        ("objects = objects.masked_fill(~present[..., None], 0.0)", "pass",
         "test_padding_has_no_part_in_the_gradient"),
        ("masked_fill(~present[..., None], -math.inf)", "masked_fill(~present[..., None], 0.0)",
         "test_padding_may_differ_between_the_samples_of_a_batch"),
        ("r.amax(dim=1)", "r.amin(dim=1)",
         "test_lrn_with_a_maximum_equals_the_loop_and_counts_copies_once"),
        ("if goal.shape != (B, D):", "if goal.shape[-1] != D:",
         "test_wrong_shapes_are_refused_and_the_right_one_is_named"),
        ("present.dtype != torch.bool", "False",
         "test_wrong_shapes_are_refused_and_the_right_one_is_named"),
        ("gain=math.sqrt(2)", "gain=1.0", "test_weights_start_orthogonal"),
    ),
    "rn.py": (
        ("r.sum(dim=(1, 2))", "r.sum(dim=(1, 2)) - r.diagonal(0, 1, 2).sum(-1)",
         "test_rn_equals_the_double_loop_over_pairs"),
        ("linear(tokens, W_2, self.first.bias)", "linear(tokens, W_1, self.first.bias)",
         "test_rn_equals_the_double_loop_over_pairs"),
        ("objects = objects.masked_fill(~present[..., None], 0.0)", "pass",
         "test_padding_has_no_part_in_the_gradient"),
        ("real[:, :, None] & real[:, None]", "real[:, :, None] | real[:, None]",
         "test_padding_may_differ_between_the_samples_of_a_batch"),
        ("self.norm(self.f(", "(self.f(", "test_rn_equals_the_double_loop_over_pairs"),
    ),
    "attn.py": (
        ("objects = objects.masked_fill(~present[..., None], 0.0)", "pass",
         "test_encoder_ignores_order_and_padding_and_serves_any_number"),
        (" / math.sqrt(q.shape[-1])", "", "test_attention_equals_torch_multihead_attention"),
        ("score.softmax(dim=-1)", "score.softmax(dim=-2)",
         "test_attention_equals_torch_multihead_attention"),
        ("total = attended.sum(dim=1)", "total = attended[:, :-1].sum(dim=1)",
         "test_attention_equals_torch_multihead_attention"),
        ("masked_fill(~real[:, None, None], -math.inf)", "masked_fill(~real[:, None, None], 0.0)",
         "test_padding_may_differ_between_the_samples_of_a_batch"),
        ("attended = attended.masked_fill(~real[..., None], 0.0)", "pass",
         "test_padding_may_differ_between_the_samples_of_a_batch"),
    ),
    "ppo.py": (
        # Advantages
        ("discount * (1 - terminated[t])", "discount * (1 - is_last[t])",
         "test_gae_against_a_hand_computed_table"),
        ("discount * (1 - terminated[t])", "discount", "test_gae_against_a_hand_computed_table"),
        ("lam * (1 - is_last[t])", "lam * (1 - terminated[t])",
         "test_gae_against_a_hand_computed_table"),
        ("discount * lam * (1 - is_last[t])", "lam * (1 - is_last[t])",
         "test_gae_is_the_discounted_sum_of_td_errors"),
        ("discount * lam * (1 - is_last[t])", "discount * (1 - is_last[t])",
         "test_gae_is_the_discounted_sum_of_td_errors"),
        ("self.discount, self.lam)", "self.lam, self.discount)",
         "test_rollout_stores_what_happened"),
        ("values.roll(-1, dims=0)", "values.clone()", "test_rollout_stores_what_happened"),
        ("if ended or t == T - 1:", "if ended:", "test_rollout_stores_what_happened"),
        ("ended = terminated or truncated", "ended = terminated",
         "test_rollout_stores_what_happened"),
        ("total[e] = length[e] = 0", "total[e] = 0", "test_rollout_stores_what_happened"),
        ("current[e], _ = self.envs[e].reset()", "pass", "test_rollout_stores_what_happened"),
        ("env.reset(seed=seed)[0] for", "env.reset(seed=seeds[0])[0] for",
         "test_rollout_starts_every_environment_from_its_seed"),
        ("mean + noise[t]", "mean + noise[0]",
         "test_rollout_samples_the_policy_and_stores_its_density"),
        ("torch.randn(T, *mean.shape) * log_std.exp()", "torch.randn(T, *mean.shape)",
         "test_rollout_samples_the_policy_and_stores_its_density"),
        ("0.5 * scaled ** 2 - log_std", "0.5 * scaled ** 2 + log_std",
         "test_log_prob_against_torch_distributions"),
        ("(returns - values).var() / returns.var()", "(returns - values).var() / values.var()",
         "test_explained_variance_by_hand"),
        # Normalisation
        ("next_values = next_values * self.return_std() + self.return_mean",
         "next_values = next_values * 1.0",
         "test_values_are_learned_in_units_of_their_running_moments"),
        ("            values = values * self.return_std() + self.return_mean",
         "            values = values * self.return_std()",
         "test_values_are_learned_in_units_of_their_running_moments"),
        ("variance = self.return_square - self.return_mean ** 2", "variance = self.return_square",
         "test_running_moments_are_the_plain_mean_at_first_and_slow_after_100_batches"),
        ("max(1 / self.return_batches.item(), 0.01)", "0.01",
         "test_running_moments_are_the_plain_mean_at_first_and_slow_after_100_batches"),
        ("max(1 / self.return_batches.item(), 0.01)", "1 / self.return_batches.item()",
         "test_running_moments_are_the_plain_mean_at_first_and_slow_after_100_batches"),
        ("(returns - self.return_mean) / self.return_std()", "returns / self.return_std()",
         "test_running_moments_are_the_plain_mean_at_first_and_slow_after_100_batches"),
        ("(advantage_square - advantage_mean ** 2)", "advantage_square",
         "test_advantages_are_normalized_over_the_batch"),
        ("(advantages - advantage_mean) / (std + 1e-8)", "advantages / (std + 1e-8)",
         "test_advantages_are_normalized_over_the_batch"),
        ("        if self.normalize_advantages:", "        if True:",
         "test_normalization_can_be_switched_off"),
        # The loss
        ("ratio.clamp(1 - clip, 1 + clip)", "ratio.clamp(1 - clip, 1 + 3 * clip)",
         "test_loss_by_hand"),
        ("ratio.clamp(1 - clip, 1 + clip)", "ratio.clamp(1 - 3 * clip, 1 + clip)",
         "test_loss_by_hand"),
        ("torch.min(ratio * advantages", "torch.max(ratio * advantages", "test_loss_by_hand"),
        ("0.5 * (value - returns)", "(value - returns)", "test_loss_by_hand"),
        ("- self.entropy_coef * entropy", "+ self.entropy_coef * entropy", "test_loss_by_hand"),
        ("self.value_coef * value_loss", "0.5 * value_loss", "test_loss_by_hand"),
        ("loss + self.auxiliary_coef * auxiliary_loss", "loss + auxiliary_loss",
         "test_loss_by_hand"),
        ("((ratio - 1) - log_ratio).mean()", "(-log_ratio).mean()", "test_loss_by_hand"),
        ("(value - returns).square()", "(value.detach() - returns).square()",
         "test_gradient_of_the_loss_against_finite_differences"),
        ("if self.auxiliary_coef:", "if True:",
         "test_an_auxiliary_loss_without_weight_is_never_asked_for"),
        # The step
        ("remaining ** self.lr_power", "remaining",
         "test_learning_rate_and_clip_range_shrink_with_the_training_that_is_left"),
        ("clip = self.clip * remaining if self.anneal_clip else self.clip",
         "clip = self.clip",
         "test_learning_rate_and_clip_range_shrink_with_the_training_that_is_left"),
        ("clip = self.clip * remaining if self.anneal_clip else self.clip",
         "clip = self.clip * remaining",
         "test_learning_rate_and_clip_range_shrink_with_the_training_that_is_left"),
        ("torch.randperm(count)", "torch.arange(count)",
         "test_every_sample_is_used_once_in_every_epoch"),
        ("range(self.epochs)", "range(1)", "test_every_sample_is_used_once_in_every_epoch"),
        ("        gradient.zero_()\n", "",
         "test_update_on_one_vector_of_weights_equals_torch_layer_by_layer"),
        ("(self.max_grad_norm / (norm + 1e-6))", "(0.5 / (norm + 1e-6))",
         "test_update_on_one_vector_of_weights_equals_torch_layer_by_layer"),
        ("(norm + 1e-6)).clamp(max=1.0)", "(norm + 1e-6))",
         "test_update_on_one_vector_of_weights_equals_torch_layer_by_layer"),
        ("eps=adam_eps", "eps=1e-5",
         "test_update_on_one_vector_of_weights_equals_torch_layer_by_layer"),
        ("        if not torch.isfinite(norm):", "        if False:",
         "test_ppo_refuses_a_gradient_that_is_not_finite_and_keeps_the_weights"),
        # Several ranks
        ("        dist.all_reduce(tensor)\n", "",
         "test_two_ranks_give_the_gradient_of_one_on_the_joined_batch"),
        ("        tensor /= dist.get_world_size()\n", "",
         "test_two_ranks_give_the_gradient_of_one_on_the_joined_batch"),
        ("moments = rank_mean(torch.stack([", "moments = (torch.stack([",
         "test_two_ranks_give_the_gradient_of_one_on_the_joined_batch"),
        ("np.array(value, np.float32)", "value",
         "test_an_environment_may_reuse_its_array_of_any_type"),
    ),
    "trifinger_env.py": (
        # The world
        ("CUBE_FRICTION, FLOOR_FRICTION = 1.0, 0.5", "CUBE_FRICTION, FLOOR_FRICTION = 0.7, 0.5",
         "test_friction_of_a_cube_on_the_floor"),
        ("CUBE_FRICTION, FLOOR_FRICTION = 1.0, 0.5", "CUBE_FRICTION, FLOOR_FRICTION = 1.0, 0.6",
         "test_friction_of_a_cube_on_the_floor"),
        ("lateralFriction=self.finger_friction", "lateralFriction=1.0",
         "test_mass_and_friction_are_those_asked_for"),
        ("finger_friction=1.0", "finger_friction=0.5",
         "test_mass_and_friction_are_those_asked_for"),
        ("if not 0 <= goal_yaw < math.inf:", "if goal_yaw < 0:", "test_bad_arguments_are_refused"),
        ("self._body(self.cube_mass, shape", "self._body(0.08, shape",
         "test_mass_and_friction_are_those_asked_for"),
        ("cube_mass=0.08", "cube_mass=0.02", "test_mass_and_friction_are_those_asked_for"),
        ("flags = pb.URDF_USE_INERTIA_FROM_FILE", "flags = 0",
         "test_masses_and_limits_are_those_of_trifinger_edu"),
        ("JOINT_HIGH = (1.0, 1.57, 3.0)", "JOINT_HIGH = (1.0, 1.57, 2.7)",
         "test_masses_and_limits_are_those_of_trifinger_edu"),
        ("setGravity(0, 0, -9.81", "setGravity(0, 0, -9.0",
         "test_a_cube_falls_by_gravity_for_the_time_of_a_step"),
        ("fixedTimeStep=self.timestep", "fixedTimeStep=0.008",
         "test_a_cube_falls_by_gravity_for_the_time_of_a_step"),
        ("range(self.substeps)", "range(5)", "test_a_cube_falls_by_gravity_for_the_time_of_a_step"),
        ("WALL = 0.242", "WALL = 0.23", "test_the_wall_is_closed_and_stands_at_its_radius"),
        ("for side in range(WALL_SIDES)", "for side in range(WALL_SIDES - 1)",
         "test_the_wall_is_closed_and_stands_at_its_radius"),
        ("TORQUE = 0.36", "TORQUE = 0.72", "test_fingers_push_with_at_most_their_torque"),
        # The robot
        ("math.sin(q1) + math.sin(q1 + q2)", "math.sin(q1) + math.sin(q2)",
         "test_kinematics_against_pybullet"),
        ("BASE = 0.0455", "BASE = 0.04", "test_kinematics_by_hand"),
        ("HEIGHT = 0.34", "HEIGHT = 0.30", "test_kinematics_by_hand"),
        ("90 + 120 * k", "90 + 110 * k", "test_kinematics_by_hand"),
        ("math.atan2(-x, -depth) - q2 / 2", "math.atan2(-x, -depth) - q2",
         "test_inverse_kinematics_undoes_the_forward_ones"),
        ("bar((BASE, 0, 0), (0, 0, 0), 0.018, METAL)", "bar((0, BASE, 0), (0, 0, 0), 0.018, METAL)",
         "test_the_robots_drawn_parts_are_joined_from_the_mount_to_the_tip"),
        ("bar((0, 0, 0), knee, 0.013, METAL)", "bar((0, 0, -0.05), knee, 0.013, METAL)",
         "test_the_robots_drawn_parts_are_joined_from_the_mount_to_the_tip"),
        # Fractional success
        ("abs(x * y - z * w) + abs(x * z + y * w)", "abs(x * y + z * w) + abs(x * z + y * w)",
         "test_overlap_against_monte_carlo_volumes"),
        ("/ (2 * half_goal)", "/ (2 * half_cube)", "test_overlap_against_monte_carlo_volumes"),
        ("beyond_p / (beyond_p - beyond_q)", "beyond_q / (beyond_q - beyond_p)",
         "test_overlap_against_monte_carlo_volumes"),
        ("strict = oriented_overlap(", "strict = aabb_overlap(",
         "test_success_is_measured_on_the_target_and_strictly_at_the_end"),
        ("pose = self._poses[self.target]", "pose = self._poses[0]",
         "test_success_is_measured_on_the_target_and_strictly_at_the_end"),
        # The start of an episode
        ("np.sqrt(u[:, 0])", "u[:, 0]",
         "test_candidates_are_uniform_by_area_and_in_every_direction"),
        ("2 * math.pi * u[:, 1]", "math.pi * u[:, 1]",
         "test_candidates_are_uniform_by_area_and_in_every_direction"),
        ("(2 * u[:, 2] - 1) * yaw", "u[:, 2] * yaw",
         "test_candidates_are_uniform_by_area_and_in_every_direction"),
        ("GRASP_RADIUS = 0.124", "GRASP_RADIUS = 0.11",
         "test_goals_are_uniform_where_a_finger_can_get_behind_them"),
        ("(placed, GRASP_RADIUS, self.goal_yaw)", "(placed, WALL, self.goal_yaw)",
         "test_goals_are_uniform_where_a_finger_can_get_behind_them"),
        ("(placed, WALL, math.pi / 4)", "(placed, GRASP_RADIUS, math.pi / 4)",
         "test_distractors_lie_anywhere_in_the_arena"),
        ("(placed, GRASP_RADIUS, math.pi / 4)", "(placed, GRASP_RADIUS, self.goal_yaw)",
         "test_targets_start_where_goals_lie_and_are_turned"),
        ("(placed, GRASP_RADIUS, self.goal_yaw)", "(placed, GRASP_RADIUS, 0.0)",
         "test_goals_are_turned_as_much_as_asked_for"),
        ("uniform(CUBE / 2, HIGHEST_GOAL)", "uniform(CUBE / 2, 0.15)",
         "test_lifting_goals_reach_up_to_20_cm"),
        ("corners_inside(new) & ~squares_overlap(new, placed).any(1)", "corners_inside(new)",
         "test_nothing_overlaps_at_the_start"),
        ("corners_inside(new) & ~squares_overlap(new, placed).any(1)",
         "~squares_overlap(new, placed).any(1)", "test_nothing_overlaps_at_the_start"),
        ("own + other * widening", "own + other", "test_nothing_overlaps_at_the_start"),
        ("int(self._np_random.integers(count))", "0",
         "test_the_goal_names_the_target_and_no_other_cube"),
        ("replace=False", "replace=True", "test_the_goal_names_the_target_and_no_other_cube"),
        ("identifier = self._ids[self.target]", "identifier = self._ids[0]",
         "test_the_goal_names_the_target_and_no_other_cube"),
        (".insert(self.target, target_pose)", ".insert(0, target_pose)",
         "test_the_goal_names_the_target_and_no_other_cube"),
        ("np.linspace(-1.0, 1.0, 21)", "np.arange(21.0)",
         "test_the_goal_names_the_target_and_no_other_cube"),
        ("REST[j], 0.0,", "REST[j], 0.1,", "test_every_episode_starts_at_rest"),
        ("self._joint_targets = list(REST * 3)",
         "self._joint_targets = getattr(self, \"_joint_targets\", REST * 3)",
         "test_actions_ask_for_the_angles_they_should"),
        ("if seed is not None or self._steps is None:", "if self._steps is None:",
         "test_same_seed_same_trajectory_bit_for_bit"),
        # Observation and action
        ("*linear, *angular, identifier", "*angular, *linear, identifier",
         "test_observation_is_table_1"),
        ("if qw < 0:", "if False:", "test_observation_is_table_1"),
        ("*dq[:3], -1.0, *a,", "*dq[:3], 0.0, *a,", "test_observation_is_table_1"),
        (" * self._scale", "", "test_observation_is_table_1"),
        ("POSITION_SCALE = 0.2 ", "POSITION_SCALE = 0.3 ",
         "test_observation_is_table_1"),
        ("[0.5] * 3 + [10] * 3 + [1]", "[10] * 3 + [0.5] * 3 + [1]",
         "test_observation_is_table_1"),
        ("LINEAR, ANGULAR = slice(11, 14), slice(14, 17)",
         "ANGULAR, LINEAR = slice(11, 14), slice(14, 17)",
         "test_columns_are_picked_out_by_their_names"),
        ("fingertips(self._joint_targets) if is_integrated", "self._moment.tips if is_integrated",
         "test_fingertips_are_seen_where_they_are_told_to_be_if_targets_stay"),
        ("is_integrated = self.action_mode == \"integrated\"", "is_integrated = True",
         "test_fingertips_are_seen_where_they_are_told_to_be_if_targets_stay"),
        ("LEAD = 0.25 ", "LEAD = 0.35 ", "test_actions_ask_for_the_angles_they_should"),
        ("action_scale=0.1", "action_scale=0.2", "test_actions_ask_for_the_angles_they_should"),
        ("zip(self._joint_targets, action)", "zip(self._q, action)",
         "test_actions_ask_for_the_angles_they_should"),
        ("q + scale * a for", "scale * a for", "test_actions_ask_for_the_angles_they_should"),
        ("low + (high - low) * (a + 1) / 2", "low + (high - low) * a",
         "test_actions_ask_for_the_angles_they_should"),
        ("return clip(targets, JOINT_LOW * 3, JOINT_HIGH * 3)", "return targets",
         "test_actions_ask_for_the_angles_they_should"),
        ("return clip(numbers, (-1.0,) * 9, (1.0,) * 9)", "return numbers",
         "test_actions_beyond_their_range_count_as_its_ends"),
        # Reward
        ("(before.to_goal - now.to_goal)", "(now.to_goal - before.to_goal)",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("before, self._moment = self._moment, self._measure()",
         "before = self._measure()\n        self._moment = before",
         "test_moments_of_consecutive_steps_follow_each_other"),
        ("weights[\"overlap\"] * now.rho", "weights[\"overlap\"] * before.rho",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("BETA = 0.05 ", "BETA = 0.5 ",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("math.log(moved + 1e-5)", "math.log(moved + 1e-3)",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("(before.to_tips - now.to_tips)", "(now.to_tips - before.to_tips)",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("math.hypot(math.dist(a, position), math.dist(b, position),",
         "math.hypot(math.dist(a, position), math.dist(a, position),",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("\"distance\": 5000.0", "\"distance\": 250.0",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("\"curiosity\": 0.0", "\"curiosity\": 10.0",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("\"reach\": 2500.0", "\"reach\": 250.0",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        ("{**REWARD_WEIGHTS, **(reward_weights or {})}", "{**REWARD_WEIGHTS}",
         "test_reward_terms_add_up_and_follow_their_formulas"),
        # The end of an episode
        ("self._steps >= self.episode_steps", "self._steps > self.episode_steps",
         "test_episode_ends_after_its_steps"),
        ("OUTSIDE, BELOW, ABOVE = WALL + 0.03", "OUTSIDE, BELOW, ABOVE = WALL + 0.3",
         "test_a_cube_beyond_the_arena_ends_the_episode"),
        ("BELOW < z < ABOVE", "BELOW < z", "test_a_cube_beyond_the_arena_ends_the_episode"),
        ("math.isfinite(sum(rows)) and", "True and",
         "test_diverged_physics_end_the_episode_and_the_next_one_is_sound"),
        ("episode_steps=125", "episode_steps=250",
         "test_the_environment_alone_is_the_one_of_a_run_with_default_settings"),
        # Pictures
        ("if i == self.target else", "if i == 0 else",
         "test_picture_shows_target_goal_and_distractors_in_their_colours"),
        ("beyond_p <= 0 < beyond_q or beyond_q <= 0 < beyond_p",
         "beyond_p < 0 < beyond_q or beyond_q < 0 < beyond_p",
         "test_overlap_against_hand_computed_cases"),
        ("not isinstance(count, (int, np.integer)) or count < 1", "count < 1",
         "test_bad_arguments_are_refused"),
    ),
    "train.py": (
        # Files
        ("self.update, self.seconds = checkpoint[\"update\"], checkpoint[\"seconds\"]",
         "self.update = checkpoint[\"update\"]",
         "test_a_stop_in_the_middle_of_an_update_goes_back_to_its_beginning"),
        ("TIMING, self.update)", "TIMING, 9 ** 9)",
         "test_stopped_killed_and_resumed_equals_never_stopped"),
        ("mlp(width, 2 * hidden, 2 * hidden, z_dim)", "mlp(width, z_dim)",
         "test_mlp_agent_sees_everything_and_has_a_fixed_input"),
        ("return checkpoint, agent.eval()", "return checkpoint, agent",
         "test_a_shipped_run_has_the_same_weights_and_no_optimiser"),
        ("len(os.sched_getaffinity(0))", "os.cpu_count()",
         "test_as_many_ranks_as_cores_and_batch_allow"),
        ("nargs=\"+\", action=\"extend\", default=[]", "nargs=\"+\", default=[]",
         "test_set_may_be_given_twice"),
        ("SIG_IGN)               # the others inherit it", "SIG_DFL)",
         "test_ctrl_c_before_the_first_update_ends_both_ranks"),
        ("        sys.exit(STOPPED)", "        return",
         "test_a_stop_in_the_middle_of_an_update_goes_back_to_its_beginning"),
        ("if isinstance(error.__context__, KeyboardInterrupt):", "if False:",
         "test_a_stop_in_the_middle_of_a_checkpoint_stays_a_stop"),
        # The agent
        ("*layers[:-1]", "*layers", "test_mlps_are_orthogonal_and_end_in_a_linear_layer"),
        ("+ [last_gain]", "+ [1.0]",
         "test_mlps_are_orthogonal_and_end_in_a_linear_layer"),
        ("last_gain=0.01", "last_gain=1.0",
         "test_heads_start_small_so_that_the_first_policy_is_near_zero"),
        ("torch.cat([cubes, fingers], dim=1), self.goal(obs[\"goal\"])",
         "cubes, self.goal(obs[\"goal\"])",
         "test_agent_is_an_mlp_per_type_an_encoder_and_two_heads"),
        ("torch.full((9,), settings[\"log_std\"])", "torch.zeros(9)",
         "test_agent_is_an_mlp_per_type_an_encoder_and_two_heads"),
        ("\"z_dim\", \"relations\", \"layer_norm\")", "\"z_dim\")",
         "test_settings_of_one_encoder_reach_it"),
        ("mlp(Z, hidden, hidden, 9, last_gain=0.01)", "mlp(Z, 128, 128, 9, last_gain=0.01)",
         "test_settings_of_one_encoder_reach_it"),
        # The read-out loss
        ("identifiers = POOL[shuffled[:, :count]]",
         "identifiers = POOL[shuffled[:, :1].expand(-1, count)]",
         "test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers"),
        ("cubes[..., IDENTIFIER] = identifiers", "identifiers = cubes[..., IDENTIFIER]",
         "test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers"),
        ("torch.randint(count, (B,))", "torch.zeros(B, dtype=torch.long)",
         "test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers"),
        ("identifiers[rows, target]", "identifiers[:, 0]",
         "test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers"),
        ("goal[torch.randperm(B)]", "goal.clone()",
         "test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers"),
        ("meant = cubes[rows, target]", "meant = cubes[:, 0]",
         "test_read_out_loss_is_the_mean_squared_error_of_the_facts"),
        ("meant[:, LINEAR]", "meant[:, 14:17]",
         "test_read_out_loss_is_the_mean_squared_error_of_the_facts"),
        ("meant[:, LINEAR], goal[:, POSITION]", "meant[:, LINEAR], obs[\"goal\"][:, POSITION]",
         "test_read_out_loss_is_the_mean_squared_error_of_the_facts"),
        ("(self.read_out(z) - facts).square()", "(self.read_out(z) - facts).abs()",
         "test_read_out_loss_is_the_mean_squared_error_of_the_facts"),
        ("z = self.encode({\"cubes\": cubes,", "z = self.encode({\"cubes\": obs[\"cubes\"],",
         "test_read_out_loss_asks_about_fresh_goals_targets_and_identifiers"),
        # What ranks draw
        ("SeedSequence(numbers)", "SeedSequence(sum(numbers))",
         "test_derived_seeds_do_not_repeat_where_sums_would"),
        ("NOISE_STREAM + rank", "NOISE_STREAM",
         "test_every_rank_draws_other_episodes_and_other_noise"),
        ("NOISE_STREAM = 10 ** 6", "NOISE_STREAM = 0",
         "test_every_rank_draws_other_episodes_and_other_noise"),
        ("rank * count + e", "e", "test_every_rank_draws_other_episodes_and_other_noise"),
        ("reseed(run.args.seed, run.update, rank,", "reseed(run.args.seed, run.update, 0,",
         "test_first_row_of_two_ranks_is_about_the_episodes_of_both"),
        ("reseed(run.args.seed, run.update, rank,", "reseed(run.args.seed, 0, rank,",
         "test_every_update_plays_other_episodes_and_is_told_how_much_is_left"),
        ("reseed(run.args.seed, run.update, rank,", "reseed(0, run.update, rank,",
         "test_every_update_plays_other_episodes_and_is_told_how_much_is_left"),
        ("        dist.all_reduce(sums)\n", "        pass\n",
         "test_first_row_of_two_ranks_is_about_the_episodes_of_both"),
        ("torch.manual_seed(args.seed)", "torch.manual_seed(0)",
         "test_first_weights_depend_on_the_seed_alone"),
        # The run
        ("remaining=1 - run.update / run.last_update", "remaining=1.0",
         "test_every_update_plays_other_episodes_and_is_told_how_much_is_left"),
        ("math.ceil(settings[\"frames\"] / self.frames_per_update)",
         "settings[\"frames\"] // self.frames_per_update",
         "test_every_update_plays_other_episodes_and_is_told_how_much_is_left"),
        ("range(settings[\"envs\"] // args.ranks)", "range(settings[\"envs\"])",
         "test_every_setting_reaches_the_learner_and_its_environments"),
        ("\"cube_mass\", \"finger_friction\", \"goal_yaw\")", "\"cube_mass\", \"goal_yaw\")",
         "test_every_setting_reaches_the_learner_and_its_environments"),
        ("\"lr_power\", \"anneal_clip\",\n", "\"lr_power\",\n",
         "test_every_setting_reaches_the_learner_and_its_environments"),
        ("reward_weights=weights", "reward_weights=None",
         "test_every_setting_reaches_the_learner_and_its_environments"),
        ("setting.paper if args.paper else setting.default", "setting.default",
         "test_paper_sets_the_numbers_of_the_paper_and_of_its_sources"),
        ("if args.task == \"lift\" and not args.paper:", "if args.task == \"lift\":",
         "test_lifting_has_frames_schedule_and_noise_of_its_own"),
        ("\"lr_power\": 2.0, \"log_std\": -1.0}", "\"lr_power\": 2.0}",
         "test_lifting_has_frames_schedule_and_noise_of_its_own"),
        ("\"clip\": Setting(0.2, 0.5,", "\"clip\": Setting(0.2, 0.2,",
         "test_paper_sets_the_numbers_of_the_paper_and_of_its_sources"),
        ("        refuse_if_without_effect(name, args.encoder)\n", "",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("if value < 0 and not may_be_negative:", "if False:",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("abs(value) > 20 and name", "abs(value) > 200 and name",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("if value > 1 and name in (\"discount\", \"lam\"):", "if False:",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("if not 0 <= number < math.inf:", "if number < 0:",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("envs * settings[\"steps\"] % settings[\"minibatches\"] == 0", "True",
         "test_as_many_ranks_as_cores_and_batch_allow"),
        ("[\"fractional_success\"] >= SOLVED", "[\"fractional_success\"] > SOLVED",
         "test_columns_about_episodes_by_hand"),
        ("[\"truncated_by\"] != TIME]", "[\"truncated_by\"] == TIME]",
         "test_columns_about_episodes_by_hand"),
        ("self.args.save_minutes * 60", "self.args.save_minutes * 6",
         "test_a_checkpoint_is_due_after_its_minutes"),
        ("        run.save(before)\n", "        run.save(run.checkpoint())\n",
         "test_a_stop_in_the_middle_of_an_update_goes_back_to_its_beginning"),
        ("copy.deepcopy(run.checkpoint())\n    except", "run.checkpoint()\n    except",
         "test_a_stop_in_the_middle_of_an_update_goes_back_to_its_beginning"),
        ("            other.kill()\n", "            pass\n",
         "test_a_stop_does_not_wait_for_a_long_update"),
        # Files
        ("        self.learner.optimizer.load_state_dict(checkpoint[\"optimizer\"])\n", "",
         "test_stopped_killed_and_resumed_equals_never_stopped"),
        ("os.remove(self.path(name))", "pass",
         "test_stopped_killed_and_resumed_equals_never_stopped"),
        ("for name in (\"zeroshot.csv\", \"zeroshot-sampled.csv\"):", "for name in ():",
         "test_scores_go_when_the_weights_they_are_of_are_replaced"),
        ("        self.saved_update = self.update\n", "",
         "test_a_stop_before_anything_was_learned_keeps_the_scores"),
        ("is_whole and int(row[0]) <= update", "is_whole",
         "test_resume_drops_rows_after_the_checkpoint_and_torn_lines"),
        ("{**DEFAULTS, **checkpoint[\"settings\"]}", "checkpoint[\"settings\"]",
         "test_a_checkpoint_that_lacks_a_setting_takes_the_default"),
        ("weights_only=True", "weights_only=False",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("    return int(os.environ[\"RANK\"]) if ranks > 1 else 0",
         "    return int(os.environ.get(\"RANK\", 0))",
         "test_variables_of_another_launcher_are_not_torchruns"),
        ("    if dist.is_torchelastic_launched():", "    if \"WORLD_SIZE\" in os.environ:",
         "test_variables_of_another_launcher_are_not_torchruns"),
        ("            sys.exit(1)", "            pass",
         "test_of_two_ranks_one_says_that_a_gradient_is_not_finite"),
    ),
    "evaluate.py": (
        ("blocked=blocked[e]", "blocked=False",
         "test_an_episode_that_ends_for_another_reason_is_cut_short"),
        ("args.distractors or \"0-9\"", "args.distractors or \"0-8\"",
         "test_commands_without_options_mean_what_the_readme_says"),
        ("        print(\"the window was closed\")", "        raise",
         "test_closing_the_window_ends_watching"),
        ("play_all(folder, numbers,", "play_all(run, numbers,",
         "test_a_run_that_trains_on_meanwhile_does_not_change_what_is_evaluated"),
        ("derived_seed(EVALUATION, episode, STARTS)", "derived_seed(EVALUATION, 0, STARTS)",
         "test_evaluation_starts_belong_to_no_training_run"),
        ("EVALUATION = 20220131", "EVALUATION = 0",
         "test_evaluation_starts_belong_to_no_training_run"),
        ("    if generators is None:\n", "    if False:\n",
         "test_play_equals_a_plain_loop_over_episodes"),
        ("std = log_std.exp().numpy()", "std = log_std.numpy()",
         "test_play_equals_a_plain_loop_over_episodes"),
        ("derived_seed(EVALUATION, episode, NOISE)", "derived_seed(EVALUATION, 0, NOISE)",
         "test_play_equals_a_plain_loop_over_episodes"),
        ("success_strict=info[\"fractional_success_strict\"]",
         "success_strict=info[\"fractional_success\"]",
         "test_play_equals_a_plain_loop_over_episodes"),
        ("            if ends[e] is None:\n", "            if True:\n",
         "test_every_environment_is_played_to_its_own_end_and_no_further"),
        ("info[\"truncated_by\"] != TIME", "info[\"truncated_by\"] == TIME",
         "test_an_episode_that_ends_for_another_reason_is_cut_short"),
        ("(z - z_trained).norm(dim=1) / spread", "(z - z_trained).norm(dim=1)",
         "test_drift_and_read_error_by_hand"),
        (".sum() / (B * (B - 1))", ".sum() / (B * B)", "test_drift_and_read_error_by_hand"),
        ("mean_or_nan(drift[~np.isnan(drift)])", "drift.mean()",
         "test_a_chunk_of_one_episode_has_no_drift"),
        ("norm(dim=1) * POSITION_SCALE", "norm(dim=1)", "test_drift_and_read_error_by_hand"),
        ("obs[\"cubes\"][is_target(obs)][0, POSITION]", "obs[\"cubes\"][0, POSITION]",
         "test_drift_and_read_error_by_hand"),
        ("start(checkpoint, checkpoint[\"distractors\"], episodes)",
         "start(checkpoint, 3, episodes)",
         "test_a_trained_agent_drifts_at_other_numbers_and_reads_its_cube"),
        ("@ way / length_squared, 0, 1)", "@ way / length_squared, -9, 9)",
         "test_blocked_ways_by_hand"),
        ("nearest, axis=1) < CUBE)", "nearest, axis=1) < CUBE / 2)", "test_blocked_ways_by_hand"),
        ("ddof=1", "ddof=0", "test_summary_of_four_episodes_by_hand"),
        ("1.96 * values.std", "1.65 * values.std", "test_summary_of_four_episodes_by_hand"),
        ("(rho >= SOLVED)", "(rho > SOLVED)", "test_summary_of_four_episodes_by_hand"),
        ("(rho >= SOLVED)", "(strict >= SOLVED)", "test_summary_of_four_episodes_by_hand"),
        ("half_width(strict)", "half_width(rho)", "test_summary_of_four_episodes_by_hand"),
        ("nan(rho[is_clear])", "nan(rho[~is_clear])", "test_summary_of_four_episodes_by_hand"),
        ("1000 * row['read_error']", "100 * row['read_error']", "test_a_row_is_printed_as_it_is"),
        ("[make_env(checkpoint[\"task\"], distractors", "[make_env(\"push\", distractors",
         "test_play_equals_a_plain_loop_over_episodes"),
        ("env = make_env(checkpoint[\"task\"], distractors, checkpoint[\"settings\"], render_mode",
         "env = make_env(\"push\", distractors, checkpoint[\"settings\"], render_mode",
         "test_watching_plays_the_evaluated_episodes"),
        ("episodes[first:first + CHUNK]", "range(first, first + CHUNK)",
         "test_evaluation_prints_each_n_as_it_is_done_with_the_time_left"),
        ("seconds_each * (len(numbers) - len(rows))", "seconds_each * len(numbers)",
         "test_evaluation_prints_each_n_as_it_is_done_with_the_time_left"),
        ("load(run)[0][\"update\"] != update", "False",
         "test_scores_are_not_saved_if_the_run_was_trained_on_meanwhile"),
        ("if last < first:", "if False:", "test_bad_input_ends_with_one_line_and_status_2"),
        ("int(high if dash else low)", "int(high or low)",
         "test_bad_input_ends_with_one_line_and_status_2"),
        ("        print(\"stopped\")", "        raise", "test_ctrl_c_ends_watching"),
        ("if not (args.save and rows):", "if not rows:",
         "test_evaluation_leaves_a_run_as_it_is_unless_asked_to_save"),
        ("for n in sorted(lines)", "for n in lines",
         "test_rows_are_saved_in_order_and_other_n_stay"),
        ("\"zeroshot-sampled.csv\" if args.sample_actions else \"zeroshot.csv\"",
         "\"zeroshot.csv\"",
         "test_sampled_actions_are_saved_apart"),
        ("info = env.reset(seed=episode_seed(episode))", "info = env.reset(seed=episode)",
         "test_watching_plays_the_evaluated_episodes"),
        ("noise_of([episode])", "noise_of([0])",
         "test_watching_plays_the_evaluated_episodes"),
        ("if step % every == 0 and has_picture:", "if has_picture:", "test_film_shows_one_episode"),
        ("if step % every == 0 and has_picture:", "if step % every == 0:",
         "test_a_film_ends_where_the_physics_diverge"),
        ("os.path.join(folder, \"checkpoint.pt\"))", "folder)",
         "test_a_checkpoint_of_any_name_can_be_evaluated"),
        ("round(1000 * every * seconds)", "round(1000 * PICTURE_PERIOD)",
         "test_film_shows_one_episode"),
    ),
}
EVERY_MUTATION = [(name, *mutation) for name, many in MUTATIONS.items() for mutation in many]


def test_every_planted_defect_has_its_place_and_its_test():
    """Each quoted source occurs exactly once, each named test exists; SLOW=1 plants them."""
    for name, source, mutated, test in EVERY_MUTATION:
        assert read(os.path.join(HERE, name)).decode().count(source) == 1, (name, source)
        assert source != mutated and test in globals(), test
    assert len(set(EVERY_MUTATION)) == len(EVERY_MUTATION) > 150


def copy_of_the_project(folder):
    """All code copied; what was measured (results/) is linked."""
    os.mkdir(folder / "results")
    for part in ("", "results"):
        for name in os.listdir(os.path.join(HERE, part)):
            source, target = os.path.join(HERE, part, name), folder / part / name
            if name.endswith(".py"):
                shutil.copy(source, target)
            elif part:
                os.symlink(source, target)


def run_one_test(test, folder):
    quick = {key: value for key, value in os.environ.items() if key != "SLOW"}
    return run("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"test_all.py::{test}",
               cwd=folder, env=quick, timeout=600)


@pytest.fixture(scope="module")
def passes_unbroken(tmp_path_factory):
    """Does a test pass in a copy with no defect? Where it does not, a red one would say nothing."""
    folder = tmp_path_factory.mktemp("unbroken")
    copy_of_the_project(folder)
    return functools.cache(lambda test: run_one_test(test, folder).returncode == 0)


@pytest.mark.skipif(not SLOW, reason="takes hours: SLOW=1")
@pytest.mark.parametrize("name, source, mutated, test", EVERY_MUTATION)
def test_mutation_is_caught(name, source, mutated, test, tmp_path, passes_unbroken):
    assert passes_unbroken(test)
    copy_of_the_project(tmp_path)
    path = tmp_path / name
    path.write_text(path.read_text().replace(source, mutated))
    done = run_one_test(test, tmp_path)
    # 1: tests ran and failed; another status would be that none was found, or pytest's own error.
    assert done.returncode == 1 and "1 failed" in done.stdout, done.stdout
