#include "gates.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ekfslam {
namespace {

using Small = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, 3, 1>;
using Eigenvalues = Eigen::SelfAdjointEigenSolver<Block3>;

double smallest_eigenvalue(const Block3& S) {
    return S.allFinite() ? Eigenvalues(S, Eigen::EigenvaluesOnly).eigenvalues()[0] : 0.0;
}

// Whether the smallest eigenvalue exceeds a number, given the root of S. The product of n eigenvalues and their sum
// bound the smallest one from below, and decide nearly always.
bool exceeds(const Block3& S, const Eigen::LLT<Block3>& root, double least) {
    const auto others = static_cast<int>(S.rows()) - 1;
    double bound = root.matrixLLT().diagonal().cwiseAbs2().prod();
    for (int i = 0; i < others; ++i) bound *= others / S.trace();
    return bound > 2.0 * least || smallest_eigenvalue(S) > least;
}

// L^-1 r, or nothing where S is not positive definite.
bool whiten_by(const Block3& S, Small& r) {
    if (!S.allFinite()) return false;
    const Eigen::LLT<Block3> root(S);
    if (root.info() != Eigen::Success) return false;
    root.matrixL().solveInPlace(r);
    return true;
}

}  // namespace

Blocks own_covariances(const Projection& tried) {
    Blocks S(tried.rows.count());
    for (Index i = 0; i < tried.rows.count(); ++i) {
        S[i] = tried.own_variance(i);
        S[i].diagonal() += tried.rows.variance.col(i);
    }
    return S;
}

Vector normalised_squares(const Blocks& S, const Matrix& residual, const Slots& slots) {
    Vector squares(residual.cols());
    Slots failed;
    for (Index i = 0; i < residual.cols(); ++i) {
        Small r = residual.col(i);
        if (!whiten_by(S[i], r)) failed.push_back(i);
        squares[i] = r.squaredNorm();
    }
    if (failed.empty()) return squares;
    Slots at_fault;
    for (Index i : failed) {
        if (smallest_eigenvalue(S[i]) <= 0) at_fault.push_back(slots[i]);
    }
    throw Error("the innovation covariance is not positive definite", at_fault);
}

Vector most_given_others(const Matrix& left, const Matrix& variance, const Blocks& S) {
    Vector most(left.cols());
    for (Index i = 0; i < left.cols(); ++i) {
        const Small y = left.col(i).cwiseQuotient(variance.col(i));
        most[i] = y.dot(S[i] * y);
    }
    return most;
}

Judged agrees_with_others(const Matrix& left, const Matrix& variance, const std::vector<Matrix>& C) {
    Judged found{Vector::Zero(left.cols()), Flags(left.cols(), false)};
    for (Index i = 0; i < left.cols(); ++i) {
        const Eigenvalues own{Block3(C[i])};
        const auto share = own.eigenvalues();
        if (!(share[0] > LEAST_SHARE)) continue;
        const Small e = left.col(i).cwiseQuotient(variance.col(i).cwiseSqrt());
        found.squares[i] = (own.eigenvectors().transpose() * e).cwiseAbs2().cwiseQuotient(share).sum();
        found.judged[i] = true;
    }
    return found;
}

Evidence evidence_alone(const Matrix& residual, const Blocks& S, const Matrix& h) {
    Evidence evidence{Vector(residual.cols()), Vector(residual.cols())};
    for (Index i = 0; i < residual.cols(); ++i) {
        const Small along = h.col(i), weighted = S[i].llt().solve(along);
        evidence.along[i] = weighted.dot(residual.col(i));
        evidence.information[i] = weighted.dot(along);
    }
    return evidence;
}

Evidence evidence_given_others(const Matrix& left, const Matrix& variance, const std::vector<Matrix>& C,
                               const Matrix& h) {
    Evidence evidence{Vector(left.cols()), Vector(left.cols())};
    for (Index i = 0; i < left.cols(); ++i) {
        const Small std = variance.col(i).cwiseSqrt(), g = h.col(i).cwiseQuotient(std);
        evidence.along[i] = g.dot(left.col(i).cwiseQuotient(std));
        evidence.information[i] = g.dot(C[i] * g);
    }
    return evidence;
}

Flags moves_along(Table& table, const Slots& slots, const Evidence& evidence, const Vector& squares, double gate,
                  const Config& config) {
    Flags moves(slots.size(), false);
    for (Index i = 0; i < squares.size(); ++i) {
        // Gross outliers count as at the gate.
        const double clip = std::sqrt(std::min(1.0, gate / std::max(squares[i], 1e-12)));
        auto track = table.evidence.col(slots[i]);
        track[0] += clip * evidence.along[i];
        track[1] += std::max(evidence.information[i], 0.0);
        const double least = std::max(config.moving_sigma * std::sqrt(track[1]), config.moving_share * track[1]);
        moves[i] = std::abs(track[0]) > least && table.observations[slots[i]] >= SEEN_TO_MOVE;
    }
    return moves;
}

Matrix whitened(const Blocks& S, const Matrix& residual) {
    Matrix white(residual.rows(), residual.cols());
    for (Index i = 0; i < residual.cols(); ++i) {
        const Small std = S[i].diagonal().cwiseMax(std::numeric_limits<double>::min()).cwiseSqrt();
        const Block3 scale = std.cwiseInverse().asDiagonal();
        const Block3 correlation = scale * S[i] * scale;
        const Small r = residual.col(i).cwiseQuotient(std);
        const Eigen::LLT<Block3> root(correlation);
        const bool definite = correlation.allFinite() && root.info() == Eigen::Success;
        if (definite && exceeds(correlation, root, LEAST_SHARE)) {
            white.col(i) = root.matrixL().solve(r);
        } else {
            white.col(i).setConstant(std::numeric_limits<double>::quiet_NaN());
        }
    }
    return white;
}

}  // namespace ekfslam
