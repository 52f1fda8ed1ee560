// Primary hits as seen from other lens points: `PrimaryHits` of render/primary_hits.py.

#pragma once

#include "bsdf.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::PathLight;

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

// Whether light comes from a direction of a path: of its light sample or of its BSDF sample.
inline bool is_lit(const PathLight& of, int32_t path, int kind) {
    const float* const incident = of.incident + 3 * kind * of.path_columns + path;
    return incident[0] != 0.0f || incident[of.path_columns] != 0.0f || incident[2 * of.path_columns] != 0.0f;
}
inline Vec3 path_column(const PathLight& of, const float* rows, int32_t path) {
    return {all(rows[path]), all(rows[of.path_columns + path]), all(rows[2 * of.path_columns + path])};
}
inline Vec3 incident_light(const PathLight& of, int32_t path, int kind) { return path_column(of, of.incident + 3 * kind * of.path_columns, path); }

// `PrimaryHits.reflection`: 0 where the BSDF is too small as a divisor.
inline void incident_of(const PathLight& of, const float* reflected, float* incident) {
    for (int64_t row = 0; row < 6; ++row) {
        const float *const value = of.bsdf + row * of.path_columns, *const light = reflected + row * of.path_columns;
        float* const found = incident + row * of.path_columns;
        for (int64_t path = 0; path < of.path_count; ++path) found[path] = value[path] > FAINTEST ? light[path] / value[path] : 0.0f;
    }
}

// The incoming directions of paths of one hit, one in each lane, and the numbers of the BSDF that do not depend on the viewer.
class PathDirections {
  public:
    static constexpr int PATHS = 4;
    Opaque::Incidents incidents;
    Float allowed;

    static int lane(int path, int kind) { return 2 * path + kind; }
    // World directions of `paths` paths from `start` on.
    static Vec3 load(const PathLight& of, int32_t start, int paths) {
        Vec3 found = {};
        for (int path = 0; path < paths; ++path) {
            for (int kind = 0; kind < 2; ++kind) {
                const float* const from = (kind == 0 ? of.light_direction : of.scattered_direction) + start + path;
                const int at = lane(path, kind);
                found.x[at] = from[0], found.y[at] = from[of.path_columns], found.z[at] = from[2 * of.path_columns];
            }
        }
        return found;
    }
    // One lane in all lanes.
    PathDirections all_from(int lane) const {
        PathDirections found;
        const Float* const from = reinterpret_cast<const Float*>(this);
        Float* const to = reinterpret_cast<Float*>(&found);
        for (size_t row = 0; row < sizeof found / sizeof(Float); ++row) to[row] = all(from[row][lane]);
        return found;
    }
};
static_assert(2 * PathDirections::PATHS <= LANES, "a lane for each direction");

// The BSDF of one hit towards a vector of unit directions (`PrimaryHits.bsdf`).
class RecordedScattering {
  public:
    RecordedScattering(const Tables& t, const PathLight& of, int32_t hit, Vec3 outgoing)
        : surface_(recorded_surface(t, of, hit)), scattering_(opaque_part(t, seen_from(surface_, outgoing))) {}

    PathDirections directions(const PathLight& of, int32_t start, int paths) const {
        const Vec3 world = PathDirections::load(of, start, paths), local = to_local(world, scattering_.frame);
        return {scattering_.opaque.incidents(local), scattering_.allowed(world, local.z)};
    }
    // BSDF times cosine for the incoming direction of a lane.
    Vec3 evaluate(const PathDirections& directions, int lane) const {
        const PathDirections from = directions.all_from(lane);
        return scattering_.opaque.evaluate(from.incidents).value * from.allowed;
    }

  private:
    Surface surface_;
    Scattering scattering_;

    static const Surface& seen_from(Surface& s, Vec3 outgoing) {
        s.outgoing = outgoing;
        return s;
    }
};

}  // namespace BOKEHGUIDE_ISA
