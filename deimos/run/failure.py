"""What a run leaves behind when its numbers are no longer finite, so that the cause can be found."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from torch import Tensor

from deimos.checks import RunError, SimulationError
from deimos.files import save_tensors
from deimos.learn.rollout import Rollout
from deimos.nn.ranks import place, together
from deimos.nn.stateful import LARGEST, unsound
from deimos.run.folder import RunFolder
from deimos.run.trainer import Trainer

REPORT, STATE = "failure.json", "failure.pt"
SHOWN = 16  # worlds, or places of another tensor, that the report lists
SCHEMA = 1  # of both files


def check_finite(trainer: Trainer) -> None:
    """Raise ``SimulationError`` if a number that a checkpoint would keep is huge, or not finite although it must be."""
    for name, bad in unsound("", _parts(trainer)):
        raise SimulationError(
            f"Iteration {trainer.iteration}: {int(bad.sum())} of the {bad.numel()} numbers of {name} are not finite, "
            f"or beyond {LARGEST:g}, the first in row {_places(bad)[0]}."
        )


def dump(trainer: Trainer, folder: RunFolder, error: SimulationError, versions: dict[str, str]) -> None:
    """Record what stopped a run: ``failure.json`` for reading, ``failure.pt`` with all its numbers.

    The report lists every tensor with a number that is not finite, or that is huge: its shape, how many there are, and
    in which worlds (or rows, where a tensor has no worlds); and the first steps of the rollout on which a world broke,
    with what it observed and did before. The state holds the whole rollout. Where several ranks share a run, both are
    about the worlds of the one that failed, counted from its first.
    """
    worlds = trainer.env.num_envs
    rollout = {name: value for name, value in vars(trainer.rollout).items() if isinstance(value, Tensor)}
    cut_off = trainer.rollout.truncated.unsqueeze(2)
    rollout["last_obs"] = trainer.rollout.last_obs.where(cut_off, 0.0)  # elsewhere is what the memory held before
    found = [*unsound("", _parts(trainer)), *unsound("rollout", rollout)]
    report = {
        "schema": SCHEMA, "error": str(error), "rank": error.rank, "iteration": trainer.iteration, "versions": versions,
        "not_finite": [
            {"name": name, "shape": list(bad.shape), "count": int(bad.sum()),
             "worlds" if worlds in bad.shape else "rows": _places(bad, worlds)}
            for name, bad in found
        ],
        "invalid": _invalid(trainer.rollout),
        "last_rows": folder.read_csv("progress.csv")[-10:],
    }  # fmt: skip
    folder.write_json(REPORT, report)
    state = {"schema": SCHEMA, "error": str(error), "rollout": rollout, **trainer.state_dict()}
    save_tensors(folder.path / STATE, state)


def _invalid(rollout: Rollout) -> list[dict[str, Any]]:
    """The first steps after which a world was no longer valid."""
    steps = rollout.invalid.nonzero()[:SHOWN].tolist()
    return [
        {"step": t, "world": world, "obs": rollout.obs[t, world].tolist(), "action": rollout.action[t, world].tolist()}
        for t, world in steps
    ]


def _parts(trainer: Trainer) -> dict[str, Any]:
    return {"ppo": trainer.ppo, "env": trainer.env, "goals": trainer.loop.core}


def _places(bad: Tensor, worlds: int | None = None) -> list[int]:
    """The first worlds where something is true; along the first axis where none has that many."""
    axis = list(bad.shape).index(worlds) if worlds is not None and worlds in bad.shape else 0
    if bad.dim() == 0:
        return [0]
    found = bad.movedim(axis, 0).flatten(1).any(1) if bad.dim() > 1 else bad
    return found.nonzero().squeeze(1)[:SHOWN].tolist()


@contextlib.contextmanager
def dumped(trainer: Trainer, folder: RunFolder, versions: Callable[[], dict[str, str]]) -> Iterator[None]:
    """Report on a ``SimulationError`` raised within the context, and raise it with the path of the report."""
    try:
        yield
    except SimulationError as error:
        try:
            with together():
                if error.rank == place().rank:
                    dump(trainer, folder, error, versions())
        except RunError:  # the disk is full too: the first error is the one to report
            raise error from None
        raise SimulationError(f"{error} Details are in {folder.path / REPORT}.") from error
