"""What each of the method's defaults is worth: one is changed at a time, on every built-in scene.

    python scripts/ablations.py
    python scripts/ablations.py fairy-lights chrome --only alpha,fits --seeds 4

Each row of the table is one change (CHANGES), each column a scene; a cell is MAPE over the insets
(over the frame for a scene without) divided by that of the default, both averaged over the
seeds, with the standard error of the quotient (- with one seed). The last column is the geometric
mean over the scenes.
A change is made in the mode that shows it: all that `lis-o` does, or `lis-b` where offsets
would make up for it; what `guided` adds is left out one by one (`--only guided`), and added to nothing one by one
(`--only alone`). Writes ablations.md, the table, and ablations.json, the MAPE of each render by a
digest of all that it depends on, into `--out`; renders that are there from an earlier run are kept.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import torch
from ablation_scenes import SCENES
from other_fields import KeptSpots, LearntField, LearntSpots
from torch import Tensor

import bokehguide
from bokehguide.cli.arguments import Parser, positive, size, threads
from bokehguide.cli.scripts import run
from bokehguide.errors import BokehguideError
from bokehguide.evaluation import errors, fingerprint, made_reference, progress, regions
from bokehguide.image import check_writable, replacing
from bokehguide.models import BlendWeightMap, GaussianField, disc_distribution, polynomial_offset
from bokehguide.models.disc_distribution import Band, Shapes, balls
from bokehguide.models.projection import lens_magnification
from bokehguide.render import direct_light, path_tracer
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.light_choice import LightChoice
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.builtin import BUILTIN
from bokehguide.scene.digest import digest
from bokehguide.scene.lamps import Lamps
from bokehguide.train import RenderLoop, RenderSettings, fitting, guide, known_lamps, loop, radiance_control, sharing, spot_guide
from bokehguide.train.known_lamps import KnownLamps
from bokehguide.train.lamp_yield import LampYield
from bokehguide.train.light_guide import LightGuide
from bokehguide.train.radiance_control import RadianceControl
from bokehguide.train.record_buffer import RecordBuffer
from bokehguide.train.voxel_record import VoxelRecord

HERE = (Path(__file__).with_name(name) for name in ("ablations.py", "other_fields.py"))
SOURCES = (*sorted(Path(bokehguide.__file__).parent.rglob("*.py")), *HERE)
CODE = digest(tuple(path.read_text() for path in SOURCES))
"""What renders of other code do not stand in for."""
FIRST_SEED = 5_000_000
REFERENCE_SHARE = 32
"""SPP of a reference for one of a render's."""


@dataclass(frozen=True)
class Change:
    """Names of the default and of what stands in for it, and where that stands.

    patches: (owner, attribute, value) each.
    """

    what: str
    value: str
    patches: tuple[tuple[object, str, object], ...] = ()
    mode: str = "lis-o"

    @contextlib.contextmanager
    def made(self) -> Iterator[None]:
        """The context in which it holds."""
        with contextlib.ExitStack() as stack:
            for owner, attribute, value in self.patches:
                stack.enter_context(mock.patch.object(owner, attribute, value))
            yield


def constants(what: str, owner: object, attribute: str, values: list[float], mode: str = "lis-o") -> list[Change]:
    return [Change(what, f"{value:g}", ((owner, attribute, value),), mode) for value in values]


def degree(highest: int) -> Change:
    exponents = [(i, j) for i in range(highest + 1) for j in range(highest + 1 - i)]
    return Change("polynomial degree", str(highest), ((polynomial_offset, "EXPONENTS", exponents),))


def start(beta: float) -> Change:
    """β in `lis`, which never changes it."""
    return Change("fixed β", f"{beta:g}", ((guide, "BlendWeightMap", lambda pixels: BlendWeightMap(pixels, beta)),), "lis")


def add_plain(record: RecordBuffer, cells: Tensor, points: Tensor, luminance: Tensor) -> None:
    """As `RecordBuffer.add`, but every sample's position counts the same, whatever its radiance."""
    index = (cells >= 0).nonzero()[:, 0]
    cells, light = cells[index], luminance[index]
    x, y, depth = points[:, index].unbind(0)
    for total, value in zip(record.sums, (torch.ones_like(light), light, x / depth, y / depth, 1.0 / depth)):
        total.index_add_(0, cells, value)


def plain_positions(record: RecordBuffer, cells: Tensor) -> Tensor:
    x, y, inverse_depth = record.sums[2:5, cells]
    return torch.stack((x, y, record.sums[0, cells])) / inverse_depth


def by_volume(field: GaussianField, focus_distance: float) -> Tensor:
    """Weights by the volume of each Gaussian's sphere."""
    return field.radius**3


def by_energy_alone(field: GaussianField, focus_distance: float) -> Tensor:
    """Weights that ignore distance, as Eq. 12 to 17 have them in print."""
    return field.energy


def by_area(field: GaussianField, focus_distance: float) -> Tensor:
    """Weights by the area that each sphere covers on the lens, whatever its radiance."""
    return (field.radius * lens_magnification(field.mean[2], focus_distance)).square()


def no_lamps(scene: Scene, camera: ThinLensCamera) -> KnownLamps:
    """Nothing known before the first ray."""
    nothing, triangles = torch.zeros(0, dtype=torch.int64), sum(len(mesh.triangles) for mesh in scene.meshes)
    shapes = Shapes(None, nothing, None, nothing, torch.zeros(0))
    return KnownLamps(GaussianField(), torch.zeros(6, 0), shapes, torch.zeros(triangles, dtype=torch.bool), False)


def nothing_found(*_: object) -> tuple[Tensor, ...]:
    """The field's lamps are all there is."""
    return torch.zeros(0, dtype=torch.int64), torch.zeros(3, 0), torch.zeros(6, 0), torch.zeros(0), torch.zeros(0)


def no_shapes(scene: Scene, lamps: Lamps, seen: Tensor, camera: ThinLensCamera) -> Shapes:
    """All lamps are ellipsoids."""
    none = torch.full((int(seen.sum()),), -1)
    return Shapes(None, none, None, none, torch.zeros(0))


def as_balls(squared: Tensor) -> Tensor:
    """Outlines of balls in the place of ellipsoids of squared half axes `[L, 3, 3]`."""
    return balls(torch.linalg.eigvalsh(squared)[:, -1].clamp(min=0.0).sqrt())


def uncut(center: Tensor, *_: Tensor) -> Band:
    """Ellipses are drawn beyond the lens as well. Compiled kernels would not know of it."""
    ones = torch.ones_like(center[0])
    return Band(torch.stack((ones, 0.0 * ones)), -2.0 * ones, 2.0 * ones, 0.0 * ones, ones)


def independent_lens_points(random: PixelRandom, dimension: int, count: int, first: int = 1) -> Tensor:
    """As `PixelRandom.stratified`, but of lens points every step is independent."""
    return random.uniform(dimension, count) if dimension == guide.LENS_DIMENSION else STRATIFIED(random, dimension, count, first)


STRATIFIED = PixelRandom.stratified


LAMPS, FOUND, LIGHTS, SHARING = "known lamps", "found highlights", "learnt lights", "shared paths"
PARTS: dict[str, tuple[tuple[object, str, object], ...]] = {
    LAMPS: ((spot_guide, "known_lamps", no_lamps),),
    FOUND: ((spot_guide, "fit_ellipsoids", nothing_found),),
    "voxels by depth": ((VoxelRecord, "_layers", lambda _, depth: torch.zeros_like(depth, dtype=torch.int64)),),
    "images in mirrors and glass": ((PathSamples, "image", property(lambda samples: samples.distance)),),
    "shapes of map lamps and panels": ((known_lamps, "_shapes", no_shapes),),
    "proportions (else balls)": ((known_lamps, "packed", as_balls),),
    "discs cut off at the lens": ((disc_distribution, "_band", uncut),),
    "learnt yields of lamps": ((LampYield, "factor", lambda _, slots: torch.ones(slots.shape)),),
    "learnt β (else 0.65)": ((spot_guide, "LOWEST", 0.65), (spot_guide, "HIGHEST", 0.65)),
    "shared β": ((spot_guide, "POOLED", 1),),
    "stratified lens points": ((PixelRandom, "stratified", independent_lens_points),),
    "split paths": ((spot_guide, "PARTS", 1), (spot_guide, "MOST_PARTS", 1)),
    SHARING: ((sharing, "LONG", 1), (sharing, "SHORT", 1)),
    "weights as a control": ((RadianceControl, "update", lambda *_: None),),
    "resampled lights": ((direct_light, "CANDIDATES", 1),),
    "learnt visibility": ((LightChoice, "visibility", lambda _, cluster: torch.ones(cluster.shape)),),
    LIGHTS: ((LightGuide, "update", lambda *_: None),),
}
"""What mode `guided` is made of, and the patches that take each part away."""
NEEDED = {
    "voxels by depth": (FOUND,),
    "images in mirrors and glass": (FOUND,),
    "shapes of map lamps and panels": (LAMPS,),
    "proportions (else balls)": (LAMPS,),
    "discs cut off at the lens": (LAMPS,),
    "learnt yields of lamps": (LAMPS,),
    "learnt β (else 0.65)": (LAMPS,),
    "shared β": (LAMPS, "learnt β (else 0.65)"),
    "learnt visibility": (LIGHTS, "resampled lights"),
    "weights as a control": (SHARING,),
}
"""Parts that do nothing by themselves, and what they are added to."""


def guided_with(what: str, kept: tuple[str, ...]) -> Change:
    """Mode `guided` with only some of its parts."""
    patches = tuple(patch for part, away in PARTS.items() if part not in kept for patch in away)
    return Change(f"guided {what}", "", patches, "guided")


def guided_without(part: str) -> Change:
    return guided_with(f"without {part}", tuple(other for other in PARTS if other != part))


def alone(part: str) -> Change:
    needed = NEEDED.get(part, ())
    return guided_with(f"with {part} alone" if not needed else f"with {part} on {' and '.join(needed)}", (part, *needed))


def parts(number: int) -> Change:
    """Into how many paths samples split."""
    return Change("paths of a draw of weight 1", str(number), ((spot_guide, "PARTS", number), (spot_guide, "MOST_PARTS", 8 * number)), "guided")


def group(long: int, short: int) -> Change:
    """How many pixels share what their rays find."""
    return Change("pixels of a group", f"{long} x {short}", ((sharing, "LONG", long), (sharing, "SHORT", short)), "guided")


SPOTS = (("kept after 8 steps", KeptSpots), ("kept, and learnt by the KL", LearntSpots))
PLAIN = ((RecordBuffer, "add", add_plain), (RecordBuffer, "positions", plain_positions))
CHANGES = {
    "alpha": constants("α of σ = α R_b", fitting, "ALPHA", [0.25, 0.35, 0.7, 1.0]),
    "radiance": constants("radiance threshold / frame's mean", fitting, "RADIANCE_THRESHOLD", [2.0, 4.0, 16.0, 32.0]),
    "coc": constants("CoC threshold, pixels", fitting, "COC_THRESHOLD", [2.0, 8.0, 16.0]),
    "gap": constants("depth gap, cell widths", fitting, "DEPTH_GAP", [2.0, 32.0, math.inf]),
    "fits": constants("number of fits", guide, "FITS", [2, 4, 16, 32]),
    "degree": [degree(0), degree(1), degree(3)],
    "blend-rate": constants("learning rate of β", guide, "BLEND_RATE", [0.02, 0.05, 0.2, 0.5], "lis-b"),
    "offset-rate": constants("learning rate of the offsets", guide, "OFFSET_RATE", [0.001, 0.003, 0.03, 0.1]),
    "fixed-beta": [start(0.5), start(0.65), start(0.9)],
    "guided": [guided_without(part) for part in PARTS],
    "alone": [guided_with("with none of its parts", ()), *map(alone, PARTS)],
    "candidates": constants("candidates of light samples", direct_light, "CANDIDATES", [1, 3, 4], "guided"),
    "parts": [parts(number) for number in (1, 4, 8)],
    "group": [group(1, 1), group(2, 2), group(4, 4)],
    "smooth": constants("α of shared surfaces, views' angles", sharing, "SMOOTH", [0.25, 1.0, 2.0], "guided"),
    "doubt": constants("doubt in slopes", radiance_control, "DOUBT", [16.0, 256.0, 1e30], "guided"),
    "roulette": constants("first depth of Russian roulette", path_tracer, "ROULETTE_DEPTH", [2, 3, 5], "guided"),
    "axes": constants("half axes of found highlights, standard deviations", fitting, "AXES", [1.7, 3.2], "guided"),
    "depth": [guided_without("voxels by depth")],
    "proportions": [guided_without("proportions (else balls)")],
    "visibility": [guided_without("learnt visibility")],
    "field": [
        Change("σ and mixture weights", "learnt by the KL", ((loop, "LensGuide", LearntField),)),
        *(Change("found highlights", how, ((loop, "SpotGuide", guide),), "guided") for how, guide in SPOTS),
        Change("without known lamps", "", PARTS[LAMPS], "guided"),
        *(Change("found highlights, no known lamps", how, (*PARTS[LAMPS], (loop, "SpotGuide", guide)), "guided") for how, guide in SPOTS),
    ],
    "positions": [Change("record positions", "plain means", PLAIN)],
    "weights": [
        Change("mixture weights", name, ((GaussianField, "lens_weights", weights),))
        for name, weights in (("volume", by_volume), ("energy without k²", by_energy_alone), ("area k² R_b²", by_area))
    ],
}
"""By the names that `--only` takes. The values left out are the defaults; block starts allow powers of two of fits."""


def main() -> None:
    options = parse()
    check_writable(options.out / "ablations")
    changes = [change for name in options.only for change in CHANGES[name]]
    defaults = [Change("default", mode, mode=mode) for mode in sorted({change.mode for change in changes})]
    path = options.out / "ablations.json"
    kept = read_kept(path)
    scenes = [SCENES[name](*options.size) if name in SCENES else load_scene(name, Overrides(*options.size)) for name in options.scenes]
    found = {scene.name: measured(scene, [*defaults, *changes], options, path, kept) for scene in scenes}
    table = "\n".join(rows(defaults, changes, found)) + "\n"
    with replacing(options.out / "ablations.md") as temporary:
        temporary.write_text(table)
    print(table)


def parse() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scenes", nargs="*", default=list(BUILTIN), metavar="SCENE", help=f"or {', '.join(SCENES)}; default: all that are built in")
    add("--only", type=names, default=list(CHANGES), metavar="NAMES", help=f"of {','.join(CHANGES)}; default all")
    add("--size", type=size, default="160x90", metavar="WxH", help="default 160x90")
    add("--spp", type=positive, default=64, metavar="N", help="default 64")
    add("--seeds", type=positive, default=2, metavar="N", help="renders of each, default 2")
    add("--threads", type=threads, metavar="N", help="default: one per core")
    add("--cache", type=Path, metavar="DIR", help="where references are kept, default the user's cache folder")
    add("--out", type=Path, default=Path("out/ablations"), metavar="DIR", help="default out/ablations")
    return parser.parse_args()


def names(text: str) -> list[str]:
    for name in text.split(","):
        if name not in CHANGES:
            raise argparse.ArgumentTypeError(f"{name!r} is unknown; choose of {', '.join(CHANGES)}")
    return text.split(",")


def read_kept(path: Path) -> dict[str, float]:
    """MAPE by digest in an `ablations.json`; none where there is no such file. Raises BokehguideError for a damaged one."""
    if not path.exists():
        return {}
    try:
        kept = json.loads(path.read_bytes())
        if not all(isinstance(value, float) and math.isfinite(value) for value in kept.values()):
            raise ValueError("not an error")
    except OSError as error:
        raise BokehguideError(f"{path}: cannot be read ({error.strerror}); choose another folder") from error
    except (AttributeError, ValueError) as error:
        raise BokehguideError(f"{path}: is damaged or no ablations'; remove it or choose another folder") from error
    return kept


def measured(
    scene: Scene, changes: list[Change], options: argparse.Namespace, path: Path, kept: dict[str, float]
) -> list[list[float]]:
    """MAPE by change and seed, rendered unless `kept` knows it already; each is added there and written to `path`."""
    settings = RenderSettings(spp=options.spp, threads=options.threads)
    whole = replace(settings, spp=REFERENCE_SHARE * options.spp)
    reference = made_reference(scene, whole, options.out / f"{scene.name}-reference.exr", options.cache).radiance
    masks = regions(scene)
    mask = masks.get("insets", masks["frame"])
    found, tracer = [], None
    with progress(scene.name, len(changes) * options.seeds) as bar:
        for change in changes:
            found.append([])
            for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
                one = replace(settings, mode=change.mode, seed=seed)
                measurement = (options.spp, scene.insets, reference.numpy(), change.what, change.value, CODE)
                key = digest((fingerprint(scene, one), *measurement))
                if key not in kept:
                    tracer = tracer or PathTracer(scene)
                    kept[key] = errors(rendered(scene, one, change, tracer), reference, mask)["mape"]
                    with replacing(path) as temporary:
                        temporary.write_text(json.dumps(kept, indent=1) + "\n")
                found[-1].append(kept[key])
                bar.update()
    return found


def rendered(scene: Scene, settings: RenderSettings, change: Change, tracer: PathTracer) -> Tensor:
    """Radiance `[H, W, 3]` with one change made; none of them changes what the scene's tracer is made of."""
    with change.made():
        render = RenderLoop(scene, settings, tracer=tracer)
        for _ in range(settings.spp):
            render.step()
    return render.film.radiance().cpu()


def rows(defaults: list[Change], changes: list[Change], found: dict[str, list[list[float]]]) -> Iterator[str]:
    """The table in Markdown."""
    yield f"| change | to | mode | {' | '.join(found)} | all |"
    yield "| --- | --- | --- |" + " ---: |" * (len(found) + 1)
    for place, default in enumerate(defaults):
        cells = [f"{torch.tensor(scene[place]).mean():.4f}" for scene in found.values()]
        yield f"| none: MAPE | | {default.mode} | {' | '.join(cells)} | |"
    baseline = {default.mode: place for place, default in enumerate(defaults)}
    for place, change in enumerate(changes, start=len(defaults)):
        pairs = [(scene[place], scene[baseline[change.mode]]) for scene in found.values()]
        ratios = [ratio(torch.tensor(one), torch.tensor(other)) for one, other in pairs]
        overall = math.exp(sum(math.log(value) for value, _ in ratios) / len(ratios))
        cells = [f"{value:.3f} ± {'-' if error is None else f'{error:.3f}'}" for value, error in ratios]
        yield f"| {change.what} | {change.value} | {change.mode} | {' | '.join(cells)} | {overall:.3f} |"


def ratio(changed: Tensor, default: Tensor) -> tuple[float, float | None]:
    """Quotient of two means, and its standard error as if the two were independent; None for one seed."""
    value = changed.mean() / default.mean()
    if len(changed) == 1:
        return float(value), None
    relative = [one.std() / one.mean() / len(one) ** 0.5 for one in (changed, default)]
    return float(value), float(value * (relative[0].square() + relative[1].square()).sqrt())


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command goes on")
