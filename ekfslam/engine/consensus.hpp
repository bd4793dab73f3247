// Consensus of the landmarks of a frame: which are wrong, these landmarks or the inputs? See filters/consensus.py.
#pragma once

#include "correction.hpp"

namespace ekfslam {

// Which landmarks (k) agree with the best of small samples of them, given S (k d, k d) of their innovations (d, k). A
// sample corrects the predictions of all others. What it moves by s px may be wrong by s^2 / f, as linearised.
Flags agreeing(const Matrix& S, const Matrix& residual, const Vector& focal, double gate,
               const std::vector<Slots>& samples);

// Samples of k landmarks: three each, or one less than there are; all of them, or by random numbers.
std::vector<Slots> samples_of(Index k, Index frame, const Uniform& uniform);

// The landmarks (k) that agree with all others of them, starting from those inside. The worst one leaves first: with it
// inside, it may seem that others are wrong. The square given all others is y_i^T K_ii^-1 y_i, K = S_AA^-1, y = K r_A.
Flags refined(const Matrix& S, const Matrix& residual, const Flags& inside, double gate);

}  // namespace ekfslam
