"""Reference images: given ones, and those made in two independent halves, whose difference says how good they are."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

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
"""SPP of one of the renders that a half is the mean of."""
FIRST_SEED, SECOND_SEED = 1_000_000, 2_000_000
"""Seeds of the halves, one a chunk from there on. Renders that are measured have seeds that no reference uses."""
MODE = "guided"
"""In which a reference is rendered."""


@dataclass(frozen=True)
class Reference:
    """What errors are measured against.

    radiance: float32 `[H, W, 3]`; path: its EXR; mode, spp: None where its file does not tell;
    halves: MAPE and relMSE between its two halves by region, as far as they are known.
    """

    radiance: Tensor
    path: Path
    mode: str | None
    spp: int | None
    halves: Mapping[str, Mapping[str, float]]

    def own_error(self, region: str) -> float | None:
        """MAPE against the truth, as far as the halves tell: the mean is half their difference away from it."""
        return self.halves[region]["mape"] / 2 if region in self.halves else None

    def facts(self) -> dict[str, object]:
        """All but the pixels, ready for JSON."""
        facts = {"path": str(self.path), "mode": self.mode, "spp": self.spp, "between_halves": self.halves}
        return facts | {"digest": digest(self.radiance.numpy())}


def given_reference(path: Path, scene: Scene) -> Reference:
    """The reference in an EXR. Raises BokehguideError as `read_reference` does."""
    radiance = read_reference(path, scene.film.width, scene.film.height)
    header = read_metadata(path)
    try:
        told = json.loads(header["between_halves"])
        halves = {"frame": {measure: float(told[measure]) for measure in MEASURES}}
    except (KeyError, TypeError, ValueError):
        halves = {}
    return Reference(radiance, path, header.get("mode"), header.get("spp"), halves)


def made_reference(scene: Scene, settings: RenderSettings, path: Path, cache: Path | None = None) -> Reference:
    """A reference of two halves, rendered as far as they are not yet in `cache`, and written to `path`.

    settings: of the whole; its mode and seed are not used. cache: a folder, by default the
    user's own. It tells scenes apart by their content and camera, and one version of
    bokehguide from another.
    Raises BokehguideError where a file cannot be written, or one in the cache is damaged.
    """
    check_writable(path)
    cache = cache or platformdirs.user_cache_path("bokehguide") / "references"
    half = replace(settings, mode=MODE, seed=FIRST_SEED, spp=math.ceil(settings.spp / 2))
    folder = cache / f"{__version__}-{fingerprint(scene, half)[:16]}"
    spp = sum(render.spp for render in rendered_halves(folder, scene, half))
    # As they are in the files, so that a later run reads the same reference to the last bit.
    first, second = (torch.from_numpy(read_rgb(file)) for file in half_files(folder, scene, MODE))
    mean = (first + second) / 2
    masks = regions(scene).items()
    halves = {region: between_halves(first[mask][None], mean[mask][None]) for region, mask in masks}
    facts = {"scene": scene.name, "mode": MODE, "spp": spp, "between_halves": json.dumps(halves["frame"])}
    write_exr(path, {"beauty": mean.numpy()}, facts)
    return Reference(mean, path, MODE, spp, halves)


def rendered_halves(
    folder: Path, scene: Scene, settings: RenderSettings, deadline: float = math.inf
) -> tuple[LongRender, LongRender]:
    """The halves kept in `half_files`, continued until each has `settings.spp` or time is up; its seed is not used.

    Raises BokehguideError as `accumulate` does.
    """
    files, seeds = half_files(folder, scene, settings.mode), (FIRST_SEED, SECOND_SEED)
    first, second = (
        accumulate(file, scene, replace(settings, seed=seed), CHUNK, deadline) for file, seed in zip(files, seeds)
    )
    return first, second


def half_files(folder: Path, scene: Scene, mode: str) -> tuple[Path, Path]:
    stem = f"{scene.name}-{scene.film.width}x{scene.film.height}-{mode}"
    return folder / f"{stem}-first.exr", folder / f"{stem}-second.exr"
