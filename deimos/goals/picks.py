"""Rules that pick one of many candidates by their scores; all randomness comes from one uniform number per row."""

from typing import Literal

import torch
from torch import Tensor

Rule = Literal["percentile", "argmin", "argmax", "proportional"]
RULES: tuple[Rule, ...] = ("percentile", "argmin", "argmax", "proportional")


def take(values: Tensor, pick: Tensor) -> Tensor:
    """The picked entry of every row.

    Args:
        values: Shape (B, N) or (B, N, D).
        pick: Indices in [0, N), int64, shape (B,).

    Returns:
        Shape (B,) or (B, D).
    """
    if values.dim() == 2:
        return values.gather(1, pick.unsqueeze(1)).squeeze(1)
    return values.gather(1, pick.view(-1, 1, 1).expand(-1, 1, values.shape[2])).squeeze(1)


def uniformly(draw: Tensor, count: int | Tensor) -> Tensor:
    """Any of ``count`` candidates, shape (B,); ``draw`` holds uniform numbers in [0, 1), shape (B,)."""
    return (draw * count).long().clamp(max=count - 1)


def kept_above(percentile: float, count: int) -> int:
    """How many of ``count`` candidates are kept above a percentile in [0, 100]: max(1, N - floor(p N / 100))."""
    return max(1, count - int(percentile * count / 100))


def above_percentile(score: Tensor, draw: Tensor, percentile: float) -> Tensor:
    """Any of the candidates above a percentile of the scores.

    Exactly k = max(1, N - floor(p N / 100)) candidates are kept, even where scores tie at the edge.
    So p = 0 keeps all, whatever the scores, and picks the very goal that Uniform picks.

    Args:
        score: Scores, shape (B, N).
        draw: Uniform numbers in [0, 1), shape (B,).
        percentile: p, in [0, 100].
    """
    count = score.shape[1]
    kept = kept_above(percentile, count)
    pick = uniformly(draw, kept)
    if kept == count:
        return pick
    return take(score.topk(kept, dim=1, sorted=False).indices, pick)


def percentile(score: Tensor, picked: Tensor) -> Tensor:
    """Percentile of the picked score among those of its row, in (0, 100), ties counting half, shape (B,).

    Whatever the scores, a uniform pick has 50 on average.

    Args:
        score: Scores, shape (B, N).
        picked: The one of each row, shape (B,).
    """
    # Above n of 100 and below m, it has 50 + (n - m) / 2. For few rows, the cost of an operation is that of its call.
    above = (picked.unsqueeze(1) - score).sign_().sum(1)
    return above * (50.0 / score.shape[1]) + 50.0


def in_proportion(weight: Tensor, draw: Tensor) -> Tensor:
    """A candidate with a probability in proportion to its weight; any, where all weights of a row are 0.

    Args:
        weight: At least 0, shape (B, N).
        draw: Uniform numbers in [0, 1), shape (B,).
    """
    upto = weight.cumsum(1)
    total = upto[:, -1]
    pick = torch.searchsorted(upto, (draw * total).unsqueeze(1), right=True).squeeze(1)
    # Rounding may put the number beyond the last weight, or past trailing candidates of weight 0.
    last = (upto < total.unsqueeze(1)).sum(1)
    return torch.where(total > 0, torch.minimum(pick, last), uniformly(draw, weight.shape[1]))


def by_rule(score: Tensor, draw: Tensor, rule: Rule, percentile: float) -> Tensor:
    """Index of the candidate that a rule picks in each row, in [0, N), int64, shape (B,).

    Args:
        score: Scores, shape (B, N); at least 0 for ``proportional``.
        draw: Uniform numbers in [0, 1), shape (B,).
        rule: One of ``RULES``.
        percentile: p, in [0, 100]; for ``percentile`` only.
    """
    if rule == "argmin":
        return score.argmin(dim=1)
    if rule == "argmax":
        return score.argmax(dim=1)
    if rule == "proportional":
        return in_proportion(score, draw)
    return above_percentile(score, draw, percentile)
