"""When goals are due in other people's loops, by our clock or by theirs; tensors only, one entry per world."""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.goals.core import Changes, GoalCore, on_gpu
from deimos.goals.faults import Faults
from deimos.goals.interactions import assign
from deimos.goals.selector import Spaces
from deimos.nn.random import Purpose, uniforms
from deimos.nn.stateful import Stateful


@dataclass(frozen=True)
class Outcome:
    """What ended in a step of all worlds."""

    terminated: Tensor
    """True where the world crashed, bool, shape (num_envs,)."""
    truncated: Tensor
    """True where its episode was cut off without a crash, bool, shape (num_envs,)."""
    due: Tensor
    """True where the goal's time is up, bool, shape (num_envs,)."""
    done: Tensor
    """True where an episode has ended, bool, shape (num_envs,)."""
    changed: Tensor
    """True where a goal is needed now: the world is due or begins an episode, bool, shape (num_envs,)."""
    rows: Tensor
    """The worlds of ``changed``, int64, shape (m,): those that are due, then those that begin an episode; in dense form
    all worlds."""
    changes: Changes | None
    """What the core returned for the step; ``None`` in dense form."""

    @property
    def where(self) -> Tensor | None:
        """In dense form, which of the worlds in ``rows`` are meant, bool, shape (num_envs,)."""
        return self.changed if self.changes is None else None


class GoalClocks(Stateful):
    """The goal core of worlds in another loop, and what tells it when a goal ends.

    Their owner calls ``outcome`` and ``advance`` after every step, and ``propose`` where a goal is due.

    Args:
        core: The selector and the interactions.
        spaces: The worlds.
        seed: Seed of every choice, in [0, 2^32).
        choose_first: Whether first goals are chosen, and so are interactions.
        next_step: Whether a world that is done is reset in a separate step, after the one that ended it.
    """

    saved = ("core", "_age", "_count", "asked", "_first", "_over", "_open_ended", "_given", "_goal")

    def __init__(self, core: GoalCore, spaces: Spaces, seed: int, choose_first: bool, next_step: bool) -> None:
        self.core = core
        self._seed, self._choose_first, self._next_step = seed, choose_first, next_step
        count, device = spaces.num_envs, spaces.device
        # Steps of the active goal, and goals that were chosen for the world: its draws' addresses.
        self._age, self._count, self.asked = torch.zeros(3, count, dtype=torch.int64, device=device)
        """Goals that every world was given, first ones included, int64, shape (num_envs,)."""
        # A first goal is next; done but not reset yet; the goal has no announced horizon; the goal was chosen.
        self._first, self._over, self._open_ended, self._given = torch.zeros(4, count, dtype=torch.bool, device=device)
        self._first.fill_(True)
        self._goal = torch.zeros(count, spaces.goal_dim, dtype=torch.float32, device=device)
        groups = () if spaces.groups == (slice(None),) else (len(spaces.groups),)
        self._untracked = torch.zeros(count, *groups, dtype=torch.float32, device=device)
        self.tracked = False
        """Whether tracking has ever been given."""
        self._draws: Tensor | None = None  # for the next decision of every world, until the step _drawn_until
        self._drawn_until = 0
        self.faults = Faults(core.interactions) if on_gpu(device) else None
        """Where input that does not fit is noted; ``None`` where it is refused at once."""

    @property
    def dense(self) -> bool:
        """Whether the selector is asked about all worlds, so that nobody waits to learn which are meant."""
        return self.faults is not None and self.core.selector.dense

    def outcome(self, terminated: Tensor, truncated: Tensor, own: bool, dense: bool) -> Outcome:
        """What the last step has ended; nothing is counted yet, so a caller that fails now may call again.

        Args:
            terminated: True where the world crashed, bool, shape (num_envs,).
            truncated: True where its episode was cut off without a crash, bool, shape (num_envs,).
            own: Whether goals are due after T steps. If not, they last until the next proposal, and an interaction
                lasts for its horizon at most.
            dense: Whether to return it in dense form, which reads nothing from the device.
        """
        interactions = self.core.interactions
        if own:
            due = self._age + ~self._over >= self.core.goal_period
        else:
            due = interactions.active & (interactions.now + 1 - interactions.issued_at >= interactions.horizon)
        done = terminated | truncated
        if dense:
            changed = (due & ~done) | (self._over if self._next_step else done)
            return Outcome(terminated, truncated, due, done, changed, self.core.everybody, None)
        changes = self.core.changes(terminated, truncated, due)
        begin = self._over.nonzero().squeeze(1) if self._next_step else changes.done
        rows = torch.cat([changes.due, begin])
        changed = torch.zeros_like(done).index_fill_(0, rows, True)
        return Outcome(terminated, truncated, due, done, changed, rows, changes)

    def advance(self, step: Outcome, tracking: Tensor | None, executed: Tensor | None) -> None:
        """Count a step of all worlds and resolve what it decided.

        Args:
            step: What ``outcome`` returned for it.
            tracking: How well a goal is met, in [0, 1], shape (num_envs,) for the whole of it or (num_envs, groups);
                ``None`` for 0.
            executed: Goals that were pursued, shape (num_envs, goal_dim); ``None`` for those that were given.
        """
        interactions, done = self.core.interactions, step.done
        if executed is not None:  # what a goal turned into at once: its first step shows it
            interactions.execute(interactions.active & (interactions.issued_at == interactions.now), executed)
            self._given.zero_()
        self._age += ~self._over  # where an episode was over, this step was the reset alone
        self.tracked |= tracking is not None
        tracking = self._untracked if tracking is None else tracking
        reward, columns = (tracking, None) if tracking.dim() == 1 else (torch.zeros_like(tracking[:, 0]), tracking)
        dense = step.changes is None
        self.core.advance(
            step.terminated, step.truncated, step.due, reward, columns, dense=dense, changes=step.changes
        )  # fmt: skip
        self._first.copy_(done | self._over)
        self._given &= ~done
        self._age.masked_fill_(done, 0)
        self.core.weight.masked_fill_(done, 1.0)
        if self._next_step:
            self._over.copy_(done)

    def reset(self, where: Tensor) -> None:
        """Begin an episode in some worlds, bool, shape (num_envs,): what is pending there is dropped."""
        core = self.core
        for flags in (core.interactions.active, self._given, self._over):
            flags.masked_fill_(where, False)
        self._first.masked_fill_(where, True)
        self._age.masked_fill_(where, 0)
        core.weight.masked_fill_(where, 1.0)
        core.percentile.masked_fill_(where, 50.0)

    def uniform(self, rows: Tensor) -> Tensor:
        """True where the next goal is a uniform one, whatever the state, bool, shape (m,); ``rows`` are worlds."""
        return (self._over if self._choose_first else self._first)[rows]

    def end(self, rows: Tensor) -> None:
        """End what is pending in the listed worlds, int64, shape (m,), before its time.

        Where no horizon was announced, the world has survived the goal, and the horizon is the time that it has lasted;
        elsewhere the outcome is not known, and the interaction is dropped.
        """
        interactions = self.core.interactions
        lasted = interactions.now - interactions.issued_at[rows]
        survived = self._open_ended[rows] & (lasted > 0)
        interactions.horizon[rows] = torch.where(survived, lasted, interactions.horizon[rows])
        interactions.resolve(rows, torch.zeros_like(survived), survived)

    def propose(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, horizon: Tensor | None = None,
        open_ended: bool = False, own: bool = False, where: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Give the listed worlds their next goals; nothing is pending in them.

        Args:
            rows: Worlds, int64, shape (m,), each once.
            state: Their states, shape (m, state_dim).
            goal: Their active goals, shape (m, goal_dim).
            candidates: Independent uniform goals, shape (m, N, goal_dim).
            horizon: Steps that each goal is to last, int64, shape (m,); ``None`` for T.
            open_ended: Whether that is not known, and ``horizon`` is the maximum.
            own: Whether no world gets two goals from us within T steps.
            where: In dense form, which of ``rows``, then all worlds, are meant, bool, shape (num_envs,).

        Returns:
            Goals, shape (m, goal_dim). First goals are the first candidates, unless they are chosen.
        """
        if self.dense and where is None and len(rows) == len(self._age):  # in order, as ``assign`` wants all rows
            order, every = rows.argsort(), torch.ones_like(self._first)
            state, goal, candidates = state[order], goal[order], candidates[order]
            horizon = None if horizon is None else horizon[order]
            goals = self.propose(self.core.everybody, state, goal, candidates, horizon, open_ended, own, every)
            return goals[order.argsort()]
        ours = ~self.uniform(rows)
        goals = candidates[:, 0].clone()
        before = goal.masked_fill(self._first[rows].unsqueeze(1), 0.0) if self._choose_first else goal
        if self.dense:
            issued = ours if where is None else ours & where
            seen = state.masked_fill(~ours.unsqueeze(1), 0.0)  # it may be anything there
            draws = self._drawn(rows, own)
            chosen = self.core.choose(rows, seen, before, candidates, draws, horizon, where=issued)
            goals = torch.where(ours.unsqueeze(1), chosen, goals)
            self._count[rows] += issued
        elif len(some := ours.nonzero().squeeze(1)):
            goals[some] = self.core.choose(
                rows[some], state[some], before[some], candidates[some], self._drawn(rows[some], own),
                None if horizon is None else horizon[some],
            )  # fmt: skip
            self._count[rows[some]] += 1
        assign(self._goal, rows, goals, where)
        assign(self._given, rows, ours, where)
        assign(self._open_ended, rows, open_ended, where)
        assign(self._age, rows, 0, where)
        self.asked[rows] += 1 if where is None else where
        return goals

    def _drawn(self, rows: Tensor, own: bool) -> Tensor:
        """Uniform numbers that belong to the next decision of the listed worlds, shape (m, 4).

        Drawing for all worlds costs as much as for one, and the numbers stay valid until a world can have used its own.
        """
        if not own or self._choose_first:
            self._drawn_until = 0
            return uniforms(self._seed, Purpose.GOAL, rows, self._count[rows])
        if self._draws is None or self.core.interactions.now >= self._drawn_until:
            every = torch.arange(len(self._count), dtype=torch.int64, device=rows.device)
            self._draws = uniforms(self._seed, Purpose.GOAL, every, self._count)
            self._drawn_until = self.core.interactions.now + self.core.goal_period
        return self._draws[rows]

    def refuse_other_goals(self, goal: Tensor, rows: Tensor | None = None) -> None:
        """Raise ``ValueError`` if a chosen goal has changed without a proposal, by more than rounding to 8 bits.

        Args:
            goal: Active goals, shape (m, goal_dim).
            rows: Their worlds, int64, shape (m,); ``None`` for all.
        """
        chosen, ours = (self._given, self._goal) if rows is None else (self._given[rows], self._goal[rows])
        other = chosen & ((goal - ours).abs() > 1e-2 * ours.abs() + 1e-5).any(1)
        if self.faults is not None:
            text = "goal of world {world} must be what it was given; report what a world really pursues by executed="
            self.faults.note(text, other, rows)
        elif bool(other.any()):
            row = int(other.nonzero()[0])
            raise ValueError(
                f"goal of world {row if rows is None else int(rows[row])} must be {ours[row].tolist()}, which it was "
                f"given, got {goal[row].tolist()}; report what a world really pursues by executed=, and give other "
                "environments a GoalDirector of their own."
            )

    def refuse_faults(self) -> None:
        """Raise ``ValueError`` that names the first input that did not fit, if one was noted."""
        if self.faults is not None:
            self.faults.refuse()

    def state_dict(self) -> dict:
        """See ``Stateful.state_dict``; raises ``ValueError`` after input that did not fit."""
        self.refuse_faults()
        return super().state_dict()

    def load_state_dict(self, state: dict) -> None:
        """See ``Stateful.load_state_dict``."""
        super().load_state_dict(state)
        self._drawn_until = 0
        if self.faults is not None:
            self.faults.clear()
