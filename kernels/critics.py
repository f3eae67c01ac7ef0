"""Values of several critics and the gradient of their loss, in the vector registers of a CPU.

A critic is a multilayer perceptron of ReLU with one output. Products of a library write every layer of every critic to
memory and read it back for ReLU, its derivative and the next product; here blocks of rows pass forwards and backwards
through all layers within a core's caches (10 critics of 11, 64, 64 and 1 units, one core of Zen 5: 195 GFLOP/s in
all; batched products by oneDNN 93). A GPU's libraries want large products: there ``nn.ensemble`` leaves it to them.

Weights lie in a table of rows of ``WIDE`` or more lanes, one table per critic; units beyond a layer's lie idle, as 0.
For each hidden layer: a row for every input, with its weights to all units, and a row of biases. For the output: a row
of weights, and a row whose first number is the bias. Then the weights of the second and later hidden layers once
more, transposed: a row for every unit, with its weights from all inputs. Gradients have a table like it.
"""

from dataclasses import dataclass

import warp as wp

from .check import require, require_axes
from .lanes import FLOATS, OPTIONS, WIDE

wp.set_module_options(OPTIONS)

_Floats = FLOATS[WIDE]
_Eight = wp.types.vector(length=8, dtype=float)
_Sixteen = wp.types.vector(length=16, dtype=float)
_ROWS = WIDE  # a block: as many rows as lanes, so that what a row has once also fits a vector


@dataclass(frozen=True)
class Layout:
    """Where the weights of a critic lie in its table."""

    units: tuple[int, ...]
    """Of the inputs and every hidden layer."""

    @property
    def start(self) -> tuple[int, ...]:
        """First row of every hidden layer and of the output."""
        return tuple(sum(self.units[:i]) + i for i in range(len(self.units)))

    @property
    def transposed(self) -> tuple[int, ...]:
        """First row of every hidden layer's transposed weights; those of the first are not kept."""
        rows = [self.start[-1] + 2]
        for units in self.units[2:]:
            rows.append(rows[-1] + units)
        return (0, *rows[:-1])

    @property
    def rows(self) -> int:
        """Rows of the table."""
        return self.start[-1] + 2 + sum(self.units[2:])

    @property
    def width(self) -> int:
        """Numbers in a row, a multiple of ``WIDE``."""
        return -(-max(self.units) // WIDE) * WIDE

    @property
    def scratch_rows(self) -> int:
        """Rows of the memory that a critic works in: a block of every hidden layer, and two of gradients."""
        return (len(self.units) + 1) * _ROWS


@wp.struct
class _Critics:
    """Memory of all critics, by vectors and by numbers."""

    units: wp.array[int]
    start: wp.array[int]
    transposed: wp.array[int]
    table: wp.array3d[_Floats]
    table_number: wp.array3d[float]
    scratch: wp.array3d[_Floats]
    scratch_number: wp.array3d[float]
    eights: wp.array3d[_Eight]
    sixteens: wp.array3d[_Sixteen]
    gradient: wp.array3d[_Floats]
    gradient_number: wp.array3d[float]


@wp.func
def _relu(h: _Floats):
    """max(h, 0), and NaN where h is: Warp's ``max`` would take NaN for 0."""
    for lane in range(WIDE):
        h[lane] = wp.where(h[lane] <= 0.0, 0.0, h[lane])
    return h


@wp.func
def _where_active(h: _Floats, delta: _Floats):
    """``delta`` times the derivative of ReLU, which its output determines."""
    for lane in range(WIDE):
        delta[lane] = wp.where(h[lane] > 0.0, delta[lane], 0.0)
    return delta


@wp.func
def _groups(units: int):
    """Vectors that hold the units of a layer."""
    return (units + WIDE - 1) // WIDE


@wp.func
def _products(
    x: wp.array3d[float],
    k: int,
    row: int,
    last: int,
    n: int,
    table: wp.array3d[_Floats],
    at: int,
    g: int,
    bias: _Floats,
):
    """``bias`` and the products of four rows of ``x`` with rows of the table; rows beyond ``last`` are like it.

    Four rows by four registers: more sums at a time would not fit the registers, fewer would wait for memory.
    """
    r0 = wp.min(row, last)
    r1 = wp.min(row + 1, last)
    r2 = wp.min(row + 2, last)
    r3 = wp.min(row + 3, last)
    y0 = bias
    y1 = bias
    y2 = bias
    y3 = bias
    for j in range(n):
        w = table[k, at + j, g]
        y0 += x[k, r0, j] * w
        y1 += x[k, r1, j] * w
        y2 += x[k, r2, j] * w
        y3 += x[k, r3, j] * w
    return y0, y1, y2, y3


@wp.func
def _forward_layer(c: _Critics, k: int, layer: int, x: wp.array3d[float], first: int, last: int):
    """Write a block of a hidden layer's outputs; its inputs are the rows of ``x`` from ``first`` on."""
    n = c.units[layer]
    at = c.start[layer]
    for quad in range(_ROWS // 4):
        for g in range(_groups(c.units[layer + 1])):
            bias = c.table[k, at + n, g]
            y0, y1, y2, y3 = _products(x, k, first + 4 * quad, last, n, c.table, at, g, bias)
            row = layer * _ROWS + 4 * quad
            c.scratch[k, row, g] = _relu(y0)
            c.scratch[k, row + 1, g] = _relu(y1)
            c.scratch[k, row + 2, g] = _relu(y2)
            c.scratch[k, row + 3, g] = _relu(y3)


@wp.func
def _forward(c: _Critics, k: int, x: wp.array3d[float], first: int, last: int):
    """The values of a block of rows, one per lane; rows beyond ``last`` are like it."""
    hidden = c.units.shape[0] - 1
    _forward_layer(c, k, 0, x, first, last)
    for layer in range(1, hidden):
        _forward_layer(c, k, layer, c.scratch_number, (layer - 1) * _ROWS, layer * _ROWS - 1)
    top = (hidden - 1) * _ROWS
    free = hidden * _ROWS  # until the backward pass
    out = c.start[hidden]
    for r in range(_ROWS):
        products = _Floats()
        for g in range(_groups(c.units[hidden])):
            products += wp.cw_mul(c.scratch[k, top + r, g], c.table[k, out, g])
        c.scratch[k, free + r, 0] = products
    # Lanes are added by way of memory: of anything else LLVM makes a long sequence of shuffles.
    for r in range(_ROWS):
        halves = c.sixteens[k, free + r, 0] + c.sixteens[k, free + r, 1]
        c.sixteens[k, free + r, 0] = halves + (c.sixteens[k, free + r, 2] + c.sixteens[k, free + r, 3])
    value = _Floats()
    for r in range(_ROWS):
        s = c.eights[k, free + r, 0] + c.eights[k, free + r, 1]
        value[r] = c.table_number[k, out + 1, 0] + (((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7])))
    return value


@wp.func
def _backward_output(c: _Critics, k: int, delta: _Floats):
    """Add the output's gradient by that of the values, ``delta``, and write that of the last hidden layer."""
    hidden = c.units.shape[0] - 1
    top = (hidden - 1) * _ROWS
    below = hidden * _ROWS
    out = c.start[hidden]
    for g in range(_groups(c.units[hidden])):
        total = c.gradient[k, out, g]
        w = c.table[k, out, g]
        for r in range(_ROWS):
            h = c.scratch[k, top + r, g]
            total += delta[r] * h
            c.scratch[k, below + r, g] = _where_active(h, delta[r] * w)
        c.gradient[k, out, g] = total
    bias = c.gradient_number[k, out + 1, 0]
    for r in range(_ROWS):
        bias += delta[r]
    c.gradient_number[k, out + 1, 0] = bias


@wp.func
def _add_gradient(c: _Critics, k: int, layer: int, x: wp.array3d[float], first: int, last: int, delta: int):
    """Add a hidden layer's gradient, from its inputs and from that of its outputs, which begins at row ``delta``."""
    n = c.units[layer]
    at = c.start[layer]
    for g in range(_groups(c.units[layer + 1])):
        bias = c.gradient[k, at + n, g]
        for r in range(_ROWS):
            bias += c.scratch[k, delta + r, g]
        c.gradient[k, at + n, g] = bias
        for quad in range((n + 3) // 4):
            j0 = 4 * quad
            j1 = wp.min(j0 + 1, n - 1)
            j2 = wp.min(j0 + 2, n - 1)
            j3 = wp.min(j0 + 3, n - 1)
            y0 = _Floats()
            y1 = _Floats()
            y2 = _Floats()
            y3 = _Floats()
            for r in range(_ROWS):
                d = c.scratch[k, delta + r, g]
                row = wp.min(first + r, last)
                y0 += x[k, row, j0] * d
                y1 += x[k, row, j1] * d
                y2 += x[k, row, j2] * d
                y3 += x[k, row, j3] * d
            c.gradient[k, at + j0, g] = c.gradient[k, at + j0, g] + y0
            if j0 + 1 < n:
                c.gradient[k, at + j1, g] = c.gradient[k, at + j1, g] + y1
            if j0 + 2 < n:
                c.gradient[k, at + j2, g] = c.gradient[k, at + j2, g] + y2
            if j0 + 3 < n:
                c.gradient[k, at + j3, g] = c.gradient[k, at + j3, g] + y3


@wp.func
def _backward_layer(c: _Critics, k: int, layer: int, delta: int, to: int):
    """Write the gradient of a block of a hidden layer's inputs at row ``to``, from that of its outputs."""
    n = c.units[layer + 1]
    for quad in range(_ROWS // 4):
        row = (layer - 1) * _ROWS + 4 * quad
        for g in range(_groups(c.units[layer])):
            y0, y1, y2, y3 = _products(
                c.scratch_number, k, delta + 4 * quad, delta + _ROWS - 1, n, c.table, c.transposed[layer], g, _Floats()
            )
            c.scratch[k, to + 4 * quad, g] = _where_active(c.scratch[k, row, g], y0)
            c.scratch[k, to + 4 * quad + 1, g] = _where_active(c.scratch[k, row + 1, g], y1)
            c.scratch[k, to + 4 * quad + 2, g] = _where_active(c.scratch[k, row + 2, g], y2)
            c.scratch[k, to + 4 * quad + 3, g] = _where_active(c.scratch[k, row + 3, g], y3)


@wp.func
def _backward(c: _Critics, k: int, x: wp.array3d[float], first: int, last: int, delta: _Floats):
    """Add the gradient of all weights, by that of the values of the block that went forward last."""
    hidden = c.units.shape[0] - 1
    _backward_output(c, k, delta)
    for step in range(1, hidden):
        layer = hidden - step
        delta_at = (hidden + (step - 1) % 2) * _ROWS  # the gradients of two layers take turns
        _add_gradient(c, k, layer, c.scratch_number, (layer - 1) * _ROWS, layer * _ROWS - 1, delta_at)
        _backward_layer(c, k, layer, delta_at, (hidden + step % 2) * _ROWS)
    _add_gradient(c, k, 0, x, first, last, (hidden + (hidden - 1) % 2) * _ROWS)


@wp.func
def _clipped_loss(value: float, before: float, target: float, clip: float):
    """The clipped value loss and its derivative, as ``deimos.nn.returns.value_gradient`` has them."""
    error = value - target
    step = value - before
    clipped = before + wp.clamp(step, -clip, clip) - target
    plain = error * error
    bound = clipped * clipped
    flat = wp.abs(step) > clip and plain < bound
    # Where the value or the old one is not a number, the loss is none either.
    return wp.where(plain >= bound, plain, bound + (plain - plain)), wp.where(flat, 0.0, 2.0 * error)


@wp.kernel
def _values(
    # In
    c: _Critics,
    member: int,
    x: wp.array3d[float],
    # Out
    value: wp.array2d[float],
):
    k = member + wp.tid()
    rows = value.shape[1]
    for block in range((rows + _ROWS - 1) // _ROWS):
        first = block * _ROWS
        y = _forward(c, k, x, first, rows - 1)
        for lane in range(wp.min(_ROWS, rows - first)):
            value[k, first + lane] = y[lane]


@wp.kernel
def _gradients(
    # In
    c: _Critics,
    member: int,
    start: int,
    stop: int,
    x: wp.array3d[float],
    before: wp.array2d[float],
    target: wp.array2d[float],
    weight: wp.array2d[float],
    clip: float,
    # Out
    loss: wp.array[float],
):
    k = member + wp.tid()
    total = float(0.0)
    total_weight = float(0.0)
    for row in range(start, stop):
        total_weight += weight[k, row]
    scale = 1.0 / wp.max(total_weight, 1.0)
    for row in range(c.gradient.shape[1]):
        for g in range(c.gradient.shape[2]):
            c.gradient[k, row, g] = _Floats()
    for block in range((stop - start + _ROWS - 1) // _ROWS):
        first = start + block * _ROWS
        value = _forward(c, k, x, first, stop - 1)
        delta = _Floats()
        for lane in range(wp.min(_ROWS, stop - first)):
            row = first + lane
            row_loss, slope = _clipped_loss(value[lane], before[k, row], target[k, row], clip)
            total += row_loss * weight[k, row] * scale
            delta[lane] = slope * weight[k, row] * scale
        _backward(c, k, x, first, stop - 1, delta)
    loss[k] = total


class CriticTables:
    """The memory of K critics, for the launchers below. A critic is worked on by one launch at a time.

    Args:
        layout: Where weights lie.
        table: Weights, float32, shape (K, rows, width) of the layout; idle numbers are 0. It may change, not move.
        gradient: Gradients of the weights, of the same shape. All of it is written; idle numbers and transposed rows
            mean nothing.

    Raises:
        ValueError: If an array has another shape or dtype, is not contiguous, or does not lie on a CPU.
    """

    def __init__(self, layout: Layout, table: wp.array, gradient: wp.array) -> None:
        require_axes("table", table, 3)
        require("table", table, dtype=wp.float32, shape=(table.shape[0], layout.rows, layout.width))
        require("gradient", gradient, like=table)
        if not table.device.is_cpu:
            raise ValueError(f"table must lie on a CPU, got {table.device}; on a GPU use the products of a library.")
        self.layout, self.count = layout, table.shape[0]
        scratch = wp.zeros((self.count, layout.scratch_rows, layout.width), dtype=float, device=table.device)
        whole = [wp.array(numbers, dtype=int, device=table.device) for numbers in (layout.units, layout.start)]
        self.struct = _Critics()
        self.struct.units, self.struct.start = whole
        self.struct.transposed = wp.array(layout.transposed, dtype=int, device=table.device)
        self.struct.table, self.struct.table_number = _as_vectors(table), table
        self.struct.scratch, self.struct.scratch_number = _as_vectors(scratch), scratch
        self.struct.eights = _as_vectors(scratch, _Eight)
        self.struct.sixteens = _as_vectors(scratch, _Sixteen)
        self.struct.gradient, self.struct.gradient_number = _as_vectors(gradient), gradient


def _as_vectors(array: wp.array, dtype: type = _Floats) -> wp.array:
    """The same memory, by vectors."""
    if not array.is_contiguous:
        raise ValueError(f"table and gradient must be contiguous, got the strides {array.strides}.")
    count, rows, width = array.shape
    shape = (count, rows, width // dtype._length_)
    return wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)


def values(
    critics: CriticTables, x: wp.array, value: wp.array, *, members: range, record: bool = False
) -> wp.Launch | None:
    """The value of every row by some of the critics. Others may run at the same time, in another thread of Python.

    Args:
        critics: Their memory.
        x: Inputs, float32, shape (K, n, inputs); all may be the same memory.
        value: Values, float32, shape (K, n). Written for ``members``.
        members: Consecutive critics.
        record: Return the launch, to be replayed with ``launch()``, instead of making it.

    Raises:
        ValueError: If an array has another shape, dtype or device, or there are no such members.
    """
    require_axes("value", value, 2)
    rows = value.shape[1]
    _require_range("members", members, critics.count)
    require(
        "x", x, dtype=wp.float32, shape=(critics.count, rows, critics.layout.units[0]), like=critics.struct.table_number
    )
    require("value", value, dtype=wp.float32, shape=(critics.count, rows), like=critics.struct.table_number)
    return _launch(_values, [critics.struct, members.start, x], value, members, record)


def gradients(
    critics: CriticTables,
    x: wp.array,
    before: wp.array,
    target: wp.array,
    weight: wp.array,
    loss: wp.array,
    *,
    clip: float,
    members: range,
    rows: range,
    record: bool = False,
) -> wp.Launch | None:
    """The clipped value loss of some of the critics and the gradient of their weights, see ``returns.value_gradient``.

    Args:
        critics: Their memory, whose gradients are written.
        x: Inputs, float32, shape (K, n, inputs).
        before: Values before the update, float32, shape (K, n).
        target: What they should be, float32, shape (K, n).
        weight: Weight of every row in the average, 0 or more, float32, shape (K, n).
        loss: Averages, float32, shape (K,). Written for ``members``.
        clip: How far a value may move, positive; infinite for the plain squared error.
        members: Consecutive critics.
        rows: Consecutive rows to learn from, at least one.
        record: See ``values``.

    Raises:
        ValueError: If an array has another shape, dtype or device, there are no such members or rows, or ``clip`` is
            not positive.
    """
    require_axes("before", before, 2)
    shape = (critics.count, before.shape[1])
    require("x", x, dtype=wp.float32, shape=(*shape, critics.layout.units[0]), like=critics.struct.table_number)
    for name, array in (("before", before), ("target", target), ("weight", weight)):
        require(name, array, dtype=wp.float32, shape=shape, like=critics.struct.table_number)
    require("loss", loss, dtype=wp.float32, shape=shape[:1], like=critics.struct.table_number)
    _require_range("members", members, critics.count)
    _require_range("rows", rows, shape[1])
    if not clip > 0:
        raise ValueError(f"clip must be positive, got {clip}.")
    inputs = [critics.struct, members.start, rows.start, rows.stop, x, before, target, weight, float(clip)]
    return _launch(_gradients, inputs, loss, members, record)


def _require_range(name: str, numbers: range, count: int) -> None:
    """Refuse numbers that are none, that are not consecutive, or that there are not."""
    if not (numbers.step == 1 and 0 <= numbers.start < numbers.stop <= count):
        raise ValueError(f"{name} must be one or more of {count} in a row, got {numbers}.")


def _launch(kernel: wp.Kernel, inputs: list, output: wp.array, members: range, record: bool) -> wp.Launch | None:
    return wp.launch(kernel, dim=len(members), inputs=inputs, outputs=[output], device=output.device, record_cmd=record)
