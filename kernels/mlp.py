"""Multilayer perceptrons on the threads of a CPU: blocks of rows pass through all layers, and back, within its caches.

A block is stored unit by unit: the values of one unit are contiguous for all rows of the block. So a vector register
holds one unit of several rows, which a weight multiplies as one number: layers of any width fill the registers, and
weights and gradients have torch's memory layout. Products are made of tiles, as many sums at a time as fit the
registers.

That number depends on the processor that Clang compiles for but changes no bit of the results: an output is summed over
its inputs in order; a gradient over 16 interleaved sets of rows, then over these by halves. This module is only for
CPUs; a GPU never compiles it.
"""

from enum import IntEnum

import warp as wp

ACTIVATIONS = ("relu", "elu", "tanh")
STEP = 48
"""Rows of a block are a multiple of these: three registers of the widest kind."""

_FLAGS = "-march=native" if wp.config.cpu_compiler_flags is None else wp.config.cpu_compiler_flags
wp.set_module_options({
    "enable_backward": False,
    # A product and a sum become one instruction. By default Clang would use only half of 512-bit registers.
    "cpu_compiler_flags": f"{_FLAGS} -ffp-contract=fast -mprefer-vector-width=512",
})  # fmt: skip


class Mode(IntEnum):
    """What a job does with every block of rows."""

    FORWARD = 0  # write the outputs
    BACKWARD = 1  # add up gradients, given those with respect to the outputs
    VALUE = 2  # add up gradients of ``losses.ValueLoss``
    SURROGATE = 3  # add up gradients of ``losses.Surrogate``


@wp.struct
class Shape:
    """What the networks have in common."""

    layers: int
    activation: int  # index in ACTIVATIONS
    parameters: int  # of a network
    free: int  # where the parameters that belong to no layer start
    units: wp.array[int]  # inputs, and outputs of every layer
    weight: wp.array[int]  # where a layer's weights start among the parameters; its biases follow them
    unit: wp.array[int]  # where the inputs and a layer's outputs start among the units of a block


@wp.struct
class Job:
    """One call; memory by address, so that a recorded launch serves every call. Strides are in numbers."""

    mode: int
    count: int  # networks
    rows: int
    parts: int  # of the rows: what a thread takes at a time
    block_rows: int  # of a whole block
    stride: int  # numbers from a unit of a block to the next one
    counter: wp.uint64  # parts that have been taken, int32
    memory: wp.uint64  # of a block for every thread
    memory_size: int
    parameters: wp.uint64
    gradient: wp.uint64  # of every network and part: its parameters' and the sums of the loss
    sums: int
    x: wp.uint64
    x_net: wp.int64
    x_row: wp.int64
    x_unit: wp.int64
    inputs: int  # that ``x`` has
    y: wp.uint64  # outputs, shape (count, rows, outputs)
    data: wp.uint64  # of the loss, or gradients with respect to outputs, shape (count, columns, rows)
    data_net: wp.int64
    data_column: wp.int64
    data_row: wp.int64
    columns: int
    clip: float
    start: wp.uint64  # if not 0, what the first layer's sums start from, shape (count, rows / shared, units)
    shared: int  # consecutive rows with the same start


@wp.struct
class Block:
    """Some rows of one network."""

    parameters: wp.uint64
    gradient: wp.uint64
    memory: wp.uint64
    stride: int  # numbers from a unit to the next one
    rows: int
    inputs: int  # of the first layer, without those whose share it starts from


def _vectors(size: str) -> str:
    """Vectors of this many bytes: Clang splits those that are wider than a register."""
    return f"""
typedef float Vector __attribute__((vector_size({size})));
typedef int Whole __attribute__((vector_size({size})));
typedef Vector Unaligned __attribute__((aligned(4), may_alias));
auto at = [](const float* p) __attribute__((always_inline)) -> Unaligned& {{ return *(Unaligned*)p; }};
"""


_REGISTERS = """
#if defined(__AVX512F__)
constexpr int lanes = 16, most = 8;  // 24 sums, 3 vectors and a factor in 32 registers
#elif defined(__AVX__)
constexpr int lanes = 8, most = 4;  // 12 sums in 16
#else
constexpr int lanes = 4, most = 8;
#endif
""" + _vectors("4 * lanes")

# Of 16 numbers, by halves.
_TOTAL = """
auto total = [](const float* p) __attribute__((always_inline)) {
    typedef float Eight __attribute__((vector_size(32), aligned(4), may_alias));
    typedef float Four __attribute__((vector_size(16)));
    const Eight e = *(const Eight*)p + *(const Eight*)(p + 8);
    const Four f = __builtin_shufflevector(e, e, 0, 1, 2, 3) + __builtin_shufflevector(e, e, 4, 5, 6, 7);
    return (f[0] + f[2]) + (f[1] + f[3]);
};
"""

# With x = n log 2 + r, exp(x) is 2^n exp(r), and exp(x) - 1 is 2^n (exp(r) - 1) + (2^n - 1).
_EXP = """
auto expm1 = [](Vector x) __attribute__((always_inline)) {
    const Vector bounded = x < -87.0f ? Vector{} - 87.0f : x > 88.0f ? Vector{} + 88.0f : x;  // NaN stays NaN
    const Vector shifted = bounded * 1.44269504f + 12582912.0f;  // its last bits are n
    const Vector n = shifted - 12582912.0f;
    const Vector r = (bounded - n * 0.693359375f) + n * 2.12194440e-4f;
    const Vector power = (Vector)(((Whole)shifted << 23) + 0x3f800000);
    Vector p = ((r * (1.0f / 5040) + (1.0f / 720)) * r + (1.0f / 120)) * r + (1.0f / 24);
    p = ((p * r + (1.0f / 6)) * r + 0.5f) * r * r + r;
    return x > 88.0f ? Vector{} + __builtin_inff() : power * p + (power - 1.0f);
};
"""


def _in_tiles(count: str, tile: str) -> str:
    """A loop over this many units, N at a time: the compiler must know how many sums to keep in registers."""
    cases = (f"case {n}: {{ {tile.replace('N', str(n))} break; }}" for n in range(1, 9))
    return "\n".join([
        f"for (int unit = 0, height; unit < {count}; unit += height) {{",
        f"const int tiles = ({count} - unit + most - 1) / most;",
        f"height = ({count} - unit + tiles - 1) / tiles;",
        "switch (height) {", *cases, "}}",
    ])  # fmt: skip


_PRODUCT = _REGISTERS + """
const int ins = shape.units.data[layer], outs = shape.units.data[layer + 1], stride = b.stride;
const int skipped = layer == 0 ? ins - b.inputs : 0;
const bool relu = shape.activation == 0, elu = shape.activation == 1, linear = layer + 1 == shape.layers;
float* below = (float*)b.memory + shape.unit.data[layer] * stride;
float* above = (float*)b.memory + shape.unit.data[layer + 1] * stride;
const float* weight = (const float*)b.parameters + shape.weight.data[layer];
const float* bias = weight + ins * outs;
const float* x = back ? above : below;
float* y = back ? below : above;
const int depth = back ? outs : ins - skipped, width = back ? ins : outs;
const int to_next = back ? 1 : ins, to_deeper = back ? ins : 1;  // distances of weights
auto tile = [&](auto& sum, int row, int unit) __attribute__((always_inline)) {
    constexpr int height = sizeof(sum) / sizeof(sum[0]);
    float* const to = y + unit * stride + row;
    #pragma unroll
    for (int n = 0; n < 3 * height; ++n)
        sum[n / 3][n % 3] = back ? Vector{} : skipped ? Vector(at(to + n / 3 * stride + n % 3 * lanes))
                                 : Vector{} + bias[unit + n / 3];
    const float* w = weight + skipped + unit * to_next;
    const float* v = x + row;
    for (int k = 0; k < depth; ++k, w += to_deeper, v += stride) {
        const Vector v0 = at(v), v1 = at(v + lanes), v2 = at(v + 2 * lanes);
        #pragma unroll
        for (int i = 0; i < height; ++i) {
            const float factor = w[i * to_next];
            sum[i][0] += factor * v0;
            sum[i][1] += factor * v1;
            sum[i][2] += factor * v2;
        }
    }
    #pragma unroll
    for (int n = 0; n < 3 * height; ++n) {
        Unaligned& out = at(to + n / 3 * stride + n % 3 * lanes);
        const Vector s = sum[n / 3][n % 3], h = out;
        if (!back) out = relu && !linear ? (s <= 0.0f ? Vector{} : s) : s;  // NaN stays NaN
        else if (relu) out = h <= 0.0f ? Vector{} : s;
        else out = elu ? (h <= 0.0f ? s * (h + 1.0f) : s) : s * (1.0f - h * h);
    }
};
for (int row = 0; row < b.rows; row += 3 * lanes)
""" + _in_tiles("width", "Vector sum[N][3]; tile(sum, row, unit);")  # fmt: skip


@wp.func_native(_PRODUCT)
def _product(shape: Shape, b: Block, layer: int, back: bool):
    """A layer's outputs; or the gradients by its inputs times the activation's slope, which take the inputs' place."""


_GRADIENT = _REGISTERS + _TOTAL + """
const int ins = shape.units.data[layer], outs = shape.units.data[layer + 1], stride = b.stride;
float* gradient = (float*)b.gradient + shape.weight.data[layer];
const float* x = (const float*)b.memory + shape.unit.data[layer] * stride;
const float* delta = (const float*)b.memory + shape.unit.data[layer + 1] * stride;
auto tile = [&](auto& units, int unit, int in) __attribute__((always_inline)) {
    constexpr int height = sizeof(units);
    const int left = ins - in;  // less than three: some sums are made twice, and dropped
    const int one = left > 1 ? stride : 0, two = left > 2 ? 2 * stride : 0;
    float sums[3 * height][16];
    for (int set = 0; set < 16; set += lanes) {  // as many of the sets of rows as a register takes
        Vector sum[height][3] = {};
        const float* d = delta + unit * stride + set;
        const float* v = x + in * stride + set;
        for (int row = 0; row < b.rows; row += 16, d += 16, v += 16) {
            const Vector v0 = at(v), v1 = at(v + one), v2 = at(v + two);
            #pragma unroll
            for (int i = 0; i < height; ++i) {
                const Vector u = at(d + i * stride);
                sum[i][0] += u * v0;
                sum[i][1] += u * v1;
                sum[i][2] += u * v2;
            }
        }
        #pragma unroll
        for (int n = 0; n < 3 * height; ++n) at(sums[n] + set) = sum[n / 3][n % 3];
    }
    #pragma unroll
    for (int n = 0; n < 3 * height; ++n)
        if (n % 3 < left) gradient[(unit + n / 3) * ins + in + n % 3] += total(sums[n]);
};
""" + _in_tiles("outs", "char units[N]; for (int in = 0; in < ins; in += 3) tile(units, unit, in);") + """
for (int unit = 0; unit < outs; ++unit) {
    float sums[16] = {};
    for (int row = 0; row < b.rows; row += 16)
        for (int i = 0; i < 16; ++i) sums[i] += delta[unit * stride + row + i];
    gradient[ins * outs + unit] += total(sums);
}
"""  # fmt: skip


@wp.func_native(_GRADIENT)
def _add_gradient(shape: Shape, b: Block, layer: int):
    """Add the gradient by a layer's weights and biases."""


_ACTIVATION = _vectors("64") + _EXP + """
float* y = (float*)b.memory + shape.unit.data[layer + 1] * b.stride;
for (int unit = 0; unit < shape.units.data[layer + 1]; ++unit, y += b.stride)
    for (int row = 0; row < b.rows; row += 16) {
        const Vector s = at(y + row);
        if (shape.activation == 1) at(y + row) = s <= 0.0f ? expm1(s) : s;
        else {
            const Vector e = expm1(s <= 0.0f ? 2.0f * s : -2.0f * s), t = e / (e + 2.0f);
            at(y + row) = s <= 0.0f ? t : -t;
        }
    }
"""  # fmt: skip


@wp.func_native(_ACTIVATION)
def _apply_activation(shape: Shape, b: Block, layer: int):
    """Apply ELU or tanh to a layer's outputs; ReLU costs nothing while they are in registers."""


# The data of a loss are stored behind the outputs, column by column as in ``losses``.
_VALUE = _vectors("64") + _TOTAL + """
float* value = (float*)b.memory + shape.unit.data[shape.layers] * b.stride;
const float *weight = value + b.stride, *old = weight + b.stride, *target = old + b.stride;
Vector loss = {};
for (int row = 0; row < b.rows; row += 16) {
    const Vector v = at(value + row), w = at(weight + row), error = v - at(target + row), step = v - at(old + row);
    const Vector held = step < -clip ? Vector{} - clip : step > clip ? Vector{} + clip : step;
    const Vector kept = at(old + row) + held - at(target + row), plain = error * error, clipped = kept * kept;
    const Vector slope = 2.0f * w * error;
    loss += w * (plain >= clipped ? plain : clipped);
    at(value + row) = ((step == held) | (plain >= clipped)) ? slope : slope * 0.0f;  // 0 times NaN is NaN
}
((float*)b.gradient)[shape.parameters] += total((float*)&loss);
"""  # fmt: skip


@wp.func_native(_VALUE)
def _value_loss(shape: Shape, b: Block, clip: float):
    """Replace the outputs by the gradients of ``losses.ValueLoss`` by them, and add its sum."""


_SURROGATE = _vectors("64") + _TOTAL + _EXP + """
const int stride = b.stride, actions = shape.units.data[shape.layers];
float* mean = (float*)b.memory + shape.unit.data[shape.layers] * stride;
float *action = mean + actions * stride, *old_mean = action + actions * stride, *log_prob = old_mean + actions * stride;
float *advantage = log_prob + stride, *weight = advantage + stride, *slope = log_prob;  // by log r
const float* std = (const float*)b.parameters + shape.free;
float *std_gradient = (float*)b.gradient + shape.free, *sums = (float*)b.gradient + shape.parameters;
float normaliser = 0.918938533f * actions;
for (int a = 0; a < actions; ++a) normaliser += logf(std[a]);
Vector loss = {};
for (int row = 0; row < b.rows; row += 16) {
    Vector squares = {};
    for (int a = 0; a < actions; ++a) {
        const Vector z = (at(action + a * stride + row) - at(mean + a * stride + row)) / std[a];
        squares += z * z;
    }
    const Vector ratio = expm1(-0.5f * squares - normaliser - at(log_prob + row)) + 1.0f, gain = -at(advantage + row);
    const Vector least = Vector{} + (1.0f - clip), most = Vector{} + (1.0f + clip);
    const Vector held = ratio < least ? least : ratio > most ? most : ratio;
    const Vector plain = gain * ratio, clipped = gain * held, by_ratio = at(weight + row) * plain;
    loss += at(weight + row) * (plain >= clipped ? plain : clipped);
    at(slope + row) = plain >= clipped ? by_ratio : by_ratio * 0.0f;
}
sums[0] += total((float*)&loss);
for (int a = 0; a < actions; ++a) {
    Vector by_std = {}, moved = {};
    for (int row = 0; row < b.rows; row += 16) {
        Unaligned& m = at(mean + a * stride + row);
        const Vector z = (at(action + a * stride + row) - m) / std[a], step = m - at(old_mean + a * stride + row);
        by_std += (z * z - 1.0f) * at(slope + row);
        moved += at(weight + row) * step * step;
        m = z / std[a] * at(slope + row);
    }
    std_gradient[a] += total((float*)&by_std) / std[a];
    sums[1 + a] += total((float*)&moved);
}
"""  # fmt: skip


@wp.func_native(_SURROGATE)
def _surrogate(shape: Shape, b: Block, clip: float):
    """Replace the outputs by the gradients of ``losses.Surrogate`` by them; add those by deviations, and its sums."""


@wp.func_native("return address + 4 * ((wp::uint64)i * (wp::uint64)size + (wp::uint64)j * (wp::uint64)step);")
def _offset(address: wp.uint64, i: int, size: wp.int64, j: int, step: wp.int64) -> wp.uint64:
    """Where number i * size + j * step lies; there may be more than 2^31."""


@wp.func_native("""
float* y = (float*)b.memory + unit * b.stride;
for (int i = 0; i < units; ++i, y += b.stride) {
    for (int row = 0; row < rows; ++row) y[row] = ((const float*)source)[row * to_row + i * to_unit];
    for (int row = rows; row < b.rows; ++row) y[row] = y[rows - 1];
}
""")
def _read(b: Block, unit: int, units: int, rows: int, source: wp.uint64, to_row: wp.int64, to_unit: wp.int64):
    """Copy units of rows into a block; behind them the last row is repeated, which overflows only if it does itself."""


@wp.func_native("""
const float* y = (const float*)b.memory + unit * b.stride;
for (int row = 0; row < rows; ++row)
    for (int i = 0; i < units; ++i) ((float*)to)[row * units + i] = y[i * b.stride + row];
""")
def _write(b: Block, unit: int, units: int, rows: int, to: wp.uint64):
    """Copy units of rows out of a block, row by row."""


@wp.func_native("""
float* y = (float*)b.memory + unit * b.stride;
for (int row = 0, until; row < b.rows; row = until) {
    const int group = (first + row) / shared, end = (group + 1) * shared - first;
    until = end < rows ? end : b.rows;
    for (int i = 0; i < units; ++i) {
        const float value = ((const float*)start)[(long long)group * units + i];
        for (int r = row; r < until; ++r) y[i * b.stride + r] = value;
    }
}
""")
def _broadcast(b: Block, unit: int, units: int, first: int, rows: int, start: wp.uint64, shared: int):
    """Write what the first layer's sums start from, the same for ``shared`` consecutive rows."""


@wp.func_native("for (int i = 0; i < count; ++i) ((float*)address)[i] = 0.0f;")
def _clear(address: wp.uint64, count: int): ...


@wp.func_native("return __atomic_fetch_add((int*)counter, 1, __ATOMIC_RELAXED);")
def _take(counter: wp.uint64) -> int:
    """The next number, for one thread alone: Warp's own ``atomic_add`` is none on a CPU."""


@wp.func
def _backward(shape: Shape, b: Block):
    """Add all gradients, given those by the outputs in the outputs' place."""
    for step in range(shape.layers):
        layer = shape.layers - 1 - step
        _add_gradient(shape, b, layer)
        if layer > 0:
            _product(shape, b, layer, True)


@wp.func
def _work_on(shape: Shape, job: Job, b: Block, net: int, first: int, rows: int):
    """Take some rows through a network, and back."""
    outs, end = shape.units[shape.layers], shape.unit[shape.layers]
    if job.start != wp.uint64(0):
        start = _offset(job.start, net, wp.int64(job.rows // job.shared) * wp.int64(shape.units[1]), 0, wp.int64(0))
        _broadcast(b, shape.unit[1], shape.units[1], first, rows, start, job.shared)
    _read(b, 0, b.inputs, rows, _offset(job.x, net, job.x_net, first, job.x_row), job.x_row, job.x_unit)
    for layer in range(shape.layers):
        _product(shape, b, layer, False)
        if shape.activation > 0 and layer + 1 < shape.layers:
            _apply_activation(shape, b, layer)
    if job.mode == wp.static(int(Mode.FORWARD)):
        _write(b, end, outs, rows, _offset(job.y, net, wp.int64(job.rows) * wp.int64(outs), first, wp.int64(outs)))
        return
    given = job.mode == wp.static(int(Mode.BACKWARD))
    place = wp.where(given, end, end + outs)  # the loss's data come behind the outputs
    data = _offset(job.data, net, job.data_net, first, job.data_row)
    _read(b, place, job.columns, rows, data, job.data_row, job.data_column)
    # What is behind the last row adds nothing: its gradients, or its weight, are 0.
    zero = wp.where(job.mode == wp.static(int(Mode.SURROGATE)), place + job.columns - 1, place)
    for unit in range(zero, zero + wp.where(given, outs, 1)):
        _clear(_offset(b.memory, unit, wp.int64(b.stride), rows, wp.int64(1)), b.rows - rows)
    if job.mode == wp.static(int(Mode.VALUE)):
        _value_loss(shape, b, job.clip)
    elif job.mode == wp.static(int(Mode.SURROGATE)):
        _surrogate(shape, b, job.clip)
    _backward(shape, b)


@wp.kernel
def _work(shape: Shape, jobs: wp.array[Job], thread: int):
    """Take parts until there are none left: cores that others use too are not equally fast."""
    job = jobs[0]
    b = Block()
    b.memory = _offset(job.memory, thread, wp.int64(job.memory_size), 0, wp.int64(0))
    b.stride = job.stride
    b.inputs = job.inputs
    blocks = (job.rows + job.block_rows - 1) // job.block_rows
    size = shape.parameters + job.sums
    task = _take(job.counter)
    while task < job.count * job.parts:
        net, part = task // job.parts, task % job.parts
        b.parameters = _offset(job.parameters, net, wp.int64(shape.parameters), 0, wp.int64(0))
        b.gradient = _offset(job.gradient, task, wp.int64(size), 0, wp.int64(0))
        if job.mode != wp.static(int(Mode.FORWARD)):
            _clear(b.gradient, size)
        for block in range(part * blocks // job.parts, (part + 1) * blocks // job.parts):
            first = block * job.block_rows
            rows = wp.min(job.block_rows, job.rows - first)
            b.rows = (rows + STEP - 1) // STEP * STEP
            _work_on(shape, job, b, net, first, rows)
        task = _take(job.counter)


def record(shape: Shape, jobs: wp.array, thread: int) -> wp.Launch:
    """A launch for one of the threads that share ``jobs[0]``, to be replayed whenever that job has been filled in."""
    return wp.launch(_work, dim=1, inputs=[shape, jobs, thread], device="cpu", record_cmd=True)
