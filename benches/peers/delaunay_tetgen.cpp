// TetGen's Delaunay tetrahedralization of a file of raw doubles (x y z); one CSV row as benches/delaunay.rs prints.
// g++ -O3 -DTETLIBRARY delaunay_tetgen.cpp -ltet -o delaunay_tetgen && ./delaunay_tetgen points.f64
#include <cstdio>
#include <sys/resource.h>
#include <tetgen.h>
#include <vector>

static double cpu() {
    rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_utime.tv_sec + usage.ru_stime.tv_sec + 1e-6 * (usage.ru_utime.tv_usec + usage.ru_stime.tv_usec);
}

int main(int argc, char **argv) {
    std::vector<double> coordinates;
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : nullptr;
    double row[3];
    while (file && fread(row, sizeof row, 1, file) == 1) coordinates.insert(coordinates.end(), row, row + 3);
    tetgenio in, out;
    in.numberofpoints = (int)(coordinates.size() / 3);
    in.pointlist = new REAL[coordinates.size()];
    std::copy(coordinates.begin(), coordinates.end(), in.pointlist);
    char options[] = "Q";
    const double begin = cpu();
    tetrahedralize(options, &in, &out);
    const double seconds = cpu() - begin;
    rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    printf("tetgen,%s,1,%d,%d,%.2f,%.2f,%.0f,%ld\n", argv[1], in.numberofpoints, out.numberoftetrahedra, seconds,
           seconds, in.numberofpoints / seconds, usage.ru_maxrss >> 10);
    return 0;
}
