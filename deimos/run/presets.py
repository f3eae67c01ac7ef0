"""Ready configurations: what an environment is trained with unless somebody says otherwise.

A module of ``deimos.sim.envs`` may hold ``PRESETS``: by name, the fields of ``TrainConfig`` that differ from its
defaults, in plain dictionaries as ``config.json`` has them: those of the environment in ``env``, of the learner in
``ppo``, of the evaluation in ``eval``. The one with the environment's own name is what ``env:NAME`` starts from. As on
the command line, hyphens and underscores in a name are the same.
"""

from typing import Any

from deimos import plugins
from deimos.run.config import from_dict
from deimos.run.trainer import TrainConfig
from deimos.sim import envs


def _all() -> dict[str, tuple[str, dict[str, Any]]]:
    """Environment and fields of every preset."""
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    for env, presets in plugins.load_all(envs, lambda module: dict(getattr(module, "PRESETS", {}))).items():
        own = {spelled(env): {}} | presets
        found |= {spelled(name): (env, fields) for name, fields in own.items()}
    return found


def names() -> list[str]:
    """Names of all presets, sorted."""
    return sorted(_all())


def environment(name: str) -> str:
    """Name of the environment that a preset is for.

    Raises:
        ValueError: If there is no such preset; the message lists those that there are.
    """
    return _get(name)[0]


def preset(name: str) -> TrainConfig:
    """The configuration of a preset.

    Raises:
        ValueError: If there is no such preset; the message lists those that there are. Or if one of its fields is
            unknown or not allowed.
    """
    env, fields = _get(name)
    return from_dict(TrainConfig, fields | {"env": {"kind": env} | fields.get("env", {})})


def _get(name: str) -> tuple[str, dict[str, Any]]:
    found = _all()
    if spelled(name) not in found:
        raise ValueError(f"There is no preset '{name}'; there are: {', '.join(sorted(found))}.")
    return found[spelled(name)]


def spelled(name: str) -> str:
    """A name as it is listed: hyphens and underscores are the same."""
    return name.replace("_", "-")
