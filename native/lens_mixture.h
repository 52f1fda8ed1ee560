// Mixtures on the lens: `LensMixture` of models/base.py, for a vector of candidates or pixels at a time.
//
// `Shapes` are the components: `EllipseShapes` of ellipses.h or `GaussianShapes` of gaussians.h.

#pragma once

#include "columns.h"
#include "projection.h"
#include "tables.h"

namespace BOKEHGUIDE_ISA {

constexpr double WEIGHT_STEPS = 0x1p40;

// The candidates of all pixels of a batch: their shapes and weights.
template <class Shapes> class MixtureBuilder {
  public:
    explicit MixtureBuilder(const typename Shapes::Rows& rows) : m(rows), shapes(rows) {}

    void run() const {
        own();
        for (int64_t first = 0; first < m.candidates; first += LANES) shapes.shape(first);
        for (int64_t pixel = 0; pixel < m.pixels; ++pixel) weigh(pixel);
    }

  private:
    const typename Shapes::Rows& m;
    const Shapes shapes;

    void own() const {
        for (int64_t pixel = 0; pixel < m.pixels; ++pixel) {
            for (int64_t i = m.start[pixel]; i < m.start[pixel + 1]; ++i) m.owner[i] = int32_t(pixel), m.component[i] = int32_t(m.given[i]);
            shapes.begin(pixel);
        }
        for (int64_t i = m.candidates; i < m.columns; ++i) m.owner[i] = m.component[i] = 0;
    }

    // `LensMixture._set_weights`.
    void weigh(int64_t pixel) const {
        double total = 0.0;
        for (int64_t i = m.start[pixel]; i < m.start[pixel + 1]; ++i) {
            m.weight[i] = m.scale == nullptr ? m.contribution[i] : m.contribution[i] * m.scale[i];
            total += double(m.weight[i]);
        }
        m.guided[pixel] = total > 0.0;
        m.beta[pixel] = total > 0.0 ? m.given_beta[pixel] : 0.0f;
        int64_t sum = 0;
        for (int64_t i = m.start[pixel]; i < m.start[pixel + 1]; ++i) {
            const double share = double(m.weight[i]) / (total > 1e-300 ? total : 1e-300);
            sum += int64_t(share * WEIGHT_STEPS);
            m.weight[i] = float(share), m.cumulative[i] = sum;
        }
    }
};

// Densities of all candidates of some pixels at lens points.
template <class Shapes> class MixtureDensity {
  public:
    explicit MixtureDensity(const typename Shapes::Rows& rows) : m(rows), shapes(rows) {}

    // p_GMM of a vector of pixels. components: where not null, the density of each candidate is written here.
    Float mixture(Int pixel, LensPoint point, Int active, float* components) const {
        Int begin = all(0), count = all(0);
        for (int lane = 0; lane < LANES; ++lane) {
            if (!active[lane]) continue;
            begin[lane] = int32_t(m.start[pixel[lane]]), count[lane] = int32_t(m.start[pixel[lane] + 1] - m.start[pixel[lane]]);
        }
        Float sum = all(0.0f);
        if (!any(count > 0)) return sum;
        pixel = active ? pixel : all(0);
        const Vec3 focus = gather3(m.focus, m.pixels, pixel);
        typename Shapes::Seen seen;
        shapes.see(point, focus, pixel, active, seen);
        for (int32_t number = 0; any(number < count); ++number) {
            const Int there = number < count, candidate = there ? begin + number : all(0);
            const Float density = shapes.density(candidate, pixel, focus, point, there, seen);
            sum = there ? sum + gather(m.weight, candidate) * density : sum;
            for (int lane = 0; lane < LANES && components != nullptr; ++lane) {
                if (there[lane]) components[candidate[lane]] = density[lane];
            }
        }
        return sum;
    }

    // q of Eq. 26. transmission: W.
    Float blend(Int pixel, Float mixture, Float transmission, Int active) const {
        const Float beta = gather(m.beta, active ? pixel : all(0));
        return beta * mixture + (1.0f - beta) * transmission / all(m.lens_area);
    }
    Float disc(LensPoint point) const { return one_if(point.x * point.x + point.y * point.y <= all(m.lens_squared_radius)); }

  private:
    const typename Shapes::Rows& m;
    const Shapes shapes;
};

// Lens points of a vector of pixels from uniform numbers, where the pixels draw from their candidates (`sample` of the mixtures).
template <class Shapes> class MixtureSampler {
  public:
    explicit MixtureSampler(const typename Shapes::Rows& rows) : m(rows), shapes(rows) {}

    void sample(int64_t first, int count, const float* uniforms, float* points, int64_t* candidates) const {
        Int candidate = all(-1), pixel;
        for (int lane = 0; lane < LANES; ++lane) pixel[lane] = int32_t(first + (lane < count ? lane : count - 1));
        for (int lane = 0; lane < count; ++lane) {
            if (uniforms[first + lane] < m.beta[first + lane]) candidate[lane] = int32_t(choose(first + lane, shapes.choice(uniforms, first + lane)));
            if (candidates != nullptr) candidates[first + lane] = candidate[lane];
        }
        const Int guided = candidate >= 0;
        if (!any(guided)) return;
        const LensPoint point = shapes.draw(guided ? candidate : all(0), guided, pixel, uniforms);
        for (int lane = 0; lane < count; ++lane) {
            if (guided[lane]) points[first + lane] = point.x[lane], points[m.pixels + first + lane] = point.y[lane];
        }
    }

  private:
    const typename Shapes::Rows& m;
    const Shapes shapes;

    // `LensMixture.choose`.
    int64_t choose(int64_t pixel, float u) const {
        const int64_t begin = m.start[pixel], end = m.start[pixel + 1], target = int64_t(double(m.cumulative[end - 1]) * double(u));
        int64_t candidate = begin;
        while (candidate < end && m.cumulative[candidate] <= target) ++candidate;
        return candidate < m.candidates ? candidate : m.candidates - 1;
    }
};

template <class Shapes> void prepare_mixture(const typename Shapes::Rows& m) { MixtureBuilder<Shapes>(m).run(); }

template <class Shapes> void sample_mixture(const typename Shapes::Rows& m, const float* uniforms, float* points, int64_t* candidates) {
    const MixtureSampler<Shapes> sampler(m);
    for (int64_t first = 0; first < m.pixels; first += LANES) {
        sampler.sample(first, m.pixels - first < LANES ? int(m.pixels - first) : LANES, uniforms, points, candidates);
    }
}

// `LensMixture.weights` of a round aperture.
inline void lens_weights(const bokehguide::MixtureRows& m, const float* points, const float* density, float* weights) {
    for (Columns at(m.pixels); at.first < m.pixels; at.first += LANES) {
        const Float x = at(points, 0), y = at(points, 1), passes = one_if(x * x + y * y <= all(m.lens_squared_radius));
        at.put(weights, 0, at.flags(m.guided) ? passes / at_least(m.lens_area * at(density, 0), 1e-20f) : all(1.0f));
    }
}

// Densities at one lens point `[2, N]` for each of `count` entries; pixel: of each entry, null for the entry itself. transmission: W
// there, null for a disc.
template <class Shapes>
void evaluate_mixture(const typename Shapes::Rows& m, int64_t count, const int32_t* pixels, const float* x, const float* y,
                      const float* transmission, float* components, float* mixture, float* density) {
    const MixtureDensity<Shapes> of(m);
    for (int64_t first = 0; first < count; first += LANES) {
        const int size = count - first < LANES ? int(count - first) : LANES;
        const Int active = first_lanes(size);
        Int entry = lane_numbers() + int32_t(first);
        entry = active ? entry : all(int32_t(count - 1));
        const Int pixel = pixels == nullptr ? entry : gather(pixels, entry);
        const LensPoint point = {gather(x, entry), gather(y, entry)};
        const Float passes = transmission == nullptr ? of.disc(point) : gather(transmission, entry);
        const Float sum = of.mixture(pixel, point, active, components), q = of.blend(pixel, sum, passes, active);
        for (int lane = 0; lane < size; ++lane) {
            if (mixture != nullptr) mixture[first + lane] = sum[lane];
            density[first + lane] = q[lane];
        }
    }
}

}  // namespace BOKEHGUIDE_ISA
