"""``check_env``: all our environments keep the contract, and what a plug-in forgot is named."""

import importlib.util
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from deimos.checks import SimulationError
from deimos.goals.shield import Shield
from deimos.nn.random import Purpose, uniforms
from deimos.run.attack import collect, uniform_goals
from deimos.run.evaluation import EvalConfig, make_target, play
from deimos.run.oracle import Clones
from deimos.run.shield import Guard, random_rule
from deimos.sim.check_env import check_env
from deimos.sim.env import Env, EnvConfig, ObsField, Step
from deimos.sim.envs import particle, quad, quad_arm

PAGE = Path(__file__).parent.parent / "docs" / "add_an_environment.md"
OURS = {
    "directional": particle.Config(),
    "absolute": particle.Config(variant="absolute", obs_scale="raw", reward="exponential"),
    "relative": particle.Config(
        variant="relative", spawn_range=50.0, time_limit=30, stagger_goals=True, crash_penalty=2.0
    ),
    "quad": quad.Config(),
    "quad on mujoco-warp": quad.Config(engine="warp"),
    "quad-arm": quad_arm.Config(),
}


@pytest.mark.parametrize("name", OURS)
def test_our_environments_keep_the_contract(torch_device, name):
    """Nothing is found in the environments of the tree."""
    check_env(OURS[name].build(2, torch_device, 0))


def test_the_unit_of_the_penalty_is_matching_the_goal():
    """A crash penalty of one costs what a step at the goal gives: 1 for a particle, for robots their tracking terms."""
    units = {name: config.largest_reward for name, config in OURS.items()}
    assert units.pop("quad") == units.pop("quad on mujoco-warp") == pytest.approx(0.02 * (1.0 + 0.5))
    assert units.pop("quad-arm") == pytest.approx(0.02 * (1.0 + 0.5 + 0.5 + 0.5))
    assert set(units.values()) == {1.0}


@pytest.mark.parametrize("name", OURS)
def test_a_crash_costs_the_penalty_everywhere(torch_device, name):
    """In every environment the step of a crash, and no other, is worth less by the penalty; evaluation has none."""
    configs = [replace(OURS[name].with_goal_period(5), crash_penalty=cost) for cost in (0.0, 2.0)]
    plain, punished = (config.build(6, torch_device, 0) for config in configs)
    assert punished.crash_penalty == pytest.approx(2.0 * OURS[name].largest_reward)
    assert configs[1].for_evaluation() == configs[0].for_evaluation()
    generator, crashes = torch.Generator().manual_seed(0), 0
    place = "position" if "position" in plain.tensors else None
    for t in range(40):
        action = (3.0 * torch.randn(6, plain.action_dim, generator=generator)).to(torch_device)
        if place and t == 20:  # robots fall by themselves
            for env in (plain, punished):
                env.tensors[place][2:4] = 1e4
        expected, step = plain.step(action), punished.step(action)
        crashes += int(expected.terminated.sum())
        assert torch.equal(step.reward, expected.reward - punished.crash_penalty * expected.terminated)
    assert crashes > 0


@pytest.fixture
def plant(tmp_path):
    """A function that builds the page's cart with one piece of its source replaced."""
    source = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]

    def build(device, old, new):
        assert source.count(old) >= 1, old
        path = tmp_path / "broken_cart.py"
        path.write_text(source.replace(old, new))
        spec = importlib.util.spec_from_file_location("broken_cart", path)
        sys.modules["broken_cart"] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.Config().build(8, device, 0)

    yield build
    sys.modules.pop("broken_cart", None)


def test_the_sound_cart_passes(torch_device, plant):
    """What the bugs below are planted into has none."""
    check_env(plant(torch_device, "", ""))


# In the kernels or the constructor.
FORGOTTEN = {
    "a scale": ('"velocity", 1, "m/s", 1.0', '"velocity", 1, "m/s", (1.0, 1.0)', "layout: velocity must have a scale"),
    "the actor's goal": ('"goal", 1, "m", 1 / HALF_LENGTH)', '"goal", 1, "m", 1.0, seen_by="critic")', "seen by both"),
    "begin_episode": (
        "begin_episode(env, worlds)  #", "worlds.episode_count[env]  #", "an episode must have begun in every world",
    ),
    "half of obs": ("obs[env, 1] = cart.velocity[env]", "obs[env, 1] = 0.0 / 0.0", "the first observation must be"),
    "a column of the layout": (
        '                ObsField("velocity", 1, "m/s", 1.0),\n', "", "the step must write nothing but the goal into",
    ),
    "the goal's place": (
        'ObsField("velocity", 1, "m/s", 1.0),\n                ObsField("goal", 1, "m", 1 / HALF_LENGTH),',
        'ObsField("goal", 1, "m", 1 / HALF_LENGTH),\n                ObsField("velocity", 1, "m/s", 1.0),',
        "the step must write nothing but the goal into the goal's slot",
    ),
    "how wide obs is": (
        'ObsField("velocity", 1, "m/s", 1.0)', 'ObsField("velocity", 3, "m/s", 1.0)',
        r"the first observation must be|the step must write all of obs, but left out the columns \[2, 3\]",
    ),
    "columns behind the layout": (
        "    obs[env, 1] = cart.velocity[env]\n",
        "    obs[env, 1] = cart.velocity[env]\n    obs[env, 3] = 1.0\n    obs[env, 4] = 2.0\n",
        "the step must not write beyond the 3 columns of the layout, which is too narrow",
    ),
    "the draw of goals": ("goal_range=(1.2 * HALF_LENGTH,)", "goal_range=(0.0,)", "first goals must differ and be se"),
    "world_offset": ("worlds.world_offset + env", "env", r"draws must be addressed by world_offset \+ env"),
    "the reset's state": ("cart.velocity[env] = 0.0", "pass", "restart must begin the first episodes again, but"),
    "write_goal": ("            write_goal(env, worlds)\n", "", "first goals must differ and be seen"),
    "the mask": ("if worlds.mask[env]:", "if worlds.num_envs > 0:", "reset must leave the worlds outside its mask"),
    "end_step": ("        end_step(env, crashed, False, cause, worlds)\n", "", "step 1 must advance episode_step"),
    "no goal changes": (
        "end_step(env", "worlds.goal_count[env] = worlds.goal_count[env] + 1\n        end_step(env",
        "step must not reset a world or change a goal, but goal_count changed",
    ),
    "a reward": ("worlds.reward[env] = 1.0", "worlds.reward[env] = -1.0", "Step.reward must be finite and at least 0"),
    "any reward": (
        "        worlds.reward[env] = 1.0 / (1.0 + wp.abs(position - worlds.goal[env, 0]))\n", "",
        "Step.reward must be finite and at least 0: the step must write it in every world",
    ),
    "a crash's reward": (
        "        worlds.reward[env] = 1.0", "        if not crashed:\n            worlds.reward[env] = 1.0",
        "Step.reward must be finite: the step must write it, after a crash too",
    ),
    "the bound of actions": (
        "wp.clamp(action, -1.0, 1.0)", "action",
        "the step must clip actions to action_range, as a deployed policy does, but beyond it obs differs",
    ),
    "the cause": ("cause = wp.static(ACTION)", "cause = 0", "check must stop the run after an action that is not fin"),
    "an array to resume": ("StructTable(Cart))", "StructTable(Cart), resume=False)", "clones must move alike, but obs"),
    "groups": (
        '    """Carts; see ``Config``."""\n', "    goal_groups = (slice(0, 1), slice(0, 1))\n",
        "goal_groups must name every component of a goal once",
    ),
    "a name": (
        '    """Carts; see ``Config``."""\n', '    goal_group_names = ("place", "speed")\n',
        "goal_group_names must name every group once",
    ),
    "a weight": (
        '    """Carts; see ``Config``."""\n', "    goal_group_weights = (1.0, 0.5)\n",
        "goal_group_weights must be empty, or a number of at least 0 for every group",
    ),
}  # fmt: skip


@pytest.mark.parametrize("forgotten", FORGOTTEN)
def test_what_a_plug_in_forgot_is_named(torch_device, plant, forgotten):
    """A bug planted in the source of an environment is found, and the message says what is missing."""
    old, new, message = FORGOTTEN[forgotten]
    env = plant(torch_device, old, new)
    with pytest.raises(ValueError, match=f"CartEnv: .*({message})"):
        check_env(env)


def test_a_range_of_goals_has_their_components(torch_device, plant):
    """A range with a component too many is refused by the constructor, in one line."""
    with pytest.raises(ValueError, match=r"^goal_range must have 1 components, got 2\.$"):
        plant(torch_device, "goal_range=(1.2 * HALF_LENGTH,)", "goal_range=(1.2 * HALF_LENGTH, 1.0)")


def wrap(method, after):
    """A method that does ``after(self, result, *arguments)`` to what it gives back."""
    return lambda self, *arguments: after(self, method(self, *arguments), *arguments)


def forget_rows(self, result, rows, count, scale=None):
    """Goals that depend on who else asks."""
    return result + 0.01 * len(rows)


def forget_count(self, result, rows, count, scale=None):
    """Goals that depend on how many are asked for."""
    return result + 0.01 * count


def forget_to_count(self, result, rows, goal, where=None):
    """New goals that do not count."""
    self.tensors["goal_count"][rows] -= 1


def forget_the_mask(self, result, rows, goal, where=None):
    """New goals that are told of to worlds outside of the mask."""
    if where is not None:
        self.tensors["goal_clock"][rows[~where]] = 0


def forget_the_goals(self, result, rows, goal, where=None):
    """No new goals where there is a mask."""
    if where is not None:
        self.tensors["goal_count"][rows[where]] -= 1


def forget_others(self, result, rows, goal, where=None):
    """New goals that move other worlds."""
    self.tensors["position"] += 1


def forget_to_show(self, result, rows, goal, where=None):
    """New goals that are not seen."""
    self.obs[rows, 9:] = 0.5


def forget_the_view(self, result, *arguments):
    """A state that is rebound at every step."""
    self.tensors["position"] = self.tensors["position"].clone()
    return result


def forget_the_seed(self, result, *arguments):
    """A step that draws from a global generator."""
    result.reward.add_(torch.rand(1).item())
    return result


def forget_the_clock(self, result, *arguments):
    """A goal that is due a step too early."""
    result.goal_due[:] = self.tensors["goal_clock"] >= self.goal_period - 1
    return result


def forget_the_limit(self, result, *arguments):
    """Episodes that never end."""
    result.truncated[:] = False
    return result


def forget_the_difference(self, result, *arguments):
    """A crash that is a truncation too."""
    result.terminated[:] = result.truncated[:] = True
    return result


def forget_the_penalty(self, result, *arguments):
    """A crash that costs nothing."""
    result.reward[:] += self.crash_penalty * result.terminated
    return result


def forget_the_order(self, result, *arguments):
    """A penalty that the reward is clipped after."""
    result.reward.clamp_(min=0.0)
    return result


def forget_what_a_penalty_is(self, result, *arguments):
    """A penalty that the policy sees."""
    self.obs[:, 0] -= self.crash_penalty * result.terminated
    return result


def forget_the_first_goal_count(self, result, *arguments):
    """First goals that count."""
    self.tensors["goal_count"] += self._views["mask"]


def forget_the_copy(self, result):
    """A state dictionary of views."""
    return dict(self.tensors)


BUGS = [
    ("sample_goals", forget_rows, "sample_goals must not depend on the other worlds that ask"),
    ("sample_goals", forget_count, "sample_goals must give the first ones of a longer list"),
    ("set_goals", forget_to_count, "sample_goals must give other goals once a goal was set: count it"),
    ("set_goals", forget_others, "set_goals must leave the other worlds alone, but position changed"),
    ("set_goals", forget_to_show, "set_goals must show the goals that it was given"),
    ("set_goals", forget_the_mask, "set_goals must leave the rows outside of where alone, but goal_clock changed"),
    ("set_goals", forget_the_goals, "set_goals must give a goal to the rows in where"),
    ("step", forget_the_view, "position must stay where it is: write into it, never rebind it"),
    ("step", forget_the_seed, "the same seed must give the same numbers"),
    ("step", forget_the_clock, "a goal must not be due before T = 6 steps, but this fails after 5 steps"),
    ("step", forget_the_limit, "episodes must be truncated at the time limit of 30 steps"),
    ("step", forget_the_difference, "a world that crashed must not be truncated too"),
    ("step", forget_the_penalty, "the step of a crash, and no other, must cost crash_penalty"),
    ("step", forget_the_order, "the step of a crash, and no other, must cost crash_penalty, taken off after"),
    ("step", forget_what_a_penalty_is, "crash_penalty must change the reward alone, but obs differs"),
    ("reset", forget_the_first_goal_count, "first goals must not count in goal_count"),
    ("state_dict", forget_the_copy, "state_dict must give copies"),
]


@pytest.mark.parametrize(("method", "bug", "message"), BUGS, ids=[bug.__name__ for _, bug, _ in BUGS])
def test_bugs_in_methods_are_named(torch_device, monkeypatch, method, bug, message):
    """A method that does not keep its promise is found, and the message says which one it is."""
    env = OURS["relative"].build(2, torch_device, 0)
    monkeypatch.setattr(particle.Particle, method, wrap(getattr(particle.Particle, method), bug))
    with pytest.raises(ValueError, match=f"Particle: .*({message})"):
        check_env(env)


def test_the_unit_of_the_penalty_is_checked(torch_device, monkeypatch):
    """An environment that names another penalty than its configuration would have wrong rewards reported."""
    monkeypatch.setattr(particle.Particle, "crash_penalty", property(lambda self: 1.0, lambda self, value: None))
    env = OURS["relative"].build(2, torch_device, 0)
    with pytest.raises(
        ValueError, match="Particle: crash_penalty must be the configuration's times its largest_reward"
    ):
        check_env(env)


@dataclass(frozen=True, kw_only=True)
class LineConfig(EnvConfig):
    """A point on a line, in plain torch."""

    clip_last: bool = False

    def build(self, num_envs, device, seed, env_offset=0):
        """See ``EnvConfig.build``."""
        return Line(self, num_envs, device, seed, env_offset)


class Line(Env):
    """See ``LineConfig``; it crashes where the line ends."""

    layout = (ObsField("position", 1, "m", 1.0), ObsField("goal", 1, "m", 1.0))
    action_dim, action_bound, dt, time_limit = 1, 1.0, 1.0, 0

    def __init__(self, config, num_envs, device, seed, env_offset):
        self.config, self.num_envs, self.device, self.goal_period = config, num_envs, device, config.goal_period
        self.crash_penalty = config.crash_penalty * config.largest_reward
        self._seed, self._world, self._sound = seed, torch.arange(num_envs, device=device) + env_offset, True
        self.obs, self.episode_step = torch.zeros(num_envs, 2, device=device), self._zeros(torch.int32)
        counts = {name: self._zeros(torch.int64) for name in ("goal_clock", "episode_count", "goal_count")}
        self.tensors = counts | {"obs": self.obs, "episode_step": self.episode_step}
        self._step = Step(self.obs, self._zeros(torch.float32), *(self._zeros(torch.bool) for _ in range(4)))
        self.reset(torch.ones(num_envs, dtype=torch.bool, device=device))

    def _zeros(self, dtype):
        return torch.zeros(self.num_envs, dtype=dtype, device=self.device)

    def _uniform(self, purpose, rows, count):
        return 2 * uniforms(self._seed, purpose, self._world[rows].unsqueeze(1), count)[..., :1] - 1

    def step(self, action):
        """See ``Env.step``."""
        if action.shape != (self.num_envs, 1):
            raise ValueError("action")
        self._sound &= bool(action.isfinite().all())
        self.obs[:, 0] += 0.1 * action[:, 0].clamp(-1, 1)
        self.episode_step += 1
        self.tensors["goal_clock"] += 1
        step, (position, goal) = self._step, self.obs.T
        step.terminated[:] = position.abs() > 1
        step.goal_due[:] = self.tensors["goal_clock"] >= self.goal_period
        step.reward[:] = (1 - (position - goal).abs()).clamp(min=0) - self.crash_penalty * step.terminated
        if self.config.clip_last:
            step.reward.clamp_(min=0)
        return step

    def reset(self, mask, goal_scale=None):
        """See ``Env.reset``."""
        rows = mask.nonzero().squeeze(1)
        self.tensors["episode_count"][rows] += 1
        self.episode_step[rows] = 0
        self.tensors["goal_clock"][rows] = 0
        first = self._uniform(2, rows, self.tensors["episode_count"][rows].unsqueeze(1))[:, 0]
        self.obs[rows, 0] = 0.0
        self.obs[rows, 1:] = first if goal_scale is None else first * goal_scale

    def sample_goals(self, rows, count, scale=None):
        """See ``Env.sample_goals``."""
        address = 1000 * self.tensors["goal_count"][rows].unsqueeze(1) + torch.arange(count, device=self.device)
        return self._uniform(1, rows, address) * (1.0 if scale is None else scale)

    def draw(self, rows):
        """See ``Env.draw``."""
        return uniforms(self._seed, Purpose.GOAL, self._world[rows], self.tensors["goal_count"][rows])

    def set_goals(self, rows, goal, where=None):
        """See ``Env.set_goals``."""
        if where is not None:
            rows, goal = rows[where], goal[where]
        self.obs[rows, 1:] = goal
        self.tensors["goal_clock"][rows] = 0
        self.tensors["goal_count"][rows] += 1

    def check(self):
        """See ``Env.check``."""
        if not self._sound:
            raise SimulationError("An action is not finite.")


def test_an_environment_of_plain_torch_is_checked(torch_device):
    """The contract needs no Warp: a sound environment passes, and one whose penalty is clipped away is named."""
    check_env(LineConfig().build(3, torch_device, 0))
    with pytest.raises(ValueError, match="Line: the step of a crash, and no other, must cost crash_penalty, taken off"):
        check_env(LineConfig(clip_last=True).build(3, torch_device, 0))


def test_a_shield_decides_in_an_environment_of_plain_torch():
    """A guard has the last word on goals that are played, that an attacker learns from, and that clones pursue."""
    config, cpu = LineConfig(goal_period=12), torch.device("cpu")
    env, stop = config.build(16, cpu, 0), Shield(-1.0, "stop", (0.0,), (1.0,))

    def follow(obs):
        return obs[:, 1:]

    guards = [None, Guard(stop, random_rule, candidates=4)]
    played = [play(config.build(16, cpu, 0), follow, uniform_goals(env), 120, guard=guard) for guard in guards]
    target = make_target(follow, config, EvalConfig(worlds=16, attackers=()), cpu)
    learnt = [collect([replace(target, guard=guard)], 120, own_goals=False)[1] for guard in guards]
    assert guards[1].refused == 1.0
    assert played[0]["interaction_crashes"] > 0 == played[1]["interaction_crashes"]
    assert learnt[0].crashed.any()
    assert not learnt[1].crashed.any()
    clones = [Clones(lambda count: config.build(count, cpu, 0), follow, guard=guard) for guard in guards]
    survived = [each.try_out(env, torch.arange(16), torch.ones(16, 1, 1)) for each in clones]
    assert (survived[0] < 12).all()
    assert (survived[1] == 12).all()


def test_the_configuration_must_be_one(torch_device):
    """An environment whose ``config`` is none cannot be built again, and the message says so."""
    env = OURS["absolute"].build(2, torch_device, 0)
    env.config = {}
    with pytest.raises(ValueError, match="config must be the environment's EnvConfig, got dict"):
        check_env(env)
