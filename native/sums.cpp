// Sums over samples that learning needs: guiding/light_sampler.py and control_variate.py.

#include "sums.h"

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

}  // namespace

void bind_sums(nb::module_& m) {
    m.def("add_light_samples", &add_light_samples);
    m.def("correct_samples", &correct_samples, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg(), nb::arg());
}

}  // namespace bokehguide
