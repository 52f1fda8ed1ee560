// Reuse of primary hits among neighbouring pixels, as an object of the module.

#pragma once

#include "arrays.h"
#include "tables.h"

namespace bokehguide {

// The light of recorded paths, by the names of `PathLight`; `paths` of them are in use.
PathLight path_light(const Tables& t, const nb::dict& arrays, int64_t paths);

void bind_reuse(nb::module_& m);

}  // namespace bokehguide
