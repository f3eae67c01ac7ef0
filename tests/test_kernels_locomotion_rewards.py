"""The legged robots' reward terms, each against plain NumPy."""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from deimos.kernels.legged import arm_rewards, rewards
from deimos.kernels.legged.rewards import (
    TERMS,
    LegMotion,
    RewardWeights,
    vec12,
    vecT,
    weighted_terms,
)
from deimos.kernels.legged.terms import functions_of

DT = 0.02
N = 64
VECTORS = {
    "velocity": 3, "rate": 3, "down": 3, "goal": 3, "angle": 12, "speed": 12, "last_speed": 12, "torque": 12,
    "action": 12, "last_action": 12, "soft_low": 12, "soft_high": 12,
}  # fmt: skip
TYPES = {3: wp.vec3, 12: vec12}


@wp.struct
class Columns:
    """The fields of ``LegMotion``, one robot per row."""

    velocity: wp.array[wp.vec3]
    rate: wp.array[wp.vec3]
    down: wp.array[wp.vec3]
    goal: wp.array[wp.vec3]
    angle: wp.array[vec12]
    speed: wp.array[vec12]
    last_speed: wp.array[vec12]
    torque: wp.array[vec12]
    action: wp.array[vec12]
    last_action: wp.array[vec12]
    soft_low: wp.array[vec12]
    soft_high: wp.array[vec12]
    collisions: wp.array[int]
    landed_air_time: wp.array[float]


@wp.kernel
def _all_terms(columns: Columns, weight: vecT, dt: float, term: wp.array[vecT]):
    i = wp.tid()
    m = LegMotion()
    m.velocity = columns.velocity[i]
    m.rate = columns.rate[i]
    m.down = columns.down[i]
    m.goal = columns.goal[i]
    m.angle = columns.angle[i]
    m.speed = columns.speed[i]
    m.last_speed = columns.last_speed[i]
    m.torque = columns.torque[i]
    m.action = columns.action[i]
    m.last_action = columns.last_action[i]
    m.soft_low = columns.soft_low[i]
    m.soft_high = columns.soft_high[i]
    m.collisions = columns.collisions[i]
    m.landed_air_time = columns.landed_air_time[i]
    m.dt = dt
    term[i] = weighted_terms(m, weight)


def make_motion(seed=0):
    """Random motions of the size of a walking Go1's."""
    rng = np.random.default_rng(seed)
    motion = {name: rng.normal(size=(N, size)) for name, size in VECTORS.items()}
    motion["down"] /= np.linalg.norm(motion["down"], axis=1, keepdims=True)
    motion["speed"] *= 5
    motion["torque"] *= 10
    motion["goal"][::4, :2] *= 0.02  # asks for no steps
    motion["soft_low"] = -np.abs(motion["soft_low"])
    motion["soft_high"] = np.abs(motion["soft_high"])
    motion["collisions"] = rng.integers(0, 9, size=N)
    motion["landed_air_time"] = rng.uniform(-1, 1, size=N)
    return {name: value.astype(np.float32) if value.dtype == np.float64 else value for name, value in motion.items()}


def run(motion, weight, device):
    """Weighted terms, shape (N, len(TERMS))."""
    columns = Columns()
    for name, value in motion.items():
        dtype = TYPES[VECTORS[name]] if name in VECTORS else {"collisions": wp.int32}.get(name, wp.float32)
        setattr(columns, name, wp.array(value, dtype=dtype, device=device))
    term = wp.full(N, vecT(np.nan), dtype=vecT, device=device)
    wp.launch(_all_terms, dim=N, inputs=[columns, vecT(*weight), DT], outputs=[term], device=device)
    return term.numpy()


def terms_reference(m):
    """Legged Gym's formulas and the tilt, in float64, by name."""
    m = {name: value.astype(np.float64) for name, value in m.items()}
    v, w, goal, q = m["velocity"], m["rate"], m["goal"], m["angle"]
    wants_motion = np.hypot(goal[:, 0], goal[:, 1]) > 0.1
    return {
        "linear_tracking": np.exp(-((v - goal)[:, :2] ** 2).sum(1) / 0.25),
        "yaw_tracking": np.exp(-((w[:, 2] - goal[:, 2]) ** 2) / 0.25),
        "vertical_speed": v[:, 2] ** 2,
        "roll_pitch_rate": (w[:, :2] ** 2).sum(1),
        "tilt": (m["down"][:, :2] ** 2).sum(1),
        "torque": (m["torque"] ** 2).sum(1),
        "joint_acceleration": (((m["speed"] - m["last_speed"]) / DT) ** 2).sum(1),
        "action_rate": ((m["action"] - m["last_action"]) ** 2).sum(1),
        "joint_limit": (np.maximum(m["soft_low"] - q, 0) + np.maximum(q - m["soft_high"], 0)).sum(1),
        "collision": m["collisions"],
        "air_time": np.where(wants_motion, m["landed_air_time"], 0.0),
    }


def test_every_term_matches_reference(device):
    """Each term equals Legged Gym's formula, times its weight and the step's duration, in the order of TERMS."""
    motion = make_motion()
    weight = np.linspace(-2, 3, len(TERMS))
    terms = run(motion, weight, device)
    expected = terms_reference(motion)
    assert set(expected) == set(TERMS)
    for k, name in enumerate(TERMS):
        # Sums of at most 24 numbers whose inputs' differences are rounded: the errors grow with the inputs, not
        # with the sum, which for exp means with its argument, here at most a few hundred.
        tolerance = 2e-4 if "tracking" in name else 40 * 2.0**-24
        np.testing.assert_allclose(
            terms[:, k], DT * weight[k] * expected[name], rtol=tolerance, atol=1e-7, err_msg=name
        )  # fmt: skip
        assert np.ptp(expected[name]) > 0, name


@pytest.mark.parametrize("name", TERMS)
def test_weight_reaches_its_own_term_alone(device, name):
    """A weight of 0 elsewhere leaves one term, that of the weight's name."""
    motion = make_motion(1)
    weight = [float(other == name) for other in TERMS]
    terms = run(motion, weight, device)
    k = TERMS.index(name)
    assert np.abs(terms[:, k]).max() > 0
    assert not np.delete(terms, k, axis=1).any()


def test_perfect_motion_earns_the_two_tracking_weights(device):
    """A robot that does what its goal says, upright and without effort, earns the tracking weights and nothing else."""
    motion = {name: np.zeros_like(value) for name, value in make_motion().items()}
    goal = np.random.default_rng(2).uniform(-1, 1, size=(N, 3)).astype(np.float32)
    motion |= {"goal": goal, "velocity": goal * [1, 1, 0], "rate": goal * [0, 0, 1]}
    motion["down"] = np.tile(np.float32([0, 0, -1]), (N, 1))
    motion |= {"soft_low": motion["angle"] - 1, "soft_high": motion["angle"] + 1}
    weights = RewardWeights()
    terms = run(motion, [getattr(weights, name) for name in TERMS], device)
    expected = np.zeros(len(TERMS))
    expected[:2] = DT * 1.0, DT * 0.5
    np.testing.assert_allclose(terms, np.tile(expected, (N, 1)), rtol=2.0**-22, atol=0)


def test_penalties_do_not_know_left_from_right(device):
    """Turning the sign of everything sideways leaves every term alone: the reward has no handedness."""
    motion = make_motion(3)
    mirrored = dict(motion)
    for name, flip in (("velocity", [1, -1, 1]), ("rate", [-1, 1, -1]), ("down", [1, -1, 1]), ("goal", [1, -1, -1])):
        mirrored[name] = motion[name] * np.float32(flip)
    weight = np.ones(len(TERMS))
    np.testing.assert_array_equal(run(motion, weight, device), run(mirrored, weight, device))


def test_default_weights_are_those_of_the_a1(device):
    """The defaults are Legged Gym's A1 (base list with torques, limits and collisions changed), plus the tilt."""
    a1 = {
        "linear_tracking": 1.0, "yaw_tracking": 0.5, "vertical_speed": -2.0, "roll_pitch_rate": -0.05,
        "torque": -2e-4, "joint_acceleration": -2.5e-7, "action_rate": -0.01, "joint_limit": -10.0, "collision": -1.0,
        "air_time": 1.0,
    }  # fmt: skip
    assert vars(RewardWeights()) == a1 | {"tilt": -1.0}


ADDED = {
    rewards: ("LegMotion", "RewardWeights", "sideways_speed", "wp.abs(m.velocity[1])"),
    arm_rewards: ("ArmMotion", "ArmWeights", "arm_distance", "m.distance"),
}
"""What a term that somebody adds reads, and its weight, function and formula."""


@pytest.fixture(params=ADDED, ids=lambda module: module.__name__)
def extended(request, tmp_path, monkeypatch):
    """A rewards file to which a term was added, by a function and a weight of its name and nothing else."""
    motion, weights, name, formula = ADDED[request.param]
    lines = Path(request.param.__file__).read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"class {weights}"))
    end = next(i for i in range(at, len(lines)) if lines[i].startswith(tuple("ABCDEFGHIJKLMNOPQRSTUVWXYZ")))
    lines[end:end] = [f"    {name}: float = 3.0", '    """A new term."""', ""]
    at = next(i for i, line in enumerate(lines) if line.startswith("_FUNCTIONS"))
    lines[at:at] = ["@wp.func", f"def {name}(m: {motion}) -> float:", f"    return {formula}", "", ""]
    file = tmp_path / f"{request.param.__name__.rpartition('.')[2]}_extended.py"
    file.write_text("\n".join(lines))
    spec = importlib.util.spec_from_file_location(f"deimos.kernels.legged.{file.stem}", file)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module, name


def test_a_term_is_one_function_and_one_weight(extended, device):
    """A term that is added to its file alone has a name for the log and is weighted under it, the others as before."""
    module, name = extended
    if hasattr(module, "RewardWeights"):
        vector, motion, weigh, terms = module.vecT, module.LegMotion, module.weighted_terms, module.TERMS
    else:
        vector, motion, weigh, terms = module.vecA, module.ArmMotion, module.weighted_arm_terms, module.ARM_TERMS

    @wp.kernel(module="unique")
    def weigh_one(weight: vector, term: wp.array[vector]):
        m = motion()
        m.dt = 0.5
        if wp.static("distance" in motion.vars):
            m.distance = 2.0
        else:
            m.velocity = wp.vec3(0.0, -2.0, 0.0)
        term[0] = weigh(m, weight)

    assert terms[-1] == name
    term = wp.full(1, vector(np.nan), dtype=vector, device=device)
    weight = vector(*[float(each == name) * 3.0 for each in terms])
    wp.launch(weigh_one, dim=1, inputs=[weight], outputs=[term], device=device)
    assert term.numpy()[0].tolist() == [0.0] * (len(terms) - 1) + [0.5 * 3.0 * 2.0]


def test_a_weight_without_a_function_is_named():
    """Whoever forgets the function learns so when the file is imported, and which one it is."""

    @dataclass
    class Weights:
        tilt: float = 1.0
        wobble: float = 1.0

    with pytest.raises(NameError, match=r"Weights has weights without a @wp.func of the same name: wobble\."):
        functions_of(Weights, {"tilt": rewards.tilt, "wobble": 3})
