"""When an interaction begins, how it resolves, and how long it is remembered."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from deimos.goals.interactions import Interactions, Resolved

STATE_DIM, GOAL_DIM = 4, 2


def make_step(num_envs, device, *, terminated=(), truncated=(), goal_due=(), reward=1.0):
    """A step in which the listed worlds crashed, were cut off, or have a goal due."""

    def mask(rows):
        flags = torch.zeros(num_envs, dtype=torch.bool, device=device)
        flags[list(rows)] = True
        return flags

    return SimpleNamespace(
        reward=torch.as_tensor(reward, dtype=torch.float32, device=device).expand(num_envs).clone(),
        terminated=mask(terminated),
        truncated=mask(truncated),
        goal_due=mask(goal_due),
        tracking=None,
    )


def make_interactions(num_envs, device, *, goal_period=3, window=None):
    """A fresh record, with the window that training has."""
    window = 2 * goal_period if window is None else window
    return Interactions(num_envs, STATE_DIM, GOAL_DIM, math.ceil(window / goal_period) + 1, window, device)


def advance(interactions, step):
    """Do with a step what the loop does, and return the worlds that are due and not done."""
    interactions.advance(step.reward, step.terminated, step.tracking)
    done = step.terminated | step.truncated
    due = torch.nonzero(step.goal_due & ~done).flatten()
    rows = torch.cat([due, torch.nonzero(done).flatten()])
    interactions.resolve(rows, step.terminated[rows], step.goal_due[rows])
    return due


def issue(interactions, rows, marks, device, horizon=3):
    """Open interactions whose parts can be told from each other: mark + 0.25 k in part k."""
    marks = torch.as_tensor(marks, dtype=torch.float32, device=device).unsqueeze(1)
    interactions.open(
        torch.as_tensor(rows, dtype=torch.int64, device=device),
        state=marks.repeat(1, STATE_DIM),
        goal=marks.repeat(1, GOAL_DIM) + 0.25,
        next_goal=marks.repeat(1, GOAL_DIM) + 0.5,
        score=marks.squeeze(1) + 0.75,
        horizon=horizon,
    )


def test_nothing_is_there_at_first(torch_device):
    """Before anything was issued nothing is pending, and no step resolves anything."""
    interactions = make_interactions(3, torch_device)
    assert not interactions.active.any()
    assert len(interactions.resolved()) == 0
    advance(interactions, make_step(3, torch_device, terminated=[0], goal_due=[0, 1], truncated=[2]))
    assert len(interactions.resolved()) == 0


def test_every_ending_by_hand(torch_device):
    """Crash and due decide; a cut-off alone drops; a crash outweighs both; what is not listed stays pending."""
    interactions = make_interactions(6, torch_device)
    issue(interactions, range(6), torch.arange(6.0), torch_device)
    step = make_step(6, torch_device, terminated=[0, 1], truncated=[2, 3], goal_due=[1, 3, 4])
    assert advance(interactions, step).tolist() == [4]
    resolved = interactions.resolved()
    assert resolved.env.tolist() == [0, 1, 3, 4]
    assert resolved.crashed.tolist() == [True, True, False, False]
    assert interactions.active.tolist() == [False, False, False, False, False, True]
    advance(interactions, make_step(6, torch_device, terminated=[2, 5]))
    assert interactions.resolved().env.tolist() == [0, 1, 3, 4, 5]


def test_parts_stay_what_they_were(torch_device):
    """State, goal, next goal and score come back each in its own place, as they were at the moment of the choice."""
    interactions = make_interactions(4, torch_device)
    tensors = [torch.rand(2, size, device=torch_device) for size in (STATE_DIM, GOAL_DIM, GOAL_DIM)]
    tensors.append(torch.tensor([0.5, torch.nan], device=torch_device))
    kept = [tensor.clone() for tensor in tensors]
    interactions.open(torch.tensor([3, 1], device=torch_device), *tensors, horizon=3)
    for tensor in tensors:
        tensor.fill_(-1.0)
    advance(interactions, make_step(4, torch_device, goal_due=[1, 3]))
    resolved = interactions.resolved()
    assert resolved.env.tolist() == [1, 3]
    for name, value in zip(("state", "goal", "next_goal", "score"), kept, strict=True):
        torch.testing.assert_close(getattr(resolved, name), value[[1, 0]], rtol=0, atol=0, equal_nan=True, msg=name)


def test_reward_sums_exclude_the_crash_step(torch_device):
    """Rewards add up from the step after the choice; that of a crash is not among them."""
    interactions = make_interactions(2, torch_device)
    advance(interactions, make_step(2, torch_device, reward=100.0))  # before the choice
    issue(interactions, [0, 1], [0.0, 1.0], torch_device)
    advance(interactions, make_step(2, torch_device, reward=[1.0, 2.0]))
    advance(interactions, make_step(2, torch_device, reward=[4.0, 8.0]))
    advance(interactions, make_step(2, torch_device, terminated=[0], goal_due=[0, 1], reward=[16.0, 32.0]))
    resolved = interactions.resolved()
    assert resolved.crashed.tolist() == [True, False]
    assert resolved.reward.tolist() == [5.0, 42.0]


def test_reward_starts_anew_with_every_interaction(torch_device):
    """Nothing of an earlier interaction or of the time between is left in the next sum."""
    interactions = make_interactions(1, torch_device)
    for reward in (1.0, 2.0, 4.0):
        issue(interactions, [0], [reward], torch_device)
        advance(interactions, make_step(1, torch_device, goal_due=[0], reward=reward))
        advance(interactions, make_step(1, torch_device, reward=1000.0))
        newest = interactions.resolved()
        assert newest.reward[newest.resolved.argmax()] == reward


def test_window_drops_the_old_ones(torch_device):
    """An interaction is kept for exactly as many steps as the window has."""
    interactions = make_interactions(2, torch_device, goal_period=3, window=6)
    issue(interactions, [0, 1], [0.0, 1.0], torch_device)
    advance(interactions, make_step(2, torch_device, terminated=[0]))
    advance(interactions, make_step(2, torch_device))
    advance(interactions, make_step(2, torch_device, goal_due=[1]))
    kept = [interactions.resolved().env.tolist()]
    for _ in range(6):
        advance(interactions, make_step(2, torch_device))
        kept.append(interactions.resolved().env.tolist())
    assert kept == [[0, 1], [0, 1], [0, 1], [0, 1], [1], [1], []]


def test_rows_can_be_filtered(torch_device):
    """A filter keeps the listed rows of every part."""
    interactions = make_interactions(3, torch_device)
    issue(interactions, [0, 1, 2], [0.0, 1.0, 2.0], torch_device)
    advance(interactions, make_step(3, torch_device, terminated=[1], goal_due=[0, 1, 2]))
    survived = interactions.resolved()
    survived = survived.where(~survived.crashed)
    assert len(survived) == 2
    assert survived.env.tolist() == [0, 2]
    assert survived.state[:, 0].tolist() == [0.0, 2.0]
    for name in Resolved.__dataclass_fields__:
        assert len(getattr(survived, name)) == 2


@dataclass
class PlainWorld:
    """One world as a list of what happened: the same rules, without rings, masks or tensors."""

    clock: int = 0
    pending: dict | None = None

    def advance(self, now, crashed, truncated, goal_period, reward, mark):
        """Take one step; return what it resolved, and whether a goal is chosen after it."""
        self.clock += 1
        due = self.clock >= goal_period
        if self.pending is not None and not crashed:
            self.pending["reward"] += reward
        closed = None
        if self.pending is not None and (crashed or due):
            closed = self.pending | {"crashed": crashed, "resolved": now}
        if crashed or truncated:
            self.pending, self.clock = None, 0
        elif due:
            self.pending, self.clock = {"mark": mark, "issued": now, "reward": 0.0}, 0
        return closed, due and not crashed and not truncated


@pytest.mark.parametrize(("goal_period", "windows"), [(1, 2), (2, 2), (3, 2), (8, 2), (4, 5)])
def test_equals_a_plain_list(torch_device, goal_period, windows):
    """Whatever crashes when, the rings hold just what lists that never forget hold within the window."""
    rng = np.random.default_rng(seed=goal_period)
    n, window = 24, windows * goal_period
    # From worlds that hardly ever crash to worlds that crash on every other step, and some that are cut off.
    crash_rate = np.repeat([0.02, 1 / goal_period / 2, 0.5, 0.9], n // 4)
    cut_rate = np.tile([0.0, 0.0, 0.1], n // 3)
    interactions = make_interactions(n, torch_device, goal_period=goal_period, window=window)
    worlds = [PlainWorld(clock=int(rng.integers(goal_period))) for _ in range(n)]
    history = []
    most = 0
    for now in range(1, 40 * goal_period + 1):
        crashed = rng.random(n) < crash_rate
        # Worst for a ring: a crash right after a survival.
        crashed |= np.array([w.pending is not None and w.clock == 0 for w in worlds]) & (rng.random(n) < 0.5)
        truncated = ~crashed & (rng.random(n) < cut_rate)
        reward = rng.integers(8, size=n) / 8  # sums of these are exact
        due = np.array([world.clock + 1 >= goal_period for world in worlds])
        step = make_step(
            n, torch_device, terminated=np.flatnonzero(crashed), truncated=np.flatnonzero(truncated),
            goal_due=np.flatnonzero(due), reward=reward,
        )  # fmt: skip
        rows = advance(interactions, step)
        chosen = []
        for env, world in enumerate(worlds):
            mark = float(now * n + env)
            closed, chooses = world.advance(
                now, bool(crashed[env]), bool(truncated[env]), goal_period, reward[env], mark
            )
            if closed:
                history.append(closed | {"env": env})
            if chooses:
                chosen.append(env)
        assert rows.tolist() == chosen
        if chosen:
            issue(interactions, rows, rows.float() + now * n, torch_device)

        kept = [entry for entry in history if entry["resolved"] > now - window]
        names = ("env", "resolved", "issued", "crashed", "reward", "mark")
        expected = sorted((*(e[name] for name in names), e["mark"] + 0.25, e["mark"] + 0.75) for e in kept)
        got = interactions.resolved()
        columns = (
            got.env, got.resolved, got.issued, got.crashed, got.reward, got.state[:, 0], got.goal[:, 1], got.score
        )  # fmt: skip
        assert sorted(zip(*(column.tolist() for column in columns), strict=True)) == expected
        assert got.env.tolist() == sorted(got.env.tolist())
        assert interactions.active.tolist() == [world.pending is not None for world in worlds]
        per_world = np.bincount([entry["env"] for entry in kept], minlength=n)
        most = max(most, per_world.max())
    # The test has seen rings as full as they can be: s survivals, T apart, and a crash right after the last.
    assert most == (windows if goal_period == 1 else windows + 1)
    assert most <= math.ceil(window / goal_period) + 1


def test_resume_is_exact(torch_device):
    """A record that continues from a state dictionary resolves what one that was never closed resolves."""
    book, other = (make_interactions(4, torch_device) for _ in range(2))
    advance(book, make_step(4, torch_device))
    issue(book, [0, 1, 2], [0.0, 1.0, 2.0], torch_device)
    advance(book, make_step(4, torch_device, terminated=[1], reward=3.0))
    saved = book.state_dict()
    kept = {name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in saved.items()}
    results = []
    for interactions in (book, other):
        if interactions is other:
            other.load_state_dict(saved)
        advance(interactions, make_step(4, torch_device, goal_due=[0], reward=5.0))
        issue(interactions, [0], [7.0], torch_device)
        advance(interactions, make_step(4, torch_device, terminated=[0], goal_due=[2]))
        results.append(vars(interactions.resolved()) | {"now": torch.tensor(interactions.now)})
    assert results[0].keys() == results[1].keys()
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name
    assert len(results[0]["env"]) == 4
    assert results[0]["reward"].tolist() == [8.0, 0.0, 0.0, 9.0]
    for name, value in kept.items():  # the steps since have not reached into it
        assert torch.equal(saved[name], value) if isinstance(value, torch.Tensor) else saved[name] == value


def test_notes_and_probes_come_back(torch_device):
    """Whole numbers up to 2^24 - 1 and the marks of uniform goals come back with their own interactions."""
    interactions = make_interactions(4, torch_device)
    rows = torch.tensor([2, 0, 3], device=torch_device)
    parts = [torch.zeros(3, size, device=torch_device) for size in (STATE_DIM, GOAL_DIM, GOAL_DIM)]
    score = torch.zeros(3, device=torch_device)
    note = torch.tensor([2**24 - 1, 0, 12_345_679], device=torch_device)
    probe = torch.tensor([False, True, True], device=torch_device)
    interactions.open(rows, *parts, score, horizon=3, probe=probe, note=note)
    advance(interactions, make_step(4, torch_device, goal_due=[0, 2, 3]))
    resolved = interactions.resolved()
    assert resolved.env.tolist() == [0, 2, 3]
    assert resolved.note.tolist() == [0, 2**24 - 1, 12_345_679]
    assert resolved.probe.tolist() == [True, False, True]
    interactions.open(rows, *parts, score, horizon=3)
    advance(interactions, make_step(4, torch_device, terminated=[0, 2, 3]))
    newest = interactions.resolved()
    newest = newest.where(newest.resolved == 2)
    assert (newest.note == 0).all()  # of what was not given nothing is left over
    assert not newest.probe.any()


def test_tracking_is_the_mean_over_the_period(torch_device):
    """Each group has a column: its mean over all T steps, with 0 from the crash on; rewards are summed beside it."""
    interactions = Interactions(3, STATE_DIM, GOAL_DIM, 3, 8, torch_device, groups=2)
    issue(interactions, [0, 1], [0.0, 1.0], torch_device, horizon=4)
    tracking = torch.tensor([[1.0, 0.25], [0.5, 0.0], [1.0, 1.0]], device=torch_device)
    for t in range(4):
        terminated = [1] if t == 2 else []
        step = make_step(3, torch_device, terminated=terminated, goal_due=[0] if t == 3 else [], reward=2.0)
        step.tracking = tracking * (t + 1) / 4
        advance(interactions, step)
    resolved = interactions.resolved()
    assert resolved.tracking.shape == (2, 2)
    assert resolved.tracking[0].tolist() == [0.625, 0.15625]  # (1 + 2 + 3 + 4) / 16 of each
    assert resolved.tracking[1].tolist() == [0.09375, 0.0]  # (1 + 2) / 16 of one half
    assert resolved.reward.tolist() == [8.0, 4.0]


def test_without_groups_the_reward_is_the_tracking(torch_device):
    """Where a step tells no tracking, it is the mean reward over T steps, in one column."""
    interactions = make_interactions(1, torch_device, goal_period=4)
    issue(interactions, [0], [0.0], torch_device, horizon=4)
    for t in range(4):
        advance(interactions, make_step(1, torch_device, goal_due=[0] if t == 3 else [], reward=0.5 * t))
    assert interactions.resolved().tracking.tolist() == [[0.75]]


def test_issued_lists_everything_once(torch_device):
    """Pending and resolved interactions that were issued after a step are listed once each, with what was decided."""
    interactions = make_interactions(3, torch_device)
    issue(interactions, [0, 1], [10.0, 11.0], torch_device)  # after step 0
    advance(interactions, make_step(3, torch_device, terminated=[0]))
    issue(interactions, [2], [12.0], torch_device)  # after step 1
    advance(interactions, make_step(3, torch_device, goal_due=[1]))
    issue(interactions, [1], [13.0], torch_device)  # after step 2
    for since, expected in (
        (-1, [(0, 10), (1, 11), (1, 13), (2, 12)]),
        (0, [(1, 13), (2, 12)]),
        (1, [(1, 13)]),
        (2, []),
    ):
        env, state, goal, next_goal = interactions.issued(since)
        assert sorted(zip(env.tolist(), state[:, 0].tolist(), strict=True)) == expected
        assert torch.equal(goal[:, 0], state[:, 0] + 0.25)
        assert torch.equal(next_goal[:, 1], state[:, 0] + 0.5)


def test_a_view_without_scores_is_the_same_but_for_them(torch_device):
    """It shows every interaction as it is, and NaN for what another selector thought; the original keeps its scores."""
    interactions = make_interactions(2, torch_device)
    issue(interactions, [0, 1], [3.0, 4.0], torch_device)
    view = interactions.without_scores()
    advance(interactions, make_step(2, torch_device, terminated=[1], goal_due=[0]))
    shown, true = interactions.without_scores().resolved(), interactions.resolved()
    assert true.score.tolist() == [3.75, 4.75]
    assert shown.score.isnan().all()
    for name in set(Resolved.__dataclass_fields__) - {"score"}:
        assert torch.equal(getattr(shown, name), getattr(true, name)), name
    assert torch.equal(view.resolved().crashed, true.crashed)  # it shares the memory


def test_every_interaction_has_a_horizon_of_its_own(torch_device):
    """Tracking is the mean over the horizon that an interaction was opened with, whatever those of the others are."""
    interactions = make_interactions(3, torch_device)
    issue(interactions, [0, 1, 2], [0.0, 1.0, 2.0], torch_device, horizon=torch.tensor([2, 4, 8], device=torch_device))
    for _ in range(2):
        advance(interactions, make_step(3, torch_device, reward=1.0))
    advance(interactions, make_step(3, torch_device, goal_due=[0, 1], terminated=[2], reward=1.0))
    resolved = interactions.resolved()
    assert resolved.horizon.tolist() == [2, 4, 8]
    assert resolved.tracking.flatten().tolist() == [1.5, 0.75, 0.25]  # the step of the crash does not count


def test_what_was_executed_is_what_comes_back(torch_device):
    """Where a world pursued another goal than was issued, that one is learnt from; the others keep theirs."""
    interactions = make_interactions(3, torch_device)
    issue(interactions, [0, 1, 2], [0.0, 1.0, 2.0], torch_device)
    executed = torch.tensor([7.0, 8.0], device=torch_device).expand(3, 2)
    interactions.execute(torch.tensor([False, True, False], device=torch_device), executed)
    advance(interactions, make_step(3, torch_device, goal_due=[0, 1, 2]))
    resolved = interactions.resolved()
    assert resolved.next_goal.tolist() == [[0.5, 0.5], [7.0, 8.0], [2.5, 2.5]]
    assert resolved.goal.tolist() == [[0.25, 0.25], [1.25, 1.25], [2.25, 2.25]]


def test_the_oldest_makes_way_where_a_ring_is_full(torch_device):
    """A world keeps as many interactions as its ring holds, however long the window is."""
    interactions = Interactions(1, STATE_DIM, GOAL_DIM, 2, 1000, torch_device)
    for mark in (1.0, 2.0, 3.0):
        issue(interactions, [0], [mark], torch_device)
        advance(interactions, make_step(1, torch_device, goal_due=[0]))
    assert sorted(interactions.resolved().state[:, 0].tolist()) == [2.0, 3.0]


def test_what_is_stored_carries_no_gradient(torch_device):
    """States, goals, scores and rewards of a caller who records gradients are kept without them."""
    interactions = make_interactions(2, torch_device)
    rows, score = torch.arange(2, device=torch_device), torch.zeros(2, device=torch_device, requires_grad=True)
    sizes = (STATE_DIM, GOAL_DIM, GOAL_DIM)
    parts = [torch.zeros(2, size, device=torch_device, requires_grad=True) for size in sizes]
    interactions.open(rows, *parts, 2 * score, horizon=3)
    interactions.execute(rows >= 0, 2 * parts[2])
    step = make_step(2, torch_device, goal_due=[0, 1])
    step.reward.requires_grad_()
    advance(interactions, step)
    resolved = interactions.resolved()
    assert len(resolved) == 2
    assert not any(getattr(resolved, name).requires_grad for name in Resolved.__dataclass_fields__)
