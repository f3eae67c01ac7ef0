"""Evaluate the policies of ``studies/legged.toml``, which were trained on the native engine, on mujoco-warp.

    python -m reproduction.legged_on_warp runs/legged runs/legged_on_warp    # repeat it to continue after a kill
    python -m reproduction.legged_on_warp runs/legged runs/legged_on_warp --methods uniform p75 --seeds 1-2

Uniform goals at T2, as in ``studies/legged_warp.toml``. The rows belong to a separate environment, ``quad_on_warp``, in
a folder that ``deimos study merge`` accepts. A policy whose row is in the tables of that folder is not evaluated again;
the study's policies may come from its archive (``deimos study unpack``).
"""

import argparse
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch

from deimos.checks import RunError
from deimos.run.evaluation import EvalConfig, evaluate_run
from deimos.run.folder import RunFolder
from deimos.sim.legged.config import LocomotionConfig
from deimos.sim.shared import one_stream
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell, parse_seeds
from deimos.study.results import SCHEMA, Results, Row, evaluated, identity
from deimos.study.source import check_sources
from reproduction.legged_bases import SHORT

ENVIRONMENT = "quad_on_warp"
EVALUATION = EvalConfig(worlds=200, steps=2700, attackers=())  # a robot on every tile


def on_warp(cell: Cell) -> Cell:
    """The cell of a policy's rows on mujoco-warp: a different engine and evaluation of the same training."""
    env = cast(LocomotionConfig, cell.config.env.with_goal_period(SHORT))
    config = replace(cell.config, env=replace(env, engine=cast(Any, "warp")), eval=EVALUATION)
    sources = {name: value for name, value in cell.sources.items() if name != "pool"}  # no attackers
    return replace(
        cell, environment=ENVIRONMENT, base_environment=ENVIRONMENT, config=config, goal_periods=(SHORT,),
        sources=sources,
    )  # fmt: skip


def judge(study: StudyFolder, out: StudyFolder, methods: Collection[str], seeds: Collection[int]) -> None:
    """Write the results of a study's finished policies of some methods and seeds (all if none are given) to ``out``.

    Raises:
        RunError: If there are no such policies, or different code trained them.
    """
    cells = [
        cell for cell in study.cells()
        if cell.environment == "quad" and (not methods or cell.config.label in methods)
        and (not seeds or cell.config.seed in seeds) and (study.cell_path(cell) / "result.json").exists()
    ]  # fmt: skip
    if not cells:
        raise RunError(f"{study.path} holds no finished policies of these methods and seeds.")
    device = torch.device("cpu")
    for cell in cells:
        run, own = RunFolder.open(study.cell_path(cell) / "run"), on_warp(cell)
        out.add([own])
        if not out.finished([own]):
            check_sources(f"Cell {cell.name}", {"code": cell.sources["code"]}, (), {})
            with one_stream(device):
                rows = evaluate_run(run, own.config.env, own.config.eval, device, again=False)
            write(study, cell, out, own, evaluated(own, run, rows, own.sources["code"]))
        print(own.name, flush=True)


def write(study: StudyFolder, cell: Cell, out: StudyFolder, own: Cell, rows: list[Row]) -> None:
    """Write the result of a policy on mujoco-warp; its training is as in the study.

    The run itself may have come from an archive, without its training curve.
    """
    trained = Results.of_cell(study.cell_path(cell))
    found = [row | {"fps": trained.rows[0]["fps"]} for row in rows]
    curve = trained.curves[0] | identity(own)
    RunFolder(out.cell_path(own)).write_json("result.json", {"schema": SCHEMA, "rows": found, "curve": curve})


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("out", type=Path, help="folder of the results, which is a study's too")
    parser.add_argument("--methods", nargs="+", default=[])
    parser.add_argument("--seeds", default="", help="of the bases, as a study has them")
    options = parser.parse_args()
    seeds = parse_seeds(options.seeds) if options.seeds else []
    judge(StudyFolder(options.study), StudyFolder(options.out), options.methods, seeds)


if __name__ == "__main__":
    main()
