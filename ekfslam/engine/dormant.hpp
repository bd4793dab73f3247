// Landmarks out of view in the conditional form: exact, and next to free until they are seen again.
//
// Dormant landmarks are d_B = K_B x_A + eps_B, eps_B independent of x_A with a joint covariance S, and with a
// covariance `cross` with the other columns e. Correcting A changes none of these. If columns o leave A, and k stay,
// with x_o = C x_k + eps_o, eps_o of covariance D:
//
//     K_B <- K_B,k + K_B,o C      S <- S + K_B,o D K_B,o^T      cross <- cross + (P_eo - P_ek C^T) K_B,o^T
//
// If columns n enter A whose part N given A has a covariance with eps_B:
//
//     K_B <- K_B + g (x_n - C x_A),  g = cov(eps_B, N) var(N)^-1      S <- S - g cov(N, eps_B)
//
#pragma once

#include "types.hpp"

namespace ekfslam {

class Dormant {
   public:
    Slots slot;    // (n)
    Matrix K;      // K_B^T (n_A, 3n)
    Matrix cross;  // (e, 3n)

    Index size() const { return size_of(slot); }
    // Adds landmarks, independent of the others given A.
    void append(const Slots& at, const Matrix& K_new, const std::vector<Matrix3>& S_new);
    // Keeps some of the landmarks, ascending.
    void keep(const Slots& which);
    // Adds sign A A^T to S, A (3n, c).
    void add(const Matrix& A, double sign);
    // d_i <- M_i d_i + ... in S and cross.
    void turn(Index which, const Matrix3& M);
    Matrix rows(const Slots& own) const;  // (r, 3n) rows of S
    Matrix3 block(Index which) const;

   private:
    void fold();
    void square(const Matrix& A, double sign);
    auto squares() const { return squares_.topLeftCorner(K.cols(), waiting_); }
    Matrix S_{0, 0};        // its lower triangle, with room for more
    Matrix squares_{0, 0};  // S is this much more, or less, than S_: U diag(sign) U^T, with room for more
    Vector sign_;
    Index waiting_ = 0;  // columns of U
};

// Columns (3n) of landmarks.
Slots triples(const Slots& which);

}  // namespace ekfslam
