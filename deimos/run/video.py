"""Sequences of pictures, as a video or as files."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from deimos.checks import RunError
from deimos.files import first_line, require_place

CODECS = {".mp4": "libx264", ".mkv": "libx264", ".mov": "libx264", ".webm": "libvpx-vp9", ".gif": "gif"}
"""ffmpeg's codecs, by the ending of the file."""
ENDINGS = (*CODECS, ".webp")
PALETTES = "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=dither=none:new=1"
"""ffmpeg's filter that gives every picture its own 256 colours, for GIF."""
FASTEST_GIF = 50.0  # pictures per second; viewers slow down faster ones
WEBP: dict[str, Any] = {"quality": 50, "method": 4, "loop": 0}
"""How Pillow encodes WebP: a tenth of the size of a GIF."""

Write = Callable[[np.ndarray], object]
"""Takes the next picture, uint8, shape (height, width, 3)."""


@contextmanager
def pictures(folder: Path) -> Iterator[Write]:
    """Writes numbered PNG files into a new folder.

    Raises:
        RunError: If the folder exists, or it cannot be created or written to.
    """
    from PIL import Image

    if folder.exists():
        raise RunError(f"{folder} exists already; choose another folder.")
    with _writing(folder):
        folder.mkdir(parents=True)
    number = itertools.count()

    def write(picture: np.ndarray) -> None:
        path = folder / f"{next(number):06d}.png"
        with _writing(path):
            Image.fromarray(picture).save(path)

    yield write


def require_video(path: Path) -> None:
    """Raise ``RunError`` unless ``path`` ends in one of ``ENDINGS`` and a file can be written there."""
    if path.suffix.lower() not in ENDINGS:
        raise RunError(f"video must end in one of {', '.join(ENDINGS)}, got {path}.")
    require_place(path)


@contextmanager
def video(path: Path, size: tuple[int, int], fps: float) -> Iterator[Write]:
    """Writes a video, whose ending is one of ``ENDINGS``; an incomplete one is deleted.

    Args:
        path: The file; an existing one is overwritten once the new one is complete.
        size: Width and height [pixels].
        fps: Pictures per second; a GIF has 50 at most.

    Raises:
        RunError: If the ending is a different one, the file cannot be written, or there were no pictures.
    """
    require_video(path)
    ending = path.suffix.lower()
    unfinished = path.with_name(f".unfinished-{path.name}")
    try:
        known = CODECS.get(ending)
        encoder = _encoder(unfinished, size, fps, known) if known else _webp(unfinished, path, fps)
        with encoder as send:
            count = itertools.count()

            def write(picture: np.ndarray) -> None:
                with _writing(path):
                    send(np.ascontiguousarray(picture))
                next(count)

            yield write
            if not next(count):
                raise RunError(f"{path} could not be written (there are no pictures).")
        with _writing(path):
            unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def _encoder(path: Path, size: tuple[int, int], fps: float, codec: str) -> Iterator[Write]:
    import imageio_ffmpeg

    options: dict[str, Any] = {"fps": fps, "macro_block_size": 2}
    if codec == "gif":
        options = {
            "fps": min(fps, FASTEST_GIF), "macro_block_size": 1, "pix_fmt_out": "pal8", "quality": None,
            "output_params": ["-vf", PALETTES],
        }  # fmt: skip
    frames = imageio_ffmpeg.write_frames(str(path), size, codec=codec, ffmpeg_log_level="error", **options)
    frames.send(None)
    try:
        yield frames.send
    finally:
        frames.close()


@contextmanager
def _webp(unfinished: Path, path: Path, fps: float) -> Iterator[Write]:
    """Keeps all pictures in memory until the end, when Pillow writes them: ffmpeg does not read animated WebP."""
    from PIL import Image

    kept: list[Any] = []
    yield lambda picture: kept.append(Image.fromarray(picture.copy()))
    if kept:
        times = [round(1000 * number / fps) for number in range(len(kept) + 1)]  # [ms], so that errors do not add up
        lengths = [later - now for now, later in itertools.pairwise(times)]
        with _writing(path):
            kept[0].save(unfinished, save_all=True, append_images=kept[1:], duration=lengths, **WEBP)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn a system's error about writing a file into ``RunError``."""
    try:
        yield
    except OSError as error:
        raise RunError(f"{path} could not be written ({error.strerror or first_line(error)}).") from error
