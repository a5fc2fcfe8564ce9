// Draws with VTK what is wrong with a surface: the surface see-through, red tubes along open edges, blue tubes along the
// triangles that cut each other, a ball at each place. Needs a display, or xvfb-run.
//
//   11_findings_drawn [OUTPUT.png]     ("-" draws nothing and lists only)
#include <meshwright.hpp>

#include <vtkActor.h>
#include <vtkCamera.h>
#include <vtkCellArray.h>
#include <vtkGlyph3DMapper.h>
#include <vtkNew.h>
#include <vtkPNGWriter.h>
#include <vtkPoints.h>
#include <vtkPolyData.h>
#include <vtkPolyDataMapper.h>
#include <vtkProperty.h>
#include <vtkRenderWindow.h>
#include <vtkRenderer.h>
#include <vtkSphereSource.h>
#include <vtkTubeFilter.h>
#include <vtkWindowToImageFilter.h>

#include <iostream>

// An open box that a spike pierces.
static const std::vector<double> POINTS = {
    0, 0, 0, 10, 0, 0, 10, 10, 0, 0, 10, 0, 0, 0, 10, 10, 0, 10, 10, 10, 10, 0, 10, 10, // the box
    5, 5, 5, 6.5, 5, 5, 5, 6.5, 5, 5.3, 5.3, 15};                                       // the spike
static const std::vector<std::int32_t> TRIANGLES = {
    0, 3, 2, 0, 2, 1, 4, 5, 6, 4, 6, 7, 0, 1, 5, 0, 5, 4, 1, 2, 6, 1, 6, 5, 2, 3, 7, 2, 7, 6, 3, 0, 4, // one missing
    8, 10, 9, 8, 9, 11, 9, 10, 11, 10, 8, 11};

/// Points and cells for one colour of the picture.
struct Drawing {
    vtkNew<vtkPoints> points;
    vtkNew<vtkCellArray> lines, polygons;

    void add_cell(vtkCellArray *cells, const std::vector<std::int64_t> &corners) {
        cells->InsertNextCell(static_cast<int>(corners.size()));
        for (std::int64_t corner : corners) cells->InsertCellPoint(points->InsertNextPoint(&POINTS[3 * corner]));
    }
    void add_outline(std::int64_t triangle) {
        const std::int32_t *v = &TRIANGLES[3 * triangle];
        add_cell(lines, {v[0], v[1], v[2], v[0]});
    }
    vtkSmartPointer<vtkPolyData> data() const {
        vtkSmartPointer<vtkPolyData> result = vtkSmartPointer<vtkPolyData>::New();
        result->SetPoints(points);
        result->SetLines(lines);
        result->SetPolys(polygons);
        return result;
    }
};

static vtkSmartPointer<vtkActor> actor(vtkMapper *mapper, double red, double green, double blue, double opacity = 1.0) {
    vtkSmartPointer<vtkActor> result = vtkSmartPointer<vtkActor>::New();
    result->SetMapper(mapper);
    result->GetProperty()->SetColor(red, green, blue);
    result->GetProperty()->SetOpacity(opacity);
    return result;
}

static vtkSmartPointer<vtkActor> tubes(const Drawing &drawing, double radius, double red, double green, double blue) {
    vtkNew<vtkTubeFilter> tube;
    tube->SetInputData(drawing.data());
    tube->SetRadius(radius);
    tube->SetNumberOfSides(12);
    vtkNew<vtkPolyDataMapper> mapper;
    mapper->SetInputConnection(tube->GetOutputPort());
    return actor(mapper, red, green, blue);
}

static void draw(const std::vector<mw::Finding> &findings, const std::string &path) {
    Drawing surface, open, cutting, places;
    for (std::size_t t = 0; t < TRIANGLES.size(); t += 3)
        surface.add_cell(surface.polygons, {TRIANGLES[t], TRIANGLES[t + 1], TRIANGLES[t + 2]});
    for (const mw::Finding &finding : findings) {
        if (finding.code == MW_DIAG_OPEN_EDGE) {
            open.add_cell(open.lines, {finding.id[0], finding.id[1]});
        } else if (finding.code == MW_DIAG_INTERSECTING_TRIANGLES) {
            for (std::int64_t triangle : finding.id) cutting.add_outline(triangle);
            places.points->InsertNextPoint(finding.xyz[0], finding.xyz[1], finding.xyz[2]);
        }
    }
    vtkNew<vtkPolyDataMapper> faces;
    faces->SetInputData(surface.data());
    vtkNew<vtkSphereSource> ball;
    ball->SetRadius(0.3);
    vtkNew<vtkGlyph3DMapper> balls;
    balls->SetInputData(places.data());
    balls->SetSourceConnection(ball->GetOutputPort());
    vtkNew<vtkRenderer> renderer;
    renderer->SetBackground(1.0, 1.0, 1.0);
    renderer->AddActor(actor(faces, 0.6, 0.65, 0.7, 0.35));
    renderer->AddActor(tubes(open, 0.15, 0.85, 0.1, 0.1));
    renderer->AddActor(tubes(cutting, 0.06, 0.1, 0.3, 0.8));
    renderer->AddActor(actor(balls, 0.95, 0.6, 0.0));
    vtkNew<vtkRenderWindow> window;
    window->SetOffScreenRendering(1);
    window->SetSize(900, 700);
    window->AddRenderer(renderer);
    renderer->GetActiveCamera()->SetPosition(-22, -26, 24);
    renderer->GetActiveCamera()->SetFocalPoint(5, 5, 6);
    renderer->GetActiveCamera()->SetViewUp(0, 0, 1);
    renderer->ResetCamera();
    window->Render();
    vtkNew<vtkWindowToImageFilter> picture;
    picture->SetInput(window);
    vtkNew<vtkPNGWriter> writer;
    writer->SetFileName(path.c_str());
    writer->SetInputConnection(picture->GetOutputPort());
    writer->Write();
}

int main(int argc, char **argv) {
    const std::string path = argc > 1 ? argv[1] : "11_findings.png";
    try {
        const mw::Context context;
        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", mw::Surface(context, POINTS, TRIANGLES));
        job.run();
        return 1; // nothing is wrong?
    } catch (const mw::Error &error) {
        std::cout << error.what() << '\n';
        for (const mw::Finding &finding : error.findings()) std::cout << "  " << finding.text << '\n';
        if (error.status() != MW_E_INPUT || error.findings().empty()) return 1;
        if (path == "-") return 0;
        draw(error.findings(), path);
        std::cout << "drawn in " << path << '\n';
        return 0;
    }
}
