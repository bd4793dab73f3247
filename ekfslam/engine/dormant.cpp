#include "dormant.hpp"

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

void Dormant::append(Index at, const Matrix& K_i, const Matrix3& S_i) {
    const Index before = S_.rows(), after = before + 3;
    slot.push_back(at);
    K.conservativeResize(K_i.rows(), after);
    K.rightCols(3) = K_i;
    cross.conservativeResize(cross.rows(), after);
    cross.rightCols(3).setZero();
    S_.conservativeResizeLike(Matrix::Zero(after, after));
    S_.bottomRightCorner(3, 3) = S_i;
    squares_.conservativeResizeLike(Matrix::Zero(after, squares_.cols()));
}

void Dormant::keep(const std::vector<Index>& which) {
    const std::vector<Index> own = triples(which);
    std::vector<Index> kept;
    for (Index i : which) kept.push_back(slot[static_cast<std::size_t>(i)]);
    slot = kept;
    K = Matrix(K(Eigen::all, own));
    cross = Matrix(cross(Eigen::all, own));
    S_ = Matrix(S_(own, own));
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
    S_.middleRows(own, 3) = (M * S_.middleRows(own, 3)).eval();
    S_.middleCols(own, 3) = (S_.middleCols(own, 3) * M.transpose()).eval();
    squares_.middleRows(own, 3) = (M * squares_.middleRows(own, 3)).eval();
    cross.middleCols(own, 3) = (cross.middleCols(own, 3) * M.transpose()).eval();
}

Matrix Dormant::rows(const std::vector<Index>& own) const {
    Matrix S = S_(own, Eigen::all);
    const Matrix left = squares_(own, Eigen::all) * sign_.asDiagonal();
    blas::multiply('N', 'T', 1.0, left, squares_, 1.0, S);
    return S;
}

Matrix3 Dormant::block(Index which) const {
    const auto squares = squares_.middleRows(3 * which, 3);
    return S_.block<3, 3>(3 * which, 3 * which) + squares * sign_.asDiagonal() * squares.transpose();
}

void Dormant::fold() {
    for (double sign : {1.0, -1.0}) {
        std::vector<Index> which;
        for (Index j = 0; j < sign_.size(); ++j)
            if (sign_(j) == sign) which.push_back(j);
        if (!which.empty()) blas::square('N', sign, squares_(Eigen::all, which), 1.0, S_);
    }
    blas::mirror(S_);
    squares_.resize(S_.rows(), 0);
    sign_.resize(0);
}

}  // namespace ekfslam
