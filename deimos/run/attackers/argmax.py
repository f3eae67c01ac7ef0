"""The thesis's Adversary (4.1.3): it asks for the candidate that a fear network, trained on the policy, fears most."""

from dataclasses import dataclass

from deimos.run.attack import Attack, AttackerConfig, Target, argmax_director, learn_fear


@dataclass(frozen=True, kw_only=True)
class Config(AttackerConfig):
    """Its network learns from 1500 steps under uniform goals."""

    def learning_steps(self, steps: int) -> int:
        """See ``AttackerConfig.learning_steps``."""
        return steps

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``."""
        fear, facts = learn_fear(target, target.steps, own_goals=False)
        return Attack(lambda env: argmax_director(env, fear), facts)
