"""Vectorized arithmetic of the compiled loops: powers of two, and weighted sums of neighbouring colours.

The compiler does not vectorize across the bands of a colour; these intrinsics emit the vector operations themselves,
for 4 x 4 pixels of an image, for 2 x 2 texels of a texture, and for entries of a table of R, G, B and a zero.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from twin.kernels import kernel

LOG2_E = 1.4426950408889634
LEAST = -126.0  # exponent of the smallest normal number in single precision; smaller exponents are clipped to it


@kernel(inline="always")
def two_to(t):
    """Returns 2^t for t from -126 to 127 with a relative error of 2e-7, exactly 1 at 0; a smaller t counts as -126.

    2^t = 2^n 2^f with |f| <= 1/2: 2^f - 1 is a minimax polynomial, 2^n sets the exponent bits of a float32.
    """
    one, t = np.float32(1.0), max(t, np.float32(LEAST))
    n = np.floor(t + np.float32(0.5))
    f = t - n
    p = np.float32(9.671513e-3) + f * np.float32(1.3264727e-3)
    p = np.float32(2.4022242e-1) + f * (np.float32(5.5507336e-2) + f * p)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * (one + f * (np.float32(6.931470e-1) + f * p))


_PIXELS, _BANDS = 4, 3
_FUSED = ("contract",)  # lets the compiler fuse multiplication and addition
_NUMBER, _INDEX = ir.FloatType(), ir.IntType(32)


@intrinsic
def sum_of_pixels(typingctx, image, start, stride, weights, at):
    """Returns weighted sums (R, G, B) of 4 x 4 pixels of a float32 image (H, 3 W) at `start`; no bounds are checked."""
    # `stride` is that of rows; column `at` of `weights` (8, n) holds those of the columns (0 to 3) and of the rows (4
    # to 7)
    result = types.UniTuple(types.float32, _BANDS)
    signature = result(image, types.int64, types.int64, weights, types.int64)

    def emit(context, builder, sig, args):
        image_type, _, _, weights_type, _ = sig.args
        values = context.make_array(image_type)(context, builder, args[0]).data
        shares = context.make_array(weights_type)(context, builder, args[3])
        n = cgutils.unpack_tuple(builder, shares.shape)[1]
        wide, narrow = ir.VectorType(_NUMBER, _PIXELS * _BANDS), ir.VectorType(_NUMBER, _PIXELS)

        def weight(k, vector):
            place = builder.add(builder.mul(n, ir.Constant(n.type, k)), args[4])
            return _repeated(builder, builder.load(builder.gep(shares.data, [place])), vector)

        column = None
        for k in range(_PIXELS):
            place = builder.add(args[1], builder.mul(args[2], ir.Constant(args[2].type, k)))
            column = _add(builder, column, _load(builder, values, place, wide), weight(_PIXELS + k, wide))
        total = None
        for k in range(_PIXELS):
            bands = [min(_BANDS * k + band, _PIXELS * _BANDS - 1) for band in range(_PIXELS)]
            mask = ir.Constant(ir.VectorType(_INDEX, _PIXELS), bands)
            pixel = builder.shuffle_vector(column, ir.Constant(wide, ir.Undefined), mask)
            total = _add(builder, total, pixel, weight(k, narrow))
        return context.make_tuple(builder, result, _bands(builder, total))

    return signature, emit


@intrinsic
def sum_of_texels(typingctx, texels, start, stride, weights):
    """Returns weighted sums (R, G, B) of 2 x 2 texels of uint8 colours (3 n,), row by row; no bounds are checked."""
    result, pair = types.UniTuple(types.float32, _BANDS), ir.VectorType(_NUMBER, 2 * _BANDS)

    def emit(context, builder, sig, args):
        values = context.make_array(sig.args[0])(context, builder, args[0]).data
        shares, total = cgutils.unpack_tuple(builder, args[3]), None
        spread = ir.Constant(ir.VectorType(_INDEX, 2 * _BANDS), [k // _BANDS for k in range(2 * _BANDS)])
        for row in range(2):
            place = builder.add(args[1], args[2]) if row else args[1]
            bytes_ = ir.VectorType(ir.IntType(8), 2 * _BANDS)
            loaded = builder.load(builder.bitcast(builder.gep(values, [place]), bytes_.as_pointer()))
            loaded.align = 1
            numbers = builder.uitofp(builder.zext(loaded, ir.VectorType(_INDEX, 2 * _BANDS)), pair)
            both = ir.Constant(ir.VectorType(_NUMBER, 2), ir.Undefined)
            for k in range(2):
                both = builder.insert_element(both, shares[2 * row + k], _INDEX(k))
            total = _add(builder, total, numbers, builder.shuffle_vector(both, both, spread))
        left, right = (
            builder.shuffle_vector(total, total, ir.Constant(ir.VectorType(_INDEX, _BANDS), bands))
            for bands in (list(range(_BANDS)), list(range(_BANDS, 2 * _BANDS)))
        )
        return context.make_tuple(builder, result, _bands(builder, builder.fadd(left, right)))

    return result(texels, types.int64, types.int64, types.UniTuple(types.float32, 4)), emit


@intrinsic
def sum_of_entries(typingctx, table, places, weights):
    """Returns the three sums (R, G, B) of entries of a float32 table, weighted by a tuple; no bounds are checked."""
    result = types.UniTuple(types.float32, _BANDS)

    def emit(context, builder, sig, args):
        values, vector = context.make_array(sig.args[0])(context, builder, args[0]).data, ir.VectorType(_NUMBER, 4)
        places, weights = (cgutils.unpack_tuple(builder, pair) for pair in args[1:])
        total = None
        for place, weight in zip(places, weights, strict=True):
            entry = _load(builder, values, builder.zext(place, ir.IntType(64)), vector)
            total = _add(builder, total, entry, _repeated(builder, weight, vector))
        return context.make_tuple(builder, result, _bands(builder, total))

    return result(table, places, weights), emit


def _load(builder, values, place, vector):
    loaded = builder.load(builder.bitcast(builder.gep(values, [place]), vector.as_pointer()))
    loaded.align = 4
    return loaded


def _repeated(builder, number, vector):
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, _INDEX(0))
    zeros = ir.Constant(ir.VectorType(_INDEX, vector.count), [0] * vector.count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def _add(builder, total, value, weight):
    """Returns the LLVM code for total + value * weight; a total of None counts as 0."""
    term = builder.fmul(value, weight, flags=_FUSED)
    return term if total is None else builder.fadd(total, term, flags=_FUSED)


def _bands(builder, vector):
    return [builder.extract_element(vector, _INDEX(band)) for band in range(_BANDS)]
