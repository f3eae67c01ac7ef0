"""Floating-point operations of matrix products, from the sizes of networks: a lower bound on an iteration's cost."""

from collections.abc import Sequence
from itertools import pairwise

from deimos.goals.fear import FearConfig
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import rnd, vds
from deimos.learn.ppo import PPOConfig
from deimos.sim.env import Env

TRAINING = 3  # passes to learn from a row: forward, gradient of the weights, gradient of the inputs


def forward(inputs: int, hidden: Sequence[int], outputs: int) -> float:
    """Operations of a multilayer perceptron for one row."""
    sizes = [inputs, *hidden, outputs]
    return 2.0 * sum(a * b for a, b in pairwise(sizes))


def scoring(context: int, goal: int, hidden: Sequence[int], outputs: int, count: int) -> float:
    """Operations of a network for ``count`` candidate goals of one context, whose first-layer part is computed once."""
    each = forward(context + goal, hidden, outputs) - 2.0 * context * hidden[0]
    return 2.0 * context * hidden[0] + count * each


def of_learner(ppo: PPOConfig, env: Env) -> float:
    """Operations of PPO's update in an iteration."""
    actor = forward(env.obs_dim, ppo.hidden, env.action_dim)
    return TRAINING * (actor + forward(env.obs_dim, ppo.hidden, 1)) * _transitions(ppo, env) * ppo.epochs


def of_selector(selector: SelectorConfig, ppo: PPOConfig, env: Env) -> float:
    """Operations that a goal selector adds to an iteration; negative if it replaces the critic's work.

    Selectors without networks add none.
    """
    state, goal, transitions = env.state_dim, env.goal_dim, _transitions(ppo, env)
    decisions = transitions / env.goal_period
    context = state + goal
    fear = getattr(selector, "fear", None)
    if isinstance(fear, FearConfig):
        window = 2 * env.num_envs  # interactions: the resolved ones of 2 T steps, about one per world and T
        fit = TRAINING * forward(context + goal, fear.hidden, 1) * window * fear.epochs
        candidates: int = getattr(selector, "candidates")  # noqa: B009 (every selector with fear has them)
        return decisions * scoring(context, goal, fear.hidden, 1, candidates) + fit
    if isinstance(selector, rnd.Config):
        nets = [forward(context + goal, (units,), selector.features) for units in (selector.target, selector.predictor)]
        both = (selector.target + selector.predictor,)  # as one network of that width
        score = scoring(context, goal, both, selector.features, selector.candidates)
        return decisions * (score + (nets[0] + TRAINING * nets[1]) * selector.epochs)
    if isinstance(selector, vds.Config):
        critic = forward(state + goal, selector.hidden, 1)
        rows = transitions * (selector.critics if selector.data == "all" else 1)
        learning = rows * critic * (1 + TRAINING * selector.epochs)  # values, then the passes
        chosen = decisions * selector.candidates * selector.critics * critic
        own = TRAINING * forward(env.obs_dim, ppo.hidden, 1) * transitions * ppo.epochs
        return learning + chosen - (own if selector.role == "replace" else 0.0)
    return 0.0


def _transitions(ppo: PPOConfig, env: Env) -> int:
    return ppo.num_steps * env.num_envs
