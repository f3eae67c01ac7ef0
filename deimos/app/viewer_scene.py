"""What a viewer shows of a session: a MuJoCo model with its data, and shapes that are drawn on top."""

import abc
from typing import TYPE_CHECKING, Any

import numpy as np

from deimos.app.viewer_session import FearMap, Session
from deimos.checks import RunError
from deimos.sim.env import Sketch

if TYPE_CHECKING:
    import mujoco

BLUE, ORANGE, RED = (0.0, 0.45, 0.70, 1.0), (0.90, 0.62, 0.0, 1.0), (0.85, 0.10, 0.10, 1.0)
GREY = (0.45, 0.48, 0.52, 1.0)
TILES = 11  # tiles of fear along each side of the square around a robot
AROUND = 0.8  # half side of that square [m]
FLAT = 1e-6  # largest difference of heights of a flat ground [m]
MARKS = 200  # ends of episodes that are marked, the last ones
TRAIL, STRIDE = 60, 3  # pieces of the trail of the first particle, and steps of each
EDGE, PARTICLE, GOAL = 0.006, 0.025, 0.03  # radii of what is drawn of a box of half side 1


def palette() -> np.ndarray:
    """Colours of fear from lowest to highest, float32 in [0, 1], shape (256, 3)."""
    from matplotlib import colormaps

    return colormaps["inferno"](np.linspace(0.1, 1.0, 256))[:, :3].astype(np.float32)


def shades(fear: FearMap) -> np.ndarray:
    """Place in the palette of the colour of each point of a map, in [0, 255], int64, shape (SIDE, SIDE).

    The colours span the map's own probabilities: those of a safe policy differ by little, and by place.
    """
    probability = fear.probability.numpy()
    low, high = probability.min(), probability.max()
    return np.round(255 * (probability - low) / max(high - low, 1e-6)).astype(np.int64)


class Scene(abc.ABC):
    """What is shown of the worlds of a session."""

    model: "mujoco.MjModel"
    data: "mujoco.MjData"
    distance: float
    """How far away the camera is [units of the model]."""
    elevation: float
    """Angle of the camera above the horizon, negative when it looks down [degrees]."""
    body: int
    """The body that a camera may follow; 0 where nothing is to be followed."""
    is_flat: bool = False
    """Whether it is a robot on flat ground, which can have tiles of fear."""
    has_tiles: bool = True
    """Whether there are tiles of fear on the ground around it."""

    @abc.abstractmethod
    def update(self) -> None:
        """Show the worlds as they are now; call it after every step."""

    @abc.abstractmethod
    def shapes(self, fear: FearMap | None) -> "list[mujoco.MjvGeom]":
        """What is drawn on top: the goal, and more; ``fear`` is the session's map of this moment."""


def build_scene(session: Session) -> Scene:
    """What can be shown of a session.

    Raises:
        RunError: If there is nothing.
    """
    if session.env.scene(0) is not None:
        return RobotScene(session)
    if session.env.sketch(0) is not None:
        return BoxScene(session)
    raise RunError("This environment has nothing to show: neither a scene nor a sketch.")


class RobotScene(Scene):
    """The first world of an environment with a ``scene``, with its goal and, on flat ground, tiles of fear.

    Args:
        session: The session.
    """

    distance, elevation = 1.8, -18.0

    def __init__(self, session: Session) -> None:
        self._session = session
        self._colours = palette()
        self.update()
        self.body = int(self.model.jnt_bodyid[0])
        terrain = getattr(session.env, "terrain", None)
        heights = np.zeros(1) if terrain is None else terrain.heights
        self.is_flat, self._ground = float(np.ptp(heights)) < FLAT, float(heights.max())

    def update(self) -> None:
        """See ``Scene.update``."""
        found = self._session.env.scene(0)
        assert found is not None
        self.model, self.data = found

    def shapes(self, fear: FearMap | None) -> "list[mujoco.MjvGeom]":
        """See ``Scene.shapes``."""
        shapes = []
        point = self._session.env.goal_point(0)
        if point is not None:
            shapes.append(sphere(point, 0.025, RED))
        if fear is not None and fear.axes == (0, 1) and self.is_flat and self.has_tiles:
            shapes += self._tiles(fear)
        return shapes

    def _tiles(self, fear: FearMap) -> "list[mujoco.MjvGeom]":
        """Tiles on the ground around the robot: a tile ahead is coloured by the fear of walking ahead, and so on."""
        import mujoco

        w, x, y, z = self.data.qpos[3:7]
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        shade = shades(fear)
        picked = np.round(np.linspace(0, len(shade) - 1, TILES)).astype(np.int64)
        side = AROUND / TILES
        tiles = []
        for row, second in zip(picked, np.linspace(-AROUND + side, AROUND - side, TILES), strict=True):
            for column, first in zip(picked, np.linspace(-AROUND + side, AROUND - side, TILES), strict=True):
                place = self.data.qpos[:3] + turn @ np.array([first, second, 0.0])
                place[2] = self._ground + 0.002  # what is as high as the ground would flicker
                colour = np.array([*self._colours[shade[row, column]], 0.75], np.float32)
                tile, size = mujoco.MjvGeom(), np.array([0.92 * side, 0.92 * side, 0.001])
                mujoco.mjv_initGeom(tile, mujoco.mjtGeom.mjGEOM_BOX, size, place, turn.ravel(), colour)
                tiles.append(tile)
        return tiles


class BoxScene(Scene):
    """Particles in their box, by the ``sketch`` of every world: their velocities, their goals, where episodes ended.

    Args:
        session: The session.
    """

    distance, elevation, body = 4.8, -20.0, 0

    def __init__(self, session: Session) -> None:
        import mujoco

        self._session = session
        self._sketches = self._look()
        self._velocity = np.zeros((len(self._sketches), 3))
        self._ends: list[np.ndarray] = []
        self._trail: list[np.ndarray] = []
        self._age, self._restarts = session.env.episode_step.tolist(), session.restarts
        self.model = _box(len(self._sketches)).compile()
        self.data = mujoco.MjData(self.model)
        self.update()

    def _look(self) -> list[Sketch]:
        """The sketches of all worlds."""
        found = [self._session.env.sketch(world) for world in range(self._session.env.num_envs)]
        return [sketch for sketch in found if sketch is not None]

    def update(self) -> None:
        """See ``Scene.update``."""
        import mujoco

        if self._session.restarts > self._restarts:  # no episode has ended
            self._ends.clear()
            self._trail.clear()
            self._velocity[:] = 0.0
            self._restarts = self._session.restarts
            self._sketches, self._age = self._look(), self._session.env.episode_step.tolist()
        before, self._sketches = self._sketches, self._look()
        age = self._session.env.episode_step.tolist()
        for world, (old, new) in enumerate(zip(before, self._sketches, strict=True)):
            place = new.position / new.half_side
            if age[world] < self._age[world]:  # another episode has begun
                self._ends.append(old.position / old.half_side)
                self._velocity[world] = 0.0
                if world == 0:
                    self._trail.clear()
            elif age[world] > self._age[world]:
                self._velocity[world] = place - old.position / old.half_side
                if world == 0 and age[0] % STRIDE == 0:
                    self._trail = [*self._trail[-TRAIL:], place]
            self.data.mocap_pos[world] = place
        del self._ends[:-MARKS]
        self._age = age
        mujoco.mj_forward(self.model, self.data)

    def shapes(self, fear: FearMap | None) -> "list[mujoco.MjvGeom]":
        """See ``Scene.shapes``."""
        shapes = []
        ahead = self._session.env.goal_period / 4  # steps that an arrow looks ahead
        for world, sketch in enumerate(self._sketches):
            place, target = self.data.mocap_pos[world], sketch.target / sketch.half_side
            faint = 1.0 if world == 0 else 0.45
            shapes.append(sphere(target, GOAL, (*ORANGE[:3], 0.8 * faint)))
            shapes.append(line(place, target, 0.003, (*ORANGE[:3], 0.6 * faint)))
            shapes.append(line(place, place + ahead * self._velocity[world], 0.012, (*BLUE[:3], faint), arrow=True))
        shapes += [line(a, b, 0.004, BLUE) for a, b in zip(self._trail, self._trail[1:], strict=False)]
        return shapes + [sphere(end, 0.025, RED) for end in self._ends]


def sphere(place: np.ndarray, radius: float, colour: tuple[float, ...]) -> "mujoco.MjvGeom":
    """A ball to draw.

    Args:
        place: Its middle, shape (3,).
        radius: Its radius, positive.
        colour: Red, green, blue and opacity, in [0, 1].
    """
    import mujoco

    ball = mujoco.MjvGeom()
    size, turn = np.array([radius, 0.0, 0.0]), np.eye(3).ravel()
    kind, paint = mujoco.mjtGeom.mjGEOM_SPHERE, np.array(colour, np.float32)
    mujoco.mjv_initGeom(ball, kind, size, np.asarray(place, np.float64), turn, paint)
    return ball


def line(
    start: np.ndarray, end: np.ndarray, width: float, colour: tuple[float, ...], *, arrow: bool = False
) -> "mujoco.MjvGeom":
    """A line or an arrow to draw.

    Args:
        start: Where it begins, shape (3,).
        end: Where it ends, shape (3,).
        width: Its radius, positive.
        colour: Red, green, blue and opacity, in [0, 1].
        arrow: Whether it ends in a point.
    """
    import mujoco

    kind = mujoco.mjtGeom.mjGEOM_ARROW if arrow else mujoco.mjtGeom.mjGEOM_CAPSULE
    geom, size, turn = mujoco.MjvGeom(), np.zeros(3), np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, kind, size, np.zeros(3), turn, np.array(colour, np.float32))
    mujoco.mjv_connector(geom, kind, width, np.asarray(start, np.float64), np.asarray(end, np.float64))
    return geom


def _box(particles: int) -> Any:
    """The model of a box of half side 1 with particles in it, as a MuJoCo specification."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.visual.headlight.ambient[:] = 0.45
    spec.visual.headlight.diffuse[:] = 0.5
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=64, height=384)
    sky.builtin, sky.rgb1[:], sky.rgb2[:] = mujoco.mjtBuiltin.mjBUILTIN_FLAT, 1.0, 1.0
    world, sphere = spec.worldbody, mujoco.mjtGeom.mjGEOM_SPHERE
    for axis in range(3):
        for corner in np.ndindex(2, 2):
            ends = np.insert(np.array([corner, corner], float) * 2.0 - 1.0, axis, [-1.0, 1.0], axis=1)
            world.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends.ravel(), size=[EDGE, 0, 0], rgba=GREY,
                contype=0, conaffinity=0,
            )  # fmt: skip
    floor = mujoco.mjtGeom.mjGEOM_BOX
    world.add_geom(
        type=floor, size=[1, 1, 0.002], pos=[0, 0, -1], rgba=[0.8, 0.82, 0.85, 0.6], contype=0, conaffinity=0
    )
    for number in range(particles):
        body = world.add_body(name=f"particle {number}", mocap=True)
        colour = BLUE if number == 0 else (0.45, 0.70, 0.88, 1.0)
        body.add_geom(type=sphere, size=[PARTICLE, 0, 0], rgba=colour, contype=0, conaffinity=0)
    return spec
