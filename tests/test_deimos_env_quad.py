"""Quad: what an environment promises, shown on the Go1 without and with its arm, and the task of the thesis."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from deimos.kernels.legged.height_scan import scan_points
from deimos.kernels.legged.levels import update_levels
from deimos.kernels.legged.rewards import RewardWeights
from deimos.kernels.legged.state import COLUMNS
from deimos.kernels.legged.step import evaluate_step
from deimos.kernels.random import Purpose
from deimos.terrain import Grid, Share
from deimos.terrain.shapes.flat import Shape as Flat
from deimos.terrain.shapes.stairs import Shape as Stairs

import deimos
from deimos import terrain
from deimos.checks import SimulationError
from deimos.goals.selectors import uniform
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.env import Step
from deimos.sim.envs import quad_arm
from deimos.sim.envs.quad import Config
from deimos.sim.legged import robots
from deimos.sim.legged.engines import PhysicsConfig

U = 2.0**-24
POSE = np.tile([0.1, 0.8, -1.5, -0.1, 0.8, -1.5], 2)
TASKS = {"quad": Config, "quad-arm": quad_arm.Config}

both = pytest.mark.parametrize("task", TASKS)
"""With an arm or without, a robot keeps what an environment promises."""


@pytest.fixture(scope="module")
def hills(tmp_path_factory):
    """The path of a small saved terrain: 3 levels and 2 columns of stairs."""
    shapes = tuple(Share(shape=Stairs(tile=4.0, platform=2.0, direction=way)) for way in ("up", "down"))
    ground = terrain.build(Grid(shapes=shapes, levels=3, columns=2, tile=4.0, border=2.0, hardest=0.5))
    path = tmp_path_factory.mktemp("terrain") / "hills.npz"
    ground.save(path)
    return str(path)


def build(device, num_envs=6, seed=0, env_offset=0, task="quad", **config):
    """An environment with short goals and episodes unless told otherwise."""
    config = TASKS[task](**({"goal_period": 5, "episode_steps": 40, "engine": "warp"} | config))
    return config.build(num_envs, device, seed, env_offset)


def build_on(simulator, **options):
    """The same with an engine, on a device that it knows."""
    return build(simulator.device, engine=simulator.engine, **options)


def build_loop(env, candidates=3):
    """A loop with uniform goals."""
    return GoalLoop(env, uniform.Config(candidates=candidates).build(spaces(env), seed=0))


def actions(num_envs, device, seed=0, scale=0.6, task="quad"):
    """Constant actions, other for every world: some robots fall early, some late."""
    joints = 12 if task == "quad" else 17
    a = np.random.default_rng(seed).normal(scale=scale, size=(num_envs, joints))
    return torch.tensor(a, dtype=torch.float32, device=device)


def tensors_of(env, step):
    """Copies of all that a resume needs and of all that a step gave back."""
    return env.state_dict() | {name: getattr(step, name).clone() for name in Step.__dataclass_fields__}


def assert_equal(found, expected):
    """Two dictionaries of tensors are the same in every value."""
    assert found.keys() == expected.keys()
    for name in expected:
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=0, equal_nan=True, msg=name)


def rows_of(env, *rows):
    """Rows as an environment takes them; all of them if none is given."""
    return torch.tensor(rows or range(env.num_envs), dtype=torch.int64, device=env.device)


def mask_of(env, *rows):
    """A mask of the listed worlds."""
    mask = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    mask[list(rows)] = True
    return mask


def test_observation_is_legged_gyms(torch_device):
    """48 numbers and 187 heights, in Legged Gym's order, scales and noise."""
    env = build(torch_device)
    fields = [(field.name, field.size, field.scale) for field in env.layout]
    assert fields == [
        ("linear_velocity", 3, 2.0), ("angular_velocity", 3, 0.25), ("gravity", 3, 1.0), ("goal", 3, (2.0, 2.0, 0.25)),
        ("joint_position", 12, 1.0), ("joint_velocity", 12, 0.05), ("last_action", 12, 1.0), ("heights", 187, 5.0),
    ]  # fmt: skip
    assert env.obs_dim == 235
    assert env.goal_slice == slice(9, 12)
    assert env.dt == pytest.approx(0.02)
    noise = [0.2] * 3 + [0.05] * 3 + [0.05] * 3 + [0.0] * 3 + [0.01] * 12 + [0.075] * 12 + [0.0] * 12 + [0.5] * 187
    np.testing.assert_allclose(env.legged.sensing.noise.numpy(), noise, rtol=1e-6)


def test_observation_matches_numpy(torch_device, hills):
    """After random steps on stairs, the whole observation, heights included, is that of NumPy from the same state."""
    env = build(torch_device, num_envs=12, terrain=hills, noise=False)
    action = actions(12, torch_device)
    for _ in range(15):
        step = env.step(action)
    ground, points = env.terrain, scan_points()
    qpos, qvel = (env.tensors[name].double().cpu().numpy() for name in ("qpos", "qvel"))
    for i in range(12):
        w, x, y, z = qpos[i, 3:7]
        forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
        left = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
        rotation = np.stack([forward, left, np.cross(forward, left)], axis=1)
        yaw = np.arctan2(forward[1], forward[0])
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        cells = (qpos[i, :2] + points @ turn.T - ground.corner) / ground.cell
        a, b = np.clip(np.floor(cells), 0, np.array(ground.heights.shape) - 2).astype(int).T
        height = np.minimum(np.minimum(ground.heights[a, b], ground.heights[a + 1, b]), ground.heights[a, b + 1])
        expected = np.concatenate([
            2 * rotation.T @ qvel[i, :3], 0.25 * qvel[i, 3:6], -rotation[2],
            env.tensors["goal"][i].cpu().numpy() * [2, 2, 0.25], qpos[i, 7:] - POSE, 0.05 * qvel[i, 6:],
            action[i].cpu().numpy(), 5 * np.clip(qpos[i, 2] - 0.325 - height, -1, 1),
        ])  # fmt: skip
        found = step.obs[i].cpu().numpy()
        np.testing.assert_allclose(found[:48], expected[:48], rtol=1e-5, atol=1e-5)
        # A point within rounding of a cell's edge may be read from the next cell.
        assert (np.abs(found[48:] - expected[48:]) > 1e-4).sum() <= 2


def test_reward_is_the_sum_of_its_columns(torch_device, hills):
    """Over steps with crashes on stairs, the columns sum to the reward, and the report's means to the mean reward."""
    env = build(torch_device, num_envs=32, terrain=hills)
    loop = build_loop(env)
    total = 0.0
    for _ in range(30):
        step = env.step(actions(32, torch_device))
        torch.testing.assert_close(env.term.sum(1), step.reward, rtol=0, atol=1e-5)
        assert bool((step.reward >= 0).all())
        total += float(step.reward.mean()) / 30
        loop.advance(step)
    report = env.report()
    assert sum(report[f"reward/{name}"] for name in COLUMNS) == pytest.approx(total, abs=1e-6)
    assert set(env.report()) == set(report)


def test_tracking_is_the_reward_terms_unweighted(torch_device):
    """``Step.tracking`` is each tracking term over its weight and the duration, a column for each goal group."""
    env = build(torch_device)
    assert env.goal_groups == (slice(0, 2), slice(2, 3))
    assert env.goal_group_names == ("velocity", "yaw rate")
    step = env.step(actions(6, torch_device))
    weights = RewardWeights()
    for column, name in enumerate(("linear_tracking", "yaw_tracking")):
        term = env.term[:, COLUMNS.index(name)]
        torch.testing.assert_close(step.tracking[:, column], term / (getattr(weights, name) * 0.02), rtol=1e-6, atol=0)
    assert bool(((step.tracking >= 0) & (step.tracking <= 1)).all())


def test_crash_is_the_trunk_on_the_ground(simulator):
    """A robot dropped on its back crashes when the trunk touches the ground, not before; one that stands does not."""
    config = Config(episode_steps=500, goal_period=500, engine=simulator.engine).for_evaluation()
    env = config.build(2, simulator.device, 0)
    qpos = env.tensors["qpos"]
    qpos[0, 2] = 0.5
    qpos[0, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], device=simulator.device)
    crashed_at, stood = None, True
    for t in range(60):
        step = env.step(torch.zeros(2, 12, device=simulator.device))
        stood &= not bool(step.terminated[1])
        if bool(step.terminated[0]) and crashed_at is None:
            crashed_at = t
            assert float(qpos[0, 2]) < 0.12
    # A fall by 0.4 m takes sqrt(2 0.4 / 9.81) = 0.29 s, or 14 steps; its first speed is at most 0.5 m/s either way.
    assert crashed_at is not None
    assert 8 <= crashed_at <= 22
    assert stood


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("effort", [0.0, 1.0])
def test_a_robot_that_lies_on_its_side_has_crashed(simulator, side, effort):
    """Whatever its legs do: it falls on its hips, which are parts of the base (thesis, 4.1.2: "any part" of it)."""
    config = Config(goal_period=500, engine=simulator.engine).for_evaluation()
    env, rng = config.build(32, simulator.device, 0), np.random.default_rng(0)
    yaw, roll = rng.uniform(0, 2 * np.pi, 32) / 2, side * np.pi / 4
    c, s, a, b = np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    qpos = env.tensors["qpos"]
    qpos[:, 2] = 0.25
    qpos[:, 3:7] = torch.tensor(np.stack([c * a, c * b, s * b, s * a], axis=1), dtype=torch.float32)
    env.tensors["qvel"].zero_()
    crashed = torch.zeros(32, dtype=torch.bool, device=simulator.device)
    for _ in range(50):
        crashed |= env.step(actions(32, simulator.device, scale=effort)).terminated
    assert bool(crashed.all())


@both
def test_warp_and_torch_see_one_allocation_and_views_stay(task, simulator):
    """Every tensor keeps its address over steps, goals and resets, and a step gives back the very same views."""
    env = build_on(simulator, task=task, episode_steps=6)
    loop = build_loop(env)
    first = env.step(actions(6, simulator.device, task=task))
    addresses = [t.data_ptr() for t in (*env.tensors.values(), *vars(first).values())]
    for _ in range(12):
        last = env.step(actions(6, simulator.device, task=task))
        loop.advance(last)
    assert last is first
    assert addresses == [t.data_ptr() for t in (*env.tensors.values(), *vars(last).values())]
    assert env.tensors["qpos"].data_ptr() == env.physics.arrays.qpos.ptr


@both
def test_reset_of_one_world_leaves_the_others(task, simulator, hills):
    """Resetting world 0 changes world 0 and no bit of any other, now and over the steps that follow."""
    env, twin = (build_on(simulator, task=task, terrain=hills, episode_steps=200, goal_period=100) for _ in range(2))
    action = actions(6, simulator.device, task=task)
    for _ in range(8):
        env.step(action)
        twin.step(action)
    env.reset(mask_of(env, 0))
    assert not torch.equal(env.tensors["qpos"][0], twin.tensors["qpos"][0])
    assert int(env.tensors["episode_count"][0]) == 2
    for _ in range(8):
        for name, tensor in env.tensors.items():
            assert torch.equal(tensor[1:], twin.tensors[name][1:]), name
        env.step(action)
        twin.step(action)


@both
def test_copied_worlds_are_exact_clones(task, simulator):
    """Clones, also into another environment, continue exactly as their originals, warm starts and payloads included."""
    config = {"noise": False, "push_interval": 0.0, "episode_steps": 300, "goal_period": 100}
    origin, env = build_on(simulator, task=task, **config), build_on(simulator, task=task, seed=3, **config)
    action = actions(6, simulator.device, task=task)
    for _ in range(9):
        origin.step(action)
    source, target = rows_of(origin, 4, 1), rows_of(env, 0, 5)
    env.copy_worlds(source, target, origin)
    everyone = actions(6, simulator.device, task=task, seed=1)
    everyone[target] = action[source]
    for _ in range(12):
        for name, tensor in env.tensors.items():
            assert torch.equal(tensor[target], origin.tensors[name][source]), name
        env.step(everyone)
        origin.step(action)


@both
def test_resume_is_exact(task, simulator, hills):
    """A new environment with the saved state continues bit for bit, over goals, pushes, crashes, resets and levels."""
    config = {"terrain": hills, "push_interval": 0.2}
    env = build_on(simulator, task=task, **config)
    loop = build_loop(env)
    action = actions(6, simulator.device, task=task)
    for _ in range(30):
        loop.advance(env.step(action))
    saved = loop.state_dict()
    expected = []
    for _ in range(45):
        step = env.step(action)
        loop.advance(step)
        expected.append(tensors_of(env, step))
    resumed_env = build_on(simulator, task=task, **config)
    resumed = build_loop(resumed_env)
    resumed.load_state_dict(saved)
    for want in expected:
        step = resumed_env.step(action)
        resumed.advance(step)
        assert_equal(tensors_of(resumed_env, step), want)
    assert bool((env.tensors["episode_count"] > saved["env"]["episode_count"]).any())


@both
def test_reports_are_the_same_after_a_resume(task, simulator, hills):
    """What a log gets of the steps after a resume is what it would have got of an uninterrupted run, buffers too."""
    env = build_on(simulator, task=task, terrain=hills)
    buffers = {"warp": ["contact_use", "row_use"], "native": []}[simulator.engine]
    assert [name for name in env.report() if name.endswith("_use")] == buffers
    assert all(env.report()[name] == 0 for name in buffers), "nothing has been simulated yet"
    action = actions(6, simulator.device, task=task)
    reports = []
    for _ in range(12):
        env.step(action)
    env.check()
    env.report()
    saved = env.state_dict()
    resumed = build_on(simulator, task=task, terrain=hills)
    resumed.load_state_dict(saved)
    for world in (env, resumed):
        for _ in range(3):
            world.step(action)
        world.check()
        reports.append(world.report())
    assert reports[0] == reports[1]
    assert all(0 < reports[0][name] < 1 for name in buffers)


@both
def test_two_shards_equal_the_whole(task, simulator, hills):
    """Two environments of 4 worlds, the second with an offset of 4, do what one of 8 does, bit for bit."""
    config = {"terrain": hills, "push_interval": 0.2}
    whole = build_on(simulator, task=task, num_envs=8, **config)
    shards = [build_on(simulator, task=task, num_envs=4, env_offset=offset, **config) for offset in (0, 4)]
    loops = [build_loop(env) for env in (whole, *shards)]
    action = actions(8, simulator.device, task=task)
    for _ in range(50):
        loops[0].advance(whole.step(action))
        for i, shard in enumerate(shards):
            loops[1 + i].advance(shard.step(action[4 * i : 4 * i + 4]))
    for name, tensor in whole.tensors.items():
        assert torch.equal(tensor, torch.cat([shard.tensors[name] for shard in shards])), name
    assert bool((whole.tensors["episode_count"] > 1).all())


def test_goals_are_uniform_in_the_box_and_what_the_policy_sees(torch_device):
    """Candidates fill [-1, 1]^3, scaled as observed; a goal that is set shows in its slot and starts its clock."""
    env = build(torch_device, num_envs=50)
    goals = env.sample_goals(rows_of(env), 200).clone() / torch.tensor([2.0, 2.0, 0.25], device=torch_device)
    assert bool((goals.abs() <= 1).all())
    # The mean of 10 000 uniform numbers has a standard deviation of 0.0058, their variance one of 0.003.
    assert goals.mean((0, 1)).abs().max() < 5 * 0.0058
    assert (goals.var((0, 1)) - 1 / 3).abs().max() < 5 * 0.003
    small = env.sample_goals(rows_of(env), 200, torch.tensor([0.5, 0.25, 1.0], device=torch_device))
    torch.testing.assert_close(small / torch.tensor([1.0, 0.5, 0.25], device=torch_device), goals, rtol=1e-5, atol=1e-6)
    wanted = torch.tensor([[1.0, -2.0, 0.125], [0.0, 0.5, -0.25]], device=torch_device)
    env.step(actions(50, torch_device))
    before = env.obs.clone()
    env.set_goals(rows_of(env, 7, 3), wanted)
    assert torch.equal(env.goal[[7, 3]], wanted)
    torch.testing.assert_close(env.tensors["goal"][7], torch.tensor([0.5, -1.0, 0.5], device=torch_device))
    assert env.tensors["goal_clock"][[7, 3]].tolist() == [0, 0]
    assert torch.equal(env.state(env.obs), env.state(before))


def test_first_goals_fill_the_asked_share_of_the_range(torch_device):
    """First goals lie within the given share of the box, and without one within all of it."""
    env = build(torch_device, num_envs=200)
    env.reset(mask_of(env, *range(200)), torch.tensor([0.1, 1.0, 0.5], device=torch_device))
    largest = env.tensors["goal"].abs().amax(0)
    assert bool((largest <= torch.tensor([0.1, 1.0, 0.5], device=torch_device)).all())
    assert bool((largest > 0.9 * torch.tensor([0.1, 1.0, 0.5], device=torch_device)).all())


def test_randomisation_is_drawn_per_world(simulator, uniform_reference):
    """Friction and payload are functions of the seed and the world's number, in their ranges; evaluation has none."""
    env = build_on(simulator, num_envs=40, seed=5, env_offset=100)
    u = uniform_reference(5, Purpose.FRICTION, 100 + np.arange(40), 0)
    model = env.physics.model
    friction = env.physics.tensors["geom_friction"].cpu().numpy()
    mass = env.physics.tensors["body_mass"].cpu().numpy()[:, 1]
    np.testing.assert_allclose(mass, model.body("trunk").mass + 2 * u[:, 1] - 1, rtol=1e-6)
    feet = np.sort(friction[:, :, 0], axis=1)
    np.testing.assert_allclose(
        np.unique(feet), np.unique(np.append(0.5 + 0.75 * u[:, 0], 1.0).astype(np.float32)), rtol=1e-6
    )
    quiet = Config().for_evaluation()
    assert quiet == replace(
        Config(), levels="frozen", friction=(1.0, 1.0), payload=0.0, push_interval=0.0, noise=False, stagger=False,
        episode_steps=0,
    )  # fmt: skip
    assert "geom_friction" not in replace(quiet, engine=simulator.engine).build(2, simulator.device, 0).tensors


def test_noise_is_uniform_and_keyed(torch_device):
    """Noise is uniform within the published bounds, and another on every step and in every world."""
    quiet, noisy = (build(torch_device, num_envs=300, noise=noise) for noise in (False, True))
    action = actions(300, torch_device)
    differences = []
    for _ in range(2):
        difference = noisy.step(action).obs - quiet.step(action).obs
        differences.append(difference.cpu().numpy())
    bound = noisy.legged.sensing.noise.numpy()
    for difference in differences:
        assert np.all(np.abs(difference) <= bound + 1e-5)
        assert np.all(np.abs(difference[:, bound == 0]) == 0)
        # 300 draws in 208 columns: the largest of each comes within 10 % of the bound but for one in 10^13.
        assert np.all(np.abs(difference).max(axis=0)[bound > 0] > 0.9 * bound[bound > 0])
    assert not np.any(np.isclose(differences[0], differences[1])[:, bound > 0].all(axis=1))


def test_levels_follow_the_tracking(torch_device, hills):
    """A good episode lifts the level, a poor one or a crash lowers it, and one in between leaves it."""
    env = build(torch_device, num_envs=6, terrain=hills, stagger=False)
    cases = [(0.85, False, 1, 2), (0.45, False, 1, 0), (0.9, True, 1, 0), (0.65, False, 1, 1), (0.3, False, 0, 0)]
    t = env.tensors
    for i, (tracking, crashed, level, _) in enumerate(cases):
        t["tracked"][i] = torch.tensor([tracking * 40, 40.0])
        env._views["terminated"][i] = crashed
        env._views["truncated"][i] = not crashed
        t["level"][i] = level
    t["tracked"][5], t["level"][5] = torch.tensor([40.0, 40.0]), 2
    env._views["truncated"][5] = True
    env.reset(mask_of(env, *range(6)))
    assert t["level"][:5].tolist() == [case[3] for case in cases]
    assert 0 <= int(t["level"][5]) <= 2
    origin = torch.tensor(env.terrain.origins)[t["level"].cpu().long(), torch.arange(6) % 2]
    assert bool(((t["qpos"][:, :2].cpu() - origin[:, :2]).abs() <= 1.0).all())


def test_a_reset_in_the_middle_and_an_invalid_world_keep_their_level(torch_device, hills):
    """Only an episode that ended says how it went."""
    env = build(torch_device, num_envs=3, terrain=hills)
    env.tensors["level"][:] = 1
    env.tensors["tracked"][:] = torch.tensor([1.0, 40.0])
    env._views["terminated"][:] = False
    env._views["truncated"][:] = torch.tensor([False, True, True])
    env._views["invalid"][:] = torch.tensor([False, True, False])
    env.reset(mask_of(env, 0, 1, 2))
    assert env.tensors["level"].tolist() == [1, 1, 0]


def test_who_passes_the_last_level_is_sent_anywhere(torch_device, hills):
    """After the last level the next is uniform over all of them."""
    n = 600
    env = build(torch_device, num_envs=n, terrain=hills)
    env.tensors["level"][:] = 2
    env.tensors["tracked"][:] = torch.tensor([40.0, 40.0])
    env._views["truncated"][:] = True
    env.reset(mask_of(env, *range(n)))
    counts = torch.bincount(env.tensors["level"].long(), minlength=3)
    assert (counts - n / 3).abs().max() < 5 * math.sqrt(n * 2 / 9)


def walk(env, goals, follows):
    """Play an episode in which robots do what two goals say, or stand; what they do is written, not simulated.

    Gives the level that each begins the next episode on, all having begun on level 5 of ten, and the distance of the
    ends of each goal's path, shape (2, num_envs).
    """
    n, t = env.num_envs, env.tensors
    env.legged.ground.origin = wp.zeros((10, 1), dtype=wp.vec3, device=env.worlds.mask.device)
    t["level"][:] = 5
    position, yaw, lengths = np.zeros((n, 2)), np.zeros(n), []
    for k, goal in enumerate(goals):
        if k > 0:
            env.set_goals(rows_of(env), torch.tensor(goal * [2.0, 2.0, 0.25], dtype=torch.float32))
        else:
            t["goal"][:] = torch.tensor(goal, dtype=torch.float32)
        start = position.copy()
        for _ in range(500):
            yaw = yaw + goal[:, 2] * 0.02 * follows
            c, s = np.cos(yaw), np.sin(yaw)
            velocity = np.stack([c * goal[:, 0] - s * goal[:, 1], s * goal[:, 0] + c * goal[:, 1]], axis=1)
            position = position + 0.02 * velocity * follows
            t["qpos"][:, :2] = torch.tensor(position, dtype=torch.float32)
            zero = np.zeros(n)
            t["qpos"][:, 3:7] = torch.tensor(np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], 1))
            t["qvel"].zero_()
            t["qvel"][:, :2] = torch.tensor(velocity * follows)
            t["qvel"][:, 5] = torch.tensor(goal[:, 2] * follows)
            evaluate_step(env.legged)
        lengths.append(np.linalg.norm(position - start, axis=1))
    assert env._views["truncated"].all()
    env._views["mask"][:] = True
    update_levels(env.legged)
    return t["level"].cpu().numpy(), np.array(lengths)


@pytest.mark.parametrize("rule", ["reward", "displacement"])
def test_perfect_tracker_of_turning_goals(torch_device, rule):
    """Who follows turning goals perfectly walks in circles and never goes down by either rule; who stands does."""
    goals = np.random.default_rng(0).uniform(-1, 1, size=(2, 64, 3))
    config = {"levels": rule, "episode_steps": 1000, "goal_period": 500, "stagger": False}
    level, lengths = walk(build(torch_device, num_envs=64, **config), goals, follows=1.0)
    counts = (lengths > 0.31).any(axis=0) | (rule == "reward")
    unclear = (np.abs(lengths - 0.3) < 0.02).any(axis=0)  # the path that counts begins a step later
    np.testing.assert_array_equal(level[~unclear], np.where(counts, 6, 5)[~unclear])
    assert counts.sum() > 60
    level, _ = walk(build(torch_device, num_envs=64, **config), goals, follows=0.0)
    still = np.exp(-(goals[..., :2] ** 2).sum(-1) / 0.25).mean(0)
    down = counts if rule == "displacement" else still < 0.5
    clear = ~unclear if rule == "displacement" else still < 0.8
    np.testing.assert_array_equal(level[clear], np.where(down, 4, 5)[clear])


def test_goals_that_lead_nowhere_do_not_count(torch_device):
    """By displacements, goals that turn on the spot say nothing, and a goal that was missed halves one that was met."""
    goals = np.zeros((2, 4, 3))
    goals[:, 0, 2] = 1.0  # turns
    goals[:, 1] = [0.025, 0.0, 0.0]  # leads 0.25 m away
    goals[0, 2], goals[1, 2] = [0.5, 0.0, 0.0], [0.0, 0.0, 1.0]  # one counts
    goals[:, 3] = [0.5, 0.0, 0.2]
    config = {"levels": "displacement", "episode_steps": 1000, "goal_period": 500, "stagger": False}
    assert walk(build(torch_device, num_envs=4, **config), goals, follows=1.0)[0].tolist() == [5, 5, 6, 6]
    assert walk(build(torch_device, num_envs=4, **config), goals, follows=0.0)[0].tolist() == [5, 5, 4, 4]
    env = build(torch_device, num_envs=4, **config)
    env.tensors["progress"][:] = torch.tensor([0.9, 1.0, 0.3, 1.0])  # mean 0.6
    env.tensors["level"][:] = 5
    env._views["truncated"][:] = True
    env._views["terminated"][:2] = torch.tensor([True, False])
    env.legged.ground.origin = wp.zeros((10, 1), dtype=wp.vec3, device=env.worlds.mask.device)
    env._views["mask"][:] = True
    update_levels(env.legged)
    assert env.tensors["level"].tolist() == [4, 5, 5, 5]


def test_evaluation_puts_world_i_on_tile_i(torch_device, hills):
    """In evaluation the tile is a function of the world's number alone, and stays, whatever happens."""
    config = Config(terrain=hills, goal_period=3).for_evaluation()
    env = config.build(8, torch_device, 0)
    tiles = [("stairs-up", 0), ("stairs-down", 0), ("stairs-up", 1), ("stairs-down", 1), ("stairs-up", 2)]
    for _ in range(3):
        assert [(shape.split("_")[0], level) for shape, level in env.tiles()][:5] == tiles
        assert env.tiles()[6:] == env.tiles()[:2]
        loop = build_loop(env)
        for _ in range(7):
            loop.advance(env.step(actions(8, torch_device)))
        loop.start()
    assert not env.tensors["goal_clock"].unique().numel() > 2


def test_evaluation_has_no_time_limit(torch_device):
    """However short the episodes of training are, those of an evaluation go on until something happens."""
    env = Config(episode_steps=6, goal_period=3).for_evaluation().build(8, torch_device, 0)
    assert env.time_limit == 0
    assert not any(bool(env.step(torch.zeros(8, 12, device=torch_device)).truncated.any()) for _ in range(20))


def test_episodes_end_at_their_limit_and_first_ones_are_staggered(torch_device):
    """An episode without a crash is cut off after exactly its steps; first clocks are spread over episode and goal."""
    env = build(torch_device, num_envs=200, episode_steps=50, goal_period=20)
    assert len(env.tensors["episode_step"].unique()) > 35
    assert len(env.tensors["goal_clock"].unique()) == 20
    calm = build(torch_device, num_envs=3, episode_steps=50, goal_period=20, stagger=False, push_interval=0.0)
    ends = [bool(calm.step(torch.zeros(3, 12, device=torch_device)).truncated.all()) for _ in range(50)]
    assert ends == [False] * 49 + [True]


def test_walking_off_the_terrain_cuts_the_episode_off(torch_device, hills):
    """Beyond the edge a robot is truncated, not terminated."""
    env = build(torch_device, terrain=hills, episode_steps=200, goal_period=100)
    env.tensors["qpos"][2, 0] += 100.0
    step = env.step(torch.zeros(6, 12, device=torch_device))
    assert step.truncated.tolist() == [False, False, True, False, False, False]
    assert not step.terminated[2]
    assert not step.invalid.any()


@both
@pytest.mark.parametrize(("name", "index", "value"), [("qpos", 8, math.nan), ("qvel", 0, 1e6), ("qvel", 12, math.inf)])
def test_a_broken_world_is_reset_and_touches_nobody(task, simulator, hills, name, index, value):
    """NaN or a huge speed in one world: it is flagged, cut off and begins anew, and no bit of the others changes."""
    env, twin = (build_on(simulator, task=task, terrain=hills, episode_steps=200, goal_period=100) for _ in range(2))
    loops = [build_loop(e) for e in (env, twin)]
    action = actions(6, simulator.device, task=task, scale=0.2)
    for _ in range(4):
        for e, loop in zip((env, twin), loops, strict=True):
            loop.advance(e.step(action))
    env.tensors[name][2, index] = value
    others = [0, 1, 3, 4, 5]
    for t in range(6):
        step, twin_step = env.step(action), twin.step(action)
        assert step.invalid.tolist() == [t == 0 and i == 2 for i in range(6)]
        assert bool(step.obs.isfinite().all())
        for key in vars(step):
            if key != "count":
                assert torch.equal(getattr(step, key)[others], getattr(twin_step, key)[others]), key
        for outcome, loop in zip((step, twin_step), loops, strict=True):
            loop.advance(outcome)
        for key, tensor in env.tensors.items():
            assert torch.equal(tensor[others], twin.tensors[key][others]), key
    assert bool(torch.stack([t.isfinite().all() for t in env.tensors.values()]).all())
    assert int(env.tensors["episode_count"][2]) >= 2


@pytest.mark.parametrize("often", [True, False])
def test_too_many_invalid_worlds_stop_the_run(torch_device, often):
    """More than 0.1 % of 10 000 world-steps are too many, however often the check looks; it names what was wrong."""
    env = build(torch_device)
    for count in range(11):
        assert env.invalid_steps == (count if often else 0)
        env.tensors["qvel"][4, 1] = 123.0
        step = env.step(torch.zeros(6, 12, device=torch_device))
        assert step.invalid.tolist() == [False] * 4 + [True, False]
        env.reset(step.invalid)
        if often and count < 10:
            env.check()
    wanted = r"World 4: its speed was 1[12]\d.* 11 of the last 66 world-steps were invalid, more than 0.1 % of 10000"
    with pytest.raises(SimulationError, match=wanted):
        env.check()
    env.check()
    assert env.report()["invalid_steps"] == 11
    assert env.report()["invalid_steps"] == 0


def test_invalid_worlds_are_forgotten_after_a_window(torch_device):
    """Ten invalid world-steps in every window of 10 000 or more are no reason to stop, for however long."""
    env = build(torch_device, num_envs=512)
    for _ in range(3):
        env.tensors["qvel"][:10, 1] = 123.0
        for _ in range(20):
            step = env.step(torch.zeros(512, 12, device=torch_device))
            env.reset(step.terminated | step.truncated)
            env.check()
    assert env.report()["invalid_steps"] == 30


def test_a_goal_that_is_not_finite_breaks_its_world(torch_device):
    """A NaN goal is named like a broken state, and the world that has it begins anew under a sound one."""
    env = build(torch_device, episode_steps=200, goal_period=100)
    loop = build_loop(env)
    goal = env.goal[:1].clone()
    goal[0, 1] = torch.nan
    env.set_goals(rows_of(env, 3), goal)
    step = env.step(actions(6, torch_device))
    assert step.invalid.tolist() == [False, False, False, True, False, False]
    assert env.describe_fault(3) == "its goal was nan"
    loop.advance(step)
    assert bool(env.obs.isfinite().all())
    assert not env.step(actions(6, torch_device)).invalid.any()


def test_buffers_too_small_say_how_large_they_had_to_be(torch_device):
    """The message names the bit, the buffer, its size, what was needed and the flag, and no other buffer."""
    env = build(torch_device, physics=PhysicsConfig(rows=8))
    for _ in range(20):
        env.step(actions(6, torch_device))
    message = (
        r"lost contacts \(NEFC: up to \d+ constraint rows .* were needed, the buffer holds 8; raise physics.rows\)"
    )
    with pytest.raises(SimulationError, match=message):
        env.check()


@pytest.mark.parametrize(("seconds", "steps"), [(0.0, 0), (0.009, 1), (0.02, 1), (0.3, 15)])
def test_pushes_come_as_often_as_they_are_asked_for(torch_device, seconds, steps):
    """An interval shorter than a step is a push on every step, and only 0 is none."""
    assert build(torch_device, num_envs=1, push_interval=seconds).legged.params.push_interval == steps


def test_terrain_of_fine_cells_is_refused(torch_device, tmp_path):
    """On cells finer than those that its geoms were tried on no robot is built, and the message says what to do."""
    ground = terrain.build(Grid(shapes=(Share(shape=Stairs(tile=4.0)),), levels=1, columns=1, tile=4.0, cell=0.025))
    ground.save(tmp_path / "fine.npz")
    with pytest.raises(ValueError, match=r"terrain must have cells of at least 0.05 m .*got 0.025 m.*--cell 0.05"):
        build(torch_device, terrain=str(tmp_path / "fine.npz"))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_broken_action_stops_the_run(torch_device, value):
    """A single action that is not finite is an error at once, with the world's number."""
    env = build(torch_device)
    action = actions(6, torch_device)
    action[3, 5] = value
    env.step(action)
    with pytest.raises(SimulationError, match="World 3: its action is not finite"):
        env.check()


@pytest.mark.parametrize("shape", [(6,), (6, 11), (5, 12), (1, 12)])
def test_actions_of_another_shape_are_refused(torch_device, shape):
    """Actions are never broadcast."""
    env = build(torch_device)
    with pytest.raises(ValueError, match=r"action must have the shape \(6, 12\), got"):
        env.step(torch.zeros(shape, device=torch_device))


def test_actions_are_what_the_joints_can_do(torch_device):
    """However large an action, targets end where the joints' ranges do, and the policy sees what was done."""
    env = build(torch_device, num_envs=2, noise=False)
    low, high = np.array([joint.range for joint in env.robot.joints]).T
    ends = np.array([joint.action_range for joint in env.robot.joints])
    np.testing.assert_allclose(POSE + 0.25 * ends.T, [low, high], atol=1e-12)
    assert env.action_bound == pytest.approx(np.abs(ends).max())
    np.testing.assert_allclose(torch.stack(env.action_range), ends.T, rtol=1e-6)
    step = env.step(torch.tensor([[1e6], [-1e6]], device=torch_device).expand(2, 12))
    np.testing.assert_allclose(env.physics.arrays.ctrl.numpy(), [high, low], rtol=0, atol=1e-6)
    np.testing.assert_allclose(step.obs[:, 36:48].cpu(), ends.T[::-1], rtol=1e-6)


NEW_ROBOT = '''
from dataclasses import replace
from deimos.sim.legged.robots import go1

def build(*, stiffness=40.0, damping=1.0, action_scale=0.2):
    """A Go1 with other gains that starts a little higher."""
    return replace(go1.build(stiffness=stiffness, damping=damping, action_scale=action_scale), spawn_height=0.5)
'''


def test_a_robot_is_one_file(torch_device, tmp_path, monkeypatch):
    """A file in the folder of robots is a robot: its name is known, its numbers are the task's, and it steps."""
    (tmp_path / "newcomer.py").write_text(NEW_ROBOT)
    monkeypatch.setattr(robots, "__path__", [*robots.__path__, str(tmp_path)])
    env = build(torch_device, robot="newcomer")
    assert [joint.stiffness for joint in env.robot.joints] == [40.0] * 12
    assert bool((env.tensors["qpos"][:, 2] == 0.5).all())
    assert bool(env.step(actions(6, torch_device)).obs.isfinite().all())
    softer = build(torch_device, robot="newcomer", stiffness=20.0)
    assert {(joint.stiffness, joint.damping) for joint in softer.robot.joints} == {(20.0, 1.0)}


def test_the_data_hold_what_a_deployment_reads(torch_device):
    """Joint names in order, default pose, action scale, gains, torque limits and the control period are at hand."""
    env = build(torch_device)
    assert [joint.name for joint in env.robot.joints[:3]] == ["FL_hip", "FL_thigh", "FL_calf"]
    np.testing.assert_array_equal([joint.pose for joint in env.robot.joints], POSE)
    assert {(joint.action_scale, joint.stiffness, joint.damping) for joint in env.robot.joints} == {(0.25, 30.0, 0.8)}
    assert [joint.max_torque for joint in env.robot.joints[:3]] == [23.7, 23.7, 35.55]
    assert env.config.physics.control_period == env.dt == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"goal_period": 1001}, "goal_period must be at most an episode of 1000 steps, got 1001"),
        ({"goal_period": 0}, "goal_period must be at least 1, got 0"),
        ({"levels": "up"}, "levels must be one of frozen, reward, displacement, got 'up'"),
        ({"friction": (0.01, 1.0)}, r"friction must be a range within \[0.05, inf\), got \(0.01, 1.0\)"),
        ({"friction": (1.0, 0.5)}, "friction must be a range"),
        ({"payload": -1.0}, r"payload must be in \[0, 1e\+06\], got -1.0"),
        ({"stiffness": 0.0}, "stiffness must be finite and positive, got 0.0"),
        ({"robot": "spot"}, "robot must be one of go1, go1_rx150, or the path of a .*, got 'spot'"),
        ({"rewards": RewardWeights(tilt=math.nan)}, "rewards.tilt must be finite, got nan"),
    ],
)
def test_config_rejects_bad_values(config, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        Config(**config)


def test_robots_start_on_the_terrain(torch_device, tmp_path):
    """Ground that ends where robots start is refused with the border that it lacks; with it, none leaves at once."""

    def tiles(border):
        shape = Share(shape=Flat(tile=2.0, platform=1.0))
        grid = Grid(shapes=(shape,), levels=3, columns=3, tile=2.0, border=border, cell=0.1)
        terrain.build(grid).save(tmp_path / "tiles.npz")
        return build(torch_device, num_envs=64, terrain=str(tmp_path / "tiles.npz"), stagger=False)

    with pytest.raises(ValueError, match=r"terrain must reach 1.3 m .*, got 1 m; .* or its border wider by 0.3 m"):
        tiles(border=0.0)
    env = tiles(border=0.3)
    step = env.step(torch.zeros(64, env.action_dim, device=torch_device))
    assert not step.truncated.any()


def test_a_run_keeps_its_terrain(tmp_path, monkeypatch, hills):
    """A run resumes and is evaluated in any folder, with the terrain file gone and its own folder moved."""
    (tmp_path / "before").mkdir()
    (tmp_path / "after").mkdir()
    monkeypatch.chdir(tmp_path / "before")
    shutil.copy(hills, "mine.npz")
    config = deimos.TrainConfig(
        env=Config(goal_period=5, episode_steps=40, terrain="mine.npz"), method="uniform", num_envs=8, env_steps=192,
        ppo=PPOConfig(hidden=(8,)), evaluation=False, device="cpu", threads=1,
    )  # fmt: skip
    run = deimos.train(config, "run")
    run.rename(tmp_path / "after" / "run")
    Path("mine.npz").unlink()
    monkeypatch.chdir(tmp_path / "after")
    trainer, folder = training.resume(Path("run"), env_steps=384)
    assert np.array_equal(trainer.env.terrain.heights, terrain.load(hills).heights)
    training.train(trainer, folder)
    again, _ = training.resume(Path("run"), env_steps=576)  # once more: resuming wrote the configuration anew
    stored = folder.read_json("config.json")["config"]
    assert (stored["env"]["terrain"], stored["env_steps"]) == ("mine.npz", 576)  # where it came from is not forgotten
    assert again.env.terrain.shapes == ("stairs-up", "stairs-down")
    monkeypatch.chdir(tmp_path)
    naive, *_ = deimos.evaluate("after/run", worlds=4, steps=20)
    assert naive["steps"] == 20


def test_unknown_and_broken_terrains_are_refused(tmp_path):
    """A terrain that is neither a name nor a file, and a file that is not one, each give one clear line."""
    with pytest.raises(ValueError, match=r"terrain must be flat, rough or the path of a terrain file, got 'moon'"):
        Config(terrain="moon").load_terrain()
    with pytest.raises(ValueError, match=r"got 'h.stl'; make one of it by: deimos terrain import h.stl --out h.npz"):
        Config(terrain="h.stl").load_terrain()
    (tmp_path / "x.npz").write_bytes(b"no terrain")
    with pytest.raises(ValueError, match="is not a terrain file"):
        Config(terrain=str(tmp_path / "x.npz")).load_terrain()
