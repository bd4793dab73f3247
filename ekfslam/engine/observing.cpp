#include <algorithm>

#include "model.hpp"
#include "se3.hpp"

namespace ekfslam {

namespace {

// A camera in which rows are taken: its pose W = T_cam_world, and the first of its six leading columns.
struct Seer {
    Matrix4 W;
    Index at;
};

// Adds rows of points and their derivatives over the leading columns.
struct Writer {
    Intrinsics intrinsics;
    Index d;

    Writer(const Estimate& e, const Values& values) : intrinsics(e, values), d(e.sensor.dimension()) {}

    // Add the derivatives of observation i of a landmark m, times a sign, and its residual; return q. Eq. (3), (4).
    Vector3 add(const Seer& seer, const Vector3& m, Index i, double sign, Rows& rows) const {
        const Sensor& sensor = intrinsics.sensor;
        const Vector3 q = se3::apply(seer.W, m);
        const Matrix3 A = sign * sensor.jacobian(q), by_landmark = A * se3::rotation(seer.W);
        const Matrix36 by_view = A * se3::by_frame(q);
        rows.residual.col(i) -= sign * sensor.predict(q).head(d);
        rows.H_x.block(seer.at, i * d, 6, d) += by_view.topRows(d).transpose();
        rows.H_m.middleCols(i * d, d) += by_landmark.topRows(d).transpose();
        if (intrinsics.is_free()) intrinsics.add(q, sign, rows.H_x.col(i * d + 2));
        return q;
    }
};

Rows blank(const Slots& slots, const Matrix& measured, Index lead) {
    const Index n = measured.size();
    return {slots, Matrix::Zero(lead, n), Matrix::Zero(3, n), measured, Matrix(measured.rows(), measured.cols())};
}

}  // namespace

Intrinsics::Intrinsics(const Estimate& e, const Values& values) : sensor(e.sensor.calibrated(values.calibration())) {
    const Slots& front = e.columns.front;
    for (const Block& block : e.blocks) {
        for (Index j = 0; j < size_of(block.free); ++j) {
            const auto found = std::find(front.begin(), front.end(), block.at + j);
            if (block.free[j] == LOG_BASELINE) log_baseline = found - front.begin();
            if (block.free[j] == DISPARITY_OFFSET) disparity = found - front.begin();
        }
    }
}

void Intrinsics::add(const Vector3& q, double factor, Eigen::Ref<Vector> by) const {
    if (log_baseline >= 0) by[log_baseline] += factor * sensor.by_log_baseline(q);
    if (disparity >= 0) by[disparity] += factor * sensor.by_disparity();
}

Observed observe(const Estimate& e, const Mean& at, const Slots& slots, const Matrix& measured) {
    const Writer writer(e, at.values);
    const Lead lead = e.gaussian.lead();
    const Index k = measured.cols(), d = writer.d;
    const Seer alone{camera_pose(e, at.values, at.imu_twist, false), lead.view};
    const Seer drifted = e.drifted ? Seer{camera_pose(e, at.values, at.imu_twist, true), lead.drifted} : alone;
    const bool has_before = e.track_error && e.columns.previous >= 0 && lead.previous >= 0;
    const Seer before{has_before ? at.values.previous() : Matrix4::Identity(), lead.previous};
    Observed out{Matrix(3, k), Matrix(3, k * d), blank(slots, measured, lead.width)};
    Rows& rows = out.rows;
    if (!e.track_error) rows.variance = e.sensor.variance(k);
    for (Index i = 0; i < k; ++i) {
        const Index slot = slots[i];
        const auto s = slot;
        const Vector3 m = at.position_m.col(slot);
        const bool is_difference = e.track_error && e.table.last_step[s] == e.step - 1;
        const Vector3 q = writer.add(is_difference ? drifted : alone, m, i, 1.0, rows);
        out.q.col(i) = q;
        out.H_m.middleCols(i * d, d) = rows.H_m.middleCols(i * d, d);
        if (!e.track_error) continue;
        if (!is_difference) {
            const Index age = e.step - static_cast<Index>(e.table.first_step[s]);
            rows.variance.col(i) = e.track_error->absolute_variance(age).head(d);
            continue;
        }
        if (!has_before) throw Error("an observation follows another one, but no view of the frame before exists");
        writer.add(before, m, i, -1.0, rows);  // eq. (10)
        rows.residual.col(i) -= e.table.seen_rows.col(slot);
        Vector3 motion = Vector3::Zero();
        motion.head(d) = measured.col(i) - e.table.seen_rows.col(slot);
        const double parallax = e.motion.way_m / std::max(q.z(), e.config.min_depth_m);
        rows.variance.col(i) = e.track_error->step_variance(motion, parallax).head(d);
    }
    return out;
}

}  // namespace ekfslam
