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

inline int set_rays(RaysOf<8>& packet, int (&valid)[8], const RayRows& rays, int64_t first, int64_t count) {
    const int active = count - first < LANES ? int(count - first) : LANES;
    for (int lane = 0; lane < LANES; ++lane) {
        const int64_t number = first + (lane < active ? lane : 0);
        valid[lane] = lane < active ? -1 : 0;
        for (int axis = 0; axis < 3; ++axis) {
            packet.origin[axis][lane] = rays.origin[axis][number], packet.direction[axis][lane] = rays.direction[axis][number];
        }
        packet.near[lane] = packet.time[lane] = 0.0f;
        packet.far[lane] = rays.limit ? rays.limit[number] : FAR;
        packet.mask[lane] = ~0u, packet.id[lane] = packet.flags[lane] = 0;
    }
    return active;
}

inline void nearest_by_packets(void* scene, const RayRows& rays, const HitRows& hits, int64_t count,
                               bokehguide::QueryArguments* arguments = nullptr) {
    RayHitsOf<8> query;
    alignas(32) int valid[8];
    for (int64_t first = 0; first < count; first += LANES) {
        const int active = set_rays(query.ray, valid, rays, first, count);
        for (int lane = 0; lane < LANES; ++lane) {
            query.hit.geometry[lane] = query.hit.instance[lane] = query.hit.instance_primitive[lane] = bokehguide::INVALID;
        }
        embree.intersect8(valid, scene, &query, arguments);
        for (int lane = 0; lane < active; ++lane) {
            const bool found = query.hit.geometry[lane] != bokehguide::INVALID;
            hits.triangle[first + lane] = found ? int32_t(query.hit.triangle[lane]) : -1;
            hits.distance[first + lane] = query.ray.far[lane];
            hits.u[first + lane] = found ? query.hit.u[lane] : 0.0f;
            hits.v[first + lane] = found ? query.hit.v[lane] : 0.0f;
        }
    }
}

inline void visible_by_packets(void* scene, const RayRows& rays, float* visible, int64_t count,
                               bokehguide::QueryArguments* arguments = nullptr) {
    RaysOf<8> packet;
    alignas(32) int valid[8];
    for (int64_t first = 0; first < count; first += LANES) {
        const int active = set_rays(packet, valid, rays, first, count);
        embree.occluded8(valid, scene, &packet, arguments);
        for (int lane = 0; lane < active; ++lane) visible[first + lane] = packet.far[lane] < 0.0f ? 0.0f : 1.0f;
    }
}

}  // namespace BOKEHGUIDE_ISA
