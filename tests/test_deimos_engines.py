"""Two engines, one face: they agree with each other, and what only the native one has to promise."""

import math
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from deimos.terrain import Grid, Share
from deimos.terrain.shapes.stairs import Shape as Stairs

import deimos
from deimos import terrain
from deimos.app import cli
from deimos.checks import SimulationError
from deimos.goals.selectors import uniform
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.config import from_dict, to_dict
from deimos.run.evaluation import EvalConfig, play
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop, spaces
from deimos.run.trainer import TrainConfig
from deimos.sim.env import EnvConfig
from deimos.sim.envs import particle, quad, quad_arm
from deimos.sim.legged import engines
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.robots import go1

CPU = torch.device("cpu")
WALKER = Path(__file__).parent.parent / "docs" / "results" / "quad_flat"
ENGINES = ("warp", "native")


@pytest.fixture(scope="module")
def hill():
    """A small hill of stairs with risers of 0.14 m."""
    shape = Share(shape=Stairs(tile=4.0, platform=1.0, direction="down"))
    return terrain.build(Grid(shapes=(shape,), levels=1, columns=1, tile=4.0, border=1.0, hardest=0.5, easiest=0.5))


@pytest.fixture
def threads():
    """Sets torch's threads, which the native engine is made with; afterwards they are what they were."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def make(engine, num_envs, ground=None, robot=None, substeps=4):
    """Worlds with Go1s in their default pose."""
    robot = robot or go1.build()
    physics = engines.build(engine, robot, ground, num_envs, CPU, PhysicsConfig(substeps=substeps))
    qpos = physics.arrays.qpos.numpy()
    qpos[:, 7:] = robot.pose
    physics.arrays.ctrl.assign(qpos[:, 7:])
    return physics, qpos


def trajectories(engine, start, ground=None, steps=50, sway=0.0):
    """Positions after every control step, (steps, num_envs, nq), from bases at ``start`` (position and quaternion)."""
    physics, qpos = make(engine, len(start), ground)
    qpos[:, :7] = start
    pose, ctrl, path = qpos[:, 7:].copy(), physics.arrays.ctrl.numpy(), []
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, pose.shape)
    for t in range(steps):
        ctrl[:] = pose + sway * np.sin(0.2 * t + phase)
        physics.step()
        path.append(qpos.copy())
    return np.array(path)


def walk(engine, ground, num_envs=64, steps=100):
    """The committed policy under uniform goals, and what it did: positions, tracking, crashes, forces on the feet."""
    policy = deimos.load_policy(WALKER)
    config = quad.Config(engine=engine, terrain=ground, goal_period=50).for_evaluation()
    env = config.build(num_envs, CPU, seed=7)
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0))
    path, tracking, force, crashes = [], 0.0, 0.0, 0
    for _ in range(steps):
        with torch.no_grad():
            step = env.step(policy.scaled(env.obs))
        path.append(env.tensors["qpos"].numpy().copy())
        tracking = tracking + step.tracking.numpy() / steps
        force = force + env.physics.arrays.part_force.numpy()[:, :, 1:5].sum(2).mean(0) / steps
        crashes += int(step.terminated.sum())
        loop.advance(step)
    return np.array(path), tracking, force, crashes


def differences(paths, joints=True):
    """Largest difference of any joint, or of the base's position, in every world at every step."""
    part = slice(7, None) if joints else slice(0, 3)
    return np.abs(paths[0] - paths[1])[:, :, part].max(axis=2)


def test_engines_agree_in_free_flight():
    """Half a second of falling with swinging legs: base and joints to 1e-4, as float32 allows."""
    start = np.tile([0.0, 0.0, 5.0, 0.8, 0.6, 0.0, 0.0], (3, 1))
    paths = [trajectories(engine, start, steps=25, sway=0.4) for engine in ENGINES]
    np.testing.assert_allclose(paths[0], paths[1], rtol=0, atol=1e-4)
    assert paths[0][-1, 0, 2] < 4.0


def test_engines_agree_in_standing():
    """Set down on flat ground and swaying for a second: the base to a millimetre, joints to 5 mrad."""
    start = np.tile([0.0, 0.0, 0.325, 1.0, 0.0, 0.0, 0.0], (3, 1))
    paths = [trajectories(engine, start, sway=0.1) for engine in ENGINES]
    assert differences(paths, joints=False).max() < 1e-3
    assert differences(paths).max() < 5e-3


def test_engines_agree_in_a_fall_on_stairs(hill):
    """Dropped askew: until three steps after the first touch, the base to a millimetre and joints to 10 mrad."""
    start = np.array([[x, 0.3, hill.heights.max() + 0.45, math.cos(0.3), math.sin(0.3), 0, 0] for x in (0.0, 0.5, 0.9)])
    paths = [trajectories(engine, start, hill, steps=100) for engine in ENGINES]
    free = start[:, 2] - 0.5 * 9.81 * (0.02 * np.arange(1, 101)[:, None]) ** 2
    for world in range(3):  # from then on contacts lie on other sides of a prism's edge
        first = np.flatnonzero(paths[0][:, world, 2] > free[:, world] + 0.01)[0] + 3
        assert first < 40
        assert differences(paths, joints=False)[:first, world].max() < 1e-3
        assert differences(paths)[:first, world].max() < 1e-2
    ends = np.array([path[-1, :, 2] for path in paths])
    assert ((ends > hill.heights.min()) & (ends < hill.heights.max() + 0.45)).all()


def test_engines_agree_while_a_policy_walks():
    """On flat ground joints agree to 1e-5 rad for 8 steps in nearly all worlds, and to 1 mrad for 100 in most."""
    walked = [walk(engine, "flat") for engine in ENGINES]
    apart = differences([path for path, *_ in walked])
    assert np.quantile(apart[7], 0.95) < 1e-5
    assert np.median(apart[99]) < 1e-3  # 7e-6 when this was written; a foot that lands later parts the rest
    np.testing.assert_allclose(walked[0][1].mean(axis=0), walked[1][1].mean(axis=0), atol=2e-3)


def test_engines_agree_in_distribution_on_rough_ground():
    """Once contacts part, tracking, the feet's forces and crashes agree within 4 standard errors over the worlds."""
    walked = [walk(engine, "rough", num_envs=128) for engine in ENGINES]
    assert differences([path for path, *_ in walked])[-1].max() > 0.1, "they must have parted to be told apart"
    for quantity in (1, 2):
        a, b = (world[quantity].reshape(128, -1) for world in walked)
        error = np.sqrt((a.var(axis=0) + b.var(axis=0)) / 128)
        assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4 * error).all()
    crashes = [world[3] for world in walked]
    assert abs(crashes[0] - crashes[1]) <= 4 * math.sqrt(sum(crashes))


def test_threads_do_not_change_a_bit(threads):
    """Robots with arms on rough ground, some of which fall, and one that breaks: on one, two and five threads."""
    action = torch.tensor(np.random.default_rng(0).normal(size=(200, 17)), dtype=torch.float32)
    found, parts = [], []
    for count in (1, 2, 5):
        threads(count)
        env = quad_arm.Config(engine="native", terrain="rough").build(200, CPU, seed=1)
        threads(1)
        terminated = sum(env.step(action).terminated.clone() for _ in range(40))
        env.tensors["qvel"][[131, 190], 0] = 1e9
        step = env.step(action)
        assert step.invalid.nonzero().flatten().tolist() == [131, 190]
        assert env._views["fault"].tolist() == [2, 131, 200]
        names = ("obs", "reward", "tracking", "truncated", "goal_due")
        seen = {f"step {name}": getattr(step, name).clone() for name in names}
        found.append(env.state_dict() | {"terminated": terminated, "term": env.term.clone()} | seen)
        parts.append([(rows.start, rows.stop) for rows in env.physics.parts])
    assert parts == [[(0, 200)], [(0, 128), (128, 200)], [(0, 64), (64, 128), (128, 192), (192, 200)]]
    assert found[0]["terminated"].any()
    for other in found[1:]:
        assert all(torch.equal(value, other[name]) for name, value in found[0].items())


def test_doubles_are_cast_once_per_control_step():
    """From equal states MuJoCo C in double precision, substep after substep, rounds to the very same bits."""
    import mujoco

    physics, qpos = make("native", 1)
    qpos[:, 2] = 0.3
    for _ in range(30):
        physics.step()
    model = physics._batch.model
    data = mujoco.MjData(model)
    for name in ("qpos", "qvel", "ctrl"):
        getattr(data, name)[:] = getattr(physics.arrays, name).numpy()[0]
    data.qacc_warmstart[:] = physics.tensors["warmstart"][0].numpy()
    mujoco.mj_step(model, data, physics.config.substeps)
    physics.step()
    np.testing.assert_array_equal(physics.arrays.qvel.numpy()[0], data.qvel.astype(np.float32))
    np.testing.assert_array_equal(physics.tensors["warmstart"][0].numpy(), data.qacc_warmstart)


def test_a_lasting_step_allocates_no_arrays():
    """Steps, resets and copies leave every array where it is, MuJoCo's own too."""
    env = quad.Config(engine="native").build(4, CPU, seed=0)
    memory = env.physics._memory
    before = {name: array.ctypes.data for name, array in memory.items()}
    action = torch.zeros(4, 12)
    for _ in range(3):
        env.step(action)
        env.reset(torch.tensor([True, False, False, True]))
        env.copy_worlds(torch.tensor([1]), torch.tensor([2]))
    batch = env.physics._batch
    after = {name: batch.bind(name).ctypes.data for name in ("qpos", "qvel", "ctrl")}
    after |= {"state": batch.state.ctypes.data, "warning": batch.warning.ctypes.data}
    after |= {"torque": batch.bind("actuator_force").ctypes.data}
    assert after == {name: before[name] for name in after}


def crouching(memory):
    """Three worlds of a Go1 with an arena of so many bytes, the second with all of its geoms in the ground."""
    robot = go1.build()
    robot.spec.memory = memory
    physics, qpos = make("native", 3, robot=robot)
    qpos[:, 2], qpos[1, 2] = 5.0, 0.02
    return physics


def test_a_full_arena_is_a_loss_with_a_cause():
    """Contacts that the arena does not hold set the bits of their world alone, and the next step can be sound."""
    physics = crouching(16_000)
    physics.step()
    overflow = physics.arrays.overflow.numpy()
    assert overflow[1] & physics.lost_contacts
    assert not overflow[[0, 2]].any()
    cause = physics.explain_loss(int(overflow[1]))
    assert cause.startswith("CONTACTFULL: there were more contacts than the arena holds; raise memory")
    physics.arrays.overflow.zero_()
    physics.arrays.qpos.numpy()[1, 2] = 5.0
    physics.step()
    assert not physics.arrays.overflow.numpy().any()


def test_an_error_of_mujoco_names_the_world():
    """What MuJoCo cannot go on from ends the run in one line."""
    physics = crouching(30_000)
    with pytest.raises(SimulationError, match=r"^World 1: MuJoCo stops with 'mj_stackAlloc: out of memory[^\n]*'\.$"):
        physics.step()


def test_a_world_that_is_not_finite_stays_so_and_says_nothing(tmp_path, monkeypatch, capfd):
    """MuJoCo puts no world back by itself, prints nothing and writes no log; the environment sees and counts it."""
    monkeypatch.chdir(tmp_path)
    env = quad.Config(engine="native").build(3, CPU, seed=0)
    env.tensors["qvel"][1, 7] = math.nan
    step = env.step(torch.zeros(3, 12))
    assert step.invalid.tolist() == [False, True, False]
    assert env.tensors["qpos"][1].isnan().any()
    assert env.describe_fault(1).startswith("its position was nan")
    env.reset(step.invalid)
    assert not env.step(torch.zeros(3, 12)).invalid.any()
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == []


def test_the_native_engine_is_for_cpus():
    """On CUDA it says which engine is."""
    with pytest.raises(ValueError, match=r"^engine must be warp on cuda:0, got native; use --env\.engine warp, or"):
        engines.build("native", go1.build(), None, 1, torch.device("cuda", 0), PhysicsConfig())


def test_too_many_worlds_say_what_one_takes():
    """More worlds than memory holds are refused with the size of one."""
    with pytest.raises(MemoryError, match=r"^a world takes at least \d\.\d KiB$"):
        engines.build("native", go1.build(), None, 2**31 - 1, CPU, PhysicsConfig())


@pytest.mark.parametrize("config", [quad.Config(), quad_arm.Config()])
def test_auto_is_the_devices_engine(config):
    """mujoco-warp on CUDA, native on a CPU; whoever names an engine gets it; a particle has none."""
    assert config.engine == "auto"
    assert config.resolved(CPU).engine == "native"
    assert config.resolved(torch.device("cuda", 0)).engine == "warp"
    assert replace(config, engine="warp").resolved(CPU).engine == "warp"
    assert particle.Config().resolved(CPU) == particle.Config()


def test_an_unknown_engine_is_refused():
    """The message names the field and the engines."""
    with pytest.raises(ValueError, match="engine must be one of auto, warp, native, got 'bullet'"):
        quad.Config(engine="bullet")


TINY = TrainConfig(
    env=quad.Config(goal_period=4, episode_steps=30), method="uniform", num_envs=4, env_steps=8, device="cpu",
    threads=1, ppo=PPOConfig(hidden=(8,), num_steps=4, minibatches=1), evaluation=False,
)  # fmt: skip


def test_a_run_stores_what_auto_became(tmp_path):
    """Its configuration names the engine, and it goes on with that one, bit for bit."""
    whole, folder = training.start(replace(TINY, env_steps=16), tmp_path / "whole", None)
    assert training.read_config(folder).env == replace(TINY.env, engine="native")
    training.train(whole, folder)
    training.train(*training.start(TINY, tmp_path / "parts", None))
    resumed, folder = training.resume(tmp_path / "parts", env_steps=16)
    training.train(resumed, folder)
    rows = [(tmp_path / name / "progress.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]


def test_a_run_from_before_the_choice_goes_on_with_mujoco_warp(tmp_path):
    """A configuration and a checkpoint without an engine mean the only one that there was; a new one means auto."""
    trainer, folder = training.start(replace(TINY, env=replace(TINY.env, engine="warp")), tmp_path / "run", None)
    data = folder.read_json("config.json")
    del data["config"]["env"]["engine"]
    folder.write_json("config.json", data)
    checkpoint = trainer.state_dict()
    del checkpoint["made_for"]["env"]["engine"]
    trainer.load_state_dict(checkpoint)
    assert training.read_config(RunFolder.open(tmp_path / "run")).env.engine == "warp"
    plain = to_dict(quad.Config())
    del plain["engine"]
    assert from_dict(EnvConfig, plain).engine == "auto"
    assert from_dict(EnvConfig, plain, stored=True).engine == "warp"


def test_the_committed_policies_are_of_mujoco_warp():
    """The runs of 0.1.0 in docs/results are read as what they were trained on."""
    assert training.read_config(RunFolder.open(WALKER)).env.engine == "warp"


def test_a_run_is_evaluated_on_the_other_engine_too(tmp_path, capsys):
    """Its rows stand beside those of its own engine, in the folder and in the table; a second time replaces them."""
    tiny = EvalConfig(worlds=3, steps=12, adversary_steps=8)
    training.train(*training.start(replace(TINY, eval=tiny), tmp_path / "run", None))
    run = tmp_path / "run"
    own = deimos.evaluate(run, device="cpu")
    assert {row["engine"] for row in own} == {"native"}
    for _ in range(2):
        assert cli.main(["evaluate", str(run), "--env.engine", "warp", "--device", "cpu"]) == 0
        kept = RunFolder.open(run).read_json("evaluation.json")
        assert [(row["engine"], row["goals"]) for row in kept] == [
            (engine, goals) for engine in ("native", "warp") for goals in ("naive", "argmax", "scripted")
        ]
    text = capsys.readouterr().out
    assert "a goal every 4 steps, on warp" in text
    assert re.search(r"^simulated by( +warp){3}( +native){3}$", text, re.MULTILINE)


def test_a_particle_is_evaluated_on_no_engine(tmp_path, capsys):
    """Whoever asks for one is told that there is none."""
    config = replace(TINY, env=particle.Config(goal_period=4))
    training.train(*training.start(config, tmp_path / "run", None))
    assert cli.main(["evaluate", str(tmp_path / "run"), "--env.engine", "warp"]) != 0
    assert "deimos.sim.envs.particle.Config has no engine; it has: crash_penalty" in capsys.readouterr().err


def test_a_policy_walks_on_either_engine():
    """What was trained on mujoco-warp scores the same on the native engine, goal group by goal group."""
    policy = deimos.load_policy(WALKER)
    tracking = []
    for engine in ENGINES:
        env = quad.Config(engine=engine).for_evaluation().with_goal_period(50).build(48, CPU, seed=3)
        tracking.append(play(env, policy.scaled, uniform.Config().build(spaces(env), 0), 150)["tracking"])
    assert tracking[0] == pytest.approx(tracking[1], abs=0.02)
    assert min(tracking[0]) > 0.6
