"""Many independent streams of random numbers from one seed."""

import hashlib
import warnings

import numpy as np
import torch


def derive(seed: int, use: str) -> int:
    """The seed of one use of randomness.

    Two networks, or a network and its noise, with the same seed would be correlated; those with derived
    seeds are not, however similar the seeds and the uses are.

    Args:
        seed: Seed of the whole, at least 0.
        use: What it is for, in words that no other use has.

    Returns:
        A number in [0, 2^64).
    """
    return int(np.random.SeedSequence([seed, *use.encode()]).generate_state(1, np.uint64)[0])


def generator(seed: int, use: str, device: torch.device | str = "cpu") -> torch.Generator:
    """A separate generator for one use of randomness; see ``derive`` for the arguments.

    Weights are drawn on the CPU, whatever the device of their network.
    """
    return torch.Generator(device).manual_seed(derive(seed, use))


def restore(generator: torch.Generator, state: torch.Tensor) -> None:
    """Continue from a saved ``generator.get_state()``, even one from another kind of device.

    States of CPUs and of GPUs cannot be converted into each other. The stream then continues from a seed that follows
    from the saved state: an equally good stream, and the same every time, but not the saved one.
    """
    state = state.cpu()  # where generators keep it; ``torch.load(map_location=...)`` moves it
    if state.numel() == generator.get_state().numel():
        generator.set_state(state)
        return
    warnings.warn(
        f"The random numbers of a {generator.device.type} continue from a checkpoint of another kind of device: "
        "the run is not a bit-for-bit continuation.",
        stacklevel=2,
    )
    digest = hashlib.sha256(bytes(state.tolist())).hexdigest()
    generator.manual_seed(derive(generator.initial_seed(), digest))
