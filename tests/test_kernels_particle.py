"""Point-mass physics, crash test and observation."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.episodes import RESUMED
from deimos.kernels.particle import BROKEN, GOAL_START, reset_particles, step_particles
from particle_arrays import FLAGS, GOAL_RANGE, GOAL_SCALE, HALF_SIDE, LARGEST_DISTANCE, VARIANTS, VECTORS, U, World


def on_grid(rng, low, high, size):
    """Random multiples of 1/128: float32 adds and halves these without rounding, so the physics is exact."""
    return rng.integers(round(low * 128), round(high * 128), size=size, endpoint=True) / 128


def step_reference(variant, x, v, f, goal):
    """One step of the thesis's section 4.1.1, in float64, one particle and one axis after another."""
    n = len(x)
    x_new, v_new, f_new, seen = (np.empty((n, 3)) for _ in range(4))
    crashed, reward = np.empty(n, bool), np.empty(n)
    for i in range(n):
        for axis in range(3):
            f_new[i, axis] = min(max(f[i, axis], -1.0), 1.0)
            v_new[i, axis] = min(max(v[i, axis] + f_new[i, axis] / 2, -10.0), 10.0)
            x_new[i, axis] = x[i, axis] + v_new[i, axis]
        crashed[i] = any(abs(x_new[i, axis]) > HALF_SIDE for axis in range(3))
        if variant == "directional":
            distance, seen[i] = np.linalg.norm(v_new[i] - goal[i]), goal[i] / 10
        elif variant == "absolute":
            distance, seen[i] = np.linalg.norm(x_new[i] - goal[i]), goal[i] / 1000
        else:
            distance, seen[i] = np.linalg.norm(x_new[i] - goal[i]), (goal[i] - x_new[i]) / 1000
        reward[i] = 1 - distance / (1.01 * LARGEST_DISTANCE[variant])
    obs = np.concatenate([v_new / 10, x_new / 1000, f_new, seen], axis=1)
    return x_new, v_new, f_new, crashed, reward, obs


@pytest.mark.parametrize("num_envs", [1, 257])
@pytest.mark.parametrize("variant", VARIANTS)
def test_step_matches_reference(device, variant, num_envs):
    """One step equals the reference in all variants, with forces, speeds and positions on both sides of each bound."""
    rng = np.random.default_rng(seed=num_envs)
    x = on_grid(rng, -HALF_SIDE, HALF_SIDE, (num_envs, 3))
    x[::3, 1] = np.sign(x[::3, 1]) * (HALF_SIDE - on_grid(rng, 0, 12, x[::3, 1].shape))  # close to a wall
    v, f = on_grid(rng, -10, 10, (num_envs, 3)), on_grid(rng, -2, 2, (num_envs, 3))
    goal = on_grid(rng, -GOAL_RANGE[variant], GOAL_RANGE[variant], (num_envs, 3))
    values = {"position": x, "velocity": v, "force": np.nan, "goal": goal}
    world = World(num_envs, device, variant, values=values)
    seen = goal.astype(np.float32) * np.float32(GOAL_SCALE[variant])
    world.set("obs", np.concatenate([np.full((num_envs, GOAL_START), np.nan), seen], axis=1))

    world.step(f)

    x_new, v_new, f_new, crashed, reward, obs = step_reference(variant, x, v, f, goal)
    np.testing.assert_array_equal(world.get("position"), x_new)
    np.testing.assert_array_equal(world.get("velocity"), v_new)
    np.testing.assert_array_equal(world.get("force"), f_new)
    np.testing.assert_array_equal(world.get("goal"), goal)
    np.testing.assert_array_equal(world.get("terminated"), crashed)
    # Two roundings: of the scale and of the product with it.
    np.testing.assert_allclose(world.get("obs"), obs, rtol=2.01 * U, atol=0)
    # The length has 3 relative errors at most, the divisor 4, the quotient 1, the difference 1.
    np.testing.assert_allclose(world.get("reward"), reward, rtol=0, atol=9 * U)
    assert np.all(world.get("reward") > 0)
    if num_envs > 1:  # or the test would not have seen both sides
        assert 0 < crashed.sum() < num_envs
        assert np.abs(v_new).max() == 10
        assert np.abs(f).max() > 1


@pytest.mark.parametrize("threads", [1, 7, 60])
def test_threads_share_the_worlds(device, threads):
    """However many threads share the worlds, each one is moved once."""
    force = np.random.default_rng(seed=0).uniform(-1, 1, (60, 3))
    expected, world = World(60, device).step(force), World(60, device)
    world.worlds.num_threads = threads
    world.step(force)
    for name in (*VECTORS, "reward", "goal_clock"):
        np.testing.assert_array_equal(world.get(name), expected.get(name))


def test_constant_force_follows_the_sum_of_its_steps(device):
    """From rest, n steps of force f give exactly v = n f / 2 and x = f n (n + 1) / 4."""
    force = np.array([1 / 64, -1 / 128, 0.0])  # so small that float32 holds every sum exactly
    world = World(1, device)
    for n in range(1, 201):
        world.step(force)
        np.testing.assert_array_equal(world.get("velocity")[0], n * force / 2)
        np.testing.assert_array_equal(world.get("position")[0], force * n * (n + 1) / 4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_mirror_worlds_move_as_mirror_images(device, variant):
    """The cube prefers no direction: mirrored states, goals and forces give mirrored steps and the same rewards."""
    rng = np.random.default_rng(seed=2)
    n = 100
    x, v, f = rng.uniform(-1000, 1000, (n, 3)), rng.uniform(-10, 10, (n, 3)), rng.uniform(-2, 2, (n, 3))
    goal = rng.uniform(-10, 10, (n, 3)) * (1 if variant == "directional" else 125)
    mirror = np.array([-1.0, 1.0, -1.0])
    results = []
    for sign in (np.ones(3), mirror):
        values = {"position": sign * x, "velocity": sign * v, "goal": sign * goal}
        world = World(n, device, variant, garbage=0.0, values=values)
        for _ in range(5):
            world.step(sign * f)
        results.append([world.get(name) for name in ("obs", "reward", "terminated")])
    (obs, reward, crashed), (mirrored_obs, mirrored_reward, mirrored_crashed) = results
    np.testing.assert_array_equal(mirrored_obs, obs * np.tile(mirror, 4).astype(np.float32))
    np.testing.assert_array_equal(mirrored_reward, reward)
    np.testing.assert_array_equal(mirrored_crashed, crashed)


def test_speed_and_force_stay_bounded(device):
    """Whatever the forces, no component of force, velocity or displacement ever exceeds its bound."""
    rng = np.random.default_rng(seed=3)
    world = World(50, device)
    for _ in range(100):
        before = world.get("position").astype(np.float64)
        world.step(rng.normal(scale=5.0, size=(50, 3)))
        displacement = np.abs(world.get("position") - before)
        assert np.abs(world.get("force")).max() <= 1.0
        assert np.abs(world.get("velocity")).max() <= 10.0
        # The new position is rounded to float32, by 2^-24 of its value at most.
        assert np.all(displacement <= 10.0 + U * np.abs(before + 10.0))


def test_force_is_halved(device):
    """A force of 1 u/step^2 on a particle at rest gives 0.5 u/step and moves it by as much."""
    world = World(1, device).step([1.0, -0.5, 0.0])
    np.testing.assert_array_equal(world.get("velocity"), [[0.5, -0.25, 0.0]])
    np.testing.assert_array_equal(world.get("position"), [[0.5, -0.25, 0.0]])


def test_velocity_is_clipped_per_component(device):
    """Only the components that exceed the bound are cut, each on its own and towards its own sign."""
    world = World(1, device, values={"velocity": [9.75, -9.75, 3.0]}).step([1.0, -1.0, 1.0])
    np.testing.assert_array_equal(world.get("velocity"), [[10.0, -10.0, 3.5]])
    np.testing.assert_array_equal(world.get("position"), [[10.0, -10.0, 3.5]])


def test_force_is_clipped_per_component_and_kept_as_applied(device):
    """The last action in the observation is the bounded force that moved the particle."""
    world = World(1, device, max_force=2.0, force_scale=0.5).step([3.0, -300.0, 0.5])
    np.testing.assert_array_equal(world.get("force"), [[2.0, -2.0, 0.5]])
    np.testing.assert_array_equal(world.get("obs")[0, 6:9], [1.0, -1.0, 0.25])


def test_force_may_be_unbounded(device):
    """Without a bound every finite force is applied as it is, and only the speed is cut."""
    world = World(1, device, max_force=np.inf).step([1e30, -12.0, 3e38])
    np.testing.assert_array_equal(world.get("force"), np.array([[1e30, -12.0, 3e38]], np.float32))
    np.testing.assert_array_equal(world.get("velocity"), [[10.0, -6.0, 10.0]])
    assert not world.get("invalid")[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_crash_is_strict(device, axis, sign):
    """A particle at exactly 1000 u is inside; at the next float32 it has crashed, along any axis and either way."""
    limit = np.float32(HALF_SIDE)
    x = np.zeros((3, 3), np.float32)
    x[:, axis] = sign * np.array([limit, np.nextafter(limit, np.float32(np.inf)), np.nextafter(limit, np.float32(0))])
    assert World(3, device, values={"position": x}).step(0.0).get("terminated").tolist() == [False, True, False]


def test_crash_is_judged_where_the_step_ends(device):
    """A particle that starts inside and ends outside has crashed; one that comes back in has not."""
    values = {"position": [[995.0, 0, 0], [1005.0, 0, 0]], "velocity": [[6.0, 0, 0], [-6.0, 0, 0]]}
    assert World(2, device, values=values).step(0.0).get("terminated").tolist() == [True, False]


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["action", "position", "velocity", "goal"])
def test_non_finite_numbers_are_flagged(device, name, value, variant):
    """A single non-finite component of action or state marks its world, and no clamp hides it."""
    for axis in range(3):
        array = np.zeros((5, 3), np.float32)
        array[3, axis] = value
        world = World(5, device, variant, values={} if name == "action" else {name: array})
        world.step(array if name == "action" else 0.0)
        assert world.get("invalid").tolist() == [False, False, False, True, False]
        assert world.get("fault").tolist() == [1, 3, 3 if name == "action" else 5]
        assert world.get("cause").tolist() == [0, 0, 0, 1 << BROKEN.index(name), 0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_unbounded_force_does_not_hide_non_finite_actions(device, value):
    """Where infinity is a legal bound it is still no legal force."""
    assert World(1, device, max_force=np.inf).step([0.0, value, 0.0]).get("invalid")[0]


def test_faults_add_up_until_they_are_read(device):
    """Invalid world-steps are counted over many steps, with the lowest world among them; sound steps add none."""
    world = World(6, device)
    for worlds in ([4, 5], [], [2, 4], []):
        action = np.zeros((6, 3), np.float32)
        action[worlds, 1] = np.nan
        world.step(action)
        assert np.flatnonzero(world.get("invalid")).tolist() == worlds
    assert world.get("fault").tolist() == [4, 2, 2]
    assert np.flatnonzero(world.get("cause") == 1 << BROKEN.index("action")).tolist() == [2, 4, 5]


@pytest.mark.parametrize("variant", VARIANTS)
def test_step_writes_every_output(device, variant):
    """What the outputs and the last force held before makes no difference, and no NaN is left."""
    results = []
    for garbage, flag in ((np.nan, True), (1e30, False)):
        world = World(4, device, variant, garbage=garbage, flag=flag, values={"force": garbage})
        world.step(0.25)
        seen = slice(None) if variant == "relative" else slice(GOAL_START)  # other goals stay as they were shown
        results.append([world.get("obs")[:, seen], *(world.get(name) for name in ("reward", *FLAGS, "force"))])
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()


def test_a_step_advances_the_clocks(device):
    """A step moves goal clock and age on by one, and leaves the counts of goals and episodes alone."""
    values = {"goal_clock": [0, 2], "episode_step": [5, 9], "goal_count": 7, "episode_count": 3}
    world = World(2, device, goal_period=3, time_limit=10, values=values).step(0.0)
    assert world.get("goal_due").tolist() == [False, True]
    assert world.get("truncated").tolist() == [False, True]
    assert world.get("goal_clock").tolist() == [1, 3]
    assert world.get("episode_step").tolist() == [6, 10]
    assert world.get("goal_count").tolist() == [7, 7]
    assert world.get("episode_count").tolist() == [3, 3]


def test_relative_goal_is_expressed_anew_every_step(device):
    """In Relative the goal stays where it is in space, and the goal seen is the way left to it."""
    goal = np.array([512.0, -256.0, 1024.0])
    world = World(1, device, "relative", values={"goal": goal})
    seen = []
    for n in range(1, 11):
        world.step([1.0, 0.5, -1.0])
        position = np.array([1.0, 0.5, -1.0]) * n * (n + 1) / 4
        np.testing.assert_allclose(world.get("obs")[0, GOAL_START:], (goal - position) / 1000, rtol=2.01 * U)
        np.testing.assert_array_equal(world.get("goal")[0], goal)
        seen.append(tuple(world.get("obs")[0, GOAL_START:]))
    assert len(set(seen)) == 10


@pytest.mark.parametrize("variant", VARIANTS)
def test_raw_observation_is_the_physical_state(device, variant):
    """With scales of 1 the observation holds velocity, position, force and goal themselves."""
    rng = np.random.default_rng(seed=5)
    x, v, goal = on_grid(rng, -900, 900, 3), on_grid(rng, -9, 9, 3), on_grid(rng, -100, 100, 3)
    scales = {"position_scale": 1.0, "velocity_scale": 1.0, "force_scale": 1.0}
    world = World(1, device, variant, **scales, values={"position": x, "velocity": v, "goal": goal})
    world.set("obs", np.concatenate([np.zeros(GOAL_START), goal]))
    world.step(0.5)
    v, x = v + 0.25, x + v + 0.25
    seen = goal - x if variant == "relative" else goal
    np.testing.assert_array_equal(world.get("obs")[0], np.concatenate([v, x, [0.5] * 3, seen]))


def test_step_works_in_shared_memory(device):
    """Torch views made before the launch feed the step and see its results at the same addresses."""
    world = World(2, device, garbage=0.0)
    force, position, obs = (wp.to_torch(world.array(name)) for name in ("action", "position", "obs"))
    force[:] = 1.0
    step_particles(world.worlds, world.state, world.params).launch()
    for view, name in ((force, "action"), (position, "position"), (obs, "obs")):
        assert view.data_ptr() == world.array(name).ptr
    assert bool((position == 0.5).all())
    assert bool(obs[:, :GOAL_START].any(dim=1).all())


def test_recorded_step_reads_what_is_there_at_its_launch(device):
    """A recorded step moves nothing until it is replayed, and then by the force in memory at that time."""
    world = World(2, device)
    launch = step_particles(world.worlds, world.state, world.params)
    world.set("action", 1.0)
    assert np.isnan(world.get("obs")).all()
    launch.launch()
    np.testing.assert_array_equal(world.get("position"), np.full((2, 3), 0.5))
    launch.launch()
    np.testing.assert_array_equal(world.get("position"), np.full((2, 3), 1.5))


# A struct refuses another dtype or number of dimensions by itself; the launcher checks the lengths.
@pytest.mark.parametrize("name", [*VECTORS, *RESUMED, "reward", *FLAGS, "fault", "cause", "mask", "action"])
@pytest.mark.parametrize("launcher", [step_particles, reset_particles])
def test_rejects_a_wrong_array(device, launcher, name):
    """Both launchers check every array of the worlds and of the state, and the message names it."""
    world = World(4, device)
    array = world.array(name)
    length = 3 if name == "fault" else 4
    struct = world.state if name in VECTORS else world.worlds
    setattr(struct, name, wp.zeros((7, *array.shape[1:]), dtype=array.dtype, device=device))
    label = "state" if name in VECTORS else "worlds"
    with pytest.raises(ValueError, match=rf"{label}\.{name} must be \w+\({length},.*got \w+\(7,"):
        launcher(world.worlds, world.state, world.params)
