#include "starting.hpp"

#include <algorithm>

#include "model.hpp"
#include "retraction.hpp"
#include "se3.hpp"
#include "table.hpp"

namespace ekfslam {

namespace {

// Standard deviation of a first depth by the noise of two views, as a share of the depth, up to which they are enough.
constexpr double LARGEST_DEPTH_ERROR = 0.1;

Matrix4 view_of(const Estimate& e) {
    return e.columns.view >= 0 ? e.values.view() : camera_pose(e, e.values, e.imu_twist, false);
}

// Write new landmarks into the table, after `views` observations each.
void enter(Estimate& e, Index frame, const Ids& ids, const Matrix& position_m, const Matrix& rows, Index views) {
    Table fresh = blank(size_of(ids), rows.rows());
    fresh.id = ids;
    for (Ids* column : {&fresh.first_frame, &fresh.last_frame}) column->assign(ids.size(), frame);
    for (Ids* column : {&fresh.first_step, &fresh.last_step}) column->assign(ids.size(), e.step);
    fresh.observations.assign(ids.size(), views);
    fresh.position_m = fresh.initial_m = position_m;
    fresh.seen_rows = rows;
    append(e.table, fresh);
}

}  // namespace

Started start(Estimate& e, Index frame, const Ids& ids, const Matrix& rows) {
    const Lead lead = e.gaussian.lead();
    const Intrinsics intrinsics(e, e.values);
    const Sensor& sensor = intrinsics.sensor;
    Started out;
    Slots some;
    for (Index i = 0; i < rows.cols(); ++i) {
        const bool is_calibrated = e.values.places.calibration >= 0;
        out.which.push_back(!is_calibrated || sensor.has_depth(sensor.invert(rows.col(i))));
        if (out.which.back()) some.push_back(i);
    }
    const auto n = size_of(some);
    out.rows = columns_of(rows, some);
    out.variance = e.sensor.variance(n);
    out.position_m.resize(3, n);
    if (n == 0) return out;
    if (e.track_error) out.variance.colwise() = e.track_error->absolute_variance(0);
    const Matrix4 back = se3::inverse(view_of(e));
    const Matrix3 R_world = se3::rotation(back);
    Matrix G = Matrix::Zero(lead.width, 3 * n);
    std::vector<Matrix3> covariance(some.size());
    for (Index j = 0; j < n; ++j) {
        const Vector3 q = sensor.invert(out.rows.col(j));
        const Matrix3 by_rows = R_world * sensor.jacobian(q).inverse();
        out.position_m.col(j) = se3::apply(back, q);
        // Rows stay the same, H_x x + H_m d = 0, hence G = -H_m^-1 H_x.
        G.block<6, 3>(lead.view, 3 * j) = (-R_world * se3::by_frame(q)).transpose();
        if (intrinsics.is_free())
            for (Index c = 0; c < 3; ++c) intrinsics.add(q, -by_rows(c, 2), G.col(3 * j + c));
        const Matrix3 C = by_rows * out.variance.col(j).asDiagonal() * by_rows.transpose();
        covariance[j] = 0.5 * (C + C.transpose());
    }
    e.gaussian.augment(G, covariance);
    enter(e, frame, picked(ids, some), out.position_m, out.rows, 1);
    return out;
}

// --- Waiting for a second view ---------------------------------------------------------------------------------------
//
// Once the parallax from the anchor suffices, both views of a landmark, r = H_x x + H_m d + n whitened, are split by
// the QR factorisation H_m = [Q_1 Q_2] [R; 0]: d = R^-1 Q_1^T (r - H_x x - n) starts it, and Q_2^T r = Q_2^T H_x x +
// Q_2^T n is a measurement of both views. Li and Mourikis, "Optimization-based estimator design", RSS 2012.

namespace {

using Vector4 = Eigen::Vector4d;
using Matrix43 = Eigen::Matrix<double, 4, 3>;
using ByViews = Eigen::Matrix<double, 4, 12>;  // anchor, present view

// A landmark seen twice.
struct Pair {
    Index which;  // among the new tracks
    Vector3 then, now, position;
    ByViews by_views;  // Q^T H_x
    Vector4 residual;  // Q^T r
    Matrix3 R_inverse;
    Vector4 variance;  // of the rows of both views
};

Vector3 padded(const Matrix& rows, Index i) { return {rows(0, i), rows(1, i), 0.0}; }

// Variances of the rows of both views. If tracks have errors, the second ones are those of a difference.
Vector4 variances(const Estimate& e, const Matrix4& anchor, const Matrix4& view, const Pair& pair, Index frames) {
    Vector4 out;
    if (e.track_error) {
        const double way_m = se3::translation(view * se3::inverse(anchor)).norm();
        const double depth_m = std::max(se3::apply(view, pair.position).z(), e.config.min_depth_m);
        const Vector3 step = e.track_error->step_variance(pair.now - pair.then, way_m / depth_m, frames);
        out << e.track_error->absolute_variance(0).head<2>(), step.head<2>();
    } else {
        out << e.sensor.variance_px2.head<2>(), e.sensor.variance_px2.head<2>();
    }
    return out;
}

void split(const Estimate& e, const Matrix4& anchor, const Matrix4& view, Index frames, Pair& pair) {
    Matrix43 H_m;
    ByViews H_x = ByViews::Zero();
    Vector4 r;
    for (const Index part : {0, 1}) {
        const Matrix4& W = part == 0 ? anchor : view;
        const Vector3 q = se3::apply(W, pair.position), rows = part == 0 ? pair.then : pair.now;
        const Eigen::Matrix<double, 2, 3> A = e.sensor.jacobian(q).topRows<2>();
        H_m.middleRows<2>(2 * part) = A * se3::rotation(W);
        H_x.block<2, 6>(2 * part, 6 * part) = A * se3::by_frame(q);
        r.segment<2>(2 * part) = (rows - e.sensor.predict(q)).head<2>();
    }
    if (e.track_error) {  // eq. (10)
        H_m.bottomRows<2>() -= H_m.topRows<2>();
        H_x.bottomRows<2>() -= H_x.topRows<2>();
        r.tail<2>() -= r.head<2>();
    }
    pair.variance = variances(e, anchor, view, pair, frames);
    const Vector4 scale = pair.variance.array().rsqrt();
    H_m = scale.asDiagonal() * H_m;
    H_x = scale.asDiagonal() * H_x;
    r = scale.asDiagonal() * r;
    const Eigen::HouseholderQR<Matrix43> qr(H_m);
    const Matrix4 Q = qr.householderQ();
    pair.R_inverse = Matrix3((Q.transpose() * H_m).topRows<3>().triangularView<Eigen::Upper>()).inverse();
    pair.by_views = Q.transpose() * H_x;
    pair.residual = Q.transpose() * r;
}

// The rows (k, body) that two views leave.
Matrix rest(const Estimate& e, const std::vector<Pair>& pairs) {
    Matrix H = Matrix::Zero(size_of(pairs), e.columns.body);
    for (Index j = 0; j < H.rows(); ++j) {
        const auto row = pairs[j].by_views.row(3);
        H.block<1, 6>(j, e.columns.anchor) = row.head<6>();
        H.block<1, 6>(j, e.columns.view) = row.tail<6>();
    }
    return H;
}

// Landmarks of pairs into covariance and table.
void initialise(Estimate& e, Index frame, const Ids& ids, const std::vector<Pair>& pairs, Started& out) {
    const Lead lead = e.gaussian.lead();
    const auto k = size_of(pairs);
    Matrix G = Matrix::Zero(lead.width, 3 * k);
    std::vector<Matrix3> covariance;
    Ids started;
    for (Matrix* rows : {&out.rows_before, &out.rows, &out.variance_before, &out.variance}) rows->resize(2, k);
    out.position_m.resize(3, k);
    for (Index j = 0; j < k; ++j) {
        const Pair& pair = pairs[j];
        const Eigen::Matrix<double, 3, 12> by_views = -pair.R_inverse * pair.by_views.topRows<3>();
        G.block<6, 3>(lead.front - 6, 3 * j) = by_views.leftCols<6>().transpose();
        G.block<6, 3>(lead.view, 3 * j) = by_views.rightCols<6>().transpose();
        covariance.push_back(pair.R_inverse * pair.R_inverse.transpose());
        started.push_back(ids[pair.which]);
        out.rows_before.col(j) = pair.then.head<2>();
        out.rows.col(j) = pair.now.head<2>();
        out.variance_before.col(j) = pair.variance.head<2>();
        out.variance.col(j) = pair.variance.tail<2>();
        out.position_m.col(j) = pair.position + pair.R_inverse * pair.residual.head<3>();
        out.which[pair.which] = true;
    }
    e.gaussian.augment(G, covariance);
    enter(e, frame, started, out.position_m, out.rows, 2);
}

}  // namespace

Started Waiting::start(Estimate& e, Index frame, const Ids& ids, const Matrix& rows) {
    if (e.columns.view < 0 || e.columns.anchor < 0) throw Error("tracks that wait need the blocks view and anchor");
    Started out;
    out.which.assign(ids.size(), false);
    out.step_before = step_;
    const Matrix4 anchor = e.values.anchor(), view = e.values.view();
    const Matrix P = e.gaussian.body_covariance();
    std::vector<Pair> inside;
    for (Index i = 0; i < rows.cols(); ++i) {
        const auto found = std::find(ids_.begin(), ids_.end(), ids[i]);
        if (found == ids_.end()) continue;
        Pair pair{i, padded(rows_, found - ids_.begin()), padded(rows, i), {}, {}, {}, {}, {}};
        const auto seen = e.sensor.triangulate(pair.then, pair.now, view * se3::inverse(anchor));
        if (!seen.is_ready) continue;
        pair.position = se3::apply(se3::inverse(view), seen.q);
        split(e, anchor, view, e.step - step_, pair);
        const Matrix H = rest(e, {pair});
        const double S = (H * P.topLeftCorner(e.columns.body, e.columns.body) * H.transpose())(0, 0) + 1.0;
        if (!(S > 0)) throw Error("the covariance of two views is not positive definite");
        const double depth_std_m = (view.block<1, 3>(2, 0) * pair.R_inverse).norm();
        if (depth_std_m > LARGEST_DEPTH_ERROR * seen.q.z()) continue;
        if (pair.residual[3] * pair.residual[3] / S <= e.config.waiting_gate) inside.push_back(pair);
    }
    if (!inside.empty()) {
        initialise(e, frame, ids, inside, out);
        const Matrix H = rest(e, inside);
        Vector residual(H.rows());
        for (Index j = 0; j < H.rows(); ++j) residual[j] = inside[j].residual[3];
        const Solution solution = e.gaussian.solve_body(H, residual, Vector::Ones(H.rows()));
        const Vector correction = e.gaussian.correction(solution);
        e.gaussian.apply(solution);
        retract(e, correction);
    }
    const Slots left = where(out.which, false);
    move_on(e, picked(ids, left), columns_of(rows, left));
    return out;
}

// Keep the tracks without a landmark that wait already; if none is left or patience ends, all start to wait again here.
void Waiting::move_on(Estimate& e, const Ids& ids, const Matrix& rows) {
    Slots still;
    for (Index j = 0; j < size_of(ids_); ++j)
        if (std::find(ids.begin(), ids.end(), ids_[j]) != ids.end()) still.push_back(j);
    ids_ = picked(ids_, still);
    rows_ = columns_of(rows_, still);
    if (!ids_.empty() && e.step - step_ < e.sensor.patience) return;
    e.gaussian.hold_anchor();
    e.values.set(e.values.places.anchor, e.values.view());
    ids_ = ids;
    rows_ = rows;
    step_ = e.step;
}

}  // namespace ekfslam
