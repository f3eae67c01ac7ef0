"""A Director in rsl_rl's own training loop, on carts that are not part of Deimos: follow a speed, stay on the track."""

import argparse

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from deimos import GoalDirector


class Carts(VecEnv):
    """Carts on a 2 m track. An action accelerates [m/s^2]; the goal is a speed [m/s]; leaving the track is a crash."""

    def __init__(self, director: GoalDirector, num_envs: int = 256) -> None:
        self.num_envs, self.num_actions, self.max_episode_length, self.device, self.cfg = num_envs, 1, 500, "cpu", {}
        self.director, self.state = director, torch.zeros(num_envs, 2)  # position, speed
        self.goal = director.propose(None, self.state, torch.zeros(num_envs, 1))
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)

    def get_observations(self) -> TensorDict:  # noqa: D102
        return TensorDict({"policy": torch.cat([self.state, self.goal], dim=1)}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:  # noqa: D102
        self.state += 0.05 * torch.stack([self.state[:, 1], actions[:, 0].clamp(-2.0, 2.0)], dim=1)
        self.episode_length_buf += 1
        reward = torch.exp(-4.0 * (self.state[:, 1] - self.goal[:, 0]).square())
        crashed = self.state[:, 0].abs() > 1.0
        timed_out = (self.episode_length_buf >= self.max_episode_length) & ~crashed
        self.goal = self.director.step(self.state, self.goal, crashed, timed_out).goal
        self.state[crashed | timed_out], self.episode_length_buf[crashed | timed_out] = 0.0, 0
        return self.get_observations(), reward, crashed | timed_out, {"time_outs": timed_out.float()}


def main() -> None:
    """Train, and print the fear of goal speeds close to the end of the track."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--resume", help="a checkpoint to go on from, as this leaves in carts.pt")
    args = parser.parse_args()
    env = Carts(GoalDirector("p75", goal_period=40, goal_box=([-1.0], [1.0])))
    model = {"class_name": "MLPModel", "hidden_dims": [32, 32], "activation": "elu"}
    config = {"actor": model | {"distribution_cfg": {"class_name": "GaussianDistribution"}}, "critic": model}
    config |= {"obs_groups": {"actor": ["policy"], "critic": ["policy"]}, "algorithm": {"class_name": "PPO"}}
    runner = OnPolicyRunner(env, config | {"num_steps_per_env": 24, "save_interval": 10**6})
    if args.resume:
        saved = runner.load(args.resume)
        env.director.load_state_dict(saved["director"])
        env.state, env.goal, env.episode_length_buf = saved["env"]
    runner.learn(args.iterations)
    infos = {"director": env.director.state_dict(), "env": (env.state, env.goal, env.episode_length_buf)}
    runner.save("carts.pt", infos)
    edge, speeds = torch.tensor([0.9, 0.0]).expand(5, 2), torch.linspace(-1, 1, 5).unsqueeze(1)
    for speed, fear in zip(speeds[:, 0], env.director.fear(edge, 0 * speeds, speeds).probability, strict=True):
        print(f"{speed:+.1f} m/s  {fear:.2f}")


if __name__ == "__main__":
    main()
