"""Fear of several heads times novelty: which goals are drawn."""

import torch
from taught_selectors import SPACES, across, decisions, history

from deimos.goals import picks
from deimos.goals.selectors import novelty


def test_novel_goals_of_unsure_outcome_are_drawn():
    """Odds are p (1 - p) of the drawn head times the novelty rank to the power of eta."""
    selector = history(novelty.Config(candidates=20, eta=2.0).build(SPACES, 0), across)
    _, state, goal, options, draws = decisions(count=40)
    score = selector.score(state, goal, options)
    weight = selector.ranking(state, goal, options, score, draws)
    heads = [score, *(head.score(state, goal, options) for head in selector.heads)]
    rank = selector.rnd.surprise(state, goal, options).argsort(1).argsort(1) + 1
    for row in range(40):
        p = selector.calibration.probability(heads[int(draws[row, 3] * 4)][row])
        torch.testing.assert_close(weight[row], p * (1 - p) * (rank[row] / 20) ** 2)
    assert len(selector.heads) == 3
    spread = torch.stack(heads).std(dim=0).mean()
    assert spread > 0.05  # the heads are networks of their own
    frequency = picks.in_proportion(weight[:1].expand(10_000, -1), (torch.arange(10_000) + 0.5) / 10_000)
    expected = weight[0] / weight[0].sum()
    torch.testing.assert_close(torch.bincount(frequency, minlength=20) / 10_000, expected, rtol=0, atol=3e-4)


def test_without_eta_novelty_does_not_count():
    """With eta 0 and one head the odds are learnability's."""
    selector = history(novelty.Config(candidates=20, eta=0.0, heads=1).build(SPACES, 0), across)
    _, state, goal, options, draws = decisions(count=40)
    score = selector.score(state, goal, options)
    p = selector.calibration.probability(score)
    torch.testing.assert_close(selector.ranking(state, goal, options, score, draws), p * (1 - p))
