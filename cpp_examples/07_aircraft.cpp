// An aircraft in its far field, for flow solvers: the volume between both, small elements at the skin, in the formats
// of FUN3D (UGRID), SU2 and OpenFOAM. The test then runs OpenFOAM's checkMesh on the case.
//
//   07_aircraft [FOLDER [POINTS_PER_SECTION]]
#include <meshwright.hpp>

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <map>
#include <vector>

struct Shape {
    std::vector<double> points;
    std::vector<std::int32_t> triangles, patches;

    std::int32_t add_point(double x, double y, double z) {
        points.insert(points.end(), {x, y, z});
        return static_cast<std::int32_t>(points.size() / 3 - 1);
    }
    void add(std::int32_t a, std::int32_t b, std::int32_t c, std::int32_t patch) {
        triangles.insert(triangles.end(), {a, b, c});
        patches.push_back(patch);
    }
};

static const std::int32_t SKIN = 1, FAR_FIELD = 2;
static const double HALF_SPAN = 16.0; // metres

/// A blended wing-body: symmetric NACA sections along the span, long and thick at the body, short and thin at the tips.
/// Each section is a ring of `ring` points from the trailing edge over the top to the nose and back.
static void add_aircraft(Shape &shape, int ring) {
    const int stations = 4 * ring;
    const std::int32_t first = static_cast<std::int32_t>(shape.points.size() / 3);
    for (int s = 0; s <= stations; ++s) {
        const double y = HALF_SPAN * (2.0 * s / stations - 1.0), out = std::sqrt(y * y + 1.0) - 1.0;
        const double body = std::exp(-std::pow(y / 3.5, 2)), chord = 3.0 + 13.0 * body, thickness = 0.11 + 0.05 * body;
        for (int p = 0; p < ring; ++p) {
            const double angle = 2.0 * M_PI * p / ring, x = 0.5 * (1.0 + std::cos(angle));
            // NACA four-digit thickness with a closed trailing edge.
            const double half = 5.0 * thickness * (0.2969 * std::sqrt(x) - 0.126 * x - 0.3516 * x * x +
                                                   0.2843 * x * x * x - 0.1036 * x * x * x * x);
            const double side = p == 0 ? 0.0 : std::sin(angle) > 0.0 ? 1.0 : -1.0;
            shape.add_point(0.75 * out + chord * x, y, 0.08 * out + chord * half * side);
        }
    }
    const auto at = [=](int s, int p) { return first + s * ring + p % ring; };
    for (int s = 0; s < stations; ++s)
        for (int p = 0; p < ring; ++p) {
            shape.add(at(s, p), at(s, p + 1), at(s + 1, p + 1), SKIN);
            shape.add(at(s, p), at(s + 1, p + 1), at(s + 1, p), SKIN);
        }
    for (int s : {0, stations}) // flat tips: the points of the top with those of the bottom
        for (int p = 0; p < ring / 2; ++p) {
            const std::int32_t quad[] = {at(s, p), at(s, p + 1), at(s, ring - p - 1), at(s, ring - p)};
            const bool left = s == 0;
            if (p + 1 < ring / 2) shape.add(quad[0], quad[left ? 2 : 1], quad[left ? 1 : 2], SKIN);
            if (p > 0) shape.add(quad[0], quad[left ? 3 : 2], quad[left ? 2 : 3], SKIN);
        }
}

/// A box of `n` x `n` squares a side around the aircraft.
static void add_far_field(Shape &shape, double half, int n) {
    std::map<std::int64_t, std::int32_t> numbers;
    const auto vertex = [&](const int (&index)[3]) {
        const std::int64_t key = index[0] + (n + 1) * (index[1] + std::int64_t(n + 1) * index[2]);
        const auto known = numbers.find(key);
        if (known != numbers.end()) return known->second;
        const auto place = [&](int i) { return half * (2.0 * i / n - 1.0); };
        return numbers[key] = shape.add_point(place(index[0]), place(index[1]), place(index[2]));
    };
    for (int axis = 0; axis < 3; ++axis)
        for (int side : {0, n})
            for (int v = 0; v < n; ++v)
                for (int u = 0; u < n; ++u) {
                    const auto corner = [&](int du, int dv) {
                        int index[3];
                        index[axis] = side;
                        index[(axis + 1) % 3] = u + du;
                        index[(axis + 2) % 3] = v + dv;
                        return vertex(index);
                    };
                    const std::int32_t a = corner(0, 0), b = corner(1, 0), c = corner(1, 1), d = corner(0, 1);
                    shape.add(a, side ? b : c, side ? c : b, FAR_FIELD);
                    shape.add(a, side ? c : d, side ? d : c, FAR_FIELD);
                }
}

int main(int argc, char **argv) {
    const std::string folder = argc > 1 ? argv[1] : "07_aircraft_case";
    const int ring = argc > 2 ? std::atoi(argv[2]) : 16;
    if (ring < 6 || ring % 2) {
        std::cerr << "POINTS_PER_SECTION is an even number from 6\n";
        return 2;
    }
    try {
        Shape shape;
        add_aircraft(shape, ring);
        add_far_field(shape, 100.0, 8);
        const mw::Context context(0); // all cores
        mw::Surface surface(context, shape.points, shape.triangles, shape.patches);
        surface.set_patch(SKIN, "wall", "aircraft");
        surface.set_patch(FAR_FIELD, "farfield", "farfield");

        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", surface);
        job.set("domain", "nesting");  // every second nesting level is empty: the inside of the aircraft
        job.set("growth-rate", 1.3);   // elements may grow fast towards the far field
        job.run();
        const mw::Mesh mesh = job.mesh();
        mesh.check();

        // Every triangle of the skin is a face of the mesh, and nothing lies within.
        std::map<int, std::int64_t> given, found;
        for (std::int32_t patch : shape.patches) ++given[patch];
        const mw_boundary boundary = mesh.boundary();
        for (std::int64_t face = 0; boundary.patches && face < boundary.triangle_count; ++face)
            ++found[boundary.patches[face]];
        std::cout << mesh.point_count() << " points, " << mesh.cell_count() << " tetrahedra between " << found[SKIN]
                  << " triangles of the aircraft and " << found[FAR_FIELD] << " of the far field\n";
        if (given != found) return 1;

        mesh.write(folder + "/aircraft.foam"); // an OpenFOAM case; the other formats beside it
        mesh.write(folder + "/aircraft.lb8.ugrid");
        mesh.write(folder + "/aircraft.su2");
        return 0;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        for (const mw::Finding &finding : error.findings()) std::cerr << "  " << finding.text << '\n';
        return 1;
    }
}
