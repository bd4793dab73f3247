// Equation (5): new landmarks, at once or after waiting for a second view. The functions of filters/starting.py.
#pragma once

#include "estimate.hpp"

namespace ekfslam {

// New tracks by whether they have a landmark now, and the observations that started those (j): for the log.
struct Started {
    Flags which;                          // (n)
    Ids ids;                              // (j)
    Matrix position_m;                    // (3, j)
    Matrix rows, variance;                // (d, j) in this frame
    Index step_before = -1;               // of the anchor, where two views start a landmark; -1: there is none
    Matrix rows_before, variance_before;  // (d, j) at the anchor
};

// Append landmarks for new tracks with rows (d, n) to table and covariance. The caller's log gives them `log_row` and
// `last_observation`; they have the last places of the table.
Started start(Estimate& e, Index frame, const Ids& ids, const Matrix& rows);

// Tracks of one camera that were seen from the anchor and have no landmark yet.
class Waiting {
   public:
    Started start(Estimate& e, Index frame, const Ids& ids, const Matrix& rows);

   private:
    void move_on(Estimate& e, const Ids& ids, const Matrix& rows);

    Ids ids_;  // ascending
    Matrix rows_;
    Index step_ = 0;
};

}  // namespace ekfslam
