"""A Director in the command manager of mjlab or Isaac Lab, which keep the clock of the commands themselves."""

import abc
from typing import Any

from torch import Tensor

from deimos.goals.director import GoalDirector
from deimos.goals.given import Rows


class DirectedCommand(abc.ABC):
    """A mix-in to put before the class of a command term, such as either's ``UniformVelocityCommand``.

    The term resamples as before, by its own timers and at resets, and draws its modes (headings, standing robots); the
    commands come from the Director, which learns from what the modes made of them. A reset between two steps, as after
    the Director or the environment has loaded a state, drops what is pending and is not an outcome.
    """

    director: GoalDirector
    """Chooses the commands, on the term's clock; it must have a ``goal_box``. Set it after ``super().__init__``."""
    command: Tensor
    """The term's commands, shape (num_envs, goal_dim)."""
    _env: Any
    _observed = 0  # last step of the environment that was reported to the Director

    @abc.abstractmethod
    def state(self) -> Tensor:
        """What the Director sees of every robot, shape (num_envs, state_dim)."""

    def compute(self, *args: Any, **options: Any) -> None:
        """See the term; called once in every step."""
        self._observe()
        super().compute(*args, **options)  # type: ignore[misc]  # it is the term's

    def reset(self, env_ids: Rows = None) -> dict[str, float]:
        """See the term; an episode begins, after the outcome of the last one where a step has ended it."""
        self._observe()
        self.director.reset(env_ids)
        return super().reset(env_ids)  # type: ignore[misc]

    def _resample_command(self, env_ids: Tensor) -> None:
        before = self.command[env_ids].clone()
        super()._resample_command(env_ids)  # type: ignore[misc]
        self.command[env_ids] = self.director.propose(env_ids, self.state()[env_ids], before)

    def _observe(self) -> None:
        """Report to the Director how the last step ended; in a step, worlds are reset before commands are computed."""
        env = self._env
        if env.common_step_counter == self._observed:
            return
        self._observed = env.common_step_counter
        if hasattr(env, "reset_terminated"):  # else the counter is a checkpoint's, and nothing has been stepped yet
            self.director.observe(env.reset_terminated, env.reset_time_outs, executed=self.command)
