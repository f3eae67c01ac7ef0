"""Controls and new selectors deliver what they say."""

import dataclasses
import importlib
import math
import sys

import pytest
import torch
from scipy import stats

from deimos import GoalDirector, plugins
from deimos.goals import picks
from deimos.goals.core import GoalCore
from deimos.goals.interactions import Interactions
from deimos.goals.methods import method
from deimos.goals.selector import Spaces, with_parts
from deimos.goals.selectors import director, mix, novelty, penalty, q_fear, rnd, swapped, uniform, vds, weighted
from deimos.learn.ppo import PPOConfig
from deimos.run.audit import audit_choices, audit_clones
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
WORLDS, STATE, GOAL = 400, 3, 2
SPACES = Spaces(num_envs=WORLDS, state_dim=STATE, goal_dim=GOAL, goal_period=5, device=CPU, total_steps=96)


def history(selector, crashes, rollouts=40, seed=0):
    """Let a selector learn from goals of its own whose outcome is a function of (state, goal, next goal)."""
    core = GoalCore(selector, SPACES)
    generator = torch.Generator().manual_seed(seed)
    no = torch.zeros(WORLDS, dtype=torch.bool)
    doomed, goal = no.clone(), torch.rand(WORLDS, GOAL, generator=generator) * 2 - 1
    for now in range(5 * rollouts):
        due = no if (now + 1) % 5 else ~no
        crash = doomed if now % 5 == 2 else no  # halfway through the period
        changes = core.advance(crash, no, due, torch.zeros(WORLDS))
        rows = changes.due
        if len(rows):
            state = torch.randn(len(rows), STATE, generator=generator)
            options = torch.rand(len(rows), selector.num_candidates, GOAL, generator=generator) * 2 - 1
            draws = torch.rand(len(rows), 4, generator=generator)
            chosen = core.choose(rows, state, goal[rows], options, draws)
            doomed = no.clone()
            doomed[rows] = crashes(state, goal[rows], chosen)
            goal[rows] = chosen
            core.learn(None)
        doomed = doomed & ~crash
    return selector


def across(state, goal, next_goal):
    """A goal crashes where its first component agrees in sign with the state's, and both are large."""
    return (state[:, 0] * next_goal[:, 0]) > 0.4


def decisions(count=20_000, candidates=20, seed=5):
    """The arguments of ``propose``, with goals of [-1, 1]^2; any world may decide again."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(count, STATE, generator=generator)
    goal, options = (torch.rand(*shape, generator=generator) * 2 - 1 for shape in ((count, 2), (count, candidates, 2)))
    return torch.arange(count) % WORLDS, state, goal, options, torch.rand(count, 4, generator=generator)


@pytest.fixture(scope="module")
def twins():
    """A Director and one whose goals are swapped, with the same knowledge."""
    source = history(director.Config(percentile=75, candidates=20).build(SPACES, 0), across)
    other = history(swapped.Config(candidates=20).build(SPACES, 0), across)
    for name in ("fear", "calibration", "memory"):
        getattr(other, name).load_state_dict(getattr(source, name).state_dict())
    return source, other


def cells(goal):
    """Cell of every goal on a grid of 8 x 8."""
    return ((goal + 1) * 4).long().clamp(0, 7) @ torch.tensor([8, 1])


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


def test_state_blind_goals_ignore_the_state():
    """Whatever the state, the same candidate is picked; the Director's choice depends on it."""
    rows, state, goal, options, draws = decisions(count=300)
    for control, same in (("state-blind", True), ("none", False)):
        config = director.Config(percentile=75, candidates=20, control=control)
        selector = history(config.build(SPACES, 0), across)
        chosen = [selector.propose(rows, s, goal, options, draws).goal for s in (state, -state)]
        assert torch.equal(*chosen) == same
    assert method("state-blind").memory > 0


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
def oracle_module(monkeypatch):
    """``reproduction.oracle``, registered as a selector for this test alone."""
    monkeypatch.setattr(plugins, "_registered", {})
    monkeypatch.delitem(sys.modules, "reproduction.oracle", raising=False)
    yield importlib.import_module("reproduction.oracle")
    sys.modules.pop("reproduction.oracle", None)


def small_run(selector, **env):
    """A run of a few worlds whose policy throws itself about."""
    config = particle.Config(**({"goal_period": 8, "max_speed": 200.0, "max_force": 100.0} | env))
    ppo = PPOConfig(hidden=(16,), epochs=1, init_std=100.0)
    return Trainer(TrainConfig(env=config, selector=selector, ppo=ppo, num_envs=48, evaluation=False), CPU)


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


def test_uniform_ensemble_differs_from_uniform_in_the_baseline_alone():
    """Its goals are the ones that Uniform picks, and PPO's baseline is VDS's ensemble."""
    selector = method("uniform-ensemble").build(SPACES, 0)
    arguments = decisions(count=200, candidates=1)
    chosen = selector.propose(*arguments)
    assert torch.equal(chosen.goal, uniform.Config().build(SPACES, 0).propose(*arguments).goal)
    assert selector.num_candidates == 1
    assert selector.critic() is not None
    assert method("uniform-ensemble") == dataclasses.replace(method("vds"), rule="uniform")


def test_vds_argmax_takes_the_largest_deviation():
    """Of all candidates it takes the one that the critics disagree about most."""
    selector = method("vds-argmax").build(SPACES, 0)
    rows, state, goal, options, draws = decisions(count=50)
    chosen = selector.propose(rows, state, goal, options, draws)
    inputs = torch.cat([state.unsqueeze(1).expand(-1, 20, -1), options], dim=2)
    deviation = selector.values(inputs).std(dim=0, correction=0)
    assert torch.equal(chosen.goal, picks.take(options, deviation.argmax(1)))


def test_raw_rnd_sees_inputs_as_they_are():
    """Its networks are applied to what it is given, neither whitened nor clipped; by default they are."""
    _, state, goal, options, _ = decisions(count=50)
    state = 30.0 * state
    for config, same in ((rnd.Config(whiten=False), True), (rnd.Config(), False)):
        selector = history(config.build(SPACES, 0), across, rollouts=6)
        assert selector.fitted
        inputs = torch.cat([torch.cat([state, goal], 1).unsqueeze(1).expand(-1, 20, -1), options], dim=2)
        error = (selector.predictor(inputs) - selector.target(inputs)).square().mean(2).detach()
        surprise = selector.surprise(state, goal, options)
        assert torch.allclose(surprise, error, rtol=1e-3, atol=1e-3) == same
    assert method("rnd-raw") == rnd.Config(whiten=False)


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


def test_weights_make_goals_uniform():
    """In expectation over choices a goal's weighted frequency is Uniform's, for its own decision and overall."""
    config = weighted.Config(candidates=20, mix=0.5, alpha=1.0)
    selector = history(config.build(SPACES, 0), across)
    arguments = decisions()
    chosen = selector.propose(*arguments)
    # p = 75 keeps 5 of 20: q is 0.5 / 20 + 0.5 / 5 there and 0.5 / 20 elsewhere.
    assert {round(weight, 4) for weight in chosen.weight.tolist()} == {0.4, 2.0}
    assert chosen.weight.mean() == pytest.approx(1.0, abs=0.02)
    plain = torch.bincount(cells(chosen.goal), minlength=64)
    mended = torch.bincount(cells(chosen.goal), chosen.weight.double(), minlength=64)
    assert stats.chisquare(plain.numpy()).pvalue < 1e-6
    noise = torch.bincount(cells(chosen.goal), chosen.weight.double().square(), minlength=64).sqrt()
    assert (((mended - len(chosen.goal) / 64) / noise).abs() < 4.5).all()
    assert (chosen.percentile[chosen.weight < 1] > 75).all()


def test_alpha_and_mix_span_from_uniform_to_the_director():
    """An alpha of 0 weighs nothing, mix 1 is Uniform with weights of 1, and a small mix is the Director."""
    arguments = decisions(count=2000)
    for changes, weights in (({"alpha": 0.0}, {1.0}), ({"mix": 1.0}, {1.0})):
        chosen = history(weighted.Config(candidates=20, **changes).build(SPACES, 0), across).propose(*arguments)
        assert set(chosen.weight.tolist()) == weights
    assert chosen.percentile.mean() == pytest.approx(50, abs=2)
    strict = history(weighted.Config(candidates=20, mix=1e-3).build(SPACES, 0), across).propose(*arguments)
    assert strict.percentile.mean() == pytest.approx(87.5, abs=1)
    with pytest.raises(ValueError, match=r"mix must be in \[0.001, 1\], got 0"):
        weighted.Config(mix=0.0)
    with pytest.raises(ValueError, match="control must be none or state-blind where goals are weighed, got 'shuffled'"):
        weighted.Config(control="shuffled")


def test_effective_share_and_state_shift_are_told():
    """The share is 1 / E_u[u / q] = 0.625 at a mix of 0.5; the shift is 0.5 where goals move no states."""
    selector = history(weighted.Config(candidates=100, mix=0.5, alpha=1.0).build(SPACES, 0), across)
    arguments = decisions(candidates=100)
    selector.issued(*arguments[:4], selector.propose(*arguments))
    interactions = Interactions(WORLDS, STATE, GOAL, 3, 10, CPU)
    for shift, low, high in ((0.0, 0.35, 0.65), (3.0, 0.9, 1.0)):
        rows, generator = torch.arange(WORLDS), torch.Generator().manual_seed(0)
        note = 1 + (torch.rand(WORLDS, generator=generator) < 0.5).long()
        zeros = torch.zeros(WORLDS, GOAL)
        state = torch.randn(WORLDS, STATE, generator=generator)
        interactions.open(rows, state, zeros, zeros, zeros[:, 0], horizon=5, note=note)
        interactions.now += 5
        interactions.resolve(rows, zeros[:, 0] > 0, zeros[:, 0] == 0)
        interactions.open(rows, state + shift * (note == 2).unsqueeze(1), zeros, zeros, zeros[:, 0], horizon=5)
        row = selector.learn(interactions, None)
        assert low <= row["weighted/state_shift"] <= high
        if shift == 0.0:
            assert row["weighted/effective_share"] == pytest.approx(0.625, abs=0.01)
        interactions.resolve(rows, zeros[:, 0] > 0, zeros[:, 0] > 0)  # cut off
        interactions.now += 20
    assert math.isnan(selector.learn(interactions, None)["weighted/state_shift"])


def test_the_learner_takes_the_weights():
    """A run's transitions weigh as their goal does, and a GoalDirector hands the weights out."""
    run = small_run(weighted.Config(candidates=20, mix=0.5, alpha=1.0))
    for _ in range(4):
        run.iterate()
    assert {0.4, 1.0, 2.0} >= {round(value, 4) for value in run.rollout.weight.unique().tolist()} >= {0.4, 2.0}
    goals, no = (
        GoalDirector(weighted.Config(candidates=9, mix=0.5, alpha=1.0), goal_period=2, learn_every=4),
        torch.zeros(4, dtype=torch.bool),
    )
    seen, goal = set(), torch.zeros(4, 2)
    for t in range(60):
        crash = no.clone()
        crash[t % 4] = t % 3 == 0
        given = goals.step(torch.randn(4, 3), goal, crash, no, torch.rand(4, 9, 2))
        goal = given.goal
        assert (given.weight[crash] == 1).all()
        seen |= set(given.weight.tolist())
    assert len(seen) == 3


def test_novel_goals_of_unsure_outcome_are_drawn():
    """Odds are p (1 - p) of the drawn head times the novelty rank to the power of eta."""
    selector = history(novelty.Config(candidates=20, eta=2.0).build(SPACES, 0), across)
    _, state, goal, options, draws = decisions(count=40)
    score = selector.score(state, goal, options)
    weight = selector.ranking(state, goal, options, score, draws)
    heads = [score, *(head.score(state, goal, options) for head in selector.heads)]
    rank = selector.rnd.surprise(state, goal, options).argsort(1).argsort(1) + 1
    for row in range(40):
        p = selector.calibration.probability(heads[int(draws[row, 3] * 4)][row])
        torch.testing.assert_close(weight[row], p * (1 - p) * (rank[row] / 20) ** 2)
    assert len(selector.heads) == 3
    spread = torch.stack(heads).std(dim=0).mean()
    assert spread > 0.05  # the heads are networks of their own
    frequency = picks.in_proportion(weight[:1].expand(10_000, -1), (torch.arange(10_000) + 0.5) / 10_000)
    expected = weight[0] / weight[0].sum()
    torch.testing.assert_close(torch.bincount(frequency, minlength=20) / 10_000, expected, rtol=0, atol=3e-4)


def test_without_eta_novelty_does_not_count():
    """With eta 0 and one head the odds are learnability's."""
    selector = history(novelty.Config(candidates=20, eta=0.0, heads=1).build(SPACES, 0), across)
    _, state, goal, options, draws = decisions(count=40)
    score = selector.score(state, goal, options)
    p = selector.calibration.probability(score)
    torch.testing.assert_close(selector.ranking(state, goal, options, score, draws), p * (1 - p))


class Chain:
    """States -1, 0 and 1: goals above 0 lead one up, others down; at 1 every goal above 0 crashes."""

    def __init__(self):
        self.state = torch.zeros(WORLDS)

    def play(self, selector, rollouts=150):
        """Let a selector choose one-step goals in many chains."""
        core = GoalCore(selector, dataclasses.replace(SPACES, state_dim=1, goal_dim=1, goal_period=1))
        generator = torch.Generator().manual_seed(0)
        no = torch.zeros(WORLDS, dtype=torch.bool)
        goal = torch.zeros(WORLDS, 1)
        for _ in range(rollouts):
            crash = (self.state == 1) & (goal[:, 0] > 0)
            self.state = torch.where(crash, 0.0, (self.state + goal[:, 0].sign()).clamp(-1, 1))
            changes = core.advance(crash, no, ~no, torch.zeros(WORLDS))
            rows = changes.due
            options = torch.rand(len(rows), selector.num_candidates, 1, generator=generator) * 2 - 1
            draws = torch.rand(len(rows), 4, generator=generator)
            goal[rows] = core.choose(rows, self.state[rows].unsqueeze(1), goal[rows], options, draws)
            goal[changes.done] = torch.rand(len(changes.done), 1, generator=generator) * 2 - 1
            core.learn(None)
        return selector


def test_q_fear_sees_what_may_follow():
    """At 0, where no goal crashes, one that leads to the edge is feared; fear of the next step alone fears none."""
    feared = {}
    for beta in (0.9, 0.0):
        sizes = dataclasses.replace(SPACES, state_dim=1, goal_dim=1, goal_period=1)
        selector = Chain().play(q_fear.Config(percentile=0, candidates=8, beta=beta).build(sizes, 0))
        ahead = torch.tensor([[[0.7], [-0.7]]] * 2)
        feared[beta] = torch.sigmoid(selector.score(torch.tensor([[0.0], [1.0]]), torch.zeros(2, 1), ahead))
    for found in feared.values():  # at the edge both know what crashes
        assert found[1, 0] > 0.9
    assert feared[0.0][0].max() < 0.1
    assert feared[0.9][0, 0] > 0.3
    assert feared[0.9][0, 0] > feared[0.9][0, 1]


def test_q_targets_are_discounted_worst_fears():
    """A survival's target is beta times the fear of the most feared candidate that followed, a crash's is 1."""
    selector = history(q_fear.Config(candidates=20, beta=0.5).build(SPACES, 0), across)
    rows, state, goal, options, draws = decisions(count=WORLDS)
    selector.issued(rows, state, goal, options, selector.propose(rows, state, goal, options, draws))
    fits = []
    selector.fear.fit_rows = lambda inputs, crashed, weight, target: fits.append((crashed, target)) or 0.0
    worst = selector.score(state, goal, options).amax(1)
    width = STATE + 2 * GOAL
    lesson = torch.cat([torch.zeros(WORLDS, width), selector._worst], dim=1)
    lesson[:5, width:] = torch.nan
    crashed = torch.arange(WORLDS) % 10 == 0
    selector.fit(lesson, crashed, torch.ones(WORLDS))
    ((_, target),) = fits
    expected = 0.5 * selector.calibration.probability(worst)
    expected[:5] = 0.0
    torch.testing.assert_close(target, torch.where(crashed, 1.0, expected), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="beta must be in"):
        q_fear.Config(beta=1.0)


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


def test_percentiles_count_ties_half():
    """A constant score has the percentile 50, the largest of N different ones 100 (N - 1/2) / N."""
    score = torch.tensor([[3.0, 3.0, 3.0, 3.0], [1.0, 2.0, 3.0, 4.0], [1.0, 1.0, 2.0, 3.0]])
    assert picks.percentile(score, torch.tensor([3.0, 4.0, 1.0])).tolist() == [50.0, 87.5, 25.0]


def test_vds_needs_no_candidates_for_uniform_goals():
    """The rule is checked, and only ``uniform`` asks for one candidate."""
    assert [vds.Config(rule=rule).build(SPACES, 0).num_candidates for rule in ("uniform", "argmax")] == [1, 100]
