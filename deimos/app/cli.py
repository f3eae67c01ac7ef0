"""The command line: one table of commands, one table of errors.

Whatever the user can fix (a flag, a folder, a disk, a missing package) ends in one line on stderr and exit code 2.
A process that runs ``main`` is a command's: its environment and its standard streams are set up here, and only here.
Importing the library leaves both alone; a program that shares its cores sets OMP_WAIT_POLICY=passive itself.
"""

import atexit
import contextlib
import gc
import importlib.util
import io
import os
import signal
import sys
import threading
import warnings

from deimos import __version__
from deimos.app import console
from deimos.checks import RunError, SimulationError

COMMANDS = {
    "train": ("deimos.app.train", "train a policy and evaluate it (also: python train.py)"),
    "evaluate": ("deimos.app.evaluate", "evaluate the policy of a run folder"),
    "pool": ("deimos.app.pool", "train the network of the attacker pooled on other runs"),
    "study": ("deimos.app.study", "train and compare populations of policies"),
    "play": ("deimos.app.playback", "show a trained policy at work, as a video or as pictures"),
    "view": ("deimos.app.view", "watch a policy in the browser and drive it, even while it trains"),
    "shield": ("deimos.app.shield", "calibrate a shield against goals that would crash a policy, and test it"),
    "export": ("deimos.app.export", "write a policy as ONNX, with all that a robot's controller needs"),
    "robot": ("deimos.app.robot", "check a robot of your own, and draft its file from an MJCF"),
    "doctor": ("deimos.app.doctor", "report what this machine has, and what works on it"),
    "terrain": ("deimos.app.terrain", "generate terrain for legged robots (also: python -m terrain)"),
}
"""By name: the module whose ``main`` is the command, imported when it is asked for, and a line about it."""

EXTRAS = {
    "warp": "sim", "tyro": "sim", "rich": "sim", "tensorboard": "sim", "matplotlib": "sim", "PIL": "legged",
    "mujoco": "legged", "mujoco_warp": "legged", "trimesh": "legged", "imageio_ffmpeg": "legged", "scipy": "study",
    "onnx": "export", "onnxruntime": "export", "yaml": "export",
    "ray": "cluster", "wandb": "wandb",
}  # fmt: skip
"""The extra of ``deimos-rl`` that installs a package."""

BROKEN_PIPE = 141  # a shell's exit code for a program that SIGPIPE ends


def main(arguments: list[str] | None = None) -> int:
    """Run ``deimos``; returns the exit code.

    Args:
        arguments: The command line; ``None`` for that of the process.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    _prepare_process()
    hook, threading.excepthook = threading.excepthook, _skip_file_errors
    spell, warnings.formatwarning = warnings.formatwarning, _spell_warning
    try:
        with console.on_signals(console.raise_stopped):
            _run(arguments)
        sys.stdout.flush()  # what cannot be written is reported here, and not by Python when it ends
    except BrokenPipeError:  # the reader has read enough
        return BROKEN_PIPE
    except (RunError, SimulationError) as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        package, _, part = (error.name or "").partition(".")
        if package not in EXTRAS:
            raise
        if part and importlib.util.find_spec(package) is not None:
            return _fail(f"This needs {error.name}, which the installed {package} does not have.")
        return _fail(f"This needs {package}, which is not installed: pip install 'deimos-rl[{EXTRAS[package]}]'")
    except ImportError as error:
        return _fail(f"{error.name or 'A library'} cannot be loaded ({error}).")
    except OSError as error:
        what = error.filename or "A file or the output"
        return _fail(f"{what} could not be read or written ({error.strerror or error}).")
    except KeyboardInterrupt as interrupt:
        number = interrupt.args[0] if isinstance(interrupt, console.Stopped) else signal.SIGINT
        _fail("Interrupted; files written so far are intact.")
        return 128 + number
    except (MemoryError, RuntimeError, ValueError) as error:
        if reason := _shortage(error):
            return _fail(reason)
        raise
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    finally:
        threading.excepthook, warnings.formatwarning = hook, spell
        _drop_broken_streams()
    return 0


def _shortage(error: BaseException) -> str:
    """What the system is short of, if that is what an error is about."""
    if "can't start new thread" in str(error):  # Python's words
        return "The system does not let this process start another thread; see ulimit -u, or use fewer --threads."
    if isinstance(error, MemoryError):
        return "There is not enough memory for this, or the limit of this process (ulimit -v) is too low."
    if isinstance(error.__cause__, OSError):  # how Warp says that one of its libraries did not fit
        return f"{str(error).rstrip('.')} ({error.__cause__})."
    from deimos.run.memory import is_shortage

    return f"There is not enough memory for this ({error})." if is_shortage(error) else ""


def _prepare_process() -> None:
    """Set up what torch and matplotlib read when they are loaded, and the standard streams."""
    # Threads that wait sleep: where cores are shared, those that spin cost more than they gain. A user's value stays.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    atexit.register(gc.freeze)  # Python would search torch's modules for garbage when it ends, half a second long
    os.environ["MPLBACKEND"] = "agg"  # commands draw into files; the back end of a notebook need not be installed here
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:  # closed: the next file that is opened would get its number, and everything written to it
            null = open(os.devnull, "w" if number else "r")
            os.dup2(null.fileno(), number)
            setattr(sys, name, null)
        elif number and isinstance(stream, io.TextIOWrapper):  # not stdin, which may have been read from
            stream.reconfigure(errors="backslashreplace")  # a path that this terminal cannot spell


def _drop_broken_streams() -> None:
    """Discard what can no longer be written; Python would complain about it when it ends."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _run(arguments: list[str]) -> None:
    try:
        os.getcwd()
    except FileNotFoundError as error:  # torch's libraries would end the process
        raise RunError("The working folder does not exist any more; change to one that does.") from error
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


def _spell_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """A warning in one line: users of a command need not know which line of the program it comes from."""
    return f"deimos: {' '.join(str(message).split())}\n"


def _skip_file_errors(thread: threading.ExceptHookArgs) -> None:
    """Print nothing about a full disk that TensorBoard's thread has met: it reports that to the main thread."""
    if not issubclass(thread.exc_type, OSError):
        threading.__excepthook__(thread)


def _fail(message: str) -> int:
    with contextlib.suppress(OSError):  # nobody reads it
        print(f"deimos: {' '.join(message.split())}", file=sys.stderr)
    return 2
