"""The committed policy of docs/results/quad_arm_stand still stands and reaches, on either engine."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import deimos
from deimos.goals.selectors import uniform
from deimos.run.evaluation import play
from deimos.run.loop import spaces
from deimos.run.presets import preset

HOME = Path(__file__).parent.parent / "docs" / "results" / "quad_arm_stand"


@pytest.fixture(scope="module", params=["warp", "native"])
def reached(request):
    """Four goals of two seconds for 48 robots under Naive goals that the policy was not evaluated on before."""
    policy = deimos.load_policy(HOME)
    config = replace(preset("quad-arm-stand").env, goal_period=100, engine=request.param).for_evaluation()
    env = config.build(48, torch.device("cpu"), seed=7)
    assert policy.layout == env.layout
    return play(env, policy.scaled, uniform.Config().build(spaces(env), 0), 400)


def test_it_reaches_its_goals(reached):
    """The median error stays near what docs/lab/quad_arm.md says of 256 robots; an arm that rests misses by 28 cm."""
    assert reached["errors"]["end effector [m]"] < 0.04


def test_it_stands(reached):
    """At most one robot of 48 falls in eight seconds, and their velocities stay near zero, which the goals ask for."""
    assert reached["crashes"] <= 1
    linear, yaw, _ = reached["tracking"]
    assert linear > 0.9
    assert yaw > 0.9


def test_it_is_small():
    """The policy and what training resumes from fit into 2 MB."""
    assert sum(path.stat().st_size for path in HOME.iterdir()) < 2_000_000
