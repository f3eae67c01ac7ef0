"""A goal selector in other people's loops: one object, which needs only torch and NumPy."""

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from deimos.checks import check_at_least
from deimos.goals import given, transitions
from deimos.goals.clocks import GoalClocks
from deimos.goals.core import GoalCore, window_between
from deimos.goals.director_checks import check_candidates, check_options, placed, settings, unpacked
from deimos.goals.faults import refuse_not_finite, refuse_unsound
from deimos.goals.fear_selector import FearEstimate, fear_selector
from deimos.goals.given import A, Array, Assignment, Bound, Candidates, GoalBox, Inputs, Rows
from deimos.goals.horizons import Horizons
from deimos.goals.interactions import Interactions, taken
from deimos.goals.methods import method
from deimos.goals.risk_map import RiskMap, grid
from deimos.goals.selector import GoalSelector, SelectorConfig, Spaces, Transitions
from deimos.nn.host import own_settings

_log = logging.getLogger(__name__)


class GoalDirector:
    """Chooses the goals of any vectorised environment, and learns from their outcomes.

    There are two ways to drive it, and both give the same interactions where their periods are the same:

    * *Its own clock*: ``step`` once after every step of the worlds; the goals that it returns become the active ones.
    * *Your clock*: ``observe`` once after every step, then ``propose`` for the worlds that get a new goal. A goal's
      interaction lasts up to the next proposal, or as long as was announced.

    All arguments may be NumPy arrays or torch tensors; results are of the kind and the dtype of ``goal``. It computes
    in float32, and keeps copies without gradients.

    On a GPU, calls with tensors there do not wait for it, except for updates and ``state_dict`` and where worlds must
    be counted: for a function of ``candidates`` in ``step``, for selectors that are not ``dense``. So numbers that do
    not fit are refused only there, before anything is learnt from them or saved; shapes are refused at once.

    Args:
        selector: A selector's ``Config``, or the name of a method such as ``p25``.
        goal_period: T: steps that a goal is active, at least 1; ``None`` on your own clock if periods vary.
        num_envs: Worlds, at least 1. This and the two sizes may be left to the first call.
        state_dim: Components of a state, at least 1.
        goal_dim: Components of a goal, at least 1.
        device: Device of its tensors and of yours; ``None`` for that of the first call, the CPU for arrays.
        max_horizon: The most steps that a goal lasts, where ``goal_period`` is ``None``.
        horizon_input: Whether the fear network sees how long a goal is to last: a component ``horizon / max_horizon``
            after the state, in ``interactions`` too.
        first_goals: ``uniform``, or ``chosen`` from the start state and a null goal of zeros; only chosen ones are
            interactions. ``state`` must then be the one after the reset.
        goal_box: Lowest and highest goal, shape (goal_dim,) each. Candidates must then be inside it, and need not be
            given: they are drawn uniformly.
        groups: Components of a goal that are met or missed together, as slices, for ``tracking`` by group.
        autoreset: gymnasium's ``AutoresetMode`` or its value: ``SameStep``, also for loops that reset before the next
            step by hand (``Disabled``), or ``NextStep``, where a separate step resets a world after its end.
        learn_every: Steps between two updates of the selector, at least 1; a rollout of the learner is a good choice.
            Selectors that learn from transitions (``vds``, ``plr``) are updated by ``learn`` alone: give its period.
            Outcomes are kept for 2 T steps or, if more, ``learn_every + T``: ``4 (state_dim + 2 goal_dim + 12)`` bytes
            per world for every T; where goals may be shorter, the newest, up to 32 MiB in all or 8 per world.
        total_steps: Steps of the whole training, for selectors that change over it; 0 if unknown.
        seed: Of the selector's networks and of every choice, in [0, 2^32); Directors with the same seed choose alike.

    Raises:
        ValueError: If an option is not valid, here or at the first call where sizes are left to it.
    """

    def __init__(
        self, selector: SelectorConfig | str, goal_period: int | None = None, *, num_envs: int | None = None,
        state_dim: int | None = None, goal_dim: int | None = None, device: torch.device | str | None = None,
        max_horizon: int | None = None, horizon_input: bool = False,
        first_goals: Literal["uniform", "chosen"] = "uniform", goal_box: tuple[Bound, Bound] | None = None,
        groups: Sequence[slice] = (slice(None),), autoreset: object = "SameStep", learn_every: int = 24,
        total_steps: int = 0, seed: int = 0,
    ) -> None:  # fmt: skip
        periods = {"goal_period": goal_period, "max_horizon": max_horizon}
        sizes = {"num_envs": num_envs, "state_dim": state_dim, "goal_dim": goal_dim}
        mode = str(getattr(autoreset, "value", autoreset))
        check_options(periods | sizes, mode, first_goals, learn_every, total_steps, seed)
        periods, sizes = ({name: n if n is None else int(n) for name, n in of.items()} for of in (periods, sizes))
        self.goal_period, self.learn_every, seed = periods["goal_period"], int(learn_every), int(seed)
        self.max_horizon: int = self.goal_period or periods["max_horizon"]  # type: ignore[assignment]  # one is given
        self.metrics: dict[str, float] = {}
        """Numbers for the log, from the selector's last update."""
        self._config = method(selector) if isinstance(selector, str) else selector
        self._choose_first, self._next_step = first_goals == "chosen", mode == "NextStep"
        self._horizons, self._goal_box = Horizons(self.goal_period, self.max_horizon, horizon_input), goal_box
        self._groups, self._total_steps, self._seed = tuple(groups), total_steps, seed
        self._made_with = settings(
            self._config, goal_box, **periods, horizon_input=horizon_input, first_goals=first_goals, seed=seed,
            next_step=self._next_step, groups=[str(part) for part in self._groups],
        )  # fmt: skip
        self._told = [*sizes.values()], None if device is None else placed(device)
        self._start_anew()

    def _start_anew(self) -> None:
        """Return to what the constructor was told, with nothing learnt."""
        self._sizes, self._device = self._told
        self._clocks: GoalClocks | None = None
        self._box: GoalBox | None = None
        self._learnt_at = 0  # step of the last update
        if self._device is not None and None not in self._sizes:
            self._begin(self._expected(np.zeros(0), None, None, None))

    @property
    def selector(self) -> GoalSelector:
        """The selector.

        Raises:
            RuntimeError: Before the first call, where sizes and device are left to it.
        """
        return self._known.core.selector

    @property
    def interactions(self) -> Interactions:
        """The outcomes of its goals; see ``selector`` for when they are known."""
        return self._known.core.interactions

    @property
    def weight(self) -> Tensor:
        """Weight of the transitions under the active goals, shape (num_envs,); see ``Assignment``."""
        return self._known.core.weight

    @property
    def _known(self) -> GoalClocks:
        if self._clocks is None:
            raise RuntimeError(
                "The GoalDirector knows its worlds only after the first call of step() or propose(), unless num_envs, "
                "state_dim, goal_dim and device are given."
            )
        return self._clocks

    @property
    def goal_range(self) -> Tensor | None:
        """Share of the goal range to draw candidates from, shape (goal_dim,), around its middle; ``None`` for all.

        Only a curriculum of the range (``cl``) has one, and only from the first call on.
        """
        return None if self._clocks is None else self._clocks.core.selector.goal_range()

    @own_settings()
    @torch.no_grad()
    def step(
        self, state: Array, goal: A, terminated: Array, truncated: Array, candidates: Candidates = None,
        tracking: Array | None = None, executed: Array | None = None,
    ) -> Assignment[A]:  # fmt: skip
        """Resolve what the last step decided, and choose the goals that are due after T steps.

        Worlds that are done get a first goal; under ``NextStep`` after the step that reset them.

        Args:
            state: Observations without the goal, shape (num_envs, state_dim). Where a world is done, it may be the one
                from before or after its reset, unless first goals are chosen.
            goal: Goals that were active during the step, shape (num_envs, goal_dim): those that were given last.
            terminated: True where the world crashed, shape (num_envs,): bool, or 0 and 1.
            truncated: True where its episode was cut off without a crash, shape (num_envs,): bool, or 0 and 1.
            candidates: Independent uniform valid goals, from within ``goal_range``: shape (num_envs, N, goal_dim), N at
                least 1, or a function that returns (m, N, goal_dim) for the m worlds that need one, whose indices it is
                given; ``None`` to draw them from ``goal_box``. If it raises, nothing has happened yet: call again.
            tracking: How well the goal is met, in [0, 1], for curricula: shape (num_envs,), or (num_envs, groups);
                ``None`` for 0.
            executed: What the worlds really pursued where that was not ``goal`` (headings, standing, limits), shape
                (num_envs, goal_dim): fear is learnt for what a goal became in its first step. ``None`` for ``goal``.

        Raises:
            ValueError: If a shape, a device or a number does not fit, or a goal is not the one that was given. Nothing
                is counted then; for numbers on a GPU see the class.
            SimulationError: If a weight of a network is not finite after an update.
        """
        if self.goal_period is None:
            raise ValueError(
                "goal_period must be given for step(), got None; on your clock use observe() and propose()."
            )
        num_envs, state_dim = given.matrix("state", state, "state_dim")
        inputs = self._expected(state, num_envs, state_dim, given.matrix("goal", goal, "goal_dim")[1])
        states, goals = inputs.states(state, inputs.num_envs), inputs.goals(goal, inputs.num_envs)
        crashed, cut_off, met, pursued = inputs.ends(terminated, truncated, tracking, executed)
        check_candidates(candidates, inputs.num_envs, inputs, self._goal_box is not None)
        clocks = self._clocks or self._begin(inputs)
        unseen = None if self._choose_first and not self._next_step else crashed | cut_off
        refuse_unsound("state", states, but=unseen, faults=inputs.faults)
        refuse_unsound("goal", goals, faults=inputs.faults)
        if executed is None:
            clocks.refuse_other_goals(goals)
        step = clocks.outcome(crashed, cut_off, own=True, dense=clocks.dense and not callable(candidates))
        rows, where, new = step.rows, step.where, goals[:0]
        offered = self._candidates(given.taken(candidates, rows, where), rows, goal, where) if len(rows) else None
        clocks.advance(step, met, pursued)
        if offered is not None:
            seen, before = (taken(values, rows, where) for values in (self._horizons.behind(states), goals))
            new = clocks.propose(rows, seen, before, offered, own=True, where=where)
        self._learn_if_due()
        weight = given.like(clocks.core.weight.clone(), goal)
        return Assignment(given.replaced(goal, rows, new, where), given.like(step.changed, goal), weight)

    @own_settings()
    @torch.no_grad()
    def observe(
        self, terminated: Array, truncated: Array, tracking: Array | None = None, executed: Array | None = None
    ) -> None:
        """Resolve what the last step decided, on your clock; call it once after every step, before ``propose``.

        For the arguments and errors see ``step``. A world that lives through the horizon of its goal has survived it.
        """
        shape = np.shape(terminated)
        inputs = self._expected(terminated, shape[0] if len(shape) == 1 else None, None, None)
        crashed, cut_off, met, pursued = inputs.ends(terminated, truncated, tracking, executed)
        clocks = self._clocks or self._begin(inputs)
        self._learn_if_due()  # all proposals of the step before have been made by now
        clocks.advance(clocks.outcome(crashed, cut_off, own=False, dense=clocks.faults is not None), met, pursued)

    @own_settings()
    @torch.no_grad()
    def reset(self, rows: Rows = None) -> None:
        """Begin episodes in worlds that were reset by hand; then ``propose`` first goals for them.

        What is pending there is dropped; what was learnt stays, and no step is counted. Also call it for all worlds
        after ``load_state_dict``, unless they continue where they were. Before the first call it changes nothing.

        Args:
            rows: Worlds: indices, each once, a mask, a slice, or ``None`` for all.

        Raises:
            ValueError: If a world does not exist or is listed twice.
        """
        if self._clocks is not None:
            self._clocks.reset(given.marked(rows, len(self.weight), self.weight.device, self._clocks.faults))

    @own_settings()
    @torch.no_grad()
    def propose(
        self, rows: Rows, state: Array, goal: A, candidates: Candidates = None, horizon: Array | int | None = None
    ) -> A:
        """Give the listed worlds their next goals, on your clock or, for the first goals, on its own.

        What was pending there ends: survived where the horizon was not announced, dropped where it was longer. Worlds
        that have begun an episode, or never lived through a step, get a first goal.

        Args:
            rows: Worlds: indices, each once, a mask, a slice, or ``None`` for all.
            state: Their states, shape (m, state_dim); ignored where a first goal is not chosen.
            goal: Their active goals, shape (m, goal_dim).
            candidates: As in ``step``, for these worlds: shape (m, N, goal_dim), a function or ``None``.
            horizon: Steps that each goal is to last, at least 1 and at most ``max_horizon``, one number or shape (m,);
                ``None`` for ``goal_period`` or, without one, up to the next proposal.

        Returns:
            Goals, shape (m, goal_dim).

        Raises:
            ValueError: See ``step``; also if a world does not exist or is listed twice, or the horizon is missing where
                it is an input.
        """
        count, state_dim = given.matrix("state", state, "state_dim")
        num_envs = count if rows is None else None
        inputs = self._expected(state, num_envs, state_dim, given.matrix("goal", goal, "goal_dim")[1])
        listed = given.worlds(rows, inputs.num_envs, inputs.device, count, inputs.faults)
        states, goals = inputs.states(state, len(listed)), inputs.goals(goal, len(listed))
        lasts = self._horizons.steps(horizon, listed, inputs)
        check_candidates(candidates, len(listed), inputs, self._goal_box is not None)
        clocks = self._clocks or self._begin(inputs)
        if not len(listed):
            return given.like(goals, goal)
        refuse_unsound("state", states, listed, clocks.uniform(listed), inputs.faults)
        refuse_unsound("goal", goals, listed, faults=inputs.faults)
        clocks.refuse_other_goals(goals, listed)
        offered = self._candidates(candidates, listed, goal)
        clocks.end(listed)
        open_ended = horizon is None and self.goal_period is None
        seen = self._horizons.behind(states, lasts)
        new = clocks.propose(listed, seen, goals, offered, lasts, open_ended=open_ended)
        return given.like(new, goal)

    @own_settings()
    @torch.no_grad()
    def learn(self, rollout: Transitions | None = None) -> dict[str, float]:
        """Update the selector now, in addition to every ``learn_every`` steps.

        Args:
            rollout: The learner's transitions since the last call, for selectors that learn from them (``vds``,
                ``plr``): arrays or tensors, flags as bool or 0 and 1, observations with the goal after the state.

        Returns:
            ``metrics``.

        Raises:
            ValueError: If the selector needs a rollout and gets none, or one that lacks steps since the last call or
                does not fit. Nothing is changed then.
            SimulationError: If a weight of a network is no longer finite.
        """
        core = self._known.core
        self._known.refuse_faults()
        told = transitions.checked(rollout, core, self._learnt_at)
        self.metrics, self._learnt_at = core.learn(told), core.interactions.now
        core.selector.check()
        return self.metrics

    @own_settings()
    @torch.no_grad()
    def fear(self, state: Array, goal: Array, new_goal: Array, horizon: Array | int | None = None) -> FearEstimate:
        """Calibrated probability that the policy crashes before the next goal after ``new_goal``, and its quality.

        Args:
            state: States, shape (B, state_dim).
            goal: Active goals, shape (B, goal_dim).
            new_goal: Goals to evaluate, shape (B, goal_dim).
            horizon: Steps that they are to last, where that is an input; ``None`` for ``max_horizon``.

        Returns:
            Tensors, whatever the arguments are.

        Raises:
            ValueError: If the selector has no fear network, or a shape does not fit.
            RuntimeError: If it has not learnt anything yet.
        """
        afraid = fear_selector(self.selector)
        if afraid is None:
            raise ValueError(f"The selector must have a fear network, as a Director has; got {self._config}.")
        count, _ = given.matrix("state", state, "state_dim")
        inputs = replace(self._expected(state, None, None, None), faults=None)
        states, goals = inputs.states(state, count), inputs.goals(goal, count)
        new_goals = inputs.goals(new_goal, count, "new_goal")
        for name, numbers in (("state", states), ("goal", goals), ("new_goal", new_goals)):
            refuse_not_finite(name, numbers, what="row")
        rows = torch.arange(count, device=inputs.device)
        lasts = self._horizons.steps(self.max_horizon if horizon is None else horizon, rows, inputs)
        return afraid.estimate(self._horizons.behind(states, lasts), goals, new_goals)

    def risk_map(
        self, state: Array, goal: Array, axes: Mapping[int, Array] | tuple[int, int], horizon: int | None = None
    ) -> RiskMap:
        """Fear over a grid of two components of the new goal.

        Args:
            state: One state, shape (state_dim,).
            goal: The goal that is active in it, shape (goal_dim,): its other components are those of all new goals.
            axes: The two components and their values, as ``{0: np.linspace(-1, 1, 41), 2: np.linspace(-2, 2, 41)}``;
                the components alone for 41 values over the whole ``goal_box``.
            horizon: See ``fear``.

        Raises:
            ValueError: If there are not two different components, or as in ``fear``.
            RuntimeError: If it has not learnt anything yet.
        """
        device, known = self.weight.device, self._expected(state, None, None, None)
        states = given.floats("state", state, (known.state_dim,), device)
        goals = given.floats("goal", goal, (known.goal_dim,), device)
        x, y, new = grid(goals, axes, self._box)
        states, goals = (values.expand(len(new), *values.shape) for values in (states, goals))
        told = self.fear(states, goals, torch.from_numpy(new).to(device), horizon)
        return RiskMap(x, y, told.probability.view(len(y), len(x)).cpu().numpy(), told.auroc, told.age)

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs, at any time; ``torch.load(weights_only=True)`` reads it."""
        known = self._clocks
        return {
            "made_with": self._made_with, "learnt_at": self._learnt_at,
            "sizes": None if known is None else [*self._sizes], "goals": None if known is None else known.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: dict) -> None:
        """Continue from ``state_dict()``, before the first call or later; see ``reset`` for worlds that do not.

        Args:
            state: What it returned, for a GoalDirector that was made with the same options; ``learn_every``,
                ``total_steps`` and the device may differ.

        Raises:
            ValueError: If it belongs to a Director with other options, or to another number or size of worlds. Nothing
                is changed then.
        """
        sizes, goals, learnt_at = unpacked(state, self._made_with)
        if sizes is None:  # it had not begun
            self._start_anew()
            return
        if not all(ours in (None, theirs) for ours, theirs in zip(self._sizes, sizes, strict=True)):
            raise ValueError(f"state must be that of {[*self._sizes]} worlds and components, got {sizes}.")
        try:
            inputs = self._expected(goals["goal"], *sizes)
            copy.copy(self)._begin(inputs).load_state_dict(goals)  # tried on a copy first
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"state must be what state_dict() of this version returned, got {error!r}.") from error
        (self._clocks or self._begin(inputs)).load_state_dict(goals)
        self._learnt_at = learnt_at

    def _expected(self, sample: Array, num_envs: int | None, state_dim: int | None, goal_dim: int | None) -> Inputs:
        """What arguments must be like: as already known, or else as the call shows; ``sample`` is one of them."""
        told = zip(self._sizes, (num_envs, state_dim, goal_dim), strict=True)
        worlds, states, goals = (theirs if ours is None else ours for ours, theirs in told)
        if worlds is None or states is None or goals is None:
            raise ValueError(
                "num_envs, state_dim and goal_dim must be given to GoalDirector if its first call does not show "
                f"them all, got {worlds}, {states} and {goals}."
            )
        for name, value in (("num_envs", worlds), ("state_dim", states), ("goal_dim", goals)):
            check_at_least(name, value, 1)
        device = self._device or (sample.device if isinstance(sample, Tensor) else torch.device("cpu"))
        columns = () if self._groups == (slice(None),) else (len(self._groups),)
        return Inputs(worlds, states, goals, device, columns, None if self._clocks is None else self._clocks.faults)

    @own_settings()
    @torch.inference_mode(False)  # what is made in a loop without gradients must also work outside it
    def _begin(self, inputs: Inputs) -> GoalClocks:
        box = self._box = None if self._goal_box is None else GoalBox(*self._goal_box, inputs.goal_dim, inputs.device)
        spaces = Spaces(
            inputs.num_envs, inputs.state_dim + self._horizons.seen, inputs.goal_dim, self.max_horizon, inputs.device,
            groups=self._groups, total_steps=self._total_steps, goal_middle=None if box is None else box.middle,
        )  # fmt: skip
        window = window_between(self.max_horizon, self.learn_every)
        any_number = self._choose_first or self.goal_period is None
        core = GoalCore(self._config.build(spaces, self._seed), spaces, window, any_number)
        self._clocks = GoalClocks(core, spaces, self._seed, self._choose_first, self._next_step)
        self._device, self._sizes = inputs.device, [inputs.num_envs, inputs.state_dim, inputs.goal_dim]
        return self._clocks

    def _candidates(self, candidates: Candidates, rows: Tensor, model: A, where: Tensor | None = None) -> Tensor:
        """Candidates of the listed worlds, shape (m, N, goal_dim): given, made by a function, or drawn."""
        clocks, share = self._known, self.goal_range
        if candidates is None:
            box: GoalBox = self._box  # type: ignore[assignment]  # or ``check_candidates`` has refused
            return box.draw(self._seed, rows, clocks.asked[rows], clocks.core.selector.num_candidates, share)
        if callable(candidates):
            candidates = candidates(given.like(rows, model))
        offered = self._expected(rows, None, None, None).candidates(candidates, len(rows))
        but = None if where is None else ~where
        refuse_unsound("candidates", offered, rows, but, clocks.faults)
        if self._box is not None:
            self._box.check(offered, rows, share, but, clocks.faults)
        return offered

    def _learn_if_due(self) -> None:
        """Update every ``learn_every`` steps, once each."""
        core, tracked = self._known.core, self._known.tracked
        now = core.interactions.now
        if now % self.learn_every or now == self._learnt_at:
            return
        for lack in given.lacking(core.selector, self._learnt_at > 0, tracked) if now == self.learn_every else ():
            _log.warning(lack)
        if core.selector.needs_rollout:
            self._known.refuse_faults()
        else:
            self.learn()
