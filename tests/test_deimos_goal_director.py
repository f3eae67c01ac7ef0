"""The Director in other people's loops."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from deimos import GoalDirector
from deimos.goals.fear import FearConfig
from deimos.goals.interactions import Resolved
from deimos.goals.selectors import director, learnability, mix, uniform
from deimos.nn.random import Purpose, uniforms
from deimos.nn.stateful import Stateful

N, PERIOD = 96, 5
AFRAID = director.Config(percentile=75, candidates=20, fear=FearConfig(min_per_class=8))


def action(now):
    """What everybody does after ``now`` steps: worlds accelerate their own ways, some hardly and some into the wall."""
    return torch.sin(torch.arange(3.0 * N).view(N, 3) + 0.1 * now) * torch.linspace(0, 90, N).unsqueeze(1)


class Box(Stateful):
    """Somebody else's simulator: points in a cube of 2000 a side, whose goals are positions in it or beyond."""

    saved = ("now", "position", "velocity", "age", "goal", "drawn")

    def __init__(self):
        self.now = 0
        self.position, self.velocity, self.goal = torch.zeros(3, N, 3)
        self.age, self.drawn = torch.zeros(2, N, dtype=torch.int64)
        self.goal[:] = self.sample_goals(1)[:, 0]

    @property
    def state(self):
        """Position and velocity, shape (N, 6), of order 1."""
        return torch.cat([self.position / 1000, self.velocity / 200], dim=1)

    def sample_goals(self, count):
        """Independent goals of the next decision of every world, shape (N, count, 3)."""
        address = self.drawn.unsqueeze(1) * 100 + torch.arange(count)
        return 2.5 * uniforms(0, Purpose.GOAL, torch.arange(N).unsqueeze(1), address)[:, :, :3] - 1.25

    def step(self):
        """One step of all worlds; returns who crashed and whose time was up."""
        self.velocity = (self.velocity + 0.5 * action(self.now)).clamp(-200, 200)
        self.position = self.position + self.velocity
        self.now += 1
        self.age += 1
        crashed = (self.position.abs() > 1000).any(dim=1)
        return crashed, (self.age >= 23) & ~crashed

    def reset(self, mask):
        """Put worlds back to the middle, at rest."""
        for tensor in (self.position, self.velocity, self.age):
            tensor[mask] = 0


class Theirs:
    """Somebody else's loop: a simulator with its own resets, and goals that a GoalDirector gives."""

    def __init__(self, goals, candidates=1):
        self.env, self.goals, self.candidates = Box(), goals, candidates

    def step(self):
        """One step of the worlds; returns what the GoalDirector said, and whose episode ended."""
        env = self.env
        terminated, truncated = env.step()
        candidates = env.sample_goals(self.candidates)
        given = self.goals.step(env.state, env.goal, terminated, truncated, candidates, tracking=torch.zeros(N))
        env.goal = given.goal
        env.drawn += given.changed
        done = terminated | truncated
        env.reset(done)
        return given, done


def test_goals_change_when_they_are_due_or_the_world_is_done():
    """Goals stay for T steps, then come from the world's own candidates; a done world gets its first candidate."""
    goals = GoalDirector(AFRAID, 3)
    terminated = torch.tensor([False, True, False])
    no = torch.zeros(3, dtype=torch.bool)
    goal = torch.zeros(3, 2)
    clock = [0, 0, 0]
    generator = torch.Generator().manual_seed(0)
    for step in range(1, 20):
        candidates = torch.randn(3, 7, 2, generator=generator)
        crash = terminated if step % 5 == 2 else no
        given = goals.step(torch.randn(3, 4, generator=generator), goal, crash, no, candidates)
        for world in range(3):
            clock[world] += 1
            if crash[world]:
                assert torch.equal(given.goal[world], candidates[world, 0])
            elif clock[world] == 3:
                assert (given.goal[world] == candidates[world]).all(1).any()
            else:
                assert torch.equal(given.goal[world], goal[world])
            assert given.changed[world] == bool(crash[world] or clock[world] == 3)
            clock[world] = 0 if given.changed[world] else clock[world]
        goal = given.goal


def trained(steps=96, config=AFRAID, **options):
    theirs = Theirs(GoalDirector(config, PERIOD, learn_every=12, **options), candidates=20)
    for _ in range(steps):
        theirs.step()
    return theirs


def test_it_learns_fear_and_tells_it_calibrated():
    """``fear`` is the calibrated probability of the network's score, and its mean is near the share of crashes."""
    theirs = trained()
    goals, env = theirs.goals, theirs.env
    assert {"fear/loss", "fear/auroc", "calibration/ece"} <= set(goals.metrics)
    state, goal, new = env.state, env.goal, env.sample_goals(1)[:, 0]
    selector = goals.selector
    logit = selector.fear.network(torch.cat([state, goal, new], dim=1)).squeeze(1).detach()
    expected = torch.sigmoid((logit + selector.calibration.prior) / selector.calibration.temperature)
    torch.testing.assert_close(goals.fear(state, goal, new).probability, expected, rtol=1e-4, atol=1e-6)
    window = goals.interactions.resolved()
    told = goals.fear(window.state, window.goal, window.next_goal).probability
    assert abs(told.mean() - window.crashed.float().mean()) < 0.1
    assert told[window.crashed].mean() > told[~window.crashed].mean() + 0.1


def test_fear_is_found_in_mixed_and_blind_selectors():
    """A Mix has the fear of its method, and a state-blind one says the same whatever the state."""
    theirs = trained(config=mix.Config(base="p75"), steps=48)
    arguments = torch.zeros(2, 6), torch.zeros(2, 3), torch.zeros(2, 3)
    assert theirs.goals.fear(*arguments).probability.shape == (2,)
    blind = director.Config(candidates=20, control="state-blind", fear=FearConfig(min_per_class=8))
    theirs = trained(config=blind, steps=48)
    told = [theirs.goals.fear(state, *arguments[1:]).probability for state in (arguments[0], arguments[0] + 3.0)]
    assert torch.equal(*told)


def test_it_resumes_bit_for_bit():
    """Saved, loaded into a fresh one and driven on, it gives the goals of the one that never stopped."""
    first = trained(steps=50)
    saved = io.BytesIO()
    torch.save({"goals": first.goals.state_dict(), "env": first.env.state_dict()}, saved)
    saved.seek(0)
    state = torch.load(saved, weights_only=True)
    second = Theirs(GoalDirector(AFRAID, PERIOD, learn_every=12), candidates=20)
    second.env.load_state_dict(state["env"])
    second.goals.load_state_dict(state["goals"])
    for _ in range(40):
        (one, done), (two, _) = first.step(), second.step()
        assert torch.equal(one.goal, two.goal)
        assert torch.equal(first.env.state, second.env.state)
    assert not bool(done.all())
    assert repr(first.goals.metrics) == repr(second.goals.metrics)


def test_its_seed_fixes_every_choice():
    """Two of one seed choose alike whatever torch has drawn meanwhile; another seed chooses otherwise."""
    first = trained(steps=40, seed=1)
    torch.rand(5)
    second, other = trained(steps=40, seed=1), trained(steps=40, seed=2)
    assert torch.equal(first.env.goal, second.env.goal)
    assert not torch.equal(first.env.goal, other.env.goal)


def test_a_loop_without_gradients_may_continue_with_them():
    """Begun in rsl_rl's inference mode, it steps, learns and loads outside of it, and the other way round."""
    goals = GoalDirector(AFRAID, PERIOD, learn_every=12)
    theirs = Theirs(goals, candidates=20)
    with torch.inference_mode():
        theirs.step()
    for _ in range(40):
        theirs.step()
    with torch.inference_mode():
        for _ in range(30):
            theirs.step()
    assert goals.selector.fear.fitted
    goals.load_state_dict(goals.state_dict())
    theirs.step()


@pytest.mark.parametrize(
    "name", ["p75", "p75-literal", "rnd", "learnability", "swapped", "weighted", "fear-novelty", "q-fear"]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_host_may_compute_in_float64(name, dtype):
    """Where the default is float64 it chooses and learns, from states of either kind."""
    torch.set_default_dtype(torch.float64)
    try:
        goals, generator = GoalDirector(name, 4, learn_every=8), torch.Generator().manual_seed(0)
        never, goal = torch.zeros(300, dtype=torch.bool), torch.zeros(300, 2, dtype=dtype)
        for t in range(40):
            state = torch.randn(300, 3, generator=generator, dtype=dtype)
            candidates = torch.randn(300, 10, 2, generator=generator, dtype=dtype)
            goal = goals.step(state, goal, state[:, 0] > 1.0, never, candidates).goal
            assert goal.dtype == dtype, t
    finally:
        torch.set_default_dtype(torch.float32)
    selector = goals.selector
    assert selector.fitted if name == "rnd" else selector.fear.fitted


def test_a_curriculum_tells_its_range():
    """Candidates are the caller's, so the range that they shall come from can be asked for, and it grows."""
    goals = GoalDirector("cl", PERIOD, learn_every=10)
    assert goals.goal_range is None
    no, goal = torch.zeros(300, dtype=torch.bool), torch.zeros(300, 2)
    ranges = []
    for _ in range(30):
        goals.step(torch.zeros(300, 4), goal, no, no, torch.zeros(300, 1, 2), tracking=torch.ones(300))
        ranges.append(goals.goal_range.tolist())
    assert ranges[0] == [0.25, 0.25]
    assert ranges[-1][0] > 0.25
    assert GoalDirector(uniform.Config(), PERIOD).goal_range is None


def test_torch_and_numpy_are_all_that_it_needs():
    """Every selector that needs no simulator works, and learns, where nothing but torch and NumPy can be imported."""
    code = """
import sys
import torch
absent = ["warp", "mujoco", "mujoco_warp", "trimesh", "matplotlib", "tyro", "rich", "tensorboard", "gymnasium"]
absent += ["scipy", "PIL", "rsl_rl", "tensordict"]
sys.modules.update(dict.fromkeys(absent))  # importing them fails
from deimos import GoalDirector, load_policy
assert callable(load_policy)
no = torch.zeros(4, dtype=torch.bool)
for name in ("p75", "uniform", "rnd", "cl", "learnability", "band", "boltzmann", "grid", "mix", "state-blind",
             "swapped", "weighted", "fear-novelty", "q-fear", "penalty-30", "rnd-raw", "p75-literal"):
    goals, goal = GoalDirector(name, goal_period=2, total_steps=100), torch.zeros(4, 2)
    for t in range(50):
        crash = no.clone()
        crash[t % 4] = t % 3 == 0
        goal = goals.step(torch.randn(4, 3), goal, crash, no, torch.rand(4, 9, 2) - 0.5, tracking=torch.rand(4)).goal
    goals.selector.check()
loaded = {"deimos.kernels", "deimos.sim", "deimos.run", "terrain", "kernels"} & set(sys.modules)
assert not loaded, loaded
"""
    home = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=home, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_it_says_nothing_of_the_tools_beneath_it():
    """Where Warp is installed its networks use it, and what Warp reports of its start is not our host's business."""
    code = """
import numpy as np
import deimos
director = deimos.GoalDirector("p75", goal_period=2, goal_box=([-1.0], [1.0]))
director.step(np.zeros((4, 2)), np.zeros((4, 1)), np.zeros(4), np.zeros(4))
"""
    home = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=home, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_nothing_that_it_keeps_carries_a_gradient():
    """In a loop that records gradients, as a differentiable simulator's does, it keeps copies without them."""
    goals, no = GoalDirector(AFRAID, 2), torch.zeros(4, dtype=torch.bool)
    goal = torch.zeros(4, 2, requires_grad=True) * 1.0
    for _ in range(6):
        state, candidates, tracking = (torch.rand(4, *shape, requires_grad=True) for shape in ((3,), (9, 2), ()))
        goal = goals.step(2 * state, goal, no, no, 2 * candidates, tracking=tracking / 2).goal
        assert not goal.requires_grad
    kept = goals.interactions.resolved()
    assert len(kept) > 0
    assert not any(getattr(kept, name).requires_grad for name in Resolved.__dataclass_fields__)


def arguments(**changes):
    """A good first call, with changes."""
    no = torch.zeros(4, dtype=torch.bool)
    good = {"state": torch.zeros(4, 3), "goal": torch.zeros(4, 2), "terminated": no, "truncated": no}
    return good | {"candidates": torch.zeros(4, 9, 2)} | changes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": torch.zeros(3, 2)}, r"goal must have the shape \(4, 2\), got \(3, 2\)"),
        ({"terminated": torch.zeros(3, dtype=torch.bool)}, r"terminated must have the shape \(4,\), got \(3,\)"),
        ({"truncated": torch.zeros(4, 1, dtype=torch.bool)}, r"truncated must have the shape \(4,\), got \(4, 1\)"),
        ({"truncated": torch.full((4,), 0.5)}, r"truncated must be bool, or 0 and 1, got 0\.5 in world 0"),
        (
            {"candidates": torch.zeros(4, 2)},
            r"candidates must have the shape \(4, N, 2\) with N at least 1, got \(4, 2\)",
        ),
        ({"candidates": torch.zeros(4, 0, 2)}, r"candidates must have the shape .*, got \(4, 0, 2\)"),
        ({"candidates": torch.zeros(4, 9, 3)}, r"candidates must have the shape .*, got \(4, 9, 3\)"),
        ({"goal": torch.zeros(4)}, r"goal must have the shape \(num_envs, goal_dim\), got \(4,\)"),
        ({"terminated": np.array(["no"] * 4)}, r"terminated must be an array or a tensor of numbers, got numpy\.nd"),
    ],
)
def test_shapes_are_checked(changes, message):
    """What does not fit the rest is named, on the first call and on later ones."""
    goals = GoalDirector("p25", 5)
    with pytest.raises(ValueError, match=message):
        goals.step(**arguments(**changes))
    goals.step(**arguments())
    with pytest.raises(ValueError, match=message):
        goals.step(**arguments(**changes))


def test_worlds_may_not_change():
    """Later calls must have as many worlds and components as the first."""
    goals = GoalDirector("p25", 5)
    goals.step(**arguments())
    for name, tensor in (("state", torch.zeros(4, 2)), ("state", torch.zeros(3, 3)), ("goal", torch.zeros(4, 1))):
        with pytest.raises(ValueError, match=rf"{name} must have the shape \(4, "):
            goals.step(**arguments(**{name: tensor}))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal_period": 0}, "goal_period must be at least 1, got 0"),
        ({"learn_every": 0}, "learn_every must be at least 1, got 0"),
        ({"total_steps": -1}, "total_steps must be at least 0, got -1"),
        ({"selector": "p333"}, "Unknown method 'p333'; choose from: uniform"),
    ],
)
def test_options_are_checked(options, message):
    """The message names the argument and what it was."""
    with pytest.raises(ValueError, match=message):
        GoalDirector(**({"selector": "p25", "goal_period": 5} | options))


def test_what_is_not_there_yet_is_refused():
    """There is no selector before the first step, no fear before something was learnt, and none in Uniform."""
    goals = GoalDirector(learnability.Config(), 5)
    with pytest.raises(RuntimeError, match=r"knows its worlds only after the first call of step\(\) or propose\(\)"):
        goals.fear(torch.zeros(1, 3), torch.zeros(1, 2), torch.zeros(1, 2))
    goals.step(**arguments())
    with pytest.raises(RuntimeError, match="fear network has learnt nothing yet"):
        goals.fear(torch.zeros(1, 3), torch.zeros(1, 2), torch.zeros(1, 2))
    goals = GoalDirector("uniform", 5)
    goals.step(**arguments())
    with pytest.raises(ValueError, match="selector must have a fear network"):
        goals.fear(torch.zeros(1, 3), torch.zeros(1, 2), torch.zeros(1, 2))
    with pytest.raises(ValueError, match="changes over the training"):
        GoalDirector("boltzmann", 5).step(**arguments())
