"""Quad: the task of the thesis on the Go1: observation, reward, crash, goals, randomisation and actions."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from deimos.kernels.legged.height_scan import scan_points
from deimos.kernels.legged.rewards import RewardWeights
from deimos.kernels.legged.state import COLUMNS
from deimos.kernels.random import Purpose
from quad_worlds import actions, build
from worlds import build_loop, mask_of, rows_of

from deimos.sim.envs.quad import Config
from deimos.sim.legged import robots
from deimos.sim.legged.robots import go1

POSE = np.tile([0.1, 0.8, -1.5, -0.1, 0.8, -1.5], 2)


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
    env = build(simulator.device, engine=simulator.engine, num_envs=40, seed=5, env_offset=100)
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


def test_a_fixed_friction_is_that_of_any_robot(torch_device, monkeypatch):
    """Feet that are slippery by their robot's own file have the configuration's friction all the same."""
    robot = go1.build()
    for foot in (name for part in robot.parts[1:5] for name in part):
        robot.spec.geom(foot).friction = (0.6, 0.005, 0.0001)
    monkeypatch.setattr(Config, "make_robot", lambda self: robot)
    env = build(torch_device, engine="auto", friction=(1.0, 1.0))
    assert set(env.physics.tensors["geom_friction"][:, :, 0].ravel().tolist()) == {1.0}


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


@pytest.mark.parametrize(("seconds", "steps"), [(0.0, 0), (0.009, 1), (0.02, 1), (0.3, 15)])
def test_pushes_come_as_often_as_they_are_asked_for(torch_device, seconds, steps):
    """An interval shorter than a step is a push on every step, and only 0 is none."""
    assert build(torch_device, num_envs=1, push_interval=seconds).legged.params.push_interval == steps


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
