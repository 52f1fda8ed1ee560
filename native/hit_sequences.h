// Sequences of the random numbers of primary hits, which are the same for all paths of a trace.

#pragma once

#include <memory>

#include "random.h"

namespace BOKEHGUIDE_ISA {

// Random dimensions (render/dimensions.py).
constexpr uint32_t PART = 0, SCATTER = 1, SCATTER_COUNT = 4, LIGHT = 5, LIGHT_COUNT = 6, SHADOW = 11;
inline uint32_t vertex_dimension(int depth) { return 32 + 16 * uint32_t(depth - 1); }

// first: step from which the numbers are stratified; lights, bsdf: numbers of candidates for direct light, besides the sample that every
// path has.
class HitSequences {
  public:
    HitSequences(const Random& random, uint32_t first, int lights, int bsdf)
        : part(random, vertex_dimension(1) + PART, 1, first), lights_(new Stratified[size_t(lights)]), bsdf_(new Stratified[size_t(bsdf) + 1]) {
        for (int i = 0; i < lights; ++i) lights_[i] = Stratified(random, vertex_dimension(1) + LIGHT, LIGHT_COUNT, first, uint32_t(i));
        for (int i = 0; i <= bsdf; ++i) bsdf_[i] = Stratified(random, vertex_dimension(1) + SCATTER, SCATTER_COUNT, first, uint32_t(i));
    }

    const Stratified part;
    // Of light candidates from 0 on.
    const Stratified& light(int number) const { return lights_[number]; }
    // Of the BSDF sample by which the path continues (0), and of BSDF candidates from 1 on.
    const Stratified& bsdf(int number) const { return bsdf_[number]; }

  private:
    const std::unique_ptr<Stratified[]> lights_, bsdf_;
};

}  // namespace BOKEHGUIDE_ISA
