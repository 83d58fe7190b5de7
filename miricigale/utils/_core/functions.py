"""Elementary functions in double and in single precision, which the compiler can take side by side."""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from miricigale.utils.compilation import PART, njit

_LOG2E = 1.4426950408889634
# Their sum is ln 2; products of the first with whole numbers are exact in either precision.
_LN2_HIGH = 0.693359375
_LN2_LOW = -2.121944400546905e-4
_LOG10_2 = 0.30102999566398120
_LOG10_E = 0.43429448190325183
_MANTISSA32 = np.int32(0x007FFFFF)
_HALF_ONE32 = np.int32(0x3F000000)
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_HALF_ONE = np.int64(0x3FE0000000000000)
_ROOT_HALF = 0.70710678118654752


@intrinsic
def as_type(_, x, to):
    """Bits of a number as a number of another type of the same size."""
    out = to.instance_type

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], context.get_value_type(signature.return_type))

    return out(x, to), generate


def polynomial(double, single=()):
    """Make a compiled polynomial of these coefficients, those of the highest powers first."""

    @intrinsic
    def evaluate(_, x):
        def generate(context, builder, signature, args):
            kind = args[0].type
            value = ir.Constant(kind, 0.0)
            for c in single if x == types.float32 else double:
                value = builder.fmul(value, args[0], flags=("fast",))
                value = builder.fadd(value, ir.Constant(kind, c), flags=("fast",))
            return value

        return x(x), generate

    return evaluate


_EXPONENTIAL = polynomial(
    (1 / 362880, 1 / 40320, 1 / 5040, 1 / 720, 1 / 120, 1 / 24, 1 / 6, 0.5, 1.0, 1.0),
    (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1,
     5.0000001201e-1, 1.0, 1.0),
)  # fmt: skip
# atanh(t) / t in t^2
_ATANH = polynomial((1 / 11, 1 / 9, 1 / 7, 1 / 5, 1 / 3, 1.0), (1 / 7, 1 / 5, 1 / 3, 1.0))


def _power_of_two(m):
    """2^m of a whole number, in its type."""


@overload(_power_of_two, jit_options=PART)
def _power_of_two_of_type(m):
    if m == types.float32:
        return lambda m: as_type(np.int32((np.int32(m) + 127) << 23), np.float32)
    return lambda m: as_type(np.int64(np.int32(m) + 1023) << np.int64(52), np.float64)


@njit(**PART)
def exponential(e):
    """exp(e) for abs(e) up to 700, to 1e-11 (after Cody & Waite); up to 80 in single precision."""
    real = type(e)
    m = np.floor(e * real(_LOG2E) + real(0.5))
    r = e - m * real(_LN2_HIGH)
    return _EXPONENTIAL(r - m * real(_LN2_LOW)) * _power_of_two(m)


@njit(**PART)
def log10(x):
    """Logarithm of positive normal numbers, to 1e-10, in double precision (0: about -308)."""
    # x = m 2^e with m in [0.5, 1)
    bits = as_type(x, np.int64)
    e = np.float64(np.int32((bits >> np.int64(52)) - np.int64(1022)))
    m = as_type((bits & _MANTISSA) | _HALF_ONE, np.float64) / _ROOT_HALF
    t = (m - 1.0) / (m + 1.0)
    return (e - 0.5) * _LOG10_2 + 2.0 * _LOG10_E * t * _ATANH(t * t)


@njit(**PART)
def log10_single(x):
    """Logarithm of positive normal numbers in single precision, to 1e-6."""
    half = np.float32(0.5)
    one = np.float32(1.0)
    bits = as_type(x, np.int32)
    e = np.float32(np.int32(bits >> np.int32(23)) - np.int32(126))
    m = as_type(np.int32((bits & _MANTISSA32) | _HALF_ONE32), np.float32) * np.float32(
        1.0 / _ROOT_HALF
    )
    t = (m - one) / (m + one)
    log = (e - half) * np.float32(_LOG10_2)
    return log + np.float32(2.0 * _LOG10_E) * t * _ATANH(t * t)
