"""The shield: its thresholds against the binomial distribution and simulation, its modes, and a run's own."""

import json
import logging
import pickle
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats

from benchmarks.shield_splits import split
from deimos.app import cli
from deimos.goals.fear import FearConfig
from deimos.goals.selectors import director
from deimos.goals.shield import GUARANTEES, Shield, crashes_needed, rank, threshold
from deimos.run.attack import uniform_goals
from deimos.run.evaluation import EvalConfig, make_target
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop, spaces
from deimos.run.shield import Guard, ShieldConfig, Trial, _goal_scale, _seen_range, collect, plain_rule, random_rule
from deimos.sim.envs import particle, quad_arm

CPU = torch.device("cpu")
FAST = particle.Config(goal_period=10, max_speed=200.0, max_force=100.0)


def total(goals):
    """Fear of a goal: the sum of its components."""
    return goals.sum(-1)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of a run of particles so fast that there is much to fear."""
    path = tmp_path_factory.mktemp("shield") / "run"
    budget = "--no-evaluation --num-envs 256 --env-steps 96 --threads 1 --device cpu --ppo.hidden 16 --ppo.init-std 100"
    fast = "--env.goal-period 10 --env.max-speed 200 --env.max-force 100"
    assert cli.main(["train", *budget.split(), *fast.split(), "--out", str(path)]) == 0
    return path


@pytest.mark.parametrize("crashes", [0, 1, 28, 29, 46, 500])
@pytest.mark.parametrize("alpha", [0.01, 0.1, 0.5])
def test_the_threshold_is_the_largest_that_keeps_its_promise(crashes, alpha):
    """The rank has k / (n + 1) <= alpha, or P(Binomial(n, alpha) < k) <= 5 %, and no larger k has that."""
    k = rank(crashes, alpha, "marginal")
    assert k / (crashes + 1) <= alpha + 1e-9 < (k + 1) / (crashes + 1)
    k = rank(crashes, alpha, "conditional")
    assert stats.binom.cdf(k - 1, crashes, alpha) <= 0.05 < stats.binom.cdf(k, crashes, alpha)


@pytest.mark.parametrize(("alpha", "marginal", "conditional"), [(0.1, 9, 29), (0.05, 19, 59), (0.5, 1, 5)])
def test_how_many_crashes_it_takes(alpha, marginal, conditional):
    """The fewest crashes are those from which on there is a threshold: 29 for a tenth with confidence."""
    for need, guarantee in zip((marginal, conditional), GUARANTEES, strict=True):
        assert crashes_needed(alpha, guarantee) == need
        assert rank(need, alpha, guarantee) >= 1 > rank(need - 1, alpha, guarantee)


def test_miss_rates_are_those_that_were_promised():
    """Over 4000 calibrations on uniform scores, whose miss rate is the threshold, both promises are kept."""
    score = torch.rand(4000, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    missed = {name: np.array([threshold(row, 0.1, name) for row in score]) for name in GUARANTEES}
    assert missed["marginal"].mean() == pytest.approx(10 / 101, abs=0.002)
    beyond = stats.binom.cdf(rank(100, 0.1, "conditional") - 1, 100, 0.1)
    assert beyond <= 0.05
    assert (missed["conditional"] > 0.1).mean() == pytest.approx(beyond, abs=0.006)  # two and a half standard errors


def test_a_threshold_that_cannot_be_is_refused():
    """An alpha outside (0, 1), and too few crashes, are named, with how many it takes."""
    with pytest.raises(ValueError, match=r"alpha must be in \(0, 1\), got 1.0"):
        threshold(torch.zeros(9), 1.0, "marginal")
    with pytest.raises(ValueError, match=r"alpha = 0.1 needs 29 crashes to calibrate on, got 28"):
        threshold(torch.zeros(28), 0.1, "conditional")


def test_acceptable_goals_pass():
    """Goals below the threshold are given as they were asked for; those at it, and those of unknown fear, are not."""
    shield = Shield(1.0, "stop", (0.0, 0.0), (1.0, 1.0))
    wanted = torch.tensor([[0.4, 0.5], [0.5, 0.5], [torch.nan, 0.0]])
    made = shield.choose(total, torch.ones(3, 2), wanted)
    assert made.refused.tolist() == [False, True, True]
    assert torch.equal(made.goal, torch.tensor([[0.4, 0.5], [0.0, 0.0], [0.0, 0.0]]))
    torch.testing.assert_close(made.score, wanted.sum(1), equal_nan=True)


def test_the_three_modes():
    """Refused, the active goal stays, or the safe goal or the nearest acceptable one is given."""
    goal, wanted = torch.tensor([[0.2, -0.3]]), torch.tensor([[1.0, 1.0]])
    near, far = [1.0, -0.5], [-1.0, 0.0]
    candidates = torch.tensor([[far, near, [0.9, 0.9]]])
    given = {
        mode: Shield(1.0, mode, (0.0, None), (1.0, 1.0)).choose(total, goal, wanted, candidates).goal[0].tolist()
        for mode in ("ignore", "project", "stop")
    }
    assert given["ignore"] == pytest.approx([0.2, -0.3])
    assert given["stop"] == pytest.approx([0.0, -0.3])  # what is not fixed stays as it is
    assert given["project"] == pytest.approx(near)
    alone = Shield(1.0, "project", (0.0, 0.0), (1.0, 1.0)).choose(total, goal, wanted).goal[0].tolist()
    assert alone == pytest.approx([0.4, 0.4])  # the first of the shrunk goals whose sum is below 1


def test_distances_are_shares_of_the_range():
    """The nearest goal is near in units of every component's range, whatever its unit."""
    shield = Shield(1.0, "project", (None, None), (10.0, 0.1))
    candidates = torch.tensor([[[-1.0, 1.0], [0.0, 0.8]]])
    given = shield.choose(total, torch.zeros(1, 2), torch.tensor([[5.0, 1.0]]), candidates).goal
    assert given[0].tolist() == pytest.approx([-1.0, 1.0])


def test_where_nothing_is_acceptable_it_stops():
    """Without an acceptable candidate, project gives the safe goal, however it is feared."""
    made = Shield(-9.0, "project", (0.0, 0.0), (1.0, 1.0)).choose(total, torch.ones(1, 2), torch.ones(1, 2))
    assert made.goal.tolist() == [[0.0, 0.0]]


def test_a_shield_of_other_sizes_is_refused():
    """A safe goal and ranges that do not fit each other, an unknown mode and an empty range are named."""
    with pytest.raises(ValueError, match="safe_goal must have 2 components as goal_range has, got 1"):
        Shield(0.0, "stop", (0.0,), (1.0, 1.0))
    with pytest.raises(ValueError, match="mode must be one of ignore, project, stop, got 'run'"):
        Shield(0.0, "run", (0.0,), (1.0,))
    for side in (0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"goal_range must be finite and positive, got {side}"):
            Shield(0.0, "stop", (0.0, 0.0), (1.0, side))
    with pytest.raises(ValueError, match=r"safe_goal must be finite, got \(nan,\)"):
        Shield(0.0, "stop", (float("nan"),), (1.0,))
    for limit in (float("nan"), float("inf"), -float("inf")):
        with pytest.raises(ValueError, match=f"threshold must be finite, or all goals pass, or none, got {limit}"):
            Shield(limit, "stop", (0.0,), (1.0,))


def test_goals_of_other_sizes_are_refused():
    """Goals of another number of components, and scores of another shape, are named; nothing is broadcast."""
    goal, one = torch.ones(2, 3), Shield(0.0, "project", (0.0,), (1.0,))
    with pytest.raises(ValueError, match=r"wanted must have shape \(2, 1\), got \(2, 3\)"):
        one.choose(total, goal, goal)
    shield = Shield(0.0, "project", (0.0,) * 3, (1.0,) * 3)
    with pytest.raises(ValueError, match=r"goal must have shape \(2, 3\), got \(1, 3\)"):
        shield.choose(total, goal[:1], goal)
    for shape in ((2, 4, 1), (1, 4, 3), (2, 3)):
        with pytest.raises(ValueError, match=r"candidates must have shape \(2, \d, 3\), got"):
            shield.choose(total, goal, goal, torch.ones(shape))
    with pytest.raises(ValueError, match=r"score of \(B, 1\) goals must have shape \(2, 1\), got \(2,\)"):
        shield.choose(lambda goals: goals.sum((1, 2)), goal, goal)
    with pytest.raises(ValueError, match=r"score of \(B, N\) goals must have shape \(2, 10\), got \(2, 1\)"):
        shield.choose(lambda goals: total(goals)[:, :1], goal, goal)  # the first one's would be everyone's


def test_what_is_no_tensor_is_refused():
    """Arrays, as onnxruntime gives them, are named, with what makes tensors of them."""
    goal, shield = torch.ones(2, 1), Shield(0.0, "project", (0.0,), (1.0,))
    for score, active, wanted, candidates, name in (
        (total, goal.numpy(), goal, None, "goal"),
        (total, goal, goal.numpy(), None, "wanted"),
        (total, goal, goal, np.ones((2, 4, 1)), "candidates"),
        (lambda goals: total(goals).numpy(), goal, goal, None, r"score of \(B, 1\) goals"),
    ):
        with pytest.raises(ValueError, match=f"{name} must be a tensor, got numpy.ndarray; torch.from_numpy makes one"):
            shield.choose(score, active, wanted, candidates)


def test_no_shield_is_said():
    """The entry of an export without a shield is refused with the way to one."""
    with pytest.raises(ValueError, match="There is no shield: make one with deimos shield, then export the run again"):
        Shield.from_dict(None)
    with pytest.raises(ValueError, match="guarantee must be one of marginal, conditional, got 'sure'"):
        Shield.from_dict({"guarantee": "conditional"}, guarantee="sure")


def test_a_drift_is_told_once(caplog):
    """Scores like the calibration's raise no warning; half a deviation above them they do, once."""
    random = np.random.default_rng(0)
    shield = Shield(9.0, "stop", (0.0,), (1.0,), reference=random.normal(size=1000), window=200)
    for shift, warnings in ((0.0, 0), (0.5, 1), (0.5, 1)):
        scores = torch.from_numpy(random.normal(shift, size=(200, 1))).float()
        with caplog.at_level(logging.WARNING):
            shield.choose(total, scores, scores)
        assert len(caplog.records) == warnings
        assert (shield.drift() < 1e-3) == bool(shift)


@pytest.mark.parametrize(("before", "warnings"), [(0, 1), (1, 0)])
def test_a_later_test_of_a_drift_takes_more(caplog, monkeypatch, before, warnings):
    """A p-value of 4e-4 is below the level of the first test, 1e-3 / 2, and not below that of the second, 1e-3 / 6."""
    shield, scores = Shield(9.0, "stop", (0.0,), (1.0,), reference=range(9), window=4), torch.zeros(4, 1)
    for p_value in [1.0] * before + [4e-4]:
        monkeypatch.setattr(shield, "drift", lambda p_value=p_value: p_value)
        shield.choose(total, scores, scores)
    assert len(caplog.records) == warnings


def test_the_p_value_of_a_drift_is_scipys():
    """It is the first term of the series of Kolmogorov's distribution at the distance that SciPy finds."""
    random = np.random.default_rng(1)
    reference, recent = random.normal(size=1000), random.normal(0.2, size=200)
    shield = Shield(9.0, "stop", (0.0,), (1.0,), reference=reference, window=200)
    scores = torch.from_numpy(recent).unsqueeze(1)
    shield.choose(total, scores, scores)
    found = stats.ks_2samp(recent, reference, method="asymp")
    assert shield.drift() == pytest.approx(2 * np.exp(-2 * found.statistic**2 * 200 * 1000 / 1200))
    assert shield.drift() == pytest.approx(found.pvalue, rel=0.1)  # SciPy minds how many there are


def test_a_guard_counts_and_keeps_nothing():
    """The share of refused goals is exact, NaN before the first, and memory does not grow with what is asked for."""
    env, rows = FAST.build(4, CPU, seed=0), torch.arange(4)
    guard = Guard(Shield(0.5, "stop", (0.0,) * 3, (1.0,) * 3), random_rule, candidates=1)
    assert np.isnan(guard.refused)
    sizes, refused = [], 0
    for _ in range(20):
        drawn = random_rule(env, rows, env.goal.unsqueeze(1))[:, 0]
        refused += int((drawn >= 0.5).sum())
        guard(env, rows, env.goal.clone())
        sizes.append(len(pickle.dumps(guard)))
        env.step(torch.zeros(4, 3))
    assert 0 < refused < 80
    assert guard.refused == refused / 80
    assert sizes[-1] <= sizes[0] + 8  # an integer's digits


def test_the_guard_has_the_last_word_and_the_asker_learns_of_the_asked():
    """Worlds pursue what the shield gives, and interactions hold the goals that were asked for."""
    env = FAST.build(32, CPU, seed=0)
    guard = Guard(Shield(-1.0, "stop", (0.0,) * 3, (1.0,) * 3), random_rule, candidates=4)
    loop, rows = GoalLoop(env, uniform_goals(env), guard=guard), torch.arange(32)
    first = env.goal.clone()
    loop.choose(rows)
    assert guard.refused == 1.0
    assert (first != 0).any()
    assert torch.equal(env.goal, torch.zeros(32, 3))
    _, _, active, asked = loop.interactions.issued(since=-1)
    assert torch.equal(active, first)
    assert (asked != 0).all()


def test_refusing_at_random_has_its_rate():
    """A threshold of 0.7 on the random rule refuses three in ten, the same worlds every time."""
    env = FAST.build(4000, CPU, seed=0)
    rows, goals = torch.arange(4000), torch.zeros(4000, 2, 3)
    score = random_rule(env, rows, goals)
    assert torch.equal(score[:, 0], score[:, 1])
    assert torch.equal(score, random_rule(env, rows, goals))
    assert (score[:, 0] >= 0.7).float().mean().item() == pytest.approx(0.3, abs=0.03)


def test_the_plain_rules():
    """Particles go by the distance to the wall, robots by their tilt: 0 at the origin, -1 for an upright robot."""
    env = FAST.build(4, CPU, seed=0)
    env.tensors["position"][:, 1] = torch.tensor([0.0, 250.0, -500.0, 999.0])
    name, rule = plain_rule(env)
    assert name == "distance to the wall"
    assert rule(env, torch.arange(4), torch.zeros(4, 5, 3))[:, 0].tolist() == pytest.approx([0.0, 0.25, 0.5, 0.999])
    robots = quad_arm.Config(engine="native").for_evaluation().build(3, CPU, seed=0)
    name, rule = plain_rule(robots)
    assert name == "tilt"
    assert rule(robots, torch.arange(3), torch.zeros(3, 2, 6)).flatten().tolist() == pytest.approx([-1.0] * 6, abs=1e-4)
    assert robots.rest_goal() == (0.0, 0.0, 0.0, None, None, None)


def test_robots_that_stand_can_have_a_shield():
    """Velocity goals of 0 alone have no range, but there are distances between goals of the arm."""
    env = quad_arm.Config(engine="native", speed=0.0).for_evaluation().build(1, CPU, seed=0)
    reach = _seen_range(env)
    assert (reach > 0).all()
    assert torch.equal(reach[3:], (env.goal_range * _goal_scale(env))[3:])
    Shield(0.0, "project", env.rest_goal(), reach.tolist())


def test_a_calibration_takes_one_goal_of_each_world():
    """Of all goals that ended it keeps one a world, not always the first, with the network's score at issue."""
    policy = lambda obs: torch.zeros(len(obs), 3)  # noqa: E731
    config = EvalConfig(worlds=8, steps=200, attackers=())
    target = make_target(policy, FAST, config, CPU)
    env = target.build(64, 5)
    afraid = director.Config(rule="argmax", fear=FearConfig(hidden=(4,))).build(spaces(env), 0)
    found = collect(target, afraid, 64, 200, seed=5)
    assert found.score.shape == found.crashed.shape == (64,)
    loop = GoalLoop(env, uniform_goals(env), window=200)
    for _ in range(200):
        loop.advance(env.step(policy(env.obs)))
    done = loop.outcomes()
    every = afraid.score(done.state, done.goal, done.next_goal.unsqueeze(1))[:, 0]
    which = [int((every[done.env == world] - found.score[world]).abs().argmin()) for world in range(64)]
    assert max((every[done.env == world] - found.score[world]).abs().min() for world in range(64)) < 1e-5
    assert len(set(which)) > 5
    assert len(found.half(False).score) + len(found.half(True).score) == 64


def test_splits_of_uniform_scores_keep_the_promise():
    """The command's own splits have the miss rates of theory on scores that are uniform."""
    score = torch.rand(1400, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rates = {name: split(score, 0.1, 200, 200, name) for name in GUARANTEES}
    assert rates["marginal"].mean().item() == pytest.approx(0.1, abs=0.02)
    assert (rates["conditional"] > 0.1).sum() <= 16


SMALL = "--worlds 1000 --eval.worlds 64 --eval.steps 100 --eval.adversary-steps 40 --alphas 0.3 --device cpu".split()


def test_the_shield_of_a_run(run, tmp_path, capsys):
    """The command keeps a shield that can be loaded, refuses as often at random, and lets fewer crash."""
    pool = str(tmp_path / "pool.pt")
    make = "--worlds 64 --adversary-steps 100 --device cpu".split()
    assert cli.main(["pool", str(run), str(run), "--out", pool, *make]) == 0
    attackers = ["--attackers", "argmax", "pooled", "--eval.pool", pool]
    assert cli.main(["shield", str(run), "--alpha", "0.2", *attackers, *SMALL]) == 0
    assert "at most 20 % get through, with a confidence of 95 %" in capsys.readouterr().out
    found = json.loads((run / "shield.json").read_text())
    rows = {(row["shield"], row["goals"]): row for row in found["trials"]}
    assert {goals for _, goals in rows} == {"naive", "argmax", "pooled"}
    shielded, random = rows["shield", "naive"], rows["random refusal", "naive"]
    assert 0.0 < shielded["refused"] < 1.0
    assert random["refused"] == pytest.approx(shielded["refused"], abs=0.1)
    assert shielded["crash_rate"] < rows["no shield", "naive"]["crash_rate"]
    assert {row["alpha"] for row in found["tradeoff"]} == {0.3}
    deploy = found["deploy"]
    assert deploy["threshold"]["conditional"] < deploy["threshold"]["marginal"]
    assert deploy["safe_goal"] == [0.0] * 3
    assert deploy["goal_range"] == pytest.approx([200.0] * 3)
    assert Shield.from_dict(deploy, mode="stop", guarantee="marginal").threshold == deploy["threshold"]["marginal"]
    assert Shield.from_dict(deploy).threshold == deploy["threshold"]["conditional"]
    assert (run / "shield.png").stat().st_size > 10_000


def test_the_advice_on_worlds_is_enough():
    """As many worlds as it says nearly always meet as many crashes as a threshold takes, and not twice as many."""
    rate, config = 0.02, ShieldConfig(worlds=1000)
    trial = SimpleNamespace(config=config, _crashes=range(10), _calibration=SimpleNamespace(score=range(500)))
    worlds = re.search(r"calibrate in about ([\d,]+) worlds", Trial._too_few(trial, ValueError("")))[1]
    half, need = int(worlds.replace(",", "")) // 2, crashes_needed(config.alpha, config.guarantee)
    assert stats.binom.cdf(need - 1, half, rate) < 0.05
    assert half * rate < 2 * need


def test_what_cannot_be_shielded_is_refused_in_a_line(run, tmp_path, capsys):
    """Too few crashes, an alpha out of range, a run without a fear network, no run: one line that says what to do."""
    assert cli.main(["shield", str(run), "--alpha", "0.01", "--worlds", "100", *SMALL[2:]]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "alpha = 0.01 needs 299 crashes to calibrate on" in said
    assert "--worlds" in said
    assert cli.main(["shield", str(run), "--alpha", "1.5"]) == 2
    assert "alpha must be in (0, 1), got 1.5" in capsys.readouterr().err
    assert cli.main(["shield", str(run), "--eval.oracle-worlds", "3", "--attackers", "argmax"]) == 2
    assert "oracle_worlds are those of the attacker oracle; add --attackers oracle" in capsys.readouterr().err
    assert cli.main(["shield", str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err
    budget = "--method uniform --no-evaluation --num-envs 16 --env-steps 24 --threads 1 --device cpu --ppo.hidden 8"
    uniform = ["--env.goal-period", "10", "--out", str(tmp_path / "uniform")]
    assert cli.main(["train", *budget.split(), *uniform]) == 0
    assert cli.main(["shield", str(tmp_path / "uniform"), *SMALL]) == 2
    assert "has no fear network that has learnt" in capsys.readouterr().err
    assert not (RunFolder.open(tmp_path / "uniform").path / "shield.json").exists()
