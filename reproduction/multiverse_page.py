"""The page of the map: results of screening, map and confirmation, as far as they have run (plan: multiverse.md)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from deimos.files import write_bytes
from deimos.study import figures, plan, stats
from deimos.study.data import Data
from deimos.study.document import Block, to_html, to_markdown
from reproduction import multiverse
from reproduction.measures import SAFE
from reproduction.multiverse import (
    AIM,
    AIM_SCORE,
    HEADROOM,
    LEARNT,
    LEAST_SCORE,
    MOST_CRASHES,
    NEW,
    UNIFORM,
    Roles,
    Setting,
)
from reproduction.multiverse_figures import draw, level_named, named, slope_named

FIGURES = "figures"
TOO_FEW = "These settings are too few to tell the factors apart."
STUDY = Path(__file__).parent / "studies" / "multiverse_screening.toml"
ENOUGH = 16  # settings with headroom: no other round of screening
OURS = "directional"  # the environment of multiverse_ours.toml: the confirmation to which the aim applies


@dataclass(frozen=True, kw_only=True)
class MultiverseOptions:
    """Write the page of the map over what the thesis leaves open, as far as its studies have run."""

    out: tyro.conf.Positional[Path]
    """Folder of multiverse.html, multiverse.md and figures; created if it does not exist."""
    screening: Path = Path("runs/multiverse_screening")
    """Folder of the screening."""
    map: Path | None = None
    """Folder of the map."""
    confirmations: tuple[Path, ...] = ()
    """Folders of confirmations."""


def write(options: MultiverseOptions) -> Path:
    """Write the page; returns the path of its HTML. Raises ``RunError`` if results are missing or do not fit."""
    settings = multiverse.read(options.screening, options.map)
    (options.out / FIGURES).mkdir(parents=True, exist_ok=True)
    studies = [each for each in (options.screening, options.map, *options.confirmations) if each is not None]
    blocks: list[Block] = ["# The map", _ran_from(studies), *_screened(settings)]
    if options.map is not None:
        Roles.of(settings)  # is it a map?
        new = multiverse.best_new(multiverse.standings(settings))
        with figures.print_size():
            pictures = figures.write(draw(settings), options.out / FIGURES)
        blocks += [*_mapped(settings, new), "## Figures", *pictures]
        for folder in options.confirmations:
            blocks += _confirmed(Data.read(folder), new)
    for name, text in (
        ("multiverse.md", to_markdown(blocks, FIGURES)), ("multiverse.html", to_html(blocks, options.out / FIGURES))
    ):  # fmt: skip
        write_bytes(options.out / name, text.encode())
    return options.out / "multiverse.html"


def _ran_from(studies: Sequence[Path]) -> str:
    """Where the plan is, and the code that the rows come from."""
    codes = sorted({row["code"] for folder in studies for row in Data.read(folder).rows})
    return f"Plan, committed before the first cell: reproduction/multiverse.md. Code of all rows: {', '.join(codes)}."


def _screened(settings: Sequence[Setting]) -> list[Block]:
    """Settings with headroom, and the factors that affect it."""
    room = sum(each.has_headroom for each in settings)
    learnt = sum(each.learnt for each in settings)
    verdict = "enough" if room >= ENOUGH else "too few: adjust the levels as the plan says"
    if learnt < ENOUGH:
        verdict = f"too few, and so are the {learnt} that are learnt: the plan has no further round"
    chosen = multiverse.most_headroom(settings)
    rows = [
        {"setting": each.name, **{named(name): str(level) for name, level in each.levels.items()},
         "Naive [%]": f"{100 * each.screened.naive:.2f}", "attacked [%]": f"{100 * each.screened.worst:.1f}",
         "score": f"{each.screened.score:.2f}", "learnt": "yes" if each.learnt else "no",
         "headroom": "yes" if each.has_headroom else "no"}
        for each in sorted(settings, key=lambda each: -each.screened.worst)
    ]  # fmt: skip
    moved = multiverse.moved_by(settings, 100 * np.array([each.screened.worst for each in settings]))
    rule = f"a score of {LEARNT} or more, and at most {100 * MOST_CRASHES:g} % of crashes under Naive"
    names = {each.name for each in settings}
    lost = [name for name in dict.fromkeys(x.environment for x in plan.expand(plan.read(STUDY))) if name not in names]
    return [
        "## Screening",
        f"{room} of {len(settings)} settings have headroom: Uniform has learnt the task ({rule}) and its attacked "
        f"rate is above {100 * HEADROOM:g} %. {ENOUGH} are needed, so these are {verdict}.",
        *([f"Not screened, or given up: {', '.join(lost)}."] if lost else []),
        f"Most headroom: {chosen.name if chosen else 'none'}.", rows,
        *(["What moves Uniform's attacked rate [points]:", _moves(settings, moved)] if moved else [TOO_FEW]),
    ]  # fmt: skip


def _moves(settings: Sequence[Setting], moved: dict[str, stats.Interval]) -> Block:
    levels, _ = multiverse.coded(settings)
    return [{"factor": f"{level_named(name, levels[name][1])} (not {levels[name][0]})",
             "effect [95 %, of all factors at once]": f"{effect:.1f}"} for name, effect in moved.items()]  # fmt: skip


def _moved_most(settings: Sequence[Setting], clause: multiverse.Headline) -> dict[str, str]:
    """The factor with the largest effect on a clause's margin, as the cells of a row."""
    own = clause.counts_in(settings)
    moved = multiverse.moved_by(own, 100 * multiverse.margins(own, clause))
    if not moved:
        return dict.fromkeys(("moved most by", "by", "beyond chance"), "-")
    levels, _ = multiverse.coded(own)
    name, effect = next(iter(moved.items()))
    beyond = effect.low > 0.0 or effect.high < 0.0
    return {"moved most by": level_named(name, levels[name][1]), "by": f"{effect:.1f}",
            "beyond chance": "yes" if beyond else "no"}  # fmt: skip


def _clauses(settings: Sequence[Setting]) -> list[Block]:
    """In how many settings each clause holds, and the factors that affect it."""
    room = [each for each in settings if each.has_headroom]
    rows, exploratory = [], []
    for clause in multiverse.headlines(Roles.of(settings)):
        share, values = multiverse.share_that_holds(settings, clause), 100 * multiverse.margins(settings, clause)
        rows.append({
            "clause": clause.text, "settings with headroom": str(len(clause.counts_in(room))), "holds in [%]":
            "-" if share is None else f"{100 * share.estimate:.0f} [{100 * share.low:.0f}, {100 * share.high:.0f}]",
            "of all settings": str(len(values)), "mean margin": f"{multiverse.mean(values):.2f}",
            **_moved_most(settings, clause),
        })  # fmt: skip
        exploratory.append({"clause": clause.text, **_moved_most(room, clause)})
    return [
        "## Headline clauses", rows,
        f"Exploratory: what moves the margins over the {len(room)} settings with headroom alone. "
        "A dash: these do not tell the factors apart.", exploratory,
    ]  # fmt: skip


def _missing(settings: Sequence[Setting]) -> list[Block]:
    """The missing cells of the map, and what that means."""
    if not (lacking := multiverse.missing(settings)):
        return []
    return [
        "## Missing cells",
        "A clause leaves out the settings that lack one of its methods, the comparison of methods all of these.",
        [{"setting": name, "no policy of": ", ".join(methods)} for name, methods in lacking.items()],
    ]


def _mapped(settings: Sequence[Setting], new: str) -> list[Block]:
    """Headline clauses, standings and the selection."""
    standing = [
        {"method": each.method, "policies below 1 % [%]": f"{100 * each.safe.estimate:.0f}",
         "95 %": f"[{100 * each.safe.low:.0f}, {100 * each.safe.high:.0f}]",
         "mean attacked rate": f"{each.worst:.3f}", "score / Uniform's where learnt": f"{each.score:.3f}",
         "slope of its gain over Uniform's danger":
         "-" if each.method == UNIFORM else slope_named(multiverse.gain_slope(settings, each.method))}
        for each in multiverse.standings(settings)
    ]  # fmt: skip
    chosen = multiverse.most_headroom(settings)
    return [
        *_clauses(settings), "## Methods", standing, *_missing(settings),
        f"The best new selector is {new}: {_why(settings, new)}. "
        f"Confirmation: --methods with {new}" + (f", and --environments {chosen.name}." if chosen else "."),
    ]  # fmt: skip


def _why(settings: Sequence[Setting], new: str) -> str:
    """Why a new selector was chosen as the best."""
    score = next(each.score.estimate for each in multiverse.standings(settings) if each.method == new)
    if np.isnan(score):
        return "the safest; scores can be compared nowhere"
    if score < LEAST_SCORE:
        return f"none has {LEAST_SCORE} of Uniform's score, and it comes nearest"
    return f"the most policies below 1 % at {LEAST_SCORE} of Uniform's score or more"


def _confirmed(data: Data, new: str) -> list[Block]:
    """Means of the methods of a confirmation, and the best new selector compared with each of the others."""
    blocks: list[Block] = []
    for environment in data.environments:
        own = [row for row in data.rows if (row["environment"], row["goals"]) == (environment, "naive")]
        rows = []
        for name in data.methods(environment):
            worst, score = (
                np.array([row[key] for row in own if row["method"] == name]) for key in ("worst", "score")
            )  # fmt: skip
            rows.append({
                "method": name, "n": str(len(worst)), "mean attacked rate": f"{worst.mean():.4f}",
                "below 1 %": f"{(worst < SAFE).mean():.2f}", "mean score": f"{score.mean():.3f}",
            })  # fmt: skip
        found = multiverse.contrasts(data, environment, new)
        lines = [
            {f"{new} compared with": each.rival, "n": f"{each.n[0]} + {each.n[1]}",
             "attacked rate lower by": f"{each.lower:.4f}", "rival's rate / its rate": f"{each.ratio:.2f}",
             "its score / rival's": f"{each.score:.3f}", "p": f"{each.p:.3g}"}
            for each in found
        ]  # fmt: skip
        blocks += [f"## Confirmation: {environment}", rows]
        if not lines:
            blocks.append(f"Means without tests: there are too few policies of {new}, or of others, for a contrast.")
            continue
        blocks += [
            f"Intervals are at {100 * multiverse.CONFIDENCE:.1f} %; p-values are one-sided, by Holm's rule over the "
            f"rivals, times the {len(NEW)} selectors that were tried.", lines,
        ]  # fmt: skip
        blocks += _winner(found, new) if environment == OURS else []
    return blocks


def _winner(found: Sequence[multiverse.Contrast], new: str) -> list[Block]:
    """Whether the aim is met, where Uniform is among the rivals."""
    uniform = next((each for each in found if each.rival == UNIFORM), None)
    if uniform is None:
        return []
    aim = f"a rate lower than Uniform's by a factor of {AIM:g} or more at {AIM_SCORE} of its score or more"
    return [f"{new} is {'a winner' if uniform.is_winner else 'no winner'} here; the aim was {aim}."]
