"""What the Director asks of a GPU in other people's loops, tried on a CPU: no waits, the same goals, late refusals."""

import re
from dataclasses import dataclass

import pytest
import replay
import torch
from replay import counted
from states import leaves
from test_deimos_dense import differences

from deimos import GoalDirector
from deimos.goals import core
from deimos.goals.fear import FearConfig
from deimos.goals.methods import method
from deimos.goals.selector import SelectorConfig
from deimos.goals.selectors import director, q_fear, uniform, weighted

N, PERIOD = 32, 4
AFRAID = {"candidates": 8, "fear": FearConfig(hidden=(8,), min_per_class=2, epochs=2)}
SELECTORS = {
    "p75": director.Config(percentile=75, probe=0.2, **AFRAID), "q-fear": q_fear.Config(**AFRAID),
    "weighted": weighted.Config(**AFRAID), "uniform": method("uniform"), "rnd": method("rnd"), "cl": method("cl"),
    "grid": method("grid"),
}  # fmt: skip
SIZES = {"num_envs": N, "state_dim": 2, "goal_dim": 1, "device": "cpu"}
BOX = ([-1.0], [1.0])
OWN_WAYS = {
    "drawn": {}, "given": {"candidates": torch.linspace(-1, 1, N * 3).view(N, 3, 1)},
    "executed": {"executed": True, "tracking": torch.full((N,), 0.5), "flags": torch.Tensor.float},
    "next step": {"autoreset": "NextStep"}, "chosen": {"first_goals": "chosen"},
}  # fmt: skip


class Carts:
    """Carts on a track that follow a speed; some leave it, some are cut off. What waits is counted by the call."""

    def __init__(self, goals, **way):
        self.goals, self.candidates = goals, way.pop("candidates", None)
        self.executed, self.tracking = way.pop("executed", False), way.pop("tracking", None)
        self.flags, self.hides = way.pop("flags", lambda marks: marks), way.pop("hides")
        self.state, self.goal, self.now = torch.zeros(N, 2), torch.linspace(-1, 1, N).unsqueeze(1), 0
        self.waits = {"step": [], "observe": [], "reset": [], "propose": []}
        self.done = torch.zeros(N, dtype=torch.bool)

    def move(self):
        """One step; returns who has left the track and whose time is up."""
        self.now += 1
        self.state[:, 1] += 0.5 * (self.goal[:, 0] - self.state[:, 1])
        self.state[:, 0] += 0.3 * self.state[:, 1]
        self.state[self.done] = 0.0
        crashed = self.state[:, 0].abs() > 1
        self.done = crashed | ((torch.arange(N) + self.now) % 17 == 0)
        return crashed, self.done & ~crashed

    def call(self, name, *arguments, **named):
        """Call the Director, and count."""
        with counted() as calls:
            found = getattr(self.goals, name)(*arguments, **named)
        self.waits[name].append(dict(calls.waits))
        return found

    def step(self):
        """One step on the Director's clock."""
        ends = [self.flags(marks) for marks in self.move()]
        state = self.state.masked_fill(self.done.unsqueeze(1), torch.nan) if self.hides else self.state
        executed = self.goal if self.executed else None
        given = self.call("step", state, self.goal, *ends, self.candidates, self.tracking, executed)
        self.goal = given.goal

    def theirs(self, horizon=None):
        """One step on a clock of its own, with worlds by indices, in any order, or by a mask."""
        crashed, cut_off = self.move()
        self.call("observe", crashed, cut_off, tracking=self.tracking, executed=self.goal)
        self.call("reset", torch.tensor([self.now % N]))
        mask = self.done | ((torch.arange(N) * 7 + self.now) % 5 == 0) | torch.tensor(self.now % 10 == 0)
        rows = mask.nonzero().squeeze(1).flip(0)
        listed, horizon = (rows, mask)[self.now % 2], horizon and torch.full((len(rows),), horizon)
        self.goal[listed] = self.call("propose", listed, self.state[listed], self.goal[listed], horizon=horizon)


def driven(selector, clock, learn_every=8, **way):
    """A Director after some steps of carts, and all of their goals."""
    own = {name: way.pop(name) for name in ("autoreset", "first_goals") if name in way}
    period = {"goal_period": PERIOD} if clock == "own" else {"max_horizon": 6}
    goals = GoalDirector(selector, **period, goal_box=BOX, learn_every=learn_every, **SIZES, **own)
    horizon = way.pop("horizon", None)
    carts, seen = Carts(goals, hides="first_goals" not in own, **way), []
    carts.goal = goals.propose(None, carts.state, carts.goal, horizon=horizon)
    for _ in range(3 * learn_every + (clock == "theirs")):  # up to an update
        carts.step() if clock == "own" else carts.theirs(horizon)
        seen.append(carts.goal.clone())
    return goals, torch.stack(seen), carts.waits


def both(monkeypatch, *arguments, **way):
    """Goals and states of the same steps, as on a CPU and as on a GPU, and what waited on the latter."""
    with monkeypatch.context() as patch:
        replay.as_on_gpu(patch)
        patch.setattr(core, "AS_ON_GPU", False)
        listed, expected, _ = driven(*arguments, **way)
        patch.setattr(core, "AS_ON_GPU", True)
        dense, found, waits = driven(*arguments, **way)
        assert torch.equal(found, expected)
        states = (dict(leaves(goals.state_dict())) for goals in (dense, listed))
        assert not list(differences(*states))
    return dense, waits


def only_updates_wait(waits, learn_every=8):
    """Whether nothing has waited but for updates, in the steps that make them."""
    for name, calls in waits.items():
        for now, found in enumerate(calls, 1):
            update = (name == "step" and now % learn_every == 0) or (name == "observe" and now % learn_every == 1)
            assert update or not found, (name, now, found)


@pytest.mark.parametrize("way", OWN_WAYS)
def test_a_step_waits_for_nothing_and_gives_the_same(way, monkeypatch):
    """However it is told, every goal and all that is learnt is that of a CPU, and only updates read the device."""
    goals, waits = both(monkeypatch, SELECTORS["p75"], "own", **OWN_WAYS[way])
    only_updates_wait(waits)
    assert goals.selector.fear.fitted
    assert any(waits["step"])


@pytest.mark.parametrize("name", [name for name in SELECTORS if name != "p75"])
def test_every_selector_gives_the_same(name, monkeypatch):
    """So it is with other selectors, worlds with arbitrary states at their ends included."""
    goals, waits = both(monkeypatch, SELECTORS[name], "own", **OWN_WAYS["executed"])
    only_updates_wait(waits)
    assert len(goals.interactions.resolved())


@pytest.mark.parametrize("horizon", [None, 3])
def test_their_clock_waits_for_nothing_and_gives_the_same(horizon, monkeypatch):
    """Nor do the calls that command managers make, with worlds listed in any order or in a mask."""
    goals, waits = both(monkeypatch, SELECTORS["p75"], "theirs", horizon=horizon)
    only_updates_wait(waits)
    assert goals.selector.fear.fitted
    assert goals.interactions.resolved().crashed.any()


@dataclass(frozen=True)
class Picky(SelectorConfig):
    """Uniform goals, of a selector that wants to be asked about the worlds that are due alone."""

    def build(self, spaces, seed):
        """See ``SelectorConfig.build``."""
        selector = uniform.Config().build(spaces, seed)
        selector.dense = False
        return selector


def test_what_wants_to_know_the_worlds_waits(monkeypatch):
    """A function of candidates makes a step wait once, for their number, and a selector that is not dense twice."""
    offered = torch.linspace(-1, 1, N).view(N, 1, 1)
    for selector, candidates, times in ((SELECTORS["p75"], lambda rows: offered[rows], 1), (Picky(), None, 2)):
        _, waits = both(monkeypatch, selector, "own", candidates=candidates)
        assert max(sum(found.values()) for found in waits["step"][:7]) == times


NO = torch.zeros(N, dtype=torch.bool)


def odd(value):
    """Zeros, shape (N, 1), except ``value`` in world 5."""
    return torch.zeros(N, 1).index_fill(0, torch.tensor([5]), value)


NAN = odd(torch.nan)


def good(**changes):
    """A step, with changes."""
    step = {"state": torch.zeros(N, 2), "goal": torch.zeros(N, 1), "terminated": NO, "truncated": NO}
    return step | {"candidates": torch.zeros(N, 4, 1)} | changes


STEPS = [
    ({"state": NAN.expand(N, 2)}, "state of world 5 must be finite and at most 1e+15 in size"),
    ({"goal": odd(1e16)}, "goal of world 5 must be finite and at most 1e+15 in size"),
    ({"tracking": NAN[:, 0]}, "tracking of world 5 must be in [0, 1]"),
    ({"tracking": odd(7.0)[:, 0]}, "tracking of world 5 must be in [0, 1]"),
    ({"executed": NAN}, "executed of world 5 must be finite and at most 1e+15 in size"),
    ({"candidates": NAN.unsqueeze(1)}, "candidates of world 5 must be finite and at most 1e+15 in size"),
    ({"candidates": odd(2.0).unsqueeze(1)}, "candidates of world 5 must be in the goal_box"),
    ({"truncated": NAN[:, 0]}, "truncated of world 5 must be bool, or 0 and 1"),
    ({"goal": odd(0.5)}, "goal of world 5 must be what it was given"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), STEPS)
def test_what_does_not_fit_is_refused_before_anything_is_learnt(changes, message, monkeypatch):
    """The message names argument, world and step; until a state is loaded nothing is learnt and none is saved."""
    monkeypatch.setattr(core, "AS_ON_GPU", True)
    goals = GoalDirector("p75", 1, goal_box=BOX, learn_every=4, **SIZES)
    goals.step(**good())
    saved = goals.state_dict()
    goals.step(**good(**changes))
    goals.step(**good())
    refused = pytest.raises(
        ValueError, match=re.escape(message) + r".*; after 1 steps it was not\. On cpu, numbers are"
    )
    for call in (lambda: goals.step(**good()), goals.learn, goals.state_dict):
        with refused:
            call()
    assert goals.metrics == {}
    goals.load_state_dict(saved)
    for _ in range(4):
        goals.step(**good())
    assert goals.metrics


@pytest.mark.parametrize(
    ("rows", "more", "message"),
    [
        ([0, 0], {}, f"rows must be worlds in [0, {N}), each once"),
        ([0, N], {}, f"rows must be worlds in [0, {N}), each once"),
        ([-1, 0], {}, f"rows must be worlds in [0, {N}), each once"),
        (NO, {}, "rows must be as many worlds as state has rows"),
        ([3, 5], {"horizon": torch.tensor([2, 9])}, "horizon of world 5 must be in [1, 6]"),
        ([3, 5], {"state": torch.tensor([[0.0, 0.0], [0.0, torch.inf]])}, "state of world 5 must be finite"),
    ],
)
def test_worlds_and_horizons_are_checked_late(rows, more, message, monkeypatch):
    """Nor do worlds that do not exist write elsewhere, or break the device, before they are refused."""
    monkeypatch.setattr(core, "AS_ON_GPU", True)
    goals = GoalDirector("p75", max_horizon=6, goal_box=BOX, **SIZES)
    for _ in range(2):
        goals.propose(None, torch.zeros(N, 2), torch.zeros(N, 1), torch.zeros(N, 1, 1))
        goals.observe(NO, NO)
    arguments = {"state": torch.zeros(2, 2), "goal": torch.zeros(2, 1), "candidates": torch.zeros(2, 1, 1)} | more
    rows = torch.as_tensor(rows)
    goals.propose(rows, **arguments)
    with pytest.raises(ValueError, match=re.escape(message)):
        goals.learn()
