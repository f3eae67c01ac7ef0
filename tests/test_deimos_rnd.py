"""Random network distillation over goals: what it is surprised by, and by what it is whitened."""

import math

import pytest
import torch

from deimos.goals.interactions import Interactions
from deimos.goals.methods import method
from deimos.goals.selector import Spaces
from deimos.goals.selectors import rnd
from deimos.nn import mlps

CPU = torch.device("cpu")
NUM_ENVS, CANDIDATES = 200, 20
SPACES = Spaces(num_envs=NUM_ENVS, state_dim=4, goal_dim=2, goal_period=5, device=CPU)
ROWS = torch.arange(NUM_ENVS)


class World:
    """Decisions whose candidates are uniform in [-1, 1]^2, and their outcomes."""

    def __init__(self, seed=0, **changes):
        self.selector = rnd.Config(**changes).build(SPACES, seed)
        self.interactions = Interactions(NUM_ENVS, 4, 2, 5, 10, CPU)
        self.generator = torch.Generator().manual_seed(seed)
        self.constant = False

    def decision(self):
        """The arguments of ``propose`` for a decision in every world."""
        state = torch.randn(NUM_ENVS, 4, generator=self.generator)
        if self.constant:
            state[:, 1] = 3.0
        goal, candidates = (
            torch.rand(*shape, generator=self.generator) * 2 - 1 for shape in ((NUM_ENVS, 2), (NUM_ENVS, CANDIDATES, 2))
        )
        return ROWS, state, goal, candidates, torch.rand(NUM_ENVS, 4, generator=self.generator)

    def update(self, choose=None):
        """Decide once in every world, by the selector or by ``choose``, and learn from it; returns the log."""
        arguments = self.decision()
        proposal = self.selector.propose(*arguments)
        chosen = proposal.goal if choose is None else choose(arguments[3])
        self.selector.issued(*arguments[:4], proposal)
        self.interactions.now += 1
        self.interactions.open(ROWS, arguments[1], arguments[2], chosen, proposal.score, horizon=5)
        return self.selector.learn(self.interactions, None)


@pytest.mark.parametrize("kernel", [False, True])
def test_scores_are_the_predictors_errors(monkeypatch, kernel):
    """A surprise is the mean squared error between the two networks on whitened (state, goal, candidate)."""
    if not kernel:
        monkeypatch.setattr(mlps, "_kernel", lambda nets: None)
    world = World()
    assert (world.selector._predictor._kernel is not None) == kernel
    world.update()
    selector = world.selector
    _, state, goal, candidates, _ = world.decision()
    everything = torch.cat([torch.cat([state, goal], 1).unsqueeze(1).expand(-1, CANDIDATES, -1), candidates], dim=2)
    whitened = ((everything - selector._mean) * selector._scale).clamp(-5, 5)
    with torch.no_grad():
        expected = (selector.predictor(whitened) - selector.target(whitened)).square().mean(2)
    torch.testing.assert_close(selector.surprise(state, goal, candidates), expected, rtol=1e-3, atol=1e-5)


def test_raw_rnd_sees_inputs_as_they_are():
    """Its networks are applied to what it is given, neither whitened nor clipped; by default they are."""
    for whiten in (False, True):
        world = World(whiten=whiten)
        for _ in range(6):
            world.update()
        selector, (_, state, goal, candidates, _) = world.selector, world.decision()
        assert selector.fitted
        state = 30.0 * state
        inputs = torch.cat([torch.cat([state, goal], 1).unsqueeze(1).expand(-1, CANDIDATES, -1), candidates], dim=2)
        error = (selector.predictor(inputs) - selector.target(inputs)).square().mean(2).detach()
        surprise = selector.surprise(state, goal, candidates)
        assert torch.allclose(surprise, error, rtol=1e-3, atol=1e-3) != whiten
    assert method("rnd-raw") == rnd.Config(whiten=False)


def test_surprises_fit_the_workspace():
    """Many decisions are scored in parts, whose numbers do not depend on where they are split."""
    world = World()
    world.update()
    selector, (_, state, goal, candidates, _) = world.selector, world.decision()
    whole, nets, sizes = selector.surprise(state, goal, candidates), selector._predictor, []
    nets._workspace = 2**18
    score = nets.score
    nets.score = lambda context, goals: (sizes.append(len(context)), score(context, goals))[1]
    torch.testing.assert_close(selector.surprise(state, goal, candidates), whole, rtol=1e-5, atol=1e-6)
    assert sum(sizes) == NUM_ENVS
    assert max(sizes) * CANDIDATES * 2 * 64 * 4 <= 2**18  # a layer's inputs and outputs, of 4 bytes each
    assert len(selector.surprise(state[:0], goal[:0], candidates[:0])) == 0


@pytest.mark.parametrize("rule", ["argmax", "proportional"])
def test_the_most_surprising_goal_or_in_proportion(rule):
    """Argmax takes the largest surprise; proportional draws the others too, and larger ones more often."""
    world = World(rule=rule)
    world.update()
    arguments = world.decision()
    surprise = world.selector.surprise(*arguments[1:4])
    proposal = world.selector.propose(*arguments)
    best = surprise.amax(1)
    assert torch.equal(proposal.score, best) == (rule == "argmax")
    assert proposal.score.mean() > surprise.mean()


def test_before_the_first_update_it_is_uniform():
    """As long as nothing can be whitened it picks as Uniform does and has no opinion."""
    world = World()
    rows, state, goal, candidates, draws = world.decision()
    proposal = world.selector.propose(rows, state, goal, candidates, draws)
    assert proposal.score.isnan().all()
    assert torch.equal(proposal.goal, candidates[rows, (draws[:, 0] * CANDIDATES).long()])


def test_whitening_knows_uniform_candidates_only():
    """Mean and spread of goals are those of what could have been chosen, whatever is: only corners, say."""
    world = World()
    states, goals = [], []

    def corner(candidates):
        goals.append(candidates[:, 0].clone())
        return torch.ones(NUM_ENVS, 2)

    for _ in range(30):
        world.update(corner)
        states.append(torch.cat(world.interactions.issued(world.interactions.now - 1)[1:3], dim=1))
    selector = world.selector
    seen = torch.cat([torch.cat(states), torch.cat(goals)], dim=1).double()
    torch.testing.assert_close(selector._mean.double(), seen.mean(0), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(1 / selector._scale.double(), seen.std(0, correction=0), rtol=1e-5, atol=0)
    assert (selector._mean[-2:].abs() < 0.05).all()


def test_what_never_changes_is_ignored():
    """A constant input is whitened to 0, before and after it changes, and nothing becomes infinite."""
    world = World()
    world.constant = True
    world.update()
    _, state, goal, candidates, _ = world.decision()
    before = world.selector.surprise(state, goal, candidates)
    state[:, 1] = 1000.0
    assert torch.equal(world.selector.surprise(state, goal, candidates), before)
    assert before.isfinite().all()


def test_surprise_falls_where_goals_repeat():
    """Goals that are issued again and again become known, by a factor of three; those that never are stay as new."""
    world = World(learning_rate=3e-3)

    def left(candidates):
        return candidates[:, 0] * torch.tensor([0.2, 1.0]) - torch.tensor([0.8, 0.0])

    world.update(left)
    _, state, goal, candidates, _ = world.decision()
    known, unknown = left(candidates).unsqueeze(1), -left(candidates).unsqueeze(1)
    first = [world.selector.surprise(state, goal, options).mean().item() for options in (known, unknown)]
    target = [parameter.clone() for parameter in world.selector.target.parameters()]
    rows = [world.update(left) for _ in range(150)]
    last = [world.selector.surprise(state, goal, options).mean().item() for options in (known, unknown)]
    assert last[0] < first[0] / 3
    assert last[1] > 2 * last[0]
    assert rows[-1]["rnd/loss"] < rows[0]["rnd/loss"] / 3
    assert all(torch.equal(a, b) for a, b in zip(target, world.selector.target.parameters(), strict=True))


def test_every_goal_is_learnt_from_once():
    """An update uses what was issued since the last one, and none when nothing was."""
    world = World()
    world.update()
    assert world.selector._moments[0, 0] == NUM_ENVS
    before = [parameter.clone() for parameter in world.selector.predictor.parameters()]
    row = world.selector.learn(world.interactions, None)
    assert all(math.isnan(value) for value in row.values())
    assert all(torch.equal(a, b) for a, b in zip(before, world.selector.predictor.parameters(), strict=True))
    world.update()
    assert world.selector._moments[0, 0] == 2 * NUM_ENVS


def test_goals_that_somebody_else_chose_do_not_whiten():
    """In worlds where it has not been asked yet it knows no uniform candidate, and leaves them out."""
    world = World()
    _, state, goal, candidates, draws = world.decision()
    world.interactions.now = 1
    world.interactions.open(ROWS, state, goal, candidates[:, 0], draws[:, 0], horizon=5)
    assert math.isnan(world.selector.learn(world.interactions, None)["rnd/loss"])
    assert not world.selector.fitted
    world.interactions.now = 2
    world.interactions.open(ROWS, state, goal, candidates[:, 0], draws[:, 0], horizon=5)
    decision = ROWS[:50], state[:50], goal[:50], candidates[:50]
    world.selector.issued(*decision, world.selector.propose(*decision, draws[:50]))
    assert math.isfinite(world.selector.learn(world.interactions, None)["rnd/loss"])
    assert world.selector._moments[0, 0] == 50


def test_weights_come_from_the_seed_alone():
    """Two selectors of one seed have the same networks whatever torch's own generator has drawn."""
    first = rnd.Config().build(SPACES, 0)
    torch.rand(11)
    second, other = rnd.Config().build(SPACES, 0), rnd.Config().build(SPACES, 1)
    for name in ("target", "predictor"):
        weights = [list(getattr(selector, name).parameters()) for selector in (first, second, other)]
        assert all(torch.equal(a, b) for a, b in zip(weights[0], weights[1], strict=True))
        assert not torch.equal(weights[0][0], weights[2][0])
