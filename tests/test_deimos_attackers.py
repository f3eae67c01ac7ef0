"""Attackers: what each asks for, that their budgets do not depend on the policy, and planted policies."""

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from deimos.kernels.legged.state import RATE_SCALE, VELOCITY_SCALE

from deimos.app import cli
from deimos.checks import RunError
from deimos.goals.fear import Fear, FearConfig
from deimos.goals.interactions import Resolved
from deimos.run import attack
from deimos.run.attack import Explorer, argmax_director, attacker, learn_fear, names, quality, uniform_goals
from deimos.run.attackers import q_fear, search
from deimos.run.attackers.pooled import make_pool
from deimos.run.attackers.scripted import Scripted
from deimos.run.evaluation import EvalConfig, _identities, evaluate, make_target
from deimos.sim.envs import particle, quad, quad_arm

OLD = Path(__file__).parent / "data" / "run_0_1_0"  # of a policy that crashes
CPU = torch.device("cpu")
VARIANTS = ["absolute", "directional", "relative"]
SMALL = EvalConfig(
    worlds=60, steps=600, adversary_steps=300, oracle_worlds=8,
    fear=FearConfig(epochs=10, min_per_class=1),
)  # fmt: skip


def stay(obs):
    """A policy that never moves."""
    return torch.zeros(len(obs), 3)


def blind(variant="directional"):
    """A policy that follows its goals and never brakes."""
    return particle.Config(variant=variant).build(1, CPU, 0).reference_policy(brake=False)


@pytest.mark.parametrize("variant", VARIANTS)
def test_nobody_crashes_a_policy_that_stays(tmp_path, variant):
    """A policy that stays at the origin never crashes; attackers that would have to learn from crashes say so."""
    config, pool = particle.Config(variant=variant), tmp_path / "pool.pt"
    make_pool([make_target(blind(variant), config, SMALL, CPU)], pool)
    rows = evaluate(stay, config, replace(SMALL, attackers=tuple(names()), pool=pool), CPU)
    assert [row["goals"] for row in rows] == ["naive", *names()]
    assert [row["crashes"] for row in rows] == [0] * len(rows)
    learn = [row for row in rows if "adversary_crashes" in row and row["goals"] != "pooled"]
    assert [row["adversary_crashes"] for row in learn] == [0] * len(learn)
    assert {row["goals"]: row["uninformed"] for row in rows[1:]} == dict.fromkeys(names(), True) | {
        "scripted": False, "oracle": False, "pooled": False,
    }  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_scripted_crashes_a_policy_that_never_brakes(variant):
    """More than nine of ten of its goals crash a policy that follows them blindly, far more than uniform ones."""
    config = EvalConfig(worlds=500, steps=1000, attackers=("scripted",))
    naive, attacked = evaluate(blind(variant), particle.Config(variant=variant), config, CPU)
    assert attacked["crash_rate"] > 0.9
    assert attacked["interactions"] > 500
    assert attacked["crash_rate"] > 1.5 * naive["crash_rate"]


@pytest.mark.parametrize("variant", VARIANTS)
def test_scripted_goals_are_outward_and_valid(variant):
    """They lie in the box of uniform goals, on its surface, away from the origin; also for a particle that is there."""
    config = particle.Config(variant=variant, spawn_range=900.0)
    env = config.build(50, CPU, 0)
    env.tensors["position"][0] = 0.0
    position, rows = env.tensors["position"], torch.arange(50)
    goal = Scripted(env).propose(rows, env.state(env.obs), env.goal, env.sample_goals(rows, 1), env.draw(rows)).goal
    if variant == "directional":
        assert torch.equal(goal[1:], position[1:].sign())  # full speed, in units of the largest
        return
    place = 1000.0 * goal + (position if variant == "relative" else 0.0)
    assert place.abs().amax(1) == pytest.approx(torch.full((50,), 1250.0), rel=1e-5)
    cosine = torch.nn.functional.cosine_similarity(place[1:], position[1:])
    assert cosine == pytest.approx(torch.ones(49), abs=1e-5)


@pytest.mark.parametrize("config", [quad.Config(engine="native"), quad_arm.Config(engine="native")])
def test_scripted_turns_robots_round(config):
    """A robot is asked for the reverse of its velocity at the limits, and for a uniform, valid place of its arm."""
    env, rows = config.build(4, CPU, 0), torch.arange(4)
    candidates = env.sample_goals(rows, 1).clone()
    goal = Scripted(env).propose(rows, env.state(env.obs), env.goal, candidates, env.draw(rows)).goal
    limits = torch.tensor([VELOCITY_SCALE, VELOCITY_SCALE, RATE_SCALE])
    assert torch.equal(goal[:, :3], -env.goal[:, :3].sign() * limits)
    assert torch.equal(goal[:, 3:], candidates[:, 0, 3:])
    assert (env.goal_bounds(rows) is None) == isinstance(config, quad_arm.Config)


def test_scripted_is_uniform_where_nobody_knows_better():
    """In an environment without scripted goals it issues Uniform's, and its row says so."""
    env = particle.Config().build(20, CPU, 0)
    env.scripted_goals = lambda rows, goal: None
    rows = torch.arange(20)
    arguments = (rows, env.state(env.obs), env.goal, env.sample_goals(rows, 1).clone(), env.draw(rows))
    assert torch.equal(Scripted(env).propose(*arguments).goal, uniform_goals(env).propose(*arguments).goal)
    target = replace(make_target(stay, particle.Config(), SMALL, CPU), build=lambda worlds, seed: env)
    assert attacker("scripted").prepare(target).facts == {"uninformed": True}


@pytest.mark.parametrize(
    ("name", "steps"), [("argmax", 300), ("argmax-long", 1200), ("q-fear", 1200), ("search", 1200), ("oracle", 1200)]
)
def test_every_policy_costs_the_same(name, steps):
    """What an attacker may learn from is as much for a policy that never crashes as for one that does all the time."""
    for policy in (stay, blind()):
        target = make_target(policy, particle.Config(goal_period=50), SMALL, CPU)
        facts = attacker(name).prepare(target).facts
        assert facts["adversary_steps"] == steps
        assert facts["adversary_interactions"] > 0
        assert (facts["adversary_crashes"] == 0) == (policy is stay)


def test_the_thesis_adversary_learns_from_uniform_goals():
    """The goals that argmax has learnt from are as many as Naive's, and their crashes those of Naive goals."""
    config = particle.Config(goal_period=50)
    _, facts = learn_fear(make_target(blind(), config, SMALL, CPU), 600, own_goals=False)
    naive = evaluate(blind(), config, replace(SMALL, seed=SMALL.seed + 1, attackers=()), CPU)[0]
    assert facts["adversary_interactions"] == naive["interactions"]
    assert facts["adversary_crashes"] == naive["interaction_crashes"]


def test_q_fear_sees_beyond_a_goal():
    """Where no goal can crash a policy within T steps it asks for speed towards a wall, and fears it far more."""
    config = particle.Config(goal_period=10)  # at 10 u a step nobody crosses the 250 u that are left
    target = make_target(blind(), config, replace(SMALL, worlds=300, adversary_steps=500), CPU)
    env, rows = config.build(200, CPU, 3), torch.arange(200)
    still = torch.tensor([0.0, 0.0, 0.0, 0.75, 0.0, 0.0, 0.0, 0.0, 0.0]).expand(200, 9)
    arguments = (rows, still, still[:, :3], env.sample_goals(rows, 100).clone(), env.draw(rows))
    far, near = (q_fear.Config(beta=beta).prepare(target).selector(env).propose(*arguments) for beta in (0.9, 0.0))
    assert far.goal[:, 0].mean() > 0.7
    assert far.score.mean() > near.score.mean() + 3.0  # in log odds: twenty times the odds


@pytest.mark.parametrize("variant", VARIANTS)
def test_search_fears_more_than_the_best_candidate(variant):
    """What it finds is a valid goal, feared at least as much as the first round's best, and mostly more by far."""
    env = particle.Config(variant=variant, spawn_range=900.0).build(40, CPU, 0)
    fear = Fear(FearConfig(hidden=(16,)), env.state_dim, env.goal_dim, CPU, seed=0)
    fear.fitted = True
    searcher, rows = search.Search(search.Config(), env, fear), torch.arange(40)
    state, candidates = env.state(env.obs), env.sample_goals(rows, searcher.num_candidates).clone()
    chosen = searcher.propose(rows, state, env.goal, candidates, env.draw(rows))
    low, high = env.goal_bounds(rows)
    assert ((candidates >= low.unsqueeze(1) - 1e-5) & (candidates <= high.unsqueeze(1) + 1e-5)).all()
    assert ((chosen.goal >= low) & (chosen.goal <= high)).all()
    score = fear.score(state, env.goal, candidates)
    assert chosen.score == pytest.approx(fear.score(state, env.goal, chosen.goal.unsqueeze(1))[:, 0], abs=1e-5)
    assert (chosen.score >= score[:, :100].amax(1) - 1e-6).all()
    assert (chosen.score > score.amax(1)).float().mean() > 0.9
    half = searcher.propose(rows[:7], state[:7], env.goal[:7], candidates[:7], env.draw(rows[:7]))
    assert half.goal == pytest.approx(chosen.goal[:7], abs=1e-5)


def test_gradients_lead_to_the_top():
    """Fear that grows with every component is followed to the corner of the box, which no candidate is in."""
    env = particle.Config().build(10, CPU, 0)
    fear = Fear(FearConfig(hidden=(8,), activation="elu"), env.state_dim, env.goal_dim, CPU, seed=0)
    fear.fitted = True
    with torch.no_grad():
        for weights in fear.network.parameters():
            weights.abs_()
    searcher = search.Search(search.Config(rounds=1, ascents=100), env, fear)
    rows = torch.arange(10)
    arguments = (rows, env.state(env.obs), env.goal, env.sample_goals(rows, 100), env.draw(rows))
    assert searcher.propose(*arguments).goal == pytest.approx(torch.ones(10, 3), abs=1e-5)


def test_search_in_no_box_is_argmax():
    """Where the environment cannot bound its valid goals, the most feared candidate is asked for."""
    env = particle.Config().build(10, CPU, 0)
    env.goal_bounds = lambda rows: None
    fear = Fear(FearConfig(), env.state_dim, env.goal_dim, CPU, seed=0)
    fear.fitted = True
    rows = torch.arange(10)
    arguments = (rows, env.state(env.obs), env.goal, env.sample_goals(rows, 300).clone(), env.draw(rows))
    chosen = search.Search(search.Config(), env, fear).propose(*arguments)
    assert torch.equal(chosen.goal, argmax_director(env, fear).propose(*arguments).goal)


def test_a_pool_attacks_policies_that_it_has_not_seen(tmp_path):
    """A network that has seen some policies crash crashes another; all meet the same network, which the file fixes."""
    config, pool = particle.Config(), tmp_path / "pool.pt"
    facts = make_pool([make_target(policy, config, SMALL, CPU) for policy in (stay, blind())], pool)
    assert facts["adversary_steps"] == 2 * SMALL.adversary_steps
    assert facts["adversary_crashes"] > 0
    assert facts["adversary_auroc"] > 0.7

    def slower(obs):
        return 0.6 * blind()(obs)

    sizes = replace(SMALL, attackers=("pooled",), pool=pool, steps=1000)
    naive, attacked = evaluate(slower, config, sizes, CPU)
    assert attacked["crash_rate"] > 1.2 * naive["crash_rate"] > 0
    assert attacked["adversary_crashes"] == facts["adversary_crashes"]
    before = _identities(config, sizes)
    make_pool([make_target(blind(), config, SMALL, CPU)], pool)
    after = _identities(config, sizes)
    assert before[0] == after[0]
    assert before[1] != after[1]


@pytest.mark.parametrize("own_goals", [True, False])
def test_policies_of_a_pool_have_one_network(monkeypatch, own_goals):
    """Each acts in the same worlds as alone; under uniform goals it meets the same, else the one network's choices."""
    asked = []
    monkeypatch.setattr(attack, "Explorer", lambda env, fear: asked.append(fear) or Explorer(env, fear))
    config = particle.Config(goal_period=50)
    targets = [make_target(policy, config, SMALL, CPU) for policy in (blind(), stay)]
    fear, together = attack.collect(targets, 300, own_goals=own_goals)
    alone = [attack.collect([target], 300, own_goals=own_goals)[1] for target in targets]
    assert [each is fear for each in asked] == [True, True, False, False] * own_goals
    assert len(together) == pytest.approx(sum(map(len, alone)), rel=0.2)
    assert fear.fitted == own_goals
    if not own_goals:
        for name in ("env", "state", "goal", "next_goal", "crashed"):
            assert torch.equal(getattr(together, name), torch.cat([getattr(part, name) for part in alone]))


def test_attackers_of_one_evaluation_share_what_they_learn(monkeypatch):
    """Those that want the same network have it trained once, and do to a policy what they do alone."""
    trained = []
    original = attack.fear_of

    def count(targets, steps, *, own_goals):
        trained.append((steps, own_goals))
        return original(targets, steps, own_goals=own_goals)

    monkeypatch.setattr(attack, "fear_of", count)
    config, sizes = particle.Config(goal_period=50), replace(SMALL, attackers=("argmax", "argmax-long", "search"))
    together = evaluate(blind(), config, sizes, CPU)
    assert trained == [(300, False), (1200, True)]
    alone = evaluate(blind(), config, replace(sizes, attackers=("search",)), CPU)[1]
    assert repr(together[3]) == repr(alone)
    assert len(trained) == 3


def test_a_pool_is_made_and_used_by_commands(tmp_path, capsys):
    """``deimos pool`` makes the file, once, and ``deimos evaluate`` attacks with it, beside the run's own attackers."""
    shutil.copytree(OLD, tmp_path / "run")
    stored = tmp_path / "run" / "config.json"
    stored.write_text(stored.read_text().replace('"goal_period": 100', '"goal_period": 20'))  # some goals are survived
    run, pool = str(tmp_path / "run"), str(tmp_path / "pool.pt")
    make = ["pool", run, run, "--out", pool, "--worlds", "16", "--adversary-steps", "600", "--device", "cpu"]
    assert cli.main(make) == 0
    said = capsys.readouterr().out
    assert re.search(r"^2 policies, [\d,]+ goals, [1-9][\d,]* crashes; AUROC .*\n.*pool\.pt\n$", said)
    assert cli.main(make) == 2
    assert "pool.pt exists and is not overwritten" in capsys.readouterr().err
    assert cli.main(["evaluate", run, "--attackers", "pooled", "--device", "cpu"]) == 2
    assert "pool must be a file of deimos pool" in capsys.readouterr().err
    assert cli.main(["evaluate", run, "--attackers", "pooled", "--pool", pool, "--device", "cpu"]) == 0
    assert re.search(r"\(Naive\) +argmax +scripted +pooled\n", capsys.readouterr().out)


def test_a_place_for_a_pool_is_tried_before_the_work(tmp_path, monkeypatch, capsys):
    """A folder that is missing, or that cannot be written to, is refused before anything is trained."""
    monkeypatch.setattr("deimos.app.pool.make_pool", lambda *args: pytest.fail("trained in vain"))
    make = ["pool", str(OLD), "--out"]
    assert cli.main([*make, str(tmp_path / "none" / "pool.pt")]) == 2
    assert capsys.readouterr().err == f"deimos: The folder {tmp_path / 'none'} does not exist; make it first.\n"
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert cli.main([*make, str(tmp_path / "pool.pt")]) == 2
    assert capsys.readouterr().err == f"deimos: The folder {tmp_path} cannot be written to.\n"


def test_a_pool_is_refused_in_one_line(tmp_path):
    """None, one of another environment, one that is not there, and policies that never crash."""
    config, pool = particle.Config(), tmp_path / "pool.pt"
    with pytest.raises(ValueError, match="pool must be a file of deimos pool for the attacker pooled, got none"):
        EvalConfig(attackers=("pooled",))
    sizes = replace(SMALL, attackers=("pooled",), pool=pool)
    with pytest.raises(RunError, match=r"pool.pt cannot be read \(No such file"):
        evaluate(stay, config, sizes, CPU)
    with pytest.raises(RunError, match="These policies never or always crashed"):
        make_pool([make_target(stay, config, SMALL, CPU)], pool)
    make_pool([make_target(blind(), config, SMALL, CPU)], pool)
    with pytest.raises(RunError, match=r"pool\.pt is for other observations"):
        evaluate(stay, replace(config, max_speed=20.0), sizes, CPU)
    other = make_target(blind(), replace(config, max_speed=20.0), SMALL, CPU)
    with pytest.raises(RunError, match="The policies have different observations"):
        make_pool([make_target(blind(), config, SMALL, CPU), other], pool)
    shorter = make_target(blind(), replace(config, goal_period=50), SMALL, CPU)
    with pytest.raises(RunError, match=r"goals of the same period T, got 50, 100\."):
        make_pool([make_target(blind(), config, SMALL, CPU), shorter], pool)
    pool.write_bytes(b"broken")
    with pytest.raises(RunError, match=r"pool\.pt"):
        evaluate(stay, config, sizes, CPU)


def test_setting_tells_attackers_apart():
    """A row is another's where the attacker, its budget or its network is another, whoever else attacks."""
    config = particle.Config()

    def settings(**changes):
        return [row.get("adversary_setting") for row in _identities(config, replace(SMALL, **changes))]

    both = settings(attackers=("argmax", "scripted"))
    assert both[0] is None
    assert both[1] != both[2]
    assert settings(attackers=("argmax",)) == both[:2]
    assert settings(attackers=("argmax",), steps=700) == both[:2]
    for change in ({"adversary_steps": 301}, {"seed": 3}, {"worlds": 61}, {"fear": FearConfig(epochs=9)}):
        assert settings(attackers=("argmax",), **change)[1] != both[1]


def test_rows_tell_tasks_apart(tmp_path):
    """Every row is another's where the evaluated task is another; what evaluation switches off changes nothing."""
    ground, moved, other = (tmp_path / name for name in ("ground.npz", "terrain.npz", "other.npz"))
    for path, data in ((ground, b"slopes"), (moved, b"slopes"), (other, b"stairs")):
        path.write_bytes(data)

    def identities(config):
        return _identities(config, replace(SMALL, attackers=("argmax",)))

    config = quad.Config(engine="native", terrain=str(ground))
    before = identities(config)
    assert identities(config.for_evaluation()) == identities(replace(config, crash_penalty=2.0)) == before
    assert identities(replace(config, terrain=str(moved))) == before  # a run folder that was moved
    for change in ({"air_time_target": 0.77}, {"terrain": str(other)}):
        for old, new in zip(before, identities(replace(config, **change)), strict=True):
            assert old | {"environment": ""} == new | {"environment": ""}
            assert old != new
    with pytest.raises(RunError, match=r"none\.npz cannot be read"):
        identities(replace(config, terrain="none.npz"))
    for old, new in zip(before, identities(replace(config, engine="warp")), strict=True):
        assert old | {"engine": "warp"} == new


def test_argmax_finds_what_crashes_a_policy():
    """Against a follower with a blind side both learn to rank goals and crash it more often than Naive does."""
    config = particle.Config()
    follow = config.build(1, CPU, 0).reference_policy()

    unseeing = blind()

    def policy(obs):
        action = follow(obs)
        action[:, 0] = torch.where(obs[:, 9] > 0, unseeing(obs)[:, 0], action[:, 0])
        return action

    sizes = EvalConfig(worlds=100, steps=1000, attackers=("argmax", "argmax-long"), adversary_steps=1000)
    naive, *rows = evaluate(policy, config, sizes, CPU)
    for attacked in rows:
        assert attacked["adversary_auroc"] > 0.8
        assert attacked["crash_rate"] > 1.3 * naive["crash_rate"] > 0


def held_out(probe, crashed):
    """Interactions of which only the kind of the goal and the outcome are known; states hold the kind."""
    probe, crashed = torch.tensor(probe), torch.tensor(crashed)
    nothing = torch.zeros(len(probe))
    return Resolved(
        env=nothing.long(), state=torch.stack([probe.float(), crashed.float()], dim=1), goal=nothing.unsqueeze(1),
        next_goal=nothing.unsqueeze(1), score=nothing, reward=nothing, tracking=nothing, probe=probe,
        note=nothing.long(), crashed=crashed, issued=nothing.long(), resolved=nothing.long(),
        horizon=nothing.long() + 1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("column", "probe", "crashed", "expected"),
    [
        (0, [True] * 6 + [False] * 6, [True] + [False] * 5 + [True] * 5 + [False], 0.5),  # it knows the kind alone
        (1, [True] * 6 + [False] * 6, [True] + [False] * 5 + [True] * 5 + [False], 1.0),
        (1, [True] * 6 + [False] * 6, [False] * 9 + [True] * 3, 1.0),  # only its own goals crash the policy
        (1, [True] * 6 + [False] * 6, [False] * 6 + [True] * 6, math.nan),  # no kind has both outcomes
        (1, [True] * 6, [False] * 6, math.nan),
    ],
)
def test_the_adversary_is_judged_within_each_kind_of_goals(column, probe, crashed, expected):
    """To know which goals are its own is worth nothing, and where one kind never crashes the other one counts."""
    network = SimpleNamespace(fitted=True, score=lambda state, goal, candidates: state[:, column : column + 1])
    assert quality(network, held_out(probe, crashed)) == pytest.approx(expected, nan_ok=True)
    assert math.isnan(quality(SimpleNamespace(fitted=False), held_out(probe, crashed)))


def test_the_adversarys_uniform_goals_are_marked():
    """While it collects, about half of its goals are Uniform's, and these are the ones that are marked as probes."""
    env = particle.Config().build(400, CPU, 0)
    fear = Fear(FearConfig(), env.state_dim, env.goal_dim, CPU, 0)
    fear.fitted = True
    collector, rows = Explorer(env, fear), torch.arange(400)
    candidates, draws = env.sample_goals(rows, collector.num_candidates).clone(), env.draw(rows)
    arguments = (rows, env.state(env.obs), env.goal, candidates, draws)
    proposal, free = collector.propose(*arguments), uniform_goals(env).propose(*arguments)
    same = (proposal.goal == free.goal).all(1)
    assert bool(same[proposal.probe].all())
    assert same[~proposal.probe].float().mean() < 0.1  # one of a hundred candidates, by chance
    assert abs(proposal.probe.sum().item() - 200) < 4 * 10
