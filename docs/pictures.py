"""Train a policy for half a minute and draw the pictures of the concepts: ``python docs/pictures.py runs/pictures``.

Everything in them is that run's: the goals, the fear, the crashes and the scores. Each is drawn for light pages and, as
``NAME-dark.svg``, for dark ones, at the width of a phone. A folder that holds the run already is used as it is.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

import deimos
from deimos.goals import picks
from deimos.goals.fear_selector import fear_selector
from deimos.goals.selector import GoalSelector
from deimos.goals.selectors import uniform
from deimos.run import attack, evaluation, training
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop, spaces
from deimos.run.trainer import TrainConfig
from deimos.sim.envs.particle import HALF_SIDE

IMAGES = Path(__file__).parent / "images"
CPU = torch.device("cpu")
PERCENTILE = 75
SPEED = 10.0  # [u/step], the largest
T = 100  # [steps] that a goal is active
THEMES = {
    "": {"ink": "#1b2a33", "faint": "#8a969d", "blue": "#0072b2", "orange": "#d55e00", "green": "#008060",
         "paper": "#ffffff", "fear": "YlOrRd"},
    "-dark": {"ink": "#e6e9eb", "faint": "#85929a", "blue": "#62bdf0", "orange": "#ff9a4d", "green": "#3ec99b",
              "paper": "#131416", "fear": "inferno"},
}  # fmt: skip


@dataclass
class Film:
    """What happened in a few worlds under a selector's goals, step by step; arrays of shape (steps, worlds, ...)."""

    position: np.ndarray
    """[u]."""
    goal: np.ndarray
    """The goal that was active during the step [u/step]."""
    crashed: np.ndarray
    """Whether the step ended in a crash."""
    chosen: np.ndarray
    """Whether the goal was chosen: no first goal."""
    due: np.ndarray
    """Whether the goal had been active for T steps."""

    def outcomes(self) -> list[tuple[int, int, int, bool]]:
        """Of every goal that was chosen early enough to end in time: step, world, steps that it lasted, crashed."""
        goals = []
        for t, world in np.argwhere(self.due[:-T] & ~self.crashed[:-T]):
            hits = np.flatnonzero(self.crashed[t + 1 : t + T + 1, world])
            goals.append((int(t), int(world), int(hits[0]) + 1 if len(hits) else T, len(hits) > 0))
        return goals


@dataclass
class Scene:
    """The run, and what the pictures need of it."""

    run: Path
    ink: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        config = TrainConfig(method=f"p{PERCENTILE}", threads=1, device="cpu", evaluation=False)
        if not self.run.exists():
            deimos.train(config, out=self.run)
        self.config = config
        self.policy = deimos.load_policy(self.run).scaled
        trainer = training.load(RunFolder.open(self.run), training.read_config(RunFolder.open(self.run)))
        self.director = fear_selector(trainer.loop.selector)
        target = evaluation.make_target(self.policy, config.env, evaluation.EvalConfig(worlds=500), CPU)
        fear, _ = attack.learn_fear(target, target.steps, own_goals=False)
        env = config.env.build(500, CPU, 1)
        self.adversary = attack.argmax_director(env, fear)
        self.naive = uniform.Config().build(spaces(env), 0)
        self.films = {"naive": self.film(self.naive), "adversary": self.film(self.adversary)}

    @torch.no_grad()
    def film(self, selector: GoalSelector, worlds: int = 60, steps: int = 600) -> Film:
        """Record a few worlds."""
        env = self.config.env.build(worlds, CPU, 7)
        loop = GoalLoop(env, selector)
        frames = []
        for _ in range(steps):
            goal, chosen = env.goal.clone(), loop.interactions.active.clone()
            step = env.step(self.policy(env.obs))
            position = step.obs[:, 3:6] * HALF_SIDE
            frames.append((position.clone(), goal * SPEED, step.terminated.clone(), chosen, step.goal_due.clone()))
            loop.advance(step)
        return Film(*(torch.stack(column).numpy() for column in zip(*frames, strict=True)))

    def score(self, act: Callable[[torch.Tensor], torch.Tensor], selector: GoalSelector) -> float:
        """Return per step of a policy under a selector's goals."""
        env = self.config.env.for_evaluation().build(500, CPU, 3)
        return evaluation.play(env, act, selector, 1000)["return_per_step"]

    @torch.no_grad()
    def fear(self, distance: float, goals: np.ndarray) -> np.ndarray:
        """Probability of a crash within T steps for a particle that flies at a wall, x ahead, under new goals.

        Args:
            distance: To the wall [u].
            goals: Velocities along x and y [u/step], shape (n, 2).
        """
        state = torch.tensor([[0.8, 0.0, 0.0, 1.0 - distance / HALF_SIDE, 0, 0, 0, 0, 0]])
        new = torch.zeros(1, len(goals), 3)
        new[0, :, :2] = torch.from_numpy(goals / SPEED)
        logit = self.director.score(state, torch.tensor([[0.8, 0.0, 0.0]]), new)
        return self.director.calibration.probability(logit)[0].numpy()


@contextlib.contextmanager
def picture(scene: Scene, name: str, height: float = 2.9, width: float = 4.6) -> Iterator[tuple[Figure, Axes]]:
    """Axes to draw on in the theme of the scene; written on leaving."""
    ink = scene.ink
    style = {key: ink["ink"] for key in ("text.color", "axes.labelcolor", "xtick.color", "ytick.color")}
    style |= {"axes.edgecolor": ink["faint"], "axes.spines.top": False, "axes.spines.right": False, "font.size": 11}
    style |= {"figure.facecolor": ink["paper"], "axes.facecolor": ink["paper"], "svg.hashsalt": name}
    with plt.rc_context(style):
        figure, axes = plt.subplots(figsize=(width, height), layout="constrained")
        yield figure, axes
        figure.savefig(IMAGES / f"{name}{ink['suffix']}.svg", metadata={"Date": None}, dpi=120)
        plt.close(figure)


def draw_fear_map(scene: Scene) -> None:
    """Fear over the goals of a particle that flies at the wall, and what the Director picks."""
    ink = scene.ink
    line = np.linspace(-SPEED, SPEED, 101)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    candidates = np.random.default_rng(2).uniform(-SPEED, SPEED, (100, 2))
    danger = scene.fear(150.0, candidates)
    kept = np.argsort(danger)[-(100 - PERCENTILE) :]
    drawn = int(picks.above_percentile(torch.from_numpy(danger)[None], torch.tensor([0.4]), PERCENTILE))
    with picture(scene, "fear_map", 4.1) as (figure, axes):
        shades = axes.pcolormesh(
            line, line, scene.fear(150.0, grid).reshape(101, 101), cmap=ink["fear"], vmin=0, vmax=1, rasterized=True
        )
        figure.colorbar(shades, label="fear: probability of a crash", shrink=0.8, pad=0.02)
        axes.axvspan(SPEED + 0.3, SPEED + 1.3, color=ink["faint"])
        axes.text(SPEED + 0.8, 0, "wall", rotation=90, ha="center", va="center", color=ink["paper"], size=11)
        rim = {"edgecolors": "white", "linewidths": 0.8}
        axes.scatter(*candidates.T, s=20, color="#555555", label="possible goals", **rim)
        axes.scatter(*candidates[kept].T, s=30, color="#00a0ff", label=f"the {100 - PERCENTILE} most feared", **rim)
        axes.scatter(*candidates[drawn], s=150, marker="*", color="#00a0ff", label="one of them is drawn", **rim)
        axes.annotate("", (8, 0), (0, 0), arrowprops={"arrowstyle": "-|>", "lw": 2.5, "color": "#00b060"})
        axes.plot(0, 0, "o", color="#00b060", ms=9, mec="white", label="its velocity now")
        axes.set(xlim=(-SPEED, SPEED + 1.3), ylim=(-SPEED, SPEED), aspect="equal")
        axes.set(xlabel="goal: speed towards the wall", ylabel="goal: speed along the wall")
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=10, handletextpad=0.2)


def draw_goal(scene: Scene) -> None:
    """The path of a particle under four goals in turn."""
    film, ink = scene.films["naive"], scene.ink
    lengths = np.linalg.norm(film.goal[1:400:T, :, :2], axis=2).min(axis=0)  # goals along z would not be seen
    alone = np.argmax(np.where(film.crashed[:400].any(axis=0), 0.0, lengths))
    colours = [ink["blue"], ink["orange"], ink["green"], ink["ink"]]
    with picture(scene, "concepts/goal") as (_, axes):
        for i, colour in enumerate(colours):
            path = film.position[i * T : (i + 1) * T + 1, alone, :2]
            axes.plot(*path.T, color=colour, lw=2)
            way = film.goal[i * T + 1, alone, :2] / SPEED * 220
            axes.annotate(
                "", path[10] + way, path[10], arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.5, "ls": ":"}
            )
            clear = [withStroke(linewidth=4, foreground=ink["paper"])]  # where a path runs below the letters
            axes.annotate(
                f"goal {i + 1}", path[10] + 1.3 * way, color=colour, ha="center", va="center", path_effects=clear
            )
        axes.set(xlabel="x [u]", ylabel="y [u]", aspect="equal", adjustable="datalim")


def draw_interaction(scene: Scene) -> None:
    """Distance to the nearest wall after a goal was chosen: survived, and crashed."""
    film, ink = scene.films["adversary"], scene.ink
    distance = HALF_SIDE - np.abs(film.position).max(axis=2)
    crash = next(goal for goal in film.outcomes() if goal[3] and 20 < goal[2] < 90)
    near = next(
        goal for goal in film.outcomes() if not goal[3] and distance[goal[0] : goal[0] + T, goal[1]].min() < 120
    )
    with picture(scene, "concepts/interaction") as (_, axes):
        for (t, world, steps, _), colour, mark, text in (
            (near, ink["blue"], "o", "survived: label 0"),
            (crash, ink["orange"], "X", "crashed: label 1"),
        ):
            curve = distance[t : t + steps + 1, world].clip(min=0)
            axes.plot(curve, color=colour, lw=2)
            axes.plot(steps, curve[-1], mark, color=colour, ms=9, clip_on=False)
            axes.annotate(text, (8, curve[8]), (4, 6), textcoords="offset points", color=colour)
        axes.axhline(0, color=ink["faint"], lw=4)
        axes.set(xlabel=f"steps since the goal was chosen (T = {T})", ylabel="distance to the wall [u]", xlim=(0, 104))
        axes.set_ylim(bottom=0)


def clocks(film: Film) -> np.ndarray:
    """Steps that every goal has been active, shape (steps, worlds)."""
    clock, rows = np.zeros(film.due.shape[1], int), []
    for due, crashed in zip(film.due, film.crashed, strict=True):
        clock += 1
        rows.append(clock.copy())
        clock[due | crashed] = 0
    return np.array(rows)


def draw_due(scene: Scene) -> None:
    """The goal clocks of two worlds; a crash begins a new episode, and with it the clock."""
    film, ink = scene.films["adversary"], scene.ink
    first = np.where(film.crashed.any(axis=0), film.crashed.argmax(axis=0), len(film.crashed))
    with picture(scene, "concepts/due") as (_, axes):
        for world, colour, style in ((first.argmax(), "blue", "-"), (first.argmin(), "orange", "--")):
            clock = clocks(film)[:450, world]
            axes.plot(clock, color=ink[colour], lw=2, ls=style)
            at = np.flatnonzero(film.due[:450, world])
            axes.plot(at, clock[at], "o", color=ink[colour], ms=8)
            for t in np.flatnonzero(film.crashed[:450, world]):
                axes.plot(t, clock[t], "X", color=ink[colour], ms=10)
                axes.annotate("crash", (t, clock[t]), (6, 4), textcoords="offset points", color=ink[colour])
        axes.axhline(T, color=ink["faint"], lw=1, ls=":")
        axes.annotate("due", (0, T), (2, 4), textcoords="offset points")
        axes.set(xlabel="step", ylabel="goal active for [steps]", ylim=(0, 1.2 * T), xlim=(0, 450))


def draw_first_goal(scene: Scene) -> None:
    """The goals of six worlds one after the other, by kind and outcome."""
    film, ink = scene.films["adversary"], scene.ink
    order = np.argsort(film.crashed.sum(axis=0), kind="stable")
    worlds = order[np.linspace(0, len(order) - 1, 6).astype(int)]
    kinds = {"first goal": ink["faint"], "survived": ink["blue"], "crashed": ink["orange"]}
    with picture(scene, "concepts/first_goal", 3.1) as (figure, axes):
        for row, world in enumerate(worlds):
            ends = np.flatnonzero(film.due[:, world] | film.crashed[:, world]) + 1
            for start, end in zip([0, *ends[:-1]], ends, strict=True):
                chosen, crashed = film.chosen[end - 1, world], film.crashed[end - 1, world]
                kind = "crashed" if chosen and crashed else "survived" if chosen else "first goal"
                axes.barh(row, end - start - 3, left=start, height=0.62, color=kinds[kind])
                if crashed:
                    axes.plot(end - 2, row, "X", color=ink["ink"], ms=8)
        figure.legend(
            [plt.Rectangle((0, 0), 1, 1, color=colour) for colour in kinds.values()], kinds,
            loc="outside upper center", ncols=3, frameon=False, handlelength=1.0, columnspacing=1.2,
        )  # fmt: skip
        axes.set(xlabel="step", ylabel="world", yticks=[])


def draw_fear(scene: Scene) -> None:
    """Fear of a speed towards the wall, from three distances."""
    ink = scene.ink
    speed = np.linspace(-SPEED, SPEED, 101)
    goals = np.stack([speed, 0 * speed], axis=1)
    with picture(scene, "concepts/fear") as (_, axes):
        for distance, colour, style in ((150.0, "orange", "-"), (400.0, "blue", "--"), (800.0, "green", ":")):
            axes.plot(
                speed, scene.fear(distance, goals), color=ink[colour], ls=style, lw=2.2, label=f"{distance:g} u away"
            )
        axes.set(xlabel="goal: speed towards the wall [u/step]", ylabel="fear", ylim=(0, 1), xlim=(-SPEED, SPEED))
        axes.legend(frameon=False, loc="upper left")


def draw_director(scene: Scene) -> None:
    """A hundred candidates in the order of their fear, and those that the Director draws from."""
    ink = scene.ink
    danger = np.sort(scene.fear(150.0, np.random.default_rng(2).uniform(-SPEED, SPEED, (100, 2))))
    with picture(scene, "concepts/director") as (_, axes):
        bars = axes.bar(np.arange(100), danger, width=0.8, color=ink["faint"])
        for bar in bars[PERCENTILE:]:
            bar.set_color(ink["blue"])
        axes.axvline(PERCENTILE - 0.5, color=ink["ink"], lw=1, ls="--")
        axes.annotate("discarded", (PERCENTILE / 2, 0.9), ha="center", color=ink["ink"])
        axes.annotate("drawn\nfrom", (PERCENTILE + 12, 0.86), ha="center", color=ink["blue"])
        axes.set(
            xlabel="100 candidates, by their fear", ylabel="fear", ylim=(0, 1), xlim=(-1, 100), xticks=[0, 75, 100]
        )


def draw_evaluations(scene: Scene) -> None:
    """The same worlds of the same policy under uniform goals and under the Adversary's."""
    ink = scene.ink
    for name, film in scene.films.items():
        share = np.mean([crashed for *_, crashed in film.outcomes()])
        with picture(scene, f"concepts/{name}", 3.7, 4.0) as (_, axes):
            for world in range(film.position.shape[1]):
                path = film.position[::6, world, :2].copy()
                path[1:][np.abs(np.diff(path, axis=0)).max(axis=1) > 6 * SPEED + 1] = np.nan  # a reset is no way
                axes.plot(*path.T, color=ink["blue"], lw=0.6, alpha=0.5, rasterized=True)
            hits = film.position[film.crashed][:, :2].clip(-HALF_SIDE, HALF_SIDE)
            axes.plot(*hits.T, "X", color=ink["orange"], ms=6, ls="none", alpha=0.8)
            axes.add_patch(
                plt.Rectangle((-HALF_SIDE, -HALF_SIDE), *2 * [2 * HALF_SIDE], fill=False, ec=ink["ink"], lw=2)
            )
            axes.set_title(f"{100 * share:.1f} % of goals end in a crash", size=11)
            axes.set(xlabel="x [u]", ylabel="y [u]", aspect="equal", xlim=(-1060, 1060), ylim=(-1060, 1060))


def draw_score(scene: Scene) -> None:
    """Where policies lie between one that does nothing and the scripted one that brakes."""
    ink = scene.ink
    env = scene.config.env.for_evaluation().build(1, CPU, 0)
    low = scene.score(lambda obs: torch.zeros(len(obs), 3), scene.naive)
    high = scene.score(env.reference_policy(), scene.naive)
    rows = {
        "does nothing": low,
        "follows, never brakes": scene.score(env.reference_policy(brake=False), scene.naive),
        "this policy, Naive": scene.score(scene.policy, scene.naive),
        "this policy, Adversary": scene.score(scene.policy, scene.adversary),
        "follows and brakes": high,
    }
    colours = [ink["faint"], ink["orange"], ink["blue"], ink["blue"], ink["faint"]]
    with picture(scene, "concepts/score", 2.7) as (_, axes):
        values = [(value - low) / (high - low) for value in rows.values()]
        bars = axes.barh(list(rows), values, color=colours, height=0.6)
        axes.bar_label(bars, [f"{value:.2f}" for value in values], padding=4)
        axes.axvline(0, color=ink["ink"], lw=1)
        axes.axvline(1, color=ink["ink"], lw=1, ls=":")
        axes.margins(x=0.3)
        axes.set(xlabel="score")


def main() -> None:
    """Draw everything, twice."""
    (IMAGES / "concepts").mkdir(parents=True, exist_ok=True)
    scene = Scene(Path(sys.argv[1]))
    for suffix, colours in THEMES.items():
        scene.ink = colours | {"suffix": suffix}
        for draw in (
            draw_fear_map, draw_goal, draw_interaction, draw_due, draw_first_goal, draw_fear, draw_director,
            draw_evaluations, draw_score,
        ):  # fmt: skip
            draw(scene)


if __name__ == "__main__":
    main()
