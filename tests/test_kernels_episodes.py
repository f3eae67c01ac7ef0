"""What all environments share: clocks, first goals, new goals, relative goals, the end of a step."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels import episodes
from deimos.kernels.episodes import (
    RESUMED,
    WORLDS,
    begin_episode,
    end_step,
    make_worlds,
    record,
    set_goals,
    write_goal,
)
from deimos.kernels.random import Purpose

U = 2.0**-24  # relative error of one float32 operation
GOAL_START = 2  # of observations of 2 + goal_dim components


@wp.kernel(enable_backward=False)
def _end_steps(
    worlds: episodes.Worlds,
    crashed: wp.array[wp.bool],
    over: wp.array[wp.bool],
    cause: wp.array[int],
):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        end_step(env, crashed[env], over[env], cause[env], worlds)


@wp.kernel(enable_backward=False)
def _begin_episodes(worlds: episodes.Worlds, number: wp.array[int]):
    for env in range(wp.tid(), worlds.num_envs, worlds.num_threads):
        if worlds.mask[env]:
            number[env] = begin_episode(env, worlds)
            write_goal(env, worlds)


def make(num_envs, device, *, goal_dim=3, scale=0.1, origin=None, values=None, **task):
    """Worlds with observations of NaN and the given arrays."""
    task = {"goal_period": 100} | task
    worlds = make_worlds(
        num_envs, device, obs_dim=GOAL_START + goal_dim, action_dim=1, goal_start=GOAL_START,
        goal_scale=[scale] * goal_dim, **task,
    )  # fmt: skip
    worlds.obs.fill_(np.nan)
    for name, value in (values or {}).items():
        array = getattr(worlds, name)
        array.assign(np.broadcast_to(np.asarray(value, array.numpy().dtype), array.shape))
    if origin is not None:
        worlds.origin = wp.array(origin, dtype=wp.float32, device=device)
    return worlds


def integers(values, device):
    """An int32 array."""
    return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=device)


def begin(worlds, mask=True, first_range=10.0):
    """Begin an episode in the worlds of ``mask``; gives the numbers of the episodes."""
    worlds.mask.assign(np.broadcast_to(mask, worlds.num_envs))
    worlds.first_range.assign(np.broadcast_to(np.float32(first_range), worlds.first_range.shape))
    number = integers([-1] * worlds.num_envs, worlds.goal.device)
    record(_begin_episodes, worlds, number).launch()
    return number.numpy()


def give(worlds, row, goal):
    """Give the listed worlds new goals."""
    device = worlds.goal.device
    set_goals(integers(row, device), wp.array(goal, dtype=wp.float32, device=device), worlds).launch()


def snapshot(worlds):
    """The bytes of everything that a resume needs, world by world."""
    return {name: [row.tobytes() for row in getattr(worlds, name).numpy()] for name in RESUMED}


def test_ends_of_steps_by_hand(device):
    """Goals fall due at T, episodes end at the limit or for a reason unless they crash; invalid worlds are cut off."""
    # goal clock, age, crashed, over, cause -> goal due, truncated; T = 3 and the limit is 8
    table = [
        (0, 0, False, False, 0, False, False),
        (1, 6, False, False, 0, False, False),
        (2, 6, False, False, 0, True, False),
        (5, 6, False, False, 0, True, False),
        (1, 7, False, False, 0, False, True),
        (2, 7, False, False, 0, True, True),
        (2, 0, True, False, 0, True, False),
        (2, 7, True, False, 0, True, False),
        (0, 7, True, True, 0, False, False),
        (0, 9, False, False, 0, False, True),
        (2, 0, False, True, 0, True, True),
        (2, 0, False, False, 6, False, True),
        (2, 0, True, False, 3, False, False),
    ]
    clock, age, crashed, over, cause, due, truncated = (list(column) for column in zip(*table, strict=True))
    n = len(table)
    worlds = make(n, device, goal_period=3, time_limit=8, values={
        "goal_clock": clock, "episode_step": age, "goal_count": 7, "terminated": True, "invalid": True,
    })  # fmt: skip
    flags = [wp.array(flag, dtype=wp.bool, device=device) for flag in (crashed, over)]

    record(_end_steps, worlds, *flags, integers(cause, device)).launch()

    assert worlds.goal_due.numpy().tolist() == due
    assert worlds.truncated.numpy().tolist() == truncated
    assert worlds.terminated.numpy().tolist() == crashed
    assert worlds.invalid.numpy().tolist() == [bits != 0 for bits in cause]
    assert worlds.goal_clock.numpy().tolist() == [value + 1 for value in clock]
    assert worlds.episode_step.numpy().tolist() == [value + 1 for value in age]
    assert worlds.goal_count.numpy().tolist() == [7] * n
    assert worlds.episode_count.numpy().tolist() == [0] * n
    assert worlds.fault.numpy().tolist() == [2, 11, 12]  # two of them, the first of them, the first with ACTION
    assert worlds.cause.numpy().tolist() == cause
    assert np.isnan(worlds.obs.numpy()).all()  # goals that are not relative stay as they were shown


def test_no_time_limit_never_comes(device):
    """With a limit of 0 no episode is truncated, however long it lasts."""
    worlds = make(2, device, values={"episode_step": [0, 2**30]})
    flags = [wp.zeros(2, dtype=wp.bool, device=device) for _ in range(2)]
    record(_end_steps, worlds, *flags, integers([0, 0], device)).launch()
    assert not worlds.truncated.numpy().any()


def test_relative_goals_are_shown_anew_at_the_end_of_a_step(device):
    """Where goals are relative, a step ends with the way from the origin as it is then."""
    worlds = make(2, device, scale=0.5, origin=[[1.0, 2.0, 4.0], [0.0, 0.0, 0.0]], values={"goal": [8.0, 8.0, 8.0]})
    flags = [wp.zeros(2, dtype=wp.bool, device=device) for _ in range(2)]
    record(_end_steps, worlds, *flags, integers([0, 0], device)).launch()
    assert worlds.obs.numpy()[:, GOAL_START:].tolist() == [[3.5, 3.0, 2.0], [4.0, 4.0, 4.0]]


@pytest.mark.parametrize("goal_dim", [1, 3, 4, 6])
def test_first_goals_match_reference(device, uniform_reference, goal_dim):
    """Component 4 b + l of a first goal is lane l of block b of the draw of the episode, scaled, bit for bit."""
    rng = np.random.default_rng(seed=goal_dim)
    episode, ranges = rng.integers(1000, size=20), rng.uniform(0.1, 2000.0, goal_dim).astype(np.float32)
    worlds = make(20, device, goal_dim=goal_dim, seed=9, world_offset=50, values={
        "episode_count": episode, "goal_clock": 8, "episode_step": 9, "goal_count": 7,
    })  # fmt: skip

    number = begin(worlds, first_range=ranges)

    u = np.stack([
        uniform_reference(9, Purpose.FIRST_GOAL, 50 + np.arange(20), episode, 0, c // 4)[:, c % 4]
        for c in range(goal_dim)
    ], axis=1)  # fmt: skip
    goal = np.float32(2.0 * u - 1.0) * ranges
    np.testing.assert_array_equal(worlds.goal.numpy(), goal)
    np.testing.assert_array_equal(worlds.obs.numpy()[:, GOAL_START:], goal * np.float32(0.1))
    np.testing.assert_array_equal(number, episode)
    np.testing.assert_array_equal(worlds.episode_count.numpy(), episode + 1)
    assert not worlds.goal_clock.numpy().any()
    assert not worlds.episode_step.numpy().any()
    np.testing.assert_array_equal(worlds.goal_count.numpy(), 7)


def test_only_the_first_episode_is_staggered(device, uniform_reference):
    """The first goal clock starts at a random step below T; from the second episode on at 0."""
    n = 500
    worlds = make(n, device, stagger=True, goal_period=7, seed=4)
    begin(worlds)
    u = uniform_reference(4, Purpose.RESET, np.arange(n), 0, index=1)[:, 0]
    np.testing.assert_array_equal(worlds.goal_clock.numpy(), np.floor(u * 7))
    assert set(worlds.goal_clock.numpy().tolist()) == set(range(7))
    begin(worlds)
    np.testing.assert_array_equal(worlds.goal_clock.numpy(), 0)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("num_envs", [1, 257])
def test_set_goals_matches_reference(device, relative, num_envs):
    """A goal becomes what it stands for in physical units, and is seen as it was given."""
    rng = np.random.default_rng(seed=num_envs)
    row = rng.permutation(num_envs)[: num_envs // 2 + 1]
    x = rng.uniform(-1000, 1000, (num_envs, 3)).astype(np.float32)
    given = rng.uniform(-1.25, 1.25, (len(row), 3)).astype(np.float32)
    values = {"goal_clock": 100, "goal_count": np.arange(num_envs)}
    worlds = make(num_envs, device, scale=1e-3, origin=x if relative else None, values=values)

    give(worlds, row, given)

    goal = given.astype(np.float64) * 1000 + (x[row].astype(np.float64) if relative else 0.0)
    # Scale and quotient round, and so does the sum with the origin.
    goal_error = 2.01 * U * np.abs(given * 1000) + 1.01 * U * np.abs(goal)
    assert np.all(np.abs(worlds.goal.numpy()[row] - goal) <= goal_error)
    # Back again the scale's own error cancels; the difference with the origin is that of the sum.
    seen = worlds.obs.numpy()[row][:, GOAL_START:]
    sum_error = np.abs(goal) / 1000 if relative else 0.0
    assert np.all(np.abs(seen - given) <= 1.01 * U * (3 * np.abs(given) + sum_error))
    np.testing.assert_array_equal(worlds.goal_clock.numpy()[row], 0)
    np.testing.assert_array_equal(worlds.goal_count.numpy()[row], row + 1)


@pytest.mark.parametrize("relative", [False, True])
def test_set_goals_touches_nothing_else(device, relative):
    """Other worlds keep every byte, and listed worlds all but their goal, its clock and its count."""
    origin = np.ones((4, 3), np.float32) if relative else None
    worlds = make(4, device, origin=origin, values={"goal_clock": 5, "episode_step": 6})
    before = snapshot(worlds)
    give(worlds, [2, -1, 0, 4], [[0.5, 0.5, 0.5], [0.1, 0.1, 0.1], [-1.0, 0.0, 1.0], [0.2, 0.2, 0.2]])  # -1, 4: nobody
    after = snapshot(worlds)
    for name in before:
        assert [before[name][i] == after[name][i] for i in (1, 3)] == [True, True]
    for name in ("episode_step", "episode_count"):
        assert before[name] == after[name]
    assert np.isnan(worlds.obs.numpy()[[0, 2], :GOAL_START]).all()
    assert np.isfinite(worlds.obs.numpy()[[0, 2], GOAL_START:]).all()


@pytest.mark.parametrize("relative", [False, True])
def test_step_sees_the_goal_that_was_set(device, relative):
    """Setting a goal and ending a step agree on what is seen, bit for bit, while the origin stays where it is."""
    rng = np.random.default_rng(seed=6)
    origin = rng.uniform(-900, 900, (20, 3)) if relative else None
    worlds = make(20, device, scale=1e-3, origin=origin)
    give(worlds, np.arange(20), rng.uniform(-1, 1, (20, 3)))
    seen = worlds.obs.numpy()
    flags = [wp.zeros(20, dtype=wp.bool, device=device) for _ in range(2)]
    record(_end_steps, worlds, *flags, integers([0] * 20, device)).launch()
    np.testing.assert_array_equal(worlds.obs.numpy(), seen)


def test_set_goals_works_in_shared_memory(device):
    """Goals written through torch arrive, and torch views see them at the same addresses."""
    worlds, given = make(2, device), wp.zeros((1, 3), dtype=float, device=device)
    wanted, goal = wp.to_torch(given), wp.to_torch(worlds.goal)
    launch = set_goals(integers([1], device), given, worlds)
    wanted[:] = 0.5
    launch.launch()
    assert (wanted.data_ptr(), goal.data_ptr()) == (given.ptr, worlds.goal.ptr)
    assert goal.tolist() == [[0.0] * 3, [5.0] * 3]


def test_worlds_begin_with_nothing(device):
    """All arrays are zeros, but for the scale of goals and the faults, of which there are none."""
    worlds = make_worlds(
        4, device, obs_dim=5, action_dim=2, goal_start=3, goal_scale=[2.0, 0.5], goal_period=9, num_groups=2
    )
    for name in WORLDS.names:
        expected = {"goal_scale": [2.0, 0.5], "fault": [0, 4, 4]}.get(name, 0)
        np.testing.assert_array_equal(getattr(worlds, name).numpy(), expected)
    assert worlds.tracking.shape == (4, 2)
    assert worlds.num_threads == (1 if device == "cpu" else 4)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"row": ((1, 1), wp.int64)}, r"row must be int32\(1, 1\).*got int64"),
        ({"goal": ((2, 3), wp.float32)}, r"goal must be float32\(1, 3\).*got float32\(2, 3\)"),
        ({"goal": ((1, 3), wp.float64)}, r"goal must be float32\(1, 3\).*got float64\(1, 3\)"),
    ],
)
def test_set_goals_rejects_wrong_arguments(device, wrong, message):
    """The message names the argument, what it must be and what it was."""
    right = {"row": ((1,), wp.int32), "goal": ((1, 3), wp.float32)}
    arrays = {name: wp.zeros(shape, dtype=dtype, device=device) for name, (shape, dtype) in (right | wrong).items()}
    with pytest.raises(ValueError, match=message):
        set_goals(**arrays, worlds=make(4, device))
