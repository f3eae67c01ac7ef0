"""What other people's loops may hand to the Director, and what it says of the rest."""

import re
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from deimos import GoalDirector
from deimos.goals.fear import FearConfig
from deimos.goals.selectors import director, uniform

AFRAID = director.Config(percentile=75, candidates=20, fear=FearConfig(min_per_class=4))
N = 64
NO = torch.zeros(N, dtype=torch.bool)


def plain(numbers):
    """Tensors as they are."""
    return numbers


def nothing(candidates):
    """No candidates: the Director draws its own."""
    return None


def drive(goals, cast, offer=None, flag=None, host=nullcontext):
    """Walkers that crash far out, in a loop whose numbers ``cast`` has made; returns the last assignment."""
    offer, flag = offer or cast, flag or cast
    generator = torch.Generator().manual_seed(0)
    state, goal = torch.zeros(N, 2), cast(torch.zeros(N, 2))
    for _ in range(48):
        last = goal.detach().float() if isinstance(goal, torch.Tensor) else torch.tensor(goal)
        state = 0.8 * state + 0.5 * last
        crashed = state.norm(dim=1) > 1.2
        candidates = 2 * torch.rand(N, 20, 2, generator=generator) - 1
        arguments = cast(state), goal, flag(crashed), flag(NO), offer(candidates)
        with host():
            given = goals.step(*arguments)
        goal = given.goal
        state[crashed] = 0.0
    return given


def tensors(goals):
    """What a Director has kept and learnt."""
    return goals.interactions.resolved().next_goal, goals.selector.fear.state_dict()["network"]["0.weight"]


WAYS = {
    "arrays": {"cast": lambda x: x.numpy().copy()},
    "arrays that must not be written to": {"cast": lambda x: np.broadcast_to(x.numpy(), x.shape)},
    "float64": {"cast": lambda x: x.double() if x.is_floating_point() else x},
    "gradients": {"cast": lambda x: x.clone().requires_grad_() if x.is_floating_point() else x},
    "int dones": {"cast": plain, "flag": lambda x: x.int()},
    "float dones": {"cast": plain, "flag": lambda x: x.float()},
    "candidates by need": {"cast": plain, "offer": lambda x: lambda rows: x[rows]},
    "arrays by need": {"cast": lambda x: x.numpy().copy(), "offer": lambda x: lambda rows: x.numpy()[rows]},
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_to_say_it_is_the_same(way):
    """Arrays, tensors of any precision, flags of any type and candidates by need give the same, bit for bit."""
    expected, found = (GoalDirector(AFRAID, 4, learn_every=12) for _ in range(2))
    ordinary = drive(expected, plain)
    given = drive(found, **WAYS[way])
    assert expected.selector.fear.fitted
    for ours, theirs in zip(tensors(expected), tensors(found), strict=True):
        assert torch.equal(ours, theirs)
    assert torch.equal(ordinary.goal, torch.as_tensor(given.goal, dtype=torch.float32))
    arrays = way.startswith("arrays")
    assert all(isinstance(x, np.ndarray) == arrays for x in (given.goal, given.changed, given.weight))
    assert given.goal.dtype == (torch.float64 if way == "float64" else np.float32 if arrays else torch.float32)


HOSTS = {
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "default device": lambda: torch.device("meta"),
    "inference mode": torch.inference_mode,
}


@pytest.mark.parametrize("host", HOSTS)
def test_what_the_host_prefers_changes_nothing(host):
    """Steps, updates, a reload and fear are those of a host without autocast and other devices."""
    known = {"num_envs": N, "state_dim": 2, "goal_dim": 2, "device": "cpu"}
    options = known | {"learn_every": 12, "goal_box": ([-1, -1], [1, 1])}
    expected = GoalDirector(AFRAID, 4, **options)
    drive(expected, plain, offer=nothing)
    at, now, new = np.array([[1.0, 0.0]]), np.zeros((1, 2)), np.array([[1.0, 0.0]])
    with HOSTS[host]():
        found = GoalDirector(AFRAID, 4, **options)
    drive(found, plain, offer=nothing, host=HOSTS[host])
    with HOSTS[host]():
        found.load_state_dict(found.state_dict())
        told = found.fear(at, now, new).probability
    for ours, theirs in zip(tensors(expected), tensors(found), strict=True):
        assert torch.equal(ours, theirs)
    assert torch.equal(told, expected.fear(at, now, new).probability)


def test_candidates_are_asked_for_where_they_are_needed():
    """The function gets the worlds that are due and those that begin an episode, and is not called for none."""
    asked = []

    def candidates(rows):
        asked.append(rows.tolist())
        return torch.rand(len(rows), 7, 1) - 0.5

    goals, goal, no = GoalDirector("uniform", 3), torch.zeros(5, 1), torch.zeros(5, dtype=torch.bool)
    crash = torch.tensor([False, True, False, False, True])
    for t in range(1, 6):
        goal = goals.step(torch.zeros(5, 2), goal, crash & (t == 1), no, candidates).goal
    assert asked == [[1, 4], [0, 2, 3], [1, 4]]


def test_it_draws_from_the_box():
    """Goals are uniform in the box, independent, and those of a world do not depend on who else is due."""
    low, high = np.array([-1.0, 2.0]), np.array([0.0, 6.0])
    options = {"goal_box": (low, high), "num_envs": 500, "state_dim": 1, "goal_dim": 2, "device": "cpu"}
    goals = GoalDirector("uniform", 1, **options)
    goal, every = np.zeros((500, 2)), []
    for _ in range(4):
        goal = goals.propose(None, np.zeros((500, 1)), goal)
        every.append(goal)
    drawn = (np.concatenate(every) - low) / (high - low)
    assert drawn.min() >= 0
    assert drawn.max() <= 1
    np.testing.assert_allclose(drawn.mean(0), 0.5, atol=5 * np.sqrt(1 / 12 / 2000))
    np.testing.assert_allclose(drawn.var(0), 1 / 12, atol=0.01)
    assert len(np.unique(drawn[:, 0])) > 1990
    few = GoalDirector("uniform", 1, **options)
    np.testing.assert_array_equal(few.propose([7, 3], np.zeros((2, 1)), np.zeros((2, 2))), every[0][[7, 3]])


def test_a_risk_map_is_fear_over_a_grid():
    """Every cell is the fear of the new goal whose two components are the cell's, the others those of the goal."""
    goals = GoalDirector(AFRAID, 4, learn_every=12, goal_box=([-1, -1], [1, 1]))
    drive(goals, plain, offer=nothing)
    state, goal = torch.tensor([0.5, 0.1]), torch.tensor([0.2, -0.3])
    x, y = np.linspace(-1, 1, 5), np.linspace(0, 1, 3)
    found = goals.risk_map(state, goal, {1: x, 0: y})
    assert found.probability.shape == (3, 5)
    for row in range(3):
        for column in range(5):
            new = torch.tensor([[y[row], x[column]]], dtype=torch.float32)
            told = goals.fear(state.unsqueeze(0), goal.unsqueeze(0), new)
            np.testing.assert_allclose(found.probability[row, column], told.probability.item(), rtol=1e-5)
    assert (found.auroc, found.age) == (told.auroc, told.age)
    whole = goals.risk_map(state.numpy(), goal.numpy(), (0, 1))
    assert (whole.x[0], whole.x[-1], whole.probability.shape) == (-1.0, 1.0, (41, 41))
    for axes, message in (
        ((0, 0), "axes must be two different components in [0, 2), got [0, 0]"),
        ((0, 2), "axes must be two different components in [0, 2), got [0, 2]"),
        ({0: x}, "axes must be two different components in [0, 2), got [0]"),
        (1, "axes must be two different components in [0, 2), got [1]"),
        ((0.0, 1.0), "axes must be two different components in [0, 2), got [0.0, 1.0]"),
        ({0: x, 1: 0.5}, "values of axes must have the shape (n,) each, got (5,) and ()"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            goals.risk_map(state, goal, axes)
    for at, now, message in (
        (state[None], goal, "state must have the shape (2,), got (1, 2)"),
        (state, goal[None], "goal must have the shape (2,), got (1, 2)"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            goals.risk_map(at, now, (0, 1))
    for at in (state, 3.0):
        with pytest.raises(ValueError, match=r"state must have the shape \(num_envs, state_dim\), got \("):
            goals.fear(at, goal[None], goal[None])
    unbounded = GoalDirector(AFRAID, 4, num_envs=N, state_dim=2, goal_dim=2, device="cpu")
    with pytest.raises(ValueError, match="axes must come with their values where there is no goal_box"):
        unbounded.risk_map(state, goal, (0, 1))


def test_a_risk_map_takes_what_a_learner_has():
    """Tensors with gradients and of bfloat16, which NumPy does not read, give the map of plain numbers."""
    goals = GoalDirector(AFRAID, 4, learn_every=12, goal_box=([-1, -1], [1, 1]))
    drive(goals, plain, offer=nothing)
    state, goal, x = torch.tensor([0.5, 0.25]), torch.tensor([0.25, -0.5]), torch.linspace(-1, 1, 5)
    expected = goals.risk_map(state.numpy(), goal.numpy(), {0: x.numpy(), 1: x.numpy()}).probability
    for change in (torch.Tensor.bfloat16, lambda tensor: tensor.clone().requires_grad_()):
        found = goals.risk_map(change(state), change(goal), {0: change(x), 1: change(x)}).probability
        np.testing.assert_array_equal(found, expected)


def good(**changes):
    """A step of two worlds, with changes."""
    no = torch.zeros(2, dtype=torch.bool)
    step = {"state": torch.zeros(2, 3), "goal": torch.zeros(2, 1), "terminated": no, "truncated": no}
    return step | {"candidates": torch.zeros(2, 4, 1)} | changes


NAN = torch.tensor([[0.0], [torch.nan]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": NAN.expand(2, 3)}, r"state of world 1 must be finite, got \[nan, nan, nan\]"),
        ({"goal": NAN}, r"goal of world 1 must be finite, got \[nan\]"),
        ({"tracking": NAN[:, 0]}, "tracking of world 1 must be finite, got nan"),
        ({"tracking": [1.0, 7.0]}, r"tracking of world 1 must be in \[0, 1\], got 7.0"),
        ({"tracking": [0.0, -0.1]}, r"tracking of world 1 must be in \[0, 1\], got -0.1"),
        ({"executed": NAN}, r"executed of world 1 must be finite, got \[nan\]"),
        ({"candidates": NAN.unsqueeze(1)}, r"candidates of world 1 must be finite, got \[\[nan\]\]"),
        ({"candidates": lambda rows: torch.zeros(len(rows), 4)}, r"candidates must have the shape .*, got \(2, 4\)"),
        ({"candidates": None}, "candidates must be given where GoalDirector was made without a goal_box, got None"),
        ({"state": torch.zeros(2, 3, device="meta")}, "state must be on cpu, got it on meta"),
        ({"terminated": torch.zeros(2, device="meta")}, "terminated must be on cpu, got it on meta"),
        ({"truncated": [0, 2]}, "truncated must be bool, or 0 and 1, got 2 in world 1"),
        ({"truncated": torch.tensor([0.0, torch.nan])}, "truncated must be bool, or 0 and 1, got nan in world 1"),
        ({"state": torch.zeros(3, 3)}, r"state must have the shape \(2, 3\), got \(3, 3\)|goal must have .*\(3, 1\)"),
        ({"goal": torch.ones(2, 1)}, r"goal of world 0 must be \[0\.0\], which it was .*\[1\.0\]; .* their own"),
        ({"state": np.zeros((2, 3), ">f4")}, r"state must be an array or .* of numbers, got numpy\.ndarray of >f4"),
    ],
)  # fmt: skip
def test_bad_input_is_named(changes, message):
    """What is wrong, where, what it must be and what it was; a good step follows all the same."""
    goals = GoalDirector("uniform", 1)
    if "goal of world 0" not in message:  # which needs a goal that was given
        with pytest.raises(ValueError, match=message):
            GoalDirector("uniform", 1, device="cpu").step(**good(**changes))
    goals.step(**good())
    with pytest.raises(ValueError, match=message):
        goals.step(**good(**changes))
    goals.step(**good())


def test_worlds_that_are_done_need_no_state():
    """Nothing is chosen in the state of a world that is done: it may be anything, unless first goals are chosen."""
    ended = torch.tensor([False, True])
    for autoreset in ("SameStep", "NextStep"):
        goals = GoalDirector("uniform", 1, autoreset=autoreset)
        goals.step(**good(state=NAN.expand(2, 3), truncated=ended))
    goals = GoalDirector("uniform", 1, first_goals="chosen")  # where the next episode begins
    with pytest.raises(ValueError, match="state of world 1 must be finite"):
        goals.step(**good(state=NAN.expand(2, 3), truncated=ended))


def test_a_world_that_is_both_due_and_done_begins_anew():
    """The old goal gets its label, a crash or a survival; the next one is a first goal and no interaction."""
    goals, no, goal = GoalDirector("uniform", 2), torch.zeros(2, dtype=torch.bool), torch.zeros(2, 1)
    candidates = torch.arange(8.0).view(2, 4, 1)
    for _ in range(3):
        goal = goals.step(torch.zeros(2, 3), goal, no, no, candidates).goal
    ended = torch.tensor([True, False])
    given = goals.step(torch.zeros(2, 3), goal, ended, ~ended, candidates)
    assert goals.interactions.resolved().crashed.tolist() == [True, False]
    assert torch.equal(given.goal, candidates[:, 0])
    assert not goals.interactions.active.any()


def test_nobody_may_be_listed():
    """An empty mask, slice or list of worlds changes nothing and gives no goals."""
    goals = GoalDirector("uniform", 2, num_envs=3, state_dim=2, goal_dim=1, device="cpu", goal_box=([0], [1]))
    before = repr(goals.state_dict())
    for rows in (np.zeros(3, bool), slice(0, 0), []):
        assert goals.propose(rows, np.zeros((0, 2)), np.zeros((0, 1), np.float32)).shape == (0, 1)
    assert repr(goals.state_dict()) == before


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([0, 0], r"rows must be worlds in \[0, 3\), each once, got \[0, 0\]"),
        ([0, 3], r"rows must be worlds in \[0, 3\), each once, got \[0, 3\]"),
        ([-1, 0], r"rows must be worlds in \[0, 3\), each once, got \[-1, 0\]"),
        ([0.0, 1.0], r"rows must be indices of worlds, a mask or a slice, got \[0\.0, 1\.0\]"),
        (torch.zeros(2, dtype=torch.bool), r"rows must be a mask of the shape \(3,\), got \(2,\)"),
        (slice(0, 3), r"state must have the shape \(3, 2\), got \(2, 2\)"),
    ],
)
def test_rows_are_checked(rows, message):
    """Worlds that are not there or listed twice, and masks of another length, are refused."""
    goals = GoalDirector("uniform", 2, num_envs=3, state_dim=2, goal_dim=1, device="cpu", goal_box=([0], [1]))
    with pytest.raises(ValueError, match=message):
        goals.propose(rows, torch.zeros(2, 2), torch.zeros(2, 1))


@pytest.mark.parametrize("horizon", [0, 6, [3, 6], 2.5, [1, 2, 3], True])
def test_horizons_are_checked(horizon):
    """Steps of a goal are whole, at least one and at most what was announced, one for each world."""
    goals = GoalDirector(
        "uniform", max_horizon=5, num_envs=3, state_dim=2, goal_dim=1, device="cpu", goal_box=([0], [1])
    )
    with pytest.raises(ValueError, match=r"horizon must be (in \[1, 5\]|a whole number or 2 of them), got "):
        goals.propose([0, 1], torch.zeros(2, 2), torch.zeros(2, 1), horizon=horizon)


def test_goals_of_a_fixed_period_are_not_announced_shorter():
    """Too few outcomes are kept for shorter ones; the message says what takes them."""
    goals = GoalDirector("uniform", 5, num_envs=2, state_dim=2, goal_dim=1, device="cpu", goal_box=([0], [1]))
    goals.propose(None, torch.zeros(2, 2), torch.zeros(2, 1), horizon=5)
    with pytest.raises(ValueError, match=r"horizon must be goal_period, 5, got \[5, 4\]; GoalDirector\(max_"):
        goals.propose(None, torch.zeros(2, 2), torch.zeros(2, 1), horizon=[5, 4])


@pytest.mark.parametrize("selector", [uniform.Config, uniform, 75])
def test_a_selector_is_a_name_or_a_configuration(selector):
    """A class, a module or a number is none."""
    with pytest.raises(ValueError, match=r"selector must be a deimos.goals.selector.SelectorConfig, got "):
        GoalDirector(selector, 5)


OPTIONS = [
    ({}, "goal_period must be the steps that a goal is active or, .* max_horizon .*; got None and None"),
    ({"goal_period": 5, "max_horizon": 9}, "goal_period must be .*; got 5 and 9"),
    ({"max_horizon": 0}, "max_horizon must be at least 1, got 0"),
    ({"goal_period": 5, "num_envs": 0}, "num_envs must be at least 1, got 0"),
    ({"goal_period": 5, "autoreset": "Sometimes"}, "autoreset must be one of SameStep, NextStep, Disabled, got 'Some"),
    ({"goal_period": 5, "device": "gpu"}, "device must be one that torch has, got 'gpu': "),
    ({"goal_period": 5, "first_goals": "any"}, "first_goals must be one of uniform, chosen, got 'any'"),
]
KNOWN = {"num_envs": 2, "state_dim": 3, "goal_dim": 1, "device": "cpu", "goal_period": 5}
OPTIONS += [
    (KNOWN | {"goal_box": ([0], [0])}, r"goal_box must be the lowest and the highest goal, finite, got \[0\.0\] and"),
    (KNOWN | {"goal_box": ([0], [np.inf])}, "goal_box must be the lowest and the highest goal, finite"),
    (KNOWN | {"goal_box": ([0, 0], [1, 1])}, r"goal_box must have the shape \(1,\), got \(2,\)"),
]
OPTIONS += [  # also where the sizes are not known yet
    ({"goal_period": 5, "goal_box": box}, "goal_box must be the lowest and the highest goal, as in .*, got ")
    for box in ([(-1, 1)] * 3, 1.0, {"low": [0], "high": [1]}, ([0, 1], [[1], [1, 2]]), SimpleNamespace(low=0, high=1))
]
OPTIONS += [
    (KNOWN | {"goal_dim": 3, "groups": groups}, "groups must be slices that name each of the 3 components .* once, got")
    for groups in (
        (slice(0, 2), slice(1, 3)), (slice(0, 1), slice(2, 3)), (slice(0, 3), slice(3, 4)), (slice(0, 2), 2), (),
    )
]  # fmt: skip


@pytest.mark.parametrize(("options", "message"), OPTIONS)
def test_options_are_checked(options, message):
    """The message names the option and what it was."""
    with pytest.raises(ValueError, match=message):
        GoalDirector("uniform", **options)


def test_there_must_be_a_world():
    """A loop of no worlds is refused."""
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        GoalDirector("uniform", 1).step(**good(state=torch.zeros(0, 3), goal=torch.zeros(0, 1)))


def test_calls_that_come_too_early_are_refused():
    """A first call that does not tell all sizes, and a step without a period, say what to give."""
    goals, no = GoalDirector("uniform", max_horizon=5), torch.zeros(2, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"num_envs, state_dim and goal_dim must be given .*, got 2, None and None"):
        goals.observe(no, no)
    with pytest.raises(ValueError, match=r"num_envs, state_dim and goal_dim must be given .*, got None, 3 and 1"):
        goals.propose([0], torch.zeros(1, 3), torch.zeros(1, 1), torch.zeros(1, 1, 1))
    with pytest.raises(ValueError, match=r"goal_period must be given for step\(\), got None"):
        goals.step(**good())


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (
            GoalDirector("p75", 5, goal_box=([0], [1])),
            "state must come from a GoalDirector with .*percentile|with .*, got",
        ),
        (GoalDirector("uniform", 4, goal_box=([0], [1])), "state must come from a GoalDirector with "),
        (GoalDirector("uniform", 5, num_envs=3, state_dim=3, goal_dim=1, device="cpu"), "state must be that of "),
    ],
)
def test_a_state_must_fit(other, message):
    """That of another selector, period or number of worlds is refused, and so is what is no state."""
    goals = GoalDirector("uniform", 5)
    goals.step(**good())
    with pytest.raises(ValueError, match=message):
        other.load_state_dict(goals.state_dict())
    with pytest.raises(ValueError, match=r"state must be what state_dict.* returned; it lacks 'made_with'"):
        other.load_state_dict({"core": {}, "clock": torch.zeros(2)})
    spoilt = goals.state_dict()
    spoilt["goals"]["core"]["interactions"]["ring"] = None
    before = repr(goals.state_dict())
    for state in (None, [], goals.state_dict() | {"made_with": None}, spoilt):
        with pytest.raises(ValueError, match=r"state must be what state_dict\(\) of this version returned, got"):
            goals.load_state_dict(state)
    assert repr(goals.state_dict()) == before
