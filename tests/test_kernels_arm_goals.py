"""Goals of an arm on a legged robot: their places, which are valid, draws until one is, resets."""

import numpy as np
import pytest
import warp as wp
from arm_arrays import (
    CELL,
    CORNER,
    GARBAGE,
    ORIGIN,
    G,
    J,
    World,
    clear_reference,
    geometry,
    make_arm,
    make_world,
    place_of,
    place_reference,
    to_array,
)
from deimos.kernels.goals import draw_candidates
from deimos.kernels.legged.arm_goals import redraw_candidates
from deimos.kernels.random import Purpose
from scipy import stats


def test_goals_map_to_places_and_back(device):
    """A goal's place is spherical geometry, corners of the box are those of the shell, and the way back is exact."""
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    goals = np.concatenate([corners, np.random.default_rng(1).uniform(-1, 1, size=(500, 3))])
    _, place, back, clear = geometry(np.zeros((len(goals), 24)), goals, device)
    expected = np.array([place_reference(goal) for goal in goals])
    np.testing.assert_allclose(place, expected, rtol=0, atol=10 * 2.0**-24)
    np.testing.assert_allclose(np.linalg.norm(place[:8], axis=1), np.repeat([0.15, 0.45], 4), rtol=1e-6)
    # Places of order 0.1 m are off by some 2^-26, an angle by that over the least level distance of 0.075 m.
    np.testing.assert_allclose(back, goals, rtol=0, atol=2e-6)
    assert np.array_equal(clear, clear_reference(goals))
    assert 0.1 < 1 - clear.mean() < 0.5


def draw(device, n, count, scale, *, arm=None, seed=3, world_offset=20, heights=None):
    """Candidates before and after ``redraw_candidates``, each (n, count, 6); robots face x at the world's origin."""
    arrays = make_world(n)
    arrays["qpos"] = np.zeros((n, 7 + J))
    arrays["qpos"][:, 3] = 1.0
    ground = np.zeros((121, 161)) if heights is None else heights
    world = World(
        arrays, device, seed=seed, world_offset=world_offset, heights=ground, arm=arm or make_arm(device, n=n)
    )
    world.worlds.goal_count.assign(np.arange(n) % 4)
    row = wp.array(np.arange(n), dtype=wp.int32, device=device)
    scale = to_array(scale, device)
    candidate = wp.full((n, count, G), np.nan, dtype=wp.float32, device=device)
    draw_candidates(row, scale, candidate, world.worlds).launch()
    first = candidate.numpy().copy()
    redraw_candidates(world.legged, world.arm, row, scale, candidate).launch()
    return first, candidate.numpy()


def test_no_goal_is_in_the_ground(device):
    """Beyond the edge of a high step goals stay above it by the clearance; those before it are as on level ground."""
    x = CORNER[0] + CELL * np.arange(121)
    heights = np.tile(np.where(x > 0.25, 0.5, 0.0)[:, None], (1, 161))  # rises from 0 to 0.5 m between 0.2 and 0.3 m
    first, last = draw(device, 60, 100, np.ones(G), heights=heights)
    level = draw(device, 60, 100, np.ones(G))[1].reshape(-1, G)[:, 3:]

    # The highest row of points below the trunk is at 0.19 m, before the step, so the origin is where it is without one.
    def above(goals):
        points = np.array([place_reference(goal) for goal in goals]) + ORIGIN
        return points[:, 2] - 0.5 * np.clip((points[:, 0] - 0.2) / 0.1, 0.0, 1.0)

    goals = last.reshape(-1, G)[:, 3:]
    assert above(goals).min() >= 0.035 - 1e-5
    sunk = above(level) < 0.035
    assert sunk.mean() > 0.05
    np.testing.assert_array_equal(goals[~sunk], level[~sunk])
    assert not np.any(goals[sunk] == level[sunk])
    assert np.isfinite(first).all()


def test_redraws_match_reference(device, uniform_reference):
    """Valid candidates stay bit for bit; others become the first valid one of further draws of their own address."""
    scale = np.array([1.0, 0.5, 2.0, 1.0, 0.9, 0.8], np.float32)
    first, last = draw(device, 12, 9, scale)
    np.testing.assert_array_equal(first[..., :3], last[..., :3])
    changed = 0
    for i in range(12):
        for k in range(9):
            goal, block = first[i, k, 3:], 2
            while not clear_reference([goal])[0]:
                u = uniform_reference(3, Purpose.CANDIDATE, 20 + i, i % 4, k, block)[:3]
                goal, block = np.float32(2 * u - 1) * scale[3:], block + 1
            changed += block > 2
            np.testing.assert_array_equal(last[i, k, 3:], goal)
    assert changed > 5


def test_no_goal_is_ever_invalid_and_valid_ones_are_uniform(device):
    """Of 200 000 goals not one is in the box, and cells that are all valid get equal shares (chi-square)."""
    goals = draw(device, 400, 500, np.ones(6))[1].reshape(-1, G)[:, 3:]
    assert geometry(np.zeros((len(goals), 24)), goals, device)[3].all()
    cells = 6
    edges = np.linspace(-1, 1, cells + 1)
    corners = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5 * cells + 1)] * 3, indexing="ij"), axis=-1)
    clear = clear_reference(corners.reshape(-1, 3)).reshape(corners.shape[:3])
    whole = np.array([
        clear[tuple(slice(5 * c, 5 * c + 6) for c in cell)].all() for cell in np.ndindex(cells, cells, cells)
    ])  # fmt: skip
    counts = np.histogramdd(goals, bins=[edges] * 3)[0].reshape(-1)[whole]
    assert 100 < whole.sum() < cells**3
    # A sound generator fails this once in a million.
    assert stats.chisquare(counts).pvalue > 1e-6


def test_where_no_goal_is_valid_it_is_the_middle(device):
    """After the last draw the arm's part is 0: a place before the shoulder."""
    everywhere = np.full(3, 1e3)
    goals = draw(device, 3, 4, np.ones(6), arm=make_arm(device, -everywhere, everywhere, n=3))[1]
    assert np.all(goals[..., 3:] == 0)
    assert clear_reference([np.zeros(3)])[0]


def test_reset_matches_reference(device, uniform_reference):
    """In masked worlds the first goal is valid, drawn again from its own address, and seen; others keep every bit."""
    arrays = make_world(120, seed=2)
    goal_range = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.5], np.float32)
    mask = np.arange(120) % 3 > 0
    world = World(arrays, device)
    before = world.worlds.goal.numpy().copy()
    world.reset(mask, goal_range)
    goals, obs, error = world.worlds.goal.numpy(), world.worlds.obs.numpy(), world.arm.error.numpy()
    changed = 0
    for i in range(120):
        if not mask[i]:
            np.testing.assert_array_equal(goals[i], before[i])
            assert np.all(obs[i] == GARBAGE)
            assert error[i] == GARBAGE
            continue
        goal, block = before[i, 3:], 2
        while not clear_reference([goal])[0]:
            u = uniform_reference(9, Purpose.FIRST_GOAL, 50 + i, arrays["episode_count"][i] - 1, 0, block)[:3]
            goal, block = np.float32(2 * u - 1) * goal_range[3:], block + 1
        changed += block > 2
        np.testing.assert_array_equal(goals[i], np.append(before[i, :3], goal))
        np.testing.assert_array_equal(obs[i, 9:15], goals[i] * np.float32([2, 2, 0.25, 1, 1, 1]))
        place = place_of(arrays["qpos"][i])
        np.testing.assert_allclose(error[i], np.linalg.norm(place - place_reference(goal)), rtol=0, atol=2e-6)
    assert changed > 3


def test_redraws_reject_arrays_of_another_shape(device):
    """Candidates have all components of a goal."""
    world, ints = World(make_world(5), device), wp.zeros(2, dtype=wp.int32, device=device)
    right, short = (wp.zeros((2, 4, width), dtype=wp.float32, device=device) for width in (6, 3))
    scale = to_array(np.ones(6), device)
    with pytest.raises(ValueError, match=r"candidate must be float32\(2, 4, 6\).*got float32\(2, 4, 3\)"):
        redraw_candidates(world.legged, world.arm, ints, scale, short)
    with pytest.raises(ValueError, match=r"scale must be float32\(6,\).*got float32\(3,\)"):
        redraw_candidates(world.legged, world.arm, ints, to_array(np.ones(3), device), right)
