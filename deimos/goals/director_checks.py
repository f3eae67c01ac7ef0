"""What a ``GoalDirector`` refuses: options, states of other Directors, numbers that would spoil its networks."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from deimos.checks import check_at_least, check_choice, check_is, check_seed, one_line
from deimos.goals import given
from deimos.goals.given import Bound, Candidates, Inputs
from deimos.goals.selector import SelectorConfig

PLAIN = (bool, int, float, str, type(None))


def check_options(
    counts: Mapping[str, int | None], mode: str, first_goals: str, learn_every: int, total_steps: int, seed: int
) -> None:
    """Raise ``ValueError`` if an option is not valid; for their names see ``GoalDirector``.

    Args:
        counts: By name, what is at least 1 or ``None``: ``goal_period`` or ``max_horizon``, and sizes.
        mode: The value of ``autoreset``.
        first_goals: As it was given, like the others.
        learn_every: See above.
        total_steps: See above.
        seed: See above.
    """
    for name, value in counts.items():
        if value is not None:
            check_at_least(name, value, 1)
    if (counts["goal_period"] is None) == (counts["max_horizon"] is None):
        raise ValueError(
            "goal_period must be the steps that a goal is active or, where these vary, max_horizon the most that "
            f"they can be; got {counts['goal_period']} and {counts['max_horizon']}."
        )
    check_choice("autoreset", mode, ["SameStep", "NextStep", "Disabled"])
    check_choice("first_goals", first_goals, ["uniform", "chosen"])
    check_at_least("learn_every", learn_every, 1)
    check_at_least("total_steps", total_steps, 0)
    check_seed(seed)


def placed(device: torch.device | str) -> torch.device:
    """The device with its number, as tensors there have it.

    Raises:
        ValueError: If torch has no such device.
    """
    try:
        return torch.empty(0, dtype=torch.float32, device=device).device
    except (AssertionError, RuntimeError) as error:  # the former where torch was built without CUDA
        raise ValueError(f"device must be one that torch has, got {str(device)!r}: {one_line(error)}") from error


def settings(config: SelectorConfig, goal_box: tuple[Bound, Bound] | None, **others: Any) -> dict[str, Any]:
    """What two Directors must have in common where one continues from the other's state: plain values by name.

    Args:
        config: The selector's configuration; its plain fields count, and those of the dataclasses in it.
        goal_box: Lowest and highest goal.
        **others: What else counts, plain.

    Raises:
        ValueError: If ``config`` is not a configuration but, say, a selector or a class, or ``goal_box`` not two goals.
    """
    check_is("selector", config, SelectorConfig)
    box = None if goal_box is None else _ends(goal_box)
    kind = f"{type(config).__module__}.{type(config).__qualname__}"
    return {"selector": kind, **_plain_fields(config), **others, "goal_box": box}


def _own(value: Any) -> Any:
    """Python's number instead of NumPy's, which ``torch.load(weights_only=True)`` does not read."""
    return value.item() if isinstance(value, np.generic) else value


def _numbers(end: Bound) -> list[float]:
    return np.asarray(end.detach().cpu() if isinstance(end, Tensor) else end).astype(np.float32).tolist()


def _ends(goal_box: tuple[Bound, Bound]) -> list[list[float]]:
    """Lowest and highest goal.

    Raises:
        ValueError: If it is something else, such as a range for each component, or a space.
    """
    try:
        low, high = goal_box
        return [_numbers(low), _numbers(high)]
    except (TypeError, ValueError) as error:
        raise ValueError(
            "goal_box must be the lowest and the highest goal, as in (space.low, space.high) or ([-1, -2], [1, 2]), "
            f"got {goal_box!r:.80}."
        ) from error


def _plain_fields(config: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in [field.name for field in fields(config)] if is_dataclass(config) else ():
        value = _own(getattr(config, name))
        if is_dataclass(value):
            found |= {f"{name}.{inner}": plain for inner, plain in _plain_fields(value).items()}
        elif isinstance(value, PLAIN) or (isinstance(value, tuple) and all(isinstance(part, PLAIN) for part in value)):
            found[name] = value
    return found


def unpacked(state: Mapping[str, Any], own: Mapping[str, Any]) -> tuple[list[int] | None, Any, int]:
    """Sizes, goals and the step of the last update in a saved state.

    Args:
        state: What ``GoalDirector.state_dict`` returned.
        own: Settings of the Director that is to continue from it.

    Raises:
        ValueError: If something is missing, or it is of a Director with other settings, which are named.
    """
    if not isinstance(state, Mapping) or not isinstance(state.get("made_with", own), Mapping):
        raise ValueError(f"state must be what state_dict() of this version returned, got {state!r:.80}.")
    try:
        made_with, sizes, goals, learnt_at = (state[name] for name in ("made_with", "sizes", "goals", "learnt_at"))
    except KeyError as error:
        raise ValueError(f"state must be what state_dict() of this version returned; it lacks {error}.") from error
    differ = [name for name in {**own, **made_with} if own.get(name, ...) != made_with.get(name, ...)]
    if "selector" in differ:  # then so do its fields
        differ = ["selector"]
    if differ:
        ours, theirs = (", ".join(f"{name}={all_.get(name)!r}" for name in differ) for all_ in (own, made_with))
        raise ValueError(f"state must come from a GoalDirector with {ours}, got one with {theirs}.")
    return sizes, goals, learnt_at


def check_candidates(candidates: Candidates, count: int, inputs: Inputs, drawn: bool) -> None:
    """Raise ``ValueError`` if candidates of ``count`` worlds do not fit, or are missing and cannot be ``drawn``.

    What a function makes, and the numbers themselves, are checked where they are needed.
    """
    inputs.check_candidates(candidates, count)
    if candidates is None and not drawn:
        raise ValueError("candidates must be given where GoalDirector was made without a goal_box, got None.")
    if isinstance(candidates, Tensor):
        given.tensor("candidates", candidates, inputs.device)
