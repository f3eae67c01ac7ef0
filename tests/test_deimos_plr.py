"""Prioritized level replay over goals: scores, places, ranks and masks."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from deimos.goals.interactions import Interactions
from deimos.goals.selector import Spaces
from deimos.goals.selectors import plr

CPU = torch.device("cpu")
NUM_ENVS, PERIOD, STEPS = 24, 5, 8
SPACES = Spaces(num_envs=NUM_ENVS, state_dim=4, goal_dim=2, goal_period=PERIOD, device=CPU)


class Loop:
    """Worlds that crash at random while a PLR chooses their goals, and a list of all that happened."""

    def __init__(self, **changes):
        self.selector = plr.Config(**({"capacity": 40, "fill": 0.25, "candidates": 6} | changes)).build(SPACES, 0)
        self.interactions = Interactions(NUM_ENVS, 4, 2, PERIOD, 2 * PERIOD, CPU)
        self.rng = np.random.default_rng(0)
        self.clock = np.arange(NUM_ENVS) % PERIOD
        self.now = 0
        self.advantages = []  # of every step so far, shape (NUM_ENVS,) each
        self.closed = []  # world, issued, resolved, proposal's row: (goal, note, replayed)
        self.open = [None] * NUM_ENVS

    def random(self, *shape):
        """Uniform numbers, float32."""
        return torch.from_numpy(self.rng.random(shape, dtype=np.float32))

    def step(self):
        """One step of the worlds."""
        self.now += 1
        self.clock += 1
        crashed = torch.from_numpy(self.rng.random(NUM_ENVS) < 0.05)
        due = torch.from_numpy(self.clock >= PERIOD)
        ended = torch.nonzero(due | crashed).squeeze(1)
        self.interactions.advance(torch.zeros(NUM_ENVS), crashed)
        self.interactions.resolve(ended, crashed[ended], due[ended])
        for env in torch.nonzero(due | crashed).flatten().tolist():
            if self.open[env]:
                self.closed.append((env, self.open[env][0], self.now, self.open[env][1]))
            self.open[env] = None
        rows = torch.nonzero(due & ~crashed).squeeze(1)
        if len(rows):
            state, goal = self.random(len(rows), 4), self.random(len(rows), 2)
            candidates = self.random(len(rows), self.selector.num_candidates, 2)
            proposal = self.selector.propose(rows, state, goal, candidates, self.random(len(rows), 4))
            self.interactions.open(
                rows, state, goal, proposal.goal, proposal.score, PERIOD, probe=proposal.probe, note=proposal.note
            )
            for i, env in enumerate(rows.tolist()):
                self.open[env] = (self.now, (proposal.goal[i], int(proposal.note[i]), not proposal.probe[i]))
        self.clock[(due | crashed).numpy()] = 0
        self.advantages.append(self.random(NUM_ENVS) - 0.5)

    def update(self):
        """One rollout and what is learnt from it; returns what resolved in it, with the loss of each, by loops."""
        known = len(self.closed)
        for _ in range(STEPS):
            self.step()
        rollout = SimpleNamespace(num_steps=STEPS, advantage=torch.stack(self.advantages[-STEPS:]))
        self.row = self.selector.learn(self.interactions, rollout)
        found = []
        for env, issued, resolved, choice in self.closed[known:]:
            gains = [max(0.0, self.advantages[t][env].item()) for t in range(issued, resolved)]
            found.append((env, issued, resolved, choice, sum(gains) / len(gains)))
        return found


def test_positive_value_loss_is_a_sum_over_transitions(monkeypatch):
    """It is the mean of max(advantage, 0) over each interaction's own transitions, also where it spans rollouts."""
    loop, losses = Loop(), []
    method = plr.PLR._positive_value_loss

    def spied(self, interactions, done, rollout):
        losses.append((done, method(self, interactions, done, rollout)))
        return losses[-1][1]

    monkeypatch.setattr(plr.PLR, "_positive_value_loss", spied)
    spanning = 0
    for update in range(12):
        expected = sorted((env, issued, resolved, loss) for env, issued, resolved, _, loss in loop.update())
        done, loss = losses[-1]
        found = sorted(zip(done.env.tolist(), done.issued.tolist(), done.resolved.tolist(), loss.tolist(), strict=True))
        assert [row[:3] for row in found] == [row[:3] for row in expected]
        # Differences of sums of eight numbers below 1.
        np.testing.assert_allclose([row[3] for row in found], [row[3] for row in expected], rtol=0, atol=1e-5)
        spanning += sum(issued < STEPS * update < resolved for _, issued, resolved, _ in expected)
    assert spanning > 50


def test_an_interaction_longer_than_rollouts_is_summed_over_them():
    """With T of five rollouts nothing of what lies in between is lost."""
    spaces = Spaces(num_envs=1, state_dim=1, goal_dim=1, goal_period=10, device=CPU)
    selector = plr.Config(capacity=1, fill=1.0, candidates=1).build(spaces, 0)
    interactions = Interactions(1, 1, 1, 10, 20, CPU)
    one, no = torch.zeros(1, 1), torch.zeros(1, dtype=torch.bool)
    interactions.open(torch.zeros(1, dtype=torch.int64), one, one, one, torch.zeros(1), horizon=10, probe=~no)
    gains = torch.tensor([1.0, -3.0, 2.0, 0.5, -1.0, 4.0, 0.25, 0.0, 8.0, -2.0])
    for t in range(10):
        interactions.advance(torch.zeros(1), no)
        if t == 9:
            interactions.resolve(torch.zeros(1, dtype=torch.int64), no, ~no)
        if t % 2:
            row = selector.learn(interactions, SimpleNamespace(num_steps=2, advantage=gains[t - 1 : t + 1].view(2, 1)))
    assert row["plr/value_loss"] == pytest.approx((1 + 2 + 0.5 + 4 + 0.25 + 8) / 10)
    assert selector._score.tolist() == [pytest.approx(1.575)]


def test_the_buffer_holds_what_a_plain_list_holds():
    """Refreshed by means over worlds, the worst replaced by better new goals, nothing stale: as loops over lists."""
    loop = Loop()
    places = [None] * 40  # goal, score, step that it was made on
    refreshed = stale = 0
    for _ in range(40):
        found = loop.update()
        renewed = {}
        for _, issued, _, (_, note, replayed), loss in found:
            if replayed and places[note - 1][2] < issued:
                renewed.setdefault(note - 1, []).append(loss)
            stale += replayed and places[note - 1][2] >= issued
        for place, losses in renewed.items():
            places[place] = (places[place][0], sum(losses) / len(losses), places[place][2])
        refreshed += len(renewed)
        for loss, goal in sorted(((loss, c[0]) for *_, c, loss in found if not c[2]), key=lambda x: -x[0]):
            worst = min(range(40), key=lambda k: -np.inf if places[k] is None else places[k][1])
            if places[worst] is None or places[worst][1] < loss:
                places[worst] = (goal, loss, loop.now)
        kept = sorted((place[1], *place[0].tolist()) for place in places if place)
        selector = loop.selector
        filled = selector._score > -torch.inf
        got = sorted(torch.cat([selector._score[filled, None], selector._level[filled]], dim=1).tolist())
        np.testing.assert_allclose(got, kept, rtol=0, atol=1e-5)
        # Which of the free places is taken is the selector's own affair; from here on the list follows it.
        index = {tuple(level): k for k, level in enumerate(selector._level.tolist()) if filled[k]}
        moved = [None] * 40
        for place in places:
            if place:
                moved[index[tuple(place[0].tolist())]] = place
        places = moved
    assert refreshed > 50
    assert stale > 0
    assert loop.row["plr/filled"] == 1.0
    assert 0.5 < loop.row["plr/replayed"] <= 1.0


def test_a_note_on_a_replaced_level_is_not_written():
    """A goal that was issued on the step of an update which then replaced its level leaves the new one alone."""
    selector = plr.Config(capacity=2, fill=0.5).build(SPACES, 0)
    selector._score.copy_(torch.tensor([1.0, 2.0]))
    selector._made.fill_(10)
    fields = dict.fromkeys(("note", "issued", "resolved"))
    for issued, scores in ((9, [1.0, 2.0]), (10, [1.0, 2.0]), (11, [1.0, 7.0])):
        fields = {"note": torch.tensor([2]), "issued": torch.tensor([issued]), "resolved": torch.tensor([14])}
        selector._refresh(SimpleNamespace(**fields), torch.tensor([7.0]))
        assert selector._score.tolist() == scores
    assert selector._seen.tolist() == [0, 14]


@pytest.mark.parametrize("staleness", [0.0, 0.3, 1.0])
def test_levels_are_replayed_by_rank_and_age(staleness):
    """Chances are (1 - rho) rank^(-1 / beta) plus rho age, each normalised; free places have none."""
    selector = plr.Config(capacity=5, fill=0.5, staleness=staleness, temperature=0.5).build(SPACES, 0)
    selector._score.copy_(torch.tensor([0.5, -torch.inf, 3.0, 1.0, -torch.inf]))
    selector._seen.copy_(torch.tensor([90, 0, 60, 100, 0]))
    selector._weigh(100)
    rank = np.array([3, np.inf, 1, 2, np.inf]) ** -2.0
    age = np.array([10, 0, 40, 0, 0])
    expected = (1 - staleness) * rank / rank.sum() + staleness * age / age.sum()
    np.testing.assert_allclose(selector._upto.numpy(), expected.cumsum(), rtol=1e-6)
    assert selector.replaying

    selector._level.copy_(torch.arange(10.0).view(5, 2))
    n = 20_000
    draws = torch.zeros(n, 4)
    draws[:, 2] = (torch.arange(n) + 0.5) / n
    candidates = selector._level.expand(n, -1, -1) + 0.25
    proposal = selector.propose(torch.arange(n) % NUM_ENVS, torch.zeros(n, 4), torch.zeros(n, 2), candidates, draws)
    frequency = np.bincount(proposal.note.numpy(), minlength=6)[1:] / n
    np.testing.assert_allclose(frequency, expected, atol=2e-4)
    assert torch.equal(proposal.goal, selector._level[proposal.note - 1] + 0.25)  # the nearest candidate
    assert torch.equal(proposal.score, selector._score[proposal.note - 1])


def test_the_largest_draw_hits_a_level():
    """However the sum of the chances rounds, no draw below 1 leads to a free place."""
    for seed in range(50):
        selector = plr.Config(capacity=60, fill=0.1).build(SPACES, 0)
        selector._score[:30] = torch.rand(30, generator=torch.Generator().manual_seed(seed))
        selector._weigh(0)
        draws = torch.tensor([[0.0, 0.0, 1 - 2.0**-24, 0.0], [0.0, 0.0, 1.0, 0.0]])
        proposal = selector.propose(torch.arange(2), torch.zeros(2, 4), torch.zeros(2, 2), torch.zeros(2, 3, 2), draws)
        assert (proposal.note <= 30).all()
        assert proposal.score.isfinite().all()


def test_nothing_is_replayed_before_the_buffer_is_filled():
    """Below its share of levels every goal is uniform and marked so; above, the configured share is replayed."""
    loop = Loop(fill=1.0, replay=0.7)
    while not loop.selector.replaying:
        loop.update()
    assert not any(choice[2] for *_, choice in loop.closed)
    n = 20_000
    draws = loop.random(n, 4)
    arguments = (torch.arange(n) % NUM_ENVS, torch.zeros(n, 4), torch.zeros(n, 2), loop.random(n, 6, 2), draws)
    proposal = loop.selector.propose(*arguments)
    assert abs((~proposal.probe).float().mean().item() - 0.7) < 4 * (0.7 * 0.3 / n) ** 0.5
    assert torch.equal(proposal.note > 0, ~proposal.probe)
    assert torch.equal(proposal.score.isnan(), proposal.probe)
    assert proposal.weight is None


def test_the_robust_learner_takes_replayed_goals_only():
    """With ``robust`` the learner may use exactly what follows a replayed goal, from the first decision on."""
    loop = Loop(robust=True, replay=0.5)
    arguments = [torch.arange(4), torch.zeros(4, 4), torch.zeros(4, 2), loop.random(4, 6, 2), loop.random(4, 4)]
    assert not loop.selector.propose(*arguments).weight.any()
    while not loop.selector.replaying:
        loop.update()
    arguments[4][:, 1] = torch.tensor([0.0, 0.49, 0.51, 0.9])
    assert loop.selector.propose(*arguments).weight.tolist() == [1, 1, 0, 0]


def test_it_needs_the_learners_rollout():
    """Without advantages there is no score."""
    loop = Loop()
    with pytest.raises(ValueError, match="plr scores goals by advantages, so it needs the learner's rollout, got None"):
        loop.selector.learn(loop.interactions, None)
