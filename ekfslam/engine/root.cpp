#include "root.hpp"

#include <cmath>

#include "blas.hpp"

namespace ekfslam {

namespace {
// Smallest pivot of a Cholesky factorisation, in the variance of its column, that is more than rounding.
constexpr double LEAST_PIVOT = 1e-14;
// Triangles of this size are not divided further; roots of this size need no BLAS.
constexpr Index SMALL = 48, SMALLEST = 24;

// P = F F^T with upper triangular F, in place of the upper triangle; false if P is not positive definite. The lower
// triangle is not touched. Reversing rows and columns for LAPACK would take longer than the factorisation.
bool to_upper_root(Eigen::Ref<Matrix> P) {
    const Index n = P.rows(), a = n / 2, b = n - a;
    if (n > SMALLEST) {
        if (!to_upper_root(P.bottomRightCorner(b, b))) return false;
        blas::solve('R', 'U', 'T', P.bottomRightCorner(b, b), P.topRightCorner(a, b));
        blas::square('U', 'N', -1.0, P.topRightCorner(a, b), 1.0, P.topLeftCorner(a, a));
        return to_upper_root(P.topLeftCorner(a, a));
    }
    for (Index j = n - 1; j >= 0; --j) {
        if (!(P(j, j) > 0.0) || !std::isfinite(P(j, j))) return false;
        P(j, j) = std::sqrt(P(j, j));
        const auto column = P.col(j).head(j) *= 1.0 / P(j, j);
        for (Index i = 0; i < j; ++i) P.col(i).head(i + 1) -= column(i) * column.head(i + 1);
    }
    return true;
}
}  // namespace

Root::Root(const Matrix& P, const Vector& of) {
    const Index n = P.rows();
    F = P;
    regular = to_upper_root(F);
    for (Index j = 0; regular && j < n; ++j) regular = std::pow(F(j, j), 2) > LEAST_PIVOT * of(j);
    if (!regular) {
        pivot(P, of);
        return;
    }
    for (Index j = 0; j < n; ++j) F.col(j).tail(n - 1 - j).setZero();
}

void Root::pivot(const Matrix& P, const Vector& of) {
    const Index n = P.rows();
    if (!P.allFinite()) throw Error("the covariance is not finite");
    const Vector std = of.cwiseMax(0.0).cwiseSqrt();
    const Vector scale = std.unaryExpr([](double s) { return s > 0.0 ? 1.0 / s : 0.0; });
    Matrix L = scale.asDiagonal() * P * scale.asDiagonal();
    char lower = 'L';
    int size = blas::size(n), rank = 0, failed = 0;
    double tolerance = LEAST_PIVOT;
    std::vector<int> order(n);
    std::vector<double> work(2 * n);
    if (n) lapack::dpstrf(&lower, &size, L.data(), &size, order.data(), &rank, &tolerance, work.data(), &failed);
    F.setZero(n, rank);
    L_.setZero(rank, rank);
    for (Index i = 0; i < n; ++i) {
        const Index row = order[i] - 1, length = std::min<Index>(i + 1, rank);
        F.row(row).head(length) = std(row) * L.row(i).head(length);
        if (i >= rank) continue;
        pivots_.push_back(row);
        L_.row(i).head(length) = F.row(row).head(length);
    }
}

Matrix Root::coefficients(const Matrix& P_oA) const {
    Matrix F_o = regular ? P_oA : Matrix(P_oA(Eigen::all, pivots_));
    if (regular)
        blas::solve('R', 'U', 'T', F, F_o);
    else
        blas::solve('R', 'L', 'T', L_, F_o);
    return F_o;
}

Matrix Root::regression(const Matrix& F_o) const {
    Matrix C = F_o;
    if (regular) {
        blas::solve('R', 'U', 'N', F, C);
        return C;
    }
    blas::solve('R', 'L', 'N', L_, C);
    Matrix wide = Matrix::Zero(F_o.rows(), F.rows());
    wide(Eigen::all, pivots_) = C;
    return wide;
}

void divide_upper(Eigen::Ref<Matrix> F, const Eigen::Ref<const Matrix>& C) {
    const Index n = F.rows(), a = n / 2, b = n - a;
    if (n <= SMALL) return blas::solve('R', 'L', 'T', C, F);
    divide_upper(F.topLeftCorner(a, a), C.topLeftCorner(a, a));
    divide_upper(F.bottomRightCorner(b, b), C.bottomRightCorner(b, b));
    Matrix known = C.bottomLeftCorner(b, a).transpose();
    blas::multiply_triangle('L', 'U', 'N', F.topLeftCorner(a, a), known);
    F.topRightCorner(a, b) -= known;
    blas::solve('R', 'L', 'T', C.bottomRightCorner(b, b), F.topRightCorner(a, b));
}

void square_upper(const Eigen::Ref<const Matrix>& W, Eigen::Ref<Matrix> P) {
    const Index n = W.rows(), a = n / 2, b = n - a;
    if (n <= SMALL) return blas::square('N', 1.0, W, 0.0, P);
    square_upper(W.topLeftCorner(a, a), P.topLeftCorner(a, a));
    square_upper(W.bottomRightCorner(b, b), P.bottomRightCorner(b, b));
    blas::square('N', 1.0, W.topRightCorner(a, b), 1.0, P.topLeftCorner(a, a));
    P.bottomLeftCorner(b, a) = W.topRightCorner(a, b).transpose();
    blas::multiply_triangle('L', 'U', 'N', W.bottomRightCorner(b, b), P.bottomLeftCorner(b, a));
}

}  // namespace ekfslam
