// Arrays of PyTorch's tensors, as arguments of functions of the module.

#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>
#include <string>

namespace nb = nanobind;

namespace bokehguide {

template <class T> using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

// The memory of a tensor of PyTorch, or of another contiguous array.
template <class T> struct Out : Array<T> {};

using Floats = Out<const float>;
using Ints = Out<const int32_t>;
using FloatsOut = Out<float>;
using IntsOut = Out<int32_t>;

template <class T> void check(const Array<T>& array, size_t size, const char* name) {
    if (array.size() != size) {
        throw std::invalid_argument(std::string(name) + " has " + std::to_string(array.size()) + " entries, not " + std::to_string(size));
    }
}

// An array of a dictionary, which must have some number of entries.
template <class Found> Found entry(const nb::dict& arrays, const char* name, size_t size) {
    const auto found = nb::cast<Found>(arrays[name], false);  // a converted copy would end with this function
    check(found, size, name);
    return found;
}

// PyTorch's class of tensors and its conversion to DLPack, from the start of the module on.
inline nb::handle tensor_class, to_dlpack;

inline void import_torch() {
    tensor_class = nb::object(nb::module_::import_("torch").attr("Tensor")).release();
    to_dlpack = nb::object(nb::module_::import_("torch.utils.dlpack").attr("to_dlpack")).release();
}

// A DLPack capsule of a tensor, invalid for other objects and for tensors that have none.
inline nb::object lent(nb::handle source) noexcept {
    try {
        return nb::isinstance(source, tensor_class) ? to_dlpack(source) : nb::object();
    } catch (nb::python_error&) {
        return {};
    }
}

}  // namespace bokehguide

// `Tensor.__dlpack__`, which nanobind calls for an `Array`, takes ten times as long, because it is Python code.
template <class T> struct nanobind::detail::type_caster<bokehguide::Out<T>> {
    NB_TYPE_CASTER(bokehguide::Out<T>, make_caster<bokehguide::Array<T>>::Name)

    bool from_python(handle source, uint32_t flags, cleanup_list* cleanup) noexcept {
        make_caster<bokehguide::Array<T>> array;
        if constexpr (!std::is_const_v<T>) flags &= ~uint32_t(cast_flags::convert);  // a copy would keep what the core writes
        const object capsule = bokehguide::lent(source);
        const bool found = capsule.is_valid() && array.from_python(capsule, flags, cleanup);
        if (!found && !array.from_python(source, flags, cleanup)) return false;  // may convert the type
        static_cast<bokehguide::Array<T>&>(value) = std::move(array.value);
        return true;
    }
};
