"""How does only shifting the goals affect the score? Uniform policies under goals of a rising percentile of fear.

    python -m reproduction.shifted_goals runs/population    # a finished study with Uniform policies; resumes

The policies of a Director were trained on dangerous goals and are evaluated on uniform ones; here policies that were
trained on uniform goals are evaluated on dangerous ones. Nothing learns: a fear network that was trained on the
finished policy, or the truth from clones of the worlds, ranks the candidates, and the Director's rules choose. The
percentile that a rule has delivered is measured. The rows, ``shifted_goals.csv``, are stored with those of the study,
and its report draws them.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from deimos.goals import picks
from deimos.goals.fear import Fear
from deimos.goals.selector import GoalSelector, Proposal
from deimos.learn.policy import load_policy
from deimos.run.attack import learn_fear
from deimos.run.evaluation import make_target, play, score_scale
from deimos.run.oracle import Clones
from deimos.sim.env import Env
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell
from deimos.study.results import Row, read_table, write_table

FILE = "shifted_goals.csv"
COLUMNS = {
    "environment": str, "goal_period": int, "seed": int, "fear": str, "rule": str, "percentile": float,
    "score": float, "crash_rate": float, "interactions": int,
}  # fmt: skip
RULES: dict[str, tuple[picks.Rule, float]] = {
    "coop": ("argmin", 0.0), **{f"p{p}": ("percentile", float(p)) for p in (0, 25, 50, 75, 90)},
    "antagonist": ("argmax", 0.0),
}  # fmt: skip
LONGER = (
    4  # times the steps of the thesis's Adversary, half of them under its own goals: for policies that seldom crash
)
EXACT_CANDIDATES = 25  # N when every candidate is tried in a clone

Danger = Callable[[Env, Tensor, Tensor, Tensor, Tensor], Tensor]
"""From worlds, rows, states, goals and candidates: how dangerous each candidate is, shape (B, N)."""


class Ranked(GoalSelector):
    """A Director's rule over a given danger, and the percentile of it that the rule has delivered.

    Args:
        env: The worlds whose goals it chooses.
        danger: The ranking of candidates.
        rule: How it picks; see ``picks.by_rule``.
        percentile: p, in [0, 100]; for the rule ``percentile`` only.
        candidates: N: uniform candidates per decision.
    """

    def __init__(self, env: Env, danger: Danger, rule: picks.Rule, percentile: float, candidates: int) -> None:
        self.num_candidates = candidates
        self._env, self._danger, self._rule, self._percentile = env, danger, rule, percentile
        self._delivered: list[Tensor] = []

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        score = self._danger(self._env, rows, state, goal, candidates)
        pick = picks.by_rule(score, draws[:, 0], self._rule, self._percentile)
        picked = picks.take(score, pick)
        self._delivered.append(picks.percentile(score, picked))
        return Proposal(picks.take(candidates, pick), picked, percentile=self._delivered[-1])

    @property
    def delivered(self) -> float:
        """Mean percentile of all goals so far, in (0, 100); NaN before the first."""
        return torch.cat([torch.empty(0), *self._delivered]).mean().item()


def learnt(fear: Fear) -> Danger:
    """The logits of a fear network."""
    return lambda env, rows, state, goal, candidates: fear.score(state, goal, candidates)


def exact(clones: Clones) -> Danger:
    """The sooner a clone crashes, the more dangerous; those that do not crash within T steps tie."""
    return lambda env, rows, state, goal, candidates: -clones.try_out(env, rows, candidates).float()


def evaluate(cell: Cell, run: Path, device: torch.device) -> list[Row]:
    """The rows of a policy: every rule, by learnt and by exact fear.

    Args:
        cell: How it was trained; its evaluation's sizes and seed are used.
        run: Its run folder.
        device: Where.
    """
    config = cell.config
    policy = load_policy(run, str(device))
    target = make_target(policy.scaled, config.env, config.eval, device)
    fear, _ = learn_fear(target, LONGER * target.steps, own_goals=True)
    clones = Clones(lambda count: target.build(count, target.seed), target.policy)
    measure, low, high = score_scale(target.build, config.eval)
    ways: dict[str, tuple[Danger, int, int]] = {"exact": (exact(clones), EXACT_CANDIDATES, config.eval.oracle_worlds)}
    if fear.fitted:
        ways["learnt"] = learnt(fear), 100, config.eval.worlds
    rows = []
    for name, (danger, candidates, worlds) in ways.items():
        for rule, (how, percentile) in RULES.items():
            env = target.build(min(worlds, config.eval.worlds), target.seed)
            selector = Ranked(env, danger, how, percentile, candidates)
            found = play(env, target.policy, selector, config.eval.steps)
            rows.append({
                "environment": cell.environment, "goal_period": env.goal_period, "seed": config.seed, "fear": name,
                "rule": rule, "percentile": selector.delivered, "crash_rate": found["crash_rate"],
                "interactions": found["interactions"], "score": (found[measure] - low) / (high - low),
            })  # fmt: skip
    return rows


def read(folder: Path) -> list[Row]:
    """The rows of a study's folder; none if they do not exist."""
    return read_table(folder / FILE, COLUMNS)


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="folder of the study")
    parser.add_argument("--method", default="uniform", help="whose policies (default: uniform)")
    parser.add_argument("--seeds", type=int, default=5, help="the first so many of each environment (default: 5)")
    options = parser.parse_args()
    wp.config.quiet = True
    study = StudyFolder(options.study)
    wanted = [cell for cell in study.cells() if cell.config.label == options.method]
    rows = read(options.study)
    for environment in dict.fromkeys(cell.environment for cell in wanted):
        own = [cell for cell in wanted if cell.environment == environment][: options.seeds]
        for cell in own:
            if not any((row["environment"], row["seed"]) == (environment, cell.config.seed) for row in rows):
                rows += evaluate(cell, study.cell_path(cell) / "run", torch.device("cpu"))
                write_table(options.study / FILE, COLUMNS, rows)
                print(f"{cell.name}: {len(rows)} rows in {options.study / FILE}")


if __name__ == "__main__":
    main()
