"""The panel next to the picture in the browser: the map of fear, the goals, and what a user can ask for."""

import math
import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from deimos.app.findings import percent, risk_name
from deimos.app.viewer_scene import Scene, palette, shades
from deimos.app.viewer_session import FearMap, Session
from deimos.nn.layout import GoalComponent

if TYPE_CHECKING:
    import mujoco

WIDTH = 330  # [pixels] of the panel
MAP = 250  # [pixels] along a side of the map
WHITE, ORANGE, CYAN = (1.0, 1.0, 1.0, 1.0), (1.0, 0.6, 0.0, 1.0), (0.3, 1.0, 1.0, 1.0)
Command = Callable[[Session], object]
"""What a user asks of a session."""


@dataclass(frozen=True)
class Moment:
    """What a panel and its picture show of one moment."""

    text: tuple[str, ...]
    """Lines on the state of the session."""
    names: list[str]
    """Who can choose the goals."""
    current: str
    """Who chooses them now."""
    world: int
    """Global number of the world."""
    paused: bool
    """Whether it is paused."""
    components: list[GoalComponent]
    """What the goal consists of."""
    low: list[float]
    """Lowest values of the goal, in physical units."""
    high: list[float]
    """Highest values of the goal, in physical units."""
    goal: list[float]
    """The active goal, in physical units."""
    next_goal: list[float]
    """What would come if the next goal were due now, in physical units."""
    risk_name: str
    """What ``risk``, ``next_risk`` and ``fear`` are called."""
    risk: float | None
    """Predicted probability that asking for the active goal now ends in a crash, in (0, 1)."""
    next_risk: float | None
    """The same for the next goal."""
    fear: FearMap | None
    """The map of fear."""
    axes: tuple[int, int]
    """Its two components of the goal."""
    shapes: "list[mujoco.MjvGeom]"
    """What is drawn on top of the model."""

    @classmethod
    def of(cls, session: Session, scene: Scene) -> "Moment":
        """What a session shows now."""
        low, high = session.bounds()
        goal, next_goal, fear = session.goal, session.next_goal(), session.fear_map()
        seconds = session.steps * session.seconds_per_step
        time_text = f"{seconds:.1f} s" if session.env.has_seconds else f"step {session.steps}"
        text: tuple[str, ...] = (
            f"{time_text}   crashes {session.crashes}   episodes {session.episodes}",
            f"T = {session.env.goal_period} steps   iteration {session.iteration}",
        )
        if session.refused is not None and not math.isnan(session.refused):
            text += (f"the shield has refused {percent(session.refused)} of the goals",)
        return cls(
            text=text, names=session.names, current=session.goals.current, world=session.world, paused=session.paused,
            components=session.components, low=low.tolist(), high=high.tolist(), goal=goal, next_goal=next_goal,
            risk_name="fear" if session.fear is None else risk_name(session.fear), risk=session.risk(goal),
            next_risk=session.risk(next_goal), fear=fear, axes=session.axes, shapes=scene.shapes(fear),
        )  # fmt: skip


class Panel:
    """Draws what it was last shown, and keeps what a user asks for.

    ``show``, ``commands`` and ``wait`` belong to the thread that simulates, the rest to that of the viewer.

    Args:
        scene: What the picture shows.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        """What the picture shows."""
        self._shown: Moment | None = None
        self._asked: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._colours = np.round(255 * palette()).astype(np.uint8)
        self._follows = True
        self._texture = 0
        self._drawn: FearMap | None = None  # what the texture shows
        self.frames = 0
        """Frames that were built for a browser."""

    def show(self, shown: Moment) -> None:
        """Show another moment from now on."""
        self._shown = shown

    def ask(self, command: Command) -> None:
        """Keep something that is asked for."""
        self._asked.put(command)

    def commands(self) -> Iterator[Command]:
        """What was asked for since the last call."""
        while not self._asked.empty():
            yield self._asked.get()

    @staticmethod
    def wait(seconds: float) -> None:
        """Leave the processor to the viewer."""
        time.sleep(seconds)

    def place_camera(self, viewer: Any) -> None:
        """Look at the robot, or at the whole box; the user moves the camera from there."""
        import mujoco
        from mujoco.studio import ux

        camera, scene = viewer.camera, self.scene
        camera.distance, camera.azimuth, camera.elevation = scene.distance, 130.0, scene.elevation
        follows = self._follows and scene.body > 0
        camera.type = int(mujoco.mjtCamera.mjCAMERA_TRACKING if follows else mujoco.mjtCamera.mjCAMERA_FREE)
        camera.trackbodyid = scene.body if follows else -1
        viewer.camera_index = ux.TRACKING_CAMERA_IDX if follows else ux.TUMBLE_CAMERA_IDX
        if not follows:
            camera.lookat[:] = viewer.data.xpos[scene.body]

    def draw(self, viewer: Any) -> None:
        """Build one frame of the panel."""
        from mujoco.studio import ux
        from mujoco.studio.dear_imgui import dear_imgui as imgui

        if not self.frames:
            ux.setup_theme(ux.GuiTheme.LIGHT)
        self.frames += 1
        shown = self._shown
        if shown is None:
            return
        viewer.extra_geoms[:] = shown.shapes
        imgui.SetNextWindowPos(imgui.Vec2(10, 10), int(imgui.Cond.FirstUseEver))
        imgui.SetNextWindowSize(imgui.Vec2(WIDTH, 0))
        imgui.Begin("Deimos", True, int(imgui.WindowFlags.NoSavedSettings))
        for line in shown.text:
            imgui.TextUnformatted(line)
        self._draw_buttons(imgui, shown, viewer)
        self._draw_goal(imgui, shown)
        self._draw_map(imgui, shown, viewer)
        imgui.End()

    def _draw_buttons(self, imgui: Any, shown: Moment, viewer: Any) -> None:
        """Pause, step, reset; the world, the camera, who chooses the goals; and the keys for them."""
        keys = not imgui.GetIO().WantCaptureKeyboard
        pressed = [keys and imgui.IsKeyChordPressed(key) for key in (imgui.Key.Space, imgui.Key.N, imgui.Key.R)]
        if imgui.Button("Go on (space)" if shown.paused else "Pause (space)") or pressed[0]:
            self.ask(lambda session: setattr(session, "paused", not session.paused))
        imgui.SameLine()
        if imgui.Button("Step (N)") or pressed[1]:
            self.ask(_step_once)
        imgui.SameLine()
        if imgui.Button("Reset (R)") or pressed[2]:
            self.ask(Session.reset)
        imgui.PushItemWidth(150)
        changed, world = imgui.InputInt("world", shown.world)
        if changed and world >= 0:
            self.ask(lambda session: session.go_to(world))
        changed, chosen = imgui.Combo("goals", shown.names.index(shown.current), shown.names)
        if changed:
            self.ask(lambda session: session.choose(shown.names[chosen]))
        imgui.PopItemWidth()
        if self.scene.body:
            changed, self._follows = imgui.Checkbox("follow", self._follows)
            if changed:
                self.place_camera(viewer)
        if self.scene.is_flat:
            imgui.SameLine()
            _, self.scene.has_tiles = imgui.Checkbox("tiles of fear", self.scene.has_tiles)

    def _draw_goal(self, imgui: Any, shown: Moment) -> None:
        """A slider per component of the goal: moving one chooses by hand."""
        imgui.SeparatorText("goal: move a slider to choose by hand")
        imgui.PushItemWidth(150)
        goal, is_moved = list(shown.goal), False
        for k, component in enumerate(shown.components):
            moved, goal[k] = imgui.SliderFloat(component.label, goal[k], shown.low[k], shown.high[k], "%.2f")
            is_moved = is_moved or moved
        imgui.PopItemWidth()
        if is_moved:
            self.ask(lambda session: session.ask(goal))
        if shown.risk is not None and shown.next_risk is not None:
            imgui.TextUnformatted(f"fear: this goal {percent(shown.risk)}, next {percent(shown.next_risk)}")

    def _draw_map(self, imgui: Any, shown: Moment, viewer: Any) -> None:
        """The map of fear, with the active goal in white and the next one in cyan; a click chooses by hand."""
        imgui.SeparatorText(shown.risk_name)
        if shown.fear is None:
            imgui.TextUnformatted("There is no fear network.")
            return
        if len(shown.components) > 2:
            self._draw_axes(imgui, shown)
        fear = shown.fear
        if fear is not self._drawn:
            picture = self._colours[shades(fear)[::-1]]  # the first row of a picture is its upper one
            opaque = np.concatenate([picture, np.full((*picture.shape[:2], 1), 255, np.uint8)], axis=2)
            side = len(opaque)
            self._texture = viewer.upload_image(self._texture, opaque.tobytes(), side, side, 4)
            self._drawn = fear
        corner = imgui.GetCursorScreenPos()
        imgui.Image(self._texture, imgui.Vec2(MAP, MAP))
        imgui.SetCursorScreenPos(corner)
        imgui.InvisibleButton("map", imgui.Vec2(MAP, MAP))  # else a click would move the panel
        for goal, colour, radius in ((shown.next_goal, CYAN, 4.0), (shown.goal, WHITE, 6.0)):
            right, up = fear.shares(goal)
            middle = imgui.Vec2(corner.x + MAP * right, corner.y + MAP * (1.0 - up))
            imgui.GetWindowDrawList().AddCircle(
                middle, radius, imgui.ColorConvertFloat4ToU32(imgui.Vec4(*colour)), 0, 2.5
            )
        if imgui.IsItemActive():
            mouse, goal = imgui.GetMousePos(), list(shown.goal)
            place = fear.at((mouse.x - corner.x) / MAP, 1.0 - (mouse.y - corner.y) / MAP)
            goal[fear.axes[0]], goal[fear.axes[1]] = place
            self.ask(lambda session: session.ask(goal))
        first, second = (shown.components[axis].label for axis in fear.axes)
        least, most = float(fear.probability.min()), float(fear.probability.max())
        imgui.TextUnformatted(f"right: {first}   up: {second}")
        imgui.TextUnformatted(f"dark {percent(least)}, bright {percent(most)}")
        imgui.TextUnformatted("white: goal, cyan: next")

    def _draw_axes(self, imgui: Any, shown: Moment) -> None:
        """Which two components of the goal the map is over."""
        names, axes = [component.label for component in shown.components], list(shown.axes)
        imgui.PushItemWidth(140)
        for k, label in enumerate(("##right", "##up")):
            if k:
                imgui.SameLine()
            changed, axes[k] = imgui.Combo(label, axes[k], names)
            if changed and axes[0] != axes[1]:
                self.ask(partial(_set_axes, axes=(axes[0], axes[1])))
        imgui.PopItemWidth()


def _set_axes(session: Session, axes: tuple[int, int]) -> None:
    session.axes = axes


def _step_once(session: Session) -> None:
    session.paused = True
    session.step()
