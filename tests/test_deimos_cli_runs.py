"""The command line on the folder of a run: what a whole run leaves there, and what a broken one is refused for."""

import os
import pickle
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from command_line import contents, refused

import deimos
from deimos.app import cli
from deimos.checks import RunError
from deimos.run import training
from deimos.run.config import from_dict
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig

HOME = Path(deimos.__file__).resolve().parent.parent

# A run of a second, evaluated in another.
TINY = (
    "--num-envs 32 --env-steps 48 --threads 1 --device cpu --env.goal-period 10 --ppo.hidden 16 16 --eval.worlds 32 "
    "--eval.steps 40 --eval.adversary-steps 20"
).split()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder of a run that was trained and evaluated, and what it printed."""
    path = tmp_path_factory.mktemp("cli") / "finished"
    command = [sys.executable, HOME / "train.py", *TINY, "--method", "p50", "--out", path]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=path.parent, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "Warp" not in done.stderr
    return path, done.stdout


@pytest.fixture
def copied(finished, tmp_path):
    """A copy of the finished run, to be damaged."""
    return Path(shutil.copytree(finished[0], tmp_path / "run"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--steps 19", "steps must be at least 2 T = 20, got 19"),
        ("--goal-period 21", "steps must be at least 2 T = 42, got 40"),
        ("--goal-period 0", "goal_period must be at least 1, got 0"),
        ("--worlds 0", "worlds must be at least 1, got 0"),
        ("--worlds many", "--worlds: .*'many'"),
        ("--seed -1", r"seed must be in \[0, .*, got -1"),
        ("--pool pool.pt", "pool is the file of the attacker pooled; add --attackers pooled"),
        ("--oracle-worlds 3 --attackers search", "oracle_worlds are those of the attacker oracle; add --attackers"),
        ("--contexts -1", "contexts must be at least 0, got -1"),
        (
            "--contexts 5 --worlds 3",
            "contexts evaluates the fear network .* cannot be combined with worlds",
        ),
    ],
)
def test_evaluation_refuses(copied, capfd, arguments, message):
    """What a run cannot be evaluated with is refused, and its folder stays as it was."""
    before = contents(copied)
    assert re.search(message, refused(["evaluate", copied, *arguments.split()], capfd))
    assert contents(copied) == before


def cut(path):
    """Keep the first half."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_last_byte(path):
    """Keep all but the last byte."""
    path.write_bytes(path.read_bytes()[:-1])


def flip_a_bit(path):
    """Change one bit in the middle of the largest tensor."""
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda info: info.file_size)
        with archive.open(largest) as file:
            content = file.read()
    data = bytearray(path.read_bytes())
    data[data.find(content) + len(content) // 2] ^= 1
    path.write_bytes(data)


def empty(path):
    """Nothing at all."""
    path.write_bytes(b"")


def write_text(path):
    """Somebody's notes."""
    path.write_text("not a checkpoint\n" * 100)


def write_pickle(path):
    """Somebody's pickle."""
    path.write_bytes(pickle.dumps({"schema": 1, "path": path}))


def write_zip(path):
    """Somebody's zip."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme", "nothing")


def write_script(path):
    """Somebody's TorchScript, over which torch would warn."""
    torch.jit.save(torch.jit.trace(torch.nn.Linear(2, 2), torch.zeros(1, 2)), path)


def write_objects(path):
    """A torch file with more in it than tensors."""
    torch.save({"schema": 1, "path": path}, path)


def write_tensors(path):
    """Somebody's checkpoint."""
    torch.save({"model": {"weight": torch.zeros(3)}, "schema": torch.zeros(2)}, path)


def write_next_schema(path):
    """A checkpoint of a later version."""
    torch.save(torch.load(path) | {"schema": 99}, path)


BREAKERS = [
    cut, cut_last_byte, flip_a_bit, empty, write_text, write_pickle, write_zip, write_objects, write_tensors,
    write_next_schema,
]  # fmt: skip


@pytest.mark.parametrize("break_file", BREAKERS)
@pytest.mark.parametrize("name", ["checkpoint", "policy"])
def test_broken_file_is_refused(copied, capfd, name, break_file):
    """A truncated, damaged or foreign checkpoint or policy is named and refused, and nothing else changes."""
    path = copied / f"{name}.pt"
    break_file(path)
    before = contents(copied)
    command = ["train", "--resume", copied] if name == "checkpoint" else ["evaluate", copied]
    message = refused(command, capfd)
    assert f"{path} is not a {name}" in message
    assert "weights_only" not in message  # torch's advice is to run what is in the file
    assert contents(copied) == before


@pytest.mark.filterwarnings("ignore:.*torch.jit")
def test_foreign_script_is_refused_without_a_warning(copied, capfd):
    """What torch has to say of a TorchScript file is not added to the one line."""
    write_script(copied / "checkpoint.pt")
    assert "checkpoint.pt is not a checkpoint" in refused(["train", "--resume", copied], capfd)


def test_init_from_refuses_a_broken_checkpoint(copied, tmp_path, capfd):
    """Weights are not taken from a broken checkpoint either, and the new run makes no folder."""
    new = tmp_path / "new"
    cut(copied / "checkpoint.pt")
    message = refused(["train", *TINY, "--init-from", copied, "--out", new], capfd)
    assert "checkpoint.pt is not a checkpoint, or it is broken" in message
    assert not new.exists()


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("ppo", {"hidden": [16, 17]}),
        ("ppo", {"hidden": [16]}),
        ("selector", {"kind": "director", "fear": {"hidden": [8]}}),
        (None, {"num_envs": 33}),
    ],
)
def test_checkpoint_of_another_size_is_refused(copied, capfd, part, change):
    """A checkpoint that does not fit its configuration is refused, and nothing changes."""
    folder = RunFolder(copied)
    data = folder.read_json("config.json")
    if part == "selector":
        data["config"]["method"] = None
        data["config"][part] = change
    else:
        (data["config"][part] if part else data["config"]).update(change)
    folder.write_json("config.json", data)
    before = contents(copied)
    message = refused(["train", "--resume", copied], capfd)
    assert "The checkpoint belongs to another environment or network size: " in message
    assert contents(copied) == before


@pytest.mark.parametrize(
    "text",
    ["", "no json", "[]", "{}", '{"schema": 2}', '{"schema": 1}', '{"schema": 1, "config": {"sed": 3}}',
     '{"schema": 1, "config": {"env": {"kind": "moon"}}}', '{"schema": 1, "config": {"num_envs": -1}}',
     '{"schema": 1, "config": {"ppo": {"hidden": 64}}}', '{"schema": 1, "config": null}'],
)  # fmt: skip
def test_broken_configuration_is_refused(copied, capfd, text):
    """A config.json that describes no run is named and refused, by --resume and by evaluate."""
    (copied / "config.json").write_text(text)
    before = contents(copied)
    for command in (["train", "--resume"], ["evaluate"]):
        assert f"{copied / 'config.json'} " in refused([*command, copied], capfd)
    assert contents(copied) == before


def test_evaluation_of_a_run_without_policy_is_refused(copied, capfd):
    """A run that was killed before its first checkpoint has no policy to evaluate."""
    (copied / "policy.pt").unlink()
    assert f"There is no policy at {copied / 'policy.pt'}." in refused(["evaluate", copied], capfd)


def test_a_folder_that_cannot_be_written_to_is_refused_before_the_work(copied, capfd, monkeypatch):
    """An evaluation, or a shield, that could not be kept is not begun, neither by a command nor by a program."""
    for name in ("evaluation.evaluate", "shield.Trial"):
        monkeypatch.setattr(f"deimos.run.{name}", lambda *args, **options: pytest.fail("worked in vain"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    said = f"{copied} cannot be written to; work on a copy of it."
    for command in (["evaluate", copied], ["evaluate", copied, "--contexts", "1"], ["shield", copied]):
        assert refused(command, capfd) == f"deimos: {said}\n"
    with pytest.raises(RunError, match=re.escape(said)):
        deimos.evaluate(copied)


def test_broken_evaluation_is_refused_before_the_work(copied, capfd, monkeypatch):
    """An evaluation.json that cannot be added to is refused before anything is computed, and stays as it is."""
    monkeypatch.setattr("deimos.run.evaluation.evaluate", lambda *args, **options: pytest.fail("evaluated in vain"))
    (copied / "evaluation.json").write_text("{")
    assert "evaluation.json cannot be read" in refused(["evaluate", copied], capfd)
    assert (copied / "evaluation.json").read_text() == "{"


@pytest.mark.parametrize("arguments", [["--device", "cuda"], ["--resume"], ["--num-envs", "0"]])
def test_true_process_says_one_line(copied, arguments):
    """From outside, a refused run is exit code 2 and exactly one line on stderr, with nothing of Warp's or torch's."""
    cut(copied / "checkpoint.pt")
    arguments = [*arguments, copied] if arguments == ["--resume"] else arguments
    before = contents(copied.parent)
    done = subprocess.run(
        [sys.executable, HOME / "train.py", *arguments],
        cwd=copied.parent,
        env=os.environ | {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert re.fullmatch(r"deimos: [^\n]+\n", done.stderr), done.stderr
    assert "---" not in done.stderr  # what is left of a frame where there is no UTF-8
    assert done.stdout == ""
    assert contents(copied.parent) == before


def test_run_leaves_its_files(finished):
    """A run ends with all its files, and its folder is the last line on stdout, below the table."""
    path, out = finished
    names = {file.name for file in path.iterdir()}
    events = {name for name in names if name.startswith("events.out.tfevents.")}
    assert len(events) == 1
    assert names - events == {
        "config.json", "progress.csv", "timing.csv", "checkpoint.pt", "policy.pt", "evaluation.json", "summary.png",
        "lock", "evaluation.json.lock",
    }  # fmt: skip
    assert out.splitlines()[-1] == str(path)
    assert re.search(r"uniform goals +attacked by +attacked by\n +\(Naive\) +argmax +scripted\n", out)
    assert re.search(r"\n\nUnder uniform goals .* of the goals end in a crash; argmax .*; scripted .*\n", out)
    assert re.match(r"Training took \d+\.\d s: env \d+%, policy .*\.\nEvaluation: ", out)
    assert (path / "summary.png").read_bytes().startswith(b"\x89PNG")
    folder = RunFolder(path)
    assert [row["iteration"] for row in folder.read_csv("progress.csv")] == ["1", "2"]
    assert [row["iteration"] for row in folder.read_csv("timing.csv")] == ["1", "2"]
    data = folder.read_json("config.json")
    assert data["schema"] == 1
    assert {"deimos", "commit", "torch", "warp-lang", "numpy", "python"} <= set(data["versions"])
    config = from_dict(TrainConfig, data["config"])
    assert (config.method, config.num_envs, config.env.goal_period, config.eval.worlds) == ("p50", 32, 10, 32)
    assert deimos.load_policy(path).hidden == (16, 16)
    assert [row["goals"] for row in folder.read_json("evaluation.json")] == ["naive", "argmax", "scripted"]


def test_progress_holds_no_time(finished):
    """No column of progress.csv depends on how fast the machine is; timing.csv has those."""
    folder = RunFolder(finished[0])
    assert not {"fps", "seconds", "time"} & set(folder.read_csv("progress.csv")[0])
    assert {"iteration", "fps", "env", "policy", "update", "selector"} <= set(folder.read_csv("timing.csv")[0])


def test_evaluating_again_adds_and_never_duplicates(copied, capsys):
    """The same evaluation gives the same rows in the place of the old ones; another one is added to them."""
    keep = ("config.json", "progress.csv", "timing.csv", "checkpoint.pt", "policy.pt")
    before = {name: (copied / name).read_bytes() for name in keep}
    first = RunFolder(copied).read_json("evaluation.json")

    assert cli.main(["evaluate", str(copied)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(copied)
    assert RunFolder(copied).read_json("evaluation.json") == first

    assert cli.main(["evaluate", str(copied), "--goal-period", "5"]) == 0
    second = RunFolder(copied).read_json("evaluation.json")
    assert second[:3] == first
    goals = [(row["goals"], row["goal_period"]) for row in second[3:]]
    assert goals == [("naive", 5), ("argmax", 5), ("scripted", 5)]

    assert cli.main(["evaluate", str(copied)]) == 0
    third = RunFolder(copied).read_json("evaluation.json")
    assert len(third) == 6
    assert all(row in third for row in second)
    assert {name: (copied / name).read_bytes() for name in keep} == before
    assert not list(copied.glob("*.partial"))


def test_default_folder_is_named_after_the_run(tmp_path, monkeypatch, capsys):
    """Without --out a run goes to runs/ENV-METHOD-sSEED-TIME."""
    monkeypatch.chdir(tmp_path)
    flags = "--no-evaluation --num-envs 4 --env-steps 1 --threads 1 --device cpu --seed 12 --method antagonist".split()
    assert cli.main(["train", *flags]) == 0
    (path,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(r"particle-antagonist-s12-\d{8}-\d{6}", path.name)
    assert capsys.readouterr().out.splitlines()[-1] == f"runs/{path.name}"
    assert (path / "summary.png").exists()
    assert not (path / "evaluation.json").exists()


def test_interrupt_during_the_evaluation_is_one_line(copied, monkeypatch, capfd):
    """Ctrl-C in the evaluation ends with one line and exit code 130; the run is whole."""

    def interrupt(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("deimos.run.evaluation.evaluate", interrupt)
    before = contents(copied)
    assert cli.main(["evaluate", str(copied)]) == 130
    err = capfd.readouterr().err
    assert err.splitlines()[-1].startswith("deimos: Interrupted")
    assert "Traceback" not in err
    assert contents(copied) == before


def test_interrupt_at_the_last_iteration_skips_the_evaluation(tmp_path, monkeypatch, capsys):
    """Ctrl-C in the last iteration stops the run too: nobody has to wait for an evaluation that he does not want."""
    iterate, path = training.Trainer.iterate, tmp_path / "run"

    def interrupted(trainer):
        row = iterate(trainer)
        os.kill(os.getpid(), 2)
        return row

    monkeypatch.setattr(training.Trainer, "iterate", interrupted)
    monkeypatch.setattr("deimos.run.evaluation.evaluate", lambda *args, **options: pytest.fail("evaluated"))
    once = [argument if argument != "48" else "24" for argument in TINY]
    assert cli.main(["train", *once, "--out", str(path)]) == 130
    assert f"resume with --resume {path}" in capsys.readouterr().err
    assert (path / "checkpoint.pt").exists()
