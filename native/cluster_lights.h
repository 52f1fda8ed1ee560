// Learned light sampling at primary hits: guiding/cluster_lights.py, light_sampler.py and render/lights/light_clusters.py.

#pragma once

#include "hit_sequences.h"
#include "lights.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::ClusterLights;

constexpr float VOXEL_SHARE = 0.125f;
constexpr uint32_t CANDIDATE_CHOICE = 1u << 16;  // random dimension

// `LearnedLightSampler.tiles`.
inline Int tile_of(const ClusterLights& c, Vec3 point) {
    const Vec3 offset = point - Vec3{all(c.position[0]), all(c.position[1]), all(c.position[2])};
    const auto local = [&](int axis) { return c.axes[axis] * offset.x + c.axes[3 + axis] * offset.y + c.axes[6 + axis] * offset.z; };
    const auto place = [&](Float x, float last) {
        x = x / c.tile_size;
        const Int finite = (bits<Int>(x) & 0x7f800000) != 0x7f800000;
        return to_int(clamp(finite ? x : all(0.0f), 0.0f, last));
    };
    const Float scale = 1.0f / (local(2) * c.pixel_slope);
    const Int column = place(c.half_width + local(0) * scale, c.last_column), row = place(c.half_height - local(1) * scale, c.last_row);
    return row * c.across + column;
}

inline Int bytes_at(const uint8_t* table, Int index) {
    Int found;
    for (int lane = 0; lane < LANES; ++lane) found[lane] = table[index[lane]];
    return found;
}

// `ClusterSample`.
struct ClusterSample {
    LightSample light;
    Int cluster;
    Float share;
};

struct DirectLight {
    Vec3 direction;
    Float distance;
    Vec3 value;
    Scattered scattered;
    Int triangle, row, cluster;
    Float contribution_rms, broad;
};

constexpr float BROAD = 16.0f, MAX_UNIFORM = 0x1.fffffep-1f;

// `mis.broad_share`.
inline Float broad_share(Float pdf, Float bsdf_pdf) {
    const Float ratio = pdf / (BROAD * divisor(bsdf_pdf));
    return 1.0f / (1.0f + ratio * ratio);
}

// `BsdfWeights`.
struct BsdfWeights {
    Float weight, broad;
};

// Light samples at a vector of surfaces; active: lanes that count.
class ClusterSampler {
  public:
    ClusterSampler(const Tables& tables, const ClusterLights& lights, Vec3 point, Int active)
        : t(tables), c(lights), query(tables, point), row(tile_of(lights, point)), active(active),
          factor(lights.factor == nullptr ? all(1.0f) : gather(lights.factor, row)) {}

    // Choose the light of candidate `number`, and ask for the entries of alias tables.
    LightSlots choose_light(const Stratified& sequence, const PathKeys& keys, int number) const {
        Float u[LIGHT_COUNT];
        for (int i = 0; i < int(LIGHT_COUNT); ++i) u[i] = sequence(keys, i);
        u[0] = at_most((u[0] + float(number)) / float(c.light_candidates), MAX_UNIFORM);
        const LightSlots slots = choice_by(u);
        slots.fetch(t, &c);
        return slots;
    }

    // `ResampledLights.sample`; first: the light of the first candidate; second: the choice of the next one, if there is one.
    DirectLight sample(const Scattering& scattering, const LightChoice& first, const LightSlots& second, const HitSequences& sequences,
                       const Random& random, const PathKeys& keys) const {
        LightChoice next = first;
        LightSlots later = second;
        BsdfSample next_sample = c.bsdf_candidates > 0 ? sample_bsdf(scattering, sequences.bsdf(1), keys) : BsdfSample();
        const auto light_of = [&](int number) {
            const LightChoice choice = next;
            if (number + 1 < c.light_candidates) next = later.find(t, &c), fetch_visibility(next);
            if (number + 2 < c.light_candidates) later = choose_light(sequences.light(number + 2), keys, number + 2);
            return light_candidate(scattering, choice);
        };
        Candidate kept = light_of(0);
        Float total = kept.target;
        const auto consider = [&](const Candidate& other, int number) {
            total = total + other.target;
            const Int changes = uniform(random, keys.own, CANDIDATE_CHOICE + uint32_t(number)) * total < other.target;
            kept = choose_candidate(changes, other, kept);
        };
        for (int number = 1; number < c.light_candidates; ++number) consider(light_of(number), number);
        for (int number = 1; number <= c.bsdf_candidates; ++number) {
            const BsdfSample sample = next_sample;
            if (number < c.bsdf_candidates) next_sample = sample_bsdf(scattering, sequences.bsdf(number + 1), keys);
            consider(bsdf_candidate(sample), c.light_candidates - 1 + number);
        }
        const Float scale = total / (float(c.light_candidates) * divisor(kept.target));
        const Float contribution_rms = luminance(kept.value) * sqrt(kept.share * scale);
        return {kept.direction, kept.distance, kept.value * scale, kept.scattered, kept.triangle, row, kept.cluster, contribution_rms,
                kept.broad};
    }

    // `ResampledLights.environment_weights` and `triangle_weights`.
    BsdfWeights environment_weights(const MapDirection& at, Float pdf) const {
        const Float light = t.has_far_power ? density(at.direction, look_up(texel_at(t, at))) : all(0.0f);
        return with_factor(pdf, together(light, pdf));
    }
    BsdfWeights triangle_weights(Int triangle, Float distance, Float cosine, Float pdf) const {
        if (t.emitters == 0) return with_factor(pdf, all(0.0f));
        const Int emitter = emitter_of(t, triangle), known = emitter < 0 ? all(0) : emitter;
        const Float chosen = share(gather(&t.emitter_rows[0].cluster, known * 16)) * one_if(emitter >= 0);
        const Float light = chosen * emitter_field(t, known, 13) * distance * distance / divisor(abs(cosine), LEAST_COSINE);
        return with_factor(pdf, float(c.light_candidates) * light);
    }

  private:
    const Tables& t;
    const ClusterLights& c;
    PointQuery query;
    Int row, active;
    Float factor;

    // `BsdfWeights.with_factor`.
    BsdfWeights with_factor(Float pdf, Float light_pdf) const {
        const Float broad = power_heuristic(light_pdf, pdf) * broad_share(light_pdf, pdf);
        return {power_heuristic(pdf, light_pdf) + (1.0f - factor) * broad, broad};
    }
    // Density of all candidates together in directions of the map.
    Float together(Float light, Float bsdf_pdf) const { return float(c.light_candidates) * light + float(c.bsdf_candidates) * bsdf_pdf; }

    // `_Candidate`.
    struct Candidate {
        Vec3 direction;
        Float distance;
        Vec3 value;
        Scattered scattered;
        Int cluster, triangle;
        Float share, target, broad;
    };
    static Candidate choose_candidate(Int first, const Candidate& one, const Candidate& other) {
        return {choose(first, one.direction, other.direction), first ? one.distance : other.distance,
                choose(first, one.value, other.value),
                {choose(first, one.scattered.value, other.scattered.value), first ? one.scattered.pdf : other.scattered.pdf},
                first ? one.cluster : other.cluster, first ? one.triangle : other.triangle,
                first ? one.share : other.share, first ? one.target : other.target, first ? one.broad : other.broad};
    }
    Candidate light_candidate(const Scattering& scattering, const LightChoice& choice) const {
        const ClusterSample drawn = draw(choice);
        const LightSample& light = drawn.light;
        const Scattered found = scattering.evaluate(light.direction);
        const Float pdf = light.distance >= all(MISS_DISTANCE) ? together(light.pdf, found.pdf) : float(c.light_candidates) * light.pdf;
        const Candidate empty{light.direction, light.distance, {}, found, drawn.cluster, light.triangle, drawn.share, {}, {}};
        return weighed(empty, found.value * light.radiance / divisor(pdf), pdf, drawn.cluster);
    }
    // `ResampledLights._weighed`; light: reflected light over the density of all candidates, `pdf`.
    Candidate weighed(Candidate candidate, Vec3 light, Float pdf, Int cluster) const {
        const Float bsdf_pdf = candidate.scattered.pdf, broad = broad_share(pdf, bsdf_pdf), kept = 1.0f - (1.0f - factor) * broad;
        const Vec3 contribution = light * (power_heuristic(pdf, bsdf_pdf) * float(c.light_candidates));
        candidate.value = contribution * kept, candidate.target = luminance(contribution) * visibility(cluster);
        candidate.broad = broad / kept;
        return candidate;
    }
    // A direction of a BSDF candidate, and its texel.
    struct BsdfSample {
        Vec3 weight;
        Float pdf;
        MapDirection at;
        Int texel;
    };
    // Sample a BSDF candidate, and ask for the memory of its texel.
    BsdfSample sample_bsdf(const Scattering& scattering, const Stratified& sequence, const PathKeys& keys) const {
        BsdfSample sample;
        Vec3 of_opaque;
        sample.at = on_map(t, scattering.sample(sequence(keys, 3), sequence(keys, 1), sequence(keys, 2), sample.weight, sample.pdf, of_opaque));
        sample.texel = texel_at(t, sample.at);
        if (t.map_texels != nullptr) TexelCorners(t, sample.at).fetch(t);
        return sample;
    }
    Candidate bsdf_candidate(const BsdfSample& sample) const {
        const Texel texel = look_up(sample.texel);
        const Int cluster = c.first_texels + texel.cluster;
        const Float pdf = sample.pdf, of_all = together(density(sample.at.direction, texel), pdf);
        const Candidate empty{sample.at.direction, all(MISS_DISTANCE), {}, {sample.weight * pdf, pdf}, all(-1), all(-1), all(0.0f), {}, {}};
        return weighed(empty, sample.weight * environment_radiance(t, sample.at) * (pdf / divisor(of_all)), of_all, cluster);
    }
    // Ask for the visibility of clusters of triangles.
    void fetch_visibility(const LightChoice& choice) const {
        if (c.table.cumulative == nullptr) return;
        const Int place = row * c.clusters + choice.cluster;
        for (int lane = 0; lane < LANES; ++lane) __builtin_prefetch(c.visibility + place[lane]);
    }
    Float visibility(Int cluster) const {
        return c.table.cumulative == nullptr ? all(1.0f) : gather(c.visibility, row * c.clusters + cluster);
    }
    Float probability(Int cluster) const { return cluster_pdf(c.table, row, cluster); }

    // Texels of the map: their clusters, from 0 on, and their densities in the whole map and in their clusters.
    struct Texel {
        Int cluster;
        Float density, within;
    };
    Texel look_up(Int texel) const {
        if (c.texel_table == nullptr) return {all(0), map_density(t, texel), all(0.0f)};
        const Int cluster = bytes_at(c.texel_cluster, texel);
        const Float of_map = map_density(t, texel);
        return {cluster, of_map, of_map * gather(c.cluster_scale, cluster)};
    }

    // Probability of clusters of triangles, and density of directions in texels.
    Float share(Int cluster) const {
        const Float by_voxel = query.share(t, cluster);
        return c.table.cumulative == nullptr ? by_voxel : VOXEL_SHARE * by_voxel + (1.0f - VOXEL_SHARE) * probability(cluster);
    }
    Float density(Vec3 direction, const Texel& texel) const {
        const Float by_voxel = query.environment_share * environment_density(t, direction, texel.density);
        return c.table.cumulative == nullptr ? by_voxel : VOXEL_SHARE * by_voxel + (1.0f - VOXEL_SHARE) * table_density(direction, texel);
    }

    // The choice of `LearnedLightSampler.draw`.
    LightSlots choice_by(const Float (&u)[6]) const {
        Int cluster = all(0), by_voxel = all(-1), far = u[0] < query.environment_share;
        if (c.table.cumulative != nullptr) {
            by_voxel = u[0] < all(VOXEL_SHARE);
            cluster = sample_cluster(c.table, row, (u[0] - VOXEL_SHARE) / (1.0f - VOXEL_SHARE));
            far = by_voxel ? u[0] < VOXEL_SHARE * query.environment_share : cluster >= c.first_texels;
        }
        if (!t.has_far_power) far = all(0);
        if (t.emitters == 0) far = all(-1);
        LightSlots slots(far, all(0.0f), u);
        if (any(far & ~by_voxel & active)) choose_element(slots, far & ~by_voxel, within(cluster, c.first_texels, c.clusters - 1), u);
        if (any(far & by_voxel & active)) choose_environment(t, slots, far & by_voxel, u);
        if (!any(~far & active)) return slots;
        cluster = cluster < c.first_texels ? cluster : all(c.first_texels - 1);
        if (any(by_voxel)) cluster = by_voxel ? sample_cluster(t.clusters, query.cell, u[1]) : cluster;
        slots.set_near(t, cluster, share(cluster), u);
        return slots;
    }

    ClusterSample draw(const LightChoice& choice) const {
        const Int far = choice.far;
        if (!any(far & active)) return draw_triangle(choice, active);
        const ClusterSample sky = draw_environment(choice);
        if (!any(~far & active)) return sky;
        const ClusterSample near = draw_triangle(choice, active & ~far);
        const LightSample light = {choose(far, sky.light.direction, near.light.direction), far ? sky.light.distance : near.light.distance,
                                   choose(far, sky.light.radiance, near.light.radiance), far ? sky.light.pdf : near.light.pdf,
                                   far ? sky.light.triangle : near.light.triangle};
        return {light, far ? sky.cluster : near.cluster, far ? sky.share : near.share};
    }

    ClusterSample draw_triangle(const LightChoice& choice, Int drawn) const {
        const Int emitter = choice.far ? all(0) : choice.element;
        return {sample_triangle(t, query.point, emitter, choice.share, choice.place, drawn), choice.cluster, choice.share};
    }

    ClusterSample draw_environment(const LightChoice& choice) const {
        const Int element = choice.far ? choice.element : all(0);
        const MapDirection at = on_map(t, environment_direction(t, element, choice.place[0], choice.place[1]));
        const Texel texel = look_up(element_texel(t, element, at));
        const Float pdf = density(at.direction, texel);
        const LightSample light = {at.direction, all(MISS_DISTANCE), environment_radiance(t, at), pdf, all(-1)};
        return {light, cluster_of(element, texel), pdf / density_within(element, texel)};
    }

    // `LightClusters.sample_element`, `cluster`, `pdf_within` and `environment_pdf`. texel: of the element, if it is one.
    void choose_element(LightSlots& slots, Int chosen, Int cluster, const Float (&u)[6]) const {
        const Int distant = c.first_distant - 1 - cluster;
        if (c.texel_table == nullptr) return slots.set_far(chosen, distant, AliasSlots(), all(0));
        const Int number = within(cluster - c.first_texels, 0, c.map_clusters - 1), start = gather(c.texel_start, number);
        const AliasSlots texels(start, gather(c.texel_start, number + 1) - start, u[1], u[2]);
        slots.set_far(chosen, distant < 0 ? distant : all(0), texels, all(-1));
    }
    Int cluster_of(Int element, const Texel& texel) const {
        const Int distant = c.first_distant - 1 - element;
        return c.texel_table == nullptr ? distant : element < 0 ? distant : c.first_texels + texel.cluster;
    }
    Float density_within(Int element, const Texel& texel) const {
        Float density = texel.within;
        for (int number = 1; number <= t.distant_count; ++number) {
            density = element == -number ? all(t.distant[number - 1].density) : density;
        }
        return density;
    }
    Float table_density(Vec3 direction, const Texel& texel) const {
        Float density = c.texel_table == nullptr ? all(0.0f) : probability(c.first_texels + texel.cluster) * texel.within;
        for (int number = 0; number < t.distant_count; ++number) {
            const DistantTable& light = t.distant[number];
            density = density + probability(all(c.first_distant + number)) * light.density * contains(light, direction);
        }
        return density;
    }
};

}  // namespace BOKEHGUIDE_ISA
