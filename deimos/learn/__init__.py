"""The learner: PPO, its rollouts and the trained policy."""
