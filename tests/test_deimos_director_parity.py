"""The Director in somebody else's loop against the same selector in Deimos' own, on Particle Gym."""

import pytest
import torch

from deimos import GoalDirector
from deimos.goals.core import window_between
from deimos.goals.fear import FearConfig
from deimos.goals.interactions import Resolved
from deimos.goals.selectors import director
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.envs import particle

CPU = torch.device("cpu")
N, PERIOD = 96, 5
CONFIG = particle.Config(goal_period=PERIOD, max_speed=200.0, max_force=100.0, time_limit=23)


def action(now):
    """What everybody does after ``now`` steps: worlds accelerate their own ways, some hardly and some into the wall."""
    return torch.sin(torch.arange(3.0 * N).view(N, 3) + 0.1 * now) * torch.linspace(0, 90, N).unsqueeze(1)


class Theirs:
    """Somebody else's loop: Particle Gym with its own resets, and goals that a GoalDirector gives."""

    def __init__(self, goals, candidates=1):
        self.env, self.goals, self.candidates = CONFIG.build(N, CPU, 0), goals, candidates
        self.now = 0

    def step(self):
        """One step of the worlds; returns what the GoalDirector said."""
        env, every = self.env, torch.arange(N)
        step = env.step(action(self.now))
        self.now += 1
        candidates = env.sample_goals(every, self.candidates).clone()
        given = self.goals.step(
            env.state(step.obs), env.goal.clone(), step.terminated, step.truncated, candidates, tracking=step.reward
        )
        done = step.terminated | step.truncated
        rows = torch.nonzero(given.changed & ~done).squeeze(1)
        env.set_goals(rows, given.goal[rows])
        env.reset(done)  # with a first goal of its own
        return given, done


@pytest.mark.parametrize("candidates", [1, 20])
def test_it_does_what_the_loop_does(candidates):
    """On the same worlds it issues the same goals and keeps the same interactions, labels, scores and fear."""
    config = director.Config(percentile=75, candidates=candidates, fear=FearConfig(min_per_class=8))
    env = CONFIG.build(N, CPU, 0)
    ours = GoalLoop(env, config.build(spaces(env), seed=0), window_between(PERIOD, 12))
    theirs = Theirs(GoalDirector(config, PERIOD, learn_every=12, seed=0), candidates)
    labels = []
    for now in range(96):
        ours.advance(env.step(action(now)))
        if (now + 1) % 12 == 0:
            ours.selector.learn(ours.interactions, None)
        theirs.step()
        assert torch.equal(env.obs, theirs.env.obs)
        expected, found = ours.interactions.resolved(), theirs.goals.interactions.resolved()
        for name in Resolved.__dataclass_fields__:
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=0, equal_nan=True)
        labels.append(expected.crashed.float().mean())
    assert expected.score.isfinite().all()
    assert 0.05 < torch.stack(labels).nanmean() < 0.95
    for a, b in zip(
        ours.selector.fear.network.parameters(), theirs.goals.selector.fear.network.parameters(), strict=True
    ):
        assert torch.equal(a, b)
    assert ours.selector.calibration.state_dict() == theirs.goals.selector.calibration.state_dict()
