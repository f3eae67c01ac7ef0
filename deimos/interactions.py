"""Pending and resolved interactions: a goal is issued, and the policy crashes on it or survives it.

An interaction is (state, goal in force, next goal) at the moment of the choice. It resolves as *crashed*
when the world crashes within T steps, on the step of the next goal change included, and as *survived*
when the next goal is due and the world lives. Where the episode ends otherwise before that, it is
dropped. First goals are no interactions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.env import Step


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
    crashed: Tensor
    """True where the policy crashed on it, bool, shape (n,)."""
    steps: Tensor
    """Steps from issue to resolution, int32, shape (n,)."""
    reward: Tensor
    """Sum of the rewards over those steps, without that of a crash, shape (n,)."""
    issued: Tensor
    """Step that it was issued after, int64, shape (n,)."""

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
    """

    def __init__(
        self, num_envs: int, state_dim: int, goal_dim: int, goal_period: int, window: int, device: torch.device
    ) -> None:
        self.window = window
        self.now = 0
        """Steps so far."""
        self._slots = math.ceil(window / goal_period) + 1
        fields = {
            "state": ((state_dim,), torch.float32),
            "goal": ((goal_dim,), torch.float32),
            "next_goal": ((goal_dim,), torch.float32),
            "score": ((), torch.float32),
            "steps": ((), torch.int32),
            "reward": ((), torch.float32),
            "issued": ((), torch.int64),
        }
        self._pending = {
            name: torch.zeros(num_envs, *shape, dtype=dtype, device=device) for name, (shape, dtype) in fields.items()
        }
        self._ring = {
            name: torch.zeros(num_envs, self._slots, *shape, dtype=dtype, device=device)
            for name, (shape, dtype) in (fields | {"crashed": ((), torch.bool)}).items()
        }
        self._resolved_at = torch.full((num_envs, self._slots), -1, dtype=torch.int64, device=device)
        self._cursor = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.active = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """True where an interaction is pending, shape (num_envs,)."""

    def advance(self, step: Step) -> None:
        """Count a step and its rewards. Call it once per step, before ``resolve``."""
        self.now += 1
        self._pending["steps"] += 1
        self._pending["reward"].addcmul_(step.reward, (~step.terminated).float())

    def resolve(self, step: Step, rows: Tensor) -> None:
        """Close what this step has decided.

        Args:
            step: What the step gave back, before anything is reset.
            rows: The worlds whose goal is due or that are done, int64, shape (m,), each once.
        """
        crashed = step.terminated[rows]
        decided = self.active[rows] & (crashed | step.goal_due[rows])
        slot = self._cursor[rows] % self._slots
        for name, ring in self._ring.items():
            value = crashed if name == "crashed" else self._pending[name][rows]
            keep = decided.view(-1, *[1] * (value.dim() - 1))
            ring[rows, slot] = torch.where(keep, value, ring[rows, slot])
        self._resolved_at[rows, slot] = torch.where(decided, self.now, self._resolved_at[rows, slot])
        self._cursor[rows] += decided
        self.active[rows] = False

    def open(self, rows: Tensor, state: Tensor, goal: Tensor, next_goal: Tensor, score: Tensor) -> None:
        """Start an interaction in each listed world.

        Args:
            rows: Worlds, int64, shape (m,), each once.
            state: States, shape (m, state_dim).
            goal: Goals that were in force, shape (m, goal_dim).
            next_goal: Goals as they are issued, shape (m, goal_dim).
            score: What the selector thinks of them, shape (m,).
        """
        pending = self._pending
        pending["state"][rows] = state
        pending["goal"][rows] = goal
        pending["next_goal"][rows] = next_goal
        pending["score"][rows] = score
        pending["steps"][rows] = 0
        pending["reward"][rows] = 0.0
        pending["issued"][rows] = self.now
        self.active[rows] = True

    def resolved(self, last: int | None = None) -> Resolved:
        """The interactions resolved within the last steps, ordered by world and age of the slot.

        Args:
            last: Steps to look back, at most ``window``; ``None`` for the whole window.
        """
        since = self.now - (self.window if last is None else min(last, self.window))
        env, slot = torch.nonzero((self._resolved_at > since) & (self._resolved_at > 0), as_tuple=True)
        return Resolved(env=env, **{name: ring[env, slot] for name, ring in self._ring.items()})

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        return {
            "now": self.now,
            "pending": {name: value.clone() for name, value in self._pending.items()},
            "ring": {name: value.clone() for name, value in self._ring.items()},
            "resolved_at": self._resolved_at.clone(),
            "cursor": self._cursor.clone(),
            "active": self.active.clone(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from ``state_dict()``."""
        self.now = state["now"]
        for name, value in self._pending.items():
            value.copy_(state["pending"][name])
        for name, value in self._ring.items():
            value.copy_(state["ring"][name])
        self._resolved_at.copy_(state["resolved_at"])
        self._cursor.copy_(state["cursor"])
        self.active.copy_(state["active"])
