"""Limits of input values. Imports nothing, so that the command line can check them first."""

LARGEST = 1e18
"""Largest length, angle or radiance: its square is finite in single precision."""

SMALLEST = 1e-18
"""Smallest value that must be above 0: its square is above 0 in single precision."""

FARTHEST_FOCUS = 1e12
"""Metres; a lens focused at this distance or beyond is focused at infinity."""

MAX_EXTENT = 1e9
"""Largest extent of a mesh in metres: squares of its triangles' areas stay finite."""

MAX_TRIANGLES = 20_000_000
"""Triangles of a scene; each instance counts, as it has its own memory."""

MAX_SIDE = 2**16
MAX_PIXELS = 2**28

MAX_VALUES, VALUES_PER_BYTE = 2**28, 64


def most_values(stored: int) -> int:
    """Largest number of values (pixels × channels) of an image file of `stored` bytes.

    The limit is 1 GiB of floats, plus a compression ratio that no photograph exceeds. A small file that claims to be a huge
    image is refused before memory is allocated.
    """
    return MAX_VALUES + VALUES_PER_BYTE * stored


MAX_INT = 2**31 - 1
"""Largest whole number in the header of an EXR file."""

MAX_THREADS = 1024
VIEWS = ("photo", "aces", "srgb")
"""Display transforms of `image/views.py`; the first is the default."""

MAX_EXPOSURE = 100.0
