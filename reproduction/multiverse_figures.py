"""The figures of the map: specification curves, effect against headroom, headline clauses, effects of factors."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deimos.study.figures import WIDTH, Figures, instead, subplots
from deimos.study.stats import Array, Interval
from reproduction.multiverse import (
    UNIFORM,
    Headline,
    Roles,
    Setting,
    coded,
    gain_slope,
    having,
    headlines,
    margins,
    mean,
    methods_of,
    moved_by,
    share_that_holds,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, RED, GREY = "#0072B2", "#D55E00", "#777777"
CURVE = (
    "every column is a setting, ordered by how much less often the method crashes under the worst attacker than "
    "Uniform, in points of interactions; full dots have headroom. The line is the mean over settings, with "
    "its 95 % interval. Below: the difference of the scores, and the levels of the factors, dark where it is the named "
    "one."
)
ROOM = (
    "By how much a method's policy crashes less than Uniform's, over how often that of another seed crashes. The line "
    "is what the instrumental variable finds: with a slope of 1 a method's crashes do not depend on Uniform's danger, "
    "with one of 0 it gains the same everywhere, possibly nothing. Both axes: crashes per interaction under the worst "
    "attacker, in percent."
)
SHARES = (
    "Share of the settings with headroom in which a clause holds, with its exact 95 % interval. A clause that compares "
    "two methods holds in half of them where the two do not differ, and not where they crash equally often, as never."
)
MOVES = (
    "By how much a factor moves the margin of a clause, towards the level that is named, with 95 % intervals that "
    "hold for all factors of a clause at once; red where they exclude 0. Margins: points of crashes per interaction "
    "under the worst attacker; of the clause that p is free, hundredths of Uniform's score, over settings where it has "
    "learnt the task."
)


def draw(settings: Sequence[Setting]) -> Figures:
    """All figures of a map."""
    roles = Roles.of(settings)
    clauses = headlines(roles)
    others = [name for name in methods_of(settings) if name != UNIFORM]
    curves = {f"curve-{name}": (f"{name}: {CURVE}", curve(settings, name)) for name in others}
    return curves | {
        "headroom": (ROOM, over_headroom(settings, others)),
        "shares": (SHARES, shares(settings, clauses)),
        "factors": (MOVES, moves(settings, clauses)),
    }


def named(name: str) -> str:
    """A factor's name in figures and tables: the field without its path, and multipliers marked as such."""
    return name.rpartition(".")[2].replace("_", " ")


def level_named(name: str, level: Any) -> str:
    """A level of a factor."""
    return f"{named(name)} x {level:g}" if name.startswith("times.") else f"{named(name)}: {level}"


def curve(settings: Sequence[Setting], method: str) -> "Figure":
    """The specification curve of a method, with its factor matrix."""
    settings = having(settings, [UNIFORM, method])
    safer = 100 * np.array([each.policies[UNIFORM].worst - each.policies[method].worst for each in settings])
    score = np.array([each.policies[method].score - each.policies[UNIFORM].score for each in settings])
    order = np.argsort(safer, kind="stable")
    room = np.array([each.has_headroom for each in settings])[order]
    levels, design = coded(settings)
    figure, axes = subplots(3, 1, (WIDTH, 5.6), sharex=True, height_ratios=[3, 1.6, 0.26 * len(levels) + 0.2])
    place = np.arange(len(settings))
    for panel, values in zip(axes[:2, 0], (safer[order], score[order]), strict=True):
        panel.axhline(0.0, color="black", linewidth=0.8)
        for chosen, filling in ((room, BLUE), (~room, "white")):
            panel.plot(place[chosen], values[chosen], linestyle="", marker="o", markersize=4.5, color=BLUE,
                       markerfacecolor=filling)  # fmt: skip
        panel.grid(axis="y", alpha=0.3)
        panel.tick_params(axis="x", which="both", length=0)
    middle = mean(safer)
    if np.isfinite(middle.low):
        axes[0, 0].axhspan(middle.low, middle.high, color=GREY, alpha=0.2, linewidth=0)
    axes[0, 0].axhline(middle.estimate, color=GREY, linewidth=1)
    axes[0, 0].set_ylabel("fewer crashes than\nUniform [points]")
    axes[1, 0].set_ylabel("score minus\nUniform's")
    axes[0, 0].set_title(f"{method}: {middle:.1f} points in the mean over {len(settings)} settings")
    _matrix(axes[2, 0], levels, design[order])
    return figure


def _matrix(axes: "Axes", levels: dict[str, list[Any]], design: Array) -> None:
    """The level of every factor in each setting."""
    axes.imshow(design.T > 0, cmap="Greys", vmin=-0.15, vmax=1.3, aspect="auto", interpolation="none")
    axes.set_xticks(np.arange(-0.5, len(design)), minor=True)
    axes.set_yticks(np.arange(-0.5, len(levels)), minor=True)
    axes.grid(which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="both", length=0)
    axes.set_xticks([])
    axes.set_yticks(range(len(levels)), [level_named(name, own[-1]) for name, own in levels.items()])
    axes.set_xlabel("settings")


def over_headroom(settings: Sequence[Setting], methods: Sequence[str]) -> "Figure":
    """The effect of every method against headroom from the screening's seed."""
    columns = 3
    figure, axes = subplots(-(-len(methods) // columns), columns, (WIDTH, 4.4), sharex=True, sharey=True)
    for panel in axes.flat[len(methods) :]:
        panel.set_axis_off()
    for panel, name in zip(axes.flat, methods, strict=False):
        own = having(settings, [UNIFORM, name])
        room = 100 * np.array([each.screened.worst for each in own])
        base = 100 * np.array([each.policies[UNIFORM].worst for each in own])
        effect = base - 100 * np.array([each.policies[name].worst for each in own])
        slope = gain_slope(settings, name)
        panel.axhline(0.0, color="black", linewidth=0.8)
        panel.plot(room, effect, linestyle="", marker="o", markersize=3.5, color=BLUE, alpha=0.7)
        if np.isfinite(slope.low):
            ends = np.array([0.0, 100.0])
            panel.plot(ends, effect.mean() + slope.estimate * (ends - base.mean()), color=RED, linewidth=1)
        panel.set_title(f"{name}: slope\n{slope_named(slope)}")
        panel.grid(alpha=0.3)
        panel.set_xlim(-4, 104)
        panel.set_ylim(-104, 104)
    for panel in axes[-1]:
        panel.set_xlabel("Uniform, screening [%]")
    for panel in axes[:, 0]:
        panel.set_ylabel("fewer crashes than\nUniform [points]")
    return figure


def slope_named(slope: Interval) -> str:
    """A slope with its interval, if it has one."""
    if np.isnan(slope.estimate):
        return "unknown"
    return f"{slope:.2f}" if np.isfinite(slope.low) else f"{slope.estimate:.2f} [no interval]"


def shares(settings: Sequence[Setting], clauses: Sequence[Headline]) -> "Figure | None":
    """In how many settings with headroom each clause holds."""
    found = [share_that_holds(settings, clause) for clause in clauses]
    if not any(found):
        return None
    figure, axes = subplots(1, 1, (WIDTH, 2.9))
    panel = axes[0, 0]
    for i, interval in enumerate(found):
        if interval is None:
            continue
        panel.plot([100 * interval.low, 100 * interval.high], [i, i], color=BLUE, linewidth=1.5)
        panel.plot(100 * interval.estimate, i, marker="o", color=BLUE, markersize=5, clip_on=False)
    panel.axvline(50.0, color="black", linewidth=0.8, linestyle=":")
    panel.set_yticks(range(len(clauses)), [clause.text for clause in clauses])
    panel.set_ylim(len(clauses) - 0.5, -0.5)
    panel.set_xlim(0, 100)
    panel.set_xlabel("holds in [%] of the settings with headroom")
    panel.grid(axis="x", alpha=0.3)
    return figure


def moves(settings: Sequence[Setting], clauses: Sequence[Headline]) -> "Figure | None":
    """The effects of factors on the margin of every clause."""
    columns = 4
    figure, axes = subplots(-(-len(clauses) // columns), columns, (WIDTH, 4.6), sharey=True)
    levels, _ = coded(settings)
    for panel, clause in zip(axes.flat, clauses, strict=False):
        own = clause.counts_in(settings)
        panel.set_title(clause.name)
        if not (found := moved_by(own, 100 * margins(own, clause))):
            instead(panel, "too few settings")
            continue
        panel.axvline(0.0, color="black", linewidth=0.8)
        for i, name in enumerate(levels):
            effect = found[name]
            colour = RED if effect.low > 0.0 or effect.high < 0.0 else GREY
            panel.plot([effect.low, effect.high], [i, i], color=colour, linewidth=1.3)
            panel.plot(effect.estimate, i, marker="o", color=colour, markersize=3.5)
        panel.grid(axis="x", alpha=0.3)
        panel.set_ylim(len(levels) - 0.5, -0.5)
    if not any(panel.lines for panel in axes.flat):
        return None
    texts = [f"{level_named(name, own[-1])}" for name, own in levels.items()]
    axes[0, 0].set_yticks(range(len(levels)), texts)
    for panel in axes[-1]:
        panel.set_xlabel("points")
    return figure
