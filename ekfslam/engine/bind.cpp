// The Python module `ekfslam.engine._engine`.
#include "alignment.hpp"
#include "binding.hpp"
#include "blas.hpp"
#include "lapack.hpp"

#if defined(__GLIBC__)
#include <malloc.h>
#endif

using namespace ekfslam;
using namespace ekfslam::binding;

namespace {

lapack::Found find(const char* module, const char* name) {
    const nb::dict routines = nb::module_::import_(module).attr("__pyx_capi__");
    if (!routines.contains(name)) return {};
    const nb::object capsule = routines[name];
    const char* signature = PyCapsule_GetName(capsule.ptr());
    return {PyCapsule_GetPointer(capsule.ptr(), signature), signature};
}

// Matrices of a frame come and go. What glibc may return to the system at once costs a fifth of the frame in page
// faults.
void keep_memory() {
#if defined(__GLIBC__)
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 64 << 20);
#endif
}

// Arrays of `geometry.stereo_motion.Alignment`, matrices flat; camera (fu, fv, cu, cv, b).
nb::tuple aligned(const Eigen::Matrix<double, 5, 1>& camera, const Alignment::Points& before,
                  const Alignment::Points& now, const Matrix4& first, double std_px, double scale) {
    if (before.rows() != now.rows()) throw nb::value_error("rows before and now must be those of the same points");
    Sensor rig;
    rig.fu_px = camera[0], rig.fv_px = camera[1], rig.cu_px = camera[2], rig.cv_px = camera[3];
    rig.baseline_m = camera[4];
    const Alignment found = align(rig, before, now, first, std_px, scale);
    return nb::make_tuple(found.T, found.true_px, found.residual_px, found.H, found.B, found.W);
}

}  // namespace

NB_MODULE(_engine, module) {
    module.doc() = "The filter in C++; `ekfslam.engine` is its face.";
    try {
        lapack::load(&find);
    } catch (const std::runtime_error& error) {
        throw nb::import_error(error.what());
    }
    keep_memory();
    bind_filter(module);
    module.def("align", &aligned, arg("camera"), arg("before_px"), arg("now_px"), arg("T_now_before"), arg("std_px"),
               arg("scale"), "Align two frames of a stereo rig.");
    module.def(
        "flops", [] { return blas::flops(); },
        "Return the number of floating point operations of BLAS and LAPACK in this thread so far.");
}
