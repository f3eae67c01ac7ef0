"""What an environment promises, shown on Particle Gym."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from deimos.kernels.episodes import RESUMED
from deimos.kernels.particle import PARTICLES

from deimos.checks import RunError, SimulationError
from deimos.goals.selectors import uniform
from deimos.learn.policy import Policy, load_policy, save_policy
from deimos.learn.ppo import PPOConfig
from deimos.run.loop import GoalLoop, spaces
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.env import Step
from deimos.sim.envs.particle import HALF_SIDE, Config

STEP_FIELDS = [name for name in Step.__dataclass_fields__ if name != "tracking"]  # the reward says it
VARIANTS = ["absolute", "directional", "relative"]
U = 2.0**-24  # relative error of one float32 operation


def build(device, num_envs=8, seed=0, env_offset=0, **config):
    """An environment with short goals unless told otherwise."""
    return Config(**({"goal_period": 5} | config)).build(num_envs, device, seed, env_offset)


def build_loop(env, candidates=4):
    """A loop with uniform goals, each picked from a few candidates."""
    return GoalLoop(env, uniform.Config(candidates=candidates).build(spaces(env), seed=0))


def constant_actions(num_envs, device, seed=0):
    """A force of its own for every world: some crash early, some late."""
    force = np.random.default_rng(seed).uniform(-1, 1, size=(num_envs, 3))
    return torch.tensor(force, dtype=torch.float32, device=device)


def tensors_of(env, step):
    """Copies of all that a resume needs and of all that a step gave back."""
    return env.state_dict() | {name: getattr(step, name).clone() for name in STEP_FIELDS}


def assert_equal(found, expected):
    """Two dictionaries of tensors are the same in every value, NaN included."""
    assert found.keys() == expected.keys()
    for name in expected:
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=0, equal_nan=True, msg=name)


def assert_same_state(env, other, rows=slice(None), other_rows=slice(None)):
    """Everything that a resume needs is the same in two environments, bit for bit."""
    ours = {name: tensor[rows] for name, tensor in env.tensors.items()}
    assert_equal(ours, {name: tensor[other_rows] for name, tensor in other.tensors.items()})


def ones(env):
    """A mask of all worlds."""
    return torch.ones(env.num_envs, dtype=torch.bool, device=env.device)


def rows_of(env, *rows):
    """Rows as an environment takes them; all of them if none is given."""
    return torch.tensor(rows or range(env.num_envs), dtype=torch.int64, device=env.device)


def put_outside(env, rows):
    """Make the listed worlds crash on the next step."""
    env.tensors["position"][rows] = 2 * HALF_SIDE


def test_warp_and_torch_see_one_allocation(torch_device):
    """Every tensor of state and step lies at the address of its Warp array, and keeps it over steps and goals."""
    env = build(torch_device, variant="relative", time_limit=7)
    step = env.step(constant_actions(8, torch_device))
    loop = build_loop(env)
    for _ in range(10):
        loop.advance(env.step(constant_actions(8, torch_device)))
    assert env.tensors.keys() == {*RESUMED, *PARTICLES.names}
    for name in RESUMED:
        assert env.tensors[name].data_ptr() == getattr(env.worlds, name).ptr, name
    for name in STEP_FIELDS:
        assert getattr(step, name).data_ptr() == getattr(env.worlds, name).ptr, name


def test_views_are_made_once(torch_device):
    """After ten steps, with goals and resets between them, a step still gives back the very same views."""
    env = build(torch_device, time_limit=4, goal_period=3)
    loop = build_loop(env)
    action = constant_actions(8, torch_device)
    first = env.step(action)
    views = [getattr(first, name) for name in STEP_FIELDS] + list(env.tensors.values())
    addresses = [view.data_ptr() for view in views]
    for _ in range(10):
        loop.advance(env.step(action))
    last = env.step(action)
    again = [getattr(last, name) for name in STEP_FIELDS] + list(env.tensors.values())
    assert last is first
    assert all(a is b for a, b in zip(views, again, strict=True))
    assert addresses == [view.data_ptr() for view in again]
    assert last.obs is env.obs


def test_goal_and_state_split_the_observation(torch_device):
    """The goal is a view of its slot, the state is all the rest, and the layout names both with their scales."""
    env = build(torch_device, max_speed=4.0, max_force=0.5)
    env.step(constant_actions(8, torch_device))
    assert [(f.name, f.size) for f in env.layout] == [("velocity", 3), ("position", 3), ("last_action", 3), ("goal", 3)]
    assert (env.obs_dim, env.state_dim, env.goal_dim, env.action_dim) == (12, 9, 3, 3)
    assert env.goal_slice == slice(9, 12)
    assert env.goal.data_ptr() == env.obs[:, 9:].data_ptr()
    assert torch.equal(torch.cat([env.state(env.obs), env.goal], dim=1), env.obs)
    start = 0
    for field, name in zip(env.layout, ("velocity", "position", "force", "goal"), strict=True):
        seen = env.obs[:, start : start + field.size]
        torch.testing.assert_close(seen, env.tensors[name] * field.scale, rtol=4 * U, atol=0)
        start += field.size


@pytest.mark.parametrize("variant", VARIANTS)
def test_raw_scale_shows_the_physical_values(torch_device, variant):
    """With obs_scale raw all scales are 1 and the observation is the state itself."""
    env = build(torch_device, variant=variant, obs_scale="raw", spawn_range=100.0)
    for _ in range(3):
        env.step(constant_actions(8, torch_device))
    state = env.tensors
    goal = state["goal"] - state["position"] if variant == "relative" else state["goal"]
    assert [field.scale for field in env.layout] == [1.0] * 4
    assert torch.equal(env.obs, torch.cat([state["velocity"], state["position"], state["force"], goal], dim=1))


@pytest.mark.parametrize("variant", VARIANTS)
def test_step_never_resets_and_never_changes_a_goal(torch_device, variant):
    """Through crashes, time limits and goals overdue the particles fly on, under the same goals."""
    env = build(torch_device, variant=variant, time_limit=20)
    target, episodes = env.tensors["goal"].clone(), env.tensors["episode_count"].clone()
    seen = torch.zeros(3, dtype=torch.int64, device=torch_device)
    for n in range(1, 301):
        before = env.tensors["position"].clone()
        step = env.step(constant_actions(8, torch_device))
        assert torch.equal(env.tensors["goal"], target)
        assert bool((env.tensors["episode_step"] == n).all())
        assert bool((env.tensors["goal_clock"] == n).all())
        assert torch.equal(env.tensors["episode_count"], episodes)
        assert bool((env.tensors["goal_count"] == 0).all())
        assert torch.equal(env.tensors["position"], before + env.tensors["velocity"])
        seen += torch.stack([step.terminated.any(), step.truncated.any(), step.goal_due.all()])
    assert (seen > 0).all()


def test_observation_is_that_of_the_step_with_the_old_goal(torch_device):
    """On the step of a goal change the reward and the observation still know the old goal only."""
    env = build(torch_device)
    loop = build_loop(env)
    for _ in range(20):
        target = env.tensors["goal"].clone()
        step = env.step(constant_actions(8, torch_device))
        distance = (env.tensors["velocity"] - target).double().norm(dim=1)
        expected = 1 - distance / (1.01 * 20 * math.sqrt(3))
        torch.testing.assert_close(step.reward.double(), expected, rtol=0, atol=9 * U)
        torch.testing.assert_close(step.obs[:, 9:], target / 10, rtol=4 * U, atol=0)
        loop.advance(step)


def test_reset_leaves_other_worlds_bit_identical(torch_device):
    """Resetting world 0 changes it alone, at once and in all that follows, goals included."""
    env, twin = (build(torch_device, spawn_range=50.0) for _ in range(2))
    loop, twin_loop = build_loop(env), build_loop(twin)
    action = constant_actions(8, torch_device)
    for _ in range(7):
        loop.advance(env.step(action))
        twin_loop.advance(twin.step(action))
    mask = ~ones(env)
    mask[0] = True

    env.reset(mask)

    assert not torch.equal(env.tensors["position"][0], twin.tensors["position"][0])
    assert env.tensors["episode_count"][0] == twin.tensors["episode_count"][0] + 1
    for _ in range(50):
        assert_same_state(env, twin, slice(1, None), slice(1, None))
        loop.advance(env.step(action))
        twin_loop.advance(twin.step(action))


@pytest.mark.parametrize("variant", VARIANTS)
def test_reset_starts_an_episode(torch_device, variant):
    """A reset world stands still inside its spawn box, with a goal within range and clocks at 0."""
    env = build(torch_device, num_envs=256, variant=variant, spawn_range=200.0)
    for _ in range(5):
        env.step(constant_actions(256, torch_device))
    env.reset(ones(env))
    for name in ("velocity", "force", "goal_clock", "episode_step"):
        assert not env.tensors[name].any()
    assert 0 < env.tensors["position"].abs().max() <= 200
    assert env.tensors["goal"].abs().max() <= env.config.goal_half_side
    assert torch.equal(env.obs[:, :3], env.tensors["velocity"])


@pytest.mark.parametrize("variant", VARIANTS)
def test_goal_scale_shrinks_first_goals(torch_device, variant):
    """First goals fill the share of the range that is asked for, along every axis, and no more."""
    env = build(torch_device, num_envs=512, variant=variant)
    scale = torch.tensor([1.0, 0.5, 0.125], device=torch_device)
    env.reset(ones(env), scale)
    largest = (env.tensors["goal"] / env.config.goal_half_side).abs().amax(dim=0)
    assert bool((largest <= scale).all())
    assert bool((largest > 0.95 * scale).all())  # 0.95^512 is 4e-12
    env.reset(ones(env))
    assert bool((env.tensors["goal"].abs().amax(dim=0) > 0.95 * env.config.goal_half_side).all())


@pytest.mark.parametrize("variant", VARIANTS)
def test_sampled_goals_are_within_range(torch_device, variant):
    """Candidates fill the box of valid goals, whole or scaled, wherever the particles are."""
    env = build(torch_device, num_envs=128, variant=variant, spawn_range=900.0)
    unit = 10.0 if variant == "directional" else 1000.0
    for scale in (None, torch.tensor([0.25, 1.0, 0.5], device=torch_device)):
        goals = env.sample_goals(rows_of(env), 10, scale)
        assert goals.shape == (128, 10, 3)
        place = goals.double() * unit
        if variant == "relative":
            place += env.tensors["position"].double().unsqueeze(1)
        largest = place.abs().amax(dim=(0, 1)) / env.config.goal_half_side
        bound = torch.ones(3, device=torch_device) if scale is None else scale
        # In Relative a place is rounded with its way; both are below 2300 u, four roundings in all.
        slack = 4 * U * 2300 / env.config.goal_half_side if variant == "relative" else 2 * U
        assert bool((largest <= bound + slack).all())
        assert bool((largest > 0.95 * bound).all())


@pytest.mark.parametrize("variant", VARIANTS)
def test_set_goals_gives_back_what_was_sampled(torch_device, variant):
    """A sampled goal that is set is then seen as it was sampled, and its place is within range."""
    env = build(torch_device, num_envs=64, variant=variant, spawn_range=900.0)
    rows = rows_of(env, 5, 60, 13)
    wanted = env.sample_goals(rows, 4)[:, 2].clone()
    before = env.obs.clone()
    clock = env.tensors["goal_clock"].clone()
    env.step(torch.zeros(64, 3, device=torch_device))  # nobody moves, but the clocks do

    env.set_goals(rows, wanted)

    # Quotient, sum, difference and product: the sum and the difference with a place below 2.3 units.
    torch.testing.assert_close(env.goal[rows], wanted, rtol=3 * U, atol=2 * 2.3 * U)
    others = torch.tensor([i for i in range(64) if i not in (5, 60, 13)], device=torch_device)
    assert torch.equal(env.obs[others], before[others])
    assert torch.equal(env.tensors["goal_clock"][others], clock[others] + 1)
    assert env.tensors["goal_clock"][rows].tolist() == [0, 0, 0]
    assert env.tensors["goal_count"].sum() == 3
    assert env.tensors["goal"].abs().max() <= env.config.goal_half_side * (1 + 8 * U)


def test_relative_goal_drifts_as_the_particle_moves(torch_device):
    """In Relative the goal shrinks by just the way that the particle has gone."""
    env = build(torch_device, variant="relative")
    rows = rows_of(env)
    issued = env.sample_goals(rows, 1)[:, 0].clone()
    env.set_goals(rows, issued)
    for _ in range(30):
        env.step(constant_actions(8, torch_device))
    gone = env.tensors["position"].double() / 1000
    assert bool((gone.abs().amax(dim=1) > 0.01).all())
    torch.testing.assert_close(env.goal.double(), issued.double() - gone, rtol=0, atol=8 * 2.3 * U)


@pytest.mark.parametrize("variant", VARIANTS)
def test_candidates_are_independent_of_who_else_asks(torch_device, variant):
    """A world is offered the same goals and draws alone, in any order, and again before a goal is set."""
    env = build(torch_device, variant=variant, spawn_range=100.0)
    rows = rows_of(env)
    goals, draws = env.sample_goals(rows, 6).clone(), env.draw(rows).clone()
    few = rows_of(env, 6, 1)
    assert torch.equal(env.sample_goals(few, 6), goals[[6, 1]])
    assert torch.equal(env.sample_goals(few, 2), goals[[6, 1], :2])
    assert torch.equal(env.draw(few), draws[[6, 1]])

    env.set_goals(few, goals[[6, 1], 0])

    again, redraws = env.sample_goals(rows, 6), env.draw(rows)
    others = [0, 2, 3, 4, 5, 7]
    assert torch.equal(again[others], goals[others])
    assert torch.equal(redraws[others], draws[others])
    assert not (again[[6, 1]] == goals[[6, 1]]).any()
    assert not (redraws[[6, 1]] == draws[[6, 1]]).any()


def test_clones_move_alike(torch_device):
    """Cloned worlds are equal in every bit, and stay so for as long as they get the same actions."""
    env = build(torch_device, spawn_range=100.0, time_limit=40)
    for _ in range(3):
        env.step(constant_actions(8, torch_device))
    source, target = rows_of(env, 0, 3), rows_of(env, 6, 1)
    before = env.state_dict()

    env.copy_worlds(source, target)

    others = [0, 2, 3, 4, 5, 7]
    assert_equal({k: v[others] for k, v in env.tensors.items()}, {k: v[others] for k, v in before.items()})
    assert_equal({k: v[target] for k, v in env.tensors.items()}, {k: v[source] for k, v in before.items()})
    action = constant_actions(8, torch_device)
    action[target] = action[source]
    for _ in range(50):
        step = env.step(action)
        assert_same_state(env, env, source, target)
        for name in ("obs", "reward", "terminated", "truncated", "goal_due", "invalid"):
            assert torch.equal(getattr(step, name)[source], getattr(step, name)[target])


def test_clones_of_another_environment(torch_device):
    """Worlds can be cloned out of another environment, and then move as they would have there."""
    origin, env = build(torch_device, num_envs=4, seed=1), build(torch_device, num_envs=10, seed=2)
    action = constant_actions(4, torch_device)
    for _ in range(7):
        origin.step(action)
    source, target = rows_of(origin, 3, 0), rows_of(env, 8, 9)
    env.copy_worlds(source, target, origin)
    everyone = constant_actions(10, torch_device, seed=1)
    everyone[target] = action[source]
    for _ in range(20):
        assert_same_state(env, origin, target, source)
        env.step(everyone)
        origin.step(action)


@pytest.mark.parametrize("variant", VARIANTS)
def test_resume_is_exact(torch_device, variant):
    """A run that continues from its state dictionary in a new environment equals one that was never stopped."""
    config = {"variant": variant, "spawn_range": 20.0, "time_limit": 90, "stagger_goals": True}
    env = build(torch_device, **config)
    loop = build_loop(env)
    action = constant_actions(8, torch_device)
    for _ in range(63):
        loop.advance(env.step(action))
    saved = loop.state_dict()
    expected = []
    for _ in range(100):
        step = env.step(action)
        loop.advance(step)
        expected.append(tensors_of(env, step))

    resumed_env = build(torch_device, **config)
    resumed = build_loop(resumed_env)
    resumed.load_state_dict(saved)
    for want in expected:
        step = resumed_env.step(action)
        resumed.advance(step)
        assert_equal(tensors_of(resumed_env, step), want)
    assert_equal(vars(resumed.interactions.resolved()), vars(loop.interactions.resolved()))
    assert bool((env.tensors["episode_count"] > saved["env"]["episode_count"]).any())
    assert bool((env.tensors["goal_count"] > saved["env"]["goal_count"] + 10).all())


def test_state_dict_is_a_copy(torch_device):
    """Steps after a state dictionary was taken do not reach into it."""
    env = build(torch_device)
    saved = env.state_dict()
    kept = {name: tensor.clone() for name, tensor in saved.items()}
    env.step(constant_actions(8, torch_device))
    assert_equal(saved, kept)
    assert not torch.equal(env.tensors["position"], saved["position"])


def test_state_of_another_size_is_refused(torch_device):
    """A state dictionary of other worlds, or without a part, is refused, and nothing is loaded."""
    env, other = build(torch_device, num_envs=8), build(torch_device, num_envs=7)
    before = env.state_dict()
    partial = {name: tensor for name, tensor in env.state_dict().items() if name != "force"}
    for wrong in (other.state_dict(), partial):
        with pytest.raises(ValueError, match=r"state must hold .*\(8, 3\).*got .*another environment"):
            env.load_state_dict(wrong)
    assert_equal(env.state_dict(), before)


@pytest.mark.parametrize("variant", VARIANTS)
def test_policies_that_crash_at_different_times_meet_the_same_goals(torch_device, variant):
    """The i-th goal and the i-th first goal of a world are the same, whenever its policy crashes."""
    histories = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        env = build(torch_device, variant=variant, seed=7)
        loop = build_loop(env)
        chosen = {(w, "first", int(env.tensors["episode_count"][w])): env.tensors["goal"][w].clone() for w in range(8)}
        steps = []
        for n in range(200):
            put_outside(env, rows_of(env)[torch.tensor(rng.random(8) < 0.03, device=torch_device)])
            goals, episodes = env.tensors["goal_count"].clone(), env.tensors["episode_count"].clone()
            loop.advance(env.step(torch.zeros(8, 3, device=torch_device)))
            for w in torch.nonzero(env.tensors["goal_count"] > goals).flatten().tolist():
                chosen[w, "selected", int(goals[w])] = env.tensors["goal"][w].clone()
            for w in torch.nonzero(env.tensors["episode_count"] > episodes).flatten().tolist():
                chosen[w, "first", int(episodes[w]) + 1] = env.tensors["goal"][w].clone()
                steps.append((w, n))
        histories.append((chosen, steps))
    (goals, crashes), (other_goals, other_crashes) = histories
    assert crashes != other_crashes
    common = goals.keys() & other_goals.keys()
    for kind, least in (("selected", 20), ("first", 2)):
        for w in range(8):
            assert sum(key[0] == w and key[1] == kind for key in common) >= least
    # In Relative a place is sampled from where the particle is: a few roundings of at most 2300 u.
    tolerance = 8 * U * 2300 if variant == "relative" else 0.0
    for key in common:
        torch.testing.assert_close(goals[key], other_goals[key], rtol=0, atol=tolerance)


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_shards_equal_the_whole(torch_device, variant):
    """Two environments of 8 worlds, the second with an offset of 8, do what one of 16 does, bit for bit."""
    config = {"variant": variant, "spawn_range": 30.0, "time_limit": 150, "stagger_goals": True}
    whole = build(torch_device, num_envs=16, **config)
    shards = [build(torch_device, num_envs=8, env_offset=offset, **config) for offset in (0, 8)]
    loop, shard_loops = build_loop(whole), [build_loop(shard) for shard in shards]
    action, episodes = constant_actions(16, torch_device), whole.tensors["episode_count"].clone()
    for _ in range(300):
        loop.advance(whole.step(action))
        for i, shard in enumerate(shards):
            shard_loops[i].advance(shard.step(action[8 * i : 8 * i + 8]))
    for name, tensor in whole.tensors.items():
        assert torch.equal(tensor, torch.cat([shard.tensors[name] for shard in shards])), name
    resolved = [shard_loop.interactions.resolved() for shard_loop in shard_loops]
    assert torch.equal(
        loop.interactions.resolved().next_goal, torch.cat([interactions.next_goal for interactions in resolved])
    )
    assert bool((whole.tensors["episode_count"] > episodes + 1).all())


def test_another_seed_is_another_world(torch_device):
    """Another seed changes starts, first goals, candidates and draws in every world."""
    one, other = (build(torch_device, seed=seed, spawn_range=10.0) for seed in (0, 1))
    rows = rows_of(one)
    for a, b in (
        (one.tensors["position"], other.tensors["position"]),
        (one.tensors["goal"], other.tensors["goal"]),
        (one.sample_goals(rows, 3), other.sample_goals(rows, 3)),
        (one.draw(rows), other.draw(rows)),
    ):
        assert not (a == b).any()


def test_staggered_clocks_spread_over_the_period(torch_device):
    """Goal clocks begin spread evenly over [0, T), so that from then on goals fall due evenly."""
    n, period = 10000, 20
    env = build(torch_device, num_envs=n, goal_period=period, stagger_goals=True)
    loop = build_loop(env)
    counts = torch.bincount(env.tensors["goal_clock"].long(), minlength=period)
    share = 1 / period
    assert len(counts) == period
    # Five standard deviations of a binomial count, each exceeded once in 1.7 million.
    assert (counts - n * share).abs().max() < 5 * math.sqrt(n * share * (1 - share))

    due = []
    for _ in range(2 * period):
        step = env.step(torch.zeros(n, 3, device=torch_device))
        due.append(int(step.goal_due.sum()))
        loop.advance(step)
    assert due[:period] == due[period:]
    assert max(due) < n * share + 5 * math.sqrt(n * share * (1 - share))


def test_clocks_are_in_step_unless_staggered(torch_device):
    """By default, and in every evaluation, all first goals fall due on the same step."""
    for config in (Config(), Config(stagger_goals=True).for_evaluation()):
        env = config.build(100, torch_device, 0)
        build_loop(env)
        assert not env.tensors["goal_clock"].any()


def test_evaluation_keeps_the_task(torch_device):
    """For evaluation nothing but the stagger is switched off."""
    config = Config(stagger_goals=True, variant="relative", max_speed=3.0, time_limit=50)
    assert config.for_evaluation() == replace(config, stagger_goals=False)


@pytest.mark.parametrize("variant", VARIANTS)
def test_reference_policy_follows_and_never_crashes(torch_device, variant):
    """The braking follower survives all uniform goals and is well paid; the blind one leaves the cube."""
    crashes, reward = {}, {}
    for brake in (True, False):
        env = build(torch_device, num_envs=64, variant=variant, goal_period=100, seed=3)
        loop = build_loop(env, candidates=1)
        act = env.reference_policy(brake=brake)
        crashes[brake], reward[brake] = 0, 0.0
        for _ in range(400):
            step = env.step(act(env.obs))
            crashes[brake] += int(step.terminated.sum())
            reward[brake] += float(step.reward.mean()) / 400
            loop.advance(step)
    idle = build(torch_device, num_envs=64, variant=variant, goal_period=100, seed=3)
    loop = build_loop(idle, candidates=1)
    idle_reward = 0.0
    for _ in range(400):
        step = idle.step(torch.zeros(64, 3, device=torch_device))
        idle_reward += float(step.reward.mean()) / 400
        loop.advance(step)
    assert crashes[True] == 0
    assert crashes[False] > 0
    assert reward[True] > idle_reward


def test_reference_policy_brakes_at_any_force_and_speed(torch_device):
    """The braking follower survives weak, strong and unbounded forces, and starts near the wall."""
    for max_force, max_speed in ((0.25, 20.0), (5.0, 10.0), (math.inf, 10.0)):
        env = build(
            torch_device, num_envs=64, goal_period=50, max_force=max_force, max_speed=max_speed, spawn_range=990.0
        )
        loop, act = build_loop(env, candidates=1), env.reference_policy()
        for _ in range(200):
            step = env.step(act(env.obs))
            assert not step.terminated.any(), (max_force, max_speed)
            loop.advance(step)


@pytest.mark.parametrize("shape", [(8,), (8, 2), (7, 3), (1, 3)])
def test_actions_of_another_shape_are_refused(torch_device, shape):
    """Actions are never broadcast: another shape is refused with both shapes, and nothing moves."""
    env = build(torch_device)
    before = env.state_dict()
    with pytest.raises(ValueError, match=rf"action must have the shape \(8, 3\), got {re.escape(str(shape))}"):
        env.step(torch.zeros(shape, device=torch_device))
    assert_equal(env.state_dict(), before)


def test_sound_worlds_pass_the_check(torch_device):
    """Crashes, bounds and time limits are no faults."""
    env = build(torch_device, time_limit=30)
    for _ in range(150):
        env.step(10 * constant_actions(8, torch_device))
    env.check()


def test_check_names_world_and_action(torch_device):
    """A NaN action stops the run with the world and the quantity."""
    env = build(torch_device)
    action = constant_actions(8, torch_device)
    action[5, 1] = torch.nan
    env.step(action)
    with pytest.raises(SimulationError, match=r"World 5: its action is not finite\."):
        env.check()


def test_check_still_names_the_action_after_sound_ones(torch_device):
    """A NaN action is found out at the end of the rollout, and a position that is finite is not blamed for it."""
    env = build(torch_device)
    action = constant_actions(8, torch_device)
    action[5, 1] = torch.nan
    env.step(action)
    for _ in range(3):
        env.step(constant_actions(8, torch_device))
    with pytest.raises(SimulationError, match="World 5: its action"):
        env.check()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_check_names_world_and_position(torch_device, value):
    """A position that is not finite stops the run with the lowest world that it happened in, however late."""
    env = build(torch_device)
    env.tensors["position"][2, 0] = value
    env.tensors["position"][4, 2] = value
    for _ in range(3):
        env.step(constant_actions(8, torch_device))
    with pytest.raises(SimulationError, match="World 2: its position is not finite; 6 of the last 24 world-steps"):
        env.check()


@pytest.mark.parametrize("name", ["velocity", "goal"])
def test_check_finds_any_broken_state(torch_device, name):
    """A velocity or a goal that is not finite stops the run too, as every state must be finite."""
    env = build(torch_device)
    env.tensors[name][3, 1] = torch.nan
    env.step(constant_actions(8, torch_device))
    with pytest.raises(SimulationError, match=f"World 3: its {name} is not finite"):
        env.check()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("variant", "sideways", "variant must be one of absolute, directional, relative, got 'sideways'"),
        ("reward", "cubic", "reward must be one of linear, reciprocal, exponential, got 'cubic'"),
        ("obs_scale", "big", "obs_scale must be one of unit, raw, got 'big'"),
        ("goal_period", 0, "goal_period must be at least 1, got 0"),
        ("goal_period", 2.5, "goal_period must be a whole number, got 2.5"),
        ("time_limit", -1, "time_limit must be at least 0, got -1"),
        ("max_speed", math.nan, "max_speed must be finite and positive, got nan"),
        ("max_speed", math.inf, "max_speed must be finite and positive, got inf"),
        ("max_speed", 0.0, "max_speed must be finite and positive, got 0.0"),
        ("max_force", math.nan, "max_force must be positive, got nan"),
        ("max_force", -1.0, "max_force must be positive, got -1.0"),
        ("goal_range", 0.0, "goal_range must be finite and positive, got 0.0"),
        ("goal_range", math.inf, "goal_range must be finite and positive, got inf"),
        ("reward_length", 0.0, "reward_length must be finite and positive, got 0.0"),
        ("spawn_range", 1000.0, r"spawn_range must be in \[0, 1000\), got 1000.0"),
        ("spawn_range", -1.0, r"spawn_range must be in \[0, 1000\), got -1.0"),
        ("spawn_range", math.nan, r"spawn_range must be in \[0, 1000\), got nan"),
    ],
)
def test_config_rejects_bad_values(field, value, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        Config(**{field: value})


def test_config_accepts_its_edges():
    """The ends of every range are allowed."""
    Config(goal_period=1, time_limit=0, max_force=math.inf, spawn_range=0.0, goal_range=1e-3)
    Config(spawn_range=999.9, max_speed=1e-3, max_force=1e-3, reward_length=1e-3)


def test_no_gradient_is_kept(torch_device):
    """Actions, goals and ranges that want gradients are stored without: no graph grows in somebody else's loop."""
    env = build(torch_device)
    weight = torch.ones(3, device=torch_device, requires_grad=True)
    for _ in range(3):
        step = env.step(0.5 * weight.expand(8, 3))
        env.set_goals(rows_of(env), env.sample_goals(rows_of(env), 1, 0.5 * weight)[:, 0] * weight)
        env.reset(ones(env), 0.5 * weight)
    assert not env.action.tensor.requires_grad
    views = [*env.tensors.values(), *(getattr(step, name) for name in STEP_FIELDS), *env._views.values()]
    assert not any(view.requires_grad for view in views)
    assert not env.sample_goals(rows_of(env), 2).requires_grad


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_crash_costs_what_the_penalty_says(torch_device, variant):
    """The penalty is subtracted on the step of a crash alone; without it, and in evaluation, nothing is."""
    config = {"variant": variant, "time_limit": 9}
    plain, punished = build(torch_device, **config), build(torch_device, crash_penalty=2.5, **config)
    assert (plain.crash_penalty, punished.crash_penalty) == (0.0, 2.5)
    for t in range(8):
        for env in (plain, punished):
            if t == 3:
                put_outside(env, rows_of(env, 1, 6))
            step = env.step(constant_actions(8, torch_device))
        expected = plain._step.reward - 2.5 * plain._step.terminated
        assert torch.equal(step.reward, expected)
        assert bool(step.terminated.any()) == (t >= 3)
    assert bool((step.reward < 0).any())
    assert Config(crash_penalty=2.5).for_evaluation() == Config()


@pytest.mark.parametrize("value", [-0.1, math.inf, math.nan])
def test_a_penalty_that_is_none_is_refused(value):
    """A penalty must be finite and at least 0, in every environment's configuration."""
    with pytest.raises(ValueError, match=r"crash_penalty must be in \[0, .*\], got"):
        Config(crash_penalty=value)


def train_config(**env):
    """A few worlds close to the walls, so that some crash at once."""
    env = Config(goal_period=5, spawn_range=999.0, **env)
    return TrainConfig(env=env, ppo=PPOConfig(hidden=(8,)), num_envs=64, evaluation=False)


def test_the_learner_sees_the_penalty_and_reports_do_not(torch_device):
    """What is learnt from holds the penalty of every crash; the reported reward is that of a run without it."""
    plain, punished = (Trainer(train_config(crash_penalty=cost), torch_device) for cost in (0.0, 3.0))
    expected, row = plain.iterate(), punished.iterate()
    assert row["crashes"] == expected["crashes"] > 0
    assert row["reward"] == pytest.approx(expected["reward"], abs=64 * U)
    learnt, crashed = punished.rollout.reward, plain.rollout.terminated
    assert torch.equal(learnt, plain.rollout.reward - 3.0 * crashed)
    assert bool((learnt < 0).any())


def test_checkpoints_of_before_the_penalty_load(torch_device):
    """A checkpoint that lacks a newer field of the configuration was made with its default."""
    trainer = Trainer(train_config(), torch_device)
    state = trainer.state_dict()
    del state["made_for"]["env"]["crash_penalty"]
    trainer.load_state_dict(state)
    state["made_for"]["env"]["max_speed"] = 3.0
    with pytest.raises(RunError, match="another environment"):
        trainer.load_state_dict(state)


def test_each_network_sees_what_it_is_shown(torch_device, monkeypatch, tmp_path):
    """A field for one network moves the outputs of that one alone, in training and in the stored policy."""
    build_env = Config.build

    def build_private(self, *arguments):
        env = build_env(self, *arguments)
        velocity, position, *others = env.layout
        env.layout = (replace(velocity, seen_by="critic"), replace(position, seen_by="actor"), *others)
        return env

    monkeypatch.setattr(Config, "build", build_private)
    trainer = Trainer(train_config(), torch_device)
    trainer.iterate()
    policy = Policy(trainer.ppo.actor, trainer.config.ppo.hidden, "relu", trainer.env.layout, 1.0, 1.0)
    save_policy(tmp_path / "policy.pt", policy)
    stored = load_policy(tmp_path / "policy.pt", str(torch_device))
    obs = torch.rand(5, 12, device=torch_device)
    for seen, hidden, network in (
        (slice(3, 6), slice(0, 3), stored.scaled), (slice(0, 3), slice(3, 6), trainer.ppo.value),
    ):  # fmt: skip
        before = network(obs).clone()
        changed = obs.clone()
        changed[:, hidden] += 1.0
        assert torch.equal(network(changed), before)
        changed[:, seen] += 1.0
        assert not torch.equal(network(changed), before)
    assert torch.equal(stored.scaled(obs), policy.scaled(obs))
