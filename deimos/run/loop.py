"""What happens between two steps: interactions resolve, goals are chosen, episodes begin."""

import torch
from torch import Tensor

from deimos.goals.interactions import Interactions
from deimos.goals.selector import GoalSelector, Spaces
from deimos.nn.fused import fuse
from deimos.nn.fused_critics import fuse_critics
from deimos.sim.env import Env, Step


def spaces(env: Env, total_steps: int = 0) -> Spaces:
    """What a selector needs to know about ``env`` and, where it is known, how long the training is."""
    return Spaces(
        num_envs=env.num_envs, state_dim=env.state_dim, goal_dim=env.goal_dim, goal_period=env.goal_period,
        device=env.device, groups=env.goal_groups, goal_start=env.goal_slice.start, total_steps=total_steps,
        fuse=fuse,
        fuse_critics=fuse_critics,
    )  # fmt: skip


class GoalLoop:
    """Joins an environment, a selector and their interactions; training and evaluation both run it.

    Args:
        env: The worlds.
        selector: Who chooses their goals.
        window: Steps that resolved interactions are kept for; ``None`` for 2 T.
    """

    def __init__(self, env: Env, selector: GoalSelector, window: int | None = None) -> None:
        self.env = env
        self.selector = selector
        self.interactions = Interactions(
            env.num_envs, env.state_dim, env.goal_dim, env.goal_period, window or 2 * env.goal_period, env.device,
            groups=0 if env.goal_groups == (slice(None),) else len(env.goal_groups),
        )  # fmt: skip
        self.weight = torch.ones(env.num_envs, device=env.device)
        """1 where the learner may use the transitions under the goal in force, else 0, shape (num_envs,)."""
        if selector.first_goals_scaled:  # the goals that the environment was built with are not
            env.restart(selector.goal_range())

    def start(self) -> None:
        """Begin a new episode in every world and drop what is pending; a fresh environment has begun already."""
        self.interactions.active.fill_(False)
        self._reset(torch.ones(self.env.num_envs, dtype=torch.bool, device=self.env.device))

    def advance(self, step: Step) -> None:
        """Do what ``step`` calls for; ``env.obs`` is then what the policy acts on next.

        Interactions are resolved before anything is reset, so one whose T-th step is the time
        limit keeps its label. Worlds that are done get a first goal, not one of the selector's.
        """
        self.interactions.advance(step)
        done = step.terminated | step.truncated
        due = step.goal_due & ~done
        due_count, done_count = torch.stack([due.sum(), done.sum()]).tolist()  # the one synchronisation of the step
        if due_count + done_count == 0:
            return
        due_rows = _rows(due, due_count)
        self.interactions.resolve(step, torch.cat([due_rows, _rows(done, done_count)]))
        if due_count:
            self._propose(due_rows)
        if done_count:
            self._reset(done)

    def _propose(self, rows: Tensor) -> None:
        env, selector = self.env, self.selector
        obs = env.obs[rows]
        state, goal = env.state(obs), obs[:, env.goal_slice]
        candidates = env.sample_goals(rows, selector.num_candidates, selector.goal_range())
        proposal = selector.propose(rows, state, goal, candidates, env.draw(rows))
        self.interactions.open(
            rows, state, goal, proposal.goal, proposal.score, probe=proposal.probe, note=proposal.note
        )
        self.weight[rows] = 1.0 if proposal.learn is None else proposal.learn.float()
        env.set_goals(rows, proposal.goal)

    def _reset(self, mask: Tensor) -> None:
        self.env.reset(mask, self.selector.goal_range() if self.selector.first_goals_scaled else None)
        self.weight.masked_fill_(mask, 1.0)

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        return {
            "env": self.env.state_dict(),
            "selector": self.selector.state_dict(),
            "interactions": self.interactions.state_dict(),
            "learn": self.weight.clone(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from ``state_dict()``."""
        self.env.load_state_dict(state["env"])
        self.selector.load_state_dict(state["selector"])
        self.interactions.load_state_dict(state["interactions"])
        self.weight.copy_(state["learn"])


def _rows(mask: Tensor, count: int) -> Tensor:
    """Indices of the ``count`` true entries of ``mask``; a known count spares the device a wait."""
    return torch.nonzero_static(mask, size=count).squeeze(1)
