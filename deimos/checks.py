"""Checks of values, and the errors that stop a run; each message names the field, what it must be and what it was."""

import math
import numbers
import re
from collections.abc import Iterable


class RunError(Exception):
    """A run cannot continue for a reason outside the program: a folder, a file, a disk, a device.

    Messages may quote files; characters that should not reach a terminal are escaped.
    """

    def __str__(self) -> str:
        return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in super().__str__())


class SimulationError(RuntimeError):
    """The simulation or the learner has produced invalid numbers; the run must stop."""

    def __init__(self, message: str, rank: int = 0) -> None:
        super().__init__(message)
        self.rank = rank
        """Which of the processes that share a run it happened in."""


def one_line(error: BaseException) -> str:
    """The message of an error in one line."""
    return " ".join(str(error).split())


def check_is(name: str, value: object, kind: type) -> None:
    """Raise ``ValueError`` unless ``value`` is an object of the class ``kind``."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__module__}.{kind.__name__}, got {value!r:.80}.")


def check_whole(name: str, value: int) -> None:
    """Raise ``ValueError`` unless ``value`` is a whole number."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):  # NumPy's whole numbers too
        raise ValueError(f"{name} must be a whole number, got {value!r}.")


def check_at_least(name: str, value: int, least: int) -> None:
    """Raise ``ValueError`` unless ``value`` is a whole number of at least ``least``."""
    check_whole(name, value)
    if not value >= least:
        raise ValueError(f"{name} must be at least {least}, got {value}.")
    if value >= 2**31:
        raise ValueError(f"{name} must be below 2^31, got {value}.")


def check_positive(name: str, value: float, *, finite: bool = False) -> None:
    """Raise ``ValueError`` unless ``value`` is above 0, and finite if asked for."""
    if not value > 0 or (finite and not math.isfinite(value)):
        raise ValueError(f"{name} must be {'finite and ' if finite else ''}positive, got {value}.")


def check_range(name: str, value: float, low: float, high: float, *, finite: bool = False) -> None:
    """Raise ``ValueError`` unless ``value`` is in [low, high], and finite if asked for."""
    if not low <= value <= high or (finite and not math.isfinite(value)):
        end = ")" if finite and math.isinf(high) else "]"
        raise ValueError(f"{name} must be in [{low:g}, {high:g}{end}, got {value}.")


def check_seed(seed: int, spare: int = 0) -> None:
    """Raise ``ValueError`` unless a seed is a whole number in [0, 2^32 - ``spare``)."""
    check_whole("seed", seed)
    if not 0 <= seed < 2**32 - spare:
        raise ValueError(f"seed must be in [0, 2^32{f' - {spare}' if spare else ''}), got {seed}.")


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Raise ``ValueError`` unless ``value`` is one of ``choices``."""
    choices = list(choices)
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got '{value}'.")


def check_device(name: str, value: str) -> None:
    """Raise ``ValueError`` unless ``value`` names a device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``."""
    if not isinstance(value, str) or not re.fullmatch(r"auto|cpu|cuda(:\d+)?", value):
        raise ValueError(f"{name} must be auto, cpu, cuda or cuda:N, got {value!r}.")


def check_names(name: str, value: Iterable[str]) -> None:
    """Raise ``ValueError`` unless ``value`` is a collection of names; one string would be read letter by letter."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ValueError(f"{name} must be a tuple of names, got {value!r}.")


def check_hidden(name: str, sizes: Iterable[int]) -> None:
    """Raise ``ValueError`` unless there is a hidden layer and each has at least one unit."""
    sound = [isinstance(size, numbers.Integral) and size > 0 for size in sizes] if isinstance(sizes, Iterable) else []
    if not sound or not all(sound):
        raise ValueError(f"{name} must be one or more positive layer sizes, got {sizes}.")
