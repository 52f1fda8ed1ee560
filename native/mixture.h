// Mixtures of shapes on the lens plane, as objects of the module.

#pragma once

#include <nanobind/stl/optional.h>

#include <memory>
#include <optional>

#include "arrays.h"
#include "tables.h"

namespace bokehguide {

// A mixture for each pixel of a batch, by the names of `MixtureRows`.
class EllipseMixture {
  public:
    EllipseMixture(nb::dict arrays, nb::dict numbers, nb::object environment, nb::object parallelograms);
    EllipseMixture(const EllipseMixture&) = delete;

    void sample(const Floats& uniforms, FloatsOut points, Out<int64_t> candidates) const;
    void evaluate(const Floats& points, const std::optional<Floats>& transmission, FloatsOut components, FloatsOut mixture, FloatsOut density) const;

    const MixtureRows& rows() const { return rows_; }

  private:
    nb::dict arrays_;
    nb::object environment_, parallelograms_;
    MixtureRows rows_{};
    std::unique_ptr<float[]> memory_;
};

void bind_mixture(nb::module_& m);

}  // namespace bokehguide
