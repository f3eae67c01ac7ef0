"""The primary hypotheses, on simulated rows whose truth is known."""

import math

import numpy as np
import pytest

from reproduction import hypotheses
from reproduction.hypotheses import VARIANTS
from reproduction.measures import PENALTIES, Evidence

DOSES = {"coop": 2, "p10": 54, "uniform": 50, "p25": 62, "p50": 74, "p75": 86, "p90": 94, "antagonist": 98}


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Resample and permute little."""
    monkeypatch.setattr(hypotheses, "PERMUTATIONS", 499)
    monkeypatch.setattr(hypotheses, "RESAMPLES", 300)


def study(rate, score=lambda method, rng: 1.0, seeds=range(30), seed=0):
    """Rows and curves of all methods in both variants; ``rate(method, rng, seed)`` under the worst attacker."""
    rng, rows, curves = np.random.default_rng(seed), [], []
    for variant in VARIANTS:
        for method in (*DOSES, *PENALTIES):
            for number in seeds:
                key = {"environment": variant, "method": method, "seed": number}
                worst = float(np.clip(rate(method, rng, number), 0, 1))
                rows.append(key | {"goals": "naive", "goal_period": 100, "worst": worst,
                                   "score": score(method, rng) + 0.02 * rng.normal()})  # fmt: skip
                curves.append(key | {"goal_percentile": (DOSES.get(method, 50) + rng.normal(),)})
    return Evidence(rows, curves, renamed=False)


def bimodal(share, rng):
    """The rate of a policy that is unsafe with some probability."""
    return rng.uniform(0.1, 0.5) if rng.random() < share else 0.001


def test_best_p_is_found_safer():
    """A p that makes fewer unsafe policies than Uniform and both penalties is chosen, and H1 and H2 hold."""
    found = hypotheses.primary(study(lambda m, rng, s: bimodal(0.05 if m == "p75" else 0.8, rng)))
    assert [each.name for each in found] == ["H1", "H2", "H3"]
    assert found[0].text == "p75 is safer than uniform"
    assert "p75 is safer than penalty-" in found[1].text
    assert [each.holds for each in found[:2]] == [True, True]
    assert found[0].effect.low > 0.0
    assert found[0].effect.estimate > found[0].detectable
    assert found[0].corrected == pytest.approx(3 * found[0].p)


def test_choice_and_test_use_different_seeds():
    """A p that is the safest on seeds 0 to 9 alone is chosen, and not found safer on the others."""
    found = hypotheses.primary(study(lambda m, rng, s: bimodal(0.05 if m == "p10" and s < 10 else 0.8, rng)))
    assert found[0].text == "p10 is safer than uniform"
    assert not found[0].holds


def test_score_must_not_be_lower():
    """A p that is safer at nine tenths of the score does not fulfil H2, but H1."""
    found = hypotheses.primary(study(
        lambda m, rng, s: bimodal(0.05 if m == "p75" else 0.8, rng), lambda m, rng: 0.9 if m == "p75" else 1.0
    ))  # fmt: skip
    assert [each.holds for each in found[:2]] == [True, False]
    assert found[1].note.startswith("ratio of scores 0.89")


def test_hump_is_found_and_a_line_is_not():
    """Score and safety that are best inside fulfil H3; those that only fall over the dose do not."""

    def inside(method):
        return 1 - ((DOSES.get(method, 50) - 50) / 50) ** 2

    humped = study(lambda m, rng, s: 0.5 - 0.4 * inside(m) + 0.03 * rng.normal(), lambda m, rng: inside(m))
    assert hypotheses.primary(humped)[2].holds
    falling = study(lambda m, rng, s: 0.1 + 0.004 * DOSES.get(m, 50) + 0.03 * rng.normal(),
                    lambda m, rng: 1 - 0.01 * DOSES.get(m, 50))  # fmt: skip
    found = hypotheses.primary(falling)[2]
    assert not found.holds
    assert found.effect.estimate < 0


def test_slopes_are_those_of_a_known_parabola():
    """Exact parabolas have the slopes towards the inside that their formula gives, whatever the variants' levels."""
    dose = np.tile(np.linspace(10, 90, 9), 2)
    variant = np.repeat([0.0, 1.0], 9)
    score = 3 - 0.001 * (dose - 40) ** 2 + 5 * variant
    safety = 0.01 * dose - variant
    found = hypotheses.slopes(np.stack([variant, dose, score, safety])[:, None], np.array([10.0, 90.0]))[:, 0]
    assert found == pytest.approx([0.06, 0.1, 0.01, -0.01])


def test_permutation_is_within_variants():
    """A difference between variants alone is none between methods, and without one the level of the test holds."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(200):
        pairs = [(level + rng.normal(size=10), level + rng.normal(size=10)) for level in (0.0, 100.0)]
        found.append(hypotheses.permuted(pairs)[0])
    assert np.mean(np.array(found) <= 0.05) <= 0.05 + 4 * math.sqrt(0.05 * 0.95 / 200)
    assert (
        hypotheses.permuted([(rng.normal(1, 1, 10) + level, rng.normal(size=10) + level) for level in (0, 100)])[0]
        < 0.05
    )


def test_missing_data_are_said(tmp_path):
    """Without fresh seeds or penalties nothing is shown, and the answers say so."""
    found = hypotheses.primary(study(lambda m, rng, s: 0.1, seeds=range(10)))
    assert [each.text.endswith("no data") for each in found[:2]] == [True, True]
    assert not any(each.holds for each in found)
    empty = hypotheses.primary(Evidence([], renamed=False))
    assert [each.corrected for each in empty] == [1.0, 1.0, 1.0]


def test_command_prints_three_answers(monkeypatch, capsys):
    """The rows of 0.1.0 have neither fresh seeds nor penalties."""
    monkeypatch.setattr("sys.argv", ["hypotheses", "docs/results/particle_0.1.0"])
    hypotheses.main()
    assert capsys.readouterr().out.count("is not shown") == 3
