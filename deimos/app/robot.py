"""``deimos robot``: draft a robot's file from an MJCF, and check a robot: what is missing or odd, with a picture."""

import contextlib
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro

from deimos import plugins
from deimos.app import console
from deimos.app.console import number, table
from deimos.checks import RunError
from deimos.files import require_place, write_whole
from deimos.sim.drawing import with_caption
from deimos.sim.legged import mjcf, robot_draft, robot_file, robots
from deimos.sim.legged.robot_check import LEGS, PARTS, SECONDS, Report, check_robot
from deimos.sim.legged.robots import COLLISION_GROUP, VISUAL_GROUP, Robot
from deimos.sim.rendering import choose_renderer, load_renderer, renderer

if TYPE_CHECKING:
    import mujoco

SIZE = 480  # [pixels] of either side of each of the two views
SEEN = 3.2  # distance of the camera, in heights of the base
DRAWN_BY = "deimos robot check"  # the software that a picture names
COLOURS = {"base": (0.85, 0.2, 0.15, 1.0), "feet": (0.1, 0.6, 0.25, 1.0), "limbs": (0.2, 0.4, 0.8, 1.0)}


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Check a robot: let it stand for two seconds, and say what is missing or odd.

    Ends with exit code 0 if it can be trained, and 1 if it cannot.
    """

    robot: tyro.conf.Positional[str]
    """A robot file (.toml), an MJCF (.xml), or the name of a robot that comes with Deimos."""
    held: tuple[str, ...] = ()
    """Joints of an MJCF that are held at zero: of a head, a tail, an arm."""
    engine: Literal["native", "warp"] = "native"
    """What simulates it; warp, mujoco-warp, compiles for a minute or two first."""
    picture: Path | None = None
    """PNG file for the picture: the robot next to its collision geometry. By default NAME.png here. A picture of an
    earlier check is replaced, another file is not."""


@dataclass(frozen=True, kw_only=True)
class NewOptions:
    """Write a robot file to start from: what an MJCF says, and guesses for the rest."""

    mjcf: tyro.conf.Positional[Path]
    """The MJCF (.xml) of a quadruped."""
    held: tuple[str, ...] = ()
    """Joints that are held at zero: of a head, a tail, an arm."""
    out: Path | None = None
    """The file (.toml), which must be next to the MJCF. By default the MJCF's name with .toml."""
    force: bool = False
    """Overwrite what exists."""


def main(arguments: list[str], program: str) -> None:
    """Run ``deimos robot``."""
    commands = {
        "new": ("write a robot file to start from: deimos robot new scout.xml", write_draft),
        "check": ("say what is missing or odd, and draw it: deimos robot check scout.toml", check),
    }
    try:
        console.dispatch(commands, "Makes a robot from your own MJCF.", arguments, program)
    except ValueError as error:  # a file that is not a robot's
        raise RunError(str(error)) from error


def write_draft(arguments: list[str], program: str) -> None:
    """Write a robot file."""
    options: NewOptions = console.parse(NewOptions, arguments, program)
    out = options.out or options.mjcf.with_suffix(".toml")
    if out.suffix != ".toml" or out.parent.resolve() != options.mjcf.parent.resolve():
        raise RunError(f"out must be a .toml file in the folder of {options.mjcf}, got {out}.")
    if out.exists() and not options.force:
        raise RunError(f"{out} exists and is not overwritten; choose another name, or add --force.")
    drafted, notes = robot_draft.draft(options.mjcf, options.held)
    write_whole(out, lambda file: file.write(robot_file.to_toml(drafted).encode()))
    print(*[f"note: {note}." for note in notes], out, sep="\n")


def check(arguments: list[str], program: str) -> None:
    """Check a robot; ends the process with 1 if it has faults."""
    options: CheckOptions = console.parse(CheckOptions, arguments, program)
    path = options.picture or Path(f"{Path(options.robot).stem}.png")
    _check_picture(path)
    choose_renderer()
    load_renderer()
    console.quiet_warp()
    robot, notes = _load(options)
    report = check_robot(robot, options.engine)
    _say(robot, report, notes)
    _draw(path, robot, report)
    print(path)
    if report.faults:
        raise SystemExit(1)


def _load(options: CheckOptions) -> tuple[Robot, list[str]]:
    """The robot that is asked for, and notes on its file."""
    path = Path(options.robot)
    if options.held and path.suffix.lower() != ".xml":
        raise RunError("held is for an MJCF; a robot file names the joints that it holds.")
    if path.suffix.lower() in robot_file.ENDINGS:
        with robot_file.opened(path) as (described, folder):
            return described.build(folder), list(mjcf.read(folder / described.mjcf, described.held).notes)
    if path.suffix.lower() == ".xml":
        drafted, notes = robot_draft.draft(path, options.held)
        return drafted.build(path.parent), [*notes, f"deimos robot new {path} writes these values to a file"]
    return plugins.load(robots, options.robot).build(), []


def _say(robot: Robot, report: Report, notes: list[str]) -> None:
    """Print what the robot is, and what was found."""
    model, standing = report.physics.model, report.standing
    base = model.body(model.jnt_bodyid[0])
    print(
        f"{base.subtreemass[0]:.3g} kg, of which base '{base.name}' {base.mass[0]:.3g} kg; it stands "
        f"{robot.standing_height:.3f} m high and starts at {robot.spawn_height:.3f} m"
    )
    legs = [f"{leg} {part}" for leg, part in itertools.product(LEGS, PARTS)]
    labels = [*legs, *["arm"] * (len(robot.joints) - len(legs))]
    rows = [
        [label, joint.name, number(joint.pose), f"{joint.range[0]:.3g} to {joint.range[1]:.3g}",
         f"{joint.stiffness:g}, {joint.damping:g}", f"{standing.torque[i]:.1f} of {joint.max_torque:g}"]
        for i, (label, joint) in enumerate(zip(labels, robot.joints, strict=True))
    ]  # fmt: skip
    header = ("", "joint", "pose [rad]", "range [rad]", "gains [N m/rad, N m s/rad]", "torque [N m]")
    feet = ", ".join(f"{leg} {' '.join(part)}" for leg, part in zip(LEGS, robot.parts[1:5], strict=True))
    loads = ", ".join(f"{force:.0f}" for force in standing.force[1:5])
    print("", table(header, rows), "", f"feet: {feet}", sep="\n")
    print(
        f"after {SECONDS:g} s in its pose: base at {standing.height:.0%} of its height, tilted by "
        f"{np.degrees(standing.tilt):.1f} degrees; {loads} N on the feet"
    )
    for kind, texts in (("note", notes), ("odd", report.oddities), ("fault", report.faults)):
        print(*[f"{kind}: {text}." for text in texts], sep="\n", end="\n" if texts else "")
    print("It cannot be trained like this." if report.faults else "It stands, and can be trained.")


def _check_picture(path: Path) -> None:
    """Raise ``RunError`` unless a picture can be written there: to a new file, or over one of an earlier check."""
    from PIL import Image

    if path.suffix.lower() != ".png":
        raise RunError(f"picture must end in .png, got {path}.")
    require_place(path)
    if not path.exists():
        return
    with contextlib.suppress(Exception), Image.open(path) as found:  # a foreign file may raise anything
        if found.info.get("Software") == DRAWN_BY:
            return
    raise RunError(f"{path} exists and is not overwritten: it is not a picture of a check; choose another --picture.")


def _draw(path: Path, robot: Robot, report: Report) -> None:
    """Write a picture of the robot as it stands: its looks to the left, what collides to the right."""
    import mujoco
    from PIL import Image, PngImagePlugin

    model, data = report.physics.model, report.physics.to_mujoco(0)
    _colour(model, robot)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = 130.0, -18.0, SEEN * robot.standing_height
    camera.lookat[:] = *data.qpos[:2], robot.standing_height / 2
    views = []
    with renderer(model, SIZE, SIZE) as drawn:
        for group, text in ((VISUAL_GROUP, "looks"), (COLLISION_GROUP, "collides: base red, feet green, limbs blue")):
            shown = mujoco.MjvOption()
            shown.geomgroup[:] = [1, 1, 0, 0, 0, 0]  # the ground's
            shown.geomgroup[group] = 1
            drawn.update_scene(data, camera, shown)
            views.append(with_caption(drawn.render(), text))
    notes = PngImagePlugin.PngInfo()
    notes.add_text("Software", DRAWN_BY)
    write_whole(path, lambda file: Image.fromarray(np.hstack(views)).save(file, "PNG", pnginfo=notes))


def _colour(model: "mujoco.MjModel", robot: Robot) -> None:
    """Colour what collides by what it counts as."""
    for kind, parts in (("base", robot.parts[:1]), ("feet", robot.parts[1:5]), ("limbs", robot.parts[5:])):
        for name in itertools.chain.from_iterable(parts):
            model.geom_rgba[model.geom(name).id] = COLOURS[kind]
