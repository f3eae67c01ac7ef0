"""Robots of exports: MuJoCo alone simulates and measures what the environment does."""

import itertools
import json

import mujoco
import numpy as np
import pytest
import torch
from deimos.terrain.shapes.stairs import Shape as Stairs
from robot_models import write_mule

from deimos import terrain
from deimos.checks import RunError
from deimos.run import export_controller, export_robot
from deimos.sim.envs import quad, quad_arm
from deimos.sim.legged import robot_draft, robot_file
from deimos.sim.legged.robots import go1

CPU = torch.device("cpu")


def test_a_model_that_would_be_rounded_is_refused(tmp_path, monkeypatch):
    """With the six digits that MuJoCo writes by itself, the export fails instead of writing another robot."""
    env = quad.Config(engine="native").for_evaluation().build(1, CPU, seed=0)
    monkeypatch.setattr(export_robot, "_to_xml", lambda spec: spec.to_xml())
    with pytest.raises(RunError, match=r"differs from this robot's in .*armature"):
        export_robot.write_model(env, tmp_path)


def test_a_robot_of_meshes_moves_alone_as_it_does_here(tmp_path):
    """What MuJoCo writes of the looks of a robot file's robot keeps no export back, and its physics are the same."""
    file = tmp_path / "mule.toml"
    file.write_text(robot_file.to_toml(robot_draft.draft(write_mule(tmp_path), ("nod",))[0]))
    env = quad.Config(robot=str(file), engine="native").for_evaluation().build(2, CPU, seed=0)
    assert env.physics.model.nmesh
    export_robot.write_model(env, tmp_path)
    (tmp_path / "deploy.json").write_text(json.dumps({"robot": export_robot.describe_robot(env)}))
    start = [env.tensors[name].double().numpy() for name in ("qpos", "qvel")]
    worlds = export_controller.Simulation(tmp_path, *start)
    for _ in range(5):
        env.step(torch.zeros(2, 12))
        worlds.step(np.tile(env.robot.pose, (2, 1)))
    found = np.array([data.qpos for data in worlds.robots])
    np.testing.assert_allclose(found, env.tensors["qpos"].numpy(), rtol=0, atol=1e-4)
    assert np.abs(found[:, 2] - start[0][:, 2]).max() > 1e-3


def test_a_robot_that_slips_is_exported_as_it_was_evaluated(tmp_path, monkeypatch):
    """Where a robot's own feet have another friction than an evaluation's, the model has the evaluation's."""
    build = go1.build

    def slippery(**gains):
        robot = build(**gains)
        for foot in itertools.chain.from_iterable(robot.parts[1:5]):
            robot.spec.geom(foot).friction[0] = 0.6
        return robot

    monkeypatch.setattr(go1, "build", slippery)
    env = quad.Config(engine="native").for_evaluation().build(1, CPU, seed=0)
    export_robot.write_model(env, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    assert {model.geom(foot).friction[0] for foot in itertools.chain.from_iterable(env.robot.parts[1:5])} == {1.0}


@pytest.fixture(scope="module")
def stairs(tmp_path_factory):
    """A file of steep stairs."""
    path = tmp_path_factory.mktemp("ground") / "stairs.npz"
    grid = terrain.Grid(
        shapes=(terrain.Share(shape=Stairs()),), levels=1, columns=1, tile=6.0, border=2.0, hardest=0.7, easiest=0.7
    )
    terrain.build(grid).save(path)
    return path


def test_what_the_controller_measures_is_what_the_policy_saw(stairs, tmp_path):
    """On stairs, heights, end effector and all else in MuJoCo alone are the environment's observation."""
    env = quad_arm.Config(terrain=str(stairs), engine="native").for_evaluation().build(8, CPU, seed=3)
    export_robot.write_model(env, tmp_path)
    deploy = {"robot": export_robot.describe_robot(env)}
    (tmp_path / "deploy.json").write_text(json.dumps(deploy))
    action = torch.zeros(8, env.action_dim)
    for _ in range(20):
        env.step(action)
    worlds = export_controller.Simulation(
        tmp_path, env.tensors["qpos"].double().numpy(), env.tensors["qvel"].double().numpy()
    )
    scale = torch.cat([torch.as_tensor(field.scale).expand(field.size) for field in env.layout])
    seen = (env.obs / scale).split([field.size for field in env.layout], dim=1)
    known = {field.name: part.numpy() for field, part in zip(env.layout, seen, strict=True)}
    measured = worlds.measure(known["goal"])
    assert measured.keys() == known.keys() - {"last_action"}
    assert np.ptp(measured["heights"]) > 0.1
    for name, value in measured.items():
        bound = export_robot.CLIPS.get(name, np.inf)
        np.testing.assert_allclose(np.clip(value, -bound, bound), known[name], atol=2e-4, err_msg=name)
