"""A training of seconds for the tests of runs, with everything that a run can have."""

from deimos.goals.fear import FearConfig
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle

# Fast particles that start anywhere and get a goal every 16 steps: some crash, some survive, and the fear network
# learns from the first iterations on. Its window, 2 T, is longer than a rollout, so it too outlives a checkpoint.
CONFIG = TrainConfig(
    env=particle.Config(goal_period=16, max_speed=40.0, spawn_range=900.0),
    selector=director.Config(candidates=20, fear=FearConfig(min_per_class=4)),
    ppo=PPOConfig(hidden=(16, 16)),
    evaluation=False,
    seed=3,
    num_envs=64,
    env_steps=480,
    device="cpu",
    threads=1,
)
