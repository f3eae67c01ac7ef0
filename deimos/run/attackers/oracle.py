"""It tries every candidate in clones of the world and asks for the one that crashes the policy soonest.

Where none does within T steps, it asks for the one that the network of ``argmax-long`` fears most.
"""

from dataclasses import dataclass

from deimos.run.attack import Attack, Target, learn_fear
from deimos.run.attackers import argmax_long
from deimos.run.oracle import Clones, Oracle


@dataclass(frozen=True, kw_only=True)
class Config(argmax_long.Config):
    """A goal costs N T steps of a clone."""

    few_worlds = True
    """Clones are expensive: it attacks only ``eval.oracle_worlds`` of the worlds."""

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``."""
        fear, facts = learn_fear(target, self.longer * target.steps, own_goals=True)
        clones = Clones(lambda count: target.build(count, target.seed), target.policy, guard=target.guard)
        return Attack(lambda env: Oracle(env, clones, fear=fear), facts | {"uninformed": False})
