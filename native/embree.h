// The few parts of Embree 4's C interface that bokehguide calls, on the library that embreex brings.
//
// Sizes and orders of the fields are those of Embree 4.4's rtcore_ray.h. The library is loaded at run time, so that the extension
// needs neither headers nor a link.

#pragma once

#include <cstddef>
#include <cstdint>

namespace bokehguide {

constexpr unsigned INVALID = 0xFFFFFFFFu;

template <int N> struct alignas(N == 1 ? 16 : 4 * N) RaysOf {
    float origin[3][N], near[N], direction[3][N], time[N], far[N];
    unsigned mask[N], id[N], flags[N];
};

template <int N> struct alignas(N == 1 ? 16 : 4 * N) HitsOf {
    float normal[3][N], u[N], v[N];
    unsigned triangle[N], geometry[N], instance[N], instance_primitive[N];
};

template <int N> struct alignas(N == 1 ? 16 : 4 * N) RayHitsOf {
    RaysOf<N> ray;
    HitsOf<N> hit;
};

// Arguments of a query for packets of rays that have much of their way in common.
struct OccludedArguments {
    unsigned flags = 1u << 16, features = ~0u;  // coherent, all features
    void *context = nullptr, *filter = nullptr, *occluded = nullptr;
};

struct Embree {
    void* (*new_device)(const char*);
    long (*device_property)(void*, int);
    void* (*new_scene)(void*);
    void (*set_scene_flags)(void*, int);
    void* (*new_geometry)(void*, int);
    void* (*new_buffer)(void*, int, unsigned, int, size_t, size_t);
    void (*commit_geometry)(void*);
    unsigned (*attach_geometry)(void*, void*);
    void (*release_geometry)(void*);
    void (*commit_scene)(void*);
    void (*release_scene)(void*);
    void (*intersect1)(void*, RayHitsOf<1>*, void*);
    void (*occluded1)(void*, RaysOf<1>*, void*);
    void (*occluded8)(const int*, void*, RaysOf<8>*, OccludedArguments*);
};

extern Embree embree;

static_assert(sizeof(RaysOf<8>) == 384, "as in rtcore_ray.h");
static_assert(sizeof(RaysOf<1>) == 48 && sizeof(RayHitsOf<1>) == 96, "as in rtcore_ray.h");

}  // namespace bokehguide
