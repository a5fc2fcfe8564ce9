/* SPDX-License-Identifier: MIT OR Apache-2.0
 *
 * Meshwright: mesh generation and registration. C99 and later, C++98 and later.
 * Generated from the sources by cbindgen: do not edit.
 *
 * How to use it
 *   A context owns worker threads. A job is made for a kind of work, gets inputs and parameters by name, runs, and
 *   hands out results: a mesh, images, arrays, figures, findings. mw_param_get lists the parameters.
 *
 * Errors
 *   Most functions return a status: MW_OK or a negative MW_E_ number. mw_last_error() has the reason in words, per
 *   thread. What is wrong with data is listed by mw_job_diag_get, with ids and coordinates. Outputs are written only
 *   on success, handles are null after an error. No function exits, aborts, prints, or lets an exception through.
 *
 * Ownership
 *   Who creates a handle destroys it; destroying null is allowed; any order of destruction is right. Arrays that are
 *   handed in are copied (images with MW_BORROW excepted). Arrays that are handed out belong to their handle: do not
 *   write or free them.
 *
 * Threads
 *   A context may be used by several threads at once; images and meshes never change and may be read by any number
 *   of threads. A surface, a sizing and a job are used by one thread at a time, except mw_job_cancel; a second
 *   thread gets MW_E_STATE. mw_last_error is per thread. Callbacks say on which thread they are called.
 *   The calls do not depend on the host's floating-point mode (rounding, flush-to-zero) and leave it as it was.
 *   Once loaded, the library stays in memory until the process ends, also after dlclose.
 *
 * Coordinates and units
 *   Millimetres, LPS (left, posterior, superior) for images, as DICOM and ITK. Degrees for angles, seconds for time.
 *   Indices count from 0. Points are rows of three doubles. Cells use VTK's types and node order.
 *
 * Structs
 *   Structs that cross begin with struct_size: set it to sizeof. They only ever grow at the end.
 */

#ifndef MESHWRIGHT_H
#define MESHWRIGHT_H

#include <stddef.h>
#include <stdint.h>

/** Version of this header; mw_version() is that of the library. */
#define MW_VERSION_MAJOR 0
#define MW_VERSION_MINOR 1
#define MW_VERSION_PATCH 0
#define MW_MAKE_VERSION(major, minor, patch) \
    (((uint32_t)(major) << 22) | ((uint32_t)(minor) << 12) | (uint32_t)(patch))
#define MW_VERSION MW_MAKE_VERSION(MW_VERSION_MAJOR, MW_VERSION_MINOR, MW_VERSION_PATCH)
/** Whether the library that is running fits this header: same major version, before 1.0 also same minor version. */
#define MW_CHECK_VERSION() \
    ((mw_version() >> 22) == MW_VERSION_MAJOR && \
     (MW_VERSION_MAJOR > 0 || ((mw_version() >> 12) & 0x3ffu) == MW_VERSION_MINOR))

#ifndef MW_API
#if defined(_WIN32) && !defined(MW_STATIC)
#define MW_API __declspec(dllimport)
#else
#define MW_API
#endif
#endif

/** Log level: something is wrong, but the work goes on. */
#define MW_LOG_WARNING 1

/** Log level: the steps of a run. */
#define MW_LOG_INFO 2

/** Log level: details for developers. */
#define MW_LOG_DEBUG 3

/** Frame of coordinates: left, posterior, superior (DICOM, ITK). What the library uses. */
#define MW_SPACE_LPS 1

/** Frame of coordinates: right, anterior, superior (NIfTI, the scene of 3D Slicer). */
#define MW_SPACE_RAS 2

/** Copy the voxels: the caller's array is free for other use after mw_image_create. */
#define MW_COPY 0

/** Borrow the voxels: the caller keeps the array unchanged until mw_image_destroy has returned. */
#define MW_BORROW 1

/** Source of sizes: a point; 3 numbers. */
#define MW_SOURCE_POINT 1

/** Source of sizes: a segment; 6 numbers, its ends. */
#define MW_SOURCE_LINE 2

/** Source of sizes: an axis-aligned box with its inside; 6 numbers, smallest and largest corner. */
#define MW_SOURCE_BOX 3

/** Source of sizes: a ball with its inside; 4 numbers, centre and radius. */
#define MW_SOURCE_SPHERE 4

/** Kind of job: a segmented image becomes a mesh. Input: image "labels". Optional: points "fixed_points". */
#define MW_JOB_IMAGE_TO_MESH 1

/** Kind of job: a surface triangulation becomes a mesh. Input: surface "surface". Optional: sizing "sizing". */
#define MW_JOB_SURFACE_TO_MESH 2

/**
 * Kind of job: two scans become a displacement field. Inputs: images "fixed" (intraoperative), "moving" (preoperative)
 * and "segmentation" (labels of the moving scan: 1 brain, 2 tumour, more allowed). Optional: image "mask" (labels of
 * the fixed scan), mesh "mesh" (of the segmentation, instead of making one), transform "rigid", points
 * "fixed_landmarks" and "moving_landmarks" (for evaluation only).
 */
#define MW_JOB_REGISTRATION 3

/** Worth knowing; nothing was changed. */
#define MW_SEVERITY_NOTE 0

/** The input was repaired, or the result deviates from what was asked. */
#define MW_SEVERITY_WARNING 1

/** The input cannot be used. */
#define MW_SEVERITY_ERROR 2

/** A label has no cell. id: label, voxels. */
#define MW_DIAG_LABEL_LOST 1

/** A connected component of a label has no cell. id: label, voxels. */
#define MW_DIAG_COMPONENT_LOST 2

/** A label does not reach its fidelity. id: label. */
#define MW_DIAG_FIDELITY_NOT_REACHED 3

/** A sub-mesh has a non-manifold edge or vertex. id: label. */
#define MW_DIAG_NON_MANIFOLD_MESH 4

/** A sub-mesh has other components than its label. id: label, how many more, negative where it joins some. */
#define MW_DIAG_DISCONNECTED_MESH 5

/** Voxels were relabelled by the clean-up. id: label, voxels. */
#define MW_DIAG_VOXELS_RELABELLED 6

/** Smoothing could not improve the mesh, or stopped early. */
#define MW_DIAG_SMOOTHING_STOPPED 7

/** The image border cuts a label. id: label. */
#define MW_DIAG_LABEL_AT_IMAGE_BORDER 8

/** A sub-mesh has other tunnels, cavities or pieces than its label. id: label, difference of the Euler numbers. */
#define MW_DIAG_OTHER_TOPOLOGY 9

/** A surface edge with one triangle. id: its points. */
#define MW_DIAG_OPEN_EDGE 20

/** A surface edge with three or more triangles where that is not allowed. id: its points. */
#define MW_DIAG_NON_MANIFOLD_EDGE 21

/** Two triangles with the same points. id: the triangles. */
#define MW_DIAG_DUPLICATE_TRIANGLE 22

/** A triangle of zero area. id: the triangle. */
#define MW_DIAG_DEGENERATE_TRIANGLE 23

/** A triangle was turned over to agree with its component. id: the triangle. */
#define MW_DIAG_INCONSISTENT_ORIENTATION 24

/** Two triangles intersect. id: the triangles. */
#define MW_DIAG_INTERSECTING_TRIANGLES 25

/** Two points almost touch. id: the points. */
#define MW_DIAG_NEARLY_COINCIDENT_POINTS 26

/** Two points are equal and were merged. id: the points. */
#define MW_DIAG_MERGED_POINTS 27

/** A coordinate is NaN or infinite. id: the point. */
#define MW_DIAG_NON_FINITE_COORDINATE 28

/** A point index out of range. id: the triangle, the index. */
#define MW_DIAG_INDEX_OUT_OF_RANGE 29

/** All points lie on a point, a line or a plane. */
#define MW_DIAG_DEGENERATE_POINT_SET 30

/** A point that was added stays in the volume. id: the point. */
#define MW_DIAG_STEINER_POINT 31

/** A boundary edge or triangle could not be recovered. id: its points, or the triangle. */
#define MW_DIAG_NOT_RECOVERED 32

/** A region of the domain. id: its label, its cells. */
#define MW_DIAG_REGION 33

/** A point that no triangle uses. id: the point. */
#define MW_DIAG_UNUSED_POINT 34

/** A cell stays bad because the input's own angles force it. id: the cell. */
#define MW_DIAG_FORCED_BAD_ELEMENT 35

/** A hole or region point lies in no bounded region. id: its number. */
#define MW_DIAG_SEED_OUTSIDE 36

/** Blocks without a counterpart. id: how many. */
#define MW_DIAG_MISSING_CORRESPONDENCE 50

/** A solver stopped before its tolerance. id: iterations. */
#define MW_DIAG_NOT_CONVERGED 51

/** The displacement field folds. id: how many voxels. */
#define MW_DIAG_FOLDED_FIELD 52

/** Anything without a code of its own; the text says it. */
#define MW_DIAG_OTHER 99

/** Kind of a parameter: on or off; set with mw_job_set_i64 (0, 1). */
#define MW_PARAM_FLAG 1

/** Kind of a parameter: whole number; set with mw_job_set_i64. */
#define MW_PARAM_INTEGER 2

/** Kind of a parameter: number; set with mw_job_set_f64. */
#define MW_PARAM_REAL 3

/** Kind of a parameter: one of `choices`; set by name with mw_job_set_str, by position with mw_job_set_i64. */
#define MW_PARAM_CHOICE 4

/** Kind of a parameter: text; set with mw_job_set_str. */
#define MW_PARAM_TEXT 5

/** Kind of a parameter: a file that the command line reads. Not for mw_job_set_str: hand data over instead. */
#define MW_PARAM_INPUT_FILE 6

/** Kind of a parameter: a file that the command line writes. Not for mw_job_set_str: take results instead. */
#define MW_PARAM_OUTPUT_FILE 7

/** A parameter is given once. */
#define MW_PARAM_SINGLE 0

/** A parameter is given once for all labels, and once per label (mw_job_set_f64_for). */
#define MW_PARAM_PER_LABEL 1

/** A parameter is given any number of times; each mw_job_set_str adds a value. */
#define MW_PARAM_REPEATABLE 2

/** Worker threads and log, shared by any number of jobs. Any thread may use it, several at once. */
typedef struct mw_context mw_context;

/** An image. It does not change after its creation: any number of threads may read it. */
typedef struct mw_image mw_image;

/**
 * One mesher or one registration: takes inputs and parameters, runs, hands out results. Used by one thread at a time
 * (a second one gets MW_E_STATE), except mw_job_cancel. It may run again with other inputs or parameters.
 */
typedef struct mw_job mw_job;

/**
 * A finished mesh. It never changes: any number of threads may read it. It outlives the job and the context it came
 * from. Every array that a mw_mesh_ function hands out belongs to the mesh, stays valid until mw_mesh_destroy and must
 * not be written or freed.
 */
typedef struct mw_mesh mw_mesh;

/**
 * Element sizes for a surface job. Every part is an upper bound of the edge length; the smallest bound holds. Used by
 * one thread at a time while it is filled; a job keeps the state it was given.
 */
typedef struct mw_sizing mw_sizing;

/**
 * A surface triangulation: one or several closed components, nested, with internal sheets where wanted. Used by one
 * thread at a time while patches, regions and holes are set; a job keeps the state it was given.
 */
typedef struct mw_surface mw_surface;

/** Result of most functions: `MW_OK`, or a negative `MW_E_...`; positive values are reserved. */
typedef int32_t mw_status;

/**
 * Receives log lines: one at a time for a context, on any thread, never after mw_context_set_log replaced it or
 * mw_context_destroy returned. `level` is MW_LOG_WARNING, MW_LOG_INFO or MW_LOG_DEBUG; `text` is one line of UTF-8
 * without a line end, valid during the call. It must not throw, must not call longjmp, and must not call
 * mw_context_set_log or mw_context_destroy.
 */
typedef void (*mw_log_fn)(void *user, int32_t level, const char *text);

/** Type of array values: one of the MW_TYPE_... numbers. */
typedef int32_t mw_type;

/**
 * Describes an image in memory. Set everything to zero first, then `struct_size = sizeof(mw_image_desc)`.
 * Voxel (i, j, k), component c stands at `data[i * stride[0] + j * stride[1] + k * stride[2] + c]`.
 * Its centre in the world is `origin + direction * (spacing .* (i, j, k))`, the convention of ITK.
 */
typedef struct mw_image_desc {
    /** sizeof(mw_image_desc) */
    size_t struct_size;
    /** Voxels along i, j, k; each at least 1. */
    int64_t dims[3];
    /** Distance of voxel centres along i, j, k, mm; within 1e-6 and 1e6. */
    double spacing[3];
    /** Centre of voxel (0, 0, 0), mm. */
    double origin[3];
    /** 3 x 3, row-major; column n is the direction of axis n. All zero: identity. It may reflect. */
    double direction[9];
    /** Value of voxel (0, 0, 0), aligned for its type. */
    const void *data;
    /** Steps along i, j, k, in values, not bytes; may be negative. A zero stands for the step of a packed array. */
    int64_t stride[3];
    /** Type of the values, MW_TYPE_... */
    mw_type type;
    /** MW_COPY or MW_BORROW. */
    int32_t borrow;
    /** Frame of origin and direction: MW_SPACE_LPS or MW_SPACE_RAS; 0 stands for LPS. */
    int32_t space;
    /** Values per voxel; 0 stands for 1. Displacement fields have 3. */
    int32_t components;
} mw_image_desc;

/**
 * A size function: the largest edge length wanted at a point.
 *
 * Called from several threads at once, on threads of the library: it must not change data without a lock of its own,
 * must not throw, must not call longjmp. `point` are 3 coordinates, mm; `size` is the edge length wanted so far, mm.
 * The run ends with MW_E_INPUT when the function returns a number that is not finite and positive.
 */
typedef double (*mw_size_fn)(void *user, const double *point, double size);

/**
 * Receives progress, on the thread that called mw_job_run, about every 50 ms. `stage` is a stable name of the step,
 * valid during the call; `done` is the fraction of the whole run, from 0 to 1, never decreasing.
 * It must not throw, must not call longjmp, and must not use the job except through mw_job_cancel.
 *
 * @return 0 to go on, anything else to cancel
 */
typedef int32_t (*mw_progress_fn)(void *user, const char *stage, double done);

/** One figure of a run. Set `struct_size` before the call. */
typedef struct mw_stat {
    /** sizeof(mw_stat) */
    size_t struct_size;
    /** Stable dotted name, such as "mesh.tets"; valid until the job runs again or is destroyed. */
    const char *name;
    /** The figure. */
    double value;
} mw_stat;

/** One thing that is wrong with the data, or worth knowing. Set `struct_size` before the call. */
typedef struct mw_diag {
    /** sizeof(mw_diag) */
    size_t struct_size;
    /** MW_DIAG_... */
    int32_t code;
    /** MW_SEVERITY_NOTE, MW_SEVERITY_WARNING or MW_SEVERITY_ERROR. */
    int32_t severity;
    /** Two ids whose meaning the code tells; -1 where there is none. */
    int64_t id[2];
    /** Place, mm; NaN where there is none. */
    double xyz[3];
    /** One line of UTF-8; valid until the job runs again or is destroyed. */
    const char *text;
} mw_diag;

/** Describes a parameter. Set `struct_size` before the call. All strings are static. */
typedef struct mw_param_info {
    /** sizeof(mw_param_info) */
    size_t struct_size;
    /** Name, such as "lattice-spacing"; '_' for '-' is accepted in calls. */
    const char *name;
    /** The name in the literature, such as "latticeSpacing", accepted in calls; null where there is none. */
    const char *alias;
    /** What it does. */
    const char *doc;
    /** Unit for people, such as "mm"; empty where there is none. */
    const char *unit;
    /** Heading for dialogs. */
    const char *group;
    /** The names of a choice, one a line; empty for other kinds. */
    const char *choices;
    /** Default of a text; null for other kinds and for no default. */
    const char *default_text;
    /** MW_PARAM_FLAG ... MW_PARAM_OUTPUT_FILE. */
    int32_t kind;
    /** MW_PARAM_SINGLE, MW_PARAM_PER_LABEL or MW_PARAM_REPEATABLE. */
    int32_t multiplicity;
    /** 1 where there is a default, 0 where not. */
    int32_t has_default;
    /** 1 where `min` itself is not allowed. */
    int32_t min_excluded;
    /** Default of a flag, a number or the position of a choice. */
    double default_value;
    /** Smallest value. */
    double min;
    /** Largest value; may be infinite. */
    double max;
} mw_param_info;

/**
 * The surface of a mesh: triangles and quadrilaterals around and between the labels. Set `struct_size` before the
 * call. Arrays over faces list the triangles first, then the quadrilaterals.
 */
typedef struct mw_boundary {
    /** sizeof(mw_boundary) */
    size_t struct_size;
    /** Number of triangles. */
    int64_t triangle_count;
    /** triangle_count x 3 point indices, row-major, outward from the inner label. */
    const int32_t *triangles;
    /** Number of quadrilaterals; 0 for tetrahedral meshes. */
    int64_t quad_count;
    /** quad_count x 4 point indices, row-major, outward from the inner label. */
    const int32_t *quads;
    /** Per face the inner and the outer label; 0 is outside. */
    const int32_t *labels;
    /** Per face the inner and the outer cell; -1 for none. */
    const int64_t *cells;
    /** Per face the patch number of the input surface; null where there was none. */
    const int32_t *patches;
} mw_boundary;

/** Done. */
#define MW_OK 0

/** An argument is unusable by itself: null pointer, bad size, wrong type code, non-finite number. */
#define MW_E_ARG (-1)

/** A parameter: unknown name (the text of mw_last_error names the nearest known one), wrong kind, out of range. */
#define MW_E_PARAM (-2)

/** The data cannot be meshed or registered; mw_job_diag_get lists every fault found, with ids and coordinates. */
#define MW_E_INPUT (-3)

/** The operating system refused a read or a write. */
#define MW_E_IO (-4)

/** Memory or threads could not be had. */
#define MW_E_MEMORY (-5)

/** Cancelled by the progress callback or by mw_job_cancel. */
#define MW_E_CANCELLED (-6)

/** A limit was reached: time limit of the caller, or more entities than 32-bit indices can name. */
#define MW_E_LIMIT (-7)

/** Valid, but not supported; the text says what is supported instead. */
#define MW_E_UNSUPPORTED (-8)

/**
 * The call does not fit the state of the object: no input yet, no result yet, in use by another thread, or spoilt by
 * an earlier MW_E_INTERNAL.
 */
#define MW_E_STATE (-9)

/** No valid result could be made from valid input; mw_job_diag_get says where. */
#define MW_E_NO_RESULT (-10)

/** A file is not what its name or its header says. */
#define MW_E_FORMAT (-11)

/** A defect of this library was caught. The object is spoilt: destroy it. The host can go on. */
#define MW_E_INTERNAL (-99)

/** uint8_t */
#define MW_TYPE_U8 1

/** int8_t */
#define MW_TYPE_I8 2

/** uint16_t */
#define MW_TYPE_U16 3

/** int16_t */
#define MW_TYPE_I16 4

/** uint32_t */
#define MW_TYPE_U32 5

/** int32_t */
#define MW_TYPE_I32 6

/** uint64_t */
#define MW_TYPE_U64 7

/** int64_t */
#define MW_TYPE_I64 8

/** float */
#define MW_TYPE_F32 9

/** double */
#define MW_TYPE_F64 10

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Version of the library that is running, packed as by MW_MAKE_VERSION.
 *
 * Compare it with the header's: `MW_CHECK_VERSION()` does so. Any thread.
 */
MW_API uint32_t mw_version(void);

/**
 * Version of the library that is running, such as "0.1.0".
 *
 * @return A static string, never null. Any thread.
 */
MW_API const char *mw_version_string(void);

/**
 * A few words for a status, such as "invalid argument".
 *
 * @return A static string, never null; "unknown status" for a number that is none. Any thread.
 */
MW_API const char *mw_status_string(mw_status status);

/**
 * Why the last call on this thread failed, in one line of UTF-8; empty when it did not fail.
 *
 * @return Never null; valid until the next mw_ call on this thread (mw_last_error, mw_version, mw_version_string and
 *         mw_status_string excepted). Copy it if you need it longer.
 */
MW_API const char *mw_last_error(void);

/**
 * Makes a context with its own worker threads.
 *
 * @param threads  number of worker threads; 0 for one per core
 * @param out      receives the context, null after an error; destroy it with mw_context_destroy
 * @return MW_OK, MW_E_ARG (null `out`; threads negative or above 1024), MW_E_MEMORY (no threads to be had)
 */
MW_API mw_status mw_context_create(int32_t threads, struct mw_context **out);

/**
 * Destroys a context; null is allowed. Its log function is not called any more. Threads end when the last job made
 * with the context is destroyed too. Not from inside a callback.
 */
MW_API void mw_context_destroy(struct mw_context *context);

/** Number of worker threads of a context; 0 for null. */
MW_API int32_t mw_context_threads(const struct mw_context *context);

/**
 * Sets the function that receives log lines. Without one nothing is logged: the library never prints.
 *
 * @param fn         the function; null for none
 * @param user       handed to the function as it is
 * @param max_level  lines above this level are left out: MW_LOG_WARNING, MW_LOG_INFO or MW_LOG_DEBUG
 * @return MW_OK, MW_E_ARG (null context, unknown level)
 */
MW_API mw_status mw_context_set_log(struct mw_context *context, mw_log_fn fn, void *user, int32_t max_level);

/**
 * Makes an image of voxels in memory.
 *
 * Labels are whole numbers from 0 (background) to 2147483647, of any integer type, or of a floating-point type when
 * every value is whole; that is checked when the image is given to a job as labels.
 *
 * @param context  a context
 * @param desc     the description; not kept
 * @param out      receives the image, null after an error; destroy it with mw_image_destroy
 * @return MW_OK, MW_E_ARG (null pointer, struct_size too small, unknown type, size below 1, spacing not finite and
 *         positive, singular direction, misaligned data), MW_E_MEMORY
 */
MW_API mw_status mw_image_create(struct mw_context *context,
                          const struct mw_image_desc *desc,
                          struct mw_image **out);

/**
 * Reads an image file: NIfTI (.nii, .nii.gz), NRRD (.nrrd, .nhdr) or MetaImage (.mha, .mhd).
 *
 * @param context  a context
 * @param path     file name, UTF-8
 * @param out      receives the image, null after an error; destroy it with mw_image_destroy
 * @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_FORMAT (the text says what is wrong with the file), MW_E_UNSUPPORTED,
 *         MW_E_MEMORY
 */
MW_API mw_status mw_image_read(struct mw_context *context,
                        const char *path,
                        struct mw_image **out);

/**
 * Writes an image in the format of the file's name. The file appears whole or not at all.
 *
 * @param image  an image
 * @param path   file name, UTF-8, ending as in mw_image_read
 * @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_UNSUPPORTED (unknown ending), MW_E_MEMORY
 */
MW_API mw_status mw_image_write(const struct mw_image *image, const char *path);

/**
 * Describes an image: its size, place, type and where its voxels are.
 *
 * @param image  an image
 * @param out    receives the description; set its struct_size before. `data` stays valid until mw_image_destroy and
 *               must not be written
 * @return MW_OK, MW_E_ARG (null pointer, struct_size too small)
 */
MW_API mw_status mw_image_describe(const struct mw_image *image,
                            struct mw_image_desc *out);

/** Destroys an image; null is allowed. Jobs that were given the image keep what they need of it. */
MW_API void mw_image_destroy(struct mw_image *image);

/**
 * Makes a surface of arrays, which are copied. Its geometry is checked when a job runs: every fault is then a finding.
 *
 * @param context         a context
 * @param point_count     number of points
 * @param points          point_count x 3 coordinates, row-major, mm
 * @param triangle_count  number of triangles
 * @param triangles       triangle_count x 3 point indices, from 0, row-major
 * @param patches         triangle_count patch numbers; null for all 0
 * @param out             receives the surface, null after an error; destroy it with mw_surface_destroy
 * @return MW_OK, MW_E_ARG (null pointer, negative count), MW_E_MEMORY
 */
MW_API mw_status mw_surface_create(struct mw_context *context,
                            int64_t point_count,
                            const double *points,
                            int64_t triangle_count,
                            const int32_t *triangles,
                            const int32_t *patches,
                            struct mw_surface **out);

/**
 * Reads a surface file: .stl .off .obj .ply .vtk .vtp .mesh .surf .poly .smesh, by the ending of its name.
 *
 * @param context  a context
 * @param path     file name, UTF-8
 * @param out      receives the surface, null after an error; destroy it with mw_surface_destroy
 * @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_FORMAT, MW_E_UNSUPPORTED (unknown ending), MW_E_MEMORY
 */
MW_API mw_status mw_surface_read(struct mw_context *context, const char *path, struct mw_surface **out);

/**
 * Says what a patch is for.
 *
 * @param surface  a surface
 * @param patch    patch number, as in mw_surface_create
 * @param role     "wall", "wall_bl", "symmetry", "farfield", "embedded" (or "transparent"), "source", "internal",
 *                 "fixed", "inlet", "outlet"
 * @param name     name for files of flow solvers; null for none
 * @return MW_OK, MW_E_ARG (null pointer, unknown role), MW_E_STATE
 */
MW_API mw_status mw_surface_set_patch(struct mw_surface *surface,
                               int32_t patch,
                               const char *role,
                               const char *name);

/**
 * Gives the region around a point its label and, where wanted, its own largest edge length.
 *
 * @param surface  a surface
 * @param point    3 coordinates strictly inside the region, mm
 * @param label    label of its elements
 * @param size     largest edge length in it, mm; 0 for no limit of its own
 * @return MW_OK, MW_E_ARG (null pointer, not finite, negative size), MW_E_STATE
 */
MW_API mw_status mw_surface_add_region(struct mw_surface *surface,
                                const double *point,
                                int32_t label,
                                double size);

/**
 * Leaves the cavity around a point empty.
 *
 * @param surface  a surface
 * @param point    3 coordinates strictly inside the cavity, mm
 * @return MW_OK, MW_E_ARG (null pointer, not finite), MW_E_STATE
 */
MW_API mw_status mw_surface_add_hole(struct mw_surface *surface, const double *point);

/** Destroys a surface; null is allowed. Jobs that were given it keep their state of it. */
MW_API void mw_surface_destroy(struct mw_surface *surface);

/**
 * Makes a sizing without any bound.
 *
 * @param context  a context
 * @param out      receives the sizing, null after an error; destroy it with mw_sizing_destroy
 * @return MW_OK, MW_E_ARG
 */
MW_API mw_status mw_sizing_create(struct mw_context *context, struct mw_sizing **out);

/**
 * Adds a source: edge length at most `size + decay * distance`.
 *
 * @param sizing   a sizing
 * @param kind     MW_SOURCE_POINT, _LINE, _BOX or _SPHERE
 * @param numbers  coordinates and radius as the kind says, mm
 * @param count    how many numbers: 3, 6, 6 or 4
 * @param size     edge length at the source, mm, positive
 * @param decay    growth per millimetre of distance, at least 0
 * @return MW_OK, MW_E_ARG (null pointer, unknown kind, wrong count, not finite or positive), MW_E_STATE
 */
MW_API mw_status mw_sizing_add_source(struct mw_sizing *sizing,
                               int32_t kind,
                               const double *numbers,
                               int32_t count,
                               double size,
                               double decay);

/**
 * Sets the size function.
 *
 * @param sizing  a sizing
 * @param fn      the function; null for none
 * @param user    handed to the function as it is; alive until every job given the sizing is destroyed
 * @return MW_OK, MW_E_ARG, MW_E_STATE
 */
MW_API mw_status mw_sizing_set_function(struct mw_sizing *sizing, mw_size_fn fn, void *user);

/**
 * Sets a background mesh with an edge length at each of its points, interpolated linearly between them; outside of the
 * mesh there is no bound.
 *
 * @param sizing  a sizing
 * @param mesh    a mesh; kept
 * @param sizes   one edge length per point of the mesh, mm, positive
 * @param count   how many: mw_mesh_point_count(mesh)
 * @return MW_OK, MW_E_ARG (null pointer, wrong count, not finite or positive), MW_E_STATE, MW_E_MEMORY
 */
MW_API mw_status mw_sizing_set_background(struct mw_sizing *sizing,
                                   const struct mw_mesh *mesh,
                                   const double *sizes,
                                   int64_t count);

/** Destroys a sizing; null is allowed. Jobs that were given it keep their state of it. */
MW_API void mw_sizing_destroy(struct mw_sizing *sizing);

/**
 * Makes a job.
 *
 * @param context  a context; the job keeps what it needs of it
 * @param kind     MW_JOB_IMAGE_TO_MESH, MW_JOB_SURFACE_TO_MESH or MW_JOB_REGISTRATION
 * @param out      receives the job, null after an error; destroy it with mw_job_destroy
 * @return MW_OK, MW_E_ARG (null pointer, unknown kind)
 */
MW_API mw_status mw_job_create(struct mw_context *context, int32_t kind, struct mw_job **out);

/** Destroys a job; null is allowed. Not while it runs. */
MW_API void mw_job_destroy(struct mw_job *job);

/**
 * Gives a job an image. Labels are converted and checked at once; borrowed voxels are copied as far as needed: the
 * image may be destroyed afterwards.
 *
 * @param job    a job
 * @param slot   which input: see MW_JOB_...
 * @param image  an image; null takes the input away
 * @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_INPUT (no label image: a value that is not whole or
 *         negative, more than 65535 labels, only background), MW_E_STATE, MW_E_MEMORY
 */
MW_API mw_status mw_job_set_image(struct mw_job *job,
                           const char *slot,
                           const struct mw_image *image);

/**
 * Gives a surface job its surface, in its present state.
 *
 * @param job      a job
 * @param slot     "surface"
 * @param surface  a surface; null takes the input away
 * @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_STATE
 */
MW_API mw_status mw_job_set_surface(struct mw_job *job, const char *slot, const struct mw_surface *surface);

/**
 * Gives a surface job element sizes, in their present state.
 *
 * @param job     a job
 * @param slot    "sizing"
 * @param sizing  a sizing; null takes the input away
 * @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_STATE
 */
MW_API mw_status mw_job_set_sizing(struct mw_job *job, const char *slot, const struct mw_sizing *sizing);

/**
 * Gives a registration a mesh of the segmentation, to be used instead of making one.
 *
 * @param job   a job
 * @param slot  "mesh"
 * @param mesh  a mesh, which the job shares; null takes the input away
 * @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_STATE
 */
MW_API mw_status mw_job_set_mesh(struct mw_job *job, const char *slot, const struct mw_mesh *mesh);

/**
 * Gives a job points: "fixed_points" of an image job become vertices of the mesh; "fixed_landmarks" and
 * "moving_landmarks" of a registration are compared after it, pair by pair.
 *
 * @param job     a job
 * @param slot    which input
 * @param count   number of points; 0 takes the input away
 * @param points  count x 3 finite coordinates, row-major, LPS mm; copied
 * @return MW_OK, MW_E_ARG (null pointer, no such input, not finite), MW_E_STATE
 */
MW_API mw_status mw_job_set_points(struct mw_job *job, const char *slot, int64_t count, const double *points);

/**
 * Gives a registration its rigid start, from points of the fixed image to points of the moving image.
 *
 * @param job     a job
 * @param slot    "rigid"
 * @param matrix  16 numbers, 4 x 4, row-major, last row 0 0 0 1, translation in mm; null takes the input away
 * @param space   frame of both sides: MW_SPACE_LPS or MW_SPACE_RAS
 * @return MW_OK, MW_E_ARG (null job or slot, no such input, no rigid transform, unknown space), MW_E_STATE
 */
MW_API mw_status mw_job_set_transform(struct mw_job *job,
                               const char *slot,
                               const double *matrix,
                               int32_t space);

/**
 * Sets a parameter to a number. mw_param_get lists names, ranges and units.
 *
 * @return MW_OK, MW_E_ARG (null pointer), MW_E_PARAM (unknown name, wrong kind, out of range, not finite), MW_E_STATE
 */
MW_API mw_status mw_job_set_f64(struct mw_job *job,
                         const char *name,
                         double value);

/**
 * Sets a parameter to a whole number: numbers, flags (0, 1), positions of choices.
 *
 * @return as mw_job_set_f64
 */
MW_API mw_status mw_job_set_i64(struct mw_job *job, const char *name, int64_t value);

/**
 * Sets a parameter from text, as the command line does: any kind but files. A repeatable parameter gets one value more.
 *
 * @return as mw_job_set_f64; also MW_E_ARG for text that is not UTF-8
 */
MW_API mw_status mw_job_set_str(struct mw_job *job,
                         const char *name,
                         const char *value);

/**
 * Sets a parameter for one label; mw_param_get tells which parameters allow it.
 *
 * @param label  the label's value in the image
 * @return as mw_job_set_f64
 */
MW_API mw_status mw_job_set_f64_for(struct mw_job *job, const char *name, int64_t label, double value);

/**
 * Sets a parameter for one label from text.
 *
 * @param label  the label's value in the image
 * @return as mw_job_set_str
 */
MW_API mw_status mw_job_set_str_for(struct mw_job *job, const char *name, int64_t label, const char *value);

/**
 * Sets every parameter back to its default.
 *
 * @return MW_OK, MW_E_ARG, MW_E_STATE
 */
MW_API mw_status mw_job_reset_params(struct mw_job *job);

/**
 * Sets the function that receives progress.
 *
 * @param job   a job
 * @param fn    the function; null for none
 * @param user  handed to the function as it is
 * @return MW_OK, MW_E_ARG, MW_E_STATE
 */
MW_API mw_status mw_job_set_progress(struct mw_job *job, mw_progress_fn fn, void *user);

/**
 * Limits the time of a run, after which it ends with MW_E_LIMIT.
 *
 * @param job      a job
 * @param seconds  positive and finite; 0 for no limit
 * @return MW_OK, MW_E_ARG (null, negative, not finite), MW_E_STATE
 */
MW_API mw_status mw_job_set_time_limit(struct mw_job *job, double seconds);

/**
 * Runs a job and waits for it. Results of an earlier run are dropped first; what was taken of them stays.
 * Same inputs and parameters give the same bits for any number of threads, except where a parameter's documentation
 * says otherwise.
 *
 * @return MW_OK; MW_E_STATE (an input is missing, the job is in use); MW_E_PARAM; MW_E_INPUT and MW_E_NO_RESULT (see
 *         mw_job_diag_get); MW_E_CANCELLED; MW_E_LIMIT; MW_E_UNSUPPORTED; MW_E_MEMORY; MW_E_INTERNAL
 */
MW_API mw_status mw_job_run(struct mw_job *job);

/**
 * Cancels the run in progress, or the next one where none is: the run ends with MW_E_CANCELLED within 0.2 s. The one
 * function that may be called from another thread while the job runs, also from callbacks. Null is allowed.
 */
MW_API void mw_job_cancel(struct mw_job *job);

/**
 * The mesh of the last run. It shares the data: no copy, and it outlives the job.
 *
 * @param job  a job
 * @param out  receives the mesh, null after an error; destroy it with mw_mesh_destroy
 * @return MW_OK, MW_E_ARG (null pointer), MW_E_STATE (no run yet, the last run failed or made no mesh)
 */
MW_API mw_status mw_job_take_mesh(struct mw_job *job, struct mw_mesh **out);

/**
 * A mesh that the last run made beside its result, by name.
 *
 * @param job   a job
 * @param name  its name
 * @param out   receives the mesh, null after an error; destroy it with mw_mesh_destroy
 * @return MW_OK, MW_E_ARG (null pointer; no mesh of this name, the text lists the names), MW_E_STATE (no results)
 */
MW_API mw_status mw_job_take_named_mesh(struct mw_job *job,
                                 const char *name,
                                 struct mw_mesh **out);

/**
 * An image that the last run made. A registration makes "displacement" (3 components, LPS mm, from points of the fixed
 * image to the moving image), "inverse" and "warped".
 *
 * @param job   a job
 * @param name  its name
 * @param out   receives the image, null after an error; destroy it with mw_image_destroy
 * @return MW_OK, MW_E_ARG (null pointer; no image of this name, the text lists the names), MW_E_STATE (no results)
 */
MW_API mw_status mw_job_take_image(struct mw_job *job,
                            const char *name,
                            struct mw_image **out);

/**
 * An array that the last run made, such as a registration's "source_points", "target_points" (3 components, LPS mm),
 * "similarity", "rejected" (one per pair of points) and "rigid" (16 numbers, 4 x 4, row-major).
 *
 * @param job         a job
 * @param name        its name
 * @param type        receives MW_TYPE_I32, MW_TYPE_I64 or MW_TYPE_F64
 * @param components  receives the number of values per row
 * @param rows        receives the number of rows
 * @param data        receives the values, row-major; valid until the job runs again or is destroyed
 * @return MW_OK, MW_E_ARG (null pointer; no array of this name, the text lists the names), MW_E_STATE (no results)
 */
MW_API mw_status mw_job_array(const struct mw_job *job,
                       const char *name,
                       mw_type *type,
                       int32_t *components,
                       int64_t *rows,
                       const void **data);

/**
 * A figure of the last run by name, such as "time.total" (s), "memory.peak" (bytes), "mesh.tets",
 * "quality.min_dihedral" (degrees), "label.3.volume" (mm^3).
 *
 * @return MW_OK, MW_E_ARG (null pointer, no figure of this name), MW_E_STATE (no results)
 */
MW_API mw_status mw_job_stat(const struct mw_job *job, const char *name, double *out);

/** Number of figures of the last run; 0 without results or for null. */
MW_API int64_t mw_job_stat_count(const struct mw_job *job);

/**
 * A figure of the last run by position, in the order in which they were made.
 *
 * @param job    a job
 * @param index  from 0
 * @param out    receives name and value; set its struct_size before
 * @return MW_OK, MW_E_ARG (null pointer, index out of range, struct_size too small), MW_E_STATE
 */
MW_API mw_status mw_job_stat_get(const struct mw_job *job, int64_t index, struct mw_stat *out);

/** Number of findings of the last run, also of one that failed; 0 before a run or for null. */
MW_API int64_t mw_job_diag_count(const struct mw_job *job);

/**
 * A finding of the last run, also of one that failed: every open edge, every intersecting pair, every lost label.
 *
 * @param job    a job
 * @param index  from 0
 * @param out    receives the finding; set its struct_size before
 * @return MW_OK, MW_E_ARG (null pointer, index out of range, struct_size too small), MW_E_STATE
 */
MW_API mw_status mw_job_diag_get(const struct mw_job *job,
                          int64_t index,
                          struct mw_diag *out);

/**
 * Number of parameters of a kind of job.
 *
 * @param kind  MW_JOB_...
 * @param out   receives the number
 * @return MW_OK, MW_E_ARG (null pointer, unknown kind)
 */
MW_API mw_status mw_param_count(int32_t kind, int32_t *out);

/**
 * Describes a parameter of a kind of job. The command line's options, the XML for 3D Slicer and this list come from
 * one table.
 *
 * @param kind   MW_JOB_...
 * @param index  from 0
 * @param out    receives the description; set its struct_size before
 * @return MW_OK, MW_E_ARG (null pointer, unknown kind, index out of range, struct_size too small)
 */
MW_API mw_status mw_param_get(int32_t kind,
                       int32_t index,
                       struct mw_param_info *out);

/** Number of points; 0 for null. */
MW_API int64_t mw_mesh_point_count(const struct mw_mesh *mesh);

/** Number of cells; 0 for null. */
MW_API int64_t mw_mesh_cell_count(const struct mw_mesh *mesh);

/** Coordinates: point_count x 3, row-major, mm, in the frame of mw_mesh_space; null for an empty mesh or null. */
MW_API const double *mw_mesh_points(const struct mw_mesh *mesh);

/** Tetrahedra: cell_count x 4 point indices, row-major; null when the mesh has other cells, is empty, or null. */
MW_API const int32_t *mw_mesh_tets(const struct mw_mesh *mesh);

/**
 * Type of each cell, VTK's numbers: 10 tetrahedron, 12 hexahedron, 13 wedge, 14 pyramid, 24 tetrahedron with 10 nodes,
 * 25 hexahedron with 20 nodes.
 */
MW_API const uint8_t *mw_mesh_cell_types(const struct mw_mesh *mesh);

/** Where each cell begins in mw_mesh_connectivity: cell_count + 1 numbers, the last one its length. */
MW_API const int64_t *mw_mesh_offsets(const struct mw_mesh *mesh);

/** Point indices of all cells, from 0, in VTK's node order. */
MW_API const int32_t *mw_mesh_connectivity(const struct mw_mesh *mesh);

/** Label of each cell: the label values of the input. */
MW_API const int32_t *mw_mesh_labels(const struct mw_mesh *mesh);

/** Frame of the coordinates: MW_SPACE_LPS, MW_SPACE_RAS, or 0 where there is no anatomical frame. */
MW_API int32_t mw_mesh_space(const struct mw_mesh *mesh);

/**
 * The surface around and between the labels.
 *
 * @param mesh  a mesh
 * @param out   receives counts and arrays; set its struct_size before
 * @return MW_OK, MW_E_ARG (null pointer, struct_size too small)
 */
MW_API mw_status mw_mesh_boundary(const struct mw_mesh *mesh, struct mw_boundary *out);

/** Number of named arrays on points (`on_cells` 0) or cells (1); 0 for null. */
MW_API int32_t mw_mesh_array_count(const struct mw_mesh *mesh, int32_t on_cells);

/** Name of a named array, from 0; null where there is none. */
MW_API const char *mw_mesh_array_name(const struct mw_mesh *mesh, int32_t on_cells, int32_t index);

/**
 * A named array on points or cells, such as "displacement" on points.
 *
 * @param mesh        a mesh
 * @param on_cells    0 for an array on points, 1 on cells
 * @param name        its name
 * @param type        receives MW_TYPE_I32, MW_TYPE_I64 or MW_TYPE_F64
 * @param components  receives the number of values per point or cell
 * @param data        receives the values, row-major
 * @return MW_OK, MW_E_ARG (null pointer, no array of this name)
 */
MW_API mw_status mw_mesh_array(const struct mw_mesh *mesh,
                        int32_t on_cells,
                        const char *name,
                        mw_type *type,
                        int32_t *components,
                        const void **data);

/**
 * Copies mw_mesh_connectivity as 64-bit numbers, VTK's vtkIdType.
 *
 * @param mesh      a mesh
 * @param out       receives the numbers
 * @param capacity  how many fit; mw_mesh_offsets(mesh)[cell_count] are needed
 * @return MW_OK, MW_E_ARG (null pointer, too small)
 */
MW_API mw_status mw_mesh_copy_connectivity_i64(const struct mw_mesh *mesh, int64_t *out, int64_t capacity);

/**
 * Computes a measure of every cell, with the definitions of VTK's vtkMeshQuality.
 *
 * @param mesh      a mesh
 * @param measure   "min_dihedral", "max_dihedral" (degrees), "radius_ratio" (circumradius over 3 inradii, 1 is best),
 *                  "mean_ratio", "scaled_jacobian" (1 is best); NaN where a kind of cell has no such measure
 * @param out       receives one number per cell
 * @param capacity  how many fit; mw_mesh_cell_count(mesh) are needed
 * @return MW_OK, MW_E_ARG (null pointer, unknown measure, too small)
 */
MW_API mw_status mw_mesh_quality(const struct mw_mesh *mesh,
                          const char *measure,
                          double *out,
                          int64_t capacity);

/**
 * Checks that a mesh is valid: every cell positively oriented (exactly), no duplicate, no face with three cells.
 * Meshes that a job returns are; this is for meshes from elsewhere. Runs on one thread.
 *
 * @return MW_OK, MW_E_ARG, MW_E_INPUT (the text names the first fault)
 */
MW_API mw_status mw_mesh_check(const struct mw_mesh *mesh);

/**
 * Makes a mesh of arrays, which are copied.
 *
 * @param context       a context
 * @param point_count   number of points
 * @param points        point_count x 3 coordinates, row-major, LPS mm
 * @param cell_count    number of cells
 * @param types         cell_count VTK cell types, as in mw_mesh_cell_types
 * @param offsets       cell_count + 1 positions in connectivity, the first 0
 * @param connectivity  point indices of all cells, from 0, VTK's node order
 * @param labels        cell_count labels; null for all 1
 * @param out           receives the mesh, null after an error; destroy it with mw_mesh_destroy
 * @return MW_OK, MW_E_ARG (null pointer, unknown type, offsets that do not match, index out of range), MW_E_MEMORY
 */
MW_API mw_status mw_mesh_create(struct mw_context *context,
                         int64_t point_count,
                         const double *points,
                         int64_t cell_count,
                         const uint8_t *types,
                         const int64_t *offsets,
                         const int32_t *connectivity,
                         const int32_t *labels,
                         struct mw_mesh **out);

/**
 * Reads a mesh file, by the ending of its name: .vtu .vtk .msh .mesh .ugrid and others.
 *
 * @param context  a context
 * @param path     file name, UTF-8
 * @param out      receives the mesh, null after an error; destroy it with mw_mesh_destroy
 * @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_FORMAT, MW_E_UNSUPPORTED (unknown ending), MW_E_MEMORY
 */
MW_API mw_status mw_mesh_read(struct mw_context *context, const char *path, struct mw_mesh **out);

/**
 * Writes a mesh. The file appears whole or not at all.
 *
 * @param mesh     a mesh
 * @param path     file name, UTF-8; its ending decides the format: .vtu .vtk .msh .mesh .meshb .ugrid .b8.ugrid
 *                 .lb8.ugrid .su2, or CASE/NAME.foam for an OpenFOAM case in the folder CASE
 * @param options  null, or settings as "key=value" with ';' between them: "format=" vtu, vtk42, vtk51, msh22, msh41,
 *                 medit, meditb, ugrid, b8.ugrid, lb8.ugrid, su2, openfoam; "encoding=" binary, ascii;
 *                 "compression=" none, zlib; "space=" lps, ras, none; "surfaces=" include, omit
 * @return MW_OK, MW_E_ARG (null pointer, unknown setting), MW_E_IO, MW_E_UNSUPPORTED (unknown ending, a kind of cell
 *         that the format has not)
 */
MW_API mw_status mw_mesh_write(const struct mw_mesh *mesh,
                        const char *path,
                        const char *options);

/** Destroys a mesh and every array it handed out; null is allowed. */
MW_API void mw_mesh_destroy(struct mw_mesh *mesh);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* MESHWRIGHT_H */
