// Predictions in C++: models/process/velocities.py and inertial.py, and the walks of blocks. Each process is one file.
#pragma once

#include <vector>

#include "estimate.hpp"

namespace ekfslam {

// How a prediction treats a block, in the order of Estimate::blocks.
struct Law {
    enum Walk { stays, gauss_markov, walk } transition = stays;  // x+ = exp(-l / L) x + w, or x+ = x + w
    Vector std, time_s, length_m;  // of w or stationary; L as a time and as a way, infinite where it is no such one
    double least_way_m = 0;        // way that counts at least
    bool turns = false;            // level velocities into the IMU frame: models/blocks/up.py
    enum Share { none, one, way } share = none;  // of a block that moves the camera
    Matrix offset;                               // (6, size) derivative of the measured velocities, or (6, 0)
};

struct Interval {
    double tau_s = 0;
    Vector dt_s;    // (n)
    Matrix inputs;  // (n, 6)
    bool is_gap = false;
    double doubt = 1;
};

// Where a block is: its first column, and the first number of its value.
struct Place {
    Index at = -1, value_at = -1;
};

// Velocities move the pose. Those of a block `twist` walk, and inputs measure them or only start them.
struct Velocities {
    Vector6 pose_std, gap_std;  // of inputs; further one across a gap
    std::optional<Place> twist;
    Vector6 twist_std = Vector6::Zero();  // of inputs that measure `twist`
    bool is_measured = false;
};

// Gyroscope and accelerometer move pose and velocity.
struct Inertial {
    double gyro = 0, accel = 0, gyro_walk = 0, accel_walk = 0;  // densities
    double gravity_m_s2 = 0;
    Place velocity, gyro_bias, accel_bias;
};

struct Process {
    std::vector<Law> laws;
    Velocities velocities;
    std::optional<Inertial> inertial;
};

// A step of the blocks in some columns (p), whose values it has moved: eq. (2).
struct Step {
    Slots columns;
    Matrix Phi, Q;  // (p, body), (p, p)
    Vector6 imu_twist;
};

struct Departed {
    Vector coordinates;           // before the process moved its blocks
    Matrix4 T_cam_imu;            // of the frame before, after its update: the view's for the pose
    double nis = 0, log_det = 0;  // of inputs that measured `twist`
    double doubt = 1;             // and their factor of standard deviations
};

// Predict over an interval, eq. (1) and (2), and open the view of the next frame.
Departed predict(Estimate& e, const Process& process, const Interval& interval);

// velocities.cpp: the constant velocity that leads to the same pose as the inputs of an interval; eq. (1) and (2) by
// it; the first inputs become the twist, or inputs measure it, eq. (6).
Vector6 mean_velocity(const Interval& interval);
Step step(Estimate& e, const Process& process, const Interval& interval, const Vector6& measured);
void measure_twist(Estimate& e, const Process& process, const Vector6& measured, Departed& departed);

// inertial.cpp: eq. (12).
Step step(Estimate& e, const Inertial& process, const Interval& interval);

}  // namespace ekfslam
