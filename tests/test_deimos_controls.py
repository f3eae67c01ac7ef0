"""Controls deliver what they say, and the oracle and the Director the percentiles that they are asked for."""

import importlib
import math
import sys
from dataclasses import replace

import pytest
import torch
from scipy import stats
from taught_selectors import CPU, SPACES, STATE, across, cells, decisions, history, small_run

from deimos import plugins
from deimos.goals.methods import method
from deimos.goals.selector import with_parts
from deimos.goals.selectors import director, mix, penalty, swapped, uniform
from deimos.run.audit import audit_choices, audit_clones
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle


@pytest.fixture(scope="module")
def twins():
    """A Director and one whose goals are swapped, with the same knowledge."""
    source = history(director.Config(percentile=75, candidates=20).build(SPACES, 0), across)
    other = history(swapped.Config(candidates=20).build(SPACES, 0), across)
    for name in ("fear", "calibration", "memory"):
        getattr(other, name).load_state_dict(getattr(source, name).state_dict())
    return source, other


def test_swapped_goals_are_the_directors_in_wrong_states(twins):
    """Goals are distributed as the Director's (1 %), do not depend on the state, and are hardly more feared."""
    arguments = decisions()
    source, other = (selector.propose(*arguments) for selector in twins)
    counts = torch.stack([torch.bincount(cells(chosen.goal), minlength=64) for chosen in (source, other)])
    assert stats.chi2_contingency(counts.numpy()).pvalue > 0.01
    uneven = stats.chisquare(counts[1].numpy()).pvalue  # the comparison would notice: they are not uniform
    assert uneven < 1e-6
    correlations = [
        torch.corrcoef(torch.stack([arguments[1][:, 0], c.goal[:, 0]]))[0, 1].item() for c in (source, other)
    ]
    assert correlations[0] > 0.2
    assert abs(correlations[1]) < 4 / math.sqrt(len(arguments[0]))
    assert source.percentile.mean() == pytest.approx(87.5, abs=0.5)
    assert 50 < other.percentile.mean() < 75


def test_a_swapped_choice_ignores_its_own_state(twins):
    """In another state and under another goal the very same candidate is picked."""
    rows, state, goal, options, draws = decisions(count=300)
    _, other = twins
    same = [other.propose(rows, s, g, options, draws).goal for s, g in ((state, goal), (state + 2.0, -goal))]
    assert torch.equal(*same)


def test_swapped_goals_can_be_shuffled_too(twins, monkeypatch):
    """With both controls at once, goals are distributed as Uniform's (1 %)."""
    _, other = twins
    monkeypatch.setattr(other, "config", replace(other.config, control="shuffled"))
    counts = torch.bincount(cells(other.propose(*decisions()).goal), minlength=64)
    assert stats.chisquare(counts.numpy()).pvalue > 0.01


def test_state_blind_fear_learns_what_goals_alone_tell():
    """What it learns from has no states in it, and yet it asks for large goals, which crash more often."""
    rows, state, goal, options, draws = decisions(count=2000)
    selector = history(method("state-blind").build(SPACES, 0), across)
    assert (selector.memory._crash[: selector.memory.stored, :STATE] == 0).all()
    assert (selector.memory._partners[: selector.memory.stored, :, :STATE] == 0).all()
    assert (selector.memory._crash[: selector.memory.stored, STATE:] != 0).any(1).all()
    chosen = selector.propose(rows, state, goal, options, draws)
    assert chosen.goal[:, 0].abs().mean() > options[:, :, 0].abs().mean() + 0.15
    assert chosen.percentile.mean() == pytest.approx(87.5, abs=1.5)


def test_swapped_states_are_those_of_the_last_decisions():
    """Every state that it may borrow was met with the goal beside it, by any world, in the decisions just before."""
    selector, met = swapped.Config(candidates=20).build(SPACES, 0), []
    original = selector.propose

    def watch(rows, state, goal, candidates, draws):
        met.append(torch.cat([state, goal], dim=1))
        return original(rows, state, goal, candidates, draws)

    selector.propose = watch
    history(selector, across, rollouts=6)
    borrowed = torch.cat([selector._state, selector._goal], dim=1)
    assert len(met) == 6
    # A call of learn sees the decisions up to it: the last one's are all that there is room for.
    torch.testing.assert_close(borrowed.sort(dim=0).values, met[-1].sort(dim=0).values)


def test_all_controls_of_a_director_have_memory():
    """Controls differ from the Director in one thing only, and crash memory is not it."""
    for name in (
        "shuffled",
        "state-blind",
        "swapped",
        "weighted",
        "fear-novelty",
        "q-fear",
        "p25",
        "coop",
        "antagonist",
    ):
        assert method(name).memory == method("p75").memory > 0


@pytest.fixture
def oracle_module(new_plugins):
    """``reproduction.oracle``, registered as a selector for this test alone."""
    return importlib.import_module("reproduction.oracle")


@pytest.mark.parametrize("percentile", [25.0, 75.0])
def test_the_oracle_delivers_its_percentile(oracle_module, percentile):
    """Its goals have an exact rank of at least p: so many of the candidates crash the policy no sooner."""
    config = particle.Config(goal_period=20, max_speed=100.0, max_force=50.0)

    def follow(obs):
        """Accelerates towards the goal velocity and minds no wall."""
        return (obs[:, 9:12] - obs[:, 0:3]) * 100.0

    env, clones = config.build(48, CPU, 5), Clones(lambda count: config.build(count, CPU, 5), follow)
    oracle = oracle_module.Config(percentile=percentile, candidates=12).build(spaces(env), 0)
    oracle.see(env, clones)
    loop, rows = GoalLoop(env, oracle), torch.arange(48)
    for _ in range(50):
        loop.advance(env.step(follow(env.obs)))
    options = env.sample_goals(rows, 12).clone()
    draws = torch.rand(48, 4, generator=torch.Generator().manual_seed(0))
    chosen = oracle.propose(rows, env.state(env.obs), env.goal, options, draws)
    danger = (20 - clones.try_out(env, rows, options)).float()
    assert ((danger > 0).any(1) & (danger == 0).any(1)).sum() > 5  # there is something to rank
    no_sooner = (danger <= chosen.score.unsqueeze(1)).float().mean(1) * 100
    assert (no_sooner >= percentile).all()
    assert chosen.percentile.mean() > 50 + percentile / 2 - 15


def test_the_exact_percentile_is_measured(oracle_module):
    """By the truth Uniform's goals have the percentile 50, an oracle's Coop a low one, its Antagonist a high one."""
    found = {}
    rules = {rule: oracle_module.Config(rule=rule, candidates=12) for rule in ("argmin", "argmax")}
    for name, selector in {"uniform": uniform.Config(), **rules}.items():
        run = small_run(selector, goal_period=20, max_speed=100.0, max_force=50.0)
        run.ppo.actor.forward = lambda obs: (obs[:, 9:12] - obs[:, 0:3]) * 100.0  # follows goals and minds no wall
        exact, clones = [], audit_clones(run)
        while len(exact) < 60:
            exact += audit_choices(run, run.env.num_envs, clones).percentile
        found[name] = sum(exact) / len(exact)
    assert found["uniform"] == pytest.approx(50, abs=15)
    assert found["argmin"] < 40
    assert found["argmax"] > 60


def test_the_oracle_is_a_plugin(oracle_module):
    """Importing its module makes it a method; outside a training run it says what it lacks; a run resumes."""
    config = method("oracle")
    assert type(config) is oracle_module.Config
    assert plugins.name_of(sys.modules["deimos.goals.selectors"], "reproduction.oracle") == "oracle"
    with pytest.raises(RuntimeError, match="has seen no worlds to clone"):
        config.build(SPACES, 0).propose(*decisions(count=4))
    run = small_run(oracle_module.Config(candidates=6))
    run.iterate()
    other = small_run(oracle_module.Config(candidates=6))
    other.load_state_dict(run.state_dict())
    assert repr(other.iterate()) == repr(run.iterate())
    mixed = small_run(mix.Config(base="oracle"))  # a part of another selector is shown the worlds too
    mixed.iterate()


def test_nobody_else_sees_the_worlds():
    """A run hands its worlds to those who ask for them, and the selectors of the library see tensors only."""
    for name in ("p75", "uniform", "rnd", "vds+p75", "swapped"):
        run = TrainConfig(method=name)
        assert not any(hasattr(part, "see") for part in with_parts(run.goals.build(SPACES, 0)))


def test_a_penalty_is_taken_from_the_learner_alone():
    """Every crash takes its size from the learner's rewards and nothing else changes: worlds, goals, what is logged."""
    plain, punished = (small_run(config) for config in (uniform.Config(), penalty.Config(size=3.0)))
    rows = [run.iterate() for run in (plain, punished)]
    assert rows[0]["crashes"] > 10
    taken = plain.rollout.reward - punished.rollout.reward
    torch.testing.assert_close(taken, 3.0 * plain.rollout.terminated * plain.env.config.largest_reward)
    assert torch.equal(plain.rollout.obs, punished.rollout.obs)
    assert rows[0]["reward"] == pytest.approx(rows[1]["reward"], rel=1e-5)
    assert (method("penalty-30").size, method("penalty-100").size) == (30, 100)
    assert mix.Config(base="penalty-30").build(SPACES, 0).crash_penalty == 30


def test_the_delivered_percentile_counts_every_step():
    """First goals and goals before the first fit count 50, chosen ones their rank, and NaN where nothing ranks."""
    expected = {"uniform": 50.0, "rnd": math.nan, "cl": 50.0}
    for name, value in expected.items():
        run = small_run(method(name))
        rows = [run.iterate() for _ in range(3)]
        assert rows[0]["goal_percentile"] == 50.0 or math.isnan(rows[0]["goal_percentile"])
        assert rows[-1]["goal_percentile"] == value or (math.isnan(value) and math.isnan(rows[-1]["goal_percentile"]))
    run = small_run(director.Config(percentile=75, candidates=20))
    rows = []
    for _ in range(4):
        shares = []
        step = run.loop.resolve
        run.loop.resolve = lambda result, step=step, shares=shares: (
            shares.append(run.loop.core.percentile.mean()) or step(result)
        )
        rows.append(run.iterate())
        run.loop.resolve = step
        assert rows[-1]["goal_percentile"] == pytest.approx(torch.stack(shares).mean().item(), rel=1e-5)
    assert 55 < rows[-1]["goal_percentile"] < 87.5  # diluted by first goals


@pytest.mark.parametrize(("percentile", "expected"), [(0, 50), (25, 62.5), (75, 87.5), (90, 95), (100, 99.5)])
def test_a_fitted_director_delivers_its_nominal_percentile(percentile, expected):
    """Where fear chooses and nothing ties, the mean rank of chosen goals is that of the kept candidates."""
    selector = history(director.Config(percentile=percentile, candidates=100).build(SPACES, 0), across)
    chosen = selector.propose(*decisions(count=4000, candidates=100))
    assert chosen.percentile.mean().item() == pytest.approx(expected, abs=1.5)
