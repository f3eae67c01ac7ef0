"""Pictures one after another, as a video or as files."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from deimos.checks import RunError

CODECS = {".mp4": "libx264", ".mkv": "libx264", ".mov": "libx264", ".webm": "libvpx-vp9"}
"""What ffmpeg encodes a video with, by the ending of its file."""
ENDINGS = (*CODECS, ".gif")

Write = Callable[[np.ndarray], object]
"""Takes the next picture, uint8, shape (height, width, 3)."""


@contextmanager
def pictures(folder: Path) -> Iterator[Write]:
    """Writes numbered PNG files into a new folder.

    Raises:
        RunError: If the folder exists.
    """
    from PIL import Image

    try:
        folder.mkdir(parents=True)
    except FileExistsError as error:
        raise RunError(f"{folder} exists already; name another folder.") from error
    number = itertools.count()
    yield lambda picture: Image.fromarray(picture).save(folder / f"{next(number):06d}.png")


@contextmanager
def video(path: Path, size: tuple[int, int], fps: float) -> Iterator[Write]:
    """Writes a video, whose ending is one of ``ENDINGS``; one that is cut off does not stay.

    Args:
        path: The file; what is there is overwritten once the new one is whole.
        size: Width and height [pixels].
        fps: Pictures per second.

    Raises:
        RunError: If the ending is another, or it cannot be written.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise RunError(f"video must end in one of {', '.join(ENDINGS)}, got {path}.")
    if not path.parent.is_dir():
        raise RunError(f"The folder of {path} does not exist.")
    unfinished = path.with_name(f".unfinished-{path.name}")
    try:
        with _gif(unfinished, fps) if ending == ".gif" else _encoder(unfinished, size, fps, CODECS[ending]) as write:
            yield write
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def _encoder(path: Path, size: tuple[int, int], fps: float, codec: str) -> Iterator[Write]:
    import imageio_ffmpeg

    frames = imageio_ffmpeg.write_frames(
        str(path), size, fps=fps, macro_block_size=2, codec=codec, ffmpeg_log_level="error"
    )
    frames.send(None)
    try:
        yield lambda picture: frames.send(np.ascontiguousarray(picture))
    finally:
        frames.close()


@contextmanager
def _gif(path: Path, fps: float) -> Iterator[Write]:
    """Each picture has 256 colours of its own, and time is in hundredths of a second."""
    from PIL import Image

    frames: list[Image.Image] = []
    yield lambda picture: frames.append(Image.fromarray(picture).quantize(dither=Image.Dither.NONE))
    duration = max(20, 10 * round(100 / fps))  # [ms]; viewers slow down what is faster
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=duration, loop=0)
