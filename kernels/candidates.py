"""Scores of many candidate goals per decision, by networks of one hidden layer of ReLU.

Matrix products would write the hidden layer of every candidate to memory and read it back; here it lives in registers
(2000 candidates by 64 units, one core of Zen 5: 16 us; a product, ReLU and a product take 37 us over and over, and
110 us once in a while, as decisions come).
"""

from typing import Any

import warp as wp

from .check import require, require_axes
from .lanes import FLOATS, OPTIONS, lanes, threads

wp.set_module_options(OPTIONS)

MOST_COMPONENTS = 6
"""Components that a candidate of ``score_candidates`` may have."""
MOST_COMPONENTS_SQUARED = 3
"""Components that a candidate of ``mean_square_of_candidates`` may have."""
OUTPUTS_AT_ONCE = 4
"""The outputs of a network under a mean of squares are a multiple of these."""


@wp.func
def _component(candidate: wp.array3d[float], i: int, first: int, d: int, lanes: Any):
    """Component ``d`` of the candidates from ``first`` on, one per lane; 0 where there is none."""
    x = type(lanes)()
    if d < candidate.shape[2]:
        for lane in range(len(lanes)):
            x[lane] = candidate[i, wp.min(first + lane, candidate.shape[1] - 1), d]
    return x


@wp.func
def _whitened(
    candidate: wp.array3d[float],
    i: int,
    first: int,
    d: int,
    mean: wp.array[float],
    factor: wp.array[float],
    bound: float,
    lanes: Any,
):
    """What ``_component`` gives, less its mean, scaled and clipped; 0 where there is no such component."""
    x = _component(candidate, i, first, d, lanes)
    if d < candidate.shape[2]:
        for lane in range(len(lanes)):
            white = (x[lane] - mean[d]) * factor[d]
            x[lane] = wp.clamp(white, -bound, bound) + (white - white)  # clamp takes NaN for a bound
    return x


@wp.func
def _by_three(
    of_context: wp.array2d[float], weight: wp.array2d[float], i: int, j: int, last: int, c0: Any, c1: Any, c2: Any
):
    """Hidden unit ``j`` before ReLU, by the first three components of the candidates; those beyond ``last`` are 0."""
    h = type(c0)(of_context[i, j])
    h += weight[j, 0] * c0
    h += weight[j, wp.min(1, last)] * c1
    h += weight[j, wp.min(2, last)] * c2
    return h


@wp.func
def _relu(h: Any):
    """max(h, 0), and NaN where h is NaN or -inf: Warp's ``max`` would take it for 0, a broken state for a safe one."""
    return h - wp.min(h, type(h)())


@wp.kernel
def _score(
    # In
    lanes: Any,
    of_context: wp.array2d[float],
    candidate: wp.array3d[float],
    weight: wp.array2d[float],
    out_weight: wp.array[float],
    out_bias: wp.array[float],
    # Out
    score: wp.array2d[float],
):
    i, part = wp.tid()
    first = part * len(lanes)
    last = candidate.shape[2] - 1
    c0 = _component(candidate, i, first, 0, lanes)
    c1 = _component(candidate, i, first, 1, lanes)
    c2 = _component(candidate, i, first, 2, lanes)
    c3 = _component(candidate, i, first, 3, lanes)
    c4 = _component(candidate, i, first, 4, lanes)
    c5 = _component(candidate, i, first, 5, lanes)
    total = type(lanes)(out_bias[0])
    for j in range(weight.shape[0]):
        h = _by_three(of_context, weight, i, j, last, c0, c1, c2)
        if last > 2:
            h += weight[j, 3] * c3
            h += weight[j, wp.min(4, last)] * c4
            h += weight[j, wp.min(5, last)] * c5
        total += out_weight[j] * _relu(h)
    for lane in range(len(lanes)):
        if first + lane < score.shape[1]:
            score[i, first + lane] = total[lane]


@wp.kernel
def _mean_square(
    # In
    lanes: Any,
    of_context: wp.array2d[float],
    candidate: wp.array3d[float],
    weight: wp.array2d[float],
    out_weight: wp.array2d[float],
    out_bias: wp.array[float],
    mean: wp.array[float],
    factor: wp.array[float],
    bound: float,
    # Out
    score: wp.array2d[float],
):
    i, part = wp.tid()
    first = part * len(lanes)
    last = candidate.shape[2] - 1
    c0 = _whitened(candidate, i, first, 0, mean, factor, bound, lanes)
    c1 = _whitened(candidate, i, first, 1, mean, factor, bound, lanes)
    c2 = _whitened(candidate, i, first, 2, mean, factor, bound, lanes)
    squares = type(lanes)()
    for block in range(out_weight.shape[0] // wp.static(OUTPUTS_AT_ONCE)):
        k = wp.static(OUTPUTS_AT_ONCE) * block
        # More outputs at a time would not fit the registers; for each of these blocks the hidden layer is made anew.
        y0 = type(lanes)(out_bias[k])
        y1 = type(lanes)(out_bias[k + 1])
        y2 = type(lanes)(out_bias[k + 2])
        y3 = type(lanes)(out_bias[k + 3])
        for j in range(weight.shape[0]):
            h = _relu(_by_three(of_context, weight, i, j, last, c0, c1, c2))
            y0 += out_weight[k, j] * h
            y1 += out_weight[k + 1, j] * h
            y2 += out_weight[k + 2, j] * h
            y3 += out_weight[k + 3, j] * h
        squares += wp.cw_mul(y0, y0) + wp.cw_mul(y1, y1) + wp.cw_mul(y2, y2) + wp.cw_mul(y3, y3)
    for lane in range(len(lanes)):
        if first + lane < score.shape[1]:
            score[i, first + lane] = squares[lane] / float(out_weight.shape[0])


for _floats in FLOATS.values():
    wp.overload(_score, {"lanes": _floats})
    wp.overload(_mean_square, {"lanes": _floats})


def score_candidates(
    of_context: wp.array,
    candidate: wp.array,
    weight: wp.array,
    out_weight: wp.array,
    out_bias: wp.array,
    score: wp.array,
    *,
    record: bool = False,
) -> wp.Launch | None:
    """The one output of a network for every candidate: ``v . relu(h_i + W g_ik) + b``.

    A recorded launch keeps the addresses of its arguments, whose contents may change. For other contexts, change the
    first axis of its threads alone: on a CPU one of the second scores many candidates.

    Args:
        of_context: The hidden layer h before ReLU, without the candidate's share, float32, shape (n, hidden).
        candidate: Candidates g, float32, shape (n, count, goal_dim); goal_dim is at most ``MOST_COMPONENTS``.
        weight: W, of the hidden layer by the candidate, float32, shape (hidden, goal_dim).
        out_weight: v, of the output, float32, shape (hidden,).
        out_bias: b, of the output, float32, shape (1,).
        score: Outputs, float32, shape (n, count). Written.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device, or candidates have too many components.
    """
    _require_network(of_context, candidate, weight, score, most=MOST_COMPONENTS)
    require("out_weight", out_weight, dtype=wp.float32, shape=weight.shape[:1], like=of_context)
    require("out_bias", out_bias, dtype=wp.float32, shape=(1,), like=of_context)
    return _launch(_score, [of_context, candidate, weight, out_weight, out_bias], score, record)


def mean_square_of_candidates(
    of_context: wp.array,
    candidate: wp.array,
    weight: wp.array,
    out_weight: wp.array,
    out_bias: wp.array,
    mean: wp.array,
    factor: wp.array,
    score: wp.array,
    *,
    bound: float,
    record: bool = False,
) -> wp.Launch | None:
    """The mean of the squared outputs of a network for every candidate: ``mean((V relu(h_i + W x_ik) + b)^2)``.

    The network sees whitened candidates, ``x_ik = clip((g_ik - mean) * factor, -bound, bound)``.

    Args:
        of_context: The hidden layer h before ReLU, without the candidate's share, float32, shape (n, hidden).
        candidate: Candidates g, float32, shape (n, count, goal_dim); goal_dim is at most ``MOST_COMPONENTS_SQUARED``.
        weight: W, of the hidden layer by the candidate, float32, shape (hidden, goal_dim).
        out_weight: V, of the outputs, float32, shape (outputs, hidden), a multiple of ``OUTPUTS_AT_ONCE`` outputs.
        out_bias: b, of the outputs, float32, shape (outputs,).
        mean: What every component is less, float32, shape (goal_dim,).
        factor: What it is times, float32, shape (goal_dim,).
        bound: What it is clipped to, above 0.
        score: Mean squares, float32, shape (n, count). Written.
        record: See ``score_candidates``.

    Raises:
        ValueError: If an array has another shape, dtype or device, or candidates have too many components.
    """
    _require_network(of_context, candidate, weight, score, most=MOST_COMPONENTS_SQUARED)
    require_axes("out_weight", out_weight, 2)
    outputs = out_weight.shape[0]
    if outputs < 1 or outputs % OUTPUTS_AT_ONCE:
        raise ValueError(f"out_weight must have a multiple of {OUTPUTS_AT_ONCE} rows, got {outputs}.")
    require("out_weight", out_weight, dtype=wp.float32, shape=(outputs, weight.shape[0]), like=of_context)
    require("out_bias", out_bias, dtype=wp.float32, shape=(outputs,), like=of_context)
    for name, array in (("mean", mean), ("factor", factor)):
        require(name, array, dtype=wp.float32, shape=candidate.shape[2:], like=of_context)
    if not bound > 0:
        raise ValueError(f"bound must be above 0, got {bound}.")
    inputs = [of_context, candidate, weight, out_weight, out_bias, mean, factor, float(bound)]
    return _launch(_mean_square, inputs, score, record)


def _launch(kernel: wp.Kernel, inputs: list, score: wp.array, record: bool) -> wp.Launch | None:
    return wp.launch(
        kernel,
        dim=threads(*score.shape, score.device),
        inputs=[FLOATS[lanes(score.shape[1], score.device)](), *inputs],
        outputs=[score],
        device=score.device,
        record_cmd=record,
    )


def _require_network(
    of_context: wp.array, candidate: wp.array, weight: wp.array, score: wp.array, *, most: int
) -> None:
    """Check what both launchers take."""
    require("of_context", of_context, dtype=wp.float32)
    for name, array, axes in (("of_context", of_context, 2), ("candidate", candidate, 3), ("weight", weight, 2)):
        require_axes(name, array, axes)
    rows, hidden = of_context.shape
    count, goal_dim = candidate.shape[1:]
    if not 1 <= goal_dim <= most:
        raise ValueError(f"candidate must have 1 to {most} components, got {goal_dim}.")
    require("candidate", candidate, dtype=wp.float32, shape=(rows, count, goal_dim), like=of_context)
    require("weight", weight, dtype=wp.float32, shape=(hidden, goal_dim), like=of_context)
    require("score", score, dtype=wp.float32, shape=(rows, count), like=of_context)
