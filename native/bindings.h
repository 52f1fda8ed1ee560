// Functions that add parts to the Python module.

#pragma once

#include <nanobind/nanobind.h>

namespace bokehguide {

void bind_frame(nanobind::module_& m);
void bind_reports(nanobind::module_& m);
void bind_sums(nanobind::module_& m);

}  // namespace bokehguide
