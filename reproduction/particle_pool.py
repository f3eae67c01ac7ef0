"""Train the policies that the attacker ``pooled`` learns from, and write its network for each variant of Particle.

    python -m reproduction.particle_pool runs/pool    # 30 training runs; writes reproduction/pool/VARIANT.pt

Five methods, from one that avoids dangerous goals to one that seeks them, each with two seeds that no study uses, so
that no evaluated policy has trained its own attacker. After an interruption the same command continues, and a file that
exists is not written again.
"""

import argparse
import hashlib
from dataclasses import replace
from pathlib import Path

import torch

from deimos.learn.policy import load_policy
from deimos.nn.threads import torch_on_one
from deimos.run.attackers.pooled import make_pool
from deimos.run.evaluation import EvalConfig, make_target
from deimos.run.trainer import TrainConfig
from deimos.sim.envs import particle
from reproduction.runs import finished

POOL = Path(__file__).parent / "pool"
VARIANTS = {  # with the thesis's budgets
    "directional": TrainConfig(env=particle.Config(variant="directional"), env_steps=2000, device="cpu", threads=1),
    "absolute": TrainConfig(env=particle.Config(variant="absolute"), env_steps=5000, device="cpu", threads=1),
    "relative": TrainConfig(env=particle.Config(variant="relative"), env_steps=2000, device="cpu", threads=1),
}
METHODS = ("uniform", "coop", "p25", "antagonist", "rnd")
SEEDS = (9001, 9002)


def pool(variant: str, root: Path) -> None:
    """Make the file of a variant, from runs in ``root``."""
    targets = []
    for seed in SEEDS:
        for method in METHODS:
            config = replace(VARIANTS[variant], method=method, seed=seed, evaluation=False)
            folder, _ = finished(config, root / f"{variant}-{method}-s{seed}")
            policy = load_policy(folder.path, "cpu").scaled
            targets.append(make_target(policy, config.env, EvalConfig(), torch.device("cpu")))
    with torch_on_one():
        print(variant, make_pool(targets, POOL / f"{variant}.pt"), flush=True)


def note_checksums() -> None:
    """Write the checksums of all pools, by which a test knows them."""
    sums = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(POOL.glob("*.pt"))}
    (POOL / "SHA256SUMS").write_text("".join(f"{digest}  {name}\n" for name, digest in sums.items()))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="where the runs are kept")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    options = parser.parse_args()
    for variant in options.variants:
        if not (POOL / f"{variant}.pt").exists():
            pool(variant, options.root)
    note_checksums()


if __name__ == "__main__":
    main()
