// The film: `Film.add` of render/film.py with the feature estimators of render/features.py.

#pragma once

#include "lights.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::FilmSamples;
using bokehguide::FilmSums;

constexpr float NO_DEPTH = 1e10f;
constexpr int FEATURES = 9;

// A vector of pixels: consecutive from `first`, or any. Only the first `count` lanes are read and written.
struct PixelLanes {
    const int64_t* pixels;
    int64_t first;
    int count;

    int64_t at(int lane) const { return pixels == nullptr ? first + lane : pixels[lane]; }
    template <class V, class T> V get(const T* row) const {
        V found{};
        if (pixels == nullptr && count == LANES) return load<V>(row + first);
        for (int lane = 0; lane < count; ++lane) found[lane] = row[at(lane)];
        return found;
    }
    template <class V, class T> void put(T* row, V values) const {
        if (pixels == nullptr && count == LANES) return store(row + first, values);
        for (int lane = 0; lane < count; ++lane) row[at(lane)] = values[lane];
    }
    void add(double* row, Float values) const { put(row, get<Double>(row) + __builtin_convertvector(values, Double)); }
    void add(double* row, Double values) const { put(row, get<Double>(row) + values); }
    void add(float* row, Float values) const { put(row, get<Float>(row) + values); }
};


// `torch.lerp`.
inline Float lerp(Float start, Float end, Float weight) {
    const Float difference = end - start;
    return weight < all(0.5f) ? start + weight * difference : end - difference * (1.0f - weight);
}

// Adds a vector of samples; returns the lanes whose samples are finite.
inline Int expose(const FilmSums& film, const FilmSamples& s, const PixelLanes& lanes, const PixelLanes& samples, bool recenter) {
    const auto sample = [&](const float* row) { return samples.get<Float>(row); };
    Float weight = sample(s.weight);
    const Float scale = s.radiance_weight == nullptr ? weight : sample(s.radiance_weight), depth = sample(s.depth);
    Float value[3], emission[3], feature[FEATURES];
    for (int i = 0; i < 3; ++i) value[i] = sample(s.radiance + i * s.count) * scale;
    const Int good = finite((value[0] + value[1]) + value[2]) & finite(weight);
    const Float hit = one_if(depth < all(NO_DEPTH)), kept = one_if(good);
    feature[0] = sample(s.alpha), feature[1] = hit, feature[2] = depth * hit;
    for (int i = 0; i < 3; ++i) {
        feature[3 + i] = sample(s.normal + i * s.count), feature[6 + i] = sample(s.albedo + i * s.count);
        emission[i] = sample(s.emission + i * s.count);
    }
    weight = or_zero(weight);
    for (int i = 0; i < 3; ++i) value[i] = or_zero(value[i]), emission[i] = or_zero(emission[i]);
    for (Float& x : feature) x = or_zero(x);

    if (film.moments != nullptr) {  // the control variate
        const Float total = lanes.get<Float>(film.moments), square = weight * weight;
        for (int i = 0; i < FEATURES; ++i) {
            float *moment = film.moments + (1 + i) * film.pixels, *center = film.center + i * film.pixels;
            const Float so_far = lanes.get<Float>(moment);
            if (recenter) lanes.put(center, so_far / divisor(total));
            lanes.add(film.features + i * film.pixels, lerp(lanes.get<Float>(center), feature[i], weight) * kept);
            lanes.put(moment, so_far + feature[i] * square);
        }
        lanes.put(film.moments, total + square);
    } else {
        const Float factor = film.passed == nullptr ? kept : weight * kept;
        for (int i = 0; i < FEATURES; ++i) lanes.add(film.features + i * film.pixels, feature[i] * factor);
        if (film.passed != nullptr) lanes.add(film.passed, factor);
    }
    weight = weight * kept;
    Double light = {};
    const double weights[3] = {0.2126, 0.7152, 0.0722};
    for (int i = 0; i < 3; ++i) {
        value[i] = value[i] * kept;
        lanes.add(film.radiance + i * film.pixels, value[i]);
        lanes.add(film.emission + i * film.pixels, emission[i] * weight);
        light += weights[i] * __builtin_convertvector(value[i], Double);
    }
    lanes.add(film.square, light * light);
    lanes.add(film.count, kept);
    const Float nearest = lanes.get<Float>(film.nearest), farthest = lanes.get<Float>(film.farthest);
    lanes.put(film.nearest, min(nearest, depth));
    lanes.put(film.farthest, max(farthest, depth * hit));
    return good;
}

}  // namespace BOKEHGUIDE_ISA
