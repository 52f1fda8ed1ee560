"""Random numbers keyed by seed, step, pixel and dimension.

Each number is a hash of its key, so it does not depend on threads, on batches, on the
order of tracing or on which other pixels are rendered.

Numbers come in two kinds. Those of `uniform` are independent. Those of `stratified` fill
the unit cube evenly over the steps of a pixel: they are a Sobol' sequence, scrambled for
every pixel and dimension by a random I-binomial matrix (Tezuka and Faure 2003) and a random
digital shift, whose variance is that of Owen's nested scrambling (Owen 2003). Each of them is
uniform and those of one step are independent, but given a pixel's earlier steps they are
not: nothing that was learnt from those may decide what a number is used for.

Lens points whose density is learnt step by step therefore take independent numbers. The film position
x and the first bounce b may be stratified all the same: given them and the past, the
average of f(x, l, b) / q(l | x) over the lens point l is the integral of f over the lens,
whatever q has become, and nothing of the past is left in it.

Lens points may be stratified too, over a block of steps for which their density was settled
before the block began: the block's scramble is its own, so that it knows nothing of the past
that settled it. The same holds for light samples whose choice is learnt, and then for first
bounces as well: how much one counts beside a light sample (MIS) depends on what was learnt.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from bokehguide.render.kernels import kernel
from bokehguide.render.transfers import sent

_MASK = 0xFFFFFFFF
_BITS = 31
_DIRECTIONS = (torch.quasirandom.SobolEngine(8).sobolstate << 1).tolist()
"""Sobol' direction numbers of _BITS bits (Joe and Kuo 2008), by dimension and bit of the index."""
_AT_ONCE = 4
"""Bits of points are taken so many at once: each number of them is compiled anew."""


def hash_int(x: int) -> int:
    """32-bit integer hash (Wellons' `lowbias32`); a bijection."""
    x &= _MASK
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & _MASK
    x = ((x ^ (x >> 15)) * 0x846CA68B) & _MASK
    return x ^ (x >> 16)


def _signed(x: int) -> int:
    return x - (1 << 32) if x >= 1 << 31 else x


def hash_tensor(x: Tensor) -> Tensor:
    """`hash_int` of int32 values, as int32, in place."""
    shifted = x >> 16
    x ^= shifted.bitwise_and_(0xFFFF)
    x *= _signed(0x7FEB352D)
    torch.bitwise_right_shift(x, 15, out=shifted)
    x ^= shifted.bitwise_and_(0x1FFFF)
    x *= _signed(0x846CA68B)
    torch.bitwise_right_shift(x, 16, out=shifted)
    x ^= shifted.bitwise_and_(0xFFFF)
    return x


def shuffle_index(index: int, key: int) -> int:
    """A random reordering of 0, 1, 2, … that keeps every aligned block of 2^k together, and 2^k … 2^(k+1) - 1 in place."""
    bits = [hash_int(key + hash_int((index >> bit) * 32 + bit)) & 1 for bit in range(1, index.bit_length())]
    return index ^ sum(flip << bit for bit, flip in enumerate(bits))


def sobol_point(index: int, dimension: int) -> int:
    """Coordinate of the Sobol' point `index`, as an integer of _BITS bits."""
    value = 0
    for bit in range(index.bit_length()):
        value ^= _DIRECTIONS[dimension][bit] * (index >> bit & 1)
    return value


def _places(point: int) -> list[int]:
    """Places of the ones among its _BITS bits, from the highest down."""
    return [place for place in range(_BITS) if point >> (_BITS - 1 - place) & 1]


def _to_unit(bits: Tensor) -> Tensor:
    """Float32 in (0, 1) from the upper 23 of the _BITS lower bits of int32 values, which it overwrites."""
    return bits.bitwise_right_shift_(8).bitwise_and_(0x7FFFFF).to(torch.float32).add_(0.5).mul_(2.0**-23)


@kernel
def _uniform(pixel_keys: Tensor, keys: Tensor) -> Tensor:
    """Numbers float32 `[keys, N]` from a hash of every key and pixel."""
    return _to_unit(hash_tensor(pixel_keys ^ keys[:, None]).bitwise_right_shift_(1))


@kernel
def _scrambled(pixel_keys: Tensor, keys: Tensor, places: Tensor) -> Tensor:
    """Points of Sobol' sequences, float32 `[keys, N]`, scrambled by every key and pixel.

    places: of the ones among the points' bits, from the highest down, float32 `[ones, keys]`; _BITS where there are fewer.
    """
    values = hash_tensor(pixel_keys ^ keys[:, None])
    columns = (values * _signed(0x9E3779B1)).bitwise_or_(0x40000000).bitwise_and_(0x7FFFFFFF)  # the first ones of the matrices
    for place in places.to(torch.int32):
        values ^= columns >> place[:, None]
    return _to_unit(values)


class PixelRandom:
    """Uniform numbers for the paths of some pixels at one step.

    seed, step: any integers; the first step is 1. pixels: int32 `[N]`, flat pixel indices.
    `select` follows the compaction of ended paths.
    """

    def __init__(self, seed: int, step: int, pixels: Tensor):
        self.pixel_keys = hash_tensor(pixels.to(torch.int32) ^ _signed(hash_int(seed)))
        self.step_key = hash_int(hash_int(seed ^ 0x9E3779B9) + step)
        self.seed_key = hash_int(seed ^ 0x2545F491)
        self.index = (step - 1) & 0x3FFFFFFF

    def select(self, index: Tensor) -> PixelRandom:
        """The generator of the paths at `index`, int64 `[M]`."""
        return self._with(self.pixel_keys.index_select(0, index))

    def copies(self, number: Tensor) -> PixelRandom:
        """Numbers of their own for the copies 1, 2, … of a path, int64 `[N]`; those of number 0 stay what they are."""
        others = hash_tensor(self.pixel_keys ^ hash_tensor(number.to(torch.int32)))
        return self._with(torch.where(number > 0, others, self.pixel_keys))

    def _with(self, pixel_keys: Tensor) -> PixelRandom:
        other = object.__new__(PixelRandom)
        other.pixel_keys, other.step_key, other.seed_key, other.index = pixel_keys, self.step_key, self.seed_key, self.index
        return other

    def uniform(self, dimension: int, count: int) -> Tensor:
        """Numbers of dimensions `dimension … dimension + count - 1`, float32 `[count, N]`.

        Multiples of 2^-23 shifted by half a step: never 0 and never 1.
        """
        return _uniform(self.pixel_keys, self._keys(self.step_key + 0x3C6EF372 * (dimension + i) for i in range(count)))

    def _keys(self, keys: Iterable[int]) -> Tensor:
        return sent([_signed(hash_int(key)) for key in keys], self.pixel_keys.device, torch.int32)

    def stratified(self, dimension: int, count: int, first: int = 1) -> Tensor:
        """Like `uniform`, with numbers that are one point of a `count`-dimensional sequence over the steps from `first` on.

        `dimension` and `first` name the sequence; at most 8 dimensions. Sequences of different
        names are independent but for being evenly spread each.
        """
        key = hash_int(self.seed_key + 0x3C6EF372 * dimension + hash_int(first - 1))
        index = shuffle_index(self.index - (first - 1), key)
        ones = [_places(sobol_point(index, i)) for i in range(count)]
        rows = max(-(-max(map(len, ones)) // _AT_ONCE), 1) * _AT_ONCE
        places = [[float(point[row] if row < len(point) else _BITS) for point in ones] for row in range(rows)]
        return _scrambled(self.pixel_keys, self._keys(key + i for i in range(count)), sent(places, self.pixel_keys.device))
