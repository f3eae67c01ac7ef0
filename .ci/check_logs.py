"""Weights & Biases itself, offline: `python .ci/check_logs.py` (extra wandb).

A run is killed some iterations after its last checkpoint and resumed; the files that `wandb sync` would send have every
iteration once, with the numbers of progress.csv, and the clips of the policy.
"""

import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from wandb.proto.wandb_internal_pb2 import Record

from deimos.run import training
from deimos.run.folder import RunFolder

SAVED, KILLED, END = 3, 6, 9  # iterations: of the last checkpoint, of the kill and in all
FILMED = [3, 6, 9]  # iterations with a video
RUN = f"""
import os, signal, sys
from pathlib import Path
from deimos.run import training
from deimos.run.trainer import TrainConfig

training.CHECKPOINT_SECONDS = -1.0
def report(row, fps):
    if row["iteration"] > {SAVED}:
        training.CHECKPOINT_SECONDS = 1e9
    if row["iteration"] == {KILLED}:
        os.kill(os.getpid(), signal.SIGKILL)

config = TrainConfig(
    num_envs=16, env_steps={24 * END}, device="cpu", threads=1, evaluation=False, log=("wandb",), video_every=3
)
training.train(*training.start(config, Path(sys.argv[1])), report)
"""
BLOCK, HEADER = 32768, 7  # of LevelDB's log format, in which wandb stores its records


def records(path: Path) -> Iterator[Record]:
    """The records of a wandb file."""
    data = path.read_bytes()
    place, parts = HEADER, b""  # the file's header is as long
    while place + HEADER <= len(data):
        if BLOCK - place % BLOCK < HEADER:  # the rest of a block is padding
            place += BLOCK - place % BLOCK
            continue
        _, size, kind = struct.unpack("<IHB", data[place : place + HEADER])
        parts += data[place + HEADER : place + HEADER + size]
        place += HEADER + size
        if kind in (1, 4):  # a whole record, or the last part of one
            yield Record.FromString(parts)
            parts = b""


def main() -> None:
    """Run the check; ends with an error if something does not hold."""
    os.environ["WANDB_MODE"] = "offline"
    with tempfile.TemporaryDirectory() as home:
        path = Path(home) / "run"
        killed = subprocess.run([sys.executable, "-c", RUN, str(path)])
        assert killed.returncode == -signal.SIGKILL, killed
        trainer, folder = training.resume(path)
        assert trainer.iteration == SAVED
        assert training.train(trainer, folder)
        files = sorted(path.glob("wandb/offline-run-*/run-*.wandb"))
        assert len(files) == 1, files
        history = [record.history for record in records(files[0]) if record.HasField("history")]
        steps = [each.step.num for each in history]
        assert steps == [*range(1, END + 1)], steps
        said = {("reward",): [], ("policy", "path"): []}
        for each in history:
            for item in each.item:
                if (name := tuple(item.nested_key) or (item.key,)) in said:
                    said[name].append((each.step.num, json.loads(item.value_json)))
        rewards, videos = said.values()
        rows = RunFolder(path).read_csv("progress.csv")
        assert rewards == [(int(row["iteration"]), float(row["reward"])) for row in rows], rewards
        assert [step for step, _ in videos] == FILMED, videos
        for step, name in videos:
            clip = files[0].parent / "files" / name
            assert clip.read_bytes() == (path / "videos" / f"{step:06d}.gif").read_bytes(), clip
    print(f"Weights & Biases has the iterations 1 to {END} and their clips once each, after a kill and a resume.")


if __name__ == "__main__":
    main()
