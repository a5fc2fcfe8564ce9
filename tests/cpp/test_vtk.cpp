// VTK reads what the library writes, and vtkMeshQuality agrees with its measures to 1e-9.
#include "support.hpp"

#include <vtkCellData.h>
#include <vtkCellIterator.h>
#include <vtkDataArray.h>
#include <vtkGenericCell.h>
#include <vtkMath.h>
#include <vtkMeshQuality.h>
#include <vtkNew.h>
#include <vtkSmartPointer.h>
#include <vtkUnstructuredGrid.h>
#include <vtkUnstructuredGridReader.h>
#include <vtkVersionMacros.h>
#include <vtkXMLUnstructuredGridReader.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <vector>

static std::string folder;

static vtkSmartPointer<vtkUnstructuredGrid> read(const std::string &path) {
    vtkSmartPointer<vtkUnstructuredGrid> grid = vtkSmartPointer<vtkUnstructuredGrid>::New();
    if (path.size() > 4 && path.substr(path.size() - 4) == ".vtu") {
        vtkNew<vtkXMLUnstructuredGridReader> reader;
        reader->SetFileName(path.c_str());
        reader->Update();
        grid->DeepCopy(reader->GetOutput());
    } else {
        vtkNew<vtkUnstructuredGridReader> reader;
        reader->SetFileName(path.c_str());
        reader->Update();
        grid->DeepCopy(reader->GetOutput());
    }
    return grid;
}

/// Volume cells of the file are those of the mesh, in order, with their labels and points.
static void compare(const mw::Mesh &mesh, vtkUnstructuredGrid *grid, double sign, const std::string &what) {
    const int before = failures;
    CHECK(static_cast<std::size_t>(grid->GetNumberOfPoints()) == mesh.point_count());
    vtkDataArray *labels = grid->GetCellData()->GetArray("labels");
    if (!labels) labels = grid->GetCellData()->GetArray("label");
    CHECK(labels != nullptr);
    if (failures > before) {
        std::fprintf(stderr, "in %s\n", what.c_str());
        return;
    }
    double worst = 0.0;
    for (std::size_t i = 0; i < mesh.point_count(); ++i) {
        const double *point = grid->GetPoint(static_cast<vtkIdType>(i));
        worst = std::max(worst, std::fabs(point[0] - sign * mesh.points()[3 * i]));
        worst = std::max(worst, std::fabs(point[1] - sign * mesh.points()[3 * i + 1]));
        worst = std::max(worst, std::fabs(point[2] - mesh.points()[3 * i + 2]));
    }
    CHECK(worst <= 1e-12);
    std::size_t cell = 0, wrong = 0;
    vtkNew<vtkGenericCell> generic;
    for (vtkIdType id = 0; id < grid->GetNumberOfCells(); ++id) {
        if (grid->GetCellType(id) < 10) continue; // surface triangles, where the format carries them
        grid->GetCell(id, generic);
        if (cell >= mesh.cell_count() || grid->GetCellType(id) != mesh.cell_types()[cell]) {
            ++wrong;
            continue;
        }
        const std::int64_t begin = mesh.offsets()[cell];
        for (vtkIdType node = 0; node < generic->GetNumberOfPoints(); ++node)
            wrong += generic->GetPointId(node) != mesh.connectivity()[begin + node];
        wrong += static_cast<int>(labels->GetTuple1(id)) != mesh.labels()[cell];
        ++cell;
    }
    CHECK(wrong == 0 && cell == mesh.cell_count());
    if (failures > before) std::fprintf(stderr, "in %s\n", what.c_str());
}

static void formats(const mw::Mesh &mesh) {
    const char *settings[][2] = {
        {"a.vtu", ""}, {"b.vtu", "encoding=ascii"}, {"c.vtu", "compression=zlib"}, {"d.vtu", "surfaces=omit"},
        {"e.vtk", "format=vtk42"}, {"f.vtk", "format=vtk42;encoding=ascii"}, {"g.vtk", "format=vtk51"},
        {"h.vtk", "format=vtk51;encoding=ascii"}, {"i.vtk", ""}};
    for (const auto &setting : settings) {
        const std::string path = folder + "/" + setting[0];
        mesh.write(path, setting[1]);
        compare(mesh, read(path), 1.0, setting[1]);
    }
    mesh.write(folder + "/ras.vtu", "space=ras");
    compare(mesh, read(folder + "/ras.vtu"), -1.0, "space=ras");
}

/// Every format that the library reads itself brings the same cells back.
static void round_trips(const mw::Context &context, const mw::Mesh &mesh) {
    for (const char *name : {"r.vtu", "r.vtk", "r.msh", "r.mesh", "r.meshb"}) {
        const std::string path = folder + "/" + name;
        mesh.write(path);
        const mw::Mesh back = mw::Mesh::read(context, path);
        CHECK(back.cell_count() == mesh.cell_count() && back.point_count() == mesh.point_count());
        // Gmsh files group the elements by label, so their order differs.
        const bool same = std::strstr(name, ".msh") || hash_of(back) == hash_of(mesh);
        CHECK(same);
        if (!same) std::fprintf(stderr, "in %s\n", name);
    }
}

/// The dihedral angles of a tet of VTK at its edges 01, 02, 03, 12, 13 and 23, degrees.
static std::array<double, 6> dihedral_angles(vtkCell *cell) {
    double point[4][3];
    for (int i = 0; i < 4; ++i) cell->GetPoints()->GetPoint(i, point[i]);
    const int edges[6][4] = {{0, 1, 2, 3}, {0, 2, 1, 3}, {0, 3, 1, 2}, {1, 2, 0, 3}, {1, 3, 0, 2}, {2, 3, 0, 1}};
    std::array<double, 6> angles;
    for (int edge = 0; edge < 6; ++edge) {
        double along[3], left[3], right[3], normals[2][3], cross[3];
        const int *corner = edges[edge];
        vtkMath::Subtract(point[corner[1]], point[corner[0]], along);
        vtkMath::Subtract(point[corner[2]], point[corner[0]], left);
        vtkMath::Subtract(point[corner[3]], point[corner[0]], right);
        vtkMath::Cross(along, left, normals[0]);
        vtkMath::Cross(along, right, normals[1]);
        vtkMath::Cross(normals[0], normals[1], cross);
        const double angle = std::atan2(vtkMath::Norm(cross), vtkMath::Dot(normals[0], normals[1]));
        angles[edge] = vtkMath::DegreesFromRadians(angle);
    }
    return angles;
}

/// What VTK's TetMinAngle gives for these angles. It takes the supplements of those at edges 02 and 13, because its normals
/// there point one inwards, one outwards (seen in VTK 9.1 and 9.6; another version may not).
static double min_angle_of_vtk(std::array<double, 6> angles) {
    for (int edge : {1, 4}) angles[edge] = 180.0 - angles[edge];
    return *std::min_element(angles.begin(), angles.end());
}

/// A tetrahedral mesh beside VTK's own figures of it: the worst value of each, and the largest difference over all elements.
static void quality(const mw::Mesh &mesh, const char *name) {
    mesh.write(folder + "/quality.vtu", "surfaces=omit");
    vtkSmartPointer<vtkUnstructuredGrid> grid = read(folder + "/quality.vtu");
    const char *figures[] = {"min_dihedral", "radius_ratio", "scaled_jacobian"};
    std::vector<double> ours[3];
    for (int f = 0; f < 3; ++f) ours[f] = mesh.quality(figures[f]);
    double worst_ours[3] = {180.0, 0.0, 1.0}, worst_theirs[3] = {180.0, 0.0, 1.0}, difference[4] = {0.0, 0.0, 0.0, 0.0};
    for (vtkIdType id = 0; id < grid->GetNumberOfCells(); ++id) {
        vtkCell *cell = grid->GetCell(id);
        // Our smallest angle is the smallest of the six; and these six are the ones that VTK takes its own from.
        const std::array<double, 6> angles = dihedral_angles(cell);
        const double theirs[] = {*std::min_element(angles.begin(), angles.end()), vtkMeshQuality::TetRadiusRatio(cell),
                                 vtkMeshQuality::TetScaledJacobian(cell)};
        difference[3] = std::max(difference[3], std::fabs(vtkMeshQuality::TetMinAngle(cell) - min_angle_of_vtk(angles)));
        for (int f = 0; f < 3; ++f) {
            const bool large_is_bad = f == 1;
            worst_ours[f] = large_is_bad ? std::max(worst_ours[f], ours[f][id]) : std::min(worst_ours[f], ours[f][id]);
            worst_theirs[f] = large_is_bad ? std::max(worst_theirs[f], theirs[f]) : std::min(worst_theirs[f], theirs[f]);
            difference[f] = std::max(difference[f], std::fabs(theirs[f] - ours[f][id]));
        }
    }
    std::printf("%s, %d tets: worst of   %14s %14s %14s\n", name, static_cast<int>(grid->GetNumberOfCells()), "Meshwright",
                "VTK " VTK_VERSION, "difference");
    for (int f = 0; f < 3; ++f)
        std::printf("  %-28s %14.9f %14.9f %14.2g\n", figures[f], worst_ours[f], worst_theirs[f], difference[f]);
    std::printf("  %-28s %44.2g\n", "VTK's angle from the same six", difference[3]);
    CHECK(grid->GetNumberOfCells() > 100);
    for (double largest : difference) CHECK(largest < 1e-9);
}

/// The surfaces around and between the labels of a mesh, meshed by the other engine.
static mw::Mesh mesh_of_surfaces(const mw::Context &context, const mw::Mesh &mesh) {
    const mw_boundary boundary = mesh.boundary();
    std::vector<std::int32_t> number(mesh.point_count(), -1), triangles;
    std::vector<double> points;
    for (std::int64_t corner = 0; corner < 3 * boundary.triangle_count; ++corner) {
        std::int32_t &vertex = number[boundary.triangles[corner]];
        if (vertex < 0) {
            vertex = static_cast<std::int32_t>(points.size() / 3);
            const double *point = mesh.points().data() + 3 * boundary.triangles[corner];
            points.insert(points.end(), point, point + 3);
        }
        triangles.push_back(vertex);
    }
    mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
    job.set("surface", mw::Surface(context, points, triangles));
    job.run();
    return job.mesh();
}

int main() {
    char name[] = "/tmp/meshwright-vtk-XXXXXX";
    if (!mkdtemp(name)) return 2;
    folder = name;
    try {
        const mw::Context context(2);
        mw::Job job = ball_job(context, 32, 4.0);
        job.run();
        const mw::Mesh mesh = job.mesh();
        formats(mesh);
        round_trips(context, mesh);
        quality(mesh, "image, smoothed");
        job.set("smoothing-iterations", 0);
        job.run();
        quality(job.mesh(), "image, unsmoothed");
        const mw::Mesh solid = mesh_of_surfaces(context, mesh);
        solid.check();
        quality(solid, "surfaces");
        compare(solid, read(folder + "/quality.vtu"), 1.0, "surfaces");
        job.set("mixed-elements", true);
        job.run();
        job.mesh().write(folder + "/mixed.vtk");
        compare(job.mesh(), read(folder + "/mixed.vtk"), 1.0, "mixed elements");
    } catch (const std::exception &error) {
        std::fprintf(stderr, "%s\n", error.what());
        ++failures;
    }
    const int removed = std::system(("rm -rf " + folder).c_str());
    return finish("test_vtk") || removed;
}
