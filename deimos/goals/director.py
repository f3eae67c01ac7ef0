"""A goal selector in other people's loops: one object, which needs only torch and NumPy."""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_range
from deimos.goals.core import GoalCore
from deimos.goals.fear_selector import FearEstimate, fear_selector
from deimos.goals.interactions import Interactions
from deimos.goals.methods import method
from deimos.goals.selector import GoalSelector, SelectorConfig, Spaces
from deimos.nn.random import Purpose, uniforms


@dataclass(frozen=True)
class Assignment:
    """What every world pursues next."""

    goal: Tensor
    """Goals, shape (num_envs, goal_dim): the given ones but where ``changed``."""
    changed: Tensor
    """True where the goal is a new one, bool, shape (num_envs,)."""
    weight: Tensor
    """Weight of the transitions under the goal in everything that the learner learns, at least 0, shape (num_envs,);
    1 under most selectors."""


class GoalDirector:
    """Chooses the goals of any vectorised environment, and learns from their outcomes.

    It keeps the goal clocks and the interactions, and lets the selector learn. Call ``step`` once after
    every step of the worlds, and make the goals that it returns the active ones. It keeps copies, without gradients.

    Selectors that learn from the learner's transitions (``vds``, ``plr``) need Deimos' own loop.

    Args:
        selector: Who chooses: a selector's ``Config``, or the name of a method such as ``p25``.
        goal_period: T: steps that a goal is active, at least 1.
        learn_every: Steps between two updates of the selector, at least 1; a rollout of the learner is a good choice.
        total_steps: Steps of the whole training, for selectors that change over it; 0 where nobody knows.
        seed: Seed of the selector's networks and of every choice, in [0, 2^32).
    """

    def __init__(
        self, selector: SelectorConfig | str, goal_period: int, *, learn_every: int = 24, total_steps: int = 0,
        seed: int = 0,
    ) -> None:  # fmt: skip
        check_at_least("goal_period", goal_period, 1)
        check_at_least("learn_every", learn_every, 1)
        check_at_least("total_steps", total_steps, 0)
        check_range("seed", seed, 0, 2**32 - 1)
        self.goal_period, self.learn_every = goal_period, learn_every
        self.metrics: dict[str, float] = {}
        """What the selector's last update had to say."""
        self._config = method(selector) if isinstance(selector, str) else selector
        self._total_steps, self._seed = total_steps, seed
        self._core: GoalCore | None = None
        self._sizes: tuple[int, int, int] | None = None  # worlds, components of a state, of a goal

    @property
    def selector(self) -> GoalSelector:
        """Who chooses.

        Raises:
            RuntimeError: Before the first step, which tells how many worlds and components there are.
        """
        return self._known.selector

    @property
    def interactions(self) -> Interactions:
        """The outcomes of its goals; see ``selector`` for when it is known."""
        return self._known.interactions

    @property
    def _known(self) -> GoalCore:
        if self._core is None:
            raise RuntimeError("The GoalDirector knows its worlds only after the first call of step().")
        return self._core

    @property
    def goal_range(self) -> Tensor | None:
        """Share of the goal range to draw candidates from, shape (goal_dim,); ``None`` for all of it.

        Only a curriculum of the range (``cl``) has one, and only from the first step on.
        """
        return None if self._core is None else self._core.selector.goal_range()

    @torch.no_grad()
    def step(
        self, state: Tensor, goal: Tensor, terminated: Tensor, truncated: Tensor, candidates: Tensor,
        tracking: Tensor | None = None,
    ) -> Assignment:  # fmt: skip
        """Resolve what the last step decided, and choose the goals that are due.

        Worlds that are done get a uniform first goal, their first candidate.

        Args:
            state: Observations without the goal, shape (num_envs, state_dim). Where a world is done it may be
                that from before or after its reset: nothing is chosen for it.
            goal: Goals that were active during the step, shape (num_envs, goal_dim).
            terminated: True where the world crashed, bool, shape (num_envs,).
            truncated: True where its episode was cut off without a crash, bool, shape (num_envs,).
            candidates: Independent uniform valid goals, from within ``goal_range``, shape
                (num_envs, N, goal_dim), N at least 1.
            tracking: How well the goal is met, in [0, 1], shape (num_envs,), for curricula; ``None`` for 0.

        Raises:
            ValueError: If a shape does not fit the others or those of the first call, or, on the first call, if
                the selector needs the learner's rollout.
        """
        self._check(state, goal, terminated, truncated, candidates)
        core = self._core or self._begin(state, goal)
        if core.interactions.now % self.goal_period == 0:  # no world's goal is due twice within T steps
            self._draw()
        self._clock += 1
        due = self._clock >= self.goal_period
        reward = torch.zeros_like(terminated, dtype=torch.float32) if tracking is None else tracking.float()
        changes = core.advance(terminated, truncated, due, reward)
        done = terminated | truncated
        goals = torch.where(done.unsqueeze(1), candidates[:, 0], goal)
        rows = changes.due
        if len(rows):
            goals[rows] = core.choose(rows, state[rows], goal[rows], candidates[rows], self._draws[rows])
            self._count[rows] += 1
        self._clock.masked_fill_(due | done, 0)
        core.weight.masked_fill_(done, 1.0)
        if core.interactions.now % self.learn_every == 0:
            self.metrics = core.learn(None)
        return Assignment(goals, due | done, core.weight.clone())

    @torch.inference_mode(False)  # what is made in a loop without gradients shall also be used outside it
    def _begin(self, state: Tensor, goal: Tensor) -> GoalCore:
        self._sizes = len(state), state.shape[1], goal.shape[1]
        spaces = Spaces(*self._sizes, self.goal_period, state.device, total_steps=self._total_steps)
        selector = self._config.build(spaces, self._seed)
        if selector.needs_rollout:
            raise ValueError(f"selector must need no rollout of the learner, as vds and plr do; got {self._config}.")
        # Steps that the goal of every world has been active, and goals that were chosen for it: its draws' addresses.
        self._clock, self._count = torch.zeros(2, len(state), dtype=torch.int64, device=state.device)
        self._core = GoalCore(selector, spaces)
        return self._core

    def _draw(self) -> None:
        """Draw for the next decision of every world; many worlds at once cost what one does."""
        worlds = torch.arange(len(self._count), device=self._count.device)
        self._draws = uniforms(self._seed, Purpose.GOAL, worlds, self._count)

    def _check(self, state: Tensor, goal: Tensor, terminated: Tensor, truncated: Tensor, candidates: Tensor) -> None:
        given = {"state": state, "goal": goal, "terminated": terminated, "truncated": truncated}
        for name, value in (given | {"candidates": candidates}).items():
            if not isinstance(value, Tensor):
                kind = f"{type(value).__module__}.{type(value).__qualname__}"
                raise ValueError(f"{name} must be a tensor, got {kind}; torch.as_tensor makes one.")
        for name, components in (("state", "state_dim"), ("goal", "goal_dim")):
            if given[name].dim() != 2:
                shape = tuple(given[name].shape)
                raise ValueError(f"{name} must have the shape (num_envs, {components}), got {shape}.")
        n, state_dim, goal_dim = self._sizes or (len(state), state.shape[1], goal.shape[1])
        sizes = {"state": (n, state_dim), "goal": (n, goal_dim), "terminated": (n,), "truncated": (n,)}
        for name, shape in sizes.items():
            if given[name].shape != shape:
                raise ValueError(f"{name} must have the shape {shape}, got {tuple(given[name].shape)}.")
        for name in ("terminated", "truncated"):
            if given[name].dtype != torch.bool:
                raise ValueError(f"{name} must be bool, got {given[name].dtype}.")
        if candidates.dim() != 3 or candidates.shape[::2] != goal.shape or candidates.shape[1] < 1:
            expected = f"({n}, N, {goal_dim}) with N at least 1"
            raise ValueError(f"candidates must have the shape {expected}, got {tuple(candidates.shape)}.")

    @torch.no_grad()
    def fear(self, state: Tensor, goal: Tensor, new_goal: Tensor) -> FearEstimate:
        """Calibrated probability that the policy crashes within T steps of getting ``new_goal``, and its quality.

        Args:
            state: States, shape (B, state_dim).
            goal: Active goals, shape (B, goal_dim).
            new_goal: Goals to evaluate, shape (B, goal_dim).

        Raises:
            ValueError: If the selector has no fear network.
            RuntimeError: If it has not learnt anything yet.
        """
        afraid = fear_selector(self.selector)
        if afraid is None:
            raise ValueError(f"The selector must have a fear network, as a Director has; got {self._config}.")
        return afraid.estimate(state, goal, new_goal)

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs; see ``load_state_dict``."""
        return {"core": self._known.state_dict(), "clock": self._clock.clone(), "count": self._count.clone()}

    def load_state_dict(self, state: dict, observed: Tensor, goal: Tensor) -> None:
        """Continue from ``state_dict()``.

        Args:
            state: What it returned.
            observed: Any states, shape (num_envs, state_dim), to tell the sizes.
            goal: Any goals, shape (num_envs, goal_dim).
        """
        self._begin(observed, goal).load_state_dict(state["core"])
        self._clock.copy_(state["clock"])
        self._count.copy_(state["count"])
        self._draw()
