"""Worlds of particles as the kernels' arrays."""

import numpy as np
import warp as wp
from deimos.kernels.episodes import RESUMED, make_worlds
from deimos.kernels.particle import GOAL_START, OBS_DIM, PARTICLES, ParticleParams, reset_particles, step_particles
from deimos.kernels.particle_rewards import RewardShape

U = 2.0**-24  # relative error of one float32 operation
VARIANTS = ["absolute", "directional", "relative"]
VECTORS = PARTICLES.names  # ("position", "velocity", "force")
FLAGS = ("terminated", "truncated", "goal_due", "invalid")
HALF_SIDE = 1000.0  # [u]
LARGEST_DISTANCE = {name: np.sqrt(3) * (20.0 if name == "directional" else 2260.0) for name in VARIANTS}
GOAL_RANGE = {name: 10.0 if name == "directional" else 1250.0 for name in VARIANTS}
GOAL_SCALE = {name: 0.1 if name == "directional" else 1e-3 for name in VARIANTS}


class World:
    """Particles at rest in the middle, but for what is given, and outputs that no kernel has written yet."""

    def __init__(self, num_envs, device, variant="directional", *, garbage=np.nan, flag=True, values=None, **changes):
        task = {"goal_period": 100} | {name: changes.pop(name) for name in TASK if name in changes}
        self.params = ParticleParams()
        numbers = {
            "velocity_goals": variant == "directional",
            "half_side": HALF_SIDE,
            "max_speed": 10.0,
            "max_force": 1.0,
            "spawn_range": 0.0,
            "position_scale": 1e-3,
            "velocity_scale": 0.1,
            "force_scale": 1.0,
            "reward_shape": int(RewardShape.LINEAR),
            "reward_length": 2.5,
            "largest_distance": LARGEST_DISTANCE[variant],
        }
        assert numbers.keys() == ParticleParams.vars.keys()
        for name, value in (numbers | changes).items():
            setattr(self.params, name, value)
        scale = self.params.velocity_scale if variant == "directional" else self.params.position_scale
        self.worlds = make_worlds(
            num_envs, device, obs_dim=OBS_DIM, action_dim=3, goal_start=GOAL_START, goal_scale=[scale] * 3, **task
        )
        self.state = PARTICLES.allocate(device, num_envs=num_envs)
        for name in ("obs", "reward"):
            getattr(self.worlds, name).fill_(garbage)
        for name in FLAGS:
            getattr(self.worlds, name).fill_(flag)
        for name, value in (values or {}).items():
            self.set(name, value)
        if variant == "relative":
            self.worlds.origin = wp.from_torch(wp.to_torch(self.state.position))

    def array(self, name):
        """An array of the state or of the worlds."""
        return getattr(self.state if name in VECTORS else self.worlds, name)

    def set(self, name, value):
        """Fill an array with a value for all worlds, or with one for each."""
        array = self.array(name)
        dtype = {wp.int32: np.int32, wp.bool: bool}.get(array.dtype, np.float32)
        array.assign(np.broadcast_to(np.asarray(value, dtype), array.numpy().shape))

    def get(self, name):
        """An array as NumPy's."""
        return self.array(name).numpy()

    def step(self, action):
        """One step."""
        self.set("action", action)
        step_particles(self.worlds, self.state, self.params).launch()
        return self

    def reset(self, mask=True, first_range=None):
        """Reset the worlds of ``mask``."""
        self.set("mask", mask)
        self.set("first_range", GOAL_RANGE["directional"] if first_range is None else first_range)
        reset_particles(self.worlds, self.state, self.params).launch()
        return self

    def snapshot(self):
        """The bytes of everything that a reset may touch, world by world."""
        return {name: [row.tobytes() for row in self.get(name)] for name in (*VECTORS, *RESUMED)}


TASK = ("goal_period", "time_limit", "stagger", "seed", "world_offset")
