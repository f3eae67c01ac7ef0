"""What every goal selector promises. A selector sees tensors only, never an environment or a learner."""

import abc
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from deimos.goals import picks
from deimos.goals.interactions import Interactions
from deimos.nn.stateful import Stateful


@dataclass(frozen=True)
class Spaces:
    """What a selector needs to know about the worlds that it serves."""

    num_envs: int
    """Number of worlds; where several ranks share a run, that of each."""
    state_dim: int
    """Components of a state (the observation without its goal)."""
    goal_dim: int
    """Components of a goal."""
    goal_period: int
    """T: steps that a goal is active."""
    device: torch.device
    """Device of the tensors."""
    groups: tuple[slice, ...] = (slice(None),)
    """Components of a goal that are met or missed together; ``Resolved.tracking`` has one column for each."""
    goal_start: int | None = None
    """Where the goal begins in the observation, the rest of which is the state; ``None`` for after the state."""
    total_steps: int = 0
    """Steps of the whole training; 0 if unknown."""
    goal_middle: tuple[float, ...] | None = None
    """Middle of the range of every component of a goal; ``None`` for 0, as in the policy's scale."""

    def __post_init__(self) -> None:
        components = range(self.goal_dim)
        named = [components[group] if isinstance(group, slice) else range(0) for group in self.groups]
        if not all(named) or sorted(component for group in named for component in group) != list(components):
            raise ValueError(
                f"groups must be slices that name each of the {self.goal_dim} components of a goal once, got "
                f"{self.groups}."
            )

    def state_then_goal(self, obs: Tensor) -> Tensor:
        """Observations, shape (..., obs_dim), with the goal moved after the state; no copy if it is there already."""
        if self.goal_start is None or self.goal_start == self.state_dim:
            return obs
        start, stop = self.goal_start, self.goal_start + self.goal_dim
        return torch.cat([obs[..., :start], obs[..., stop:], obs[..., start:stop]], dim=-1)

    def require_total_steps(self, who: str) -> int:
        """``total_steps``, for selectors that need it.

        Raises:
            ValueError: If it is unknown; ``who`` names the selector.
        """
        if self.total_steps < 1:
            raise ValueError(f"{who} changes over the training, so Spaces.total_steps must be positive, got 0.")
        return self.total_steps


@dataclass(frozen=True)
class Proposal:
    """The goals that a selector chose."""

    goal: Tensor
    """Shape (B, goal_dim)."""
    score: Tensor
    """The selector's score of each, NaN where it has none, shape (B,)."""
    weight: Tensor | None = None
    """Weight of what follows in everything learnt, at least 0, shape (B,); ``None`` for 1 everywhere."""
    probe: Tensor | None = None
    """True where the goal was drawn uniformly, whatever its score, bool, shape (B,); ``None`` for nowhere."""
    note: Tensor | None = None
    """A whole number that comes back with the interaction, int64 below 2^24, shape (B,); ``None`` for 0."""
    percentile: Tensor | None = None
    """Percentile of the goal's fear among the candidates, in [0, 100], shape (B,); ``None`` if unknown."""


def uniform_proposal(candidates: Tensor, draw: Tensor) -> Proposal:
    """Any of the candidates, without a score. Whatever is feared, its percentile is 50 on average.

    Args:
        candidates: Shape (B, N, goal_dim).
        draw: Uniform numbers in [0, 1), shape (B,).
    """
    pick = picks.uniformly(draw, candidates.shape[1])
    unknown, middle = torch.full_like(draw, torch.nan), torch.full_like(draw, 50.0)
    return Proposal(picks.take(candidates, pick), unknown, percentile=middle)


class Transitions(Protocol):
    """The learner's transitions that selectors may learn from, of shape (num_steps, num_envs) except ``obs``."""

    num_steps: int
    obs: Tensor  # what the steps started from, and those after the last: (num_steps + 1, num_envs, obs_dim)
    reward: Tensor  # as the environment gives them
    terminated: Tensor
    truncated: Tensor
    weight: Tensor  # in everything learnt: 0 leaves a transition out
    advantage: Tensor  # the learner's, in units of scaled rewards
    reward_scale: float  # what the learner multiplies rewards by before it values them
    discount: float
    gae_lambda: float

    def cut_off(self) -> tuple[Tensor, Tensor, Tensor]:
        """Steps and worlds that were truncated, int64, shape (m,) each, and their last observations, (m, obs_dim)."""
        ...


class SelectorConfig(abc.ABC):
    """What the ``Config`` of a selector promises: a frozen dataclass in a file of ``deimos.goals.selectors``."""

    @abc.abstractmethod
    def build(self, spaces: Spaces, seed: int) -> "GoalSelector":
        """Make the selector.

        Args:
            spaces: The worlds that it serves.
            seed: Seed of its networks and of its own draws.
        """


class GoalSelector(Stateful, abc.ABC):
    """Chooses the goals of a training run; ``saved`` names what a resume needs."""

    num_candidates: int = 1
    """Candidates that it wants to choose from at every decision."""
    parts: "tuple[GoalSelector, ...]" = ()
    """The selectors that it is made of."""
    needs_rollout: bool = False
    """Whether ``learn`` needs the learner's transitions."""
    needs_tracking: bool = False
    """Whether ``learn`` follows how well goals are met, and does nothing without tracking."""
    first_goals_scaled: bool = False
    """Whether ``goal_range`` bounds first goals too; true only for a curriculum of the range."""
    crash_penalty: float = 0.0
    """What a crash takes from the learner's reward, at least 0, in units of the largest reward of a step."""
    dense: bool = False
    """Whether ``propose`` may be called for all worlds at every step, as on a GPU, which would have to wait to find out
    how many are due. It must then not change the selector, since most of its answers are dropped; ``issued`` notes what
    was issued."""

    def graph_key(self) -> Hashable:
        """What Python branches on in ``propose`` and ``issued``, such as whether a network has learnt yet.

        A GPU records a whole rollout as a CUDA graph, and replays it as long as this stays the same. So everything else
        that they depend on and that changes must be in tensors that are written in place; ``None`` if that is not so.
        See ``deimos.nn.graphs``.
        """
        return None

    def goal_range(self) -> Tensor | None:
        """Share of the goal range to draw candidates from, shape (goal_dim,), in (0, 1]; ``None`` for all of it."""
        return None

    @abc.abstractmethod
    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """Choose the next goal of each listed world.

        Args:
            rows: Worlds, int64, shape (B,).
            state: Their states, shape (B, state_dim).
            goal: Their active goals, shape (B, goal_dim).
            candidates: Independent uniform goals for each, shape (B, num_candidates, goal_dim).
            draws: Uniform numbers in [0, 1) that belong to this decision, shape (B, 4). All randomness
                in the choice comes from here, so that it is the same in any batch.
        """

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """Take note of goals that were issued.

        The first arguments are those of ``propose``, and ``chosen`` is what it returned. ``where`` says in which of the
        rows goals were issued, bool, shape (B,); ``None`` for all. See ``deimos.goals.interactions.assign``.
        """

    def critic(self) -> Callable[[Tensor], Tensor] | None:
        """The value function for the learner to use instead of its own, if this selector supplies one.

        It takes observations of shape (..., obs_dim) and returns values in units of scaled rewards, shape (...).
        """
        return None

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Learn from what happened, once per rollout.

        Where several ranks share a run, each learns the same from the same interactions, those in the worlds of all.
        What a selector keeps of its own worlds, or counts in them, it gathers with ``deimos.nn.ranks``. What it reads
        of the interactions is gathered then, so whether it reads it must not depend on the rank.

        Args:
            interactions: The pending and the recently resolved ones; worlds by their global numbers.
            rollout: The transitions of this rank's worlds since the last call; ``None`` in a loop that keeps none,
                where selectors that learn from transitions raise ``ValueError``.

        Returns:
            Numbers for the log, the same keys every time.
        """
        return {}

    def check(self) -> None:
        """Raise ``SimulationError`` if a weight is not finite."""


def with_parts(selector: GoalSelector) -> Iterator[GoalSelector]:
    """A selector and everything that it is made of."""
    yield selector
    for part in selector.parts:
        yield from with_parts(part)


class Delegate(GoalSelector):
    """Leaves everything to one of its ``parts``, ``current``, except what it overrides; saves all of them."""

    saved: ClassVar[tuple[str, ...]] = ("parts",)

    @property
    @abc.abstractmethod
    def current(self) -> GoalSelector:
        """The part that chooses."""

    needs_rollout = property(lambda self: any(part.needs_rollout for part in self.parts))
    dense = property(lambda self: self.current.dense)
    num_candidates = property(lambda self: self.current.num_candidates)
    first_goals_scaled = property(lambda self: self.current.first_goals_scaled)
    crash_penalty = property(lambda self: self.current.crash_penalty)

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        key = self.current.graph_key()
        return None if key is None else (self.parts.index(self.current), key)

    def goal_range(self) -> Tensor | None:
        """See ``GoalSelector.goal_range``."""
        return self.current.goal_range()

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        return self.current.propose(rows, state, goal, candidates, draws)

    def issued(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, chosen: Proposal,
        where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """See ``GoalSelector.issued``."""
        self.current.issued(rows, state, goal, candidates, chosen, where)

    def critic(self) -> Callable[[Tensor], Tensor] | None:
        """See ``GoalSelector.critic``."""
        return self.current.critic()

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """See ``GoalSelector.learn``."""
        return self.current.learn(interactions, rollout)

    def check(self) -> None:
        """See ``GoalSelector.check``."""
        self.current.check()
