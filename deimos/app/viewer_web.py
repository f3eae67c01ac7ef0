"""The page in the browser: MuJoCo's web viewer, on the loopback address alone, with our own panel.

The viewer runs in its own thread and draws what it was last shown; what a user asks for waits in a queue until the
thread that simulates takes it.
"""

import contextlib
import errno
import io
import logging
import re
import socket
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from deimos.app.viewer_panel import Panel
from deimos.checks import RunError, one_line

if TYPE_CHECKING:
    from mujoco.studio.viewer_handle import ViewerHandle

HOST = "127.0.0.1"
"""The only address that the page is served on."""
HOSTS = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]+)?")  # that a browser may ask for; a tunnel has its own port


def check_port(port: int) -> None:
    """Raise ``RunError`` if a port in [0, 65535] cannot be listened on; 0 always can."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does: one just closed is free
        try:
            probe.bind((HOST, port))
        except OSError as error:
            reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be opened ({error.strerror})"
            raise RunError(f"Port {port} {reason} on {HOST}; choose another --port, or 0 for a free one.") from error


@contextlib.contextmanager
def serve(panel: Panel, port: int) -> "Iterator[tuple[ViewerHandle, int]]":
    """Serve the page of a panel and its scene; gives the handle that takes states, and the port.

    Args:
        panel: What is next to the picture, and what the picture shows.
        port: Where, in [0, 65535]; 0 takes the first free one from 8080 on.

    Raises:
        RunError: If the port is in use, or the viewer does not start.
    """
    check_port(port)
    from mujoco.studio import launch_thread, viewer_protocol

    logging.getLogger("WebServer").setLevel(logging.WARNING)
    made: list[Any] = []
    config = viewer_protocol.ViewerConfig(title="Deimos", gfx="web", http_port=port)
    started = partial(_run, config=config, plugins=[_plugin(panel)], made=made)
    with contextlib.redirect_stdout(io.StringIO()):  # its own messages; the command prints where the page is
        handle = launch_thread.launch_thread(started)
        try:
            while not made and handle.is_running():
                panel.wait(0.01)
        except RuntimeError as error:
            raise RunError(f"The viewer does not start: {one_line(error)}") from error
        found = made.pop().port  # the viewer itself belongs to its thread, which ends before this process does
        with handle:
            handle.set_model(panel.scene.model, data=panel.scene.data)
            _await_answer(found, panel, handle)
            yield handle, found


def _await_answer(port: int, panel: Panel, handle: "ViewerHandle") -> None:
    """Wait until something listens on a port that is bound already."""
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
    # Reference cycles are broken, so that the viewer is freed here, in its own thread: the garbage collector would do
    # it in any other, next to another viewer's graphics, and the process would crash.
    viewer.plugins = None
    for plugin in plugins:
        plugin.viewer = None


def is_own(path: str, hosts: list[str], origins: list[str]) -> bool:
    """Whether a request is from the viewer's own page, or from a program that is not a browser.

    A browser lets every page that is open in it send requests to this machine, and does not keep WebSockets from
    reading the answers; it says in ``Origin`` whose page it is. A page whose name is suddenly resolved to this machine
    (DNS rebinding) is of the same origin, but its name is in ``Host``. Models that are dropped on the page are of no
    use here, and the server would keep them in memory without a limit.

    Args:
        path: What is asked for, with its query.
        hosts: Values of the header ``Host``.
        origins: Values of the header ``Origin``.
    """
    if len(hosts) != 1 or not HOSTS.fullmatch(hosts[0]):
        return False
    return origins in ([], [f"http://{hosts[0]}"]) and not path.startswith("/drop")


def _guarded(serve: Callable[..., Any]) -> Callable[..., Any]:
    """The ``serve`` of websockets that MuJoCo calls, with 403 for requests that are not from its own page."""

    def guarded(*arguments: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            headers = request.headers
            if not is_own(request.path, headers.get_all("Host"), headers.get_all("Origin")):
                return connection.respond(403, "Only the page of this viewer may ask for this.\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=check, **options)

    return guarded


@cache  # the server is guarded once
def _loopback_viewer() -> Any:
    """MuJoCo's web viewer, which binds every address and answers every page by itself, on ``HOST`` for its own page."""
    from mujoco.studio import web_viewer
    from mujoco.studio.web import web_server

    web_server.serve = _guarded(web_server.serve)

    class LoopbackViewer(web_viewer.WebViewer):
        """See ``_loopback_viewer``."""

        @property
        def _host(self) -> str:
            return HOST

        @_host.setter
        def _host(self, value: str) -> None:
            """Ignore the constructor, which asks for another one."""

        @property
        def port(self) -> int:
            """Where it listens, once there is a model."""
            return self._http_port

        def _start_server(self) -> None:
            """Wait: MuJoCo 4.0.0 has crashed when a page connected before there was a model."""
            self._web_server = None

        def _update_model(self) -> None:
            """Serve the new model."""
            if self._web_server is None:
                super()._start_server()
            else:
                super()._update_model()

    return LoopbackViewer


def _plugin(panel: Panel) -> Any:
    """Hands the events of the viewer to a panel; the class is made here since MuJoCo is imported only here."""
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
