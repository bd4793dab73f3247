// Rotations and rigid transforms: the functions of ekfslam/geometry/se3.py, with its series and branches.
// Tangent vectors of SE(3) are [rho; theta], metres and radians. All is accurate to rounding from angle 0 to pi.
#pragma once

#include <array>
#include <utility>

#include "types.hpp"

namespace ekfslam::se3 {

// (phi_0, ..., phi_5) at theta^2, phi_k = sum_n (-1)^n theta^(2n) / (2n + k)!.
std::array<double, 6> phis(double theta_squared);

inline Matrix3 skew(const Vector3& v) {
    Matrix3 out;
    out << 0.0, -v.z(), v.y(), v.z(), 0.0, -v.x(), -v.y(), v.x(), 0.0;
    return out;
}

std::pair<Matrix3, Matrix3> so3_exp_and_left_jacobian(const Vector3& theta);
Matrix3 so3_exp(const Vector3& theta);
Matrix3 so3_left_jacobian(const Vector3& theta);
Matrix3 so3_left_jacobian_inverse(const Vector3& theta);
Vector3 so3_log(const Matrix3& R);

Matrix4 transform(const Matrix3& R, const Vector3& t);
Matrix4 inverse(const Matrix4& T);
Matrix4 exp(const Vector6& xi);
Vector6 log(const Matrix4& T);
Matrix6 adjoint(const Matrix4& T);
Matrix6 left_jacobian(const Vector6& xi);
Matrix6 left_jacobian_inverse(const Vector6& xi);

inline Matrix3 rotation(const Matrix4& T) { return T.topLeftCorner<3, 3>(); }
inline Vector3 translation(const Matrix4& T) { return T.topRightCorner<3, 1>(); }
// p_a = T_a_b p_b.
inline Vector3 apply(const Matrix4& T, const Vector3& point) { return rotation(T) * point + translation(T); }
// [I, -q^], the derivative of a point in a frame by the error of that frame: exp(z^) q = q + [I, -q^] z.
inline Matrix36 by_frame(const Vector3& q) {
    Matrix36 out;
    out << Matrix3::Identity(), -skew(q);
    return out;
}

}  // namespace ekfslam::se3
