"""What a deployment needs of a legged robot besides its policy: the model, its numbers, and how it walked here."""

import ctypes
import itertools
import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from deimos.checks import RunError
from deimos.kernels.legged.arm import SEEN_BOUND
from deimos.kernels.legged.arm_goals import FOOTPRINT, SHELL_HIGH, SHELL_LOW
from deimos.kernels.legged.rewards import TRACKING_VARIANCE
from deimos.kernels.legged.state import CRASH_FORCE, HEIGHT_BOUND
from deimos.nn.layout import goal_field
from deimos.sim.legged.engines.model import build_spec
from deimos.sim.legged.robots import Arm
from deimos.sim.legged.task import Locomotion

if TYPE_CHECKING:
    import mujoco

GROUND = "ground.bin"
DIGITS = 17  # significant ones, enough to distinguish any two numbers of double precision
SOURCES = {
    "linear_velocity": "velocity of the base in its own frame; a state estimator",
    "angular_velocity": "rate of the base in its own frame; a gyroscope",
    "gravity": "direction of gravity in the base's frame, a unit vector; an inertial measurement unit",
    "goal": "what the robot is asked for",
    "joint_position": "angles minus default_position, in the order of robot.joints; encoders",
    "joint_velocity": "in the order of robot.joints; encoders",
    "last_action": "the last action, within action.low and action.high",
    "end_effector": "where it is, expressed like the arm's part of a goal; forward kinematics and the base's height",
    "heights": "base minus standing_height minus ground, at robot.heights.points in the frame of the yaw; a height map",
}
"""What every entry of a robot's observation is, and what measures it."""
CLIPS = {"heights": HEIGHT_BOUND, "end_effector": SEEN_BOUND}
"""Symmetric bounds of entries of the observation, in their units."""


def write_model(env: Locomotion, folder: Path) -> None:
    """Write ``robot.xml``, the robot on its ground as MJCF, and the ground's samples where it is not flat.

    Raises:
        RunError: If what MuJoCo reads from it is not, number for number, what the run simulates.
    """
    import mujoco

    spec = build_spec(env.robot, env.physics.terrain, env.config.physics, visual=True)
    for foot in itertools.chain.from_iterable(env.robot.parts[1:5]):
        spec.geom(foot).friction[0] = env.config.friction[0]  # worlds without randomness use this, not the robot's own
    wanted = spec.compile()
    for field in spec.hfields:  # in the XML itself it would be some fifty megabytes
        data = np.asarray(field.userdata, np.float32)
        contents = np.array([field.nrow, field.ncol], np.int32).tobytes() + data.tobytes()
        (folder / GROUND).write_bytes(contents)
        field.userdata, field.nrow, field.ncol, field.file, spec.assets = [], 0, 0, GROUND, {GROUND: contents}
    spec.compile()
    path = folder / "robot.xml"
    path.write_text(_to_xml(spec), encoding="utf-8")
    found = mujoco.MjModel.from_xml_path(str(path))
    there, here = _numbers(found), _numbers(wanted)
    if different := [name for name in here if not np.array_equal(here[name], there[name])]:
        raise RunError(
            f"MuJoCo {mujoco.__version__} writes a model that differs from this robot's in "
            f"{', '.join(different)}; export with MuJoCo 4.0."
        )


def _to_xml(spec: "mujoco.MjSpec") -> str:
    """The model as MJCF with all digits, if this MuJoCo can write them: by default it writes six."""
    import mujoco

    home = Path(mujoco.__file__).parent  # with libmujoco.so.X, libmujoco.X.dylib or mujoco.dll
    libraries = [ctypes.CDLL(str(path)) for path in home.iterdir() if re.match(r"(lib)?mujoco\.", path.name)]
    named = [f"_mjPRIVATE__{verb}_xml_precision" for verb in ("set", "get")]  # not a public interface
    change, ask = (next((getattr(each, name, None) for each in libraries), None) for name in named)
    if change is None or ask is None:
        return spec.to_xml()
    before = ask()
    change(DIGITS)
    try:
        return spec.to_xml()
    finally:
        change(before)


def _numbers(model: "mujoco.MjModel") -> dict[str, np.ndarray]:
    """A model's arrays that physics depends on, by name: all except appearance and the addresses of texts.

    Visual geoms are appearance too: MuJoCo centres meshes on their own middle, and writes the resulting positions of
    their geoms with a different last bit.
    """
    looks = ("vis", "mat_", "tex_", "light_", "cam_", "geom_rgba", "site_rgba", "name", "paths", "text_")
    arrays = {
        name: getattr(model, name) for name in dir(model)
        if not name.startswith(("_", *looks)) and not name.endswith("pathadr")
        and isinstance(getattr(model, name), np.ndarray)
    }  # fmt: skip
    hard = (model.geom_contype | model.geom_conaffinity) != 0
    return {name: array[hard] if name.startswith("geom_") else array for name, array in arrays.items()}


def describe_robot(env: Locomotion) -> dict[str, Any]:
    """The entry ``robot`` of ``deploy.json``."""
    robot, physics = env.robot, env.config.physics
    return {
        "model": "robot.xml", "timestep": physics.timestep, "substeps": physics.substeps,
        "joints": [
            {
                "name": joint.name, "default_position": joint.pose, "action_scale": joint.action_scale,
                "range": list(joint.range), "stiffness": joint.stiffness, "damping": joint.damping,
                "max_torque": joint.max_torque,
            }
            for joint in robot.joints
        ],
        "units": {
            "default_position": "rad", "action_scale": "rad", "range": "rad", "stiffness": "N m/rad",
            "damping": "N m s/rad", "max_torque": "N m",
        },
        "base_geoms": list(robot.parts[0]), "crash_force": CRASH_FORCE, "standing_height": robot.standing_height,
        "tracking_variance": TRACKING_VARIANCE,
        "heights": {"points": env.points.tolist()},
        "arm": _describe_arm(robot.arm, robot.standing_height) if len(env.parts) > 1 and robot.arm else None,
    }  # fmt: skip


def _describe_arm(arm: Arm, standing_height: float) -> dict[str, Any]:
    """Where the end effector is and where its goals are; see ``deimos.kernels.legged.arm_goals``."""
    x, y, z = arm.shoulder
    along, across = np.meshgrid(*(np.array(side) * np.array([-0.5, 0.0, 0.5]) for side in FOOTPRINT), indexing="ij")
    kinematics = {name: value for name, value in asdict(arm).items() if name in ("offsets", "axes")}
    return kinematics | {
        "origin": [x, y, z + standing_height], "shell_low": list(SHELL_LOW), "shell_high": list(SHELL_HIGH),
        "ground_points": np.stack([along.ravel(), across.ravel()], axis=1).tolist(),
    }  # fmt: skip


class Walk:
    """How robots of an environment walk from where they are, for the check of an export; goals must not change.

    Args:
        env: The robots, just built.
    """

    def __init__(self, env: Locomotion) -> None:
        scale = torch.tensor(goal_field(env.layout).scale, dtype=torch.float64)
        self._start = {name: env.tensors[name].clone() for name in ("qpos", "qvel")}
        self._start["goal"] = env.goal.double() / scale
        self._env = env
        self._fell, self._left = torch.zeros(2, env.num_envs, dtype=torch.bool)
        self._steps = torch.zeros(env.num_envs, dtype=torch.int64)
        self._met = torch.zeros(env.num_envs, len(env.goal_groups), dtype=torch.float64)

    def note(self, terminated: Tensor, truncated: Tensor, tracking: Tensor) -> None:
        """Take note of a step; see ``Step``. Robots off the terrain no longer count, fallen ones track nothing."""
        self._left |= truncated & ~terminated
        self._fell |= terminated & ~self._left
        self._steps += ~self._left
        self._met += tracking.double() * ~(self._fell | self._left).unsqueeze(1)

    def facts(self) -> dict[str, np.ndarray]:
        """What the check compares with, by name."""
        tracking = self._met / self._steps.clamp(min=1).unsqueeze(1)
        found = self._start | {"fell": self._fell, "steps": self._steps, "tracking": tracking}
        return {f"walk.{name}": value.numpy() for name, value in found.items()}
