"""What the thesis's methods look like, and the figure of claim C25: crashes over the achieved percentile of fear."""

from typing import TYPE_CHECKING

import numpy as np

from deimos.study.data import Data, Style, Where
from deimos.study.figures import GOALS, Figures, logarithmic, of_environment, subplots
from deimos.study.stats import Array
from reproduction.thesis import ACHIEVED, DIRECTOR_METHODS, ENVIRONMENTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BASELINES = ("uniform", "rnd", "vds")
_DIRECTOR_COLOURS = ("#fde333", "#b6c24a", "#6fa76b", "#3c8a7c", "#2e6b85", "#3a4a80", "#2d1e5f")  # yellow to blue
STYLE = Style(
    order=(*ENVIRONMENTS, *DIRECTOR_METHODS, *_BASELINES, "cl"),
    panels={"Directors": DIRECTOR_METHODS, "baselines": _BASELINES},
    everywhere="p25",
    colours=dict(zip(DIRECTOR_METHODS, _DIRECTOR_COLOURS, strict=True)) | {  # the others are Okabe and Ito's
        "uniform": "#000000", "rnd": "#D55E00", "vds": "#CC79A7", "cl": "#56B4E9", "vds+p75": "#009E73",
        "learnability": "#E69F00",
    },
)  # fmt: skip


def figures(data: Data, environment: str) -> Figures:
    """The figures of every study, and the dose-response of the Directors."""
    found = of_environment(data, environment)
    for period in data.periods(environment):
        found[f"dose-{environment}-T{period}"] = (
            f"{environment}, T = {period}: crashes over the percentile of fear that a method's goals have on average; "
            "medians with quartiles, and the parabola of claim C25.",
            dose_response(data, environment, period),
        )
    return found


def dose_response(data: Data, environment: str, period: int) -> "Figure | None":
    """Crashes over the achieved percentile of fear, Naive and Adversary side by side."""
    names = [name for name in data.methods(environment) if name in ACHIEVED]
    if len([name for name in names if name in DIRECTOR_METHODS]) < 3:
        return None
    figure, axes = subplots(1, 2, (11, 4.2), sharey=True)
    for panel, goals in zip(axes[0], GOALS, strict=True):
        where = Where(environment, goals, period)
        samples = {name: data.sample(where, name, "crashes") for name in names}
        for name, values in samples.items():
            if len(values):
                low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
                panel.errorbar(
                    ACHIEVED[name], middle, [[middle - low], [high - middle]], color="black",
                    marker=data.style.marker(name), markerfacecolor=data.style.colours[name], markersize=8,
                    capsize=3, linewidth=1,
                )  # fmt: skip
        _parabola(panel, {n: x for n, x in samples.items() if n in DIRECTOR_METHODS and len(x)})
        panel.set_title(f"against the {goals.capitalize()}")
        panel.set_xlabel("achieved percentile of fear")
        panel.grid(alpha=0.3)
        shown = [name for name, values in samples.items() if len(values)]
        names_above = panel.secondary_xaxis("top")  # beside the markers they would cover each other
        names_above.set_xticks([ACHIEVED[name] for name in shown], shown, rotation=60, ha="left", fontsize=8)
    logarithmic(axes[0, 0])
    axes[0, 0].set_ylabel("crashes")
    return figure


def _parabola(axes: "Axes", samples: dict[str, Array]) -> None:
    if len(samples) < 4:
        return
    x = np.concatenate([np.full(len(values), ACHIEVED[name]) for name, values in samples.items()])
    coefficients = np.polyfit(x, np.log1p(np.concatenate(list(samples.values()))), 2)
    line = np.linspace(0.5, 99.5, 100)
    axes.plot(line, np.expm1(np.polyval(coefficients, line)), color="grey", linewidth=1, linestyle="--", zorder=0)
