"""Values and gradients of several critics in one kernel."""

import itertools

import numpy as np
import pytest
import warp as wp
from deimos.kernels.critics import CriticTables, Layout, gradients, values
from deimos.kernels.lanes import WIDE

COUNT = 3


def network(units, seed=0):
    """Weights and biases of every layer, (inputs, outputs) and (outputs,), for each critic; the last has one output."""
    rng = np.random.default_rng(seed)
    shapes = [*itertools.pairwise(units), (units[-1], 1)]
    return [
        [(rng.standard_normal(shape) / shape[0] ** 0.5, rng.standard_normal(shape[1])) for shape in shapes]
        for _ in range(COUNT)
    ]


def tables(layout, nets):
    """The tables of the critics, as the module's docstring describes them."""
    table = np.zeros((len(nets), layout.rows, layout.width), np.float32)
    for own, net in zip(table, nets, strict=True):
        row = 0
        for weight, bias in net[:-1]:
            own[row : row + len(weight), : weight.shape[1]] = weight
            own[row + len(weight), : weight.shape[1]] = bias
            row += len(weight) + 1
        own[row, : layout.units[-1]] = net[-1][0][:, 0]
        own[row + 1, 0] = net[-1][1][0]
        row += 2
        for weight, _ in net[1:-1]:
            own[row : row + weight.shape[1], : weight.shape[0]] = weight.T
            row += weight.shape[1]
        assert row == layout.rows
    return table


def forward(net, x):
    """Inputs of every layer, and the values."""
    layers = [x.astype(np.float64)]
    for weight, bias in net[:-1]:
        layers.append(np.maximum(layers[-1] @ weight + bias, 0.0))
    return layers, (layers[-1] @ net[-1][0] + net[-1][1])[:, 0]


def backward(net, layers, delta):
    """Gradients like ``net``, from those of the values."""
    result, delta = [], delta[:, None]
    for (weight, _), x in zip(net[::-1], layers[::-1], strict=True):
        result.insert(0, (x.T @ delta, delta.sum(0)))
        delta = (delta @ weight.T) * (x > 0.0)
    return result


def critics(units, nets):
    layout = Layout(units)
    table = wp.array(tables(layout, nets), dtype=float, device="cpu")
    gradient = wp.full(table.shape, np.nan, dtype=float, device="cpu")
    return CriticTables(layout, table, gradient), table, gradient


def arrays(rows, inputs, seed=1):
    """Arguments of ``gradients`` by name, as NumPy has them."""
    rng = np.random.default_rng(seed)
    numbers = {name: rng.standard_normal((COUNT, rows)) for name in ("before", "target")}
    share = (rng.random((COUNT, rows)) < 0.9).astype(float)
    return {"x": rng.standard_normal((COUNT, rows, inputs)), **numbers, "weight": share}


def on_cpu(numbers):
    return {name: wp.array(value, dtype=float, device="cpu") for name, value in numbers.items()}


@pytest.mark.parametrize("units", [(1, 1), (4, 9), (11, WIDE, WIDE), (WIDE + 3, 2 * WIDE + 2, 20, 9)])
@pytest.mark.parametrize("rows", [1, WIDE, WIDE + 1, 150])
def test_values_match_reference(units, rows):
    """Every member's values are those of its network; members that were not asked for are left alone."""
    nets = network(units)
    memory, _, _ = critics(units, nets)
    x = arrays(rows, units[0])["x"]
    value = wp.full((COUNT, rows), np.nan, dtype=float, device="cpu")
    values(memory, wp.array(x, dtype=float, device="cpu"), value, members=range(1, COUNT))
    expected = np.stack([forward(net, own)[1] for net, own in zip(nets, x, strict=True)])
    np.testing.assert_allclose(value.numpy()[1:], expected[1:], rtol=1e-4, atol=1e-5)
    assert np.isnan(value.numpy()[0]).all()


@pytest.mark.parametrize("units", [(1, 1), (4, 9), (11, WIDE, WIDE), (WIDE + 3, 2 * WIDE + 2, 20, 9)])
@pytest.mark.parametrize("clip", [0.3, np.inf])
def test_gradients_match_reference(units, clip):
    """Losses and gradients are those of the clipped value loss on the rows asked for, over what their shares sum to."""
    nets = network(units)
    memory, _, gradient = critics(units, nets)
    numbers, rows = arrays(150, units[0]), range(20, 140)
    loss = wp.zeros(COUNT, dtype=float, device="cpu")
    gradients(memory, **on_cpu(numbers), loss=loss, clip=clip, members=range(COUNT), rows=rows)
    expected, losses = [], []
    for k, net in enumerate(nets):
        x, before, target, share = (numbers[name][k, rows.start : rows.stop] for name in numbers)
        layers, value = forward(net, x)
        plain = (value - target) ** 2
        bound = (before + np.clip(value - before, -clip, clip) - target) ** 2
        flat = (np.abs(value - before) > clip) & (bound > plain)
        share = share / share.sum()
        losses.append((np.where(flat, bound, plain) * share).sum())
        expected.append(backward(net, layers, np.where(flat, 0.0, 2.0 * (value - target)) * share))
    wanted = tables(memory.layout, expected)
    wanted[:, memory.layout.start[-1] + 2 :] = 0.0  # there are no gradients of what lies there once more
    np.testing.assert_allclose(loss.numpy(), losses, rtol=1e-4)
    np.testing.assert_allclose(gradient.numpy(), wanted, rtol=1e-3, atol=1e-6)


def test_rows_of_no_share_teach_nothing():
    """Where all shares are 0 so are the loss and every gradient, and sums of shares below 1 are not blown up."""
    units = (4, 9)
    memory, _, gradient = critics(units, network(units))
    numbers, loss = arrays(10, 4), wp.full(COUNT, np.nan, dtype=float, device="cpu")
    halves = []
    for share in (0.0, 0.01, 0.02):
        numbers["weight"][:] = share
        gradients(memory, **on_cpu(numbers), loss=loss, clip=0.2, members=range(COUNT), rows=range(10))
        halves.append(gradient.numpy().copy())
    assert not halves[0].any()
    assert halves[1].any()
    np.testing.assert_allclose(2.0 * halves[1], halves[2], rtol=1e-5)


def test_a_unit_that_is_infinitely_silent_is_silent():
    """ReLU makes 0 of minus infinity, as torch's does."""
    units = (4, 9)
    nets = network(units)
    for net in nets:
        net[0][1][2] = -np.inf
    memory, _, _ = critics(units, nets)
    x, value = arrays(5, 4)["x"], wp.zeros((COUNT, 5), dtype=float, device="cpu")
    values(memory, wp.array(x, dtype=float, device="cpu"), value, members=range(COUNT))
    expected = np.stack([forward(net, own)[1] for net, own in zip(nets, x, strict=True)])
    np.testing.assert_allclose(value.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_an_old_value_that_is_not_a_number_breaks_the_loss():
    """It shows in the loss, as it does in ``returns.value_gradient``, though no gradient comes of it."""
    units = (4, 9)
    memory, _, gradient = critics(units, network(units))
    numbers, loss = arrays(5, 4), wp.zeros(COUNT, dtype=float, device="cpu")
    numbers["weight"][:] = 1.0
    numbers["before"][1, 2] = np.nan
    gradients(memory, **on_cpu(numbers), loss=loss, clip=0.2, members=range(COUNT), rows=range(5))
    np.testing.assert_array_equal(np.isnan(loss.numpy()), [False, True, False])
    assert np.isfinite(gradient.numpy()).all()


@pytest.mark.parametrize("place", ["x", "table"])
def test_what_is_not_a_number_stays_so(place):
    """A broken input or weight breaks the value and the gradient; ReLU does not take it for 0."""
    units = (4, 9, 9)
    memory, table, gradient = critics(units, network(units))
    numbers = arrays(5, 4)
    if place == "x":
        numbers["x"][1, 2, 3] = np.nan
    else:
        broken = table.numpy()
        broken[1, 0, 0] = np.nan
        table.assign(broken)
    value, loss = wp.zeros((COUNT, 5), dtype=float, device="cpu"), wp.zeros(COUNT, dtype=float, device="cpu")
    values(memory, on_cpu(numbers)["x"], value, members=range(COUNT))
    numbers["weight"][:] = 1.0
    gradients(memory, **on_cpu(numbers), loss=loss, clip=0.2, members=range(COUNT), rows=range(5))
    assert np.isnan(value.numpy()[1, 2])
    assert np.isnan(loss.numpy()[1])
    assert np.isnan(gradient.numpy()[1]).any()
    assert np.isfinite(gradient.numpy()[[0, 2]]).all()


def test_replays_and_shared_inputs():
    """A recorded launch sees what changed since; inputs that all critics share need no copies."""
    units = (4, 9)
    nets = network(units)
    memory, table, _ = critics(units, nets)
    x = wp.array(np.ones((1, 6, 4)), dtype=float, device="cpu")
    shared = wp.array(ptr=x.ptr, dtype=float, shape=(COUNT, 6, 4), strides=(0, *x.strides[1:]), device="cpu")
    value = wp.zeros((COUNT, 6), dtype=float, device="cpu")
    launch = values(memory, shared, value, members=range(COUNT), record=True)
    assert not value.numpy().any()
    launch.launch()
    expected = np.stack([forward(net, np.ones((6, 4)))[1] for net in nets])
    np.testing.assert_allclose(value.numpy(), expected, rtol=1e-5)
    table.zero_()
    launch.launch()
    assert not value.numpy().any()


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("x", wp.zeros((COUNT, 10, 5), dtype=float, device="cpu"), "x must be float32"),
        ("before", wp.zeros(10, dtype=float, device="cpu"), "before must have 2 axes"),
        ("target", wp.zeros((COUNT, 10), dtype=int, device="cpu"), "target must be float32"),
        ("weight", wp.zeros((COUNT, 9), dtype=float, device="cpu"), "weight must be float32"),
        ("loss", wp.zeros(1, dtype=float, device="cpu"), "loss must be float32"),
        ("rows", range(4, 11), "rows must be one or more of 10"),
        ("rows", range(4, 4), "rows must be one or more of 10"),
        ("members", range(2, 4), "members must be one or more of 3"),
        ("clip", 0.0, "clip must be positive"),
    ],
)
def test_bad_arguments(name, array, message):
    """Arguments of another shape, dtype or range are refused by name."""
    units = (4, 9)
    memory, _, _ = critics(units, network(units))
    arguments = on_cpu(arrays(10, 4)) | {"loss": wp.zeros(COUNT, dtype=float, device="cpu"), "clip": 0.2}
    arguments |= {"members": range(COUNT), "rows": range(10)}
    with pytest.raises(ValueError, match=message):
        gradients(memory, **(arguments | {name: array}))


def test_bad_tables():
    """Tables of another layout and tables that are no memory of their own are refused."""
    layout = Layout((4, 9))
    table = wp.zeros((COUNT, layout.rows, layout.width), dtype=float, device="cpu")
    with pytest.raises(ValueError, match="table must be float32"):
        CriticTables(Layout((5, 9)), table, table)
    with pytest.raises(ValueError, match="gradient must be float32"):
        CriticTables(layout, table, table[:2])
    every_second = wp.zeros((2 * COUNT, layout.rows, layout.width), dtype=float, device="cpu")[::2]
    with pytest.raises(ValueError, match="contiguous"):
        CriticTables(layout, every_second, table)
