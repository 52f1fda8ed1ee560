"""The text of `bokehguide info`."""

from __future__ import annotations

import math
from collections.abc import Iterable

from bokehguide.errors import printable
from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.scene.emitters import Emitters, find_emitters, lens_coverage
from bokehguide.scene.inspection import Inspection, SceneObject, inspect
from bokehguide.scene.types import Aperture, Camera, Environment, Scene, Sun

SHOWN_OBJECTS = 40


def summarize(scene: Scene, facts: Inspection | None = None) -> str:
    """The contents of a scene, its imported features and its warnings, one fact a line. facts: found here if None."""
    camera, film, emitters = scene.camera, scene.film, find_emitters(scene)
    found = facts or inspect(scene, emitters)
    rows = {
        "triangles": f"{sum(len(mesh.triangles) for mesh in scene.meshes):,}",
        "materials": _materials(scene),
        "lights": _lights(scene, emitters),
        "camera": f"at {_vector(camera.position)} towards {_vector(camera.target)}, {camera.fov:.4g}° across",
        "lens": _lens(camera),
        "aperture": _aperture(camera.aperture),
        "film": f"{film.width} × {film.height} pixels, paths of up to {film.max_depth} segments",
        "insets": "; ".join(f"{inset.x:g}, {inset.y:g}, {inset.width:g}, {inset.height:g}" for inset in scene.insets) or "none",
        "in view": _in_view(found),
        "blur": _blur(found),
        "coverage": _coverage(scene, emitters),
    }
    title = f"{scene.name}: {scene.description}" if scene.description else scene.name
    lines = [title, *(f"  {name + ':':<14}{fact}" for name, fact in rows.items())]
    lines += [f"  {'object:':<14}{_object(entry)}" for entry in found.objects[:SHOWN_OBJECTS]]
    if len(found.objects) > SHOWN_OBJECTS:
        lines.append(f"  {'':<14}… and {len(found.objects) - SHOWN_OBJECTS} more objects")
    lines += [f"  {'supported:':<14}{line}" for line in scene.supported]
    lines += [f"  {'ignored:':<14}{warning}" for warning in scene.warnings]
    lines += [f"  {'warning:':<14}{warning}" for warning in scene.likely_mistakes]
    return "\n".join(lines)


def _materials(scene: Scene) -> str:
    names = [material.name for material in scene.materials]
    shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
    counts = {
        "masked": sum(material.alpha_mode == "mask" for material in scene.materials),
        "blended": sum(material.alpha_mode == "blend" for material in scene.materials),
        "clear-coated": sum(material.clearcoat > 0.0 for material in scene.materials),
        "with a sheen": sum(any(material.sheen_color) for material in scene.materials),
        "anisotropic": sum(material.anisotropy > 0.0 for material in scene.materials),
        "diffusely transmitting": sum(material.diffuse_transmission > 0.0 for material in scene.materials),
        "iridescent": sum(material.iridescence > 0.0 for material in scene.materials),
        "dispersive": sum(material.dispersion > 0.0 for material in scene.materials),
        "absorbing": sum(math.isfinite(material.attenuation_distance) for material in scene.materials),
    }
    return "; ".join([f"{len(names)} ({shown})", *(f"{count} {name}" for name, count in counts.items() if count)])


def _lights(scene: Scene, emitters: Emitters) -> str:
    emitting = [mesh for mesh in scene.meshes if scene.materials[mesh.material].emits]
    triangles = sum(len(mesh.triangles) for mesh in emitting)
    count = int((~emitters.infinite).sum())
    near = f"{triangles:,} emissive {_plural(triangles, 'triangle')} in {count} {_plural(count, 'emitter')}"
    peaks = emitters.infinite.sum() - len(scene.suns)
    return "; ".join([near, *map(_sun, scene.suns), _environment(scene.environment, peaks)])


def _sun(sun: Sun) -> str:
    return f"sun {sun.angle:g}° across, irradiance {_vector(sun.irradiance)}, towards {_vector(sun.direction)}"


def _environment(environment: Environment | None, peaks: int) -> str:
    if environment is None:
        return "no environment"
    height, width = environment.radiance.shape[:2]
    hidden = "" if environment.visible else ", not visible to the camera"
    if (height, width) == (1, 1):
        return f"environment of colour {_vector(environment.radiance[0, 0])}{hidden}"
    return f"environment map of {width} × {height} texels with {peaks} {_plural(peaks, 'peak')}{hidden}"


def _plural(count: int, noun: str) -> str:
    return noun if count == 1 else f"{noun}s"


def _lens(camera: Camera) -> str:
    if camera.aperture_radius == 0.0:
        return f"pinhole, focused at {_focus(camera)}"
    return (
        f"radius {camera.aperture_radius:.4g} m, focused at {_focus(camera)} "
        f"(f/{camera.f_number:.2g} on a sensor {camera.sensor_width:g} mm wide)"
    )


def _focus(camera: Camera) -> str:
    return f"{camera.focus_distance:.4g} m" if camera.focus_distance < FARTHEST_FOCUS else "infinity"


def _aperture(aperture: Aperture | None) -> str:
    if aperture is None:
        return "round"
    if aperture.image is not None:
        height, width = aperture.image.shape
        facts = [f"a mask of {width} × {height} texels"]
    elif aperture.blades:
        facts = [f"{aperture.blades} blades of curvature {aperture.curvature:g}"]
    else:
        facts = ["round"]
    if aperture.rotation:
        facts.append(f"rotated by {aperture.rotation:g}°")
    if aperture.ratio != 1.0:
        facts.append(f"its width divided by {aperture.ratio:g}")
    if aperture.edge:
        facts.append(f"{'rim' if aperture.edge > 0.0 else 'centre'} brighter by {abs(aperture.edge):g}")
    if aperture.cat_eye:
        facts.append(f"cat's eyes of {aperture.cat_eye:g} radii towards the corners")
    return ", ".join(facts)


def _in_view(facts: Inspection) -> str:
    if facts.nearest is None or facts.farthest is None:
        return "no surface"
    nearest, farthest = (f"{end.depth:.4g} m ({end.object})" for end in (facts.nearest, facts.farthest))
    return f"nearest {nearest}, farthest {farthest}" + (", and background" if facts.background else "")


def _blur(facts: Inspection) -> str:
    infinity = f"{facts.coc_infinity:.3g} pixels across at infinity"
    if not facts.emitters:
        return f"{infinity}; no emitter in the frame"
    discs = (f"{each.coc:.3g} at pixel {each.pixel[0]:.0f},{each.pixel[1]:.0f}" for each in facts.emitters)
    return f"{infinity}; of the brightest emitters in the frame: {'; '.join(discs)}"


def _object(entry: SceneObject) -> str:
    materials = printable(", ".join(entry.materials))
    return f"{printable(entry.name)}: {_vector(entry.low)} to {_vector(entry.high)}, of {materials}"


def _coverage(scene: Scene, emitters: Emitters) -> str:
    share = lens_coverage(scene, emitters)
    if share is None:
        return "no emitter in the frame"
    return f"{100.0 * share:.3g} % of the lens (median, from inside its bokeh)"


def _vector(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
