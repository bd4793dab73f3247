// Gates: which observations a frame may use. One at a time, against all others, and along the track.
#pragma once

#include "table.hpp"

namespace ekfslam {

using Block3 = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, 3, 3>;  // (d, d), without allocation
using Blocks = std::vector<Block3>;

// Smallest share of its variance that an innovation must have besides what all others of the frame say of it.
constexpr double LEAST_SHARE = 1e-6;
// Observations of a landmark after which it may be found to move.
constexpr std::int64_t SEEN_TO_MOVE = 3;

// Normalised squares (k), and whether the others say anything about a landmark.
struct Judged {
    Vector squares;
    Flags judged;
};

// Terms (k) that a frame adds to N and D, see moves_along.
struct Evidence {
    Vector along, information;
};

// H_i P H_i^T + V of projected landmarks.
Blocks own_covariances(const Projection& tried);

// r_i^T S_i^-1 r_i (k) for residuals (d, k); throws Error with the slots of blocks that are not positive definite.
Vector normalised_squares(const Blocks& S, const Matrix& residual, const Slots& slots);

// Upper bound e_i^T V^-1 S_i V^-1 e_i (k) of the squares of agrees_with_others: ((S^-1)_ii)^-1 <= S_i. Landmarks that
// pass the gate by it need no `given_others`.
Vector most_given_others(const Matrix& left, const Matrix& variance, const Blocks& S);

// e_i^T C_i^-1 e_i (k), the normalised square of each landmark's innovation given those of all others, with
// C_i = V^1/2 (S^-1)_ii V^1/2 and e_i, in standard deviations, what the correction leaves: V C_i^-1 e_i has the
// covariance V C_i^-1 V. If C is only rounding, the others say nothing about the landmark, and its square is 0.
Judged agrees_with_others(const Matrix& left, const Matrix& variance, const std::vector<Matrix>& C);

// h^T S^-1 r and h^T S^-1 h for derivatives h (d, k).
Evidence evidence_alone(const Matrix& residual, const Blocks& S, const Matrix& h);

// h^T V^-1 e and h^T V^-1 C V^-1 h, for agrees_with_others.
Evidence evidence_given_others(const Matrix& left, const Matrix& variance, const std::vector<Matrix>& C,
                               const Matrix& h);

// Which landmarks (k) travel with the rig or against it, by their whole tracks so far. A landmark that moves by a share
// b of the rig's step has innovations of mean b h. Over a track N = sum h^T S^-1 r and D = sum h^T S^-1 h estimate b as
// N / D with standard deviation D^-1/2. It moves if b exceeds `moving_sigma` of these, and `moving_share`.
Flags moves_along(Table& table, const Slots& slots, const Evidence& evidence, const Vector& squares, double gate,
                  const Config& config);

// L_i^-1 r_i with S_i = L_i L_i^T; NaN where S_i is singular. Rows that are (uL, v, uR) and those that are
// (u, v, disparity) come out alike.
Matrix whitened(const Blocks& S, const Matrix& residual);

}  // namespace ekfslam
