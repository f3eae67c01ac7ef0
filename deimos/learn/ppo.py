"""Proximal policy optimization with a clipped surrogate objective.

The updates are those of rsl_rl 5 (a test compares them on the same data), with one difference: an
episode that ran into its time limit is continued with the value of the observation it ended in; rsl_rl
uses the value of the one before.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from deimos.checks import SimulationError, check_at_least, check_choice, check_hidden, check_positive, check_range
from deimos.learn.rollout import Rollout
from deimos.nn.adam import Adam
from deimos.nn.graphs import Recorded, Recorder
from deimos.nn.layout import ALL, Seen, count
from deimos.nn.losses import Loss, Surrogate, ValueLoss, log_prob
from deimos.nn.mlps import MLPs, gradients
from deimos.nn.networks import ACTIVATIONS, Activation, Actor, mlp
from deimos.nn.random import Purpose, normals
from deimos.nn.ranks import gather_rows, own_transitions, place, sum_over_ranks
from deimos.nn.seeds import generator
from deimos.nn.stateful import Stateful

LEARNING_RATE_RANGE = (1e-5, 1e-2)  # bounds of the adaptive schedule; rsl_rl's


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Proximal policy optimization [1]_; the defaults are rsl_rl's except for sizes and reward scale.

    .. [1] Schulman et al., *Proximal Policy Optimization Algorithms*, arXiv:1707.06347.
    """

    num_steps: int = 24
    """Steps of every world in one rollout, at least 1."""
    epochs: int = 5
    """Passes over every rollout, at least 1."""
    minibatches: int = 4
    """Parts that a rollout is split into, at least 1. A remainder is left out."""
    learning_rate: float = 1e-3
    """Initial learning rate of Adam, positive."""
    desired_kl: float = 0.01
    """KL divergence of one update that the adaptive schedule aims at, at least 0; 0 keeps the learning rate fixed."""
    discount: float = 0.99
    """Weight of the next step's reward (gamma), in [0, 1]."""
    gae_lambda: float = 0.95
    """Advantage estimator: 0 trusts the value function, 1 the returns. In [0, 1]."""
    clip: float = 0.2
    """How far the probability ratio, and the value, may move in one update; positive."""
    clip_value: bool = True
    """Whether the value loss is clipped too."""
    value_coef: float = 1.0
    """Weight of the value loss, at least 0."""
    entropy_coef: float = 0.01
    """Weight of the entropy bonus, at least 0."""
    max_grad_norm: float = 1.0
    """Norm that the gradient of each network is clipped to, positive."""
    reward_scale: float = 0.01
    """Factor on rewards for learning, positive. 1 - gamma makes returns of order 1, within reach of the clipped value
    loss."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of the actor and of the critic."""
    activation: Activation = "relu"
    """Activation between the layers."""
    init_std: float = 1.0
    """Standard deviation that the policy starts with, in units of the action, positive."""
    normalize_observations: bool = False
    """Whether actor and critic see observations minus their running mean, in units of their running standard
    deviation. The statistics are part of the trained policy, and fixed in it."""

    def __post_init__(self) -> None:
        for name in ("num_steps", "epochs", "minibatches"):
            check_at_least(name, getattr(self, name), 1)
        for name in ("learning_rate", "clip", "max_grad_norm", "reward_scale", "init_std"):
            check_positive(name, getattr(self, name), finite=True)
        for name in ("desired_kl", "value_coef", "entropy_coef"):
            check_range(name, getattr(self, name), 0.0, math.inf, finite=True)
        for name in ("discount", "gae_lambda"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        check_choice("activation", self.activation, ACTIVATIONS)
        check_hidden("hidden", self.hidden)


@dataclass(frozen=True)
class Batch:
    """Transitions to learn from, one per column, so that every component is contiguous in memory."""

    table: Tensor
    """Observations as the networks receive them, actions, means of the policy that acted, log-probability under it,
    normalised advantage, weight, value before the update and target, shape (obs_dim + 2 action_dim + 5, n)."""
    obs_dim: int
    """Components of an observation."""

    @cached_property
    def obs(self) -> Tensor:
        """Observations, shape (n, obs_dim): a view."""
        return self.table[: self.obs_dim].t()

    @cached_property
    def policy(self) -> Tensor:
        """The data of ``losses.Surrogate``: a view."""
        return self.table[self.obs_dim : -2].unsqueeze(0)

    @cached_property
    def value(self) -> Tensor:
        """The data of ``losses.ValueLoss``: a view."""
        return self.table[-3:].unsqueeze(0)


class PPO(Stateful):
    """An actor and a critic, and how they learn from a rollout.

    Args:
        config: How they learn.
        num_envs: Number of worlds; of each rank, where several share a run.
        obs_dim: Components of an observation.
        action_dim: Components of an action.
        device: Device of the networks.
        seed: Seed of the weights, the exploration and the order of the minibatches, in [0, 2^32).
        actor_sees: What the actor sees of an observation.
        critic_sees: What the critic sees of it.
        record: Records the learning from all minibatches of a rollout, to replay it; ``None`` records nothing.

    Raises:
        ValueError: If there are more minibatches than transitions in a rollout.
    """

    saved = ("actor", "critic", "optimizer", "generator")

    def __init__(
        self, config: PPOConfig, num_envs: int, obs_dim: int, action_dim: int, device: torch.device, seed: int, *,
        actor_sees: Seen = ALL, critic_sees: Seen = ALL, record: Recorder | None = None,
    ) -> None:  # fmt: skip
        rows = config.num_steps * num_envs
        self._rows = rows * place().size  # transitions of all ranks
        if config.minibatches > self._rows:
            raise ValueError(
                f"minibatches must be at most the {self._rows} transitions of a rollout, got {config.minibatches}."
            )
        self.config = config
        self._size = self._rows // config.minibatches
        weights = generator(seed, "policy weights")
        self.actor = Actor(
            obs_dim, config.hidden, action_dim, config.activation, config.init_std, weights, actor_sees,
            normalize=config.normalize_observations,
        ).to(device)  # fmt: skip
        self.critic = mlp(count(critic_sees, obs_dim), config.hidden, 1, config.activation, weights).to(device)
        self._critic_sees = critic_sees
        self.generator = generator(seed, "policy minibatches", device)
        sizes = [sum(p.numel() for p in module.parameters()) for module in (self.actor, self.critic)]
        memory = torch.zeros(2, sum(sizes), dtype=torch.float32, device=device)  # one vector: Adam makes few passes
        self._actor, self._critic = (
            MLPs([module], part.unsqueeze(1))
            for module, part in zip((self.actor, self.critic), memory.split(sizes, dim=1), strict=True)
        )
        self._parameters, self._grad = memory
        self.learning_rate = torch.tensor(config.learning_rate, dtype=torch.float32, device=device)
        self.optimizer = Adam(self._parameters, self._grad, self.learning_rate, late=sizes[0])
        shape = obs_dim + 2 * action_dim + 5, rows
        self._batch, self._shuffled = (
            Batch(torch.zeros(shape, dtype=torch.float32, device=device), obs_dim) for _ in range(2)
        )
        self._order = torch.zeros(self._rows, dtype=torch.int64, device=device)
        self._fit = Recorded[Tensor](record)
        self._normalized = torch.zeros(num_envs, obs_dim, dtype=torch.float32, device=device)
        self._sizes = num_envs, obs_dim, action_dim, device
        self._seed, self._worlds = seed, torch.arange(num_envs, device=device)

    def new_rollout(self) -> Rollout:
        """Memory for what ``update`` learns from."""
        config = self.config
        return Rollout(
            config.num_steps, *self._sizes, discount=config.discount, gae_lambda=config.gae_lambda,
            reward_scale=config.reward_scale,
        )  # fmt: skip

    def draw_noise(self, noise: Tensor, first_step: int | Tensor, env_offset: int = 0) -> None:
        """Draw the exploration noise of a rollout; a world's numbers depend only on the seed, the world and the step.

        Args:
            noise: Standard normal draws, shape (num_steps, num_envs, action_dim). Written.
            first_step: Steps that every world has taken before, below 2^32 - num_steps; a zero-dimensional int64 tensor
                to have it read on the device.
            env_offset: Global number of world 0.
        """
        size = max(1, 2**17 // len(self._worlds))  # steps at a time, so that their words stay within a core's caches
        for start in range(0, len(noise), size):
            part = noise[start : start + size]
            steps = (torch.arange(start, start + len(part), device=noise.device) + first_step).unsqueeze(1)
            part.copy_(normals(self._seed, Purpose.EXPLORATION, self._worlds + env_offset, steps, noise.shape[2]))

    @torch.no_grad()
    def act(self, obs: Tensor, noise: Tensor, action: Tensor, mean: Tensor) -> None:
        """Draw actions from the policy.

        Args:
            obs: Observations, shape (n, obs_dim).
            noise: Standard normal draws, shape (n, action_dim).
            action: Actions, shape (n, action_dim). Written.
            mean: Means of their distribution, same shape. Written.
        """
        inputs = self._inputs(obs, self._normalized[: len(obs)])[:, self.actor.seen]
        self._actor.forward(inputs, out=mean.unsqueeze(0))
        torch.addcmul(mean, noise, self.actor.std, out=action)

    @torch.no_grad()
    def value(self, obs: Tensor) -> Tensor:
        """Values of observations of any leading shape."""
        return self._critic.forward(self._inputs(obs.flatten(0, -2))[:, self._critic_sees]).view(obs.shape[:-1])

    def _inputs(self, obs: Tensor, out: Tensor | None = None) -> Tensor:
        """What the networks receive for observations, shape (n, obs_dim); normalised into ``out`` if it is given."""
        return obs if self.actor.normalizer is None else self.actor.normalizer(obs, out)

    @torch.no_grad()
    def update(
        self, rollout: Rollout, order: Tensor | None = None, critic: Callable[[Tensor], Tensor] | None = None, *,
        learn_policy: bool = True,
    ) -> dict[str, float]:  # fmt: skip
        """Learn from a rollout.

        Args:
            rollout: What the current policy did.
            order: The order in which the transitions of all ranks are split into minibatches, int64,
                shape (num_steps * all worlds,); ``None`` draws one.
            critic: The value function to use as the baseline, from observations of shape (..., obs_dim) to values
                in units of scaled rewards; ``None`` for PPO's own. With a given one, PPO trains no critic.
            learn_policy: Whether the policy learns, its normaliser included.

        Returns:
            Averages over all minibatches: ``value_loss``, ``surrogate_loss``, ``kl``; and, after the
            update, ``entropy``, ``learning_rate``, ``action_std``, ``explained_variance``. If fewer transitions
            have weight than a minibatch holds, nothing is learnt and the first three are NaN.
        """
        explained = self.batch(rollout, critic)[1]
        if order is None:
            own = self._order.device  # named: within ``own_settings`` it may be the CPU, whatever ``out`` is
            torch.randperm(self._rows, generator=self.generator, out=self._order, device=own)
        else:
            self._order.copy_(order)
        value_loss = surrogate_loss = kl = math.nan
        learns = learn_policy or critic is None
        if learns and self._has_enough(rollout.weight):
            options = {"policy": learn_policy, "value": critic is None}
            key = tuple(options.values()) if place().size == 1 else None  # communication between ranks is not recorded
            value_loss, surrogate_loss, kl = self._fit(partial(self._fit_batch, **options), key).tolist()
        if learn_policy and self.actor.normalizer is not None:
            # Only now: learning must start from the policy that acted.
            for obs, weight in zip(rollout.obs[:-1], rollout.weight, strict=True):
                self.actor.normalizer.update(obs, (weight > 0).float())
        entropy = self.actor.std.log().sum() + len(self.actor.std) * 0.5 * math.log(2 * math.pi * math.e)
        after = {
            "entropy": entropy, "learning_rate": self.learning_rate, "action_std": self.actor.std.mean(),
            "explained_variance": explained,
        }  # fmt: skip
        return {
            "value_loss": value_loss,
            "surrogate_loss": surrogate_loss,
            "kl": kl,
            **dict(zip(after, torch.stack(list(after.values())).tolist(), strict=True)),
        }

    def _has_enough(self, weight: Tensor) -> bool:
        """Whether a minibatch's number of transitions has any weight, and the weights add up to more than 1."""
        count, total = sum_over_ranks(torch.stack([(weight > 0).sum(dtype=torch.float64), weight.sum().double()]))
        return bool((count >= self._size) & (total > 1.0))

    @torch.no_grad()
    def batch(self, rollout: Rollout, critic: Callable[[Tensor], Tensor] | None = None) -> tuple[Batch, Tensor]:
        """Advantages, value targets and old log-probabilities of a rollout; and the share of variance explained.

        The networks have not changed since the rollout, so values and log-probabilities are
        computed here all at once instead of step by step. The next call overwrites the batch.
        """
        value = rollout.estimate(critic or self.value)
        advantage = rollout.advantage
        returns = advantage + value
        weight = rollout.weight
        total = sum_over_ranks(weight.sum())
        mean = sum_over_ranks((weight * advantage).sum()) / total
        variance = sum_over_ranks((weight * (advantage - mean).square()).sum()) / (total - 1)
        explained = 1 - variance / (gather_rows(returns, dim=1).var() + 1e-8)
        advantage = (advantage - mean) / (variance.sqrt() + 1e-8)
        table, std = self._batch.table, self.actor.std.unsqueeze(1)
        start, size = rollout.obs.shape[2], rollout.action.shape[2]
        obs, action, mean, *rows = table.split([start, size, size, 1, 1, 1, 1, 1])
        for part, source in ((obs, rollout.obs[:-1]), (action, rollout.action), (mean, rollout.mean)):
            part.copy_(source.flatten(0, 1).t())
        self._inputs(obs.t(), out=obs.t())
        density = log_prob((action - mean) / std, std)
        for row, source in zip(rows, (density, advantage, weight, value, returns), strict=True):
            row.copy_(source.flatten())
        return self._batch, explained

    def _fit_batch(self, *, policy: bool, value: bool) -> Tensor:
        """Learn from the last batch in the last order; return means of ``_learn`` over all minibatches.

        It reads and writes tensors that stay in place, and never waits for the device: see ``deimos.nn.graphs``.
        """
        std = self.actor.std.clone()
        minibatches = self._minibatches(self._batch, self._order)
        totals = torch.zeros(3, dtype=torch.float32, device=std.device)
        self._grad.zero_()
        for _ in range(self.config.epochs):
            for minibatch in minibatches:
                totals += self._learn(minibatch, std, learn_value=value) if policy else self._learn_value(minibatch)
        return totals / (self.config.epochs * self.config.minibatches)

    def _minibatches(self, batch: Batch, order: Tensor) -> list[Batch]:
        """Parts of a batch in the given order, each with weights that add up to 1 over all ranks."""
        count, num_envs = self.config.minibatches, self._sizes[0]
        rows, own = own_transitions(order[: self._size * count].view(count, self._size), num_envs)
        table = self._shuffled.table.resize_(len(batch.table), rows.numel())  # a rank's share differs each time
        torch.index_select(batch.table, 1, rows.flatten(), out=table)
        weight = table[-3].view_as(rows)
        if own is not None:
            weight *= own
        weight /= sum_over_ranks(weight.sum(1, keepdim=True)).clamp(min=1.0)
        return [Batch(part, batch.obs_dim) for part in table.split(rows.shape[1], dim=1)]

    def _learn(self, minibatch: Batch, old_std: Tensor, *, learn_value: bool = True) -> Tensor:
        """Make one step of Adam; return value loss, surrogate loss and KL divergence, shape (3,)."""
        config, std = self.config, self.actor.std
        assert std.grad is not None
        work: list[tuple[MLPs, Tensor, Loss]]
        work = [(self._actor, minibatch.obs[:, self.actor.seen], Surrogate(minibatch.policy, config.clip))]
        if learn_value:
            work.append(self._value_work(minibatch))
        surrogate, *value = gradients(*work)
        sum_over_ranks(self._grad, surrogate, *value)
        std.grad -= config.entropy_coef / std
        self._critic.grad *= config.value_coef
        ratio, moved = old_std / std, surrogate[0, 1:]
        kl = (0.5 * (ratio.square() + moved / std.square() - 1.0) - ratio.log()).sum()
        for nets in (self._actor, self._critic):
            nets.clip_gradient(config.max_grad_norm)
        if config.desired_kl:
            self._adapt_learning_rate(kl)
        self.optimizer.step()
        std.data.clamp_(min=1e-6)
        value_loss = value[0][0, 0] if value else torch.zeros_like(kl)
        return torch.stack([value_loss, surrogate[0, 0], kl])

    def _value_work(self, minibatch: Batch) -> tuple[MLPs, Tensor, Loss]:
        """What the critic learns from a minibatch."""
        clip = self.config.clip if self.config.clip_value else math.inf
        return self._critic, minibatch.obs[:, self._critic_sees], ValueLoss(minibatch.value, clip)

    def _learn_value(self, minibatch: Batch) -> Tensor:
        """``_learn`` for the critic alone; surrogate loss and KL divergence are NaN."""
        (loss,) = gradients(self._value_work(minibatch))
        sum_over_ranks(self._critic.grad, loss)
        self._critic.grad *= self.config.value_coef
        self._critic.clip_gradient(self.config.max_grad_norm)
        self.optimizer.step(without_late=True)
        return torch.stack([loss[0, 0], *loss.new_full((2,), math.nan)])

    def _adapt_learning_rate(self, kl: Tensor) -> None:
        """Divide by 1.5 above twice the desired divergence, multiply below half of it; no host round trip."""
        rate, desired = self.learning_rate, self.config.desired_kl
        low, high = LEARNING_RATE_RANGE
        raised, lowered = (rate * 1.5).clamp(max=high), (rate * (1 / 1.5)).clamp(min=low)
        kept = torch.where((kl < desired / 2) & (kl > 0), raised, rate)
        torch.where(kl > 2 * desired, lowered, kept, out=rate)

    def load_weights(self, state: dict) -> None:
        """Load the networks alone.

        Raises:
            RuntimeError: If they have other sizes.
        """
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])

    def load_learnt(self, state: dict) -> None:
        """Load what was learnt: networks, observation statistics and the optimiser's gradient statistics.

        Raises:
            KeyError: If something is missing.
            RuntimeError, ValueError: If the networks have other sizes.
        """
        self.load_weights(state)
        self.optimizer.load_state_dict(state["optimizer"])

    def check(self) -> None:
        """Raise ``SimulationError`` if a weight or a statistic is not finite; reads the device once."""
        finite = [numbers.isfinite().all() for numbers in (self._parameters, *self.actor.buffers())]
        if bool(torch.stack(finite).all()):
            return
        for part, module in (("actor", self.actor), ("critic", self.critic)):
            for name, value in module.state_dict().items():
                if not value.isfinite().all():
                    raise SimulationError(f"The weight {part}.{name} is not finite after an update of PPO.")
