// What is wrong with a surface, and where: an open box that a spike pierces.
//
//   06_findings [SURFACE]
#include <meshwright.hpp>

#include <iostream>
#include <map>

static mw::Surface broken(const mw::Context &context) {
    const std::vector<double> points = {
        0, 0, 0, 10, 0, 0, 10, 10, 0, 0, 10, 0, 0, 0, 10, 10, 0, 10, 10, 10, 10, 0, 10, 10, // a box
        5, 5, 5, 6, 5, 5, 5, 6, 5, 5.3, 5.3, 15};                                           // a spike through its top
    const std::vector<std::int32_t> triangles = {
        0, 3, 2, 0, 2, 1, 4, 5, 6, 4, 6, 7, 0, 1, 5, 0, 5, 4, 1, 2, 6, 1, 6, 5, 2, 3, 7, 2, 7, 6, 3, 0, 4, // one missing
        8, 10, 9, 8, 9, 11, 9, 10, 11, 10, 8, 11};
    return mw::Surface(context, points, triangles);
}

int main(int argc, char **argv) {
    try {
        const mw::Context context;
        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", argc > 1 ? mw::Surface::read(context, argv[1]) : broken(context));
        job.run();
        std::cout << "nothing is wrong\n";
        return argc > 1 ? 0 : 1;
    } catch (const mw::Error &error) {
        if (error.status() != MW_E_INPUT) throw;
        std::cout << error.what() << '\n';
        std::map<int, int> codes;
        for (const mw::Finding &finding : error.findings()) {
            const char *severity[] = {"note", "warning", "error"};
            std::cout << severity[finding.severity] << " " << finding.code << " (" << finding.id[0] << ", "
                      << finding.id[1] << ") at " << finding.xyz[0] << " " << finding.xyz[1] << " " << finding.xyz[2]
                      << ": " << finding.text << '\n';
            ++codes[finding.code];
        }
        return argc > 1 || (codes[MW_DIAG_OPEN_EDGE] == 3 && codes[MW_DIAG_INTERSECTING_TRIANGLES] > 0) ? 0 : 1;
    }
}
