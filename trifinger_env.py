"""TriFinger with N+1 cubes in PyBullet: the PushingCube and LiftingCube tasks of the paper (section 4.1, appendix A).

A three-finger robot (9 joints) stands over a round arena with N+1 identical cubes. The goal names one of them by an
identifier; that cube has to reach the goal pose, the other N are distractors. The robot and the arena are made of
primitives by this file: no mesh, no data file. Signatures are Gymnasium's, Gymnasium itself is not needed.

Shapes: observation {"cubes": (N+1, 18), "fingers": (3, 10), "goal": (12,)} float32 (Table 1), action (9,) in [-1, 1].
Run:    python trifinger_env.py        prints the speed table: frames/s by N and the share of physics in a step
"""
import math
import os
import sys
import tempfile
import time

import numpy as np
import pybullet as pb

CUBE = 0.065                             # edge of a cube, m
WALL = 0.242                             # inner radius of the arena, m
REACH = 0.124                            # a cube inside this radius can be pushed inward from every side, m
BASE, HEIGHT, LINK, OFFSET = 0.0455, 0.34, 0.16, 0.05945       # robot: mounting radius and height, link length, side step, m
LOWER, UPPER = (-1.57, -1.2, -3.0), (1.0, 1.57, 3.0)           # limits of upper, middle and lower joint, rad
REST = (0.0, 0.55, -0.7)                 # joint angles at reset: the tips hang beside the cubes at z = 0.045 m
JOINTS = tuple(range(9))                 # upper, middle, lower of finger 0, then 1, then 2
TORQUE = 0.36                            # N m
TIP = 0.0095                             # radius of a finger's lower link and tip, m
CUBE_MASS = 0.08                         # kg
FRICTION = {"cube": 1.0, "finger": 0.1, "floor": 0.5}          # Bullet multiplies the two in contact
IDENTIFIERS = np.linspace(-1.0, 1.0, 21)                       # pool that covers every N, so none is new when N grows
YAW = [-math.radians(90 + 120 * k) for k in range(3)]          # heading of finger k
HEADING = [(math.sin(yaw), math.cos(yaw)) for yaw in YAW]

# Table 1, with the divisor that brings each entry to about [-1, 1]; fixed numbers, so nothing here depends on N.
CUBE_SCALE = [1] + [CUBE] * 3 + [0.2] * 3 + [1] * 4 + [0.5] * 3 + [10] * 3 + [1]    # type size pos quat v omega id
GOAL_SCALE = [1] + [CUBE] * 3 + [0.2] * 3 + [1] * 4 + [1]                           # type size pos quat id
FINGER_SCALE = [1.5] * 3 + [10] * 3 + [1] + [0.2] * 3                               # q dq id tip
REWARD_WEIGHTS = {"overlap": 100.0, "distance": 5000.0, "curiosity": 0.0, "reach": 2500.0}


def forward_kinematics(k, q):
    """Fingertip (x, y, z) in m of finger k at joint angles q (3,) in rad, in the world frame."""
    s0, c0 = math.sin(q[0]), math.cos(q[0])
    x = -LINK * (math.sin(q[1]) + math.sin(q[1] + q[2])) - BASE
    w = -LINK * (math.cos(q[1]) + math.cos(q[1] + q[2]))       # depth below the upper joint, in the finger's plane
    y, z = -OFFSET * c0 + w * s0, OFFSET * s0 + w * c0
    s, c = HEADING[k]
    return c * x - s * y, s * x + c * y, z + HEIGHT


def inverse_kinematics(k, tip):
    """Joint angles (3,) in rad that bring finger k's tip to `tip` (3,) in m. ValueError if it is out of reach."""
    s, c = HEADING[k]
    x, y, z = c * tip[0] + s * tip[1] + BASE, -s * tip[0] + c * tip[1], tip[2] - HEIGHT
    depth = y * y + z * z - OFFSET ** 2
    w = -math.sqrt(max(depth, 0.0))
    r = math.hypot(x, w)
    if depth < 0 or r > 2 * LINK:
        raise ValueError(f"finger {k} cannot reach {tuple(tip)}")
    q0 = math.remainder(math.atan2(w, -OFFSET) - math.atan2(z, y), 2 * math.pi)
    q2 = -2 * math.acos(r / (2 * LINK))
    return q0, math.atan2(-x, -w) - q2 / 2, q2


def clip(values, low, high):
    """Values limited to [low, high] one by one; plain python, which on nine numbers beats numpy."""
    return [a if v < a else b if v > b else v for v, a, b in zip(values, low, high)]


def rotation(quaternion):
    """Rotation matrix (3, 3) of a unit quaternion (x, y, z, w)."""
    return np.reshape(pb.getMatrixFromQuaternion(quaternion), (3, 3))


def aabb_half_extents(quaternion):
    """Half edges (3,) in m of the axis-aligned box around a cube turned by `quaternion`; plain python, for speed."""
    x, y, z, w = quaternion
    return (CUBE * (abs(0.5 - y * y - z * z) + abs(x * y - z * w) + abs(x * z + y * w)),
            CUBE * (abs(x * y + z * w) + abs(0.5 - x * x - z * z) + abs(y * z - x * w)),
            CUBE * (abs(x * z - y * w) + abs(y * z + x * w) + abs(0.5 - x * x - y * y)))


def aabb_overlap(cube, goal):
    """Fractional success rho as CausalWorld measures it: vol(AABB(goal) n AABB(cube)) / vol(AABB(goal)), in [0, 1].

    `cube` and `goal` are (position (3,), quaternion (4,)). Lenient: turning the cube only makes its box larger.
    """
    share = 1.0
    for c, g, hc, hg in zip(cube[0], goal[0], aabb_half_extents(cube[1]), aabb_half_extents(goal[1])):
        share *= max(min(c + hc, g + hg) - max(c - hc, g - hg), 0.0) / (2 * hg)
    return min(share, 1.0)


def oriented_overlap(cube, goal):
    """The strict form of rho: share of the goal cube's true volume that the cube covers, orientation included.

    Cuts the cube's six faces (and the caps that the cuts leave) by the goal's six planes, in the goal's frame; the volume
    of what is left is the sum of the pyramids from a point inside to every face.
    """
    to_goal, h = rotation(goal[1]).T, CUBE / 2
    centre, axes = to_goal @ (np.subtract(cube[0], goal[0])), to_goal @ rotation(cube[1])
    faces = []
    for i in range(3):
        u, v = axes[:, (i + 1) % 3] * h, axes[:, (i + 2) % 3] * h
        for side in (-h, h):
            faces.append([centre + axes[:, i] * side + a * u + b * v for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    for axis in range(3):
        for sign in (-1, 1):
            kept, cap = [], []
            for face in faces:
                new = []
                for p, q in zip(face, face[1:] + face[:1]):
                    dp, dq = sign * p[axis] - h, sign * q[axis] - h        # > 0: beyond this plane of the goal
                    if dp <= 0:
                        new.append(p)
                    if (dp < 0 < dq) or (dq < 0 < dp):
                        new.append(p + (q - p) * dp / (dp - dq))
                        cap.append(new[-1])
                if len(new) > 2:
                    kept.append(new)
            if len(cap) > 2:                                               # close the cut: order its corners by angle
                d = np.array(cap) - np.mean(cap, axis=0)
                angle = np.arctan2(d[:, axis - 1], d[:, axis - 2])
                kept.append([cap[j] for j in np.argsort(angle)])
            faces = kept
    if not faces:
        return 0.0
    inside = np.mean([p for face in faces for p in face], axis=0)
    volume = sum(abs(np.dot(np.cross(face[j] - face[0], face[j + 1] - face[0]), face[0] - inside)) / 6
                 for face in faces for j in range(1, len(face) - 1))
    return float(min(volume / CUBE ** 3, 1.0))


def squares_overlap(a, b):
    """(n, m) bool: does square i of a (n, 4) touch square j of b (m, 4)? Rows: x, y, yaw, half edge (separating axes)."""
    a, b = np.asarray(a)[:, None], np.asarray(b)[None]                     # (n, 1, 4), (1, m, 4)
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    turn = np.abs(np.cos(b[..., 2] - a[..., 2])) + np.abs(np.sin(b[..., 2] - a[..., 2]))
    apart = np.zeros(dx.shape, bool)
    for s, own, other in ((a, a[..., 3], b[..., 3]), (b, b[..., 3], a[..., 3])):
        cos, sin = np.cos(s[..., 2]), np.sin(s[..., 2])
        for along in (cos * dx + sin * dy, cos * dy - sin * dx):
            apart |= np.abs(along) > own + other * turn
    return ~apart


def robot_urdf():
    """URDF of the robot from capsules; a tip is merged into its lower link. Only lower links can touch things."""
    def link(name, mass, com, inertia, radius, length, xyz, rpy, collides):
        shape = f'<origin xyz="{xyz}" rpy="{rpy}"/><geometry><capsule radius="{radius}" length="{length}"/></geometry>'
        return (f'<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/><inertia ixx="{inertia[0]}" '
                f'iyy="{inertia[1]}" izz="{inertia[2]}" ixy="0" ixz="0" iyz="0"/></inertial><visual>{shape}</visual>'
                + (f'<collision>{shape}</collision>' if collides else '') + '</link>')

    def joint(parent, child, xyz, axis, limits, yaw=0.0):
        return (f'<joint name="{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" '
                f'rpy="0 0 {yaw}"/><axis xyz="{axis}"/><limit lower="{limits[0]}" upper="{limits[1]}" effort="{TORQUE}" '
                'velocity="100"/></joint>')

    urdf = ('<robot name="trifinger"><link name="base"><inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" '
            'ixz="0" iyz="0"/></inertial></link>')
    limits = list(zip(LOWER, UPPER))
    for k, yaw in enumerate(YAW):
        origin = f"{-BASE * math.cos(yaw)} {-BASE * math.sin(yaw)} {HEIGHT}"
        urdf += link(f"upper{k}", 0.14854, "-0.079 0 0", (3e-5, 4.1e-4, 4.1e-4), 0.016, 0.13, "-0.065 0 0", f"0 {math.pi / 2} 0", False)
        urdf += link(f"middle{k}", 0.14854, "0 -0.019 -0.079", (4.1e-4, 4.1e-4, 3e-5), 0.014, 0.13, "0 -0.02 -0.08", "0 0 0", False)
        urdf += link(f"lower{k}", 0.0407, "0 -0.00875 -0.1065", (1.6e-4, 1.6e-4, 1e-5), TIP, LINK, "0 -0.008 -0.08", "0 0 0", True)
        urdf += joint("base", f"upper{k}", origin, "-1 0 0", limits[0], yaw)
        urdf += joint(f"upper{k}", f"middle{k}", "0 -0.014 0", "0 1 0", limits[1])
        urdf += joint(f"middle{k}", f"lower{k}", "0 -0.03745 -0.16", "0 1 0", limits[2])
    return urdf + '</robot>'


class TriFingerEnv:
    """PushingCube (task="push") or LiftingCube (task="lift") with `distractors` + 1 cubes.

    distractors     N, 0 to 20. ValueError beyond what the arena and the pool of identifiers hold.
    episode_steps   actions in an episode; it does not depend on N, or N would change the task. 250 at 25 Hz = 10 s.
    substeps, timestep   physics steps per action and their length in s: control rate = 1 / (substeps * timestep).
                    The paper's 83.3 Hz and 30 s: episode_steps=2500, substeps=3, timestep=0.004.
    action_mode     "delta": joint target = measured angle + 0.3 rad * action; "absolute": the action spans the joint range.
    goal_yaw        goal's largest yaw in rad. With 0 the goal is axis-aligned, and rho needs position only.
    reward_weights  weights that replace those of REWARD_WEIGHTS, by name (appendix A.1; "reach" is ours):
                    overlap    rho_t
                    distance   d(o_{t-1}, g) - d(o_t, g): positive for moving closer (the paper prints the opposite sign)
                    curiosity  (1 - rho_t)^0.05 log(d(o_t, o_{t-1}) + 1e-5)
                    reach      decrease of the Frobenius norm of (fingertips - target cube)
    render_mode     None, "rgb_array" (headless), or "human" (PyBullet's window, in real time).

    info: fractional_success (axis-aligned, as CausalWorld), rewards (each weighted term by name; they add up to the
    reward); at an episode's last step also fractional_success_strict (oriented) and truncated_by ("time", "a cube left
    the arena", "the physics diverged": then with the last sound observation, reward 0 and success 0). An episode never
    terminates: it is truncated, and counts as a success at rho >= 0.8.
    """
    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 25}

    def __init__(self, task="push", distractors=2, *, episode_steps=250, substeps=5, timestep=0.008, action_mode="delta",
                 goal_yaw=0.0, reward_weights=None, render_mode=None):
        unknown = set(reward_weights or {}) - set(REWARD_WEIGHTS)
        for bad, message in (
                (task not in ("push", "lift"), f"task must be 'push' or 'lift', got {task!r}"),
                (not isinstance(distractors, (int, np.integer)) or isinstance(distractors, bool) or not 0 <= distractors < len(IDENTIFIERS),
                 f"the arena holds {len(IDENTIFIERS)} cubes: distractors must be an integer from 0 to {len(IDENTIFIERS) - 1}, got {distractors!r}"),
                (action_mode not in ("delta", "absolute"), f"action_mode must be 'delta' or 'absolute', got {action_mode!r}"),
                (unknown, f"reward_weights knows {list(REWARD_WEIGHTS)}, got {sorted(unknown)}"),
                (episode_steps < 1 or substeps < 1 or not timestep > 0, "episode_steps, substeps and timestep must be positive"),
                (render_mode not in (None, "rgb_array", "human"), f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}"),
                (render_mode == "human" and sys.platform == "linux" and not os.environ.get("DISPLAY"),
                 "render_mode='human' needs a screen (DISPLAY is not set); use 'rgb_array'")):
            if bad:
                raise ValueError(message)
        self.task, self.distractors, self.episode_steps, self.action_mode = task, int(distractors), episode_steps, action_mode
        self.substeps, self.timestep, self.goal_yaw, self.render_mode = substeps, timestep, goal_yaw, render_mode
        self.reward_weights = {**REWARD_WEIGHTS, **(reward_weights or {})}
        self._rng, self._steps = np.random.default_rng(), None
        self._scale = 1 / np.array(CUBE_SCALE * (self.distractors + 1) + FINGER_SCALE * 3 + GOAL_SCALE, np.float32)
        self._client = pb.connect(pb.GUI if render_mode == "human" else pb.DIRECT)
        if render_mode == "human":
            pb.configureDebugVisualizer(pb.COV_ENABLE_GUI, 0, physicsClientId=self._client)
            pb.resetDebugVisualizerCamera(0.8, 0, -40, [0, 0, 0.1], physicsClientId=self._client)

    def _build(self):
        """Make floor, wall, robot, cubes and the goal's picture anew."""
        c = {"physicsClientId": self._client}
        pb.resetSimulation(**c)
        pb.setPhysicsEngineParameter(fixedTimeStep=self.timestep, numSolverIterations=8, deterministicOverlappingPairs=1,
                                     enableFileCaching=0, **c)             # or each new world keeps a copy of its URDF for ever
        pb.setGravity(0, 0, -9.81, **c)

        def picture(shape, color, **size):                     # -1: no visual shape, which makes building twice as fast
            return pb.createVisualShape(shape, rgbaColor=color, **size, **c) if self.render_mode else -1

        # useMaximalCoordinates makes a plain rigid body of what would be a one-link multibody: faster to solve.
        table = picture(pb.GEOM_BOX, [0.97, 0.97, 0.97, 1], halfExtents=[2, 2, 0.5])
        # A box, not GEOM_PLANE: Bullet finds one contact a step on a plane, and moving cubes sank 6 mm into it.
        ground = pb.createCollisionShape(pb.GEOM_BOX, halfExtents=[2, 2, 0.5], **c)
        floor = pb.createMultiBody(0, ground, table, [0, 0, -0.5], useMaximalCoordinates=1, **c)
        sides = 12
        edge = (WALL + 0.02) * math.tan(math.pi / sides)
        wall = pb.createCollisionShape(pb.GEOM_BOX, halfExtents=[0.01, edge, 0.1], **c)
        rim = picture(pb.GEOM_BOX, [0.6, 0.62, 0.66, 1], halfExtents=[0.01, edge, 0.006], visualFramePosition=[0, 0, -0.094])
        for a in 2 * math.pi / sides * np.arange(sides):
            pb.createMultiBody(0, wall, rim, [(WALL + 0.01) * math.cos(a), (WALL + 0.01) * math.sin(a), 0.1],
                               pb.getQuaternionFromEuler([0, 0, a]), useMaximalCoordinates=1, **c)
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "trifinger.urdf")
            with open(path, "w") as file:
                file.write(robot_urdf())
            flags = pb.URDF_USE_INERTIA_FROM_FILE | pb.URDF_USE_SELF_COLLISION
            self._robot = pb.loadURDF(path, useFixedBase=1, flags=flags | (0 if self.render_mode else pb.URDF_IGNORE_VISUAL_SHAPES), **c)
        for j in JOINTS:
            pb.changeDynamics(self._robot, j, lateralFriction=FRICTION["finger"], linearDamping=0, angularDamping=0, jointDamping=0, **c)
            if self.render_mode:
                pb.changeVisualShape(self._robot, j, rgbaColor=[(0.25, 0.25, 0.28, 1), (0.35, 0.35, 0.4, 1), (0.15, 0.15, 0.17, 1)][j % 3], **c)
        half = [CUBE / 2] * 3
        shape, skin = pb.createCollisionShape(pb.GEOM_BOX, halfExtents=half, **c), picture(pb.GEOM_BOX, [1, 0, 0, 1], halfExtents=half)
        self._cubes = [pb.createMultiBody(CUBE_MASS, shape, skin, [0, 0, 1 + i], useMaximalCoordinates=1, **c)
                       for i in range(self.distractors + 1)]
        for body, kind in [(floor, "floor")] + [(cube, "cube") for cube in self._cubes]:
            pb.changeDynamics(body, -1, lateralFriction=FRICTION[kind], **c)
        if self.render_mode:
            self._goal_picture = pb.createMultiBody(0, -1, picture(pb.GEOM_BOX, [0.2, 0.8, 0.3, 0.5], halfExtents=half), **c)

    def _place(self):
        """Draw poses (x, y, yaw) of goal and cubes (N+2, 3): goal, target, then the distractors.

        Goal and target come first, inside REACH, so that their law is the same for every N; distractors lie anywhere in
        the arena. Uniform by area, nothing overlaps, nothing lies on the goal or touches a finger. Yaw within 45
        degrees is every yaw of a cube. Where a crowd has jammed (N near 20), distractors are nudged until a gap opens.
        """
        def free(new, others):
            corner = CUBE / math.sqrt(2) * np.exp(1j * (new[:, 2:3] + math.pi / 4 + math.pi / 2 * np.arange(4)))
            inside = (np.abs(new[:, :1] + 1j * new[:, 1:2] + corner) < WALL - 0.001).all(1)
            return inside & ~squares_overlap(new, others).any(1)

        placed, size = [[*forward_kinematics(k, REST)[:2], 0.0, 0.014] for k in range(3)], CUBE / 2 + 0.0005
        for _ in range(200000):
            if len(placed) == 5 + self.distractors:
                return np.array(placed[3:])[:, :3]
            u = self._rng.random((64, 3))
            radius = (REACH if len(placed) < 5 else WALL) * np.sqrt(u[:, 0])
            yaw = self.goal_yaw if len(placed) == 3 else math.pi / 4
            new = np.stack([radius * np.cos(2 * math.pi * u[:, 1]), radius * np.sin(2 * math.pi * u[:, 1]),
                            (2 * u[:, 2] - 1) * yaw, np.full(64, size)], 1)
            ok = free(new, placed)
            if ok.any():
                placed.append(new[ok.argmax()])
            elif len(placed) > 5:
                moved = placed.pop(int(self._rng.integers(5, len(placed))))
                new = np.concatenate([moved + self._rng.normal(size=(64, 4)) * [0.01, 0.01, 0.2, 0.0], [moved]])
                placed.append(new[free(new, placed).argmax()])
        raise ValueError(f"the arena cannot hold {self.distractors + 1} cubes: no free place found")

    def reset(self, *, seed=None, options=None):
        """Start an episode. Returns (observation, info with fractional_success).

        With a `seed` the generator restarts and the world is built anew (about 5 ms), because moving bodies in place
        leaves traces in Bullet's caches: two resets with one seed give bit-equal trajectories. Without a seed the
        bodies are only moved, so an episode then repeats exactly only together with those before it.
        """
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        if seed is not None or self._steps is None:
            self._build()
        c = {"physicsClientId": self._client}
        poses = self._place()
        count = self.distractors + 1
        self.target = int(self._rng.integers(count))
        self._ids = self._rng.choice(IDENTIFIERS, count, replace=False).tolist()
        height = float(self._rng.uniform(CUBE / 2, 0.2)) if self.task == "lift" else CUBE / 2
        x, y, yaw = poses[0].tolist()
        self.goal = ((x, y, height), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
        self._goal_row = (1.0, CUBE, CUBE, CUBE, *self.goal[0], *self.goal[1], self._ids[self.target])
        order = list(range(2, count + 1))
        order.insert(self.target, 1)
        for cube, (x, y, yaw) in zip(self._cubes, poses[order]):
            pb.resetBasePositionAndOrientation(cube, [x, y, CUBE / 2], [0, 0, math.sin(yaw / 2), math.cos(yaw / 2)], **c)
            pb.resetBaseVelocity(cube, [0, 0, 0], [0, 0, 0], **c)
        for j in JOINTS:
            pb.resetJointState(self._robot, j, REST[j % 3], 0.0, **c)
        self._steps = 0
        if self.render_mode:
            self._paint()
        self._read()
        observation = self._observe()
        self._distances = self._measure()
        return observation, {"fractional_success": self._rho}

    def step(self, action):
        """Apply action (9,) in [-1, 1] (beyond: clipped). Returns (observation, reward, terminated, truncated, info).

        ValueError for an action that is not nine finite numbers; RuntimeError before the first reset.
        """
        if self._steps is None:
            raise RuntimeError("call reset() before step()")
        try:
            action = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            action = np.array(np.nan)
        if action.shape != (9,) or not all(map(math.isfinite, action.tolist())):
            raise ValueError(f"action must be nine finite numbers, shape (9,), got {action!r}")
        action = clip(action.tolist(), (-1.0,) * 9, (1.0,) * 9)
        if self.action_mode == "delta":
            targets = [q + 0.3 * a for q, a in zip(self._q, action)]
        else:
            targets = [low + (high - low) * (a + 1) / 2 for a, low, high in zip(action, LOWER * 3, UPPER * 3)]
        c = self._client                                       # passed by place below: keywords cost time at each call
        pb.setJointMotorControlArray(self._robot, JOINTS, pb.POSITION_CONTROL, targetPositions=clip(targets, LOWER * 3, UPPER * 3),
                                     forces=(TORQUE,) * 9, physicsClientId=c)
        for _ in range(self.substeps):
            pb.stepSimulation(c)
        self._steps += 1
        reason = self._read() or ("time" if self._steps >= self.episode_steps else None)
        if reason == "the physics diverged":                   # show the last sound observation; the next reset builds anew
            self._steps = None
            return self._seen, 0.0, False, True, {"fractional_success": 0.0, "fractional_success_strict": 0.0, "truncated_by": reason,
                                                  "rewards": dict.fromkeys(self.reward_weights, 0.0)}
        observation = self._observe()
        last, last_to_goal, last_to_tips = self._distances
        position, to_goal, to_tips = self._distances = self._measure()
        rho, w = self._rho, self.reward_weights
        rewards = {"overlap": w["overlap"] * rho,
                   "distance": w["distance"] * (last_to_goal - to_goal),
                   "curiosity": w["curiosity"] * (1 - rho) ** 0.05 * math.log(math.dist(position, last) + 1e-5),
                   "reach": w["reach"] * (last_to_tips - to_tips)}
        info = {"fractional_success": rho, "rewards": rewards}
        if reason:
            info["truncated_by"], info["fractional_success_strict"] = reason, oriented_overlap(self._poses[self.target], self.goal)
        if self.render_mode == "human":
            time.sleep(self.substeps * self.timestep)
        return observation, sum(rewards.values()), False, reason is not None, info

    def _read(self):
        """Read joints and cubes from the simulator. Returns a reason to cut the episode short, or None."""
        c, reason, flat, self._poses = self._client, None, [], []
        self._q, self._dq, _, _ = zip(*pb.getJointStates(self._robot, JOINTS, c))
        for cube, identifier in zip(self._cubes, self._ids):
            (x, y, z), turn = pose = pb.getBasePositionAndOrientation(cube, c)
            linear, angular = pb.getBaseVelocity(cube, c)
            self._poses.append(pose)
            if turn[3] < 0:                                    # q and -q are the same turn: show one of them
                turn = (-turn[0], -turn[1], -turn[2], -turn[3])
            flat += (1.0, CUBE, CUBE, CUBE, x, y, z, *turn, *linear, *angular, identifier)
            if not (x * x + y * y < (WALL + 0.03) ** 2 and -0.03 < z < 1.0):
                reason = "a cube left the arena"
        self._rows = flat
        # rad/s; full speed of all joints is about 80. Written so that NaN fails it.
        return reason if math.isfinite(sum(flat)) and sum(map(abs, self._dq)) < 1000 else "the physics diverged"

    def _observe(self):
        """The observation of Table 1 from what _read() read, scaled, in fresh arrays; also tips and rho."""
        split, q, dq = len(self._rows), self._q, self._dq
        self._tips = a, b, d = [forward_kinematics(k, q[3 * k:3 * k + 3]) for k in range(3)]
        flat = (*self._rows, *q[:3], *dq[:3], -1.0, *a, *q[3:6], *dq[3:6], 0.0, *b, *q[6:], *dq[6:], 1.0, *d, *self._goal_row)
        flat = np.array(flat, np.float32) * self._scale
        self._rho = aabb_overlap(self._poses[self.target], self.goal)
        self._seen = {"cubes": flat[:split].reshape(-1, 18), "fingers": flat[split:-12].reshape(3, 10), "goal": flat[-12:]}
        return self._seen

    def _measure(self):
        """Target cube's position, its distance to the goal, and the Frobenius norm of (fingertips - cube); all in m."""
        position, (a, b, c) = self._poses[self.target][0], self._tips
        return (position, math.dist(position, self.goal[0]),
                math.hypot(math.dist(a, position), math.dist(b, position), math.dist(c, position)))

    def _paint(self):
        """Move the goal's picture and colour the cubes: target blue, distractors red (Figure 1)."""
        c = {"physicsClientId": self._client}
        for i, cube in enumerate(self._cubes):
            pb.changeVisualShape(cube, -1, rgbaColor=[0.15, 0.35, 0.9, 1] if i == self.target else [0.85, 0.2, 0.2, 1], **c)
        pb.resetBasePositionAndOrientation(self._goal_picture, *self.goal, **c)

    def render(self, width=480, height=360):
        """RGB picture (height, width, 3) uint8 of the arena, drawn on the CPU (TinyRenderer); needs no screen."""
        if self._steps is None or not self.render_mode:
            raise RuntimeError("render() needs render_mode='rgb_array' and a reset() first")
        view = pb.computeViewMatrix([0.0, -0.72, 0.62], [0, 0, 0.1], [0, 0, 1])
        lens = pb.computeProjectionMatrixFOV(45, width / height, 0.05, 3)

        def shot():
            image = pb.getCameraImage(width, height, view, lens, shadow=1, lightDirection=[0.5, -1, 2],
                                      renderer=pb.ER_TINY_RENDERER, physicsClientId=self._client)[2]
            return np.reshape(image, (height, width, 4))[:, :, :3].astype(np.float32)

        image = shot()                                         # TinyRenderer knows no transparency: blend two pictures
        pb.resetBasePositionAndOrientation(self._goal_picture, [0, 0, -1], [0, 0, 0, 1], physicsClientId=self._client)
        image = 0.5 * image + 0.5 * shot()
        pb.resetBasePositionAndOrientation(self._goal_picture, *self.goal, physicsClientId=self._client)
        return image.astype(np.uint8)

    def close(self):
        """Disconnect from PyBullet; calling it twice is harmless."""
        if self._client is not None:
            pb.disconnect(self._client)
            self._client = None


def speed_table(episodes=21, steps=100):
    """Frames/s under random actions, times the bare physics that a step takes and times a step that a reset takes.

    Medians over episodes. The bare physics is timed inside the very same steps, by wrapping stepSimulation.
    """
    bare, clock, physics = pb.stepSimulation, time.perf_counter, []

    def timed(client):
        start = clock()
        bare(client)
        physics.append(clock() - start)

    pb.stepSimulation, rng = timed, np.random.default_rng(0)
    print("   N  control        frames/s  step/physics  reset/step")
    for substeps, timestep in ((5, 0.008), (3, 0.004)):
        for distractors in (0, 2, 5, 9):
            env, rows = TriFingerEnv(distractors=distractors, substeps=substeps, timestep=timestep), []
            env.reset(seed=0)
            for actions in rng.uniform(-1, 1, (episodes, steps, 9)):
                start = clock()
                env.reset()
                reset, spent = clock() - start, 0.0
                physics.clear()
                for action in actions:
                    start = clock()
                    env.step(action)
                    spent += clock() - start
                rows.append((steps / spent, spent / sum(physics), reset / spent * steps))
            env.close()
            rate, share, reset = np.median(rows, 0)
            print(f"{distractors:4d}  {substeps} x {1000 * timestep:.0f} ms {rate:13.0f} {share:13.2f} {reset:11.1f}")
    pb.stepSimulation = bare


if __name__ == "__main__":
    speed_table()
