// Shared by the peer programs: figures of a list of tetrahedra, and the table that compares two.
#ifndef PEER_SUPPORT_H
#define PEER_SUPPORT_H

#include <meshwright.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <vector>

struct Tetrahedron
{
    std::array<std::array<double, 3>, 4> point;
    int label;
};

typedef std::vector<Tetrahedron> Tetrahedra;

struct Figures
{
    std::size_t count = 0;
    double smallestDihedral = 180.0, largestDihedral = 0.0, smallestVolume = 1e300;
    std::map<int, double> volume;

    double totalVolume() const
    {
        double sum = 0.0;
        for (const auto& entry : volume) sum += entry.second;
        return sum;
    }
};

inline void require(mw_status status)
{
    if (status < 0)
    {
        std::fprintf(stderr, "meshwright: %s\n", mw_last_error());
        std::exit(1);
    }
}

inline Tetrahedra tetrahedraOf(const mw_mesh* mesh)
{
    const double* points = mw_mesh_points(mesh);
    const int32_t* tets = mw_mesh_tets(mesh);
    const int32_t* labels = mw_mesh_labels(mesh);
    Tetrahedra result(std::size_t(mw_mesh_cell_count(mesh)));
    for (std::size_t t = 0; t < result.size(); ++t)
    {
        for (int v = 0; v < 4; ++v)
            std::copy(points + 3 * tets[4 * t + v], points + 3 * tets[4 * t + v] + 3, result[t].point[v].begin());
        result[t].label = labels[t];
    }
    return result;
}

inline std::array<double, 3> minus(const std::array<double, 3>& a, const std::array<double, 3>& b) { return {{a[0] - b[0], a[1] - b[1], a[2] - b[2]}}; }

inline std::array<double, 3> cross(const std::array<double, 3>& a, const std::array<double, 3>& b)
{
    return {{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}};
}

inline double dot(const std::array<double, 3>& a, const std::array<double, 3>& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline Figures figuresOf(const Tetrahedra& tetrahedra)
{
    static const int EDGES[6][4] = {{0, 1, 2, 3}, {0, 2, 3, 1}, {0, 3, 1, 2}, {1, 2, 0, 3}, {1, 3, 2, 0}, {2, 3, 0, 1}};
    Figures figures;
    figures.count = tetrahedra.size();
    for (const Tetrahedron& t : tetrahedra)
    {
        const double volume = dot(cross(minus(t.point[1], t.point[0]), minus(t.point[2], t.point[0])), minus(t.point[3], t.point[0])) / 6.0;
        figures.smallestVolume = std::min(figures.smallestVolume, volume);
        figures.volume[t.label] += volume;
        for (const auto& edge : EDGES)
        {
            const auto along = minus(t.point[edge[1]], t.point[edge[0]]);
            const auto left = cross(along, minus(t.point[edge[2]], t.point[edge[0]])), right = cross(along, minus(t.point[edge[3]], t.point[edge[0]]));
            const double cosine = dot(left, right) / std::sqrt(dot(left, left) * dot(right, right));
            const double angle = std::acos(std::max(-1.0, std::min(1.0, cosine))) * 180.0 / M_PI;
            figures.smallestDihedral = std::min(figures.smallestDihedral, angle);
            figures.largestDihedral = std::max(figures.largestDihedral, angle);
        }
    }
    return figures;
}

inline void printTable(const char* title, const Figures& ours, const char* peerName, const Figures& peer)
{
    std::printf("%-42s %12s %12s\n", title, "Meshwright", peerName);
    std::printf("%-42s %12zu %12zu\n", "tetrahedra", ours.count, peer.count);
    std::printf("%-42s %12.2f %12.2f\n", "smallest dihedral angle, degrees", ours.smallestDihedral, peer.smallestDihedral);
    std::printf("%-42s %12.2f %12.2f\n", "largest dihedral angle, degrees", ours.largestDihedral, peer.largestDihedral);
    std::printf("%-42s %12.6g %12.6g\n", "volume", ours.totalVolume(), peer.totalVolume());
}

#endif
