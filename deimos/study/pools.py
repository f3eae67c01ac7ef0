"""A file for the attacker ``pooled`` for every environment of a study, made from the policies of that environment."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from deimos.checks import RunError
from deimos.files import require_place
from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run.attackers.pooled import make_pool
from deimos.run.evaluation import make_target
from deimos.sim.shared import one_stream
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell
from deimos.study.runner import ATTEMPTS

POOLS = "pools"
"""Name of their folder inside a study's."""


def write_pools(study: StudyFolder, out: Path, device: torch.device) -> Iterator[tuple[Path, dict[str, Any] | None]]:
    """Write OUT/ENVIRONMENT.pt for every environment of a study; an existing file stays as it is.

    Each network learns from all policies of its environment, with the sizes of their evaluation. Where they never
    crashed, or always, the file says that it has learnt nothing. Environments with a cell that was given up get none.

    Yields:
        The files, each once it is there, with the facts of ``deimos.run.attackers.pooled.make_pool``; ``None`` for one
        that existed.

    Raises:
        RunError: If the study has no cells, one of them is open, or a file cannot be read or written.
    """
    cells = study.cells()
    if not cells:
        raise RunError(f"{study.path} holds no policies.")
    require_trained(study, cells)
    failed = {cell.name: cell.environment for cell in given_up(study)}
    environments: dict[str, list[Cell]] = defaultdict(list)
    for cell in cells:
        if cell.environment not in failed.values():
            environments[cell.environment].append(cell)
    out.mkdir(parents=True, exist_ok=True)
    for name in sorted(environments):
        path = out / f"{name}.pt"
        yield path, None if path.exists() else _write(study, environments[name], path, device)


def given_up(study: StudyFolder) -> list[Cell]:
    """The cells of a study that have failed so often that they are not tried again."""
    return [
        cell for cell in study.cells() if not _is_finished(study, cell) and len(study.failures(cell)) >= ATTEMPTS
    ]  # fmt: skip


def require_trained(study: StudyFolder, cells: Sequence[Cell]) -> None:
    """Raise ``RunError`` if a cell of a study is open, or its policy is not in the folder."""
    failed = {cell.name for cell in given_up(study)}
    left = [cell for cell in cells if not _is_finished(study, cell) and cell.name not in failed]
    told = {row["hash"] for row in study.results().rows} if left else set()
    if open_ := [cell for cell in left if cell.digest not in told]:
        raise RunError(
            f"{len(open_)} of {len(cells)} cells are not finished; finish them first: deimos study run {study.path}"
        )
    if left:
        raise RunError(
            f"{len(left)} of {len(cells)} cells have rows in the tables of {study.path}, but no policy there; put the "
            f"policies.zip that belongs to the tables beside them."
        )


def _is_finished(study: StudyFolder, cell: Cell) -> bool:
    return (study.cell_path(cell) / "result.json").exists()


def _write(study: StudyFolder, cells: Sequence[Cell], path: Path, device: torch.device) -> dict[str, Any]:
    require_place(path)
    with one_stream(device), torch_on_one():
        targets = []
        for cell in cells:
            policy = load_policy(study.cell_path(cell) / "run", str(device))
            targets.append(make_target(policy.scaled, cell.config.env, cell.config.eval, device))
        return make_pool(targets, path, may_be_uninformed=True)
