"""What an iteration asks of a GPU, counted on a CPU: calls of torch, launches of Warp, and waits for the device."""

from collections import Counter
from dataclasses import replace

import pytest
import replay
import torch
import warp as wp
from replay import counted

from deimos.goals import methods
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
BUDGET = {"uniform": (52, 5), "p75": (67, 5)}
"""Calls of torch that start work on the device, and launches of Warp, in a step of a rollout with goals of a method."""
VIEWS = {"uniform": 37, "p75": 61}
"""Calls of torch in a step that start no work: views."""
NOISE = 137
"""Calls for the exploration of a whole rollout."""
MINIBATCH, MINIBATCH_VIEWS = 127, 53
"""Calls in a minibatch of the update, under torch's products."""


@pytest.fixture
def as_on_gpu(monkeypatch):
    """Torch's products and its random numbers, and goals for all worlds, as on CUDA; gives how often Warp launched."""
    replay.as_on_gpu(monkeypatch)
    launches, launch = Counter(), wp.Launch.launch
    monkeypatch.setattr(wp.Launch, "launch", lambda self, *more: launches.update(["launch"]) or launch(self, *more))
    return launches


def trained(selector, iterations=4):
    """A trainer after some iterations: fear has learnt, and chooses."""
    env = particle.Config(goal_period=10, time_limit=70, max_speed=150.0, max_force=150.0)
    ppo = PPOConfig(init_std=80.0, hidden=(16, 16))
    trainer = Trainer(
        TrainConfig(env=env, selector=selector, ppo=ppo, num_envs=48, env_steps=24 * 30, evaluation=False), CPU
    )
    for _ in range(iterations):
        trainer.iterate()
    return trainer


@pytest.mark.parametrize("name", methods.METHODS)
def test_a_rollout_never_waits_for_the_device(name, as_on_gpu):
    """Whoever chooses the goals, no operation of a rollout waits for a GPU or copies something from the host."""
    selector = methods.method(name)
    if name.startswith("plr"):
        selector = replace(selector, capacity=20)  # full after the first rollout, so that goals are replayed
    trainer = trained(selector, 1)
    with counted() as calls:
        trainer.collect()
    assert not calls.waits
    assert trainer.rollout.terminated.any()


@pytest.mark.parametrize("name", BUDGET)
def test_a_step_keeps_within_its_budget(name, as_on_gpu):
    """A step makes no more calls and launches than the table says, whether or not goals are due."""
    trainer = trained(methods.method(name))
    noise = trainer.rollout.noise.clone()
    with counted() as drawing:
        trainer.ppo.draw_noise(noise, 0)
    as_on_gpu.clear()
    with counted() as calls:
        trainer.collect()
    steps, (work, launches) = trainer.rollout.num_steps, BUDGET[name]
    assert drawing.work.total() <= NOISE
    assert (calls.work - drawing.work).total() / steps <= work
    assert (calls.views - drawing.views).total() / steps <= VIEWS[name]
    assert as_on_gpu["launch"] / steps == launches


def test_an_update_keeps_within_its_budget(as_on_gpu, monkeypatch):
    """No minibatch waits for the device; around them an update waits three times, to decide and to report."""
    trainer = trained(methods.method("uniform"), 1)
    trainer.collect()
    ppo, inside = trainer.ppo, []
    learn = ppo._learn

    def watched(*arguments, **more):
        with counted() as calls:
            done = learn(*arguments, **more)
        inside.append(calls)
        return done

    monkeypatch.setattr(ppo, "_learn", watched)
    with counted() as calls:
        ppo.update(trainer.rollout)
    assert len(inside) == ppo.config.epochs * ppo.config.minibatches
    for each in inside:
        assert not each.waits
        assert each.work.total() <= MINIBATCH
        assert each.views.total() <= MINIBATCH_VIEWS
    assert set(calls.waits) == {"nonzero", "_local_scalar_dense", "__bool__", "tolist"}


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.tolist(), lambda x: x.sum().item(), lambda x: bool(x.any()), lambda x: x[x > 1], lambda x: x.cpu(),
        lambda x: x.nonzero(), lambda x: x.unique(), lambda x: x.repeat_interleave(x.long()), lambda x: x.numpy(),
        lambda x: x + torch.tensor([1.0]), lambda x: x.clone().__setitem__(x > 1, x[:2]),
        lambda x: x.clone().index_put_((x.long(),), torch.tensor(1.0)), lambda x: x[[0, 1]], lambda x: float(x[0]),
        lambda x: torch.equal(x, x), lambda x: x.masked_select(x > 1), lambda x: x.long().bincount(),
    ],
)  # fmt: skip
def test_waits_are_found(wait):
    """The count finds every way in which torch waits for a device; what does not wait is not counted."""
    x = torch.arange(4.0)
    with counted() as calls:
        torch.where(x > 1, x, 0.0).masked_fill_(x > 2, 1.0)
        x[x.long()] + x[1:2].expand(4)
    assert not calls.waits
    with counted() as calls:
        wait(x)
    assert calls.waits


def test_what_wants_to_know_who_is_due_waits(as_on_gpu):
    """A selector that may not be asked about all worlds makes a rollout wait once a step, and no oftener."""
    trainer = trained(methods.method("uniform"), 1)
    trainer.loop.selector.dense = False
    with counted() as calls:
        trainer.collect()
    assert calls.waits == {"tolist": trainer.rollout.num_steps}


def test_probing_and_controls_do_not_wait_either(as_on_gpu):
    """Nor do probes, shuffled scores and the thesis's literal fear."""
    for changes in ({"probe": 0.3}, {"control": "shuffled", "memory": 0}, {"rule": "argmin"}):
        trainer = trained(replace(methods.method("p75"), **changes), 1)
        with counted() as calls:
            trainer.collect()
        assert not calls.waits
