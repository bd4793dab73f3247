// Landmarks of the Gaussian: they start, move, sleep, wake and leave.
#include <algorithm>
#include <numeric>

#include "blas.hpp"
#include "gaussian.hpp"

namespace ekfslam {

// Renews the places of awake landmarks by slot.
void Gaussian::number() {
    std::fill(row_.begin(), row_.end(), -1);
    for (std::size_t i = 0; i < awake_.size(); ++i)
        row_[static_cast<std::size_t>(awake_[i].slot)] = static_cast<Index>(i);
}

void Gaussian::augment(const Matrix& G, const std::vector<Matrix3>& covariance) {
    const Matrix K = lead_over(G);
    const Lead lead = this->lead();
    for (std::size_t i = 0; i < covariance.size(); ++i) {
        const Index at = static_cast<Index>(3 * i);
        Index begin = view_column();
        const auto depends = [&](Index row, const View& view) {
            if (row >= 0 && !G.block(row, at, 6, 3).isZero(0.0)) begin = std::min(begin, view.column);
        };
        depends(lead.previous, previous_);
        depends(columns_.anchor >= 0 ? front_size() : -1, anchor_);
        Awake landmark{landmarks(), -1, begin, std::vector<double>(static_cast<std::size_t>(3 * (K.rows() - begin))),
                       covariance[i]};
        tail(landmark) = K.middleCols(at, 3).bottomRows(K.rows() - begin);
        row_.push_back(static_cast<Index>(awake_.size()));
        awake_.push_back(std::move(landmark));
    }
}

void Gaussian::transform_landmarks(const Slots& slots, const std::vector<Matrix3>& M, const std::vector<Matrix36>& B,
                                   Index at) {
    const View* view = view_at(at);
    if (!view) throw Error("landmarks depend on views alone");
    const std::vector<Index> dormant = dormant_.size() ? dormant_of(slots) : std::vector<Index>(slots.size(), -1);
    std::vector<Change> promoted;
    for (std::size_t i = 0; i < slots.size(); ++i) {
        const Matrix3 M_i = M.empty() ? Matrix3::Identity() : M[i];
        const Matrix36 B_i = B[i] * view->E;
        if (dormant[i] >= 0) {
            transform_dormant(dormant[i], M_i, B_i, view->column);
            continue;
        }
        Awake& landmark = awake_[static_cast<std::size_t>(row_[static_cast<std::size_t>(slots[i])])];
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

void Gaussian::rest(const std::vector<bool>& asleep) {
    std::vector<bool> wakes(asleep.size()), tires(awake_.size());
    bool some_wake = false, some_tire = false;
    for (std::size_t slot = 0; slot < asleep.size(); ++slot) {
        const Index row = row_[slot];
        wakes[slot] = row < 0 && !asleep[slot];
        some_wake = some_wake || wakes[slot];
        if (row < 0 || !asleep[slot]) continue;
        tires[static_cast<std::size_t>(row)] = true;
        some_tire = true;
    }
    if (some_wake) wake(wakes);
    if (!some_tire) return;
    tires.resize(awake_.size(), false);
    Slots slots;
    std::vector<Matrix3> S;
    for (std::size_t i = 0; i < tires.size(); ++i) {
        if (!tires[i]) continue;
        slots.push_back(awake_[i].slot);
        S.push_back(awake_[i].S);
    }
    dormant_.append(slots, dependence(slots), S);
    forget(tires);
}

void Gaussian::wake(const std::vector<bool>& wakes) {
    std::vector<Index> which, others;
    for (Index i = 0; i < dormant_.size(); ++i) {
        const bool is_one = wakes[static_cast<std::size_t>(dormant_.slot[static_cast<std::size_t>(i)])];
        (is_one ? which : others).push_back(i);
    }
    const std::vector<Index> own = triples(which), rest = triples(others);
    const Matrix rows = dormant_.rows(own), S = rows(Eigen::all, own), S_br = rows(Eigen::all, rest).transpose();
    const Matrix K = dormant_.K(Eigen::all, own), cross = dormant_.cross(Eigen::all, own);
    Slots slots;
    for (Index i : which) slots.push_back(dormant_.slot[static_cast<std::size_t>(i)]);
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
void Gaussian::forget(const std::vector<bool>& gone) {
    std::vector<Index> leaving;
    std::size_t kept = 0;
    for (std::size_t i = 0; i < awake_.size(); ++i) {
        if (!gone[i]) {
            if (kept != i) awake_[kept] = std::move(awake_[i]);
            ++kept;
        } else if (awake_[i].own >= 0) {
            for (Index axis = 0; axis < 3; ++axis) leaving.push_back(awake_[i].own + axis);
        }
    }
    awake_.resize(kept);
    number();
    promoted_ -= static_cast<Index>(leaving.size());
    drop(leaving);
}

void Gaussian::marginalise(const std::vector<bool>& stay) {
    std::vector<Index> dormant, renamed(stay.size());
    for (Index i = 0; i < dormant_.size(); ++i)
        if (stay[static_cast<std::size_t>(dormant_.slot[static_cast<std::size_t>(i)])]) dormant.push_back(i);
    if (static_cast<Index>(dormant.size()) < dormant_.size()) dormant_.keep(dormant);
    std::vector<bool> gone;
    for (const Awake& landmark : awake_) gone.push_back(!stay[static_cast<std::size_t>(landmark.slot)]);
    forget(gone);
    Index after = 0;
    for (std::size_t slot = 0; slot < stay.size(); ++slot) renamed[slot] = stay[slot] ? after++ : -1;
    for (Awake& landmark : awake_) landmark.slot = renamed[static_cast<std::size_t>(landmark.slot)];
    for (Index& slot : dormant_.slot) slot = renamed[static_cast<std::size_t>(slot)];
    row_.resize(static_cast<std::size_t>(after));
    number();
}

void Gaussian::replace(const Matrix& P) {
    const Index b = columns_.body + considered_, n = (P.rows() - b) / 3;
    std::vector<Index> A(static_cast<std::size_t>(3 * n)), e = rest_;
    std::iota(A.begin(), A.end(), b);
    const auto add = [&A](Index at) {
        for (Index i = 0; i < 6; ++i) A.push_back(at + i);
        return View{static_cast<Index>(A.size()) - 6};
    };
    if (columns_.previous >= 0) previous_ = add(columns_.previous);
    if (columns_.view >= 0) view_ = add(columns_.view);
    A.insert(A.end(), columns_.front.begin(), columns_.front.end());
    if (columns_.anchor >= 0) anchor_ = add(columns_.anchor);
    for (Index i = 0; i < considered_; ++i) e.push_back(columns_.body + i);
    P_AA_ = P(A, A);
    P_eA_ = P(e, A);
    P_ee_ = P(e, e);
    groups_.assign(columns_.previous >= 0 ? 1 : 0, 6);
    promoted_ = 3 * n;
    has_anchor_ = columns_.anchor >= 0;
    awake_.clear();
    row_.assign(static_cast<std::size_t>(n), -1);
    for (Index i = 0; i < n; ++i) awake_.push_back(Awake{i, 3 * i, 3 * i, {}, Matrix3::Zero()});
    number();
    dormant_ = Dormant();
    dormant_.K.resize(P_AA_.rows(), 0);
    dormant_.cross.resize(P_eA_.rows(), 0);
    restore_views();
}

}  // namespace ekfslam
