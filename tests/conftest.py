"""Fixtures of all tests: devices that they run on, the reference of every random draw, the text of a short study."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections import namedtuple
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from deimos import plugins

torch.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a script starts the tests in the background
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored under nohup

DEVICES = ["cpu"]
one_stream = contextlib.nullcontext
if find_spec("warp"):  # a base install, which .ci/nightly tests, has none
    import warp as wp

    from deimos.sim.shared import one_stream

    wp.config.log_level = wp.LOG_WARNING
    if wp.get_cuda_device_count() > 0 and torch.cuda.is_available():  # a torch without CUDA cannot share its memory
        DEVICES.append("cuda:0")


OWN_PROCESS = "DEIMOS_TEST_OWN_PROCESS"  # set in the process that a test has for itself
OWN_PATIENCE = 600.0  # [s] for such a test, on a machine that does other things


def pytest_configure(config):
    """Make the markers of these tests known."""
    config.addinivalue_line("markers", "own_process: run the test in a process of its own")


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Run a test that asks for it in a process of its own; what it says there is said here."""
    if pyfuncitem.get_closest_marker("own_process") is None or OWN_PROCESS in os.environ:
        return None
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", pyfuncitem.nodeid]
    done = subprocess.run(
        command, cwd=pyfuncitem.config.rootpath, env=os.environ | {OWN_PROCESS: "1"}, capture_output=True, text=True,
        timeout=OWN_PATIENCE,
    )  # fmt: skip
    if done.returncode != 0:
        pytest.fail(f"{done.stdout}{done.stderr}\nexit code {done.returncode}", pytrace=False)
    return True


@pytest.fixture(scope="session")
def hills(tmp_path_factory):
    """The path of a small saved terrain: 3 levels and 2 columns of stairs."""
    from deimos.terrain.shapes import stairs

    from deimos import terrain

    shapes = tuple(terrain.Share(shape=stairs.Shape(tile=4.0, platform=2.0, direction=way)) for way in ("up", "down"))
    grid = terrain.Grid(shapes=shapes, levels=3, columns=2, tile=4.0, border=2.0, hardest=0.5)
    path = tmp_path_factory.mktemp("terrain") / "hills.npz"
    terrain.build(grid).save(path)
    return str(path)


STUDY = """
seeds = {seeds}
methods = {methods}
[train]
num_envs = 16
env_steps = {env_steps}
device = "cpu"
ppo = {{ hidden = [8], epochs = 1 }}
eval = {{ worlds = 16, steps = 40, adversary_steps = 40 }}
[[environment]]
name = "directional"
env = {{ kind = "particle", variant = "directional", goal_period = 10, max_speed = 200.0, max_force = 200.0 }}
"""


@pytest.fixture(scope="session")
def short_study():
    """Writes the TOML of a study whose cells take seconds and crash, ``head`` first."""

    def text(env_steps, *, seeds=1, methods=("uniform", "p25"), head=""):
        return head + STUDY.format(env_steps=env_steps, seeds=seeds, methods=json.dumps(methods))

    return text


@pytest.fixture
def new_plugins(monkeypatch):
    """What a test registers it registers for itself alone, and modules register themselves anew."""
    own = ("reproduction.oracle", "my_selector", "my_attacker")
    monkeypatch.setattr(plugins, "_registered", {})
    for name in own:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield
    for name in own:
        sys.modules.pop(name, None)


@pytest.fixture(params=DEVICES)
def device(request):
    """Name of a device; on CUDA, torch and Warp run on one stream for as long as the test lasts."""
    with one_stream(torch.device(request.param)):
        yield request.param


Simulator = namedtuple("Simulator", ["engine", "device"])


@pytest.fixture(params=[("warp", name) for name in DEVICES] + [("native", "cpu")], ids="-".join)
def simulator(request):
    """An engine for robots and a device that it knows, for torch."""
    engine, name = request.param
    with one_stream(torch.device(name)):
        yield Simulator(engine, torch.device(name))


@pytest.fixture
def torch_device(device):
    """The same device, for torch."""
    return torch.device(device)


def _philox(counter, key):
    """Philox4x32-10 as the paper states it; counters (..., 4) and keys (..., 2) give words (..., 4)."""
    low = np.uint64(0xFFFFFFFF)
    counter, key = np.asarray(counter, np.uint64) & low, np.asarray(key, np.uint64) & low
    r0, l0, r1, l1 = np.moveaxis(counter, -1, 0)
    k0, k1 = np.moveaxis(key, -1, 0)
    for _ in range(10):
        product_0, product_1 = np.uint64(0xD2511F53) * r0, np.uint64(0xCD9E8D57) * r1
        high_0, high_1 = product_0 >> np.uint64(32), product_1 >> np.uint64(32)
        r0, l0, r1, l1 = high_1 ^ l0 ^ k0, product_1 & low, high_0 ^ l1 ^ k1, product_0 & low
        k0, k1 = (k0 + np.uint64(0x9E3779B9)) & low, (k1 + np.uint64(0xBB67AE85)) & low
    return np.stack(np.broadcast_arrays(r0, l0, r1, l1), axis=-1).astype(np.uint32)


@pytest.fixture
def philox_reference():
    """Words (..., 4) of counters (..., 4) and keys (..., 2)."""
    return _philox


@pytest.fixture
def uniform_reference():
    """Numbers in [0, 1), float64, shape (..., 4), of one address; its parts broadcast."""

    def uniforms(seed, purpose, world, count, index=0, block=0):
        counter = np.stack(np.broadcast_arrays(world, count, index, block), axis=-1)
        return (_philox(counter, [seed, purpose]) >> np.uint32(8)) * 2.0**-24

    return uniforms
