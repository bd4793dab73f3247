#include "process.hpp"

#include <cmath>

#include "model.hpp"
#include "se3.hpp"

namespace ekfslam {

namespace {

// A transition x+ = Phi x + w of all blocks but views: walks have a diagonal.
struct Walked {
    Vector phi, variance;  // (body)
};

Walked none(const Estimate& e) { return {Vector::Ones(e.columns.body), Vector::Zero(e.columns.body)}; }

// Let the blocks walk: x+ = x + w, or x+ = exp(-l / L) x + w with w ~ N(0, sigma^2 (1 - exp(-2 l / L))).
Walked wander(Estimate& e, const Process& process, double tau_s, double way_m) {
    Walked out = none(e);
    for (Index i = 0; i < size_of(e.blocks); ++i) {
        const Block& block = e.blocks[i];
        const Law& law = process.laws[i];
        if (law.transition == Law::stays) continue;
        const bool is_stationary = law.transition == Law::gauss_markov;
        const double way = std::max(way_m, law.least_way_m);
        for (Index j = 0; j < block.size; ++j) {
            const double phi = is_stationary ? std::exp(-(tau_s / law.time_s[j] + way / law.length_m[j])) : 1.0;
            const double std = is_stationary ? law.std[j] * std::sqrt(1.0 - phi * phi) : law.std[j];
            out.phi[block.at + j] = phi;
            out.variance[block.at + j] = std * std;
            e.values.flat[block.value_at + j] *= phi;
            e.coordinates[block.at + j] *= phi;
        }
    }
    return out;
}

void set_shares(Estimate& e, const Process& process, double way_m) {
    for (Index i = 0; i < size_of(e.blocks); ++i) {
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

// After the walks: Phi = step walked, Q = step Q_walked step^T + Q_step.
void propagate(Estimate& e, const Walked& walked, const Step& step) {
    Matrix Phi = walked.phi.asDiagonal(), Q = walked.variance.asDiagonal();
    const Matrix noise = step.Phi * walked.variance.asDiagonal();
    Phi(step.columns, Eigen::all) = step.Phi * walked.phi.asDiagonal();
    Q(step.columns, Eigen::all) = noise;
    Q(Eigen::all, step.columns) = noise.transpose();
    Q(step.columns, step.columns) = noise * step.Phi.transpose() + step.Q;
    e.gaussian.propagate(Phi, Q);
}

}  // namespace

Departed predict(Estimate& e, const Process& process, const Interval& interval) {
    Departed departed{{}, Matrix4::Identity()};
    if (e.columns.view >= 0) departed.T_cam_imu = e.values.view() * se3::inverse(e.values.pose());
    const auto& inertial = process.inertial;
    const Vector6 measured = inertial ? Vector6(Vector6::Zero()) : mean_velocity(interval);
    Vector3 v = measured.head<3>();
    if (inertial) v = e.values.flat.segment<3>(inertial->velocity.value_at);
    const double way_m = v.norm() * interval.tau_s;
    // Clones and walking blocks, then the first or measured inputs, eq. (6).
    if (e.is_open) close_views(e);
    Walked walked = wander(e, process, interval.tau_s, way_m);
    if (process.velocities.twist && (e.step == 0 || process.velocities.is_measured)) {
        e.gaussian.propagate(walked.phi.asDiagonal(), walked.variance.asDiagonal());
        walked = none(e);
        measure_twist(e, process, measured, departed);
    }
    departed.coordinates = e.coordinates;
    // Eq. (1): the mean, and Phi and Q of eq. (2).
    begin_motion(e, interval, way_m);
    const Step by = inertial ? step(e, *inertial, interval) : step(e, process, interval, measured);
    e.coordinates.segment<6>(by.columns[0]).setZero();
    e.motion.T_predicted = e.values.pose();
    e.motion.Q = Matrix::Zero(e.columns.body, e.columns.body);
    e.motion.Q(by.columns, by.columns) = by.Q;
    propagate(e, walked, by);
    e.imu_twist = by.imu_twist;
    set_shares(e, process, way_m);
    ++e.step;
    open_views(e);
    return departed;
}

}  // namespace ekfslam
