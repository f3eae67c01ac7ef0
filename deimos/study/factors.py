"""Studies over factors: which settings of the training a design tries.

A factor is a field of the training with levels, such as ``env.max_force``, or a name whose levels are tables of such
fields, each with a ``name``. Fields under ``times``, such as ``times.env.goal_range``, are multiplied by their levels:
what they are otherwise may differ between environments, and with other factors. A sweep is a design with one factor.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from deimos.checks import RunError, check_at_least, check_choice
from deimos.study.tables import check_keys, check_kind

KINDS = ("full", "fractional", "sobol")
MOST_POINTS = 10_000  # of a design
TIMES = "times"
"""Prefix of the name of a factor that multiplies a field."""


@dataclass(frozen=True)
class Point:
    """A setting that a design tries."""

    levels: dict[str, Any]
    """Level of every factor, by its name, in JSON types; a level that is a table is its name."""
    fields: dict[str, Any]
    """What they change in the training; under ``TIMES``, what its numbers are multiplied by."""


def expand(factors: Mapping[str, Any], design: Mapping[str, Any]) -> list[Point]:
    """The points of a design, in order.

    Args:
        factors: By name, a list of levels, or for a Sobol sample also a range ``{low, high}``, logarithmic with
            ``log = true``, whole if both ends are.
        design: ``kind``: ``full`` (the default), all combinations; ``fractional``, of factors with two levels, where
            ``generators`` gives for each factor that is not a base factor those that it is the product of;
            ``sobol``, a sample of ``points`` with a ``seed`` (0).

    Raises:
        RunError: If the description is wrong.
    """
    flat = _flat(factors)
    if not flat:
        if design:
            raise RunError("A [design] needs [factors], got none.")
        return [Point({}, {})]
    _check_apart(flat)
    kind = design.get("kind", "full")
    known = {"full": set(), "fractional": {"generators"}, "sobol": {"points", "seed"}}
    try:
        check_choice("kind", kind, KINDS)
        check_keys(f"A {kind} [design]", design, {"kind"} | known[kind])
        if kind == "sobol":
            chosen = _sobol(flat, design)
        else:
            ranges = [name for name, levels in flat.items() if not isinstance(levels, list)]
            if ranges:
                raise ValueError(f"{', '.join(ranges)} must be a list of levels; only a sobol design takes a range.")
            chosen = _full(flat) if kind == "full" else _fractional(flat, design)
    except (TypeError, ValueError) as error:
        raise RunError(f"[design]: {error}") from error
    return [_point(levels) for levels in chosen]


def aliases(generators: Mapping[str, Sequence[str]], factors: Sequence[str]) -> tuple[int, list[str]]:
    """The effects that a fractional design cannot distinguish.

    Args:
        generators: For each generated factor, those that it is the product of.
        factors: Names of all.

    Returns:
        The resolution, the shortest word of the defining relation; and a line for every main effect and every
        interaction of two that is aliased with another of these.
    """
    words = [frozenset({name, *product}) for name, product in generators.items()]
    relation = {
        _product(part) for size in range(1, len(words) + 1) for part in itertools.combinations(words, size)
    }  # fmt: skip
    effects = [frozenset(part) for size in (1, 2) for part in itertools.combinations(factors, size)]
    lines = []
    for effect in effects:
        same = [other for other in effects if other != effect and effect ^ other in relation]
        if same and all(effects.index(effect) < effects.index(other) for other in same):
            lines.append(" = ".join(_spelled(one, factors) for one in [effect, *same]))
    return min((len(word) for word in relation), default=math.inf), lines  # type: ignore[return-value]


def describe(factors: Mapping[str, Any], design: Mapping[str, Any]) -> str:
    """A line on the design, and one for each set of effects that it cannot distinguish.

    For a fractional design these are main effects and interactions of two, for others main effects.
    """
    flat = _flat(factors)
    kind, points = design.get("kind", "full"), expand(factors, design)
    text = f"Design: {kind}, {len(points)} points of {len(flat)} factors ({', '.join(flat)})."
    if kind != "fractional":
        columns = {name: [str(point.levels[name]) for point in points] for name in flat}
        same = [pair for pair in itertools.combinations(flat, 2) if _same_split(*(columns[name] for name in pair))]
        return "\n".join([text, *(f"Aliased: {a} = {b}" for a, b in same)])
    resolution, lines = aliases(design["generators"], list(flat))
    return "\n".join([f"{text} Resolution {resolution}.", *(f"Aliased: {line}" for line in lines)])


def _same_split(first: Sequence[str], second: Sequence[str]) -> bool:
    """Whether two columns of levels split the points in the same way."""
    pairs = {*zip(first, second, strict=True)}
    return len(pairs) == len({*first}) == len({*second}) and 1 < len(pairs) < len(first)


def _flat(factors: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Factors by their full names: ``env.max_force`` is a table in TOML unless it is quoted."""
    found: dict[str, Any] = {}
    for name, levels in factors.items():
        if isinstance(levels, Mapping) and not {"low", "high"} & levels.keys():
            found |= _flat(levels, f"{prefix}{name}.")
            continue
        name = prefix + name
        if isinstance(levels, list) and levels:
            kinds = {isinstance(level, Mapping) for level in levels}
            if kinds == {True, False} or any(not isinstance(x.get("name"), str) for x in levels if kinds == {True}):
                raise RunError(f"[factors] {name}: levels must be values, or tables of fields each with a name.")
            if len({str(_label(level)) for level in levels}) < len(levels):
                raise RunError(f"[factors] {name}: every level must be given once, got {levels}.")
        elif isinstance(levels, Mapping):
            _check_range(name, levels)
        else:
            raise RunError(f"[factors] {name} must be a list of levels or a range, got {levels!r}.")
        found[name] = levels
    return found


def _check_apart(factors: Mapping[str, Any]) -> None:
    """Raise ``RunError`` if two factors set one field: it would not be at the level that the tables say."""
    made_by: dict[str, str] = {}
    for name, levels in factors.items():
        tables = [level for level in levels if isinstance(level, Mapping)] if isinstance(levels, list) else []
        own = {field for table in tables for field in _leaves(table) if field != "name"} if tables else {name}
        for field in sorted(own & made_by.keys()):
            raise RunError(f"[factors] {made_by[field]} and {name} both set {field}; only one of them can.")
        made_by |= dict.fromkeys(own, name)


def _leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Full names of the fields that a table sets."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def ending(index: int, count: int) -> str:
    """The ending of an environment's name at a point of a design of ``count`` points."""
    return f".{index:0{len(str(count - 1))}d}" if count > 1 else ""


def _check_range(name: str, found: Mapping[str, Any]) -> None:
    check_keys(f"[factors] {name}", found, {"low", "high", "log"})
    low, high = found.get("low"), found.get("high")
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
    check_kind(f"[factors] {name}: log", found.get("log", False), bool)
    if not numbers or not -math.inf < low < high < math.inf or (found.get("log") and low <= 0):  # type: ignore[operator]
        raise RunError(f"[factors] {name} must have low < high, finite, and positive if log = true, got {dict(found)}.")


def _full(factors: Mapping[str, list]) -> list[dict[str, Any]]:
    if math.prod(map(len, factors.values())) > MOST_POINTS:
        raise ValueError(f"a full design of these factors has more than {MOST_POINTS} points; take a sobol sample.")
    return [dict(zip(factors, levels, strict=True)) for levels in itertools.product(*factors.values())]


def _fractional(factors: Mapping[str, list], design: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All combinations of the base factors; the sign of each generated one is the product of its factors' signs."""
    generators = check_kind("generators", design.get("generators"), dict)
    if more := [name for name, levels in factors.items() if len(levels) != 2]:
        raise ValueError(f"a fractional design takes factors with two levels, unlike {', '.join(more)}.")
    base = [name for name in factors if name not in generators]
    for name, product in generators.items():
        if name not in factors or not isinstance(product, list) or len(product) < 2 or set(product) - set(base):
            raise ValueError(
                f"generators must name for a factor two or more of {', '.join(base)}, got {name} = {product}."
            )
    points = []
    for place in _full({name: [0, 1] for name in base}):
        # An even number of low levels makes the product of the signs -1 and 1 high.
        made = {name: 1 - sum(1 - place[one] for one in product) % 2 for name, product in generators.items()}
        points.append({name: levels[(place | made)[name]] for name, levels in factors.items()})
    return points


def _sobol(factors: Mapping[str, Any], design: Mapping[str, Any]) -> list[dict[str, Any]]:
    from scipy.stats import qmc

    points, seed = design.get("points"), design.get("seed", 0)
    check_at_least("points", points, 2)  # type: ignore[arg-type]
    check_at_least("seed", seed, 0)
    if points & (points - 1) or points > MOST_POINTS:  # type: ignore[operator]
        raise ValueError(f"points must be a power of 2 below {MOST_POINTS}, got {points}.")
    sample = qmc.Sobol(len(factors), rng=seed).random(points)
    return [{name: _at(levels, share) for (name, levels), share in zip(factors.items(), row, strict=True)}
            for row in sample.tolist()]  # fmt: skip


def _at(levels: Any, share: float) -> Any:
    """The level at a share in [0, 1) of a list or of a range."""
    if isinstance(levels, list):
        return levels[int(share * len(levels))]
    low, high = levels["low"], levels["high"]
    whole = isinstance(low, int) and isinstance(high, int)
    end = high + whole  # of what is rounded down
    value = low * (end / low) ** share if levels.get("log") else low + (end - low) * share
    return min(high, math.floor(value)) if whole else value


def _point(levels: Mapping[str, Any]) -> Point:
    fields: dict[str, Any] = {}
    for name, level in levels.items():
        if isinstance(level, Mapping):
            fields = merged(fields, {key: value for key, value in level.items() if key != "name"})
        else:
            value: Any = level
            for part in reversed(name.split(".")):
                value = {part: value}
            fields = merged(fields, value)
    return Point({name: _label(level) for name, level in levels.items()}, fields)


def _label(level: Any) -> Any:
    if isinstance(level, Mapping):
        return level["name"]
    return str(level) if isinstance(level, float) and math.isinf(level) else level  # JSON has no infinity


def _product(words: Sequence[frozenset[str]]) -> frozenset[str]:
    """The product of words, in which the square of a factor is 1."""
    product: frozenset[str] = frozenset()
    for word in words:
        product ^= word
    return product


def _spelled(effect: frozenset[str], factors: Sequence[str]) -> str:
    return " x ".join(name for name in factors if name in effect)


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with what ``over`` says, table by table."""
    both = dict(base)
    for key, value in over.items():
        inner = isinstance(value, Mapping) and isinstance(both.get(key), Mapping)
        both[key] = merged(both[key], value) if inner else value
    return both
