// The correction of one frame by its known landmarks: gates, eq. (6), and consensus in doubtful frames.
// The functions of filters/correction.py and filters/consensus.py.
#pragma once

#include <optional>

#include "innovations.hpp"
#include "model.hpp"

namespace ekfslam {

using Verdicts = std::vector<int>;

struct Correction {
    std::optional<Solution> solution;  // of eq. (6), to be applied to the covariance; none: nothing was accepted
    Vector change;                     // (body + considered + 3n) of the mean
    double nis = 0, log_det = 0;
    Index dof = 0;
    Verdicts verdict;               // (k) ACCEPTED or a reason
    Slots slot;                     // (j) of the accepted landmarks
    Matrix measured, variance;      // (d, j)
    Mean linear;                    // at which the accepted rows were linearised
    Vector coordinates;             // (body) there
    FrameInnovations innovations;   // of the first linearisation
    Index outside = 0;              // landmarks outside of the gate, whether or not they seem to move, too
    bool is_wide = false;           // whether the prediction is too uncertain to linearise at
    std::optional<Estimate> prior;  // that the solution belongs to, if it is another one; its table is of no use
};

// Numbers (rows, columns) that are uniform in [0, 1), drawn row by row from a generator seeded by the frame.
using Uniform = std::function<Matrix(Index frame, Index rows, Index columns)>;

// Solve eq. (6) behind its gates, for landmarks at slots (k) with rows (d, k). A landmark must agree with the
// prediction, and with the prediction as corrected by all other landmarks of the frame. Of the estimate, the evidence
// of motion in its table changes, and with a time offset its velocity and view. The caller applies the correction.
Correction correct_plainly(Estimate& e, const Slots& slots, const Matrix& measured);

// The same, and doubtful frames are decided by consensus, see filters/consensus.py.
Correction correct(Estimate& e, Index frame, const Slots& slots, const Matrix& measured, const Uniform& uniform);

// Largest derivative (k) of each landmark's rows by a rotation, px/rad, from `by_pose` (k d, 6).
Vector focal_lengths(const Matrix& by_pose, Index dimension);

// Take another velocity at the image, before its update: the view of this frame becomes that with it, eq. (9).
void look_at(Estimate& e, const Vector6& imu_twist);

// Rows at the mean after a correction, in the coordinates of the prior.
struct Relinearised {
    Mean linear;
    Vector coordinates;
    Observed seen;
};
Relinearised relinearised(const Estimate& e, const Vector& change, const Slots& slots, const Matrix& measured);

}  // namespace ekfslam
