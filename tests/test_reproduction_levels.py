"""The level of the verdicts: how often a true claim is contradicted and a false one supported, simulated.

``POPULATIONS=1000 pytest -s tests/test_reproduction_levels.py`` simulates more and prints the rates.
"""

import math
import os

import numpy as np
import pytest

from deimos.study import stats
from deimos.study.data import Data
from deimos.study.results import RESULT_COLUMNS, Results
from reproduction import claims
from reproduction.claim_custom import NEARLY_NONE
from reproduction.claim_list import CLAIMS
from reproduction.thesis import ACHIEVED, PARTICLE_METHODS

POPULATIONS = int(os.environ.get("POPULATIONS", "80"))
SEEDS, STEPS, ALPHA = 10, 2000, 0.05
GOALS = ("naive", "adversary")
MOST = ALPHA + 3 * math.sqrt(ALPHA * (1 - ALPHA) / POPULATIONS)
BY_ID = {claim.id: claim for claim in CLAIMS}
BLANK = dict.fromkeys(RESULT_COLUMNS) | {"setting": "s", "weak_adversary": False, "goal_period": 100}


def study(
    rng, crashes=None, reward=None, environment="absolute", at=5.0, sd=1.0, counted=False, worlds=2000, goals=GOALS
):
    """Ten methods of ten policies, log crashes and rewards normal with sd 1, ahead by what is given for a method.

    Crashes are real numbers, or else ``counted``: Poisson around them.
    """
    rows = []
    for name in PARTICLE_METHODS:
        for seed in range(SEEDS):
            for kind in goals:
                rate = np.expm1(sd * rng.normal() + (crashes or {}).get(name, 0.0) + at)
                rows.append(BLANK | {
                    "environment": environment, "method": name, "selector": name, "seed": seed, "goals": kind,
                    "crashes": rng.poisson(max(rate, 0.0)) if counted else rate, "steps": STEPS, "worlds": worlds,
                    "reward": rng.normal() + (reward or {}).get(name, 0.0),
                })  # fmt: skip
    return Data(Results(rows))


def rates(monkeypatch, claim, verdicts=("supported", "contradicted"), only="", resamples=2, **populations):
    """How often a claim's tests, or those whose text has ``only``, come to some verdicts together."""
    monkeypatch.setattr(stats, "RESAMPLES", resamples)  # 2 are enough where only intervals hang on them
    rng = np.random.default_rng(0)
    found = []
    for _ in range(POPULATIONS):
        data = study(rng, **populations)
        findings = [f for each in claim.environments for f in claim.findings(data, each) if only in f.what]
        assert findings
        found.append(claims.combined(claims.assess(findings, claim.combine), claim.combine, len(findings)))
    shares = [found.count(verdict) / POPULATIONS for verdict in verdicts]
    print(f"\n{claim.id} {only} {populations}: {', '.join(map('{} {:.1%}'.format, verdicts, shares))}")
    return shares


@pytest.mark.parametrize("ahead", [0.0, 0.25, 0.5, 1.0] if POPULATIONS > 100 else [0.0, 0.5])
@pytest.mark.parametrize("claim", ["C8", "C9", "C27"])
def test_true_claim_of_a_best_method_is_rarely_contradicted(monkeypatch, claim, ahead):
    """Methods that are the best by any distance, or by none, are contradicted in at most 5 % of all studies."""
    populations = {
        "C8": {"crashes": dict.fromkeys(("uniform", "p25"), -ahead), "only": ">"},
        "C9": {"reward": {"antagonist": ahead}},
        "C27": {"crashes": {"vds": -ahead}, "only": "mean rank"},
    }[claim]
    assert rates(monkeypatch, BY_ID[claim], ["contradicted"], **populations)[0] <= MOST


@pytest.mark.parametrize("claim", ["C8", "C9", "C27"])
def test_claim_of_a_best_method_that_is_tied_is_rarely_supported(monkeypatch, claim):
    """Methods far ahead of all but one, which is as good, are called the best in at most 5 % of all studies."""
    populations = {
        "C8": {"crashes": dict.fromkeys(("uniform", "p25", "p50"), -9.0), "only": ">"},
        "C9": {"reward": dict.fromkeys(("antagonist", "p50"), 9.0)},
        "C27": {"crashes": dict.fromkeys(("vds", "rnd"), -9.0), "only": "mean rank", "at": 14.0},
    }[claim]
    assert rates(monkeypatch, BY_ID[claim], ["supported"], **populations)[0] <= MOST


@pytest.mark.parametrize(("claim", "populations"), [
    ("C8", {"crashes": dict.fromkeys(("uniform", "p25"), -3.0), "only": ">", "at": 8.0}),
    ("C9", {"reward": {"antagonist": 9.0}}),
    ("C27", {"crashes": {"vds": -3.0}, "only": "mean rank", "at": 8.0}),
])  # fmt: skip
def test_best_method_far_ahead_is_found(monkeypatch, claim, populations):
    """A method that is clearly the best supports the claim, and the worst one in its place contradicts it."""
    assert rates(monkeypatch, BY_ID[claim], ["supported"], **populations)[0] > 0.8
    worst = {name: {k: -v for k, v in values.items()} if isinstance(values, dict) else values
             for name, values in populations.items()}  # fmt: skip
    assert rates(monkeypatch, BY_ID[claim], ["contradicted"], **worst)[0] > 0.8


@pytest.mark.parametrize(("sd", "worlds"), [(1.0, 2000), (0.0, 2000), (0.0, 505)])
def test_policies_at_the_limit_do_not_support_few_crashes(monkeypatch, sd, worlds):
    """Where half of every method's policies have a crash in 10^6 steps or more, C11 is supported in at most 5 %."""
    # Crashes are Poisson. In the shortest evaluation a policy at the limit is expected to crash 1.01 times, so with one
    # crash it would be below that more often than not.
    limit = worlds * STEPS * NEARLY_NONE
    study = {"environment": "relative", "goals": ("naive",), "counted": True, "worlds": worlds, "sd": sd}
    assert rates(monkeypatch, BY_ID["C11"], ["supported"], at=math.log1p(limit), **study)[0] <= MOST


def test_method_far_below_the_limit_supports_few_crashes(monkeypatch):
    """A method whose policies crash a thirtieth as often as the others, half of which are at the limit, is found."""
    populations = {"environment": "relative", "at": math.log1p(4.0), "crashes": {"vds": -3.0}}
    assert rates(monkeypatch, BY_ID["C11"], ["supported"], counted=True, **populations)[0] > 0.8


def parabola(depth, lowest):
    """Log crashes over the achieved percentile: as much above the lowest point as ``depth`` says, 50 away from it."""
    return {name: depth * ((place - lowest) / 50.0) ** 2 for name, place in ACHIEVED.items()}


HUMP = {"goals": ("naive",), "resamples": 400}


@pytest.mark.parametrize("only", ["", "curvature", "the lowest point lies inside"])
def test_flat_line_is_no_hump_and_no_valley(monkeypatch, only):
    """Where no method differs from another, C25 and each of its tests is supported or contradicted in at most 5 %."""
    assert max(rates(monkeypatch, BY_ID["C25"], only=only, **HUMP)) <= MOST


def test_lowest_point_at_the_end_is_not_inside(monkeypatch):
    """Crashes that fall up to Antagonist, where they are level, have their lowest point inside in at most 5 %."""
    end = parabola(3.0, ACHIEVED["antagonist"])
    found = rates(monkeypatch, BY_ID["C25"], only="the lowest point lies inside", crashes=end, **HUMP)
    assert max(found) <= MOST


def test_planted_hump_is_found(monkeypatch):
    """Crashes with their lowest point in the middle support C25, and upside down they contradict it."""
    for depth, verdict in ((2.0, "supported"), (-2.0, "contradicted")):
        crashes = parabola(depth, 50.0)
        assert rates(monkeypatch, BY_ID["C25"], [verdict], crashes=crashes, at=8.0, **HUMP)[0] > 0.8
