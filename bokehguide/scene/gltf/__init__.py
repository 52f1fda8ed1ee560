"""glTF 2.0 files (`.gltf`, `.glb`) as models."""

from bokehguide.scene.gltf.loading import load_gltf

__all__ = ["load_gltf"]
