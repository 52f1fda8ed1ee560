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
"""Of a model, all instances together: each has its own place in memory."""

MAX_SIDE = 2**16
MAX_PIXELS = 2**28

MAX_INT = 2**31 - 1
"""The largest whole number that a header of an EXR file holds."""

MAX_THREADS = 1024
MAX_EXPOSURE = 100.0
