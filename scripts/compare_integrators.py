"""Errors of `guided_thinlens` and of its nested integrator in Mitsuba 3, at equal CPU time.

    pip install '.[mitsuba]'
    python scripts/compare_integrators.py scene.xml other.xml --width 480 --spp 64 --seeds 6
    python scripts/compare_integrators.py staircase.xml --blur 0.05 --json out/staircase.json

SCENE is an XML file of Mitsuba with a thin lens or a pinhole. A pinhole becomes a thin lens that focuses on the middle of the
picture; `--blur` sets its aperture. The nested integrator is the scene's own. Both render with S seeds, after a first render that
compiles the kernels. The SPP of the plain renders are those that take the CPU time of a guided render. CPU time is that of all
threads, since other load of the machine does not change it.

Each integrator also renders CHUNKS parts of a long render. The reference is the long render whose halves differ less. Its error
is half the error between its halves; the table gives it as "reference". The bokeh region has the pixels whose lens sees an area
emitter in part, out of focus by at least BLURRED pixels. Tests of means compare both long renders over blocks of BLOCK × BLOCK
pixels.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import norm, t

if importlib.util.find_spec("mitsuba") is None:
    sys.exit("compare_integrators: error: Mitsuba is not installed; pip install '.[mitsuba]'")
import drjit as dr
import mitsuba as mi

from bokehguide.cli.parser import Parser, positive
from bokehguide.cli.report import write_json
from bokehguide.cli.scripts import run
from bokehguide.errors import BokehguideError
from bokehguide.evaluation import markdown
from bokehguide.metrics import EPSILON, mape
from bokehguide.mitsuba.frame import matrix

CHUNKS, BLOCK = 8, 8
BLURRED = 4.0
"""Smallest diameter of the circle of confusion in the bokeh region, pixels."""
SEEN = (0.002, 0.5)
"""Parts of the lens that see an emitter, in the bokeh region."""
LENS_RAYS = 512
"""Rays per pixel that look for emitters."""
REFERENCE_SEED = 1_000_000


@dataclass
class View:
    """A scene, its integrator and a thin lens with a film of the wanted size."""

    name: str
    scene: Any
    nested: Any
    sensor: Any

    def render(self, integrator: Any, spp: int, seed: int) -> tuple[torch.Tensor, float]:
        """Radiance `[H, W, 3]`, and CPU seconds."""
        dr.sync_thread()
        start = time.process_time()
        picture = np.array(mi.render(self.scene, sensor=self.sensor, integrator=integrator, spp=spp, seed=seed))
        return torch.from_numpy(picture[..., :3].copy()), time.process_time() - start


def main() -> None:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scenes", nargs="+", type=Path, metavar="SCENE", help="an XML file of Mitsuba")
    add("--mode", default="guided", help="mode of guided_thinlens (default: guided)")
    add("--width", type=positive, default=480, metavar="N", help="pixels (default: 480)")
    add("--spp", type=positive, default=64, metavar="N", help="of guided renders (default: 64)")
    add("--seeds", type=positive, default=6, metavar="N", help="renders of each integrator (default: 6)")
    add("--reference-spp", type=positive, default=4096, metavar="N", help="of a long render (default: 4096)")
    add("--blur", type=float, default=0.03, help="of infinity behind a pinhole, over the width (default: 0.03)")
    add("--cache", type=Path, default=Path("out/integrators"), metavar="DIR", help="folder of the references")
    add("--json", type=Path, metavar="FILE", help="all figures")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    found: list[dict[str, Any]] = []
    for path in args.scenes:
        found.append(compare(load(path, args.width, args.blur), args))
        print(table(found[-1:]), flush=True)
    if args.json:
        write_json(args.json, {one["scene"]: one for one in found})
    if len(found) > 1:
        print(table(found))


def load(path: Path, width: int, blur: float) -> View:
    """The scene of a file. Raises BokehguideError for a missing file and for sensors without a lens or pinhole."""
    if not path.is_file():
        raise BokehguideError(f"{path}: no such file")
    scene = mi.load_file(str(path))
    sensor = scene.sensors()[0]
    values, (columns, rows) = mi.traverse(sensor), sensor.film().size()
    film = {"type": "hdrfilm", "width": width, "height": round(width * rows / columns), "rfilter": {"type": "box"}}
    fov = float(values["x_fov"][0])
    if sensor.class_name() == "ThinLensCamera":
        lens = {name: float(values[name][0]) for name in ("aperture_radius", "focus_distance")}
    elif sensor.class_name() == "PerspectiveCamera":
        ray, _ = sensor.sample_ray(0.0, 0.0, mi.Point2f(0.5), mi.Point2f(0.5))
        distance = float(scene.ray_intersect_preliminary(ray).t[0])
        lens = {"aperture_radius": blur * distance * np.tan(np.radians(fov) / 2.0), "focus_distance": distance}
    else:
        raise BokehguideError(f"{path}: the sensor is a {sensor.class_name()}; give a scene with a thin lens or a pinhole")
    place = matrix(sensor.world_transform())
    thin = {"type": "thinlens", "fov": fov, "fov_axis": "x", "to_world": mi.ScalarTransform4f(place), "film": film} | lens
    return View(f"{path.parent.name}-{path.stem}", scene, scene.integrator(), mi.load_dict(thin))


def compare(view: View, args: argparse.Namespace) -> dict[str, Any]:
    """All figures of a scene."""
    guided = mi.load_dict({"type": "guided_thinlens", "mode": args.mode, "nested": view.nested})
    masks, long = bokeh_masks(view), [long_render(view, integrator, args) for integrator in (guided, view.nested)]
    parts = min(long, key=lambda each: half_error(each, masks["frame"]))
    reference = parts.mean(dim=0)
    for integrator in (guided, view.nested):  # compile
        view.render(integrator, args.spp, 0)
    ratio = view.render(guided, args.spp, 0)[1] / view.render(view.nested, args.spp, 0)[1]
    plain_spp, own, plain = max(round(args.spp * ratio), 1), [], []
    for seed in range(1, args.seeds + 1):
        own.append(view.render(guided, args.spp, seed))
        plain.append(view.render(view.nested, plain_spp, seed))
    seconds = [float(np.median([time for _, time in runs])) for runs in (own, plain)]
    found = {
        "scene": view.name,
        "spp": [args.spp, plain_spp],
        "seconds": seconds,
        "bokeh_part": float(masks["bokeh"].float().mean()),
    }
    for name, mask in masks.items():
        if mask.any():
            both = [[error(picture, reference, mask) for picture, _ in runs] for runs in (own, plain)]
            found[name] = {"mape": both, "reference": half_error(parts, mask), **ratio_of(both, seconds)}
    return found | {"means": means(*long)}


def error(picture: torch.Tensor, reference: torch.Tensor, mask: torch.Tensor) -> float:
    """MAPE over the pixels of a mask."""
    return mape(picture[mask][None], reference[mask][None])


def half_error(parts: torch.Tensor, mask: torch.Tensor) -> float:
    """Estimate of the error of the mean of parts `[CHUNKS, H, W, 3]`: half of that between the means of two halves."""
    first, second = parts[::2].mean(dim=0), parts[1::2].mean(dim=0)
    return 0.5 * ((first - second).abs() / (0.5 * (first + second) + EPSILON))[mask].mean().item()


def ratio_of(errors: list[list[float]], seconds: list[float]) -> dict[str, float]:
    """Ratio of the mean errors at the time of the guided renders, and its standard error from the spread over the seeds.

    Errors fall with the square root of the time, which removes what is left of the difference of the times.
    """
    first, second = map(np.array, errors)
    ratio = first.mean() / second.mean() * (seconds[0] / seconds[1]) ** 0.5
    spread = sum(values.var(ddof=1) / len(values) / values.mean() ** 2 for values in (first, second)) if len(first) > 1 else 0.0
    return {"ratio": float(ratio), "standard_error": float(ratio * spread**0.5)}


def long_render(view: View, integrator: Any, args: argparse.Namespace) -> torch.Tensor:
    """Independent renders `[CHUNKS, H, W, 3]`, kept in the cache."""
    size, spp = tuple(view.sensor.film().size()), max(args.reference_spp // CHUNKS, 1)
    key = hashlib.sha256(f"{integrator}{view.sensor}{size}{spp}".encode()).hexdigest()[:16]
    path = args.cache / f"{view.name}-{key}.npy"
    if not path.is_file():
        parts = [view.render(integrator, spp, REFERENCE_SEED + part)[0] for part in range(CHUNKS)]
        args.cache.mkdir(parents=True, exist_ok=True)
        np.save(path, torch.stack(parts).numpy())
    return torch.from_numpy(np.load(path))


def bokeh_masks(view: View) -> dict[str, torch.Tensor]:
    """The regions, bool `[H, W]`: all pixels, those in the bokeh of an area emitter, and the rest."""
    width, height = view.sensor.film().size()
    values, pixels = mi.traverse(view.sensor), width * height
    seen, blurred = np.zeros(pixels), np.zeros(pixels)
    x, y = np.arange(pixels) % width, np.arange(pixels) // width
    focus, random = float(values["focus_distance"][0]), np.random.default_rng(0)
    # Diameter on the film, in pixels, of the circle of confusion of a point at infinity.
    infinite = float(values["aperture_radius"][0]) / focus * width / np.tan(np.radians(float(values["x_fov"][0])) / 2.0)
    forward = view.sensor.world_transform() @ mi.Vector3f(0.0, 0.0, 1.0)
    for _ in range(LENS_RAYS):
        place = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
        ray, _ = view.sensor.sample_ray(0.0, 0.5, place, mi.Point2f(*random.random((2, pixels)).astype(np.float32)))
        hit = view.scene.ray_intersect(ray)
        bright = np.array(hit.is_valid() & hit.shape.is_emitter())
        depth = np.array(hit.t * dr.dot(ray.d, forward))
        seen += bright
        blurred += bright & (infinite * np.abs(1.0 - focus / np.where(bright, depth, focus)) >= BLURRED)
    part = seen / LENS_RAYS
    mask = (part >= SEEN[0]) & (part <= SEEN[1]) & (blurred >= 0.5 * seen)
    return {
        name: torch.from_numpy(np.reshape(each, (height, width)))
        for name, each in (("frame", np.ones(pixels, bool)), ("bokeh", mask), ("rest", ~mask))
    }


def means(own: torch.Tensor, plain: torch.Tensor) -> dict[str, float]:
    """Tests of the means of blocks: z of the frame, the part of the blocks with |z| > 3, and the largest |z|."""
    sets = [blocks(pictures) for pictures in (own, plain)]
    frame = welch([each.mean(axis=1, keepdims=True) for each in sets])
    each = welch(sets)
    return {
        "frame_z": float(frame[0]),
        "blocks": len(each),
        "above_3": int((np.abs(each) > 3.0).sum()),
        "largest_z": float(np.abs(each).max()),
    }


def blocks(pictures: torch.Tensor) -> np.ndarray:
    """Mean luminance of the blocks of pictures `[R, H, W, 3]`, `[R, blocks]`."""
    light = pictures.double().mean(dim=-1)
    return torch.nn.functional.avg_pool2d(light, BLOCK).flatten(1).numpy()


def welch(sets: list[np.ndarray]) -> np.ndarray:
    """z of the differences of the means of two sets of runs `[R, N]`, by Welch's t-test with the rounding of single precision."""
    first, second = sets
    parts = [each.var(axis=0, ddof=1) / len(each) + 1e-30 for each in sets]
    rounding = (1e-4 * np.abs(second.mean(axis=0))) ** 2
    freedom = sum(parts) ** 2 / sum(part**2 / (len(each) - 1) for part, each in zip(parts, sets))
    found = (first.mean(axis=0) - second.mean(axis=0)) / np.sqrt(sum(parts) + rounding)
    return np.sign(found) * norm.isf(np.maximum(t.sf(np.abs(found), freedom), 1e-300))


def table(found: list[dict[str, Any]]) -> str:
    """A row for each region of each scene, in Markdown."""
    rows = [["scene", "region", "SPP", "seconds", "MAPE", "reference", "ratio", "frame z", "blocks above 3", "largest z"]]
    for one in found:
        for name in ("frame", "bokeh", "rest"):
            if name not in one:
                continue
            part, test = one[name], one["means"]
            pair = [
                " / ".join(f"{value:.{digits}f}" for value in values)
                for values, digits in ((one["spp"], 0), (one["seconds"], 2), ([np.mean(each) for each in part["mape"]], 4))
            ]
            tests = [f"{test['frame_z']:.1f}", f"{test['above_3']} of {test['blocks']}", f"{test['largest_z']:.1f}"]
            rows.append(
                [
                    one["scene"],
                    name,
                    *pair,
                    f"{part['reference']:.4f}",
                    f"{part['ratio']:.3f} ± {part['standard_error']:.3f}",
                    *tests,
                ]
            )
    return markdown(rows)


if __name__ == "__main__":
    run(main)
