// The classes `EllipseMixture`, `EnvironmentShapes` and `ParallelogramShapes` of the module.

#include "scene.h"

#include "mixture.h"

namespace bokehguide {

namespace {

constexpr size_t ELLIPSE_ROWS = 11, WINDOW_ROWS = 4;

// Densities of a map's emitters, by the names of `EnvironmentTable`; those of a `PiecewiseTable` have a prefix.
class EnvironmentShapes : Named {
  public:
    EnvironmentShapes(nb::dict arrays, nb::dict numbers) : Named(arrays, numbers) {
        t.width = int32_t(number("width")), t.height = int32_t(number("height")), t.turn = number("turn");
        size_t count;
        t.whole = array<double>("whole", &count), t.emitters = int64_t(count / 2), t.columns = array<double>("columns");
        const float* axes = array<float>("axes");
        for (int entry = 0; entry < 9; ++entry) t.float_axes[entry] = axes[entry], t.axes[entry] = double(axes[entry]);
        t.segment = array<int64_t>("segment"), t.emitter = array<int64_t>("emitter"), t.slot = array<int32_t>("slot"), t.flux = array<float>("flux");
        set(t.segments, "segments_"), set(t.rows, "rows_");
        forget_names();
    }

    EnvironmentTable t{};

  private:
    void set(PiecewiseTable& table, const std::string& prefix) {
        table.period = int64_t(number((prefix + "period").c_str()));
        table.keys = array<int64_t>(prefix + "keys"), table.position = array<int64_t>(prefix + "position");
        table.start = array<int64_t>(prefix + "start"), table.end = array<int64_t>(prefix + "end");
        table.weights = array<double>(prefix + "weights"), table.cumulative = array<double>(prefix + "cumulative");
        table.total = array<double>(prefix + "total");
    }
};

class ParallelogramShapes : Named {
  public:
    explicit ParallelogramShapes(nb::dict arrays) : Named(arrays, nb::dict()) {
        size_t count;
        t.area = array<float>("area", &count), t.count = int64_t(count), t.luminance = array<float>("luminance");
        t.centre = array<float>("centre"), t.right = array<float>("right"), t.up = array<float>("up"), t.normal = array<float>("normal");
        t.first = array<float>("first"), t.second = array<float>("second");
        forget_names();
    }

    ParallelogramTable t{};
};

}  // namespace

EllipseMixture::EllipseMixture(nb::dict arrays, nb::dict numbers, nb::object environment, nb::object parallelograms)
    : arrays_(arrays), environment_(environment), parallelograms_(parallelograms) {
    MixtureRows& m = rows_;
    const auto whole = [&](const char* name) { return nb::cast<Out<const int64_t>>(arrays[name], false); };
    const auto start = whole("start"), given = whole("component");
    m.pixels = int64_t(start.size()) - 1, m.candidates = int64_t(given.size()), m.columns = whole_vectors(m.candidates);
    m.start = start.data(), m.given = given.data();
    m.components = int64_t(nb::cast<Floats>(arrays["strength"], false).size());
    const size_t pixels = size_t(m.pixels), candidates = size_t(m.candidates), components = size_t(m.components);
    for (size_t pixel = 0; pixel <= pixels; ++pixel) {
        if (m.start[pixel] < (pixel ? m.start[pixel - 1] : 0) || m.start[pixel] > m.candidates) throw std::invalid_argument("starts must ascend");
    }
    for (size_t i = 0; i < candidates; ++i) {
        if (m.given[i] < 0 || m.given[i] >= m.components) throw std::invalid_argument("a component beyond the field");
    }
    const auto floats = [&](const char* name, size_t size) { return entry<Floats>(arrays, name, size).data(); };
    m.focus = floats("focus", 3 * pixels), m.given_beta = floats("beta", pixels), m.scale = floats("scale", candidates);
    m.mean = floats("mean", 3 * components), m.outline = floats("outline", 6 * components), m.strength = floats("strength", components);
    m.environment_index = whole("environment_index").data(), m.parallelogram_index = whole("parallelogram_index").data();
    m.contribution = entry<FloatsOut>(arrays, "contribution", size_t(m.columns)).data(), m.weight = entry<FloatsOut>(arrays, "weight", candidates).data();
    m.beta = entry<FloatsOut>(arrays, "own_beta", pixels).data(), m.guided = entry<Out<uint8_t>>(arrays, "guided", pixels).data();
    const auto number = [&](const char* name) { return nb::cast<double>(numbers[name]); };
    m.lens_radius = float(number("radius")), m.lens_squared_radius = float(number("squared_radius")), m.lens_area = float(number("area"));
    m.clips = number("clips") != 0.0;
    if (!environment.is_none()) m.environment = &nb::cast<EnvironmentShapes&>(environment).t;
    if (!parallelograms.is_none()) m.parallelograms = &nb::cast<ParallelogramShapes&>(parallelograms).t;
    const size_t columns = size_t(m.columns);
    memory_.reset(new float[2 * (columns * 3 + pixels * 3) + columns * (ELLIPSE_ROWS + WINDOW_ROWS + 3) + pixels]);
    float* place = memory_.get();
    const auto next = [&](size_t size) { place += size; return place - size; };
    m.map_rows = reinterpret_cast<double*>(next(4 * columns)), m.cumulative = reinterpret_cast<int64_t*>(next(2 * columns));
    m.cones = reinterpret_cast<double*>(next(6 * pixels));
    m.ellipses = next(ELLIPSE_ROWS * columns), m.windows = next(WINDOW_ROWS * columns);
    m.owner = reinterpret_cast<int32_t*>(next(columns)), m.component = reinterpret_cast<int32_t*>(next(columns));
    m.clipped = reinterpret_cast<uint8_t*>(next(columns)), m.sees_map = reinterpret_cast<uint8_t*>(next(pixels));
    nb::gil_scoped_release released;
    kernels().prepare_mixture(m);
}

void EllipseMixture::sample(const Floats& uniforms, FloatsOut points, Out<int64_t> candidates) const {
    const size_t pixels = size_t(rows_.pixels);
    check(uniforms, 3 * pixels, "uniforms"), check(points, 2 * pixels, "points"), check(candidates, pixels, "candidates");
    nb::gil_scoped_release released;
    kernels().sample_mixture(rows_, uniforms.data(), points.data(), candidates.data());
}

void EllipseMixture::evaluate(const Floats& points, const std::optional<Floats>& transmission, FloatsOut components, FloatsOut mixture,
                              FloatsOut density) const {
    const size_t pixels = size_t(rows_.pixels);
    check(points, 2 * pixels, "points"), check(components, size_t(rows_.candidates), "components");
    check(mixture, pixels, "mixture"), check(density, pixels, "density");
    if (transmission) check(*transmission, pixels, "transmission");
    nb::gil_scoped_release released;
    kernels().evaluate_mixture(rows_, rows_.pixels, nullptr, points.data(), points.data() + pixels, transmission ? transmission->data() : nullptr,
                               components.data(), mixture.data(), density.data());
}

void bind_mixture(nb::module_& m) {
    nb::class_<EnvironmentShapes>(m, "EnvironmentShapes").def(nb::init<nb::dict, nb::dict>());
    nb::class_<ParallelogramShapes>(m, "ParallelogramShapes").def(nb::init<nb::dict>());
    nb::class_<EllipseMixture>(m, "EllipseMixture")
        .def(nb::init<nb::dict, nb::dict, nb::object, nb::object>(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none())
        .def("sample", &EllipseMixture::sample)
        .def("evaluate", &EllipseMixture::evaluate, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg());
}

}  // namespace bokehguide
