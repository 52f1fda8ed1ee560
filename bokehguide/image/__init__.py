"""Pictures in and out of files: EXR for radiance, PNG for looking at."""

from bokehguide.image.exr import read_exr, read_metadata, read_rgb, write_exr
from bokehguide.image.png import write_png
from bokehguide.image.tonemap import tone_map

__all__ = ["read_exr", "read_metadata", "read_rgb", "tone_map", "write_exr", "write_png"]
