"""Designs over factors: which settings they try, what they cannot tell apart, and what is refused."""

import itertools
import math

import numpy as np
import pytest

from deimos.checks import RunError
from deimos.study import factors, plan

BASE = """
seeds = 2
methods = ["uniform", "p25"]
[[environment]]
name = "directional"
env = { kind = "particle", variant = "directional" }
"""
TWO = {name: [-1, 1] for name in "ABCDEFG"}


def expanded(tmp_path, text, **options):
    """The cells of the base study with some text more; options as those of ``plan.expand``."""
    path = tmp_path / "study.toml"
    path.write_text(BASE + text)
    return plan.expand(plan.read(path), **options)


def test_a_sweep_is_a_design_of_one_factor(tmp_path):
    """Every level is a setting of its own, under the environment's name with a number, and says its level."""
    cells = expanded(tmp_path, "[factors]\nenv.max_force = [0.5, inf]\n")
    found = [(cell.environment, cell.config.method, cell.config.env.max_force, cell.levels) for cell in cells[:4]]
    assert found == [
        ("directional.0", "uniform", 0.5, {"env.max_force": 0.5}),
        ("directional.0", "p25", 0.5, {"env.max_force": 0.5}),
        ("directional.1", "uniform", math.inf, {"env.max_force": "inf"}),
        ("directional.1", "p25", math.inf, {"env.max_force": "inf"}),
    ]  # fmt: skip
    assert {cell.base_environment for cell in cells} == {"directional"}
    assert len({cell.setting for cell in cells}) == 2
    assert len({cell.name for cell in cells}) == len(cells) == 8


def test_full_design_has_every_combination(tmp_path):
    """Factors of the environment, of the learner and of both together are crossed."""
    cells = expanded(tmp_path, """
[factors]
"ppo.epochs" = [1, 2, 3]
[[factors.horizon]]
name = "short"
env = { max_speed = 10.0, goal_period = 100 }
[[factors.horizon]]
name = "long"
env = { max_speed = 5.0, goal_period = 200 }
train = 1
""".replace("train = 1\n", ""))  # fmt: skip
    settings = {(cell.config.ppo.epochs, cell.config.env.max_speed, cell.config.env.goal_period) for cell in cells}
    assert settings == {(n, *pair) for n in (1, 2, 3) for pair in ((10.0, 100), (5.0, 200))}
    assert {(cell.levels["horizon"], cell.goal_periods) for cell in cells} == {("short", (100,)), ("long", (200,))}


def test_fractional_design_is_orthogonal():
    """Of a 2^(7-3) design each pair of columns is balanced, and a generated column is the product of its own."""
    design = {"kind": "fractional", "generators": {"E": list("ABC"), "F": list("BCD"), "G": list("ACD")}}
    table = np.array([list(point.levels.values()) for point in factors.expand(TWO, design)])
    assert table.shape == (16, 7)
    assert np.array_equal(table.T @ table, 16 * np.eye(7, dtype=int))
    a, b, c, d, e, f, g = table.T
    for made, product in ((e, a * b * c), (f, b * c * d), (g, a * c * d)):
        assert np.array_equal(made, product)


def test_aliases_are_those_of_the_columns():
    """Two effects are said to be aliased exactly where their columns are equal, and the resolution is that of books."""
    generators = {"E": list("ABC"), "F": list("BCD"), "G": list("ACD")}
    points = factors.expand(TWO, {"kind": "fractional", "generators": generators})
    columns = {name: np.array([point.levels[name] for point in points]) for name in TWO}
    columns |= {f"{a} x {b}": columns[a] * columns[b] for a, b in itertools.combinations(TWO, 2)}
    resolution, lines = factors.aliases(generators, list(TWO))
    assert resolution == 4  # Box, Hunter and Hunter: 2^(7-3) is IV
    said = {frozenset(line.split(" = ")) for line in lines}
    assert said == {
        same for name in columns
        if len(same := frozenset(n for n, x in columns.items() if np.array_equal(x, columns[name]))) > 1
    }  # fmt: skip
    assert factors.aliases({"C": ["A", "B"]}, ["A", "B", "C"]) == (3, ["A = B x C", "B = A x C", "C = A x B"])
    text = factors.describe(TWO, {"kind": "fractional", "generators": generators})
    assert text.startswith("Design: fractional, 16 points of 7 factors (A, B, C, D, E, F, G). Resolution 4.\nAliased: ")


def test_sobol_sample_fills_the_ranges():
    """A sample of 2^m points has as many in each half of a range as in the other, and repeats with its seed."""
    ranges = {
        "ppo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
        "env.goal_period": {"low": 50, "high": 200},
        "env.reward": ["linear", "reciprocal"],
    }
    points = factors.expand(ranges, {"kind": "sobol", "points": 16, "seed": 3})
    assert points == factors.expand(ranges, {"kind": "sobol", "points": 16, "seed": 3})
    assert points != factors.expand(ranges, {"kind": "sobol", "points": 16, "seed": 4})
    rates, periods, rewards = (np.array([point.levels[name] for point in points]) for name in ranges)
    assert (rates < 1e-3).sum() == 8
    assert rates.min() >= 1e-4
    assert rates.max() <= 1e-2
    assert all(isinstance(point.fields["env"]["goal_period"], int) for point in points)
    assert 50 <= periods.min() < periods.max() <= 200
    assert (rewards == "linear").sum() == 8


def test_whole_ranges_have_both_ends():
    """A whole range is as often at either end as its numbers are wide, on its own scale, and never beyond them."""
    ranges = {"ppo.epochs": {"low": 1, "high": 3}, "ppo.minibatches": {"low": 1, "high": 3, "log": True}}
    points = factors.expand(ranges, {"kind": "sobol", "points": 1024})
    linear, rising = ([[point.levels[name] for point in points].count(value) for value in (1, 2, 3)] for name in ranges)
    assert sum(linear) == sum(rising) == 1024
    np.testing.assert_allclose(linear, 1024 / 3, atol=8)
    np.testing.assert_allclose(rising, 1024 * np.diff(np.log([1, 2, 3, 4])) / np.log(4), atol=8)


def test_small_sobol_sample_may_hide_a_factor_behind_another():
    """Of 16 points of 7 factors some split alike, and the line on the design says which; 32 points of 8 tell all."""
    eight = {f"env.f{i}": [0, 1] for i in range(8)}
    seven = {name: eight[name] for name in list(eight)[:7]}
    design = {"kind": "sobol", "points": 16}
    columns = {name: [point.levels[name] for point in factors.expand(seven, design)] for name in seven}
    same = {
        f"Aliased: {a} = {b}" for a, b in itertools.combinations(seven, 2)
        if columns[a] in (columns[b], [1 - x for x in columns[b]])
    }  # fmt: skip
    head, *lines = factors.describe(seven, design).splitlines()
    assert head.startswith("Design: sobol, 16 points of 7 factors (env.f0, ")
    assert len(same) > 0
    assert set(lines) == same
    assert "\n" not in factors.describe(eight, design | {"points": 32})
    share = {"low": 0.0, "high": 1.0}
    apart = {"env.low": [1], "env.high": [2], "env.rate": share, "env.gain": share}
    assert "\n" not in factors.describe(apart, design)  # one level each, and a value of its own for every point


def test_multiples_are_of_what_the_environment_has(tmp_path):
    """A multiple counts from the value of the preset, the environment or another factor, and from what None means."""
    cells = expanded(tmp_path, """
[[environment]]
name = "relative"
env = { kind = "particle", variant = "relative", max_speed = 4.0 }
train = { ppo = { learning_rate = 2e-3 } }
[factors]
env.max_speed = [10.0, 5.0]
times.env.goal_range = [1.0, 1.5]
times.ppo.learning_rate = [0.5]
[[factors.horizon]]
name = "long"
times = { env = { goal_period = 2 }, env_steps = 0.5 }
""")  # fmt: skip
    found = {
        (cell.environment, cell.config.env.max_speed, cell.config.env.goal_range, cell.config.ppo.learning_rate)
        for cell in cells
    }
    assert found == {
        (f"{name}.{i}", speed, times * (speed if name == "directional" else 1250.0), rate)
        for name, rate in (("directional", 5e-4), ("relative", 1e-3))
        for i, (speed, times) in enumerate([(10.0, 1.0), (10.0, 1.5), (5.0, 1.0), (5.0, 1.5)])
    }
    assert {(cell.config.env.goal_period, cell.goal_periods, cell.config.env_steps) for cell in cells} == {
        (200, (200,), 1000)
    }
    assert cells[0].levels == {
        "env.max_speed": 10.0, "times.env.goal_range": 1.0, "times.ppo.learning_rate": 0.5, "horizon": "long"
    }  # fmt: skip


def test_a_design_of_multiples_may_be_a_sample_of_a_range(tmp_path):
    """Multiples may come from a range, as levels of a field may."""
    sample = '[design]\nkind = "sobol"\npoints = 4\n[factors]\ntimes.env.max_force = { low = 0.5, high = 2.0 }\n'
    cells = expanded(tmp_path, sample)
    assert len({cell.config.env.max_force for cell in cells}) == 4
    assert {cell.config.env.max_force == cell.levels["times.env.max_force"] for cell in cells} == {True}


def test_a_factor_is_not_overridden(tmp_path):
    """An option for a field that a factor sets would have no effect, and is refused; one for its multiple has some."""
    with pytest.raises(RunError, match="env_steps cannot override a factor of the study; change its levels"):
        expanded(tmp_path, "[factors]\nenv_steps = [48, 96]", train={"env_steps": 24})
    cells = expanded(tmp_path, "[factors]\ntimes.env_steps = [1, 2]", train={"env_steps": 24})
    assert {cell.config.env_steps for cell in cells} == {24, 48}


MISTAKES = {
    "[factors]\nenv.max_force = []": r"\[factors\] env\.max_force must be a list of levels or a range, got \[\]",
    "[factors]\nenv.max_force = 3": r"\[factors\] env\.max_force must be a list of levels or a range, got 3",
    "[factors]\nenv.max_force = [1.0, 1.0]": "every level must be given once",
    "[factors]\nenv.mass = [1.0]": "Environment 'directional': .*Config has no mass",
    "[factors]\nppo.speed = [1.0]": "PPOConfig has no speed",
    "[factors]\nseed = [1, 2]": "seed cannot be in 'train' or be a factor",
    "[factors]\nnum_envs = [0]": "num_envs must be at least 1, got 0",
    "[factors]\nhorizon = [{ env = { goal_period = 5 } }]": "levels must be values, or tables of fields each",
    "[factors]\nenv = [2]": r"\[factors\] env must be a table, got 2",
    "[factors]\ntimes = [2]": r"\[factors\] times must be a table, got 2",
    "[factors]\ntimes.env = [2]": r"\[factors\] times\.env must be a table, got 2",
    "[factors]\ntimes.seed = [2]": "seed cannot be in 'train' or be a factor",
    "[factors]\ntimes.env.mass = [2.0]": "Environment 'directional': .*Config has no mass",
    "[factors]\ntimes.env.variant = [2.0]": r"variant must be a number to be multiplied.*got directional x 2\.0",
    "[factors]\ntimes.num_envs = ['much']": "num_envs must be a number to be multiplied.*got 2000 x much",
    "[factors]\ntimes.ppo.clip_value = [2]": "clip_value must be a number to be multiplied.*got True x 2",
    "[factors]\ntimes.env.goal_period = [0.333]": r"goal_period must stay a whole number, got 100 x 0\.333 = 33\.3",
    "[factors]\ntimes.env_steps = [inf]": "env_steps must stay a whole number, got 2000 x inf = inf",
    "[factors]\ntimes.env.max_force = [0.0]": "Environment 'directional': max_force must be positive",
    "[factors]\nppo.epochs = { low = 3, high = 1 }": r"ppo\.epochs must have low < high",
    "[factors]\nenv.max_speed = { low = -inf, high = 3.0 }": r"max_speed must have low < high, finite",
    "[factors]\nppo.epochs = { low = 1, high = 3 }": "must be a list of levels; only a sobol design takes a range",
    "[factors]\nppo.epochs = [1, 2]\nlong = [{ name = 'a', ppo.epochs = 3 }, { name = 'b', env.max_speed = 3.0 }]":
        r"\[factors\] ppo\.epochs and long both set ppo\.epochs; only one of them can",
    "[design]\nkind = 'sobol'": r"A \[design\] needs \[factors\], got none",
    "[factors]\nppo.epochs = [1, 2]\n[design]\nkind = 'half'": "kind must be one of full, .*, got 'half'",
    "[factors]\nppo.epochs = [1, 2]\n[design]\npoints = 4": r"A full \[design\] has no points; it has: kind",
    "[factors]\nppo.epochs = [1, 2]\n[design]\nkind = 'sobol'\npoints = 3": "points must be a power of 2 .*, got 3",
    "[factors]\nppo.epochs = [1, 2]\n[design]\nkind = 'sobol'": "points must be a whole number, got None",
    "[factors]\nppo.epochs = [1, 2]\n[design]\nkind = 'fractional'": "generators must be a table, got None",
    "[factors]\nppo.epochs = [1, 2, 3]\n[design]\nkind = 'fractional'\ngenerators = {}": "unlike ppo.epochs",
    "[factors]\nppo.epochs = [1, 2]\n[design]\nkind = 'fractional'\ngenerators = { 'ppo.epochs' = ['x', 'y'] }":
        r"generators must name for a factor two or more of .*, got ppo\.epochs = \['x', 'y'\]",
}  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MISTAKES.items())
def test_mistake_in_a_design_is_one_line(tmp_path, text, message):
    """Whatever is wrong with factors or their design is said in one line that names it."""
    with pytest.raises(RunError, match=message) as error:
        expanded(tmp_path, text)
    assert "\n" not in str(error.value)
