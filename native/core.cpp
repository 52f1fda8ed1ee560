// The native core for one instruction set; CMake compiles this file once for each.
//
// All functions are inline in a namespace of their own, and none is shared with the other core: the linker would keep only one of
// two equal functions, which a processor might not be able to execute.

#include "kernels.h"
#include "trace.h"

namespace BOKEHGUIDE_ISA {
namespace {

// Some rows of an array `[rows, count]`, eight columns at a time; lanes beyond the end repeat the last column.
struct Columns {
    int64_t count, first = 0;

    explicit Columns(int64_t columns) : count(columns) {}
    int64_t column(int lane) const { return first + lane < count ? first + lane : count - 1; }
    Float operator()(const float* rows, int row) const {
        Float found;
        for (int lane = 0; lane < LANES; ++lane) found[lane] = rows[row * count + column(lane)];
        return found;
    }
    Vec3 vector(const float* rows, int row) const { return {(*this)(rows, row), (*this)(rows, row + 1), (*this)(rows, row + 2)}; }
    Int integers(const int32_t* row) const {
        Int found;
        for (int lane = 0; lane < LANES; ++lane) found[lane] = row[column(lane)];
        return found;
    }
    Int active() const { return first_lanes(count - first < LANES ? int(count - first) : LANES); }
    void put(float* rows, int row, Float values) const {
        for (int lane = 0; lane < LANES && first + lane < count; ++lane) rows[row * count + first + lane] = values[lane];
    }
    void put(float* rows, int row, Vec3 v) const { put(rows, row, v.x), put(rows, row + 1, v.y), put(rows, row + 2, v.z); }
    Surface surface(const float* rows) const {
        Surface s;
        for (int row = 0; row < SURFACE_ROWS; ++row) reinterpret_cast<Float*>(&s)[row] = (*this)(rows, row);
        return s;
    }
    Hits hits(const int32_t* triangle, const float* rows) const {
        return {integers(triangle), (*this)(rows, 0), (*this)(rows, 1), (*this)(rows, 2)};
    }
    bool next() { return (first += LANES) < count; }
};

void trace(const Tables& tables, Trace& arguments) { Tracing(tables, arguments).run(); }

void nearest_of(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, int32_t* triangle,
                float* distance, float* u, float* v) {
    nearest(scene, RayRows(origin, direction, count, limits), {triangle, distance, u, v}, count);
}

void visible_of(void* scene, int64_t count, const float* origin, const float* direction, const float* limits, float* passes) {
    visible(scene, RayRows(origin, direction, count, limits), passes, count);
}

void random(const Random& random, int64_t count, const int32_t* pixels, uint32_t dimension, int numbers, int first, float* out) {
    Columns at(count);
    do {
        const Bits pixel = bits<Bits>(at.integers(pixels));
        for (int i = 0; i < numbers; ++i) {
            at.put(out, i, first > 0 ? Stratified(random, dimension, numbers, uint32_t(first))(pixel, i)
                                     : uniform(random, pixel, dimension + uint32_t(i)));
        }
    } while (at.next());
}

void surfaces(const Tables& t, int64_t count, const float* origin, const float* direction, const int32_t* triangle, const float* hits,
              float* rows) {
    Columns at(count);
    do {
        const Surface s = surface_at(t, at.vector(origin, 0), at.vector(direction, 0), at.hits(triangle, hits), at.active());
        for (int row = 0; row < SURFACE_ROWS; ++row) at.put(rows, row, reinterpret_cast<const Float*>(&s)[row]);
    } while (at.next());
}

void evaluate(const Tables& t, int64_t count, const float* rows, const float* choice, const float* direction, float* out) {
    Columns at(count);
    do {
        const Surface s = at.surface(rows);
        const Scattered found = Scattering(t, s, at(choice, 0)).evaluate(at.vector(direction, 0));
        at.put(out, 0, found.value), at.put(out, 3, found.pdf);
    } while (at.next());
}

void sample(const Tables& t, int64_t count, const float* rows, const float* choice, const float* uniforms, float* out) {
    Columns at(count);
    do {
        const Surface s = at.surface(rows);
        Vec3 weight;
        Float pdf;
        const Scattering scattering(t, s, at(choice, 0));
        at.put(out, 0, scattering.sample(at(uniforms, 0), at(uniforms, 1), at(uniforms, 2), weight, pdf));
        at.put(out, 3, weight), at.put(out, 6, pdf);
    } while (at.next());
}

void lights(const Tables& t, int64_t count, const float* points, const float* uniforms, float* out) {
    Columns at(count);
    do {
        Float u[6];
        for (int i = 0; i < 6; ++i) u[i] = at(uniforms, i);
        const LightSample light = sample_light(t, PointQuery(t, at.vector(points, 0)), u, at.active());
        at.put(out, 0, light.direction), at.put(out, 3, light.distance), at.put(out, 4, light.radiance), at.put(out, 7, light.pdf);
    } while (at.next());
}

void environment(const Tables& t, int64_t count, const float* points, const float* direction, float* out) {
    Columns at(count);
    do {
        const Vec3 towards = at.vector(direction, 0);
        at.put(out, 0, environment_radiance(t, towards)), at.put(out, 3, environment_alpha(t, towards));
        at.put(out, 4, environment_pdf(t, at.vector(points, 0), towards));
    } while (at.next());
}

void emitters(const Tables& t, int64_t count, const float* points, const float* direction, const int32_t* triangle, const float* hits,
              float* out) {
    Columns at(count);
    do {
        const Hits hit = at.hits(triangle, hits);
        const Float front = at(hits, 3), cosine = at(hits, 4);
        at.put(out, 0, emission(t, hit, front, at.vector(direction, 0), at.active()));
        at.put(out, 3, triangle_pdf(t, at.vector(points, 0), hit.triangle, hit.distance, cosine));
        at.put(out, 4, t.translucent == nullptr ? all(1.0f) : opacity(t, hit, at.active()));
        at.put(out, 5, t.absorption == nullptr ? grey(all(1.0f)) : transmittance(t, hit, front));
    } while (at.next());
}

}  // namespace
}  // namespace BOKEHGUIDE_ISA

namespace bokehguide {
namespace BOKEHGUIDE_TARGET {
namespace isa = ::BOKEHGUIDE_ISA;
extern const Kernels kernels = {isa::trace, isa::nearest_of, isa::visible_of, isa::random, isa::surfaces, isa::evaluate, isa::sample,
                                isa::lights, isa::environment, isa::emitters};
}  // namespace BOKEHGUIDE_TARGET
}  // namespace bokehguide
