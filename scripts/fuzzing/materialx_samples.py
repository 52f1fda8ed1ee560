"""A small MaterialX document with a kind of each thing that is read, and a stage that names it."""

from __future__ import annotations

STAGE = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World" {
    def Mesh "Wall" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 5, 2]
        point3f[] points = [(-2, -1, 0), (0, -1, 0), (0, 1, 0), (-2, 1, 0), (2, -1, 0), (2, 1, 0)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1), (2, 0), (2, 1)] ( interpolation = "vertex" )
        color3f[] primvars:tint = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1)] ( interpolation = "vertex" )
        rel material:binding = </World/Looks/wood>
        def GeomSubset "Part" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding = </World/Looks/paint>
        }
    }
    def Sphere "Ball" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
        double radius = 0.5
        rel material:binding = </World/Looks/glass>
    }
    def Scope "Looks" ( prepend references = @./look.mtlx@</MaterialX/Materials> ) {
    }
    def DistantLight "Sun" {
        float inputs:intensity = 20000
    }
}
"""

DOCUMENT = """<?xml version="1.0"?>
<materialx version="1.39" colorspace="lin_rec709" fileprefix="./" xmlns:xi="http://www.w3.org/2001/XInclude">
  <xi:include href="part.mtlx"/>
  <nodegraph name="grain">
    <input name="strength" type="float" value="0.5"/>
    <texcoord name="uv" type="vector2"><input name="index" type="integer" value="0"/></texcoord>
    <place2d name="place" type="vector2">
      <input name="texcoord" type="vector2" nodename="uv"/>
      <input name="scale" type="vector2" value="0.5, 0.25"/>
      <input name="rotate" type="float" value="30"/>
    </place2d>
    <image name="color" type="color3">
      <input name="file" type="filename" value="wood.png" colorspace="srgb_texture"/>
      <input name="texcoord" type="vector2" nodename="place"/>
      <input name="uaddressmode" type="string" value="mirror"/>
    </image>
    <tiledimage name="rough" type="float">
      <input name="file" type="filename" value="wood.png"/>
      <input name="realworldimagesize" type="vector2" value="20, 20" unit="centimeter" unittype="distance"/>
      <input name="realworldtilesize" type="vector2" value="0.1, 0.1" unit="meter" unittype="distance"/>
    </tiledimage>
    <image name="bumps" type="vector3"><input name="file" type="filename" value="wood.png"/></image>
    <normalmap name="relief" type="vector3">
      <input name="in" type="vector3" nodename="bumps"/>
      <input name="scale" type="float" value="0.7"/>
    </normalmap>
    <mix name="mixed" type="color3">
      <input name="fg" type="color3" nodename="color"/>
      <input name="bg" type="color3" value="0.2, 0.1, 0.05"/>
      <input name="mix" type="float" interfacename="strength"/>
    </mix>
    <multiply name="half" type="float">
      <input name="in1" type="float" nodename="rough"/>
      <input name="in2" type="float" value="0.5"/>
    </multiply>
    <output name="base" type="color3" nodename="mixed"/>
    <output name="roughness" type="float" nodename="half"/>
    <output name="normal" type="vector3" nodename="relief"/>
  </nodegraph>
  <standard_surface name="boards" type="surfaceshader">
    <input name="base" type="float" value="0.9"/>
    <input name="base_color" type="color3" nodegraph="grain" output="base"/>
    <input name="specular_roughness" type="float" nodegraph="grain" output="roughness"/>
    <input name="normal" type="vector3" nodegraph="grain" output="normal"/>
    <input name="specular_anisotropy" type="float" value="0.3"/>
    <input name="coat" type="float" value="0.4"/>
    <input name="coat_color" type="color3" value="0.9, 0.8, 0.7"/>
    <input name="sheen" type="float" value="0.2"/>
    <input name="thin_film_thickness" type="float" value="300"/>
    <input name="opacity" type="color3" value="0.9, 0.9, 0.9"/>
  </standard_surface>
  <surfacematerial name="wood" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="boards"/>
  </surfacematerial>
  <open_pbr_surface name="clear" type="surfaceshader">
    <input name="transmission_weight" type="float" value="0.8"/>
    <input name="transmission_color" type="color3" value="0.5, 0.9, 0.6"/>
    <input name="transmission_depth" type="float" value="0.3"/>
    <input name="transmission_dispersion_scale" type="float" value="0.5"/>
    <input name="specular_ior" type="float" value="1.45"/>
    <input name="subsurface_weight" type="float" value="0.1"/>
    <input name="emission_luminance" type="float" value="2"/>
  </open_pbr_surface>
  <surfacematerial name="glass" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="clear"/>
  </surfacematerial>
</materialx>
"""

PART = """<?xml version="1.0"?>
<materialx version="1.39">
  <geompropvalue name="tint" type="color3"><input name="geomprop" type="string" value="tint"/></geompropvalue>
  <gltf_colorimage name="picture" type="multioutput">
    <input name="file" type="filename" value="wood.png" colorspace="srgb_texture"/>
    <input name="color" type="color4" value="1, 0.9, 0.8, 1"/>
  </gltf_colorimage>
  <gltf_pbr name="coated" type="surfaceshader">
    <input name="base_color" type="color3" nodename="tint"/>
    <input name="alpha" type="float" nodename="picture" output="outa"/>
    <input name="alpha_mode" type="integer" value="1"/>
    <input name="alpha_cutoff" type="float" value="0.4"/>
    <input name="metallic" type="float" value="0.3"/>
    <input name="emissive" type="color3" value="0.5, 0.4, 0.3"/>
  </gltf_pbr>
  <surfacematerial name="paint" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="coated"/>
  </surfacematerial>
</materialx>
"""
