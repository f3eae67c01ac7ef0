"""The report of a study as HTML and as Markdown: what was run, tables, figures and limits.

``write`` puts the sections of ``page`` together; a caller with more to say gives a ``page`` of its own, made of
these sections and others.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deimos.run.folder import RunError
from deimos.study import figures, stats
from deimos.study.data import Data, Where
from deimos.study.document import Block, Picture, Table, to_html, to_markdown
from deimos.study.figures import Figures, Style
from deimos.study.stats import Array, Interval

FIGURES = "figures"
COVERAGE = (  # python -m reproduction coverage, its defaults
    "The intervals of IQMs and medians are percentile bootstraps: they cover 93 to 94 % at n = 10, on normal and on "
    "lognormal data. Means have bootstrap-t intervals (94 % and 91 %); the percentile bootstrap would cover 90 % and "
    "81 %, BCa 90 % and 83 %. Intervals of ratios of spread cover more than 99 %: they are too wide, they only "
    "describe, and no difference is called on them. `python -m reproduction coverage` measures all of this again."
)


def page(data: Data, captions: Mapping[str, str]) -> list[Block]:
    """The sections that every study has; ``captions`` are those of its figures, by their names."""
    return [
        "# A study of goal selection", *what_was_run(data), *environments(data, captions),
        *over_all(data), *speed(data), "## Limits", "\n".join(f"* {text}" for text in limits(data)),
    ]  # fmt: skip


def write(
    folder: Path,
    out: Path,
    style: Style | None = None,
    page: Callable[[Data, Mapping[str, str]], list[Block]] = page,
    draw: Callable[[Data, str], Figures] = figures.of_environment,
) -> Path:
    """Write ``report.html``, ``report.md`` and ``figures/``.

    Args:
        folder: A study's folder, or one of exported tables.
        out: Where to write; made if it is not there.
        style: How methods are ordered and drawn.
        page: Makes the page.
        draw: Names the figures of an environment.

    Returns:
        Path of the HTML page.

    Raises:
        RunError: If there are no results, or something cannot be read or written.
    """
    data = Data.read(folder, style)
    try:
        (out / FIGURES).mkdir(parents=True, exist_ok=True)
        captions: dict[str, str] = {}
        for environment in data.environments:
            captions |= figures.draw(draw(data, environment), out / FIGURES)
        blocks = page(data, captions)
        (out / "report.md").write_text(to_markdown(blocks, FIGURES))
        (out / "report.html").write_text(to_html(blocks, out / FIGURES))
    except OSError as error:
        raise RunError(f"The report in {out} could not be written ({error.strerror}).") from error
    return out / "report.html"


def what_was_run(data: Data) -> list[Block]:
    """Environments, methods, seeds, sizes, weak adversaries and versions."""
    rows = []
    for environment in data.environments:
        own = [row for row in data.rows if row["environment"] == environment]
        seeds = {name: {row["seed"] for row in own if row["method"] == name} for name in data.methods(environment)}
        counts = Counter(len(found) for found in seeds.values())
        rows.append([
            environment, ", ".join(seeds), ", ".join(f"{n} seeds x {k} methods" for n, k in sorted(counts.items())),
            _values(own, "num_envs"), _values(own, "env_steps"), _values(own, "trained_period"),
            _values(own, "goal_period"), f"{_values(own, 'worlds')} x {_values(own, 'steps')}", _values(own, "setting"),
        ])  # fmt: skip
    header = ["environment", "methods", "runs", "worlds", "parallel steps", "T in training", "T evaluated",
              "evaluation: worlds x steps", "setting"]  # fmt: skip
    versions = sorted({f"{row['device']}, {row['versions']}" for row in data.rows})
    adversaries = [row for row in data.rows if row["goals"] == "adversary"]
    weak = f"{len(data.weak)} of {len(adversaries)} evaluations by the Adversary are marked weak and left out"
    if data.weak:
        counted = Counter((row["environment"], row["method"]) for row in data.weak)
        parts = [f"{place}: " + ", ".join(f"{name} {counted[place, name]}" for name in data.methods(place)
                                          if counted[place, name]) for place in data.environments
                 if any(where == place for where, _ in counted)]  # fmt: skip
        weak += (
            f" ({'; '.join(parts)}). A policy that hardly ever crashes gives its Adversary nothing to learn from, so "
            "what is left of a method with many of them are its least safe policies"
        )
    weak += "."
    return [
        "## What was run",
        Table(header, rows),
        weak,
        "By: " + "; ".join(versions) + ".",
    ]


def _values(rows: Sequence[dict], column: str) -> str:
    return ", ".join(map(str, sorted({row[column] for row in rows})))


def environments(data: Data, captions: Mapping[str, str]) -> list[Block]:
    """Of every environment a table for each evaluation, and its figures."""
    blocks: list[Block] = []
    for environment in data.environments:
        blocks.append(f"## {environment}")
        for period in data.periods(environment):
            for goals in ("naive", "adversary", "oracle"):
                blocks += _table(data, Where(environment, goals, period))
        names = [name for name in captions if f"-{environment}-" in f"{name}-"]
        blocks += [Picture(name, captions[name]) for name in names]
    return blocks


def _table(data: Data, where: Where) -> list[Block]:
    methods = [name for name in data.methods(where.environment) if len(data.sample(where, name, "crashes")) >= 2]
    if not methods:
        return []
    reference = data.style.reference
    base, parts = data.sample(where, reference, "crashes"), data.parts(where)
    rows = []
    for name in methods:
        crashes, reward = (data.sample(where, name, metric) for metric in ("crashes", "reward"))
        score, rate = data.sample(where, name, "score"), data.sample(where, name, "crash_rate")
        more = "-"
        if name != reference and len(base) >= 2:
            pair = [(crashes, base)]
            more = interval(stats.probability_of_improvement(pair), ".2f")
        rows.append([
            name, str(len(crashes)),
            _boot(crashes, _median), _boot(crashes, stats.iqm),
            interval(_of_counts(stats.bootstrap_t(crashes))),
            _boot(crashes, stats.cvar), _boot(crashes, stats.iqr),
            " to ".join(f"{x:.3g}" for x in np.quantile(crashes, [0.1, 0.9])),
            f"{np.median(rate):.4f}" if len(rate) else "-", _boot(reward, stats.iqm, ".4f"),
            _boot(score, stats.iqm, ".3f"), more,
            *[_boot(data.sample(where, name, part), stats.iqm, ".3g") for part in parts],
        ])  # fmt: skip
    header = ["method", "seeds", "crashes: median", "IQM", "mean", "worst 20 % (CVaR)", "IQR", "10 % to 90 %",
              "crashes per interaction", "reward: IQM", "score: IQM", f"P(more crashes than {reference})",
              *[_part_name(part) for part in parts]]  # fmt: skip
    return [f"### {where}", Table(header, rows)]


def _part_name(part: str) -> str:
    column, _, name = part.partition(":")
    return f"tracking of goal group {name}: IQM" if column == "tracking" else f"{name}, median over goals: IQM"


def _median(x: Array) -> Array:
    return np.median(x, axis=-1)


def _boot(x: Array, statistic: stats.Statistic, form: str = ".3g") -> str:
    if len(x) < 2:
        return "-"
    return interval(stats.bootstrap([x], statistic), form)


def _of_counts(interval: Interval) -> Interval:
    """Where most policies do not crash, the bootstrap-t is wide on both sides; counts are not below 0."""
    return replace(interval, low=max(interval.low, 0.0))


def interval(found: Interval, form: str = ".3g") -> str:
    """An interval as text, its numbers in a format; the estimate alone where it has no ends."""
    if math.isnan(found.low):
        return format(found.estimate, form)
    return f"{found.estimate:{form}} [{found.low:{form}}, {found.high:{form}}]"


def over_all(data: Data) -> list[Block]:
    """Safety over all environments and T, by the stratified bootstrap, for the methods that were run in all."""
    blocks: list[Block] = []
    for goals in ("naive", "adversary"):
        places = [place for environment in data.environments for place in data.places(environment, goals)]
        shared = [name for name in data.methods(data.environments[0])
                  if all(len(data.sample(place, name, "crashes")) >= 2 for place in places)]  # fmt: skip
        if len(places) < 2 or len(shared) < 2:
            continue
        worst = [max(data.sample(place, name, "log_crashes").max() for name in shared) for place in places]
        rows = []
        for name in shared:
            safety = [1 - data.sample(place, name, "log_crashes") / max(most, 1e-9)
                      for place, most in zip(places, worst, strict=True)]  # fmt: skip
            found = stats.bootstrap(safety, lambda *x: stats.iqm(np.concatenate(x, axis=-1)))
            rows.append([name, interval(found, ".3f")])
        blocks += [f"### Against the {goals.capitalize()}, {len(places)} evaluations together",
                   Table(["method", "safety: IQM [95 %]"], rows)]  # fmt: skip
    if not blocks:
        return []
    text = "Safety is 1 - log(1 + crashes) / log(1 + most crashes of any policy of that evaluation)."
    return ["## Over all environments", text, *blocks]


def speed(data: Data, published: Mapping[str, Mapping[str, float]] | None = None) -> list[Block]:
    """Frames per second.

    Args:
        data: The results.
        published: Ratios to the reference method that somebody else measured, by environment and method.
    """
    rows = []
    for environment in data.environments:
        place = data.places(environment, "naive")[:1]
        if not place:
            continue
        fps = {name: data.sample(place[0], name, "fps") for name in data.methods(environment)}
        base = fps.get(data.style.reference, np.array([]))
        for name, values in fps.items():
            if len(values) < 2:
                continue
            error = values.std(ddof=1) / math.sqrt(len(values))
            ratio = f"{values.mean() / base.mean():.2f}" if len(base) else "-"
            theirs = (published or {}).get(environment, {}).get(name)
            more = [] if published is None else ["-" if theirs is None else f"{theirs:.2f}"]
            rows.append([environment, name, f"{values.mean():.0f} ± {error:.0f}", ratio, *more])
    text = (
        "Frames per second over all worlds during training, learning included: mean over seeds ± standard error. Only "
        "ratios are comparable, and only among runs of one kind of machine."
    )
    header = ["environment", "method", "FPS", f"ratio to {data.style.reference}"]
    header += [] if published is None else ["published ratio"]
    return ["## Speed", text, Table(header, rows)] if rows else []


def limits(data: Data) -> list[str]:
    """What a reader must bear in mind, one text each."""
    smallest = min(
        len(data.sample(place, name, "crashes"))
        for environment in data.environments
        for place in data.places(environment, "naive")
        for name in data.methods(environment)
    )
    p10, p30 = (stats.detectable_probability(n, n) for n in (10, 30))
    return [
        "The unit is one trained policy. Its worlds and episodes are no replicates.",
        f"The smallest population here has {smallest} policies. With a power of 80 %, a rank-sum test finds P(x > y) = "
        f"{p10:.2f} with 10 a side and {p30:.2f} with 30.",
        COVERAGE,
        "CVaR over seeds is too low in small populations.",
        "The mean reward per transition pays for crashing where a crash puts the robot back to safety; the score does "
        "not.",
        "Frames per second were measured while the study's workers shared the machine.",
    ]
