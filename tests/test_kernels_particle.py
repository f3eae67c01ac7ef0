"""Point-mass physics, crash test, clocks, observation, resets and goals."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.particle import (
    BROKEN,
    GOAL_START,
    OBS_DIM,
    ParticleParams,
    ParticleState,
    ParticleStep,
    Variant,
    make_relative,
    reset_particles,
    set_goals,
    step_particles,
)
from deimos.kernels.particle_rewards import RewardShape
from deimos.kernels.random import Purpose

U = 2.0**-24  # relative error of one float32 operation
VECTORS = ("position", "velocity", "force", "target")
COUNTERS = ("goal_clock", "episode_step", "episode_count", "goal_count")
FLAGS = ("terminated", "truncated", "goal_due", "invalid")
HALF_SIDE = 1000.0  # [u]
LARGEST_DISTANCE = {variant: np.sqrt(3) * (20.0 if variant == Variant.DIRECTIONAL else 2260.0) for variant in Variant}


def make_params(variant=Variant.DIRECTIONAL, **changes):
    """The thesis's numbers."""
    params = ParticleParams()
    values = {
        "variant": int(variant),
        "half_side": HALF_SIDE,
        "max_speed": 10.0,
        "max_force": 1.0,
        "goal_range": 10.0 if variant == Variant.DIRECTIONAL else 1250.0,
        "spawn_range": 0.0,
        "position_scale": 1e-3,
        "velocity_scale": 0.1,
        "force_scale": 1.0,
        "reward_shape": int(RewardShape.LINEAR),
        "reward_length": 2.5,
        "largest_distance": LARGEST_DISTANCE[variant],
        "goal_period": 100,
        "time_limit": 0,
        "stagger": False,
        "seed": 0,
        "world_offset": 0,
    }
    assert values.keys() == ParticleParams.vars.keys()
    for name, value in (values | changes).items():
        setattr(params, name, value)
    return params


def make_state(num_envs, device, **values):
    """Particles at rest in the middle, but for what is given."""
    state = ParticleState()
    for name in VECTORS:
        value = np.broadcast_to(np.asarray(values.get(name, 0.0), np.float32), (num_envs, 3))
        setattr(state, name, wp.array(value, dtype=wp.vec3, device=device))
    for name in COUNTERS:
        value = np.broadcast_to(np.asarray(values.get(name, 0), np.int32), num_envs)
        setattr(state, name, wp.array(value, dtype=wp.int32, device=device))
    return state


def make_step(num_envs, device, *, garbage=np.nan, flag=True):
    """Outputs that no kernel has written yet."""
    out = ParticleStep()
    out.obs = wp.full((num_envs, OBS_DIM), garbage, dtype=wp.float32, device=device)
    out.reward = wp.full(num_envs, garbage, dtype=wp.float32, device=device)
    for name in FLAGS:
        setattr(out, name, wp.full(num_envs, flag, dtype=wp.bool, device=device))
    out.count = wp.zeros(2, dtype=wp.int32, device=device)
    out.fault = wp.array([0, num_envs, 0], dtype=wp.int32, device=device)
    return out


def vectors(value, num_envs, device):
    """A Warp array of vec3."""
    value = np.broadcast_to(np.asarray(value, np.float32), (num_envs, 3))
    return wp.array(value, dtype=wp.vec3, device=device)


def snapshot(state, obs):
    """The bytes of everything that a reset or a new goal may touch, world by world."""
    arrays = {name: getattr(state, name).numpy() for name in VECTORS + COUNTERS} | {"obs": obs.numpy()}
    return {name: [row.tobytes() for row in value] for name, value in arrays.items()}


def on_grid(rng, low, high, size):
    """Random multiples of 1/128: float32 adds and halves these without rounding, so the physics is exact."""
    return rng.integers(round(low * 128), round(high * 128), size=size, endpoint=True) / 128


def step_reference(variant, x, v, f, target):
    """One step of the thesis's section 4.1.1, in float64, one particle and one axis after another."""
    n = len(x)
    x_new, v_new, f_new, goal = (np.empty((n, 3)) for _ in range(4))
    crashed, reward = np.empty(n, bool), np.empty(n)
    for i in range(n):
        for axis in range(3):
            f_new[i, axis] = min(max(f[i, axis], -1.0), 1.0)
            v_new[i, axis] = min(max(v[i, axis] + f_new[i, axis] / 2, -10.0), 10.0)
            x_new[i, axis] = x[i, axis] + v_new[i, axis]
        crashed[i] = any(abs(x_new[i, axis]) > HALF_SIDE for axis in range(3))
        if variant == Variant.DIRECTIONAL:
            distance, goal[i] = np.linalg.norm(v_new[i] - target[i]), target[i] / 10
        elif variant == Variant.ABSOLUTE:
            distance, goal[i] = np.linalg.norm(x_new[i] - target[i]), target[i] / 1000
        else:
            distance, goal[i] = np.linalg.norm(x_new[i] - target[i]), (target[i] - x_new[i]) / 1000
        reward[i] = 1 - distance / (1.01 * LARGEST_DISTANCE[variant])
    obs = np.concatenate([v_new / 10, x_new / 1000, f_new, goal], axis=1)
    return x_new, v_new, f_new, crashed, reward, obs


@pytest.mark.parametrize("num_envs", [1, 257])
@pytest.mark.parametrize("variant", list(Variant))
def test_step_matches_reference(device, variant, num_envs):
    """One step equals the reference in all variants, with forces, speeds and positions on both sides of each bound."""
    rng = np.random.default_rng(seed=num_envs)
    params = make_params(variant)
    x = on_grid(rng, -HALF_SIDE, HALF_SIDE, (num_envs, 3))
    x[::3, 1] = np.sign(x[::3, 1]) * (HALF_SIDE - on_grid(rng, 0, 12, x[::3, 1].shape))  # close to a wall
    v, f = on_grid(rng, -10, 10, (num_envs, 3)), on_grid(rng, -2, 2, (num_envs, 3))
    target = on_grid(rng, -params.goal_range, params.goal_range, (num_envs, 3))
    state = make_state(num_envs, device, position=x, velocity=v, force=np.nan, target=target)
    out = make_step(num_envs, device)

    step_particles(params, vectors(f, num_envs, device), state, out)

    x_new, v_new, f_new, crashed, reward, obs = step_reference(variant, x, v, f, target)
    np.testing.assert_array_equal(state.position.numpy(), x_new)
    np.testing.assert_array_equal(state.velocity.numpy(), v_new)
    np.testing.assert_array_equal(state.force.numpy(), f_new)
    np.testing.assert_array_equal(state.target.numpy(), target)
    np.testing.assert_array_equal(out.terminated.numpy(), crashed)
    # Two roundings: of the scale and of the product with it.
    np.testing.assert_allclose(out.obs.numpy(), obs, rtol=2.01 * U, atol=0)
    # The length has 3 relative errors at most, the divisor 4, the quotient 1, the difference 1.
    np.testing.assert_allclose(out.reward.numpy(), reward, rtol=0, atol=9 * U)
    assert np.all(out.reward.numpy() > 0)
    if num_envs > 1:  # or the test would not have seen both sides
        assert 0 < crashed.sum() < num_envs
        assert np.abs(v_new).max() == 10
        assert np.abs(f).max() > 1


def test_constant_force_follows_the_sum_of_its_steps(device):
    """From rest, n steps of force f give exactly v = n f / 2 and x = f n (n + 1) / 4."""
    force = np.array([1 / 64, -1 / 128, 0.0])  # so small that float32 holds every sum exactly
    params, state, out = make_params(), make_state(1, device), make_step(1, device)
    for n in range(1, 201):
        step_particles(params, vectors(force, 1, device), state, out)
        np.testing.assert_array_equal(state.velocity.numpy()[0], n * force / 2)
        np.testing.assert_array_equal(state.position.numpy()[0], force * n * (n + 1) / 4)


@pytest.mark.parametrize("variant", list(Variant))
def test_mirror_worlds_move_as_mirror_images(device, variant):
    """The cube prefers no direction: mirrored states, goals and forces give mirrored steps and the same rewards."""
    rng = np.random.default_rng(seed=2)
    n = 100
    x, v, f = rng.uniform(-1000, 1000, (n, 3)), rng.uniform(-10, 10, (n, 3)), rng.uniform(-2, 2, (n, 3))
    target = rng.uniform(-10, 10, (n, 3)) * (1 if variant == Variant.DIRECTIONAL else 125)
    mirror = np.array([-1.0, 1.0, -1.0])
    results = []
    for sign in (np.ones(3), mirror):
        state = make_state(n, device, position=sign * x, velocity=sign * v, target=sign * target)
        out = make_step(n, device)
        for _ in range(5):
            step_particles(make_params(variant), vectors(sign * f, n, device), state, out)
        results.append((out.obs.numpy(), out.reward.numpy(), out.terminated.numpy()))
    (obs, reward, crashed), (mirrored_obs, mirrored_reward, mirrored_crashed) = results
    np.testing.assert_array_equal(mirrored_obs, obs * np.tile(mirror, 4).astype(np.float32))
    np.testing.assert_array_equal(mirrored_reward, reward)
    np.testing.assert_array_equal(mirrored_crashed, crashed)


def test_speed_and_force_stay_bounded(device):
    """Whatever the forces, no component of force, velocity or displacement ever exceeds its bound."""
    rng = np.random.default_rng(seed=3)
    params, state, out = make_params(), make_state(50, device), make_step(50, device)
    for _ in range(100):
        before = state.position.numpy().astype(np.float64)
        step_particles(params, vectors(rng.normal(scale=5.0, size=(50, 3)), 50, device), state, out)
        displacement = np.abs(state.position.numpy() - before)
        assert np.abs(state.force.numpy()).max() <= 1.0
        assert np.abs(state.velocity.numpy()).max() <= 10.0
        # The new position is rounded to float32, by 2^-24 of its value at most.
        assert np.all(displacement <= 10.0 + U * np.abs(before + 10.0))


def test_force_is_halved(device):
    """A force of 1 u/step^2 on a particle at rest gives 0.5 u/step and moves it by as much."""
    state = make_state(1, device)
    step_particles(make_params(), vectors([1.0, -0.5, 0.0], 1, device), state, make_step(1, device))
    np.testing.assert_array_equal(state.velocity.numpy(), [[0.5, -0.25, 0.0]])
    np.testing.assert_array_equal(state.position.numpy(), [[0.5, -0.25, 0.0]])


def test_velocity_is_clipped_per_component(device):
    """Only the components that exceed the bound are cut, each on its own and towards its own sign."""
    state = make_state(1, device, velocity=[9.75, -9.75, 3.0])
    step_particles(make_params(), vectors([1.0, -1.0, 1.0], 1, device), state, make_step(1, device))
    np.testing.assert_array_equal(state.velocity.numpy(), [[10.0, -10.0, 3.5]])
    np.testing.assert_array_equal(state.position.numpy(), [[10.0, -10.0, 3.5]])


def test_force_is_clipped_per_component_and_kept_as_applied(device):
    """The last action in the observation is the bounded force that moved the particle."""
    state, out = make_state(1, device), make_step(1, device)
    params = make_params(max_force=2.0, force_scale=0.5)
    step_particles(params, vectors([3.0, -300.0, 0.5], 1, device), state, out)
    np.testing.assert_array_equal(state.force.numpy(), [[2.0, -2.0, 0.5]])
    np.testing.assert_array_equal(out.obs.numpy()[0, 6:9], [1.0, -1.0, 0.25])


def test_force_may_be_unbounded(device):
    """Without a bound every finite force is applied as it is, and only the speed is cut."""
    state, out = make_state(1, device), make_step(1, device)
    step_particles(make_params(max_force=np.inf), vectors([1e30, -12.0, 3e38], 1, device), state, out)
    np.testing.assert_array_equal(state.force.numpy(), np.array([[1e30, -12.0, 3e38]], np.float32))
    np.testing.assert_array_equal(state.velocity.numpy(), [[10.0, -6.0, 10.0]])
    assert not out.invalid.numpy()[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_crash_is_strict(device, axis, sign):
    """A particle at exactly 1000 u is inside; at the next float32 it has crashed, along any axis and either way."""
    limit = np.float32(HALF_SIDE)
    x = np.zeros((3, 3), np.float32)
    x[:, axis] = sign * np.array([limit, np.nextafter(limit, np.float32(np.inf)), np.nextafter(limit, np.float32(0))])
    out = make_step(3, device)
    step_particles(make_params(), vectors(0.0, 3, device), make_state(3, device, position=x), out)
    assert out.terminated.numpy().tolist() == [False, True, False]


def test_crash_is_judged_where_the_step_ends(device):
    """A particle that starts inside and ends outside has crashed; one that comes back in has not."""
    state = make_state(2, device, position=[[995.0, 0, 0], [1005.0, 0, 0]], velocity=[[6.0, 0, 0], [-6.0, 0, 0]])
    out = make_step(2, device)
    step_particles(make_params(), vectors(0.0, 2, device), state, out)
    assert out.terminated.numpy().tolist() == [True, False]


@pytest.mark.parametrize("variant", list(Variant))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["action", "position", "velocity", "target"])
def test_non_finite_numbers_are_flagged(device, name, value, variant):
    """A single non-finite component of action or state marks its world, and no clamp hides it."""
    for axis in range(3):
        state, out = make_state(5, device), make_step(5, device)
        array = np.zeros((5, 3), np.float32)
        array[3, axis] = value
        action = vectors(array if name == "action" else 0.0, 5, device)
        if name != "action":
            setattr(state, name, vectors(array, 5, device))
        step_particles(make_params(variant), action, state, out)
        assert out.invalid.numpy().tolist() == [False, False, False, True, False]
        bit = 1 << BROKEN.index("goal" if name == "target" else name)
        assert out.fault.numpy().tolist() == [1, 3, bit]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_unbounded_force_does_not_hide_non_finite_actions(device, value):
    """Where infinity is a legal bound it is still no legal force."""
    action = vectors([0.0, value, 0.0], 1, device)
    out = make_step(1, device)
    step_particles(make_params(max_force=np.inf), action, make_state(1, device), out)
    assert out.invalid.numpy()[0]


def test_faults_add_up_until_they_are_read(device):
    """Invalid world-steps are counted over many steps, with the lowest world among them; sound steps add none."""
    state, out = make_state(6, device), make_step(6, device)
    params = make_params()
    for worlds in ([4, 5], [], [2, 4], []):
        action = np.zeros((6, 3), np.float32)
        action[worlds, 1] = np.nan
        step_particles(params, vectors(action, 6, device), state, out)
        assert np.flatnonzero(out.invalid.numpy()).tolist() == worlds
    assert out.fault.numpy().tolist() == [4, 2, 1 << BROKEN.index("action")]


@pytest.mark.parametrize("variant", list(Variant))
def test_step_writes_every_output(device, variant):
    """What the outputs and the last force held before makes no difference, and no NaN is left."""
    results = []
    for garbage, flag in ((np.nan, True), (1e30, False)):
        state, out = make_state(4, device, force=garbage), make_step(4, device, garbage=garbage, flag=flag)
        step_particles(make_params(variant), vectors(0.25, 4, device), state, out)
        arrays = [out.obs, out.reward, *(getattr(out, name) for name in FLAGS), state.force]
        results.append([array.numpy() for array in arrays])
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()


def test_clocks_and_counts(device):
    """Goals fall due at T, episodes end at the limit unless they crash, and only the living are counted as due."""
    # goal clock, episode step, x -> goal due, truncated, crashed; T = 3 and the limit is 8
    table = [
        (0, 0, 0.0, False, False, False),
        (1, 6, 0.0, False, False, False),
        (2, 6, 0.0, True, False, False),
        (5, 6, 0.0, True, False, False),
        (1, 7, 0.0, False, True, False),
        (2, 7, 0.0, True, True, False),
        (2, 0, 2000.0, True, False, True),
        (2, 7, 2000.0, True, False, True),
        (0, 7, 2000.0, False, False, True),
        (0, 9, 0.0, False, True, False),
    ]
    clock, episode, x, due, truncated, crashed = (np.array(column) for column in zip(*table, strict=True))
    n = len(table)
    position = np.stack([x, 0 * x, 0 * x], axis=1)
    state = make_state(n, device, goal_clock=clock, episode_step=episode, position=position, goal_count=7)
    out = make_step(n, device)
    out.count.fill_(100)

    step_particles(make_params(goal_period=3, time_limit=8), vectors(0.0, n, device), state, out)

    np.testing.assert_array_equal(out.goal_due.numpy(), due)
    np.testing.assert_array_equal(out.truncated.numpy(), truncated)
    np.testing.assert_array_equal(out.terminated.numpy(), crashed)
    done = truncated | crashed
    assert out.count.numpy().tolist() == [100 + (due & ~done).sum(), 100 + done.sum()]
    np.testing.assert_array_equal(state.goal_clock.numpy(), clock + 1)
    np.testing.assert_array_equal(state.episode_step.numpy(), episode + 1)
    np.testing.assert_array_equal(state.episode_count.numpy(), 0)
    np.testing.assert_array_equal(state.goal_count.numpy(), 7)


def test_no_time_limit_never_comes(device):
    """With a limit of 0 no episode is truncated, however long it lasts."""
    out = make_step(2, device)
    step_particles(make_params(), vectors(0.0, 2, device), make_state(2, device, episode_step=[0, 2**30]), out)
    assert not out.truncated.numpy().any()


def test_relative_goal_is_expressed_anew_every_step(device):
    """In Relative the target stays where it is in space, and the goal seen is the way left to it."""
    target = np.array([512.0, -256.0, 1024.0])
    params, state, out = make_params(Variant.RELATIVE), make_state(1, device, target=target), make_step(1, device)
    seen = []
    for n in range(1, 11):
        step_particles(params, vectors([1.0, 0.5, -1.0], 1, device), state, out)
        position = np.array([1.0, 0.5, -1.0]) * n * (n + 1) / 4
        np.testing.assert_allclose(out.obs.numpy()[0, GOAL_START:], (target - position) / 1000, rtol=2.01 * U)
        np.testing.assert_array_equal(state.target.numpy()[0], target)
        seen.append(tuple(out.obs.numpy()[0, GOAL_START:]))
    assert len(set(seen)) == 10


@pytest.mark.parametrize("variant", list(Variant))
def test_raw_observation_is_the_physical_state(device, variant):
    """With scales of 1 the observation holds velocity, position, force and goal themselves."""
    rng = np.random.default_rng(seed=5)
    x, v, target = on_grid(rng, -900, 900, 3), on_grid(rng, -9, 9, 3), on_grid(rng, -100, 100, 3)
    params = make_params(variant, position_scale=1.0, velocity_scale=1.0, force_scale=1.0)
    state, out = make_state(1, device, position=x, velocity=v, target=target), make_step(1, device)
    step_particles(params, vectors(0.5, 1, device), state, out)
    v, x = v + 0.25, x + v + 0.25
    goal = target - x if variant == Variant.RELATIVE else target
    np.testing.assert_array_equal(out.obs.numpy()[0], np.concatenate([v, x, [0.5] * 3, goal]))


def test_step_works_in_shared_memory(device):
    """Torch views made before the launch feed the step and see its results at the same addresses."""
    state, out, action = make_state(2, device), make_step(2, device), vectors(0.0, 2, device)
    force, position, obs = wp.to_torch(action), wp.to_torch(state.position), wp.to_torch(out.obs)
    force[:] = 1.0
    step_particles(make_params(), action, state, out)
    for view, array in ((force, action), (position, state.position), (obs, out.obs)):
        assert view.data_ptr() == array.ptr
    assert bool((position == 0.5).all())
    assert bool(obs.isfinite().all())


def test_recorded_step_reads_what_is_there_at_its_launch(device):
    """A recorded step moves nothing until it is replayed, and then by the force in memory at that time."""
    state, out, action = make_state(2, device), make_step(2, device), vectors(0.0, 2, device)
    launch = step_particles(make_params(), action, state, out, record=True)
    action.fill_(wp.vec3(1.0))
    assert np.isnan(out.obs.numpy()).all()
    launch.launch()
    np.testing.assert_array_equal(state.position.numpy(), np.full((2, 3), 0.5))
    launch.launch()
    np.testing.assert_array_equal(state.position.numpy(), np.full((2, 3), 1.5))


@pytest.mark.parametrize("num_envs", [1, 257])
@pytest.mark.parametrize("variant", list(Variant))
def test_reset_matches_reference(device, uniform_reference, variant, num_envs):
    """Start and first goal are the draws addressed by the world's own number and episode, bit for bit."""
    rng = np.random.default_rng(seed=num_envs)
    episode, goal_count = rng.integers(1000, size=(2, num_envs))
    params = make_params(variant, spawn_range=300.0, seed=77, world_offset=500)
    scale = np.array([1.0, 0.5, 0.3], np.float32)
    state = make_state(num_envs, device, episode_count=episode, goal_count=goal_count, goal_clock=8, episode_step=9)
    for name in VECTORS:
        getattr(state, name).fill_(wp.vec3(np.nan))
    out = make_step(num_envs, device)
    mask = wp.full(num_envs, True, dtype=wp.bool, device=device)

    reset_particles(params, mask, wp.array(scale, dtype=wp.float32, device=device), state, out.obs)

    world = 500 + np.arange(num_envs)
    spawn = uniform_reference(77, Purpose.RESET, world, episode)[:, :3]
    first = uniform_reference(77, Purpose.FIRST_GOAL, world, episode)[:, :3]
    # 2 u - 1 is exact in float32, so only the products round.
    position = np.float32(2 * spawn - 1) * np.float32(300)
    target = np.float32(2 * first - 1) * scale * np.float32(params.goal_range)
    np.testing.assert_array_equal(state.position.numpy(), position)
    np.testing.assert_array_equal(state.velocity.numpy(), np.zeros((num_envs, 3)))
    np.testing.assert_array_equal(state.force.numpy(), np.zeros((num_envs, 3)))
    np.testing.assert_array_equal(state.target.numpy(), target)
    np.testing.assert_array_equal(state.goal_clock.numpy(), 0)
    np.testing.assert_array_equal(state.episode_step.numpy(), 0)
    np.testing.assert_array_equal(state.episode_count.numpy(), episode + 1)
    np.testing.assert_array_equal(state.goal_count.numpy(), goal_count)
    goal = (target.astype(np.float64) - (position if variant == Variant.RELATIVE else 0.0)) * (
        0.1 if variant == Variant.DIRECTIONAL else 1e-3
    )
    obs = np.concatenate([np.zeros((num_envs, 3)), position / 1000, np.zeros((num_envs, 3)), goal], axis=1)
    # Three roundings: of the difference, of the scale and of the product with it.
    np.testing.assert_allclose(out.obs.numpy(), obs, rtol=3.01 * U, atol=0)


def test_reset_leaves_the_others_alone(device):
    """Worlds outside the mask keep every byte; those inside are made new, even out of NaN."""
    state, out = make_state(4, device), make_step(4, device)
    for name in VECTORS:
        getattr(state, name).fill_(wp.vec3(np.nan))
    before = snapshot(state, out.obs)
    mask = wp.array([True, False, True, False], dtype=wp.bool, device=device)
    scale = wp.full(3, 1.0, dtype=wp.float32, device=device)
    reset_particles(make_params(), mask, scale, state, out.obs)
    after = snapshot(state, out.obs)
    for name in before:
        assert [before[name][i] == after[name][i] for i in (1, 3)] == [True, True]
    for name in VECTORS:
        assert np.isfinite(getattr(state, name).numpy()[[0, 2]]).all()
    assert np.isfinite(out.obs.numpy()[[0, 2]]).all()


def test_particles_start_uniformly_in_their_box(device):
    """Starts and first goals fill their boxes evenly and independently: mean, spread and correlation say so."""
    n = 2**14
    params = make_params(spawn_range=100.0)
    state, out = make_state(n, device), make_step(n, device)
    mask = wp.full(n, True, dtype=wp.bool, device=device)
    reset_particles(params, mask, wp.full(3, 1.0, dtype=wp.float32, device=device), state, out.obs)
    x = np.concatenate([state.position.numpy() / 100.0, state.target.numpy() / 10.0], axis=1).astype(np.float64)
    sigmas = 5.0  # exceeded once in 1.7 million tests
    assert np.abs(x).max() <= 1.0
    assert np.all(np.abs(x.mean(axis=0)) < sigmas / np.sqrt(3 * n))  # the variance of a component is 1/3
    assert np.all(np.abs((x**2).mean(axis=0) - 1 / 3) < sigmas * np.sqrt(4 / 45 / n))  # that of its square 4/45
    assert np.all(np.abs(np.corrcoef(x.T) - np.eye(6)) < sigmas / np.sqrt(n))


def test_only_the_first_episode_is_staggered(device, uniform_reference):
    """The first goal clock starts at a random step below T; from the second episode on at 0."""
    n = 500
    params = make_params(stagger=True, goal_period=7, seed=4)
    state, out = make_state(n, device), make_step(n, device)
    mask = wp.full(n, True, dtype=wp.bool, device=device)
    scale = wp.full(3, 1.0, dtype=wp.float32, device=device)
    reset_particles(params, mask, scale, state, out.obs)
    u = uniform_reference(4, Purpose.RESET, np.arange(n), 0, index=1)[:, 0]
    np.testing.assert_array_equal(state.goal_clock.numpy(), np.floor(u * 7))
    assert set(state.goal_clock.numpy().tolist()) == set(range(7))
    reset_particles(params, mask, scale, state, out.obs)
    np.testing.assert_array_equal(state.goal_clock.numpy(), 0)


def test_reset_works_in_shared_memory(device):
    """A torch mask written before the launch decides, and torch views see the reset at the same addresses."""
    state, out = make_state(2, device, position=5.0), make_step(2, device)
    mask = wp.zeros(2, dtype=wp.bool, device=device)
    chosen, position, obs = wp.to_torch(mask), wp.to_torch(state.position), wp.to_torch(out.obs)
    chosen[1] = True
    reset_particles(make_params(), mask, wp.full(3, 1.0, dtype=wp.float32, device=device), state, out.obs)
    for view, array in ((chosen, mask), (position, state.position), (obs, out.obs)):
        assert view.data_ptr() == array.ptr
    assert position.tolist() == [[5.0] * 3, [0.0] * 3]
    assert obs.isfinite().all(dim=1).tolist() == [False, True]


@pytest.mark.parametrize("num_envs", [1, 257])
@pytest.mark.parametrize("variant", list(Variant))
def test_set_goals_matches_reference(device, variant, num_envs):
    """A goal becomes the velocity or the place that it stands for, and is seen as it was given."""
    rng = np.random.default_rng(seed=num_envs)
    row = rng.permutation(num_envs)[: num_envs // 2 + 1]
    x = rng.uniform(-1000, 1000, (num_envs, 3)).astype(np.float32)
    goal = rng.uniform(-1.25, 1.25, (len(row), 3)).astype(np.float32)
    state = make_state(num_envs, device, position=x, goal_clock=100, goal_count=np.arange(num_envs))
    out = make_step(num_envs, device)

    rows = wp.array(row, dtype=wp.int32, device=device)
    set_goals(make_params(variant), rows, vectors(goal, len(row), device), state, out.obs)

    unit = 10.0 if variant == Variant.DIRECTIONAL else 1000.0
    origin = x[row].astype(np.float64) if variant == Variant.RELATIVE else np.zeros((len(row), 3))
    target = goal.astype(np.float64) * unit + origin
    # Scale and quotient round, and so does the sum with the position.
    target_error = 2.01 * U * np.abs(goal * unit) + 1.01 * U * np.abs(target)
    assert np.all(np.abs(state.target.numpy()[row] - target) <= target_error)
    # Back again the scale's own error cancels; the difference with the position is that of the sum.
    seen = out.obs.numpy()[row][:, GOAL_START:]
    sum_error = np.abs(target) / unit if variant == Variant.RELATIVE else 0.0
    assert np.all(np.abs(seen - goal) <= 1.01 * U * (3 * np.abs(goal) + sum_error))
    np.testing.assert_array_equal(state.goal_clock.numpy()[row], 0)
    np.testing.assert_array_equal(state.goal_count.numpy()[row], row + 1)


@pytest.mark.parametrize("variant", list(Variant))
def test_set_goals_touches_nothing_else(device, variant):
    """Other worlds keep every byte, and listed worlds all but their goal, its clock and its count."""
    state = make_state(4, device, position=1.0, velocity=2.0, force=3.0, goal_clock=5, episode_step=6)
    out = make_step(4, device)
    before = snapshot(state, out.obs)
    row = wp.array([2, 0], dtype=wp.int32, device=device)
    set_goals(make_params(variant), row, vectors([[0.5, 0.5, 0.5], [-1.0, 0.0, 1.0]], 2, device), state, out.obs)
    after = snapshot(state, out.obs)
    for name in before:
        assert [before[name][i] == after[name][i] for i in (1, 3)] == [True, True]
    for name in ("position", "velocity", "force", "episode_step", "episode_count"):
        assert before[name] == after[name]
    assert np.isnan(out.obs.numpy()[[0, 2], :GOAL_START]).all()
    assert np.isfinite(out.obs.numpy()[[0, 2], GOAL_START:]).all()


@pytest.mark.parametrize("variant", list(Variant))
def test_step_at_rest_sees_the_goal_that_was_set(device, variant):
    """Setting a goal and stepping agree on what is seen: at rest the next observation repeats it, bit for bit."""
    rng = np.random.default_rng(seed=6)
    x, goal = rng.uniform(-900, 900, (20, 3)), rng.uniform(-1, 1, (20, 3))
    state, out = make_state(20, device, position=x), make_step(20, device)
    params = make_params(variant)
    row = wp.array(np.arange(20), dtype=wp.int32, device=device)
    set_goals(params, row, vectors(goal, 20, device), state, out.obs)
    seen = out.obs.numpy()[:, GOAL_START:].copy()
    step_particles(params, vectors(0.0, 20, device), state, out)
    np.testing.assert_array_equal(out.obs.numpy()[:, GOAL_START:], seen)


def test_set_goals_works_in_shared_memory(device):
    """Goals written through torch arrive, and torch views see them at the same addresses."""
    state, out, goal = make_state(2, device), make_step(2, device), vectors(0.0, 1, device)
    wanted, target = wp.to_torch(goal), wp.to_torch(state.target)
    wanted[:] = 0.5
    set_goals(make_params(), wp.array([1], dtype=wp.int32, device=device), goal, state, out.obs)
    assert (wanted.data_ptr(), target.data_ptr()) == (goal.ptr, state.target.ptr)
    assert target.tolist() == [[0.0] * 3, [5.0] * 3]


@pytest.mark.parametrize(("num_rows", "count"), [(1, 1), (40, 7)])
def test_make_relative_matches_reference(device, num_rows, count):
    """From every candidate place the scaled position of its own world is subtracted."""
    rng = np.random.default_rng(seed=num_rows)
    x = rng.uniform(-1000, 1000, (50, 3)).astype(np.float32)
    candidate = rng.uniform(-1.25, 1.25, (num_rows, count, 3)).astype(np.float32)
    row = rng.permutation(50)[:num_rows]
    result = wp.array(candidate, dtype=wp.float32, device=device)

    rows = wp.array(row, dtype=wp.int32, device=device)
    make_relative(make_params(Variant.RELATIVE), rows, vectors(x, 50, device), result)

    origin = x[row].astype(np.float64)[:, None] / 1000
    expected = candidate - origin
    error = np.abs(result.numpy() - expected)
    assert np.all(error <= 1.01 * U * (2 * np.abs(origin) + np.abs(expected)))  # scale, product; difference


def test_make_relative_of_a_particle_in_the_middle_changes_nothing(device):
    """Seen from the origin every place is where it is."""
    candidate = np.random.default_rng(seed=0).uniform(-1, 1, (2, 3, 3)).astype(np.float32)
    result = wp.array(candidate, dtype=wp.float32, device=device)
    rows = wp.array([0, 1], dtype=wp.int32, device=device)
    make_relative(make_params(Variant.RELATIVE), rows, vectors(0.0, 2, device), result)
    np.testing.assert_array_equal(result.numpy(), candidate)


def test_make_relative_then_set_goals_gives_the_place_back(device):
    """A candidate place that is made relative and set as a goal becomes the target again."""
    rng = np.random.default_rng(seed=8)
    x = rng.uniform(-1000, 1000, (30, 3)).astype(np.float32)
    place = rng.uniform(-1250, 1250, (30, 3))
    candidate = wp.array((place / 1000).reshape(30, 1, 3).astype(np.float32), dtype=wp.float32, device=device)
    state, out, params = make_state(30, device, position=x), make_step(30, device), make_params(Variant.RELATIVE)
    rows = wp.array(np.arange(30), dtype=wp.int32, device=device)
    make_relative(params, rows, state.position, candidate)
    set_goals(params, rows, wp.array(candidate.numpy()[:, 0], dtype=wp.vec3, device=device), state, out.obs)
    # The candidate rounds; the origin twice, but its scale's error returns in the quotient; then difference,
    # quotient with the scale's error, and sum.
    error = np.abs(state.target.numpy() - place)
    assert np.all(error <= 1.01 * U * (3 * np.abs(place) + 3 * np.abs(x) + 3 * np.abs(place - x)))


def test_make_relative_works_in_shared_memory(device):
    """A torch view of the candidates sees them change at the same address."""
    candidate = wp.full((1, 2, 3), 1.0, dtype=wp.float32, device=device)
    view = wp.to_torch(candidate)
    rows = wp.array([0], dtype=wp.int32, device=device)
    params = make_params(Variant.RELATIVE, position_scale=0.5)
    make_relative(params, rows, vectors([1.0, 2.0, 4.0], 1, device), candidate)
    assert view.data_ptr() == candidate.ptr
    assert view.tolist() == [[[0.5, 0.0, -1.0]] * 2]


# A struct refuses another dtype or number of dimensions by itself; the launcher checks the lengths.
@pytest.mark.parametrize("name", VECTORS + COUNTERS)
@pytest.mark.parametrize("call", ["step", "reset", "goals"])
def test_rejects_a_wrong_state(device, call, name):
    """Every launcher checks every array of the state, and the message names it."""
    state, out = make_state(4, device), make_step(4, device)
    dtype = getattr(state, name).dtype
    setattr(state, name, wp.zeros(3, dtype=dtype, device=device))
    # A goal is set in as many worlds as there are positions, so there it is the others that do not fit.
    wrong, right, was = (name, 4, 3) if (call, name) != ("goals", "position") else ("(obs|state.velocity)", 3, 4)
    with pytest.raises(ValueError, match=rf"{wrong} must be \w+\({right},.*got \w+\({was},"):
        launch_by_name(call, state, out, device)


@pytest.mark.parametrize("name", ["obs", "reward", *FLAGS, "count", "fault"])
def test_rejects_a_wrong_output(device, name):
    """Every output of a step is checked, and the message names it."""
    state, out = make_state(4, device), make_step(4, device)
    array = getattr(out, name)
    setattr(out, name, wp.zeros((7, *array.shape[1:]), dtype=array.dtype, device=device))
    with pytest.raises(ValueError, match=rf"out\.{name} must be \w+\({array.shape[0]},.*got \w+\(7,"):
        launch_by_name("step", state, out, device)


@pytest.mark.parametrize(
    ("call", "name", "right"),
    [
        ("step", "action", r"vec3f\(7, 7\)"),
        ("reset", "mask", r"bool\(7, 7\)"),
        ("reset", "goal_scale", r"float32\(3,\)"),
        ("reset", "obs", r"float32\(4, 12\)"),
        ("goals", "row", r"int32\(7, 7\)"),
        ("goals", "goal", r"vec3f\(1,\)"),
        ("goals", "obs", r"float32\(4, 12\)"),
        ("relative", "row", r"int32\(7, 7\)"),
        ("relative", "position", r"vec3f\(7, 7\)"),
    ],
)
def test_rejects_a_wrong_argument(device, call, name, right):
    """Every array argument is checked, and the message says what it must be and what it was."""
    state, out = make_state(4, device), make_step(4, device)
    wrong = {name: wp.zeros((7, 7), dtype=wp.float64, device=device)}
    with pytest.raises(ValueError, match=rf"^{name} must be {right}.*got float64\(7, 7\)"):
        launch_by_name(call, state, out, device, **wrong)


@pytest.mark.parametrize("shape", [(1, 3), (1, 1, 4), (2, 1, 3)])
def test_rejects_candidates_of_another_shape(device, shape):
    """Candidates have a row per listed world and three components, and the message says what they were."""
    wrong = {"candidate": wp.zeros(shape, dtype=wp.float32, device=device)}
    with pytest.raises(ValueError, match=r"^candidate must .*got .*\(" + ", ".join(map(str, shape))):
        launch_by_name("relative", make_state(4, device), make_step(4, device), device, **wrong)


def launch_by_name(call, state, out, device, **wrong):
    """Call a launcher with arguments for four worlds, one row and one candidate, but for what is given."""
    right = {
        "step": {"action": vectors(0.0, 4, device), "state": state, "out": out},
        "reset": {
            "mask": wp.zeros(4, dtype=wp.bool, device=device),
            "goal_scale": wp.zeros(3, dtype=wp.float32, device=device),
            "state": state,
            "obs": out.obs,
        },
        "goals": {
            "row": wp.zeros(1, dtype=wp.int32, device=device),
            "goal": vectors(0.0, 1, device),
            "state": state,
            "obs": out.obs,
        },
        "relative": {
            "row": wp.zeros(1, dtype=wp.int32, device=device),
            "position": state.position,
            "candidate": wp.zeros((1, 1, 3), dtype=wp.float32, device=device),
        },
    }[call]
    launcher = {"step": step_particles, "reset": reset_particles, "goals": set_goals, "relative": make_relative}[call]
    launcher(make_params(), **(right | wrong))
