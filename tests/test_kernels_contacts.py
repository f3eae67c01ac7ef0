"""Which part pushes how hard: the gathering of contact forces."""

import numpy as np
import pytest
import warp as wp
from deimos.kernels.legged.contacts import CONTACTS, TERRAIN, UNWATCHED, gather_contacts, peak_force
from deimos.kernels.legged.state import build

WORLDS, PARTS, ROWS, SUBSTEPS = 7, 5, 40, 3
PART_OF_GEOM = np.array([TERRAIN, 0, 0, 1, 2, 3, 4, UNWATCHED], np.int32)


def make_case(seed=0, found=60, buffer=80):
    """Random contacts; some are not in the solution, some between two parts of a robot."""
    rng = np.random.default_rng(seed)
    case = {
        "count": np.array([found]),
        "world": rng.integers(WORLDS, size=buffer),
        "geom": np.stack([np.zeros(buffer, int), rng.integers(1, len(PART_OF_GEOM), size=buffer)], axis=1),
        "dim": rng.choice([1, 3], size=buffer),
        "row": np.repeat(rng.integers(0, ROWS - 4, size=buffer)[:, None], 4, axis=1) + np.arange(4),
        "force": rng.uniform(0, 20, size=(WORLDS, ROWS)).astype(np.float32),
    }
    case["geom"][::5] = rng.integers(1, len(PART_OF_GEOM), size=(len(case["geom"][::5]), 2))  # without the terrain
    case["geom"][1::2] = case["geom"][1::2, ::-1]
    case["row"][::7] = -1
    return case


def run(case, device, substeps=SUBSTEPS, substep=1):
    """Part forces and peaks after one gathering."""
    part_force = np.zeros((substeps, WORLDS, PARTS))
    contacts = build(CONTACTS, device, **case, geom_part=PART_OF_GEOM, part_force=part_force, peak=np.zeros(2))
    CONTACTS.require(
        "contacts", contacts, contacts.peak, num_envs=WORLDS, buffer=len(case["world"]), edges=4, rows=ROWS,
        num_geoms=len(PART_OF_GEOM), substeps=substeps, parts=PARTS,
    )  # fmt: skip
    gather_contacts(contacts, substep=substep)
    return contacts.part_force.numpy(), contacts.peak.numpy()


def gather_reference(case):
    """Contact by contact, in float64."""
    force, rows_used = np.zeros((WORLDS, PARTS)), 0
    for i in range(min(case["count"][0], len(case["world"]))):
        row = case["row"][i, 0]
        if row < 0:
            continue
        rows = 1 if case["dim"][i] == 1 else 4
        rows_used = max(rows_used, row + rows)
        a, b = PART_OF_GEOM[case["geom"][i]]
        if {a, b} & {TERRAIN} and max(a, b) >= 0:
            force[case["world"][i], max(a, b)] += case["force"][case["world"][i], row : row + rows].astype(float).sum()
    return force, rows_used


@pytest.mark.parametrize("found", [0, 1, 60, 80])
def test_matches_reference(device, found):
    """Forces are those of the reference, in the layer of the substep and nowhere else."""
    case = make_case(found=found)
    force, peak = run(case, device)
    expected, rows = gather_reference(case)
    # At most 80 contacts of 4 rows add up to less than 6400 N, each addition rounded once.
    np.testing.assert_allclose(force[1], expected, rtol=320 * 2.0**-24, atol=0)
    assert not force[[0, 2]].any()
    assert peak.tolist() == [found, rows]
    assert found < 2 or (expected > 0).sum() > 5


def test_contacts_beyond_the_buffer_are_counted_but_not_read(device):
    """More contacts than the buffer holds: those that are there count, and the peak says how many were found."""
    case = make_case(found=1000)
    force, peak = run(case, device)
    np.testing.assert_allclose(force[1], gather_reference(case)[0], rtol=320 * 2.0**-24, atol=0)
    assert peak[0] == 1000


def test_pyramid_edges_add_up_to_the_normal_force(device):
    """A contact with friction has four edges whose forces add up; without friction it has one row."""
    case = make_case(found=2, buffer=2)
    case |= {"world": np.array([3, 3]), "dim": np.array([3, 1]), "geom": np.array([[0, 3], [4, 0]])}
    case["row"] = np.array([[10, 11, 12, 13], [20, -1, -1, -1]])
    case["force"][3, [10, 11, 12, 13, 20]] = [1.0, 2.0, 4.0, 8.0, 16.0]
    force, _ = run(case, device)
    assert force[1, 3].tolist() == [0.0, 15.0, 16.0, 0.0, 0.0]


def test_rows_that_did_not_fit_are_not_read(device):
    """A contact whose last rows lie beyond the constraint buffer counts with those that fit."""
    case = make_case(found=1, buffer=1)
    case |= {"world": np.array([2]), "dim": np.array([3]), "geom": np.array([[0, 1]])}
    case["row"] = np.array([[ROWS - 2, ROWS - 1, ROWS, ROWS + 1]])
    case["force"][2, -2:] = [3.0, 5.0]
    force, peak = run(case, device)
    assert force[1, 2, 0] == 8.0
    assert peak[1] == ROWS + 2


@wp.kernel
def _peaks(part_force: wp.array3d[float], peak: wp.array2d[float]):
    env, part = wp.tid()
    peak[env, part] = peak_force(part_force, env, part)


@pytest.mark.parametrize("substeps", [1, 4])
def test_peak_is_the_largest_substep(device, substeps):
    """The force of a part is the largest over the substeps."""
    value = np.random.default_rng(1).uniform(0, 9, size=(substeps, WORLDS, PARTS)).astype(np.float32)
    peak = wp.full((WORLDS, PARTS), np.nan, dtype=wp.float32, device=device)
    inputs = [wp.array(value, dtype=wp.float32, device=device)]
    wp.launch(_peaks, dim=(WORLDS, PARTS), inputs=inputs, outputs=[peak], device=device)
    np.testing.assert_array_equal(peak.numpy(), value.max(axis=0))


def test_one_contact_more_is_its_force_more(device):
    """Forces add up over contacts: all at once equals one after another, whatever their order."""
    case = make_case(found=20, buffer=20)
    case["force"] = np.round(case["force"])  # whole numbers add without rounding
    whole, _ = run(case, device)
    order = np.random.default_rng(2).permutation(20)
    shuffled, _ = run(case | {name: case[name][order] for name in ("world", "geom", "dim", "row")}, device)
    np.testing.assert_array_equal(whole, shuffled)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("count", np.zeros(2), r"contacts.count must be int32\(1,\)"),
        ("dim", np.zeros(3), r"contacts.dim must be int32\(80,\).*got int32\(3,\)"),
        ("geom", np.zeros((3, 2)), r"contacts.geom must be vec2i\(80,\).*got vec2i\(3,\)"),
        ("row", np.zeros((3, 4)), r"contacts.row must be int32\(80, 4\).*got int32\(3, 4\)"),
        ("force", np.zeros((2, ROWS)), r"contacts.force must be float32\(7, 40\).*got float32\(2, 40\)"),
    ],
)
def test_rejects_arrays_of_another_shape(device, name, value, message):
    """The message names the array, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        run(make_case() | {name: value}, device)


@pytest.mark.parametrize("substep", [-1, SUBSTEPS])
def test_rejects_a_substep_that_is_not_there(device, substep):
    """The message names the range of substeps."""
    with pytest.raises(ValueError, match=rf"substep must be in \[0, {SUBSTEPS}\), got {substep}"):
        run(make_case(), device, substep=substep)
