"""What a bit-exact resume needs, by the names of attributes."""

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from deimos.nn.networks import weights_of
from deimos.nn.seeds import restore


class Stateful:
    """Saves and restores the attributes that its class names.

    A tensor is copied, and written in place when it is restored, for others may hold views of it. Networks, generators
    and what has a ``state_dict`` of its own are saved by it, the items of a tuple one by one; all else is plain.
    """

    saved: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes; ``state_dict`` has them without a leading underscore."""

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        return {name.lstrip("_"): _state(getattr(self, name)) for name in self.saved}

    def load_state_dict(self, state: dict) -> None:
        """Continue from ``state_dict()``.

        Raises:
            KeyError: If something is missing in it.
            RuntimeError, ValueError: If it belongs to something of another size.
        """
        for name in self.saved:
            setattr(self, name, _restored(getattr(self, name), state[name.lstrip("_")]))


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
    """``value`` after it has taken over a state; another one only where it is plain."""
    if isinstance(value, Tensor):
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
