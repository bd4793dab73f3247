// Covariances that leave the Gaussian, and the body: propagation, transformation, considered columns.
#include "gaussian.hpp"

#include <algorithm>
#include <utility>

#include "blas.hpp"

namespace ekfslam {

namespace {
bool contains(const Slots& some, Index value) { return std::find(some.begin(), some.end(), value) != some.end(); }

bool is_within(Index j, Index begin) { return begin >= 0 && j >= begin && j < begin + 6; }
}  // namespace

Gaussian::Gaussian(const Matrix& P_body, Columns columns) : columns_(std::move(columns)) {
    const Columns& c = columns_;
    for (Index j = 0; j < c.body; ++j)
        if (!is_within(j, c.view) && !is_within(j, c.previous) && !is_within(j, c.anchor) && !contains(c.front, j))
            rest_.push_back(j);
    replace(P_body);
}

Lead Gaussian::lead() const {
    Lead lead;
    lead.front = front_size() + (columns_.anchor >= 0 ? 6 : 0);
    lead.width = lead.front;
    const auto next = [&lead] { return std::exchange(lead.width, lead.width + 6); };
    if (has_drifted_) lead.drifted = next();
    lead.view = next();
    if (columns_.previous >= 0) lead.previous = next();
    return lead;
}

const Gaussian::View* Gaussian::view_at(Index at) const {
    if (at == columns_.view) return &view_;
    if (at >= 0 && at == columns_.previous) return &previous_;
    if (at >= 0 && at == columns_.anchor) return &anchor_;
    return nullptr;
}

Gaussian::View* Gaussian::view_at(Index at) { return const_cast<View*>(std::as_const(*this).view_at(at)); }

Slots Gaussian::body_places() const {
    const Index e = P_AA_.rows();
    Slots places(columns_.body + considered_);
    const auto set = [&places](Index column, Index place) { places[column] = place; };
    for (Index i = 0; i < size_of(rest_); ++i) set(rest_[i], e + i);
    for (Index i = 0; i < front_size(); ++i) set(columns_.front[i], front_at() + i);
    for (Index at : {columns_.view, columns_.previous, columns_.anchor})
        for (Index i = 0; at >= 0 && i < 6; ++i) set(at + i, view_at(at)->column + i);
    for (Index i = 0; i < considered_; ++i) set(columns_.body + i, e + size_of(rest_) + i);
    return places;
}

double Gaussian::entry(Index i, Index j) const {
    const Index n = P_AA_.rows();
    if (i < n) return j < n ? P_AA_(i, j) : P_eA_(j - n, i);
    return j < n ? P_eA_(i - n, j) : P_ee_(i - n, j - n);
}

Matrix Gaussian::gathered(const Slots& rows, const Slots& columns) const {
    Matrix P(size_of(rows), size_of(columns));
    for (Index j = 0; j < P.cols(); ++j)
        for (Index i = 0; i < P.rows(); ++i) P(i, j) = entry(rows[i], columns[j]);
    return P;
}

void Gaussian::turn_views(Matrix& P) const {
    for (Index at : {columns_.view, columns_.previous, columns_.anchor}) {
        if (at < 0) continue;
        const Matrix6& E = view_at(at)->E;
        P.middleRows(at, 6) = (E * P.middleRows(at, 6)).eval();
        P.middleCols(at, 6) = (P.middleCols(at, 6) * E.transpose()).eval();
    }
}

Matrix Gaussian::body_covariance() const {
    const Slots places = body_places();
    Matrix P = gathered(places, places);
    turn_views(P);
    return P;
}

Slots Gaussian::dormant_of(const Slots& slots) const {
    Slots which(row_.size(), -1), found;
    for (Index i = 0; i < dormant_.size(); ++i) which[dormant_.slot[i]] = i;
    for (Index slot : slots) found.push_back(which[slot]);
    return found;
}

Matrix Gaussian::dependence(const Slots& slots) const {
    const Slots dormant = dormant_of(slots);
    Matrix K = Matrix::Zero(P_AA_.rows(), 3 * size_of(slots));
    for (Index i = 0; i < size_of(slots); ++i) {
        auto own = K.middleCols(3 * i, 3);
        if (dormant[i] >= 0) {
            own = dormant_.K.middleCols(3 * dormant[i], 3);
            continue;
        }
        const Awake& landmark = awake_[row_[slots[i]]];
        if (landmark.own >= 0)
            own.middleRows(landmark.own, 3).setIdentity();
        else
            own.bottomRows(P_AA_.rows() - landmark.begin) = tail(landmark);
    }
    return K;
}

Matrix Gaussian::own_covariance(const Slots& slots) const {
    const Slots dormant = dormant_of(slots);
    Matrix S = Matrix::Zero(3 * size_of(slots), 3 * size_of(slots));
    Slots asleep, at;
    for (Index i = 0; i < size_of(slots); ++i) {
        if (dormant[i] >= 0) {
            asleep.push_back(dormant[i]);
            at.push_back(i);
        } else {
            const Index own = 3 * i;
            S.block<3, 3>(own, own) = awake_[row_[slots[i]]].S;
        }
    }
    if (!at.empty()) S(triples(at), triples(at)) = dormant_.rows(triples(asleep))(Eigen::all, triples(asleep));
    return S;
}

Matrix Gaussian::covariance_of(const Slots& slots) const {
    const Index b = columns_.body + considered_, m = 3 * size_of(slots), n = P_AA_.rows();
    const Slots places = body_places(), dormant = dormant_of(slots);
    const Matrix K = dependence(slots);
    Matrix P_ed(P_eA_.rows(), m), P_Ad(n, m);
    blas::multiply('N', 'N', 1.0, P_AA_, K, 0.0, P_Ad);
    blas::multiply('N', 'N', 1.0, P_eA_, K, 0.0, P_ed);
    for (Index i = 0; i < size_of(slots); ++i)
        if (dormant[i] >= 0) P_ed.middleCols(3 * i, 3) += dormant_.cross.middleCols(3 * dormant[i], 3);
    Matrix P(b + m, b + m);
    P.topLeftCorner(b, b) = gathered(places, places);
    for (Index j = 0; j < b; ++j) {
        const Index place = places[j];
        P.row(j).tail(m) = place < n ? P_Ad.row(place) : P_ed.row(place - n);
    }
    P.bottomLeftCorner(m, b) = P.topRightCorner(b, m).transpose();
    turn_views(P);
    Matrix own = own_covariance(slots);
    blas::multiply('T', 'N', 1.0, K, P_Ad, 1.0, own);
    P.bottomRightCorner(m, m) = 0.5 * (own + own.transpose());
    return P;
}

std::vector<Matrix3> Gaussian::landmark_blocks(const Slots& slots) const {
    std::vector<Matrix3> blocks(slots.size());
    Slots others;
    Slots at;
    Index begin = P_AA_.rows();
    for (Index i = 0; i < size_of(slots); ++i) {
        const Index row = row_[slots[i]];
        const Awake* landmark = row < 0 ? nullptr : &awake_[row];
        if (landmark && landmark->own >= 0) {
            blocks[i] = P_AA_.block<3, 3>(landmark->own, landmark->own);
            continue;
        }
        begin = landmark ? std::min(begin, landmark->begin) : 0;
        others.push_back(slots[i]);
        at.push_back(i);
    }
    const Slots dormant = dormant_of(others);
    const Matrix K = dependence(others).bottomRows(P_AA_.rows() - begin);
    Matrix PK(K.rows(), K.cols());
    blas::multiply('N', 'N', 1.0, P_AA_.bottomRightCorner(K.rows(), K.rows()), K, 0.0, PK);
    for (Index i = 0; i < size_of(others); ++i) {
        const Index own = 3 * i, row = row_[others[i]];
        const Matrix3 P = K.middleCols(own, 3).transpose() * PK.middleCols(own, 3);
        blocks[at[i]] = 0.5 * (P + P.transpose());
        blocks[at[i]] += row < 0 ? dormant_.block(dormant[i]) : awake_[row].S;
    }
    return blocks;
}

Gaussian::Parts Gaussian::parts() const {
    const Lead at = lead();
    Parts parts{{0, front_at(), front_size(), nullptr}};
    if (columns_.anchor >= 0) parts.push_back({front_size(), anchor_.column, 6, &anchor_});
    if (at.drifted >= 0) parts.push_back({at.drifted, view_column() + 6, 6, nullptr});
    parts.push_back({at.view, view_.column, 6, &view_});
    if (at.previous >= 0) parts.push_back({at.previous, previous_.column, 6, &previous_});
    return parts;
}

Index Gaussian::first_column(const Parts& parts, const Eigen::Ref<const Matrix>& H, Index begin) {
    for (const Part& part : parts)
        if (part.column < begin && !H.middleRows(part.row, part.size).isZero(0.0)) begin = part.column;
    return begin;
}

Gaussian::Over Gaussian::over(const Matrix& H) const {
    Over rows{Matrix::Zero(H.rows(), P_AA_.rows()), Matrix::Zero(H.rows(), P_eA_.rows())};
    for (Index i = 0; i < size_of(rest_); ++i) rows.e.col(i) = H.col(rest_[i]);
    for (Index i = 0; i < front_size(); ++i) rows.A.col(front_at() + i) = H.col(columns_.front[i]);
    for (Index at : {columns_.view, columns_.previous, columns_.anchor})
        if (at >= 0) rows.A.middleCols(view_at(at)->column, 6) += H.middleCols(at, 6) * view_at(at)->E;
    return rows;
}

void Gaussian::propagate(const Matrix& Phi, const Matrix& Q) {
    Slots body = rest_, changed;
    body.insert(body.end(), columns_.front.begin(), columns_.front.end());
    for (Index i = 0; i < front_size(); ++i) {
        const Index j = columns_.front[i];
        const bool stays = Phi(j, j) == 1.0 && (Phi.row(j).array() != 0.0).count() == 1;
        if (!stays || !Q.row(j).isZero(0.0)) changed.push_back(i);
    }
    if (!changed.empty()) push_front(changed);
    const Index r = size_of(rest_), n = P_AA_.rows(), b = size_of(body);
    Slots at = range(n, n + r);
    append_range(at, front_at(), front_at() + front_size());
    const Matrix Phi_b = Phi(body, body), Q_b = Q(body, body);
    Matrix before(b, n + P_eA_.rows());  // rows of P over [A, e]
    before.topLeftCorner(r, n) = P_eA_.topRows(r);
    before.topRightCorner(r, P_eA_.rows()) = P_ee_.topRows(r);
    before.bottomLeftCorner(b - r, n) = P_AA_.middleRows(front_at(), b - r);
    before.bottomRightCorner(b - r, P_eA_.rows()) = P_eA_.middleCols(front_at(), b - r).transpose();
    Matrix rows(b, before.cols());
    blas::multiply('N', 'N', 1.0, Phi_b, before, 0.0, rows);
    const Matrix P_bb = Matrix(rows(Eigen::all, at)) * Phi_b.transpose() + Q_b;
    rows(Eigen::all, at) = 0.5 * (P_bb + P_bb.transpose());
    const Matrix P_fe = rows.bottomRows(front_size()).rightCols(P_eA_.rows());
    P_eA_.topRows(r) = rows.topRows(r).leftCols(n);
    P_eA_.middleCols(front_at(), front_size()) = P_fe.transpose();
    P_ee_.topRows(r) = rows.topRows(r).rightCols(P_eA_.rows());
    P_ee_.leftCols(r) = P_ee_.topRows(r).transpose().eval();
    P_AA_.middleRows(front_at(), front_size()) = rows.bottomRows(front_size()).leftCols(n);
    P_AA_.middleCols(front_at(), front_size()) = P_AA_.middleRows(front_at(), front_size()).transpose().eval();
    root_.reset();
    if (!dormant_.size()) return;
    const Matrix cross = Phi_b.leftCols(r) * dormant_.cross.topRows(r);
    dormant_.cross.topRows(r) = cross.topRows(r);
    Slots entered, of;
    for (Index i : changed) entered.push_back(front_at() + i), of.push_back(r + i);
    if (!entered.empty()) absorb(entered, cross(of, Eigen::all));
}

void Gaussian::transform_body(Index at, const Matrix& A) {
    if (View* view = view_at(at)) {
        view->E = A * view->E;
        return;
    }
    const Slots places = body_places();
    Slots some[2], of[2];  // places in A and in e, and the rows of the matrix
    for (Index i = 0; i < A.rows(); ++i) {
        const Index place = places[at + i], is_e = place >= P_AA_.rows();
        some[is_e].push_back(place);
        of[is_e].push_back(i);
    }
    if (!A(of[0], of[1]).isZero(0.0) || !A(of[1], of[0]).isZero(0.0))
        throw Error("a transformation mixes columns on which landmarks depend with others");
    for (int part : {0, 1})
        if (!of[part].empty()) transform_columns(some[part], A(of[part], of[part]));
}

void Gaussian::transform_columns(const Slots& at, const Matrix& A) {
    const Index n = P_AA_.rows();
    Slots in_e;
    for (Index place : at) in_e.push_back(place - n);
    if (at.front() >= n) {
        P_eA_(in_e, Eigen::all) = (A * P_eA_(in_e, Eigen::all)).eval();
        P_ee_(in_e, Eigen::all) = (A * P_ee_(in_e, Eigen::all)).eval();
        P_ee_(Eigen::all, in_e) = (P_ee_(Eigen::all, in_e) * A.transpose()).eval();
        dormant_.cross(in_e, Eigen::all) = (A * dormant_.cross(in_e, Eigen::all)).eval();
        root_.reset();
        return;
    }
    P_AA_(at, Eigen::all) = (A * P_AA_(at, Eigen::all)).eval();
    P_AA_(Eigen::all, at) = (P_AA_(Eigen::all, at) * A.transpose()).eval();
    P_eA_(Eigen::all, at) = (P_eA_(Eigen::all, at) * A.transpose()).eval();
    const Matrix back = A.inverse().transpose();
    dormant_.K(at, Eigen::all) = (back * dormant_.K(at, Eigen::all)).eval();
    for (Awake& landmark : awake_) {
        if (landmark.own >= 0) continue;
        Slots rows;
        for (Index place : at) rows.push_back(place - landmark.begin);
        tail(landmark)(rows, Eigen::all) = (back * tail(landmark)(rows, Eigen::all)).eval();
    }
    root_.reset();
}

Index Gaussian::consider(Index columns) {
    const Index first = columns_.body + considered_, e = P_eA_.rows() + columns;
    considered_ += columns;
    P_eA_.conservativeResizeLike(Matrix::Zero(e, P_eA_.cols()));
    P_ee_.conservativeResizeLike(Matrix::Zero(e, e));
    dormant_.cross.conservativeResizeLike(Matrix::Zero(e, dormant_.cross.cols()));
    root_.reset();
    return first;
}

void Gaussian::clone(Index source, Index size, Index to) {
    Matrix H = Matrix::Zero(size, columns_.body);
    H.middleCols(source, size).setIdentity();
    const Over rows = over(H);
    const Index at = size_of(rest_) + to - columns_.body;
    const Matrix P_A = rows.A * P_AA_ + rows.e * P_eA_;
    Matrix P_e = rows.A * P_eA_.transpose() + rows.e * P_ee_;
    const Matrix own = P_A * rows.A.transpose() + P_e * rows.e.transpose();
    P_e.middleCols(at, size) = 0.5 * (own + own.transpose());
    P_eA_.middleRows(at, size) = P_A;
    P_ee_.middleRows(at, size) = P_e;
    P_ee_.middleCols(at, size) = P_e.transpose();
    dormant_.cross.middleRows(at, size) = (rows.e * dormant_.cross).eval();
    root_.reset();
}

}  // namespace ekfslam
