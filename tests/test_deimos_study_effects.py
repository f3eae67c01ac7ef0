"""Effects of factors and slopes over a noisy base line, on simulated settings whose truth is known."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from deimos.study import effects

SETTINGS, STUDIES = 32, 300


@pytest.fixture
def design():
    """A design of 5 factors in all 32 combinations."""
    return np.array([*itertools.product((-1.0, 1.0), repeat=5)])


def excludes(interval):
    """Whether an interval says that there is an effect."""
    return interval.low > 0.0 or interval.high < 0.0


def test_effects_are_exact_without_noise(design):
    """The effect of a factor is the difference of the outcome between its levels, whatever else acts."""
    outcome = 3.0 + 2.0 * design[:, 1] - 0.25 * design[:, 4]
    found = effects.factor_effects(design, outcome, permutations=99)
    assert [each.estimate for each in found] == pytest.approx([0.0, 4.0, 0.0, 0.0, -0.5], abs=1e-12)
    for constant in (0.0, 0.1):
        still = effects.factor_effects(design, np.full(32, constant), permutations=99)
        assert {(each.estimate, excludes(each)) for each in still} == {(0.0, False)}


def test_no_factor_moves_noise(design):
    """Where nothing is moved, an interval excludes 0 in 5 % of studies, also if the outcome is skewed and mostly 0."""
    rng, wrong = np.random.default_rng(0), 0
    for seed in range(STUDIES):
        outcome = np.where(rng.random(SETTINGS) < 0.6, 0.0, rng.lognormal(size=SETTINGS))
        wrong += any(map(excludes, effects.factor_effects(design, outcome, permutations=199, seed=seed)))
    assert wrong / STUDIES <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / STUDIES)


def test_a_factor_is_found_among_others(design):
    """An effect of two standard deviations is found nearly always, and its interval holds the truth in 95 %."""
    rng, found, covered = np.random.default_rng(1), 0, 0
    for seed in range(100):
        outcome = design[:, 2] + rng.normal(size=SETTINGS) * (1.0 + 0.5 * design[:, 2])  # noisier at one level
        own = effects.factor_effects(design, outcome, permutations=199, seed=seed)
        found += excludes(own[2])
        covered += all(each.low <= 2.0 * (i == 2) <= each.high for i, each in enumerate(own))
    assert found >= 95
    assert covered >= 88  # of all five at once


def test_effects_that_cannot_be_told_are_refused(design):
    """Too few settings, and a factor that is another's mirror image."""
    with pytest.raises(ValueError, match="levels must be of 8 settings or more for 5 factors, got 7"):
        effects.factor_effects(design[:7], np.zeros(7))
    design[:, 3] = -design[:, 0]
    with pytest.raises(ValueError, match="follow from those of others"):
        effects.factor_effects(design, np.zeros(32))


def simulated(rng, slope, noise=0.15):
    """Outcome, base line and instrument of settings: a method removes ``slope`` of the danger, every rate is noisy."""
    danger = rng.beta(0.7, 1.0, SETTINGS)
    base, again, own = (danger + rng.normal(scale=noise, size=SETTINGS) for _ in range(3))
    return base - (own - slope * danger), base, again


@pytest.mark.parametrize("slope", [0.0, 0.6])
def test_slope_is_found_and_none_is_not(slope):
    """The interval holds the true slope in 95 % of studies, where least squares on the noisy base line finds one."""
    rng, covered, naive, wrong = np.random.default_rng(2), 0, [], []
    for _ in range(STUDIES):
        outcome, base, again = simulated(rng, slope)
        found = effects.instrumented_slope(outcome, base, again)
        covered += found.low <= slope <= found.high
        naive.append(np.polyfit(base, outcome, 1)[0])
        wrong.append(found.estimate)
    assert covered / STUDIES >= 0.95 - 3 * math.sqrt(0.05 * 0.95 / STUDIES)
    assert np.median(wrong) == pytest.approx(slope, abs=0.03)
    assert np.mean(naive) > slope + 0.05


def test_an_instrument_that_measures_nothing_has_no_interval():
    """Where the second measurement has nothing to do with the first, the interval is the whole line."""
    rng = np.random.default_rng(3)
    outcome, base, _ = simulated(rng, 0.5)
    found = effects.instrumented_slope(outcome, base, rng.permutation(SETTINGS) / SETTINGS)
    assert (found.low, found.high) == (-math.inf, math.inf)
    alternating = np.resize([1.0, -1.0], SETTINGS)
    for nothing in (
        (base, np.zeros(SETTINGS)),
        (base, np.full(SETTINGS, 0.7)),
        (np.full(SETTINGS, 0.7), base),
        (alternating, np.resize([1.0, 1.0, -1.0, -1.0], SETTINGS)),
    ):  # constant, or uncorrelated
        still = effects.instrumented_slope(outcome, *nothing)
        assert math.isnan(still.estimate)
        assert (still.low, still.high) == (-math.inf, math.inf)


def test_the_interval_of_a_slope_is_what_students_test_does_not_reject():
    """At its ends the mean of (outcome - b base) times the centred instrument is as far from 0 as 5 % allow."""
    outcome, base, again = simulated(np.random.default_rng(4), 0.4)
    found, centred = effects.instrumented_slope(outcome, base, again), again - again.mean()
    assert found.estimate == pytest.approx(np.cov(outcome, again)[0, 1] / np.cov(base, again)[0, 1])
    for end in (found.low, found.high):
        left = centred * ((outcome - outcome.mean()) - end * (base - base.mean()))
        ratio = left.mean() / scipy_stats.sem(left)
        assert abs(ratio) == pytest.approx(scipy_stats.t.ppf(0.975, SETTINGS - 2))


def test_errors_of_effects_are_hc3(design):
    """Intervals are as many of White's errors wide, each residual over 1 - its leverage, as the permutations say."""
    rng = np.random.default_rng(5)
    levels, outcome = rng.permuted(design, axis=0), rng.lognormal(size=SETTINGS)
    x = np.column_stack([np.ones(SETTINGS), levels])
    inverse = np.linalg.inv(x.T @ x)
    residuals = (outcome - x @ inverse @ x.T @ outcome) / (1 - np.diag(x @ inverse @ x.T))
    errors = 2 * np.sqrt(np.diag(inverse @ (x.T * residuals**2) @ x @ inverse))[1:]
    found = effects.factor_effects(levels, outcome, permutations=99)
    widths = [(each.high - each.estimate) / error for each, error in zip(found, errors, strict=True)]
    assert widths == pytest.approx([widths[0]] * 5)
