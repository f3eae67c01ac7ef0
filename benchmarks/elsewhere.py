"""The Director in a foreign training loop: Stable-Baselines3's PPO on a cart that follows goals and must not crash.

``python -m benchmarks.elsewhere`` trains and attacks a population of policies, one row each in a table that an
interrupted run continues, and prints the results. Measurements and analysis are declared in ``docs/lab/elsewhere.md``.
"""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.timing import wide_console
from deimos.adapters.stable_baselines3 import DirectedVecEnv
from deimos.goals.director import GoalDirector
from deimos.goals.fear import Fear, FearConfig
from deimos.nn.threads import torch_on_one
from deimos.study.permutation import p_values
from deimos.study.stats import bootstrap_t
from examples.stable_baselines3_director import LARGEST, GoalCart, closeness
from reproduction.claims import holm

PERIOD = 100  # T [steps of 0.02 s]
WORLDS, STEPS = 64, 3000  # of every part of an evaluation
GOAL = slice(4, 5)
METHODS = {"uniform": ("uniform", 0.0), "p75": ("p75", 0.0), "p25": ("p25", 0.0), "penalty": ("uniform", 10.0)}
"""Goal selector, and what a crash costs in multiples of the largest reward of a step."""

SHOWN = {"worst": "crashes, worst case", "uniform_goals": "crashes, uniform goals", "reward": "reward of a step"}
"""Columns of the table, and their types."""

Choose = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]
"""Next goals, shape (n, 1), from the states and the goals of the worlds that are due, shapes (n, 4) and (n, 1)."""


def train(method: str, seed: int, steps: int) -> PPO:
    """Train Stable-Baselines3's PPO at its defaults except for 32 worlds of 64 steps, and minibatches of 256."""
    selector, penalty = METHODS[method]
    box = np.array([-LARGEST]), np.array([LARGEST])
    director = GoalDirector(selector, PERIOD, goal_box=box, learn_every=64, total_steps=steps // 32, seed=seed)

    def reward(obs: np.ndarray, crash: np.ndarray) -> np.ndarray:
        return closeness(obs, crash) + penalty * crash

    venv = DirectedVecEnv(DummyVecEnv([GoalCart] * 32), director, GOAL, reward=reward)
    policy = PPO("MlpPolicy", venv, n_steps=64, batch_size=256, seed=seed, device="cpu")
    return policy.learn(steps)


@dataclass
class Outcomes:
    """Outcomes of the goals chosen in the worlds of an evaluation."""

    inputs: np.ndarray
    """State, goal and next goal at the choice, shape (n, 6)."""
    world: np.ndarray
    """World of each choice, shape (n,)."""
    crashed: np.ndarray
    """Whether the cart crashed within T steps, bool, shape (n,)."""
    reward: float
    """Mean goal-matching reward of a step."""

    def rate(self, parity: int | None = None) -> float:
        """Share of the goals that ended in a crash, in even-numbered (0), odd-numbered (1) or all worlds.

        1 if no cart survived until a goal was chosen for it.
        """
        crashed = self.crashed if parity is None else self.crashed[self.world % 2 == parity]
        return float(crashed.mean()) if len(crashed) else 1.0


def play(policy: PPO, choose: Choose, seed: int) -> Outcomes:
    """Run a policy's most likely actions under goals from ``ask``; first goals are uniform and do not count.

    gymnasium's ``CartPoleVectorEnv`` resets a world on the step after its end, whatever the action.
    """
    envs, rng = gymnasium.make_vec("CartPole-v1", WORLDS, "vector_entry_point"), np.random.default_rng(seed)
    state, goal = envs.reset(seed=seed)[0], np.zeros((WORLDS, 1), np.float32)
    clock, begins, done = np.zeros(WORLDS, int), np.ones(WORLDS, bool), np.zeros(WORLDS, bool)
    pending = np.full((WORLDS, 6), np.nan, np.float32)
    found, rewards = [], []
    for step in range(STEPS):
        goal[begins], clock[begins] = anywhere(state[begins], goal[begins], rng), 0
        due = np.flatnonzero((clock == PERIOD) & ~done)
        if len(due):
            chosen = choose(state[due], goal[due], rng)
            if step + PERIOD <= STEPS:  # of later goals only the crashes would be known at the end
                pending[due] = np.concatenate([state[due], goal[due], chosen], axis=1)
            goal[due], clock[due] = chosen, 0
        action = policy.predict(np.concatenate([state, goal], axis=1), deterministic=True)[0]
        begins = done
        state, _, crashed, truncated, _ = envs.step(action)
        done = crashed | truncated
        clock += ~begins
        rewards.append(closeness(np.concatenate([state, goal], axis=1), crashed)[~begins])
        over = np.flatnonzero((crashed | (clock == PERIOD)) & ~np.isnan(pending[:, 0]))
        found.append((pending[over], over, crashed[over]))
        pending[over] = pending[done] = np.nan
    parts = (np.concatenate(part) for part in zip(*found, strict=True))
    return Outcomes(*parts, float(np.concatenate(rewards).mean()))


def anywhere(state: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Uniform goals."""
    return rng.uniform(-LARGEST, LARGEST, goal.shape)


def beyond(state: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The farthest goal beyond the end of the track that the cart is closer to."""
    return np.where(state[:, :1] < 0, -LARGEST, LARGEST)


def across(state: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The farthest goal from the cart."""
    return -beyond(state, goal, rng)


def most_feared(learnt: Outcomes, seed: int) -> Choose | None:
    """Attack with the most feared of 100 uniform goals; ``None`` if no goal, or every one, ended in a crash."""
    fear = Fear(FearConfig(epochs=20, minibatches=32), 4, 1, torch.device("cpu"), seed)
    fear.fit_rows(*map(torch.as_tensor, (learnt.inputs, learnt.crashed, np.ones_like(learnt.inputs[:, 0]))))

    def choose(state: np.ndarray, goal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        candidates = rng.uniform(-LARGEST, LARGEST, (len(state), 100, 1)).astype(np.float32)
        worst = fear.score(*map(torch.as_tensor, (state, goal, candidates))).argmax(1).numpy()
        return candidates[np.arange(len(state)), worst]

    return choose if fear.fitted else None


def judge(policy: PPO, seed: int) -> dict[str, float]:
    """One policy under uniform goals and under attackers.

    The worst attacker is chosen by the crashes in even-numbered worlds and reported by those in odd-numbered worlds.
    """
    naive = play(policy, anywhere, 10_000 + seed)
    attackers = {"beyond": beyond, "across": across, "argmax": most_feared(naive, seed) or anywhere}
    attacked = {name: play(policy, choose, 20_000 + seed) for name, choose in attackers.items()}
    worst = max(attacked, key=lambda name: attacked[name].rate(0))
    rates = {name: outcomes.rate() for name, outcomes in ({"uniform_goals": naive} | attacked).items()}
    goals = {"crashes_learnt_from": int(naive.crashed.sum()), "goals": len(naive.crashed)}
    return {"worst": attacked[worst].rate(1)} | rates | {"reward": naive.reward} | goals


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train Stable-Baselines3's PPO under goals of several selectors, attack the policies, and print the results."""

    seeds: tuple[int, ...] = tuple(range(10))
    """A policy of every method for each; those already in the table are not trained again."""
    steps: int = 150_000
    """Training steps, at least 1."""
    table: Path = Path("docs/results/elsewhere.csv")
    """Rows, one per policy."""


def fill(options: Options) -> None:
    """Train and evaluate the policies that the table lacks; each row is written when it is finished."""
    for seed in options.seeds:
        for method in METHODS:
            if (method, seed) not in {(row["method"], int(row["seed"])) for row in rows(options.table)}:
                judged = judge(train(method, seed, options.steps), seed)
                row = {"method": method, "seed": seed, "steps": options.steps} | judged
                new = not options.table.exists()
                with options.table.open("a", newline="") as file:
                    writer = csv.DictWriter(file, list(row))
                    if new:
                        writer.writeheader()
                    writer.writerow(row)


def rows(table: Path) -> list[dict[str, str]]:
    """The rows of the table; none if there is no table yet."""
    if not table.exists():
        return []
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def show(table: Path) -> None:
    """Means over policies with 95 % intervals, and the tests that were declared."""
    found = {
        method: {name: np.array([float(row[name]) for row in rows(table) if row["method"] == method]) for name in SHOWN}
        for method in METHODS
    }
    worst = {method: values["worst"] for method, values in found.items()}
    others = [method for method in METHODS if method != "uniform"]
    corrected = holm([float(p_values([worst["uniform"], worst[name]], [(0, 1)], "mean")[0]) for name in others])
    result = Table(title=f"{len(worst['uniform'])} policies of each method")
    for column in ("method", *SHOWN.values(), "p, by Holm"):
        result.add_column(column)
    for method in METHODS:
        p = dict(zip(others, corrected, strict=True)).get(method)
        cells = (f"{bootstrap_t(found[method][name]):.3f}" for name in SHOWN)
        result.add_row(method, *cells, "" if p is None else f"{p:.3f}")
    wide_console().print(result)


def main(options: Options) -> None:
    """Fill the table and print it."""
    with torch_on_one():
        fill(options)
    show(options.table)


if __name__ == "__main__":
    main(tyro.cli(Options))
