"""When goals end in other people's loops: our clock and theirs, horizons, first goals, executed goals."""

import io
from dataclasses import dataclass

import pytest
import torch

from deimos import GoalDirector
from deimos.goals.fear import FearConfig
from deimos.goals.interactions import Resolved
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig
from deimos.goals.selectors import director

N, PERIOD = 48, 5
AFRAID = director.Config(percentile=75, candidates=20, fear=FearConfig(min_per_class=8))
NOBODY = torch.zeros(N, dtype=torch.bool)
SIZES = {"num_envs": N, "state_dim": 2, "goal_dim": 1, "device": "cpu"}
BOX = (torch.tensor([-1.0]), torch.tensor([1.0]))


class Carts:
    """Carts on a track of 2 m that follow a speed: position [m] and speed [m/s] are their state."""

    def __init__(self, limit=23):
        self.state, self.limit = torch.zeros(N, 2), limit
        self.goal = torch.linspace(-1, 1, N).unsqueeze(1)
        self.age = torch.arange(N) % limit

    def step(self):
        """One step of all carts; returns who has left the track and whose time is up."""
        self.state[:, 1] += 0.5 * (self.goal[:, 0] - self.state[:, 1])
        self.state[:, 0] += 0.2 * self.state[:, 1]
        self.age += 1
        crashed = self.state[:, 0].abs() > 1
        return crashed, (self.age >= self.limit) & ~crashed

    def reset(self, done):
        """Put carts back to the middle, at rest."""
        self.state[done], self.age[done] = 0.0, 0


@dataclass(frozen=True)
class Nearest(SelectorConfig):
    """Chooses the candidate that is nearest to ten times the position, and remembers what it was asked."""

    def build(self, spaces, seed):
        """See ``SelectorConfig.build``."""
        return _Nearest()


class _Nearest(GoalSelector):
    num_candidates = 8

    def __init__(self):
        self.asked = []

    def propose(self, rows, state, goal, candidates, draws):
        """See ``GoalSelector.propose``."""
        self.asked.append((rows.tolist(), state.clone(), goal.clone()))
        pick = (candidates[:, :, 0] - 10 * state[:, :1]).abs().argmin(1)
        return Proposal(candidates[torch.arange(len(rows)), pick], torch.full((len(rows),), torch.nan))


def own(goals, carts):
    """A step under the Director's clock; returns who was done."""
    terminated, truncated = carts.step()
    carts.goal = goals.step(carts.state, carts.goal, terminated, truncated).goal
    carts.reset(terminated | truncated)
    return terminated | truncated


class Theirs:
    """The same step under the loop's own clock of T steps."""

    def __init__(self):
        self.clock = torch.zeros(N, dtype=torch.int64)

    def __call__(self, goals, carts, horizon=None):
        """See ``own``."""
        terminated, truncated = carts.step()
        done = terminated | truncated
        goals.observe(terminated, truncated)
        self.clock += 1
        rows = done | (self.clock >= PERIOD)
        self.clock[rows] = 0
        # Every other time as indices, in any order, as a framework may have them.
        listed = rows.nonzero().squeeze(1).flip(0) if goals.interactions.now % 2 else rows
        carts.goal[listed] = goals.propose(listed, carts.state[listed], carts.goal[listed], horizon=horizon)
        carts.reset(done)
        return done


def same(first, second):
    """Whether two Directors keep the same interactions, bit for bit, and have learnt the same."""
    expected, found = first.interactions.resolved(), second.interactions.resolved()
    for name in Resolved.__dataclass_fields__:
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=0, equal_nan=True)
    ours, theirs = (goals.selector.fear.state_dict()["network"] for goals in (first, second))
    return all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_either_clock_gives_the_same():
    """With equal periods, goals, interactions and what is learnt from them are equal, bit for bit."""
    options = {**SIZES, "learn_every": 12, "goal_box": BOX}
    first, second = (GoalDirector(AFRAID, PERIOD, **options) for _ in range(2))
    ours, theirs, step = Carts(), Carts(), Theirs()
    crashes = 0
    for now in range(96):
        own(first, ours)
        step(second, theirs)
        assert torch.equal(ours.goal, theirs.goal)
        if now % 12 != 11:  # where an update is due, ours has been made, theirs begins the next step
            assert same(first, second)
        crashes += int(first.interactions.resolved().crashed.sum())
    assert first.selector.fear.fitted
    assert crashes > 100


@pytest.mark.parametrize("announced", [True, False])
def test_a_clock_whose_periods_vary_gives_the_same_where_they_do_not(announced):
    """Announced horizons of T steps and unannounced ones of at most T resolve as those of a fixed period."""
    first = GoalDirector(Nearest(), PERIOD, goal_box=BOX)
    second = GoalDirector(Nearest(), max_horizon=PERIOD, goal_box=BOX, **SIZES)
    ours, theirs, step = Carts(), Carts(), Theirs()
    for _ in range(60):
        own(first, ours)
        step(second, theirs, PERIOD if announced else None)
        assert torch.equal(ours.goal, theirs.goal)
        expected, found = (goals.interactions.resolved() for goals in (first, second))
        order = [done.env * 1000 + done.resolved for done in (expected, found)]
        for name in ("env", "state", "goal", "next_goal", "crashed", "issued", "resolved", "horizon"):
            assert torch.equal(*(getattr(d, name)[o.argsort()] for d, o in zip((expected, found), order, strict=True)))
    assert len(expected) > N


def small(**options):
    """A Director of two worlds on somebody else's clock, with what it was asked first: goals of 0.5 and -0.5."""
    goals = GoalDirector(Nearest(), max_horizon=10, **{"goal_box": BOX} | options)
    state = torch.tensor([[0.05, 0.0], [-0.05, 0.0]])
    no = torch.zeros(2, dtype=torch.bool)
    goals.propose(None, state, torch.zeros(2, 1), horizon=10 if options.get("horizon_input") else None)
    goals.observe(no, no)
    return goals, state, no


def test_a_goal_without_a_horizon_lasts_up_to_the_next_proposal():
    """It is survived then, and its horizon is what it has lasted; one in its first step is replaced."""
    goals, state, no = small()
    goal = goals.propose(None, state, torch.zeros(2, 1))
    goal[1:] = goals.propose([1], state[1:], goal[1:])  # twice in one step: the second one counts
    for _ in range(3):
        goals.observe(no, no)
    goals.propose([0], state[:1], goal[:1])
    goals.observe(no, no)
    goals.propose([1], state[1:], goal[1:])
    done = goals.interactions.resolved()
    assert done.env.tolist() == [0, 1]
    assert done.horizon.tolist() == [3, 4]
    assert not done.crashed.any()
    assert torch.equal(done.next_goal, goal)


def test_a_goal_that_ends_before_its_announced_horizon_is_dropped():
    """Whether it would have been survived is not known; a crash within it is."""
    goals, state, no = small()
    goal = goals.propose(None, state, torch.zeros(2, 1), horizon=[6, 4])
    for _ in range(3):
        goals.observe(no, no)
    goals.propose([0], state[:1], goal[:1], horizon=6)
    assert len(goals.interactions.resolved()) == 0
    goals.observe(torch.tensor([True, False]), no)
    done = goals.interactions.resolved()
    assert (done.env.tolist(), done.crashed.tolist(), done.horizon.tolist()) == ([0, 1], [True, False], [6, 4])
    for _ in range(3):  # what happens to the second world after its horizon is no outcome of its goal
        goals.observe(torch.tensor([False, True]), no)
    assert len(goals.interactions.resolved()) == 2


def test_a_horizon_at_the_time_limit_keeps_its_label():
    """A world that is cut off in the last step of its goal has survived it; one step earlier it is dropped."""
    goals, state, no = small()
    goals.propose(None, state, torch.zeros(2, 1), horizon=[3, 4])
    for cut in (no, no, ~no):
        goals.observe(no, cut)
    done = goals.interactions.resolved()
    assert (done.env.tolist(), done.crashed.tolist()) == ([0], [False])


def test_horizons_are_an_input_of_fear():
    """What fear is learnt from has the share of the longest horizon behind the state, and fear asks for it."""
    goals, state, no = small(horizon_input=True)
    with pytest.raises(ValueError, match="horizon must be given where it is an input of the fear network, got None"):
        goals.propose(None, state, torch.zeros(2, 1))
    goals.propose(None, state, torch.zeros(2, 1), horizon=[2, 5])
    for _ in range(5):
        goals.observe(no, no)
    done = goals.interactions.resolved()
    assert torch.equal(done.state, torch.cat([state, torch.tensor([[0.2], [0.5]])], dim=1))

    goals = GoalDirector(AFRAID, max_horizon=20, horizon_input=True, goal_box=BOX, learn_every=10, **SIZES)
    carts, generator = Carts(10**6), torch.Generator().manual_seed(0)
    for _ in range(400):
        crashed, _ = carts.step()
        goals.observe(crashed, NOBODY)
        rows = crashed | (torch.rand(N, generator=generator) < 0.15)
        horizon = torch.where(torch.rand(N, generator=generator) < 0.5, 2, 20)[rows]
        carts.goal[rows] = goals.propose(rows, carts.state[rows], carts.goal[rows], horizon=horizon)
        carts.reset(crashed)
    at, now, new = torch.tensor([[0.5, 0.0]]), torch.zeros(1, 1), torch.ones(1, 1)
    short, long = (goals.fear(at, now, new, horizon).probability.item() for horizon in (2, 20))
    assert long > short + 0.2  # half a metre takes more than two steps
    assert goals.fear(at, now, new).probability.item() == long


@pytest.mark.parametrize("clock", ["own", "theirs"])
def test_first_goals_are_chosen_from_the_start_state_and_a_null_goal(clock):
    """Every decision after an end is one of the selector, in the start state, and an interaction from there on."""
    goals, carts = GoalDirector(Nearest(), PERIOD, goal_box=BOX, first_goals="chosen", **SIZES), Carts()
    carts.goal = goals.propose(None, carts.state, carts.goal)
    assert goals.interactions.active.all()
    for _ in range(40):
        terminated, truncated = carts.step()
        done = terminated | truncated
        carts.reset(done)
        carts.state[done, 1] = 0.07  # where episodes begin
        before = len(goals.selector.asked)
        if clock == "own":
            carts.goal = goals.step(carts.state, carts.goal, terminated, truncated).goal
        else:
            goals.observe(terminated, truncated)
            carts.goal[done] = goals.propose(done, carts.state[done], carts.goal[done])
        asked = {
            row: (s, g) for rows, *rest in goals.selector.asked[before:] for row, s, g in zip(rows, *rest, strict=True)
        }
        for world in done.nonzero().squeeze(1).tolist():
            state, goal = asked[world]
            assert torch.equal(state, torch.tensor([0.0, 0.07]))
            assert torch.equal(goal, torch.zeros(1))
        assert goals.interactions.active[done].all()
    first = goals.interactions.resolved()
    assert (first.state[:, 1] == 0.07).any()


def test_a_task_with_one_goal_an_episode_has_a_director():
    """Chosen first goals that last as long as the episode crash or survive; uniform ones are no interactions."""
    for first_goals in ("chosen", "uniform"):
        goals = GoalDirector(AFRAID, max_horizon=12, first_goals=first_goals, goal_box=BOX, learn_every=48, **SIZES)
        carts, crashed = Carts(12), []
        carts.goal = goals.propose(None, carts.state, carts.goal)
        for _ in range(120):
            terminated, truncated = carts.step()
            done = terminated | truncated
            goals.observe(terminated, truncated)
            carts.reset(done)
            carts.goal[done] = goals.propose(done, carts.state[done], carts.goal[done])
            crashed.append(goals.interactions.resolved().crashed)
        if first_goals == "uniform":
            assert sum(map(len, crashed)) == 0
        else:
            assert 0.1 < crashed[40].float().mean() < 0.9  # as long as goals are uniform
            assert goals.metrics["fear/chosen"] == 1.0  # from the first update on every goal is the network's choice


def test_fear_is_learnt_of_what_was_executed():
    """A report in a goal's first step replaces it; later ones, and steps without one, do not."""
    goals, no = GoalDirector(Nearest(), 3, goal_box=BOX), torch.zeros(2, dtype=torch.bool)
    state, goal = torch.zeros(2, 2), torch.zeros(2, 1)
    for _ in range(3):
        goal = goals.step(state, goal, no, no).goal
    clipped, later = goal.clamp(-0.01, 0.01) + 0.02, goal * 0.0
    given = goals.step(state, clipped, no, no, executed=clipped)
    assert torch.equal(given.goal, clipped)
    goals.step(state, later, no, no, executed=later)
    goals.step(state, goal, no, no)
    done = goals.interactions.resolved()
    assert torch.equal(done.next_goal, clipped)
    assert len(done) == 2


@pytest.mark.parametrize("clock", [own, Theirs()])
def test_it_resumes_on_either_clock(clock):
    """Saved, loaded into a fresh one that was told no sizes, and driven on, it does what it would have done."""
    options = {"learn_every": 10, "goal_box": BOX, "first_goals": "chosen"}
    first, carts = GoalDirector(AFRAID, PERIOD, **options, **SIZES), Carts()
    for _ in range(50):  # an update is due
        clock(first, carts)
    saved = io.BytesIO()
    torch.save(first.state_dict(), saved)
    saved.seek(0)
    second, others = GoalDirector(AFRAID, PERIOD, **options), Carts()
    second.load_state_dict(torch.load(saved, weights_only=True))
    others.state, others.goal, others.age = carts.state.clone(), carts.goal.clone(), carts.age.clone()
    other_clock = clock
    if clock is not own:
        other_clock = Theirs()
        other_clock.clock = clock.clock.clone()
    for _ in range(30):
        clock(first, carts)
        other_clock(second, others)
        assert torch.equal(carts.goal, others.goal)
        assert same(first, second)
    assert repr(first.metrics) == repr(second.metrics)


def test_state_is_there_before_the_first_call():
    """A Director that has not begun saves and loads, and begins as a fresh one."""
    fresh, loaded = (GoalDirector(AFRAID, PERIOD, goal_box=BOX) for _ in range(2))
    loaded.load_state_dict(fresh.state_dict())
    ours, theirs = Carts(), Carts()
    for _ in range(20):
        own(fresh, ours)
        own(loaded, theirs)
    assert same(fresh, loaded)
