"""Methods made of others: one after the other, and one with some uniform goals."""

import copy
import io
import math

import pytest
import torch
from scipy import stats
from states import assert_same

from deimos.goals.methods import method
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces
from deimos.goals.selectors import director, mix, penalty, plr, schedule, uniform
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
SPACES = Spaces(num_envs=40, state_dim=9, goal_dim=3, goal_period=4, device=CPU, total_steps=96)


class Recorder(GoalSelector):
    """Takes a fixed candidate, and keeps what it is shown."""

    def __init__(self, place, score, **proposal):
        self.num_candidates = place + 1
        self.place, self.score, self.proposal = place, score, proposal
        self.updates = []

    def propose(self, rows, state, goal, candidates, draws):
        """See ``GoalSelector.propose``."""
        self.draws = draws
        return Proposal(candidates[:, self.place], torch.full_like(draws[:, 0], self.score), **self.proposal)

    def learn(self, interactions, rollout):
        """See ``GoalSelector.learn``."""
        self.updates.append((interactions.now, interactions.resolved().score))
        return {f"recorder/{self.place}": float(interactions.now)}


@pytest.fixture
def recorders(monkeypatch):
    """Methods ``one``, ``two`` and ``noted`` that are recorders, and the recorders that were built."""
    built = {}

    class Config(SelectorConfig):
        def __init__(self, name, *arguments, **proposal):
            self.name, self.arguments, self.proposal = name, arguments, proposal

        def build(self, spaces, seed):
            built[self.name] = Recorder(*self.arguments, **self.proposal)
            return built[self.name]

    noted = {"note": torch.full((4000,), 7), "probe": torch.zeros(4000).bool()}
    known = {"one": Config("one", 0, 1.0), "two": Config("two", 2, 2.0), "noted": Config("noted", 1, 3.0, **noted)}
    for module in (mix, schedule):
        monkeypatch.setattr(module, "method", lambda name: known[name] if name in known else method(name))
    return built


def trainer(selector):
    """A run of four rollouts of 24 steps in 96 small worlds."""
    config = TrainConfig(
        env=particle.Config(goal_period=4, max_speed=200.0, max_force=100.0), selector=selector, num_envs=96,
        env_steps=96, ppo=PPOConfig(hidden=(16,), epochs=1, init_std=100.0), evaluation=False,
    )  # fmt: skip
    return Trainer(config, CPU)


@pytest.mark.parametrize(("at", "switch"), [(0.5, 48), (0.3, 48), (0.2, 24), (0.9, 96)])
def test_it_switches_once_at_its_share(recorders, at, switch):
    """From the first update at or after its share of the training on, the second method chooses, and it stays so."""
    run = trainer(schedule.Config(first="one", second="two", at=at))
    selector = run.loop.selector
    for rollout in range(1, 5):
        row = run.iterate()
        assert row["schedule/switched"] == (24 * rollout > switch)
        assert selector.switched == (24 * rollout >= switch)
        assert selector.current is recorders["two" if selector.switched else "one"]
        assert selector.num_candidates == (3 if selector.switched else 1)
    last = run.loop.interactions.resolved()
    assert (last.score == (2.0 if switch < 80 else 1.0)).all()


def test_the_second_learns_from_the_start_without_the_firsts_scores(recorders):
    """It sees every update, but no score until they are its own; the first learns only as long as it chooses."""
    run = trainer(schedule.Config(first="one", second="two", at=0.5))
    for _ in range(4):
        run.iterate()
    assert [now for now, _ in recorders["one"].updates] == [24, 48]
    assert [now for now, _ in recorders["two"].updates] == [24, 48, 72, 96]
    assert all((score == 1.0).all() for _, score in recorders["one"].updates)
    assert all(score.isnan().all() and len(score) for _, score in recorders["two"].updates[:2])
    assert (recorders["two"].updates[3][1] == 2.0).all()


def test_every_row_has_the_same_columns(recorders):
    """What the first method logs stays as NaN after the switch."""
    run = trainer(schedule.Config(first="one", second="two", at=0.5))
    rows = [run.iterate() for _ in range(4)]
    assert all(list(row) == list(rows[0]) for row in rows)
    assert [row["recorder/0"] for row in rows[:2]] == [24.0, 48.0]
    assert all(math.isnan(row["recorder/0"]) for row in rows[2:])
    assert [row["recorder/2"] for row in rows] == [24.0, 48.0, 72.0, 96.0]


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_it_resumes_over_the_switch(cut):
    """Saved before, on or after the switch and loaded into a fresh run, it ends bit for bit where it would have."""
    config = schedule.Config(first="rnd", second="p75", at=0.5)
    straight, resumed = trainer(config), trainer(config)
    rows = []
    for rollout in range(4):
        if rollout == cut:
            saved = io.BytesIO()
            torch.save(straight.state_dict(), saved)
        rows.append(straight.iterate())
    saved.seek(0)
    resumed.load_state_dict(torch.load(saved, weights_only=True))
    again = [resumed.iterate() for _ in range(4 - cut)]
    assert [list(row) for row in again] == [list(row) for row in rows[cut:]]
    assert repr(again) == repr(rows[cut:])
    assert torch.equal(straight.env.obs, resumed.env.obs)


def test_a_longer_run_keeps_its_switch():
    """A state that is loaded into a run of a larger budget switches when it would have."""
    short = schedule.Config(first="p25", second="p75").build(SPACES, 0)
    longer = schedule.Config(first="p25", second="p75").build(Spaces(40, 9, 3, 4, CPU, total_steps=960), 0)
    longer.load_state_dict(short.state_dict())
    assert longer._switch == 48


def test_it_needs_to_know_the_end():
    """Without the steps of the whole training there is no half of it."""
    with pytest.raises(
        ValueError, match=r"schedule changes over the training, so Spaces\.total_steps must be .*, got 0"
    ):
        schedule.Config().build(Spaces(40, 9, 3, 4, CPU), 0)


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_a_mix_has_its_share_of_uniform_goals(recorders, share):
    """Its share of goals is what Uniform would pick, marked, without score and note; the others are the method's."""
    selector = mix.Config(base="noted", share=share).build(SPACES, 0)
    generator = torch.Generator().manual_seed(0)
    candidates = torch.rand(4000, 30, 3, generator=generator)
    draws = torch.rand(4000, 4, generator=generator)
    arguments = (torch.arange(4000), torch.zeros(4000, 9), torch.zeros(4000, 3), candidates, draws)
    proposal = selector.propose(*arguments)
    free = proposal.probe
    assert abs(free.float().mean().item() - share) <= 4 * math.sqrt(share * (1 - share) / 4000)
    uniform_goals = uniform.Config(candidates=30).build(SPACES, 0).propose(*arguments).goal
    assert torch.equal(proposal.goal, torch.where(free.unsqueeze(1), uniform_goals, candidates[:, 1]))
    assert torch.equal(proposal.score.isnan(), free)
    assert torch.equal(proposal.note, torch.where(free, 0, 7))


def test_the_uniform_goals_of_a_mix_are_not_replayed_ones(recorders):
    """A learner that may learn from its method's goals alone learns from no uniform one."""
    selector = mix.Config(base="noted", share=0.5).build(SPACES, 0)
    selector.parts[0].proposal["weight"] = torch.ones(4000)
    generator = torch.Generator().manual_seed(0)
    arguments = [torch.randn(4000, *shape, generator=generator) for shape in ((9,), (3,), (5, 3))]
    proposal = selector.propose(torch.arange(4000), *arguments, torch.rand(4000, 4, generator=generator))
    assert torch.equal(proposal.weight, (~proposal.probe).float())
    assert 0 < proposal.weight.sum() < 4000


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_a_mixed_method_draws_from_uniform_numbers(recorders, share):
    """Where it chooses, its fourth number is as uniform as the others, though the mix has decided by that one."""
    selector = mix.Config(base="noted", share=share).build(SPACES, 0)
    draws = torch.rand(4000, 4, generator=torch.Generator().manual_seed(0))
    zeros = (torch.zeros(4000, *shape) for shape in ((9,), (3,), (5, 3)))
    free = selector.propose(torch.arange(4000), *zeros, draws).probe
    seen = recorders["noted"].draws
    assert torch.equal(seen[:, :3], draws[:, :3])
    assert share > 0 or torch.equal(seen, draws)
    assert 0 <= seen.min() <= seen.max() < 1
    assert stats.kstest(seen[~free, 3].numpy(), "uniform").pvalue > 1e-3


def test_a_mix_is_its_method_in_all_else():
    """It asks for what the method asks for, learns what it learns and saves what it saves."""
    wrapped, own = (config.build(SPACES, 0) for config in (mix.Config(base="plr-robust"), plr.Config(robust=True)))
    assert (wrapped.num_candidates, wrapped.needs_rollout) == (own.num_candidates, own.needs_rollout)
    assert wrapped.state_dict()["parts"][0].keys() == own.state_dict().keys()
    assert mix.Config(base="cl").build(SPACES, 0).first_goals_scaled
    assert mix.Config(base="cl").build(SPACES, 0).goal_range().tolist() == [0.25] * 3
    critic = mix.Config(base="vds").build(SPACES, 0)
    assert critic.critic() == critic.parts[0].value
    alone, mixed = (trainer(config) for config in (director.Config(percentile=75), mix.Config(base="p75", share=0.0)))
    for _ in range(4):
        assert repr(alone.iterate()) == repr(mixed.iterate())


@pytest.mark.parametrize(
    "config", [mix.Config(base="p75"), penalty.Config(base="p75"), schedule.Config(first="rnd", second="p75")],
    ids=["mix", "penalty", "schedule"],
)  # fmt: skip
def test_what_is_made_of_methods_saves_them_as_its_parts(config):
    """Whoever delegates has one layout of its state: those of its parts, in their order."""
    run = trainer(config)
    run.iterate()
    selector = run.loop.selector
    assert selector.parts[-1].fear.fitted
    assert_same(selector.state_dict()["parts"], [part.state_dict() for part in selector.parts])


def test_a_mix_goes_on_from_what_earlier_versions_saved():
    """A state that is its method's alone continues bit for bit as one with parts."""
    config = mix.Config(base="p75")
    straight, resumed = trainer(config), trainer(config)
    for _ in range(2):
        straight.iterate()
    state = copy.deepcopy(straight.state_dict())
    (state["loop"]["selector"],) = state["loop"]["selector"]["parts"]
    resumed.load_state_dict(state)
    for _ in range(2):
        assert repr(resumed.iterate()) == repr(straight.iterate())


def test_the_baseline_stays_with_the_first():
    """VDS supplies the learner's baseline; after the switch it still does and still learns, while p75 chooses."""
    run = trainer(schedule.Config(first="vds", second="p75", at=0.5))
    for _ in range(2):
        run.iterate()
    selector = run.loop.selector
    assert selector.switched
    assert selector.critic() == selector.parts[0].value
    before = selector.parts[0].nets.parameters.clone()
    assert math.isfinite(run.iterate()["vds/loss"])
    assert not torch.equal(before, selector.parts[0].nets.parameters)
