// Surfaces at hits: `Geometry` and `Materials` of render/geometry.py and render/materials.py, for eight hits at a time.

#pragma once

#include <cstddef>

#include "simd.h"
#include "tables.h"

#if defined(__F16C__)
#include <immintrin.h>
#endif

namespace BOKEHGUIDE_ISA {

using bokehguide::Slot;
using bokehguide::Tables;
using bokehguide::TriangleRow;

constexpr float MIN_ALPHA = 1e-3f, OFFSET = 1e-5f, MIN_FACING = 1e-4f, CLEARCOAT_F0 = 0.04f;

struct Hits {
    Int triangle;
    Float distance, u, v;
};

// A vector of surfaces; the fields are those of `Surface` in render/surface.py, in its order.
struct Surface {
    Vec3 position, outgoing, geometric_normal, normal;
    Float front, offset, facing;
    Vec3 base_color;
    Float metallic, alpha, specular, transmission, thin, ior;
    Vec3 specular_color;
    Float clearcoat, clearcoat_alpha;
    Vec3 clearcoat_normal;
    Vec3 sheen_color;
    Float sheen_roughness;
    Vec3 tangent;
    Float alpha_along, diffuse_transmission;
    Vec3 transmission_color;
    Float iridescence, film_ior, film_thickness, dispersion, single_scattering;
};
constexpr int SURFACE_ROWS = sizeof(Surface) / sizeof(Float);
constexpr int SHEEN_ROW = offsetof(Surface, sheen_color) / sizeof(Float);  // the first of the rare fields
static_assert(SURFACE_ROWS == 49, "as many as bokehguide/render/native_hits.py names");

// rows: of the scene (`Tables::surface_rows`); fields beyond them are undefined.
inline Surface load_surface(const float* values, int64_t stride, int rows) {
    Surface s;
    Float* fields = reinterpret_cast<Float*>(&s);
    for (int row = 0; row < rows; ++row) fields[row] = load<Float>(values + row * stride);
    return s;
}
inline void store_surface(float* values, int64_t stride, const Surface& s, int rows) {
    const Float* fields = reinterpret_cast<const Float*>(&s);
    for (int row = 0; row < rows; ++row) store(values + row * stride, fields[row]);
}

inline Vec3 gather3(const float* table, int64_t columns, Int index) {
    return {gather(table, index), gather(table + columns, index), gather(table + 2 * columns, index)};
}

inline Int material_of(const Tables& t, Int triangle) {
    return gather(&t.triangles[0].material, triangle * 16);
}
// Values of materials; materials that are the same in all lanes are read once.
struct MaterialValues {
    Int material;
    bool same;

    explicit MaterialValues(Int of) : material(of), same(!any(of != all(of[0]))) {}
    Float operator()(const float* row) const { return same ? all(row[material[0]]) : gather(row, material); }
};
inline Int emitter_of(const Tables& t, Int triangle) { return gather(&t.triangles[0].emitter, triangle * 16); }
// Value at a hit from rows `[3 C, columns]` of first corners and differences; count: C.
inline Float interpolated(const float* rows, int64_t columns, int count, int row, Int column, Float u, Float v) {
    return gather(rows + row * columns, column) + u * gather(rows + (count + row) * columns, column) +
           v * gather(rows + (2 * count + row) * columns, column);
}
inline Vec3 interpolated3(const float* rows, int64_t columns, int count, Int column, Float u, Float v) {
    return {interpolated(rows, columns, count, 0, column, u, v), interpolated(rows, columns, count, 1, column, u, v),
            interpolated(rows, columns, count, 2, column, u, v)};
}

// Fields of `TriangleRow`.
inline RowFields<4> triangle_fields(const Tables& t, Int triangle) {
    return RowFields<4>([&](int lane) { return reinterpret_cast<const float*>(t.triangles + triangle[lane]); });
}
inline Vec3 corner_normal(const RowFields<4>& triangle, const Hits& hit) {
    const auto at = [&](int row) { return triangle(3 + row) + hit.u * triangle(6 + row) + hit.v * triangle(9 + row); };
    return {at(0), at(1), at(2)};
}

// ---------------------------------------------------------------------------------------------------------- textures

inline float half_to_float(uint16_t half) {
#if defined(__F16C__)
    return _cvtsh_ss(half);
#else
    const uint32_t sign = uint32_t(half & 0x8000) << 16, exponent = half >> 10 & 31, fraction = half & 1023;
    if (exponent == 0) return (sign ? -1.0f : 1.0f) * float(fraction) * 0x1p-24f;
    uint32_t word = sign | (exponent == 31 ? 255u : exponent + 112u) << 23 | fraction << 13;
    float value;
    std::memcpy(&value, &word, sizeof value);
    return value;
#endif
}

inline int64_t floored_modulo(int64_t index, int64_t size) {
    if (index >= 0 && index < size) return index;  // spares most lookups a division
    const int64_t rest = index % size;
    return rest < 0 ? rest + size : rest;
}

// Texels on both sides of a coordinate along an axis, and the weight of the second (`TextureAtlas._neighbours`).
inline float neighbours(const Tables& t, int64_t number, float coordinate, int axis, int64_t (&pair)[2]) {
    const int64_t size = t.texture_sizes[axis * t.textures + number];
    const float x = coordinate * float(size) - 0.5f, below = __builtin_floorf(x);
    const int64_t index = x == x && below > -9e18f && below < 9e18f ? int64_t(below) : 0;
    for (int side = 0; side < 2; ++side) {
        int64_t place = index + side;
        if (t.texture_bounds != nullptr) {
            const int64_t* bounds = t.texture_bounds + 3 * axis * t.textures + number;
            const int64_t low = bounds[0], high = bounds[t.textures], period = bounds[2 * t.textures];
            place = place < low ? low : place;
            place = floored_modulo(place > high ? high : place, period);
            place = place < 2 * size - 1 - place ? place : 2 * size - 1 - place;  // the second half of a mirrored period
        } else {
            place = floored_modulo(place, size);
        }
        pair[side] = place;
    }
    return x - below;
}

// Bilinear RGBA of one texture (`TextureAtlas.lookup`).
inline void lookup(const Tables& t, int64_t number, float u, float v, float (&color)[4]) {
    if (t.texture_transforms != nullptr) {
        const float* rows = t.texture_transforms + number;
        const int64_t next = t.textures;
        const float across = rows[0] * u + rows[next] * v + rows[2 * next];
        v = rows[3 * next] * u + rows[4 * next] * v + rows[5 * next];
        u = across;
    }
    int64_t columns[2], lines[2];
    const float right = neighbours(t, number, u, 0, columns), below = neighbours(t, number, v, 1, lines);
    const int64_t start = t.texture_start[number], width = t.texture_sizes[number];
    const float across[2] = {1.0f - right, right}, down[2] = {1.0f - below, below};
    for (float& channel : color) channel = 0.0f;
    for (int line = 0; line < 2; ++line) {
        for (int column = 0; column < 2; ++column) {
            const uint16_t* texel = t.texels + 4 * (start + lines[line] * width + columns[column]);
            const float weight = across[column] * down[line];
            for (int channel = 0; channel < 4; ++channel) color[channel] += half_to_float(texel[channel]) * weight;
        }
    }
    if (t.texture_scales != nullptr) {
        for (float& channel : color) channel *= t.texture_scales[number];
    }
}

// RGBA of the textures in a slot, 1 where a material has none, and which lanes have one.
struct Texels {
    Float rgba[4];
    Int textured;
};
inline Texels texels(const Tables& t, Slot slot, const Hits& hit, Int material, Int active) {
    Texels found = {{all(1.0f), all(1.0f), all(1.0f), all(1.0f)}, all(0)};
    if (t.numbers[slot] == nullptr) return found;
    for (int lane = 0; lane < LANES; ++lane) {
        const int64_t number = active[lane] ? t.numbers[slot][material[lane]] : -1;
        if (number < 0) continue;
        int64_t column = hit.triangle[lane];
        if (t.uv_sets > 1) column += t.triangle_count * t.texture_uv_set[number];
        const int64_t columns = t.uv_sets * t.triangle_count;
        float uv[2], color[4];
        for (int axis = 0; axis < 2; ++axis) {
            const float* rows = t.uvs + axis * columns + column;
            uv[axis] = rows[0] + hit.u[lane] * rows[2 * columns] + hit.v[lane] * rows[4 * columns];
        }
        lookup(t, number, uv[0], uv[1], color);
        for (int channel = 0; channel < 4; ++channel) found.rgba[channel][lane] = color[channel];
        found.textured[lane] = -1;
    }
    return found;
}

inline Vec3 rgb(const Texels& found) { return {found.rgba[0], found.rgba[1], found.rgba[2]}; }

// ---------------------------------------------------------------------------------------------------------- surfaces

inline Float leaving_distance(Vec3 position, Float distance) {
    return OFFSET * (max(max(abs(position.x), abs(position.y)), abs(position.z)) + distance);
}

inline Vec3 leave(const Surface& s, Vec3 direction) {
    const Float side = dot(s.geometric_normal, direction);
    const Float sign = one_if(side > all(0.0f)) - one_if(side < all(0.0f));
    return s.position + s.geometric_normal * ((side == side ? sign : side) * s.offset);
}

// Replace shading normals by those of the maps in a slot, given the texels in tangent space (`_apply_normal_map`).
inline void apply_normal_map(const Tables& t, Slot slot, const Hits& hit, Int material, Surface& s, Vec3& normal, Int active) {
    const Texels texel = texels(t, slot, hit, material, active);
    if (!any(texel.textured)) return;
    const Float scale = gather(t.normal_scales[slot], material);
    const float* rows = t.tangents[slot];
    Vec3 tangent = interpolated3(rows, t.triangle_count, 3, hit.triangle, hit.u, hit.v);
    tangent = normalize(tangent - normal * dot(normal, tangent));
    const Float side = 2.0f * s.front - 1.0f, up = gather(rows + 9 * t.triangle_count, hit.triangle);
    const Float x = texel.rgba[0] * scale * side, y = texel.rgba[1] * scale * up;
    const Vec3 bent = normalize(x * tangent + y * cross(normal, tangent) + texel.rgba[2] * normal);
    const Int faces = dot(bent, s.outgoing) > all(MIN_FACING);
    s.facing = texel.textured & ~faces ? all(0.0f) : s.facing;
    normal = choose(texel.textured & faces, bent, normal);
}

inline void apply_textures(const Tables& t, const Hits& hit, Int material, Surface& s, Int active) {
    if (t.colors != nullptr) s.base_color = s.base_color * interpolated3(t.colors, t.triangle_count, 4, hit.triangle, hit.u, hit.v);
    if (t.textures == 0) return;
    const auto slot = [&](Slot which) { return texels(t, which, hit, material, active); };
    if (t.numbers[bokehguide::BASE_COLOR]) s.base_color = s.base_color * rgb(slot(bokehguide::BASE_COLOR));
    if (t.numbers[bokehguide::METALLIC_ROUGHNESS]) {
        const Texels texel = slot(bokehguide::METALLIC_ROUGHNESS);
        s.alpha = s.alpha * square(texel.rgba[1]);
        s.metallic = s.metallic * texel.rgba[2];
    }
    if (t.numbers[bokehguide::SPECULAR]) s.specular = s.specular * slot(bokehguide::SPECULAR).rgba[3];
    if (t.numbers[bokehguide::SPECULAR_COLOR]) s.specular_color = s.specular_color * rgb(slot(bokehguide::SPECULAR_COLOR));
    if (t.numbers[bokehguide::TRANSMISSION]) s.transmission = s.transmission * slot(bokehguide::TRANSMISSION).rgba[0];
    if (t.numbers[bokehguide::CLEARCOAT]) s.clearcoat = s.clearcoat * slot(bokehguide::CLEARCOAT).rgba[0];
    if (t.numbers[bokehguide::CLEARCOAT_ROUGHNESS]) {
        s.clearcoat_alpha = s.clearcoat_alpha * square(slot(bokehguide::CLEARCOAT_ROUGHNESS).rgba[1]);
    }
    if (t.numbers[bokehguide::SHEEN_COLOR]) s.sheen_color = s.sheen_color * rgb(slot(bokehguide::SHEEN_COLOR));
    if (t.numbers[bokehguide::SHEEN_ROUGHNESS]) s.sheen_roughness = s.sheen_roughness * slot(bokehguide::SHEEN_ROUGHNESS).rgba[3];
    if (t.numbers[bokehguide::DIFFUSE_TRANSMISSION]) {
        s.diffuse_transmission = s.diffuse_transmission * slot(bokehguide::DIFFUSE_TRANSMISSION).rgba[3];
    }
    if (t.numbers[bokehguide::DIFFUSE_TRANSMISSION_COLOR]) {
        s.transmission_color = s.transmission_color * rgb(slot(bokehguide::DIFFUSE_TRANSMISSION_COLOR));
    }
    if (t.numbers[bokehguide::IRIDESCENCE]) s.iridescence = s.iridescence * slot(bokehguide::IRIDESCENCE).rgba[0];
    if (t.numbers[bokehguide::IRIDESCENCE_THICKNESS]) {
        const Texels texel = slot(bokehguide::IRIDESCENCE_THICKNESS);
        const Float least = gather(t.film + 2 * t.materials, material), most = gather(t.film + 3 * t.materials, material);
        s.film_thickness = texel.textured ? least + (most - least) * texel.rgba[1] : s.film_thickness;
    }
    if (t.numbers[bokehguide::NORMAL]) apply_normal_map(t, bokehguide::NORMAL, hit, material, s, s.normal, active);
    if (t.numbers[bokehguide::CLEARCOAT_NORMAL]) {
        apply_normal_map(t, bokehguide::CLEARCOAT_NORMAL, hit, material, s, s.clearcoat_normal, active);
    }
}

// `Geometry._apply_anisotropy`.
inline void apply_anisotropy(const Tables& t, const Hits& hit, Int material, Surface& s, Int active) {
    const auto parameter = [&](int row) { return gather(t.anisotropy + row * t.materials, material); };
    Float strength = parameter(0), x = all(1.0f), y = all(0.0f);
    const Texels texel = texels(t, bokehguide::ANISOTROPY, hit, material, active);
    if (any(texel.textured)) {
        const Float size = 1.0f / sqrt(at_least(square(texel.rgba[0]) + square(texel.rgba[1]), 1e-12f));
        x = texel.textured ? texel.rgba[0] * size : x;
        y = texel.textured ? texel.rgba[1] * size : y;
        strength = texel.textured ? strength * (0.5f * texel.rgba[2] + 0.5f) : strength;
    }
    const Float cosine = parameter(1), sine = parameter(2), along = x * cosine - y * sine, across = x * sine + y * cosine;
    const float* rows = t.tangents[bokehguide::ANISOTROPY];
    Vec3 tangent = interpolated3(rows, t.triangle_count, 3, hit.triangle, hit.u, hit.v);
    tangent = normalize(tangent - s.normal * dot(s.normal, tangent));
    const Float side = 2.0f * s.front - 1.0f, up = gather(rows + 9 * t.triangle_count, hit.triangle);
    s.tangent = along * side * tangent + across * up * cross(s.normal, tangent);
    s.alpha_along = s.alpha + (1.0f - s.alpha) * square(strength);
}

// The last fields as without the terms.
inline void clear_rare_fields(Surface& s) {
    s.sheen_color = s.tangent = grey(all(0.0f)), s.transmission_color = grey(all(1.0f)), s.film_ior = all(1.0f);
    s.sheen_roughness = s.diffuse_transmission = s.iridescence = s.film_thickness = s.dispersion = s.single_scattering = all(0.0f);
}

// `Geometry.surface`. active: lanes with a valid hit.
inline Surface surface_at(const Tables& t, Vec3 origin, Vec3 direction, const Hits& hit, Int active) {
    Surface s;
    const RowFields<4> triangle = triangle_fields(t, hit.triangle);
    s.outgoing = -direction;
    const Vec3 face = {triangle(0), triangle(1), triangle(2)};
    const Float side = dot(face, s.outgoing);
    s.front = one_if(side > all(0.0f));
    s.geometric_normal = face * copysign(all(1.0f), side);
    Vec3 normal = corner_normal(triangle, hit);
    normal = normalize(normal * copysign(all(1.0f), dot(normal, s.geometric_normal)));
    const Int faces = dot(normal, s.outgoing) > all(MIN_FACING);
    s.facing = one_if(faces);
    s.normal = choose(faces, normal, s.geometric_normal);
    s.position = origin + hit.distance * direction;
    s.offset = leaving_distance(s.position, hit.distance);
    const Int material = triangle.integer(12);
    const MaterialValues value(material);
    const auto parameter = [&](int row) { return value(t.parameters + row * t.materials); };
    s.base_color = {parameter(0), parameter(1), parameter(2)};
    s.metallic = parameter(3), s.alpha = parameter(4), s.specular = parameter(5);
    s.transmission = parameter(6), s.thin = parameter(7), s.ior = parameter(8);
    s.specular_color = t.specular_color ? gather3(t.specular_color, t.materials, material) : grey(all(1.0f));
    s.clearcoat = t.clearcoat ? gather(t.clearcoat, material) : all(0.0f);
    s.clearcoat_alpha = t.clearcoat ? gather(t.clearcoat + t.materials, material) : all(1.0f);
    s.clearcoat_normal = s.normal;
    if (t.surface_rows == SURFACE_ROWS) clear_rare_fields(s);
    if (t.sheen != nullptr) {
        s.sheen_color = gather3(t.sheen, t.materials, material), s.sheen_roughness = gather(t.sheen + 3 * t.materials, material);
    }
    if (t.diffuse_transmission != nullptr) {
        s.diffuse_transmission = gather(t.diffuse_transmission, material);
        s.transmission_color = gather3(t.diffuse_transmission + t.materials, t.materials, material);
    }
    if (t.film != nullptr) {
        s.iridescence = gather(t.film, material), s.film_ior = gather(t.film + t.materials, material);
        s.film_thickness = gather(t.film + 3 * t.materials, material);
    }
    if (t.dispersion != nullptr) s.dispersion = gather(t.dispersion, material);
    if (t.single_scattering != nullptr) s.single_scattering = gather(t.single_scattering, material);
    if (t.colors != nullptr || t.textures > 0) apply_textures(t, hit, material, s, active);
    if (t.has_transmission) {  // `_separate_glass`
        s.transmission = s.transmission * (1.0f - s.metallic);
        s.metallic = at_most(s.metallic / divisor(1.0f - s.transmission, 1e-6f), 1.0f);
    }
    s.alpha = at_least(s.alpha, MIN_ALPHA), s.alpha_along = s.alpha;
    s.clearcoat_alpha = at_least(s.clearcoat_alpha, MIN_ALPHA);
    if (t.anisotropy != nullptr) apply_anisotropy(t, hit, material, s, active);
    return s;
}

// ----------------------------------------------------------------------------------------- emission, opacity, absorption

inline Vec3 emitted(Vec3 emission, Float double_sided, Float front) { return emission * max(front, double_sided); }

inline Float through_clearcoat(const Tables& t, const Hits& hit, Int material, Vec3 direction, Int active) {
    const Float weight = gather(t.clearcoat, material) * texels(t, bokehguide::CLEARCOAT, hit, material, active).rgba[0];
    const Float grazing = fifth_power(1.0f - at_most(abs(dot(normalize(corner_normal(triangle_fields(t, hit.triangle), hit)), direction)), 1.0f));
    return 1.0f - weight * (CLEARCOAT_F0 + (1.0f - CLEARCOAT_F0) * grazing);
}

// `Geometry.emission_share`: factor of cones, textures, vertex colours and clearcoats on the emission.
inline Vec3 emission_share(const Tables& t, const Hits& hit, Vec3 direction, Int active) {
    const Int material = material_of(t, hit.triangle);
    Vec3 share = grey(all(1.0f));
    if (t.cones != nullptr) {
        const auto row = [&](int number) { return gather(t.cones + number * t.materials, material); };
        const Float s = clamp(dot({row(0), row(1), row(2)}, direction) * row(3) + row(4), 0.0f, 1.0f);
        share = grey(square(s) * (1.0f + row(5) * (2.0f - 2.0f * s)));
    }
    share = share * rgb(texels(t, bokehguide::EMISSION, hit, material, active));
    if (t.colors != nullptr) {
        const Vec3 color = interpolated3(t.colors, t.triangle_count, 4, hit.triangle, hit.u, hit.v);
        share = choose(gather(t.tinted, material) != 0, share * color, share);
    }
    if (t.clearcoat != nullptr) share = share * through_clearcoat(t, hit, material, direction, active);
    return share;
}

// `Geometry.emission`.
inline Vec3 emission(const Tables& t, const Hits& hit, Float front, Vec3 direction, Int active) {
    const Int material = material_of(t, hit.triangle);
    const Vec3 color = gather3(t.emission, t.materials, material);
    const Vec3 radiance = emitted(color, gather(t.emission + 3 * t.materials, material), front);
    return t.plain_emission ? radiance : radiance * emission_share(t, hit, direction, active);
}

// `Geometry.opacity`.
inline Float opacity(const Tables& t, const Hits& hit, Int active) {
    const Int material = material_of(t, hit.triangle);
    Float coverage = all(1.0f);
    if (t.colors != nullptr) coverage = interpolated(t.colors, t.triangle_count, 4, 3, hit.triangle, hit.u, hit.v);
    coverage = coverage * texels(t, bokehguide::BASE_COLOR, hit, material, active).rgba[3];
    const auto row = [&](int number) { return gather(t.opacity + number * t.materials, material); };
    coverage = row(0) * coverage;
    const Float blend = row(1);
    return blend * clamp(coverage, 0.0f, 1.0f) + (1.0f - blend) * one_if(coverage >= row(2));
}

// `Materials.transmittance`, where some solid absorbs.
inline Vec3 transmittance(const Tables& t, const Hits& hit, Float front) {
    const Vec3 absorption = gather3(t.absorption, t.materials, material_of(t, hit.triangle));
    const Float inside = (1.0f - front) * hit.distance;
    return {exp_of_negative(-absorption.x * inside), exp_of_negative(-absorption.y * inside), exp_of_negative(-absorption.z * inside)};
}

}  // namespace BOKEHGUIDE_ISA
