// The joint covariance in the conditional form: exact, and linear in the number of landmarks.
//
// Landmarks are independent of each other given A: the views of a window of frames, columns of the body on which they
// depend directly (front), and a few promoted landmarks. X is A and the rest of the body.
//
//     N(x_X; 0, P_X) prod_i N(d_i; K_i x_A, S_i)
//
#pragma once

#include <memory>
#include <optional>

#include "types.hpp"

namespace ekfslam {

// Columns of the body in the layout of the model. All body matrices and vectors of the interface have this layout.
struct Columns {
    Index body = 0;           // all blocks, views included
    Index view = -1;          // first column of the block `view`
    Index previous = -1;      // of `previous_view`
    Index anchor = -1;        // of `anchor`
    std::vector<Index> front;  // columns of the body (no view) on which rows depend directly
};

class Gaussian;

// Whitened rows over A, with what both gates need.
struct Projection {
    Rows rows;
    // L_i (d, d), B_i (d, n_A), T_i = B_i L (d, f), G_i (3, d): layout is the business of gaussian.cpp
    std::vector<double> L;
    Matrix B, T, G;
    Projection only(const Slots& which) const;
    Matrix own_variance(Index i) const;  // (d, d) of H P H^T for landmark i
    Matrix S() const;                    // (k d, k d) joint covariance of the innovations, V included
};

// Eq. (6) solved for projected rows, all or some of them.
struct Solution {
    Projection at;
    std::vector<bool> left;  // which landmarks are in it
    Matrix U;                // M = I + T^T T = U^T U
    Vector w, u;
    double nis = 0.0, log_det = 0.0;
};

class Gaussian {
   public:
    Gaussian(const Matrix& P_body, Columns columns);

    const Columns& columns() const;
    Lead lead() const;        // of rows in the present frame
    Index landmarks() const;  // in the table's order, dormant ones included
    Index considered() const;
    Index width() const;  // n_X

    Matrix body_covariance() const;                     // (body + considered)
    Matrix covariance_of(const Slots& slots) const;     // (body + considered + 3k)
    std::vector<Matrix3> landmark_blocks(const Slots& slots) const;

    // Eq. (2) on the body; views stay. Promotes landmarks and drops old views so that A becomes smallest.
    void propagate(const Matrix& Phi, const Matrix& Q);
    // previous_view <- view, at the start of a prediction.
    void close_view();
    // view <- Y x, and the drifted view <- Yd x if given; Y, Yd (6, body) with zeros at views.
    void open_view(const Matrix& Y, const std::optional<Matrix>& Yd);
    // anchor <- view; landmarks that depend on the old anchor keep its columns in the window.
    void hold_anchor();
    // Adds Q (body, body) to the body, and to the views of this frame through Y and Yd.
    void add_noise(const Matrix& Q);

    Projection project(Rows rows) const;
    Solution solve(Projection at) const;
    Solution without(Solution solution, const std::vector<bool>& out) const;
    Solution solve_body(const Matrix& H, const Vector& residual, const Vector& variance) const;  // H (k, body)
    Vector correction(const Solution& solution) const;                            // (body + considered + 3n)
    std::vector<Matrix> given_others(const Solution& s, const Slots& which) const;  // V^1/2 (S^-1)_ii V^1/2, (d, d)
    Matrix information(const Solution& s, const Matrix& J) const;                 // J^T S^-1 J for J (k d, c)
    void apply(const Solution& solution);

    // Landmarks d = G x_lead + w, eq. (5): G (lead, 3n), one column a coordinate; covariances of w.
    void augment(const Matrix& G, const std::vector<Matrix3>& covariance);
    // z <- A z for the view in layout columns `at` (view, previous or anchor), or another part of the body.
    void transform_body(Index at, const Matrix& A);
    // d_i <- M_i d_i + B_i z for the view in layout columns `at`; M empty: identity.
    void transform_landmarks(const Slots& slots, const std::vector<Matrix3>& M, const std::vector<Matrix36>& B, Index at);
    void rest(const std::vector<bool>& asleep);
    void marginalise(const std::vector<bool>& stay);
    void replace(const Matrix& P);  // (body + considered + 3n): all landmarks promoted

    Index consider(Index columns);                   // considered columns for clones of reported poses
    void clone(Index source, Index size, Index to);  // body columns into considered ones
};

}  // namespace ekfslam
