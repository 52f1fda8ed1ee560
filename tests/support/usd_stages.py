"""USD stages in memory, and files of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from bokehguide.scene import Overrides, Scene, load_scene

SQUARE = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
PALE = (0.5, 0.5, 0.5)


def new_stage(unit: float = 1.0, up: str = "Y") -> Usd.Stage:
    """An empty stage with metres per unit and an up axis."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, up)
    return stage


def add_mesh(stage: Usd.Stage, path: str, points=SQUARE, counts=(4,), indices=None, scheme: str = "none") -> UsdGeom.Mesh:
    """A mesh, by default a square of side 2 that faces +z."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, point)) for point in points])
    mesh.CreateFaceVertexCountsAttr(list(counts))
    mesh.CreateFaceVertexIndicesAttr(list(range(len(points)) if indices is None else indices))
    mesh.CreateSubdivisionSchemeAttr(scheme)
    return mesh


def add_primvar(prim, name: str, kind, values, interpolation: str, indices=None):
    """A primvar of a gprim."""
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, interpolation)
    primvar.Set(values)
    if indices is not None:
        primvar.SetIndices(indices)
    return primvar


def saved(stage: Usd.Stage, folder: Path, name: str = "scene.usda") -> str:
    """The path of a file of the stage."""
    path = folder / name
    stage.GetRootLayer().Export(str(path))
    return str(path)


def loaded(stage: Usd.Stage, folder: Path, overrides: Overrides | None = None, name: str = "scene.usda") -> Scene:
    """The scene of a stage, read from a file."""
    return load_scene(saved(stage, folder, name), overrides or Overrides())


def corners(scene: Scene, number: int = 0) -> np.ndarray:
    """Corners of the triangles of a mesh, `[T, 3, 3]`."""
    mesh = scene.meshes[number]
    return mesh.vertices[mesh.triangles]


def facing(scene: Scene, number: int = 0) -> np.ndarray:
    """Area-weighted normals of the triangles, `[T, 3]`."""
    a, b, c = np.moveaxis(corners(scene, number).astype(np.float64), 1, 0)
    return np.cross(b - a, c - a) / 2.0


def textured(stage, mesh, folder, varname: str) -> None:
    """A material with a white texture."""
    Image.new("RGB", (2, 2), "white").save(folder / "white.png")
    material, surface, image, reader = (
        UsdShade.Material.Define(stage, "/look"),
        *(UsdShade.Shader.Define(stage, f"/look/{name}") for name in ("surface", "image", "reader")),
    )
    for shader, kind in ((surface, "UsdPreviewSurface"), (image, "UsdUVTexture"), (reader, "UsdPrimvarReader_float2")):
        shader.SetShaderId(kind)
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(varname)
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./white.png")
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(image.ConnectableAPI(), "rgb")
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def scattered(stage) -> UsdGeom.PointInstancer:
    """Four instances of two prototypes, of which the third one is invisible."""
    instancer = UsdGeom.PointInstancer.Define(stage, "/many")
    instancer.AddTranslateOp().Set(Gf.Vec3d(0, 0, 7))
    add_mesh(stage, "/many/a").AddScaleOp().Set(Gf.Vec3f(0.5, 0.5, 0.5))
    add_mesh(stage, "/many/b/part")
    instancer.CreatePrototypesRel().SetTargets(["/many/a", "/many/b"])
    instancer.CreateProtoIndicesAttr([0, 1, 0, 1])
    instancer.CreatePositionsAttr([(0, 0, 0), (10, 0, 0), (20, 0, 0), (30, 0, 0)])
    instancer.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0)] * 3 + [Gf.Quath(math.sqrt(0.5), 0, math.sqrt(0.5), 0)])
    instancer.CreateScalesAttr([(1, 1, 1), (2, 2, 2), (1, 1, 1), (1, 1, 1)])
    instancer.CreateInvisibleIdsAttr([2])
    return instancer
