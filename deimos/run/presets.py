"""Ready-made configurations: what an environment is trained with by default.

A module of ``deimos.sim.envs`` may hold ``PRESETS``: by name, the fields of ``TrainConfig`` that differ from its
defaults, in plain dictionaries as ``config.json`` has them: those of the environment in ``env``, of the learner in
``ppo``, of the evaluation in ``eval``. The one with the environment's own name is where ``env:NAME`` starts from. As on
the command line, hyphens and underscores in a name are the same.
"""

from types import ModuleType
from typing import Any

from deimos import plugins
from deimos.learn.ppo import PPOConfig
from deimos.run.config import changed, from_dict, kind
from deimos.run.trainer import TrainConfig
from deimos.sim import envs


def _all() -> dict[str, tuple[str, dict[str, Any]]]:
    """Environment and fields of every preset, by name."""
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    for env, presets in plugins.load_all(envs, _of_module).items():
        own = {spelled(env): {}} | presets
        found |= {name: (env, fields) for name, fields in own.items()}
    return found


def _of_module(module: ModuleType) -> dict[str, dict[str, Any]]:
    """Fields of the presets that an environment's module holds."""
    return {spelled(name): fields for name, fields in getattr(module, "PRESETS", {}).items()}


def names() -> list[str]:
    """Names of all presets, sorted."""
    return sorted(_all())


def environment(name: str) -> str:
    """Name of the environment that a preset is for; see ``preset``."""
    return kind(preset(name).env)


def preset(name: str, **changes: Any) -> TrainConfig:
    """The configuration of a preset, as ``deimos train --preset`` starts from, with some fields changed.

    ``preset("quad-walk", seed=3, env={"terrain": "rough"})`` walks on rough ground, and keeps the rest of the task.

    Args:
        name: Its name; the preset of an environment's name, such as ``quad``, is what ``env:quad`` starts from.
        changes: Fields of ``TrainConfig``, as for ``dataclasses.replace``. Where one is a configuration (``env``,
            ``ppo``, ``eval``), a dictionary changes only the fields that it names.

    Raises:
        ValueError: If there is no such preset (the message lists all), a field is unknown, a value is not allowed, or
            ``env`` is another environment.
    """
    found = _all()
    if spelled(name) not in found:
        raise ValueError(f"Unknown preset '{name}'; choose from: {', '.join(sorted(found))}.")
    env, fields = found[spelled(name)]
    config = from_dict(TrainConfig, fields | {"env": {"kind": env} | fields.get("env", {})})
    made = changed(config, changes)
    if type(made.env) is not type(config.env):
        raise ValueError(f"The preset '{name}' is for {env}, not for {type(made.env).__module__}.Config.")
    return made


def advice(config: TrainConfig) -> str:
    """A warning if an environment is given the default learner and its own preset has another; otherwise empty."""
    env = kind(config.env)
    own = plugins.load(envs, env, _of_module).get(spelled(env), {})
    if config.ppo != PPOConfig() or "ppo" not in own:
        return ""
    return (
        f"{env} is trained with the default ppo, which is Particle Gym's, and may learn nothing; "
        f"start from deimos.preset('{spelled(env)}')."
    )


def spelled(name: str) -> str:
    """A name as it is listed: hyphens and underscores are the same."""
    return name.replace("_", "-")
