// The state of the filter: model as data, values of blocks, landmark table, covariance.
#pragma once

#include <functional>

#include "gaussian.hpp"
#include "sensor.hpp"
#include "types.hpp"

namespace ekfslam {

enum class Kind { vector, pose, direction, calibration };  // retraction: x + d, exp(d) T, exp(d) u, x[free] + d
enum class Variant { invariant, standard };

struct Block {
    std::string name;
    Kind kind = Kind::vector;
    Index at = 0, size = 0;              // columns
    Index value_at = 0, value_size = 0;  // place in Values::flat; poses are 16 numbers, row-major
    bool moves_camera = false;
    double share = 0.0, share_of_difference = 0.0;  // of the present frame, set by each prediction
    Slots free;                                     // of a calibration: indices among its nine parameters
};

struct Config {
    Variant variant = Variant::invariant;
    bool image_coordinates = true;
    double gate = 0, gate_probability = 1, min_depth_m = 0.1;  // threshold for the rows of one landmark
    double waiting_gate = 0;                                   // for the rows that two views leave (monocular)
    double moving_sigma = 1.5, moving_share = 0.05;            // of a track that moves, see moves_along
    bool estimates_velocity = false;                           // `Process.estimates_velocity`
    Index retire_after = 1, misses_to_split = 0;
    Index dormant = 0;                  // landmarks out of view that stay; -1: all
    double input_gate = 0, doubt = 30;  // threshold for inputs, and the factor of the noise of rejected ones
};

struct Table {  // one entry a landmark, columns as in filters/landmarks.py
    Ids id, first_frame, last_frame, observations, misses, log_row, stay_until, first_step, last_step, last_observation,
        asleep;
    Matrix position_m, initial_m, evidence, seen_rows;  // (3, n), (3, n), (2, n), (d, n)
    Index size() const { return size_of(id); }
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

// The view that the observations of the last update have corrected: that of this frame, that of the frame before, or
// none. Landmarks have image coordinates in it, eq. (7').
enum class Updated { none, view, previous };

// Places in Values::flat of blocks by their names; -1: there is none.
struct Places {
    Index pose = -1, view = -1, previous = -1, anchor = -1, calibration = -1;
    Places() = default;
    explicit Places(const std::vector<Block>& blocks);
};

// Values of all blocks.
struct Values {
    Vector flat;
    Places places;

    Matrix4 matrix(Index at) const;
    void set(Index at, const Matrix4& T);
    Matrix4 pose() const { return matrix(places.pose); }
    Matrix4 view() const { return matrix(places.view); }
    Matrix4 previous() const { return matrix(places.previous); }
    Matrix4 anchor() const { return matrix(places.anchor); }
    Parameters calibration() const;  // 0 without the block
};

// Mean at which observations are linearised.
struct Mean {
    Values values;
    Matrix position_m;  // (3, n)
    Vector6 imu_twist;  // velocity of the IMU at the image, for a time offset, eq. (9)
};

// A camera of a frame, T_cam_world = exp(z^) W, with z = Y x.
struct View {
    Matrix4 W;
    Matrix Y;  // (6, body), 0 at views
};

struct Estimate {
    Config config;
    Sensor sensor;  // as given; see Sensor::calibrated
    std::optional<TrackError> track_error;
    std::vector<Block> blocks;
    Columns columns;
    Values values;
    Vector coordinates;                   // (body), as in the log
    Vector6 imu_twist = Vector6::Zero();  // at the last frame
    Table table;
    Gaussian gaussian;
    Motion motion;
    Index step = 0;
    Updated updated = Updated::view;
    bool is_open = false;         // whether the view of this frame is in the state: from open_views to close_views
    View opened;                  // the view of this frame as open_views found it
    std::optional<View> drifted;  // that of differences, if it is another one
    // `Process.imu_twist` of Python, from T_departed to values after a correction: for a time offset.
    std::function<Vector6(const Values& after)> twist_after;

    // The blocks as data; values and P of the prior, (body, body). Views open by `open_views`.
    Estimate(Config config, Sensor sensor, std::optional<TrackError> track_error, std::vector<Block> blocks,
             const Vector& values, Vector coordinates, const Matrix& P);

    Mean mean() const { return {values, table.position_m, imu_twist}; }
    const Block* block(const std::string& name) const;  // null: not in the state
    bool has_time_offset() const;
};

// Columns of the body by the names of blocks, and those on which rows depend directly: ln baseline and disparity.
Columns columns_of(const std::vector<Block>& blocks);

}  // namespace ekfslam
