"""``deimos play``: watch a trained policy, as a video or as single pictures."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from deimos.app import console
from deimos.app.drawing import Drawing, with_caption
from deimos.app.findings import percent
from deimos.app.video import pictures, video
from deimos.checks import RunError, check_at_least, check_positive, check_range
from deimos.goals.fear_selector import FearSelector
from deimos.goals.selectors import uniform
from deimos.learn.policy import Policy
from deimos.nn.layout import goal_field
from deimos.run.loop import GoalLoop, spaces
from deimos.run.saved import SavedRun
from deimos.sim.env import Env

LARGEST = 8192  # [pixels] along a side of a picture
PACE = 50.0  # steps per second of video, in worlds that have no seconds
RED = np.array([0.9, 0.15, 0.1, 0.9], np.float32)


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Render the policy of a run in one world under uniform goals; pictures have the goal and its crash probability.

    Robots are rendered without a display: MUJOCO_GL says how (egl or osmesa; Debian has libegl1 and libosmesa6).
    Particles are drawn, with their trail in blue, their goal in orange and a cross where they crashed.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    video: Path | None = None
    """Video to write: .mp4, .mkv, .mov, .webm, .gif or .webp."""
    frames: Path | None = None
    """Folder for single pictures (.png) instead; must not exist."""
    seconds: float = 10.0
    """Length of the video [s], positive: simulated seconds, or 50 steps each where the world has no seconds."""
    fps: float = 25.0
    """Pictures per second, positive."""
    width: int = 640
    """Width of a picture [pixels], in [16, 8192]."""
    height: int = 480
    """Height of a picture [pixels], in [16, 8192]."""
    world: int = 0
    """Global number of the world, at least 0: where it stands, and which goals it gets."""
    goal_period: int | None = None
    """T: steps that a goal is active. By default as in training."""
    seed: int = 1_000_003
    """Seed of the world and its goals, in [0, 2^32)."""

    def __post_init__(self) -> None:
        for name in ("seconds", "fps"):
            check_positive(name, getattr(self, name), finite=True)
        for name in ("width", "height"):
            check_range(name, getattr(self, name), 16, LARGEST)
        check_at_least("world", self.world, 0)
        check_range("seed", self.seed, 0, 2**32 - 1)
        if self.goal_period is not None:
            check_at_least("goal_period", self.goal_period, 1)
        if (self.video is None) == (self.frames is None):
            raise ValueError("Give either --video FILE or --frames FOLDER.")

    @property
    def target(self) -> Path:
        """Where the pictures go."""
        target = self.video or self.frames
        assert target is not None
        return target


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos play``."""
    options: PlayOptions = console.parse(PlayOptions, arguments, program)
    console.quiet_warp()
    choose_renderer()
    run = SavedRun.open(options.run, options.goal_period)
    if run.has_robots:
        with rendering():
            import mujoco  # noqa: F401 (it decides now how it will render)
    env = run.build(1, options.seed, options.world)
    _render(env, run.policy(env), run.fear(env), options)
    print(options.target)


def _render(env: Env, policy: Policy, afraid: FearSelector | None, options: PlayOptions) -> None:
    """Let the policy act under uniform goals, and write the pictures."""
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0))
    seconds = env.dt if env.has_seconds else 1.0 / PACE  # of a step
    every, count = (max(1, round(time / seconds)) for time in (1.0 / options.fps, options.seconds))
    size, fps, crashes = (options.width, options.height), 1.0 / (every * seconds), 0
    writer = video(options.video, size, fps) if options.video else pictures(options.target)
    with _view(env, *size) as picture, writer as write, console.progress("rendering") as report:
        for t in range(count):
            if t % every == 0:
                write(with_caption(picture(), _caption(env, afraid, t, crashes)))
                report(f"step {t} of {count}", t / count)
            step = env.step(policy.scaled(env.obs))
            crashes += int(step.terminated[0])
            loop.advance(step)
    env.check()


def choose_renderer() -> None:
    """Have MuJoCo render without a display, as the user says or by EGL; call it before MuJoCo is imported."""
    if sys.platform.startswith("linux"):
        os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL") or "egl"


@contextmanager
def rendering() -> Iterator[None]:
    """Turn whatever goes wrong into a ``RunError`` that says how to render, but for a missing MuJoCo."""
    try:
        yield
    except Exception as error:  # of MuJoCo, PyOpenGL and what they load: ImportError, AttributeError, GLError, ...
        if isinstance(error, ModuleNotFoundError) and error.name == "mujoco":
            raise
        raise RunError(
            f"Nothing can be rendered with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({error}); "
            "install libegl1 or libosmesa6 and set MUJOCO_GL=egl or osmesa."
        ) from error


def _caption(env: Env, afraid: FearSelector | None, t: int, crashes: int) -> str:
    goal = env.obs[:, env.goal_slice]
    field = goal_field(env.layout)
    physical = (goal[0] / torch.as_tensor(field.scale)).round(decimals=2) + 0.0  # never "-0.00"
    now = f"{t * env.dt:5.2f} s" if env.has_seconds else f"step {t}"
    values = "  ".join(f"{value:+.2f}" for value in physical.tolist())
    text = f"{now}   crashes {crashes}   goal {values}  [{field.unit}]"
    if afraid is None:
        return text
    score = afraid.score(env.state(env.obs), goal, goal.unsqueeze(1))[:, 0]
    return text + f"\npredicted crash probability of this goal {percent(afraid.calibration.probability(score).item())}"


@contextmanager
def _view(env: Env, width: int, height: int) -> Iterator[Callable[[], np.ndarray]]:
    """Gives the function that shows world 0: by MuJoCo where it can, else as a drawing."""
    if (shown := env.scene(0)) is None:
        if env.sketch(0) is None:
            raise RunError("This environment has nothing to render: neither a scene nor a sketch.")
        yield Drawing(env, width, height)
        return
    import mujoco

    model = shown[0]
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    with rendering():
        renderer = mujoco.Renderer(model, height, width)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 1.8, 130.0, -18.0

    def picture() -> np.ndarray:
        found = env.scene(0)
        assert found is not None
        camera.lookat[:] = found[1].qpos[:3]
        renderer.update_scene(found[1], camera)
        point, scene = env.goal_point(0), renderer.scene
        if point is not None and scene.ngeom < scene.maxgeom:
            ball, size, turn = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.025, 0.0, 0.0]), np.eye(3).ravel()
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], ball, size, point.astype(float), turn, RED)
            scene.ngeom += 1
        return renderer.render()

    with renderer:
        yield picture
