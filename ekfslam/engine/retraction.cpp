#include "retraction.hpp"

#include <algorithm>
#include <cmath>

#include "model.hpp"
#include "se3.hpp"

namespace ekfslam {

namespace {

// Largest ratio of distances across and along the optical axis for image coordinates.
constexpr double MOST_OBLIQUE = 3.0;
// Largest factor by which a correction may change a disparity.
constexpr double LARGEST_FACTOR = 4.0;

// A view before and after a correction, and its error z in it.
struct Turn {
    Matrix4 before, after;
    Vector6 z;
    Index at = -1;  // layout columns
};

Turn turn_of(const Estimate& e, Updated which, const Values& after, const Vector& correction) {
    const bool is_view = which == Updated::view;
    const Index at = is_view ? e.columns.view : e.columns.previous;
    if (at >= 0) {
        const Index place = is_view ? e.values.places.view : e.values.places.previous;
        return {e.values.matrix(place), after.matrix(place), correction.segment<6>(at), at};
    }
    // A view that is a function of the body alone.
    return {e.opened.W, camera_pose(e, after, e.imu_twist, false), e.opened.Y * correction.head(e.columns.body), at};
}

// The view by which landmarks turn in world, eq. (7): the newest one in the state.
Updated newest(const Estimate& e) { return e.is_open ? Updated::view : Updated::previous; }

bool is_by_image(const Estimate& e) { return e.config.image_coordinates && e.updated != Updated::none; }

// Matrix from the error of a pose before a correction to that after it. Ad(T+ T^-1) is not the derivative of the
// retraction: it keeps the invariant error, and with it the unobservable directions.
Matrix6 turned(const Estimate& e, const Matrix4& before, const Matrix4& after) {
    if (e.config.variant == Variant::standard) return Matrix6::Identity();
    return se3::adjoint(after * se3::inverse(before));
}

// The same for rows that are taken after a correction: the standard variant has the derivative of exp(xi^) T.
Matrix6 derivative(const Estimate& e, const Matrix4& before, const Matrix4& after) {
    const Matrix4 moved = after * se3::inverse(before);
    return e.config.variant == Variant::standard ? se3::left_jacobian(se3::log(moved)) : se3::adjoint(moved);
}

// (x/z, y/z, 1/z), its own inverse, and its derivative.
Vector3 image(const Vector3& q) { return Vector3(q.x(), q.y(), 1.0) / q.z(); }

Matrix3 image_jacobian(const Vector3& q) {
    const Vector3 y = image(q);
    Matrix3 J = Matrix3::Zero();
    J(0, 0) = J(1, 1) = y.z();
    J.col(2) = -y * y.z();
    return J;
}

bool is_in_image(const Estimate& e, const Vector3& q) {
    const bool is_ahead = std::max(std::abs(q.x()), std::abs(q.y())) < MOST_OBLIQUE * q.z();
    return is_ahead && q.z() > e.config.min_depth_m && q.z() < e.sensor.furthest_m();
}

// A point that a correction moves linearly in the image, y+ = y + J dq, or by dq itself; in_image says which.
Vector3 moved_by_image(const Vector3& q, const Vector3& step, bool& in_image) {
    if (in_image) {
        const Vector3 y = image(q), y_after = y + image_jacobian(q) * step;
        in_image = y_after.z() > y.z() / LARGEST_FACTOR && y_after.z() < y.z() * LARGEST_FACTOR;
        if (in_image) return image(y_after);
    }
    return q + step;
}

// Eq. (7) for a landmark: a rotation of all of them about the origin of world, plus the remainder of each.
void retract_in_world(const Estimate& e, const Slots& slots, const Turn& turn, const Matrix& d, Matrix& position_m) {
    if (e.config.variant == Variant::standard) {
        for (const Index i : slots) position_m.col(i) += d.col(i);
        return;
    }
    const Vector3 e_theta = -se3::rotation(turn.before).transpose() * turn.z.tail<3>();
    const auto [R, J] = se3::so3_exp_and_left_jacobian(e_theta);
    for (const Index i : slots) {
        const Vector3 m = position_m.col(i), remainder = d.col(i) - e_theta.cross(m);
        position_m.col(i) = R * m + J * remainder;
    }
}

// Eq. (7').
void retract_in_view(const Estimate& e, const Turn& turn, const Matrix& d, Moved& moved) {
    const auto n = size_of(moved.awake);
    const Matrix3 R = se3::rotation(turn.before);
    const Matrix4 back = se3::inverse(turn.after);
    moved.q.resize(3, n);
    moved.q_after.resize(3, n);
    moved.in_image.resize(moved.awake.size());
    for (Index j = 0; j < n; ++j) {
        const Index i = moved.awake[j];
        const Vector3 q = se3::apply(turn.before, moved.mean.position_m.col(i));
        const Vector3 step = se3::by_frame(q) * turn.z + R * d.col(i);
        bool in_image = is_in_image(e, q);
        const Vector3 q_after = moved_by_image(q, step, in_image);
        moved.q.col(j) = q;
        moved.q_after.col(j) = q_after;
        moved.in_image[j] = in_image;
        moved.mean.position_m.col(i) = se3::apply(back, q_after);
    }
}

// M and B of eq. (7'): d+ = R+^T J R d + R+^T (J [I, -q^] z - [I, -q+^] z+), z+ = by z, J the derivative of the image.
Change change_in_view(const Moved& moved, const Turn& turn, const Matrix6& by) {
    Change out{moved.awake, {}, {}, turn.at};
    out.M.reserve(moved.awake.size());
    out.B.reserve(moved.awake.size());
    const Matrix3 R = se3::rotation(turn.before), R_after = se3::rotation(turn.after).transpose();
    for (Index j = 0; j < moved.q.cols(); ++j) {
        const Vector3 q = moved.q.col(j), q_after = moved.q_after.col(j);
        // The image is its own inverse: its derivative at an image is the inverse of that at the point.
        Matrix3 J = Matrix3::Identity();
        if (moved.in_image[j]) J = image_jacobian(image(q_after)) * image_jacobian(q);
        out.M.push_back(R_after * J * R);
        out.B.push_back(R_after * (J * se3::by_frame(q) - se3::by_frame(q_after) * by));
    }
    return out;
}

// B of eq. (7): by the rotation of the view; none with the standard variant.
Change change_in_world(const Estimate& e, const Moved& moved, const Turn& turn) {
    Change out{moved.others, {}, {}, turn.at};
    if (e.config.variant == Variant::standard) return {};
    const Matrix3 R_world = se3::rotation(turn.before).transpose();
    for (const Index i : moved.others) {
        Matrix36 B = Matrix36::Zero();
        B.rightCols<3>() = se3::skew(moved.mean.position_m.col(i) - e.table.position_m.col(i)) * R_world;
        out.B.push_back(B);
    }
    return out;
}

void transport(Gaussian& gaussian, const Change& change) {
    if (!change.slot.empty()) gaussian.transform_landmarks(change.slot, change.M, change.B, change.at);
}

// Without the block `view`, the covariance has a view all the same: it stays that of the pose.
void turn_hidden_view(Estimate& e, const Values& after) {
    const Matrix4 W = camera_pose(e, after, e.imu_twist, false);
    if (e.config.variant == Variant::invariant) e.gaussian.transform_body(-1, turned(e, e.opened.W, W));
    e.opened.W = W;
}

void carry_change(const Change& change, Index at, Rows& rows) {
    const Index d = rows.dimension();
    for (Index i = 0; i < rows.count(); ++i) {
        const Index slot = rows.slot[i];
        const auto found = std::lower_bound(change.slot.begin(), change.slot.end(), slot);
        if (found == change.slot.end() || *found != slot) continue;
        const auto j = static_cast<std::size_t>(found - change.slot.begin());
        auto H_m = rows.H_m.middleCols(i * d, d);
        rows.H_x.block(at, i * d, 6, d) += change.B[j].transpose() * H_m;
        if (!change.M.empty()) H_m = (change.M[j].transpose() * H_m).eval();
    }
}

}  // namespace

Parts parts(const Estimate& e, const Vector& correction) {
    const Lead lead = e.gaussian.lead();
    const auto body = correction.head(e.columns.body);
    Parts out{Vector::Zero(lead.width), Matrix(3, e.table.size())};
    for (Index j = 0; j < size_of(e.columns.front); ++j) out.x[j] = body[e.columns.front[j]];
    if (e.columns.anchor >= 0) out.x.segment<6>(lead.front - 6) = body.segment<6>(e.columns.anchor);
    if (e.drifted && lead.drifted >= 0) out.x.segment<6>(lead.drifted) = e.drifted->Y * body;
    if (lead.view >= 0) {
        if (e.columns.view >= 0)
            out.x.segment<6>(lead.view) = body.segment<6>(e.columns.view);
        else
            out.x.segment<6>(lead.view) = e.opened.Y * body;
    }
    if (lead.previous >= 0 && e.columns.previous >= 0)
        out.x.segment<6>(lead.previous) = body.segment<6>(e.columns.previous);
    out.d = correction.tail(3 * e.table.size()).reshaped(3, e.table.size());
    return out;
}

Matrix left_by(const Rows& rows, const Parts& correction) {
    const Index d = rows.dimension();
    Matrix left = rows.residual - (rows.H_x.transpose() * correction.x).reshaped(d, rows.count());
    for (Index i = 0; i < rows.count(); ++i) {
        const Index slot = rows.slot[i];
        left.col(i) -= rows.H_m.middleCols(i * d, d).transpose() * correction.d.col(slot);
    }
    return left;
}

Moved retracted(const Estimate& e, const Vector& correction) {
    const Index n = e.table.size();
    const auto d = correction.tail(3 * n).reshaped(3, n);
    Moved moved{{retract_values(e, correction), e.table.position_m, e.imu_twist}, {}, {}, {}, {}, {}};
    const bool by_image = is_by_image(e);
    for (Index i = 0; i < n; ++i) {
        const bool is_awake = by_image && e.table.asleep[i] == 0;
        (is_awake ? moved.awake : moved.others).push_back(i);
    }
    const Values& after = moved.mean.values;
    retract_in_world(e, moved.others, turn_of(e, newest(e), after, correction), d, moved.mean.position_m);
    if (by_image) retract_in_view(e, turn_of(e, e.updated, after, correction), d, moved);
    return moved;
}

void retract(Estimate& e, const Vector& correction) {
    Moved moved = retracted(e, correction);
    const Values& after = moved.mean.values;
    if (is_by_image(e)) {
        const Turn turn = turn_of(e, e.updated, after, correction);
        transport(e.gaussian, change_in_view(moved, turn, turned(e, turn.before, turn.after)));
    }
    transport(e.gaussian, change_in_world(e, moved, turn_of(e, newest(e), after, correction)));
    if (e.config.variant == Variant::invariant) {
        for (const Block& block : e.blocks) {
            const bool is_closed = block.name == "view" && !e.is_open;
            if (block.kind != Kind::pose || is_closed) continue;
            const Matrix4 before = e.values.matrix(block.value_at);
            e.gaussian.transform_body(block.at, turned(e, before, after.matrix(block.value_at)));
        }
    }
    if (e.columns.view < 0) turn_hidden_view(e, after);
    e.values = after;
    e.table.position_m = moved.mean.position_m;
    e.coordinates += correction.head(e.coordinates.size());
}

Rows carried_back(const Estimate& e, Rows rows, const Moved& moved) {
    const Lead lead = e.gaussian.lead();
    const Values& after = moved.mean.values;
    const auto carry = [&](Index at, const Matrix4& from, const Matrix4& to) {
        auto H = rows.H_x.middleRows(at, 6);
        H = (derivative(e, from, to).transpose() * H).eval();
    };
    const Vector none = Vector::Zero(e.columns.body);
    const Turn now = turn_of(e, Updated::view, after, none);
    carry(lead.view, now.before, now.after);
    if (e.drifted) carry(lead.drifted, e.drifted->W, camera_pose(e, after, moved.mean.imu_twist, true));
    if (e.columns.previous >= 0 && lead.previous >= 0) carry(lead.previous, e.values.previous(), after.previous());
    if (is_by_image(e)) {
        const Turn turn = turn_of(e, e.updated, after, none);
        const Index at = e.updated == Updated::view ? lead.view : lead.previous;
        carry_change(change_in_view(moved, turn, derivative(e, turn.before, turn.after)), at, rows);
    } else {
        carry_change(change_in_world(e, moved, now), lead.view, rows);
    }
    return rows;
}

}  // namespace ekfslam
