// Projected Gaussians as components of a mixture on the lens: models/gaussian_mixture.py, polynomial_offset.py and kl.py, for a vector of
// candidates at a time.

#pragma once

#include "lens_mixture.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::CENTER;
using bokehguide::FOCUS;
using bokehguide::GaussianRows;
using bokehguide::INVERSE_RADIUS;
using bokehguide::MEAN;
using bokehguide::OFFSET_FIELDS;
using bokehguide::OFFSETS;
using bokehguide::PIXEL_FIELDS;
using bokehguide::RASTER;
using bokehguide::SIGMA;
using bokehguide::STRENGTH;
using bokehguide::UNIT;

// Inverse of the error function, to some ulps (Giles 2012), ±infinity at ±1.
inline Float inverse_erf(Float x) {
    const Float w = -logarithm(at_least((1.0f - x) * (1.0f + x), 1e-37f));
    const Int near = w < all(5.0f);
    const Float z = near ? w - 2.5f : sqrt(w) - 3.0f;
    constexpr float MIDDLE[] = {2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f, 2.1858087e-04f,
                                -1.25372503e-03f, -4.17768164e-03f, 2.46640727e-01f, 1.50140941f};
    constexpr float TAIL[] = {-2.00214257e-04f, 1.00950558e-04f, 1.34934322e-03f, -3.67342844e-03f, 5.73950773e-03f,
                              -7.6224613e-03f, 9.43887047e-03f, 1.00167406f, 2.83297682f};
    Float p = near ? all(MIDDLE[0]) : all(TAIL[0]);
    for (int i = 1; i < 9; ++i) p = p * z + (near ? all(MIDDLE[i]) : all(TAIL[i]));
    return abs(x) < all(1.0f) ? p * x : copysign(all(INFINITY), x);
}

// Gaussians seen through focus points, as the components of a mixture (lens_mixture.h).
class GaussianShapes {
  public:
    using Rows = GaussianRows;
    struct Seen {};

    explicit GaussianShapes(const Rows& rows) : m(rows) {}

    // Prepares a pixel for its candidates.
    void begin(int64_t pixel) const {
        float* const row = m.of_pixels + PIXEL_FIELDS * pixel;
        for (int axis = 0; axis < 3; ++axis) row[FOCUS + axis] = m.focus[axis * m.pixels + pixel];
        for (int axis = 0; axis < 2; ++axis) row[RASTER + axis] = m.raster[axis * m.pixels + pixel];
    }
    // The means and contributions of a vector of candidates; `_kept` excludes some.
    void shape(int64_t first) const {
        const Int owner = load<Int>(m.owner + first), component = load<Int>(m.component + first);
        const PixelRow pixel = pixel_row(owner);
        const Vec3 focus = {pixel(FOCUS), pixel(FOCUS + 1), pixel(FOCUS + 2)};
        const Places of = places(component);
        const Header row([&](int lane) { return of.rows[lane]; });
        place(first, of, pixel, row);
        const Gaussian g = gaussian(lane_numbers() + int32_t(first));
        const LensPoint projected = project_to_lens(g.mean, focus);
        const Float reach = m.lens_radius + abs(focus.z / (focus.z - g.mean.z)) * g.sigma;
        const Int kept = projected.x * projected.x + projected.y * projected.y < reach * reach;
        store(m.contribution + first, row(STRENGTH) * one_if(kept));
    }
    void see(LensPoint, Vec3, Int, Int, Seen&) const {}
    Float density(Int candidate, Int, Vec3 focus, LensPoint point, Int, const Seen&) const {
        const Gaussian g = gaussian(candidate);
        return lens_density(point, focus, g.mean, g.sigma);
    }
    float choice(const float* uniforms, int64_t pixel) const { return uniforms[m.pixels + pixel]; }
    // Random points of Gaussians, projected.
    LensPoint draw(Int candidate, Int, Int pixel, const float* uniforms) const {
        const auto normal = [&](int number) {
            return 1.41421356237309504880f * inverse_erf(2.0f * gather(uniforms + number * m.pixels, pixel) - 1.0f);
        };
        const Gaussian g = gaussian(candidate);
        const Vec3 highlight = g.mean + g.sigma * Vec3{normal(2), normal(3), normal(4)};
        const LensPoint point = project_to_lens(highlight, gather3(m.focus, m.pixels, pixel));
        const auto finite_or_far = [](Float x) { return bounded(or_else(x, all(FAR_OUTSIDE)), all(FAR_OUTSIDE)); };
        return {finite_or_far(point.x), finite_or_far(point.y)};
    }

    struct Gaussian {
        Vec3 mean;
        Float sigma;
    };
    Gaussian gaussian(Int candidate) const {
        const RowFields<1> row([&](int lane) { return m.gaussians + 4 * candidate[lane]; });
        return {{row(0), row(1), row(2)}, row(3)};
    }

    // The fields of Gaussians before their coefficients.
    using Header = RowFields<OFFSETS / 4>;
    Header header(Int component) const {
        const Places of = places(component);
        return Header([&](int lane) { return of.rows[lane]; });
    }
    using PixelRow = RowFields<PIXEL_FIELDS / 4>;
    PixelRow pixel_row(Int pixel) const {
        return PixelRow([&](int lane) { return m.of_pixels + PIXEL_FIELDS * pixel[lane]; });
    }
    // Calls `use` with the number and the basis of each monomial at raster positions of pixels, in the order of `exponents`.
    template <class Use> void for_basis(const PixelRow& pixel, const Header& row, Use use) const {
        const auto coordinate = [&](int axis) { return clamp((pixel(RASTER + axis) - row(CENTER + axis)) * row(INVERSE_RADIUS), -2.0f, 2.0f); };
        const Float x = coordinate(0), y = coordinate(1), unit = row(UNIT);
        Float of_x = all(1.0f);
        for (int i = 0, number = 0; i <= m.degree; ++i, of_x = of_x * x) {
            Float of_y = all(1.0f);
            for (int j = 0; i + j <= m.degree; ++j, ++number, of_y = of_y * y) use(number, of_x * of_y * unit);
        }
    }

  private:
    const Rows& m;

    struct Places {
        const float* rows[LANES];
    };
    Places places(Int component) const {
        Places found;
        for (int lane = 0; lane < LANES; ++lane) found.rows[lane] = m.rows + int64_t(component[lane]) * m.row_length;
        return found;
    }
    // Means and σ of candidates; `PolynomialOffset.forward` moves the means.
    void place(int64_t first, const Places& of, const PixelRow& pixel, const Header& header) const {
        Quad gaussians[LANES] = {};
        if (m.degree >= 0) {
            for_basis(pixel, header, [&](int number, Float basis) {
                float factor[LANES];
                store(factor, basis);
                const int64_t place = OFFSETS + OFFSET_FIELDS * number;
                for (int lane = 0; lane < LANES; ++lane) gaussians[lane] += load<Quad>(of.rows[lane] + place) * factor[lane];
            });
        }
        for (int lane = 0; lane < LANES; ++lane) store(m.gaussians + 4 * (first + lane), load<Quad>(of.rows[lane] + MEAN) + gaussians[lane]);
    }
};

// `offset_gradient`: adds to sums `[components, monomials, OFFSET_FIELDS]` for one lens point `[2, N]` of each pixel.
// components: densities of all candidates there; ratio, density: `[N]`.
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
        const GaussianShapes::PixelRow row = shapes.pixel_row(pixel);
        const GaussianShapes::Gaussian g = shapes.gaussian(candidate);
        const Float share = gather(m.weight, candidate) * gather(components_, candidate) / gather(density_, pixel);
        const Vec3 slope = -(gather(ratio_, pixel) * gather(m.beta, pixel) * share) *
                           log_density_gradient(point, {row(FOCUS), row(FOCUS + 1), row(FOCUS + 2)}, g.mean, g.sigma);
        const int64_t length = m.row_length - OFFSETS;
        shapes.for_basis(row, shapes.header(component), [&](int number, Float basis) {
            const Float x = slope.x * basis, y = slope.y * basis, z = slope.z * basis;
            for (int lane = 0; lane < waiting_; ++lane) {
                double* const sums = sums_ + component[lane] * length + OFFSET_FIELDS * number;
                sums[0] += double(x[lane]), sums[1] += double(y[lane]), sums[2] += double(z[lane]);
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
