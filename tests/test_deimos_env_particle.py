"""What an environment promises, shown on Particle Gym; its state and its faults have files of their own."""

import math
from dataclasses import replace

import pytest
import torch
from particle_worlds import VARIANTS, U, build, constant_actions
from worlds import build_loop, mask_of, rows_of, step_tensors

from deimos.learn.policy import Policy, load_policy, save_policy
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs.particle import Config


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


@pytest.mark.parametrize("variant", VARIANTS)
def test_reset_starts_an_episode(torch_device, variant):
    """A reset world stands still inside its spawn box, with a goal within range and clocks at 0."""
    env = build(torch_device, num_envs=256, variant=variant, spawn_range=200.0)
    for _ in range(5):
        env.step(constant_actions(256, torch_device))
    env.reset(mask_of(env))
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
    env.reset(mask_of(env), scale)
    largest = (env.tensors["goal"] / env.config.goal_half_side).abs().amax(dim=0)
    assert bool((largest <= scale).all())
    assert bool((largest > 0.95 * scale).all())  # 0.95^512 is 4e-12
    env.reset(mask_of(env))
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
        env.reset(mask_of(env), 0.5 * weight)
    assert not env.action.tensor.requires_grad
    views = [*env.tensors.values(), *step_tensors(step).values(), *env._views.values()]
    assert not any(view.requires_grad for view in views)
    assert not env.sample_goals(rows_of(env), 2).requires_grad


def test_each_network_sees_what_it_is_shown(torch_device, monkeypatch, tmp_path):
    """A field for one network moves the outputs of that one alone, in training and in the stored policy."""
    build_env = Config.build

    def build_private(self, *arguments):
        env = build_env(self, *arguments)
        velocity, position, *others = env.layout
        env.layout = (replace(velocity, seen_by="critic"), replace(position, seen_by="actor"), *others)
        return env

    monkeypatch.setattr(Config, "build", build_private)
    config = TrainConfig(env=Config(goal_period=5), ppo=PPOConfig(hidden=(8,)), num_envs=64, evaluation=False)
    trainer = Trainer(config, torch_device)
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
