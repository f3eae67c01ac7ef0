"""Cells on the machines of a Ray cluster. This is the only file that knows Ray.

Every machine must see the study's folder under the same path, and have the same Deimos installed. A machine that is
given a cell works on it as this one would, in a separate process (``deimos.study.engine.LocalProcesses``); Ray finds
the machine, and restarts a cell elsewhere, from its last checkpoint, if a worker or a machine is lost.
"""

import os
import threading
from pathlib import Path
from typing import Any

from deimos.checks import RunError, one_line
from deimos.study.engine import LocalProcesses
from deimos.study.folder import StudyFolder
from deimos.study.plan import Cell

RETRIES = 3  # of a cell whose worker or machine is lost


class OnRay:
    """An engine that gives each cell to a machine of a Ray cluster.

    The cluster is the one at ``RAY_ADDRESS`` or the one that runs on this machine; without either, Ray starts one here.
    A cell takes as many CPUs as it has threads, by default 1.

    Args:
        study: The study.
        gpus: GPUs per cell, at least 0; below 1 for several on one. ``None`` for 1 where a cell asks for CUDA.

    Raises:
        RunError: If there is no cluster at the address.
    """

    def __init__(self, study: StudyFolder, gpus: float | None = None) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray, self._study, self._gpus = ray, study, gpus
        try:
            ray.init(ignore_reinit_error=True, log_to_driver=False)
        except (ConnectionError, ray.exceptions.RayError, RuntimeError) as error:
            raise RunError(f"There is no Ray cluster to work on: {one_line(error)}") from error
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self._stop = ray.remote(num_cpus=0, scheduling_strategy=here)(_Stop).remote()
        # A worker of Ray's works on one cell: what libraries keep in a process, GPU memory too, is gone with it.
        self._task = ray.remote(max_calls=1, max_retries=RETRIES)(_work)
        self._lock = threading.Lock()
        self._running: set[Any] = set()
        self._stopping = False

    def room(self, cells: list[Cell]) -> int:
        """How many of these cells the cluster has room for at a time, as it is now; at least 1."""
        here = self._ray.cluster_resources()
        needs = [self._resources(cell) for cell in cells]
        fits = [
            int(here.get(kind, 0) // max(need[name] for need in needs))
            for kind, name in (("CPU", "num_cpus"), ("GPU", "num_gpus"))
            if any(need[name] for need in needs)
        ]
        return max(1, min([len(cells), *fits]))

    def lacking(self, cells: list[Cell]) -> str:
        """Which of these cells no machine of the cluster, as it is now, has room for; empty where each has one.

        Ray waits for such a machine silently, and forever unless the cluster grows.
        """
        machines = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        for cell in cells:
            cpus, gpus = (self._resources(cell)[name] for name in ("num_cpus", "num_gpus"))
            if not any(has.get("CPU", 0) >= cpus and has.get("GPU", 0) >= gpus for has in machines):
                return f"No machine of the Ray cluster has the {cpus} CPU(s) and {gpus:g} GPU(s) that {cell.name} takes"
        return ""

    def _resources(self, cell: Cell) -> dict[str, float]:
        gpus = float(cell.config.device.startswith("cuda")) if self._gpus is None else self._gpus
        return {"num_cpus": cell.config.threads or 1, "num_gpus": gpus}

    def run(self, cell: Cell) -> str | None:
        """See ``deimos.study.engine.Engine.run``."""
        with self._lock:
            if self._stopping:
                return None
            options = self._task.options(name=cell.name, **self._resources(cell))
            task = options.remote(str(self._study.path.resolve()), cell.name, self._stop, os.getcwd())
            self._running.add(task)
        try:
            return self._ray.get(task)
        except self._ray.exceptions.RayError as error:  # it was lost more often than it is retried, or cancelled
            return one_line(error) or type(error).__name__
        finally:
            with self._lock:
                self._running.discard(task)

    def stop(self) -> None:
        """See ``deimos.study.engine.Engine.stop``."""
        with self._lock:
            self._stopping = True
        self._ray.get(self._stop.set.remote())

    def kill(self) -> None:
        """See ``deimos.study.engine.Engine.kill``."""
        with self._lock:
            self._stopping = True
            for task in self._running:
                self._ray.cancel(task, force=True)


class _Stop:
    """An actor that lets workers wait until the study is to stop."""

    def __init__(self) -> None:
        import asyncio

        self._asked = asyncio.Event()

    async def set(self) -> None:
        self._asked.set()

    async def wait(self) -> None:
        await self._asked.wait()


def _work(study: str, name: str, stop: Any, working: str) -> str | None:
    """Work on a cell on the machine that Ray has chosen; see ``deimos.study.engine.Engine.run``.

    ``working`` is the runner's working directory, from which a study's files and plug-ins are found; where machines do
    not share it, the study must give their full paths.
    """
    import ray

    if os.path.isdir(working):
        os.chdir(working)  # Ray's is where `ray start` was called; this process works on this cell alone
    folder = StudyFolder(Path(study))
    engine = LocalProcesses(folder)
    asked = stop.wait.remote()

    def listen() -> None:
        ray.get(asked)
        engine.stop()

    threading.Thread(target=listen, daemon=True).start()
    try:
        return engine.run(folder.cell(name))
    except (OSError, RunError) as error:  # this machine does not see the folder
        return one_line(error)
