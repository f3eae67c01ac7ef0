"""Figures of the outcomes: the policies of every method, score against safety, and outcomes by level of a factor."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from deimos.study import figures, stats
from deimos.study.audits import diversity
from deimos.study.data import Data, Style, Where
from deimos.study.figures import WIDTH, Figures, as_rates, instead, legend, line, subplots
from deimos.study.stats import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SAFE = 1.0  # [%] of interactions: safe policies crash in fewer, under the worst attacker
NOBODY = "nobody attacked"
BOXES = (
    "every point is a policy; boxes are quartiles, whiskers 1.5 times their range; n policies. The dotted line is 1 % "
    "of interactions."
)
PROFILES = "share of the policies that crash in more than x % of their interactions, with pointwise 95 % bands."
PARETO = (
    "every dot is a policy, every large marker the medians of a method; the line joins the methods that no other beats "
    "in both. Up and left is better; policies that never crashed are spread around 0. Dotted: 1 % of interactions."
)
DOSE = (
    "score and safety over the dose that training delivered, the mean percentile of fear of its goals: 50 is "
    "Uniform's. Every dot is a policy, every large marker the medians of a method."
)
MAPS = (
    "where goals were in the last quarter of training (up), given the place of the world (across), or the goal before "
    "where goals are no places, axis by axis, from one end of the range to the other. The number is the diversity of "
    "goals: their entropy given the place, 1 where they are uniform, 0 where the place says the goal."
)
MOST_LEVELS = 6
LEVELS = (
    "crashes under attack and score by the level of every factor: medians over policies and the levels of the other "
    "factors, with quartiles. Many levels of a number are put into quarters."
)


def of_environment(data: Data, environment: str) -> Figures:
    """The figures of one environment."""
    found: Figures = {}
    for period in data.periods(environment):
        place, ending = f"{environment}, T = {period}", f"{environment}-T{period}"
        found |= {
            f"evaluation-{ending}": (f"{place}: {BOXES}", boxes(data, environment, period)),
            f"pareto-{ending}": (f"{place}: {PARETO}", pareto(data, environment, period)),
            f"dose-{ending}": (f"{place}: {DOSE}{late_doses(data, environment)}", dose(data, environment, period)),
            f"profile-{ending}": (f"{place}: {PROFILES}", profiles(data, environment, period)),
        }
        if data.trained_in(environment) != environment:
            del found[f"dose-{ending}"]
    if data.trained_in(environment) != environment:  # its trainings are drawn there
        return found
    text = f"{environment}: {figures.TRAINING} {figures.CAVEAT}"
    return found | {
        f"goals-{environment}": (f"{environment}: {MAPS}", goal_maps(data, environment)),
        f"training-{environment}": (text, figures.training(data, environment)),
    }


def late_doses(data: Data, environment: str) -> str:
    """A sentence on the methods whose dose is that of a part of their training; empty if there are none."""
    names = ", ".join(data.dosed_late(environment))
    return f" The dose of {names} is that of the last part of the training, whose goals alone fear ranked." * bool(
        names
    )


def of_factors(data: Data) -> Figures:
    """A figure by level for every environment with several settings in a study."""
    bases = dict.fromkeys(base_of(data, name) for name, own in settings_of(data).items() if own)
    periods = {base: sorted({row["goal_period"] for row in data.rows if row.get("base_environment") == base})
               for base in bases}  # fmt: skip
    return {
        f"levels-{base}-T{period}": (f"{base}, T = {period}: {LEVELS}", levels(data, base, period))
        for base in bases for period in periods[base]
    }  # fmt: skip


@dataclass(frozen=True)
class Attacked:
    """Where the safety of an environment's policies is read from."""

    where: Where
    """The evaluation."""
    metric: str
    """The column with the share of interactions that ended in a crash."""
    by: str
    """Who chose the goals, in words."""


def attacked(data: Data, environment: str, period: int) -> Attacked:
    """Safety under the worst attacker that all policies met; under the thesis's if the rows do not name it."""
    easy, hard = (Where(environment, goals, period) for goals in ("naive", "adversary"))
    if any(len(data.sample(easy, name, "worst")) for name in data.methods(environment)):
        return Attacked(easy, "worst", "the worst attacker")
    return Attacked(hard, "crash_rate", "the Adversary")


def pairs(data: Data, environment: str, period: int, method: str) -> tuple[Array, Array]:
    """Crashes per interaction under attack [%] and score under Naive of the policies that have both, shapes (n,)."""
    hard, easy = attacked(data, environment, period), Where(environment, "naive", period)
    seeds = sorted({*data.seeds(hard.where, [method])} & {*data.seeds(easy, [method])})
    both = [
        (data.sample(hard.where, method, hard.metric, [seed]), data.sample(easy, method, "score", [seed]))
        for seed in seeds
    ]
    known = [(100 * rate[0], score[0]) for rate, score in both if len(rate) and len(score)]
    rate, score = np.array(known).reshape(-1, 2).T
    return rate, score


def boxes(data: Data, environment: str, period: int) -> "Figure":
    """Box-and-whisker plots of crashes per interaction, under Naive and under attack, and of the score."""
    methods = data.methods(environment)
    figure, axes = subplots(1, 3, (WIDTH, 1.1 + 0.22 * len(methods)), sharey=True)
    for panel, each in zip(axes[0], _both(data, environment, period), strict=False):
        _boxes(panel, data.style, {name: 100 * data.sample(each.where, name, each.metric) for name in methods})
        as_rates(panel, "x", "crashes per interaction [%]")
        panel.axvline(SAFE, color="black", linewidth=0.8, linestyle=":")
        panel.set_title(f"under {each.by}")
    panel, easy = axes[0, 2], Where(environment, "naive", period)
    _boxes(panel, data.style, {name: data.sample(easy, name, "score") for name in methods})
    panel.set_title("under uniform goals")
    panel.set_xlabel("score")
    axes[0, 0].set_yticks(range(len(methods)), methods)
    axes[0, 0].set_ylim(len(methods) - 0.4, -0.6)
    return figure


def _both(data: Data, environment: str, period: int) -> list[Attacked]:
    """Crashes without and with an attacker."""
    easy = Attacked(Where(environment, "naive", period), "crash_rate", "uniform goals")
    return [easy, attacked(data, environment, period)]


def _boxes(axes: "Axes", style: Style, samples: Mapping[str, Array]) -> None:
    """A box for each method, from top to bottom, with the number of its policies next to it."""
    beside = axes.get_yaxis_transform()
    axes.text(1.01, -0.9, "n", transform=beside, va="center", fontsize=7)
    for i, (name, values) in enumerate(samples.items()):
        axes.text(1.01, i, str(len(values)), transform=beside, va="center", fontsize=7)
        if len(values) == 0:
            continue
        drawn = axes.boxplot(
            [values], positions=[i], widths=0.7, patch_artist=True, showfliers=False, orientation="horizontal",
            medianprops={"color": "white" if _is_dark(style.colours[name]) else "black", "linewidth": 1.6},
            manage_ticks=False,
        )  # fmt: skip
        drawn["boxes"][0].set(facecolor=style.colours[name], alpha=0.85)
        place = i + 0.4 * (np.arange(len(values)) * 0.618034 % 1.0 - 0.5)  # spread, but not in the order of the seeds
        axes.plot(
            values, place, linestyle="", marker="o", markersize=2.4, color="white",
            markeredgecolor="black", markeredgewidth=0.5, zorder=3, clip_on=False,
        )  # fmt: skip
    axes.grid(axis="x", alpha=0.3)


def pareto(data: Data, environment: str, period: int) -> "Figure | None":
    """Score under Naive against crashes under attack, every policy a dot."""
    points = {name: pairs(data, environment, period, name) for name in data.methods(environment)}
    points = {name: both for name, both in points.items() if len(both[0])}
    if not points:
        return None
    figure, axes = subplots(1, 1, (WIDTH, 3.6))
    panel = axes[0, 0]
    for name, (rate, score) in points.items():
        spread = np.where(rate > 0, rate, 0.0012 * np.sin(np.arange(len(rate)) * 2.4))  # or they hide each other
        panel.plot(spread, score, linestyle="", marker=".", markersize=5, color=data.style.colours[name], alpha=0.7)
    middles = {name: (float(np.median(rate)), float(np.median(score))) for name, (rate, score) in points.items()}
    front = unbeaten(middles)
    panel.plot(
        *np.array([middles[name] for name in front]).T, color="#777777", linewidth=1, drawstyle="steps-post", zorder=2
    )
    for name, middle in middles.items():
        panel.plot(
            *middle, linestyle="", marker=data.style.marker(name), markersize=7.5, zorder=3,
            color=data.style.colours[name], markeredgecolor="black", markeredgewidth=0.7,
        )  # fmt: skip
    panel.axvline(SAFE, color="black", linewidth=0.8, linestyle=":")
    rates = [SAFE, *np.concatenate([rate for rate, _ in points.values()])]
    as_rates(panel, "x", f"crashes per interaction under {attacked(data, environment, period).by} [%]", rates)
    panel.set_ylabel("score under uniform goals")
    panel.grid(alpha=0.3)
    legend(figure, data.style, points, "beside")
    return figure


def unbeaten(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points (rate, score) of which no other has a lower rate at no lower score, by rising rate.

    Nor a higher score at no higher rate.
    """
    front: list[str] = []
    for name in sorted(points, key=lambda name: (points[name][0], -points[name][1])):
        if not front or points[name][1] > points[front[-1]][1]:
            front.append(name)
    return front


def profiles(data: Data, environment: str, period: int) -> "Figure | None":
    """Performance profiles: share of the policies whose crashes per interaction exceed a threshold."""
    titles = [*data.style.panels]
    figure, axes = subplots(2, len(titles), (WIDTH, 4.6), sharex=True, sharey="all")
    thresholds = np.concatenate([[0.0], np.geomspace(1e-2, 1e2, 120)])
    for row, each in zip(axes, _both(data, environment, period), strict=True):
        for panel, title in zip(row, titles, strict=True):
            for name in data.methods(environment):
                values = 100 * data.sample(each.where, name, each.metric)
                if data.style.panel(name) == title and len(values) >= 2:
                    share, *band = stats.performance_profile([values], thresholds, resamples=2000)
                    line(panel, data.style, name, thresholds, share, band, every=12, alpha=0.1, step="post")
            panel.grid(alpha=0.3)
        row[0].set_ylabel(f"share of policies above,\nunder {each.by}")
        if not any(panel.lines for panel in row):
            for panel in row:
                instead(panel, NOBODY)
    for panel, title in zip(axes[0], titles, strict=True):
        panel.set_title(title)
    for panel in axes[1]:
        as_rates(panel, "x", "crashes per interaction [%]")
    legend(figure, data.style, data.methods(environment), "below")
    return figure if any(panel.lines for panel in axes.flat) else None


def levels(data: Data, base: str, period: int) -> "Figure | None":
    """Crashes under attack and score by the level of every factor of a study, a column for each factor."""
    settings = {name: own for name, own in settings_of(data).items() if own and base_of(data, name) == base}
    factors = [*dict.fromkeys(factor for own in settings.values() for factor in own)]
    if not factors:
        return None
    figure, axes = subplots(2, len(factors), (WIDTH, 4.4), sharex="col", sharey="row")
    methods = [*dict.fromkeys(name for each in settings for name in data.methods(each))]
    for column, factor in zip(axes.T, factors, strict=True):
        groups = _grouped([own[factor] for own in settings.values() if factor in own])
        for i, name in enumerate(methods):
            shift = 0.5 * ((i + 0.5) / len(methods) - 0.5)
            both = [[pairs(data, each, period, name) for each, own in settings.items() if own.get(factor) in group]
                    for group in groups.values()]  # fmt: skip
            for panel, which in zip(column, (0, 1), strict=True):
                samples = [np.concatenate([part[which] for part in parts]) for parts in both]
                _over_levels(panel, data.style, name, shift, samples)
        column[1].set_xticks(range(len(groups)), groups)
        column[1].set_xlabel(factor)
    for panel in axes.flat:
        panel.grid(alpha=0.3)
    as_rates(axes[0, 0], "y", "crashes per interaction\nunder attack [%]")
    axes[1, 0].set_ylabel("score under uniform goals")
    legend(figure, data.style, methods, "beside")
    return figure


def _grouped(levels: list[Any]) -> dict[str, list[Any]]:
    """Levels in order, by their labels; more numbers than a figure can distinguish are put into quarters."""
    ordered: list[Any] = []
    for level in sorted(levels, key=lambda level: (not isinstance(level, int | float), level)):
        ordered += [level] if level not in ordered else []
    if len(ordered) <= MOST_LEVELS or not all(isinstance(level, int | float) for level in ordered):
        return {str(level): [level] for level in ordered}
    quarters = [ordered[len(ordered) * i // 4 : len(ordered) * (i + 1) // 4] for i in range(4)]
    return {f"{part[0]:.3g}\nto {part[-1]:.3g}": part for part in quarters}


def settings_of(data: Data) -> dict[str, dict[str, Any]]:
    """The level of every factor, by environment; none where a study has no factors."""
    return {row["environment"]: row.get("levels") or {} for row in data.rows}


def base_of(data: Data, environment: str) -> str:
    """The environment of the study's file that an environment is a setting of; itself without factors."""
    return next(row.get("base_environment") or environment for row in data.rows if row["environment"] == environment)


def _over_levels(axes: "Axes", style: Style, name: str, shift: float, samples: list[Array]) -> None:
    known = [i for i, values in enumerate(samples) if len(values)]
    if not known:
        return
    low, middle, high = np.array([np.quantile(samples[i], [0.25, 0.5, 0.75]) for i in known]).T
    axes.errorbar(
        np.array(known) + shift, middle, [middle - low, high - middle], color=style.colours[name], linewidth=1,
        marker=style.marker(name), markersize=4.5, markeredgecolor="black", markeredgewidth=0.4, capsize=2,
    )  # fmt: skip


def dose(data: Data, environment: str, period: int) -> "Figure | None":
    """Score and crashes under attack over the delivered dose of every method, policies as dots."""
    hard = attacked(data, environment, period)
    names = [name for name in data.methods(environment) if data.delivered(environment, name)]
    if not names:
        return None
    figure, axes = subplots(1, 2, (WIDTH, 3.0), sharex=True)
    for panel, where, metric in (
        (axes[0, 0], Where(environment, "naive", period), "score"), (axes[0, 1], hard.where, hard.metric),
    ):  # fmt: skip
        over_dose(panel, data, where, names, metric)
        panel.set_xlabel("delivered dose: mean percentile of fear")
        panel.grid(alpha=0.3)
    axes[0, 0].set_ylabel("score under uniform goals")
    rates = [x for drawn in axes[0, 1].lines for x in drawn.get_ydata()]
    as_rates(axes[0, 1], "y", f"crashes per interaction\nunder {hard.by} [%]", rates)
    legend(figure, data.style, names, "beside")
    return figure


def over_dose(axes: "Axes", data: Data, where: Where, methods: Sequence[str], metric: str) -> None:
    """Draw the policies of some methods and their medians over the delivered dose; crashes in percent."""
    for name in methods:
        _over_dose(axes, data, where, name, metric)
    if not axes.lines:
        instead(axes, NOBODY)


def _over_dose(axes: "Axes", data: Data, where: Where, method: str, metric: str) -> None:
    doses = data.delivered(where.environment, method)
    both = [
        (doses[seed], value[0]) for seed in data.seeds(where, [method])
        if seed in doses and len(value := data.sample(where, method, metric, [seed]))
    ]  # fmt: skip
    if not both:
        return
    x, y = np.array(both).T
    y = y if metric == "score" else 100 * y
    colour = data.style.colours[method]
    axes.plot(x, y, linestyle="", marker=".", markersize=4, color=colour, alpha=0.6)
    axes.plot(
        np.median(x), np.median(y), marker=data.style.marker(method), markersize=7, color=colour, zorder=3,
        markeredgecolor="black", markeredgewidth=0.7,
    )  # fmt: skip


def goal_maps(data: Data, environment: str) -> "Figure | None":
    """Where every method's goals were late in training, given the place of the world, and how diverse they were."""
    counts = {
        name: np.sum(maps, axis=0) for name in data.methods(environment)
        if (maps := data.curves(environment, name, "goal_map"))
    }  # fmt: skip
    if not counts:
        return None
    columns = min(6, len(counts))
    rows = -(-len(counts) // columns)
    figure, axes = subplots(rows, columns, (WIDTH, 0.4 + 1.3 * rows), sharex=True, sharey=True)
    for panel in axes.flat[len(counts) :]:
        panel.set_axis_off()
    for panel, (name, flat) in zip(axes.flat, counts.items(), strict=False):
        bins = math.isqrt(len(flat))
        table = flat.reshape(bins, bins)
        share = table / np.maximum(table.sum(axis=1, keepdims=True), 1)  # of the goals at a place
        drawn = panel.imshow(share.T, origin="lower", extent=(-1, 1, -1, 1), cmap="cividis", vmin=0, vmax=4 / bins)
        panel.set_title(f"{name}\n{diversity(flat):.2f}")
        panel.set_xticks([-1, 0, 1])
        panel.set_yticks([-1, 0, 1])
    for panel in axes[-1]:
        panel.set_xlabel("place")
    for panel in axes[:, 0]:
        panel.set_ylabel("goal")
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, ticks=[0, 1 / bins, 4 / bins])
    bar.set_ticklabels(["none", "as uniform", "4 times"])
    return figure


def _is_dark(code: str) -> bool:
    red, green, blue = (int(code[i : i + 2], 16) for i in (1, 3, 5))
    return 0.299 * red + 0.587 * green + 0.114 * blue < 110
