"""A policy at work in a few worlds, steered by a user: who chooses its goals, pause, step, reset, new checkpoints."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from deimos.checks import RunError, check_choice
from deimos.goals.fear_selector import FearSelector
from deimos.goals.selector import GoalSelector, Proposal
from deimos.goals.shield import Mode
from deimos.nn.layout import goal_components
from deimos.run.attack import Attack, argmax_director, attacker, require_heard, uniform_goals
from deimos.run.evaluation import make_target, require_pool
from deimos.run.fear import learnt_fear
from deimos.run.film import seconds_per_step
from deimos.run.loop import GoalLoop
from deimos.run.saved import SavedRun
from deimos.run.shield import stored_guard
from deimos.sim.env import Env

UNIFORM, BY_HAND = "uniform", "by hand"
EXTENT = 512  # goals that show how far goals reach where they do not fill a box
SIDE = 21  # points of the map of fear along each of its axes
WATCHED = ("policy.pt", "checkpoint.pt")  # written one after the other, whole

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FearMap:
    """Predicted probabilities of a crash over two components of the next goal; the others are those of the active one.

    Everything is in physical units.
    """

    axes: tuple[int, int]
    """The two components."""
    low: tuple[float, float]
    """Their lowest values."""
    high: tuple[float, float]
    """Their highest values."""
    probability: Tensor
    """In (0, 1), float32, shape (SIDE, SIDE): the second component grows along the first axis, the first along the
    second; both ends are included."""

    def at(self, right: float, up: float) -> tuple[float, float]:
        """The two components at a place: how far right and up it is, as shares of the sides; 0 and 1 are the ends.

        What is beyond the map has those of its edge: dragging the mouse that far asks for no goal outside it.
        """
        shares = zip(self.low, self.high, (right, up), strict=True)
        first, second = (low + (high - low) * min(max(share, 0.0), 1.0) for low, high, share in shares)
        return first, second

    def shares(self, goal: Sequence[float]) -> tuple[float, float]:
        """The place of a goal, as in ``at``; the middle along an axis without extent, such as a speed of always 0."""
        ends = zip(self.axes, self.low, self.high, strict=True)
        right, up = ((goal[axis] - low) / (high - low) if high > low else 0.5 for axis, low, high in ends)
        return right, up


class Steered(GoalSelector):
    """The one of some selectors that is chosen at the moment, or a user's own goal.

    Args:
        choices: The selectors, by name.
    """

    def __init__(self, choices: Mapping[str, GoalSelector]) -> None:
        self.choices = dict(choices)
        self.current = UNIFORM
        self.own: Tensor | None = None
        """The user's goal as the policy sees it, shape (goal_dim,)."""

    @property
    def num_candidates(self) -> int:  # type: ignore[override]
        """See ``GoalSelector.num_candidates``."""
        return 1 if self.current == BY_HAND else self.choices[self.current].num_candidates

    def goal_range(self) -> Tensor | None:
        """See ``GoalSelector.goal_range``."""
        return None if self.current == BY_HAND else self.choices[self.current].goal_range()

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        if self.current == BY_HAND:
            assert self.own is not None
            return Proposal(self.own.expand(len(rows), -1).clone(), torch.full_like(draws[:, 0], torch.nan))
        return self.choices[self.current].propose(rows, state, goal, candidates, draws)


class Session:
    """Worlds in which a policy acts, the first of which is watched.

    Args:
        run: The run whose policy it is.
        worlds: How many, at least 1.
        seed: Seed of the worlds and their goals.
        world: Global number of the first.
        attacks: Attackers that are ready, by name; see ``prepare``.
        afraid: Makes the selector whose fear is shown if the run itself has no fear network.
        shield: What becomes of goals that the run's shield refuses; ``None`` for no shield.

    Raises:
        RunError: If the policy, the worlds or the shield cannot be loaded.
    """

    def __init__(
        self, run: SavedRun, worlds: int, seed: int, world: int = 0,
        attacks: Mapping[str, Attack] | None = None, afraid: Callable[[Env], FearSelector] | None = None,
        shield: Mode | None = None,
    ) -> None:  # fmt: skip
        self._run, self._worlds, self._seed = run, worlds, seed
        self._attacks, self._fallback, self._shield = dict(attacks or {}), afraid, shield
        self.paused = False
        self._stays = False  # the policy, for the shield's sake
        self.axes = (0, 1)
        self.crashes = self.steps = self.episodes = 0
        self.restarts = 0
        """How often ``reset`` and ``go_to`` have restarted everything."""
        self.goals = Steered({})
        self._build(world)
        self._load()

    def _build(self, world: int) -> None:
        """Make the worlds; ``world`` is the global number of the first."""
        self.world = world
        self.env = self._run.build(self._worlds, self._seed, world)
        self.components = goal_components(self.env.layout, self.env.goal_groups, self.env.goal_group_names)
        self._scale = torch.tensor([component.scale for component in self.components])
        self._rows = torch.zeros(1, dtype=torch.int64)
        self._extent: tuple[Tensor, Tensor] | None = None

    def _load(self) -> None:
        """Load the policy and the selector of the run as they are now; the worlds continue."""
        self._stamp = self._stamps()
        self._policy, self.iteration = self._run.policy(self.env), self._run.iteration()
        self._trained, self._guard = self._run.selector(self.env), None
        if self._shield:
            afraid = learnt_fear(self._trained)
            self._guard = stored_guard(self._run.folder, self._policy, self.env, afraid, self._shield)
        self._join()

    def _join(self) -> None:
        """Let the selectors that can choose goals serve the worlds."""
        current, own = self.goals.current, self.goals.own
        self.fear = learnt_fear(self._trained) or (self._fallback(self.env) if self._fallback else None)
        choices = {UNIFORM: uniform_goals(self.env)}
        if self._trained is not None:
            choices[self._run.config.label] = self._trained
        choices |= {name: attack.selector(self.env) for name, attack in self._attacks.items()}
        self.goals = Steered(choices)
        self.goals.current, self.goals.own = current if current in (*choices, BY_HAND) else UNIFORM, own
        self._loop = GoalLoop(self.env, self.goals, guard=self._guard)

    def add_attackers(
        self, attacks: Mapping[str, Attack], afraid: Callable[[Env], FearSelector] | None = None
    ) -> None:  # fmt: skip
        """Let attackers choose too; for the arguments see ``Session``, which may be without them until then."""
        self._attacks, self._fallback = dict(attacks), afraid
        self._join()

    def _stamps(self) -> list[tuple[int, int]]:
        """Marks that show whether the files of a run are those that were loaded."""
        try:
            found = [(self._run.folder.path / name).stat() for name in WATCHED]
        except OSError:
            return []
        return [(file.st_mtime_ns, file.st_ino) for file in found]

    def reload(self) -> bool:
        """Load the policy and the fear network again if the run has written new ones; returns whether it has.

        A shield is made for one policy and one fear network, so with a shield those that were loaded stay.
        """
        stamp = self._stamps()
        if self._stays or not stamp or stamp == self._stamp:
            return False
        if self._shield:
            self._stays = True
            _log.warning(
                "The run has written another policy, which its shield is not made for: the one of iteration %d stays.",
                self.iteration,
            )
            return False
        self._load()
        return True

    @property
    def names(self) -> list[str]:
        """Who can choose the goals."""
        return [*self.goals.choices, BY_HAND]

    @property
    def seconds_per_step(self) -> float:
        """Duration of a step as it is shown [s]: 1/50 in worlds without units of time."""
        return seconds_per_step(self.env)

    def choose(self, name: str) -> None:
        """Change who chooses the goals, from the next one on; by hand it begins with the active one.

        Raises:
            ValueError: If the name is not one of ``names``.
        """
        check_choice("goals", name, self.names)
        if name == BY_HAND and self.goals.current != BY_HAND:
            self.goals.own = self.env.goal[0].clone()
        self.goals.current = name

    @torch.no_grad()
    def ask(self, goal: Sequence[float]) -> None:
        """Give the first world a goal by hand, at once; the next ones of all worlds are the same.

        Args:
            goal: In physical units.
        """
        self.goals.own = torch.tensor(goal, dtype=torch.float32) * self._scale
        self.goals.current = BY_HAND
        self._loop.choose(self._rows)

    @torch.no_grad()
    def step(self) -> None:
        """One step of all worlds, with new goals and new episodes where they are due."""
        step = self.env.step(self._policy.scaled(self.env.obs))
        self.steps += 1
        self.crashes += int(step.terminated.sum())
        self.episodes += int((step.terminated | step.truncated).sum())
        self._loop.advance(step)

    def reset(self) -> None:
        """Begin new episodes in all worlds, and reset the counts."""
        self._loop.start()
        self._count_anew()

    def go_to(self, world: int) -> None:
        """Watch the world with another global number, from its beginning.

        Raises:
            ValueError: If the number is negative.
        """
        if world < 0:
            raise ValueError(f"world must be at least 0, got {world}.")
        self._build(world)
        self._join()
        self._count_anew()

    def _count_anew(self) -> None:
        self.crashes = self.steps = self.episodes = 0
        self.restarts += 1

    @property
    def refused(self) -> float | None:
        """Share of the goals since the policy was loaded that the shield refused, NaN before the first one.

        ``None`` without a shield.
        """
        return self._guard.refused if self._guard else None

    @property
    def goal(self) -> list[float]:
        """The active goal of the first world, in physical units."""
        return (self.env.goal[0] / self._scale).tolist()

    @torch.no_grad()
    def next_goal(self) -> list[float]:
        """What the first world would get if its next goal were due now, in physical units."""
        env, obs = self.env, self.env.obs[self._rows]
        # Drawing again gives the same goals.
        candidates = env.sample_goals(self._rows, self.goals.num_candidates, self.goals.goal_range())
        proposal = self.goals.propose(
            self._rows, env.state(obs), obs[:, env.goal_slice], candidates, env.draw(self._rows)
        )
        return (proposal.goal[0] / self._scale).tolist()

    def risk(self, goal: Sequence[float]) -> float | None:
        """Predicted probability that the policy crashes within T steps if the first world got a goal now.

        Args:
            goal: In physical units.

        Returns:
            In (0, 1); ``None`` without a fear network.
        """
        found = self._risks((torch.tensor(goal, dtype=torch.float32) * self._scale).view(1, 1, -1))
        return None if found is None else float(found[0, 0])

    @torch.no_grad()
    def _risks(self, candidates: Tensor) -> Tensor | None:
        """The same for many goals as the policy sees them, shape (1, n, goal_dim); returns shape (1, n)."""
        if self.fear is None:
            return None
        obs = self.env.obs[self._rows]
        score = self.fear.score(self.env.state(obs), obs[:, self.env.goal_slice], candidates)
        return self.fear.calibration.probability(score)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest value of every component of the first world's goals, in physical units."""
        box = self.env.goal_bounds(self._rows)
        if box is None:  # where not all goals of a box are valid, they are as far apart as some of them
            if self._extent is None:
                goals = self.env.sample_goals(self._rows, EXTENT)
                self._extent = goals.amin(1), goals.amax(1)
            box = self._extent
        return box[0][0] / self._scale, box[1][0] / self._scale

    def fear_map(self) -> FearMap | None:
        """The map of fear over ``axes``; ``None`` without a fear network."""
        first, second = self.axes
        low, high = self.bounds()
        goals = self.env.goal[0].expand(SIDE, SIDE, -1).clone()
        line = torch.linspace(0.0, 1.0, SIDE, dtype=torch.float32)
        for axis, shape in ((first, (1, SIDE)), (second, (SIDE, 1))):
            goals[..., axis] = ((low + (high - low) * line[:, None])[:, axis] * self._scale[axis]).view(shape)
        found = self._risks(goals.view(1, SIDE * SIDE, -1))
        if found is None:
            return None
        lowest, highest = ((float(end[first]), float(end[second])) for end in (low, high))
        return FearMap(self.axes, lowest, highest, found.view(SIDE, SIDE))


def prepare(
    run: SavedRun, names: Sequence[str], worlds: int, report: Callable[[str, float], None], pool: Path | None = None
) -> tuple[dict[str, Attack], Callable[[Env], FearSelector] | None]:
    """Let attackers learn about the policy of a run.

    Args:
        run: The run.
        names: The attackers.
        worlds: Worlds that they learn in.
        report: Called with the attacker and the share of its steps that are done.
        pool: The file of the attacker ``pooled``; ``None`` for the run's own.

    Returns:
        The attackers, and a function that makes a selector with the first fear network that one of them has learnt, and
        with the crash rate that it has met; ``None`` if none has learnt one.

    Raises:
        RunError: If an attacker is unknown, lacks what it needs, or is too slow to watch.
    """
    try:
        setting = replace(run.config.eval, attackers=tuple(names), worlds=worlds, pool=pool or run.config.eval.pool)
        require_heard(names, pool)
    except ValueError as error:
        raise RunError(str(error)) from error
    require_pool(setting)
    slow = [name for name in names if attacker(name).few_worlds]
    if slow:
        raise RunError(f"{slow[0]} tries every goal in clones of the world, which is too slow to watch.")
    env = run.build(1, 0, 0)
    policy = run.policy(env)
    target = make_target(policy.scaled, run.config.env, setting, env.device)
    learnt = target.learnt  # what one attacker has learnt is there for the others
    attacks = {}
    for name in names:
        attacks[name] = attacker(name).prepare(replace(target, progress=partial(report, name)))
    fitted = [(known.fear, known.facts) for known in learnt if known.fear.fitted]
    if not fitted:
        return attacks, None
    fear, facts = fitted[0]
    share = (facts["adversary_crashes"] + 0.5) / (facts["adversary_interactions"] + 1.0)

    def afraid(env: Env) -> FearSelector:
        selector = argmax_director(env, fear)
        selector.calibration.set_share(share)
        return selector

    return attacks, afraid
