// The columns of A: views enter it and leave it, landmarks are promoted to it.
#include <algorithm>
#include <utility>

#include "blas.hpp"
#include "gaussian.hpp"

namespace ekfslam {

namespace {
Slots complement(const Slots& some, Index size) {
    Flags is_in(size, false);
    for (Index i : some) is_in[i] = true;
    Slots others;
    for (Index i = 0; i < size; ++i)
        if (!is_in[i]) others.push_back(i);
    return others;
}

// Neighbours that stay neighbours in a new order.
struct Run {
    Index to, from, size;
};

std::vector<Run> runs(const Slots& from) {
    std::vector<Run> found;
    for (Index j = 0; j < size_of(from); ++j) {
        const Index old = from[j];
        if (old < 0) continue;
        if (!found.empty() && found.back().to + found.back().size == j && found.back().from + found.back().size == old)
            ++found.back().size;
        else
            found.push_back({j, old, 1});
    }
    return found;
}

// Blocks of a matrix in a new order (n); zero elsewhere.
Matrix picked(const Matrix& P, const std::vector<Run>& rows, Index height, const std::vector<Run>& columns,
              Index width) {
    Matrix moved(height, width);
    Index kept_rows = 0, kept_columns = 0;
    for (const Run& run : rows) kept_rows += run.size;
    for (const Run& run : columns) kept_columns += run.size;
    if (kept_rows < height || kept_columns < width) moved.setZero();
    for (const Run& column : columns)
        for (const Run& row : rows)
            moved.block(row.to, column.to, row.size, column.size) =
                P.block(row.from, column.from, row.size, column.size);
    return moved;
}

// Columns of C at some places among more, which are zero.
Matrix widened(const Matrix& C, const Slots& columns, Index width) {
    Matrix wide = Matrix::Zero(C.rows(), width);
    wide(Eigen::all, columns) = C;
    return wide;
}
}  // namespace

Gaussian::Tail Gaussian::tail(const Awake& constant) const {
    Awake& landmark = const_cast<Awake&>(constant);  // its K does not change, the form of it does
    const Index rows = P_AA_.rows() - landmark.begin;
    const Matrix3 A = landmark.A;
    double *x = landmark.K.data(), *y = x + rows, *z = y + rows;
    for (Index i = 0; i < landmark.waiting; ++i) {
        const double a = x[i], b = y[i], c = z[i];
        x[i] = A(0, 0) * a + A(0, 1) * b + A(0, 2) * c;
        y[i] = A(1, 0) * a + A(1, 1) * b + A(1, 2) * c;
        z[i] = A(2, 0) * a + A(2, 1) * b + A(2, 2) * c;
    }
    landmark.waiting = 0;
    return Tail(x, rows, 3);
}

// As a map of all rows, of which those before the last `n_A - recent_column()` may be waiting.
Gaussian::Tail Gaussian::recent(const Awake& landmark) const {
    const Index begin = std::max(recent_column(), landmark.begin);
    if (landmark.waiting > begin - landmark.begin) return tail(landmark);
    return Tail(const_cast<double*>(landmark.K.data()), P_AA_.rows() - landmark.begin, 3);
}

void Gaussian::turn(Awake& landmark, const Matrix3& A) const {
    const Index waiting = std::max<Index>(0, recent_column() - landmark.begin);
    if (landmark.waiting && landmark.waiting != waiting) tail(landmark);
    landmark.A = landmark.waiting ? Matrix3(A * landmark.A) : A;
    landmark.waiting = waiting;
    const Index rows = P_AA_.rows() - landmark.begin;
    auto K = Tail(landmark.K.data(), rows, 3).bottomRows(rows - waiting);
    K = (K.lazyProduct(A.transpose())).eval();
}

// Lets a landmark depend on columns from `begin` on.
void Gaussian::extend(Awake& landmark, Index begin) const {
    if (landmark.own >= 0 || begin >= landmark.begin) return;
    const Index rows = P_AA_.rows() - begin, before = P_AA_.rows() - landmark.begin;
    std::vector<double> K(3 * rows, 0.0);
    Tail(K.data(), rows, 3).bottomRows(before) = tail(landmark);
    landmark.K.swap(K);
    landmark.begin = begin;
}

// Whether a landmark that is not promoted depends on columns of A.
bool Gaussian::is_used(Index column, Index size) const {
    for (const Awake& landmark : awake_) {
        if (landmark.own >= 0) continue;
        const Index begin = std::max(column, landmark.begin);
        if (begin >= column + size) continue;
        const Tail K = column >= recent_column() ? recent(landmark) : tail(landmark);
        if (!K.middleRows(begin - landmark.begin, column + size - begin).isZero(0.0)) return true;
    }
    return false;
}

// Puts the columns of A in a new order: new column j is `from[j]`, or zero if that is -1. If a column is there twice,
// landmarks depend on the first one.
void Gaussian::rearrange(const Slots& from) {
    const Index before = P_AA_.rows(), n = size_of(from);
    Slots to(before + 1, -1), first = from;
    for (Index j = 0; j < n; ++j) {
        const Index old = from[j];
        if (old < 0) continue;
        if (to[old] >= 0)
            first[j] = -1;
        else
            to[old] = j;
    }
    for (Awake& landmark : awake_) {
        if (landmark.own >= 0)
            landmark.own = landmark.begin = to[landmark.own];
        else
            move(landmark, first);
    }
    for (View* view : {&view_, &previous_, &anchor_})
        if (view->column >= 0) view->column = to[view->column];
    const std::vector<Run> order = runs(from), e = runs(range(0, P_eA_.rows()));
    P_AA_ = picked(P_AA_, order, n, order, n);
    P_eA_ = picked(P_eA_, e, P_eA_.rows(), order, n);
    dormant_.K = picked(dormant_.K, runs(first), n, runs(range(0, dormant_.K.cols())), dormant_.K.cols());
    root_.reset();
}

// Gives K of a landmark the new order of A, see `rearrange`.
void Gaussian::move(Awake& landmark, const Slots& first) const {
    const Index before = P_AA_.rows(), n = size_of(first), begin = landmark.begin;
    Index after = n;
    while (after > 0 && first[after - 1] == before - (n - after) - 1 && before - (n - after) > begin) --after;
    if (before - (n - after) == begin) {  // all of its columns stay together
        landmark.begin = after;
        return;
    }
    after = 0;
    while (after < n && first[after] < begin) ++after;
    const Tail old = tail(landmark);
    std::vector<double> K(3 * (n - after), 0.0);
    Tail moved(K.data(), n - after, 3);
    for (Index j = after; j < n; ++j) {
        const Index row = first[j] - begin;
        if (row < 0) continue;
        for (Index axis = 0; axis < 3; ++axis) moved(j - after, axis) = old(row, axis);
    }
    landmark.K.swap(K);
    landmark.begin = after;
}

// Makes dormant landmarks independent of columns that leave A, see dormant.hpp.
Matrix Gaussian::release(const Slots& leaving) {
    Matrix covariance = Matrix::Zero(size_of(leaving), 3 * dormant_.size());
    if (!dormant_.size() || leaving.empty()) return covariance;
    const Matrix K_o = dormant_.K(leaving, Eigen::all);
    if (K_o.isZero(0.0)) return covariance;
    const Slots kept = complement(leaving, P_AA_.rows());
    const Root root(P_AA_(kept, kept));
    const Matrix F_o = root.coefficients(P_AA_(leaving, kept)), C = root.regression(F_o);
    const Matrix D = P_AA_(leaving, leaving) - F_o * F_o.transpose();
    blas::multiply('T', 'N', 1.0, widened(C, kept, P_AA_.rows()), K_o, 1.0, dormant_.K);
    dormant_.K(leaving, Eigen::all).setZero();
    dormant_.add(K_o.transpose() * Root(D).F, 1.0);
    const Matrix P_eo = P_eA_(Eigen::all, leaving) - P_eA_(Eigen::all, kept) * C.transpose();
    blas::multiply('N', 'N', 1.0, P_eo, K_o, 1.0, dormant_.cross);
    return D * K_o;
}

void Gaussian::drop(const Slots& leaving) {
    if (leaving.empty()) return;
    release(leaving);
    rearrange(complement(leaving, P_AA_.rows()));
}

// Makes dormant landmarks depend on columns that entered A and have a covariance with eps_B, see dormant.hpp.
void Gaussian::absorb(const Slots& entered, const Matrix& cross) {
    if (!dormant_.size() || cross.isZero(0.0)) return;
    const Slots others = complement(entered, P_AA_.rows());
    const Root root(P_AA_(others, others));
    const Matrix F_n = root.coefficients(P_AA_(entered, others)), C = root.regression(F_n);
    const Matrix F_e = root.coefficients(P_eA_(Eigen::all, others));
    const Matrix P_nn = P_AA_(entered, entered);
    const Root given(P_nn - F_n * F_n.transpose(), P_nn.diagonal());
    const Matrix white = given.coefficients(cross.transpose()), gain = given.regression(white).transpose();
    blas::multiply('T', 'N', -1.0, widened(C, others, P_AA_.rows()), gain, 1.0, dormant_.K);
    dormant_.K(entered, Eigen::all) += gain;
    dormant_.add(white, -1.0);
    blas::multiply('N', 'N', -1.0, P_eA_(Eigen::all, entered) - F_e * F_n.transpose(), gain, 1.0, dormant_.cross);
}

// Appends columns K x_A + eps, K^T (n_A, m), to the promoted ones, with S (m, m) of eps and its covariance (e, m) with
// the other columns. Returns the first one.
Index Gaussian::join(const Matrix& K, const Matrix& S, const Matrix& cross) {
    const Index m = K.cols(), n = P_AA_.rows(), at = promoted_;
    Matrix P_Am(n, m), P_em = cross, P_mm = S;
    blas::multiply('N', 'N', 1.0, P_AA_, K, 0.0, P_Am);
    blas::multiply('N', 'N', 1.0, P_eA_, K, 1.0, P_em);
    blas::multiply('T', 'N', 1.0, K, P_Am, 1.0, P_mm);
    Slots from = range(0, at);
    from.insert(from.end(), m, -1);
    append_range(from, at, n);
    rearrange(from);
    P_AA_.block(0, at, at, m) = P_Am.topRows(at);
    P_AA_.block(at + m, at, n - at, m) = P_Am.bottomRows(n - at);
    P_AA_.block(at, at, m, m) = 0.5 * (P_mm + P_mm.transpose());
    P_AA_.middleRows(at, m) = P_AA_.middleCols(at, m).transpose().eval();
    P_eA_.middleCols(at, m) = P_em;
    promoted_ += m;
    return at;
}

void Gaussian::promote(const Slots& rows) {
    if (rows.empty()) return;
    Slots slots;
    for (Index row : rows) slots.push_back(awake_[row].slot);
    const Index m = 3 * size_of(rows);
    const Matrix K = dependence(slots), S = own_covariance(slots);
    Index own = join(K, S, Matrix::Zero(P_eA_.rows(), m));
    for (Index row : rows) {
        Awake& landmark = awake_[row];
        landmark = Awake{landmark.slot, own, own, {}, Matrix3::Zero()};
        own += 3;
    }
}

// Promotes landmarks so that A becomes smallest without the views that only they depend on; returns these columns.
Slots Gaussian::cut() {
    Slots begins;
    for (const Awake& landmark : awake_)
        if (landmark.own < 0) begins.push_back(landmark.begin);
    std::sort(begins.begin(), begins.end());
    Index end = promoted_, best = promoted_, least = 0;
    Index groups = 0;
    for (Index c = 0; c < size_of(groups_); ++c) {
        end += groups_[c];
        if (previous_.column >= promoted_ && previous_.column < end) break;
        const auto joined = std::lower_bound(begins.begin(), begins.end(), end) - begins.begin();
        const Index grows = 3 * joined - (end - promoted_);
        if (grows >= least) continue;
        least = grows;
        groups = c + 1;
        best = end;
    }
    if (!groups) return {};
    const Index dropped = best - promoted_;
    Slots joined, leaving;
    for (Index i = 0; i < size_of(awake_); ++i)
        if (awake_[i].own < 0 && awake_[i].begin < best) joined.push_back(i);
    promote(joined);
    groups_.erase(groups_.begin(), groups_.begin() + groups);
    append_range(leaving, promoted_, promoted_ + dropped);
    return leaving;
}

void Gaussian::close_view() {
    if (columns_.previous >= 0) previous_ = view_;
}

void Gaussian::open_view(const Matrix& Y, const std::optional<Matrix>& Yd) {
    Slots leaving = cut(), from, group;
    const Index z = view_column(), front = front_at(), n = P_AA_.rows();
    const Index groups = promoted_ + size_of(leaving);
    const bool is_anchor = columns_.anchor >= 0 && anchor_.column == z;
    if (is_anchor) {
    } else if (is_used(z, 6) || (columns_.previous >= 0 && previous_.column == z))
        append_range(group, z, z + 6);
    else
        append_range(leaving, z, z + 6);
    if (has_drifted_) append_range(is_used(z + 6, 6) ? group : leaving, z + 6, z + 12);
    release(leaving);
    append_range(from, 0, promoted_);
    append_range(from, groups, z);
    from.insert(from.end(), group.begin(), group.end());
    from.insert(from.end(), Yd ? 12 : 6, -1);
    append_range(from, front, n);
    if (is_anchor) append_range(from, z, z + 6);
    rearrange(from);
    if (!group.empty()) groups_.push_back(size_of(group));
    has_anchor_ = has_anchor_ || is_anchor;
    has_drifted_ = Yd.has_value();
    Y_ = Y;
    Yd_ = Yd ? *Yd : Matrix();
    open_again();
}

// Fills the columns z and zd, which are zero.
void Gaussian::open_again() {
    view_ = View{view_column()};
    enter(view_column(), Y_);
    const Slots entered = range(view_column(), front_at());
    if (has_drifted_) enter(view_column() + 6, Yd_);
    if (!dormant_.size()) return;
    Matrix cross(size_of(entered), dormant_.cross.cols());
    cross.topRows(6) = over(Y_).e * dormant_.cross;
    if (has_drifted_) cross.bottomRows(6) = over(Yd_).e * dormant_.cross;
    absorb(entered, cross);
}

// Renews the views of this frame that a replaced covariance lacks: zd, and z of a model without a block for it.
void Gaussian::restore_views() {
    root_.reset();
    const bool lacks_view = columns_.view < 0, has_drifted = std::exchange(has_drifted_, false);
    Slots from = range(0, P_AA_.rows());
    const Index at = front_at() - (lacks_view ? 0 : 6);
    from.insert(from.begin() + front_at(), (lacks_view ? 6 : 0) + (has_drifted ? 6 : 0), -1);
    rearrange(from);
    has_drifted_ = has_drifted;
    view_ = View{at};
    if (lacks_view && Y_.size()) enter(at, Y_);
    if (has_drifted) enter(at + 6, Yd_);
}

// Fills columns Y x of A.
void Gaussian::enter(Index column, const Matrix& Y) {
    const Over rows = over(Y);
    const Index q = Y.rows();
    Matrix P_A(q, P_AA_.rows()), P_e(q, P_eA_.rows());
    blas::multiply('N', 'N', 1.0, rows.A, P_AA_, 0.0, P_A);
    blas::multiply('N', 'N', 1.0, rows.e, P_eA_, 1.0, P_A);
    blas::multiply('N', 'T', 1.0, rows.A, P_eA_, 0.0, P_e);
    blas::multiply('N', 'N', 1.0, rows.e, P_ee_, 1.0, P_e);
    const Matrix own = P_A * rows.A.transpose() + P_e * rows.e.transpose();
    P_A.middleCols(column, q) = 0.5 * (own + own.transpose());
    P_AA_.middleRows(column, q) = P_A;
    P_AA_.middleCols(column, q) = P_A.transpose();
    P_eA_.middleCols(column, q) = P_e.transpose();
    root_.reset();
}

void Gaussian::hold_anchor() {
    if (has_anchor_) {
        const Index a = P_AA_.rows() - 6, z = view_column();
        const bool stays = is_used(a, 6) || (columns_.previous >= 0 && previous_.column == a);
        Slots from = range(0, z);
        const Slots own = range(a, a + 6);
        if (!stays) release(own);
        if (stays) from.insert(from.end(), own.begin(), own.end());
        append_range(from, z, a);
        anchor_.column = -1;
        rearrange(from);
        has_anchor_ = false;
        if (stays) groups_.push_back(6);
    }
    anchor_ = view_;
}

// Lets columns of the front that are about to change stay in the window, if landmarks depend on them.
void Gaussian::push_front(const Slots& changed) {
    bool stays = dormant_.size() > 0;
    for (Index i : changed) stays = stays || is_used(front_at() + i, 1);
    if (!stays) return;
    Slots from = range(0, view_column());
    for (Index i : changed) from.push_back(front_at() + i);
    append_range(from, view_column(), P_AA_.rows());
    rearrange(from);
    groups_.push_back(size_of(changed));
}

void Gaussian::add_noise(const Matrix& Q) {
    Slots noisy, leaving, of;
    for (Index i = 0; i < front_size(); ++i) {
        if (Q.row(columns_.front[i]).isZero(0.0)) continue;
        noisy.push_back(front_at() + i);
    }
    append_range(leaving, view_column(), front_at());
    const Index views = size_of(leaving);
    leaving.insert(leaving.end(), noisy.begin(), noisy.end());
    const Matrix cross = release(leaving);
    append_range(of, views, size_of(leaving));
    Slots from = range(0, P_AA_.rows());
    std::fill(from.begin() + view_column(), from.begin() + front_at(), -1);
    rearrange(from);
    const Index r = size_of(rest_);
    P_ee_.topLeftCorner(r, r) += Q(rest_, rest_);
    P_eA_.block(0, front_at(), r, front_size()) += Q(rest_, columns_.front);
    P_AA_.block(front_at(), front_at(), front_size(), front_size()) += Q(columns_.front, columns_.front);
    absorb(noisy, cross(of, Eigen::all));
    open_again();
}

}  // namespace ekfslam
