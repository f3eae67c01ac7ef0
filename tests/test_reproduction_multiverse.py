"""The analysis of the map, on simulated rows whose truth is known."""

import itertools
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from deimos.checks import RunError
from deimos.study import effects, plan, stats
from deimos.study.data import Data
from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, Results
from reproduction import __main__ as commands
from reproduction import multiverse, multiverse_figures, multiverse_page
from reproduction.multiverse import NEW, Policy, Setting, Standing
from reproduction.multiverse_figures import level_named
from reproduction.multiverse_page import MultiverseOptions, write

METHODS = ("uniform", "p75", "penalty-30", "rnd", *NEW)
HALF = 10_000  # interactions in worlds of even number, and as many in others
EMPTY = {str: "v", int: 100, float: 0.5, bool: False, tuple: (), dict: {}, list: []}


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Resample and permute little."""
    monkeypatch.setattr(effects, "PERMUTATIONS", 299)
    monkeypatch.setattr(stats, "RESAMPLES", 500)


@cache
def points():
    """The levels of the plan's settings by their names."""
    return {cell.environment: cell.levels for cell in plan.expand(plan.read(multiverse_page.STUDY))}


def written(folder, policies, levels=None):
    """A study's folder of tables; ``policies`` are (environment, method, seed, Policy)."""
    rows, curves = [], []
    for environment, method, seed, policy in policies:
        key = {"environment": environment, "method": method, "seed": seed, "setting": environment, "selector": method,
               "hash": f"{environment}{method}{seed}", "levels": (levels or {}).get(environment, {})}  # fmt: skip
        curves.append({name: EMPTY[kind] for name, kind in CURVE_COLUMNS.items()} | key)
        for goals, rate in (("naive", policy.naive), ("argmax", policy.worst / 2), ("scripted", policy.worst)):
            crashes = round(HALF * rate)
            rows.append({name: EMPTY[kind] for name, kind in RESULT_COLUMNS.items()} | key | {
                "goals": goals, "score": policy.score, "crash_rate": rate, "interactions": 2 * HALF,
                "interaction_crashes": 2 * crashes, "even_interactions": HALF, "even_interaction_crashes": crashes,
            })  # fmt: skip
    folder.mkdir()
    Results(rows, curves).write(folder)
    return folder


def simulated(rate, score=lambda method, levels: 1.0, danger=lambda levels, rng: rng.beta(1.0, 1.5), seed=0, noise=0.0):
    """The settings of the plan; ``rate(method, levels, danger)`` under the worst attacker, before noise."""
    rng, settings = np.random.default_rng(seed), []

    def policy(method, levels, base):
        worst = float(np.clip(rate(method, levels, base) + noise * rng.normal(), 0.0, 1.0))
        return Policy(worst / 30, worst, score(method, levels))

    for name, levels in points().items():
        base = danger(levels, rng)
        found = {method: policy(method, levels, base) for method in METHODS}
        settings.append(Setting(name, levels, policy("uniform", levels, base), found))
    return settings


def clause(settings, name):
    """One of the headline clauses by its name."""
    return next(each for each in multiverse.headlines(multiverse.Roles.of(settings)) if each.name == name)


def excludes(interval):
    """Whether an interval says that there is an effect."""
    return interval.low > 0.0 or interval.high < 0.0


def test_a_planted_effect_is_found_and_a_planted_absence_is_not():
    """Fear that helps only over a long horizon makes horizon the factor that moves its clause; nothing else does."""

    def rate(method, levels, base):
        return base * (0.2 if method == "p75" and levels["horizon"] == "long" else 1.0)

    settings = simulated(rate, noise=0.05)
    moved = multiverse.moved_by(settings, multiverse.margins(settings, clause(settings, "p is safer")))
    levels, _ = multiverse.coded(settings)
    assert levels["horizon"] == ["long", "short"]
    assert next(iter(moved)) == "horizon"
    assert [name for name, effect in moved.items() if excludes(effect)] == ["horizon"]
    true = np.mean([-0.8 * each.policies["uniform"].worst for each in settings])
    assert moved["horizon"].low <= true <= moved["horizon"].high
    moved = multiverse.moved_by(settings, multiverse.margins(settings, clause(settings, "weighted is safer")))
    assert len(moved) == 8
    assert not any(map(excludes, moved.values()))


def test_an_absent_effect_is_rarely_found():
    """Over 60 maps in which no factor moves anything, at most 5 % of clauses have one that seems to, beyond chance."""
    found = []
    for seed in range(60):
        settings = simulated(lambda method, levels, base: base, noise=0.1, seed=seed)
        moved = multiverse.moved_by(settings, multiverse.margins(settings, clause(settings, "p is safer")))
        found.append(any(map(excludes, moved.values())))
    assert np.mean(found) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 60)


def test_shares_count_settings_with_headroom_alone():
    """A clause's share is that of settings whose screening was attacked above 1 %, of which equal rates do not hold."""

    def danger(levels, rng):
        return 0.005 if levels["env.variant"] == "relative" else 0.5

    def rate(method, levels, base):
        better = method == "p75" and (levels["env.reward"] == "linear" or levels["env.variant"] == "relative")
        return base / 5 if better else base

    settings = simulated(rate, danger=danger)
    assert [each.has_headroom for each in settings] == [
        each.levels["env.variant"] == "directional" for each in settings
    ]
    share = multiverse.share_that_holds(settings, clause(settings, "p is safer"))
    assert share.estimate == 0.5
    assert (share.low, share.high) == pytest.approx((0.2465, 0.7535), abs=1e-4)  # Clopper and Pearson, 8 of 16
    assert multiverse.share_that_holds(settings, clause(settings, "q-fear is safer")).estimate == 0.0
    safe = [each for each in settings if not each.has_headroom]
    assert multiverse.share_that_holds(safe, clause(settings, "p is free")) is None


def test_every_headline_clause_says_what_it_tests():
    """Of each clause a case in which it holds and one in which it does not, in the numbers that its words name."""
    base = {name: Policy(0.01, 0.2, 1.0) for name in METHODS}

    def holds(name, **changed):
        policies = base | {method.replace("_", "-"): policy for method, policy in changed.items()}
        settings = [Setting("map.00", {}, base["uniform"], policies)]
        (margin,) = multiverse.margins(settings, clause(settings, name))
        return bool(margin > 0)

    safe, unsafe = Policy(0.01, 0.1, 1.0), Policy(0.01, 0.3, 1.0)
    assert holds("danger is hidden", uniform=Policy(0.09, 0.2, 1.0))
    assert not holds("danger is hidden", uniform=Policy(0.11, 0.2, 1.0))
    assert holds("p is safer", p75=safe)
    assert not holds("p is safer", p75=unsafe)
    assert holds("p is free", p75=Policy(0.01, 0.2, 0.96))
    assert not holds("p is free", p75=Policy(0.01, 0.2, 0.94))
    assert holds("p is free", p75=Policy(0.01, 0.2, 0.48), uniform=Policy(0.01, 0.2, 0.5))
    assert holds("p beats a penalty", p75=safe)
    assert not holds("p beats a penalty", penalty_30=safe)
    assert holds("rnd is unsafe", rnd=unsafe)
    assert not holds("rnd is unsafe", rnd=safe)
    for name in NEW:
        assert holds(f"{name} is safer", **{name.replace("-", "_"): safe})
        assert not holds(f"{name} is safer", **{name.replace("-", "_"): unsafe})


def test_part_of_headroom_is_not_found_where_there_is_none():
    """A method that removes half of the danger has a slope of a half; one that is Uniform again has none."""
    settings = simulated(lambda method, levels, base: base * (0.5 if method == "rnd" else 1.0), noise=0.15)
    half, none = multiverse.gain_slope(settings, "rnd"), multiverse.gain_slope(settings, "p75")
    assert half.low <= 0.5 <= half.high
    assert none.low <= 0.0 <= none.high


def test_best_new_selector_is_safe_at_a_score():
    """The highest share of safe policies wins among those that keep 95 % of the score; else the highest score."""

    def standing(name, safe, score, worst=0.1):
        same = [stats.Interval(x, x, x) for x in (safe, worst, score)]
        return Standing(name, *same)

    found = [standing("q-fear", 0.9, 0.94), standing("fear-novelty", 0.6, 0.95), standing("weighted", 0.5, 1.1)]
    others = [standing("rnd", 1.0, 1.0)]
    assert multiverse.best_new(others + found) == "fear-novelty"
    assert multiverse.best_new([standing("q-fear", 0.9, 0.8), standing("weighted", 0.1, 0.9)]) == "weighted"


def test_scores_are_compared_where_the_task_is_learnt():
    """Below 0 the worse score would be the larger ratio: such settings count neither for methods nor for a clause."""

    def score(method, levels):
        if levels["learner"] == "tuned":
            return {"weighted": -3.0, "p75": -2.0}.get(method, -1.0)
        return {"weighted": 0.9, "p75": 0.9}.get(method, 1.0)

    settings = simulated(lambda method, levels, base: 0.001 if method == "rnd" else base, score)
    found = {each.method: each for each in multiverse.standings(settings)}
    assert next(iter(found)) == "rnd"
    assert found["rnd"].safe.estimate == 1.0
    assert found["weighted"].score.estimate == pytest.approx(0.9)
    assert found["uniform"].score.estimate == 1.0
    assert multiverse.best_new([*found.values()]) == "fear-novelty"
    free = clause(settings, "p is free")
    assert multiverse.share_that_holds(settings, free).estimate == 0.0
    assert multiverse.margins(settings, free) == pytest.approx([-0.05] * 16)
    assert {each.levels["learner"] for each in free.counts_in(settings)} == {"rsl_rl-like"}
    fallen = [replace(x, policies=x.policies | {"uniform": Policy(0.0, 0.5, -1.0)}) for x in settings]
    assert free.counts_in(fallen) == []  # learnt in the screening, and not again in the map
    assert multiverse.share_that_holds(fallen, free) is None
    assert all(np.isnan(each.score.estimate) for each in multiverse.standings(fallen))
    assert found["uniform"].worst.low < found["uniform"].worst.estimate < found["uniform"].worst.high


def test_headroom_is_where_the_task_is_learnt():
    """A setting in which Uniform does not follow, or crashes by itself, has none, however much it is crashed."""
    policies = {
        "follows nobody": Policy(0.1, 0.9, 0.29), "never brakes": Policy(0.11, 1.0, 1.0), "b": Policy(0.1, 0.5, 0.3),
        "c": Policy(0.1, 0.4, 1.0), "safe": Policy(0.0, 0.01, 1.0),
    }  # fmt: skip
    settings = [Setting(name, {}, policy) for name, policy in policies.items()]
    assert [each.name for each in settings if each.learnt] == ["b", "c", "safe"]
    assert [each.name for each in settings if each.has_headroom] == ["b", "c"]
    assert multiverse.most_headroom(settings).name == "b"
    assert multiverse.most_headroom([settings[i] for i in (0, 1, 4)]) is None


def confirmation(folder, better, score=1.0, n=30, environment="directional"):
    """A confirmation in which q-fear's rate is ``better`` times Uniform's."""
    rng, policies = np.random.default_rng(4), []
    for method, seed in itertools.product(("uniform", "p75", "rnd", "q-fear"), range(30, 30 + n)):
        worst = rng.uniform(0.2, 0.4) * (better if method == "q-fear" else 1.0)
        own = score if method == "q-fear" else 1.0
        policies.append((environment, method, seed, Policy(0.001, worst, own + 0.02 * rng.normal())))
    return Data.read(written(folder, policies))


def test_confirmation_finds_a_winner_and_no_other(tmp_path):
    """A third of Uniform's rate at its score wins; the same rate does not, nor does a third at nine tenths of it."""
    won = multiverse.contrasts(confirmation(tmp_path / "won", 1 / 3), "directional", "q-fear")
    assert {each.rival for each in won} == {"uniform", "p75", "rnd"}
    uniform = next(each for each in won if each.rival == "uniform")
    assert uniform.is_winner
    assert uniform.n == (30, 30)
    assert uniform.ratio.low < 3.0 < uniform.ratio.high
    assert uniform.lower.low > 0.0
    same = multiverse.contrasts(confirmation(tmp_path / "same", 1.0), "directional", "q-fear")
    assert not any(each.is_winner for each in same)
    assert all(each.p > 0.05 for each in same)
    worse = multiverse.contrasts(confirmation(tmp_path / "worse", 1 / 3, 0.9), "directional", "q-fear")
    assert not any(each.is_winner for each in worse)
    assert multiverse.contrasts(confirmation(tmp_path / "few", 1 / 3, n=2), "directional", "q-fear") == []


def test_confirmation_counts_the_selectors_that_were_tried(tmp_path, monkeypatch):
    """p-values are Holm's over the rivals times three, and intervals are wider than those at 95 %."""
    data = confirmation(tmp_path / "study", 0.9)
    monkeypatch.setattr(multiverse, "p_values", lambda *arguments: (0.01, 0.99))
    found = multiverse.contrasts(data, "directional", "q-fear")
    assert [each.p for each in found] == pytest.approx([0.09] * 3)
    wide = found[0].lower
    monkeypatch.setattr(multiverse, "CONFIDENCE", 0.95)
    narrow = multiverse.contrasts(data, "directional", "q-fear")[0].lower
    assert wide.low < narrow.low < narrow.high < wide.high


@pytest.fixture
def folders(tmp_path):
    """The folders of a screening and of a map in which p75 and q-fear remove most of the danger."""
    settings = simulated(lambda m, levels, base: base * (0.1 if m in ("p75", "q-fear") else 1.0), noise=0.03)
    screened = [(each.name, "uniform", 9201, each.screened) for each in settings]
    mapped = [(each.name, method, 9202, own) for each in settings for method, own in each.policies.items()]
    return written(tmp_path / "screening", screened, points()), written(tmp_path / "map", mapped, points())


def test_tables_become_settings(folders):
    """Rows of both studies meet by the names of their settings."""
    settings = multiverse.read(*folders)
    assert [each.name for each in settings] == [*points()]
    assert {frozenset(each.policies) for each in settings} == {frozenset(METHODS)}
    assert settings[3].levels == points()["map.03"]
    assert multiverse.Roles.of(settings) == multiverse.Roles("p75", "penalty-30")
    assert multiverse.missing(settings) == {}


def without(folder, *cells):
    """Take the rows of some cells, ENVIRONMENT,METHOD, out of the tables of a study."""
    table = folder / "results.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(line for line in lines if not line.startswith(cells)))


def test_a_failed_cell_costs_what_needs_it_and_is_named(folders, tmp_path):
    """Its setting stays in the screening and in the clauses of other methods; the page says what is not there."""

    def page(*cells, map_=folders[1]):
        without(folders[0] if map_ is None else folders[1], *cells)
        write(MultiverseOptions(out=tmp_path / "page", screening=folders[0], map=map_))
        return (tmp_path / "page" / "multiverse.md").read_text()

    screened = page(map_=None)
    assert "given up" not in screened
    text = page("map.05,rnd")
    assert text.startswith(screened)
    assert "| map.05 | rnd |" in text
    settings = multiverse.read(*folders)
    counts = {each.name: len(each.counts_in(settings)) for each in multiverse.headlines(multiverse.Roles.of(settings))}
    assert {name for name, count in counts.items() if count == 31} == {"rnd is unsafe"}
    assert {*counts.values()} == {31, 32}
    others = [each for each in settings if each.name != "map.05"]
    assert multiverse.standings(settings) == multiverse.standings(others)
    assert "Not screened, or given up: map.07, map.09." in page("map.07", "map.09", map_=None)


def test_what_is_no_map_is_refused(folders, tmp_path):
    """Several seeds, settings without Uniform, and methods that are not those of the plan."""
    several = written(tmp_path / "several", [("map.00", "uniform", seed, Policy(0, 0, 1)) for seed in (1, 2)], points())
    with pytest.raises(RunError, match=r"The map has one seed; map\.00 has several of uniform"):
        multiverse.read(several)
    none = written(tmp_path / "none", [("map.00", "rnd", 1, Policy(0, 0, 1))], points())
    with pytest.raises(RunError, match=r"must hold a policy of uniform for every setting; map\.00 has none"):
        multiverse.read(none)
    table = folders[0] / "results.csv"
    kept = [line for line in table.read_text().splitlines(keepends=True) if ",naive," in line or "adversary" in line]
    (tmp_path / "naive").mkdir()
    (tmp_path / "naive" / "results.csv").write_text("".join(kept))
    with pytest.raises(RunError, match=r"No attacker has met all policies of map\.00, so none is the worst"):
        multiverse.read(tmp_path / "naive")
    three = [Setting(str(level), {"env.max_speed": level}, Policy(0, 0, 1)) for level in (5.0, 10.0, "inf")]
    with pytest.raises(RunError, match=r"must have two levels; env\.max_speed has more"):
        multiverse.coded(three)
    parts = [(name, method, 1, Policy(0, 0, 1)) for name, method in (("map.00", "rnd"), ("map.01", "p75"))]
    halves = written(tmp_path / "halves", parts)
    with pytest.raises(RunError, match=r"halves has no setting yet in which all of p75, rnd have finished"):
        multiverse.read(folders[0], halves)
    with pytest.raises(RunError, match="one pNN and one penalty; it has: none"):
        multiverse.Roles.of(multiverse.read(folders[0]))


def test_specification_curve_is_in_order(folders):
    """Dots are the differences by rising size; the matrix below has the levels of the same settings."""
    settings = multiverse.read(*folders)
    figure = multiverse_figures.curve(settings, "p75")
    top, _, matrix = figure.axes
    drawn = sorted(
        tuple(point) for line in top.lines if line.get_marker() == "o" for point in zip(*line.get_data(), strict=True)
    )
    safer = {each.name: 100 * (each.policies["uniform"].worst - each.policies["p75"].worst) for each in settings}
    order = sorted(safer, key=safer.__getitem__)
    assert [y for _, y in drawn] == pytest.approx([safer[name] for name in order])
    levels, design = multiverse.coded(settings)
    assert {levels["env.max_force"][0], levels["env.variant"][1]} == {1.0, "relative"}
    at = {each.name: row for each, row in zip(settings, design, strict=True)}
    assert np.array_equal(matrix.images[0].get_array(), np.array([at[name] > 0 for name in order]).T)
    assert [text.get_text() for text in matrix.get_yticklabels()] == [
        level_named(name, own[1]) for name, own in levels.items()
    ]
    assert "goal range x 1.5" in [text.get_text() for text in matrix.get_yticklabels()]


def test_a_slope_without_an_interval_is_not_drawn(folders):
    """Where a second measurement says nothing of the first, the picture says so and has no line."""
    settings = multiverse.read(*folders)
    lines = [len(axes.lines) for axes in multiverse_figures.over_headroom(settings, ["p75", "rnd"]).axes[:2]]
    assert lines == [3, 3]
    same = [Setting(each.name, each.levels, settings[0].screened, each.policies) for each in settings]
    blind = multiverse_figures.over_headroom(same, ["p75"]).axes[0]
    assert len(blind.lines) == 2
    assert blind.get_title() == "p75: slope\nunknown"


def test_what_moves_clauses_where_there_is_headroom():
    """The exploratory table has the settings with headroom alone, and dashes where these do not tell factors apart."""

    def table(danger):
        settings = simulated(
            lambda m, levels, base: base * (0.2 if m == "p75" and levels["horizon"] == "long" else 1.0), danger=danger
        )
        found = multiverse_page._clauses(settings)[-1]
        return next(row for row in found if row["clause"] == "p75 crashes less than uniform")

    def few(levels, rng):
        return 0.005 if (levels["env.variant"], levels["learner"]) == ("relative", "tuned") else 0.5

    row = table(few)
    assert (row["moved most by"], row["by"], row["beyond chance"]) == ("horizon: short", "-40.0 [-40.0, -40.0]", "yes")
    row = table(lambda levels, rng: 0.005 if levels["env.variant"] == "relative" else 0.5)
    assert (row["moved most by"], row["by"], row["beyond chance"]) == ("-", "-", "-")


def test_page_of_a_map_that_is_not_finished(folders, tmp_path):
    """With settings that do not tell the factors apart the page says so, and has everything else."""
    for folder in folders:
        table = folder / "results.csv"
        lines = table.read_text().splitlines(keepends=True)
        table.write_text("".join([lines[0], *(line for line in lines if line[:6] in ("map.03", "map.15"))]))
    assert multiverse.moved_by([], np.array([])) == {}
    assert multiverse.moved_by(multiverse.read(*folders), np.array([0.1, 0.2])) == {}
    write(MultiverseOptions(out=tmp_path / "page", screening=folders[0], map=folders[1]))
    text = (tmp_path / "page" / "multiverse.md").read_text()
    assert "of 2 settings have headroom" in text
    assert "the 2 that are learnt: the plan has no further round" in text
    assert "These settings are too few to tell the factors apart." in text
    assert "There are no data for this figure: By how much a factor moves" in text
    assert (tmp_path / "page" / "figures" / "curve-p75.png").exists()


def test_page_of_one_setting(folders, tmp_path):
    """Of one setting, or of one where scores can be compared, there are means without intervals."""
    table = folders[1] / "results.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join([lines[0], *(line for line in lines if line.startswith("map.03"))]))
    write(MultiverseOptions(out=tmp_path / "page", screening=folders[0], map=folders[1]))
    assert "| p75 crashes less than uniform | 1 | " in (tmp_path / "page" / "multiverse.md").read_text()
    assert f"{multiverse.mean(np.array([0.5])):g}" == "0.5"


def test_page_says_why_a_selector_is_the_best():
    """It names the rule that chose: safety at enough score, else the score, else safety alone."""
    for score, words in ((1.0, "the most policies below 1 %"), (0.8, "none has 0.95 of Uniform's score"),
                         (0.1, "scores can be compared nowhere")):  # fmt: skip
        settings = simulated(
            lambda method, levels, base: base,
            lambda method, levels, own=score: own if method in NEW or own < 0.3 else 1.0,
        )
        new = multiverse.best_new(multiverse.standings(settings))
        assert words in multiverse_page._mapped(settings, new)[-1]


def test_page_of_other_methods_is_refused(folders, tmp_path):
    """A study that is no map is refused by what it lacks, before anything is chosen of it."""
    without(folders[1], *(f"{name},{method}," for name in points() for method in NEW))
    with pytest.raises(RunError, match="one pNN and one penalty; it has: p75, penalty-30, rnd, uniform"):
        write(MultiverseOptions(out=tmp_path / "page", screening=folders[0], map=folders[1]))


def test_page_says_as_much_as_has_run(folders, tmp_path, capsys):
    """After the screening headroom; after the map clauses, methods, the best and pictures; then the confirmation."""
    out = tmp_path / "page"
    write(MultiverseOptions(out=out, screening=folders[0]))
    text = (out / "multiverse.md").read_text()
    assert all(part in text for part in ("of 32 settings have headroom", "so these are enough"))
    assert "Headline" not in text
    ours, room = tmp_path / "ours", tmp_path / "headroom"
    confirmation(ours, 0.2)
    confirmation(room, 0.2, environment="map.07")
    arguments = [out, "--screening", folders[0], "--map", folders[1], "--confirmations", ours, room]
    assert commands.main(["multiverse", *map(str, arguments)]) == 0
    assert Path(capsys.readouterr().out.strip()) == out / "multiverse.html"
    text = (out / "multiverse.md").read_text()
    assert "The best new selector is q-fear" in text
    assert "| p75 crashes less than uniform | " in text
    assert "Missing cells" not in text
    assert text.count("| q-fear compared with |") == 2
    assert "Code of all rows: v." in text
    assert text.split("## Confirmation")[1].count("q-fear is a winner here") == text.count("winner") == 1
    pictures = {path.stem for path in (out / "figures").glob("*.png")}
    assert pictures == {*(f"curve-{name}" for name in METHODS if name != "uniform"), "headroom", "shares", "factors"}
