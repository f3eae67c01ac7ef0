"""Many independent streams of random numbers from one seed."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


def derive(seed: int, use: str) -> int:
    """The seed of one use of chance.

    Two networks, or a network and its noise, that were seeded alike would be correlated; numbers that
    are derived are not, however alike the seeds and the uses are.

    Args:
        seed: Seed of the whole, at least 0.
        use: What it is for; every use has its own words.

    Returns:
        A number in [0, 2^64).
    """
    return int(np.random.SeedSequence([seed, *use.encode()]).generate_state(1, np.uint64)[0])


def generator(seed: int, use: str, device: torch.device) -> torch.Generator:
    """A generator of its own for one use of chance; the arguments are those of ``derive``."""
    return torch.Generator(device).manual_seed(derive(seed, use))


@contextmanager
def weights_from(seed: int, use: str) -> Iterator[None]:
    """Draw the weights of networks built inside from ``derive(seed, use)`` alone, and leave torch's own stream be."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(seed, use))
        yield
