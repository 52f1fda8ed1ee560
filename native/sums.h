// Sums over samples, as functions of the module.

#pragma once

#include <nanobind/nanobind.h>

namespace bokehguide {

void bind_sums(nanobind::module_& m);

}  // namespace bokehguide
