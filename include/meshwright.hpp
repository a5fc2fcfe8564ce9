// SPDX-License-Identifier: MIT OR Apache-2.0
//
// Meshwright for C++11 and later: the C interface with destructors and exceptions. Header only, not part of the ABI.
// Every failed call throws mw::Error, which carries the status, the text, and after a run the findings.
// Exceptions that leave a progress, log or size callback are caught, cancel the run, and are thrown again by run().
#ifndef MESHWRIGHT_HPP
#define MESHWRIGHT_HPP

#include "meshwright.h"

#include <array>
#include <cmath>
#include <cstdint>
#include <exception>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace mw {

/// One thing that is wrong with the data, or worth knowing.
struct Finding {
    std::int32_t code;              ///< MW_DIAG_...
    std::int32_t severity;          ///< MW_SEVERITY_...
    std::array<std::int64_t, 2> id; ///< meaning: see the code; -1 for none
    std::array<double, 3> xyz;      ///< mm; NaN for none
    std::string text;
};

/// A call that failed.
class Error : public std::runtime_error {
public:
    Error(mw_status status, const std::string &text, std::vector<Finding> findings = std::vector<Finding>())
        : std::runtime_error(text), status_(status),
          findings_(std::make_shared<const std::vector<Finding>>(std::move(findings))) {}
    mw_status status() const noexcept { return status_; }
    const std::vector<Finding> &findings() const noexcept { return *findings_; }

private:
    mw_status status_;
    std::shared_ptr<const std::vector<Finding>> findings_;
};

namespace detail {

/// The text of an error, which names its kind by itself; the kind alone where there is no text.
inline std::string message(mw_status status, const std::string &text) {
    return text.empty() ? mw_status_string(status) : text;
}

inline void check(mw_status status) {
    if (status != MW_OK) throw Error(status, message(status, mw_last_error()));
}

template <class Handle, void (*destroy)(Handle *)>
struct Destroy {
    void operator()(Handle *handle) const noexcept { destroy(handle); }
};
template <class Handle, void (*destroy)(Handle *)>
using Owner = std::unique_ptr<Handle, Destroy<Handle, destroy>>;

template <class T> struct TypeOf;
template <> struct TypeOf<std::uint8_t> { enum { value = MW_TYPE_U8 }; };
template <> struct TypeOf<std::int8_t> { enum { value = MW_TYPE_I8 }; };
template <> struct TypeOf<std::uint16_t> { enum { value = MW_TYPE_U16 }; };
template <> struct TypeOf<std::int16_t> { enum { value = MW_TYPE_I16 }; };
template <> struct TypeOf<std::uint32_t> { enum { value = MW_TYPE_U32 }; };
template <> struct TypeOf<std::int32_t> { enum { value = MW_TYPE_I32 }; };
template <> struct TypeOf<std::uint64_t> { enum { value = MW_TYPE_U64 }; };
template <> struct TypeOf<std::int64_t> { enum { value = MW_TYPE_I64 }; };
template <> struct TypeOf<float> { enum { value = MW_TYPE_F32 }; };
template <> struct TypeOf<double> { enum { value = MW_TYPE_F64 }; };

} // namespace detail

/// Rows of values that belong to another object: valid as long as that one lives.
template <class T>
class View {
public:
    View(const T *data, std::size_t size) : data_(data), size_(size) {}
    const T *data() const noexcept { return data_; }
    std::size_t size() const noexcept { return size_; }
    bool empty() const noexcept { return size_ == 0; }
    const T &operator[](std::size_t index) const noexcept { return data_[index]; }
    const T *begin() const noexcept { return data_; }
    const T *end() const noexcept { return size_ ? data_ + size_ : data_; }

private:
    const T *data_;
    std::size_t size_;
};

/// Worker threads and log.
class Context {
public:
    using Log = std::function<void(std::int32_t level, const std::string &text)>;

    /// 0 threads: one per core.
    explicit Context(int threads = 0) {
        mw_context *handle = nullptr;
        detail::check(mw_context_create(threads, &handle));
        handle_.reset(handle);
    }
    int threads() const noexcept { return mw_context_threads(handle_.get()); }
    /// Log lines go to `log`, one at a time, on any thread. Exceptions that leave it are dropped.
    void set_log(Log log, std::int32_t max_level = MW_LOG_INFO) {
        std::unique_ptr<Log> kept(log ? new Log(std::move(log)) : nullptr);
        detail::check(mw_context_set_log(handle_.get(), kept ? &Context::write : nullptr, kept.get(), max_level));
        log_ = std::move(kept);
    }
    mw_context *get() const noexcept { return handle_.get(); }

private:
    static void write(void *user, std::int32_t level, const char *text) {
        try {
            (*static_cast<Log *>(user))(level, text);
        } catch (...) { // a log that fails must not end the work
        }
    }
    std::unique_ptr<Log> log_; // outlives the handle, which is declared after it
    detail::Owner<mw_context, mw_context_destroy> handle_;
};

/// Where an image lies: spacing and origin in mm, direction 3 x 3 row-major with the axes as columns.
struct Geometry {
    std::array<double, 3> spacing;
    std::array<double, 3> origin;
    std::array<double, 9> direction;
    std::int32_t space;
    Geometry() : spacing{{1, 1, 1}}, origin{{0, 0, 0}}, direction{{1, 0, 0, 0, 1, 0, 0, 0, 1}}, space(MW_SPACE_LPS) {}
};

/// An image.
class Image {
public:
    explicit Image(mw_image *handle) : handle_(handle) {}
    /// Packed voxels, i fastest. MW_BORROW: the array stays alive and unchanged as long as this image.
    template <class T>
    Image(const Context &context, const T *voxels, const std::array<std::int64_t, 3> &dims,
          const Geometry &geometry = Geometry(), std::int32_t borrow = MW_COPY, std::int32_t components = 1) {
        mw_image_desc desc = mw_image_desc();
        desc.struct_size = sizeof desc;
        for (int axis = 0; axis < 3; ++axis) {
            desc.dims[axis] = dims[axis];
            desc.spacing[axis] = geometry.spacing[axis];
            desc.origin[axis] = geometry.origin[axis];
        }
        for (int entry = 0; entry < 9; ++entry) desc.direction[entry] = geometry.direction[entry];
        desc.data = voxels;
        desc.type = detail::TypeOf<T>::value;
        desc.borrow = borrow;
        desc.space = geometry.space;
        desc.components = components;
        create(context, desc);
    }
    Image(const Context &context, const mw_image_desc &desc) { create(context, desc); }
    static Image read(const Context &context, const std::string &path) {
        mw_image *handle = nullptr;
        detail::check(mw_image_read(context.get(), path.c_str(), &handle));
        return Image(handle);
    }
    void write(const std::string &path) const { detail::check(mw_image_write(get(), path.c_str())); }
    mw_image_desc describe() const {
        mw_image_desc desc = mw_image_desc();
        desc.struct_size = sizeof desc;
        detail::check(mw_image_describe(get(), &desc));
        return desc;
    }
    mw_image *get() const noexcept { return handle_.get(); }

private:
    void create(const Context &context, const mw_image_desc &desc) {
        mw_image *handle = nullptr;
        detail::check(mw_image_create(context.get(), &desc, &handle));
        handle_.reset(handle);
    }
    detail::Owner<mw_image, mw_image_destroy> handle_;
};

/// A finished mesh. All views are valid as long as the mesh.
class Mesh {
public:
    explicit Mesh(mw_mesh *handle) : handle_(handle) {}
    static Mesh read(const Context &context, const std::string &path) {
        mw_mesh *handle = nullptr;
        detail::check(mw_mesh_read(context.get(), path.c_str(), &handle));
        return Mesh(handle);
    }
    /// `options` as in mw_mesh_write.
    void write(const std::string &path, const std::string &options = std::string()) const {
        detail::check(mw_mesh_write(get(), path.c_str(), options.c_str()));
    }
    std::size_t point_count() const noexcept { return static_cast<std::size_t>(mw_mesh_point_count(get())); }
    std::size_t cell_count() const noexcept { return static_cast<std::size_t>(mw_mesh_cell_count(get())); }
    /// point_count x 3 coordinates, mm.
    View<double> points() const noexcept { return View<double>(mw_mesh_points(get()), 3 * point_count()); }
    /// cell_count x 4 point indices; empty when the mesh has other cells than tetrahedra.
    View<std::int32_t> tets() const noexcept {
        const std::int32_t *tets = mw_mesh_tets(get());
        return View<std::int32_t>(tets, tets ? 4 * cell_count() : 0);
    }
    View<std::uint8_t> cell_types() const noexcept { return View<std::uint8_t>(mw_mesh_cell_types(get()), cell_count()); }
    View<std::int64_t> offsets() const noexcept { return View<std::int64_t>(mw_mesh_offsets(get()), cell_count() + 1); }
    View<std::int32_t> connectivity() const noexcept {
        const View<std::int64_t> ends = offsets();
        return View<std::int32_t>(mw_mesh_connectivity(get()), static_cast<std::size_t>(ends[cell_count()]));
    }
    View<std::int32_t> labels() const noexcept { return View<std::int32_t>(mw_mesh_labels(get()), cell_count()); }
    mw_boundary boundary() const {
        mw_boundary boundary = mw_boundary();
        boundary.struct_size = sizeof boundary;
        detail::check(mw_mesh_boundary(get(), &boundary));
        return boundary;
    }
    /// One number per cell; `measure` as in mw_mesh_quality.
    std::vector<double> quality(const std::string &measure) const {
        std::vector<double> values(cell_count());
        detail::check(mw_mesh_quality(get(), measure.c_str(), values.data(), static_cast<std::int64_t>(values.size())));
        return values;
    }
    /// Throws when the mesh is not valid.
    void check() const { detail::check(mw_mesh_check(get())); }
    mw_mesh *get() const noexcept { return handle_.get(); }

private:
    detail::Owner<mw_mesh, mw_mesh_destroy> handle_;
};

/// A surface triangulation.
class Surface {
public:
    explicit Surface(mw_surface *handle) : handle_(handle) {}
    /// Rows of 3 coordinates, rows of 3 indices, and where wanted a patch number per triangle.
    Surface(const Context &context, const std::vector<double> &points, const std::vector<std::int32_t> &triangles,
            const std::vector<std::int32_t> &patches = std::vector<std::int32_t>()) {
        if (points.size() % 3 || triangles.size() % 3 || (!patches.empty() && 3 * patches.size() != triangles.size()))
            throw Error(MW_E_ARG, "points and triangles come in rows of three, patches one per triangle");
        mw_surface *handle = nullptr;
        detail::check(mw_surface_create(context.get(), static_cast<std::int64_t>(points.size() / 3), points.data(),
                                        static_cast<std::int64_t>(triangles.size() / 3), triangles.data(),
                                        patches.empty() ? nullptr : patches.data(), &handle));
        handle_.reset(handle);
    }
    static Surface read(const Context &context, const std::string &path) {
        mw_surface *handle = nullptr;
        detail::check(mw_surface_read(context.get(), path.c_str(), &handle));
        return Surface(handle);
    }
    void set_patch(std::int32_t patch, const std::string &role, const std::string &name = std::string()) {
        detail::check(mw_surface_set_patch(get(), patch, role.c_str(), name.c_str()));
    }
    void add_region(const std::array<double, 3> &point, std::int32_t label, double size = 0.0) {
        detail::check(mw_surface_add_region(get(), point.data(), label, size));
    }
    void add_hole(const std::array<double, 3> &point) { detail::check(mw_surface_add_hole(get(), point.data())); }
    mw_surface *get() const noexcept { return handle_.get(); }

private:
    detail::Owner<mw_surface, mw_surface_destroy> handle_;
};

/// Element sizes for a surface job.
class Sizing {
public:
    /// The largest edge length wanted at a point, given the one wanted so far. Called from several threads at once.
    using Function = std::function<double(const std::array<double, 3> &point, double size)>;

    explicit Sizing(const Context &context) : function_(std::make_shared<Callback>()) {
        mw_sizing *handle = nullptr;
        detail::check(mw_sizing_create(context.get(), &handle));
        handle_.reset(handle);
    }
    void add_point(const std::array<double, 3> &p, double size, double decay) {
        add(MW_SOURCE_POINT, p.data(), 3, size, decay);
    }
    void add_line(const std::array<double, 3> &a, const std::array<double, 3> &b, double size, double decay) {
        const double numbers[] = {a[0], a[1], a[2], b[0], b[1], b[2]};
        add(MW_SOURCE_LINE, numbers, 6, size, decay);
    }
    void add_box(const std::array<double, 3> &low, const std::array<double, 3> &high, double size, double decay) {
        const double numbers[] = {low[0], low[1], low[2], high[0], high[1], high[2]};
        add(MW_SOURCE_BOX, numbers, 6, size, decay);
    }
    void add_sphere(const std::array<double, 3> &center, double radius, double size, double decay) {
        const double numbers[] = {center[0], center[1], center[2], radius};
        add(MW_SOURCE_SPHERE, numbers, 4, size, decay);
    }
    void set_function(Function function) {
        std::shared_ptr<Callback> callback = std::make_shared<Callback>();
        callback->function = std::move(function);
        const mw_size_fn trampoline = callback->function ? &Sizing::evaluate : nullptr;
        detail::check(mw_sizing_set_function(get(), trampoline, callback.get()));
        function_ = callback;
    }
    void set_background(const Mesh &mesh, const std::vector<double> &sizes) {
        const std::int64_t count = static_cast<std::int64_t>(sizes.size());
        detail::check(mw_sizing_set_background(get(), mesh.get(), sizes.data(), count));
    }
    mw_sizing *get() const noexcept { return handle_.get(); }

private:
    friend class Job;
    struct Callback {
        Function function;
        std::mutex mutex;
        std::exception_ptr thrown;
    };
    static double evaluate(void *user, const double *point, double size) {
        Callback &callback = *static_cast<Callback *>(user);
        try {
            return callback.function(std::array<double, 3>{{point[0], point[1], point[2]}}, size);
        } catch (...) {
            std::lock_guard<std::mutex> lock(callback.mutex);
            if (!callback.thrown) callback.thrown = std::current_exception();
            return std::numeric_limits<double>::quiet_NaN(); // ends the run
        }
    }
    void add(std::int32_t kind, const double *numbers, std::int32_t count, double size, double decay) {
        detail::check(mw_sizing_add_source(get(), kind, numbers, count, size, decay));
    }
    std::shared_ptr<Callback> function_; // shared with the jobs that use it
    detail::Owner<mw_sizing, mw_sizing_destroy> handle_;
};

/// One mesher or one registration.
class Job {
public:
    /// Returns whether to go on.
    using Progress = std::function<bool(const std::string &stage, double done)>;

    Job(const Context &context, std::int32_t kind) : callback_(new Callback) {
        mw_job *handle = nullptr;
        detail::check(mw_job_create(context.get(), kind, &handle));
        handle_.reset(handle);
    }
    void set(const std::string &slot, const Image &image) {
        detail::check(mw_job_set_image(get(), slot.c_str(), image.get()));
    }
    void set(const std::string &slot, const Surface &surface) {
        detail::check(mw_job_set_surface(get(), slot.c_str(), surface.get()));
    }
    void set(const std::string &slot, const Sizing &sizing) {
        detail::check(mw_job_set_sizing(get(), slot.c_str(), sizing.get()));
        sizing_ = sizing.function_;
    }
    void set(const std::string &slot, const Mesh &mesh) {
        detail::check(mw_job_set_mesh(get(), slot.c_str(), mesh.get()));
    }
    void set_points(const std::string &slot, const std::vector<double> &points) {
        if (points.size() % 3) throw Error(MW_E_ARG, "points come in rows of three");
        const std::int64_t count = static_cast<std::int64_t>(points.size() / 3);
        detail::check(mw_job_set_points(get(), slot.c_str(), count, points.data()));
    }
    void set_transform(const std::string &slot, const std::array<double, 16> &matrix, std::int32_t space) {
        detail::check(mw_job_set_transform(get(), slot.c_str(), matrix.data(), space));
    }
    void set(const std::string &name, double value) { detail::check(mw_job_set_f64(get(), name.c_str(), value)); }
    void set(const std::string &name, int value) { detail::check(mw_job_set_i64(get(), name.c_str(), value)); }
    void set(const std::string &name, long value) { detail::check(mw_job_set_i64(get(), name.c_str(), value)); }
    void set(const std::string &name, bool value) { detail::check(mw_job_set_i64(get(), name.c_str(), value)); }
    void set(const std::string &name, const char *value) { detail::check(mw_job_set_str(get(), name.c_str(), value)); }
    void set(const std::string &name, const std::string &value) { set(name, value.c_str()); }
    void set_for(const std::string &name, std::int64_t label, double value) {
        detail::check(mw_job_set_f64_for(get(), name.c_str(), label, value));
    }
    void set_progress(Progress progress) {
        detail::check(mw_job_set_progress(get(), progress ? &Job::report : nullptr, callback_.get()));
        callback_->progress = std::move(progress);
    }
    void set_time_limit(double seconds) { detail::check(mw_job_set_time_limit(get(), seconds)); }

    /// Throws mw::Error with the findings, or what a callback threw.
    void run() {
        const mw_status status = mw_job_run(get());
        const std::string text = mw_last_error();
        if (callback_->thrown) std::rethrow_exception(take(callback_->thrown));
        if (sizing_ && sizing_->thrown) std::rethrow_exception(take(sizing_->thrown));
        if (status != MW_OK) throw Error(status, detail::message(status, text), findings());
    }
    /// From any thread.
    void cancel() noexcept { mw_job_cancel(get()); }

    Mesh mesh() const {
        mw_mesh *handle = nullptr;
        detail::check(mw_job_take_mesh(get(), &handle));
        return Mesh(handle);
    }
    Mesh mesh(const std::string &name) const {
        mw_mesh *handle = nullptr;
        detail::check(mw_job_take_named_mesh(get(), name.c_str(), &handle));
        return Mesh(handle);
    }
    Image image(const std::string &name) const {
        mw_image *handle = nullptr;
        detail::check(mw_job_take_image(get(), name.c_str(), &handle));
        return Image(handle);
    }
    double stat(const std::string &name) const {
        double value = 0.0;
        detail::check(mw_job_stat(get(), name.c_str(), &value));
        return value;
    }
    std::vector<std::pair<std::string, double>> stats() const {
        std::vector<std::pair<std::string, double>> all;
        for (std::int64_t index = 0; index < mw_job_stat_count(get()); ++index) {
            mw_stat stat = mw_stat();
            stat.struct_size = sizeof stat;
            detail::check(mw_job_stat_get(get(), index, &stat));
            all.emplace_back(stat.name, stat.value);
        }
        return all;
    }
    std::vector<Finding> findings() const {
        std::vector<Finding> all;
        const std::int64_t count = mw_job_diag_count(get());
        for (std::int64_t index = 0; index < count; ++index) {
            mw_diag diag = mw_diag();
            diag.struct_size = sizeof diag;
            detail::check(mw_job_diag_get(get(), index, &diag));
            const Finding finding = {diag.code, diag.severity, {{diag.id[0], diag.id[1]}},
                                     {{diag.xyz[0], diag.xyz[1], diag.xyz[2]}}, diag.text};
            all.push_back(finding);
        }
        return all;
    }
    mw_job *get() const noexcept { return handle_.get(); }

private:
    struct Callback {
        Progress progress;
        std::exception_ptr thrown;
    };
    static std::exception_ptr take(std::exception_ptr &thrown) {
        std::exception_ptr taken;
        std::swap(taken, thrown);
        return taken;
    }
    static std::int32_t report(void *user, const char *stage, double done) {
        Callback &callback = *static_cast<Callback *>(user);
        try {
            return callback.progress(stage, done) ? 0 : 1;
        } catch (...) {
            callback.thrown = std::current_exception();
            return 1;
        }
    }
    std::unique_ptr<Callback> callback_;
    std::shared_ptr<Sizing::Callback> sizing_;
    detail::Owner<mw_job, mw_job_destroy> handle_;
};

} // namespace mw

#endif
