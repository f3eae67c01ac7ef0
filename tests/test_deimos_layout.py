"""Components of a goal have the names, units and scales of their fields and groups."""

import pytest
import torch

from deimos.nn.layout import ObsField, goal_components
from deimos.sim.envs.particle import Config


def labels(field, groups=(slice(None),), names=("goal",)):
    """Names with units of the components of a goal, between other fields."""
    layout = (ObsField("velocity", 3, "m/s", 1.0), field, ObsField("action", 2, "1", 1.0))
    return [component.label for component in goal_components(layout, groups, names)]


def test_a_goal_of_one_unit_has_it_on_every_component():
    """A particle's goal has three components of one unit."""
    env = Config().build(1, torch.device("cpu"), 0)
    found = goal_components(env.layout, env.goal_groups, env.goal_group_names)
    assert [component.label for component in found] == ["goal x [u/step]", "goal y [u/step]", "goal z [u/step]"]
    assert [component.name for component in found] == ["goal x", "goal y", "goal z"]


def test_components_are_called_after_their_group():
    """One alone has the group's name, up to three have letters, more have numbers; groups may stand in any order."""
    field = ObsField("goal", 4, "m, m, m, rad", (1.0, 2.0, 3.0, 4.0))
    places = ["place x [m]", "place y [m]", "place z [m]"]
    assert labels(field, (slice(3, 4), slice(0, 3)), ("turn", "place")) == [*places, "turn [rad]"]
    assert labels(field) == ["goal 0 [m]", "goal 1 [m]", "goal 2 [m]", "goal 3 [rad]"]
    assert labels(ObsField("goal", 2, "1", 1.0)) == ["goal x", "goal y"]
    scales = [component.scale for component in goal_components((field,), (slice(None),), ("goal",))]
    assert scales == [1.0, 2.0, 3.0, 4.0]
    with pytest.raises(ValueError, match="The layout has no field named 'goal'"):
        goal_components((ObsField("velocity", 3, "m/s", 1.0),), (), ())
