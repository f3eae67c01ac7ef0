"""The grid of a study: which cells it has, and what fixes each of them."""

import contextlib
import hashlib
import json
import re
import tomllib
import typing
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import Any

import deimos
from deimos.checks import RunError, check_at_least, one_line
from deimos.files import first_line, read_bytes
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig
from deimos.run import presets, training
from deimos.run.branch import branch_config, check_branch, flat
from deimos.run.config import from_dict, multiplied, to_dict
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim.env import EnvConfig
from deimos.study import factors
from deimos.study.factors import merged
from deimos.study.source import Files, code, hashes, import_plugins
from deimos.study.tables import check_kind, check_table, shown

SCHEMA = 2  # of cell.json
MOST_SEEDS = 100_000
_OWN: dict[str, tuple[type, type | None]] = {
    "methods": (list, str), "train": (dict, None), "audit_worlds": (int, None), "branch_from": (str, None),
    "pools": (str, None),
}  # fmt: skip
_KEYS: dict[str, tuple[type, type | None]] = _OWN | {
    "base": (str, None), "plugins": (list, str), "environment": (list, dict), "factors": (dict, None),
    "design": (dict, None), "attack": (list, dict),
}  # fmt: skip
_ENVIRONMENT_KEYS: dict[str, tuple[type, type | None]] = _OWN | {
    "name": (str, None), "preset": (str, None), "env": (dict, None), "goal_periods": (list, int),
}  # fmt: skip
_GRID = {"env", "method", "selector", "seed", "evaluation"}  # of TrainConfig: the grid's, not the settings'
_SEED = "{seed}"  # stands for the number in texts of a study's file


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One training run and its evaluations: a pure function of ``digest``."""

    environment: str
    """Name of the environment or variant in tables and figures."""
    config: TrainConfig
    """The run, with the evaluation's sizes."""
    goal_periods: tuple[int, ...]
    """The T that the policy is evaluated at [steps]."""
    base_environment: str = ""
    """Name of the environment in the study's file, which factors divide."""
    levels: dict[str, Any] = field(default_factory=dict)
    """Level of every factor, by its name."""
    audit_worlds: int = 100
    """Worlds whose choices are audited at a time late in the training, at least 0; 0 for no audits."""
    plugins: tuple[str, ...] = ()
    """Modules that are imported before names are resolved."""
    branch_from: Path | None = None
    """Folder of the run that it branches off; ``None`` to begin from nothing."""
    sources: dict[str, str] = field(default_factory=dict)
    """What the numbers depend on besides all this: the ``code``, and by their SHA-256 the plugins and ``files``."""
    by_seed: tuple[str, ...] = ()
    """Names of the ``files`` that differ from seed to seed."""

    def __post_init__(self) -> None:
        check_at_least("audit_worlds", self.audit_worlds, 0)
        if not self.goal_periods or len(set(self.goal_periods)) < len(self.goal_periods):
            raise ValueError(f"goal_periods must be one or more different numbers, got {self.goal_periods}.")
        for period in self.goal_periods:
            replace(self.config, env=self.config.env.for_evaluation().with_goal_period(period))  # long enough for it?

    @cached_property
    def digest(self) -> str:
        """First 12 hexadecimal digits of the SHA-256 of everything that the numbers depend on."""
        return _digest(
            config=self._config(), selector=_spelled_out(self.config.goals), goal_periods=list(self.goal_periods),
            audit_worlds=self.audit_worlds, plugins=list(self.plugins), sources=self.sources,
        )  # fmt: skip

    @cached_property
    def setting(self) -> str:
        """The same for what the cells of one environment must share to be compared: all but selector and seed.

        Plug-ins count if the environment is from one; files that differ from seed to seed do not, see ``block``.
        """
        return _digest(**self._shared())

    def _shared(self) -> dict[str, Any]:
        """What ``setting`` is the hash of."""
        config = {name: value for name, value in self._config().items() if name not in ("method", "selector", "seed")}
        own = (*self.plugins, *self.by_seed)
        common = {name: value for name, value in self.sources.items() if name not in own}
        common |= self._made_by(self.config.env)
        return {"config": config, "goal_periods": list(self.goal_periods), "sources": common}

    @cached_property
    def block(self) -> str:
        """The same for the files that all cells of a seed have in common, and no other seed; empty without such files.

        Methods are compared within a block, since all of them began with the same files there.
        """
        own = {name: value for name, value in self.sources.items() if name in self.by_seed}
        return _digest(sources=own) if own else ""

    @cached_property
    def selector(self) -> str:
        """The same for what the cells of one method must share: what its name stands for, and whose code that is."""
        made_by = self._made_by(self.config.goals)
        return _digest(selector=_spelled_out(self.config.goals), **({"plugins": made_by} if made_by else {}))

    def _made_by(self, config: EnvConfig | SelectorConfig) -> dict[str, str]:
        """The hashes of the plug-ins, if a configuration belongs to one."""
        found = {name: self.sources[name] for name in self.plugins if name in self.sources}
        return {} if _is_own(config) else found

    @property
    def files(self) -> Files:
        """The files of its environment, the ``pool`` of its attackers, and the checkpoint that it branches off."""
        env, pool = self.config.env, self.config.eval.pool
        others = {"pool": pool, "branch_from": self.branch_from and self.branch_from / "checkpoint.pt"}

        def read(name: str) -> bytes:
            return env.read_file(name)[0]

        own: Files = {name: partial(read, name) for name in env.files}
        return {**own, **{name: path.read_bytes for name, path in others.items() if path}}

    def _config(self) -> dict:
        """The run's configuration; files are identified by their hashes, wherever they are."""
        fields = to_dict(self.config)
        for part, left_out in (("env", self.config.env.files), ("eval", ("pool",))):
            fields[part] = {name: value for name, value in fields[part].items() if name not in left_out}
        return fields

    @cached_property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.environment}-{self.config.label}-s{self.config.seed}-{self.digest[:8]}"

    def to_dict(self) -> dict:
        """As JSON types; see ``read_cell``."""
        return {"schema": SCHEMA} | to_dict(self)


def _named(config: SelectorConfig, known: tuple[str, ...]) -> dict[str, SelectorConfig]:
    """The methods that a selector names, as Schedule and Mix do, except those that are ``known``."""
    found, hints = {}, typing.get_type_hints(type(config))
    for value in [value for name, value in to_dict(config).items() if hints.get(name) is str and value not in known]:
        with contextlib.suppress(ValueError):  # it names no method
            found[value] = method(value)
    return found


def _spelled_out(config: SelectorConfig, known: tuple[str, ...] = ()) -> dict:
    """A selector's configuration with those of the methods that it names."""
    named = {name: _spelled_out(own, (*known, name)) for name, own in _named(config, known).items()}
    return to_dict(config) | ({"methods": named} if named else {})


def _is_own(config: EnvConfig | SelectorConfig, known: tuple[str, ...] = ()) -> bool:
    """Whether a configuration, and those of the methods that it names, are of Deimos' own code, not a plug-in's."""
    named = _named(config, known) if isinstance(config, SelectorConfig) else {}
    own = type(config).__module__.partition(".")[0] == deimos.__name__
    return own and all(_is_own(each, (*known, name)) for name, each in named.items())


def _digest(**data: Any) -> str:
    text = json.dumps({"schema": SCHEMA} | data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def check_settings(there: Iterable[Cell], cells: Iterable[Cell]) -> None:
    """Raise ``RunError`` with what differs if a cell's setting is not that of others of its environment and code."""
    known = {cell.environment: cell for cell in there}
    for cell in cells:
        other = known.get(cell.environment, cell)
        if other.setting != cell.setting and other.sources.get("code") == cell.sources.get("code"):
            ours, theirs = ({**flat(x["config"]), **x["sources"], "goal_periods": x["goal_periods"]}
                            for x in (cell._shared(), other._shared()))  # fmt: skip
            differ = [f"{name} was {theirs.get(name)} and is {ours.get(name)}"
                      for name in {**theirs, **ours} if ours.get(name) != theirs.get(name)]  # fmt: skip
            if differ:  # an older version may have hashed something else
                raise RunError(
                    f"The cells of environment '{cell.environment}' were made with other settings and cannot be "
                    f"compared: {', '.join(differ[:5] + ['...'] * (len(differ) > 5))}. Put them back, or begin again."
                )


def read_cell(path: Path) -> Cell:
    """Read a ``cell.json``; raises ``RunError`` if it is broken or of another version."""
    data = RunFolder(path.parent).read_json(path.name)
    try:
        if (found := data.pop("schema")) != SCHEMA:
            way = "; deimos study report and merge still read its tables" if found == 1 else ""
            raise ValueError(f"its schema is {found}, not {SCHEMA}{way}")
        import_plugins(data["plugins"])
        return from_dict(Cell, data, stored=True)
    except (AttributeError, KeyError, RunError, TypeError, ValueError) as error:
        raise RunError(f"{path} does not describe a cell ({error}).") from error


def read(path: Path) -> dict:
    """Read the description of a study from a TOML file.

    Its keys:

    * ``seeds`` (see ``parse_seeds``) and ``methods`` (names);
    * ``train``: fields of ``TrainConfig`` for all cells;
    * ``environment``: for each environment or variant its ``name``, ``env`` (``kind`` and fields) and, if they differ
      there, ``methods``, ``train``, ``audit_worlds`` and ``goal_periods``; its ``preset`` is one of
      ``deimos.run.presets``, which fills in what is not given of its environment and settings;
    * ``pools``: folder with a file NAME.pt for every environment, or those of an environment, which the attacker
      ``pooled`` attacks with (``deimos study pool`` makes it);
    * ``branch_from``: folder of a run that all cells branch off, or those of an environment (``deimos.run.branch``);
      what is not given is as it was there, and critics learn first;
    * ``{seed}`` in the name of a file or of a run stands for the number of the seed: so each seed may branch off its
      own run, and methods are compared in pairs, seed by seed;
    * ``factors`` and ``design``: see ``deimos.study.factors``;
    * ``audit_worlds``: see ``Cell``;
    * ``plugins``: names of modules that register selectors, attackers or environments;
    * ``attack``: further attackers for some seeds, see ``deimos.study.rounds``;
    * ``base``: another such file, relative to this one, which fills in every key that is not given.

    Raises ``RunError`` if it or its base cannot be read or is not TOML.
    """
    return _read(path, ())


def _read(path: Path, readers: tuple[Path, ...]) -> dict:
    if path.resolve() in readers:
        raise RunError(f"{path} is a base of itself.")
    try:
        data = tomllib.loads(read_bytes(path).decode("utf-8-sig"))  # some editors mark a file as UTF-8
    except RecursionError as error:
        raise RunError(f"{path} is not a study's TOML file (it is nested too deep).") from error
    except (OSError, ValueError) as error:
        raise RunError(f"{path} is not a study's TOML file ({first_line(error)}).") from error
    if "base" not in data:
        return data
    base = path.parent / check_kind(f"{path}: base", data["base"], str)
    return _read(base, (*readers, path.resolve())) | data


def expand(
    description: dict, *, seeds: list[int] | str | None = None, methods: Sequence[str] | None = None,
    environments: Sequence[str] | None = None, train: dict | None = None,
) -> list[Cell]:  # fmt: skip
    """All cells of a study, seed by seed, so that a study cut short has the same seeds of every method.

    Args:
        description: See ``read``.
        seeds: See ``parse_seeds``; in place of the description's, like ``methods``, in every environment.
        methods: Names.
        environments: Names of those to take, with all points of a design or with one (``directional.3``); ``None`` for
            all.
        train: Fields of ``TrainConfig`` that override its own.

    Raises:
        RunError: If something is unknown, missing, repeated or out of range.
    """
    check_table("A study", description, _KEYS, {"seeds"})
    tables = description.get("environment", [])
    if not tables:
        raise RunError("A study must have an [[environment]].")
    for table in tables:
        check_table("An [[environment]]", table, _ENVIRONMENT_KEYS)
    names = [table.get("name", "") for table in tables]
    _check_unique("environment", names)
    numbers = parse_seeds(description.get("seeds", 10) if seeds is None else seeds)
    import_plugins(description.get("plugins", ()))
    said: dict | None = None
    cells: list[Cell] = []
    try:
        for seed in numbers:
            own = _with_seed(description, seed)
            if own != said:  # most studies say the same for every seed
                said, grid = own, _grid(description, own, environments, methods, train or {})
            cells += [replace(cell, config=replace(cell.config, seed=seed)) for cell in grid]
    except (AttributeError, RecursionError, TypeError, ValueError) as error:  # of from_dict and the configurations
        raise RunError(one_line(error)) from error
    return cells


def _with_seed(value: Any, seed: int) -> Any:
    """A description with the number of a seed in place of ``{seed}`` in its texts."""
    match value:
        case str():
            return value.replace(_SEED, str(seed))
        case dict():
            return {name: _with_seed(each, seed) for name, each in value.items()}
        case list():
            return [_with_seed(each, seed) for each in value]
    return value


def _grid(
    pattern: dict, study: dict, wanted: Sequence[str] | None, methods: Sequence[str] | None, train: dict
) -> list[Cell]:
    """The cells of one seed, without its number.

    Args:
        pattern: The description as the file has it.
        study: The same with the number of the seed in its texts.
        wanted: Names of environments or of their points; ``None`` for all.
        methods: See ``expand``.
        train: See ``expand``.
    """
    points, made_by = factors.expand(study.get("factors", {}), study.get("design", {})), {"code": code().name}
    places = [factors.ending(index, len(points)) for index in range(len(points))]
    names = [table.get("name", "") for table in study["environment"]]
    _check_known(wanted or (), names, places)
    grid = [
        replace(cell, by_seed=_by_seed(raw, pattern))
        for name, raw, table in zip(names, pattern["environment"], study["environment"], strict=True)
        for place, point in zip(places, points, strict=True)
        if wanted is None or {name, name + place} & {*wanted}
        for cell in _environment(table, study, methods, train, point, place)
    ]
    return [replace(cell, sources=made_by | hashes(cell.plugins, cell.files)) for cell in grid]


def _by_seed(table: dict, study: dict) -> tuple[str, ...]:
    """Names of the files of an environment's cells that differ from seed to seed."""
    train = merged(study.get("train", {}), table.get("train", {}))
    origin, pools = (table.get(name, study.get(name)) for name in ("branch_from", "pools"))
    pool = train.get("eval", {}).get("pool", pools)
    texts = {**table.get("env", {}), "pool": pool, "branch_from": origin}
    return tuple(name for name, text in texts.items() if _SEED in str(text))


def _check_known(wanted: Sequence[str], names: Sequence[str], places: Sequence[str]) -> None:
    """Raise ``RunError`` for a wanted environment that is neither one of these names nor a point of one."""
    points = [name + place for name in names for place in places if place]
    if unknown := [name for name in wanted if name not in {*names, *points}]:
        ends = f", and their points {points[0]} to {points[-1]}" if points else ""
        raise RunError(f"This study has no environment {', '.join(unknown)}; it has: {', '.join(names)}{ends}.")


def _environment(
    table: dict, study: dict, methods: Sequence[str] | None, train: dict, point: factors.Point, place: str
) -> list[Cell]:
    """A cell, without its seed, for each method of an environment; arguments as those of ``expand``."""
    name = table.get("name", "")
    if not name.replace("_", "").replace(".", "").isalnum():
        raise RunError(f"An [[environment]] must have a name of letters, digits, '.' and '_', got {shown(name)}.")
    shared, own = study.get("train", {}), table.get("train", {})
    tried = {key: value for key, value in point.fields.items() if key != factors.TIMES}
    times = check_kind("[factors] times", point.fields.get(factors.TIMES, {}), dict)
    if taken := sorted((set(shared) | set(own)) & _GRID | (set(tried) | set(times)) & (_GRID - {"env"})):
        raise RunError(f"{', '.join(taken)} cannot be in 'train' or be a factor: the grid of the study sets it.")
    if idle := sorted(set(train) & set(tried)):
        raise RunError(f"{', '.join(idle)} cannot override a factor of the study; change its levels in the file.")
    methods = list(table.get("methods", study.get("methods")) or [] if methods is None else methods)
    if not methods:
        raise RunError(f"Environment '{name}' has no methods.")
    _check_unique("method", methods)
    origin = table.get("branch_from", study.get("branch_from"))
    stored = None if origin is None else training.read_config(RunFolder.open(Path(origin)))
    try:
        ready = _training_preset(table) if stored is None else _branch(table, stored)
        varied = check_kind("[factors] env", tried.get("env", {}), dict)
        env = from_dict(EnvConfig, reduce(merged, (ready.pop("env", {}), table.get("env", {}), varied)))
        env = multiplied(env, check_kind("[factors] times.env", times.get("env", {}), dict))
    except ValueError as error:
        raise RunError(f"Environment '{name}': {error}") from error
    pools = table.get("pools", study.get("pools"))
    pool = {} if pools is None else {"eval": {"pool": str(Path(pools, f"{name}{place}.pt"))}}
    fields = reduce(merged, (ready, {"threads": 1}, pool, shared, own, train, tried, {"env": to_dict(env)}))
    others = {key: value for key, value in times.items() if key != "env"}
    configs = [multiplied(from_dict(TrainConfig, fields | {"method": each}), others) for each in methods]
    if stored is not None:
        try:
            for config in configs:
                check_branch(config, stored)
        except ValueError as error:
            raise RunError(f"Environment '{name}' cannot branch off {origin}: {error}") from error
    plugins = tuple(study.get("plugins", ()))
    worlds = table.get("audit_worlds", study.get("audit_worlds", Cell.audit_worlds))
    return [
        Cell(
            environment=name + place, config=config, goal_periods=tuple(table.get("goal_periods") or [env.goal_period]),
            base_environment=name, levels=point.levels, audit_worlds=worlds, plugins=plugins,
            branch_from=None if origin is None else Path(origin),
        )
        for config in configs
    ]  # fmt: skip


def _training_preset(table: dict) -> dict:
    """The fields of ``TrainConfig`` in the preset of an environment's table, except the grid's and the machine's."""
    if "preset" not in table:
        return {}
    name = table["preset"]
    kind = table.get("env", {}).get("kind", presets.environment(name))
    if kind != presets.environment(name):
        raise ValueError(f"preset '{name}' is for {presets.environment(name)}, not for {kind}.")
    return _settings(presets.preset(name))


def _branch(table: dict, origin: TrainConfig) -> dict:
    """The same for the run that an environment's cells branch off."""
    if "preset" in table:
        raise ValueError("preset and branch_from cannot be combined; a branch has the settings of its run.")
    return _settings(branch_config(origin))


def _settings(config: TrainConfig) -> dict:
    """The fields of a training, except the grid's and the machine's."""
    return {
        key: value for key, value in to_dict(config).items() if key == "env" or key not in _GRID | {"threads", "device"}
    }


def parse_seeds(given: Any) -> list[int]:
    """Seeds from a number of them (10, or the text "10"), a range ("10-19") or a list ("0,3,5", or one of numbers).

    Raises ``RunError`` for anything else, and if a seed is given twice.
    """
    spans = []
    if type(given) is int or (isinstance(given, str) and re.fullmatch(r"[1-9]\d*", given)):
        spans = [range(int(given))]
    elif isinstance(given, str | list):
        for part in given.split(",") if isinstance(given, str) else map(str, given):
            found = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
            spans.append(range(int(found[1]), int(found[2] or found[1]) + 1) if found else range(0))
    if not spans or not all(spans):
        example = "a number of seeds, a range that rises like 10-19 or a list like 0,3,5"
        raise RunError(f"seeds must be {example}, got {shown(given)}.")
    if any(span.stop - span.start > MOST_SEEDS for span in spans):
        raise RunError(f"seeds must be at most {MOST_SEEDS} in number, got {shown(given)}.")
    seeds = [seed for span in spans for seed in span]
    _check_unique("seed", seeds)
    return seeds


def _check_unique(what: str, values: Sequence[Any]) -> None:
    if doubled := sorted(value for value, count in Counter(values).items() if count > 1):
        raise RunError(f"Every {what} must be given once; repeated: {', '.join(map(str, doubled))}.")
