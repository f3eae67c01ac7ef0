"""Exported policies: the same numbers in onnxruntime and MuJoCo alone, and nothing rounded."""

import ast
import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
import yaml
from short_training import CONFIG

from deimos.app import cli
from deimos.app.export import check
from deimos.goals.methods import method
from deimos.goals.selector import Spaces
from deimos.goals.selectors import director
from deimos.learn.policy import Policy
from deimos.nn.layout import ObsField, seen_by
from deimos.nn.networks import Actor
from deimos.run import export, export_controller, training
from deimos.run.export_onnx import IR_VERSION, OPSET, fear_model, policy_model
from deimos.run.folder import RunFolder
from deimos.sim.envs import quad

HOME = Path(__file__).resolve().parent.parent
WALK = HOME / "docs" / "results" / "quad_flat"
CPU = torch.device("cpu")
LAYOUT = (
    ObsField("speed", 2, "m/s", (2.0, 0.5), seen_by="critic"),
    ObsField("goal", 3, "m", 0.25),
    ObsField("angle", 4, "rad", 3.0),
)


def run_model(data, **inputs):
    """Outputs of an ONNX model for tensors."""
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    return [torch.from_numpy(out) for out in session.run(None, {key: value.numpy() for key, value in inputs.items()})]


def make_policy(activation, normalize, bound, layout=LAYOUT):
    """A policy of random weights."""
    random = torch.Generator().manual_seed(0)
    size = sum(field.size for field in layout)
    seen = seen_by("actor", layout, CPU)
    actor = Actor(size, (32, 16), 5, activation, 1.0, random, seen, normalize=normalize)
    if normalize:
        actor.normalizer.update(torch.randn(500, size, generator=random) * 3 + 1, torch.ones(500))
    return Policy(actor, (32, 16), activation, layout, bound, 0.02)


@pytest.fixture(scope="module")
def afraid():
    """A fear network of random weights, with a calibration of its own."""
    selector = director.Config(rule="argmax").build(Spaces(1, 6, 3, 10, CPU), 0)
    selector.calibration.prior, selector.calibration.temperature = -1.25, 1.75
    return selector


@pytest.fixture(scope="module")
def particles(tmp_path_factory):
    """Folder of a run in Particle Gym that has hardly learnt anything, with a fear network."""
    path = tmp_path_factory.mktemp("export") / "run"
    budget = "--no-evaluation --num-envs 256 --env-steps 96 --threads 1 --device cpu --ppo.hidden 16 --ppo.init-std 100"
    fast = "--env.goal-period 10 --env.max-speed 200 --env.max-force 100"
    assert cli.main(["train", *budget.split(), *fast.split(), "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def walker(tmp_path_factory):
    """The committed policy, exported with a check of 16 robots that walk for a second."""
    patch = pytest.MonkeyPatch()
    patch.setattr(export, "ROBOTS", 16)
    patch.setattr(export, "SECONDS", 1.0)
    out = tmp_path_factory.mktemp("export") / "go1"
    export.export_run(RunFolder.open(WALK), out, check=True)
    patch.undo()
    return out


@pytest.mark.parametrize("batch", [1, 7, 4096])
@pytest.mark.parametrize("bound", [0.5, float("inf")])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("activation", ["relu", "elu", "tanh"])
def test_a_policy_gives_the_same_actions(activation, normalize, bound, batch):
    """Physical observations of what the actor sees give its actions to 1e-5, for any batch."""
    policy = make_policy(activation, normalize, bound)
    obs = torch.randn(batch, 9, generator=torch.Generator().manual_seed(1))
    (action,) = run_model(policy_model(policy, {}), observation=obs[:, 2:].contiguous())
    torch.testing.assert_close(action, policy.physical(obs), rtol=0, atol=1e-5)
    assert (action.abs() <= bound).all()


def test_the_privileged_is_not_asked_for():
    """An observation that only the critic sees changes no action, and the file does not want it."""
    model = onnx.load_from_string(policy_model(make_policy("elu", True, 1.0), {"weights": "abc"}))
    assert [dim.dim_value or dim.dim_param for dim in model.graph.input[0].type.tensor_type.shape.dim] == ["batch", 7]
    assert {entry.key: entry.value for entry in model.metadata_props} == {"weights": "abc"}
    assert (model.ir_version, model.opset_import[0].version) == (IR_VERSION, OPSET)
    assert not any(constant.external_data for constant in model.graph.initializer)


@pytest.mark.parametrize("count", [1, 100])
@pytest.mark.parametrize("blind", [False, True])
def test_a_fear_network_gives_the_same_fear(afraid, blind, count):
    """Logits and calibrated probabilities of physical states and goals are those of the selector."""
    control = "state-blind" if blind else "none"
    selector = director.Config(rule="argmax", control=control).build(Spaces(1, 6, 3, 10, CPU), 0)
    selector.calibration.load_state_dict(afraid.calibration.state_dict())
    random = torch.Generator().manual_seed(1)
    state, goal, goals = (torch.randn(*shape, generator=random) for shape in ((50, 6), (50, 3), (50, count, 3)))
    scale, goal_scale = torch.tensor([2.0, 0.5, 3.0, 3.0, 3.0, 3.0]), torch.full((3,), 0.25)
    found = run_model(fear_model(selector, scale, goal_scale, {}), state=state, goal=goal, candidates=goals)
    logit = selector.score(state * scale, goal * goal_scale, goals * goal_scale)
    torch.testing.assert_close(found[0], logit, rtol=0, atol=1e-5)
    torch.testing.assert_close(found[1], selector.calibration.probability(logit), rtol=0, atol=1e-5)
    assert len(found[0].unique()) > 1


def test_the_controller_stands_alone():
    """The exported script imports the standard library, NumPy, onnxruntime and MuJoCo, and nothing of ours."""
    tree = ast.parse(Path(export_controller.__file__).read_text(encoding="utf-8"))
    found = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        for name in ([alias.name for alias in node.names] if isinstance(node, ast.Import) else [])
        + ([node.module] if isinstance(node, ast.ImportFrom) else [])
    }
    assert found - set(sys.stdlib_module_names) == {"numpy", "onnxruntime", "mujoco"}


def test_robots_walk_alone_as_they_did_at_the_export(walker, capfd):
    """Its own check, in a process without ours, finds the same actions and the same walk."""
    check(walker)
    said = capfd.readouterr().out
    assert "16 robots walk 1 s: 0 fall, at the export 0" in said
    assert "It is what was exported." in said


def test_a_check_finds_what_is_installed_for_its_user(tmp_path, monkeypatch, capsys):
    """Packages that the export finds outside of the environment, the check finds too, and no module beside it."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "own_package.py").write_text("WORD = 'found'")
    (tmp_path / "json.py").write_text("raise RuntimeError")
    (tmp_path / "controller.py").write_text("import json, own_package\nprint(own_package.WORD)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))
    check(tmp_path)
    assert capsys.readouterr().out == "found\n"


def some_measurements(controller):
    """What robots measure that stand in their default position, under no goal."""
    return {
        entry["name"]: np.zeros((len(controller.action), entry["size"]))
        for entry in controller.deploy["observation"] if entry["name"] != "last_action"
    }  # fmt: skip


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_a_controller_takes_no_number_that_is_none(walker, value):
    """A measurement that is not finite, or leaves float32, is refused, and the next sound one is answered as ever."""
    controller, other = (export_controller.Controller(walker, 2) for _ in range(2))
    measured = some_measurements(controller)
    for each in (controller, other):
        each.targets(measured)
    broken = measured | {"joint_velocity": measured["joint_velocity"].copy()}
    broken["joint_velocity"][1, 4] = value
    with np.errstate(over="ignore"), pytest.raises(ValueError, match=r"must be finite, got \[.*\] of robot 1"):
        controller.targets(broken)
    assert controller.action.any()
    targets = controller.targets(measured)
    assert np.isfinite(targets).all()
    np.testing.assert_array_equal(targets, other.targets(measured))


def test_a_controller_begins_anew(walker):
    """After a reset robots are controlled as at first, and those that it leaves out go on."""
    controller = export_controller.Controller(walker, 2)
    measured = some_measurements(controller)
    first, second = (controller.targets(measured) for _ in range(2))
    assert (first != second).any()
    controller.reset()
    np.testing.assert_array_equal(controller.targets(measured), first)
    controller.reset([0])
    third = controller.targets(measured)
    np.testing.assert_array_equal(third[0], first[0])
    np.testing.assert_array_equal(third[1], second[1])


def test_a_controller_is_for_robots_and_their_sizes(walker, tmp_path):
    """A measurement of another size, and an export without a robot, are named."""
    controller = export_controller.Controller(str(walker), 2)
    measured = some_measurements(controller) | {"gravity": np.zeros((1, 3))}
    with pytest.raises(ValueError, match=r"gravity must have shape \(2, 3\), got \(1, 3\)"):
        controller.targets(measured)
    (tmp_path / "deploy.json").write_text(json.dumps({"environment": "particle", "robot": None}))
    for make in (export_controller.Controller, lambda folder: export_controller.Simulation(folder, (), ())):
        with pytest.raises(ValueError, match="must be an export of a legged robot, got one of particle"):
            make(tmp_path)


def test_numbers_are_those_of_the_robot(walker):
    """Joints, gains, limits, scales and hashes of ``deploy.json`` are the robot's and the policy's to the last bit."""
    deploy = json.loads((walker / "deploy.json").read_text())
    robot = quad.Config().make_robot()
    for entry, joint in zip(deploy["robot"]["joints"], robot.joints, strict=True):
        assert (entry["name"], entry["default_position"]) == (joint.name, joint.pose)
        assert (entry["stiffness"], entry["damping"]) == (joint.stiffness, joint.damping)
        assert (entry["max_torque"], tuple(entry["range"])) == (joint.max_torque, joint.range)
    data = (walker / "policy.onnx").read_bytes()
    assert deploy["policy"]["sha256"] == hashlib.sha256(data).hexdigest()
    assert deploy["control_period"] == 0.02
    assert [entry["name"] for entry in deploy["observation"]][:4] == [
        "linear_velocity", "angular_velocity", "gravity", "goal",
    ]  # fmt: skip
    assert all(entry["source"] for entry in deploy["observation"])
    assert [entry["name"] for entry in deploy["goal"]["components"]] == ["velocity x", "velocity y", "yaw rate"]
    assert [entry["unit"] for entry in deploy["goal"]["components"]] == ["m/s", "m/s", "rad/s"]
    assert deploy["versions"]["training"]["deimos"]
    assert deploy["fear"] is deploy["shield"] is None


def test_unitrees_tools_find_their_order(walker):
    """``deploy.yaml`` lists gains by Unitree's motors, right legs first, and everything else in the policy's order."""
    deploy = json.loads((walker / "deploy.json").read_text())
    found = yaml.safe_load((walker / "deploy.yaml").read_text())
    names = [joint["name"] for joint in deploy["robot"]["joints"]]
    motors = [None] * 12
    for name, motor in zip(names, found["joint_ids_map"], strict=True):
        motors[motor] = name
    assert [name[:2] for name in motors[::3]] == ["FR", "FL", "RR", "RL"]
    assert motors[:3] == ["FR_hip", "FR_thigh", "FR_calf"]
    assert found["default_joint_pos"] == [joint["default_position"] for joint in deploy["robot"]["joints"]]
    assert found["actions"]["JointPositionAction"]["scale"] == [0.25] * 12
    assert found["commands"]["base_velocity"]["ranges"]["ang_vel_z"] == [-1.0, 1.0]
    assert list(found["observations"])[:4] == [
        "base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands",
    ]  # fmt: skip


def test_an_actor_without_what_a_robot_cannot_measure(tmp_path, capsys):
    """What the critic alone sees, the export does not ask for, and its robots move as they did in training."""
    budget = "--preset quad-walk --no-evaluation --num-envs 8 --env-steps 24 --threads 1 --device cpu --ppo.hidden 16"
    hidden = "--env.engine native --env.privileged linear_velocity heights"
    assert cli.main(["train", *budget.split(), *hidden.split(), "--out", str(tmp_path / "run")]) == 0
    assert cli.main(["export", str(tmp_path / "run"), str(tmp_path / "out"), "--check"]) == 0
    assert "It is what was exported." in capsys.readouterr().out
    deploy = json.loads((tmp_path / "out" / "deploy.json").read_text())
    names = [entry["name"] for entry in deploy["observation"]]
    assert names == ["angular_velocity", "gravity", "goal", "joint_position", "joint_velocity", "last_action"]
    with np.load(tmp_path / "out" / "check.npz") as file:
        assert file["policy.observation"].shape[1] == 45


def test_only_what_there_is_can_be_privileged():
    """An entry that does not exist, and the goal, are refused by name."""
    for name in ("speed", "goal"):
        with pytest.raises(ValueError, match=f"privileged must be some of linear_velocity, .*, got {name}"):
            quad.Config(engine="native", privileged=(name,)).build(1, CPU, seed=0)


def test_a_check_that_fails_says_so(walker, tmp_path, capsys):
    """Other actions, one that is not a number, a robot that falls, and a file that was exchanged are found.

    A robot that leaves the ground at once is no fault.
    """
    folder = tmp_path / "changed"
    folder.mkdir()
    for path in walker.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    with np.load(folder / "check.npz") as file:
        known = dict(file)
    np.savez(folder / "check.npz", **known | {"policy.action": known["policy.action"] + 2e-5})
    assert not export_controller.main(folder)
    unknown = known["policy.action"].copy()
    unknown[3, 5] = np.nan
    np.savez(folder / "check.npz", **known | {"policy.action": unknown})
    capsys.readouterr()
    assert not export_controller.main(folder)
    rows = len(unknown)
    assert f"batches of 1, 7, {min(rows, 4096)}: largest difference nan" in capsys.readouterr().out
    start = known["walk.qpos"].copy()
    start[0, 3:7] = 0.0, 1.0, 0.0, 0.0  # upside down
    np.savez(folder / "check.npz", **known | {"walk.qpos": start})
    assert not export_controller.main(folder)
    assert "1 fall, at the export 0" in capsys.readouterr().out
    gone = {name: known[name].copy() for name in ("walk.steps", "walk.tracking")}
    gone["walk.steps"][0] = gone["walk.tracking"][0] = 0  # one that left the ground on its first step
    np.savez(folder / "check.npz", **known | gone)
    assert export_controller.main(folder)
    (folder / "policy.onnx").write_bytes((walker / "policy.onnx").read_bytes() + b" ")
    with pytest.raises(ValueError, match=r"policy.onnx is not the file that deploy.json describes"):
        export_controller.main(folder)


def test_large_actions_are_compared_by_their_size(tmp_path):
    """Where actions are thousands, the check allows their rounding in float32, and a tenth of one is still found."""
    policy = make_policy("elu", False, float("inf"))
    with torch.no_grad():
        policy.actor.mean[-1].weight *= 3e4
    data = policy_model(policy, {})
    (tmp_path / "policy.onnx").write_bytes(data)
    deploy = {"policy": {"file": "policy.onnx", "sha256": hashlib.sha256(data).hexdigest()}, "fear": None}
    obs = torch.randn(4096, 9, generator=torch.Generator().manual_seed(1))
    action = policy.physical(obs).numpy()
    known = {"policy.observation": obs[:, policy.actor.seen].numpy(), "policy.action": action}
    assert np.abs(action).max() > 3000.0
    assert export_controller.compare_networks(tmp_path, deploy, known)
    action[5, 1] += 0.1
    assert not export_controller.compare_networks(tmp_path, deploy, known)


def test_particles_with_fear_and_shield(particles, tmp_path, capsys):
    """A run's fear network and shield leave with it, the check holds, and the run-time example decides over a goal."""
    small = "--worlds 1000 --eval.worlds 64 --eval.steps 100 --alphas 0.5 --attackers scripted --device cpu".split()
    assert cli.main(["shield", str(particles), "--alpha", "0.3", *small]) == 0
    out = tmp_path / "particles"
    assert cli.main(["export", str(particles), str(out), "--check"]) == 0
    assert "fear.onnx" not in capsys.readouterr().err
    deploy = json.loads((out / "deploy.json").read_text())
    assert deploy["robot"] is None
    assert not (out / "robot.xml").exists()
    assert deploy["fear"]["goal_period"] == 10
    assert deploy["fear"]["outputs"] == ["logit", "probability"]
    assert [entry["name"] for entry in deploy["fear"]["state"]] == ["velocity", "position", "last_action"]
    assert deploy["shield"] == json.loads((particles / "shield.json").read_text())["deploy"]
    example = HOME / "examples" / "deploy" / "shield.py"
    done = subprocess.run([sys.executable, example, out], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("wanted [200. 200. 200.], fear ")
    for limit, word, goal in ((1e9, "let through", "[200. 200. 200.]"), (-100.0, "refused", "[0. 0. 0.]")):
        deploy["shield"]["threshold"] = dict.fromkeys(deploy["shield"]["threshold"], limit)
        for mode in ("stop", "project"):
            deploy["shield"]["mode"] = mode
            (out / "deploy.json").write_text(json.dumps(deploy))
            first, second = subprocess.run(
                [sys.executable, example, out], capture_output=True, text=True, check=True
            ).stdout.splitlines()
            assert word in first
            assert second == f"pursue {goal}"


def test_fear_that_is_no_probability_is_not_exported_as_one(tmp_path, capsys):
    """The fear of Q-fear looks beyond T steps: its file gives logits alone, and the check holds."""
    config = replace(CONFIG, selector=method("q-fear"), env_steps=120)
    trainer, folder = training.start(config, tmp_path / "run")
    assert training.train(trainer, folder)
    out = tmp_path / "out"
    export.export_run(folder, out, check=True)
    fear = json.loads((out / "deploy.json").read_text())["fear"]
    assert (fear["outputs"], fear["calibration"]) == (["logit"], None)
    assert [output.name for output in onnx.load(out / "fear.onnx").graph.output] == ["logit"]
    assert export_controller.main(out)
    assert "fear.onnx, batches of" in capsys.readouterr().out


def test_a_folder_has_its_name_when_it_is_whole(particles, tmp_path, monkeypatch):
    """As long as something is missing there is no folder of the name, and an interrupt leaves nothing."""
    out = tmp_path / "out"

    def interrupt(*arguments):
        (unfinished,) = tmp_path.iterdir()
        assert unfinished != out
        assert (unfinished / "deploy.json").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "_play", interrupt)
    with pytest.raises(KeyboardInterrupt):
        export.export_run(RunFolder.open(particles), out, check=True)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_exported_is_refused_in_a_line(particles, tmp_path, capsys):
    """A folder that exists, no run, a policy or a shield of another one, each in a line; a run without fear is told."""
    assert cli.main(["export", str(particles), str(tmp_path)]) == 2
    assert "exists and is not overwritten" in capsys.readouterr().err
    assert cli.main(["export", str(tmp_path), str(tmp_path / "out")]) == 2
    assert "is not a run folder" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    for name in ("config.json", "checkpoint.pt"):
        (other / name).write_bytes((particles / name).read_bytes())
    (other / "policy.pt").write_bytes((WALK / "policy.pt").read_bytes())
    assert cli.main(["export", str(other), str(tmp_path / "out")]) == 2
    assert "belongs to another environment: it observes" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (other / "policy.pt").write_bytes((particles / "policy.pt").read_bytes())
    (other / "shield.json").write_text('{"deploy": {"weights": "0123456789abcdef"}}')
    assert cli.main(["export", str(other), str(tmp_path / "out")]) == 2
    assert "was made for an earlier policy; make it again with deimos shield" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert cli.main(["export", str(WALK), str(tmp_path / "go1")]) == 0
    assert "This run has learnt no fear network, so there is no fear.onnx." in capsys.readouterr().err
    assert not (tmp_path / "go1" / "check.npz").exists()
    with pytest.raises(SystemExit, match=r"go1 holds no check\.npz to compare with; export it again with --check"):
        export_controller.main(tmp_path / "go1")
