#include "process.hpp"

#include <cmath>

#include "model.hpp"
#include "se3.hpp"

namespace ekfslam {

namespace {

using Matrix63 = Eigen::Matrix<double, 6, 3>;
constexpr Index POSE = 0;  // its first column: it comes first

// The constant velocity that leads to the same pose as the inputs of an interval.
Vector6 mean_velocity(const Interval& interval) {
    if (interval.dt_s.size() == 1) return interval.inputs.row(0).transpose();
    Matrix4 E = Matrix4::Identity();
    for (Index i = 0; i < interval.dt_s.size(); ++i)
        E = se3::exp(-interval.dt_s[i] * interval.inputs.row(i).transpose()) * E;
    return -se3::log(E) / interval.tau_s;
}

// A transition x+ = Phi x + w of all blocks but views: walks have a diagonal.
struct Walked {
    Vector phi, variance;  // (body)
};

// Let the blocks walk, x+ = exp(-l / L) x + w, w ~ N(0, sigma^2 (1 - exp(-2 l / L))).
Walked wander(Estimate& e, const Process& process, double tau_s, double way_m) {
    Walked out{Vector::Ones(e.columns.body), Vector::Zero(e.columns.body)};
    for (std::size_t i = 0; i < e.blocks.size(); ++i) {
        const Block& block = e.blocks[i];
        const Law& law = process.laws[i];
        if (!law.walks) continue;
        const double way = std::max(way_m, law.least_way_m);
        for (Index j = 0; j < block.size; ++j) {
            const double phi = std::exp(-(tau_s / law.time_s[j] + way / law.length_m[j]));
            const double std = law.std[j] * std::sqrt(1.0 - phi * phi);
            out.phi[block.at + j] = phi;
            out.variance[block.at + j] = std * std;
            e.values.flat[block.value_at + j] *= phi;
            e.coordinates[block.at + j] *= phi;
        }
    }
    return out;
}

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

// Velocities of the IMU, and their derivative (6, body): less the blocks that are added to them, then turned.
std::pair<Vector6, Matrix> imu_velocities(const Estimate& e, const Process& process, Vector6 twist) {
    Matrix by = Matrix::Zero(6, e.columns.body);
    for (std::size_t i = 0; i < e.blocks.size(); ++i) {
        const Matrix& J = process.laws[i].offset;
        if (J.cols() == 0) continue;
        twist -= J * e.values.flat.segment(e.blocks[i].value_at, J.cols());
        by.middleCols(e.blocks[i].at, J.cols()) = -J;
    }
    for (std::size_t i = 0; i < e.blocks.size(); ++i)
        if (process.laws[i].turns) turn(e, e.blocks[i], twist, by);
    return {twist, by};
}

// Q = G W G^T of eq. (2).
Matrix6 process_noise(const Process& process, const Interval& interval, const Matrix6& G) {
    Vector6 std = process.pose_std;
    for (Index i = 0; i < 6; ++i) {
        if (interval.is_gap) std[i] = std::hypot(std[i], process.gap_std[i]);
        std[i] *= interval.doubt;
    }
    return G * std.cwiseAbs2().asDiagonal() * G.transpose();
}

void set_shares(Estimate& e, const Process& process, double way_m) {
    for (std::size_t i = 0; i < e.blocks.size(); ++i) {
        const Law& law = process.laws[i];
        if (law.share == Law::none) continue;
        e.blocks[i].share = law.share == Law::one ? 1.0 : 0.0;
        e.blocks[i].share_of_difference = law.share == Law::one ? 1.0 : std::max(way_m, law.least_way_m);
    }
}

// Motion of the interval, before the pose of the estimate moves.
void begin_motion(Estimate& e, const Interval& interval, double way_m) {
    const Matrix4 T = e.values.pose();
    Motion& motion = e.motion;
    motion.has_last = motion.tau_s != 0.0;
    if (motion.has_last) {
        motion.moved_last = T * se3::inverse(motion.T_departed);
        motion.tau_last_s = motion.tau_s;
    }
    motion.T_departed = T;
    motion.tau_s = interval.tau_s;
    motion.way_m = way_m;
    motion.doubt = interval.doubt;
}

}  // namespace

Departed predict(Estimate& e, const Process& process, const Interval& interval) {
    const Index body = e.columns.body;
    Departed departed{{}, Matrix4::Identity()};
    if (e.columns.view >= 0) departed.T_cam_imu = e.values.view() * se3::inverse(e.values.pose());
    // Clones and walking blocks.
    const Vector6 measured = mean_velocity(interval);
    const double way_m = measured.head<3>().norm() * interval.tau_s;
    if (e.is_open) close_views(e);
    const Walked walked = wander(e, process, interval.tau_s, way_m);
    departed.coordinates = e.coordinates;
    // Eq. (1): the mean; the rows of the pose in Phi, and Q of eq. (2).
    const auto [twist, by] = imu_velocities(e, process, measured);
    const Vector6 xi = -interval.tau_s * twist;
    const Matrix4 E = se3::exp(xi);
    const Matrix6 G = interval.tau_s * se3::left_jacobian(xi), Q_pose = process_noise(process, interval, G);
    Matrix F = -(G * by);
    F.middleCols<6>(POSE) += se3::adjoint(E);
    begin_motion(e, interval, way_m);
    e.motion.T_predicted = E * e.motion.T_departed;
    e.motion.Q = Matrix::Zero(body, body);
    e.motion.Q.block<6, 6>(POSE, POSE) = Q_pose;
    // After the walks: Phi = step walked, Q = step Q_walked step^T + Q_step.
    Matrix Phi = walked.phi.asDiagonal(), Q = walked.variance.asDiagonal();
    const Matrix noise = F * walked.variance.asDiagonal();
    Phi.middleRows<6>(POSE) = F * walked.phi.asDiagonal();
    Q.middleRows<6>(POSE) = noise;
    Q.middleCols<6>(POSE) = noise.transpose();
    Q.block<6, 6>(POSE, POSE) = noise * F.transpose() + Q_pose;
    e.gaussian.propagate(Phi, Q);
    e.values.set(e.values.places.pose, e.motion.T_predicted);
    e.coordinates.segment<6>(POSE).setZero();
    e.imu_twist = twist;
    set_shares(e, process, way_m);
    ++e.step;
    open_views(e);
    return departed;
}

}  // namespace ekfslam
