"""What cells measure late in their training: exact ranks, fear against the truth, maps of goals, speeds."""

import dataclasses
import math

import pytest
import torch

from deimos.goals.selector import GoalSelector
from deimos.learn.ppo import PPOConfig
from deimos.run import audit, training
from deimos.run.attackers.scripted import Scripted
from deimos.run.audit import audit_choices, audit_clones
from deimos.run.oracle import Clones, Oracle
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle
from deimos.study import audits

CONFIG = TrainConfig(
    env=particle.Config(goal_period=10, max_speed=200.0, max_force=200.0), method="uniform", num_envs=64,
    ppo=PPOConfig(hidden=(8,), epochs=1), evaluation=False, device="cpu", threads=1,
)  # fmt: skip
CPU = torch.device("cpu")


def trained(**changes):
    """A trainer after some iterations, in which particles crash."""
    trainer = Trainer(dataclasses.replace(CONFIG, **changes), CPU)
    for _ in range(4):
        trainer.iterate()
    return trainer


class Follower:
    """A policy that follows its goals wherever they lead, without exploration."""

    std = torch.zeros(3)

    def __init__(self, env):
        self.act = env.reference_policy(brake=False)

    def __call__(self, obs):
        """Actions for observations."""
        return self.act(obs)


def test_audited_choices_of_the_oracle_are_the_worst():
    """Who knows the truth and wants a crash chooses at the top of every context, Uniform in its middle on average."""
    for rule, percentile, least, most in (("percentile", 0.0, 35.0, 65.0), ("argmax", 0.0, 75.0, 100.0)):
        trainer = trained()
        trainer.ppo.actor = Follower(trainer.env)
        exact = Clones(lambda count: CONFIG.env.build(count, CPU, 0), trainer.ppo.actor)
        oracle = Oracle(trainer.env, exact, rule, percentile, candidates=audit.CANDIDATES)
        trainer.loop.selector = trainer.loop.core.selector = oracle
        found = audit_choices(trainer, 64, audit_clones(trainer))
        assert len(found.percentile) > 20
        assert least < sum(found.percentile) / len(found.percentile) < most
        assert found.auroc == []


def test_goals_of_a_selectors_own_are_judged_too():
    """Who makes goals instead of picking candidates is measured by these: the worst that a person can think of."""
    trainer = trained()
    trainer.ppo.actor = Follower(trainer.env)
    trainer.loop.selector = trainer.loop.core.selector = Scripted(trainer.env)
    found = audit_choices(trainer, 64, audit_clones(trainer))
    assert len(found.percentile) > 20
    assert sum(found.percentile) / len(found.percentile) > 75
    assert torch.equal(found.chosen.abs(), torch.ones_like(found.chosen))


def test_a_curriculum_chooses_from_its_range():
    """What is audited of ``cl`` are goals of the range that it has got to, judged among goals of the whole range."""
    trainer = trained(method="cl")
    tried = []
    clones = audit_clones(trainer)
    try_out = clones.try_out
    clones.try_out = lambda env, rows, goals: tried.append(goals) or try_out(env, rows, goals)
    found = audit_choices(trainer, 64, clones)
    share = trainer.loop.selector.share[0]
    assert share < 1.0
    assert 0.5 * share < found.chosen.abs().max() <= share + 1e-6
    assert tried[0].abs().max() > 0.9
    picked = (tried[0] == found.chosen.unsqueeze(1)).all(2)
    assert bool((picked.sum(1) == 1).all())


def test_audited_worlds_count_once():
    """As many worlds as are asked for give one decision each, wherever their goals stand, inside their boxes."""
    trainer = trained()
    found = audit_choices(trainer, 16, audit_clones(trainer))
    assert 0 < len(found.place) <= 16
    assert found.place.shape == found.chosen.shape == (len(found.place), 3)
    assert bool((found.place.abs() <= 1.0).all())
    assert bool((found.chosen.abs() <= 1.0 + 1e-6).all())


def test_decisions_together_are_decisions_one_by_one(monkeypatch):
    """Trying the candidates of all worlds at the end gives what trying them at the moment of each choice gives."""
    trainer = trained()
    clones = audit_clones(trainer)
    held = []
    try_out = clones.try_out

    def note(env, rows, goals):
        held.append((env, goals))
        return try_out(env, rows, goals)

    monkeypatch.setattr(clones, "try_out", note)
    audit_choices(trainer, 64, clones)
    ((worlds, candidates),) = held
    other = trained()
    moments = []

    class Watcher(GoalSelector):
        num_candidates = 1

        def propose(self, rows, state, goal, candidates, draws):
            moments.append((candidates, {name: tensor[rows].clone() for name, tensor in other.env.tensors.items()}))
            return uniform.propose(rows, state, goal, candidates, draws)

    uniform = other.loop.selector
    other.loop.selector = Watcher()
    audit_choices(other, 64, audit_clones(other))
    seen = [(goals, state) for goals, state in moments if goals.shape[1] > 1]
    assert torch.equal(torch.cat([goals for goals, _ in seen]), candidates)
    for name, tensor in worlds.tensors.items():
        assert torch.equal(torch.cat([state[name] for _, state in seen]), tensor), name


@pytest.mark.parametrize("variant", ["directional", "relative", "absolute"])
def test_dangerous_and_safe_places_of_particles(variant):
    """Half of the particles are at rest 1 u from a wall, half at the origin, and their observations say so."""
    env = particle.Config(variant=variant, spawn_range=500.0).build(8, CPU, 0)
    risky, safe = env.risk_contrast()
    assert sorted([*risky.tolist(), *safe.tolist()]) == list(range(8))
    assert env.place(risky).tolist() == [[pytest.approx(-0.999), 0.0, 0.0]] * 4
    assert env.place(safe).abs().max() == 0.0
    torch.testing.assert_close(env.obs[risky, 3:6], env.place(risky))
    assert env.obs[safe, :9].abs().max() == 0.0
    assert env.obs[:, :3].abs().max() == 0.0
    low, high = env.goal_bounds(torch.arange(8))
    assert bool(((env.goal >= low) & (env.goal <= high)).all())


def test_stairs_are_told_from_flat_ground():
    """Of a robot's worlds those on stairs that see a step are dangerous, those on flat ground that see none safe."""
    from deimos.sim.legged.task import Locomotion

    class Ground:
        device, obs_dim, points = CPU, 6, range(4)

        def __init__(self, *shapes, step=0.05):
            self.shapes = shapes
            self.obs = torch.tensor([0.0, 9.0, 1.0, 1.0, 1.0 + 5.0 * step, 1.0]).repeat(len(shapes), 1)
            self.obs[[shape == "flat" for shape in shapes], 2:] = 1.0

        def tiles(self):
            return [(shape, 0) for shape in self.shapes]

    risky, safe = Locomotion.risk_contrast(Ground("stairs-up", "flat", "waves", "stairs-down"))
    assert (risky.tolist(), safe.tolist()) == ([0, 3], [1])
    level = Ground("stairs-up", "slope-up", step=0.01)
    assert [rows.tolist() for rows in Locomotion.risk_contrast(level)] == [[], [1]]
    edge = Ground("stairs-up", "slope-up")
    assert [rows.tolist() for rows in Locomotion.risk_contrast(edge)] == [[0], []]
    assert Locomotion.risk_contrast(Ground("stairs-up", "waves")) is None
    assert Locomotion.risk_contrast(Ground("waves", "slope-up")) is None


def test_the_ground_of_studies_has_stairs_and_flat_places():
    """Robots on the rough ground of the presets stand on stairs, and on slopes of level 0, which are flat."""
    from deimos.run.presets import preset

    env = preset("quad-rough").env.for_evaluation().resolved(CPU).build(audits.PLACES, CPU, 0)
    tiles, seen, counts, flat = env.tiles(), [], [0, 0], set()
    for _ in range(audits.SPAWNS):
        risky, safe = env.risk_contrast()
        assert {tiles[i][0] for i in risky.tolist()} == {"stairs-up", "stairs-down"}
        flat |= {tiles[i] for i in safe.tolist()}
        counts = [counts[0] + len(risky), counts[1] + len(safe)]
        seen.append(env.obs[:, -1].clone())
        env.reset(torch.ones(audits.PLACES, dtype=torch.bool))
        assert env.tiles() == tiles
    assert flat == {("slope-up", 0), ("slope-down", 0)}
    assert counts[0] > 20 * audits.SPAWNS
    assert counts[1] > audits.SPAWNS
    assert len({tuple(each.tolist()) for each in seen}) == audits.SPAWNS


def test_map_counts_places_and_goals():
    """Every axis of every choice is one count, at the place of its world and that of its goal."""
    place, chosen = torch.tensor([[-1.0, 0.0], [1.0, 2.0]]), torch.tensor([[1.0, 0.01], [-1.0, -5.0]])
    table = torch.tensor(audits.goal_map(place, chosen)).view(audits.BINS, audits.BINS)
    last = audits.BINS - 1
    assert table.nonzero().tolist() == [[0, last], [audits.BINS // 2, audits.BINS // 2], [last, 0]]
    assert table[last, 0] == 2
    assert audits.goal_map(place[:0], chosen[:0]) == []


def test_diversity_is_the_entropy_of_goals_given_the_place():
    """It is 1 where goals are uniform at every place, 0 where the place says the goal, and of nothing unknown."""
    size = audits.BINS
    assert audits.diversity([3] * size * size) == pytest.approx(1.0)
    assert audits.diversity(torch.eye(size).flatten().tolist()) == 0.0
    halves = [1.0] * (size // 2) + [0.0] * (size // 2)
    assert audits.diversity(halves * size) == pytest.approx(math.log(size / 2) / math.log(size))
    assert math.isnan(audits.diversity([]))
    assert math.isnan(audits.diversity([0] * size * size))


def test_speed_is_that_of_the_policy(tmp_path):
    """A policy that does nothing has no speed; one that pushes at full force moves at the bound in the end."""
    trainer, folder = training.start(dataclasses.replace(CONFIG, env_steps=24), tmp_path / "run", None)
    for value, least, most in ((0.0, 0.0, 0.0), (1e3, 50.0, 200.0 * math.sqrt(3.0))):
        for parameter in trainer.ppo.actor.parameters():
            parameter.data.zero_()
        list(trainer.ppo.actor.parameters())[-1].data.fill_(value)
        training.save(trainer, folder)
        assert least <= audits.speed(folder, CONFIG.env, 0, CPU) <= most
