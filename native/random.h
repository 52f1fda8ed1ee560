// Random numbers of render/random.py: the same bits.

#pragma once

#include "simd.h"
#include "tables.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::Random;

inline uint32_t hash(uint32_t x) {
    x = (x ^ (x >> 16)) * 0x7FEB352Du;
    x = (x ^ (x >> 15)) * 0x846CA68Bu;
    return x ^ (x >> 16);
}

inline Bits hash(Bits x) {
    x = (x ^ (x >> 16)) * 0x7FEB352Du;
    x = (x ^ (x >> 15)) * 0x846CA68Bu;
    return x ^ (x >> 16);
}

inline Float to_unit(Bits upper) { return (to_float(bits<Int>(upper)) + 0.5f) * 0x1p-23f; }

// `PixelRandom.uniform`: the number of one dimension.
inline Float uniform(const Random& random, Bits pixel, uint32_t dimension) {
    const uint32_t key = hash(random.step_key + 0x3C6EF372u * dimension);
    return to_unit(hash(pixel ^ key) >> 9);
}

inline int bit_length(uint32_t x) { return x == 0 ? 0 : 32 - __builtin_clz(x); }

// `shuffle_index`.
inline uint32_t shuffled(uint32_t index, uint32_t key) {
    uint32_t flips = 0;
    for (int bit = 1; bit < bit_length(index); ++bit) flips |= (hash(key + hash((index >> bit) * 32 + bit)) & 1) << (bit - 1);
    return index ^ flips;
}

// A point of `PixelRandom.stratified`, before it is scrambled for each pixel.
struct Stratified {
    uint32_t key, point[8];

    Stratified(const Random& random, uint32_t dimension, int count, uint32_t first = 1) {
        key = hash(random.seed_key + 0x3C6EF372u * dimension + hash(first - 1));
        const uint32_t index = shuffled(random.index - (first - 1), key);
        for (int i = 0; i < count; ++i) {
            point[i] = 0;
            for (int bit = 0; bit < bit_length(index); ++bit) {
                if (index >> bit & 1) point[i] ^= uint32_t(random.directions[i][bit]);
            }
        }
    }

    // Number `i` of some pixels.
    Float operator()(Bits pixel, int i) const {
        Bits values = hash(pixel ^ hash(key + uint32_t(i)));
        const Bits columns = (values * 0x9E3779B1u | 0x40000000u) & 0x7FFFFFFFu;
        for (uint32_t rest = point[i]; rest != 0; rest &= rest - 1) values ^= columns >> (30 - __builtin_ctz(rest));
        return to_unit((values >> 8) & 0x7FFFFFu);
    }
};

}  // namespace BOKEHGUIDE_ISA
