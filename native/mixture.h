// Mixtures on the lens plane, as objects of the module.

#pragma once

#include <nanobind/stl/optional.h>

#include <memory>
#include <optional>

#include "arrays.h"
#include "tables.h"

namespace bokehguide {

// `count` lens points, one for each pixel, or for each of `pixels` where not null; transmission: W there, null for a disc.
struct PointsOnLens {
    int64_t count;
    const int32_t* pixels;
    const float *x, *y, *transmission;
};
// Densities of candidates, p_GMM and q; the first two null where nobody asks.
struct Densities {
    float *components, *mixture, *density;
};

// A mixture for each pixel of a batch, by the names of `MixtureRows`.
class Mixture {
  public:
    Mixture(nb::dict arrays, nb::dict numbers) : arrays_(arrays), numbers_(numbers) {}
    Mixture(const Mixture&) = delete;
    virtual ~Mixture() = default;

    virtual const MixtureRows& rows() const = 0;
    // Uniform numbers that `sample` takes for each pixel.
    virtual size_t uniform_count() const = 0;
    virtual void sample(const float* uniforms, float* points, int64_t* candidates) const = 0;
    virtual void evaluate(const PointsOnLens& points, const Densities& densities) const = 0;

  protected:
    // The fields of all mixtures.
    void set(MixtureRows& m);
    double number(const char* name) const { return nb::cast<double>(numbers_[name]); }
    const float* floats(const char* name, size_t size) const { return entry<Floats>(arrays_, name, size).data(); }
    const int64_t* whole(const char* name) const { return nb::cast<Out<const int64_t>>(arrays_[name], false).data(); }
    const nb::dict& arrays() const { return arrays_; }

  private:
    nb::dict arrays_, numbers_;  // the arrays stay alive as long as the mixture
};

void bind_mixture(nb::module_& m);

}  // namespace bokehguide
