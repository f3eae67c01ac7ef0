"""How often verdicts are wrong, on a few simulated studies of every kind of test, and the table of many."""

import json
import math

import numpy as np
import pytest

from reproduction import verdicts
from reproduction.claim_list import CLAIMS
from reproduction.claims import ALPHA
from reproduction.verdicts import Policies, Scene

STUDIES, SEEDS = 80, 10
MOST = ALPHA + 3 * math.sqrt(ALPHA * (1 - ALPHA) / STUDIES)
SMALL = {
    name: test
    for name, (test, _) in verdicts.kinds().items()
    if name.startswith(("alike", "at most", "most", "highest")) or name.endswith(("1 against 1", "1 against 4"))
}


def shares(test, scene):
    """How often a clause holds and how often it does not, in a scene."""
    return verdicts.measure(test, scene, SEEDS, STUDIES, seed=[1])


@pytest.mark.parametrize("name", SMALL)
def test_wrong_verdicts_are_rare(name):
    """On the border between true and false, and beyond it on the other side, either verdict comes in at most 5 %."""
    test = SMALL[name]
    for scene in verdicts.scenes(test):
        holds, does_not = shares(test, scene)
        if scene.holds is not True:
            assert holds <= MOST, scene.name
        if scene.holds is not False:
            assert does_not <= MOST, scene.name


@pytest.mark.parametrize(
    ("name", "case", "verdict"),
    [("more: 1 against 1", "P = 0.75, rows", 0), ("more: 1 against 1", "P = 0.75, normal", 1),
     ("spread: 1 against 1", "ratio 3, normal", 0), ("spread: 1 against 1", "ratio 3, normal", 1),
     ("alike, ratio", "5 margins apart, normal", 1), ("most policies", "90 %", 0), ("most policies", "10 %", 1),
     ("highest of 10", "far behind, normal", 1)],
)  # fmt: skip
def test_clear_cases_are_decided(name, case, verdict):
    """What is clearly true is found to hold in many studies, and what is clearly false not to."""
    (scene,) = [each for each in verdicts.scenes(SMALL[name]) if (each.name, each.holds) == (case, verdict == 0)]
    assert shares(SMALL[name], scene)[verdict] > 0.25


def test_tight_populations_are_settled():
    """Equal populations whose policies differ by a tenth are alike in most studies."""
    scene = Scene("tight", True, [Policies("normal", factor=0.1)] * 2)
    assert shares(SMALL["alike, ratio"], scene)[0] > 0.9


def test_every_clause_has_a_kind():
    """The kinds name every claim, and those of a chosen best are tested with half of the policies."""
    found = verdicts.kinds()
    assert {name for _, ids in found.values() for name in ids} == {claim.id for claim in CLAIMS}
    assert all(verdicts.scenes(test) for test, _ in found.values())
    assert [ids for name, (_, ids) in found.items() if name.endswith("half of the seeds")] == [["C28"]] * 2


@pytest.mark.parametrize("name", verdicts.POPULATIONS)
def test_policies_have_their_odds(name):
    """Raised policies exceed those of the population with the odds that they should, ties counting half."""
    rng = np.random.default_rng(0)
    x, y = (Policies(name, odds).drawn(rng, (1, 4000))[0] for odds in (3.0, 1.0))
    wins = (np.sign(x[:, None] - y) + 1).mean() / 2
    tied = (x[:, None] == y).mean()
    assert wins == pytest.approx(0.75, abs=0.02 + tied / 4)
    rates = Policies(name, rates=True).drawn(rng, (1, 10))
    assert name == "normal" or (rates > 0).all()


def test_other_shapes_are_not_apart():
    """Populations that are moved together exceed one another as often as not."""
    for one, other in verdicts.OTHER_SHAPES:
        rng = np.random.default_rng(1)
        x, y = (Policies(name).drawn(rng, (1, 3000))[0] for name in (one, other))
        assert (np.sign(x[:, None] - verdicts.apart(one, other) - y)).mean() == pytest.approx(0.0, abs=0.03)


def test_table_is_resumed(tmp_path, monkeypatch, capsys):
    """What a file holds is not measured again, and the table has a row for every kind and size."""
    kinds = {name: verdicts.kinds()[name] for name in ("most policies", "highest of 10")}
    monkeypatch.setattr(verdicts, "kinds", lambda: kinds)
    file = tmp_path / "rates.json"
    monkeypatch.setattr("sys.argv", ["verdicts", str(file), "--studies", "20"])
    verdicts.main()
    first = json.loads(file.read_text())
    key = next(iter(first))
    file.write_text(json.dumps({name: values for name, values in first.items() if name != key}))
    measured = []
    honest = verdicts.measure
    monkeypatch.setattr(verdicts, "measure", lambda *given: measured.append(given) or honest(*given))
    capsys.readouterr()
    verdicts.main()
    assert len(measured) == 1
    assert json.loads(file.read_text()) == first
    out = capsys.readouterr().out
    assert out.count("| most policies | C3, C7, C11, C12, C29, C35 |") == 2
    assert "20 studies of each kind" in out
