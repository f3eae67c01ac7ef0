"""The grid of a study: its cells, what fixes them, and what is refused before anything runs."""

import dataclasses
import json
import re

import pytest

from deimos.checks import RunError
from deimos.goals.methods import METHODS
from deimos.run.presets import preset as training_preset
from deimos.run.trainer import TrainConfig
from deimos.study import plan

TOML = """
seeds = [3, 5]
methods = ["uniform", "p25"]
[train]
num_envs = 64
ppo = { hidden = [16, 16] }
[[environment]]
name = "near"
env = { kind = "particle", variant = "directional" }
goal_periods = [50, 100]
[[environment]]
name = "far"
env = { kind = "particle", variant = "absolute" }
methods = ["coop"]
train = { env_steps = 500, ppo = { epochs = 2 } }
"""


def described(tmp_path, text):
    """The description in a TOML text."""
    path = tmp_path / "study.toml"
    path.write_text(text)
    return plan.read(path)


def test_file_becomes_a_grid(tmp_path):
    """A file gives every combination, seed by seed, with the fields of the study under those of the environment."""
    cells = plan.expand(described(tmp_path, TOML))
    found = [(cell.environment, cell.config.method, cell.config.seed) for cell in cells]
    assert found == [
        (name, method, seed)
        for seed in (3, 5)
        for name, method in (("near", "uniform"), ("near", "p25"), ("far", "coop"))
    ]
    near, far = cells[0], cells[2]
    assert (near.config.num_envs, near.config.env_steps, near.goal_periods) == (64, TrainConfig().env_steps, (50, 100))
    assert (far.config.env_steps, far.config.ppo.epochs, far.config.ppo.hidden) == (500, 2, (16, 16))
    assert far.goal_periods == (far.config.env.goal_period,)
    assert all(cell.config.threads == 1 for cell in cells)


def test_an_editors_mark_is_no_mistake(tmp_path):
    """A file that an editor has marked as UTF-8 says the same."""
    (tmp_path / "marked.toml").write_text("\ufeff" + TOML, encoding="utf-8")
    assert plan.read(tmp_path / "marked.toml") == described(tmp_path, TOML)


def test_choices_come_before_the_file(tmp_path):
    """Seeds, methods, environments and budgets of the command line replace those of the file."""
    cells = plan.expand(
        described(tmp_path, TOML), seeds=[9], methods=["rnd"], environments=["far"], train={"env_steps": 77}
    )
    assert [(cell.environment, cell.config.method, cell.config.seed) for cell in cells] == [("far", "rnd", 9)]
    assert cells[0].config.env_steps == 77


def test_file_extends_another(tmp_path):
    """What a file does not say comes from the one that it names as its base, and that one's base."""
    (tmp_path / "first.toml").write_text(TOML)
    (tmp_path / "second.toml").write_text('base = "first.toml"\nmethods = ["rnd"]\n')
    cells = plan.expand(described(tmp_path, 'base = "second.toml"\nseeds = 1\n'))
    found = [(cell.environment, cell.config.method, cell.config.seed) for cell in cells]
    assert found == [("near", "rnd", 0), ("far", "coop", 0)]


def test_any_percentile_can_be_asked_for(tmp_path):
    """Whatever ``method`` knows by name is a method of a study."""
    names = ["p25", "vds+p75", "learnability"]
    text = TOML.replace('"uniform", "p25"', ", ".join(f'"{name}"' for name in names))
    cells = plan.expand(described(tmp_path, text), seeds=[0], environments=["near"])
    assert [cell.config.method for cell in cells] == names


def test_environment_takes_a_training_preset(tmp_path):
    """An environment may name a preset of the training; what the study says itself comes before it."""
    flat = '[[environment]]\nname = "quad"\npreset = "quad-large"\n'
    (cell,) = plan.expand(described(tmp_path, flat), seeds=[2], methods=["p25"])
    base = training_preset("quad-large")
    assert cell.config == dataclasses.replace(base, method="p25", seed=2, threads=1)
    toml = """
[[environment]]
name = "hills"
preset = "quad"
env = { terrain = "rough" }
methods = ["vds"]
train = { num_envs = 8, ppo = { epochs = 2 } }
"""
    (cell,) = plan.expand(described(tmp_path, toml), seeds=[0])
    base = training_preset("quad")
    assert cell.config.env == dataclasses.replace(base.env, terrain="rough")
    assert cell.config.ppo == dataclasses.replace(base.ppo, epochs=2)
    assert (cell.config.num_envs, cell.config.eval) == (8, base.eval)
    with pytest.raises(RunError, match=r"preset must be a text, got 3"):
        plan.expand(described(tmp_path, toml.replace('"quad"', "3")))
    other = toml.replace("{ terrain", '{ kind = "particle", terrain')
    with pytest.raises(RunError, match=r"Environment 'hills': preset 'quad' is for quad, not for particle"):
        plan.expand(described(tmp_path, other))
    with pytest.raises(RunError, match=r"Environment 'hills': Unknown preset 'quat'; choose from: .*quad"):
        plan.expand(described(tmp_path, toml.replace('"quad"', '"quat"')))


def test_digest_is_a_function_of_all_that_matters():
    """Another seed, method, budget, evaluation or T is another cell, and another setting but for seed and method."""
    config = TrainConfig(method="p25", threads=1)
    cell = plan.Cell(environment="directional", config=config, goal_periods=(100,))
    same = plan.Cell(environment="directional", config=TrainConfig(method="p25", threads=1), goal_periods=(100,))
    assert (cell.digest, cell.setting, cell.selector, cell.name) == (
        same.digest, same.setting, same.selector, same.name,
    )  # fmt: skip
    for shares, change in (
        (("setting", "selector"), {"seed": 1}),
        (("setting",), {"method": "p50"}),
        (("selector",), {"env_steps": 4000}),
        (("selector",), {"eval": dataclasses.replace(config.eval, steps=1000)}),
    ):
        other = dataclasses.replace(cell, config=dataclasses.replace(config, **change))
        assert other.digest != cell.digest
        assert (other.setting == cell.setting) == ("setting" in shares)
        assert (other.selector == cell.selector) == ("selector" in shares)
    assert dataclasses.replace(cell, goal_periods=(50, 100)).setting != cell.setting


@pytest.mark.parametrize("name", ["p75", "vds+p75"])
def test_digests_know_what_a_method_stands_for(name, monkeypatch):
    """Another configuration behind a method's name is another selector and cell, also where a schedule names it."""
    cell = plan.Cell(environment="x", config=TrainConfig(method=name, threads=1), goal_periods=(100,))
    before = cell.selector, cell.digest, cell.setting
    monkeypatch.setitem(METHODS, "p75", ("director", {"percentile": 74}))
    cell = dataclasses.replace(cell)
    assert [new == old for new, old in zip((cell.selector, cell.digest, cell.setting), before, strict=True)] == [
        False, False, True,
    ]  # fmt: skip


def test_cell_survives_its_file(tmp_path):
    """A cell that is written and read is the same one."""
    cell = plan.Cell(environment="x", config=TrainConfig(method="vds+p75", seed=3), goal_periods=(20, 100))
    (tmp_path / "cell.json").write_text(json.dumps(cell.to_dict()))
    assert plan.read_cell(tmp_path / "cell.json") == cell
    for schema, way in ((99, r"\)\."), (1, "; deimos study report and merge still read its tables")):
        (tmp_path / "cell.json").write_text(json.dumps({"schema": schema}))
        with pytest.raises(RunError, match=f"its schema is {schema}, not 2{way}"):
            plan.read_cell(tmp_path / "cell.json")


ERRORS = {
    # what is said in the file, and the one line that refuses it
    TOML.replace('"uniform", "p25"', '"uniform", "q33"'): "Unknown method 'q33'; choose from: uniform, coop",
    TOML.replace('"uniform", "p25"', '"uniform", "uniform"'): "Every method must be given once; repeated: uniform",
    TOML.replace("[3, 5]", "[3, 3]"): "Every seed must be given once; repeated: 3",
    TOML.replace("[3, 5]", "0"): "seeds must be a number of seeds, .* or a list like 0,3,5, got 0",
    TOML.replace("[3, 5]", "[-1]"): r"seeds must be .* got \[-1\]",
    TOML.replace("[3, 5]", "[4294967296]"): r"seed must be in \[0, 2\^32\), got 4294967296",
    TOML.replace('"far"', '"near"'): "Every environment must be given once; repeated: near",
    TOML.replace('"far"', '"../far"'): r"must have a name of letters, digits, '\.' and '_', got '\.\./far'",
    TOML.replace(
        '"particle", variant = "absolute"', '"hexapod"'
    ): "'far': deimos.sim.envs has no 'hexapod'; it has: particle",
    TOML.replace('variant = "absolute"', 'variant = "cubic"'): "'far': variant must be one of",
    TOML.replace('variant = "absolute"', "friction = 1"): "'far': .*Config has no friction; it has: ",
    TOML.replace("num_envs = 64", "num_worlds = 64"): "TrainConfig has no num_worlds; it has: ",
    TOML.replace("num_envs = 64", "seed = 64"): "seed cannot be in 'train' or be a factor: the grid",
    TOML.replace("num_envs = 64", "num_envs = 0"): "num_envs must be at least 1, got 0",
    TOML.replace("[50, 100]", "[50, 5000]"): "eval.steps must be at least 2 T = 10000, got 2000",
    TOML.replace("[50, 100]", "[50, 50]"): r"goal_periods must be one or more different numbers, got \(50, 50\)",
    TOML.replace("seeds", "seed"): "A study has no seed; it has: attack, audit_worlds, base, branch_from, design",
    TOML.replace("goal_periods", "periods"): r"An \[\[environment\]\] has no periods; it has: audit_worlds",
    "seeds = 3": r"A study must have an \[\[environment\]\]",
    'base = "huge.toml"': r"huge\.toml is not a study's TOML file",
    'base = "study.toml"': r"study\.toml is a base of itself",
    "base = 3": r"study\.toml: base must be a text, got 3",
    TOML.replace("[3, 5]", "1000000000000"): "seeds must be at most 100000 in number, got 1000000000000",
    TOML.replace("[3, 5]", '"0-1000000000000"'): "seeds must be at most 100000 in number, got '0-1000000000000'",
    TOML.replace("[3, 5]", "true"): "seeds must be a number of seeds, .* got True",
    TOML.replace("[3, 5]", "{ a = 1 }"): "seeds must be a number of seeds, .* got {'a': 1}",
    TOML.replace('name = "far"', 'name = "far"\npreset = []'): r"preset must be a text, got \[\]",
    TOML.replace('name = "far"', 'name = ["far"]'): r"name must be a text, got \['far'\]",
    TOML.replace("[train]\nnum_envs = 64\nppo = { hidden = [16, 16] }", "train = true"): "train must be a table, got",
    TOML.replace('["uniform", "p25"]', '"uniform"'): "methods must be a list, each entry a text, got 'uniform'",
    TOML.replace('["uniform", "p25"]', "[[1]]"): r"methods must be a list, each entry a text, got \[\[1\]\]",
    TOML.replace("[50, 100]", "[true]"): r"goal_periods must be a list, each entry a whole number, got \[True\]",
    TOML.replace("[50, 100]", "50"): "goal_periods must be a list, each entry a whole number, got 50",
    TOML.replace("{ env_steps = 500, ppo = { epochs = 2 } }", "[1]"): r"train must be a table, got \[1\]",
    TOML.replace("ppo = { hidden = [16, 16] }", "ppo = 3"): "PPOConfig must be a table of its fields, got 3",
    TOML.replace(
        "ppo = { hidden = [16, 16] }", "eval = { fear = [1] }"
    ): r"FearConfig must be a table of its fields, got \[1\]",
    'environment = ["x"]': r"environment must be a list, each entry a table, got \['x'\]",
    "environment = 3": "environment must be a list, each entry a table, got 3",
    "train = " + 2000 * "{ a = " + "1" + 2000 * " }": r"study\.toml is not .* \(it is nested too deep\)",
    "seeds = " + 5000 * "[" + 5000 * "]": r"study\.toml is not a study's TOML file \(it is nested too deep\)",
    "audit_worlds = -1\n" + TOML: "audit_worlds must be at least 0, got -1",
    "plugins = 3\n" + TOML: "plugins must be a list, each entry a text, got 3",
    "seeds = = 3": r"study\.toml is not a study's TOML file",
}


@pytest.mark.parametrize(("text", "message"), ERRORS.items())
def test_mistake_in_a_file_is_one_line(tmp_path, text, message):
    """Whatever is wrong in a file is said in one line that names it, before anything runs."""
    with pytest.raises(RunError, match=message) as error:
        plan.expand(described(tmp_path, text))
    assert "\n" not in str(error.value)


def test_unknown_environment_is_refused(tmp_path):
    """Asking for an environment that a study does not have lists those that it has."""
    with pytest.raises(RunError, match=re.escape("This study has no environment quad; it has: near, far.")):
        plan.expand(described(tmp_path, TOML), environments=["quad"])


DESIGN = """
[factors]
env.max_speed = [5.0, 10.0, 20.0]
"""


def test_one_point_of_a_design_can_be_asked_for(tmp_path):
    """An environment's name stands for all points of its design, and with a number for one of them."""
    description = described(tmp_path, TOML + DESIGN)
    cells = plan.expand(description, environments=["near.2", "far"], seeds="0")
    names = [cell.environment for cell in cells]
    assert names == ["near.2", "near.2", "far.0", "far.1", "far.2"]
    assert cells[0] in plan.expand(description, seeds="0")
    assert {cell.environment for cell in plan.expand(description, environments=["near.1"])} == {"near.1"}
    message = "This study has no environment near.3; it has: near, far, and their points near.0 to far.2."
    with pytest.raises(RunError, match=re.escape(message)):
        plan.expand(description, environments=["near.3"])


def test_every_environment_has_a_pool_of_its_own(tmp_path):
    """A folder of pools, the study's or an environment's own, has a file for each; the training may name another."""
    shared, own = tmp_path / "shared", tmp_path / "own"
    for folder, names in ((shared, ("far.0", "far.1", "far.2", "other")), (own, ("own.0", "own.1", "own.2"))):
        folder.mkdir()
        for name in names:
            (folder / f"{name}.pt").write_text(name)
    text = TOML.replace("goal_periods", f"train = {{ eval = {{ pool = '{shared}/other.pt' }} }}\ngoal_periods")
    more = f"[[environment]]\nname = 'own'\nenv = {{ kind = 'particle' }}\npools = '{own}'\n"

    def cells():
        return plan.expand(described(tmp_path, f"pools = '{shared}'\n" + text + more + DESIGN), seeds="0")

    pools = {cell.environment: cell.config.eval.pool for cell in cells()}
    assert pools == {
        **{f"near.{i}": shared / "other.pt" for i in range(3)},
        **{f"far.{i}": shared / f"far.{i}.pt" for i in range(3)},
        **{f"own.{i}": own / f"own.{i}.pt" for i in range(3)},
    }
    before = [cell.digest for cell in cells()]
    (own / "own.1.pt").write_text("made anew")
    changed = {cell.environment for cell, digest in zip(cells(), before, strict=True) if cell.digest != digest}
    assert changed == {"own.1"}
