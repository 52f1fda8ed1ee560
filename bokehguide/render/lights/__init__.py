"""Emitters of a scene as a path tracer samples them: triangles, environment maps and distant lights."""
