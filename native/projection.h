// The projection through focus points: models/projection.py, for a vector of points at a time.

#pragma once

#include "surface.h"

namespace BOKEHGUIDE_ISA {

constexpr float FAR_OUTSIDE = 1e15f;

struct LensPoint {
    Float x, y;
};

// `project_to_lens`.
inline LensPoint project_to_lens(Vec3 point, Vec3 focus) {
    const Float gap = focus.z - point.z, k = focus.z / gap, other = point.z / gap;
    return {point.x * k - focus.x * other, point.y * k - focus.y * other};
}

inline Float or_else(Float x, Float fallback) { return x == x ? x : fallback; }
inline Float bounded(Float x, Float limit) {
    const Float upper = x > limit ? limit : x;
    return upper < -limit ? -limit : upper;
}

// `lens_density`.
inline Float lens_density(LensPoint point, Vec3 focus, Vec3 mean, Float sigma) {
    const Vec3 ray = {point.x - focus.x, point.y - focus.y, -focus.z};
    const Float distance = length(ray);
    const Vec3 omega = ray / distance, perpendicular = cross({mean.x - point.x, mean.y - point.y, mean.z}, omega);
    const Float variance = sigma * sigma, along = dot(mean - focus, omega) / distance, across = sigma / distance;
    const Float peak = (across * across + along * along) / (2.0f * PI * variance);
    return peak * exp_of_negative(-0.5f * dot(perpendicular, perpendicular) / variance) * (focus.z / distance);
}

// `log_density_gradient`.
inline Vec3 log_density_gradient(LensPoint point, Vec3 focus, Vec3 mean, Float sigma) {
    const Vec3 ray = {point.x - focus.x, point.y - focus.y, -focus.z}, omega = ray * (1.0f / length(ray));
    const Vec3 offset = {mean.x - point.x, mean.y - point.y, mean.z};
    const Float a = dot(mean - focus, omega), variance = sigma * sigma;
    return (2.0f * a / (variance + a * a) + dot(offset, omega) / variance) * omega - offset / variance;
}

}  // namespace BOKEHGUIDE_ISA
