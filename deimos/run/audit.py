"""Does the fear network rank goals rightly *within* a context? Exact labels from cloned worlds.

The AUROC over all interactions is flattered by states: near a wall everything is dangerous. What a
Director uses is the ranking of goals for one state and one goal in force. Here worlds at the moment of
a goal change are cloned, every clone gets another candidate goal, and the policy is rolled out for T
steps under each, with its actions drawn as in training.
"""

import math
from typing import TYPE_CHECKING

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
from deimos.nn import seeds
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones

if TYPE_CHECKING:
    from deimos.run.trainer import Trainer

CANDIDATES = 50  # goals tried in every context
BATCH = 256  # contexts cloned at a time
PATIENCE = 50  # contexts tried per context wanted, before giving up
RESAMPLES = 10_000


def audit_fear(trainer: "Trainer", contexts: int) -> dict:
    """Measure the AUROC within contexts of a training run's fear network.

    The run's own worlds go on as in training, without learning, and supply the contexts; only
    those where some candidates crash and some do not can be ranked.

    Args:
        trainer: A run whose selector has a fear network that has learnt. Its worlds move on.
        contexts: Contexts with both outcomes to collect, at least 1.

    Returns:
        ``auroc``, the mean over contexts; ``low`` and ``high``, its 95 % bootstrap interval by
        context; ``contexts`` with both outcomes among those ``tried``; ``crash_rate`` of all
        rollouts; ``iteration``.

    Raises:
        RunError: If there is no fear network, or no context with both outcomes.
    """
    afraid = _learnt_fear(trainer)
    generator, clones = _clones(trainer)
    ranks: list[float] = []
    crashes = tried = 0
    while len(ranks) < contexts and tried < PATIENCE * contexts:
        _, state, goal, candidates, survived = _next_contexts(trainer, clones, generator)
        logit = afraid.score(state, goal, candidates)
        crashed = survived < trainer.env.goal_period
        tried += len(logit)
        crashes += int(crashed.sum())
        ranks += [
            auroc(score, label)
            for score, label in zip(logit, crashed, strict=True)
            if 0 < int(label.sum()) < CANDIDATES
        ]
    if not ranks:
        raise RunError(
            f"None of {tried} contexts had both outcomes; the policy is too safe or too bad to rank its goals."
        )
    resamples = np.random.default_rng(0).integers(len(ranks), size=(RESAMPLES, len(ranks)))
    low, high = np.quantile(np.array(ranks)[resamples].mean(axis=1), [0.025, 0.975])
    return {
        "auroc": math.fsum(ranks) / len(ranks),
        "low": float(low),
        "high": float(high),
        "contexts": len(ranks),
        "tried": tried,
        "crash_rate": crashes / (tried * CANDIDATES),
        "iteration": trainer.iteration,
    }


def audit_percentile(trainer: "Trainer", contexts: int) -> dict[str, float]:
    """Measure how dangerous the goals of a training run's selector are, by the truth.

    Args:
        trainer: A run. Its worlds move on.
        contexts: Contexts to collect where candidates differ in danger, at least 1.

    Returns:
        ``percentile``: the mean percentile of the chosen goal among 50 candidates, by how soon each crashes the policy,
        ties counting half: 50 is Uniform's; and the number of ``contexts``.

    Raises:
        RunError: If no context has candidates that differ.
    """
    generator, clones = _clones(trainer)
    found: list[float] = []
    tried = 0
    while len(found) < contexts and tried < PATIENCE * contexts:
        rows, state, goal, candidates, survived = _next_contexts(trainer, clones, generator)
        tried += len(rows)
        chosen = trainer.loop.selector.propose(rows, state, goal, candidates, trainer.env.draw(rows)).goal
        pick = (candidates == chosen.unsqueeze(1)).all(2).int().argmax(1)
        percentile = picks.percentile(-survived, pick)
        found += percentile[survived.amin(1) < survived.amax(1)].tolist()
    if not found:
        raise RunError(f"In none of {tried} contexts do candidates differ in danger.")
    return {"percentile": math.fsum(found) / len(found), "contexts": float(len(found))}


def _clones(trainer: "Trainer") -> tuple[torch.Generator, Clones]:
    """Where to try candidates, with actions drawn as in training, and what these are drawn from."""
    config, device = trainer.config, trainer.env.device
    generator = seeds.generator(config.seed, "audit", device)
    return generator, Clones(
        lambda count: config.env.build(count, device, config.seed),
        lambda obs: _act(trainer, obs, generator), limit=BATCH * CANDIDATES,
    )  # fmt: skip


def audit_calibration(trainer: "Trainer", interactions: int) -> dict[str, tuple[Tensor, Tensor, dict[str, float]]]:
    """Judge the calibrated probabilities of a training run's fear network, on goals that it did not learn from.

    The run's own worlds go on as in training, without learning: first under the goals of its selector, which
    are a biased sample of all goals, then under uniform goals, which are not.

    Args:
        trainer: A run whose selector has a fear network that has learnt. Its worlds move on.
        interactions: Interactions to judge under either, at least 1.

    Returns:
        For ``selected`` and ``uniform`` goals: probabilities, shape (n,), what became of them, bool, shape (n,),
        and the dictionary of ``calibration.evaluate``, with ``interactions``, ``crash_rate`` and ``auroc``.

    Raises:
        RunError: If there is no fear network.
    """
    afraid = _learnt_fear(trainer)
    generator = seeds.generator(trainer.config.seed, "calibration", trainer.env.device)
    choosers = {"selected": trainer.loop.selector, "uniform": uniform.Config().build(spaces(trainer.env), 0)}
    results = {}
    for name, chooser in choosers.items():
        done = _watch(trainer, chooser, interactions, generator)
        score = afraid.score(done.state, done.goal, done.next_goal.unsqueeze(1)).squeeze(1)
        probability = afraid.calibration.probability(score)
        counts = {"interactions": float(len(done)), "crash_rate": done.crashed.float().mean().item()}
        quality = counts | {"auroc": auroc(score, done.crashed)} | evaluate(probability, done.crashed)
        results[name] = probability, done.crashed, quality
    return results


def _learnt_fear(trainer: "Trainer") -> FearSelector:
    afraid = fear_selector(trainer.loop.selector)
    if afraid is None or not afraid.fear.fitted:
        raise RunError("This run's selector has no fear network that has learnt anything.")
    return afraid


@torch.no_grad()
def _watch(trainer: "Trainer", chooser: GoalSelector, count: int, generator: torch.Generator) -> Resolved:
    """Let the policy go on under a selector's goals until ``count`` interactions have ended, in whole periods."""
    env = trainer.env
    periods = -(-count // env.num_envs)
    loop = GoalLoop(env, chooser, window=(periods + 1) * env.goal_period)
    begin = periods * env.goal_period
    for _ in range((periods + 1) * env.goal_period):
        loop.advance(env.step(_act(trainer, env.obs, generator)))
    done = loop.interactions.resolved()
    return done.where(done.issued <= begin)  # of the later ones only the crashes are known yet


def _act(trainer: "Trainer", obs: Tensor, generator: torch.Generator) -> Tensor:
    """Actions as in training: drawn, not the mean."""
    mean = trainer.ppo.actor(obs)
    return mean + trainer.ppo.actor.std * torch.randn(mean.shape, generator=generator, device=mean.device)


@torch.no_grad()
def _next_contexts(
    trainer: "Trainer", clones: Clones, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Go on until goals are due, and try candidates in up to ``BATCH`` of those worlds.

    Returns:
        Worlds (n,), states (n, state_dim), goals in force (n, goal_dim), candidates (n, CANDIDATES, goal_dim) and the
        steps survived under each (n, CANDIDATES).
    """
    env = trainer.env
    while True:
        step = env.step(clones.act(env.obs))
        rows = (step.goal_due & ~step.terminated & ~step.truncated).nonzero().squeeze(1)
        if len(rows) == 0:
            trainer.loop.advance(step)
            continue
        rows = rows[torch.randperm(len(rows), generator=generator, device=rows.device)[:BATCH]]
        obs = env.obs[rows]
        candidates = env.sample_goals(rows, CANDIDATES).clone()
        survived = clones.try_out(env, rows, candidates)
        trainer.loop.advance(step)
        return rows, env.state(obs), obs[:, env.goal_slice], candidates, survived
