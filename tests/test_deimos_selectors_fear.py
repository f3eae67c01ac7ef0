"""Selectors that rank by fear: which goals they take, how often, and how their forecasts are judged."""

import copy
import dataclasses
import math

import pytest
import torch
from scipy import stats
from states import assert_same

from deimos.goals.fear import FearConfig
from deimos.goals.interactions import Interactions
from deimos.goals.methods import method
from deimos.goals.selector import Spaces
from deimos.goals.selectors import boltzmann, director, learnability, uniform
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
SPACES = Spaces(num_envs=40, state_dim=9, goal_dim=3, goal_period=5, device=CPU, total_steps=96)


def decision(rows=40, candidates=100, seed=0):
    """The arguments of ``propose`` for a random decision in each of ``rows`` worlds."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((rows, 9), (rows, 3), (rows, candidates, 3))
    state, goal, options = (torch.randn(*shape, generator=generator) for shape in shapes)
    return torch.arange(rows), state, goal, options, torch.rand(rows, 4, generator=generator)


def fitted(config):
    """A selector whose fear network has learnt that large first components of a goal crash."""
    selector = config.build(SPACES, 0)
    generator = torch.Generator().manual_seed(0)
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
    """Neither its scores nor its choices depend on the state, and it learns from none; a Director's do."""
    rows, state, goal, candidates, draws = decision()
    for control, same in (("state-blind", True), ("none", False)):
        selector = fitted(director.Config(control=control))
        one, other = (selector.propose(rows, s, goal, candidates, draws) for s in (state, 5 - state))
        assert torch.equal(one.score, other.score) == same
        assert torch.equal(one.goal, other.goal) == same
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


def test_predictions_are_judged_once_and_before_they_are_learnt_from():
    """The calibration of an update is that of the scores at issue of what has resolved since the last one."""
    # Goals that last for most of a rollout, so that the window reaches back beyond the last update.
    config = TrainConfig(
        env=particle.Config(goal_period=16, max_speed=70.0, max_force=30.0),
        selector=director.Config(percentile=75, candidates=20, fear=FearConfig(min_per_class=8)),
        ppo=PPOConfig(hidden=(16,), epochs=1, init_std=100.0), num_envs=128, env_steps=96, evaluation=False,
    )  # fmt: skip
    run, resumed = Trainer(config, CPU), Trainer(config, CPU)
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
