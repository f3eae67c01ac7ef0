"""The picture of the answer: means over variants that count alike, beside Uniform's score in each."""

import numpy as np
import pytest

from reproduction.measures import Evidence
from reproduction.particle_picture import points

RATES = {"directional": 0.2, "absolute": 0.1}
UNITS = {"directional": 0.8, "absolute": 1.6}


def evidence(*without):
    """Twelve policies of Uniform and eight of p75 in each variant, whose means are known; RND in one variant only."""
    rows = []
    for variant, rate in RATES.items():
        for method, n, share in (("uniform", 12, 1.0), ("p75", 8, 0.5), ("rnd", 6, 0.1)):
            if (method, variant) == ("rnd", "absolute") or method in without:
                continue
            for seed, off in enumerate(np.linspace(-0.01, 0.01, n)):
                key = {"environment": variant, "method": method, "seed": seed, "goal_period": 100}
                naive = {"goals": "naive", "score": share * UNITS[variant] + off, "worst": share * rate + off}
                rows += [key | naive, key | {"goals": "argmax", "crash_rate": share * rate + off}]
    return Evidence(rows, renamed=False)


def test_points_are_means_beside_uniform():
    """Variants count alike, however many policies they have; a method that lacks a variant has no point."""
    found = points(evidence(), ["uniform", "p75", "rnd", "vds"])
    assert [*found] == ["uniform", "p75"]
    assert found["uniform"][0].estimate == pytest.approx(1.0)
    score, rate = found["p75"]
    assert (score.estimate, rate.estimate) == (pytest.approx(0.5), pytest.approx(100 * 0.5 * 0.15))
    assert rate.low < rate.estimate < rate.high


def test_without_uniform_there_is_no_unit():
    """Scores are beside Uniform's; where it was not run nothing is drawn."""
    assert points(evidence("uniform"), ["p75"]) == {}
