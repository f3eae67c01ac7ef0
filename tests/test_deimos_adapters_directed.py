"""The Director in other people's training loops: wrappers, command terms, and hindsight in SB3."""

import runpy
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

import deimos.adapters.gymnasium  # noqa: F401 - it registers the environments
from deimos.adapters.directed import DirectedVectorEnv
from deimos.adapters.stable_baselines3 import DirectedVecEnv
from deimos.goals.director import GoalDirector

HOME = Path(__file__).resolve().parent.parent
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


class Whole(gymnasium.ObservationWrapper):
    """Observations in whole numbers, which cut off a goal's fraction."""

    observation_space = Box(-100, 100, (3,), np.int64)

    def observation(self, observation):
        """See ``gymnasium.ObservationWrapper``."""
        return observation.astype(np.int64)


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


def test_a_reset_is_no_step_and_no_outcome():
    """Between two resets of the worlds nothing is counted: neither steps of the Director's clock nor interactions."""
    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
        envs = wrapped(mode)
        play(envs, PERIOD + 1)
        interactions = envs.slot.director.interactions
        now, known = interactions.now, len(interactions.resolved())
        envs.reset(seed=1)
        envs.reset(seed=2)
        assert (interactions.now, len(interactions.resolved())) == (now, known)
        play(envs, LIMIT + 2)  # with ends of episodes: it still knows how these worlds are reset


def wrapped(mode, state=None, num_envs=4):
    """Counters in gymnasium's vector, whose Director has loaded a state."""
    director = GoalDirector("p75", PERIOD, goal_box=BOX, autoreset=mode)
    if state is not None:
        director.load_state_dict(state)
    return DirectedVectorEnv(SyncVectorEnv([Counter] * num_envs, autoreset_mode=mode), director, slice(2, 3), closeness)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_a_director_that_was_resumed_begins_with_a_reset(mode):
    """A wrapper made for worlds that begin anew takes a Director from a state in which goals were pending."""
    envs = wrapped(mode)
    play(envs, PERIOD + 1)
    assert envs.slot.director.interactions.active.any()
    second = wrapped(mode, envs.slot.director.state_dict())
    obs, _ = second.reset(seed=0)
    assert not second.slot.director.interactions.active.any()
    assert np.array_equal(obs[:, 2:], second.slot.goal)
    play(second, LIMIT + 2)

    first = directed(parted=False)
    first.reset()
    for _ in range(PERIOD + 1):
        first.step(np.zeros((5, 1)))
    other = directed(parted=False)
    other.slot.director.load_state_dict(first.slot.director.state_dict())
    other.reset()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_a_reset_of_some_worlds_leaves_the_others_alone(mode):
    """Under gymnasium's mask the others keep their goals, their clocks and what is pending."""
    envs = wrapped(mode)
    envs.reset(seed=0)
    for world in envs.env.envs:
        world.crash = LIMIT + 1
    for _ in range(PERIOD + 1):
        obs, *_ = envs.step(np.zeros((4, 1), np.float32))
    director, goal = envs.slot.director, obs[:, 2].copy()
    assert director.interactions.active.all()
    mask = np.array([False, True, False, False])
    obs, _ = envs.reset(options={"reset_mask": mask})
    assert np.array_equal(obs[:, 2] != goal, mask)
    envs.env.envs[1].crash = LIMIT + 1
    assert director.interactions.active.tolist() == [True, False, True, True]
    for _ in range(PERIOD - 1):
        last, (obs, *_) = obs, envs.step(np.zeros((4, 1), np.float32))
    assert np.array_equal(obs[:, 2] != last[:, 2], ~mask)  # due, but for the world whose goal began later
    assert len(director.interactions.resolved()) == 3


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
    whole = DummyVecEnv([lambda: Whole(Counter())])
    with pytest.raises(ValueError, match=r"where must be a place for fractions, which goals have, got .* of int64"):
        DirectedVecEnv(whole, director, slice(2, 3), reward=lambda obs, own: own)
    with pytest.raises(
        ValueError, match="reward must be a function where observations have no achieved_goal, got None"
    ):
        DirectedVecEnv(flat, director, slice(2, 3))
    column = {"where": slice(2, 3), "reward": lambda obs, own: -np.abs(obs[:, 2:])}
    two = DummyVecEnv([Counter] * 2), SyncVectorEnv([Counter] * 2)
    for envs in (DirectedVecEnv(two[0], director, **column), DirectedVectorEnv(two[1], director, **column)):
        envs.reset()
        with pytest.raises(ValueError, match=r"reward must give the shape \(2,\), got \(2, 1\)"):
            envs.step(np.zeros((2, 1), np.float32))


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


def closeness(obs, own):
    """Rewards of observations that the goal stands in."""
    steps, goal = (obs["observation"], obs["desired_goal"]) if isinstance(obs, dict) else (obs, obs[:, 2:])
    return own - np.abs(steps[:, 0] / 10 - goal[:, 0])


def histories(mode, parted, selector="uniform", steps=80):
    """Goals, rewards and ends of every step of four worlds, but for those that only reset one; and the Director."""
    director = GoalDirector(selector, PERIOD, goal_box=BOX, autoreset=mode)
    worlds = SyncVectorEnv([lambda: Counter(parted)] * 4, autoreset_mode=mode)
    envs = DirectedVectorEnv(worlds, director, "desired_goal" if parted else slice(2, 3), closeness)
    goal_of = (lambda obs: obs["desired_goal"][..., 0]) if parted else (lambda obs: obs[..., 2])
    obs, found, over = envs.reset(seed=0)[0], [[] for _ in range(4)], np.zeros(4, bool)
    for _ in range(steps):
        goal, ignored = goal_of(obs), over
        obs, reward, terminated, truncated, infos = envs.step(np.zeros((4, 1), np.float32))
        done = terminated | truncated
        over = done if mode is AutoresetMode.NEXT_STEP else np.zeros(4, bool)
        assert not reward[ignored].any()
        for world in np.flatnonzero(~ignored):
            found[world].append((goal[world], reward[world], terminated[world], truncated[world]))
        for world in np.flatnonzero(done):
            last = obs if mode is AutoresetMode.NEXT_STEP else infos["final_obs"][world]
            assert (goal_of(last)[world] if mode is AutoresetMode.NEXT_STEP else goal_of(last)) == goal[world]
    return found, director


@pytest.mark.parametrize("parted", [False, True])
def test_autoreset_modes_of_gymnasium_give_the_same_goals(parted):
    """Every world meets the same goals and rewards, whether its reset takes a step of its own or none."""
    (first, _), (second, _) = (histories(mode, parted) for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP))
    for one, other in zip(first, second, strict=True):
        assert len(other) > 60
        assert one[: len(other)] == other
        assert sum(terminated or truncated for _, _, terminated, truncated in other) > 5
        assert len({goal for goal, *_ in other}) > 12


def play(envs, steps):
    """An episode or more."""
    envs.reset(seed=0)
    for _ in range(steps):
        envs.step(np.zeros((4, 1), np.float32))


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_a_director_that_expects_other_resets_is_refused(mode):
    """At the first end of an episode the mistake shows, and the message says what the Director must be made with."""
    other = {AutoresetMode.SAME_STEP: "NextStep", AutoresetMode.NEXT_STEP: "SameStep"}[mode]
    director = GoalDirector("uniform", PERIOD, goal_box=BOX, autoreset=other)
    envs = DirectedVectorEnv(SyncVectorEnv([Counter] * 4, autoreset_mode=mode), director, slice(2, 3), closeness)
    with pytest.raises(ValueError, match=f"director must be made with autoreset='{mode.value}'"):
        play(envs, LIMIT)


def test_a_vector_may_name_its_mode_by_its_value():
    """It is that mode, not the other one; a vector that says nothing is refused."""
    worlds = SyncVectorEnv([Counter] * 4, autoreset_mode=AutoresetMode.NEXT_STEP)
    worlds.metadata = {"autoreset_mode": "NextStep"}
    director = GoalDirector("uniform", PERIOD, goal_box=BOX)
    with pytest.raises(ValueError, match="director must be made with autoreset='NextStep'"):
        play(DirectedVectorEnv(worlds, director, slice(2, 3), closeness), LIMIT)
    worlds.metadata = {}
    with pytest.raises(ValueError, match=r"worlds that are done by itself, got None for its metadata"):
        DirectedVectorEnv(worlds, director, slice(2, 3), closeness)


def test_fear_is_learnt_in_a_wrapped_vector():
    """The wrapper hands over outcomes from which the Director's network learns."""
    _, director = histories(AutoresetMode.NEXT_STEP, parted=False, selector="p75", steps=200)
    assert director.selector.fear.fitted
    with pytest.raises(ValueError, match=r"env must reset worlds that are done by itself, got AutoresetMode.DISABLED"):
        histories(AutoresetMode.DISABLED, parted=False)


@pytest.fixture
def isaac_lab(monkeypatch):
    """Makes an environment with a share of standing robots, of the example for Isaac Lab over a stub of it."""
    monkeypatch.syspath_prepend(str(HOME / "tests" / "data" / "isaaclab_stub"))
    example = runpy.run_path(str(HOME / "examples" / "isaac_lab_director.py"))
    make = sys.modules["isaaclab.envs"].ManagerBasedRLEnv
    yield lambda standing=0.0: make(64, example["DirectedVelocityCfg"](rel_standing_envs=standing))
    for name in [name for name in sys.modules if name.split(".")[0] == "isaaclab"]:
        del sys.modules[name]


def test_timers_and_resets_call_for_commands(isaac_lab):
    """A command changes where its timer has run out or an episode begins, and nowhere else; all are in the box."""
    torch.manual_seed(0)
    worlds = isaac_lab()
    changes = 0
    for _ in range(40):
        before, left = worlds.term.command.clone(), worlds.term.time_left.clone()
        worlds.step()
        new = (worlds.term.command != before).any(1)
        expected = worlds.reset_terminated | worlds.reset_time_outs | (left - worlds.step_dt <= 0)
        assert torch.equal(new, expected)
        assert (worlds.term.command.abs() <= torch.tensor([1.0, 0.5, 2.0])).all()
        changes += int(new.sum())
    assert changes > 300


def test_interactions_are_those_of_the_commands(isaac_lab):
    """Falls under a command of the Director's are its crashes, first ones are not; it then asks for fast walks."""
    torch.manual_seed(0)
    worlds = isaac_lab()
    director, counted, found = worlds.term.director, 0, 0
    for _ in range(300):
        ours = director.interactions.active.clone()
        worlds.step()
        counted += int((worlds.reset_terminated & ours).sum())
        resolved = director.interactions.resolved()
        found += int((resolved.crashed & (resolved.resolved == director.interactions.now)).sum())
    assert director.interactions.now == 300
    assert counted == found > 50
    assert director.selector.fear.fitted
    state, speeds = torch.zeros(15), np.array([0.0, 0.95])
    slow, fast = director.risk_map(state, torch.zeros(3), {0: speeds, 1: [0.0]}).probability[0]
    assert fast > slow + 0.2


def test_a_reset_between_two_steps_begins_episodes(isaac_lab):
    """Whatever the modes made of commands meanwhile: pending goals are dropped, and the next ones are first ones."""
    torch.manual_seed(0)
    worlds = isaac_lab(standing=0.5)
    interactions = worlds.term.director.interactions
    for _ in range(4):
        for _ in range(10):
            worlds.step()
        now, known = interactions.now, len(interactions.resolved())
        half = torch.arange(32)
        worlds.term.reset(half)
        assert not interactions.active[half].any()
        assert interactions.active[32:].any()
        worlds.term.reset(None)
        assert not interactions.active.any()
        assert (interactions.now, len(interactions.resolved())) == (now, known)
    worlds.step()
    assert interactions.now == 41


def test_a_term_goes_on_from_a_state(isaac_lab):
    """The Director's state in another environment, and a counter of steps from a checkpoint, before the first step."""
    torch.manual_seed(0)
    first, second = isaac_lab(standing=0.5), isaac_lab(standing=0.5)
    for _ in range(30):
        first.step()
    director = second.term.director
    director.load_state_dict(first.term.director.state_dict())
    second.common_step_counter = 1000
    second.term.reset(torch.arange(64))
    assert not director.interactions.active.any()
    assert director.interactions.now == 30
    for _ in range(30):
        second.step()
    assert director.interactions.now == 60


def test_a_robot_that_has_diverged_does_not_stop_the_others(isaac_lab):
    """It is done, its data may be NaN until the next step, and its first command is drawn whatever its state."""
    torch.manual_seed(0)
    worlds = isaac_lab()
    for _ in range(10):
        worlds.step()
    worlds.scene["robot"].data.joint_pos[5] = torch.nan
    worlds.term.reset(torch.tensor([5]))
    assert worlds.term.command.isfinite().all()
    alive = int((~(worlds.reset_terminated | worlds.reset_time_outs)).nonzero()[-1])
    worlds.scene["robot"].data.joint_pos[alive] = torch.nan
    with pytest.raises(ValueError, match=f"state of world {alive} must be finite"):
        worlds.term._resample(torch.tensor([alive]))


def test_what_is_executed_is_what_is_learnt(isaac_lab):
    """Robots that stand whatever they were asked for have pursued a goal of zeros."""
    torch.manual_seed(0)
    worlds = isaac_lab(standing=0.5)
    for _ in range(40):
        worlds.step()
    goals = worlds.term.director.interactions.resolved().next_goal
    standing = (goals == 0).all(1).float().mean().item()
    assert 0.3 < standing < 0.7
