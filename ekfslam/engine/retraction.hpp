// Equations (7) and (7'): the effect of a correction on blocks, landmarks and their covariance.
// The functions of filters/retraction.py, coordinates.py and variants.py.
#pragma once

#include "estimate.hpp"

namespace ekfslam {

// The mean after a correction, and the landmarks by the coordinates in which it moved them.
struct Moved {
    Mean mean;
    Slots awake, others;  // corrected in the last updated view, eq. (7'), and in world, eq. (7)
    Flags in_image;       // (awake) which of the former count by their images
    Matrix q, q_after;    // (3, awake) in that view before and after
};

// Landmark errors after a correction, d_i+ = M_i d_i + B_i z, with z the error of the view in layout columns `at`.
struct Change {
    Slots slot;
    std::vector<Matrix3> M;  // empty: identity
    std::vector<Matrix36> B;
    Index at = -1;
};

// Return the mean after a correction (body + considered + 3n), and leave the estimate unchanged.
Moved retracted(const Estimate& e, const Vector& correction);
// Correct the mean, and express the covariance in the errors after it.
void retract(Estimate& e, const Vector& correction);
// Return rows that were taken after a correction, in the errors before it.
Rows carried_back(const Estimate& e, Rows rows, const Moved& moved);

// The parts of a correction for the leading columns of rows (lead) and for the landmarks (3, n).
struct Parts {
    Vector x;
    Matrix d;
};
Parts parts(const Estimate& e, const Vector& correction);
// The residuals (d, k) r - H (x, d) that a correction leaves.
Matrix left_by(const Rows& rows, const Parts& correction);

}  // namespace ekfslam
