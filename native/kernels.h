// The functions that a core for one instruction set provides.

#pragma once

#include "tables.h"

namespace bokehguide {

// Mixtures on the lens: shapes and weights; lens points `[2, N]`, which hold those of the uniform lens, and candidates, null for none;
// densities.
template <class Rows> struct MixtureKernels {
    void (*prepare)(const Rows&);
    void (*sample)(const Rows&, const float* uniforms, float* points, int64_t* candidates);
    void (*evaluate)(const Rows&, int64_t count, const int32_t* pixels, const float* x, const float* y, const float* transmission,
                     float* components, float* mixture, float* density);
};

struct Kernels {
    void (*trace)(const Tables&, Trace&);
    // Nearest hits of rays `[3, N]` within `limits` `[N]`, null for none; a miss has the triangle -1.
    void (*nearest)(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, int32_t* triangle,
                    float* distance, float* u, float* v);
    // 1 where rays meet nothing within `limits`, else 0.
    void (*visible)(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, float* visible);
    // Adds samples of pixels from `first` on, or of `pixels`; `good` is 1 for the finite ones. Returns whether all are.
    bool (*expose)(const FilmSums&, const FilmSamples&, const int64_t* pixels, int64_t first, bool recenter, uint8_t* good);
    // Pixels and their rays: see camera.h.
    void (*pixel_keys)(uint32_t seed, int64_t count, const PixelNumbers&, int32_t* keys);
    void (*random_numbers)(const Random&, int64_t count, const int32_t* pixels, uint32_t dimension, int numbers, int first, int number,
                           const int32_t* member, const uint8_t* replaced, float* out);
    void (*film_positions)(const FilmFrame&, const Random&, uint32_t dimension, int64_t count, const PixelNumbers&, const int32_t* keys, float* rows);
    void (*sample_disc)(float radius, int64_t count, const float* uniforms, float* points);
    void (*camera_rays)(const Camera&, int64_t count, const float* focus, const float* points, float* origin, float* direction);
    void (*camera_depths)(const Camera&, int64_t count, const float* distance, const float* directions, float miss, float none, float* depths);
    // Reports to a guide: see guide.h.
    void (*record_hits)(const RecordRaster&, const Camera&, int64_t count, const float* points, const float* directions, const float* distance,
                        const float* weight, float* positions, int64_t* cells);
    void (*recorded_light)(const GuideSamples&, const KnownEmission&, float* light);
    void (*apparent_distances)(int64_t count, const float* radiance, const float* distance, const float* images, float bright, float miss, float* found);
    void (*weigh_samples)(const GuideSamples&, const MixtureSamples&, float* weights, float* ratios, double* figures);
    int64_t (*learn_emitters)(const EmitterDraws&, int64_t count, const PixelNumbers&, int64_t frame, float* moments, int32_t* slots, float* squares);
    void (*success_rates)(const SuccessTiles&, int64_t count, const PixelNumbers&, const int64_t* start, const int64_t* components, int32_t* slots,
                          float* rates);
    // Incident light `[6, path_columns]` of the paths of a record from the radiance that they reflect (`PrimaryHits.reflection`).
    void (*incident_light)(const PathLight&, const float* reflected, float* incident);
    // Views of recorded hits by other pixels: those that their lens contains; those of them that nothing blocks, with the number of
    // rays and the seconds in Embree; and the radiance `[3, N]` and weights `[N]` of all pixels, given the densities of all views.
    void (*find_views)(const Tables&, const LensCamera&, const PixelGroups&, const LensSamples&, const HitRecord&, float min_spread,
                       ViewRows&);
    int64_t (*trace_views)(const Tables&, const LensCamera&, const LensSamples&, const HitRecord&, ViewRows&, double* seconds);
    void (*add_views)(const Tables&, const LensSamples&, const HitRecord&, const ViewRows&, const OwnSamples&, const float* density,
                      const ReusedGroups*, float* radiance, float* weight);
    MixtureKernels<EllipseRows> ellipses;
    MixtureKernels<GaussianRows> gaussians;
    // Weights of lens points `[2, N]` with densities `[N]` (`LensMixture.weights`), of a round aperture.
    void (*lens_weights)(const MixtureRows&, const float* points, const float* density, float* weights);
    // Adds the gradient of the offsets' coefficients to sums by component and monomial (`offset_gradient` of models/kl.py).
    void (*add_offset_gradient)(const GaussianRows&, const float* points, const float* components, const float* ratio, const float* density,
                                double* sums);
    // Stages of a trace, for tests.
    void (*surfaces)(const Tables&, int64_t count, const float* origin, const float* direction, const int32_t* triangle,
                     const float* hits, float* rows);
    void (*evaluate)(const Tables&, int64_t count, const float* rows, const float* choice, const float* direction, float* out);
    void (*sample)(const Tables&, int64_t count, const float* rows, const float* choice, const float* uniforms, float* out);
    void (*lights)(const Tables&, int64_t count, const float* points, const float* uniforms, float* out);
    void (*environment)(const Tables&, int64_t count, const float* points, const float* direction, float* out);
    void (*emitters)(const Tables&, int64_t count, const float* points, const float* direction, const int32_t* triangle,
                     const float* hits, float* out);
};

namespace baseline {
extern const Kernels kernels;
}
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}

}  // namespace bokehguide
