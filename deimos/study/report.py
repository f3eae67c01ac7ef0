"""The report of a study as HTML and as Markdown: what was run, tables, figures and limits.

``write`` puts the sections of ``page`` together; a caller with more to say gives a ``page`` of its own, made of
these sections and others.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import sem

from deimos.study import figures, stats
from deimos.study.data import Data, Where
from deimos.study.document import Block, Picture, to_html, to_markdown
from deimos.study.figures import Figures, Style
from deimos.study.stats import Array

Pictures = Mapping[str, Sequence[Picture]]
"""The figures of every environment."""

FIGURES = "figures"
COVERAGE = (  # python -m reproduction coverage, its defaults
    "The intervals of IQMs and medians are percentile bootstraps: they cover 93 to 94 % at n = 10, on normal and on "
    "lognormal data. Means have bootstrap-t intervals (94 % and 91 %); the percentile bootstrap would cover 90 % and "
    "81 %, BCa 90 % and 83 %; of few seeds, or many equal values, a mean has none. Intervals of ratios of spread cover "
    "more than 99 %: they are too wide, they only "
    "describe, and no difference is called on them."
)
_median = partial(np.median, axis=-1)


def page(data: Data, pictures: Pictures) -> list[Block]:
    """The sections that every study has."""
    return [
        "# A study of goal selection", *what_was_run(data), *environments(data, pictures),
        *over_all(data), *speed(data), "## Limits", "\n".join(f"* {text}" for text in limits(data)),
    ]  # fmt: skip


def write(
    folder: Path,
    out: Path,
    style: Style | None = None,
    page: Callable[[Data, Pictures], list[Block]] = page,
    draw: Callable[[Data, str], Figures] = figures.of_environment,
) -> Path:
    """Write ``report.html``, ``report.md`` and ``figures/``; returns the path of the HTML page.

    Args:
        folder: A study's folder, or one of exported tables.
        out: Where to write; made if it is not there.
        style: How methods are ordered and drawn.
        page: Makes the page.
        draw: Draws the figures of an environment.

    Raises:
        RunError: If there are no results, or they cannot be read.
    """
    data = Data.read(folder, style)
    (out / FIGURES).mkdir(parents=True, exist_ok=True)
    pictures = {name: figures.write(draw(data, name), out / FIGURES) for name in data.environments}
    blocks = page(data, pictures)
    (out / "report.md").write_text(to_markdown(blocks, FIGURES))
    (out / "report.html").write_text(to_html(blocks, out / FIGURES))
    return out / "report.html"


def what_was_run(data: Data) -> list[Block]:
    """Environments, methods, seeds, sizes, weak adversaries and versions."""
    rows = []
    for environment in data.environments:
        methods, own = data.methods(environment), [row for row in data.rows if row["environment"] == environment]
        counts = Counter(len({row["seed"] for row in own if row["method"] == name}) for name in methods)
        rows.append({
            "environment": environment, "methods": ", ".join(methods),
            "runs": ", ".join(f"{n} seeds x {k} methods" for n, k in sorted(counts.items())),
            "worlds": _values(own, "num_envs"), "parallel steps": _values(own, "env_steps"),
            "T in training": _values(own, "trained_period"), "T evaluated": _values(own, "goal_period"),
            "evaluation: worlds x steps": f"{_values(own, 'worlds')} x {_values(own, 'steps')}",
            "setting": _values(own, "setting"),
        })  # fmt: skip
    versions = sorted({f"{row['device']}, {row['versions']}" for row in data.rows})
    weak = [_weak_adversaries(data)] if data.weak else []  # of results of 0.1.0
    return ["## What was run", rows, *weak, "Run on " + "; ".join(versions) + "."]


def _values(rows: Sequence[dict], column: str) -> str:
    return ", ".join(map(str, sorted({row[column] for row in rows})))


def _weak_adversaries(data: Data) -> str:
    made = sum(row["goals"] == "adversary" for row in data.rows)
    weak = Counter((row["environment"], row["method"]) for row in data.weak)
    text = f"{len(data.weak)} of {made} evaluations by the Adversary are marked weak and left out"
    found = {place: [f"{name} {weak[place, name]}" for name in data.methods(place) if weak[place, name]]
             for place in data.environments}  # fmt: skip
    parts = "; ".join(f"{place}: {', '.join(names)}" for place, names in found.items() if names)
    return (
        f"{text} ({parts}). A policy that hardly ever crashes gives its Adversary nothing to learn from, so what is "
        "left of a method with many of them are its least safe policies."
    )


def environments(data: Data, pictures: Pictures) -> list[Block]:
    """Of every environment a table for each evaluation, and its figures."""
    blocks: list[Block] = []
    for environment in data.environments:
        blocks.append(f"## {environment}")
        for period in data.periods(environment):
            for goals in data.goals:
                blocks += _table(data, Where(environment, goals, period))
        blocks += pictures[environment]
    return blocks


def _table(data: Data, where: Where) -> list[Block]:
    samples = {name: data.sample(where, name, "crashes") for name in data.methods(where.environment)}
    base, parts = samples.get(data.style.reference, np.array([])), data.parts(where)
    rows = []
    for name, crashes in samples.items():
        if len(crashes) < 2:
            continue
        reward, score, rate = (data.sample(where, name, metric) for metric in ("reward", "score", "crash_rate"))
        mean = stats.bootstrap_t(crashes)
        more = "-"
        if name != data.style.reference and len(base) >= 2:
            more = f"{stats.probability_of_improvement([(crashes, base)]):.2f}"
        rows.append({
            "method": name, "seeds": str(len(crashes)),
            "crashes: median": _boot(crashes, _median), "IQM": _boot(crashes, stats.iqm),
            # Where most policies do not crash, the bootstrap-t is wide on both sides; counts are not below 0.
            "mean": f"{replace(mean, low=max(mean.low, 0.0)):.3g}" if math.isfinite(mean.high)
            else f"{mean.estimate:.3g} (no interval)",
            "worst 20 % (CVaR)": _boot(crashes, stats.cvar), "IQR": _boot(crashes, stats.iqr),
            "10 % to 90 %": " to ".join(f"{x:.3g}" for x in np.quantile(crashes, [0.1, 0.9])),
            "goals that ended in a crash: median": f"{100 * np.median(rate):.3g} %" if len(rate) else "-",
            "reward: IQM": _boot(reward, stats.iqm, ".4f"), "score: IQM": _boot(score, stats.iqm, ".3f"),
            f"P(more crashes than {data.style.reference})": more,
            **{f"{what}: IQM": _boot(data.sample(where, name, part), stats.iqm) for part, what in parts.items()},
        })  # fmt: skip
    return [f"### {where}", rows] if rows else []


def _boot(x: Array, statistic: stats.Statistic, form: str = ".3g") -> str:
    return format(stats.bootstrap([x], statistic), form) if len(x) >= 2 else "-"


def over_all(data: Data) -> list[Block]:
    """Safety over all environments and T, by the stratified bootstrap, for the methods that were run in all."""
    blocks: list[Block] = []
    for goals in ("naive", "adversary"):
        places = [place for environment in data.environments for place in data.places(environment, goals)]
        found = {name: [data.sample(place, name, "log_crashes") for place in places]
                 for name in data.methods(data.environments[0])}  # fmt: skip
        shared = {name: samples for name, samples in found.items() if min(map(len, samples)) >= 2}
        if len(places) < 2 or len(shared) < 2:
            continue
        worst = [max(1e-9, *(x.max() for x in samples)) for samples in zip(*shared.values(), strict=True)]
        rows = []
        for name, samples in shared.items():
            safety = [1 - x / most for x, most in zip(samples, worst, strict=True)]
            mean = stats.bootstrap(safety, lambda *x: stats.iqm(np.concatenate(x, axis=-1)))
            rows.append({"method": name, "safety: IQM [95 %]": f"{mean:.3f}"})
        blocks += [f"### Against the {goals.capitalize()}, {len(places)} evaluations together", rows]
    text = "Safety is 1 - log(1 + crashes) / log(1 + most crashes of any policy of that evaluation)."
    return ["## Over all environments", text, *blocks] if blocks else []


def speed(data: Data) -> list[Block]:
    """Frames per second; the rows of its table, the last of its blocks, can be added to."""
    rows = []
    for environment in data.environments:
        place = data.places(environment, "naive")[0]
        fps = {name: data.sample(place, name, "fps") for name in data.methods(environment)}
        base = fps.get(data.style.reference, np.array([]))
        for name, values in fps.items():
            if len(values) >= 2:
                rows.append({
                    "environment": environment, "method": name,
                    "FPS": f"{values.mean():.0f} ± {sem(values):.0f}",
                    f"ratio to {data.style.reference}": f"{values.mean() / base.mean():.2f}" if len(base) else "-",
                })  # fmt: skip
    text = (
        "Frames per second over all worlds during training, learning included: mean over seeds ± standard error. Only "
        "ratios are comparable, and only among runs of one kind of machine."
    )
    return ["## Speed", text, rows] if rows else []


def limits(data: Data) -> list[str]:
    """What a reader must bear in mind, one text each."""
    places = [place for environment in data.environments for place in data.places(environment, "naive")]
    smallest = min(
        len(data.sample(place, name, "crashes")) for place in places for name in data.methods(place.environment)
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
