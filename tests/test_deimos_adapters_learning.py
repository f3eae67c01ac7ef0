"""Selectors learn in rsl_rl's loop and in gymnasium's, as in Deimos' own."""

import numpy as np
import pytest
import torch
from bare_loop import CONFIG, CPU, random_actions
from gymnasium.vector import AutoresetMode
from rsl_rl.runners import OnPolicyRunner
from taught_selectors import SPACES

from deimos.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from deimos.adapters.rsl_rl import RslRlVecEnv, runner_config
from deimos.goals.core import window_between
from deimos.goals.fear import FearConfig
from deimos.goals.methods import METHODS, method
from deimos.goals.selectors import director, vds
from deimos.learn.ppo import PPOConfig
from deimos.run.loop import GoalLoop, spaces

DIRECTOR = director.Config(percentile=75.0, candidates=20, fear=FearConfig(min_per_class=4))


def directed(learn_every, selector=DIRECTOR, device=CPU, num_envs=64):
    """Worlds of 96 steps whose goals a selector chooses."""
    env = CONFIG.build(num_envs, device, 0)
    return RslRlVecEnv(env, selector.build(spaces(env, total_steps=96), seed=0), learn_every=learn_every)


def test_director_learns_in_rsl_rl(torch_device):
    """After every rollout of the runner, whose log shows it, fear has learnt, and later goals go by it."""
    torch.manual_seed(0)
    env = directed(12, device=torch_device)
    ppo = PPOConfig(hidden=(16,), num_steps=12, init_std=CONFIG.max_force)
    runner = OnPolicyRunner(env, runner_config(ppo, env), log_dir=None, device=str(torch_device))
    runner.learn(num_learning_iterations=1)
    assert env.loop.selector.fear.fitted
    assert env.loop.metrics["fear/loss"] > 0
    runner.learn(num_learning_iterations=1)  # 24 steps: a report is due
    resolved = env.loop.interactions.resolved()
    assert resolved.score[resolved.issued > 12].isfinite().all()
    for _ in range(24):
        extras = env.step(torch.zeros(64, 3, device=torch_device))[3]
    np.testing.assert_equal(extras["log"], env.loop.metrics)


def test_it_learns_as_the_bare_loop_does():
    """In inference mode, as the runner steps, goals and networks are those of a loop taught by hand, bit for bit."""
    ours, theirs = CONFIG.build(64, CPU, 0), directed(12)
    loop = GoalLoop(ours, DIRECTOR.build(spaces(ours, total_steps=96), 0), window_between(ours.goal_period, 12))
    for now, action in enumerate(torch.from_numpy(random_actions(60, 64)), start=1):
        loop.advance(ours.step(action))
        if now % 12 == 0:
            loop.core.learn(None)
        with torch.inference_mode():
            assert torch.equal(theirs.step(action)[0]["policy"], ours.obs)
    pairs = zip(loop.selector.fear.network.parameters(), theirs.loop.selector.fear.network.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    np.testing.assert_equal(theirs.loop.learn(), loop.core.learn(None))  # outside of inference mode, too


def test_the_owner_may_let_it_learn():
    """Without ``learn_every`` nothing is learnt until ``loop.learn`` is called."""
    env = directed(None)
    for action in torch.from_numpy(random_actions(30, 64)):
        env.step(action)
    assert not env.loop.selector.fear.fitted
    assert np.isfinite(env.loop.learn()["fear/loss"])
    assert env.loop.selector.fear.fitted
    with pytest.raises(ValueError, match="learn_every must be at least 1, got 0"):
        directed(0)


TAUGHT = [name for name in METHODS if method(name).build(SPACES, 0).needs_rollout]


@pytest.mark.parametrize("name", sorted(set(METHODS) - set(TAUGHT)))
def test_every_method_that_can_learns(name):
    """Steps in inference mode and updates of all other methods go on outside of it, from a saved state too."""
    env = directed(8, method(name), num_envs=16)
    actions = torch.from_numpy(random_actions(32, 16))
    with torch.inference_mode():
        for action in actions[:16]:
            env.step(action)
    assert "goal_percentile" in env.loop.metrics
    env.loop.load_state_dict(env.loop.state_dict())
    for action in actions[16:]:
        env.step(action)
    env.loop.selector.check()


def test_what_learns_from_a_rollout_is_refused_by_name():
    """VDS and PLR, alone or as a part, need the learner's transitions; with ``None`` their owner gives them."""
    assert {"vds", "plr", "plr-robust", "vds+p75"} <= set(TAUGHT)
    for name in TAUGHT:
        who = "plr" if "plr" in name else "vds"
        advice = "learns from the learner's transitions.* learn_every=None, got 24, .*docs/director.md"
        with pytest.raises(ValueError, match=rf"deimos\.goals\.selectors\.{who} {advice}"):
            directed(24, method(name))
        with pytest.raises(ValueError, match="rollout"):
            directed(None, method(name)).loop.learn()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_the_director_learns_in_gymnasium(mode):
    """It does by default, an update every 24 steps; not before, not by itself if told so, and a seed begins again."""
    options = {"seed": 0, "selector": DIRECTOR, "autoreset_mode": mode}
    ours, left = GymnasiumVectorEnv(CONFIG, 64, **options), GymnasiumVectorEnv(CONFIG, 64, **options, learn_every=None)
    for envs in (ours, left):
        envs.reset()
        for action in random_actions(23, 64):
            envs.step(action)
        assert not envs.loop.selector.fear.fitted
        envs.step(np.zeros((64, 3)))
    assert ours.loop.selector.fear.fitted
    assert not left.loop.selector.fear.fitted
    assert np.isfinite(left.loop.learn()["fear/loss"])
    for action in random_actions(10, 64):
        ours.step(action)
    resolved = ours.loop.interactions.resolved()
    assert resolved.score[resolved.issued > 24].isfinite().any()
    ours.reset(seed=1)
    assert not ours.loop.selector.fear.fitted


def test_gymnasium_refuses_it_too():
    """VDS would stay as it is, in one world as in many."""
    with pytest.raises(ValueError, match=r"selectors\.vds learns from the learner's transitions.* got 24"):
        GymnasiumVectorEnv(CONFIG, 4, selector=vds.Config())
    with pytest.raises(ValueError, match="learn_every must be at least 1, got 0"):
        GymnasiumEnv(CONFIG, learn_every=0)
    assert GymnasiumEnv(CONFIG, selector=vds.Config(), learn_every=None).worlds.loop.selector.needs_rollout
