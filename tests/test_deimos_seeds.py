"""Streams of random numbers that depend on the seed and the use alone."""

import itertools

import numpy as np
import pytest
import torch

from deimos import GoalDirector
from deimos.nn.networks import mlp
from deimos.nn.seeds import derive, generator, restore

USES = ("policy weights", "policy noise", "fear weights", "fear minibatches", "vds critic 0", "vds critic 1", "")


def test_every_seed_and_use_has_a_number_of_its_own():
    """No two of 200 seeds and seven uses share a number, the same pair always has the same, and all fit torch."""
    numbers = [derive(seed, use) for seed, use in itertools.product(range(200), USES)]
    assert len(set(numbers)) == len(numbers)
    assert numbers == [derive(seed, use) for seed, use in itertools.product(range(200), USES)]
    assert all(0 <= number < 2**64 for number in numbers)
    assert torch.Generator().manual_seed(max(numbers)).initial_seed() == max(numbers)


def test_streams_are_independent():
    """Streams of neighbouring seeds and of different uses are uncorrelated: 28 pairs of 10 000 numbers, 4.5 sigma."""
    streams = [
        torch.randn(10_000, generator=generator(seed, use, torch.device("cpu")))
        for seed, use in itertools.product((0, 1), USES[:4])
    ]
    correlation = np.corrcoef(torch.stack(streams).numpy())
    assert np.abs(correlation[np.triu_indices(8, 1)]).max() < 4.5 / 100


def test_weights_leave_the_global_stream_alone():
    """Networks depend on their generator alone, and torch's own stream continues as if nothing had been."""

    def weights(seed, use):
        return mlp(4, (8,), 1, "relu", generator(seed, use))[0].weight.detach().clone()

    before = torch.get_rng_state()
    first = weights(1, "a")
    assert torch.equal(weights(1, "a"), first)
    assert not torch.equal(weights(1, "b"), first)
    assert not torch.equal(weights(2, "a"), first)
    assert not any(parameter.any() for parameter in mlp(4, (8,), 1, "relu").parameters())  # they are to be loaded
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("sizes", [(4, (8,), 1), (12, (64, 64), 3), (1, (1,), 1)])
def test_weights_are_those_that_pytorch_would_draw(sizes):
    """A generator in the state of torch's own gives the weights and biases of ``nn.Linear``, bit for bit."""
    inputs, hidden, outputs = sizes
    found = mlp(inputs, hidden, outputs, "relu", torch.Generator().manual_seed(7))
    torch.manual_seed(7)
    units = [inputs, *hidden, outputs]
    expected = [torch.nn.Linear(*pair) for pair in itertools.pairwise(units)]
    for layer, own in zip(expected, found[::2], strict=True):
        assert torch.equal(layer.weight, own.weight)
        assert torch.equal(layer.bias, own.bias)


def test_a_director_leaves_all_global_streams_alone():
    """Choosing and learning under selectors with networks moves neither torch's nor NumPy's global stream."""
    before = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    no = torch.zeros(4, dtype=torch.bool)
    for name in ("p75", "rnd"):
        director = GoalDirector(name, 2)
        for _ in range(6):
            director.step(torch.zeros(4, 3), torch.zeros(4, 2), no, no, torch.zeros(4, 9, 2))
    assert torch.equal(torch.get_rng_state(), before[0])
    assert str(np.random.get_state()) == str(before[1])  # noqa: NPY002


def test_a_stream_continues_from_its_state():
    """A saved stream continues bit for bit."""
    first, second = (generator(seed, "a", torch.device("cpu")) for seed in (0, 1))
    torch.rand(5, generator=first)
    restore(second, first.get_state())
    assert torch.equal(torch.rand(5, generator=first), torch.rand(5, generator=second))


def test_a_state_may_lie_on_another_device(monkeypatch):
    """Whoever loads a checkpoint onto a GPU has the states of generators there."""
    first, second = (generator(seed, "a", torch.device("cpu")) for seed in (0, 1))
    state = first.get_state()
    elsewhere = state.to("meta")
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: state)
    restore(second, elsewhere)
    assert torch.equal(torch.rand(5, generator=first), torch.rand(5, generator=second))


def test_a_stream_of_another_kind_of_device_continues_as_one_of_its_own():
    """After the 16 bytes of a GPU a CPU continues as they and the seed determine, and warns that it is another."""
    states = [torch.tensor([0] * 8 + [offset] + [0] * 7, dtype=torch.uint8) for offset in (4, 4, 8)]
    numbers = []
    for state in states:
        stream = generator(3, "a", torch.device("cpu"))
        untouched = torch.rand(5, generator=stream)
        with pytest.warns(UserWarning, match="not a bit-for-bit continuation"):
            restore(stream, state)
        numbers.append(torch.rand(5, generator=stream))
        assert not torch.equal(numbers[-1], untouched)
    assert torch.equal(numbers[0], numbers[1])
    assert not torch.equal(numbers[0], numbers[2])
