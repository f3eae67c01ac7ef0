"""Columns ``episode/...`` of ``progress.csv``: the same as a plain count of episodes, step by step."""

import math
from dataclasses import replace

import pytest
import torch

from deimos.learn.ppo import PPOConfig
from deimos.learn.rollout import Rollout
from deimos.run.episodes import Episodes
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
NAMES = ("episode/return", "episode/length", "episode/timeout_fraction")


class Count:
    """The episodes of all worlds, as a loop over steps and worlds counts them."""

    def __init__(self, num_envs):
        self.rewards = [[] for _ in range(num_envs)]

    def add(self, rollout, penalty):
        """Means over those that end in a rollout."""
        ended = []
        for t in range(rollout.num_steps):
            for world, rewards in enumerate(self.rewards):
                crashed, cut_off = bool(rollout.terminated[t, world]), bool(rollout.truncated[t, world])
                rewards.append(rollout.reward[t, world].item() + penalty * crashed)
                if crashed or cut_off:
                    ended.append((math.fsum(rewards), len(rewards), cut_off and not bool(rollout.invalid[t, world])))
                    rewards.clear()
        means = [sum(column) / len(ended) for column in zip(*ended, strict=True)] or [math.nan] * 3
        return dict(zip(NAMES, means, strict=True))


def random_rollout(generator, ends, num_steps=12, num_envs=7):
    """One in which episodes end now and then: by crashes, cut off, and cut off since the world is invalid."""
    rollout = Rollout(num_steps, num_envs, 4, 2, CPU)
    rollout.reward.copy_(torch.rand(rollout.reward.shape, generator=generator))
    kind = torch.randint(0, 4 * 12, rollout.reward.shape, generator=generator)
    rollout.terminated.copy_(kind < 2 * ends)
    rollout.truncated.copy_((kind >= 2 * ends) & (kind < 4 * ends))
    rollout.invalid.copy_((kind >= 3 * ends) & (kind < 4 * ends))
    rollout.reward -= 50.0 * rollout.terminated
    return rollout


def test_means_are_those_of_a_plain_count():
    """Over rollouts with many ends, with none and with a few, in which episodes of several rollouts end too."""
    generator = torch.Generator().manual_seed(0)
    episodes, count = Episodes(7, CPU), Count(7)
    rollouts = [random_rollout(generator, ends) for ends in (3, 0, 1, 0, 0, 1, 6)]
    found = [episodes.add(rollout, 50.0) for rollout in rollouts]
    for row, rollout in zip(found, rollouts, strict=True):
        assert row == pytest.approx(count.add(rollout, 50.0), rel=1e-12, nan_ok=True)
    assert [math.isnan(row["episode/return"]) for row in found] == [False, True, False, True, True, False, False]
    assert found[5]["episode/length"] > 12
    assert 0 < found[0]["episode/timeout_fraction"] < 1


def test_episodes_that_nobody_counted_are_left_out():
    """After a checkpoint of a version that did not count, those that were under way count nowhere, later ones do."""
    generator = torch.Generator().manual_seed(1)
    episodes, count = Episodes(7, CPU), Count(7)
    episodes.load_state_dict(None)
    everywhere = random_rollout(generator, 0)
    everywhere.terminated[4] = True
    assert all(math.isnan(value) for value in episodes.add(everywhere, 50.0).values())
    count.add(everywhere, 50.0)
    rollout = random_rollout(generator, 4)
    assert episodes.add(rollout, 50.0) == pytest.approx(count.add(rollout, 50.0), rel=1e-12)


@pytest.mark.parametrize("limit", [0, 25])
def test_a_run_logs_its_episodes(limit):
    """Rows hold what the rollouts hold, penalties for crashes apart; without a time limit only a crash is an end."""
    env = particle.Config(
        goal_period=8, max_speed=60.0, max_force=20.0, spawn_range=980.0, time_limit=limit, crash_penalty=3.0
    )
    config = TrainConfig(
        env=env, method="penalty-30", ppo=PPOConfig(num_steps=8, hidden=(8,)), num_envs=32, env_steps=64,
        evaluation=False, device="cpu",
    )  # fmt: skip
    trainer, count, rows = Trainer(config, CPU), Count(32), []
    for _ in range(6):
        rows.append(trainer.iterate())
        penalty = trainer.env.crash_penalty + trainer.loop.selector.crash_penalty * env.largest_reward
        expected = count.add(trainer.rollout, penalty)
        assert {name: rows[-1][name] for name in NAMES} == pytest.approx(expected, rel=1e-9, nan_ok=True)
    ended = [row["episode/timeout_fraction"] for row in rows if not math.isnan(row["episode/timeout_fraction"])]
    assert ended
    assert any(ended) == bool(limit)
    assert sum(row["crashes"] for row in rows)


def test_a_resumed_run_goes_on_with_its_episodes():
    """Of episodes that began before a checkpoint, what came before it counts."""
    config = TrainConfig(
        env=particle.Config(goal_period=8, time_limit=20), method="uniform", ppo=PPOConfig(num_steps=8, hidden=(8,)),
        num_envs=4, env_steps=64, evaluation=False, device="cpu",
    )  # fmt: skip
    trainer, again = Trainer(config, CPU), Trainer(replace(config, env_steps=32), CPU)
    first = [trainer.iterate() for _ in range(2)]
    again.load_state_dict(trainer.state_dict())
    row, resumed = trainer.iterate(), again.iterate()
    assert {name: row[name] for name in NAMES} == {name: resumed[name] for name in NAMES}
    assert math.isnan(first[1]["episode/return"])
    assert (row["episode/length"], row["episode/timeout_fraction"]) == (20.0, 1.0)
