// The native core for one instruction set; CMake compiles this file once for each.
//
// All functions are inline in a namespace of their own, and none is shared with the other core: the linker would keep only one of
// two equal functions, which a processor might not be able to execute.

#include "kernels.h"
#include "ellipses.h"
#include "film.h"
#include "gaussians.h"
#include "lens_mixture.h"
#include "pixel_reuse.h"
#include "trace.h"

namespace BOKEHGUIDE_ISA {
namespace {

using bokehguide::Camera;

// Some rows of an array `[rows, count]`, eight columns at a time; lanes beyond the end repeat the last column.
struct Columns {
    int64_t count, first = 0;

    explicit Columns(int64_t columns) : count(columns) {}
    int64_t column(int lane) const { return first + lane < count ? first + lane : count - 1; }
    Float operator()(const float* rows, int row) const {
        if (count - first >= LANES) return load<Float>(rows + row * count + first);
        Float found;
        for (int lane = 0; lane < LANES; ++lane) found[lane] = rows[row * count + column(lane)];
        return found;
    }
    Vec3 vector(const float* rows, int row) const { return {(*this)(rows, row), (*this)(rows, row + 1), (*this)(rows, row + 2)}; }
    Int integers(const int32_t* row) const {
        if (count - first >= LANES) return load<Int>(row + first);
        Int found;
        for (int lane = 0; lane < LANES; ++lane) found[lane] = row[column(lane)];
        return found;
    }
    Int active() const { return first_lanes(count - first < LANES ? int(count - first) : LANES); }
    void put(float* rows, int row, Float values) const {
        if (count - first >= LANES) return store(rows + row * count + first, values);
        for (int lane = 0; lane < LANES && first + lane < count; ++lane) rows[row * count + first + lane] = values[lane];
    }
    void put(float* rows, int row, Vec3 v) const { put(rows, row, v.x), put(rows, row + 1, v.y), put(rows, row + 2, v.z); }
    Surface surface(const Tables& t, const float* rows) const {
        Surface s;
        for (int row = 0; row < t.surface_rows; ++row) reinterpret_cast<Float*>(&s)[row] = (*this)(rows, row);
        return s;
    }
    Hits hits(const int32_t* triangle, const float* rows) const {
        return {integers(triangle), (*this)(rows, 0), (*this)(rows, 1), (*this)(rows, 2)};
    }
};

void trace(const Tables& tables, Trace& arguments) { Tracing(tables, arguments).run(); }

void nearest_of(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, int32_t* triangle,
                float* distance, float* u, float* v) {
    nearest(scene, RayRows(origin, direction, count, limits), {triangle, distance, u, v}, count);
}

void visible_of(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, float* passes) {
    visible(scene, RayRows(origin, direction, count, limits), passes, count);
}

void random(const Random& random, int64_t count, const int32_t* pixels, uint32_t dimension, int numbers, int first, int number,
            const int32_t* odd, float* out) {
    const Stratified sequence(random, dimension, first > 0 ? numbers : 0, uint32_t(first > 0 ? first : 1), uint32_t(number));
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Bits pixel = bits<Bits>(at.integers(pixels));
        const PathKeys keys = {pixel, pixel, odd == nullptr ? Bits{} : 0u - bits<Bits>(at.integers(odd))};
        for (int i = 0; i < numbers; ++i) {
            at.put(out, i, first > 0 ? sequence(keys, i) : uniform(random, pixel, dimension + uint32_t(i)));
        }
    }
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

// `ThinLensCamera.rays`.
void camera_rays(const Camera& camera, int64_t count, const float* focus, const float* points, float* origin, float* direction) {
    const float* m = camera.axes;
    const auto turned = [&](Vec3 v) {
        return Vec3{m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z, m[6] * v.x + m[7] * v.y + m[8] * v.z};
    };
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Vec3 point = {at(points, 0), at(points, 1), all(0.0f)};
        const Vec3 place = {all(camera.position[0]), all(camera.position[1]), all(camera.position[2])};
        at.put(origin, 0, turned(point) + place);
        at.put(direction, 0, turned(normalize(at.vector(focus, 0) - point)));
    }
}

// `Guide.records`.
void record_hits(const bokehguide::RecordRaster& r, int64_t count, const float* points, const float* directions, const float* distance,
                 const float* weight, float* positions, int64_t* cells) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Float along = at(distance, 0);
        const Int hit = along < all(r.miss);
        const Vec3 origin = {at(points, 0) * one_if(hit), at(points, 1) * one_if(hit), all(0.0f)};
        const Vec3 position = origin + at.vector(directions, 0) * (hit ? along : all(r.far));
        at.put(positions, 0, position);
        const Float scale = 1.0f / (position.z * r.pixel_slope), border = to_float(all(r.border));
        const Float column = floor(r.half_width + position.x * scale + border), row = floor(r.half_height - position.y * scale + border);
        const Float width = to_float(all(r.width)), height = to_float(all(r.height));
        const Int inside = (position.z > all(0.0f)) & (column >= all(0.0f)) & (column < width) & (row >= all(0.0f)) & (row < height);
        const Int counts = inside & (at(weight, 0) > all(0.0f));
        const Int x = to_int(counts ? column : all(0.0f)), y = to_int(counts ? row : all(0.0f));
        for (int lane = 0; lane < LANES && at.first + lane < count; ++lane) {
            cells[at.first + lane] = counts[lane] ? int64_t(y[lane]) * r.width + x[lane] : -1;
        }
    }
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
        const LightSample light = sample_light(t, PointQuery(t, at.vector(points, 0)), u, at.active());
        at.put(out, 0, light.direction), at.put(out, 3, light.distance), at.put(out, 4, light.radiance), at.put(out, 7, light.pdf);
    }
}

void environment(const Tables& t, int64_t count, const float* points, const float* direction, float* out) {
    for (Columns at(count); at.first < count; at.first += LANES) {
        const Vec3 towards = at.vector(direction, 0);
        at.put(out, 0, environment_radiance(t, towards)), at.put(out, 3, environment_alpha(t, towards));
        at.put(out, 4, environment_pdf(t, at.vector(points, 0), towards));
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
extern const Kernels kernels = {isa::trace, isa::nearest_of, isa::visible_of, isa::expose_all, isa::camera_rays, isa::record_hits, isa::random,
                                isa::find_views, isa::trace_views, isa::add_views,
                                isa::mixture_kernels<isa::EllipseShapes>(), isa::mixture_kernels<isa::GaussianShapes>(), isa::add_offset_gradient,
                                isa::surfaces, isa::evaluate, isa::sample, isa::lights, isa::environment, isa::emitters};
}  // namespace BOKEHGUIDE_TARGET
}  // namespace bokehguide
