// CGAL's Delaunay tetrahedralization of a file of raw doubles (x y z); one CSV row as benches/delaunay.rs prints.
// g++ -O3 -DNDEBUG delaunay_cgal.cpp -lgmp -lmpfr -o delaunay_cgal && ./delaunay_cgal points.f64
#include <CGAL/Delaunay_triangulation_3.h>
#include <CGAL/Exact_predicates_inexact_constructions_kernel.h>
#include <cstdio>
#include <sys/resource.h>
#include <vector>

typedef CGAL::Exact_predicates_inexact_constructions_kernel Kernel;

static double cpu() {
    rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_utime.tv_sec + usage.ru_stime.tv_sec + 1e-6 * (usage.ru_utime.tv_usec + usage.ru_stime.tv_usec);
}

int main(int argc, char **argv) {
    std::vector<Kernel::Point_3> points;
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : nullptr;
    double row[3];
    while (file && fread(row, sizeof row, 1, file) == 1) points.emplace_back(row[0], row[1], row[2]);
    const double begin = cpu();
    CGAL::Delaunay_triangulation_3<Kernel> mesh(points.begin(), points.end());
    const double seconds = cpu() - begin;
    rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    printf("cgal,%s,1,%zu,%zu,%.2f,%.2f,%.0f,%ld\n", argv[1], points.size(), (size_t)mesh.number_of_cells(), seconds,
           seconds, points.size() / seconds, usage.ru_maxrss >> 10);
    return 0;
}
