"""It asks for what leads to a crash now or under the worst goals that may follow, beyond T steps.

See ``deimos.goals.selectors.q_fear``, whose selector it trains on the finished policy.
"""

from dataclasses import dataclass

import torch

from deimos.checks import check_range
from deimos.goals.selectors import q_fear
from deimos.run.attack import Attack, Target, argmax_director
from deimos.run.attackers import argmax_long
from deimos.run.loop import GoalLoop, spaces


@dataclass(frozen=True, kw_only=True)
class Config(argmax_long.Config):
    """It learns every T steps, over as many steps as ``argmax-long``; every other goal in them is its own."""

    beta: float = 0.9
    """Weight of what follows, in [0, 1)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("beta", self.beta, 0.0, 1.0 - 1e-6)

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``; the AUROC is that of the last T steps, before it learnt from them."""
        env = target.build(target.worlds, target.seed + 1)
        config = q_fear.Config(rule="argmax", probe=0.5, beta=self.beta, fear=target.fear)
        selector = config.build(spaces(env), target.seed)
        # The last T steps: for earlier interactions, what could have followed is no longer known.
        loop = GoalLoop(env, selector, window=env.goal_period, guard=target.guard)
        interactions = crashes = 0
        steps, quality = self.longer * target.steps, torch.nan
        for t in range(1, steps + 1):
            with torch.no_grad():
                step = env.step(target.policy(env.obs))
            loop.advance(step)
            if t % env.goal_period == 0:
                target.progress(t / steps)
                done = loop.interactions.resolved()
                interactions, crashes = interactions + len(done), crashes + int(done.crashed.sum())
                quality = selector.learn(loop.interactions, None)["fear/auroc"]
        env.check()
        selector.check()
        return Attack(lambda env: argmax_director(env, selector.fear), {
            "adversary_steps": steps, "adversary_interactions": interactions, "adversary_crashes": crashes,
            "adversary_auroc": quality, "uninformed": not selector.fear.fitted,
        })  # fmt: skip
