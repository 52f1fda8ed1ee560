"""The integrator `guided_thinlens`: a nested integrator of Mitsuba behind a lens that this package samples."""

from __future__ import annotations

from contextlib import nullcontext

import drjit as dr
import mitsuba as mi

from bokehguide.errors import BokehguideError
from bokehguide.mitsuba.frame import first_number
from bokehguide.mitsuba.lens import MODES
from bokehguide.mitsuba.rendering import Rendering
from bokehguide.mitsuba.variants import is_scalar


def integrator_class() -> type:
    """The integrator for the current variant of Mitsuba, to which its base class belongs."""

    class GuidedThinLens(mi.SamplingIntegrator):
        """Renders with a nested integrator, and draws the lens points in a mode of bokehguide.

        Properties: `mode`, one of MODES, "guided" by default; and one nested integrator that samples rays, such as `path`,
        `volpath` or `aov`. The sensor must be a `thinlens`. The picture of a seed depends neither on threads nor on time.
        Every channel, alpha and AOVs included, is the mean of samples times their weights, which is an unbiased estimate.
        """

        def __init__(self, props: mi.Properties):
            super().__init__(props)
            self._mode = str(props.get("mode", "guided"))
            if self._mode not in MODES:
                raise BokehguideError(f"guided_thinlens: mode: {self._mode!r} is none of {', '.join(MODES)}; give one of them")
            objects = [props[name] for name in props.keys() if props.type(name) == mi.Properties.Type.Object]  # noqa: SIM118
            if len(objects) != 1 or not isinstance(objects[0], mi.SamplingIntegrator):
                raise BokehguideError("guided_thinlens: give one nested integrator that samples rays, such as path")
            self._nested = objects[0]

        def aov_names(self) -> list[str]:
            """The channels of the nested integrator."""
            return self._nested.aov_names()

        def to_string(self) -> str:
            nested = str(self._nested).replace("\n", "\n  ")
            return f"GuidedThinLens[\n  mode = {self._mode},\n  nested = {nested}\n]"

        def sample(self, scene, sampler, ray, medium=None, active=True):
            """The nested integrator's sample: the lens has no part in it."""
            return self._nested.sample(scene, sampler, ray, medium, active)

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            """The picture, as `mi.render` asks for it. Raises BokehguideError for a sensor that is no thin lens."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with nullcontext() if is_scalar() else dr.suspend_grad():
                return Rendering(self._nested, self._mode, scene, sensor, int(first_number(seed))).picture(spp, develop)

    return GuidedThinLens
