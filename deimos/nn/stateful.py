"""Save and restore what a bit-exact resume needs, by the names of attributes."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from deimos.nn.networks import weights_of
from deimos.nn.ranks import gather_rows, own_rows
from deimos.nn.seeds import restore


class Stateful:
    """Saves and restores the attributes that its class names.

    A tensor is copied, and written in place when it is restored, since others may hold views of it. Networks,
    generators and what has its own ``state_dict`` are saved by it, the items of a tuple one by one; all else is plain.
    """

    saved: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes; ``state_dict`` has them without a leading underscore."""
    unknown: ClassVar[tuple[str, ...]] = ()
    """Names of those in which NaN means that something is unknown or absent. All other numbers must be sound, see
    ``is_sound``, or the run stops."""
    by_world: ClassVar[tuple[str, ...]] = ()
    """Names of those with one row per world: where several ranks share the worlds, each holds its own rows, and a
    saved state those of all. Everything else must be the same on all ranks."""

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs; where several ranks share a run, all must call it."""
        found = {name: getattr(self, name) for name in self.saved}
        found |= {name: gather_rows(found[name]) for name in self.by_world}
        return {name.lstrip("_"): _state(value) for name, value in found.items()}

    def load_state_dict(self, state: dict) -> None:
        """Continue from ``state_dict()``.

        Raises:
            KeyError: If something is missing from it.
            RuntimeError, ValueError: If sizes differ.
        """
        for name in self.saved:
            saved = state[name.lstrip("_")]
            saved = own_rows(saved) if name in self.by_world else saved
            setattr(self, name, _restored(getattr(self, name), saved))

    def must_be_sound(self) -> Mapping[str, Any]:
        """What ``state_dict`` is made of, by name, with 0 for the NaN of unknown values."""
        if type(self).state_dict is not Stateful.state_dict:  # overridden: it may hold anything
            return self.state_dict()
        found = {name.lstrip("_"): getattr(self, name) for name in self.saved}
        return found | {name.lstrip("_"): _known(getattr(self, name)) for name in self.unknown}


def _known(value: Any) -> Any:
    """A number or a tensor with 0 for NaN."""
    if isinstance(value, Tensor):
        return value.where(~value.isnan(), 0.0)
    return 0.0 if math.isnan(value) else value


def _state(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.detach().clone()
    if isinstance(value, nn.Module):
        return weights_of(value)
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, tuple):
        return [_state(item) for item in value]
    if isinstance(value, list):
        return list(value)
    return value.state_dict() if hasattr(value, "state_dict") else value


def _restored(value: Any, state: Any) -> Any:
    """Restore a state into ``value`` and return it; only plain values are replaced."""
    if isinstance(value, Tensor):
        if not isinstance(state, Tensor):  # older versions may have saved it as plain
            state = torch.tensor(state, device=value.device)
        if value.shape != state.shape:
            raise ValueError(f"A tensor of shape {tuple(value.shape)} cannot become one of {tuple(state.shape)}.")
        value.data.copy_(state)
    elif isinstance(value, torch.Generator):
        restore(value, state)
    elif isinstance(value, tuple):
        for item, saved in zip(value, state, strict=True):
            _restored(item, saved)
    elif hasattr(value, "load_state_dict"):
        value.load_state_dict(state)
    else:
        return list(state) if isinstance(state, list) else state
    return value


LARGEST = 1e15
"""Larger numbers come from a fault, and their squares soon leave the range of float32 (3.4e38)."""


def is_sound(value: Tensor) -> Tensor:
    """Where numbers are finite and at most ``LARGEST``."""
    return value.abs() <= LARGEST


def unsound(name: str, value: Any) -> Iterator[tuple[str, Tensor]]:
    """Tensors that ``value`` would save with unsound numbers, except ``Stateful.unknown``: their names, and where.

    Args:
        name: Name of ``value``.
        value: Anything that an attribute of ``Stateful.saved`` may be, or a mapping of such.
    """
    if isinstance(value, float):
        value = torch.tensor(value, dtype=torch.float64, device="cpu")
    if isinstance(value, Tensor):
        if value.is_floating_point() and not bool((sound := is_sound(value.detach())).all()):
            yield name, ~sound
        return
    if isinstance(value, nn.Module):
        parts: Any = weights_of(value)
    elif isinstance(value, tuple | list):
        parts = {str(i): item for i, item in enumerate(value)}
    elif isinstance(value, Stateful):
        parts = value.must_be_sound()
    else:
        parts = value.state_dict() if hasattr(value, "state_dict") else value
    for key, part in parts.items() if isinstance(parts, Mapping) else ():
        yield from unsound(f"{name}.{key}".lstrip("."), part)
