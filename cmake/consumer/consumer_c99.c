/* A host in C99: a ball of labels in memory becomes a mesh. */
#include <meshwright.h>

#include <stdio.h>
#include <string.h>

#define N 24

static uint8_t voxels[N * N * N];

static int fail(const char *step, mw_status status)
{
    fprintf(stderr, "%s: %s: %s\n", step, mw_status_string(status), mw_last_error());
    return 1;
}

int main(void)
{
    mw_context *context = NULL;
    mw_image *image = NULL;
    mw_job *job = NULL;
    mw_mesh *mesh = NULL;
    mw_image_desc desc;
    mw_status status;
    int i, j, k;

    if (!MW_CHECK_VERSION()) {
        fprintf(stderr, "header %d.%d, library %s\n", MW_VERSION_MAJOR, MW_VERSION_MINOR, mw_version_string());
        return 1;
    }
    for (k = 0; k < N; k++)
        for (j = 0; j < N; j++)
            for (i = 0; i < N; i++) {
                double x = i - 11.5, y = j - 11.5, z = k - 11.5;
                voxels[i + N * (j + N * k)] = (uint8_t)(x * x + y * y + z * z < 81.0 ? 7 : 0);
            }
    memset(&desc, 0, sizeof desc);
    desc.struct_size = sizeof desc;
    desc.dims[0] = desc.dims[1] = desc.dims[2] = N;
    desc.spacing[0] = desc.spacing[1] = desc.spacing[2] = 1.0;
    desc.data = voxels;
    desc.type = MW_TYPE_U8;
    desc.borrow = MW_BORROW;

    if ((status = mw_context_create(2, &context)) != MW_OK) return fail("context", status);
    if ((status = mw_image_create(context, &desc, &image)) != MW_OK) return fail("image", status);
    if ((status = mw_job_create(context, MW_JOB_IMAGE_TO_MESH, &job)) != MW_OK) return fail("job", status);
    if ((status = mw_job_set_image(job, "labels", image)) != MW_OK) return fail("set image", status);
    if ((status = mw_job_set_f64(job, "lattice-spacing", 4.0)) != MW_OK) return fail("parameter", status);
    if ((status = mw_job_run(job)) != MW_OK) return fail("run", status);
    if ((status = mw_job_take_mesh(job, &mesh)) != MW_OK) return fail("take mesh", status);
    if ((status = mw_mesh_check(mesh)) != MW_OK) return fail("check", status);
    printf("%lld points, %lld cells, label %d\n", (long long)mw_mesh_point_count(mesh),
           (long long)mw_mesh_cell_count(mesh), (int)mw_mesh_labels(mesh)[0]);
    if (mw_mesh_cell_count(mesh) < 100 || mw_mesh_labels(mesh)[0] != 7) return 1;
    mw_context_destroy(context);
    mw_job_destroy(job);
    mw_image_destroy(image);
    mw_mesh_destroy(mesh);
    return 0;
}
