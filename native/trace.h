// Whole paths: render/path_tracer.py, with the AOVs of primary hits, splits, and virtual images.
//
// Blocks of paths go from the camera to their ends, segment by segment. A block's arrays stay in the cache. What happens to a
// path depends on neither its block nor its lane.

#pragma once

#include <new>

#include "cluster_lights.h"
#include "images.h"
#include "light_groups.h"
#include "shadow_rays.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::SplitRecord;
using bokehguide::Trace;

// Rows of a `Surface`.
constexpr int NORMAL_ROW = 9, ALBEDO_ROW = 15;
constexpr int ROULETTE_DEPTH = 4, FETCHED_AHEAD = 2 * LANES;
constexpr float MAX_SURVIVAL = 0.95f, SHADOW_END = 1.0f - 1e-4f, MIN_CHANCE = 0.25f;
inline uint32_t crossing_dimension(int depth) { return (1u << 20) + MAX_CROSSINGS * uint32_t(depth); }

struct alignas(64) Block {
    // Paths that are alive.
    IntRow slot, key;
    // Of copies, until they leave their primary hits: see `PathKeys`.
    IntRow shared_key, member;
    Row throughput[3], radiance[3];
    // Their next segments, as `Rays` of paths.py has them.
    Row vertex[3], origin[3], direction[3], pdf, alive;
    // The hits of these, and the surfaces there.
    IntRow triangle;
    Row distance, u, v, surface[SURFACE_ROWS];
    // Light samples, and their shadow rays.
    Row contribution[3], weight, visibility, light_direction[3];
    IntRow light_triangle;
    ShadowRays shadow;
    // Which paths go on or met a surface, and which did not; places on the map of paths that leave the scene.
    IntRow kept, dropped;
    Row map_column, map_row;
    // Rays beyond translucent surfaces.
    Beyond beyond;
    // Primary hits that split, by their number in the block.
    IntRow hit_key;
    Row hit_throughput[3];
    // Virtual images of paths, by slot: the ray, the distance of the primary hit, whether the path met only mirrors and glass, and
    // ray transfers; images that light samples would have (0 for none), and the brightest image of each ray.
    IntRow ray, narrow;
    Row primary_distance, transfer[5], sample_image, brightest;
};

class Tracing {
  public:
    Tracing(const Tables& tables, Trace& arguments)
        : t(tables), trace(arguments), block(*new (std::align_val_t(64)) Block()),
          sequences(trace.random, uint32_t(trace.first_step), trace.lights ? trace.lights->light_candidates : 1,
                    trace.lights ? trace.lights->bsdf_candidates : 0) {}
    ~Tracing() { operator delete(&block, std::align_val_t(64)); }
    Tracing(const Tracing&) = delete;

    void run() {
        trace.rays = block.shadow.rays = 0;
        trace.embree_seconds = block.shadow.embree_seconds = 0.0;
        if (trace.split != nullptr) trace.split->hit_count = trace.split->path_count = 0;
        for (first = 0; first < trace.count; first += BLOCK) {
            begin();
            if (!arrive(1)) continue;
            if (trace.split != nullptr) {
                follow_splits();
            } else {
                follow();
            }
        }
        trace.rays += block.shadow.rays, trace.embree_seconds += block.shadow.embree_seconds;
    }

  private:
    const Tables& t;
    Trace& trace;
    Block& block;
    const HitSequences sequences;
    int64_t first = 0;
    int paths = 0;
    // Where paths add their radiance: rows `[3, columns]`, and rows of light groups, from the path with slot 0 on.
    float* collected = nullptr;
    GroupRows grouped{};
    int64_t columns = 0, base = 0;

    void begin() {
        Block& b = block;
        collected = trace.radiance, columns = trace.count, base = first;
        if (trace.groups != nullptr) grouped = {trace.groups->rays, columns, base, 3};
        paths = trace.count - first < BLOCK ? int(trace.count - first) : BLOCK;
        const size_t size = sizeof(float) * size_t(paths);
        for (int axis = 0; axis < 3; ++axis) {
            const int64_t row = axis * trace.count + first;
            std::memcpy(b.origin[axis], trace.origin + row, size);
            std::memcpy(b.vertex[axis], trace.origin + row, size);
            std::memcpy(b.direction[axis], trace.direction + row, size);
            float* const results[] = {trace.radiance, trace.normal, trace.albedo, trace.emission};
            for (float* result : results) std::memset(result + row, 0, size);
        }
        std::memcpy(b.key, trace.pixel_keys + first, size);
        if (trace.alive != nullptr) std::memcpy(b.alive, trace.alive + first, size);
        std::memset(trace.alpha + first, 0, size);
        for (int row = 0; row < 3 && trace.images != nullptr; ++row) std::memset(trace.images + row * trace.count + first, 0, size);
        std::memset(b.brightest, 0, sizeof b.brightest);
        for (int i = 0; i < paths; ++i) trace.distance[first + i] = MISS_DISTANCE, trace.triangle[first + i] = -1;
        for (int i = 0; i < paths; i += LANES) {
            store(b.slot + i, lane_numbers() + i);
            store3(b.throughput, i, grey(all(1.0f)));
            store3(b.radiance, i, grey(all(0.0f)));
            store(b.pdf + i, all(DELTA_PDF));
            if (trace.alive == nullptr) store(b.alive + i, all(1.0f));
        }
    }

    // Trace a segment; returns whether paths continue.
    bool arrive(int depth) {
        drop_ended();
        if (paths == 0) return false;
        find_nearest(depth);
        leave_scene(depth);
        if (paths == 0) return false;
        for (int i = 0; i < paths; i += LANES) fetch_triangles(i + FETCHED_AHEAD), meet(depth, i);
        if (depth == 1) report_primary_hits();
        if (depth == trace.max_depth) finish(paths);
        return depth < trace.max_depth;
    }
    // Scatter paths at the ends of their segments.
    void leave_surfaces(int depth) {
        PlannedLights later = choose_lights(depth, 0), next = later;
        LightChoice next_light = find_lights(0, later);
        later = choose_lights(depth, LANES);
        for (int i = 0; i < paths; i += LANES) {
            const LightChoice light = next_light;
            const LightSlots second = next.second;
            next_light = find_lights(i + LANES, later), next = later;
            later = choose_lights(depth, i + 2 * LANES);
            scatter(depth, i, light, second);
        }
        if (lit()) add_direct_light(depth);
    }
    // From the primary hits to the ends of the paths.
    void follow() {
        leave_surfaces(1);
        for (int depth = 2; arrive(depth); ++depth) leave_surfaces(depth);
    }

    // `Paths.split`: record the primary hits, then follow their paths, a block of them at a time.
    void follow_splits() {
        const SplitRecord& record = *trace.split;
        const int64_t first_hit = record.hit_count, first_path = record.path_count;
        record_hits();
        for (int64_t path = first_path; path < record.path_count; path += BLOCK) {
            load_paths(first_hit, path);
            follow();
        }
        for (int64_t path = first_path; path < record.path_count; ++path) {  // `SplitPaths.collect`
            const int64_t ray = record.ray[record.owner[path]];
            for (int channel = 0; channel < 3; ++channel) {
                const int64_t column = channel * record.path_columns + path;
                trace.radiance[channel * trace.count + ray] += record.direct[column] + record.indirect[column];
            }
            for (int row = 0; trace.groups != nullptr && row < 3 * trace.groups->count; ++row) {
                const float* const direct = trace.groups->reflected + (row + row / 3 * 3) * record.path_columns + path;
                trace.groups->rays[row * trace.count + ray] += direct[0] + direct[3 * record.path_columns];
            }
        }
    }

    void record_hits() {
        Block& b = block;
        SplitRecord& record = *trace.split;
        std::memcpy(b.hit_key, b.key, sizeof b.key), std::memcpy(b.hit_throughput, b.throughput, sizeof b.throughput);
        finish(paths);
        const size_t size = sizeof(float) * size_t(paths);
        const int64_t hits = record.hit_count;
        std::memcpy(record.triangle + hits, b.triangle, size), std::memcpy(record.distance + hits, b.distance, size);
        std::memcpy(record.u + hits, b.u, size), std::memcpy(record.v + hits, b.v, size);
        for (int row = 0; row < t.surface_rows; ++row) std::memcpy(record.surface + row * record.hit_columns + hits, b.surface[row], size);
        for (int row = 0; row < 3; ++row) std::memcpy(record.emission + row * record.hit_columns + hits, b.radiance[row], size);
        for (int i = 0; i < paths; ++i) {
            const int64_t hit = record.hit_count++, ray = first + b.slot[i];
            record.ray[hit] = int32_t(ray), record.paths[hit] = int32_t(record.counts[ray]);
            for (int number = 0; number < record.paths[hit]; ++number) record.owner[record.path_count++] = hit;
        }
    }

    // The next BLOCK paths of the record, at their primary hits; first_hit: of the block of rays.
    void load_paths(int64_t first_hit, int64_t first_path) {
        Block& b = block;
        const SplitRecord& record = *trace.split;
        collected = record.indirect, columns = record.path_columns, base = first_path;
        if (trace.groups != nullptr) grouped = {trace.groups->reflected + 3 * columns, columns, base, 6};
        paths = record.path_count - first_path < BLOCK ? int(record.path_count - first_path) : BLOCK;
        for (int i = 0; i < paths; ++i) {
            const int64_t path = first_path + i, hit = record.owner[path];
            int64_t before = path;
            while (before > 0 && record.owner[before - 1] == hit) --before;
            const uint32_t number = uint32_t(path - before), key = uint32_t(b.hit_key[hit - first_hit]);
            b.key[i] = copied(key, number), b.shared_key[i] = copied(key, number >> 1), b.member[i] = int32_t(number & 1);
            b.kept[i] = int32_t(hit - first_hit);
            b.slot[i] = i, b.ray[i] = int32_t(record.ray[hit] - first);
        }
        for (int i = paths; i % LANES != 0; ++i) b.kept[i] = 0;
        for (int i = 0; i < paths; i += LANES) load_hits(i, first_hit);
        for (int axis = 0; axis < 3; ++axis) {
            const int64_t row = axis * record.path_columns + base;
            std::memset(record.direct + row, 0, sizeof(float) * size_t(paths)), std::memset(record.bsdf + row, 0, sizeof(float) * size_t(paths));
            std::memcpy(record.light_direction + row, b.surface[NORMAL_ROW + axis], sizeof(float) * size_t(paths));
        }
    }
    // `PixelRandom.copies`.
    static int32_t copied(uint32_t key, uint32_t number) { return int32_t(number == 0 ? key : hash(key ^ hash(number))); }
    void load_hits(int i, int64_t first_hit) {
        Block& b = block;
        const SplitRecord& record = *trace.split;
        const Int hit = load<Int>(b.kept + i);
        const Float share = to_float(gather(record.paths + first_hit, hit)), distance = gather(record.distance + first_hit, hit);
        store(b.triangle + i, gather(record.triangle + first_hit, hit));
        store(b.distance + i, distance), store(b.primary_distance + i, distance);
        for (int row = 0; row < t.surface_rows; ++row) {
            store(b.surface[row] + i, gather(record.surface + row * record.hit_columns + first_hit, hit));
        }
        store3(b.throughput, i, gather3(b.hit_throughput, hit) / share), store3(b.radiance, i, grey(all(0.0f)));
        store(b.narrow + i, all(-1));
        for (int row = 0; row < 5; ++row) store(b.transfer[row] + i, all(row == 1 || row == 2 ? 0.0f : 1.0f));
    }

    // Add light that reaches some paths by way of their segments to the rows of its groups. triangle: -1 for lights at infinity.
    void add_to_groups(Int path, Vec3 light, Int triangle, Vec3 direction, Int arrives) {
        if (trace.groups == nullptr) return;
        BOKEHGUIDE_ISA::add_to_groups(t, *trace.groups, grouped, gather(block.slot, path), light, triangle, direction, arrives);
    }

    bool lit() const { return t.emitters > 0 || t.has_far_power; }

    // Whether light samples at the starts of segments come from the learned clusters.
    bool learned(int depth) const { return depth == 2 && trace.lights != nullptr; }

    // Add the radiance of the first paths to that of their rays.
    void finish(int count) {
        for (int i = 0; i < count; ++i) collect(i, 0.0f, 0.0f, 0.0f);
    }
    void collect(int path, float red, float green, float blue) {
        const float more[3] = {red, green, blue};
        for (int channel = 0; channel < 3; ++channel) {
            collected[channel * columns + base + block.slot[path]] = block.radiance[channel][path] + more[channel];
        }
    }

    // Sort paths by a condition into `kept` and `dropped`; returns the number kept.
    template <class Condition> int sort(Condition keeps) {
        int kept = 0, dropped = 0;
        for (int i = 0; i < paths; ++i) {
            const bool keep = keeps(i);
            block.kept[kept] = block.dropped[dropped] = i;
            kept += keep, dropped += !keep;
        }
        for (int i = kept; i < (kept + LANES - 1) / LANES * LANES; ++i) block.kept[i] = 0;
        for (int i = dropped; i < (dropped + LANES - 1) / LANES * LANES; ++i) block.dropped[i] = 0;
        return kept;
    }
    template <class T> void compact(T (&row)[ROW], int count) {
        for (int i = 0; i < count; i += LANES) store(row + i, gather(row, load<Int>(block.kept + i)));
    }
    template <int N> void compact(Row (&rows)[N], int count) {
        for (Row& row : rows) compact(row, count);
    }
    // Keep the first `count` of `kept`.
    void keep(int count, bool with_hits) {
        Block& b = block;
        compact(b.slot, count), compact(b.key, count), compact(b.throughput, count), compact(b.radiance, count);
        compact(b.vertex, count), compact(b.origin, count), compact(b.direction, count), compact(b.pdf, count);
        if (with_hits) compact(b.triangle, count), compact(b.distance, count), compact(b.u, count), compact(b.v, count);
        paths = count;
    }

    // End paths that are not alive. Throughputs of NaN make their radiance NaN.
    void drop_ended() {
        const int going = sort([&](int i) { return block.alive[i] > 0.0f; });
        if (going == paths) return;
        for (int i = 0; i < paths - going; ++i) {
            const int path = block.dropped[i];
            collect(path, 0.0f * block.throughput[0][path], 0.0f * block.throughput[1][path], 0.0f * block.throughput[2][path]);
        }
        keep(going, false);
    }

    template <class Work> void in_embree(int rays, Work work) {
        const double begun = bokehguide::seconds();
        work();
        trace.embree_seconds += bokehguide::seconds() - begun;
        trace.rays += rays;
    }

    void find_nearest(int depth) {
        Block& b = block;
        const RayRows rays(b.origin[0], b.direction[0], ROW, nullptr);
        in_embree(paths, [&] { nearest(t.tracer, rays, {b.triangle, b.distance, b.u, b.v}, paths); });
        if (t.translucent != nullptr) go_beyond_translucent(depth);
    }

    Hits hits_of(Int path) const {
        return {gather(block.triangle, path), gather(block.distance, path), gather(block.u, path), gather(block.v, path)};
    }

    // Paths go on from translucent surfaces with probability 1 - opacity.
    void go_beyond_translucent(int depth) {
        Block& b = block;
        Beyond& rays = b.beyond;
        int count = paths;
        for (int i = 0; i < paths; ++i) rays.ray[i] = i, rays.last[i] = -1;
        for (uint32_t crossing = 0; crossing < MAX_CROSSINGS; ++crossing) {
            count = keep_if(rays.ray, count, [&](int path) {
                return b.triangle[path] >= 0 && t.is_translucent[t.triangles[b.triangle[path]].material];
            });
            int going = 0;
            for (int i = 0; i < count; i += LANES) {
                const Int active = first_lanes(count - i), path = load<Int>(rays.ray + i);
                const Hits hit = valid(hits_of(path), active);
                const Float number = uniform(trace.random, bits<Bits>(gather(b.key, path)), crossing_dimension(depth) + crossing);
                const Int again = hit.triangle == gather(rays.last, path);
                const unsigned on = lanes(((number >= opacity(t, hit, active)) | again) & active);
                Vec3 start;
                const Float further = just_beyond(gather3(b.origin, path), gather3(b.direction, path), hit.distance, again, start);
                for (int lane = 0; lane < LANES; ++lane) {
                    if (!(on >> lane & 1)) continue;
                    rays.last[path[lane]] = hit.triangle[lane];
                    rays.set(going++, path[lane], start, lane, further[lane], b.direction);
                }
            }
            count = going;
            if (count == 0) break;
            in_embree(count, [&] { rays.find(t.tracer, count, nullptr); });
            for (int i = 0; i < count; ++i) {
                const int path = rays.ray[i];
                b.triangle[path] = rays.triangle[i], b.u[path] = rays.u[i], b.v[path] = rays.v[i];
                b.distance[path] = rays.distance[i] + rays.start[i];
            }
        }
    }

    // Paths that meet nothing end in the environment.
    void leave_scene(int depth) {
        Block& b = block;
        const int met = sort([&](int i) { return b.triangle[i] >= 0; }), missed = paths - met;
        if (missed == 0) return;
        if (t.has_environment) fetch_sky(0, missed), fetch_sky(LANES, missed);
        for (int i = 0; i < missed && t.has_environment; i += LANES) fetch_sky(i + FETCHED_AHEAD, missed), add_environment(depth, i, missed);
        for (int i = 0; i < missed; ++i) collect(b.dropped[i], 0.0f, 0.0f, 0.0f);
        keep(met, true);
    }

    // Find the places on the map of a vector of paths, and ask for the texels there.
    void fetch_sky(int i, int missed) {
        if (i >= missed) return;
        const MapDirection at = on_map(t, gather3(block.direction, load<Int>(block.dropped + i)));
        store(block.map_column + i, at.column), store(block.map_row + i, at.row);
        if (t.map_texels != nullptr) TexelCorners(t, at).fetch(t);
    }
    void add_environment(int depth, int i, int missed) {
        Block& b = block;
        const Int path = load<Int>(b.dropped + i);
        if (depth == 1 && !t.visible_environment) return;
        const MapDirection at = {gather3(b.direction, path), load<Float>(b.map_column + i), load<Float>(b.map_row + i)};
        Vec3 light = gather3(b.throughput, path) * environment_radiance(t, at);
        if (depth > 1) {
            const BsdfWeights weights = environment_weights(depth, gather3(b.vertex, path), at, gather(b.pdf, path));
            subtract_broad(depth, path, light, weights, first_lanes(missed - i));
            light = light * weights.weight;
            add_images(path, light, all(MISS_DISTANCE), first_lanes(missed - i));
        }
        add_to_groups(path, light, all(-1), at.direction, first_lanes(missed - i));
        light = gather3(b.radiance, path) + light;
        const Float alpha = environment_alpha(t, at.direction);
        for (int lane = 0; lane < LANES && i + lane < missed; ++lane) {
            b.radiance[0][path[lane]] = light.x[lane];
            b.radiance[1][path[lane]] = light.y[lane];
            b.radiance[2][path[lane]] = light.z[lane];
            if (depth == 1) trace.alpha[first + b.slot[path[lane]]] = alpha[lane];
        }
    }

    // MIS weights of BSDF samples that leave the scene.
    BsdfWeights environment_weights(int depth, Vec3 vertex, const MapDirection& at, Float pdf) const {
        if (!learned(depth)) return {power_heuristic(pdf, environment_pdf(t, vertex, at)), all(0.0f)};
        return ClusterSampler(t, *trace.lights, vertex, all(-1)).environment_weights(at, pdf);
    }
    // `LightSampleRecorder.broad_light`.
    void subtract_broad(int depth, Int path, Vec3 light, const BsdfWeights& weights, Int arrives) {
        if (!learned(depth)) return;
        const Float broad = luminance(light * weights.broad);
        for (int lane = 0; lane < LANES; ++lane) {
            if (arrives[lane]) trace.split->light_difference[base + block.slot[path[lane]]] -= broad[lane];
        }
    }

    // Ask for the rows of the triangles that a vector of paths met.
    void fetch_triangles(int i) const {
        for (int lane = i; lane < i + LANES && lane < paths; ++lane) __builtin_prefetch(t.triangles + block.triangle[lane]);
    }
    // Surfaces, absorption on the way there, and emission from there.
    void meet(int depth, int i) {
        Block& b = block;
        const Int active = first_lanes(paths - i);
        const Hits hit = valid({load<Int>(b.triangle + i), load<Float>(b.distance + i), load<Float>(b.u + i), load<Float>(b.v + i)}, active);
        const Surface s = surface_at(t, load3(b.origin, i), load3(b.direction, i), hit, active);
        store_surface(b.surface[0] + i, ROW, s, t.surface_rows);
        Vec3 throughput = load3(b.throughput, i);
        if (t.absorption != nullptr) {
            throughput = throughput * transmittance(t, hit, s.front);
            store3(b.throughput, i, throughput);
        }
        const Int emits = (gather(t.emissive, material_of(t, hit.triangle)) != 0) & active;
        if (!any(emits)) return;
        Vec3 light = throughput * emission(t, hit, s.front, s.outgoing, emits);
        if (depth > 1) {
            const Vec3 vertex = load3(b.vertex, i), offset = s.position - vertex;
            const Float distance = length(offset), cosine = dot(s.geometric_normal, offset) / divisor(distance);
            const BsdfWeights weights = triangle_weights(depth, vertex, hit.triangle, distance, cosine, load<Float>(b.pdf + i));
            subtract_broad(depth, lane_numbers() + i, light, weights, emits);
            light = light * weights.weight;
            add_images(lane_numbers() + i, light, distance, emits);
        }
        add_to_groups(lane_numbers() + i, light, hit.triangle, s.outgoing, emits);
        const Vec3 radiance = load3(b.radiance, i);
        store3(b.radiance, i, choose(emits, radiance + light, radiance));
    }

    // MIS weights of BSDF samples that meet triangles.
    BsdfWeights triangle_weights(int depth, Vec3 vertex, Int triangle, Float distance, Float cosine, Float pdf) const {
        if (!learned(depth)) return {power_heuristic(pdf, triangle_pdf(t, vertex, triangle, distance, cosine)), all(0.0f)};
        return ClusterSampler(t, *trace.lights, vertex, all(-1)).triangle_weights(triangle, distance, cosine, pdf);
    }

    void report_primary_hits() {
        const Block& b = block;
        for (int i = 0; i < paths; ++i) {
            const int64_t ray = first + b.slot[i];
            trace.distance[ray] = b.distance[i], trace.triangle[ray] = b.triangle[i], trace.alpha[ray] = 1.0f;
        }
        for (int axis = 0; axis < 3; ++axis) {
            report(b.surface[NORMAL_ROW + axis], trace.normal, axis), report(b.surface[ALBEDO_ROW + axis], trace.albedo, axis);
            report(b.radiance[axis], trace.emission, axis);
        }
    }
    void report(const Row& values, float* rows, int axis) const {
        float* const row = rows + axis * trace.count + first;
        for (int i = 0; i < paths; ++i) row[block.slot[i]] = values[i];
    }

    // Uniform numbers of N dimensions; those of primary hits are of a sequence.
    template <int N> void numbers(int depth, uint32_t offset, const Stratified& sequence, const PathKeys& keys, Float (&out)[N]) const {
        for (int i = 0; i < N; ++i) {
            out[i] = depth == 1 ? sequence(keys, i) : uniform(trace.random, keys.own, vertex_dimension(depth) + offset + uint32_t(i));
        }
    }
    PathKeys path_keys(int depth, int i) const {
        const Bits own = bits<Bits>(load<Int>(block.key + i));
        if (depth > 1 || trace.split == nullptr) return {own, own, Bits{}};
        return {own, bits<Bits>(load<Int>(block.shared_key + i)), bits<Bits>(load<Int>(block.member + i))};
    }

    // Choices of the first light of a vector of paths, and of the second one among learned clusters.
    struct PlannedLights {
        LightSlots first, second;
    };
    // Choose lights up to the entries of alias tables, and ask for their memory.
    PlannedLights choose_lights(int depth, int i) const {
        if (!lit() || i >= paths) return PlannedLights();
        const Int active = first_lanes(paths - i);
        const PathKeys keys = path_keys(depth, i);
        const Vec3 point = load3(block.surface, i);
        if (depth == 1 && trace.lights != nullptr) {
            const ClusterSampler sampler(t, *trace.lights, point, active);
            const bool more = trace.lights->light_candidates > 1;
            return {sampler.choose_light(sequences.light(0), keys, 0), more ? sampler.choose_light(sequences.light(1), keys, 1) : LightSlots()};
        }
        Float u[LIGHT_COUNT];
        numbers(depth, LIGHT, sequences.light(0), keys, u);
        return {choose_light(t, PointQuery(t, point), u, active), LightSlots()};
    }
    LightChoice find_lights(int i, const PlannedLights& planned) const {
        return lit() && i < paths ? planned.first.find(t, trace.lights) : LightChoice();
    }

    // Sample lights and the BSDF; from ROULETTE_DEPTH on, play Russian roulette. choice, second: of lights.
    void scatter(int depth, int i, const LightChoice& choice, const LightSlots& second) {
        Block& b = block;
        const Int active = first_lanes(paths - i);
        const PathKeys keys = path_keys(depth, i);
        const Surface s = load_surface(b.surface[0] + i, ROW, t.surface_rows);
        Vec3 throughput = load3(b.throughput, i);
        Float part[1] = {all(0.0f)};
        if (t.has_transmission) numbers(depth, PART, sequences.part, keys, part);
        const Scattering scattering(t, s, part[0], throughput);
        if (lit()) {
            const Light light = direct_light(depth, i, s, scattering, choice, second, keys, active);
            if (trace.images != nullptr) prepare_image(i, s, light, active);
            if (depth == 1 && trace.split != nullptr) record(trace.split->bsdf, i, light.scattered.value);
            aim_shadow_ray(depth, i, s, throughput, light, keys);
        }
        Float scatter[SCATTER_COUNT], pdf;  // roulette; angle, radius and lobe of the BSDF sample
        numbers(depth, SCATTER, sequences.bsdf(0), keys, scatter);
        Vec3 weight, value;
        const Vec3 direction = scattering.sample(scatter[3], scatter[1], scatter[2], weight, pdf, value);
        if (depth == 1 && trace.split != nullptr) {
            record(trace.split->bsdf + 3 * trace.split->path_columns, i, value);
            record_directions(i, direction, pdf, active);
        }
        if (trace.images != nullptr) transfer_through(i, s, direction, pdf, active);
        throughput = throughput * weight;
        Float survival = largest(throughput);
        if (depth >= ROULETTE_DEPTH) {
            const Float chance = at_most(survival, MAX_SURVIVAL);
            survival = chance * one_if(scatter[0] < chance);
            throughput = throughput / divisor(chance, 1e-20f);
        }
        store3(b.throughput, i, throughput);
        store3(b.vertex, i, s.position), store3(b.origin, i, leave(s, direction)), store3(b.direction, i, direction);
        store(b.pdf + i, pdf), store(b.alive + i, survival);
    }

    // A light sample without shadow: its direction, distance and reflected radiance, and the BSDF and its density there.
    struct Light {
        Vec3 direction;
        Float distance;
        Vec3 value;
        Scattered scattered;
        Int triangle;
    };

    Light direct_light(int depth, int i, const Surface& s, const Scattering& scattering, const LightChoice& choice,
                       const LightSlots& second, const PathKeys& keys, Int active) {
        if (depth == 1 && trace.lights != nullptr) {
            const ClusterSampler sampler(t, *trace.lights, s.position, active);
            const DirectLight found = sampler.sample(scattering, choice, second, sequences, trace.random, keys);
            record_light(i, found);
            return {found.direction, found.distance, found.value, found.scattered, found.triangle};
        }
        const LightSample light = sample_light(t, s.position, choice, active);
        const Scattered found = scattering.evaluate(light.direction);
        const Float weight = power_heuristic(light.pdf, found.pdf) / divisor(light.pdf);
        return {light.direction, light.distance, found.value * light.radiance * weight, found, light.triangle};
    }

    void aim_shadow_ray(int depth, int i, const Surface& s, Vec3 throughput, const Light& light, const PathKeys& keys) {
        Block& b = block;
        Vec3 contribution = throughput * light.value;
        if (trace.shadow_threshold != nullptr) contribution = contribution * roulette_factor(depth, i, largest(contribution), light.scattered.pdf, keys);
        const Vec3 origin = leave(s, light.direction), target = light.direction - (origin - s.position) / light.distance;
        const Float stretch = length(target);
        store3(b.contribution, i, contribution), store(b.weight + i, largest(contribution));
        b.shadow.aim(i, origin, target / stretch, light.distance * stretch * SHADOW_END);
        if (trace.split != nullptr || trace.groups != nullptr) store3(b.light_direction, i, light.direction), store(b.light_triangle + i, light.triangle);
    }

    // `roulette_factor` of shadow_roulette.py, and `DirectLight.thinned`.
    Float roulette_factor(int depth, int i, Float light, Float bsdf_pdf, const PathKeys& keys) {
        const Int slot = load<Int>(block.slot + i), active = first_lanes(paths - i);
        const Int ray = trace.split != nullptr ? gather(block.ray, active ? slot : all(0)) : slot;
        const Float threshold = gather(trace.shadow_threshold + first, active ? ray : all(0));
        const Float chance = ((light > all(0.0f)) & (bsdf_pdf <= all(NARROW))) ? clamp(light / divisor(threshold), MIN_CHANCE, 1.0f) : all(1.0f);
        const Float factor = one_if(uniform(trace.random, keys.own, vertex_dimension(depth) + SHADOW) < chance) / chance;
        if (depth == 1 && trace.lights != nullptr) {
            for (int lane = 0; lane < LANES && i + lane < paths; ++lane) {
                const int64_t path = base + i + lane;
                if (!(factor[lane] > 0.0f)) trace.split->light_cluster[path] = -1;
                trace.split->light_rms[path] *= __builtin_sqrtf(factor[lane]);
            }
        }
        return factor;
    }

    // Records of paths at their primary hits, where slots are places.
    template <class V, class T> void record(T* row, int i, V values) const {
        if (i + LANES <= paths) return store(row + base + i, values);
        for (int lane = 0; i + lane < paths; ++lane) row[base + i + lane] = values[lane];
    }
    void record(float* rows, int i, Vec3 v) const {
        const int64_t next = trace.split->path_columns;
        record(rows, i, v.x), record(rows + next, i, v.y), record(rows + 2 * next, i, v.z);
    }
    void record_light(int i, const DirectLight& light) const {
        record(trace.split->light_row, i, light.row), record(trace.split->light_cluster, i, light.cluster);
        record(trace.split->light_rms, i, light.contribution_rms), record(trace.split->light_difference, i, light.broad);
    }
    void record_directions(int i, Vec3 direction, Float pdf, Int active) const {
        record(trace.split->scattered_direction, i, direction);
        const Int narrow = active & (pdf > all(NARROW));
        if (trace.images == nullptr || !any(narrow)) return;
        for (int lane = 0; lane < LANES; ++lane) {
            if (narrow[lane]) trace.images[2 * trace.count + first + block.ray[i + lane]] = 1.0f;
        }
    }
    void record_direct() {
        const Block& b = block;
        for (int i = 0; i < paths; i += LANES) {
            const Float visibility = load<Float>(b.visibility + i);
            record(trace.split->direct, i, load3(b.contribution, i) * visibility);
            record(trace.split->light_direction, i, load3(b.light_direction, i));
            if (trace.lights != nullptr) record(trace.split->light_visibility, i, visibility);
        }
        if (trace.groups != nullptr) group_light_samples({trace.groups->reflected, trace.split->path_columns, base, 6}, true);
        for (int i = 0; i < paths && trace.lights != nullptr; ++i) {
            const float light = 0.2126f * b.contribution[0][i] + 0.7152f * b.contribution[1][i] + 0.0722f * b.contribution[2][i];
            trace.split->light_rms[base + i] *= b.visibility[i], trace.split->light_difference[base + i] *= light * b.visibility[i];
        }
    }

    // Add the light samples to rows of their groups. in_order: columns are paths, not slots.
    void group_light_samples(const GroupRows& rows, bool in_order) {
        const Block& b = block;
        for (int i = 0; i < paths; i += LANES) {
            const Vec3 light = load3(b.contribution, i) * load<Float>(b.visibility + i);
            const Int column = in_order ? lane_numbers() + i : load<Int>(b.slot + i), triangle = load<Int>(b.light_triangle + i);
            BOKEHGUIDE_ISA::add_to_groups(t, *trace.groups, rows, column, light, triangle, load3(b.light_direction, i), first_lanes(paths - i));
        }
    }

    // ------------------------------------------------------------------------------------------------ virtual images

    RayTransfer transfer_of(Int slot) const {
        const Row* rows = block.transfer;
        return {gather(rows[0], slot), gather(rows[1], slot), gather(rows[2], slot), gather(rows[3], slot), gather(rows[4], slot)};
    }
    Hits hits_at(int i, Int active) const {
        return valid({load<Int>(block.triangle + i), load<Float>(block.distance + i), all(0.0f), all(0.0f)}, active);
    }

    // Images of light samples at eight vertices.
    void prepare_image(int i, const Surface& s, const Light& light, Int active) {
        const Int slot = load<Int>(block.slot + i), shows = active & gather(block.narrow, slot) & (light.scattered.pdf > all(NARROW));
        Float image = all(0.0f);
        if (any(shows)) {
            const Hits hit = hits_at(i, active);
            const RayTransfer at = propagate_through(t, transfer_of(slot), hit.distance, hit.triangle, s, light.direction);
            image = shows ? image_distance(at, light.distance) : image;
        }
        store(block.sample_image + i, image);
    }

    // Follow a vector of paths through a mirror or glass; other paths show no image from here on.
    void transfer_through(int i, const Surface& s, Vec3 direction, Float pdf, Int active) {
        Block& b = block;
        const Int slot = load<Int>(b.slot + i), narrow = active & gather(b.narrow, slot), goes_on = narrow & (pdf > all(NARROW));
        if (!any(narrow)) return;
        for (int lane = 0; lane < LANES && i + lane < paths; ++lane) b.narrow[slot[lane]] = goes_on[lane];
        if (!any(goes_on)) return;
        const Hits hit = hits_at(i, active);
        const RayTransfer at = propagate_through(t, transfer_of(slot), hit.distance, hit.triangle, s, direction);
        for (int lane = 0; lane < LANES; ++lane) {
            if (!goes_on[lane]) continue;
            const float rows[5] = {at.a[lane], at.b[lane], at.c[lane], at.d[lane], at.index[lane]};
            for (int row = 0; row < 5; ++row) b.transfer[row][slot[lane]] = rows[row];
        }
    }

    // Light that arrives along some paths from a distance beyond the last vertex.
    void add_images(Int path, Vec3 light, Float distance, Int arrives) {
        if (trace.images == nullptr) return;
        const Int slot = gather(block.slot, path), shows = arrives & gather(block.narrow, slot) & (largest(light) > all(0.0f));
        if (!any(shows)) return;
        const Float image = image_distance(transfer_of(slot), distance), bright = luminance(light);
        for (int lane = 0; lane < LANES; ++lane) {
            if (shows[lane]) add_image(slot[lane], image[lane], bright[lane]);
        }
    }
    void add_image(int slot, float image, float light) {
        Block& b = block;
        const int ray = b.ray[slot];
        if (!(image > LEAST_SHARE * b.primary_distance[slot])) return;
        float* const found = trace.images + first + ray;
        found[0] += light;
        if (light >= b.brightest[ray]) b.brightest[ray] = light, found[trace.count] = image;
    }
    void add_sampled_images() {
        const Block& b = block;
        for (int i = 0; i < paths; ++i) {
            if (!(b.sample_image[i] > 0.0f && b.visibility[i] > 0.0f)) continue;
            const float* const channels[3] = {b.contribution[0], b.contribution[1], b.contribution[2]};
            float light[3], brightest = 0.0f;
            for (int channel = 0; channel < 3; ++channel) {
                light[channel] = channels[channel][i] * b.visibility[i];
                brightest = light[channel] > brightest ? light[channel] : brightest;
            }
            if (brightest > 0.0f) add_image(b.slot[i], b.sample_image[i], 0.2126f * light[0] + 0.7152f * light[1] + 0.0722f * light[2]);
        }
    }

    // ------------------------------------------------------------------------------------------------ shadow rays

    // Add the light samples that are not blocked, as far as translucent surfaces let them pass.
    void add_direct_light(int depth) {
        Block& b = block;
        const int traced = sort([&](int i) { return b.weight[i] > 0.0f; });
        for (int i = 0; i < paths; i += LANES) store(b.visibility + i, all(0.0f));
        if (traced < paths) compact(b.shadow.origin, traced), compact(b.shadow.direction, traced), compact(b.shadow.length, traced);
        b.shadow.trace(t, traced, false);
        for (int i = 0; i < traced; ++i) b.visibility[b.kept[i]] = b.shadow.passes[i];
        if (trace.images != nullptr) add_sampled_images();
        if (depth == 1 && trace.split != nullptr) return record_direct();
        if (trace.groups != nullptr) group_light_samples(grouped, false);
        for (int i = 0; i < paths; i += LANES) {
            store3(b.radiance, i, load3(b.radiance, i) + load3(b.contribution, i) * load<Float>(b.visibility + i));
        }
    }
};

}  // namespace BOKEHGUIDE_ISA
