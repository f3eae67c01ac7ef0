"""The thesis's Adversary with four times the steps, half of them under its own goals, so that it sees rare crashes."""

from dataclasses import dataclass

from deimos.checks import check_at_least
from deimos.run.attack import Attack, AttackerConfig, Target, argmax_director, learn_fear


@dataclass(frozen=True, kw_only=True)
class Config(AttackerConfig):
    """Its network learns from 6000 steps; every other goal in them is its own."""

    longer: int = 4
    """Steps to learn from, in multiples of those of ``argmax``, at least 1."""

    def __post_init__(self) -> None:
        check_at_least("longer", self.longer, 1)

    def learning_steps(self, steps: int) -> int:
        """See ``AttackerConfig.learning_steps``."""
        return self.longer * steps

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``."""
        fear, facts = learn_fear(target, self.longer * target.steps, own_goals=True)
        return Attack(lambda env: argmax_director(env, fear), facts)
