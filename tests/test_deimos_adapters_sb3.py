"""Environments and the Director in Stable-Baselines3's training loops."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

import deimos.adapters.gymnasium  # noqa: F401 - it registers the environments
from deimos.adapters.stable_baselines3 import DirectedVecEnv
from deimos.goals.director import GoalDirector

PERIOD, LIMIT = 4, 10
BOX = np.array([-2.0]), np.array([3.0])


class Counter(gymnasium.Env):
    """Counts its steps; a crash at a step drawn at reset, a time limit after ``LIMIT``. The goal is one number."""

    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, parted=False):
        count, goal = Box(0.0, 100.0, (2,), np.float32), Box(-2.0, 3.0, (1,), np.float32)
        flat = Box(np.array([0, 0, -2], np.float32), np.array([100, 100, 3], np.float32))
        self.parted = parted
        self.observation_space = (
            Dict({"observation": count, "achieved_goal": goal, "desired_goal": goal}) if parted else flat
        )

    def seen(self):
        """Steps, the step of the crash, and a goal that nobody shall see."""
        count = np.array([self.steps, self.crash], np.float32)
        if not self.parted:
            return np.append(count, np.float32(-1.5))
        achieved, desired = np.array([self.steps / 10], np.float32), np.array([-1.5], np.float32)
        return {"observation": count, "achieved_goal": achieved, "desired_goal": desired}

    def reset(self, *, seed=None, options=None):
        """Another episode."""
        super().reset(seed=seed)
        self.steps, self.crash = 0, int(self.np_random.integers(3, 2 * LIMIT))
        return self.seen(), {}

    def step(self, action):
        """One more."""
        self.steps += 1
        crashed = self.steps == self.crash
        return self.seen(), float(-crashed), crashed, self.steps == LIMIT and not crashed, {}

    def compute_reward(self, achieved, desired, info):
        """How far the goal is."""
        return -np.abs(achieved - desired)[..., 0]


def directed(parted, num_envs=5):
    """Counters whose goals a Director chooses."""
    venv = DummyVecEnv([lambda: Counter(parted)] * num_envs)
    venv.seed(0)
    where = "desired_goal" if parted else slice(2, 3)
    reward = None if parted else lambda obs, own: own - np.abs(obs[:, 0] / 10 - obs[:, 2])
    return DirectedVecEnv(venv, GoalDirector("p75", PERIOD, goal_box=BOX), where, reward)


@pytest.mark.parametrize("parted", [False, True])
def test_goals_change_when_they_are_due_and_where_episodes_end(parted):
    """Observations hold the Director's goals, terminal ones and rewards those that were in force."""
    envs = directed(parted)
    goal_of = (lambda obs: obs["desired_goal"][..., 0]) if parted else (lambda obs: obs[..., 2])
    count_of = (lambda obs: obs["observation"][..., 0]) if parted else (lambda obs: obs[..., 0])
    obs, clock = envs.reset(), np.zeros(5, int)
    ends = changes = 0
    for _ in range(60):
        goal = goal_of(obs).copy()
        assert ((goal >= -2) & (goal <= 3) & (goal != -1.5)).all()
        obs, reward, dones, infos = envs.step(np.zeros((5, 1)))
        clock += 1
        for world in range(5):
            last = count_of(obs)[world]
            crashed = False
            if dones[world]:
                terminal = infos[world]["terminal_observation"]
                assert goal_of(terminal) == goal[world]
                last, crashed = count_of(terminal), not infos[world]["TimeLimit.truncated"]
            own = 0 if parted else -crashed
            assert reward[world] == pytest.approx(own - abs(last / 10 - goal[world]), rel=1e-5)
        new = dones | (clock == PERIOD)
        assert np.array_equal(goal_of(obs) != goal, new)
        clock[new] = 0
        ends, changes = ends + dones.sum(), changes + (new & ~dones).sum()
    assert ends > 20
    assert changes > 20
    assert np.unique(goal_of(obs)).size == 5


def test_crashes_and_time_limits_stay_apart():
    """The Director hears of the crashes that came within T steps of a goal of its own, and of no time limit."""
    envs = directed(parted=False, num_envs=64)
    obs, crashes = envs.reset(), 0
    for _ in range(2 * PERIOD):
        steps, crash = obs[:, 0].copy(), obs[:, 1].copy()
        obs, _, dones, _ = envs.step(np.zeros((64, 1)))
        crashes += int((dones & (steps + 1 == crash) & (steps >= PERIOD)).sum())
    assert crashes > 5
    assert int(envs.slot.director.interactions.resolved().crashed.sum()) == crashes


def test_a_reset_drops_what_is_pending():
    """A loop that begins anew, as SB3's ``learn`` does each time, gets first goals; nothing goes on behind it."""
    envs = directed(parted=False, num_envs=8)
    envs.reset()
    for _ in range(PERIOD):
        envs.step(np.zeros((8, 1)))
    interactions = envs.slot.director.interactions
    assert interactions.active.any()
    before = len(interactions.resolved())
    goal = envs.slot.goal
    assert (envs.reset()[:, 2] != goal[:, 0]).all()
    assert not interactions.active.any()
    for _ in range(2):  # a goal of PERIOD - 1 would be due
        envs.step(np.zeros((8, 1)))
    assert len(interactions.resolved()) == before


def test_equal_seeds_give_equal_goals():
    """Nothing of a directed loop depends on a generator that it shares with others."""
    found = []
    for _ in range(2):
        envs = directed(parted=True)
        found.append([envs.reset()] + [envs.step(np.zeros((5, 1)))[0] for _ in range(30)])
    for a, b in zip(*found, strict=True):
        assert all(np.array_equal(a[key], b[key]) for key in a)


def test_ppo_trains_under_a_director():
    """SB3's PPO trains in it, its Director learns fear, and the policy's weights move."""
    envs = directed(parted=True, num_envs=16)
    policy = PPO("MultiInputPolicy", envs, n_steps=32, batch_size=128, n_epochs=2, seed=0, device="cpu")
    before = [weight.detach().clone() for weight in policy.policy.parameters()]
    policy.learn(2 * 16 * 32)
    assert any(not torch.equal(old, new) for old, new in zip(before, policy.policy.parameters(), strict=True))
    assert envs.slot.director.fear(torch.zeros(1, 3), torch.zeros(1, 1), torch.ones(1, 1)).probability.isfinite()


def test_refuses_what_does_not_fit():
    """Messages name the argument, what it must be and what it was."""
    flat, parted = DummyVecEnv([Counter]), DummyVecEnv([lambda: Counter(parted=True)])
    director = GoalDirector("p75", PERIOD, goal_box=BOX)
    for envs, where in ((flat, "desired_goal"), (parted, slice(2, 3)), (parted, "goal")):
        with pytest.raises(ValueError, match="where must be a key of a Dict or a slice of a Box, got"):
            DirectedVecEnv(envs, director, where, reward=lambda obs, own: own)
    with pytest.raises(
        ValueError, match="reward must be a function where observations have no achieved_goal, got None"
    ):
        DirectedVecEnv(flat, director, slice(2, 3))


def test_hindsight_experience_replay_runs():
    """SB3's HER relabels transitions of a registered environment with rewards that are those of its own formula."""
    options = {"goal_dict": True, "time_limit": 20, "goal_period": 20, "seed": 0}
    envs = make_vec_env("Deimos/Particle-Directional-v1", 1, env_kwargs=options)
    model = SAC(
        "MultiInputPolicy", envs, learning_starts=100, replay_buffer_class=HerReplayBuffer, seed=0, device="cpu",
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"}, batch_size=32,
        policy_kwargs={"net_arch": [16]},
    )  # fmt: skip
    model.learn(160)
    sample = model.replay_buffer.sample(256, model.get_vec_normalize_env())
    desired, achieved = sample.next_observations["desired_goal"], sample.next_observations["achieved_goal"]
    assert torch.equal(sample.observations["desired_goal"], desired)
    hindsight = (desired.unsqueeze(1) == achieved.unsqueeze(0)).all(2).any(1)
    assert 0.6 < hindsight.float().mean() < 1.0  # four of five are relabelled
    expected = envs.env_method("compute_reward", achieved.numpy(), desired.numpy(), [{}])[0]
    np.testing.assert_allclose(sample.rewards[hindsight, 0], expected[hindsight], rtol=1e-5)
