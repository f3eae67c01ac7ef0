"""It asks for what a fear network fears most that was trained on other policies: it needs no crash of this one.

The file of the network is made before any of the policies that it attacks (``deimos pool``), so that all of them meet
the very same attacker (after Uesato et al. 2019, who train an adversary on weaker agents).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from deimos.checks import RunError, one_line
from deimos.files import load_tensors, save_tensors
from deimos.goals.fear import Fear, FearConfig
from deimos.goals.interactions import Resolved
from deimos.run.attack import HELD_OUT, Attack, AttackerConfig, Target, argmax_director, collect, learnt_from, quality
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
            RunError: If the file is broken, or that of another environment.
        """
        assert target.pool is not None
        found = load_tensors(target.pool, "pool", SCHEMA)
        env = target.build(1, target.seed)
        if found["layout"] != str(env.layout):
            raise RunError(f"{target.pool} is of other observations: {found['layout']}, not {env.layout}.")
        try:
            fear = Fear(from_dict(FearConfig, found["fear"]), env.state_dim, env.goal_dim, env.device, target.seed)
            fear.network.load_state_dict(found["network"])
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise RunError(f"{target.pool} is broken: {one_line(error)}") from error
        fear.fitted = True
        return Attack(lambda env: argmax_director(env, fear), found["facts"] | {"uninformed": False})


def make_pool(targets: Sequence[Target], path: Path) -> dict[str, Any]:
    """Train a fear network on the interactions of many policies, each with the same number of steps.

    Args:
        targets: The policies, at least 1, of one environment.
        path: The file to write.

    Returns:
        The facts that rows of the attacker have: see ``learn_fear``.

    Raises:
        RunError: If the environments differ, crashes or survivals are missing, or the file cannot be written.
    """
    envs = [target.build(1, target.seed) for target in targets]
    if len({str(env.layout) for env in envs}) > 1:
        raise RunError("The policies observe different things, so they have no fear in common.")
    found = [collect(target, target.steps, own_goals=True)[1] for target in targets]
    data = Resolved(
        **{field.name: torch.cat([getattr(part, field.name) for part in found]) for field in fields(Resolved)}
    )
    first, env = targets[0], envs[0]
    fear = Fear(first.fear, env.state_dim, env.goal_dim, env.device, first.seed)
    fear.fit(learnt_from(data))
    fear.check()
    if not fear.fitted:
        raise RunError("These policies never crashed, or always, so there is nothing to learn; pool others.")
    facts = {
        "adversary_steps": sum(target.steps for target in targets), "adversary_interactions": len(data),
        "adversary_crashes": int(data.crashed.sum()),
        "adversary_auroc": quality(fear, data.where(data.env % HELD_OUT == 0)),
    }  # fmt: skip
    save_fear(path, fear, env, facts)
    return facts


def save_fear(path: Path, fear: Fear, env: Env, facts: dict[str, Any]) -> None:
    """Write the file of a fear network.

    Args:
        path: The file.
        fear: The network.
        env: Worlds that it is for.
        facts: What rows of the attacker say of it.

    Raises:
        RunError: If the file cannot be written.
    """
    network = {name: weights.cpu() for name, weights in fear.network.state_dict().items()}
    save_tensors(path, {
        "schema": SCHEMA, "layout": str(env.layout), "fear": to_dict(fear.config), "network": network, "facts": facts,
    })  # fmt: skip
