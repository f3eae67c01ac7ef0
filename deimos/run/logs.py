"""Where the numbers of a run are shown while it trains: ``--log tensorboard wandb``.

``progress.csv`` and ``timing.csv`` are the record of a run; logs are views of them. A resumed run writes again what it
wrote before it was killed: each log below explains how it gets every iteration once. A clip of the policy
(``deimos.run.clips``) is logged with the numbers of its iteration.
"""

import re
import shutil
import struct
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol

from deimos.checks import RunError, one_line
from deimos.run.clips import clips
from deimos.run.folder import RunFolder

VIDEO = "policy"  # name of the clips in the logs
WANDB = "wandb.json"  # in a run's folder: the name of the run at Weights & Biases


class Log(Protocol):
    """What numbers are written to."""

    def write(self, iteration: int, row: dict[str, float], clip: Path | None) -> None:
        """Write the results of an iteration: its numbers, and a GIF if one was made."""

    def flush(self) -> None:
        """Make what was written survive a kill: called before every checkpoint."""

    def close(self) -> None:
        """End the log."""


class TensorBoard:
    """Event files in the run's folder.

    All that came before a checkpoint is on the disk when it is written, so a resumed log has no gap; what an earlier
    file says of later iterations, TensorBoard drops when it reads the first step of the next file.
    """

    def __init__(self, folder: RunFolder, facts: dict[str, Any], iteration: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # Files are read in the order of their names, which have the second and then the process: a resumed run must not
        # start in the same second as its predecessor.
        begun = (path.name.split(".")[3] for path in folder.path.glob("events.out.tfevents.*"))
        newest = max((int(second) for second in begun if second.isdigit()), default=0)
        time.sleep(min(max(newest + 1 - time.time(), 0.0), 1.0))
        self._board = SummaryWriter(str(folder.path), purge_step=iteration + 1)
        self.flush, self.close = self._board.flush, self._board.close

    def write(self, iteration: int, row: dict[str, float], clip: Path | None) -> None:
        """See ``Log.write``."""
        for name, value in row.items():
            self._board.add_scalar(name, value, iteration)
        if clip is not None:  # as ``SummaryWriter.add_video`` does, which needs moviepy
            from tensorboard.compat.proto.summary_pb2 import Summary

            data = clip.read_bytes()
            width, height = struct.unpack("<HH", data[6:10])  # GIF's header
            image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
            self._board.file_writer.add_summary(Summary(value=[Summary.Value(tag=VIDEO, image=image)]), iteration)


class WeightsAndBiases:
    """A run of Weights & Biases, under the same identity however often it is resumed; offline if WANDB_MODE says so.

    A separate process writes and sends the numbers, and what it had left to do when the run was killed is unknown. So a
    resumed run writes the log again from the tables of its folder: offline in place of the earlier files, online from
    the first step that has not arrived.
    """

    def __init__(self, folder: RunFolder, facts: dict[str, Any], iteration: int) -> None:
        import wandb

        self._video = wandb.Video
        if not (folder.path / WANDB).exists():
            folder.write_json(WANDB, {"id": uuid.uuid4().hex[:16]})
        stored = folder.read_json(WANDB)
        identity = stored.get("id") if isinstance(stored, dict) else None
        if not isinstance(identity, str) or not re.fullmatch(r"[0-9a-f]{16}", identity):  # it becomes part of a path
            raise RunError(f"{folder.path / WANDB} must hold an id of 16 hexadecimal digits, got {identity!r:.40}.")
        for path in sorted(folder.path.glob(f"wandb/offline-run-*-{identity}")):
            shutil.rmtree(path)
        try:
            self._run = wandb.init(
                project="deimos", name=folder.path.resolve().name, id=identity, resume="allow", dir=str(folder.path),
                config=facts, reinit="create_new", settings=wandb.Settings(console="off"),
            )  # fmt: skip
        except wandb.Error as error:
            raise RunError(
                f"Weights & Biases cannot be reached ({one_line(error)}); log in with `wandb login`, or set "
                f"WANDB_MODE=offline and send the run with `wandb sync` later."
            ) from error
        fps, made = {row["iteration"]: row["fps"] for row in folder.read_csv("timing.csv")}, clips(folder)
        for row in folder.read_csv("progress.csv"):
            known = {name: float(cell) for name, cell in (row | {"fps": fps.get(row["iteration"], "")}).items() if cell}
            if self._run.step <= int(row["iteration"]) <= iteration:
                self.write(int(row["iteration"]), known, made.get(int(row["iteration"])))

    def write(self, iteration: int, row: dict[str, float], clip: Path | None) -> None:
        """See ``Log.write``."""
        video = {VIDEO: self._video(str(clip))} if clip else {}
        self._run.log(row | video, step=iteration, commit=True)

    def flush(self) -> None:
        """See ``Log.flush``; there is nothing to do."""

    def close(self) -> None:
        """See ``Log.close``."""
        self._run.finish()


LOGS: dict[str, Callable[[RunFolder, dict[str, Any], int], Log]] = {
    "tensorboard": TensorBoard, "wandb": WeightsAndBiases,
}  # fmt: skip
"""By the name in ``TrainConfig.log``."""


class Logs:
    """Several logs as one."""

    def __init__(self, logs: list[Log]) -> None:
        self._logs = logs

    def write(self, iteration: int, row: dict[str, float], clip: Path | None) -> None:
        """See ``Log.write``."""
        for log in self._logs:
            log.write(iteration, row, clip)

    def flush(self) -> None:
        """See ``Log.flush``."""
        for log in self._logs:
            log.flush()


@contextmanager
def open_logs(names: tuple[str, ...], folder: RunFolder, facts: dict[str, Any], iteration: int) -> Iterator[Logs]:
    """Open the logs of a run that continues after ``iteration``; its tables hold what came before.

    Args:
        names: Some of ``LOGS``.
        folder: The run's folder.
        facts: Configuration of the run, as JSON types.
        iteration: Number of finished iterations.

    Raises:
        RunError: If one cannot be opened.
    """
    with ExitStack() as stack:
        logs: list[Log] = []
        for name in names:
            log = LOGS[name](folder, facts, iteration)
            stack.callback(log.close)
            logs.append(log)
        yield Logs(logs)
