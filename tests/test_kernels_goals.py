"""Uniform candidates for goals."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.episodes import make_worlds, set_goals
from deimos.kernels.goals import draw_candidates
from deimos.kernels.lanes import WIDE, lanes, threads
from deimos.kernels.random import Purpose

U = 2.0**-24  # relative error of one float32 operation
SIGMAS = 5.0  # a sound generator's mean is off by more than this once in 1.7 million tests


def make(goal_count, device, *, goal_scale, origin=None, seed=0, world_offset=0):
    """Worlds that have received so many goals."""
    worlds = make_worlds(
        len(goal_count), device, obs_dim=len(goal_scale), action_dim=1, goal_start=0, goal_scale=goal_scale,
        goal_period=1, seed=seed, world_offset=world_offset,
    )  # fmt: skip
    worlds.goal_count.assign(np.asarray(goal_count, np.int32))
    if origin is not None:
        worlds.origin = wp.array(origin, dtype=wp.float32, device=device)
    return worlds


def arrays_for(row, scale, count, device):
    """Rows, half sides and candidates, which are NaN."""
    row = wp.array(np.asarray(row, np.int32), dtype=wp.int32, device=device)
    scale = wp.array(np.asarray(scale, np.float32), dtype=wp.float32, device=device)
    return row, scale, wp.full((*row.shape, count, *scale.shape), np.nan, dtype=wp.float32, device=device)


def draw(row, goal_count, scale, count, device, *, goal_scale=1.0, **more):
    """The kernel's output, float32, shape (n, count, goal_dim)."""
    row, scale, candidate = arrays_for(row, scale, count, device)
    draw_candidates(
        row, scale, candidate, make(goal_count, device, goal_scale=[goal_scale] * len(scale), **more)
    ).launch()
    return candidate.numpy()


@pytest.mark.parametrize("goal_dim", [1, 2, 3, 4, 5, 6])
def test_candidates_match_reference(device, uniform_reference, goal_dim):
    """Component 4 b + l of candidate k is lane l of block b of the world's draw k, scaled, bit for bit."""
    rng = np.random.default_rng(seed=goal_dim)
    goal_count = rng.integers(1000, size=20)
    row = rng.permutation(20)[:11]
    scale = rng.uniform(0.1, 2000.0, size=goal_dim).astype(np.float32)

    candidate = draw(row, goal_count, scale, 7, device, seed=9, world_offset=50)

    expected = np.empty_like(candidate)
    for i, env in enumerate(row):
        for k in range(7):
            for c in range(goal_dim):
                u = uniform_reference(9, Purpose.CANDIDATE, 50 + env, goal_count[env], k, c // 4)[c % 4]
                # 2 u - 1 is exact in float32, so the product with the scale rounds once.
                expected[i, k, c] = np.float32(2.0 * u - 1.0) * scale[c]
    np.testing.assert_array_equal(candidate, expected)


def test_candidates_are_uniform_in_the_box(device):
    """Every component keeps to [-scale, scale), has a uniform number's mean and spread, and ignores the rest."""
    scale = np.array([0.5, 1.0, 1250.0, 3.0, 10.0], np.float32)
    x = draw(np.arange(2000), np.zeros(2000), scale, 20, device).reshape(-1, 5).astype(np.float64) / scale
    n = len(x)

    assert x.min() >= -1.0
    assert x.max() < 1.0
    assert np.all(np.abs(x.mean(axis=0)) < SIGMAS / np.sqrt(3 * n))  # the variance of a component is 1/3
    # Its square has the mean 1/3 and the variance 1/5 - 1/9 = 4/45.
    assert np.all(np.abs((x**2).mean(axis=0) - 1 / 3) < SIGMAS * np.sqrt(4 / 45 / n))
    correlation = np.corrcoef(x.T) - np.eye(5)
    assert np.all(np.abs(correlation) < SIGMAS / np.sqrt(n))


def test_first_of_a_longer_list_are_the_same(device):
    """Asking for fewer candidates gives the first ones of a longer list."""
    longer = draw([3, 1], [4, 5, 6, 7], [1.0, 2.0, 3.0], 100, device)
    for count in (1, 2, 33):
        np.testing.assert_array_equal(draw([3, 1], [4, 5, 6, 7], [1.0, 2.0, 3.0], count, device), longer[:, :count])


def test_candidates_are_independent_of_the_other_rows(device):
    """A world is offered the same goals alone, in any order, and whatever the others' counts are."""
    goal_count = np.arange(30)
    everyone = draw(np.arange(30), goal_count, [1.0, 2.0, 3.0], 5, device)
    np.testing.assert_array_equal(draw([21], goal_count, [1.0, 2.0, 3.0], 5, device)[0], everyone[21])
    others = np.where(goal_count == 21, 21, 77)
    np.testing.assert_array_equal(draw([2, 21], others, [1.0, 2.0, 3.0], 5, device)[1], everyone[21])


def test_two_shards_are_offered_what_the_whole_is(device):
    """World 0 of a shard with an offset of 20 is world 20 of the whole."""
    whole = draw(np.arange(40), np.arange(40), [1.0], 3, device)
    shard = draw(np.arange(20), np.arange(20, 40), [1.0], 3, device, world_offset=20)
    np.testing.assert_array_equal(shard, whole[20:])


def test_every_goal_worlds_and_seed_differ(device):
    """Another goal of the same world, another world and another seed are offered other candidates."""
    base = draw([0], [0, 0], [1.0, 1.0, 1.0], 4, device)
    for other in (
        draw([0], [1, 0], [1.0, 1.0, 1.0], 4, device),
        draw([1], [0, 0], [1.0, 1.0, 1.0], 4, device),
        draw([0], [0, 0], [1.0, 1.0, 1.0], 4, device, seed=1),
    ):
        assert np.all(base != other)


@pytest.mark.parametrize("count", [1, 7, 100])
def test_candidates_are_seen_from_the_origin(device, count):
    """From every candidate the scaled origin of its own world is subtracted; from the middle it is where it is."""
    rng = np.random.default_rng(seed=count)
    x = rng.uniform(-1000, 1000, (50, 3)).astype(np.float32)
    row = rng.permutation(50)[:40]
    given = {"goal_count": np.zeros(50), "scale": [1.25] * 3, "count": count, "device": device, "goal_scale": 1e-3}
    candidate, result = draw(row, **given), draw(row, **given, origin=x)

    origin = x[row].astype(np.float64)[:, None] / 1000
    expected = candidate - origin
    error = np.abs(result - expected)
    assert np.all(error <= 1.01 * U * (2 * np.abs(origin) + np.abs(expected)))  # scale, product; difference
    np.testing.assert_array_equal(draw(row, **given, origin=0 * x), candidate)


def test_candidate_that_is_set_gives_the_place_back(device):
    """A candidate place that is seen from an origin and set as a goal becomes that place again."""
    x = np.random.default_rng(seed=8).uniform(-1000, 1000, (30, 3)).astype(np.float32)
    place = 1000 * draw(np.arange(30), np.zeros(30), [1.25] * 3, 1, device, goal_scale=1e-3)[:, 0].astype(np.float64)
    worlds = make(np.zeros(30), device, goal_scale=[1e-3] * 3, origin=x)
    row, scale, candidate = arrays_for(np.arange(30), [1.25] * 3, 1, device)
    draw_candidates(row, scale, candidate, worlds).launch()
    set_goals(row, wp.array(candidate.numpy()[:, 0], dtype=wp.float32, device=device), worlds).launch()
    # The candidate rounds; the origin twice, but its scale's error returns in the quotient; then difference,
    # quotient with the scale's error, and sum.
    error = np.abs(worlds.goal.numpy() - place)
    assert np.all(error <= 1.01 * U * (3 * np.abs(place) + 3 * np.abs(x) + 3 * np.abs(place - x)))


@pytest.mark.parametrize("origin", [None, [[0.5, 0.0, 0.0]] * 2])
def test_recorded_draw_waits_for_its_launch(device, origin):
    """Nothing is written before the launch, and then only its rows, in the memory of an earlier torch view."""
    arrays = arrays_for([0, 1], [1.0, 1.0, 1.0], 4, device)
    view = wp.to_torch(arrays[2])
    launch = draw_candidates(*arrays, make([0, 1], device, goal_scale=[1.0] * 3, origin=origin))
    assert bool(view.isnan().all())
    launch.set_dim((1, launch.bounds.shape[1]))
    launch.launch()
    assert view.data_ptr() == arrays[2].ptr
    expected = draw([0], [0, 1], [1.0, 1.0, 1.0], 4, device, origin=origin)
    np.testing.assert_array_equal(view[:1].cpu().numpy(), expected)
    assert bool(view[1].isnan().all())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"row": ((2,), wp.int64)}, r"row must be int32\(2,\).*got int64\(2,\)"),
        ({"scale": ((4,), wp.float32)}, r"scale must be float32\(3,\).*got float32\(4,\)"),
        ({"candidate": ((2, 3), wp.float32)}, r"candidate must have 3 axes, got the shape \(2, 3\)"),
        ({"candidate": ((4, 7, 3), wp.float32)}, r"candidate must be float32\(2, 7, 3\).*got float32\(4, 7, 3\)"),
        ({"candidate": ((2, 7, 4), wp.float32)}, r"candidate must be float32\(2, 7, 3\).*got float32\(2, 7, 4\)"),
        ({"candidate": ((2, 7, 3), wp.float64)}, r"candidate must be float32\(2, 7, 3\).*got float64\(2, 7, 3\)"),
    ],
)
def test_draw_candidates_rejects(device, wrong, message):
    """The message names the argument, what it must be and what it was."""
    right = {"row": ((2,), wp.int32), "scale": ((3,), wp.float32), "candidate": ((2, 7, 3), wp.float32)}
    arrays = {name: wp.zeros(shape, dtype=dtype, device=device) for name, (shape, dtype) in (right | wrong).items()}
    with pytest.raises(ValueError, match=message):
        draw_candidates(**arrays, worlds=make(np.zeros(5), device, goal_scale=[1.0] * 3))


def test_threads_cover_every_number(device):
    """A thread takes one number on a GPU and where there are few, else as many as its lanes."""
    device, cpu = wp.get_device(device), device == "cpu"
    assert lanes(WIDE // 4 - 1, device) == 1
    assert lanes(100, device) == (WIDE if cpu else 1)
    assert threads(7, 100, device) == (7, -(-100 // WIDE) if cpu else 100)
    assert threads(7, 3, device) == (7, 3)
