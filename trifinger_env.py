"""TriFinger with N+1 cubes in PyBullet: PushingCube and LiftingCube (section 4.1, A.1, A.3).

A three-finger robot (9 joints) stands over a round arena with N+1 identical cubes. The goal names
one of them by an identifier; that cube has to reach the goal pose, the other N are distractors.
The robot and the arena are made of primitives by this file: no mesh, no data file. The class has
Gymnasium's signatures; with gymnasium installed it is a gymnasium.Env, and importing this module
registers "TriFingerPush-v0" and "TriFingerLift-v0".

Shapes: observation {"cubes": (N+1, 18), "fingers": (3, 10), "goal": (12,)} float32 (Table 1),
        action (9,) in [-1, 1].
Run:    python trifinger_env.py        one episode of random actions, and frames/s
"""
import itertools
import math
import time
from typing import NamedTuple

import numpy as np
import pybullet as pb

try:
    import gymnasium
    from gymnasium import Env, spaces
except ImportError:                      # the same class without it
    gymnasium, Env, spaces = None, object, None

# The arena
CUBE = 0.065                             # edge of a cube, m
WALL = 0.242                             # inner radius of the arena, m
GAP = 0.001                              # left free between cubes, and to the wall, at the start, m
WALL_SIDES = 12                          # the round wall is made of so many boxes
GRASP_RADIUS = 0.124                     # inside it a finger can get behind a cube, m
OUTSIDE, BELOW, ABOVE = WALL + 0.03, -0.03, 1.0                # beyond them a cube has left, m
CUBE_FRICTION, FLOOR_FRICTION = 1.0, 0.5                       # Bullet multiplies the two in touch
IDENTIFIER_POOL = np.linspace(-1.0, 1.0, 21)                   # fixed: none is new at a larger N
HIGHEST_GOAL = 0.2                       # height of the centre of the highest goal in lifting, m
ITERATIONS = 16                          # of Bullet's solver: with fewer, grips slip (tested)

# The robot: three fingers of three joints each, upper, middle and lower
JOINTS = (0, 1, 2)
BASE = 0.0455                            # radius at which fingers are mounted, m
HEIGHT = 0.329                           # of the fingers' mounts, m: CausalWorld's 0.34 less the
                                         # height of its floor, 0.011
LINK = 0.16                              # length of the middle and the lower link, m
TIP = 0.0095                             # radius of a finger's lower link and tip, m
TIP_HALF_EDGE = 0.014                    # half edge of the cube-free square under a resting tip, m
JOINT_LOW = (-1.57, -1.2, -3.0)          # limits of upper, middle and lower joint, rad
JOINT_HIGH = (1.0, 1.57, 3.0)
REST = (0.0, 0.55, -0.7)                 # at reset, rad: tips hang beside the cubes, 0.034 m high
LEAD = 0.25                              # rad, how far an integrated target may lead its joint
FINGER_YAW = [-math.radians(90 + 120 * k) for k in range(3)]   # heading of finger k
FINGER_MOUNT = [(-BASE * math.cos(yaw), -BASE * math.sin(yaw), HEIGHT) for yaw in FINGER_YAW]
FINGER_SIN_COS = [(math.sin(yaw), math.cos(yaw)) for yaw in FINGER_YAW]

# Upper, middle and lower link as in TriFingerEdu's URDF (the tip is merged into the lower link):
# where its joint sits in the link before it, the joint's axis, mass, centre of mass, inertia.
KNEE, TIP_PLACE = (0.0, -0.03745, -LINK), (0.0, -0.008, -LINK)
JOINT_PLACE = ((0.0, 0.0, 0.0), (0.0, -0.014, 0.0), KNEE)                  # m
JOINT_AXIS = ((-1, 0, 0), (0, 1, 0), (0, 1, 0))
MASS = (0.14854, 0.14854, 0.0407)                                          # kg
CENTRE_OF_MASS = ((-0.079, 0.0, 0.0), (0.0, -0.019, -0.079), (0.0, -0.00875, -0.1065))     # m
INERTIA = ((3e-5, 4.1e-4, 4.1e-4), (4.1e-4, 4.1e-4, 3e-5), (1.6e-4, 1.6e-4, 1e-5))     # kg m^2
OFFSET = 0.05945                         # how far a tip stands beside its finger's plane, m: the
                                         # sideways parts of JOINT_PLACE and TIP_PLACE, added up

# The motors. Bullet's own aims at a speed of GAIN x (target - angle), with at most TORQUE.
GAIN = 12.5                              # 1/s
TORQUE = 0.36                            # N m
# CausalWorld's is a torque KP (target - angle) - KD speed, cut to TORQUE, less DAMPING x speed, cut
# again. So a joint reaches TORQUE / DAMPING at most, in rad/s.
KP, KD, DAMPING = 10.0, (0.1, 0.3, 0.001), (0.08, 0.08, 0.04)

# Columns of an observation's rows (Table 1). In action_mode "integrated" a fingertip is shown where
# the joint targets would hold it: the agent has to see those targets somewhere, and where the
# fingertip really is follows from the joints' angles anyway.
SIZE, POSITION, QUATERNION = slice(1, 4), slice(4, 7), slice(7, 11)        # of a cube and the goal
LINEAR, ANGULAR = slice(11, 14), slice(14, 17)                             # of a cube
IDENTIFIER = -1                                                            # of a cube and the goal
FINGER_IDENTIFIER, FINGERTIP = 6, slice(7, 10)                             # of a finger

# What each column is divided by to be of order 1: fixed numbers, so that nothing here depends on N.
POSITION_SCALE = 0.2                     # m
POSE_SCALE = [1] + [CUBE] * 3 + [POSITION_SCALE] * 3 + [1] * 4             # type size pos quat
CUBE_SCALE = POSE_SCALE + [0.5] * 3 + [10] * 3 + [1]                       # ... v omega id
GOAL_SCALE = POSE_SCALE + [1]                                              # ... id
FINGER_SCALE = [1.5] * 3 + [10] * 3 + [1] + [POSITION_SCALE] * 3           # q dq id tip
CUBE_WIDTH, FINGER_WIDTH, GOAL_WIDTH = len(CUBE_SCALE), len(FINGER_SCALE), len(GOAL_SCALE)

# Equation 2 (A.1); "reach" is ours. A term of your own: its weight here, its formula in _rewards().
REWARD_WEIGHTS = {"overlap": 100.0, "distance": 5000.0, "curiosity": 0.0, "reach": 2500.0}
BETA = 0.05                              # exponent of the curiosity term
SOLVED = 0.8                             # fractional success from which a task counts as solved
TIME, LEFT, DIVERGED = "time", "a cube left the arena", "the physics diverged"     # truncated_by


# ---- geometry

def forward_kinematics(k, q):
    """Fingertip (x, y, z) in m of finger k at joint angles q (3,) in rad, in the world frame."""
    q0, q1, q2 = q
    s0, c0 = math.sin(q0), math.cos(q0)
    x = -LINK * (math.sin(q1) + math.sin(q1 + q2)) - BASE
    depth = -LINK * (math.cos(q1) + math.cos(q1 + q2))         # in the finger's plane, negative
    y = -OFFSET * c0 + depth * s0
    z = OFFSET * s0 + depth * c0
    s, c = FINGER_SIN_COS[k]                                   # turn by the finger's heading
    return c * x - s * y, s * x + c * y, z + HEIGHT


def fingertips(q):
    """The three fingertips at joint angles q (9,), finger by finger."""
    return [forward_kinematics(k, q[3 * k:3 * k + 3]) for k in range(3)]


def clip(values, low, high):
    """Values limited to [low, high] one by one; on nine numbers plain python beats numpy."""
    return [lo if v < lo else hi if v > hi else v for v, lo, hi in zip(values, low, high)]


def yaw_quaternion(yaw):
    """Quaternion (x, y, z, w) of a turn by `yaw` rad about the vertical axis."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def rotation(quaternion):
    """Rotation matrix (3, 3) of a unit quaternion (x, y, z, w)."""
    return np.reshape(pb.getMatrixFromQuaternion(quaternion), (3, 3))


def aabb_half_extents(quaternion):
    """Half edges (3,) in m of the axis-aligned box around a cube turned by `quaternion`."""
    # CUBE / 2 times the row sums of |R|, written out: plain python, for speed.
    x, y, z, w = quaternion
    return (CUBE * (abs(0.5 - y * y - z * z) + abs(x * y - z * w) + abs(x * z + y * w)),
            CUBE * (abs(x * y + z * w) + abs(0.5 - x * x - z * z) + abs(y * z - x * w)),
            CUBE * (abs(x * z - y * w) + abs(y * z + x * w) + abs(0.5 - x * x - y * y)))


def aabb_overlap(cube, goal):
    """Fractional success rho as CausalWorld measures it, in [0, 1].

    rho = vol(AABB(goal) and AABB(cube)) / vol(AABB(goal)), the volume that both boxes share in the
    numerator; `cube` and `goal` are (position (3,), quaternion (4,)). It is lenient: turning the
    cube only makes its box larger.
    """
    share = 1.0
    halves = aabb_half_extents(cube[1]), aabb_half_extents(goal[1])
    for at_cube, at_goal, half_cube, half_goal in zip(cube[0], goal[0], *halves):
        low = max(at_cube - half_cube, at_goal - half_goal)
        high = min(at_cube + half_cube, at_goal + half_goal)
        share *= max(high - low, 0.0) / (2 * half_goal)
    return min(share, 1.0)


ALONG = CUBE * ((np.arange(20) + 0.5) / 20 - 0.5)              # 20 points along a cube's edge, m
GRID = np.stack(np.meshgrid(ALONG, ALONG, ALONG), axis=-1).reshape(-1, 3)  # 8000 points in a cube


def oriented_overlap(cube, goal):
    """The strict form of rho: share of the goal cube's true volume that the cube covers.

    That is the share of a grid's points in the goal cube which lie in the cube, too.
    """
    points = GRID @ rotation(goal[1]).T + goal[0]              # in the world
    in_cube = (points - cube[0]) @ rotation(cube[1])           # in the frame of the cube
    return float((np.abs(in_cube) <= CUBE / 2).all(axis=1).mean())


def squares_overlap(a, b):
    """(n, m) bool: does square i of a (n, 4) touch square j of b (m, 4)?

    Rows are x, y, yaw, half edge. Two squares are apart if, along the direction of some edge of
    either, their projections do not meet (separating axes).
    """
    a, b = np.asarray(a)[:, None], np.asarray(b)[None]         # (n, 1, 4), (1, m, 4)
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    between = b[..., 2] - a[..., 2]
    # Turned by `between`, a square of half edge h reaches h (|cos| + |sin|) along the other's edge.
    widening = np.abs(np.cos(between)) + np.abs(np.sin(between))
    apart = np.zeros(dx.shape, bool)
    for square, own, other in ((a, a[..., 3], b[..., 3]), (b, b[..., 3], a[..., 3])):
        cos, sin = np.cos(square[..., 2]), np.sin(square[..., 2])
        for along in (cos * dx + sin * dy, cos * dy - sin * dx):
            apart |= np.abs(along) > own + other * widening
    return ~apart


def are_free(squares, placed):
    """(n,) bool: which squares touch neither the wall nor one that is placed already?"""
    quarter = math.pi / 4 + math.pi / 2 * np.arange(4)         # corners: CUBE / sqrt(2) from x, y
    angle = squares[:, 2:3] + quarter                          # (n, 4)
    x = squares[:, :1] + CUBE / math.sqrt(2) * np.cos(angle)
    y = squares[:, 1:2] + CUBE / math.sqrt(2) * np.sin(angle)
    is_inside = (np.hypot(x, y) < WALL - GAP).all(1)
    return is_inside & ~squares_overlap(squares, placed).any(1)


# ---- the environment

class Moment(NamedTuple):
    """What the reward compares between two steps; lengths in m."""
    tips: list                           # three fingertips (3,), world frame
    position: tuple                      # target cube's centre (3,)
    rho: float                           # fractional success
    to_goal: float                       # distance from target cube to goal
    to_tips: float                       # Frobenius norm of (fingertips - target cube)


class TriFingerEnv(Env):
    """PushingCube (task="push") or LiftingCube (task="lift") with `distractors` + 1 cubes.

    distractors     N, 0 to 20
    episode_steps   actions in an episode; the same for every N, or N would change the task
    substeps, timestep   physics steps per action and their length in s: the control rate is
                    1 / (substeps * timestep), 25 Hz by default. The paper's 83.3 Hz and 30 s:
                    episode_steps=2500, substeps=3, timestep=0.004.
    action_mode     "integrated": joint target = last target + action_scale * action (rad), so that
                    a zero action keeps a grip; at most LEAD away from the measured angle;
                    "absolute": the action spans the joint range, action_scale has no effect
    motor           what draws the joints to their targets: "position", Bullet's motor, or "torque",
                    CausalWorld's law, anew in every physics step (it needs steps of 4 ms)
    cube_mass       kg
    finger_friction of a finger; times that of what it touches (cube 1.0, floor 0.5) in Bullet
    goal_yaw        goal's largest yaw in rad. With 0 rho asks for the position only.
    reward_weights  weights that replace those of REWARD_WEIGHTS, by name (equation 2, A.1)
    render_mode     None, "rgb_array" (headless), or "human" (PyBullet's window, in real time)

    info holds fractional_success (axis-aligned, as in CausalWorld) and rewards, the weighted terms,
    which add up to the reward. At an episode's last step it also holds fractional_success_strict
    (oriented) and truncated_by: "time", "a cube left the arena", or "the physics diverged" (then
    with the last sound observation, reward 0 and success 0). An episode never terminates, it is
    truncated. ValueError, in one line, for arguments that it does not know.
    """
    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 25}

    # Without train.py these defaults count; with it SETTINGS, which are the same (tested).
    def __init__(self, task="push", distractors=2, *, episode_steps=125, substeps=5,
                 timestep=0.008, action_mode="integrated", action_scale=0.1, motor="position",
                 cube_mass=0.08, finger_friction=1.0, goal_yaw=0.0, reward_weights=None,
                 render_mode=None):
        self._client = None
        for name, got, known in (("task", task, ("push", "lift")),
                                 ("action_mode", action_mode, ("integrated", "absolute")),
                                 ("motor", motor, ("position", "torque")),
                                 ("render_mode", render_mode, (None, "rgb_array", "human"))):
            if got not in known:
                raise ValueError(f"{name} must be one of {known}, got {got!r}")
        if distractors not in range(len(IDENTIFIER_POOL)):
            raise ValueError(f"the arena holds 21 cubes: distractors must be an integer from 0 to "
                             f"20, got {distractors!r}")
        sizes = (episode_steps, substeps, timestep, cube_mass, finger_friction)
        if not all(0 < size < math.inf for size in sizes) or not 0 <= goal_yaw < math.inf:
            raise ValueError("episode_steps, substeps, timestep, cube_mass and finger_friction "
                             "must be positive, goal_yaw at least 0")
        self.task, self.distractors = task, int(distractors)
        self.episode_steps, self.substeps, self.timestep = episode_steps, substeps, timestep
        self.action_mode, self.action_scale, self.motor = action_mode, action_scale, motor
        self.cube_mass, self.finger_friction = cube_mass, finger_friction
        self.goal_yaw = goal_yaw
        self.reward_weights = {**REWARD_WEIGHTS, **(reward_weights or {})}
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / (substeps * timestep))}
        # The state: _joint_targets (9), _q and _dq (9) measured; _poses and _ids of the cubes,
        # target (index of a cube), goal (its pose); _moment for the reward of the next step.
        self._np_random = np.random.default_rng()              # Gymnasium's name for it
        self._steps = None                                     # None: reset() has to come first
        scale = CUBE_SCALE * (self.distractors + 1) + FINGER_SCALE * 3 + GOAL_SCALE
        self._scale = 1 / np.array(scale, np.float32)
        if spaces is not None:
            shapes = {"cubes": (self.distractors + 1, CUBE_WIDTH),
                      "fingers": (3, FINGER_WIDTH), "goal": (GOAL_WIDTH,)}
            self.observation_space = spaces.Dict({
                key: spaces.Box(-np.inf, np.inf, shape, np.float32)
                for key, shape in shapes.items()})
            self.action_space = spaces.Box(-1.0, 1.0, (9,), np.float32)
        self._client = pb.connect(pb.GUI if render_mode == "human" else pb.DIRECT)
        self._world = {"physicsClientId": self._client}        # last argument of PyBullet's calls
        if render_mode == "human":
            pb.configureDebugVisualizer(pb.COV_ENABLE_GUI, 0, **self._world)
            pb.resetDebugVisualizerCamera(0.6, 0, -40, [0, 0, 0.1], **self._world)

    def __reduce__(self):
        """TypeError: a copy would share the physics world, which lives in PyBullet."""
        raise TypeError("a TriFingerEnv cannot be copied or pickled: make another one")

    # ---- building the world

    def _build(self):
        """Make floor, wall, robot, cubes and the goal's picture anew."""
        pb.resetSimulation(**self._world)
        pb.setPhysicsEngineParameter(fixedTimeStep=self.timestep, numSolverIterations=ITERATIONS,
                                     deterministicOverlappingPairs=1, **self._world)
        pb.setGravity(0, 0, -9.81, **self._world)
        self._build_arena()
        self._fingers = [self._build_finger(mount, yaw_quaternion(yaw))
                         for mount, yaw in zip(FINGER_MOUNT, FINGER_YAW)]
        self._build_cubes()

    def _skin(self, color, half_extents, **place):
        """Visual shape of a box; without pictures -1, none, which makes building twice as fast."""
        if not self.render_mode:
            return -1
        return pb.createVisualShape(pb.GEOM_BOX, halfExtents=half_extents, rgbaColor=color,
                                    **place, **self._world)

    def _box(self, half_extents):
        """Collision shape of a box."""
        return pb.createCollisionShape(pb.GEOM_BOX, halfExtents=half_extents, **self._world)

    def _body(self, mass, shape, skin, position, quaternion=(0, 0, 0, 1)):
        """A rigid body. useMaximalCoordinates: a plain one, which Bullet solves faster."""
        return pb.createMultiBody(mass, shape, skin, position, quaternion,
                                  useMaximalCoordinates=1, **self._world)

    def _build_arena(self):
        # A box, not GEOM_PLANE: Bullet finds one contact a step on a plane, and moving cubes sank.
        table = [2, 2, 0.5]
        white = self._skin([0.97, 0.97, 0.97, 1], table)
        floor = self._body(0, self._box(table), white, [0, 0, -0.5])
        pb.changeDynamics(floor, -1, lateralFriction=FLOOR_FRICTION, **self._world)

        edge = (WALL + 0.02) * math.tan(math.pi / WALL_SIDES)
        wall = self._box([0.01, edge, 0.1])
        rim = self._skin([0.6, 0.62, 0.66, 1], [0.01, edge, 0.006],
                         visualFramePosition=[0, 0, -0.094])
        for side in range(WALL_SIDES):
            angle = 2 * math.pi / WALL_SIDES * side
            middle = [(WALL + 0.01) * math.cos(angle), (WALL + 0.01) * math.sin(angle), 0.1]
            self._body(0, wall, rim, middle, yaw_quaternion(angle))

    def _build_finger(self, mount, quaternion):
        """One finger, of whose links only the lower one can touch things.

        Bullet solves three bodies of three joints faster than one of nine.
        """
        touching = pb.createCollisionShape(
            pb.GEOM_CAPSULE, radius=TIP, height=LINK,
            collisionFramePosition=[0, -0.008, -LINK / 2], **self._world)
        base, *skins = self._finger_skins()
        finger = pb.createMultiBody(
            0, -1, base, mount, quaternion, linkMasses=MASS,
            linkCollisionShapeIndices=[-1, -1, touching], linkVisualShapeIndices=skins,
            linkPositions=JOINT_PLACE, linkOrientations=[(0, 0, 0, 1)] * 3,
            linkInertialFramePositions=CENTRE_OF_MASS,
            linkInertialFrameOrientations=[(0, 0, 0, 1)] * 3, linkParentIndices=[0, 1, 2],
            linkJointTypes=[pb.JOINT_REVOLUTE] * 3, linkJointAxis=JOINT_AXIS, **self._world)
        for j in JOINTS:
            pb.changeDynamics(finger, j, localInertiaDiagonal=INERTIA[j],
                              lateralFriction=self.finger_friction, jointLowerLimit=JOINT_LOW[j],
                              jointUpperLimit=JOINT_HIGH[j], linearDamping=0, angularDamping=0,
                              jointDamping=0, **self._world)
        if self.motor == "torque":                             # Bullet's own motors off
            pb.setJointMotorControlArray(finger, JOINTS, pb.VELOCITY_CONTROL, forces=[0] * 3,
                                         **self._world)
        if self.render_mode:
            orange, metal, black = (0.95, 0.55, 0.15, 1), (0.45, 0.47, 0.52, 1), (0.2, 0.2, 0.23, 1)
            for link, color in zip((-1, *JOINTS), (metal, black, metal, orange)):
                pb.changeVisualShape(finger, link, rgbaColor=color, **self._world)
        return finger

    def _finger_skins(self):
        """Visual shapes of base, upper, middle and lower link: a ball, and a bar from it."""
        if not self.render_mode:
            return [-1] * 4
        bars = (((BASE, 0, 0), 0.018, 0.018),                  # end, radii of bar and ball, m
                ((-0.10, 0, 0), 0.017, 0.021),
                (KNEE, 0.013, 0.019),
                (TIP_PLACE, TIP, 0.016))
        skins = []
        for (x, y, z), radius, ball in bars:
            length = math.hypot(x, y, z)
            along = pb.getQuaternionFromEuler([0, math.acos(z / length), math.atan2(y, x)])
            skins.append(pb.createVisualShapeArray(
                [pb.GEOM_CAPSULE, pb.GEOM_SPHERE], radii=[radius, ball], lengths=[length, 0],
                visualFramePositions=[[x / 2, y / 2, z / 2], [0, 0, 0]],
                visualFrameOrientations=[along, (0, 0, 0, 1)], **self._world))
        return skins

    def _build_cubes(self):
        half = [CUBE / 2] * 3
        shape = self._box(half)
        skin = self._skin([1, 0, 0, 1], half)
        self._cubes = []
        for i in range(self.distractors + 1):
            cube = self._body(self.cube_mass, shape, skin, [0, 0, 1 + i])
            pb.changeDynamics(cube, -1, lateralFriction=CUBE_FRICTION, **self._world)
            self._cubes.append(cube)
        if self.render_mode:
            self._goal_picture = pb.createMultiBody(0, -1, self._frame(), **self._world)
            green = [0.1, 0.65, 0.25, 1]
            pb.changeVisualShape(self._goal_picture, -1, rgbaColor=green, **self._world)

    def _frame(self):
        """Visual shape of the goal: the twelve edges of a cube, visible with a cube inside, too."""
        half, thin = CUBE / 2, 0.0025
        places = [np.insert(ends, axis, 0.0)
                  for axis in range(3) for ends in itertools.product((-half, half), repeat=2)]
        sizes = np.repeat(thin + half * np.eye(3), 4, axis=0)  # four bars along each axis
        return pb.createVisualShapeArray([pb.GEOM_BOX] * 12, halfExtents=sizes.tolist(),
                                         visualFramePositions=places, **self._world)

    # ---- the start of an episode

    def _place(self):
        """Draw poses (x, y, yaw) of goal, target and distractors, in this order: (N+2, 3).

        Goal and target come first, inside GRASP_RADIUS, so that their distribution is the same for
        all N; distractors lie anywhere in the arena. All uniform by area, but for distractors that
        were nudged; nothing overlaps, nothing lies on the goal or touches a finger.
        """
        placed = [[*forward_kinematics(k, REST)[:2], 0.0, TIP_HALF_EDGE] for k in range(3)]
        self._add_square(placed, GRASP_RADIUS, self.goal_yaw)              # the goal
        self._add_square(placed, GRASP_RADIUS, math.pi / 4)                # the target
        for _ in range(self.distractors):
            self._add_square(placed, WALL, math.pi / 4)
        return np.array(placed[3:])[:, :3]

    def _add_square(self, placed, radius, yaw):
        """Add a free square to `placed`: rows x, y, yaw, half edge of 3 fingers, goal, target, ...

        Where a crowd has jammed, distractors are nudged until a gap opens: in some episodes from
        N = 9 on, in nearly all at 14.
        """
        fixed = 5                                              # fingers, goal, target: never nudged
        for _ in range(100_000):                               # a few, except in a crowd
            new = self._draw_squares(radius, yaw)
            free = are_free(new, placed)
            if free.any():
                placed.append(new[free.argmax()])
                return
            if len(placed) > fixed:
                moved = placed.pop(int(self._np_random.integers(fixed, len(placed))))
                steps = self._np_random.normal(size=(64, 4)) * [0.01, 0.01, 0.2, 0.0]   # m, m, rad
                new = np.concatenate([moved + steps, [moved]])             # at worst: back again
                placed.append(new[are_free(new, placed).argmax()])
        raise ValueError(f"the arena cannot hold {self.distractors + 1} cubes: no free place found")

    def _draw_squares(self, radius, yaw, count=64):
        """(count, 4) candidates, uniform in the disc; a yaw within 45 degrees is every yaw."""
        u = self._np_random.random((count, 3))
        r = radius * np.sqrt(u[:, 0])                          # uniform by area
        angle = 2 * math.pi * u[:, 1]
        half = (CUBE + GAP) / 2
        return np.stack([r * np.cos(angle), r * np.sin(angle), (2 * u[:, 2] - 1) * yaw,
                         np.full(count, half)], axis=1)

    def reset(self, *, seed=None, options=None):
        """Start an episode. Returns (observation, info with fractional_success).

        With a `seed` the world is built anew (about 5 ms), because moving bodies in place leaves
        traces in Bullet's caches: two resets with one seed give bit-equal trajectories. Without a
        seed an episode repeats exactly only together with those before it.
        """
        if self._client is None:                               # Bullet would use another's world
            raise RuntimeError("this environment is closed: make another one")
        if seed is not None:
            self._np_random = np.random.default_rng(seed)
            self._np_random_seed = seed
        if seed is not None or self._steps is None:
            self._build()
        goal, *cubes = self._place().tolist()
        count = len(cubes)
        self.target = int(self._np_random.integers(count))
        self._ids = self._np_random.choice(IDENTIFIER_POOL, count, replace=False).tolist()
        height = CUBE / 2
        if self.task == "lift":
            height = float(self._np_random.uniform(CUBE / 2, HIGHEST_GOAL))
        self.goal = (goal[0], goal[1], height), yaw_quaternion(goal[2])
        identifier = self._ids[self.target]
        self._goal_row = (1.0, CUBE, CUBE, CUBE, *self.goal[0], *self.goal[1], identifier)
        target_pose, *poses = cubes
        poses.insert(self.target, target_pose)
        for cube, (x, y, yaw) in zip(self._cubes, poses):
            pb.resetBasePositionAndOrientation(cube, [x, y, CUBE / 2], yaw_quaternion(yaw),
                                               **self._world)
            pb.resetBaseVelocity(cube, [0, 0, 0], [0, 0, 0], **self._world)
        for finger in self._fingers:
            for j in JOINTS:
                pb.resetJointState(finger, j, REST[j], 0.0, **self._world)
        self._joint_targets = list(REST * 3)
        self._steps = 0
        if self.render_mode:
            self._paint()
        self._read()
        self._moment = self._measure()
        return self._observe(), {"fractional_success": self._moment.rho}

    # ---- a step

    def step(self, action):
        """Apply action (9,) in [-1, 1] (beyond: clipped).

        Returns (observation, reward, terminated, truncated, info). RuntimeError if reset() has to
        come first: at the beginning, and after the physics diverged.
        """
        if self._steps is None:
            raise RuntimeError("call reset() before step()")
        action = np.asarray(action, np.float64).reshape(9).tolist()
        action = clip(action, (-1.0,) * 9, (1.0,) * 9)
        self._joint_targets = self._targets_after(action)
        self._drive()
        self._steps += 1
        reason = self._read()
        if reason == DIVERGED:
            return self._diverged()
        if reason is None and self._steps >= self.episode_steps:
            reason = TIME
        before, self._moment = self._moment, self._measure()
        rewards = self._rewards(before, self._moment, action)
        info = {"fractional_success": self._moment.rho, "rewards": rewards}
        if reason is not None:
            info["truncated_by"] = reason
            strict = oriented_overlap(self._poses[self.target], self.goal)
            info["fractional_success_strict"] = strict
        if self.render_mode == "human":
            time.sleep(self.substeps * self.timestep)
        return self._observe(), sum(rewards.values()), False, reason is not None, info

    def _targets_after(self, action):
        """Joint targets (9,) in rad that an action asks for."""
        if self.action_mode == "integrated":
            # The target stays where it was put, so the motor keeps pressing and a grip lasts.
            moved = [target + self.action_scale * a
                     for target, a in zip(self._joint_targets, action)]
            targets = clip(moved, [q - LEAD for q in self._q], [q + LEAD for q in self._q])
        else:                                                  # from [-1, 1] to the joint range
            targets = [low + (high - low) * (a + 1) / 2
                       for a, low, high in zip(action, JOINT_LOW * 3, JOINT_HIGH * 3)]
        return clip(targets, JOINT_LOW * 3, JOINT_HIGH * 3)

    def _drive(self):
        """Let the physics run for one action with the joints drawn to their targets."""
        client, targets = self._client, self._joint_targets
        if self.motor == "position":
            gains = (GAIN * self.timestep,) * 3                # Bullet's are per physics step
            for k, finger in enumerate(self._fingers):
                pb.setJointMotorControlArray(
                    finger, JOINTS, pb.POSITION_CONTROL, targetPositions=targets[3 * k:3 * k + 3],
                    positionGains=gains, forces=(TORQUE,) * 3, physicsClientId=client)
        for _ in range(self.substeps):
            if self.motor == "torque":
                self._apply_torques()
            pb.stepSimulation(client)

    def _apply_torques(self):
        """CausalWorld's law, for one physics step."""
        low, high = (-TORQUE,) * 3, (TORQUE,) * 3
        for k, finger in enumerate(self._fingers):
            targets = self._joint_targets[3 * k:3 * k + 3]
            states = pb.getJointStates(finger, JOINTS, self._client)
            q, dq, _, _ = zip(*states)
            wanted = [KP * (target - angle) - kd * speed
                      for target, angle, kd, speed in zip(targets, q, KD, dq)]
            damped = [u - damping * speed
                      for u, damping, speed in zip(clip(wanted, low, high), DAMPING, dq)]
            pb.setJointMotorControlArray(finger, JOINTS, pb.TORQUE_CONTROL,
                                         forces=clip(damped, low, high),
                                         physicsClientId=self._client)

    def _read(self):
        """Read joints (_q, _dq) and cubes (_poses, _cube_rows) from the simulator.

        Returns why the episode must end, or None.
        """
        client = self._client                                  # faster than **self._world
        reason = None
        states = [state for finger in self._fingers
                  for state in pb.getJointStates(finger, JOINTS, client)]
        self._q, self._dq, _, _ = zip(*states)
        self._poses, rows = [], []
        for cube, identifier in zip(self._cubes, self._ids):
            pose = pb.getBasePositionAndOrientation(cube, client)
            linear, angular = pb.getBaseVelocity(cube, client)
            self._poses.append(pose)
            (x, y, z), (qx, qy, qz, qw) = pose
            if qw < 0:                                         # q and -q are one turn: show one
                qx, qy, qz, qw = -qx, -qy, -qz, -qw
            rows += (1.0, CUBE, CUBE, CUBE, x, y, z, qx, qy, qz, qw, *linear, *angular, identifier)
            if not (x * x + y * y < OUTSIDE ** 2 and BELOW < z < ABOVE):
                reason = LEFT
        self._cube_rows = rows
        # 1000 rad/s is far above any real speed. Written so that NaN fails it, too.
        if math.isfinite(sum(rows)) and sum(map(abs, self._dq)) < 1000:
            return reason
        return DIVERGED

    def _measure(self):
        """The Moment of what _read() read."""
        tips = fingertips(self._q)
        pose = self._poses[self.target]
        position = pose[0]
        a, b, c = tips
        to_tips = math.hypot(math.dist(a, position), math.dist(b, position), math.dist(c, position))
        to_goal = math.dist(position, self.goal[0])
        return Moment(tips, position, aabb_overlap(pose, self.goal), to_goal, to_tips)

    def _observe(self):
        """The observation of Table 1 from what _read() read, scaled, in fresh arrays.

        It is kept: _diverged() shows it again.
        """
        q, dq = self._q, self._dq
        is_integrated = self.action_mode == "integrated"
        a, b, c = fingertips(self._joint_targets) if is_integrated else self._moment.tips
        flat = (*self._cube_rows,                              # (N+1) x 18
                *q[:3], *dq[:3], -1.0, *a,                     # 3 x 10: q dq identifier tip
                *q[3:6], *dq[3:6], 0.0, *b,
                *q[6:], *dq[6:], 1.0, *c,
                *self._goal_row)                               # 12
        flat = np.array(flat, np.float32) * self._scale
        split = len(self._cube_rows)
        self._last_observation = {
            "cubes": flat[:split].reshape(-1, CUBE_WIDTH),
            "fingers": flat[split:-GOAL_WIDTH].reshape(3, FINGER_WIDTH),
            "goal": flat[-GOAL_WIDTH:],
        }
        return self._last_observation

    def _rewards(self, before, now, action):
        """Equation 2 (A.1) term by term, weighted; "reach" is ours.

            overlap     rho_t
            distance    d(o_{t-1}, g) - d(o_t, g): pays for moving closer (printed: away)
            curiosity   (1 - rho_t)^beta log(d(o_t, o_{t-1}) + 1e-5)
            reach       ||tips_{t-1} - o_{t-1}|| - ||tips_t - o_t||: pays for tips nearer the cube

        `before` and `now` are Moments; no term looks at the action (9,), one of yours may.
        """
        moved = math.dist(now.position, before.position)
        far = (1 - now.rho) ** BETA                            # about 1 until the cube is there
        terms = {
            "overlap": now.rho,
            "distance": before.to_goal - now.to_goal,
            "curiosity": far * math.log(moved + 1e-5),
            "reach": before.to_tips - now.to_tips,
        }
        return {name: self.reward_weights[name] * terms[name]  # KeyError: no weight, or no formula
                for name in self.reward_weights | terms}

    def _diverged(self):
        """Last step of an episode whose state is no longer numbers: the next reset builds anew."""
        self._steps = None
        info = {"fractional_success": 0.0, "fractional_success_strict": 0.0,
                "truncated_by": DIVERGED, "rewards": dict.fromkeys(self.reward_weights, 0.0)}
        return self._last_observation, 0.0, False, True, info

    # ---- pictures

    def _paint(self):
        """Show the goal and colour the cubes as in figure 1: target blue, distractors red."""
        for i, cube in enumerate(self._cubes):
            color = [0.15, 0.35, 0.9, 1] if i == self.target else [0.85, 0.2, 0.2, 1]
            pb.changeVisualShape(cube, -1, rgbaColor=color, **self._world)
        pb.resetBasePositionAndOrientation(self._goal_picture, *self.goal, **self._world)

    def render(self, width=480, height=360):
        """RGB picture (height, width, 3) uint8 of the arena, drawn on the CPU; needs no screen.

        With "human" None, as in Gymnasium: the window shows it. RuntimeError without a render_mode,
        or if reset() has to come first.
        """
        if self._steps is None or not self.render_mode:
            raise RuntimeError("render() needs render_mode='rgb_array' and a reset() first")
        if self.render_mode == "human":
            return None
        view = pb.computeViewMatrix([0.0, -0.62, 0.74], [0, 0, 0.09], [0, 0, 1])
        lens = pb.computeProjectionMatrixFOV(38, width / height, 0.05, 3)
        _, _, image, _, _ = pb.getCameraImage(                 # twice the size, for smooth edges
            2 * width, 2 * height, view, lens, shadow=1, lightDirection=[0.5, -1, 2],
            renderer=pb.ER_TINY_RENDERER, **self._world)
        blocks = np.reshape(image, (height, 2, width, 2, 4))[..., :3]
        return blocks.mean((1, 3)).astype(np.uint8)

    def close(self):
        """Disconnect from PyBullet; calling it twice is harmless, any other use then an error."""
        if self._client is not None:
            pb.disconnect(self._client)
        self._client = self._steps = None


if gymnasium is not None:                # gymnasium.make("TriFingerLift-v0", distractors=2)
    gymnasium.register("TriFingerPush-v0", TriFingerEnv, kwargs={"task": "push"})
    gymnasium.register("TriFingerLift-v0", TriFingerEnv, kwargs={"task": "lift"})


if __name__ == "__main__":
    env = TriFingerEnv("push", distractors=2)
    observation, info = env.reset(seed=0)
    print({key: value.shape for key, value in observation.items()})
    rng, begin, truncated = np.random.default_rng(0), time.perf_counter(), False
    while not truncated:
        observation, reward, _, truncated, info = env.step(rng.uniform(-1, 1, 9))
    rate = env.episode_steps / (time.perf_counter() - begin)
    print(f"{info}\n{rate:.0f} frames/s")
