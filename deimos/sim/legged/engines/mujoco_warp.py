"""The engine for GPUs: mujoco-warp, which also runs on Warp's CPU backend. No other file uses it."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from deimos.kernels.legged.contacts import CONTACTS, TERRAIN, UNWATCHED, Contacts, gather_contacts
from deimos.kernels.legged.state import Simulation
from deimos.sim.legged.engines import Physics, PhysicsConfig
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.engines.model import build_spec
from deimos.sim.legged.robots import Robot
from deimos.sim.shared import Shared, warp_device
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco


class Engine(Physics):
    """See ``Physics`` and ``build``."""

    recordable = True

    def __init__(
        self, robot: Robot, terrain: Terrain | None, num_envs: int, device: torch.device, config: PhysicsConfig, *,
        friction: np.ndarray | None, payload: np.ndarray | None,
    ) -> None:  # fmt: skip
        import mujoco_warp as mjw

        self.robot, self.terrain, self.config = robot, terrain, config
        self.num_envs, self.device = num_envs, device
        self.parts = (slice(0, num_envs),)
        model = build_spec(robot, terrain, config, visual=False).compile()
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
            self._model.opt.deterministic = mjw.DeterminismType.ALL if config.deterministic else 0
            if device.type == "cuda":
                self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
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
        self._mjw = mjw

    def _set_friction(self, model: "mujoco.MjModel", robot: Robot, friction: np.ndarray) -> None:
        value = np.tile(model.geom_friction, (self.num_envs, 1, 1)).astype(np.float32)
        for foot in robot.parts[1:5]:
            for name in foot:
                value[:, model.geom(name).id, 0] = friction
        self._model.geom_friction.assign(value)

    def _set_payload(self, model: "mujoco.MjModel", payload: np.ndarray) -> None:
        """Change the base's mass, its inertia in proportion, and what depends on them."""
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
        """See ``Physics.step``; meant to be captured, see ``Captured``."""
        with _device(self.device):
            self.arrays.part_force.zero_()
            for substep in range(self.config.substeps):
                self._mjw.step(self._model, self._data)
                gather_contacts(self._contacts, substep=substep)

    def record_step(self, before: Callable[[], None], after: Sequence[Callable[[], None]]) -> Captured:
        """See ``Physics.record_step``: all of it is one graph."""

        def launch() -> None:
            before()
            self.step()
            for part in after:
                part()

        return Captured(launch, self.device)

    def bare_step(self) -> None:
        """See ``Physics.bare_step``; meant to be captured."""
        with _device(self.device):
            for _ in range(self.config.substeps):
                self._mjw.step(self._model, self._data)

    def reset(self, mask: wp.array) -> None:
        """See ``Physics.reset``."""
        with _device(self.device):
            self._mjw.reset_data(self._model, self._data, mask)

    def buffer_use(self) -> dict[str, int]:
        """Largest use of contact and constraint buffers since the last call, and their sizes; reads the device."""
        contacts, rows = self._peak.tensor.tolist()
        self._peak.tensor.zero_()
        return {
            "contacts": contacts, "max_contacts": self.max_contacts, "rows": rows, "max_rows": self.max_rows,
        }  # fmt: skip

    def report(self) -> dict[str, float]:
        """See ``Physics.report``: the largest shares of the buffers that were in use."""
        use = self.buffer_use()
        return {"contact_use": use["contacts"] / use["max_contacts"], "row_use": use["rows"] / use["max_rows"]}

    def explain_loss(self, bits: int) -> str:
        """See ``Physics.explain_loss``."""
        bit, use = self._mjw.OverflowType, self.buffer_use()
        rows = f"up to {use['rows']} constraint rows in a world were needed, the buffer holds {use['max_rows']}"
        contacts = f"up to {use['contacts']} contacts in all worlds were needed, the buffer holds {use['max_contacts']}"
        reasons = {
            bit.NEFC | bit.NJMAX_NNZ: f"{rows}; raise physics.rows",
            bit.BROADPHASE | bit.NARROWPHASE | bit.CCD: f"{contacts}; raise physics.contacts",
            bit.HFIELD: "a geom covered more of the height field than is tested; use a terrain with larger cells",
            bit.EPA_HORIZON: "a contact was deeper than the collision test can resolve",
        }
        return "; ".join(f"{bit(bits & cause).name}: {text}" for cause, text in reasons.items() if bits & cause)


def _buffer_sizes(model: "mujoco.MjModel", num_envs: int, config: PhysicsConfig, *, plane: bool) -> tuple[int, int]:
    """Buffer sizes: contacts in all worlds, and constraint rows in each.

    Buffers cost time, used or not. On a height field no robot touches with four contacts of every geom: of a Go1's 136
    rows a policy's robots needed at most 64, except for worlds that diverged (108), and robots with large random leg
    targets 93.
    """
    contacts, pairs, rows = _largest_demand(model, plane=plane)
    contact_share, row_share = (1 / 2, 1.0) if plane else (1 / 4, 4 / 5)
    # A few worlds may need all of their contacts at once.
    shared = num_envs * max(pairs, math.ceil(contact_share * contacts)) + min(num_envs, 16) * contacts
    return config.contacts * num_envs or shared, config.rows or math.ceil(row_share * rows)


def _largest_demand(model: "mujoco.MjModel", *, plane: bool) -> tuple[int, int, int]:
    """Contacts, pairs of geoms and constraint rows of one world in which all geoms that can touch each other do.

    A sphere touches anything in one point, a capsule a plane or another capsule in two; on a height field the
    simulator keeps four of each. A contact without friction takes one row, one on a pyramid of four edges four, a joint
    at its limit one, and one of dry friction another at all times.
    """
    import mujoco

    is_sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    pairs = _pairs(model)
    first, second = pairs.T
    points = np.where(is_sphere[first] | is_sphere[second], 1, 2)
    if not plane:
        points[(model.geom_bodyid[pairs] == 0).any(axis=1)] = 4
    edges = np.where(model.geom_condim[pairs].max(axis=1) == 1, 1, 4)
    joints = int(model.jnt_limited.sum() + (model.dof_frictionloss > 0.0).sum())
    return int(points.sum()), len(pairs), int((points * edges).sum()) + joints


def _pairs(model: "mujoco.MjModel") -> np.ndarray:
    """Geoms whose bits let them touch each other, on bodies that move against each other, shape (pairs, 2)."""
    first, second = np.triu_indices(model.ngeom, 1)
    wanted = (model.geom_contype[first] & model.geom_conaffinity[second]) != 0
    wanted |= (model.geom_contype[second] & model.geom_conaffinity[first]) != 0
    body = model.body_weldid[model.geom_bodyid]
    wanted &= body[first] != body[second]
    return np.stack([first, second], axis=1)[wanted]


def _device(device: torch.device) -> wp.ScopedDevice:
    return wp.ScopedDevice(warp_device(device))
