"""What the oracle says would happen is what happens."""

from dataclasses import replace

import pytest
import torch

from deimos.checks import RunError
from deimos.goals.fear import Fear, FearConfig
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.nn.random import Purpose, normals
from deimos.run.audit import _Explorer, audit_calibration, audit_fear
from deimos.run.evaluation import EvalConfig, evaluate, play
from deimos.run.loop import GoalLoop
from deimos.run.oracle import Clones, Oracle
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
CONFIG = particle.Config(goal_period=20, max_speed=100.0, max_force=50.0)
WORLDS, CANDIDATES = 24, 10


def follow(obs):
    """Accelerates towards the goal velocity and minds no wall."""
    return (obs[:, 9:12] - obs[:, 0:3]) * 100.0


def build(count):
    return CONFIG.build(count, CPU, seed=5)


def oracle(env, limit=10_000, **options):
    """An oracle for ``env`` whose policy is the follower."""
    return Oracle(env, Clones(build, follow, limit), candidates=CANDIDATES, **options)


def watched(limit=10_000, rule="percentile", percentile=0.0, steps=100):
    """The interactions under an oracle's goals."""
    env = build(WORLDS)
    loop = GoalLoop(env, oracle(env, limit, rule=rule, percentile=percentile), window=steps)
    for _ in range(steps):
        loop.advance(env.step(follow(env.obs)))
    done = loop.interactions.resolved()
    return done.where(done.issued <= steps - CONFIG.goal_period)


def test_prophecies_come_true():
    """A chosen goal crashes the policy exactly when the oracle says so, and exactly as soon."""
    done = watched()
    assert 0 < int(done.crashed.sum()) < len(done)
    assert torch.equal(done.score > 0, done.crashed)
    survived = (done.resolved - done.issued - done.crashed.long()).float()
    assert torch.equal(CONFIG.goal_period - done.score, survived)


def test_size_of_the_sets_does_not_matter():
    """The same goals are chosen whether many decisions are tried at a time or one after another."""
    together, alone = watched(), watched(limit=1)
    assert torch.equal(together.next_goal, alone.next_goal)


def test_worlds_are_not_touched():
    """Trying candidates leaves the worlds, their goals and their draws alone."""
    env = build(WORLDS)
    before = env.state_dict()
    rows = torch.arange(WORLDS)
    Clones(build, follow).try_out(env, rows, env.sample_goals(rows, CANDIDATES).clone())
    assert all(torch.equal(value, before[name]) for name, value in env.state_dict().items())


def test_argmax_crashes_the_policy_whenever_a_candidate_can():
    """The worst candidate crashes at least as often as any, and a Coop oracle crashes only where all do."""
    rates = [watched(rule=rule).crashed.float().mean() for rule in ("argmin", "percentile", "argmax")]
    assert rates[0] < rates[1] < rates[2]


def test_ties_go_to_the_fear_network():
    """Among candidates of equal fate the network's ranking decides, and never against the truth."""
    env = build(WORLDS)
    fear = Fear(FearConfig(), env.state_dim, env.goal_dim, CPU, seed=0)
    fear.fitted = True
    selector = oracle(env, fear=fear)
    rows = torch.arange(WORLDS)
    state, goal = env.state(env.obs), env.goal
    candidates = env.sample_goals(rows, CANDIDATES).clone()
    chosen = selector.propose(rows, state, goal, candidates, torch.zeros(WORLDS, 4))
    danger = CONFIG.goal_period - Clones(build, follow).try_out(env, rows, candidates)
    logit = fear.score(state, goal, candidates)
    for row in range(WORLDS):
        worst = (danger[row] == danger[row].max()).nonzero().flatten()
        expected = worst[logit[row, worst].argmax()]
        assert torch.equal(chosen.goal[row], candidates[row, expected])


def test_evaluation_adds_a_row():
    """The attacker ``oracle`` meets few worlds and crashes the policy more often than Naive goals do."""
    config = EvalConfig(worlds=64, steps=100, attackers=("oracle",), adversary_steps=60, oracle_worlds=16)
    rows = evaluate(follow, CONFIG, config, CPU)
    assert [row["goals"] for row in rows] == ["naive", "oracle"]
    assert rows[1]["worlds"] == 16
    assert rows[1]["crash_rate"] > rows[0]["crash_rate"]


@pytest.fixture(scope="module")
def afraid():
    """A short training run whose fear network has learnt something."""
    selector = director.Config(fear=FearConfig(min_per_class=4))
    config = TrainConfig(env=CONFIG, selector=selector, ppo=PPOConfig(hidden=(8,)), num_envs=128, evaluation=False)
    trainer = Trainer(config, CPU)
    for _ in range(6):
        trainer.iterate()
    assert trainer.loop.selector.fear.fitted
    return trainer


def test_calibration_is_judged_on_whole_periods(afraid):
    """Chosen and uniform goals are judged on at least as many interactions as asked for, none cut off early."""
    judged = audit_calibration(afraid, 200)
    assert list(judged) == ["selected", "uniform"]
    for probability, crashed, quality in judged.values():
        assert len(probability) == len(crashed) == quality["interactions"] >= 100
        assert ((probability > 0) & (probability < 1)).all()
        assert 0 < quality["crash_rate"] < 1
        assert quality["brier"] <= 1


def test_audits_draw_by_address(afraid):
    """What a world does in an audit follows from the seed, its number and the step, and not from training's noise."""
    obs, actor = torch.zeros(8, afraid.env.obs_dim), afraid.ppo.actor
    whole, half = _Explorer(afraid), _Explorer(afraid, first_world=4)
    with torch.no_grad():
        for step in range(3):
            action = whole(obs)
            assert torch.equal(half(obs[:4]), action[4:])
            drawn = (action - actor(obs)) / actor.std
            address = torch.arange(8), torch.tensor(step), 3
            torch.testing.assert_close(drawn, normals(0, Purpose.AUDIT, *address), rtol=1e-4, atol=1e-5)
            assert (drawn - normals(0, Purpose.EXPLORATION, *address)).abs().min() > 1e-4


def test_audit_agrees_with_itself(afraid):
    """The audit ranks within contexts that have both outcomes and stays within [0, 1]."""
    found = audit_fear(afraid, 5)
    assert found["contexts"] >= 5
    assert 0 <= found["low"] <= found["auroc"] <= found["high"] <= 1


def test_an_audit_of_a_policy_that_always_crashes_ends(afraid, monkeypatch):
    """Where no world lives until its goal changes there is no context, which is said and not waited for."""
    step = afraid.env.step
    monkeypatch.setattr(
        afraid.env, "step", lambda action: replace(step(action), goal_due=torch.zeros(128, dtype=torch.bool))
    )
    with pytest.raises(RunError, match=f"In {50 * CONFIG.goal_period} steps no world lived until its goal changed"):
        audit_fear(afraid, 5)


def test_a_run_without_fear_cannot_be_judged():
    """Uniform has no fear network; the message says so."""
    config = TrainConfig(env=CONFIG, method="uniform", ppo=PPOConfig(hidden=(8,)), num_envs=8, evaluation=False)
    for judge in (audit_calibration, audit_fear):
        with pytest.raises(RunError, match="no fear network"):
            judge(Trainer(config, CPU), 10)


def test_a_learnt_adversary_plays_beside_it():
    """``play`` counts the same way for both, so that their rates compare."""
    env = build(WORLDS)
    row = play(env, follow, oracle(env), 60)
    assert row["interaction_crashes"] <= row["interactions"]
    assert row["crash_rate"] == pytest.approx(row["interaction_crashes"] / row["interactions"])
