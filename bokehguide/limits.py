"""Limits of input values. Imports nothing, so that the command line can check them first."""

LARGEST = 1e18
"""Largest length, angle or radiance: its square is finite in single precision."""

SMALLEST = 1e-18
"""Smallest value that must be above 0: its square is above 0 in single precision."""

NEAREST_FOCUS = 1e-9
"""Metres; slopes of rays through the edge of a lens stay finite in single precision."""

FARTHEST_FOCUS = 1e12
"""Metres; a lens focused at this distance or beyond is focused at infinity."""

MAX_EXTENT = 1e9
"""Largest extent of a mesh in metres: squares of its triangles' areas stay finite."""

MAX_TRIANGLES = 20_000_000
"""Triangles of a scene; each instance counts, as it has its own memory."""

FREE_TRIANGLES, FREE_INSTANCES, FREE_MESHES = 2**23, 2**20, 2**15
"""Triangles, instances and meshes of a scene that no file stores: of shapes, lights and repeated parts."""

MESH_BYTES = 100
"""Bytes of a file for each further mesh."""

MAX_SUNS = 256
"""Suns of a scene: every light sample looks at all of them."""

MAX_LIGHT_GROUPS = 32
"""Light groups of a scene: the film has sums of each."""

MAX_KEY_DEPTH = 100
"""Parts of a dotted key in TOML: the parser takes time and memory with the square of their number."""

MAX_SIDE = 2**16
MAX_PIXELS = 2**28

MAX_VALUES, VALUES_PER_BYTE = 2**27, 64
MAX_MAP_VALUES, MAP_VALUES_PER_BYTE = 2**25, 32


def most_values(stored: int) -> int:
    """Largest number of values (pixels × channels) of images of `stored` bytes, such as the textures of a scene.

    The limit is 512 MiB of floats, plus a compression ratio that no photograph exceeds. A small file that claims to be a huge
    image is refused before memory is allocated.
    """
    return MAX_VALUES + VALUES_PER_BYTE * stored


def most_map_values(stored: int) -> int:
    """As `most_values`, of an EXR or HDR file: the tables of an environment map take several times the memory of its texels."""
    return MAX_MAP_VALUES + MAP_VALUES_PER_BYTE * stored


def most_triangles(stored: int) -> int:
    """Largest number of triangles of a scene whose files have `stored` bytes; a compressed triangle takes a byte or more."""
    return min(MAX_TRIANGLES, FREE_TRIANGLES + stored)


MAX_DECODED, DECODED_PER_BYTE = 2**27, 64


def most_decoded(stored: int) -> int:
    """Largest number of bytes to which compressed buffers of `stored` bytes may decode. Real meshes reach a factor of 20."""
    return MAX_DECODED + DECODED_PER_BYTE * stored


MAX_INT = 2**31 - 1
"""Largest whole number in the header of an EXR file."""

MAX_THREADS = 1024
VIEWS = ("photo", "aces", "srgb")
"""Display transforms of `image/views.py`; the first is the default."""

MAX_EXPOSURE = 100.0
