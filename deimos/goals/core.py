"""Goals between two steps, in Deimos' own loop and in other people's: outcomes first, then choices."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.goals.interactions import Interactions, assign, bytes_of
from deimos.goals.selector import GoalSelector, Spaces, Transitions
from deimos.nn.ranks import mean_over_ranks
from deimos.nn.stateful import Stateful

RING = 32 * 2**20  # bytes for resolved interactions where a world may have any number of them,
SPARE = 8  # but at least this many of each world
AS_ON_GPU = False
"""Whether a CPU is treated as a device that the host has to wait for, as it has for a GPU: for tests."""


def on_gpu(device: torch.device) -> bool:
    """Whether the host has to wait for ``device`` to read a number: whether it is not the CPU."""
    return AS_ON_GPU or device.type != "cpu"


def window_between(goal_period: int, steps: int) -> int:
    """Steps that outcomes are kept for, so that each is learnt from if a selector learns every ``steps`` steps.

    The method learns from the last 2 T. The crash memory takes over what was issued T steps ago, once all outcomes of
    that time are known: what was resolved up to T steps before the last update must still be there.
    """
    return max(2 * goal_period, steps + goal_period)


@dataclass(frozen=True)
class Changes:
    """Where a step calls for a new goal; in dense form all worlds are listed, since they were not counted."""

    due: Tensor
    """Worlds that are not done and whose goal's time is up, int64, shape (m,)."""
    done: Tensor
    """Worlds whose episode has ended, int64, shape (m,): they begin with a first goal."""
    cut_off: Tensor
    """Those of them that were truncated, int64, shape (m,)."""
    ended: Tensor
    """True where an episode has ended, bool, shape (num_envs,)."""
    where: Tensor | None = None
    """In dense form, which of the worlds in ``due`` are meant, bool, shape (num_envs,)."""


class GoalCore(Stateful):
    """Joins a selector and the interactions of its goals.

    It sees tensors only. The owner of the worlds calls ``advance`` after every step, and ``choose`` for the worlds
    that are due.

    Args:
        selector: The selector.
        spaces: The worlds.
        window: Steps that resolved interactions are kept for; ``None`` for 2 T.
        any_number: Whether a world may resolve one in every step, as where goals last fewer than T steps or first ones
            are chosen. Then the newest that fit into ``RING`` are kept, and ``SPARE`` of each world in any case: where
            that forgets crashes, the calibration counts too few.
    """

    saved = ("selector", "interactions", "weight", "percentile", "_delivered", "_steps")
    unknown = ("percentile", "_delivered")
    by_world = ("weight", "percentile", "_delivered")

    def __init__(
        self, selector: GoalSelector, spaces: Spaces, window: int | None = None, any_number: bool = False
    ) -> None:
        self.selector = selector
        self.goal_period = spaces.goal_period
        window = window or 2 * self.goal_period
        groups = 0 if spaces.groups == (slice(None),) else len(spaces.groups)
        # No world resolves more within the window, since a crash is followed by a first goal of T steps.
        capacity = math.ceil(window / self.goal_period) + 1
        if any_number:
            row = spaces.num_envs * bytes_of(spaces.state_dim, spaces.goal_dim, groups)
            capacity = min(window, max(SPARE, RING // row))
        self.interactions = Interactions(
            spaces.num_envs, spaces.state_dim, spaces.goal_dim, capacity, window, spaces.device, groups
        )
        self.weight = torch.ones(spaces.num_envs, dtype=torch.float32, device=spaces.device)
        """Weight of the transitions under the active goal in everything learnt, at least 0, shape (num_envs,)."""
        self.percentile = torch.full_like(self.weight, 50.0)
        """Percentile of the active goal's fear among the candidates that it was chosen from, in [0, 100], shape
        (num_envs,): 50 for first goals and all other uniform ones, NaN where the selector has no fear to rank by."""
        self._delivered, self._steps = torch.zeros_like(self.weight), 0  # its sum since the last call of learn
        self.everybody = torch.arange(spaces.num_envs, dtype=torch.int64, device=spaces.device)
        """All worlds, int64, shape (num_envs,)."""
        self._nobody = self.everybody[:0]

    def changes(self, terminated: Tensor, truncated: Tensor, due: Tensor) -> Changes:
        """What ``advance`` will return for a step; nothing is counted yet."""
        done = terminated | truncated
        masks = torch.stack([due & ~done, done, truncated])
        # A known count saves another wait for the device.
        due_rows, done_rows, cut_off = (
            torch.nonzero_static(mask, size=count).squeeze(1) if count else self._nobody
            for mask, count in zip(masks, masks.sum(1).tolist(), strict=True)
        )
        return Changes(due_rows, done_rows, cut_off, done)

    def advance(
        self, terminated: Tensor, truncated: Tensor, due: Tensor, reward: Tensor, tracking: Tensor | None = None, *,
        dense: bool = False, changes: Changes | None = None,
    ) -> Changes:  # fmt: skip
        """Count a step, and resolve the interactions that it ended.

        Call it before anything is reset: an interaction whose T-th step is the time limit keeps its label.

        Args:
            terminated: True where the world crashed, bool, shape (num_envs,).
            truncated: True where its episode was cut off without a crash, bool, shape (num_envs,).
            due: True where the goal's time is up, bool, shape (num_envs,).
            reward: Rewards, shape (num_envs,).
            tracking: How well each group of goal components is met, in [0, 1], shape (num_envs, groups); ``None``
                where there is one group and the reward is its tracking.
            dense: Whether to return the changes in dense form, which reads nothing from the device. Otherwise three
                counts are read at once, and what follows is done for those worlds alone.
            changes: What ``changes`` returned for this step; ``None`` to compute it.
        """
        self.interactions.advance(reward, terminated, tracking)
        self._delivered += self.percentile
        self._steps += 1
        if dense:
            done = terminated | truncated
            everybody, changing = self.everybody, due | done
            self.interactions.resolve(everybody, terminated, due, changing)
            assign(self.percentile, everybody, 50.0, done)
            return Changes(everybody, everybody, everybody, done, changing ^ done)
        changes = changes or self.changes(terminated, truncated, due)
        if not (len(changes.due) or len(changes.done)):
            return changes
        rows = torch.cat([changes.due, changes.done])
        self.interactions.resolve(rows, terminated[rows], due[rows])
        assign(self.percentile, changes.done, 50.0)
        return changes

    def passed(self, steps: int) -> None:
        """Count steps that a CUDA graph has replayed, in which ``advance`` was not called."""
        self.interactions.now += steps
        self._steps += steps

    @torch.no_grad()
    def choose(
        self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor,
        horizon: Tensor | None = None, where: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Choose the next goals of the listed worlds, and begin their interactions.

        For the arguments see ``GoalSelector.propose``; each world is listed once, and nothing is pending in it.
        ``horizon`` holds the steps that each goal is to last, int64, shape (B,); ``None`` for T. ``where`` says in
        which of ``rows`` the goals are issued, bool, shape (B,); see ``assign``.

        Returns:
            Goals, shape (B, goal_dim).
        """
        chosen = self.selector.propose(rows, state, goal, candidates, draws)
        self.selector.issued(rows, state, goal, candidates, chosen, where)
        self.interactions.open(
            rows, state, goal, chosen.goal, chosen.score, self.goal_period if horizon is None else horizon,
            probe=chosen.probe, note=chosen.note, where=where,
        )  # fmt: skip
        assign(self.weight, rows, 1.0 if chosen.weight is None else chosen.weight, where)
        assign(self.percentile, rows, torch.nan if chosen.percentile is None else chosen.percentile, where)
        return chosen.goal

    def learn(self, rollout: Transitions | None) -> dict[str, float]:
        """Let the selector learn, once per rollout; see ``GoalSelector.learn``.

        Returns:
            Its numbers for the log, and ``goal_percentile``: the mean of ``percentile`` over all worlds and steps since
            the last call, which is the dose of fear that was delivered.
        """
        mean = mean_over_ranks(self._delivered.mean()).item() / self._steps if self._steps else math.nan
        self._delivered.zero_()
        self._steps = 0
        return {"goal_percentile": mean} | self.selector.learn(self.interactions.of_all_ranks(), rollout)
