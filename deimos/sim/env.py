"""The interface of environments.

The order of one step is part of the contract: physics; crash test; reward, against the goal that was
active; clocks; the observation that the step ended in, still with the old goal. ``step`` never
resets a world and never changes a goal: ``deimos.run.loop`` does both, between two steps.
"""

import abc
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Self, final

import numpy as np
import torch
from torch import Tensor

from deimos.checks import check_at_least, check_range
from deimos.files import read_bytes
from deimos.nn.layout import ObsField, goal_slice
from deimos.nn.ranks import gather_rows, own_rows

if TYPE_CHECKING:
    import mujoco

DRAW_COUNTS = ("episode_count", "goal_count")  # the addresses of a world's draws, among ``Env.tensors``


@dataclass(frozen=True)
class Step:
    """What a step returns. All tensors are views that the next step overwrites."""

    obs: Tensor
    """Observations that the step ended in, float32, shape (num_envs, obs_dim)."""
    reward: Tensor
    """Rewards, at least 0 except for ``Env.crash_penalty``, float32, shape (num_envs,)."""
    terminated: Tensor
    """True where the world crashed, bool, shape (num_envs,)."""
    truncated: Tensor
    """True where the episode was cut off without a crash, bool, shape (num_envs,)."""
    goal_due: Tensor
    """True where the goal has been active for its whole period and the state is valid, bool, shape (num_envs,)."""
    invalid: Tensor
    """True where the state is no longer physical, bool, shape (num_envs,); truncated too, unless it crashed."""
    tracking: Tensor | None = None
    """How well each group of goal components is met, in [0, 1], float32, shape (num_envs, len(goal_groups));
    ``None`` if there is one group, whose reward says it."""


@dataclass(frozen=True)
class Sketch:
    """What to draw of a world that is a point in a box. Lengths are in the world's own unit."""

    half_side: float
    """Half side of the box, around the origin, whose walls the point must not cross."""
    position: np.ndarray
    """Where the point is, shape (3,)."""
    target: np.ndarray
    """Where its goal is, or where the goal would lead it from here by the end of the goal's period; shape (3,)."""


@dataclass(frozen=True, kw_only=True)
class EnvConfig(abc.ABC):
    """The interface of an environment's ``Config``: a frozen dataclass in a file of ``deimos.sim.envs`` or a plug-in.

    A subclass that checks its own fields in ``__post_init__`` calls this class's too.
    """

    goal_period: int = 100
    """T: steps that a goal is active, at least 1."""
    crash_penalty: float = 0.0
    """What a crash costs the learner, in multiples of the largest goal-matching reward of one step, at least 0. Scores
    and reported rewards do not include it."""

    def __post_init__(self) -> None:
        check_at_least("goal_period", self.goal_period, 1)
        check_range("crash_penalty", self.crash_penalty, 0.0, 1e6)

    @abc.abstractmethod
    def build(self, num_envs: int, device: torch.device, seed: int, env_offset: int = 0) -> "Env":
        """Make the environment.

        Args:
            num_envs: Number of worlds, at least 1.
            device: Where they are simulated.
            seed: Seed of every draw, in [0, 2^32).
            env_offset: Global number of world 0. Draws are addressed by global numbers, so two
                environments of 1000 worlds, the second with an offset of 1000, equal one of 2000.
        """

    @property
    def files(self) -> dict[str, Path]:
        """Files that the worlds are built from, by the field that holds the path; a run works with its own copies."""
        return {}

    def read_file(self, name: str) -> tuple[bytes, str]:
        """What a run keeps of one of ``files``, self-contained, and the ending of its copy."""
        return read_bytes(self.files[name]), self.files[name].suffix

    @final
    def file_hashes(self) -> dict[str, str]:
        """First 16 hexadecimal digits of the SHA-256 of what a run keeps of each of ``files``.

        Raises:
            OSError: If one cannot be read.
            ValueError: If one is not what it should be.
        """
        return {name: hashlib.sha256(self.read_file(name)[0]).hexdigest()[:16] for name in self.files}

    @property
    def largest_reward(self) -> float:
        """Largest reward of one step for matching the goal: the unit of ``crash_penalty``."""
        return 1.0

    def implied(self, name: str) -> float | None:
        """What a field that is ``None`` stands for; ``None`` if that is not a number."""
        return None

    @final
    def with_goal_period(self, goal_period: int) -> Self:
        """The same task with another T."""
        return replace(self, goal_period=goal_period)

    @final
    def for_evaluation(self) -> Self:
        """The same task without randomisation and without a penalty for crashes, all goal clocks in step."""
        return replace(self.without_randomness(), crash_penalty=0.0)

    def resolved(self, device: torch.device) -> Self:
        """The same task with what ``auto`` stands for on a device, so that a run keeps it on another device."""
        return self

    def without_randomness(self) -> Self:
        """The same task with every randomisation switched off and all goal clocks in step."""
        return self


class Env(abc.ABC):
    """Many worlds, simulated in parallel, each pursuing its own goal; once built, every world has begun an episode."""

    config: EnvConfig
    num_envs: int
    device: torch.device
    layout: tuple[ObsField, ...]
    """Fields of the observation, in order; the one named ``goal`` is the goal slot."""
    action_dim: int
    action_bound: float
    """Bound of every component of an action, in absolute value; may be infinite. See ``action_range``."""
    dt: float
    """Duration of a step [s]; 1 where the environment has no seconds."""
    goal_period: int
    """T: steps that a goal is active."""
    time_limit: int
    """Steps after which an episode is truncated; 0 for never."""
    crash_penalty: float = 0.0
    """What is subtracted from the reward of a step that ends in a crash: add it to report rewards."""
    obs: Tensor
    """The current observations: the same memory as ``Step.obs``, refreshed by ``reset`` and ``set_goals``."""
    steps: int = 0
    """Steps since it was built."""
    recordable: bool = False
    """Whether a CUDA graph may replay steps, resets and draws: all work is on the device, except counting ``steps``."""
    may_go_on_invalid: bool = False
    """Whether the run continues if a world becomes invalid; otherwise ``check`` stops it."""
    goal_groups: tuple[slice, ...] = (slice(None),)
    """Components of a goal that are met or missed together."""
    goal_group_names: tuple[str, ...] = ("goal",)
    """Their names."""
    goal_group_weights: tuple[float, ...] = ()
    """Weight of each of them in the score, at least 0; empty if all weigh the same."""
    goal_range: Tensor | None = None
    """Half side of the box that goals are drawn from, in physical units, shape (goal_dim,); ``None`` for no box."""
    errors: Mapping[str, Tensor] = MappingProxyType({})
    """How far each world was from its goal at the end of the last step, in physical units; by name and unit, views of
    shape (num_envs,). Empty where ``Step.tracking`` is enough."""
    episode_step: Tensor
    """Steps since the last reset, int32, shape (num_envs,); a view."""
    tensors: dict[str, Tensor]
    """Everything that a bit-exact resume needs, by name; views, worlds along the first axis. The addresses of draws are
    ``episode_count``, a world's episodes so far, and ``goal_count``, its goals since the last one began."""

    @abc.abstractmethod
    def step(self, action: Tensor) -> Step:
        """Simulate one step of every world.

        Args:
            action: Actions, float32, shape (num_envs, action_dim).

        Raises:
            ValueError: If the shape is a different one.
        """

    @abc.abstractmethod
    def reset(self, mask: Tensor, goal_scale: Tensor | None = None) -> None:
        """Start a new episode, with a uniform first goal, where ``mask`` is true.

        Args:
            mask: bool, shape (num_envs,).
            goal_scale: Share of the goal range that first goals come from, shape (goal_dim,), in (0, 1]; ``None``: all.
        """

    @abc.abstractmethod
    def sample_goals(self, rows: Tensor, count: int, scale: Tensor | None = None) -> Tensor:
        """Draw independent valid goals, uniform by this environment's definition.

        Drawing again before ``set_goals`` gives the same goals.

        Args:
            rows: Worlds that need a goal, int64, shape (B,).
            count: Goals per world, at least 1.
            scale: Share of the goal range, shape (goal_dim,), in (0, 1]; ``None`` for the whole range.

        Returns:
            Goals as the policy sees them, shape (B, count, goal_dim); a view that the next call overwrites.
        """

    @abc.abstractmethod
    def draw(self, rows: Tensor) -> Tensor:
        """Four uniform numbers in [0, 1) per listed world for the choice of its next goal, shape (B, 4)."""

    @abc.abstractmethod
    def set_goals(self, rows: Tensor, goal: Tensor, where: Tensor | None = None) -> None:
        """Give the listed worlds a new goal, start its clock and refresh their observations.

        Args:
            rows: Worlds, int64, shape (B,), each at most once.
            goal: Goals as the policy sees them, float32, shape (B, goal_dim).
            where: Which of the rows are meant, bool, shape (B,); ``None`` for all.
        """

    @abc.abstractmethod
    def check(self) -> None:
        """Raise ``SimulationError`` if an action was not finite or more worlds became invalid than may.

        It reads the device. Call it after every step, or once in a while.
        """

    def scene(self, world: int) -> "tuple[mujoco.MjModel, mujoco.MjData] | None":
        """One world as MuJoCo's model and data, for rendering; ``None`` if MuJoCo cannot show it."""
        return None

    def sketch(self, world: int) -> Sketch | None:
        """One world as a drawing, for rendering without a ``scene``; ``None`` if it is not a point in a box."""
        return None

    def goal_point(self, world: int) -> np.ndarray | None:
        """Where the goal of one world is in its ``scene`` [m], shape (3,); ``None`` if a goal is not a place."""
        return None

    @property
    def has_seconds(self) -> bool:
        """Whether ``dt`` is in seconds."""
        return self.dt != 1

    def goal_bounds(self, rows: Tensor) -> tuple[Tensor, Tensor] | None:
        """The box of the valid goals of the listed worlds; ``None`` if not all goals of a box are valid.

        Args:
            rows: Worlds, int64, shape (B,).

        Returns:
            The lowest and the highest value of every component, as the policy sees it, shape (B, goal_dim) each.
        """
        return None

    def rest_goal(self) -> tuple[float | None, ...]:
        """The goal that asks a world to stay where it is, as the policy sees it.

        By default all zeros: no speed, no distance to go, the middle of the box. ``None`` for components that stay.
        """
        return (0.0,) * self.goal_dim

    def scripted_goals(self, rows: Tensor, goal: Tensor) -> Tensor | None:
        """What a person would ask of the listed worlds to make them crash, for the attacker ``scripted``.

        Args:
            rows: Worlds, int64, shape (B,).
            goal: A valid uniform goal for each, shape (B, goal_dim), for the components that are left to chance.

        Returns:
            Valid goals as the policy sees them, shape (B, goal_dim); ``None`` if the environment defines none.
        """
        return None

    def achieved(self, obs: Tensor) -> Tensor | None:
        """The goals that observations meet exactly, for learners that relabel goals in hindsight.

        Args:
            obs: Observations that steps ended in, shape (n, obs_dim).

        Returns:
            Shape (n, goal_dim); ``None`` if a reward depends on more than these and the goal.
        """
        return None

    def goal_reward(self, achieved: Tensor, goal: Tensor) -> Tensor:
        """Rewards of steps with the given achievements and goals, without ``crash_penalty``.

        Args:
            achieved: What ``achieved`` returned, shape (n, goal_dim).
            goal: Goals as the policy sees them, shape (n, goal_dim).

        Returns:
            Float32, shape (n,).

        Raises:
            ValueError: If ``achieved`` returns ``None`` here.
        """
        raise ValueError(f"The rewards of {type(self).__name__} depend on more than what was achieved and the goal.")

    def place(self, rows: Tensor) -> Tensor | None:
        """Where the listed worlds are in the box that they crash outside of.

        Args:
            rows: Worlds, int64, shape (B,).

        Returns:
            Shape (B, goal_dim), in [-1, 1] inside; ``None`` if there is no such box.
        """
        return None

    def risk_contrast(self) -> tuple[Tensor, Tensor] | None:
        """Put worlds where any goal is dangerous and where none is, to ask a fear network about both.

        Returns:
            The former and the latter, int64, shapes (m,) and (n,); ``None`` if the environment knows no such places.
            Their goals are uniform. A later reset may give others.
        """
        return None

    def strata(self) -> list[str]:
        """The kind of each world, such as the ground that it stands on, for evaluation; empty for no kinds."""
        return []

    def report(self) -> dict[str, float]:
        """Numbers for the log on the steps since the last call, the same keys every time; reads the device.

        Where several ranks share a run, all call it, and the first one's result is logged: see ``deimos.nn.ranks``.
        """
        return {}

    def reference_policy(self) -> Callable[[Tensor], Tensor] | None:
        """A scripted policy (obs -> action) that sets 1 on the normalised score; ``None`` if there is none."""
        return None

    def tracking_at_rest(self) -> float | None:
        """Weighted tracking of uniform goals by a robot that stands still, in [0, 1]: it sets 0 on the score.

        Perfect tracking is then 1. The robots of this environment stand for a while to find out. ``None`` if scripts
        set the score (``reference_policy``), or nothing does.
        """
        return None

    @property
    def action_range(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest value of every component of an action, beyond which it is clipped, on the CPU."""
        bound = torch.full((self.action_dim,), self.action_bound, dtype=torch.float32)
        return -bound, bound

    @property
    def obs_dim(self) -> int:
        """Components of the observation."""
        return sum(field.size for field in self.layout)

    @property
    def goal_slice(self) -> slice:
        """The components of the observation that hold the goal."""
        return goal_slice(self.layout)

    @property
    def goal_dim(self) -> int:
        """Components of a goal."""
        return self.goal_slice.stop - self.goal_slice.start

    @property
    def state_dim(self) -> int:
        """Components of the observation that are not the goal."""
        return self.obs_dim - self.goal_dim

    @property
    def goal(self) -> Tensor:
        """The active goals as the policies see them, shape (num_envs, goal_dim); a view."""
        return self.obs[:, self.goal_slice]

    def state(self, obs: Tensor) -> Tensor:
        """The observation without its goal slot, shape (..., state_dim)."""
        goal = self.goal_slice
        if goal.stop == self.obs_dim:  # a goal at the end costs no copy
            return obs[..., : goal.start]
        return torch.cat([obs[..., : goal.start], obs[..., goal.stop :]], dim=-1)

    def restart(self, goal_scale: Tensor | None = None) -> None:
        """Begin every world's first episode again, as it was when the environment was built, except for its first goal.

        Args:
            goal_scale: Share of the goal range that first goals come from; see ``reset``.
        """
        for name in DRAW_COUNTS:
            self.tensors[name].zero_()
        self.reset(torch.ones(self.num_envs, dtype=torch.bool, device=self.device), goal_scale)

    def copy_worlds(self, source: Tensor, target: Tensor, origin: "Env | None" = None) -> None:
        """Make worlds ``target`` exact clones of worlds ``source``, clocks and counts included.

        A clone keeps its own global number, so its later draws are its own.

        Args:
            source: Worlds to copy, int64, shape (n,).
            target: Worlds to overwrite, int64, shape (n,), each at most once.
            origin: The environment that ``source`` counts in; ``None`` for this one.
        """
        origin = self if origin is None else origin
        for name, tensor in self.tensors.items():
            tensor[target] = origin.tensors[name][source]

    def take_worlds(self, state: dict[str, Tensor]) -> None:
        """Continue where the worlds of another environment are, with this one's own draws.

        Args:
            state: Its ``state_dict()``. What only one of the two has, because engines differ, is left out.

        Raises:
            ValueError: If it belongs to another task or number of worlds.
        """
        for name, tensor in self.tensors.items():
            if name in state and name not in DRAW_COUNTS:
                own = own_rows(state[name])
                if own.shape != tensor.shape:
                    raise ValueError(f"{name} must have the shape {tuple(tensor.shape)}, got {tuple(own.shape)}.")
                tensor.copy_(own)

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of all tensors that a bit-exact resume needs, with the worlds of all ranks; see ``Stateful``."""
        return {name: gather_rows(tensor).clone() for name, tensor in self.tensors.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from ``state_dict()``.

        Raises:
            ValueError: If ``state`` belongs to another environment or number of worlds.
        """
        state = {name: own_rows(tensor) for name, tensor in state.items()}
        expected = {name: tuple(tensor.shape) for name, tensor in self.tensors.items()}
        found = {name: tuple(tensor.shape) for name, tensor in state.items()}
        if expected != found:
            raise ValueError(f"state must hold {expected}, got {found}; it belongs to another environment.")
        for name, tensor in self.tensors.items():
            tensor.copy_(state[name])
