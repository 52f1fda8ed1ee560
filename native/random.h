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

// Keys of the random numbers of paths: of their own, and of the paths that share a scramble; member: number of a path among these.
struct PathKeys {
    Bits own, shared, member;
};

constexpr uint32_t LONGEST_EPOCH = 1u << 20;
constexpr int MEMBER_BITS = 7;  // most bits of a member's number: groups of 64, and two copies
// `PixelRandom._in_epoch`.
inline bool in_epoch(const Random& random, uint32_t first) {
    const uint32_t steps = first > 1 ? first - 1 : 1;
    return random.index - (first - 1) < steps && steps <= LONGEST_EPOCH && (steps & (steps - 1)) == 0;
}

// A point of `PixelRandom.stratified`, before it is scrambled. `change` is by what a member differs from member 0, for each bit.
struct Stratified {
    int bits;  // of numbers of members
    bool together;
    uint32_t key[8], point[8], change[MEMBER_BITS][8];

    Stratified() = default;
    Stratified(const Random& random, uint32_t dimension, int count, uint32_t first = 1, uint32_t number = 0)
        : bits(bit_length(random.group)), together(in_epoch(random, first)) {
        uint32_t of_all = hash(random.seed_key + 0x3C6EF372u * dimension + hash(first - 1));
        const uint32_t steps = first > 1 ? first - 1 : 1;
        if (number > 0 && !together) of_all = hash(of_all ^ hash(number));
        const uint32_t index = shuffled(random.index - (first - 1), of_all) + (together ? (steps * number << bits) : 0);
        for (int i = 0; i < count; ++i) {
            key[i] = hash(of_all + uint32_t(i));
            point[i] = sobol_point(random, index, i);
            for (int bit = 0; bit < bits && together; ++bit) {
                change[bit][i] = sobol_point(random, member_index(random, of_all, steps, bit), i);
            }
        }
    }

    // Number `i` of some paths.
    Float operator()(const PathKeys& keys, int i) const {
        Bits values = hash((together ? keys.shared : keys.own) ^ key[i]);
        const Bits columns = (values * 0x9E3779B1u | 0x40000000u) & 0x7FFFFFFFu;
        values ^= product(columns, point[i]);
        for (int bit = 0; bit < bits && together; ++bit) values ^= product(columns, change[bit][i]) & (0u - (keys.member >> bit & 1u));
        return to_unit((values >> 8) & 0x7FFFFFu);
    }

  private:
    // `member_index`.
    static uint32_t member_index(const Random& random, uint32_t key, uint32_t steps, int bit) {
        const uint32_t index = steps << bit;
        return index >= steps * random.group ? index : index | (hash(key - hash(uint32_t(bit))) & (steps - 1));
    }
    static uint32_t sobol_point(const Random& random, uint32_t index, int dimension) {
        uint32_t value = 0;
        for (int bit = 0; bit < bit_length(index); ++bit) {
            if (index >> bit & 1) value ^= uint32_t(random.directions[dimension][bit]);
        }
        return value;
    }
    static Bits product(Bits columns, uint32_t point) {
        Bits sum{};
        for (; point != 0; point &= point - 1) sum ^= columns >> (30 - __builtin_ctz(point));
        return sum;
    }
};

}  // namespace BOKEHGUIDE_ISA
