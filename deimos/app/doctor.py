"""``deimos doctor``: what this machine has, what works on it, and what does not; ``--gpu``: ten minutes on a GPU."""

import contextlib
import importlib.metadata
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from deimos.app import console, gpu_stages
from deimos.checks import RunError, check_device, one_line
from deimos.run import training
from deimos.run.cores import cores
from deimos.run.folder import RunFolder
from deimos.run.presets import preset
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.shared import one_stream

REPORT = "gpu.json"
SCHEMA = 1  # of the report
# The thesis's budget for Quad, 295 million transitions, with the worlds and networks that suit a GPU.
QUAD_WORLDS, QUAD_STEPS, QUAD_HIDDEN = 4096, 72_000, (512, 256, 128)
PURPOSES = {
    "mujoco": ("robots", "legged"), "mujoco_warp": ("robots on a GPU", "legged"), "trimesh": ("terrain", "legged"),
    "imageio_ffmpeg": ("videos", "legged"), "scipy": ("studies and their statistics", "study"),
    "ray": ("studies on a Ray cluster", "cluster"), "wandb": ("curves at Weights & Biases", "wandb"),
    "onnx": ("policies as ONNX", "export"),
}  # fmt: skip
"""Packages that are not needed to train particles: what they are for, and the extra that installs them."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Report what this machine has, and what of Deimos works on it: exit code 0 if a policy can be trained, else 1.

    With --gpu, run the stages that test what only a GPU can show: ten minutes, a JSON report after each.
    """

    device: str = "auto"
    """Where to try: cpu, cuda or cuda:N; auto takes the GPU where there is one. The stages of --gpu need a GPU, unless
    this is cpu, which runs them at tiny sizes to see that they work."""
    gpu: bool = False
    """Run the stages."""
    science: bool = False
    """After the stages, measure the thesis's Table 4.1 and train Quad for as long as the thesis did: half an hour or
    more; repeated, the command continues where it was."""
    stages: tuple[str, ...] = ()
    """Names of the stages to run. By default all."""
    out: Path = Path("doctor")
    """Folder of the report of --gpu, and of what --science makes."""

    def __post_init__(self) -> None:
        check_device("device", self.device)
        if unknown := [name for name in self.stages if name not in gpu_stages.STAGES]:
            raise ValueError(f"stages must be some of {', '.join(gpu_stages.STAGES)}, got '{unknown[0]}'.")
        if (self.science or self.stages) and not self.gpu:
            raise ValueError(f"{'science' if self.science else 'stages'} belongs to --gpu; add it.")


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos doctor``."""
    options: DoctorOptions = console.parse(DoctorOptions, arguments, program)
    console.quiet_warp()
    if not options.gpu:
        if not examine(options.device):
            raise SystemExit(1)
        return
    device = training.resolve_device("cuda" if options.device == "auto" else options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    passed = run_stages(options.stages or tuple(gpu_stages.STAGES), device, options.out)
    print(options.out / REPORT)
    if options.science:
        for command in science(device, options.out):
            if code := subprocess.run(command, cwd=gpu_stages.HOME).returncode:
                raise SystemExit(code)
    if not passed:
        raise SystemExit(1)


def examine(device_name: str) -> bool:
    """Print what there is and what works; returns whether a policy can be trained.

    Args:
        device_name: Where it is tried, see ``training.resolve_device``.
    """
    facts = [(name, text) for name, text in training.provenance().items()]
    facts += [("cores", str(cores())), ("NVIDIA driver", gpu_stages.driver() or "none"), ("CUDA", _cuda())]
    print(_table("this machine", facts), end="\n\n")
    packages = [(what, *_package(name, extra)) for name, (what, extra) in PURPOSES.items()]
    print(_table("optional packages", packages), end="\n\n", flush=True)
    rows, works = [], True
    for what, check, is_needed in CHECKS:
        begin = time.perf_counter()
        try:
            said = check(device_name)
        except Exception as error:  # any error is a finding
            said, works = f"FAILS: {one_line(error) or type(error).__name__}", works and not is_needed
        rows.append((what, f"{time.perf_counter() - begin:.1f} s", said))
    print(_table("what was tried", rows))
    return works


def _table(title: str, rows: Sequence[Sequence[str]]) -> str:
    """Lines of a table of texts, in columns."""
    rows = [[" ".join(cell.split()) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join([f"{title}:", *(f"  {line}" for line in lines)])


def _package(name: str, extra: str) -> tuple[str, str]:
    """The version of a package, and a note on it."""
    try:
        return importlib.metadata.version(name.replace("_", "-")), "installed"
    except importlib.metadata.PackageNotFoundError:  # a folder of that name, such as wandb's logs, is not a package
        return "-", f"pip install 'deimos-rl[{extra}]'"


def _cuda() -> str:
    """What torch and Warp see of GPUs."""
    try:
        device = training.resolve_device("auto")
    except RunError as error:
        return str(error)
    return "none that torch sees" if device.type == "cpu" else torch.cuda.get_device_name(device)


def _check_cache(device_name: str) -> str:
    """Whether compiled kernels can be kept."""
    import warp as wp

    path = Path(wp.config.kernel_cache_dir)
    if not os.access(path, os.W_OK):
        raise RunError(f"{path} cannot be written to; set WARP_CACHE_PATH to a folder that can.")
    sizes = [file.stat().st_size for file in path.rglob("*") if file.is_file()]
    return f"{path}: {sum(sizes) / 2**20:.0f} MiB in {len(sizes)} files"


def _check_streams(device_name: str) -> str:
    """Whether torch and Warp work on one stream."""
    device = training.resolve_device(device_name)
    with one_stream(device):
        found = gpu_stages.versions(device, gpu_stages.SMALL)
    if device.type == "cuda" and not found["one stream"]:
        raise RunError("torch and Warp work on two streams.")
    return "one, of torch and Warp" if device.type == "cuda" else "a CPU has none"


def _check_particles(device_name: str) -> str:
    """Whether particles can be trained."""
    config = TrainConfig(method="p25", num_envs=64, evaluation=False)
    return _iterate(config, training.resolve_device(device_name))


def _check_robots(device_name: str) -> str:
    """Whether robots can be trained, with the engine that ``auto`` takes."""
    config = preset("quad")
    device = training.resolve_device(device_name)
    small = TrainConfig(env=config.env.resolved(device), ppo=config.ppo, num_envs=16, evaluation=False)
    return _iterate(small, device)


def _iterate(config: TrainConfig, device: torch.device) -> str:
    with one_stream(device):
        row = Trainer(config, device).iterate()
    return (
        f"works on {device}: reward {console.number(row['reward'])} in the first iteration of {config.num_envs} worlds"
    )


CHECKS: list[tuple[str, Callable[[str], str], bool]] = [
    ("kernel cache", _check_cache, True), ("streams", _check_streams, True),
    ("training particles", _check_particles, True), ("training robots", _check_robots, False),
]  # fmt: skip
"""What is tried, how, and whether training any policy needs it."""


def run_stages(names: tuple[str, ...], device: torch.device, out: Path) -> bool:
    """Run stages of ``gpu_stages``, and write the report after each; returns whether none has failed.

    What an earlier call found of other stages stays in the report.
    """
    folder = RunFolder(out)
    stages: dict[str, Any] = folder.read_json(REPORT)["stages"] if (out / REPORT).exists() else {}
    for name in names:
        begin = time.perf_counter()
        stages[name] = _run_stage(name, device, gpu_stages.STAGES[name][1])
        stages[name] |= {"seconds": time.perf_counter() - begin, "device": str(device), "deimos": training.provenance()}
        folder.write_json(REPORT, {"schema": SCHEMA, "stages": stages})
        said = stages[name].get("error") or stages[name].get("skipped") or "found"
        print(f"{name}: {said} ({stages[name]['seconds']:.0f} s)", flush=True)
    return not any("error" in stages[name] or _fails(stages[name].get("found")) for name in names)


def _fails(found: Any) -> bool:
    """Whether a check has failed in what a stage found, however deeply nested."""
    return isinstance(found, dict) and (found.get("passed") is False or any(map(_fails, found.values())))


def _run_stage(name: str, device: torch.device, limit: float) -> dict[str, Any]:
    """What a stage found, in a separate process that may take ``limit`` seconds; or its error."""
    with tempfile.TemporaryDirectory() as home:
        file = Path(home) / "found.json"
        command = [sys.executable, "-m", "deimos.app.gpu_stages", name, str(device), str(file)]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
        ) as process:
            try:
                said = process.communicate(timeout=limit)[1]
            except subprocess.TimeoutExpired:
                return {"error": f"it took longer than {limit:.0f} s"}
            finally:
                with contextlib.suppress(ProcessLookupError):  # they have ended, as they should
                    os.killpg(process.pid, signal.SIGKILL)  # with what it has started
        if not file.exists():
            last = said.strip().splitlines()[-1:] or [f"exit code {process.returncode}"]
            return {"error": last[0], "said": said[-4000:]}
        return RunFolder(file.parent).read_json(file.name)


def science(device: torch.device, out: Path) -> list[list[str]]:
    """The commands of ``--science``: each continues what is there.

    Raises:
        RunError: If this is not a checkout: benchmarks are not installed.
    """
    if not (gpu_stages.HOME / "benchmarks").is_dir():
        raise RunError("--science needs a checkout of the repository; benchmarks are not installed.")
    table = [sys.executable, "-m", "benchmarks", "table41", "--device", str(device), "--json"]
    train = [sys.executable, "-m", "deimos", "train"]
    quad = out.resolve() / "quad"
    if quad.exists():
        train += ["--resume", str(quad)]
    else:
        train += [
            "--preset", "quad", "--method", "p25", "--num-envs", str(QUAD_WORLDS), "--env-steps", str(QUAD_STEPS),
            "--ppo.hidden", *map(str, QUAD_HIDDEN), "--device", str(device), "--out", str(quad),
        ]  # fmt: skip
    return [[*table, str(out.resolve() / "table41.json")], train]
