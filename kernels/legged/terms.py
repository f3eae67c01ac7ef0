"""Terms of a reward by name: a weight and a function of the same name, and nothing else, make a term."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import warp as wp


def functions_of(weights: type, namespace: Mapping[str, Any]) -> list[wp.Function]:
    """The function of every term, in the order of its weights.

    Args:
        weights: A dataclass with one number for every term.
        namespace: The functions by name: ``globals()`` of the module that defines them.

    Raises:
        NameError: If a weight has no function of its name.
    """
    names = [field.name for field in fields(weights)]
    if missing := [name for name in names if not isinstance(namespace.get(name), wp.Function)]:
        raise NameError(f"{weights.__name__} has weights without a @wp.func of the same name: {', '.join(missing)}.")
    return [namespace[name] for name in names]
