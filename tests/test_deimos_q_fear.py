"""Fear of what may follow: targets, and what it sees that fear of the next goal does not."""

import dataclasses

import pytest
import torch
from taught_selectors import GOAL, SPACES, STATE, WORLDS, across, decisions, history

from deimos.goals.core import GoalCore
from deimos.goals.selectors import q_fear


class Chain:
    """States -1, 0 and 1: goals above 0 lead one up, others down; at 1 every goal above 0 crashes."""

    def __init__(self):
        self.state = torch.zeros(WORLDS)

    def play(self, selector, rollouts=150):
        """Let a selector choose one-step goals in many chains."""
        core = GoalCore(selector, dataclasses.replace(SPACES, state_dim=1, goal_dim=1, goal_period=1))
        generator = torch.Generator().manual_seed(0)
        no = torch.zeros(WORLDS, dtype=torch.bool)
        goal = torch.zeros(WORLDS, 1)
        for _ in range(rollouts):
            crash = (self.state == 1) & (goal[:, 0] > 0)
            self.state = torch.where(crash, 0.0, (self.state + goal[:, 0].sign()).clamp(-1, 1))
            changes = core.advance(crash, no, ~no, torch.zeros(WORLDS))
            rows = changes.due
            options = torch.rand(len(rows), selector.num_candidates, 1, generator=generator) * 2 - 1
            draws = torch.rand(len(rows), 4, generator=generator)
            goal[rows] = core.choose(rows, self.state[rows].unsqueeze(1), goal[rows], options, draws)
            goal[changes.done] = torch.rand(len(changes.done), 1, generator=generator) * 2 - 1
            core.learn(None)
        return selector


def test_q_fear_sees_what_may_follow():
    """At 0, where no goal crashes, one that leads to the edge is feared; fear of the next step alone fears none."""
    feared = {}
    for beta in (0.9, 0.0):
        sizes = dataclasses.replace(SPACES, state_dim=1, goal_dim=1, goal_period=1)
        selector = Chain().play(q_fear.Config(percentile=0, candidates=8, beta=beta).build(sizes, 0))
        ahead = torch.tensor([[[0.7], [-0.7]]] * 2)
        feared[beta] = torch.sigmoid(selector.score(torch.tensor([[0.0], [1.0]]), torch.zeros(2, 1), ahead))
    for found in feared.values():  # at the edge both know what crashes
        assert found[1, 0] > 0.9
    assert feared[0.0][0].max() < 0.1
    assert feared[0.9][0, 0] > 0.3
    assert feared[0.9][0, 0] > feared[0.9][0, 1]


def test_q_targets_are_discounted_worst_fears():
    """A survival's target is beta times the fear of the most feared candidate that followed, a crash's is 1."""
    selector = history(q_fear.Config(candidates=20, beta=0.5).build(SPACES, 0), across)
    rows, state, goal, options, draws = decisions(count=WORLDS)
    selector.issued(rows, state, goal, options, selector.propose(rows, state, goal, options, draws))
    fits = []
    selector.fear.fit_rows = lambda inputs, crashed, weight, target: fits.append((crashed, target)) or 0.0
    worst = selector.score(state, goal, options).amax(1)
    width = STATE + 2 * GOAL
    lesson = torch.cat([torch.zeros(WORLDS, width), selector._worst], dim=1)
    lesson[:5, width:] = torch.nan
    crashed = torch.arange(WORLDS) % 10 == 0
    selector.fit(lesson, crashed, torch.ones(WORLDS))
    ((_, target),) = fits
    expected = 0.5 * selector.calibration.probability(worst)
    expected[:5] = 0.0
    torch.testing.assert_close(target, torch.where(crashed, 1.0, expected), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="beta must be in"):
        q_fear.Config(beta=1.0)
