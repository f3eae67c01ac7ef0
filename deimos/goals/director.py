"""A goal selector in other people's loops: one object, and torch is all that it imports."""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.checks import check_at_least
from deimos.goals.fear_selector import fear_selector
from deimos.goals.interactions import Interactions
from deimos.goals.selector import GoalSelector, SelectorConfig, Spaces
from deimos.nn.seeds import generator, restore
from deimos.sim.env import Step


@dataclass(frozen=True)
class Assignment:
    """What every world pursues next."""

    goal: Tensor
    """Goals, shape (num_envs, goal_dim): the given ones but where ``changed``."""
    changed: Tensor
    """True where the goal is a new one, bool, shape (num_envs,)."""


class GoalDirector:
    """Chooses the goals of any vectorised environment, and learns from what becomes of them.

    It keeps the goal clocks and the interactions, and lets the selector learn. Call ``step`` once after
    every step of the worlds, and put the goals that it returns into force.

    Selectors that learn from the learner's transitions (``vds``, ``plr``) need Deimos' own loop.

    Args:
        selector: Who chooses: a selector's ``Config``, or the name of a method such as ``p25``.
        goal_period: T: steps that a goal is in force, at least 1.
        learn_every: Steps between two lessons of the selector, at least 1; a rollout of the learner is a good choice.
        total_steps: Steps of the whole training, for selectors that change over it; 0 where nobody knows.
        seed: Seed of the selector's networks and of every choice.
    """

    def __init__(
        self, selector: SelectorConfig | str, goal_period: int, *, learn_every: int = 24, total_steps: int = 0,
        seed: int = 0,
    ) -> None:  # fmt: skip
        check_at_least("goal_period", goal_period, 1)
        check_at_least("learn_every", learn_every, 1)
        check_at_least("total_steps", total_steps, 0)
        if isinstance(selector, str):
            from deimos.goals.methods import method

            selector = method(selector)
        self.goal_period, self.learn_every = goal_period, learn_every
        self.metrics: dict[str, float] = {}
        """What the selector's last lesson had to say."""
        self._config, self._total_steps, self._seed = selector, total_steps, seed
        self._selector: GoalSelector | None = None
        self._sizes: tuple[int, int, int] | None = None  # worlds, components of a state, of a goal

    @property
    def selector(self) -> GoalSelector:
        """Who chooses.

        Raises:
            RuntimeError: Before the first step, which tells how many worlds and components there are.
        """
        if self._selector is None:
            raise RuntimeError("The GoalDirector knows its worlds only after the first call of step().")
        return self._selector

    @property
    def goal_range(self) -> Tensor | None:
        """Share of the goal range to draw candidates from, shape (goal_dim,); ``None`` for all of it.

        Only a curriculum of the range (``cl``) has one, and only from the first step on.
        """
        return None if self._selector is None else self._selector.goal_range()

    def step(
        self, state: Tensor, goal: Tensor, terminated: Tensor, truncated: Tensor, candidates: Tensor,
        tracking: Tensor | None = None,
    ) -> Assignment:  # fmt: skip
        """Resolve what the last step decided, and choose the goals that are due.

        Worlds that are done get a uniform first goal, their first candidate.

        Args:
            state: Observations without the goal, shape (num_envs, state_dim). Where a world is done it may be
                that of before or after its reset: nothing is chosen for it.
            goal: Goals that were in force during the step, shape (num_envs, goal_dim).
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
        if self._selector is None:
            self._begin(state, goal)
        done = terminated | truncated
        self._clock += 1
        due = self._clock >= self.goal_period
        reward = torch.zeros_like(self._clock, dtype=torch.float32) if tracking is None else tracking.float()
        result = Step(state, reward, terminated, truncated, due, torch.zeros_like(done))
        self._interactions.advance(result)
        ended, chooses = due | done, due & ~done
        counts = torch.stack([ended.sum(), chooses.sum()]).tolist()  # the one synchronisation of the step
        ended_rows, rows = (
            torch.nonzero_static(mask, size=count).squeeze(1)
            for mask, count in zip((ended, chooses), counts, strict=True)
        )
        self._interactions.resolve(result, ended_rows)
        goals = torch.where(done.unsqueeze(1), candidates[:, 0], goal)
        if len(rows):
            self._propose(rows, state[rows], goal[rows], candidates[rows], goals)
        self._clock.masked_fill_(ended, 0)
        if self._interactions.now % self.learn_every == 0:
            self.metrics = self.selector.learn(self._interactions, None)
        return Assignment(goals, ended)

    def _begin(self, state: Tensor, goal: Tensor) -> None:
        spaces = Spaces(
            len(state), state.shape[1], goal.shape[1], self.goal_period, state.device, total_steps=self._total_steps
        )
        with torch.inference_mode(False):  # what is made in a loop without gradients shall also be used outside it
            selector = self._config.build(spaces, self._seed)
            if selector.needs_rollout:
                raise ValueError(
                    f"selector must need no rollout of the learner, as vds and plr do; got {self._config}."
                )
            self._selector = selector
            self._sizes = len(state), state.shape[1], goal.shape[1]
            self._interactions = Interactions(*self._sizes, self.goal_period, 2 * self.goal_period, state.device)
            self._clock = torch.zeros(len(state), dtype=torch.int64, device=state.device)
            self._generator = generator(self._seed, "goal director", state.device)

    def _propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, goals: Tensor) -> None:
        draws = torch.rand(len(rows), 4, generator=self._generator, device=rows.device)
        with torch.no_grad():
            proposal = self.selector.propose(rows, state, goal, candidates, draws)
        self._interactions.open(
            rows, state, goal, proposal.goal, proposal.score, probe=proposal.probe, note=proposal.note
        )
        goals[rows] = proposal.goal

    def _check(self, state: Tensor, goal: Tensor, terminated: Tensor, truncated: Tensor, candidates: Tensor) -> None:
        n, state_dim, goal_dim = self._sizes or (len(state), state.shape[-1], goal.shape[-1])
        sizes = {"state": (n, state_dim), "goal": (n, goal_dim), "terminated": (n,), "truncated": (n,)}
        given = {"state": state, "goal": goal, "terminated": terminated, "truncated": truncated}
        for name, shape in sizes.items():
            if given[name].shape != shape:
                raise ValueError(f"{name} must have the shape {shape}, got {tuple(given[name].shape)}.")
        for name in ("terminated", "truncated"):
            if given[name].dtype != torch.bool:
                raise ValueError(f"{name} must be bool, got {given[name].dtype}.")
        if candidates.dim() != 3 or candidates.shape[::2] != goal.shape or candidates.shape[1] < 1:
            expected = f"({n}, N, {goal_dim}) with N at least 1"
            raise ValueError(f"candidates must have the shape {expected}, got {tuple(candidates.shape)}.")

    def fear(self, state: Tensor, goal: Tensor, new_goal: Tensor) -> Tensor:
        """Calibrated probability that the policy crashes within T steps of getting ``new_goal``, shape (B,).

        Args:
            state: States, shape (B, state_dim).
            goal: Goals in force, shape (B, goal_dim).
            new_goal: Goals to judge, shape (B, goal_dim).

        Raises:
            ValueError: If the selector has no fear network.
            RuntimeError: If it has not learnt anything yet.
        """
        afraid = fear_selector(self.selector)
        if afraid is None:
            raise ValueError(f"The selector must have a fear network, as a Director has; got {self._config}.")
        if not afraid.fear.fitted:
            raise RuntimeError("The fear network has learnt nothing yet: it must see crashes and survivals first.")
        return afraid.calibration.probability(afraid.score(state, goal, new_goal.unsqueeze(1)).squeeze(1))

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs; see ``load_state_dict``."""
        return {
            "selector": self.selector.state_dict(),
            "interactions": self._interactions.state_dict(),
            "clock": self._clock.clone(),
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict, observed: Tensor, goal: Tensor) -> None:
        """Go on from ``state_dict()``.

        Args:
            state: What it returned.
            observed: Any states, shape (num_envs, state_dim), to tell the sizes.
            goal: Any goals, shape (num_envs, goal_dim).
        """
        self._begin(observed, goal)
        self.selector.load_state_dict(state["selector"])
        self._interactions.load_state_dict(state["interactions"])
        self._clock.copy_(state["clock"])
        restore(self._generator, state["generator"])
