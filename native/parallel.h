// Loops over ranges on several threads.

#pragma once

#include <algorithm>
#include <cstddef>
#include <future>
#include <vector>

namespace bokehguide {

// Calls `work(first, last)` for consecutive ranges of 0 … count, each on a thread of its own. Throws the first exception of `work`.
template <class Work> void in_ranges(size_t count, int threads, const Work& work) {
    const size_t ranges = std::clamp<size_t>(size_t(std::max(threads, 1)), 1, std::max<size_t>(count, 1));
    std::vector<std::future<void>> others;
    for (size_t range = 1; range < ranges; ++range) {
        others.push_back(std::async(std::launch::async, work, count * range / ranges, count * (range + 1) / ranges));
    }
    work(0, count / ranges);
    for (std::future<void>& other : others) other.get();
}

}  // namespace bokehguide
