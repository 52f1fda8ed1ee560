// Arrays `[rows, count]`, a vector of columns at a time.

#pragma once

#include "surface.h"

namespace BOKEHGUIDE_ISA {

// Some rows of an array `[rows, count]`, a vector of columns at a time; lanes beyond the end repeat the last column.
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
    void put_integers(int32_t* row, Int values) const {
        if (count - first >= LANES) return store(row + first, values);
        for (int lane = 0; lane < LANES && first + lane < count; ++lane) row[first + lane] = values[lane];
    }
    // -1 where a flag is set, else 0.
    Int flags(const uint8_t* row) const {
        Int found;
        for (int lane = 0; lane < LANES; ++lane) found[lane] = row[column(lane)] ? -1 : 0;
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

}  // namespace BOKEHGUIDE_ISA
