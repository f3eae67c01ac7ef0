"""What environments on Warp kernels share: memory that torch sees too, recorded launches, the drawing of goals."""

import abc
from collections.abc import Callable
from typing import Any, final

import torch
import warp as wp
from torch import Tensor

from deimos.kernels.goals import draw_candidates
from deimos.kernels.random import Purpose, draw_uniforms
from deimos.sim.env import Env, Step
from deimos.sim.shared import Shared


class WarpEnv(Env):
    """An environment on Warp kernels.

    A subclass hands its arrays to ``_share``, records its launches, and then begins every world's first episode.
    What it does in a step it says in ``launch_step``, and which goals are valid in ``_finish_candidates``.
    """

    action: Shared
    """The actions of the step, for the kernels."""
    state_arrays: Any
    """The struct of the arrays that a resume needs."""
    step_arrays: Any
    """The struct of the arrays that a step gives back."""
    _launch_reset: Callable[[], None]
    """Begins an episode in the worlds of ``_mask``, with first goals from ``_first_range``."""
    _launch_goals: wp.Launch
    """Gives the worlds of ``_row`` the goals in ``_new_goal``, one thread for each."""

    @abc.abstractmethod
    def launch_step(self) -> None:
        """Simulate one step under the actions that are in ``action``, for benchmarks too."""

    @abc.abstractmethod
    def _finish_candidates(self, candidates: wp.array) -> list[wp.Launch]:
        """Record what makes valid goals of candidates for the worlds of ``_row`` that are uniform in their box.

        Args:
            candidates: Goals as the policy sees them, float32, shape (num_envs, count, goal_dim).

        Returns:
            Launches of two axes, rows first; none where all candidates are valid goals.
        """

    @final
    def _share(
        self, state_arrays: Any, state: dict[str, Shared], step_arrays: Any, out: dict[str, Shared], *,
        action: Shared, new_goal: Shared, first_range: Tensor, seen_range: Tensor, seed: int, env_offset: int,
    ) -> None:  # fmt: skip
        """Keep all memory of the environment; nothing is allocated or rebound later.

        Args:
            state_arrays: The struct of ``state``, to be filled.
            state: What a resume needs, by name; worlds along the first axis.
            step_arrays: The struct of ``out``, to be filled.
            out: What a step gives back, by name.
            action: The actions, num_envs of them.
            new_goal: Room for a goal for every world.
            first_range: What ``_first_range`` holds where first goals come from the whole range, shape (goal_dim,).
            seen_range: Half side of the box of goals as the policy sees them, shape (goal_dim,).
            seed: Seed of every draw.
            env_offset: Global number of world 0.
        """
        n, device = self.num_envs, self.device
        for struct, arrays in ((state_arrays, state), (step_arrays, out)):
            for name, shared in arrays.items():
                setattr(struct, name, shared.array)
        self.state_arrays, self.step_arrays, self.action = state_arrays, step_arrays, action
        self._out = {name: shared.tensor for name, shared in out.items()}
        self._step = Step(**{name: self._out[name] for name in Step.__dataclass_fields__ if name in out})
        self.obs = self._out["obs"]
        # Observations are kept, not computed anew: what a policy saw is part of a bit-exact resume.
        self.tensors = {name: shared.tensor for name, shared in state.items()} | {"obs": self.obs}
        self.episode_step = self.tensors["episode_step"]
        self._seed, self._offset = seed, env_offset
        self._mask = Shared.zeros(n, wp.bool, device)
        self._row = Shared.zeros(n, wp.int32, device)
        self._new_goal = new_goal
        self._draw = Shared.zeros(n, wp.vec4, device)
        self._whole_range, self._seen_range = first_range, seen_range
        self._first_range = Shared.zeros(len(first_range), wp.float32, device)
        self._candidate_scale = Shared.zeros(len(seen_range), wp.float32, device)
        self._candidates: dict[int, tuple[Shared, list[wp.Launch]]] = {}
        self._launch_draw = draw_uniforms(
            self._row.array, state_arrays.goal_count, self._draw.array, seed=seed, purpose=Purpose.GOAL,
            world_offset=env_offset, record=True,
        )  # fmt: skip

    @final
    def step(self, action: Tensor) -> Step:
        """See ``Env.step``."""
        if action.shape != self.action.tensor.shape:
            expected = tuple(self.action.tensor.shape)
            raise ValueError(f"action must have the shape {expected}, got {tuple(action.shape)}.")
        self.action.tensor.copy_(action)
        self._step.count.zero_()
        self.launch_step()
        return self._step

    @final
    def reset(self, mask: Tensor, goal_scale: Tensor | None = None) -> None:
        """See ``Env.reset``."""
        self._mask.tensor.copy_(mask)
        if goal_scale is None:
            self._first_range.tensor.copy_(self._whole_range)
        else:
            torch.mul(self._whole_range, goal_scale, out=self._first_range.tensor)
        self._launch_reset()

    @final
    def sample_goals(self, rows: Tensor, count: int, scale: Tensor | None = None) -> Tensor:
        """See ``Env.sample_goals``."""
        if count not in self._candidates:
            self._candidates[count] = self._record_candidates(count)
        candidates, launches = self._candidates[count]
        self._set_rows(rows)
        torch.mul(self._seen_range, 1.0 if scale is None else scale, out=self._candidate_scale.tensor)
        for launch in launches:
            launch.set_dim((len(rows), launch.bounds.shape[1]))  # as many threads per row as were recorded
            launch.launch()
        return candidates.tensor[: len(rows)]

    @final
    def draw(self, rows: Tensor) -> Tensor:
        """See ``Env.draw``."""
        self._set_rows(rows)
        self._launch_draw.set_dim(len(rows))
        self._launch_draw.launch()
        return self._draw.tensor[: len(rows)]

    @final
    def set_goals(self, rows: Tensor, goal: Tensor) -> None:
        """See ``Env.set_goals``."""
        self._set_rows(rows)
        self._new_goal.tensor[: len(rows)] = goal
        self._launch_goals.set_dim(len(rows))
        self._launch_goals.launch()

    def _record_candidates(self, count: int) -> tuple[Shared, list[wp.Launch]]:
        candidates = Shared.zeros((self.num_envs, count, self.goal_dim), wp.float32, self.device)
        drawn = draw_candidates(
            self._row.array, self.state_arrays.goal_count, self._candidate_scale.array, candidates.array,
            seed=self._seed, world_offset=self._offset, record=True,
        )  # fmt: skip
        return candidates, [drawn, *self._finish_candidates(candidates.array)]

    def _set_rows(self, rows: Tensor) -> None:
        self._row.tensor[: len(rows)] = rows
