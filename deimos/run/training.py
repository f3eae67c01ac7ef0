"""Training: a policy learns in parallel worlds whose goals a selector chooses."""

import os
import platform
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from deimos import __version__
from deimos.checks import RunError, SimulationError, check_at_least, check_choice
from deimos.files import load_tensors, save_tensors
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig
from deimos.learn.policy import Policy, load_policy, save_policy
from deimos.learn.ppo import PPO, PPOConfig
from deimos.nn.matmul import keep_freed_memory, on_threads
from deimos.run.config import from_dict, kind, to_dict
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.env import EnvConfig
from deimos.sim.envs import particle

SCHEMA = 1  # of config.json and checkpoint.pt
CHECKPOINT_SECONDS = 30.0
LEAST_BYTES = 100  # of any transition, and of any world


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run and the evaluation at its end."""

    env: EnvConfig = field(default_factory=particle.Config)
    """The environment."""
    method: str | None = None
    """Who chooses the goals, by name (docs/selectors.md explains them all): uniform, coop, p10, p25, p50, p75, p90,
    antagonist, rnd, vds, cl, vds+p75, ... By default p25; or leave it out and set up a selector."""
    selector: SelectorConfig | None = None
    """Who chooses the goals, in detail."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learner."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """The evaluation against Naive and Adversary at the end."""
    evaluation: bool = True
    """Whether the run ends with the evaluation."""
    seed: int = 0
    """Seed of the weights, the worlds, the goals and the exploration, in [0, 2^32)."""
    num_envs: int = 2000
    """Parallel worlds, at least 1."""
    env_steps: int = 2000
    """Steps of every world, at least 1; rounded up to whole rollouts."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to simulate and learn; auto takes the GPU where there is one."""
    threads: int = 0
    """CPU threads, at least 0; 0 takes one per core that this process may use. Part of what fixes a run's numbers."""

    def __post_init__(self) -> None:
        check_at_least("num_envs", self.num_envs, 1)
        check_at_least("env_steps", self.env_steps, 1)
        check_at_least("threads", self.threads, 0)
        check_choice("device", self.device, ["auto", "cpu", "cuda"])
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be in [0, 2^32), got {self.seed}.")
        if self.method is not None and self.selector is not None:
            raise ValueError(f"method '{self.method}' and a selector exclude each other; give one of them.")
        if self.method is not None:
            method(self.method)
        if self.evaluation and self.eval.steps < 2 * self.env.goal_period:
            raise ValueError(f"eval.steps must be at least 2 T = {2 * self.env.goal_period}, got {self.eval.steps}.")
        transitions = self.num_envs * self.ppo.num_steps
        if transitions < 2 or self.ppo.minibatches > transitions:
            raise ValueError(
                f"A rollout must hold ppo.minibatches = {self.ppo.minibatches} transitions or more, got {transitions}."
            )

    @property
    def goals(self) -> SelectorConfig:
        """Who chooses the goals."""
        return self.selector or method(self.method or "p25")

    @property
    def label(self) -> str:
        """Short name of who chooses the goals."""
        return self.method or (kind(self.selector) if self.selector else "p25")

    @property
    def iterations(self) -> int:
        """Rollouts in the whole run."""
        return -(-self.env_steps // self.ppo.num_steps)


def resolve_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        RunError: If CUDA is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise RunError("There is no CUDA device here; use --device cpu.")
    return torch.device("cuda", 0) if name != "cpu" and torch.cuda.is_available() else torch.device("cpu")


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Trainer:
    """Everything that a run holds in memory, and one iteration of it."""

    def __init__(self, config: TrainConfig, device: torch.device) -> None:
        keep_freed_memory()
        self.config = config
        self.env = config.env.build(config.num_envs, device, config.seed)
        total_steps = config.iterations * config.ppo.num_steps
        self.loop = GoalLoop(self.env, config.goals.build(spaces(self.env, total_steps), config.seed))
        self.ppo = PPO(config.ppo, config.num_envs, self.env.obs_dim, self.env.action_dim, device, config.seed)
        self.rollout = self.ppo.new_rollout()
        self.iteration = 0
        self.seconds = {"env": 0.0, "policy": 0.0, "goals": 0.0, "update": 0.0, "selector": 0.0}
        """Time spent so far in each part of an iteration [s]; on CUDA only where ``synchronise`` is set."""
        self.synchronise = False
        """Whether to wait for the device at the end of every part, to tell their times apart; for benchmarks."""

    def collect(self) -> None:
        """Let the policy act for one rollout."""
        with on_threads(1):
            self._collect()

    def _collect(self) -> None:
        env, loop, ppo, rollout = self.env, self.loop, self.ppo, self.rollout
        ppo.draw_noise(rollout.noise, self.iteration * rollout.num_steps)
        clock = _Clock(self)
        for t in range(rollout.num_steps):
            rollout.obs[t] = env.obs
            ppo.act(env.obs, rollout.noise[t], rollout.action[t], rollout.mean[t])
            clock.lap("policy")
            step = env.step(rollout.action[t])
            clock.lap("env")
            changes = loop.resolve(step)
            rollout.record(
                t, obs=step.obs, reward=step.reward, terminated=step.terminated, truncated=step.truncated,
                invalid=step.invalid, weight=loop.weight, cut_off=changes.cut_off,
            )  # fmt: skip
            loop.renew(step, changes)
            clock.lap("goals")
        rollout.obs[-1] = env.obs

    def iterate(self) -> dict[str, float]:
        """One rollout and what is learnt from it.

        Returns:
            The row of ``progress.csv``.

        Raises:
            SimulationError: If a number is not finite. This trainer is spoilt then; the last checkpoint is not.
        """
        self.iteration += 1
        try:
            self.collect()
            self.env.check()
            if self.env.may_go_on_invalid:
                self.rollout.exclude_invalid()
            _check_obs(self.rollout.obs[-1])
            clock = _Clock(self)
            learner = self.ppo.update(self.rollout, critic=self.loop.selector.critic())
            self.ppo.check()
            clock.lap("update")
            with on_threads(1):
                selector = self.loop.selector.learn(self.loop.interactions, self.rollout)
            self.loop.selector.check()
            clock.lap("selector")
        except SimulationError as error:
            raise SimulationError(f"Iteration {self.iteration}: {error}") from error
        rollout = self.rollout
        crashes, reward = rollout.terminated.sum(), rollout.reward.mean(dtype=torch.float64)
        transitions = rollout.reward.numel()
        return {
            "iteration": self.iteration,
            "env_steps": self.iteration * rollout.num_steps,
            "transitions": self.iteration * transitions,
            "reward": reward.item(),
            "crashes": int(crashes),
            "crashes_per_1000": 1000 * int(crashes) / transitions,
            "selected_share": self.loop.interactions.active.float().mean().item(),
            **learner,
            **selector,
            **self.env.report(),
        }

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        return {
            "iteration": self.iteration,
            "made_for": _identity(self.config),
            "ppo": self.ppo.state_dict(),
            "loop": self.loop.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from ``state_dict()``.

        Raises:
            RunError: If it is that of another environment or another network size.
        """
        try:
            if state["made_for"] != _identity(self.config):
                raise ValueError(f"it was made for {state['made_for']}, this run is {_identity(self.config)}.")
            self.ppo.load_state_dict(state["ppo"])
            self.loop.load_state_dict(state["loop"])
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise RunError(f"The checkpoint is that of another environment or network size: {reason}") from error
        self.iteration = state["iteration"]


def _identity(config: TrainConfig) -> dict:
    """What a checkpoint must have in common with the run that goes on from it."""
    return {"env": to_dict(config.env), "selector": to_dict(config.goals), "num_envs": config.num_envs}


def _check_obs(obs: Tensor) -> None:
    """Raise ``SimulationError`` if an observation is not finite: what broke on a rollout's last step shows there."""
    if not bool(obs.isfinite().all()):
        world = int((~obs.isfinite()).any(dim=1).nonzero()[0])
        raise SimulationError(f"World {world}: its observation is not finite.")


class _Clock:
    """Adds up the time between laps."""

    def __init__(self, trainer: Trainer) -> None:
        self._seconds = trainer.seconds
        self._device = trainer.env.device if trainer.synchronise and trainer.env.device.type == "cuda" else None
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        if self._device is not None:
            torch.cuda.synchronize(self._device)
        now = time.perf_counter()
        self._seconds[name] += now - self._last
        self._last = now


def provenance() -> dict[str, str]:
    """Versions, commit and platform that a run's numbers belong to."""
    packages = ("torch", "warp-lang", "numpy")
    home = Path(__file__).resolve().parent
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=12"], cwd=home, capture_output=True, text=True, check=False
    )
    return {
        "deimos": __version__,
        "commit": git.stdout.strip() if git.returncode == 0 else "unknown",
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{name: version(name) for name in packages},
    }


def start(config: TrainConfig, path: Path | None, init_from: Path | None) -> tuple[Trainer, RunFolder]:
    """Begin a run.

    Args:
        config: What to train.
        path: Its folder; ``None`` for ``runs/ENV-METHOD-sSEED-TIME``.
        init_from: An earlier run whose networks this one starts with.

    Raises:
        RunError: If the folder exists, or ``init_from`` does not fit.
    """
    device = resolve_device(config.device)
    config = replace(config, threads=config.threads or cores(), device="cuda" if device.type == "cuda" else "cpu")
    torch.set_num_threads(config.threads)
    trainer = build(config, device)
    if init_from is not None:
        _load_weights(trainer, RunFolder.open(init_from))
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder = RunFolder.create(path or Path("runs") / f"{kind(config.env)}-{config.label}-s{config.seed}-{stamp}")
    try:
        folder.write_json("config.json", {
            "schema": SCHEMA, "config": to_dict(config), "versions": provenance(),
            "init_from": str(init_from) if init_from else None,
        })  # fmt: skip
        save(trainer, folder)  # a run that is killed before its first checkpoint begins again from here
    except RunError:
        shutil.rmtree(folder.path, ignore_errors=True)  # nothing is in it yet, and it would be in the way
        raise
    return trainer, folder


def build(config: TrainConfig, device: torch.device) -> Trainer:
    """Make a trainer.

    Raises:
        RunError: If its worlds do not fit in memory, or what the configuration names is not there or does not fit.
    """
    _check_memory(config)
    try:
        return Trainer(config, device)
    except (MemoryError, RuntimeError, ValueError) as error:  # Warp, torch and NumPy each have their own
        reason = " ".join(str(error).split())
        if isinstance(error, ValueError) and "allowed dimension" not in reason and "too big" not in reason:
            raise RunError(reason) from error
        raise RunError(f"{config.num_envs} worlds could not be allocated ({reason}); use fewer (num_envs).") from error


def _check_memory(config: TrainConfig) -> None:
    """Raise ``RunError`` for what this machine cannot hold.

    Systems promise more memory than they have, and would kill the process halfway.
    """
    if not hasattr(os, "sysconf"):
        return
    need = config.num_envs * (config.ppo.num_steps * LEAST_BYTES + LEAST_BYTES)
    has = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if need > has:
        raise RunError(
            f"{config.num_envs} worlds need more than {need / 2**30:.0f} GiB of memory, this machine has "
            f"{has / 2**30:.0f} GiB; use fewer (num_envs)."
        )


def _load_weights(trainer: Trainer, origin: RunFolder) -> None:
    """Take over the networks of another run, whose observations must mean the same."""
    state = load_tensors(origin.path / "checkpoint.pt", "checkpoint", SCHEMA)
    try:
        layout = load_policy(origin.path).layout
        if layout != trainer.env.layout:
            raise ValueError(f"it observes {layout}, this one {trainer.env.layout}")
        trainer.ppo.load_weights(state["ppo"])
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise RunError(f"The networks of {origin.path} do not fit this run: {reason}") from error


def load(folder: RunFolder, config: TrainConfig) -> Trainer:
    """Rebuild a run as it was at its last checkpoint; writes nothing.

    Args:
        folder: Its folder.
        config: Its configuration.

    Raises:
        RunError: If the checkpoint is broken, foreign, or that of another environment or network size.
    """
    torch.set_num_threads(config.threads)
    trainer = build(config, resolve_device(config.device))
    trainer.load_state_dict(load_tensors(folder.path / "checkpoint.pt", "checkpoint", SCHEMA))
    return trainer


def resume(path: Path, env_steps: int | None = None, device: str | None = None) -> tuple[Trainer, RunFolder]:
    """Go on with a run from its last checkpoint.

    Args:
        path: Its folder.
        env_steps: A larger budget; ``None`` for the one that it had.
        device: Where to go on; ``None`` for where it was.

    Raises:
        RunError: If it is not a run folder, its checkpoint is broken, or the budget is smaller.
    """
    folder = RunFolder.open(path)
    config = read_config(folder)
    if env_steps is not None:
        if env_steps < config.env_steps:
            raise RunError(
                f"A resumed run takes only a larger budget: it had {config.env_steps} steps, got {env_steps}."
            )
        config = replace(config, env_steps=env_steps)
    if device is not None:
        config = replace(config, device="cuda" if resolve_device(device).type == "cuda" else "cpu")
    trainer = load(folder, config)
    folder.write_json("config.json", folder.read_json("config.json") | {"config": to_dict(config)})
    for name in ("progress.csv", "timing.csv"):
        folder.cut_csv(name, trainer.iteration)
    return trainer, folder


def read_config(folder: RunFolder) -> TrainConfig:
    """The configuration that a run was started with.

    Raises:
        RunError: If it is broken or of another version.
    """
    data = folder.read_json("config.json")
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise RunError(f"{folder.path / 'config.json'} is not that of a run of schema {SCHEMA}.")
    try:
        return from_dict(TrainConfig, data["config"])
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{folder.path / 'config.json'} does not describe a run: {error}") from error


def save(trainer: Trainer, folder: RunFolder) -> None:
    """Write the checkpoint and the policy.

    Raises:
        RunError: If they cannot be written; the ones of before are whole.
    """
    save_tensors(folder.path / "checkpoint.pt", {"schema": SCHEMA, **trainer.state_dict()})
    ppo, env = trainer.config.ppo, trainer.env
    policy = Policy(trainer.ppo.actor, ppo.hidden, ppo.activation, env.layout, env.action_bound, env.dt)
    save_policy(folder.path / "policy.pt", policy)


def train(
    trainer: Trainer,
    folder: RunFolder,
    report: Callable[[dict[str, float], float], None] = lambda row, fps: None,
    stopped: Callable[[], bool] = lambda: False,
) -> bool:
    """Run all iterations that are left.

    Args:
        trainer: New or resumed.
        folder: Where its files go.
        report: Called after every iteration with its row and the frames per second.
        stopped: Asked after every iteration; true ends the run early, with a checkpoint.

    Returns:
        Whether the budget was used up.

    Raises:
        SimulationError: If a number is not finite; the last checkpoint is that of before.
        RunError: If a file cannot be written; the last checkpoint is whole.
    """
    from torch.utils.tensorboard import SummaryWriter

    transitions = trainer.rollout.reward.numel()
    saved = time.monotonic()
    with SummaryWriter(str(folder.path), purge_step=trainer.iteration + 1) as board:
        while trainer.iteration < trainer.config.iterations:
            before = dict(trainer.seconds)
            begin = time.perf_counter()
            row = trainer.iterate()
            fps = transitions / (time.perf_counter() - begin)
            folder.append_csv("progress.csv", row)
            spent = {name: seconds - before[name] for name, seconds in trainer.seconds.items()}
            folder.append_csv("timing.csv", {"iteration": trainer.iteration, "fps": fps, **spent})
            for name, value in row.items():
                board.add_scalar(name, value, trainer.iteration)
            board.add_scalar("fps", fps, trainer.iteration)
            report(row, fps)
            if stopped():
                break
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                save(trainer, folder)
                saved = time.monotonic()
    save(trainer, folder)
    return trainer.iteration >= trainer.config.iterations
