"""The scene's emitters as proposals: the initial field of the mode `guided`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bokehguide.color import LUMINANCE
from bokehguide.guiding.config import GuidedConfig
from bokehguide.models.ellipse_mixture import EmitterShapes, balls, outline_areas, packed
from bokehguide.models.emitters.environment import EnvironmentEmitters
from bokehguide.models.emitters.parallelogram import ParallelogramEmitters
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.emitter_parts import emptiness
from bokehguide.scene.emitters import Emitters
from bokehguide.scene.types import Scene

INFINITY = 1e5
"""Distance of emitters at infinity, in focus distances."""
MAX_EMPTINESS = 16.0
"""Largest ratio of outline area to visible area. An emitter with a larger ratio is no proposal; the record may find it."""
FILLED, MAX_OUTLINE = 1.75, 0.5
"""Ratio of areas up to which an emitter fills its outline. Outlines of other emitters cover at most this part of the lens."""
MAX_DISC = 3.0
"""Largest radius of an emitter's projection on the lens, in lens radii. With a larger radius, most draws would miss the lens."""


@dataclass
class EmitterProposals:
    """L emitters that the lens can see out of focus, camera frame.

    field: enclosing balls of the emitters. Energies are luminance times the area of the outline over π, or the flux over π of
    emitters of the map. outlines: `packed` squared half axes, `[6, L]`. shapes: parallelograms and emitters of
    the map among the emitters. triangles: whether the proposals cover the light that a triangle of the scene sends directly into
    the lens, bool `[T + 1]`; the last entry is for a miss. whole_environment: whether the proposals cover all visible emitters of
    the environment.
    """

    field: GaussianField
    outlines: Tensor
    shapes: EmitterShapes
    triangles: Tensor
    whole_environment: bool


def no_proposals(scene: Scene, device: torch.device) -> EmitterProposals:
    """No emitter is known before the first ray."""
    none, count = torch.zeros(0, dtype=torch.int64, device=device), sum(len(mesh.triangles) for mesh in scene.meshes)
    shapes = EmitterShapes(None, none, None, none, torch.zeros(0, device=device))
    triangles = torch.zeros(count + 1, dtype=torch.bool, device=device)
    return EmitterProposals(GaussianField().to(device), torch.zeros(6, 0, device=device), shapes, triangles, False)


def emitter_proposals(scene: Scene, emitters: Emitters, camera: ThinLensCamera, config: GuidedConfig) -> EmitterProposals:
    """The `emitters` of a scene that a camera sees out of focus."""
    device = camera.position.device
    if not config.known_emitters:
        return no_proposals(scene, device)
    size_scale = config.emitter_scale
    arrays = (emitters.centres.T, emitters.bounding_radii, emitters.luminance, emitters.ellipsoids)
    centre, reach, bright, outline = (torch.from_numpy(x).float() for x in arrays)
    infinite, axes = torch.from_numpy(emitters.infinite), camera.axes.cpu()
    scale = torch.where(infinite, INFINITY * camera.lens.focus_distance, 1.0)
    world = centre - torch.where(infinite, 0.0, camera.position.cpu())
    mean, radius = (axes.T @ world) * scale, size_scale * reach * scale
    # The extent of a cone is the tangent of its angle. The radius of a ball inside the cone is the sine.
    cones = balls(radius / (1.0 + reach.square()).sqrt())
    outline = torch.where(infinite, cones, _ellipsoids(axes.T @ outline @ axes, config.ellipsoids) * size_scale**2)
    energy = bright * outline_areas(outline, mean)
    empty = torch.from_numpy(emptiness(emitters.ellipsoids, emitters.radii))
    visible = scene.environment is None or scene.environment.visible
    proposed = (mean[2] > radius) & (~infinite | visible) & (empty <= MAX_EMPTINESS) & (energy > 0.0) & energy.isfinite()
    # Near the focal plane, or with a tiny lens, the projection of an emitter is far larger than the lens, and guiding has no use.
    away, lens = (mean[2] - camera.lens.focus_distance).abs(), camera.lens
    proposed &= (away > radius) & (MAX_DISC * away * lens.radius > radius * lens.focus_distance)
    # An outline as large as the lens guides only where the emitter fills its outline.
    area = empty * torch.from_numpy(emitters.radii).square() * (lens.focus_distance / away).square()
    proposed &= (empty <= FILLED) | (area <= MAX_OUTLINE * lens.radius**2)
    in_sight = infinite & _in_sight(mean, radius, camera)
    shapes = _shapes(scene, emitters, proposed, camera, config.emitter_shapes)
    mean, radius, energy, bright = mean[:, proposed], radius[proposed], energy[proposed], bright[proposed]
    # The flux of an emitter of the map: the solid angle is that of a disc across the direction, not of the cone.
    disc = torch.from_numpy(emitters.radii).float()[proposed] * INFINITY * lens.focus_distance
    of_map = shapes.environment_index.cpu() >= 0
    energy = torch.where(of_map, bright * disc.square() * mean.norm(dim=0) / mean[2], energy)
    field = GaussianField()
    field.assign(mean, radius, radius, energy)
    known = torch.from_numpy(np.append(proposed.numpy(), True)[emitters.triangle_emitters])  # -1 is the last
    whole_environment = bool(infinite.any() and proposed[in_sight].all())
    return EmitterProposals(field.to(device), outline[:, proposed].to(device), shapes, known.to(device), whole_environment)


def _in_sight(mean: Tensor, radius: Tensor, camera: ThinLensCamera) -> Tensor:
    """Whether balls `[3, L]` and `[L]` at infinity may send light into the frame, bool `[L]`."""
    steepest = (
        0.5 * math.hypot(camera.width, camera.height) * camera.pixel_slope + camera.lens.radius / camera.lens.focus_distance
    )
    return mean[:2].norm(dim=0) - radius < steepest * (mean[2] + radius)


def _shapes(scene: Scene, emitters: Emitters, proposed: Tensor, camera: ThinLensCamera, own: bool) -> EmitterShapes:
    """Parallelograms and emitters of the map among the `proposed` emitters, bool `[emitters]`.

    own: whether these emitters have exact densities; False: all are ellipsoids.
    """
    device = camera.position.device
    drawn = proposed & own
    of_map, parallelogram = torch.zeros_like(proposed), torch.from_numpy(emitters.half_edges.any(axis=(1, 2))) & drawn
    if emitters.texel_emitters is not None:
        of_map[torch.from_numpy(emitters.texel_emitters[emitters.texel_emitters >= 0])] = True
        of_map &= drawn
    environment_emitter, number = _numbered(of_map), _numbered(parallelogram)
    environment = parallelograms = None
    if bool(of_map.any()):
        assert scene.environment is not None
        texels = torch.cat((environment_emitter, torch.tensor([-1])))[
            torch.from_numpy(emitters.texel_emitters)
        ].numpy()  # -1 is the last
        luminance = np.zeros(texels.shape)
        luminance[texels >= 0] = scene.environment.radiance[texels >= 0].astype(np.float64) @ LUMINANCE
        environment = EnvironmentEmitters(luminance, texels, scene.environment.rotation, camera)
    if bool(parallelogram.any()):
        to_camera = camera.axes.T
        edges = torch.from_numpy(emitters.half_edges).float()[parallelogram].to(device)
        centre = torch.from_numpy(emitters.centres).float()[parallelogram].to(device)
        parallelograms = ParallelogramEmitters(
            to_camera @ (centre.T - camera.position), to_camera @ edges[:, 0].T, to_camera @ edges[:, 1].T
        )
    light = torch.from_numpy(emitters.luminance).float()[parallelogram].to(device)
    places = (environment_emitter[proposed].to(device), number[proposed].to(device))
    return EmitterShapes(environment, places[0], parallelograms, places[1], light)


def _ellipsoids(squared: Tensor, ellipsoids: bool) -> Tensor:
    """`packed` outlines `[6, L]` of squared half axes `[L, 3, 3]`; if not `ellipsoids`, of the enclosing balls."""
    return packed(squared) if ellipsoids else balls(torch.linalg.eigvalsh(squared)[:, -1].clamp(min=0.0).sqrt())


def _numbered(kind: Tensor) -> Tensor:
    """Consecutive numbers from 0 where `kind`, bool `[L]`, is true, and -1 elsewhere."""
    return torch.where(kind, kind.cumsum(0) - 1, -1)
