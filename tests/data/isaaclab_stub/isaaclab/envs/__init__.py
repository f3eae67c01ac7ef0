"""The environment: robots whose velocity is their command's, and which fall over where that is fast."""

from types import SimpleNamespace

import torch


class ManagerBasedRLEnv:
    """Calls a command term as Isaac Lab's environment does: at resets within a step, then once for all worlds."""

    step_dt, device, episode = 0.1, "cpu", 25

    def __init__(self, num_envs, command):
        self.num_envs, self.common_step_counter = num_envs, 0
        self.generator = torch.Generator().manual_seed(0)
        zeros = torch.zeros(num_envs, 3)
        data = {name: zeros.clone() for name in ("root_lin_vel_b", "root_ang_vel_b", "projected_gravity_b")}
        data |= {"joint_pos": zeros.clone(), "joint_vel": zeros.clone()}
        self.scene = {"robot": SimpleNamespace(data=SimpleNamespace(**data))}
        self.steps = torch.zeros(num_envs, dtype=torch.long)
        self.term = command.class_type(command, self)
        self.term.reset(torch.arange(num_envs))

    def step(self):
        """One step."""
        self.steps += 1
        self.common_step_counter += 1
        data = self.scene["robot"].data
        data.root_lin_vel_b.copy_(self.term.command)
        fast = self.term.command[:, 0].abs() > 0.7
        self.reset_terminated = fast & (torch.rand(self.num_envs, generator=self.generator) < 0.2)
        self.reset_time_outs = (self.steps == self.episode) & ~self.reset_terminated
        rows = (self.reset_terminated | self.reset_time_outs).nonzero().squeeze(-1)
        if len(rows):
            data.root_lin_vel_b[rows], self.steps[rows] = 0.0, 0
            self.term.reset(rows)
        self.term.compute(dt=self.step_dt)
