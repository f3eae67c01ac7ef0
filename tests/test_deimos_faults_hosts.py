"""Used inside somebody else's program: other defaults of torch, other threads, tensors that want gradients."""

import ast
import contextlib
import dataclasses
import functools
import threading
from pathlib import Path

import pytest
import torch
from torch.utils._device import _device_constructors

import deimos
from deimos.learn.policy import load_policy
from deimos.learn.ppo import PPOConfig
from deimos.nn.host import own_settings
from deimos.run import training
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
CONFIG = TrainConfig(
    env=particle.Config(goal_period=8), method="p75", ppo=PPOConfig(hidden=(8,), num_steps=8, minibatches=2),
    eval=EvalConfig(worlds=8, steps=32, adversary_steps=32), evaluation=False, num_envs=64, env_steps=8 * 4,
    device="cpu", threads=1,
)  # fmt: skip


@contextlib.contextmanager
def default_dtype():
    """A host that computes in float64 where nobody says otherwise."""
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def default_device():
    """A host whose tensors lie elsewhere where nobody says otherwise: where there are no numbers at all."""
    torch.set_default_device("meta")
    try:
        yield
    finally:
        torch.set_default_device(None)


HOSTS = {
    "dtype": default_dtype, "device": default_device, "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16)
}  # fmt: skip


@pytest.fixture(params=HOSTS)
def host(request):
    """A host that prefers something else; gives the context in which it does."""
    return HOSTS[request.param]


def rows(config):
    """What a run's first iterations say, to the last digit."""
    trainer = Trainer(config, CPU)
    return [repr(trainer.iterate()) for _ in range(config.iterations)]


alone = functools.cache(rows)


@pytest.mark.parametrize("method", ["p75", "plr", "grid", "rnd", "vds", "cl", "vds+p75", "swapped"])
def test_a_host_changes_no_number_of_a_run(host, method):
    """Every row of a run is the same whatever dtype, device or precision the program around it prefers."""
    config = dataclasses.replace(CONFIG, method=method)
    expected = alone(config)
    with host():
        assert rows(config) == expected


def test_a_host_changes_no_number_of_a_folder(host, tmp_path):
    """Files of a run, its evaluation under attackers and what its policy does are those of any other program."""
    names = ("progress.csv", "policy.pt", "evaluation.json")
    found = []
    for name, around in (("alone", contextlib.nullcontext), ("inside", host)):
        with around():
            trainer, folder = training.start(CONFIG, tmp_path / name)
            training.train(trainer, folder)
            evaluate_run(folder, CONFIG.env, CONFIG.eval, CPU)
            obs = torch.linspace(-1, 1, 24, dtype=torch.float64, device="cpu").view(2, 12)
            actions = load_policy(folder.path).physical(obs)
            assert training.resume(folder.path)[0].iteration == CONFIG.iterations
        found.append([(folder.path / each).read_bytes() for each in names] + [actions.tolist(), actions.dtype])
    assert found[0] == found[1]
    assert found[0][-1] == torch.float32


def preferences():
    """Default dtype and device, and whether autocast is on; torch 2.7's ``get_default_device`` misses contexts."""
    return torch.get_default_dtype(), torch.empty(0, dtype=torch.float32).device, torch.is_autocast_enabled("cpu")


def test_a_host_keeps_its_preferences(host):
    """What a host prefers is what it was as soon as we are done, errors included."""
    with host():
        before = preferences()
        with contextlib.suppress(KeyError), own_settings():
            assert preferences()[1:] == (CPU, False)
            raise KeyError
        assert before == preferences()


FLOATS = {"zeros", "ones", "empty", "full", "rand", "randn", "linspace", "eye"}


def test_tensors_name_their_dtype():
    """Nothing is made in the default dtype, which is the whole process's and so the host's."""
    wrong = []
    for path in sorted(Path(deimos.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Call(func=ast.Attribute(value=ast.Name("torch"), attr=made)) if made in FLOATS:
                    if "dtype" not in {keyword.arg for keyword in node.keywords}:
                        wrong.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert not wrong


def test_tensors_in_given_memory_name_their_device():
    """Where a host has a default device, ours is the CPU, and torch refuses memory that is elsewhere, as on a GPU.

    The first calls show what torch does; then nothing that makes a tensor is given memory without its device.
    """
    memory = torch.empty(3, dtype=torch.int64, device="meta")
    with default_device(), own_settings():
        with pytest.raises(RuntimeError, match="does not match device type of out"):
            torch.randperm(3, out=memory)
        torch.randperm(3, out=memory, device=memory.device)
    made, wrong = {each.__name__ for each in _device_constructors()}, []
    for path in sorted(Path(deimos.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Call(func=ast.Attribute(value=ast.Name("torch"), attr=name)) if name in made:
                    if {"out", "device"} & {keyword.arg for keyword in node.keywords} == {"out"}:
                        wrong.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert not wrong


def test_two_threads_train_as_one_does():
    """Trainers that two threads build and run at the same time begin and go on as each does alone."""
    configs = [dataclasses.replace(CONFIG, seed=seed) for seed in range(4)]
    expected, found = [rows(config) for config in configs], {}
    before = torch.get_rng_state()
    begin = threading.Barrier(len(configs))

    def work(config):
        begin.wait()
        found[config.seed] = rows(config)

    threads = [threading.Thread(target=work, args=(config,)) for config in configs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [found[config.seed] for config in configs] == expected
    assert torch.equal(torch.get_rng_state(), before)


def nothing(obs):
    """A critic that expects no rewards."""
    return obs.new_zeros(obs.shape[:-1])


class Impatient(particle.Particle):
    """A plug-in's worlds that have no time limit and cut themselves off now and then."""

    def step(self, action):
        """One step, after whose third a world of three is truncated."""
        step = super().step(action)
        step.truncated[::3] = ~step.terminated[::3] & (self.episode_step[::3] >= 3)
        return step


def test_a_flag_counts_whoever_sets_it(monkeypatch):
    """Worlds that a plug-in truncates without a time limit are reset, and no advantage runs across."""
    monkeypatch.setattr(particle, "Particle", Impatient)
    trainer = Trainer(dataclasses.replace(CONFIG, method="uniform"), CPU)
    assert trainer.env.time_limit == 0
    trainer.collect()
    cut = trainer.rollout.truncated
    assert cut[:, ::3].any(0).all()
    assert not cut[:, 1::3].any()
    assert int(trainer.env.episode_step[::3].max()) <= 3
    ended = cut.int().cumsum(0) - cut.int() > 0  # steps after a world's first cut
    trainer.rollout.estimate(nothing)
    before = trainer.rollout.advantage.clone()
    trainer.rollout.reward += 1000.0 * ended
    trainer.rollout.estimate(nothing)
    changed = trainer.rollout.advantage != before
    assert changed[ended].all()
    assert not changed[~ended].any()
