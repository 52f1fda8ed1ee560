// The native core for one instruction set; CMake compiles this file once for each.
//
// All functions are inline in a namespace of their own, and none is shared with the other core: the linker would keep only one of
// two equal functions, which a processor might not be able to execute.

#include "kernels.h"
#include "camera.h"
#include "ellipses.h"
#include "film.h"
#include "gaussians.h"
#include "guide.h"
#include "lens_mixture.h"
#include "pixel_reuse.h"
#include "trace.h"

namespace BOKEHGUIDE_ISA {
namespace {

void trace(const Tables& tables, Trace& arguments) { Tracing(tables, arguments).run(); }

void nearest_of(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, int32_t* triangle,
                float* distance, float* u, float* v) {
    nearest(scene, RayRows(origin, direction, count, limits), {triangle, distance, u, v}, count);
}

void visible_of(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, float* passes) {
    visible(scene, RayRows(origin, direction, count, limits), passes, count);
}

bool expose_all(const FilmSums& film, const FilmSamples& samples, const int64_t* pixels, int64_t first, bool recenter, uint8_t* good) {
    bool clean = true;
    for (int64_t i = 0; i < samples.count; i += LANES) {
        const int count = samples.count - i < LANES ? int(samples.count - i) : LANES;
        const PixelLanes lanes = {pixels == nullptr ? nullptr : pixels + i, first + i, count};
        const Int finite = expose(film, samples, lanes, {nullptr, i, count}, recenter);
        for (int lane = 0; lane < count; ++lane) good[i + lane] = finite[lane] != 0, clean = clean && finite[lane] != 0;
    }
    return clean;
}

void surfaces(const Tables& t, int64_t count, const float* origin, const float* direction, const int32_t* triangle, const float* hits,
              float* rows) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Surface s = surface_at(t, at.vector(origin, 0), at.vector(direction, 0), at.hits(triangle, hits), at.active());
        for (int row = 0; row < t.surface_rows; ++row) at.put(rows, row, reinterpret_cast<const Float*>(&s)[row]);
    }
}

void evaluate(const Tables& t, int64_t count, const float* rows, const float* choice, const float* direction, float* out) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Surface s = at.surface(t, rows);
        const Scattered found = Scattering(t, s, at(choice, 0)).evaluate(at.vector(direction, 0));
        at.put(out, 0, found.value), at.put(out, 3, found.pdf);
    }
}

void sample(const Tables& t, int64_t count, const float* rows, const float* choice, const float* uniforms, float* out) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Surface s = at.surface(t, rows);
        Vec3 weight, value;
        Float pdf;
        const Scattering scattering(t, s, at(choice, 0));
        at.put(out, 0, scattering.sample(at(uniforms, 0), at(uniforms, 1), at(uniforms, 2), weight, pdf, value));
        at.put(out, 3, weight), at.put(out, 6, pdf);
    }
}

void lights(const Tables& t, int64_t count, const float* points, const float* uniforms, float* out) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        Float u[6];
        for (int i = 0; i < 6; ++i) u[i] = at(uniforms, i);
        const Vec3 point = at.vector(points, 0);
        const LightSample light = sample_light(t, point, choose_light(t, PointQuery(t, point), u, at.active()).find(t, nullptr), at.active());
        at.put(out, 0, light.direction), at.put(out, 3, light.distance), at.put(out, 4, light.radiance), at.put(out, 7, light.pdf);
    }
}

void environment(const Tables& t, int64_t count, const float* points, const float* direction, float* out) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Vec3 towards = at.vector(direction, 0);
        at.put(out, 0, environment_radiance(t, on_map(t, towards))), at.put(out, 3, environment_alpha(t, towards));
        at.put(out, 4, environment_pdf(t, at.vector(points, 0), on_map(t, towards)));
    }
}

void emitters(const Tables& t, int64_t count, const float* points, const float* direction, const int32_t* triangle, const float* hits,
              float* out) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Hits hit = at.hits(triangle, hits);
        const Float front = at(hits, 3), cosine = at(hits, 4);
        at.put(out, 0, emission(t, hit, front, at.vector(direction, 0), at.active()));
        at.put(out, 3, triangle_pdf(t, at.vector(points, 0), hit.triangle, hit.distance, cosine));
        at.put(out, 4, t.translucent == nullptr ? all(1.0f) : opacity(t, hit, at.active()));
        at.put(out, 5, t.absorption == nullptr ? grey(all(1.0f)) : transmittance(t, hit, front));
    }
}

template <class Shapes> constexpr bokehguide::MixtureKernels<typename Shapes::Rows> mixture_kernels() {
    return {prepare_mixture<Shapes>, sample_mixture<Shapes>, evaluate_mixture<Shapes>};
}

}  // namespace
}  // namespace BOKEHGUIDE_ISA

namespace bokehguide {
namespace BOKEHGUIDE_TARGET {
namespace isa = ::BOKEHGUIDE_ISA;
extern const Kernels kernels = {isa::trace, isa::nearest_of, isa::visible_of, isa::expose_all,
                                isa::pixel_keys, isa::random_numbers, isa::film_positions, isa::sample_disc, isa::camera_rays, isa::camera_depths,
                                isa::record_hits, isa::recorded_light, isa::apparent_distances, isa::weigh_samples, isa::learn_emitters, isa::success_rates,
                                isa::incident_of, isa::find_views, isa::trace_views, isa::add_views,
                                isa::mixture_kernels<isa::EllipseShapes>(), isa::mixture_kernels<isa::GaussianShapes>(), isa::lens_weights, isa::add_offset_gradient,
                                isa::surfaces, isa::evaluate, isa::sample, isa::lights, isa::environment, isa::emitters};
}  // namespace BOKEHGUIDE_TARGET
}  // namespace bokehguide
