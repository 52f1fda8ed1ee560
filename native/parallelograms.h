// Parallelograms as exact densities on the lens: models/emitters/parallelogram.py, for eight of them at a time.

#pragma once

#include "blocks.h"
#include "projection.h"
#include "tables.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::EllipseRows;
using bokehguide::ParallelogramTable;

constexpr float LENS_MARGIN = 1.001f, LENS_POINT_ERROR = 1e-6f, TINY = 1e-30f;

// Numbers below 2^31 of eight components.
inline Int numbers_of(const int64_t* table, Int component) {
    Int found;
    for (int lane = 0; lane < LANES; ++lane) found[lane] = int32_t(table[component[lane]]);
    return found;
}

// Ranges of both coordinates that the lens sees.
struct Window {
    Float low_a, low_b, high_a, high_b;
};
inline Window load_window(const EllipseRows& m, Int candidate) {
    const auto row = [&](int number) { return gather(m.windows + number * m.columns, candidate); };
    return {row(0), row(1), row(2), row(3)};
}

struct Range {
    Float low, high;
};

// Parallelograms through focus points.
class Parallelogram {
  public:
    Parallelogram(const ParallelogramTable& t, Int number, Vec3 focus, float radius) : focus_(focus), radius_(radius) {
        const auto vector = [&](const float* rows) { return gather3(rows, t.count, number); };
        centre_ = vector(t.centre), right_ = vector(t.right), up_ = vector(t.up), normal_ = vector(t.normal);
        first_ = vector(t.first), second_ = vector(t.second), area_ = gather(t.area, number);
        offset_ = centre_ - focus_;
        projected_ = project_to_lens(centre_, focus_);
    }

    // `window`.
    Window window() const {
        const Float limit_a = 1.0f + margin(first_), limit_b = 1.0f + margin(second_);
        const Range a = range_on_lens(first_), b = range_on_lens(second_);
        Window w = {bounded(or_else(a.low, all(0.0f)), limit_a), bounded(or_else(b.low, all(0.0f)), limit_b),
                    bounded(or_else(a.high, all(0.0f)), limit_a), bounded(or_else(b.high, all(0.0f)), limit_b)};
        const Range at_low = interval(w.low_a, false, w), at_high = interval(w.high_a, false, w);
        const Float low = interval(0.5f * (at_low.low + at_low.high), true, w).low;
        const Float high = interval(0.5f * (at_high.low + at_high.high), true, w).high;
        w.low_a = low, w.high_a = high;
        return w;
    }
    // `sample`.
    LensPoint sample(const Window& w, Float u1, Float u2) const {
        const Float a = w.low_a + u1 * (w.high_a - w.low_a);
        const Range b = interval(a, false, w);
        const LensPoint point = on_lens(a, b.low + u2 * (b.high - b.low));
        const Int seen = b.high > b.low;
        return {seen ? point.x : all(FAR_OUTSIDE), seen ? point.y : all(FAR_OUTSIDE)};
    }
    // `pdf`.
    Float pdf(Float x, Float y, const Window& w) const {
        Vec3 ray = {focus_.x - x, focus_.y - y, focus_.z};
        Float cosine = dot(normal_, ray);
        cosine = cosine == all(0.0f) ? all(TINY) : cosine;
        const Float distance = dot(normal_, offset_) / cosine;
        const Vec3 from_centre = {x - projected_.x, y - projected_.y, all(0.0f)};
        const Vec3 in_plane = dot(normal_, from_centre) / cosine * offset_ - distance * from_centre;
        const Float jacobian = distance * distance * abs(focus_.z / cosine) / area_;
        const Float a = dot(first_, in_plane), b = dot(second_, in_plane);
        const Range range = interval(a, false, w);
        const Int inside = (a >= w.low_a) & (a <= w.high_a) & (b >= range.low) & (b <= range.high);
        const Float share = 0.25f * (w.high_a - w.low_a) * (range.high - range.low);
        return (inside & (share > all(0.0f))) ? jacobian / share : all(0.0f);
    }
    // `area_on_lens`.
    Float area_on_lens(const Window& w) const {
        const Float width = w.high_a - w.low_a;
        Float total = all(0.0f);
        const float nodes[2] = {0.2113f, 0.7887f};  // of Gauss' quadrature on 0 … 1
        for (int i = 0; i < 2; ++i) {
            const Float a = w.low_a + nodes[i] * width;
            const Range b = interval(a, false, w);
            const Float depth = offset_.z + a * right_.z + 0.5f * (b.low + b.high) * up_.z, ratio = depth / focus_.z;
            total = total + (b.high - b.low) * abs(dot(normal_, offset_) / (ratio * ratio * ratio * focus_.z));
        }
        return 0.125f * width * area_ * total;
    }

  private:
    Vec3 focus_, centre_, right_, up_, normal_, first_, second_, offset_;
    Float area_;
    LensPoint projected_;
    float radius_;

    // `_margin`, for one row of the dual basis.
    Float margin(Vec3 row) const {
        const Float error = LENS_POINT_ERROR * (sqrt(projected_.x * projected_.x + projected_.y * projected_.y) + radius_);
        Float height = dot(normal_, offset_);
        height = height == all(0.0f) ? all(TINY) : height;
        const Vec3 gradient = dot(row, offset_) / height * normal_ - row;
        const Float length = sqrt(gradient.x * gradient.x + gradient.y * gradient.y);
        return clamp(or_else(abs(offset_.z / focus_.z) * length * error, all(1.0f)), 1e-5f, 1.0f);
    }
    // `_range_on_lens`.
    Range range_on_lens(Vec3 row) const {
        const Float height = dot(normal_, offset_), reach = all(LENS_MARGIN * radius_), squared = reach * reach;
        const Float d0 = dot(normal_, focus_ / focus_.z), s_x = -normal_.x / focus_.z, s_y = -normal_.y / focus_.z;
        const Float along = dot(row, offset_);
        const Float g_x = (along * normal_.x - row.x * height) / focus_.z, g_y = (along * normal_.y - row.y * height) / focus_.z;
        const Float n0 = -(g_x * projected_.x + g_y * projected_.y);
        const Float quadratic = d0 * d0 - squared * (s_x * s_x + s_y * s_y), linear = n0 * d0 - squared * (g_x * s_x + g_y * s_y);
        const Float determinant = g_x * s_y - g_y * s_x;
        const Float discriminant = squared * (square(n0 * s_x - d0 * g_x) + square(n0 * s_y - d0 * g_y) - squared * determinant * determinant);
        const Float root = sqrt(at_least(discriminant, 0.0f));
        const Int unbounded = quadratic <= all(0.0f);
        return {unbounded ? all(-INFINITY) : (linear - root) / quadratic, unbounded ? all(INFINITY) : (linear + root) / quadratic};
    }
    // `_on_lens`.
    LensPoint on_lens(Float a, Float b) const {
        const Vec3 in_plane = a * right_ + b * up_;
        const Float turn = in_plane.z / offset_.z, scale = focus_.z / (offset_.z + in_plane.z);
        return {projected_.x + (offset_.x * turn - in_plane.x) * scale, projected_.y + (offset_.y * turn - in_plane.y) * scale};
    }
    // `_interval`: of the second coordinate at a first one, or the other way round.
    Range interval(Float at, bool of_first, const Window& w) const {
        const Float low = of_first ? w.low_a : w.low_b, high = of_first ? w.high_a : w.high_b;
        const Vec3 fixed = of_first ? up_ : right_, moving = of_first ? right_ : up_;
        const LensPoint first = of_first ? on_lens(low, at) : on_lens(at, low), last = of_first ? on_lens(high, at) : on_lens(at, high);
        const Float dx = last.x - first.x, dy = last.y - first.y, length = at_least(sqrt(dx * dx + dy * dy), TINY);
        const Float x = dx / length, y = dy / length, middle = -(first.x * x + first.y * y);
        const Float reach = LENS_MARGIN * radius_ + LENS_POINT_ERROR * length;
        const Float aside_x = first.x + middle * x, aside_y = first.y + middle * y;
        const Float half = sqrt(at_least(reach * reach - (aside_x * aside_x + aside_y * aside_y), 0.0f));
        const Float depth = offset_.z + at * fixed.z;
        const auto end = [&](Float fraction, float fallback) {
            fraction = clamp(or_else(fraction, all(fallback)), 0.0f, 1.0f);
            const Float near = fraction * (depth + low * moving.z);
            const Float share = clamp(or_else(near / (near + (1.0f - fraction) * (depth + high * moving.z)), all(fallback)), 0.0f, 1.0f);
            return low + share * (high - low);
        };
        return {end((middle - half) / length, 0.0f), end((middle + half) / length, 1.0f)};
    }
};

}  // namespace BOKEHGUIDE_ISA
