"""The committed policies of Quad+arm still do what docs/lab/quad_arm.md says of them, on either engine."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import deimos
from deimos.goals.selectors import uniform
from deimos.run.evaluation import play
from deimos.run.loop import spaces
from deimos.run.presets import preset

RESULTS = Path(__file__).parent.parent / "docs" / "results"
STANDS, WALKS = "quad_arm_stand", "quad_arm_reach"


def followed(name: str, engine: str) -> dict:
    """Four goals of two seconds for 48 robots under Naive goals that the policy was not evaluated on before."""
    policy = deimos.load_policy(RESULTS / name)
    config = replace(preset(name.replace("_", "-")).env, goal_period=100, engine=engine).for_evaluation()
    env = config.build(48, torch.device("cpu"), seed=7)
    assert policy.layout == env.layout
    return play(env, policy.scaled, uniform.Config().build(spaces(env), 0), 400)


@pytest.mark.parametrize("engine", ["warp", "native"])
def test_one_stands_and_reaches(engine: str):
    """At most one robot of 48 falls, the gripper is near its goals, and velocities stay near zero, as is asked for."""
    row = followed(STANDS, engine)
    assert row["errors"]["end effector [m]"] < 0.04  # an arm that rests misses by 28 cm
    assert row["crashes"] <= 1
    linear, yaw, _ = row["tracking"]
    assert linear > 0.9
    assert yaw > 0.9


@pytest.mark.parametrize("engine", ["warp", "native"])
def test_one_walks_and_reaches_at_once(engine: str):
    """It follows velocities (a robot that stands still has a linear tracking of 0.2) with its gripper at the goal."""
    row = followed(WALKS, engine)
    assert row["errors"]["end effector [m]"] < 0.05
    assert row["crashes"] <= 16  # in 6.4 robot-minutes; 2 a minute are allowed
    linear, yaw, _ = row["tracking"]
    assert linear > 0.7
    assert yaw > 0.8


@pytest.mark.parametrize("name", [STANDS, WALKS])
def test_they_are_small(name: str):
    """Each folder fits into 2 MB."""
    assert sum(path.stat().st_size for path in (RESULTS / name).iterdir()) < 2_000_000
