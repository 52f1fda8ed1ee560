"""Random numbers that are hashes of seed, step, pixel and dimension.

A dimension numbers a random decision of a sample (`dimensions.py`). A random number does not depend on threads, batches, the
order of tracing, or on the other rendered pixels.

There are two kinds of random numbers. The numbers of `uniform` are independent. The numbers of `stratified` cover the unit cube
evenly over the steps of a pixel. They are a Sobol' sequence, scrambled for each pixel and dimension by a random I-binomial matrix
(Tezuka and Faure 2003) and a random digital shift. Their variance equals the variance of Owen's nested scrambling (Owen 2003).
Each stratified number is uniform, and the numbers of one step are independent. Given the earlier steps of a pixel, the numbers of
a step are not uniform.

If a density adapts to the earlier steps of a pixel, its samples therefore need independent numbers. All other numbers of the path
may be stratified. Let x be the film position and b the first bounce. Given the past, the mean of f(x, l, b) / q(l | x) over the
lens point l is the integral of f over the lens, for any density q.

Samples of an adaptive density may also use stratified numbers over a range of steps in which the density does not change. The
sequence must start with the range, so that its scramble is independent of the past. In adaptive light sampling, the MIS weights
of BSDF samples depend on the light density. The numbers of these BSDF samples therefore need the same range.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType

import torch
from torch import Tensor

from bokehguide.runtime import native
from bokehguide.runtime.device import to_device
from bokehguide.runtime.indexing import ActiveEntries, Pixels, core_pixels, pixel_numbers

_MASK = 0xFFFFFFFF
_BITS = 31
_LONGEST_EPOCH = 1 << 20
_DIRECTIONS = (torch.quasirandom.SobolEngine(8).sobolstate << 1).tolist()
"""Direction numbers of Sobol' sequences, of _BITS bits (Joe and Kuo 2008), by dimension and bit of the index."""


def hash_int(x: int) -> int:
    """32-bit integer hash (`lowbias32` by Wellons), a bijection."""
    x &= _MASK
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & _MASK
    x = ((x ^ (x >> 15)) * 0x846CA68B) & _MASK
    return x ^ (x >> 16)


def _signed(x: int) -> int:
    return x - (1 << 32) if x >= 1 << 31 else x


def hash_tensor(x: Tensor) -> Tensor:
    """`hash_int` of int32 values of any shape, as int32, in place."""
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
    """Position of `index` in a random permutation of 0, 1, 2, …. The permutation keeps aligned blocks of 2^k numbers together,
    and maps the set 2^k … 2^(k+1) - 1 to itself."""
    bits = [hash_int(key + hash_int((index >> bit) * 32 + bit)) & 1 for bit in range(1, index.bit_length())]
    return index ^ sum(flip << bit for bit, flip in enumerate(bits))


def sobol_point(index: int, dimension: int) -> int:
    """Coordinate of Sobol' point `index`, an integer of _BITS bits."""
    value = 0
    for bit in range(index.bit_length()):
        value ^= _DIRECTIONS[dimension][bit] * (index >> bit & 1)
    return value


def member_index(key: int, steps: int, bit: int, group: int) -> int:
    """Index of the Sobol' point by which a member differs from member 0, for one bit of the member's number.

    A member has an aligned block of `steps` indices, in an order of its own. In the order of member 0, the first coordinates
    of all members would be nearly equal in each step.
    """
    index = steps << bit
    return index if index >= steps * group else index | hash_int(key - hash_int(bit)) & (steps - 1)


def _places(points: list[int], device: torch.device) -> Tensor:
    """Positions of the ones among the _BITS bits of points, from the highest bit down, int32 `[ones, points]`, padded with
    _BITS."""
    ones = [[place for place in range(_BITS) if point >> (_BITS - 1 - place) & 1] for point in points]
    rows = [[float(each[row] if row < len(each) else _BITS) for each in ones] for row in range(max(1, *map(len, ones)))]
    return to_device(rows, device).to(torch.int32)


def _to_unit(bits: Tensor) -> Tensor:
    """Float32 in (0, 1) from the upper 23 of the _BITS lower bits of int32 values. The function overwrites the values."""
    return bits.bitwise_right_shift_(8).bitwise_and_(0x7FFFFF).to(torch.float32).add_(0.5).mul_(2.0**-23)


def _copied(pixel_keys: Tensor, number: Tensor) -> Tensor:
    """Keys `[N]` of copies of pixels, int32; copies with the number 0 have the keys of the pixels."""
    return torch.where(number > 0, hash_tensor(pixel_keys ^ hash_tensor(number.clone())), pixel_keys)


def _uniform(pixel_keys: Tensor, keys: Tensor) -> Tensor:
    """Numbers float32 `[keys, N]` from a hash of every key and pixel."""
    return _to_unit(hash_tensor(pixel_keys ^ keys[:, None]).bitwise_right_shift_(1))


def _scrambled(pixel_keys: Tensor, keys: Tensor, points: list[int], changes: list[list[int]], member: Tensor | None) -> Tensor:
    """Points of Sobol' sequences, float32 `[keys, N]`, scrambled by each key and pixel.

    changes: points by which a member differs from member 0, for each bit of its number. member: int32 `[N]`, None for zeros.
    """
    values = hash_tensor(pixel_keys ^ keys[:, None])
    columns = (values * _signed(0x9E3779B1)).bitwise_or_(0x40000000).bitwise_and_(0x7FFFFFFF)  # the first columns of the matrices
    for place in _places(points, keys.device):
        values ^= columns >> place[:, None]
    for bit, change in enumerate(changes):
        assert member is not None
        product = torch.zeros_like(values)
        for place in _places(change, keys.device):
            product ^= columns >> place[:, None]
        values ^= product * (member >> bit & 1)
    return _to_unit(values)


def _pixel_keys(seed: int, pixels: Pixels, device: torch.device) -> Tensor:
    """Hashes of seed and pixel, int32 `[N]`."""
    core = native.core_on(device)
    if core is not None:
        first, numbers = core_pixels(pixels)
        keys = torch.empty(pixels.stop - first if isinstance(pixels, slice) else len(pixels), dtype=torch.int32)
        core.pixel_keys(hash_int(seed), first, None if numbers is None else numbers.long(), keys)
        return keys
    return hash_tensor(pixel_numbers(pixels, device).to(torch.int32) ^ _signed(hash_int(seed)))


class PixelRandom:
    """Random numbers for the paths of some pixels in one step.

    seed, step: any integers; the first step is 1. pixels: flat pixel indices. device: of the numbers of consecutive pixels.
    """

    def __init__(self, seed: int, step: int, pixels: Pixels, device: torch.device | str = "cpu"):
        device = pixels.device if isinstance(pixels, Tensor) else torch.device(device)
        self.pixel_keys = self._shared_keys = _pixel_keys(seed, pixels, device)
        self._member: Tensor | None = None
        self._group = 1
        self.step_key = hash_int(hash_int(seed ^ 0x9E3779B9) + step)
        self.seed_key = hash_int(seed ^ 0x2545F491)
        self.index = (step - 1) & 0x3FFFFFFF

    def select(self, index: Tensor) -> PixelRandom:
        """Random numbers of the paths at `index`, int64 `[M]`."""
        member = None if self._member is None else self._member.index_select(0, index)
        return self._with(self.pixel_keys.index_select(0, index), self._shared_keys.index_select(0, index), member)

    def in_groups(self, keys: Tensor, member: Tensor, size: int) -> PixelRandom:
        """Random numbers whose sequences in `stratified` are shared by groups of pixels within an epoch (`_in_epoch`).

        keys: of the group of each pixel, int32 `[N]`. member: number of a pixel in its group, int32 `[N]`, from 0 to `size` - 1.
        size: a power of two. All numbers of a group in an epoch are then stratified together, and those of each pixel too.
        """
        other = self._with(self.pixel_keys, hash_tensor(keys ^ _signed(self.seed_key)), member)
        other._group = size
        return other

    def copies(self, number: Tensor) -> PixelRandom:
        """Random numbers of copies of paths; number: int64 `[N]`, of the copy. Copy 0 has the random numbers of the path.

        The copies 2 k and 2 k + 1 are a pair, and share the scramble of `stratified`.
        """
        number = number.to(torch.int32)
        member = (number & 1) * self._group
        if self._member is not None:
            member |= self._member
        return self._with(_copied(self.pixel_keys, number), _copied(self._shared_keys, number >> 1), member)

    def _with(self, pixel_keys: Tensor, shared_keys: Tensor, member: Tensor | None) -> PixelRandom:
        other = object.__new__(PixelRandom)
        other.pixel_keys, other._shared_keys, other._member = pixel_keys, shared_keys, member
        other.step_key, other.seed_key, other.index, other._group = self.step_key, self.seed_key, self.index, self._group
        return other

    def uniform(self, dimension: int, count: int) -> Tensor:
        """Numbers of dimensions `dimension … dimension + count - 1`, float32 `[count, N]`.

        Multiples of 2^-23, shifted by half of that: neither 0 nor 1.
        """
        if self._core is not None:
            return self._native(self._core, self.pixel_keys, dimension, count, 0)
        return _uniform(self.pixel_keys, self._keys(self.step_key + 0x3C6EF372 * (dimension + i) for i in range(count)))

    @property
    def _core(self) -> ModuleType | None:
        """The native core, whose numbers have the same bits."""
        return native.core_on(self.pixel_keys.device)

    def _native(
        self,
        core: ModuleType,
        keys: Tensor,
        dimension: int,
        count: int,
        first: int,
        number: int = 0,
        member: Tensor | None = None,
    ) -> Tensor:
        """Numbers of the native core; first, number: as in `stratified`, `first` is 0 for `uniform`. member: see `_scrambled`."""
        numbers, member = torch.empty(count, len(keys)), None if member is None else member.contiguous()
        core.random(self.core_keys(core), keys.contiguous(), dimension & _MASK, count, first, number, member, None, numbers)
        return numbers

    def core_keys(self, core: ModuleType) -> object:
        """The `Random` of the extension: the keys of the step."""
        return core.Random(self.step_key, self.seed_key, self.index, self._group)

    def stratify(self, numbers: Tensor, replaced: Tensor, dimension: int, first: int) -> None:
        """Replace `numbers` `[count, N]` by those of `stratified` in some pixels; replaced: bool `[N]`."""
        if self._core is not None:
            keys = self._shared_keys if self._in_epoch(first) else self.pixel_keys
            given = (dimension & _MASK, len(numbers), first, 0)
            self._core.random(self.core_keys(self._core), keys.contiguous(), *given, self._member, replaced.contiguous(), numbers)
            return
        entries = ActiveEntries(replaced)
        if len(entries) > 0:
            entries.scatter(numbers, self.select(entries.index).stratified(dimension, len(numbers), first))

    def _keys(self, keys: Iterable[int]) -> Tensor:
        return to_device([_signed(hash_int(key)) for key in keys], self.pixel_keys.device, torch.int32)

    def stratified(self, dimension: int, count: int, first: int = 1, number: int = 0) -> Tensor:
        """Like `uniform`, `[count, N]`, but with a `count`-dimensional sequence, count ≤ 8, over the steps from `first` on.

        Each pair of `dimension` and `first` has its own sequence. Different sequences have independent scrambles.

        number: of a further sample of each path. In an epoch (`_in_epoch`) of n steps, the sequence goes on: member m of a group
        of G pixels, as copy c of a pair, has the points n (m + G (c + 2 number)) … for its steps. All samples of the group and of
        both copies together are then stratified. Outside an epoch, members, copies and further samples have scrambles of their
        own. After the last epoch (`RenderLoop.freeze`), copy 0 repeats the points of copy 1.
        """
        together = self._in_epoch(first)
        pixel_keys, member = (self._shared_keys, self._member) if together else (self.pixel_keys, None)
        if self._core is not None:
            return self._native(self._core, pixel_keys, dimension, count, first, number, member)
        key = hash_int(self.seed_key + 0x3C6EF372 * dimension + hash_int(first - 1))
        if number and not together:
            key = hash_int(key ^ hash_int(number))
        steps = max(first - 1, 1)
        index = shuffle_index(self.index - (first - 1), key) + (2 * steps * self._group * number if together else 0)
        points = [sobol_point(index, i) for i in range(count)]
        bits = range(self._group.bit_length() if member is not None else 0)
        indices = [member_index(key, steps, bit, self._group) for bit in bits]
        changes = [[sobol_point(index, i) for i in range(count)] for index in indices]
        return _scrambled(pixel_keys, self._keys(key + i for i in range(count)), points, changes, member)

    def _in_epoch(self, first: int) -> bool:
        """Whether the step is one of max(first - 1, 1) steps from `first` on. first - 1 is then 0 or a power of two, and small
        enough for the indices of further samples."""
        steps = max(first - 1, 1)
        return 0 <= self.index - (first - 1) < steps <= _LONGEST_EPOCH and steps & (steps - 1) == 0
