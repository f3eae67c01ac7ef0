"""A Director in mjlab's own training: its Go1 follows velocities that are likely to make it fall."""

import argparse
import math
from dataclasses import asdict

import mjlab.tasks  # noqa: F401 - registers the tasks
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity.mdp.velocity_command import UniformVelocityCommand, UniformVelocityCommandCfg

from deimos import GoalDirector
from deimos.adapters.command_term import DirectedCommand


class DirectedVelocity(DirectedCommand, UniformVelocityCommand):
    """mjlab's velocity commands, chosen by fear; its timers and its modes stay."""

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        box = tuple(zip(cfg.ranges.lin_vel_x, cfg.ranges.lin_vel_y, cfg.ranges.ang_vel_z, strict=True))
        sizes = {"num_envs": env.num_envs, "state_dim": self.state().shape[1], "goal_dim": 3, "device": env.device}
        longest = math.ceil(cfg.resampling_time_range[1] / env.step_dt)
        self.director = GoalDirector("p75", max_horizon=longest, goal_box=box, **sizes)

    def state(self) -> torch.Tensor:
        """Velocities, gravity and joints, in the frame of the trunk."""
        d = self.robot.data
        parts = d.root_link_lin_vel_b, d.root_link_ang_vel_b, d.projected_gravity_b, d.joint_pos, d.joint_vel
        return torch.cat(parts, dim=1)


class DirectedVelocityCfg(UniformVelocityCommandCfg):  # noqa: D101
    def build(self, env: ManagerBasedRlEnv) -> DirectedVelocity:  # noqa: D102
        return DirectedVelocity(self, env)


def main() -> None:
    """Train, and print the fear of forward velocities in the robot's current state."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--seconds", type=float, nargs=2, default=(3.0, 8.0), help="range between two commands")
    args = parser.parse_args()
    device = "cuda:0" if torch.cuda.is_available() else "cpu"
    cfg, agent = (load("Mjlab-Velocity-Flat-Unitree-Go1") for load in (load_env_cfg, load_rl_cfg))
    uniform = vars(cfg.commands["twist"]) | {"resampling_time_range": tuple(args.seconds)}
    cfg.scene.num_envs, cfg.commands["twist"] = args.num_envs, DirectedVelocityCfg(**uniform)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device=device), clip_actions=agent.clip_actions)
    MjlabOnPolicyRunner(env, asdict(agent), None, device).learn(args.iterations)
    term = env.unwrapped.command_manager.get_term("twist")
    risk = term.director.risk_map(term.state()[0], term.command[0], {0: [-1.0, -0.5, 0.0, 0.5, 1.0], 2: [0.0]})
    for speed, fear in zip(risk.x, risk.probability[0], strict=True):
        print(f"{speed:+.1f} m/s  {fear:.2f}")


if __name__ == "__main__":
    main()
