"""Image files: EXR for radiance, PNG for display."""

from bokehguide.image.exposure import metered_exposure
from bokehguide.image.exr import group_layers, read_exr, read_layers, read_metadata, read_rgb, write_exr
from bokehguide.image.files import check_writable, make_folder, remove_abandoned, replacing
from bokehguide.image.png import to_8_bit, write_png
from bokehguide.image.tonemap import tone_map
from bokehguide.image.views import Display, to_display

__all__ = [
    "Display",
    "check_writable",
    "group_layers",
    "make_folder",
    "metered_exposure",
    "read_exr",
    "read_layers",
    "read_metadata",
    "read_rgb",
    "remove_abandoned",
    "replacing",
    "to_8_bit",
    "to_display",
    "tone_map",
    "write_exr",
    "write_png",
]
