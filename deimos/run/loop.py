"""What happens between two steps: interactions resolve, goals are chosen, episodes begin."""

from collections.abc import Callable, Hashable

import torch
from torch import Tensor

from deimos.checks import check_at_least
from deimos.goals.core import Changes, GoalCore, on_gpu, window_between
from deimos.goals.given import lacking
from deimos.goals.interactions import Resolved
from deimos.goals.selector import GoalSelector, Spaces, Transitions
from deimos.nn.host import own_settings
from deimos.sim.env import Env, Step

GoalGuard = Callable[[Env, Tensor, Tensor], Tensor]
"""Has the last word on goals: from the environment, the worlds, int64, shape (B,), and the goals that they are to get,
shape (B, goal_dim), it returns those that they do get."""


def spaces(env: Env, total_steps: int = 0) -> Spaces:
    """What a selector needs to know about ``env`` and, if known, the length of the training."""
    return Spaces(
        num_envs=env.num_envs, state_dim=env.state_dim, goal_dim=env.goal_dim, goal_period=env.goal_period,
        device=env.device, groups=env.goal_groups, goal_start=env.goal_slice.start, total_steps=total_steps,
    )  # fmt: skip


class GoalLoop:
    """Joins an environment and a goal core; training and evaluation both run it.

    Args:
        env: The worlds.
        selector: Chooses their goals.
        window: Steps that resolved interactions are kept for; ``None`` for 2 T or, if more, ``learn_every + T``.
        guard: Has the last word on the selector's goals; ``None`` for none. Interactions, which selectors and
            attackers learn from, hold the goals that the selector asked for.
        learn_every: Steps between two updates of the selector by ``learn_if_due``, at least 1; ``None`` if the owner
            calls ``learn``, or if it does not learn.

    Raises:
        ValueError: If ``learn_every`` is less than 1, or is given to a selector that learns from a rollout.
    """

    def __init__(
        self, env: Env, selector: GoalSelector, window: int | None = None, guard: GoalGuard | None = None,
        learn_every: int | None = None,
    ) -> None:  # fmt: skip
        if learn_every is not None:
            check_at_least("learn_every", learn_every, 1)
            window = window or window_between(env.goal_period, learn_every)
            for lack in lacking(selector, taught=False, tracked=True):
                raise ValueError(
                    f"{lack} A loop that keeps no rollout must have learn_every=None, got {learn_every}, and its owner "
                    "call loop.learn(rollout); see docs/director.md."
                )
        self.env, self._guard, self._learn_every = env, guard, learn_every
        self.metrics: dict[str, float] = {}
        """Numbers for the log, from the selector's last update."""
        self.core = GoalCore(selector, spaces(env), window)
        self.selector, self.interactions, self.weight = selector, self.core.interactions, self.core.weight
        if selector.first_goals_scaled:  # those that the environment was built with are not
            env.restart(selector.goal_range())

    def start(self, mask: Tensor | None = None) -> None:
        """Begin new episodes and drop what is pending there; a fresh environment has begun already.

        Args:
            mask: Where, bool, shape (num_envs,); ``None`` for every world.
        """
        if mask is None:
            mask = torch.ones(self.env.num_envs, dtype=torch.bool, device=self.env.device)
        self.interactions.active &= ~mask
        self.core.percentile.masked_fill_(mask, 50.0)
        self.begin(mask)

    def advance(self, step: Step, *, in_time: bool = False) -> None:
        """Process the outcome of ``step``; ``env.obs`` is then what the policy acts on next.

        Interactions are resolved before anything is reset, so one whose T-th step is the time
        limit keeps its label. Worlds that are done get a first goal, which the selector does not choose.

        Args:
            step: What the environment's step returned.
            in_time: Whether to leave out goals that were issued less than T steps before the time limit: of these only
                crashes would count, which biases a crash rate upwards. For measurements.
        """
        if in_time and self.env.time_limit:
            lasted = self.interactions.now + 1 - self.interactions.issued_at
            last = self.env.episode_step - lasted + self.env.goal_period  # of the episode's steps, under the goal
            self.interactions.active &= ~(step.terminated & (last > self.env.time_limit))
        self.renew(step, self.resolve(step))

    def resolve(self, step: Step) -> Changes:
        """The first half of ``advance``: the outcomes of the goals; nothing is reset yet.

        A CPU lists the worlds that are due, to skip the others. A GPU would idle until their number is known, and
        scores the candidates of all worlds in less time; unless the selector, or a guard, must be asked about those
        that are due only.
        """
        return self.core.advance(
            step.terminated, step.truncated, step.goal_due, step.reward, step.tracking, dense=self._dense
        )

    @property
    def _dense(self) -> bool:
        return on_gpu(self.env.device) and self.selector.dense and self._guard is None

    def graph_key(self) -> Hashable:
        """What Python branches on in ``advance``; ``None`` if a CUDA graph cannot replay it, see ``why_eager``."""
        return self.selector.graph_key() if self.env.recordable and self._dense else None

    def why_eager(self) -> str:
        """What keeps a CUDA graph from replaying steps, in a few words."""
        if not self.env.recordable:
            return f"{type(self.env).__name__} does not say that its steps can be replayed (Env.recordable)"
        who = type(self.selector).__name__ if self._guard is None else "a guard of goals"
        return f"{who} does not say that its choices can be replayed (GoalSelector.dense and graph_key)"

    def passed(self, steps: int) -> None:
        """Count steps that a CUDA graph has replayed, in which Python did not run."""
        self.env.steps += steps
        self.core.passed(steps)

    def renew(self, step: Step, changes: Changes) -> None:
        """The second half of ``advance``: new goals where they are due, new episodes where one has ended."""
        self.choose(changes.due, changes.where)
        if len(changes.done):
            self.begin(changes.ended)

    def choose(self, rows: Tensor, where: Tensor | None = None) -> None:
        """Give the listed worlds, int64, shape (m,), the selector's next goals; for ``where`` see ``Changes``."""
        if len(rows):
            env = self.env
            obs = env.obs[rows] if where is None else env.obs
            candidates = env.sample_goals(rows, self.selector.num_candidates, self.selector.goal_range())
            state, goal, draws = env.state(obs), obs[:, env.goal_slice], env.draw(rows)
            goal = self.core.choose(rows, state, goal, candidates, draws, where=where)
            env.set_goals(rows, goal if self._guard is None else self._guard(env, rows, goal), where)

    def begin(self, mask: Tensor) -> None:
        """Begin an episode where ``mask``, bool, shape (num_envs,), is true; nothing may be pending there."""
        self.env.reset(mask, self.selector.goal_range() if self.selector.first_goals_scaled else None)
        self.weight.masked_fill_(mask, 1.0)

    @own_settings()
    @torch.inference_mode(False)  # what is learnt in a loop without gradients can also be used outside it
    @torch.no_grad()
    def learn(self, rollout: Transitions | None = None) -> dict[str, float]:
        """Let the selector learn from the outcomes, after a step and once per rollout.

        Args:
            rollout: The learner's transitions since the last call, for selectors that learn from them; their
                observations are all of ``env.obs``.

        Returns:
            ``metrics``; see ``GoalCore.learn``.

        Raises:
            ValueError: If the selector needs a rollout and gets none.
            SimulationError: If a weight of a network is not finite afterwards.
        """
        self.metrics = self.core.learn(rollout)
        self.selector.check()
        return self.metrics

    def learn_if_due(self) -> None:
        """Learn after every ``learn_every`` steps; call it once per step, when the step's goals are chosen."""
        if self._learn_every and self.interactions.now % self._learn_every == 0:
            self.learn()

    def outcomes(self) -> Resolved:
        """Interactions that were issued at least T steps ago: of later ones only the crashes are known so far."""
        done = self.interactions.resolved()
        return done.where(done.issued <= self.interactions.now - self.env.goal_period)

    def state_dict(self) -> dict:
        """Everything that a bit-exact resume needs."""
        return {"env": self.env.state_dict(), **self.core.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Continue from ``state_dict()``."""
        self.env.load_state_dict(state["env"])
        self.core.load_state_dict(state)
