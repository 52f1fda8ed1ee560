"""`bokehguide develop`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.pictures import chosen_exposure, png_values, warn_if_opaque
from bokehguide.cli.terminal import say
from bokehguide.errors import BokehguideError, printable
from bokehguide.image import Display, check_writable, read_layers, write_png
from bokehguide.image.views import VIEW_ATTRIBUTE
from bokehguide.limits import MAX_EXPOSURE, VIEWS

NEEDED = ("beauty", "variance", "albedo", "normal")
"""Layers that denoising needs."""


def run(options: argparse.Namespace) -> int:
    """Make a PNG from an EXR, with its exposure and view unless others are given."""
    layers, header = read_layers(options.picture)
    if "beauty" not in layers:
        raise BokehguideError(f"{options.picture}: has no channels R, G and B; give an EXR of a picture")
    if options.alpha and "alpha" not in layers:
        raise BokehguideError(f"--alpha: {options.picture} has no channel A; leave --alpha out, or give an EXR with alpha")
    out = options.out or options.picture.with_suffix(".png")
    print_folders(make_folders([out.parent]))
    check_writable(out)
    radiance = denoised(layers, options) if options.denoise else layers["beauty"]
    display = display_of(options, header).metered(radiance, layers.get("alpha"))
    alpha = layers["alpha"] if options.alpha else None
    write_png(out, png_values(display, radiance, alpha), options.bits)
    warn_if_opaque(alpha)
    if "denoised" in layers and not options.denoise:
        say(f"the PNG shows the noisy picture of {options.picture}; --denoise shows the denoised one")
    print(f"wrote {out}, exposure {display.exposure:+g} EV, view {display.view}")
    return 0


def display_of(options: argparse.Namespace, header: Mapping[str, Any]) -> Display:
    """Exposure and view of the options, else of the header; values in the header that do not fit are ignored."""
    stored, view = header.get("exposure"), header.get(VIEW_ATTRIBUTE)
    known = isinstance(stored, float) and math.isfinite(stored) and abs(stored) <= MAX_EXPOSURE
    return Display(
        chosen_exposure(options.exposure, stored if known else None), options.view or (view if view in VIEWS else VIEWS[0])
    )


def denoised(layers: Mapping[str, np.ndarray], options: argparse.Namespace) -> np.ndarray:
    """The denoised layer, or the beauty denoised by its variance. Raises BokehguideError where layers are missing."""
    if "denoised" in layers:
        return layers["denoised"]
    missing = [name for name in NEEDED if name not in layers]
    if missing:
        raise BokehguideError(
            f"{options.picture}: --denoise needs the layer{'s' * (len(missing) > 1)} {printable(', '.join(missing))}, which the "
            "file lacks; give an EXR of `bokehguide render`"
        )
    from bokehguide.image.denoise import denoise_by_variance

    return denoise_by_variance(*(layers[name] for name in NEEDED)).radiance
