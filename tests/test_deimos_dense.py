"""Goals as a GPU asks for them, for all worlds at every step: the same as those of the worlds that are due alone."""

import math
import re
from dataclasses import replace

import pytest
import torch
from states import leaves

from deimos.goals import core, methods
from deimos.goals.interactions import assign
from deimos.goals.selector import GoalSelector, uniform_proposal
from deimos.goals.selectors import mix, rnd
from deimos.learn.ppo import PPOConfig
from deimos.run import loop
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle, quad, quad_arm

CPU = torch.device("cpu")
PPO = PPOConfig(num_steps=12, epochs=1, hidden=(8,), init_std=80.0)
# Crashes, time limits and goals that are due fall on different steps in different worlds.
PARTICLES = particle.Config(
    variant="relative", goal_period=7, time_limit=33, stagger_goals=True, max_speed=150.0, max_force=150.0
)
SELECTORS = {name: methods.method(name) for name in methods.METHODS} | {
    "probing": replace(methods.method("p75"), probe=0.3), "literal": methods.method("p75-literal"),
    "some uniform": mix.Config(base="p75"), "rnd by chance": rnd.Config(rule="proportional"),
}  # fmt: skip


ROUNDED = re.compile(r"fear/(score|temperature)|calibration/|.*\.(ring|pending|temperature)$")
"""What scores are part of: torch's products of several rows differ from those of a row in the last bit."""


def run(config, iterations):
    """A trainer after some iterations, its rows of ``progress.csv``, its goals and where episodes were cut off."""
    trainer = Trainer(config, CPU)
    rows, goals, cut_off = [], [], []
    for _ in range(iterations):
        rows.append(trainer.iterate())
        goals.append(trainer.rollout.obs[..., trainer.env.goal_slice].clone())
        cut_off.append(trainer.rollout.truncated.clone())
    return trainer, rows, torch.stack(goals), torch.stack(cut_off)


def differences(found, expected):
    """Names of what is not the same: in its bits, but for what scores are part of."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, str | None):
            same = found[name] == value
        else:
            one, other = torch.as_tensor(found[name]).double(), torch.as_tensor(value).double()
            rounding = 1e-5 if ROUNDED.match(name) else 0.0
            same = torch.allclose(one, other, rtol=rounding, atol=rounding, equal_nan=True)
        if not same:
            yield name


def hold_to_each_other(config, monkeypatch, iterations):
    """Train twice, once as a GPU does, and compare all that there is; gives what ``run`` gave in that case."""
    listed, rows, goals, cut_off = run(config, iterations)
    monkeypatch.setattr(core, "AS_ON_GPU", True)
    dense, dense_rows, dense_goals, dense_cut_off = run(config, iterations)
    assert torch.equal(dense_goals, goals)
    assert torch.equal(dense_cut_off, cut_off)
    for found, expected in zip(dense_rows, rows, strict=True):
        assert not list(differences(found, expected))
    assert not list(differences(*(dict(leaves(trainer.state_dict())) for trainer in (dense, listed))))
    assert cut_off.any()
    return dense


@pytest.mark.parametrize("name", SELECTORS)
def test_all_worlds_get_the_goals_of_those_that_are_due(name, monkeypatch):
    """Goals, outcomes, rows of progress.csv and all that is learnt are the same, whoever chooses the goals."""
    config = TrainConfig(env=PARTICLES, selector=SELECTORS[name], ppo=PPO, num_envs=64, env_steps=72, evaluation=False)
    dense = hold_to_each_other(config, monkeypatch, 6)
    assert dense.loop.selector.dense
    done = dense.loop.interactions.resolved()
    assert done.crashed.any()
    assert not done.crashed.all()


def test_goals_that_outlast_a_rollout_are_counted_alike(monkeypatch):
    """Where a rollout issues no goal, the log says so, whoever is asked about every world at each of its steps."""
    env = replace(PARTICLES, goal_period=30, stagger_goals=False, max_speed=30.0, time_limit=45)
    config = TrainConfig(env=env, method="p75", ppo=PPO, num_envs=64, env_steps=72, evaluation=False)
    hold_to_each_other(config, monkeypatch, 6)
    said = [row["fear/chosen"] for row in run(config, 4)[1]]
    assert [math.isnan(share) for share in said] == [True, True, False, True]


@pytest.mark.parametrize("env", [quad.Config, quad_arm.Config])
def test_robots_get_them_too(env, monkeypatch):
    """Robots, whose goals may have to be made valid and are seen from where they stand, learn the same."""
    task = env(engine="native", goal_period=7, episode_steps=25)
    config = TrainConfig(env=task, method="p75", ppo=PPO, num_envs=12, env_steps=36, evaluation=False)
    hold_to_each_other(config, monkeypatch, 3)


@pytest.mark.parametrize("value", [2.5, torch.arange(10.0).view(5, 2)])
@pytest.mark.parametrize("listed", [[], [3], [1, 4], [0, 1, 2, 3, 4]])
def test_a_mask_writes_what_a_list_does(listed, value, torch_device):
    """``assign`` writes the same rows, numbers or a tensor's, whether they are listed or in a mask of all rows."""
    rows = torch.tensor(listed, dtype=torch.int64, device=torch_device)
    every = torch.arange(5, device=torch_device)
    value = value.to(torch_device) if isinstance(value, torch.Tensor) else value
    by_list, by_mask = torch.full((2, 5, 2), -1.0, device=torch_device)
    assign(by_list, rows, value[rows] if isinstance(value, torch.Tensor) else value)
    assign(by_mask, every, value, torch.isin(every, rows))
    assert torch.equal(by_list, by_mask)
    assert int((by_list != -1).any(1).sum()) == len(listed)


class Counting(GoalSelector):
    """Uniform goals; it counts what it is asked for, as selectors of other people may."""

    asked = 0

    def propose(self, rows, state, goal, candidates, draws):
        """See ``GoalSelector.propose``."""
        self.asked += len(rows)
        return uniform_proposal(candidates, draws[:, 0])


@pytest.mark.parametrize("dense", [False, True])
def test_a_selector_is_asked_about_due_worlds_alone_unless_it_allows_more(dense, monkeypatch):
    """Whoever does not say that it may be asked about all worlds, or has a guard, is asked about those that are due."""
    monkeypatch.setattr(core, "AS_ON_GPU", True)
    monkeypatch.setattr(Counting, "dense", dense)
    for guard in (None, lambda env, rows, goal: goal):
        env = particle.Config(goal_period=5).build(8, CPU, 0)
        own = loop.GoalLoop(env, Counting(), guard=guard)
        for _ in range(10):
            own.advance(env.step(torch.zeros(8, 3)))
        assert own.selector.asked == (80 if dense and guard is None else 16)
