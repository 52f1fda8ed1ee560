// Sums over samples: guiding/light_sampler.py, guiding/tile_pools.py, guiding/record_buffer.py, guiding/control_variate.py and render/coverage.py.

#include "bindings.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.h"
#include "parallel.h"

namespace bokehguide {

namespace {

constexpr int CONTROL_ROWS = 8;

// Number of samples of all batches; the first array of a batch has one entry for each.
template <class Batch> size_t sample_count(const std::vector<Batch>& batches) {
    size_t count = 0;
    for (const Batch& batch : batches) count += std::get<0>(batch).size();
    return count;
}

// Arrays of one batch of light samples: tile, cluster, contribution and visibility.
using LightBatch = std::tuple<Ints, Ints, Floats, Floats>;

// Adds the samples of tiles `first` … `last` to sums `[3, tiles · clusters]`.
void add_light_batch(double* total, size_t places, const LightBatch& batch, size_t clusters, double most, size_t first, size_t last) {
    const auto& [tile, cluster, contribution, visibility] = batch;
    const size_t count = tile.size();
    for (size_t i = 0; i < count; ++i) {
        const size_t row = size_t(tile.data()[i]);
        if (row < first || row >= last || cluster.data()[i] < 0 || size_t(cluster.data()[i]) >= clusters) continue;
        const size_t place = row * clusters + size_t(cluster.data()[i]);
        double value = contribution.data()[i];
        value = std::isnan(value) ? 0.0 : (value < most ? value : most);
        total[place] += value * value, total[places + place] += 1.0, total[2 * places + place] += visibility.data()[i];
    }
}

// `LearnedLightSampler.add`: adds samples to sums `[3, tiles · clusters]`, in the order of the batches.
void add_light_samples(Out<double> sums, const std::vector<LightBatch>& batches, int clusters, double most, int threads) {
    const size_t places = sums.size() / 3, tiles = places / size_t(std::max(clusters, 1));
    check(sums, 3 * tiles * size_t(clusters), "sums");
    for (const auto& [tile, cluster, contribution, visibility] : batches) {
        const size_t count = tile.size();
        check(cluster, count, "cluster"), check(contribution, count, "contribution"), check(visibility, count, "visibility");
    }
    nb::gil_scoped_release released;
    double* const total = sums.data();
    in_ranges(tiles, sample_count(batches), threads, [&](size_t first, size_t last) {
        for (const LightBatch& batch : batches) add_light_batch(total, places, batch, size_t(clusters), most, first, last);
    });
}

// Means over windows of `width` entries, smaller at the ends, of `count` entries of `size` numbers each. `entry(i)` returns a
// pointer to the numbers of entry i.
template <class Entry> void window_mean(const Entry& entry, size_t at, size_t count, size_t width, size_t size, double* mean) {
    const size_t first = at - std::min(at, width / 2), last = std::min(at + width / 2 + 1, count);
    std::fill_n(mean, size, 0.0);
    for (size_t i = first; i < last; ++i) {
        const double* const values = entry(i);
        for (size_t k = 0; k < size; ++k) mean[k] += values[k];
    }
    for (size_t k = 0; k < size; ++k) mean[k] /= double(last - first);
}

// `TilePools.pooled`: weighted means over squares of tiles. values: `[down, across, channels]`. own: weight of the tile
// itself. pools: width of each square, an odd number, and weight of its mean.
void pool_tiles(const Out<const double>& values, double own, const std::vector<std::pair<int, double>>& pools, Out<double> pooled, int threads) {
    if (values.ndim() != 3) throw std::invalid_argument("values are not [down, across, channels]");
    const size_t down = values.shape(0), across = values.shape(1), channels = values.shape(2), row_size = across * channels;
    check(pooled, values.size(), "pooled");
    nb::gil_scoped_release released;
    const double* const source = values.data();
    in_ranges(down, values.size(), threads, [&](size_t first, size_t last) {
        std::vector<double> column(row_size), mean(channels);
        for (size_t y = first; y < last; ++y) {
            double* const out = pooled.data() + y * row_size;
            for (size_t k = 0; k < row_size; ++k) out[k] = own * source[y * row_size + k];
            for (const auto& [width, share] : pools) {
                window_mean([&](size_t i) { return source + i * row_size; }, y, down, size_t(width), row_size, column.data());
                for (size_t x = 0; x < across; ++x) {
                    window_mean([&](size_t i) { return column.data() + i * channels; }, x, across, size_t(width), channels, mean.data());
                    for (size_t k = 0; k < channels; ++k) out[x * channels + k] += share * mean[k];
                }
            }
        }
    });
}

// Number of entries of a window of `width` entries around one of `count` entries.
size_t window_size(size_t at, size_t count, size_t width) { return std::min(at + width / 2 + 1, count) - (at - std::min(at, width / 2)); }

// Sums over windows of entries of `size` numbers each, smaller at the ends. Two blocks as wide as the window contain a window, so that
// its sum is that of the end of one block and of the start of the next (van Herk 1992). `starts` and `ends` are scratch memory.
void window_sums(const double* values, size_t count, size_t size, size_t width, double* sums, double* starts, double* ends) {
    const auto add = [size](double* to, const double* one, const double* other) {
        for (size_t k = 0; k < size; ++k) to[k] = one[k] + other[k];
    };
    for (size_t i = 0; i < count; ++i) {
        if (i % width == 0) std::copy_n(values + i * size, size, starts + i * size);
        else add(starts + i * size, starts + (i - 1) * size, values + i * size);
    }
    for (size_t i = count; i-- > 0;) {
        if (i % width == width - 1 || i == count - 1) std::copy_n(values + i * size, size, ends + i * size);
        else add(ends + i * size, values + i * size, ends + (i + 1) * size);
    }
    for (size_t i = 0; i < count; ++i) {
        const size_t first = i - std::min(i, width / 2), last = std::min(i + width / 2, count - 1);
        if (first / width != last / width) add(sums + i * size, ends + first * size, starts + last * size);
        else std::copy_n(first % width == 0 ? starts + last * size : ends + first * size, size, sums + i * size);
    }
}

// `TilePools.shrunk` for a chunk of the channels, which stays in the cache.
class ShrunkChannels {
  public:
    static constexpr size_t COUNT = 16;

    ShrunkChannels(size_t down, size_t across) : down_(down), across_(across) {
        for (auto* table : {&values_, &arrived_, &estimate_, &expected_, &moments_, &numbers_, &columns_, &starts_, &ends_}) {
            table->resize(down * across * COUNT);
        }
    }
    // Estimates of the channels from `first` on, from tables of `channels` columns.
    void run(const double* values, const double* arrived, size_t channels, size_t first, const std::vector<int>& squares, double prior,
             double doubt, const std::pair<double, double>& shares, double* estimate) {
        const size_t count = std::min(COUNT, channels - first);
        for (size_t tile = 0; tile < down_ * across_; ++tile) {
            std::copy_n(values + tile * channels + first, count, &values_[tile * COUNT]);
            std::copy_n(arrived + tile * channels + first, count, &arrived_[tile * COUNT]);
        }
        for (size_t level = 0; level < squares.size(); ++level) {
            before_ = estimate_;
            shrink(size_t(squares[level]), level == 0, prior, doubt);
        }
        for (size_t tile = 0; tile < down_ * across_; ++tile) {
            for (size_t k = 0; k < count; ++k) {
                const size_t i = tile * COUNT + k;
                estimate[tile * channels + first + k] = shares.first * estimate_[i] + shares.second * before_[i];
            }
        }
    }

  private:
    using Table = std::vector<double>;

    size_t down_, across_;
    Table values_, arrived_, estimate_, before_, expected_, moments_, numbers_, columns_, starts_, ends_;

    void square_sums(const Table& values, size_t width, Table& sums) {
        const size_t row = across_ * COUNT;
        window_sums(values.data(), down_, row, width, columns_.data(), starts_.data(), ends_.data());
        for (size_t y = 0; y < down_; ++y) window_sums(&columns_[y * row], across_, COUNT, width, &sums[y * row], starts_.data(), ends_.data());
    }
    void shrink(size_t width, bool largest, double prior, double doubt) {
        square_sums(values_, width, moments_), square_sums(arrived_, width, numbers_);
        for (size_t y = 0; y < down_; ++y) {
            for (size_t x = 0; x < across_; ++x) {
                const double tiles = double(window_size(y, down_, width) * window_size(x, across_, width));
                for (size_t i = (y * across_ + x) * COUNT, end = i + COUNT; i < end; ++i) {
                    const double share = largest ? 1.0 : expected_[i], lost = share * tiles / doubt;
                    const double kept = largest ? 0.0 : numbers_[i] > 0.0 ? prior : prior / (1.0 + lost * lost), whole = kept + share * tiles;
                    estimate_[i] = (kept * estimate_[i] + share * moments_[i]) / whole;
                    expected_[i] = (kept * expected_[i] + share * numbers_[i]) / whole;
                }
            }
        }
    }
};

// `TilePools.shrunk`: values, relative second moments, and arrived, numbers of visible samples: `[down, across, channels]`. squares: odd
// widths, from the largest square to the tile. prior: number of samples that the estimate of the next larger square counts as. doubt:
// number of expected samples at which this number is halved, if none arrived. shares: of the last two estimates.
void shrink_tiles(const Out<const double>& values, const Out<const double>& arrived, Out<double> estimate, const std::vector<int>& squares,
                  double prior, double doubt, const std::pair<double, double>& shares, int threads) {
    if (values.ndim() != 3) throw std::invalid_argument("values are not [down, across, channels]");
    constexpr size_t COUNT = ShrunkChannels::COUNT;
    const size_t down = values.shape(0), across = values.shape(1), channels = values.shape(2);
    check(arrived, values.size(), "arrived"), check(estimate, values.size(), "estimate");
    nb::gil_scoped_release released;
    in_ranges((channels + COUNT - 1) / COUNT, values.size(), threads, [&](size_t begin, size_t end) {
        ShrunkChannels chunk(down, across);
        for (size_t first = begin * COUNT; first < std::min(end * COUNT, channels); first += COUNT) {
            chunk.run(values.data(), arrived.data(), channels, first, squares, prior, doubt, shares, estimate.data());
        }
    });
}

// `MisFactors.moments`: adds paths to sums `[2, tiles]`; factor: of each tile.
void add_mis_moments(Out<double> sums, const Floats& factor, const Ints& tile, const Floats& difference, const Floats& reflected, double most) {
    const size_t count = tile.size(), tiles = factor.size();
    check(sums, 2 * tiles, "sums"), check(difference, count, "difference"), check(reflected, count, "reflected");
    nb::gil_scoped_release released;
    double* const total = sums.data();
    const auto finite = [most](double value) { return std::isnan(value) ? 0.0 : (value < most ? (value > -most ? value : -most) : most); };
    for (size_t i = 0; i < count; ++i) {
        const size_t place = size_t(tile.data()[i]);
        if (place >= tiles) continue;
        const double change = finite(difference.data()[i]), rest = finite(reflected.data()[i]) - double(factor.data()[place]) * change;
        total[place] += rest * change, total[tiles + place] += change * change;
    }
}

// A cell of a record of `cells` cells, no cell for a negative number. Throws for a number beyond the last cell.
size_t cell_in(int64_t number, size_t cells) {
    if (number >= int64_t(cells)) throw std::out_of_range("cell outside the record");
    return size_t(number);
}

// Arrays of one batch of records: cells, positions `[3, N]` and luminance.
using RecordBatch = std::tuple<Out<const int64_t>, Floats, Floats>;

// Adds the samples in cells `first` … `last` to sums `[5, cells]`.
void add_record_batch(float* total, size_t places, const RecordBatch& batch, size_t first, size_t last) {
    const auto& [cells, points, luminance] = batch;
    const size_t count = luminance.size();
    for (size_t i = 0; i < count; ++i) {
        const size_t cell = cell_in(cells.data()[i], places);
        if (cell < first || cell >= last) continue;
        const float light = luminance.data()[i], x = points.data()[i], y = points.data()[count + i], depth = points.data()[2 * count + i];
        const float values[5] = {1.0f, light, light * (x / depth), light * (y / depth), light * (1.0f / depth)};
        for (size_t plane = 0; plane < 5; ++plane) total[plane * places + cell] += values[plane];
    }
}

// `RecordBuffer.add`: adds samples to sums `[5, cells]`, in the order of the batches.
void add_records(FloatsOut sums, const std::vector<RecordBatch>& batches, int threads) {
    const size_t places = sums.size() / 5;
    check(sums, 5 * places, "sums");
    for (const auto& [cells, points, luminance] : batches) {
        check(cells, luminance.size(), "cells"), check(points, 3 * luminance.size(), "points");
    }
    nb::gil_scoped_release released;
    float* const total = sums.data();
    in_ranges(places, sample_count(batches), threads, [&](size_t first, size_t last) {
        for (const RecordBatch& batch : batches) add_record_batch(total, places, batch, first, last);
    });
}

// Arrays of one batch of hits: cells, luminance, and whether voxels add the sample, false before `add_hits`.
using HitBatch = std::tuple<Out<const int64_t>, Floats, Out<bool>>;

// Adds the samples in cells `first` … `last` to sums `[2, cells]`, and marks samples that voxels add. Returns their number.
size_t add_hit_batch(float* total, size_t places, const HitBatch& batch, const bool* lit, float threshold, size_t first, size_t last) {
    const auto& [cells, luminance, bright] = batch;
    const size_t count = luminance.size();
    size_t found = 0;
    for (size_t i = 0; i < count; ++i) {
        const size_t cell = cell_in(cells.data()[i], places);
        if (cell < first || cell >= last) continue;
        const float light = luminance.data()[i];
        total[cell] += 1.0f, total[places + cell] += light;
        bright.data()[i] = light > threshold || lit[cell];
        found += bright.data()[i];
    }
    return found;
}

// `VoxelRecord.add`: adds samples to sums `[2, cells]`, in the order of the batches. Returns the number of samples that voxels add.
// lit: cells that have voxels.
size_t add_hits(FloatsOut sums, const std::vector<HitBatch>& batches, const Out<const bool>& lit, float threshold, int threads) {
    const size_t places = lit.size();
    check(sums, 2 * places, "sums");
    for (const auto& [cells, luminance, bright] : batches) {
        const size_t count = luminance.size();
        check(cells, count, "cells"), check(bright, count, "bright");
    }
    nb::gil_scoped_release released;
    float* const total = sums.data();
    std::atomic<size_t> found = 0;
    in_ranges(places, sample_count(batches), threads, [&](size_t first, size_t last) {
        for (const HitBatch& batch : batches) found += add_hit_batch(total, places, batch, lit.data(), threshold, first, last);
    });
    return found;
}

// Depths on either side of the focal plane, as in guiding/layered_record.py.
struct DepthLayers {
    double focus_distance;
    int per_octave, octaves;
    bool separate;

    // The layer of a depth, from near to far.
    double layer(double depth) const {
        const double defocus = 1.0 - focus_distance / depth, side = per_octave * octaves;
        const double place = std::floor(std::clamp(per_octave * (std::log2(std::abs(defocus)) + octaves - 2), 0.0, side - 1.0));
        return separate ? (defocus < 0.0 ? side - 1.0 - place : side + place) : 0.0;
    }
};

// Arrays of one batch of hits: cells, positions `[3, N]`, luminance, and whether voxels add the sample.
using VoxelBatch = std::tuple<Out<const int64_t>, Floats, Floats, Out<const bool>>;

// `VoxelRecord._rows`: fills the rows `[K, 6]` of the K samples that voxels add. layers: fields of `DepthLayers`.
void voxel_rows(const std::vector<VoxelBatch>& batches, std::tuple<double, int, int, bool> layers, Out<double> rows) {
    const auto& [focus_distance, per_octave, octaves, separate] = layers;
    const DepthLayers depths{focus_distance, per_octave, octaves, separate};
    const double cells_apart = 2.0 * per_octave * octaves;
    const size_t limit = rows.size() / 6;
    nb::gil_scoped_release released;
    size_t row = 0;
    for (const auto& [cells, points, luminance, bright] : batches) {
        const size_t count = luminance.size();
        check(cells, count, "cells"), check(points, 3 * count, "points"), check(bright, count, "bright");
        for (size_t i = 0; i < count; ++i) {
            if (!bright.data()[i]) continue;
            if (row == limit) throw std::invalid_argument("more bright samples than rows");
            const double light = luminance.data()[i], x = points.data()[i], y = points.data()[count + i], depth = points.data()[2 * count + i];
            const double values[6] = {cells.data()[i] * cells_apart + depths.layer(depth), 1.0, light, light * x / depth, light * y / depth, light / depth};
            std::copy_n(values, 6, rows.data() + 6 * row++);
        }
    }
}

// Arrays of one batch of draws: slots of emitters, and squares of contribution over expected contribution.
using DrawBatch = std::tuple<Ints, Floats>;

// `SuccessRates.add`: adds draws to sums `[2, slots]`, in the order of the batches.
void add_draws(Out<double> sums, const std::vector<DrawBatch>& batches, int threads) {
    const size_t slots = sums.size() / 2;
    check(sums, 2 * slots, "sums");
    for (const auto& [slot, squared] : batches) check(squared, slot.size(), "squared");
    nb::gil_scoped_release released;
    double* const total = sums.data();
    in_ranges(slots, sample_count(batches), threads, [&](size_t first, size_t last) {
        for (const auto& [slot, squared] : batches) {
            for (size_t i = 0; i < slot.size(); ++i) {
                const size_t place = size_t(slot.data()[i]);
                if (place >= first && place < last) total[place] += 1.0, total[slots + place] += squared.data()[i];
            }
        }
    });
}

// `ControlVariate.corrected`: corrects samples of pixels, null for consecutive ones from `first` on, and adds them to sums
// `[8, cells]`. coefficients: `[3, cells]`; bound: `[3, film pixels]`.
void correct_samples(Out<double> sums, const std::optional<Out<const int64_t>>& pixels, int64_t first, int width, int cell,
                     const Floats& radiance, const Floats& weight, const Floats& coefficients, const Floats& bound, Out<float> corrected) {
    const size_t count = weight.size(), cells = sums.size() / CONTROL_ROWS, film = bound.size() / 3;
    check(sums, CONTROL_ROWS * cells, "sums"), check(radiance, 3 * count, "radiance"), check(coefficients, 3 * cells, "coefficients");
    check(corrected, 3 * count, "corrected");
    if (pixels) check(*pixels, count, "pixels");
    nb::gil_scoped_release released;
    double* const total = sums.data();
    const int64_t across = (width + cell - 1) / cell;
    for (size_t i = 0; i < count; ++i) {
        const int64_t pixel = pixels ? pixels->data()[i] : first + int64_t(i);
        const size_t place = size_t(pixel / width / cell * across + pixel % width / cell);
        if (pixel < 0 || size_t(pixel) >= film || place >= cells) throw std::out_of_range("pixel outside the film");
        for (size_t channel = 0; channel < 3; ++channel) {
            const float most = bound.data()[channel * film + size_t(pixel)], slope = coefficients.data()[channel * cells + place];
            const float c = slope < -most ? -most : slope > most ? most : slope;
            corrected.data()[channel * count + i] = radiance.data()[channel * count + i] - c * (weight.data()[i] - 1.0f);
        }
        const double w = weight.data()[i], color[3] = {radiance.data()[i], radiance.data()[count + i], radiance.data()[2 * count + i]};
        const double light = 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2];
        if (!std::isfinite(w + light)) continue;
        const double rows[CONTROL_ROWS] = {1.0, w, w * w, w * light, light * light, color[0], color[1], color[2]};
        for (int row = 0; row < CONTROL_ROWS; ++row) total[row * cells + place] += rows[row];
    }
}

// The tensors of `Coverage.sums`, rows of `pixels` each. passed is null except with `RatioFeatures`, moments and center are null
// except with `ControlVariateFeatures`.
struct CoverageSums {
    size_t slots, pixels;
    int32_t* numbers;
    double *features, *passed;
    float *moments, *center;

    // The slot of an object at a pixel, -1 for none. A pixel fills its slots in order.
    int find(int32_t number, size_t pixel) const {
        for (size_t slot = 0; slot < slots && numbers[slot * pixels + pixel] > 0; ++slot) {
            if (numbers[slot * pixels + pixel] == number) return int(slot);
        }
        return -1;
    }
    bool full(size_t pixel) const { return numbers[(slots - 1) * pixels + pixel] > 0; }
    // `Coverage._least`, and the new object in this slot.
    int insert(int32_t number, size_t pixel) const {
        size_t least = 0;
        for (size_t slot = 0; slot < slots; ++slot) {
            const size_t place = slot * pixels + pixel;
            if (numbers[place] == 0) {
                least = slot;
                break;
            }
            if (features[place] < features[least * pixels + pixel]) least = slot;
        }
        const size_t place = least * pixels + pixel;
        numbers[place] = number, features[place] = 0.0;
        if (moments != nullptr) moments[place + pixels] = center[place] = 0.0f;
        return int(least);
    }
    // `MeanFeatures.add` and its other forms, for a sample in one slot, or in none.
    void add(int slot, size_t pixel, float weight, float kept, bool recenter) const {
        if (moments == nullptr) {
            const float factor = passed == nullptr ? kept : weight * kept;
            if (slot >= 0) features[size_t(slot) * pixels + pixel] += factor;
            if (passed != nullptr) passed[pixel] += factor;
            return;
        }
        const float total = moments[pixel], square = weight * weight;
        for (size_t each = 0; each < slots && numbers[each * pixels + pixel] > 0; ++each) {
            const size_t place = each * pixels + pixel;
            float& moment = moments[place + pixels];
            if (recenter) center[place] = moment / (total > 1e-30f ? total : 1e-30f);
            const float start = center[place], end = int(each) == slot ? 1.0f : 0.0f, difference = end - start;
            features[place] += (weight < 0.5f ? start + weight * difference : end - difference * (1.0f - weight)) * kept;
            moment += end * square;
        }
        moments[pixel] = total + square;
    }
};

CoverageSums coverage_sums(const nb::dict& arrays) {
    CoverageSums sums{};
    const auto numbers = nb::cast<IntsOut>(arrays["objects"], false);
    sums.slots = numbers.shape(0), sums.pixels = numbers.shape(1), sums.numbers = numbers.data();
    const size_t size = numbers.size();
    sums.features = entry<Out<double>>(arrays, "features", size).data();
    if (arrays.contains("passed")) sums.passed = entry<Out<double>>(arrays, "passed", sums.pixels).data();
    if (arrays.contains("control")) {
        sums.moments = entry<FloatsOut>(arrays, "control", size + sums.pixels).data();
        sums.center = entry<FloatsOut>(arrays, "center", size).data();
    }
    return sums;
}

// `Coverage.add` of samples of pixels, null for consecutive ones from `first` on. objects: number of the object of each triangle.
void cover(const nb::dict& arrays, const Ints& objects, const std::optional<Out<const int64_t>>& pixels, int64_t first,
           const Ints& triangle, const Floats& weight, const Floats& kept, bool recenter) {
    const size_t count = triangle.size();
    check(weight, count, "weight"), check(kept, count, "kept");
    if (pixels) check(*pixels, count, "pixels");
    const CoverageSums sums = coverage_sums(arrays);
    nb::gil_scoped_release released;
    for (size_t i = 0; i < count; ++i) {
        const int64_t pixel = pixels ? pixels->data()[i] : first + int64_t(i);
        const int32_t hit = triangle.data()[i];
        if (pixel < 0 || size_t(pixel) >= sums.pixels || hit >= int64_t(objects.size())) throw std::out_of_range("no such pixel or triangle");
        int slot = -1;
        if (hit >= 0) {
            const int32_t number = objects.data()[hit];
            slot = sums.find(number, size_t(pixel));
            if (slot < 0 && (kept.data()[i] > 0.0f || !sums.full(size_t(pixel)))) slot = sums.insert(number, size_t(pixel));
        }
        sums.add(slot, size_t(pixel), weight.data()[i], kept.data()[i], recenter);
    }
}

}  // namespace

void bind_sums(nb::module_& m) {
    m.def("add_draws", &add_draws);
    m.def("add_hits", &add_hits);
    m.def("add_records", &add_records);
    m.def("pool_tiles", &pool_tiles);
    m.def("shrink_tiles", &shrink_tiles);
    m.def("voxel_rows", &voxel_rows);
    m.def("add_light_samples", &add_light_samples);
    m.def("add_mis_moments", &add_mis_moments);
    m.def("correct_samples", &correct_samples, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg(), nb::arg());
    m.def("cover", &cover, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}

}  // namespace bokehguide
