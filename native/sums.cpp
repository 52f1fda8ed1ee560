// Sums over samples: guiding/light_sampler.py, guiding/record_buffer.py, guiding/control_variate.py and render/coverage.py.

#include "bindings.h"

#include <nanobind/stl/optional.h>

#include <cmath>

#include "arrays.h"

namespace bokehguide {

namespace {

constexpr int CONTROL_ROWS = 8;

// `LightSampler.add`: adds samples to sums `[3, tiles · clusters]`.
void add_light_samples(Out<double> sums, const Ints& tile, const Ints& cluster, const Floats& contribution, const Floats& visibility,
                       int clusters, double most) {
    const size_t count = tile.size(), places = sums.size() / 3;
    check(sums, 3 * places, "sums"), check(cluster, count, "cluster"), check(contribution, count, "contribution"), check(visibility, count, "visibility");
    nb::gil_scoped_release released;
    double* const total = sums.data();
    for (size_t i = 0; i < count; ++i) {
        if (cluster.data()[i] < 0) continue;
        const size_t place = size_t(tile.data()[i]) * size_t(clusters) + size_t(cluster.data()[i]);
        if (place >= places) continue;
        double value = contribution.data()[i];
        value = std::isnan(value) ? 0.0 : (value < most ? value : most);
        total[place] += value * value, total[places + place] += 1.0, total[2 * places + place] += visibility.data()[i];
    }
}

// `MisFactors.moments`: adds paths to sums `[2, tiles]`; factor: of each tile.
void add_mis_moments(Out<double> sums, const Floats& factor, const Ints& tile, const Floats& difference, const Floats& reflected, double most) {
    const size_t count = tile.size(), tiles = factor.size();
    check(sums, 2 * tiles, "sums"), check(difference, count, "difference"), check(reflected, count, "reflected");
    nb::gil_scoped_release released;
    double* const total = sums.data();
    const auto finite = [most](double value) { return std::isnan(value) ? 0.0 : (value < most ? (value > -most ? value : -most) : most); };
    for (size_t i = 0; i < count; ++i) {
        const size_t place = size_t(tile.data()[i]);
        if (place >= tiles) continue;
        const double change = finite(difference.data()[i]), rest = finite(reflected.data()[i]) - double(factor.data()[place]) * change;
        total[place] += rest * change, total[tiles + place] += change * change;
    }
}

// `RecordBuffer.add`: adds samples with positions `[3, N]` to sums `[5, cells]`.
void add_records(FloatsOut sums, const Out<const int64_t>& cells, const Floats& points, const Floats& luminance) {
    const size_t count = luminance.size(), places = sums.size() / 5;
    check(sums, 5 * places, "sums"), check(cells, count, "cells"), check(points, 3 * count, "points");
    nb::gil_scoped_release released;
    for (size_t i = 0; i < count; ++i) {
        const int64_t cell = cells.data()[i];
        if (cell < 0) continue;
        if (size_t(cell) >= places) throw std::out_of_range("cell outside the record");
        const float light = luminance.data()[i], x = points.data()[i], y = points.data()[count + i], depth = points.data()[2 * count + i];
        const float values[5] = {1.0f, light, light * (x / depth), light * (y / depth), light * (1.0f / depth)};
        for (size_t plane = 0; plane < 5; ++plane) sums.data()[plane * places + size_t(cell)] += values[plane];
    }
}

// `ControlVariate.corrected`: corrects samples of pixels, null for consecutive ones from `first` on, and adds them to sums
// `[8, cells]`. coefficients: `[3, cells]`; bound: `[3, film pixels]`.
void correct_samples(Out<double> sums, const std::optional<Out<const int64_t>>& pixels, int64_t first, int width, int cell,
                     const Floats& radiance, const Floats& weight, const Floats& coefficients, const Floats& bound, Out<float> corrected) {
    const size_t count = weight.size(), cells = sums.size() / CONTROL_ROWS, film = bound.size() / 3;
    check(sums, CONTROL_ROWS * cells, "sums"), check(radiance, 3 * count, "radiance"), check(coefficients, 3 * cells, "coefficients");
    check(corrected, 3 * count, "corrected");
    if (pixels) check(*pixels, count, "pixels");
    nb::gil_scoped_release released;
    double* const total = sums.data();
    const int64_t across = (width + cell - 1) / cell;
    for (size_t i = 0; i < count; ++i) {
        const int64_t pixel = pixels ? pixels->data()[i] : first + int64_t(i);
        const size_t place = size_t(pixel / width / cell * across + pixel % width / cell);
        if (pixel < 0 || size_t(pixel) >= film || place >= cells) throw std::out_of_range("pixel outside the film");
        for (size_t channel = 0; channel < 3; ++channel) {
            const float most = bound.data()[channel * film + size_t(pixel)], slope = coefficients.data()[channel * cells + place];
            const float c = slope < -most ? -most : slope > most ? most : slope;
            corrected.data()[channel * count + i] = radiance.data()[channel * count + i] - c * (weight.data()[i] - 1.0f);
        }
        const double w = weight.data()[i], color[3] = {radiance.data()[i], radiance.data()[count + i], radiance.data()[2 * count + i]};
        const double light = 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2];
        if (!std::isfinite(w + light)) continue;
        const double rows[CONTROL_ROWS] = {1.0, w, w * w, w * light, light * light, color[0], color[1], color[2]};
        for (int row = 0; row < CONTROL_ROWS; ++row) total[row * cells + place] += rows[row];
    }
}

// The tensors of `Coverage.sums`, rows of `pixels` each. passed is null except with `RatioFeatures`, moments and center are null
// except with `ControlVariateFeatures`.
struct CoverageSums {
    size_t slots, pixels;
    int32_t* numbers;
    double *features, *passed;
    float *moments, *center;

    // The slot of an object at a pixel, -1 for none. A pixel fills its slots in order.
    int find(int32_t number, size_t pixel) const {
        for (size_t slot = 0; slot < slots && numbers[slot * pixels + pixel] > 0; ++slot) {
            if (numbers[slot * pixels + pixel] == number) return int(slot);
        }
        return -1;
    }
    bool full(size_t pixel) const { return numbers[(slots - 1) * pixels + pixel] > 0; }
    // `Coverage._least`, and the new object in this slot.
    int insert(int32_t number, size_t pixel) const {
        size_t least = 0;
        for (size_t slot = 0; slot < slots; ++slot) {
            const size_t place = slot * pixels + pixel;
            if (numbers[place] == 0) {
                least = slot;
                break;
            }
            if (features[place] < features[least * pixels + pixel]) least = slot;
        }
        const size_t place = least * pixels + pixel;
        numbers[place] = number, features[place] = 0.0;
        if (moments != nullptr) moments[place + pixels] = center[place] = 0.0f;
        return int(least);
    }
    // `MeanFeatures.add` and its other forms, for a sample in one slot, or in none.
    void add(int slot, size_t pixel, float weight, float kept, bool recenter) const {
        if (moments == nullptr) {
            const float factor = passed == nullptr ? kept : weight * kept;
            if (slot >= 0) features[size_t(slot) * pixels + pixel] += factor;
            if (passed != nullptr) passed[pixel] += factor;
            return;
        }
        const float total = moments[pixel], square = weight * weight;
        for (size_t each = 0; each < slots && numbers[each * pixels + pixel] > 0; ++each) {
            const size_t place = each * pixels + pixel;
            float& moment = moments[place + pixels];
            if (recenter) center[place] = moment / (total > 1e-30f ? total : 1e-30f);
            const float start = center[place], end = int(each) == slot ? 1.0f : 0.0f, difference = end - start;
            features[place] += (weight < 0.5f ? start + weight * difference : end - difference * (1.0f - weight)) * kept;
            moment += end * square;
        }
        moments[pixel] = total + square;
    }
};

CoverageSums coverage_sums(const nb::dict& arrays) {
    CoverageSums sums{};
    const auto numbers = nb::cast<IntsOut>(arrays["objects"], false);
    sums.slots = numbers.shape(0), sums.pixels = numbers.shape(1), sums.numbers = numbers.data();
    const size_t size = numbers.size();
    sums.features = entry<Out<double>>(arrays, "features", size).data();
    if (arrays.contains("passed")) sums.passed = entry<Out<double>>(arrays, "passed", sums.pixels).data();
    if (arrays.contains("control")) {
        sums.moments = entry<FloatsOut>(arrays, "control", size + sums.pixels).data();
        sums.center = entry<FloatsOut>(arrays, "center", size).data();
    }
    return sums;
}

// `Coverage.add` of samples of pixels, null for consecutive ones from `first` on. objects: number of the object of each triangle.
void cover(const nb::dict& arrays, const Ints& objects, const std::optional<Out<const int64_t>>& pixels, int64_t first,
           const Ints& triangle, const Floats& weight, const Floats& kept, bool recenter) {
    const size_t count = triangle.size();
    check(weight, count, "weight"), check(kept, count, "kept");
    if (pixels) check(*pixels, count, "pixels");
    const CoverageSums sums = coverage_sums(arrays);
    nb::gil_scoped_release released;
    for (size_t i = 0; i < count; ++i) {
        const int64_t pixel = pixels ? pixels->data()[i] : first + int64_t(i);
        const int32_t hit = triangle.data()[i];
        if (pixel < 0 || size_t(pixel) >= sums.pixels || hit >= int64_t(objects.size())) throw std::out_of_range("no such pixel or triangle");
        int slot = -1;
        if (hit >= 0) {
            const int32_t number = objects.data()[hit];
            slot = sums.find(number, size_t(pixel));
            if (slot < 0 && (kept.data()[i] > 0.0f || !sums.full(size_t(pixel)))) slot = sums.insert(number, size_t(pixel));
        }
        sums.add(slot, size_t(pixel), weight.data()[i], kept.data()[i], recenter);
    }
}

}  // namespace

void bind_sums(nb::module_& m) {
    m.def("add_records", &add_records);
    m.def("add_light_samples", &add_light_samples);
    m.def("add_mis_moments", &add_mis_moments);
    m.def("correct_samples", &correct_samples, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg(), nb::arg());
    m.def("cover", &cover, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}

}  // namespace bokehguide
