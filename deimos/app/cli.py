"""The command line: one table of commands, one table of errors.

Whatever the user can mend (a flag, a folder, a disk, a missing package) ends in one line on stderr and exit code 2.
"""

import importlib.util
import sys
import threading

from deimos import __version__
from deimos.app import console
from deimos.checks import RunError, SimulationError

COMMANDS = {
    "train": ("deimos.app.train", "train a policy and evaluate it (also: python train.py)"),
    "evaluate": ("deimos.app.evaluate", "evaluate the policy of a run folder"),
    "study": ("deimos.app.study", "train and compare populations of policies"),
    "play": ("deimos.app.playback", "render a trained robot as a video"),
    "terrain": ("deimos.app.terrain", "generate terrain for legged robots (also: python -m terrain)"),
}
"""By name: the module whose ``main`` is the command, imported when it is asked for, and a line about it."""

EXTRAS = {
    "warp": "sim", "tyro": "sim", "rich": "sim", "tensorboard": "sim", "matplotlib": "sim", "PIL": "legged",
    "mujoco": "legged", "mujoco_warp": "legged", "trimesh": "legged", "imageio_ffmpeg": "legged", "scipy": "study",
}  # fmt: skip
"""The extra of ``deimos-rl`` that installs a package."""


def main(arguments: list[str] | None = None) -> int:
    """Run ``deimos``; returns the exit code.

    Args:
        arguments: The command line; ``None`` for that of the process.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    hook, threading.excepthook = threading.excepthook, _skip_file_errors
    try:
        _run(arguments)
    except (RunError, SimulationError) as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        return _fail(f"This needs {package}, which is not installed: pip install 'deimos-rl[{EXTRAS[package]}]'")
    except OSError as error:
        return _fail(f"{error.filename or 'A file'} could not be read or written ({error.strerror or error}).")
    except KeyboardInterrupt:
        _fail("Interrupted; files written so far are intact.")
        return 130
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    finally:
        threading.excepthook = hook
    return 0


def _run(arguments: list[str]) -> None:
    if arguments[:1] == ["--version"]:
        print(__version__)
        return
    if importlib.util.find_spec("tyro") is None:  # no command works on the base install
        raise ModuleNotFoundError("No module named 'tyro'", name="tyro")
    commands = {name: (about, _command(module)) for name, (module, about) in COMMANDS.items()}
    about = f"Deimos {__version__}: robot policies trained under a Director that chooses their goals by fear."
    console.dispatch(commands, about, arguments, "deimos")


def _command(module: str) -> console.Command:
    return lambda arguments, program: importlib.import_module(module).main(arguments, program)


def _skip_file_errors(thread: threading.ExceptHookArgs) -> None:
    """Say nothing of a full disk that TensorBoard's thread has met: it reports it to the main thread."""
    if not issubclass(thread.exc_type, OSError):
        threading.__excepthook__(thread)


def _fail(message: str) -> int:
    print(f"deimos: {' '.join(message.split())}", file=sys.stderr)
    return 2
