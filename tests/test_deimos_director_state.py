"""A GoalDirector's state: saved and refused, dropped by a reset, unchanged by a call that fails, kept for an update."""

import copy
import io
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from states import assert_same

from deimos import GoalDirector
from deimos.checks import SimulationError
from deimos.goals import core
from deimos.goals.fear import FearConfig
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig
from deimos.goals.selectors import director

N, PERIOD = 16, 5
AFRAID = director.Config(percentile=75, candidates=8, fear=FearConfig(min_per_class=4))
BOX = ([-1.0], [1.0])
NO = torch.zeros(N, dtype=torch.bool)


def crashes_at(step, share=0.08):
    """Who crashes in a step, whatever it does, bool, shape (N,)."""
    return torch.rand(N, generator=torch.Generator().manual_seed(step)) < share


def driven(goals, steps, goal=None, begin=0):
    """Drive it on its own clock; returns the goals."""
    goal = torch.zeros(N, 1) if goal is None else goal
    for step in range(begin, begin + steps):
        state = torch.rand(N, 2, generator=torch.Generator().manual_seed(step))
        goal = goals.step(state, goal, crashes_at(step), NO).goal
    return goal


def made(**options):
    """One that has learnt, and the goals that it gave last."""
    goals = GoalDirector(**{"selector": AFRAID, "goal_period": PERIOD, "goal_box": BOX, "learn_every": 10} | options)
    return goals, driven(goals, 43)


@pytest.mark.parametrize("autoreset", ["SameStep", "NextStep"])
@pytest.mark.parametrize("first_goals", ["uniform", "chosen"])
def test_a_reset_drops_what_is_pending_and_counts_nothing(autoreset, first_goals):
    """In the listed worlds an episode begins: what was pending teaches nothing, and the next goal is a first one."""
    goals, goal = made(autoreset=autoreset, first_goals=first_goals)
    interactions = goals.interactions
    now, known, pending = interactions.now, len(interactions.resolved()), interactions.active.clone()
    rows = torch.arange(N) % 2 == 0
    assert pending[rows].any()
    goals.reset(rows)
    assert torch.equal(interactions.active, pending & ~rows)
    given = goals.propose(rows, torch.full((8, 2), 0.5), torch.zeros(8, 1))
    assert torch.equal(interactions.active, pending & ~rows | (rows if first_goals == "chosen" else NO))
    assert (interactions.now, len(interactions.resolved())) == (now, known)
    assert goals.selector.fear.fitted
    goal[rows] = given
    changes = torch.zeros(N, dtype=torch.int64)
    for _ in range(PERIOD):
        step = goals.step(torch.zeros(N, 2), goal, NO, NO)
        goal, changes = step.goal, changes + step.changed
        assert not changes[rows].any() or interactions.now == now + PERIOD
    assert (changes == 1).all()  # of all worlds within T steps, of these after T steps


def test_a_reset_before_the_first_call_changes_nothing():
    """Worlds are not known then, and begin with first goals anyway."""
    first, second = (GoalDirector(AFRAID, PERIOD, goal_box=BOX) for _ in range(2))
    second.reset()
    assert torch.equal(driven(first, 12), driven(second, 12))
    with pytest.raises(ValueError, match=r"rows must be worlds in \[0, 16\), each once, got \[16\]"):
        second.reset([16])


@dataclass(frozen=True)
class Counting(SelectorConfig):
    """Uniform goals by a selector that keeps what it has been shown."""

    def build(self, spaces, seed):
        """See ``SelectorConfig.build``."""
        return _Counting()


class _Counting(GoalSelector):
    def __init__(self):
        self.upto, self.seen = 0, []

    def propose(self, rows, state, goal, candidates, draws):
        """See ``GoalSelector.propose``."""
        return Proposal(candidates[:, 0], torch.full((len(rows),), torch.nan))

    def learn(self, interactions, rollout):
        """See ``GoalSelector.learn``."""
        new = interactions.resolved(self.upto)
        self.upto = interactions.now
        self.seen += zip(new.env.tolist(), new.resolved.tolist(), new.crashed.tolist(), strict=True)
        return {}


@pytest.mark.parametrize("options", [{}, {"first_goals": "chosen"}, {"first_goals": "chosen", "autoreset": "NextStep"}])
@pytest.mark.parametrize("learn_every", [1, 7, 100])
def test_every_outcome_is_shown_to_the_selector(learn_every, options):
    """However far apart updates are, and however soon worlds crash."""
    shown, expected = GoalDirector(Counting(), PERIOD, goal_box=BOX, learn_every=learn_every, **options), []
    plain = GoalDirector(Counting(), PERIOD, goal_box=BOX, learn_every=1000, **options)
    goal = torch.zeros(N, 1)
    for step in range(300):
        crashed = crashes_at(step, 0.3)
        state = torch.zeros(N, 2)
        given, goal = (goals.step(state, goal, crashed, NO).goal for goals in (shown, plain))
        assert torch.equal(given, goal)
        done = plain.interactions.resolved(step)
        expected += zip(done.env.tolist(), done.resolved.tolist(), done.crashed.tolist(), strict=True)
    assert len(expected) > 250
    last = 300 // learn_every * learn_every
    assert sorted(shown.selector.seen) == sorted(row for row in expected if row[1] <= last)


def test_the_crash_memory_gets_every_crash():
    """It takes over what was issued T steps ago, also where updates are many periods apart."""
    stored = []
    for learn_every in (PERIOD, 120):
        goals = GoalDirector(AFRAID, PERIOD, goal_box=BOX, learn_every=learn_every)
        driven(goals, 240)
        stored.append(goals.selector.memory.stored)
    assert stored[0] == stored[1] > 50


def test_worlds_that_crash_at_once_count_in_full():
    """The share of crashes is that of the last 2 T steps, where half of the worlds live for three steps."""
    period = 40
    goals = GoalDirector(AFRAID, period, goal_box=BOX, first_goals="chosen", learn_every=10)
    goal, doomed = torch.zeros(N, 1), torch.arange(N) < N // 2
    for step in range(1, 201):
        state = doomed.float().unsqueeze(1).expand(N, 2)
        goal = goals.step(state, goal, doomed & (step % 3 == 0), NO).goal
    window = [step for step in range(201 - 2 * period, 201) if step % 3 == 0]
    crashes, survivals = len(window) * N // 2, 2 * N // 2
    share = (crashes + 0.5) / (crashes + survivals + 1.0)
    assert goals.selector.calibration.prior == pytest.approx(math.log(share / (1 - share)))


def test_memory_for_short_goals_is_bounded(monkeypatch):
    """Where more would not fit the newest outcomes of every world are kept."""
    monkeypatch.setattr(core, "RING", 0)
    goals = GoalDirector(AFRAID, 40, goal_box=BOX, first_goals="chosen", learn_every=10)
    goal = torch.zeros(N, 1)
    for _ in range(20):
        goal = goals.step(torch.zeros(N, 2), goal, ~NO, NO).goal
    done = goals.interactions.resolved()
    assert len(done) == core.SPARE * N
    assert done.resolved.min() == 20 - core.SPARE + 1


def test_fear_is_learnt_where_goals_are_far_shorter_than_they_may_be(monkeypatch):
    """Outcomes make way long before T steps have passed; crashes are remembered all the same."""
    monkeypatch.setattr(core, "RING", 0)
    sizes = {"num_envs": N, "state_dim": 2, "goal_dim": 1, "device": "cpu"}
    goals = GoalDirector(AFRAID, max_horizon=100, goal_box=BOX, first_goals="chosen", learn_every=10, **sizes)
    state, worlds = torch.zeros(N, 2), torch.arange(N)
    goal, crashes = goals.propose(None, state, torch.zeros(N, 1)), 0
    for step in range(1, 202):
        crashed = crashes_at(step, 0.15) & (worlds >= 2)  # the first two pursue one goal for T steps
        goals.observe(crashed, NO)
        rows = crashed | ((worlds + step) % torch.where(worlds < 2, 100, 5) == 0)
        goal[rows] = goals.propose(rows, state[rows], goal[rows])
        crashes += int(crashed.sum())
    assert goals.selector.fear.fitted
    assert 0.8 * crashes < goals.selector.memory.stored <= crashes


OTHERS = {
    "selector": ({"selector": "uniform"}, "selector='.*director.Config', got one with selector='.*uniform.Config'"),
    "percentile": ({"selector": director.Config(percentile=25, candidates=8)}, "percentile=75"),
    "hidden": ({"selector": director.Config(fear=FearConfig(hidden=(8,)))}, r"fear.hidden=\(64,\)"),
    "period": ({"goal_period": 6}, "goal_period=5, got one with goal_period=6"),
    "seed": ({"seed": 3}, "seed=0, got one with seed=3"),
    "goal_box": ({"goal_box": ([-1.0], [2.0])}, r"goal_box=\[\[-1.0\], \[1.0\]\], got one with .*\[2.0\]"),
    "first_goals": ({"first_goals": "chosen"}, "first_goals='uniform', got one with first_goals='chosen'"),
    "autoreset": ({"autoreset": "NextStep"}, "next_step=False, got one with next_step=True"),
}


@pytest.mark.parametrize("other", OTHERS)
def test_the_state_of_another_director_is_refused(other):
    """What differs is named, and nothing is written."""
    options, message = OTHERS[other]
    state = made(**options)[0].state_dict()
    goals, _ = made()
    before = goals.state_dict()
    with pytest.raises(ValueError, match=f"state must come from a GoalDirector with .*{message}"):
        goals.load_state_dict(state)
    assert_same(goals.state_dict(), before)


def test_options_of_numpy_are_saved_as_pythons():
    """A state can be read as ``torch.load`` reads by default, whatever kind of number the options were."""
    options = {"goal_period": np.int64(PERIOD), "seed": np.uint32(0), "num_envs": np.int64(N), "state_dim": np.int64(2)}
    goals, _ = made(selector=director.Config(percentile=np.float64(75), candidates=np.int64(8)), **options)
    saved = io.BytesIO()
    torch.save(goals.state_dict(), saved)
    saved.seek(0)
    other, _ = made(selector=director.Config(percentile=75, candidates=8))
    other.load_state_dict(torch.load(saved, weights_only=True))
    assert_same(other.state_dict(), goals.state_dict())


def test_a_state_that_is_damaged_is_refused():
    """Something missing, or of another size, deep in it: a ValueError, and nothing is written."""
    goals, _ = made()
    before, whole = goals.state_dict(), made()[0].state_dict()
    lacking, cut, grown, empty = (copy.deepcopy(whole) for _ in range(4))
    del lacking["goals"]["core"]["selector"]["memory"]
    cut["goals"]["core"]["selector"]["fear"]["network"]["0.weight"] = torch.zeros(8, 4)
    grown["goals"]["asked"] = torch.zeros(N + 1, dtype=torch.int64)
    del empty["goals"]["goal"]
    for state in (lacking, cut, grown, empty):
        with pytest.raises(ValueError, match=r"state must be what state_dict.* of this version returned, got "):
            goals.load_state_dict(state)
        assert_same(goals.state_dict(), before)
    goals.load_state_dict(whole)


def test_a_state_goes_on_with_updates_further_apart():
    """``learn_every`` may differ: what was kept is kept, and of less room the newest outcomes."""
    goals, goal = made(learn_every=3)
    kept = goals.interactions.resolved()
    for learn_every in (3, 60, 2):
        other = GoalDirector(AFRAID, PERIOD, goal_box=BOX, learn_every=learn_every)
        other.load_state_dict(goals.state_dict())
        found = other.interactions.resolved(goals.interactions.now - goals.interactions.window)
        assert len(found) == len(kept) > N
        order = [(done.env * 1000 + done.resolved).argsort() for done in (kept, found)]
        assert torch.equal(kept.state[order[0]], found.state[order[1]])
        driven(other, 130, goal, begin=43)
        back = GoalDirector(AFRAID, PERIOD, goal_box=BOX, learn_every=3)
        back.load_state_dict(other.state_dict())
        last = other.interactions.now - back.interactions.window
        assert len(back.interactions.resolved()) == len(other.interactions.resolved(last)) > N


def test_a_director_that_had_not_begun_forgets_the_worlds():
    """Its state gives back what the constructor knew: sizes are free again, or those that it was made with."""
    fresh = GoalDirector(AFRAID, PERIOD, goal_box=BOX).state_dict()
    goals, _ = made()
    goals.load_state_dict(fresh)
    goals.step(np.zeros((3, 4)), np.zeros((3, 1)), np.zeros(3), np.zeros(3))
    sizes = {"num_envs": N, "state_dim": 2, "goal_dim": 1, "device": "cpu"}
    known, _ = made(**sizes)
    known.load_state_dict(fresh)
    assert known.interactions.now == 0
    assert torch.equal(driven(known, 20), driven(GoalDirector(AFRAID, PERIOD, goal_box=BOX, learn_every=10), 20))


FAULTS = {
    "raises": (lambda rows: [][0], IndexError),
    "not finite": (lambda rows: torch.full((len(rows), 4, 1), torch.nan), ValueError),
    "outside": (lambda rows: torch.full((len(rows), 4, 1), 3.0), ValueError),
    "shape": (lambda rows: torch.zeros(len(rows), 4), ValueError),
    "array": (np.full((N, 4, 1), np.nan), ValueError),
    "device": (torch.zeros(N, 4, 1, device="meta"), ValueError),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_call_that_fails_changes_nothing(fault):
    """Called again as it should have been, it does what it would have done."""
    candidates, error = FAULTS[fault]
    (goals, goal), (twin, _) = made(), made()
    state, crashed = torch.zeros(N, 2), torch.arange(N) < 4
    for call in (
        lambda goals, goal, given: goals.step(state, goal, crashed, NO, given).goal,
        lambda goals, goal, given: goals.propose(None, state, goal, given),
    ):
        before = goals.state_dict()
        with pytest.raises(error):
            call(goals, goal, candidates)
        assert_same(goals.state_dict(), before)
        ours, goal = call(goals, goal, None), call(twin, goal, None)
        assert torch.equal(ours, goal)
    assert_same(goals.state_dict(), twin.state_dict())


def test_missing_candidates_are_told_at_once():
    """Not when the first goals are due."""
    goals, message = (
        GoalDirector(AFRAID, PERIOD),
        "candidates must be given where GoalDirector was made without a goal_box",
    )
    with pytest.raises(ValueError, match=message):
        goals.step(torch.zeros(N, 2), torch.zeros(N, 1), NO, NO)
    with pytest.raises(ValueError, match=message):
        goals.propose(None, torch.zeros(N, 2), torch.zeros(N, 1))


def test_a_first_goal_needs_no_state():
    """On your clock, too, the state of a world that is done may be anything, unless its first goal is chosen."""
    nowhere = torch.full((N, 2), torch.nan)
    sizes = {"num_envs": N, "state_dim": 2, "goal_dim": 1, "device": "cpu", "goal_box": BOX}
    goals = GoalDirector(AFRAID, max_horizon=9, **sizes)
    goal = goals.propose(None, nowhere, torch.zeros(N, 1))
    goals.observe(~NO, NO)
    goal = goals.propose(None, nowhere, goal)
    assert goal.isfinite().all()
    goals.observe(NO, NO)
    with pytest.raises(ValueError, match="state of world 0 must be finite"):
        goals.propose(None, nowhere, goal)
    with pytest.raises(ValueError, match="state of world 0 must be finite"):
        GoalDirector(AFRAID, max_horizon=9, first_goals="chosen", **sizes).propose(None, nowhere, torch.zeros(N, 1))


@pytest.mark.parametrize("size", [3e38, -1e16])
def test_numbers_that_would_spoil_the_networks_are_refused(size):
    """One diverged world leaves them as they were; the message names it."""
    goals, goal = made()
    state = torch.zeros(N, 2)
    state[3, 1] = size
    before = goals.state_dict()
    with pytest.raises(ValueError, match=r"state of world 3 must be at most 1e\+15 in size, got \[0\.0, "):
        goals.step(state, goal, NO, NO)
    with pytest.raises(ValueError, match=r"state of world 5 must be at most 1e\+15 in size, got \[0\.0, "):
        goals.propose([5], state[3:4], goal[5:6])
    with pytest.raises(ValueError, match=r"executed of world 3 must be at most 1e\+15 in size"):
        goals.step(torch.zeros(N, 2), goal, NO, NO, executed=state[:, 1:])
    assert_same(goals.state_dict(), before)
    goals.step(state, goal, torch.arange(N) == 3, NO)  # of a world that is done nobody looks at it
    unbounded = GoalDirector(AFRAID, max_horizon=9)
    with pytest.raises(ValueError, match=r"candidates of world 3 must be at most 1e\+15 in size"):
        unbounded.propose(None, torch.zeros(N, 2), torch.zeros(N, 1), state[:, 1:].unsqueeze(1))


def test_a_network_that_is_not_finite_stops_the_run():
    """After the update that it is found by, and not silently for ever."""
    goals, goal = made()
    goals.selector.fear.network[0].weight.data[0, 0] = torch.nan
    with pytest.raises(SimulationError, match="A weight of the fear network is not finite after a fit"):
        driven(goals, 10, goal, begin=43)
