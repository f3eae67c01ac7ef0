"""A Director as a command term of Isaac Lab: its velocity commands are those that are likely to make a robot fall.

In a velocity task: ``commands.base_velocity = DirectedVelocityCfg(**vars(commands.base_velocity))``; train as usual.
Isaac Lab does not run without Isaac Sim: our tests run this against a stub of its command manager and its environment,
written after the source of 2.3.2.
"""

import math

import torch
from isaaclab.envs import ManagerBasedRLEnv
from isaaclab.envs.mdp import UniformVelocityCommand, UniformVelocityCommandCfg
from isaaclab.utils import configclass

from deimos import GoalDirector
from deimos.adapters.command_term import DirectedCommand


class DirectedVelocity(DirectedCommand, UniformVelocityCommand):
    """Isaac Lab's velocity commands, chosen by fear; its timers and its modes stay."""

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        box = tuple(zip(cfg.ranges.lin_vel_x, cfg.ranges.lin_vel_y, cfg.ranges.ang_vel_z, strict=True))
        sizes = {"num_envs": env.num_envs, "state_dim": self.state().shape[1], "goal_dim": 3, "device": env.device}
        longest = math.ceil(cfg.resampling_time_range[1] / env.step_dt)
        self.director = GoalDirector("p75", max_horizon=longest, goal_box=box, **sizes)

    def state(self) -> torch.Tensor:
        """Velocities, gravity and joints, in the frame of the base."""
        d = self.robot.data
        parts = d.root_lin_vel_b, d.root_ang_vel_b, d.projected_gravity_b, d.joint_pos, d.joint_vel
        return torch.cat(parts, dim=1)


@configclass
class DirectedVelocityCfg(UniformVelocityCommandCfg):
    """Configuration of the term."""

    class_type: type = DirectedVelocity
