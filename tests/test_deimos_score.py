"""The score of robots: 0 for standing still, 1 for perfect tracking, and less than 0 for who crashes."""

import math
from dataclasses import replace

import pytest
import torch
from deimos.kernels.legged.rewards import RewardWeights

from deimos.goals.selectors import uniform
from deimos.run.evaluation import EvalConfig, evaluate
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.envs import particle, quad, quad_arm

CPU = torch.device("cpu")
SMALL = EvalConfig(worlds=32, steps=120, attackers=())
PERIOD = 60


def stand(env, steps):
    """Let robots stand; what became of their goals, and what is computed for each of these goals."""
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0), window=steps)
    for _ in range(steps):
        loop.advance(env.step(torch.zeros(env.num_envs, env.action_dim)))
    done = loop.outcomes()
    goals = (done.next_goal / env._views["goal_scale"]).expand(env.num_envs, -1, -1)
    expected = torch.cat(env.at_rest(goals), dim=2)
    return done, expected[done.env, torch.arange(len(done))]


def test_tracking_at_rest_is_the_integral_over_the_goals():
    """For velocity goals it is the closed form with the error function, whatever their range and weights."""
    for speed, weights in ((1.0, RewardWeights()), (0.5, RewardWeights(linear_tracking=3.0, yaw_tracking=2.0))):
        config = quad_arm.Config(
            engine="native", speed=speed, rewards=weights, arm_rewards=replace(quad_arm.Config().arm_rewards, reach=0.0)
        ).for_evaluation()
        one = math.sqrt(math.pi * 0.25) / (2 * speed) * math.erf(speed / math.sqrt(0.25))
        expected = (weights.linear_tracking * one**2 + weights.yaw_tracking * one) / (
            weights.linear_tracking + weights.yaw_tracking
        )
        found = config.build(8, CPU, 0).tracking_at_rest()
        # 2^18 goals, whose tracking has a deviation of at most 0.5.
        assert found == pytest.approx(expected, abs=4 * 0.5 / 2**9)


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("task", [quad, quad_arm], ids=["quad", "quad-arm"])
def test_a_robot_that_stands_tracks_as_it_is_computed(task, engine):
    """Goal by goal, what is simulated over whole interactions is what a robot that stands would get."""
    env = task.Config(engine=engine, goal_period=PERIOD).for_evaluation().build(24, CPU, 0)
    done, expected = stand(env, 4 * PERIOD)
    assert not done.crashed.any()
    assert len(done) == 3 * 24
    # A robot settles from its start within a period; then some trunks with an arm still sink, whose end
    # effectors come nearer by 4 cm in the next two seconds at worst, of a range of 30 cm.
    later = done.issued > PERIOD
    apart = (done.tracking - expected)[later]
    assert float(apart.abs().max()) < 0.1
    assert float(apart.mean(0).abs().max()) < 0.015


def test_the_score_of_an_evaluation_is_its_place_between_rest_and_perfection():
    """Standing is about 0, falling is less; it is (tracking - at rest) / (1 - at rest) of the weighted groups."""
    config = quad.Config(engine="native", goal_period=20)
    still, wild = (
        evaluate(lambda obs, size=size: torch.full((len(obs), 12), size), config, SMALL, CPU)[0] for size in (0.0, 1.0)
    )
    rest = config.for_evaluation().build(SMALL.worlds, CPU, SMALL.seed).tracking_at_rest()
    for row in (still, wild):
        assert row["score"] == pytest.approx((row["matching"] - rest) / (1.0 - rest))
    assert still["crash_rate"] == 0.0
    # Interactions whose tracking has a deviation of 0.3.
    assert abs(still["score"]) < 4 * 0.3 / math.sqrt(still["interactions"]) / (1.0 - rest)
    assert wild["crash_rate"] > 0.5
    assert wild["score"] < -0.1


def test_tracking_counts_nothing_from_a_crash_on():
    """Of an interaction that crashes after half of its steps half can count at most, whatever the steps are worth."""
    env = quad.Config(engine="native", goal_period=PERIOD, rewards=RewardWeights()).for_evaluation().build(4, CPU, 0)
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0), window=200)
    for t in range(2 * PERIOD):
        step = env.step(torch.zeros(4, 12))
        step.tracking.fill_(1.0)
        step.terminated[0] = t == PERIOD + PERIOD // 2 - 1
        loop.advance(step)
    done = loop.outcomes()
    torch.testing.assert_close(done.tracking[done.env == 0], torch.full((1, 2), 0.5 - 1 / PERIOD))
    torch.testing.assert_close(done.tracking[done.env != 0], torch.ones(3, 2))


def test_without_weights_there_is_no_score():
    """Where no group of the goal has a weight, the score is NaN; that of a particle is still that of its scripts."""
    nothing = RewardWeights(linear_tracking=0.0, yaw_tracking=-1.0)
    config = quad.Config(engine="native", goal_period=20, rewards=nothing)
    (row,) = evaluate(lambda obs: torch.zeros(len(obs), 12), config, replace(SMALL, worlds=2, steps=40), CPU)
    assert math.isnan(row["score"])
    env = particle.Config(goal_period=20).build(4, CPU, 0)
    assert env.tracking_at_rest() is None
    (row,) = evaluate(
        lambda obs: torch.zeros(len(obs), 3), particle.Config(goal_period=20), replace(SMALL, steps=60), CPU
    )
    assert row["score"] == 0.0
    assert "matching" not in row
