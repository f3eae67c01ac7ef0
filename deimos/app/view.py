"""``deimos view``: a policy at work in the browser, live; even while its training is still running."""

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from deimos.app import console
from deimos.app.findings import percent
from deimos.app.playback import LARGEST
from deimos.app.viewer_panel import Moment, Panel
from deimos.app.viewer_scene import Scene, build_scene, palette, shades
from deimos.app.viewer_session import UNIFORM, Session, prepare
from deimos.app.viewer_web import HOST, check_port, serve
from deimos.checks import RunError, check_at_least, check_positive, check_range, check_seed
from deimos.goals.shield import Mode
from deimos.run.attack import names as attacker_names
from deimos.run.saved import SavedRun
from deimos.run.video import require_video, video
from deimos.sim.drawing import with_caption
from deimos.sim.rendering import choose_renderer, load_renderer, renderer

PATIENCE = 1.0  # [s] between two looks at whether the run has written a checkpoint
SIDE_OF_MAP = 0.3  # of a picture's height, in its corner


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Watch the policy of a run in the browser, and drive it; the page is served on 127.0.0.1 alone.

    The panel has a slider for every component of the goal, pause, step and reset, and a map of how likely each goal is
    to end in a crash, by the run's own fear network. Whenever the run writes a checkpoint, it is loaded.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    port: int = 0
    """Port of the page, in [0, 65535]; 0 takes the first free one from 8080 on."""
    goals: str = UNIFORM
    """Who chooses the goals at first: uniform, the method of the run if it has a fear network, or an attacker."""
    attackers: tuple[str, ...] = ()
    """Attackers that may choose the goals: argmax, scripted, ... One that learns does so before the page opens; if the
    run has no fear network, the map shows what the attacker has learnt."""
    pool: Path | None = None
    """File of the attacker pooled, made by ``deimos pool``. By default as the run was set up."""
    shield: Mode | None = None
    """Have the run's shield, which deimos shield makes, check every goal before the policy gets it, including those set
    by hand: what becomes of a goal that it refuses."""
    attacker_worlds: int = 256
    """Worlds that attackers learn in, at least 1."""
    terrain: str | None = None
    """What robots stand on, as --env.terrain; by default the ground that they were trained on."""
    worlds: int | None = None
    """Worlds side by side, at least 1: by default 8 particles or one robot. Of several robots only the first is
    shown."""
    world: int = 0
    """Global number of the first world, at least 0: where it stands, and which goals it gets."""
    goal_period: int | None = None
    """T: steps that a goal is active. By default as in training."""
    seed: int = 1_000_003
    """Seed of the worlds and their goals, in [0, 2^32)."""
    record: Path | None = None
    """Video to write meanwhile: .mp4, .mkv, .mov, .webm, .gif or .webp; an existing one is replaced. Pauses are left
    out."""
    seconds: float | None = None
    """End after this many simulated seconds, of 50 steps each in worlds without units of time; by default it runs until
    stopped."""
    fps: float = 25.0
    """Changes of the panel, and pictures of the video, per second, positive."""
    width: int = 640
    """Width of the video [pixels], in [16, 8192]."""
    height: int = 480
    """Height of the video [pixels], in [16, 8192]."""

    def __post_init__(self) -> None:
        check_range("port", self.port, 0, 65535)
        for name in ("attacker_worlds", "worlds", "goal_period"):
            if getattr(self, name) is not None:
                check_at_least(name, getattr(self, name), 1)
        check_at_least("world", self.world, 0)
        check_seed(self.seed)
        for name in ("fps", "seconds"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name), finite=True)
        for name in ("width", "height"):
            check_range(name, getattr(self, name), 16, LARGEST)


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos view``."""
    options: ViewOptions = console.parse(ViewOptions, arguments, program)
    console.quiet_warp()
    if options.record:
        require_video(options.record)
        choose_renderer()
        load_renderer()
    run = SavedRun.open(options.run, options.goal_period, options.terrain)
    check_port(options.port)
    worlds = options.worlds or (1 if run.has_robots else 8)
    session = Session(run, worlds, options.seed, options.world, shield=options.shield)
    if options.goals not in (*session.names, *options.attackers):
        possible = sorted({*session.names[:-1], *attacker_names()})
        raise RunError(
            f"Unknown value '{options.goals}' for --goals; choose from: {', '.join(session.names[:-1])}, and with "
            f"--attackers: {', '.join(possible)}."
        )
    with console.progress("attackers learn") as report:  # takes minutes, so everything has been checked before
        attacks, afraid = prepare(run, options.attackers, options.attacker_worlds, report, options.pool)
    session.add_attackers(attacks, afraid)
    session.choose(options.goals)
    watch(session, options)


def watch(session: Session, options: ViewOptions) -> None:
    """Show a session until it is stopped, the viewer is closed, or ``options.seconds`` have passed."""
    scene = build_scene(session)
    panel = Panel(scene)
    left: KeyboardInterrupt | None = None
    with ExitStack() as stack:
        write = stack.enter_context(_recorder(session, scene, options)) if options.record else lambda moment: None
        handle, port = stack.enter_context(serve(panel, options.port))
        print(f"http://{HOST}:{port}/ (Ctrl+C ends)", file=sys.stderr)
        if session.fear is None:
            advice = "none of the attackers has learnt one" if options.attackers else "--attackers argmax trains one"
            print(f"There is no fear network for a map: {advice}.", file=sys.stderr)
        try:
            simulate(session, scene, panel, handle, write, fps=options.fps, seconds=options.seconds)
        except KeyboardInterrupt as interrupt:  # this is how users leave; a video is kept
            left = interrupt
    if options.record:
        print(options.record)
    if isinstance(left, console.Stopped):
        raise left


def simulate(
    session: Session, scene: Scene, panel: Panel, handle: Any, write: Callable[[Moment], object], *,
    fps: float, seconds: float | None,
) -> None:  # fmt: skip
    """Let a session run at the pace of real time, until its viewer is closed.

    A machine that is too slow falls behind instead of hurrying afterwards.

    Args:
        session: What runs.
        scene: What is shown of it.
        panel: The panel next to it.
        handle: The viewer, from ``serve``.
        write: Takes every moment that the panel shows, unless it is paused.
        fps: Moments per second, positive.
        seconds: Duration, positive, in the seconds of the simulation; ``None`` for no end.
    """
    every = _stride(session, fps)
    due = looked = time.monotonic()
    for tick in itertools.count():
        if seconds is not None and session.steps * session.seconds_per_step >= seconds:
            return
        for command in panel.commands():
            command(session)
        if not session.paused:
            session.step()
        scene.update()
        if tick % every == 0:
            moment = Moment.of(session, scene)
            panel.show(moment)
            if not session.paused:
                write(moment)
        if not handle.is_running():
            return
        handle.sync(scene.model, scene.data)
        now = time.monotonic()
        if now - looked > PATIENCE:
            looked = now
            session.reload()
        due = max(due + session.seconds_per_step, now)
        panel.wait(due - now)


def _stride(session: Session, fps: float) -> int:
    """Steps from one moment that is shown to the next."""
    return max(1, round(1.0 / (fps * session.seconds_per_step)))


@contextmanager
def _recorder(session: Session, scene: Scene, options: ViewOptions) -> Iterator[Callable[[Moment], object]]:
    """Gives what writes a moment into the video: the scene, its caption, and the map of fear in a corner."""
    assert options.record is not None
    import mujoco

    camera, colours = mujoco.MjvCamera(), np.round(255 * palette()).astype(np.uint8)
    camera.distance, camera.azimuth, camera.elevation = scene.distance, 130.0, scene.elevation
    fps = 1.0 / (_stride(session, options.fps) * session.seconds_per_step)
    size = (options.width, options.height)
    with renderer(scene.model, *size) as drawn, video(options.record, size, fps) as send:

        def write(moment: Moment) -> None:
            camera.lookat[:] = scene.data.xpos[scene.body]
            drawn.update_scene(scene.data, camera)
            room = drawn.scene.geoms[drawn.scene.ngeom : drawn.scene.maxgeom]
            for slot, geom in zip(room, moment.shapes, strict=False):
                mujoco.mjv_initGeom(slot, geom.type, np.zeros(3), np.zeros(3), np.eye(3).ravel(), geom.rgba)
                slot.size, slot.pos, slot.mat = geom.size, geom.pos, geom.mat
                drawn.scene.ngeom += 1
            picture = drawn.render().copy()
            if moment.fear is not None:
                inset = colours[shades(moment.fear)[::-1]]
                times = max(1, round(SIDE_OF_MAP * options.height / len(inset)))
                inset = inset.repeat(times, axis=0).repeat(times, axis=1)[: options.height, : options.width]
                picture[-len(inset) :, -len(inset[0]) :] = inset
            send(with_caption(picture, caption(moment)))

        yield write


def caption(moment: Moment) -> str:
    """The text in the corner of a picture: the time, who chooses the goals, the goal and its risk."""
    goal = "  ".join(f"{value + 0.0:+.2f}" for value in np.round(moment.goal, 2))
    lines = [moment.text[0], f"goals: {moment.current}   {goal}", *moment.text[2:]]
    if moment.risk is not None:
        lines.append(f"{moment.risk_name} {percent(moment.risk)}")
    return "\n".join(lines)
