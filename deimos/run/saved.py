"""A saved run for use: its policy, its worlds, its fear network."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from deimos.checks import RunError
from deimos.goals.fear_selector import FearSelector
from deimos.goals.selector import GoalSelector
from deimos.learn.policy import Policy, load_policy
from deimos.run.fear import learnt_fear, load_selector
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.run.training import load_checkpoint, read_config
from deimos.sim.env import Env
from deimos.sim.legged.config import LocomotionConfig


@dataclass(frozen=True)
class SavedRun:
    """A run whose policy is used."""

    folder: RunFolder
    """Its folder."""
    config: TrainConfig
    """The configuration that it was started with, except for ``env``: that is what ``build`` uses."""

    @classmethod
    def open(cls, path: Path, goal_period: int | None = None, terrain: str | None = None) -> "SavedRun":
        """Open the folder of a run.

        Args:
            path: The folder.
            goal_period: T; ``None`` for that of the training.
            terrain: What robots stand on; ``None`` for the ground of the training.

        Raises:
            RunError: If it is not a run, has no robots to put on a terrain, or cannot have this T.
        """
        folder = RunFolder.open(path)
        config = read_config(folder)
        try:
            period = config.env.goal_period if goal_period is None else goal_period
            env = config.env.for_evaluation().with_goal_period(period)
            if terrain is not None:
                if not isinstance(env, LocomotionConfig):
                    raise RunError(f"terrain is for legged robots; {path} is a run of another environment.")
                env = replace(env, terrain=terrain)
        except ValueError as error:
            raise RunError(str(error)) from error
        return cls(folder, replace(config, env=env, evaluation=False))  # its steps are for the training's T

    @property
    def has_robots(self) -> bool:
        """Whether MuJoCo simulates its worlds."""
        return isinstance(self.config.env, LocomotionConfig)

    def policy(self, env: Env) -> Policy:
        """The policy as it is now.

        Raises:
            RunError: If there is none, or its observations are not those of ``env``.
        """
        policy = load_policy(self.folder.path)
        if policy.layout != env.layout:
            has, needs = (
                ", ".join(f"{field.name} ({field.size})" for field in seen) for seen in (env.layout, policy.layout)
            )
            raise RunError(
                f"The policy in {self.folder.path} belongs to another environment: it observes {needs}, not {has}."
            )
        return policy

    def iteration(self) -> int:
        """The iteration that the checkpoint was written after; that of the log if the checkpoint holds only networks.

        The log is ahead of the checkpoint while the run goes on; 0 if there is neither.
        """
        state = load_checkpoint(self.folder) if (self.folder.path / "checkpoint.pt").exists() else {}
        rows = self.folder.read_csv("progress.csv")
        return int(state.get("iteration", rows[-1]["iteration"] if rows else 0))

    def build(self, num_envs: int, seed: int, world: int) -> Env:
        """Make worlds on the CPU, the first one with the global number ``world``.

        Raises:
            RunError: If they cannot be made.
        """
        try:
            return self.config.env.build(num_envs, torch.device("cpu"), seed, world)
        except ValueError as error:
            raise RunError(str(error)) from error

    def selector(self, env: Env) -> GoalSelector | None:
        """The selector of the run's goals in its current state, if it has a fear network that has learnt."""
        return load_selector(self.folder, self.config, env)

    def fear(self, env: Env) -> FearSelector | None:
        """The selector with the fear network that the run has learnt so far, if there is one."""
        return learnt_fear(self.selector(env))
