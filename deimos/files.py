"""Files that survive a kill at any moment: each is written atomically."""

import contextlib
import os
import pickle
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from deimos.checks import RunError

UNREADABLE = (
    OSError, RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError,
    struct.error, zlib.error, zipfile.BadZipFile, pickle.UnpicklingError,
)  # fmt: skip
"""What reading damaged and foreign archives was seen to raise."""


def save_tensors(path: Path, data: dict) -> None:
    """Write a file of tensors so that at every moment either the old or the new one is complete.

    Raises:
        RunError: If it cannot be written; the previous file is untouched.
    """
    import torch

    write_whole(path, lambda file: torch.save(data, file))


def write_whole(path: Path, write: Callable[[BinaryIO], Any]) -> None:
    """Write a file under a temporary name, to the disk, and only then rename it.

    Raises:
        RunError: If it cannot be written; the previous file is untouched.
    """
    temporary = path.with_name(path.name + ".partial")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except (OSError, RuntimeError) as error:  # torch turns a full disk into a RuntimeError
        raise RunError(f"{path} could not be written ({first_line(error)}); what was there is untouched.") from error
    finally:  # an interrupt too must not leave half a file
        with contextlib.suppress(OSError):  # nothing can be deleted on a read-only disk
            temporary.unlink(missing_ok=True)


def load_tensors(path: Path, what: str, schema: int, *, oldest: int | None = None) -> dict:
    """Read a file of tensors.

    Args:
        path: The file.
        what: What it is, for the message.
        schema: The schema that it must have.
        oldest: An older schema that is read too; ``None`` for none.

    Raises:
        RunError: If it is missing, broken, foreign or of another version.
    """
    import torch

    try:
        with zipfile.ZipFile(path) as archive:  # torch reads on over damaged bytes; the archive's checksums tell
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} is damaged")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what torch says of a foreign file; it is refused all the same
            data = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise RunError(f"There is no {what} at {path}.") from error
    except UNREADABLE as error:  # torch's own words on foreign objects advise to run them
        reason = "it holds more than tensors" if isinstance(error, pickle.UnpicklingError) else first_line(error)
        raise RunError(f"{path} is not a {what}, or it is broken ({reason}).") from error
    found = data.get("schema") if isinstance(data, dict) else None
    if not isinstance(found, int) or not (schema if oldest is None else oldest) <= found <= schema:
        raise RunError(f"{path} is not a {what} of schema {schema}, got {found}.")
    return data


def first_line(error: BaseException) -> str:
    """What an error says in its first line, without the full stop; the name of its class where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
