"""Random numbers keyed by seed, step, pixel and dimension.

Each number is a hash of its key, so it does not depend on threads, on batches, on the
order of tracing or on which other pixels are rendered.
"""

from __future__ import annotations

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF


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


class PixelRandom:
    """Uniform numbers for the paths of some pixels at one step.

    seed, step: any integers. pixels: int32 `[N]`, flat pixel indices. `select` follows
    the compaction of ended paths.
    """

    def __init__(self, seed: int, step: int, pixels: Tensor):
        self.pixel_keys = hash_tensor(pixels.to(torch.int32) ^ _signed(hash_int(seed)))
        self.step_key = hash_int(hash_int(seed ^ 0x9E3779B9) + step)

    def select(self, index: Tensor) -> PixelRandom:
        """The generator of the paths at `index`, int64 `[M]`."""
        chosen = object.__new__(PixelRandom)
        chosen.pixel_keys = self.pixel_keys.index_select(0, index)
        chosen.step_key = self.step_key
        return chosen

    def uniform(self, dimension: int, count: int) -> Tensor:
        """Numbers of dimensions `dimension … dimension + count - 1`, float32 `[count, N]`.

        Multiples of 2^-23 shifted by half a step: never 0 and never 1.
        """
        keys = [_signed(hash_int(self.step_key + 0x3C6EF372 * (dimension + i))) for i in range(count)]
        keys = torch.tensor(keys, dtype=torch.int32, device=self.pixel_keys.device)[:, None]
        bits = hash_tensor(self.pixel_keys ^ keys)
        return bits.bitwise_right_shift_(9).bitwise_and_(0x7FFFFF).to(torch.float32).add_(0.5).mul_(2.0**-23)
