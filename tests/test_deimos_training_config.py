"""A run's configuration: it comes back from its file whole, and what it does not know is refused."""

import contextlib
import itertools
import json
import math
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import get_type_hints

import pytest
import torch

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.fear import FearConfig
from deimos.goals.methods import METHODS, method
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import director, vds
from deimos.learn.ppo import PPOConfig
from deimos.plugins import load_all
from deimos.run import attackers, presets, training
from deimos.run.config import from_dict, kind, to_dict
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.run.shield import ShieldConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim import envs
from deimos.sim.env import EnvConfig
from deimos.sim.envs import particle
from deimos.sim.legged.engines import PhysicsConfig

CONFIGS = {
    **{f"method {name}": TrainConfig(method=name) for name in METHODS},
    **{f"selector of {name}": TrainConfig(selector=method(name)) for name in METHODS},
    "default": TrainConfig(),
    "all else": TrainConfig(
        env=particle.Config(
            variant="relative", goal_period=7, max_speed=3.3, max_force=float("inf"), goal_range=0.1,
            reward="reciprocal", reward_length=1e-3, spawn_range=999.0, time_limit=55, stagger_goals=True,
            obs_scale="raw", crash_penalty=2.5,
        ),
        selector=director.Config(
            percentile=33.3, rule="argmin", candidates=17, probe=0.05, control="shuffled", memory=3,
            fear=FearConfig(
                hidden=(5,), activation="tanh", learning_rate=0.1, epochs=3, minibatches=2, min_per_class=2, workspace=3
            ),
        ),
        ppo=PPOConfig(
            num_steps=5, epochs=2, minibatches=3, learning_rate=1 / 3, desired_kl=0.0, discount=1.0, gae_lambda=0.0,
            clip=0.1, clip_value=False, value_coef=0.5, entropy_coef=0.0, max_grad_norm=7.0, reward_scale=2.0,
            hidden=(3, 2, 1), activation="elu", init_std=0.7, normalize_observations=True,
        ),
        eval=EvalConfig(
            worlds=3, steps=99, seed=0, adversary_steps=4, attackers=("oracle",), oracle_worlds=2, pool=Path("pool.pt"),
            fear=FearConfig(
                hidden=(9, 9, 9), activation="elu", learning_rate=1.0, epochs=1, minibatches=1, min_per_class=9,
                workspace=1,
            ),
        ),
        evaluation=False, seed=2**32 - 1, num_envs=11, env_steps=13, critic_warmup=3, device="cpu",
        threads=2, tf32=True, graph="off", log=("wandb", "tensorboard"), video_every=4, save_every=5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CONFIGS)
def test_config_round_trips(tmp_path, name):
    """A configuration comes back the same from config.json, infinity included."""
    config = CONFIGS[name]
    folder = RunFolder.create(tmp_path / "run")
    folder.write_json("config.json", {"schema": training.SCHEMA, "config": to_dict(config)})
    assert json.loads((folder.path / "config.json").read_text())["schema"] == training.SCHEMA
    found = training.read_config(folder)
    assert found == config
    assert found.goals == config.goals
    assert hash(found) == hash(config)  # lists have become tuples again


def test_config_differs_from_the_default_in_every_field():
    """The configuration that shall round-trip leaves no field at its default."""

    def same(config, default, name):
        if is_dataclass(config) and type(config) is type(default):
            for field in fields(config):
                yield from same(getattr(config, field.name), getattr(default, field.name), f"{name}.{field.name}")
        elif config == default:
            yield name

    found = list(same(CONFIGS["all else"], replace(TrainConfig(), selector=director.Config()), ""))
    assert found == [".method"]  # which excludes a selector


@pytest.mark.parametrize(
    ("cls", "data", "message"),
    [
        (TrainConfig, {"sed": 1}, "deimos.run.trainer.TrainConfig has no sed; it has: critic_warmup, device, env"),
        (TrainConfig, {"env": {"kind": "moon"}}, "deimos.sim.envs has no 'moon'; it has: .*particle"),
        (EnvConfig, {"variant": "relative"}, "deimos.sim.envs must name its 'kind'"),
        (SelectorConfig, {"kind": "director", "percentile": 101}, r"percentile must be in \[0, 100\], got 101"),
    ],
)
def test_config_refuses_what_it_does_not_know(cls, data, message):
    """An unknown field, plugin or value in a stored configuration is named, not skipped."""
    with pytest.raises(ValueError, match=message):
        from_dict(cls, data)


def test_numbers_are_finite_unless_infinity_means_something():
    """Every number of a configuration refuses NaN and, but for two in which it stands for no bound, infinity."""
    plugged = [module.Config() for package in (envs, selectors, attackers) for module in load_all(package).values()]
    accepted = set()
    for config in (PPOConfig(), FearConfig(), PhysicsConfig(), ShieldConfig(), *plugged):
        names = [name for name, hint in get_type_hints(type(config)).items() if hint in (float, float | None)]
        for name, value in itertools.product(names, (math.inf, -math.inf, math.nan)):
            with contextlib.suppress(ValueError):
                replace(config, **{name: value})
                accepted.add((type(config), name, value))
    assert accepted == {(particle.Config, "max_force", math.inf), (vds.Config, "clip", math.inf)}


def test_a_field_that_is_gone_is_read_with_the_value_that_it_has_today():
    """A stored Director without a gate is one of today; one behind a gate, and a gate that is not stored, are refused.

    The checkpoint of the former resumes.
    """
    plain = to_dict(director.Config()) | {"gate": False}
    assert from_dict(SelectorConfig, plain, stored=True) == director.Config()
    with pytest.raises(ValueError, match="Config has no gate; it has: candidates"):
        from_dict(SelectorConfig, plain | {"gate": True}, stored=True)
    with pytest.raises(ValueError, match="Config has no gate; it has: candidates"):
        from_dict(SelectorConfig, plain)
    trainer = Trainer(TrainConfig(num_envs=4, evaluation=False, device="cpu"), torch.device("cpu"))
    state = trainer.state_dict()
    state["made_for"]["selector"]["gate"] = False
    trainer.load_state_dict(state)


def test_a_preset_is_a_training_configuration():
    """Every environment has a preset of its own name, and every preset builds a configuration for its environment."""
    for name in plugins.names(envs):
        assert presets.environment(name) == name
    for name in presets.names():
        assert kind(presets.preset(name).env) == presets.environment(name)
    with pytest.raises(ValueError, match=r"Unknown preset 'nonsense'; choose from: .*particle"):
        presets.preset("nonsense")
