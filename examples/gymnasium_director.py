"""A Director in a loop around gymnasium's Pendulum: which leans does a balancing controller fail to hold?"""

import argparse

import gymnasium as gym
import numpy as np
import torch

from deimos import GoalDirector

LARGEST = 0.8  # goals are leans in [-LARGEST, LARGEST] [rad]; the motor can hold 0.41


class Balance(gym.Wrapper):
    """Pendulum-v1 that starts upright and ends when it has fallen over."""

    def reset(self, **options: object) -> tuple:
        """Start close to upright."""
        return self.env.reset(**options | {"options": {"x_init": 0.1, "y_init": 0.1}})

    def step(self, action: np.ndarray) -> tuple:
        """The pendulum has fallen when it is below the horizontal."""
        obs, reward, _, truncated, info = self.env.step(action)
        return obs, reward, bool(obs[0] < 0), truncated, info


def controller(obs: torch.Tensor, lean: torch.Tensor) -> torch.Tensor:
    """Torques [Nm] that hold a lean, within what the motor can do; the place of a policy that learns."""
    angle = torch.atan2(obs[:, 1], obs[:, 0])
    return (-15.0 * (angle - lean[:, 0]) - 4.0 * obs[:, 2] - 5.0 * torch.sin(lean[:, 0])).clamp(-2.0, 2.0)


def main() -> None:
    """Let the Director ask for leans, and say which of them it has learnt to fear."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--num-envs", type=int, default=64)
    args = parser.parse_args()
    director = GoalDirector("p25", goal_period=25)
    makers = [lambda: Balance(gym.make("Pendulum-v1"))] * args.num_envs
    envs = gym.vector.SyncVectorEnv(makers, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    obs, falls, generator = torch.from_numpy(envs.reset(seed=0)[0]), 0, torch.Generator().manual_seed(0)
    lean = torch.zeros(args.num_envs, 1)
    for _ in range(args.steps):
        obs, _, fallen, cut, _ = envs.step(controller(obs, lean).unsqueeze(1).numpy())
        obs, fallen, cut = (torch.from_numpy(array) for array in (obs, fallen, cut))
        leans = (torch.rand(args.num_envs, 100, 1, generator=generator) * 2 - 1) * LARGEST
        lean = director.step(obs, lean, fallen, cut, leans).goal
        falls += int(fallen.sum())
    upright, leans = torch.tensor([1.0, 0.0, 0.0]).expand(5, 3), torch.linspace(0, LARGEST, 5).unsqueeze(1)
    print(f"{falls} falls. Fear of leaning, from upright:")
    for angle, fear in zip(leans[:, 0], director.fear(upright, torch.zeros(5, 1), leans).probability, strict=True):
        print(f"{angle:.1f} rad  {fear:.2f}")


if __name__ == "__main__":
    main()
