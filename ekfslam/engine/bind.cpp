// The Python module `ekfslam.engine._engine`.
#include "alignment.hpp"
#include "binding.hpp"
#include "blas.hpp"
#include "lapack.hpp"

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

Matrix cholesky(Matrix P) {
    if (P.rows() != P.cols()) throw nb::value_error("P must be square");
    char uplo = 'L';
    int n = static_cast<int>(P.rows()), lda = n > 0 ? n : 1, info = 0;
    lapack::dpotrf(&uplo, &n, P.data(), &lda, &info);
    if (info != 0) throw nb::value_error("P is not positive definite");
    return P.triangularView<Eigen::Lower>();
}

// Arrays of `geometry.stereo_motion.Alignment`, matrices flat; camera (fu, fv, cu, cv, b).
nb::tuple aligned(const Eigen::Matrix<double, 5, 1>& camera, const Alignment::Points& before,
                  const Alignment::Points& now, const Matrix4& first, double std_px, double scale) {
    if (before.rows() != now.rows()) throw nb::value_error("rows before and now must be those of the same points");
    const Alignment found =
        align({camera[0], camera[1], camera[2], camera[3], camera[4]}, before, now, first, std_px, scale);
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
    bind_gaussian(module);
    bind_gates(module);
    bind_filter(module);
    module.def("cholesky", &cholesky, arg("P"), "Return the lower Cholesky factor of a covariance.");
    module.def("align", &aligned, arg("camera"), arg("before_px"), arg("now_px"), arg("T_now_before"), arg("std_px"),
               arg("scale"), "Align two frames of a stereo rig.");
    module.def(
        "flops", [] { return blas::flops(); },
        "Return the number of floating point operations of BLAS and LAPACK in this thread so far.");
    bind_model(module);
}
