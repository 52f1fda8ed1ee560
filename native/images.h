// Virtual images in mirrors and glass: the ray transfer of guiding/virtual_images.py, for a vector of paths at a time.

#pragma once

#include "lights.h"

namespace BOKEHGUIDE_ISA {

constexpr float NARROW = 4.0f, LEAST_SHARE = 0.5f, GRAZING = 0.02f;

// `propagate_abcd`.
struct RayTransfer {
    Float a, b, c, d, index;

    RayTransfer after(Float distance) const {
        const Float reduced = distance / index;
        return {a + reduced * c, b + reduced * d, c, d, index};
    }
};

// `_image`: distances of the images of points at a distance beyond the last vertex.
inline Float image_distance(const RayTransfer& at, Float distance) {
    const RayTransfer there = at.after(distance);
    const Float place = there.b / (there.a == all(0.0f) ? all(1e-37f) : there.a);
    return place > all(0.0f) ? at_most(place, MISS_DISTANCE) : all(MISS_DISTANCE);
}

struct Corners {
    Vec3 position[3], normal[3];

    Corners(const Tables& t, Int triangle) {
        const RowFields<4> field = triangle_fields(t, triangle);
        for (int corner = 0; corner < 3; ++corner) {
            const Int vertex = 3 * gather(t.corners + corner, 3 * triangle);
            position[corner] = {gather(t.vertices, vertex), gather(t.vertices + 1, vertex), gather(t.vertices + 2, vertex)};
            normal[corner] = {field(3 + 3 * corner), field(4 + 3 * corner), field(5 + 3 * corner)};
        }
        normal[1] = normal[0] + normal[1], normal[2] = normal[0] + normal[2];
    }

    // `_curvature`: normal curvature along unit tangents.
    Float curvature(Vec3 along) const {
        Vec3 first = position[1] - position[0], second = position[2] - position[0];
        const Float base = divisor(length(first));
        first = first / base;
        const Float skew = dot(first, second);
        second = second - skew * first;
        const Float height = divisor(length(second));
        const Float v = dot(along, second / height) / height, u = (dot(along, first) - v * skew) / base;
        return dot(along, u * (normal[1] - normal[0]) + v * (normal[2] - normal[0]));
    }
};

// `principal_curvatures`.
struct Curvatures {
    Float tangential, sagittal, cosine;
    Vec3 normal;

    Curvatures(const Corners& corners, Vec3 incoming) {
        normal = normalize((corners.normal[0] + corners.normal[1] + corners.normal[2]) / all(3.0f));
        const Float facing = dot(normal, incoming);
        const Float side = one_if(facing < all(0.0f)) - one_if(facing > all(0.0f));
        cosine = at_least(abs(facing), GRAZING);
        Vec3 across = cross(normal, incoming);
        const Float upright = one_if(dot(across, across) < all(1e-8f));
        across = normalize(across + upright * cross(normal, corners.position[1] - corners.position[0]));
        tangential = side * corners.curvature(cross(normal, across)), sagittal = side * corners.curvature(across);
    }
};

// `_propagate_through`: to surfaces at a distance, and by reflection or refraction into a direction.
inline RayTransfer propagate_through(const Tables& t, const RayTransfer& before, Float distance, Int triangle, const Surface& s,
                                     Vec3 direction) {
    const RayTransfer at = before.after(distance);
    const Corners corners(t, triangle);
    const Vec3 incoming = -s.outgoing;
    const Curvatures bend(corners, incoming);
    const Int solid = (s.thin == all(0.0f)) & (s.transmission > all(0.0f));
    const Int mirrored = dot(incoming, corners.normal[0]) * dot(direction, corners.normal[0]) < all(0.0f);
    const Float inside = s.front > all(0.0f) ? s.ior : all(1.0f), outside = s.front > all(0.0f) ? all(1.0f) : s.ior;
    const Float refracted = -0.5f * (bend.tangential + bend.sagittal) * (inside * abs(dot(bend.normal, direction)) - outside * bend.cosine);
    const Float reflected = at.index * (bend.tangential / bend.cosine + bend.sagittal * bend.cosine);
    const Float power = mirrored ? reflected : (solid ? refracted : all(0.0f));
    const Float beyond = solid & ~mirrored ? inside : at.index;
    return {at.a, at.b, at.c + power * at.a, at.d + power * at.b, beyond};
}

}  // namespace BOKEHGUIDE_ISA
