"""A trained policy as a folder that a robot's own software reads, without Deimos and without torch.

``policy.onnx`` and ``fear.onnx`` are the networks, ``deploy.json`` has all that a deployment has to know about them,
``controller.py`` is an example of one and checks the others. A legged robot also has ``robot.xml``, and ``deploy.yaml``
in the format of Unitree's tools. No number is rounded.
"""

import hashlib
import json
import os
import secrets
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from deimos.checks import RunError
from deimos.files import PARTIAL, write_whole
from deimos.goals.fear_selector import FearSelector
from deimos.learn.policy import Policy
from deimos.nn.layout import ObsField, goal_components
from deimos.nn.threads import torch_on_one
from deimos.run import export_controller, export_onnx, export_robot, export_unitree
from deimos.run.config import kind
from deimos.run.evaluation import weights_hash
from deimos.run.folder import RunFolder
from deimos.run.saved import SavedRun
from deimos.run.shield import read_shield
from deimos.run.trainer import TrainConfig
from deimos.run.training import provenance
from deimos.sim.env import Env
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.task import Locomotion

SCHEMA = 1  # of deploy.json
ROBOTS = 64  # that walk in the check, and times that their observations are kept
SECONDS = 10.0  # that they walk
STEPS = 512  # of a check in environments without seconds
CANDIDATES = 5  # for every decision of the fear network in the check


@torch.no_grad()
@torch_on_one()
def export_run(folder: RunFolder, out: Path, *, check: bool) -> None:
    """Write the folder of a run's policy.

    Args:
        folder: The run.
        out: The folder, which must not exist.
        check: Whether to write ``check.npz``, which ``controller.py`` compares with.

    Raises:
        RunError: If ``out`` exists, or the run is broken.
        OSError, RunError: If something cannot be written.
    """
    if os.path.lexists(out):
        raise RunError(f"{out} exists and is not overwritten; choose another folder.")
    run, steps = SavedRun.open(folder.path), STEPS
    if isinstance(run.config.env, LocomotionConfig):
        steps = round(SECONDS / run.config.env.physics.control_period)
    env = SavedRun.open(folder.path, goal_period=steps).build(ROBOTS, run.config.eval.seed, 0)
    policy, afraid = run.policy(env), run.fear(env)
    # A partial folder would be taken for a whole one: it gets its name when it is whole, in case of a kill.
    unfinished = out.with_name(f"{out.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        unfinished.mkdir(parents=True)
        _write(folder, run.config, policy, env, afraid, unfinished)
        if check:
            facts = _play(env, policy, afraid, steps)
            write_whole(unfinished / "check.npz", lambda file: np.savez(file, **facts))  # type: ignore[arg-type]
        unfinished.rename(out)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _write(
    folder: RunFolder, config: TrainConfig, policy: Policy, env: Env, afraid: FearSelector | None, out: Path
) -> None:
    """Write everything except what the check compares with."""
    weights = weights_hash(policy.actor)
    facts = {"weights": weights, "environment": kind(config.env), "units": "physical; see deploy.json"}
    goal = policy.goal_slice
    models = {"policy": export_onnx.policy_model(policy, facts)}
    if afraid is not None:
        scale = policy.scale.cpu()
        models["fear"] = export_onnx.fear_model(afraid, env.state(scale), scale[goal], facts)
    files = {}
    for name, data in models.items():
        (out / f"{name}.onnx").write_bytes(data)
        files[name] = {"file": f"{name}.onnx", "sha256": hashlib.sha256(data).hexdigest(), "weights": weights}
    deploy = _describe(folder, config, policy, env, afraid, files)
    if isinstance(env, Locomotion):
        export_robot.write_model(env, out)
        deploy["robot"] = export_robot.describe_robot(env)
        export_unitree.write(deploy, out / "deploy.yaml")
    (out / "deploy.json").write_text(json.dumps(deploy, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    shutil.copyfile(export_controller.__file__, out / "controller.py")


def _describe(
    folder: RunFolder, config: TrainConfig, policy: Policy, env: Env, afraid: FearSelector | None, files: dict
) -> dict[str, Any]:
    """``deploy.json``, except for the entry ``robot``."""
    stored = folder.read_json("config.json")
    sees = torch.zeros(env.obs_dim, dtype=torch.bool)
    sees[policy.actor.seen] = True
    shown = dict(zip(policy.layout, sees.split([field.size for field in policy.layout]), strict=True))
    low, high = (_plain(bound) for bound in env.action_range)
    fear = None
    if afraid is not None:
        state = [_entry(field) for field in policy.layout if field.name != "goal"]
        fear = files["fear"] | {
            "goal_period": config.env.goal_period, "outputs": list(export_onnx.fear_outputs(afraid)),
            "calibration": afraid.calibration.state_dict() if afraid.is_calibrated else None, "state": state,
        }  # fmt: skip
    return {
        "schema": SCHEMA,
        "environment": kind(config.env),
        "goals_chosen_by": config.label,
        "seed": config.seed,
        "versions": {"training": stored.get("versions"), "export": provenance() | {"onnx": version("onnx")}},
        "control_period": policy.dt,
        "control_period_unit": "s" if env.has_seconds else "step",
        "policy": files["policy"],
        "observation": [_entry(field) for field, seen in shown.items() if bool(seen.all())],
        "action": {"size": env.action_dim, "low": low, "high": high},
        "goal": _describe_goal(env, config.env.goal_period),
        "fear": fear,
        "shield": read_shield(folder, files["policy"]["weights"]),
        "robot": None,
    }


def _entry(field: ObsField) -> dict[str, Any]:
    """An entry of an observation: what the networks' files expect, in physical units, and how they scale it."""
    bound = export_robot.CLIPS.get(field.name)
    return {
        "name": field.name, "size": field.size, "unit": field.unit,
        "scale": _plain(torch.as_tensor(field.scale, dtype=torch.float64).expand(field.size)),
        "clip": None if bound is None else [-bound, bound], "source": export_robot.SOURCES.get(field.name),
    }  # fmt: skip


def _describe_goal(env: Env, goal_period: int) -> dict[str, Any]:
    """Components of the goal with units and the box that training drew them from."""
    found = goal_components(env.layout, env.goal_groups, env.goal_group_names)
    half = [None] * len(found) if env.goal_range is None else _plain(env.goal_range)
    return {
        "period": goal_period,
        "groups": list(env.goal_group_names),
        "components": [
            {"name": component.name, "unit": component.unit, "low": None if side is None else -side, "high": side}
            for component, side in zip(found, half, strict=True)
        ],
    }


def _plain(values: Tensor) -> list[float | None]:
    """Numbers for JSON, which has no infinity."""
    return [None if not np.isfinite(value) else value for value in values.tolist()]


def _play(env: Env, policy: Policy, afraid: FearSelector | None, steps: int) -> dict[str, np.ndarray]:
    """Let the policy act from where the worlds are, each under one goal: what the exported files must reproduce."""
    walk = export_robot.Walk(env) if isinstance(env, Locomotion) else None
    rows = torch.arange(env.num_envs)
    kept: list[tuple[Tensor, Tensor]] = []
    for t in range(steps):
        if t % max(1, steps // ROBOTS) == 0 and len(kept) < ROBOTS:
            kept.append((env.obs.clone(), env.sample_goals(rows, CANDIDATES).clone()))
        step = env.step(policy.scaled(env.obs))
        if walk is not None:
            assert step.tracking is not None
            walk.note(step.terminated, step.truncated, step.tracking)
    obs, candidates = (torch.cat(parts) for parts in zip(*kept, strict=True))
    physical, goal_scale = obs / policy.scale, policy.scale[policy.goal_slice]
    seen = physical * policy.scale  # so that both have the division's rounding
    facts = {"policy.observation": physical[:, policy.actor.seen], "policy.action": policy.scaled(seen)}
    if afraid is not None:
        goals = candidates / goal_scale
        logit = afraid.score(env.state(seen), seen[:, policy.goal_slice], goals * goal_scale)
        said = {"logit": logit, "probability": afraid.calibration.probability(logit)}
        facts |= {
            "fear.state": env.state(physical), "fear.goal": physical[:, policy.goal_slice], "fear.candidates": goals,
            **{f"fear.{name}": said[name] for name in export_onnx.fear_outputs(afraid)},
        }  # fmt: skip
    return {name: value.numpy() for name, value in facts.items()} | (walk.facts() if walk else {})
