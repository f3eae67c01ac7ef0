"""The fear network: its ranking measure, its factorised scores, and what it learns."""

import itertools
import math

import pytest
import torch
from torch import nn

from deimos.checks import SimulationError
from deimos.goals.fear import Fear, FearConfig, auroc
from deimos.goals.interactions import Resolved

STATE_DIM, GOAL_DIM = 5, 2


def interactions(crashed, seed=0, state=None):
    """Resolved interactions with random contexts and the given outcomes."""
    generator = torch.Generator().manual_seed(seed)
    n = len(crashed)
    state = torch.randn(n, STATE_DIM, generator=generator) if state is None else state
    goal, next_goal = (torch.randn(n, GOAL_DIM, generator=generator) for _ in range(2))
    zeros, steps = torch.zeros(n), torch.zeros(n, dtype=torch.int64)
    return Resolved(
        env=torch.arange(n), state=state, goal=goal, next_goal=next_goal, score=zeros, reward=zeros,
        tracking=zeros.unsqueeze(1), probe=steps.bool(), note=steps, crashed=crashed, issued=steps, resolved=steps + 1,
        horizon=steps + 1,
    )  # fmt: skip


def make(**changes):
    return Fear(FearConfig(**changes), STATE_DIM, GOAL_DIM, torch.device("cpu"), seed=0)


def test_auroc_counts_pairs():
    """It is the share of (positive, negative) pairs in the right order, ties counting half."""
    generator = torch.Generator().manual_seed(0)
    score = torch.randint(0, 6, (40,), generator=generator).float()  # many ties
    positive = torch.rand(40, generator=generator) < 0.4
    pairs = [
        1.0 if p > n else 0.5 if p == n else 0.0
        for p, n in itertools.product(score[positive].tolist(), score[~positive].tolist())
    ]
    assert auroc(score, positive) == pytest.approx(sum(pairs) / len(pairs), abs=1e-12)


@pytest.mark.parametrize("value", [True, False])
def test_auroc_needs_both_classes(value):
    """With one class it is NaN, not a number that looks like one."""
    assert math.isnan(auroc(torch.rand(5), torch.full((5,), value)))


def test_auroc_at_the_ends():
    """A perfect ranking gives 1, a reversed one 0, a constant one 1/2."""
    score, positive = torch.arange(10.0), torch.arange(10) >= 6
    assert (auroc(score, positive), auroc(-score, positive), auroc(0 * score, positive)) == (1.0, 0.0, 0.5)


@pytest.mark.parametrize("hidden", [(8,), (16, 8)])
def test_scores_are_the_networks_own(hidden):
    """Factorised scores equal a pass of the network over every (state, goal, candidate)."""
    fear = make(hidden=hidden)
    generator = torch.Generator().manual_seed(0)
    state, goal = (torch.randn(7, n, generator=generator) for n in (STATE_DIM, GOAL_DIM))
    candidates = torch.randn(7, 30, GOAL_DIM, generator=generator)
    rows = [
        torch.cat([state[i], goal[i], candidates[i, k]]) for i, k in itertools.product(range(7), range(30))
    ]  # fmt: skip
    expected = fear.network(torch.stack(rows)).view(7, 30).detach()
    # Sums of at most 16 products of numbers of order 1, in another order.
    torch.testing.assert_close(fear.score(state, goal, candidates), expected, rtol=1e-5, atol=1e-6)


def test_any_workspace_gives_the_same_scores():
    """One decision at a time or all at once: the scores, and so the picks, are the same."""
    generator = torch.Generator().manual_seed(0)
    state, goal = (torch.randn(3000, n, generator=generator) for n in (STATE_DIM, GOAL_DIM))
    candidates = torch.randn(3000, 100, GOAL_DIM, generator=generator)
    scores = [make(workspace=size).score(state, goal, candidates) for size in (1, 1024)]
    torch.testing.assert_close(*scores, rtol=1e-5, atol=1e-6)
    assert torch.equal(scores[0].argmax(1), scores[1].argmax(1))


def test_it_learns_which_contexts_crash():
    """Where the outcome is a function of state and next goal, it ranks unseen interactions."""
    generator = torch.Generator().manual_seed(1)
    state = torch.randn(4000, STATE_DIM, generator=generator)
    data = interactions(torch.zeros(4000, dtype=torch.bool), state=state)
    crashed = data.state[:, 0] + data.next_goal[:, 1] > 1.5
    fear = make(epochs=30)
    data = Resolved(**{**vars(data), "crashed": crashed})
    train, test = data.where(data.env < 3000), data.where(data.env >= 3000)
    first = fear.fit(train, epochs=1)
    last = fear.fit(train)
    assert last < first
    score = fear.score(test.state, test.goal, test.next_goal.unsqueeze(1)).squeeze(1)
    assert auroc(score, test.crashed) > 0.97


def test_classes_count_alike():
    """A constant network learns logit 0 whatever the share of crashes: both classes weigh the same."""
    data = interactions(torch.arange(1000) < 100, state=torch.zeros(1000, STATE_DIM))
    data = Resolved(**{**vars(data), "goal": torch.zeros(1000, GOAL_DIM), "next_goal": torch.zeros(1000, GOAL_DIM)})
    fear = make(hidden=(4,), epochs=300, minibatches=1, learning_rate=0.03)
    fear.network[2].bias.data.fill_(-2.0)
    fear.fit(data)
    logit = fear.score(data.state[:1], data.goal[:1], data.next_goal[:1].unsqueeze(1))
    assert abs(logit.item()) < 0.02


def test_the_loss_is_the_balanced_cross_entropy():
    """The loss of a first pass in one batch is torch's, weighted by n / (2 n_class)."""
    data = interactions(torch.arange(200) < 60)
    fear = make(minibatches=1)
    inputs = torch.cat([data.state, data.goal, data.next_goal], dim=1)
    weight = torch.where(data.crashed, 200 / (2 * 60), 200 / (2 * 140))
    logit = fear.network(inputs).squeeze(1)
    expected = nn.functional.binary_cross_entropy_with_logits(logit, data.crashed.float(), weight)
    gradient = torch.autograd.grad(expected, list(fear.network.parameters()))
    assert fear.fit(data) == pytest.approx(expected.item(), rel=1e-5)
    for parameter, value in zip(fear.network.parameters(), gradient, strict=True):
        torch.testing.assert_close(parameter.grad, value, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("crashes", [0, 31, 200 - 31, 200])
def test_too_few_of_a_class_teach_nothing(crashes):
    """Below ``min_per_class`` crashes or survivals nothing is learnt and the loss is NaN."""
    fear = make(min_per_class=32)
    before = [parameter.clone() for parameter in fear.network.parameters()]
    assert math.isnan(fear.fit(interactions(torch.arange(200) < crashes)))
    assert not fear.fitted
    assert all(torch.equal(a, b) for a, b in zip(before, fear.network.parameters(), strict=True))


def test_no_interactions_teach_nothing():
    """An empty window is no error."""
    assert math.isnan(make().fit(interactions(torch.zeros(0, dtype=torch.bool))))


def test_it_continues_from_its_state_bit_for_bit():
    """Saved, loaded into a fresh one and fitted again, it equals the one that never stopped."""
    data = interactions(torch.arange(400) < 150)
    first, second = make(), Fear(FearConfig(), STATE_DIM, GOAL_DIM, torch.device("cpu"), seed=5)
    first.fit(data)
    state = first.state_dict()
    state["network"] = {name: value.clone() for name, value in state["network"].items()}
    first.fit(data)
    second.load_state_dict(state)
    assert second.fitted
    second.fit(data)
    assert all(torch.equal(a, b) for a, b in zip(first.network.parameters(), second.network.parameters(), strict=True))


def test_a_weight_that_is_not_finite_stops_the_run():
    """The check says whose weight it is."""
    fear = make()
    fear.check()
    fear.network[0].weight.data[0, 0] = torch.inf
    with pytest.raises(SimulationError, match="fear network"):
        fear.check()
