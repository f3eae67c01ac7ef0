"""The state of legged robots, with an arm and without: shared, reset, cloned, resumed and sharded to the bit."""

import math

import pytest
import torch
from quad_worlds import TASKS, actions, build
from states import assert_same
from worlds import build_loop, mask_of, played, rows_of

both = pytest.mark.parametrize("task", TASKS)
"""With an arm or without, a robot keeps what an environment promises."""


def build_on(simulator, **options):
    """The same with an engine, on a device that it knows."""
    return build(simulator.device, engine=simulator.engine, **options)


@both
def test_warp_and_torch_see_one_allocation_and_views_stay(task, simulator):
    """Every tensor keeps its address over steps, goals and resets, and a step gives back the very same views."""
    env = build_on(simulator, task=task, episode_steps=6)
    loop = build_loop(env)
    first = env.step(actions(6, simulator.device, task=task))
    addresses = [t.data_ptr() for t in (*env.tensors.values(), *vars(first).values())]
    for _ in range(12):
        last = env.step(actions(6, simulator.device, task=task))
        loop.advance(last)
    assert last is first
    assert addresses == [t.data_ptr() for t in (*env.tensors.values(), *vars(last).values())]
    assert env.tensors["qpos"].data_ptr() == env.physics.arrays.qpos.ptr


@both
def test_reset_of_one_world_leaves_the_others(task, simulator, hills):
    """Resetting world 0 changes world 0 and no bit of any other, now and over the steps that follow."""
    env, twin = (build_on(simulator, task=task, terrain=hills, episode_steps=200, goal_period=100) for _ in range(2))
    action = actions(6, simulator.device, task=task)
    for _ in range(8):
        env.step(action)
        twin.step(action)
    env.reset(mask_of(env, 0))
    assert not torch.equal(env.tensors["qpos"][0], twin.tensors["qpos"][0])
    assert int(env.tensors["episode_count"][0]) == 2
    for _ in range(8):
        for name, tensor in env.tensors.items():
            assert torch.equal(tensor[1:], twin.tensors[name][1:]), name
        env.step(action)
        twin.step(action)


@both
def test_copied_worlds_are_exact_clones(task, simulator):
    """Clones, also into another environment, continue exactly as their originals, warm starts and payloads included."""
    config = {"noise": False, "push_interval": 0.0, "episode_steps": 300, "goal_period": 100}
    origin, env = build_on(simulator, task=task, **config), build_on(simulator, task=task, seed=3, **config)
    action = actions(6, simulator.device, task=task)
    for _ in range(9):
        origin.step(action)
    source, target = rows_of(origin, 4, 1), rows_of(env, 0, 5)
    env.copy_worlds(source, target, origin)
    everyone = actions(6, simulator.device, task=task, seed=1)
    everyone[target] = action[source]
    for _ in range(12):
        for name, tensor in env.tensors.items():
            assert torch.equal(tensor[target], origin.tensors[name][source]), name
        env.step(everyone)
        origin.step(action)


@both
def test_resume_is_exact(task, simulator, hills):
    """A new environment with the saved state continues bit for bit, over goals, pushes, crashes, resets and levels."""
    config = {"terrain": hills, "push_interval": 0.2}
    env = build_on(simulator, task=task, **config)
    loop = build_loop(env)
    action = actions(6, simulator.device, task=task)
    for _ in range(30):
        loop.advance(env.step(action))
    saved = loop.state_dict()
    expected = played(env, loop, action, 45)
    resumed_env = build_on(simulator, task=task, **config)
    resumed = build_loop(resumed_env)
    resumed.load_state_dict(saved)
    assert_same(played(resumed_env, resumed, action, 45), expected)
    assert bool((env.tensors["episode_count"] > saved["env"]["episode_count"]).any())


@both
def test_reports_are_the_same_after_a_resume(task, simulator, hills):
    """What a log gets of the steps after a resume is what it would have got of an uninterrupted run, buffers too."""
    env = build_on(simulator, task=task, terrain=hills)
    buffers = {"warp": ["contact_use", "row_use"], "native": []}[simulator.engine]
    assert [name for name in env.report() if name.endswith("_use")] == buffers
    assert all(env.report()[name] == 0 for name in buffers), "nothing has been simulated yet"
    action = actions(6, simulator.device, task=task)
    reports = []
    for _ in range(12):
        env.step(action)
    env.check()
    env.report()
    saved = env.state_dict()
    resumed = build_on(simulator, task=task, terrain=hills)
    resumed.load_state_dict(saved)
    for world in (env, resumed):
        for _ in range(3):
            world.step(action)
        world.check()
        reports.append(world.report())
    assert reports[0] == reports[1]
    assert all(0 < reports[0][name] < 1 for name in buffers)


@both
def test_two_shards_equal_the_whole(task, simulator, hills):
    """Two environments of 4 worlds, the second with an offset of 4, do what one of 8 does, bit for bit."""
    config = {"terrain": hills, "push_interval": 0.2}
    whole = build_on(simulator, task=task, num_envs=8, **config)
    shards = [build_on(simulator, task=task, num_envs=4, env_offset=offset, **config) for offset in (0, 4)]
    loops = [build_loop(env) for env in (whole, *shards)]
    action = actions(8, simulator.device, task=task)
    for _ in range(50):
        loops[0].advance(whole.step(action))
        for i, shard in enumerate(shards):
            loops[1 + i].advance(shard.step(action[4 * i : 4 * i + 4]))
    for name, tensor in whole.tensors.items():
        assert torch.equal(tensor, torch.cat([shard.tensors[name] for shard in shards])), name
    assert bool((whole.tensors["episode_count"] > 1).all())


@both
@pytest.mark.parametrize(("name", "index", "value"), [("qpos", 8, math.nan), ("qvel", 0, 1e6), ("qvel", 12, math.inf)])
def test_a_broken_world_is_reset_and_touches_nobody(task, simulator, hills, name, index, value):
    """NaN or a huge speed in one world: it is flagged, cut off and begins anew, and no bit of the others changes."""
    env, twin = (build_on(simulator, task=task, terrain=hills, episode_steps=200, goal_period=100) for _ in range(2))
    loops = [build_loop(e) for e in (env, twin)]
    action = actions(6, simulator.device, task=task, scale=0.2)
    for _ in range(4):
        for e, loop in zip((env, twin), loops, strict=True):
            loop.advance(e.step(action))
    env.tensors[name][2, index] = value
    others = [0, 1, 3, 4, 5]
    for t in range(6):
        step, twin_step = env.step(action), twin.step(action)
        assert step.invalid.tolist() == [t == 0 and i == 2 for i in range(6)]
        assert bool(step.obs.isfinite().all())
        for key in vars(step):
            if key != "count":
                assert torch.equal(getattr(step, key)[others], getattr(twin_step, key)[others]), key
        for outcome, loop in zip((step, twin_step), loops, strict=True):
            loop.advance(outcome)
        for key, tensor in env.tensors.items():
            assert torch.equal(tensor[others], twin.tensors[key][others]), key
    assert bool(torch.stack([t.isfinite().all() for t in env.tensors.values()]).all())
    assert int(env.tensors["episode_count"][2]) >= 2
