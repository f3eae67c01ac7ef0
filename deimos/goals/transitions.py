"""The learner's transitions as other people's loops hand them over: checked, numbers as float32, flags as bool."""

import math
from typing import Any

import torch
from torch import Tensor

from deimos.goals.core import GoalCore
from deimos.goals.given import tensor
from deimos.goals.selector import Transitions


class _Checked:
    """A rollout with the parts that were checked; everything else is as it was handed over."""

    def __init__(self, rollout: Transitions, parts: dict[str, Any]) -> None:
        self._rollout = rollout
        vars(self).update(parts)

    def __getattr__(self, name: str) -> Any:  # asked only for what is not an attribute
        return getattr(self._rollout, name)


def checked(rollout: Transitions | None, core: GoalCore, since: int) -> Transitions | None:
    """The rollout that a selector learns from, if there is one.

    Args:
        rollout: Transitions: arrays or tensors of numbers, flags as bool or as numbers 0 and 1.
        core: The selector, and the interactions that it learns from as well.
        since: Step of its last update.

    Raises:
        ValueError: If something is missing; or if the selector needs it, and it does not hold all worlds in all steps
            since then, or holds what does not fit or is not finite.
    """
    if rollout is None:
        return None
    wanted = [*Transitions.__annotations__, "cut_off"]
    missing = [name for name in wanted if not hasattr(rollout, name)]
    if missing:
        raise ValueError(
            f"rollout must have {', '.join(wanted)}, as deimos.goals.selector.Transitions says; it lacks "
            f"{', '.join(missing)}."
        )
    if not core.selector.needs_rollout:
        return rollout
    steps, num_envs = core.interactions.now - since, len(core.weight)
    if rollout.num_steps != steps:
        raise ValueError(
            f"rollout must hold the transitions since the last call of learn(), {steps} steps, got {rollout.num_steps}."
        )
    parts: dict[str, Any] = {}
    for name in ("obs", "reward", "terminated", "truncated", "weight", "advantage"):
        own = getattr(rollout, name)
        values = tensor(f"rollout.{name}", own, core.weight.device)
        expected = (steps + 1, num_envs, *values.shape[2:3]) if name == "obs" else (steps, num_envs)
        if values.shape != expected:
            raise ValueError(f"rollout.{name} must have the shape {expected}, got {tuple(values.shape)}.")
        values = (_flags if name in ("terminated", "truncated") else _numbers)(name, values)
        # The very tensor where there was nothing to convert: selectors may know it.
        parts[name] = own if isinstance(own, Tensor) and own.dtype == values.dtype else values
    for name in ("reward_scale", "discount", "gae_lambda"):
        if not _is_finite(getattr(rollout, name)):
            raise ValueError(f"rollout.{name} must be a finite number, got {getattr(rollout, name)!r}.")
    last = _cut_off(rollout.cut_off(), parts)
    return _Checked(rollout, parts | {"cut_off": lambda: last})


def _is_finite(number: Any) -> bool:
    try:
        return math.isfinite(number)
    except TypeError:  # no number at all
        return False


def _numbers(name: str, values: Tensor) -> Tensor:
    """Numbers of steps and worlds as float32, if they are finite."""
    values = values.float()
    if not bool(values.isfinite().all()):
        step, world = (~values.isfinite()).nonzero()[0, :2].tolist()
        raise ValueError(f"rollout.{name} must be finite, got {values[step, world].tolist()} in world {world}.")
    return values


def _flags(name: str, values: Tensor) -> Tensor:
    """Flags of steps and worlds as bool, of which ``~`` is the opposite."""
    if values.dtype == torch.bool:
        return values
    other = (values != 0) & (values != 1)
    if bool(other.any()):
        step, world = other.nonzero()[0].tolist()
        raise ValueError(f"rollout.{name} must be bool, or 0 and 1, got {values[step, world].item()} in world {world}.")
    return values == 1


def _cut_off(found: Any, parts: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """What ``Transitions.cut_off`` has returned, if it is where each truncated episode ended.

    Args:
        found: Steps, worlds and their last observations.
        parts: The rollout's parts, checked.
    """
    name = "rollout.cut_off()"
    if not isinstance(found, tuple | list) or len(found) != 3:
        raise ValueError(f"{name} must give steps, worlds and their last observations, got {found!r:.80}.")
    truncated, obs = parts["truncated"], parts["obs"]
    step, world, last = (tensor(name, part, obs.device) for part in found)
    if not len(step) and not len(world):
        step, world, last = step.long(), world.long(), obs[:0, 0]
    if step.dim() != 1 or step.shape != world.shape or last.shape != (len(step), obs.shape[2]):
        shapes = ", ".join(str(tuple(part.shape)) for part in (step, world, last))
        raise ValueError(f"{name} must give the shapes (m,), (m,) and (m, {obs.shape[2]}), got {shapes}.")
    if any(rows.is_floating_point() or rows.dtype == torch.bool for rows in (step, world)):
        raise ValueError(f"{name} must give whole numbers of steps and worlds, got {step.dtype} and {world.dtype}.")
    step, world, last = step.long(), world.long(), last.float()
    for rows, what, count in zip((step, world), ("steps", "worlds"), truncated.shape, strict=True):
        if bool(((rows < 0) | (rows >= count)).any()):
            raise ValueError(f"{name} must give {what} in [0, {count}), got {rows.tolist()}.")
    lost = truncated & ~parts["terminated"]
    lost[step, world] = False
    if bool(lost.any()):
        at, where = lost.nonzero()[0].tolist()
        raise ValueError(f"{name} must list every truncated step, but lacks step {at} of world {where}.")
    if not bool(last.isfinite().all()):
        row = int((~last.isfinite()).any(1).nonzero()[0])
        raise ValueError(f"{name} must be finite, got {last[row].tolist()} in world {int(world[row])}.")
    return step, world, last
