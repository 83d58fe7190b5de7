"""Light of interpolated models, eight columns of a table side by side in registers."""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

#: Columns that are taken at a time.
LANES = 8
#: Largest change of ln flux from the nearest node that is followed.
STEEPEST = 5.0

_SINGLES = ir.VectorType(ir.FloatType(), LANES)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_LONGS = ir.VectorType(ir.IntType(64), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_INT = ir.IntType(64)
# factors of the exponential function, as in `miricigale.utils._core.functions`
_LOG2E = 1.4426950408889634
_LN2_HIGH = 0.693359375
_LN2_LOW = -2.121944400546905e-4
_EXPONENTIAL = (
    1.9875691500e-4,
    1.3981999507e-3,
    8.3334519073e-3,
    4.1665795894e-2,
    1.6666665459e-1,
    5.0000001201e-1,
    1.0,
    1.0,
)
#: What is added to powers of 2 in doubles.
_BIAS = 1023
#: Largest exponent, so that powers of 2 are normal numbers.
_MOST = 690.0


def _same(vector, value):
    """Vector of one number."""
    return ir.Constant(vector, [value] * LANES)


def _spread(builder, vector, x):
    """Vector of a number that is known when the code runs."""
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), x, ir.Constant(_INT, 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), mask)


def _load(builder, pointer, vector, align):
    return builder.load(builder.bitcast(pointer, vector.as_pointer()), align=align)


def _clipped(builder, x, low, high):
    """Vector within two others."""
    x = builder.select(builder.fcmp_ordered("<", x, low), low, x)
    return builder.select(builder.fcmp_ordered(">", x, high), high, x)


def _exponential(builder, x):
    """exp(x) of single numbers as doubles, which reach further."""
    fast = ("fast",)
    x = _clipped(builder, x, _same(_SINGLES, -_MOST), _same(_SINGLES, _MOST))
    power = builder.fmul(x, _same(_SINGLES, _LOG2E))
    # numbers above 0 are rounded down
    power = builder.fptosi(builder.fadd(power, _same(_SINGLES, _BIAS + 0.5)), _INTS)
    whole = builder.sub(power, _same(_INTS, _BIAS))
    power = builder.sitofp(whole, _SINGLES)
    x = builder.fsub(x, builder.fmul(power, _same(_SINGLES, _LN2_HIGH)), flags=("contract",))
    x = builder.fsub(x, builder.fmul(power, _same(_SINGLES, _LN2_LOW)), flags=("contract",))
    value = _same(_SINGLES, 0.0)
    for factor in _EXPONENTIAL:
        value = builder.fadd(
            builder.fmul(value, x, flags=fast), _same(_SINGLES, factor), flags=fast
        )
    whole = builder.add(builder.sext(whole, _LONGS), _same(_LONGS, _BIAS))
    whole = builder.shl(whole, _same(_LONGS, 52))
    return builder.fmul(builder.fpext(value, _DOUBLES), builder.bitcast(whole, _DOUBLES))


def _logarithms(builder, table, n_columns, nodes, column):
    """Interpolated logarithms of columns, no further from those of the nearest node than may be."""
    data, n_models = table
    row, weight, count, z, next_z, nearest_z, part = nodes

    def columns_of(node_z, model):
        place = builder.add(builder.mul(node_z, n_models), model)
        place = builder.add(builder.mul(place, n_columns), column)
        return _load(builder, builder.gep(data, [place]), _SINGLES, 4)

    total = cgutils.alloca_once_value(builder, _same(_SINGLES, 0.0))
    with cgutils.for_range(builder, count) as loop:
        model = builder.load(builder.gep(row, [loop.index]))
        both = builder.load(builder.gep(weight, [loop.index]))
        above = builder.fmul(both, part)
        below = builder.fsub(both, above)
        low = _spread(builder, _SINGLES, builder.fptrunc(below, ir.FloatType()))
        high = _spread(builder, _SINGLES, builder.fptrunc(above, ir.FloatType()))
        low = builder.fmul(low, columns_of(z, model))
        new = builder.fadd(low, builder.fmul(high, columns_of(next_z, model)), flags=("contract",))
        builder.store(builder.fadd(builder.load(total), new), total)
    nearest = columns_of(nearest_z, builder.load(row))
    steepest = _same(_SINGLES, STEEPEST)
    return _clipped(
        builder,
        builder.load(total),
        builder.fsub(nearest, steepest),
        builder.fadd(nearest, steepest),
    )


@intrinsic
def add_exponentials(_, table, unit, row, weight, count, z, next_z, nearest_z, part, factor, out):
    """
    Add exponentials of interpolated logarithms to columns.

    Parameters
    ----------
    table, unit : `~numpy.ndarray`, float32 (nz, n_models, n_columns), float64 (n_columns,)
        Logarithms of at least eight columns, and units of what they are of.
    row, weight : `~numpy.ndarray`, int64 and float64, shape (n,)
        Nodes, the first of which is the nearest, and their weights.
    count : int
        Number of nodes.
    z, next_z, nearest_z : int
        Redshifts of the table below and above, and the nearer one.
    part, factor : float
        Part of the way to the next redshift; what columns are multiplied by.
    out : `~numpy.ndarray`, shape (n_columns,) or longer
        Is added to.
    """
    signature = types.void(
        table, unit, row, weight, types.intp, types.intp, types.intp, types.intp, *[types.float64] * 2, out
    )  # fmt: skip

    def generate(context, builder, signature, args):
        arrays = []
        for i in (0, 1, 2, 3, 10):
            arrays.append(context.make_array(signature.args[i])(context, builder, args[i]))
        table, unit, row, weight, out = arrays
        count, z, next_z, nearest_z, part, factor = args[4:10]
        _, n_models, n_columns = cgutils.unpack_tuple(builder, table.shape, 3)
        nodes = (row.data, weight.data, count, z, next_z, nearest_z, part)
        lanes = ir.Constant(_INT, LANES)
        n_blocks = builder.sdiv(builder.add(n_columns, ir.Constant(_INT, LANES - 1)), lanes)
        lane = ir.Constant(_LONGS, list(range(LANES)))
        with cgutils.for_range(builder, n_blocks) as loop:
            first = builder.mul(loop.index, lanes)
            # the last block begins earlier, and its columns count once
            last = builder.sub(n_columns, lanes)
            column = builder.select(builder.icmp_signed("<", first, last), first, last)
            log = _logarithms(builder, (table.data, n_models), n_columns, nodes, column)
            value = _exponential(builder, log)
            units = _load(builder, builder.gep(unit.data, [column]), _DOUBLES, 8)
            value = builder.fmul(value, units)
            value = builder.fmul(value, _spread(builder, _DOUBLES, factor))
            begin = _spread(builder, _LONGS, builder.sub(first, column))
            is_new = builder.icmp_signed(">=", lane, begin)
            value = builder.select(is_new, value, _same(_DOUBLES, 0.0))
            pointer = builder.gep(out.data, [column])
            total = builder.fadd(_load(builder, pointer, _DOUBLES, 8), value)
            builder.store(total, builder.bitcast(pointer, _DOUBLES.as_pointer()), align=8)
        return context.get_dummy_value()

    return signature, generate
