"""Does crashing pay? A controller that brakes before the wall against one that does not, by reward.

    python -m reproduction.braking

Particles follow a velocity, from the same states: those in which a particle that ignores the wall crashes within T
steps. One brakes, one brakes for these T steps and never again, one does not brake. Training maximises the discounted
return, which a crash ends. The mean reward per step over all steps also counts what follows a crash, when the particle
is back at the origin, far from every wall.
"""

import argparse
from dataclasses import dataclass

import torch
import warp as wp
from rich.console import Console
from rich.table import Table
from torch import Tensor

from deimos.run.attack import uniform_goals
from deimos.run.loop import GoalLoop
from deimos.run.trainer import TrainConfig
from deimos.sim.envs.particle import Config, Particle

TASKS = {
    "linear": Config(), "reciprocal, 2.5": Config(reward="reciprocal", reward_length=2.5),
    "exponential, 5": Config(reward="exponential", reward_length=5.0),
}  # fmt: skip
"""Rewards of a velocity, by name."""
WORLDS = 4000
PERIODS = 4  # goals that a non-braking particle has followed before states are taken
LONG = 1000  # steps over which a discounted return is summed; later ones weigh less than 0.01 %


BRAKES = {"brakes": (True, True), "brakes once": (True, False), "never brakes": (False, False)}
"""The controllers: whether they brake in the first T steps, and later."""


@dataclass(frozen=True)
class Gain:
    """What a controller gains from some states, as means over them."""

    discounted: float
    """Sum of discounted rewards until a crash."""
    per_step: float
    """Mean reward per step over all steps, including those after a crash."""


def gains(task: Config, worlds: int = WORLDS, discount: float = TrainConfig().ppo.discount) -> dict[str, Gain]:
    """What each controller gains, from the states in which not braking crashes within T steps.

    Args:
        task: A task with velocity goals.
        worlds: Number of states, at least 1.
        discount: gamma, in [0, 1].

    Returns:
        By the names of ``BRAKES``.
    """
    env = task.build(worlds, torch.device("cpu"), 0)
    loop = GoalLoop(env, uniform_goals(env))
    blind = env.reference_policy(brake=False)
    for _ in range(PERIODS * task.goal_period):
        loop.advance(env.step(blind(env.obs)))
    start = env.state_dict()
    found = {name: _follow(env, start, brakes, discount) for name, brakes in BRAKES.items()}
    doomed = found["never brakes"][2]
    return {
        name: Gain(discounted[doomed].mean().item(), per_step[doomed].mean().item())
        for name, (discounted, per_step, _) in found.items()
    }


def _follow(env: Particle, start: dict, brakes: tuple[bool, bool], discount: float) -> tuple[Tensor, Tensor, Tensor]:
    """Discounted returns, mean rewards, and which worlds crash within T steps, each of shape (worlds,)."""
    env.load_state_dict(start)
    loop = GoalLoop(env, uniform_goals(env))
    now, later = (env.reference_policy(brake) for brake in brakes)
    discounted, total = torch.zeros(2, env.num_envs, dtype=torch.float64)
    alive, doomed = torch.ones(env.num_envs, dtype=torch.bool), torch.zeros(env.num_envs, dtype=torch.bool)
    for t in range(LONG):
        first = t < env.goal_period
        step = env.step((now if first else later)(env.obs))
        discounted += discount**t * step.reward * alive
        total += step.reward
        doomed |= step.terminated & first
        alive &= ~step.terminated
        loop.advance(step)
    return discounted, total / LONG, doomed


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    wp.config.quiet = True
    table = Table("reward", "controller", "discounted return", "beside not braking", "mean reward per step")
    for name, task in TASKS.items():
        found = gains(task)
        least = found["never brakes"].discounted
        for controller, gain in found.items():
            more = f"{100 * (gain.discounted / least - 1):+.0f} %"
            table.add_row(name, controller, f"{gain.discounted:.1f}", more, f"{gain.per_step:.3f}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
