"""The page of ``deimos view``, met as a browser meets it, but for the drawing; and who cannot meet it."""

import errno
import gc
import http.client
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch

from benchmarks import viewer
from deimos.app.view import simulate
from deimos.app.viewer_panel import MAP, Moment, Panel
from deimos.app.viewer_scene import build_scene
from deimos.app.viewer_session import BY_HAND, Session
from deimos.app.viewer_web import check_port, serve
from deimos.checks import RunError
from deimos.goals.fear import Fear, FearConfig
from deimos.run import training
from deimos.run.attack import argmax_director
from deimos.run.saved import SavedRun
from deimos.run.trainer import TrainConfig
from deimos.sim.envs.particle import Config

PATIENCE = 120.0  # [s] for frames, on a machine that does other things

own_process = pytest.mark.own_process  # MuJoCo's viewer does not survive a second one beside it (docs/lab/viewer.md)

# Its server leaves the connection between its own halves to the garbage collector.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(autouse=True)
def _collect_garbage():
    """What a test leaves is collected before another test is blamed for it."""
    yield
    gc.collect()


def some_fear(env):
    """A selector with a fear network that nobody has taught: its map is as good as any to be drawn."""
    fear = Fear(FearConfig(), env.state_dim, env.goal_dim, env.device, seed=0)
    fear.fitted = True
    return argmax_director(env, fear)


@pytest.fixture(scope="module")
def particles(tmp_path_factory):
    """Three particles under a policy that has learnt nothing."""
    path = tmp_path_factory.mktemp("page") / "run"
    config = TrainConfig(env=Config(goal_period=10), num_envs=2, device="cpu", threads=1, evaluation=False)
    _, folder = training.start(config, path)
    return Session(SavedRun.open(folder.path), 3, seed=5, afraid=some_fear)


@pytest.fixture(scope="module")
def robot():
    """A Go1 under the policy that walks."""
    run = SavedRun.open(Path(__file__).parent.parent / "docs" / "results" / "quad_flat")
    return Session(run, 1, seed=5, afraid=some_fear)


@pytest.fixture(scope="module")
def port():
    """Where ``deimos view`` serves, in a process of its own, a Go1 that walks."""
    with viewer.serving(viewer.ROBOT) as port:
        yield port


def meet(session, during=lambda page, panel: None, frames=4):
    """Serve a session until a page has received some frames; gives the page, the panel and what the page loaded."""
    scene = build_scene(session)
    panel = Panel(scene)

    def leave():
        end = time.monotonic() + PATIENCE
        while len(page.states) < frames and time.monotonic() < end:
            time.sleep(0.02)
        during(page, panel)
        panel.ask(interrupt)

    def interrupt(session):
        raise KeyboardInterrupt

    with serve(panel, 0) as (handle, port), viewer.Page(port) as page:
        loaded = {path: page.get(path) for path in ("/", "/web_client.js")}
        watcher = threading.Thread(target=leave)
        watcher.start()
        with pytest.raises(KeyboardInterrupt):
            simulate(session, scene, panel, handle, lambda moment: None, fps=25.0, seconds=None)
        loaded["/model"] = page.get("/model")
        watcher.join()
    return page, panel, loaded


@own_process
def test_a_page_gets_the_model_and_moving_states(robot):
    """The page, its program and the model are served as browsers need them; states follow, the last as it stands."""

    def during(page, panel):
        panel.ask(lambda session: setattr(session, "paused", True))
        end, count = time.monotonic() + PATIENCE, len(page.states)
        while len(page.states) < count + 20 and time.monotonic() < end:
            time.sleep(0.02)

    page, panel, loaded = meet(robot, during)
    robot.paused = False
    headers, text = loaded["/"]
    assert b"<canvas" in text
    assert headers["cross-origin-opener-policy"] == "same-origin"  # else browsers withhold shared memory
    assert headers["cross-origin-embedder-policy"] == "require-corp"
    assert len(loaded["/web_client.js"][1]) > 1000
    model, data = robot.env.scene(0)
    assert model.names in loaded["/model"][1]
    assert len({state for _, state in page.states}) >= 3
    assert data.qpos.tobytes() not in page.states[0][1]
    assert data.qpos.tobytes() in page.states[-1][1]
    assert panel.frames >= 3
    assert page.drawn > 0


@own_process
def test_particles_have_a_page(particles):
    """Particles, their goals and the map of fear are served like robots."""
    page, panel, _ = meet(particles)
    assert len({state for _, state in page.states}) >= 3
    assert panel.frames >= 3


@own_process
def test_what_a_person_does_reaches_the_worlds(particles):
    """What is asked for in the panel's thread is done between two steps of the simulation."""

    def during(page, panel):
        panel.ask(lambda session: session.ask([1.0, 2.0, 3.0]))
        panel.ask(lambda session: setattr(session, "paused", True))

    meet(particles, during)
    assert particles.goals.current == BY_HAND
    assert particles.goal == pytest.approx([1.0, 2.0, 3.0])
    assert particles.paused
    particles.paused = False


def test_a_drag_beyond_the_map_stays_on_it(particles):
    """A mouse that leaves the map with its button down asks for goals of the map's edge, not for any beyond."""
    scene = build_scene(particles)
    panel, imgui = Panel(scene), MagicMock()
    imgui.GetCursorScreenPos.return_value = SimpleNamespace(x=100.0, y=100.0)
    imgui.IsItemActive.return_value, imgui.Combo.return_value = True, (False, 0)
    low, high = (bound.tolist() for bound in particles.bounds())
    for x, y, place in ((9999.0, -9999.0, high[:2]), (-9999.0, 9999.0, low[:2])):
        imgui.GetMousePos.return_value = SimpleNamespace(x=x, y=y)
        panel._draw_map(imgui, Moment.of(particles, scene), MagicMock())
        for command in panel.commands():
            command(particles)
        assert particles.goal[:2] == pytest.approx(place)


def test_goals_are_marked_on_a_map_without_extent(particles):
    """Where they are along an axis, and in the middle of one that is a point, as the speed of a robot that stands."""
    scene = build_scene(particles)
    shown = Moment.of(particles, scene)
    flat = replace(shown.fear, axes=(0, 1), low=(-1.0, 2.0), high=(3.0, 2.0))
    panel, imgui = Panel(scene), MagicMock()
    imgui.GetCursorScreenPos.return_value = SimpleNamespace(x=100.0, y=200.0)
    imgui.Vec2 = lambda x, y: (x, y)
    imgui.IsItemActive.return_value, imgui.Combo.return_value = False, (False, 0)
    goals = {"goal": [0.0, 2.0, 0.0], "next_goal": [3.0, 2.0, 0.0]}
    panel._draw_map(imgui, replace(shown, fear=flat, **goals), MagicMock())
    marks = [call.args[0] for call in imgui.GetWindowDrawList().AddCircle.call_args_list]
    assert marks == [(100 + MAP, 200 + MAP / 2), (100 + MAP / 4, 200 + MAP / 2)]


def own_addresses():
    """Addresses of this machine that are not 127.0.0.1: another one of the loopback's, IPv6's, the network's."""
    found = {("127.0.0.2", socket.AF_INET), ("::1", socket.AF_INET6)}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing; it is an address of documentation (RFC 5737)
            found.add((probe.getsockname()[0], socket.AF_INET))
        except OSError:
            pass  # there is no network here
    return sorted(found - {("127.0.0.1", socket.AF_INET)})


def test_no_other_address_is_served(port):
    """On the same port, this machine's other addresses refuse what 127.0.0.1 accepts."""
    with socket.create_connection(("127.0.0.1", port), timeout=10):
        pass
    for address, family in own_addresses():
        with socket.socket(family) as caller:
            caller.settimeout(10)
            assert caller.connect_ex((address, port)) in (errno.ECONNREFUSED, errno.EADDRNOTAVAIL), address


def answer_to(port, path, host="127.0.0.1:{port}", origin=None):
    """Status of the answer to a request for a WebSocket, or for a file, with the headers of a page."""
    headers = {"Host": host.format(port=port)} | ({} if origin is None else {"Origin": origin.format(port=port)})
    if path.startswith(("/ui", "/state", "/drop")):
        headers |= {
            "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        }  # fmt: skip
    caller = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        caller.request("GET", path, headers=headers)
        return caller.getresponse().status
    finally:
        caller.close()


def test_only_its_own_page_is_answered(port):
    """Another page in the browser, or one by another name of this machine, gets nothing; nobody can send files."""
    for path, status in (("/", 200), ("/model", 200), ("/ui?sid=a", 101), ("/state?sid=a", 101)):
        for host in ("127.0.0.1:{port}", "localhost:{port}", "localhost:9", "localhost"):
            assert answer_to(port, path, host) == status
            assert answer_to(port, path, host, f"http://{host}") == status
            for origin in ("null", "http://example.org", "http://127.0.0.1:1", "https://127.0.0.1:{port}", ""):
                assert answer_to(port, path, host, origin) == 403, (path, host, origin)
        for host in ("example.org:{port}", "127.0.0.1.example.org", "127.0.0.1:{port}@example.org", "", "10.0.0.1"):
            assert answer_to(port, path, host) == 403, (path, host)
            assert answer_to(port, path, host, f"http://{host}") == 403, (path, host)
    for path in ("/drop", "/drop?sid=a", "/dropped"):
        assert answer_to(port, path) == 403
        assert answer_to(port, path, origin="http://127.0.0.1:{port}") == 403


def test_a_request_with_two_hosts_or_origins_is_refused(port):
    """Which of two headers counts is not left to the server."""
    own = "127.0.0.1:{port}"
    for extra in (["Host: example.org"], [f"Origin: http://{own}", "Origin: http://example.org"]):
        lines = ["GET / HTTP/1.1", f"Host: {own}", *extra, "", ""]
        with socket.create_connection(("127.0.0.1", port), timeout=60) as caller:
            caller.sendall("\r\n".join(lines).format(port=port).encode())
            assert b" 403 " in caller.recv(100), extra


def free_port():
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@own_process
def test_a_port_is_free_again(robot):
    """Once it is closed, the page is gone and its port can be had again."""
    wanted = free_port()
    with serve(Panel(build_scene(robot)), wanted) as (_, port):
        assert port == wanted
    with socket.socket() as caller:
        assert caller.connect_ex(("127.0.0.1", wanted)) == errno.ECONNREFUSED
    check_port(wanted)


def test_a_port_that_cannot_be_opened_says_why(monkeypatch):
    """What is wrong with a port is what the system says, not always that it is in use."""

    def refuse(self, address):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    with pytest.raises(RunError, match=r"Port 80 cannot be opened \(Permission denied\) on 127.0.0.1; choose another"):
        check_port(80)


def test_a_viewer_that_does_not_start_says_why(robot, monkeypatch):
    """Where MuJoCo's viewer cannot be made, its reason is the error, in one line."""
    from mujoco.studio.web import web_server

    def broken(port):
        raise RuntimeError("no more\nsockets")

    monkeypatch.setattr(web_server, "bind_loopback_socket", broken)
    with (
        pytest.raises(RunError, match="The viewer does not start: no more sockets"),
        serve(Panel(build_scene(robot)), 0),
    ):
        pass


@own_process
def test_a_broken_panel_stops_the_simulation(robot, monkeypatch):
    """A fault in the viewer's thread ends the simulation with it, instead of leaving a page that stands still."""

    def broken(self, viewer):
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(Panel, "draw", broken)
    scene = build_scene(robot)
    panel = Panel(scene)
    with pytest.raises(ZeroDivisionError, match="a fault"), serve(panel, 0) as (handle, port), viewer.Page(port):
        simulate(robot, scene, panel, handle, lambda moment: None, fps=25.0, seconds=PATIENCE)
    assert torch.isfinite(robot.env.obs).all()


def test_the_benchmark_measures_frames_and_cost(capsys):
    """Frames are counted and trainings run alone and beside the viewer; the table says all of it."""
    tiny = "--num-envs 16 --env-steps 120 --threads 1 --env.goal-period 5".split()
    found = viewer.measure(1, seconds=1.0, options=tiny)
    assert found["state frames per second"] > 0
    assert set(found["training, FPS"]) == {"alone", "beside the viewer"}
    alone, beside = found["training, FPS"].values()
    assert found["beside the viewer / alone"] == pytest.approx(beside / alone)
    viewer.show(found)
    assert f"{found['beside the viewer / alone']:.3f}" in capsys.readouterr().out
