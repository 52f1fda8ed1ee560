// Shadow rays: the transmittance of opaque and translucent surfaces (`Visibility` of render/visibility.py).

#pragma once

#include "blocks.h"
#include "surface.h"

namespace BOKEHGUIDE_ISA {

constexpr float SHORT = 1.0f / 16.0f;
constexpr uint32_t MAX_CROSSINGS = 256;

// Lanes that do not count have some triangle, so that tables can be read.
inline Hits valid(Hits hit, Int active) {
    hit.triangle = active ? hit.triangle : all(0);
    return hit;
}

// Rays of a block that go on beyond translucent surfaces: which they are, by the place of a ray in this list; `last` is the last
// surface of a ray, by its place in the block.
struct Beyond {
    IntRow ray, last, triangle;
    Row origin[3], start, limit, direction[3], distance, u, v;

    void set(int place, int of, Vec3 point, int lane, float begun, const Row* towards) {
        const float from[3] = {point.x[lane], point.y[lane], point.z[lane]};
        ray[place] = of, start[place] = begun;
        for (int axis = 0; axis < 3; ++axis) origin[axis][place] = from[axis], direction[axis][place] = towards[axis][of];
    }
    void find(void* scene, int count, const float* within) {
        nearest(scene, RayRows(origin[0], direction[0], ROW, within), {triangle, distance, u, v}, count);
    }
};

// Distances just beyond surfaces along rays, and the points there (`_beyond` of visibility.py).
inline Float just_beyond(Vec3 origin, Vec3 direction, Float distance, Int again, Vec3& start) {
    const Float step = again ? all(1.0f) : all(SHORT);
    const Float further = distance + step * leaving_distance(origin + distance * direction, distance);
    start = origin + further * direction;
    return further;
}

// A block of shadow rays, and their transmittances.
struct ShadowRays {
    Row origin[3], direction[3], length, passes;
    Beyond beyond;
    int64_t rays;
    double embree_seconds;

    void aim(int i, Vec3 from, Vec3 towards, Float distance) {
        store3(origin, i, from), store3(direction, i, towards), store(length + i, distance);
    }

    // Transmittances of the first `count` rays; adds to `rays` and `embree_seconds`. coherent: whether neighbours have much of their
    // way in common, as the rays from one hit to the lens have.
    void trace(const Tables& t, int count, bool coherent) {
        for (int i = 0; i < count; ++i) passes[i] = 1.0f;
        rays += count;
        if (t.opaque != nullptr) {
            const RayRows rows(origin[0], direction[0], ROW, length);
            in_embree([&] { coherent ? visible_coherent(t.opaque, rows, passes, count) : visible(t.opaque, rows, passes, count); });
        }
        if (t.translucent != nullptr) dim(t, count);
    }

  private:
    template <class Work> void in_embree(Work work) {
        const double begun = bokehguide::seconds();
        work();
        embree_seconds += bokehguide::seconds() - begun;
    }

    // Multiply transmittances by those of the translucent surfaces (`Visibility._dim`).
    void dim(const Tables& t, int traced) {
        Beyond& b = beyond;
        for (int i = 0; i < traced; ++i) b.ray[i] = i, b.last[i] = -1, b.start[i] = 0.0f;
        int count = keep_if(b.ray, traced, [&](int ray) { return passes[ray] > 0.0f; });
        for (int i = 0; i < count; ++i) {
            for (int axis = 0; axis < 3; ++axis) {
                b.origin[axis][i] = origin[axis][b.ray[i]], b.direction[axis][i] = direction[axis][b.ray[i]];
            }
        }
        for (uint32_t crossing = 0; crossing < MAX_CROSSINGS && count > 0; ++crossing) {
            for (int i = 0; i < count; ++i) b.limit[i] = length[b.ray[i]] - b.start[i];
            rays += count;
            in_embree([&] { b.find(t.translucent, count, b.limit); });
            count = dim_once(t, count);
        }
        for (int i = 0; i < count; ++i) passes[b.ray[i]] = 0.0f;
    }

    // One translucent surface along each of `count` rays; returns the number of rays that go on.
    int dim_once(const Tables& t, int count) {
        Beyond& b = beyond;
        int met = 0;
        for (int i = 0; i < count; ++i) {  // rays that met a surface, in place
            if (b.triangle[i] < 0) continue;
            b.ray[met] = b.ray[i], b.triangle[met] = int32_t(t.translucent_numbers[b.triangle[i]]);
            b.distance[met] = b.distance[i] + b.start[i], b.u[met] = b.u[i], b.v[met++] = b.v[i];
        }
        for (int i = met; i < (met + LANES - 1) / LANES * LANES; ++i) b.ray[i] = b.triangle[i] = 0;
        int going = 0;
        for (int i = 0; i < met; i += LANES) {
            const Int active = first_lanes(met - i), ray = load<Int>(b.ray + i), triangle = load<Int>(b.triangle + i);
            const Float distance = load<Float>(b.distance + i);
            const Hits hit = {triangle, distance, load<Float>(b.u + i), load<Float>(b.v + i)};
            const Int again = triangle == gather(b.last, ray);
            const Float left = again ? all(1.0f) : 1.0f - opacity(t, hit, active);
            Vec3 start;
            const Float further = just_beyond(gather3(origin, ray), gather3(direction, ray), distance, again, start);
            for (int lane = 0; lane < LANES && i + lane < met; ++lane) {
                passes[ray[lane]] *= left[lane];
                if (!(passes[ray[lane]] > 0.0f && further[lane] < length[ray[lane]])) continue;
                b.last[ray[lane]] = triangle[lane];
                b.set(going++, ray[lane], start, lane, further[lane], direction);
            }
        }
        return going;
    }
};

}  // namespace BOKEHGUIDE_ISA
