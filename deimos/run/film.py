"""Pictures of a policy in action. ``python -m deimos.run.film RUN POLICY VIDEO`` makes a clip for the logs of a run.

``deimos.run.clips`` makes clips in a separate process: MuJoCo's renderer is chosen when it is imported, and a crash of
OpenGL or a codec must not end the training.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import torch

from deimos.checks import RunError, one_line
from deimos.goals.selectors import uniform
from deimos.learn.policy import Policy, load_policy
from deimos.nn.layout import goal_field
from deimos.run.loop import GoalLoop, spaces
from deimos.run.saved import SavedRun
from deimos.run.video import Write, video
from deimos.sim.drawing import with_caption
from deimos.sim.env import Env
from deimos.sim.rendering import choose_renderer, load_renderer, view

PACE = 50.0  # steps per second of video, in environments without seconds
SEED = 1_000_003  # of the world that is shown, and of its goals
SIZE = (320, 240)  # of a clip for the logs [pixels]
SECONDS, FPS = 4.0, 12.5  # of such a clip

Caption = Callable[[int, int], str]
"""The caption of a picture, from the step and the number of crashes so far."""


def seconds_per_step(env: Env) -> float:
    """How long a step is shown [s]."""
    return env.dt if env.has_seconds else 1.0 / PACE


def timing(env: Env, fps: float, seconds: float) -> tuple[int, int, float]:
    """Steps from one picture to the next and in all, at least 1, and the pictures per second that follow from it.

    Args:
        env: The environment.
        fps: Pictures per second, positive.
        seconds: Length of the video [s], positive.
    """
    step = seconds_per_step(env)
    every, count = (max(1, round(time / step)) for time in (1.0 / fps, seconds))
    return every, count, 1.0 / (every * step)


def film(
    env: Env, policy: Policy, writer: AbstractContextManager[Write], size: tuple[int, int], every: int, count: int,
    caption: Caption,
) -> Iterator[int]:  # fmt: skip
    """Let a policy act under uniform goals, and write pictures of world 0; yield the step of each one written.

    Args:
        env: The worlds.
        policy: The policy.
        writer: Takes the pictures.
        size: Width and height [pixels].
        every: Steps from one picture to the next.
        count: Steps in all.
        caption: Their captions.

    Raises:
        RunError: If there is nothing to render, or nothing to render with.
    """
    loop, crashes = GoalLoop(env, uniform.Config().build(spaces(env), 0)), 0
    with view(env, *size) as picture, writer as write:
        for t in range(count):
            if t % every == 0:
                write(with_caption(picture(), caption(t, crashes)))
                yield t
            step = env.step(policy.scaled(env.obs))
            crashes += int(step.terminated[0])
            loop.advance(step)
    env.check()


def caption(env: Env, t: int, crashes: int) -> str:
    """Time, crashes and goal, in physical units, of world 0."""
    field = goal_field(env.layout)
    physical = (env.obs[0, env.goal_slice] / torch.as_tensor(field.scale)).round(decimals=2) + 0.0  # never "-0.00"
    now = f"{t * env.dt:5.2f} s" if env.has_seconds else f"step {t}"
    values = "  ".join(f"{value:+.2f}" for value in physical.tolist())
    return f"{now}   crashes {crashes}   goal {values}  [{field.unit}]"


def main(arguments: list[str]) -> int:
    """Make a clip of what the arguments name; return the exit code. If it fails, one line on stderr says why."""
    path, policy, target = map(Path, arguments)
    torch.set_num_threads(1)
    choose_renderer()
    try:
        run = SavedRun.open(path)
        if run.has_robots:
            load_renderer()
        env = run.build(1, SEED, 0)
        every, count, fps = timing(env, FPS, SECONDS)
        shots = film(
            env, load_policy(policy), video(target, SIZE, fps), SIZE, every, count,
            lambda t, crashes: caption(env, t, crashes),
        )  # fmt: skip
        for _ in shots:
            pass
    except (ImportError, RunError) as error:
        print(one_line(error), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
