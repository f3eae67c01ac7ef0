"""The committed policy of docs/results/quad_flat still walks, on either engine."""

from pathlib import Path

import pytest
import torch

import deimos
from deimos.goals.selectors import uniform
from deimos.run.evaluation import play
from deimos.run.loop import spaces
from deimos.sim.envs import quad

HOME = Path(__file__).parent.parent / "docs" / "results" / "quad_flat"


@pytest.fixture(scope="module", params=["warp", "native"])
def walked(request):
    """Six seconds of 48 robots under Naive goals at T2, in a task that the policy was not evaluated on before."""
    policy = deimos.load_policy(HOME)
    env = quad.Config(engine=request.param).for_evaluation().with_goal_period(100).build(48, torch.device("cpu"), 7)
    assert policy.layout == env.layout
    return play(env, policy.scaled, uniform.Config().build(spaces(env), 0), 300)


def test_it_follows_its_goals(walked):
    """Mean linear and yaw tracking stay near what docs/lab/quad.md says of 256 robots; standing still reaches 0.19."""
    linear, yaw = walked["tracking"]
    assert linear > 0.7
    assert yaw > 0.7


def test_it_stays_on_its_feet(walked):
    """At one crash per robot-minute 48 robots would fall five times in six seconds; twice that is beyond chance."""
    assert walked["crashes"] <= 10


def test_it_is_small():
    """The policy and what training resumes from fit into 2 MB."""
    assert sum(path.stat().st_size for path in HOME.iterdir()) < 2_000_000
