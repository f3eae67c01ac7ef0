"""The studies of the thesis, as files: what is in them, and that their cells are still those of the committed rows."""

from pathlib import Path

import pytest

from deimos.study import plan
from reproduction.thesis import DIRECTOR_METHODS, LEGGED_METHODS, PARTICLE_METHODS

ROOT = Path(__file__).parent.parent
FILES = {
    path.stem: path for path in [*(ROOT / "reproduction" / "studies").glob("*.toml"), ROOT / "examples/study.toml"]
}
PARTICLE = [name for name in FILES if not name.startswith("quad")]


def test_every_study_of_the_thesis_is_there():
    """Each figure of the thesis has its study."""
    assert set(FILES) == {
        "absolute", "relative", "directional", "particle", "quad", "quad_arm", "population", "pilots", "study",
    }  # fmt: skip


@pytest.mark.parametrize("name", PARTICLE)
def test_studies_of_particle_gym_expand(name):
    """Every study of Particle Gym is a valid grid of different cells."""
    description = plan.read(FILES[name])
    cells = plan.expand(description, seeds=[0, 1])
    assert len({cell.digest for cell in cells}) == len({cell.name for cell in cells}) == len(cells)
    expected = sum(len(each.get("methods", description["methods"])) for each in description["environment"])
    assert len(cells) == 2 * expected


def test_studies_are_the_thesis():
    """Particle Gym has ten methods, ten seeds and 2000 or 5000 steps; the legged ones twelve, thirty and two T."""
    description = plan.read(FILES["particle"])
    cells = plan.expand(description, seeds=[0])
    steps = {cell.environment: cell.config.env_steps for cell in cells}
    assert steps == {"directional": 2000, "relative": 2000, "absolute": 5000}
    assert {cell.config.num_envs for cell in cells} == {2000}
    assert (description["seeds"], set(description["methods"])) == (10, {*PARTICLE_METHODS, "learnability"})
    assert (len(DIRECTOR_METHODS), len(PARTICLE_METHODS), len(LEGGED_METHODS)) == (7, 10, 12)
    for name in ("quad", "quad_arm"):
        description = plan.read(FILES[name])
        assert (description["seeds"], set(description["methods"])) == (30, set(LEGGED_METHODS))
        (environment,) = description["environment"]
        assert (environment["name"], environment["goal_periods"]) == (name, [100, 500])
