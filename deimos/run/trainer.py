"""A run in memory: what is trained, and one iteration of it."""

import logging
import math
import time
from collections.abc import Hashable
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from deimos.checks import (
    RunError,
    SimulationError,
    check_at_least,
    check_choice,
    check_device,
    check_is,
    check_names,
    check_range,
    check_seed,
    check_whole,
    one_line,
)
from deimos.goals.core import window_between
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig, with_parts
from deimos.learn.ppo import PPO, PPOConfig
from deimos.nn import ranks
from deimos.nn.graphs import Recorded
from deimos.nn.host import own_settings
from deimos.nn.layout import seen_by
from deimos.nn.threads import tf32_products, torch_on_one
from deimos.run.config import from_dict, kind, to_dict
from deimos.run.evaluation import EvalConfig
from deimos.run.logs import LOGS
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones, SeesWorlds
from deimos.sim.env import EnvConfig
from deimos.sim.envs import particle
from deimos.sim.graphs import MODES, Mode, recorder

MOST_THREADS = 4096  # with far more, threading libraries crash

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run and the evaluation at its end."""

    env: EnvConfig = field(default_factory=particle.Config)
    """The environment."""
    method: str | None = None
    """How goals are chosen, by name (docs/reference/selectors.md): uniform, coop, p10, p25, p50, p75, p90,
    antagonist, rnd, vds, cl, vds+p75, ... By default p25; or leave it out and configure a selector."""
    selector: SelectorConfig | None = None
    """How goals are chosen, in detail."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learner."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """The evaluation at the end, under uniform goals and against attackers."""
    evaluation: bool = True
    """Whether the run ends with the evaluation."""
    seed: int = 0
    """Seed of the weights, the worlds, the goals and the exploration, in [0, 2^32)."""
    num_envs: int = 2000
    """Parallel worlds, at least 1; in all processes together if torchrun starts several."""
    env_steps: int = 2000
    """Steps of every world, at least 1; rounded up to whole rollouts."""
    device: str = "auto"
    """Where to simulate and learn: cpu, cuda, or cuda:N for one of several GPUs; auto takes a GPU if there is one."""
    tf32: bool = False
    """Whether a GPU may round the factors of float32 matrix products to 10 bits of mantissa (TF32), which is faster
    for large networks. CPUs never do."""
    threads: int = 0
    """CPU threads, at least 0; 0 takes one per core that this process may use. They change no number of a run."""
    graph: Mode = "auto"
    """Whether a GPU replays rollouts and updates as CUDA graphs: auto does so where possible, on refuses to train where
    it is not, off launches every operation separately."""
    log: tuple[str, ...] = ("tensorboard",)
    """Where its numbers are shown while it trains: tensorboard, wandb (Weights & Biases), both or neither."""
    video_every: int = 0
    """Iterations from one video of the policy to the next, at least 0; 0 makes none. Each goes into ``videos`` in the
    run's folder and into its logs, and takes some seconds, during which training waits."""
    critic_warmup: int = 0
    """Rollouts at the start in which values are learnt and the policy stays as it is, at least 0; 10 in a branch."""

    def __post_init__(self) -> None:
        for name, kind_of_it in (("env", EnvConfig), ("ppo", PPOConfig), ("eval", EvalConfig)):
            check_is(name, getattr(self, name), kind_of_it)
        if self.selector is not None:
            check_is("selector", self.selector, SelectorConfig)
        check_at_least("num_envs", self.num_envs, 1)
        check_at_least("env_steps", self.env_steps, 1)
        for name in ("critic_warmup", "video_every"):
            check_at_least(name, getattr(self, name), 0)
        check_whole("threads", self.threads)
        check_range("threads", self.threads, 0, MOST_THREADS)
        check_device("device", self.device)
        check_choice("graph", self.graph, MODES)
        check_names("log", self.log)
        for name in self.log:
            check_choice("log", name, LOGS)
        check_seed(self.seed)
        if self.method is not None and self.selector is not None:
            raise ValueError(f"method '{self.method}' and a selector cannot be combined; give one of them.")
        if self.method is not None:
            method(self.method)
        if self.evaluation and self.eval.steps < 2 * self.env.goal_period:
            raise ValueError(f"eval.steps must be at least 2 T = {2 * self.env.goal_period}, got {self.eval.steps}.")
        transitions = self.num_envs * self.ppo.num_steps
        if transitions < 2:
            raise ValueError(f"A rollout must hold 2 transitions or more, got {transitions}.")
        if self.ppo.minibatches > transitions:
            raise ValueError(
                f"A rollout must hold ppo.minibatches = {self.ppo.minibatches} transitions or more, got {transitions}."
            )

    @property
    def goals(self) -> SelectorConfig:
        """The configuration of what chooses the goals."""
        return self.selector or method(self.method or "p25")

    @property
    def label(self) -> str:
        """Short name of what chooses the goals."""
        return self.method or (kind(self.selector) if self.selector else "p25")

    @property
    def iterations(self) -> int:
        """Rollouts in the whole run."""
        return -(-self.env_steps // self.ppo.num_steps)


class Trainer:
    """Everything that a run holds in memory, and one iteration of it."""

    @own_settings()
    @torch_on_one()  # torch's sums depend on its threads; those of ``MLPs``, which has its own, do not
    def __init__(self, config: TrainConfig, device: torch.device) -> None:
        self.config = config
        num_envs = ranks.share("num_envs", config.num_envs)
        self._first_world = ranks.place().rank * num_envs
        self.env = config.env.build(num_envs, device, config.seed, self._first_world)
        if 0 < self.env.time_limit < 2 * self.env.goal_period:
            _log.warning(
                "Episodes of %d steps have no room for two goals of T = %d: the first one is uniform, and no chosen "
                "one is survived to its end.", self.env.time_limit, self.env.goal_period,
            )  # fmt: skip
        total_steps = config.iterations * config.ppo.num_steps
        window = window_between(self.env.goal_period, config.ppo.num_steps)
        self.loop = GoalLoop(self.env, config.goals.build(spaces(self.env, total_steps), config.seed), window)
        record = recorder(config.graph, device)
        actor_sees, critic_sees = (seen_by(who, self.env.layout, device) for who in ("actor", "critic"))
        self.ppo = PPO(
            config.ppo, num_envs, self.env.obs_dim, self.env.action_dim, device, config.seed,
            actor_sees=actor_sees, critic_sees=critic_sees, record=record,
        )  # fmt: skip
        self.rollout = self.ppo.new_rollout()
        clones = Clones(lambda count: config.env.build(count, device, config.seed), self.ppo.actor)
        for part in with_parts(self.loop.selector):
            if isinstance(part, SeesWorlds):
                part.see(self.env, clones)
        self._penalty = self.loop.selector.crash_penalty * self.env.config.largest_reward
        self.iteration = 0
        self.seconds = {"env": 0.0, "policy": 0.0, "goals": 0.0, "update": 0.0, "selector": 0.0}
        """Time spent so far in each part of an iteration [s]; on CUDA only where ``synchronise`` is set."""
        self.synchronise = False
        """Whether to wait for the device at the end of every part, to measure them separately; for benchmarks. Rollouts
        are then not replayed as graphs."""
        self._first_step = torch.zeros((), dtype=torch.int64, device=device)  # of the rollout
        self._clock = _Clock(self)
        self._steps = Recorded[None](record)
        self._says_why = record is not None
        if config.graph == "on" and self.loop.graph_key() is None:
            raise RunError(f"graph must be auto or off here, since {self.loop.why_eager()}; got on.")

    @own_settings()
    @torch.no_grad()
    def collect(self) -> None:
        """Let the policy act for one rollout."""
        self._first_step.fill_(self.iteration * self.rollout.num_steps)
        self._clock = _Clock(self)
        self._steps(self._make_steps, self._graph_key(), replayed=partial(self.loop.passed, self.rollout.num_steps))
        self._clock.lap("env")  # all of a rollout that was replayed

    def _graph_key(self) -> Hashable:
        """What Python branches on in a rollout; ``None`` if it is not replayed, which is reported once."""
        key = None if self.synchronise else self.loop.graph_key()
        if key is None and self._says_why and not self.synchronise:
            self._says_why = False
            _log.info("Rollouts are not replayed as CUDA graphs: %s.", self.loop.why_eager())
        return key

    def _make_steps(self) -> None:
        """The steps of a rollout, in place and without a wait for the device: see ``deimos.nn.graphs``."""
        env, loop, ppo, rollout, clock = self.env, self.loop, self.ppo, self.rollout, self._clock
        ppo.draw_noise(rollout.noise, self._first_step, self._first_world)
        steps = zip(rollout.obs[:-1], rollout.noise, rollout.action, rollout.mean, strict=True)
        for t, (obs, noise, action, mean) in enumerate(steps):
            obs.copy_(env.obs)
            ppo.act(env.obs, noise, action, mean)
            clock.lap("policy")
            step = env.step(action)
            clock.lap("env")
            changes = loop.resolve(step)
            rollout.record(
                t, obs=step.obs, reward=step.reward, terminated=step.terminated, truncated=step.truncated,
                invalid=step.invalid, weight=loop.weight, cut_off=changes.cut_off,
            )  # fmt: skip
            loop.renew(step, changes)
            clock.lap("goals")
        rollout.obs[-1] = env.obs

    @own_settings()
    @torch_on_one()
    def iterate(self) -> dict[str, float]:
        """Collect one rollout and learn from it.

        Returns:
            The row of ``progress.csv``.

        Raises:
            SimulationError: If a number is not finite. The trainer is then unusable; the last checkpoint is not.
        """
        with tf32_products(self.config.tf32 and self.env.device.type == "cuda"):
            row = self._iterate()
        if infinite := [name for name, value in row.items() if math.isinf(value)]:
            raise SimulationError(f"Iteration {self.iteration}: {', '.join(infinite)} would be infinite.")
        return row

    def _iterate(self) -> dict[str, float]:
        """See ``iterate``."""
        try:
            with ranks.together():
                self.collect()
                self.iteration += 1
                self.env.check()
                if self.env.may_go_on_invalid:
                    self.rollout.exclude_invalid()
                _check_obs(self.rollout.obs[-1])
            self.rollout.reward -= self._penalty * self.rollout.terminated
            clock = _Clock(self)
            learner = self.ppo.update(
                self.rollout, critic=self.loop.selector.critic(),
                learn_policy=self.iteration > self.config.critic_warmup,
            )  # fmt: skip
            self.ppo.check()
            clock.lap("update")
            selector = self.loop.core.learn(self.rollout)
            self.loop.selector.check()
            clock.lap("selector")
        except SimulationError as error:
            raise SimulationError(f"Iteration {self.iteration}: {error}", error.rank) from error
        return self._summary() | learner | selector | self.env.report()

    def _summary(self) -> dict[str, float]:
        """What every run logs of a rollout, over the worlds of all ranks."""
        rollout = self.rollout
        transitions = self.config.num_envs * rollout.num_steps
        crashes = int(ranks.sum_over_ranks(rollout.terminated.sum()))
        penalty = self.env.crash_penalty + self._penalty
        reward = ranks.mean_over_ranks(rollout.reward.mean(dtype=torch.float64)).item()
        return {
            "iteration": self.iteration,
            "env_steps": self.iteration * rollout.num_steps,
            "transitions": self.iteration * transitions,
            "reward": reward + penalty * crashes / transitions,
            "crashes": crashes,
            "crashes_per_1000": 1000 * crashes / transitions,
            "selected_fraction": ranks.mean_over_ranks(self.loop.interactions.active.float().mean()).item(),
        }

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        made_for, ppo, loop = _identity(self.config), self.ppo.state_dict(), self.loop.state_dict()
        return {"iteration": self.iteration, "made_for": made_for, "ppo": ppo, "loop": loop}

    def load_state_dict(self, state: dict) -> None:
        """Continue from ``state_dict()``.

        Raises:
            RunError: If it belongs to another environment or network size.
        """
        try:
            made_for = _completed(state["made_for"])
            if made_for != _identity(self.config):
                raise ValueError(f"it was made for {made_for}, this run is {_identity(self.config)}.")
            self.ppo.load_state_dict(state["ppo"])
            self.loop.load_state_dict(state["loop"])
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            text = "The checkpoint belongs to another environment or network size: "
            raise RunError(text + one_line(error)) from error
        self.iteration = state["iteration"]


def _identity(config: TrainConfig) -> dict:
    """What a checkpoint must have in common with the run that resumes from it."""
    env = to_dict(config.env) | dict.fromkeys(config.env.files, "")  # wherever the run's copies are
    return {"env": env, "selector": to_dict(config.goals), "num_envs": config.num_envs}


def _completed(identity: dict) -> dict:
    """The identity that an older version wrote, with the defaults of fields that have been added since."""
    kinds = {"env": EnvConfig, "selector": SelectorConfig}
    return identity | {name: to_dict(from_dict(cls, identity[name], stored=True)) for name, cls in kinds.items()}


def _check_obs(obs: Tensor) -> None:
    """Raise ``SimulationError`` if an observation is not finite: a fault on a rollout's last step shows there."""
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
