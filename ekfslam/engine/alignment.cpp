// Motion of a stereo rig between two frames: the function `align` of ekfslam/geometry/stereo_motion.py, whose equations
// and symbols these are.
#include "alignment.hpp"

#include <limits>

#include "se3.hpp"

namespace ekfslam {
namespace {

constexpr double least_depth_m = 0.1, track_std_px = 0.3, fits = 9.0, converged = 1e-4;
constexpr int iterations = 12;

}  // namespace

void Alignment::linearise(const Sensor& camera, const Points& before, const Points& now, double std_px, double scale) {
    information.setZero();
    gradient.setZero();
    const Matrix3 R = se3::rotation(T), I = Matrix3::Identity();
    const double variance = std_px * std_px, track = track_std_px * track_std_px;
    for (Index i = 0; i < before.rows(); ++i) {
        const Vector3 z = true_px.row(i), z_before = before.row(i), z_now = now.row(i);
        const double disparity = z[0] - z[2];
        const Vector3 q_before = camera.invert(z);
        Vector3 q = se3::apply(T, q_before);
        const bool is_ahead = q.z() > least_depth_m;
        // A disparity moves a point along its ray.
        const Vector3 along = is_ahead ? Vector3((q - se3::translation(T)) / disparity) : Vector3(Vector3::Zero());
        if (!is_ahead) q << 0.0, 0.0, 1.0;
        const Vector3 row = camera.predict(q);
        const Matrix3 by_q = camera.jacobian(q);
        Matrix3 of_rows;
        of_rows << R.col(0) * (q_before.z() / camera.fu_px) - along, R.col(1) * (q_before.z() / camera.fv_px), along;
        const Matrix36 by_xi = by_q * se3::by_frame(q);
        const Matrix3 by_rows = by_q * of_rows;
        const Vector3 r = z_now - row - by_rows * (z_before - z), k = I.col(2) - by_rows.col(2);
        const Matrix3 S = variance * (I + by_rows * by_rows.transpose()) + track * k * k.transpose(),
                      inverse = S.inverse();
        const Vector3 finite = is_ahead ? r : Vector3(Vector3::Zero()), Wr = inverse * finite;
        const double squared = finite.dot(Wr) / 3.0, root = 1.0 / (1.0 + squared / (scale * scale));
        const Matrix3 weighted = inverse * (is_ahead ? root * root : 0.0);
        Vector3 moved = z_before + variance * (by_rows.transpose() * Wr);
        moved[2] -= track * k.dot(Wr);
        // Rows of an outlier say nothing about each other.
        const bool fit = squared < fits && moved[0] - moved[2] > 0.5 * (z_before[0] - z_before[2]);
        true_px.row(i) = fit ? moved : z_before;
        residual_px.row(i) = is_ahead ? r : Vector3(Vector3::Constant(std::numeric_limits<double>::infinity()));
        const Matrix36 WH = weighted * by_xi;
        information += by_xi.transpose() * WH;
        gradient += WH.transpose() * finite;
        Eigen::Map<Eigen::Matrix<double, 3, 6, Eigen::RowMajor>>(H.row(i).data()) = by_xi;
        Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(B.row(i).data()) = by_rows;
        Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(W.row(i).data()) = weighted;
    }
}

Alignment align(const Sensor& camera, const Alignment::Points& before, const Alignment::Points& now,
                const Matrix4& first, double std_px, double scale) {
    const Index n = before.rows();
    Alignment found{
        first, before, Alignment::Points(n, 3), Alignment::Rows(n, 18), Alignment::Rows(n, 9), Alignment::Rows(n, 9),
        {},    {}};
    found.linearise(camera, before, now, std_px, scale);
    for (int k = 0; k < iterations; ++k) {
        // A weak prior keeps the step finite if too few points are left.
        const Vector6 xi = (found.information + 1e-6 * Matrix6::Identity()).partialPivLu().solve(found.gradient);
        found.T = se3::exp(xi) * found.T;
        found.linearise(camera, before, now, std_px, scale);
        if (xi.cwiseAbs().maxCoeff() < converged) break;
    }
    return found;
}

}  // namespace ekfslam
