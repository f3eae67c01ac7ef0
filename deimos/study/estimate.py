"""How long the open cells of a study take, estimated before they start."""

import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from statistics import harmonic_mean, median

import torch

from deimos.checks import RunError, one_line
from deimos.nn.threads import on_threads
from deimos.run import training
from deimos.run.attack import attacker, uniform_goals
from deimos.run.audit import CANDIDATES
from deimos.run.config import kind
from deimos.run.evaluation import EvalConfig, play
from deimos.sim.shared import one_stream
from deimos.study.audits import points
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell
from deimos.study.results import Results

SECONDS = 10.0  # of training that a kind of cells is measured for, at most; a period of goals if that is less
PLAYED = 50  # steps of a policy that evaluations are measured by
MOST_KINDS = 16  # that are measured; others are taken to be as fast as their mean
OF_ORACLE = 100  # candidates that an attacker tries in clones
Kind = tuple[str, str]
"""Cells of equal speed: their setting, and the kind of their selector."""


@dataclass(frozen=True)
class Speed:
    """How fast a kind of cells is."""

    training: float
    """Transitions per second."""
    acting: float
    """World-steps per second of a policy that only acts."""


@dataclass(frozen=True)
class Estimate:
    """How long the cells of a study take."""

    text: str
    """A line on all of them."""
    seconds: dict[str, tuple[float, float]]
    """For every cell, by its name: seconds of a core for its training, and for everything else."""


def estimate(
    study: StudyFolder, cells: Iterable[Cell], *, elsewhere: bool = False, stopped: Callable[[], bool] = lambda: False
) -> Estimate:  # fmt: skip
    """Estimate how long unfinished cells of a study take; this measures kinds of cells for some seconds each.

    Of more than ``MOST_KINDS``, as a design over many settings has, a random sample is measured. Training is as fast as
    the finished cells of a kind were, if there are any, and acting as measured.

    Args:
        study: The study.
        cells: At least one cell.
        elsewhere: Whether other machines work on them: then what this one cannot run, for lack of a GPU, is left out.
        stopped: Called before a kind is measured; true leaves out those that are left.

    Raises:
        RunError: If a kind of cells cannot be run here, and not ``elsewhere``.
    """
    cells = list(cells)
    kinds: dict[Kind, list[Cell]] = defaultdict(list)
    for cell in cells:
        kinds[cell.setting, kind(cell.config.goals)].append(cell)
    ran: dict[Kind, list[float]] = defaultdict(list)
    results = study.results()
    for row in results.rows:
        ran[row["setting"], row["method"]].append(row["fps"])
    sample = random.Random(0).sample([*kinds], min(MOST_KINDS, len(kinds)))
    measures, reason = _measure_all({name: kinds[name][0] for name in sample}, elsewhere, stopped)
    costs = {cell.name: cost(study, cell, results) for cell in cells}
    trained, acted = (sum(steps) for steps in zip(*costs.values(), strict=True))
    learning = f"{len(cells)} run(s): {trained / 1e6:,.1f} M transitions"
    others = f"{acted / 1e6:,.1f} M world-steps of attacks, evaluations and audits"
    if not measures:
        return Estimate(f"{learning} + {others}; how long they take cannot be measured here ({reason})", {})
    mean = Speed(*(harmonic_mean([getattr(x, rate) for x in measures.values()]) for rate in ("training", "acting")))
    measured, seconds = False, {}
    for name, own in kinds.items():
        speed = measures.get(name, mean)
        for cell in own:
            known = [fps for fps in ran[cell.setting, cell.config.label] if fps > 0]
            measured |= not known
            transitions, steps = costs[cell.name]
            rate = median(known) if known else speed.training
            seconds[cell.name] = transitions / rate, steps / speed.acting
    each = "each kind" if len(measures) == len(kinds) else f"{len(measures)} of {len(kinds)} kinds"
    source = f"measured on a short run of {each}" if measured else "of the finished cells"
    hours = sum(map(sum, seconds.values())) / 3600
    return Estimate(f"{learning} (FPS {source}) + {others} = {hours:.2f} core-hours.", seconds)


def _measure_all(
    cells: Mapping[Kind, Cell], elsewhere: bool, stopped: Callable[[], bool]
) -> tuple[dict[Kind, Speed], str]:  # fmt: skip
    """The speeds of kinds of cells, and why the last one that cannot be run here cannot; see ``estimate``."""
    measures, reason = {}, ""
    for name, cell in cells.items():
        if stopped():
            break
        try:
            measures[name] = _measure(cell)
        except RunError as error:
            if not elsewhere:
                raise
            reason = one_line(error)
    return measures, reason


def cost(study: StudyFolder, cell: Cell, results: Results | None = None) -> tuple[int, int]:
    """Transitions that a cell still has to be trained for at most, and world-steps of everything else that it lacks.

    For ``results`` see ``StudyFolder.missing``.
    """
    config = cell.config
    if (study.cell_path(cell) / "result.json").exists():
        return 0, sum(evaluation_steps(config.eval, names) for names in study.missing(cell, results).values())
    transitions = config.iterations * config.ppo.num_steps * config.num_envs
    parts = [("naive", *config.eval.attackers)] + ([added] if (added := study.added(cell)) else [])
    evaluated = len(cell.goal_periods) * sum(evaluation_steps(config.eval, part) for part in parts)
    period = config.env.goal_period
    audited = len(points(config.iterations)) * period * (config.num_envs + cell.audit_worlds * CANDIDATES)
    return transitions, evaluated + (audited if cell.audit_worlds else 0)


def evaluation_steps(config: EvalConfig, goals: Iterable[str]) -> int:
    """World-steps of an evaluation under some goals, those that attackers learn from included.

    The scale of the score is not: all cells of a task share it.
    """
    total = 0
    for name in goals:
        worlds = config.worlds_against(name)
        tries = 0 if name == "naive" or not attacker(name).few_worlds else OF_ORACLE
        total += worlds * config.steps * (1 + tries)
        if name != "naive":
            total += config.worlds * attacker(name).learning_steps(config.adversary_steps)
    return total


def _measure(cell: Cell) -> Speed:
    """The speeds of a kind of cells, by a training that has just begun."""
    config = cell.config
    device = training.resolve_device(config.device)
    with on_threads(config.threads or 1), one_stream(device):
        trainer = training.build(config, device)
        trainer.iterate()  # compiles
        clock = time.monotonic if device.type == "cuda" else time.process_time  # others may use the cores too
        begin, done = clock(), 0
        while not done or (done * config.ppo.num_steps < config.env.goal_period and clock() - begin < SECONDS):
            trainer.iterate()
            done += 1
        rate = done * config.ppo.num_steps * config.num_envs / (clock() - begin)
        env = config.env.for_evaluation().resolved(device).build(config.eval.worlds, device, 0)
        begin = clock()
        play(env, trainer.ppo.actor, uniform_goals(env), PLAYED)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return Speed(rate, PLAYED * config.eval.worlds / (clock() - begin))
