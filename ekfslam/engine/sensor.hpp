// Sensors of landmarks and the error of tracks: ekfslam/models/sensors and `TrackError` of ekfslam/data/noise.py.
#pragma once

#include <limits>

#include "types.hpp"

namespace ekfslam {

// Outcomes of an observation: the codes of ekfslam.models.sensors.base.
enum Reason : int { ACCEPTED = -1, GATE = 0, DISPARITY = 1, ABSENT = 2, BEHIND_CAMERA = 3, MOVING = 4, WAITING = 5 };

using Parameters = Eigen::Matrix<double, 9, 1>;  // of a calibration: extrinsic (6), ln baseline, disparity, time
enum Parameter : Index { EXTRINSIC = 0, LOG_BASELINE = 6, DISPARITY_OFFSET = 7, TIME_OFFSET = 8 };

// A rectified stereo rig, or its left camera alone. Rows of one point are Vector3 and Matrix3 for both; one camera has
// the first two of them.
struct Sensor {
    enum Type { rig, monocular } type = rig;
    double fu_px = 1, fv_px = 1, cu_px = 0, cv_px = 0, baseline_m = 1, disparity_offset_px = 0;
    double least_disparity_px = 0.5;  // of a point with a depth
    bool sees_disparity = false;      // rows (u, v, disparity) instead of (u, v, right u)
    double weight_left = 0.5;         // of the left v in the row v
    Matrix4 T_cam_imu = Matrix4::Identity();
    Vector3 variance_px2 = Vector3::Ones();  // white, of the rows
    double parallax_rad = 0.2;               // monocular: angle between two rays that locates a landmark
    Index patience = 40;                     // monocular: frames after which the anchor moves on

    Index dimension() const { return type == rig ? 3 : 2; }
    double furthest_m() const {
        return type == rig ? fu_px * baseline_m / least_disparity_px : std::numeric_limits<double>::infinity();
    }
    // The rig with parameters applied, all but the time offset.
    Sensor calibrated(const Parameters& parameters) const;

    // Reason codes of measurements (4 or 2, n), judged from them alone; their rows (d, n), and white variances (d, n).
    std::vector<int> screen(const Matrix& measured) const;
    Matrix rows(const Matrix& measured) const;
    Matrix variance(Index count) const;

    bool in_view(const Vector3& q, double min_depth_m) const { return q.z() > min_depth_m; }
    // Whether an inverted point is in front of the rig and near enough to have a depth.
    bool has_depth(const Vector3& q) const { return q.z() > 0 && q.z() < furthest_m(); }
    Vector3 predict(const Vector3& q) const;
    Matrix3 jacobian(const Vector3& q) const;                            // d rows / d q
    double by_disparity() const { return sees_disparity ? 1.0 : -1.0; }  // of the third row, as the next one
    double by_log_baseline(const Vector3& q) const { return by_disparity() * (fu_px * baseline_m / q.z()); }
    Vector3 invert(const Vector3& rows) const;

    // Monocular: the middle of the shortest line between two rays, and whether their parallax suffices.
    struct Triangulated {
        Vector3 q;
        bool is_ready;
    };
    Triangulated triangulate(const Vector3& rows_anchor, const Vector3& rows, const Matrix4& T_now_anchor) const;
};

// Error of a track in the image, eq. (10): it starts with the track and then walks.
struct TrackError {
    Vector3 first_std = Vector3::Zero(), walk_std = Vector3::Zero();
    double flow_px = std::numeric_limits<double>::infinity(), parallax = std::numeric_limits<double>::infinity();

    // Of a difference from some frames before: motion of the rows, and way of the camera over the depth.
    Vector3 step_variance(const Vector3& motion_px, double parallax_seen, Index frames = 1) const;
    // Of an observation without a predecessor in the frame before, by the age of the track in frames.
    Vector3 absolute_variance(Index age) const;
};

}  // namespace ekfslam
