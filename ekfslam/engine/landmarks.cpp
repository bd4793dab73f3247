// Landmarks of the Gaussian: they start, move, sleep, wake and leave.
#include <algorithm>

#include "blas.hpp"
#include "gaussian.hpp"

namespace ekfslam {

// Renews the places of awake landmarks by slot.
void Gaussian::number() {
    std::fill(row_.begin(), row_.end(), -1);
    for (Index i = 0; i < size_of(awake_); ++i) row_[awake_[i].slot] = i;
}

void Gaussian::augment(const Matrix& G, const std::vector<Matrix3>& covariance) {
    const Matrix G_A = by_columns(G);
    const Parts parts = this->parts();
    Matrix K = Matrix::Zero(P_AA_.rows(), G.cols());
    for (const Part& part : parts) K.middleRows(part.column, part.size) += G_A.middleRows(part.row, part.size);
    for (Index i = 0; i < size_of(covariance); ++i) {
        const Index at = 3 * i;
        const Index begin = first_column(parts, G.middleCols(at, 3), view_column());
        Awake landmark{landmarks(), -1, begin, std::vector<double>(3 * (K.rows() - begin)), covariance[i]};
        tail(landmark) = K.middleCols(at, 3).bottomRows(K.rows() - begin);
        row_.push_back(size_of(awake_));
        awake_.push_back(std::move(landmark));
    }
}

void Gaussian::transform_landmarks(const Slots& slots, const std::vector<Matrix3>& M, const std::vector<Matrix36>& B,
                                   Index at) {
    const View* view = view_at(at);
    if (!view) throw Error("landmarks depend on views alone");
    const Slots dormant = dormant_.size() ? dormant_of(slots) : Slots(slots.size(), -1);
    std::vector<Change> promoted;
    for (Index i = 0; i < size_of(slots); ++i) {
        const Matrix3 M_i = M.empty() ? Matrix3::Identity() : M[i];
        const Matrix36 B_i = B[i] * view->E;
        if (dormant[i] >= 0) {
            transform_dormant(dormant[i], M_i, B_i, view->column);
            continue;
        }
        Awake& landmark = awake_[row_[slots[i]]];
        if (landmark.own >= 0) {
            promoted.push_back({landmark.own, M_i, B_i});
            continue;
        }
        extend(landmark, view->column);
        if (!M.empty()) {
            turn(landmark, M_i);
            const Matrix3 S = M_i * landmark.S * M_i.transpose();
            landmark.S = 0.5 * (S + S.transpose());
        }
        Tail K = view->column >= recent_column() ? recent(landmark) : tail(landmark);
        K.middleRows(view->column - landmark.begin, 6) += B_i.transpose();
    }
    if (!promoted.empty()) transform_promoted(promoted, view->column);
}

// Multiplies P_AA from the right, then the promoted rows from the left; the others follow by symmetry.
void Gaussian::transform_promoted(const std::vector<Change>& changes, Index view) {
    const Index n = P_AA_.rows(), p = promoted_;
    Matrix B = Matrix::Zero(p, 6), P_Ap(n, p), P_ep(P_eA_.rows(), p), own(p, p);
    for (const Change& change : changes) B.middleRows(change.own, 3) = change.B;
    blas::multiply('N', 'T', 1.0, P_AA_.middleCols(view, 6), B, 0.0, P_Ap);
    blas::multiply('N', 'T', 1.0, P_eA_.middleCols(view, 6), B, 0.0, P_ep);
    for (const Change& change : changes) {
        auto columns = P_AA_.middleCols<3>(change.own), columns_e = P_eA_.middleCols<3>(change.own);
        P_Ap.middleCols<3>(change.own) += columns.lazyProduct(change.M.transpose());
        P_ep.middleCols<3>(change.own) += columns_e.lazyProduct(change.M.transpose());
        columns = P_Ap.middleCols<3>(change.own);
        columns_e = P_ep.middleCols<3>(change.own);
    }
    blas::multiply('N', 'N', 1.0, B, P_AA_.block(view, 0, 6, p), 0.0, own);
    for (Index j = 0; j < p; ++j)  // the lower triangle
        for (const Change& change : changes) {
            if (change.own + 2 < j) continue;
            const Vector3 column = P_AA_.block<3, 1>(change.own, j);
            P_AA_.block<3, 1>(change.own, j) = change.M * column + own.block<3, 1>(change.own, j);
        }
    blas::mirror(P_AA_.topLeftCorner(p, p));
    P_AA_.topRightCorner(p, n - p) = P_AA_.bottomLeftCorner(n - p, p).transpose();
    root_.reset();
    if (!dormant_.size()) return;
    for (const Change& change : changes) {  // dormant landmarks stay: x_own = M^-1 (x_own+ - B z)
        auto K = dormant_.K.middleRows(change.own, 3);
        K = (change.M.inverse().transpose() * K).eval();
        dormant_.K.middleRows(view, 6) -= change.B.transpose() * K;
    }
}

void Gaussian::transform_dormant(Index which, const Matrix3& M, const Matrix36& B, Index view) {
    if (M != Matrix3::Identity()) {
        dormant_.turn(which, M);
        dormant_.K.middleCols(3 * which, 3) = (dormant_.K.middleCols(3 * which, 3) * M.transpose()).eval();
    }
    dormant_.K.block(view, 3 * which, 6, 3) += B.transpose();
}

void Gaussian::rest(const Flags& asleep) {
    Flags wakes(asleep.size()), tires(awake_.size());
    bool some_wake = false, some_tire = false;
    for (Index slot = 0; slot < size_of(asleep); ++slot) {
        const Index row = row_[slot];
        wakes[slot] = row < 0 && !asleep[slot];
        some_wake = some_wake || wakes[slot];
        if (row < 0 || !asleep[slot]) continue;
        tires[row] = true;
        some_tire = true;
    }
    if (some_wake) wake(wakes);
    if (!some_tire) return;
    tires.resize(awake_.size(), false);
    Slots slots;
    std::vector<Matrix3> S;
    for (Index i = 0; i < size_of(tires); ++i) {
        if (!tires[i]) continue;
        slots.push_back(awake_[i].slot);
        S.push_back(awake_[i].S);
    }
    dormant_.append(slots, dependence(slots), S);
    forget(tires);
}

void Gaussian::wake(const Flags& wakes) {
    Slots which, others;
    for (Index i = 0; i < dormant_.size(); ++i) {
        const bool is_one = wakes[dormant_.slot[i]];
        (is_one ? which : others).push_back(i);
    }
    const Slots own = triples(which), rest = triples(others);
    const Matrix rows = dormant_.rows(own), S = rows(Eigen::all, own), S_br = rows(Eigen::all, rest).transpose();
    const Matrix K = dormant_.K(Eigen::all, own), cross = dormant_.cross(Eigen::all, own);
    Slots slots;
    for (Index i : which) slots.push_back(dormant_.slot[i]);
    dormant_.keep(others);
    Index at = join(K, S, cross);
    const Root root(S);
    const Matrix white = root.coefficients(S_br), gain = root.regression(white).transpose();
    // The part of the new columns that A did not know is eps_R.
    Matrix K_after = Matrix::Zero(P_AA_.rows(), own.size());
    K_after.topRows(at) = K.topRows(at);
    K_after.bottomRows(K.rows() - at) = K.bottomRows(K.rows() - at);
    dormant_.K -= K_after * gain;
    dormant_.K.middleRows(at, gain.rows()) += gain;
    dormant_.add(white, -1.0);
    dormant_.cross -= cross * gain;
    for (Index slot : slots) {
        awake_.push_back(Awake{slot, at, at, {}, Matrix3::Zero()});
        at += 3;
    }
    number();
}

// Removes awake landmarks, and their columns if they are promoted.
void Gaussian::forget(const Flags& gone) {
    Slots leaving;
    Index kept = 0;
    for (Index i = 0; i < size_of(awake_); ++i) {
        if (!gone[i]) {
            if (kept != i) awake_[kept] = std::move(awake_[i]);
            ++kept;
        } else if (awake_[i].own >= 0) {
            append_range(leaving, awake_[i].own, awake_[i].own + 3);
        }
    }
    awake_.resize(kept);
    number();
    promoted_ -= size_of(leaving);
    drop(leaving);
}

void Gaussian::marginalise(const Flags& stay) {
    Slots dormant, renamed(stay.size());
    for (Index i = 0; i < dormant_.size(); ++i)
        if (stay[dormant_.slot[i]]) dormant.push_back(i);
    if (size_of(dormant) < dormant_.size()) dormant_.keep(dormant);
    Flags gone;
    for (const Awake& landmark : awake_) gone.push_back(!stay[landmark.slot]);
    forget(gone);
    Index after = 0;
    for (Index slot = 0; slot < size_of(stay); ++slot) renamed[slot] = stay[slot] ? after++ : -1;
    for (Awake& landmark : awake_) landmark.slot = renamed[landmark.slot];
    for (Index& slot : dormant_.slot) slot = renamed[slot];
    row_.resize(after);
    number();
}

void Gaussian::replace(const Matrix& P) {
    const Index b = columns_.body + considered_, n = (P.rows() - b) / 3;
    Slots A = range(b, b + 3 * n), e = rest_;
    const auto add = [&A](Index at) {
        append_range(A, at, at + 6);
        return View{size_of(A) - 6};
    };
    if (columns_.previous >= 0) previous_ = add(columns_.previous);
    if (columns_.view >= 0) view_ = add(columns_.view);
    A.insert(A.end(), columns_.front.begin(), columns_.front.end());
    if (columns_.anchor >= 0) anchor_ = add(columns_.anchor);
    append_range(e, columns_.body, b);
    P_AA_ = P(A, A);
    P_eA_ = P(e, A);
    P_ee_ = P(e, e);
    groups_.assign(columns_.previous >= 0 ? 1 : 0, 6);
    promoted_ = 3 * n;
    has_anchor_ = columns_.anchor >= 0;
    awake_.clear();
    row_.assign(n, -1);
    for (Index i = 0; i < n; ++i) awake_.push_back(Awake{i, 3 * i, 3 * i, {}, Matrix3::Zero()});
    number();
    dormant_ = Dormant();
    dormant_.K.resize(P_AA_.rows(), 0);
    dormant_.cross.resize(P_eA_.rows(), 0);
    restore_views();
}

}  // namespace ekfslam
