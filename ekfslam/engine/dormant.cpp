#include "dormant.hpp"

#include <algorithm>
#include <utility>

#include "blas.hpp"

namespace ekfslam {

namespace {
// Columns of squares that wait until S is written to: once for all of them is much cheaper.
constexpr Index WAITING = 192;
}  // namespace

Slots triples(const Slots& which) {
    Slots columns;
    for (Index i : which) append_range(columns, 3 * i, 3 * i + 3);
    return columns;
}

void Dormant::append(const Slots& at, const Matrix& K_new, const std::vector<Matrix3>& S_new) {
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
        squares_.conservativeResize(S_.rows(), WAITING);
        sign_.conservativeResize(WAITING);
    }
    S_.block(before, 0, after - before, after).setZero();
    for (Index i = 0; i < size_of(S_new); ++i) {
        const Index own = before + 3 * i;
        S_.block<3, 3>(own, own) = S_new[i];
    }
    squares_.block(before, 0, after - before, waiting_).setZero();
}

void Dormant::keep(const Slots& which) {
    const Slots own = triples(which);
    Slots kept;
    for (Index i : which) kept.push_back(slot[i]);
    slot = kept;
    K = Matrix(K(Eigen::all, own));
    cross = Matrix(cross(Eigen::all, own));
    const auto n = size_of(own);
    Slots end(own.size());  // of neighbours that stay neighbours
    for (std::size_t i = own.size(); i-- > 0;) {
        const bool is_last = i + 1 == own.size() || own[i + 1] != own[i] + 1;
        end[i] = is_last ? i + 1 : end[i + 1];
    }
    const auto move = [&](const double* from, double* to, Index begin) {  // in place: they ascend
        for (Index i = begin; i < n; i = end[i]) std::copy_n(from + own[i], end[i] - i, to + i);
    };
    for (Index j = 0; j < n; ++j) move(S_.col(own[j]).data(), S_.col(j).data(), j);
    for (Index j = 0; j < waiting_; ++j) move(squares_.col(j).data(), squares_.col(j).data(), 0);
}

void Dormant::add(const Matrix& A, double sign) {
    if (waiting_ + A.cols() > WAITING) fold();
    if (A.cols() > WAITING) return square(A, sign);
    squares_.block(0, waiting_, A.rows(), A.cols()) = A;
    sign_.segment(waiting_, A.cols()).setConstant(sign);
    waiting_ += A.cols();
}

void Dormant::turn(Index which, const Matrix3& M) {
    const Index own = 3 * which;
    const Index below = K.cols() - own - 3;
    auto before = S_.block(own, 0, 3, own), after = S_.block(own + 3, own, below, 3);
    auto S = S_.block<3, 3>(own, own);
    before = (M * before).eval();
    after = (after * M.transpose()).eval();
    S = (M * Matrix3(S.selfadjointView<Eigen::Lower>()) * M.transpose()).eval();
    auto squares = squares_.block(own, 0, 3, waiting_);
    squares = (M * squares).eval();
    cross.middleCols(own, 3) = (cross.middleCols(own, 3) * M.transpose()).eval();
}

Matrix Dormant::rows(const Slots& own) const {
    Matrix S(size_of(own), K.cols());
    for (Index i = 0; i < S.rows(); ++i) {
        const Index row = own[i];
        S.row(i).head(row) = S_.row(row).head(row);
        S.row(i).tail(K.cols() - row) = S_.col(row).segment(row, K.cols() - row).transpose();
    }
    const Matrix left = squares()(own, Eigen::all) * sign_.head(waiting_).asDiagonal();
    blas::multiply('N', 'T', 1.0, left, squares(), 1.0, S);
    return S;
}

Matrix3 Dormant::block(Index which) const {
    const auto squares = squares_.block(3 * which, 0, 3, waiting_);
    const Matrix3 S = S_.block<3, 3>(3 * which, 3 * which).selfadjointView<Eigen::Lower>();
    return S + squares * sign_.head(waiting_).asDiagonal() * squares.transpose();
}

void Dormant::fold() {
    for (double sign : {1.0, -1.0}) {
        Slots which;
        for (Index j = 0; j < waiting_; ++j)
            if (sign_(j) == sign) which.push_back(j);
        square(squares()(Eigen::all, which), sign);
    }
    waiting_ = 0;
}

void Dormant::square(const Matrix& A, double sign) {
    blas::square('N', sign, A, 1.0, S_.topLeftCorner(K.cols(), K.cols()));
}

}  // namespace ekfslam
