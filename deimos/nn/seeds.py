"""Many independent streams of random numbers from one seed."""

import hashlib
import warnings

import numpy as np
import torch


def derive(seed: int, use: str) -> int:
    """The seed of one use of randomness.

    Two networks, or a network and its noise, that were seeded alike would be correlated; numbers that
    are derived are not, however alike the seeds and the uses are.

    Args:
        seed: Seed of the whole, at least 0.
        use: What it is for; every use has its own words.

    Returns:
        A number in [0, 2^64).
    """
    return int(np.random.SeedSequence([seed, *use.encode()]).generate_state(1, np.uint64)[0])


def generator(seed: int, use: str, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator of its own for one use of randomness; the arguments are those of ``derive``.

    Weights are drawn on the CPU, whatever the device of their network.
    """
    return torch.Generator(device).manual_seed(derive(seed, use))


def restore(generator: torch.Generator, state: torch.Tensor) -> None:
    """Continue from ``generator.get_state()``, also from one of another kind of device.

    States of CPUs and of GPUs cannot be converted into each other. The stream then continues from a seed that follows
    from the saved state: as good a stream, and the same whenever it is done, but not the saved one.
    """
    state = state.cpu()  # where generators keep it; ``torch.load(map_location=...)`` takes it elsewhere
    if state.numel() == generator.get_state().numel():
        generator.set_state(state)
        return
    warnings.warn(
        f"The random numbers of a {generator.device.type} continue from a checkpoint of another kind of device: "
        "the run is no bit-for-bit continuation.",
        stacklevel=2,
    )
    digest = hashlib.sha256(bytes(state.tolist())).hexdigest()
    generator.manual_seed(derive(generator.initial_seed(), digest))
