"""The state of Particle Gym: shared with Warp, reset, cloned, resumed and sharded to the bit."""

import numpy as np
import pytest
import torch
from deimos.kernels.episodes import RESUMED
from deimos.kernels.particle import PARTICLES
from particle_worlds import VARIANTS, U, build, constant_actions, put_outside
from states import assert_same
from worlds import build_loop, mask_of, played, rows_of, step_tensors


def assert_same_state(env, other, rows=slice(None), other_rows=slice(None)):
    """Everything that a resume needs is the same in two environments, bit for bit."""
    ours = {name: tensor[rows] for name, tensor in env.tensors.items()}
    assert_same(ours, {name: tensor[other_rows] for name, tensor in other.tensors.items()})


def test_warp_and_torch_see_one_allocation(torch_device):
    """Every tensor of state and step lies at the address of its Warp array, and keeps it over steps and goals."""
    env = build(torch_device, variant="relative", time_limit=7)
    step = env.step(constant_actions(8, torch_device))
    loop = build_loop(env)
    for _ in range(10):
        loop.advance(env.step(constant_actions(8, torch_device)))
    assert env.tensors.keys() == {*RESUMED, *PARTICLES.names}
    for name in RESUMED:
        assert env.tensors[name].data_ptr() == getattr(env.worlds, name).ptr, name
    for name, tensor in step_tensors(step).items():
        assert tensor.data_ptr() == getattr(env.worlds, name).ptr, name


def test_views_are_made_once(torch_device):
    """After ten steps, with goals and resets between them, a step still gives back the very same views."""
    env = build(torch_device, time_limit=4, goal_period=3)
    loop = build_loop(env)
    action = constant_actions(8, torch_device)
    first = env.step(action)
    views = [*step_tensors(first).values(), *env.tensors.values()]
    addresses = [view.data_ptr() for view in views]
    for _ in range(10):
        loop.advance(env.step(action))
    last = env.step(action)
    again = [*step_tensors(last).values(), *env.tensors.values()]
    assert last is first
    assert all(a is b for a, b in zip(views, again, strict=True))
    assert addresses == [view.data_ptr() for view in again]
    assert last.obs is env.obs


def test_reset_leaves_other_worlds_bit_identical(torch_device):
    """Resetting world 0 changes it alone, at once and in all that follows, goals included."""
    env, twin = (build(torch_device, spawn_range=50.0) for _ in range(2))
    loop, twin_loop = build_loop(env), build_loop(twin)
    action = constant_actions(8, torch_device)
    for _ in range(7):
        loop.advance(env.step(action))
        twin_loop.advance(twin.step(action))

    env.reset(mask_of(env, 0))

    assert not torch.equal(env.tensors["position"][0], twin.tensors["position"][0])
    assert env.tensors["episode_count"][0] == twin.tensors["episode_count"][0] + 1
    for _ in range(50):
        assert_same_state(env, twin, slice(1, None), slice(1, None))
        loop.advance(env.step(action))
        twin_loop.advance(twin.step(action))


def test_clones_move_alike(torch_device):
    """Cloned worlds are equal in every bit, and stay so for as long as they get the same actions."""
    env = build(torch_device, spawn_range=100.0, time_limit=40)
    for _ in range(3):
        env.step(constant_actions(8, torch_device))
    source, target = rows_of(env, 0, 3), rows_of(env, 6, 1)
    before = env.state_dict()

    env.copy_worlds(source, target)

    others = [0, 2, 3, 4, 5, 7]
    assert_same({k: v[others] for k, v in env.tensors.items()}, {k: v[others] for k, v in before.items()})
    assert_same({k: v[target] for k, v in env.tensors.items()}, {k: v[source] for k, v in before.items()})
    action = constant_actions(8, torch_device)
    action[target] = action[source]
    for _ in range(50):
        step = env.step(action)
        assert_same_state(env, env, source, target)
        for name in ("obs", "reward", "terminated", "truncated", "goal_due", "invalid"):
            assert torch.equal(getattr(step, name)[source], getattr(step, name)[target])


def test_clones_of_another_environment(torch_device):
    """Worlds can be cloned out of another environment, and then move as they would have there."""
    origin, env = build(torch_device, num_envs=4, seed=1), build(torch_device, num_envs=10, seed=2)
    action = constant_actions(4, torch_device)
    for _ in range(7):
        origin.step(action)
    source, target = rows_of(origin, 3, 0), rows_of(env, 8, 9)
    env.copy_worlds(source, target, origin)
    everyone = constant_actions(10, torch_device, seed=1)
    everyone[target] = action[source]
    for _ in range(20):
        assert_same_state(env, origin, target, source)
        env.step(everyone)
        origin.step(action)


@pytest.mark.parametrize("variant", VARIANTS)
def test_resume_is_exact(torch_device, variant):
    """A run that continues from its state dictionary in a new environment equals one that was never stopped."""
    config = {"variant": variant, "spawn_range": 20.0, "time_limit": 90, "stagger_goals": True}
    env = build(torch_device, **config)
    loop = build_loop(env)
    action = constant_actions(8, torch_device)
    for _ in range(63):
        loop.advance(env.step(action))
    saved = loop.state_dict()
    expected = played(env, loop, action, 100)

    resumed_env = build(torch_device, **config)
    resumed = build_loop(resumed_env)
    resumed.load_state_dict(saved)
    assert_same(played(resumed_env, resumed, action, 100), expected)
    assert_same(vars(resumed.interactions.resolved()), vars(loop.interactions.resolved()))
    assert bool((env.tensors["episode_count"] > saved["env"]["episode_count"]).any())
    assert bool((env.tensors["goal_count"] > saved["env"]["goal_count"] + 10).all())


def test_state_dict_is_a_copy(torch_device):
    """Steps after a state dictionary was taken do not reach into it."""
    env = build(torch_device)
    saved = env.state_dict()
    kept = {name: tensor.clone() for name, tensor in saved.items()}
    env.step(constant_actions(8, torch_device))
    assert_same(saved, kept)
    assert not torch.equal(env.tensors["position"], saved["position"])


def test_state_of_another_size_is_refused(torch_device):
    """A state dictionary of other worlds, or without a part, is refused, and nothing is loaded."""
    env, other = build(torch_device, num_envs=8), build(torch_device, num_envs=7)
    before = env.state_dict()
    partial = {name: tensor for name, tensor in env.state_dict().items() if name != "force"}
    for wrong in (other.state_dict(), partial):
        with pytest.raises(ValueError, match=r"state must hold .*\(8, 3\).*got .*another environment"):
            env.load_state_dict(wrong)
    assert_same(env.state_dict(), before)


@pytest.mark.parametrize("variant", VARIANTS)
def test_policies_that_crash_at_different_times_meet_the_same_goals(torch_device, variant):
    """The i-th goal and the i-th first goal of a world are the same, whenever its policy crashes."""
    histories = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        env = build(torch_device, variant=variant, seed=7)
        loop = build_loop(env)
        chosen = {(w, "first", int(env.tensors["episode_count"][w])): env.tensors["goal"][w].clone() for w in range(8)}
        steps = []
        for n in range(200):
            put_outside(env, rows_of(env)[torch.tensor(rng.random(8) < 0.03, device=torch_device)])
            goals, episodes = env.tensors["goal_count"].clone(), env.tensors["episode_count"].clone()
            loop.advance(env.step(torch.zeros(8, 3, device=torch_device)))
            for w in torch.nonzero(env.tensors["goal_count"] > goals).flatten().tolist():
                chosen[w, "selected", int(goals[w])] = env.tensors["goal"][w].clone()
            for w in torch.nonzero(env.tensors["episode_count"] > episodes).flatten().tolist():
                chosen[w, "first", int(episodes[w]) + 1] = env.tensors["goal"][w].clone()
                steps.append((w, n))
        histories.append((chosen, steps))
    (goals, crashes), (other_goals, other_crashes) = histories
    assert crashes != other_crashes
    common = goals.keys() & other_goals.keys()
    for kind, least in (("selected", 20), ("first", 2)):
        for w in range(8):
            assert sum(key[0] == w and key[1] == kind for key in common) >= least
    # In Relative a place is sampled from where the particle is: a few roundings of at most 2300 u.
    tolerance = 8 * U * 2300 if variant == "relative" else 0.0
    for key in common:
        torch.testing.assert_close(goals[key], other_goals[key], rtol=0, atol=tolerance)


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_shards_equal_the_whole(torch_device, variant):
    """Two environments of 8 worlds, the second with an offset of 8, do what one of 16 does, bit for bit."""
    config = {"variant": variant, "spawn_range": 30.0, "time_limit": 150, "stagger_goals": True}
    whole = build(torch_device, num_envs=16, **config)
    shards = [build(torch_device, num_envs=8, env_offset=offset, **config) for offset in (0, 8)]
    loop, shard_loops = build_loop(whole), [build_loop(shard) for shard in shards]
    action, episodes = constant_actions(16, torch_device), whole.tensors["episode_count"].clone()
    for _ in range(300):
        loop.advance(whole.step(action))
        for i, shard in enumerate(shards):
            shard_loops[i].advance(shard.step(action[8 * i : 8 * i + 8]))
    for name, tensor in whole.tensors.items():
        assert torch.equal(tensor, torch.cat([shard.tensors[name] for shard in shards])), name
    resolved = [shard_loop.interactions.resolved() for shard_loop in shard_loops]
    assert torch.equal(
        loop.interactions.resolved().next_goal, torch.cat([interactions.next_goal for interactions in resolved])
    )
    assert bool((whole.tensors["episode_count"] > episodes + 1).all())


def test_another_seed_is_another_world(torch_device):
    """Another seed changes starts, first goals, candidates and draws in every world."""
    one, other = (build(torch_device, seed=seed, spawn_range=10.0) for seed in (0, 1))
    rows = rows_of(one)
    for a, b in (
        (one.tensors["position"], other.tensors["position"]),
        (one.tensors["goal"], other.tensors["goal"]),
        (one.sample_goals(rows, 3), other.sample_goals(rows, 3)),
        (one.draw(rows), other.draw(rows)),
    ):
        assert not (a == b).any()
