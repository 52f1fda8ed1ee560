"""Pictures of real models under real maps, framed by hand: the benchmark of light at surfaces.

Each picture has a large aperture, and insets on highlights, on bokeh or on matt surfaces. The models come from the samples of
Khronos, PlayCanvas, Bevy and NASA, and the maps from Poly Haven. They are not part of the project. `ASSETS` is their folder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bokehguide.scene import BUILTIN, Inset, Overrides, Scene, load_scene
from bokehguide.scene.types import Vector

ASSETS = Path(__file__).resolve().parents[2] / "shared" / "assets"
PETERS, MOON = "st_peters_square_night_1k.hdr", "narrow_moonlit_road_1k.hdr"


@dataclass(frozen=True)
class RealScene:
    """One picture. focus: focus distance in metres, or a name of the model. insets: by what they show, as fractions of the frame.

    fov: horizontal, degrees. radius: of the aperture, metres.
    """

    model: str
    map: str
    position: Vector
    target: Vector
    fov: float
    radius: float
    focus: float | str
    insets: dict[str, Inset]

    def load(self, name: str, width: int, height: int) -> Scene:
        """The scene at this size. Raises BokehguideError where the model or the map is missing."""
        focus = {"focus_on" if isinstance(self.focus, str) else "focus_distance": self.focus}
        overrides = Overrides(
            width=width,
            height=height,
            environment=str(ASSETS / "hdr" / self.map),
            camera_position=self.position,
            camera_target=self.target,
            fov=self.fov,
            aperture_radius=self.radius,
            **focus,  # type: ignore[arg-type]
        )
        scene = load_scene(str(ASSETS / "models" / self.model), overrides)
        return replace(scene, name=name, insets=tuple(self.insets.values()))


REAL_SCENES = {
    "real-chess": RealScene(
        "chess-board.glb", PETERS, (60.0, 60.0, 260.0), (10.0, 35.0, 0.0), 35.0, 12.0, 200.0,
        {"bokeh": Inset(0.78, 0.0, 0.22, 0.27), "highlights": Inset(0.28, 0.5, 0.3, 0.45), "matt": Inset(0.0, 0.6, 0.25, 0.4)},
    ),
    "real-helmet": RealScene(
        "FlightHelmet/FlightHelmet.gltf", PETERS, (0.5, 0.62, 0.8), (0.0, 0.55, 0.05), 35.0, 0.05, "Lenses_low",
        {"bokeh": Inset(0.08, 0.0, 0.28, 0.3), "highlights": Inset(0.32, 0.3, 0.35, 0.4), "matt": Inset(0.62, 0.05, 0.2, 0.5)},
    ),
    "real-clearcoat": RealScene(
        "ClearCoatTest.glb", PETERS, (6.0, 7.0, 8.0), (0.0, 2.5, 0.3), 35.0, 0.6, 9.0,
        {"highlights": Inset(0.2, 0.1, 0.45, 0.45), "matt": Inset(0.0, 0.1, 0.2, 0.6), "coats": Inset(0.66, 0.25, 0.3, 0.6)},
    ),
    "real-circuit": RealScene(
        "DepthOfFieldExample.glb", "night.exr", (-3.5, 1.6, 4.5), (-0.2, 0.4, 0.5), 40.0, 0.22, 4.0,
        {"bokeh": Inset(0.58, 0.0, 0.42, 0.18), "highlights": Inset(0.4, 0.4, 0.45, 0.45), "matt": Inset(0.08, 0.45, 0.3, 0.5)},
    ),
    "real-sunglasses": RealScene(
        "SunglassesKhronos.glb", PETERS, (0.09, 0.055, 0.13), (0.02, 0.035, -0.01), 40.0, 0.007, 0.14,
        {"bokeh": Inset(0.0, 0.0, 0.4, 0.15), "highlights": Inset(0.72, 0.2, 0.28, 0.55), "frame": Inset(0.22, 0.2, 0.15, 0.6)},
    ),
    "real-shaderball": RealScene(
        "usd-shaderball.glb", PETERS, (9.0, 7.0, 11.0), (0.0, 4.0, 0.0), 40.0, 0.8, 11.0,
        {"matt": Inset(0.3, 0.5, 0.4, 0.4), "panel": Inset(0.3, 0.05, 0.4, 0.4)},
    ),
    "real-neon": RealScene(
        "love.glb", MOON, (1.1, 0.8, 1.3), (0.0, 0.45, 0.35), 40.0, 0.08, 1.3,
        {"bokeh": Inset(0.5, 0.3, 0.4, 0.5), "background": Inset(0.0, 0.0, 0.25, 0.6)},
    ),
    "real-truck": RealScene(
        "CesiumMilkTruck.glb", MOON, (3.8, 1.8, 3.6), (1.2, 1.3, 0.3), 45.0, 0.2, 3.5,
        {"matt": Inset(0.1, 0.45, 0.3, 0.5), "highlights": Inset(0.65, 0.55, 0.3, 0.35), "bokeh": Inset(0.85, 0.0, 0.15, 0.5)},
    ),
    "real-bridge": RealScene(
        "japanese-bridge-garden.glb", "potsdamer_platz_1k.hdr", (6.0, 4.0, 10.0), (0.0, 2.2, 0.0), 40.0, 0.45, 9.0,
        {"bokeh": Inset(0.28, 0.05, 0.3, 0.3), "highlights": Inset(0.1, 0.55, 0.4, 0.4), "matt": Inset(0.45, 0.35, 0.4, 0.35)},
    ),
    "real-rotor": RealScene(
        "Ingenuity.glb", "studio.exr", (0.75, 0.5, 0.85), (0.0, 0.25, 0.0), 40.0, 0.05, 0.8,
        {"bokeh": Inset(0.05, 0.2, 0.35, 0.5), "highlights": Inset(0.32, 0.35, 0.35, 0.5), "matt": Inset(0.65, 0.5, 0.3, 0.4)},
    ),
}  # fmt: skip
"""The pictures by name. `potsdamer_platz` has no peak, so that `real-bridge` shows what guiding costs where it gains little."""


def load_any(name: str, width: int, height: int) -> Scene:
    """The picture of this name at this size, or the scene that `load_scene` knows by this name."""
    if name in REAL_SCENES:
        return REAL_SCENES[name].load(name, width, height)
    return load_scene(name, Overrides(width=width, height=height))


SCENE_NAMES = (*BUILTIN, *REAL_SCENES)
