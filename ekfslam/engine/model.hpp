// Landmarks as the sensor sees them: models/observer.py, filters/observing.py, and the views of prediction.py.
#pragma once

#include "estimate.hpp"

namespace ekfslam {

// The camera of the present frame for single observations or for differences, eq. (9) and (11).
Matrix4 camera_pose(const Estimate& e, const Values& values, const Vector6& imu_twist, bool is_difference);
View camera(const Estimate& e, const Mean& at, bool is_difference);

// Start of a prediction: the view becomes that of the frame before; `updated` follows it.
void close_views(Estimate& e);
// End of a prediction, before the first update, and when `imu_twist` has been corrected for a time offset:
// view <- W(values), z <- Y x.
void open_views(Estimate& e);

// Every block after a correction (body, ...): poses by exp(d) T, the view of this frame by its camera.
Values retract_values(const Estimate& e, const Vector& correction);

// The calibrated sensor, and the derivative of its third row by the parameters in front of the leading columns.
struct Intrinsics {
    Sensor sensor;
    Index log_baseline = -1, disparity = -1;  // leading columns; -1: the parameter is not free

    Intrinsics(const Estimate& e, const Values& values);
    bool is_free() const { return log_baseline >= 0 || disparity >= 0; }
    // by += factor (d row / d parameters), for a point q in the camera frame.
    void add(const Vector3& q, double factor, Eigen::Ref<Vector> by) const;
};

// Landmarks as predicted: points in the camera of their rows (3, k), derivative (3, k d) of a single observation by the
// landmark, and the linearised rows of measurements (d, k). A row that follows another one is their difference, eq.
// (10).
struct Observed {
    Matrix q, H_m;
    Rows rows;
};
Observed observe(const Estimate& e, const Mean& at, const Slots& slots, const Matrix& measured);

}  // namespace ekfslam
