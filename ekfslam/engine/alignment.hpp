// Alignment of two frames of a stereo rig by their common rows (uL, v, uR).
#pragma once

#include "types.hpp"

namespace ekfslam {

struct Alignment {
    struct Camera {
        double fu_px, fv_px, cu_px, cv_px, baseline_m;
    };
    using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;  // one row a point
    using Points = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

    Matrix4 T;  // T_now_before
    Points true_px, residual_px;
    Rows H, B, W;  // (n, 18), (n, 9), (n, 9): matrices 3 x 6 and 3 x 3, row by row
    Matrix6 information;
    Vector6 gradient;

    // Residuals, derivatives and weights at T and true_px, which moves on to its next estimate.
    void linearise(const Camera& camera, const Points& before, const Points& now, double std_px, double scale);
};

// Robust Gauss-Newton from a first guess of T_now_before; disparities must be positive.
Alignment align(const Alignment::Camera& camera, const Alignment::Points& before, const Alignment::Points& now,
                const Matrix4& first, double std_px, double scale);

}  // namespace ekfslam
