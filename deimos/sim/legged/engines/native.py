"""The engine for CPUs: ``mujoco.batch``, MuJoCo's own C code on a pool of threads. Nothing has to be compiled.

Results are bit-identical for any number of threads. Between control steps the state is in single precision, like
mujoco-warp's; MuJoCo computes in double precision from there.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from deimos.checks import SimulationError
from deimos.kernels.legged.rows import ROWS, Rows, narrow, reset_rows, widen
from deimos.kernels.legged.state import SIMULATION
from deimos.nn.threads import POOL, available
from deimos.sim.legged.engines import Physics, PhysicsConfig
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.engines.model import build_spec
from deimos.sim.legged.robots import Robot
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco
    from mujoco.batch import Batch

GRAIN = 64  # worlds that are worth waking a thread for; a multiple keeps threads from writing to the same cache line
SLOTS = 4  # contacts of a geom with the ground that are kept, those with the largest forces; mujoco-warp keeps as many
LARGEST_FORCES = 2  # how a contact sensor chooses; MuJoCo has no name for this number
WARNINGS = (
    ("INERTIA", "the inertia of the robot is close to singular"),
    ("CONTACTFULL", "there were more contacts than the arena holds; raise memory of the robot's spec"),
    ("CNSTRFULL", "there were more constraints than the arena holds; raise memory of the robot's spec"),
    ("BADQPOS", "a position was not finite, or beyond 1e10"),
    ("BADQVEL", "a velocity was not finite, or beyond 1e10"),
    ("BADQACC", "an acceleration was not finite, or beyond 1e10"),
    ("BADCTRL", "a target angle was not finite, or beyond 1e10"),
)
"""MuJoCo's warnings, in order; a world that gets one is not simulated to the end of the control step."""


class Engine(Physics):
    """See ``Physics`` and ``build``. It gets as many threads as torch has when it is built."""

    def __init__(
        self, robot: Robot, terrain: Terrain | None, num_envs: int, device: torch.device, config: PhysicsConfig, *,
        friction: np.ndarray | None, payload: np.ndarray | None,
    ) -> None:  # fmt: skip
        import mujoco

        if device.type != "cpu":
            raise ValueError(f"engine must be warp on {device}, got native; use --env.engine warp, or --device cpu.")
        # Warnings are counted per world and explained by this engine; MuJoCo itself would also write them to a file in
        # the working directory. An existing handler is kept.
        if mujoco.get_mju_user_warning() is None:
            mujoco.set_mju_user_warning(lambda message: None)
        self.robot, self.terrain, self.config = robot, terrain, config
        self.num_envs, self.device = num_envs, device
        self.parts = _divide(num_envs, available())
        spec = build_spec(robot, terrain, config, visual=False)
        part = _watch_contacts(spec, robot, plane=terrain is None)
        model = spec.compile()
        _set_options(model)
        self._batch = _make_batch(model, num_envs)
        if friction is not None:
            self._set_friction(model, robot, friction)
        if payload is not None:
            self._set_payload(model, payload)
        self.lost_contacts = (1 << len(WARNINGS)) - 1
        self._join(model, part)
        own = {name: self._batch.expand(name) for name in _own_fields(self._batch)}
        rows = {"warmstart": self._batch.bind("qacc_warmstart")} | own
        state = {name: wp.to_torch(getattr(self.arrays, name)) for name in ("qpos", "qvel")}
        self.tensors = state | {name: torch.from_numpy(array) for name, array in rows.items()}

    def _set_friction(self, model: "mujoco.MjModel", robot: Robot, friction: np.ndarray) -> None:
        feet = [model.geom(name).id for foot in robot.parts[1:5] for name in foot]
        self._batch.expand("geom_friction")[:, feet, 0] = friction[:, None]

    def _set_payload(self, model: "mujoco.MjModel", payload: np.ndarray) -> None:
        """Change the base's mass, its inertia in proportion, and what depends on them."""
        base = model.jnt_bodyid[0]
        share = 1.0 + payload / model.body_mass[base]
        self._batch.expand("body_mass")[:, base] *= share
        self._batch.expand("body_inertia")[:, base] *= share[:, None]
        self._batch.set_const()

    def _join(self, model: "mujoco.MjModel", part: list[int]) -> None:
        """Make the arrays for the kernels, and give the kernels MuJoCo's memory."""
        batch, shape = self._batch, (self.num_envs, self.config.substeps, model.nsensordata)
        self._contact = np.zeros(shape)
        memory = {
            "state": batch.state, "rest": batch.state[0].copy(), "part": np.array(part, np.int32),
            "warning": batch.warning, "torque": batch.bind("actuator_force"),
            "contact": self._contact.reshape(*shape[:2], -1, 3),
        }  # fmt: skip
        self._memory = memory | {name: batch.bind(name) for name in ("qpos", "qvel", "ctrl")}
        self._rows = Rows()
        for name in ROWS.names:
            setattr(self._rows, name, _view(self._memory[name], ROWS.dtype(name)))
        sizes = {
            "num_envs": self.num_envs, "num_joints": model.nu, "nq": model.nq, "nv": model.nv, "substeps": shape[1],
            "row": batch.nstate, "slots": len(part), "warnings": len(WARNINGS),
        }  # fmt: skip
        ROWS.require("rows", self._rows, self._rows.state, **sizes)
        self.arrays = SIMULATION.allocate("cpu", **sizes)
        narrow(self._rows, self.arrays)

    def step(self) -> None:
        """See ``Physics.step``."""
        widen(self.arrays, self._rows)
        self._simulate()
        narrow(self._rows, self.arrays)

    def record_step(self, before: Callable[[], None], after: Sequence[Callable[[], None]]) -> Callable[[], None]:
        """See ``Physics.record_step``: what comes before MuJoCo's pool is one graph, what follows is one per thread."""

        def enter() -> None:
            before()
            widen(self.arrays, self._rows)

        def leave(rows: slice, evaluate: Callable[[], None]) -> None:
            narrow(ROWS.rows(self._rows, rows), SIMULATION.rows(self.arrays, rows))
            evaluate()

        entered = Captured(enter, self.device)
        left = [
            Captured(partial(leave, rows, evaluate), self.device)
            for rows, evaluate in zip(self.parts, after, strict=True)
        ]

        def step() -> None:
            entered()
            self._simulate()
            with POOL.lock:
                POOL.run(lambda part: left[part](), len(left))

        return step

    def bare_step(self) -> None:
        """See ``Physics.bare_step``; it includes the contact forces of every substep."""
        self._simulate()

    def _simulate(self) -> None:
        """Step all worlds on the pool, with the contact forces of every substep."""
        from mujoco import batch

        try:
            self._batch.rollout(self.config.substeps, record=("sensordata",), out={"sensordata": self._contact})
        except batch.SimulationError as error:  # those worlds have not moved
            world = int(error.ids[0])
            reason = " ".join(self._batch.error(world).split())
            raise SimulationError(f"World {world}: MuJoCo stops with '{reason}'.") from error

    def reset(self, mask: wp.array) -> None:
        """See ``Physics.reset``."""
        reset_rows(mask, self._rows, self.arrays)

    def report(self) -> dict[str, float]:
        """See ``Physics.report``: there are no buffers to report."""
        return {}

    def explain_loss(self, bits: int) -> str:
        """See ``Physics.explain_loss``."""
        return "; ".join(f"{name}: {text}" for i, (name, text) in enumerate(WARNINGS) if bits & 1 << i)


def _divide(num_envs: int, threads: int) -> tuple[slice, ...]:
    """Divide worlds into at most as many parts as threads, each a multiple of ``GRAIN`` except for the last."""
    size = -(-num_envs // (threads * GRAIN)) * GRAIN
    return tuple(slice(start, min(start + size, num_envs)) for start in range(0, num_envs, size))


def _watch_contacts(spec: "mujoco.MjSpec", robot: Robot, *, plane: bool) -> list[int]:
    """Give every watched geom a sensor of its contacts with the ground, and the model no other sensors.

    Returns:
        The part of every contact that they report, in order.
    """
    import mujoco

    for sensor in spec.sensors:
        spec.delete(sensor)
    points = {mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 2} if plane else {}
    part: list[int] = []
    for index, names in enumerate(robot.parts):
        for name in names:
            slots = points.get(spec.geom(name).type, SLOTS)
            spec.add_sensor(
                name=f"contact_{name}", type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=name, reftype=mujoco.mjtObj.mjOBJ_GEOM, refname="ground",
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), LARGEST_FORCES, slots],
            )  # fmt: skip
            part += [index] * slots
    return part


def _set_options(model: "mujoco.MjModel") -> None:
    """Set the options that only this engine has."""
    import mujoco

    off = mujoco.mjtDisableBit
    # A robot is one island of few geoms: finding islands and sorting geoms costs more than it saves. A world that is
    # not finite stays so, to be found and reset like all others.
    model.opt.disableflags |= int(off.mjDSBL_ISLAND | off.mjDSBL_MIDPHASE | off.mjDSBL_AUTORESET)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # Newton's solver is wrong with sparse ones in MuJoCo 4.0.0
    model.opt.tolerance = 1e-6  # mujoco-warp's; anything smaller is lost when the state is rounded to single precision


def _make_batch(model: "mujoco.MjModel", num_envs: int) -> "Batch":
    """The worlds.

    Raises:
        MemoryError: If there are more of them than memory holds.
    """
    import mujoco
    from mujoco.batch import Batch

    try:
        return Batch(model, num_envs, available())
    except ValueError as error:  # std::bad_alloc
        size = 8 * mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value)
        raise MemoryError(f"a world takes at least {size / 1024:.1f} KiB") from error


def _own_fields(batch: "Batch") -> list[str]:
    """Names of the model's fields that every world has its own copy of."""
    from mujoco.batch import MODEL_FIELDS

    return sorted(name for name in MODEL_FIELDS if batch.expanded(name) is not None)


def _view(array: np.ndarray, dtype: Any) -> wp.array:
    """A Warp array in a NumPy array's memory, which must outlive it."""
    axes = array.ndim - len(getattr(dtype, "_shape_", ()))
    return wp.array(
        ptr=array.ctypes.data, dtype=dtype, shape=array.shape[:axes], strides=array.strides[:axes], device="cpu"
    )
