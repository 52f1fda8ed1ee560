// BSDFs of render/bsdf/: opaque.py, dielectric.py and mixture.py explain the formulas.

#pragma once

#include "surface.h"

namespace BOKEHGUIDE_ISA {

constexpr float MIN_COSINE = 1e-6f, FILM_TRACE = 0.006f, LEAST_ENTERING = 0.2f, SMOOTH_ALPHA = 4e-3f, DELTA_PDF = 1e30f;

inline Float ggx_density(Vec3 half, Float alpha) {
    const Float a2 = alpha * alpha, t = (half.x * half.x + half.y * half.y) / a2 + half.z * half.z;
    return 1.0f / (PI * a2 * t * t);
}

// along: α along x.
inline Float ggx_density(Vec3 half, Float alpha, Float along) {
    const Float t = square(half.x / along) + square(half.y / alpha) + half.z * half.z;
    return 1.0f / (PI * alpha * along * t * t);
}

inline Vec3 sample_visible_normal(Vec3 outgoing, Float alpha, Float along, Float u, Float sine, Float cosine) {
    const Vec3 stretched = normalize({outgoing.x * along, outgoing.y * alpha, outgoing.z});
    const Float z = (1.0f - u) * (1.0f + stretched.z) - stretched.z, radius = sqrt(at_least(1.0f - z * z, 0.0f));
    const Vec3 half = Vec3{radius * cosine, radius * sine, z} + stretched;
    return normalize({half.x * along, half.y * alpha, at_least(half.z, 1e-12f)});
}

inline Float smith_root(Float cosine, Float a2) { return sqrt(a2 + (1.0f - a2) * cosine * cosine); }

struct Scattered {
    Vec3 value;
    Float pdf;
};

struct Microfacets {
    bool isotropic;
    Float cosine, alpha, along, root;

    Microfacets() = default;
    Microfacets(Vec3 outgoing, Float alpha) : isotropic(true), alpha(alpha), along(alpha) { see(outgoing); }
    Microfacets(Vec3 outgoing, Float alpha, Float along) : isotropic(false), alpha(alpha), along(along) { see(outgoing); }
    void see(Vec3 outgoing) {
        cosine = at_least(outgoing.z, MIN_COSINE);
        root = masking_root(outgoing, cosine);
    }
    Float masking_root(Vec3 direction, Float towards) const {
        if (isotropic) return smith_root(towards, alpha * alpha);
        return sqrt(square(along * direction.x) + square(alpha * direction.y) + towards * towards);
    }

    // α in the plane of the normal and a direction.
    Float facing(Vec3 direction) const {
        if (isotropic) return alpha;
        const Float x = square(direction.x), y = square(direction.y) + 1e-12f;
        return sqrt((square(along) * x + square(alpha) * y) / (x + y));
    }

    // G2 D / (4 cos cos) and the density G1 D / (4 cos). towards: cosine of the incoming direction; other: its `masking_root`.
    void evaluate(Vec3 half, Float towards, Float other, Float& visibility, Float& pdf) const {
        const Float distribution = 0.5f * (isotropic ? ggx_density(half, alpha) : ggx_density(half, alpha, along));
        visibility = distribution / (towards * root + cosine * other);
        pdf = distribution / (cosine + root);
    }
};

// Places in the tables of albedos.
struct Ends {
    Int lower;
    Float right;  // weight of the entry after `lower`

    Ends() = default;
    Ends(Float share, int size) {
        const Float place = at_most(at_least_zero(share), 1.0f) * float(size - 1), below = at_most(floor(place), float(size - 2));
        lower = to_int(below), right = place - below;
    }
    // 0 for NaN, so that places stay in the table.
    static Float at_least_zero(Float x) { return x > all(0.0f) ? x : all(0.0f); }
};
inline Float fourth_root(Float x) { return sqrt(sqrt(x)); }
constexpr float LOWEST_ROOT = 0.42169650343f;  // eighth root of MIN_ALPHA

// `BrushedAlbedo` of brushed_albedo.py. f0, rise: shares of S and B in the albedo.
struct BrushedAlbedo {
    static constexpr int ALPHAS = 12, STRENGTHS = 8, COSINES = 16, PLACES = 14, LENGTH = COSINES * PLACES + 1;
    static constexpr float LEAST_SPAN = 1e-6f;
    const int32_t* table;
    Float low, span;
    Ends alpha, strength;

    BrushedAlbedo() = default;
    BrushedAlbedo(const Tables& t, const Microfacets& facets)
        : table(t.brushed_albedo), low(fourth_root(facets.alpha)), span(at_least(fourth_root(facets.along) - low, LEAST_SPAN)),
          alpha((sqrt(low) - LOWEST_ROOT) * (1.0f / (1.0f - LOWEST_ROOT)), ALPHAS),
          strength(sqrt(at_least((facets.along - facets.alpha) / at_least(1.0f - facets.alpha, LEAST_SPAN), 0.0f)), STRENGTHS) {}

    // Bilinear means of four entries, by two places on axes.
    template <class Entry> static Float bilinear(Ends first, Ends second, int size, Entry entry) {
        const Int start = first.lower * size + second.lower;
        const auto pair = [&](Int left) {
            const Float value = entry(left);
            return value + (entry(left + 1) - value) * second.right;
        };
        const Float upper = pair(start);
        return upper + (pair(start + size) - upper) * first.right;
    }
    template <class Entry> Float over_alphas(Entry entry) const { return bilinear(alpha, strength, STRENGTHS, entry); }
    Float at(Int place, Float f0, Float rise) const {
        const Int packed = gather(table, place);
        const Float steep = to_float(packed & 0xffff) - 32768.0f, grazing = to_float((packed >> 16) & 0xffff) - 32768.0f;
        return (f0 * steep + rise * grazing) * (1.0f / 65535.0f);
    }
    Float towards(Float facing, Float cosine, Float f0, Float rise) const {
        const Ends height(fourth_root(cosine), COSINES), place((fourth_root(facing) - low) / span, PLACES);
        return over_alphas([&](Int start) {
            return bilinear(height, place, PLACES, [&](Int inner) { return at(start * LENGTH + inner, f0, rise); });
        });
    }
    Float mean(Float f0, Float rise) const {
        return over_alphas([&](Int start) { return at(start * LENGTH + (LENGTH - 1), f0, rise); });
    }
};

// `CoatAlbedo` of coat_albedo.py.
struct CoatAlbedo {
    static constexpr int ROWS = 64, COLUMNS = 96, WIDTH = COLUMNS + 1;
    const int32_t* table;
    Float f0, rise, down;
    Int start;
    bool isotropic;
    BrushedAlbedo brushed;

    CoatAlbedo() = default;
    CoatAlbedo(const Tables& t, const Microfacets& facets, Float f0, Float rise) : table(t.coat_albedo), f0(f0), rise(rise), isotropic(facets.isotropic) {
        if (isotropic) choose_row(facets.alpha, start, down);
        else brushed = BrushedAlbedo(t, facets);
    }
    static void choose_row(Float alpha, Int& start, Float& down) {
        const Float row = Ends::at_least_zero(sqrt(fourth_root(alpha)) - LOWEST_ROOT) * (float(ROWS - 1) / (1.0f - LOWEST_ROOT));
        const Float upper = at_most(floor(row), float(ROWS - 2));
        start = to_int(upper) * WIDTH, down = row - upper;
    }
    static Float between(Float first, Float second, Float share) { return first + (second - first) * share; }
    // Albedo at places in the table (`packed_table`).
    Float corner(Int place) const {
        const Int packed = gather(table, place);
        const Float steep = to_float(packed & 0xffff), grazing = to_float((packed >> 16) & 0xffff);
        return (f0 * steep + rise * grazing) * (1.0f / 65535.0f);
    }

    Float towards(const Microfacets& facets, Vec3 direction, Float cosine) const {
        Int row = start;
        Float below = down, facing = facets.alpha;
        if (!isotropic) {
            facing = facets.facing(direction);
            choose_row(facing, row, below);
        }
        cosine = at_most(Ends::at_least_zero(cosine), 1.0f);
        const Float column = fourth_root(cosine) * float(COLUMNS - 1);
        const Float left = at_most(floor(column), float(COLUMNS - 2)), right = column - left;
        const Int place = row + to_int(left);
        const Float albedo = between(between(corner(place), corner(place + 1), right), between(corner(place + WIDTH), corner(place + (WIDTH + 1)), right), below);
        return isotropic ? albedo : albedo + brushed.towards(facing, cosine, f0, rise);
    }
    Float mean(const Microfacets& facets) const {
        Int row = start;
        Float below = down;
        if (!isotropic) choose_row(facets.along, row, below);
        const Int place = row + COLUMNS;
        const Float albedo = between(corner(place), corner(place + WIDTH), below);
        return isotropic ? albedo : albedo + brushed.mean(f0, rise);
    }
};

// An incoming direction in the frame of a lobe, and numbers that depend on it and not on the outgoing direction: 1 above the surface,
// else 0; the cosine, at least MIN_COSINE; the `masking_root`; and the share of light that passes the coat.
struct Incident {
    Vec3 direction;
    Float above, cosine, root, passing;
};

struct Clearcoat {
    bool tilted;
    Frame frame;
    Vec3 outgoing;
    Float weight, leaving, reflectance;
    Microfacets facets;
    CoatAlbedo albedo;

    Clearcoat() = default;
    Clearcoat(const Tables& t, Vec3 seen_from, const Surface& s, Vec3 normal) : tilted(t.tilts_coats) {
        if (tilted) frame = frame_about(normal);
        outgoing = to_own(seen_from);
        const Float cosine = at_least(outgoing.z, MIN_COSINE);
        weight = s.clearcoat;
        facets = Microfacets(outgoing, s.clearcoat_alpha);
        albedo = CoatAlbedo(t, facets, weight * CLEARCOAT_F0, weight * (1.0f - CLEARCOAT_F0));
        leaving = passing(outgoing, cosine);
        reflectance = weight * (CLEARCOAT_F0 + (1.0f - CLEARCOAT_F0) * fifth_power(1.0f - cosine));
    }
    Vec3 to_own(Vec3 direction) const { return tilted ? to_local(direction, frame) : direction; }
    Vec3 from_own(Vec3 direction) const { return tilted ? to_world(direction, frame) : direction; }
    Float passing(Vec3 direction, Float cosine) const { return 1.0f - albedo.towards(facets, direction, cosine); }

    // incoming: in the frame of the surface.
    Incident incident(Vec3 incoming) const {
        incoming = to_own(incoming);
        const Float cosine = at_least(incoming.z, MIN_COSINE);
        return {incoming, one_if(incoming.z > all(0.0f)), cosine, facets.masking_root(incoming, cosine), passing(incoming, cosine)};
    }
    // half: in the frame of the surface.
    void evaluate(const Incident& of, Vec3 half, Float grazing, Float& value, Float& pdf, Float& beneath) const {
        half = to_own(half);
        Float visibility;
        facets.evaluate(half, of.cosine, of.root, visibility, pdf);
        value = weight * visibility * (CLEARCOAT_F0 + (1.0f - CLEARCOAT_F0) * grazing) * (of.cosine * of.above);
        pdf = pdf * one_if(half.z > all(0.0f));
        beneath = min(leaving, of.passing);
    }
    // Weight of light from below the surface, and 1 below the clearcoat's horizon, else 0.
    Float transmitted(Vec3 incoming, Float& below) const {
        incoming = to_own(incoming);
        below = one_if(incoming.z <= all(0.0f));
        return min(leaving, passing(incoming, at_most(abs(incoming.z), 1.0f)));
    }
};

// `Sheen` of sheen.py.
struct Sheen {
    static constexpr float MIN_ROUGHNESS = 0.07f;
    static constexpr int ROWS = 32, COLUMNS = 64;
    const float* table;
    Vec3 color;
    Float cosine, roughness, alpha, peak, leaving, reflectance;

    Sheen() = default;
    Sheen(const Tables& t, Float cosine, const Surface& s)
        : table(t.sheen_albedo), color(s.sheen_color), cosine(cosine), roughness(s.sheen_roughness),
          alpha(square(at_least(s.sheen_roughness, MIN_ROUGHNESS))), peak(largest(s.sheen_color)) {
        leaving = albedo(cosine);
        reflectance = peak * at_most(leaving, 1.0f);
    }
    Float albedo(Float towards) const {
        const Float x = sqrt(clamp(towards, 0.0f, 1.0f)) * float(COLUMNS - 1);
        const Float y = at_least(roughness - MIN_ROUGHNESS, 0.0f) * (float(ROWS - 1) / (1.0f - MIN_ROUGHNESS));
        const Float column = at_most(floor(x), float(COLUMNS - 2)), row = at_most(floor(y), float(ROWS - 2));
        const Int place = to_int(row) * COLUMNS + to_int(column);
        const auto line = [&](int down) {
            return (1.0f - (x - column)) * gather(table, place + down) + (x - column) * gather(table, place + down + 1);
        };
        return (1.0f - (y - row)) * line(0) + (y - row) * line(COLUMNS);
    }
    Float bound(Float towards) const { return max(leaving, albedo(towards)); }
    Float beneath(Float towards) const { return 1.0f - peak * at_most(bound(towards), 1.0f); }
    Vec3 evaluate(Vec3 half, Float towards) const {
        const Float sine2 = at_most(square(half.x) + square(half.y), 1.0f);
        const Float lobe = (2.0f + 1.0f / alpha) * power_of_fraction(sine2, 0.5f / alpha);
        const Float value = lobe / (8.0f * PI * (towards + cosine - towards * cosine));
        return color * (value / at_least(bound(towards), 1.0f));
    }
};

// Thin films, of `thin_film.py`.
inline Float film_index(Float ior, Float thickness) {
    const Float t = clamp(thickness / 0.03f, 0.0f, 1.0f);
    return 1.0f + (ior - 1.0f) * t * t * (3.0f - 2.0f * t);
}
inline Float base_index(Float f0) {
    const Float root = sqrt(at_most(f0 + 1e-4f, 0.9999f));
    return (1.0f + root) / (1.0f - root);
}
inline Float in_phase(Float first, Float second) {
    return square((sqrt(first) + sqrt(second)) / (1.0f + sqrt(first * second)));
}
// `_interfaces`, for a film of the index `ior`.
struct FilmInterfaces {
    Float first, second[3], inside;

    FilmInterfaces(Vec3 f0, Float ior, Float cosine) {
        inside = sqrt(at_least(1.0f - (1.0f - square(cosine)) / square(ior), 0.0f));
        const Float outer = square((ior - 1.0f) / (ior + 1.0f)), steep = fifth_power(1.0f - inside);
        first = outer + (1.0f - outer) * fifth_power(1.0f - cosine);
        for (int channel = 0; channel < 3; ++channel) {
            const Float base = base_index((&f0.x)[channel]), lower = square((base - ior) / (base + ior));
            second[channel] = lower + (1.0f - lower) * steep;
        }
    }
};
inline Float film_bound(Vec3 f0, Float ior, Float thickness, Float cosine) {
    const FilmInterfaces faces(f0, film_index(ior, thickness), cosine);
    return largest({in_phase(faces.first, faces.second[0]), in_phase(faces.first, faces.second[1]), in_phase(faces.first, faces.second[2])});
}
inline Float fringe(Float phase, float amplitude, float position, float variance, Float shift) {
    const float height = float(double(amplitude) * __builtin_sqrt(2.0 * 3.14159265358979323846 * double(variance)) / 1.0685e-7);
    Float sine, cosine;
    sincos(position * phase + shift, sine, cosine);
    return height * cosine * exp_of_negative(-variance * square(phase));
}
inline Vec3 film_sensitivity(Float difference, Vec3 shift) {
    const Float phase = float(2.0e-9 * 3.14159265358979323846) * difference;
    const Float x = fringe(phase, 5.4856e-13f, 1.6810e6f, 4.3278e9f, shift.x) + fringe(phase, 9.7470e-14f, 2.2399e6f, 4.5282e9f, shift.x);
    const Float y = fringe(phase, 4.4201e-13f, 1.7953e6f, 9.3046e9f, shift.y), z = fringe(phase, 5.2481e-13f, 2.2084e6f, 6.6121e9f, shift.z);
    return {3.2404542f * x - 1.5371385f * y - 0.4985314f * z, -0.9692660f * x + 1.8760108f * y + 0.0415560f * z,
            0.0556434f * x - 0.2040259f * y + 1.0572252f * z};
}
inline Vec3 film_reflectance(Vec3 f0, Float ior, Float thickness, Float cosine) {
    ior = film_index(ior, thickness);
    const FilmInterfaces faces(f0, ior, cosine);
    const Float passed = 1.0f - faces.first, denser = one_if(ior >= all(1.0f));
    Float both[3], returned[3], shift[3];
    for (int channel = 0; channel < 3; ++channel) {
        shift[channel] = PI * (denser + one_if(base_index((&f0.x)[channel]) < ior));
        both[channel] = clamp(faces.first * faces.second[channel], 1e-5f, 0.9999f);
        returned[channel] = square(passed) * faces.second[channel] / (1.0f - both[channel]);
    }
    const Vec3 root = {sqrt(both[0]), sqrt(both[1]), sqrt(both[2])}, back = {returned[0], returned[1], returned[2]};
    Vec3 total = grey(faces.first) + back, order = back - grey(passed);
    const Float difference = 2.0f * ior * thickness * faces.inside;
    for (int number = 1; number <= 2; ++number) {
        const Vec3 shifts = {shift[0] * float(number), shift[1] * float(number), shift[2] * float(number)};
        order = order * root;
        total = total + all(2.0f) * order * film_sensitivity(difference * float(number), shifts);
    }
    const auto bounded = [&](Float x, int channel) { return min(at_least(x, 0.0f), in_phase(faces.first, faces.second[channel])); };
    return {bounded(total.x, 0), bounded(total.y, 1), bounded(total.z, 2)};
}

// `metal_gain` of multiscatter.py. perfect: albedo of microfacets that reflect all light.
inline Vec3 metal_gain(const Tables& t, const Surface& s, const CoatAlbedo& perfect, const Microfacets& facets, Vec3 outgoing, Float cosine) {
    const Float mean = perfect.mean(facets);
    Float lost = 1.0f / perfect.towards(facets, outgoing, cosine) - 1.0f;
    if (t.single_scattering != nullptr) lost = lost * (1.0f - s.single_scattering);
    const auto gain = [&](Float color) {
        const Float reflectance = color + (1.0f - color) * float(1.0 / 21.0);
        return 1.0f + lost * (reflectance * mean / (1.0f - reflectance * (1.0f - mean)));
    };
    return {gain(s.base_color.x), gain(s.base_color.y), gain(s.base_color.z)};
}

struct Opaque {
    Vec3 outgoing, base_color, f0;
    Vec3 metal;  // of single scattering: `metallic`, and the gain by multiple scattering
    bool coated, shines, transmits, filmed;
    Float cosine, metallic, f90, leaving, specular_share, clearcoat_share, sheen_share, below_share;
    Microfacets facets;
    CoatAlbedo albedo;
    Clearcoat clearcoat;
    Sheen sheen;
    Float diffuse_transmission, specular;
    Vec3 transmission_color;
    Float iridescence, film_ior, film_thickness;

    Opaque(const Tables& t, Vec3 seen_from, const Surface& s, const Frame& frame) {
        outgoing = seen_from, base_color = s.base_color, metallic = s.metallic;
        cosine = at_least(outgoing.z, MIN_COSINE);
        const Float ratio = square((s.ior - 1.0f) / (s.ior + 1.0f));
        Float peak = s.specular * ratio;
        f0 = grey(peak);
        if (t.specular_color != nullptr) {
            const Vec3 tinted = ratio * s.specular_color;
            f0 = s.specular * Vec3{at_most(tinted.x, 1.0f), at_most(tinted.y, 1.0f), at_most(tinted.z, 1.0f)};
            peak = largest(f0);
        }
        f90 = specular = s.specular;
        filmed = t.film != nullptr;
        if (filmed) {
            iridescence = s.iridescence, film_ior = s.film_ior, film_thickness = s.film_thickness;
        }
        facets = t.anisotropy != nullptr ? Microfacets(outgoing, s.alpha, s.alpha_along) : Microfacets(outgoing, s.alpha);
        coated = t.clearcoat != nullptr, shines = t.sheen != nullptr, transmits = t.diffuse_transmission != nullptr;
        if (shines) sheen = Sheen(t, cosine, s);
        if (transmits) diffuse_transmission = s.diffuse_transmission, transmission_color = s.transmission_color;
        if (coated) clearcoat = Clearcoat(t, outgoing, s, to_local(s.clearcoat_normal, frame));
        choose_shares(peak);
        albedo = CoatAlbedo(t, facets, peak, f90 - peak);
        Float entering = at_least(1.0f - albedo.mean(facets), LEAST_ENTERING);
        if (filmed) entering = at_least(entering + (passing_film(all(1.0f)) * (20.0f / 21.0f) - entering) * iridescence, 1e-4f);
        leaving = (1.0f - metallic) * passing(outgoing, cosine) / (PI * entering);
        metal = grey(metallic);
        if (any(metallic > all(0.0f))) {
            CoatAlbedo perfect = albedo;
            perfect.f0 = all(1.0f), perfect.rise = all(0.0f);
            metal = metallic * metal_gain(t, s, perfect, facets, outgoing, cosine);
        }
    }
    Float passing(Vec3 direction, Float towards) const {
        const Float passed = at_least(1.0f - albedo.towards(facets, direction, towards), 0.0f);
        return filmed ? passed + (passing_film(towards) - passed) * iridescence : passed;
    }
    Float passing_film(Float towards) const { return (1.0f - FILM_TRACE) * (1.0f - film_bound(f0, film_ior, film_thickness, towards)); }

    // `_fresnel`: reflectances of coat and metal with a film.
    void film_fresnel(Float towards, Float grazing, Vec3& coat, Vec3& metal) const {
        coat = f0 + (grey(specular) - f0) * grazing, metal = base_color + (grey(all(1.0f)) - base_color) * grazing;
        coat = coat + (film_reflectance(f0, film_ior, film_thickness, towards) - coat) * iridescence;
        metal = metal + (film_reflectance(base_color, film_ior, film_thickness, towards) - metal) * iridescence;
    }

    void choose_shares(Float peak) {
        const Float grazing = fifth_power(1.0f - cosine), base = luminance(base_color);
        const Float coat = peak + (f90 - peak) * grazing;
        Float specular = metallic * (base + (1.0f - base) * grazing) + (1.0f - metallic) * coat;
        if (filmed) {
            Vec3 of_coat, of_metal;
            film_fresnel(cosine, grazing, of_coat, of_metal);
            specular = metallic * luminance(of_metal) + (1.0f - metallic) * luminance(of_coat);
        }
        Float diffuse = (1.0f - metallic) * (1.0f - peak) * base;
        if (transmits) {
            const Float below = diffuse_transmission * luminance(transmission_color);
            const Float both = (1.0f - diffuse_transmission) * base + below;
            below_share = (below + 1e-9f) / (both + 1e-9f);
            diffuse = (1.0f - metallic) * (1.0f - peak) * both;
        }
        if (shines) {
            const Float over = sheen.reflectance;
            specular = specular * (1.0f - over), diffuse = diffuse * (1.0f - over) + over;
            sheen_share = (over + 1e-9f) / (diffuse + 1e-9f);
        }
        specular_share = (specular + 1e-9f) / (specular + diffuse + 1e-9f);
        if (coated) {
            const Float over = clearcoat.reflectance;
            clearcoat_share = over / (over + (1.0f - over) * (specular + diffuse) + 1e-9f);
        }
    }

    // Density of the lobes of sheen and base above the surface, without a clearcoat. above: 1 there, else 0.
    Float diffuse_pdf(Float towards, Float above) const {
        Float pdf = (1.0f - specular_share) * towards * (1.0f / PI);
        if (transmits) pdf = pdf * (1.0f - below_share);
        return shines ? pdf + ((1.0f - specular_share) * above * (0.5f / PI) - pdf) * sheen_share : pdf;
    }

    // BTDF times cosine, and density, of diffuse transmission; 0 above the surface.
    Scattered transmitted(Vec3 incoming) const {
        const Float below = one_if(incoming.z < all(0.0f)), towards = clamp(abs(incoming.z), MIN_COSINE, 1.0f);
        Float factor = leaving * passing(incoming, towards) * diffuse_transmission * towards * below;
        Float pdf = (1.0f - specular_share) * below_share * towards * below * (1.0f / PI);
        if (shines) factor = factor * sheen.beneath(towards), pdf = pdf * (1.0f - sheen_share);
        if (coated) {
            Float below_coat;
            const Float weight = clearcoat.transmitted(incoming, below_coat);
            factor = factor * weight * below_coat, pdf = pdf * (1.0f - clearcoat_share);
        }
        return {transmission_color * factor, pdf};
    }

    // An incoming direction at the base and at the clearcoat.
    struct Incidents {
        Incident base, clearcoat;
    };
    Incidents incidents(Vec3 incoming) const {
        const Float towards = at_least(incoming.z, MIN_COSINE);
        Incidents found = {};
        found.base = {incoming, one_if(incoming.z > all(0.0f)), towards, facets.masking_root(incoming, towards), passing(incoming, towards)};
        if (coated) found.clearcoat = clearcoat.incident(incoming);
        return found;
    }

    // BSDF times cosine, and the density of `sample`.
    Scattered evaluate(Vec3 incoming) const { return evaluate(incidents(incoming)); }
    Scattered evaluate(const Incidents& of) const {
        Float above = of.base.above;
        const Float towards = of.base.cosine;
        const Vec3 half = normalize(outgoing + of.base.direction);
        const Float facing = clamp(dot(outgoing, half), 0.0f, 1.0f), grazing = fifth_power(1.0f - facing);
        Float visibility, microfacet;
        facets.evaluate(half, towards, of.base.root, visibility, microfacet);
        const Vec3 coat = f0 + (grey(f90) - f0) * grazing;
        Float diffuse = leaving * of.base.passing;
        if (transmits) diffuse = diffuse * (1.0f - diffuse_transmission);
        const Vec3 of_metal = base_color + (grey(all(1.0f)) - base_color) * grazing;
        Vec3 value = base_color * diffuse + visibility * ((1.0f - metallic) * coat + metal * of_metal);
        if (filmed) {
            Vec3 of_coat, of_metal;
            film_fresnel(facing, grazing, of_coat, of_metal);
            value = base_color * diffuse + visibility * ((1.0f - metallic) * of_coat + metal * of_metal);
        }
        if (shines) value = value * sheen.beneath(towards) + sheen.evaluate(half, towards);
        Float pdf = specular_share * microfacet + diffuse_pdf(towards, above);
        value = value * (towards * above);
        if (coated || transmits) pdf = pdf * one_if(half.z > all(0.0f));
        if (coated) {
            Float over, of_coat, beneath;
            clearcoat.evaluate(of.clearcoat, half, grazing, over, of_coat, beneath);
            value = value * beneath + grey(over);
            pdf = pdf + (of_coat - pdf) * clearcoat_share;
            above = max(above, of.clearcoat.above);
        }
        if (!transmits) return {value, pdf * above};
        const Scattered through = transmitted(of.base.direction);
        return {value + through.value, pdf + through.pdf};
    }

    Vec3 sample(Float u0, Float u1, Float u2) const {
        Float sine, cosine_of_angle;
        sincos(2.0f * PI * u1, sine, cosine_of_angle);
        Float share = specular_share;
        Vec3 half;
        if (!coated) {
            half = sample_visible_normal(outgoing, facets.alpha, facets.along, u2, sine, cosine_of_angle);
        } else {
            const Float over = one_if(u0 < clearcoat_share);
            share = clearcoat_share + (1.0f - clearcoat_share) * share;
            const Float alpha = facets.alpha + (clearcoat.facets.alpha - facets.alpha) * over;
            const Float along = facets.along + (clearcoat.facets.alpha - facets.along) * over;
            const Vec3 seen = outgoing + (clearcoat.outgoing - outgoing) * over;
            half = sample_visible_normal(seen, alpha, along, u2, sine, cosine_of_angle);
            half = half + (clearcoat.from_own(half) - half) * over;
        }
        const Vec3 mirrored = 2.0f * dot(outgoing, half) * half - outgoing;
        Float radius = sqrt(u2), height = sqrt(1.0f - u2), rest = 1.0f - share;
        if (shines) rest = rest * (1.0f - sheen_share);
        if (transmits) height = u0 >= 1.0f - rest * below_share ? -height : height;
        if (shines) {
            const Int chosen = u0 < 1.0f - rest;
            height = chosen ? at_least(1.0f - u2, MIN_COSINE) : height;
            radius = chosen ? sqrt(at_least(1.0f - square(1.0f - u2), 0.0f)) : radius;
        }
        const Vec3 diffuse = {radius * cosine_of_angle, radius * sine, height};
        return choose(u0 < share, mirrored, diffuse);
    }
};

inline Float fresnel(Float cosine, Float eta) {
    cosine = at_most(abs(cosine), 1.0f);
    const Float transmitted = sqrt(at_least(1.0f - (1.0f - cosine * cosine) / (eta * eta), 0.0f));
    const Float parallel = (eta * cosine - transmitted) / divisor(eta * cosine + transmitted, 1e-12f);
    const Float perpendicular = (cosine - eta * transmitted) / divisor(cosine + eta * transmitted, 1e-12f);
    return 0.5f * (parallel * parallel + perpendicular * perpendicular);
}

struct Dielectric {
    Vec3 outgoing, base_color;
    Float cosine, thin, solid, eta, smooth, alpha, root;
    bool filmed;
    Float ior, front, iridescence, film_ior, film_thickness;

    // ior: of the surface, or of a channel of a dispersive solid.
    Dielectric(const Tables& t, Vec3 seen_from, const Surface& s, Float ior) : filmed(t.film != nullptr), ior(ior), front(s.front) {
        if (filmed) iridescence = s.iridescence, film_ior = s.film_ior, film_thickness = s.film_thickness;
        outgoing = seen_from, base_color = s.base_color, thin = s.thin;
        cosine = at_least(outgoing.z, MIN_COSINE);
        solid = 1.0f - thin;
        const Float inside = s.front * ior + (1.0f - s.front) / ior;
        eta = inside * solid + ior * thin;
        const Int straight = (abs(eta - 1.0f) < all(1e-4f)) & (thin == all(0.0f));
        smooth = one_if((s.alpha < all(SMOOTH_ALPHA)) | straight);
        alpha = at_least(s.alpha, SMOOTH_ALPHA);
        root = smith_root(cosine, alpha * alpha);
    }
    Float reflectance(Float towards) const {
        if (!filmed) return both_faces(fresnel(towards, eta));
        const Vec3 colored = colored_reflectance(towards);
        return (colored.x + colored.y + colored.z) * (1.0f / 3.0f);
    }
    Float both_faces(Float single) const { return single * solid + 2.0f * single / (1.0f + single) * thin; }
    // `_colored_reflectance`.
    Vec3 colored_reflectance(Float towards) const {
        const Float inner = at_most(abs(towards), 1.0f), squared = 1.0f - (1.0f - square(inner)) * square(ior);
        const Float leaves = (1.0f - front) * solid, outside = inner + (sqrt(at_least(squared, 0.0f)) - inner) * leaves;
        const Vec3 found = film_reflectance(grey(square((ior - 1.0f) / (ior + 1.0f))), film_ior, film_thickness, outside);
        const Float plain = fresnel(inner, eta);
        const Int total = (squared < all(0.0f)) & (leaves > all(0.0f));
        const auto mixed = [&](Float film) { return both_faces(plain + ((total ? all(1.0f) : film) - plain) * iridescence); };
        return {mixed(found.x), mixed(found.y), mixed(found.z)};
    }
    Vec3 tint(Float below, Float towards) const {
        const Float scale = below * solid / square(eta) + below * thin;
        const Vec3 plain = base_color * scale + grey(1.0f - below);
        if (!filmed) return plain;
        const Vec3 colored = colored_reflectance(towards);
        const Float mean = (colored.x + colored.y + colored.z) * (1.0f / 3.0f);
        const Vec3 reflected = colored / divisor(mean, 1e-6f), transmitted = (grey(all(1.0f)) - colored) / divisor(1.0f - mean, 1e-6f);
        return plain * (reflected + (transmitted - reflected) * below);
    }
    Float masking(Float towards) const {
        const Float other = smith_root(towards, alpha * alpha);
        return (cosine + root) / (cosine * other / towards + root);
    }
    Scattered evaluate(Vec3 incoming) const {
        const Float below = one_if(incoming.z < all(0.0f)), refracts = below * solid;
        const Vec3 mirrored = {incoming.x, incoming.y, incoming.z * (1.0f - 2.0f * below)};
        Vec3 half = normalize(outgoing + mirrored * (1.0f - refracts) + eta * incoming * refracts);
        half = half * copysign(all(1.0f), half.z);
        const Float toward_viewer = dot(outgoing, half), toward_light = dot(incoming, half);
        const Float valid = one_if(toward_viewer > all(0.0f)) * (1.0f - smooth) *
                            (1.0f - refracts * one_if(toward_light > all(0.0f)));
        const Float towards = at_least(abs(incoming.z), MIN_COSINE);
        const Float visible = ggx_density(half, alpha) * 2.0f / (cosine + root);
        const Float bend = divisor(square(toward_viewer + eta * toward_light), 1e-20f);
        const Float jacobian = refracts * square(eta) * abs(toward_light) * toward_viewer / bend + 0.25f * (1.0f - refracts);
        const Float reflected = reflectance(toward_viewer), share = reflected + below * (1.0f - 2.0f * reflected);
        const Float pdf = valid > all(0.0f) ? share * visible * jacobian : all(0.0f);
        return {tint(below, toward_viewer) * (pdf * masking(towards)), pdf};
    }
    // Direction, weight and density.
    Vec3 sample(Float u0, Float u1, Float u2, Vec3& weight, Float& pdf) const {
        Float sine, cosine_of_angle;
        sincos(2.0f * PI * u1, sine, cosine_of_angle);
        const Vec3 rough = sample_visible_normal(outgoing, alpha, alpha, u2, sine, cosine_of_angle);
        const Vec3 upright = {all(0.0f), all(0.0f), all(1.0f)};
        const Vec3 half = rough + (upright - rough) * smooth;
        const Float towards = dot(outgoing, half);
        const Float below = one_if(u0 >= reflectance(towards));
        const Vec3 mirrored = 2.0f * towards * half - outgoing;
        const Vec3 flipped = {mirrored.x, mirrored.y, -mirrored.z};
        Vec3 incoming = mirrored + (flipped - mirrored) * (below * thin);
        const Float transmitted = sqrt(at_least(1.0f - (1.0f - towards * towards) / square(eta), 0.0f));
        const Vec3 refracted = (towards / eta - transmitted) * half - outgoing / eta;
        incoming = incoming + (refracted - incoming) * (below * solid);
        const Float right_side = one_if((incoming.z < all(0.0f)) == (below > all(0.0f)));
        pdf = evaluate(incoming).pdf + smooth * DELTA_PDF;
        Float masked = masking(at_least(abs(incoming.z), MIN_COSINE));
        masked = masked + (1.0f - masked) * smooth;
        weight = tint(below, towards) * (masked * right_side);
        return incoming;
    }
};

// `Scattering` of mixture.py: the BSDF in world space. choice: uniform numbers that choose the opaque or the transmissive part.
struct Scattering {
    const Tables& t;
    const Surface& surface;
    Frame frame;
    Vec3 local_outgoing;
    Opaque opaque;
    bool tilts_coats;
    Int glass;
    Vec3 channel;  // factor of transmissive parts
    Float ior;

    // throughput: of the paths.
    Scattering(const Tables& tables, const Surface& s, Float choice, Vec3 throughput = grey(all(1.0f)))
        : t(tables), surface(s), frame(t.anisotropy != nullptr ? aligned_frame(s.normal, s.tangent) : frame_about(s.normal)),
          local_outgoing(to_local(s.outgoing, frame)), opaque(t, local_outgoing, s, frame), tilts_coats(t.clearcoat != nullptr && t.tilts_coats) {
        glass = t.has_transmission ? choice < s.transmission : all(0);
        ior = s.ior;
        if (t.dispersion != nullptr && any(glass)) disperse(throughput, choice / divisor(s.transmission));
    }
    // `disperse` of mixture.py.
    void disperse(Vec3 throughput, Float number) {
        const Vec3 raised = throughput + grey(all(1e-9f)), share = raised / (raised.x + raised.y + raised.z);
        const Float red = one_if(number < share.x), blue = one_if(number >= share.x + share.y) * (1.0f - red), green = 1.0f - red - blue;
        const Float disperses = one_if((surface.dispersion > all(0.0f)) & (surface.thin == all(0.0f)));
        const Float spread = (surface.ior - 1.0f) * (0.025f * surface.dispersion) * disperses;
        ior = at_least(surface.ior + spread * (blue - red), 1.0f);
        const auto factor = [&](Float chosen, Float probability) { return 1.0f + (chosen / probability - 1.0f) * disperses; };
        channel = {factor(red, share.x), factor(green, share.y), factor(blue, share.z)};
    }
    Vec3 dispersed(Vec3 value) const { return t.dispersion != nullptr ? value * channel : value; }
    Float agree(Vec3 direction, Float above) const {
        return one_if((dot(surface.geometric_normal, direction) > all(0.0f)) == (above > all(0.0f)));
    }
    Float allowed(Vec3 direction, Float above) const {
        return agree(direction, tilts_coats ? max(above, dot(surface.clearcoat_normal, direction)) : above);
    }
    Scattered evaluate(Vec3 direction) const {
        const Vec3 local = to_local(direction, frame);
        Scattered found = opaque.evaluate(local);
        found.value = found.value * allowed(direction, local.z);
        if (any(glass)) {
            const Scattered other = Dielectric(t, local_outgoing, surface, ior).evaluate(local);
            found.value = choose(glass, dispersed(other.value) * agree(direction, local.z), found.value);
            found.pdf = glass ? other.pdf : found.pdf;
        }
        return found;
    }
    // World direction; weight is BSDF·|cos|/pdf, and value is BSDF·|cos| of the opaque part.
    Vec3 sample(Float u0, Float u1, Float u2, Vec3& weight, Float& pdf, Vec3& value) const {
        const Vec3 local = opaque.sample(u0, u1, u2);
        const Scattered found = opaque.evaluate(local);
        Vec3 direction = to_world(local, frame);
        const Float side = allowed(direction, local.z);
        weight = found.value / divisor(found.pdf, 1e-20f) * side, pdf = found.pdf, value = found.value * side;
        if (any(glass)) {
            Vec3 other_weight;
            Float other_pdf;
            const Vec3 other = Dielectric(t, local_outgoing, surface, ior).sample(u0, u1, u2, other_weight, other_pdf);
            const Vec3 towards = to_world(other, frame);
            weight = choose(glass, dispersed(other_weight) * agree(towards, other.z), weight);
            pdf = glass ? other_pdf : pdf;
            direction = choose(glass, towards, direction);
        }
        return direction;
    }
};

// `power_heuristic` of render/mis.py.
inline Float power_heuristic(Float pdf, Float other) { return 1.0f / (1.0f + square(other / divisor(pdf))); }

}  // namespace BOKEHGUIDE_ISA
