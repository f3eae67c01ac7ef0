"""What happens between two steps: how episodes begin under selectors that bound first goals."""

from types import SimpleNamespace

import pytest
import torch

from deimos.goals.selectors import cl, mix, schedule, uniform
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.env import Env
from deimos.sim.envs import particle, quad

TASKS = {
    "particle": particle.Config(goal_period=20, stagger_goals=True, spawn_range=100.0),
    "quad": quad.Config(goal_period=20, episode_steps=50),
}
SCALED = {
    "cl": cl.Config(start=0.25),
    "schedule": schedule.Config(first="cl", second="p75"),
    "mix": mix.Config(base="cl"),
}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("selector", SCALED)
def test_only_first_goals_differ_where_they_are_scaled(torch_device, task, selector):
    """Worlds start where and with the clocks that they have under Uniform; their first goals are those, scaled."""
    goal, place = "goal", "position" if task == "particle" else "qpos"
    built = []
    for config in (uniform.Config(), SCALED[selector]):
        env = TASKS[task].build(64, torch_device, 5)
        loop = GoalLoop(env, config.build(spaces(env, total_steps=1000), 0))
        assert not loop.interactions.active.any()
        assert bool((loop.weight == 1).all())
        built.append(env.state_dict())
    plain, scaled = built
    layout = env.goal_slice
    for tensors in built:
        tensors["state"] = env.state(tensors.pop("obs"))
    for name in plain.keys() - {goal}:
        assert torch.equal(scaled[name], plain[name]), name
    # A quarter is exact in float32, before the draw is multiplied by it or after.
    assert torch.equal(scaled[goal], 0.25 * plain[goal])
    assert len(plain["goal_clock"].unique()) > 10
    assert len(plain[place][:, 0].unique()) == 64
    assert layout.stop - layout.start == plain[goal].shape[1]


def test_scaled_first_goals_do_not_fall_due_together(torch_device):
    """Under the curriculum as under Uniform, no step gives all worlds a goal or ends all episodes."""
    env = TASKS["quad"].build(64, torch_device, 1)
    loop = GoalLoop(env, cl.Config().build(spaces(env), 0))
    for _ in range(50):
        step = env.step(torch.zeros(64, 12, device=torch_device))
        done = step.terminated | step.truncated
        assert max(int(done.sum()), int((step.goal_due & ~done).sum())) < 32
        loop.advance(step)


def test_starting_again_goes_on_to_new_episodes(torch_device):
    """``start`` begins the next episode of every world, where ``restart`` begins the first one again."""
    env = TASKS["particle"].build(16, torch_device, 2)
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0))
    first = env.state_dict()
    loop.start()
    assert env.tensors["episode_count"].tolist() == [2] * 16
    assert not (env.tensors["position"] == first["position"]).any()
    for _ in range(25):
        loop.advance(env.step(torch.ones(16, 3, device=torch_device)))
    assert env.tensors["goal_count"].any()
    env.restart()
    for name, tensor in first.items():
        assert torch.equal(env.tensors[name], tensor), name


def test_an_environment_that_miscounts_touches_no_other_world(torch_device):
    """Goals and episodes begin where the masks say so; what a step says of their number is not even read."""
    env = TASKS["particle"].build(16, torch_device, 2)
    loop = GoalLoop(env, uniform.Config().build(spaces(env), 0))
    step = env.step(torch.zeros(16, 3, device=torch_device))
    for name, rows in (("goal_due", [3, 5]), ("terminated", [5, 7]), ("truncated", [])):
        getattr(step, name).fill_(False)[rows] = True
    before = {name: env.tensors[name].clone() for name in ("goal_count", "episode_count")}
    loop.advance(SimpleNamespace(**(vars(step) | {"count": torch.tensor([9, 9], device=torch_device)})))
    assert (env.tensors["goal_count"] - before["goal_count"]).nonzero().flatten().tolist() == [3]
    assert (env.tensors["episode_count"] - before["episode_count"]).nonzero().flatten().tolist() == [5, 7]
    assert loop.interactions.active.nonzero().flatten().tolist() == [3]


def test_goals_stay_in_the_range_first_goals_included():
    """In Particle Gym all goals, first ones included, come from the share of the range, and reach its edge."""
    env = particle.Config(goal_period=4).build(500, torch.device("cpu"), 0)
    loop = GoalLoop(env, cl.Config(start=0.2, min_interactions=10**6).build(spaces(env), 0))
    largest = 0.0
    for _ in range(13):
        largest = max(largest, env.goal.abs().max().item())
        loop.advance(env.step(torch.zeros(500, 3)))
    assert 0.19 < largest <= 0.2 * (1 + 1e-6)
    env.tensors["position"][:] = 5000.0
    loop.advance(env.step(torch.zeros(500, 3)))  # everybody crashes and gets a first goal
    assert 0.19 < env.goal.abs().max().item() <= 0.2 * (1 + 1e-6)


def test_environments_tell_their_groups():
    """By default all components are one group, and its tracking is the mean reward."""
    assert Env.goal_groups == (slice(None),)
    env = particle.Config(goal_period=4).build(8, torch.device("cpu"), 0)
    loop = GoalLoop(env, cl.Config().build(spaces(env), 0))
    for _ in range(8):
        loop.advance(env.step(torch.zeros(8, 3)))
    resolved = loop.interactions.resolved()
    assert resolved.tracking.shape == (8, 1)
    torch.testing.assert_close(resolved.tracking[:, 0], resolved.reward / 4)
