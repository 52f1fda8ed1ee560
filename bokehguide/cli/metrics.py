"""`bokehguide metrics`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.report import json_file, text_beside, write_json
from bokehguide.errors import BokehguideError
from bokehguide.image import check_writable, read_rgb
from bokehguide.image.reading import read_crop
from bokehguide.metrics import Metrics, compare, read_reference
from bokehguide.scene.types import Inset


def run(options: argparse.Namespace) -> int:
    """Print the metrics of the frame and of each inset, one line each; SSIM is "-" for a box smaller than its window."""
    if file := json_file(options.json):
        print_folders(make_folders([file.parent]))
        check_writable(file)
    image = torch.from_numpy(read_rgb(options.image))
    reference = read_reference(options.reference)
    require_same_crop(options.image, options.reference)
    try:
        rows = {"frame": compare(image, reference)}
        rows |= {_label(box): _compare_inset(image, reference, Inset(*box)) for box in options.inset}
    except BokehguideError as error:
        raise BokehguideError(f"{options.image} against {options.reference}: {error}") from error
    if options.json:
        write_json(options.json, {label: _for_json(row) for label, row in rows.items()})
    with text_beside(options.json):
        print_table(rows)
    return 0


def print_table(rows: Mapping[str, Metrics]) -> None:
    """Print one line for the frame and for each inset."""
    width = max(map(len, rows))
    print(f"{'':<{width}}  {'MAPE':>10} {'relMSE':>10} {'SSIM':>8} {'PSNR':>8}")
    for label, row in rows.items():
        similarity = "-" if row.ssim is None else f"{row.ssim:.5f}"
        print(f"{label:<{width}}  {row.mape:>10.5f} {row.relmse:>10.5f} {similarity:>8} {row.psnr:>8.3f}")


def _for_json(row: Metrics) -> dict[str, float | None]:
    """The measures by name. JSON has no infinity, so that the PSNR of equal images is None."""
    return asdict(row) | {"psnr": row.psnr if math.isfinite(row.psnr) else None}


def require_same_crop(image: Path, reference: Path) -> None:
    """Raise BokehguideError if intact files have different parts of a frame. A whole frame may stand for a crop of its size."""
    crops = [read_crop(path) for path in (image, reference)]
    if None not in crops and crops[0] != crops[1]:
        one, other = ("{},{},{},{} of {}x{}".format(*crop) for crop in crops if crop is not None)
        raise BokehguideError(
            f"{image} against {reference}: the image is the crop {one} pixels, and the reference is the crop {other} pixels; "
            "give two images of the same crop"
        )


def _compare_inset(image: Tensor, reference: Tensor, inset: Inset) -> Metrics:
    rows, columns = inset.pixels(image.shape[1], image.shape[0])
    return compare(image[rows, columns], reference[rows, columns])


def _label(box: tuple[float, float, float, float]) -> str:
    return "inset " + ",".join(f"{value:g}" for value in box)
