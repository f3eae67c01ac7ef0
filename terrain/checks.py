"""Checks of arguments; each message names the argument, what it must be and what it was."""

import math


def check_positive(name: str, value: float) -> None:
    """Raise ``ValueError`` unless ``value`` is finite and above 0."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and positive, got {value}.")


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ``ValueError`` unless ``value`` is in [low, high]."""
    if not low <= value <= high:
        raise ValueError(f"{name} must be in [{low:g}, {high:g}], got {value}.")


def check_at_least(name: str, value: int, least: int) -> None:
    """Raise ``ValueError`` unless ``value`` is a whole number of at least ``least``."""
    if not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value}.")


def check_ramp(name: str, value: tuple[float, float], least: float = 0.0) -> None:
    """Raise ``ValueError`` unless ``value`` is a pair of finite numbers of at least ``least``."""
    if len(value) != 2 or not all(least <= end < math.inf for end in value):
        raise ValueError(
            f"{name} must be two finite numbers of at least {least:g}, at difficulty 0 and at 1, got {value}."
        )


def cells(name: str, length: float, cell: float) -> int:
    """Number of cells along ``length``.

    Raises:
        ValueError: Unless ``cell`` divides ``length``.
    """
    check_positive("cell", cell)
    number = round(length / cell)
    if abs(number * cell - length) > 1e-6 * cell:
        raise ValueError(f"cell must divide {name} = {length:g} m, got {cell:g} m; {_nearest(length, cell)}.")
    return number


def _nearest(length: float, cell: float) -> str:
    number = max(1, round(length / cell))
    return f"{length / number:.6g} m would do"
