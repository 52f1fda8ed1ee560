"""Ablations: the effect of each default of the method, one setting at a time, on every built-in scene.

    python scripts/ablations.py
    python scripts/ablations.py fairy-lights chrome --only alpha,fits --seeds 4

Each row of the table is one change (CHANGES), each column a scene. A cell is the MAPE over the insets (over the frame for a scene
without insets) divided by that of the default, both averaged over the seeds, with the standard error of the quotient (- with one
seed). The last column is the geometric mean over the scenes. Changes set fields of `GaussianConfig` or `GuidedConfig`.
`--only guided` leaves out each part of the mode `guided`, `--only alone` adds each part to none. The script writes ablations.md,
the table, and ablations.json, the MAPE of each render by a digest of its settings and of the code, into `--out`. Renders of an
earlier run are kept.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from ablation_scenes import SCENES
from torch import Tensor

import bokehguide
from bokehguide.cli.parser import Parser, positive, size, threads
from bokehguide.cli.scripts import run
from bokehguide.errors import BokehguideError
from bokehguide.evaluation import errors, fingerprint, made_reference, progress, regions
from bokehguide.guiding.config import HighlightConfig
from bokehguide.image import check_writable, write_text
from bokehguide.render.path_tracer import PathTracer
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.builtin import BUILTIN
from bokehguide.scene.digest import digest
from bokehguide.train import RenderLoop, RenderSettings

NATIVE = Path(__file__).parents[1] / "native"
SOURCES = (*sorted([*Path(bokehguide.__file__).parent.rglob("*.py"), *NATIVE.glob("*.h"), *NATIVE.glob("*.cpp")]), Path(__file__))
CODE = digest(tuple(path.read_text() for path in SOURCES))
"""Renders of other code are not kept."""
FIRST_SEED = 5_000_000
REFERENCE_SHARE = 32
"""SPP of a reference for one of a render's."""


@dataclass(frozen=True)
class Change:
    """A change of settings: its subject and value in the table, the mode that shows it, and the fields of that mode's config."""

    what: str
    value: str = ""
    mode: str = "lis-o"
    fields: Mapping[str, object] = field(default_factory=dict)

    def settings(self, settings: RenderSettings) -> RenderSettings:
        """The settings with the change, in its mode."""
        owner = "guided" if self.mode == "guided" else "gaussian"
        return replace(settings, mode=self.mode, **{owner: replace(getattr(settings, owner), **self.fields)})


def values_of(what: str, name: str, values: Sequence[float], mode: str = "lis-o") -> list[Change]:
    """One change for each value of a field."""
    return [Change(what, f"{value:g}", mode, {name: value}) for value in values]


def highlights(what: str, name: str, values: Sequence[float]) -> list[Change]:
    """One change for each value of a field of `HighlightConfig`, in `lis-o`."""
    return [Change(what, f"{value:g}", "lis-o", {"highlights": HighlightConfig(**{name: value})}) for value in values]


PARTS: dict[str, dict[str, object]] = {
    "known emitters": {"known_emitters": False},
    "found highlights": {"find_highlights": False},
    "voxels by depth": {"depth_layers": False},
    "virtual images": {"virtual_images": False},
    "shapes of emitters": {"emitter_shapes": False},
    "ellipsoids (else balls)": {"ellipsoids": False},
    "clipping to the lens": {"clip_to_lens": False},
    "success rates": {"learn_success_rates": False},
    "learned β (else 0.65)": {"min_blend": 0.65, "max_blend": 0.65},
    "pooled β": {"blend_pool": 1},
    "stratified lens points": {"stratify": False},
    "split paths": {"split_count": 1, "max_split_count": 1},
    "reused primary hits": {"reuse_group": 1},
    "control variate": {"control_variate": False},
    "resampled lights": {"light_candidates": 1, "bsdf_candidates": 0},
    "learned visibility": {"learn_visibility": False},
    "learned MIS weights": {"learn_mis": False},
    "learned lights": {"learn_lights": False},
}
"""The parts of the mode `guided`, and the fields that take each part away."""
NEEDED = {
    "voxels by depth": ("found highlights",),
    "virtual images": ("found highlights",),
    "shapes of emitters": ("known emitters",),
    "ellipsoids (else balls)": ("known emitters",),
    "clipping to the lens": ("known emitters",),
    "success rates": ("known emitters",),
    "learned β (else 0.65)": ("known emitters",),
    "pooled β": ("known emitters", "learned β (else 0.65)"),
    "learned visibility": ("learned lights", "resampled lights"),
    "learned MIS weights": ("learned lights",),
    "control variate": ("reused primary hits",),
}
"""Parts that do nothing by themselves, and the parts that they are added to."""


def guided_with(what: str, kept: Sequence[str]) -> Change:
    """The mode `guided` with some of its parts."""
    fields = {name: value for part, away in PARTS.items() if part not in kept for name, value in away.items()}
    return Change(f"guided {what}", "", "guided", fields)


def guided_without(part: str) -> Change:
    return guided_with(f"without {part}", [other for other in PARTS if other != part])


def alone(part: str) -> Change:
    needed = NEEDED.get(part, ())
    return guided_with(f"with {part} alone" if not needed else f"with {part} on {' and '.join(needed)}", (part, *needed))


def group(pixels: int) -> Change:
    """The size of the groups that reuse primary hits."""
    return Change("pixels of a group", f"{pixels}", "guided", {"reuse_group": pixels})


def split(count: int) -> Change:
    """The number of paths of a sample of weight 1."""
    return Change("paths of weight 1", str(count), "guided", {"split_count": count, "max_split_count": 8 * count})


CHANGES = {
    "alpha": values_of("α of σ = α R_b", "sigma_scale", [0.25, 0.35, 0.7, 1.0]),
    "radiance": highlights("radiance threshold / frame's mean", "radiance_threshold", [2.0, 4.0, 16.0, 32.0]),
    "coc": highlights("CoC threshold, pixels", "coc_threshold", [2.0, 8.0, 16.0]),
    "gap": highlights("depth gap, cell widths", "depth_gap", [2.0, 32.0, math.inf]),
    "fits": [Change("number of fits", str(count), "lis-o", {"fits": count}) for count in (2, 4, 16, 32)],
    "degree": [Change("polynomial degree", str(degree), "lis-o", {"offset_degree": degree}) for degree in (0, 1, 3)],
    "blend-rate": values_of("learning rate of β", "blend_rate", [0.02, 0.05, 0.2, 0.5], "lis-b"),
    "offset-rate": values_of("learning rate of the offsets", "offset_rate", [0.001, 0.003, 0.03, 0.1]),
    "fixed-beta": values_of("fixed β", "blend", [0.5, 0.65, 0.9], "lis"),
    "guided": [guided_without(part) for part in PARTS],
    "alone": [guided_with("with none of its parts", ()), *map(alone, PARTS)],
    "candidates": [Change("light candidates", str(count), "guided", {"light_candidates": count}) for count in (1, 2, 7)],
    "bsdf": [Change("BSDF candidates", str(count), "guided", {"bsdf_candidates": count}) for count in (0, 2)],
    "parts": [split(count) for count in (1, 4, 8)],
    "group": [group(1), group(4), group(8), group(32)],
    "spread": values_of("α of reused surfaces by the views' angle", "min_spread", [0.05, 0.5, 1.0], "guided"),
    "shrinkage": values_of("shrinkage of the control variate", "control_shrinkage", [0.1, 64.0, 1e18], "guided"),
    "axes": values_of("half axes of found highlights, standard deviations", "highlight_axes", [1.7, 3.2], "guided"),
    "depth": [guided_without("voxels by depth")],
    "proportions": [guided_without("ellipsoids (else balls)")],
    "visibility": [guided_without("learned visibility")],
}
"""By the names that `--only` takes. Values left out are the defaults. Epochs allow powers of two of fits."""


def main() -> None:
    options = parse()
    check_writable(options.out / "ablations")
    changes = [change for name in options.only for change in CHANGES[name]]
    defaults = [Change("default", mode, mode) for mode in sorted({change.mode for change in changes})]
    path = options.out / "ablations.json"
    kept = read_kept(path)
    scenes = [
        SCENES[name](*options.size) if name in SCENES else load_scene(name, Overrides(*options.size)) for name in options.scenes
    ]
    found = {scene.name: measured(scene, [*defaults, *changes], options, path, kept) for scene in scenes}
    table = "\n".join(rows(defaults, changes, found)) + "\n"
    write_text(options.out / "ablations.md", table)
    print(table)


def parse() -> argparse.Namespace:
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add(
        "scenes",
        nargs="*",
        default=list(BUILTIN),
        metavar="SCENE",
        help=f"or {', '.join(SCENES)}; default: all that are built in",
    )
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
    with progress(scene.name, len(changes) * options.seeds, unit="render") as bar:
        for change in changes:
            found.append([])
            for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
                one = change.settings(replace(settings, seed=seed))
                measurement = (options.spp, scene.insets, reference.numpy(), CODE)
                key = digest((fingerprint(scene, one), *measurement, str(one)))
                if key not in kept:
                    tracer = tracer or PathTracer(scene)
                    kept[key] = errors(rendered(scene, one, tracer), reference, mask)["mape"]
                    write_text(path, json.dumps(kept, indent=1) + "\n")
                found[-1].append(kept[key])
                bar.update()
    return found


def rendered(scene: Scene, settings: RenderSettings, tracer: PathTracer) -> Tensor:
    """Radiance `[H, W, 3]`."""
    with RenderLoop(scene, settings, tracer=tracer) as render:
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
