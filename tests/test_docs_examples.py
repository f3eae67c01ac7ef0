"""Every example of every page runs: programs as they stand, commands on budgets of seconds.

A page is one session in an empty folder, from its first block to its last. A block whose first line is a comment with a
path is a file; a TOML block of an entry point installs the file beside it. Long commands are shortened in one place, by
``shortened``: sizes and budgets are replaced, everything else is what the page says. Pages of the lab are records of
what was measured, often over hours: of their scripts the syntax is checked, and that the programs are there.
"""

import importlib
import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

import deimos
from deimos import plugins
from deimos.app import cli
from deimos.run.evaluation import EvalConfig

HOME = Path(__file__).resolve().parent.parent
DOCS = HOME / "docs"
PAGES = [HOME / "README.md", HOME / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
PAGES = [page for page in PAGES if "```" in page.read_text(encoding="utf-8") and "results" not in page.parts]
LAB = [page for page in PAGES if page.parent.name == "lab" and "```sh" in page.read_text(encoding="utf-8")]
PAGES = [page for page in PAGES if page not in LAB]
LANGUAGES = {"python", "sh", "toml", "xml", "text", "{toctree}", "{eval-rst}"}

CRASHING = {
    "--num-envs": "256", "--env-steps": "96", "--env.max-speed": "200", "--env.max-force": "100",
    "--ppo.init-std": "100",
}  # fmt: skip
"""Of particles, so fast that there are crashes to learn from; some commands need a fear network."""
TRAINING = {
    "--num-envs": "16", "--env-steps": "48", "--env.goal-period": "5", "--eval.worlds": "8", "--eval.steps": "100",
    "--eval.adversary-steps": "20", "--threads": "1", "--device": "cpu",
}  # fmt: skip
BUDGETS = {
    "train": TRAINING,
    "resume": {"--env-steps": "192"},
    "evaluate": {"--worlds": "8", "--oracle-worlds": "4", "--calibration": "100", "--contexts": "2"},
    "study run": {"--methods": "uniform p25", "--num-envs": "16", "--env-steps": "48", "--threads": "1"},
    "play": {"--seconds": "0.2", "--fps": "10", "--width": "64", "--height": "48"},
    "view": {"--seconds": "0.2", "--attacker-worlds": "8", "--width": "64", "--height": "48"},
}
"""By command: what its options become. Those of ``evaluate`` only where the page gives them."""
SMALL = {
    "num_envs": 16, "env_steps": 48, "threads": 1,
    "eval": EvalConfig(worlds=8, steps=200, adversary_steps=20),
}  # fmt: skip
"""The same for ``deimos.TrainConfig(...)`` and ``deimos.preset(NAME, ...)`` in Python."""

STUDY_EVAL = "eval = { worlds = 8, steps = 200, adversary_steps = 20 }"
"""The same in a study's file."""

ELSEWHERE = {
    r"python3 -m venv |\. \.venv/|pip install .*pre-commit": "README's lines and lint are what .ci/run runs",
    r"pip install torch==": "it fetches from another host; no test does",
    r"deimos pool |.* --pool ": "tests/test_deimos_attackers.py, with policies that crash",
    r"python examples/\w+\.py$": "tests/test_examples.py",
    r"deimos shield ": "tests/test_deimos_shield.py, with policies that crash",
    r"deimos view .* --shield ": "tests/test_deimos_view.py, with a policy that crashes",
    r"deimos export docs/.* --check|python deploy/go1/|python examples/deploy/": "tests/test_deimos_export.py",
    r"pip install 'deimos-rl\[|ray start |.* --engine ray": ".ci/check_ray.py; Ray is in no environment of the tests",
    r"sbatch ": "tests/test_deimos_study_cluster.py, without Slurm",
    r"first=\$\(scontrol |srun torchrun ": "nowhere: it needs Slurm; torchrun is in tests/test_deimos_ranks.py",
    r"deimos doctor --gpu |deimos train --device cuda": "tests/test_deimos_doctor.py, on a CPU",
    r"reproduction/freeze ": "tests/test_reproduction_studies.py, in a repository of its own",
}
"""Commands that are run elsewhere, and where."""


@dataclass
class Block:
    """A fenced block of a page."""

    language: str
    text: str

    @property
    def path(self) -> str | None:
        """Where the block belongs, if it is a file."""
        first = re.match(r"(?:#|<!--) ([\w/]+\.(?:py|toml|xml))(?: -->)?\n", self.text)
        return first and first[1]


def blocks(page):
    """The blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = [Block(*match) for match in re.findall(r"^```(\S*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)]
    assert text.count("\n```") + text.startswith("```") == 2 * len(found), "a fence is not closed"
    return found


def commands(block):
    """The commands of a block, without comments."""
    text = block.text.replace("\\\n", " ")
    return [line for line in (re.sub(r"(^|\s+)#.*$", "", line).strip() for line in text.splitlines()) if line]


def shortened(arguments, budget, add=True):
    """A command line whose options are those of ``budget``; without ``add``, only where it has them already."""
    kept, given, i = [], set(), 0
    while i < len(arguments):
        if arguments[i] in budget:
            given.add(arguments[i])
            i += 1
            while i < len(arguments) and not arguments[i].startswith(("--", "env:", "selector:")):
                i += 1
        else:
            kept.append(arguments[i])
            i += 1
    return kept + [word for name in budget if add or name in given for word in [name, *budget[name].split()]]


class Session:
    """Runs the blocks of one page in a folder."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.runs = folder, 0
        self.monkeypatch = monkeypatch
        (folder / "reproduction").symlink_to(HOME / "reproduction")
        shutil.copytree(HOME / "examples", folder / "examples")
        self.write(
            Block("toml", (folder / "examples" / "study.toml").read_text(encoding="utf-8")), "examples/study.toml"
        )
        for name in ("quad_flat", "quad_rough_walk", "quad_arm_reach"):
            shutil.copytree(DOCS / "results" / name, folder / "docs" / "results" / name)
        self.keep_one_policy()
        monkeypatch.chdir(folder)
        monkeypatch.syspath_prepend(str(folder))

    def keep_one_policy(self):
        """Put the tables of the kept policies in the folder, and an archive of one of them."""
        for name in ("particle_a", "particle_b"):
            kept = shutil.ignore_patterns("policies.zip")
            shutil.copytree(DOCS / "results" / name, self.folder / "docs" / "results" / name, ignore=kept)
        part = Path("docs", "results", "particle_a", "policies.zip")
        with zipfile.ZipFile(HOME / part) as every, zipfile.ZipFile(self.folder / part, "w") as one:
            for name in every.namelist():
                if name.startswith("directional-uniform-s0-"):
                    one.writestr(name, every.read(name))

    def write(self, block, path=None):
        """Save a file; the evaluations of a study's are shortened."""
        path = self.folder / (path or block.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(re.sub(r"^eval = .*$", STUDY_EVAL, block.text, flags=re.MULTILINE), encoding="utf-8")
        importlib.invalidate_caches()

    def install(self, block):
        """Install the plug-in of a TOML block as another distribution."""
        (group, entries), *others = tomllib.loads(block.text)["project"]["entry-points"].items()
        assert not others
        information = self.folder / "page-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text("Metadata-Version: 2.1\nName: page\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(
            f"[{group}]\n" + "".join(f"{name} = {module}\n" for name, module in entries.items())
        )
        importlib.invalidate_caches()

    def python(self, block):
        """Run a program."""
        script = self.folder / "program.py"
        text = re.sub(r'deimos\.(TrainConfig\(|preset\("[\w-]+",)', r"deimos.\1 **SMALL, ", block.text)
        script.write_text(text, encoding="utf-8")
        runpy.run_path(str(script), init_globals={"SMALL": SMALL})

    def command(self, line):
        """Run a command; what is not there or fails, fails the test."""
        if any(re.match(pattern, line) for pattern in ELSEWHERE):
            return
        program, *arguments = shlex.split(line)
        if program == "pytest":
            self.pytest(arguments)
        elif program == "deimos":
            self.deimos(arguments)
        elif (program, arguments[0]) == ("python", "train.py"):
            self.deimos(["train", *arguments[1:]])
        elif program == "cp":
            self.process(program, *arguments)
        elif program == "torchrun":  # tests/test_deimos_ranks.py runs several; here it is one process
            self.deimos(["train", *arguments[arguments.index("train.py") + 1 :]])
        else:
            raise AssertionError(f"{line}: nothing runs this")

    def deimos(self, arguments):
        """Run ``deimos`` on a small budget."""
        name = "study run" if arguments[:2] == ["study", "run"] else arguments[0]
        if name == "train":
            if "--resume" in arguments:
                name = "resume"
            elif "--out" not in arguments:
                self.runs += 1
                arguments = [*arguments, "--out", f"runs/unnamed-{self.runs}"]
        if name == "study run":
            if "--file" not in arguments:  # the folder knows what it is
                name = "study"
            else:
                seeds = arguments[arguments.index("--seeds") + 1] if "--seeds" in arguments else "0"
                arguments = [*arguments, "--allow-uncommitted"]  # whatever this checkout holds
                arguments = shortened(arguments, {"--seeds": "{0}-{0}".format(*re.findall(r"\d+", seeds))})
        if arguments[:2] == ["study", "attack"]:
            arguments = [*arguments, "--allow-uncommitted"]
        if name in ("play", "robot", "view"):  # MuJoCo decides once in a process how it renders
            self.process(sys.executable, "-m", "deimos", *shortened(arguments, BUDGETS.get(name, {})))
            return
        budget = BUDGETS.get(name, {})
        if name == "train" and "--preset" not in arguments and "env:" not in " ".join(arguments):
            budget = budget | CRASHING
        arguments = shortened(arguments, budget, add=name != "evaluate")
        try:
            code = cli.main(arguments)
        except SystemExit as stop:
            code = stop.code
        assert not code, arguments

    def pytest(self, arguments):
        """Run tests of the repository that find what the page has written."""
        plugin = "import deimos.terrain.shapes\ndeimos.terrain.shapes.__path__.append('terrain/shapes')\n"
        plugin = plugin.replace("'terrain/shapes'", repr(str(self.folder / "terrain" / "shapes")))
        (self.folder / "of_the_page.py").write_text(plugin)
        done = self.process(
            sys.executable, "-m", "pytest", "-q", "-p", "of_the_page", "-p", "no:cacheprovider", *arguments, cwd=HOME
        )
        assert re.search(r"^[1-9]\d* passed", done, re.MULTILINE), done
        assert not re.search(r"failed|error|skipped", done.splitlines()[-1]), done

    def process(self, *command, cwd=None):
        """Run a program in a process of its own; returns what it printed."""
        path = os.pathsep.join([str(self.folder), str(Path(deimos.__file__).parent.parent)])  # that of this process
        done = subprocess.run(
            command, cwd=cwd or self.folder, env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, (command, done.stdout[-2000:], done.stderr[-2000:])
        return done.stdout


@pytest.fixture
def session(tmp_path, monkeypatch):
    """An empty session; modules that a page has written or registered are forgotten afterwards."""
    known = set(sys.modules)
    yield Session(tmp_path, monkeypatch)
    for name, module in list(sys.modules.items()):
        if name not in known and str(getattr(module, "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]
            for registered in plugins._registered.values():
                for plugin in [plugin for plugin, its_module in registered.items() if its_module == name]:
                    del registered[plugin]


@pytest.mark.parametrize("page", LAB, ids=lambda page: page.stem)
def test_scripts_of_the_lab_are_whole(page):
    """The shell understands what was measured, and the commands, modules and files that it names are there."""
    named = 0
    for block in blocks(page):
        if block.language == "sh":
            subprocess.run(["bash", "-n"], input=block.text, text=True, check=True)
            for command in re.findall(r"\bdeimos (\w+)", block.text):
                assert command in cli.COMMANDS, command
            for module in re.findall(r"-m ([\w.]+)", block.text):
                assert importlib.util.find_spec(module), module
            for script in re.findall(r"\bpython ([\w/]+\.py)", block.text):
                assert (HOME / script).is_file(), script
            named += len(re.findall(r"\bdeimos \w+|-m [\w.]+|\bpython ", block.text))
    assert named


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(HOME).as_posix())
def test_every_example_runs(page, session):
    """What the page shows works in the order in which it shows it."""
    found = blocks(page)
    assert {block.language for block in found} <= LANGUAGES
    for block in found:
        if block.path:
            session.write(block)
        elif block.language == "toml":
            session.install(block)
        elif block.language == "python":
            session.python(block)
        elif block.language == "sh":
            for line in commands(block):
                session.command(line)


def test_budgets_replace_what_a_page_gives():
    """Options of the budget take the place of the page's, wherever they stand; the others stay."""
    line = "train env:quad --num-envs 4096 selector:rnd --ppo.hidden 8 8 --env-steps 1".split()
    budget = {"--num-envs": "2", "--env-steps": "3", "--threads": "1"}
    expected = "train env:quad selector:rnd --ppo.hidden 8 8 --num-envs 2 --env-steps 3".split()
    assert shortened(line, budget, add=False) == expected
    assert shortened(line, budget) == [*expected, "--threads", "1"]


def test_a_broken_example_is_found(session, tmp_path):
    """A command with an option that is not there, and a program with a fault, fail."""
    for text in ("```sh\ndeimos evaluate --nonsense\n```\n", "```python\nimport nothing_of_that_name\n```\n"):
        page = tmp_path / "page.md"
        page.write_text(text)
        with pytest.raises((AssertionError, ModuleNotFoundError)):
            test_every_example_runs(page, session)


def test_what_the_first_page_offers_is_there():
    """The names that the reference of the public face lists are those of the package."""
    text = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    for name in set(deimos.__all__) - {"__version__"}:
        assert re.search(rf"\b{name}\b", text), name
