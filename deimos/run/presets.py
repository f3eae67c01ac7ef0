"""Ready-made configurations: what an environment is trained with by default.

A module of ``deimos.sim.envs`` may hold ``PRESETS``: by name, the fields of ``TrainConfig`` that differ from its
defaults, in plain dictionaries as ``config.json`` has them: those of the environment in ``env``, of the learner in
``ppo``, of the evaluation in ``eval``. The one with the environment's own name is where ``env:NAME`` starts from. As on
the command line, hyphens and underscores in a name are the same.
"""

from typing import Any

from deimos import plugins
from deimos.run.config import from_dict, kind
from deimos.run.trainer import TrainConfig
from deimos.sim import envs


def _all() -> dict[str, tuple[str, dict[str, Any]]]:
    """Environment and fields of every preset, by name."""
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    for env, presets in plugins.load_all(envs, lambda module: dict(getattr(module, "PRESETS", {}))).items():
        own = {spelled(env): {}} | presets
        found |= {spelled(name): (env, fields) for name, fields in own.items()}
    return found


def names() -> list[str]:
    """Names of all presets, sorted."""
    return sorted(_all())


def environment(name: str) -> str:
    """Name of the environment that a preset is for; see ``preset``."""
    return kind(preset(name).env)


def preset(name: str) -> TrainConfig:
    """The configuration of a preset.

    Raises:
        ValueError: If there is no such preset (the message lists all), or one of its fields is unknown or not allowed.
    """
    found = _all()
    if spelled(name) not in found:
        raise ValueError(f"Unknown preset '{name}'; choose from: {', '.join(sorted(found))}.")
    env, fields = found[spelled(name)]
    return from_dict(TrainConfig, fields | {"env": {"kind": env} | fields.get("env", {})})


def spelled(name: str) -> str:
    """A name as it is listed: hyphens and underscores are the same."""
    return name.replace("_", "-")
