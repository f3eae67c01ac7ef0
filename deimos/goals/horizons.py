"""How long the goals of other people's loops last, and what the fear network sees of that."""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.goals.given import Array, Inputs


@dataclass(frozen=True)
class Horizons:
    """Steps that goals last."""

    period: int | None
    """T, where it is always the same."""
    most: int
    """The most steps that a goal lasts."""
    seen: bool
    """Whether the fear network sees how long a goal is to last."""

    def steps(self, horizon: Array | int | None, rows: Tensor, inputs: Inputs) -> Tensor | None:
        """Announced steps of some worlds, int64, shape (m,); the most if not announced, ``None`` where it is always T.

        Raises:
            ValueError: If they do not fit, are not T where it is always the same, or are missing where the fear network
                sees them.
        """
        if horizon is None:
            if self.period is not None:
                return None
            if self.seen:
                raise ValueError("horizon must be given where it is an input of the fear network, got None.")
            horizon = self.most
        steps = inputs.horizons(horizon, self.most, rows)
        if self.period is None:
            return steps
        short = steps < self.period  # outcomes are kept for goals of T steps
        if inputs.faults is not None:
            inputs.faults.note(f"horizon of world {{world}} must be goal_period, {self.period}", short, rows)
        elif bool(short.any()):
            raise ValueError(
                f"horizon must be goal_period, {self.period}, got {steps.tolist()}; "
                f"GoalDirector(max_horizon={self.period}) has goals of fewer steps."
            )
        return steps

    def behind(self, states: Tensor, steps: Tensor | None = None) -> Tensor:
        """What the selector sees of states, shape (m, state_dim): then ``steps / most``, if ``seen``; 1 for T."""
        if not self.seen:
            return states
        share = torch.ones_like(states[:, :1]) if steps is None else steps.unsqueeze(1) / self.most
        return torch.cat([states, share], dim=1)
