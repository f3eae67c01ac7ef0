"""What a trainer computes: the same whatever the host has set, and other numbers for another seed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from short_training import CONFIG

from deimos.checks import RunError, SimulationError
from deimos.goals.methods import method
from deimos.goals.selectors import rnd
from deimos.learn.ppo import PPOConfig
from deimos.learn.rollout import Rollout
from deimos.nn.random import Purpose, normals
from deimos.run import training
from deimos.run.config import kind
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle


@pytest.mark.parametrize(
    "selector",
    [
        method("p75"),
        method("vds"),
        rnd.Config(target=64, predictor=128, features=128),  # so large that torch shares out the weights' decomposition
    ],
    ids=kind,
)
def test_threads_change_no_number(selector, tmp_path, monkeypatch):
    """On one thread and on several, all of which have work, ``progress.csv`` has the same bytes."""
    monkeypatch.setattr("deimos.nn.cpu.MIN_OPERATIONS", 1.0)
    config = replace(CONFIG, num_envs=1500, env_steps=48, selector=selector)
    before, written = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            training.train(*training.start(replace(config, threads=threads), tmp_path / str(threads)))
            written.append((tmp_path / str(threads) / "progress.csv").read_bytes())
    finally:
        torch.set_num_threads(before)
    assert written[0].count(b"\n") == 3
    assert written[1] == written[2] == written[0]


@pytest.mark.parametrize("name", ["p75", "rnd", "vds"])
def test_the_hosts_default_dtype_changes_no_number(name):
    """Where torch's default is float64, a trainer is built and learns in float32, with the same numbers."""
    config, found = replace(CONFIG, selector=None, method=name), []
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            trainer = training.Trainer(config, torch.device("cpu"))
            found.append([str(trainer.iterate()) for _ in range(4)])
        finally:
            torch.set_default_dtype(torch.float32)
    assert found[0] == found[1]


@pytest.mark.parametrize(("limit", "said"), [(0, 0), (20, 0), (19, 1), (10, 1)])
def test_episodes_that_are_too_short_for_a_chosen_goal_are_said(limit, said, caplog):
    """The first goal of an episode is nobody's choice, so one that is chosen lasts T steps only if two fit."""
    config = replace(CONFIG, env=particle.Config(goal_period=10, time_limit=limit))
    training.Trainer(config, torch.device("cpu"))
    words = f"Episodes of {limit} steps have no room for two goals of T = 10"
    assert [words in record.getMessage() for record in caplog.records] == [True] * said


def test_seed_reaches_everything():
    """The seed decides the weights of every network, their noise and order of learning, and the worlds and goals."""
    one, other = (training.Trainer(replace(CONFIG, seed=seed), torch.device("cpu")) for seed in (3, 4))
    for part in (
        lambda trainer: trainer.ppo.actor.mean[0].weight,
        lambda trainer: trainer.ppo.critic[0].weight,
        lambda trainer: trainer.ppo.generator.get_state(),
        lambda trainer: trainer.loop.selector.fear.network[0].weight,
        lambda trainer: trainer.loop.selector.fear.generator.get_state(),
        lambda trainer: trainer.env.tensors["position"],
        lambda trainer: trainer.env.tensors["goal"],
        lambda trainer: trainer.env.sample_goals(torch.arange(2), 3),
        lambda trainer: trainer.env.draw(torch.arange(2)),
    ):
        assert not torch.equal(part(one), part(other))


def test_what_led_to_an_invalid_state_is_left_out():
    """Every transition of a world since its last reset gets weight 0 when the world breaks, and no other one."""
    rollout = Rollout(5, 3, 12, 3, torch.device("cpu"))
    rollout.terminated[1, 0] = True  # world 0 is reset after step 1 and breaks at step 3
    rollout.invalid[3, 0] = rollout.truncated[3, 0] = True
    rollout.invalid[0, 1] = rollout.truncated[0, 1] = True  # world 1 breaks at once
    rollout.exclude_invalid()
    expected = torch.tensor([[1, 1, 0, 0, 1], [0, 1, 1, 1, 1], [1, 1, 1, 1, 1]], dtype=torch.float32)
    assert torch.equal(rollout.weight.t(), expected)


def test_too_many_worlds_are_refused_before_memory_is_taken():
    """The message says how much would be needed; nothing is allocated first, or the system would kill the process."""
    with pytest.raises(
        RunError, match=r"2000000000 worlds, each at least \d+ KiB, need more than [\d,]+ GiB of memory, .*use fewer"
    ):
        training.build(TrainConfig(num_envs=2_000_000_000), torch.device("cpu"))


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (RuntimeError("the engine has lost\nits map"), "^the engine has lost its map$"),
        (SimulationError("qpos is not finite"), "^qpos is not finite$"),
        (RuntimeError(), "^RuntimeError$"),
        (ValueError("goal_period must be even"), "^goal_period must be even$"),
        (MemoryError(), r"^64 worlds could not be allocated \(MemoryError\); use fewer"),
        (RuntimeError("Failed to allocate 9 bytes on device 'cpu'"), r"^64 worlds could not be allocated \(Failed to"),
        (RuntimeError("CUDA out of memory"), "^64 worlds could not be allocated"),
        (ValueError("Maximum allowed dimension exceeded"), "^64 worlds could not be allocated"),
    ],
)
def test_what_stops_a_run_from_being_built_is_named(monkeypatch, error, message):
    """Only what is for want of memory is said to be; every other reason is given as it is, in one line."""

    def fail(*arguments):
        raise error

    monkeypatch.setattr(particle.Config, "build", fail)
    with pytest.raises(RunError, match=message):
        training.build(CONFIG, torch.device("cpu"))


def test_exploration_is_addressed_by_world_and_step():
    """The first rollout draws the noise of steps 0 to T - 1, the second goes on after it."""
    trainer = training.Trainer(CONFIG, torch.device("cpu"))
    steps, worlds = CONFIG.ppo.num_steps, torch.arange(CONFIG.num_envs)
    for first in (0, steps):
        trainer.iterate()
        numbers = torch.arange(first, first + steps).unsqueeze(1)
        expected = normals(CONFIG.seed, Purpose.EXPLORATION, worlds, numbers, 3)
        assert torch.equal(trainer.rollout.noise, expected)


@pytest.mark.parametrize(("period", "window"), [(24, 48), (100, 200), (8, 32)])
def test_outcomes_last_from_one_update_to_the_next(period, window):
    """They are kept for 2 T steps, and where a rollout is longer than T for the rollout and T more."""
    config = replace(CONFIG, env=replace(CONFIG.env, goal_period=period))
    assert config.ppo.num_steps == 24
    assert training.Trainer(config, torch.device("cpu")).loop.interactions.window == window


def test_a_rollout_keeps_no_graph():
    """What an environment or a caller hands over with gradients is recorded without."""
    rollout = Rollout(2, 3, 4, 1, torch.device("cpu"))
    wanting = torch.ones(3, requires_grad=True)
    no, yes = torch.zeros(3, dtype=torch.bool), torch.ones(3, dtype=torch.bool)
    rollout.record(
        0, obs=wanting.unsqueeze(1).expand(3, 4), reward=2 * wanting, terminated=no, truncated=yes, invalid=no,
        weight=wanting, cut_off=torch.arange(3),
    )  # fmt: skip
    kept = [value for value in vars(rollout).values() if isinstance(value, torch.Tensor)]
    assert not any(value.requires_grad for value in [*kept, *rollout.cut_off()])


def test_a_run_leaves_all_global_streams_alone():
    """Building, training and saving under selectors with networks moves neither torch's nor NumPy's global stream."""
    before = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    for name in ("p75", "rnd", "vds"):
        config = TrainConfig(
            env=particle.Config(goal_period=4), method=name, ppo=PPOConfig(hidden=(8,)), num_envs=16, evaluation=False
        )
        trainer = training.Trainer(config, torch.device("cpu"))
        for _ in range(2):
            trainer.iterate()
        trainer.load_state_dict(trainer.state_dict())
    assert torch.equal(torch.get_rng_state(), before[0])
    assert str(np.random.get_state()) == str(before[1])  # noqa: NPY002
