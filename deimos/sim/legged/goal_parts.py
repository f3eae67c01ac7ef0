"""The parts of a legged robot's goal, each with its components and all that belongs to them."""

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field

import numpy as np
import torch
import warp as wp
from torch import Tensor

from deimos.kernels.legged.arm import evaluate_arms, reset_arms
from deimos.kernels.legged.arm_goals import ARM, Arm, check_arm, locate_goals, redraw_candidates
from deimos.kernels.legged.arm_rewards import ARM_TERMS, ArmWeights, vecA
from deimos.kernels.legged.rewards import TRACKING_VARIANCE, RewardWeights
from deimos.kernels.legged.state import RATE_SCALE, VELOCITY_SCALE, LeggedWorlds
from deimos.sim.env import ObsField
from deimos.sim.legged.robots import Robot


@dataclass(frozen=True, kw_only=True)
class Launches:
    """Work of a part in the worlds that it was bound to."""

    evaluate: Callable[[LeggedWorlds, slice], None] = lambda worlds, rows: None
    """Evaluates a step in some of the worlds, with their rows: writes the part's terms, tracking and observation. The
    step as a whole is evaluated afterwards."""
    reset: Callable[[], None] = lambda: None
    """Finishes the reset of the worlds in the mask: their first goals and observations."""
    validate: Callable[[wp.array, wp.array, wp.array], wp.Launch] | None = None
    """Records a launch that makes uniform candidates valid; takes the rows, the box's half side and the candidates."""
    errors: Mapping[str, Tensor] = field(default_factory=dict)
    """See ``Env.errors``."""
    points: Callable[[], np.ndarray] | None = None
    """Gives the positions of all goals in the world [m], shape (num_envs, 3)."""


@dataclass(frozen=True, kw_only=True)
class GoalPart:
    """Components of a goal and what belongs to them. The velocity goal, whose kernels are the legs', comes first."""

    range: tuple[float, ...]
    """Half side of the box of goals along every component, in its unit."""
    units: tuple[str, ...]
    """Units of the components."""
    scale: tuple[float, ...]
    """Factors by which the policy sees the components."""
    groups: tuple[int, ...]
    """Numbers of consecutive components that are met or missed together."""
    group_names: tuple[str, ...]
    """Names of these groups."""
    weights: tuple[float, ...]
    """Weights of the groups in the score."""
    at_rest: Callable[[Tensor, Tensor], Tensor]
    """Tracking of each group by robots that stand still, in [0, 1], shape (num_envs, n, groups); takes goals in
    physical units, shape (num_envs, n, components), and the observation's ``fields``, shape (num_envs, size)."""
    fields: tuple[ObsField, ...] = ()
    """The part's fields of the observation, between the last action and the heights."""
    noise: Mapping[str, float] = field(default_factory=dict)
    """Half width of the noise of those fields, in their units."""
    columns: tuple[str, ...] = ()
    """Their terms of the reward."""
    bind: Callable[[LeggedWorlds], Launches] = lambda worlds: Launches()
    """Makes the launches for worlds, once."""


def velocity_goal(weights: RewardWeights, speed: float = 1.0) -> GoalPart:
    """v_x, v_y and yaw rate in the base's frame, uniform in [-1, 1]^3 times ``speed`` (thesis, 4.1.2)."""

    def at_rest(goal: Tensor, seen: Tensor) -> Tensor:
        missed = torch.stack([goal[..., :2].square().sum(-1), goal[..., 2].square()], dim=-1)
        return torch.exp(-missed / TRACKING_VARIANCE)

    return GoalPart(
        range=(speed,) * 3,
        units=("m/s", "m/s", "rad/s"),
        scale=(VELOCITY_SCALE, VELOCITY_SCALE, RATE_SCALE),
        groups=(2, 1),
        group_names=("velocity", "yaw rate"),
        weights=(weights.linear_tracking, weights.yaw_tracking),
        at_rest=at_rest,
    )


def end_effector_goal(robot: Robot, weights: ArmWeights) -> GoalPart:
    """A position of the end effector, in [-1, 1]^3; see ``deimos.kernels.legged.arm_goals``.

    Raises:
        ValueError: If the robot has no arm.
    """
    if robot.arm is None:
        raise ValueError("robot must have an arm for goals of its end effector.")

    def bind(worlds: LeggedWorlds) -> Launches:
        arm = _build_arm(robot, weights, worlds)
        return Launches(
            evaluate=lambda worlds, rows: evaluate_arms(worlds, ARM.rows(arm, rows)),
            reset=lambda: reset_arms(worlds, arm),
            validate=lambda row, scale, candidates: redraw_candidates(worlds, arm, row, scale, candidates),
            errors={"end effector [m]": wp.to_torch(arm.error)},
            points=lambda: locate_goals(worlds, arm).numpy(),
        )

    return GoalPart(
        range=(1.0,) * 3,
        units=("1",) * 3,
        scale=(1.0,) * 3,
        groups=(3,),
        group_names=("end effector",),
        weights=(weights.reach,),
        at_rest=lambda goal, seen: torch.exp(-0.5 * (seen.unsqueeze(1) - goal).abs().sum(-1, keepdim=True)),
        fields=(ObsField("end_effector", 3, "1", 1.0),),
        noise={"end_effector": 0.01},  # what the noise of the joints' angles amounts to
        columns=ARM_TERMS,
        bind=bind,
    )


def _build_arm(robot: Robot, weights: ArmWeights, worlds: LeggedWorlds) -> Arm:
    """The arm's numbers, in the kernels' memory."""
    assert robot.arm is not None
    numbers, n = robot.arm, worlds.worlds.num_envs
    joints = len(numbers.axes)
    arm = ARM.allocate(str(worlds.worlds.goal.device), num_envs=n, num_arm_joints=joints, num_links=joints + 1)
    arm.offset.assign(np.array(numbers.offsets))
    arm.axis.assign(np.array(numbers.axes))
    shoulder = np.array(numbers.shoulder)
    low, high = np.array(numbers.body)
    arm.origin = wp.vec3(shoulder[0], shoulder[1], shoulder[2] + robot.standing_height)
    arm.body_low = wp.vec3(*(low - numbers.radius - shoulder))
    arm.body_high = wp.vec3(*(high + numbers.radius - shoulder))
    arm.clearance = numbers.radius
    arm.weight = vecA(*astuple(weights))
    arm.obs_start = worlds.params.scan_start - 3
    check_arm(arm, worlds)
    return arm
