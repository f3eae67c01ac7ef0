"""The studies of the thesis, as files: what is in them, and that their cells are still those of the committed rows."""

import dataclasses
import itertools
import os
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from deimos.checks import RunError
from deimos.run import training
from deimos.run.config import kind, to_dict
from deimos.run.folder import RunFolder
from deimos.study import plan
from deimos.study.results import check_cells, check_comparable, identity
from deimos.study.rounds import rounds
from reproduction import legged_bases
from reproduction.thesis import DIRECTOR_METHODS, LEGGED_METHODS, PARTICLE_METHODS

PARTICLE_VARIANTS = ("directional", "relative", "absolute")

ROOT = Path(__file__).parent.parent
STUDIES = ROOT / "reproduction" / "studies"
FILES = {path.stem: path for path in [*STUDIES.glob("*.toml"), *(ROOT / "examples").glob("*.toml")]}
BLOCKS = {f"particle_{letter}": count for letter, count in zip("abcdef", (330, 90, 40, 40, 80, 80), strict=True)}
"""The blocks of the populations of Particle Gym, with their numbers of cells."""
BRANCHES = {"legged": (25, (100, 500)), "legged_long": (4, (100, 500)), "legged_warp": (4, (100,)),
            "legged_arm": (12, (100,))}  # fmt: skip
"""The populations of robots that branch off bases, with their numbers of cells and the T of their evaluations."""
MAP = {f"multiverse{part}": count for part, count in
       {"": 160, "_screening": 32, "_headroom": 1280, "_ours": 90, "_long": 12}.items()}  # fmt: skip
"""The studies of the map, with their numbers of cells before a command says which methods and setting they are for."""


@pytest.fixture
def pools(tmp_path, monkeypatch, new_plugins):
    """A working directory with the files that cells are made from."""
    folder = tmp_path / "reproduction" / "pool"
    folder.mkdir(parents=True)
    for name in PARTICLE_VARIANTS:
        (folder / f"{name}.pt").write_text(name)
    screened = tmp_path / "runs" / "multiverse_screening" / "pools"
    screened.mkdir(parents=True)
    for number in range(32):
        (screened / f"map.{number:02}.pt").write_text(str(number))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def bases(pools, tmp_path):
    """The same with the bases of robots as their script describes them, whose networks are a few bytes, and pools."""
    for robot, own in legged_bases.ROBOTS.items():
        for index in range(len(own.seeds)):
            name = legged_bases.base_name(robot, index)
            config = legged_bases.base_config(own, len(own.stages) - 1, index)
            config = dataclasses.replace(config, env=config.env.resolved(torch.device("cpu")))
            folder = RunFolder.create(tmp_path / "docs" / "results" / "legged" / name)
            folder.write_json("config.json", {"schema": training.SCHEMA, "config": to_dict(config)})
            (folder.path / "checkpoint.pt").write_text(name)
            (tmp_path / "reproduction" / "pool" / f"{name}.pt").write_text(name)


def test_every_study_of_the_thesis_is_there():
    """Particle Gym has its blocks and their base, the map its studies, each robot its study and its branches."""
    others = {"particle", "quad", "quad_arm", "population", "pilots", "study", "sweep"}
    assert set(FILES) == {*BLOCKS, *BRANCHES, *MAP} | others


@pytest.mark.parametrize("name", [name for name in FILES if not name.startswith(("quad", "legged"))])
def test_studies_of_particle_gym_expand(name, pools):
    """Every study of Particle Gym is a valid grid of different cells."""
    cells = plan.expand(plan.read(FILES[name]))
    assert len({cell.digest for cell in cells}) == len({cell.name for cell in cells}) == len(cells)
    assert len(cells) == (BLOCKS | MAP).get(name, len(cells))


def test_blocks_make_one_table(pools):
    """The cells of all blocks can be compared: an environment is one setting, and all meet the same attackers."""
    cells = [cell for name in BLOCKS for cell in plan.expand(plan.read(FILES[name]))]
    check_comparable(map(identity, cells))
    check_cells(map(identity, cells))
    assert {cell.config.eval.attackers for cell in cells} == {("argmax", "pooled", "scripted")}
    assert {cell.config.eval.pool.stem == cell.environment for cell in cells} == {True}
    for name in BLOCKS:
        (more,) = rounds(plan.read(FILES[name]))
        assert (more.attackers, more.seeds) == (("argmax-long", "search", "q-fear"), (0, 3, 6, 9))


@pytest.mark.parametrize("name", BRANCHES)
def test_branches_are_pairs(name, bases):
    """Every seed of a study of branches is a base of its robot, which its methods share, and all are one setting."""
    cells = plan.expand(plan.read(FILES[name]))
    count, periods = BRANCHES[name]
    assert len({cell.digest for cell in cells}) == len({cell.name for cell in cells}) == len(cells) == count
    check_comparable(map(identity, cells))
    assert {cell.goal_periods for cell in cells} == {periods}
    robot = "quad_arm" if name == "legged_arm" else "quad"
    for cell in cells:
        own = f"{robot}_base_{cell.config.seed}"
        assert (cell.branch_from.name, kind(cell.config.env).replace("-", "_")) == (own, robot)
        assert cell.config.eval.pool is None or cell.config.eval.pool.stem == own
        assert cell.config.critic_warmup == 10
    assert len({cell.block for cell in cells}) == len({cell.config.seed for cell in cells})
    transitions = {cell.config.num_envs * cell.config.env_steps for cell in cells}
    assert [round(x / 1e6, 1) for x in transitions] == [1.5 if robot == "quad_arm" else 2.0]


def test_branches_differ_in_what_they_are_about(bases):
    """Quad's studies differ by the T of the training and by the engine alone, and by the worlds of the evaluation."""
    quad, long, warp = (plan.expand(plan.read(FILES[name]))[0] for name in list(BRANCHES)[:3])
    assert (quad.config.env.goal_period, long.config.env.goal_period) == (100, 500)
    assert (quad.config.env.engine, warp.config.env.engine) == ("native", "warp")
    assert dataclasses.replace(long.config, env=quad.config.env) == quad.config
    assert dataclasses.replace(warp.config, env=quad.config.env, eval=quad.config.eval) == quad.config
    assert dataclasses.replace(long.config.env, goal_period=100) == quad.config.env
    assert {cell.environment for cell in (quad, long, warp)} == {"quad", "quad_long", "quad_warp"}


def test_bases_are_not_needed_to_have_their_studies(pools):
    """A study of branches whose bases are not trained yet is refused in one line that names what is missing."""
    with pytest.raises(RunError, match="quad_base_1"):
        plan.expand(plan.read(FILES["legged"]))


def test_the_map_tells_its_factors_apart(pools):
    """All 32 settings differ, no factor's levels follow from others', nor from the product of any two."""
    cells = plan.expand(plan.read(FILES["multiverse"]), methods=["uniform"])
    assert len({cell.setting for cell in cells}) == len({cell.environment for cell in cells}) == 32
    levels = {name: [*dict.fromkeys(cell.levels[name] for cell in cells)] for name in cells[0].levels}
    assert [len(own) for own in levels.values()] == [2] * 8
    columns = {name: np.array([2 * own.index(cell.levels[name]) - 1 for cell in cells]) for name, own in levels.items()}
    for name, column in columns.items():
        assert column.sum() == 0
        others = [columns[other] for other in columns if other != name]
        assert not any(column @ other for other in others)
        assert not any(column @ (a * b) for a, b in itertools.combinations(others, 2))


def test_the_map_is_what_its_plan_says(pools):
    """Goals follow from variant and speed, pools from the setting; screening, map and confirmation differ in seeds."""
    screening, cells = (plan.expand(plan.read(FILES[name])) for name in ("multiverse_screening", "multiverse"))
    ranges = {(cell.config.env.variant, cell.config.env.max_speed, cell.config.env.goal_range) for cell in cells}
    assert ranges == {
        ("directional", 10.0, 10.0), ("directional", 10.0, 15.0), ("directional", 5.0, 5.0), ("directional", 5.0, 7.5),
        *(("relative", speed, size) for speed in (5.0, 10.0) for size in (1250.0, 1875.0)),
    }  # fmt: skip
    assert {cell.config.eval.pool.stem == cell.environment for cell in cells} == {True}
    assert {cell.config.eval.attackers for cell in cells} == {("argmax", "pooled", "scripted")}
    seen = [(cell.levels["observations"], cell.config.env.obs_scale, cell.config.ppo.normalize_observations)
            for cell in screening]  # fmt: skip
    assert Counter(seen) == {("scaled", "unit", False): 16, ("raw", "raw", True): 16}
    learners = {(cell.levels["learner"], cell.config.ppo.hidden, cell.config.ppo.activation) for cell in screening}
    assert learners == {("tuned", (64, 64), "relu"), ("rsl_rl-like", (128, 128), "elu")}  # both factors say ppo
    assert {(cell.environment, cell.config.env, cell.config.ppo) for cell in screening} == {
        (cell.environment, cell.config.env, cell.config.ppo) for cell in cells
    }
    chosen = plan.expand(plan.read(FILES["multiverse_headroom"]), environments=["map.07"], methods=["uniform", "p75"])
    assert {cell.environment for cell in chosen} == {"map.07"}
    assert {cell.config.env for cell in chosen} == {cell.config.env for cell in cells if cell.environment == "map.07"}
    others = [plan.expand(plan.read(FILES[name])) for name in ("multiverse_ours", "multiverse_long", "particle_d")]
    seeds = [{cell.config.seed for cell in own} for own in (screening, cells, *others)]
    assert [len(own) for own in seeds] == [1, 1, 30, 3, 20]
    assert sum(map(len, seeds)) == len(set.union(*seeds))
    assert len({cell.config.seed for cell in chosen}) == 20
    assert {cell.config.env_steps for cell in others[1]} == {48_000}


def test_studies_are_the_thesis(pools):
    """Particle Gym has ten methods, ten seeds and 2000 or 5000 steps; the legged ones twelve, thirty and two T."""
    description = plan.read(FILES["particle_a"])
    cells = plan.expand(description)
    steps = {cell.environment: cell.config.env_steps for cell in cells}
    assert steps == {"directional": 2000, "relative": 2000, "absolute": 5000}
    assert {cell.config.num_envs for cell in cells} == {2000}
    assert {cell.config.seed for cell in cells} == set(range(10))
    names = {name.removesuffix("-literal") for name in description["methods"]}
    assert names == {*PARTICLE_METHODS, "learnability"}
    for cell in cells:  # as in the thesis, fear learns from the last 2 T steps alone
        assert getattr(cell.config.goals, "memory", 0) == 0 or cell.config.method in ("rnd", "vds", "learnability")
    assert (len(DIRECTOR_METHODS), len(PARTICLE_METHODS), len(LEGGED_METHODS)) == (7, 10, 12)
    for name in ("quad", "quad_arm"):
        description = plan.read(FILES[name])
        assert (description["seeds"], set(description["methods"])) == (30, set(LEGGED_METHODS))
        (environment,) = description["environment"]
        assert (environment["name"], environment["goal_periods"]) == (name, [100, 500])


PYTHON = """#!/usr/bin/env bash
[ "$*" = "-m venv .venv" ] && mkdir -p .venv/bin && printf '#!/bin/sh\\necho pip "$@" > asked\\n' > .venv/bin/pip \\
    && chmod +x .venv/bin/pip
"""


def test_frozen_commit_has_a_worktree_of_its_own(tmp_path):
    """The command makes a worktree of a commit, into which it installs that commit's own sources."""
    home, frozen, tools = (tmp_path / name for name in ("home", "frozen", "tools"))
    (home / "reproduction").mkdir(parents=True)
    tools.mkdir()
    (tools / "python3").write_text(PYTHON)
    (tools / "python3").chmod(0o755)
    script = home / "reproduction" / "freeze"
    script.write_bytes((ROOT / "reproduction" / "freeze").read_bytes())
    script.chmod(0o755)

    def git(*arguments):
        command = ["git", "-C", str(home), "-c", "user.name=x", "-c", "user.email=x@example.org", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    git("init", "-q")
    for text in ("one", "two"):
        (home / "source").write_text(text)
        git("add", "-A")
        git("commit", "-q", "-m", text)
    env = os.environ | {"PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"}
    command = [str(script), "HEAD~1", str(frozen)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    assert (frozen / "source").read_text() == "one"
    assert (frozen / "asked").read_text() == "pip install --quiet -c constraints.txt -e .[all]\n"
    assert done.stdout.splitlines()[-1].startswith(f"cd {frozen} && .venv/bin/deimos study run runs/particle_a --file ")
    wrong = subprocess.run(command[:2], env=env, capture_output=True, text=True, check=False)
    assert (wrong.returncode, wrong.stderr) == (2, "usage: reproduction/freeze COMMIT FOLDER\n")
