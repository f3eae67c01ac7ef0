"""What ``deimos view`` sends in real time, and what it costs a training run next to it; without a browser."""

import asyncio
import os
import re
import signal
import statistics
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.table import Table

from benchmarks.commits import HOME, train_once
from benchmarks.timing import wide_console
from deimos.checks import RunError

ROBOT = HOME / "docs" / "results" / "quad_flat"
VERSION = 120  # bytes of the versions that a page and the viewer exchange before anything else
TRAINING = ["--num-envs", "2000", "--env-steps", "960", "--threads", "1"]


class Page:
    """What a browser does for the page, except drawing it: it loads the model, takes control, receives states.

    Args:
        port: Port of the viewer, on 127.0.0.1.
    """

    def __init__(self, port: int) -> None:
        self._address = f"127.0.0.1:{port}"
        self.states: list[tuple[float, bytes]] = []
        """When each state frame arrived [s], and its content."""
        self.drawn = 0
        """Messages of the panel."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def get(self, path: str) -> tuple[dict[str, str], bytes]:
        """Load a file: its headers, in lower case, and its content."""
        with urllib.request.urlopen(f"http://{self._address}{path}", timeout=60) as answer:
            return {name.lower(): value for name, value in answer.headers.items()}, answer.read()

    def __enter__(self) -> "Page":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join(timeout=60)

    def _run(self) -> None:
        from websockets.exceptions import WebSocketException

        with suppress(OSError, WebSocketException):  # the viewer is gone
            asyncio.run(self._live())

    async def _live(self) -> None:
        """Take control of the viewer and receive what it sends until the end."""
        from websockets.asyncio.client import connect

        options: dict[str, Any] = {"max_size": None, "ping_interval": None, "compression": None}
        # The viewer talks only to pages of its own version, and tells its version to any client that asks.
        async with connect(f"ws://{self._address}/ui?sid=asks", **options) as asking:
            await asking.send(bytes(VERSION))
            version = await asking.recv()
        async with (
            connect(f"ws://{self._address}/ui?sid=page", **options) as panel,
            connect(f"ws://{self._address}/state?sid=page", **options) as states,
        ):
            await panel.send(version)
            tasks = [asyncio.create_task(work) for work in (self._receive(states), self._draw(panel), self._wait())]
            _, others = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in others:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _wait(self) -> None:
        while not self._ended.is_set():
            await asyncio.sleep(0.05)

    async def _receive(self, states: Any) -> None:
        async for message in states:
            if isinstance(message, bytes):
                self.states.append((time.monotonic(), message))
                await states.send("state_ack")

    async def _draw(self, panel: Any) -> None:
        async for _ in panel:
            self.drawn += 1


@contextmanager
def serving(run: Path) -> Iterator[int]:
    """Start ``deimos view`` in a separate process; returns its port.

    Raises:
        RunError: If it does not start.
    """
    command = [sys.executable, "-m", "deimos", "view", str(run)]
    with subprocess.Popen(command, cwd=HOME, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stderr is not None
            found = None
            for line in process.stderr:
                if found := re.search(r"http://127\.0\.0\.1:(\d+)/", line):
                    break
            if found is None:
                raise RunError(f"{' '.join(command)} did not start.")
            yield int(found[1])
        finally:
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
            process.kill()


def measure(rounds: int, seconds: float = 20.0, options: list[str] | None = None) -> dict[str, Any]:
    """State frames per second for one Go1, the viewer's processor time, and training speed next to it and alone.

    Args:
        rounds: Alternating training runs of each kind.
        seconds: How long frames are counted [s], positive.
        options: Options of ``train.py``; by default the main job, shortened, on one thread.
    """
    with serving(ROBOT) as port, Page(port) as page:
        sent = _frames_per_second(page, seconds)
    speeds: dict[str, list[float]] = {"alone": [], "beside the viewer": []}
    for _ in range(rounds):
        speeds["alone"].append(train_once(HOME, options or TRAINING)["FPS"])
        with serving(ROBOT) as port, Page(port) as page:
            _await_frames(page)
            speeds["beside the viewer"].append(train_once(HOME, options or TRAINING)["FPS"])
    ratio = statistics.median(
        beside / alone for alone, beside in zip(speeds["alone"], speeds["beside the viewer"], strict=True)
    )
    return {
        "state frames per second": sent, "training, FPS": {name: statistics.median(v) for name, v in speeds.items()},
        "beside the viewer / alone": ratio, "cores": len(os.sched_getaffinity(0)),
    }  # fmt: skip


def _await_frames(page: Page, patience: float = 120.0) -> None:
    """Wait until frames come.

    Raises:
        RunError: If none does.
    """
    end = time.monotonic() + patience
    while len(page.states) < 3:
        if time.monotonic() > end:
            raise RunError(f"The viewer sent no state frame in {patience:g} s.")
        time.sleep(0.05)


def _frames_per_second(page: Page, seconds: float) -> float:
    """Distinct states among the frames that arrive from now on, per second."""
    _await_frames(page)
    start = len(page.states)
    time.sleep(seconds)
    return len({state for _, state in page.states[start:]}) / seconds


def show(results: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    table = Table(title="deimos view, one Go1", title_justify="left")
    for title in ("", "figure"):
        table.add_column(title, justify="right" if title else "left")
    table.add_row("state frames per second (25 are needed)", f"{results['state frames per second']:.1f}")
    for name, fps in results["training, FPS"].items():
        table.add_row(f"training {name}, FPS", f"{fps:.4g}")
    table.add_row(f"beside / alone, {results['cores']} cores", f"{results['beside the viewer / alone']:.3f}")
    wide_console().print(table)
