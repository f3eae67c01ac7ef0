"""What a cell measures late in its training, while its worlds exist, without a trace in the training.

At five points of the last quarter a copy of the run goes on for T steps: what its selector chooses in some worlds is
compared with what would become of 50 candidates in clones of each, and its fear network is asked about a dangerous
place and a safe one.
"""

import copy
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from deimos.checks import RunError
from deimos.goals.fear import auroc
from deimos.goals.fear_selector import fear_selector
from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run.attack import uniform_goals
from deimos.run.audit import CANDIDATES, audit_choices, audit_clones
from deimos.run.folder import RunFolder
from deimos.run.loop import GoalLoop
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.env import Env, EnvConfig

POINTS = 5  # in the last quarter of a training
BINS = 12  # of either axis of a map
PLACES, SPAWNS = 64, 16  # worlds in which fear is asked about dangerous and safe places, and their fresh starts
WORLDS = 200  # in which speed is measured
SPEEDS = ("velocity", "linear_velocity")  # what environments call the velocity in their observations
FILE = "audits.json"


def points(iterations: int) -> list[int]:
    """Iterations after which a training of so many is audited: five points of its last quarter, the last at its end."""
    return sorted({round(iterations * (0.75 + 0.25 * (k + 1) / POINTS)) for k in range(POINTS)})


class Audits:
    """The audits of one cell, kept in its folder: an existing one is not made again.

    Args:
        home: The cell's folder.
        config: Its run.
        worlds: Worlds whose choices are audited, at least 0; 0 for no audits.
    """

    def __init__(self, home: RunFolder, config: TrainConfig, worlds: int) -> None:
        self._home, self._worlds = home, worlds
        self._points = points(config.iterations) if worlds else []
        self._copy: Trainer | None = None
        there = (home.path / FILE).exists()
        self._found: dict[str, dict] = home.read_json(FILE) if there else {}
        if not isinstance(self._found, dict):
            raise RunError(f"{home.path / FILE} must hold a table of audits, got {type(self._found).__name__}.")

    @torch_on_one()
    @torch.no_grad()
    def after(self, trainer: Trainer) -> None:
        """Audit a run if it is time to; the run does not change."""
        name = str(trainer.iteration)
        if trainer.iteration not in self._points or name in self._found:
            return
        if self._copy is None:
            self._copy = Trainer(trainer.config, trainer.env.device)
            self._clones = audit_clones(self._copy)
        self._copy.load_state_dict(copy.deepcopy(trainer.state_dict()))
        found = audit_choices(self._copy, self._worlds, self._clones)
        self._found[name] = {
            "exact_percentile": _mean(found.percentile), "exact_contexts": len(found.percentile),
            "auroc": _mean(found.auroc), "auroc_contexts": len(found.auroc), "risk": _risk(trainer),
            "goal_map": goal_map(found.place, found.chosen),
        }  # fmt: skip
        self._home.write_json(FILE, self._found)

    def row(self) -> dict:
        """The columns ``AUDITS`` of a training curve, except the speed."""
        rows = [self._found[str(point)] for point in self._points if str(point) in self._found]
        if not rows:
            return {}
        maps = [row["goal_map"] for row in rows if row["goal_map"]]
        columns = ("exact_percentile", "exact_contexts", "auroc", "auroc_contexts", "risk")
        return {name: [row[name] for row in rows] for name in columns} | {
            "goal_map": np.sum(maps, axis=0).tolist() if maps else []
        }


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


def _risk(trainer: Trainer) -> float:
    """How often fear at a dangerous place exceeds that at a safe one, over starts and goals, ties counting half."""
    afraid = fear_selector(trainer.loop.selector)
    if afraid is None or not afraid.fear.fitted:
        return math.nan
    env = trainer.config.env.for_evaluation().build(PLACES, trainer.env.device, trainer.config.seed)
    scores: list[Tensor] = []
    risky: list[Tensor] = []
    for _ in range(SPAWNS):
        contrast = env.risk_contrast()
        if contrast is None:
            return math.nan
        rows = torch.cat(contrast)
        obs, candidates = env.obs[rows], env.sample_goals(rows, CANDIDATES).clone()
        scores.append(afraid.score(env.state(obs), obs[:, env.goal_slice], candidates).flatten())
        dangerous = torch.arange(len(rows), device=env.device) < len(contrast[0])
        risky.append(dangerous.repeat_interleave(CANDIDATES))
        env.reset(torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
    return auroc(torch.cat(scores), torch.cat(risky))


def goal_map(place: Tensor, chosen: Tensor) -> list[int]:
    """Where goals were chosen, and how often: counts, rows by the place of a world, columns by that of its goal.

    Args:
        place: In [-1, 1], shape (n, k); the k axes count alike.
        chosen: The same for the goals.

    Returns:
        BINS x BINS counts, row by row; empty without goals.
    """
    if not len(place):
        return []
    x, y = (axis.flatten().double().cpu().numpy().clip(-1.0, 1.0) for axis in (place, chosen))
    counts, _, _ = np.histogram2d(x, y, bins=BINS, range=[[-1.0, 1.0], [-1.0, 1.0]])
    return counts.astype(int).flatten().tolist()


def diversity(counts: Sequence[float]) -> float:
    """How diverse the goals of a map are, given the place of the world.

    Returns:
        The conditional entropy H(goal | place) / log(BINS), in [0, 1]: 1 where goals are uniform, 0 where the place
        determines the goal. NaN for an empty map.
    """
    table = np.reshape(np.asarray(counts, float), (-1, BINS))
    if not table.sum():
        return math.nan
    share = table / table.sum()
    place = np.broadcast_to(share.sum(axis=1, keepdims=True), share.shape)
    there = share > 0
    return float(-(share[there] * np.log(share[there] / place[there])).sum() / math.log(BINS))


@torch_on_one()
@torch.no_grad()
def speed(run: RunFolder, env_config: EnvConfig, seed: int, device: torch.device) -> float:
    """Mean speed of a run's policy under uniform goals, over 2 T steps, in the units of its observations.

    NaN if its observations have no velocity.
    """
    policy = load_policy(run.path, str(device))
    env = env_config.for_evaluation().resolved(device).build(WORLDS, device, seed)
    seen = _velocity(env)
    if seen is None:
        return math.nan
    loop, total = GoalLoop(env, uniform_goals(env)), 0.0
    steps = 2 * env.goal_period
    for _ in range(steps):
        step = env.step(policy.scaled(env.obs))
        total += (step.obs[:, seen] / policy.scale[seen]).norm(dim=1).mean(dtype=torch.float64).item()
        loop.advance(step)
    return total / steps


def _velocity(env: Env) -> slice | None:
    start = 0
    for field in env.layout:
        if field.name in SPEEDS:
            return slice(start, start + field.size)
        start += field.size
    return None
