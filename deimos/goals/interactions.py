"""Pending and resolved interactions: a goal is issued, and the policy crashes on it or survives it.

An interaction is (state, active goal, next goal) at the moment of the choice. It resolves as *crashed*
when the world crashes within T steps (its horizon), on the step of the next goal change included, and as *survived*
when the next goal is due and the world lives. Where the episode ends otherwise before that, it is
dropped. First goals are not interactions unless the caller opens them.
"""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.nn.ranks import gather_rows
from deimos.nn.stateful import Stateful


@dataclass(frozen=True)
class Resolved:
    """Resolved interactions, one per row."""

    env: Tensor
    """World, int64, shape (n,)."""
    state: Tensor
    """State at the moment of the choice, shape (n, state_dim)."""
    goal: Tensor
    """Goal that was active until then, shape (n, goal_dim)."""
    next_goal: Tensor
    """Goal that was executed: as it was issued, unless ``execute`` named another, shape (n, goal_dim)."""
    score: Tensor
    """The selector's score of it then, NaN where it had none, shape (n,)."""
    reward: Tensor
    """Sum of the rewards until it resolved, without that of a crash, shape (n,)."""
    tracking: Tensor
    """How well each group of its components was met, mean over its horizon, 0 from a crash on, shape (n, groups)."""
    probe: Tensor
    """True where the goal was drawn uniformly, whatever its score, bool, shape (n,)."""
    note: Tensor
    """What the selector noted on it, int64, shape (n,)."""
    crashed: Tensor
    """True where the policy crashed on it, bool, shape (n,)."""
    issued: Tensor
    """Step that it was issued after, int64, shape (n,)."""
    resolved: Tensor
    """Step that it was resolved on, int64, shape (n,)."""
    horizon: Tensor
    """Steps that it was to last, int64, shape (n,)."""

    def __len__(self) -> int:
        return len(self.crashed)

    def where(self, mask: Tensor) -> "Resolved":
        """Only the rows of ``mask``."""
        return Resolved(**{name: getattr(self, name)[mask] for name in self.__dataclass_fields__})


def bytes_of(state_dim: int, goal_dim: int, groups: int = 0) -> int:
    """Memory of one resolved interaction [bytes]; for the arguments see ``Interactions``."""
    return 4 * (state_dim + 2 * goal_dim + 4 + groups) + 8 * 4


def assign(tensor: Tensor, rows: Tensor, value: Tensor | float, where: Tensor | None = None) -> None:
    """Write a value into rows without waiting for the device.

    ``tensor[rows] = number`` would copy the number from the host, and ``tensor[mask] = rows`` would count what is in
    the mask: a GPU waits for both.

    Args:
        tensor: Written, shape (n, ...).
        rows: Which rows, int64, shape (m,), each once.
        value: A number for all, or a tensor with a row for each, of the dtype of ``tensor``.
        where: Which of ``rows`` are meant, bool, shape (m,); ``None`` for all. If ``rows`` are all rows of ``tensor``,
            they must be in order.
    """
    if where is None:
        if isinstance(value, Tensor):
            tensor[rows] = value
        else:
            tensor.index_fill_(0, rows, value)
        return
    where = where.view(-1, *[1] * (tensor.dim() - 1))
    if len(where) < len(tensor):
        kept = tensor[rows]
        tensor[rows] = torch.where(where, value, kept) if isinstance(value, Tensor) else kept.masked_fill(where, value)
    elif isinstance(value, Tensor):
        torch.where(where, value, tensor, out=tensor)
    else:
        tensor.masked_fill_(where, value)


def taken(tensor: Tensor, rows: Tensor, where: Tensor | None) -> Tensor:
    """The rows of a tensor that ``assign`` would write: a copy, or the tensor itself where ``rows`` are all rows."""
    return tensor[rows] if where is None or len(where) < len(tensor) else tensor


class Interactions(Stateful):
    """One pending interaction per world, and the resolved ones of the last steps.

    Each world has its own small ring buffer for what it resolved, so that nothing waits for a count and
    the memory is bounded. What is stored is a copy and carries no gradient.

    Args:
        num_envs: Number of worlds.
        state_dim: Components of a state.
        goal_dim: Components of a goal.
        capacity: Resolved interactions that are kept per world, at least 1; the oldest makes way for a new one.
        window: Steps that a resolved interaction is kept for.
        device: Where they are kept.
        groups: Columns of ``tracking`` in ``advance``; 0 where it is ``None`` and the reward stands for it.
    """

    saved = ("now", "active", "_pending", "issued_at", "_horizon", "_ring", "_marks", "_cursor")
    unknown = ("_pending", "_ring")  # scores
    by_world = ("active", "_pending", "issued_at", "_horizon", "_ring", "_marks", "_cursor")

    def __init__(
        self, num_envs: int, state_dim: int, goal_dim: int, capacity: int, window: int, device: torch.device,
        groups: int = 0,
    ) -> None:  # fmt: skip
        self.window = window
        self._now, self._clock = 0, torch.zeros((), dtype=torch.int64, device=device)
        self._scored = True
        self.active = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """True where an interaction is pending, shape (num_envs,)."""
        self._capacity = capacity
        # State, goal, next goal, score, probe, note, reward, tracking.
        self._sizes = [state_dim, goal_dim, goal_dim, 1, 1, 1, 1, groups]
        self._next_goal = slice(state_dim + goal_dim, state_dim + 2 * goal_dim)
        width = sum(self._sizes)
        # One row per interaction, not one tensor per field: the cost of a few decisions per step is that of the calls.
        self._pending = torch.zeros(num_envs, width, dtype=torch.float32, device=device)
        self._gained = self._pending[:, -1 - groups :]  # reward and tracking: what grows with every step
        self._zeros = torch.zeros(num_envs, 1 + groups, dtype=torch.float32, device=device)
        self.issued_at, self._horizon, self._cursor = torch.zeros(3, num_envs, dtype=torch.int64, device=device)
        """Step that the pending interaction was issued after, int64, shape (num_envs,)."""
        self._ring = torch.zeros(num_envs, capacity, width, dtype=torch.float32, device=device)
        self._marks = torch.zeros(num_envs, capacity, 4, dtype=torch.int64, device=device)
        """Crashed, issued, resolved, horizon; steps count from 1, so a resolved step of 0 marks a free slot."""

    def load_state_dict(self, state: dict) -> None:
        """See ``Stateful.load_state_dict``; if a state holds more or fewer per world, the newest are kept."""
        resized = {name: _resized(state[name], state["cursor"], self._capacity) for name in ("ring", "marks")}
        super().load_state_dict(state | resized)

    @property
    def now(self) -> int:
        """Steps so far. The device counts them too, for CUDA graphs that replay them."""
        return self._now

    @now.setter
    def now(self, steps: int) -> None:
        self._now = steps
        self._clock.fill_(steps)

    @torch.no_grad()
    def advance(self, reward: Tensor, terminated: Tensor, tracking: Tensor | None = None) -> None:
        """Count a step and its rewards. Call it once per step, before ``resolve``.

        Args:
            reward: Rewards, shape (num_envs,).
            terminated: True where the world crashed, bool, shape (num_envs,).
            tracking: How well each group of goal components was met, in [0, 1], shape (num_envs, groups).
        """
        self._now += 1
        self._clock += 1
        gain = reward.unsqueeze(1)
        gain = gain if tracking is None else torch.cat([gain, tracking], dim=1)
        self._gained.add_(gain.masked_fill(terminated.unsqueeze(1), 0.0))

    @torch.no_grad()
    def resolve(self, rows: Tensor, crashed: Tensor, survived: Tensor, where: Tensor | None = None) -> None:
        """Close the interactions that this step has decided, and drop those that it has cut off.

        Args:
            rows: The worlds whose interaction ends in any way, int64, shape (m,), each once.
            crashed: True where it ends in a crash, bool, shape (m,).
            survived: True where its time is up, bool, shape (m,); a crash takes precedence. Where neither is true, the
                episode was cut off, and the interaction is dropped.
            where: Which of ``rows`` are meant; see ``assign``. The others neither crashed nor survived.
        """
        active, cursor, issued_at, horizon, pending = (
            taken(tensor, rows, where)
            for tensor in (self.active, self._cursor, self.issued_at, self._horizon, self._pending)
        )
        decided = active & (crashed | survived)
        slot = cursor % self._capacity
        marks = torch.stack([crashed, issued_at, self._clock.expand_as(slot), horizon], dim=1)
        keep = decided.unsqueeze(1)
        self._ring[rows, slot] = torch.where(keep, pending, self._ring[rows, slot])
        self._marks[rows, slot] = torch.where(keep, marks, self._marks[rows, slot])
        assign(self._cursor, rows, cursor + decided, where)
        assign(self.active, rows, False, where)

    @torch.no_grad()
    def open(
        self, rows: Tensor, state: Tensor, goal: Tensor, next_goal: Tensor, score: Tensor, horizon: int | Tensor,
        probe: Tensor | None = None, note: Tensor | None = None, where: Tensor | None = None,
    ) -> None:  # fmt: skip
        """Start an interaction in each listed world.

        The arguments are fields of ``Resolved``, with one row for each of ``rows``, int64, shape (m,), each once. Goals
        are those that are issued; ``horizon`` may be one number, at least 1; ``probe`` is ``None`` for nowhere, and
        ``note`` for 0, its numbers being below 2^24. For ``where`` see ``assign``.
        """
        gained = self._zeros[: len(rows)]
        columns = [gained[:, :1] if values is None else values.unsqueeze(1) for values in (score, probe, note)]
        pending = torch.cat([state, goal, next_goal, *columns, gained], dim=1).float()
        assign(self._pending, rows, pending, where)
        assign(self.issued_at, rows, self._clock.expand(len(rows)), where)
        assign(self._horizon, rows, horizon, where)
        assign(self.active, rows, True, where)

    @torch.no_grad()
    def execute(self, where: Tensor, goal: Tensor) -> None:
        """Report what worlds pursue where that is not what was issued: it is what is learnt from.

        Args:
            where: Which worlds, bool, shape (num_envs,).
            goal: Goals of all worlds, shape (num_envs, goal_dim).
        """
        issued = self._pending[:, self._next_goal]
        torch.where(where.unsqueeze(1), goal.float(), issued, out=issued)

    def resolved(self, since: int = 0) -> Resolved:
        """The interactions resolved within the window, and after step ``since``, ordered by world."""
        env, slot = torch.nonzero(self._marks[:, :, 2] > max(since, self.now - self.window, 0), as_tuple=True)
        state, goal, next_goal, score, probe, note, reward, tracking = self._ring[env, slot].split(self._sizes, dim=1)
        crashed, issued, resolved, horizon = self._marks[env, slot].unbind(1)
        met = tracking if self._sizes[-1] else reward
        score = score if self._scored else torch.full_like(score, torch.nan)
        return Resolved(
            env=env, state=state, goal=goal, next_goal=next_goal, score=score.squeeze(1), reward=reward.squeeze(1),
            tracking=met / horizon.unsqueeze(1), probe=probe.squeeze(1) > 0, note=note.squeeze(1).long(),
            crashed=crashed.bool(), issued=issued, resolved=resolved, horizon=horizon,
        )  # fmt: skip

    def issued(self, since: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What was issued after step ``since`` and is still known, pending or resolved.

        Returns:
            World, int64, shape (n,); state (n, state_dim), goal that was active until then and goal that is
            executed, (n, goal_dim) each.
        """
        pending = torch.nonzero(self.active & (self.issued_at > since)).squeeze(1)
        issued, resolved = self._marks[:, :, 1], self._marks[:, :, 2]
        env, slot = torch.nonzero((resolved > 0) & (issued > since), as_tuple=True)
        known = torch.cat([self._pending[pending], self._ring[env, slot]])
        state, goal, next_goal, *_ = known.split(self._sizes, dim=1)
        return torch.cat([pending, env]), state, goal, next_goal

    def kept_since(self) -> int:
        """Step after which no goal was issued whose outcome has made way for a newer one; 0 if none has."""
        slot = self._cursor % self._capacity  # of the oldest, where the ring is full
        oldest = self._marks[torch.arange(len(slot), device=slot.device), slot, 1]
        return int(oldest.masked_fill(self._cursor <= self._capacity, 0).max())

    @property
    def horizon(self) -> Tensor:
        """Steps that the pending interaction is to last, int64, shape (num_envs,)."""
        return self._horizon

    @property
    def latest_state(self) -> Tensor:
        """State at the latest decision of every world, on the step ``issued_at``, shape (num_envs, state_dim)."""
        return self._pending[:, : self._sizes[0]]

    def followed(self, done: Resolved) -> Tensor:
        """True where an interaction was survived and led to the latest decision of its world, bool, shape (n,)."""
        return ~done.crashed & (self.issued_at[done.env] == done.resolved)

    def of_all_ranks(self) -> "Interactions":
        """The interactions in the worlds of all ranks, by their global numbers: what to learn from.

        What has one row per world is gathered when it is first read, so all ranks must read the same in the same order,
        and what a selector does not read is not sent.
        """
        return _OfAllRanks(self)

    def without_scores(self) -> "Interactions":
        """The same interactions for a selector that did not choose these goals: it sees no scores."""
        view = copy.copy(self)
        view._scored = False
        return view


class _OfAllRanks(Interactions):
    """See ``Interactions.of_all_ranks``."""

    def __init__(self, own: Interactions) -> None:
        vars(self).update({name: value for name, value in vars(own).items() if name not in self.by_world})
        self._own = own
        self._gathered: dict[str, Tensor] = {}  # also of a view without scores, which is a shallow copy

    def __getattr__(self, name: str) -> Tensor:  # asked only for what is not an attribute
        if name not in Interactions.by_world:
            raise AttributeError(name)
        if name not in self._gathered:
            self._gathered[name] = gather_rows(getattr(self._own, name))
        return self._gathered[name]


def _resized(ring: Tensor, cursor: Tensor, capacity: int) -> Tensor:
    """Ring buffers, shape (num_envs, any, ...), with another capacity; ``cursor`` counts what each has been given."""
    old = ring.shape[1]
    if old == capacity:
        return ring
    newest = torch.arange(1, min(old, capacity) + 1, dtype=torch.int64, device=ring.device)
    entry = cursor.unsqueeze(1) - newest  # below 0 a free slot of the old one becomes one of the new one
    world = torch.arange(len(ring), dtype=torch.int64, device=ring.device).unsqueeze(1)
    new = ring.new_zeros(len(ring), capacity, *ring.shape[2:])
    new[world, entry % capacity] = ring[world, entry % old]
    return new
