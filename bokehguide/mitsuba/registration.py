"""The registration of the integrator in Mitsuba, for each of its variants."""

from __future__ import annotations

import functools

from bokehguide.errors import BokehguideError

NAME = "guided_thinlens"
VERSIONS = ((3, 9), (3, 10))
"""The first version of Mitsuba that works, and the first one whose interface of meshes differs."""


def register() -> None:
    """Register the integrator for the current variant of Mitsuba and for later ones. Raises BokehguideError as the package."""
    try:
        import mitsuba as mi
    except ImportError:
        raise BokehguideError("bokehguide.mitsuba: Mitsuba is missing; run pip install 'bokehguide[mitsuba]'") from None
    first, last = VERSIONS
    if not first <= tuple(map(int, str(mi.__version__).split(".")[:2])) < last:
        wanted = " and before ".join(".".join(map(str, version)) for version in VERSIONS)
        raise BokehguideError(f"bokehguide.mitsuba: Mitsuba {mi.__version__} is installed; install a version from {wanted}")
    if mi.variant() is not None:
        _register_variant()
    _follow_variants()


@functools.cache
def _follow_variants() -> None:
    """Let Mitsuba register the integrator whenever its variant changes."""
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda _, new: _register_variant())


def _register_variant() -> None:
    """Register the integrator for the current variant, whose classes it derives from."""
    import mitsuba as mi

    from bokehguide.mitsuba.integrator import integrator_class

    mi.register_integrator(NAME, integrator_class())
