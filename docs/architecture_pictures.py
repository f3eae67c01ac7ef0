"""Draw the pictures of docs/architecture.md, for light and dark pages: ``python docs/architecture_pictures.py``."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

FOLDER = Path(__file__).parent / "images" / "architecture"
THEMES = {
    "": {"ink": "#1b2a33", "line": "#5b7280", "paper": "#ffffff", "kernel": "#cfe6f5", "torch": "#fde3c8",
         "person": "#e4e8eb"},
    "-dark": {"ink": "#e6e9eb", "line": "#8fa3ae", "paper": "#131416", "kernel": "#173f57", "torch": "#573716",
              "person": "#3a4045"},
}  # fmt: skip
UNIT = 0.46  # [inch]; a picture of ten units is as wide as a phone


class Canvas:
    """Boxes and arrows on the paper of a theme, in units."""

    def __init__(self, width: float, height: float, theme: dict[str, str]) -> None:
        self.theme = theme
        self.figure, ax = plt.subplots(figsize=(width * UNIT, height * UNIT), layout="constrained")
        self.ax: Axes = ax
        self.figure.patch.set_facecolor(theme["paper"])
        ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        ax.axis("off")

    def box(self, x: float, y: float, width: float, title: str, text: str, color: str) -> None:
        """A room with its name and what is in it, centred at (x, y)."""
        shape = FancyBboxPatch(
            (x - width / 2, y - 0.65), width, 1.3, boxstyle="round,pad=0.02,rounding_size=0.12",
            fc=self.theme[color], ec=self.theme["line"],
        )  # fmt: skip
        self.ax.add_patch(shape)
        style = {"ha": "center", "color": self.theme["ink"]}
        self.ax.text(x, y + 0.13, title, va="bottom", fontsize=10.5, weight="bold", **style)
        self.ax.text(x, y + 0.08, text, va="top", fontsize=8, linespacing=1.0, **style)

    def arrow(self, start: tuple[float, float], end: tuple[float, float], text: str = "", bend: float = 0.0) -> None:
        """An arrow with words on its middle."""
        line = {"arrowstyle": "-|>", "color": self.theme["line"], "lw": 1.3, "shrinkA": 1, "shrinkB": 1}
        self.ax.annotate("", end, start, arrowprops=line | {"connectionstyle": f"arc3,rad={bend}"})
        if text:
            middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
            paper = {"fc": self.theme["paper"], "ec": "none", "pad": 1.0}
            style = {"ha": "center", "va": "center", "fontsize": 8.5, "color": self.theme["ink"]}
            self.ax.text(*middle, text, bbox=paper, **style)

    def save(self, name: str) -> None:
        """Write it."""
        self.figure.savefig(FOLDER / name, metadata={"Date": None})
        plt.close(self.figure)


def draw_packages(suffix: str) -> None:
    """Which package may import which; arrows point at what is imported, and continue downwards."""
    canvas = Canvas(10, 10.4, THEMES[suffix])
    canvas.box(3.2, 9.5, 3.2, "app", "command line,\nfigures, viewer", "person")
    canvas.box(8.0, 9.5, 3.2, "adapters", "rsl_rl, SB3,\ngymnasium", "person")
    canvas.box(3.2, 7.4, 3.2, "study", "populations,\nreport", "person")
    canvas.box(5.0, 5.3, 7.4, "run", "trainer, loop, folder, evaluation, attackers", "torch")
    canvas.box(1.65, 3.2, 2.9, "goals", "selectors, fear,\nGoalDirector", "torch")
    canvas.box(5.0, 3.2, 2.9, "learn", "PPO, rollout,\npolicy", "torch")
    canvas.box(8.35, 3.2, 2.9, "sim", "environments,\nrobots", "kernel")
    canvas.box(2.75, 0.9, 4.0, "nn", "networks, Adam, seeds, graphs", "torch")
    canvas.box(6.5, 0.9, 2.2, "terrain", "shapes, tool", "kernel")
    canvas.box(9.0, 0.9, 1.7, "kernels", "Warp", "kernel")
    canvas.arrow((3.2, 8.85), (3.2, 8.05))
    canvas.arrow((3.2, 6.75), (3.9, 5.95))
    canvas.arrow((8.0, 8.85), (7.2, 5.95))
    for x in (1.65, 5.0, 8.35):
        canvas.arrow((2.0 + 0.6 * x, 4.65), (x, 3.85))
    for start, end in ((1.65, 2.0), (5.0, 3.4), (7.5, 4.5)):
        canvas.arrow((start, 2.55), (end, 1.55))
    canvas.arrow((8.2, 2.55), (6.9, 1.55))
    canvas.arrow((8.8, 2.55), (9.0, 1.55))
    canvas.arrow((7.6, 0.9), (8.15, 0.9))
    canvas.save(f"packages{suffix}.svg")


def draw_data(suffix: str) -> None:
    """The way of a step's numbers: three resting places, one copy each."""
    canvas = Canvas(10, 9.4, THEMES[suffix])
    canvas.box(1.6, 8.3, 2.8, "Policy", "torch", "torch")
    canvas.box(8.2, 8.3, 3.3, "Kernel arrays", "physics, crash,\nreward, clocks", "kernel")
    canvas.box(8.2, 4.9, 3.3, "Step", "torch views of\nthe same memory", "kernel")
    canvas.box(8.2, 1.2, 3.3, "Rollout", "num_steps x\nnum_envs", "torch")
    canvas.box(1.6, 1.2, 2.8, "PPO", "update", "torch")
    canvas.box(4.6, 3.6, 2.9, "Interactions", "crashed or\nsurvived", "torch")
    canvas.box(3.4, 5.9, 2.4, "Selector", "fear, choice", "torch")
    canvas.arrow((3.0, 8.3), (6.55, 8.3), "action (copy)")
    canvas.arrow((8.2, 7.65), (8.2, 5.55), "same memory")
    canvas.arrow((8.2, 4.25), (8.2, 1.85), "record (copy)")
    canvas.arrow((6.55, 1.2), (3.0, 1.2), "minibatches")
    canvas.arrow((6.55, 4.6), (6.05, 4.1))
    canvas.arrow((4.3, 4.25), (3.8, 5.25))
    canvas.arrow((4.0, 6.55), (6.6, 7.75), "goals that are due")
    canvas.arrow((0.7, 1.85), (0.7, 7.65), "weights")
    canvas.save(f"data{suffix}.svg")


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    plt.rcParams["svg.hashsalt"] = "deimos"  # the same file every time
    for theme in THEMES:
        draw_packages(theme)
        draw_data(theme)
