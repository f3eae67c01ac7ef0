"""The fear network: how likely is this policy to crash within T steps of getting this goal?"""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import SimulationError, check_at_least, check_choice, check_hidden, check_positive
from deimos.goals.interactions import Resolved
from deimos.nn.adam import Adam
from deimos.nn.losses import cross_entropy
from deimos.nn.mlps import MLPs
from deimos.nn.networks import ACTIVATIONS, Activation, mlp
from deimos.nn.seeds import generator
from deimos.nn.stateful import Stateful


@dataclass(frozen=True, kw_only=True)
class FearConfig:
    """The fear network and how it learns (thesis, 4.2)."""

    hidden: tuple[int, ...] = (64,)
    """Units of the hidden layers."""
    activation: Activation = "relu"
    """Between the layers."""
    learning_rate: float = 1e-2
    """Learning rate of Adam, positive."""
    epochs: int = 1
    """Passes over the window of interactions in every fit, at least 1."""
    minibatches: int = 8
    """Parts that the window is split into, at least 1."""
    min_per_class: int = 1
    """Crashes and survivals that a fit must have to learn from, at least 1."""
    workspace: int = 64
    """Memory for the activations of candidates [MiB], at least 1; what takes more is scored in parts. The kernel for
    CPUs needs none."""

    def __post_init__(self) -> None:
        check_hidden("hidden", self.hidden)
        check_choice("activation", self.activation, ACTIVATIONS)
        check_positive("learning_rate", self.learning_rate, finite=True)
        for name in ("epochs", "minibatches", "min_per_class", "workspace"):
            check_at_least(name, getattr(self, name), 1)


class Fear(Stateful):
    """A fear network, an MLP of (state, goal, next goal) with one logit, and how it learns online.

    Args:
        config: Its sizes and how it learns.
        state_dim: Components of a state.
        goal_dim: Components of a goal.
        device: Device of its weights.
        seed: Seed of its weights and of the order that it learns in.
    """

    saved = ("network", "optimizer", "generator", "fitted")

    def __init__(self, config: FearConfig, state_dim: int, goal_dim: int, device: torch.device, seed: int) -> None:
        self.config = config
        weights = generator(seed, "fear weights")
        self.network = mlp(state_dim + 2 * goal_dim, config.hidden, 1, config.activation, weights).to(device)
        self._nets = MLPs([self.network], workspace=config.workspace)
        rate = torch.tensor(config.learning_rate, dtype=torch.float32, device=device)
        self.optimizer = Adam(self._nets.parameters, self._nets.grad, rate)
        self.generator = generator(seed, "fear minibatches", device)
        self.fitted = False
        """Whether it has learnt anything yet; before that, its ranking of goals would be an arbitrary bias."""

    def fit(self, data: Resolved, epochs: int | None = None) -> float:
        """Learn from interactions with equal weights within their class; see ``fit_rows``."""
        inputs = torch.cat([data.state, data.goal, data.next_goal], dim=1)
        return self.fit_rows(inputs, data.crashed, torch.ones_like(inputs[:, 0]), epochs=epochs)

    @torch.no_grad()
    def fit_rows(
        self, inputs: Tensor, crashed: Tensor, weight: Tensor, target: Tensor | None = None, epochs: int | None = None
    ) -> float:
        """Learn by class-balanced binary cross-entropy on logits.

        Crashes and survivals each have a total weight of 1/2, over all rows and not over those of a minibatch, so that
        the shift this causes is known exactly.

        Args:
            inputs: State, goal and next goal, shape (n, state_dim + 2 goal_dim).
            crashed: True for a crash, bool, shape (n,).
            weight: Weight within the class, positive, shape (n,).
            target: What to predict, in [0, 1], shape (n,); ``None`` for the class.
            epochs: Passes over the rows; ``None`` for the configured number.

        Returns:
            Mean loss of the last pass; NaN, and nothing is learnt, where a class has too few rows.
        """
        crashes = int(crashed.sum())
        if min(crashes, len(crashed) - crashes) < self.config.min_per_class:
            return float("nan")
        inputs, weight, target = inputs.float(), weight.float(), crashed.float() if target is None else target
        mass = torch.stack([(weight * ~crashed).sum(), (weight * crashed).sum()])
        weight = weight * (0.5 / mass)[crashed.long()]
        size = -(-len(inputs) // self.config.minibatches)
        loss = torch.zeros((), dtype=torch.float32, device=target.device)
        for _ in range(self.config.epochs if epochs is None else epochs):
            order = torch.randperm(len(inputs), generator=self.generator, device=target.device)
            x, y, w = inputs[order], target[order], weight[order]
            loss.zero_()
            for part in zip(x.split(size), y.split(size), w.split(size), strict=True):
                scale = len(inputs) / len(part[0])  # makes the gradient that of a mean
                loss += self._learn(part[0], part[1], part[2] * scale) / scale
        self.fitted = True
        return loss.item()

    def _learn(self, inputs: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        """One step of Adam on a minibatch; returns the loss before it."""
        loss = self._nets.gradient(inputs, cross_entropy(target, weight))
        self.optimizer.step()
        return loss[0, 0]

    def score(self, state: Tensor, goal: Tensor, candidates: Tensor) -> Tensor:
        """Logits of crashing for many candidates per decision.

        Args:
            state: States, shape (B, state_dim).
            goal: Active goals, shape (B, goal_dim).
            candidates: Possible next goals, shape (B, N, goal_dim).

        Returns:
            Logits, shape (B, N); see ``MLPs.score``.
        """
        return self._nets.score(torch.cat([state, goal], dim=1), candidates)[0, :, :, 0]

    def check(self) -> None:
        """Raise ``SimulationError`` if a weight is not finite; reads the device once."""
        if not bool(self._nets.parameters.isfinite().all()):
            raise SimulationError("A weight of the fear network is not finite after a fit.")


def auroc(score: Tensor, positive: Tensor) -> float:
    """Area under the ROC curve: how often a positive outranks a negative, ties counting half.

    Args:
        score: Scores, higher for positives, shape (n,).
        positive: The true classes, bool, shape (n,).

    Returns:
        A number in [0, 1]; NaN where a class is empty.
    """
    positives = int(positive.sum())
    negatives = len(positive) - positives
    if positives == 0 or negatives == 0:
        return float("nan")
    ranked = score[~positive].sort().values
    found = score[positive].contiguous()
    below, not_above = (torch.searchsorted(ranked, found, side=side) for side in ("left", "right"))
    return (below.sum() + not_above.sum()).item() / (2 * positives * negatives)
