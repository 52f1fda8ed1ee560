// Projected Gaussians as components of a mixture on the lens: models/gaussian_mixture.py, polynomial_offset.py and kl.py, for a vector of
// candidates at a time.

#pragma once

#include "lens_mixture.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::GaussianRows;

// Inverse of the error function, to some ulps (Giles 2012), ±infinity at ±1.
inline Float inverse_erf(Float x) {
    const Float w = -logarithm(at_least((1.0f - x) * (1.0f + x), 1e-37f));
    const Float middle = w - 2.5f, tail = sqrt(w) - 3.0f;
    const Int near = w < all(5.0f);
    const Float z = near ? middle : tail;
    constexpr float NEAR[] = {2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f, 2.1858087e-04f,
                              -1.25372503e-03f, -4.17768164e-03f, 2.46640727e-01f, 1.50140941f};
    constexpr float FAR[] = {-2.00214257e-04f, 1.00950558e-04f, 1.34934322e-03f, -3.67342844e-03f, 5.73950773e-03f,
                             -7.6224613e-03f, 9.43887047e-03f, 1.00167406f, 2.83297682f};
    Float p = near ? all(NEAR[0]) : all(FAR[0]);
    for (int i = 1; i < 9; ++i) p = p * z + (near ? all(NEAR[i]) : all(FAR[i]));
    return abs(x) < all(1.0f) ? p * x : copysign(all(INFINITY), x);
}

// Gaussians seen through focus points (lens_mixture.h).
class GaussianShapes {
  public:
    using Rows = GaussianRows;
    struct Seen {};

    explicit GaussianShapes(const Rows& rows) : m(rows) {}

    void begin(int64_t) const {}
    // The means and contributions of a vector of candidates; `_kept` excludes some.
    void shape(int64_t first) const {
        const Int owner = load<Int>(m.owner + first), component = load<Int>(m.component + first);
        const Vec3 focus = gather3(m.focus, m.pixels, owner);
        Vec3 mean = gather3(m.mean, m.components, component);
        if (m.coefficients != nullptr) mean = mean + offset(component, owner);
        const Float sigma = gather(m.sigma, component);
        const LensPoint projected = project_to_lens(mean, focus);
        const Float reach = m.lens_radius + abs(focus.z / (focus.z - mean.z)) * sigma;
        const Int kept = projected.x * projected.x + projected.y * projected.y < reach * reach;
        store(m.contribution + first, gather(m.strength, component) * one_if(kept));
        const Float rows[4] = {mean.x, mean.y, mean.z, sigma};
        for (int row = 0; row < 4; ++row) store(m.gaussians + row * m.columns + first, rows[row]);
    }
    void see(LensPoint, Vec3, Int, Int, Seen&) const {}
    Float density(Int candidate, Int, Vec3 focus, LensPoint point, Int, const Seen&) const {
        return lens_density(point, focus, mean(candidate), sigma(candidate));
    }
    float choice(const float* uniforms, int64_t pixel) const { return uniforms[m.pixels + pixel]; }
    // Random points of Gaussians, projected.
    LensPoint draw(Int candidate, Int, Int pixel, const float* uniforms) const {
        const auto normal = [&](int number) {
            return 1.41421356237309504880f * inverse_erf(2.0f * gather(uniforms + number * m.pixels, pixel) - 1.0f);
        };
        const Vec3 highlight = mean(candidate) + sigma(candidate) * Vec3{normal(2), normal(3), normal(4)};
        const LensPoint point = project_to_lens(highlight, gather3(m.focus, m.pixels, pixel));
        const auto finite_or_far = [](Float x) { return bounded(or_else(x, all(FAR_OUTSIDE)), all(FAR_OUTSIDE)); };
        return {finite_or_far(point.x), finite_or_far(point.y)};
    }

    Vec3 mean(Int candidate) const { return gather3(m.gaussians, m.columns, candidate); }
    Float sigma(Int candidate) const { return gather(m.gaussians + 3 * m.columns, candidate); }

    // Calls `use` with the number of each monomial and its basis (`PolynomialOffset.basis`).
    template <class Use> void for_basis(Int component, Int pixel, Use use) const {
        const Float scale = gather(m.inverse_radius, component), unit = gather(m.unit, component);
        const auto coordinate = [&](int axis) {
            return clamp((gather(m.raster + axis * m.pixels, pixel) - gather(m.center + axis * m.components, component)) * scale, -2.0f, 2.0f);
        };
        const Float x = coordinate(0), y = coordinate(1);
        Float of_x = all(1.0f);
        for (int i = 0, number = 0; i <= m.degree; ++i, of_x = of_x * x) {
            Float of_y = all(1.0f);
            for (int j = 0; i + j <= m.degree; ++j, ++number, of_y = of_y * y) use(number, of_x * of_y * unit);
        }
    }
    int monomials() const { return (m.degree + 1) * (m.degree + 2) / 2; }

  private:
    const Rows& m;

    // `PolynomialOffset.forward`.
    Vec3 offset(Int component, Int pixel) const {
        Vec3 sum = grey(all(0.0f));
        const int64_t next = monomials() * m.components;
        for_basis(component, pixel, [&](int number, Float basis) {
            const float* row = m.coefficients + number * m.components;
            const auto coefficient = [&](int axis) { return gather(row + axis * next, component); };
            sum = sum + Vec3{coefficient(0), coefficient(1), coefficient(2)} * basis;
        });
        return sum;
    }
};

// `offset_gradient`: adds to sums `[3, monomials, components]` for one lens point `[2, N]` of each pixel. components: densities of all
// candidates there; ratio, density: `[N]`.
class OffsetGradient {
  public:
    OffsetGradient(const GaussianRows& rows, const float* points, const float* components, const float* ratio, const float* density, double* sums)
        : m(rows), shapes(rows), points_(points), components_(components), ratio_(ratio), density_(density), sums_(sums) {}

    void run() {
        for (int64_t pixel = 0; pixel < m.pixels; ++pixel) {
            float strongest = 0.0f;
            for (int64_t i = m.start[pixel]; i < m.start[pixel + 1] && ratio_[pixel] > 0.0f; ++i) {
                if (contribution(i) > strongest) strongest = contribution(i);
            }
            for (int64_t i = m.start[pixel]; i < m.start[pixel + 1] && strongest > 0.0f; ++i) {
                if (contribution(i) == strongest) learn(i);
            }
        }
        if (waiting_ > 0) add();
    }

  private:
    const GaussianRows& m;
    const GaussianShapes shapes;
    const float *points_, *components_, *ratio_, *density_;
    double* sums_;
    Int candidates_ = {};
    int waiting_ = 0;

    float contribution(int64_t candidate) const { return m.weight[candidate] * components_[candidate]; }
    void learn(int64_t candidate) {
        candidates_[waiting_++] = int32_t(candidate);
        if (waiting_ == LANES) add();
    }
    // The terms of the candidates that wait; candidates in lanes beyond them are those of earlier calls.
    void add() {
        const Int candidate = candidates_, pixel = gather(m.owner, candidate), component = gather(m.component, candidate);
        const LensPoint point = {gather(points_, pixel), gather(points_ + m.pixels, pixel)};
        const Vec3 slope = log_density_gradient(point, gather3(m.focus, m.pixels, pixel), shapes.mean(candidate), shapes.sigma(candidate));
        const Float share = gather(m.weight, candidate) * gather(components_, candidate) / gather(density_, pixel);
        const Vec3 of_mean = -(gather(ratio_, pixel) * gather(m.beta, pixel) * share) * slope;
        const int64_t next = shapes.monomials() * m.components;
        shapes.for_basis(component, pixel, [&](int number, Float basis) {
            const Float terms[3] = {of_mean.x * basis, of_mean.y * basis, of_mean.z * basis};
            double* const row = sums_ + number * m.components;
            for (int lane = 0; lane < waiting_; ++lane) {
                for (int axis = 0; axis < 3; ++axis) row[axis * next + component[lane]] += double(terms[axis][lane]);
            }
        });
        waiting_ = 0;
    }
};

inline void add_offset_gradient(const GaussianRows& m, const float* points, const float* components, const float* ratio, const float* density,
                                double* sums) {
    OffsetGradient(m, points, components, ratio, density, sums).run();
}

}  // namespace BOKEHGUIDE_ISA
