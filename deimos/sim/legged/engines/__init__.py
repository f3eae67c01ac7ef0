"""What steps the worlds of robots: two engines behind one interface, one file each.

``mujoco_warp`` simulates on CUDA, and on Warp's CPU backend after a minute or two of compilation. ``native`` is
MuJoCo's own C code on all cores of a CPU. Both expose Warp arrays with MuJoCo's names and layout; code that uses them
need not know which engine it is.
"""

import abc
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
import warp as wp

from deimos.checks import check_at_least, check_positive
from deimos.kernels.legged.state import Simulation
from deimos.sim.legged.robots import Robot
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco

Name = Literal["auto", "warp", "native"]
MODULES = {"warp": "mujoco_warp", "native": "native"}
"""The file of every engine, by its name in a configuration."""


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The simulator's settings."""

    timestep: float = 0.005
    """Duration of a substep [s], positive."""
    substeps: int = 4
    """Substeps of a control step, at least 1."""
    iterations: int = 5
    """Bound of the constraint solver's Newton iterations, at least 1."""
    line_search: int = 10
    """Bound of its line-search iterations, at least 1."""
    contacts: int = 0
    """Contact buffer size per world, shared by all worlds; 0 takes half of what contact with every geom would need, a
    quarter on a height field, but at least one for every pair of geoms that can touch, and the whole for 16 more
    worlds. That is 69 % and 28 % for 512 Go1s. Only for mujoco-warp; the native engine has an arena per thread."""
    rows: int = 0
    """Buffer size for constraint rows in each world; 0 takes what contact with every geom needs, with all joints at
    their limits and with dry friction, four fifths of it on a height field. Only for mujoco-warp, as above."""
    deterministic: bool = False
    """Whether contacts and sums have the same order every time on a GPU too, which exact resumes and clones need there;
    it costs time. Only for mujoco-warp; on a CPU the order is always the same."""

    def __post_init__(self) -> None:
        check_positive("timestep", self.timestep, finite=True)
        for name in ("substeps", "iterations", "line_search"):
            check_at_least(name, getattr(self, name), 1)
        for name in ("contacts", "rows"):
            check_at_least(name, getattr(self, name), 0)

    @property
    def control_period(self) -> float:
        """Time from one action to the next [s]."""
        return self.timestep * self.substeps


class Physics(abc.ABC):
    """``num_envs`` worlds, each with its own robot on the same terrain, at the model's defaults."""

    robot: Robot
    terrain: Terrain | None
    config: PhysicsConfig
    num_envs: int
    device: torch.device
    arrays: Simulation
    """The simulator's arrays for the kernels; torques are those of the last substep."""
    parts: tuple[slice, ...]
    """Consecutive worlds that are each evaluated on a separate thread."""
    lost_contacts: int
    """The bits of ``arrays.overflow`` that mean that a contact or a constraint was left out."""
    recordable: bool = False
    """Whether a larger CUDA graph may include steps and resets; see ``Env.recordable``."""
    tensors: dict[str, torch.Tensor]
    """Everything that a bit-exact resume needs, by name; views, worlds along the first axis."""

    @cached_property
    def model(self) -> "mujoco.MjModel":
        """The model with its visual geoms, for rendering and viewers; made on first use."""
        from deimos.sim.legged.engines.model import build_spec

        return build_spec(self.robot, self.terrain, self.config, visual=True).compile()

    @abc.abstractmethod
    def step(self) -> None:
        """Simulate one control step: its substeps, and the contact forces of each.

        Positions of bodies and geoms lag ``qpos`` by a substep.
        """

    @abc.abstractmethod
    def record_step(self, before: Callable[[], None], after: Sequence[Callable[[], None]]) -> Callable[[], None]:
        """Record one control step between launches that belong to it.

        Args:
            before: Makes the launches that the step begins with, such as new target angles.
            after: Make the launches that follow it, in the worlds of each of ``parts``.

        Returns:
            Replays all of it. Recording has run it once or more often, so whatever that changes must be set again.
        """

    @abc.abstractmethod
    def bare_step(self) -> None:
        """Simulate the substeps of one control step and nothing else: the baseline of benchmarks."""

    @abc.abstractmethod
    def reset(self, mask: wp.array) -> None:
        """Put every world of ``mask`` back to the model's defaults and forget all that it computed, warm starts too.

        Meant to be captured, see ``Captured``.

        Args:
            mask: bool, shape (num_envs,).
        """

    @abc.abstractmethod
    def report(self) -> dict[str, float]:
        """Numbers for the log on the steps since the last call, the same keys every time; reads the device."""

    @abc.abstractmethod
    def explain_loss(self, bits: int) -> str:
        """Why contacts were lost, by the bits of ``arrays.overflow``, and what helps; reads the device."""

    def to_mujoco(self, world: int) -> "mujoco.MjData":
        """One world as MuJoCo's own data on ``model``, for rendering, viewers and tests; reads the device."""
        import mujoco

        data = mujoco.MjData(self.model)
        for name in ("qpos", "qvel", "ctrl"):
            getattr(data, name)[:] = getattr(self.arrays, name).numpy()[world]
        data.qacc_warmstart[:] = self.tensors["warmstart"][world].cpu().numpy()
        mujoco.mj_forward(self.model, data)
        return data


def resolve(engine: Name, device: torch.device) -> Name:
    """The engine that a name stands for on a device: ``auto`` depends on it, others stand for themselves."""
    if engine != "auto":
        return engine
    return "warp" if device.type == "cuda" else "native"


def build(
    engine: Name, robot: Robot, terrain: Terrain | None, num_envs: int, device: torch.device, config: PhysicsConfig, *,
    friction: np.ndarray | None = None, payload: np.ndarray | None = None,
) -> Physics:  # fmt: skip
    """Make the worlds.

    Args:
        engine: A name of ``MODULES``, or ``auto``.
        robot: The robot.
        terrain: What it stands on; ``None`` for a plane at height 0, which is faster.
        num_envs: Number of worlds.
        device: Where they are simulated.
        config: The simulator's settings.
        friction: Sliding friction of every world's feet, shape (num_envs,); ``None`` for the robot's own.
        payload: Mass that is added to every world's base [kg], shape (num_envs,); ``None`` for none.

    Raises:
        ValueError: If the terrain's cells are finer than ``model.FINEST_CELL``, or the engine does not know the device.
        MemoryError: If there are more worlds than memory holds.
    """
    module = importlib.import_module(f"{__name__}.{MODULES[resolve(engine, device)]}")
    return module.Engine(robot, terrain, num_envs, device, config, friction=friction, payload=payload)
