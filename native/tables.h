// The tables of a scene and the arguments of a trace, as plain pointers: the same for every instruction set.
//
// Tables are those of the PyTorch modules (render/geometry.py, render/materials.py, render/textures.py, render/lights/), whose
// docstrings describe them. A row of a table `[rows, N]` begins N entries after the one before. A pointer is null where the
// scene has no use for the table.

#pragma once

#include <cstdint>

namespace bokehguide {

// Lanes of the widest core; rows of whole vectors are padded to them.
constexpr int64_t MOST_LANES = 16;
inline int64_t whole_vectors(int64_t count) { return (count + MOST_LANES - 1) / MOST_LANES * MOST_LANES; }

double seconds();  // of a steady clock

// Texture slots, in the order of `SLOTS` in render/materials.py.
enum Slot { BASE_COLOR, METALLIC_ROUGHNESS, EMISSION, NORMAL, SPECULAR, SPECULAR_COLOR, TRANSMISSION, CLEARCOAT, CLEARCOAT_ROUGHNESS,
            CLEARCOAT_NORMAL, SHEEN_COLOR, SHEEN_ROUGHNESS, ANISOTROPY, DIFFUSE_TRANSMISSION, DIFFUSE_TRANSMISSION_COLOR,
            IRIDESCENCE, IRIDESCENCE_THICKNESS, SLOTS };

// What the renderer needs of a triangle at a hit, in one line of the cache.
struct alignas(64) TriangleRow {
    float geometric[3], normals[9];
    int32_t material, emitter, unused[2];
};

// What the renderer needs of an emissive triangle, in one line of the cache: the first corner, the edges from there, emission and
// double-sidedness, the density of samples in its cluster.
struct alignas(64) EmitterRow {
    float corner[3], first[3], second[3], emission[4], density;
    int32_t triangle, cluster;
};
static_assert(sizeof(TriangleRow) == 64 && sizeof(EmitterRow) == 64, "one line of the cache");

struct AliasEntry {
    float keep;
    int32_t alias;
};

constexpr int MOST_LIGHT_GROUPS = 32;
constexpr int LEVELS_IN_LINE = 4, FLOATS_IN_LINE = 1 << LEVELS_IN_LINE;  // a line of the cache has 16 floats

// A `ClusterTable`: rows of 1 << levels cumulative probabilities. `ends` are the last ones of each FLOATS_IN_LINE, or all of them in
// rows with fewer, 1 << coarse_levels for each row. FLOATS_IN_LINE entries follow the last row of `ends`.
struct ClusterTable {
    const float *cumulative, *ends;
    int32_t levels, coarse_levels;
};

struct DistantTable {
    float frame[9];  // row by row; the third column points to the light
    float height, squared_radius, density, radiance[3];
    float share;  // of the samples of the environment
};

struct Tables {
    // Geometry
    const TriangleRow* triangles;
    int64_t triangle_count;
    void *tracer, *opaque, *translucent;  // RTCScene; null for none
    const int64_t* translucent_numbers;   // numbers of the translucent scene's triangles among all
    const float *uvs, *colors, *tangents[SLOTS];
    const float* vertices;   // three coordinates each
    const int32_t* corners;  // three vertices for each triangle

    // Materials, M columns
    int64_t materials;
    const float *parameters, *emission, *specular_color, *clearcoat, *cones, *opacity, *absorption, *normal_scales[SLOTS];
    const int32_t *emissive, *tinted, *is_translucent;
    const int64_t* numbers[SLOTS];
    const int32_t *coat_albedo, *brushed_albedo;  // the latter null without anisotropy
    const float *sheen, *sheen_albedo, *anisotropy, *diffuse_transmission, *film, *dispersion, *single_scattering;
    bool tilts_coats, has_transmission, plain_emission;
    int32_t surface_rows;  // of records: `Surface` in surface.h without the last fields, where no material needs them

    // Textures, K columns
    int64_t textures;
    const uint16_t* texels;
    const int64_t *texture_start, *texture_sizes, *texture_bounds, *texture_uv_set;
    const float *texture_transforms, *texture_scales;
    int64_t uv_sets;

    // Emissive triangles, E columns
    int64_t emitters;
    const EmitterRow* emitter_rows;
    const AliasEntry* within_table;
    const int32_t* within_start;
    ClusterTable clusters;
    const float* far_share;
    float grid_low[3], grid_scale, grid_last[3];
    int32_t grid_step[3];
    bool has_far_power;

    // Environment
    bool has_environment, visible_environment;
    const float* map_texels;      // radiance and density of samples
    const AliasEntry* map_table;  // null where the map is not sampled
    int32_t map_width, map_height;
    float map_turn, map_share;
    int32_t distant_count;
    const DistantTable* distant;
    const float* distant_edges;  // cumulative shares of the map and of all distant lights but the last
};

// Keys of the random numbers of a step (render/random.py).
struct Random {
    uint32_t step_key, seed_key, index, group;  // group: number of pixels that share a scramble, a power of two
    const int32_t (*directions)[30];  // of Sobol' sequences, eight dimensions
};

// A choice among clusters of lights at primary hits, by tables of the tiles of a frame (render/lights/light_clusters.py).
struct ClusterLights {
    // Tiles of the frame, which are the rows of the table
    float axes[9], position[3], pixel_slope, half_width, half_height, tile_size, last_column, last_row;
    int32_t across;
    // Without `cumulative` in the first epoch, in which the voxel grid chooses alone
    ClusterTable table;
    const float *visibility, *factor;
    int32_t clusters, first_step, light_candidates, bsdf_candidates;
    // Clusters of the environment: those of the map begin at `first_texels`, those of distant lights at `first_distant`
    int32_t first_texels, map_clusters, first_distant;
    const AliasEntry* texel_table;  // whose aliases are texels; null where the map is not sampled, as the next four
    const int32_t *texel_start, *texel_order;
    const uint8_t* texel_cluster;
    const float* cluster_scale;
};

// Primary hits whose rays split into paths, and the paths (render/primary_hits.py). Hits are in the order of the rays.
struct SplitRecord {
    const float* counts;  // paths of each ray
    int64_t hit_columns, path_columns;
    // Of hits
    int32_t *ray, *triangle, *paths;
    float *distance, *u, *v, *surface, *emission;
    // Of paths
    int64_t* owner;
    float *light_direction, *scattered_direction;
    float *direct, *indirect, *bsdf;  // bsdf: BSDF times cosine of both directions, [6, paths]
    // Light samples of paths; null without `lights`
    int32_t *light_row, *light_cluster;
    float *light_rms, *light_visibility, *light_difference;
    int64_t hit_count, path_count;
};

// The incident light of recorded paths, by which their primary hits are shaded, and their BSDFs along the rays; rows as in
// `SplitRecord`.
struct PathLight {
    int64_t hit_columns, path_columns, path_count;
    const float *surface, *light_direction, *scattered_direction, *incident, *bsdf;
    const int32_t *first_path, *paths;  // of each hit
};

// Light groups (render/light_groups.py): the group of each material, and of the environment map and each distant light; and the
// radiance of the groups in a trace, to be added to zeros: along the rays, `[groups, 3, count]`, and of the light sample and then the
// BSDF sample of each split path, `[groups, 6, path_columns]`.
struct LightGroups {
    int32_t count;
    const int32_t *materials, *far;
    float *rays, *reflected;
};

struct Trace {
    int64_t count;
    const float *origin, *direction, *alive;  // [3, count] each, [count] or null
    const int32_t* pixel_keys;
    Random random;
    int32_t max_depth, first_step;
    const ClusterLights* lights;  // of primary hits; null for those by power
    SplitRecord* split;           // null for one path a ray
    // Virtual images (guiding/virtual_images.py), [3, count]: their light, the distance of the brightest, and whether some path
    // leaves the primary hit as in a mirror or glass. Null for none.
    float* images;
    const LightGroups* groups;      // null for none
    const float* shadow_threshold;  // of the roulette of shadow rays, [count]; null for none
    // Results, all written.
    float *radiance, *distance, *normal, *albedo, *emission, *alpha;
    int32_t* triangle;
    int64_t rays;
    double embree_seconds;
};

// One sample for each of some pixels, and the sums of a film over its pixels (render/film.py); rows as in `Tables`.
struct FilmSamples {
    int64_t count;
    const float *weight, *radiance_weight, *radiance, *alpha, *depth, *normal, *albedo, *emission;
};
struct FilmSums {
    int64_t pixels;
    double *radiance, *emission, *square, *features, *passed;  // passed: null unless the frame is vignetted
    float *count, *nearest, *farthest, *moments, *center;      // the last two null without a control variate
};

// Numbers of pixels in a frame, null for consecutive pixels from `first` on.
struct PixelNumbers {
    const int64_t* numbers;
    int64_t first;

    int64_t number(int64_t i) const { return numbers == nullptr ? first + i : numbers[i]; }
};
struct FilmFrame {
    int32_t width;
    float half_width, half_height, pixel_slope, focus_distance;
};
struct Camera {
    float axes[9], position[3];  // camera to world, row by row
};
struct LensCamera {
    Camera camera;
    float radius, squared_radius, passing, focus_distance, pixel_slope;  // passing: 1 / A of a round aperture
};

// A raster with a margin of `border` cells (guiding/record_buffer.py), of a frame by its halves and the width of a pixel at unit distance.
struct RecordRaster {
    float half_width, half_height, pixel_slope;
    int32_t border, width, height;
    float far, miss;  // distance at which rays without a hit end, and from which on a distance is none
};

// What `Guide.record` reports: samples; the mixture of their pixels, all null without one; and emitters that the record leaves out.
struct GuideSamples {
    int64_t count;
    const float *radiance, *weight;
    const uint8_t* good;
};
struct MixtureSamples {
    const float *density, *beta;
    const uint8_t* guided;
    float unit, area;  // of radiance, and of the lens
};
struct KnownEmission {
    const float* emission;
    const int32_t* triangle;
    const uint8_t* known;  // triangles
    bool whole_environment;
};
// Draws of emitters (guiding/emitter_guide.py): of N pixels, and of the candidates among which they choose.
struct EmitterDraws {
    const float *beta, *mixture, *density, *ratio;
    const int64_t* candidate;  // -1 for none
    const float *weight, *contribution;
    const int32_t* slots;
    float area_of_unit, most;
};
// Tiles of a frame and rates by slot (guiding/success_rates.py).
struct SuccessTiles {
    int32_t width, size, across;
    uint32_t last_slot;
    int64_t emitters;
    const float* rates;
};

// Groups end with bands of ROWS_PER_BAND rows and with bands of 2^COLUMN_BITS columns.
constexpr int MOST_MEMBERS = 64, ROWS_PER_BAND = 8, COLUMN_BITS = 5, COLUMNS_PER_BAND = 1 << COLUMN_BITS;
// Groups of pixels of a film that reuse each other's primary hits (guiding/pixel_groups.py): the number of the first
// pixel of a batch and of all pixels, null for consecutive ones; the width of the film, the shifts of tiles, and `PixelGroups.offsets`.
struct PixelGroups {
    int64_t first;
    const int64_t* pixels;
    int32_t width, right[ROWS_PER_BAND], below, members, across[MOST_MEMBERS], down[MOST_MEMBERS];
};

// One sample for each of some pixels; rows as in `Tables`.
struct LensSamples {
    int64_t count;
    const float *points, *focus, *depth, *weight, *radiance;
    const int32_t* triangle;
};

// Recorded hits and their light; rows as in `SplitRecord`.
struct HitRecord {
    int64_t count;
    const int32_t *ray, *triangle;
    const float *u, *v, *distance, *emission;
    PathLight light;
};

// Views of primary hits by other pixels of a group: rows of `columns` entries, of which `count` are in use. The views of each source
// follow one another, in the order of the members of the group.
struct ViewRows {
    int64_t columns, count;
    int32_t members;
    int32_t *source, *viewer, *member;
    float *x, *y, *jacobian, *passing, *outgoing;
    // Of the pixels of a batch, filled up to whole vectors: the number of the primary hit, -1 for none; column and row in the band,
    // number after the first; whether others may use the hit, its depth and plane; scale of the weights.
    int64_t pixels;
    int32_t *place, *column, *line, *number;
    float *reusable, *depth, *plane, *scale;
    int32_t* among;  // index of each number in the batch, -1 for none; null for consecutive pixels
    int32_t numbers;  // in `among`, or of the batch
};

// The weights of reuse, for each pixel: density and W / A at the pixel's own lens point, null for a round aperture, whose W / A is
// `inside` where the sample has a weight; transmittance there, null for 1.
struct OwnSamples {
    const float *density, *passing, *transmittance;
    float inside;

    float passing_at(int64_t pixel) const { return passing == nullptr ? inside : passing[pixel]; }
};

// Light groups in the reuse of primary hits: those of materials; radiance of the samples before and after reuse, `[groups, 3, N]`; and
// that of recorded paths, as in `LightGroups`.
struct ReusedGroups {
    int32_t count;
    const int32_t* materials;
    const float *own, *reflected;
    float* radiance;
};

// Piecewise linear densities (models/emitters/piecewise_linear.py).
struct PiecewiseTable {
    int64_t period;
    const int64_t *keys, *position, *start, *end;  // the last two of each density
    const double *weights, *cumulative, *total;
};

// Emitters of an environment map as densities on the lens (models/emitters/environment.py).
struct EnvironmentTable {
    int32_t width, height;
    int64_t emitters;
    double turn, axes[9];  // camera to world, row by row
    float float_axes[9];
    PiecewiseTable segments, rows;
    const int64_t *segment, *emitter;
    const double *whole, *columns;  // [2, emitters]
    const int32_t* slot;
    const float* flux;
};

// Parallelograms (models/emitters/parallelogram.py): three rows each, but for the last two.
struct ParallelogramTable {
    int64_t count;
    const float *centre, *right, *up, *normal, *first, *second, *area, *luminance;
};

// A mixture for each of some pixels (models/base.py), whose candidates are components of a field.
struct MixtureRows {
    int64_t pixels, candidates, columns, components;  // columns: candidates up to a whole vector
    float lens_radius, lens_squared_radius, lens_area;
    const int64_t *start, *given;  // candidates of each pixel, and their components
    const float *focus, *given_beta;
    // Of components
    const float *mean, *strength;
    // Of candidates
    const float* scale;  // of weights; null for 1
    int32_t *owner, *component;
    float *contribution, *weight;
    int64_t* cumulative;
    // Of pixels
    float* beta;
    uint8_t* guided;
};

constexpr int ELLIPSE_ROW = 12;  // numbers of an ellipse, of which the last is unused

// A mixture of shapes (models/ellipse_mixture.py).
struct EllipseRows : MixtureRows {
    bool clips;
    // Of components
    const float* outline;
    const int64_t *environment_index, *parallelogram_index;
    const EnvironmentTable* environment;  // null for none, as the next
    const ParallelogramTable* parallelograms;
    // Of candidates
    float *ellipses, *windows;
    double* map_rows;
    uint8_t* clipped;
    // Of pixels
    double* cones;
    uint8_t* sees_map;
};

// The row of a Gaussian: mean, σ, weight; inverse radius and centre of its disc on the raster, and unit of its coefficients. The polynomial
// offset of the mean follows (models/polynomial_offset.py): three coefficients and a 0 for each monomial.
enum GaussianField { MEAN, SIGMA = 3, STRENGTH, INVERSE_RADIUS, CENTER, UNIT = 8, OFFSETS = 12 };
constexpr int OFFSET_FIELDS = 4;
// The row of a pixel: focus point and raster position.
enum GaussianPixelField { FOCUS, RASTER = 3, PIXEL_FIELDS = 8 };

// A mixture of Gaussians (models/gaussian_mixture.py).
struct GaussianRows : MixtureRows {
    int32_t degree, row_length;  // degree of the polynomials, -1 without offsets
    const float* rows;           // of components, row by row
    const float* raster;
    float* of_pixels;  // row by row, as the next
    float* gaussians;  // of candidates: mean and σ
};

}  // namespace bokehguide
