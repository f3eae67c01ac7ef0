"""Files that survive a kill at any moment: writes are atomic, and only regular files are read or written."""

import contextlib
import errno
import glob
import hashlib
import math
import os
import pickle
import re
import secrets
import stat
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO

from deimos.checks import RunError

if TYPE_CHECKING:
    import numpy as np

UNREADABLE = (
    OSError, RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError, MemoryError, ArithmeticError,
    SyntaxError, tokenize.TokenError, struct.error, zlib.error, zipfile.BadZipFile, pickle.UnpicklingError,
)  # fmt: skip
"""What reading damaged and foreign archives has been seen to raise."""
PARTIAL = ".partial"  # suffix of a file that is not complete yet
LONGEST_NAME = 100  # letters
DEFLATED = 1032  # bytes that one byte of an archive stands for at most (RFC 1951)


def open_file(path: Path, mode: str = "rb", **text: Any) -> Any:
    """Open a regular file as ``open`` does, but nothing else: no pipe, which might block, and no device.

    A file to write must not be a link either: its target may be somebody else's.

    Raises:
        OSError: If it cannot be opened, or is not such a file.
    """
    more = getattr(os, "O_NONBLOCK", 0) | (0 if mode[0] == "r" else getattr(os, "O_NOFOLLOW", 0))

    def opener(name: str, flags: int) -> int:
        if mode[0] != "r" and os.path.islink(name):
            raise OSError(errno.ELOOP, "it is a link", name)
        descriptor = os.open(name, flags | more, 0o666)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise OSError(errno.EINVAL, "it is not a regular file", name)
        return descriptor

    return open(path, mode, opener=opener, **text)


def read_bytes(path: Path) -> bytes:
    """Read a file; raises as ``open_file`` does."""
    with open_file(path) as file:
        return file.read()


def require_place(path: Path) -> None:
    """Refuse a path that cannot be written, before long work instead of after it.

    An existing file can be replaced.

    Raises:
        RunError: If its folder is missing or cannot be written to, or it is a folder itself.
    """
    if not path.parent.is_dir():
        raise RunError(f"The folder {path.parent} does not exist; make it first.")
    if path.is_dir():
        raise RunError(f"{path} is a folder.")
    if not os.access(path.parent, os.W_OK):
        raise RunError(f"The folder {path.parent} cannot be written to.")


def save_tensors(path: Path, data: dict) -> None:
    """Write a file of tensors so that at every moment either the old or the new one is complete.

    Raises:
        RunError: If it cannot be written; the previous file is untouched.
    """
    import torch

    write_whole(path, lambda file: torch.save(data, file))


def write_whole(path: Path, write: Callable[[BinaryIO], Any]) -> None:
    """Write a new file next to the old one, flush it to the disk, and only then rename it.

    Raises:
        RunError: If it cannot be written; the previous file is untouched.
    """
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{PARTIAL}")  # others may be writing it too
    try:
        if path.exists() and not path.is_file():
            raise OSError(errno.EINVAL, "it is not a regular file")
        with open_file(temporary, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except (OSError, RuntimeError) as error:  # torch turns a full disk into a RuntimeError
        raise RunError(f"{path} could not be written ({first_line(error)}); what was there is untouched.") from error
    finally:  # an interrupt must not leave half a file either
        with contextlib.suppress(OSError):  # nothing can be deleted on a read-only disk
            temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """``write_whole`` for bytes."""
    write_whole(path, lambda file: file.write(data))


def remove_partial(path: Path) -> None:
    """Delete what killed attempts to write a file have left; nobody may be writing it now."""
    for left in path.parent.glob(f"{glob.escape(path.name)}.*{PARTIAL}"):
        left.unlink(missing_ok=True)


def load_tensors(path: Path, what: str, schema: int, *, oldest: int | None = None) -> dict:
    """Read a file of tensors.

    Args:
        path: The file.
        what: What it is, for the message.
        schema: The schema that it must have.
        oldest: The oldest schema that is read too; ``None`` for ``schema`` alone.

    Raises:
        RunError: If it is missing, broken, foreign or of another version.
    """
    import torch

    try:
        with open_file(path) as file:
            with zipfile.ZipFile(file) as archive:  # torch misses damaged bytes; the archive's checksums do not
                if damaged := archive.testzip():
                    raise ValueError(f"{damaged} is damaged")
            file.seek(0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch's warnings about a foreign file, which is refused anyway
                data = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise RunError(f"There is no {what} at {path}.") from error
    except UNREADABLE as error:  # torch's own message on foreign objects advises to run them
        reason = "it holds more than tensors" if isinstance(error, pickle.UnpicklingError) else first_line(error)
        raise RunError(f"{path} is not a {what}, or it is broken ({reason}).") from error
    found = data.get("schema") if isinstance(data, dict) else None
    if not isinstance(found, int) or not (schema if oldest is None else oldest) <= found <= schema:
        raise RunError(f"{path} is not a {what} of schema {schema}, got {found}.")
    return data


def load_arrays(path: Path) -> "dict[str, np.ndarray]":
    """Read a NumPy file, an ``.npz`` or an ``.npy``, whose one array then has the name "".

    No array is allocated before its size has been checked against what the file has room for.

    Raises:
        OSError: If it cannot be opened.
        ValueError: If it is not such a file, or is broken.
    """
    import numpy as np

    with open_file(path) as file:
        try:
            if not zipfile.is_zipfile(file):
                file.seek(0)
                _check_array(file, os.fstat(file.fileno()).st_size)
                file.seek(0)
                return {"": np.lib.format.read_array(file, allow_pickle=False)}
            with zipfile.ZipFile(file) as archive:
                return dict(_members(archive))
        except UNREADABLE as error:
            raise ValueError(first_line(error)) from error


def _members(archive: zipfile.ZipFile) -> "Iterator[tuple[str, np.ndarray]]":
    """Name and array of every member."""
    import numpy as np

    for info in archive.infolist():
        if info.file_size > DEFLATED * info.compress_size:
            raise ValueError(f"{info.filename} claims {info.file_size} bytes and has {info.compress_size}")
        with archive.open(info) as member:
            _check_array(member, info.file_size)
        with archive.open(info) as member:
            array = np.lib.format.read_array(member, allow_pickle=False)
            member.read()  # the checksum is compared at the end
        yield info.filename.removesuffix(".npy"), array


def _check_array(file: IO[bytes], size: int) -> None:
    """Raise ``ValueError`` unless ``size`` bytes hold an array's header and exactly the data that it promises."""
    from numpy.lib import format as npy

    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file)
    need, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if dtype.hasobject or min(shape, default=0) < 0 or need != there:
        raise ValueError(f"an array of {dtype}{list(shape)} takes {need} bytes, got {there}")


def file_name(text: str) -> str:
    """A text as a file name: unchanged if it is valid everywhere, otherwise without what is not."""
    clean = re.sub(r"[^\w.+-]", "-", text, flags=re.ASCII).lstrip(".-")[:LONGEST_NAME]
    return clean if clean == text else f"{clean}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"  # distinct


def first_line(error: BaseException) -> str:
    """The first line of an error's message, without the full stop; the name of its class if it has none.

    Of an error of the operating system, its text alone, without number and file.
    """
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
