// The prediction of a pose by measured velocities that are inputs: models/process/velocities.py, and the walks of
// blocks.
#pragma once

#include <vector>

#include "estimate.hpp"

namespace ekfslam {

// How a prediction treats a block, in the order of Estimate::blocks.
struct Law {
    bool walks = false;            // x+ = exp(-l / L) x + w of models/blocks/gauss_markov.py
    Vector std, time_s, length_m;  // stationary; L as a time and as a way, infinite where it is no such one
    double least_way_m = 0;        // way that counts at least
    bool turns = false;            // level velocities into the IMU frame: models/blocks/up.py
    enum Share { none, one, way } share = none;  // of a block that moves the camera
    Matrix offset;                               // (6, size) derivative of the measured velocities, or (6, 0)
};

struct Process {
    std::vector<Law> laws;
    Vector6 pose_std, gap_std;  // of velocities; further one across a gap
};

struct Interval {
    double tau_s = 0;
    Vector dt_s;    // (n)
    Matrix inputs;  // (n, 6)
    bool is_gap = false;
    double doubt = 1;
};

struct Departed {
    Vector coordinates;  // before the process moved the pose
    Matrix4 T_cam_imu;   // of the frame before, after its update: the view's for the pose
};

// Predict over an interval, eq. (1) and (2), and open the view of the next frame.
Departed predict(Estimate& e, const Process& process, const Interval& interval);

}  // namespace ekfslam
