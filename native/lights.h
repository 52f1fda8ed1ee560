// Light sampling by power: render/lights/power_sampler.py, scene_lights.py, voxel_grid.py and environment.py, for a vector of points at
// a time.

#pragma once

#include "bsdf.h"
#include "random.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::DistantTable;
using bokehguide::AliasEntry;
using bokehguide::EmitterRow;
using bokehguide::ClusterLights;
using bokehguide::ClusterTable;
using bokehguide::FLOATS_IN_LINE;
using bokehguide::LEVELS_IN_LINE;

constexpr float MISS_DISTANCE = 1e37f, LEAST_COSINE = 1e-12f;

// Slots of an alias table, and places in them from 0 to 1 (`AliasTable.sample`). start, count: of the row of the table.
struct AliasSlots {
    Int slot;
    Double place;

    AliasSlots() = default;
    AliasSlots(Int start, Int count, Float u0, Float u1) {
        const Double fine = __builtin_convertvector(u0, Double) + (__builtin_convertvector(u1, Double) - 0.5) * 0x1p-23;
        const Double position = fine * __builtin_convertvector(count, Double);
        const Int whole = __builtin_convertvector(position, Int);
        slot = whole + start, place = position - __builtin_convertvector(whole, Double);
    }
};

// `LightVoxelGrid.cells`; a NaN belongs to the first cell.
inline Int cell_of(const Tables& t, Vec3 point) {
    const auto along = [&](Float x, int axis) {
        const Float place = (x - t.grid_low[axis]) * t.grid_scale;
        return to_int(at_most(place > all(0.0f) ? place : all(0.0f), t.grid_last[axis])) * t.grid_step[axis];
    };
    return along(point.x, 0) + along(point.y, 1) + along(point.z, 2);
}

// Number of entries up to `u` among ascending ones that begin at `start`, at most `count - 1`. Loads go up to the end of a line.
inline Int entries_up_to(const float* table, Int start, int count, Float u) {
    Int found;
    for (int lane = 0; lane < LANES; ++lane) {
        const float* const from = table + start[lane];
        int below = 0;
        for (int first = 0; first < count; first += LANES) {
            const unsigned within = count - first < LANES ? (1u << (count - first)) - 1u : ~0u;
            below += __builtin_popcount(lanes(load<Float>(from + first) <= all(u[lane])) & within);
        }
        found[lane] = below;
    }
    return found < count ? found : all(count - 1);
}
// `ClusterTable.sample`: a search among the ends of lines, and then in a line.
inline Int sample_cluster(const ClusterTable& table, Int row, Float u) {
    const Int start = row << table.coarse_levels, end = entries_up_to(table.ends, start, 1 << table.coarse_levels, u);
    if (table.coarse_levels == table.levels) return end;
    return (end << LEVELS_IN_LINE) + entries_up_to(table.cumulative, (start + end) << LEVELS_IN_LINE, FLOATS_IN_LINE, u);
}
// `ClusterTable.pdf`: differences of cumulative probabilities.
inline Float cluster_pdf(const ClusterTable& table, Int row, Int cluster) {
    const Int place = (row << table.levels) + cluster;
    const Float before = gather(table.cumulative, cluster > 0 ? place - 1 : place);
    return gather(table.cumulative, place) - (cluster > 0 ? before : all(0.0f));
}

// Points that lights illuminate (`Lights.query`).
struct PointQuery {
    Vec3 point;
    Int cell;
    Float environment_share;

    PointQuery(const Tables& t, Vec3 at) : point(at), cell(all(0)), environment_share(all(t.has_far_power ? 1.0f : 0.0f)) {
        if (t.emitters > 0) {
            cell = cell_of(t, at);
            if (t.has_far_power) environment_share = gather(t.far_share, cell);
        }
    }
    Float share(const Tables& t, Int cluster) const { return (1.0f - environment_share) * cluster_pdf(t.clusters, cell, cluster); }
};

// -------------------------------------------------------------------------------------------------------- environment

inline Float contains(const DistantTable& light, Vec3 direction) {
    const Vec3 offset = direction - Vec3{all(light.frame[2]), all(light.frame[5]), all(light.frame[8])};
    return one_if(dot(offset, offset) <= all(light.squared_radius));
}

// A direction, and its place on the map in texels (`Equirectangular.place`), 0 without a map.
struct MapDirection {
    Vec3 direction;
    Float column, row;
};
inline MapDirection on_map(const Tables& t, Vec3 d) {
    if (t.map_texels == nullptr) return {d, all(0.0f), all(0.0f)};
    const Float u = 0.5f + polar_angle(d.x, -d.z) / (2.0f * PI) + t.map_turn;
    return {d, (u - floor(u)) * float(t.map_width), polar_angle(sqrt(d.x * d.x + d.z * d.z), d.y) / PI * float(t.map_height)};
}

inline Int within(Int x, int32_t least, int32_t most) {
    x = x < least ? all(least) : x;
    return x > most ? all(most) : x;
}

inline Int texel_at(const Tables& t, const MapDirection& at) {
    return within(to_int(at.row), 0, t.map_height - 1) * t.map_width + within(to_int(at.column), 0, t.map_width - 1);
}

// The four texels around a place on the map, and the weights of the right and the lower ones.
struct TexelCorners {
    Int upper[2], lower[2];
    Float across, down;

    TexelCorners(const Tables& t, const MapDirection& at) {
        const Float x = at.column - 0.5f, y = at.row - 0.5f, left = floor(x), top = floor(y);
        const auto row = [&](Float line) { return within(to_int(line), 0, t.map_height - 1) * t.map_width; };
        const auto column = [&](Float place) {
            return within(to_int(place - floor(place / float(t.map_width)) * float(t.map_width)), 0, t.map_width - 1);
        };
        across = x - left, down = y - top;
        const Int lines[2] = {row(top), row(top + 1.0f)}, columns[2] = {column(left), column(left + 1.0f)};
        for (int side = 0; side < 2; ++side) upper[side] = lines[0] + columns[side], lower[side] = lines[1] + columns[side];
    }
    void fetch(const Tables& t) const {
        for (int lane = 0; lane < LANES; ++lane) {
            for (int side = 0; side < 2; ++side) {
                __builtin_prefetch(t.map_texels + 4 * int64_t(upper[side][lane]));
                __builtin_prefetch(t.map_texels + 4 * int64_t(lower[side][lane]));
            }
        }
    }
};

inline Vec3 map_radiance(const Tables& t, const MapDirection& at) {
    const TexelCorners corners(t, at);
    const Float before = 1.0f - corners.across, over = 1.0f - corners.down;
    alignas(16) float colors[LANES][4];
    for (int lane = 0; lane < LANES; ++lane) {
        const auto line = [&](const Int (&texels)[2]) {
            const auto color = [&](int side) { return load<Quad>(t.map_texels + 4 * int64_t(texels[side][lane])); };
            return before[lane] * color(0) + corners.across[lane] * color(1);
        };
        store(colors[lane], over[lane] * line(corners.upper) + corners.down[lane] * line(corners.lower));
    }
    const RowFields<1> color([&](int lane) { return colors[lane]; });
    return {color(0), color(1), color(2)};
}

// `EnvironmentLight.radiance`.
inline Vec3 environment_radiance(const Tables& t, const MapDirection& at) {
    Vec3 color = t.map_texels == nullptr ? grey(all(0.0f)) : map_radiance(t, at);
    for (int number = 0; number < t.distant_count; ++number) {
        const DistantTable& light = t.distant[number];
        color = color + Vec3{all(light.radiance[0]), all(light.radiance[1]), all(light.radiance[2])} * contains(light, at.direction);
    }
    return color;
}

inline Float environment_alpha(const Tables& t, Vec3 direction) {
    if (t.map_texels != nullptr) return all(1.0f);
    Float sum = all(0.0f);
    for (int number = 0; number < t.distant_count; ++number) sum = sum + contains(t.distant[number], direction);
    return at_most(sum, 1.0f);
}

// Density of each texel in the whole map.
inline Float map_density(const Tables& t, Int texel) { return t.map_table == nullptr ? all(0.0f) : gather(t.map_texels + 3, 4 * texel); }
// `EnvironmentLight.pdf` at directions in texels of the map with densities `of_map`.
inline Float environment_density(const Tables& t, Vec3 direction, Float of_map) {
    Float density = of_map * t.map_share;
    for (int number = 0; number < t.distant_count; ++number) {
        const DistantTable& light = t.distant[number];
        density = density + light.share * light.density * contains(light, direction);
    }
    return density;
}

// `PowerLightSampler.environment_pdf`.
inline Float environment_pdf(const Tables& t, Vec3 point, const MapDirection& at) {
    if (!t.has_far_power) return all(0.0f);
    return PointQuery(t, point).environment_share * environment_density(t, at.direction, map_density(t, texel_at(t, at)));
}

struct LightSample {
    Vec3 direction;
    Float distance;
    Vec3 radiance;
    Float pdf;
    Int triangle;  // -1 at infinity
};

inline Vec3 sample_distant(const DistantTable& light, Float u0, Float u1) {
    const Float down = light.height * u0, radius = sqrt(down * (2.0f - down)), z = 1.0f - down;
    Float sine, cosine;
    sincos(2.0f * PI * u1, sine, cosine);
    const Float x = radius * cosine, y = radius * sine;
    const float* f = light.frame;
    return {f[0] * x + f[1] * y + f[2] * z, f[3] * x + f[4] * y + f[5] * z, f[6] * x + f[7] * y + f[8] * z};
}

// A direction uniform over a texel of the map.
inline Vec3 sample_texel(const Tables& t, Int texel, Float u0, Float u1) {
    const Double quotient = __builtin_convertvector(texel, Double) / double(t.map_width);  // exact enough for whole numbers of 31 bits
    const Int row = __builtin_convertvector(quotient, Int), column = texel - row * t.map_width;
    Float unused, top, bottom, sine, cosine;
    sincos(PI / float(t.map_height) * to_float(row), unused, top);
    sincos(PI / float(t.map_height) * to_float(row + 1), unused, bottom);
    const Float y = top + (bottom - top) * u1;
    const Float phi = 2.0f * PI * ((to_float(column) + u0) / float(t.map_width) - 0.5f - t.map_turn);
    sincos(phi, sine, cosine);
    const Float radius = sqrt(at_least(1.0f - y * y, 0.0f));
    return {radius * sine, y, -radius * cosine};
}

// The distant lights that `EnvironmentLight.sample_element` draws, as elements -1, -2, ...; 0 for the map.
inline Int distant_element(const Tables& t, Float u) {
    Int number = all(0);
    for (int edge = 0; edge < t.distant_count; ++edge) number = number - (u >= all(t.distant_edges[edge]));
    return -number;
}

// `EnvironmentLight.directions`.
inline Vec3 environment_direction(const Tables& t, Int element, Float u0, Float u1) {
    Vec3 direction = grey(all(0.0f));
    if (t.map_table != nullptr) direction = sample_texel(t, element > 0 ? element : all(0), u0, u1);
    for (int light = 1; light <= t.distant_count; ++light) {
        direction = choose(element == -light, sample_distant(t.distant[light - 1], u0, u1), direction);
    }
    return direction;
}

// `EnvironmentLight.texels`: texels that directions lie in, which were drawn from elements.
inline Int element_texel(const Tables& t, Int element, const MapDirection& at) {
    if (t.map_table == nullptr) return all(0);
    return t.distant_count > 0 ? (element < 0 ? texel_at(t, at) : element) : element;
}

// Samples of elements of the environment, which is chosen with the probability `share`.
inline LightSample sample_environment(const Tables& t, Int element, Float share, const Float (&u)[2]) {
    const MapDirection at = on_map(t, environment_direction(t, element, u[0], u[1]));
    const Float pdf = share * environment_density(t, at.direction, map_density(t, element_texel(t, element, at)));
    return {at.direction, all(MISS_DISTANCE), environment_radiance(t, at), pdf, all(-1)};
}

// ---------------------------------------------------------------------------------------------------- emissive triangles

inline Float emitter_field(const Tables& t, Int emitter, int field) {
    return gather(reinterpret_cast<const float*>(t.emitter_rows) + field, emitter * 16);
}

// `Lights.triangle_sample`: points on emissive triangles, whose clusters are chosen with the probability `share`.
inline LightSample sample_triangle(const Tables& t, Vec3 point, Int emitter, Float share, const Float (&u)[2], Int active) {
    const RowFields<4> field([&](int lane) { return reinterpret_cast<const float*>(t.emitter_rows + emitter[lane]); });
    const auto vector = [&](int number) { return Vec3{field(number), field(number + 1), field(number + 2)}; };
    const Float root = sqrt(u[0]), a = root * (1.0f - u[1]), b = root * u[1];
    const Vec3 first = vector(3), second = vector(6);
    const Vec3 offset = vector(0) + a * first + b * second - point;
    const Float squared = divisor(dot(offset, offset)), distance = sqrt(squared);
    const Vec3 direction = offset / distance;
    const Float cosine = -dot(normalize(cross(first, second)), direction);
    const Float front = one_if(cosine > all(0.0f));
    const Float pdf = share * field(13) * squared / divisor(abs(cosine), LEAST_COSINE);
    Vec3 radiance = emitted(vector(9), field(12), front);
    const Int triangle = field.integer(14);
    if (!t.plain_emission || t.absorption != nullptr || t.translucent != nullptr) {
        const Hits hit = {triangle, distance, a, b};
        if (!t.plain_emission) radiance = radiance * emission_share(t, hit, -direction, active);
        if (t.absorption != nullptr) radiance = radiance * transmittance(t, hit, front);
        if (t.translucent != nullptr) radiance = radiance * opacity(t, hit, active);
    }
    return {direction, distance, radiance, pdf, triangle};
}

// Lights that samples come from: whether each is an element of the environment or an emissive triangle, which one it is, the
// probability of the environment or of the triangle's cluster, and uniform numbers for its place on the light.
struct LightChoice {
    Int far, element, cluster;
    Float share, place[2];

    // Ask for the memory that the samples will read: the emissive triangle, or the texels around the place on the map. A loop without
    // branches suits lanes of both kinds.
    void fetch(const Tables& t) const {
        const char* const tables[2] = {reinterpret_cast<const char*>(t.emitter_rows), reinterpret_cast<const char*>(t.map_texels)};
        const Int left = place[0] < all(0.5f), above = place[1] < all(0.5f);
        const Int corner = element + left - (above & t.map_width), first = far ? corner * 16 : element * 64;
        const Int right = far & 16, below = far & (t.map_width * 16);
        for (int lane = 0; lane < LANES; ++lane) {
            const char* const place = tables[-far[lane]] + first[lane];
            __builtin_prefetch(place), __builtin_prefetch(place + right[lane]);
            __builtin_prefetch(place + below[lane]), __builtin_prefetch(place + below[lane] + right[lane]);
        }
    }
};

// Lights that are chosen up to the entries of alias tables, which are not read yet. Reading them later hides the wait for memory.
struct LightSlots {
    LightChoice choice;  // its elements are those of distant lights, else 0
    AliasSlots alias;
    Int learned;  // whether the entry is one of `ClusterLights::texel_table`

    LightSlots() = default;
    LightSlots(Int far, Float share, const Float (&u)[6])
        : choice{far, all(0), all(0), share, {far ? u[3] : u[4], far ? u[4] : u[5]}}, alias(), learned(all(0)) {}

    // Choose elements of the environment where `chosen`; distant: their elements, 0 for texels.
    void set_far(Int chosen, Int distant, const AliasSlots& texels, Int of_cluster) {
        choice.element = chosen ? distant : choice.element, learned = chosen ? of_cluster : learned;
        set_slots(chosen, texels);
    }
    // Choose triangles of clusters where lights are not far.
    void set_near(const Tables& t, Int cluster, Float probability, const Float (&u)[6]) {
        const Int far = choice.far;
        choice.cluster = far ? choice.cluster : cluster, choice.share = far ? choice.share : probability;
        const Int start = gather(t.within_start, cluster), count = gather(t.within_start, cluster + 1) - start;
        set_slots(~far, AliasSlots(start, count, u[2], u[3]));
    }
    // Ask for the memory of the entries.
    void fetch(const Tables& t, const ClusterLights* lights) const {
        const Entries entry(*this, t, lights);
        for (int lane = 0; lane < LANES; ++lane) __builtin_prefetch(entry(lane));
        if (!any(learned)) return;
        const Int slot = learned ? alias.slot : all(0);
        for (int lane = 0; lane < LANES; ++lane) __builtin_prefetch(lights->texel_order + slot[lane]);
    }
    // Read the entries, and ask for the memory of the lights.
    LightChoice find(const Tables& t, const ClusterLights* lights) const {
        const RowFields<1> of_entry(Entries(*this, t, lights));
        const Int stays = __builtin_convertvector(alias.place < __builtin_convertvector(of_entry(0), Double), Int);
        Int slot = alias.slot;
        if (any(learned)) slot = learned ? gather(lights->texel_order, learned ? slot : all(0)) : slot;
        LightChoice found = choice;
        found.element = choice.element < 0 ? choice.element : (stays ? slot : of_entry.integer(1));
        found.fetch(t);
        return found;
    }

  private:
    void set_slots(Int chosen, const AliasSlots& slots) {
        alias.slot = chosen ? slots.slot : alias.slot;
        alias.place = __builtin_convertvector(chosen, Long) ? slots.place : alias.place;
    }
    // The entries, lane by lane, without branches. Where there is no table, all slots are 0.
    struct Entries {
        const AliasEntry* tables[3];
        Int table, slot;

        Entries(const LightSlots& of, const Tables& t, const ClusterLights* lights)
            : tables{t.within_table, t.map_table, lights == nullptr ? nullptr : lights->texel_table}, slot(of.alias.slot) {
            static constexpr AliasEntry NONE[2] = {{1.0f, 0}, {1.0f, 0}};
            for (const AliasEntry*& each : tables) each = each == nullptr ? NONE : each;
            table = -of.choice.far - of.learned;
        }
        const float* operator()(int lane) const { return reinterpret_cast<const float*>(tables[table[lane]] + slot[lane]); }
    };
};

// Elements of the whole environment for `LightSlots::set_far`.
inline void choose_environment(const Tables& t, LightSlots& slots, Int chosen, const Float (&u)[6]) {
    const AliasSlots texels = t.map_table == nullptr ? AliasSlots() : AliasSlots(all(0), all(t.map_width * t.map_height), u[1], u[2]);
    slots.set_far(chosen, distant_element(t, u[5]), texels, all(0));
}

// The choice of `PowerLightSampler.draw`.
inline LightSlots choose_light(const Tables& t, const PointQuery& query, const Float (&u)[6], Int active) {
    const Int far = u[0] < query.environment_share;
    LightSlots slots(far, query.environment_share, u);
    if (any(far & active)) choose_environment(t, slots, far, u);
    if (any(~far & active)) {
        const Int cluster = sample_cluster(t.clusters, query.cell, u[1]);
        slots.set_near(t, cluster, query.share(t, cluster), u);
    }
    slots.fetch(t, nullptr);
    return slots;
}

// `PowerLightSampler.draw`.
inline LightSample sample_light(const Tables& t, Vec3 point, const LightChoice& choice, Int active) {
    const Int far = choice.far;
    if (!any(far & active)) return sample_triangle(t, point, far ? all(0) : choice.element, choice.share, choice.place, active);
    const LightSample sky = sample_environment(t, far ? choice.element : all(0), choice.share, choice.place);
    if (!any(~far & active)) return sky;
    const LightSample near = sample_triangle(t, point, far ? all(0) : choice.element, choice.share, choice.place, active & ~far);
    return {choose(far, sky.direction, near.direction), far ? sky.distance : near.distance, choose(far, sky.radiance, near.radiance),
            far ? sky.pdf : near.pdf, far ? sky.triangle : near.triangle};
}

// `PowerLightSampler.triangle_pdf`: density with which points sample a triangle at a distance under a cosine.
inline Float triangle_pdf(const Tables& t, Vec3 point, Int triangle, Float distance, Float cosine) {
    if (t.emitters == 0) return all(0.0f);
    const Int emitter = emitter_of(t, triangle), known = emitter < 0 ? all(0) : emitter;
    const Int cluster = gather(&t.emitter_rows[0].cluster, known * 16);
    const Float chosen = PointQuery(t, point).share(t, cluster) * one_if(emitter >= 0);
    return chosen * emitter_field(t, known, 13) * distance * distance / divisor(abs(cosine), LEAST_COSINE);
}

}  // namespace BOKEHGUIDE_ISA
