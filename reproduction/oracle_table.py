"""How many of the dangerous goals does a learnt fear network find? Prints the tables of docs/lab/selectors.md.

    python -m reproduction.oracle_table runs/population    # after reproduction.particle_population runs/population

For every policy that was trained in Directional under Uniform goals, a fear network is trained as for the Adversary.
Then all candidates of the decisions in 200 worlds under Uniform goals are tried in clones, so that every rule can be
asked what it would have chosen, by the network and by the truth; and three Adversaries choose all goals of 200 worlds.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
import warp as wp
from torch import Tensor

from deimos.goals import picks
from deimos.goals.fear import Fear
from deimos.goals.selector import GoalSelector, Proposal, uniform_proposal
from deimos.run.attack import argmax_director, learn_fear
from deimos.run.evaluation import EvalConfig, make_target, play
from deimos.run.folder import RunFolder
from deimos.run.oracle import Clones, Oracle
from deimos.run.training import load, read_config
from deimos.sim.env import Env

WORLDS, STEPS = 200, 1000
RULES: dict[str, tuple[picks.Rule, float]] = {
    "Uniform": ("percentile", 0.0), "p25": ("percentile", 25.0), "p75": ("percentile", 75.0),
    "p90": ("percentile", 90.0), "argmax": ("argmax", 0.0),
}  # fmt: skip


class Watcher(GoalSelector):
    """Uniform goals; it also records what every rule would have chosen, and with what outcome."""

    def __init__(self, env: Env, clones: Clones, fear: Fear) -> None:
        self.num_candidates = 100
        self.env, self.clones, self.fear = env, clones, fear
        self.crashed: dict[tuple[str, str], list[Tensor]] = {}

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``."""
        danger = (self.env.goal_period - self.clones.try_out(self.env, rows, candidates)).float()
        for known, score in (("learnt", self.fear.score(state, goal, candidates)), ("truth", danger)):
            for name, (rule, percentile) in RULES.items():
                pick = picks.by_rule(score, draws[:, 0], rule, percentile)
                self.crashed.setdefault((known, name), []).append(picks.take(danger, pick) > 0)
        return uniform_proposal(candidates, draws[:, 0])

    def rate(self, known: str, name: str) -> float:
        """Share of a rule's choices that would have crashed the policy."""
        return torch.cat(self.crashed[known, name]).float().mean().item()


def measure(path: Path) -> tuple[list[list[float]], list[float]]:
    """Crash rates on the same decisions, by rule and by source of knowledge; and those of three Adversaries."""
    folder = RunFolder.open(path)
    config = read_config(folder)
    policy = load(folder, config).ppo.actor
    env_config, evaluation, cpu = config.env.for_evaluation(), EvalConfig(), torch.device("cpu")

    def act(obs: Tensor) -> Tensor:
        with torch.no_grad():
            return policy(obs)

    def worlds() -> Env:
        return env_config.build(WORLDS, cpu, evaluation.seed)

    target = make_target(act, config.env, evaluation, cpu)
    fear, _ = learn_fear(target, 4 * target.steps, own_goals=True)
    clones = Clones(lambda count: env_config.build(count, cpu, evaluation.seed), act)
    env = worlds()
    watcher = Watcher(env, clones, fear)
    play(env, act, watcher, STEPS)
    same = [[watcher.rate(known, name) for known in ("learnt", "truth")] for name in RULES]
    env = worlds()
    closed = [play(env, act, argmax_director(env, fear), STEPS)["crash_rate"]]
    for known in (None, fear):
        env = worlds()
        closed.append(play(env, act, Oracle(env, clones, fear=known), STEPS)["crash_rate"])
    return same, closed


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    wp.config.quiet = True
    found = [measure(path) for path in sorted(parser.parse_args().root.glob("cells/directional-uniform-s*/run"))]
    same, closed = (np.array(part) for part in zip(*found, strict=True))
    print(f"Crashes per chosen goal on the same decisions, median over {len(found)} policies (min-max):\n")
    print("| rule | learnt fear | the truth |\n|---|---|---|")
    for i, name in enumerate(RULES):
        print(f"| {name} | {spread(same[:, i, 0])} | {spread(same[:, i, 1])} |")
    print("\nCrashes per goal of Adversaries that choose all goals:\n")
    print("| Adversary | crashes per goal |\n|---|---|")
    for i, name in enumerate(("learnt fear", "the truth, else chance", "the truth, else learnt fear")):
        print(f"| {name} | {spread(closed[:, i])} |")


def spread(values: np.ndarray) -> str:
    """Median and range."""
    return f"{np.median(values):.4f} ({values.min():.4f}-{values.max():.4f})"


if __name__ == "__main__":
    main()
