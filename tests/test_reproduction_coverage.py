"""How often the intervals of the report contain the truth."""

import math

from reproduction import coverage


def test_coverage_of_the_intervals():
    """In 200 populations of 10, IQM, median and bootstrap-t cover as promised, and the percentile mean does not."""
    rows = {(row.statistic, row.interval): row for row in coverage.simulate(10, 200, 1000, seed=1)}
    error = 4 * math.sqrt(0.95 * 0.05 / 200)  # four standard errors of a coverage of 95 %
    for statistic in ("IQM", "median"):
        row = rows[statistic, "percentile"]
        assert 0.92 - error < min(row.normal, row.lognormal)
        assert max(row.normal, row.lognormal) < 0.97 + error
    assert rows["mean", "percentile"].lognormal < rows["mean", "bootstrap-t"].lognormal
    assert rows["mean", "bootstrap-t"].normal > 0.92 - error
    assert rows["ratio of spreads", "percentile of the logarithm"].normal > 0.92 - error
