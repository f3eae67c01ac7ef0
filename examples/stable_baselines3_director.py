"""A Director in Stable-Baselines3's PPO: a cart with a pole follows positions, some beyond its track."""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from deimos import GoalDirector
from deimos.adapters.stable_baselines3 import DirectedVecEnv

LARGEST = 3.0  # [m]; the track ends at 2.4 m


class GoalCart(gym.ObservationWrapper):
    """CartPole-v1 with a slot for a goal after its four observations. The reward is -1 for a crash and 0 otherwise."""

    def __init__(self) -> None:
        super().__init__(gym.make("CartPole-v1", sutton_barto_reward=True))
        high = np.append(self.env.observation_space.high, np.float32(LARGEST))
        self.observation_space = gym.spaces.Box(-high, high)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Add the slot; the Director writes the goal."""
        return np.append(observation, np.float32(0.0))


def closeness(obs: np.ndarray, reward: np.ndarray) -> np.ndarray:
    """1 at the goal, 0 at the largest possible distance."""
    return 1.0 - np.abs(obs[:, 0] - obs[:, 4]) / (2.4 + LARGEST)


def main() -> None:
    """Train, and print the fear of goal positions for a cart near the right end of its track."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--num-envs", type=int, default=32)
    args = parser.parse_args()
    director = GoalDirector("p75", goal_period=50, goal_box=([-LARGEST], [LARGEST]), learn_every=64)
    worlds = DirectedVecEnv(make_vec_env(GoalCart, args.num_envs), director, slice(4, 5), closeness)
    PPO("MlpPolicy", worlds, n_steps=64, batch_size=256, seed=0, device="cpu").learn(args.steps)
    places = np.linspace(-LARGEST, LARGEST, 5)[:, None]
    near_the_end = np.tile([1.8, 0.0, 0.0, 0.0], (5, 1))
    for place, fear in zip(places[:, 0], director.fear(near_the_end, places * 0, places).probability, strict=True):
        print(f"{place:+.1f} m  {fear:.2f}")


if __name__ == "__main__":
    main()
