"""Checks a robot's model and how it stands for two seconds: what is missing or odd, with a way out for each."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from deimos.sim.legged import engines
from deimos.sim.legged.engines import Physics, PhysicsConfig
from deimos.sim.legged.robots import Robot

if TYPE_CHECKING:
    import mujoco

LEGS = ("front left", "front right", "rear left", "rear right")
PARTS = ("hip", "thigh", "calf")
SECONDS = 2.0  # that the robot must stand
DROP = 0.005  # [m] above the ground that it starts at
SETTLED = 0.5  # [s] at the end, over which means are taken
LOWEST, STEEPEST = 0.7, 0.35  # share of its height, and tilt [rad], beyond which the robot has fallen
SLIDE, SWAY = 0.04, 0.5  # [m] and [rad/s], beyond which it slides or trembles; a Go1 creeps by 0.02 m
SAG, USE = 0.3, 0.7  # [rad], and share of the largest torque, beyond which standing takes too much
SOFT_LIMIT = 0.9  # share of a joint's range, beyond which the task's reward has a penalty
SMALLEST, LARGEST = 2.0, 100.0  # [kg]; the task's numbers have not been tried on other robots
PAYLOAD = 0.25  # share of the base's mass that the task's payload of 1 kg should not exceed


@dataclass(frozen=True)
class Standing:
    """How a robot stood."""

    height: float
    """Of the base, relative to its standing height."""
    tilt: float
    """Of the base [rad]."""
    slide: float
    """Distance of the base over the ground since it settled [m]."""
    speed: float
    """Largest root mean square of a joint's speed since it settled [rad/s]."""
    sag: np.ndarray
    """Angle of every joint minus its target, at the end [rad], shape (num_joints,)."""
    torque: np.ndarray
    """Mean size of every joint's torque since it settled [N m], shape (num_joints,)."""
    force: np.ndarray
    """Mean normal force of every part since it settled [N], shape (num_parts,)."""


@dataclass(frozen=True)
class Report:
    """Findings about a robot."""

    standing: Standing
    faults: tuple[str, ...]
    """What keeps the robot from being trained."""
    oddities: tuple[str, ...]
    """What may be intended."""
    physics: Physics
    """The world in which it stood, as it is at the end."""


def check_robot(robot: Robot, engine: engines.Name = "native") -> Report:
    """Check a robot.

    Args:
        robot: The robot.
        engine: What simulates it, on the CPU.

    Raises:
        ValueError: If the engine cannot simulate it.
    """
    physics = engines.build(engine, robot, None, 1, torch.device("cpu"), PhysicsConfig())
    model = physics.model
    standing = stand(robot, physics)
    faults = [*_check_geoms(robot, model), *_check_standing(robot, standing)]
    oddities = [*_check_masses(model), *_check_parts(robot, model), *_check_joints(robot, standing)]
    if not faults:
        oddities += judge_feet(standing)
    return Report(standing, tuple(faults), tuple(oddities), physics)


def stand(robot: Robot, physics: Physics) -> Standing:
    """Let a robot stand in its pose on a plane, in the one world of ``physics``, for ``SECONDS``."""
    joints = len(robot.joints)
    pose = np.array(robot.pose, np.float32)
    physics.arrays.qpos.assign([[0.0, 0.0, robot.standing_height + DROP, 1.0, 0.0, 0.0, 0.0, *pose]])
    physics.arrays.qvel.zero_()
    physics.arrays.ctrl.assign([pose])
    steps, settled = (round(time / physics.config.control_period) for time in (SECONDS, SETTLED))
    speeds, torques, forces, begin = [], [], [], np.zeros(2)
    for step in range(steps):
        physics.step()
        if step == steps - settled:
            begin = physics.arrays.qpos.numpy()[0, :2].copy()
        if step >= steps - settled:
            speeds.append(physics.arrays.qvel.numpy()[0, 6:].copy())
            torques.append(np.abs(physics.arrays.torque.numpy()[0, :joints]))
            forces.append(physics.arrays.part_force.numpy().mean(axis=0)[0])
    qpos = physics.arrays.qpos.numpy()[0].astype(float)
    up = 1.0 - 2.0 * (qpos[4] ** 2 + qpos[5] ** 2)  # of the base's vertical axis
    return Standing(
        height=float(qpos[2] / robot.standing_height), tilt=math.acos(np.clip(up, -1.0, 1.0)),
        slide=float(np.linalg.norm(qpos[:2] - begin)), speed=float(np.sqrt(np.square(speeds).mean(axis=0)).max()),
        sag=qpos[7:] - pose, torque=np.mean(torques, axis=0), force=np.mean(forces, axis=0),
    )  # fmt: skip


def _check_geoms(robot: Robot, model: "mujoco.MjModel") -> list[str]:
    """What must collide but does not."""
    base = model.body(model.jnt_bodyid[0]).name
    on_base = [name for name in robot.parts[0] if model.body(model.geom(name).bodyid[0]).name == base]
    return [] if on_base else [
        f"base '{base}' does not collide, so a fall is not a crash; give it a geom with a contype of 1"
    ]  # fmt: skip


def _check_standing(robot: Robot, standing: Standing) -> list[str]:
    """A fault if the robot does not stand at all."""
    if not math.isfinite(standing.height):
        return ["the simulation of standing is not finite; lower stiffness or damping, or raise the joints' armature"]
    fallen = standing.height < LOWEST or standing.tilt > STEEPEST or standing.force[0] > 1.0
    if not fallen:
        return []
    weakest = int(np.abs(standing.sag).argmax())
    joint = robot.joints[weakest]
    return [
        f"it falls from its pose: after {SECONDS:g} s its base is at {standing.height:.0%} of its height, tilted by "
        f"{math.degrees(standing.tilt):.0f} degrees, and '{joint.name}' is {standing.sag[weakest]:+.2f} rad from its "
        f"target at {standing.torque[weakest]:.1f} of {joint.max_torque:g} N m; raise stiffness or max_torque, or bend "
        "the legs so that the feet are below the body"
    ]


def _check_masses(model: "mujoco.MjModel") -> list[str]:
    base = model.jnt_bodyid[0]
    total, own, found = model.body_subtreemass[base], model.body_mass[base], []
    if not SMALLEST <= total <= LARGEST:
        found.append(f"it weighs {total:.3g} kg; the task is made for {SMALLEST:g} to {LARGEST:g} kg")
    if own < 1.0 / PAYLOAD:
        found.append(
            f"base '{model.body(base).name}' weighs {own:.3g} kg, but the payload in training is up to 1 kg; use "
            f"--env.payload {PAYLOAD * own:.2g}"
        )
    return found


def _check_parts(robot: Robot, model: "mujoco.MjModel") -> list[str]:
    """Hips and limbs that do not collide."""
    found, bodies = [], [model.geom(name).bodyid[0] for name in robot.parts[0]]
    for i, leg in enumerate(LEGS):
        hip, thigh = (model.jnt_bodyid[model.joint(robot.joints[3 * i + part].name).id] for part in (0, 1))
        if hip not in bodies and hip != thigh:
            found.append(
                f"hip '{model.body(hip).name}' ({leg}) does not collide: a robot on its side may rest on its legs and "
                "not count as crashed; give it a geom with a contype of 1"
            )
        if not any(robot.parts[5 + 2 * i : 7 + 2 * i]):
            found.append(f"{leg}: neither thigh nor calf collides, so they pass through the ground unnoticed")
    return found


def _check_joints(robot: Robot, standing: Standing) -> list[str]:
    """Angles and torques near their limits, joints that give way or tremble."""
    found = []
    for i, joint in enumerate(robot.joints):
        middle, half = sum(joint.range) / 2, (joint.range[1] - joint.range[0]) / 2
        if abs(joint.pose - middle) > SOFT_LIMIT * half:
            found.append(
                f"pose of '{joint.name}', {joint.pose:g} rad, is in the outer tenth of its range "
                f"({joint.range[0]:g}, {joint.range[1]:g}), which costs reward; move it inwards"
            )
        if standing.torque[i] > USE * joint.max_torque:
            found.append(
                f"standing takes {standing.torque[i]:.1f} of the {joint.max_torque:g} N m of '{joint.name}'; raise "
                "max_torque if the motor can give more, or choose a pose that takes less"
            )
        elif abs(standing.sag[i]) > SAG:
            found.append(
                f"'{joint.name}' gives way by {standing.sag[i]:+.2f} rad when the robot stands; raise stiffness"
            )
    if standing.speed > SWAY:
        found.append(f"joints tremble at {standing.speed:.1f} rad/s; lower stiffness, or raise damping or armature")
    return found


def judge_feet(standing: Standing) -> list[str]:
    """Oddities of the feet of a robot that stands."""
    found = [
        f"the {leg} foot is off the ground when the robot stands; make its leg's pose as long as the others'"
        for leg, force in zip(LEGS, standing.force[1:5], strict=True) if force < 1.0
    ]  # fmt: skip
    names = [f"{leg} {part}" for leg in LEGS for part in PARTS[1:]]
    found += [
        f"the {name} touches the ground when the robot stands; name its geom as a foot, or change the pose"
        for name, force in zip(names, standing.force[5:], strict=True) if force > 1.0
    ]  # fmt: skip
    if standing.slide > SLIDE:
        found.append(f"it slides by {100 * standing.slide:.0f} cm in {SETTLED:g} s; put its feet below its hips")
    return found
