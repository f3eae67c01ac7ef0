"""The commands of the reproduction: a report with claims, and the table of coverages."""

import pytest

from deimos.study import stats
from deimos.study.results import RESULT_COLUMNS, Results
from reproduction import __main__ as reproduction


def test_report_has_the_claims(tmp_path, capsys, monkeypatch):
    """The report of a folder of tables has a verdict on each of the thesis's claims."""
    values = {str: "v", int: 100, float: 0.5, bool: False, tuple: (), dict: {}, list: []}
    row = {name: values[kind] for name, kind in RESULT_COLUMNS.items()} | {"block": None}
    rows = [
        row | {"environment": "relative", "method": method, "hash": f"{method}{seed}", "seed": seed, "goals": goals}
        for method in ("uniform", "p25") for seed in range(2) for goals in ("naive", "adversary")
    ]  # fmt: skip
    Results(rows).write(tmp_path)
    monkeypatch.setattr(stats, "RESAMPLES", 200)
    assert reproduction.main(["report", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'report.html'}\n"
    text = (tmp_path / "report.md").read_text()
    assert all(f"| C{number} |" in text for number in range(1, 38))


def test_report_of_nothing_is_refused(tmp_path, capsys):
    """An empty folder is refused in one line with exit code 2."""
    assert reproduction.main(["report", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path} holds no results; it is empty, or not a study's folder.\n"


def test_coverage_is_a_table(capsys, monkeypatch):
    """The simulation of coverages prints every kind of interval."""
    monkeypatch.setenv("COLUMNS", "120")
    assert reproduction.main(["coverage", "--populations", "100", "--resamples", "1000"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("IQM", "median", "BCa", "bootstrap-t", "ratio of spreads", "lognormal"))


@pytest.mark.parametrize(("arguments", "code"), [([], 0), (["--help"], 0), (["nope"], 2)])
def test_usage_names_the_commands(arguments, code, capsys):
    """Without a command, or with one that is not there, the commands are named."""
    assert reproduction.main(arguments) == code
    assert "{report,multiverse,coverage}" in capsys.readouterr().out
