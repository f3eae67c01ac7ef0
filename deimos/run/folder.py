"""A run's folder: what is written where, and how it survives a kill at any moment."""

import csv
import io
import json
import math
import numbers
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from deimos.checks import RunError
from deimos.files import PARTIAL, first_line, open_file, read_bytes, remove_partial, write_bytes
from deimos.lock import hold

OF_TRAINING = ("config.json", "checkpoint.pt", "policy.pt", "progress.csv", "timing.csv")
"""Files that only the process that trains writes."""
POLICIES, VIDEOS = "policies/*.pt", "videos/*.gif"
"""Files that a run keeps for some iterations; the star stands for the iteration."""
PATIENCE_SECONDS = 60.0  # to wait for a file that another process is adding to


class RunFolder:
    """The files of one run: ``config.json``, ``progress.csv``, ``timing.csv``, ``checkpoint.pt`` and the rest.

    Methods raise ``RunError`` if a file or folder cannot be created, read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._columns: dict[str, list[str]] = {}  # of the files that were added to

    @staticmethod
    def require_new(path: Path) -> None:
        """Refuse a folder for a new run that exists."""
        if path.exists():
            raise RunError(f"{path} exists and is not overwritten; choose another --out, or continue with --resume.")

    @classmethod
    def create(cls, path: Path) -> "RunFolder":
        """Make the folder, which must not exist."""
        cls.require_new(path)
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise RunError(f"The run folder {path} cannot be created ({error.strerror}).") from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open the folder of an earlier run; it must hold a ``config.json``."""
        if not (path / "config.json").is_file():
            raise RunError(f"{path} is not a run folder: it holds no config.json.")
        return cls(path)

    def require_writable(self) -> None:
        """Refuse a folder that cannot be written to, before long work whose result would be lost."""
        if not os.access(self.path, os.W_OK):
            raise RunError(f"{self.path} cannot be written to; work on a copy of it.")

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Hold the run as the only process that trains it; ``RunError`` if another does."""
        with hold(self.path / "lock", str(self.path)):
            for name in OF_TRAINING:
                remove_partial(self.path / name)
            yield

    def adding(self, name: str) -> AbstractContextManager[None]:
        """Hold a file while something is added to it; waits for another process that is doing so."""
        return hold(self.path / f"{name}.lock", str(self.path / name), patience=PATIENCE_SECONDS)

    def write_json(self, name: str, data: Any) -> None:
        """Write a JSON file whole or not at all; NaN becomes null."""
        text = json.dumps(_without_nan(data), indent=2, allow_nan=False) + "\n"
        write_bytes(self.path / name, text.encode())

    def read_json(self, name: str) -> Any:
        """Read a JSON file, which must be there and be JSON."""
        try:
            return json.loads(read_bytes(self.path / name))
        except (OSError, ValueError, RecursionError) as error:  # the last where it is nested too deeply
            raise RunError(f"{self.path / name} cannot be read ({first_line(error)}).") from error

    def read_rows(self, name: str) -> list[dict[str, Any]]:
        """Read a JSON file of rows: a list of tables; none if there is no file."""
        if not (self.path / name).exists():
            return []
        rows = self.read_json(name)
        if not isinstance(rows, list):
            raise RunError(f"{self.path / name} must hold a list of rows, got {type(rows).__name__}.")
        for number, row in enumerate(rows, 1):
            if not isinstance(row, dict):
                raise RunError(f"{self.path / name}, row {number}: it must be a table, got {type(row).__name__}.")
        return rows

    def keep(self, name: str, read: Callable[[], tuple[bytes, str]]) -> str:
        """Copy a file that a run is built from; return the name of the copy.

        Args:
            name: Name of the copy, without its ending.
            read: Returns its contents and its ending.
        """
        try:
            data, ending = read()
        except OSError as error:
            raise RunError(f"{error.filename or name} cannot be read ({error.strerror}).") from error
        write_bytes(self.path / (name + ending), data)
        return name + ending

    def read_csv(self, name: str) -> list[dict[str, str]]:
        """All rows of a CSV file, each of numbers or empty cells; none if there is no file.

        A last line without a line break is that of a killed run, and left out.

        Raises:
            RunError: If it cannot be read, or is damaged; the message names the line.
        """
        path = self.path / name
        if not path.exists():
            return []
        try:
            return list(_rows(read_bytes(path)))
        except OSError as error:
            raise RunError(f"{path} cannot be read ({error.strerror}).") from error
        except ValueError as error:
            way_out = "repair it, or move it away: the run goes on without it."
            raise RunError(f"{path}, {first_line(error)}; {way_out}") from error

    def of_iterations(self, pattern: str) -> dict[int, Path]:
        """The files that the run has kept, ``POLICIES`` or ``VIDEOS``, by iteration."""
        found = sorted(self.path.glob(pattern))
        return {int(path.stem): path for path in found if path.stem.isdecimal()}

    def of_iteration(self, pattern: str, iteration: int) -> Path:
        """Path of the file to write for an iteration; creates its folder."""
        path = self.path / pattern.replace("*", f"{iteration:06d}")
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise RunError(f"{path.parent} cannot be created ({error.strerror}).") from error
        return path

    def cut_iterations(self, pattern: str, iteration: int) -> None:
        """Drop the files after an iteration, and half a file of a kill: a resumed run writes them again."""
        later = [path for number, path in self.of_iterations(pattern).items() if number > iteration]
        for path in [*later, *self.path.glob(f"{pattern}.*{PARTIAL}")]:
            try:
                path.unlink()
            except OSError as error:
                raise RunError(f"{path} could not be deleted ({error.strerror}).") from error

    def policy(self, iteration: int | None = None) -> Path:
        """The file of the last policy, or of the one that was kept after an iteration (``save_every``)."""
        if iteration is None:
            return self.path / "policy.pt"
        kept = self.of_iterations(POLICIES)
        if iteration not in kept:
            there = ", ".join(map(str, kept)) or "none"
            raise RunError(f"{self.path} has kept no policy of iteration {iteration}; it has those of: {there}.")
        return kept[iteration]

    def cut_csv(self, name: str, iteration: int) -> None:
        """Drop the rows after an iteration, and half a line: a resumed run writes them again."""
        rows = self.read_csv(name)
        kept = [row for row in rows if int(row["iteration"]) <= iteration]
        path = self.path / name
        if not kept:
            path.unlink(missing_ok=True)
            self._columns.pop(name, None)  # or the next row would go without their names
        elif len(kept) < len(rows) or not read_bytes(path).endswith(b"\n"):
            self._write_csv(name, kept[0], kept)

    def append_csv(self, name: str, row: dict[str, float]) -> None:
        """Add a row, and columns that are new in it; NaN becomes an empty cell.

        Raises:
            RunError: If it cannot be written.
            TypeError: If a value is not a number.
        """
        path = self.path / name
        cells = {key: _cell(key, value) for key, value in row.items()}
        if name not in self._columns:
            self._columns[name] = [*next(iter(self.read_csv(name)), {})]
        columns = self._columns[name]
        if columns and (new := [key for key in row if key not in columns]):  # from a version that writes more
            columns += new
            self._write_csv(name, columns, self.read_csv(name))
        try:
            with open_file(path, "a", newline="") as file:
                writer = csv.DictWriter(file, columns or [*row], restval="")
                if not columns:
                    columns += row
                    writer.writeheader()
                writer.writerow(cells)
        except OSError as error:
            raise RunError(f"{path} could not be written ({error.strerror}); the last checkpoint is whole.") from error

    def sync(self) -> None:
        """Flush the tables of the training to the disk: a checkpoint without its rows would leave a gap in them."""
        for path in (self.path / name for name in OF_TRAINING if name.endswith(".csv")):
            try:
                with open_file(path, "rb+") as file:
                    os.fsync(file.fileno())
            except FileNotFoundError:
                continue
            except OSError as error:
                raise RunError(f"{path} could not be written ({error.strerror}).") from error

    def _write_csv(self, name: str, columns: Iterable[str], rows: Iterable[dict[str, str]]) -> None:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, [*columns], restval="")
        writer.writeheader()
        writer.writerows(rows)
        write_bytes(self.path / name, text.getvalue().encode())


def _cell(name: str, value: Any) -> str:
    """A number as it is written, NumPy's and one-element tensors like Python's; NaN as an empty text."""
    if isinstance(value, numbers.Integral):
        return repr(int(value))
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be a number, got {value!r}.") from error
    return "" if math.isnan(number) else repr(number)


def _rows(data: bytes) -> Iterator[dict[str, str]]:
    """The rows of a CSV file of numbers whose iterations grow; ``ValueError`` names the first line that is not one."""
    lines = data.decode("utf-8-sig", "surrogateescape").split("\n")[:-1]  # the last line is incomplete
    columns: list[str] = []
    last = 0
    for number, line in enumerate(lines, 1):
        try:
            (cells,) = csv.reader([line.removesuffix("\r")], strict=True)
            if not columns:
                if "iteration" not in cells or len(set(cells)) < len(cells) or not all(map(str.isprintable, cells)):
                    raise ValueError("the names of the columns, iteration among them, are missing or damaged")
                columns = cells
                continue
            if len(cells) != len(columns):
                raise ValueError(f"it must have {len(columns)} cells, got {len(cells)}")
            row = dict(zip(columns, cells, strict=True))
            for cell in filter(None, cells):
                float(cell)
            if not int(row["iteration"]) > last:
                raise ValueError(f"its iteration must be above {last}, got {row['iteration']}")
            last = int(row["iteration"])
        except (csv.Error, ValueError) as error:
            raise ValueError(f"line {number}: {ascii(first_line(error))[1:-1]}") from error
        yield row


def _without_nan(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
