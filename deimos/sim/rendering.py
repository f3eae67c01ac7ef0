"""Pictures of a world: by MuJoCo if it simulates the world, otherwise as a drawing."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from deimos.checks import RunError
from deimos.sim.drawing import Drawing
from deimos.sim.env import Env

if TYPE_CHECKING:
    import mujoco

RED = np.array([0.9, 0.15, 0.1, 0.9], np.float32)


def choose_renderer() -> None:
    """Have MuJoCo render without a display, as MUJOCO_GL says or with EGL; call it before MuJoCo is imported."""
    if sys.platform.startswith("linux"):
        os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL") or "egl"


@contextmanager
def rendering() -> Iterator[None]:
    """Turn any error except a missing MuJoCo into a ``RunError`` that says how to render."""
    try:
        yield
    except Exception as error:  # from MuJoCo, PyOpenGL and what they load: ImportError, AttributeError, GLError, ...
        if isinstance(error, ModuleNotFoundError) and error.name == "mujoco":
            raise
        raise RunError(
            f"Nothing can be rendered with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({error}); "
            "install libegl1 or libosmesa6 and set MUJOCO_GL=egl or osmesa."
        ) from error


def load_renderer() -> None:
    """Import MuJoCo after ``choose_renderer``, which is when it loads its renderer.

    Raises:
        RunError: If nothing can be rendered here.
    """
    with rendering():
        import mujoco  # noqa: F401 (the import chooses the renderer)


def renderer(model: "mujoco.MjModel", width: int, height: int) -> "mujoco.Renderer":
    """A renderer of a model, for pictures of a size [pixels].

    Raises:
        RunError: If nothing can be rendered here.
    """
    import mujoco

    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    with rendering():
        return mujoco.Renderer(model, height, width)


@contextmanager
def view(env: Env, width: int, height: int) -> Iterator[Callable[[], np.ndarray]]:
    """Yields a function that renders world 0 as it is, uint8, shape (height, width, 3).

    Args:
        env: The environment.
        width: Width of a picture [pixels].
        height: Height of a picture [pixels].

    Raises:
        RunError: If the environment has nothing to show, or nothing can be rendered here.
    """
    if (shown := env.scene(0)) is None:
        if env.sketch(0) is None:
            raise RunError("This environment has nothing to render: neither a scene nor a sketch.")
        yield Drawing(env, width, height)
        return
    import mujoco

    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 1.8, 130.0, -18.0

    def picture() -> np.ndarray:
        found = env.scene(0)
        assert found is not None
        camera.lookat[:] = found[1].qpos[:3]
        drawn.update_scene(found[1], camera)
        point, scene = env.goal_point(0), drawn.scene
        if point is not None and scene.ngeom < scene.maxgeom:
            ball, size, turn = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.025, 0.0, 0.0]), np.eye(3).ravel()
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], ball, size, point.astype(float), turn, RED)
            scene.ngeom += 1
        return drawn.render()

    with renderer(shown[0], width, height) as drawn:
        yield picture
