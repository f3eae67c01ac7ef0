"""It asks for what a fear network that was trained on other policies fears most: it needs no crash of this one.

The file of the network is made first (``deimos pool``), so that all policies that it attacks meet the same attacker
(after Uesato et al. 2019, who train an adversary on weaker agents).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deimos.checks import RunError, one_line
from deimos.files import load_tensors, save_tensors
from deimos.goals.fear import Fear, FearConfig
from deimos.run.attack import Attack, AttackerConfig, Target, argmax_director, fear_of
from deimos.run.config import from_dict, to_dict
from deimos.sim.env import Env

SCHEMA = 1  # of the file


@dataclass(frozen=True, kw_only=True)
class Config(AttackerConfig):
    """Its network comes from the file ``EvalConfig.pool``."""

    needs_pool = True

    def prepare(self, target: Target) -> Attack:
        """See ``AttackerConfig.prepare``.

        Raises:
            RunError: If the file is broken, or belongs to another environment.
        """
        assert target.pool is not None
        found = load_tensors(target.pool, "pool", SCHEMA)
        env = target.build(1, target.seed)
        if found["layout"] != str(env.layout):
            raise RunError(f"{target.pool} is for other observations: {found['layout']}, not {env.layout}.")
        try:
            fear = Fear(from_dict(FearConfig, found["fear"]), env.state_dim, env.goal_dim, env.device, target.seed)
            fear.network.load_state_dict(found["network"])
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise RunError(f"{target.pool} is broken: {one_line(error)}") from error
        facts = {"uninformed": False} | found["facts"]
        fear.fitted = not facts["uninformed"]
        return Attack(lambda env: argmax_director(env, fear), facts)


def make_pool(targets: Sequence[Target], path: Path, *, may_be_uninformed: bool = False) -> dict[str, Any]:
    """Train a fear network on the interactions of many policies, each with the same number of steps.

    Half of the goals are the network's own, one network for all policies: so it learns what crashes most of them, and
    where its fear is wrong.

    Args:
        targets: The policies, at least 1, of one environment.
        path: The file to write.
        may_be_uninformed: Whether to write a file even if crashes or survivals are missing. Its network has then learnt
            nothing, and the attacker's goals are uniform.

    Returns:
        The facts that rows of the attacker have: see ``learn_fear``.

    Raises:
        RunError: If the environments differ, crashes or survivals are missing, or the file cannot be written.
    """
    envs = [target.build(1, target.seed) for target in targets]
    if len({str(env.layout) for env in envs}) > 1:
        raise RunError("The policies have different observations, so they cannot share a fear network.")
    if len(periods := sorted({env.goal_period for env in envs})) > 1:
        raise RunError(f"The policies must have goals of the same period T, got {', '.join(map(str, periods))}.")
    fear, facts = fear_of(targets, targets[0].steps, own_goals=True)
    if facts["uninformed"] and not may_be_uninformed:
        raise RunError("These policies never or always crashed, so there is nothing to learn; pool others.")
    save_fear(path, fear, envs[0], facts)
    return facts


def save_fear(path: Path, fear: Fear, env: Env, facts: dict[str, Any]) -> None:
    """Write the file of a fear network.

    Args:
        path: The file.
        fear: The network.
        env: Worlds that it is for.
        facts: Facts about it for rows of the attacker.

    Raises:
        RunError: If the file cannot be written.
    """
    network = {name: weights.cpu() for name, weights in fear.network.state_dict().items()}
    save_tensors(path, {
        "schema": SCHEMA, "layout": str(env.layout), "fear": to_dict(fear.config), "network": network, "facts": facts,
    })  # fmt: skip
