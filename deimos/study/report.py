"""The report of a study as HTML and as Markdown: outcomes, figures, what was run, and limits.

``write`` puts the sections of ``page`` together; a caller with more to report gives its own ``page``, made of
these sections and others.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import sem

from deimos.files import write_bytes
from deimos.study import figures, stats
from deimos.study.data import Data, Style, Where
from deimos.study.document import Block, to_html, to_markdown
from deimos.study.figures import Figures
from deimos.study.outcomes import (
    SAFE,
    Attacked,
    attacked,
    base_of,
    late_doses,
    of_environment,
    of_factors,
    settings_of,
)
from deimos.study.results import Row
from deimos.study.stats import Array

Pictures = Mapping[str, Sequence[Block]]
"""The figures of every environment and, under ``FACTORS``, those by level."""

FIGURES = "figures"
FACTORS = ""
MOST_OF_FEW = 5  # policies: the population's median is between their extremes in less than 95 % of studies
COVERAGE = (  # docs/lab/study.md; `python -m reproduction coverage` simulates it again
    "Intervals of shares of policies and of pairs are exact, but for those over all environments; all others are "
    "percentile bootstraps over policies, but for the means under Distributions. Those of IQMs and medians cover 93 to "
    "94 % at n = 10, of normal, lognormal and bimodal data alike; ratios of spreads 94, 90 and 90 %; those of means "
    "91, 81 and 80 %, so read the mean rates of skewed populations with care. The means under Distributions have "
    "bootstrap-t intervals (95, 91 and 95 %); of few seeds, or many equal values, a mean has none there. A bootstrap "
    "interval without width says that these policies agree, not that all would."
)
SAFE_FROM = (
    "In {count} attacks the attacker had met few crashes or none before it attacked ({parts}). A policy that hardly "
    "ever crashes gives an attacker nothing to learn from; it counts as the safe policy that it is."
)
UNINFORMED = (
    "In {count} attacks the attacker's goals were uniform although the policy may well crash ({parts}): it had met "
    "hardly a survival, or learns nothing and has no goals for this environment."
)
_median = partial(np.median, axis=-1)


def _mean(x: Array) -> Array:
    return np.mean(x, axis=-1)


def page(data: Data, pictures: Pictures) -> list[Block]:
    """The sections that every study has."""
    return [
        "# A study of goal selection", *environments(data, pictures), *over_all(data), *what_was_run(data),
        *speed(data), *distributions(data), "## Limits", "\n".join(f"* {text}" for text in limits(data)),
    ]  # fmt: skip


def write(
    folder: Path,
    out: Path,
    style: Style | None = None,
    page: Callable[[Data, Pictures], list[Block]] = page,
    draw: Callable[[Data, str], Figures] = of_environment,
) -> Path:
    """Write ``report.html``, ``report.md`` and ``figures/``; returns the path of the HTML page.

    Args:
        folder: A study's folder, or one of exported tables.
        out: Where to write; made if it is not there.
        style: How methods are ordered and drawn.
        page: Makes the page.
        draw: Draws the figures of an environment. A design's settings have none, but there are figures by level.

    Raises:
        RunError: If there are no results, or they cannot be read.
    """
    data = Data.read(folder, style)
    (out / FIGURES).mkdir(parents=True, exist_ok=True)
    single = [name for name, own in settings_of(data).items() if not own]
    with figures.print_size():
        drawn = {name: draw(data, name) for name in single} | {FACTORS: of_factors(data)}
        pictures = {name: figures.write(own, out / FIGURES) for name, own in drawn.items()}
        blocks = page(data, pictures)
    for name, text in (("report.md", to_markdown(blocks, FIGURES)), ("report.html", to_html(blocks, out / FIGURES))):
        write_bytes(out / name, text.encode())
    return out / "report.html"


def what_was_run(data: Data) -> list[Block]:
    """Environments, methods, seeds, sizes, attackers and versions."""
    rows = []
    for environment in data.environments:
        trained_in = data.trained_in(environment)
        methods, own = data.methods(environment), [row for row in data.rows if row["environment"] == environment]
        counts = Counter(len({row["seed"] for row in own if row["method"] == name}) for name in methods)
        policies = {(row["method"], row["seed"]): row["env_steps"] * row["num_envs"] for row in own}
        rows.append({
            "environment": environment, "methods": ", ".join(methods),
            "runs": ", ".join(
                f"{n} seed{'s' * (n > 1)} x {k} method{'s' * (k > 1)}" for n, k in sorted(counts.items())
            ),
            "worlds": _values(own, "num_envs"), "parallel steps": _values(own, "env_steps"),
            "transitions, all": f"{sum(policies.values()) / 1e6:.0f} M" if trained_in == environment
            else f"those of {trained_in}",
            "T in training": _values(own, "trained_period"), "T evaluated": _values(own, "goal_period"),
            "evaluation: worlds x steps": f"{_values(own, 'worlds')} x {_values(own, 'steps')}",
            "goals": _values(own, "goals"), "setting": _values(own, "setting"),
        })  # fmt: skip
    versions = sorted({f"{row['device']}, {row['versions']}" for row in data.rows})
    return [
        "## What was run", rows, *_lacking(data), *_uninformed(data), "Run on " + "; ".join(versions) + ".",
        "### Hyper-parameters", *hyper_parameters(data.settings),
    ]  # fmt: skip


def hyper_parameters(settings: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """Every field of the environments, of the learner and of the evaluation, except those that are not set.

    A selector's are those that its method's name stands for.

    Args:
        settings: Configurations by environment, as JSON types.
    """
    if not settings:
        return ["They are in the cells of the study, which are not beside these tables."]
    environments = {name: _flat(config) for name, config in settings.items()}
    names = dict.fromkeys(name for fields in environments.values() for name in fields)
    rows = [{"field": name} | {place: fields.get(name, "-") for place, fields in environments.items()}
            for name in names if name.partition(".")[0] not in ("method", "selector", "seed")]  # fmt: skip
    return [rows]


def _flat(fields: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        elif value is not None:
            found[prefix + name] = " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
    return found


def _values(rows: Sequence[dict], column: str) -> str:
    return ", ".join(map(str, sorted({row[column] for row in rows})))


def _lacking(data: Data) -> list[Block]:
    """Which cells have no results, so that those with results are not taken for all."""
    counts = Counter(name.rsplit("-", 2)[0] for name in data.lacking)  # without seed and hash
    if not counts:
        return []
    names = ", ".join(f"{name} {count}" for name, count in counts.items())
    return [f"Cells without results: {names}. They were given up or have not finished yet, and count nowhere."]


def _uninformed(data: Data) -> list[Block]:
    """How many attackers found nothing to learn from, and why; their policies count all the same."""
    blocks: list[Block] = []
    made = sum(row["goals"] != "naive" for row in data.rows)
    for is_safe, text in ((True, SAFE_FROM), (False, UNINFORMED)):
        found = [row for row in data.rows if (row["weak_adversary"] or row.get("uninformed")) and _safe(row) == is_safe]
        counts = Counter((row["environment"], row["method"]) for row in found)
        places = {place: [f"{name} {counts[place, name]}" for name in data.methods(place) if counts[place, name]]
                  for place in data.environments}  # fmt: skip
        parts = "; ".join(f"{place}: {', '.join(names)}" for place, names in places.items() if names)
        blocks += [text.format(count=f"{len(found)} of {made}", parts=parts)] * bool(found)
    return blocks


def _safe(row: Row) -> bool:
    """Whether an attacker that has learnt little or nothing saw mostly survivals; without a count it learns nothing."""
    return bool(row["weak_adversary"] or row["adversary_crashes"] <= row["adversary_interactions"] / 2)


def environments(data: Data, pictures: Pictures) -> list[Block]:
    """For every environment the outcomes and its figures; for a design's settings the outcomes and figures by level."""
    blocks: list[Block] = []
    for environment in data.environments:
        blocks.append(f"## {environment}")
        if levels := settings_of(data)[environment]:
            text = ", ".join(f"{name} {level}" for name, level in levels.items())
            blocks.append(f"{base_of(data, environment)} with {text}.")
        for period in data.periods(environment):
            blocks += outcomes(data, environment, period)
        blocks += pictures.get(environment, ())
    by_level = pictures.get(FACTORS, ())
    return [*blocks, "## By level", *by_level] if by_level else blocks


def outcomes(data: Data, environment: str, period: int) -> list[Block]:
    """The primary outcomes of every method, and its mean rates under each attacker."""
    hard, easy = attacked(data, environment, period), Where(environment, "naive", period)
    names = data.methods(environment, period)
    under_attack = {name: data.sample(hard.where, name, hard.metric) for name in names}
    rates = {goals: [len(data.sample(Where(environment, goals, period), name, "crash_rate")) for name in names]
             for goals in data.goals}  # fmt: skip
    met = [goals for goals, sizes in rates.items() if any(sizes)]
    few = ", ".join(goals for goals in met if sum(rates[goals]) < max(map(sum, rates.values())))
    of_some = f" ({few}: of some policies)" if few else ""
    by = hard.by if any(map(len, under_attack.values())) else f"{hard.by} (nobody attacked)"
    rows, by_attacker = [], []
    for name, rate in under_attack.items():
        score = data.sample(easy, name, "score")
        doses = [*data.delivered(environment, name).values()]
        better = _safer(data, hard, name) if name != data.style.reference else "-"
        rows.append({
            "method": name, "seeds": str(max(len(rate), len(score)) or len(data.seeds(easy, [name]))),
            f"policies below {SAFE:g} % [%]": _share(100 * rate < SAFE),
            "mean rate [%]": _boot(100 * rate, _mean),
            f"P(safer than {data.style.reference})": better,
            "score: IQM": _boot(score, stats.iqm, ".3f"),
            "delivered dose": f"{np.mean(doses):.1f}" if doses else "not recorded",
        })  # fmt: skip
        by_attacker.append({"method": name} | {
            goals: f"{100 * values.mean():.3g}" if len(values) else "-" for goals in met
            if (values := data.sample(Where(environment, goals, period), name, "crash_rate")) is not None
        })  # fmt: skip
    return [
        f"### {environment}, T = {period}: outcomes",
        f"Crashes per interaction under {by}, the score under uniform goals; with 95 % intervals over policies."
        + late_doses(data, environment),
        told(rows), f"Mean crashes per interaction [%] by who chooses the goals{of_some}:", by_attacker,
    ]  # fmt: skip


def told(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The rows of a table without the columns that are empty in all of them."""
    kept = [title for title in rows[0] if any(row[title] != "-" for row in rows)]
    return [{title: row[title] for title in kept} for row in rows]


def _safer(data: Data, hard: Attacked, method: str) -> str:
    """P(safer than the reference); where methods are compared seed by seed, how often it is, over seeds."""
    both, paired = (data.style.reference, method), data.paired(hard.where.environment)
    base, rate = (
        data.in_pairs(hard.where, both, hard.metric) if paired
        else (data.sample(hard.where, name, hard.metric) for name in both)
    )  # fmt: skip
    if min(len(base), len(rate)) < 2:
        return "-"
    return f"{stats.share_of_pairs(base, rate) if paired else stats.probability_of_improvement([(base, rate)]):.2f}"


def distributions(data: Data) -> list[Block]:
    """How the policies of every evaluation are distributed."""
    blocks: list[Block] = []
    for environment in data.environments:
        for period in data.periods(environment):
            for goals in data.goals:
                blocks += _table(data, Where(environment, goals, period))
    return ["## Distributions", "Crashes are shares of interactions [%].", *blocks] if blocks else []


def _table(data: Data, where: Where) -> list[Block]:
    samples = {name: 100 * data.sample(where, name, "crash_rate") for name in data.methods(where.environment)}
    parts, rows = data.parts(where), []
    for name, crashes in samples.items():
        if len(crashes) < 2:
            continue
        reward, score = (data.sample(where, name, metric) for metric in ("reward", "score"))
        mean = stats.bootstrap_t(crashes)  # wide of few policies, or where most do not crash
        within = replace(mean, low=max(mean.low, 0.0), high=min(mean.high, 100.0))  # as shares are
        rows.append({
            "method": name, "seeds": str(len(crashes)),
            "crashes: median": _boot(crashes, _median), "IQM": _boot(crashes, stats.iqm),
            "mean": f"{within:.3g}" if math.isfinite(mean.high) else f"{mean.estimate:.3g} (no interval)",
            "worst 20 % (CVaR)": _boot(crashes, stats.cvar), "IQR": _boot(crashes, stats.iqr),
            "10 % to 90 %": " to ".join(f"{x:.3g}" for x in np.quantile(crashes, [0.1, 0.9])),
            "reward: IQM": _boot(reward, stats.iqm, ".4f"), "score: IQM": _boot(score, stats.iqm, ".3f"),
            **{f"{what}: IQM": _boot(data.sample(where, name, part), stats.iqm) for part, what in parts.items()},
        })  # fmt: skip
    return [f"### {where}", rows] if rows else []


def _boot(x: Array, statistic: stats.Statistic, form: str = ".3g") -> str:
    return format(stats.bootstrap([x], statistic), form) if len(x) >= 2 else "-"


def _share(holds: NDArray[np.bool_]) -> str:
    """Share of the policies that something holds for, in percent, with its exact interval."""
    if not len(holds):
        return "-"
    found = stats.share(holds)
    return f"{stats.Interval(*(100 * x for x in (found.estimate, found.low, found.high))):.3g}"


def over_all(data: Data) -> list[Block]:
    """The primary outcomes over all environments and T, for the methods that were run in all of them."""
    places = [attacked(data, name, period) for name in data.environments for period in data.periods(name)]
    found = {name: [100 * data.sample(each.where, name, each.metric) for each in places]
             for name in data.methods(data.environments[0])}  # fmt: skip
    shared = {name: samples for name, samples in found.items() if min(map(len, samples)) >= 2}
    if len(places) < 2 or len(shared) < 2:
        return []
    rows = []
    for name, samples in shared.items():
        safe = [np.where(rate < SAFE, 100.0, 0.0) for rate in samples]
        both = (stats.bootstrap(values, _over_places) for values in (safe, samples))
        rows.append({"method": name} | dict(zip(
            (f"policies below {SAFE:g} % [%]", "mean rate [%]"), (f"{each:.3g}" for each in both), strict=True
        )))  # fmt: skip
    text = (
        f"Means over {len(places)} evaluations of crashes per interaction under attack, each of which counts alike. "
        "These intervals are bootstraps, which have no width where all policies are below, or none."
    )
    return ["## Over all environments", text, rows]


def _over_places(*samples: Array) -> Array:
    return np.mean([x.mean(axis=-1) for x in samples], axis=0)


def speed(data: Data) -> list[Block]:
    """Frames per second; the rows of its table, the last of its blocks, can be added to."""
    rows = []
    for environment in [name for name in data.environments if data.trained_in(name) == name]:
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
        "Frames per second over all worlds during training, learning included: mean over seeds ± standard error. They "
        "say what a study costs; runs shared the machine, so methods are compared by `python -m benchmarks table41`."
    )
    return ["## Speed", text, told(rows)] if rows else []


def limits(data: Data) -> list[str]:
    """What a reader must bear in mind, one text each."""
    sizes = [
        len(data.seeds(place, [name])) for environment in data.environments
        for place in data.places(environment, "naive") for name in data.methods(environment, place.period)
    ]  # fmt: skip
    least = min((size for size in sizes if size), default=0)
    p10, p30 = (stats.detectable_probability(n, n) for n in (10, 30))
    size = f"The smallest population here has {least} {'policy' if least == 1 else 'policies'}."
    power = f" With a power of 80 %, a rank-sum test finds P(x > y) = {p10:.2f} with 10 a side and {p30:.2f} with 30."
    few = (
        f" A population's median lies between the lowest and the highest of {least} of its policies in "
        f"{100 - 100 * 0.5 ** (least - 1):.3g} % of studies, and no percentile interval reaches beyond these."
    )
    return [
        "The unit is one trained policy. Its worlds and episodes are no replicates.",
        size + power * (not all(map(data.paired, data.environments))) + few * (2 <= least <= MOST_OF_FEW),
        COVERAGE,
        "CVaR over seeds is too low in small populations.",
        "The mean reward per transition pays for crashing where a crash puts the robot back to safety; the score does "
        "not.",
        "Frames per second were measured while the study's workers shared the machine.",
    ]
