"""A robot on a terrain, in many worlds: stepping, reset, health.

This is the only file that knows mujoco-warp. What it shows to others are Warp arrays with MuJoCo's
names and layout, so that another engine fits behind the same interface.
"""

import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from deimos.checks import check_at_least, check_positive
from deimos.kernels.legged.contacts import CONTACTS, TERRAIN, UNWATCHED, Contacts, gather_contacts
from deimos.kernels.legged.state import Simulation
from deimos.sim.legged.height_field import add_height_field
from deimos.sim.legged.robots import CONTACT_STIFFNESS, ROBOT_BIT, TERRAIN_BIT, VISUAL_GROUP, Robot
from deimos.sim.shared import Shared, warp_device
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco

FINEST_CELL = 0.05  # [m] of a height field on which no geom of a robot covers more than the 50 prisms that are tested
PATIENCE = 3.0  # [s] of silence before the first step says what it waits for


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
    """Contact buffer size per world, shared by all worlds; 0 takes half of what touching with every geom would need, a
    quarter on a height field, but one for every pair of geoms that can touch at least, and all of it for 16 worlds
    more. That is 69 % and 28 % for 512 Go1s."""
    rows: int = 0
    """Buffer size for constraint rows in each world; 0 takes what touching with every geom, all joints at limits,
    needs, four fifths of it on a height field."""

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


class Physics:
    """``num_envs`` worlds, each with a robot of its own on the same terrain.

    Args:
        robot: What is simulated.
        terrain: What it stands on; ``None`` for a plane at height 0, which is faster.
        num_envs: Number of worlds.
        device: Where they are simulated.
        config: The simulator's settings.
        friction: Sliding friction of every world's feet, shape (num_envs,); ``None`` for that of the robot.
        payload: What is added to every world's base [kg], shape (num_envs,); ``None`` for nothing.

    Raises:
        ValueError: If the terrain's cells are finer than ``FINEST_CELL``.
    """

    model: "mujoco.MjModel"
    """The model with its visual geoms, for rendering and viewers."""
    arrays: Simulation
    """What the simulator has for the kernels; torques are those of the last substep."""
    lost_contacts: int
    """The bits of ``overflow`` that mean that a contact or a constraint was left out."""
    tensors: dict[str, torch.Tensor]
    """Everything that a bit-exact resume needs, by name; views, worlds along the first axis."""

    def __init__(
        self,
        robot: Robot,
        terrain: Terrain | None,
        num_envs: int,
        device: torch.device,
        config: PhysicsConfig,
        *,
        friction: np.ndarray | None = None,
        payload: np.ndarray | None = None,
    ) -> None:
        import mujoco
        import mujoco_warp as mjw

        if terrain is not None and terrain.cell < (1 - 1e-6) * FINEST_CELL:
            raise ValueError(
                f"terrain must have cells of at least {FINEST_CELL} m under a robot, got {terrain.cell:g} m; on "
                f"finer ones the simulator loses contacts. Build it with --cell {FINEST_CELL}, or import it with "
                f"--resolution {FINEST_CELL}."
            )
        self.config = config
        self.num_envs = num_envs
        self.device = device
        spec = _with_ground(robot.spec, terrain)
        _set_options(spec, config)
        self.model = spec.compile()
        plain = spec.copy()
        for geom in [geom for geom in plain.geoms if geom.group == VISUAL_GROUP]:
            plain.delete(geom)
        model = plain.compile()

        self.max_contacts, self.max_rows = _buffer_sizes(model, num_envs, config, plane=terrain is None)
        batched: dict[str, int] = {}
        if friction is not None:
            batched |= {"geom_friction": num_envs}
        if payload is not None:
            names = ("body_mass", "body_subtreemass", "body_inertia", "body_invweight0", "dof_invweight0")
            batched |= dict.fromkeys(names, num_envs)
        with wp.ScopedDevice(warp_device(device)):
            self._model = mjw.put_model(model, batch_sizes=batched)
            self._model.opt.warn_overflow = 0  # reported by ``overflow``, not by printing
            self._data = mjw.make_data(model, num_envs, naconmax=self.max_contacts, njmax=self.max_rows)
            if friction is not None:
                self._set_friction(model, robot, friction)
            if payload is not None:
                self._set_payload(model, payload)
        data = self._data
        self.arrays = Simulation()
        self.arrays.qpos, self.arrays.qvel, self.arrays.ctrl = data.qpos, data.qvel, data.ctrl
        self.arrays.torque, self.arrays.overflow = data.actuator_force, data.overflow
        bits = mjw.OverflowType
        self.lost_contacts = int(
            bits.NEFC | bits.NJMAX_NNZ | bits.BROADPHASE | bits.NARROWPHASE | bits.CCD | bits.HFIELD | bits.EPA_HORIZON
        )
        batch = {name: wp.to_torch(getattr(self._model, name)) for name in batched}
        state = {"qpos": data.qpos, "qvel": data.qvel, "warmstart": data.qacc_warmstart}
        self.tensors = {name: wp.to_torch(array) for name, array in state.items()} | batch
        self._watch_contacts(model, robot)
        self._mujoco, self._mjw = mujoco, mjw

    def _set_friction(self, model: "mujoco.MjModel", robot: Robot, friction: np.ndarray) -> None:
        value = np.tile(model.geom_friction, (self.num_envs, 1, 1)).astype(np.float32)
        for foot in robot.parts[1:5]:
            for name in foot:
                value[:, model.geom(name).id, 0] = friction
        self._model.geom_friction.assign(value)

    def _set_payload(self, model: "mujoco.MjModel", payload: np.ndarray) -> None:
        """Change the base's mass, its inertia in proportion, and what follows from them."""
        import mujoco_warp as mjw

        base = model.jnt_bodyid[0]
        mass = np.tile(model.body_mass, (self.num_envs, 1)).astype(np.float32)
        inertia = np.tile(model.body_inertia, (self.num_envs, 1, 1)).astype(np.float32)
        share = 1.0 + payload / model.body_mass[base]
        mass[:, base] *= share
        inertia[:, base] *= share[:, None]
        self._model.body_mass.assign(mass)
        self._model.body_inertia.assign(inertia)
        mjw.set_const(self._model, self._data)

    def _watch_contacts(self, model: "mujoco.MjModel", robot: Robot) -> None:
        """Prepare what ``gather_contacts`` needs."""
        part = np.full(model.ngeom, UNWATCHED, np.int32)
        part[model.geom_bodyid == 0] = TERRAIN
        for index, names in enumerate(robot.parts):
            for name in names:
                part[model.geom(name).id] = index
        data, device = self._data, warp_device(self.device)
        shape = (self.config.substeps, self.num_envs, len(robot.parts))
        self.arrays.part_force = wp.zeros(shape, dtype=wp.float32, device=device)
        self._peak = Shared.zeros(2, wp.int32, self.device)
        contacts = Contacts()
        contacts.count = data.nacon
        contacts.world, contacts.geom, contacts.dim = data.contact.worldid, data.contact.geom, data.contact.dim
        contacts.row, contacts.force = data.contact.efc_address, data.efc.force
        contacts.geom_part = wp.array(part, dtype=wp.int32, device=device)
        contacts.part_force, contacts.peak = self.arrays.part_force, self._peak.array
        CONTACTS.require(
            "contacts", contacts, contacts.part_force, num_envs=self.num_envs, num_geoms=model.ngeom, substeps=shape[0],
            parts=shape[2], buffer=self.max_contacts, edges=contacts.row.shape[1], rows=contacts.force.shape[1],
        )  # fmt: skip
        self._contacts = contacts

    def step(self) -> None:
        """Launch the substeps of one control step, each followed by the gathering of its contacts.

        Meant to be captured, see ``Captured``. Positions of bodies and geoms lag ``qpos`` by a substep.
        """
        with _device(self.device):
            self.arrays.part_force.zero_()
            for substep in range(self.config.substeps):
                self._mjw.step(self._model, self._data)
                gather_contacts(self._contacts, substep=substep)

    def bare_step(self) -> None:
        """Launch the substeps of one control step and nothing else: the baseline of benchmarks."""
        with _device(self.device):
            for _ in range(self.config.substeps):
                self._mjw.step(self._model, self._data)

    def reset(self, mask: wp.array) -> None:
        """Put every world of ``mask`` back to the model's defaults and forget all that it computed, warm starts too.

        Args:
            mask: bool, shape (num_envs,).
        """
        with _device(self.device):
            self._mjw.reset_data(self._model, self._data, mask)

    def buffer_use(self) -> dict[str, int]:
        """Largest use of contact and constraint buffers since the last call, beside their sizes; reads the device."""
        contacts, rows = self._peak.tensor.tolist()
        self._peak.tensor.zero_()
        return {
            "contacts": contacts, "max_contacts": self.max_contacts, "rows": rows, "max_rows": self.max_rows,
        }  # fmt: skip

    def explain_loss(self, bits: int) -> str:
        """Why contacts were lost, by the bits of ``overflow``, and what helps; reads the device."""
        bit, use = self._mjw.OverflowType, self.buffer_use()
        rows = f"up to {use['rows']} constraint rows in a world were needed, the buffer holds {use['max_rows']}"
        contacts = f"up to {use['contacts']} contacts in all worlds were needed, the buffer holds {use['max_contacts']}"
        reasons = {
            bit.NEFC | bit.NJMAX_NNZ: f"{rows}; raise physics.rows",
            bit.BROADPHASE | bit.NARROWPHASE | bit.CCD: f"{contacts}; raise physics.contacts",
            bit.HFIELD: "a geom covered more of the height field than is tested; take a terrain of larger cells",
            bit.EPA_HORIZON: "a contact was deeper than the collision test can resolve",
        }
        return "; ".join(f"{bit(bits & cause).name}: {text}" for cause, text in reasons.items() if bits & cause)

    def to_mujoco(self, world: int) -> "mujoco.MjData":
        """One world as MuJoCo's own data on ``model``, for rendering, viewers and tests; reads the device."""
        data = self._mujoco.MjData(self.model)
        data.qpos[:] = self.arrays.qpos.numpy()[world]
        data.qvel[:] = self.arrays.qvel.numpy()[world]
        data.ctrl[:] = self.arrays.ctrl.numpy()[world]
        data.qacc_warmstart[:] = self._data.qacc_warmstart.numpy()[world]
        self._mujoco.mj_forward(self.model, data)
        return data


class Captured:
    """Launches that were recorded once, to be replayed as one graph.

    Args:
        launch: Makes the launches. Run once before it is recorded, which compiles what has to be compiled,
            and once or not at all while it is: whatever it changes has to be set anew afterwards.
        device: Where they run.
    """

    def __init__(self, launch: Callable[[], None], device: torch.device) -> None:
        with wp.ScopedDevice(warp_device(device)):
            with _say_what_it_waits_for():
                launch()
            with wp.ScopedCapture() as capture:
                launch()
        self._graph = capture.graph

    def __call__(self) -> None:
        """Replay the launches."""
        wp.capture_launch(self._graph)


def _with_ground(robot: "mujoco.MjSpec", terrain: Terrain | None) -> "mujoco.MjSpec":
    """A copy of the robot's model on a ground without friction of its own: the feet's counts."""
    import mujoco

    spec = robot.copy()
    if terrain is None:
        ground = spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 0.05))
    else:
        ground = add_height_field(spec, terrain)
    ground.contype, ground.conaffinity, ground.condim = TERRAIN_BIT, ROBOT_BIT, 1
    ground.solref = CONTACT_STIFFNESS
    _dress(spec, ground)
    return spec


def _dress(spec: "mujoco.MjSpec", ground: "mujoco.MjsGeom") -> None:
    """Daylight, a sky and a chequered ground, so that one sees how the robot moves over it."""
    import mujoco

    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.45,) * 3, (0.35,) * 3, (0.1,) * 3
    light = spec.worldbody.add_light(pos=(0.0, 0.0, 4.0), dir=(-0.3, 0.4, -1.0), castshadow=False)
    light.type, light.diffuse = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, (0.5,) * 3
    texture = mujoco.mjtTexture
    spec.add_texture(
        name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.78, 0.85, 0.93), rgb2=(0.95, 0.97, 1.0), width=64, height=64,
    )  # fmt: skip
    spec.add_texture(
        name="squares", type=texture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.62, 0.66, 0.7), rgb2=(0.55, 0.59, 0.64), width=256, height=256,
    )  # fmt: skip
    material = spec.add_material(name="ground", texuniform=True, texrepeat=(1.0, 1.0))
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
    ground.material = "ground"


def _buffer_sizes(model: "mujoco.MjModel", num_envs: int, config: PhysicsConfig, *, plane: bool) -> tuple[int, int]:
    """Buffer sizes: contacts in all worlds, and constraint rows in each.

    Buffers cost time, used or not. On a height field nobody touches with four contacts of every geom: of a Go1's 136
    rows a policy's robots needed 64 at most, but for worlds that diverged (108), and robots under large random
    leg targets 93.
    """
    contacts, pairs, rows = _largest_demand(model, plane=plane)
    contact_share, row_share = (1 / 2, 1.0) if plane else (1 / 4, 4 / 5)
    # A few worlds alone may need all of the contacts at once.
    shared = num_envs * max(pairs, math.ceil(contact_share * contacts)) + min(num_envs, 16) * contacts
    return config.contacts * num_envs or shared, config.rows or math.ceil(row_share * rows)


def _largest_demand(model: "mujoco.MjModel", *, plane: bool) -> tuple[int, int, int]:
    """Contacts, pairs of geoms and constraint rows of one world in which all geoms touch that can touch each other.

    A sphere touches anything in one point, a capsule a plane or another capsule in two; on a height field the
    simulator keeps four of each. A contact without friction takes one row, one on a pyramid of four edges four, a joint
    at its limit one.
    """
    import mujoco

    is_sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    pairs = _pairs(model)
    first, second = pairs.T
    points = np.where(is_sphere[first] | is_sphere[second], 1, 2)
    if not plane:
        points[(model.geom_bodyid[pairs] == 0).any(axis=1)] = 4
    edges = np.where(model.geom_condim[pairs].max(axis=1) == 1, 1, 4)
    limits = int(model.jnt_limited.sum())
    return int(points.sum()), len(pairs), int((points * edges).sum()) + limits


def _pairs(model: "mujoco.MjModel") -> np.ndarray:
    """Geoms that can touch each other by their bits and on bodies that move against each other, shape (pairs, 2)."""
    first, second = np.triu_indices(model.ngeom, 1)
    wanted = (model.geom_contype[first] & model.geom_conaffinity[second]) != 0
    wanted |= (model.geom_contype[second] & model.geom_conaffinity[first]) != 0
    body = model.body_weldid[model.geom_bodyid]
    wanted &= body[first] != body[second]
    return np.stack([first, second], axis=1)[wanted]


def _set_options(spec: "mujoco.MjSpec", config: PhysicsConfig) -> None:
    """Newton's solver on pyramidal friction cones, implicit in the joints' damping."""
    import mujoco

    option = spec.option
    option.timestep = config.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.impratio = 1.0
    option.iterations = config.iterations
    option.ls_iterations = config.line_search
    option.ccd_iterations = 20


def _device(device: torch.device) -> wp.ScopedDevice:
    return wp.ScopedDevice(warp_device(device))


@contextmanager
def _say_what_it_waits_for() -> Iterator[None]:
    """After some seconds of silence, say that the simulator is being compiled."""
    message = "Compiling the simulator for this machine, which takes a minute or two, once."
    timer = threading.Timer(PATIENCE, lambda: print(message, file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
