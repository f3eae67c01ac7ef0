"""The grid of a study: which cells it has, and what fixes each of them."""

import contextlib
import hashlib
import json
import re
import tomllib
import typing
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

from deimos.checks import RunError, one_line
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig
from deimos.run import presets
from deimos.run.config import from_dict, to_dict
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.env import EnvConfig

SCHEMA = 1  # of cell.json
_KEYS = {"base", "seeds", "methods", "train", "environment"}
_ENVIRONMENT_KEYS = {"name", "preset", "env", "methods", "train", "goal_periods"}
_GRID = {"env", "method", "selector", "seed", "evaluation"}  # of TrainConfig: the grid's, not the settings'


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One training run and its evaluations: a pure function of ``digest``."""

    environment: str
    """Name of the environment or variant in tables and figures."""
    config: TrainConfig
    """The run, with the evaluation's sizes."""
    goal_periods: tuple[int, ...]
    """The T that the policy is evaluated at [steps]."""

    def __post_init__(self) -> None:
        if not self.goal_periods or len(set(self.goal_periods)) < len(self.goal_periods):
            raise ValueError(f"goal_periods must be one or more different numbers, got {self.goal_periods}.")
        for period in self.goal_periods:
            replace(self.config, env=self.config.env.with_goal_period(period))  # is the evaluation long enough for it?

    @cached_property
    def digest(self) -> str:
        """First 12 hexadecimal digits of the SHA-256 of everything that the numbers depend on."""
        selector, periods = _spelled_out(self.config.goals), list(self.goal_periods)
        return _digest(config=to_dict(self.config), selector=selector, goal_periods=periods)

    @cached_property
    def setting(self) -> str:
        """The same of what the cells of one environment must share to be compared: all but selector and seed."""
        config = to_dict(self.config)
        shared = {name: value for name, value in config.items() if name not in ("method", "selector", "seed")}
        return _digest(config=shared, goal_periods=list(self.goal_periods))

    @cached_property
    def selector(self) -> str:
        """The same of what the cells of one method must share: what the method's name stands for."""
        return _digest(selector=_spelled_out(self.config.goals))

    @cached_property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.environment}-{self.config.label}-s{self.config.seed}-{self.digest[:8]}"

    def to_dict(self) -> dict:
        """As JSON types; see ``read_cell``."""
        return {"schema": SCHEMA} | to_dict(self)


def _spelled_out(config: SelectorConfig, known: tuple[str, ...] = ()) -> dict:
    """A selector's configuration with those of the methods that it names, as Schedule and Mix do."""
    fields, named = to_dict(config), {}
    hints = typing.get_type_hints(type(config))
    for value in [value for name, value in fields.items() if hints.get(name) is str and value not in known]:
        with contextlib.suppress(ValueError):  # it names no method
            named[value] = _spelled_out(method(value), (*known, value))
    return fields | ({"methods": named} if named else {})


def _digest(**data: Any) -> str:
    text = json.dumps({"schema": SCHEMA} | data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def read_cell(path: Path) -> Cell:
    """Read a ``cell.json``; raises ``RunError`` if it is broken or of another version."""
    data = RunFolder(path.parent).read_json(path.name)
    try:
        if (found := data.pop("schema")) != SCHEMA:
            raise ValueError(f"its schema is {found}, not {SCHEMA}")
        return from_dict(Cell, data)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{path} does not describe a cell ({error}).") from error


def read(path: Path) -> dict:
    """Read the description of a study from a TOML file.

    Its keys: ``seeds`` (see ``parse_seeds``), ``methods`` (names), ``train`` (fields of
    ``TrainConfig`` for all cells), and an ``[[environment]]`` for each environment or variant, with ``name``,
    ``env`` (its ``kind`` and fields) and, if they differ there, ``methods``, ``train`` and ``goal_periods``; its
    ``preset`` is one of ``deimos.run.presets``, where its environment and settings come from that are not said.
    ``base`` names another such file, as seen from this one, where everything comes from that is not said.

    Raises ``RunError`` if it or its base cannot be read or is not TOML.
    """
    try:
        data = tomllib.loads(path.read_text())
        return read(path.parent / data["base"]) | data if "base" in data else data
    except RecursionError as error:
        raise RunError(f"{path} is a base of itself.") from error
    except (OSError, TypeError, ValueError) as error:
        raise RunError(f"{path} is not a study's TOML file ({error}).") from error


def expand(
    description: dict, *, seeds: list[int] | str | None = None, methods: Sequence[str] | None = None,
    environments: Sequence[str] | None = None, train: dict | None = None,
) -> list[Cell]:  # fmt: skip
    """All cells of a study, seed by seed, so that a study cut short has the same seeds of every method.

    Args:
        description: See ``read``.
        seeds: See ``parse_seeds``; in place of its own, as ``methods`` are, in every environment.
        methods: Names.
        environments: Names of those to take; ``None`` for all.
        train: Fields of ``TrainConfig`` that come before its own.

    Raises:
        RunError: If something is unknown, missing, doubled or out of range.
    """
    _check_keys("A study", description, _KEYS)
    tables = description.get("environment", [])
    if not isinstance(tables, list) or not tables:
        raise RunError("A study must have an [[environment]].")
    names = [str(table.get("name", "")) for table in tables]
    _check_unique("environment", names)
    if unknown := [name for name in environments or () if name not in names]:
        raise RunError(f"This study has no environment {', '.join(unknown)}; it has: {', '.join(names)}.")
    wanted = names if environments is None else environments
    numbers = parse_seeds(description.get("seeds", 10) if seeds is None else seeds)
    try:
        grid = [
            cell for name, table in zip(names, tables, strict=True) if name in wanted
            for cell in _environment(table, description, methods, train or {})
        ]  # fmt: skip
        return [replace(cell, config=replace(cell.config, seed=seed)) for seed in numbers for cell in grid]
    except (AttributeError, TypeError, ValueError) as error:  # what from_dict and the configurations raise
        raise RunError(one_line(error)) from error


def _environment(table: dict, study: dict, methods: Sequence[str] | None, train: dict) -> list[Cell]:
    """A cell, without its seed, for each method of an environment; arguments as those of ``expand``."""
    _check_keys("An [[environment]]", table, _ENVIRONMENT_KEYS)
    name = table.get("name")
    if not isinstance(name, str) or not name.replace("_", "").replace(".", "").isalnum():
        raise RunError(f"An [[environment]] must have a name of letters, digits, '.' and '_', got {name!r}.")
    shared, own = study.get("train", {}), table.get("train", {})
    if taken := sorted((set(shared) | set(own)) & _GRID):
        raise RunError(f"{', '.join(taken)} cannot stand in 'train': the grid of the study says it.")
    methods = list(table.get("methods", study.get("methods")) or [] if methods is None else methods)
    if not methods:
        raise RunError(f"Environment '{name}' has no methods.")
    _check_unique("method", methods)
    try:
        ready = _training_preset(table)
        env = from_dict(EnvConfig, _merged(ready.pop("env", {}), table.get("env", {})))
    except ValueError as error:
        raise RunError(f"Environment '{name}': {error}") from error
    fields = reduce(_merged, (ready, {"threads": 1}, shared, own, train, {"env": to_dict(env)}))
    configs = [from_dict(TrainConfig, fields | {"method": each}) for each in methods]
    periods = tuple(table.get("goal_periods") or [env.goal_period])
    return [Cell(environment=name, config=config, goal_periods=periods) for config in configs]


def _training_preset(table: dict) -> dict:
    """What the preset that an environment's table names says of ``TrainConfig``, but for the grid and the machine."""
    if "preset" not in table:
        return {}
    name = table["preset"]
    if not isinstance(name, str):
        raise ValueError(f"preset must be the name of one, got {name!r}.")
    kind = table.get("env", {}).get("kind", presets.environment(name))
    if kind != presets.environment(name):
        raise ValueError(f"preset '{name}' is for {presets.environment(name)}, not for {kind}.")
    fields = to_dict(presets.preset(name))
    return {key: value for key, value in fields.items() if key == "env" or key not in _GRID | {"threads", "device"}}


def parse_seeds(given: Any) -> list[int]:
    """Seeds of a number of them (10, or the text "10"), a range ("10-19") or a list ("0,3,5", or one of numbers).

    Raises ``RunError`` for anything else, and if a seed is there twice.
    """
    spans = []
    if type(given) is int or re.fullmatch(r"[1-9]\d*", str(given)):
        spans = [range(int(given))]
    elif isinstance(given, str | list):
        for part in given.split(",") if isinstance(given, str) else map(str, given):
            found = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
            spans.append(range(int(found[1]), int(found[2] or found[1]) + 1) if found else range(0))
    if not spans or not all(spans):
        example = "a number of seeds, a range that rises like 10-19 or a list like 0,3,5"
        raise RunError(f"seeds must be {example}, got {given!r}.")
    seeds = [seed for span in spans for seed in span]
    _check_unique("seed", seeds)
    return seeds


def _check_unique(what: str, values: Sequence[Any]) -> None:
    if doubled := sorted({value for value in values if list(values).count(value) > 1}):
        raise RunError(f"Every {what} must be given once; doubled: {', '.join(map(str, doubled))}.")


def _check_keys(what: str, data: dict, known: set[str]) -> None:
    if unknown := sorted(set(data) - known):
        raise RunError(f"{what} has no {', '.join(unknown)}; it has: {', '.join(sorted(known))}.")


def _merged(base: dict, over: dict) -> dict:
    """``base`` with what ``over`` says, table by table."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merged(merged[key], value) if both else value
    return merged
