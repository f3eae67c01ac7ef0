"""Multiplications and additions of the matrix products of networks: what their cost cannot fall below."""

from torch import nn

from deimos.goals.fear_selector import FearSelector
from deimos.goals.selector import GoalSelector
from deimos.goals.selectors.rnd import RND
from deimos.goals.selectors.vds import VDS


def operations(net: nn.Module) -> int:
    """Operations of the linear layers of a network for one row, forward."""
    return sum(2 * layer.weight.numel() for layer in net.modules() if isinstance(layer, nn.Linear))


def scoring(net: nn.Module, goal_dim: int, count: int) -> int:
    """Operations of scoring ``count`` candidates for one context, whose share of the first layer is computed once."""
    first = next(layer for layer in net.modules() if isinstance(layer, nn.Linear))
    own = 2 * first.out_features * goal_dim
    return 2 * first.weight.numel() - own + count * (own + operations(net) - 2 * first.weight.numel())


def selector_operations(
    selector: GoalSelector, decisions: float, transitions: int, num_envs: int, goal_dim: int
) -> float:
    """Operations of a selector in an iteration.

    Args:
        selector: One of ours; others, and those without networks, count as nothing.
        decisions: Goals that it chooses in an iteration.
        transitions: Transitions of an iteration.
        num_envs: Number of worlds.
        goal_dim: Components of a goal.
    """
    count = selector.num_candidates
    if isinstance(selector, FearSelector):
        net, config = selector.fear.network, selector.config.fear
        window = 2 * num_envs  # interactions: the resolved ones of 2 T steps, about one per world and T
        return decisions * scoring(net, goal_dim, count) + 3.0 * operations(net) * window * config.epochs
    if isinstance(selector, RND):
        fit = (operations(selector.target) + 3 * operations(selector.predictor)) * selector.config.epochs
        nets = (selector.target, selector.predictor)
        return decisions * (sum(scoring(net, goal_dim, count) for net in nets) + fit)
    if isinstance(selector, VDS):
        net, config = selector.stack.nets[0], selector.config
        rows = transitions * (config.critics if config.data == "all" else 1)
        learning = rows * operations(net) * (1 + 3 * config.epochs)  # values, then the passes
        return learning + decisions * count * config.critics * operations(net)
    return sum(selector_operations(part, decisions, transitions, num_envs, goal_dim) for part in selector.parts)
