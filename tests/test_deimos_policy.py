"""The file of a trained policy: it acts as the actor did, in physical units."""

from dataclasses import replace

import pytest
import torch
from short_training import CONFIG

import deimos
from deimos.checks import RunError
from deimos.goals.selectors import uniform
from deimos.run import training
from deimos.run.folder import RunFolder


@pytest.mark.parametrize("obs_scale", ["unit", "raw"])
@pytest.mark.parametrize("variant", ["absolute", "directional", "relative"])
def test_policy_acts_as_the_actor_in_physical_units(tmp_path, variant, obs_scale):
    """The saved policy does for physical observations what the actor does for the environment's, bounded alike."""
    config = replace(
        CONFIG, env=replace(CONFIG.env, variant=variant, obs_scale=obs_scale, max_force=0.3), selector=uniform.Config()
    )
    trainer = training.Trainer(config, torch.device("cpu"))
    trainer.collect()
    with torch.no_grad():  # so that about half of the actions are cut
        size = trainer.ppo.actor(trainer.env.obs).abs().median()
        for parameter in trainer.ppo.actor.mean[-1].parameters():
            parameter *= 0.3 / size
    training.save(trainer, RunFolder.create(tmp_path / "run"))
    policy = deimos.load_policy(tmp_path / "run")

    env, state = trainer.env, trainer.env.tensors
    goal = state["goal"] - state["position"] if variant == "relative" else state["goal"]
    physical = torch.cat([state["velocity"], state["position"], state["force"], goal], dim=1)
    mean = trainer.ppo.actor(env.obs).detach()
    expected = mean.clamp(-0.3, 0.3)
    assert (mean != expected).any()  # some are cut
    assert (mean == expected).any()  # and some are not
    # Scaling back and forth costs a rounding or two of numbers up to 2250, seen through two layers.
    torch.testing.assert_close(policy.physical(physical), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(policy.scaled(env.obs), expected, rtol=0, atol=1e-6)
    assert policy.goal_slice == env.goal_slice
    assert policy.layout == env.layout
    assert [field.unit for field in policy.layout] == [
        "u/step",
        "u",
        "u/step^2",
        "u/step" if variant == "directional" else "u",
    ]
    assert policy.dt == env.dt
    assert policy.action_bound == 0.3


def test_a_policy_does_not_guess_the_units(tmp_path):
    """Called without a word on units, a policy names both ways: scaled twice, observations give plausible actions."""
    trainer = training.Trainer(CONFIG, torch.device("cpu"))
    training.save(trainer, RunFolder.create(tmp_path / "run"))
    policy, obs = deimos.load_policy(tmp_path / "run"), trainer.env.obs
    with pytest.raises(TypeError, match=r"policy\.scaled\(env\.obs\).* or policy\.physical\(obs\)"):
        policy(obs)
    assert torch.equal(policy.physical(obs), policy.scaled(obs * policy.scale))
    assert not torch.allclose(policy.physical(obs), policy.scaled(obs))


def test_policy_without_a_bound_is_not_cut(tmp_path):
    """A policy trained without a bound on the force loads, and its actions are the actor's own."""
    config = replace(CONFIG, env=replace(CONFIG.env, max_force=float("inf")))
    trainer = training.Trainer(config, torch.device("cpu"))
    trainer.ppo.actor.mean[-1].bias.data += 1e6
    training.save(trainer, RunFolder.create(tmp_path / "run"))
    policy = deimos.load_policy(tmp_path / "run" / "policy.pt")
    assert (policy.physical(torch.zeros(2, 12)) > 1e5).all()


def test_missing_or_foreign_policy_is_refused(tmp_path):
    """A folder without a policy, and a file that is none, raise RunError."""
    with pytest.raises(RunError, match="There is no policy at"):
        deimos.load_policy(tmp_path)
    torch.save({"schema": 1, "layout": [], "actor": {}}, tmp_path / "policy.pt")
    with pytest.raises(RunError, match="is not a policy of this version"):
        deimos.load_policy(tmp_path)


def test_a_device_that_is_none_is_no_fault_of_the_file(tmp_path):
    """A name that torch does not know is said in torch's words, and the policy is not called one of another version."""
    training.save(training.Trainer(CONFIG, torch.device("cpu")), RunFolder.create(tmp_path / "run"))
    with pytest.raises(RuntimeError, match="device string: auto"):
        deimos.load_policy(tmp_path / "run", "auto")
