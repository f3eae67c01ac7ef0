"""Random network distillation over goals (Burda et al., ICLR 2019, arXiv:1810.12894; a rival in the thesis, 4.3)."""

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from deimos.checks import SimulationError, check_at_least, check_choice, check_positive
from deimos.goals import picks
from deimos.goals.interactions import Interactions, assign
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, Transitions, uniform_proposal
from deimos.nn.adam import Adam
from deimos.nn.losses import mean_squared_error
from deimos.nn.mlps import MLPs
from deimos.nn.networks import ACTIVATIONS, Activation, mlp
from deimos.nn.ranks import gather_rows
from deimos.nn.seeds import generator
from deimos.nn.threads import torch_on_one

CLIP = 5.0  # bound of whitened inputs, as in the paper


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """The goal on whose (state, active goal, next goal) a trained network predicts a frozen random one worst."""

    rule: Literal["argmax", "proportional"] = "argmax"
    """Take the most surprising candidate, or draw in proportion to the surprise."""
    candidates: int = 100
    """N: uniform candidates per decision, at least 1."""
    target: int = 32
    """Units in the hidden layer of the frozen network, at least 1."""
    predictor: int = 64
    """Units in the hidden layer of the trained network, at least as many, so that it can become the frozen one."""
    features: int = 16
    """Outputs of both networks, at least 1."""
    whiten: bool = True
    """Whether inputs are whitened and clipped, as in the paper, or seen as they are."""
    activation: Activation = "relu"
    """Between the layers."""
    learning_rate: float = 1e-3
    """Learning rate of Adam, positive."""
    epochs: int = 1
    """Passes over the interactions that were issued since the last update, at least 1."""
    minibatches: int = 4
    """Parts that they are split into, at least 1."""

    def __post_init__(self) -> None:
        check_choice("rule", self.rule, ["argmax", "proportional"])
        check_choice("activation", self.activation, ACTIVATIONS)
        check_positive("learning_rate", self.learning_rate, finite=True)
        for name in ("candidates", "target", "features", "epochs", "minibatches"):
            check_at_least(name, getattr(self, name), 1)
        if self.predictor < self.target:
            raise ValueError(
                f"predictor must have at least the target's {self.target} units, or it can never learn what the target "
                f"says, got {self.predictor}."
            )

    def build(self, spaces: Spaces, seed: int) -> "RND":
        """See ``SelectorConfig.build``."""
        return RND(self, spaces, seed)


class RND(GoalSelector):
    """See ``Config``. Until inputs have been seen, and so can be whitened, it is uniform."""

    dense = True
    saved = (
        "predictor", "target", "optimizer", "generator", "_uniform", "_moments", "_mean", "_scale", "_learnt_at",
        "fitted",
    )  # fmt: skip
    unknown = by_world = ("_uniform",)

    @torch_on_one()  # orthogonal weights come from a decomposition whose sums depend on torch's threads
    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        self.config = config
        self.num_candidates = config.candidates
        inputs = spaces.state_dim + 2 * spaces.goal_dim
        weights = generator(seed, "rnd weights")
        self.target, self.predictor = (
            mlp(inputs, (units,), config.features, config.activation, weights)
            for units in (config.target, config.predictor)
        )
        for layer in (*self.target, *self.predictor):
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, 2**0.5, generator=weights)
        self.target.to(spaces.device)
        self.predictor.to(spaces.device)
        self._target, self._predictor = MLPs([self.target]), MLPs([self.predictor])
        rate = torch.tensor(config.learning_rate, dtype=torch.float32, device=spaces.device)
        self.optimizer = Adam(self._predictor.parameters, self._predictor.grad, rate)
        self.generator = generator(seed, "rnd minibatches", spaces.device)
        # Inputs are whitened by the moments of states, active goals and *uniform* candidates; those of the
        # chosen goals would drift with what is chosen.
        shape = spaces.num_envs, spaces.goal_dim
        self._uniform = torch.full(shape, torch.nan, dtype=torch.float32, device=spaces.device)
        self._moments = torch.zeros(3, inputs, dtype=torch.float64, device=spaces.device)  # count, sum, of squares
        self._mean = torch.zeros(inputs, dtype=torch.float32, device=spaces.device)
        self._scale = torch.ones_like(self._mean)
        self._context = slice(0, inputs - spaces.goal_dim)
        self._goal = slice(inputs - spaces.goal_dim, inputs)
        self._clip = CLIP if config.whiten else math.inf
        self._learnt_at = 0  # step of the last call of learn
        self.fitted = False
        """Whether it has seen anything yet; before that, nothing can be whitened."""

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return (self.fitted,)

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are surprises."""
        if not self.fitted:
            return uniform_proposal(candidates, draws[:, 0])
        score = self.surprise(state, goal, candidates)
        pick = picks.by_rule(score, draws[:, 0], self.config.rule, 0.0)
        return Proposal(picks.take(candidates, pick), picks.take(score, pick))

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``: it notes what uniform goals look like, whatever was chosen."""
        assign(self._uniform, rows, candidates[:, 0].float(), where)

    def surprise(self, state: Tensor, goal: Tensor, candidates: Tensor) -> Tensor:
        """Mean squared error of the predictor, shape (B, N); the arguments are those of ``Fear.score``."""
        context = self._whiten(torch.cat([state, goal], dim=1), self._context)
        parts = []
        for few in self._predictor.parts(*candidates.shape[:2]):  # a candidate has many outputs, not one score
            goals = self._whiten(candidates[few], self._goal)
            error = self._predictor.score(context[few], goals) - self._target.score(context[few], goals)
            parts.append(error[0].square_().mean(2))
        return torch.cat(parts)

    def _whiten(self, inputs: Tensor, part: slice) -> Tensor:
        return (inputs - self._mean[part]).mul_(self._scale[part]).clamp_(-self._clip, self._clip)

    @torch.no_grad()
    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Whiten by, and learn from, what was issued since the last call; no outcome is needed."""
        env, state, goal, next_goal = interactions.issued(self._learnt_at)
        self._learnt_at = interactions.now
        uniform = gather_rows(self._uniform)[env]
        known = uniform.isfinite().all(1)  # in a world whose goals another selector chose so far, it has seen none
        state, goal, next_goal, uniform = state[known], goal[known], next_goal[known], uniform[known]
        if len(uniform) == 0:
            return {"rnd/surprise": float("nan"), "rnd/loss": float("nan")}
        context = torch.cat([state, goal], dim=1)
        if self.config.whiten:
            self._observe(torch.cat([context, uniform], dim=1).double())
        self.fitted = True
        everything = slice(0, len(self._mean))
        inputs = self._whiten(torch.cat([context, next_goal], dim=1), everything)
        target = self._target.forward(inputs)[0]
        surprise = (self._predictor.forward(inputs)[0] - target).square_().mean().item()
        return {"rnd/surprise": surprise, "rnd/loss": self._fit(inputs, target)}

    def _observe(self, inputs: Tensor) -> None:
        self._moments[0] += len(inputs)
        self._moments[1] += inputs.sum(0)
        self._moments[2] += inputs.square().sum(0)
        mean = self._moments[1] / self._moments[0]
        variance = (self._moments[2] / self._moments[0] - mean.square()).clamp(min=0)
        self._mean.copy_(mean)
        # A constant input tells nothing, and would explode on the first change.
        self._scale.copy_(torch.where(variance > 1e-12, variance, torch.inf).rsqrt())

    def _fit(self, inputs: Tensor, target: Tensor) -> float:
        """Adam on the mean squared error; returns that of the last pass."""
        size = -(-len(inputs) // self.config.minibatches)
        total = torch.zeros((), dtype=torch.float32, device=inputs.device)
        for _ in range(self.config.epochs):
            total.zero_()
            order = torch.randperm(len(inputs), generator=self.generator, device=inputs.device)
            for rows in order.split(size):
                loss = self._predictor.gradient(inputs[rows], mean_squared_error(target[rows]))
                self.optimizer.step()
                total += loss[0, 0] * len(rows)
        return (total / len(inputs)).item()

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        if not bool(self._predictor.parameters.isfinite().all()):
            raise SimulationError("A weight of the RND predictor is not finite after a fit.")
