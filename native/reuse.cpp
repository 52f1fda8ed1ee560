// Views of primary hits by neighbouring pixels: the class `Views` of the module.

#include "reuse.h"

#include <vector>

#include "mixture.h"
#include "scene.h"

namespace bokehguide {

PathLight path_light(const Tables& t, const nb::dict& arrays, int64_t paths) {
    PathLight of{};
    of.hit_columns = int64_t(nb::cast<Ints>(arrays["paths"], false).size()), of.path_columns = int64_t(nb::cast<Out<const int64_t>>(arrays["owner"], false).size());
    of.path_count = paths;
    if (paths < 0 || paths > of.path_columns) throw std::invalid_argument("more paths than the record has entries");
    const auto rows = [&](const char* name, size_t size) { return entry<Floats>(arrays, name, size).data(); };
    const size_t columns = size_t(of.path_columns);
    of.surface = rows("surface", size_t(t.surface_rows) * size_t(of.hit_columns));
    of.light_direction = rows("light_direction", 3 * columns), of.scattered_direction = rows("scattered_direction", 3 * columns);
    of.paths = nb::cast<Ints>(arrays["paths"], false).data();
    return of;
}

namespace {

// The views of a batch. Each thread keeps the memory of its last one.
class Views {
  public:
    // arrays: samples by the names of `LensSamples`, and a record of hits by those of `SplitRecord`; numbers: of `LensCamera` and `PixelGroups`. pixels: null for consecutive ones.
    Views(const Scene& scene, nb::dict arrays, nb::dict numbers, const std::optional<Out<const int64_t>>& pixels) : arrays_(arrays), scene_(scene) {
        set_lens(numbers);
        const auto floats = [&](const char* name, size_t rows) { return entry<Floats>(arrays, name, rows * count()).data(); };
        samples_.count = int64_t(nb::cast<Ints>(arrays["triangle"], false).size());
        samples_.triangle = nb::cast<Ints>(arrays["triangle"], false).data();
        samples_.points = floats("points", 2), samples_.focus = floats("focus", 3), samples_.radiance = floats("radiance", 3);
        samples_.depth = floats("depth", 1), samples_.weight = floats("weight", 1);
        if (arrays.contains("record")) set_record(nb::cast<nb::dict>(arrays["record"]), int64_t(number(numbers, "hits")), int64_t(number(numbers, "paths")));
        groups_.first = int64_t(number(numbers, "first"));
        int64_t span = samples_.count;
        if (pixels) {
            check(*pixels, count(), "pixels");
            groups_.pixels = pixels->data();
            nb::gil_scoped_release released;
            for (size_t i = 0; i < count(); ++i) {
                if (groups_.pixels[i] < (i == 0 ? 0 : groups_.pixels[i - 1] + 1)) throw std::invalid_argument("pixels must ascend");
            }
            span = groups_.pixels[count() - 1] - groups_.pixels[0] + 1;
        }
        make_rows(span);
        nb::gil_scoped_release released;
        kernels().find_views(scene.t, lens_, groups_, samples_, record_, float(min_spread_), views_);
    }
    ~Views() { pool().swap(memory_); }
    Views(const Views&) = delete;

    int64_t size() const { return views_.count; }
    // Lens points `[2, J]`, viewers, and members of groups that the viewers are, `[J]`.
    void copy(FloatsOut points, IntsOut viewer, IntsOut member) const {
        const size_t views = size_t(views_.count);
        check(points, 2 * views, "points"), check(viewer, views, "viewer"), check(member, views, "member");
        std::memcpy(points.data(), views_.x, 4 * views), std::memcpy(points.data() + views, views_.y, 4 * views);
        std::memcpy(viewer.data(), views_.viewer, 4 * views), std::memcpy(member.data(), views_.member, 4 * views);
    }
    void set_passing(const Floats& passing) {
        check(passing, size_t(views_.count), "passing");
        std::memcpy(views_.passing, passing.data(), 4 * passing.size());
    }
    // Keeps the views that nothing blocks; returns the number of rays and seconds in Embree.
    nb::tuple trace() {
        double seconds = 0.0;
        int64_t rays;
        {
            nb::gil_scoped_release released;
            rays = kernels().trace_views(scene_.t, lens_, samples_, record_, views_, &seconds);
        }
        return nb::make_tuple(rays, seconds);
    }
    // Densities `[J]` of a mixture; transmission: W at the lens points, null for a disc.
    void densities(const Mixture& mixture, const std::optional<Floats>& transmission, FloatsOut density) const {
        check(density, size_t(views_.count), "density");
        if (transmission) check(*transmission, size_t(views_.count), "transmission");
        if (mixture.rows().pixels != samples_.count) throw std::invalid_argument("a mixture of other pixels");
        nb::gil_scoped_release released;
        mixture.evaluate({views_.count, views_.viewer, views_.x, views_.y, transmission ? transmission->data() : nullptr},
                         {nullptr, nullptr, density.data()});
    }
    // Radiance `[3, N]` and weights `[N]` of the pixels. density: of the viewers at the lens points, `[J]`; own: by the names of
    // `OwnSamples`; groups: by the names of `ReusedGroups`.
    void reuse(const Floats& density, const nb::dict& own, FloatsOut radiance, FloatsOut weight, const std::optional<nb::dict>& groups) const {
        check(density, size_t(views_.count), "density"), check(radiance, 3 * count(), "radiance"), check(weight, count(), "weight");
        const auto floats = [&](const char* name) { return entry<Floats>(own, name, count()).data(); };
        const auto maybe = [&](const char* name) { return own.contains(name) ? floats(name) : nullptr; };
        const OwnSamples samples = {floats("density"), maybe("passing"), maybe("transmittance"), lens_.passing};
        ReusedGroups by_group{};
        if (groups) by_group = reused_groups(*groups);
        nb::gil_scoped_release released;
        kernels().add_views(scene_.t, samples_, record_, views_, samples, density.data(), groups ? &by_group : nullptr, radiance.data(), weight.data());
    }

  private:
    nb::dict arrays_;  // stay alive as long as the views
    std::unique_ptr<float[]> incident_;
    std::vector<int32_t> first_path_;
    const Scene& scene_;
    LensCamera lens_{};
    LensSamples samples_{};
    HitRecord record_{};
    PixelGroups groups_{};
    ViewRows views_{};
    double min_spread_ = 0.0;
    std::vector<float> memory_;

    static std::vector<float>& pool() {
        static thread_local std::vector<float> kept;
        return kept;
    }
    static double number(const nb::dict& numbers, const char* name) { return nb::cast<double>(numbers[name]); }
    size_t count() const { return size_t(samples_.count); }

    ReusedGroups reused_groups(const nb::dict& arrays) const {
        ReusedGroups groups{};
        const size_t values = nb::cast<FloatsOut>(arrays["radiance"], false).size(), paths = size_t(record_.light.path_columns);
        groups.count = int32_t(values / (3 * count()));
        if (groups.count > MOST_LIGHT_GROUPS) throw std::invalid_argument("too many light groups");
        const Ints materials = entry<Ints>(arrays, "materials", size_t(scene_.t.materials));
        for (size_t i = 0; i < materials.size(); ++i) {
            if (materials.data()[i] < 0 || materials.data()[i] >= groups.count) throw std::invalid_argument("a light group beyond their number");
        }
        groups.materials = materials.data(), groups.own = entry<Floats>(arrays, "own", values).data();
        groups.radiance = entry<FloatsOut>(arrays, "radiance", 3 * size_t(groups.count) * count()).data();
        if (record_.count > 0) {
            groups.reflected = entry<Floats>(arrays, "reflected", 6 * paths * size_t(groups.count)).data();
        }
        return groups;
    }
    void set_lens(const nb::dict& numbers) {
        std::memcpy(lens_.camera.axes, entry<Floats>(arrays_, "axes", 9).data(), sizeof lens_.camera.axes);
        std::memcpy(lens_.camera.position, entry<Floats>(arrays_, "position", 3).data(), sizeof lens_.camera.position);
        lens_.radius = float(number(numbers, "radius")), lens_.squared_radius = float(number(numbers, "squared_radius"));
        lens_.passing = float(number(numbers, "passing")), lens_.focus_distance = float(number(numbers, "focus_distance"));
        lens_.pixel_slope = float(number(numbers, "pixel_slope")), min_spread_ = number(numbers, "min_spread");
        const auto whole = [&](const char* name) { return int32_t(number(numbers, name)); };
        groups_.width = whole("width"), groups_.below = whole("below");
        std::memcpy(groups_.right, entry<Ints>(arrays_, "right", ROWS_PER_BAND).data(), sizeof groups_.right);
        const Ints offsets = nb::cast<Ints>(arrays_["offsets"], false);
        groups_.members = int32_t(offsets.size() / 2);
        if (offsets.size() < 2 || offsets.size() > 2 * MOST_MEMBERS) throw std::invalid_argument("groups of at most 64 pixels");
        for (int member = 0; member < groups_.members; ++member) {
            groups_.across[member] = offsets.data()[2 * member], groups_.down[member] = offsets.data()[2 * member + 1];
        }
    }
    void set_record(const nb::dict& record, int64_t hits, int64_t paths) {
        record_.light = path_light(scene_.t, record, paths);
        const size_t values = 6 * size_t(record_.light.path_columns);
        incident_.reset(new float[values]), record_.light.incident = incident_.get();
        const float* const reflected = entry<Floats>(record, "reflected", values).data();
        record_.light.bsdf = entry<Floats>(record, "bsdf", values).data();
        const size_t columns = size_t(record_.light.hit_columns);
        if (hits < 0 || size_t(hits) > columns) throw std::invalid_argument("more hits than the record has entries");
        record_.count = hits;
        record_.ray = entry<Ints>(record, "ray", columns).data(), record_.triangle = entry<Ints>(record, "triangle", columns).data();
        const auto floats = [&](const char* name, size_t rows) { return entry<Floats>(record, name, rows * columns).data(); };
        record_.distance = floats("distance", 1), record_.u = floats("u", 1), record_.v = floats("v", 1);
        record_.emission = floats("emission", 3);
        nb::gil_scoped_release released;
        first_path_.resize(size_t(hits)), record_.light.first_path = first_path_.data();
        int32_t path = 0;
        for (int64_t hit = 0; hit < hits; ++hit) {
            if (record_.ray[hit] < 0 || size_t(record_.ray[hit]) >= count()) throw std::invalid_argument("a ray beyond the batch");
            first_path_[size_t(hit)] = path, path += record_.light.paths[hit];
        }
        if (path > paths) throw std::invalid_argument("more paths of hits than paths");
        kernels().incident_light(record_.light, reflected, incident_.get());
    }
    // span: of the numbers of pixels from the first to the last.
    void make_rows(int64_t span) {
        ViewRows& v = views_;
        v.members = groups_.members;
        v.pixels = whole_vectors(samples_.count), v.columns = samples_.count * (v.members - 1) + MOST_LANES;
        v.numbers = int32_t(span);
        const size_t needed = 10 * size_t(v.columns) + 11 * size_t(v.pixels) + (groups_.pixels ? size_t(span) : 0);
        memory_.swap(pool());
        if (memory_.size() < needed) memory_.resize(needed);
        float* place = memory_.data();
        const auto floats = [&](int64_t size) { place += size; return place - size; };
        const auto whole = [&](int64_t size) { return reinterpret_cast<int32_t*>(floats(size)); };
        v.source = whole(v.columns), v.viewer = whole(v.columns), v.member = whole(v.columns);
        v.x = floats(v.columns), v.y = floats(v.columns), v.jacobian = floats(v.columns), v.passing = floats(v.columns);
        v.outgoing = floats(3 * v.columns);
        v.place = whole(v.pixels), v.column = whole(v.pixels), v.line = whole(v.pixels), v.number = whole(v.pixels);
        v.reusable = floats(v.pixels), v.depth = floats(v.pixels), v.plane = floats(3 * v.pixels), v.scale = floats(v.pixels);
        v.among = groups_.pixels ? whole(span) : nullptr;
    }
};

}  // namespace

void bind_reuse(nb::module_& m) {
    nb::class_<Views>(m, "Views")
        .def(nb::init<const Scene&, nb::dict, nb::dict, const std::optional<Out<const int64_t>>&>(), nb::keep_alive<1, 2>(), nb::arg(), nb::arg(),
             nb::arg(), nb::arg().none())
        .def("__len__", &Views::size)
        .def("copy", &Views::copy)
        .def("set_passing", &Views::set_passing)
        .def("trace", &Views::trace)
        .def("densities", &Views::densities, nb::arg(), nb::arg().none(), nb::arg())
        .def("reuse", &Views::reuse, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none());
}

}  // namespace bokehguide
