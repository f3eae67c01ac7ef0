"""Interactions in Deimos' own loop: what is labelled when, on Particle Gym."""

import numpy as np
import pytest
import torch

from deimos.goals.selectors import uniform
from deimos.learn.rollout import Rollout
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.envs import particle


def build_loop(device, num_envs=2, **config):
    """A loop on Particle Gym with uniform goals; nobody moves unless acted upon."""
    env = particle.Config(**({"goal_period": 5} | config)).build(num_envs, device, seed=0)
    return GoalLoop(env, uniform.Config().build(spaces(env), seed=0))


def run(loop, steps, *, crash=()):
    """Take steps with no force; the listed worlds crash on the last of them."""
    env = loop.env
    for n in range(steps):
        if crash and n == steps - 1:
            env.tensors["position"][list(crash)] = 2 * particle.HALF_SIDE
        loop.advance(env.step(torch.zeros(env.num_envs, 3, device=env.device)))


def test_first_goals_are_no_interactions(torch_device):
    """A crash or a survival under a first goal is no interaction; only goals of the selector are."""
    loop = build_loop(torch_device)
    run(loop, 4, crash=[0])
    assert len(loop.interactions.resolved()) == 0
    run(loop, 1)  # world 1 survives its first goal and gets one of the selector's
    assert len(loop.interactions.resolved()) == 0
    assert loop.interactions.active.tolist() == [False, True]
    run(loop, 4)  # so does world 0, which has had a second first goal since its crash
    assert loop.interactions.active.tolist() == [True, True]
    assert len(loop.interactions.resolved()) == 0


def test_survivor_is_labelled_at_its_last_step_and_not_before(torch_device):
    """A world that lives is labelled as survived when its next goal falls due, after exactly T steps."""
    loop = build_loop(torch_device)
    run(loop, 5)
    for _ in range(4):
        run(loop, 1)
        assert len(loop.interactions.resolved()) == 0
        assert loop.interactions.active.all()
    run(loop, 1)
    resolved = loop.interactions.resolved()
    assert resolved.env.tolist() == [0, 1]
    assert resolved.crashed.tolist() == [False, False]
    assert resolved.issued.tolist() == [5, 5]
    assert resolved.resolved.tolist() == [10, 10]
    assert loop.interactions.active.all()  # of the next one


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_crash_within_the_period_is_labelled_at_once(torch_device, steps):
    """A crash on any of the T steps, the first and the last included, is labelled on that step."""
    loop = build_loop(torch_device)
    run(loop, 5)
    run(loop, steps, crash=[1])
    resolved = loop.interactions.resolved()
    resolved = resolved.where(resolved.crashed)
    assert resolved.env.tolist() == [1]
    assert resolved.issued.tolist() == [5]
    assert resolved.resolved.tolist() == [5 + steps]
    assert loop.interactions.active.tolist() == [True, False]


def test_crash_on_a_goal_change_is_charged_to_the_old_goal(torch_device):
    """A crash on the very step that the next goal is due on belongs to the goal that was active."""
    loop = build_loop(torch_device)
    run(loop, 5)
    old = loop.env.goal.clone()
    run(loop, 5, crash=[0])
    resolved = loop.interactions.resolved()
    assert resolved.env.tolist() == [0, 1]
    assert resolved.crashed.tolist() == [True, False]
    # As it was given and as it was seen: apart by a quotient and a product.
    torch.testing.assert_close(resolved.next_goal, old, rtol=3 * 2.0**-24, atol=0)
    assert loop.env.tensors["goal_count"].tolist() == [1, 2]  # nothing was chosen for the crashed world
    run(loop, 4)
    assert len(loop.interactions.resolved()) == 2  # and its first goal is charged with nothing


def test_truncated_interaction_is_dropped(torch_device):
    """A time limit before the T-th step leaves no label, then or later."""
    loop = build_loop(torch_device, time_limit=8)
    run(loop, 7)
    assert loop.interactions.active.all()
    run(loop, 1)
    assert not loop.interactions.active.any()
    for _ in range(40):
        run(loop, 1)
        assert len(loop.interactions.resolved()) == 0


def test_time_limit_on_the_last_step_keeps_the_label(torch_device):
    """An interaction whose T-th step is the time limit is a survival or a crash, never dropped."""
    loop = build_loop(torch_device, time_limit=10)
    run(loop, 10, crash=[1])
    resolved = loop.interactions.resolved()
    assert resolved.env.tolist() == [0, 1]
    assert resolved.crashed.tolist() == [False, True]
    assert resolved.issued.tolist() == [5, 5]
    assert not loop.interactions.active.any()  # what follows the limit is a first goal


def test_starting_anew_drops_what_is_pending(torch_device):
    """A loop that starts again begins an episode everywhere; what was pending is not charged to first goals."""
    loop = build_loop(torch_device)
    run(loop, 7)
    episodes = loop.env.tensors["episode_count"].clone()
    loop.start()
    assert not loop.interactions.active.any()
    assert torch.equal(loop.env.tensors["episode_count"], episodes + 1)
    run(loop, 5, crash=[0])
    assert len(loop.interactions.resolved()) == 0


def test_interaction_straddles_rollouts(torch_device):
    """Rollouts shorter than T cut nothing: an interaction continues over as many of them as it takes."""
    loop = build_loop(torch_device, goal_period=10)
    env, rollout = loop.env, Rollout(4, 2, loop.env.obs_dim, 3, torch_device)
    found = []
    for _ in range(7):
        for t in range(rollout.num_steps):
            step = env.step(torch.zeros(2, 3, device=torch_device))
            changes = loop.resolve(step)
            rollout.record(
                t, obs=step.obs, reward=step.reward, terminated=step.terminated, truncated=step.truncated,
                invalid=step.invalid, weight=loop.weight, cut_off=changes.cut_off,
            )  # fmt: skip
            loop.renew(step, changes)
        loop.selector.learn(loop.interactions, rollout)
        found.append(loop.interactions.resolved())
    assert [len(resolved) for resolved in found] == [0, 0, 0, 0, 2, 2, 2]
    assert found[-1].issued.tolist() == [10, 10]
    assert found[-1].resolved.tolist() == [20, 20]


@pytest.mark.parametrize("variant", ["absolute", "directional", "relative"])
def test_loop_stores_the_moment_of_the_choice(torch_device, variant):
    """State and old goal are those seen just before the choice, the next goal is the one seen just after it."""
    loop = build_loop(torch_device, num_envs=8, variant=variant, spawn_range=500.0)
    env = loop.env
    force = torch.tensor(np.random.default_rng(0).uniform(-1, 1, (8, 3)), dtype=torch.float32, device=torch_device)
    for _ in range(4):
        loop.advance(env.step(force))
    step = env.step(force)
    state, goal, position = env.state(step.obs).clone(), env.goal.clone(), env.tensors["position"].clone()
    loop.advance(step)
    issued = env.goal.clone()
    for _ in range(4):
        loop.advance(env.step(force))
    gone = (env.tensors["position"] - position) / particle.HALF_SIDE
    drifted = env.goal.clone()
    loop.advance(env.step(force))

    resolved = loop.interactions.resolved()
    assert resolved.env.tolist() == list(range(8))
    assert torch.equal(resolved.state, state)
    assert torch.equal(resolved.goal, goal)
    # As it was given and as it was seen: apart by a quotient, a sum, a difference and a product below 2.3.
    tolerance = 4 * 2.3 * 2.0**-24
    torch.testing.assert_close(resolved.next_goal, issued, rtol=0, atol=tolerance)
    if variant == "relative":
        torch.testing.assert_close(resolved.next_goal, drifted + gone, rtol=0, atol=2 * tolerance)
        assert bool((gone.abs().amax(dim=1) > 1e-3).all())
