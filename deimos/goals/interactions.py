"""Pending and resolved interactions: a goal is issued, and the policy crashes on it or survives it.

An interaction is (state, goal in force, next goal) at the moment of the choice. It resolves as *crashed*
when the world crashes within T steps, on the step of the next goal change included, and as *survived*
when the next goal is due and the world lives. Where the episode ends otherwise before that, it is
dropped. First goals are no interactions.
"""

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.sim.env import Step


@dataclass(frozen=True)
class Resolved:
    """Resolved interactions, one per row."""

    env: Tensor
    """World, int64, shape (n,)."""
    state: Tensor
    """State at the moment of the choice, shape (n, state_dim)."""
    goal: Tensor
    """Goal that was in force, shape (n, goal_dim)."""
    next_goal: Tensor
    """Goal as it was issued, shape (n, goal_dim)."""
    score: Tensor
    """What the selector thought of it then, NaN where it had no opinion, shape (n,)."""
    reward: Tensor
    """Sum of the rewards until it resolved, without that of a crash, shape (n,)."""
    tracking: Tensor
    """How well each group of its components was met, mean over its T steps, 0 from a crash on, shape (n, groups)."""
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

    def __len__(self) -> int:
        return len(self.crashed)

    def where(self, mask: Tensor) -> "Resolved":
        """Only the rows of ``mask``."""
        return Resolved(**{name: getattr(self, name)[mask] for name in self.__dataclass_fields__})


class Interactions:
    """One pending interaction per world, and the resolved ones of the last steps.

    Each world has a small ring of its own for what it resolved, so that nothing waits for a count and
    the memory is bounded: a world resolves at most ``ceil(window / T) + 1`` interactions within
    ``window`` steps, since a crash is followed by a first goal of T steps.

    Args:
        num_envs: Number of worlds.
        state_dim: Components of a state.
        goal_dim: Components of a goal.
        goal_period: T, steps.
        window: Steps that a resolved interaction is kept for.
        device: Where they are kept.
        groups: Columns of ``Step.tracking``; 0 where it is ``None`` and the reward says it.
    """

    def __init__(
        self, num_envs: int, state_dim: int, goal_dim: int, goal_period: int, window: int, device: torch.device,
        groups: int = 0,
    ) -> None:  # fmt: skip
        self.goal_period = goal_period
        self.window = window
        self.now = 0
        """Steps so far."""
        self._scored = True
        self.active = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """True where an interaction is pending, shape (num_envs,)."""
        self._slots = math.ceil(window / goal_period) + 1
        # State, goal, next goal, score, probe, note, reward, tracking.
        self._sizes = [state_dim, goal_dim, goal_dim, 1, 1, 1, 1, groups]
        self._reward = slice(-1 - groups, None)  # and the tracking: what grows with every step
        width = sum(self._sizes)
        # One row per interaction, not one tensor per field: a few decisions per step cost what their calls cost.
        self._pending = torch.zeros(num_envs, width, device=device)
        self.issued_at = torch.zeros(num_envs, dtype=torch.int64, device=device)
        """Step that the pending interaction was issued after, int64, shape (num_envs,)."""
        self._ring = torch.zeros(num_envs, self._slots, width, device=device)
        self._marks = torch.zeros(num_envs, self._slots, 3, dtype=torch.int64, device=device)
        """Crashed, issued, resolved; steps count from 1, so a resolved step of 0 marks a free slot."""
        self._cursor = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def advance(self, step: Step) -> None:
        """Count a step and its rewards. Call it once per step, before ``resolve``."""
        self.now += 1
        alive = (~step.terminated).float()
        if step.tracking is None:
            self._pending[:, -1].addcmul_(step.reward, alive)
        else:
            gain = torch.cat([step.reward.unsqueeze(1), step.tracking], dim=1)
            self._pending[:, self._reward].addcmul_(gain, alive.unsqueeze(1))

    def resolve(self, step: Step, rows: Tensor) -> None:
        """Close what this step has decided, and drop what it has cut off.

        Args:
            step: What the step gave back, before anything is reset.
            rows: The worlds whose goal is due or that are done, int64, shape (m,), each once.
        """
        crashed = step.terminated[rows]
        decided = self.active[rows] & (crashed | step.goal_due[rows])
        cursor = self._cursor[rows]
        slot = cursor % self._slots
        marks = torch.stack([crashed.long(), self.issued_at[rows], torch.full_like(slot, self.now)], dim=1)
        keep = decided.unsqueeze(1)
        self._ring[rows, slot] = torch.where(keep, self._pending[rows], self._ring[rows, slot])
        self._marks[rows, slot] = torch.where(keep, marks, self._marks[rows, slot])
        self._cursor[rows] = cursor + decided
        self.active[rows] = False

    def open(
        self, rows: Tensor, state: Tensor, goal: Tensor, next_goal: Tensor, score: Tensor,
        probe: Tensor | None = None, note: Tensor | None = None,
    ) -> None:  # fmt: skip
        """Start an interaction in each listed world.

        Args:
            rows: Worlds, int64, shape (m,), each once.
            state: States, shape (m, state_dim).
            goal: Goals that were in force, shape (m, goal_dim).
            next_goal: Goals as they are issued, shape (m, goal_dim).
            score: What the selector thinks of them, shape (m,).
            probe: True where the goal was drawn uniformly, bool, shape (m,); ``None`` for nowhere.
            note: Whole numbers below 2^24 to give back with the interaction, shape (m,); ``None`` for 0.
        """
        rest = torch.zeros(len(rows), 3 + self._sizes[-1], device=score.device)
        if probe is not None:
            rest[:, 0] = probe
        if note is not None:
            rest[:, 1] = note
        self._pending[rows] = torch.cat([state, goal, next_goal, score.unsqueeze(1), rest], dim=1)
        self.issued_at[rows] = self.now
        self.active[rows] = True

    def resolved(self) -> Resolved:
        """The interactions resolved within the window, ordered by world."""
        at = self._marks[:, :, 2]
        env, slot = torch.nonzero((at > 0) & (at > self.now - self.window), as_tuple=True)
        state, goal, next_goal, score, probe, note, reward, tracking = self._ring[env, slot].split(self._sizes, dim=1)
        crashed, issued, resolved = self._marks[env, slot].unbind(1)
        met = tracking if self._sizes[-1] else reward
        score = score if self._scored else torch.full_like(score, torch.nan)
        return Resolved(
            env=env, state=state, goal=goal, next_goal=next_goal, score=score.squeeze(1), reward=reward.squeeze(1),
            tracking=met / self.goal_period, probe=probe.squeeze(1) > 0, note=note.squeeze(1).long(),
            crashed=crashed.bool(), issued=issued, resolved=resolved,
        )  # fmt: skip

    def issued(self, since: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What was issued after step ``since`` and is still known, pending or resolved.

        Returns:
            World, int64, shape (n,); state (n, state_dim), goal that was in force and goal that was
            issued, (n, goal_dim) each.
        """
        pending = torch.nonzero(self.active & (self.issued_at > since)).squeeze(1)
        issued, resolved = self._marks[:, :, 1], self._marks[:, :, 2]
        env, slot = torch.nonzero((resolved > 0) & (issued > since), as_tuple=True)
        known = torch.cat([self._pending[pending], self._ring[env, slot]])
        state, goal, next_goal, *_ = known.split(self._sizes, dim=1)
        return torch.cat([pending, env]), state, goal, next_goal

    def without_scores(self) -> "Interactions":
        """The same interactions for a selector that did not choose these goals: it sees no scores."""
        view = copy.copy(self)
        view._scored = False
        return view

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "active": self.active, "pending": self._pending, "issued": self.issued_at,
            "ring": self._ring, "marks": self._marks, "cursor": self._cursor,
        }  # fmt: skip

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        return {"now": self.now} | {name: value.clone() for name, value in self._tensors().items()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from ``state_dict()``."""
        self.now = state["now"]
        for name, value in self._tensors().items():
            value.copy_(state[name])
