// Scenes for Embree, and the tables of whole scenes, as objects of the module.

#pragma once

#include <nanobind/stl/optional.h>

#include <cstring>
#include <optional>
#include <vector>

#include "arrays.h"
#include "embree.h"
#include "kernels.h"

namespace bokehguide {

extern void* device;  // Embree's; null before the library is loaded

const Kernels& kernels();  // of the instruction set in use

// Triangles that rays may meet; threads may call it side by side.
class Triangles {
  public:
    Triangles(const nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>& vertices,
              const nb::ndarray<const int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>& corners) {
        if (device == nullptr) throw std::runtime_error("Embree is not loaded");
        constexpr int INDEX = 0, VERTEX = 1, UINT3 = 0x5003, FLOAT3 = 0x9003, TRIANGLE = 0, ROBUST = 4;
        scene = embree.new_scene(device);
        embree.set_scene_flags(scene, ROBUST);
        void* geometry = embree.new_geometry(device, TRIANGLE);
        std::memcpy(embree.new_buffer(geometry, VERTEX, 0, FLOAT3, 12, vertices.shape(0)), vertices.data(), 4 * vertices.size());
        std::memcpy(embree.new_buffer(geometry, INDEX, 0, UINT3, 12, corners.shape(0)), corners.data(), 4 * corners.size());
        embree.commit_geometry(geometry);
        embree.attach_geometry(scene, geometry);
        embree.release_geometry(geometry);
        nb::gil_scoped_release released;
        embree.commit_scene(scene);
    }
    ~Triangles() { embree.release_scene(scene); }
    Triangles(const Triangles&) = delete;

    void nearest(const Floats& origin, const Floats& direction, const std::optional<Floats>& limits, IntsOut triangle,
                 FloatsOut found) const {
        const size_t count = triangle.size();
        check(origin, 3 * count, "origin"), check(direction, 3 * count, "direction"), check(found, 3 * count, "found");
        if (limits) check(*limits, count, "limits");
        nb::gil_scoped_release released;
        float* rows = found.data();
        kernels().nearest(scene, int64_t(count), origin.data(), direction.data(), limits ? limits->data() : nullptr, triangle.data(),
                          rows, rows + count, rows + 2 * count);
    }
    void visible(const Floats& origin, const Floats& direction, const Floats& limits, FloatsOut passes) const {
        const size_t count = passes.size();
        check(origin, 3 * count, "origin"), check(direction, 3 * count, "direction"), check(limits, count, "limits");
        nb::gil_scoped_release released;
        kernels().visible(scene, int64_t(count), origin.data(), direction.data(), limits.data(), passes.data());
    }

    void* scene;
};

// Arrays and numbers by name; the arrays stay alive as long as the object.
class Named {
  public:
    Named(nb::dict arrays, nb::dict numbers) : arrays_(arrays), numbers_(numbers) {}
    Named(const Named&) = delete;

  protected:
    template <class T> const T* array(const std::string& name, size_t* size = nullptr) {
        if (!arrays_.contains(name.c_str()) || nb::handle(arrays_[name.c_str()]).is_none()) {
            if (size) *size = 0;
            return nullptr;
        }
        auto found = nb::cast<Out<const T>>(arrays_[name.c_str()]);
        if (size) *size = found.size();
        kept_.push_back(nb::ndarray<>(found));
        return found.data();
    }
    double number(const char* name) { return nb::cast<double>(numbers_[name]); }
    bool is(const char* name) { return number(name) != 0.0; }
    // One more entry follows the last: loads of an entry read two. texels: what aliases stand for, null for themselves.
    const AliasEntry* alias_table(const std::string& name, std::vector<AliasEntry>& entries, const int32_t* texels = nullptr) {
        size_t count;
        const float* keep = array<float>(name + "_keep", &count);
        const int32_t* alias = array<int32_t>(name + "_alias");
        entries.resize(count + 1);
        for (size_t i = 0; i < count; ++i) entries[i] = {keep[i], texels == nullptr ? alias[i] : texels[alias[i]]};
        return count > 0 ? entries.data() : nullptr;
    }
    ClusterTable cluster_table(const char* name, int32_t levels, std::vector<float>& ends) {
        size_t size;
        ClusterTable table = {array<float>(name, &size), nullptr, levels, levels < LEVELS_IN_LINE ? levels : levels - LEVELS_IN_LINE};
        const size_t line = size_t(1) << (table.levels - table.coarse_levels);
        ends.clear();
        for (size_t last = line - 1; last < size; last += line) ends.push_back(table.cumulative[last]);
        ends.resize(ends.size() + FLOATS_IN_LINE, 1.0f);
        table.ends = ends.data();
        return table;
    }
    void forget_names() {
        arrays_.clear();
        numbers_.clear();
    }

  private:
    nb::dict arrays_, numbers_;
    std::vector<nb::ndarray<>> kept_;
};

// A scene's tables, by the names of `Tables`.
class Scene : Named {
  public:
    Scene(nb::dict arrays, nb::dict numbers, nb::object tracer, nb::object opaque, nb::object translucent)
        : Named(arrays, numbers), scenes_(nb::make_tuple(tracer, opaque, translucent)) {
        const auto scene = [](nb::handle triangles) { return triangles.is_none() ? nullptr : nb::cast<Triangles&>(triangles).scene; };
        t.tracer = scene(tracer), t.opaque = scene(opaque), t.translucent = scene(translucent);
        set_geometry(), set_materials(), set_textures(), set_lights(), set_environment();
        forget_names();
    }

    Tables t{};

  private:
    void set_geometry() {
        size_t size, count;
        const float* normals = array<float>("normals", &size);
        const int32_t* material = array<int32_t>("material", &count);
        const int32_t* emitter = array<int32_t>("emitter");
        t.triangle_count = int64_t(count);
        rows_.resize(count);
        for (size_t i = 0; i < count; ++i) {
            for (int row = 0; row < 12; ++row) (row < 3 ? rows_[i].geometric[row] : rows_[i].normals[row - 3]) = normals[row * count + i];
            rows_[i].material = material[i], rows_[i].emitter = emitter[i];
        }
        t.triangles = rows_.data();
        t.translucent_numbers = array<int64_t>("translucent_numbers");
        t.uvs = array<float>("uvs"), t.colors = array<float>("colors");
        t.vertices = array<float>("vertices"), t.corners = array<int32_t>("corners");
    }
    void set_materials() {
        size_t size;
        t.parameters = array<float>("parameters", &size);
        t.materials = int64_t(size / 9);
        t.emission = array<float>("emission"), t.specular_color = array<float>("specular_color");
        t.clearcoat = array<float>("clearcoat"), t.cones = array<float>("cones");
        t.coat_albedo = array<int32_t>("coat_albedo"), t.brushed_albedo = array<int32_t>("brushed_albedo");
        t.sheen = array<float>("sheen"), t.sheen_albedo = array<float>("sheen_albedo");
        t.anisotropy = array<float>("anisotropy"), t.diffuse_transmission = array<float>("diffuse_transmission");
        t.film = array<float>("film"), t.dispersion = array<float>("dispersion");
        t.single_scattering = array<float>("single_scattering");
        t.surface_rows = int32_t(number("surface_rows"));
        t.opacity = array<float>("opacity"), t.absorption = array<float>("absorption");
        t.emissive = array<int32_t>("emissive"), t.tinted = array<int32_t>("tinted");
        t.is_translucent = array<int32_t>("is_translucent");
        for (int slot = 0; slot < SLOTS; ++slot) {
            const std::string number = std::to_string(slot);
            t.numbers[slot] = array<int64_t>("numbers" + number);
            t.normal_scales[slot] = array<float>("normal_scales" + number);
            t.tangents[slot] = array<float>("tangents" + number);
        }
        t.tilts_coats = is("tilts_coats"), t.has_transmission = is("has_transmission"), t.plain_emission = is("plain_emission");
    }
    void set_textures() {
        size_t size;
        t.texels = reinterpret_cast<const uint16_t*>(array<int64_t>("texels"));
        t.texture_start = array<int64_t>("texture_start", &size);
        t.textures = int64_t(size);
        t.texture_sizes = array<int64_t>("texture_sizes"), t.texture_bounds = array<int64_t>("texture_bounds");
        t.texture_uv_set = array<int64_t>("texture_uv_set"), t.texture_transforms = array<float>("texture_transforms");
        t.texture_scales = array<float>("texture_scales");
        t.uv_sets = int64_t(number("uv_sets"));
    }
    void set_lights() {
        size_t count;
        const int64_t* triangles = array<int64_t>("emitter_triangles", &count);
        t.emitters = int64_t(count);
        t.has_far_power = is("has_far_power");
        if (count == 0) return;
        const float* rows = array<float>("emitter_rows");
        const int32_t* cluster = array<int32_t>("emitter_cluster");
        emitters_.resize(count);
        for (size_t i = 0; i < count; ++i) {
            float* fields = reinterpret_cast<float*>(&emitters_[i]);
            for (int row = 0; row < 14; ++row) fields[row] = rows[row * count + i];
            emitters_[i].triangle = int32_t(triangles[i]), emitters_[i].cluster = cluster[i];
        }
        t.emitter_rows = emitters_.data();
        t.within_table = alias_table("within", within_table_);
        t.within_start = array<int32_t>("within_start"), t.far_share = array<float>("far_share");
        t.clusters = cluster_table("cluster_cumulative", int32_t(number("cluster_levels")), cluster_ends_);
        const float* box = array<float>("grid_box");  // low, cells per metre, last cell, steps
        for (int axis = 0; axis < 3; ++axis) {
            t.grid_low[axis] = box[axis], t.grid_last[axis] = box[4 + axis], t.grid_step[axis] = int32_t(box[7 + axis]);
        }
        t.grid_scale = box[3];
    }
    void set_environment() {
        t.has_environment = is("has_environment"), t.visible_environment = is("visible_environment");
        t.map_texels = array<float>("map_texels");
        t.map_table = alias_table("map", map_table_);
        t.map_width = int32_t(number("map_width")), t.map_height = int32_t(number("map_height"));
        t.map_turn = float(number("map_turn")), t.map_share = float(number("map_share"));
        size_t size;
        const float* distant = array<float>("distant", &size);
        static_assert(sizeof(DistantTable) == 16 * sizeof(float), "one row of `distant`");
        t.distant = reinterpret_cast<const DistantTable*>(distant);
        t.distant_count = int32_t(size / 16);
        t.distant_edges = array<float>("distant_edges");
    }

    nb::tuple scenes_;
    std::vector<TriangleRow> rows_;
    std::vector<EmitterRow> emitters_;
    std::vector<AliasEntry> within_table_, map_table_;
    std::vector<float> cluster_ends_;
};

// The choice among clusters of lights, by the names of `ClusterLights`.
class NamedClusterLights : Named {
  public:
    NamedClusterLights(nb::dict arrays, nb::dict numbers) : Named(arrays, numbers) {
        std::memcpy(c.axes, array<float>("axes"), sizeof c.axes), std::memcpy(c.position, array<float>("position"), sizeof c.position);
        const auto real = [&](const char* name) { return float(number(name)); };
        const auto whole = [&](const char* name) { return int32_t(number(name)); };
        c.pixel_slope = real("pixel_slope"), c.half_width = real("half_width"), c.half_height = real("half_height");
        c.tile_size = real("tile_size"), c.last_column = real("across") - 1.0f, c.last_row = real("down") - 1.0f;
        c.across = whole("across"), c.clusters = whole("clusters"), c.light_candidates = whole("light_candidates");
        c.table = cluster_table("cumulative", whole("levels"), ends_);
        c.visibility = array<float>("visibility"), c.factor = array<float>("factor");
        c.first_step = whole("first_step"), c.bsdf_candidates = whole("bsdf_candidates");
        c.first_texels = whole("first_texels"), c.map_clusters = whole("map_clusters"), c.first_distant = whole("first_distant");
        c.texel_order = array<int32_t>("texel_order"), c.texel_start = array<int32_t>("texel_start");
        c.texel_table = alias_table("texel", texel_table_, c.texel_order), c.texel_cluster = array<uint8_t>("texel_cluster");
        c.cluster_scale = array<float>("cluster_scale");
        forget_names();
    }

    ClusterLights c{};

  private:
    std::vector<AliasEntry> texel_table_;
    std::vector<float> ends_;
};

}  // namespace bokehguide
