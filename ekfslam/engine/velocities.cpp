// Velocities that move the pose, as inputs or as a walk: models/process/velocities.py.
#include <cmath>

#include "model.hpp"
#include "process.hpp"
#include "retraction.hpp"
#include "se3.hpp"

namespace ekfslam {

namespace {

using Matrix63 = Eigen::Matrix<double, 6, 3>;
constexpr Index POSE = 0;  // its first column: it comes first

// Turn velocities and their derivative (6, body) from the level frame into the IMU frame, eq. (8).
void turn(const Estimate& e, const Block& up_block, Vector6& twist, Matrix& by) {
    const Matrix3 R = se3::rotation(e.values.pose());
    const Vector3 up = R * e.values.flat.segment<3>(up_block.value_at);
    // The level frame: z up, x the horizontal part of the IMU's x axis.
    const double sine = up[0], cosine = std::sqrt(1.0 - sine * sine);
    const Vector3 x = (Vector3::UnitX() - sine * up) / cosine;
    Matrix3 R_imu_level;
    R_imu_level << x, up.cross(x), up;
    // Up turns by exp(phi^), the frame by exp((Z phi)^).
    const Matrix3 Z = Matrix3::Identity() + up * (sine / cosine * x - up).transpose();
    twist.head<3>() = (R_imu_level * twist.head<3>()).eval();
    twist.tail<3>() = (R_imu_level * twist.tail<3>()).eval();
    by.topRows<3>() = (R_imu_level * by.topRows<3>()).eval();
    by.bottomRows<3>() = (R_imu_level * by.bottomRows<3>()).eval();
    Matrix63 by_phi;
    by_phi << -se3::skew(twist.head<3>()) * Z, -se3::skew(twist.tail<3>()) * Z;
    by.middleCols<3>(up_block.at) += by_phi * R;
    by.middleCols<3>(POSE + 3) += by_phi;
}

// Inputs less the blocks that are added to them, and their derivative (6, body).
std::pair<Vector6, Matrix> unbiased(const Estimate& e, const Process& process, Vector6 twist) {
    Matrix by = Matrix::Zero(6, e.columns.body);
    for (Index i = 0; i < size_of(e.blocks); ++i) {
        const Matrix& J = process.laws[i].offset;
        if (J.cols() == 0) continue;
        twist -= J * e.values.flat.segment(e.blocks[i].value_at, J.cols());
        by.middleCols(e.blocks[i].at, J.cols()) = -J;
    }
    return {twist, by};
}

// Velocities of the IMU, and their derivative (6, body).
std::pair<Vector6, Matrix> imu_velocities(const Estimate& e, const Process& process, const Vector6& measured) {
    auto [twist, by] = unbiased(e, process, measured);
    if (const auto& walk = process.velocities.twist) {
        twist = e.values.flat.segment<6>(walk->value_at);
        by.setZero();
        by.middleCols<6>(walk->at).setIdentity();
    }
    for (Index i = 0; i < size_of(e.blocks); ++i)
        if (process.laws[i].turns) turn(e, e.blocks[i], twist, by);
    return {twist, by};
}

// Q = G W G^T of eq. (2).
Matrix6 process_noise(const Velocities& velocities, const Interval& interval, const Matrix6& G) {
    Vector6 std = velocities.pose_std;
    for (Index i = 0; i < 6; ++i) {
        if (interval.is_gap) std[i] = std::hypot(std[i], velocities.gap_std[i]);
        std[i] *= interval.doubt;
    }
    return G * std.cwiseAbs2().asDiagonal() * G.transpose();
}

}  // namespace

Vector6 mean_velocity(const Interval& interval) {
    if (interval.dt_s.size() == 1) return interval.inputs.row(0).transpose();
    Matrix4 E = Matrix4::Identity();
    for (Index i = 0; i < interval.dt_s.size(); ++i)
        E = se3::exp(-interval.dt_s[i] * interval.inputs.row(i).transpose()) * E;
    return -se3::log(E) / interval.tau_s;
}

Step step(Estimate& e, const Process& process, const Interval& interval, const Vector6& measured) {
    const auto [twist, by] = imu_velocities(e, process, measured);
    const Vector6 xi = -interval.tau_s * twist;
    const Matrix4 E = se3::exp(xi);
    const Matrix6 G = interval.tau_s * se3::left_jacobian(xi);
    Step out{{0, 1, 2, 3, 4, 5}, -(G * by), process_noise(process.velocities, interval, G), twist};
    out.Phi.middleCols<6>(POSE) += se3::adjoint(E);
    e.values.set(e.values.places.pose, E * e.values.pose());
    return out;
}

void measure_twist(Estimate& e, const Process& process, const Vector6& measured, Departed& departed) {
    const Velocities& velocities = process.velocities;
    const Index at = velocities.twist->at, body = e.columns.body;
    const auto [found, by] = unbiased(e, process, measured);
    const Vector6 variance = velocities.twist_std.cwiseAbs2();
    if (e.step == 0) {  // the first input becomes the velocity
        Matrix Phi = Matrix::Identity(body, body), Q = Matrix::Zero(body, body);
        Phi.middleRows<6>(at) = by;
        Q.block<6, 6>(at, at) = variance.asDiagonal();
        e.gaussian.propagate(Phi, Q);
        e.values.flat.segment<6>(velocities.twist->value_at) = e.coordinates.segment<6>(at) = found;
        return;
    }
    Matrix H = -by;
    H.middleCols<6>(at).setIdentity();
    const Vector residual = measured - H * e.coordinates;
    if (e.config.gate_probability < 1.0) {  // the pull of a wild measurement falls with its size
        Matrix6 S = H * e.gaussian.body_covariance().topLeftCorner(body, body) * H.transpose();
        S.diagonal() += variance;
        const double nis = residual.dot(S.partialPivLu().solve(residual));
        departed.doubt = std::max(1.0, std::sqrt(nis / e.config.input_gate));
    }
    const Solution solution = e.gaussian.solve_body(H, residual, departed.doubt * departed.doubt * variance);
    const Vector correction = e.gaussian.correction(solution);
    e.gaussian.apply(solution);
    retract(e, correction);
    departed.nis = solution.nis;
    departed.log_det = solution.log_det;
}

}  // namespace ekfslam
