"""From scratch or from a checkpoint to a trained policy: how a run begins, resumes, is saved and ends."""

import logging
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import torch

from deimos import __version__
from deimos.checks import RunError, check_device, one_line
from deimos.files import load_tensors, save_tensors
from deimos.learn.policy import Policy, load_policy, save_policy
from deimos.nn import ranks
from deimos.run import memory
from deimos.run.branch import check_branch
from deimos.run.clips import Camera
from deimos.run.config import from_dict, kind, require_readable, to_dict, with_plain_numbers
from deimos.run.cores import cores
from deimos.run.evaluation import check_memory, require_pool
from deimos.run.failure import check_finite, dumped
from deimos.run.folder import POLICIES, VIDEOS, RunFolder
from deimos.run.logs import Logs, open_logs
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.graphs import Mode
from deimos.sim.shared import find_cuda

SCHEMA = 1  # of config.json
CHECKPOINT_SCHEMA = 3  # of checkpoint.pt; from earlier ones only the networks can be loaded
CHECKPOINT_SECONDS = 30.0

_log = logging.getLogger(__name__)


def resolve_device(name: str) -> torch.device:
    """The device of a name: auto, cpu, cuda or cuda:N. Of several GPUs cuda is the first, or each rank's own.

    Raises:
        RunError: If the name is invalid, there is no such device, or torch sees a CUDA device but Warp does not.
    """
    try:
        check_device("device", name)
    except ValueError as error:
        raise RunError(str(error)) from error
    count = 0 if name == "cpu" else find_cuda()
    if name == "cpu" or (name == "auto" and not count):
        return torch.device("cpu")
    if ":" in name and ranks.place().size > 1:
        raise RunError(f"device must be auto, cpu or cuda where several ranks have a GPU each, got '{name}'.")
    index = int(name.partition(":")[2] or ranks.place().local_rank)
    if not count:
        raise RunError("There is no CUDA device here; use --device cpu.")
    if index >= count:
        there = ", ".join(f"cuda:{number}" for number in range(count))
        raise RunError(f"There is no CUDA device {index} here; choose from: {there}.")
    return torch.device("cuda", index)


def provenance() -> dict[str, str]:
    """Versions, commit and platform that a run's numbers belong to."""
    return {
        "deimos": __version__,
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "torch": str(torch.__version__),  # includes its build (+cu130), which the package's version does not
        **{name: version(name) for name in ("warp-lang", "numpy")},
    }


def _commit() -> str:
    """The commit of the checkout that this file is in; unknown if it is installed, or without git."""
    home = Path(__file__).resolve().parents[2]
    describe = ["git", "--git-dir=.git", "describe", "--always", "--dirty", "--abbrev=12"]  # of no repository around it
    try:
        return subprocess.run(describe, cwd=home, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def start(
    config: TrainConfig, path: Path | None, init_from: Path | None = None, branch_from: Path | None = None
) -> tuple[Trainer, RunFolder]:  # fmt: skip
    """Begin a run.

    Args:
        config: What is trained.
        path: Its folder; ``None`` for ``runs/ENV-METHOD-sSEED-TIME``.
        init_from: Folder of a run whose networks it starts with.
        branch_from: Folder of a run that it branches off, see ``branch``.

    Raises:
        RunError: If the folder exists, the other run does not fit, or ``config`` could not be read back.
    """
    if init_from is not None and branch_from is not None:
        raise RunError("--init-from and --branch-from cannot be combined; the latter takes over the networks too.")
    device = resolve_device(config.device)
    config = with_plain_numbers(config)
    try:
        require_readable(config)
    except ValueError as error:
        raise RunError(str(error)) from error
    config = replace(
        config, env=config.env.resolved(device), threads=config.threads or max(1, cores() // ranks.place().local_size),
        device=_stored_name(device),
    )  # fmt: skip
    torch.set_num_threads(config.threads)
    with ranks.together():
        if path is not None and ranks.place().first:
            RunFolder.require_new(path)  # before robots are compiled
        if config.evaluation:
            require_pool(config.eval)  # before hours of training
        trainer = build(config, device)
        if init_from is not None:
            _load_weights(trainer, RunFolder.open(init_from))
        if branch_from is not None:
            _take_over(trainer, RunFolder.open(branch_from))
    folder = RunFolder(ranks.from_first(lambda: (RunFolder.create(path) if path else _new_folder(config)).path))
    first = ranks.place().first
    try:
        with ranks.together():
            if first:
                folder.write_json("config.json", _description(config, folder, init_from, branch_from))
        save(trainer, folder)  # a run that is killed before its next checkpoint starts again from here
    except BaseException:  # even a plug-in's error, or an interrupt
        if first:
            shutil.rmtree(folder.path, ignore_errors=True)  # it holds nothing yet, and would be in the way
        raise
    return trainer, folder


def _stored_name(device: torch.device) -> str:
    """The name of a device in a run's configuration: without a number if several ranks have one each."""
    return str(device) if ranks.place().size == 1 else device.type


def _description(config: TrainConfig, folder: RunFolder, init_from: Path | None, branch_from: Path | None) -> dict:
    """The contents of ``config.json``; copies the files that the worlds are built from."""
    return {
        "schema": SCHEMA, "config": to_dict(config), "versions": provenance(),
        "init_from": str(init_from) if init_from else None,
        "branch_from": str(branch_from) if branch_from else None,
        "files": {name: folder.keep(name, partial(config.env.read_file, name)) for name in config.env.files},
    }  # fmt: skip


def _new_folder(config: TrainConfig) -> RunFolder:
    """A folder named after the run and the time; a second one in the same second ends in -2."""
    name = f"{kind(config.env)}-{config.label}-s{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    path, number = Path("runs") / name, 1
    while True:
        try:
            return RunFolder.create(path)
        except RunError:
            if not path.exists():  # the name is not the cause
                raise
        number += 1
        path = path.with_name(f"{name}-{number}")


def build(config: TrainConfig, device: torch.device) -> Trainer:
    """Make a trainer.

    Raises:
        RunError: If its worlds do not fit in memory, or something that the configuration names does not exist or fit.
    """
    memory.require_worlds(config.num_envs // ranks.place().size, config.ppo.num_steps, device)
    if config.evaluation:
        check_memory(config.env, config.eval, device)
    try:
        trainer = Trainer(config, device)
    except (MemoryError, RuntimeError, ValueError) as error:
        reason = one_line(error) or type(error).__name__
        if memory.is_shortage(error):
            reason = f"{config.num_envs} worlds could not be allocated ({reason}); use fewer (num_envs)."
        raise RunError(reason) from error
    memory.require_candidates(trainer.env.num_envs, trainer.loop.selector.num_candidates, trainer.env.goal_dim, device)
    return trainer


def _load_weights(trainer: Trainer, origin: RunFolder) -> None:
    """Load the networks of another run, whose observations must have the same meaning."""
    state = load_checkpoint(origin)
    try:
        policy = load_policy(origin.path)
        layout, activation = policy.layout, policy.activation
        if layout != trainer.env.layout:
            raise ValueError(f"it observes {layout}, this one {trainer.env.layout}")
        if activation != trainer.config.ppo.activation:
            raise ValueError(
                f"ppo.activation must be {activation}, as in the origin, got {trainer.config.ppo.activation}"
            )
        trainer.ppo.load_weights(state["ppo"])
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise RunError(f"The networks of {origin.path} do not fit this run: {one_line(error)}") from error


def _take_over(trainer: Trainer, origin: RunFolder) -> None:
    """Continue with networks, optimiser, worlds and levels of a run's last checkpoint."""
    state = _load_current(origin)
    try:
        check_branch(trainer.config, read_config(origin))
        trainer.ppo.load_learnt(state["ppo"])
        trainer.env.take_worlds(state["loop"]["env"])
        trainer.episodes.load_state_dict(state.get("episodes"))
    except (AttributeError, KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise RunError(f"A run cannot branch off {origin.path}: {one_line(error)}") from error


def load_checkpoint(folder: RunFolder) -> dict:
    """The contents of a run's checkpoint, of this version or an earlier one; ``RunError`` as in ``load_tensors``."""
    return load_tensors(folder.path / "checkpoint.pt", "checkpoint", CHECKPOINT_SCHEMA, oldest=1)


def _load_current(folder: RunFolder) -> dict:
    """The same, of this version only; raises ``RunError`` otherwise."""
    state = load_checkpoint(folder)
    if state["schema"] != CHECKPOINT_SCHEMA:
        raise RunError(
            f"{folder.path / 'checkpoint.pt'} has the schema {state['schema']}, of an earlier version, and cannot be "
            "resumed or branched off; evaluate its policy, or start a run from its networks with --init-from."
        )
    return state


def load(folder: RunFolder, config: TrainConfig) -> Trainer:
    """Rebuild a run as it was at its last checkpoint; writes nothing.

    Raises:
        RunError: If the checkpoint is broken, or not of a run, this environment or this network size.
    """
    return _rebuild(_load_current(folder), config)


def _rebuild(state: dict, config: TrainConfig) -> Trainer:
    """The run of a checkpoint."""
    torch.set_num_threads(config.threads)
    trainer = build(config, resolve_device(config.device))
    trainer.load_state_dict(state)
    return trainer


def resume(
    path: Path, env_steps: int | None = None, device: str | None = None, graph: Mode | None = None
) -> tuple[Trainer, RunFolder]:
    """Resume a run from its last checkpoint, with another budget, device or use of CUDA graphs if they are given.

    Raises:
        RunError: If it is not a run folder, its checkpoint is broken, the budget ``env_steps`` is smaller, or another
            number of ranks has trained it: sums would be rounded differently.
    """
    folder = RunFolder.open(path)
    with _held(folder), ranks.together():
        config = read_config(folder)
        if env_steps is not None:
            if env_steps < config.env_steps:
                raise RunError(f"--env-steps must be at least the {config.env_steps} already set, got {env_steps}.")
            config = replace(config, env_steps=env_steps)
        if device is not None:
            config = replace(config, device=_stored_name(resolve_device(device)))
        if graph is not None:
            config = replace(config, graph=graph)
        state = _load_current(folder)
        _check_ranks(folder, state.get("ranks", 1))
        trainer = _rebuild(state, config)
        if ranks.place().first:
            stored = folder.read_json("config.json")  # whose files keep their names in the configuration
            stored["config"] |= {"env_steps": config.env_steps, "device": config.device, "graph": config.graph}
            folder.write_json("config.json", stored)
    return trainer, folder


def _check_ranks(folder: RunFolder, count: int) -> None:
    """Refuse a run that ``count`` ranks have trained, if there are more or fewer now."""
    if count != ranks.place().size:
        begin = "python train.py" if count == 1 else f"torchrun --nproc_per_node={count} train.py"
        raise RunError(
            f"The number of ranks that resume {folder.path} must be {count}, as in its training, got "
            f"{ranks.place().size}: {begin} --resume {folder.path}, or start a run from its networks with --init-from."
        )


@contextmanager
def _held(folder: RunFolder) -> Iterator[None]:
    """``RunFolder.hold`` on behalf of all ranks."""
    with ExitStack() as stack:
        with ranks.together():
            if ranks.place().first:
                stack.enter_context(folder.hold())
        yield


def read_config(folder: RunFolder) -> TrainConfig:
    """The configuration that a run was started with.

    Raises:
        RunError: If it is broken or of another version.
    """
    data = folder.read_json("config.json")
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise RunError(f"{folder.path / 'config.json'} does not belong to a run of schema {SCHEMA}.")
    try:
        config = from_dict(TrainConfig, data["config"] | {"eval": _today(data["config"].get("eval", {}))}, stored=True)
        kept = {name: str(folder.path / copy) for name, copy in data.get("files", {}).items()}
        return replace(config, env=replace(config.env, **kept)) if kept else config
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{folder.path / 'config.json'} does not describe a run: {error}") from error


def _today(evaluation: dict) -> dict:
    """An evaluation's options without those of 0.1.0 alone: budgets that depended on the policy's crashes."""
    former = ("adversary_interactions", "adversary_crashes", "adversary_enough", "adversary_patience")
    kept = {name: value for name, value in evaluation.items() if name not in former}
    return {name: value for name, value in kept.items() if (name, value) != ("oracle_worlds", 0)}


def save(trainer: Trainer, folder: RunFolder) -> None:
    """Write the checkpoint and the policy; where several ranks share a run, all call it, and the first one writes.

    Raises:
        SimulationError: If a number that must be finite is not; the previous files are intact.
        RunError: If they cannot be written; the previous files are intact.
    """
    with ranks.together():
        check_finite(trainer)
    state = {"schema": CHECKPOINT_SCHEMA, "ranks": ranks.place().size, **trainer.state_dict()}
    with ranks.together():
        if ranks.place().first:
            save_tensors(folder.path / "checkpoint.pt", state)
            _save_policy(trainer, folder.policy())


def _save_policy(trainer: Trainer, path: Path) -> None:
    ppo, env = trainer.config.ppo, trainer.env
    save_policy(path, Policy(trainer.ppo.actor, ppo.hidden, ppo.activation, env.layout, env.action_bound, env.dt))


def train(
    trainer: Trainer, folder: RunFolder, report: Callable[[dict[str, float], float], None] = lambda row, fps: None,
    stopped: Callable[[], bool] = lambda: False,
) -> bool:  # fmt: skip
    """Run all remaining iterations, and return whether the budget was used up.

    Rows, policies and clips of later iterations in the folder are made again. Meanwhile no other process can train the
    run. After every iteration ``report`` is called with its row and the frames per second, and ``stopped`` is asked:
    true ends the run early, with a checkpoint. Where several ranks share a run, the first one writes and reports, and
    any may end it.

    Raises:
        SimulationError: If a number is not finite; the last checkpoint is intact, and ``failure.json`` has the details.
        RunError: If a file cannot be written, in which case the last checkpoint is intact; or another process trains
            the run.
    """
    device = trainer.env.device
    if device.type == "cuda" and ranks.place().first:
        _log.warning(
            "%s: the authors have not verified GPUs on real hardware yet; deimos doctor --gpu checks this machine, "
            "device cpu avoids it.", device,
        )  # fmt: skip
    with _held(folder), dumped(trainer, folder, provenance), ExitStack() as stack:
        with ranks.together():
            writer = stack.enter_context(_writer(trainer, folder, report)) if ranks.place().first else None
        return _iterate(trainer, folder, writer, stopped)


@dataclass(frozen=True)
class _Writer:
    """Writes and shows the numbers of a run."""

    folder: RunFolder
    logs: Logs
    camera: Camera
    report: Callable[[dict[str, float], float], None]

    def add(self, trainer: Trainer, row: dict[str, float], timing: dict[str, float]) -> None:
        """Write and show the iteration that ``trainer`` has just ended."""
        self.folder.append_csv("progress.csv", row)
        self.folder.append_csv("timing.csv", timing)
        every = trainer.config.save_every
        if every and trainer.iteration % every == 0:
            _save_policy(trainer, self.folder.of_iteration(POLICIES, trainer.iteration))
        clip = self.camera.after(trainer.iteration, partial(_save_policy, trainer))
        self.logs.write(trainer.iteration, row | {"fps": timing["fps"]}, clip)
        self.report(row, timing["fps"])


@contextmanager
def _writer(
    trainer: Trainer, folder: RunFolder, report: Callable[[dict[str, float], float], None]
) -> Iterator[_Writer]:  # fmt: skip
    """Open a run's tables and logs; rows, policies and clips that it is about to make again are dropped."""
    for name in ("progress.csv", "timing.csv"):
        folder.cut_csv(name, trainer.iteration)
    for pattern in (POLICIES, VIDEOS):
        folder.cut_iterations(pattern, trainer.iteration)
    with open_logs(trainer.config.log, folder, to_dict(trainer.config), trainer.iteration) as logs:
        yield _Writer(folder, logs, Camera(folder, trainer.config.video_every), report)


def _iterate(trainer: Trainer, folder: RunFolder, writer: _Writer | None, stopped: Callable[[], bool]) -> bool:
    """See ``train``; of several ranks, only the first one has a writer."""

    def keep() -> None:
        with ranks.together():
            if writer is not None:
                folder.sync()  # first: what a resumed run does not write again must be on the disk
                writer.logs.flush()
        save(trainer, folder)

    transitions = trainer.config.num_envs * trainer.config.ppo.num_steps
    saved = time.monotonic()
    while trainer.iteration < trainer.config.iterations:
        before = dict(trainer.seconds)
        begin = time.perf_counter()
        row = trainer.iterate()
        fps = transitions / (time.perf_counter() - begin)
        spent = {name: seconds - before[name] for name, seconds in trainer.seconds.items()}
        with ranks.together():
            if writer is not None:
                writer.add(trainer, row, {"iteration": trainer.iteration, "fps": fps, **spent})
            wanted = stopped(), time.monotonic() - saved > CHECKPOINT_SECONDS
        stop, checkpoint = ranks.largest(*wanted)
        if stop:
            break
        if checkpoint:
            keep()
            saved = time.monotonic()
    keep()
    return trainer.iteration >= trainer.config.iterations
