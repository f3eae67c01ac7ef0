"""Curricula that follow how well goals are tracked: the range that grows, and the grid of weights."""

import pytest
import torch

from deimos.goals.interactions import Interactions
from deimos.goals.selector import Spaces
from deimos.goals.selectors import cl, grid

CPU = torch.device("cpu")
GROUPS = (slice(0, 2), slice(2, 3))
SPACES = Spaces(num_envs=10, state_dim=2, goal_dim=3, goal_period=5, device=CPU, groups=GROUPS)


class Ledger:
    """Interactions of five steps each in ten worlds, with the tracking that a test asks for."""

    def __init__(self):
        self.now = 0
        self.kept = Interactions(10, 2, 3, 5, 10, CPU, groups=2)

    def update(self, selector, tracking, issued=None, goals=None):
        """One update after 6 more steps, on ten interactions; ``tracking`` is that of the two groups."""
        kept, rows = self.kept, torch.arange(10)
        self.now += 1
        kept.now = self.now if issued is None else issued
        goals = torch.zeros(10, 3) if goals is None else torch.tensor(goals).expand(10, -1)
        kept.open(rows, torch.zeros(10, 2), torch.zeros(10, 3), goals, torch.zeros(10), horizon=5)
        kept.now = self.now
        no = torch.zeros(10, dtype=torch.bool)
        for _ in range(5):
            kept.advance(torch.zeros(10), no, torch.tensor(tracking).expand(10, -1))
        kept.resolve(rows, no, ~no)
        self.now = kept.now
        return selector.learn(kept, None)


def curriculum(**changes):
    config = {"start": 0.25, "growth": 0.25, "threshold": 0.8, "min_interactions": 10}
    return cl.Config(**(config | changes)).build(SPACES, 0)


def test_a_group_grows_when_it_is_tracked_well():
    """A group's share rises by the growth where its mean tracking reaches the threshold, up to 1, and never falls."""
    selector, ledger = curriculum(), Ledger()
    assert selector.first_goals_scaled
    shares = []
    for _ in range(5):
        row = ledger.update(selector, [0.9, 0.7])
        shares.append(selector.goal_range().tolist())
        assert row["cl/tracking_0"] == pytest.approx(0.9, abs=1e-6)
        assert row["cl/tracking_1"] == pytest.approx(0.7, abs=1e-6)
    assert shares == [[x, x, 0.25] for x in (0.5, 0.75, 1.0, 1.0, 1.0)]
    ledger.update(selector, [0.1, 0.81])
    assert selector.goal_range().tolist() == [1.0, 1.0, 0.5]


def test_it_waits_for_enough_interactions():
    """However well goals are tracked, nothing grows on fewer than ``min_interactions``; all of them count."""
    selector, ledger = curriculum(min_interactions=25), Ledger()
    grown = []
    for tracking in (1.0, 1.0, 0.5, 1.0, 1.0, 0.3, 0.9):
        ledger.update(selector, [tracking, 0.0])
        grown.append(selector.share[0])
    # Means of three updates each: 0.83 reaches the threshold, 0.77 does not.
    assert grown == [0.25, 0.25, 0.5, 0.5, 0.5, 0.5, 0.5]


def test_goals_of_the_old_range_say_nothing_of_the_new():
    """After a growth, goals that were issued before it or on its very step do not count; later ones do."""
    selector, ledger = curriculum(), Ledger()
    ledger.update(selector, [0.9, 0.0])
    grown_at = ledger.now
    assert selector.share[0] == 0.5
    for issued in (grown_at - 3, grown_at):
        assert torch.tensor(ledger.update(selector, [1.0, 0.0], issued=issued)["cl/tracking_0"]).isnan()
        assert selector.share[0] == 0.5
    ledger.update(selector, [1.0, 0.0], issued=grown_at + 1)
    assert selector.share[0] == 0.75


def test_a_saved_curriculum_stays_what_it_was():
    """What happens after a state was taken does not reach into it, and from it the curriculum continues."""
    selector, other, ledger = curriculum(), curriculum(), Ledger()
    ledger.update(selector, [0.9, 0.0])
    state = selector.state_dict()
    ledger.update(selector, [0.9, 0.9])
    other.load_state_dict(state)
    assert other.share == [0.5, 0.25]
    assert other.goal_range().tolist() == [0.5, 0.5, 0.25]


def adaptive(bins=8, corner=(1.0, 1.0, 1.0), **changes):
    """A grid selector that knows that goals lie between ``corner`` and its opposite."""
    selector = grid.Config(bins=bins, **changes).build(SPACES, 0)
    corners = torch.tensor([[corner, corner]]) * torch.tensor([[1.0], [-1.0]])
    decision = torch.zeros(1).long(), torch.zeros(1, 2), torch.zeros(1, 3), corners
    selector.issued(*decision, selector.propose(*decision, torch.zeros(1, 4)))
    selector.learn(Interactions(10, 2, 3, 5, 10, CPU, groups=2), None)
    assert selector.fitted
    return selector


def test_the_middle_of_the_range_has_weight_first():
    """At the start the cells whose centre lies within the share weigh 1 and all others nothing."""
    weights = adaptive(start=0.5)._weights
    inside = torch.tensor([0, 0, 1, 1, 1, 1, 0, 0]).float()
    assert torch.equal(weights[0], inside.unsqueeze(1) * inside)
    assert torch.equal(weights[1], inside)


@pytest.mark.parametrize("reach", [0.5, 1.0, 2.0])
def test_neighbours_are_raised_exactly(reach):
    """A well-tracked goal raises its cell and all within reach along every component by the growth, and no other."""
    selector = adaptive(start=0.5, growth=0.2, reach=reach)
    before = [weights.clone() for weights in selector._weights]
    one = torch.tensor([[0.9, -0.4, 0.1]])  # cells 7, 2 and 4
    selector._raise(0, selector._cells(one)[:, :2])
    for i in range(8):
        for j in range(8):
            near = abs(i - 7) <= reach and abs(j - 2) <= reach
            expected = min(1.0, before[0][i, j].item() + 0.2 * near)
            assert selector._weights[0][i, j].item() == pytest.approx(expected)
    assert torch.equal(selector._weights[1], before[1])


def test_every_good_goal_counts_and_weights_end_at_1():
    """Two good goals in one cell raise it twice, and however many there are no weight exceeds 1."""
    selector = adaptive(start=0.1, growth=0.3)
    selector._weights[1].zero_()
    cells = selector._cells(torch.tensor([[0.0, 0.0, 0.9]] * 2 + [[0.0, 0.0, -0.9]] * 20))[:, 2:]
    selector._raise(1, cells)
    assert selector._weights[1].tolist() == pytest.approx([1.0, 1.0, 0, 0, 0, 0, 0.6, 0.6])


def test_groups_have_grids_of_their_own():
    """Only the group that reached the threshold is raised, at the cell of its own components of the goal as issued."""
    selector, ledger = adaptive(start=0.1, growth=0.05), Ledger()
    before = [weights.clone() for weights in selector._weights]
    row = ledger.update(selector, [0.79, 0.85], goals=[0.9, 0.9, 0.9])
    assert (row["grid/good_0"], row["grid/good_1"]) == (0.0, 1.0)
    assert torch.equal(selector._weights[0], before[0])
    risen = selector._weights[1] - before[1]
    assert risen.tolist() == pytest.approx([0, 0, 0, 0, 0, 0, 0.5, 0.5])  # ten worlds


def test_what_never_varies_is_always_in_one_cell():
    """A component of 0 alone, such as the speed of a robot that stands, does not keep the grid from its work."""
    selector = adaptive(corner=(1.0, 0.0, 0.5))
    assert selector._cells(torch.tensor([[0.9, 0.0, -0.2], [-0.9, 0.0, 0.45]])).tolist() == [[7, 4, 2], [0, 4, 7]]


def test_candidates_are_drawn_by_their_cells():
    """A candidate's chance is the product of its groups' weights; where none has any, all are as likely."""
    selector = adaptive(start=0.5)
    selector._weights[0][6, 3], selector._weights[1][7] = 0.5, 0.25
    candidates = torch.tensor([[0.1, 0.1, 0.1], [0.6, -0.1, 0.1], [0.6, -0.1, 0.9], [0.9, 0.9, 0.1]])
    n = 13_000
    draws = torch.zeros(n, 4)
    draws[:, 0] = (torch.arange(n) + 0.5) / n
    arguments = (torch.arange(n), torch.zeros(n, 2), torch.zeros(n, 3))
    proposal = selector.propose(*arguments, candidates.expand(n, -1, -1), draws)
    assert sorted(set(proposal.score.tolist())) == [0.125, 0.5, 1.0]
    assert [(proposal.score == s).sum().item() for s in (1.0, 0.5, 0.125)] == [8000, 4000, 1000]
    proposal = selector.propose(*arguments, -torch.ones(n, 2, 3) + torch.tensor([[0.0], [0.1]]), draws)
    assert (proposal.score == 0).all()
    assert (proposal.goal[:, 0] == -1).sum() == n // 2


def test_a_grid_that_does_not_fit_is_refused():
    """Cells are counted before they are allocated."""
    spaces_of_six = Spaces(num_envs=1, state_dim=1, goal_dim=6, goal_period=1, device=CPU)
    with pytest.raises(ValueError, match=r"bins must give at most 2\^20 cells per group, got 16 bins: 16777216 cells"):
        grid.Config(bins=16).build(spaces_of_six, 0)
