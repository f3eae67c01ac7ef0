"""The counter-based generator of torch: known answers, and normal numbers made of them."""

import itertools
import math

import numpy as np
import pytest
import torch

from deimos.nn.random import Purpose, normals, philox, uniforms

ONES = 0xFFFFFFFF
# Of the paper's own implementation, Random123: examples/kat_vectors, philox4x32 with 10 rounds.
KNOWN_ANSWERS = [
    ([0, 0, 0, 0], [0, 0], [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([ONES] * 4, [ONES] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]
SIGMAS = 5.0  # a sound generator's mean is off by more than this once in 1.7 million tests


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_it_gives_the_known_answers(torch_device, counter, key, expected):
    """Its words are those that the authors of Philox publish."""
    counter = tuple(torch.tensor([word], device=torch_device) for word in counter)
    assert [word.item() for word in philox(counter, tuple(key))] == expected


@pytest.mark.parametrize("size", [1, 3, 4, 12])
def test_normals_are_standard_normal(size):
    """Mean, deviation and shape are those of the normal distribution, and no two numbers of an address correlate."""
    drawn = normals(3, Purpose.EXPLORATION, torch.arange(500), torch.arange(40).unsqueeze(1), size)
    assert drawn.shape == (40, 500, size)
    flat = drawn.flatten(0, 1).double()
    assert (flat.mean(0).abs() < SIGMAS / 20_000**0.5).all()
    assert ((flat.square().mean(0) - 1).abs() < SIGMAS * (2 / 20_000) ** 0.5).all()
    ordered = flat.flatten().sort().values
    steps = torch.arange(len(ordered) + 1) / len(ordered)
    below = torch.special.ndtr(ordered)
    distance = torch.maximum((steps[1:] - below).max(), (below - steps[:-1]).max())
    assert distance < (math.log(2 / 1e-6) / (2 * len(ordered))) ** 0.5  # Kolmogorov and Smirnov at 1e-6
    for a, b in itertools.combinations(range(size), 2):
        assert abs((flat[:, a] * flat[:, b]).mean()) < SIGMAS / 20_000**0.5
    assert flat.abs().max() < 5.78


def test_normals_are_box_and_mullers():
    """Of four uniform numbers the first and third give the radii, the others the angles of two pairs."""
    world, count = torch.arange(50), torch.arange(50) * 7
    u = uniforms(5, Purpose.EXPLORATION, world, count).double().numpy()
    radius, angle = np.sqrt(-2 * np.log1p(-u[:, ::2])), 2 * np.pi * u[:, 1::2]
    expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2).reshape(50, 4)
    found = normals(5, Purpose.EXPLORATION, world, count, 4).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)  # an angle of up to 2 pi is rounded to 2^-22


def test_an_address_determines_its_numbers():
    """A world's numbers are the same whatever other worlds and steps are drawn beside it; any other address differs."""
    together = normals(1, 16, torch.arange(2000), torch.arange(24).unsqueeze(1), 3)
    halves = [normals(1, 16, torch.arange(1000) + first, torch.arange(24).unsqueeze(1), 3) for first in (0, 1000)]
    assert torch.equal(together, torch.cat(halves, dim=1))
    alone = normals(1, 16, torch.tensor([1234]), torch.tensor([17]), 3)
    assert torch.equal(alone[0], together[17, 1234])
    for seed, purpose, world, count in ((2, 16, 1234, 17), (1, 17, 1234, 17), (1, 16, 1235, 17), (1, 16, 1234, 18)):
        assert not torch.equal(normals(seed, purpose, torch.tensor([world]), torch.tensor([count]), 3), alone)
