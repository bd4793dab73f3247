// Eq. (6): rows projected on A, solved, and applied.
#include <cmath>

#include "blas.hpp"
#include "gaussian.hpp"

namespace ekfslam {

namespace {
using Block = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 8, 8>;  // d is small

Matrix columns_of(const Matrix& M, const Slots& which, Index d) {
    Matrix some(M.rows(), static_cast<Index>(which.size()) * d);
    for (std::size_t i = 0; i < which.size(); ++i)
        some.middleCols(static_cast<Index>(i) * d, d) = M.middleCols(which[i] * d, d);
    return some;
}

Slots places(const std::vector<bool>& flags) {
    Slots some;
    for (std::size_t i = 0; i < flags.size(); ++i)
        if (flags[i]) some.push_back(static_cast<Index>(i));
    return some;
}
}  // namespace

Rows Rows::only(const Slots& which) const {
    const Index d = dimension();
    Rows some{{}, columns_of(H_x, which, d), columns_of(H_m, which, d), columns_of(residual, which, 1),
              columns_of(variance, which, 1)};
    for (Index i : which) some.slot.push_back(slot[static_cast<std::size_t>(i)]);
    return some;
}

Projection Projection::only(const Slots& which) const {
    const Index d = rows.dimension();
    Projection some{rows.only(which), {}, columns_of(B, which, d), columns_of(T, which, d), columns_of(G, which, d), {}};
    for (Index i : which) {
        const double* own = L.data() + i * d * d;
        some.L.insert(some.L.end(), own, own + d * d);
        some.begin.push_back(begin[static_cast<std::size_t>(i)]);
    }
    return some;
}

Eigen::Map<const Matrix> Projection::root(Index i) const {
    const Index d = rows.dimension();
    return Eigen::Map<const Matrix>(L.data() + i * d * d, d, d);
}

Matrix Projection::own_variance(Index i) const {
    const Index d = rows.dimension();
    const auto T_i = T.middleCols(i * d, d);
    Matrix S = root(i) * (Matrix::Identity(d, d) + T_i.transpose() * T_i) * root(i).transpose();
    S.diagonal() -= rows.variance.col(i);
    return S;
}

Matrix Projection::S() const {
    const Index d = rows.dimension(), k = rows.count();
    Matrix LT = T, S = Matrix::Zero(k * d, k * d);
    for (Index i = 0; i < k; ++i) {
        LT.middleCols(i * d, d) = (T.middleCols(i * d, d) * root(i).transpose()).eval();
        S.block(i * d, i * d, d, d) = root(i) * root(i).transpose();
    }
    blas::square('T', 1.0, LT, 1.0, S);
    blas::mirror(S);
    return S;
}

Matrix Solution::residual() const {
    const Index d = at.rows.dimension();
    Matrix e = Matrix::Zero(d, at.rows.count());
    for (Index i : places(left)) {
        const Vector white = w.col(i) - at.T.middleCols(i * d, d).transpose() * y;
        e.col(i) = at.rows.variance.col(i).cwiseProduct(
            at.root(i).transpose().triangularView<Eigen::Upper>().solve(white));
    }
    return e;
}

const Root& Gaussian::root() const {
    if (!root_) {
        root_.emplace(P_AA_);
        F_e_ = root_->coefficients(P_eA_);
    }
    return *root_;
}

Projection Gaussian::project(Rows rows) const {
    const Index d = rows.dimension(), k = rows.count(), n = P_AA_.rows();
    Projection at{std::move(rows), std::vector<double>(static_cast<std::size_t>(k * d * d)), lead_over(at.rows.H_x), {},
                  Matrix(3, k * d), {}};
    Slots failed;
    for (Index i = 0; i < k; ++i) {
        const Index row = row_[static_cast<std::size_t>(at.rows.slot[static_cast<std::size_t>(i)])];
        if (row < 0) throw Error("a dormant landmark must wake before it is observed", {at.rows.slot[static_cast<std::size_t>(i)]});
        const Awake& landmark = awake_[static_cast<std::size_t>(row)];
        const auto H_m = at.rows.H_m.middleCols(i * d, d);
        Block R = H_m.transpose() * landmark.S * H_m;
        R.diagonal() += at.rows.variance.col(i);
        const Eigen::LLT<Block> factor(R);
        if (factor.info() != Eigen::Success || !R.allFinite()) {
            failed.push_back(at.rows.slot[static_cast<std::size_t>(i)]);
            continue;
        }
        const Block L = factor.matrixL();
        Eigen::Map<Matrix>(at.L.data() + i * d * d, d, d) = L;
        const auto whitened = L.triangularView<Eigen::Lower>();
        at.G.middleCols(i * d, d) = whitened.solve<Eigen::OnTheLeft>((landmark.S * H_m).transpose()).transpose();
        auto B = at.B.middleCols(i * d, d);
        Index begin = 0;
        while (begin < view_column() && B.row(begin).isZero(0.0)) ++begin;
        begin = std::min(begin, landmark.begin);
        if (landmark.own >= 0) B.middleRows(landmark.own, 3) += H_m;
        else B.bottomRows(n - landmark.begin) += tail(const_cast<Awake&>(landmark)).lazyProduct(H_m);
        B.bottomRows(n - begin) = whitened.solve(B.bottomRows(n - begin).transpose()).transpose().eval();
        at.begin.push_back(begin);
    }
    if (!failed.empty()) throw Error("the innovation covariance is not positive definite", failed);
    if (root().regular) {
        at.T = at.B;
        blas::multiply_triangle('L', 'U', 'T', root().F, at.T);
    } else {
        at.T.resize(root().F.cols(), k * d);
        blas::multiply('T', 'N', 1.0, root().F, at.B, 0.0, at.T);
    }
    return at;
}

Solution Gaussian::solve(Projection at) const {
    Solution solution;
    const Index d = at.rows.dimension(), k = at.rows.count();
    solution.left.assign(static_cast<std::size_t>(k), true);
    solution.w.resize(d, k);
    for (Index i = 0; i < k; ++i)
        solution.w.col(i) = at.root(i).triangularView<Eigen::Lower>().solve(at.rows.residual.col(i));
    solution.at = std::move(at);
    solve_left(solution);
    return solution;
}

Solution Gaussian::without(Solution solution, const std::vector<bool>& out) const {
    for (std::size_t i = 0; i < out.size(); ++i) solution.left[i] = solution.left[i] && !out[i];
    solve_left(solution);
    return solution;
}

// Factorises M for the rows that are left.
void Gaussian::solve_left(Solution& s) const {
    const Slots some = places(s.left);
    const Index d = s.at.rows.dimension(), f = s.at.T.rows();
    const bool is_all = some.size() == s.left.size();
    const Matrix T_left = is_all ? Matrix() : columns_of(s.at.T, some, d), w = columns_of(s.w, some, 1);
    const Matrix& T = is_all ? s.at.T : T_left;
    s.C.setIdentity(f, f);
    blas::square('N', 1.0, T, 1.0, s.C);
    if (!blas::factorise(s.C)) throw Error("the innovation covariance is not positive definite", s.at.rows.slot);
    const Eigen::Map<const Vector> white(w.data(), w.size());
    const Vector along = T * white;
    const Vector u = s.C.triangularView<Eigen::Lower>().solve(along);
    s.y = s.C.transpose().triangularView<Eigen::Upper>().solve(u);
    s.nis = white.squaredNorm() - u.squaredNorm();
    s.log_det = 2.0 * s.C.diagonal().array().log().sum();
    for (Index i : some) s.log_det += 2.0 * s.at.root(i).diagonal().array().log().sum();
}

Solution Gaussian::solve_body(const Matrix& H, const Vector& residual, const Vector& variance) const {
    const Over rows = over(H);
    Matrix A = rows.A * P_AA_ + rows.e * P_eA_, e = rows.A * P_eA_.transpose() + rows.e * P_ee_;
    Matrix S = A * rows.A.transpose() + e * rows.e.transpose();
    S = (0.5 * (S + S.transpose())).eval();
    S.diagonal() += variance;
    const Eigen::LLT<Matrix> factor(S);
    if (factor.info() != Eigen::Success || !S.allFinite()) throw Error("the innovation covariance is not positive definite");
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
    const Vector x_A = of_body ? Vector(s.V_A * s.w) : Vector(root().F * s.y);
    const Vector x_e = of_body ? Vector(s.V_e * s.w) : Vector(F_e_ * s.y);
    const Index b = columns_.body, n = x_A.size();
    Vector x = Vector::Zero(b + considered_ + 3 * landmarks());
    for (Index i = 0; i < static_cast<Index>(rest_.size()); ++i) x(rest_[static_cast<std::size_t>(i)]) = x_e(i);
    for (Index i = 0; i < front_size(); ++i) x(columns_.front[static_cast<std::size_t>(i)]) = x_A(front_at() + i);
    for (Index at : {columns_.view, columns_.previous, columns_.anchor})
        if (at >= 0) x.segment<6>(at) = view_at(at)->E * x_A.segment<6>(view_at(at)->column);
    const auto own = [&](Index slot) { return x.segment<3>(b + considered_ + 3 * slot); };
    for (const Awake& landmark : awake_) {
        if (landmark.own >= 0) own(landmark.slot) = x_A.segment<3>(landmark.own);
        else own(landmark.slot) = tail(const_cast<Awake&>(landmark)).transpose() * x_A.tail(n - landmark.begin);
    }
    for (Index i = 0; i < dormant_.size(); ++i) {
        const Index slot = dormant_.slot[static_cast<std::size_t>(i)];
        own(slot) = dormant_.K.middleCols(3 * i, 3).transpose() * x_A;
        if (of_body) own(slot) += (s.H_e * dormant_.cross.middleCols(3 * i, 3)).transpose() * s.w;
    }
    const Index d = s.at.rows.dimension();
    for (Index i : places(s.left)) {
        const Vector white = s.w.col(i) - s.at.T.middleCols(i * d, d).transpose() * s.y;
        own(s.at.rows.slot[static_cast<std::size_t>(i)]) += s.at.G.middleCols(i * d, d) * white;
    }
    return x;
}

std::vector<Matrix> Gaussian::given_others(const Solution& s, const Slots& which) const {
    const Index d = s.at.rows.dimension();
    Matrix Z = columns_of(s.at.T, which, d);
    blas::solve('L', 'L', 'N', s.C, Z);
    std::vector<Matrix> blocks;
    for (std::size_t i = 0; i < which.size(); ++i) {
        const auto Z_i = Z.middleCols(static_cast<Index>(i) * d, d);
        const Matrix std = s.at.rows.variance.col(which[i]).cwiseSqrt().asDiagonal();
        const Matrix white = s.at.root(which[i]).triangularView<Eigen::Lower>().solve(std);
        blocks.push_back(white.transpose() * (Matrix::Identity(d, d) - Z_i.transpose() * Z_i) * white);
    }
    return blocks;
}

Matrix Gaussian::information(const Solution& s, const Matrix& J) const {
    const Slots some = places(s.left);
    const Index d = s.at.rows.dimension();
    Matrix A = J;
    for (std::size_t i = 0; i < some.size(); ++i) {
        auto rows = A.middleRows(static_cast<Index>(i) * d, d);
        s.at.root(some[i]).triangularView<Eigen::Lower>().solveInPlace(rows);
    }
    const Matrix T = columns_of(s.at.T, some, d);
    Matrix along(T.rows(), J.cols());
    blas::multiply('N', 'N', 1.0, T, A, 0.0, along);
    blas::solve('L', 'L', 'N', s.C, along);
    return A.transpose() * A - along.transpose() * along;
}

void Gaussian::apply(const Solution& s) {
    if (s.V_A.size() > 0) return apply_body(s);
    Matrix W = root().F, G_e = F_e_;
    blas::solve('R', 'L', 'T', s.C, W);
    blas::solve('R', 'L', 'T', s.C, G_e);
    blas::square('N', 1.0, W, 0.0, P_AA_);
    blas::mirror(P_AA_);
    blas::multiply('N', 'T', 1.0, G_e, W, 0.0, P_eA_);
    const Matrix P_cc = P_ee_.bottomRightCorner(considered_, considered_);
    blas::square('N', -1.0, F_e_, 1.0, P_ee_);
    blas::square('N', 1.0, G_e, 1.0, P_ee_);
    blas::mirror(P_ee_);
    P_ee_.bottomRightCorner(considered_, considered_) = P_cc;
    root_.reset();
    const Index d = s.at.rows.dimension(), n = P_AA_.rows();
    for (Index i : places(s.left)) {
        Awake& landmark = awake_[static_cast<std::size_t>(row_[static_cast<std::size_t>(s.at.rows.slot[static_cast<std::size_t>(i)])])];
        if (landmark.own >= 0) continue;
        const Index begin = s.at.begin[static_cast<std::size_t>(i)];
        extend(landmark, begin);
        const auto G = s.at.G.middleCols(i * d, d);
        tail(landmark).bottomRows(n - begin) -= s.at.B.block(begin, i * d, n - begin, d).lazyProduct(G.transpose());
        landmark.S -= G * G.transpose();
        landmark.S = (0.5 * (landmark.S + landmark.S.transpose())).eval();
    }
}

void Gaussian::apply_body(const Solution& s) {
    if (dormant_.size()) {
        // Given A afterwards: with v = F^-1 V_A and N = (I - v^T v)^-1, eps_B depends on it by - F^-T v N cov(rows, eps_B).
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
