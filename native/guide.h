// What a batch reports to a guide of the lens: guiding/guide.py and guiding/emitter_guide.py.

#pragma once

#include "columns.h"
#include "film.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::Camera;
using bokehguide::EmitterDraws;
using bokehguide::GuideSamples;
using bokehguide::KnownEmission;
using bokehguide::MixtureSamples;
using bokehguide::PixelNumbers;
using bokehguide::RecordRaster;
using bokehguide::SuccessTiles;

inline Float luminance_of(Vec3 color) { return 0.2126f * color.x + 0.7152f * color.y + 0.0722f * color.z; }

// `Guide.records`.
inline void record_hits(const RecordRaster& r, const Camera& camera, int64_t count, const float* points, const float* directions,
                        const float* distance, const float* weight, float* positions, int64_t* cells) {
    const float* m = camera.axes;
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Float along = at(distance, 0);
        const Int hit = along < all(r.miss);
        const Vec3 origin = {at(points, 0) * one_if(hit), at(points, 1) * one_if(hit), all(0.0f)};
        const Vec3 d = at.vector(directions, 0);
        const Vec3 towards = {m[0] * d.x + m[3] * d.y + m[6] * d.z, m[1] * d.x + m[4] * d.y + m[7] * d.z, m[2] * d.x + m[5] * d.y + m[8] * d.z};
        const Vec3 position = origin + towards * (hit ? along : all(r.far));
        at.put(positions, 0, position);
        const Float scale = 1.0f / (position.z * r.pixel_slope), border = to_float(all(r.border));
        const Float column = floor(r.half_width + position.x * scale + border), row = floor(r.half_height - position.y * scale + border);
        const Float width = to_float(all(r.width)), height = to_float(all(r.height));
        const Int inside = (position.z > all(0.0f)) & (column >= all(0.0f)) & (column < width) & (row >= all(0.0f)) & (row < height);
        const Int counts = inside & (at(weight, 0) > all(0.0f));
        const Int x = to_int(counts ? column : all(0.0f)), y = to_int(counts ? row : all(0.0f));
        for (int lane = 0; lane < LANES && at.first + lane < count; ++lane) {
            cells[at.first + lane] = counts[lane] ? int64_t(y[lane]) * r.width + x[lane] : -1;
        }
    }
}

// `Guide.recorded_light`: luminance of the samples, 0 where they are not on the film, without the emission of known emitters.
inline void recorded_light(const GuideSamples& s, const KnownEmission& of, float* light) {
    for (Columns at(s.count); at.first < s.count; at.first += LANES) {
        Vec3 color = at.vector(s.radiance, 0);
        Float counts = one_if(at.flags(s.good));
        if (of.emission != nullptr) {
            const Int triangle = at.integers(of.triangle), hit = triangle >= 0;
            Int known;
            for (int lane = 0; lane < LANES; ++lane) known[lane] = hit[lane] && of.known[triangle[lane]] ? -1 : 0;
            color = color - at.vector(of.emission, 0) * one_if(known);
            if (of.whole_environment) counts = counts * one_if(hit);
        }
        at.put(light, 0, or_zero(luminance_of(color)) * counts);
    }
}

// `HighlightImages.reported`; images: light, distance of the image, and whether a path continues in a mirror or glass, `[3, N]`.
inline void apparent_distances(int64_t count, const float* radiance, const float* distance, const float* images, float bright, float miss,
                               float* found) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Float light = luminance_of(at.vector(radiance, 0));
        const Float own = ((at(images, 2) > all(0.0f)) & (light <= all(bright))) ? all(miss) : at(distance, 0);
        at.put(found, 0, ((light > all(bright)) & (at(images, 0) > 0.5f * light)) ? at(images, 1) : own);
    }
}

// `Guide._weights_and_ratios`: weights of the samples that are on the film, else 0; with a mixture, ratios L / (A q) as well, and
// figures: guided pixels, guided pixels whose sample transmits no light, Σ β, and the one-sample KL divergence.
inline void weigh_samples(const GuideSamples& s, const MixtureSamples& m, float* weights, float* ratios, double* figures) {
    for (Columns at(s.count); at.first < s.count; at.first += LANES) {
        const Float good = one_if(at.flags(s.good)), weight = or_zero(at(s.weight, 0)) * good;
        at.put(weights, 0, weight);
        if (m.density == nullptr) continue;
        const Float ratio = or_zero(luminance_of(at.vector(s.radiance, 0))) * good * weight / all(m.unit);
        at.put(ratios, 0, ratio);
        const Float density = m.area * at(m.density, 0), term = or_zero(ratio * logarithm(density)), beta = at(m.beta, 0);
        const Int guided = at.flags(m.guided), lost = guided & (weight == all(0.0f)), counts = (density > all(0.0f)) & (ratio > all(0.0f));
        for (int lane = 0; lane < LANES && at.first + lane < s.count; ++lane) {
            figures[0] -= guided[lane], figures[1] -= lost[lane], figures[2] += double(beta[lane]);
            if (counts[lane]) figures[3] -= double(term[lane]);
        }
    }
}

// `EmitterGuide.learn_from`: adds to moments `[2, pixels]`, and writes slot and squared contribution of each draw of an emitter.
// Returns the number of draws.
inline int64_t learn_emitters(const EmitterDraws& d, int64_t count, const PixelNumbers& pixels, int64_t frame, float* moments, int32_t* slots,
                              float* squares) {
    int64_t draws = 0;
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Float beta = at(d.beta, 0), given = at(d.ratio, 0), ratio = at_most(given, d.most);
        const Float share = beta * at(d.mixture, 0) / divisor(at(d.density, 0), 1e-37f), squared = ratio * ratio * one_if(beta > all(0.0f));
        const int lanes = count - at.first < LANES ? int(count - at.first) : LANES;
        const PixelLanes place = {pixels.numbers == nullptr ? nullptr : pixels.numbers + at.first, pixels.first + at.first, lanes};
        place.add(moments, squared * share * beta), place.add(moments + frame, squared * (1.0f - share) * (1.0f - beta));
        for (int lane = 0; lane < lanes; ++lane) {
            const int64_t chosen = d.candidate[at.first + lane];
            if (chosen < 0) continue;
            const float expected = d.contribution[chosen] * PI / d.area_of_unit;
            float found = given[lane] * (beta[lane] * d.weight[chosen]) / expected;
            found = found != found ? 0.0f : (found < d.most ? found : d.most);
            slots[draws] = d.slots[chosen], squares[draws] = found * found, ++draws;
        }
    }
    return draws;
}

// `SuccessRates.of_candidates`: slots and rates of the candidates of pixels; start: of the candidates of each pixel, `[N + 1]`.
inline void success_rates(const SuccessTiles& t, int64_t count, const PixelNumbers& pixels, const int64_t* start, const int64_t* components,
                          int32_t* slots, float* rates) {
    for (int64_t i = 0; i < count; ++i) {
        const int32_t number = int32_t(pixels.number(i)), row = number / t.width;
        const uint32_t tile = uint32_t(row / t.size * t.across + (number - row * t.width) / t.size);
        for (int64_t candidate = start[i]; candidate < start[i + 1]; ++candidate) {
            const int64_t component = components[candidate];
            const int32_t slot = int32_t(hash(tile * 0x165667B1u + uint32_t(component) * 0x27D4EB2Fu) & t.last_slot);
            slots[candidate] = component < t.emitters ? (slot > 1 ? slot : 1) : 0;
            rates[candidate] = t.rates[slots[candidate]];
        }
    }
}

}  // namespace BOKEHGUIDE_ISA
