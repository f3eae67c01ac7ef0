"""``deimos pool``: the network of the attacker ``pooled``, from runs whose policies it is not to attack."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from deimos.app import console
from deimos.app.findings import known
from deimos.checks import RunError
from deimos.files import require_place
from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run import training
from deimos.run.attackers.pooled import make_pool
from deimos.run.evaluation import EvalConfig, make_target
from deimos.run.folder import RunFolder
from deimos.sim.shared import one_stream


@dataclass(frozen=True, kw_only=True)
class PoolOptions:
    """Train a fear network on the crashes of some policies, to attack others with it (the attacker pooled)."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the runs: the more different methods, the better."""
    out: Path
    """File to write, which must not exist."""
    worlds: int = 2000
    """Worlds that each policy acts in."""
    adversary_steps: int = 1500
    """Steps of every world that are learnt from, of each policy."""
    device: str = "auto"
    """Where to simulate: cpu, cuda or cuda:N; auto takes the GPU where there is one."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("runs must be at least one folder, got none.")
        EvalConfig(worlds=self.worlds, adversary_steps=self.adversary_steps)


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos pool``."""
    options: PoolOptions = console.parse(PoolOptions, arguments, program)
    if options.out.exists():
        raise RunError(f"{options.out} exists and is not overwritten; choose another --out.")
    require_place(options.out)
    folders = [RunFolder.open(path) for path in options.runs]
    console.quiet_warp()
    device = training.resolve_device(options.device)
    sizes = EvalConfig(worlds=options.worlds, adversary_steps=options.adversary_steps)
    with one_stream(device), torch_on_one():
        targets = [
            make_target(load_policy(folder.path, str(device)).scaled, training.read_config(folder).env, sizes, device)
            for folder in folders
        ]
        facts = make_pool(targets, options.out)
    crashes, goals, quality = (facts[f"adversary_{name}"] for name in ("crashes", "interactions", "auroc"))
    print(f"{len(folders)} policies, {goals:,} goals, {crashes:,} crashes; AUROC on other worlds {known(quality)}")
    print(options.out)
