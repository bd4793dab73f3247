// Eq. (6): projected rows solved, and applied.
#include <cmath>

#include "blas.hpp"
#include "gaussian.hpp"
#include "stairs.hpp"

namespace ekfslam {

namespace {
using Gain = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::ColMajor, 3, 8>;                // (3, d)
using Small = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 8, 8>;  // (d, d)
}  // namespace

Matrix Solution::residual() const {
    const Index d = at.rows.dimension();
    Matrix e = Matrix::Zero(d, at.rows.count());
    for (Index i : where(left)) {
        const auto L = at.root(i);
        for (Index j = d - 1; j >= 0; --j) {
            e(j, i) = v(j, i);
            for (Index l = j + 1; l < d; ++l) e(j, i) -= L(l, j) * e(l, i);
            e(j, i) /= L(j, j);
        }
        e.col(i).array() *= at.rows.variance.col(i).array();
    }
    return e;
}

Solution Gaussian::solve(Projection at) const {
    Solution solution;
    const Index k = at.rows.count();
    solution.left.assign(k, true);
    solution.w = at.rows.residual;
    for (Index i = 0; i < k; ++i) divide_rows(at.root(i), solution.w.col(i));
    solution.at = std::move(at);
    solve_left(solution);
    return solution;
}

Solution Gaussian::without(Solution s, const Flags& out) const {
    // Removal from M is exact to rounding of what is removed.
    constexpr double most = 1e4;
    const Index d = s.at.rows.dimension();
    double removed = 0.0;
    Slots some;
    for (Index i : where(out)) {
        if (!s.left[i]) continue;
        s.left[i] = false;
        removed += s.at.of(i).squaredNorm();
        some.push_back(s.at.place[i]);
    }
    if (some.empty()) return s;
    if (removed < most)
        blas::square('N', -1.0, columns_of(s.at.T, some, d), 1.0, s.M);
    else
        s.M.resize(0, 0);
    for (Index place : some) s.at.T.middleCols(place * d, d).setZero();
    for (Index i : where(out)) s.w.col(i).setZero();
    solve_left(s);
    return s;
}

// Factorises M for the rows that are left; those of others are zero.
void Gaussian::solve_left(Solution& s) const {
    const Index d = s.at.rows.dimension(), f = s.at.T.rows(), k = s.at.rows.count();
    if (s.M.rows() != f || !f) {
        s.M.setIdentity(f, f);
        for (const Stair& stair : stairs(s.at))
            blas::square('N', 1.0, s.at.T.block(stair.begin, stair.column, f - stair.begin, stair.width), 1.0,
                         s.M.bottomRightCorner(f - stair.begin, f - stair.begin));
    }
    s.C.resize(f, f);
    for (Index j = 0; j < f; ++j) s.C.col(j).tail(f - j) = s.M.col(j).tail(f - j);
    if (!blas::factorise(s.C)) throw Error("the innovation covariance is not positive definite", s.at.rows.slot);
    Vector white(k * d);
    for (Index i = 0; i < k; ++i) white.segment(s.at.place[i] * d, d) = s.w.col(i);
    Vector u = blas::multiply('N', s.at.T, white);
    s.C.triangularView<Eigen::Lower>().solveInPlace(u);
    s.y = s.C.transpose().triangularView<Eigen::Upper>().solve(u);
    white -= blas::multiply('T', s.at.T, s.y);
    s.v.setZero(d, k);
    s.nis = s.w.squaredNorm() - u.squaredNorm();
    s.log_det = 2.0 * s.C.diagonal().array().log().sum();
    for (Index i : where(s.left)) {
        s.v.col(i) = white.segment(s.at.place[i] * d, d);
        for (Index j = 0; j < d; ++j) s.log_det += 2.0 * std::log(s.at.root(i)(j, j));
    }
}

Solution Gaussian::solve_body(const Matrix& H, const Vector& residual, const Vector& variance) const {
    const Over rows = over(H);
    Matrix A = rows.A * P_AA_ + rows.e * P_eA_, e = rows.A * P_eA_.transpose() + rows.e * P_ee_;
    Matrix S = A * rows.A.transpose() + e * rows.e.transpose();
    S = (0.5 * (S + S.transpose())).eval();
    S.diagonal() += variance;
    const Eigen::LLT<Matrix> factor(S);
    if (factor.info() != Eigen::Success || !S.allFinite())
        throw Error("the innovation covariance is not positive definite");
    Solution solution;
    const auto L = factor.matrixL();
    solution.V_A = L.solve(A).transpose();
    solution.V_e = L.solve(e).transpose();
    solution.H_e = L.solve(rows.e);
    solution.w = L.solve(residual);
    solution.nis = solution.w.squaredNorm();
    solution.log_det = 2.0 * Matrix(L).diagonal().array().log().sum();
    return solution;
}

Vector Gaussian::correction(const Solution& s) const {
    const bool of_body = s.V_A.size() > 0;
    const Vector x_A = of_body ? Vector(s.V_A * s.w) : blas::multiply('N', root().F, s.y);
    const Vector x_e = of_body ? Vector(s.V_e * s.w) : blas::multiply('N', F_e_, s.y);
    const Index b = columns_.body, n = x_A.size();
    Vector x = Vector::Zero(b + considered_ + 3 * landmarks());
    for (Index i = 0; i < size_of(rest_); ++i) x(rest_[i]) = x_e(i);
    for (Index i = 0; i < front_size(); ++i) x(columns_.front[i]) = x_A(front_at() + i);
    for (Index at : {columns_.view, columns_.previous, columns_.anchor})
        if (at >= 0) x.segment<6>(at) = view_at(at)->E * x_A.segment<6>(view_at(at)->column);
    const auto own = [&](Index slot) { return x.segment<3>(b + considered_ + 3 * slot); };
    for (const Awake& landmark : awake_) {
        if (landmark.own >= 0)
            own(landmark.slot) = x_A.segment<3>(landmark.own);
        else
            own(landmark.slot) = tail(landmark).transpose() * x_A.tail(n - landmark.begin);
    }
    for (Index i = 0; i < dormant_.size(); ++i) {
        const Index slot = dormant_.slot[i];
        own(slot) = dormant_.K.middleCols(3 * i, 3).transpose() * x_A;
        if (of_body) own(slot) += (s.H_e * dormant_.cross.middleCols(3 * i, 3)).transpose() * s.w;
    }
    const Index d = s.at.rows.dimension();
    for (Index i : where(s.left)) own(s.at.rows.slot[i]) += s.at.G.middleCols(i * d, d).lazyProduct(s.v.col(i));
    return x;
}

std::vector<Matrix> Gaussian::given_others(const Solution& s, const Slots& which) const {
    const Index d = s.at.rows.dimension(), f = s.at.T.rows();
    Slots columns;
    Index begin = f;
    for (Index i : which) {
        columns.push_back(s.at.place[i]);
        begin = std::min(begin, s.at.begin[i]);
    }
    Matrix Z = columns_of(s.at.T, columns, d).bottomRows(f - begin);
    blas::solve('L', 'L', 'N', s.C.bottomRightCorner(f - begin, f - begin), Z);
    std::vector<Matrix> blocks;
    for (Index i = 0; i < size_of(which); ++i) {
        const auto Z_i = Z.middleCols(i * d, d);
        Small white = s.at.rows.variance.col(which[i]).cwiseSqrt().asDiagonal(), left = Small::Identity(d, d);
        left -= Z_i.transpose().lazyProduct(Z_i);
        divide_rows(s.at.root(which[i]), white);
        blocks.push_back(white.transpose().lazyProduct(left.lazyProduct(white).eval()));
    }
    return blocks;
}

Matrix Gaussian::information(const Solution& s, const Matrix& J) const {
    const Slots some = where(s.left);
    const Index d = s.at.rows.dimension();
    Matrix A = Matrix::Zero(s.at.T.cols(), J.cols()), along(s.at.T.rows(), J.cols());
    for (Index i = 0; i < size_of(some); ++i) {
        auto rows = A.middleRows(s.at.place[some[i]] * d, d);
        rows = J.middleRows(i * d, d);
        divide_rows(s.at.root(some[i]), rows);
    }
    blas::multiply('N', 'N', 1.0, s.at.T, A, 0.0, along);
    blas::solve('L', 'L', 'N', s.C, along);
    return A.transpose() * A - along.transpose() * along;
}

void Gaussian::apply(const Solution& s) {
    if (s.V_A.size() > 0) return apply_body(s);
    const bool regular = root().regular;
    Matrix W = std::move(root_->F), G_e = F_e_;  // the root is not that of P afterwards
    blas::solve('R', 'L', 'T', s.C, G_e);
    if (regular) {
        divide_upper(W, s.C);
        square_upper(W, P_AA_);
        P_eA_ = G_e;
        blas::multiply_triangle('R', 'U', 'T', W, P_eA_);
    } else {
        blas::solve('R', 'L', 'T', s.C, W);
        blas::square('N', 1.0, W, 0.0, P_AA_);
        blas::multiply('N', 'T', 1.0, G_e, W, 0.0, P_eA_);
    }
    blas::mirror(P_AA_);
    const Matrix P_cc = P_ee_.bottomRightCorner(considered_, considered_);
    blas::square('N', -1.0, F_e_, 1.0, P_ee_);
    blas::square('N', 1.0, G_e, 1.0, P_ee_);
    blas::mirror(P_ee_);
    P_ee_.bottomRightCorner(considered_, considered_) = P_cc;
    root_.reset();
    const Matrix H_x = by_columns(s.at.rows.H_x);
    const Parts parts = this->parts();
    for (Index i : where(s.left)) apply_rows(s, i, H_x, parts);
}

// K_i <- (I - G L^-1 H_m) K_i - G L^-1 H_x, S_i <- S_i - G G^T.
void Gaussian::apply_rows(const Solution& s, Index i, const Matrix& H_x, const Parts& parts) {
    const Index d = s.at.rows.dimension();
    const Index slot = s.at.rows.slot[i];
    Awake& landmark = awake_[row_[slot]];
    if (landmark.own >= 0) return;
    const auto G = s.at.G.middleCols(i * d, d);
    Gain gain = G;  // G L^-1
    const auto L = s.at.root(i);
    for (Index j = d - 1; j >= 0; --j) {
        for (Index l = j + 1; l < d; ++l) gain.col(j) -= L(l, j) * gain.col(l);
        gain.col(j) /= L(j, j);
    }
    turn(landmark, Matrix3::Identity() - gain.lazyProduct(s.at.rows.H_m.middleCols(i * d, d).transpose()));
    for (const Part& part : parts) {
        const auto H = H_x.block(part.row, i * d, part.size, d);
        if (part.column < landmark.begin) {
            if (H.isZero(0.0)) continue;
            extend(landmark, part.column);
        }
        Tail K = part.column >= recent_column() ? recent(landmark) : tail(landmark);
        K.middleRows(part.column - landmark.begin, part.size) -= H.lazyProduct(gain.transpose());
    }
    landmark.S -= G.lazyProduct(G.transpose());
    landmark.S = (0.5 * (landmark.S + landmark.S.transpose())).eval();
}

void Gaussian::apply_body(const Solution& s) {
    if (dormant_.size()) {
        // Given A afterwards: with v = F^-1 V_A and N = (I - v^T v)^-1, eps_B depends on it by - F^-T v N cov(rows,
        // eps_B).
        const Matrix v = root().coefficients(s.V_A.transpose()).transpose(), E = s.H_e * dormant_.cross;
        const Index k = v.cols();
        const Eigen::LLT<Matrix> left(Matrix::Identity(k, k) - v.transpose() * v);
        const Matrix gain = left.solve(E);
        dormant_.K -= root().regression(v.transpose()).transpose() * gain;
        dormant_.add(left.matrixL().solve(E).transpose(), -1.0);
        dormant_.cross -= (s.V_e - F_e_ * v) * gain;
    }
    const Matrix P_cc = P_ee_.bottomRightCorner(considered_, considered_);
    blas::square('N', -1.0, s.V_A, 1.0, P_AA_);
    blas::mirror(P_AA_);
    blas::multiply('N', 'T', -1.0, s.V_e, s.V_A, 1.0, P_eA_);
    blas::square('N', -1.0, s.V_e, 1.0, P_ee_);
    blas::mirror(P_ee_);
    P_ee_.bottomRightCorner(considered_, considered_) = P_cc;
    root_.reset();
}

}  // namespace ekfslam
