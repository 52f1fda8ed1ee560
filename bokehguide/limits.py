"""How large a number may be. Imports nothing, so that the command line may ask before all else."""

LARGEST = 1e18
"""Of any length, angle or radiance: its square is still a single-precision number."""

SMALLEST = 1e-18
"""Of what has to be above 0, for the same reason."""

FARTHEST_FOCUS = 1e12
"""Metres: a lens focused there or beyond is focused at infinity."""

MAX_EXTENT = 1e9
"""Metres of a mesh from end to end: of its triangles' areas the squares are taken."""

MAX_TRIANGLES = 20_000_000
"""Of a scene, all instances together: each has its own place in memory."""

MAX_SIDE = 2**16
MAX_PIXELS = 2**28

MAX_VALUES, VALUES_PER_BYTE = 2**28, 64


def most_values(stored: int) -> int:
    """To how many numbers (channels of pixels) images may unfold that are kept in so many bytes.

    1 GiB of floats, and what no photograph exceeds: a file of a few bytes that claims to be
    a huge image ends no render.
    """
    return MAX_VALUES + VALUES_PER_BYTE * stored


MAX_INT = 2**31 - 1
"""The largest whole number that a header of an EXR file holds."""

MAX_THREADS = 1024
MAX_EXPOSURE = 100.0
