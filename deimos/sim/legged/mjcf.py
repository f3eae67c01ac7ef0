"""Reads a robot from an MJCF, with any names and order, and copies it in the form that the simulation needs.

MuJoCo compiles the file, with its classes, includes, meshes and keyframes; what the simulation needs is then rebuilt
from the compiled numbers: the base, its legs in the order of ``Robot``, and spheres and capsules for what collides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deimos.checks import one_line
from deimos.sim.legged.capsules import Piece, fill
from deimos.sim.legged.robots import ROBOT_BIT, TERRAIN_BIT, VISUAL_GROUP
from deimos.sim.legged.robots._primitives import add_collision

if TYPE_CHECKING:
    import mujoco

STANDING = ("home", "stand", "standing")  # names of keyframes of a standing robot
DARK = (0.25, 0.27, 0.3, 1.0)


@dataclass(frozen=True, kw_only=True)
class Servo:
    """The actuators of a joint in an MJCF; 0 for what it does not specify."""

    stiffness: float = 0.0
    """[N m/rad]."""
    damping: float = 0.0
    """[N m s/rad]."""
    max_torque: float = 0.0
    """[N m]."""
    armature: float = field(default=0.0, compare=False)
    """What they add to the joint's own [kg m^2]."""
    drag: tuple[float, ...] = field(default=(0.0, 0.0, 0.0), compare=False)
    """What they add to the joint's own damping, which no torque limit clips: MuJoCo's polynomial."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """An MJCF as it was read: everything has a name, held joints are gone, bodies that do not move are merged."""

    model: "mujoco.MjModel"
    base: int
    """Body of the free joint."""
    servos: dict[str, Servo]
    """By joint."""
    pose: dict[str, float]
    """Angle of every joint in a keyframe of the standing robot, or as the file shows it [rad]."""
    has_keyframe: bool
    """Whether the pose is that of a keyframe."""
    notes: tuple[str, ...]
    """Oddities of the file, each with a way out, and what is left out."""

    def name(self, joint: int) -> str:
        """Name of a joint."""
        return self.model.joint(joint).name

    def body_of(self, joint: int) -> str:
        """Name of the body that a joint moves."""
        return self.model.body(self.model.jnt_bodyid[joint]).name


def read(path: Path, held: Sequence[str] = ()) -> Source:
    """Read an MJCF.

    Args:
        path: The file.
        held: Joints to hold at zero, as if the file did not have them.

    Raises:
        ValueError: If MuJoCo cannot read it, or it is not a robot with a floating base.
    """
    import mujoco

    if not path.is_file():
        raise ValueError(f"mjcf must be an MJCF file, but there is no {path}.")
    if path.suffix.lower() == ".urdf":
        raise ValueError(
            f"mjcf must be an MJCF file, got {path}; convert it in Python: import mujoco; "
            f"s = mujoco.MjSpec.from_file('{path}'); s.compiler.fusestatic = False; "
            "s.worldbody.first_body().add_freejoint(); s.compile(); print(s.to_xml())"
        )
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        _name_all(spec)
        whole = spec.compile()
    except ValueError as error:
        raise ValueError(f"mjcf must be a file that MuJoCo loads, but {path} fails: {one_line(error)}") from error
    base = _find_base(path, whole)
    _refuse_couplings(path, whole)
    notes = [*_weighing_visuals(spec, whole), *_left_out(whole, held)]
    for name in held:
        if spec.joint(name) is None:
            raise ValueError(f"held must name joints of {path}, which has no '{name}'.")
        if spec.joint(name).type == mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"held must name joints of a head, tail or arm, but '{name}' is the base's free joint.")
        spec.delete(spec.joint(name))
    for things in (spec.keys, spec.sensors, spec.actuators, spec.excludes, spec.pairs):
        for thing in list(things):
            spec.delete(thing)
    spec.fuse_static()
    model = spec.compile()
    key = _standing_keyframe(whole)
    angles = whole.qpos0 if key is None else whole.key_qpos[key]
    return Source(
        model=model, base=model.body(base).id, servos=_servos(whole),
        pose={whole.joint(j).name: float(angles[whole.jnt_qposadr[j]]) for j in range(whole.njnt)},
        has_keyframe=key is not None, notes=tuple(notes),
    )  # fmt: skip


def find_legs(source: Source) -> list[list[int]]:
    """The joints of four legs from hip to foot, front left, front right, rear left, rear right.

    The positions of the hips tell which leg is which: x points to the front, y to the left.

    Raises:
        ValueError: If the robot is not four legs of three hinges each, with nothing else that moves.
    """
    model, base = source.model, source.base
    chains = [_chain(source, leaf) for leaf in _leaves(model, base)]
    if len(chains) != 4 or any(len(chain) != 3 for chain in chains):
        found = "; ".join(" ".join(map(source.name, chain)) or "none" for chain in chains)
        raise ValueError(
            f"a robot must have four legs of three hinges each, and no other joints; found {len(chains)} chains of "
            f"joints: {found}. Name the joints of a head, tail or arm in held; robots with more or fewer legs are not "
            "supported."
        )
    _require_hinges(source, chains)
    places = np.array([_place(model, base, chain[0]) for chain in chains])
    by_x = np.argsort(-places[:, 0], kind="stable")
    order = [leg for pair in (by_x[:2], by_x[2:]) for leg in sorted(pair, key=lambda leg: -places[leg, 1])]
    x, y = places[order].T[:2]
    if not (min(x[:2]) > max(x[2:]) and y[0] > y[1] and y[2] > y[3]):
        raise ValueError(
            f"the base's frame must have x to the front and y to the left, but the hips of body "
            f"'{model.body(base).name}' are not so: {np.round(places[:, :2], 3).tolist()} m; turn the bodies in it."
        )
    return [chains[leg] for leg in order]


def copy(source: Source, legs: Sequence[Sequence[int]]) -> "tuple[mujoco.MjSpec, dict[str, list[tuple[str, str]]]]":
    """Rebuild the robot, its legs in this order.

    Returns:
        The model, without actuators; and for every body its geoms that collide, as pairs of a name in the file and the
        name of a piece of it.
    """
    import mujoco

    model, spec = source.model, mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = model.body(source.base).name
    trunk = _add_body(spec.worldbody, model, source.base)
    trunk.add_freejoint(name="base")
    names = {model.geom(i).name for i in range(model.ngeom)}
    pieces = {trunk.name: _add_geoms(spec, trunk, model, source.base, names)}
    for leg in legs:
        parent = trunk
        for index in dict.fromkeys(model.jnt_bodyid[list(leg)].tolist()):
            parent = _add_body(parent, model, index)
            for joint in range(model.body_jntadr[index], model.body_jntadr[index] + model.body_jntnum[index]):
                _add_joint(parent, model, joint, source.servos[source.name(joint)])
            pieces[parent.name] = _add_geoms(spec, parent, model, index, names)
    return spec, pieces


def _name_all(spec: "mujoco.MjSpec") -> None:
    """Name joints and geoms without a name after their body, and a body after its first joint."""
    names = {body.name for body in spec.bodies}
    for number, body in enumerate(spec.bodies):
        joint = body.joints[0].name if body.joints else ""
        body.name = body.name or (joint if joint not in names else f"body{number}")
        names.add(body.name)
        for things, kind in ((body.joints, "joint"), (body.geoms, "geom")):
            for i, thing in enumerate(things):
                thing.name = thing.name or f"{body.name}_{kind}{i}"


def _refuse_couplings(path: Path, model: "mujoco.MjModel") -> None:
    """Raise ``ValueError`` if joints are coupled by something that a copy would lose."""
    for count, what in ((model.neq, "an equality constraint"), (model.ntendon, "a tendon"), (model.nflex, "a flex")):
        if count:
            raise ValueError(
                f"mjcf must be a tree of bodies with independent joints, but {path} has {what}; remove it, and hold "
                "the joints that it moves."
            )


def _weighing_visuals(spec: "mujoco.MjSpec", model: "mujoco.MjModel") -> list[str]:
    """Notes on bodies whose visual geoms add to their weight: a frequent slip."""
    explicit = {body.name for body in spec.bodies if body.explicitinertial}
    weighing = [
        geom.name for geom in spec.geoms
        if not (geom.contype or geom.conaffinity) and geom.parent.name not in explicit
        and geom.parent.name != "world" and model.body(geom.parent.name).mass[0] > 0 and geom.density > 0
        and not geom.mass == 0
    ]  # fmt: skip
    return [
        f"geom '{name}' touches nothing but adds to the weight of its body, which has no <inertial>; give it mass=\"0\""
        for name in weighing
    ]


def _left_out(model: "mujoco.MjModel", held: Sequence[str]) -> list[str]:
    """Notes on what drives the robot in the file but is not simulated; actuators of held joints are not reported."""
    import mujoco

    on_joints = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)]
    joints = {i: model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)
              if model.actuator_trntype[i] in on_joints}  # fmt: skip
    moving = [i for i, joint in joints.items() if joint not in held]
    late = [joints[i] for i in moving if model.actuator_delay[i] > 0]
    filtered = [joints[i] for i in moving if model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE]
    light = [model.body(i).name for i in range(1, model.nbody) if model.body_gravcomp[i]]
    others = [model.actuator(i).name or f"number {i}" for i in range(model.nu) if i not in joints]
    found = (
        (light, "gravcomp of body {} is left out: gravity acts on all of its mass"),
        (late, "the delay of the actuator of joint {} is left out: its torque is immediate"),
        (filtered, "the activation (timeconst, dyntype) of the actuator of joint {} is left out: it acts at once"),
        (others, "actuator {} is left out because it acts on no joint"),
    )
    return [text.format(", ".join(f"'{name}'" for name in dict.fromkeys(names))) for names, text in found if names]


def _standing_keyframe(model: "mujoco.MjModel") -> int | None:
    names = [model.key(i).name.lower() for i in range(model.nkey)]
    found = [names.index(name) for name in STANDING if name in names]
    return found[0] if found else None


def _servos(model: "mujoco.MjModel") -> dict[str, Servo]:
    """Gains and limits from the actuators and the joints of a model."""
    import mujoco

    servos = {}
    for joint in range(model.njnt):
        limits = [model.jnt_actfrcrange[joint].max()] if model.jnt_actfrclimited[joint] else []
        stiffness = damping = armature = 0.0  # a position and a velocity actuator may act together
        drag = np.zeros(3)
        for i in range(model.nu):
            if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT or model.actuator_trnid[i, 0] != joint:
                continue
            gain, gear = model.actuator_gainprm[i, 0], abs(model.actuator_gear[i, 0])
            armature += gear**2 * model.actuator_armature[i]
            drag += gear**2 * np.array([model.actuator_damping[i], *model.actuator_dampingpoly[i]])
            is_affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
            by_angle, by_speed = model.actuator_biasprm[i, 1:3] * is_affine
            if model.actuator_forcelimited[i]:
                limits.append(gear * model.actuator_forcerange[i].max())
            if by_angle or by_speed:
                stiffness -= gear**2 * by_angle
                damping -= gear**2 * by_speed
            elif model.actuator_ctrllimited[i]:  # a motor
                limits.append(gear * gain * model.actuator_ctrlrange[i].max())
        servos[model.joint(joint).name] = Servo(
            stiffness=float(stiffness), damping=float(damping if stiffness else 0.0),
            max_torque=float(min(limits, default=0.0)), armature=float(armature), drag=tuple(drag.tolist()),
        )  # fmt: skip
    return servos


def _find_base(path: Path, model: "mujoco.MjModel") -> str:
    """Name of the body of the free joint."""
    import mujoco

    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free) == 1:
        return model.body(model.jnt_bodyid[free[0]]).name
    roots = ", ".join(f"'{model.body(i).name}'" for i in range(1, model.nbody) if model.body_parentid[i] == 0)
    raise ValueError(
        f"mjcf must hold one body that floats, but {path} has {len(free)} free joints; put <freejoint/> into the "
        f"robot's base alone ({roots or 'no body moves'})."
    )


def _leaves(model: "mujoco.MjModel", base: int) -> list[int]:
    """The bodies of a base's tree that have no children, without the base."""
    parents = set(model.body_parentid[1:].tolist())
    return [i for i in range(base + 1, model.nbody) if model.body_rootid[i] == base and i not in parents]


def _chain(source: Source, leaf: int) -> list[int]:
    """The joints from the base to a body."""
    model, body = source.model, leaf
    joints: list[int] = []
    while body != source.base:
        first = model.body_jntadr[body]
        joints = [*range(first, first + model.body_jntnum[body]), *joints]
        body = model.body_parentid[body]
    return joints


def _require_hinges(source: Source, chains: list[list[int]]) -> None:
    import mujoco

    model, seen = source.model, set()
    for joint in (joint for chain in chains for joint in chain):
        what = f"joint '{source.name(joint)}' of body '{source.body_of(joint)}'"
        if joint in seen:
            raise ValueError(f"legs must be chains, but {what} moves two of them; every leg needs its own three.")
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"{what} must be a hinge; name it in held, or model the leg with hinges.")
        if not model.jnt_limited[joint]:
            raise ValueError(f'{what} must have a range of angles; give it range="LOW HIGH" in the MJCF.')
        seen.add(joint)


def _place(model: "mujoco.MjModel", base: int, joint: int) -> np.ndarray:
    """Where a joint is, in the base's frame, in the pose that the file shows [m], shape (3,)."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return (data.xanchor[joint] - data.xpos[base]) @ data.xmat[base].reshape(3, 3)


def _add_body(parent: "mujoco.MjsBody", model: "mujoco.MjModel", index: int) -> "mujoco.MjsBody":
    body = parent.add_body(name=model.body(index).name, pos=model.body_pos[index], quat=model.body_quat[index])
    body.mass, body.ipos, body.iquat = model.body_mass[index], model.body_ipos[index], model.body_iquat[index]
    body.inertia, body.explicitinertial = model.body_inertia[index], True
    return body


def _add_joint(body: "mujoco.MjsBody", model: "mujoco.MjModel", joint: int, servo: Servo) -> None:
    dof, place = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    damping = np.array([model.dof_damping[dof], *model.dof_dampingpoly[dof]])
    body.add_joint(
        name=model.joint(joint).name, axis=model.jnt_axis[joint], pos=model.jnt_pos[joint],
        range=model.jnt_range[joint], limited=True, ref=model.qpos0[place], frictionloss=model.dof_frictionloss[dof],
        armature=model.dof_armature[dof] + servo.armature, damping=damping + servo.drag,
        stiffness=(model.jnt_stiffness[joint], *model.jnt_stiffnesspoly[joint]), springref=model.qpos_spring[place],
    )  # fmt: skip


def _add_geoms(
    spec: "mujoco.MjSpec", body: "mujoco.MjsBody", model: "mujoco.MjModel", index: int, taken: set[str]
) -> list[tuple[str, str]]:
    """Add a body's visual geoms and the pieces that collide; without visual geoms, those that collide are shown.

    ``taken`` are names that no piece may get; the names of the pieces are added to it.
    """
    geoms = [i for i in range(model.ngeom) if model.geom_bodyid[i] == index]
    hard = [i for i in geoms if model.geom_contype[i] or model.geom_conaffinity[i]]
    for geom in [i for i in geoms if i not in hard] or hard:
        _add_look(spec, body, model, geom)
    added = []
    for geom in hard:
        pieces = [_moved(piece, model, geom) for piece in fill(model.geom_aabb[geom, 3:])]
        for i, (start, end, radius) in enumerate(pieces):
            name = model.geom(geom).name
            piece = name if len(pieces) == 1 else f"{name}_{i}"
            while len(pieces) > 1 and piece in taken:
                piece += "_"
            taken.add(piece)
            add_collision(body, piece, radius, start, end, contype=ROBOT_BIT, conaffinity=TERRAIN_BIT)
            added.append((name, piece))
    return added


def _moved(piece: Piece, model: "mujoco.MjModel", geom: int) -> tuple[tuple, tuple | None, float]:
    """A piece of a geom's box, in the frame of its body."""
    import mujoco

    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    start, end = (
        model.geom_pos[geom] + turn.reshape(3, 3) @ (model.geom_aabb[geom, :3] + np.array(point))
        for point in (piece.start, piece.end)
    )
    return tuple(start), None if piece.start == piece.end else tuple(end), piece.radius


def _add_look(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", model: "mujoco.MjModel", index: int) -> None:
    """Add a copy of a geom that touches nothing and weighs nothing."""
    import mujoco

    material, mesh = model.geom_matid[index], model.geom_dataid[index]
    is_mesh = model.geom_type[index] == mujoco.mjtGeom.mjGEOM_MESH
    geom = body.add_geom(
        type=mujoco.mjtGeom(int(model.geom_type[index])), size=np.maximum(model.geom_size[index], 0.0),
        pos=model.geom_pos[index], quat=model.geom_quat[index], group=VISUAL_GROUP, contype=0, conaffinity=0, mass=0.0,
        rgba=model.mat_rgba[material] if material >= 0 else model.geom_rgba[index],
    )  # fmt: skip
    if is_mesh:
        geom.meshname = _add_mesh(spec, model, int(mesh))


def _add_mesh(spec: "mujoco.MjSpec", model: "mujoco.MjModel", index: int) -> str:
    """Add a copy of a mesh, once; return its name."""
    import mujoco

    name = f"mesh{index}"
    if spec.mesh(name) is None:
        first, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
        face, faces = model.mesh_faceadr[index], model.mesh_facenum[index]
        spec.add_mesh(
            name=name, uservert=model.mesh_vert[first : first + count].ravel(),
            userface=model.mesh_face[face : face + faces].ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # visual meshes need not be closed
        )  # fmt: skip
    return name
