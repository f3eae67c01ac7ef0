"""Checks of the contents of a file of tables; each message names the key, what it must be and what it was."""

from collections.abc import Collection, Mapping
from typing import Any

from deimos.checks import RunError

_WORDS = {dict: "a table", list: "a list", str: "a text", bool: "true or false", int: "a whole number"}
SHOWN = 80  # characters of a value in a message


def check_kind(name: str, value: Any, kind: type, inner: type | None = None) -> Any:
    """The value, which must be of a kind, and its entries of the kind ``inner``; ``RunError`` if it is not."""
    if not _is(value, kind) or (inner and not all(_is(entry, inner) for entry in value)):
        words = _WORDS[kind] + (f", each entry {_WORDS[inner]}" if inner else "")
        raise RunError(f"{name} must be {words}, got {shown(value)}.")
    return value


def _is(value: Any, kind: type) -> bool:
    return isinstance(value, kind) and (kind is not int or not isinstance(value, bool))  # true is a 1 in Python


def check_keys(what: str, data: Mapping[str, Any], known: Collection[str]) -> None:
    """Raise ``RunError`` if a table has a key that is not known."""
    if unknown := sorted(set(data) - set(known)):
        raise RunError(f"{what} has no {', '.join(unknown)}; it has: {', '.join(sorted(known))}.")


def shown(value: Any) -> str:
    """A value for a message, not longer than fits a line."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def check_table(
    what: str, table: dict, kinds: Mapping[str, tuple[type, type | None]], others: Collection[str] = ()
) -> None:
    """Raise ``RunError`` for a key that is not known, or a value of another kind."""
    check_keys(what, table, {*kinds, *others})
    for key in kinds.keys() & table.keys():
        check_kind(key, table[key], *kinds[key])
