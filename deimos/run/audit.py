"""Does the fear network rank goals correctly *within* a context? Exact labels from cloned worlds.

The AUROC over all interactions is inflated by states: near a wall everything is dangerous. What a Director uses is the
ranking of goals for one state and one active goal. Here worlds at the moment of a goal change are cloned, every clone
gets another candidate goal, and the policy is rolled out for T steps under each, with its actions drawn as in training.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from deimos.checks import RunError
from deimos.goals import picks
from deimos.goals.calibration import evaluate
from deimos.goals.fear import auroc
from deimos.goals.fear_selector import FearSelector, fear_selector
from deimos.goals.interactions import Resolved
from deimos.goals.selector import GoalSelector
from deimos.goals.selectors import uniform
from deimos.nn.random import Purpose, normals, uniforms
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones
from deimos.run.trainer import Trainer

CANDIDATES = 50  # goals tried in every context
BATCH = 256  # contexts cloned at a time
PATIENCE = 50  # contexts tried per context wanted, before giving up
RESAMPLES = 10_000
AHEAD = 10  # steps whose noise is drawn at once: with few worlds, the overhead of the calls dominates


class _Explorer:
    """The policy with actions drawn as in training, from an audit's own random numbers.

    They are addressed by the seed, the number of the world, that of the first row being ``first_world``, and the step.
    """

    def __init__(self, trainer: Trainer, first_world: int = 0) -> None:
        self._actor, self._seed, self._first = trainer.ppo.actor, trainer.config.seed, first_world
        self.steps = 0
        self._noise: list[Tensor] = []  # for the coming steps, the next one last

    def __call__(self, obs: Tensor) -> Tensor:
        mean = self._actor(obs)
        if not self._noise or len(self._noise[-1]) != len(obs):
            world = torch.arange(len(obs), device=obs.device)
            steps = torch.arange(self.steps, self.steps + AHEAD, device=obs.device).unsqueeze(1)
            noise = normals(self._seed, Purpose.AUDIT, world + self._first, steps, mean.shape[1])
            self._noise = list(noise.unbind())[::-1]
        self.steps += 1
        return mean + self._actor.std * self._noise.pop()


def audit_fear(trainer: Trainer, contexts: int) -> dict:
    """Measure the AUROC within contexts of a training run's fear network.

    The run's own worlds continue as in training, without learning, and supply the contexts; only those where some
    candidates crash and some do not can be ranked.

    Args:
        trainer: A run whose selector has a fear network that has learnt. Its worlds advance.
        contexts: Contexts with both outcomes to collect, at least 1.

    Returns:
        ``auroc``, the mean over contexts; ``low`` and ``high``, its 95 % bootstrap interval by context; ``contexts``
        with both outcomes among those ``tried``; ``crash_rate`` of all rollouts; ``iteration``.

    Raises:
        RunError: If there is no fear network, no context with both outcomes, or no context at all.
    """
    afraid = _learnt_fear(trainer)
    act, clones = _explorers(trainer)
    ranks: list[float] = []
    crashes = tried = 0
    while len(ranks) < contexts and tried < PATIENCE * contexts:
        _, state, goal, candidates, survived = _next_contexts(trainer, act, clones)
        logit = afraid.score(state, goal, candidates)
        crashed = survived < trainer.env.goal_period
        tried += len(logit)
        crashes += int(crashed.sum())
        pairs = zip(logit, crashed, strict=True)
        ranks += [auroc(score, label) for score, label in pairs if 0 < int(label.sum()) < CANDIDATES]
    if not ranks:
        raise RunError(
            f"None of {tried} contexts had both outcomes; the policy is too safe or too bad to rank its goals."
        )
    resamples = np.random.default_rng(0).integers(len(ranks), size=(RESAMPLES, len(ranks)))
    low, high = np.quantile(np.array(ranks)[resamples].mean(axis=1), [0.025, 0.975])
    return {
        "auroc": math.fsum(ranks) / len(ranks), "low": float(low), "high": float(high), "contexts": len(ranks),
        "tried": tried, "crash_rate": crashes / (tried * CANDIDATES), "iteration": trainer.iteration,
    }  # fmt: skip


def _explorers(trainer: Trainer) -> tuple[_Explorer, Clones]:
    """What acts in the run's own worlds, and clones to try candidates in; both explore as in training."""
    config = trainer.config
    return _Explorer(trainer), Clones(
        lambda count: config.env.build(count, trainer.env.device, config.seed),
        _Explorer(trainer, first_world=config.num_envs), limit=BATCH * CANDIDATES,
    )  # fmt: skip


def audit_calibration(trainer: Trainer, interactions: int) -> dict[str, tuple[Tensor, Tensor, dict[str, float]]]:
    """Evaluate the calibrated probabilities of a training run's fear network, on goals that it did not learn from.

    The run's own worlds continue as in training, without learning: first under the goals of its selector, which are a
    biased sample of all goals, then under uniform goals, which are not.

    Args:
        trainer: See ``audit_fear``.
        interactions: Interactions under each, at least 1.

    Returns:
        For ``selected`` and ``uniform`` goals: probabilities, shape (n,), outcomes, bool, shape (n,), and what
        ``calibration.evaluate`` returns, with ``interactions``, ``crash_rate`` and ``auroc``.

    Raises:
        RunError: If there is no fear network.
    """
    afraid = _learnt_fear(trainer)
    act = _Explorer(trainer)
    choosers = {"selected": trainer.loop.selector, "uniform": uniform.Config().build(spaces(trainer.env), 0)}
    results = {}
    for name, chooser in choosers.items():
        done = _watch(trainer, act, chooser, interactions)
        score = afraid.score(done.state, done.goal, done.next_goal.unsqueeze(1)).squeeze(1)
        probability = afraid.calibration.probability(score)
        counts = {"interactions": float(len(done)), "crash_rate": done.crashed.float().mean().item()}
        quality = counts | {"auroc": auroc(score, done.crashed)} | evaluate(probability, done.crashed)
        results[name] = probability, done.crashed, quality
    return results


def _learnt_fear(trainer: Trainer) -> FearSelector:
    afraid = fear_selector(trainer.loop.selector)
    if afraid is None or not afraid.fear.fitted:
        raise RunError("This run's selector has no fear network that has learnt anything.")
    return afraid


@torch.no_grad()
def _watch(trainer: Trainer, act: _Explorer, chooser: GoalSelector, count: int) -> Resolved:
    """Let the policy act under a selector's goals until ``count`` interactions have ended, in whole periods."""
    env = trainer.env
    steps = (-(-count // env.num_envs) + 1) * env.goal_period
    loop = GoalLoop(env, chooser, window=steps)
    for _ in range(steps):
        loop.advance(env.step(act(env.obs)), in_time=True)
    return loop.outcomes()


@torch.no_grad()
def _next_contexts(trainer: Trainer, act: _Explorer, clones: Clones) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Step until goals are due, and try candidates in up to ``BATCH`` of those worlds.

    Returns:
        Worlds (n,), states (n, state_dim), active goals (n, goal_dim), candidates (n, CANDIDATES, goal_dim) and the
        steps survived under each (n, CANDIDATES).

    Raises:
        RunError: If no goal falls due for ``PATIENCE`` periods: every world crashes before.
    """
    env = trainer.env
    for _ in range(PATIENCE * env.goal_period):
        step = env.step(act(env.obs))
        rows = (step.goal_due & ~step.terminated & ~step.truncated).nonzero().squeeze(1)
        if len(rows):
            break
        trainer.loop.advance(step)
    else:
        raise RunError(
            f"In {PATIENCE * env.goal_period} steps no world lived until its goal changed; the policy is too bad to "
            f"rank its goals."
        )
    draw = uniforms(trainer.config.seed, Purpose.AUDIT_CONTEXT, rows, rows.new_tensor(act.steps))[:, 0]
    rows = rows[draw.argsort()[:BATCH]]
    obs = env.obs[rows]
    candidates = env.sample_goals(rows, CANDIDATES).clone()
    survived = clones.try_out(env, rows, candidates)
    trainer.loop.advance(step)
    return rows, env.state(obs), obs[:, env.goal_slice], candidates, survived


@dataclass(frozen=True)
class Choices:
    """What a selector chose in the next decision of some worlds, compared with the outcome of every candidate."""

    percentile: list[float]
    """Percentile of the chosen goal among 50 candidates by how soon each crashes the policy, ties counting half, in
    the worlds where candidates differ."""
    auroc: list[float]
    """How often fear ranks a candidate that crashes above one that does not, in the worlds that have both; empty
    without a fear network that has learnt."""
    place: Tensor
    """Where each world was, in [-1, 1], shape (n, goal_dim): its ``Env.place`` or, where there is none, the active goal
    in the box of valid goals; empty where these do not form a box."""
    chosen: Tensor
    """Where the chosen goal is in the box of valid goals, in [-1, 1], shape (n, goal_dim); empty where these do
    not form a box."""


@torch.no_grad()
def audit_choices(trainer: Trainer, worlds: int, clones: Clones) -> Choices:
    """Measure one decision of a training run's selector in each of some worlds.

    The run's own worlds continue as in training, without learning, for T steps. So no world counts twice, and those
    whose episode ends before their goal is due do not count.

    Args:
        trainer: A run. Its worlds advance.
        worlds: How many of its worlds, drawn at random; at least 1.
        clones: Where candidates are tried; see ``audit_clones``.
    """
    env, loop = trainer.env, trainer.loop
    act, tried = _Explorer(trainer), _Explorer(trainer, first_world=env.num_envs)
    act.steps = tried.steps = trainer.iteration * env.goal_period  # so that no two audits of a run draw the same
    clones.act = tried
    every = torch.arange(env.num_envs, device=env.device)
    draw = uniforms(trainer.config.seed, Purpose.AUDIT_CONTEXT, every, every.new_tensor(act.steps))[:, 0]
    wanted = torch.zeros_like(draw, dtype=torch.bool)
    wanted[draw.argsort()[:worlds]] = True
    decisions = []
    for _ in range(env.goal_period):
        step = env.step(act(env.obs))
        rows = (step.goal_due & ~step.terminated & ~step.truncated & wanted).nonzero().squeeze(1)
        if len(rows):
            decisions.append(_decide(trainer, rows))
            wanted[rows] = False
        loop.advance(step)
    if not decisions:
        nothing = torch.zeros(0, env.goal_dim, dtype=torch.float32, device=env.device)
        return Choices([], [], nothing, nothing)
    return _judge(trainer, clones, decisions)


def audit_clones(trainer: Trainer) -> Clones:
    """Worlds for ``audit_choices`` to try candidates in, for any number of audits of the run."""
    return _explorers(trainer)[1]


@dataclass(frozen=True)
class _Decision:
    """A selector's choice in some worlds, and these worlds at the time."""

    worlds: dict[str, Tensor]
    candidates: Tensor
    chosen: Tensor
    score: Tensor | None
    place: Tensor
    at: Tensor


def _decide(trainer: Trainer, rows: Tensor) -> _Decision:
    env, selector = trainer.env, trainer.loop.selector
    obs = env.obs[rows]
    state, goal = env.state(obs), obs[:, env.goal_slice]
    scale = selector.goal_range()
    candidates = env.sample_goals(rows, CANDIDATES, scale).clone()
    worlds = {name: tensor[rows] for name, tensor in env.tensors.items()}
    chosen = selector.propose(rows, state, goal, candidates, env.draw(rows)).goal
    own = ~(candidates == chosen.unsqueeze(1)).all(2).any(1, keepdim=True)
    candidates[:, 0] = torch.where(own, chosen, candidates[:, 0])  # a goal that was not a candidate is ranked too
    if scale is not None:  # it chose from part of the range, as a curriculum does, but is judged among goals of all
        candidates = torch.where(
            (candidates == chosen.unsqueeze(1)).all(2, keepdim=True), candidates, env.sample_goals(rows, CANDIDATES)
        )
    afraid = fear_selector(selector)
    score = afraid.score(state, goal, candidates) if afraid is not None and afraid.fear.fitted else None
    bounds = env.goal_bounds(rows)
    if bounds is None:
        return _Decision(worlds, candidates, chosen, score, chosen[:0], chosen[:0])
    middle, half = (bounds[0] + bounds[1]) / 2, (bounds[1] - bounds[0]) / 2
    position = env.place(rows)
    place = (goal - middle) / half if position is None else position
    return _Decision(worlds, candidates, chosen, score, place, (chosen - middle) / half)


def _judge(trainer: Trainer, clones: Clones, decisions: list[_Decision]) -> Choices:
    """Try the candidates of all decisions together: clones are stepped as a whole, however few decide at once."""
    candidates, chosen = (torch.cat([getattr(each, name) for each in decisions]) for name in ("candidates", "chosen"))
    every = torch.arange(len(candidates), device=candidates.device)
    held = trainer.config.env.build(len(candidates), trainer.env.device, trainer.config.seed)
    for name, tensor in held.tensors.items():
        tensor[:] = torch.cat([each.worlds[name] for each in decisions])
    survived = clones.try_out(held, every, candidates)
    pick = (candidates == chosen.unsqueeze(1)).all(2).int().argmax(1)
    percentile = picks.percentile(-survived, -picks.take(survived, pick))[survived.amin(1) < survived.amax(1)].tolist()
    crashed = survived < trainer.env.goal_period
    scores = [each.score for each in decisions if each.score is not None]
    pairs = zip(torch.cat(scores), crashed, strict=True) if scores else ()
    ranks = [auroc(score, label) for score, label in pairs if 0 < int(label.sum()) < CANDIDATES]
    place, at = (torch.cat([getattr(each, name) for each in decisions]) for name in ("place", "at"))
    return Choices(percentile, ranks, place, at)
