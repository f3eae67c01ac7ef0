"""What a GPU needs, proved on a CPU: its threads, streams, captures and devices."""

import contextlib
import gc
import re
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from deimos.kernels import goals, lanes
from deimos.terrain import Grid, Share, build
from deimos.terrain.shapes.stairs import Shape as Stairs
from torch.utils._python_dispatch import TorchDispatchMode

from deimos.checks import RunError
from deimos.goals.selectors import director, q_fear
from deimos.learn.ppo import PPOConfig
from deimos.nn.threads import tf32_products
from deimos.run import oracle, training
from deimos.run.loop import GoalLoop, spaces
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim import shared
from deimos.sim.envs import particle, quad, quad_arm
from deimos.sim.graphs import no_garbage_collected
from deimos.sim.legged import engines
from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.robots import go1

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
TASKS = {
    "particle": particle.Config(variant="relative", goal_period=7, time_limit=20),
    "quad": quad.Config(engine="native", goal_period=7),
    "quad-warp": quad.Config(engine="warp", goal_period=7),
    "quad_arm": quad_arm.Config(engine="native", terrain="rough", goal_period=7),
}


def rollout(config, steps=24):
    """What an environment gives back over some steps of random actions, with new goals on the way."""
    env = config.build(67, CPU, seed=3)
    generator = torch.Generator().manual_seed(0)
    seen = []
    for _ in range(steps):
        action = torch.randn(67, env.action_dim, generator=generator)
        step = env.step(action)
        seen += [tensor.clone() for tensor in (step.obs, step.reward, step.terminated, step.goal_due)]
        done = step.terminated | step.truncated
        rows = torch.nonzero(step.goal_due & ~done).squeeze(1)
        candidates = env.sample_goals(rows, 40)
        seen += [candidates.clone(), env.draw(rows).clone()]
        env.set_goals(rows, candidates[:, 0])
        env.reset(done)
        seen.append(env.obs.clone())
    return env.worlds.num_threads, seen


@pytest.mark.parametrize("task", TASKS)
def test_threads_of_a_gpu_give_the_bits_of_one(task, monkeypatch):
    """An environment whose kernels divide their worlds into threads as on a GPU computes the same bits."""
    threads, expected = rollout(TASKS[task])
    monkeypatch.setattr(lanes, "AS_ON_GPU", True)
    many, found = rollout(TASKS[task])
    assert (threads, many) == (1, 67)
    for one, other in zip(expected, found, strict=True):
        torch.testing.assert_close(other, one, rtol=0.0, atol=0.0, equal_nan=True)


def test_threads_of_a_gpu_cast_the_same_rays(monkeypatch):
    """A terrain that is rasterised by a thread for every sample has the heights of one thread for all."""
    grid = Grid(shapes=(Share(shape=Stairs(tile=4.0, platform=1.0)),), levels=1, columns=1, tile=4.0, border=1.0)
    expected = build(grid).heights
    launched = []
    launch = wp.launch
    monkeypatch.setattr(wp, "launch", lambda kernel, dim, **more: launched.append(dim) or launch(kernel, dim, **more))
    monkeypatch.setattr(lanes, "AS_ON_GPU", True)
    assert (build(grid).heights == expected).all()
    assert max(launched) > 1


def test_wide_kernels_are_modules_of_their_own():
    """A GPU, whose threads draw one candidate each, does not compile the kernel for a CPU's vectors."""
    narrow, wide = goals._draw_candidates, goals._draw_wide_candidates
    assert narrow.module.name == "deimos.kernels.goals"
    assert wide.module.name == "deimos.kernels.goals.wide"


def test_a_stream_begins_warp():
    """In a process in which nothing has begun Warp, ``one_stream`` does; what fails then is that there is no GPU."""
    program = (
        "import torch\nfrom deimos.sim.shared import one_stream\n"
        "try:\n    with one_stream(torch.device('cuda', 99)):\n        pass\n"
        "except Exception as error:\n    print(type(error).__name__, error)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "cuda:99" in said
    assert "Device object" not in said


def test_a_device_has_one_stream(monkeypatch):
    """All parts of a process that use a device share a stream, so that torch can reuse the memory that each freed."""
    made, entered = [], []

    def use(stream):
        entered.append(stream)
        return contextlib.nullcontext()

    monkeypatch.setattr(shared, "_stream", shared.functools.cache(shared._stream.__wrapped__))
    monkeypatch.setattr(wp, "Stream", lambda device: made.append(device) or len(made))
    monkeypatch.setattr(wp, "ScopedStream", use)
    monkeypatch.setattr(wp, "stream_to_torch", lambda stream: stream)
    monkeypatch.setattr(torch.cuda, "stream", use)
    for device in (GPU, GPU, torch.device("cuda", 1)):
        with shared.one_stream(device):
            pass
    assert made == ["cuda:0", "cuda:1"]
    assert entered == [1, 1, 1, 1, 2, 2]


def test_foreign_streams_are_refused(monkeypatch):
    """Nothing that has a kernel is asked of an environment on a GPU where torch is on another stream than Warp."""
    env = particle.Config().build(4, CPU, 0)
    env.device = GPU
    monkeypatch.setattr(wp, "get_stream", lambda device: SimpleNamespace(cuda_stream=0x70))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0x70))
    env.step(torch.zeros(4, env.action_dim))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=0))
    message = r"torch works on CUDA stream 0x0 and Warp on 0x70, .*one_stream\(torch.device\('cuda:0'\)\)"
    rows, goals = torch.arange(4), torch.zeros(4, env.goal_dim)
    for ask in (
        lambda: env.step(torch.zeros(4, env.action_dim)), lambda: env.reset(torch.ones(4, dtype=torch.bool)),
        lambda: env.sample_goals(rows, 2), lambda: env.draw(rows), lambda: env.set_goals(rows, goals),
        lambda: env.goal_reward(goals, goals), lambda: particle.Config().build(4, GPU, 0),
    ):  # fmt: skip
        with pytest.raises(RunError, match=message):
            ask()


@pytest.fixture
def cuda(monkeypatch):
    """Sets how many CUDA devices torch and Warp see."""

    def see(torchs, warps):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: torchs > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: torchs)
        monkeypatch.setattr(wp, "get_cuda_device_count", lambda: warps)

    return see


def test_devices_by_their_names(cuda):
    """Auto takes the first GPU there is, cuda:N another one; what is not there is refused in one line."""
    cuda(2, 2)
    for name, device in {"auto": GPU, "cuda": GPU, "cuda:1": torch.device("cuda", 1), "cpu": CPU}.items():
        assert training.resolve_device(name) == device
    with pytest.raises(RunError, match="There is no CUDA device 2 here; choose from: cuda:0, cuda:1"):
        training.resolve_device("cuda:2")
    with pytest.raises(RunError, match="device must be auto, cpu, cuda or cuda:N, got 'tpu'"):
        training.resolve_device("tpu")
    cuda(0, 1)  # a torch without CUDA
    assert training.resolve_device("auto") == CPU
    with pytest.raises(RunError, match="There is no CUDA device here; use --device cpu"):
        training.resolve_device("cuda")
    with pytest.raises(ValueError, match="device must be auto, cpu, cuda or cuda:N, got 'cuda:'"):
        TrainConfig(device="cuda:")
    assert TrainConfig(device="cuda:3").device == "cuda:3"


def test_a_run_on_a_gpu_says_that_it_is_unverified(tmp_path, monkeypatch, caplog):
    """In one line at its start, with what checks the machine and what does without; on a CPU nothing is said."""
    config = TrainConfig(num_envs=4, device="cpu", threads=1, evaluation=False, log=(), ppo=PPOConfig(hidden=(4,)))
    trainer, folder = training.start(config, tmp_path / "run")
    monkeypatch.setattr(training, "_iterate", lambda *args: True)
    training.train(trainer, folder)
    assert not caplog.records
    trainer.env.device = GPU
    training.train(trainer, folder)
    (record,) = caplog.records
    assert re.match("cuda:0: .* not verified .*doctor --gpu.* cpu", record.getMessage())


@pytest.mark.parametrize("name", ["auto", "cuda", "cuda:0"])
def test_a_driver_that_is_too_old_for_warp(name, cuda):
    """A GPU that torch sees and Warp does not is said in one line, with the ways out, before anything is built."""
    cuda(1, 0)
    with pytest.raises(RunError, match=r"Warp .* does not: .*driver R580 or newer; .*\+cu12 wheel.*--device cpu"):
        training.resolve_device(name)
    assert training.resolve_device("cpu") == CPU


def test_no_garbage_is_collected_during_a_capture(monkeypatch):
    """Collection is off while launches are recorded, and on again afterwards, also where recording fails.

    On CUDA what there is to collect is collected before.
    """
    states = []
    out = wp.zeros(3, dtype=float, device="cpu")

    def launch():
        states.append(gc.isenabled())
        out.fill_(1.0)

    Captured(launch, CPU)
    assert states == [True, False]
    assert gc.isenabled()

    def fail():
        states.append(gc.isenabled())
        if len(states) == 4:
            raise RuntimeError("no memory")

    with pytest.raises(RuntimeError, match="no memory"):
        Captured(fail, CPU)
    assert states[2:] == [True, False]
    assert gc.isenabled()

    collected = []
    monkeypatch.setattr(gc, "collect", lambda: collected.append(gc.isenabled()))
    with no_garbage_collected(GPU):
        assert (collected, gc.isenabled()) == ([True], False)
    with no_garbage_collected(CPU):
        assert len(collected) == 1


class HostNumbers(TorchDispatchMode):
    """Finds ``tensor[rows] = number``: on CUDA torch copies the number there, and waits for it."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Take note of such a call, and make it."""
        if func.overloadpacket in (torch.ops.aten.index_put_, torch.ops.aten.index_put) and args[2].dim() == 0:
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))


def test_the_check_for_numbers_from_the_host_finds_them():
    """A number that is written into listed rows is found; rows written into rows are not."""
    tensor, rows = torch.zeros(4), torch.tensor([1, 2])
    with HostNumbers() as check:
        tensor[rows] = tensor[rows] + 1.0
        assert not check.found
        tensor.index_put_((rows,), torch.tensor(1.0))  # what tensor[rows] = 1.0 did before torch 2.15
    assert len(check.found) == 1


@pytest.mark.parametrize("selector", [director.Config(), q_fear.Config()])
def test_a_rollout_copies_no_number_from_the_host(selector):
    """Between two steps no single number is written into listed rows from the host, whoever chooses the goals."""
    env = particle.Config(goal_period=5, max_speed=200.0, max_force=200.0).build(32, CPU, 0)
    loop = GoalLoop(env, selector.build(spaces(env), 0))
    generator = torch.Generator().manual_seed(0)
    with HostNumbers() as check:
        for _ in range(30):
            loop.advance(env.step(100 * torch.randn(32, env.action_dim, generator=generator)))
    assert loop.interactions.resolved().crashed.any()
    assert not check.found


def test_a_gpu_tries_more_clones_at_a_time(monkeypatch):
    """How many clones are tried at a time depends on the device, unless it is said."""
    assert oracle.MOST["cuda"] >= 10 * oracle.MOST["cpu"]
    built = []

    def make(count):
        built.append(count)
        return particle.Config(goal_period=3).build(count, CPU, 0)

    env = make(8)
    rows = torch.arange(8)
    for most in (10_000, 20):
        monkeypatch.setitem(oracle.MOST, "cpu", most)
        clones = oracle.Clones(make, lambda obs: torch.zeros(len(obs), 3))
        clones.try_out(env, rows, env.sample_goals(rows, 10).clone())
    assert built == [8, 80, 20]


def test_products_are_rounded_on_a_gpu_alone(monkeypatch):
    """TF32 is what the run says, not what the host has set, and never on a CPU; the host gets its own back."""
    with shared_precision("medium"):
        config = TrainConfig(num_envs=8, ppo=PPOConfig(hidden=(4,)), evaluation=False)
        for tf32, device, expected in ((False, CPU, "highest"), (True, CPU, "highest"), (True, GPU, "high")):
            trainer = Trainer(replace(config, tf32=tf32), CPU)
            trainer.env.device = device
            seen = []
            monkeypatch.setattr(
                trainer, "_iterate", lambda seen=seen: seen.append(torch.get_float32_matmul_precision()) or {}
            )
            trainer.iterate()
            assert seen == [expected]
        assert torch.get_float32_matmul_precision() == "medium"


@pytest.mark.skipif(not hasattr(torch.backends.cuda.matmul, "fp32_precision"), reason="torch has no such settings yet")
def test_a_host_may_choose_precisions_by_device():
    """Torch's newer settings, one for each kind of device, contradict its older one, and are the host's own again.

    A run on a GPU then rounds as it is told to, and so do the settings that torch itself goes by.
    """
    cuda, cpu = torch.backends.cuda.matmul, torch.backends.mkldnn.matmul
    before = torch.get_float32_matmul_precision(), cuda.fp32_precision, cpu.fp32_precision
    try:
        torch.set_float32_matmul_precision("highest")
        cuda.fp32_precision, cpu.fp32_precision = "tf32", "bf16"
        for allowed, expected in ((False, "ieee"), (True, "tf32")):
            with contextlib.suppress(KeyError), tf32_products(allowed):
                assert cuda.fp32_precision == expected
                assert cpu.fp32_precision != "bf16"
                raise KeyError
            assert (cuda.fp32_precision, cpu.fp32_precision) == ("tf32", "bf16")
            with pytest.raises(RuntimeError, match="mix of the legacy and new APIs"):
                torch.get_float32_matmul_precision()
    finally:
        torch.set_float32_matmul_precision(before[0])
        cuda.fp32_precision, cpu.fp32_precision = before[1:]


@contextlib.contextmanager
def shared_precision(name):
    """A host that has chosen a precision of its own."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("wanted", [False, True])
def test_determinism_of_mujoco_warp_is_an_option(wanted):
    """mujoco-warp sorts contacts and sums where it is asked to, and does not otherwise."""
    import mujoco_warp

    config = PhysicsConfig(deterministic=wanted)
    physics = engines.build("warp", go1.build(), None, 2, CPU, config)
    kinds = mujoco_warp.DeterminismType
    assert physics._model.opt.deterministic == (kinds.ALL if wanted else kinds.NONE)
