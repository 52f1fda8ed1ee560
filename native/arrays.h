// Arrays of PyTorch's tensors, as arguments of functions of the module.

#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>
#include <string>

namespace nb = nanobind;

namespace bokehguide {

using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<const int32_t, nb::c_contig, nb::device::cpu>;
using FloatsOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using IntsOut = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;

template <class Array> void check(const Array& array, size_t size, const char* name) {
    if (array.size() != size) {
        throw std::invalid_argument(std::string(name) + " has " + std::to_string(array.size()) + " entries, not " + std::to_string(size));
    }
}

template <class T> using Out = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

// An array of a dictionary, which must have some number of entries.
template <class Array> Array entry(const nb::dict& arrays, const char* name, size_t size) {
    const auto found = nb::cast<Array>(arrays[name], false);  // a converted copy would end with this function
    check(found, size, name);
    return found;
}

}  // namespace bokehguide
