// Emitters of an environment map as densities on the lens, in double precision, one at a time: models/emitters/environment.py,
// lens_cone.py and piecewise_linear.py.

#pragma once

#include "blocks.h"
#include "tables.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::EnvironmentTable;
using bokehguide::PiecewiseTable;

constexpr double DOUBLE_PI = 3.14159265358979323846, SMALLEST = 1e-300, WIDENED = 1.001;
constexpr double ANGLE_ERROR = 1e-6, MAX_CONE_ANGLE = 0.3, MIN_POLE_DISTANCE = 3.0, LEAST_COSINE_TO_AXIS = 0.6;
constexpr int NEWTON_STEPS = 3;

inline double larger(double a, double b) { return a > b ? a : b; }
inline double smaller(double a, double b) { return a < b ? a : b; }
inline double sine(double x) { return __builtin_sin(x); }
inline double root(double x) { return __builtin_sqrt(larger(x, 0.0)); }

struct Direction {
    double x, y, z;
};
inline Direction operator+(Direction a, Direction b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Direction operator-(Direction a, Direction b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Direction operator*(double s, Direction a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Direction a, Direction b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Direction normalize(Direction a) { return 1.0 / __builtin_sqrt(larger(dot(a, a), 1e-37)) * a; }

// `polar_angle` of render/vector.py.
inline double polar_angle(double y, double x) {
    const double acute = __builtin_atan(y / larger(__builtin_fabs(x), 1e-30));
    return x < 0.0 ? __builtin_copysign(DOUBLE_PI, y) - acute : acute;
}

struct MapPlace {
    double column, row;
};
// `Equirectangular.place`.
inline MapPlace place_of(const EnvironmentTable& e, Direction d) {
    const double u = 0.5 + polar_angle(d.x, -d.z) / (2.0 * DOUBLE_PI) + e.turn;
    return {(u - __builtin_floor(u)) * e.width, polar_angle(__builtin_sqrt(d.x * d.x + d.z * d.z), d.y) / DOUBLE_PI * e.height};
}
// `Equirectangular.directions`.
inline Direction direction_of(const EnvironmentTable& e, double column, double row) {
    const double phi = 2.0 * DOUBLE_PI * (column / e.width - 0.5 - e.turn), theta = DOUBLE_PI / e.height * row, radius = sine(theta);
    return {radius * sine(phi), __builtin_cos(theta), -radius * __builtin_cos(phi)};
}
inline Direction to_world(const EnvironmentTable& e, Direction v) {
    const double* m = e.axes;
    return {m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z, m[6] * v.x + m[7] * v.y + m[8] * v.z};
}
inline Direction to_camera(const EnvironmentTable& e, Direction v) {
    const double* m = e.axes;
    return {m[0] * v.x + m[3] * v.y + m[6] * v.z, m[1] * v.x + m[4] * v.y + m[7] * v.z, m[2] * v.x + m[5] * v.y + m[8] * v.z};
}
inline Direction axis_row(const EnvironmentTable& e, int row) { return {e.axes[3 * row], e.axes[3 * row + 1], e.axes[3 * row + 2]}; }

// ------------------------------------------------------------------------------------------------ piecewise linear densities

// The last of the entries `begin` to `end` that is at most `value`; `begin` if none is.
template <class T> inline int64_t last_up_to(const T* entries, int64_t begin, int64_t end, T value) {
    int64_t low = begin, high = end;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (entries[middle] <= value) low = middle + 1;
        else high = middle;
    }
    return low > begin ? low - 1 : begin;
}

struct Knot {
    int64_t number;
    double beyond;
};
// `PiecewiseLinear.find`.
inline Knot find_knot(const PiecewiseTable& t, int64_t group, double x) {
    x = x - __builtin_floor(x / double(t.period)) * double(t.period);
    const int64_t key = group * (t.period + 1) + int64_t(__builtin_floor(x));
    const int64_t knot = last_up_to(t.keys, t.start[group], t.end[group] + 1, key);
    return {knot, x - double(t.position[knot])};
}
// `PiecewiseLinear.integral`.
inline double integral(const PiecewiseTable& t, int64_t group, double x) {
    const double turns = __builtin_floor(x / double(t.period));
    const Knot knot = find_knot(t, group, x);
    const double start = t.weights[knot.number], end = t.weights[knot.number + 1];
    const double before = t.cumulative[knot.number] - t.cumulative[t.start[group]];
    return before + (start + 0.5 * (end - start) * knot.beyond) * knot.beyond + turns * t.total[group];
}
// `PiecewiseLinear.inverse`.
inline double inverse(const PiecewiseTable& t, int64_t group, double value) {
    const int64_t first = t.start[group], last = t.end[group];
    const double total = larger(t.total[group], SMALLEST), turns = __builtin_floor(value / total);
    const double target = value - turns * total + t.cumulative[first];
    int64_t knot = last_up_to(t.cumulative, first, last + 1, target);
    knot = knot > last - 1 ? (last - 1 > first ? last - 1 : first) : knot;
    const double start = t.weights[knot], end = t.weights[knot + 1], rest = larger(target - t.cumulative[knot], 0.0);
    const double slope = root(start * start + 2.0 * (end - start) * rest);
    const double distance = smaller(2.0 * rest / larger(start + slope, SMALLEST), 1.0);
    return double(t.position[knot]) + distance + turns * double(t.period);
}

// --------------------------------------------------------------------------------------------------------------- lens cones

struct ColumnRange {
    double first, last;
};

// `LensCone`: directions from the lens circle through a focus point.
struct LensCone {
    Direction focus;
    double column, theta, reach, radius;

    LensCone() = default;
    // `_enclosing_circle`.
    LensCone(const EnvironmentTable& e, const double (&through)[3], double lens_radius)
        : focus{through[0], through[1], through[2]}, radius(WIDENED * lens_radius) {
        const double squared = dot(focus, focus), distance = __builtin_sqrt(squared);
        const MapPlace place = place_of(e, to_world(e, {focus.x / distance, focus.y / distance, focus.z / distance}));
        const double off_axis = __builtin_sqrt(focus.x * focus.x + focus.y * focus.y);
        const double tangent = __builtin_asin(smaller(radius / distance, 1.0)), rim = polar_angle(radius * focus.z, squared - radius * off_axis);
        column = place.column, theta = DOUBLE_PI / e.height * place.row, reach = (off_axis < radius ? rim : tangent) + ANGLE_ERROR;
    }

    double rim_radius() const { return radius + ANGLE_ERROR * focus.z; }
    // `_uses_circle`.
    bool uses_circle() const {
        const bool oblique = dot(focus, focus) * LEAST_COSINE_TO_AXIS * LEAST_COSINE_TO_AXIS > focus.z * focus.z;
        return oblique || reach > MAX_CONE_ANGLE || sine(theta) < MIN_POLE_DISTANCE * sine(reach);
    }

    // `row_range`.
    ColumnRange rows(const EnvironmentTable& e, double middle, double half) const {
        const double circle = __builtin_asin(smaller(sine(reach) / larger(sine(theta), SMALLEST), 1.0)) * (e.width / DOUBLE_PI);
        if (e.width - 2.0 * half < circle) half = 0.5 * e.width;
        const double top = extreme_row(e, middle, half, -1.0);
        return {top, larger(top, extreme_row(e, middle, half, 1.0))};
    }
    // `row_interval`.
    ColumnRange columns(const EnvironmentTable& e, double y) const {
        const double half = circle_half_angle(DOUBLE_PI / e.height * y), texels = 0.5 * e.width / DOUBLE_PI;
        double first = -half, last = half;
        if (!uses_circle()) {
            const Direction start = direction_of(e, column, y);
            const Direction polar = start.y * axis_row(e, 1), forward = start.x * axis_row(e, 0) + start.z * axis_row(e, 2);
            const Direction sideways = start.x * axis_row(e, 2) - start.z * axis_row(e, 0);
            first = rim_angle(half, polar, forward, sideways, -1.0), last = rim_angle(half, polar, forward, sideways, 1.0);
        }
        return {texels * first, texels * larger(first, last)};
    }

  private:
    // `_extreme_row`.
    double extreme_row(const EnvironmentTable& e, double middle, double half, double sign) const {
        if (uses_circle()) return e.height / DOUBLE_PI * smaller(larger(theta + sign * reach, 0.0), DOUBLE_PI);
        const MapPlace place = place_of(e, to_world(e, normalize(extreme_direction(e, sign))));
        double offset = (place.column - middle) / e.width;
        offset = (offset - __builtin_floor(offset + 0.5)) * e.width;
        const double nearest = smaller(larger(offset, -half), half);
        if (nearest == offset) return place.row;
        return meridian_row(e, middle + nearest, sign);
    }
    // `_extreme_direction`.
    Direction extreme_direction(const EnvironmentTable& e, double sign) const {
        Direction direction = focus;
        const Direction up = axis_row(e, 1);
        for (int step = 0; step < NEWTON_STEPS; ++step) {
            direction = normalize(direction);
            const Direction north = up - dot(up, direction) * direction;
            const double in_plane = larger(__builtin_sqrt(north.x * north.x + north.y * north.y), SMALLEST), reach = sign * rim_radius() / in_plane;
            direction = {focus.x - reach * north.x, focus.y - reach * north.y, focus.z};
        }
        return direction;
    }
    // `_meridian_rows`: the lower or the higher of both.
    double meridian_row(const EnvironmentTable& e, double at, double sign) const {
        const Direction normal = to_camera(e, direction_of(e, at + 0.25 * e.width, 0.5 * e.height));
        const double squared = larger(normal.x * normal.x + normal.y * normal.y, SMALLEST), nearest = dot(normal, focus) / squared;
        const double half_chord = root(rim_radius() * rim_radius() / squared - nearest * nearest);
        double rows[2];
        for (int side = 0; side < 2; ++side) {
            const double end = side == 0 ? -half_chord : half_chord;
            const Direction seen = {focus.x - nearest * normal.x - end * normal.y, focus.y - nearest * normal.y + end * normal.x, focus.z};
            rows[side] = place_of(e, normalize(to_world(e, seen))).row;
        }
        return sign < 0.0 ? smaller(rows[0], rows[1]) : larger(rows[0], rows[1]);
    }
    // `_circle_half_angle`.
    double circle_half_angle(double polar) const {
        const double radius_sine = sine(0.5 * reach), apart = sine(0.5 * (polar - theta));
        const double squared = (radius_sine * radius_sine - apart * apart) / larger(sine(polar) * sine(theta), SMALLEST);
        return 2.0 * __builtin_asin(root(smaller(larger(squared, 0.0), 1.0)));
    }
    // `_rim_angle`.
    double rim_angle(double half, Direction polar, Direction forward, Direction sideways, double sign) const {
        const double reach_squared = rim_radius() * rim_radius();
        double angle = sign * half;
        for (int step = 0; step < NEWTON_STEPS; ++step) {
            const double cosine = __builtin_cos(angle), across = sine(angle);
            const Direction now = polar + (cosine * forward + across * sideways), change = cosine * sideways - across * forward;
            const double x = focus.x * now.z - now.x * focus.z, y = focus.y * now.z - now.y * focus.z;
            const double dx = focus.x * change.z - change.x * focus.z, dy = focus.y * change.z - change.y * focus.z;
            const double outside = x * x + y * y - reach_squared * now.z * now.z;
            const double slope = sign * (x * dx + y * dy - reach_squared * now.z * change.z);
            const double further = larger(0.5 * outside / larger(slope, SMALLEST), 0.0);
            angle = sign * larger(sign * angle - further, -half);
        }
        return angle;
    }
};

inline LensCone cone_of(const bokehguide::EllipseRows& m, int64_t pixel) {
    LensCone cone;
    cone.focus = {m.focus[pixel], m.focus[m.pixels + pixel], m.focus[2 * m.pixels + pixel]};
    cone.column = m.cones[3 * pixel], cone.theta = m.cones[3 * pixel + 1], cone.reach = m.cones[3 * pixel + 2];
    cone.radius = WIDENED * double(m.lens_radius);
    return cone;
}

// --------------------------------------------------------------------------------------------------------- densities on the lens

// The emitter that a lens point sees, its place on the map, and its density without clipping.
struct MapPoint {
    int64_t emitter = -1;
    double x = 0.0, y = 0.0;
    float density = 0.0f;
};

// `EnvironmentEmitters.evaluate`, in single precision, for lens points of a vector of pixels; only lanes in use are looked up.
inline void points_on_map(const EnvironmentTable& e, Float point_x, Float point_y, Vec3 focus, Int used, MapPoint (&found)[LANES]) {
    const Vec3 ray = {focus.x - point_x, focus.y - point_y, focus.z};
    const float* m = e.float_axes;
    const Vec3 towards = normalize({m[0] * ray.x + m[1] * ray.y + m[2] * ray.z, m[3] * ray.x + m[4] * ray.y + m[5] * ray.z,
                                    m[6] * ray.x + m[7] * ray.y + m[8] * ray.z});
    const float width = float(e.width), height = float(e.height);
    const Float u = 0.5f + polar_angle(towards.x, -towards.z) / (2.0f * PI) + float(e.turn);
    const Float around = sqrt(towards.x * towards.x + towards.z * towards.z), distance = sqrt(dot(ray, ray));
    const Float column = (u - floor(u)) * width - 0.5f, row = polar_angle(around, towards.y) / PI * height - 0.5f;
    const Float left = floor(column), top = floor(row), fx = column - left, fy = row - top;
    const Float upper = (1.0f - fy) * one_if(top >= all(0.0f)), lower = fy * one_if(top + 1.0f < all(height));
    const Float solid_angle = 2.0f * PI * PI / (height * width) * around, scale = focus.z / (distance * distance * distance * divisor(solid_angle));
    for (int lane = 0; lane < LANES; ++lane) {
        if (!used[lane]) continue;
        MapPoint& point = found[lane];
        float density = 0.0f;
        for (int down = 0; down < 2; ++down) {
            const float line = top[lane] + float(down), inside = line < 0.0f ? 0.0f : (line > height - 1.0f ? height - 1.0f : line);
            for (int across = 0; across < 2; ++across) {
                const float place = left[lane] + float(across), texel = place - __builtin_floorf(place / width) * width;
                const int32_t slot = e.slot[int64_t(inside) * e.width + int64_t(texel)];
                density += (across ? fx[lane] : 1.0f - fx[lane]) * (down ? lower[lane] : upper[lane]) * e.flux[slot];
                if (e.emitter[slot] > point.emitter) point.emitter = e.emitter[slot];
            }
        }
        point.density = density * scale[lane];
        point.x = double(left[lane] + fx[lane] + 0.5f), point.y = double(top[lane] + fy[lane] + 0.5f);
    }
}

// Emitters of the map as the lens sees them through a focus point.
class EnvironmentShape {
  public:
    EnvironmentShape(const EnvironmentTable& table, const LensCone& cone) : e(table), cone_(cone) {}

    // `visible_rows`: flux above the first and above the last visible row.
    void visible_rows(int64_t emitter, double* rows) const {
        const ColumnRange seen = cone_.rows(e, e.columns[emitter], e.columns[e.emitters + emitter]);
        rows[0] = integral(e.rows, emitter, seen.first + 0.5), rows[1] = integral(e.rows, emitter, seen.last + 0.5);
    }
    // `sample`.
    void sample(int64_t emitter, const double* rows, double down, double across, float (&point)[2]) const {
        const double y = inverse(e.rows, emitter, rows[0] + down * (rows[1] - rows[0])) - 0.5;
        const Line line(*this, emitter, y);
        const double mass = line.tents[0] * line.mass[0] + line.tents[1] * line.mass[1];
        double target = across * mass;
        const int lower = target < line.tents[0] * line.mass[0] ? 0 : 1;
        target = (lower ? target - line.tents[0] * line.mass[0] : target) / line.tents[lower] + line.low[lower];
        const double x = inverse(e.segments, line.segments[lower], target) + 0.5;
        const Direction local = to_camera(e, direction_of(e, double(float(x)), double(float(y))));
        const bool visible = local.z > 0.0 && mass > 0.0 && rows[1] > rows[0];
        point[0] = visible ? float(cone_.focus.x - local.x * (cone_.focus.z / local.z)) : 1e15f;
        point[1] = visible ? float(cone_.focus.y - local.y * (cone_.focus.z / local.z)) : 1e15f;
    }
    // `clipping_factor`.
    double clipping_factor(int64_t emitter, const double* rows, double x, double y) const {
        const Line line(*this, emitter, y);
        double offset = (x - cone_.column) / e.width;
        offset = (offset - __builtin_rint(offset)) * e.width;
        const double above = integral(e.rows, emitter, y + 0.5);
        const bool inside = offset >= line.seen.first && offset <= line.seen.last && above >= rows[0] && above <= rows[1];
        const double visible = (rows[1] - rows[0]) * (line.tents[0] * line.mass[0] + line.tents[1] * line.mass[1]);
        const double whole = line.tents[0] * e.segments.total[line.segments[0]] + line.tents[1] * e.segments.total[line.segments[1]];
        return inside && visible > 0.0 ? whole / visible : 0.0;
    }

  private:
    const EnvironmentTable& e;
    const LensCone cone_;

    // `_line`.
    struct Line {
        int64_t segments[2];
        double tents[2], low[2], mass[2];
        ColumnRange seen;

        Line(const EnvironmentShape& s, int64_t emitter, double y) : seen(s.cone_.columns(s.e, y)) {
            const Knot knot = find_knot(s.e.rows, emitter, y + 0.5);
            tents[0] = 1.0 - knot.beyond, tents[1] = knot.beyond;
            for (int row = 0; row < 2; ++row) {
                segments[row] = s.e.segment[knot.number + row];
                low[row] = integral(s.e.segments, segments[row], s.cone_.column + seen.first - 0.5);
                mass[row] = integral(s.e.segments, segments[row], s.cone_.column + seen.last - 0.5) - low[row];
            }
        }
    };
};

}  // namespace BOKEHGUIDE_ISA
