"""Draw the two pictures of docs/architecture.md: ``python docs/architecture_pictures.py``."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

FOLDER = Path(__file__).parent / "images" / "architecture"
INK, LINE = "#1b2a33", "#5b7280"
KERNEL, TORCH, PERSON = "#cfe6f5", "#fde3c8", "#e4e8eb"


def box(ax: Axes, x: float, y: float, width: float, title: str, text: str, color: str, height: float = 1.0) -> None:
    """A room with its name and what is in it, centred at (x, y)."""
    ax.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2),
            width,
            height,
            boxstyle="round,pad=0.02,rounding_size=0.12",
            fc=color,
            ec=LINE,
        )
    )
    ax.text(x, y + (0.2 if text else 0.0), title, ha="center", va="center", fontsize=13, weight="bold", color=INK)
    ax.text(x, y - 0.2, text, ha="center", va="center", fontsize=9.5, color=INK)


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], text: str = "", bend: float = 0.0) -> None:
    """An arrow with a word beside its middle."""
    style = {"arrowstyle": "-|>", "color": LINE, "lw": 1.6, "shrinkA": 2, "shrinkB": 2}
    ax.annotate("", end, start, arrowprops=style | {"connectionstyle": f"arc3,rad={bend}"})
    if text:
        middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
        ax.text(
            *middle,
            text,
            ha="center",
            va="center",
            fontsize=9.5,
            color=INK,
            bbox={"fc": "white", "ec": "none", "pad": 1.5},
        )


def canvas(width: float, height: float) -> Axes:
    """Empty axes of a size in boxes' units, on white, for light and dark pages alike."""
    figure, ax = plt.subplots(figsize=(width, height), layout="constrained")
    figure.patch.set_facecolor("white")
    ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    ax.axis("off")
    return ax


def draw_packages() -> None:
    """Which package may import which; arrows point at what is imported, and continue downwards."""
    ax = canvas(10, 7.4)
    box(ax, 3.6, 6.8, 3.4, "app", "command line, figures, videos", PERSON)
    box(ax, 8.2, 6.8, 3.2, "adapters", "rsl_rl, gymnasium", PERSON)
    box(ax, 3.6, 5.3, 3.4, "study", "populations, statistics, report", PERSON)
    box(ax, 5.0, 3.8, 6.4, "run", "trainer, loop, folder, evaluation, audit", TORCH)
    box(ax, 1.7, 2.3, 2.9, "goals", "selectors, fear, director", TORCH)
    box(ax, 5.0, 2.3, 2.9, "learn", "PPO, rollout, policy", TORCH)
    box(ax, 8.3, 2.3, 2.9, "sim", "environments, robots", KERNEL)
    box(ax, 3.3, 0.7, 4.2, "nn", "networks, Adam, seeds", TORCH)
    box(ax, 6.9, 0.7, 1.9, "terrain", "shapes, tool", KERNEL)
    box(ax, 9.05, 0.7, 1.6, "kernels", "Warp", KERNEL)
    arrow(ax, (3.6, 6.3), (3.6, 5.8))
    arrow(ax, (3.6, 4.8), (4.2, 4.3))
    arrow(ax, (8.2, 6.3), (7.2, 4.3))
    for x in (1.9, 5.0, 8.1):
        arrow(ax, (0.4 * 5.0 + 0.6 * x, 3.3), (x, 2.8))
    for start, end in ((1.7, 2.6), (5.0, 4.0), (7.4, 4.9)):
        arrow(ax, (start, 1.8), (end, 1.2))
    arrow(ax, (8.2, 1.8), (7.2, 1.2))
    arrow(ax, (8.7, 1.8), (9.0, 1.2))
    arrow(ax, (7.85, 0.7), (8.25, 0.7))
    ax.figure.savefig(FOLDER / "packages.svg")
    plt.close(ax.figure)


def draw_data() -> None:
    """The way of a step's numbers: three resting places, one copy each."""
    ax = canvas(10, 6.2)
    box(ax, 1.7, 5.3, 2.8, "Policy", "torch", TORCH)
    box(ax, 8.2, 5.3, 3.0, "Kernel arrays", "physics, crash, reward,\nclocks, observation", KERNEL, 1.25)
    box(ax, 8.2, 3.1, 3.0, "Step", "torch views of the\nsame memory", KERNEL, 1.25)
    box(ax, 8.2, 0.9, 3.0, "Rollout", "num_steps x num_envs", TORCH)
    box(ax, 1.7, 0.9, 2.8, "PPO", "update", TORCH)
    box(ax, 5.1, 3.1, 2.5, "Interactions", "crashed or survived", TORCH)
    box(ax, 2.6, 3.1, 2.0, "Selector", "fear, choice", TORCH)
    arrow(ax, (3.1, 5.3), (6.7, 5.3), "action (copy)")
    arrow(ax, (8.2, 4.65), (8.2, 3.75), "same memory")
    arrow(ax, (8.2, 2.45), (8.2, 1.4), "record (copy)")
    arrow(ax, (6.7, 0.9), (3.1, 0.9), "minibatches")
    arrow(ax, (6.7, 3.1), (6.35, 3.1))
    arrow(ax, (3.85, 3.1), (3.6, 3.1))
    arrow(ax, (2.9, 3.6), (6.9, 4.75), "goals for worlds that are due", -0.05)
    arrow(ax, (0.55, 1.4), (0.55, 4.8), "weights")
    ax.figure.savefig(FOLDER / "data.svg")
    plt.close(ax.figure)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    plt.rcParams["svg.hashsalt"] = "deimos"  # the same file every time
    draw_packages()
    draw_data()
