"""Nothing meets a tensor of another device: on a GPU everything is there, in training, evaluation and other loops."""

import functools
import inspect
from dataclasses import replace

import elsewhere
import pytest
import torch

from deimos.app.figures import draw_calibration
from deimos.goals import methods
from deimos.goals.calibration import evaluate as calibration
from deimos.goals.calibration import reliability
from deimos.goals.director import GoalDirector
from deimos.goals.fear import FearConfig
from deimos.goals.selectors import plr
from deimos.learn.policy import Policy, load_policy, save_policy
from deimos.learn.ppo import PPOConfig
from deimos.run import audit
from deimos.run.evaluation import EvalConfig, evaluate
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle, quad

pytestmark = [
    pytest.mark.own_process,
    pytest.mark.skipif(elsewhere.REGISTER is None, reason="this torch cannot be told of a device from Python"),
]
CONFIG = TrainConfig(
    env=particle.Config(variant="relative", goal_period=7, time_limit=33, max_speed=150.0, max_force=150.0),
    ppo=PPOConfig(num_steps=12, epochs=1, minibatches=3, hidden=(8,), init_std=80.0, normalize_observations=True),
    num_envs=48, evaluation=False,
)  # fmt: skip


def on_its_device(test):
    """A test that is given a device that is not the CPU; not by a fixture, which the test's own process shares."""

    @functools.wraps(test)
    def given(**arguments):
        with elsewhere.device() as device:
            test(device, **arguments)

    known = inspect.signature(test)
    given.__signature__ = known.replace(parameters=[*known.parameters.values()][1:])
    return given


@on_its_device
def test_what_a_gpu_refuses_is_refused(device):
    """Operands, results and masks on the CPU; what CUDA takes from the CPU is taken."""
    there, here = torch.zeros(3, 2, device=device, dtype=torch.float32), torch.ones(3, 2, dtype=torch.float32)
    for meeting in (
        lambda: there + here, lambda: torch.cat([there, here]), lambda: torch.stack([there.sum(), here.sum()]),
        lambda: there.add_(here),
        lambda: torch.add(there, there, out=here), lambda: here.mul_(there.sum()), lambda: here[there[:, 0].long()],
        lambda: there.masked_fill_(here > 0, 0.0), lambda: torch.where(here > 0, there, there),
    ):  # fmt: skip
        with pytest.raises(RuntimeError, match="on the same device"):
            meeting()
    with pytest.raises(TypeError, match=r"Use Tensor\.cpu\(\)"):
        there.numpy()
    there[torch.tensor([0, 2])] = 3.0
    there.mul_(torch.tensor(2.0)).copy_(there + 1.0)
    assert there.device == there[:, 1:].sum(0).device == device
    assert there.cpu().numpy().tolist() == [[7.0, 7.0], [1.0, 1.0], [7.0, 7.0]] == there.tolist()
    assert there.cpu().add_(1.0).sum() != there.sum()


SELECTORS = {name: methods.method(name) for name in ("weighted", "vds+p75", "grid", "fear-novelty", "cl")}
TASKS = {
    "particles": [replace(CONFIG, selector=each) for each in (*SELECTORS.values(), plr.Config(capacity=20))],
    "robots": [replace(CONFIG, env=quad.Config(engine="warp", goal_period=7), num_envs=8, method="p25")],
}  # fmt: skip


def row(trainer):
    """What an iteration says, to the last digit."""
    return {name: repr(value) for name, value in trainer.iterate().items()}


@pytest.mark.parametrize("task", TASKS)
@on_its_device
def test_training_stays_on_its_device(device, task):
    """Rollouts, updates, what selectors learn, reports and saved states."""
    for config in TASKS[task]:
        trainer, again = Trainer(config, device), Trainer(config, device)
        for _ in range(3):
            trainer.iterate()
        again.load_state_dict(trainer.state_dict())
        assert row(again) == row(trainer)


@on_its_device
def test_evaluation_stays_on_its_device(device, tmp_path):
    """A policy that is read from a file, attackers, and audits of its fear."""
    trainer = Trainer(replace(CONFIG, method="p75"), device)
    for _ in range(4):
        trainer.iterate()
    env, ppo = trainer.env, trainer.config.ppo
    made = Policy(trainer.ppo.actor, ppo.hidden, ppo.activation, env.layout, env.action_bound, env.dt)
    save_policy(tmp_path / "policy.pt", made)
    policy = load_policy(tmp_path, str(device))
    assert policy.scaled(env.obs).device == device
    sizes = EvalConfig(
        worlds=16, steps=30, adversary_steps=20, attackers=("argmax", "search", "oracle", "scripted"), oracle_worlds=2,
        fear=FearConfig(epochs=1, minibatches=2),
    )  # fmt: skip
    rows = evaluate(policy.scaled, trainer.config.env, sizes, device)
    assert [row["goals"] for row in rows] == ["naive", *sizes.attackers]
    predictions = audit.audit_calibration(trainer, 30)
    picture = draw_calibration(RunFolder(tmp_path), {name: each[:2] for name, each in predictions.items()})
    assert picture.stat().st_size > 0
    audit.audit_choices(trainer, 8, audit.audit_clones(trainer))


@on_its_device
def test_calibration_is_summed_on_the_host(device):
    """A GPU sums in no fixed order, and pictures want NumPy."""
    probability = torch.linspace(0.01, 0.9, 50, dtype=torch.float32)
    crashed = probability > 0.6
    curve = reliability(probability.to(device), crashed.to(device))
    assert curve.predicted.device == curve.observed.device == curve.count.device == torch.device("cpu")
    assert calibration(probability.to(device), crashed.to(device)) == calibration(probability, crashed)


@on_its_device
def test_a_director_stays_on_its_device(device):
    """On both clocks, with what it learns from and is asked for."""
    generator = torch.Generator().manual_seed(0)

    def noise(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float32).to(device)

    for period, horizon in (({"goal_period": 10}, None), ({"max_horizon": 10}, 5)):
        director = GoalDirector(
            "p75", **period, num_envs=32, state_dim=9, goal_dim=3, device=device, learn_every=20, first_goals="chosen",
            goal_box=([-1.0] * 3, [1.0] * 3), horizon_input=True,
        )  # fmt: skip
        goal = director.propose(None, noise(32, 9), noise(32, 3), horizon=horizon)
        for _ in range(60):
            crashed, cut_off = noise(32) > 1.5, noise(32) < -2.0
            cut_off &= ~crashed
            if horizon is None:
                met = noise(32).sigmoid()
                goal = director.step(noise(32, 9), goal, crashed, cut_off, tracking=met, executed=goal).goal
            else:
                director.observe(crashed, cut_off, executed=goal)
                rows = (crashed | cut_off).nonzero().squeeze(1)
                director.reset(rows)
                goal[rows] = director.propose(rows, noise(32, 9)[rows], goal[rows], horizon=horizon)
        director.load_state_dict(director.state_dict())
        assert goal.device == director.fear(noise(4, 9), noise(4, 3), noise(4, 3)).probability.device == device
        assert director.risk_map(noise(9), noise(3), (0, 1)).probability.shape == (41, 41)
