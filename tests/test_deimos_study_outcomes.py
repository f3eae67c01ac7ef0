"""The figures of what came out: safety against score, delivered dose, maps of goals, levels of factors."""

import math

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from deimos.run.trainer import TrainConfig
from deimos.sim.envs.particle import Config
from deimos.study import figures, outcomes, report
from deimos.study.audits import BINS
from deimos.study.data import Data
from deimos.study.plan import Cell
from deimos.study.results import CURVE_COLUMNS, RESULT_COLUMNS, Results
from reproduction import figures as thesis

EMPTY = {str: "v", int: 100, float: 0.5, bool: False, tuple: (), dict: {}, list: []}


def study(*, environments=("directional",), methods=("uniform", "p25", "p75"), seeds=3, curve=True, **columns):
    """A study's data; ``columns`` are added to its rows, curves tell the dose, fits and places of goals."""
    rows, curves = [], []
    for environment in environments:
        for i, method in enumerate(methods):
            for seed in range(seeds):
                key = {"environment": environment, "method": method, "seed": seed, "setting": environment,
                       "selector": method, "hash": f"{environment}{method}{seed}", "block": None}  # fmt: skip
                for goals in ("naive", "adversary"):
                    row = {name: EMPTY[kind] for name, kind in RESULT_COLUMNS.items()} | key
                    values = {
                        "worst": math.nan,
                        "crash_rate": (i + 1) * 0.01 * (goals != "naive"),
                        "score": 0.9 - 0.1 * i - 0.01 * seed,
                    }
                    rows.append(row | {"goals": goals} | values | columns.get(environment, {}))
                line = {name: EMPTY[kind] for name, kind in CURVE_COLUMNS.items()} | key
                line |= {
                    "env_steps": (24.0, 48.0, 72.0),
                    "reward": (0.1, 0.2, 0.3),
                    "crashes_per_1000": (3.0, 2.0, 0.0),
                }
                if curve:
                    line |= {"goal_percentile": (50.0, 50.0 + 20 * i, 50.0 + 40 * i)}
                    line |= {"goal_map": tuple([5.0] * BINS**2)}
                    line |= {"fear_fitted": (0.0, 1.0, 1.0 - seed / 2)} if i else {}
                curves.append(line)
    return Data(Results(rows, curves), thesis.STYLE)


def dots(axes):
    """The points of all lines of some axes."""
    return np.concatenate([np.transpose(line.get_data()) for line in axes.lines])


def test_safety_is_read_from_the_worst_attacker():
    """Where rows know the worst attacker, every policy's rate is that; otherwise it is that of the Adversary."""
    rate, score = outcomes.pairs(study(), "directional", 100, "p25")
    assert rate == pytest.approx([2.0, 2.0, 2.0])
    assert score == pytest.approx([0.8, 0.79, 0.78])
    known = study(directional={"worst": 0.25})
    assert outcomes.attacked(known, "directional", 100).by == "the worst attacker"
    rate, _ = outcomes.pairs(known, "directional", 100, "p25")
    assert rate == pytest.approx([25.0, 25.0, 25.0])


def test_all_policies_count():
    """A policy whose attacker found nothing to learn from is in every sample and said in the text."""
    data = study(directional={"weak_adversary": True, "uninformed": True})
    assert all(len(outcomes.pairs(data, "directional", 100, name)[0]) == 3 for name in ("uniform", "p25", "p75"))
    text = "".join(block for block in report.what_was_run(data) if isinstance(block, str))
    assert "directional: p25 6, p75 6, uniform 6" in text


def test_the_front_has_what_no_other_beats():
    """A method is on the front unless another has fewer crashes at no lower score, or more score at no more crashes."""
    points = {"a": (0.0, 0.5), "b": (1.0, 0.4), "c": (2.0, 0.9), "d": (2.0, 0.8), "e": (5.0, 0.9), "f": (9.0, 1.0)}
    assert outcomes.unbeaten(points) == ["a", "c", "f"]


def test_every_policy_is_a_dot():
    """The figure of score against safety has each policy at its rate and score, and each method's medians."""
    figure = outcomes.pareto(study(), "directional", 100)
    found = {tuple(point) for point in dots(figure.axes[0]).round(9).tolist()}
    assert {(1.0, 0.9), (1.0, 0.88), (2.0, 0.79), (3.0, 0.68)} <= found
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["p25", "p75", "uniform"]


def test_a_legend_takes_names_of_any_length():
    """Below a figure stand as many names in a row as fit, and at least one."""
    columns = []
    for length in (3, 40, 400):
        figure, _ = figures.subplots(1, 1, (7.0, 2.0))
        names = [letter * length for letter in "abcd"]
        figures.legend(figure, Data(study(methods=names)._results).style, names, "below")
        columns.append(figure.legends[0]._ncols)
    assert columns[0] >= 4 > columns[1] > columns[2] == 1


def drawn(figure):
    """A renderer that has drawn a figure, which places what is in it."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.get_renderer()


def test_nothing_is_cut_off_where_methods_are_many():
    """Legends lie within their figures however many methods there are, and titles of panels do not meet."""
    data = study(methods=[name for name in thesis.STYLE.order if name not in ("directional", "absolute")])
    assert len(data.methods("directional")) > 25
    with figures.print_size():
        for draw in (outcomes.pareto, outcomes.dose, outcomes.profiles):
            figure = draw(data, "directional", 100)
            renderer = drawn(figure)
            legend = figure.legends[0].get_window_extent(renderer)
            assert 0 <= legend.y0 < legend.y1 <= figure.bbox.y1, draw.__name__
            assert 0 <= legend.x0 < legend.x1 <= figure.bbox.x1, draw.__name__
    titles = [panel.title.get_window_extent(renderer) for panel in figure.axes if panel.get_title()]
    assert len(titles) == 3
    assert titles[0].x1 < titles[1].x0 < titles[1].x1 < titles[2].x0
    labels = [panel.get_ylabel() for panel in figure.axes if panel.get_ylabel()]
    assert [label.partition("under ")[2] for label in labels] == ["uniform goals", "the Adversary"]


def test_boxes_say_how_many_policies_they_have():
    """Beside every box stands the number of its policies, also where one has no score."""
    data = study(seeds=4)
    data.rows[0]["score"] = math.nan  # of Uniform's first policy
    panels = outcomes.boxes(data, "directional", 100).axes
    texts = [[text.get_text() for text in panel.texts] for panel in panels]
    assert texts == [["n", "4", "4", "4"], ["n", "4", "4", "4"], ["n", "4", "4", "3"]]


def test_dose_is_what_training_delivered():
    """Policies are drawn over the mean percentile of their whole training; without it there is no figure."""
    data = study()
    assert data.delivered("directional", "p75") == pytest.approx(dict.fromkeys(range(3), 70.0 + 20.0))
    left, right = outcomes.dose(data, "directional", 100).axes
    assert {x for x, _ in dots(left).round(6).tolist()} == {50.0, 70.0, 90.0}
    assert {y for _, y in dots(right).round(6).tolist()} == {1.0, 2.0, 3.0}
    assert right.get_ylim() == (1.0, 5.0)  # no decades that nothing is in
    assert outcomes.dose(study(curve=False), "directional", 100) is None


def test_shifted_goals_stand_beside_the_dose():
    """Every Uniform policy has a line through its rules by rising percentile; without rows it is as in any study."""
    rows = [
        {"environment": "directional", "goal_period": 100, "seed": seed, "fear": fear, "percentile": p,
         "score": 1 - p / 100, "crash_rate": p / 1000}
        for seed in range(2) for fear in ("learnt", "exact") for p in (90.0, 10.0, 50.0)
    ]  # fmt: skip
    figure = thesis.dose_response(study(), "directional", 100, rows)
    right = figure.axes[1]
    assert [line.get_xdata().tolist() for line in right.lines] == [[10.0, 50.0, 90.0]] * 4
    assert figure.axes[3].lines[0].get_ydata() == pytest.approx([1.0, 5.0, 9.0])
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["learnt fear", "exact fear"]
    unlearnt = thesis.dose_response(study(curve=False), "directional", 100, rows)
    assert "delivered dose:\nnot recorded" in [text.get_text() for text in unlearnt.axes[0].texts]
    assert unlearnt.axes[1].yaxis.get_ticklocs().size  # of the scores under shifted goals, on a scale that both share
    own, without = (thesis.figures(study(), "directional", given)["dose-directional-T100"] for given in (rows, []))
    assert (own[0].endswith(thesis.SHIFTED), without[0].endswith(thesis.SHIFTED)) == (True, False)
    assert len(own[1].axes) == 2 * len(without[1].axes)


def test_methods_of_the_populations_can_be_told_apart():
    """Literal Directors have their own panel; no two methods share both colour and marker, whichever a study has."""
    data = Data(study(methods=("uniform", "p25", "p25-literal", "p75-literal", "rnd"))._results, thesis.STYLE)
    assert len({(data.style.colours[name], data.style.marker(name)) for name in thesis.STYLE.colours}) == len(
        thesis.STYLE.colours
    )
    titles = [axes.get_title() for axes in figures.training(data, "directional").axes[:3]]
    assert titles == ["the thesis's Directors", "crash memory, controls", "baselines"]
    only = Data(study(methods=("uniform", "rnd"))._results, thesis.STYLE)
    assert [axes.get_title() for axes in figures.training(only, "directional").axes] == ["baselines", "", ""]


def test_maps_have_the_share_of_goals_at_a_place():
    """Each method has a map of the goals given the place, and their diversity, which is 1 of uniform ones."""
    figure = outcomes.goal_maps(study(), "directional")
    titles = [axes.get_title() for axes in figure.axes if axes.images]
    assert titles == ["p25\n1.00", "p75\n1.00", "uniform\n1.00"]
    assert np.asarray(figure.axes[0].images[0].get_array()) == pytest.approx(np.full((BINS, BINS), 1 / BINS))
    assert outcomes.goal_maps(study(curve=False), "directional") is None


def test_strips_show_where_fear_did_not_learn():
    """A method with a fear network has the share of rollouts without a fit; others, and old rows, have none."""
    data = study()
    assert figures.unfitted(data, "directional", "p25") == pytest.approx([1.0, 0.0, 0.5])
    assert figures.unfitted(data, "directional", "uniform") is None
    assert figures.unfitted(study(curve=False), "directional", "p25") is None
    figure = figures.training(study(curve=False), "directional")
    assert "where fear did not learn:\nnot recorded" in [text.get_text() for text in figure.axes[4].texts]


def test_training_curves_are_medians(monkeypatch):
    """The line of a method is the median over its seeds, not their mean."""
    data = study(methods=("uniform",))
    for seed, line in enumerate(data._results.curves):
        line["reward"] = tuple(np.array([1.0, 2.0, 3.0]) + (100.0 if seed == 2 else seed))
    figure = figures.training(data, "directional")
    line = figure.axes[1].lines[0]  # a column of panels: uniform is a baseline
    assert line.get_ydata() == pytest.approx([2.0, 3.0, 4.0])


def test_levels_are_drawn_by_factor(tmp_path, monkeypatch):
    """A design has a column for each factor with its levels in order, and no figures of its single settings."""
    levels = {
        f"directional.{i}": {"base_environment": "directional", "levels": {"env.max_force": force, "reward": reward}}
        for i, (force, reward) in enumerate([(1, "linear"), ("inf", "linear"), (1, "sharp"), ("inf", "sharp")])
    }
    data = study(environments=tuple(levels), **levels)
    figure = outcomes.levels(data, "directional", 100)
    below = figure.axes[2:4]
    assert [axes.get_xlabel() for axes in below] == ["env.max_force", "reward"]
    assert [[text.get_text() for text in axes.get_xticklabels()] for axes in below] == [
        ["1", "inf"], ["linear", "sharp"],
    ]  # fmt: skip
    monkeypatch.setattr(Data, "read", lambda folder, style: data)
    report.write(tmp_path, tmp_path)
    assert {path.stem for path in (tmp_path / "figures").glob("*.png")} == {"levels-directional-T100"}
    text = (tmp_path / "report.md").read_text()
    assert "directional with env.max_force inf, reward sharp." in text
    assert "## By level\n\n![directional, T = 100: crashes under attack and score by the level" in text


def test_many_levels_are_quarters():
    """A sample of a range is drawn by quarters, and levels keep their order, numbers before names."""
    assert outcomes._grouped(["inf", 2, 1, 2.5, 1]) == {"1": [1], "2": [2], "2.5": [2.5], "inf": ["inf"]}
    assert outcomes._grouped([[64, 64], [32]]) == {"[32]": [[32]], "[64, 64]": [[64, 64]]}
    quarters = outcomes._grouped([0.5, *range(1, 8)])
    assert quarters == {"0.5\nto 1": [0.5, 1], "2\nto 3": [2, 3], "4\nto 5": [4, 5], "6\nto 7": [6, 7]}


def test_hyper_parameters_stand_in_one_table():
    """Every field has its value in each environment; what the grid sets, and what is not set, is left out."""
    sizes = {"directional": 64, "relative": 32}
    cells = [
        Cell(environment=name, config=TrainConfig(method="p25", num_envs=count, env=Config(variant=name)),
             goal_periods=(100,)) for name, count in sizes.items()
    ]  # fmt: skip
    (table,) = report.hyper_parameters({cell.environment: cell.to_dict()["config"] for cell in cells})
    rows = {row.pop("field"): row for row in table}
    assert rows["num_envs"] == {"directional": "64", "relative": "32"}
    assert rows["env.variant"] == {"directional": "directional", "relative": "relative"}
    assert rows["ppo.hidden"]["directional"] == "64 64"
    assert not {"method", "seed", "env.goal_range"} & set(rows)
    assert report.hyper_parameters({}) == ["They are in the cells of the study, which are not beside these tables."]
