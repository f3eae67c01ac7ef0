"""``python -m benchmarks.faults KIND``: attack, and count the outcomes; resumable."""

import contextlib
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
import warp as wp

from benchmarks.faults import files, injections, kills, memory, options, tomls
from deimos.app.console import parse
from deimos.checks import RunError, check_at_least
from deimos.files import write_bytes
from deimos.run.training import provenance

KINDS = {
    "options": options, "tomls": tomls, "files": files, "injections": injections, "kills": kills, "memory": memory
}  # fmt: skip
"""By name: a module with ``COUNT``, how many attacks there are, and ``attack``, a ``trial.Attack``."""


@dataclass(frozen=True, kw_only=True)
class FaultOptions:
    """Attack Deimos. The same command continues an interrupted round; exit code 1 means that there were faults."""

    kind: tyro.conf.Positional[Literal["options", "tomls", "files", "injections", "kills", "memory"]]
    """What to attack with."""
    count: int | None = None
    """Attacks in all, at least 1. By default the module's ``COUNT``."""
    seed: int = 0
    """Seed of all attacks, at least 0; the i-th is drawn only from (seed, i)."""
    json: Path = Path("docs/results/bench_faults.json")
    """File of results, to which these are added."""

    def __post_init__(self) -> None:
        check_at_least("count", 1 if self.count is None else self.count, 1)
        check_at_least("seed", self.seed, 0)
        if not self.json.parent.is_dir():
            raise ValueError(f"json must be in a folder that exists, got {self.json}.")


def run(options: FaultOptions) -> dict[str, Any]:
    """Run the remaining attacks, and print the faults and the number of answers of each kind.

    Returns:
        The file's entry for this kind: how many attacks were ``done``, how many ``outcomes`` of each kind there were,
        and, ``kept``, the attacks that were faults or were measured.

    Raises:
        RunError: If the results of another seed are in the file.
    """
    kind = KINDS[options.kind]
    results = json.loads(options.json.read_text()) if options.json.exists() else {}
    known = results.setdefault(
        options.kind, {"seed": options.seed, "seconds": 0.0, "done": 0, "outcomes": {}, "kept": []}
    )
    if known["seed"] != options.seed:
        raise RunError(f"{options.json} holds attacks of seed {known['seed']}, got {options.seed}; use another file.")
    for number in range(known["done"], options.count or kind.COUNT):
        begin = time.monotonic()
        with tempfile.TemporaryDirectory() as place:
            rng = np.random.default_rng([options.seed, number])
            verdict = kind.attack(number, rng, Path(place))
        known["done"] += 1
        known["outcomes"][verdict.outcome] = known["outcomes"].get(verdict.outcome, 0) + 1
        if verdict.fault or verdict.figures:
            known["kept"].append({name: value for name, value in asdict(verdict).items() if value})
        known["seconds"] += time.monotonic() - begin
        known["versions"] = provenance()
        text = json.dumps(results, indent=1) + "\n"
        write_bytes(options.json, text.encode())
        if verdict.fault:
            print(f"{number}: {verdict.what}\n  {verdict.fault}: {verdict.said}", flush=True)
    print(options.kind, known["outcomes"], f"{known['seconds']:.0f} s")
    return known


def main(arguments: list[str]) -> int:
    """Run the command line; returns the exit code."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING
    with contextlib.redirect_stdout(sys.stderr):
        wp.init()
    try:
        found = run(parse(FaultOptions, arguments, "python -m benchmarks.faults"))
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return int(any("fault" in attack for attack in found["kept"]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
