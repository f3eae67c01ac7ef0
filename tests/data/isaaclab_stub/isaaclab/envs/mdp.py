"""The velocity command and the timers that every command term has."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import torch


@dataclass
class UniformVelocityCommandCfg:
    """Its configuration."""

    class_type: type | None = None
    resampling_time_range: tuple[float, float] = (0.4, 1.0)
    rel_standing_envs: float = 0.0
    ranges: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(lin_vel_x=(-1.0, 1.0), lin_vel_y=(-0.5, 0.5), ang_vel_z=(-2.0, 2.0))
    )


class UniformVelocityCommand:
    """Uniform velocities, other ones when a timer has run out; a share of the robots stands instead."""

    def __init__(self, cfg, env):
        self.cfg, self._env, self.num_envs, self.device = cfg, env, env.num_envs, env.device
        self.robot = env.scene["robot"]
        self.time_left = torch.zeros(env.num_envs)
        self.vel_command_b = torch.zeros(env.num_envs, 3)
        self.is_standing_env = torch.zeros(env.num_envs, dtype=torch.bool)

    @property
    def command(self):
        """The active commands."""
        return self.vel_command_b

    def reset(self, env_ids=None):
        """Resample where an episode begins; returns what was measured."""
        self._resample(torch.arange(self.num_envs) if env_ids is None else env_ids)
        return {}

    def compute(self, dt):
        """Let time go by."""
        self.time_left -= dt
        expired = (self.time_left <= 0.0).nonzero().flatten()
        if len(expired):
            self._resample(expired)
        self._update_command()

    def _resample(self, env_ids):
        self.time_left[env_ids] = torch.empty(len(env_ids)).uniform_(*self.cfg.resampling_time_range)
        self._resample_command(env_ids)

    def _resample_command(self, env_ids):
        for axis, bounds in enumerate(vars(self.cfg.ranges).values()):
            self.vel_command_b[env_ids, axis] = torch.empty(len(env_ids)).uniform_(*bounds)
        self.is_standing_env[env_ids] = torch.rand(len(env_ids)) < self.cfg.rel_standing_envs

    def _update_command(self):
        self.vel_command_b[self.is_standing_env] = 0.0
