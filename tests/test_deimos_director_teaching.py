"""What selectors of other people's loops learn from besides outcomes: how well goals are met, and transitions."""

import io
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from deimos import GoalDirector
from deimos.goals.selector import Transitions
from deimos.goals.selectors import cl, plr, schedule, vds
from deimos.learn.rollout import Rollout

N = 64
NO = torch.zeros(N, dtype=torch.bool)


def test_candidates_stay_within_the_announced_range():
    """A curriculum's share shrinks the box around its middle: for what is drawn, and for what is given."""
    goals = GoalDirector("cl", 1, goal_box=([0.0], [8.0]), num_envs=50, state_dim=1, goal_dim=1, device="cpu")
    drawn = goals.propose(None, np.zeros((50, 1)), np.zeros((50, 1)))
    assert 3.0 <= drawn.min() < 3.3
    assert 4.7 < drawn.max() <= 5.0
    for value in (2.5, 5.5):
        with pytest.raises(
            ValueError, match=rf"candidates must be between \[3\.0\] and \[5\.0\], got \[{value}\] for world 4"
        ):
            goals.propose([4], np.zeros((1, 1)), np.zeros((1, 1)), np.full((1, 2, 1), value))
    goals.propose([4], np.zeros((1, 1)), np.zeros((1, 1)), np.full((1, 2, 1), 4.9))


def test_a_curriculum_follows_each_group_of_components():
    """Only the range of the components that are met grows."""
    config = cl.Config(min_interactions=10)
    goals = GoalDirector(config, 2, groups=(slice(0, 2), slice(2, 3)), learn_every=4)
    met = torch.tensor([1.0, 0.0]).expand(N, 2)
    goal = torch.zeros(N, 3)
    for _ in range(12):
        goal = goals.step(torch.zeros(N, 1), goal, NO, NO, torch.zeros(N, 1, 3), tracking=met).goal
    assert goals.goal_range[0] == goals.goal_range[1] > 0.25
    assert goals.goal_range[2] == 0.25
    with pytest.raises(ValueError, match=rf"tracking must have the shape \({N}, 2\), got \({N},\)"):
        goals.step(torch.zeros(N, 1), goal, NO, NO, torch.zeros(N, 1, 3), tracking=met[:, 0])
    goals.step(torch.zeros(N, 1), goal, NO, NO, torch.zeros(N, 1, 3))  # nobody tells: none is met


@pytest.mark.parametrize("name", ["cl", "grid", "schedule"])
@pytest.mark.parametrize("clock", ["own", "theirs"])
def test_a_curriculum_that_nobody_tells_of_tracking_says_so(name, clock, caplog):
    """It says so once, and so does one within another selector; where it is told it says nothing."""
    config = schedule.Config(first="uniform", second="cl") if name == "schedule" else name
    for tracking, times in ((None, 1), (torch.zeros(N), 0)):
        caplog.clear()
        goals = GoalDirector(config, 3, learn_every=6, goal_box=([-1.0], [1.0]), total_steps=100)
        state, goal = torch.zeros(N, 2), torch.zeros(N, 1)
        goals.propose(None, state, goal)
        for _ in range(20):
            if clock == "own":
                goal = goals.step(state, goal, NO, NO, tracking=tracking).goal
            else:
                goals.observe(NO, NO, tracking=tracking)
        said = [record.getMessage() for record in caplog.records]
        assert len(said) == times
        assert all("follows how well goals are met, and stays as it is until you give tracking" in one for one in said)


def test_a_grid_begins_in_the_middle_of_any_box():
    """Goals come from the middle of the range at first, wherever it lies, and the cells cover all of it."""
    low, high = torch.tensor([1.0, -5.0, -1.0]), torch.tensor([2.0, 3.0, 1.0])
    goals = GoalDirector("grid", 2, learn_every=4, goal_box=(low, high))
    goal, shares = torch.zeros(N, 3), []
    for _ in range(40):
        goal = goals.step(torch.zeros(N, 1), goal, NO, NO, tracking=torch.zeros(N)).goal
        shares.append((goal - low) / (high - low))
    late = torch.cat(shares[20:])
    assert (late >= 0.245).all()  # cells are cut from what was seen, which is a little less than the box
    assert (late <= 0.755).all()
    assert ((late.amin(0) < 0.3) & (late.amax(0) > 0.7)).all()
    for _ in range(200):
        goal = goals.step(torch.zeros(N, 1), goal, NO, NO, tracking=torch.ones(N)).goal
        shares.append((goal - low) / (high - low))
    late = torch.cat(shares[-40:])
    assert ((late.amin(0) < 0.05) & (late.amax(0) > 0.95)).all()


@pytest.mark.parametrize("config", [vds.Config(hidden=(8,)), plr.Config(capacity=20, candidates=5)])
def test_selectors_learn_from_the_learners_transitions(config, caplog):
    """``learn`` hands them a rollout; until somebody calls it they say so once, and goals are chosen all the same."""
    goals = GoalDirector(config, 3, learn_every=6, goal_box=([-1.0], [1.0]))
    rollout, goal = Rollout(6, N, 3, 1, torch.device("cpu")), torch.zeros(N, 1)
    before = None
    for _ in range(5):
        for t in range(6):
            rollout.obs[t] = torch.cat([torch.zeros(N, 2), goal], dim=1)
            goal = goals.step(torch.zeros(N, 2), goal, NO, NO).goal
            rollout.reward[t] = goal[:, 0]
        rollout.advantage.copy_(rollout.reward)
        before = before or repr(goals.selector.state_dict())
        found = goals.learn(rollout)
    assert found == goals.metrics
    assert repr(goals.selector.state_dict()) != before
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1
    assert "learns from the learner's transitions: call learn(rollout)" in said[0]
    with pytest.raises(ValueError, match="needs the learner's rollout, got None"):
        goals.learn()
    parts = {name: None for name in Transitions.__annotations__}
    with pytest.raises(ValueError, match=r"rollout must have num_steps, .*; it lacks cut_off\."):
        goals.learn(SimpleNamespace(**parts))


@pytest.mark.parametrize("config", [vds.Config(hidden=(8,)), plr.Config(capacity=20, candidates=5)])
def test_a_rollout_holds_all_steps_since_the_last_one(config):
    """One that is shorter or longer, of other worlds or not finite, is refused, and teaches nothing."""
    goals = GoalDirector(config, 3, learn_every=100, goal_box=([-1.0], [1.0]))
    goal = torch.zeros(N, 1)

    def rollout(steps, worlds=N):
        found = Rollout(steps, worlds, 3, 1, torch.device("cpu"))
        for name in ("obs", "reward", "advantage"):
            getattr(found, name).zero_()
        return found

    for steps in (6, 4):
        for _ in range(steps):
            goal = goals.step(torch.zeros(N, 2), goal, NO, NO).goal
        before = repr(goals.state_dict())
        for other in (steps - 1, steps + 1, 10):
            message = rf"rollout must hold the transitions since the last call of learn\(\), {steps} steps, got {other}"
            with pytest.raises(ValueError, match=message):
                goals.learn(rollout(other))
        expected, shape = re.escape(str((steps + 1, N, 3))), re.escape(str((steps + 1, N - 1, 3)))
        with pytest.raises(ValueError, match=rf"rollout.obs must have the shape {expected}, got {shape}"):
            goals.learn(rollout(steps, N - 1))
        wrong = rollout(steps)
        wrong.reward[1, 5] = torch.nan
        with pytest.raises(ValueError, match=r"rollout\.reward must be finite, got nan in world 5"):
            goals.learn(wrong)
        assert repr(goals.state_dict()) == before
        goals.learn(rollout(steps))
    afraid = GoalDirector("p75", 3, goal_box=([-1.0], [1.0]))  # which learns from outcomes alone
    afraid.step(torch.zeros(N, 2), torch.zeros(N, 1), NO, NO)
    afraid.learn(rollout(9))


def whole(goals):
    """All of its state, to compare; ``repr`` shortens large tensors."""
    file = io.BytesIO()
    torch.save(goals.state_dict(), file)
    return file.getvalue()


def taught(config, change):
    """A Director's state after two lessons, with crashes and a time limit, and why it refused the second, if it did.

    ``change`` may alter the transitions of the second one.
    """
    goals = GoalDirector(config, 3, learn_every=100, goal_box=([-1.0], [1.0]))
    goal, random = torch.zeros(N, 1), torch.Generator().manual_seed(0)
    for change_it in (lambda parts: None, change):
        parts = vars(Rollout(6, N, 3, 1, torch.device("cpu")))
        for name in ("obs", "reward", "advantage"):
            parts[name].normal_(generator=random)
        parts["terminated"].bernoulli_(0.1, generator=random)
        parts["truncated"][2, 5] = parts["truncated"][3, 1] = True
        parts["terminated"][2, 5] = parts["terminated"][3, 1] = False
        step, world = parts["truncated"].nonzero(as_tuple=True)
        last = step, world, torch.ones(2, 3)
        parts["cut_off"] = lambda last=last: last
        change_it(parts)
        for _ in range(6):
            goal = goals.step(torch.zeros(N, 2), goal, NO, NO).goal
        before = whole(goals)
        try:
            goals.learn(SimpleNamespace(**parts))
        except ValueError as error:
            assert whole(goals) == before
            return before, str(error)
    return whole(goals), None


def as_type(kind, *names):
    """Changes the type of parts of a rollout."""
    return lambda parts: parts.update({name: kind(parts[name]) for name in names})


CONFIGS = [vds.Config(hidden=(8,)), vds.Config(hidden=(8,), data="share"), plr.Config(capacity=20, candidates=5)]
FLAGS, NUMBERS = ("terminated", "truncated"), ("obs", "reward", "weight", "advantage")


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize(
    "change",
    [
        as_type(torch.Tensor.byte, *FLAGS),  # as rsl_rl's storage keeps them
        as_type(torch.Tensor.long, *FLAGS),
        as_type(torch.Tensor.float, *FLAGS),
        as_type(torch.Tensor.double, *NUMBERS),
        as_type(torch.Tensor.numpy, *FLAGS, *NUMBERS),
        lambda parts: parts.update(cut_off=lambda: ([2, 3], [5, 1], [[1, 1, 1], [1, 1, 1]])),
    ],
)
def test_transitions_of_any_type_teach_the_same(config, change):
    """Flags of 0 and 1, other precisions and arrays teach what bool and float32 teach, bit for bit."""
    assert taught(config, change) == taught(config, lambda parts: None)


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda parts: parts.update(truncated=2 * parts["truncated"]), "truncated must be bool, or 0 and 1, got 2 in"),
        (lambda parts: parts.update(terminated=torch.full((6, N), torch.nan)), "terminated must be bool, or 0 and 1"),
        (lambda parts: parts.update(reward_scale=float("nan")), "reward_scale must be a finite number, got nan"),
        (lambda parts: parts.update(discount=None), "discount must be a finite number, got None"),
        (lambda parts: parts.update(cut_off=lambda: None), "must give steps, worlds and their last observations, got"),
        (lambda parts: parts.update(cut_off=lambda: ([], [], [])), "every truncated step, but lacks step 2 of world 5"),
        (lambda parts: parts.update(cut_off=lambda: ([2], [5], [[1.0] * 3])), "but lacks step 3 of world 1"),
        (lambda parts: parts.update(cut_off=lambda: ([2, 9], [5, 1], [[1.0] * 3] * 2)), r"steps in \[0, 6\), got"),
        (lambda parts: parts.update(cut_off=lambda: ([2, 3], [5, -1], [[1.0] * 3] * 2)), r"worlds in \[0, 64\)"),
        (lambda parts: parts.update(cut_off=lambda: ([2.0], [5.0], [[1.0] * 3])), "must give whole numbers of steps"),
        (lambda parts: parts.update(cut_off=lambda: ([2, 3], [5, 1], [[1.0]] * 2)), r"\(m, 3\), got \(2,\), \(2,\)"),
        (
            lambda parts: parts.update(cut_off=lambda: ([2, 3], [5, 1], [[1.0] * 3, [1.0, float("nan"), 1.0]])),
            r"must be finite, got \[1.0, nan, 1.0\] in world 1",
        ),
    ],
)
def test_transitions_that_do_not_fit_are_named_and_teach_nothing(config, change, reason):
    """Where an episode was cut off and what values are made from is checked like the rest."""
    assert re.search(reason, taught(config, change)[1])
