"""Running statistics of observations: rsl_rl's numbers, in the policy, in a checkpoint, and nobody else's to change."""

from dataclasses import replace

import pytest
import torch
from rsl_rl.modules import EmpiricalNormalization

from deimos.checks import SimulationError
from deimos.learn.policy import load_policy
from deimos.learn.ppo import PPO, PPOConfig
from deimos.nn.layout import ALL
from deimos.nn.normalizer import Normalizer
from deimos.run import training
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle

CPU, GENERATOR = torch.device("cpu"), torch.Generator().manual_seed(0)
CONFIG = TrainConfig(
    env=particle.Config(goal_period=16, max_speed=40.0, spawn_range=900.0), method="p25",
    ppo=PPOConfig(hidden=(16, 16), normalize_observations=True), evaluation=False,
    num_envs=64, env_steps=240, device="cpu", threads=1,
)  # fmt: skip


def batches(count=8, size=7):
    """Observations whose components have means and deviations of their own, and drift."""
    generator = torch.Generator().manual_seed(0)
    scale, middle = 10.0 ** torch.linspace(-2, 2, size), torch.linspace(-5, 5, size)
    return [torch.randn(50 + 30 * i, size, generator=generator) * scale + middle * (1 + 0.1 * i) for i in range(count)]


def trained(path, config=CONFIG, iterations=None):
    """Train to the end, or for a number of iterations; the trainer and the folder."""
    trainer, folder = training.start(config, path, None)
    training.train(trainer, folder, stopped=lambda: trainer.iteration == iterations)
    return trainer, folder


def test_statistics_are_rsl_rls():
    """After batches of several sizes mean, variance, count and what comes out agree with rsl_rl's to rounding."""
    ours, theirs = Normalizer(7), EmpiricalNormalization(7)
    for batch in batches():
        ours.update(batch, torch.ones(len(batch)))
        theirs.update(batch)
        # Float32 sums of some hundred numbers.
        torch.testing.assert_close(ours.mean, theirs.mean, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(ours.variance.sqrt(), theirs.std, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(ours(batch), theirs(batch), rtol=1e-4, atol=1e-4)
    assert ours.count == theirs.count


def test_statistics_are_those_of_all_observations():
    """However they are divided, mean and variance are those of everything together."""
    ours, together = Normalizer(7), torch.cat(batches()).double()
    for batch in batches():
        ours.update(batch, torch.ones(len(batch)))
    torch.testing.assert_close(ours.mean.double(), together.mean(0), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(ours.variance.double(), together.var(0, unbiased=False), rtol=1e-4, atol=1e-9)


def test_what_weighs_nothing_does_not_count():
    """Observations of weight 0 change nothing, even where a whole batch weighs nothing, the first one included."""
    first, second = batches(2)
    ours, expected = Normalizer(7), Normalizer(7)
    ours.update(1e6 * second, torch.zeros(len(second)))
    assert torch.equal(ours(second), expected(second))
    ours.update(torch.cat([first, 1e6 * second]), torch.tensor([1.0] * len(first) + [0.0] * len(second)))
    expected.update(first, torch.ones(len(first)))
    torch.testing.assert_close(ours.mean, expected.mean, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(ours.variance, expected.variance, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("sees", ["actor", "critic"])
def test_what_a_network_does_not_see_does_not_reach_it(sees):
    """With statistics for all components an actor, or a critic, still depends on those alone that it sees."""
    only, hidden = torch.tensor([0, 1, 4]), torch.tensor([2, 3])
    ppo = PPO(
        PPOConfig(hidden=(8,), normalize_observations=True), 20, 5, 2, CPU, 0,
        actor_sees=only if sees == "actor" else ALL, critic_sees=only if sees == "critic" else ALL,
    )  # fmt: skip
    ppo.actor.normalizer.update(torch.randn(20, 5, generator=GENERATOR) * 3.0 + 1.0, torch.ones(20))
    obs = torch.randn(20, 5, generator=GENERATOR)
    changed = obs.clone()
    changed[:, hidden] += 1.0
    action, value = [ppo.actor(x) for x in (obs, changed)], [ppo.value(x) for x in (obs, changed)]
    assert torch.equal(*action) == (sees == "actor")
    assert torch.equal(*value) == (sees == "critic")
    mean = torch.empty(20, 2)
    ppo.act(obs, torch.zeros(20, 2), torch.empty(20, 2), mean)
    torch.testing.assert_close(mean, action[0], rtol=1e-5, atol=1e-6)


def test_a_statistic_that_is_not_finite_is_named():
    """The check of the learner finds statistics too."""
    ppo = PPO(PPOConfig(hidden=(8,), normalize_observations=True), 20, 5, 2, CPU, 0)
    ppo.check()
    ppo.actor.normalizer.variance[2] = torch.inf
    with pytest.raises(SimulationError, match=r"actor\.normalizer\.variance is not finite"):
        ppo.check()


def test_a_run_resumes_with_its_statistics_bit_for_bit(tmp_path):
    """Stopped and resumed it writes the rows of the run that never stopped, on other numbers of threads too."""
    whole, folder = trained(tmp_path / "whole")
    trained(tmp_path / "stopped", replace(CONFIG, threads=3), iterations=4)
    trainer, resumed = training.resume(tmp_path / "stopped")
    training.train(trainer, resumed)
    assert resumed.read_csv("progress.csv") == folder.read_csv("progress.csv")
    assert whole.ppo.actor.normalizer.count == 240 * 64
    for ours, theirs in zip(trainer.ppo.actor.buffers(), whole.ppo.actor.buffers(), strict=True):
        assert torch.equal(ours, theirs)
    plain, _ = trained(tmp_path / "plain", replace(CONFIG, ppo=PPOConfig(hidden=(16, 16))), iterations=4)
    assert not list(plain.ppo.actor.buffers())


def test_a_policy_brings_its_statistics_and_evaluation_leaves_them_alone(tmp_path):
    """The saved policy acts as the trained actor does, and neither acting nor an evaluation changes its statistics."""
    trainer, folder = trained(tmp_path / "run", iterations=4)
    policy = load_policy(folder.path)
    obs = torch.randn(30, trainer.env.obs_dim, generator=GENERATOR)
    bound = trainer.env.action_bound
    assert torch.equal(policy.scaled(obs), trainer.ppo.actor(obs).clamp(-bound, bound))
    before = policy.actor.state_dict()
    assert before["normalizer.count"] == 4 * CONFIG.num_envs * CONFIG.ppo.num_steps
    rows = evaluate_run(folder, CONFIG.env, EvalConfig(worlds=50, steps=100, attackers=()), CPU)
    assert len(rows) == 1
    assert all(torch.equal(v, load_policy(folder.path).actor.state_dict()[k]) for k, v in before.items())


def test_networks_with_and_without_statistics_do_not_mix(tmp_path):
    """--init-from refuses networks that saw normalised observations where these are not, and says so."""
    _, folder = trained(tmp_path / "run", iterations=1)
    plain = replace(CONFIG, ppo=PPOConfig(hidden=(16, 16)))
    with pytest.raises(training.RunError, match=r"do not fit this run.*normalizer"):
        training.start(plain, tmp_path / "other", folder.path)
