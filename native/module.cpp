// The Python module `bokehguide._native`: scenes for Embree and whole scenes, on the arrays of PyTorch's tensors.

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <atomic>
#include <chrono>

#if defined(_WIN32)
#include <windows.h>
#else
#include <dlfcn.h>
#endif

#include "bindings.h"
#include "mixture.h"
#include "reuse.h"
#include "scene.h"

namespace bokehguide {

Embree embree;
void* device = nullptr;

double seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

namespace {

struct Core {
    const char* name;
    const Kernels* kernels;
};

// The cores that the processor can run, the fastest last. All have the same bits.
std::vector<Core> find_cores() {
    std::vector<Core> found = {{"baseline", &baseline::kernels}};
#if defined(BOKEHGUIDE_X86)
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
    const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq");
    if (avx2) found.push_back({"avx2", &avx2::kernels});
    if (avx512) found.push_back({"avx512", &avx512::kernels});
#endif
    return found;
}

const std::vector<Core> cores = find_cores();
std::atomic<const Kernels*> chosen{cores.back().kernels};

std::vector<std::string> instruction_sets() {
    std::vector<std::string> names;
    for (const Core& core : cores) names.push_back(core.name);
    return names;
}

void use_instruction_set(const std::string& name) {
    for (const Core& core : cores) {
        if (name == core.name) return void(chosen = core.kernels);
    }
    throw std::invalid_argument("the processor has no instruction set " + name);
}

}  // namespace

const Kernels& kernels() { return *chosen; }

namespace {

// ------------------------------------------------------------------------------------------------------------- Embree

void* symbol(void* library, const char* name) {
#if defined(_WIN32)
    void* found = reinterpret_cast<void*>(GetProcAddress(static_cast<HMODULE>(library), name));
#else
    void* found = dlsym(library, name);
#endif
    if (found == nullptr) throw std::runtime_error(std::string("Embree lacks ") + name);
    return found;
}

template <class Function> void bind(void* library, const char* name, Function& function) {
    function = reinterpret_cast<Function>(symbol(library, name));
}

// Version of the Embree library in a file, major · 10000 + minor · 100 + patch, which serves all scenes from now on.
long load_embree(const std::string& path) {
#if defined(_WIN32)
    void* library = LoadLibraryA(path.c_str());
#else
    void* library = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
#endif
    if (library == nullptr) throw std::runtime_error("Embree cannot be loaded from " + path);
    bind(library, "rtcNewDevice", embree.new_device), bind(library, "rtcGetDeviceProperty", embree.device_property);
    bind(library, "rtcNewScene", embree.new_scene), bind(library, "rtcSetSceneFlags", embree.set_scene_flags);
    bind(library, "rtcNewGeometry", embree.new_geometry), bind(library, "rtcSetNewGeometryBuffer", embree.new_buffer);
    bind(library, "rtcCommitGeometry", embree.commit_geometry), bind(library, "rtcAttachGeometry", embree.attach_geometry);
    bind(library, "rtcReleaseGeometry", embree.release_geometry), bind(library, "rtcCommitScene", embree.commit_scene);
    bind(library, "rtcReleaseScene", embree.release_scene);
    bind(library, "rtcIntersect1", embree.intersect1), bind(library, "rtcOccluded1", embree.occluded1);
    bind(library, "rtcOccluded8", embree.occluded8);
    if (device == nullptr) device = embree.new_device(nullptr);
    if (device == nullptr) throw std::runtime_error("Embree has no device");
    return embree.device_property(device, 0);
}

// The arrays of a record of split paths, by the names of `SplitRecord`.
SplitRecord split_record(const nb::dict& arrays, size_t surface_rows, size_t rays, bool with_lights) {
    SplitRecord record{};
    const size_t paths = nb::cast<Out<int64_t>>(arrays["owner"], false).size();
    const auto of_hits = [&](const char* name, size_t rows) { return entry<FloatsOut>(arrays, name, rows * rays).data(); };
    const auto of_paths = [&](const char* name, size_t rows) { return entry<FloatsOut>(arrays, name, rows * paths).data(); };
    const auto whole = [&](const char* name, size_t size) { return entry<IntsOut>(arrays, name, size).data(); };
    record.hit_columns = int64_t(rays), record.path_columns = int64_t(paths);
    record.counts = of_hits("counts", 1), record.ray = whole("ray", rays), record.triangle = whole("triangle", rays);
    record.paths = whole("paths", rays), record.owner = nb::cast<Out<int64_t>>(arrays["owner"], false).data();
    record.distance = of_hits("distance", 1), record.u = of_hits("u", 1), record.v = of_hits("v", 1);
    record.surface = of_hits("surface", surface_rows), record.emission = of_hits("emission", 3);
    record.light_direction = of_paths("light_direction", 3), record.scattered_direction = of_paths("scattered_direction", 3);
    record.direct = of_paths("reflected", 6), record.indirect = record.direct + 3 * paths, record.bsdf = of_paths("bsdf", 6);
    if (with_lights) {
        record.light_row = whole("light_row", paths), record.light_cluster = whole("light_cluster", paths);
        record.light_rms = of_paths("light_rms", 1), record.light_visibility = of_paths("light_visibility", 1);
        record.light_difference = of_paths("light_difference", 1);
    }
    return record;
}

// The light groups of a trace by the names of `LightGroups`.
LightGroups light_groups(const nb::dict& arrays, const Tables& t, size_t rays, size_t paths) {
    LightGroups groups{};
    const size_t values = nb::cast<FloatsOut>(arrays["rays"], false).size();
    if (rays == 0 || values % (3 * rays) != 0) throw std::invalid_argument("rows of light groups");
    groups.count = int32_t(values / (3 * rays)), groups.rays = entry<FloatsOut>(arrays, "rays", values).data();
    const auto whole = [&](const char* name, size_t size) {
        const Ints found = entry<Ints>(arrays, name, size);
        for (size_t i = 0; i < size; ++i) {
            if (found.data()[i] < 0 || found.data()[i] >= groups.count) throw std::invalid_argument("a light group beyond their number");
        }
        return found.data();
    };
    groups.materials = whole("materials", size_t(t.materials)), groups.far = whole("far", 1 + size_t(t.distant_count));
    if (arrays.contains("reflected")) groups.reflected = entry<FloatsOut>(arrays, "reflected", 6 * paths * size_t(groups.count)).data();
    return groups;
}

// Traces rays into `rows` `[14, N]` and `triangle`. With a `split` record, paths split; `lights` and `images` `[3, N]` need one.
// Returns the number of rays, seconds in Embree, and the numbers of recorded hits and paths.
nb::tuple trace(const Scene& scene, const Floats& origin, const Floats& direction, const std::optional<Floats>& alive,
                const Ints& pixel_keys, const Random& random, int max_depth, FloatsOut rows, IntsOut triangle,
                const std::optional<nb::dict>& split, const NamedClusterLights* lights, const std::optional<FloatsOut>& images,
                const std::optional<nb::dict>& groups, const std::optional<Floats>& shadow_threshold) {
    const size_t count = pixel_keys.size();
    check(origin, 3 * count, "origin"), check(direction, 3 * count, "direction"), check(rows, 14 * count, "rows");
    check(triangle, count, "triangle");
    if (alive) check(*alive, count, "alive");
    if (images) check(*images, 3 * count, "images");
    if (shadow_threshold) check(*shadow_threshold, count, "shadow_threshold");
    if (!split && (lights != nullptr || images)) throw std::invalid_argument("cluster lights and images need a record of splits");
    Trace arguments{};
    SplitRecord record{};
    if (split) record = split_record(*split, size_t(scene.t.surface_rows), count, lights != nullptr), arguments.split = &record;
    arguments.count = int64_t(count);
    arguments.origin = origin.data(), arguments.direction = direction.data(), arguments.alive = alive ? alive->data() : nullptr;
    arguments.pixel_keys = pixel_keys.data(), arguments.random = random, arguments.max_depth = max_depth;
    arguments.first_step = lights ? lights->c.first_step : 1;
    arguments.lights = lights ? &lights->c : nullptr;
    if (images) arguments.images = const_cast<float*>(images->data());
    arguments.shadow_threshold = shadow_threshold ? shadow_threshold->data() : nullptr;
    LightGroups by_group{};
    if (groups && count > 0) by_group = light_groups(*groups, scene.t, count, size_t(record.path_columns)), arguments.groups = &by_group;
    if (split && groups && count > 0 && by_group.reflected == nullptr) throw std::invalid_argument("split paths need rows of light groups");
    float* row = rows.data();
    arguments.radiance = row, arguments.normal = row + 3 * count, arguments.albedo = row + 6 * count;
    arguments.emission = row + 9 * count, arguments.distance = row + 12 * count, arguments.alpha = row + 13 * count;
    arguments.triangle = triangle.data();
    {
        nb::gil_scoped_release released;
        kernels().trace(scene.t, arguments);
    }
    return nb::make_tuple(arguments.rays, arguments.embree_seconds, record.hit_count, record.path_count);
}

using Doubles = Out<double>;

// Adds samples to the sums of a film, both as dictionaries by the names of render/film.py. Returns whether all are finite.
bool expose(const nb::dict& sums, const nb::dict& samples, const std::optional<Out<const int64_t>>& pixels,
            int64_t first, bool recenter, Out<uint8_t> good) {
    const size_t count = good.size();
    FilmSums film{};
    film.pixels = int64_t(nb::cast<FloatsOut>(sums["count"]).size());
    const size_t size = size_t(film.pixels);
    if (pixels ? pixels->size() != count : first < 0 || size_t(first) + count > size) throw std::invalid_argument("pixels beyond the film");
    const auto doubles = [&](const char* name, size_t rows) { return entry<Doubles>(sums, name, rows * size).data(); };
    const auto floats = [&](const char* name, size_t rows) { return entry<FloatsOut>(sums, name, rows * size).data(); };
    const auto sample = [&](const char* name, size_t rows) { return entry<Floats>(samples, name, rows * count).data(); };
    film.radiance = doubles("radiance", 3), film.emission = doubles("emission", 3), film.square = doubles("square", 1);
    film.features = doubles("features", 9), film.count = floats("count", 1);
    film.nearest = floats("nearest", 1), film.farthest = floats("farthest", 1);
    if (sums.contains("passed")) film.passed = doubles("passed", 1);
    if (sums.contains("control")) film.moments = floats("control", 10), film.center = floats("center", 9);
    FilmSamples of{};
    of.count = int64_t(count);
    of.weight = sample("weight", 1), of.radiance = sample("radiance", 3), of.alpha = sample("alpha", 1), of.depth = sample("depth", 1);
    of.normal = sample("normal", 3), of.albedo = sample("albedo", 3), of.emission = sample("emission", 3);
    if (!nb::handle(samples["radiance_weight"]).is_none()) of.radiance_weight = sample("radiance_weight", 1);
    nb::gil_scoped_release released;
    return kernels().expose(film, of, pixels ? pixels->data() : nullptr, first, recenter, good.data());
}

}  // namespace
}  // namespace bokehguide

NB_MODULE(_native, m) {
    using namespace bokehguide;
    import_torch();
    nb::set_leak_warnings(false);  // scenes in caches of Python live until the process ends
    m.def("load_embree", &load_embree);
    m.attr("MOST_LANES") = MOST_LANES;
    m.def("instruction_sets", &instruction_sets);
    m.def("use_instruction_set", &use_instruction_set);
    nb::class_<Triangles>(m, "Triangles")
        .def(nb::init<const nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>&,
                      const nb::ndarray<const int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>&>())
        .def("nearest", &Triangles::nearest, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg())
        .def("visible", &Triangles::visible);
    nb::class_<Scene>(m, "Scene")
        .def(nb::init<nb::dict, nb::dict, nb::object, nb::object, nb::object>(), nb::arg(), nb::arg(), nb::arg().none(),
             nb::arg().none(), nb::arg().none())
        .def("trace", &trace, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg("split").none() = nb::none(), nb::arg("lights").none() = nb::none(), nb::arg("images").none() = nb::none(),
             nb::arg("groups").none() = nb::none(), nb::arg("shadow_threshold").none() = nb::none());
    bind_frame(m);
    bind_reports(m);
    bind_mixture(m);
    bind_reuse(m);
    bind_sums(m);
    nb::class_<NamedClusterLights>(m, "ClusterLights").def(nb::init<nb::dict, nb::dict>());
    m.def("expose", &expose, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg());
    // Stages of a trace, for tests.
    m.def("surfaces", [](const Scene& scene, const Floats& origin, const Floats& direction, const Ints& triangle, const Floats& hits,
                         FloatsOut rows) {
        check(rows, size_t(scene.t.surface_rows) * triangle.size(), "rows");
        kernels().surfaces(scene.t, int64_t(triangle.size()), origin.data(), direction.data(), triangle.data(), hits.data(), rows.data());
    });
    m.def("evaluate", [](const Scene& scene, const Floats& rows, const Floats& choice, const Floats& direction, FloatsOut out) {
        check(out, 4 * choice.size(), "out");
        kernels().evaluate(scene.t, int64_t(choice.size()), rows.data(), choice.data(), direction.data(), out.data());
    });
    m.def("sample", [](const Scene& scene, const Floats& rows, const Floats& choice, const Floats& uniforms, FloatsOut out) {
        check(out, 7 * choice.size(), "out");
        kernels().sample(scene.t, int64_t(choice.size()), rows.data(), choice.data(), uniforms.data(), out.data());
    });
    m.def("lights", [](const Scene& scene, const Floats& points, const Floats& uniforms, FloatsOut out) {
        check(out, 8 * (points.size() / 3), "out");
        kernels().lights(scene.t, int64_t(points.size() / 3), points.data(), uniforms.data(), out.data());
    });
    m.def("environment", [](const Scene& scene, const Floats& points, const Floats& direction, FloatsOut out) {
        check(out, 5 * (points.size() / 3), "out");
        kernels().environment(scene.t, int64_t(points.size() / 3), points.data(), direction.data(), out.data());
    });
    m.def("emitters", [](const Scene& scene, const Floats& points, const Floats& direction, const Ints& triangle, const Floats& hits,
                         FloatsOut out) {
        check(out, 8 * triangle.size(), "out");
        kernels().emitters(scene.t, int64_t(triangle.size()), points.data(), direction.data(), triangle.data(), hits.data(), out.data());
    });
}
