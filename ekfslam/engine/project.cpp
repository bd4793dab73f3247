// Rows projected on A: whitened, multiplied with the root of P_AA, and the covariances of innovations that follow.
#include <algorithm>

#include "blas.hpp"
#include "gaussian.hpp"
#include "stairs.hpp"

namespace ekfslam {

namespace {
using Small = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 8, 8>;  // (d, d)
using Narrow = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::ColMajor, 3, 8>;              // (3, d)
// Columns on which rows depend directly: four views, ln baseline and disparity.
using Leading = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 26, 8>;

// H <- H L^-T in place for a few columns of H and lower triangular L.
template <class Columns>
void divide(Columns&& H, const Small& L) {
    for (Index j = 0; j < L.cols(); ++j) {
        for (Index l = 0; l < j; ++l) H.col(j) -= L(j, l) * H.col(l);
        H.col(j) *= 1.0 / L(j, j);
    }
}
}  // namespace

Rows Rows::only(const Slots& which) const {
    const Index d = dimension();
    Rows some{{},
              columns_of(H_x, which, d),
              columns_of(H_m, which, d),
              columns_of(residual, which, 1),
              columns_of(variance, which, 1)};
    for (Index i : which) some.slot.push_back(slot[i]);
    return some;
}

namespace {
// Places of some landmarks in T^T among each other, and those that they have now in the new order.
std::pair<Slots, Slots> order_of(const Projection& at, const Slots& which) {
    Slots sorted = range(0, size_of(which)), place(which.size()), now;
    const auto place_of = [&](Index i) { return at.place[which[i]]; };
    std::sort(sorted.begin(), sorted.end(), [&](Index i, Index j) { return place_of(i) < place_of(j); });
    for (const Index i : sorted) {
        place[i] = size_of(now);
        now.push_back(place_of(i));
    }
    return {std::move(place), std::move(now)};
}
}  // namespace

Projection Projection::only(const Slots& which) const {
    const Index d = rows.dimension();
    auto [own, columns] = order_of(*this, which);
    Projection some{rows.only(which), {}, columns_of(T, columns, d), columns_of(G, which, d), {}, std::move(own)};
    for (Index i : which) {
        some.L.insert(some.L.end(), root(i).data(), root(i).data() + d * d);
        some.begin.push_back(begin[i]);
    }
    return some;
}

void Projection::keep(const Slots& which) {
    const Index d = rows.dimension(), k = size_of(which);
    auto [own, columns] = order_of(*this, which);
    rows = rows.only(which);
    for (Index p = 0; p < k; ++p) {
        const Index i = which[p], column = columns[p];
        std::copy_n(L.begin() + i * d * d, d * d, L.begin() + p * d * d);
        begin[p] = begin[i];
        if (i != p) G.middleCols(p * d, d) = G.middleCols(i * d, d);
        if (column != p) T.middleCols(p * d, d) = T.middleCols(column * d, d);
    }
    L.resize(k * d * d);
    begin.resize(which.size());
    place = std::move(own);
    G.conservativeResize(Eigen::NoChange, k * d);
    T.conservativeResize(Eigen::NoChange, k * d);
}

Eigen::Map<const Matrix> Projection::root(Index i) const {
    const Index d = rows.dimension();
    return Eigen::Map<const Matrix>(L.data() + i * d * d, d, d);
}

Eigen::Block<const Matrix> Projection::of(Index i) const {
    const Index d = rows.dimension(), first = begin[i];
    return T.block(first, place[i] * d, T.rows() - first, d);
}

Matrix Projection::own_variance(Index i) const {
    const Index d = rows.dimension();
    const auto T_i = of(i);
    Small square = Small::Identity(d, d);
    for (Index a = 0; a < d; ++a)
        for (Index b = 0; b <= a; ++b) square(a, b) += T_i.col(a).dot(T_i.col(b));
    for (Index a = 0; a < d; ++a)
        for (Index b = 0; b < a; ++b) square(b, a) = square(a, b);
    Matrix S = root(i).lazyProduct(square.lazyProduct(root(i).transpose()).eval());
    S.diagonal() -= rows.variance.col(i);
    return S;
}

Matrix Projection::S() const {
    const Index d = rows.dimension(), k = rows.count();
    Matrix LT(T.rows(), k * d), S = Matrix::Zero(k * d, k * d);
    for (Index i = 0; i < k; ++i) {
        LT.middleCols(i * d, d).topRows(begin[i]).setZero();
        LT.middleCols(i * d, d).bottomRows(of(i).rows()) = of(i).lazyProduct(root(i).transpose());
        S.block(i * d, i * d, d, d) = root(i) * root(i).transpose();
    }
    blas::square('T', 1.0, LT, 1.0, S);
    blas::mirror(S);
    return S;
}

const Root& Gaussian::root() const {
    if (!root_) {
        root_.emplace(P_AA_);
        F_e_ = root_->coefficients(P_eA_);
    }
    return *root_;
}

Matrix Gaussian::by_columns(Matrix H_x) const {
    for (const Part& part : parts()) {
        if (!part.view || part.view->E.isIdentity(0.0)) continue;
        auto rows = H_x.middleRows(part.row, 6);
        rows = (part.view->E.transpose() * rows).eval();
    }
    return H_x;
}

// Fills the whitened rows B^T of landmark i in T; false: their variance is not positive definite.
bool Gaussian::whiten(Projection& at, Index i, const Matrix& H_x, const Parts& parts) const {
    const Index d = at.rows.dimension(), n = P_AA_.rows();
    const Awake& landmark = awake_[row_[at.rows.slot[i]]];
    Narrow H_m = at.rows.H_m.middleCols(i * d, d), SH = landmark.S.lazyProduct(H_m);
    Small R = H_m.transpose().lazyProduct(SH);
    R.diagonal() += at.rows.variance.col(i);
    const Eigen::LLT<Small> factor(R);
    if (factor.info() != Eigen::Success || !R.allFinite()) return false;
    const Small L = factor.matrixL();
    Eigen::Map<Matrix>(at.L.data() + i * d * d, d, d) = L;
    divide(SH, L);
    divide(H_m, L);
    at.G.middleCols(i * d, d) = SH;
    auto B = at.T.middleCols(at.place[i] * d, d);
    B.topRows(landmark.own >= 0 ? n : landmark.begin).setZero();
    if (landmark.own >= 0)
        B.middleRows(landmark.own, 3) = H_m;
    else {
        const Tail K = tail(landmark);
        for (Index j = 0; j < d; ++j)
            B.col(j).tail(n - landmark.begin) = H_m(0, j) * K.col(0) + H_m(1, j) * K.col(1) + H_m(2, j) * K.col(2);
    }
    Leading H = H_x.middleCols(i * d, d);
    divide(H, L);
    for (const Part& part : parts) B.middleRows(part.column, part.size) += H.middleRows(part.row, part.size);
    return true;
}

Projection Gaussian::project(Rows rows) const {
    const Index d = rows.dimension(), k = rows.count(), n = P_AA_.rows();
    const Matrix H_x = by_columns(rows.H_x);
    const Parts parts = this->parts();
    Projection at{std::move(rows), std::vector<double>(k * d * d), Matrix(n, k * d), Matrix(3, k * d), {}, Slots(k)};
    for (Index i = 0; i < k; ++i) {
        const Index slot = at.rows.slot[i], row = row_[slot];
        if (row < 0) throw Error("a dormant landmark must wake before it is observed", {slot});
        const Index begin = std::min(view_column(), awake_[row].begin);
        at.begin.push_back(first_column(parts, H_x.middleCols(i * d, d), begin));
    }
    const Slots order = ascending(at.begin);
    for (Index p = 0; p < size_of(order); ++p) at.place[order[p]] = p;
    Slots failed;
    for (Index i = 0; i < k; ++i)
        if (!whiten(at, i, H_x, parts)) failed.push_back(at.rows.slot[i]);
    if (!failed.empty()) throw Error("the innovation covariance is not positive definite", failed);
    if (root().regular) {
        for (const Stair& s : stairs(at))
            blas::multiply_triangle('L', 'U', 'T', root().F.bottomRightCorner(n - s.begin, n - s.begin),
                                    at.T.block(s.begin, s.column, n - s.begin, s.width));
        return at;
    }
    Matrix T(root().F.cols(), k * d);
    blas::multiply('T', 'N', 1.0, root().F, at.T, 0.0, T);
    at.T = T;
    std::fill(at.begin.begin(), at.begin.end(), 0);
    return at;
}

}  // namespace ekfslam
