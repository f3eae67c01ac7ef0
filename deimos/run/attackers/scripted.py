"""What a person would ask for to crash a policy, without learning anything: see ``Env.scripted_goals``."""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.goals.selector import GoalSelector, Proposal, uniform_proposal
from deimos.run.attack import Attack, AttackerConfig, Target
from deimos.sim.env import Env


@dataclass(frozen=True, kw_only=True)
class Config(AttackerConfig):
    """The environment's own worst goals; uniform ones where it defines none."""

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``."""
        env = target.build(1, target.seed)
        rows = torch.zeros(1, dtype=torch.int64, device=env.device)
        return Attack(Scripted, {"uninformed": env.scripted_goals(rows, env.goal) is None})


class Scripted(GoalSelector):
    """Asks for an environment's scripted goals.

    Args:
        env: The worlds whose goals it chooses.
    """

    def __init__(self, env: Env) -> None:
        self._env = env

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        chance = uniform_proposal(candidates, draws[:, 0])
        scripted = self._env.scripted_goals(rows, chance.goal)
        return chance if scripted is None else Proposal(scripted, chance.score)
