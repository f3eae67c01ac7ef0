"""The page in the browser: MuJoCo's web viewer, on the loopback address alone, with a panel of our own.

The viewer runs in a thread of its own and draws from what it is shown last; what a person asks for waits in a queue
until the thread that simulates takes it.
"""

import contextlib
import io
import logging
import socket
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from deimos.app.viewer_panel import Panel
from deimos.checks import RunError

if TYPE_CHECKING:
    from mujoco.studio.viewer_handle import ViewerHandle

HOST = "127.0.0.1"
"""The only address that the page is served on."""


@contextlib.contextmanager
def serve(panel: Panel, port: int) -> "Iterator[tuple[ViewerHandle, int]]":
    """Serve the page; gives the handle that takes models and states, and the port.

    Args:
        panel: What is beside the picture.
        port: Where, in [0, 65535]; 0 takes the first free one from 8080 on.

    Raises:
        RunError: If the port is in use.
    """
    from mujoco.studio import launch_thread, viewer_protocol

    logging.getLogger("WebServer").setLevel(logging.WARNING)
    made: list[Any] = []
    config = viewer_protocol.ViewerConfig(title="Deimos", gfx="web", http_port=port)
    started = partial(_run, config=config, plugins=[_plugin(panel)], made=made)
    with contextlib.redirect_stdout(io.StringIO()):  # what it says itself; the command says where the page is
        handle = launch_thread.launch_thread(started)
        try:
            while not made and handle.is_running():
                panel.wait(0.01)
        except RuntimeError as error:
            raise RunError(f"Port {port} is in use on {HOST}; choose another --port, or 0 for a free one.") from error
        found = made.pop().port  # the viewer itself belongs to its thread, which ends before this process does
        with handle:
            _await_answer(found, panel, handle)
            yield handle, found


def _await_answer(port: int, panel: Panel, handle: "ViewerHandle") -> None:
    """Wait until somebody listens on a port that is bound already."""
    while handle.is_running():
        with contextlib.suppress(ConnectionRefusedError), socket.create_connection((HOST, port)):
            return
        panel.wait(0.01)


def _run(endpoint: Any, config: Any, plugins: list[Any], made: list[Any]) -> None:
    """The thread of the viewer."""
    from mujoco.studio import viewer_protocol

    viewer = _loopback_viewer()(config, endpoint, plugins=plugins)
    made.append(viewer)
    viewer_protocol.run_viewer_loop(viewer)
    # Who holds whom in a circle is undone, so that the viewer is freed here, in its own thread: the garbage collector
    # would do it in any other, beside another viewer's graphics, and the process would crash.
    viewer.plugins = None
    for plugin in plugins:
        plugin.viewer = None


def _loopback_viewer() -> Any:
    """MuJoCo's web viewer, which binds every address of the machine by itself, on ``HOST`` alone."""
    from mujoco.studio import web_viewer

    class LoopbackViewer(web_viewer.WebViewer):
        """See ``_loopback_viewer``."""

        @property
        def _host(self) -> str:
            return HOST

        @_host.setter
        def _host(self, value: str) -> None:
            """The constructor asks for another one."""

        @property
        def port(self) -> int:
            """Where it listens."""
            return self._http_port

    return LoopbackViewer


def _plugin(panel: Panel) -> Any:
    """What hands the events of the viewer to a panel; a class of its own since MuJoCo is imported here at last."""
    from mujoco.studio import messages, plugin

    class Bridge(plugin.ViewerPlugin):
        """See ``_plugin``."""

        @messages.handler
        def on_model(self, _: messages.PostModelEvent) -> None:
            panel.place_camera(self.viewer)

        @messages.handler
        def on_frame(self, _: messages.BuildGuiEvent) -> None:
            panel.draw(self.viewer)

    return Bridge()
