// Alignment of two frames of a stereo rig by their common rows (uL, v, uR).
#pragma once

#include "sensor.hpp"

namespace ekfslam {

struct Alignment {
    using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;  // one row a point
    using Points = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

    Matrix4 T;  // T_now_before
    Points true_px, residual_px;
    Rows H, B, W;  // (n, 18), (n, 9), (n, 9): matrices 3 x 6 and 3 x 3, row by row
    Matrix6 information;
    Vector6 gradient;

    // Residuals, derivatives and weights at T and true_px, which moves on to its next estimate.
    void linearise(const Sensor& camera, const Points& before, const Points& now, double std_px, double scale);
};

// Robust Gauss-Newton from a first guess of T_now_before; disparities must be positive.
Alignment align(const Sensor& camera, const Alignment::Points& before, const Alignment::Points& now,
                const Matrix4& first, double std_px, double scale);

}  // namespace ekfslam
