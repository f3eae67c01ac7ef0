"""The numbers of the map's page and lab are those of its rows, and its report is what the analysis writes."""

from pathlib import Path

import numpy as np
import pytest

from deimos.study.data import Data
from deimos.study.permutation import p_values
from deimos.study.stats import bootstrap
from reproduction import multiverse
from reproduction.multiverse import UNIFORM, Roles
from reproduction.multiverse_page import OURS, MultiverseOptions, write

DOCS = Path(__file__).parent.parent / "docs"
RESULTS = DOCS / "results"
PAGE, LAB, README, PARTICLE = (
    " ".join(path.read_text(encoding="utf-8").split())
    for path in (
        DOCS / "multiverse.md",
        DOCS / "lab" / "multiverse.md",
        DOCS.parent / "README.md",
        DOCS / "particle.md",
    )
)
OURS_STUDY = "multiverse_ours"
NAMES = {"uniform": "Uniform", "rnd": "RND"}


@pytest.fixture(scope="module")
def settings():
    """The settings of the map with all policies."""
    return multiverse.read(RESULTS / "multiverse_screening", RESULTS / "multiverse")


@pytest.fixture(scope="module")
def room(settings):
    """Those with headroom."""
    return [each for each in settings if each.has_headroom]


def worst(folder, environment, name):
    """Crashes of a method's policies under the worst attacker in a study [%], by their seeds."""
    rows = Data.read(RESULTS / folder).rows
    own = [row for row in rows if (row["environment"], row["method"], row["goals"]) == (environment, name, "naive")]
    return np.array([100 * row["worst"] for row in sorted(own, key=lambda row: row["seed"])])


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
    margins = 100 * multiverse.margins(settings, next(
        each for each in multiverse.headlines(Roles.of(settings)) if each.name == clause
    ))  # fmt: skip
    reciprocal = np.array([each.levels[factor] == "reciprocal" for each in settings])
    learnt = reciprocal & np.array([each.learnt for each in settings])
    assert (reciprocal.sum(), learnt.sum()) == (16, 6)
    assert (
        f"The margin is {margins[reciprocal].mean():.0f} points over all 16 settings with this reward, "
        f"{margins[learnt].mean():.0f} over the six learnt ones"
    ) in PAGE


def test_the_page_has_the_methods(settings):
    """Rates and scores, in the order of the page; and the best new selector."""
    standings = multiverse.standings(settings)
    place = -1
    for each in standings:
        score = "1" if each.method == UNIFORM else f"{each.score:.2f}"
        line = f"| {NAMES.get(each.method, each.method)} | {100 * each.worst.estimate:.0f} | {score} |"
        assert PAGE.find(line) > place
        place = PAGE.find(line)
    assert multiverse.best_new(standings) == "weighted"
    able = [each.method for each in standings if each.method in multiverse.NEW and each.score.estimate >= 0.95]
    assert able == ["weighted"]


def test_the_lab_says_how_gain_goes_with_danger(settings):
    """Slopes over all settings and over the learnt ones, and the share of Uniform's mean rate that is gone."""
    learnt = [each for each in settings if each.learnt]
    assert len(learnt) == 19
    both, mean_of = [], {
        name: np.mean([each.policies[name].worst for each in settings]) for name in multiverse.methods_of(settings)
    }  # fmt: skip
    for name in mean_of.keys() - {UNIFORM}:
        slopes = [multiverse.gain_slope(own, name) for own in (settings, learnt)]
        gone = 1 - mean_of[name] / mean_of[UNIFORM]
        assert f"| {name} | {slopes[0]:.2f} | {slopes[1]:.2f} | {gone:.2f} |" in LAB
        both += [name] if min(each.low for each in slopes) > 0.0 else []
    assert both == []


def test_pages_repeat_the_first_hypothesis(settings):
    """p75 beside Uniform on the seeds of its test, on those of the confirmation, and on all."""
    first, second = ([worst(folder, OURS, name) for name in (UNIFORM, "p75")] for folder in ("particle_d", OURS_STUDY))
    samples = (first, second, [np.concatenate(pair) for pair in zip(first, second, strict=True)])
    for title, (uniform, own) in zip(("particle_d`", "59", "all 50, exploratory"), samples, strict=True):
        gain = bootstrap([uniform, own], lambda x, y: x.mean(axis=-1) - y.mean(axis=-1))
        p, _ = p_values([uniform, own], [(0, 1)], "mean")
        assert f"{title} | {uniform.mean():.1f} | {own.mean():.1f} | {gain:.1f} | {p:.4f} |" in LAB
    ours = [f"{each.mean():.1f}" for each in second]
    assert f"p75 crashes on {ours[1]} % ({first[1].mean():.1f} before), Uniform on {ours[0]} %" in README
    assert f"gains less: {ours[0]} to {ours[1]} % (here {first[0].mean():.1f} to {first[1].mean():.1f})" in PARTICLE


def test_pages_have_the_confirmation():
    """Rates of all methods, what the new selector does to Uniform's rate and score, and that it misses both aims."""
    data = Data.read(RESULTS / OURS_STUDY)
    rate = {name: f"{worst(OURS_STUDY, OURS, name).mean():.1f}" for name in data.methods(OURS)}
    found = {each.rival: each for each in multiverse.contrasts(data, OURS, "weighted")}
    assert all(each.n == (30, 30) and each.p <= 0.05 and each.lower.low > 0.0 for each in found.values())
    uniform = found.pop("uniform")
    assert all(each.score.low > 1.0 for each in found.values())
    assert not uniform.is_winner
    assert uniform.ratio.estimate < multiverse.AIM
    assert uniform.score.estimate < multiverse.AIM_SCORE
    ratio, score = f"{uniform.ratio:.2f}", f"{uniform.score:.3f}"
    assert f"| {' | '.join(rate[name] for name in ('uniform', 'p75', 'rnd', 'vds', 'weighted'))} |" in PAGE
    assert f"safer than each (corrected p at most {max(each.p for each in found.values()):.3f})" in PAGE
    assert f"Uniform crashes {ratio} times as often; weighted has {score} of its score" in PAGE
    for each in (ratio, score):
        assert each.split(maxsplit=1)[1] in LAB
    assert (
        f"Uniform on {rate['uniform']} %, and `weighted`, ours, on {rate['weighted']} % at "
        f"{uniform.score.estimate:.3f} of Uniform's score (p = {uniform.p:.3f})"
    ) in README


def test_pages_have_the_setting_with_most_headroom():
    """Rates of all methods; the new selector is safer than Uniform there, and less safe than the others."""
    data = Data.read(RESULTS / "multiverse_headroom")
    (name,) = data.environments
    assert name == "map.03"
    rates = [f"{worst('multiverse_headroom', name, own).mean():.1f}" for own in ("uniform", "p75", "rnd")]
    assert f"| {' | '.join(rates)} | | {worst('multiverse_headroom', name, 'weighted').mean():.1f} |" in PAGE
    found = {each.rival: each for each in multiverse.contrasts(data, name, "weighted")}
    assert found["p75"].lower.high < 0.0
    assert found["rnd"].lower.high < 0.0
    uniform, p75, rnd = (found[own] for own in ("uniform", "p75", "rnd"))
    assert f"in the other than Uniform alone (p = {uniform.p:.4f})" in PAGE
    assert f"by a factor of {uniform.ratio:.2f} at {uniform.score:.3f} of its score" in LAB
    assert f"their rates are {p75.ratio:.2f} and {rnd.ratio:.2f} of its own, at lower scores" in LAB
    assert min(p75.score.low, rnd.score.low) > 1.0


def test_pages_have_the_long_budget():
    """Means and seeds after 48 000 steps, and how far apart policies of one method are."""
    study = "multiverse_long"
    data = Data.read(RESULTS / study)
    (name,) = data.environments
    score = {row["method"]: [] for row in data.rows}
    for row in data.rows:
        if row["goals"] == "naive":
            score[row["method"]].append(row["score"])
    rates = {own: worst(study, name, own) for own in ("uniform", "p25", "p50", "rnd")}
    for own, each in rates.items():
        seeds = ", ".join(f"{rate:.1f}" for rate in each)
        assert f"| {own} | {each.mean():.1f} | {seeds} | {np.mean(score[own]):.3f} |" in LAB
    uniform, p25, p50, rnd = (f"{each.mean():.1f}" for each in rates.values())
    assert f"Uniform crashes on {uniform} %, p50 on {p50}, p25 on {p25}, RND on {rnd}" in PAGE
    every = np.concatenate(list(rates.values()))
    assert f"(three seeds, {every.min():.0f} to {every.max():.0f})" in PAGE
    apart = [np.ptp(each) for each in rates.values()]
    assert f"differ by {min(apart):.0f} to {max(apart):.0f} points" in LAB
    assert rates["uniform"].mean() < worst(OURS_STUDY, OURS, "uniform").mean() / 2


def test_pages_count_settings(settings, room):
    """Learnt, safe, with headroom, and where scores are compared."""
    unlearnt = [each for each in settings if not each.learnt]
    reciprocal = [each for each in unlearnt if each.levels["env.reward"] == "reciprocal"]
    assert (len(settings), len(room), len(unlearnt), len(reciprocal)) == (32, 16, 13, 10)
    assert "finds *headroom* in 16 settings" in PAGE
    assert "In 13 the task is not learnt, in ten of these under the reciprocal reward" in PAGE
    assert f"in {sum(each.learnt and not each.has_headroom for each in settings)} it is learnt safely" in PAGE
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
    screening, mapped, *confirmed = (
        RESULTS / f"multiverse{name}" for name in ("_screening", "", "_ours", "_headroom", "_long")
    )
    write(MultiverseOptions(out=tmp_path, screening=screening, map=mapped, confirmations=tuple(confirmed)))
    wanted = (tmp_path / "multiverse.md").read_text(encoding="utf-8")
    assert (RESULTS / "map" / "multiverse.md").read_text(encoding="utf-8") == wanted
