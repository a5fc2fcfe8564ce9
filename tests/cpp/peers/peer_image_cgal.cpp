// Image to mesh, ours beside CGAL's Mesh_3 on the same label image (two nested balls). Prints a table: tetrahedra,
// dihedral angles, volume per label against the exact one. Fails when ours loses a label, is out by more than
// the voxel image allows, or has a worse smallest angle than 5 degrees.
#include <CGAL/Exact_predicates_inexact_constructions_kernel.h>
#include <CGAL/Labeled_mesh_domain_3.h>
#include <CGAL/Mesh_complex_3_in_triangulation_3.h>
#include <CGAL/Mesh_criteria_3.h>
#include <CGAL/Mesh_triangulation_3.h>
#include <CGAL/make_mesh_3.h>

#include "peer_support.h"

typedef CGAL::Exact_predicates_inexact_constructions_kernel Kernel;
typedef CGAL::Labeled_mesh_domain_3<Kernel> Domain;
typedef CGAL::Mesh_triangulation_3<Domain>::type Triangulation;
typedef CGAL::Mesh_complex_3_in_triangulation_3<Triangulation> Complex;
typedef CGAL::Mesh_criteria_3<Triangulation> Criteria;

static const int SIZE = 40;
static const double CENTER = 19.6, OUTER = 15.0, INNER = 8.0;

static unsigned char labelAt(int i, int j, int k)
{
    const double x = i - CENTER, y = j - CENTER, z = k - CENTER, squared = x * x + y * y + z * z;
    return squared < INNER * INNER ? 2 : squared < OUTER * OUTER ? 1 : 0;
}

static Tetrahedra meshWithOurs()
{
    std::vector<unsigned char> voxels(SIZE * SIZE * SIZE);
    for (int k = 0; k < SIZE; ++k)
        for (int j = 0; j < SIZE; ++j)
            for (int i = 0; i < SIZE; ++i)
                voxels[i + SIZE * (j + SIZE * k)] = labelAt(i, j, k);
    mw_context* context = NULL;
    require(mw_context_create(1, &context));
    mw_image_desc description = mw_image_desc();
    description.struct_size = sizeof description;
    for (int axis = 0; axis < 3; ++axis) { description.dims[axis] = SIZE; description.spacing[axis] = 1.0; }
    description.data = voxels.data();
    description.type = MW_TYPE_U8;
    mw_image* image = NULL;
    require(mw_image_create(context, &description, &image));
    mw_job* job = NULL;
    require(mw_job_create(context, MW_JOB_IMAGE_TO_MESH, &job));
    require(mw_job_set_image(job, "labels", image));
    require(mw_job_set_f64(job, "lattice-spacing", 4.0));
    require(mw_job_run(job));
    mw_mesh* mesh = NULL;
    require(mw_job_take_mesh(job, &mesh));
    const Tetrahedra result = tetrahedraOf(mesh);
    mw_mesh_destroy(mesh);
    mw_job_destroy(job);
    mw_image_destroy(image);
    mw_context_destroy(context);
    return result;
}

static Tetrahedra meshWithCgal()
{
    const auto label = [](const Kernel::Point_3& p) {
        const int i = int(std::lround(p.x())), j = int(std::lround(p.y())), k = int(std::lround(p.z()));
        const bool isInside = i >= 0 && j >= 0 && k >= 0 && i < SIZE && j < SIZE && k < SIZE;
        return isInside ? int(labelAt(i, j, k)) : 0;
    };
    Domain domain(CGAL::parameters::function = label, CGAL::parameters::bounding_object = CGAL::Bbox_3(-1, -1, -1, SIZE, SIZE, SIZE),
                  CGAL::parameters::relative_error_bound = 1e-3);
    Criteria criteria(CGAL::parameters::facet_angle = 30, CGAL::parameters::facet_size = 2.5, CGAL::parameters::facet_distance = 0.5,
                      CGAL::parameters::cell_radius_edge_ratio = 2, CGAL::parameters::cell_size = 4);
    const Complex complex = CGAL::make_mesh_3<Complex>(domain, criteria);
    Tetrahedra result;
    for (auto cell = complex.cells_in_complex_begin(); cell != complex.cells_in_complex_end(); ++cell)
    {
        Tetrahedron tetrahedron;
        for (int v = 0; v < 4; ++v)
        {
            const auto& p = cell->vertex(v)->point();
            tetrahedron.point[v] = {{p.x(), p.y(), p.z()}};
        }
        tetrahedron.label = complex.subdomain_index(cell);
        result.push_back(tetrahedron);
    }
    return result;
}

int main()
{
    const double innerVolume = 4.0 / 3.0 * M_PI * std::pow(INNER, 3), outerVolume = 4.0 / 3.0 * M_PI * std::pow(OUTER, 3) - innerVolume;
    const Figures ours = figuresOf(meshWithOurs()), cgal = figuresOf(meshWithCgal());
    printTable("nested balls", ours, "CGAL Mesh_3", cgal);
    bool isGood = true;
    const double exact[] = {outerVolume, innerVolume};
    for (int label = 1; label <= 2; ++label)
    {
        const double found = ours.volume.count(label) ? ours.volume.at(label) : 0.0;
        const double error = 100.0 * std::abs(found - exact[label - 1]) / exact[label - 1];
        std::printf("label %d: exact %.1f, ours %.1f (%.2f %%), CGAL %.1f\n", label, exact[label - 1], found, error,
                    cgal.volume.count(label) ? cgal.volume.at(label) : 0.0);
        isGood = isGood && error < 5.0;
    }
    isGood = isGood && ours.smallestDihedral > 5.0 && ours.smallestVolume > 0.0;
    std::printf("%s\n", isGood ? "agree" : "DISAGREE");
    return isGood ? 0 : 1;
}
