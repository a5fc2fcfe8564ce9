// Surface to mesh, ours beside TetGen 1.5 on the same surface (a subdivided sphere inside a cube: two regions). Prints
// a table: tetrahedra, dihedral angles, volume. Fails when a volume differs, a surface triangle is missing, or ours
// leaves more points than TetGen does.
#include <tetgen.h>

#include <cstring>
#include <map>
#include <set>

#include "peer_support.h"

struct Surface
{
    std::vector<std::array<double, 3>> points;
    std::vector<std::array<int, 3>> triangles;
};

static int middleOf(Surface& surface, std::map<std::pair<int, int>, int>& known, int a, int b, double radius)
{
    const std::pair<int, int> edge(std::min(a, b), std::max(a, b));
    const auto found = known.find(edge);
    if (found != known.end()) return found->second;
    std::array<double, 3> point;
    double length = 0.0;
    for (int axis = 0; axis < 3; ++axis)
    {
        point[axis] = surface.points[a][axis] + surface.points[b][axis];
        length += point[axis] * point[axis];
    }
    for (int axis = 0; axis < 3; ++axis) point[axis] *= radius / std::sqrt(length);
    surface.points.push_back(point);
    return known[edge] = int(surface.points.size()) - 1;
}

static Surface sphereInCube(int rounds)
{
    Surface surface;
    const double radius = 1.0;
    surface.points = {{{radius, 0, 0}}, {{-radius, 0, 0}}, {{0, radius, 0}}, {{0, -radius, 0}}, {{0, 0, radius}}, {{0, 0, -radius}}};
    surface.triangles = {{{0, 2, 4}}, {{2, 1, 4}}, {{1, 3, 4}}, {{3, 0, 4}}, {{2, 0, 5}}, {{1, 2, 5}}, {{3, 1, 5}}, {{0, 3, 5}}};
    for (int round = 0; round < rounds; ++round)
    {
        std::map<std::pair<int, int>, int> known;
        std::vector<std::array<int, 3>> finer;
        for (const auto& t : surface.triangles)
        {
            const int ab = middleOf(surface, known, t[0], t[1], radius), bc = middleOf(surface, known, t[1], t[2], radius),
                      ca = middleOf(surface, known, t[2], t[0], radius);
            finer.insert(finer.end(), {{{t[0], ab, ca}}, {{ab, t[1], bc}}, {{ca, bc, t[2]}}, {{ab, bc, ca}}});
        }
        surface.triangles = finer;
    }
    const int base = int(surface.points.size());
    for (int corner = 0; corner < 8; ++corner)
        surface.points.push_back({{corner & 1 ? 2.0 : -2.0, corner & 2 ? 2.0 : -2.0, corner & 4 ? 2.0 : -2.0}});
    const int cube[12][3] = {{0, 2, 3}, {0, 3, 1}, {4, 5, 7}, {4, 7, 6}, {0, 1, 5}, {0, 5, 4}, {2, 6, 7}, {2, 7, 3}, {0, 4, 6}, {0, 6, 2}, {1, 3, 7}, {1, 7, 5}};
    for (const auto& t : cube) surface.triangles.push_back({{base + t[0], base + t[1], base + t[2]}});
    return surface;
}

static Tetrahedra meshWithOurs(const Surface& surface, int refine, int64_t* points, bool* keepsTriangles)
{
    std::vector<double> xyz;
    for (const auto& p : surface.points) xyz.insert(xyz.end(), p.begin(), p.end());
    std::vector<int32_t> triangles;
    for (const auto& t : surface.triangles) triangles.insert(triangles.end(), t.begin(), t.end());
    mw_context* context = NULL;
    require(mw_context_create(1, &context));
    mw_surface* input = NULL;
    require(mw_surface_create(context, int64_t(surface.points.size()), xyz.data(), int64_t(surface.triangles.size()), triangles.data(), NULL, &input));
    mw_job* job = NULL;
    require(mw_job_create(context, MW_JOB_SURFACE_TO_MESH, &job));
    require(mw_job_set_surface(job, "surface", input));
    require(mw_job_set_i64(job, "ref", refine));
    require(mw_job_run(job));
    mw_mesh* mesh = NULL;
    require(mw_job_take_mesh(job, &mesh));
    *points = mw_mesh_point_count(mesh);
    std::set<std::array<int32_t, 3>> faces;
    const int32_t* tets = mw_mesh_tets(mesh);
    for (int64_t t = 0; t < mw_mesh_cell_count(mesh); ++t)
        for (int skip = 0; skip < 4; ++skip)
        {
            std::array<int32_t, 3> face;
            for (int v = 0, n = 0; v < 4; ++v) if (v != skip) face[n++] = tets[4 * t + v];
            std::sort(face.begin(), face.end());
            faces.insert(face);
        }
    *keepsTriangles = true;
    for (auto triangle : surface.triangles)
    {
        std::sort(triangle.begin(), triangle.end());
        *keepsTriangles = *keepsTriangles && faces.count({{triangle[0], triangle[1], triangle[2]}}) == 1;
    }
    // The input points come first, bit for bit.
    *keepsTriangles = *keepsTriangles && std::memcmp(mw_mesh_points(mesh), xyz.data(), xyz.size() * sizeof(double)) == 0;
    const Tetrahedra result = tetrahedraOf(mesh);
    mw_mesh_destroy(mesh);
    mw_job_destroy(job);
    mw_surface_destroy(input);
    mw_context_destroy(context);
    return result;
}

static Tetrahedra meshWithTetgen(const Surface& surface, const char* options, int64_t* points)
{
    tetgenio input, output;
    input.numberofpoints = int(surface.points.size());
    input.pointlist = new double[3 * surface.points.size()];
    for (std::size_t i = 0; i < surface.points.size(); ++i) std::copy(surface.points[i].begin(), surface.points[i].end(), input.pointlist + 3 * i);
    input.numberoffacets = int(surface.triangles.size());
    input.facetlist = new tetgenio::facet[surface.triangles.size()];
    input.facetmarkerlist = new int[surface.triangles.size()]();
    for (std::size_t i = 0; i < surface.triangles.size(); ++i)
    {
        tetgenio::facet& facet = input.facetlist[i];
        tetgenio::init(&facet);
        facet.numberofpolygons = 1;
        facet.polygonlist = new tetgenio::polygon[1];
        tetgenio::init(&facet.polygonlist[0]);
        facet.polygonlist[0].numberofvertices = 3;
        facet.polygonlist[0].vertexlist = new int[3]{surface.triangles[i][0], surface.triangles[i][1], surface.triangles[i][2]};
    }
    tetrahedralize(const_cast<char*>(options), &input, &output);
    *points = output.numberofpoints;
    Tetrahedra result;
    for (int t = 0; t < output.numberoftetrahedra; ++t)
    {
        Tetrahedron tetrahedron;
        for (int v = 0; v < 4; ++v)
        {
            const double* p = output.pointlist + 3 * output.tetrahedronlist[4 * t + v];
            tetrahedron.point[v] = {{p[0], p[1], p[2]}};
        }
        tetrahedron.label = 1;
        result.push_back(tetrahedron);
    }
    return result;
}

int main()
{
    const Surface surface = sphereInCube(3);
    bool isGood = true;
    for (int refine = 0; refine <= 1; ++refine)
    {
        int64_t ourPoints = 0, peerPoints = 0;
        bool keepsTriangles = false;
        const Figures ours = figuresOf(meshWithOurs(surface, refine, &ourPoints, &keepsTriangles));
        const Figures peer = figuresOf(meshWithTetgen(surface, refine ? "pYq1.4Q" : "pYQ", &peerPoints));
        printTable(refine ? "sphere in a cube, refined" : "sphere in a cube, surface points only", ours, "TetGen 1.5", peer);
        const bool sameVolume = std::abs(ours.totalVolume() - peer.totalVolume()) < 1e-9 * peer.totalVolume();
        std::printf("points %lld, TetGen %lld; volume %s; surface %s\n", (long long)ourPoints, (long long)peerPoints, sameVolume ? "agrees" : "DIFFERS",
                    keepsTriangles ? "kept" : "CHANGED");
        isGood = isGood && sameVolume && keepsTriangles && ours.smallestVolume > 0.0 && (refine || ourPoints <= peerPoints);
    }
    return isGood ? 0 : 1;
}
