// The state of the filter: model as data, values of blocks, landmark table, covariance; and what acts on it.
#pragma once

#include <functional>

#include "gaussian.hpp"
#include "types.hpp"

namespace ekfslam {

enum class Kind { vector, pose, direction, calibration };  // retraction: x + d, exp(d) T, exp(d) u, x[free] + d
enum class Variant { invariant, standard };
// Outcomes of an observation: the codes of ekfslam.models.sensors.base.
enum Reason : int { ACCEPTED = -1, GATE = 0, DISPARITY = 1, ABSENT = 2, BEHIND_CAMERA = 3, MOVING = 4, WAITING = 5 };

struct Block {
    std::string name;
    Kind kind = Kind::vector;
    Index at = 0, size = 0;              // columns
    Index value_at = 0, value_size = 0;  // place in Estimate::values; poses are 16 numbers, row-major
    bool moves_camera = false;
    double share = 0.0, share_of_difference = 0.0;  // of the present frame, set by each prediction
    std::vector<Index> free;                        // of a calibration: indices among its nine parameters
};

struct Sensor {
    enum { rig, monocular } kind = rig;
    double fu = 1, fv = 1, cu = 0, cv = 0, baseline = 1, disparity_offset = 0, furthest = 0;
    bool sees_disparity = false;  // rows (u, v, disparity) instead of (u, v, right u)
    Matrix4 T_cam_imu = Matrix4::Identity();
    Vector variance;                                // white, of the rows
    double parallax_rad = 0.2; Index patience = 0;  // monocular
    Index dimension() const { return kind == rig ? 3 : 2; }
};

// ekfslam.data.noise.TrackError as data: see absolute_variance and step_variance there.
struct TrackError;

struct Config {
    Variant variant = Variant::invariant;
    bool image_coordinates = true;
    double gate = 0, gate_probability = 1, min_depth_m = 0.1;
    double moving_sigma = 1.5, moving_share = 0.05;
    Index retire_after = 1, misses_to_split = 0;
    Index dormant = 0;  // -1: never retire
    double input_gate = 0, doubt = 30;
};

struct Table {  // one entry a landmark, columns as in filters/landmarks.py
    Ids id, first_frame, last_frame, observations, misses, log_row, stay_until, first_step, last_step, last_observation,
        asleep;
    Matrix position_m, initial_m, evidence, seen_rows;  // (3, n), (3, n), (2, n), (d, n)
    Index size() const { return static_cast<Index>(id.size()); }
};

// The last prediction, set by Python: filters/estimate.py Motion.
struct Motion {
    Matrix4 T_departed = Matrix4::Identity(), T_predicted = Matrix4::Identity();
    double tau_s = 0, way_m = 0, doubt = 1;
    Matrix Q;  // (body, body)
    bool has_last = false;
    Matrix4 moved_last = Matrix4::Identity();
    double tau_last_s = 0;
};

// Which view landmarks refer to: that of this frame, that of the frame before, or none (xyz in world).
enum class Updated { none, view, previous };
}  // namespace ekfslam
