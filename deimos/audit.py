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

from deimos import seeds
from deimos.env import Env
from deimos.fear import Fear, auroc
from deimos.run_folder import RunError

if TYPE_CHECKING:
    from deimos.training import Trainer

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
        context; ``contexts`` with both outcomes among those ``tried``; ``crash_share`` of all
        rollouts; ``iteration``.

    Raises:
        RunError: If there is no fear network, or no context with both outcomes.
    """
    fear = getattr(trainer.loop.selector, "fear", None)
    if not isinstance(fear, Fear) or not fear.fitted:
        raise RunError("This run's selector has no fear network that has learnt anything.")
    generator = seeds.generator(trainer.config.seed, "audit", trainer.env.device)
    probe = trainer.config.env.build(BATCH * CANDIDATES, trainer.env.device, trainer.config.seed)
    ranks: list[float] = []
    crashes = tried = 0
    while len(ranks) < contexts and tried < PATIENCE * contexts:
        state, goal, candidates = _next_contexts(trainer, probe, generator)
        logit = fear.score(state, goal, candidates)
        crashed = _crashes_within_period(trainer, probe, logit.numel(), generator).view_as(logit)
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
    picks = np.random.default_rng(0).integers(len(ranks), size=(RESAMPLES, len(ranks)))
    low, high = np.quantile(np.array(ranks)[picks].mean(axis=1), [0.025, 0.975])
    return {
        "auroc": math.fsum(ranks) / len(ranks),
        "low": float(low),
        "high": float(high),
        "contexts": len(ranks),
        "tried": tried,
        "crash_share": crashes / (tried * CANDIDATES),
        "iteration": trainer.iteration,
    }


@torch.no_grad()
def _next_contexts(trainer: "Trainer", probe: Env, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Go on until goals are due, and clone up to ``BATCH`` of those worlds into ``probe``, once per candidate.

    Returns:
        States (n, state_dim), goals in force (n, goal_dim) and candidates (n, CANDIDATES, goal_dim).
    """
    env = trainer.env
    while True:
        step = env.step(_act(trainer, env.obs, generator))
        rows = (step.goal_due & ~step.terminated & ~step.truncated).nonzero().squeeze(1)
        if len(rows) == 0:
            trainer.loop.advance(step)
            continue
        rows = rows[torch.randperm(len(rows), generator=generator, device=rows.device)[:BATCH]]
        obs = env.obs[rows]
        candidates = env.sample_goals(rows, CANDIDATES).clone()
        clones = torch.arange(len(rows) * CANDIDATES, device=rows.device)
        probe.copy_worlds(rows.repeat_interleave(CANDIDATES), clones, origin=env)
        probe.set_goals(clones, candidates.flatten(0, 1))
        trainer.loop.advance(step)
        return env.state(obs), obs[:, env.goal_slice], candidates


@torch.no_grad()
def _crashes_within_period(trainer: "Trainer", probe: Env, count: int, generator: torch.Generator) -> Tensor:
    """Roll the policy out for T steps in the first ``count`` worlds of ``probe``; which crashed, shape (count,)."""
    crashed = torch.zeros(probe.num_envs, dtype=torch.bool, device=probe.device)
    for _ in range(probe.goal_period):
        crashed |= probe.step(_act(trainer, probe.obs, generator)).terminated
    return crashed[:count]


def _act(trainer: "Trainer", obs: Tensor, generator: torch.Generator) -> Tensor:
    """Actions as in training: drawn, not the mean."""
    mean = trainer.ppo.actor(obs)
    return mean + trainer.ppo.actor.std * torch.randn(mean.shape, generator=generator, device=mean.device)
