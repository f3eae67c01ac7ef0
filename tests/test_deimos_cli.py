"""The command line: what it explains, and what it refuses before anything is made."""

import ast
import dataclasses
import inspect
import re
import sys
from pathlib import Path

import pytest
import torch
from command_line import contents, refused

import deimos
from deimos import plugins
from deimos.app import cli
from deimos.goals import selectors
from deimos.goals.methods import METHODS, method
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.trainer import TrainConfig
from deimos.sim import envs
from deimos.sim.envs import particle

HOME = Path(deimos.__file__).resolve().parent.parent

TRAIN_ERRORS = {
    # what is asked for, and what the one line says
    "--env.variant cubic": "'cubic' .*'absolute', 'directional', 'relative'",
    "env:moon": "Unknown argument 'env:moon'; choose from: env:particle",
    "--method q33": f"Unknown method 'q33'; choose from: {re.escape(', '.join(METHODS))}",
    "--method=": f"Unknown method ''; choose from: {re.escape(', '.join(METHODS))}",
    "selector:nope": "Unknown argument 'selector:nope'; choose from: .*selector:director, .*selector:uniform",
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
    "--ppo.entropy-coef nan": r"entropy_coef must be in \[0, inf\), got nan",
    "--ppo.desired-kl inf": r"desired_kl must be in \[0, inf\), got inf",
    "--ppo.discount 1.01": r"discount must be in \[0, 1\], got 1.01",
    "--eval.worlds 0": "worlds must be at least 1, got 0",
    "--eval.steps 199": "eval.steps must be at least 2 T = 200, got 199",
    "selector:vds --selector.critics 0": "critics must be at least 1, got 0",
    "selector:vds --selector.data share --num-envs 9": "critics must be at most the 9 worlds that they share, got 10",
    "selector:director --selector.rule best": r"'best' .*'percentile', 'argmin', 'argmax'",
    "selector:director --selector.probe 1.1": r"probe must be in \[0, 1\], got 1.1",
    "selector:schedule --selector.at 1": r"at must be in \(0, 1\), or the schedule never switches; got 1.0",
    "selector:schedule --selector.first q33": "Unknown method 'q33'",
    "selector:cl --selector.threshold 1.2": r"threshold must be in \(0, 1\), got 1.2",
    "selector:grid --selector.threshold 0": r"threshold must be in \(0, 1\), got 0.0",
    "selector:plr --selector.fill 0": r"fill must be in \(0, 1\], got 0.0",
    "selector:learnability --selector.low 0.95": "low must be below high, got 0.95 and 0.9",
    "--device cuda": "There is no CUDA device here; use --device cpu",
    "--device tpu": "device must be auto, cpu, cuda or cuda:N, got 'tpu'",
    "--ppo.hidden 8 --seed 2 --ppo.hidden 9": "--ppo.hidden is given twice; give it once, with all its values",
    "--seed 3 --env.goal-period 5 --seed 4": "deimos: --seed is given twice; give it once.$",
    "--no-evaluation --env.goal_period 5 --evaluation": "deimos: --evaluation is given twice; give it once.$",
    "--num-envs=2 env:particle --num_envs=3 --bogus": "deimos: --num-envs is given twice; give it once.$",
    "--bogus host:1 --bogus-too host:2": "Unrecognized options: --bogus host:1 --bogus-too host:2.$",
    "env:particle --seed 3 env:quad": "deimos: env: is given twice; give it once.$",
    "env:particle --bogus 3 --bogus 4": "Unrecognized options: --bogus 3 --bogus 4",
    "--eval.attackers pooled --eval.pool none.pt": r"none.pt cannot be read \(No such file or directory\)",
    "--bogus 3": "Unrecognized options: --bogus",
    "bogus": "Unrecognized options: bogus",
    "--out there": "there exists and is not overwritten; choose another --out, or continue with --resume",
    "--out file": "file exists and is not overwritten",
    "--out file/run": r"file/run cannot be created \(Not a directory\)",
    "--resume nowhere": "nowhere is not a run folder: it holds no config.json",
    "--resume there": "there is not a run folder: it holds no config.json",
    "--resume file": "file is not a run folder",
    "--resume there --seed 3": "Unrecognized options: --seed",
    "--resume": "Missing value for argument '--resume'",
    "--init-from there": "there is not a run folder: it holds no config.json",
}
OTHER_ERRORS = {
    "frobnicate": "Unknown command 'frobnicate'; choose from: train, evaluate, pool, study, play, view, "
    "shield, export, robot, doctor, terrain",
    "--bogus": "Unknown command '--bogus'",
    "evaluate": "Missing from deimos evaluate: .*Folder of the run",
    "evaluate nowhere": "nowhere is not a run folder: it holds no config.json",
    "evaluate there": "there is not a run folder: it holds no config.json",
    "evaluate there --worlds many": r"deimos: --worlds: invalid literal for int\(\) with base 10: 'many'$",
    "evaluate there --attackers oracle --attackers search": "--attackers is given twice; give it once",
    "view there --shield maybe": "Unknown value 'maybe' for --shield; choose from: 'ignore', 'project', 'stop'.$",
    "terrain grid --difficulty 0.9": "deimos: --difficulty: input length 1 did not match .* 2 of `FLOAT FLOAT`$",
    "terrain grid --out=a.npz --levels 1 --out=b.npz": "--out is given twice",
    "doctor --device gpu": "device must be auto, cpu, cuda or cuda:N, got 'gpu'",
    "bench": "Unknown command 'bench'",
    "study walk": "Unknown command 'study walk'; choose from: run, cell, show, attack, pool, pack, unpack, merge, "
    "export, report",
    "terrain walk": "Unknown command 'terrain walk'; choose from: list, shape, grid",
}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with an empty folder ``there`` and a ``file``, on a machine without a GPU."""
    (tmp_path / "there").mkdir()
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return tmp_path


@pytest.mark.parametrize("arguments", TRAIN_ERRORS)
def test_training_refuses(here, capfd, monkeypatch, arguments):
    """What cannot be trained gets one line that names it, exit code 2, and no file or folder is made."""
    monkeypatch.setattr(training, "train", lambda *args: pytest.fail("trained all the same"))
    before = contents(here)
    assert re.search(TRAIN_ERRORS[arguments], refused(["train", *arguments.split()], capfd))
    assert contents(here) == before


def test_a_folder_that_exists_is_refused_before_the_work(here, capfd, monkeypatch):
    """Nothing is built, which takes minutes where robots are compiled, for a run whose folder is taken."""
    monkeypatch.setattr(training, "build", lambda *args: pytest.fail("built in vain"))
    assert "there exists and is not overwritten" in refused(["train", "--out", "there"], capfd)


def test_of_an_option_given_twice_the_last_counts(monkeypatch):
    """A single value may be given again, as scripts do to change one; its name alone decides, not that of a list."""
    parsed = []
    monkeypatch.setattr("deimos.app.train._train", parsed.append)
    assert cli.main("train --seed 3 --seed 4 --eval.attackers argmax".split()) == 0
    assert (parsed[0].seed, parsed[0].eval.attackers) == (4, ("argmax",))


@pytest.mark.parametrize("arguments", OTHER_ERRORS)
def test_other_commands_refuse(here, capfd, arguments):
    """So do the other commands, and unknown ones."""
    before = contents(here)
    assert re.search(OTHER_ERRORS[arguments], refused(arguments.split(), capfd))
    assert contents(here) == before


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
    "command",
    "evaluate,play,view,study,study run,study show,study attack,terrain,terrain grid,terrain list".split(","),
)
def test_other_commands_explain_themselves(capsys, command):
    """The other commands have a help too, in plain text."""
    shown = shown_help(command.split(), capsys)
    assert "--help" in shown
    assert "`" not in shown


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
