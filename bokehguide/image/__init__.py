"""Image files: EXR for radiance, PNG for display.

The names below are imported when they are first used: `reading.py` does without PyTorch.
"""

from typing import TYPE_CHECKING

from bokehguide.lazy_names import lazy_names

if TYPE_CHECKING:
    from bokehguide.image.exposure import metered_exposure
    from bokehguide.image.exr import drained, group_layers, read_exr, read_layers, read_metadata, read_rgb, write_exr
    from bokehguide.image.files import check_writable, make_folder, remove_abandoned, replacing, write_text
    from bokehguide.image.png import to_8_bit, write_png
    from bokehguide.image.tonemap import tone_map
    from bokehguide.image.views import Display, to_display

__all__ = [
    "Display",
    "check_writable",
    "drained",
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
    "write_text",
]

_HOMES = {
    "Display": "views",
    "check_writable": "files",
    "make_folder": "files",
    "metered_exposure": "exposure",
    "remove_abandoned": "files",
    "replacing": "files",
    "to_8_bit": "png",
    "to_display": "views",
    "tone_map": "tonemap",
    "write_png": "png",
    "write_text": "files",
}
"""Modules of the exported names; `exr` has the others."""

__getattr__, __dir__ = lazy_names(__name__, __all__, _HOMES, "exr")
