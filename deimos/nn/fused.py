"""Scores of many candidate goals by one Warp kernel, for selectors that serve an environment on Warp."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
import warp as wp
from torch import Tensor, nn

from deimos.kernels.candidates import (
    MOST_COMPONENTS,
    MOST_COMPONENTS_SQUARED,
    OUTPUTS_AT_ONCE,
    mean_square_of_candidates,
    score_candidates,
)
from deimos.nn.networks import Whitening


def fuse(net: nn.Sequential, goal_dim: int, *, whitening: Whitening | None = None) -> "FusedScores | None":
    """A kernel that does what ``networks.ManyCandidates`` does, if there is one for this network.

    Args:
        net: Made by ``networks.mlp``; the last ``goal_dim`` inputs are the candidate. Its weights may change, not move.
        goal_dim: Components of a candidate.
        whitening: How candidates are whitened before the network sees them; the score is the mean of its squared
            outputs then. ``None`` for candidates as they are, and the one output as the score.

    Returns:
        ``None`` unless the network has one hidden layer of ReLU, and outputs and components that the kernel takes.
    """
    wp.init()
    linears = [layer for layer in net if isinstance(layer, nn.Linear)]
    if len(linears) != 2 or not isinstance(net[1], nn.ReLU):
        return None
    outputs = linears[1].out_features
    if whitening:
        fits = goal_dim <= MOST_COMPONENTS_SQUARED and outputs % OUTPUTS_AT_ONCE == 0
    else:
        fits = goal_dim <= MOST_COMPONENTS and outputs == 1
    return FusedScores(linears[0], linears[1], goal_dim, whitening) if fits else None


class FusedScores:
    """See ``fuse``. Memory is allocated once for the most decisions that were asked for at a time."""

    def __init__(self, first: nn.Linear, last: nn.Linear, goal_dim: int, whitening: Whitening | None) -> None:
        weight = first.weight.data
        self._goal_dim = goal_dim
        self._bias, self._of_context = first.bias.data, weight[:, :-goal_dim].t()
        self._kernel: Callable[..., wp.Launch | None] = score_candidates
        parts = [weight[:, -goal_dim:], last.weight.data if whitening else last.weight.data[0], last.bias.data]
        if whitening:
            parts += [whitening.mean, whitening.factor]
            self._kernel = partial(mean_square_of_candidates, bound=whitening.bound)
        self._network = [wp.from_torch(part) for part in parts]
        self._recorded: dict[int, _Recorded] = {}  # by the number of candidates

    @torch.no_grad()
    def __call__(self, context: Tensor, candidates: Tensor) -> Tensor:
        """The score of every candidate, shape (B, N).

        Args:
            context: The other inputs, shape (B, inputs - goal_dim).
            candidates: Shape (B, N, goal_dim).

        Raises:
            ValueError: If the shapes do not fit each other or the network.
        """
        rows, count, goal_dim = candidates.shape
        if context.shape != (rows, len(self._of_context)) or goal_dim != self._goal_dim:
            raise ValueError(
                f"context and candidates must have the shapes (B, {len(self._of_context)}) and (B, N, "
                f"{self._goal_dim}), got {tuple(context.shape)} and {tuple(candidates.shape)}."
            )
        if rows == 0:
            return candidates.new_empty(0, count)
        candidates = candidates.contiguous()
        known = self._recorded.get(count)
        if known is None or rows > len(known.hidden):
            known = self._recorded[count] = self._record(candidates)
        elif candidates.data_ptr() != known.candidates_at:
            known.candidates_at = candidates.data_ptr()
            known.launch.set_param_by_name("candidate", wp.from_torch(candidates))
        torch.addmm(self._bias, context, self._of_context, out=known.hidden[:rows])
        known.launch.set_dim((rows, known.launch.bounds.shape[1]))
        known.launch.launch()
        return known.score[:rows].clone()

    @torch.inference_mode(False)  # what is made in a loop without gradients shall also be used outside it
    def _record(self, candidates: Tensor) -> "_Recorded":
        rows, count = candidates.shape[:2]
        hidden, score = candidates.new_empty(rows, len(self._bias)), candidates.new_empty(rows, count)
        arrays = [wp.from_torch(hidden), wp.from_torch(candidates), *self._network, wp.from_torch(score)]
        launch = self._kernel(*arrays, record=True)
        assert launch is not None
        return _Recorded(launch, hidden, score, candidates.data_ptr())


@dataclass
class _Recorded:
    """A launch and the memory that it works on."""

    launch: wp.Launch
    hidden: Tensor
    """The contexts' share of the hidden layer, shape (most decisions, units)."""
    score: Tensor
    """Shape (most decisions, N)."""
    candidates_at: int
    """Address of the candidates."""
