"""Value disagreement sampling (Zhang, Abbeel and Pinto, NeurIPS 2020, arXiv:2006.09641), on PPO as in the thesis, 4.3.

Where critics that saw the same task disagree about a goal, there is something to learn. Each has returns of
its own, bootstrapped from its own values: regressed on one shared target they would soon agree.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from deimos.checks import SimulationError, check_at_least, check_choice, check_hidden, check_positive, check_range
from deimos.goals import picks
from deimos.goals.interactions import Interactions
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, Transitions, uniform_proposal
from deimos.nn.adam import Adam
from deimos.nn.losses import ValueLoss
from deimos.nn.mlps import MLPs
from deimos.nn.networks import ACTIVATIONS, Activation, mlp
from deimos.nn.ranks import mean_over_ranks, sum_over_ranks
from deimos.nn.returns import advantages
from deimos.nn.seeds import generator


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """Goals by the standard deviation of an ensemble's values."""

    rule: Literal["proportional", "argmax", "percentile", "uniform"] = "proportional"
    """Draw in proportion to the deviation, take its largest, draw from above its percentile, or ignore it, which shows
    what the ensemble alone is worth as a baseline."""
    percentile: float = 75.0
    """Share of candidates that ``percentile`` discards, in [0, 100] [%]."""
    role: Literal["replace", "auxiliary"] = "replace"
    """Whether the ensemble's mean is the learner's baseline too (the thesis), or the learner keeps its own critic
    (the comparison of goal selection alone)."""
    data: Literal["all", "share"] = "all"
    """Whether every critic learns from all transitions, or from those of its own part of the worlds, redrawn
    for every rollout: K times cheaper."""
    critics: int = 10
    """K, at least 2 where they are to disagree; 1 is a plain critic."""
    candidates: int = 100
    """N: uniform candidates per decision, at least 1."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of every critic."""
    activation: Activation = "relu"
    """Between the layers."""
    learning_rate: float = 1e-3
    """Learning rate of Adam, positive."""
    epochs: int = 5
    """Passes over every critic's data, at least 1."""
    minibatches: int = 4
    """Parts that its data are split into, in its own order, at least 1."""
    clip: float = 0.2
    """How far a value may move in one update, positive; infinite for no clipping."""
    max_grad_norm: float = 1.0
    """Norm that every critic's gradient is clipped to, positive."""

    def __post_init__(self) -> None:
        check_choice("rule", self.rule, ["proportional", "argmax", "percentile", "uniform"])
        check_choice("role", self.role, ["replace", "auxiliary"])
        check_choice("data", self.data, ["all", "share"])
        check_choice("activation", self.activation, ACTIVATIONS)
        check_range("percentile", self.percentile, 0.0, 100.0)
        check_hidden("hidden", self.hidden)
        for name in ("critics", "candidates", "epochs", "minibatches"):
            check_at_least(name, getattr(self, name), 1)
        check_positive("learning_rate", self.learning_rate, finite=True)
        check_positive("clip", self.clip)
        check_positive("max_grad_norm", self.max_grad_norm, finite=True)

    def build(self, spaces: Spaces, seed: int) -> "VDS":
        """See ``SelectorConfig.build``.

        Raises:
            ValueError: If there are fewer worlds than critics that share them.
        """
        if self.data == "share" and spaces.num_envs < self.critics:
            raise ValueError(
                f"critics must be at most the {spaces.num_envs} worlds that they share, got {self.critics}; "
                "use data 'all'."
            )
        return VDS(self, spaces, seed)


class VDS(GoalSelector):
    """See ``Config``."""

    needs_rollout = True
    dense = True
    saved = ("_parameters", "optimizer", "generator")

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        self.config, self._spaces = config, spaces
        self.num_candidates = 1 if config.rule == "uniform" else config.candidates
        inputs, device = spaces.state_dim + spaces.goal_dim, spaces.device
        streams = (generator(seed, f"vds critic {k}") for k in range(config.critics))
        self.nets = MLPs([mlp(inputs, config.hidden, 1, config.activation, weights).to(device) for weights in streams])
        self._parameters = self.nets.parameters
        rate = torch.tensor(config.learning_rate, dtype=torch.float32, device=device)
        self.optimizer = Adam(self._parameters, self.nets.grad, rate)
        self.generator = generator(seed, "vds minibatches", device)
        self._known: tuple[Tensor, Tensor] | None = None  # a whole rollout's observations and their values

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return ()

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are deviations of values in units of scaled rewards."""
        if self.config.rule == "uniform":
            return uniform_proposal(candidates, draws[:, 0])
        score = deviation(self.nets.score(state, candidates).squeeze(3))
        pick = picks.by_rule(score, draws[:, 0], self.config.rule, self.config.percentile)
        return Proposal(picks.take(candidates, pick), picks.take(score, pick))

    def critic(self) -> Callable[[Tensor], Tensor] | None:
        """See ``GoalSelector.critic``."""
        return self.value if self.config.role == "replace" else None

    def value(self, obs: Tensor) -> Tensor:
        """Mean value over the ensemble, shape (...,), of observations of shape (..., obs_dim)."""
        values = self.values(obs)
        if obs.dim() == 3:
            self._known = obs, values
        return values.mean(0)

    def values(self, obs: Tensor) -> Tensor:
        """Values by every critic, shape (K, ...), of observations of shape (..., obs_dim)."""
        inputs = self._spaces.state_then_goal(obs).flatten(0, -2)
        return self.nets.forward(inputs).view(len(self.nets), *obs.shape[:-1])

    @torch.no_grad()
    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Move every critic towards the lambda-returns of its own values."""
        if rollout is None:
            raise ValueError("vds learns values, so it needs the learner's rollout, got None.")
        worlds = self._worlds(rollout.obs.shape[1], rollout.obs.device)
        old, returns = self._targets(rollout, worlds)
        loss = self._fit(rollout, worlds, old, returns)
        spread = mean_over_ranks(deviation(old).mean()).item() if self.config.data == "all" else float("nan")
        self._known = None
        return {"vds/loss": loss, "vds/deviation": spread, "vds/value": mean_over_ranks(old.mean()).item()}

    def _worlds(self, num_envs: int, device: torch.device) -> Tensor:
        """The worlds that every critic learns from, int64, shape (K, worlds of each)."""
        count = self.config.critics
        if self.config.data == "all":
            return torch.arange(num_envs, device=device).expand(count, -1)
        size = num_envs // count  # a remainder is left out, a different one every time
        return torch.randperm(num_envs, generator=self.generator, device=device)[: count * size].view(count, size)

    def _targets(self, rollout: Transitions, worlds: Tensor) -> tuple[Tensor, Tensor]:
        """Values before the update and lambda-returns, shape (K, num_steps, worlds of each)."""
        shared = self.config.data == "all"
        if shared and self._known is not None and self._known[0] is rollout.obs:
            value = self._known[1]  # the learner has asked for them
        elif shared:
            value = self.values(rollout.obs)
        else:
            own = self._spaces.state_then_goal(rollout.obs)[:, worlds].transpose(0, 1)  # (K, steps, worlds, inputs)
            value = self.nets.forward(own.flatten(1, 2)).view(own.shape[:3])
        old, next_value = value.transpose(0, 1)[:-1], value.transpose(0, 1)[1:]  # (num_steps, K, worlds of each)
        reward, terminated, truncated = (
            tensor[:, worlds]  # some learners keep flags as uint8, of which ~ is not the opposite
            for tensor in (rollout.reward, rollout.terminated.bool(), rollout.truncated.bool())
        )
        step, world, obs = rollout.cut_off()
        if len(step):
            final = torch.zeros(*rollout.truncated.shape, len(worlds), dtype=value.dtype, device=value.device)
            final[step, world] = self.values(obs).t()
            member = torch.arange(len(worlds), device=value.device).unsqueeze(1)
            next_value = torch.where(truncated, final[:, worlds, member], next_value)
        advantage = advantages(
            reward * rollout.reward_scale, old, next_value, terminated, truncated,
            discount=rollout.discount, gae_lambda=rollout.gae_lambda,
        )  # fmt: skip
        return old.transpose(0, 1), (advantage + old).transpose(0, 1)

    def _fit(self, rollout: Transitions, worlds: Tensor, old: Tensor, returns: Tensor) -> float:
        """Adam on the clipped value loss; returns its mean over critics and minibatches.

        A minibatch has the same places in the rollouts of all ranks. Like PPO, it learns nothing, and returns NaN, if
        fewer transitions count than a minibatch has.
        """
        rows = rollout.num_steps * worlds.shape[1]
        minibatches = min(self.config.minibatches, rows)
        size = rows // minibatches
        order = torch.stack([torch.randperm(rows, generator=self.generator, device=old.device) for _ in worlds])
        steps = torch.arange(rollout.num_steps, device=order.device) * rollout.obs.shape[1]
        place = (steps.unsqueeze(1) + worlds.unsqueeze(1)).flatten(1).gather(1, order)  # in the flat rollout
        weight = rollout.weight.take(place)
        if bool(mean_over_ranks(weight.sum(1)).min() < size):
            return float("nan")
        order, place, weight = (tensor[:, : minibatches * size] for tensor in (order, place, weight))
        obs = self._spaces.state_then_goal(rollout.obs[:-1]).flatten(0, 1).t()
        x = obs.index_select(1, place.reshape(-1)).view(len(obs), *place.shape).permute(1, 2, 0)
        weight = weight.unflatten(1, (minibatches, size))
        weight = (weight / sum_over_ranks(weight.sum(2, keepdim=True)).clamp(min=1.0)).flatten(1)
        data = [weight, *(values.flatten(1).gather(1, order) for values in (old, returns))]
        loss, losses = ValueLoss(torch.stack(data, dim=1), self.config.clip), torch.zeros_like(old[:, 0, 0])
        for _ in range(self.config.epochs):
            for start in range(0, minibatches * size, size):
                part = slice(start, start + size)
                losses += self.nets.gradient(x[:, part], loss[part]).squeeze(1)
                sum_over_ranks(self.nets.grad)
                self.nets.clip_gradient(self.config.max_grad_norm)
                self.optimizer.step()
        return sum_over_ranks(losses).mean().item() / (self.config.epochs * minibatches)

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        if not bool(self._parameters.isfinite().all()):
            raise SimulationError("A weight of the VDS ensemble is not finite after a fit.")


def deviation(values: Tensor) -> Tensor:
    """Standard deviation over the first axis; ``Tensor.std`` takes ten times as long along a strided axis."""
    return (values - values.mean(0)).square_().mean(0).sqrt_()
