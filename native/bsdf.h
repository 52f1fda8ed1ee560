// BSDFs of render/bsdf/: opaque.py, dielectric.py and mixture.py explain the formulas.

#pragma once

#include "surface.h"

namespace BOKEHGUIDE_ISA {

constexpr float MIN_COSINE = 1e-6f, TRACE = 0.006f, SMOOTH_ALPHA = 4e-3f, DELTA_PDF = 1e30f;

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

inline Float coat_spread(Float alpha) {
    return 0.06f + 0.934f / (1.0f + alpha * alpha * alpha * float(1.0 / (0.27 * 0.27 * 0.27)));
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

    // G2 D / (4 cos cos) and the density G1 D / (4 cos).
    void evaluate(Vec3 half, Vec3 incoming, Float& visibility, Float& pdf) const {
        const Float towards = at_least(incoming.z, MIN_COSINE), other = masking_root(incoming, towards);
        const Float distribution = 0.5f * (isotropic ? ggx_density(half, alpha) : ggx_density(half, alpha, along));
        visibility = distribution / (towards * root + cosine * other);
        pdf = distribution / (cosine + root);
    }
};

struct Clearcoat {
    bool tilted;
    Frame frame;
    Vec3 outgoing;
    Float weight, minimum, spread, leaving, reflectance;
    Microfacets facets;

    Clearcoat() = default;
    Clearcoat(Vec3 seen_from, const Surface& s, bool tilts, Vec3 normal) : tilted(tilts) {
        if (tilted) frame = frame_about(normal);
        outgoing = to_own(seen_from);
        const Float cosine = at_least(outgoing.z, MIN_COSINE);
        weight = s.clearcoat;
        facets = Microfacets(outgoing, s.clearcoat_alpha);
        minimum = weight * (CLEARCOAT_F0 + TRACE * (1.0f - CLEARCOAT_F0));
        spread = weight * coat_spread(s.clearcoat_alpha) * (1.0f - CLEARCOAT_F0);
        leaving = passing(cosine);
        reflectance = weight * (CLEARCOAT_F0 + (1.0f - CLEARCOAT_F0) * fifth_power(1.0f - cosine));
    }
    Vec3 to_own(Vec3 direction) const { return tilted ? to_local(direction, frame) : direction; }
    Vec3 from_own(Vec3 direction) const { return tilted ? to_world(direction, frame) : direction; }
    Float passing(Float cosine) const { return 1.0f - minimum - spread * fifth_power(1.0f - cosine); }

    void evaluate(Vec3 incoming, Vec3 half, Float grazing, Float& value, Float& pdf, Float& beneath, Float& above) const {
        incoming = to_own(incoming), half = to_own(half);
        above = one_if(incoming.z > all(0.0f));
        const Float cosine = at_least(incoming.z, MIN_COSINE);
        Float visibility;
        facets.evaluate(half, incoming, visibility, pdf);
        value = weight * visibility * (CLEARCOAT_F0 + (1.0f - CLEARCOAT_F0) * grazing) * (cosine * above);
        pdf = pdf * one_if(half.z > all(0.0f));
        beneath = min(leaving, passing(cosine));
    }
    // Weight of light from below the surface, and 1 below the clearcoat's horizon, else 0.
    Float transmitted(Vec3 incoming, Float& below) const {
        const Float towards = to_own(incoming).z;
        below = one_if(towards <= all(0.0f));
        return min(leaving, passing(at_most(abs(towards), 1.0f)));
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

struct Opaque {
    Vec3 outgoing, base_color, f0;
    bool coated, shines, transmits;
    Float cosine, metallic, f90, minimum, rise, spread, leaving, specular_share, clearcoat_share, sheen_share, below_share;
    Microfacets facets;
    Clearcoat clearcoat;
    Sheen sheen;
    Float diffuse_transmission;
    Vec3 transmission_color;

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
        f90 = s.specular;
        facets = t.anisotropy != nullptr ? Microfacets(outgoing, s.alpha, s.alpha_along) : Microfacets(outgoing, s.alpha);
        coated = t.clearcoat != nullptr, shines = t.sheen != nullptr, transmits = t.diffuse_transmission != nullptr;
        if (shines) sheen = Sheen(t, cosine, s);
        if (transmits) diffuse_transmission = s.diffuse_transmission, transmission_color = s.transmission_color;
        if (coated) clearcoat = Clearcoat(outgoing, s, t.tilts_coats, to_local(s.clearcoat_normal, frame));
        choose_shares(peak);
        rise = f90 - peak;
        minimum = peak + TRACE * rise, spread = coat_spread(facets.along) * rise;
        const Float entering = at_least(1.0f - minimum - spread * (1.0f / 21.0f), 1e-4f);
        leaving = (1.0f - metallic) * passing(outgoing, cosine) / (PI * entering);
    }
    // spread: of isotropic coats, the same for all directions.
    Float passing(Vec3 direction, Float towards) const {
        const Float share = facets.isotropic ? spread : coat_spread(facets.facing(direction)) * rise;
        return at_least(1.0f - minimum - share * fifth_power(1.0f - towards), 0.0f);
    }

    void choose_shares(Float peak) {
        const Float grazing = fifth_power(1.0f - cosine), base = luminance(base_color);
        const Float coat = peak + (f90 - peak) * grazing;
        Float specular = metallic * (base + (1.0f - base) * grazing) + (1.0f - metallic) * coat;
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

    // BSDF times cosine, and the density of `sample`.
    Scattered evaluate(Vec3 incoming) const {
        Float above = one_if(incoming.z > all(0.0f));
        const Float towards = at_least(incoming.z, MIN_COSINE);
        const Vec3 half = normalize(outgoing + incoming);
        const Float grazing = fifth_power(1.0f - clamp(dot(outgoing, half), 0.0f, 1.0f));
        Float visibility, microfacet;
        facets.evaluate(half, incoming, visibility, microfacet);
        const Vec3 coat = f0 + (grey(f90) - f0) * grazing;
        Float diffuse = leaving * passing(incoming, towards);
        if (transmits) diffuse = diffuse * (1.0f - diffuse_transmission);
        const Float scaled = diffuse + metallic * visibility * (1.0f - grazing);
        const Vec3 white = visibility * ((1.0f - metallic) * coat + grey(metallic * grazing));
        Vec3 value = base_color * scaled + white;
        if (shines) value = value * sheen.beneath(towards) + sheen.evaluate(half, towards);
        Float pdf = specular_share * microfacet + diffuse_pdf(towards, above);
        value = value * (towards * above);
        if (coated) {
            Float over, of_coat, beneath, above_coat;
            clearcoat.evaluate(incoming, half, grazing, over, of_coat, beneath, above_coat);
            value = value * beneath + grey(over);
            pdf = pdf * one_if(half.z > all(0.0f));
            pdf = pdf + (of_coat - pdf) * clearcoat_share;
            above = max(above, above_coat);
        }
        if (!transmits) return {value, pdf * above};
        const Scattered through = transmitted(incoming);
        return {value + through.value, pdf * one_if(half.z > all(0.0f)) + through.pdf};
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

    Dielectric(Vec3 seen_from, const Surface& s) {
        outgoing = seen_from, base_color = s.base_color, thin = s.thin;
        cosine = at_least(outgoing.z, MIN_COSINE);
        solid = 1.0f - thin;
        const Float inside = s.front * s.ior + (1.0f - s.front) / s.ior;
        eta = inside * solid + s.ior * thin;
        const Int straight = (abs(eta - 1.0f) < all(1e-4f)) & (thin == all(0.0f));
        smooth = one_if((s.alpha < all(SMOOTH_ALPHA)) | straight);
        alpha = at_least(s.alpha, SMOOTH_ALPHA);
        root = smith_root(cosine, alpha * alpha);
    }
    Float reflectance(Float towards) const {
        const Float single = fresnel(towards, eta);
        return single * solid + 2.0f * single / (1.0f + single) * thin;
    }
    Vec3 tint(Float below) const {
        const Float scale = below * solid / square(eta) + below * thin;
        return base_color * scale + grey(1.0f - below);
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
        return {tint(below) * (pdf * masking(towards)), pdf};
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
        weight = tint(below) * (masked * right_side);
        return incoming;
    }
};

// `Scattering` of mixture.py: the BSDF in world space. choice: uniform numbers that choose the opaque or the transmissive part.
struct Scattering {
    const Surface& surface;
    Frame frame;
    Vec3 local_outgoing;
    Opaque opaque;
    bool tilts_coats;
    Int glass;

    Scattering(const Tables& t, const Surface& s, Float choice)
        : surface(s), frame(t.anisotropy != nullptr ? aligned_frame(s.normal, s.tangent) : frame_about(s.normal)), local_outgoing(to_local(s.outgoing, frame)),
          opaque(t, local_outgoing, s, frame), tilts_coats(t.clearcoat != nullptr && t.tilts_coats) {
        glass = t.has_transmission ? choice < s.transmission * (1.0f - s.metallic) : all(0);
    }
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
            const Scattered other = Dielectric(local_outgoing, surface).evaluate(local);
            found.value = choose(glass, other.value * agree(direction, local.z), found.value);
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
            const Vec3 other = Dielectric(local_outgoing, surface).sample(u0, u1, u2, other_weight, other_pdf);
            const Vec3 towards = to_world(other, frame);
            weight = choose(glass, other_weight * agree(towards, other.z), weight);
            pdf = glass ? other_pdf : pdf;
            direction = choose(glass, towards, direction);
        }
        return direction;
    }
};

// `power_heuristic` of render/mis.py.
inline Float power_heuristic(Float pdf, Float other) { return 1.0f / (1.0f + square(other / divisor(pdf))); }

}  // namespace BOKEHGUIDE_ISA
