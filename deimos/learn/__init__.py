"""The learner: PPO, its rollouts, the policy that it leaves behind."""
