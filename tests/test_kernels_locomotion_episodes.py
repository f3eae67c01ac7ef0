"""The legged robots' resets, levels and goals, and the heights and the noise of their observation."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.episodes import make_worlds, set_goals
from deimos.kernels.legged.levels import change_of_level, commanded_displacement, update_levels
from deimos.kernels.legged.observation import finish_obs
from deimos.kernels.legged.reset import reset_worlds
from deimos.kernels.legged.rewards import vec12, vecT
from deimos.kernels.legged.state import STATE, TABLES, LeggedWorlds, LevelRule, build, make_params, sizes
from deimos.kernels.random import Purpose

N, J, G, SCAN = 40, 12, 3, 10
OBS = 48 + SCAN
CELL, CORNER = 0.1, (-6.0, -8.0)
LEVELS, COLUMNS = 3, 4
POSE = np.tile([0.1, 0.8, -1.5], 4)
LOW, HIGH = POSE - 0.5, POSE + 0.3
GOAL_SCALE = np.array([2.0, 2.0, 0.25])
CLOCKS = ("goal_clock", "episode_step", "episode_count", "goal_count")
PARAMS = {
    "dt": 0.02, "stagger": False, "noise": False, "push_interval": 0, "push_speed": 1.0,
    "weight": vecT(1.0), "air_time_target": 0.3, "soft_low": vec12(*LOW), "soft_high": vec12(*HIGH),
    "max_speed": 20.0, "max_rate": 500.0, "lost_contacts": 0, "scan_start": 48, "standing_height": 0.325,
    "spawn_height": 0.42, "spawn_range": 1.0, "spawn_speed": 0.5, "spawn_reach": 0.5,
    "level_rule": int(LevelRule.REWARD), "start_levels": 2, "cell": CELL, "corner": wp.vec2(*CORNER),
    "low": wp.vec2(-9.0), "high": wp.vec2(9.0),
}  # fmt: skip
"""Legged Gym's numbers on a small terrain."""


class World:
    """Worlds in the middle of something, and the ground that they are on; ``changes`` are fields of the parameters."""

    def __init__(self, device, seed=0, **changes):
        rng = np.random.default_rng(seed)
        self.device = device
        self.heights = rng.uniform(0, 0.3, size=(121, 161)).astype(np.float32)
        self.origins = rng.uniform(-3, 3, size=(LEVELS, COLUMNS, 3)).astype(np.float32)
        self.worlds = make_worlds(
            N, device, obs_dim=OBS, action_dim=J, goal_start=9, goal_scale=GOAL_SCALE, goal_period=500,
            time_limit=1000, seed=9, world_offset=100, num_groups=2,
        )  # fmt: skip
        numbers = sizes(
            num_envs=N, num_joints=J, substeps=4, num_points=SCAN, heights=(121, 161), tiles=(LEVELS, COLUMNS)
        )
        values = {
            "pose": POSE, "action_scale": np.full(J, 0.25), "low": LOW, "high": HIGH,
            "action_low": np.full(J, -100.0), "action_high": np.full(J, 100.0), "heights": self.heights,
            "origin": self.origins, "noise": np.zeros(OBS), "point": np.zeros((SCAN, 2)),
        }  # fmt: skip
        structs = {}
        for label, table in TABLES.items():
            if label != "worlds":
                random = {
                    name: rng.integers(1, 3, size=table.shape(name, **numbers))
                    if table.dtype(name) is wp.int32
                    else rng.normal(size=(*table.shape(name, **numbers), *getattr(table.dtype(name), "_shape_", ())))
                    for name in table.names
                }
                structs[label] = build(table, device, **(random | values))
        for name in CLOCKS:
            getattr(self.worlds, name).assign(rng.integers(1, 3, size=N))
        self.worlds.goal.assign(rng.normal(size=(N, G)))
        self.worlds.first_range.assign([1.0, 0.5, 2.0])
        self.worlds.obs.fill_(np.nan)
        self.legged = LeggedWorlds(
            sizes=numbers, params=make_params(**(PARAMS | changes)), worlds=self.worlds, **structs
        )  # fmt: skip
        self.state, self.sim = self.legged.state, self.legged.sim
        self.state.tracked.fill_(wp.vec2(30.0, 40.0))

    def set(self, **masks):
        """Masks of the worlds, one value or one for each."""
        for name, value in masks.items():
            getattr(self.worlds, name).assign(np.broadcast_to(value, N))

    def reset(self, mask):
        """``reset_worlds``."""
        self.set(mask=mask)
        reset_worlds(self.legged)

    def snapshot(self):
        """Everything that a reset may write."""
        arrays = {name: getattr(self.state, name) for name in STATE.names}
        arrays |= {name: getattr(self.worlds, name) for name in (*CLOCKS, "goal", "obs")}
        arrays |= {"qpos": self.sim.qpos, "qvel": self.sim.qvel}
        return {name: array.numpy().copy() for name, array in arrays.items()}


def bilinear(heights, x, y):
    """Ground at a point, clamped to the grid."""
    u, v = (x - CORNER[0]) / CELL, (y - CORNER[1]) / CELL
    i, j = (int(np.clip(np.floor(w), 0, n - 2)) for w, n in zip((u, v), heights.shape, strict=True))
    s, t = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
    near = heights[i, j] * (1 - t) + heights[i, j + 1] * t
    return near * (1 - s) + (heights[i + 1, j] * (1 - t) + heights[i + 1, j + 1] * t) * s


def test_reset_matches_reference(device, uniform_reference):
    """Place, height, speeds, joints, goal, clocks and observation of a new episode are the reference's draws."""
    world = World(device)
    before = world.snapshot()
    mask = np.arange(N) % 3 == 0
    world.reset(mask)
    after, seed = world.snapshot(), 9
    for i in np.flatnonzero(mask):
        number, episode = 100 + i, int(before["episode_count"][i])

        def draw(block, purpose=Purpose.RESET, number=number, episode=episode):
            return uniform_reference(seed, purpose, number, episode, 0, block)

        u = draw(0)
        origin = world.origins[before["level"][i], number % COLUMNS].astype(float)
        x, y = origin[:2] + 2 * u[:2] - 1
        offsets = np.linspace(-0.5, 0.5, 5)
        ground = max(bilinear(world.heights.astype(float), x + a, y + b) for a in offsets for b in offsets)
        qpos, qvel = after["qpos"][i], after["qvel"][i]
        np.testing.assert_allclose(qpos[:3], [x, y, ground + 0.42], rtol=0, atol=2e-5)
        np.testing.assert_array_equal(qpos[3:7], [1, 0, 0, 0])
        factor = 0.5 + np.concatenate([draw(4 + k) for k in range(3)])
        np.testing.assert_allclose(qpos[7:], np.clip(POSE * factor, LOW, HIGH), rtol=1e-6)
        np.testing.assert_array_equal(after["goal_start"][i], [*qpos[:2], 0.0])
        speeds = np.concatenate([draw(1)[:3], draw(2)[:3]]) - 0.5
        np.testing.assert_allclose(qvel, np.append(speeds, np.zeros(J)), rtol=0, atol=1e-6)
        goal = (2 * draw(0, Purpose.FIRST_GOAL)[:3] - 1) * [1.0, 0.5, 2.0]
        np.testing.assert_allclose(after["goal"][i], goal, rtol=0, atol=1e-6)
        body = np.concatenate([2 * qvel[:3], 0.25 * qvel[3:6], [0, 0, -1], goal * GOAL_SCALE, qpos[7:] - POSE])
        np.testing.assert_allclose(after["obs"][i, :48], np.append(body, np.zeros(24)), rtol=0, atol=1e-5)
        assert after["episode_count"][i] == episode + 1
    for name in (
        "action",
        "joint_speed",
        "air_time",
        "tracked",
        "progress",
        "foot_contact",
        "goal_clock",
        "episode_step",
    ):
        assert not after[name][mask].any(), name
    for name in after:
        np.testing.assert_array_equal(after[name][~mask], before[name][~mask], err_msg=name)
    np.testing.assert_array_equal(after["goal_count"], before["goal_count"])


def test_only_first_episodes_are_staggered(device, uniform_reference):
    """Clocks start at the drawn steps in a world's first episode, and at 0 in every later one."""
    world = World(device, stagger=True)
    world.worlds.episode_count.assign(np.arange(N) % 2)
    world.reset(True)
    after = world.snapshot()
    u = uniform_reference(9, Purpose.RESET, 100 + np.arange(N), 0, 0, 3)
    first = np.arange(N) % 2 == 0
    np.testing.assert_array_equal(after["goal_clock"], np.where(first, (u[:, 0] * 500).astype(int), 0))
    np.testing.assert_array_equal(after["episode_step"], np.where(first, (u[:, 1] * 1000).astype(int), 0))


@wp.kernel
def _changes(crashed: wp.array[wp.bool], worth: wp.array[float], change: wp.array[int]):
    i = wp.tid()
    change[i] = change_of_level(crashed[i], worth[i])


@pytest.mark.parametrize(
    ("crashed", "worth", "expected"),
    [(False, 0.8, 1), (False, 0.79, 0), (False, 0.5, 0), (False, 0.49, -1), (True, 1.0, -1), (True, 0.0, -1)],
)
def test_change_of_level(device, crashed, worth, expected):
    """The table of both rules, at and around their thresholds."""
    number, flag = wp.array([worth], dtype=wp.float32, device=device), wp.array([crashed], dtype=wp.bool, device=device)
    change = wp.full(1, 7, dtype=wp.int32, device=device)
    wp.launch(_changes, dim=1, inputs=[flag, number], outputs=[change], device=device)
    assert change.numpy()[0] == expected


@wp.kernel
def _displacements(goal: wp.array[wp.vec3], time: wp.array[float], displacement: wp.array[float]):
    i = wp.tid()
    displacement[i] = commanded_displacement(goal[i], time[i])


def test_commanded_displacement_is_that_of_the_path(device):
    """The chord of line or arc equals the end of the path, integrated in a million steps."""
    goals = np.array(
        [[1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [1.0, 0.0, 1e-5], [0.5, 0.5, 1.0], [-1.0, 0.2, -0.7], [0, 0, 1]]
    )
    times = np.array([3.0, 10.0, 10.0, 5.0, 20.0, 4.0])
    found = wp.full(len(goals), np.nan, dtype=wp.float32, device=device)
    inputs = [wp.array(goals, dtype=wp.vec3, device=device), wp.array(times, dtype=wp.float32, device=device)]
    wp.launch(_displacements, dim=len(goals), inputs=inputs, outputs=[found], device=device)
    for (x, y, w), t, displacement in zip(goals, times, found.numpy(), strict=True):
        angle = w * t * (np.arange(1_000_000) + 0.5) / 1_000_000
        end = np.hypot(np.mean(np.cos(angle) * x - np.sin(angle) * y), np.mean(np.sin(angle) * x + np.cos(angle) * y))
        assert displacement == pytest.approx(end * t, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("start_levels", [2, LEVELS + 2])
def test_levels_of_first_episodes_and_frozen_ones(device, uniform_reference, start_levels):
    """First levels are drawn from the lowest ones, or evenly from all; frozen ones follow from the world's number."""
    for rule in (LevelRule.REWARD, LevelRule.FROZEN):
        world = World(device, level_rule=int(rule), start_levels=start_levels)
        world.worlds.episode_count.zero_()
        world.set(mask=True, terminated=False, truncated=False, invalid=False)
        update_levels(world.legged)
        number = 100 + np.arange(N)
        drawn = (uniform_reference(9, Purpose.LEVEL, number, 0)[:, 0] * min(start_levels, LEVELS)).astype(int)
        expected = drawn if rule == LevelRule.REWARD else number // COLUMNS % LEVELS
        np.testing.assert_array_equal(world.state.level.numpy(), expected)


def test_levels_outside_the_mask_stay(device):
    """Only the levels of worlds that are about to be reset change."""
    world = World(device)
    before = world.state.level.numpy().copy()
    mask = np.arange(N) % 2 == 0
    world.set(mask=mask, terminated=True, truncated=False, invalid=False)
    update_levels(world.legged)
    after = world.state.level.numpy()
    np.testing.assert_array_equal(after[~mask], before[~mask])
    np.testing.assert_array_equal(after[mask], before[mask] - 1)


def test_goals_reach_the_listed_worlds(device):
    """A listed world gets its goal, in physical units, a fresh clock and a higher count; the others keep theirs."""
    world = World(device)
    before = world.snapshot()
    rows, goals = np.array([31, 2, 17]), np.random.default_rng(1).uniform(-2, 2, (3, G)).astype(np.float32)
    row = wp.array(rows, dtype=wp.int32, device=device)
    set_goals(row, wp.array(goals, dtype=wp.float32, device=device), world.worlds).launch()
    after = world.snapshot()
    np.testing.assert_allclose(after["goal"][rows], goals / GOAL_SCALE, rtol=1e-6)
    np.testing.assert_allclose(after["obs"][rows, 9:12], goals, rtol=1e-6)
    np.testing.assert_array_equal(after["goal_clock"][rows], 0)
    np.testing.assert_array_equal(after["goal_count"][rows], before["goal_count"][rows] + 1)
    others = np.setdiff1d(np.arange(N), rows)
    for name in after:
        np.testing.assert_array_equal(after[name][others], before[name][others], err_msg=name)


@pytest.mark.parametrize("wanted", [True, False])
def test_heights_and_noise_match_reference(device, uniform_reference, wanted):
    """Heights are 5 clip(z - 0.325 - ground, -1, 1) at points turned by the yaw, the noise is the reference's draw."""
    world, rng = World(device, noise=True), np.random.default_rng(3)
    points, noise = rng.uniform(-0.8, 0.8, (SCAN, 2)), rng.uniform(0, 0.5, OBS)
    quat = rng.normal(size=(N, 4))
    qpos = world.sim.qpos.numpy().copy()
    qpos[:, 2] = rng.uniform(-1, 2, N)
    qpos[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    world.sim.qpos.assign(qpos)
    body = rng.normal(size=(N, OBS)).astype(np.float32)
    world.worlds.obs.assign(body)
    mask = np.arange(N) % 4 < 2
    world.set(mask=mask)
    world.legged.sensing.point.assign(points)
    world.legged.sensing.noise.assign(noise)
    finish_obs(world.legged, world.worlds.mask, wanted=wanted)
    found = world.worlds.obs.numpy()
    near_edge = 0
    for i in np.flatnonzero(mask == wanted):
        episode, step = (int(getattr(world.worlds, name).numpy()[i]) for name in ("episode_count", "episode_step"))
        u = uniform_reference(9, Purpose.NOISE, 100 + i, episode, step, np.arange((OBS + 3) // 4)).reshape(-1)[:OBS]
        w, x, y, z = qpos[i, 3:7].astype(float)
        yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        c, s = np.cos(yaw), np.sin(yaw)
        expected = body[i].astype(float)
        cells = (qpos[i, :2] + points @ np.array([[c, s], [-s, c]]) - CORNER) / CELL
        a, b = np.clip(np.floor(cells), 0, [119, 159]).astype(int).T
        h = world.heights
        ground = np.minimum(np.minimum(h[a, b], h[a + 1, b]), h[a, b + 1])
        expected[48:] = 5 * np.clip(qpos[i, 2] - 0.325 - ground, -1, 1)
        wrong = np.abs(found[i] - expected - noise * (2 * u - 1)) > 2e-5
        near = np.append(np.zeros(48, bool), (np.abs(cells - np.round(cells)) < 1e-4).any(axis=1))
        assert not (wrong & ~near).any()
        near_edge += near.sum()
    assert near_edge < 10
    np.testing.assert_array_equal(found[mask != wanted], body[mask != wanted])
