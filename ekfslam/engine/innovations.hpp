// Whitened innovations: of each observation by itself, and apart from the motion of the camera they agree on.
//
// With S the joint innovation covariance of a frame's accepted rows r, and J their derivative by the pose's error, the
// motion of the camera on which the innovations agree has the score c = J^T S^-1 r with covariance C = J^T S^-1 J.
// The functions of filters/innovations.py.
#pragma once

#include "gates.hpp"

namespace ekfslam {

struct FrameInnovations {
    Ids landmark;         // (k) rows of the log
    Matrix alone, apart;  // (d, k)
    Vector6 score = Vector6::Zero();
    Matrix6 information = Matrix6::Zero();
};

// Derivative (k d, 6) of rows by the error of the present pose; views of the frame before do not count.
Matrix by_pose(const Estimate& e, const Rows& rows);

// The innovations of rows that a solution accepts, with the covariance S of each by itself and what is `left` (d, k).
FrameInnovations innovations_of(const Estimate& e, const Gaussian& gaussian, const Solution& solution, const Rows& rows,
                                const Blocks& S, const Matrix& left);

}  // namespace ekfslam
