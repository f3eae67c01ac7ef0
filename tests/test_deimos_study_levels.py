"""The level of the verdicts: how often a true claim is contradicted and a false one supported, simulated.

``POPULATIONS=1000 pytest -s tests/test_deimos_study_levels.py`` simulates more and prints the rates.
"""

import math
import os

import numpy as np
import pytest

from deimos.study import claims, stats
from deimos.study.claim_list import CLAIMS
from deimos.study.data import Data
from deimos.study.presets import PARTICLE_METHODS
from deimos.study.results import RESULT_COLUMNS

POPULATIONS = int(os.environ.get("POPULATIONS", "80"))
SEEDS, ALPHA = 10, 0.05
MOST = ALPHA + 3 * math.sqrt(ALPHA * (1 - ALPHA) / POPULATIONS)
BY_ID = {claim.id: claim for claim in CLAIMS}
BLANK = dict.fromkeys(RESULT_COLUMNS) | {"setting": "s", "weak_adversary": False, "goal_period": 100}


def study(rng, crashes=None, reward=None, environment="absolute", at=5.0):
    """Ten methods of ten policies, log crashes and rewards normal with sd 1, ahead by what is given for a method."""
    rows = []
    for name in PARTICLE_METHODS:
        for seed in range(SEEDS):
            for goals in ("naive", "adversary"):
                rows.append(BLANK | {
                    "environment": environment, "method": name, "selector": name, "seed": seed, "goals": goals,
                    "crashes": np.expm1(rng.normal() + (crashes or {}).get(name, 0.0) + at), "steps": 2000,
                    "reward": rng.normal() + (reward or {}).get(name, 0.0), "worlds": 2000,
                })  # fmt: skip
    return Data(rows, [])


def rates(monkeypatch, claim, verdicts=("supported", "contradicted"), only="", **populations):
    """How often a claim's tests, or those whose text has ``only``, come to some verdicts together."""
    monkeypatch.setattr(stats, "RESAMPLES", 2)  # the intervals, which no verdict hangs on
    rng = np.random.default_rng(0)
    found = []
    for _ in range(POPULATIONS):
        data = study(rng, **populations)
        findings = [f for each in claim.environments for f in claim.findings(data, each) if only in f.what]
        assert findings
        found.append(claims.combined(claims.judge(findings, claim.combine), claim.combine, len(findings)))
    shares = [found.count(verdict) / POPULATIONS for verdict in verdicts]
    print(f"\n{claim.id} {populations}: {', '.join(map('{} {:.1%}'.format, verdicts, shares))}")
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


def test_crashes_that_vary_between_policies_do_not_support_few(monkeypatch):
    """Where half of the policies of every method are above a crash in 10^6 steps, C11 is supported in at most 5 %."""
    limit = math.log1p(3.999)
    assert rates(monkeypatch, BY_ID["C11"], ["supported"], environment="relative", at=limit)[0] <= MOST
    safe = {"environment": "relative", "at": limit, "crashes": {"vds": -3.0}}
    assert rates(monkeypatch, BY_ID["C11"], ["supported"], **safe)[0] > 0.8
