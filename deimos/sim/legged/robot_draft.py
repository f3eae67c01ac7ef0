"""Drafts a robot file from an MJCF: what the MJCF specifies, and guesses for the rest."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deimos.sim.legged import mjcf
from deimos.sim.legged.mjcf import Source
from deimos.sim.legged.robot_file import LEGS, Leg, RobotFile

if TYPE_CHECKING:
    import mujoco

CROUCH = 0.75  # of the largest height of the hips above the feet; a Go1 stands at 0.73
SAG = 0.1  # [rad] by which a joint gives way when the robot stands, as a Go1's
TIME_CONSTANT = 0.025  # [s], damping over stiffness; Legged Gym's A1
SOFT_LIMIT = 0.9  # share of a joint's range that poses stay within
RESERVE = 4.0  # ratio of the largest torque to that of standing
LEVEL = 0.01  # [m] above the lowest point of a leg that still counts as its foot
GRAVITY = 9.81  # [m/s^2]


def draft(path: Path, held: tuple[str, ...] = ()) -> tuple[RobotFile, list[str]]:
    """Draft a robot file, to be put next to the MJCF.

    Args:
        path: The MJCF.
        held: Joints to hold at zero.

    Returns:
        The robot, and notes on what was guessed or is odd, each with a way out.

    Raises:
        ValueError: If the MJCF does not describe a quadruped.
    """
    source = mjcf.read(path, held)
    chains = mjcf.find_legs(source)
    notes = list(source.notes)
    if source.has_keyframe:
        poses = [[source.pose[source.name(joint)] for joint in chain] for chain in chains]
    else:
        poses = [_guess_pose(source, chain) for chain in chains]
        notes.append("pose is a guess because the MJCF has no keyframe 'home': legs bent, feet below the hips")
    data = _posed(source, chains, poses)
    torques = np.max([_standing_torque(source, data, chain) for chain in chains], axis=0)
    servos, *others = [[source.servos[source.name(joint)] for joint in chain] for chain in chains]
    if any(leg != servos for leg in others):
        notes.append(
            "stiffness, damping and max_torque are the front left leg's, but the MJCF has others for other legs; write "
            "what suits all four"
        )
    stiffness, damping, max_torque = (
        [getattr(servo, key) for servo in servos] for key in ("stiffness", "damping", "max_torque")
    )
    if not all(stiffness):
        stiffness = [_rounded(max(torques) / SAG)] * 3
        notes.append(f"stiffness is a guess: joints give way by {SAG} rad when the robot stands")
    if not all(damping):
        damping = [_rounded(TIME_CONSTANT * value) for value in stiffness]
        notes.append(f"damping is a guess: {TIME_CONSTANT:g} s times the stiffness")
    if not all(max_torque):
        max_torque = [_rounded(RESERVE * max(torques))] * 3
        notes.append(f"max_torque is a guess, {RESERVE:g} times what standing takes; write what the motors can give")
    legs: dict[str, Any] = {
        name: Leg(joints=tuple(map(source.name, chain)), feet=_feet(source, data, chain), pose=tuple(pose))
        for name, chain, pose in zip(LEGS, chains, poses, strict=True)
    }
    return RobotFile(
        mjcf=path.name, stiffness=tuple(stiffness), damping=tuple(damping), max_torque=tuple(max_torque), held=held,
        **legs,
    ), notes  # fmt: skip


def _rounded(value: float) -> float:
    """A number rounded to two digits."""
    return float(f"{value:.2g}")


def _posed(source: Source, chains: list[list[int]], poses: list[list[float]]) -> "mujoco.MjData":
    """The robot in a pose, its base at the file's position but upright."""
    import mujoco

    model = source.model
    data = mujoco.MjData(model)
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    for chain, pose in zip(chains, poses, strict=True):
        data.qpos[model.jnt_qposadr[chain]] = pose
    mujoco.mj_forward(model, data)
    return data


def _guess_pose(source: Source, chain: list[int]) -> list[float]:
    """The hip near zero, the end of the leg below the thigh's joint at ``CROUCH``, the knee backwards if possible."""
    import mujoco

    model, (_, thigh, knee), end = source.model, chain, _end_geom(source, chain)
    data = mujoco.MjData(model)
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    low, high = model.jnt_range[chain].T
    middle, soft = (low + high) / 2, SOFT_LIMIT * (high - low) / 2
    low, high = middle - soft, middle + soft
    hip, height = float(np.clip(0.0, low[0], high[0])), 0.0
    best = middle[1:]
    for share in (1.0, 0.05):  # of the ranges: first everywhere, then around the best
        grid = best[:, None] + share * soft[1:, None] * np.linspace(-1.0, 1.0, 41)
        found = []
        for angles in itertools.product(*np.clip(grid, low[1:, None], high[1:, None])):
            data.qpos[model.jnt_qposadr[chain]] = hip, *angles
            mujoco.mj_kinematics(model, data)
            start, stop = data.xanchor[thigh], data.geom_xpos[end]
            found.append((start[2] - stop[2], stop[0] - start[0], data.xanchor[knee, 0] - start[0], *angles))
        drop, ahead, knee_ahead = np.array(found).T[:3]
        height = max(height, drop.max())
        error = np.hypot(drop - CROUCH * height, ahead) + 0.01 * np.maximum(knee_ahead, 0.0)
        best = np.array(found[error.argmin()][3:])
    return [round(float(angle), 2) for angle in (hip, *best)]


def _colliding(source: Source, chain: list[int]) -> np.ndarray:
    """The geoms that collide on the body that the leg's last joint moves.

    Raises:
        ValueError: If none collides.
    """
    model, body = source.model, source.model.jnt_bodyid[chain[-1]]
    hard = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(hard & (model.geom_bodyid == body))
    if not len(geoms):
        raise ValueError(
            f"body '{source.body_of(chain[-1])}' must have a geom that collides, its foot; give one a contype of 1."
        )
    return geoms


def _end_geom(source: Source, chain: list[int]) -> int:
    """The geom of the last body whose middle is farthest from the last joint."""
    geoms = _colliding(source, chain)
    away = source.model.geom_pos[geoms] - source.model.jnt_pos[chain[-1]]
    return int(geoms[np.linalg.norm(away, axis=1).argmax()])


def _feet(source: Source, data: "mujoco.MjData", chain: list[int]) -> tuple[str, ...]:
    """Names of the geoms that reach lowest."""
    geoms, model = _colliding(source, chain), source.model
    turned = data.geom_xmat[geoms].reshape(-1, 3, 3)[:, 2]
    middle = data.geom_xpos[geoms, 2] + (turned * model.geom_aabb[geoms, :3]).sum(axis=1)
    lowest = middle - np.array([_half_height(model, geom, row) for geom, row in zip(geoms, turned, strict=True)])
    return tuple(model.geom(geom).name for geom in geoms[lowest < lowest.min() + LEVEL])


def _half_height(model: "mujoco.MjModel", geom: int, row: np.ndarray) -> float:
    """How far a geom reaches below its middle [m]; that of its box except for spheres and capsules."""
    import mujoco

    kinds = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
    if model.geom_type[geom] not in kinds:
        return float(np.abs(row) @ model.geom_aabb[geom, 3:])
    radius = model.geom_size[geom, 0]
    return float(radius + abs(row[2]) * (model.geom_aabb[geom, 5] - radius))


def _standing_torque(source: Source, data: "mujoco.MjData", chain: list[int]) -> np.ndarray:
    """Torques of a leg's joints that carry a quarter of the robot's weight [N m], shape (3,)."""
    import mujoco

    model = source.model
    place, jacobian = data.geom_xpos[_end_geom(source, chain)], np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, place, model.jnt_bodyid[chain[-1]])
    weight = GRAVITY * model.body_subtreemass[source.base]
    return np.abs(jacobian[2, model.jnt_dofadr[chain]]) * weight / 4
