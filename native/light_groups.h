// Radiance by light groups: `GroupedLights.parts` of render/light_groups.py.

#pragma once

#include "lights.h"

namespace BOKEHGUIDE_ISA {

using bokehguide::LightGroups;

// Three rows of each group, from the column `first` on, among `each` rows `[columns]`.
struct GroupRows {
    float* rows;
    int64_t columns, first;
    int each;

    void add(int group, int32_t column, Vec3 light, int lane) const {
        float* const red = rows + each * group * columns + first + column;
        red[0] += light.x[lane], red[columns] += light.y[lane], red[2 * columns] += light.z[lane];
    }
    void add(int group, Int column, Vec3 light, Int lanes) const {
        for (int lane = 0; lane < LANES; ++lane) {
            if (lanes[lane]) add(group, column[lane], light, lane);
        }
    }
};

// Add light from infinity in unit directions to the rows of its groups: the shares of the groups in the radiance there.
inline void add_far_light(const Tables& t, const LightGroups& groups, const GroupRows& to, Int column, Vec3 light, Vec3 direction, Int active) {
    const MapDirection at = on_map(t, direction);
    const Vec3 map = t.map_texels == nullptr ? grey(all(0.0f)) : map_radiance(t, at), total = environment_radiance(t, at);
    for (int group = 0; group < groups.count; ++group) {
        Vec3 part = groups.far[0] == group ? map : grey(all(0.0f));
        bool lit = groups.far[0] == group && t.map_texels != nullptr;
        for (int number = 0; number < t.distant_count; ++number) {
            if (groups.far[1 + number] != group) continue;
            const DistantTable& sun = t.distant[number];
            part = part + Vec3{all(sun.radiance[0]), all(sun.radiance[1]), all(sun.radiance[2])} * contains(sun, direction), lit = true;
        }
        const auto share = [](Float one, Float of) { return of > all(0.0f) ? one / divisor(of) : all(0.0f); };
        if (lit) to.add(group, column, light * Vec3{share(part.x, total.x), share(part.y, total.y), share(part.z, total.z)}, active);
    }
}

// Add light from triangles, -1 for lights at infinity in unit directions, to the rows of its groups.
inline void add_to_groups(const Tables& t, const LightGroups& groups, const GroupRows& to, Int column, Vec3 light, Int triangle, Vec3 direction,
                          Int active) {
    active &= largest(light) > all(0.0f);
    const Int far = active & (triangle < 0);
    for (int lane = 0; lane < LANES; ++lane) {
        if (active[lane] && !far[lane]) to.add(groups.materials[t.triangles[triangle[lane]].material], column[lane], light, lane);
    }
    if (any(far)) add_far_light(t, groups, to, column, light, direction, far);
}

}  // namespace BOKEHGUIDE_ISA
