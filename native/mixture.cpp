// The classes `EllipseMixture`, `GaussianMixture`, `EnvironmentShapes` and `ParallelogramShapes` of the module.

#include "scene.h"

#include "mixture.h"

#include <algorithm>

namespace bokehguide {

namespace {

constexpr size_t WINDOW_ROWS = 4;

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

// What both kinds of mixtures have. KIND: functions of the kind; UNIFORMS: numbers that `sample` takes for each pixel.
template <class RowsOfKind, MixtureKernels<RowsOfKind> Kernels::*KIND, size_t UNIFORMS> class MixtureOfKind : public Mixture {
  public:
    using Mixture::Mixture;

    const MixtureRows& rows() const override { return m; }
    size_t uniform_count() const override { return UNIFORMS; }
    void sample(const float* uniforms, float* points, int64_t* candidates) const override {
        (kernels().*KIND).sample(m, uniforms, points, candidates);
    }
    void evaluate(const PointsOnLens& at, const Densities& of) const override {
        (kernels().*KIND).evaluate(m, at.count, at.pixels, at.x, at.y, at.transmission, of.components, of.mixture, of.density);
    }

  protected:
    RowsOfKind m{};
    std::unique_ptr<float[]> memory_;

    void prepare() {
        nb::gil_scoped_release released;
        (kernels().*KIND).prepare(m);
    }
    // Memory for rows of candidates, and for `of_kind` numbers of the kind; returns the place of those.
    float* allocate(size_t of_kind) {
        const size_t columns = size_t(m.columns);
        memory_.reset(new float[4 * columns + of_kind]);
        float* place = memory_.get() + 4 * columns;
        m.cumulative = reinterpret_cast<int64_t*>(memory_.get());
        m.owner = reinterpret_cast<int32_t*>(memory_.get() + 2 * columns), m.component = m.owner + columns;
        return place;
    }
};

class EllipseMixture : public MixtureOfKind<EllipseRows, &Kernels::ellipses, 3> {
  public:
    EllipseMixture(nb::dict given, nb::dict numbers, nb::object environment, nb::object parallelograms)
        : MixtureOfKind(given, numbers), environment_(environment), parallelograms_(parallelograms) {
        set(m);
        const size_t pixels = size_t(m.pixels), columns = size_t(m.columns);
        m.scale = floats("scale", size_t(m.candidates)), m.outline = floats("outline", 6 * size_t(m.components));
        m.environment_index = whole("environment_index"), m.parallelogram_index = whole("parallelogram_index");
        m.clips = number("clips") != 0.0;
        if (!environment.is_none()) m.environment = &nb::cast<EnvironmentShapes&>(environment).t;
        if (!parallelograms.is_none()) m.parallelograms = &nb::cast<ParallelogramShapes&>(parallelograms).t;
        float* place = allocate(4 * columns + 6 * pixels + columns * (ELLIPSE_ROW + WINDOW_ROWS + 1) + pixels);
        const auto next = [&](size_t size) { place += size; return place - size; };
        m.map_rows = reinterpret_cast<double*>(next(4 * columns)), m.cones = reinterpret_cast<double*>(next(6 * pixels));
        m.ellipses = next(ELLIPSE_ROW * columns), m.windows = next(WINDOW_ROWS * columns);
        m.clipped = reinterpret_cast<uint8_t*>(next(columns)), m.sees_map = reinterpret_cast<uint8_t*>(next(pixels));
        prepare();
    }

  private:
    nb::object environment_, parallelograms_;
};

class GaussianMixture : public MixtureOfKind<GaussianRows, &Kernels::gaussians, 5> {
  public:
    GaussianMixture(nb::dict given, nb::dict numbers) : MixtureOfKind(given, numbers) {
        set(m);
        m.degree = int32_t(number("degree"));
        m.gaussians = entry<FloatsOut>(arrays(), "gaussians", 4 * size_t(m.columns)).data();
        m.raster = floats("raster", 2 * size_t(m.pixels));
        m.row_length = int32_t(OFFSETS + OFFSET_FIELDS * monomials());
        const size_t of_components = size_t(m.components) * size_t(m.row_length);
        float* const place = allocate(of_components + PIXEL_FIELDS * size_t(m.pixels));
        m.rows = pack(place), m.of_pixels = place + of_components;
        prepare();
    }

    void add_offset_gradient(const Floats& points, const Floats& components, const Floats& ratio, const Floats& density, Out<double> sums) const {
        const size_t pixels = size_t(m.pixels);
        check(points, 2 * pixels, "points"), check(components, size_t(m.candidates), "components"), check(ratio, pixels, "ratio");
        check(density, pixels, "density"), check(sums, size_t(m.components) * monomials() * OFFSET_FIELDS, "sums");
        nb::gil_scoped_release released;
        kernels().add_offset_gradient(m, points.data(), components.data(), ratio.data(), density.data(), sums.data());
    }

  private:
    size_t monomials() const { return m.degree < 0 ? 0 : size_t(m.degree + 1) * size_t(m.degree + 2) / 2; }

    // Fills the rows of Gaussians.
    const float* pack(float* rows) const {
        const size_t components = size_t(m.components);
        const bool offsets = m.degree >= 0;
        const float *const sigma = floats("sigma", components), *const radius = offsets ? floats("inverse_radius", components) : nullptr;
        const float *const center = offsets ? floats("center", 2 * components) : nullptr, *const unit = offsets ? floats("unit", components) : nullptr;
        const float* const coefficients = offsets ? floats("coefficients", 3 * monomials() * components) : nullptr;
        nb::gil_scoped_release released;
        std::fill_n(rows, components * size_t(m.row_length), 0.0f);
        // Copies columns of the array `name` `[columns, components]` to `field` and the next ones.
        const auto put = [&](const float* columns, size_t count, int field) {
            for (size_t column = 0; column < count; ++column) {
                for (size_t i = 0; i < components; ++i) rows[i * size_t(m.row_length) + size_t(field) + column] = columns[column * components + i];
            }
        };
        put(m.mean, 3, MEAN), put(m.strength, 1, STRENGTH), put(sigma, 1, SIGMA);
        if (!offsets) return rows;
        put(radius, 1, INVERSE_RADIUS), put(center, 2, CENTER), put(unit, 1, UNIT);
        for (size_t number = 0; number < monomials(); ++number) {
            const int place = OFFSETS + OFFSET_FIELDS * int(number);
            for (size_t axis = 0; axis < 3; ++axis) put(coefficients + (axis * monomials() + number) * components, 1, place + int(axis));
        }
        return rows;
    }
};

void sample(const Mixture& mixture, const Floats& uniforms, FloatsOut points, const std::optional<Out<int64_t>>& candidates) {
    const size_t pixels = size_t(mixture.rows().pixels);
    check(uniforms, mixture.uniform_count() * pixels, "uniforms"), check(points, 2 * pixels, "points");
    if (candidates) check(*candidates, pixels, "candidates");
    nb::gil_scoped_release released;
    mixture.sample(uniforms.data(), points.data(), candidates ? candidates->data() : nullptr);
}

void evaluate(const Mixture& mixture, const Floats& points, const std::optional<Floats>& transmission, FloatsOut components, FloatsOut sums,
              FloatsOut density) {
    const size_t pixels = size_t(mixture.rows().pixels);
    check(points, 2 * pixels, "points"), check(components, size_t(mixture.rows().candidates), "components");
    check(sums, pixels, "mixture"), check(density, pixels, "density");
    if (transmission) check(*transmission, pixels, "transmission");
    nb::gil_scoped_release released;
    mixture.evaluate({int64_t(pixels), nullptr, points.data(), points.data() + pixels, transmission ? transmission->data() : nullptr},
                     {components.data(), sums.data(), density.data()});
}

// `LensMixture.weights` on a round aperture.
void weights(const Mixture& mixture, const Floats& points, const Floats& density, FloatsOut out) {
    const MixtureRows& m = mixture.rows();
    const size_t pixels = size_t(m.pixels);
    check(points, 2 * pixels, "points"), check(density, pixels, "density"), check(out, pixels, "weights");
    nb::gil_scoped_release released;
    kernels().lens_weights(m, points.data(), density.data(), out.data());
}

}  // namespace

void Mixture::set(MixtureRows& m) {
    const auto start = nb::cast<Out<const int64_t>>(arrays_["start"], false), given = nb::cast<Out<const int64_t>>(arrays_["component"], false);
    m.pixels = int64_t(start.size()) - 1, m.candidates = int64_t(given.size()), m.columns = whole_vectors(m.candidates);
    m.start = start.data(), m.given = given.data();
    m.components = int64_t(nb::cast<Floats>(arrays_["strength"], false).size());
    const size_t pixels = size_t(m.pixels), candidates = size_t(m.candidates), components = size_t(m.components);
    m.focus = floats("focus", 3 * pixels), m.given_beta = floats("beta", pixels);
    m.mean = floats("mean", 3 * components), m.strength = floats("strength", components);
    m.contribution = entry<FloatsOut>(arrays_, "contribution", size_t(m.columns)).data(), m.weight = entry<FloatsOut>(arrays_, "weight", candidates).data();
    m.beta = entry<FloatsOut>(arrays_, "own_beta", pixels).data(), m.guided = entry<Out<uint8_t>>(arrays_, "guided", pixels).data();
    m.lens_radius = float(number("radius")), m.lens_squared_radius = float(number("squared_radius")), m.lens_area = float(number("area"));
    nb::gil_scoped_release released;
    for (size_t pixel = 0; pixel <= pixels; ++pixel) {
        if (m.start[pixel] < (pixel ? m.start[pixel - 1] : 0) || m.start[pixel] > m.candidates) throw std::invalid_argument("starts must ascend");
    }
    for (size_t i = 0; i < candidates; ++i) {
        if (m.given[i] < 0 || m.given[i] >= m.components) throw std::invalid_argument("a component beyond the field");
    }
}

void bind_mixture(nb::module_& m) {
    nb::class_<EnvironmentShapes>(m, "EnvironmentShapes").def(nb::init<nb::dict, nb::dict>());
    nb::class_<ParallelogramShapes>(m, "ParallelogramShapes").def(nb::init<nb::dict>());
    nb::class_<Mixture>(m, "Mixture")
        .def("sample", &sample, nb::arg(), nb::arg(), nb::arg().none())
        .def("weights", &weights)
        .def("evaluate", &evaluate, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg());
    nb::class_<EllipseMixture, Mixture>(m, "EllipseMixture")
        .def(nb::init<nb::dict, nb::dict, nb::object, nb::object>(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none());
    nb::class_<GaussianMixture, Mixture>(m, "GaussianMixture")
        .def(nb::init<nb::dict, nb::dict>())
        .def("add_offset_gradient", &GaussianMixture::add_offset_gradient);
}

}  // namespace bokehguide
