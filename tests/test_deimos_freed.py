"""What is dropped is freed at once: nothing waits for Python's search for cycles, which no array brings about."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from short_training import CONFIG

from deimos import terrain
from deimos.goals.fear import FearConfig
from deimos.goals.methods import METHODS
from deimos.run.attack import names
from deimos.run.attackers.pooled import make_pool
from deimos.run.audit import audit_choices, audit_clones
from deimos.run.evaluation import EvalConfig, evaluate, make_target
from deimos.run.trainer import Trainer
from deimos.sim.env import Env
from deimos.sim.envs import particle, quad, quad_arm

CPU = torch.device("cpu")
BUILDS = {
    "particle": lambda hills: particle.Config(),
    "quad flat": lambda hills: quad.Config(engine="native"),
    "quad rough": lambda hills: quad.Config(engine="native", terrain=hills),
    "quad arm": lambda hills: quad_arm.Config(engine="native"),
    "mujoco-warp": lambda hills: quad.Config(engine="warp"),
}
SELECTORS = {selector: name for name, (selector, _) in METHODS.items()}  # a method of each


@pytest.fixture
def uncollected():
    """Python does not search for cycles while the test lasts."""
    gc.disable()
    yield
    gc.enable()


def watch(*objects):
    """Tells which of some objects are still there, by their types."""
    refs = [weakref.ref(thing) for thing in objects]
    return lambda: [type(ref()).__name__ for ref in refs if ref() is not None]


def environments():
    """How many there are in this process."""
    return sum(issubclass(type(thing), Env) for thing in gc.get_objects())


@pytest.mark.parametrize("name", BUILDS)
def test_an_environment_is_freed_with_its_last_reference(name, hills, uncollected):
    """Once it has made a step, an environment of every kind is freed when it is dropped, its simulator too."""
    env = BUILDS[name](hills).build(8, CPU, 0)
    env.step(torch.zeros(8, env.action_dim))
    env.sample_goals(torch.arange(3), 4)
    left = watch(env, *(getattr(env, part) for part in ("physics", "legged", "terrain") if hasattr(env, part)))
    del env
    assert left() == []


@pytest.mark.parametrize("method", SELECTORS.values(), ids=SELECTORS)
def test_a_trainer_is_freed_with_its_last_reference(method, uncollected):
    """Once it has learnt, a trainer is freed when it is dropped, with worlds, loop, selector, learner and rollout."""
    trainer = Trainer(replace(CONFIG, selector=None, method=method), CPU)
    for _ in range(3):
        trainer.iterate()
    left = watch(trainer, trainer.env, trainer.loop, trainer.loop.selector, trainer.ppo, trainer.rollout)
    del trainer
    assert left() == []


def test_evaluations_and_audits_leave_no_environment(tmp_path, uncollected):
    """The environments of an evaluation, of every attacker and of an audit of choices are freed at their end."""
    before, pool = environments(), tmp_path / "pool.pt"
    task = replace(CONFIG.env, goal_period=10, max_speed=200.0, max_force=200.0)
    fear = FearConfig(epochs=1, minibatches=1, min_per_class=1)
    config = EvalConfig(
        worlds=20, steps=40, adversary_steps=40, oracle_worlds=4, attackers=tuple(names()), pool=pool, fear=fear
    )
    trainer = Trainer(replace(CONFIG, env=task), CPU)
    for _ in range(4):
        trainer.iterate()
    blind = trainer.env.reference_policy(brake=False)  # which crashes
    make_pool([make_target(blind, task, config, CPU)], pool, may_be_uninformed=True)
    rows = evaluate(blind, task, config, CPU)
    assert [row["goals"] for row in rows] == ["naive", *names()]
    assert audit_choices(trainer, 16, audit_clones(trainer)).percentile
    del trainer
    assert environments() == before


def test_meshes_of_a_terrain_are_freed(uncollected):
    """What a terrain was made of is freed with the making, though meshes of trimesh's are cycles: no array is left."""
    grid = terrain.Grid(shapes=terrain.preset("go1").shapes, levels=2, columns=3, border=2.0)
    terrain.build(grid)
    gc.collect()  # what imports leave
    terrain.build(grid)
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        gc.collect()
        left = [array.shape for array in gc.garbage if isinstance(array, np.ndarray)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
    assert left == []
