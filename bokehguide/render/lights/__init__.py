"""Light sampling: emissive triangles, environment maps and distant lights of a scene."""
