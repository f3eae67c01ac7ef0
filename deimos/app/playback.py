"""``deimos play``: watch a trained policy, as a video or as single pictures."""

import itertools
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
from deimos.checks import RunError, check_at_least, check_positive
from deimos.goals.fear_selector import FearSelector, fear_selector
from deimos.goals.selectors import uniform
from deimos.learn.policy import load_policy
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop, spaces
from deimos.run.trainer import TrainConfig
from deimos.run.training import load_checkpoint, read_config
from deimos.sim.env import Env

RED = np.array([0.9, 0.15, 0.1, 0.9], np.float32)


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Render the policy of a run in one world under uniform goals; the goal and its fear are written in the picture.

    It renders without a display: MUJOCO_GL says how (egl or osmesa; Debian has libegl1 and libosmesa6).
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    video: Path | None = None
    """Video to write (.mp4, .gif, ...)."""
    frames: Path | None = None
    """Folder for single pictures instead; must not exist."""
    seconds: float = 10.0
    """Simulated time [s], positive."""
    fps: float = 25.0
    """Pictures per simulated second, positive."""
    width: int = 640
    """Width of a picture [pixels], at least 16."""
    height: int = 480
    """Height of a picture [pixels], at least 16."""
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
            check_at_least(name, getattr(self, name), 16)
        check_at_least("world", self.world, 0)
        if (self.video is None) == (self.frames is None):
            raise ValueError("Give one of --video FILE and --frames FOLDER.")


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos play``."""
    options: PlayOptions = console.parse(PlayOptions, arguments, program)
    console.quiet_warp()
    if sys.platform.startswith("linux"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    with _rendering():
        import mujoco  # noqa: F401 (it decides now how it will render)
    folder = RunFolder.open(options.run)
    config = read_config(folder)
    policy = load_policy(folder.path)
    env_config = config.env.for_evaluation()
    if options.goal_period is not None:
        env_config = env_config.with_goal_period(options.goal_period)
    try:
        env = env_config.build(1, torch.device("cpu"), options.seed, options.world)
    except ValueError as error:
        raise RunError(str(error)) from error
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0))
    afraid = _fear(folder, config, env)
    every = max(1, round(1.0 / (options.fps * env.dt)))
    with _camera(env, options) as picture, _writer(options, 1.0 / (every * env.dt)) as write:
        for t in range(round(options.seconds / env.dt)):
            if t % every == 0:
                write(_captioned(picture(), _caption(env, afraid, t)))
            loop.advance(env.step(policy.scaled(env.obs)))
    env.check()
    print(options.video or options.frames)


@contextmanager
def _rendering() -> Iterator[None]:
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


def _fear(folder: RunFolder, config: TrainConfig, env: Env) -> FearSelector | None:
    """The selector with the fear network that the run has learnt, if it has one."""
    afraid = fear_selector(config.goals.build(spaces(env, config.env_steps), config.seed))
    if afraid is None or afraid.parts:
        return None
    state = load_checkpoint(folder)["loop"]["selector"]
    if "fear" not in state:  # it is a part of another selector
        return None
    for name in ("fear", "calibration"):  # what else there is depends on the version that wrote it
        getattr(afraid, name).load_state_dict(state[name])
    return afraid if afraid.fear.fitted else None


def _caption(env: Env, afraid: FearSelector | None, t: int) -> str:
    goal = env.obs[:, env.goal_slice]
    field = next(field for field in env.layout if field.name == "goal")
    physical = (goal[0] / torch.as_tensor(field.scale)).tolist()
    text = f"{t * env.dt:5.2f} s   goal " + "  ".join(f"{value:+.2f}" for value in physical) + f"  [{field.unit}]"
    if afraid is None:
        return text
    score = afraid.score(env.state(env.obs), goal, goal.unsqueeze(1))[:, 0]
    return text + f"\nfear of keeping it {afraid.calibration.probability(score).item():.3f}"


@contextmanager
def _camera(env: Env, options: PlayOptions) -> Iterator[Callable[[], np.ndarray]]:
    """A camera that follows the robot of world 0 and shows its goal, where it is a point, as a red ball."""
    import mujoco

    shown = env.scene(0)
    if shown is None:
        raise RunError("This environment has nothing to render; play shows robots.")
    model = shown[0]
    model.vis.global_.offwidth, model.vis.global_.offheight = options.width, options.height
    with _rendering():
        renderer = mujoco.Renderer(model, options.height, options.width)
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


def _captioned(picture: np.ndarray, text: str) -> np.ndarray:
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    box = draw.multiline_textbbox((8, 6), text, font_size=14)
    draw.rectangle((0, 0, box[2] + 8, box[3] + 6), fill=(255, 255, 255))
    draw.multiline_text((8, 6), text, fill=(20, 20, 20), font_size=14)
    return np.asarray(image)


@contextmanager
def _writer(options: PlayOptions, fps: float) -> Iterator[Callable[[np.ndarray], object]]:
    """Writes pictures one after another; a video that is cut off does not stay."""
    if options.frames is not None:
        from PIL import Image

        folder = options.frames
        try:
            folder.mkdir(parents=True)
        except FileExistsError as error:
            raise RunError(f"{folder} exists already; name another folder.") from error
        number = itertools.count()
        yield lambda picture: Image.fromarray(picture).save(folder / f"{next(number):06d}.png")
        return
    import imageio_ffmpeg

    assert options.video is not None
    if not options.video.parent.is_dir():
        raise RunError(f"The folder of {options.video} does not exist.")
    unfinished = options.video.with_name(f".unfinished-{options.video.name}")
    video = imageio_ffmpeg.write_frames(
        str(unfinished), (options.width, options.height), fps=fps, macro_block_size=2, ffmpeg_log_level="error"
    )
    video.send(None)
    try:
        yield lambda picture: video.send(np.ascontiguousarray(picture))
        video.close()
        unfinished.replace(options.video)
    finally:
        video.close()
        unfinished.unlink(missing_ok=True)
