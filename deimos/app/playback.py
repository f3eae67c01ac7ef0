"""``deimos play``: watch a trained policy, as a video or as single pictures."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from deimos.app import console
from deimos.app.findings import percent, risk_name
from deimos.checks import check_at_least, check_positive, check_range, check_seed
from deimos.goals.fear_selector import FearSelector
from deimos.learn.policy import Policy
from deimos.run.film import SEED, caption, film, timing
from deimos.run.saved import SavedRun
from deimos.run.video import pictures, video
from deimos.sim.env import Env
from deimos.sim.rendering import choose_renderer, load_renderer

LARGEST = 8192  # [pixels] along a side of a picture


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Render the policy of a run in one world under uniform goals; pictures show the goal and its crash probability.

    Robots are rendered without a display: MUJOCO_GL says how (egl or osmesa; Debian has libegl1 and libosmesa6).
    Particles are drawn, with their trail in blue, their goal in orange and a cross where they crashed.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    video: Path | None = None
    """Video to write: .mp4, .mkv, .mov, .webm, .gif or .webp; an existing one is replaced."""
    frames: Path | None = None
    """Folder for single pictures (.png) instead; must not exist."""
    seconds: float = 10.0
    """Length of the video [s], positive: simulated seconds, of 50 steps each in worlds without units of time."""
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
    seed: int = SEED
    """Seed of the world and its goals, in [0, 2^32)."""

    def __post_init__(self) -> None:
        for name in ("seconds", "fps"):
            check_positive(name, getattr(self, name), finite=True)
        for name in ("width", "height"):
            check_range(name, getattr(self, name), 16, LARGEST)
        check_at_least("world", self.world, 0)
        check_seed(self.seed)
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
        load_renderer()
    env = run.build(1, options.seed, options.world)
    _render(env, run.policy(env), run.fear(env), options)
    print(options.target)


def _render(env: Env, policy: Policy, afraid: FearSelector | None, options: PlayOptions) -> None:
    """Let the policy act under uniform goals, and write the pictures."""
    every, count, fps = timing(env, options.fps, options.seconds)
    size = (options.width, options.height)
    writer = video(options.video, size, fps) if options.video else pictures(options.target)

    def text(t: int, crashes: int) -> str:
        return caption(env, t, crashes) + _risk(env, afraid)

    with console.progress("rendering") as report:
        for t in film(env, policy, writer, size, every, count, text):
            report(f"step {t} of {count}", t / count)


def _risk(env: Env, afraid: FearSelector | None) -> str:
    """A line that says how likely the goal of world 0 is to end in a crash; empty without a fear network."""
    if afraid is None:
        return ""
    goal = env.obs[:, env.goal_slice]
    score = afraid.score(env.state(env.obs), goal, goal.unsqueeze(1))[:, 0]
    return f"\n{risk_name(afraid)} of this goal {percent(afraid.calibration.probability(score).item())}"
