"""Counter-based random numbers: the right ones, evenly spread, and addressed by nobody but their owner."""

import itertools

import numpy as np
import pytest
import torch
import warp as wp
from deimos.kernels.random import Purpose, draw_uniforms, draw_words, vec4u

from deimos.nn import random

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


def words(counter, key, device):
    """The kernel's output, uint32, shape (n, 4)."""
    counter = wp.array(np.asarray(counter, np.uint32), dtype=vec4u, device=device)
    key = wp.array(np.asarray(key, np.uint32), dtype=wp.uint32, device=device)
    word = wp.full(counter.shape, vec4u(*[wp.uint32(7)] * 4), dtype=vec4u, device=device)
    draw_words(counter, key, word)
    return word.numpy()


def uniforms(row, count, device, *, seed=0, purpose=Purpose.GOAL, world_offset=0):
    """The kernel's output, float32, shape (n, 4)."""
    row = wp.array(np.asarray(row, np.int32), dtype=wp.int32, device=device)
    count = wp.array(np.asarray(count, np.int32), dtype=wp.int32, device=device)
    draw = wp.full(row.shape, wp.vec4(np.nan), dtype=wp.vec4, device=device)
    draw_uniforms(row, count, draw, seed=seed, purpose=purpose, world_offset=world_offset)
    return draw.numpy()


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_gives_the_known_answers(device, philox_reference, counter, key, expected):
    """Kernel and reference give the words that the authors of Philox publish."""
    np.testing.assert_array_equal(words([counter], [key], device)[0], expected)
    np.testing.assert_array_equal(philox_reference(counter, key), expected)


@pytest.mark.parametrize("n", [1, 257])
def test_words_match_reference(device, philox_reference, n):
    """Words of random counters and keys equal the paper's rounds, bit for bit."""
    rng = np.random.default_rng(seed=n)
    counter = rng.integers(2**32, size=(n, 4), dtype=np.uint32)
    key = rng.integers(2**32, size=(n, 2), dtype=np.uint32)
    np.testing.assert_array_equal(words(counter, key, device), philox_reference(counter, key))


def test_every_part_of_counter_and_key_counts(device):
    """Changing any single word of the counter or of the key changes all four words that come out."""
    counter, key = np.zeros((7, 4), np.uint32), np.zeros((7, 2), np.uint32)
    for part in range(4):
        counter[1 + part, part] = 1
    for part in range(2):
        key[5 + part, part] = 1
    word = words(counter, key, device)
    for a, b in itertools.combinations(range(7), 2):
        assert np.all(word[a] != word[b])


@pytest.mark.parametrize("seed", [0, 12345, 2**32 - 1])
@pytest.mark.parametrize("purpose", list(Purpose))
def test_uniforms_match_reference(device, uniform_reference, seed, purpose):
    """A draw is the top 24 bits of the word addressed by seed, purpose, global world and count, exactly."""
    rng = np.random.default_rng(seed=1)
    count = rng.integers(2**31, size=100)
    row = rng.permutation(100)[:37]
    draw = uniforms(row, count, device, seed=seed, purpose=purpose, world_offset=1000)
    np.testing.assert_array_equal(draw, uniform_reference(seed, purpose, 1000 + row, count[row]))


def test_uniforms_are_uniform(device):
    """Draws lie in [0, 1), and mean, variance and Kolmogorov-Smirnov distance are those of a uniform number."""
    worlds = 2**16
    u = uniforms(np.arange(worlds), np.arange(worlds) % 5, device).astype(np.float64).ravel()
    n = len(u)

    assert u.min() >= 0.0
    assert u.max() < 1.0
    assert abs(u.mean() - 1 / 2) < SIGMAS / np.sqrt(12 * n)  # the variance of a uniform number is 1/12
    spread = (u - 1 / 2) ** 2  # of mean 1/12 and variance 1/80 - 1/144 = 1/180
    assert abs(spread.mean() - 1 / 12) < SIGMAS / np.sqrt(180 * n)
    ordered = np.sort(u)
    above, below = np.arange(1, n + 1) / n - ordered, ordered - np.arange(n) / n
    distance = max(above.max(), below.max())
    assert distance < np.sqrt(np.log(2 / 1e-6) / (2 * n))  # Dvoretzky-Kiefer-Wolfowitz, one in a million


def test_addresses_draw_independently(device):
    """Numbers of the four lanes and of neighbouring worlds, counts, seeds and purposes do not correlate."""
    n = 2**14
    world, zero = np.arange(n + 1), np.zeros(n + 1)
    here = uniforms(world, zero, device)
    others = {
        "lane": (here[:-1, 0], here[:-1, 1]),
        "world": (here[:-1, 0], here[1:, 0]),
        "count": (here[:, 0], uniforms(world, zero + 1, device)[:, 0]),
        "seed": (here[:, 0], uniforms(world, zero, device, seed=1)[:, 0]),
        "purpose": (here[:, 0], uniforms(world, zero, device, purpose=Purpose.CANDIDATE)[:, 0]),
    }
    for name, (a, b) in others.items():
        assert abs(np.corrcoef(a, b)[0, 1]) < SIGMAS / np.sqrt(n), name


def test_purposes_are_distinct():
    """No two purposes share a key, or they would share a stream."""
    assert len({int(purpose) for purpose in Purpose}) == len(Purpose.__members__)


def test_purposes_of_torch_are_in_the_table():
    """What torch draws by address has the numbers that the table of purposes keeps for it."""
    assert {purpose.name: int(purpose) for purpose in random.Purpose}.items() <= {
        purpose.name: int(purpose) for purpose in Purpose
    }.items()


def test_uniforms_are_independent_of_the_other_rows(device):
    """A world draws the same numbers alone, in any order, and whatever the others have drawn so far."""
    count = np.arange(50)
    everyone = uniforms(np.arange(50), count, device, seed=3)

    np.testing.assert_array_equal(uniforms([17], count, device, seed=3)[0], everyone[17])
    np.testing.assert_array_equal(uniforms([30, 4, 17], count, device, seed=3), everyone[[30, 4, 17]])
    others = np.where(count == 17, 17, count + 9)
    np.testing.assert_array_equal(uniforms(np.arange(50), others, device, seed=3)[17], everyone[17])


def test_two_shards_draw_what_the_whole_draws(device):
    """World 0 of a shard with an offset of 20 is world 20 of the whole."""
    count = np.arange(40)
    whole = uniforms(np.arange(40), count, device)
    shard = uniforms(np.arange(20), count[20:], device, world_offset=20)
    np.testing.assert_array_equal(shard, whole[20:])


def test_draws_land_in_shared_memory(device):
    """A torch view made before the launch sees the draws at the same address."""
    row, count = (wp.array([0, 1, 2], dtype=wp.int32, device=device) for _ in range(2))
    draw = wp.full(3, wp.vec4(np.nan), dtype=wp.vec4, device=device)
    view = wp.to_torch(draw)
    draw_uniforms(row, count, draw, seed=0, purpose=Purpose.GOAL, world_offset=0)
    assert view.data_ptr() == draw.ptr
    assert bool(((view >= 0) & (view < 1)).all())


def test_words_land_in_shared_memory(device):
    """A torch view made before the launch sees the words at the same address."""
    counter, word = (wp.zeros(1, dtype=vec4u, device=device) for _ in range(2))
    view = wp.to_torch(word)
    draw_words(counter, wp.zeros((1, 2), dtype=wp.uint32, device=device), word)
    assert view.data_ptr() == word.ptr
    assert [value & ONES for value in view[0].tolist()] == KNOWN_ANSWERS[0][2]


def test_recorded_draw_waits_for_its_launch(device):
    """A recorded launch writes nothing until it is replayed, and then what a direct one writes."""
    row, count = (wp.array([0, 1, 2], dtype=wp.int32, device=device) for _ in range(2))
    draw = wp.full(3, wp.vec4(np.nan), dtype=wp.vec4, device=device)
    launch = draw_uniforms(row, count, draw, seed=5, purpose=Purpose.PUSH, world_offset=0, record=True)
    assert np.isnan(draw.numpy()).all()
    launch.launch()
    np.testing.assert_array_equal(draw.numpy(), uniforms([0, 1, 2], [0, 1, 2], device, seed=5, purpose=Purpose.PUSH))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"counter": ((3,), wp.vec4)}, r"counter must be vec4u\(3,\).*got vec4f\(3,\)"),
        ({"key": ((3, 4), wp.uint32)}, r"key must be uint32\(3, 2\).*got uint32\(3, 4\)"),
        ({"key": ((3, 2), wp.int32)}, r"key must be uint32\(3, 2\).*got int32\(3, 2\)"),
        ({"word": ((2,), vec4u)}, r"word must be vec4u\(3,\).*got vec4u\(2,\)"),
    ],
)
def test_draw_words_rejects(device, wrong, message):
    """The message names the argument, what it must be and what it was."""
    right = {"counter": ((3,), vec4u), "key": ((3, 2), wp.uint32), "word": ((3,), vec4u)}
    arrays = {name: wp.zeros(shape, dtype=dtype, device=device) for name, (shape, dtype) in (right | wrong).items()}
    with pytest.raises(ValueError, match=message):
        draw_words(**arrays)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"row": ((3,), wp.int64)}, r"row must be int32\(3,\).*got int64\(3,\)"),
        ({"count": ((9,), wp.float32)}, r"count must be int32\(9,\).*got float32\(9,\)"),
        ({"draw": ((3,), wp.vec3)}, r"draw must be vec4f\(3,\).*got vec3f\(3,\)"),
        ({"draw": ((9,), wp.vec4)}, r"draw must be vec4f\(3,\).*got vec4f\(9,\)"),
    ],
)
def test_draw_uniforms_rejects(device, wrong, message):
    """The message names the argument, what it must be and what it was."""
    right = {"row": ((3,), wp.int32), "count": ((9,), wp.int32), "draw": ((3,), wp.vec4)}
    arrays = {name: wp.zeros(shape, dtype=dtype, device=device) for name, (shape, dtype) in (right | wrong).items()}
    with pytest.raises(ValueError, match=message):
        draw_uniforms(**arrays, seed=0, purpose=Purpose.GOAL, world_offset=0)


@pytest.mark.parametrize("seed", [0, 1, 2**31, ONES])
def test_uniforms_are_torchs(torch_device, seed):
    """For every world and count they are the numbers of ``deimos.nn.random``, bit for bit."""
    rng = np.random.default_rng(seed)
    count = rng.integers(2**31, size=257, dtype=np.int32)
    row = rng.integers(257, size=1000, dtype=np.int32)
    device = "cpu" if torch_device.type == "cpu" else "cuda:0"
    arrays = [wp.array(values, dtype=wp.int32, device=device) for values in (row, count)]
    expected = wp.zeros(1000, dtype=wp.vec4, device=device)
    draw_uniforms(*arrays, expected, seed=seed, purpose=Purpose.GOAL, world_offset=12_345)
    world, count = (torch.from_numpy(values).long().to(torch_device) for values in (row, count))
    found = random.uniforms(seed, Purpose.GOAL, world + 12_345, count[world])
    assert torch.equal(found.cpu(), torch.from_numpy(expected.numpy()))
