#include "se3.hpp"

#include <cmath>

namespace ekfslam::se3 {

namespace {

constexpr double SERIES_LIMIT = 2.0;  // below this theta^2 the power series is both accurate and cheap
constexpr int SERIES_TERMS = 10;      // the first one left out is 2^10 / 24! < 1e-20

// 1 / (2n + 4)! and 1 / (2n + 5)!, the coefficients of the series of phi_4 and phi_5.
struct Series {
    std::array<double, SERIES_TERMS> of_4, of_5;

    Series() {
        double factorial = 24.0;
        for (int n = 0; n < SERIES_TERMS; ++n) {
            const auto i = n;
            of_4[i] = 1.0 / factorial;
            factorial *= 2 * n + 5;
            of_5[i] = 1.0 / factorial;
            factorial *= 2 * n + 6;
        }
    }
};

const Series SERIES;

Matrix6 blocks(const Matrix3& A, const Matrix3& B) {
    Matrix6 out;
    out << A, B, Matrix3::Zero(), A;
    return out;
}

// Upper right 3x3 block of the left Jacobian of SE(3) (Barfoot eq. 7.86).
Matrix3 left_jacobian_corner(const Vector6& xi) {
    const Matrix3 rho = skew(xi.head<3>()), theta = skew(xi.tail<3>());
    const auto phi = phis(xi.tail<3>().squaredNorm());
    const Matrix3 theta_rho = theta * rho, rho_theta = rho * theta, sandwich = theta_rho * theta;
    return 0.5 * rho + phi[3] * (theta_rho + rho_theta + sandwich) +
           phi[4] * (theta * theta_rho + rho_theta * theta - 3.0 * sandwich) +
           0.5 * (phi[4] - 3.0 * phi[5]) * (sandwich * theta + theta * sandwich);
}

}  // namespace

std::array<double, 6> phis(double x) {
    if (x <= SERIES_LIMIT) {
        double phi_4 = 0.0, phi_5 = 0.0;
        for (std::size_t n = SERIES_TERMS; n-- > 0;) {
            phi_4 = SERIES.of_4[n] - x * phi_4;
            phi_5 = SERIES.of_5[n] - x * phi_5;
        }
        const double phi_2 = 0.5 - x * phi_4, phi_3 = 1.0 / 6.0 - x * phi_5;
        return {1.0 - x * phi_2, 1.0 - x * phi_3, phi_2, phi_3, phi_4, phi_5};
    }
    const double theta = std::sqrt(x);
    std::array<double, 6> closed{std::cos(theta), std::sin(theta) / theta};
    double factorial = 1.0;
    for (std::size_t k = 0; k < 4; ++k) {
        closed[k + 2] = (1.0 / factorial - closed[k]) / x;
        factorial *= static_cast<double>(k + 1);
    }
    return closed;
}

std::pair<Matrix3, Matrix3> so3_exp_and_left_jacobian(const Vector3& theta) {
    const auto phi = phis(theta.squaredNorm());
    const Matrix3 w = skew(theta), ww = w * w;
    return {Matrix3::Identity() + phi[1] * w + phi[2] * ww, Matrix3::Identity() + phi[2] * w + phi[3] * ww};
}

Matrix3 so3_exp(const Vector3& theta) { return so3_exp_and_left_jacobian(theta).first; }

Matrix3 so3_left_jacobian(const Vector3& theta) { return so3_exp_and_left_jacobian(theta).second; }

Matrix3 so3_left_jacobian_inverse(const Vector3& theta) {
    const auto phi = phis(theta.squaredNorm());
    const Matrix3 w = skew(theta);
    return Matrix3::Identity() - 0.5 * w + (phi[3] - 2.0 * phi[4]) / (2.0 * phi[2]) * (w * w);
}

// Through the unit quaternion built on its largest component, which stays accurate for every angle.
Vector3 so3_log(const Matrix3& R) {
    // Row c is 4 q_c q (components w, x, y, z); the row of the largest |q_c| is well conditioned.
    Matrix4 candidates;
    candidates.diagonal() << 1 + R(0, 0) + R(1, 1) + R(2, 2), 1 + R(0, 0) - R(1, 1) - R(2, 2),
        1 - R(0, 0) + R(1, 1) - R(2, 2), 1 - R(0, 0) - R(1, 1) + R(2, 2);
    for (Index i = 0; i < 3; ++i) {
        const Index j = (i + 1) % 3, k = (i + 2) % 3;
        candidates(0, k + 1) = candidates(k + 1, 0) = R(j, i) - R(i, j);
        candidates(i + 1, j + 1) = candidates(j + 1, i + 1) = R(j, i) + R(i, j);
    }
    Index best;
    candidates.diagonal().maxCoeff(&best);
    Eigen::Vector4d q = candidates.row(best).transpose().normalized();
    if (q[0] < 0) q = -q;
    const double sine = q.tail<3>().norm();
    // theta / sin(theta/2) -> 2 at zero, where the quotient itself is 0/0.
    return (sine > 0 ? 2.0 * std::atan2(sine, q[0]) / sine : 2.0) * q.tail<3>();
}

Matrix4 transform(const Matrix3& R, const Vector3& t) {
    Matrix4 T;
    T << R, t, 0.0, 0.0, 0.0, 1.0;
    return T;
}

Matrix4 inverse(const Matrix4& T) {
    const Matrix3 R = rotation(T).transpose();
    return transform(R, -(R * translation(T)));
}

Matrix4 exp(const Vector6& xi) {
    const auto [R, J] = so3_exp_and_left_jacobian(xi.tail<3>());
    return transform(R, J * xi.head<3>());
}

Vector6 log(const Matrix4& T) {
    Vector6 xi;
    xi.tail<3>() = so3_log(rotation(T));
    xi.head<3>() = so3_left_jacobian_inverse(xi.tail<3>()) * translation(T);
    return xi;
}

Matrix6 adjoint(const Matrix4& T) { return blocks(rotation(T), skew(translation(T)) * rotation(T)); }

Matrix6 left_jacobian(const Vector6& xi) { return blocks(so3_left_jacobian(xi.tail<3>()), left_jacobian_corner(xi)); }

Matrix6 left_jacobian_inverse(const Vector6& xi) {
    const Matrix3 J = so3_left_jacobian_inverse(xi.tail<3>());
    return blocks(J, -J * left_jacobian_corner(xi) * J);
}

}  // namespace ekfslam::se3
