"""Clips of the policy while it learns: ``videos/ITERATION.gif`` in a run's folder, where the logs find them."""

import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from deimos.checks import RunError, one_line
from deimos.files import write_bytes
from deimos.nn.ranks import PATIENCE
from deimos.run.folder import RunFolder

VIDEOS = "videos"
# The first compilation of mujoco-warp takes a minute or two; other ranks, which wait for the clip, must not give up.
PATIENCE_SECONDS = 0.8 * PATIENCE.total_seconds()

_log = logging.getLogger(__name__)


def clips(folder: RunFolder) -> dict[int, Path]:
    """The clips of a run, by the iteration after which each was made."""
    found = (folder.path / VIDEOS).glob("*.gif")
    return {int(path.stem): path for path in sorted(found) if path.stem.isdecimal()}


def cut_clips(folder: RunFolder, iteration: int) -> None:
    """Drop the clips after an iteration: a resumed run makes them again.

    Raises:
        RunError: If one cannot be deleted.
    """
    for number, path in clips(folder).items():
        if number > iteration:
            try:
                path.unlink()
            except OSError as error:
                raise RunError(f"{path} could not be deleted ({error.strerror}).") from error


def render(run: Path, policy: Path, clip: Path) -> None:
    """Make a clip of a policy in the worlds of a run, in a separate process.

    Raises:
        OSError, subprocess.SubprocessError: If it fails; what the process wrote is in ``stderr``.
    """
    subprocess.run(
        [sys.executable, "-m", "deimos.run.film", str(run), str(policy), str(clip)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=True,
        timeout=PATIENCE_SECONDS, start_new_session=True,  # Ctrl-C stops the training, after this clip
        env=os.environ | {"CUDA_VISIBLE_DEVICES": ""},  # the world of a clip is on the CPU; the GPU is for training
    )  # fmt: skip


class Camera:
    """Makes a clip every ``every`` iterations; after a failure it warns and makes no more.

    Args:
        folder: The run's folder.
        every: Iterations from one clip to the next, at least 0; 0 for none.
    """

    def __init__(self, folder: RunFolder, every: int) -> None:
        self._folder, self._every = folder, every

    def after(self, iteration: int, save_policy: Callable[[Path], None]) -> Path | None:
        """The clip of an iteration; ``None`` if none is due, or it could not be made.

        Args:
            iteration: Its number, from 1.
            save_policy: Writes the policy as it is now into a file.
        """
        if not self._every or iteration % self._every:
            return None
        path = self._folder.path / VIDEOS / f"{iteration:06d}.gif"
        try:
            with TemporaryDirectory() as home:
                policy, clip = Path(home) / "policy.pt", Path(home) / "clip.gif"
                save_policy(policy)
                render(self._folder.path, policy, clip)
                path.parent.mkdir(exist_ok=True)
                write_bytes(path, clip.read_bytes())
        except (OSError, RunError, subprocess.SubprocessError) as error:
            said = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else ""
            reason = said.splitlines()[-1] if said else one_line(error)
            _log.warning("There will be no videos in the logs from iteration %d on: %s", iteration, reason)
            self._every = 0
            return None
        return path
