// Eight or sixteen lanes at once: floats and integers of which every operator works lane by lane.
//
// GCC's and Clang's vector extensions compile the same source for every instruction set. Only loads by index, roots and
// conversions need code of their own. A comparison gives a mask of 0 or -1; `mask ? a : b` chooses lane by lane.

#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace BOKEHGUIDE_ISA {

#if defined(__AVX512F__)
constexpr int LANES = 16;
#else
constexpr int LANES = 8;
#endif
typedef float Float __attribute__((vector_size(4 * LANES)));
typedef int32_t Int __attribute__((vector_size(4 * LANES)));
typedef uint32_t Bits __attribute__((vector_size(4 * LANES)));
typedef double Double __attribute__((vector_size(8 * LANES)));
typedef int64_t Long __attribute__((vector_size(8 * LANES)));

constexpr float PI = 3.14159265358979323846f;

inline Float all(float x) { return x - Float{}; }  // keeps the sign of 0
inline Int all(int32_t x) { return x + Int{}; }
inline Bits all(uint32_t x) { return x + Bits{}; }
#if defined(__AVX512F__)
inline Int lane_numbers() { return Int{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}; }
#else
inline Int lane_numbers() { return Int{0, 1, 2, 3, 4, 5, 6, 7}; }
#endif
inline Int first_lanes(int count) { return lane_numbers() < count; }

template <class V, class T> inline V load(const T* place) {
    V value;
    std::memcpy(&value, place, sizeof value);
    return value;
}
template <class V, class T> inline void store(T* place, V value) { std::memcpy(place, &value, sizeof value); }

template <class To, class From> inline To bits(From value) {
    static_assert(sizeof(To) == sizeof(From), "same size");
    To result;
    std::memcpy(&result, &value, sizeof result);
    return result;
}

inline Float to_float(Int x) { return __builtin_convertvector(x, Float); }
// Towards 0; NaN and values out of range give any integer.
inline Int to_int(Float x) { return __builtin_convertvector(x, Int); }

// As `torch.clamp` does, `at_least` and `at_most` keep a NaN in `x`.
#if defined(__AVX512F__)
inline Float gather(const float* table, Int index) { return (Float)_mm512_i32gather_ps((__m512i)index, table, 4); }
inline Int gather(const int32_t* table, Int index) { return (Int)_mm512_i32gather_epi32((__m512i)index, table, 4); }
inline Float sqrt(Float x) { return (Float)_mm512_sqrt_ps((__m512)x); }
inline Float at_least(Float x, float least) { return (Float)_mm512_max_ps(_mm512_set1_ps(least), (__m512)x); }
inline Float at_most(Float x, float most) { return (Float)_mm512_min_ps(_mm512_set1_ps(most), (__m512)x); }
inline Float floor(Float x) { return (Float)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
inline unsigned lanes(Int mask) { return unsigned(_mm512_movepi32_mask((__m512i)mask)); }
inline bool any(Int mask) { return lanes(mask) != 0; }
#elif defined(__AVX2__)
inline Float gather(const float* table, Int index) { return (Float)_mm256_i32gather_ps(table, (__m256i)index, 4); }
inline Int gather(const int32_t* table, Int index) { return (Int)_mm256_i32gather_epi32(table, (__m256i)index, 4); }
inline Float sqrt(Float x) { return (Float)_mm256_sqrt_ps((__m256)x); }
inline Float at_least(Float x, float least) { return (Float)_mm256_max_ps(_mm256_set1_ps(least), (__m256)x); }
inline Float at_most(Float x, float most) { return (Float)_mm256_min_ps(_mm256_set1_ps(most), (__m256)x); }
inline Float floor(Float x) { return (Float)_mm256_floor_ps((__m256)x); }
inline bool any(Int mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
inline unsigned lanes(Int mask) { return unsigned(_mm256_movemask_ps((__m256)mask)); }
#else
inline Float gather(const float* table, Int index) {
    Float found;
    for (int lane = 0; lane < LANES; ++lane) found[lane] = table[index[lane]];
    return found;
}
inline Int gather(const int32_t* table, Int index) {
    Int found;
    for (int lane = 0; lane < LANES; ++lane) found[lane] = table[index[lane]];
    return found;
}
inline Float sqrt(Float x) {
    for (int lane = 0; lane < LANES; ++lane) x[lane] = __builtin_sqrtf(x[lane]);
    return x;
}
inline Float floor(Float x) {
    for (int lane = 0; lane < LANES; ++lane) x[lane] = __builtin_floorf(x[lane]);
    return x;
}
inline unsigned lanes(Int mask) {
    unsigned found = 0;
    for (int lane = 0; lane < LANES; ++lane) found |= unsigned(mask[lane] < 0) << lane;
    return found;
}
inline bool any(Int mask) { return lanes(mask) != 0; }
inline Float at_least(Float x, float least) { return x < all(least) ? all(least) : x; }
inline Float at_most(Float x, float most) { return x > all(most) ? all(most) : x; }
#endif

inline Float clamp(Float x, float least, float most) { return at_most(at_least(x, least), most); }
// As `torch.maximum` does, these return a NaN where either is one.
inline Float max(Float a, Float b) {
    const Float greater = a > b ? a : b;
    return a != a ? a : greater;
}
inline Float min(Float a, Float b) {
    const Float less = a < b ? a : b;
    return a != a ? a : less;
}
inline Float abs(Float x) { return bits<Float>(bits<Bits>(x) & all(0x7fffffffu)); }
inline Float copysign(Float size, Float sign) {
    return bits<Float>((bits<Bits>(size) & all(0x7fffffffu)) | (bits<Bits>(sign) & all(0x80000000u)));
}
inline Int finite(Float x) { return (bits<Int>(x) & 0x7f800000) != 0x7f800000; }
inline Float or_zero(Float x) { return finite(x) ? x : all(0.0f); }
// 1 where the mask is set, else 0.
inline Float one_if(Int mask) { return bits<Float>(mask & bits<Int>(all(1.0f))); }
inline Float square(Float x) { return x * x; }
inline Float fifth_power(Float x) { return square(square(x)) * x; }
// Non-negative values as divisors: a quotient of 0 by 0 is 0, and no other overflows.
inline Float divisor(Float x, float least = 1e-30f) { return at_least(x, least); }

// Sine and cosine of angles of at most some thousand radians, to about an ulp: the quarter turn nearest to the angle, and
// minimax polynomials of the rest (Cephes).
inline void sincos(Float angle, Float& sine, Float& cosine) {
    const Float turns = floor(angle * (2.0f / PI) + 0.5f);
    Float x = angle - turns * 1.5703125f;
    x = x - turns * 4.8375129699707031e-4f;
    x = x - turns * 7.5497899548918822e-8f;
    const Int quarter = to_int(turns);
    const Float z = x * x;
    const Float s = ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * x + x;
    const Float c = ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z - 0.5f * z + 1.0f;
    const Int odd = (quarter & 1) != 0;
    const Float first = odd ? c : s, second = odd ? s : c;
    const Bits flip_sine = bits<Bits>((quarter & 2) << 30), flip_cosine = bits<Bits>(((quarter + 1) & 2) << 30);
    sine = bits<Float>(bits<Bits>(first) ^ flip_sine);
    cosine = bits<Float>(bits<Bits>(second) ^ flip_cosine);
}

// Arc tangent of non-negative and negative numbers, to about two ulps (Cephes).
inline Float arctan(Float x) {
    const Float size = abs(x);
    const Int far = size > all(2.414213562373095f), near = size > all(0.4142135623730950f);
    const Float reduced = far ? -1.0f / size : (near ? (size - 1.0f) / (size + 1.0f) : size);
    const Float start = far ? all(0.5f * PI) : (near ? all(0.25f * PI) : all(0.0f));
    const Float z = reduced * reduced;
    const Float series =
        (((8.05374449538e-2f * z - 1.38776856032e-1f) * z + 1.99777106478e-1f) * z - 3.33329491539e-1f) * z * reduced + reduced;
    return copysign(start + series, x);
}

// Angle of the point (x, y), as `polar_angle` of render/vector.py.
inline Float polar_angle(Float y, Float x) {
    const Float acute = arctan(y / divisor(abs(x)));
    return x < all(0.0f) ? copysign(all(PI), y) - acute : acute;
}

// Exponential function of numbers that are not positive, to about an ulp (Cephes); 0 below -87.
inline Float exp_of_negative(Float x) {
    const Float bounded = at_least(x, -87.0f);
    const Float power = floor(bounded * 1.44269504088896341f + 0.5f);
    Float r = bounded - power * 0.693359375f;
    r = r + power * 2.12194440e-4f;
    Float p = 1.9875691500e-4f * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    const Float mantissa = p * r * r + r + 1.0f;
    const Float scale = bits<Float>((to_int(power) + 127) << 23);
    return x < all(-87.0f) ? all(0.0f) : mantissa * scale;
}

// Natural logarithm of positive normal numbers, to about an ulp (Cephes).
inline Float logarithm(Float x) {
    const Int word = bits<Int>(x), raw = (word >> 23) - 126;
    const Float mantissa = bits<Float>((word & 0x007fffff) | 0x3f000000);
    const Int small = mantissa < all(0.70710678118654752440f);
    const Float r = small ? mantissa + mantissa - 1.0f : mantissa - 1.0f, power = to_float(small ? raw - 1 : raw), z = r * r;
    Float p = 7.0376836292e-2f * r - 1.1514610310e-1f;
    p = p * r + 1.1676998740e-1f;
    p = p * r - 1.2420140846e-1f;
    p = p * r + 1.4249322787e-1f;
    p = p * r - 1.6668057665e-1f;
    p = p * r + 2.0000714765e-1f;
    p = p * r - 2.4999993993e-1f;
    p = p * r + 3.3333331174e-1f;
    return r + (p * r * z - 2.12194440e-4f * power - 0.5f * z) + 0.693359375f * power;
}
// Power of numbers from 0 to 1 with a positive exponent.
inline Float power_of_fraction(Float x, Float exponent) { return exp_of_negative(exponent * logarithm(at_least(x, 1e-37f))); }

typedef float Quad __attribute__((vector_size(16)));

// Numbers of two vectors: 0 to 3 are those of `a`, and 4 to 7 those of `b`.
template <int I, int J, int K, int L> inline Quad numbers_of(Quad a, Quad b) {
#if defined(__clang__)
    return __builtin_shufflevector(a, b, I, J, K, L);
#else
    typedef int32_t Places __attribute__((vector_size(16)));
    return __builtin_shuffle(a, b, Places{I, J, K, L});
#endif
}
// Columns of four rows: `a` gets the first numbers of all rows.
inline void transpose(Quad& a, Quad& b, Quad& c, Quad& d) {
    const Quad ab = numbers_of<0, 4, 1, 5>(a, b), ab2 = numbers_of<2, 6, 3, 7>(a, b);
    const Quad cd = numbers_of<0, 4, 1, 5>(c, d), cd2 = numbers_of<2, 6, 3, 7>(c, d);
    a = numbers_of<0, 1, 4, 5>(ab, cd), b = numbers_of<2, 3, 6, 7>(ab, cd);
    c = numbers_of<0, 1, 4, 5>(ab2, cd2), d = numbers_of<2, 3, 6, 7>(ab2, cd2);
}
// Numbers of rows of a table, four for each of QUADS loads, lane by lane. Loads by index are slow on many processors, and one takes
// a single number.
template <int QUADS> struct RowFields {
    alignas(4 * LANES) float fields[4 * QUADS][LANES];

    // row: the first number of a lane's row.
    template <class Row> explicit RowFields(Row row) {
        for (int lane = 0; lane < LANES; lane += 4) {
            for (int quad = 0; quad < QUADS; ++quad) {
                Quad part[4];
                for (int i = 0; i < 4; ++i) part[i] = load<Quad>(row(lane + i) + 4 * quad);
                transpose(part[0], part[1], part[2], part[3]);
                for (int i = 0; i < 4; ++i) store(&fields[4 * quad + i][lane], part[i]);
            }
        }
    }
    Float operator()(int field) const { return load<Float>(fields[field]); }
    Int integer(int field) const { return load<Int>(fields[field]); }
};

struct Vec3 {
    Float x, y, z;
};
inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
inline Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline Vec3 operator*(Vec3 a, Float s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec3 operator*(Float s, Vec3 a) { return {a.x * s, a.y * s, a.z * s}; }
inline Vec3 operator/(Vec3 a, Float s) { return {a.x / s, a.y / s, a.z / s}; }
inline Vec3 choose(Int mask, Vec3 a, Vec3 b) { return {mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z}; }
inline Vec3 grey(Float x) { return {x, x, x}; }
inline Float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline Float length(Vec3 a) { return sqrt(dot(a, a)); }
// A zero vector stays zero.
inline Vec3 normalize(Vec3 a) { return a * (1.0f / sqrt(divisor(dot(a, a), 1e-37f))); }
inline Float largest(Vec3 a) { return max(max(a.x, a.y), a.z); }
inline Float luminance(Vec3 a) { return 0.2126f * a.x + 0.7152f * a.y + 0.0722f * a.z; }

// Two unit tangents and the normal, right-handed (Duff et al. 2017).
struct Frame {
    Vec3 tangent, bitangent, normal;
};
inline Frame frame_about(Vec3 n) {
    const Float sign = copysign(all(1.0f), n.z), a = -1.0f / (sign + n.z), b = n.x * n.y * a;
    return {{1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x}, {b, sign + n.y * n.y * a, -n.y}, n};
}
// `aligned_frame` of render/vector.py.
inline Frame aligned_frame(Vec3 n, Vec3 along) {
    const Vec3 projected = along - n * dot(n, along);
    const Vec3 tangent = choose(dot(projected, projected) > all(1e-12f), normalize(projected), frame_about(n).tangent);
    return {tangent, cross(n, tangent), n};
}
inline Vec3 to_world(Vec3 local, const Frame& f) { return local.x * f.tangent + local.y * f.bitangent + local.z * f.normal; }
inline Vec3 to_local(Vec3 world, const Frame& f) { return {dot(world, f.tangent), dot(world, f.bitangent), dot(world, f.normal)}; }

}  // namespace BOKEHGUIDE_ISA
