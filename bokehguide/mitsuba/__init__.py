"""Guided lens sampling in Mitsuba 3: `import bokehguide.mitsuba` registers the integrator `guided_thinlens`.

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import bokehguide.mitsuba

    integrator = mi.load_dict({"type": "guided_thinlens", "nested": {"type": "path", "max_depth": 6}})
    picture = mi.render(scene, integrator=integrator, spp=64)

The integrator is registered for the current variant, and again for each variant that is set later. Raises BokehguideError if
Mitsuba is missing or has another version.
"""

from bokehguide.mitsuba.registration import register

__all__ = ["register"]

register()
