"""The fear network: how likely is this policy to crash within T steps of getting this goal?"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from deimos.checks import SimulationError, check_at_least, check_choice, check_hidden, check_positive
from deimos.goals.interactions import Resolved
from deimos.nn.adam import Adam
from deimos.nn.fusion import fused_scores
from deimos.nn.networks import Activation, Backprop, ManyCandidates, flatten_parameters, mlp
from deimos.nn.ranks import mean_over_ranks
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
    """Memory for the activations of candidates [MiB], at least 1; what takes more is scored in parts. One hidden layer
    of ReLU needs none in training: a kernel scores them."""

    def __post_init__(self) -> None:
        check_hidden("hidden", self.hidden)
        check_choice("activation", self.activation, ["relu", "elu", "tanh"])
        check_positive("learning_rate", self.learning_rate, finite=True)
        for name in ("epochs", "minibatches", "min_per_class", "workspace"):
            check_at_least(name, getattr(self, name), 1)


class Fear(Stateful):
    """A fear network, an MLP of (state, goal, next goal) with one logit, and how it learns online.

    Args:
        config: Its sizes and how it learns.
        state_dim: Components of a state.
        goal_dim: Components of a goal.
        device: Where it lives.
        seed: Seed of its weights and of the order that it learns in.
    """

    saved = ("network", "optimizer", "generator", "fitted")

    def __init__(self, config: FearConfig, state_dim: int, goal_dim: int, device: torch.device, seed: int) -> None:
        self.config = config
        weights = generator(seed, "fear weights")
        self.network = mlp(state_dim + 2 * goal_dim, config.hidden, 1, config.activation, weights).to(device)
        self._parameters, _ = flatten_parameters(self.network)
        self._pass = Backprop(self.network)
        self._candidates = ManyCandidates(self.network, goal_dim, config.workspace)
        self._fused = fused_scores(self.network, goal_dim)
        self.optimizer = Adam(self._parameters, torch.tensor(config.learning_rate, device=device))
        self.generator = generator(seed, "fear minibatches", device)
        self.fitted = False
        """Whether it has learnt anything yet; before, its ranking of goals would be an arbitrary bias."""

    def fit(self, data: Resolved, epochs: int | None = None) -> float:
        """Learn from interactions that all weigh alike within their class; see ``fit_rows``."""
        inputs = torch.cat([data.state, data.goal, data.next_goal], dim=1)
        return self.fit_rows(inputs, data.crashed, torch.ones_like(inputs[:, 0]), epochs=epochs)

    @torch.no_grad()
    def fit_rows(
        self, inputs: Tensor, crashed: Tensor, weight: Tensor, target: Tensor | None = None, epochs: int | None = None
    ) -> float:
        """Learn by class-balanced binary cross-entropy on logits.

        Crashes and survivals weigh 1/2 together each, over all rows and not over those of a minibatch, so that the
        shift this causes is known exactly.

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
        target = crashed.float() if target is None else target
        mass = mean_over_ranks(torch.stack([(weight * ~crashed).sum(), (weight * crashed).sum()]))
        weight = weight * (0.5 / mass)[crashed.long()]
        size = -(-len(inputs) // self.config.minibatches)
        loss = torch.full((), torch.nan)
        for _ in range(self.config.epochs if epochs is None else epochs):
            order = torch.randperm(len(inputs), generator=self.generator, device=target.device)
            x, y, w = inputs[order], target[order], weight[order]
            minibatches = zip(x.split(size), y.split(size), w.split(size), strict=True)
            logit = torch.cat([self._learn(len(inputs) / len(part[0]), *part) for part in minibatches])
            loss = nn.functional.binary_cross_entropy_with_logits(logit, y, w, reduction="sum")
        self.fitted = True
        return loss.item()

    def _learn(self, scale: float, inputs: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        """One step of Adam on a minibatch; ``scale`` makes its gradient one of a mean. Returns the logits before it."""
        assert self._parameters.grad is not None
        self._parameters.grad.zero_()
        logit = self._pass.forward(inputs).squeeze(1)
        delta = torch.sigmoid(logit).sub_(target).mul_(weight * scale)  # derivative of the loss by the logit
        self._pass.backward(delta.unsqueeze(1))
        mean_over_ranks(self._parameters.grad)
        self.optimizer.step()
        return logit

    def score(self, state: Tensor, goal: Tensor, candidates: Tensor) -> Tensor:
        """Logits of crashing for many candidates per decision.

        Args:
            state: States, shape (B, state_dim).
            goal: Active goals, shape (B, goal_dim).
            candidates: Possible next goals, shape (B, N, goal_dim).

        Returns:
            Logits, shape (B, N); see ``ManyCandidates``.
        """
        context = torch.cat([state, goal], dim=1)
        if self._fused is not None:
            return self._fused(context, candidates)
        return self._candidates(context, candidates).squeeze(2)

    def check(self) -> None:
        """Raise ``SimulationError`` if a weight is not finite; reads the device once."""
        if not bool(self._parameters.isfinite().all()):
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
