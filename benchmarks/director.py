"""What ``deimos.GoalDirector`` costs in another training loop, per step of its worlds."""

import contextlib
import io
import runpy
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from benchmarks.timing import in_turn, short, wide_console
from deimos.goals.director import GoalDirector
from deimos.goals.fear_selector import fear_selector

SIZES = (1, 64, 4096, 65536)  # worlds
PERIOD, CANDIDATES = 100, 100
STATE, GOAL = 9, 3  # components, as in Particle Gym
CRASHES = 0.001  # per world and step
DRAWN, OBSERVED = "candidates drawn", "their clock"
WAYS = ("uniform", "p25", "rnd", f"p25, {DRAWN}", f"p25, {OBSERVED}")
EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
WARM_UP = 100  # at most so many periods until a fear network has learnt


def measure(
    device: torch.device, rounds: int, sizes: tuple[int, ...] = SIZES, period: int = PERIOD,
    ways: tuple[str, ...] = WAYS,
) -> dict[str, Any]:  # fmt: skip
    """Microseconds of a step, and world-steps per second, for some numbers of worlds, learning included.

    Args:
        device: Where.
        rounds: Rounds of T steps over which figures are medians.
        sizes: Numbers of worlds.
        period: T, in steps.
        ways: Methods, on the Director's own clock with candidates from the loop, unless ``DRAWN`` or ``OBSERVED``
            follows the name.
    """
    rows = []
    for num_envs in sizes:
        work = {way: periods(way, num_envs, period, device) for way in ways}
        seconds = {way: statistics.median(times) for way, times in in_turn(work, rounds, device).items()}
        rows.append({
            "num_envs": num_envs,
            "us per step": {way: 1e6 * value / period for way, value in seconds.items()},
            "world-steps/s": {way: num_envs * period / value for way, value in seconds.items()},
        })  # fmt: skip
    return {"period": period, "sizes": rows, "shares": {name: work(rounds) for name, work in SHARES.items()}}


class Timed(GoalDirector):
    """A Director that adds up the seconds that its steps take."""

    seconds = 0.0

    def step(self, *arguments: Any, **named: Any) -> Any:
        """See ``GoalDirector.step``."""
        begin = time.perf_counter()
        given = super().step(*arguments, **named)
        self.seconds += time.perf_counter() - begin
        return given


def share_of_rsl_rl(iterations: int, num_envs: int = 4096) -> float:
    """Share of an rsl_rl iteration, at its defaults on a CPU, that a Director's steps take.

    Args:
        iterations: How many are timed; twice as many, but at least 8, run before that, so that fear has been learnt.
        num_envs: Carts of the example.
    """
    from rsl_rl.runners import OnPolicyRunner

    env = runpy.run_path(str(EXAMPLES / "rsl_rl_director.py"))["Carts"](
        Timed("p75", 40, goal_box=([-1.0], [1.0])), num_envs
    )
    model = {"class_name": "MLPModel"}
    config = {"actor": model | {"distribution_cfg": {"class_name": "GaussianDistribution"}}, "critic": model}
    config |= {"obs_groups": {"actor": ["policy"], "critic": ["policy"]}, "algorithm": {"class_name": "PPO"}}
    runner = OnPolicyRunner(env, config | {"num_steps_per_env": 24, "save_interval": 10**6})
    with contextlib.redirect_stdout(io.StringIO()):
        runner.learn(max(8, 2 * iterations))
        env.director.seconds, begin = 0.0, time.perf_counter()
        runner.learn(iterations)
    return env.director.seconds / (time.perf_counter() - begin)


def share_of_sb3(iterations: int, num_envs: int = 64, num_steps: int = 2048) -> float:
    """Share of an iteration of Stable-Baselines3's PPO, at its defaults, that a Director's steps take.

    Args:
        iterations: How many are timed; one runs before that, so that fear has been learnt.
        num_envs: Worlds of the example, CartPole.
        num_steps: Steps of a rollout.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    from deimos.adapters.stable_baselines3 import DirectedVecEnv

    example = runpy.run_path(str(EXAMPLES / "stable_baselines3_director.py"))
    director = Timed("p75", 50, goal_box=([-1.0], [1.0]), learn_every=num_steps)
    worlds = DirectedVecEnv(make_vec_env(example["GoalCart"], num_envs), director, slice(4, 5), example["closeness"])
    learner = PPO("MlpPolicy", worlds, n_steps=num_steps, device="cpu")
    learner.learn(num_envs * num_steps)
    director.seconds, begin = 0.0, time.perf_counter()
    learner.learn(iterations * num_envs * num_steps, reset_num_timesteps=False)
    return director.seconds / (time.perf_counter() - begin)


SHARES = {"rsl_rl, 4096 worlds": share_of_rsl_rl, "Stable-Baselines3, 64 worlds": share_of_sb3}
"""By learner: the function that measures the share of its iterations that a Director's steps take."""


def periods(way: str, num_envs: int, period: int, device: torch.device) -> Callable[[], None]:
    """A Director that has learnt, and T steps of its worlds, which crash at random."""
    generator = torch.Generator(device).manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(num_envs, *shape, generator=generator, device=device, dtype=torch.float32)

    box = ([0.0] * GOAL, [1.0] * GOAL) if DRAWN in way else None
    director = GoalDirector(
        way.split(",")[0], period, num_envs=num_envs, state_dim=STATE, goal_dim=GOAL, device=device, goal_box=box
    )
    states, goal = [draw(STATE) for _ in range(8)], draw(GOAL)
    offered = draw(CANDIDATES, GOAL)
    candidates = None if box else offered
    never = torch.zeros(num_envs, dtype=torch.bool, device=device)
    clock = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def step(t: int, crashed: torch.Tensor) -> None:
        goal.copy_(director.step(states[t % 8], goal, crashed, never, candidates).goal)

    def observe(t: int, crashed: torch.Tensor) -> None:
        director.observe(crashed, never)
        clock.add_(1)
        rows = (crashed | (clock >= period)).nonzero().squeeze(1)
        clock[rows] = 0
        if len(rows):
            goal[rows] = director.propose(rows, states[t % 8][rows], goal[rows], lambda rows: offered[rows])

    advance = observe if OBSERVED in way else step

    def work() -> None:
        for t in range(period):
            advance(t, draw() < CRASHES)

    afraid = fear_selector(director.selector)
    for _ in range(3 if afraid is None else WARM_UP):
        if afraid is not None and afraid.fear.fitted:
            break
        work()
    return work


def show(result: dict[str, Any]) -> None:
    """Print the table of ``measure``."""
    table = Table(title=f"GoalDirector, us per step (world-steps/s), T = {result['period']}", title_justify="left")
    table.add_column("worlds", justify="right")
    rows = result["sizes"]
    for way in rows[0]["us per step"]:
        table.add_column(way, justify="right")
    for row in rows:
        cells = (f"{value:.0f} ({short(row['world-steps/s'][way])})" for way, value in row["us per step"].items())
        table.add_row(str(row["num_envs"]), *cells)
    wide_console().print(table)
    for name, share in result["shares"].items():
        wide_console().print(f"Share of an iteration of {name}: {share:.1%}")
