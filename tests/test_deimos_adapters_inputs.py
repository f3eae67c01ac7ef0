"""What adapters are given and cannot use is named at once; what they can use, they use."""

import gymnasium
import numpy as np
import pytest
import torch
from bare_loop import CONFIG, CPU
from gymnasium.spaces import Box, Dict, Text, Tuple
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from deimos.adapters.directed import DirectedVectorEnv, GoalSlot
from deimos.adapters.gymnasium import GymnasiumVectorEnv
from deimos.adapters.rsl_rl import RslRlVecEnv
from deimos.adapters.stable_baselines3 import DirectedVecEnv
from deimos.goals.director import GoalDirector
from deimos.goals.methods import method

GOAL, STATE = Box(-1.0, 1.0, (1,), np.float32), Box(-1.0, 1.0, (2,), np.float32)


def director():
    """Chooses goals of one component."""
    return GoalDirector("p75", 2, goal_box=([-1.0], [1.0]))


class Blank(gymnasium.Env):
    """Worlds that have nothing in the place of the goal."""

    action_space = Box(-1.0, 1.0, (1,), np.float32)
    observation_space = Box(-np.inf, np.inf, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        """Another episode."""
        return np.array([0.0, 0.0, np.nan], np.float32), {}

    def step(self, action):
        """One more."""
        return np.array([0.0, 1.0, np.nan], np.float32), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("space", "where", "message"),
    [
        (
            Dict(goal=GOAL, state=Dict(inner=STATE)),
            "goal",
            "Observations must hold arrays alone, got Dict.* for 'state'",
        ),
        (
            Dict(goal=GOAL, state=STATE, name=Text(3)),
            "goal",
            "Observations must hold arrays alone, got Text.* for 'name'",
        ),
        (Dict(goal=GOAL), "goal", "where must leave components for the goal and for the state, got 'goal'"),
        (STATE, slice(0, 2), r"where must leave components .*, got slice\(0, 2, None\) for Box"),
        (STATE, slice(2, 3), r"where must leave components .*, got slice\(2, 3, None\) for Box"),
        (Box(-1.0, 1.0, (2, 2)), slice(0, 1), r"where must be a place of one axis, got slice\(0, 1, None\) for Box"),
        (Dict(goal=Box(-1.0, 1.0, ()), state=STATE), "goal", "where must be a place of one axis, got 'goal' for Box"),
        (Tuple((STATE, GOAL)), slice(0, 1), "where must be a place for fractions"),
    ],
)
def test_a_space_without_a_place_for_goals_and_states_is_refused(space, where, message):
    """It is refused when the worlds are wrapped, not by what numpy finds in a step."""
    with pytest.raises(ValueError, match=message):
        GoalSlot(director(), space, 4, where)


def test_what_stands_in_the_goals_place_does_not_matter():
    """It is overwritten before anybody reads it, so it need not be a number."""
    envs = DirectedVectorEnv(
        SyncVectorEnv([Blank] * 4, autoreset_mode=AutoresetMode.SAME_STEP),
        director(),
        slice(2, 3),
        lambda obs, own: own,
    )
    for obs, *_ in (envs.reset(), *(envs.step(np.zeros((4, 1))) for _ in range(3))):
        assert np.isfinite(obs).all()


@pytest.mark.parametrize("kind", [list, torch.from_numpy])
def test_rewards_of_any_kind_are_arrays(kind):
    """A list or a tensor of rewards is one of each world, as Stable-Baselines3 wants them."""
    envs = DirectedVecEnv(DummyVecEnv([Blank] * 4), director(), slice(2, 3), lambda obs, own: kind(obs[:, 1]))
    envs.reset()
    reward = envs.step(np.zeros((4, 1)))[1]
    assert isinstance(reward, np.ndarray)
    assert reward.tolist() == [1.0] * 4


@pytest.mark.parametrize("selector", ["p75", method("p75")])
def test_rsl_rls_wrapper_takes_a_selector_that_was_built(selector):
    """A name or a configuration is none, and a configuration of worlds is no world."""
    with pytest.raises(ValueError, match=r"selector must be a deimos\.goals\.selector\.GoalSelector, got "):
        RslRlVecEnv(CONFIG.build(4, CPU, 0), selector)
    with pytest.raises(ValueError, match=r"env must be a deimos\.sim\.env\.Env, got Config"):
        RslRlVecEnv(CONFIG)


def test_gymnasiums_worlds_take_configurations():
    """A name or the class of a configuration is none."""
    for selector in ("p75", type(method("p75"))):
        with pytest.raises(ValueError, match=r"selector must be a deimos\.goals\.selector\.SelectorConfig, got "):
            GymnasiumVectorEnv(CONFIG, 4, selector=selector)
    with pytest.raises(ValueError, match=r"config must be a deimos\.sim\.env\.EnvConfig, got "):
        GymnasiumVectorEnv(type(CONFIG), 4)
