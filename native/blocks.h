// Blocks of paths and rays, whose rows stay in the cache.

#pragma once

#include "rays.h"

namespace BOKEHGUIDE_ISA {

// Entries of a block; entries of a row, so that rows of a power of two do not share sets of the cache.
constexpr int BLOCK = 1024, ROW = BLOCK + 16;

typedef float Row[ROW];
typedef int32_t IntRow[ROW];

inline Vec3 load3(const Row* rows, int first) { return {load<Float>(rows[0] + first), load<Float>(rows[1] + first), load<Float>(rows[2] + first)}; }
inline void store3(Row* rows, int first, Vec3 v) { store(rows[0] + first, v.x), store(rows[1] + first, v.y), store(rows[2] + first, v.z); }
inline Vec3 gather3(const Row* rows, Int index) { return {gather(rows[0], index), gather(rows[1], index), gather(rows[2], index)}; }

// Keeps the entries of a list for which a condition holds; returns their number. Entries up to the next whole vector are 0.
template <class Condition> int keep_if(IntRow& list, int count, Condition keeps) {
    int kept = 0;
    for (int i = 0; i < count; ++i) {
        if (keeps(list[i])) list[kept++] = list[i];
    }
    for (int i = kept; i < (kept + LANES - 1) / LANES * LANES; ++i) list[i] = 0;
    return kept;
}

}  // namespace BOKEHGUIDE_ISA
