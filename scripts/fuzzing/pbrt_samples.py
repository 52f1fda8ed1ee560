"""A small sound scene of pbrt-v4 with a kind of each thing that is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR

SCENE = """# a comment
Option "seed" 1
Scale -1 1 1
LookAt 0 0 4  0 0 0  0 1 0
Camera "perspective" "float fov" [40] "float lensradius" 0.05 "float focaldistance" 3
Film "rgb" "integer xresolution" [16] "integer yresolution" [9] "float iso" 200
Sampler "halton" "integer pixelsamples" 4
Integrator "volpath" "integer maxdepth" 3
ColorSpace "rec2020"
WorldBegin
Texture "wood" "spectrum" "imagemap" "string filename" "wood.png" "float uscale" 2 "string wrap" "clamp"
Texture "rough" "float" "imagemap" "string filename" "wood.png" "string encoding" "linear" "bool invert" true
Texture "dark" "spectrum" "scale" "texture tex" "wood" "float scale" 0.5
Texture "checks" "spectrum" "checkerboard" "float uscale" 4 "rgb tex1" [0.9 0.1 0.1] "rgb tex2" [0.1 0.1 0.9]
Texture "both" "spectrum" "mix" "texture tex1" "dark" "texture tex2" "wood" "float amount" 0.3
MakeNamedMaterial "gold" "string type" "conductor" "spectrum eta" "metal-Au-eta" "spectrum k" "metal-Au-k" "float roughness" 0.1
MakeNamedMaterial "glass" "string type" "dielectric" "spectrum eta" "glass-BK7"
MakeNamedMaterial "mixed" "string type" "mix" "string materials" ["gold" "glass"] "float amount" 0.4
MakeNamedMaterial "own" "string type" "conductor" "spectrum eta" [400 1.5 700 1.2] "spectrum k" [400 3 700 4]
LightSource "infinite" "string filename" "sky.exr" "float scale" 0.5
LightSource "point" "blackbody I" 3000 "point3 from" [0 2 0] "float power" 3
LightSource "spot" "spectrum I" [400 1 500 2 600 3] "point3 from" [0 2 0] "float coneangle" 40
LightSource "distant" "rgb L" [1 1 1] "point3 from" [1 2 3] "float illuminance" 2
Attribute "shape" "float alpha" 0.9
AttributeBegin
  Material "coateddiffuse" "texture reflectance" "both" "texture roughness" "rough" "string normalmap" "wood.png"
  Shape "plymesh" "string filename" "square.ply"
AttributeEnd
AttributeBegin
  AreaLightSource "diffuse" "rgb L" [9 8 7] "bool twosided" true
  Translate 0 0 -2 ReverseOrientation
  Shape "bilinearmesh" "point3 P" [0 0 0 1 0 0 0 1 0 1 1 0] "integer indices" [0 1 2 3]
AttributeEnd
ObjectBegin "balls"
  NamedMaterial "mixed"
  Shape "sphere" "float radius" 0.3 "float zmax" 0.2
  NamedMaterial "own"
  Shape "cylinder" "float radius" 0.1 "float phimax" 200
ObjectEnd
AttributeBegin
  ConcatTransform [1 0 0 0 0 1 0 0 0 0 1 0 1 0 0 1] CoordinateSystem "here" Rotate 20 0 1 0
  ObjectInstance "balls"
  Identity CoordSysTransform "here" Scale 0.5 -0.5 0.5
  ObjectInstance "balls"
AttributeEnd
Include "part.pbrt"
"""
PART = """Material "diffuse" "texture reflectance" "checks"
Shape "trianglemesh" "point3 P" [-3 -1 -3 3 -1 -3 3 -1 3 -3 -1 3] "integer indices" [0 2 1 0 3 2] "point2 uv" [0 0 1 0 1 1 0 1]
Shape "loopsubdiv" "integer levels" 1 "point3 P" [0 0 0 1 0 0 0 1 0 0 0 1] "integer indices" [0 2 1 0 1 3 0 3 2 1 2 3]
Material "diffusetransmission" "float scale" 0.8
Shape "disk" "float radius" 0.4 "texture alpha" "rough"
"""
REALISTIC = SCENE.replace('"perspective"', '"realistic" "string lensfile" "lens.dat" "float aperturediameter" 9')
REALISTIC = REALISTIC.replace("sky.exr", "sky.pfm")
PFM = b"PF\n4 4\n-1.0\n" + np.full(48, 0.5, "<f4").tobytes()
LENS = b"# radius thickness eta diameter\n50 2 1.5 30\n-50 5 1 30\n0 50 0 30\n"


def octahedral_sky(folder: Path) -> bytes:
    """An octahedral map of 4 × 4 texels as an EXR file."""
    path = folder / "octahedral.exr"
    planes = {name: np.full((4, 4), 0.5, np.float32) for name in "RGB"}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(path))
    return path.read_bytes()
