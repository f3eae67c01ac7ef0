"""Environments under gymnasium's interface, one world or many."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from bare_loop import CONFIG, TIME_LIMIT, Bare, random_actions
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import env_checker, passive_env_checker
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

from deimos import plugins
from deimos.adapters.gymnasium import ENVIRONMENTS, VERSION, GymnasiumEnv, GymnasiumVectorEnv
from deimos.checks import SimulationError
from deimos.goals.selectors import director
from deimos.sim import envs as sim_envs
from deimos.sim.envs import particle, quad


def spec(config=CONFIG):
    """What ``gymnasium.make`` and ``gymnasium.make_vec`` need to build either view."""
    return EnvSpec(
        "Deimos-v0", entry_point=GymnasiumEnv, vector_entry_point=GymnasiumVectorEnv, kwargs={"config": config}
    )


def play(envs, actions, **reset):
    """First observations, then the observations, rewards, terminated, truncated and infos of every step."""
    return [envs.reset(**reset)[0], *(envs.step(action) for action in actions)]


def same(a, b):
    """Whether two structures of arrays are equal, bit for bit and type for type, by gymnasium's own rule."""
    return env_checker.data_equivalence(a, b, exact=True)


# The two warnings left are gymnasium's doubts about an unbounded observation.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is -?infinity")
@pytest.mark.parametrize("variant", ["absolute", "directional", "relative"])
def test_passes_gymnasiums_checker(variant):
    """``check_env`` has nothing to say about one world, its spec included."""
    env = gymnasium.make(spec(particle.Config(variant=variant, time_limit=TIME_LIMIT)))
    assert env.spec is not None  # else the checker would skip what concerns determinism
    env_checker.check_env(env.unwrapped)


def test_vector_passes_gymnasiums_checks():
    """The parts of ``check_env`` that a vector environment can pass have nothing to say either."""
    envs = gymnasium.make_vec(spec(), num_envs=5, vectorization_mode="vector_entry_point")
    assert isinstance(envs, GymnasiumVectorEnv)
    assert envs.spec is not None
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    passive_env_checker.check_observation_space(envs.observation_space)
    passive_env_checker.check_action_space(envs.action_space)
    env_checker.check_reset_return_type(envs)
    env_checker.check_reset_seed_determinism(envs)
    env_checker.check_reset_options(envs)
    passive_env_checker.env_reset_passive_checker(envs)
    for action in random_actions(20, 5):
        obs = envs.step(action)[0]
        passive_env_checker.check_obs(obs, envs.observation_space, "step")
    env_checker.check_returned_data_not_reused(GymnasiumVectorEnv(CONFIG, 1))  # it reads ``terminated`` as a bool


def test_vector_equals_gymnasiums_own():
    """Observations, rewards, dones and infos are those of ``SyncVectorEnv`` over single worlds, bit for bit."""
    n, seed = 8, 5
    single = [lambda i=i: GymnasiumEnv(CONFIG, seed, env_offset=i) for i in range(n)]
    theirs = SyncVectorEnv(single, autoreset_mode=AutoresetMode.SAME_STEP)
    ours = GymnasiumVectorEnv(CONFIG, n, seed)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata == theirs.metadata
    actions = random_actions(40, n)
    found, expected = play(ours, actions), play(theirs, actions)
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))
    terminated, truncated = (np.stack([step[i] for step in found[1:]]) for i in (2, 3))
    assert terminated.sum() > 2
    assert truncated.sum() > 2


def test_equals_the_bare_loop(torch_device):
    """``final_obs`` is where an episode ended, under its last goal; the observation is that after the reset."""
    n, seed = 32, 4
    bare = Bare(n, seed, torch_device)
    envs = GymnasiumVectorEnv(CONFIG, n, seed, torch_device)
    np.testing.assert_array_equal(envs.reset()[0], bare.env.obs.cpu())
    ended = 0
    for action in random_actions(30, n):
        obs, reward, terminated, truncated, infos = envs.step(action)
        expected = [x.cpu().numpy() for x in bare.step(torch.from_numpy(action).to(torch_device))]
        for found, value in zip((reward, terminated, truncated, obs), expected[1:], strict=True):
            np.testing.assert_array_equal(found, value)
        done = terminated | truncated
        np.testing.assert_array_equal(infos.get("_final_obs", np.zeros(n, bool)), done)
        for world in np.flatnonzero(done):
            np.testing.assert_array_equal(infos["final_obs"][world], expected[0][world])
            assert not np.array_equal(obs[world], expected[0][world])
            assert not obs[world, :3].any()  # a new episode starts at rest
        ended += done.sum()
    assert ended > 20


def test_single_world_shows_new_goals_and_terminal_observations():
    """One world equals the bare loop: the new goal where it goes on, the old one where the episode ends."""
    bare, env = Bare(1, 9), GymnasiumEnv(CONFIG, 9)
    env.reset()
    ends = goals = 0
    for action in random_actions(100, 1):
        before = bare.env.goal.clone()
        last_obs, reward, terminated, truncated, next_obs = bare.step(torch.from_numpy(action))
        done = bool(terminated | truncated)
        obs, *rest = env.step(action[0])
        np.testing.assert_array_equal(obs, (last_obs if done else next_obs)[0])
        assert rest == [reward.item(), terminated.item(), truncated.item(), {}]
        if done:
            np.testing.assert_array_equal(env.reset()[0], next_obs[0])
        ends += done
        goals += not done and not torch.equal(before, bare.env.goal)
    assert ends > 5
    assert goals > 5


def test_statistics_wrapper_sees_whole_episodes():
    """The returns and lengths that gymnasium's ``RecordEpisodeStatistics`` finds are those counted by hand."""
    n = 8
    envs = RecordEpisodeStatistics(GymnasiumVectorEnv(CONFIG, n, seed=2), buffer_length=1000)
    envs.reset()
    total, length, returns, lengths = np.zeros(n), np.zeros(n, int), [], []
    for action in random_actions(60, n):
        _, reward, terminated, truncated, _ = envs.step(action)
        total, length = total + reward, length + 1
        for world in np.flatnonzero(terminated | truncated):
            returns.append(total[world])
            lengths.append(length[world])
            total[world] = length[world] = 0
    assert list(envs.return_queue) == returns
    assert list(envs.length_queue) == lengths
    assert max(lengths) == TIME_LIMIT
    assert min(lengths) < TIME_LIMIT


def test_equal_seeds_give_equal_episodes():
    """A seed fixes everything, whoever gets it and whatever was before; another seed gives something else."""
    actions = random_actions(20, 4)
    first, second = GymnasiumVectorEnv(CONFIG, 4, seed=1), GymnasiumVectorEnv(CONFIG, 4, seed=2)
    expected = play(first, actions)
    assert all(same(a, b) for a, b in zip(play(second, actions, seed=1), expected, strict=True))
    assert all(same(a, b) for a, b in zip(play(first, actions, seed=1), expected, strict=True))
    other = play(first, actions, seed=2)
    assert not np.isclose(other[0], expected[0])[:, 3:6].any()  # where particles start
    assert not np.isclose(other[0], expected[0])[:, 9:12].any()  # their goals


def test_without_a_seed_no_two_are_alike():
    """Worlds that nobody gave a seed differ: four of them in gymnasium's own vector, and two vectors."""
    four = SyncVectorEnv([lambda: GymnasiumEnv(CONFIG)] * 4)
    assert len(np.unique(four.reset()[0][:, 3], axis=0)) == 4  # where particles start
    two = [GymnasiumVectorEnv(CONFIG, 4).reset()[0] for _ in range(2)]
    assert not np.isclose(*two)[:, 3:6].any()


def test_seeds_may_be_numpy_numbers():
    """A seed that NumPy drew is one, and means what the same number of Python means."""
    first, second = (GymnasiumVectorEnv(CONFIG, 4, seed=kind(7)) for kind in (np.int64, int))
    np.testing.assert_array_equal(first.reset()[0], second.reset()[0])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_other_modes_give_the_same_episodes(mode):
    """Under the same policy every world goes through what it does in ``SAME_STEP``, whenever episodes begin."""
    n, gains = 6, np.random.default_rng(0).uniform(-150.0, 150.0, (12, 3)).astype(np.float32)
    episodes = []
    for envs in (GymnasiumVectorEnv(CONFIG, n, 5), GymnasiumVectorEnv(CONFIG, n, 5, autoreset_mode=mode)):
        obs, _ = envs.reset()
        found, over = [[] for _ in range(n)], np.zeros(n, bool)
        for _ in range(60):
            if mode is AutoresetMode.DISABLED and over.any():
                obs, _ = envs.reset(options={"reset_mask": over})
                over[:] = False
            before = obs
            obs, reward, terminated, truncated, infos = envs.step(np.clip(before @ gains, -100.0, 100.0))
            last = obs.copy()
            for world in np.flatnonzero(infos.get("_final_obs", np.zeros(n, bool))):
                last[world] = infos["final_obs"][world]
            for world in np.flatnonzero(~over):
                found[world].append((before[world], reward[world], terminated[world], truncated[world], last[world]))
            same_step = envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
            ignored = over
            over = np.zeros(n, bool) if same_step else terminated | truncated
            assert not (ignored & over).any()
            assert not reward[ignored].any()
        episodes.append(found)
    assert sum(step[2] for world in episodes[1] for step in world) > 5
    for expected, found in zip(*episodes, strict=True):
        assert len(found) > 40
        assert all(same(a, b) for a, b in zip(expected, found, strict=False))


def test_observation_wrappers_of_gymnasium():
    """``NormalizeObservation``, which takes ``NEXT_STEP`` alone, runs over many worlds."""
    envs = NormalizeObservation(GymnasiumVectorEnv(CONFIG, 8, 0, autoreset_mode="NextStep"))
    found = np.array(play(envs, random_actions(40, 8))[1:], dtype=object)[:, 0]
    assert np.abs(np.concatenate(found)[-64:].mean()) < 0.5


def test_disabled_mode_waits_for_a_reset():
    """A step while an episode is over is refused, with the world; a mask begins there and nowhere else."""
    envs = GymnasiumVectorEnv(replace(CONFIG, time_limit=2), 3, 0, autoreset_mode=AutoresetMode.DISABLED)
    idle = np.zeros((3, 3))
    envs.reset()
    envs.step(idle)
    before = envs.reset(options={"reset_mask": np.array([True, False, False])})[0]
    assert envs.step(idle)[3].tolist() == [False, True, True]
    with pytest.raises(gymnasium.error.ResetNeeded, match="episode of world 1 has ended"):
        envs.step(idle)
    after = envs.reset(options={"reset_mask": np.array([False, True, True])})[0]
    assert not np.isclose(after, before)[1:, 3:6].any()
    assert envs.step(idle)[3].tolist() == [True, False, False]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_registered_under_gymnasiums_names(name):
    """Every environment is known by its name, and what it stands for can be configured."""
    found = gymnasium.spec(f"Deimos/{name}-v{VERSION}")
    assert found.entry_point.startswith("deimos.")
    options = dict(found.kwargs)
    assert plugins.load(sim_envs, options.pop("environment")).Config(**options) is not None


def test_made_by_name():
    """``make`` and ``make_vec`` take options of the environment and of the adapter, and refuse others."""
    one = gymnasium.make("Deimos/Particle-Absolute-v1", seed=1, max_speed=3.0)
    assert one.unwrapped.worlds.loop.env.config == particle.Config(variant="absolute", time_limit=1000, max_speed=3.0)
    many = gymnasium.make_vec("Deimos/Particle-Absolute-v1", 4, vectorization_mode="vector_entry_point", seed=1)
    np.testing.assert_array_equal(many.reset()[0][0], one.reset()[0])
    with pytest.raises(TypeError, match="wind"):
        gymnasium.make("Deimos/Particle-Absolute-v1", wind=1.0)
    with pytest.raises(TypeError, match="render_mode must be None, got 'human'"):
        gymnasium.make("Deimos/Particle-Absolute-v1", render_mode="human")


@pytest.mark.parametrize("variant", ["absolute", "directional"])
def test_goal_dict_is_the_same_world(variant):
    """The parts of a dictionary are those of the flat observation, where an episode ends too; all else is equal."""
    config, actions = replace(CONFIG, variant=variant), random_actions(40, 6)
    flat, parted = (GymnasiumVectorEnv(config, 6, 3, goal_dict=given) for given in (False, True))
    places = {"observation": slice(0, 9), "desired_goal": slice(9, 12)}
    places["achieved_goal"] = slice(0, 3) if variant == "directional" else slice(3, 6)
    ended = 0
    for step, (obs, *expected) in zip(play(parted, actions)[1:], play(flat, actions)[1:], strict=True):
        assert parted.observation_space.contains(step[0])
        assert same(step[0], {key: obs[:, place] for key, place in places.items()})
        assert same(step[1:4], tuple(expected[:3]))
        for world in np.flatnonzero(expected[3].get("_final_obs", ())):
            last = step[4]["final_obs"][world]
            assert same(last, {key: expected[3]["final_obs"][world][place] for key, place in places.items()})
            ended += 1
    assert ended > 10


@pytest.mark.parametrize("variant", ["absolute", "directional"])
@pytest.mark.parametrize("reward", ["linear", "reciprocal", "exponential"])
def test_compute_reward_is_that_of_the_step(variant, reward):
    """What was achieved under the goal that was in force gives the step's reward, one world or many at a time."""
    env = GymnasiumEnv(replace(CONFIG, variant=variant, reward=reward, reward_length=200.0), seed=1, goal_dict=True)
    achieved, goals, rewards = [], [], []
    goal = env.reset()[0]["desired_goal"]
    for action in random_actions(60, 1):
        obs, reward, *over, _ = env.step(action[0])
        assert env.compute_reward(obs["achieved_goal"], goal, {}) == pytest.approx(reward, rel=1e-4, abs=1e-6)
        for kept, value in zip((achieved, goals, rewards), (obs["achieved_goal"], goal, reward), strict=True):
            kept.append(value)
        goal = (env.reset()[0] if any(over) else obs)["desired_goal"]
    assert np.ptp(rewards) > 0.1
    found = env.compute_reward(np.array(achieved), np.array(goals), [{}] * 60)
    np.testing.assert_allclose(found, rewards, rtol=1e-4, atol=1e-6)


def test_goal_dict_is_refused_where_rewards_are_not_of_goals_alone():
    """A way from elsewhere is no goal from here, robots are rewarded for more, and a crash may cost something."""
    for config in (replace(CONFIG, variant="relative"), quad.Config(), replace(CONFIG, crash_penalty=1.0)):
        with pytest.raises(ValueError, match="goal_dict must be False, since rewards depend on more than goals here"):
            GymnasiumVectorEnv(config, 1, goal_dict=True)
    with pytest.raises(ValueError, match="The rewards of Locomotion depend on more than what was achieved"):
        GymnasiumVectorEnv(quad.Config(), 1).compute_reward(np.zeros(3), np.zeros(3))


def test_reset_without_a_seed_goes_on():
    """The episodes after such a reset are new ones, and a second reset at once skips none of them."""
    actions = random_actions(3, 4)
    once, twice = GymnasiumVectorEnv(CONFIG, 4, seed=0), GymnasiumVectorEnv(CONFIG, 4, seed=0)
    start, *_ = play(once, actions)
    play(twice, actions)
    following = once.reset()[0]
    assert not np.array_equal(following, start)
    twice.reset()
    np.testing.assert_array_equal(twice.reset()[0], following)


def test_reset_drops_pending_interactions():
    """An interaction that a reset cuts off is neither a crash nor a survival, later either."""
    envs = GymnasiumVectorEnv(particle.Config(goal_period=5, max_force=100.0), 4)
    idle = np.zeros((4, 3))
    play(envs, [idle] * 7)
    assert envs.loop.interactions.active.all()
    envs.reset()
    assert not envs.loop.interactions.active.any()
    for _ in range(5):
        envs.step(idle)
    assert len(envs.loop.interactions.resolved()) == 0


def test_selector_chooses_the_goals():
    """A configured selector is built for the worlds, anew for every seed."""
    envs = GymnasiumVectorEnv(CONFIG, 4, selector=director.Config(percentile=75.0, candidates=7))
    selector = envs.loop.selector
    assert isinstance(selector, director.Director)
    envs.reset(seed=1)
    assert envs.loop.selector is not selector
    assert envs.loop.selector.num_candidates == 7


@pytest.mark.parametrize("bound", [1.0, 100.0, float("inf")])
def test_action_space_is_what_the_environment_takes(bound):
    """Actions are bounded by the environment's bound, and unbounded where it has none."""
    space = GymnasiumVectorEnv(particle.Config(max_force=bound), 2).single_action_space
    assert space == gymnasium.spaces.Box(-bound, bound, (3,), np.float32)
    assert space.is_bounded() == np.isfinite(bound)


def test_returns_copies():
    """Writing into what came back changes no world, and an action is not kept."""
    ours, untouched = GymnasiumVectorEnv(CONFIG, 4, seed=0), GymnasiumVectorEnv(CONFIG, 4, seed=0)
    actions = random_actions(20, 4)
    expected = play(untouched, actions)
    ours.reset()[0].fill(7.0)
    for action, step in zip(actions.copy(), expected[1:], strict=True):
        found = ours.step(action)
        assert same(found, step)
        for array in (*found[:4], action):
            array.fill(1)


def test_refuses_what_it_cannot_take():
    """Messages name the argument, what it must be and what it was."""
    envs, idle = GymnasiumVectorEnv(CONFIG, 4), np.zeros((4, 3))
    envs.reset()
    with pytest.raises(ValueError, match=r"actions must have shape \(4, 3\), got \(3,\)"):
        envs.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"options may hold only reset_mask, got .*'goal'"):
        envs.reset(options={"goal": 1})
    for mask in (np.ones(3, bool), np.ones(4)):
        with pytest.raises(ValueError, match=r"reset_mask must be bool and have shape \(4,\), got"):
            envs.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="seed must be None if there is a reset_mask, got 3"):
        envs.reset(seed=3, options={"reset_mask": np.ones(4, bool)})
    for seed in (2**32, -1, [1, 2, 3, 4], 1.5):
        with pytest.raises(ValueError, match=r"seed must be a whole number in \[0, 2\^32\), one for all worlds"):
            envs.reset(seed=seed)
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        GymnasiumVectorEnv(CONFIG, 0)
    idle[3, 0] = np.nan
    with pytest.raises(SimulationError, match="World 3: its action is not finite"):
        envs.step(idle)


def test_goes_on_after_an_invalid_world():
    """One broken world is cut off and begins anew, alone or among few, and a run of them is an error."""
    envs, idle = GymnasiumVectorEnv(quad.Config(), 2), np.zeros((2, 12))
    envs.reset()
    speed = envs.loop.env.tensors["qvel"]
    for _ in range(10):
        speed[1, 0] = 99.0
        assert envs.step(idle)[3].tolist() == [False, True]
    speed[1, 0] = 99.0
    with pytest.raises(SimulationError, match=r"World 1: its speed was .* 11 of the last 22 world-steps"):
        envs.step(idle)


def test_single_world_must_be_reset():
    """A single world takes no step before its first reset nor after the end of an episode."""
    env, idle = GymnasiumEnv(particle.Config(time_limit=2)), np.zeros(3)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(idle)
    env.reset()
    assert not env.step(idle)[3]
    assert env.step(idle)[3]
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(idle)
    env.reset()
    env.step(idle)
