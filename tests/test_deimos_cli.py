"""The command line: what it explains, what it refuses, and what a whole run leaves behind."""

import ast
import dataclasses
import inspect
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

import deimos
from deimos import plugins
from deimos.app import cli
from deimos.goals import selectors
from deimos.goals.methods import METHODS, method
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.config import from_dict
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig
from deimos.sim import envs
from deimos.sim.envs import particle

HOME = Path(deimos.__file__).resolve().parent.parent

# A run of a second, evaluated in another.
TINY = (
    "--num-envs 32 --env-steps 48 --threads 1 --device cpu --env.goal-period 10 --ppo.hidden 16 16 --eval.worlds 32 "
    "--eval.steps 40 --eval.adversary-steps 20"
).split()

TRAIN_ERRORS = {
    # what is asked for, and what the one line says
    "--env.variant cubic": "'cubic' .*'absolute', 'directional', 'relative'",
    "env:moon": "There is no 'env:moon'; there are: env:particle",
    "--method q33": f"There is no method 'q33'; there are: {re.escape(', '.join(METHODS))}",
    "--method=": f"There is no method ''; there are: {re.escape(', '.join(METHODS))}",
    "selector:nope": "There is no 'selector:nope'; there are: .*selector:director, .*selector:uniform",
    "--method p25 selector:uniform": "method 'p25' and a selector cannot be combined",
    "selector:director --selector.percentile 100.5": r"percentile must be in \[0, 100\], got 100.5",
    "selector:director --selector.percentile -1": r"percentile must be in \[0, 100\], got -1.0",
    "selector:director --selector.percentile nan": r"percentile must be in \[0, 100\], got nan",
    "selector:director --selector.candidates 0": "candidates must be at least 1, got 0",
    "selector:director --selector.fear.hidden 0": r"hidden must be one or more positive layer sizes, got \(0,\)",
    "--num-envs 0": "num_envs must be at least 1, got 0",
    "--num-envs -3": "num_envs must be at least 1, got -3",
    "--num-envs 2147483648": r"num_envs must be below 2\^31, got 2147483648",
    "--num-envs 2.5": "--num-envs: .*'2.5'",
    "--num-envs": "Missing value for argument '--num-envs'",
    "--env-steps 0": "env_steps must be at least 1, got 0",
    "--env-steps -5": "env_steps must be at least 1, got -5",
    "--threads -1": r"threads must be in \[0, 4096\], got -1",
    "--threads 1000000": r"threads must be in \[0, 4096\], got 1000000",
    "--seed -1": r"seed must be in \[0, 2\^32\), got -1",
    "--seed 4294967296": r"seed must be in \[0, 2\^32\), got 4294967296",
    "--ppo.minibatches 0": "minibatches must be at least 1, got 0",
    "--ppo.num-steps -24": "num_steps must be at least 1, got -24",
    "--ppo.epochs 0": "epochs must be at least 1, got 0",
    "--ppo.hidden": "hidden must be one or more positive layer sizes",
    "--num-envs 1 --ppo.num-steps 2": "A rollout must hold ppo.minibatches = 4 transitions or more, got 2",
    "--env.goal-period 0": "goal_period must be at least 1, got 0",
    "--env.time-limit -1": "time_limit must be at least 0, got -1",
    "--env.max-speed nan": "max_speed must be finite and positive, got nan",
    "--env.max-speed inf": "max_speed must be finite and positive, got inf",
    "--env.max-force nan": "max_force must be positive, got nan",
    "--env.max-force 0": "max_force must be positive, got 0",
    "--env.spawn-range nan": "spawn_range must be in .*, got nan",
    "--env.spawn-range 1000": "spawn_range must be in .*, got 1000",
    "--env.goal-range 0": "goal_range must be finite and positive, got 0",
    "--env.goal-range nan": "goal_range must be finite and positive, got nan",
    "--ppo.learning-rate nan": "learning_rate must be finite and positive, got nan",
    "--ppo.learning-rate 0": "learning_rate must be finite and positive, got 0",
    "--ppo.entropy-coef nan": "entropy_coef must be .*, got nan",
    "--ppo.discount 1.01": r"discount must be in \[0, 1\], got 1.01",
    "--eval.worlds 0": "worlds must be at least 1, got 0",
    "--eval.steps 199": "eval.steps must be at least 2 T = 200, got 199",
    "selector:vds --selector.critics 0": "critics must be at least 1, got 0",
    "selector:vds --selector.data share --num-envs 9": "critics must be at most the 9 worlds that they share, got 10",
    "selector:director --selector.rule best": r"'best' .*'percentile', 'argmin', 'argmax'",
    "selector:director --selector.probe 1.1": r"probe must be in \[0, 1\], got 1.1",
    "selector:schedule --selector.at 1": r"at must be in \(0, 1\), or the schedule never switches; got 1.0",
    "selector:schedule --selector.first q33": "There is no method 'q33'",
    "selector:cl --selector.threshold 1.2": r"threshold must be in \(0, 1\), got 1.2",
    "selector:grid --selector.threshold 0": r"threshold must be in \(0, 1\), got 0.0",
    "selector:plr --selector.fill 0": r"fill must be in \(0, 1\], got 0.0",
    "selector:learnability --selector.low 0.95": "low must be below high, got 0.95 and 0.9",
    "--device cuda": "There is no CUDA device here; use --device cpu",
    "--device tpu": "device must be auto, cpu, cuda or cuda:N, got 'tpu'",
    "--bogus 3": "Unrecognized options: --bogus",
    "bogus": "Unrecognized options: bogus",
    "--out there": "there exists and is not overwritten; choose another --out, or continue with --resume",
    "--out file": "file exists and is not overwritten",
    "--out file/run": r"file/run cannot be made \(Not a directory\)",
    "--resume nowhere": "nowhere is not a run folder: it holds no config.json",
    "--resume there": "there is not a run folder: it holds no config.json",
    "--resume file": "file is not a run folder",
    "--resume there --seed 3": "Unrecognized options: --seed",
    "--resume": "Missing value for argument '--resume'",
    "--init-from there": "there is not a run folder: it holds no config.json",
}
OTHER_ERRORS = {
    "frobnicate": "There is no command 'frobnicate'; there are: train, evaluate, pool, study, play, view, "
    "shield, export, robot, doctor, terrain",
    "--bogus": "There is no command '--bogus'",
    "evaluate": "Missing from deimos evaluate: .*Folder of the run",
    "evaluate nowhere": "nowhere is not a run folder: it holds no config.json",
    "evaluate there": "there is not a run folder: it holds no config.json",
    "bench": "There is no command 'bench'",
    "study walk": "There is no command 'study walk'; there are: run, cell, show, attack, pool, pack, unpack, merge, "
    "export, report",
    "terrain walk": "There is no command 'terrain walk'; there are: list, shape, grid",
}


def refused(arguments, capfd):
    """Run a command that must fail; returns the one line that it says."""
    code = cli.main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    assert code == 2, err
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("deimos: ")
    assert "Traceback" not in err
    return err


def contents(path):
    """Every file below a folder with what it holds, and every folder."""
    return {file: file.read_bytes() if file.is_file() else None for file in sorted(path.rglob("*"))}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with an empty folder ``there`` and a ``file``, on a machine without a GPU."""
    (tmp_path / "there").mkdir()
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return tmp_path


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


@pytest.mark.parametrize("arguments", TRAIN_ERRORS)
def test_training_refuses(here, capfd, monkeypatch, arguments):
    """What cannot be trained gets one line that names it, exit code 2, and no file or folder is made."""
    monkeypatch.setattr(training, "train", lambda *args: pytest.fail("trained all the same"))
    before = contents(here)
    assert re.search(TRAIN_ERRORS[arguments], refused(["train", *arguments.split()], capfd))
    assert contents(here) == before


@pytest.mark.parametrize("arguments", OTHER_ERRORS)
def test_other_commands_refuse(here, capfd, arguments):
    """So do the other commands, and unknown ones."""
    before = contents(here)
    assert re.search(OTHER_ERRORS[arguments], refused(arguments.split(), capfd))
    assert contents(here) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--steps 19", "steps must be at least 2 T = 20, got 19"),
        ("--goal-period 21", "steps must be at least 2 T = 42, got 40"),
        ("--goal-period 0", "goal_period must be at least 1, got 0"),
        ("--worlds 0", "worlds must be at least 1, got 0"),
        ("--worlds many", "--worlds: .*'many'"),
        ("--seed -1", r"seed must be in \[0, .*, got -1"),
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


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_foreign_script_is_refused_without_a_warning(copied, capfd):
    """What torch has to say of a TorchScript file is not added to the one line."""
    write_script(copied / "checkpoint.pt")
    assert "checkpoint.pt is not a checkpoint" in refused(["train", "--resume", copied], capfd)


def test_init_from_refuses_a_broken_checkpoint(copied, here, capfd):
    """Weights are not taken from a broken checkpoint either, and the new run makes no folder."""
    cut(copied / "checkpoint.pt")
    message = refused(["train", *TINY, "--init-from", copied, "--out", "new"], capfd)
    assert "checkpoint.pt is not a checkpoint, or it is broken" in message
    assert not Path("new").exists()


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
    assert "The checkpoint is that of another environment or network size: " in message
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
    """An evaluation that could not be kept is not begun."""
    monkeypatch.setattr("deimos.run.evaluation.evaluate", lambda *args, **options: pytest.fail("evaluated in vain"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert refused(["evaluate", copied], capfd) == f"deimos: {copied} cannot be written to; evaluate a copy of it.\n"


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


@pytest.mark.parametrize(
    ("arguments", "package"),
    [
        (["terrain", "shape", "flat"], "trimesh"),
        (["play", str(HOME / "docs" / "results" / "quad_flat"), "--video", "x.mp4"], "mujoco"),
        (["train", "env:quad", "--num-envs", "1"], "mujoco"),
        (["train", "env:quad", "--num-envs", "1", "--device", "cpu", "--env.engine", "warp"], "mujoco_warp"),
    ],
)
def test_legged_robots_name_their_extra(here, capfd, monkeypatch, arguments, package):
    """Where an engine or trimesh is not installed, the one line names the extra of the legged robots."""
    monkeypatch.setitem(sys.modules, package, None)
    line = f"deimos: This needs {package}, which is not installed: pip install 'deimos-rl[legged]'\n"
    assert refused(arguments, capfd) == line


def test_other_versions_of_tyro_speak_for_themselves(monkeypatch, capfd):
    """Where tyro tells nothing of what is wrong, its own words stay, with the same exit code."""
    monkeypatch.setitem(sys.modules, "tyro._errors", None)
    assert cli.main(["terrain", "grid", "--levels", "three"]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert "'three'" in err


def test_version(capsys):
    """``deimos --version`` prints the version and nothing else."""
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr() == (f"{deimos.__version__}\n", "")


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_usage_lists_the_commands(capsys, arguments):
    """Without a command, the commands are listed."""
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert all(
        re.search(rf"^  {name} ", out, re.MULTILINE)
        for name in ("train", "evaluate", "study", "play", "view", "terrain")
    )


def described_fields(config, prefix=""):
    """Flags of a configuration with the docstrings below its fields, plugins apart."""
    classes = [kind for kind in type(config).__mro__ if dataclasses.is_dataclass(kind)]
    trees = [ast.parse(inspect.getsource(kind)).body[0] for kind in classes]
    texts = {
        field.target.id: " ".join(doc.value.value.replace("``", "").split())
        for tree in reversed(trees)
        for field, doc in zip(tree.body, tree.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr)
    }
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from described_fields(value, f"{prefix}{field.name}.")
        else:
            yield f"--{prefix}{field.name}".replace("_", "-"), texts[field.name]


def shown_help(arguments, capsys):
    """What a command says with --help, without frames and line breaks."""
    assert cli.main([*arguments, "--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return re.sub(r"[│\s]+", " ", out)


def test_help_explains_every_field(capsys):
    """``--help`` shows every field of the run, of its environment and of its learner, with its whole docstring."""
    shown = shown_help(["train"], capsys)
    described = dict(described_fields(TrainConfig()))
    assert described.pop("--selector")  # sub-commands, below
    assert {"--num-envs", "--method", "--env.goal-period", "--ppo.learning-rate", "--eval.fear.epochs"} <= set(
        described
    )
    for config, prefix in ((particle.Config(), "--env."), (PPOConfig(), "--ppo.")):
        names = {prefix + field.name.replace("_", "-") for field in dataclasses.fields(config)}
        assert names <= set(described)
    for flag, text in described.items():
        assert f" {flag} " in shown.replace(",", " "), flag
        assert text in shown, flag
    assert all(name in shown for name in ("selector:director", "selector:uniform", "--out", "--resume", "--init-from"))


def test_help_explains_a_selector(capsys):
    """``selector:director --help`` shows its fields."""
    shown = shown_help(["train", "selector:director"], capsys)
    for flag, text in described_fields(method("p25"), "selector."):
        assert f" {flag} " in shown.replace(",", " "), flag
        assert text in shown, flag


@pytest.mark.parametrize("command", ["train", "train env:quad selector:schedule", "study run", "terrain grid"])
def test_help_does_not_show_none(capsys, command):
    """An option that may be left out shows what it takes; what it is by default is in its text, and never None."""
    shown = shown_help(command.split(), capsys)
    assert not re.search(r"\bNone\b", shown)
    assert "(default: " in shown
    assert re.search(r" --(method|methods|preset|file) (\{\[)?(STR|PATH) ", shown)


def test_plugins_are_one_line_in_a_list():
    """What a selector or an environment is fits the list of them: one paragraph."""
    for package in (selectors, envs):
        for name, module in plugins.load_all(package).items():
            assert "\n\n" not in module.Config.__doc__.strip(), name


@pytest.mark.parametrize(
    "command", ["evaluate", "play", "view", "study", "study run", "study show", "terrain", "terrain grid"]
)
def test_other_commands_explain_themselves(capsys, command):
    """The other commands have a help too."""
    assert "--help" in shown_help(command.split(), capsys)


@pytest.mark.parametrize(
    "arguments",
    [
        "--num-envs 7 --env.variant relative selector:director --selector.percentile 60",
        "selector:director --num-envs 7 --selector.percentile 60 --env.variant relative",
        "selector:director --selector.percentile 60 --env.variant relative --num-envs 7",
        "env:particle --env.variant relative --num-envs 7 selector:director --selector.percentile 60",
        "--num-envs 7 env:particle selector:director --env.variant=relative --selector.percentile=60.0",
    ],
)
def test_flags_work_before_and_after_subcommands(monkeypatch, arguments):
    """The place of a flag does not matter."""
    parsed = []
    monkeypatch.setattr("deimos.app.train._train", parsed.append)
    assert cli.main(["train", *arguments.split()]) == 0
    (options,) = parsed
    assert options.num_envs == 7
    assert options.env == particle.Config(variant="relative")
    assert options.selector == dataclasses.replace(method("p25"), percentile=60.0)
    assert options.out is options.resume is options.init_from is None


def test_every_method_is_accepted(monkeypatch):
    """Every name of the table of methods is a value of --method, and is what chooses the goals."""
    parsed = []
    monkeypatch.setattr("deimos.app.train._train", parsed.append)
    for name in METHODS:
        assert cli.main(["train", "--method", name]) == 0
        assert (parsed[-1].label, parsed[-1].goals) == (name, method(name))


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


def test_default_folder_is_named_after_the_run(here, capsys):
    """Without --out a run goes to runs/ENV-METHOD-sSEED-TIME."""
    flags = "--no-evaluation --num-envs 4 --env-steps 1 --threads 1 --device cpu --seed 12 --method antagonist".split()
    assert cli.main(["train", *flags]) == 0
    (path,) = (here / "runs").iterdir()
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


def test_interrupt_at_the_last_iteration_skips_the_evaluation(here, monkeypatch, capsys):
    """Ctrl-C in the last iteration stops the run too: nobody has to wait for an evaluation that he does not want."""
    iterate = training.Trainer.iterate

    def interrupted(trainer):
        row = iterate(trainer)
        os.kill(os.getpid(), 2)
        return row

    monkeypatch.setattr(training.Trainer, "iterate", interrupted)
    monkeypatch.setattr("deimos.run.evaluation.evaluate", lambda *args, **options: pytest.fail("evaluated"))
    once = [argument if argument != "48" else "24" for argument in TINY]
    assert cli.main(["train", *once, "--out", "run"]) == 130
    assert "resume with --resume run" in capsys.readouterr().err
    assert Path("run/checkpoint.pt").exists()
