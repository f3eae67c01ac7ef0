"""Every selector that there is, found by name; and the rules of the Director."""

import pytest
import torch

from deimos import picks, plugins, selectors
from deimos.envs import particle
from deimos.goal_loop import GoalLoop, spaces
from deimos.interactions import Interactions
from deimos.methods import METHODS, method
from deimos.selector import Spaces
from deimos.selectors import director, uniform

SPACES = Spaces(num_envs=40, state_dim=9, goal_dim=3, goal_period=5, device=torch.device("cpu"), total_steps=96)
ALL = {name: plugins.load(selectors, name).Config() for name in plugins.names(selectors)} | METHODS


def decision(rows=40, candidates=100, seed=0):
    """The arguments of ``propose`` for a random decision in each of ``rows`` worlds."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((rows, 9), (rows, 3), (rows, candidates, 3))
    state, goal, options = (torch.randn(*shape, generator=generator) for shape in shapes)
    return torch.arange(rows), state, goal, options, torch.rand(rows, 4, generator=generator)


def fitted(config, seed=0):
    """A Director whose network has learnt that large first components of a goal crash."""
    selector = config.build(SPACES, seed)
    interactions = Interactions(40, 9, 3, 5, 40, SPACES.device)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(9):
        goal = torch.randn(40, 3, generator=generator)
        rows = torch.arange(40)
        interactions.open(rows, torch.randn(40, 9, generator=generator), goal, goal, torch.zeros(40))
        interactions.now += 4
        interactions._marks[rows, interactions._cursor % interactions._slots] = torch.stack(
            [(goal[:, 0] > 0).long(), interactions.issued_at, torch.full((40,), interactions.now)], dim=1
        )
        interactions._ring[rows, interactions._cursor % interactions._slots] = interactions._pending
        interactions._cursor += 1
    for _ in range(30):
        selector.learn(interactions, None)
    assert selector.fear.fitted
    return selector


@pytest.mark.parametrize("name", ALL)
def test_it_chooses_a_candidate(name):
    """Every chosen goal is one of that world's own candidates, with a score and a leave to learn per row."""
    selector = ALL[name].build(SPACES, 0)
    rows, state, goal, candidates, draws = decision(candidates=selector.num_candidates)
    proposal = selector.propose(rows, state, goal, candidates, draws)
    assert (proposal.goal.unsqueeze(1) == candidates).all(2).any(1).all()
    assert proposal.score.shape == proposal.learn.shape == (40,)
    assert proposal.learn.dtype == torch.bool


@pytest.mark.parametrize("name", ALL)
def test_it_is_deterministic_and_resumes_bit_for_bit(name):
    """Two selectors of one seed, and one that was saved and loaded, run through the same worlds alike."""
    config = particle.Config(goal_period=6, max_speed=400.0, max_force=100.0)

    def worlds(seed=0):
        env = config.build(64, torch.device("cpu"), seed)
        return GoalLoop(env, ALL[name].build(spaces(env), seed))

    def go(loop, steps):
        for t in range(steps):
            loop.advance(loop.env.step(torch.sin(torch.arange(192.0).view(64, 3) + loop.interactions.now) * 90))
            if t % 12 == 11:
                loop.selector.learn(loop.interactions, None)

    straight, again, resumed = worlds(), worlds(), worlds(seed=0)
    go(straight, 96)
    go(again, 48)
    resumed.load_state_dict(again.state_dict())
    go(again, 48)
    go(resumed, 48)
    for other in (again, resumed):
        assert torch.equal(straight.env.obs, other.env.obs)


@pytest.mark.parametrize("name", ALL)
def test_the_batch_does_not_matter(name):
    """A world's goal is the same whether it is chosen alone or among others."""
    selector = ALL[name].build(SPACES, 0)
    rows, state, goal, candidates, draws = decision(candidates=selector.num_candidates)
    together = selector.propose(rows, state, goal, candidates, draws).goal
    alone = selector.propose(rows[7:8], state[7:8], goal[7:8], candidates[7:8], draws[7:8]).goal
    assert torch.equal(together[7:8], alone)


def test_p_0_is_uniform():
    """With p = 0 a fitted Director picks the very goals that Uniform picks among the same candidates."""
    arguments = decision()
    afraid = fitted(director.Config(percentile=0)).propose(*arguments)
    free = uniform.Config(candidates=100).build(SPACES, 0).propose(*arguments)
    assert torch.equal(afraid.goal, free.goal)


def test_before_it_has_learnt_a_director_is_uniform():
    """Until it has seen both classes the Director picks as Uniform does, and has no opinion."""
    arguments = decision()
    proposal = director.Config(percentile=90).build(SPACES, 0).propose(*arguments)
    assert torch.equal(proposal.goal, uniform.Config(candidates=100).build(SPACES, 0).propose(*arguments).goal)
    assert proposal.score.isnan().all()


@pytest.mark.parametrize(("percentile", "kept"), [(0, 100), (10, 90), (25, 75), (90, 10), (99.5, 1), (100, 1)])
def test_the_bucket_holds_k_of_n(percentile, kept):
    """Over all draws exactly the k = max(1, N - floor(p N / 100)) highest scores are picked, each equally often."""
    score = torch.randn(1, 100, generator=torch.Generator().manual_seed(0)).expand(1000, -1)
    draw = (torch.arange(1000) + 0.5) / 1000
    pick = picks.by_rule(score, draw, "percentile", percentile)
    assert set(pick.tolist()) == set(score[0].topk(kept).indices.tolist())
    counts = torch.bincount(pick, minlength=100)
    assert counts.max() - counts[counts > 0].min() <= 1


def test_ties_at_the_edge_keep_the_bucket_exact():
    """Where scores tie, still exactly k candidates can be picked, all that beat the tie among them."""
    score = torch.zeros(1, 100)
    score[0, [3, 60]] = 1.0
    draw = (torch.arange(1000) + 0.5) / 1000
    picked = set(picks.by_rule(score.expand(1000, -1), draw, "percentile", 90).tolist())
    assert len(picked) == 10
    assert {3, 60} <= picked
    assert len(set(picks.by_rule(torch.zeros(1000, 100), draw, "percentile", 25).tolist())) == 75


def test_coop_and_antagonist_take_the_ends():
    """Coop takes the goal of lowest fear and Antagonist that of highest; p = 100 is Antagonist."""
    arguments = decision()
    for name, pick in (("coop", torch.argmin), ("antagonist", torch.argmax)):
        selector = fitted(method(name))
        score = selector.fear.score(*arguments[1:4])
        chosen = selector.propose(*arguments)
        assert torch.equal(chosen.goal, arguments[3][torch.arange(40), pick(score, 1)])
        torch.testing.assert_close(chosen.score, score.amin(1) if name == "coop" else score.amax(1))
    score = torch.randn(20, 100)
    assert torch.equal(picks.by_rule(score, torch.rand(20), "percentile", 100), score.argmax(1))


def test_a_higher_percentile_is_more_frightening():
    """The mean fear of the chosen goals rises from Coop over p = 0, 25, 75 to Antagonist."""
    arguments = decision(rows=400)
    configs = [method("coop"), *[director.Config(percentile=p) for p in (0, 25, 75)], method("antagonist")]
    means = [fitted(config).propose(*arguments).score.mean().item() for config in configs]
    assert means == sorted(means)
    assert means[-1] - means[0] > 1.0


def test_a_large_logit_still_ranks():
    """Scores where a float32 sigmoid is exactly 1 are still told apart."""
    score = torch.tensor([[18.0, 25.0, 21.0]])
    assert (torch.sigmoid(score) == 1.0).all()
    assert picks.by_rule(score, torch.tensor([0.5]), "argmax", 0).item() == 1


@pytest.mark.parametrize(
    ("config", "field", "value", "message"),
    [
        (director.Config, "percentile", 101, r"percentile must be in \[0, 100\], got 101"),
        (director.Config, "percentile", float("nan"), "percentile must be in"),
        (director.Config, "rule", "max", "rule must be one of percentile, argmin, argmax, got 'max'"),
        (director.Config, "candidates", 0, "candidates must be at least 1, got 0"),
        (uniform.Config, "candidates", 0, "candidates must be at least 1, got 0"),
    ],
)
def test_config_rejects(config, field, value, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        config(**{field: value})


def test_an_unknown_method_lists_the_known_ones():
    """The message lists every method."""
    with pytest.raises(ValueError, match="no method 'p33'; there are: uniform, coop, p10"):
        method("p33")
