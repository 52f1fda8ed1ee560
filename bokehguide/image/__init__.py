"""Image files: EXR for radiance, PNG for display."""

from bokehguide.image.exr import read_exr, read_metadata, read_rgb, write_exr
from bokehguide.image.files import check_writable, make_folder, remove_abandoned, replacing
from bokehguide.image.png import to_8_bit, write_png
from bokehguide.image.tonemap import tone_map

__all__ = [
    "check_writable",
    "make_folder",
    "read_exr",
    "read_metadata",
    "read_rgb",
    "remove_abandoned",
    "replacing",
    "to_8_bit",
    "tone_map",
    "write_exr",
    "write_png",
]
