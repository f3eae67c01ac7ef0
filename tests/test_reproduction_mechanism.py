"""Tables of what each Director asked for, what it knew and what came of it, on rows whose means are known."""

import pytest

from deimos.checks import RunError
from reproduction import beside, mechanism
from reproduction.measures import Evidence

RATES = {"uniform": (0.10, 0.30), "oracle": (0.002, 0.004), "swapped": (0.10, 0.10)}
SCORES = {"uniform": 0.8, "oracle": 0.9, "swapped": 0.85}


@pytest.fixture
def evidence():
    """Two policies of three methods; one attacker meets all, one only the second seed, one only Uniform's."""
    rows, curves = [], []
    for method, worst in RATES.items():
        for seed in (0, 1):
            key = {"environment": "directional", "method": method, "seed": seed, "goal_period": 100}
            naive = key | {"goals": "naive", "crash_rate": 0.01, "score": SCORES[method], "worst": worst[seed]}
            attackers = ["scripted"] + ["search"] * seed + ["q-fear"] * (method == "uniform")
            rows += [naive, *(key | {"goals": name, "crash_rate": worst[seed] / 2} for name in attackers)]
            known = {"exact_percentile": (90.0, float("nan"), 80.0), "auroc": (0.7, 0.8), "fear_fitted": (0.0, 1.0)}
            dose = {"goal_percentile": (50.0 + seed,)}
            curves.append({"environment": "directional", "method": method, "seed": seed} | dose
                          | (known if method != "uniform" else {}))  # fmt: skip
    return Evidence(rows, curves, renamed=False)


def cells(evidence, methods):
    """The table as dictionaries by method."""
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in
                      mechanism.table(evidence, "directional", methods))  # fmt: skip
    return {row[0].strip("`"): dict(zip(head, row, strict=True)) for row in rows}


def test_numbers_are_means_over_policies(evidence):
    """Dose, exact rank, AUROC, rates and the share of safe policies are those of the rows, unknown points left out."""
    row = cells(evidence, ["uniform", "oracle"])["oracle"]
    assert (row["n"], row["delivered dose"], row["exact rank"]) == ("2", "50.5", "85.0")
    assert (row["AUROC"], row["fitted"], row["below 1 %"]) == ("0.75", "50%", "2 of 2")
    assert (row["naive"], row["scripted"]) == ("1.00", "0.15")
    assert row["worst"].startswith("0.30 [")


def test_attackers_are_those_that_all_methods_met(evidence):
    """One that met a few policies of each method counts over those; one that met a single method's is left out."""
    row = cells(evidence, ["uniform", "oracle"])["uniform"]
    assert "q-fear" not in row
    assert row["search"] == "15.00"
    assert cells(evidence, ["uniform"])["uniform"]["q-fear"] == "10.00"


def test_what_a_method_does_not_have_is_a_dash(evidence):
    """Uniform has no fear whose quality could be known, and a method without policies has no row."""
    found = cells(evidence, ["uniform", "state-blind"])
    assert [*found] == ["uniform"]
    assert {found["uniform"][name] for name in ("exact rank", "AUROC", "fitted")} == {"-"}


def test_who_is_better_in_both(evidence):
    """A method is beaten by those with a higher score and a lower worst rate; the best one by nobody."""
    found = cells(evidence, [*RATES])
    assert {name: row["better in both"] for name, row in found.items()} == {
        "uniform": "oracle, swapped", "oracle": "-", "swapped": "oracle",
    }  # fmt: skip


def test_what_is_not_there_is_named(evidence):
    """An environment without rows, and a rival without policies in every variant, are errors that say what there is."""
    with pytest.raises(RunError, match="environment must be one of directional, got relative"):
        mechanism.table(evidence, "relative")
    with pytest.raises(RunError, match="rival must be one of no methods: there are none, got uniform"):
        beside.table(evidence)
