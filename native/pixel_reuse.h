// Reuse of primary hits among neighbouring pixels: guiding/pixel_reuse.py, for a vector of views at a time.

#pragma once

#include <new>

#include "primary_hits.h"
#include "shadow_rays.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::HitRecord;
using bokehguide::LensCamera;
using bokehguide::LensSamples;
using bokehguide::COLUMN_BITS;
using bokehguide::MOST_MEMBERS;
using bokehguide::OwnSamples;
using bokehguide::PixelGroups;
using bokehguide::ReusedGroups;
using bokehguide::ROWS_PER_BAND;
using bokehguide::ViewRows;

constexpr int FRONT_ROW = 12;
constexpr float GROUP_SPACING = 3.0f, INFINITELY_DEEP = 1e30f, SHORTENED = 1.0f - 1e-4f;

inline Vec3 camera_to_world(const bokehguide::Camera& c, Vec3 v) {
    const float* m = c.axes;
    return {m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z, m[6] * v.x + m[7] * v.y + m[8] * v.z};
}
inline Vec3 world_to_camera(const bokehguide::Camera& c, Vec3 v) {
    const float* m = c.axes;
    return {m[0] * v.x + m[3] * v.y + m[6] * v.z, m[1] * v.x + m[4] * v.y + m[7] * v.z, m[2] * v.x + m[5] * v.y + m[8] * v.z};
}
inline Vec3 camera_position(const bokehguide::Camera& c) { return {all(c.position[0]), all(c.position[1]), all(c.position[2])}; }

// Surfaces of recorded hits, with their places, normals, and the fields by which pixels see them alike; the others are 0.
inline Surface placed_surface(const Tables& t, const PathLight& of, Int hit) {
    Surface s = {};
    fill(of, hit, s, &s.position.x, 15), fill(of, hit, s, &s.metallic, 2), fill(of, hit, s, &s.transmission);
    if (t.clearcoat != nullptr) fill(of, hit, s, &s.clearcoat, 5);
    return s;
}

// The primary hits of a batch by pixel (`_hits`), and the places of pixels in their bands.
class PixelHits {
  public:
    PixelHits(const Tables& t, const LensCamera& lens, const HitRecord& record, float min_spread, ViewRows& views)
        : t_(t), lens_(lens), record_(record), views_(views), min_spread_(min_spread) {}

    void fill(const PixelGroups& groups, const LensSamples& samples) {
        ViewRows& v = views_;
        for (int64_t i = 0; i < v.pixels; ++i) {
            const int64_t place = i < samples.count ? i : samples.count - 1;
            const int64_t pixel = groups.pixels == nullptr ? groups.first + place : groups.pixels[place];
            v.column[i] = int32_t(pixel % groups.width), v.line[i] = int32_t(pixel / groups.width % ROWS_PER_BAND);
            v.number[i] = int32_t(pixel - groups.first);
            const bool infinite = samples.triangle[place] < 0 && samples.weight[place] > 0.0f;
            v.reusable[i] = infinite && t_.has_environment && t_.visible_environment && i < samples.count;
            v.depth[i] = infinite ? INFINITELY_DEEP : samples.depth[place];
            v.place[i] = -1, v.plane[i] = v.plane[v.pixels + i] = 0.0f, v.plane[2 * v.pixels + i] = 1.0f;
        }
        for (int64_t first = 0; first < record_.count; first += LANES) add(first);
        for (int32_t i = 0; v.among != nullptr && i < v.numbers; ++i) v.among[i] = -1;
        for (int64_t i = 0; v.among != nullptr && i < samples.count; ++i) v.among[v.number[i]] = int32_t(i);
    }

  private:
    const Tables& t_;
    const LensCamera& lens_;
    const HitRecord& record_;
    ViewRows& views_;
    float min_spread_;

    void add(int64_t first) {
        const int count = record_.count - first < LANES ? int(record_.count - first) : LANES;
        Int hit;
        for (int lane = 0; lane < LANES; ++lane) hit[lane] = int32_t(first + (lane < count ? lane : count - 1));
        const Surface s = placed_surface(t_, record_.light, hit);
        const Vec3 normal = world_to_camera(lens_.camera, s.geometric_normal);
        const Vec3 position = world_to_camera(lens_.camera, s.position - camera_position(lens_.camera));
        const Float offset = dot(position, normal), alike = one_if(looks_alike(s, min_spread_ * view_angle(at_least(position.z, 1e-9f))));
        for (int lane = 0; lane < count; ++lane) {
            const int32_t pixel = record_.ray[first + lane];
            float* const plane = views_.plane + pixel;
            views_.place[pixel] = int32_t(first + lane), views_.reusable[pixel] = alike[lane];
            plane[0] = normal.x[lane], plane[views_.pixels] = normal.y[lane], plane[2 * views_.pixels] = offset[lane];
        }
    }
    // `_view_angle`.
    Float view_angle(Float depth) const {
        const float focus = lens_.focus_distance;
        const Float spacing = (GROUP_SPACING * lens_.pixel_slope * focus) * depth / at_least(abs(depth - focus), 1e-9f);
        return at_most(spacing, 2.0f * lens_.radius) / depth;
    }
    // `_looks_alike`.
    Int looks_alike(const Surface& s, Float least) const {
        Int alike = (s.alpha >= least) & (s.facing > all(0.0f));
        if (t_.clearcoat != nullptr) alike &= (s.clearcoat <= all(0.0f)) | (s.clearcoat_alpha >= least);
        if (t_.has_transmission) alike &= s.transmission <= all(0.0f);
        if (t_.absorption != nullptr) alike &= s.front > all(0.0f);
        return alike;
    }
};

// A member of the groups of a vector of pixels (`_members`), as indices into the batch; -1 for none.
inline Int member_of(const PixelGroups& groups, const ViewRows& v, int member, int64_t i) {
    const Int x = load<Int>(v.column + i), line = load<Int>(v.line + i);
    const Int row = ((line + groups.below) ^ groups.down[member]) - groups.below;
    const auto right = [&](Int of) { return gather(groups.right, of & (ROWS_PER_BAND - 1)); };
    const Int column = ((x + right(line)) ^ groups.across[member]) - right(row);
    const Int there = load<Int>(v.number + i) + (row - line) * groups.width + column - x;
    const Int inside = (column < groups.width) & ((column >> COLUMN_BITS) == (x >> COLUMN_BITS)) & (row >= 0) & (row < ROWS_PER_BAND) &
                       (there >= 0) & (there < v.numbers);
    if (v.among == nullptr) return inside ? there : all(-1);
    return inside ? gather(v.among, inside ? there : all(0)) : all(-1);
}

inline Float plane_distance(Vec3 plane, Float x, Float y) { return abs(plane.z - plane.x * x - plane.y * y); }

// The views of the hits of a vector of pixels, where the lens contains their lens points.
class ViewFinder {
  public:
    ViewFinder(const LensCamera& lens, const PixelGroups& groups, const LensSamples& samples, ViewRows& views)
        : lens_(lens), groups_(groups), samples_(samples), views_(views) {}

    void find(int64_t first) {
        first_ = first;
        for (int member = 1; member < views_.members; ++member) reconnect(member);
        for (int lane = 0; lane < LANES; ++lane) {
            for (int member = 1; member < views_.members; ++member) {
                if (inside_[member] >> lane & 1) add(member, lane);
            }
        }
    }

  private:
    const LensCamera& lens_;
    const PixelGroups& groups_;
    const LensSamples& samples_;
    ViewRows& views_;
    int64_t first_ = 0;
    unsigned inside_[MOST_MEMBERS];
    Int viewer_[MOST_MEMBERS];
    Float x_[MOST_MEMBERS], y_[MOST_MEMBERS], jacobian_[MOST_MEMBERS];

    // `_reconnected`.
    void reconnect(int member) {
        const int64_t count = samples_.count;
        Int viewer = member_of(groups_, views_, member, first_);
        const Int seen = (viewer >= 0) & (load<Float>(views_.reusable + first_) > all(0.0f));
        inside_[member] = 0;
        if (!any(seen)) return;
        viewer = seen ? viewer : all(0);
        Int pixel = lane_numbers() + int32_t(first_);
        pixel = seen ? pixel : all(0);
        const Float depth = load<Float>(views_.depth + first_);
        const Float own_x = gather(samples_.points, pixel), own_y = gather(samples_.points + count, pixel);
        const Float scale = depth / (depth - gather(samples_.focus + 2 * count, pixel));
        const auto moved = [&](const float* row, Float own) { return own + (gather(row, viewer) - gather(row, pixel)) * scale; };
        const Float x = moved(samples_.focus, own_x), y = moved(samples_.focus + count, own_y);
        const auto row = [&](int axis) { return load<Float>(views_.plane + axis * views_.pixels + first_); };
        const Vec3 plane = {row(0), row(1), row(2)};
        inside_[member] = lanes(seen & (x * x + y * y <= all(lens_.squared_radius)));
        viewer_[member] = viewer, x_[member] = x, y_[member] = y;
        jacobian_[member] = plane_distance(plane, x, y) / at_least(plane_distance(plane, own_x, own_y), 1e-20f);
    }
    void add(int member, int lane) {
        const int64_t view = views_.count++;
        views_.source[view] = int32_t(first_ + lane), views_.viewer[view] = viewer_[member][lane], views_.member[view] = member;
        views_.x[view] = x_[member][lane], views_.y[view] = y_[member][lane];
        views_.jacobian[view] = jacobian_[member][lane], views_.passing[view] = lens_.passing;
    }
};

inline void find_views(const Tables& t, const LensCamera& lens, const PixelGroups& groups, const LensSamples& samples, const HitRecord& record,
                       float min_spread, ViewRows& views) {
    PixelHits(t, lens, record, min_spread, views).fill(groups, samples);
    views.count = 0;
    ViewFinder finder(lens, groups, samples, views);
    for (int64_t first = 0; first < samples.count; first += LANES) finder.find(first);
}

// Whether surfaces have the same shading normals from unit directions (`PrimaryHits.same_normals`).
inline Int same_normals(const Tables& t, const HitRecord& record, Int hit, const Surface& s, Vec3 outgoing) {
    const auto faces = [&](Vec3 normal) { return dot(normal, outgoing) > all(MIN_FACING); };
    Int same = faces(s.normal);
    if (t.clearcoat != nullptr && t.tilts_coats) same &= faces(s.clearcoat_normal);
    const bool mapped = t.normal_scales[bokehguide::NORMAL] != nullptr || t.normal_scales[bokehguide::CLEARCOAT_NORMAL] != nullptr;
    if (mapped) {
        const RowFields<4> triangle = triangle_fields(t, gather(record.triangle, hit));
        const Vec3 own = corner_normal(triangle, {all(0), all(0.0f), gather(record.u, hit), gather(record.v, hit)});
        same &= faces(normalize(own * copysign(all(1.0f), dot(own, s.geometric_normal))));
    }
    return same;
}

// Shadow rays of the views of a block from hits to lens points (`_lens_rays`).
class alignas(64) ViewTracing {
  public:
    ViewTracing(const Tables& t, const LensCamera& lens, const LensSamples& samples, const HitRecord& record, ViewRows& views)
        : t_(t), lens_(lens), samples_(samples), record_(record), views_(views) {
        rays_.rays = 0, rays_.embree_seconds = 0.0;
    }

    // Keep the views that nothing blocks, in their order.
    void run() {
        const int64_t count = views_.count;
        views_.count = 0;
        for (int64_t first = 0; first < count; first += BLOCK) {
            const int size = count - first < BLOCK ? int(count - first) : BLOCK;
            int traced = 0;
            for (int i = 0; i < size; i += LANES) traced = aim(first, i, size, traced);
            rays_.trace(t_, traced, true);
            for (int i = 0; i < traced; ++i) {
                if (rays_.passes[i] > 0.0f) keep(first + chosen_[i], i);
            }
        }
    }
    int64_t rays() const { return rays_.rays; }
    double embree_seconds() const { return rays_.embree_seconds; }

  private:
    const Tables& t_;
    const LensCamera& lens_;
    const LensSamples& samples_;
    const HitRecord& record_;
    ViewRows& views_;
    ShadowRays rays_;
    IntRow chosen_;
    Row outgoing_[3];

    void keep(int64_t view, int ray) {
        const int64_t to = views_.count++;
        views_.source[to] = views_.source[view], views_.viewer[to] = views_.viewer[view], views_.member[to] = views_.member[view];
        views_.x[to] = views_.x[view], views_.y[to] = views_.y[view], views_.passing[to] = views_.passing[view];
        views_.jacobian[to] = views_.jacobian[view] * rays_.passes[ray];
        for (int axis = 0; axis < 3; ++axis) views_.outgoing[axis * views_.columns + to] = outgoing_[axis][ray];
    }

    // Aim the rays of a vector of views; returns the number of rays so far.
    int aim(int64_t first, int i, int size, int traced) {
        const int64_t view = first + i;  // rows have entries for whole vectors
        const Int active = first_lanes(size - i) & (load<Float>(views_.passing + view) > all(0.0f));
        const Int hit = active ? gather(views_.place, active ? load<Int>(views_.source + view) : all(0)) : all(-1);
        const Int viewer = active ? load<Int>(views_.viewer + view) : all(0), far = hit < 0;
        const Vec3 point = {load<Float>(views_.x + view), load<Float>(views_.y + view), all(0.0f)};
        const Vec3 on_lens = camera_to_world(lens_.camera, point) + camera_position(lens_.camera);
        Vec3 origin = on_lens, direction = {}, outgoing = {};
        Float distance = all(MISS_DISTANCE);
        Int leaves = active;
        if (any(far & active)) {
            direction = camera_to_world(lens_.camera, normalize(gather3(samples_.focus, samples_.count, viewer) - point));
        }
        if (any(~far)) {
            const Int place = far ? all(0) : hit;
            const Surface s = placed_surface(t_, record_.light, place);
            const Vec3 offset_to = on_lens - s.position, start = s.position + s.geometric_normal * s.offset, ray = on_lens - start;
            outgoing = offset_to / length(offset_to);
            const Float reach = length(ray);
            leaves &= far | ((dot(s.geometric_normal, outgoing) > all(0.0f)) & same_normals(t_, record_, place, s, outgoing));
            origin = choose(far, origin, start), direction = choose(far, direction, ray / reach);
            distance = far ? distance : reach * SHORTENED;
        }
        for (int lane = 0; lane < LANES; ++lane) {
            if (!leaves[lane]) continue;
            const Vec3* const from[3] = {&origin, &direction, &outgoing};
            Row* const rows[3] = {rays_.origin, rays_.direction, outgoing_};
            for (int row = 0; row < 3; ++row) {
                rows[row][0][traced] = from[row]->x[lane], rows[row][1][traced] = from[row]->y[lane], rows[row][2][traced] = from[row]->z[lane];
            }
            rays_.length[traced] = distance[lane], chosen_[traced++] = i + lane;
        }
        return traced;
    }
};

inline int64_t trace_views(const Tables& t, const LensCamera& lens, const LensSamples& samples, const HitRecord& record, ViewRows& views,
                           double* seconds) {
    ViewTracing* const tracing = new (std::align_val_t(64)) ViewTracing(t, lens, samples, record, views);
    tracing->run();
    const int64_t rays = tracing->rays();
    *seconds = tracing->embree_seconds();
    operator delete(tracing, std::align_val_t(64));
    return rays;
}

// Radiance of the samples as their viewers see them, over the scale of the source (`_seen_radiance`), in place of the directions of the
// views; and the weights of directions for the pixels' own samples (`_own_radiance`).
class alignas(64) SeenRadiance {
  public:
    SeenRadiance(const Tables& t, const LensSamples& samples, const HitRecord& record, const ViewRows& views, const OwnSamples& own,
                 const float* density, const ReusedGroups* groups, float* radiance)
        : t_(t), samples_(samples), record_(record), views_(views), own_(own), density_(density), groups_(groups), radiance_(radiance) {}

    void run() {
        for (int64_t end; first_ < views_.count; first_ = end) {
            source_ = views_.source[first_];
            for (end = first_; end < views_.count && views_.source[end] == source_;) ++end;
            count_ = int(end - first_);
            shade();
        }
    }

  private:
    static constexpr int VECTORS = MOST_MEMBERS / LANES;  // of views of a hit
    static constexpr int PATHS = PathDirections::PATHS;  // shaded together
    const Tables& t_;
    const LensSamples& samples_;
    const HitRecord& record_;
    const ViewRows& views_;
    const OwnSamples& own_;
    const float* density_;
    const ReusedGroups* groups_;
    float* radiance_;
    int64_t first_ = 0;
    int32_t source_ = 0;
    int count_ = 0;
    Vec3 light_[VECTORS], values_[PATHS][2][VECTORS], parts_[bokehguide::MOST_LIGHT_GROUPS][VECTORS];
    float ratio_[PATHS][2];  // weight of a direction over that of the lens point

    int vectors() const { return (count_ + LANES - 1) / LANES; }

    // All views of one hit.
    void shade() {
        const int32_t hit = views_.place[source_];
        for (int v = 0; v < vectors(); ++v) begin(v, hit);
        if (hit >= 0 && views_.scale[source_] > 0.0f) {
            const int32_t start = record_.light.first_path[hit], end = start + record_.light.paths[hit];
            for (int32_t path = start; path < end; path += PATHS) reflect(hit, path, end - path < PATHS ? int(end - path) : PATHS);
        }
        for (int lane = 0; lane < count_; ++lane) {
            const Vec3& light = light_[lane / LANES];
            float* const to = views_.outgoing + first_ + lane;
            to[0] = light.x[lane % LANES], to[views_.columns] = light.y[lane % LANES], to[2 * views_.columns] = light.z[lane % LANES];
        }
        if (groups_ != nullptr) add_groups();
    }
    // Emission, or radiance from infinity.
    void begin(int v, int32_t hit) {
        for (int group = 0; groups_ != nullptr && group < groups_->count; ++group) {
            const float* const own = groups_->own + 3 * group * samples_.count + source_;
            parts_[group][v] = hit >= 0 ? grey(all(0.0f)) : Vec3{all(own[0]), all(own[samples_.count]), all(own[2 * samples_.count])};
        }
        const float* const own = samples_.radiance + source_;
        light_[v] = {all(own[0]), all(own[samples_.count]), all(own[2 * samples_.count])};
        if (hit < 0) return;
        const int64_t columns = record_.light.hit_columns;
        const float* const emitted = record_.emission + hit;
        light_[v] = {all(emitted[0]), all(emitted[columns]), all(emitted[2 * columns])};
        if (!t_.plain_emission) {
            const Hits at = {all(record_.triangle[hit]), all(record_.distance[hit]), all(record_.u[hit]), all(record_.v[hit])};
            light_[v] = emission(t_, at, all(record_.light.surface[FRONT_ROW * columns + hit]), outgoing(v), all(-1));
        }
        if (groups_ != nullptr) parts_[groups_->materials[t_.triangles[record_.triangle[hit]].material]][v] = light_[v];
    }
    // Add the light of some paths of the hit.
    void reflect(int32_t hit, int32_t start, int paths) {
        const PathLight& of = record_.light;
        PathDirections directions;
        for (int v = 0; v < vectors(); ++v) {
            const RecordedScattering scattering(t_, of, hit, outgoing(v));
            if (v == 0) directions = scattering.directions(of, start, paths);
            for (int i = 0; i < paths; ++i) {
                for (int kind = 0; kind < 2; ++kind) {
                    if (is_lit(of, start + i, kind)) values_[i][kind][v] = scattering.evaluate(directions, PathDirections::lane(i, kind));
                }
            }
        }
        for (int i = 0; i < paths; ++i) weigh(start + i, i);
        for (int v = 0; v < vectors(); ++v) {
            for (int i = 0; i < paths; ++i) {
                Vec3 light = grey(all(0.0f));
                for (int kind = 0; kind < 2; ++kind) {
                    if (!is_lit(of, start + i, kind)) continue;
                    const Vec3 value = values_[i][kind][v] * all(ratio_[i][kind]);
                    light = light + value * incident_light(of, start + i, kind);
                    if (groups_ != nullptr) add_parts(start + i, kind, value, v);
                }
                light_[v] = light_[v] + light;
            }
        }
    }
    // The weights of the directions of a path, and the pixel's own sample with these weights.
    void weigh(int32_t path, int number) {
        const PathLight& of = record_.light;
        const float passed = own_.transmittance ? own_.transmittance[source_] : 1.0f, scale = views_.scale[source_];
        const float passing = samples_.weight[source_] > 0.0f ? own_.passing_at(source_) * passed : 0.0f;
        for (int kind = 0; kind < 2; ++kind) {
            if (!is_lit(of, path, kind)) continue;
            const auto at = [&](const float* rows, int channel) { return rows[(3 * kind + channel) * of.path_columns + path]; };
            const float own = luminance(Vec3{all(at(of.bsdf, 0)), all(at(of.bsdf, 1)), all(at(of.bsdf, 2))})[0];
            float sum = own_.density[source_] * passed * own;
            for (int v = 0; v < vectors(); ++v) {
                const Float seen = luminance(values_[number][kind][v]);
                for (int64_t view = first_ + v * LANES, i = 0; i < LANES && view < first_ + count_; ++view, ++i) {
                    sum += density_[view] * views_.jacobian[view] * seen[i];
                }
            }
            const float factor = sum > 0.0f ? own / sum : 0.0f, more = passing * (factor - scale);
            ratio_[number][kind] = factor / scale;
            for (int channel = 0; channel < 3; ++channel) {
                radiance_[channel * samples_.count + source_] += at(of.bsdf, channel) * at(of.incident, channel) * more;
                for (int group = 0; groups_ != nullptr && group < groups_->count; ++group) {
                    const float reflected = groups_->reflected[(6 * group + 3 * kind + channel) * of.path_columns + path];
                    if (at(of.bsdf, channel) > FAINTEST) groups_->radiance[(3 * group + channel) * samples_.count + source_] += reflected * more;
                }
            }
        }
    }
    // Add the radiance of light groups by way of one path and one kind of sample; value: BSDF times cosine and weight.
    void add_parts(int32_t path, int kind, Vec3 value, int v) {
        const int64_t columns = record_.light.path_columns;
        const float* const bsdf = record_.light.bsdf + 3 * kind * columns + path;
        const auto ratio = [&](Float x, float of) { return of > FAINTEST ? x / of : all(0.0f); };
        const Vec3 scale = {ratio(value.x, bsdf[0]), ratio(value.y, bsdf[columns]), ratio(value.z, bsdf[2 * columns])};
        for (int group = 0; group < groups_->count; ++group) {
            const float* const from = groups_->reflected + (6 * group + 3 * kind) * columns + path;
            if (from[0] == 0.0f && from[columns] == 0.0f && from[2 * columns] == 0.0f) continue;
            parts_[group][v] = parts_[group][v] + scale * Vec3{all(from[0]), all(from[columns]), all(from[2 * columns])};
        }
    }
    // Add the views to the groups where their light is finite, as in the sum of all groups.
    void add_groups() {
        for (int lane = 0; lane < count_; ++lane) {
            const int64_t view = first_ + lane;
            const int v = lane / LANES, at = lane % LANES;
            const float share = views_.passing[view] * views_.jacobian[view] * views_.scale[source_];
            const float all_groups[3] = {light_[v].x[at] * share, light_[v].y[at] * share, light_[v].z[at] * share};
            if (!std::isfinite(share)) continue;
            for (int group = 0; group < groups_->count; ++group) {
                const float channels[3] = {parts_[group][v].x[at], parts_[group][v].y[at], parts_[group][v].z[at]};
                float* const to = groups_->radiance + 3 * group * samples_.count + views_.viewer[view];
                for (int channel = 0; channel < 3; ++channel) {
                    const float seen = channels[channel] * share;
                    if (std::isfinite(seen) && std::isfinite(all_groups[channel])) to[channel * samples_.count] += seen;
                }
            }
        }
    }
    Vec3 outgoing(int v) const {
        Vec3 found;
        for (int lane = 0; lane < LANES; ++lane) {
            const int number = v * LANES + lane;
            const float* const from = views_.outgoing + first_ + (number < count_ ? number : count_ - 1);
            found.x[lane] = from[0], found.y[lane] = from[views_.columns], found.z[lane] = from[2 * views_.columns];
        }
        return found;
    }
};

inline void add_views(const Tables& t, const LensSamples& samples, const HitRecord& record, const ViewRows& views, const OwnSamples& own,
                      const float* density, const ReusedGroups* groups, float* radiance, float* weight) {
    const int64_t count = samples.count;
    float* const scale = views.scale;
    for (int64_t i = 0; i < count; ++i) scale[i] = own.density[i] * (own.transmittance ? own.transmittance[i] : 1.0f);
    for (int64_t view = 0; view < views.count; ++view) scale[views.source[view]] += density[view] * views.jacobian[view];
    for (int64_t i = 0; i < count; ++i) {
        scale[i] = scale[i] > 0.0f ? 1.0f / scale[i] : 0.0f;
        const float passing = own.passing_at(i) * (own.transmittance ? own.transmittance[i] : 1.0f);
        weight[i] = samples.weight[i] > 0.0f ? passing * scale[i] : 0.0f;
        for (int channel = 0; channel < 3; ++channel) radiance[channel * count + i] = samples.radiance[channel * count + i] * weight[i];
    }
    for (int row = 0; groups != nullptr && row < 3 * groups->count; ++row) {
        for (int64_t i = 0; i < count; ++i) groups->radiance[row * count + i] = groups->own[row * count + i] * weight[i];
    }
    SeenRadiance* const seen = new (std::align_val_t(64)) SeenRadiance(t, samples, record, views, own, density, groups, radiance);
    seen->run();
    operator delete(seen, std::align_val_t(64));
    for (int64_t first = 0; first < views.count; first += LANES) {
        const int size = views.count - first < LANES ? int(views.count - first) : LANES;
        const Int source = first_lanes(size) ? load<Int>(views.source + first) : all(0);
        const Float share = or_zero(load<Float>(views.passing + first) * load<Float>(views.jacobian + first) * gather(scale, source));
        const auto weighted = [&](int channel) { return or_zero(load<Float>(views.outgoing + channel * views.columns + first) * share); };
        const Float channels[3] = {weighted(0), weighted(1), weighted(2)};
        for (int lane = 0; lane < size; ++lane) {
            const int32_t viewer = views.viewer[first + lane];
            weight[viewer] += share[lane];
            for (int channel = 0; channel < 3; ++channel) radiance[channel * count + viewer] += channels[channel][lane];
        }
    }
}

}  // namespace BOKEHGUIDE_ISA
