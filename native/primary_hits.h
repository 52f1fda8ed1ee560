// Primary hits as seen from other lens points: `PrimaryHits` of render/primary_hits.py.

#pragma once

#include "bsdf.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::PathLight;
using bokehguide::ReusedGroups;

constexpr float FAINTEST = 1e-20f;

// The BSDF of the opaque part of surfaces, seen from some directions (`opaque_values`).
inline Scattering opaque_part(const Tables& t, const Surface& s) { return Scattering(t, s, all(2.0f)); }

// Numbers of recorded hits: of different ones, or of one hit in all lanes.
inline Float recorded(const float* row, Int hit) { return gather(row, hit); }
inline Float recorded(const float* row, int32_t hit) { return all(row[hit]); }

// Rows of recorded hits, as fields of surfaces from some field on. Hit: see `recorded`.
template <class Hit> void fill(const PathLight& of, Hit hit, Surface& s, Float* field, int count = 1) {
    const int first = int(field - reinterpret_cast<Float*>(&s));
    for (int row = 0; row < count; ++row) field[row] = recorded(of.surface + (first + row) * of.hit_columns, hit);
}

// The surface of a recorded hit, with the fields that the opaque part needs; the others are 0.
inline Surface recorded_surface(const Tables& t, const PathLight& of, int32_t hit) {
    Surface s = {};
    fill(of, hit, s, &s.outgoing.x, 9);  // with both normals
    fill(of, hit, s, &s.base_color.x, 6), fill(of, hit, s, &s.ior);
    if (t.specular_color != nullptr) fill(of, hit, s, &s.specular_color.x, 3);
    if (t.clearcoat != nullptr) fill(of, hit, s, &s.clearcoat, 5);
    if (t.surface_rows == SURFACE_ROWS) fill(of, hit, s, &s.sheen_color.x, SURFACE_ROWS - SHEEN_ROW);
    return s;
}

// Adds the radiance of light groups by way of one path and one kind of sample to `parts`; value: BSDF times cosine.
inline void add_parts(const ReusedGroups& groups, int64_t columns, int32_t path, int kind, Vec3 value, Vec3* parts) {
    const float* const bsdf = groups.bsdf + 3 * kind * columns + path;
    const auto ratio = [&](Float x, float of) { return of > FAINTEST ? x / of : all(0.0f); };
    const Vec3 scale = {ratio(value.x, bsdf[0]), ratio(value.y, bsdf[columns]), ratio(value.z, bsdf[2 * columns])};
    for (int group = 0; group < groups.count; ++group) {
        const float* const from = groups.reflected + (6 * group + 3 * kind) * columns + path;
        if (from[0] == 0.0f && from[columns] == 0.0f && from[2 * columns] == 0.0f) continue;
        parts[group] = parts[group] + scale * Vec3{all(from[0]), all(from[columns]), all(from[2 * columns])};
    }
}

// Radiance of one hit towards a vector of unit directions, added up over the paths of the hit (`PrimaryHits.radiance` without emission).
// parts: the radiance of light groups is added to them; null for none.
inline Vec3 reflected(const Tables& t, const PathLight& of, int32_t hit, Vec3 outgoing, const ReusedGroups* groups, Vec3* parts) {
    const float* directions[2] = {of.light_direction, of.scattered_direction};
    Surface s = recorded_surface(t, of, hit);
    s.outgoing = outgoing;
    const Scattering scattering = opaque_part(t, s);
    const auto column = [&](const float* rows, int32_t path) {
        return Vec3{all(rows[path]), all(rows[of.path_columns + path]), all(rows[2 * of.path_columns + path])};
    };
    Vec3 sum = grey(all(0.0f));
    for (int32_t path = of.first_path[hit]; path < of.first_path[hit] + of.paths[hit]; ++path) {
        Vec3 light = grey(all(0.0f));
        for (int kind = 0; kind < 2; ++kind) {
            const float* const incident = of.incident + 3 * kind * of.path_columns;
            if (incident[path] == 0.0f && incident[of.path_columns + path] == 0.0f && incident[2 * of.path_columns + path] == 0.0f) continue;
            const Vec3 value = scattering.evaluate(column(directions[kind], path)).value;
            light = light + value * column(incident, path);
            if (groups != nullptr) add_parts(*groups, of.path_columns, path, kind, value, parts);
        }
        sum = sum + light;
    }
    return sum;
}

}  // namespace BOKEHGUIDE_ISA
