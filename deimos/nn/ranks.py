"""The one place where several processes would meet."""

from torch import Tensor


def mean_over_ranks(value: Tensor) -> Tensor:
    """Average ``value`` over all learner processes, in place, and return it; with one process nothing changes.

    Gradients, KL divergences, sums of advantages and class shares pass through here. That is what PPO and the fear
    network need for data-parallel training, but for one thing: ``Fear.fit`` begins only where its own process has seen
    enough of both classes. What RND, CL, PLR, grid and the temperature gather stays with each process as yet.
    """
    return value
