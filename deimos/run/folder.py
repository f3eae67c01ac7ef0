"""A run's folder: what is written where, so that it survives a kill at any moment."""

import csv
import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from deimos.checks import RunError
from deimos.files import first_line, write_whole


class RunFolder:
    """The files of one run: ``config.json``, ``progress.csv``, ``timing.csv``, ``checkpoint.pt`` and the rest.

    What cannot be made, read or written raises ``RunError``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, path: Path) -> "RunFolder":
        """Make the folder, which must not exist."""
        try:
            path.mkdir(parents=True)
        except FileExistsError as error:
            reason = f"{path} exists and is not overwritten; choose another --out, or continue with --resume."
            raise RunError(reason) from error
        except OSError as error:
            raise RunError(f"The run folder {path} cannot be made ({error.strerror}).") from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open the folder of an earlier run; it must hold a ``config.json``."""
        if not (path / "config.json").is_file():
            raise RunError(f"{path} is not a run folder: it holds no config.json.")
        return cls(path)

    def write_json(self, name: str, data: Any) -> None:
        """Write a JSON file whole or not at all; NaN becomes null."""
        text = json.dumps(_without_nan(data), indent=2, allow_nan=False) + "\n"
        write_whole(self.path / name, lambda file: file.write(text.encode()))

    def read_json(self, name: str) -> Any:
        """Read a JSON file, which must be there and be JSON."""
        try:
            return json.loads((self.path / name).read_text())
        except (OSError, ValueError) as error:
            raise RunError(f"{self.path / name} cannot be read ({first_line(error)}).") from error

    def keep(self, name: str, read: Callable[[], tuple[bytes, str]]) -> str:
        """Copy a file that a run is built from; gives what the copy is called.

        Args:
            name: What the copy is called, without its ending.
            read: Gives its contents and its ending.
        """
        try:
            data, ending = read()
        except OSError as error:
            raise RunError(f"{error.filename or name} cannot be read ({error.strerror}).") from error
        write_whole(self.path / (name + ending), lambda file: file.write(data))
        return name + ending

    def read_csv(self, name: str) -> list[dict[str, str]]:
        """All whole rows of a CSV file; none if there is no file."""
        path = self.path / name
        if not path.is_file():
            return []
        with path.open(newline="") as file:
            return [row for row in csv.DictReader(file) if None not in row.values()]

    def cut_csv(self, name: str, iteration: int) -> None:
        """Drop the rows after an iteration: a resumed run writes them again."""
        rows = [row for row in self.read_csv(name) if int(row["iteration"]) <= iteration]
        if not rows:
            (self.path / name).unlink(missing_ok=True)
            return
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, rows[0])
        writer.writeheader()
        writer.writerows(rows)
        write_whole(self.path / name, lambda file: file.write(text.getvalue().encode()))

    def append_csv(self, name: str, row: dict[str, float]) -> None:
        """Add a row, and a header where there is none yet; NaN becomes an empty cell."""
        path = self.path / name
        try:
            is_new = not path.exists() or path.stat().st_size == 0
            with path.open("a", newline="") as file:
                writer = csv.writer(file)
                if is_new:
                    writer.writerow(row)
                writer.writerow(["" if isinstance(v, float) and math.isnan(v) else repr(v) for v in row.values()])
        except OSError as error:
            raise RunError(f"{path} could not be written ({error.strerror}); the last checkpoint is whole.") from error


def _without_nan(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
