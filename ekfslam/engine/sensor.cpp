#include "sensor.hpp"

#include <cmath>

#include "se3.hpp"

namespace ekfslam {

namespace {

// Share of the squared motion of a track's other rows that counts for a row.
constexpr double ACROSS = 0.35;
// Depth below which a point of one camera is one of a turn that is taken for a motion.
constexpr double NEAREST_M = 0.1;

// Unit vector along which a pixel lies.
Vector3 ray(const Sensor& sensor, const Vector3& rows) {
    return Vector3((rows[0] - sensor.cu_px) / sensor.fu_px, (rows[1] - sensor.cv_px) / sensor.fv_px, 1.0).normalized();
}

}  // namespace

Sensor Sensor::calibrated(const Parameters& parameters) const {
    Sensor out = *this;
    out.baseline_m *= std::exp(parameters[LOG_BASELINE]);
    out.T_cam_imu = se3::exp(parameters.head<6>()) * T_cam_imu;
    out.disparity_offset_px += parameters[DISPARITY_OFFSET];
    return out;
}

std::vector<int> Sensor::screen(const Matrix& measured) const {
    std::vector<int> reason(measured.cols(), ACCEPTED);
    if (type == monocular) return reason;
    for (Index i = 0; i < measured.cols(); ++i)
        if (measured(0, i) <= measured(2, i)) reason[i] = DISPARITY;
    return reason;
}

Matrix Sensor::rows(const Matrix& measured) const {
    if (type == monocular) return measured.topRows(2);
    Matrix out(3, measured.cols());
    out.row(0) = measured.row(0);
    out.row(1) = weight_left * measured.row(1) + (1.0 - weight_left) * measured.row(3);
    out.row(2) = measured.row(2);
    if (sees_disparity) out.row(2) = measured.row(0) - measured.row(2);
    return out;
}

Matrix Sensor::variance(Index count) const { return variance_px2.head(dimension()).replicate(1, count); }

Vector3 Sensor::predict(const Vector3& q) const {
    const double u = fu_px * (q.x() / q.z()) + cu_px, v = fv_px * (q.y() / q.z()) + cv_px;
    const double disparity = fu_px * baseline_m / q.z() + disparity_offset_px;
    return {u, v, sees_disparity ? disparity : u - disparity};
}

Matrix3 Sensor::jacobian(const Vector3& q) const {
    const double by_depth = 1.0 / q.z(), square = by_depth * by_depth;
    Matrix3 A = Matrix3::Zero();
    A(0, 0) = fu_px * by_depth;
    A(0, 2) = -fu_px * q.x() * square;
    A(1, 1) = fv_px * by_depth;
    A(1, 2) = -fv_px * q.y() * square;
    A(2, 2) = -fu_px * baseline_m * square;
    if (!sees_disparity) A.row(2) = A.row(0) - A.row(2);
    return A;
}

Vector3 Sensor::invert(const Vector3& rows) const {
    const double disparity = (sees_disparity ? rows[2] : rows[0] - rows[2]) - disparity_offset_px;
    const double z = fu_px * baseline_m / disparity;
    return {(rows[0] - cu_px) / fu_px * z, (rows[1] - cv_px) / fv_px * z, z};
}

Sensor::Triangulated Sensor::triangulate(const Vector3& rows_anchor, const Vector3& rows,
                                         const Matrix4& T_now_anchor) const {
    const Vector3 a = se3::rotation(T_now_anchor) * ray(*this, rows_anchor), b = ray(*this, rows);
    const Vector3 origin = se3::translation(T_now_anchor);
    const double cosine = a.dot(b), sine_square = std::max(1.0 - cosine * cosine, std::numeric_limits<double>::min());
    // Depths s along a (from the anchor) and t along b of the two nearest points.
    const double s = (cosine * b.dot(origin) - a.dot(origin)) / sine_square;
    const double t = (b.dot(origin) - cosine * a.dot(origin)) / sine_square;
    const double least = std::sin(parallax_rad);
    return {0.5 * (origin + s * a + t * b), sine_square > least * least && s > NEAREST_M && t > NEAREST_M};
}

Vector3 TrackError::step_variance(const Vector3& motion_px, double parallax_seen, Index frames) const {
    const auto count = static_cast<double>(frames);
    const Vector3 square = (motion_px / count).cwiseAbs2();
    const Vector3 flow = (1.0 - ACROSS) * square + Vector3::Constant(ACROSS * square.sum());
    const double by_parallax = parallax_seen / count / parallax;
    const Vector3 growth = flow / (flow_px * flow_px) + Vector3::Constant(1.0 + by_parallax * by_parallax);
    return count * walk_std.cwiseAbs2().cwiseProduct(growth);
}

Vector3 TrackError::absolute_variance(Index age) const {
    return first_std.cwiseAbs2() + static_cast<double>(age) * walk_std.cwiseAbs2();
}

}  // namespace ekfslam
