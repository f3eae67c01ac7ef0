"""The configuration of a legged robot's task; ``deimos.sim.legged.task`` is the task."""

import math
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import torch

from deimos import plugins, terrain
from deimos.checks import check_at_least, check_choice, check_positive, check_range
from deimos.kernels.legged.rewards import RewardWeights
from deimos.kernels.legged.state import LevelRule
from deimos.sim.env import EnvConfig
from deimos.sim.legged import engines, robot_file, robots
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.robots import Robot
from deimos.terrain import Terrain, importing


@dataclass(frozen=True, kw_only=True)
class LocomotionConfig(EnvConfig):
    """A legged robot on a terrain. Defaults are Legged Gym's unless stated otherwise."""

    robot: str = "go1"
    """Which robot walks: a name of ``deimos.sim.legged.robots``, or the path of a robot file (.toml)."""
    terrain: str = "flat"
    """What the robots walk on: flat, rough (slopes, stairs, rectangles), or the path of a terrain file (.npz)."""
    engine: engines.Name = field(default="auto", metadata={"before": "warp"})
    """The simulator: warp (mujoco-warp), or native, MuJoCo's own C code on all cores of a CPU; auto takes warp on CUDA
    and native on a CPU."""
    goal_period: int = 500
    """T: steps that a goal is active, at least 1 and at most an episode."""
    episode_steps: int = 1000
    """Steps after which an episode is truncated, at least 0; 0 for never, as in evaluations."""
    levels: Literal["reward", "displacement", "frozen"] = "reward"
    """What moves a robot to harder and easier tiles: its linear tracking (thesis, 4.1.2), how far it got compared with
    its commanded path (an arc if its goals ask for yaw; less than 0.3 m does not count), or nothing."""
    start_levels: int = 6
    """Number of the easiest levels, which first episodes are drawn from, at least 1; all if the terrain has fewer."""
    rewards: RewardWeights = field(default_factory=RewardWeights)
    """Weights of the reward's terms."""
    air_time_target: float = 0.3
    """Air time above which a step is rewarded [s], at least 0. Legged Gym uses 0.5 s, for larger robots."""
    friction: tuple[float, float] = (0.5, 1.25)
    """Range of the feet's friction, drawn once per world; at least 0.05, below which contacts are ill-conditioned."""
    payload: float = 1.0
    """Bound of the mass that is added to or taken from the base, drawn once per world [kg], at least 0 and less than
    the base's own. Off in Legged Gym, except for its ANYmal."""
    push_interval: float = 15.0
    """Time between pushes, each robot in its own phase [s], at least 0; 0 disables them."""
    push_speed: float = 1.0
    """Bound of the horizontal velocity that a push sets [m/s], at least 0."""
    noise: bool = True
    """Whether observations are noisy."""
    privileged: tuple[str, ...] = ()
    """Entries of the observation that only the critic sees because the robot cannot measure them, such as
    linear_velocity and heights."""
    stagger: bool = True
    """Whether the clocks of first episodes start at random steps, so that resets and goals spread out."""
    stiffness: float | None = None
    """Position gain of the legs' joints [N m/rad], positive; by default the robot's own."""
    damping: float | None = None
    """Velocity gain of the legs' joints [N m s/rad], positive; by default the robot's own."""
    action_scale: float | None = None
    """What an action of 1 adds to a target angle of the legs [rad], positive; by default the robot's own."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """The simulator's settings."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("episode_steps", self.episode_steps, 0)
        check_at_least("start_levels", self.start_levels, 1)
        if 0 < self.episode_steps < self.goal_period:
            raise ValueError(
                f"goal_period must be at most an episode of {self.episode_steps} steps, got {self.goal_period}."
            )
        if Path(self.robot).suffix.lower() == ".xml":
            advice = f"make a robot file of it with: deimos robot new {self.robot}"
            raise ValueError(f"robot must be a name or the path of a robot file, got '{self.robot}'; {advice}")
        if self.robot and not self._has_robot_file:  # a checkpoint omits the paths of files
            check_choice("robot", self.robot, [*plugins.names(robots), "or the path of a robot file (.toml)"])
        check_choice("engine", self.engine, ["auto", *engines.MODULES])
        check_choice("levels", self.levels, [rule.name.lower() for rule in LevelRule])
        for name, gain in self._gains().items():
            check_positive(name, gain, finite=True)
        for name in ("air_time_target", "payload", "push_interval", "push_speed"):
            check_range(name, getattr(self, name), 0, 1e6)
        check_weights("rewards", self.rewards)
        low, high = self.friction
        if not 0.05 <= low <= high < math.inf:
            raise ValueError(f"friction must be a range within [0.05, inf), got {self.friction}.")

    @property
    def files(self) -> dict[str, Path]:
        """See ``EnvConfig.files``: terrain and robot, unless they have names."""
        terrain_file = {} if self.terrain in ("flat", "rough") else {"terrain": Path(self.terrain).expanduser()}
        return terrain_file | ({"robot": Path(self.robot).expanduser()} if self._has_robot_file else {})

    def read_file(self, name: str) -> tuple[bytes, str]:
        """See ``EnvConfig.read_file``: a robot file takes its MJCF along."""
        return (robot_file.pack(self.files[name]), ".zip") if name == "robot" else super().read_file(name)

    @property
    def largest_reward(self) -> float:
        """See ``EnvConfig.largest_reward``: perfect tracking."""
        per_second = max(self.rewards.linear_tracking, 0.0) + max(self.rewards.yaw_tracking, 0.0)
        return per_second * self.physics.control_period

    def resolved(self, device: torch.device) -> "LocomotionConfig":
        """See ``EnvConfig.resolved``."""
        return replace(self, engine=engines.resolve(self.engine, device))

    def without_randomness(self) -> "LocomotionConfig":
        """See ``EnvConfig``. World i always stands on level (i // columns) % levels of column i % columns."""
        return replace(
            self, levels="frozen", friction=(1.0, 1.0), payload=0.0, push_interval=0.0, noise=False, stagger=False,
            episode_steps=0,
        )  # fmt: skip

    def make_robot(self) -> Robot:
        """The robot, in free space.

        Raises:
            ValueError: If its file is not a robot file, or its MJCF does not describe a robot.
        """
        if not self._has_robot_file:
            return plugins.load(robots, self.robot).build(**self._gains())
        with robot_file.opened(self.files["robot"]) as (robot, folder):
            return robot.build(folder, **self._gains())

    @property
    def _has_robot_file(self) -> bool:
        return Path(self.robot).suffix.lower() in robot_file.ENDINGS

    def _gains(self) -> dict[str, float]:
        """The gains that replace the robot's own."""
        gains = {name: getattr(self, name) for name in ("stiffness", "damping", "action_scale")}
        return {name: gain for name, gain in gains.items() if gain is not None}

    def load_terrain(self) -> Terrain | None:
        """The terrain; ``None`` for flat ground.

        Raises:
            ValueError: If there is no terrain of this name, or the file is not a terrain file.
        """
        if self.terrain == "flat":
            return None
        if self.terrain == "rough":
            return _rough()
        path = self.files["terrain"]
        makers = dict.fromkeys(importing.OPTIONS.keys() - {".npz"}, "import") | {".toml": "grid --file"}
        if maker := makers.get(path.suffix.lower()):
            advice = f"deimos terrain {maker} {path} --out {path.with_suffix('.npz')}"
            raise ValueError(f"terrain must be flat, rough or a terrain file, got '{path}'; convert it with: {advice}")
        if not path.is_file():
            raise ValueError(f"terrain must be flat, rough or the path of a terrain file, got '{self.terrain}'.")
        return terrain.load(path)


@lru_cache(maxsize=1)
def _rough() -> Terrain:
    """The terrain ``rough``: the same in every environment; it takes two seconds. Its arrays are read-only."""
    ground = terrain.rough()
    for array in (ground.heights, ground.origins):
        array.flags.writeable = False
    return ground


def check_weights(name: str, weights: Any) -> None:
    """Raise ``ValueError`` unless every weight of a reward is finite.

    Args:
        name: The field that holds them, for the message.
        weights: A dataclass of numbers.
    """
    for term, weight in asdict(weights).items():
        if not math.isfinite(weight):
            raise ValueError(f"{name}.{term} must be finite, got {weight}.")
