"""Every selector on every environment, all found by name."""

import copy
import dataclasses
import functools
import io

import pytest
import torch
from states import assert_same

from deimos import plugins
from deimos.checks import SimulationError
from deimos.goals import selectors
from deimos.goals.fear import FearConfig
from deimos.goals.fear_selector import fear_selector
from deimos.goals.methods import METHODS, method
from deimos.goals.selector import GoalSelector, Spaces
from deimos.goals.selectors import schedule
from deimos.learn.ppo import PPOConfig
from deimos.learn.rollout import Rollout
from deimos.nn import mlps
from deimos.run.loop import GoalLoop, spaces
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim import envs

CPU = torch.device("cpu")
SPACES = Spaces(num_envs=40, state_dim=9, goal_dim=3, goal_period=5, device=CPU, total_steps=96)
ALL = {name: method(name) for name in [*plugins.names(selectors), *METHODS]}

# Settings under which a few worlds of an environment crash often within a few steps; one that is not listed is
# taken as it is.
SMALL_ENVS = {"particle": {"goal_period": 4, "max_speed": 200.0, "max_force": 100.0, "time_limit": 40}}
# What the names of environments on a rigid-body engine begin with. Each would build its robot for every selector, so
# these have a test of their own, which builds one for all.
RIGID_BODY = ("quad",)
# What makes a selector choose within two rollouts of 128 worlds.
SMALL_FIELDS = {"candidates": 20, "capacity": 64, "min_interactions": 50, "fear": FearConfig(min_per_class=8)}


@pytest.fixture(params=[name for name in plugins.names(envs) if not name.startswith(RIGID_BODY)])
def env_name(request):
    """Name of every environment that is cheap enough for a run per selector."""
    return request.param


def small(config):
    """The configuration, such that its selector chooses after few interactions."""
    known = {field.name for field in dataclasses.fields(config)}
    return dataclasses.replace(config, **{name: value for name, value in SMALL_FIELDS.items() if name in known})


def trainer(env_name, name, seed=0, device=CPU):
    """A training run of four rollouts in 128 worlds whose policy throws itself about."""
    config = TrainConfig(
        env=plugins.load(envs, env_name).Config(**SMALL_ENVS.get(env_name, {})), selector=small(ALL[name]), seed=seed,
        ppo=PPOConfig(hidden=(16,), epochs=1, init_std=100.0), num_envs=128, env_steps=96, evaluation=False,
    )  # fmt: skip
    return Trainer(config, device)


@functools.cache
def trained(env_name, name, device=CPU):
    """A run that came to its end, its rows, what was saved after two of its four rollouts, and its last state."""
    run, saved = trainer(env_name, name, device=device), io.BytesIO()
    rows = [run.iterate() for _ in range(2)]
    torch.save(run.state_dict(), saved)
    rows += [run.iterate() for _ in range(2)]
    return run, rows, saved.getvalue(), copy.deepcopy(run.state_dict())


def fresh_and_trained(env_name, name):
    """Both selectors, and for each the arguments of a decision in every world."""
    run = trained(env_name, name)[0]
    env, rows = run.env, torch.arange(run.env.num_envs)
    for selector in (small(ALL[name]).build(spaces(env, 96), 0), run.loop.selector):
        candidates = env.sample_goals(rows, selector.num_candidates, selector.goal_range()).clone()
        yield selector, (rows, env.state(env.obs).clone(), env.goal.clone(), candidates, env.draw(rows).clone())


@pytest.mark.parametrize("name", ALL)
def test_it_chooses_among_the_candidates(env_name, name):
    """New or trained, it picks one of every world's own candidates and returns one score for each."""
    for selector, arguments in fresh_and_trained(env_name, name):
        proposal = selector.propose(*arguments)
        assert (proposal.goal.unsqueeze(1) == arguments[3]).all(2).any(1).all()
        assert proposal.score.shape == (128,)
        numbers = {"weight": torch.float32, "percentile": torch.float32, "probe": torch.bool, "note": torch.int64}
        for optional, dtype in numbers.items():
            value = getattr(proposal, optional)
            assert value is None or (value.shape == (128,) and value.dtype == dtype)
        assert proposal.percentile is None or ((proposal.percentile >= 0) & (proposal.percentile <= 100)).all()


@pytest.mark.parametrize("name", ALL)
def test_the_batch_does_not_matter(env_name, name):
    """New or trained, it chooses the same goal for a world whether alone or among others."""
    for selector, arguments in fresh_and_trained(env_name, name):
        together = selector.propose(*arguments).goal
        alone = selector.propose(*(argument[7:8] for argument in arguments)).goal
        assert torch.equal(together[7:8], alone)


@pytest.mark.parametrize("name", ALL)
def test_a_kernel_chooses_what_products_choose(monkeypatch, env_name, name):
    """With the kernel for CPUs, a trained selector proposes the goals and scores that it proposes by torch alone."""
    run = trained(env_name, name)[0]
    *_, (learnt, arguments) = fresh_and_trained(env_name, name)
    own = spaces(run.env, 96)
    proposals = []
    for kernels in (True, False):
        if not kernels:
            monkeypatch.setattr(mlps, "_kernel", lambda nets: None)
        selector = small(ALL[name]).build(own, 0)
        selector.load_state_dict(copy.deepcopy(learnt.state_dict()))
        proposals.append(selector.propose(*arguments))
    fused, bare = proposals
    same = (fused.goal == bare.goal).all(1)
    assert same.float().mean() > 0.97  # two candidates may be as good as each other up to float32's rounding
    torch.testing.assert_close(fused.score[same], bare.score[same], rtol=1e-3, atol=1e-4, equal_nan=True)


@pytest.mark.parametrize("name", ALL)
def test_it_is_deterministic_in_its_seed_and_resumes_bit_for_bit(env_name, name, torch_device):
    """A second run of one seed starts alike whatever torch drew before, and from a saved state it ends alike."""
    _, rows, saved, last = trained(env_name, name, torch_device)
    torch.rand(17)
    other = trainer(env_name, name, device=torch_device)
    assert_same(other.iterate(), rows[0])
    other.load_state_dict(torch.load(io.BytesIO(saved), map_location="cpu", weights_only=True))
    assert_same([other.iterate(), other.iterate()], rows[2:])
    assert_same(other.state_dict(), last)


@pytest.mark.parametrize("name", ALL)
def test_building_it_leaves_torchs_streams_alone(name, monkeypatch):
    """Neither the CPU's random numbers nor, by a new seed, those of any GPU are another's afterwards."""
    monkeypatch.setattr(torch.cuda, "manual_seed_all", lambda seed: pytest.fail("all GPUs were seeded"))
    before = torch.get_rng_state()
    small(ALL[name]).build(SPACES, 0)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("name", ALL)
def test_it_has_begun_to_choose(env_name, name):
    """The short runs of these tests exercise what a selector learns: nobody is still in his uniform beginning."""
    run, rows, *_ = trained(env_name, name)
    selector = run.loop.selector
    last = selector.current if isinstance(selector, schedule.Schedule) else selector
    afraid = fear_selector(last)
    assert afraid is None or afraid.fear.fitted
    assert getattr(last, "fitted", True)
    assert getattr(last, "replaying", True)
    assert getattr(last, "beta", 1.0) == 1.0
    assert getattr(selector, "switched", True)
    assert all(row.keys() == rows[0].keys() for row in rows)


def has_weights(name):
    """Whether a selector, or the first of its parts, has weights: it checks them then."""
    selector = small(ALL[name]).build(SPACES, 0)
    return type((selector.parts or (selector,))[0]).check is not GoalSelector.check


def test_who_has_weights():
    """All of ours have, but those that only draw or count."""
    without = {"uniform", "cl", "grid", "plr", "plr-robust", "penalty-30", "penalty-100"}
    assert {name for name in METHODS if not has_weights(name)} == without


@pytest.mark.parametrize("name", list(filter(has_weights, ALL)))
def test_another_seed_is_another_selector(env_name, name):
    """What draws weights draws others from another seed."""
    first, second = (small(ALL[name]).build(spaces(trained(env_name, name)[0].env, 96), seed) for seed in (0, 1))
    with pytest.raises(AssertionError):
        assert_same(first.state_dict(), second.state_dict())


@pytest.mark.parametrize("name", list(filter(has_weights, ALL)))
def test_a_weight_that_is_not_finite_stops_the_run(env_name, name):
    """Whatever selector has weights finds a NaN among them."""
    selector = small(ALL[name]).build(spaces(trained(env_name, name)[0].env, 96), 0)
    selector.check()
    part = (selector.parts or (selector,))[0]
    network = (
        part.nets.modules[0]
        if hasattr(part, "nets")
        else part.predictor
        if hasattr(part, "predictor")
        else part.fear.network
    )
    network[0].weight.data[0, 0] = torch.nan
    with pytest.raises(SimulationError, match="is not finite"):
        selector.check()


@pytest.fixture(scope="module", params=[name for name in plugins.names(envs) if name.startswith(RIGID_BODY)])
def robots(request):
    """A few robots of every environment on a rigid-body engine, built once for all selectors: that takes seconds."""
    return plugins.load(envs, request.param).Config(goal_period=4, episode_steps=40).build(12, CPU, 0)


@pytest.mark.parametrize("name", ALL)
def test_it_chooses_goals_for_robots(robots, name):
    """Every selector, CL with its groups included, issues goals within range to robots and learns from what follows."""
    selector = small(ALL[name]).build(spaces(robots, total_steps=96), 0)
    loop = GoalLoop(robots, selector)
    loop.start()
    rollout = Rollout(12, robots.num_envs, robots.obs_dim, robots.action_dim, CPU)
    for t in range(rollout.num_steps):
        rollout.obs[t] = robots.obs
        step = robots.step(torch.zeros(robots.num_envs, robots.action_dim))
        changes = loop.resolve(step)
        rollout.record(
            t, obs=step.obs, reward=step.reward, terminated=step.terminated, truncated=step.truncated,
            invalid=step.invalid, weight=loop.weight, cut_off=changes.cut_off,
        )  # fmt: skip
        loop.renew(step, changes)
    rollout.obs[-1] = robots.obs
    row = selector.learn(loop.interactions, rollout)
    assert all(isinstance(value, float) for value in row.values())
    assert loop.interactions.active.any()
    limit = robots.sample_goals(torch.arange(robots.num_envs), 1000).abs().amax((0, 1)) * 1.05
    assert (robots.goal.abs() <= limit).all()
