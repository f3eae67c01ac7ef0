"""Worlds of legged robots as the kernels' arrays."""

from dataclasses import astuple

import numpy as np
import warp as wp
from deimos.kernels.episodes import make_worlds
from deimos.kernels.legged.rewards import RewardWeights, vec12, vecT
from deimos.kernels.legged.state import (
    NUM_COLUMNS,
    NUM_PARTS,
    TABLES,
    LeggedWorlds,
    LevelRule,
    build,
    make_params,
    sizes,
)
from deimos.kernels.legged.step import apply_actions, evaluate_step

J, G, OBS, SUBSTEPS = 12, 3, 48, 4
DT = 0.02
COUNTERS = ("goal_clock", "episode_step", "episode_count", "goal_count")
FLAGS = ("terminated", "truncated", "goal_due", "invalid")
GOAL_SCALE = np.array([2.0, 2.0, 0.25], np.float32)
POSE = np.tile([0.1, 0.8, -1.5], 4).astype(np.float32)
LOW, HIGH = POSE - 0.5, POSE + 0.5
PARAMS = {
    "dt": DT, "stagger": False, "noise": False, "push_interval": 0, "push_speed": 1.0,
    "weight": vecT(*astuple(RewardWeights())), "air_time_target": 0.3, "soft_low": vec12(*LOW),
    "soft_high": vec12(*HIGH), "max_speed": 20.0, "max_rate": 500.0, "lost_contacts": 0b1011, "scan_start": OBS,
    "standing_height": 0.325, "spawn_height": 0.42, "spawn_range": 1.0, "spawn_speed": 0.5, "spawn_reach": 0.5,
    "level_rule": int(LevelRule.REWARD), "start_levels": 6, "cell": 0.1, "corner": wp.vec2(-50.0, -50.0),
    "low": wp.vec2(-49.0, -48.0), "high": wp.vec2(47.0, 46.0),
}  # fmt: skip
"""Legged Gym's numbers on a plane."""


def make_world(n, seed=0):
    """A random moment of n worlds, in NumPy."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    w = {
        "qpos": np.concatenate([
            rng.uniform(-40, 40, (n, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True),
            POSE + rng.normal(scale=0.4, size=(n, J)),
        ], axis=1),
        "qvel": rng.normal(size=(n, 6 + J)),
        "ctrl": np.full((n, J), np.nan),
        "torque": rng.normal(scale=10, size=(n, J)),
        "part_force": rng.exponential(size=(SUBSTEPS, n, NUM_PARTS)) * (rng.random((SUBSTEPS, n, NUM_PARTS)) < 0.15),
        "overflow": np.zeros(n),
        "wanted": rng.normal(size=(n, J)),
        "goal": rng.uniform(-1, 1, (n, G)), "action": rng.normal(size=(n, J)), "joint_speed": rng.normal(size=(n, J)),
        "air_time": rng.integers(0, 40, (n, 4)) * DT, "tracked": np.stack([rng.uniform(0, 9, n), np.full(n, 9.0)], 1),
        **{name: np.zeros(n) for name in (*COUNTERS, "level")},
        "foot_contact": rng.integers(0, 16, n), "goal_start": np.zeros((n, 3)), "progress": np.zeros((n, 4)),
    }  # fmt: skip
    integers = (*COUNTERS, "level", "foot_contact", "overflow")
    return {name: value.astype(np.int32 if name in integers else np.float32) for name, value in w.items()}


class World:
    """The same on a device, with outputs that no kernel has written yet; ``changes`` are fields of the parameters."""

    def __init__(self, arrays, device, garbage=np.nan, arm_terms=None, bound=100.0, seed=0, world_offset=0, **changes):
        n = len(arrays["qpos"])
        self.worlds = make_worlds(
            n, device, obs_dim=OBS, action_dim=J, goal_start=9, goal_scale=GOAL_SCALE, goal_period=500,
            time_limit=1000, seed=seed, world_offset=world_offset, num_groups=2,
        )  # fmt: skip
        for name in (*COUNTERS, "goal"):
            getattr(self.worlds, name).assign(arrays[name])
        self.worlds.action.assign(arrays["wanted"])
        for name in ("obs", "tracking", "reward"):
            getattr(self.worlds, name).fill_(garbage)
        for name in FLAGS:
            getattr(self.worlds, name).fill_(True)
        term = np.full((n, NUM_COLUMNS), garbage)
        if arm_terms is not None:
            term = np.concatenate([term, arm_terms], axis=1)
        values = arrays | {
            "term": term, "value": np.full(n, garbage), "pose": POSE, "action_scale": np.full(J, 0.25), "low": LOW,
            "high": HIGH, "action_low": np.full(J, -bound), "action_high": np.full(J, bound),
            "heights": np.zeros((2, 2)), "origin": np.zeros((1, 1, 3)), "noise": np.zeros(OBS),
            "point": np.zeros((0, 2)),
        }  # fmt: skip
        structs = {label: build(table, device, **values) for label, table in TABLES.items() if label != "worlds"}
        self.legged = LeggedWorlds(
            sizes=sizes(
                num_envs=n, num_joints=J, substeps=SUBSTEPS, num_points=0, heights=(2, 2), num_terms=term.shape[1]
            ),
            params=make_params(**(PARAMS | changes)), worlds=self.worlds, **structs,
        )  # fmt: skip
        self.sim, self.state = self.legged.sim, self.legged.state

    def evaluate(self):
        """One ``evaluate_step``; gives all that a step gives back."""
        evaluate_step(self.legged)
        names = ("obs", "reward", "tracking", "fault", "cause", *FLAGS)
        out = {name: getattr(self.worlds, name) for name in names}
        out |= {name: getattr(self.legged.out, name) for name in TABLES["out"].names}
        return {name: array.numpy() for name, array in out.items()}

    def apply(self):
        """One ``apply_actions``."""
        apply_actions(self.legged)
