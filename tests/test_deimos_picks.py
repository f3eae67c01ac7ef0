"""Rules that pick one of many candidates by their scores."""

import pytest
import torch

from deimos.goals import picks

EVENLY = (torch.arange(1000) + 0.5) / 1000


def test_take_returns_the_picked_entries():
    """Of a matrix it takes one number per row, of a stack of vectors one vector."""
    values = torch.arange(12.0).view(2, 3, 2)
    pick = torch.tensor([2, 0])
    assert picks.take(values, pick).tolist() == [[4.0, 5.0], [6.0, 7.0]]
    assert picks.take(values[:, :, 0], pick).tolist() == [4.0, 6.0]


@pytest.mark.parametrize("count", [1, 7, 100])
def test_uniform_picks_are_even(count):
    """Evenly spread draws pick every candidate as often, up to one; the largest draw there is stays inside."""
    counts = torch.bincount(picks.uniformly(EVENLY, count), minlength=count)
    assert len(counts) == count
    assert counts.max() - counts.min() <= 1
    assert picks.uniformly(torch.tensor([1 - 2.0**-24]), count).item() == count - 1


@pytest.mark.parametrize(
    ("percentile", "kept"), [(0, 100), (10, 90), (25, 75), (33.9, 67), (90, 10), (99.5, 1), (100, 1)]
)
def test_the_bucket_holds_k_of_n(percentile, kept):
    """Over all draws exactly the k = max(1, N - floor(p N / 100)) highest scores are picked, each equally often."""
    score = torch.randn(1, 100, generator=torch.Generator().manual_seed(0)).expand(1000, -1)
    pick = picks.by_rule(score, EVENLY, "percentile", percentile)
    assert set(pick.tolist()) == set(score[0].topk(kept).indices.tolist())
    counts = torch.bincount(pick, minlength=100)
    assert counts.max() - counts[counts > 0].min() <= 1


def test_ties_at_the_edge_keep_the_bucket_exact():
    """Where scores tie, still exactly k candidates can be picked, all that beat the tie among them."""
    score = torch.zeros(1, 100)
    score[0, [3, 60]] = 1.0
    picked = set(picks.by_rule(score.expand(1000, -1), EVENLY, "percentile", 90).tolist())
    assert len(picked) == 10
    assert {3, 60} <= picked
    assert len(set(picks.by_rule(torch.zeros(1000, 100), EVENLY, "percentile", 25).tolist())) == 75


def test_the_ends_of_the_ranking():
    """The least, the most, and p = 100, which is the most."""
    score = torch.randn(20, 100, generator=torch.Generator().manual_seed(0))
    assert torch.equal(picks.by_rule(score, EVENLY[:20], "argmin", 0), score.argmin(1))
    assert torch.equal(picks.by_rule(score, EVENLY[:20], "argmax", 0), score.argmax(1))
    assert torch.equal(picks.by_rule(score, EVENLY[:20], "percentile", 100), score.argmax(1))


def test_a_large_logit_still_ranks():
    """Scores where a float32 sigmoid is exactly 1 are still told apart."""
    score = torch.tensor([[18.0, 25.0, 21.0]])
    assert (torch.sigmoid(score) == 1.0).all()
    assert picks.by_rule(score, torch.tensor([0.5]), "argmax", 0).item() == 1


def test_proportional_picks_have_the_right_frequencies():
    """Random draws follow a hundred random weights (chi-square, 1 %), and even draws hit theirs exactly."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.rand(100, generator=generator)
    pick = picks.in_proportion(weight.expand(100_000, -1), torch.rand(100_000, generator=generator))
    expected = weight.double() / weight.double().sum() * 100_000
    found = torch.bincount(pick, minlength=100)
    assert ((found - expected) ** 2 / expected).sum() < 134.64  # the 99th percentile of 99 degrees of freedom
    pick = picks.by_rule(torch.tensor([[1.0, 0.0, 4.0, 5.0]]).expand(1000, -1), EVENLY, "proportional", 0)
    assert torch.bincount(pick, minlength=4).tolist() == [100, 0, 400, 500]


def test_a_candidate_of_weight_zero_is_never_picked():
    """Neither at the front, nor in between, nor at the end, whatever the draw and however sums round."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.rand(5000, 30, generator=generator) * 10.0 ** torch.randint(-6, 6, (5000, 1), generator=generator)
    weight *= torch.rand(5000, 30, generator=generator) < 0.3
    some = (weight > 0).any(1)
    for draw in (torch.zeros(5000), torch.ones(5000), torch.rand(5000, generator=generator)):
        pick = picks.in_proportion(weight, draw)
        assert bool((picks.take(weight, pick)[some] > 0).all())


def test_without_any_weight_every_candidate_is_picked_alike():
    """A row of zeros falls back to a uniform pick, whatever the other rows hold."""
    weight = torch.zeros(1000, 4)
    weight[::2, 1] = 1.0
    pick = picks.in_proportion(weight, EVENLY)
    assert (pick[::2] == 1).all()
    assert torch.bincount(pick[1::2], minlength=4).tolist() == [125, 125, 125, 125]


def test_percentiles_count_ties_half():
    """A constant score has the percentile 50, the largest of N different ones 100 (N - 1/2) / N."""
    score = torch.tensor([[3.0, 3.0, 3.0, 3.0], [1.0, 2.0, 3.0, 4.0], [1.0, 1.0, 2.0, 3.0]])
    assert picks.percentile(score, torch.tensor([3.0, 4.0, 1.0])).tolist() == [50.0, 87.5, 25.0]
