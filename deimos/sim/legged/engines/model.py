"""The model that both engines simulate: a robot on its ground, with the solver's options."""

from typing import TYPE_CHECKING

from deimos.sim.legged.engines import PhysicsConfig
from deimos.sim.legged.height_field import add_height_field
from deimos.sim.legged.robots import CONTACT_STIFFNESS, ROBOT_BIT, TERRAIN_BIT, VISUAL_GROUP, Robot
from deimos.terrain import Terrain

if TYPE_CHECKING:
    import mujoco

FINEST_CELL = 0.05  # [m] of a height field, on which no geom of a robot covers more than the 50 prisms that are tested


def build_spec(
    robot: Robot, terrain: Terrain | None, config: PhysicsConfig, *, visual: bool
) -> "mujoco.MjSpec":  # fmt: skip
    """The specification of the model, with its visual geoms for rendering or without them for simulation.

    Raises:
        ValueError: If the terrain's cells are finer than ``FINEST_CELL``.
    """
    if terrain is not None and terrain.cell < (1 - 1e-6) * FINEST_CELL:
        raise ValueError(
            f"terrain must have cells of at least {FINEST_CELL} m under a robot, got {terrain.cell:g} m; on "
            f"finer ones the simulator loses contacts. Build it with --cell {FINEST_CELL}, or import it with "
            f"--resolution {FINEST_CELL}."
        )
    spec = robot.spec.copy()
    for geom in [geom for geom in spec.geoms if geom.group == VISUAL_GROUP and not visual]:
        spec.delete(geom)  # before there is a height field: with one, each takes 50 ms
    _add_ground(spec, terrain)
    _set_options(spec, config)
    return spec


def _add_ground(spec: "mujoco.MjSpec", terrain: Terrain | None) -> None:
    """Add a ground without its own friction: that of the feet counts."""
    import mujoco

    if terrain is None:
        ground = spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 0.05))
    else:
        ground = add_height_field(spec, terrain)
    ground.contype, ground.conaffinity, ground.condim = TERRAIN_BIT, ROBOT_BIT, 1
    ground.solref = CONTACT_STIFFNESS
    _dress(spec, ground)


def _dress(spec: "mujoco.MjSpec", ground: "mujoco.MjsGeom") -> None:
    """Add daylight, a sky and a chequered ground, which shows how the robot moves over it."""
    import mujoco

    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.45,) * 3, (0.35,) * 3, (0.1,) * 3
    light = spec.worldbody.add_light(pos=(0.0, 0.0, 4.0), dir=(-0.3, 0.4, -1.0), castshadow=False)
    light.type, light.diffuse = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, (0.5,) * 3
    texture = mujoco.mjtTexture
    spec.add_texture(
        name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.78, 0.85, 0.93), rgb2=(0.95, 0.97, 1.0), width=64, height=64,
    )  # fmt: skip
    spec.add_texture(
        name="squares", type=texture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.62, 0.66, 0.7), rgb2=(0.55, 0.59, 0.64), width=256, height=256,
    )  # fmt: skip
    material = spec.add_material(name="ground", texuniform=True, texrepeat=(1.0, 1.0))
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
    ground.material = "ground"


def _set_options(spec: "mujoco.MjSpec", config: PhysicsConfig) -> None:
    """Set Newton's solver with pyramidal friction cones, implicit in the joints' damping."""
    import mujoco

    option = spec.option
    option.timestep = config.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.impratio = 1.0
    option.iterations = config.iterations
    option.ls_iterations = config.line_search
    option.ccd_iterations = 20
