"""A robot from one data file: a TOML file with what an MJCF lacks.

``--env.robot FILE.toml`` takes it. It names the MJCF, the gains, and the joints, foot and pose of every leg;
``deimos robot new`` writes one to start from.
"""

import dataclasses
import io
import itertools
import os
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deimos.checks import check_positive, one_line
from deimos.files import UNREADABLE
from deimos.sim.legged import mjcf
from deimos.sim.legged.robots import Joint, Robot
from deimos.sim.legged.robots._primitives import add_actuators

if TYPE_CHECKING:
    import mujoco

ENDINGS = (".toml", ".zip")
"""Endings of a robot file; the second is a run's copy: a file of the first kind with the MJCF and all its files."""
LEGS = ("front_left", "front_right", "rear_left", "rear_right")
FACTORS = np.linspace(0.5, 1.5, 7)  # of the pose's angles, between which a reset draws
CLEARANCE = 0.02  # [m] between the lowest foot and the ground at a reset


@dataclass(frozen=True, kw_only=True)
class Leg:
    """A leg."""

    joints: tuple[str, ...]
    """Names of its three hinges, hip first."""
    feet: tuple[str, ...]
    """Names of the geoms that it stands on, at least one; other geoms of the leg should not touch the ground."""
    pose: tuple[float, ...]
    """Angle of every joint at an action of zero [rad]; the robot must stand in it."""


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """A robot as its file describes it. In the file, a single number stands for every joint of a leg."""

    mjcf: str
    """Path of the MJCF, relative to the folder of this file."""
    stiffness: tuple[float, ...]
    """Position gain of the three joints of a leg [N m/rad], positive."""
    damping: tuple[float, ...]
    """Velocity gain of the three joints of a leg [N m s/rad], positive."""
    max_torque: tuple[float, ...]
    """Largest torque of the three joints of a leg [N m], positive."""
    action_scale: tuple[float, ...] = (0.25, 0.25, 0.25)
    """What an action of 1 adds to the target angles of a leg [rad], positive."""
    held: tuple[str, ...] = ()
    """Joints that are held at zero: of a head, a tail, an arm."""
    front_left: Leg
    front_right: Leg
    rear_left: Leg
    rear_right: Leg

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping", "max_torque", "action_scale"):
            for value in getattr(self, name):
                check_positive(name, value, finite=True)

    @property
    def legs(self) -> tuple[Leg, ...]:
        """The legs, in the order of ``LEGS``."""
        return tuple(getattr(self, name) for name in LEGS)

    def build(
        self, folder: Path, *, stiffness: float | None = None, damping: float | None = None,
        action_scale: float | None = None,
    ) -> Robot:  # fmt: skip
        """The robot, in free space.

        Args:
            folder: The folder that paths are relative to.
            stiffness: Replaces the file's own, for every joint [N m/rad].
            damping: Replaces the file's own, for every joint [N m s/rad].
            action_scale: Replaces the file's own, for every joint [rad].

        Raises:
            ValueError: If the MJCF cannot be used, or lacks what the file names.
        """
        source = mjcf.read(folder / self.mjcf, self.held)
        legs = mjcf.find_legs(source)
        self._require_joints(source.model, [[source.name(joint) for joint in leg] for leg in legs])
        spec, pieces = mjcf.copy(source, legs)
        gains = {"stiffness": stiffness, "damping": damping, "action_scale": action_scale}
        joints = tuple(
            Joint(
                name=name, pose=leg.pose[i], range=tuple(source.model.joint(name).range.tolist()),
                max_torque=self.max_torque[i],
                **{key: getattr(self, key)[i] if gain is None else gain for key, gain in gains.items()},
            )
            for leg in self.legs for i, name in enumerate(leg.joints)
        )  # fmt: skip
        add_actuators(spec, joints)
        parts = self._parts(spec, pieces)
        spec.worldbody.first_body().pos = (0.0, 0.0, 0.0)
        standing, spawn, reach = _measure(spec, joints, parts)
        spec.worldbody.first_body().pos = (0.0, 0.0, standing)
        return Robot(
            spec=spec, joints=joints, parts=parts, standing_height=standing, spawn_height=spawn, reach=reach
        )  # fmt: skip

    def _require_joints(self, model: "mujoco.MjModel", found: list[list[str]]) -> None:
        for name, leg, joints in zip(LEGS, self.legs, found, strict=True):
            if list(leg.joints) != joints:
                raise ValueError(f"{name}.joints must be {joints}, as in the MJCF, got {list(leg.joints)}.")
            for joint, angle in zip(joints, leg.pose, strict=True):
                low, high = model.joint(joint).range
                if not low < angle < high:
                    raise ValueError(f"{name}.pose of '{joint}' must be within ({low:g}, {high:g}) rad, got {angle:g}.")

    def _parts(
        self, spec: "mujoco.MjSpec", pieces: dict[str, list[tuple[str, str]]]
    ) -> tuple[tuple[str, ...], ...]:  # fmt: skip
        """See ``Robot.parts``: base and hips, then feet, then thighs and calves, leg by leg."""
        base, feet, limbs = [piece for _, piece in next(iter(pieces.values()))], [], []
        for name, leg in zip(LEGS, self.legs, strict=True):
            bodies = dict.fromkeys(spec.joint(joint).parent.name for joint in leg.joints)
            hip, thigh, calf = (spec.joint(joint).parent.name for joint in leg.joints)
            there = {geom for body in bodies for geom, _ in pieces[body]}
            if missing := [foot for foot in leg.feet if foot not in there]:
                raise ValueError(
                    f"{name}.feet must name geoms that collide on {', '.join(bodies)}, which have "
                    f"{', '.join(sorted(there)) or 'none'}, got '{missing[0]}'."
                )
            if not leg.feet:
                raise ValueError(f"{name}.feet must name at least one geom of {', '.join(sorted(there))}.")
            feet.append(tuple(piece for body in bodies for geom, piece in pieces[body] if geom in leg.feet))
            rest = {body: [piece for geom, piece in pieces[body] if geom not in leg.feet] for body in bodies}
            base += rest.pop(hip) if hip != thigh else []
            limbs += [tuple(rest.pop(thigh)), tuple(rest.pop(calf, ()))]
        for foot in itertools.chain.from_iterable(feet):
            geom = spec.geom(foot)
            geom.condim, geom.priority = 3, 1  # its own friction counts, not the larger of the two
        return (tuple(base), *feet, *limbs)


@contextmanager
def opened(path: Path) -> Iterator[tuple[RobotFile, Path]]:
    """Read a robot file; yield it and the folder that its paths are relative to, which may be gone afterwards.

    Raises:
        ValueError: If there is no such file, or it is not a robot file.
    """
    if not path.is_file():
        raise ValueError(f"robot must be a name or a robot file, but there is no {path}.")
    if path.suffix.lower() == ".toml":
        yield _parse(path, path.read_bytes()), path.parent
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder)
            text = (Path(folder) / "robot.toml").read_bytes()
        except UNREADABLE as error:
            raise ValueError(f"{path} is not a run's copy of a robot: {one_line(error)}.") from error
        yield _parse(path, text), Path(folder)


def pack(path: Path) -> bytes:
    """A robot file with its MJCF and everything that it includes, in one archive: what a run keeps.

    Raises:
        ValueError: If the MJCF names a file by an absolute path, which would be missing after the run is moved.
    """
    import mujoco

    if path.suffix.lower() == ".zip":
        return path.read_bytes()
    with opened(path) as (robot, folder):
        model = (folder / robot.mjcf).resolve()
        files = [Path(name).resolve() for name in mujoco.mju_getXMLDependencies(str(model))]
    files = sorted({model, *files})
    top = Path(os.path.commonpath([file.parent for file in files]))
    kept = dataclasses.replace(robot, mjcf=model.relative_to(top).as_posix())
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in [
            ("robot.toml", to_toml(kept).encode()),
            *((file.relative_to(top).as_posix(), file.read_bytes()) for file in files),
        ]:
            archive.writestr(zipfile.ZipInfo(name), data)  # without a time or compression: the same bytes everywhere
    _require_whole(buffer, kept)
    return buffer.getvalue()


def _require_whole(packed: io.BytesIO, robot: RobotFile) -> None:
    """Raise ``ValueError`` if the archive, unpacked elsewhere, still reads files from outside."""
    import mujoco

    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed) as archive:
        archive.extractall(folder)
        home = Path(folder).resolve()
        files = [Path(name).resolve() for name in mujoco.mju_getXMLDependencies(str(home / robot.mjcf))]
    if left := sorted(file for file in files if home not in file.parents):
        raise ValueError(
            f"mjcf must name its files by relative paths, so that a run can keep them, but it names {left[0]}."
        )


def to_toml(robot: RobotFile) -> str:
    """A robot file's text, with comments on its values."""
    lines = [f"mjcf = {_spell(robot.mjcf)}"]
    for name, unit in (
        ("stiffness", "N m/rad"), ("damping", "N m s/rad"), ("max_torque", "N m"), ("action_scale", "rad"),
    ):  # fmt: skip
        lines.append(f"{name} = {_spell(getattr(robot, name))}  # [{unit}] of hip, thigh and calf")
    lines.append(f"held = {_spell(robot.held)}  # joints that stay at zero")
    for name, leg in zip(LEGS, robot.legs, strict=True):
        lines += ["", f"[{name}]", f"joints = {_spell(leg.joints)}", f"feet = {_spell(leg.feet)}"]
        lines.append(f"pose = {_spell(leg.pose)}  # [rad]")
    return "\n".join(lines) + "\n"


def _spell(value: Any) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(_spell, value))}]"
    return repr(float(value))


def _parse(path: Path, data: bytes) -> RobotFile:
    try:
        table = tomllib.loads(data.decode())
        known = [field.name for field in dataclasses.fields(RobotFile)]
        _require_keys("it", table, known, ["mjcf", "stiffness", "damping", "max_torque", *LEGS])
        values: dict[str, Any] = {name: _read_leg(name, table[name]) for name in LEGS}
        if not isinstance(table["mjcf"], str):
            raise ValueError(f"mjcf must be the path of a file, got {table['mjcf']!r}")
        values |= {"mjcf": table["mjcf"], "held": _names("held", table.get("held", []), None)}
        for name in ("stiffness", "damping", "max_torque", "action_scale"):
            if name in table:
                values[name] = _numbers(name, table[name])
        return RobotFile(**values)
    except ValueError as error:  # also those of TOML and of its encoding
        raise ValueError(f"{path}: {one_line(error).rstrip('.')}.") from error


def _require_keys(what: str, table: Any, known: list[str], needed: list[str]) -> None:
    if not isinstance(table, dict):
        raise ValueError(f"{what} must be a table, got {table!r}")
    if unknown := sorted(set(table) - set(known)):
        raise ValueError(f"{what} has '{unknown[0]}', but may have only {', '.join(known)}")
    if missing := [name for name in needed if name not in table]:
        raise ValueError(f"{what} lacks {', '.join(missing)}; deimos robot new MODEL.xml writes a file to start from")


def _read_leg(name: str, table: Any) -> Leg:
    fields = ["joints", "feet", "pose"]
    _require_keys(f"[{name}]", table, fields, fields)
    return Leg(
        joints=_names(f"{name}.joints", table["joints"], 3), feet=_names(f"{name}.feet", table["feet"], None),
        pose=_numbers(f"{name}.pose", table["pose"], spread=False),
    )  # fmt: skip


def _names(name: str, value: Any, count: int | None) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not all(isinstance(each, str) for each in names):
        raise ValueError(f"{name} must be a list of names, got {value!r}")
    if count is not None and len(names) != count:
        raise ValueError(f"{name} must be {count} names, got {value!r}")
    return tuple(names)


def _numbers(name: str, value: Any, *, spread: bool = True) -> tuple[float, ...]:
    """Three numbers; with ``spread``, a single one stands for three."""
    numbers = value if isinstance(value, list) else [value] * (3 if spread else 1)
    is_number = [isinstance(each, int | float) and not isinstance(each, bool) for each in numbers]
    if len(numbers) != 3 or not all(is_number):
        raise ValueError(f"{name} must be {'a number or ' if spread else ''}three numbers, got {value!r}")
    return tuple(map(float, numbers))


def _measure(
    spec: "mujoco.MjSpec", joints: tuple[Joint, ...], parts: tuple[tuple[str, ...], ...]
) -> tuple[float, float, float]:
    """Standing height, spawn height and reach of a ``Robot``, from its legs in the pose and at a reset [m]."""
    import mujoco

    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    feet = [model.geom(name).id for foot in parts[1:5] for name in foot]
    legs = feet + [model.geom(name).id for limb in parts[5:] for name in limb]
    pose, (low, high) = np.array([joint.pose for joint in joints]), np.array([joint.range for joint in joints]).T

    def place(angles: np.ndarray, geoms: list[int]) -> tuple[float, float]:
        data.qpos[7:] = angles
        mujoco.mj_kinematics(model, data)
        lowest, farthest = _extent(model, data, geoms)
        return lowest, farthest

    standing = -place(pose, feet)[0]
    # Legs are independent of each other: all four take the same angles at once.
    found = [
        place(np.clip(pose * np.tile(factors, 4), low, high), legs) for factors in itertools.product(FACTORS, repeat=3)
    ]
    lowest, reach = min(low for low, _ in found), max(far for _, far in found)
    return standing, CLEARANCE - lowest, reach


def _extent(model: "mujoco.MjModel", data: "mujoco.MjData", geoms: list[int]) -> tuple[float, float]:
    """Lowest z of spheres and capsules, and their largest |x| or |y| [m]."""
    import mujoco

    radius = model.geom_size[geoms, 0]
    is_capsule = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_CAPSULE
    axis = np.abs(data.geom_xmat[geoms].reshape(-1, 3, 3)[:, :, 2]) * (model.geom_size[geoms, 1] * is_capsule)[:, None]
    centre, far = data.geom_xpos[geoms], axis + radius[:, None]
    return float((centre - far)[:, 2].min()), float((np.abs(centre) + far)[:, :2].max())
