"""A controller for an exported policy, and its check, with NumPy and onnxruntime alone; its simulation needs MuJoCo.

``deimos export`` copies this file to the folder that it writes, as ``controller.py``. There it reads ``deploy.json``,
``policy.onnx``, ``fear.onnx`` and ``robot.xml``, and nothing else::

    python controller.py    # are these the actions of the export, and do its robots walk as they did there?

A robot's own program makes a ``Controller`` and asks it for target angles every ``control_period`` seconds.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

TOLERANCE = 1e-5  # of actions, and of logits relative to their size
TRACKING_LOSS = 0.05  # share of the mean tracking that the check allows
BATCHES = (1, 7, 4096)


class Network:
    """An ONNX file whose contents are those that ``deploy.json`` names.

    Args:
        folder: The exported folder.
        entry: Its entry in ``deploy.json``.

    Raises:
        ValueError: If the file is a different one.
    """

    def __init__(self, folder: Path, entry: dict) -> None:
        import onnxruntime

        data = (folder / entry["file"]).read_bytes()
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise ValueError(f"{folder / entry['file']} is not the file that deploy.json describes; export it again.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # a network this small is slower on several
        self.session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def __call__(self, **inputs: np.ndarray) -> list[np.ndarray]:
        """Its outputs."""
        return self.session.run(None, {name: value.astype(np.float32) for name, value in inputs.items()})


def read(folder: Path) -> dict:
    """``deploy.json`` of a legged robot.

    Raises:
        ValueError: If it belongs to another environment.
    """
    deploy = json.loads((folder / "deploy.json").read_text(encoding="utf-8"))
    if deploy["robot"] is None:
        raise ValueError(f"{folder} must be an export of a legged robot, got one of {deploy['environment']}.")
    return deploy


class Controller:
    """Computes the target angles of the joints from the measurements of one or several robots.

    Args:
        folder: The folder that ``deimos export`` has written.
        robots: How many robots it controls at a time.

    Raises:
        ValueError: If the export is not that of a legged robot.
    """

    def __init__(self, folder: Path | str, robots: int = 1) -> None:
        folder = Path(folder)
        self.deploy = read(folder)
        self.policy = Network(folder, self.deploy["policy"])
        self.action = np.zeros((robots, self.deploy["action"]["size"]))
        """The last action as the joints took it, shape (robots, joints)."""

    def reset(self, robots: Any = slice(None)) -> None:
        """Begin an episode as in training: with a last action of zero.

        Args:
            robots: Which robots, a NumPy index; by default all.
        """
        self.action[robots] = 0.0

    def targets(self, measured: dict[str, np.ndarray]) -> np.ndarray:
        """Target angles of the joints [rad], shape (robots, joints), in the order of ``deploy.json``.

        If it raises, the controller is as it was before the call: a program that goes on must keep its last targets, or
        damp the joints, until its measurements are sound.

        Args:
            measured: By name, the entries of ``deploy.json``'s observation in the units given there, finite, shape
                (robots, size) each; all except ``last_action``, which the controller knows.

        Raises:
            KeyError: If one is missing.
            ValueError: If one has another shape or is not finite, or the action would not be.
        """
        measured = measured | {"last_action": self.action}
        parts = []
        for entry in self.deploy["observation"]:
            value, shape = np.asarray(measured[entry["name"]]), (len(self.action), entry["size"])
            if value.shape != shape:
                raise ValueError(f"{entry['name']} must have shape {shape}, got {value.shape}.")
            _require_finite(entry["name"], value)
            low, high = entry["clip"] or (-np.inf, np.inf)
            parts.append(np.clip(value, low, high))
        (action,) = self.policy(observation=np.concatenate(parts, axis=1))
        _require_finite("the policy's action", action)
        self.action = np.clip(action, self.deploy["action"]["low"], self.deploy["action"]["high"])
        joints = self.deploy["robot"]["joints"]
        pose, scale = (np.array([joint[key] for joint in joints]) for key in ("default_position", "action_scale"))
        return pose + scale * self.action


def _require_finite(name: str, value: np.ndarray) -> None:
    """Raise ``ValueError`` unless all is finite; np.clip keeps NaN, and the next observation would hold it too."""
    if not np.isfinite(value).all():
        robot = int(np.argwhere(~np.isfinite(value))[0, 0])
        raise ValueError(f"{name} must be finite, got {value[robot].tolist()} of robot {robot}.")


class Simulation:
    """Robots in MuJoCo, one after the other, with the sensors of ``deploy.json``.

    Args:
        folder: The folder that ``deimos export`` has written.
        qpos: Initial positions, shape (robots, nq).
        qvel: Initial velocities, shape (robots, nv).

    Raises:
        ValueError: If the export is not that of a legged robot.
    """

    def __init__(self, folder: Path | str, qpos: np.ndarray, qvel: np.ndarray) -> None:
        import mujoco

        folder = Path(folder)
        self.mujoco, self.robot = mujoco, read(folder)["robot"]
        self.model = mujoco.MjModel.from_xml_path(str(folder / self.robot["model"]))
        self.ground = self.model.geom("ground").id
        self.base = {self.model.geom(name).id for name in self.robot["base_geoms"]}
        self.pose = np.array([joint["default_position"] for joint in self.robot["joints"]])
        self.heights, self.corner, self.cell = self._read_ground()
        self.robots = [mujoco.MjData(self.model) for _ in qpos]
        for data, position, velocity in zip(self.robots, qpos, qvel, strict=True):
            data.qpos[:], data.qvel[:] = position, velocity

    def measure(self, goal: np.ndarray) -> dict[str, np.ndarray]:
        """The robots' measurements, by the names of the observation, with their goals."""
        qpos, qvel = (np.array([getattr(data, name) for data in self.robots]) for name in ("qpos", "qvel"))
        turn = self._turns(qpos[:, 3:7])  # from the base's frame to the world's
        measured = {
            "linear_velocity": np.einsum("nij,ni->nj", turn, qvel[:, :3]),
            "angular_velocity": qvel[:, 3:6],  # in the base's frame, as MuJoCo has it
            "gravity": -turn[:, 2],
            "goal": goal,
            "joint_position": qpos[:, 7:] - self.pose,
            "joint_velocity": qvel[:, 6:],
        }
        level = turn[:, :2, 0] / np.linalg.norm(turn[:, :2, 0], axis=1, keepdims=True)  # (cos, sin) of the yaw
        if self.robot["arm"]:
            measured["end_effector"] = self._end_effectors(qpos, turn, level)
        if self.robot["heights"]:
            points = self._points(qpos, level, np.array(self.robot["heights"]["points"]))
            measured["heights"] = qpos[:, 2:3] - self.robot["standing_height"] - self._lowest(points)
        return measured

    def step(self, targets: np.ndarray) -> np.ndarray:
        """Simulate one control period; return whether the base of each robot was pressed on the ground."""
        fell = np.zeros(len(self.robots), bool)
        for i, data in enumerate(self.robots):
            data.ctrl[:] = targets[i]
            for _ in range(self.robot["substeps"]):
                self.mujoco.mj_step(self.model, data)
                fell[i] |= self._base_force(data) > self.robot["crash_force"]
        return fell

    def _read_ground(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Samples of the ground [m], x along the first axis, the position of the first one, and their spacing [m]."""
        if not self.model.nhfield:
            return np.zeros((2, 2)), np.zeros(2), 1.0
        shape, middle = (self.model.hfield_nrow[0], self.model.hfield_ncol[0]), self.model.geom_pos[self.ground]
        half_x, half_y, top, _ = self.model.hfield_size[0]
        heights = self.model.hfield_data.reshape(shape).T * top + middle[2]
        return heights, middle[:2] - (half_x, half_y), 2 * half_x / (len(heights) - 1)

    def _base_force(self, data: Any) -> float:
        """Sum of the normal forces between base and ground [N]."""
        pairs, total, force = data.contact.geom, 0.0, np.zeros(6)
        for number in np.flatnonzero((pairs == self.ground).any(1) & np.isin(pairs, list(self.base)).any(1)):
            self.mujoco.mj_contactForce(self.model, data, number, force)
            total += force[0]
        return total

    def _turns(self, quat: np.ndarray) -> np.ndarray:
        """Rotation matrices of quaternions (w, x, y, z), shape (n, 3, 3)."""
        found = np.empty((len(quat), 9))
        for row, turn in zip(quat, found, strict=True):
            self.mujoco.mju_quat2Mat(turn, row)
        return found.reshape(-1, 3, 3)

    def _points(self, qpos: np.ndarray, level: np.ndarray, points: np.ndarray) -> np.ndarray:
        """World positions of points given in the frame of each robot's yaw [m], shape (robots, points, 2)."""
        along, across = level[:, None], np.stack([-level[:, 1], level[:, 0]], axis=1)[:, None]
        return qpos[:, None, :2] + points[:, :1] * along + points[:, 1:] * across

    def _cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The ground's samples around points [m], shape (2, 2, robots, points), and their places in their cells."""
        place = np.clip((points - self.corner) / self.cell, 0, np.array(self.heights.shape) - 1)
        i, j = np.moveaxis(np.minimum(place.astype(int), np.array(self.heights.shape) - 2), 2, 0)
        samples = [[self.heights[i, j], self.heights[i, j + 1]], [self.heights[i + 1, j], self.heights[i + 1, j + 1]]]
        return np.array(samples), place[..., 0] - i, place[..., 1] - j

    def _lowest(self, points: np.ndarray) -> np.ndarray:
        """The ground at points as the policy was shown it: the lowest of three samples of each point's cell [m]."""
        samples, _, _ = self._cells(points)
        return np.minimum(np.minimum(samples[0, 0], samples[1, 0]), samples[0, 1])

    def _surface(self, points: np.ndarray) -> np.ndarray:
        """The ground at points, interpolated between the samples [m]."""
        samples, s, t = self._cells(points)
        near, far = (row[0] + t * (row[1] - row[0]) for row in samples)
        return near + s * (far - near)

    def _end_effectors(self, qpos: np.ndarray, turn: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Where the end effectors are, expressed like the arm's part of a goal, shape (robots, 3)."""
        arm = self.robot["arm"]
        point = np.tile(arm["offsets"][-1], (len(qpos), 1))
        first = qpos.shape[1] - len(arm["axes"])
        for k in reversed(range(len(arm["axes"]))):  # forward kinematics, by Rodrigues's formula
            axis, angle = np.array(arm["axes"][k]), qpos[:, first + k, None]
            along = (point @ axis)[:, None] * axis
            point = arm["offsets"][k] + along + np.cos(angle) * (point - along) + np.sin(angle) * np.cross(axis, point)
        x, y, z = np.einsum("nij,nj->in", turn, point)
        below = self._points(qpos, level, np.array(arm["ground_points"]))
        place = np.stack([
            level[:, 0] * x + level[:, 1] * y, level[:, 0] * y - level[:, 1] * x,
            qpos[:, 2] - self._surface(below).mean(1) + z,
        ], axis=1) - arm["origin"]  # fmt: skip
        flat = np.hypot(place[:, 0], place[:, 1])
        shell = np.stack([
            np.linalg.norm(place, axis=1), np.arctan2(place[:, 2], flat), np.arctan2(place[:, 1], place[:, 0])
        ], axis=1)  # fmt: skip
        low, high = np.array(arm["shell_low"]), np.array(arm["shell_high"])
        return (shell - (low + high) / 2) / ((high - low) / 2)


def track(measured: dict[str, np.ndarray], variance: float) -> np.ndarray:
    """How well each group of a goal's components is met, in [0, 1], shape (robots, groups), as in training."""
    goal, velocity, rate = measured["goal"], measured["linear_velocity"], measured["angular_velocity"]
    groups = [
        np.exp(-np.square(velocity[:, :2] - goal[:, :2]).sum(1) / variance),
        np.exp(-np.square(rate[:, 2] - goal[:, 2]) / variance),
    ]
    if goal.shape[1] > 3:
        groups.append(np.exp(-0.5 * np.abs(measured["end_effector"] - goal[:, 3:]).sum(1)))
    return np.stack(groups, axis=1)


def compare_networks(folder: Path, deploy: dict, known: dict[str, np.ndarray]) -> bool:
    """Print how far the networks' outputs are from those of the export; return whether all are the same."""
    jobs: list[tuple[str, tuple[str, ...], tuple[str, ...]]] = [("policy", ("observation",), ("action",))]
    if deploy["fear"]:
        jobs.append(("fear", ("state", "goal", "candidates"), tuple(deploy["fear"]["outputs"])))
    passed = True
    for name, inputs, outputs in jobs:
        network, worst = Network(folder, deploy[name]), 0.0
        sizes = [min(size, len(known[f"{name}.{inputs[0]}"])) for size in BATCHES]
        for size in sizes:
            rows = slice(0, size)
            found = network(**{key: known[f"{name}.{key}"][rows] for key in inputs})
            for key, value in zip(outputs, found, strict=True):
                wanted = known[f"{name}.{key}"][rows]
                size = np.abs(wanted) if key == "logit" else 0.1 * np.abs(known[f"{name}.{key}"]).max()
                scale = np.maximum(1.0, size)  # float32 does not have 1e-5 of actions far beyond 10
                worst = float(np.maximum(worst, (np.abs(value - wanted) / scale).max()))  # max() would drop a NaN
        passed &= worst <= TOLERANCE  # False for NaN
        print(f"{deploy[name]['file']}, batches of {', '.join(map(str, sizes))}: largest difference {worst:.2g}")
    return passed


def compare_walks(folder: Path, deploy: dict, known: dict[str, np.ndarray]) -> bool:
    """Print how the robots walk here and how they did at the export; return whether they walk as well."""
    goal, steps, fell_there = known["walk.goal"], known["walk.steps"], known["walk.fell"]
    controller, worlds = Controller(folder, len(goal)), Simulation(folder, known["walk.qpos"], known["walk.qvel"])
    fell = np.zeros(len(goal), bool)
    met = np.zeros_like(known["walk.tracking"])
    measured = worlds.measure(goal)
    for t in range(steps.max()):
        fell |= worlds.step(controller.targets(measured)) & (t < steps)
        measured = worlds.measure(goal)
        met += track(measured, deploy["robot"]["tracking_variance"]) * (~fell & (t < steps))[:, None]
    here, there = (met / np.maximum(steps, 1)[:, None]).mean(0), known["walk.tracking"].mean(0)
    seconds = steps.max() * deploy["control_period"]
    print(f"{len(goal)} robots walk {seconds:g} s: {fell.sum()} fall, at the export {fell_there.sum()}")
    for group, mine, theirs in zip(deploy["goal"]["groups"], here, there, strict=True):
        print(f"tracking of the goal, {group} (0 to 1): {mine:.4f}, at the export {theirs:.4f}")
    return not (fell & ~fell_there).any() and bool((here >= (1.0 - TRACKING_LOSS) * there).all())


def main(folder: Path) -> bool:
    """Check an exported folder; return whether it does what it did at the export."""
    deploy = json.loads((folder / "deploy.json").read_text(encoding="utf-8"))
    if not (folder / "check.npz").exists():
        sys.exit(f"{folder} holds no check.npz to compare with; export it again with --check.")
    with np.load(folder / "check.npz") as file:
        known = dict(file)
    passed = compare_networks(folder, deploy, known)
    if deploy["robot"]:
        passed &= compare_walks(folder, deploy, known)
    print("It is what was exported." if passed else "It is NOT what was exported.")
    return passed


if __name__ == "__main__":
    sys.exit(0 if main(Path(__file__).resolve().parent) else 1)
