// What batches report to guides, as functions of the module: the loops are in guide.h.

#include "bindings.h"
#include "scene.h"

namespace bokehguide {

namespace {

using Bools = Out<const bool>;

const uint8_t* flags(const Bools& values) { return reinterpret_cast<const uint8_t*>(values.data()); }

// frame: width, height, and width of a pixel at unit distance; raster: margin, width and height of the record; ends: distance at which
// rays without a hit end, and from which on a distance is none.
void record_hits(nb::tuple frame, nb::tuple raster, nb::tuple ends, const Floats& axes, const Floats& points, const Floats& directions,
                 const Floats& distance, const Floats& weight, FloatsOut positions, Out<int64_t> cells) {
    const size_t count = distance.size();
    check(axes, 9, "axes"), check(points, 2 * count, "points"), check(directions, 3 * count, "directions"), check(weight, count, "weight");
    check(positions, 3 * count, "positions"), check(cells, count, "cells");
    const auto real = [&](int i) { return nb::cast<double>(frame[i]); };
    const auto whole = [&](int i) { return nb::cast<int32_t>(raster[i]); };
    const RecordRaster r = {float(0.5 * real(0)), float(0.5 * real(1)), float(real(2)), whole(0), whole(1), whole(2),
                            nb::cast<float>(ends[0]), nb::cast<float>(ends[1])};
    Camera camera{};
    std::memcpy(camera.axes, axes.data(), sizeof camera.axes);
    nb::gil_scoped_release released;
    kernels().record_hits(r, camera, int64_t(count), points.data(), directions.data(), distance.data(), weight.data(), positions.data(), cells.data());
}

// emission, triangle, known: None if the record leaves out no light.
void recorded_light(const Floats& radiance, const Bools& good, const std::optional<Floats>& emission, const std::optional<Ints>& triangle,
                    const std::optional<Bools>& known, bool whole_environment, FloatsOut light) {
    const size_t count = light.size();
    check(radiance, 3 * count, "radiance"), check(good, count, "good");
    KnownEmission of{};
    if (emission) {
        if (!triangle || !known) throw std::invalid_argument("emission without triangles");
        check(*emission, 3 * count, "emission"), check(*triangle, count, "triangle");
        of = {emission->data(), triangle->data(), flags(*known), whole_environment};
    }
    const int64_t triangles = known ? int64_t(known->size()) : 0;
    nb::gil_scoped_release released;
    for (size_t i = 0; emission && i < count; ++i) {
        if (of.triangle[i] >= triangles) throw std::invalid_argument("a triangle beyond the scene");
    }
    kernels().recorded_light({int64_t(count), radiance.data(), nullptr, flags(good)}, of, light.data());
}

void apparent_distances(const Floats& radiance, const Floats& distance, const Floats& images, float bright, float miss, FloatsOut found) {
    const size_t count = found.size();
    check(radiance, 3 * count, "radiance"), check(distance, count, "distance"), check(images, 3 * count, "images");
    nb::gil_scoped_release released;
    kernels().apparent_distances(int64_t(count), radiance.data(), distance.data(), images.data(), bright, miss, found.data());
}

// density, beta, guided, ratios: None without a mixture.
void weigh_samples(const Floats& radiance, const Floats& weight, const Bools& good, const std::optional<Floats>& density,
                   const std::optional<Floats>& beta, const std::optional<Bools>& guided, double unit, double area, FloatsOut weights,
                   const std::optional<FloatsOut>& ratios, Out<double> figures) {
    const size_t count = weights.size();
    check(radiance, 3 * count, "radiance"), check(weight, count, "weight"), check(good, count, "good"), check(figures, 4, "figures");
    MixtureSamples mixture{};
    if (density) {
        if (!beta || !guided || !ratios) throw std::invalid_argument("a mixture without β or ratios");
        check(*density, count, "density"), check(*beta, count, "beta"), check(*guided, count, "guided"), check(*ratios, count, "ratios");
        mixture = {density->data(), beta->data(), flags(*guided), float(unit), float(area)};
    }
    float* const found = ratios ? const_cast<float*>(ratios->data()) : nullptr;
    nb::gil_scoped_release released;
    kernels().weigh_samples({int64_t(count), radiance.data(), weight.data(), flags(good)}, mixture, weights.data(), found, figures.data());
}

// moments: `[2, pixels]` of a frame. Returns the number of draws.
int64_t learn_emitters(FloatsOut moments, int64_t first, const std::optional<Out<const int64_t>>& pixels, const nb::dict& draws, double area_of_unit,
                       double most, IntsOut slots, FloatsOut squares) {
    const size_t count = slots.size(), frame = moments.size() / 2;
    check(squares, count, "squares");
    if (pixels ? pixels->size() != count : first < 0 || size_t(first) + count > frame) throw std::invalid_argument("pixels beyond the frame");
    const auto of_pixels = [&](const char* name) { return entry<Floats>(draws, name, count).data(); };
    const size_t candidates = nb::cast<Ints>(draws["slots"], false).size();
    const auto of_candidates = [&](const char* name) { return entry<Floats>(draws, name, candidates).data(); };
    const EmitterDraws d = {of_pixels("beta"), of_pixels("mixture"), of_pixels("density"), of_pixels("ratio"),
                            entry<Out<const int64_t>>(draws, "candidate", count).data(), of_candidates("weight"), of_candidates("contribution"),
                            entry<Ints>(draws, "slots", candidates).data(), float(area_of_unit), float(most)};
    nb::gil_scoped_release released;
    for (size_t i = 0; i < count; ++i) {
        if (d.candidate[i] >= int64_t(candidates)) throw std::invalid_argument("a draw beyond the candidates");
        if (pixels && (pixels->data()[i] < 0 || pixels->data()[i] >= int64_t(frame))) throw std::invalid_argument("pixels beyond the frame");
    }
    return kernels().learn_emitters(d, int64_t(count), {pixels ? pixels->data() : nullptr, first}, int64_t(frame), moments.data(), slots.data(), squares.data());
}

// tiles: width of the frame, size of a tile, tiles across, and number of emitters.
void success_rates(nb::tuple tiles, const Floats& table, int64_t first, const std::optional<Out<const int64_t>>& pixels,
                   const Out<const int64_t>& start, const Out<const int64_t>& components, IntsOut slots, FloatsOut rates) {
    const int64_t count = int64_t(start.size()) - 1;
    check(slots, components.size(), "slots"), check(rates, components.size(), "rates");
    if (pixels) check(*pixels, size_t(count), "pixels");
    const auto whole = [&](int i) { return nb::cast<int32_t>(tiles[i]); };
    if (table.size() == 0 || (table.size() & (table.size() - 1)) != 0) throw std::invalid_argument("slots must be a power of two");
    const SuccessTiles of = {whole(0), whole(1), whole(2), uint32_t(table.size() - 1), whole(3), table.data()};
    nb::gil_scoped_release released;
    for (int64_t i = 0; i <= count; ++i) {
        if (start.data()[i] < (i ? start.data()[i - 1] : 0) || start.data()[i] > int64_t(components.size())) throw std::invalid_argument("starts must ascend");
    }
    kernels().success_rates(of, count, {pixels ? pixels->data() : nullptr, first}, start.data(), components.data(), slots.data(), rates.data());
}

}  // namespace

void bind_reports(nb::module_& m) {
    m.def("record_hits", &record_hits);
    m.def("recorded_light", &recorded_light, nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg());
    m.def("apparent_distances", &apparent_distances);
    m.def("weigh_samples", &weigh_samples, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg(),
          nb::arg(), nb::arg().none(), nb::arg());
    m.def("learn_emitters", &learn_emitters, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
    m.def("success_rates", &success_rates, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}

}  // namespace bokehguide
