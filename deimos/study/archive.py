"""The policies of a study in one file, ``policies.zip``, so that a new attacker needs no new training.

It holds every cell's ``cell.json``, ``run/config.json``, ``run/policy.pt`` and, if there is one, ``fear.pt``. The same
files give the same bytes: names are sorted, and there are no times.
"""

import re
import zipfile
from pathlib import Path
from typing import BinaryIO

from deimos.checks import RunError, one_line
from deimos.files import UNREADABLE, open_file, read_bytes, write_bytes, write_whole
from deimos.run.folder import RunFolder
from deimos.study.folder import FEAR, StudyFolder
from deimos.study.results import SCHEMA, Results

FILE = "policies.zip"
PARTS = ("cell.json", "run/config.json", "run/policy.pt", FEAR)
MOST_BYTES = 2**28  # in a part
_NAME = re.compile(rf"(?!\.\.?/)[\w.+-]+/({'|'.join(map(re.escape, PARTS))})")


def pack(study: StudyFolder) -> tuple[Path, int]:
    """Add the policies of a study's finished cells to its archive.

    Returns:
        The archive, and how many policies it holds.

    Raises:
        RunError: If there is none, or a file cannot be read or written.
    """
    path = study.path / FILE
    files = _read(path) if path.exists() else {}
    cells = study.cells()
    finished = study.finished(cells)
    for cell in cells:
        home = study.cell_path(cell)
        if cell.digest in finished and (home / "run" / "policy.pt").exists():
            files |= {f"{cell.name}/{part}": read_bytes(home / part) for part in PARTS if (home / part).exists()}
    if not files:
        raise RunError(f"{study.path} has no finished cell whose policy could be packed.")

    def write(file: BinaryIO) -> None:
        with zipfile.ZipFile(file, "w") as archive:
            for name in sorted(files):
                info = zipfile.ZipInfo(name)  # dated 1980, wherever and whenever it is written
                info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
                archive.writestr(info, files[name], compresslevel=9)

    write_whole(path, write)
    return path, len({name.partition("/")[0] for name in files})


def unpack(study: StudyFolder) -> int:
    """Put the policies of a study's archive back into folders of cells, with their rows of the study's tables.

    Existing cells stay as they are, but for those with rows and without a run: a study that is continued from its
    tables has them. Returns how many were put back; raises ``RunError`` if the archive is broken.
    """
    path = study.path / FILE
    if not path.exists():
        return 0
    files, tables = _read(path), Results.read(study.path)
    told = {row["hash"][:8] for row in tables.rows}  # as a cell's name ends
    back = 0
    for name in sorted({entry.partition("/")[0] for entry in files}):
        home = study.path / "cells" / name
        is_lost = name.rpartition("-")[2] in told and not (home / "run" / "config.json").exists()
        if (home / "cell.json").exists() and not is_lost:
            continue
        (home / "run").mkdir(parents=True, exist_ok=True)
        if not (home / "result.json").exists():
            _put_rows(home, tables)
        for part in reversed(PARTS):  # cell.json is the last: with it the cell is there
            if data := files.get(f"{name}/{part}"):
                write_bytes(home / part, data)
        back += 1
    return back


def _put_rows(home: Path, tables: Results) -> None:
    """Make a cell's ``result.json`` from its rows in the tables, so that it is finished."""
    digits = home.name.rpartition("-")[2]  # the first ones of its hash
    rows, curves = ([row for row in part if row["hash"].startswith(digits)] for part in (tables.rows, tables.curves))
    if rows and curves:
        RunFolder(home).write_json("result.json", {"schema": SCHEMA, "rows": rows, "curve": curves[0]})


def _read(path: Path) -> dict[str, bytes]:
    """The files of an archive by their names."""
    try:
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            for info in archive.infolist():
                if not _NAME.fullmatch(info.filename) or info.file_size > MOST_BYTES:
                    raise ValueError(f"it holds {info.filename!r}, {info.file_size} bytes")
            return {name: archive.read(name) for name in archive.namelist()}
    except UNREADABLE as error:
        raise RunError(f"{path} is not an archive of policies, or it is broken ({one_line(error)}).") from error
