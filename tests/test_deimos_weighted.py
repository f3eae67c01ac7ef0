"""A mixture with Uniform whose transitions are weighed: the weights make goals uniform again."""

import math

import pytest
import torch
from scipy import stats
from taught_selectors import CPU, GOAL, SPACES, STATE, WORLDS, across, cells, decisions, history, small_run

from deimos import GoalDirector
from deimos.goals.interactions import Interactions
from deimos.goals.selectors import weighted


def test_weights_make_goals_uniform():
    """In expectation over choices a goal's weighted frequency is Uniform's, for its own decision and overall."""
    config = weighted.Config(candidates=20, mix=0.5, alpha=1.0)
    selector = history(config.build(SPACES, 0), across)
    arguments = decisions()
    chosen = selector.propose(*arguments)
    # p = 75 keeps 5 of 20: q is 0.5 / 20 + 0.5 / 5 there and 0.5 / 20 elsewhere.
    assert {round(weight, 4) for weight in chosen.weight.tolist()} == {0.4, 2.0}
    assert chosen.weight.mean() == pytest.approx(1.0, abs=0.02)
    plain = torch.bincount(cells(chosen.goal), minlength=64)
    mended = torch.bincount(cells(chosen.goal), chosen.weight.double(), minlength=64)
    assert stats.chisquare(plain.numpy()).pvalue < 1e-6
    noise = torch.bincount(cells(chosen.goal), chosen.weight.double().square(), minlength=64).sqrt()
    assert (((mended - len(chosen.goal) / 64) / noise).abs() < 4.5).all()
    assert (chosen.percentile[chosen.weight < 1] > 75).all()


def test_alpha_and_mix_span_from_uniform_to_the_director():
    """An alpha of 0 weighs nothing, mix 1 is Uniform with weights of 1, and a small mix is the Director."""
    arguments = decisions(count=2000)
    for changes, weights in (({"alpha": 0.0}, {1.0}), ({"mix": 1.0}, {1.0})):
        chosen = history(weighted.Config(candidates=20, **changes).build(SPACES, 0), across).propose(*arguments)
        assert set(chosen.weight.tolist()) == weights
    assert chosen.percentile.mean() == pytest.approx(50, abs=2)
    strict = history(weighted.Config(candidates=20, mix=1e-3).build(SPACES, 0), across).propose(*arguments)
    assert strict.percentile.mean() == pytest.approx(87.5, abs=1)
    with pytest.raises(ValueError, match=r"mix must be in \[0.001, 1\], got 0"):
        weighted.Config(mix=0.0)
    with pytest.raises(ValueError, match="control must be none or state-blind where goals are weighed, got 'shuffled'"):
        weighted.Config(control="shuffled")


def test_effective_share_and_state_shift_are_told():
    """The share is 1 / E_u[u / q] = 0.625 at a mix of 0.5; the shift is 0.5 where goals move no states."""
    selector = history(weighted.Config(candidates=100, mix=0.5, alpha=1.0).build(SPACES, 0), across)
    arguments = decisions(candidates=100)
    selector.issued(*arguments[:4], selector.propose(*arguments))
    interactions = Interactions(WORLDS, STATE, GOAL, 3, 10, CPU)
    for shift, low, high in ((0.0, 0.35, 0.65), (3.0, 0.9, 1.0)):
        rows, generator = torch.arange(WORLDS), torch.Generator().manual_seed(0)
        note = 1 + (torch.rand(WORLDS, generator=generator) < 0.5).long()
        zeros = torch.zeros(WORLDS, GOAL)
        state = torch.randn(WORLDS, STATE, generator=generator)
        interactions.open(rows, state, zeros, zeros, zeros[:, 0], horizon=5, note=note)
        interactions.now += 5
        interactions.resolve(rows, zeros[:, 0] > 0, zeros[:, 0] == 0)
        interactions.open(rows, state + shift * (note == 2).unsqueeze(1), zeros, zeros, zeros[:, 0], horizon=5)
        row = selector.learn(interactions, None)
        assert low <= row["weighted/state_shift"] <= high
        if shift == 0.0:
            assert row["weighted/effective_share"] == pytest.approx(0.625, abs=0.01)
        interactions.resolve(rows, zeros[:, 0] > 0, zeros[:, 0] > 0)  # cut off
        interactions.now += 20
    assert math.isnan(selector.learn(interactions, None)["weighted/state_shift"])


def test_the_learner_takes_the_weights():
    """A run's transitions weigh as their goal does, and a GoalDirector hands the weights out."""
    run = small_run(weighted.Config(candidates=20, mix=0.5, alpha=1.0))
    for _ in range(4):
        run.iterate()
    assert {0.4, 1.0, 2.0} >= {round(value, 4) for value in run.rollout.weight.unique().tolist()} >= {0.4, 2.0}
    goals, no = (
        GoalDirector(weighted.Config(candidates=9, mix=0.5, alpha=1.0), goal_period=2, learn_every=4),
        torch.zeros(4, dtype=torch.bool),
    )
    seen, goal = set(), torch.zeros(4, 2)
    for t in range(60):
        crash = no.clone()
        crash[t % 4] = t % 3 == 0
        given = goals.step(torch.randn(4, 3), goal, crash, no, torch.rand(4, 9, 2))
        goal = given.goal
        assert (given.weight[crash] == 1).all()
        seen |= set(given.weight.tolist())
    assert len(seen) == 3
