"""The command line of a study: what it understands, and what it refuses in one line."""

from pathlib import Path

import pytest

from deimos.checks import RunError
from deimos.run.folder import RunFolder
from deimos.study import cli, plan
from deimos.study.folder import StudyFolder
from deimos.study.results import RESULT_COLUMNS, SCHEMA, Results, identity
from deimos.study.runner import Progress

SMALL = Path(__file__).parent.parent / "examples" / "study.toml"


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", [0, 1, 2]), ("10-12", [10, 11, 12]), ("0,3,5", [0, 3, 5]), ("7-7, 9", [7, 9]), ("0", [0])]
)
def test_seeds_are_a_number_a_range_or_a_list(text, seeds):
    """A plain number is how many seeds; a range and a list say which."""
    assert plan.parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "-3", "a", "3-", "5-3", "1;2", "1.5"])
def test_other_seeds_are_refused(text):
    """Anything else is refused with what it was."""
    with pytest.raises(RunError, match=f"seeds must be .*got '{text}'"):
        plan.parse_seeds(text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"seeds": "3", "methods": ["p25"]}, "seeds, methods change a file; give one too"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, options, message):
    """Options of ``run`` that contradict each other are refused when they are parsed."""
    with pytest.raises(ValueError, match=message):
        cli.RunOptions(folder=tmp_path, **options)


def test_no_seeds_are_not_all_seeds(tmp_path):
    """An empty text, as an unset variable of a shell gives, does not attack every policy."""
    with pytest.raises(RunError, match=r"seeds must be a number of seeds, .* got ''"):
        cli.AttackOptions(folder=tmp_path, attackers=("argmax",), seeds="")


def test_merge_needs_a_source(tmp_path):
    """Merging nothing into a folder is a mistake."""
    with pytest.raises(ValueError, match="sources must be one or more study folders, got none"):
        cli.MergeOptions(folder=tmp_path, sources=[])


RUN_ERRORS = {
    "no study": ({}, "study holds no study; begin one with --file"),
    "missing file": ({"file": Path("huge.toml")}, r"huge\.toml is not a study's TOML file .*No such file"),
    "unknown method": ({"file": SMALL, "methods": ["q33"]}, "Unknown method 'q33'"),
    "doubled seed": ({"file": SMALL, "seeds": "0,0"}, "Every seed must be given once; repeated: 0"),
    "foreign environment": (
        {"file": SMALL, "environments": ["quad"]},
        "This study has no environment quad; it has: directional",
    ),
    "bad budget": ({"file": SMALL, "env_steps": 0}, "env_steps must be at least 1, got 0"),
}


@pytest.mark.parametrize("name", RUN_ERRORS)
def test_mistake_is_refused_before_anything_is_made(tmp_path, name):
    """A mistake in the command leaves no folder behind."""
    options, message = RUN_ERRORS[name]
    with pytest.raises(RunError, match=message):
        cli.RunOptions(folder=tmp_path / "study", **options).run()
    assert not (tmp_path / "study").exists()


def test_results_of_another_schema_stop_the_run(tmp_path):
    """A folder whose results are of another schema is refused before cells are added to it."""
    (tmp_path / "results.csv").write_text("method,seed\n")
    with pytest.raises(RunError, match="another schema; missing: environment, hash"):
        cli.RunOptions(folder=tmp_path, file=SMALL).run()
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
    (cell,) = plan.expand(plan.read(SMALL), seeds=[7], methods=["p25"])
    values = {str: "x", int: 1, float: 0.5, bool: False, tuple: (), dict: {}, list: []}
    row = {name: values[kind] for name, kind in RESULT_COLUMNS.items()} | identity(cell) | change
    Results([row]).write(tmp_path)
    with pytest.raises(RunError, match=message):
        cli.RunOptions(folder=tmp_path, file=SMALL, methods=["p25"]).run()
    assert not (tmp_path / "cells").exists()


def test_a_policy_is_of_one_cell(tmp_path):
    """What names one cell twice, or a second cell of a policy, is refused before its cells are made."""
    text = SMALL.read_text()
    copy, edited, coarse = (tmp_path / f"{name}.toml" for name in ("copy", "edited", "coarse"))
    copy.write_text(text + text[text.index("[[environment]]") :].replace('"directional"', '"other"', 1))
    with pytest.raises(RunError, match="Environments directional, other have the same settings"):
        cli.RunOptions(folder=tmp_path / "a", file=copy).run()
    coarse.write_text(text + '[factors]\nenv.max_force = [1.0, 2.0]\n[design]\nkind = "sobol"\npoints = 4\n')
    with pytest.raises(RunError, match=r"Environments directional\.\d, directional\.\d have the same settings"):
        cli.RunOptions(folder=tmp_path / "a", file=coarse).run()
    assert not (tmp_path / "a").exists()
    study = StudyFolder(tmp_path / "b")
    study.add(plan.expand(plan.read(SMALL), seeds="1"))
    edited.write_text("audit_worlds = 50\n" + text)
    with pytest.raises(RunError, match="2 different cells of environment 'directional', method 'antagonist', seed 0"):
        cli.RunOptions(folder=study.path, file=edited).run()
    assert len(study.cells()) == 5


def test_what_was_edited_is_named(tmp_path):
    """Another setting of an environment that has cells is refused by the fields that differ."""
    study = StudyFolder(tmp_path / "study")
    study.add(plan.expand(plan.read(SMALL), seeds="1"))
    text = SMALL.read_text().replace("2000", "3000").replace("worlds = 200", "worlds = 9")
    (tmp_path / "edited.toml").write_text(text)
    differ = "eval.worlds was 200 and is 9, env_steps was 2000 and is 3000"
    with pytest.raises(RunError, match=f"'directional' were made with other settings .*: {differ}. Put them back"):
        cli.RunOptions(folder=study.path, file=tmp_path / "edited.toml").run()
    with pytest.raises(RunError, match="num_envs was 200 and is 100"):
        cli.RunOptions(folder=study.path, file=SMALL, num_envs=100).run()
    assert len(study.cells()) == 5


def test_attackers_that_cannot_be_made_stop_the_run(tmp_path):
    """Who needs a file that the cells do not have is refused before a cell is made, and before finished ones fail."""
    file = tmp_path / "study.toml"
    file.write_text(SMALL.read_text() + '[[attack]]\nattackers = ["pooled"]\n')
    message = "'directional' cannot be attacked: pool must be a file of deimos pool for the attacker pooled, got none"
    with pytest.raises(RunError, match=message):
        cli.RunOptions(folder=tmp_path / "a", file=file).run()
    assert not (tmp_path / "a").exists()
    study = StudyFolder(tmp_path / "b")
    study.add(plan.expand(plan.read(SMALL), seeds="1"))
    for cell in study.cells():
        (study.cell_path(cell) / "result.json").write_text("{}")
    with pytest.raises(RunError, match=message):
        cli.AttackOptions(folder=study.path, attackers=("pooled",), allow_uncommitted=True).run()
    assert not (study.path / "attack.json").exists()


def test_what_was_given_up_keeps_nobody_from_attacking(tmp_path, monkeypatch):
    """A cell that failed once is open; one that was given up has no policy, and those of the others are attacked."""
    study = StudyFolder(tmp_path)
    study.add(plan.expand(plan.read(SMALL), seeds="1", methods=["p25", "uniform"]))
    lost, kept = study.cells()
    RunFolder(study.cell_path(kept)).write_json("result.json", {"schema": SCHEMA, "rows": [], "curve": {}})
    begun = []
    monkeypatch.setattr(cli.AttackOptions, "_work", lambda self, study, *rest: begun.append(study.path))
    study.record_failure(lost, "it broke")
    attack = cli.AttackOptions(folder=study.path, attackers=("search",), allow_uncommitted=True)
    with pytest.raises(RunError, match="1 of 2 cells are not finished"):
        attack.run()
    study.record_failure(lost, "it broke again")
    attack.run()
    assert begun == [study.path]


@pytest.mark.parametrize("name", ["show", "export", "report"])
def test_empty_folder_is_refused(tmp_path, name):
    """There is nothing to show, export or report in an empty folder, and the line says so."""
    with pytest.raises(RunError, match="holds no "):
        cli.COMMANDS[name](folder=tmp_path).run()


def test_show_cuts_nothing(tmp_path, monkeypatch, capsys):
    """On 80 columns too names and numbers are whole, and a score that nobody has is a dash."""
    monkeypatch.setenv("COLUMNS", "80")
    values = {str: "x", int: 1, float: 0.5, bool: False, tuple: (), dict: {}, list: []}
    row = {name: values[kind] for name, kind in RESULT_COLUMNS.items()}
    long = {"environment": "an-environment-of-a-long-name", "method": "vds-auxiliary-of-a-long-name"}
    Results([row | long | {"score": float("nan"), "crashes_per_1000": 1234.0}]).write(tmp_path)
    cli.ShowOptions(folder=tmp_path).run()
    (line,) = [line for line in capsys.readouterr().out.splitlines() if long["environment"] in line]
    cells = [cell.strip() for cell in line.strip("│ ").split("│")]
    assert cells == [long["environment"], long["method"], "x", "1", "1", "1.23e+03", "-", "0.5000", "0"]


def test_progress_is_one_line():
    """The line of a study that runs says what is finished and failed, where each worker is, and how long it takes."""
    running = {"b": (0.5, 0.0), "c": (1.0, 0.25)}
    progress = Progress(5, 1, {"a": "it failed"}, running, share=0.6, seconds_left=90.0)
    assert cli._summary(progress) == "1 of 5 cells finished, 1 failed, b 50%, c evaluating 25%, 0:01:30 left"


def test_every_command_explains_itself():
    """Every command has options that say in a sentence what it is for, and a documented way to run it."""
    assert list(cli.COMMANDS) == ["run", "cell", "show", "attack", "pool", "pack", "unpack", "merge", "export",
                                  "report"]  # fmt: skip
    for options in cli.COMMANDS.values():
        assert options.__doc__.strip().endswith(".")
        assert options.run.__doc__
