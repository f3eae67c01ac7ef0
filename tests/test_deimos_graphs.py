"""Rollouts and updates as CUDA graphs: they replay what Python would have asked for, number for number."""

import copy
import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from replay import Replay, replay_on_cpu
from states import leaves

from deimos.app import console
from deimos.app.train import ResumeOptions
from deimos.checks import RunError
from deimos.goals import methods
from deimos.goals.interactions import Interactions, assign
from deimos.goals.selector import Delegate
from deimos.goals.selectors import boltzmann, learnability, mix, plr, swapped, uniform, vds
from deimos.learn.ppo import PPO, PPOConfig
from deimos.run import training
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim import graphs
from deimos.sim.envs import particle, quad
from deimos.sim.legged.engines.captured import Captured

CPU = torch.device("cpu")
# Crashes, time limits and goals that are due fall on different steps in different worlds, from the first rollout on.
CONFIG = TrainConfig(
    env=particle.Config(
        variant="relative", goal_period=7, time_limit=33, stagger_goals=True, max_speed=150.0, max_force=150.0
    ),
    ppo=PPOConfig(num_steps=12, epochs=2, minibatches=3, hidden=(8,), init_std=80.0, normalize_observations=True),
    num_envs=64, env_steps=12 * 7, evaluation=False,
)  # fmt: skip
SELECTORS = {
    name: replace(selector, epochs=1) if isinstance(selector, vds.Config) else selector  # which learns at length
    for name, selector in zip(methods.METHODS, map(methods.method, methods.METHODS), strict=True)
} | {
    "probing": replace(methods.method("p75"), probe=0.3), "some uniform": mix.Config(base="p75"),
    "plr that replays": plr.Config(capacity=20), "boltzmann": boltzmann.Config(), "swapped": swapped.Config(),
    "learnability": learnability.Config(), "vds, then p75": methods.method("vds+p75"),
}  # fmt: skip
ITERATIONS = 7


def trained(config, device, iterations=ITERATIONS):
    """All that some iterations of a training have come to, by name: rows, the last rollout, and the state."""
    trainer = Trainer(config, device)
    rows = [trainer.iterate() for _ in range(iterations)]
    rollout = {name: value for name, value in vars(trainer.rollout).items() if isinstance(value, torch.Tensor)}
    rollout.pop("last_obs")  # of worlds that were not truncated it may hold anything
    return dict(leaves({"row": rows, "rollout": rollout, "state": trainer.state_dict()})), trainer


def differences(found, expected):
    """Names of what is not the same, bit for bit."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, torch.Tensor | float | int):
            one, other = (torch.as_tensor(number).cpu() for number in (found[name], value))
            same = one.shape == other.shape and ((one == other) | (one.isnan() & other.isnan())).all()
            if not same:
                yield name
        elif found[name] != value:
            yield name


@pytest.fixture
def recording(device, monkeypatch):
    """A device that replays: a GPU its CUDA graphs, a CPU the calls that a stand-in has noted."""
    if device == "cpu":
        replay_on_cpu(monkeypatch)
    return torch.device(device)


@pytest.mark.parametrize("name", SELECTORS)
def test_replays_are_what_python_asks_for(name, recording):
    """Whoever chooses the goals: rows, rollouts, networks, draws and all that is kept have the bits of an eager run."""
    config = replace(CONFIG, selector=SELECTORS[name])
    expected, _ = trained(replace(config, graph="off"), recording)
    found, trainer = trained(replace(config, graph="on"), recording)
    assert not list(differences(found, expected))
    assert trainer._steps._recording is not None
    assert trainer.ppo._fit._recording is not None
    assert trainer.loop.interactions.resolved().crashed.any()


def plant_a_count(monkeypatch):
    """A number that Python counts in every step."""
    propose = uniform.Uniform.propose

    def counting(self, rows, state, goal, candidates, draws):
        self.asked = getattr(self, "asked", 0) + 1
        return propose(self, rows, state, goal, candidates * (1.0 - 1e-3 * self.asked), draws)

    monkeypatch.setattr(uniform.Uniform, "propose", counting)


def plant_a_host_clock(monkeypatch):
    """The time in the interaction, as Python knows it."""
    issue = Interactions.open

    def opened(self, rows, *arguments, where=None, **more):
        issue(self, rows, *arguments, where=where, **more)
        assign(self.issued_at, rows, self.now, where)

    monkeypatch.setattr(Interactions, "open", opened)


def plant_a_schedule(monkeypatch):
    """A coefficient of the update that Python lowers."""
    learn = PPO._learn

    def annealed(self, *arguments, **more):
        self.config = replace(self.config, entropy_coef=0.9 * self.config.entropy_coef)
        return learn(self, *arguments, **more)

    monkeypatch.setattr(PPO, "_learn", annealed)


def plant_another_tensor(monkeypatch):
    """Memory that is replaced and not written."""
    update = PPO.update

    def replacing(self, *arguments, **more):
        self.optimizer._square = self.optimizer._square.clone()
        return update(self, *arguments, **more)

    monkeypatch.setattr(PPO, "update", replacing)


@pytest.mark.parametrize("plant", [plant_a_count, plant_a_host_clock, plant_a_schedule, plant_another_tensor])
def test_what_python_freezes_is_found(plant, monkeypatch):
    """The comparison fails where a rollout or an update depends on what a graph cannot know."""
    replay_on_cpu(monkeypatch)
    expected = trained(replace(CONFIG, method="uniform", graph="off"), CPU, 4)[0]
    assert not list(differences(trained(replace(CONFIG, method="uniform"), CPU, 4)[0], expected))
    plant(monkeypatch)
    expected = trained(replace(CONFIG, method="uniform", graph="off"), CPU, 4)[0]
    assert list(differences(trained(replace(CONFIG, method="uniform"), CPU, 4)[0], expected))


def test_a_recording_that_waits_fails(monkeypatch):
    """Work that reads a number of the device cannot be recorded, which is said in one line with the way out."""
    replay_on_cpu(monkeypatch)
    propose = uniform.Uniform.propose
    monkeypatch.setattr(
        uniform.Uniform, "propose", lambda self, rows, *more: propose(self, rows + int(rows.sum() < 0), *more)
    )
    trainer = Trainer(replace(CONFIG, method="uniform"), CPU)
    trainer.iterate()
    with pytest.raises(RunError, match=r"recorded on cpu; use --graph off: aten._local_scalar_dense.* waits"):
        trainer.iterate()


def test_a_graph_is_recorded_once_for_every_choice_of_python(monkeypatch):
    """The first rollout and update run as they are, the second are recorded; so again once fear chooses."""
    replay_on_cpu(monkeypatch)
    recorded = []

    class Noted(Replay):
        def __init__(self, work, device):
            super().__init__(work, device)
            recorded.append((trainer.iteration, trainer.loop.selector.fear.fitted))

    monkeypatch.setitem(graphs.RECORDERS, "cpu", Noted)
    trainer = Trainer(replace(CONFIG, method="p25", critic_warmup=3), CPU)
    afraid = []
    for _ in range(7):
        afraid.append(trainer.loop.selector.fear.fitted)
        trainer.iterate()
    assert afraid == [False] + [True] * 6
    # Rollouts when the next iteration has not been counted yet, updates when it has: of values alone, and of both.
    assert recorded == [(2, True), (2, True), (5, True)]


def test_who_cannot_be_recorded_is_said_once(monkeypatch, caplog):
    """A selector, an environment or a part that does not say that it may be recorded is run as it is, or refused."""
    replay_on_cpu(monkeypatch)
    caplog.set_level(logging.INFO)
    config = replace(CONFIG, method="uniform")
    for owner, name, value, who in (
        (uniform.Uniform, "dense", False, "Uniform does not say that its choices can be replayed"),
        (uniform.Uniform, "graph_key", lambda self: None, "Uniform does not say that its choices can be replayed"),
        (particle.Particle, "recordable", False, "Particle does not say that its steps can be replayed"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            caplog.clear()
            trainer = Trainer(config, CPU)
            for _ in range(3):
                trainer.iterate()
            assert [record.message for record in caplog.records].count(
                f"Rollouts are not replayed as CUDA graphs: {trainer.loop.why_eager()}."
            ) == 1
            assert who in caplog.text
            assert trainer._steps._recording is None
            assert trainer.ppo._fit._recording is not None
            with pytest.raises(RunError, match=f"graph must be auto or off here, since {who}.*; got on"):
                Trainer(replace(config, graph="on"), CPU)
    monkeypatch.setattr(Delegate, "graph_key", lambda self: None)
    with pytest.raises(RunError, match="Mix does not say"):
        Trainer(replace(config, method=None, selector=mix.Config(base="uniform"), graph="on"), CPU)


def test_a_cpu_has_no_graphs():
    """On a CPU nothing is recorded, and whoever insists is told what to do; so is whoever misspells the switch."""
    config = replace(CONFIG, method="uniform")
    trainer = Trainer(config, CPU)
    for _ in range(3):
        trainer.iterate()
    assert trainer._steps._recording is None
    assert trainer.ppo._fit._recording is None
    with pytest.raises(RunError, match="graph must be auto or off on cpu, where there are no CUDA graphs, got on"):
        Trainer(replace(config, graph="on"), CPU)
    with pytest.raises(ValueError, match="graph must be"):
        replace(config, graph="maybe")


def test_parts_are_told_apart_without_a_graph(monkeypatch):
    """Where the times of a rollout's parts are wanted, it is not replayed, and gives the same numbers."""
    replay_on_cpu(monkeypatch)
    config = replace(CONFIG, method="uniform")
    expected = trained(config, CPU, 5)[0]
    trainer = Trainer(config, CPU)
    rows = []
    for iteration in range(5):
        trainer.synchronise = iteration == 3
        before = trainer.seconds["policy"]
        rows.append(trainer.iterate())
        assert (trainer.seconds["policy"] > before) == (iteration != 2)
    found = dict(leaves({"row": rows, "state": trainer.state_dict()}))
    assert not list(differences(found, {name: value for name, value in expected.items() if name in found}))


def test_a_state_is_loaded_into_what_is_replayed(monkeypatch):
    """A trainer that goes back to an earlier state replays on from there, to the same end."""
    replay_on_cpu(monkeypatch)
    trainer = Trainer(replace(CONFIG, method="p25"), CPU)
    for _ in range(5):
        trainer.iterate()
    state = copy.deepcopy(trainer.state_dict())
    ends = []
    for _ in range(2):
        trainer.load_state_dict(state)
        rows = [trainer.iterate() for _ in range(2)]
        ends.append(dict(leaves({"row": rows, "state": trainer.state_dict()})))
    assert not list(differences(*ends))


def test_a_resumed_run_may_do_without_graphs(tmp_path):
    """A run that is resumed keeps its way with graphs, or takes another one, which its folder then holds."""
    config = replace(CONFIG, method="uniform", env_steps=24, log=(), threads=1)
    training.train(*training.start(config, tmp_path / "run"))
    for graph, expected in ((None, "auto"), ("off", "off"), (None, "off")):
        trainer, folder = training.resume(tmp_path / "run", 36, graph=graph)
        assert trainer.config.graph == training.read_config(folder).graph == expected
    options = console.parse(ResumeOptions, ["--resume", str(tmp_path / "run"), "--graph", "off"], "train")
    assert options.graph == "off"


def test_robots_are_replayed_too(monkeypatch):
    """Robots of mujoco-warp, whose steps and resets are graphs of their own on a CPU, have the bits of an eager run."""
    replay_on_cpu(monkeypatch)
    env = quad.Config(engine="warp", goal_period=7, episode_steps=16)
    ppo = replace(CONFIG.ppo, init_std=3.0, num_steps=8)
    config = replace(CONFIG, env=env, method="rnd", ppo=ppo, num_envs=3, env_steps=8 * 4)
    expected = trained(replace(config, graph="off"), CPU, 4)[0]
    found, trainer = trained(replace(config, graph="on"), CPU, 4)
    assert not list(differences(found, expected))
    assert trainer._steps._recording is not None


def test_a_graph_within_a_graph_is_made_of_its_launches(monkeypatch):
    """While a larger graph is recorded, a captured step makes its launches; afterwards it is replayed again."""
    made, replayed = [], []
    step = Captured(lambda: made.append(len(made)), CPU)
    monkeypatch.setattr(wp, "capture_launch", replayed.append)
    for capturing, launches, replays in ((False, 2, 1), (True, 3, 1), (False, 3, 2)):
        step._device = SimpleNamespace(is_cuda=True, is_capturing=capturing)
        step()
        assert (len(made), len(replayed)) == (launches, replays)
