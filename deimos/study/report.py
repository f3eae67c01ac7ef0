"""The report of a study: what was run, tables, figures, claims and limits, as HTML and as Markdown."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deimos.run.folder import RunError
from deimos.study import claims, stats
from deimos.study.claim_list import CLAIMS
from deimos.study.claim_tests import FACTOR, LEAST, PROBABILITY, REWARD_SHARE, SPREAD
from deimos.study.claims import Outcome
from deimos.study.data import Data, Where
from deimos.study.document import Block, Bullets, Heading, Paragraph, Picture, Table, to_html, to_markdown
from deimos.study.figures import draw_all
from deimos.study.presets import LEGGED_METHODS
from deimos.study.stats import Array, Interval
from reproduction.thesis import TABLE_4_1

FIGURES = "figures"
COVERAGE = (  # deimos study coverage, its defaults
    "The intervals of IQMs and medians are percentile bootstraps: they cover 93 to 94 % at n = 10, on normal and on "
    "lognormal data. Means have bootstrap-t intervals (94 % and 91 %); the percentile bootstrap would cover 90 % and "
    "81 %, BCa 90 % and 83 %. Intervals of ratios of spread cover more than 99 %: they are too wide, they only "
    "describe, and no difference is called on them. `deimos study coverage` measures all of this again."
)


def write(folder: Path, out: Path, *, resamples: int = stats.RESAMPLES, seed: int = 0) -> Path:
    """Write ``report.html``, ``report.md`` and ``figures/``.

    Args:
        folder: Study folder with its tables.
        out: Where to write; made if it is not there.
        resamples: Bootstrap resamples of the tables.
        seed: Of the bootstrap.

    Returns:
        Path of the HTML page.

    Raises:
        RunError: If there are no results, or something cannot be read or written.
    """
    data = Data.read(folder)
    try:
        (out / FIGURES).mkdir(parents=True, exist_ok=True)
        captions = draw_all(data, out / FIGURES)
        blocks = page(data, captions, resamples=resamples, seed=seed)
        (out / "report.md").write_text(to_markdown(blocks, FIGURES))
        (out / "report.html").write_text(to_html(blocks, out / FIGURES))
    except OSError as error:
        raise RunError(f"The report in {out} could not be written ({error.strerror}).") from error
    return out / "report.html"


def page(data: Data, captions: dict[str, str], *, resamples: int = stats.RESAMPLES, seed: int = 0) -> list[Block]:
    """The blocks of the report.

    Args:
        data: The results.
        captions: Of the figures, by their names.
        resamples: Bootstrap resamples of the tables.
        seed: Of the bootstrap.
    """
    outcomes = [claims.test(claim, data.only(LEGGED_METHODS)) for claim in CLAIMS]
    blocks: list[Block] = [Heading("A study of goal selection", 1), *_what_was_run(data), *_verdicts(outcomes)]
    for environment in data.environments:
        blocks.append(Heading(environment))
        for where in [w for period in data.periods(environment) for w in _places(environment, period)]:
            blocks += _table(data, where, resamples, seed)
        blocks += [Picture(name, text) for name, text in captions.items() if f"-{environment}-" in f"{name}-"]
    blocks += _over_all(data, resamples, seed)
    blocks += _speed(data)
    blocks += [block for outcome in outcomes for block in _details(outcome)]
    return [*blocks, *_limits(data)]


def _places(environment: str, period: int) -> list[Where]:
    return [Where(environment, goals, period) for goals in ("naive", "adversary", "oracle")]


def _what_was_run(data: Data) -> list[Block]:
    rows = []
    for environment in data.environments:
        own = [row for row in data.rows if row["environment"] == environment]
        seeds = {name: {row["seed"] for row in own if row["method"] == name} for name in data.methods(environment)}
        counts = Counter(len(found) for found in seeds.values())
        rows.append([
            environment, ", ".join(seeds), ", ".join(f"{n} seeds x {k} methods" for n, k in sorted(counts.items())),
            _values(own, "num_envs"), _values(own, "env_steps"), _values(own, "trained_period"),
            _values(own, "goal_period"), f"{_values(own, 'worlds')} x {_values(own, 'steps')}", _values(own, "setting"),
        ])  # fmt: skip
    header = ["environment", "methods", "runs", "worlds", "parallel steps", "T in training", "T evaluated",
              "evaluation: worlds x steps", "setting"]  # fmt: skip
    versions = sorted({f"{row['device']}, {row['versions']}" for row in data.rows})
    adversaries = [row for row in data.rows if row["goals"] == "adversary"]
    weak = f"{len(data.weak)} of {len(adversaries)} evaluations by the Adversary are marked weak and left out"
    if data.weak:
        counted = Counter((row["environment"], row["method"]) for row in data.weak)
        parts = [f"{place}: " + ", ".join(f"{name} {counted[place, name]}" for name in data.methods(place)
                                          if counted[place, name]) for place in data.environments
                 if any(where == place for where, _ in counted)]  # fmt: skip
        weak += (
            f" ({'; '.join(parts)}). A policy that hardly ever crashes gives its Adversary nothing to learn from, so "
            "what is left of a method with many of them are its least safe policies"
        )
    weak += "."
    return [
        Heading("What was run"),
        Table(header, rows),
        Paragraph(weak),
        Paragraph("By: " + "; ".join(versions) + "."),
    ]


def _values(rows: Sequence[dict], column: str) -> str:
    return ", ".join(map(str, sorted({row[column] for row in rows})))


def _verdicts(outcomes: Sequence[Outcome]) -> list[Block]:
    counts: Counter[str] = Counter(outcome.verdict for outcome in outcomes)
    summary = ", ".join(f"{counts[verdict]} {verdict}" for verdict in claims.VERDICTS)
    rows = [
        [o.claim.id, o.claim.text, _verdict(o), f"{o.made} of {o.claim.planned}", _tally(o), ", ".join(o.missing)]
        for o in outcomes
    ]
    return [
        Heading("Claims"),
        Paragraph(
            f"Of the thesis's {len(outcomes)} claims: {summary}. They are tested on the thesis's own methods; the "
            "tests of each, with effects, are below."
        ),
        Table(["claim", "what the thesis says", "verdict", "tests made", "what they say", "without data"], rows),
    ]


def _verdict(outcome: Outcome) -> str:
    return outcome.verdict + (", in part" if outcome.in_part else "")


def _tally(outcome: Outcome) -> str:
    counts: Counter[str] = Counter(each.verdict for each in outcome.judged)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in claims.VERDICTS if counts[verdict])


def _table(data: Data, where: Where, resamples: int, seed: int) -> list[Block]:
    methods = [name for name in data.methods(where.environment) if len(data.sample(where, name, "crashes")) >= 2]
    if not methods:
        return []
    uniform, parts = data.sample(where, "uniform", "crashes"), data.parts(where)
    rows = []
    for name in methods:
        crashes, reward = (data.sample(where, name, metric) for metric in ("crashes", "reward"))
        score, rate = data.sample(where, name, "score"), data.sample(where, name, "crash_rate")
        more = "-"
        if name != "uniform" and len(uniform) >= 2:
            pair = [(crashes, uniform)]
            more = _interval(stats.probability_of_improvement(pair, resamples=resamples, seed=seed), ".2f")
        rows.append([
            name, str(len(crashes)),
            _boot(crashes, _median, resamples, seed), _boot(crashes, stats.iqm, resamples, seed),
            _interval(_of_counts(stats.bootstrap_t(crashes, resamples=resamples, seed=seed))),
            _boot(crashes, stats.cvar, resamples, seed), _boot(crashes, stats.iqr, resamples, seed),
            " to ".join(f"{x:.3g}" for x in np.quantile(crashes, [0.1, 0.9])),
            f"{np.median(rate):.4f}" if len(rate) else "-", _boot(reward, stats.iqm, resamples, seed, ".4f"),
            _boot(score, stats.iqm, resamples, seed, ".3f"), more,
            *[_boot(data.sample(where, name, part), stats.iqm, resamples, seed, ".3g") for part in parts],
        ])  # fmt: skip
    header = ["method", "seeds", "crashes: median", "IQM", "mean", "worst 20 % (CVaR)", "IQR", "10 % to 90 %",
              "crashes per interaction", "reward: IQM", "score: IQM", "P(more crashes than uniform)",
              *[_part_name(part) for part in parts]]  # fmt: skip
    return [Heading(str(where), 3), Table(header, rows)]


def _part_name(part: str) -> str:
    column, _, name = part.partition(":")
    return f"tracking of goal group {name}: IQM" if column == "tracking" else f"{name}, median over goals: IQM"


def _median(x: Array) -> Array:
    return np.median(x, axis=-1)


def _boot(x: Array, statistic: stats.Statistic, resamples: int, seed: int, form: str = ".3g") -> str:
    if len(x) < 2:
        return "-"
    return _interval(stats.bootstrap([x], statistic, resamples=resamples, seed=seed), form)


def _of_counts(interval: Interval) -> Interval:
    """Where most policies do not crash, the bootstrap-t is wide on both sides; counts are not below 0."""
    return replace(interval, low=max(interval.low, 0.0))


def _interval(interval: Interval, form: str = ".3g") -> str:
    if math.isnan(interval.low):
        return format(interval.estimate, form)
    return f"{interval.estimate:{form}} [{interval.low:{form}}, {interval.high:{form}}]"


def _over_all(data: Data, resamples: int, seed: int) -> list[Block]:
    """Safety over all environments and T, by the stratified bootstrap, for the methods that were run in all."""
    blocks: list[Block] = []
    for goals in ("naive", "adversary"):
        places = [place for environment in data.environments for place in data.places(environment, goals)]
        shared = [name for name in data.methods(data.environments[0])
                  if all(len(data.sample(place, name, "crashes")) >= 2 for place in places)]  # fmt: skip
        if len(places) < 2 or len(shared) < 2:
            continue
        worst = [max(data.sample(place, name, "log_crashes").max() for name in shared) for place in places]
        rows = []
        for name in shared:
            safety = [1 - data.sample(place, name, "log_crashes") / max(most, 1e-9)
                      for place, most in zip(places, worst, strict=True)]  # fmt: skip
            found = stats.bootstrap(safety, lambda *x: stats.iqm(np.concatenate(x, axis=-1)),
                                    resamples=resamples, seed=seed)  # fmt: skip
            rows.append([name, _interval(found, ".3f")])
        blocks += [Heading(f"Against the {goals.capitalize()}, {len(places)} evaluations together", 3),
                   Table(["method", "safety: IQM [95 %]"], rows)]  # fmt: skip
    if not blocks:
        return []
    text = "Safety is 1 - log(1 + crashes) / log(1 + most crashes of any policy of that evaluation)."
    return [Heading("Over all environments"), Paragraph(text), *blocks]


def _speed(data: Data) -> list[Block]:
    rows = []
    for environment in data.environments:
        place = data.places(environment, "naive")[:1]
        if not place:
            continue
        fps = {name: data.sample(place[0], name, "fps") for name in data.methods(environment)}
        uniform = fps.get("uniform", np.array([]))
        thesis: dict[str, int] = TABLE_4_1.get(environment, {})
        for name, values in fps.items():
            if len(values) < 2:
                continue
            error = values.std(ddof=1) / math.sqrt(len(values))
            ratio = f"{values.mean() / uniform.mean():.2f}" if len(uniform) else "-"
            known = thesis.get("p25" if name[1:].isdigit() else name)
            theirs = f"{known / thesis['uniform']:.2f}" if known else "-"
            rows.append([environment, name, f"{values.mean():.0f} ± {error:.0f}", ratio, theirs])
    text = (
        "Frames per second over all worlds during training, learning included: mean over seeds ± standard error. The "
        "thesis's hardware is not known: only ratios compare, and only among runs of one kind of machine."
    )
    header = ["environment", "method", "FPS", "ratio to Uniform", "the thesis's ratio"]
    return [Heading("Speed (Table 4.1)"), Paragraph(text), Table(header, rows)] if rows else []


def _details(outcome: Outcome) -> list[Block]:
    claim = outcome.claim
    blocks: list[Block] = [Heading(f"{claim.id}: {_verdict(outcome)}", 3), Paragraph(claim.text)]
    blocks.append(Paragraph(f"Test: {claim.test}." + (f" {claim.note}" if claim.note else "")))
    rows = [
        [
            str(each.finding.where), each.finding.what, " + ".join(map(str, each.finding.n)), each.finding.effect,
            _interval(each.finding.interval), f"{each.p:.2g}",
            f"{'none' if math.isinf(each.detectable) else format(each.detectable, '.2g')} "
            f"(wanted {each.finding.wanted:.2g})",
            each.verdict + ("" if each.finding.required else " (can only contradict)"),
        ]
        for each in outcome.judged
    ]  # fmt: skip
    header = ["where", "what", "n", "effect", "size [95 %]", "p", "minimum detectable effect", "verdict"]
    return [*blocks, Table(header, rows)] if rows else [*blocks, Paragraph("There are no data for it here.")]


def _limits(data: Data) -> list[Block]:
    smallest = min(
        len(data.sample(place, name, "crashes"))
        for environment in data.environments
        for place in data.places(environment, "naive")
        for name in data.methods(environment)
    )
    p10, p30 = (stats.detectable_probability(n, n) for n in (10, 30))
    r10, r30 = (stats.detectable_spread(n, n) for n in (10, 30))
    return [Heading("Limits"), Bullets([
        "The unit is one trained policy. Its worlds and episodes are no replicates.",
        f"The smallest population here has {smallest} policies; nothing is tested below {LEAST}. With a power of "
        f"80 %, a rank-sum test finds P(x > y) = {p10:.2f} with 10 a side and {p30:.2f} with 30; a ratio of standard "
        f"deviations must be {r10:.1f} and {r30:.1f}.",
        f"Declared beforehand: of interest are P = {PROBABILITY} and ratios of spread of {SPREAD:g}; equivalent are "
        f"crashes within a factor of {FACTOR:g} and rewards within {100 * REWARD_SHARE:.0f} % of Uniform's median. "
        "`Undecided` is a test that would probably have found such an effect and did not; `underpowered` one that "
        "would not have.",
        "A claim that needs all its tests is supported only if each of them rejects the opposite at 5 % by itself (an "
        "intersection-union test, of level 5 % as it is); one of them is enough to contradict it, so there the "
        "p-values are corrected by Holm's rule over the claim's tests. For a claim that needs only one of its tests "
        "it is the other way round. The p that is printed is the smaller one. Nothing is corrected over all claims "
        "together. A minimum detectable effect of `none` is that of a test that cannot reject with so few policies "
        "at the level that contradicts.",
        "The best p is chosen on one half of the seeds and tested on the other, from 20 seeds on.",
        COVERAGE,
        "CVaR over seeds is too low in small populations.",
        "The mean reward per transition pays for crashing where a crash puts the robot back to safety; the score does "
        "not.",
        "Frames per second were measured while the study's workers shared the machine.",
    ])]  # fmt: skip
