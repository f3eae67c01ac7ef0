"""Crash memory: fear goes on learning when crashes become rare, and cannot tell when a state was met."""

import dataclasses
import io
import itertools
import logging
import math

import pytest
import torch

from deimos import GoalDirector
from deimos.goals import crash_memory
from deimos.goals.crash_memory import DRAWN, HALF_LIFE, PARTNERS, PRESENT, YOUNGEST, CrashMemory
from deimos.goals.fear import FearConfig
from deimos.goals.fear_selector import LEAST, FearEstimate
from deimos.goals.interactions import Interactions, Resolved
from deimos.goals.methods import method
from deimos.goals.selector import Spaces
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
PERIOD, ROLLOUT = 20, 6


class History:
    """Everything that became of a goal, in a training whose policy crashes less and less, and what is known of it."""

    def __init__(self, synchronous, steps=900, seed=0):
        generator = torch.Generator().manual_seed(seed)
        worlds = 400  # 20 goals are due in a step, as in Particle Gym
        begin = torch.zeros(worlds) if synchronous else torch.randint(PERIOD, (worlds,), generator=generator)
        issued = (begin.unsqueeze(1) + torch.arange(0, steps, PERIOD)).long().flatten()
        risk = 0.4 * torch.exp(-issued / 80)
        self.crashed = torch.rand(len(issued), generator=generator) < risk
        after = torch.randint(1, PERIOD + 1, issued.shape, generator=generator)
        self.issued, self.resolved = issued, issued + torch.where(self.crashed, after, PERIOD)

    def window(self, now):
        """What was resolved in the last 2 T steps; the rows hold the step of issue and the class."""
        known = (self.resolved <= now) & (self.resolved > now - 2 * PERIOD)
        crashed, issued = self.crashed[known], self.issued[known]
        n = len(issued)
        zeros = torch.zeros(n)
        window = Resolved(
            env=torch.arange(n), state=zeros.view(n, 1), goal=zeros.view(n, 1), next_goal=zeros.view(n, 1), score=zeros,
            reward=zeros, tracking=zeros.view(n, 1), probe=zeros.bool(), note=zeros.long(), crashed=crashed,
            issued=issued, resolved=self.resolved[known], horizon=torch.full((n,), PERIOD),
        )  # fmt: skip
        return torch.stack([issued.float(), crashed.float()], dim=1), window


def memory(capacity=64, seed=0):
    return CrashMemory(capacity, PERIOD, 2, CPU, seed)


def lived(own, history, until, since=0):
    """The memory after all rollouts from ``since`` to ``until``, and what it says to learn from in each."""
    samples = {}
    for now in range(since + ROLLOUT, until + 1, ROLLOUT):
        rows, window = history.window(now)
        own.store(rows, window, now)
        samples[now] = own.sample(rows, window)
    return samples


def weighted_auroc(score, positive, weight):
    """How often a positive outranks a negative where pairs count by the product of their weights."""
    pairs = weight[positive].unsqueeze(1) * weight[~positive]
    above = (score[positive].unsqueeze(1) > score[~positive]).double()
    ties = (score[positive].unsqueeze(1) == score[~positive]).double()
    return ((above + 0.5 * ties) * pairs).sum().item() / pairs.sum().item()


@pytest.mark.parametrize("synchronous", [True, False])
def test_age_does_not_give_the_class_away(synchronous):
    """By the weights of the fit a row's age alone tells crashes from survivals with an AUROC of at most 0.6."""
    history = History(synchronous)
    samples = lived(memory(), history, 900)
    found = [
        weighted_auroc(rows[:, 0], crashed, weight.double())  # the step of issue: the younger, the higher
        for rows, crashed, weight in samples.values() if crashed.any()
    ]  # fmt: skip
    assert len(found) > 100
    assert min(found) >= 0.4
    assert max(found) <= 0.6
    # All crashes so far beside the survivals of the last 2 T steps, as a naive memory would have them, give it away.
    _, window = history.window(900)
    old = history.issued[history.crashed]
    ages = 900.0 - torch.cat([old, window.issued[~window.crashed]])
    assert weighted_auroc(ages, torch.arange(len(ages)) < len(old), torch.ones(len(ages)).double()) > 0.9


def test_from_the_first_crash_on_there_is_something_to_learn():
    """Once a crash is T steps old, every rollout has crashes and survivals to learn from, however long none came."""
    history = History(synchronous=True)
    samples = lived(memory(), history, 1800)
    first = int(history.issued[history.crashed].min()) + PERIOD
    assert not history.crashed[history.issued > 700].any()
    for now, (_, crashed, weight) in samples.items():
        if now >= first:
            assert crashed.any()
            assert (~crashed).any()
            assert weight[crashed].sum() > 0
            torch.testing.assert_close(weight[crashed].sum(), weight[~crashed].sum())


def parts_of(own, sample):
    """Its remembered crashes, the present ones, the partners that were drawn and the present survivals, as slices."""
    count, crashes = min(own.stored, len(own._issued)), int(sample[1].sum())
    edges = [0, count, crashes, crashes + count * DRAWN, len(sample[1])]
    return [slice(begin, end) for begin, end in itertools.pairwise(edges)]


def test_what_is_kept_is_what_happened():
    """Rows keep their class; partners were issued within a rollout of their crash or while it waited for survivals."""
    own, history = memory(capacity=1000), History(synchronous=False)
    for now in range(ROLLOUT, 601, ROLLOUT):
        rows, window = history.window(now)
        own.store(rows, window, now)
        sample = own.sample(rows, window)
        rows, crashed, _ = sample
        assert torch.equal(rows[:, 1] == 1, crashed)
        crashes, _, partners, _ = (rows[part, 0] for part in parts_of(own, sample))
        assert ((partners.view(-1, DRAWN) - crashes.unsqueeze(1)).abs() < ROLLOUT).all()


def test_partners_are_the_survivals_next_in_time():
    """Partners are of the crash's step where that has enough, and else a run of survivals around it, without gaps."""
    own, history = memory(capacity=1000), History(synchronous=False)
    rows, window = history.window(2 * PERIOD)
    own.store(rows, window, 2 * PERIOD)
    survived = window.issued[~window.crashed & (window.issued <= PERIOD)]
    assert own.stored > 10
    assert len(survived) > 2 * PARTNERS
    enough = 0
    for crash, partners in zip(own._issued[: own.stored], own._partners[: own.stored, :, 0].long(), strict=True):
        first, last = partners.min(), partners.max()
        if (survived == crash).sum() >= PARTNERS:
            enough += 1
            assert first == last == crash
        else:
            assert first <= crash <= last
            assert int(((survived > first) & (survived < last)).sum()) <= PARTNERS - 2
    assert 0 < enough < own.stored


def test_every_fit_draws_other_partners():
    """Partners of a fit are some of those that are kept with each crash, and in the long run all of them."""
    own, history = memory(capacity=1000), History(synchronous=False)
    rows, window = history.window(2 * PERIOD)
    rows = torch.cat([rows, torch.arange(len(rows)).float().unsqueeze(1)], dim=1)
    own = CrashMemory(1000, PERIOD, 3, CPU, 0)
    own.store(rows, window, 2 * PERIOD)
    seen = [set() for _ in range(own.stored)]
    for _ in range(100):
        sample = own.sample(rows, window)
        drawn = sample[0][parts_of(own, sample)[2], 2].view(own.stored, DRAWN)
        for known, partners in zip(seen, drawn.tolist(), strict=True):
            known.update(partners)
    kept = own._partners[: own.stored, :, 2].tolist()
    assert all(known == set(partners) for known, partners in zip(seen, kept, strict=True))
    assert all(len(set(partners)) == PARTNERS for partners in kept)  # nobody twice


def test_the_present_takes_part():
    """Crashes that are not stored yet and survivals of the window are learnt from, with a bounded share of a class."""
    own, history, shares = memory(capacity=1000), History(synchronous=False), []
    for now in range(ROLLOUT, 301, ROLLOUT):
        rows, window = history.window(now)
        own.store(rows, window, now)
        sample = own.sample(rows, window)
        if not len(sample[0]):
            continue
        issued, weight = sample[0][:, 0], sample[2]
        crashes, waiting, partners, youngest = parts_of(own, sample)
        known = window.issued[window.crashed].float()
        assert torch.equal(issued[waiting].sort().values, known[known > now - PERIOD].sort().values)
        assert len(issued[youngest]) == min(YOUNGEST, int((~window.crashed).sum()))
        for remembered, present in ((crashes, waiting), (partners, youngest)):
            total = weight[remembered].sum() + weight[present].sum()
            torch.testing.assert_close(total, weight[crashes].sum() + weight[waiting].sum())
            shares.append((weight[present].sum() / total).item())
    assert len(shares) > 60
    assert min(shares[1::2]) > 0
    assert max(shares) == pytest.approx(PRESENT)


def test_it_is_bounded_and_keeps_the_newest():
    """It never holds more than its capacity, and holds the crashes that were issued last."""
    own, history = memory(capacity=10), History(synchronous=False)
    sample = list(lived(own, history, 600).values())[-1]
    crashes = sample[0][parts_of(own, sample)[0], 0]
    assert len(crashes) == 10 < own.stored
    known = history.issued[history.crashed & (history.issued <= 600 - PERIOD)].sort().values
    assert crashes.sort().values.tolist() == known[-10:].tolist()
    rows, window = history.window(300)
    own = memory(capacity=3)
    own.store(rows, dataclasses.replace(window, crashed=torch.arange(len(rows)) % 2 == 0), 300)  # more at once
    assert own.stored == 3


def test_weights_fade():
    """A crash that is ``HALF_LIFE`` periods older than another weighs half, and so do its partners."""
    own = memory(capacity=1000)
    sample = list(lived(own, History(synchronous=False), 300).values())[-1]
    weight, issued = sample[2], sample[0][:, 0]
    crashes, _, partners, _ = parts_of(own, sample)
    fade = 0.5 ** ((issued[crashes].max() - issued[crashes]) / (HALF_LIFE * PERIOD))
    assert fade.min() < 0.2
    torch.testing.assert_close(weight[crashes] / weight[crashes].max(), fade)
    of_one = weight[partners].view(-1, DRAWN)
    torch.testing.assert_close(of_one / of_one.max(), fade.unsqueeze(1).expand(-1, DRAWN))


def test_crashes_wait_for_survivals():
    """Crashes of a time without survivals are stored with the first ones that come."""
    own = memory(capacity=1000)
    rows, window = History(synchronous=True).window(2 * PERIOD)
    alone = dataclasses.replace(window, crashed=torch.ones_like(window.crashed))
    own.store(rows, alone, 2 * PERIOD)
    assert own.stored == 0
    own.store(rows, window, 2 * PERIOD)
    assert own.stored == int((window.crashed & (window.issued <= PERIOD)).sum()) > 0
    own.store(rows, window, 2 * PERIOD)  # nothing is stored twice
    assert own.stored == int((window.crashed & (window.issued <= PERIOD)).sum())


def test_it_resumes_bit_for_bit():
    """Saved to a file and loaded into another one, it samples what the one that never stopped samples."""
    history, own, other = History(synchronous=False), memory(), memory(seed=7)
    lived(own, history, 300)
    saved = io.BytesIO()
    torch.save(own.state_dict(), saved)
    saved.seek(0)
    other.load_state_dict(torch.load(saved, weights_only=True))
    for one, two in zip(
        lived(own, history, 600, since=300).values(), lived(other, history, 600, since=300).values(), strict=True
    ):
        assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def training(name, num_envs=128, variant="directional", **changes):
    """A run whose policy crashes often."""
    env = particle.Config(variant=variant, goal_period=8, max_speed=200.0, max_force=100.0)
    selector = dataclasses.replace(method(name), candidates=20, **changes)
    ppo = PPOConfig(hidden=(16,), epochs=1, init_std=100.0)
    return Trainer(TrainConfig(env=env, selector=selector, ppo=ppo, num_envs=num_envs, evaluation=False), CPU)


def test_fear_never_freezes():
    """When crashes end, a Director with memory is fitted in every rollout; the literal one stops, and its age grows."""
    last = {}
    for name in ("p75", "p75-literal"):
        run = training(name)
        rows = [run.iterate() for _ in range(3)]
        assert not math.isnan(rows[-1]["fear/loss"])
        run.ppo.actor.std.data.fill_(1e-3)  # from now on nobody moves
        for parameter in run.ppo.actor.parameters():
            parameter.data.mul_(1e-3)
        run.ppo.optimizer.step = lambda: None
        rows = [run.iterate() for _ in range(7)]
        assert rows[-1]["fear/crash_rate"] == 0
        assert all(row["fear/chosen"] == 1 for row in rows)
        last[name] = rows
    assert all(row["fear/age"] == 0 and math.isfinite(row["fear/loss"]) for row in last["p75"])
    ages = [row["fear/age"] for row in last["p75-literal"]]
    assert ages[-1] >= 4
    assert math.isnan(last["p75-literal"][-1]["fear/loss"])


@pytest.mark.parametrize("name", ["coop", "p0", "p10", "p25", "p50", "p75", "p90", "antagonist"])
@pytest.mark.parametrize("variant", ["directional", "absolute", "relative"])
def test_fear_is_fitted_in_every_rollout(variant, name):
    """From T steps after the first crash on, when survivals of its time are known, no rollout goes without a fit."""
    run = training(name, num_envs=64, variant=variant)
    rows = [run.iterate() for _ in range(6)]
    crashed = [row["fear/crash_rate"] > 0 for row in rows]
    begin = crashed.index(True) + 1  # a rollout is longer than T
    assert begin < 4
    assert all(math.isfinite(row["fear/loss"]) for row in rows[begin:])
    assert all(row["fear/age"] == 0 for row in rows[begin:])
    assert all(row["fear/chosen"] == 1 for row in rows[begin + 1 :])


def test_the_prior_is_that_of_the_last_two_periods():
    """It is (c + 1/2) / (n + 1) of what was resolved in the window, whatever is remembered, and never 0."""
    run = training("p75")
    for _ in range(3):
        run.iterate()
        window = run.loop.interactions.resolved()
        share = (int(window.crashed.sum()) + 0.5) / (len(window) + 1)
        assert run.loop.selector.calibration.prior == pytest.approx(math.log(share / (1 - share)))


def test_names_tell_what_fear_learns_from():
    """``-literal`` has no memory, ``-threshold`` 0.1.0's rule too; the plain names have memory."""
    assert method("p75").memory > 0
    assert FearConfig().min_per_class == 1
    assert method("p75-literal") == director.Config(percentile=75, memory=0)
    assert method("p33-threshold") == director.Config(percentile=33, memory=0, fear=FearConfig(min_per_class=32))
    assert method("antagonist-literal") == director.Config(rule="argmax", memory=0)
    for name in ("uniform-literal", "p101-literal", "p75-", "-literal", "p75-literal-literal-x"):
        with pytest.raises(ValueError, match=f"Unknown method '{name}'"):
            method(name)
    with pytest.raises(ValueError, match="memory must be at least 0, got -1"):
        director.Config(memory=-1)


def test_literal_fear_learns_from_the_window_alone():
    """Without memory the rows of a fit are the interactions of the last 2 T steps, and all of a class weigh alike."""
    run = training("p75-literal")
    selector, kept = run.loop.selector, []
    assert selector.memory is None
    selector.fit = lambda rows, crashed, weight: kept.append((rows, crashed, weight)) or 0.0
    run.iterate()
    window = run.loop.interactions.resolved()
    ((rows, crashed, weight),) = kept
    assert torch.equal(rows, torch.cat([window.state, window.goal, window.next_goal], dim=1))
    assert torch.equal(crashed, window.crashed)
    assert (weight == 1).all()


def goals_of(director_, steps=60):
    """Let a GoalDirector serve four worlds, one of which crashes now and then."""
    no, goal = torch.zeros(4, dtype=torch.bool), torch.zeros(4, 2)
    generator = torch.Generator().manual_seed(0)
    for t in range(steps):
        crash = no.clone()
        crash[t % 4] = t % 7 == 6
        state, candidates = torch.randn(4, 3, generator=generator), torch.rand(4, 9, 2, generator=generator)
        goal = director_.step(state, goal, crash, no, candidates).goal
    return director_


def test_fear_tells_its_quality():
    """A GoalDirector's estimate holds the probabilities, the AUROC of its forecasts and how long ago it learnt."""
    goals = goals_of(GoalDirector("p75", goal_period=4, learn_every=6))
    told = goals.fear(torch.zeros(5, 3), torch.zeros(5, 2), torch.zeros(5, 2))
    assert isinstance(told, FearEstimate)
    assert told.probability.shape == (5,)
    assert told.age == 0 == goals.metrics["fear/age"]
    assert repr(told.auroc) == repr(goals.metrics["fear/auroc"])


def test_it_says_once_that_goals_are_uniform_yet(caplog):
    """Before the first fit it says once what it waits for, and logs that no goal was chosen by fear."""
    goals = GoalDirector("p75", goal_period=4, learn_every=6)
    with caplog.at_level(logging.INFO, logger="deimos"):
        no = torch.zeros(4, dtype=torch.bool)
        for _ in range(30):
            goals.step(torch.zeros(4, 3), torch.zeros(4, 2), no, no, torch.zeros(4, 9, 2))
    assert [record.getMessage() for record in caplog.records] == [
        "Goals are uniform until the fear network has seen crashes (1) and as many survivals; "
        "the last 2 T steps had 0 and 0."
    ]
    assert goals.metrics["fear/chosen"] == 0
    assert math.isnan(goals.metrics["fear/age"])


def test_few_crashes_fit_no_temperature():
    """One crash is enough to learn a ranking from, and not to tell over- from underconfidence."""
    spaces = Spaces(num_envs=4, state_dim=3, goal_dim=2, goal_period=5, device=CPU)
    for crashes, moves in ((LEAST - 1, False), (LEAST, True)):
        interactions = Interactions(200, 3, 2, 3, 10, CPU)
        selector = director.Config().build(dataclasses.replace(spaces, num_envs=200), 0)
        rows, zeros = torch.arange(200), torch.zeros(200, 3)
        interactions.open(rows, zeros, zeros[:, :2], zeros[:, :2], torch.full((200,), 3.0), horizon=5)
        interactions.now = 5
        interactions.resolve(rows, rows < crashes, torch.ones(200, dtype=torch.bool))
        selector.learn(interactions, None)
        assert (selector.calibration.temperature != 1.0) == moves


def test_constants_keep_the_promise_on_age():
    """Present rows, were they all younger than what is remembered or older, leave the AUROC of age in 0.4 to 0.6."""
    past = 1 - crash_memory.PRESENT
    assert 1 - past * past / 2 <= 0.6  # both classes have a present, where crashes are the younger
    assert past / 2 >= 0.4
