"""Worlds of robots with an arm as the kernels' arrays, and what the arm's geometry is in plain NumPy."""

import dataclasses
import math

import numpy as np
import warp as wp
from deimos.kernels.episodes import make_worlds
from deimos.kernels.legged.arm import evaluate_arms, reset_arms
from deimos.kernels.legged.arm_goals import (
    ARM,
    SHELL_HIGH,
    SHELL_LOW,
    Arm,
    check_arm,
    end_effector,
    goal_of_place,
    is_clear,
    place_of_goal,
)
from deimos.kernels.legged.arm_rewards import ARM_TERMS, ArmWeights, vecA
from deimos.kernels.legged.state import NUM_COLUMNS, TABLES, LeggedWorlds, LocomotionParams, build, make_params, sizes

from deimos.sim.legged.robots import go1_rx150 as rx150

J, G, OBS_START, OBS, POINTS = 17, 6, 66, 76, 7
TIP = slice(OBS_START, OBS_START + 3)  # of the observation: the end effector
DT, CELL, CORNER = 0.02, 0.1, (-6.0, -8.0)
GARBAGE = 7.0
OFFSETS = np.array(rx150.OFFSETS) + np.array([rx150.MOUNT, *[(0.0, 0.0, 0.0)] * 5])
AXES = np.array([[float(axis == each) for each in "xyz"] for axis in rx150.AXES])
ORIGIN = np.add(rx150.SHOULDER, (0.0, 0.0, 0.325))
BODY_LOW, BODY_HIGH = np.array([-0.3, -0.2, -9.0]), np.array([0.3, 0.2, -0.06])
MIDDLE, HALF = (np.array(SHELL_HIGH) + SHELL_LOW) / 2, (np.array(SHELL_HIGH) - SHELL_LOW) / 2


@wp.kernel
def _geometry(
    arm: Arm,
    qpos: wp.array2d[float],
    goal: wp.array[wp.vec3],
    tip: wp.array[wp.vec3],
    place: wp.array[wp.vec3],
    back: wp.array[wp.vec3],
    clear: wp.array[wp.bool],
):
    i = wp.tid()
    tip[i] = end_effector(arm, qpos, i)
    place[i] = place_of_goal(goal[i])
    back[i] = goal_of_place(place[i])
    clear[i] = is_clear(arm, goal[i])


def make_arm(device, low=BODY_LOW, high=BODY_HIGH, n=1):
    """The ReactorX-150 on a Go1, with some box to keep out of."""
    arm = build(ARM, device, offset=OFFSETS, axis=AXES, error=np.full(n, GARBAGE))
    arm.origin, arm.body_low, arm.body_high = wp.vec3(*ORIGIN), wp.vec3(*low), wp.vec3(*high)
    arm.weight, arm.obs_start, arm.clearance = vecA(*dataclasses.astuple(ArmWeights())), OBS_START, 0.035
    return arm


def geometry(qpos, goal, device):
    """Everything that ``_geometry`` writes."""
    n = len(goal)
    out = [wp.full(n, wp.vec3(np.nan), dtype=wp.vec3, device=device) for _ in range(3)]
    out.append(wp.zeros(n, dtype=wp.bool, device=device))
    inputs = [make_arm(device), to_array(qpos, device), wp.array(goal, dtype=wp.vec3, device=device)]
    wp.launch(_geometry, dim=n, inputs=inputs, outputs=out, device=device)
    return [array.numpy() for array in out]


def to_array(value, device):
    """A float32 array."""
    return wp.array(np.asarray(value, np.float32), dtype=wp.float32, device=device)


def rotation(axis, angle):
    """The matrix of a turn about a coordinate axis."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[j, i], matrix[i, j] = s, -s
    return matrix


def tip_reference(angles):
    """The end effector in the trunk's frame, from the base to the tip, frame by frame."""
    position, turned = np.array(rx150.MOUNT), np.eye(3)
    for offset, axis, angle in zip(rx150.OFFSETS, rx150.AXES, angles, strict=False):
        position = position + turned @ offset
        turned = turned @ rotation(axis, angle)
    return position + turned @ rx150.OFFSETS[-1]


def place_reference(goal):
    """Spherical to Cartesian."""
    distance, pitch, yaw = MIDDLE + np.asarray(goal, np.float64) * HALF
    level = distance * math.cos(pitch)
    return np.array([level * math.cos(yaw), level * math.sin(yaw), distance * math.sin(pitch)])


def goal_reference(place):
    """Cartesian to spherical."""
    x, y, z = place
    return (np.array([math.dist(place, (0, 0, 0)), math.atan2(z, math.hypot(x, y)), math.atan2(y, x)]) - MIDDLE) / HALF


def clear_reference(goals):
    """Whether goals are outside the box, shape (n,)."""
    places = np.array([place_reference(goal) for goal in goals])
    return ((places < BODY_LOW) | (places > BODY_HIGH)).any(axis=1)


def heights_reference():
    """A plane, so that what is bilinear is exact."""
    x, y = CORNER[0] + CELL * np.arange(121), CORNER[1] + CELL * np.arange(161)
    return 0.1 * x[:, None] - 0.05 * y[None, :] + 0.3


def make_world(n, seed=0):
    """A random moment of n worlds."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    return {
        "qpos": np.concatenate([
            rng.uniform(-4, 4, (n, 2)), rng.uniform(0.2, 0.5, (n, 1)),
            quat / np.linalg.norm(quat, axis=1, keepdims=True),
            rng.uniform(-1.5, 1.5, (n, J)),
        ], axis=1),
        "qvel": rng.normal(size=(n, 6 + J)), "ctrl": rng.normal(size=(n, J)), "torque": rng.normal(size=(n, J)),
        "part_force": np.zeros((4, n, 13)), "overflow": np.zeros(n),
        "goal": rng.uniform(-1, 1, (n, G)), "action": rng.normal(size=(n, J)), "joint_speed": np.zeros((n, J)),
        "air_time": np.zeros((n, 4)), "tracked": np.zeros((n, 2)), "wanted": rng.normal(size=(n, J)),
        "foot_contact": np.zeros(n), "level": np.zeros(n), "goal_start": np.zeros((n, 3)), "progress": np.zeros((n, 4)),
        "episode_count": rng.integers(1, 5, n),
    }  # fmt: skip


class World:
    """The same on a device, with outputs that no kernel has written yet."""

    def __init__(self, arrays, device, *, seed=9, world_offset=50, heights=None, arm=None):
        n = len(arrays["qpos"])
        self.arm = arm or make_arm(device, n=n)
        self.worlds = make_worlds(
            n, device, obs_dim=OBS, action_dim=J, goal_start=9, goal_scale=[2.0, 2.0, 0.25, 1.0, 1.0, 1.0],
            goal_period=500, seed=seed, world_offset=world_offset, num_groups=3,
        )  # fmt: skip
        for name in ("goal", "episode_count"):
            getattr(self.worlds, name).assign(arrays[name])
        self.worlds.action.assign(arrays["wanted"])
        for name in ("obs", "tracking"):
            getattr(self.worlds, name).fill_(GARBAGE)
        heights = heights_reference() if heights is None else heights
        values = arrays | {
            "term": np.full((n, NUM_COLUMNS + len(ARM_TERMS)), GARBAGE), "value": np.zeros(n), "pose": np.zeros(J),
            "action_scale": np.zeros(J), "low": np.zeros(J), "high": np.zeros(J),
            "action_low": np.full(J, -100.0), "action_high": np.full(J, 100.0), "heights": heights,
            "origin": np.zeros((1, 1, 3)), "noise": np.zeros(OBS), "point": np.zeros((POINTS, 2)),
        }  # fmt: skip
        params = {name: getattr(LocomotionParams(), name) for name in LocomotionParams.vars} | {
            "dt": DT, "max_speed": 20.0, "max_rate": 500.0, "cell": CELL,
            "corner": wp.vec2(*CORNER),
        }  # fmt: skip
        self.legged = LeggedWorlds(
            sizes=sizes(
                num_envs=n, num_joints=J, substeps=4, num_points=POINTS, heights=heights.shape, goal_dim=G,
                num_groups=3, num_terms=NUM_COLUMNS + len(ARM_TERMS), arm_fields=3,
            ),
            params=make_params(**params),
            worlds=self.worlds,
            **{label: build(table, device, **values) for label, table in TABLES.items() if label != "worlds"},
        )  # fmt: skip
        check_arm(self.arm, self.legged)

    def evaluate(self):
        """One ``evaluate_arms``."""
        evaluate_arms(self.legged, self.arm)
        out = {"obs": self.worlds.obs, "tracking": self.worlds.tracking, "term": self.legged.out.term}
        return {name: array.numpy() for name, array in (out | {"error": self.arm.error}).items()}

    def reset(self, mask, goal_range):
        """One ``reset_arms``."""
        self.worlds.mask.assign(mask)
        self.worlds.first_range.assign(goal_range)
        reset_arms(self.legged, self.arm)


def place_of(qpos):
    """The end effector relative to the goals' origin, on the sloping plane, in float64."""
    w, x, y, z = qpos[3:7]
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    left = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    tip = np.stack([forward, left, np.cross(forward, left)], axis=1) @ tip_reference(qpos[19:24])
    flat = rotation("z", math.atan2(forward[1], forward[0])).T @ tip
    # The mean of a plane over points around the base is its height below the base.
    ground = 0.1 * qpos[0] - 0.05 * qpos[1] + 0.3
    return np.add(flat, (0, 0, qpos[2] - ground)) - ORIGIN
