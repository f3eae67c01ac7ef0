"""What the first minutes on a GPU are for: stages, each of which finds out one thing and reports it as JSON types.

``python -m deimos.app.gpu_stages NAME DEVICE FILE`` runs one and writes what it found; ``deimos doctor --gpu`` runs
all, each in such a process, since a kernel that fails takes its process with it. On a CPU the same stages run at
``SMALL`` sizes.
"""

import gc
import importlib.metadata
import importlib.util
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from deimos.goals.director import GoalDirector
from deimos.run import training
from deimos.run.config import to_dict
from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.env import Env
from deimos.sim.envs import particle
from deimos.sim.graphs import RECORDERS
from deimos.sim.legged import engines
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.legged.engines.captured import Captured
from deimos.sim.legged.robots import go1
from deimos.sim.shared import one_stream, warp_device

HOME = Path(__file__).resolve().parents[2]
TESTS = ("test_kernels_*.py", "test_deimos_env_particle*.py", "test_deimos_interactions.py", "test_deimos_goal_loop.py")
TOLERANCE = 1e-3  # of observations, CPU against GPU, after the steps below; products and sums round differently
STEPS = 50
EAGER_STEPS = 5
GRAPH_ITERATIONS = 8  # fear learns in the first one; the second runs as it is, the third is recorded
TIMED_ITERATIONS = 5  # the last two are replays, so the fastest one is
NOTICE = "prototype feature"  # torch says once that it may not find all waits, which is no wait


@dataclass(frozen=True)
class Sizes:
    """How much a stage does."""

    worlds: int
    """Particles."""
    iterations: int
    """Iterations of the training that is examined."""
    scales: tuple[int, ...]
    """Numbers of particles whose speed is compared."""
    robots: int
    """Robots on flat ground."""
    rough: int
    """Robots on rough ground."""
    steps: int
    """Steps of robots under random actions."""


FULL = Sizes(worlds=2000, iterations=84, scales=(2_000, 16_000, 65_000, 262_000), robots=4096, rough=1024, steps=200)
SMALL = Sizes(worlds=64, iterations=3, scales=(16, 64), robots=8, rough=4, steps=5)


class Skipped(Exception):
    """A stage has nothing to find out here; the message says why."""


def versions(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Versions, driver, memory pools, conditional graphs, and whether torch and Warp are on the same stream."""
    found: dict[str, Any] = {**training.provenance(), "torch is built for CUDA": torch.version.cuda, "driver": driver()}
    for name in ("mujoco", "mujoco-warp"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    if device.type == "cuda":
        warps = wp.get_device(warp_device(device))
        properties = torch.cuda.get_device_properties(device)
        torchs = torch.cuda.current_stream(device).cuda_stream
        found |= {
            "device": properties.name, "memory [B]": properties.total_memory, "sm": warps.arch,
            "memory pools": wp.is_mempool_enabled(warps), "conditional graphs": wp.is_conditional_graph_supported(),
            "one stream": torchs == wp.get_stream(warps).cuda_stream,
        }  # fmt: skip
    return found


def driver() -> str | None:
    """What ``nvidia-smi`` says of GPUs and driver, one line for each; ``None`` where there is no such program."""
    if shutil.which("nvidia-smi") is None:
        return None
    asked = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    done = subprocess.run(asked, capture_output=True, text=True)
    return (done.stdout or done.stderr).strip()


def tests(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """The tests of kernels, particles, interactions and the goal loop that run on a GPU."""
    if device.type != "cuda":
        raise Skipped("these are the suite's own tests; on a CPU run pytest")
    if not (HOME / "tests").is_dir() or importlib.util.find_spec("pytest") is None:
        raise Skipped("it needs a checkout, and pytest: pip install -e '.[all,test]'")
    files = [str(path) for pattern in TESTS for path in sorted((HOME / "tests").glob(pattern))]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-k", "cuda", *files],
        cwd=HOME,
        capture_output=True,
        text=True,
    )
    lines = done.stdout.strip().splitlines()
    return {
        "passed": done.returncode == 0,
        "summary": lines[-1:],
        "failed": [x for x in lines if x.startswith("FAILED")],
    }


def waits(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Where rollouts and a ``GoalDirector`` wait for the GPU, which they must not, and where whole iterations do."""
    if device.type != "cuda":
        raise Skipped("only CUDA says where it waits")
    trainer = Trainer(replace(_config(sizes.worlds), graph="off"), device)  # a graph that waits cannot be recorded
    for _ in range(5):
        trainer.iterate()
    parts = (trainer.collect, trainer.iterate, directed(sizes.worlds, device))
    in_rollouts, in_iterations, directed_ = (_waits_in(part) for part in parts)
    return {
        "waits in a rollout": in_rollouts, "waits in an iteration": in_iterations,
        "waits in a GoalDirector's step": directed_, "passed": not (in_rollouts or directed_),
    }  # fmt: skip


def directed(num_envs: int, device: torch.device) -> Callable[[], None]:
    """A step of other people's loops: under a ``GoalDirector``'s clock, and under that of a command manager."""
    options: dict[str, Any] = {"num_envs": num_envs, "state_dim": 9, "goal_dim": 3, "device": device}
    options |= {"goal_box": ([-1.0] * 3, [1.0] * 3), "learn_every": 100}
    own, theirs = GoalDirector("p75", 10, **options), GoalDirector("p75", max_horizon=10, **options)
    state = torch.zeros(num_envs, 9, dtype=torch.float32, device=device)
    never = torch.zeros(num_envs, dtype=torch.bool, device=device)
    rows = torch.arange(0, num_envs, 7, device=device)
    goals = [director.propose(None, state, state[:, :3]) for director in (own, theirs)]

    def step() -> None:
        goals[0] = own.step(state, goals[0], never, never).goal
        theirs.observe(never, never, executed=goals[1])
        theirs.reset(rows[:1])
        goals[1][rows] = theirs.propose(rows, state[rows], goals[1][rows])

    return step


def _waits_in(work: Callable[[], object]) -> dict[str, float]:
    """How often each line waits for the GPU in a piece of work, on average over three."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        for _ in range(3):
            work()
        torch.cuda.set_sync_debug_mode("default")
    found = [each for each in said if NOTICE not in str(each.message)]
    places = Counter(f"{Path(each.filename).name}:{each.lineno}" for each in found)
    return {place: count / 3 for place, count in places.most_common()}


def agreement(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Candidates and draws of the device have the CPU's bits; steps agree with the CPU's, and repeat bit for bit."""
    cpu, first, second = (_play_particles(where, sizes.worlds) for where in (torch.device("cpu"), device, device))
    largest = max(float((a - b).abs().max()) for a, b in zip(cpu["obs"], first["obs"], strict=True))
    same = {name: all(map(torch.equal, cpu[name], first[name])) for name in ("candidates", "draws")}
    repeats = all(all(map(torch.equal, first[name], second[name])) for name in first)
    return {
        **{f"{name} have the CPU's bits": equal for name, equal in same.items()}, "largest difference": largest,
        "repeats bit for bit": repeats, "passed": all(same.values()) and repeats and largest <= TOLERANCE,
    }  # fmt: skip


def _play_particles(device: torch.device, worlds: int) -> dict[str, list[Tensor]]:
    """What particles see under scripted actions, and the candidates and draws of every step, on the CPU."""
    found: dict[str, list[Tensor]] = {"obs": [], "candidates": [], "draws": []}
    with one_stream(device):
        env = particle.Config(goal_period=10).build(worlds, device, seed=1)
        rows = torch.arange(worlds, device=device)
        for step in range(STEPS):
            bound = min(env.action_bound, 1.0)
            action = bound * torch.cos(torch.arange(worlds * env.action_dim, device=device) + step)
            env.step(action.view(worlds, -1))
            found["candidates"].append(env.sample_goals(rows, 100).cpu())
            found["draws"].append(env.draw(rows).cpu())
            env.set_goals(rows, env.sample_goals(rows, 1)[:, 0])
            found["obs"].append(env.obs.cpu())
    return found


def learning(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Training under Uniform and the Director: curves to compare with a CPU's, speed, where time goes."""
    found: dict[str, Any] = {}
    for name in ("uniform", "p25"):
        trainer = _particles(device, sizes.worlds, name)
        rows, seconds = [], []
        for _ in range(sizes.iterations):
            begin = time.perf_counter()
            rows.append(trainer.iterate())
            seconds.append(_since(begin, device))
        curves = {key: [row[key] for row in rows] for key in ("reward", "crashes_per_1000")}
        fps = trainer.rollout.reward.numel() / statistics.median(seconds)
        trainer.synchronise = True
        before = dict(trainer.seconds)
        trainer.iterate()
        parts = {part: value - before[part] for part, value in trainer.seconds.items()}
        found[name] = {"FPS": fps, "parts of an iteration [s]": parts, **curves}
    activities = [torch.profiler.ProfilerActivity.CPU]
    if device.type == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as profile:
        trainer.iterate()
    calls = sorted(profile.key_averages(), key=lambda each: each.count, reverse=True)[:20]
    return found | {"most frequent calls of an iteration": {each.key: each.count for each in calls}}


def graphs(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Training by CUDA graphs against the same training call by call: the same numbers, and how fast each is."""
    if device.type not in RECORDERS:
        raise Skipped("a CPU has no CUDA graphs")
    found: dict[str, Any] = {}
    tasks = {name: _config(sizes.worlds, name) for name in ("uniform", "p25")}
    env, ppo = preset("quad").env, preset("quad").ppo
    assert isinstance(env, LocomotionConfig)
    env = replace(env, engine="warp", physics=replace(env.physics, deterministic=True))
    ppo = replace(ppo, num_steps=min(ppo.num_steps, sizes.steps))
    tasks["robots"] = replace(_config(sizes.robots, "uniform"), env=env, ppo=ppo)
    for name, config in tasks.items():
        rows: dict[str, list[dict[str, float]]] = {}
        fps = {}
        for mode in ("off", "on"):
            trainer = Trainer(replace(config, graph=mode), device)
            rows[mode], seconds = [], []
            for _ in range(GRAPH_ITERATIONS):
                begin = time.perf_counter()
                rows[mode].append(trainer.iterate())
                seconds.append(_since(begin, device))
            fps[mode] = trainer.rollout.reward.numel() / statistics.median(seconds[-3:])
            del trainer
        same = [one == other for one, other in zip(*map(_without_nan, rows.values()), strict=True)]
        found[name] = {"equal iterations": sum(same), "FPS": {"by call": fps["off"], "by graph": fps["on"]}}
        found[name]["passed"] = all(same)
    return found


def _without_nan(rows: list[dict[str, float]]) -> list[dict[str, float | None]]:
    """Rows that can be compared: NaN equals nothing."""
    return [{name: None if math.isnan(value) else value for name, value in row.items()} for row in rows]


def scales(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Speed and memory of more and more particles."""
    found = {}
    for worlds in sizes.scales:
        trainer = _particles(device, worlds)
        fps = trainer.rollout.reward.numel() / min(_iterations(trainer, device))
        found[str(worlds)] = {"FPS": fps} | _memory(device)
        del trainer
    return found


def resuming(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """A run goes from the CPU to the device and back, and loses no iteration."""
    config = replace(_config(sizes.worlds), device="cpu", env_steps=2 * 24)
    with tempfile.TemporaryDirectory() as home:
        path = Path(home) / "run"
        training.train(*training.start(config, path))
        for steps, where in ((4 * 24, str(device)), (6 * 24, "cpu")):
            with one_stream(training.resolve_device(where)):
                training.train(*training.resume(path, steps, where))
        rows = RunFolder(path).read_csv("progress.csv")
    iterations = [int(row["iteration"]) for row in rows]
    return {"iterations": iterations, "passed": iterations == [*range(1, 7)]}


def flat(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Robots on flat ground: the graph against the same launches one by one, random actions, training, memory."""
    found: dict[str, Any] = {}
    if device.type == "cuda":
        found["graph against eager"] = _graph_against_eager(device)
    config = preset("quad")
    begin = time.perf_counter()
    env = config.env.build(sizes.robots, device, seed=0)
    found["build [s]"] = _since(begin, device)
    found |= _walk_at_random(env, sizes.steps)
    del env
    for name, tf32 in (("float32", False), ("TF32", True)):
        larger = replace(config, num_envs=sizes.robots, tf32=tf32, evaluation=False, method="p25")
        trainer = Trainer(replace(larger, ppo=replace(config.ppo, hidden=(512, 256, 128))), device)
        seconds = _iterations(trainer, device)
        fps = trainer.rollout.reward.numel() / min(seconds)
        found[name] = {"iterations [s]": seconds, "FPS": fps} | _memory(device)
        del trainer
    return found


def _graph_against_eager(device: torch.device) -> dict[str, Any]:
    """How far apart robots are after some control steps of a graph and of the same launches."""
    states = []
    for captured in (True, False):
        physics = engines.build("warp", go1.build(), None, 64, device, engines.PhysicsConfig(deterministic=True))
        step = Captured(physics.step, device) if captured else physics.step
        if captured:  # what capturing has done is undone
            physics.reset(wp.ones(64, dtype=wp.bool, device=warp_device(device)))
        for _ in range(EAGER_STEPS):
            step()
        states.append(physics.tensors["qpos"].clone())
    largest = float((states[0] - states[1]).abs().max())
    return {"largest difference": largest, "passed": largest <= TOLERANCE}


def _walk_at_random(env: Env, steps: int) -> dict[str, Any]:
    """Control steps per second under random actions, what became invalid, and how full the buffers were."""
    generator = torch.Generator().manual_seed(0)
    actions = torch.randn(8, env.num_envs, env.action_dim, generator=generator, dtype=torch.float32).to(env.device)
    env.step(actions[0])
    begin = time.perf_counter()
    for t in range(steps):
        step = env.step(actions[t % 8])
        env.reset(step.terminated | step.truncated)
    seconds = _since(begin, env.device)
    env.check()
    return {
        "control steps/s": steps * env.num_envs / seconds, "invalid": getattr(env, "invalid_steps", 0),
        "use of buffers": env.report(),
    }  # fmt: skip


def rebuilding(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """A second environment is captured while the first one is dropped; then, what determinism costs and gives."""
    config = preset("quad").env
    assert isinstance(config, LocomotionConfig)
    first = config.build(sizes.robots, device, seed=0)
    _walk_at_random(first, 2)
    second = config.build(sizes.robots, device, seed=0)
    del first
    gc.collect()
    found: dict[str, Any] = {"the second": _walk_at_random(second, sizes.steps)}
    del second
    for wanted in (False, True):
        physics = replace(config.physics, deterministic=wanted)
        ends = []
        for _ in range(2):
            env = replace(config, physics=physics).build(sizes.robots, device, seed=0)
            speed = _walk_at_random(env, sizes.steps)["control steps/s"]
            ends.append(env.obs.clone())
        found["deterministic" if wanted else "as it is"] = {"control steps/s": speed, "repeats": torch.equal(*ends)}
    return found | {"passed": found["deterministic"]["repeats"]}


def rough(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Robots on rough ground."""
    config = preset("quad").env
    assert isinstance(config, LocomotionConfig)
    begin = time.perf_counter()
    env = replace(config, terrain="rough").build(sizes.rough, device, seed=0)
    seconds = _since(begin, device)
    return {"build [s]": seconds} | _walk_at_random(env, sizes.steps) | _memory(device)


def _config(worlds: int, method: str = "p25") -> TrainConfig:
    return TrainConfig(method=method, num_envs=worlds, evaluation=False, log=())


def _particles(device: torch.device, worlds: int, method: str = "p25") -> Trainer:
    return Trainer(_config(worlds, method), device)


def _iterations(trainer: Trainer, device: torch.device) -> list[float]:
    """How long each of some iterations takes [s]; where there are CUDA graphs, the first ones are not replayed."""
    seconds = []
    for _ in range(TIMED_ITERATIONS):
        begin = time.perf_counter()
        trainer.iterate()
        seconds.append(_since(begin, device))
    return seconds


def _since(begin: float, device: torch.device) -> float:
    """Seconds since ``begin``, once the device has done everything that it was asked to."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - begin


def _memory(device: torch.device) -> dict[str, int]:
    """Memory of a GPU that is in use by any process [B]."""
    if device.type != "cuda":
        return {}
    free, total = torch.cuda.mem_get_info(device)
    return {"memory in use [B]": total - free}


STAGES: dict[str, tuple[Callable[[torch.device, Sizes], dict[str, Any]], float]] = {
    "versions": (versions, 30.0), "tests": (tests, 120.0), "waits": (waits, 30.0), "agreement": (agreement, 30.0),
    "learning": (learning, 40.0), "graphs": (graphs, 180.0), "scales": (scales, 40.0), "resuming": (resuming, 30.0),
    "flat": (flat, 180.0), "rebuilding": (rebuilding, 60.0), "rough": (rough, 60.0),
}  # fmt: skip
"""By name, in their order: each stage, and how long it may take [s]. Kernels that it compiled are cached."""


def main(name: str, device_name: str, file: Path) -> None:
    """Run a stage and write what it found, or why it was skipped."""
    device = training.resolve_device(device_name)
    sizes = FULL if device.type == "cuda" else SMALL
    found: dict[str, Any]
    try:
        with one_stream(device):
            found = {"found": STAGES[name][0](device, sizes)}
    except Skipped as reason:
        found = {"skipped": str(reason)}
    RunFolder(file.parent).write_json(file.name, found | {"sizes": to_dict(sizes)})


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
