"""Quad+arm: the task of the arm on the Go1; what it shares with Quad is shown in test_deimos_env_quad_state.py."""

import dataclasses
import functools
import itertools
import math

import mujoco
import numpy as np
import pytest
import quad_worlds
import torch
from deimos.kernels.legged.arm_goals import SHELL_HIGH, SHELL_LOW
from deimos.kernels.legged.arm_rewards import ARM_TERMS, ArmWeights
from deimos.kernels.legged.state import COLUMNS
from worlds import build_loop, rows_of

from deimos import plugins
from deimos.goals.selectors import cl, director
from deimos.run import presets
from deimos.run.loop import GoalLoop, spaces
from deimos.sim import envs, warp_env
from deimos.sim.envs import particle, quad, quad_arm
from deimos.sim.envs.quad_arm import Config
from deimos.sim.legged import task as locomotion
from deimos.sim.legged.robots import go1_rx150 as rx150

MIDDLE, HALF = (np.array(SHELL_HIGH) + SHELL_LOW) / 2, (np.array(SHELL_HIGH) - SHELL_LOW) / 2
SCALE = torch.tensor([2.0, 2.0, 0.25, 1.0, 1.0, 1.0])
actions, build = (functools.partial(make, task="quad-arm") for make in (quad_worlds.actions, quad_worlds.build))


def places_of(goals):
    """Places of the arm's parts of goals relative to the origin [m], shape (..., 3)."""
    distance, pitch, yaw = np.moveaxis(MIDDLE + np.asarray(goals, np.float64) * HALF, -1, 0)
    level = distance * np.cos(pitch)
    return np.stack([level * np.cos(yaw), level * np.sin(yaw), distance * np.sin(pitch)], axis=-1)


def test_observation_is_quads_with_the_arm_in_it(torch_device):
    """Goal, joints and actions are longer by the arm's, and the end effector stands before the heights."""
    env = build(torch_device)
    assert [(field.name, field.size, field.scale) for field in env.layout] == [
        ("linear_velocity", 3, 2.0), ("angular_velocity", 3, 0.25), ("gravity", 3, 1.0),
        ("goal", 6, (2.0, 2.0, 0.25, 1.0, 1.0, 1.0)), ("joint_position", 17, 1.0), ("joint_velocity", 17, 0.05),
        ("last_action", 17, 1.0), ("end_effector", 3, 1.0), ("heights", 187, 5.0),
    ]  # fmt: skip
    assert (env.obs_dim, env.goal_dim, env.action_dim) == (256, 6, 17)
    assert env.goal_groups == (slice(0, 2), slice(2, 3), slice(3, 6))
    assert env.goal_group_names == ("velocity", "yaw rate", "end effector")
    noise = [0.2] * 3 + [0.05] * 6 + [0.0] * 6 + [0.01] * 17 + [0.075] * 17 + [0.0] * 17 + [0.01] * 3 + [0.5] * 187
    np.testing.assert_allclose(env.legged.sensing.noise.numpy(), noise, rtol=1e-6)


def test_end_effector_is_where_mujoco_has_it(torch_device):
    """Observation, error and tracking follow from MuJoCo's own kinematics and the goal, whatever the robot does."""
    env = build(torch_device, num_envs=8, noise=False, goal_period=30)
    for _ in range(12):
        step = env.step(actions(8, torch_device))
    for i in range(8):
        data = env.scene(i)[1]
        tip = data.site("end_effector").xpos - data.qpos[:3]
        rotation = data.body("trunk").xmat.reshape(3, 3)
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        c, s = math.cos(yaw), math.sin(yaw)
        place = np.array([c * tip[0] + s * tip[1], c * tip[1] - s * tip[0], tip[2] + data.qpos[2] - 0.325])
        place -= rx150.SHOULDER
        goal = env.tensors["goal"][i, 3:].cpu().numpy()
        error = np.linalg.norm(place - places_of(goal))
        x, y, z = place
        seen = (np.array([np.linalg.norm(place), math.atan2(z, math.hypot(x, y)), math.atan2(y, x)]) - MIDDLE) / HALF
        assert float(env.errors["end effector [m]"][i]) == pytest.approx(error, abs=5e-6)
        np.testing.assert_allclose(step.obs[i, 66:69].cpu(), np.clip(seen, -2, 2), atol=2e-4)
        assert float(step.tracking[i, 2]) == pytest.approx(np.exp(-np.abs(seen - goal).sum() / 2), rel=1e-3)


def test_errors_are_a_view(torch_device):
    """The error keeps its address, and the report has its mean."""
    env = build(torch_device)
    assert list(env.errors) == ["end effector [m]"]
    error = env.errors["end effector [m]"]
    assert error.shape == (6,)
    address, before = error.data_ptr(), error.clone()
    env.step(actions(6, torch_device))
    assert env.errors["end effector [m]"].data_ptr() == address
    assert not torch.equal(error, before)
    assert env.report()["end_effector_error"] == pytest.approx(float(error.mean()))


@pytest.mark.parametrize("ground", ["flat", "rough"])
def test_goals_are_shown_where_they_are(ground, torch_device):
    """The place of a goal in the scene is as far from MuJoCo's end effector as the environment says."""
    env = build(torch_device, num_envs=3, terrain=ground)
    for step in range(3):
        env.step(actions(3, torch_device, seed=step))
    for world in range(3):
        model, data = env.scene(world)
        mujoco.mj_kinematics(model, data)
        distance = np.linalg.norm(data.site("end_effector").xpos - env.goal_point(world))
        # float32 places the robots of large terrains to some um.
        assert distance == pytest.approx(env.errors["end effector [m]"][world].item(), abs=1e-5)


def test_reward_is_the_sum_of_its_columns(torch_device):
    """The arm's columns come last, count before the clip at 0, and all of them sum to the reward and in the report."""
    env = build(torch_device, num_envs=32)
    assert env.columns == (*COLUMNS, *ARM_TERMS)
    loop = build_loop(env)
    total, clipped = 0.0, 0
    for _ in range(30):
        step = env.step(actions(32, torch_device))
        torch.testing.assert_close(env.term.sum(1), step.reward, rtol=0, atol=1e-5)
        assert bool((step.reward >= 0).all())
        clipped += int((env.term[:, COLUMNS.index("clipping")] > 0).sum())
        total += float(step.reward.mean()) / 30
        loop.advance(step)
    assert 0 < clipped < 30 * 32
    report = env.report()
    assert sum(report[f"reward/{name}"] for name in env.columns) == pytest.approx(total, abs=1e-6)
    assert report["reward/reach"] > 0 > report["reward/arm_energy"]


def test_goals_are_valid_and_cover_the_shell(torch_device):
    """Of 100 000 candidates and all first goals, none is in the robot or near level ground; all of the box is used."""
    env = build(torch_device, num_envs=200)
    goals = (env.sample_goals(rows_of(env), 500).cpu() / SCALE).numpy().reshape(-1, 6)
    first = env.tensors["goal"].cpu().numpy()
    assert np.abs(goals).max() <= 1
    in_trunk = places_of(np.concatenate([goals, first])[:, 3:]) + rx150.SHOULDER
    margin = rx150.GRIPPER_RADIUS - 1e-6
    low, high = np.array(rx150.BODY[0]) - margin, np.array(rx150.BODY[1]) + margin
    assert not ((in_trunk > low) & (in_trunk < high)).all(axis=1).any()
    assert in_trunk[:, 2].min() + 0.325 > 0.15
    counts = np.histogramdd(goals[:, 3:], bins=4, range=[(-1, 1)] * 3)[0]
    assert counts[:, 2:].min() > 0.9 * 100_000 / 64
    # The velocity goals are what Quad's are.
    twin = quad.Config(goal_period=5, episode_steps=40, engine="warp").build(200, torch_device, 0)
    assert torch.equal(env.sample_goals(rows_of(env), 7)[..., :3], twin.sample_goals(rows_of(twin), 7))


def test_first_draws_of_a_goal_do_not_depend_on_the_rest(torch_device):
    """Redrawn goals too are a function of seed, world, number of the goal and candidate: policies meet the same."""
    env = build(torch_device, num_envs=40)
    long = env.sample_goals(rows_of(env), 50).clone()
    assert torch.equal(env.sample_goals(rows_of(env), 6), long[:, :6])
    some = torch.tensor([31, 4, 7], device=torch_device)
    assert torch.equal(env.sample_goals(some, 50), long[some])
    for _ in range(4):
        env.step(actions(40, torch_device, scale=0.1))
    assert torch.equal(env.sample_goals(rows_of(env), 50), long)
    shifted = build(torch_device, num_envs=10, env_offset=30)
    assert torch.equal(shifted.sample_goals(rows_of(shifted), 50), long[30:])


def test_share_of_the_range_holds_for_the_arm(torch_device):
    """Candidates and first goals from a share of the range stay in it, the redrawn ones too."""
    env = build(torch_device, num_envs=300)
    share = torch.tensor([0.5, 0.5, 1.0, 1.0, 0.9, 0.25], device=torch_device)
    goals = env.sample_goals(rows_of(env), 100, share).abs().amax((0, 1)).cpu()
    assert bool((goals <= share.cpu() * SCALE).all())
    assert bool((goals > 0.95 * share.cpu() * SCALE).all())
    env.reset(torch.ones(300, dtype=torch.bool, device=torch_device), share)
    assert bool((env.tensors["goal"].abs().amax(0) <= share).all())


def test_speed_of_zero_asks_to_stand(torch_device):
    """With speed 0 the velocity goals are 0 exactly, and selectors have only finite numbers to choose by."""
    env = build(torch_device, num_envs=12, speed=0.0, goal_period=3)
    assert not env.tensors["goal"][:, :3].any()
    assert not env.sample_goals(rows_of(env), 30)[..., :3].any()
    assert env.sample_goals(rows_of(env), 30)[..., 3:].abs().amax() > 0.9
    half = build(torch_device, num_envs=50, speed=0.5)
    assert 0.45 < float(half.tensors["goal"][:, :3].abs().max()) <= 0.5
    for config in (cl.Config(), director.Config(candidates=5)):
        loop = GoalLoop(env, config.build(spaces(env), 0))
        loop.start()
        for _ in range(8):
            loop.advance(env.step(actions(12, torch_device)))
        assert not env.goal[:, :3].any()
        assert bool(env.obs.isfinite().all())


def test_the_arm_starts_near_its_pose_and_clear_of_the_trunk(torch_device):
    """First joint angles of the arm are within 0.2 rad of its pose, and nothing of it touches anything."""
    env = build(torch_device, num_envs=60)
    offset = env.tensors["qpos"][:, 19:].cpu() - torch.tensor(rx150.POSE)
    assert float(offset.abs().max()) <= 0.2 + 1e-6
    assert float(offset.abs().amax(0).min()) > 0.15
    for world in range(60):
        model, data = env.scene(world)
        assert data.ncon == 0
        mujoco.mj_forward(model, data)
        assert data.site("end_effector").xpos[2] > data.qpos[2] + 0.1


def test_a_held_trunk_does_not_move(torch_device):
    """With the trunk held, wild actions of arm and legs move it by less than 2 mm and 0.5 degrees in 4 s."""
    env = build(torch_device, hold_trunk=True, goal_period=100, episode_steps=500)
    before = env.tensors["qpos"][:, :7].clone()
    angles = env.tensors["qpos"][:, 7:].clone()
    for t in range(200):
        step = env.step(actions(6, torch_device, seed=t // 20, scale=2.0))
        assert not step.terminated.any()
        assert not step.invalid.any()
    after = env.tensors["qpos"]
    assert float((after[:, :3] - before[:, :3]).abs().max()) < 2e-3
    # The angle of a small turn is twice the change of the quaternion's vector part.
    assert float((after[:, 3:7] - before[:, 3:7]).abs().max()) < math.radians(0.5) / 2
    assert float((after[:, 7:] - angles).abs().amax(0).min()) > 0.1


def test_evaluation_is_quads(torch_device):
    """Randomisations and the time limit are off, the task of the arm stays as it is."""
    config = Config(speed=0.0, arm_rewards=ArmWeights(reach=0.7), goal_period=100)
    quiet = config.for_evaluation()
    assert quiet == dataclasses.replace(
        config, levels="frozen", friction=(1.0, 1.0), payload=0.0, push_interval=0.0, noise=False, stagger=False,
        episode_steps=0,
    )  # fmt: skip
    assert quiet.with_goal_period(500).speed == 0.0


def test_presets():
    """The command line's names, however spelled, lead to the environment; all presets but one ask it to walk too."""
    for name in ("quad-arm", "quad_arm", "quad-arm-stand", "quad-arm-walk", "quad-arm-reach", "quad-arm-large"):
        assert plugins.load(envs, presets.environment(name)) is quad_arm
        assert presets.preset(name).env.speed == (0.0 if name == "quad-arm-stand" else 1.0)
        assert not presets.preset(name).env.hold_trunk
    assert "quad_arm" not in presets.names()
    stand = presets.preset("quad-arm-stand")
    assert (stand.env.noise, stand.ppo.discount, stand.ppo.hidden) == (False, 0.95, (256, 128, 64))
    assert (stand.eval.worlds, stand.eval.steps) == (256, 1000)
    assert presets.preset("quad-arm-large").env.terrain == "rough"


def test_the_environments_share_their_code_not_their_lines():
    """No run of six lines stands in two of the environments' files, or in one and in what they share."""
    runs = []
    for module in (quad, quad_arm, particle, locomotion, warp_env):
        with open(module.__file__, encoding="utf-8") as file:
            lines = [line.strip() for line in file if line.strip()]
        runs.append({tuple(lines[i : i + 6]) for i in range(len(lines) - 5)})
    for first, second in itertools.combinations(runs, 2):
        assert not first & second


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"speed": 1.5}, r"speed must be in \[0.*1.*\], got 1.5"),
        ({"speed": math.nan}, r"speed must be in \[0.*1.*\], got nan"),
        ({"arm_rewards": ArmWeights(reach=math.inf)}, "arm_rewards.reach must be finite, got inf"),
        ({"robot": "nobody"}, "robot must be one of go1, go1_rx150, or the path of a .*, got 'nobody'"),
        ({"goal_period": 1001}, "goal_period must be at most an episode of 1000 steps, got 1001"),
    ],
)
def test_config_rejects_bad_values(config, message):
    """The message names the field, what it must be and what it was; what Quad refuses is refused here too."""
    with pytest.raises(ValueError, match=message):
        Config(**config)


def test_actions_of_the_legs_alone_are_refused(torch_device):
    """Twelve actions are not seventeen."""
    env = build(torch_device)
    with pytest.raises(ValueError, match=r"action must have the shape \(6, 17\), got \(6, 12\)"):
        env.step(torch.zeros(6, 12, device=torch_device))


def test_a_robot_without_an_arm_is_refused(torch_device):
    """Goals of an end effector need one."""
    with pytest.raises(ValueError, match="robot must have an arm"):
        build(torch_device, robot="go1")
