"""The generator: what it writes, what it says, and what it refuses."""

import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from deimos.terrain import catalog, export, presets
from deimos.terrain.world import build_with_mesh
from PIL import Image

from deimos import terrain
from deimos.app import cli

ENDINGS = (".stl", ".obj", ".ply", ".glb", ".npz", ".png")
SMALL = ["--levels", "2", "--columns", "3", "--cell", "0.2", "--border", "1"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def small():
    """A small grid, its terrain and its mesh."""
    grid = presets.preset("go1", levels=2, columns=3, cell=0.2, border=1.0)
    return (grid, *build_with_mesh(grid))


def run(*arguments):
    """The tool's exit code."""
    return cli.main(["terrain", *map(str, arguments)])


def test_every_shape_and_preset_is_named(capsys):
    """``shape`` lists every shape with a line about it, and the help of ``grid`` names every preset."""
    assert run("shape") == 0
    said = capsys.readouterr().out
    for name in catalog.names():
        assert f"\n  {name} " in said
        assert (type(catalog.make(name)).__doc__ or "").splitlines()[0] in " ".join(said.split())
    assert run("grid", "--help") == 0
    said = capsys.readouterr().out
    for name in presets.preset_names():
        assert name in said


def test_list_names_everything(capsys):
    """Every shape, every parameter with its default, and every preset is listed."""
    assert run("list") == 0
    said = capsys.readouterr().out
    lines = said.splitlines()
    for name in catalog.names():
        shown = lines[next(i for i, line in enumerate(lines) if line.startswith(f"{name}: ")) + 1]
        words = [word for word in shown.split() if word.startswith("--")]
        assert words == [f"--{key}" for key in catalog.make(name).parameters()]
    low, high = catalog.make("stairs-up").height
    assert f"--height {low:g} {high:g} " in said
    for name in presets.preset_names():
        assert f"preset {name}: " in said


@pytest.mark.parametrize("name", catalog.names())
def test_every_parameter_is_explained(capsys, name):
    """The help of a shape shows its parameters with their defaults; its direction is in its name."""
    assert run("shape", name, "--help") == 0
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    shape = catalog.make(name)
    for field in shape.parameters():
        value = getattr(shape, field)
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        assert re.search(rf" --{field} .*?\(default: {re.escape(shown)}\)", said), field
    assert "--direction" not in said


def test_everything_is_written_at_once(folder, small, capsys):
    """One call writes the mesh in four formats, the terrain, its grey values, a MuJoCo model and a picture."""
    files = [f"ground{ending}" for ending in ENDINGS]
    assert run("grid", *SMALL, "--out", *files, "--mjcf", "model", "--preview", "view.png") == 0
    assert sorted(path.name for path in folder.iterdir()) == sorted([*files, "model", "view.png"])
    said = capsys.readouterr().out
    for word in ("extents", "steepest slope", "highest riser", "vertices", "samples", "time", *files, "model"):
        assert word in said
    _, ground, mesh = small
    assert terrain.load("ground.npz").heights.tobytes() == ground.heights.tobytes()
    for ending in (".stl", ".obj", ".ply", ".glb"):
        loaded = trimesh.load(f"ground{ending}", force="mesh", process=False)
        assert len(loaded.faces) == len(mesh.faces)
        bounds = np.array(mesh.bounds)
        if ending == ".glb":  # y is up in glTF, and z points to the viewer
            bounds = np.stack([bounds[:, 0], bounds[:, 2], -bounds[::-1, 1]], axis=1)
        np.testing.assert_allclose(loaded.bounds, bounds, rtol=1e-6, atol=1e-6)
    with Image.open("view.png") as picture:
        assert min(picture.size) > 300
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 100


def test_shapes_that_get_no_column_are_said(folder, capsys):
    """A preset on few columns has none for its smaller shares, and the report counts them."""
    assert run("grid", "--levels", "1", "--columns", "4", "--cell", "0.5", "--border", "1", "--out", "few.npz") == 0
    columns = "1 slope-up, 0 slope-down, 0 rough-slope-down, 2 stairs-up, 1 stairs-down, 0 discrete"
    assert f"columns            {columns}\n" in capsys.readouterr().out
    assert terrain.load("few.npz").shapes == ("slope-up", "stairs-up", "stairs-up", "stairs-down")


@pytest.mark.parametrize("ending", [".stl", ".obj", ".ply", ".glb", ".npz", ".png"])
def test_what_was_written_is_imported(folder, small, capsys, ending):
    """``import`` gives back the terrain that ``grid`` has written; by default as NAME.npz in the current folder."""
    (folder / "elsewhere").mkdir()
    assert run("grid", *SMALL, "--out", f"elsewhere/ground{ending}") == 0
    resolution = ["--resolution", "0.2"] if ending in (".stl", ".obj", ".ply", ".glb") else []
    capsys.readouterr()
    assert run("import", f"elsewhere/ground{ending}", *resolution) == 0
    said = capsys.readouterr().out
    ground, found = small[1], terrain.load("ground.npz")
    assert found.corner == pytest.approx(ground.corner, abs=1e-6)
    assert found.cell == pytest.approx(ground.cell)
    atol = 0.51 * float(np.ptp(ground.heights)) / 65535 if ending == ".png" else 0.0
    np.testing.assert_allclose(found.heights, ground.heights, rtol=0, atol=atol)
    nx, ny = ground.heights.shape
    assert f"{nx:,} x {ny:,} samples" in said
    assert said.splitlines()[-1] == "ground.npz"


def test_ground_from_elsewhere_becomes_everything(folder, capsys):
    """An array of heights becomes a mesh, a model and a picture, with tiles of the size that was asked for."""
    heights = np.zeros((41, 21))
    heights[10:20] = 0.3
    np.save("dig.npy", heights)
    options = "--resolution 0.1 --tile 1 --out dig.stl --mjcf model --preview dig.png".split()
    assert run("import", "dig.npy", *options) == 0
    said = capsys.readouterr().out
    assert "4 x 2 of 1 m" in said
    assert "0.000 to 0.300" in said
    assert sorted(path.name for path in folder.iterdir()) == ["dig.npy", "dig.png", "dig.stl", "model"]
    np.testing.assert_allclose(np.ptp(trimesh.load("dig.stl").bounds, axis=0), [4.0, 2.0, 0.3], rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("nowhere.stl", "nowhere.stl could not be read or written (No such file or directory)"),
        ("notes.txt", "A file to import must end in one of .glb, .obj"),
        ("broken.png", "broken.png cannot be imported: it is not a picture, or it is broken"),
        ("flat.npy --resolution 0", "resolution must be finite and positive, got 0.0"),
        ("flat.npy --height-range 0 1", "height_range does not apply to flat.npy"),
        ("flat.npy --out there.npz", "there.npz exists and is not overwritten"),
    ],
)
def test_what_is_no_ground_is_not_imported(folder, capsys, arguments, message):
    """One line says what is wrong with a file or an option, and nothing is written."""
    np.save("flat.npy", np.zeros((5, 5)))
    for name in ("notes.txt", "broken.png", "there.npz"):
        Path(name).write_text("nothing")
    before = sorted(folder.iterdir())
    assert run("import", *arguments.split()) == 2
    assert message in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before


def test_mujoco_model_stands_by_itself(folder, small):
    """MuJoCo loads the folder from anywhere, and its height field is the grid to a micrometre."""
    assert run("grid", *SMALL, "--mjcf", "model") == 0
    model = mujoco.MjModel.from_xml_path(str(folder / "model" / "terrain.xml"))
    ground = small[1]
    shares = model.hfield_data.reshape(model.hfield_nrow[0], model.hfield_ncol[0]).T
    heights = model.geom_pos[0, 2] + model.hfield_size[0, 2] * shares.astype(np.float64)
    np.testing.assert_allclose(heights, ground.heights, rtol=0, atol=1e-6)
    np.testing.assert_allclose(model.geom_pos[0, :2] - model.hfield_size[0, :2], ground.corner, atol=1e-6)
    np.testing.assert_allclose(2 * model.hfield_size[0, :2], ground.size, rtol=1e-6)


def test_mujoco_model_of_level_ground_loads(folder):
    """A terrain without any relief is a model too."""
    assert run("shape", "flat", "--cell", "0.5", "--mjcf", "model") == 0
    model = mujoco.MjModel.from_xml_path("model/terrain.xml")
    assert not model.hfield_data.any()
    assert model.geom_pos[0, 2] == 0


def test_grey_values_give_the_heights_back(folder, small):
    """The 16-bit picture is a map, x to the right and y up, and its note tells heights to half a grey value."""
    assert run("grid", *SMALL, "--out", "ground.png") == 0
    ground = small[1]
    _, low, unit = export.grey(ground)
    with Image.open("ground.png") as picture:
        note, grey = picture.info["Description"], np.asarray(picture)
    assert grey.dtype == np.uint16
    assert note.startswith(f"height [m] = {low!r} + {unit!r} * grey; 0.2 m per pixel")
    heights = low + unit * grey[::-1].T.astype(np.float64)
    np.testing.assert_allclose(heights, ground.heights, rtol=0, atol=0.5001 * unit + 1e-7)


def test_same_call_gives_the_same_bytes(folder):
    """Running the tool twice gives the same files, pictures included."""
    for name in ("a", "b"):
        (folder / name).mkdir()
        outputs = ["--out", *(f"{name}/ground{ending}" for ending in ENDINGS), "--preview", f"{name}/view.png"]
        assert run("shape", "rough", "--seed", 3, "--cell", "0.2", *outputs) == 0
    for path in (folder / "a").iterdir():
        assert path.read_bytes() == (folder / "b" / path.name).read_bytes(), path.name


def test_shape_takes_its_parameters(folder, capsys):
    """A tile is built with the parameters, the seed and the difficulty that are given."""
    assert run("shape", "stairs-down", "--difficulty", "0.5", "--height", "0.1", "0.2", "--tread", "0.5",
               "--tile", "6", "--platform", "2", "--border", "1", "--cell", "0.1", "--out", "s.npz") == 0  # fmt: skip
    ground = terrain.load("s.npz")
    assert ground.shapes == ("stairs-down",)
    assert ground.size == pytest.approx((8.0, 8.0))
    np.testing.assert_allclose(np.unique(ground.heights), 0.15 * np.arange(5), atol=1e-6)
    assert "0.150" in capsys.readouterr().out


def test_grid_takes_a_file_or_a_list(folder):
    """A grid is built from a TOML file, or from shapes that share the columns evenly."""
    (folder / "my.toml").write_text('levels = 1\ncolumns = 2\ncell = 0.4\nborder = 0\n[[shape]]\nname = "gap"\n')
    assert run("grid", "--file", "my.toml", "--levels", "2", "--out", "a.npz") == 0
    assert terrain.load("a.npz").origins.shape == (2, 2, 3)
    assert run("grid", "--shapes", "gap", "pit", "--difficulty", "0.2", "0.4", "--cell", "0.2", "--levels", "3",
               "--out", "b.npz") == 0  # fmt: skip
    ground = terrain.load("b.npz")
    assert ground.shapes == ("gap", "pit")
    np.testing.assert_allclose(ground.difficulty, [0.2, 0.3, 0.4], rtol=1e-6)


def test_force_overwrites_and_nothing_else_does(folder, capsys):
    """An output that exists is kept, and with --force replaced; other files in a model's folder stay."""
    (folder / "model").mkdir()
    for name in ("flat.npz", "model/terrain.xml", "model/mine.txt"):
        (folder / name).write_text("before")
    for output in (["--out", "flat.npz"], ["--mjcf", "model"]):
        assert run("shape", "flat", "--cell", "0.5", *output) == 2
        assert "exists and is not overwritten; choose another name, or add --force" in capsys.readouterr().err
    assert (folder / "flat.npz").read_text() == "before"
    assert run("shape", "flat", "--cell", "0.5", "--out", "flat.npz", "--mjcf", "model", "--force") == 0
    assert terrain.load("flat.npz").shapes == ("flat",)
    assert sorted(path.name for path in (folder / "model").iterdir()) == ["heights.bin", "mine.txt", "terrain.xml"]
    assert (folder / "model" / "mine.txt").read_text() == "before"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("shape flat --difficulty 1.5", "difficulty must be in [0, 1], got 1.5"),
        ("shape flat --difficulty nan", "difficulty must be in [0, 1], got nan"),
        ("grid --difficulty 0 2", "hardest must be in [0, 1], got 2.0"),
        ("shape stairs", "Unknown command 'terrain shape stairs'; choose from: discrete, flat, gap"),
        ("grid --shapes flat stair", "Unknown shape 'stair'; choose from: discrete, flat, gap"),
        ("grid --preset go2", "Unknown preset 'go2'; choose from: go1, legged-gym"),
        ("shape pit --tile 3", "platform must be smaller than tile = 3 m, got 4 m"),
        ("grid --tile 2", "platform must be smaller than tile = 2 m, got 3 m"),
        ("shape stairs-up --max-step 0.1", "max_step is 0.1 m, but stairs-up at difficulty 0.5 has steps of 0.14 m"),
        ("grid --preset legged-gym --max-step 0.2", "has steps of 0.212 m; lower them or raise max_step"),
        ("shape flat --cell 0.3", "cell must divide tile = 8 m, got 0.3 m"),
        ("shape flat --cell 0", "cell must be finite and positive, got 0.0"),
        ("shape flat --cell 0.0001", "cell must be at least 0.000488 m for at most 16384 cells along an axis"),
        ("shape flat --out here.npz", "here.npz exists and is not overwritten; choose another name, or add --force"),
        ("shape flat --out a.stl b.xyz", "out must end in one of .glb, .obj, .ply, .stl, .npz, .png, got b.xyz"),
        ("shape flat --out noending", "out must end in one of .glb, .obj, .ply, .stl, .npz, .png, got noending"),
        ("shape flat --preview a.jpg", "preview must end in .png, got a.jpg"),
        ("shape flat --out a.png --preview a.png", "a.png is named twice"),
        ("shape flat --out no/a.npz", "The folder no does not exist; make it first"),
        ("shape flat --mjcf no/model", "The folder no does not exist; make it first"),
        ("shape flat --mjcf here.npz", "mjcf must be a folder, but here.npz is a file"),
        ("shape flat --steps 3", "Unrecognized options: --steps"),
        ("shape flat --seed one", "seed"),
        ("shape flat --seed -1", "seed must be at least 0, got -1"),
        ("shape waves --count 0", "waves: count must be at least 1, got 0"),
        ("grid --file no.toml", "no.toml could not be read or written (No such file or directory)"),
        ("grid --file here.npz", "here.npz: "),
        ("grid --file a.toml --preset go1", "file excludes preset and shapes"),
        ("grid --shapes flat --preset go1", "shapes excludes preset"),
        ("shapes", "Unknown command 'terrain shapes'; choose from: list, shape, grid"),
    ],
)
def test_mistakes_give_one_line(folder, capsys, arguments, message):
    """Whatever the user can mend ends in one line on stderr and exit code 2, and no file is written or changed."""
    (folder / "here.npz").write_text("before")
    assert run(*arguments.split()) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("deimos: ")
    assert said.err.count("\n") == 1
    assert message in said.err
    assert [path.name for path in folder.iterdir()] == ["here.npz"]
    assert (folder / "here.npz").read_text() == "before"


@pytest.mark.parametrize("option", ["--out a.npz", "--preview a.png", "--mjcf new", "--mjcf old"])
def test_a_place_is_tried_before_the_work(folder, capsys, monkeypatch, option):
    """A folder that cannot be written to is refused before anything is built."""
    (folder / "old").mkdir()
    monkeypatch.setattr("deimos.app.terrain.build_with_mesh", lambda *args, **more: pytest.fail("built in vain"))
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert run("grid", *option.split()) == 2
    where = "old" if option.endswith("old") else "."
    assert capsys.readouterr().err == f"deimos: The folder {where} cannot be written to.\n"


def test_grid_that_does_not_fit_is_refused(folder, capsys, monkeypatch):
    """A grid beyond the free memory says how much it needs, and writes nothing."""
    monkeypatch.setattr("deimos.terrain.world._free_memory", lambda: 2**27)
    assert run("grid", "--out", "a.npz") == 2
    assert "needs about 1.0 GiB of memory, but 0.1 GiB are free; enlarge cell" in capsys.readouterr().err
    assert not list(folder.iterdir())


def test_full_disk_leaves_no_half_file(folder, capsys, monkeypatch):
    """When a file cannot be written to its end, the one of before stays and no other remains."""

    def fail(number):
        raise OSError(28, "No space left on device")

    (folder / "a.npz").write_text("before")
    monkeypatch.setattr("os.fsync", fail)
    assert run("shape", "flat", "--cell", "0.5", "--out", "a.npz", "--force") == 2
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert said.count("\n") == 1
    assert [path.read_text() for path in folder.iterdir()] == ["before"]


def test_interrupt_ends_quietly(folder, capsys, monkeypatch):
    """Ctrl-C ends with one line and exit code 130, and leaves no half-written file."""

    def interrupt(*arguments, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupt)
    assert run("shape", "flat", "--cell", "0.5", "--out", "a.npz") == 130
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    "arguments", [[], ["--help"], ["shape", "--help"], ["shape", "pit", "--help"], ["grid", "--help"]]
)
def test_help_is_there(capsys, arguments):
    """Every command explains itself and ends with exit code 0."""
    assert run(*arguments) == 0
    assert len(capsys.readouterr().out) > 100


def test_module_is_the_command(tmp_path):
    """``python -m terrain`` in a checkout is ``deimos terrain``, and loads no file but __init__ under two names."""
    home = Path(export.__file__).resolve().parent.parent
    code = """
import collections, pathlib, runpy, sys
sys.argv = ["terrain", "shape", "flat", "--cell", "0.5", "--out", sys.argv[1]]
try:
    runpy.run_module("terrain", run_name="__main__")
except SystemExit as stop:
    assert stop.code == 0
names = collections.defaultdict(list)
for name, module in sys.modules.items():
    names[getattr(module, "__file__", None)].append(name)
terrain = {file: found for file, found in names.items() if "deimos.terrain.world" in found or "terrain" in found}
assert sorted(map(sorted, terrain.values())) == [["deimos.terrain", "terrain"], ["deimos.terrain.world"]], terrain
assert not [name for name in sys.modules if name.startswith(("terrain.", "kernels"))]
"""
    command = [sys.executable, "-c", code, str(tmp_path / "flat.npz")]
    done = subprocess.run(command, cwd=home, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert terrain.load(tmp_path / "flat.npz").shapes == ("flat",)
