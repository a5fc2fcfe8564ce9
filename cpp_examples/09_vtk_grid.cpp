// The mesh as a vtkUnstructuredGrid whose points are not copied.
//
//   09_vtk_grid [OUTPUT.vtu]
#include <meshwright.hpp>

#include <vtkCellArray.h>
#include <vtkCellData.h>
#include <vtkDoubleArray.h>
#include <vtkIdTypeArray.h>
#include <vtkIntArray.h>
#include <vtkMeshQuality.h>
#include <vtkNew.h>
#include <vtkPoints.h>
#include <vtkUnsignedCharArray.h>
#include <vtkUnstructuredGrid.h>
#include <vtkXMLUnstructuredGridWriter.h>

#include <iostream>

static mw::Mesh ball(const mw::Context &context) {
    const int n = 40;
    std::vector<std::uint8_t> voxels(n * n * n);
    for (int k = 0; k < n; ++k)
        for (int j = 0; j < n; ++j)
            for (int i = 0; i < n; ++i) {
                const double x = i - 19.5, y = j - 19.5, z = k - 19.5;
                voxels[i + n * (j + n * k)] = x * x + y * y + z * z < 250.0 ? (x > 0 ? 2 : 1) : 0;
            }
    mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
    job.set("labels", mw::Image(context, voxels.data(), {{n, n, n}}));
    job.set("lattice-spacing", 5.0);
    job.run();
    return job.mesh();
}

int main(int argc, char **argv) {
    try {
        const mw::Context context;
        const mw::Mesh mesh = ball(context); // lives longer than the grid that looks at its points

        vtkNew<vtkDoubleArray> coordinates;
        coordinates->SetNumberOfComponents(3);
        // VTK wants a pointer it could write through; 1: the array is ours, VTK neither frees nor changes it.
        coordinates->SetArray(const_cast<double *>(mesh.points().data()),
                              static_cast<vtkIdType>(mesh.points().size()), 1);
        vtkNew<vtkPoints> points;
        points->SetData(coordinates);

        // Connectivity: 64-bit numbers for VTK.
        const vtkIdType cells = static_cast<vtkIdType>(mesh.cell_count());
        vtkNew<vtkIdTypeArray> offsets, connectivity;
        offsets->SetNumberOfValues(cells + 1);
        std::copy(mesh.offsets().begin(), mesh.offsets().end(), offsets->GetPointer(0));
        connectivity->SetNumberOfValues(static_cast<vtkIdType>(mesh.connectivity().size()));
        std::copy(mesh.connectivity().begin(), mesh.connectivity().end(), connectivity->GetPointer(0));
        vtkNew<vtkCellArray> cell_array;
        cell_array->SetData(offsets, connectivity);
        vtkNew<vtkUnsignedCharArray> types;
        types->SetArray(const_cast<unsigned char *>(mesh.cell_types().data()), cells, 1);

        vtkNew<vtkUnstructuredGrid> grid;
        grid->SetPoints(points);
        grid->SetCells(types, cell_array);
        vtkNew<vtkIntArray> labels;
        labels->SetName("labels");
        labels->SetArray(const_cast<int *>(mesh.labels().data()), cells, 1);
        grid->GetCellData()->AddArray(labels);

        if (coordinates->GetPointer(0) != mesh.points().data()) return 1;
        double worst = 1.0;
        for (vtkIdType cell = 0; cell < cells; ++cell)
            worst = std::min(worst, vtkMeshQuality::TetScaledJacobian(grid->GetCell(cell)));
        std::cout << grid->GetNumberOfCells() << " cells, smallest scaled Jacobian " << worst << '\n';

        vtkNew<vtkXMLUnstructuredGridWriter> writer;
        writer->SetFileName(argc > 1 ? argv[1] : "09_vtk_grid.vtu");
        writer->SetInputData(grid);
        return writer->Write() == 1 ? 0 : 1;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}
