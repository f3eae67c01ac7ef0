"""What is dropped is freed at once: nothing waits for Python's search for cycles, which no array brings about."""

import gc
import weakref

import numpy as np
import pytest
import torch
from short_training import CONFIG

from deimos import terrain
from deimos.run.trainer import Trainer
from deimos.sim.envs import particle, quad, quad_arm

CPU = torch.device("cpu")
BUILDS = {
    "particle": lambda hills: particle.Config().build(8, CPU, 0),
    "flat": lambda hills: quad.Config(engine="native").build(8, CPU, 0),
    "rough": lambda hills: quad.Config(engine="native", terrain=hills).build(8, CPU, 0),
    "arm": lambda hills: quad_arm.Config(engine="native").build(8, CPU, 0),
    "warp": lambda hills: quad.Config(engine="warp").build(8, CPU, 0),
}


@pytest.fixture
def uncollected():
    """Python does not search for cycles while the test lasts."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.parametrize("name", BUILDS)
def test_an_environment_is_freed_with_its_last_reference(name, hills, uncollected):
    """Once it has taken a step, an environment of every kind, its memory and its simulator are freed when dropped."""
    env = BUILDS[name](hills)
    env.step(torch.zeros(env.num_envs, env.action_dim))
    env.sample_goals(torch.arange(3), 4)
    parts = [env, env.worlds, *(getattr(env, part) for part in ("physics", "legged", "terrain") if hasattr(env, part))]
    watched = [weakref.ref(part) for part in parts]
    del env, parts
    assert [ref() for ref in watched] == [None] * len(watched)


@pytest.mark.parametrize("method", ["p75", "rnd", "vds", "plr", "antagonist"])
def test_a_trainer_is_freed_with_its_last_reference(method, uncollected):
    """Once it has learnt, a trainer is freed when dropped, with its worlds, loop, selector, learner and rollout."""
    from dataclasses import replace

    trainer = Trainer(replace(CONFIG, selector=None, method=method), CPU)
    for _ in range(3):
        trainer.iterate()
    parts = [trainer, trainer.env, trainer.loop, trainer.loop.selector, trainer.ppo, trainer.rollout]
    watched = [weakref.ref(part) for part in parts]
    del trainer, parts
    assert [ref() for ref in watched] == [None] * len(watched)


def test_the_meshes_of_a_terrain_are_freed(uncollected):
    """What a terrain was made of is freed with the making, though trimesh's meshes are cycles: no array is left over."""
    grid = terrain.Grid(shapes=terrain.preset("go1").shapes, levels=2, columns=3, border=2.0)
    terrain.build(grid)
    gc.collect()
    terrain.build(grid)
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        gc.collect()
        arrays = [found for found in gc.garbage if isinstance(found, np.ndarray)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
    assert [array.shape for array in arrays] == []
