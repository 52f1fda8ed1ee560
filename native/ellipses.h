// Ellipses and other shapes as components of a mixture on the lens: models/ellipse_mixture.py, for a vector of candidates at a time.

#pragma once

#include "environment_shapes.h"
#include "parallelograms.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::ELLIPSE_ROW;

constexpr float MIN_SQUARED_ASPECT = 1e-4f, MAX_SQUARED_DEPTH = 0.9f, MIN_CLIP_END = -0.9f, MIN_STRIP_SHARE = 1e-7f, INSIDE = 1.0f - 1e-6f;

// A vector of ellipses (`Ellipses`), in the order of the numbers in a row of `EllipseRows::ellipses`.
struct Ellipse {
    Float x, y, width, tilt, height, across, up, low, high, below, share;
};
constexpr int ELLIPSE_FIELDS = sizeof(Ellipse) / sizeof(Float);
static_assert(ELLIPSE_FIELDS < ELLIPSE_ROW);

inline Ellipse load_ellipse(const EllipseRows& m, Int candidate) {
    const RowFields<ELLIPSE_ROW / 4> fields([&](int lane) { return m.ellipses + ELLIPSE_ROW * int64_t(candidate[lane]); });
    Ellipse e;
    for (int field = 0; field < ELLIPSE_FIELDS; ++field) reinterpret_cast<Float*>(&e)[field] = fields(field);
    return e;
}
inline void store_ellipse(const EllipseRows& m, int64_t first, const Ellipse& e) {
    for (int field = 0; field < ELLIPSE_FIELDS; ++field) {
        const Float values = reinterpret_cast<const Float*>(&e)[field];
        for (int lane = 0; lane < LANES; ++lane) m.ellipses[ELLIPSE_ROW * (first + lane) + field] = values[lane];
    }
}

// `_disc_cdf`.
inline Float disc_cdf(Float x) {
    x = clamp(x, -1.0f, 1.0f);
    const Float root = sqrt(1.0f - x * x);
    return (polar_angle(root, -x) + x * root) / PI;
}

// `_disc_quantile`.
inline Float disc_quantile(Float share) {
    const Float half = at_least(min(share, 1.0f - share), 0.0f);
    Float angle = at_least(1.5f * PI * half, TINY);
    for (int lane = 0; lane < LANES; ++lane) angle[lane] = __builtin_cbrtf(angle[lane]);
    angle = angle + angle * angle * angle / 15.0f;
    Float sine, cosine;
    for (int step = 0; step < 3; ++step) {
        sincos(angle, sine, cosine);
        angle = angle - 0.5f * (angle - sine * cosine - PI * half) / at_least(sine * sine, 1e-12f);
    }
    sincos(angle, sine, cosine);
    return share < all(0.5f) ? -cosine : cosine;
}

// `_towards_center`: distance of the centre, and the two components of Lᵀu.
struct Towards {
    Float distance, across, up;

    Towards(const Ellipse& e, float lens_radius) {
        distance = sqrt(e.x * e.x + e.y * e.y);
        const Int centred = distance < all(1e-6f * lens_radius);
        const Float length = centred ? all(1.0f) : distance, x = centred ? all(1.0f) : e.x / length, y = e.y / length;
        across = e.width * x + e.tilt * y, up = e.height * y;
    }
};

// `overlap`.
inline Float overlap(const Ellipse& e, float lens_radius) {
    const Towards towards(e, lens_radius);
    const Float reach = at_least(sqrt(towards.across * towards.across + towards.up * towards.up), TINY);
    const Float inside = clamp((lens_radius + reach - towards.distance) / (2.0f * min(reach, all(lens_radius))), 0.0f, 1.0f);
    return inside * at_most(lens_radius * lens_radius / (e.width * e.height), 1.0f);
}

// `_strip_clip`.
inline void clip_strip(Ellipse& e, float lens_radius) {
    const Towards towards(e, lens_radius);
    const Float reach = at_least(sqrt(towards.across * towards.across + towards.up * towards.up), TINY);
    e.low = (-LENS_MARGIN * lens_radius - towards.distance) / reach;
    e.high = at_least((LENS_MARGIN * lens_radius - towards.distance) / reach, MIN_CLIP_END);
    e.below = disc_cdf(e.low);
    e.share = at_least(disc_cdf(e.high) - e.below, MIN_STRIP_SHARE);
    e.across = towards.across / reach, e.up = towards.up / reach;
}

// `_ellipses`: outlines of ellipsoids on the lens.
inline Ellipse outline_on_lens(const EllipseRows& m, Vec3 mean, Int component, Vec3 focus) {
    const Float gap = focus.z - mean.z, x = (mean.x - focus.x) / gap, y = (mean.y - focus.y) / gap, squared = gap * gap;
    const auto outline = [&](int row) { return gather(m.outline + row * m.components, component) / squared; };
    const Float xx = outline(0), xy = outline(1), yy = outline(3);
    Float xz = outline(2), yz = outline(4), zz = outline(5);
    const Float shortened = at_most(sqrt(MAX_SQUARED_DEPTH / at_least(zz, TINY)), 1.0f);
    xz = shortened * xz, yz = shortened * yz, zz = shortened * shortened * zz;
    const Float scale = focus.z / (1.0f - zz);
    const LensPoint projected = project_to_lens(mean, focus);
    Ellipse e = {};
    e.x = projected.x + scale * (xz + x * zz), e.y = projected.y + scale * (yz + y * zz);
    const Float m_xx = xx + x * (2.0f * xz + x * zz) - (xx * zz - xz * xz);
    const Float m_xy = xy + y * xz + x * yz + x * y * zz - (xy * zz - xz * yz);
    const Float m_yy = yy + y * (2.0f * yz + y * zz) - (yy * zz - yz * yz);
    const Float width = sqrt(at_least(m_xx, 1e-37f)), tilt = m_xy / width, least = MIN_SQUARED_ASPECT * m_yy, rest = m_yy - tilt * tilt;
    const Float height = sqrt(rest < least ? least : rest);
    e.width = scale * width, e.tilt = scale * tilt, e.height = scale * height;
    e.across = all(1.0f), e.up = all(0.0f), e.low = all(-2.0f), e.high = all(2.0f), e.below = all(0.0f), e.share = all(1.0f);
    if (m.clips) clip_strip(e, m.lens_radius);
    return e;
}

// Whether whole ellipses are inside the lens circle (`_inside_lens`).
inline Int whole_inside(const Ellipse& e, float lens_radius) {
    const Float m_xx = e.width * e.width, m_xy = e.width * e.tilt, m_yy = e.tilt * e.tilt + e.height * e.height;
    const Float long_axis = sqrt(0.5f * (m_xx + m_yy) + sqrt(0.25f * square(m_xx - m_yy) + m_xy * m_xy));
    return sqrt(e.x * e.x + e.y * e.y) + long_axis < all(lens_radius);
}

// Ellipses, emitters of the map and parallelograms as the components of a mixture (lens_mixture.h).
class EllipseShapes {
  public:
    using Rows = EllipseRows;
    // What some lens points see of the map.
    struct Seen {
        MapPoint points[LANES];
    };

    explicit EllipseShapes(const Rows& rows) : m(rows) {}

    // Prepares a pixel for its candidates.
    void begin(int64_t pixel) const {
        bool map = false;
        for (int64_t i = m.start[pixel]; i < m.start[pixel + 1]; ++i) {
            map = map || (m.environment != nullptr && m.environment_index[m.given[i]] >= 0);
        }
        m.sees_map[pixel] = map ? -1 : 0;
        if (!map) return;
        const double focus[3] = {m.focus[pixel], m.focus[m.pixels + pixel], m.focus[2 * m.pixels + pixel]};
        const LensCone cone(*m.environment, focus, double(m.lens_radius));
        double* const row = m.cones + 3 * pixel;
        row[0] = cone.column, row[1] = cone.theta, row[2] = cone.reach;
    }
    // The shapes and contributions of a vector of candidates.
    void shape(int64_t first) const {
        const Int owner = load<Int>(m.owner + first), component = load<Int>(m.component + first);
        const Vec3 focus = gather3(m.focus, m.pixels, owner), mean = gather3(m.mean, m.components, component);
        const Ellipse e = outline_on_lens(m, mean, component, focus);
        store_ellipse(m, first, e);
        const Float strength = gather(m.strength, component), inside = overlap(e, m.lens_radius);
        Float contribution = strength * sqrt(inside * e.share);
        const Int whole = whole_inside(e, m.lens_radius);
        for (int lane = 0; lane < LANES && m.environment != nullptr; ++lane) {
            const int64_t number = m.environment_index[component[lane]];
            if (number < 0) continue;
            const float share = see_emitter(first + lane, number, owner[lane], whole[lane]);
            contribution[lane] = strength[lane] * (inside[lane] < share ? inside[lane] : share);
        }
        if (m.parallelograms != nullptr) {
            const Int number = numbers_of(m.parallelogram_index, component), shown = number >= 0;
            if (any(shown)) {
                const Parallelogram p(*m.parallelograms, shown ? number : all(0), focus, m.lens_radius);
                const Window window = p.window();
                const Float seen = gather(m.parallelograms->luminance, shown ? number : all(0)) * p.area_on_lens(window) / PI;
                contribution = shown ? seen : contribution;
                const Float rows[4] = {window.low_a, window.low_b, window.high_a, window.high_b};
                for (int row = 0; row < 4; ++row) store(m.windows + row * m.columns + first, rows[row]);
            }
        }
        store(m.contribution + first, contribution);
    }
    // What lens points of pixels see, for `density`.
    void see(LensPoint point, Vec3 focus, Int pixel, Int active, Seen& seen) const {
        if (m.environment == nullptr) return;
        Int used = all(0);
        for (int lane = 0; lane < LANES; ++lane) used[lane] = active[lane] && m.sees_map[pixel[lane]] ? -1 : 0;
        if (any(used)) points_on_map(*m.environment, point.x, point.y, focus, used, seen.points);
    }
    // Densities of candidates.
    Float density(Int candidate, Int pixel, Vec3 focus, LensPoint point, Int there, const Seen& seen) const {
        Float density = ellipse_pdf(load_ellipse(m, candidate), point.x, point.y);
        if (m.environment == nullptr && m.parallelograms == nullptr) return density;
        const Int component = gather(m.component, candidate);
        for (int lane = 0; lane < LANES && m.environment != nullptr; ++lane) {
            const int64_t number = there[lane] ? m.environment_index[component[lane]] : -1;
            if (number < 0) continue;
            density[lane] = seen.points[lane].emitter == number ? seen.points[lane].density : 0.0f;
            if (!(density[lane] > 0.0f) || !m.clipped[candidate[lane]]) continue;
            const EnvironmentShape shape(*m.environment, cone_of(m, pixel[lane]));
            density[lane] *= float(shape.clipping_factor(number, m.map_rows + 2 * candidate[lane], seen.points[lane].x, seen.points[lane].y));
        }
        if (m.parallelograms != nullptr) {
            const Int number = numbers_of(m.parallelogram_index, component), shown = there & (number >= 0);
            if (any(shown)) {
                const Parallelogram p(*m.parallelograms, shown ? number : all(0), focus, m.lens_radius);
                density = shown ? p.pdf(point.x, point.y, load_window(m, candidate)) : density;
            }
        }
        return density;
    }
    // The number that chooses the candidate of a pixel, given that the first of `uniforms` is below β.
    float choice(const float* uniforms, int64_t pixel) const { return uniforms[pixel] / m.beta[pixel]; }
    // Lens points of candidates.
    LensPoint draw(Int candidate, Int guided, Int pixel, const float* uniforms) const {
        const Float u1 = gather(uniforms + m.pixels, pixel), u2 = gather(uniforms + 2 * m.pixels, pixel);
        LensPoint point = sample_ellipse(load_ellipse(m, candidate), u1, u2);
        shaped(candidate, guided, pixel, u1, u2, point);
        return point;
    }

  private:
    const Rows& m;

    // The rows of an emitter of the map that the lens sees; returns the share of its flux.
    float see_emitter(int64_t candidate, int64_t number, int32_t pixel, bool whole) const {
        const EnvironmentShape shape(*m.environment, cone_of(m, pixel));
        double* const rows = m.map_rows + 2 * candidate;
        m.clipped[candidate] = !whole;
        if (whole) {
            rows[0] = m.environment->whole[number], rows[1] = m.environment->whole[m.environment->emitters + number];
        } else {
            shape.visible_rows(number, rows);
        }
        return float(rows[1] - rows[0]);
    }
    // `_ellipse_pdf`.
    static Float ellipse_pdf(const Ellipse& e, Float x, Float y) {
        x = (x - e.x) / e.width;
        y = (y - e.y - e.tilt * x) / e.height;
        const Float along = e.across * x + e.up * y;
        const Int inside = (x * x + y * y <= all(1.0f)) & (along >= e.low) & (along <= e.high);
        return one_if(inside) / (PI * e.width * e.height * e.share);
    }
    // `_sample_ellipses`.
    static LensPoint sample_ellipse(const Ellipse& e, Float u1, Float u2) {
        Float sine, cosine;
        sincos(2.0f * PI * u2, sine, cosine);
        const Float radius = INSIDE * sqrt(u1);
        Float x = radius * cosine, y = radius * sine;
        const Int whole = (e.low <= all(-1.0f)) & (e.high >= all(1.0f));
        if (any(~whole)) {
            const Float along = disc_quantile(e.below + u1 * e.share);
            const Float across = INSIDE * sqrt(at_least(1.0f - along * along, 0.0f)) * (2.0f * u2 - 1.0f);
            x = whole ? x : e.across * along - e.up * across, y = whole ? y : e.up * along + e.across * across;
        }
        return {e.x + e.width * x, e.y + (e.tilt * x + e.height * y)};
    }
    void shaped(Int candidate, Int guided, Int pixel, Float u1, Float u2, LensPoint& point) const {
        if (m.environment == nullptr && m.parallelograms == nullptr) return;
        const Int component = gather(m.component, candidate);
        const Vec3 focus = gather3(m.focus, m.pixels, pixel);
        for (int lane = 0; lane < LANES && m.environment != nullptr; ++lane) {
            const int64_t number = guided[lane] ? m.environment_index[component[lane]] : -1;
            if (number < 0) continue;
            const EnvironmentShape shape(*m.environment, cone_of(m, pixel[lane]));
            float drawn[2];
            shape.sample(number, m.map_rows + 2 * candidate[lane], u1[lane], u2[lane], drawn);
            point.x[lane] = drawn[0], point.y[lane] = drawn[1];
        }
        if (m.parallelograms == nullptr) return;
        const Int number = numbers_of(m.parallelogram_index, component), shown = guided & (number >= 0);
        if (!any(shown)) return;
        const Parallelogram p(*m.parallelograms, shown ? number : all(0), focus, m.lens_radius);
        const LensPoint drawn = p.sample(load_window(m, candidate), u1, u2);
        point.x = shown ? drawn.x : point.x, point.y = shown ? drawn.y : point.y;
    }
};

}  // namespace BOKEHGUIDE_ISA
