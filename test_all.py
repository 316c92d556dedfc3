"""Tests of everything, each against something independent: a slow loop, torch's own layer, PyBullet, a hand-computed case.

Run:    pytest -q                                        under 3 minutes on 2 cores
        SLOW=1 pytest -q -s -k "soak or killed_and or mutation"     12 M environment steps, 40 kills, a dozen mutations: 1 to 2 hours
"""
import ast
import csv
import math
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pybullet as pb
import pytest
import torch
from torch import nn

import evaluate
import train
import trifinger_env as tri
from attn import ATTN
from lrn import LRN
from ppo import PPO, PointOnLine, TinyAgent, gae, normal_log_prob
from rn import RN
from trifinger_env import TriFingerEnv

SLOW = bool(os.environ.get("SLOW"))
HERE = os.path.dirname(os.path.abspath(__file__))
D = 64
torch.set_num_threads(1)


def some(B, K, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(B, K, D, generator=generator), torch.randn(B, D, generator=generator)


def run(*command, cwd=HERE, timeout=120, **more):
    """A command of the project in a process of its own; output as text."""
    return subprocess.run([sys.executable, *command], cwd=cwd, timeout=timeout, capture_output=True, text=True, **more)


# ---------------------------------------------------------------- encoders

def g_slow(encoder, pair):
    """g_theta on one concatenated pair, layer by layer, without the split of the first layer."""
    return encoder.g(torch.nn.functional.linear(pair, encoder.first.weight, encoder.first.bias))


def test_lrn_equals_the_loop_over_objects():
    encoder, (objects, goal) = LRN(), some(3, 6)
    for b in range(3):
        total = sum(g_slow(encoder, torch.cat([objects[b, i], goal[b]])) for i in range(6))
        z = nn.functional.layer_norm(total @ encoder.f.weight.T + encoder.f.bias, (25,))
        torch.testing.assert_close(encoder(objects, goal)[b], z, atol=1e-5, rtol=1e-4)


def test_lrn_with_a_maximum_equals_the_loop_and_counts_copies_once():
    encoder, (objects, goal) = LRN(aggregate="max"), some(3, 6)
    for b in range(3):
        r = [g_slow(encoder, torch.cat([objects[b, i], goal[b]])) for i in range(6)]
        largest = torch.stack([max(column) for column in zip(*r)])
        z = nn.functional.layer_norm(largest @ encoder.f.weight.T + encoder.f.bias, (25,))
        torch.testing.assert_close(encoder(objects, goal)[b], z, atol=1e-5, rtol=1e-4)
    more = torch.cat([objects, objects[:, 2:3].expand(-1, 7, -1)], 1)                      # seven copies of object 2
    torch.testing.assert_close(encoder(more, goal), encoder(objects, goal), atol=1e-5, rtol=1e-4)
    summed = LRN()
    assert (summed(more, goal) - summed(objects, goal)).abs().max() > 0.1
    for wrong in ({"aggregate": "mean"}, {"aggregate": "max", "layer_norm": False}):
        with pytest.raises(ValueError, match="aggregate"):
            LRN(**wrong)


def test_rn_equals_the_double_loop_over_pairs():
    encoder, (objects, goal) = RN(), some(2, 5)
    for b in range(2):
        tokens = [*objects[b], goal[b]]
        total = sum(g_slow(encoder, torch.cat([first, second])) for first in tokens for second in tokens)
        z = nn.functional.layer_norm(total @ encoder.f.weight.T + encoder.f.bias, (25,))
        torch.testing.assert_close(encoder(objects, goal)[b], z, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("heads", [1, 4])
def test_attention_equals_torch_multihead_attention(heads):
    encoder, (objects, goal) = ATTN(heads=heads), some(3, 6)
    torchs = nn.MultiheadAttention(D, heads, batch_first=True)
    with torch.no_grad():
        torchs.in_proj_weight.copy_(torch.cat([encoder.q.weight, encoder.k.weight, encoder.v.weight]))
        torchs.in_proj_bias.copy_(torch.cat([encoder.q.bias, encoder.k.bias, encoder.v.bias]))
        torchs.out_proj.weight.copy_(torch.eye(D))             # the paper's equation has no output projection
        torchs.out_proj.bias.zero_()
    tokens = torch.cat([objects, goal[:, None]], 1)
    expected, weights = torchs(tokens, tokens, tokens, average_attn_weights=False)
    attended, ours = encoder.attend(objects, goal)
    torch.testing.assert_close(attended, expected, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(ours, weights, atol=1e-6, rtol=1e-4)
    z = nn.functional.layer_norm(expected.sum(1) @ encoder.f.weight.T + encoder.f.bias, (25,))
    torch.testing.assert_close(encoder(objects, goal), z, atol=1e-4, rtol=1e-4)


def test_ablations_of_lrn_equal_their_formulas():
    objects, goal = some(2, 5)
    alone = LRN(relations=False)
    total = sum(g_slow(alone, objects[:, i]) for i in range(5))
    torch.testing.assert_close(alone(objects, goal), nn.functional.layer_norm(alone.f(total), (25,)), atol=1e-5, rtol=1e-4)
    mean = LRN(layer_norm=False, z_dim=10)
    r = sum(g_slow(mean, torch.cat([objects[:, i], goal], 1)) for i in range(5)) / 5
    torch.testing.assert_close(mean(objects, goal), mean.f(r), atol=1e-5, rtol=1e-4)
    assert mean(objects, goal).shape == (2, 10)


@pytest.mark.parametrize("make", [LRN, RN, ATTN, lambda: LRN(layer_norm=False), lambda: LRN(relations=False), lambda: LRN(aggregate="max")])
def test_encoder_ignores_order_and_padding_and_serves_any_number(make):
    encoder, other = make(), make()
    other.load_state_dict(encoder.state_dict())
    for K in range(1, 21):
        objects, goal = some(2, K, seed=K)
        z = encoder(objects, goal)
        assert z.shape == (2, encoder.f.out_features) and torch.equal(z, other(objects, goal))
        torch.testing.assert_close(z, encoder(objects[:, torch.randperm(K)], goal), atol=1e-4, rtol=1e-4)
        padded = torch.cat([objects, 1e3 * torch.randn(2, 3, D)], 1)
        present = torch.arange(K + 3).expand(2, -1) < K
        torch.testing.assert_close(z, encoder(padded, goal, present), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("make", [LRN, RN, ATTN, lambda: LRN(aggregate="max")])
def test_gradient_reaches_every_parameter(make):
    encoder, (objects, goal) = make(), some(8, 6)
    (encoder(objects, goal) * torch.randn(8, 25)).sum().backward()
    for name, p in encoder.named_parameters():
        if name != "k.bias":                                   # adds the same score to every key, so softmax drops it
            assert p.grad.abs().max() > 1e-6, name


def test_relations_grow_linearly_in_lrn_and_quadratically_in_rn():
    """Rows that pass through g_theta, counted at its second layer; the paper's 12 and 169 at 9 cubes and 3 fingers."""
    for encoder, expected in ((LRN(), {6: 6, 12: 12, 24: 24}), (RN(), {6: 49, 12: 169, 24: 625})):
        rows = []
        encoder.g[1].register_forward_hook(lambda module, inputs, output: rows.append(output.numel() // D))
        for K, count in expected.items():
            encoder(*some(1, K))
            assert rows[-1] == count


@pytest.mark.parametrize("kind", ["lrn", "lrn-max", "rn", "attn"])
def test_z_varies_with_the_state_from_the_start(kind):
    """PyTorch's default initialisation gives LRN and RN a z that is nearly constant over states; ours must not."""
    torch.manual_seed(0)
    agent, env = train.Agent(kind, 2, {key: value[0] for key, value in train.SETTINGS.items()}), TriFingerEnv()
    observations = [env.reset(seed=s)[0] for s in range(40)]
    env.close()
    obs = {key: torch.from_numpy(np.stack([o[key] for o in observations])) for key in observations[0]}
    ours = agent.encode(obs).std(0).mean().item()
    for module in agent.modules():
        if isinstance(module, nn.Linear):
            module.reset_parameters()
    default = agent.encode(obs).std(0).mean().item()
    assert ours > 0.06 and ours > (2 if kind == "attn" else 5) * default, (ours, default)


# ---------------------------------------------------------------- environment

@pytest.fixture(scope="module")
def env():
    env = TriFingerEnv()
    env.reset(seed=0)
    yield env
    env.close()


def test_kinematics_against_pybullet_and_inverse(env):
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform(np.array(tri.LOWER * 3), np.array(tri.UPPER * 3))
        for j in range(9):
            pb.resetJointState(env._robot, j, q[j], physicsClientId=env._client)
        for k in range(3):
            state = pb.getLinkState(env._robot, 3 * k + 2, computeForwardKinematics=1, physicsClientId=env._client)
            tip = pb.multiplyTransforms(state[4], state[5], [0, -0.008, -0.16], [0, 0, 0, 1])[0]
            ours = tri.forward_kinematics(k, q[3 * k:3 * k + 3])
            np.testing.assert_allclose(ours, tip, atol=1e-6)
    for q in rng.uniform([-1.0, -0.8, -2.4], [0.8, 0.8, -0.1], (50, 3)):
        for k in range(3):
            tip = tri.forward_kinematics(k, q)
            np.testing.assert_allclose(tri.forward_kinematics(k, tri.inverse_kinematics(k, tip)), tip, atol=1e-9)
    with pytest.raises(ValueError, match="cannot reach"):
        tri.inverse_kinematics(0, (1.0, 0.0, 0.0))


def test_friction_of_a_cube_on_the_floor(env):
    """A cube slides once a sideways force exceeds mu m g, with mu = 1.0 x 0.5; it stays below."""
    c = {"physicsClientId": env._client}
    for share, slides in ((0.9, False), (1.1, True)):
        env.reset(seed=1)
        cube = env._cubes[0]
        pb.resetBasePositionAndOrientation(cube, [0, 0, tri.CUBE / 2], [0, 0, 0, 1], **c)
        for body in env._cubes[1:]:
            pb.resetBasePositionAndOrientation(body, [0.15, 0.1, 1 + body], [0, 0, 0, 1], **c)
        for j in range(9):
            pb.resetJointState(env._robot, j, (0.0, 1.4, -1.0)[j % 3], **c)
        force = share * 0.5 * tri.CUBE_MASS * 9.81
        for _ in range(60):
            at = pb.getBasePositionAndOrientation(cube, **c)[0]
            pb.applyExternalForce(cube, -1, [force, 0, 0], at, pb.WORLD_FRAME, **c)
            pb.stepSimulation(**c)
        moved = pb.getBasePositionAndOrientation(cube, **c)[0][0]
        assert (moved > 0.01) == slides, moved


def test_long_physics_steps_keep_what_matters():
    """8 ms steps: cubes rest without jitter, fingers at full speed (2 m/s) do not pass through cubes, a slow push carries."""
    env = TriFingerEnv(substeps=1, episode_steps=10 ** 6)
    c = {"physicsClientId": env._client}
    env.reset(seed=0)
    for _ in range(250):
        pb.stepSimulation(**c)
    for cube in env._cubes:
        assert np.abs(pb.getBaseVelocity(cube, **c)).max() < 1e-3
        assert abs(pb.getBasePositionAndOrientation(cube, **c)[0][2] - tri.CUBE / 2) < 1e-4
    deepest, touched = 0.0, 0
    for seed in range(6):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for t in range(500):
            bang = np.sign(rng.uniform(-1, 1, 9)) if t % 25 == 0 else bang
            env.step(bang)
            touched += any(pb.getContactPoints(env._robot, cube, **c) for cube in env._cubes)
            for position, quaternion in env._poses:
                inside = tri.CUBE / 2 - np.abs(np.subtract(env._tips, position) @ tri.rotation(quaternion)).max(1)
                deepest = max(deepest, inside.max())
    assert touched > 50 and deepest < 0.005, (touched, deepest)                # the tip's centre; a cube is 65 mm wide
    moved = []
    for timestep in (0.008, 0.002):
        env.timestep = timestep
        env.reset(seed=0)
        joints = [0.0, 1.4, -1.0] * 3                          # fingers 1 and 2 lifted out of the way
        cube, start, heading = env._cubes[env.target], np.array([-0.065, 0.01, 0.035]), np.array([1.0, 0.0, 0.0])
        for body in env._cubes:
            away = [0.0, 0.0, tri.CUBE / 2] if body == cube else [0.1, 0.15 - 0.3 * (body % 2), tri.CUBE / 2]
            pb.resetBasePositionAndOrientation(body, away, [0, 0, 0, 1], **c)
        joints[:3] = tri.inverse_kinematics(0, start)
        for j in range(9):
            pb.resetJointState(env._robot, j, joints[j], 0.0, **c)
        for t in range(round(1 / timestep)):
            joints[:3] = tri.inverse_kinematics(0, start + 0.1 * t * timestep * heading)
            pb.setJointMotorControlArray(env._robot, range(9), pb.POSITION_CONTROL, targetPositions=joints, forces=[tri.TORQUE] * 9, **c)
            pb.stepSimulation(**c)
        moved.append(np.array(pb.getBasePositionAndOrientation(cube, **c)[0]))
    env.close()
    assert moved[1][0] > 0.04 and np.linalg.norm(moved[0] - moved[1]) < 0.015, moved


def turn(axis, angle):
    return tuple(math.sin(angle / 2) * np.array(axis, float)) + (math.cos(angle / 2),)


def test_overlap_against_hand_computed_cases():
    side, still, z = tri.CUBE, (0.0, 0.0, 0.0, 1.0), tri.CUBE / 2
    goal = ((0.0, 0.0, z), still)
    for cube, aabb, strict in (
            (goal, 1.0, 1.0),
            (((0.013, 0.0, z), still), 0.8, 0.8),                                      # 13 mm of 65 mm
            (((side / 2, side / 2, z + side / 2), still), 0.125, 0.125),
            (((side, 0.0, z), still), 0.0, 0.0),
            (((0.0, 0.0, z), turn((0, 0, 1), math.pi / 4)), 1.0, 2 * (math.sqrt(2) - 1)),    # an octagon of the square
            (((0.01, 0.0, z), turn((0, 0, 1), math.pi / 4)), 1.0, None),               # lenient: still 1.0, 1 cm off
            (((0.0, 0.0, z), turn((1, 0, 0), math.pi / 2)), 1.0, 1.0)):
        assert tri.aabb_overlap(cube, goal) == pytest.approx(aabb, abs=1e-9)
        if strict is not None:
            assert tri.oriented_overlap(cube, goal) == pytest.approx(strict, abs=1e-9)


def test_overlap_against_monte_carlo_volumes():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (100_000, 3)) * tri.CUBE                           # inside the goal cube, its own frame
    for _ in range(12):
        quaternions = rng.normal(size=(2, 4))
        cube, goal = ((tuple(p), tuple(q / np.linalg.norm(q))) for p, q in zip(rng.uniform(-0.025, 0.025, (2, 3)), quaternions))
        world = points @ tri.rotation(goal[1]).T + goal[0]
        inside = (np.abs((world - cube[0]) @ tri.rotation(cube[1])) < tri.CUBE / 2).all(1).mean()
        assert tri.oriented_overlap(cube, goal) == pytest.approx(inside, abs=0.006)
        half = np.abs(tri.rotation(goal[1])).sum(1) * tri.CUBE / 2
        world = points / tri.CUBE * 2 * half + goal[0]
        inside = (np.abs(world - cube[0]) < np.abs(tri.rotation(cube[1])).sum(1) * tri.CUBE / 2).all(1).mean()
        assert tri.aabb_overlap(cube, goal) == pytest.approx(inside, abs=0.006)


def test_observation_is_table_1(env):
    """Every entry against PyBullet's own state, with the scaling undone."""
    env.reset(seed=3)
    for _ in range(10):
        obs, *_ = env.step(np.full(9, 0.5))
    assert {key: (value.shape, value.dtype) for key, value in obs.items()} == {
        "cubes": ((3, 18), np.float32), "fingers": ((3, 10), np.float32), "goal": ((12,), np.float32)}
    c = {"physicsClientId": env._client}
    for cube, row, identifier in zip(env._cubes, obs["cubes"] * tri.CUBE_SCALE, env._ids):
        position, quaternion = pb.getBasePositionAndOrientation(cube, **c)
        linear, angular = pb.getBaseVelocity(cube, **c)
        quaternion = np.array(quaternion) * (1 if quaternion[3] >= 0 else -1)
        np.testing.assert_allclose(row, [1, *[tri.CUBE] * 3, *position, *quaternion, *linear, *angular, identifier], atol=1e-5)
    states = pb.getJointStates(env._robot, range(9), **c)
    for k, row in enumerate(obs["fingers"] * tri.FINGER_SCALE):
        q, dq = ([state[i] for state in states[3 * k:3 * k + 3]] for i in (0, 1))
        np.testing.assert_allclose(row, [*q, *dq, k - 1, *tri.forward_kinematics(k, q)], atol=1e-5)
    np.testing.assert_allclose(obs["goal"] * tri.GOAL_SCALE, [1, *[tri.CUBE] * 3, *env.goal[0], *env.goal[1], env._ids[env.target]], atol=1e-5)
    assert (obs["cubes"][:, -1] == obs["goal"][-1]).sum() == 1 and len(set(env._ids)) == 3 and np.abs(env._ids).max() <= 1
    # the scaling itself, in numbers: 0.2 m, 1.5 rad and a cube's edge are 1
    np.testing.assert_allclose(obs["cubes"][0, [1, 4, 5, 6]], [1, *np.array(env._poses[0][0]) / 0.2], atol=1e-5)
    np.testing.assert_allclose(obs["fingers"][1, [0, 6, 9]], [states[3][0] / 1.5, 0, env._tips[1][2] / 0.2], atol=1e-5)
    np.testing.assert_allclose(obs["goal"][[4, 10, 11]], [env.goal[0][0] / 0.2, 1, env._ids[env.target]], atol=1e-5)


def test_reward_terms_add_up_and_follow_their_formulas():
    weights = {"overlap": 100.0, "distance": 250.0, "curiosity": 10.0, "reach": 7.0}
    env = TriFingerEnv(distractors=1, reward_weights=weights)
    env.reset(seed=0)
    for t in range(30):
        before, tips = env._poses[env.target][0], np.array(env._tips)
        _, reward, _, _, info = env.step(np.sin(np.arange(9) + t / 3))
        after, rho, goal = env._poses[env.target][0], tri.aabb_overlap(env._poses[env.target], env.goal), env.goal[0]
        expected = {"overlap": 100 * rho, "distance": 250 * (math.dist(before, goal) - math.dist(after, goal)),
                    "curiosity": 10 * (1 - rho) ** 0.05 * math.log(math.dist(before, after) + 1e-5),
                    "reach": 7 * (np.linalg.norm(tips - before) - np.linalg.norm(np.array(env._tips) - after))}
        assert info["rewards"] == pytest.approx(expected, abs=1e-9)
        assert reward == pytest.approx(sum(expected.values()), abs=1e-9)
        assert info["fractional_success"] == rho
    env.close()


def test_distance_term_pays_for_moving_towards_the_goal(env):
    for sign in (1, -1):
        env.reset(seed=2)
        cube, (position, _) = env._cubes[env.target], env._poses[env.target]
        towards = np.subtract(env.goal[0], position)
        pb.resetBaseVelocity(cube, list(sign * 0.3 * towards / np.linalg.norm(towards)), [0, 0, 0], physicsClientId=env._client)
        assert sign * env.step(np.zeros(9))[4]["rewards"]["distance"] > 0


@pytest.mark.parametrize("n", [0, 1, 2, 5, 9, 14, 20])
def test_resets_never_overlap_and_follow_one_law(n):
    """Corners checked by sampling points on the edges: no cube inside another, on the goal, in a finger, beyond the wall."""
    env = TriFingerEnv(distractors=n)
    env.reset(seed=0)
    edge = np.linspace(-0.5, 0.5, 14) * tri.CUBE
    rim = np.array([(x, y) for x in edge for y in edge if max(abs(x), abs(y)) > tri.CUBE * 0.49])
    for _ in range(1 if n > 14 else 30):
        env._rng = np.random.default_rng(env._rng.integers(2 ** 32))
        poses = env._place()
        assert poses.shape == (n + 2, 3) and np.hypot(*poses[:2, :2].T).max() <= tri.REACH
        outlines = [np.stack([x + np.cos(a) * rim[:, 0] - np.sin(a) * rim[:, 1], y + np.sin(a) * rim[:, 0] + np.cos(a) * rim[:, 1]], 1)
                    for x, y, a in poses]
        tips = np.array([tri.forward_kinematics(k, tri.REST)[:2] for k in range(3)])
        for i, (x, y, a) in enumerate(poses):
            others = np.concatenate([outline for j, outline in enumerate(outlines) if j != i] + [tips]) - [x, y]
            local = np.stack([np.cos(a) * others[:, 0] + np.sin(a) * others[:, 1], -np.sin(a) * others[:, 0] + np.cos(a) * others[:, 1]], 1)
            assert (np.abs(local).max(1) > tri.CUBE / 2).all()
            assert np.hypot(*outlines[i].T).max() < tri.WALL
    env.close()


def test_goal_and_target_do_not_depend_on_the_number_of_distractors():
    starts = []
    for n in (0, 2, 9):
        env = TriFingerEnv(distractors=n)
        env.reset(seed=11)
        starts.append((env.goal[0][:2], env._poses[env.target][0][:2]))
        env.close()
    assert np.ptp(np.array(starts), 0).max() == 0


def test_lifting_goals_reach_up_to_20_cm():
    env = TriFingerEnv("lift", 0)
    heights = []
    for _ in range(100):
        env.reset(seed=0 if not heights else None)
        heights.append(env.goal[0][2])
    env.close()
    assert tri.CUBE / 2 <= min(heights) < 0.06 and 0.18 < max(heights) <= 0.2


@pytest.mark.parametrize("n", [0, 2])
def test_same_seed_same_trajectory_bit_for_bit(n):
    def trajectory(env, seed):
        rng, obs = np.random.default_rng(seed), [env.reset(seed=seed)[0]]
        for _ in range(120):
            obs.append(env.step(np.sign(rng.uniform(-1, 1, 9)))[0])
        return np.array([np.concatenate([value.ravel() for value in o.values()]) for o in obs])
    used, fresh = TriFingerEnv(distractors=n), TriFingerEnv(distractors=n)
    for seed in (0, 1, 2):
        trajectory(used, seed)
    assert np.array_equal(trajectory(used, 7), trajectory(fresh, 7))
    assert not np.array_equal(trajectory(used, 7), trajectory(fresh, 8))
    used.close(), fresh.close()


def test_episode_ends_by_truncation_with_a_named_reason():
    env = TriFingerEnv(episode_steps=5)
    env.reset(seed=0)
    results = [env.step(np.zeros(9)) for _ in range(5)]
    assert [result[3] for result in results] == [False] * 4 + [True] and not any(result[2] for result in results)
    assert results[-1][4]["truncated_by"] == "time" and 0 <= results[-1][4]["fractional_success_strict"] <= 1
    assert type(results[0][2]) is bool and type(results[0][3]) is bool and type(results[0][1]) is float
    env.reset()
    pb.resetBasePositionAndOrientation(env._cubes[0], [0.5, 0, 0.1], [0, 0, 0, 1], physicsClientId=env._client)
    assert env.step(np.zeros(9))[4]["truncated_by"] == "a cube left the arena"
    for kind in ("linearVelocity", "angularVelocity", "joints"):
        before = env.reset()[0]
        if kind == "joints":
            pb.resetJointState(env._robot, 4, 0.0, float("nan"), physicsClientId=env._client)
        else:
            pb.resetBaseVelocity(env._cubes[1], **{kind: [float("nan")] * 3}, physicsClientId=env._client)
        obs, reward, terminated, truncated, info = env.step(np.zeros(9))
        assert info["truncated_by"] == "the physics diverged" and truncated and not terminated, kind
        assert reward == info["fractional_success"] == info["fractional_success_strict"] == sum(info["rewards"].values()) == 0
        assert all(np.array_equal(obs[key], before[key]) for key in before)    # the last sound one
        with pytest.raises(RuntimeError, match="reset"):
            env.step(np.zeros(9))
        env.reset()
        assert all(np.isfinite(value).all() for _ in range(4) for value in env.step(np.zeros(9))[0].values()), kind
    env.close()


def memory():
    """Resident memory of this process in MiB (Linux)."""
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2 ** 20


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads memory from /proc")
@pytest.mark.parametrize("kind", ["random", "bang-bang"])
@pytest.mark.parametrize("task", ["push", "lift"])
@pytest.mark.parametrize("n", [0, 2, 9])
def test_soak(n, task, kind):
    """Random actions, and full speed this way and that: nothing but finite numbers, every end named, memory flat."""
    steps, env, rng, ends, held = 1_000_000 if SLOW else 500, TriFingerEnv(task, n, episode_steps=125), np.random.default_rng(n), {}, []
    env.reset(seed=0)
    for step in range(steps):
        if kind == "random":
            action = rng.uniform(-1, 1, 9)
        elif step % 10 == 0:
            action = np.sign(rng.uniform(-1, 1, 9))
        obs, reward, _, truncated, info = env.step(action)
        assert math.isfinite(reward + info["fractional_success"]) and all(np.isfinite(value).all() for value in obs.values()), step
        if truncated:
            assert math.isfinite(info["fractional_success_strict"])
            ends[info["truncated_by"]] = ends.get(info["truncated_by"], 0) + 1
            env.reset(seed=step if step % 2 else None)
        if step % (steps // 10) == 0:
            held.append(memory())
    env.close()
    print(f"\n{task} N={n} {kind}: {steps} steps, ends {ends}, memory {held[1]:.1f} MiB after a tenth, {held[-1]:.1f} at the end")
    assert set(ends) <= {"time", "a cube left the arena", "the physics diverged"} and ends["time"] >= 0.9 * steps / 125
    assert held[-1] - held[1] < 3, held


def test_bad_arguments_and_actions_are_refused():
    for arguments, words in (({"task": "fly"}, "task"), ({"distractors": -1}, "distractors"), ({"distractors": 1.5}, "distractors"),
                             ({"distractors": 21}, "holds 21 cubes"), ({"reward_weights": {"joy": 1}}, "joy"), ({"episode_steps": 0}, "positive"),
                             ({"action_mode": "torque"}, "action_mode"), ({"render_mode": "ascii"}, "render_mode")):
        with pytest.raises(ValueError, match=words):
            TriFingerEnv(**arguments)
    env = TriFingerEnv(distractors=0)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(9))
    env.reset(seed=0)
    for action in (np.full(9, np.nan), np.zeros(8), np.zeros((1, 9)), "left", None, [np.inf] + [0] * 8, 3):
        with pytest.raises(ValueError, match="nine finite numbers"):
            env.step(action)
    far, near = TriFingerEnv(distractors=0), env
    far.reset(seed=5), near.reset(seed=5)
    assert np.array_equal(far.step(np.full(9, 50.0))[0]["fingers"], near.step(np.ones(9))[0]["fingers"])     # clipped
    far.close(), near.close(), near.close()


def test_paper_rate_is_available():
    env = TriFingerEnv(episode_steps=2500, substeps=3, timestep=0.004, action_mode="absolute", distractors=0)
    env.reset(seed=0)
    for t in range(2500):
        truncated, info = env.step(np.zeros(9))[3:]
        assert truncated == (t == 2499)
    env.close()


def test_picture_shows_target_goal_and_distractors_in_their_colours():
    env = TriFingerEnv(render_mode="rgb_array")
    env.reset(seed=3)
    image = env.render().astype(int)
    env.close()
    assert image.shape == (360, 480, 3)
    r, g, b = image[..., 0], image[..., 1], image[..., 2]
    blue, red, green = (b > r + 60) & (b > g + 40), (r > g + 60) & (r > b + 60), (g > r + 25) & (g > b + 25)
    assert min(blue.sum(), red.sum(), green.sum()) > 200, (blue.sum(), red.sum(), green.sum())


def test_gymnasium_check_env():
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed (optional)")
    from gymnasium.utils.env_checker import check_env

    class Adapter(gymnasium.Env):
        metadata = TriFingerEnv.metadata

        def __init__(self):
            self.inner, box, self.render_mode = TriFingerEnv(), gymnasium.spaces.Box, None
            self.action_space = box(-1, 1, (9,), np.float32)
            self.observation_space = gymnasium.spaces.Dict({key: box(-np.inf, np.inf, value.shape, np.float32)
                                                            for key, value in self.inner.reset(seed=0)[0].items()})

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.inner.reset(seed=seed, options=options)

        def step(self, action):
            return self.inner.step(action)

    check_env(Adapter(), skip_render_check=True)


# ---------------------------------------------------------------- PPO

def test_gae_against_a_hand_computed_table():
    """discount 0.5, lambda 0.5; column 0 terminates at t=1, column 1 is truncated at t=1, both run on at t=2."""
    both = torch.tensor
    rewards, values = both([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]), both([[4.0, 4.0], [2.0, 2.0], [1.0, 1.0]])
    next_values = both([[2.0, 2.0], [8.0, 8.0], [6.0, 6.0]])
    terminated, done = both([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), both([[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]])
    # t=2: 3 + 0.5*6 - 1 = 5.  t=1: terminated 2 - 2 = 0; truncated 2 + 0.5*8 - 2 = 4.  t=0: 1 + 0.5*2 - 4 = -2, + 0.25 * A_1
    expected = both([[-2.0, -1.0], [0.0, 4.0], [5.0, 5.0]])
    torch.testing.assert_close(gae(rewards, values, next_values, terminated, done, 0.5, 0.5), expected)


def test_log_prob_and_entropy_against_torch_distributions():
    mean, log_std, actions = torch.randn(5, 9), torch.randn(9), torch.randn(5, 9)
    normal = torch.distributions.Normal(mean, log_std.exp())
    torch.testing.assert_close(normal_log_prob(actions, mean, log_std), normal.log_prob(actions).sum(-1))
    learner = PPO(TinyAgent(), [PointOnLine()], steps=8, minibatches=1)
    obs = {"x": torch.randn(8, 2)}
    stats = learner.loss(obs, torch.randn(8, 1), torch.zeros(8), torch.randn(8), torch.randn(8), 0.2)[1]
    assert stats["entropy"].item() == pytest.approx(torch.distributions.Normal(0, learner.agent.log_std.exp()).entropy().item(), abs=1e-5)


class Counter:
    """Observation t, reward 10 * episode + t; episodes end after 3 steps, by termination or truncation."""
    def __init__(self, terminates):
        self.terminates, self.episode = terminates, -1

    def reset(self, *, seed=None, options=None):
        self.t, self.episode = 0, self.episode + 1
        return {"x": np.array([0.0, self.episode], np.float32)}, {}

    def step(self, action):
        self.t += 1
        end = self.t == 3
        return {"x": np.array([self.t, self.episode], np.float32)}, 10.0 * self.episode + self.t, end and self.terminates, end and not self.terminates, {}


@pytest.mark.parametrize("terminates", [True, False])
def test_rollout_stores_what_happened(terminates):
    """Rewards sit at their step, and an episode's last value comes from its own final observation."""
    agent = TinyAgent()
    learner = PPO(agent, [Counter(terminates)], steps=5, minibatches=1, lam=1.0, discount=0.5, normalize_values=False)
    episodes = learner.rollout([0])
    assert learner.buffer["x"][:, 0].tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1]]
    assert [(e[0], e[1]) for e in episodes] == [(6.0, 3)]
    with torch.no_grad():
        final, last = (agent.value(torch.tensor(x)).item() for x in ([3.0, 0.0], [2.0, 1.0]))
    future = 0.0 if terminates else final
    expected = [1 + 0.5 * (2 + 0.5 * (3 + 0.5 * future)), 2 + 0.5 * (3 + 0.5 * future), 3 + 0.5 * future,
                11 + 0.5 * (12 + 0.5 * last), 12 + 0.5 * last]
    assert learner.batch["returns"][:, 0].tolist() == pytest.approx(expected, abs=1e-5)


def test_ppo_solves_the_line():
    """Best possible: about 3.6 moves of 0.2 to a random target; a random policy ends more than 0.5 away."""
    torch.manual_seed(0)
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(8)], steps=64, lr=3e-3)
    gaps = []
    for update in range(25):
        episodes = learner.rollout([1000 * update + e for e in range(8)])
        stats = learner.update(1 - update / 25)
        gaps.append(np.mean([e[2]["gap"] for e in episodes]))
    assert gaps[0] > 0.3 and np.mean(gaps[-5:]) < 0.1, gaps
    assert stats["approx_kl"] >= 0 and stats["explained_variance"] > 0.5


def test_ppo_refuses_a_batch_that_does_not_divide_and_a_loss_that_is_not_finite():
    with pytest.raises(ValueError, match="divide"):
        PPO(TinyAgent(), [PointOnLine()] * 3, steps=5, minibatches=4)
    learner = PPO(TinyAgent(), [PointOnLine()], steps=16, minibatches=2)
    learner.rollout([0])
    learner.batch["returns"][3] = float("nan")
    before = [p.clone() for p in learner.agent.parameters()]
    with pytest.raises(FloatingPointError):
        learner.update(1.0)
    assert all(torch.equal(p, q) for p, q in zip(before, learner.agent.parameters()))


def test_update_on_one_vector_of_weights_equals_torch_layer_by_layer():
    """Three steps of update() against torch's own gradient clipping and Adam over the list of parameters."""
    torch.manual_seed(0)
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(4)], steps=8, epochs=3, minibatches=1, lr=1e-2, max_grad_norm=0.2)
    learner.agent.load_state_dict(learner.agent.state_dict())                  # loading must keep the weights in the vector
    reference = TinyAgent()
    reference.load_state_dict(learner.agent.state_dict())
    learner.rollout([0, 1, 2, 3])
    learner.update(1.0)
    part = {key: value.flatten(0, 1) for key, value in learner.batch.items()}
    part["returns"] = (part["returns"] - learner.return_mean) / learner.return_std()
    part["advantages"] = (part["advantages"] - part["advantages"].mean()) / (part["advantages"].std(correction=0) + 1e-8)
    optimizer, loss_of, norms = torch.optim.Adam(reference.parameters(), lr=1e-2, eps=1e-5), PPO(reference, [None], minibatches=1).loss, []
    for _ in range(3):
        optimizer.zero_grad()
        loss_of({"x": learner.buffer["x"].flatten(0, 1)}, **part, clip=0.2)[0].backward()
        norms.append(nn.utils.clip_grad_norm_(reference.parameters(), 0.2))
        optimizer.step()
    assert max(norms) > 0.2                                                    # so that clipping is part of the comparison
    for ours, torchs in zip(learner.agent.parameters(), reference.parameters()):
        torch.testing.assert_close(ours, torchs, atol=1e-5, rtol=1e-4)


TWO_RANKS = """
import os, sys, torch, torch.distributed as dist
sys.path.insert(0, {here!r})
from ppo import PPO, PointOnLine, TinyAgent

def learner(envs):
    torch.manual_seed(0)
    return PPO(TinyAgent(), [PointOnLine() for _ in range(envs)], steps=32, epochs=1, minibatches=1, lr=1e-2)

def rank(r, path):
    dist.init_process_group("gloo", init_method="file://" + path, rank=r, world_size=2)
    both = learner(4)
    both.rollout([0, 1, 2, 3])
    mine = learner(2)
    mine.rollout([2 * r, 2 * r + 1])
    for store in ("buffer", "batch"):                        # the same samples: this rank's half of the joined batch
        for key, value in getattr(mine, store).items():
            value.copy_(getattr(both, store)[key][:, 2 * r:2 * r + 2])
    mine.update(1.0)
    got = torch.cat([p.grad.flatten() for p in mine.agent.parameters()])
    dist.destroy_process_group()
    both.update(1.0)
    want = torch.cat([p.grad.flatten() for p in both.agent.parameters()])
    assert torch.allclose(got, want, rtol=1e-4, atol=1e-6), (got - want).abs().max()
    assert want.abs().max() > 1e-3
    os._exit(0)                                              # see the end of train.train()

if __name__ == "__main__":
    torch.multiprocessing.spawn(rank, ({store!r},), 2)
"""


def test_two_ranks_give_the_gradient_of_one_on_the_joined_batch(tmp_path):
    script = tmp_path / "two.py"
    script.write_text(TWO_RANKS.format(here=HERE, store=str(tmp_path / "store")))
    done = run(str(script))
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------- training and evaluation

SMALL = ["--set", "envs=4", "steps=50", "episode_steps=50", "minibatches=4"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short real training run on two ranks, with the reach term only."""
    out = str(tmp_path_factory.mktemp("run") / "lrn")
    done = run("train.py", "--encoder", "lrn", "--distractors", "0", "--ranks", "2", "--frames", "16000", "--out", out, "--set", "envs=8",
               "steps=50", "episode_steps=50", "minibatches=4", "lr=0.002", "reward_overlap=0", "reward_distance=0")
    assert done.returncode == 0, done.stderr
    return out


def mean_gap(agent, settings, episodes=24):
    """Mean distance (m) of the nearest fingertip to the cube's centre over the last steps of sampled episodes."""
    env, rng, gaps = train.make_env("push", 0, settings), np.random.default_rng(0), []
    for episode in range(episodes):
        obs, truncated = env.reset(seed=1000 + episode)[0], False
        while not truncated:
            with torch.no_grad():
                mean, log_std, _ = agent({key: torch.from_numpy(value)[None] for key, value in obs.items()})
                action = mean[0].numpy() + log_std.exp().numpy() * rng.standard_normal(9)
            obs, _, _, truncated, _ = env.step(action)
        gaps.append(np.linalg.norm(np.array(env._tips) - env._poses[env.target][0], axis=1).mean())
    env.close()
    return np.mean(gaps)


def test_training_lowers_the_distance_from_fingertips_to_cube(trained):
    checkpoint, agent = train.load(trained)
    torch.manual_seed(0)
    untrained = train.Agent("lrn", 0, checkpoint["settings"])
    before, after = mean_gap(untrained, checkpoint["settings"]), mean_gap(agent, checkpoint["settings"])
    assert after < 0.85 * before, (before, after)
    with open(os.path.join(trained, "progress.csv")) as file:
        rows = list(csv.DictReader(file))
    assert [int(row["update"]) for row in rows] == list(range(1, 41)) and int(rows[-1]["frames"]) == 16000


def test_checkpoint_evaluates_at_other_numbers_of_distractors(trained):
    done = run("evaluate.py", trained, "--distractors", "0,3", "--episodes", "6")
    assert done.returncode == 0, done.stderr
    rows = evaluate.read(trained, "zeroshot.csv")
    assert rows["distractors"].tolist() == [0, 3] and rows["episodes"].tolist() == [6, 6]
    again = evaluate.play(trained, [3], 0, 6, False)[3]                        # alone and in this process: the same numbers
    assert np.mean([result[0] for result in again]) == pytest.approx(rows["success_aabb"][1], abs=1e-4)


def test_summary_of_four_episodes_by_hand():
    row = evaluate.summary(5, [(1.0, 0.8, False, True, 0.1, 0.0), (0.0, 0.0, True, False, 0.3, 0.0), (0.9, 0.7, False, False, 0.1, 0.0),
                               (0.1, 0.1, False, False, 0.1, 0.1)])
    expected = {"distractors": 5, "episodes": 4, "success_aabb": 0.5, "success_strict": 0.4, "solved": 0.5, "cut_short": 1, "blocked": 0.25,
                "success_clear": 1 / 3, "success_blocked": 1.0, "z_drift": 0.15, "read_error": 0.025, "ci95": 1.96 * math.sqrt(0.82 / 3) / 2,
                "ci95_strict": 1.96 * math.sqrt(0.5 / 3) / 2}                   # sums of squared deviations: 0.82 and 0.5
    assert row == pytest.approx(expected)


def test_blocked_ways_and_the_drift_of_z(trained):
    obs = {"cubes": np.zeros((3, 18), np.float32), "goal": np.zeros(12, np.float32)}
    obs["cubes"][:, -1], obs["goal"][-1] = (-0.5, 0.0, 0.5), 0.5
    obs["cubes"][2, 4:6], obs["goal"][4:6] = np.divide([-0.1, 0.0], 0.2), np.divide([0.1, 0.0], 0.2)       # target and goal, m / 0.2
    for x, y, blocks in ((0.0, 0.06, True), (0.0, 0.07, False), (0.16, 0.0, True), (0.17, 0.0, False), (-0.14, 0.04, True), (-0.15, 0.05, False)):
        obs["cubes"][0, 4:6], obs["cubes"][1, 4:6] = np.divide([x, y], 0.2), np.divide([0.0, -0.2], 0.2)
        assert evaluate.is_blocked(obs) == blocks, (x, y)
    same, other = (np.array(rows, float) for rows in evaluate.play(trained, [0, 3], 0, 4, False).values())        # trained with 0
    assert (same[:, 4] == 0).all() and (other[:, 4] > 0.01).all() and (same[:, 3] == 0).all()
    assert (same[:, 5] < 0.25).all() and same[:, 5].max() > 0.001              # m; the arena's radius is 0.24


def test_table_puts_seeds_together(tmp_path, capsys):
    rows = {"push-lrn-n2-seed0": 0.9, "push-lrn-n2-seed1": 0.7, "push-lrn-n2-seed2": 0.8, "push-mlp-n2-seed0": 0.5}
    for name, score in rows.items():
        os.mkdir(tmp_path / name)
        line = dict.fromkeys(evaluate.COLUMNS, 0.0) | {"distractors": 2, "episodes": 100, "success_aabb": score, "ci95": 0.03, "solved": score}
        (tmp_path / name / "zeroshot.csv").write_text(",".join(line) + "\n" + ",".join(map(str, line.values())) + "\n")
        (tmp_path / name / "timing.csv").write_text(f"frames,seconds\n6000000,{1800 + 60 * int(name[-1])}\n")
    evaluate.table([str(tmp_path / name) for name in rows])
    text = capsys.readouterr().out
    aligned, _, solved, _ = text.split("\n\n")
    assert "| push-lrn-n2 | 3 | 6.0 | 30, 31, 32 | 0.80 ± 0.25<br>0.90, 0.70, 0.80 |" in aligned       # 4.303 * 0.1 / sqrt(3), t with 2 degrees of freedom
    assert aligned.startswith("| axis-aligned | seeds |") and "| push-mlp-n2 | 1 | 6.0 | 30 | 0.50 ± 0.03 |" in aligned
    assert solved.startswith("| solved | seeds |") and "| push-mlp-n2 | 1 | 6.0 | 30 | 0.50 ± 0.10 |" in solved             # 1.96 * sqrt(0.5 * 0.5 / 100)
    bar = evaluate.over_seeds([str(tmp_path / f"push-lrn-n2-seed{seed}") for seed in range(3)], "success_aabb")[2][1]
    assert abs(bar - 0.03 / 3 ** 0.5) < 1e-12                  # the mean of three means, each +- 0.03


def test_plot_and_film(trained, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (optional)")
    done = run("evaluate.py", trained, "--episodes", "0", "--distractors", "1", "--plot", str(tmp_path / "a.png"), "--gif", str(tmp_path / "a.gif"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").stat().st_size > 10_000 and (tmp_path / "a.gif").stat().st_size > 10_000


@pytest.mark.parametrize("kind", ["lrn-max", "rn", "attn", "mlp"])
def test_other_encoders_train_and_the_mlp_says_why_it_cannot_change_n(kind, tmp_path):
    done = run("train.py", "--encoder", kind, "--distractors", "1", "--ranks", "1", "--frames", "200", "--out", str(tmp_path / "run"), *SMALL)
    assert done.returncode == 0, done.stderr
    done = run("evaluate.py", str(tmp_path / "run"), "--distractors", "0,1", "--episodes", "2")
    assert done.returncode == 0, done.stderr
    assert ("fixed input" in done.stdout) == (kind == "mlp")
    assert len(evaluate.read(str(tmp_path / "run"), "zeroshot.csv")["episodes"]) == (1 if kind == "mlp" else 2)
    agent, obs = train.load(str(tmp_path / "run"))[1], {"cubes": torch.zeros(1, 3, 18), "fingers": torch.zeros(1, 3, 10), "goal": torch.zeros(1, 12)}
    assert getattr(agent.encoder, "aggregate", None) == ("max" if kind == "lrn-max" else None)
    if kind == "mlp":
        with pytest.raises(ValueError, match="trained with 1 distractors and cannot be used with 2"):
            agent(obs)
    else:
        assert agent(obs)[0].shape == (1, 9)


def alive(group):
    """Processes of a process group that are not dead (state Z: dead, not yet collected)."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            state, _, pgrp = open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[:3]
        except OSError:                                        # gone in between
            continue
        found += [int(pid)] if pgrp == str(group) and state != "Z" else []
    return found


def wait_for_the_end_of(group):
    begin = time.monotonic()
    while alive(group):
        assert time.monotonic() - begin < 30, alive(group)
        time.sleep(0.05)


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="looks for processes in /proc")
@pytest.mark.parametrize("ranks", [1, 2])
def test_stopped_killed_and_resumed_equals_never_stopped(ranks, tmp_path):
    """SIGTERM (to the first process) or Ctrl-C (to all), then kill -9 at random moments, every other one while a checkpoint is
    being written, each time followed by --resume: bit-equal weights and byte-equal progress.csv in the end."""
    kills, rng, cut, seen, inside, slowest = 20 if SLOW else 1, np.random.default_rng(ranks), tmp_path / "cut", 0, 0, 0.0
    command = ["train.py", "--distractors", "1", "--ranks", str(ranks), "--save-minutes", "0", "--frames", str(200 * (8 + 8 * kills)), *SMALL]
    assert run(*command, "--out", str(tmp_path / "whole"), timeout=900).returncode == 0
    for number in range(kills + 1):
        process = subprocess.Popen([sys.executable, *command, "--out", str(cut), *(["--resume"] if number else [])], cwd=HERE,
                                   stdout=subprocess.PIPE, text=True, start_new_session=True)
        updates = int(rng.integers(0, 5)) if number else 2
        for line in process.stdout if updates else ():
            if line.startswith("update "):
                seen, updates = int(line[7:].split("/")[0]), updates - 1
                if not updates:
                    break
        if number % 2:
            while process.poll() is None and not os.path.exists(cut / "checkpoint.pt.tmp"):
                pass
        elif number:
            time.sleep(rng.uniform(0, 0.3 if seen else 4.0))
        begin = time.monotonic()
        if number or ranks > 1:
            os.killpg(process.pid, signal.SIGKILL if number else signal.SIGINT)
        else:
            process.terminate()
        rest = process.communicate(timeout=60)[0]
        wait_for_the_end_of(process.pid)
        if not number:
            slowest = time.monotonic() - begin
            assert process.returncode == 0 and "stopped after" in rest and slowest < 10
            (cut / "zeroshot.csv").write_text("of the old weights")
        inside += os.path.exists(cut / "checkpoint.pt.tmp")
        for line in rest.splitlines():
            seen = int(line[7:].split("/")[0]) if line.startswith("update ") else seen
        kept = train.load(str(cut))[0]["update"]
        assert kept >= seen - 1                                # a checkpoint follows every update here
    print(f"\n{ranks} ranks: stopped in {slowest:.1f} s; {kills} kills, {inside} inside the writing, the last at update {kept}")
    assert run(*command, "--out", str(cut), "--resume", timeout=900).returncode == 0
    whole, ours = (torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (tmp_path / "whole", cut))
    assert whole["update"] == ours["update"] == 8 + 8 * kills and not os.path.exists(cut / "zeroshot.csv")
    assert all(torch.equal(value, ours["learner"][key]) for key, value in whole["learner"].items())
    assert (tmp_path / "whole" / "progress.csv").read_bytes() == (cut / "progress.csv").read_bytes()


def test_resume_drops_rows_after_the_checkpoint_and_torn_lines(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("update,score\n1,0.1\n2,0.2\n3,0.3\n4,0.4\n5,")
    train.keep_rows(str(path), ("update", "score"), 2)
    assert path.read_text() == "update,score\n1,0.1\n2,0.2\n"
    train.keep_rows(str(path), ("update", "score"), 0)
    assert path.read_text() == "update,score\n"


def test_torchrun_starts_the_same_file(tmp_path):
    done = run("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "train.py", "--frames", "400", "--out", str(tmp_path / "run"), *SMALL)
    assert done.returncode == 0, done.stderr
    assert train.load(str(tmp_path / "run"))[0]["frames"] == 400


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="looks for processes in /proc")
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_the_run_and_leaves_nobody_behind(victim, tmp_path):
    command = [sys.executable, "train.py", "--ranks", "2", "--out", str(tmp_path / "run"), *SMALL]
    process = subprocess.Popen(command, cwd=HERE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    for line in process.stdout:
        if line.startswith("update 2/"):
            break
    other, = (p for p in alive(process.pid) if b"spawn_main" in open(f"/proc/{p}/cmdline", "rb").read())
    os.kill((process.pid, other)[victim], signal.SIGKILL)
    error = process.communicate(timeout=60)[1]
    if victim:
        assert process.returncode == 1 and "SIGKILL" in error and "--resume" in error and "Traceback" not in error, error
    wait_for_the_end_of(process.pid)


def test_a_loss_that_is_not_finite_ends_the_run_and_keeps_the_checkpoint(tmp_path, capsys, monkeypatch):
    out = str(tmp_path / "run")
    monkeypatch.setattr(sys, "argv", ["train.py", "--ranks", "1", "--frames", "400", "--distractors", "0", "--out", out, *SMALL])
    train.main()
    before = open(os.path.join(out, "checkpoint.pt"), "rb").read()
    checkpoint = torch.load(os.path.join(out, "checkpoint.pt"), weights_only=True)
    checkpoint["settings"]["frames"] = 800
    train.save(checkpoint, os.path.join(out, "checkpoint.pt"))
    monkeypatch.setattr(sys, "argv", ["train.py", "--distractors", "0", "--out", out, "--resume"])
    monkeypatch.setattr(train.Agent, "auxiliary", lambda self, obs: self.log_std.sum() * float("nan"))
    changed = open(os.path.join(out, "checkpoint.pt"), "rb").read()
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        train.main()
    assert stop.value.code == 1 and "update 3" in capsys.readouterr().err
    assert before != changed == open(os.path.join(out, "checkpoint.pt"), "rb").read()


class Evil:
    def __reduce__(self):
        return os.mkdir, ("evil",)


@pytest.fixture
def bad(tmp_path, trained, monkeypatch):
    """Folder with a good run and every kind of broken one; also the working directory."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained, "good")
    good = torch.load(os.path.join("good", "checkpoint.pt"), weights_only=True)
    nan = {**good, "learner": {key: value * float("nan") for key, value in good["learner"].items()}}
    for name, content in (("list", [1, 2]), ("nan", nan), ("other-z", {**good, "settings": {**good["settings"], "z_dim": 7}}),
                          ("swapped", {**good, "encoder": "attn"}), ("stranger", {"weights": good["learner"]}), ("code", Evil()),
                          ("old", {**good, "settings": {key: good["settings"][key] for key in list(good["settings"])[:5]}})):
        os.mkdir(name)
        torch.save(content, os.path.join(name, "checkpoint.pt"))
    for name, content in (("half", open(os.path.join("good", "checkpoint.pt"), "rb").read()[:5000]), ("empty", b""), ("text", b"no")):
        os.mkdir(name)
        with open(os.path.join(name, "checkpoint.pt"), "wb") as file:
            file.write(content)
    for name, content in (("torn", "distractors,episodes\n2,"), ("foreign", "a,b\n1,2\n")):
        shutil.copytree("good", name)
        with open(os.path.join(name, "zeroshot.csv"), "w") as file:
            file.write(content)
    os.mkdir("bare")
    shutil.copy(os.path.join("good", "checkpoint.pt"), "bare")
    os.mkdir("rows")
    shutil.copy(os.path.join("good", "progress.csv"), "rows")
    with open("file", "w") as file:
        file.write("not a folder")


def test_bad_input_ends_with_one_line_and_status_2(bad, capsys, monkeypatch):
    """Each line names the flag or the file; nothing is written over, no traceback."""
    fresh, resume, play, kept = "train.py --out new ", "train.py --resume --distractors 0 --out ", "evaluate.py --episodes 2 --distractors 0 ", {}
    cases = [(fresh + flags, words) for flags, words in (
        ("--encoder gnn", "--encoder"), ("--task fly", "--task"), ("--distractors -1", "distractors"), ("--distractors 99", "distractors"),
        ("--distractors 1.5", "--distractors"), ("--distractors two", "--distractors"), ("--frames 0", "--frames"), ("--frames -5", "--frames"),
        ("--frames many", "--frames"), ("--seed -1", "--seed"), ("--seed x", "--seed"), ("--ranks 0", "--ranks"), ("--ranks 3", "--ranks"),
        ("--save-minutes soon", "--save-minutes"), ("--set joy=1", "joy"), ("--set z_dim", "z_dim"), ("--set z_dim=0", "z_dim"),
        ("--set z_dim=2.5", "z_dim"), ("--set relations=maybe", "relations"), ("--set lr=-1", "lr"), ("--set lr=nan", "lr"),
        ("--set log_std=inf", "log_std"), ("--set minibatches=7", "minibatches"), ("--set action_mode=torque", "action_mode"),
        ("--encoder attn --set heads=7", "heads"), ("--speed 3", "--speed"), ("--resume", "new"), ("--resume --overwrite", "--overwrite"))]
    cases += [("train.py --out " + rest, words) for rest, words in (("file", "--out"), ("file/below", "--out"), ("good", "--overwrite"),
                                                                    ("rows", "--overwrite"))]
    cases += [(resume + rest, words) for rest, words in (
        [(name, "not a readable checkpoint") for name in ("list", "other-z", "swapped", "stranger", "code", "old", "half", "empty", "text", "rows", "file")]
        + [("nan", "not finite"), ("good --encoder rn", "--encoder"), ("good --distractors 1", "--distractors"), ("good --seed 1", "--seed"),
           ("good --task lift", "--task"), ("good --set z_dim=7", "z_dim"), ("good --frames 7", "frames"), ("good --ranks 1", "ranks")])]
    cases += [(play + rest, words) for rest, words in (
        [(name, "not a readable checkpoint") for name in ("none", "text", "half", "code", "file")] + [
            ("nan", "not finite"), ("good --distractors x", "--distractors"), ("good --distractors 5-2", "--distractors"), ("good --distractors 30", "distractors"),
            ("good --episodes -1", "--episodes"), ("good --episodes some", "--episodes"), ("", "RUN"), ("good --plot nowhere/a.png --episodes 0", "nowhere|--plot needs"),
            ("good --gif nowhere/a.gif --episodes 0", "nowhere|--gif needs"), ("other --plot a.png --episodes 0", "other"),
            ("bare --plot a.png --episodes 0", "progress.csv|--plot needs"), ("torn", "zeroshot.csv"), ("foreign", "zeroshot.csv"),
            ("good --plot nowhere/a.png", "--plot"), ("good --gif nowhere/a.gif", "--gif")])]
    for folder, _, names in os.walk("."):
        kept.update({os.path.join(folder, name): open(os.path.join(folder, name), "rb").read() for name in names})
    for command, words in cases:
        monkeypatch.setattr(sys, "argv", command.split())
        with pytest.raises(SystemExit) as stop:
            (train if command.startswith("train.py") else evaluate).main()
        error = [line for line in capsys.readouterr().err.splitlines() if "pybullet build time" not in line]
        assert stop.value.code == 2 and len(error) == 1 and any(w in error[0] for w in words.split("|")), (command, stop.value.code, error)
    print(len(cases), "cases of bad input"); assert len(cases) > 60 and not os.path.exists("new") and not os.path.exists("evil")
    for path, content in kept.items():
        assert open(path, "rb").read() == content, path
    done = run(os.path.join(HERE, "train.py"), "--encoder", "gnn")             # and once as a user sees it
    assert done.returncode == 2 and "Traceback" not in done.stderr


def test_nothing_is_unpickled_or_downloaded():
    """torch.load only with weights_only; nothing that could run code or reach the network is imported."""
    known = {"argparse", "csv", "datetime", "math", "multiprocessing", "os", "re", "signal", "socket", "sys", "tempfile", "time", "numpy",
             "torch", "pybullet", "matplotlib", "PIL", "lrn", "rn", "attn", "ppo", "train", "trifinger_env"}
    for name in ("lrn.py", "rn.py", "attn.py", "ppo.py", "trifinger_env.py", "train.py", "evaluate.py"):
        for node in ast.walk(ast.parse(open(os.path.join(HERE, name)).read())):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module] if isinstance(node, ast.ImportFrom) else []
            assert {module.split(".")[0] for module in modules} <= known, (name, modules)
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("torch.load", "np.load"):
                assert "weights_only=True" in ast.unparse(node), (name, ast.unparse(node))


MUTATIONS = (                            # file, source, mutated source, the test that must fail
    ("lrn.py", "return self.norm(self.f(total))", "return self.f(total)", "lrn_equals_the_loop"),                      # no LayerNorm
    ("rn.py", "self.f(r.sum((1, 2)))", "self.f(r.sum((1, 2)) - r.diagonal(0, 1, 2).sum(-1))", "rn_equals_the_double"),   # no self pairs
    ("attn.py", " / math.sqrt(D // self.heads)", "", "attention_equals_torch"),                                        # no scale
    ("trifinger_env.py", "(last_to_goal - to_goal)", "(to_goal - last_to_goal)", "distance_term_pays"),                # sign as printed
    ("trifinger_env.py", "np.linspace(-1.0, 1.0, 21)", "np.arange(21.0)", "observation_is_table_1"),                   # identifiers not scaled
    ("trifinger_env.py", "if seed is not None or self._steps is None:", "if self._steps is None:", "same_seed_same_trajectory"),  # no rebuild
    ("ppo.py", "lam * (1 - done[t])", "lam * (1 - terminated[t])", "gae_against"),                                     # GAE runs on after a truncation
    ("ppo.py", "        dist.all_reduce(tensor)\n", "", "two_ranks_give"),                                             # ranks go their own ways
    ("train.py", '        learner.optimizer.load_state_dict(checkpoint["optimizer"])\n', "", "killed_and_resumed"),
    ("train.py", "int(row[0]) <= update", "True", "resume_drops_rows"),                                                # double rows
    ("evaluate.py", "1e-12), 0, 1)", "1e-12), -9, 9)", "blocked_ways"),                                                # a line, not a segment
    ("evaluate.py", "values.std(0, ddof=1)", "values.std(0)", "summary_of_four"))


@pytest.mark.skipif(not SLOW, reason="takes minutes: SLOW=1")
@pytest.mark.parametrize("name, source, mutated, test", MUTATIONS)
def test_mutation_is_caught(name, source, mutated, test, tmp_path):
    for file in os.listdir(HERE):
        if file.endswith(".py"):
            shutil.copy(os.path.join(HERE, file), tmp_path)
    text = (tmp_path / name).read_text()
    assert text.count(source) == 1
    (tmp_path / name).write_text(text.replace(source, mutated))
    done = run("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", test, cwd=tmp_path, env={key: v for key, v in os.environ.items() if key != "SLOW"})
    assert done.returncode == 1 and "1 failed" in done.stdout, done.stdout     # 1: tests ran and failed; 5 would be none found


@pytest.mark.parametrize("name", ["lrn.py", "rn.py", "attn.py", "ppo.py", "trifinger_env.py"])
def test_module_works_alone_in_an_empty_folder(name, tmp_path):
    shutil.copy(os.path.join(HERE, name), tmp_path)
    done = run("-c", f"import {name[:-3]}", cwd=tmp_path)
    assert done.returncode == 0 and not done.stdout, done      # importing prints nothing
    done = run(name, cwd=tmp_path)
    assert done.returncode == 0 and len(done.stdout.splitlines()) >= 3, done
    assert sorted(os.listdir(tmp_path)) in ([name], ["__pycache__", name])
