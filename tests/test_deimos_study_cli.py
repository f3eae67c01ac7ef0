"""The command line of a study: what it understands, and what it refuses in one line."""

import pytest

from deimos.run.folder import RunError
from deimos.study import cli, plan
from deimos.study.folder import identity
from deimos.study.presets import PRESETS
from deimos.study.results import results


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", [0, 1, 2]), ("10-12", [10, 11, 12]), ("0,3,5", [0, 3, 5]), ("7-7, 9", [7, 9]), ("0", [0])]
)
def test_seeds_are_a_number_a_range_or_a_list(text, seeds):
    """A plain number is how many seeds; a range and a list say which."""
    assert cli.parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "-3", "a", "3-", "5-3", "1;2", "1.5"])
def test_other_seeds_are_refused(text):
    """Anything else is refused with what it was."""
    with pytest.raises(RunError, match=f"seeds must be .*got '{text}'"):
        cli.parse_seeds(text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"preset": "small", "file": "x.toml"}, "preset and file exclude each other"),
        ({"seeds": "3", "methods": ["p25"]}, "seeds, methods change a preset or a file; give one of them too"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, options, message):
    """Options of ``run`` that contradict each other are refused when they are parsed."""
    with pytest.raises(ValueError, match=message):
        cli.RunOptions(folder=tmp_path, **options)


def test_merge_needs_a_source(tmp_path):
    """Merging nothing into a folder is a mistake."""
    with pytest.raises(ValueError, match="sources must be one or more study folders, got none"):
        cli.MergeOptions(folder=tmp_path, sources=[])


RUN_ERRORS = {
    "no study": ({}, "study holds no study; begin one with --preset or --file"),
    "unknown preset": ({"preset": "huge"}, "There is no preset 'huge'; there are: absolute"),
    "unknown method": ({"preset": "small", "methods": ["q33"]}, "There is no method 'q33'"),
    "doubled seed": ({"preset": "small", "seeds": "0,0"}, "Every seed must be given once; doubled: 0"),
    "foreign environment": (
        {"preset": "small", "environments": ["quad"]},
        "This study has no environment quad; it has: directional",
    ),
    "bad budget": ({"preset": "small", "env_steps": 0}, "env_steps must be at least 1, got 0"),
}


@pytest.mark.parametrize("name", RUN_ERRORS)
def test_mistake_is_refused_before_anything_is_made(tmp_path, name):
    """A mistake in the command leaves no folder behind."""
    options, message = RUN_ERRORS[name]
    with pytest.raises(RunError, match=message):
        cli.run(cli.RunOptions(folder=tmp_path / "study", **options))
    assert not (tmp_path / "study").exists()


def test_results_of_another_schema_stop_the_run(tmp_path):
    """A folder whose results are of another schema is refused before cells are added to it."""
    (tmp_path / "results.csv").write_text("method,seed\n")
    with pytest.raises(RunError, match="another schema; missing: environment, hash"):
        cli.run(cli.RunOptions(folder=tmp_path, preset="small"))
    assert not (tmp_path / "cells").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"setting": "other"}, "environment 'directional' were run with 2 different settings"),
        ({"selector": "other"}, "'p25' stands for 2 different selectors in environment 'directional'"),
    ],
)
def test_cells_that_do_not_compare_with_the_results_stop_the_run(tmp_path, change, message):
    """A study of another setting, or of another selector of the same name, is refused before its cells are made."""
    (cell,) = plan.expand(PRESETS["small"], seeds=[7], methods=["p25"])
    table, values = results(tmp_path), {str: "x", int: 1, float: 0.5, bool: False, tuple: (), dict: {}}
    table.append([{name: values[kind] for name, kind in table.columns.items()} | identity(cell) | change])
    with pytest.raises(RunError, match=message):
        cli.run(cli.RunOptions(folder=tmp_path, preset="small", methods=["p25"]))
    assert not (tmp_path / "cells").exists()


@pytest.mark.parametrize("command", [cli.show, cli.report])
def test_empty_folder_is_refused(tmp_path, command):
    """There is nothing to show or report in an empty folder, and the line says so."""
    options = cli.ShowOptions if command is cli.show else cli.ReportOptions
    with pytest.raises(RunError, match="holds no "):
        command(options(folder=tmp_path))


def test_presets_are_listed(capsys, monkeypatch):
    """Every preset is named with its methods."""
    monkeypatch.setenv("COLUMNS", "200")
    cli.presets(cli.PresetsOptions())
    out = capsys.readouterr().out
    assert all(name in out for name in PRESETS)


def test_coverage_is_a_table(capsys, monkeypatch):
    """The simulation of coverages prints every kind of interval."""
    monkeypatch.setenv("COLUMNS", "120")
    cli.coverage(cli.CoverageOptions(populations=100, resamples=1000))
    out = capsys.readouterr().out
    assert all(name in out for name in ("IQM", "median", "BCa", "bootstrap-t", "ratio of IQRs", "lognormal"))


def test_every_command_has_its_options():
    """The usage names exactly the commands that there are."""
    for name in cli.COMMANDS:
        assert f"\n  {name} " in cli.USAGE
