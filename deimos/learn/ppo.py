"""Proximal policy optimization with a clipped surrogate objective.

The updates are those of rsl_rl 5 (a test compares them on the same data), with one difference: an
episode that ran into its time limit is continued with the value of the observation it ended in; rsl_rl
uses the value of the one before.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from deimos.checks import SimulationError, check_at_least, check_choice, check_hidden, check_positive, check_range
from deimos.learn.rollout import Rollout
from deimos.nn.adam import Adam
from deimos.nn.networks import Activation, Actor, Backprop, flatten_parameters, mlp, rows_in_cache
from deimos.nn.random import Purpose, normals
from deimos.nn.ranks import mean_over_ranks
from deimos.nn.returns import value_gradient
from deimos.nn.seeds import generator
from deimos.nn.stateful import Stateful

LEARNING_RATE_RANGE = (1e-5, 1e-2)  # what the adaptive schedule may reach; rsl_rl's


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Proximal policy optimization [1]_; the defaults are rsl_rl's but for sizes and reward scale.

    .. [1] Schulman et al., *Proximal Policy Optimization Algorithms*, arXiv:1707.06347.
    """

    num_steps: int = 24
    """Steps of every world in one rollout, at least 1."""
    epochs: int = 5
    """Passes over every rollout, at least 1."""
    minibatches: int = 4
    """Parts that a rollout is split into, at least 1. What does not divide evenly is left out."""
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
    """What rewards are multiplied by for learning, positive. 1 - gamma makes returns of order 1, within
    reach of the clipped value loss."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of the actor and of the critic."""
    activation: Activation = "relu"
    """Between the layers."""
    init_std: float = 1.0
    """Standard deviation that the policy starts with, in units of the action, positive."""

    def __post_init__(self) -> None:
        for name in ("num_steps", "epochs", "minibatches"):
            check_at_least(name, getattr(self, name), 1)
        for name in ("learning_rate", "clip", "max_grad_norm", "reward_scale", "init_std"):
            check_positive(name, getattr(self, name), finite=True)
        for name in ("desired_kl", "value_coef", "entropy_coef"):
            check_range(name, getattr(self, name), 0.0, math.inf)
        for name in ("discount", "gae_lambda"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        check_choice("activation", self.activation, ["relu", "elu", "tanh"])
        check_hidden("hidden", self.hidden)


@dataclass(frozen=True)
class Batch:
    """Transitions to learn from, one per row; small vectors lie along the first axis (see ``_policy_gradient``)."""

    obs: Tensor
    """Shape (n, obs_dim)."""
    action: Tensor
    """Shape (action_dim, n)."""
    mean: Tensor
    """Mean of the policy that acted, shape (action_dim, n)."""
    log_prob: Tensor
    """Of the action under the policy that acted, shape (n,)."""
    advantage: Tensor
    """Normalised, shape (n,)."""
    value: Tensor
    """Before the update, shape (n,)."""
    returns: Tensor
    """Targets of the value function, shape (n,)."""
    weight: Tensor
    """Share in every average, shape (n,)."""

    def shuffled(self, order: Tensor) -> "Batch":
        """The same rows in another order."""
        return Batch(**{
            name: getattr(self, name)[order] if name == "obs" else getattr(self, name).index_select(-1, order)
            for name in self.__dataclass_fields__
        })  # fmt: skip

    def split(self, size: int) -> "Iterator[Batch]":
        """Consecutive parts of ``size`` rows; the last may be shorter."""
        for start in range(0, len(self.obs), size):
            rows = slice(start, start + size)
            yield Batch(**{
                name: getattr(self, name)[rows] if name == "obs" else getattr(self, name)[..., rows]
                for name in self.__dataclass_fields__
            })  # fmt: skip


class PPO(Stateful):
    """An actor and a critic, and how they learn from a rollout.

    Args:
        config: How they learn.
        num_envs: Number of worlds.
        obs_dim: Components of an observation.
        action_dim: Components of an action.
        device: Where they live.
        seed: Seed of the weights, the exploration and the order of the minibatches, in [0, 2^32).

    Raises:
        ValueError: If there are more minibatches than transitions in a rollout.
    """

    saved = ("actor", "critic", "optimizer", "generator")

    def __init__(
        self, config: PPOConfig, num_envs: int, obs_dim: int, action_dim: int, device: torch.device, seed: int
    ) -> None:
        rows = config.num_steps * num_envs
        if config.minibatches > rows:
            raise ValueError(
                f"minibatches must be at most the {rows} transitions of a rollout, got {config.minibatches}."
            )
        self.config = config
        self._size = rows // config.minibatches
        weights = generator(seed, "policy weights")
        self.actor = Actor(obs_dim, config.hidden, action_dim, config.activation, config.init_std, weights).to(device)
        self.critic = mlp(obs_dim, config.hidden, 1, config.activation, weights).to(device)
        self.generator = generator(seed, "policy minibatches", device)
        self._parameters, self._grads = flatten_parameters(self.actor, self.critic)
        self.learning_rate = torch.tensor(config.learning_rate, device=device)
        self.optimizer = Adam(self._parameters, self.learning_rate)
        self._piece = rows_in_cache(max(config.hidden)) if device.type == "cpu" else self._size
        self._actor_pass = Backprop(self.actor.mean)
        self._critic_pass = Backprop(self.critic)
        self._sizes = num_envs, obs_dim, action_dim, device
        self._seed, self._worlds = seed, torch.arange(num_envs, device=device)

    def new_rollout(self) -> Rollout:
        """Memory for what ``update`` learns from."""
        config = self.config
        return Rollout(
            config.num_steps, *self._sizes, discount=config.discount, gae_lambda=config.gae_lambda,
            reward_scale=config.reward_scale,
        )  # fmt: skip

    def draw_noise(self, noise: Tensor, first_step: int, env_offset: int = 0) -> None:
        """Draw the exploration of a whole rollout; a world's number depends on the seed, the world and the step alone.

        Args:
            noise: Standard normal draws, shape (num_steps, num_envs, action_dim). Written.
            first_step: Steps that every world has taken before, below 2^32 - num_steps.
            env_offset: Global number of world 0.
        """
        size = max(1, 2**17 // len(self._worlds))  # steps at a time whose words stay within a core's caches
        for start in range(0, len(noise), size):
            part = noise[start : start + size]
            steps = torch.arange(first_step + start, first_step + start + len(part), device=noise.device).unsqueeze(1)
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
        mean.copy_(self._actor_pass.forward(obs))
        torch.addcmul(mean, noise, self.actor.std, out=action)

    @torch.no_grad()
    def value(self, obs: Tensor) -> Tensor:
        """Values of observations of any leading shape, computed in cache-sized pieces."""
        flat = obs.reshape(-1, obs.shape[-1])
        value = torch.empty(len(flat), device=obs.device)
        size = self._piece
        for start in range(0, len(flat), size):
            rows = slice(start, start + size)
            value[rows] = self._critic_pass.forward(flat[rows]).squeeze(1)
        return value.view(obs.shape[:-1])

    @torch.no_grad()
    def update(
        self, rollout: Rollout, order: Tensor | None = None, critic: Callable[[Tensor], Tensor] | None = None
    ) -> dict[str, float]:
        """Learn from a rollout.

        Args:
            rollout: What the current policy did.
            order: The order that the transitions are split into minibatches in, int64,
                shape (num_steps * num_envs,); ``None`` draws one.
            critic: The value function to use as the baseline, from observations of shape (..., obs_dim) to values
                in units of scaled rewards; ``None`` for PPO's own. Somebody else trains it, and PPO's own learns
                nothing then.

        Returns:
            Averages over all minibatches: ``value_loss``, ``surrogate_loss``, ``kl``; and, after the
            update, ``entropy``, ``learning_rate``, ``action_std``, ``explained_variance``. Where fewer transitions
            count than a minibatch has, nothing is learnt and the first three are NaN.
        """
        batch, explained = self.batch(rollout, critic)
        if order is None:
            order = torch.randperm(len(batch.obs), generator=self.generator, device=batch.obs.device)
        std = self.actor.std.clone()
        value_loss = surrogate_loss = kl = math.nan
        if bool(mean_over_ranks(rollout.weight.sum()) >= self._size):
            batch = batch.shuffled(order[: self._size * self.config.minibatches])
            totals = torch.zeros(3, device=batch.obs.device)
            for _ in range(self.config.epochs):
                for minibatch in batch.split(self._size):
                    totals += self._learn(minibatch, std, learn_value=critic is None)
            value_loss, surrogate_loss, kl = (totals / (self.config.epochs * self.config.minibatches)).tolist()
        return {
            "value_loss": value_loss,
            "surrogate_loss": surrogate_loss,
            "kl": kl,
            "entropy": (self.actor.std.log().sum() + len(std) * 0.5 * math.log(2 * math.pi * math.e)).item(),
            "learning_rate": self.learning_rate.item(),
            "action_std": self.actor.std.mean().item(),
            "explained_variance": explained.item(),
        }

    @torch.no_grad()
    def batch(self, rollout: Rollout, critic: Callable[[Tensor], Tensor] | None = None) -> tuple[Batch, Tensor]:
        """Advantages, value targets and old log-probabilities of a rollout; and the share of variance explained.

        The networks have not changed since the rollout, so values and log-probabilities are
        computed here at once and not step by step.
        """
        value = rollout.estimate(critic or self.value)
        advantage = rollout.advantage
        returns = advantage + value
        weight = rollout.weight
        total = mean_over_ranks(weight.sum())
        mean = mean_over_ranks((weight * advantage).sum()) / total
        variance = mean_over_ranks((weight * (advantage - mean).square()).sum()) / (total - 1)
        explained = 1 - variance / (returns.var() + 1e-8)
        advantage = (advantage - mean) / (variance.sqrt() + 1e-8)
        z = (rollout.action - rollout.mean) / self.actor.std
        log_prob = -0.5 * z.square().sum(-1) - self._log_normaliser(self.actor.std)
        action_dim = rollout.action.shape[-1]
        return Batch(
            obs=rollout.obs[:-1].flatten(0, 1),
            action=rollout.action.view(-1, action_dim).t().contiguous(),
            mean=rollout.mean.view(-1, action_dim).t().contiguous(),
            log_prob=log_prob.flatten(),
            advantage=advantage.flatten(),
            value=value.flatten(),
            returns=returns.flatten(),
            weight=weight.flatten(),
        ), explained

    def _learn(self, minibatch: Batch, old_std: Tensor, *, learn_value: bool = True) -> Tensor:
        """One step of Adam; returns value loss, surrogate loss and KL divergence, shape (3,).

        On a CPU the minibatch is worked through in pieces that suit the caches; their gradients add up.
        """
        config, std = self.config, self.actor.std
        assert std.grad is not None
        assert self._parameters.grad is not None
        self._parameters.grad.zero_()
        minibatch = replace(minibatch, weight=minibatch.weight / minibatch.weight.sum().clamp(min=1.0))
        losses = torch.zeros(2, device=std.device)
        moved = torch.zeros_like(std)
        for piece in minibatch.split(self._piece):
            mean = self._actor_pass.forward(piece.obs).t().contiguous()
            surrogate_loss, grad_mean, grad_std = self._policy_gradient(piece, mean)
            self._actor_pass.backward(grad_mean.t())
            std.grad += grad_std
            losses[1] += surrogate_loss
            if learn_value:
                value = self._critic_pass.forward(piece.obs).squeeze(1)
                value_loss, grad_value = value_gradient(
                    value, piece.value, piece.returns, piece.weight,
                    clip=config.clip if config.clip_value else math.inf, coef=config.value_coef,
                )  # fmt: skip
                self._critic_pass.backward(grad_value.unsqueeze(1))
                losses[0] += value_loss
            moved += (mean - piece.mean).square_() @ piece.weight
        std.grad -= config.entropy_coef / std
        ratio = old_std / std
        kl = (0.5 * (ratio.square() + moved / std.square() - 1.0) - ratio.log()).sum()
        mean_over_ranks(self._parameters.grad)
        for grad in self._grads:
            grad.mul_((config.max_grad_norm / (torch.linalg.vector_norm(grad) + 1e-6)).clamp(max=1.0))
        if config.desired_kl:
            self._adapt_learning_rate(mean_over_ranks(kl))
        self.optimizer.step()
        std.data.clamp_(min=1e-6)
        return torch.cat([losses, kl.unsqueeze(0)])

    def _policy_gradient(self, batch: Batch, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The clipped surrogate and its gradient with respect to mean and standard deviation.

        With actions along the first axis every operation runs over long contiguous rows.

        max(-A r, -A clip(r)) has the slope -A where the first is the larger or both are equal
        (inside the clip), and 0 elsewhere; log r has the slopes z / std and (z^2 - 1) / std.
        """
        std = self.actor.std.unsqueeze(1)
        clip = self.config.clip
        z = (batch.action - mean).div_(std)
        squares = z.square()
        log_prob = squares.sum(0).mul_(-0.5).sub_(self._log_normaliser(self.actor.std))
        ratio = log_prob.sub_(batch.log_prob).exp_()
        plain = -batch.advantage * ratio
        clipped = -batch.advantage * ratio.clamp(1.0 - clip, 1.0 + clip)
        slope = plain * batch.weight * (plain >= clipped)  # derivative of the loss by log r
        grad_mean = z.mul_(slope).div_(std)
        grad_std = (squares.sub_(1.0) @ slope) / self.actor.std
        return torch.maximum(plain, clipped) @ batch.weight, grad_mean, grad_std

    def _adapt_learning_rate(self, kl: Tensor) -> None:
        """Divide by 1.5 above twice the desired divergence, multiply below half of it; no host round trip."""
        rate, desired = self.learning_rate, self.config.desired_kl
        factor = torch.where(kl > 2 * desired, 1 / 1.5, torch.where((kl < desired / 2) & (kl > 0), 1.5, 1.0))
        low, high = LEARNING_RATE_RANGE
        raised, lowered = (rate * factor).clamp(max=high), (rate * factor).clamp(min=low)
        rate.copy_(torch.where(factor > 1, raised, torch.where(factor < 1, lowered, rate)))

    @staticmethod
    def _log_normaliser(std: Tensor) -> Tensor:
        """Log of the integral of exp(-z^2 / 2) over all actions."""
        return std.log().sum() + 0.5 * len(std) * math.log(2 * math.pi)

    def load_weights(self, state: dict) -> None:
        """Load the networks alone.

        Raises:
            RuntimeError: If they have other sizes.
        """
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])

    def check(self) -> None:
        """Raise ``SimulationError`` if a weight is not finite; reads the device once."""
        if bool(self._parameters.isfinite().all()):
            return
        for part, module in (("actor", self.actor), ("critic", self.critic)):
            for name, value in module.named_parameters():
                if not value.isfinite().all():
                    raise SimulationError(f"The weight {part}.{name} is not finite after an update of PPO.")
