"""The numbers of the map's page and lab are those of its rows, and its report is what the analysis writes."""

from pathlib import Path

import numpy as np
import pytest

from deimos.study.data import Data
from reproduction import multiverse, multiverse_page
from reproduction.multiverse import UNIFORM, Roles
from reproduction.multiverse_page import MultiverseOptions, write

DOCS = Path(__file__).parent.parent / "docs"
RESULTS = DOCS / "results"
PAGE, LAB, README = (
    " ".join(path.read_text(encoding="utf-8").split())
    for path in (DOCS / "multiverse.md", DOCS / "lab" / "multiverse.md", DOCS.parent / "README.md")
)
NAMES = {"uniform": "Uniform", "rnd": "RND"}


@pytest.fixture(scope="module")
def settings():
    """The settings of the map with all policies."""
    return multiverse.read(RESULTS / "multiverse_screening", RESULTS / "multiverse")


@pytest.fixture(scope="module")
def room(settings):
    """Those with headroom."""
    return [each for each in settings if each.has_headroom]


def safer(settings, name):
    """By how many points a method crashes less than Uniform under the worst attacker, setting by setting."""
    return 100 * np.array([each.policies[UNIFORM].worst - each.policies[name].worst for each in settings])


def test_the_page_has_the_headline_clauses(settings):
    """Shares of settings with headroom, mean margins over all, and that one share alone excludes one half."""
    decided, shares = [], {}
    for clause in multiverse.headlines(Roles.of(settings)):
        share, margin = multiverse.share_that_holds(settings, clause), multiverse.margins(settings, clause)
        text = clause.text.replace("rnd ", "RND ").replace("uniform", "Uniform")
        holds = f"{100 * share.estimate:.0f} [{100 * share.low:.0f}, {100 * share.high:.0f}]"
        line = f"| {text} | {holds} | {multiverse.mean(100 * margin):.1f} |"
        assert line in PAGE
        shares[clause.name] = holds.replace(" [", " % [")
        decided += [clause.name] if share.low > 0.5 or share.high < 0.5 else []
    assert decided == ["danger is hidden"]
    assert f"holds clearly, in {shares['danger is hidden']} of those" in README
    assert f"p75 is safer in {shares['p is safer']}" in README


def test_one_choice_moves_one_headline(settings):
    """Of the effects of all factors on all clauses, the one whose interval excludes zero."""
    found = []
    for clause in multiverse.headlines(Roles.of(settings)):
        own = clause.counts_in(settings)
        moved = multiverse.moved_by(own, 100 * multiverse.margins(own, clause))
        assert len(moved) == 8
        found += [(clause.name, *each) for each in moved.items() if each[1].low > 0.0 or each[1].high < 0.0]
    ((clause, factor, effect),) = found
    assert (clause, factor) == ("p beats a penalty", "env.reward")
    assert f"by {effect.estimate:.0f} points [{effect.low:.0f}, {effect.high:.0f}]" in PAGE


def test_the_page_has_the_methods(settings):
    """Rates, scores and slopes, in the order of the page; and the best new selector."""
    standings = multiverse.standings(settings)
    place = -1
    for each in standings:
        score, slope = "1", ""
        if each.method != UNIFORM:
            score, slope = f"{each.score:.2f}", f"{multiverse.removed(settings, each.method):.2f} "
        name = NAMES.get(each.method, each.method)
        line = f"| {name} | {100 * each.worst.estimate:.0f} | {score} | {slope}|"
        assert PAGE.find(line) > place
        place = PAGE.find(line)
    assert multiverse.best_new(standings) == "weighted"
    able = [each.method for each in standings if each.method in multiverse.NEW and each.score.estimate >= 0.95]
    assert able == ["weighted"]


def test_pages_have_the_confirmation():
    """Rates of all methods, what the new selector does to Uniform's rate and score, and that it misses both aims."""
    data = Data.read(RESULTS / "multiverse_ours")
    rows = [row for row in data.rows if row["goals"] == "naive"]
    rate = {
        name: f"{100 * np.mean([row['worst'] for row in rows if row['method'] == name]):.1f}"
        for name in data.methods(multiverse_page.OURS)
    }
    found = {each.rival: each for each in multiverse.contrasts(data, multiverse_page.OURS, "weighted")}
    assert all(each.n == (30, 30) and each.p <= 0.05 and each.lower.low > 0.0 for each in found.values())
    uniform = found.pop("uniform")
    assert all(each.score.low > 1.0 for each in found.values())
    assert not uniform.is_winner
    assert uniform.ratio.estimate < multiverse.AIM
    assert uniform.score.estimate < multiverse.AIM_SCORE
    ratio, score = f"{uniform.ratio:.2f}", f"{uniform.score:.3f}"
    assert (
        f"on {rate['weighted']} % of goals, p75's on {rate['p75']}, RND's on {rate['rnd']}, Uniform's on "
        f"{rate['uniform']}, VDS's on {rate['vds']}: fewer than each (corrected p at most "
        f"{max(each.p for each in found.values()):.3f})"
    ) in PAGE
    assert f"Uniform crashes {ratio} times as often; weighted has {score} of its score" in PAGE
    for each in (ratio, score):
        assert each.split(maxsplit=1)[1] in LAB
    assert (
        f"crashes on {rate['weighted']} %, Uniform on {rate['uniform']} %, at {uniform.score.estimate:.3f} of its "
        f"score (30 seeds, p = {uniform.p:.3f})"
    ) in README


def test_pages_count_settings(settings, room):
    """Learnt, safe, with headroom, and where scores are compared."""
    unlearnt = [each for each in settings if not each.learnt]
    reciprocal = [each for each in unlearnt if each.levels["env.reward"] == "reciprocal"]
    assert (len(settings), len(room), len(unlearnt), len(reciprocal)) == (32, 16, 13, 10)
    assert "finds 16 settings with *headroom*" in PAGE
    assert "In 13 others it has not learnt the task, ten of them" in PAGE
    assert f"in {sum(each.learnt and not each.has_headroom for each in settings)} it is safe" in PAGE
    assert f"over the {sum(each.compares_scores for each in settings)} settings where scores can be compared" in PAGE
    assert multiverse.most_headroom(settings).name == "map.03"


def test_pages_say_how_much_seeds_differ(room):
    """Two policies of Uniform in every setting with headroom, and the spread of their differences and of methods'."""
    first, second = (
        np.array([100 * each.worst for each in own])
        for own in ([each.screened for each in room], [each.policies[UNIFORM] for each in room])
    )
    for name, own in (("screening", first), ("map", second)):
        assert f"| {name} | {' | '.join(f'{x:.0f}' for x in own)} |" in LAB
    others = [name for name in multiverse.methods_of(room) if name != UNIFORM]
    spread = np.std(first - second, ddof=1)
    spreads = {name: np.std(safer(room, name), ddof=1) for name in others}
    assert f"standard deviation of {spread:.1f} points" in LAB
    assert ", ".join(f"{name} {own:.1f}" for name, own in spreads.items()) in LAB
    low, high = min(spreads.values()), max(spreads.values())
    assert f"differ by {spread:.0f} points (standard deviation)" in PAGE
    assert f"of another method and one of Uniform by {low:.0f} to {high:.0f}" in PAGE


def test_the_lab_says_what_a_penalty_does_without_headroom(settings, room):
    """Mean rates over the settings without headroom; and the penalty's advantage over those with it."""
    rest = [each for each in settings if not each.has_headroom]
    assert sum(each.levels["env.reward"] == "reciprocal" for each in rest) == 10
    rates = {name: 100 * np.mean([each.policies[name].worst for each in rest]) for name in multiverse.methods_of(rest)}
    uniform, penalty = (f"{rates.pop(name):.1f} %" for name in (UNIFORM, "penalty-30"))
    assert f"crashes Uniform's policies on {uniform} of its goals, penalty-30's on {penalty}" in LAB
    assert f"{min(rates.values()):.1f} to {max(rates.values()):.1f} %" in LAB
    assert f"advantage is {multiverse.mean(safer(room, 'penalty-30')):.1f}".replace(" [", " points [") in LAB


def test_the_report_is_what_the_analysis_writes(tmp_path):
    """Word for word."""
    screening, mapped, ours = (RESULTS / name for name in ("multiverse_screening", "multiverse", "multiverse_ours"))
    write(MultiverseOptions(out=tmp_path, screening=screening, map=mapped, confirmations=(ours,)))
    wanted = (tmp_path / "multiverse.md").read_text(encoding="utf-8")
    assert (RESULTS / "map" / "multiverse.md").read_text(encoding="utf-8") == wanted
