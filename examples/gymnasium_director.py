"""A Director in a loop around gymnasium's Pendulum: which leans does a balancing controller fail to hold?"""

import argparse

import gymnasium as gym
import numpy as np

from deimos import GoalDirector
from deimos.adapters.directed import DirectedVectorEnv

LARGEST = 0.8  # goals are leans in [-LARGEST, LARGEST] [rad]; the motor can hold 0.41


class Balance(gym.Wrapper):
    """Pendulum-v1 that starts upright, ends when it has fallen over, and has a slot for a goal in its observation."""

    def __init__(self) -> None:
        super().__init__(gym.make("Pendulum-v1"))
        high = np.append(self.env.observation_space.high, LARGEST).astype(np.float32)
        self.observation_space = gym.spaces.Box(-high, high)

    def reset(self, **options: object) -> tuple:
        """Start close to upright."""
        obs, info = self.env.reset(**options | {"options": {"x_init": 0.1, "y_init": 0.1}})
        return np.append(obs, np.float32(0.0)), info

    def step(self, action: np.ndarray) -> tuple:
        """End the episode when the pendulum is below the horizontal."""
        obs, reward, _, truncated, info = self.env.step(action)
        return np.append(obs, np.float32(0.0)), reward, bool(obs[0] < 0), truncated, info


def controller(obs: np.ndarray) -> np.ndarray:
    """Torques [Nm] that hold the observation's lean, within the motor's limits; stands in for a policy."""
    angle, lean = np.arctan2(obs[:, 1], obs[:, 0]), obs[:, 3]
    return np.clip(-15.0 * (angle - lean) - 4.0 * obs[:, 2] - 5.0 * np.sin(lean), -2.0, 2.0)[:, None]


def main() -> None:
    """Let the Director ask for leans, and print which of them it has learnt to fear."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--num-envs", type=int, default=64)
    args = parser.parse_args()
    director = GoalDirector("p25", goal_period=25, goal_box=([-LARGEST], [LARGEST]), autoreset="NextStep")
    worlds = gym.vector.SyncVectorEnv([Balance] * args.num_envs)
    envs = DirectedVectorEnv(worlds, director, slice(3, 4), lambda obs, reward: -np.square(obs[:, 1] - obs[:, 3]))
    (obs, _), falls = envs.reset(seed=0), 0
    for _ in range(args.steps):
        obs, _, fallen, _, _ = envs.step(controller(obs).astype(np.float32))
        falls += int(fallen.sum())
    upright, leans = np.tile([1.0, 0.0, 0.0], (5, 1)), np.linspace(0, LARGEST, 5)[:, None]
    print(f"{falls} falls. Fear of leaning, from upright:")
    for lean, fear in zip(leans[:, 0], director.fear(upright, leans * 0, leans).probability, strict=True):
        print(f"{lean:.1f} rad  {fear:.2f}")


if __name__ == "__main__":
    main()
