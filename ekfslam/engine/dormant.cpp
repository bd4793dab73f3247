#include "dormant.hpp"

#include <algorithm>
#include <utility>

#include "blas.hpp"

namespace ekfslam {

namespace {
// Columns of squares that wait until S is written to: once for all of them is much cheaper.
constexpr Index WAITING = 192;
}  // namespace

std::vector<Index> triples(const std::vector<Index>& which) {
    std::vector<Index> columns;
    for (Index i : which)
        for (Index axis = 0; axis < 3; ++axis) columns.push_back(3 * i + axis);
    return columns;
}

void Dormant::append(const std::vector<Index>& at, const Matrix& K_new, const std::vector<Matrix3>& S_new) {
    const Index before = K.cols(), after = before + K_new.cols(), room = S_.rows();
    slot.insert(slot.end(), at.begin(), at.end());
    K.conservativeResize(K_new.rows(), after);
    K.rightCols(after - before) = K_new;
    cross.conservativeResize(cross.rows(), after);
    cross.rightCols(after - before).setZero();
    if (after > room) {
        Matrix larger(std::max(after, 2 * room), std::max(after, 2 * room));
        larger.topLeftCorner(before, before) = S_.topLeftCorner(before, before);
        S_ = std::move(larger);
    }
    S_.block(before, 0, after - before, after).setZero();
    for (std::size_t i = 0; i < S_new.size(); ++i) {
        const Index own = before + static_cast<Index>(3 * i);
        S_.block<3, 3>(own, own) = S_new[i];
    }
    squares_.conservativeResizeLike(Matrix::Zero(after, squares_.cols()));
}

void Dormant::keep(const std::vector<Index>& which) {
    const std::vector<Index> own = triples(which);
    std::vector<Index> kept;
    for (Index i : which) kept.push_back(slot[static_cast<std::size_t>(i)]);
    slot = kept;
    K = Matrix(K(Eigen::all, own));
    cross = Matrix(cross(Eigen::all, own));
    const Index n = static_cast<Index>(own.size());
    for (Index j = 0; j < n; ++j)  // in place: they ascend
        for (Index i = j; i < n; ++i) S_(i, j) = S_(own[static_cast<std::size_t>(i)], own[static_cast<std::size_t>(j)]);
    squares_ = Matrix(squares_(own, Eigen::all));
}

void Dormant::add(const Matrix& A, double sign) {
    const Index before = squares_.cols(), more = A.cols();
    squares_.conservativeResize(A.rows(), before + more);
    squares_.rightCols(more) = A;
    sign_.conservativeResize(before + more);
    sign_.tail(more).setConstant(sign);
    if (before + more > WAITING) fold();
}

void Dormant::turn(Index which, const Matrix3& M) {
    const Index own = 3 * which;
    const Index below = K.cols() - own - 3;
    auto before = S_.block(own, 0, 3, own), after = S_.block(own + 3, own, below, 3);
    auto S = S_.block<3, 3>(own, own);
    before = (M * before).eval();
    after = (after * M.transpose()).eval();
    S = (M * Matrix3(S.selfadjointView<Eigen::Lower>()) * M.transpose()).eval();
    squares_.middleRows(own, 3) = (M * squares_.middleRows(own, 3)).eval();
    cross.middleCols(own, 3) = (cross.middleCols(own, 3) * M.transpose()).eval();
}

Matrix Dormant::rows(const std::vector<Index>& own) const {
    Matrix S(static_cast<Index>(own.size()), K.cols());
    for (Index i = 0; i < S.rows(); ++i) {
        const Index row = own[static_cast<std::size_t>(i)];
        S.row(i).head(row) = S_.row(row).head(row);
        S.row(i).tail(K.cols() - row) = S_.col(row).segment(row, K.cols() - row).transpose();
    }
    const Matrix left = squares_(own, Eigen::all) * sign_.asDiagonal();
    blas::multiply('N', 'T', 1.0, left, squares_, 1.0, S);
    return S;
}

Matrix3 Dormant::block(Index which) const {
    const auto squares = squares_.middleRows(3 * which, 3);
    const Matrix3 S = S_.block<3, 3>(3 * which, 3 * which).selfadjointView<Eigen::Lower>();
    return S + squares * sign_.asDiagonal() * squares.transpose();
}

void Dormant::fold() {
    auto S = S_.topLeftCorner(K.cols(), K.cols());
    for (double sign : {1.0, -1.0}) {
        std::vector<Index> which;
        for (Index j = 0; j < sign_.size(); ++j)
            if (sign_(j) == sign) which.push_back(j);
        if (!which.empty()) blas::square('N', sign, squares_(Eigen::all, which), 1.0, S);
    }
    squares_.resize(K.cols(), 0);
    sign_.resize(0);
}

}  // namespace ekfslam
