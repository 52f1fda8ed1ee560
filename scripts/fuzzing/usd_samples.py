"""Small USD files with a kind of each thing that is read."""

from __future__ import annotations

from pathlib import Path

STAGE = """#usda 1.0
(
    metersPerUnit = 0.1
    upAxis = "Z"
    timeCodesPerSecond = 24
    renderSettingsPrimPath = "/Render"
)
def RenderSettings "Render" {
    int2 resolution = (16, 9)
    rel camera = </World/Camera>
}
def Xform "World" {
    def Camera "Camera" {
        float focalLength = 50
        float horizontalAperture = 36
        float verticalAperture = 24
        float fStop = 2
        float focusDistance = 35
        double3 xformOp:translate = (0, -40, 5)
        float3 xformOp:rotateXYZ = (85, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }
    def Mesh "Wall" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
        uniform bool doubleSided = 1
        uniform token orientation = "leftHanded"
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = [4, 5]
        int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 5, 6, 2]
        point3f[] points = [(-9, 0, -9), (0, 0, -9), (0, 0, 9), (-9, 0, 9), (9, 0, -9), (2, 0, 0), (9, 0, 9)]
        normal3f[] normals = [(0, -1, 0), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, -1, 0)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1), (1, 0.5)] ( interpolation = "faceVarying" )
        int[] primvars:st:indices = [0, 1, 2, 3, 0, 1, 4, 2, 3]
        color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] ( interpolation = "uniform" )
        int[] holeIndices = []
        rel material:binding = </World/Look>
        def GeomSubset "Part" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding = </World/Glass>
        }
    }
    def Mesh "Smooth" {
        int[] faceVertexCounts = [4, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 0, 3, 4]
        point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 2, 1), (0, 2, 0), (-1, 1, 1)]
        float3 xformOp:translate.timeSamples = { 0: (0, -5, 0), 24: (3, -5, 0) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Sphere "Ball" {
        double radius = 2
    }
    def Cone "Cone" {
        double height = 3
        uniform token axis = "X"
    }
    def "Shared" ( instanceable = true
        prepend references = </World/Part> ) {
    }
    def Xform "Part" {
        def Cube "Box" {
            double size = 1
        }
    }
    def PointInstancer "Many" {
        rel prototypes = [</World/Many/A>]
        int[] protoIndices = [0, 0, 0]
        point3f[] positions = [(0, 0, 5), (3, 0, 5), (6, 0, 5)]
        quath[] orientations = [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (1, 0, 0, 0)]
        float3[] scales = [(1, 1, 1), (2, 1, 1), (1, 1, 1)]
        int64[] invisibleIds = [2]
        def Cylinder "A" {
            double radius = 0.5
        }
    }
    def SphereLight "Bulb" ( prepend apiSchemas = ["ShapingAPI"] ) {
        float inputs:radius = 0.5
        float inputs:intensity = 20
        bool inputs:enableColorTemperature = 1
        float inputs:shaping:cone:angle = 40
        double3 xformOp:translate = (0, -8, 12)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def RectLight "Panel" {
        asset inputs:texture:file = @wood.png@
        bool inputs:normalize = 1
        float inputs:intensity = 5000
    }
    def DistantLight "Sun" {
        float inputs:intensity = 20000
    }
    def DomeLight_1 "Sky" {
        asset inputs:texture:file = @sky.hdr@
        float3 xformOp:rotateXYZ = (20, 30, 0)
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
    }
    def Material "Look" {
        token outputs:surface.connect = </World/Look/Surface.outputs:surface>
        def Shader "Surface" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </World/Look/Image.outputs:rgb>
            float inputs:roughness.connect = </World/Look/Image.outputs:g>
            float inputs:opacity.connect = </World/Look/Image.outputs:a>
            normal3f inputs:normal.connect = </World/Look/Image.outputs:rgb>
            float inputs:clearcoat = 0.5
            token outputs:surface
        }
        def Shader "Image" {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @wood.png@
            float4 inputs:scale = (0.5, 0.5, 0.5, 1)
            float2 inputs:st.connect = </World/Look/Move.outputs:result>
            token inputs:wrapS = "mirror"
            float3 outputs:rgb
            float outputs:g
            float outputs:a
        }
        def Shader "Move" {
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </World/Look/Reader.outputs:result>
            float inputs:rotation = 30
            float2 outputs:result
        }
        def Shader "Reader" {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
    }
    def Material "Glass" {
        token outputs:surface.connect = </World/Glass/Surface.outputs:surface>
        def Shader "Surface" {
            uniform token info:id = "UsdPreviewSurface"
            int inputs:useSpecularWorkflow = 1
            color3f inputs:specularColor = (0.1, 0.2, 0.3)
            color3f inputs:emissiveColor = (1, 2, 3)
            float inputs:opacity = 0.2
            token outputs:surface
        }
    }
}
"""


def usdc(folder: Path) -> bytes:
    """The stage in binary form."""
    from pxr import Sdf

    (folder / "stage.usda").write_text(STAGE)
    Sdf.Layer.FindOrOpen(str(folder / "stage.usda")).Export(str(folder / "stage.usdc"))
    return (folder / "stage.usdc").read_bytes()


def usdz(folder: Path, images: dict[str, bytes]) -> bytes:
    """The stage and its images in one file."""
    from pxr import Sdf

    usdc(folder)
    for name, data in images.items():
        (folder / name).write_bytes(data)
    with Sdf.ZipFileWriter.CreateNew(str(folder / "stage.usdz")) as package:
        for name in ("stage.usdc", *images):
            package.AddFile(str(folder / name), name)
    return (folder / "stage.usdz").read_bytes()
