"""The table of methods, and the configurations of selectors that are refused."""

import math

import pytest

from deimos import plugins
from deimos.goals import selectors
from deimos.goals.methods import METHODS, method
from deimos.goals.selectors import boltzmann, cl, director, grid, learnability, mix, plr, rnd, schedule, uniform, vds


@pytest.mark.parametrize(
    ("config", "field", "value", "message"),
    [
        (director.Config, "percentile", 101, r"percentile must be in \[0, 100\], got 101"),
        (director.Config, "percentile", math.nan, "percentile must be in"),
        (director.Config, "rule", "max", "rule must be one of percentile, argmin, argmax, got 'max'"),
        (director.Config, "candidates", 0, "candidates must be at least 1, got 0"),
        (director.Config, "probe", 1.5, r"probe must be in \[0, 1\], got 1.5"),
        (director.Config, "control", "blind", "control must be one of none, shuffled, state-blind, got 'blind'"),
        (uniform.Config, "candidates", 0, "candidates must be at least 1, got 0"),
        (learnability.Config, "rule", "argmax", "rule must be one of proportional, percentile, band, got 'argmax'"),
        (learnability.Config, "percentile", -1, r"percentile must be in \[0, 100\], got -1"),
        (learnability.Config, "low", 0.9, "low must be below high, got 0.9 and 0.9"),
        (learnability.Config, "high", 1.1, r"high must be in \[0, 1\], got 1.1"),
        (boltzmann.Config, "beta", math.inf, "beta must be finite, got inf"),
        (boltzmann.Config, "beta_start", math.nan, "beta_start must be finite, got nan"),
        (boltzmann.Config, "anneal", 2.0, r"anneal must be in \[0, 1\], got 2.0"),
        (vds.Config, "critics", 0, "critics must be at least 1, got 0"),
        (vds.Config, "rule", "mean", "rule must be one of proportional, argmax, percentile, uniform, got 'mean'"),
        (vds.Config, "role", "both", "role must be one of replace, auxiliary, got 'both'"),
        (vds.Config, "data", "some", "data must be one of all, share, got 'some'"),
        (vds.Config, "clip", 0.0, "clip must be positive, got 0.0"),
        (vds.Config, "hidden", (), "hidden must be one or more positive layer sizes"),
        (rnd.Config, "rule", "percentile", "rule must be one of argmax, proportional, got 'percentile'"),
        (rnd.Config, "features", 0, "features must be at least 1, got 0"),
        (rnd.Config, "target", 0, "target must be at least 1, got 0"),
        (rnd.Config, "predictor", 31, "predictor must have at least the target.s 32 units, .*, got 31"),
        (cl.Config, "threshold", 1.0, r"threshold must be in \(0, 1\), got 1.0"),
        (cl.Config, "start", 0.0, r"start must be in \(0, 1\], got 0.0"),
        (cl.Config, "growth", 1.5, r"growth must be in \(0, 1\], got 1.5"),
        (cl.Config, "min_interactions", 0, "min_interactions must be at least 1, got 0"),
        (grid.Config, "threshold", 0.0, r"threshold must be in \(0, 1\), got 0.0"),
        (grid.Config, "bins", 1, "bins must be at least 2, got 1"),
        (grid.Config, "reach", 0.0, "reach must be finite and positive, got 0.0"),
        (plr.Config, "replay", 1.1, r"replay must be in \[0, 1\], got 1.1"),
        (plr.Config, "fill", 0.0, r"fill must be in \(0, 1\], got 0.0"),
        (plr.Config, "temperature", 0.0, "temperature must be finite and positive, got 0.0"),
        (plr.Config, "capacity", 0, "capacity must be at least 1, got 0"),
        (plr.Config, "capacity", 2**24, r"capacity must be below 2\^24, got 16777216"),
        (schedule.Config, "at", 1.0, r"at must be in \(0, 1\), or the schedule never switches; got 1.0"),
        (schedule.Config, "at", 0.0, r"at must be in \(0, 1\), or the schedule never switches; got 0.0"),
        (schedule.Config, "second", "p333", "Unknown method 'p333'"),
        (mix.Config, "share", -0.1, r"share must be in \[0, 1\], got -0.1"),
        (mix.Config, "base", "best", "Unknown method 'best'"),
    ],
)
def test_config_rejects(config, field, value, message):
    """The message names the field, what it must be and what it was, in one line."""
    with pytest.raises(ValueError, match=message) as caught:
        config(**{field: value})
    assert "\n" not in str(caught.value)


def test_an_unknown_method_lists_the_known_ones():
    """The message lists every method."""
    for name in ("p101", "p1e1", "p07", "p-1", "p", "nope", "", "penalty-NN", "uniform-literal", "p75-"):
        with pytest.raises(ValueError, match=f"Unknown method '{name}'; choose from: uniform, coop, p10") as caught:
            method(name)
        assert all(known in str(caught.value) for known in [*METHODS, "pNN", "boltzmann", "schedule"])


@pytest.mark.parametrize(("name", "percentile"), [("p0", 0), ("p33", 33), ("p12.5", 12.5), ("p100", 100)])
def test_every_percentile_is_a_method(name, percentile):
    """A p and a percentile in [0, 100] is the Director at that percentile; the table stays what it is."""
    assert method(name) == director.Config(percentile=percentile)
    assert name not in METHODS


@pytest.mark.parametrize("name", ["p75-literal-threshold", "p75-threshold-literal", "coop-literal-literal"])
def test_a_fear_has_one_kind_of_data(name):
    """A second suffix would quietly win over the first one, so there is no such method."""
    assert method(name.rpartition("-")[0]).memory == 0
    with pytest.raises(ValueError, match=f"Unknown method '{name}'"):
        method(name)


def test_every_selector_is_a_method():
    """A selector's own name is a method with its defaults, also where another package brings it."""
    for name in plugins.names(selectors):
        assert method(name) == plugins.load(selectors, name).Config()


def test_the_thesis_has_twelve_methods():
    """All twelve of its comparison are in the table, Director percentiles and roles as it names them."""
    twelve = "uniform coop p10 p25 p50 p75 p90 antagonist rnd vds cl vds+p75".split()
    assert set(twelve) <= set(METHODS)
    assert [method(name).percentile for name in twelve[2:7]] == [10, 25, 50, 75, 90]
    assert method("vds").role == "replace"
    assert method("vds+p75") == schedule.Config(first="vds", second="p75", at=0.5)
