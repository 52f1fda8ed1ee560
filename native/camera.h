// Random numbers, film positions, lens points and camera rays of pixels: render/random.py, render/camera.py and render/lens.py.

#pragma once

#include "columns.h"
#include "random.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::Camera;
using bokehguide::FilmFrame;
using bokehguide::PixelNumbers;

// The numbers of a vector of pixels.
inline Int numbers_of(const PixelNumbers& pixels, const Columns& at) {
    Int found;
    for (int lane = 0; lane < LANES; ++lane) found[lane] = int32_t(pixels.number(at.column(lane)));
    return found;
}

// `PixelRandom.pixel_keys`; seed: hash of the seed.
inline void pixel_keys(uint32_t seed, int64_t count, const PixelNumbers& pixels, int32_t* keys) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        at.put_integers(keys, bits<Int>(hash(bits<Bits>(numbers_of(pixels, at)) ^ seed)));
    }
}

// Numbers of `PixelRandom`; first: of the range of steps of stratified numbers, 0 for independent numbers. replaced: pixels whose
// numbers the function writes, null for all.
inline void random_numbers(const Random& random, int64_t count, const int32_t* pixels, uint32_t dimension, int numbers, int first,
                           int number, const int32_t* member, const uint8_t* replaced, float* out) {
    const Stratified sequence(random, dimension, first > 0 ? numbers : 0, uint32_t(first > 0 ? first : 1), uint32_t(number));
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Int written = replaced == nullptr ? all(-1) : at.flags(replaced);
        if (!any(written)) continue;
        const Bits pixel = bits<Bits>(at.integers(pixels));
        const PathKeys keys = {pixel, pixel, member == nullptr ? Bits{} : bits<Bits>(at.integers(member))};
        for (int i = 0; i < numbers; ++i) {
            const Float found = first > 0 ? sequence(keys, i) : uniform(random, pixel, dimension + uint32_t(i));
            at.put(out, i, replaced == nullptr ? found : (written ? found : at(out, i)));
        }
    }
}

// `ThinLensCamera.film_positions`; rows: raster positions `[2, N]`, positions within the pixel `[2, N]` and focus points `[3, N]`.
inline void film_positions(const FilmFrame& frame, const Random& random, uint32_t dimension, int64_t count, const PixelNumbers& pixels,
                           const int32_t* keys, float* rows) {
    const Stratified sequence(random, dimension, 2);
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Int number = numbers_of(pixels, at), row = number / frame.width;
        const Float left = to_float(number - row * frame.width), top = to_float(row);
        const Bits key = bits<Bits>(at.integers(keys));
        const Float x = left + sequence({key, key, Bits{}}, 0), y = top + sequence({key, key, Bits{}}, 1);
        at.put(rows, 0, x), at.put(rows, 1, y), at.put(rows, 2, x - left), at.put(rows, 3, y - top);
        at.put(rows, 4, (x - frame.half_width) * frame.pixel_slope * frame.focus_distance);
        at.put(rows, 5, (frame.half_height - y) * frame.pixel_slope * frame.focus_distance);
        at.put(rows, 6, all(frame.focus_distance));
    }
}

// `Lens.sample`: points `[2, N]` in a disc.
inline void sample_disc(float radius, int64_t count, const float* uniforms, float* points) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Float distance = radius * sqrt(at(uniforms, 0));
        Float sine, cosine;
        sincos(2.0f * PI * at(uniforms, 1), sine, cosine);
        at.put(points, 0, distance * cosine), at.put(points, 1, distance * sine);
    }
}

// `ThinLensCamera.rays`.
inline void camera_rays(const Camera& camera, int64_t count, const float* focus, const float* points, float* origin, float* direction) {
    const float* m = camera.axes;
    const auto turned = [&](Vec3 v) {
        return Vec3{m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z, m[6] * v.x + m[7] * v.y + m[8] * v.z};
    };
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Vec3 point = {at(points, 0), at(points, 1), all(0.0f)};
        const Vec3 place = {all(camera.position[0]), all(camera.position[1]), all(camera.position[2])};
        at.put(origin, 0, turned(point) + place);
        at.put(direction, 0, turned(normalize(at.vector(focus, 0) - point)));
    }
}

// `ThinLensCamera.depth`; miss: distance of a ray without a hit, whose depth is `none`.
inline void camera_depths(const Camera& camera, int64_t count, const float* distance, const float* directions, float miss, float none,
                          float* depths) {
    const Vec3 forward = {all(camera.axes[2]), all(camera.axes[5]), all(camera.axes[8])};
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Float along = at(distance, 0);
        at.put(depths, 0, along < all(miss) ? along * dot(forward, at.vector(directions, 0)) : all(none));
    }
}

}  // namespace BOKEHGUIDE_ISA
