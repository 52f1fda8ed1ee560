"""The figures and tables that `results.py` renders: a script, its options by setting, and the text of its page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass

from bokehguide.scene import BUILTIN

SETTINGS = ("full", "reduced", "smoke")
BUILTIN_SCENES = " ".join(BUILTIN)


@dataclass(frozen=True)
class Item:
    """One figure or table: a script of `scripts/` and its options by setting.

    A setting without options leaves the item out. pictures: glob of the PNG files of the work folder that the page shows;
    output: the option that takes the work folder, if there is one; cache: whether the script keeps references in `--cache`;
    peer: whether it needs Mitsuba; verdict: whether exit code 1 reports a failed statistical test, which the table shows.
    """

    name: str
    title: str
    text: str
    script: str
    full: str | None = None
    reduced: str | None = None
    smoke: str | None = None
    pictures: str = ""
    output: bool = True
    cache: bool = True
    peer: bool = False
    verdict: bool = False

    @property
    def page(self) -> str:
        return f"{'figures' if self.name.startswith('fig') else 'tables'}-{self.name}.md"

    def options(self, setting: str) -> list[str] | None:
        text = getattr(self, setting)
        return None if text is None else shlex.split(text)


FIGURE = {
    "full": "--size 320x180 --spp 64",
    "reduced": "--size 160x90 --spp 16",
    "smoke": "--size 16x9 --spp 2",
}
ABLATION = {
    "full": "--size 160x90 --spp 64 --seeds 2",
    "reduced": "fairy-lights chrome --size 96x54 --spp 16 --seeds 2",
}


def figure(number: str, title: str, text: str, smoke_scene: str | None) -> Item:
    """A figure of the paper; without a scene for the setting `smoke` it is left out there."""
    options = FIGURE | {"smoke": smoke_scene and f"{smoke_scene} {FIGURE['smoke']}"}
    name = f"fig{number}"
    pictures = "fig[89].png" if number == "8_9" else f"{name}.png"
    return Item(name, title, text, f"figures/{name}.py", **options, pictures=pictures)


def ablation(name: str, title: str, text: str, only: str) -> Item:
    """A group of changes of `ablations.py` on the built-in scenes."""
    options = {setting: f"{words} --only {only}" for setting, words in ABLATION.items()}
    return Item(f"ablations-{name}", title, text, "ablations.py", **options)


ITEMS = (
    figure(
        "6",
        "Fig. 6: fixed and learned β",
        "Modes `lis` with a fixed β and `lis-b` with a learned β, with occluded highlights. Below the crops: the learned β.",
        "occluded",
    ),
    figure(
        "7",
        "Fig. 7: fixed and shifting Gaussians",
        "Mode `lis-b` has fixed Gaussians; in `lis-o` polynomials shift their centres by the viewpoint.",
        "chrome",
    ),
    figure(
        "8_9",
        "Fig. 8 and 9: all methods",
        "Crops at equal SPP, and MAPE over SPP and over time. Area ReSTIR has a quarter of the SPP of the other modes.",
        "occluded",
    ),
    figure(
        "10",
        "Fig. 10: densities on the lens",
        "Densities on the lens for one pixel that sees two emitters, and KL(reference || method) of 2^16 draws. "
        "Each cell has one pseudo-count; exact draws of the reference show its effect.",
        None,
    ),
    figure(
        "11",
        "Fig. 11: highlights that share cells",
        "A failure of one Gaussian per connected patch: highlights at different depths share cells of the record buffer. "
        "Mode `lis-o` splits patches by depth; `guided` knows emitters in 3D.",
        "glitter",
    ),
    figure(
        "12",
        "Fig. 12: alpha",
        "A failure of counting draws for alpha, beside two unbiased estimates: weighted draws, and the film's control variate.",
        "cutout",
    ),
    Item(
        "seeds",
        "Modes at equal SPP, with confidence intervals",
        "Errors over the insets of each scene, averaged over seeds, with 95 % intervals of their ratios. "
        "Pictures: `guided` at 8 SPP, `uniform` at 8 SPP, `uniform` at 256 SPP.",
        "experiments/seeds.py",
        full="--size 320x180 --spp 64 --seeds 8",
        reduced="--size 160x90 --spp 16 --seeds 2",
        smoke="cutout --size 32x18 --spp 2 --seeds 2",
        pictures="*-first.png",
    ),
    Item(
        "evaluation",
        "All modes at 640×360",
        "MAPE against long references in two halves. A reference's own error is about half of the MAPE between its halves.",
        "evaluate.py",
        full="--size 640x360 --spp 64,256 --reference-spp 4096 --uniform-spp 1024",
        reduced="--size 160x90 --spp 16,64 --reference-spp 256 --uniform-spp 256",
        smoke="occluded --size 32x18 --spp 2,4 --reference-spp 16 --uniform-spp 8 --modes guided",
    ),
    Item(
        "equal_time",
        "Error over time, beside Mitsuba 3",
        "Both renderers have the same cores and the same seconds, in turns, and materials that both have.",
        "equal_time.py",
        full=f"{BUILTIN_SCENES} --size 640x360 --seconds 60",
        reduced=f"{BUILTIN_SCENES} --size 320x180 --seconds 15 --reference-spp 1024",
        smoke="daylight --size 32x18 --seconds 2 --reference-spp 16",
        pictures="equal_time.png",
        peer=True,
    ),
    ablation(
        "method",
        "Defaults of the paper's method",
        "One value changes at a time: MAPE over the MAPE of the default.",
        "alpha,radiance,coc,gap,fits,degree,blend-rate,offset-rate,fixed-beta",
    ),
    ablation(
        "without",
        "Mode `guided` without each of its parts",
        "One part is left out at a time: MAPE over the MAPE of `guided`.",
        "guided",
    ),
    ablation(
        "alone",
        "Each part of `guided` alone",
        "One part is added to no other part, or to the parts that it needs: MAPE over the MAPE of `guided`.",
        "alone",
    ),
    ablation(
        "values",
        "Defaults of mode `guided`",
        "One value changes at a time: MAPE over the MAPE of the default.",
        "candidates,parts,group,axes",
    ),
    Item(
        "ablations-scenes",
        "Parts of `guided` on scenes that need them",
        "Highlights behind one another need voxels by depth; long emitters need their proportions; two rooms need visibility.",
        "ablations.py",
        full="mirror-balls neon-tubes two-rooms --only depth,proportions,visibility --size 160x90 --spp 64 --seeds 4",
        reduced="mirror-balls neon-tubes two-rooms --only depth,proportions,visibility --size 96x54 --spp 16 --seeds 2",
        smoke="two-rooms --only visibility --size 32x18 --spp 2 --seeds 1",
    ),
    Item(
        "speed",
        "Speed and memory",
        "Samples and rays per second, the guide's share of a step, and peak memory.",
        "bench.py",
        full="--size 1280x720 --spp 8",
        reduced="--size 320x180 --spp 32",
        smoke="--size 32x18 --spp 4 --warm-up 1",
        output=False,
        cache=False,
    ),
    Item(
        "speed-wide",
        "Speed with a wider lens",
        "Pixels of a wider lens have more candidates, which the guide chooses from.",
        "bench.py",
        full="--size 1280x720 --spp 8 --aperture-radius 0.068",
        reduced="--size 320x180 --spp 32 --aperture-radius 0.068",
        output=False,
        cache=False,
    ),
    Item(
        "speed-peer",
        "Speed beside Mitsuba 3",
        "Both renderers have the same cores and materials that both have.",
        "bench.py",
        full="--size 1280x720 --spp 8 --peers",
        reduced="--size 320x180 --spp 32 --peers",
        output=False,
        cache=False,
        peer=True,
    ),
    Item(
        "profile",
        "Time of a step by function",
        "Nanoseconds per ray on one thread. The last row has the time of a step without the profiler.",
        "profile_step.py",
        full="--mode guided --size 640x360",
        reduced="--mode guided --size 160x90 --spp 2",
        smoke="--mode guided --scene daylight --size 32x18 --spp 1 --warm-up 1",
        output=False,
        cache=False,
    ),
    Item(
        "scaling",
        "Growth of cost",
        "Seconds of a step and memory as pixels, triangles, emitters or SPP grow, while the other three stay.",
        "experiments/scaling.py",
        full="",
        reduced="--pixels 100000,500000 --triangles 1000,100000 --emitters 10,1000 --spp 8,16",
        pictures="scaling.png",
        cache=False,
    ),
    Item(
        "means",
        "Means of `guided` and of uniform sampling",
        "Statistical tests of pixels, blocks, insets and frame against a long uniform render.",
        "experiments/ztest.py",
        full="--modes guided --spp 64 --runs 16 --uniform-spp 65536",
        reduced="--modes guided --spp 32 --runs 16 --uniform-spp 16384 --size 96x54",
        output=False,
        verdict=True,
    ),
    Item(
        "mitsuba",
        "Means of bokehguide and of Mitsuba 3",
        "Scenes of one material or light each, and the built-in scenes, in both renderers.",
        "compare_mitsuba.py",
        full=f"materials {BUILTIN_SCENES} --modes uniform,lis-o,guided",
        reduced=f"materials {BUILTIN_SCENES} --modes uniform,lis-o,guided --spp 512 --runs 8 --mitsuba-spp 16384",
        output=False,
        peer=True,
        verdict=True,
    ),
)
