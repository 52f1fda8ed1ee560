// Pixels, their random numbers, lens points and rays, as functions of the module: the loops are in camera.h.

#include "bindings.h"

#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <tuple>

#include "scene.h"

namespace bokehguide {

namespace {

using Numbers = std::optional<Out<const int64_t>>;

// Keys of random numbers. directions: of Sobol' sequences, int32 `[8, 30]`.
Random random_of(uint32_t step_key, uint32_t seed_key, uint32_t index, uint32_t group) {
    if (group > MOST_MEMBERS) throw std::invalid_argument("groups of at most 64 pixels");
    static int32_t directions[8][30];
    static bool ready = false;
    if (!ready) {
        nb::list rows = nb::cast<nb::list>(nb::module_::import_("bokehguide.render.random").attr("_DIRECTIONS"));
        for (int row = 0; row < 8; ++row) {
            for (int bit = 0; bit < 30; ++bit) directions[row][bit] = nb::cast<int32_t>(rows[row][bit]);
        }
        ready = true;
    }
    return {step_key, seed_key, index, group, directions};
}

// first, numbers: of consecutive pixels, or of any pixels.
void pixel_keys(uint32_t seed, int64_t first, const Numbers& numbers, IntsOut keys) {
    if (numbers) check(*numbers, keys.size(), "pixels");
    nb::gil_scoped_release released;
    kernels().pixel_keys(seed, int64_t(keys.size()), {numbers ? numbers->data() : nullptr, first}, keys.data());
}

void random(const Random& random, const Ints& pixels, uint32_t dimension, int numbers, int first, int number, const std::optional<Ints>& member,
            const std::optional<Out<const bool>>& replaced, FloatsOut out) {
    check(out, size_t(numbers) * pixels.size(), "out");
    if (member) check(*member, pixels.size(), "member");
    if (replaced) check(*replaced, pixels.size(), "replaced");
    const uint8_t* flags = replaced ? reinterpret_cast<const uint8_t*>(replaced->data()) : nullptr;
    nb::gil_scoped_release released;
    kernels().random_numbers(random, int64_t(pixels.size()), pixels.data(), dimension, numbers, first, number, member ? member->data() : nullptr, flags,
                             out.data());
}

// Fields of `PixelGroups`, and the number of tiles across the film.
struct TilePattern {
    int32_t width, across, down, below, mask, tiles_across;
    const int32_t* right;

    // `PixelGroups.numbered` for one pixel.
    void number(int32_t pixel, int32_t& group, int32_t& member) const {
        const int32_t line = pixel / width, x = pixel - line * width, in_band = line % ROWS_PER_BAND;
        const int32_t column = x + right[in_band], row = in_band + below, place = (row & (down - 1)) * across + (column & (across - 1));
        const int32_t tile_rows = (ROWS_PER_BAND + below + down - 1) / down;
        const int32_t tile = (line / ROWS_PER_BAND * tile_rows + row / down) * tiles_across + column / across;
        int32_t selected = place & mask, parity = 0, highest = -1;
        for (; selected != 0; selected &= selected - 1) parity ^= 1;
        for (int32_t bits = mask; bits != 0; bits >>= 1) ++highest;
        group = 4 * tile + 2 * (x / COLUMNS_PER_BAND & 1) + parity;
        member = (place & ((1 << highest) - 1)) | place >> (highest + 1) << highest;
    }
};

// `PixelGroups.numbered`. lengths: width, across, down, below, mask and number of tiles across.
void number_groups(std::tuple<int, int, int, int, int, int> lengths, const Ints& right, int64_t first, const Numbers& numbers, IntsOut group,
                   IntsOut member) {
    const auto [width, across, down, below, mask, tiles_across] = lengths;
    if (std::min({width, across, down, mask}) < 1) throw std::invalid_argument("groups without pixels");
    check(right, ROWS_PER_BAND, "right"), check(member, group.size(), "member");
    if (numbers) check(*numbers, group.size(), "pixels");
    nb::gil_scoped_release released;
    const TilePattern pattern = {width, across, down, below, mask, tiles_across, right.data()};
    for (size_t i = 0; i < group.size(); ++i) {
        const int64_t pixel = numbers ? numbers->data()[i] : first + int64_t(i);
        pattern.number(int32_t(pixel), group.data()[i], member.data()[i]);
    }
}

// size: width and height of the frame; lengths: width of a pixel at unit distance, and the focus distance.
void film_positions(nb::tuple size, nb::tuple lengths, const Random& random, uint32_t dimension, int64_t first, const Numbers& numbers,
                    const Ints& keys, FloatsOut rows) {
    const size_t count = keys.size();
    check(rows, 7 * count, "rows");
    if (numbers) check(*numbers, count, "pixels");
    const double width = nb::cast<double>(size[0]), height = nb::cast<double>(size[1]);
    const FilmFrame frame = {int32_t(width), float(0.5 * width), float(0.5 * height), nb::cast<float>(lengths[0]), nb::cast<float>(lengths[1])};
    nb::gil_scoped_release released;
    kernels().film_positions(frame, random, dimension, int64_t(count), {numbers ? numbers->data() : nullptr, first}, keys.data(), rows.data());
}

void sample_disc(float radius, const Floats& uniforms, FloatsOut points) {
    check(uniforms, points.size(), "uniforms");
    nb::gil_scoped_release released;
    kernels().sample_disc(radius, int64_t(points.size() / 2), uniforms.data(), points.data());
}

Camera camera_of(const Floats& axes, const Floats* position) {
    check(axes, 9, "axes");
    Camera camera{};
    std::memcpy(camera.axes, axes.data(), sizeof camera.axes);
    if (position != nullptr) check(*position, 3, "position"), std::memcpy(camera.position, position->data(), sizeof camera.position);
    return camera;
}

void camera_rays(const Floats& axes, const Floats& position, const Floats& focus, const Floats& points, FloatsOut rows) {
    const size_t count = rows.size() / 6;
    check(focus, 3 * count, "focus"), check(points, 2 * count, "points");
    const Camera camera = camera_of(axes, &position);
    nb::gil_scoped_release released;
    kernels().camera_rays(camera, int64_t(count), focus.data(), points.data(), rows.data(), rows.data() + 3 * count);
}

void camera_depths(const Floats& axes, const Floats& distance, const Floats& directions, float miss, float none, FloatsOut depths) {
    const size_t count = depths.size();
    check(distance, count, "distance"), check(directions, 3 * count, "directions");
    const Camera camera = camera_of(axes, nullptr);
    nb::gil_scoped_release released;
    kernels().camera_depths(camera, int64_t(count), distance.data(), directions.data(), miss, none, depths.data());
}

}  // namespace

void bind_frame(nb::module_& m) {
    nb::class_<Random>(m, "Random").def("__init__", [](Random* self, uint32_t step_key, uint32_t seed_key, uint32_t index, uint32_t group) {
        new (self) Random(random_of(step_key, seed_key, index, group));
    });
    m.def("pixel_keys", &pixel_keys, nb::arg(), nb::arg(), nb::arg().none(), nb::arg());
    m.def("random", &random, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg());
    m.def("number_groups", &number_groups, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg());
    m.def("film_positions", &film_positions, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg());
    m.def("sample_disc", &sample_disc);
    m.def("camera_rays", &camera_rays);
    m.def("camera_depths", &camera_depths);
}

}  // namespace bokehguide
