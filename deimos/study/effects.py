"""What moves an outcome over the settings of a design. The unit is one setting; arrays have one entry for each."""

import numpy as np
from scipy import stats as scipy_stats

from deimos.study.stats import LEVEL, Array, Interval

PERMUTATIONS = 3999


def factor_effects(levels: Array, outcome: Array, *, permutations: int | None = None, seed: int = 0) -> list[Interval]:
    """How much each factor of a design moves an outcome, with intervals that hold for all factors at once.

    Least squares over all factors; standard errors allow settings to differ in their spread (HC3 [1]_). The intervals
    are as wide as the largest ratio of an effect to its error is in 95 % of permutations of the outcome over settings
    [2]_: if no factor moves it, some interval excludes 0 in 5 % of all studies.

    Args:
        levels: -1 or 1 for the two levels of each factor, shape (n, k), n at least k + 3.
        outcome: Shape (n,).
        permutations: How many; ``None``: ``PERMUTATIONS``.
        seed: Of the permutations.

    Returns:
        The difference between the outcome at the second level and at the first, for each factor.

    Raises:
        ValueError: If there are too few settings, or the levels of a factor follow from those of others.

    References:
        .. [1] MacKinnon and White, *Some Heteroskedasticity-Consistent Covariance Matrix Estimators*, Journal of
           Econometrics 29, 1985.
        .. [2] Westfall and Young, *Resampling-Based Multiple Testing*, 1993, section 2.3.
    """
    n, k = levels.shape
    design = np.column_stack([np.ones(n), levels])
    if n < k + 3:
        raise ValueError(f"levels must be of {k + 3} settings or more for {k} factors, got {n}.")
    if np.linalg.matrix_rank(design) <= k:
        raise ValueError("The levels of a factor follow from those of others, so their effects cannot be separated.")
    outcomes = np.tile(outcome, ((permutations or PERMUTATIONS) + 1, 1))
    outcomes[1:] = np.random.default_rng(seed).permuted(outcomes[1:], axis=1)
    inverse = np.linalg.pinv(design)  # (k + 1, n)
    hat = design @ inverse
    room = np.maximum(1.0 - np.diag(hat), 1e-9)  # a setting that fits itself has no residual
    residuals = (outcomes - outcomes @ hat.T) / room
    effects = 2.0 * outcomes @ inverse[1:].T  # (studies, k)
    errors = 2.0 * np.sqrt(residuals**2 @ (inverse[1:] ** 2).T)
    rounding = 1e-12 * max(float(np.abs(outcome).max()), 1e-300)
    effects[np.abs(effects) < rounding] = 0.0
    ratios = np.abs(effects) / np.maximum(errors, rounding)
    widest = np.quantile(ratios[1:].max(axis=1), LEVEL)
    return [Interval(float(x), float(x - widest * e), float(x + widest * e))
            for x, e in zip(effects[0], errors[0], strict=True)]  # fmt: skip


def instrumented_slope(outcome: Array, base: Array, instrument: Array) -> Interval:
    """Slope of an outcome over a noisy baseline, by a second measurement of it as an instrumental variable [1]_.

    The noise of ``base`` may be in ``outcome`` too, as where it is a difference to the baseline; least squares would
    then find a slope where there is none. That of ``instrument`` must be independent of both.

    Args:
        outcome: Shape (n,), n at least 4.
        base: The baseline with noise, shape (n,).
        instrument: The baseline measured again, shape (n,).

    Returns:
        The slope with its interval by Fieller's theorem [2]_, infinite where the two measurements have nothing in
        common.

    References:
        .. [1] Fuller, *Measurement Error Models*, 1987, section 1.4.
        .. [2] Fieller, *Some Problems in Interval Estimation*, J. Royal Statistical Society B 16, 1954.
    """
    n, centred = len(outcome), instrument - instrument.mean()
    above, below = centred * (outcome - outcome.mean()), centred * (base - base.mean())
    if any(len({*x}) < 2 for x in (base, instrument)) or not below.mean():  # rounding leaves constants a covariance
        return Interval(np.nan, -np.inf, np.inf)
    slope = above.mean() / below.mean()
    (aa, ab), (_, bb) = np.cov(above, below) / n
    t2 = scipy_stats.t.ppf((1 + LEVEL) / 2, n - 2) ** 2
    # All b with (mean(above) - b mean(below))^2 <= t^2 (aa - 2 b ab + b^2 bb).
    a = below.mean() ** 2 - t2 * bb
    b, c = above.mean() * below.mean() - t2 * ab, above.mean() ** 2 - t2 * aa
    if a <= 0.0:
        return Interval(float(slope), -np.inf, np.inf)
    half = np.sqrt(max(b**2 - a * c, 0.0)) / a
    return Interval(float(slope), float(b / a - half), float(b / a + half))
