// Rays as component arrays `[3, N]`, traced by Embree.

#pragma once

#include "embree.h"
#include "simd.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::embree;
using bokehguide::HitsOf;
using bokehguide::RayHitsOf;
using bokehguide::RaysOf;

constexpr float FAR = 1e37f;
constexpr int PACKET = 8;

struct RayRows {
    const float *origin[3], *direction[3], *limit;  // limit: null for none

    RayRows(const float* from, const float* towards, int64_t stride, const float* within) : limit(within) {
        for (int axis = 0; axis < 3; ++axis) origin[axis] = from + axis * stride, direction[axis] = towards + axis * stride;
    }
};
struct HitRows {
    int32_t* triangle;
    float *distance, *u, *v;
};

inline void set_ray(RaysOf<1>& ray, const RayRows& rays, int64_t number) {
    for (int axis = 0; axis < 3; ++axis) {
        ray.origin[axis][0] = rays.origin[axis][number], ray.direction[axis][0] = rays.direction[axis][number];
    }
    ray.near[0] = ray.time[0] = 0.0f;
    ray.far[0] = rays.limit ? rays.limit[number] : FAR;
    ray.mask[0] = ~0u, ray.id[0] = ray.flags[0] = 0;
}

inline void nearest(void* scene, const RayRows& rays, const HitRows& hits, int64_t count) {
    RayHitsOf<1> query;
    for (int64_t number = 0; number < count; ++number) {
        set_ray(query.ray, rays, number);
        query.hit.geometry[0] = query.hit.instance[0] = query.hit.instance_primitive[0] = bokehguide::INVALID;
        embree.intersect1(scene, &query, nullptr);
        const bool found = query.hit.geometry[0] != bokehguide::INVALID;
        hits.triangle[number] = found ? int32_t(query.hit.triangle[0]) : -1;
        hits.distance[number] = query.ray.far[0];
        hits.u[number] = found ? query.hit.u[0] : 0.0f;
        hits.v[number] = found ? query.hit.v[0] : 0.0f;
    }
}

inline void visible(void* scene, const RayRows& rays, float* visible, int64_t count) {
    RaysOf<1> ray;
    for (int64_t number = 0; number < count; ++number) {
        set_ray(ray, rays, number);
        embree.occluded1(scene, &ray, nullptr);
        visible[number] = ray.far[0] < 0.0f ? 0.0f : 1.0f;
    }
}

// As `visible`, for rays of which neighbours have much of their way in common; rows have entries for whole packets. What happens to
// a ray does not depend on the others of its packet.
inline void visible_coherent(void* scene, const RayRows& rays, float* visible, int64_t count) {
    RaysOf<PACKET> packet{};
    for (unsigned& mask : packet.mask) mask = ~0u;
    bokehguide::OccludedArguments coherent;
    for (int64_t first = 0; first < count; first += PACKET) {
        alignas(32) int valid[PACKET];
        for (int lane = 0; lane < PACKET; ++lane) valid[lane] = first + lane < count ? -1 : 0;
        for (int axis = 0; axis < 3; ++axis) {
            std::memcpy(packet.origin[axis], rays.origin[axis] + first, sizeof packet.far);
            std::memcpy(packet.direction[axis], rays.direction[axis] + first, sizeof packet.far);
        }
        std::memcpy(packet.far, rays.limit + first, sizeof packet.far);
        embree.occluded8(valid, scene, &packet, &coherent);
        for (int lane = 0; lane < PACKET; ++lane) visible[first + lane] = packet.far[lane] < 0.0f ? 0.0f : 1.0f;
    }
}

}  // namespace BOKEHGUIDE_ISA
