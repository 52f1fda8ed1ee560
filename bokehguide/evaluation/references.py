"""Reference images: given files, and renders in two independent halves, whose difference estimates their error."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import platformdirs
import torch
from torch import Tensor

from bokehguide import __version__
from bokehguide.evaluation.fingerprint import fingerprint
from bokehguide.evaluation.long_renders import LongRender, accumulate
from bokehguide.evaluation.regions import MEASURES, between_halves, regions
from bokehguide.image import check_writable, read_metadata, read_rgb, write_exr
from bokehguide.metrics import read_reference
from bokehguide.scene.digest import digest
from bokehguide.scene.types import Scene
from bokehguide.train import RenderSettings

CHUNK = 256
"""SPP of one chunk of a half."""
FIRST_SEED, SECOND_SEED = 1_000_000, 2_000_000
"""First seeds of the halves; each chunk takes the next seed. Measured renders have other seeds."""
MODE = "guided"
"""Mode of rendered references."""


@dataclass(frozen=True)
class Reference:
    """The image that errors are measured against.

    radiance: float32 `[H, W, 3]`; path: its EXR; mode, spp: None if the file lacks them; halves: MAPE and relMSE between the
    two halves, by known region.
    """

    radiance: Tensor
    path: Path
    mode: str | None
    spp: int | None
    halves: Mapping[str, Mapping[str, float]]

    def own_error(self, region: str) -> float | None:
        """Estimated MAPE of the reference: half of the MAPE between its halves. None for an unknown region."""
        return self.halves[region]["mape"] / 2 if region in self.halves else None

    def facts(self) -> dict[str, Any]:
        """All but the pixels, ready for JSON, with a digest of the pixels."""
        facts = {"path": str(self.path), "mode": self.mode, "spp": self.spp, "between_halves": self.halves}
        return facts | {"digest": digest(self.radiance.numpy())}


def given_reference(path: Path, scene: Scene) -> Reference:
    """The reference in an EXR. Raises BokehguideError as `read_reference` does."""
    radiance = read_reference(path, scene.film.width, scene.film.height)
    header = read_metadata(path)
    try:
        between = json.loads(header["between_halves"])
        halves = {"frame": {measure: float(between[measure]) for measure in MEASURES}}
    except (KeyError, TypeError, ValueError):
        halves = {}
    return Reference(radiance, path, header.get("mode"), header.get("spp"), halves)


def made_reference(scene: Scene, settings: RenderSettings, path: Path, cache: Path | None = None) -> Reference:
    """A reference of two halves, which are rendered as far as `cache` lacks them, written to `path`.

    settings: SPP of both halves together, threads and device; mode and seed are not used. cache: as in `half_files`. Negative
    pixels are set to 0. Raises BokehguideError if a file cannot be written, or if a file in the cache is damaged.
    """
    check_writable(path)
    half = replace(settings, spp=math.ceil(settings.spp / 2))
    spp = sum(render.spp for render in rendered_halves(scene, half, cache))
    # Read from the files, so that a later run gets the same reference, bit for bit.
    first, second = (torch.from_numpy(read_rgb(file)) for file in half_files(scene, cache))
    mean = ((first + second) / 2).clamp(min=0.0)  # the control variate may leave negative pixels at few SPP
    masks = regions(scene).items()
    halves = {region: between_halves(first[mask][None], mean[mask][None]) for region, mask in masks}
    facts = {"scene": scene.name, "mode": MODE, "spp": spp, "between_halves": json.dumps(halves["frame"])}
    write_exr(path, {"beauty": mean.numpy()}, facts)
    return Reference(mean, path, MODE, spp, halves)


def rendered_halves(
    scene: Scene, settings: RenderSettings, cache: Path | None = None, deadline: float = math.inf
) -> tuple[LongRender, LongRender]:
    """The halves kept in `half_files`, continued until each has `settings.spp` samples a pixel or the deadline passes.

    settings: of one half; the mode and the seed are not used. Raises BokehguideError as `accumulate` does.
    """
    first, second = (
        accumulate(file, scene, replace(settings, mode=MODE, seed=seed), CHUNK, deadline)
        for file, seed in zip(half_files(scene, cache), (FIRST_SEED, SECOND_SEED))
    )
    return first, second


def half_files(scene: Scene, cache: Path | None = None) -> tuple[Path, Path]:
    """The EXR files of the two halves in `cache`, by default the user's cache folder.

    Their folder depends on the content of the scene, its camera, and the version of bokehguide.
    """
    cache = cache or platformdirs.user_cache_path("bokehguide") / "references"
    folder = cache / f"{__version__}-{fingerprint(scene, RenderSettings(MODE, seed=FIRST_SEED))[:16]}"
    stem = f"{scene.name}-{scene.film.width}x{scene.film.height}-{MODE}"
    return folder / f"{stem}-first.exr", folder / f"{stem}-second.exr"
