"""Scores of many candidates by networks of one hidden layer."""

import functools

import numpy as np
import pytest
import torch
import warp as wp
from deimos.kernels.candidates import (
    MOST_COMPONENTS,
    MOST_COMPONENTS_SQUARED,
    OUTPUTS_AT_ONCE,
    mean_square_of_candidates,
    score_candidates,
)
from deimos.kernels.lanes import WIDE, lanes, threads

BOUND = 0.5  # so low that many components are clipped
squares_of_candidates = functools.partial(mean_square_of_candidates, bound=BOUND)


def network(rows, count, goal_dim, hidden, outputs, seed=0):
    """Arguments of both launchers by name, float32; ``out_weight`` of one output is a vector."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.standard_normal(shape).astype(np.float32)  # noqa: E731
    return {
        "of_context": normal(rows, hidden),
        "candidate": normal(rows, count, goal_dim),
        "weight": normal(hidden, goal_dim),
        "out_weight": normal(outputs, hidden) if outputs > 1 else normal(hidden),
        "out_bias": normal(outputs),
        "score": np.full((rows, count), np.nan, np.float32),
    } | ({"mean": normal(goal_dim), "factor": normal(goal_dim)} if outputs > 1 else {})


def on(device, arguments):
    return {name: wp.array(value, dtype=wp.float32, device=device) for name, value in arguments.items()}


def reference(a):
    """Outputs of the network in float64, shape (rows, count, outputs)."""
    a = {name: value.astype(np.float64) for name, value in a.items()}
    if "mean" in a:
        a["candidate"] = np.clip((a["candidate"] - a["mean"]) * a["factor"], -BOUND, BOUND)
    hidden = np.maximum(a["of_context"][:, None] + a["candidate"] @ a["weight"].T, 0.0)
    return hidden @ np.atleast_2d(a["out_weight"]).T + a["out_bias"]


# One candidate per thread below a quarter of the lanes; then whole threads, and threads that are partly idle.
@pytest.mark.parametrize("count", [1, WIDE // 4 - 1, WIDE // 4, WIDE, WIDE + 1, 100, 2 * WIDE])
@pytest.mark.parametrize("goal_dim", range(1, MOST_COMPONENTS + 1))
def test_score_matches_reference(device, count, goal_dim):
    """The output is that of the network; sums of 50 products of numbers of order 1 round in the sixth digit."""
    a = network(5, count, goal_dim, 50, 1, seed=goal_dim)
    arrays = on(device, a)
    score_candidates(**arrays)
    np.testing.assert_allclose(arrays["score"].numpy(), reference(a)[..., 0], rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("outputs", [OUTPUTS_AT_ONCE, 4 * OUTPUTS_AT_ONCE])
@pytest.mark.parametrize("count", [1, WIDE // 4, 100])
@pytest.mark.parametrize("goal_dim", range(1, MOST_COMPONENTS_SQUARED + 1))
def test_mean_square_matches_reference(device, outputs, count, goal_dim):
    """The score is the mean of the squared outputs."""
    a = network(5, count, goal_dim, 30, outputs, seed=goal_dim)
    arrays = on(device, a)
    squares_of_candidates(**arrays)
    np.testing.assert_allclose(arrays["score"].numpy(), np.square(reference(a)).mean(2), rtol=1e-4)


def test_relu_cuts_what_is_negative(device):
    """Hidden units below 0 are silent: with only such units the output is its bias, whatever the weights."""
    a = network(3, 100, 3, 16, 1)
    a["of_context"][:] = -1000.0
    arrays = on(device, a)
    score_candidates(**arrays)
    np.testing.assert_array_equal(arrays["score"].numpy(), np.broadcast_to(a["out_bias"], (3, 100)))


@pytest.mark.parametrize("launcher", [score_candidates, squares_of_candidates])
@pytest.mark.parametrize(("name", "place"), [("of_context", (2, 5)), ("candidate", (2, 7, 1)), ("weight", (5, 1))])
def test_nan_is_not_hidden(device, launcher, name, place):
    """NaN in a context, a candidate or a weight is NaN in every score that it belongs to, and in no other."""
    a = network(4, 100, 3, 32, 1 if launcher is score_candidates else 8)
    a[name][place] = np.nan
    arrays = on(device, a)
    launcher(**arrays)
    expected = np.zeros((4, 100), bool)
    expected[{"of_context": (2,), "candidate": (2, 7), "weight": (...,)}[name]] = True
    np.testing.assert_array_equal(np.isnan(arrays["score"].numpy()), expected)


@pytest.mark.parametrize("launcher", [score_candidates, squares_of_candidates])
def test_contexts_and_candidates_do_not_mix(device, launcher):
    """A candidate's score is bit for bit the same beside other contexts and, in as many lanes, other candidates."""
    outputs = 1 if launcher is score_candidates else 8
    a = network(4, 100, 3, 32, outputs)
    arrays = on(device, a)
    launcher(**arrays)
    before = arrays["score"].numpy()
    a["of_context"][2], a["candidate"][2], a["candidate"][1, 7] = 3.0, -2.0, 5.0
    arrays = on(device, a)
    launcher(**arrays)
    changed = arrays["score"].numpy() != before
    expected = np.zeros((4, 100), bool)
    expected[2], expected[1, 7] = True, True
    np.testing.assert_array_equal(changed, expected)


def test_recorded_launch_reads_torchs_memory_anew(torch_device):
    """Views of a layer's weights, strided as they lie there, are read at every launch, also for fewer contexts."""
    layer, last = torch.nn.Linear(9, 20, device=torch_device), torch.nn.Linear(20, 1, device=torch_device)
    context, candidates = torch.randn(6, 6, device=torch_device), torch.randn(6, 100, 3, device=torch_device)
    hidden, score = torch.empty(6, 20, device=torch_device), torch.empty(6, 100, device=torch_device)
    weight = layer.weight.data[:, 6:]
    view = wp.from_torch(weight)
    assert view.ptr == weight.data_ptr()
    launch = score_candidates(
        wp.from_torch(hidden), wp.from_torch(candidates), view, wp.from_torch(last.weight.data[0]),
        wp.from_torch(last.bias.data), wp.from_torch(score), record=True,
    )  # fmt: skip
    for rows in (6, 2):
        with torch.no_grad():
            layer.weight += 0.1
            last.bias += 1.0
            hidden[:] = layer.bias + context @ layer.weight[:, :6].t()
            inputs = torch.cat([context.unsqueeze(1).expand(-1, 100, -1), candidates], dim=2)
            expected = last(layer(inputs).relu()).squeeze(2)
        score.fill_(torch.nan)
        launch.set_dim((rows, launch.bounds.shape[1]))
        launch.launch()
        torch.testing.assert_close(score[:rows], expected[:rows], rtol=1e-4, atol=1e-5)
        assert score[rows:].isnan().all()


def test_threads_cover_every_number(device):
    """A thread takes one number on a GPU and where there are few, else as many as its lanes."""
    cpu = wp.get_device(device).is_cpu
    assert lanes(WIDE // 4 - 1, wp.get_device(device)) == 1
    assert lanes(100, wp.get_device(device)) == (WIDE if cpu else 1)
    assert threads(7, 100, wp.get_device(device)) == (7, -(-100 // WIDE) if cpu else 100)
    assert threads(7, 3, wp.get_device(device)) == (7, 3)


@pytest.mark.parametrize(
    ("launcher", "wrong", "message"),
    [
        (score_candidates, {"candidate": (5, 8, MOST_COMPONENTS + 1)}, "candidate must have 1 to 6 components, got 7"),
        (squares_of_candidates, {"candidate": (5, 8, 4)}, "candidate must have 1 to 3 components, got 4"),
        (score_candidates, {"candidate": (4, 8, 3)}, r"candidate must be float32\(5, 8, 3\)"),
        (score_candidates, {"of_context": (5,)}, "of_context must have 2 axes"),
        (score_candidates, {"weight": (12, 2)}, r"weight must be float32\(12, 3\)"),
        (score_candidates, {"out_weight": (11,)}, r"out_weight must be float32\(12,\)"),
        (score_candidates, {"out_bias": (2,)}, r"out_bias must be float32\(1,\)"),
        (score_candidates, {"score": (5, 9)}, r"score must be float32\(5, 8\)"),
        (squares_of_candidates, {"out_weight": (6, 12), "out_bias": (6,)}, "multiple of 4 rows, got 6"),
        (squares_of_candidates, {"out_weight": (12,)}, "out_weight must have 2 axes"),
        (squares_of_candidates, {"out_bias": (4,)}, r"out_bias must be float32\(8,\)"),
        (squares_of_candidates, {"mean": (2,)}, r"mean must be float32\(3,\)"),
        (squares_of_candidates, {"factor": (1,)}, r"factor must be float32\(3,\)"),
    ],
)
def test_rejects(device, launcher, wrong, message):
    """Arrays of another shape raise ``ValueError`` with the argument's name, and nothing is launched."""
    arrays = on(device, network(5, 8, 3, 12, 1 if launcher is score_candidates else 8))
    arrays |= {name: wp.zeros(shape, dtype=wp.float32, device=device) for name, shape in wrong.items()}
    with pytest.raises(ValueError, match=message):
        launcher(**arrays)


@pytest.mark.parametrize("bound", [0.0, -1.0, float("nan")])
def test_rejects_a_bound_that_is_none(device, bound):
    """Nothing can be clipped to an empty range."""
    with pytest.raises(ValueError, match="bound must be above 0"):
        mean_square_of_candidates(**on(device, network(5, 8, 3, 12, 8)), bound=bound)


def test_rejects_another_dtype(device):
    """Hidden layers of float64 raise ``ValueError``."""
    arrays = on(device, network(5, 8, 3, 12, 1))
    arrays["of_context"] = wp.zeros((5, 12), dtype=wp.float64, device=device)
    with pytest.raises(ValueError, match="of_context must be float32"):
        score_candidates(**arrays)
