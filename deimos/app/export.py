"""``deimos export``: a policy as a folder that a robot's own software reads."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from deimos.app import console
from deimos.checks import RunError
from deimos.run.export import export_run
from deimos.run.folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Write the policy of a run for a deployment without Deimos: networks as ONNX, the robot as MJCF, and all numbers.

    The folder gets policy.onnx, fear.onnx if the run has a fear network, deploy.json, an example of a controller and,
    for robots, robot.xml and deploy.yaml.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    out: tyro.conf.Positional[Path]
    """Folder to write, which must not exist."""
    check: bool = False
    """Whether to run the files alone, by onnxruntime and MuJoCo, and compare: the same actions, and 64 robots that
    walk 10 s as they do here. The folder keeps what it was compared with, for a check elsewhere."""


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos export``."""
    options: ExportOptions = console.parse(ExportOptions, arguments, program)
    import onnx  # noqa: F401 (what is missing is reported before the work)

    if options.check:
        import onnxruntime  # noqa: F401
    console.quiet_warp()
    export_run(RunFolder.open(options.run), options.out, check=options.check)
    if not (options.out / "fear.onnx").exists():
        print("This run has learnt no fear network, so there is no fear.onnx.", file=sys.stderr)
    if options.check:
        check(options.out)
    print(options.out)


def check(folder: Path) -> None:
    """Run an exported folder's own check in a separate process, which imports nothing of ours.

    Raises:
        RunError: If it does not do what was exported.
    """
    sys.stdout.flush()
    # Not -I: what is installed for this user alone, or found by PYTHONPATH, is there for the check too.
    done = subprocess.run(
        [sys.executable, "-P", folder / "controller.py"], check=False, stdout=subprocess.PIPE, text=True
    )
    print(done.stdout, end="")
    if done.returncode:
        raise RunError(f"{folder} does not do what was exported; see above, and do not deploy it.")
