"""Every selector on every environment, all found by name; and the selectors that rank by fear."""

import copy
import dataclasses
import functools
import io
import math

import pytest
import torch
from scipy import stats

from deimos import plugins
from deimos.checks import SimulationError
from deimos.goals import selectors
from deimos.goals.fear import FearConfig
from deimos.goals.fear_selector import fear_selector
from deimos.goals.interactions import Interactions
from deimos.goals.methods import METHODS, method
from deimos.goals.selector import GoalSelector, Spaces
from deimos.goals.selectors import boltzmann, cl, director, grid, learnability, mix, plr, rnd, schedule, uniform, vds
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


def assert_same(first, second):
    """Nested states are equal bit for bit, NaN in the same places."""
    if isinstance(first, torch.Tensor):
        torch.testing.assert_close(first, second, rtol=0, atol=0, equal_nan=True)
    elif isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, list | tuple):
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    else:
        assert first == second or (math.isnan(first) and math.isnan(second))


def fresh_and_trained(env_name, name):
    """Both selectors, and for each the arguments of a decision in every world."""
    run = trained(env_name, name)[0]
    env, rows = run.env, torch.arange(run.env.num_envs)
    for selector in (small(ALL[name]).build(spaces(env, 96), 0), run.loop.selector):
        candidates = env.sample_goals(rows, selector.num_candidates, selector.goal_range()).clone()
        yield selector, (rows, env.state(env.obs).clone(), env.goal.clone(), candidates, env.draw(rows).clone())


def decision(rows=40, candidates=100, seed=0):
    """The arguments of ``propose`` for a random decision in each of ``rows`` worlds."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((rows, 9), (rows, 3), (rows, candidates, 3))
    state, goal, options = (torch.randn(*shape, generator=generator) for shape in shapes)
    return torch.arange(rows), state, goal, options, torch.rand(rows, 4, generator=generator)


def fitted(config, seed=0, spaces=SPACES):
    """A selector whose fear network has learnt that large first components of a goal crash."""
    selector = config.build(spaces, seed)
    generator = torch.Generator().manual_seed(seed)
    interactions = Interactions(400, 9, 3, 5, 10, CPU)
    rows, goal = torch.arange(400), torch.rand(400, 3, generator=generator) * 2 - 1
    state = torch.randn(400, 9, generator=generator)
    interactions.open(rows, state, goal.flip(1), goal, torch.full((400,), torch.nan), horizon=5)
    interactions._ring[:, 0], interactions._marks[:, 0, 0] = interactions._pending, goal[:, 0] > 0.5
    interactions._marks[:, 0, 2] = interactions.now = 5
    interactions.active.fill_(False)
    for _ in range(30):
        selector.learn(interactions, None)
    assert selector.fear.fitted
    return selector


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
    small(ALL[name]).build(dataclasses.replace(SPACES, total_steps=96), 0)
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


def test_p_0_is_uniform():
    """With p = 0 a fitted Director picks the very goals that Uniform picks among the same candidates."""
    arguments = decision()
    afraid = fitted(director.Config(percentile=0)).propose(*arguments)
    free = uniform.Config(candidates=100).build(SPACES, 0).propose(*arguments)
    assert torch.equal(afraid.goal, free.goal)


def test_before_it_has_learnt_a_director_is_uniform():
    """Until it has seen both classes the Director picks as Uniform does, and has no opinion."""
    arguments = decision()
    proposal = director.Config(percentile=90).build(SPACES, 0).propose(*arguments)
    assert torch.equal(proposal.goal, uniform.Config(candidates=100).build(SPACES, 0).propose(*arguments).goal)
    assert proposal.score.isnan().all()


def test_coop_and_antagonist_take_the_ends():
    """Coop takes the goal of lowest fear and Antagonist that of highest; p = 100 is Antagonist."""
    arguments = decision()
    for name, pick in (("coop", torch.argmin), ("antagonist", torch.argmax)):
        selector = fitted(method(name))
        score = selector.fear.score(*arguments[1:4])
        chosen = selector.propose(*arguments)
        assert torch.equal(chosen.goal, arguments[3][torch.arange(40), pick(score, 1)])
        best = score.amin(1) if name == "coop" else score.amax(1)
        torch.testing.assert_close(chosen.score, best + selector.calibration.prior)


def test_a_higher_percentile_is_more_frightening():
    """The mean fear of the chosen goals rises from Coop over p = 0, 25, 75 to Antagonist."""
    arguments = decision(rows=400)
    configs = [method("coop"), *[director.Config(percentile=p) for p in (0, 25, 75)], method("antagonist")]
    means = [fitted(config).propose(*arguments).score.mean().item() for config in configs]
    assert means == sorted(means)
    assert means[-1] - means[0] > 1.0


def uniform_decisions(rows, candidates):
    """Decisions among goals of [-1, 1]^3."""
    generator = torch.Generator().manual_seed(5)
    state = torch.randn(rows, 9, generator=generator)
    goal, options = (torch.rand(*shape, generator=generator) * 2 - 1 for shape in ((rows, 3), (rows, candidates, 3)))
    return torch.arange(rows), state, goal, options, torch.rand(rows, 4, generator=generator)


def histogram_p_value(selector):
    """Of a chi-square test that chosen goals fill 64 equal cells of [-1, 1]^3 evenly."""
    chosen = selector.propose(*uniform_decisions(20_000, 20)).goal
    cells = ((chosen + 1) * 2).long().clamp(0, 3) @ torch.tensor([16, 4, 1])
    return stats.chisquare(torch.bincount(cells, minlength=64).numpy()).pvalue


@pytest.mark.parametrize(
    "config",
    [director.Config(percentile=75, candidates=20), director.Config(rule="argmax", candidates=20),
     learnability.Config(candidates=20), boltzmann.Config(candidates=20, anneal=0.0)],
    ids=["p75", "argmax", "learnability", "boltzmann"],
)  # fmt: skip
def test_shuffled_fear_is_uniform(config):
    """With shuffled scores a fitted selector fills the goal space evenly (1 %), and without the shuffle not at all."""
    assert histogram_p_value(fitted(dataclasses.replace(config, control="shuffled"))) > 0.01
    assert histogram_p_value(fitted(config)) < 1e-6


def test_shuffled_fear_keeps_the_record_straight():
    """What is recorded with a goal that the shuffle chose is the fear of that very goal."""
    selector = fitted(director.Config(control="shuffled"))
    arguments = decision()
    proposal = selector.propose(*arguments)
    own = selector.score(arguments[1], arguments[2], proposal.goal.unsqueeze(1)).squeeze(1)
    torch.testing.assert_close(proposal.score, own + selector.calibration.prior, rtol=1e-5, atol=1e-5)


def test_state_blind_fear_sees_no_state():
    """Its scores do not depend on the state, at choice and in learning; a Director's do."""
    rows, state, goal, candidates, draws = decision()
    for control, same in (("state-blind", True), ("none", False)):
        selector = fitted(director.Config(control=control))
        scores = [selector.propose(rows, s, goal, candidates, draws).score for s in (state, 5 - state)]
        assert torch.equal(*scores) == same
    weights = [fitted(director.Config(control=control)).fear.network[0].weight for control in ("state-blind", "none")]
    start = director.Config().build(SPACES, 0).fear.network[0].weight
    assert torch.equal(weights[0][:, :9], start[:, :9])
    assert not torch.equal(weights[1][:, :9], start[:, :9])


def test_probes_are_uniform_and_marked():
    """The configured share of goals is what Uniform would pick, and marked; the others are the Director's own."""
    arguments = uniform_decisions(5000, 20)
    plain = fitted(director.Config(rule="argmax", candidates=20)).propose(*arguments)
    mixed = fitted(director.Config(rule="argmax", candidates=20, probe=0.2)).propose(*arguments)
    free = uniform.Config(candidates=20).build(SPACES, 0).propose(*arguments)
    assert plain.probe is None
    assert abs(mixed.probe.float().mean().item() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 5000)
    assert torch.equal(mixed.goal, torch.where(mixed.probe.unsqueeze(1), free.goal, plain.goal))
    assert mixed.score.isfinite().all()


def with_probabilities(config, probability):
    """A selector's picks for candidates of the given calibrated probabilities, over all draws."""
    selector = config.build(SPACES, 0)
    selector.calibration.set_share(0.2)
    selector.calibration.temperature = 2.0
    score = 2.0 * torch.logit(torch.tensor(probability, dtype=torch.float64)) - math.log(0.2 / 0.8)
    draw = ((torch.arange(10_000) + 0.5) / 10_000).double()
    pick = selector.choose(score.expand(10_000, -1), draw)
    return torch.bincount(pick, minlength=len(probability)) / 10_000


def test_learnability_is_p_times_1_minus_p():
    """Goals are drawn in proportion to p (1 - p), with p the calibrated probability and not the network's own."""
    p = [0.5, 0.1, 0.02, 0.9, 0.7]
    expected = torch.tensor([x * (1 - x) for x in p])
    frequency = with_probabilities(learnability.Config(), p)
    torch.testing.assert_close(frequency, expected / expected.sum(), rtol=0, atol=2e-4)
    frequency = with_probabilities(learnability.Config(rule="percentile", percentile=60), p)
    assert frequency.tolist() == pytest.approx([0.5, 0, 0, 0, 0.5])  # 0.25 and 0.21 are the best two of five


def test_the_band_takes_intermediate_goals_or_the_nearest():
    """Any goal whose p lies in the band is drawn as often; where none does, the one that misses it least."""
    band = learnability.Config(rule="band", low=0.1, high=0.9)
    assert with_probabilities(band, [0.05, 0.2, 0.5, 0.95, 0.85]).tolist() == pytest.approx(
        [0, 1 / 3, 1 / 3, 0, 1 / 3], abs=2e-4
    )
    assert with_probabilities(band, [0.01, 0.04, 0.99]).tolist() == [0, 1, 0]
    assert with_probabilities(band, [0.01, 0.95, 0.99]).tolist() == [0, 1, 0]


def test_boltzmann_follows_its_temperature():
    """Probabilities are in proportion to exp(beta logit), and beta rises linearly over its share of the training."""
    score = torch.tensor([[0.0, 1.0, 2.0]]).expand(10_000, -1)
    draw = (torch.arange(10_000) + 0.5) / 10_000
    selector = boltzmann.Config(beta=3.0, beta_start=-1.0, anneal=0.5).build(SPACES, 0)
    interactions = Interactions(40, 9, 3, 5, 10, CPU)
    for now, beta in ((0, -1.0), (12, 0.0), (24, 1.0), (48, 3.0), (96, 3.0)):
        interactions.now = now
        if now:
            assert selector.learn(interactions, None)["fear/beta"] == beta
        frequency = torch.bincount(selector.choose(score, draw), minlength=3) / 10_000
        torch.testing.assert_close(frequency, torch.softmax(beta * score[0], 0), rtol=0, atol=2e-4)
    assert boltzmann.Config(beta=2.0, anneal=0.0).build(dataclasses.replace(SPACES, total_steps=0), 0).beta == 2.0
    with pytest.raises(ValueError, match=r"boltzmann changes over the training, so Spaces.total_steps must be"):
        boltzmann.Config().build(dataclasses.replace(SPACES, total_steps=0), 0)


def test_predictions_are_judged_once_and_before_they_are_learnt_from(monkeypatch):
    """The calibration of an update is that of the scores at issue of what has resolved since the last one."""
    # Goals that last for most of a rollout, so that the window reaches back beyond the last update.
    monkeypatch.setitem(SMALL_ENVS, "particle", {"goal_period": 16, "max_speed": 70.0, "max_force": 30.0})
    run, resumed = trainer("particle", "p75"), trainer("particle", "p75")
    selector, interactions = run.loop.selector, run.loop.interactions
    for _ in range(6):
        run.iterate()
    resumed.load_state_dict(copy.deepcopy(run.state_dict()))
    run.collect()
    resumed.collect()
    window = interactions.resolved()
    assert (window.resolved == 144).any()
    recent = window.where((window.resolved > 144) & window.score.isfinite())
    # A forecast keeps the prior that it was issued with, while the crash rate keeps changing.
    before = torch.sigmoid(recent.score / selector.calibration.temperature)
    row = selector.learn(interactions, None)
    assert_same(resumed.loop.selector.learn(resumed.loop.interactions, None), row)
    assert len(recent) > 50
    assert row["calibration/brier"] == pytest.approx((before - recent.crashed.float()).square().mean().item(), rel=1e-5)
    assert row["fear/resolved"] == (window.resolved > 144).sum()
    assert row["fear/crash_rate"] == pytest.approx(window.where(window.resolved > 144).crashed.float().mean().item())
    share = (int(window.crashed.sum()) + 0.5) / (len(window) + 1)
    assert selector.calibration.prior == pytest.approx(math.log(share / (1 - share)))


@pytest.mark.parametrize(
    ("config", "field", "value", "message"),
    [
        (director.Config, "percentile", 101, r"percentile must be in \[0, 100\], got 101"),
        (director.Config, "percentile", math.nan, "percentile must be in"),
        (director.Config, "rule", "max", "rule must be one of percentile, argmin, argmax, got 'max'"),
        (director.Config, "candidates", 0, "candidates must be at least 1, got 0"),
        (director.Config, "probe", 1.5, r"probe must be in \[0, 1\], got 1.5"),
        (director.Config, "control", "blind", "control must be one of none, shuffled, state-blind, got 'blind'"),
        (uniform.Config, "candidates", 0, "candidates must be at least 1, got 0"),
        (learnability.Config, "rule", "argmax", "rule must be one of proportional, percentile, band, got 'argmax'"),
        (learnability.Config, "percentile", -1, r"percentile must be in \[0, 100\], got -1"),
        (learnability.Config, "low", 0.9, "low must be below high, got 0.9 and 0.9"),
        (learnability.Config, "high", 1.1, r"high must be in \[0, 1\], got 1.1"),
        (boltzmann.Config, "beta", math.inf, "beta must be finite, got inf"),
        (boltzmann.Config, "beta_start", math.nan, "beta_start must be finite, got nan"),
        (boltzmann.Config, "anneal", 2.0, r"anneal must be in \[0, 1\], got 2.0"),
        (vds.Config, "critics", 0, "critics must be at least 1, got 0"),
        (vds.Config, "rule", "mean", "rule must be one of proportional, argmax, percentile, uniform, got 'mean'"),
        (vds.Config, "role", "both", "role must be one of replace, auxiliary, got 'both'"),
        (vds.Config, "data", "some", "data must be one of all, share, got 'some'"),
        (vds.Config, "clip", 0.0, "clip must be positive, got 0.0"),
        (vds.Config, "hidden", (), "hidden must be one or more positive layer sizes"),
        (rnd.Config, "rule", "percentile", "rule must be one of argmax, proportional, got 'percentile'"),
        (rnd.Config, "features", 0, "features must be at least 1, got 0"),
        (rnd.Config, "target", 0, "target must be at least 1, got 0"),
        (rnd.Config, "predictor", 31, "predictor must have at least the target.s 32 units, .*, got 31"),
        (cl.Config, "threshold", 1.0, r"threshold must be in \(0, 1\), got 1.0"),
        (cl.Config, "start", 0.0, r"start must be in \(0, 1\], got 0.0"),
        (cl.Config, "growth", 1.5, r"growth must be in \(0, 1\], got 1.5"),
        (cl.Config, "min_interactions", 0, "min_interactions must be at least 1, got 0"),
        (grid.Config, "threshold", 0.0, r"threshold must be in \(0, 1\), got 0.0"),
        (grid.Config, "bins", 1, "bins must be at least 2, got 1"),
        (grid.Config, "reach", 0.0, "reach must be finite and positive, got 0.0"),
        (plr.Config, "replay", 1.1, r"replay must be in \[0, 1\], got 1.1"),
        (plr.Config, "fill", 0.0, r"fill must be in \(0, 1\], got 0.0"),
        (plr.Config, "temperature", 0.0, "temperature must be finite and positive, got 0.0"),
        (plr.Config, "capacity", 0, "capacity must be at least 1, got 0"),
        (plr.Config, "capacity", 2**24, r"capacity must be below 2\^24, got 16777216"),
        (schedule.Config, "at", 1.0, r"at must be in \(0, 1\), or the schedule never switches; got 1.0"),
        (schedule.Config, "at", 0.0, r"at must be in \(0, 1\), or the schedule never switches; got 0.0"),
        (schedule.Config, "second", "p333", "no method 'p333'"),
        (mix.Config, "share", -0.1, r"share must be in \[0, 1\], got -0.1"),
        (mix.Config, "base", "best", "no method 'best'"),
    ],
)
def test_config_rejects(config, field, value, message):
    """The message names the field, what it must be and what it was, in one line."""
    with pytest.raises(ValueError, match=message) as caught:
        config(**{field: value})
    assert "\n" not in str(caught.value)


def test_an_unknown_method_lists_the_known_ones():
    """The message lists every method."""
    for name in ("p101", "p1e1", "p07", "p-1", "p", "nope", ""):
        with pytest.raises(ValueError, match=f"no method '{name}'; there are: uniform, coop, p10") as caught:
            method(name)
        assert all(known in str(caught.value) for known in [*METHODS, "pNN", "boltzmann", "schedule"])


@pytest.mark.parametrize(("name", "percentile"), [("p0", 0), ("p33", 33), ("p12.5", 12.5), ("p100", 100)])
def test_every_percentile_is_a_method(name, percentile):
    """A p and a percentile in [0, 100] is the Director at that percentile; the table stays what it is."""
    assert method(name) == director.Config(percentile=percentile)
    assert name not in METHODS


def test_every_selector_is_a_method():
    """A selector's own name is a method with its defaults, also where another package brings it."""
    for name in plugins.names(selectors):
        assert method(name) == plugins.load(selectors, name).Config()


def test_the_thesis_has_twelve_methods():
    """All twelve of its comparison are in the table, Director percentiles and roles as it names them."""
    twelve = "uniform coop p10 p25 p50 p75 p90 antagonist rnd vds cl vds+p75".split()
    assert set(twelve) <= set(METHODS)
    assert [method(name).percentile for name in twelve[2:7]] == [10, 25, 50, 75, 90]
    assert method("vds").role == "replace"
    assert method("vds+p75") == schedule.Config(first="vds", second="p75", at=0.5)


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
