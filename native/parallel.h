// Loops over ranges on several threads.

#pragma once

#include <algorithm>
#include <cstddef>
#include <future>
#include <vector>

namespace bokehguide {

// Least number of entries for which another thread starts: the start takes as long as the work on some thousand entries.
constexpr size_t ENTRIES_PER_THREAD = 1 << 14;

// Calls `work(first, last)` for consecutive ranges of 0 … count, each on a thread of its own. Throws the first exception of `work`.
// entries: number of entries that all ranges process together.
template <class Work> void in_ranges(size_t count, size_t entries, int threads, const Work& work) {
    const size_t most = std::min({size_t(std::max(threads, 1)), entries / ENTRIES_PER_THREAD, count}), ranges = std::max<size_t>(most, 1);
    std::vector<std::future<void>> others;
    for (size_t range = 1; range < ranges; ++range) {
        others.push_back(std::async(std::launch::async, work, count * range / ranges, count * (range + 1) / ranges));
    }
    work(0, count / ranges);
    for (std::future<void>& other : others) other.get();
}

}  // namespace bokehguide
