"""Environments in rsl_rl's training loop."""

from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from deimos.checks import check_at_least, check_is, check_positive
from deimos.goals.selector import GoalSelector
from deimos.goals.selectors import uniform
from deimos.learn.ppo import PPOConfig
from deimos.nn.layout import seen_by
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.env import Env


class RslRlVecEnv(VecEnv):
    """An environment as rsl_rl 5 wants it: ``step`` also issues goals and resets worlds that are done.

    Everything that it returns is a copy that later steps leave alone. Of what a selector wants of the learner, two
    things are left to you: multiply losses by ``loop.weight`` (``weighted``), and subtract ``selector.crash_penalty``
    times the environment's ``largest_reward`` at a crash (``penalty``). On CUDA make it and call it within
    ``deimos.sim.shared.one_stream(device)``; outside, it is refused.

    Args:
        env: The worlds, as they were built.
        selector: Chooses their goals; ``None`` for Uniform.
        reward_scale: What rewards are multiplied by, positive.
        report_every: Steps between two reports, ``log`` of the extras, at least 1: making one waits for the device.
        learn_every: Steps between two updates of the selector, at least 1; the steps of a rollout are a good choice.
            ``None`` leaves it to you: call ``loop.learn()`` at least every T steps, or ``loop.learn(rollout)`` for
            selectors that learn from the learner's rollout (``vds``, ``plr``).

    Attributes:
        loop: The worlds, their selector and their interactions.
        obs_groups: Which groups of observations rsl_rl's actor and critic see; see ``get_observations``.

    Raises:
        ValueError: If a number is out of range, or a selector that needs a rollout is to learn every so many steps.
    """

    def __init__(
        self, env: Env, selector: GoalSelector | None = None, reward_scale: float = 1.0, report_every: int = 24,
        learn_every: int | None = 24,
    ) -> None:  # fmt: skip
        check_is("env", env, Env)
        if selector is not None:
            check_is("selector", selector, GoalSelector)
        check_positive("reward_scale", reward_scale, finite=True)
        check_at_least("report_every", report_every, 1)
        self._report_every, self._steps = report_every, 0
        self.env = env
        self.reward_scale = reward_scale
        self.cfg = spaces(env)
        self.loop = GoalLoop(env, selector or uniform.Config().build(self.cfg, seed=0), learn_every=learn_every)
        self._sees = {"policy": seen_by("actor", env.layout, env.device)}
        self.obs_groups = {"actor": ["policy"], "critic": ["policy"]}
        if any(field.seen_by != "both" for field in env.layout):
            self._sees["critic"] = seen_by("critic", env.layout, env.device)
            self.obs_groups["critic"] = ["critic"]
        self.num_envs = env.num_envs
        self.num_actions = env.action_dim
        self.device = env.device
        # Without a limit, the largest number that the clock can hold.
        self.max_episode_length = env.time_limit or torch.iinfo(env.episode_step.dtype).max

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps since every world's reset, int32, shape (num_envs,): the clock of the time limit itself.

        Setting it sets the clock, so that ``init_at_random_ep_len`` spreads the time limits.
        """
        return self.env.episode_step

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:
        self.env.episode_step.copy_(steps)

    def get_observations(self) -> TensorDict:
        """What to act on next, float32: ``policy``, what the actor sees, shape (num_envs, components that it sees).

        Where the layout hides something from one of the two (``privileged``), also ``critic``, what the critic sees.
        """
        groups = {name: self.env.obs[:, sees].clone() for name, sees in self._sees.items()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Simulate one step of every world, issue the goals that are due and reset the worlds that are done.

        Args:
            actions: Actions, float32, shape (num_envs, num_actions); the environment clips them.

        Returns:
            What to act on next; scaled rewards, shape (num_envs,); worlds that crashed or were truncated,
            bool, shape (num_envs,); and ``time_outs``: 1 where a world was truncated, else 0, shape (num_envs,). At a
            report, where there is something to say, ``log`` too, which rsl_rl logs: means of the steps since the last
            one, such as the terms of the reward (``reward/NAME``, not scaled; see ``Env.report``), and what the
            selector's last update says.

        Raises:
            SimulationError: If an action is not finite, or too many worlds become invalid.
        """
        step = self.env.step(actions.detach())
        self.env.check()  # rsl_rl looks for NaN in what comes back, but a clipped NaN is a number
        rewards = step.reward * self.reward_scale
        dones = step.terminated | step.truncated
        extras: dict[str, Any] = {"time_outs": step.truncated.float()}
        self.loop.advance(step)
        self.loop.learn_if_due()
        self._steps += 1
        if self._steps % self._report_every == 0 and (report := self.env.report() | self.loop.metrics):
            extras["log"] = report
        return self.get_observations(), rewards, dones, extras


def runner_config(ppo: PPOConfig, env: RslRlVecEnv) -> dict[str, Any]:
    """The configuration of rsl_rl's ``OnPolicyRunner`` that corresponds to ``ppo``, for the observations of ``env``.

    The reward scale is not in it: give it to the environment.
    """
    network = {
        "class_name": "MLPModel", "hidden_dims": list(ppo.hidden), "activation": ppo.activation,
        "obs_normalization": ppo.normalize_observations,
    }  # fmt: skip
    spread = {"class_name": "GaussianDistribution", "init_std": ppo.init_std, "std_type": "scalar"}
    return {
        "num_steps_per_env": ppo.num_steps,
        "save_interval": 2**31,
        "obs_groups": {name: list(groups) for name, groups in env.obs_groups.items()},
        "actor": network | {"distribution_cfg": spread},
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.minibatches,
            "learning_rate": ppo.learning_rate,
            "schedule": "adaptive" if ppo.desired_kl else "fixed",
            "desired_kl": ppo.desired_kl or None,
            "gamma": ppo.discount,
            "lam": ppo.gae_lambda,
            "clip_param": ppo.clip,
            "use_clipped_value_loss": ppo.clip_value,
            "value_loss_coef": ppo.value_coef,
            "entropy_coef": ppo.entropy_coef,
            "max_grad_norm": ppo.max_grad_norm,
        },
    }
