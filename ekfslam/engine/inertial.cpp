// A gyroscope and an accelerometer move pose and velocity: models/process/inertial.py, geometry/preintegration.py.
//
// With the motion R, v, p from (I, 0, 0) over the samples, errors z = (phi, nu, r) of preintegration.py become
// e = (R phi, R nu + v^ R phi, R r + p^ R phi), in the frame at the start. Rotations no longer turn them:
//
//     e_phi' = -R (dbg + n_g)    e_nu' = -v^ R (dbg + n_g) - R (dba + n_a)    e_r' = e_nu - p^ R (dbg + n_g)
//
// so that Phi and Q are integrals over time of g = [R; v^ R; q^ R; (tau - t) R], q = p + (tau - t) v, of its integral G
// and of G G^T. In a piece they are polynomials of degree 7 at most times the rotation's series: five nodes are exact.
#include <array>
#include <cmath>

#include "process.hpp"
#include "se3.hpp"

namespace ekfslam {

namespace {

using Matrix9 = Eigen::Matrix<double, 9, 9>;
using Stack =
    Eigen::Matrix<double, 12, 3>;  // by phi, nu and r from a gyroscope's bias, and by r from an accelerometer's
constexpr double LONGEST_S = 0.05, WIDEST_RAD = 0.1;  // of a piece
constexpr double GAP_FACTOR = 10.0;                   // of densities of white noise
constexpr double MOST_PIECES = 1e6;
constexpr int NODES = 5;

// Nodes of Gauss and Legendre in [0, 1], their weights, and the weights (row) of the integral from 0 to each node.
struct Rule {
    std::array<double, NODES> at, weight;
    Eigen::Matrix<double, NODES, NODES> until;

    Rule() {
        const double near = std::sqrt(5.0 - 2.0 * std::sqrt(10.0 / 7.0)) / 3.0;
        const double far = std::sqrt(5.0 + 2.0 * std::sqrt(10.0 / 7.0)) / 3.0;
        const std::array<double, NODES> x{-far, -near, 0.0, near, far};
        Eigen::Matrix<double, NODES, NODES> powers, integrals;
        for (int n = 0; n < NODES; ++n) {
            at[n] = 0.5 * (1.0 + x[n]);
            for (int k = 0; k < NODES; ++k) {
                powers(n, k) = std::pow(x[n], k);
                integrals(n, k) = 0.5 * (std::pow(x[n], k + 1) - std::pow(-1.0, k + 1)) / (k + 1);
            }
        }
        until = powers.transpose().partialPivLu().solve(integrals.transpose()).transpose();
        const double root = 13.0 * std::sqrt(70.0);
        weight = {(322.0 - root) / 1800.0, (322.0 + root) / 1800.0, 64.0 / 225.0, (322.0 + root) / 1800.0,
                  (322.0 - root) / 1800.0};
    }
};

const Rule RULE;

struct Integrals {
    double tau_s, t = 0;
    Matrix3 R = Matrix3::Identity();
    Vector3 v = Vector3::Zero(), p = Vector3::Zero();
    Stack G = Stack::Zero(), of_G = Stack::Zero();
    Eigen::Matrix<double, 12, 12> of_GG = Eigen::Matrix<double, 12, 12>::Zero();
    Vector6 of_vq = Vector6::Zero();
    Matrix6 of_vqvq = Matrix6::Zero();

    // A piece of angular rate w and specific force f.
    void add(const Vector3& w, const Vector3& f, double dt) {
        const Vector3 wf = w.cross(f), wwf = w.cross(wf);
        const Matrix3 W = se3::skew(w), WW = W * W;
        const auto moved = [&](double s) {  // by Gamma_0, Gamma_1, Gamma_2 of w s
            const auto phi = se3::phis(w.squaredNorm() * s * s);
            const Vector3 dv = s * (f + s * (phi[2] * wf + s * phi[3] * wwf));
            const Vector3 dp = s * s * (0.5 * f + s * (phi[3] * wf + s * phi[4] * wwf));
            const Matrix3 G_0 = Matrix3::Identity() + s * (phi[1] * W + s * phi[2] * WW);
            return std::make_tuple(Matrix3(R * G_0), Vector3(v + R * dv), Vector3(p + s * v + R * dp));
        };
        std::array<Stack, NODES> g;
        for (std::size_t n = 0; n < NODES; ++n) {
            const double s = dt * RULE.at[n], left = tau_s - t - s, weight = dt * RULE.weight[n];
            const auto [R_n, v_n, p_n] = moved(s);
            Vector6 vq;
            vq << v_n, p_n + left * v_n;
            g[n] << R_n, se3::skew(v_n) * R_n, se3::skew(vq.tail<3>()) * R_n, left * R_n;
            of_vq += weight * vq;
            of_vqvq.noalias() += (weight * vq) * vq.transpose();
        }
        Stack whole = G;
        for (std::size_t n = 0; n < NODES; ++n) {
            Stack here = G;
            for (std::size_t m = 0; m < NODES; ++m) here += dt * RULE.until(n, m) * g[m];
            const Stack weighted = dt * RULE.weight[n] * here;
            of_G += weighted;
            of_GG += weighted.lazyProduct(here.transpose());
            whole += dt * RULE.weight[n] * g[n];
        }
        G = whole;
        std::tie(R, v, p) = moved(dt);
        t += dt;
    }

    // Integrals of U and U U^T, where U is what is left of G: what a bias does that changes at t.
    Stack of_U() const { return tau_s * G - of_G; }
    Eigen::Matrix<double, 12, 12> of_UU() const {
        const Eigen::Matrix<double, 12, 12> mixed = G * (of_G - 0.5 * tau_s * G).transpose();
        return of_GG - mixed - mixed.transpose();
    }
};

Integrals integrals(const Interval& interval, const Vector3& gyro_bias, const Vector3& accel_bias) {
    Integrals out{interval.dt_s.sum()};
    for (Index i = 0; i < interval.dt_s.size(); ++i) {
        const Vector3 w = interval.inputs.row(i).head<3>().transpose() - gyro_bias;
        const Vector3 f = interval.inputs.row(i).tail<3>().transpose() - accel_bias;
        const double dt = interval.dt_s[i], parts = std::ceil(std::max(dt / LONGEST_S, dt * w.norm() / WIDEST_RAD));
        if (!(parts <= MOST_PIECES)) throw Error("an interval that is too long, or turns too fast");
        for (double k = 0; k < parts; ++k) out.add(w, f, dt / parts);
    }
    return out;
}

// Covariance (9, 9) of e, and with the biases (9, 6).
std::pair<Matrix9, Eigen::Matrix<double, 9, 6>> noise_of(const Integrals& found, const Inertial& process,
                                                         const Interval& interval) {
    const double white = interval.doubt * (interval.is_gap ? GAP_FACTOR : 1.0), tau = found.tau_s;
    const auto squared = [](double x) { return x * x; };
    const double gyro = squared(white * process.gyro), accel = squared(white * process.accel);
    const double gyro_walk = squared(interval.doubt * process.gyro_walk);
    const double accel_walk = squared(interval.doubt * process.accel_walk);
    const Eigen::Matrix<double, 12, 12> UU = found.of_UU();
    const Stack U = found.of_U();
    Matrix9 Q = gyro_walk * UU.topLeftCorner<9, 9>();
    Eigen::Matrix<double, 9, 6> with_biases = Eigen::Matrix<double, 9, 6>::Zero();
    with_biases.leftCols<3>() = -gyro_walk * U.topRows<9>();
    // a^ (b^)^T = (a . b) I - b a^T for a, b of 1, v, q.
    Q.topLeftCorner<3, 3>().diagonal().array() += gyro * tau;
    for (Index i = 0; i < 2; ++i) {
        const Matrix3 lever = gyro * se3::skew(found.of_vq.segment<3>(3 * i));
        Q.block<3, 3>(0, 3 + 3 * i) -= lever;
        Q.block<3, 3>(3 + 3 * i, 0) += lever;
        with_biases.block<3, 3>(3 + 3 * i, 3) = -accel_walk * U.middleRows<3>(9 * i);
        for (Index j = 0; j < 2; ++j) {
            const Matrix3 A = found.of_vqvq.block<3, 3>(3 * i, 3 * j);
            auto to = Q.block<3, 3>(3 + 3 * i, 3 + 3 * j);
            to += gyro * (A.trace() * Matrix3::Identity() - A.transpose());
            to += accel_walk * UU.block<3, 3>(9 * i, 9 * j);
            to.diagonal().array() += accel * std::pow(tau, 1 + i + j) / static_cast<double>(1 + i + j);
        }
    }
    return {Q, with_biases};
}

// The angular rate at the end of the interval, extrapolated from its last two pieces.
Vector3 rate_at_end(const Interval& interval) {
    const Index n = interval.dt_s.size() - 1;
    const Vector3 w = interval.inputs.row(n).head<3>();
    if (n == 0) return w;
    const double ratio = interval.dt_s[n] / (interval.dt_s[n] + interval.dt_s[n - 1]);
    return w + ratio * (w - interval.inputs.row(n - 1).head<3>().transpose());
}

}  // namespace

Step step(Estimate& e, const Inertial& process, const Interval& interval) {
    Vector& flat = e.values.flat;
    auto u = flat.segment<3>(process.velocity.value_at);
    const Integrals found =
        integrals(interval, flat.segment<3>(process.gyro_bias.value_at), flat.segment<3>(process.accel_bias.value_at));
    const double tau = found.tau_s;
    // The mean.
    const Matrix3 R_0 = se3::rotation(e.values.pose()), back = found.R.transpose();
    const Vector3 u_0 = u, g = R_0 * Vector3(0.0, 0.0, -process.gravity_m_s2), ahead = u_0 + g * tau;
    const Vector3 t_0 = se3::translation(e.values.pose());
    u = back * (ahead + found.v);
    e.coordinates.segment<3>(process.velocity.at) = u;
    e.values.set(e.values.places.pose,
                 se3::transform(back * R_0, back * (t_0 - u_0 * tau - 0.5 * tau * tau * g - found.p)));
    // Errors (rho, theta, du) after the step by e, and e by those before and the biases.
    Matrix9 after = Matrix9::Zero();
    after.block<3, 3>(0, 0) = back * se3::skew(found.p);
    after.block<3, 3>(0, 6) = after.block<3, 3>(3, 0) = -back;
    after.block<3, 3>(6, 0) = back * se3::skew(ahead);
    after.block<3, 3>(6, 3) = back;
    Eigen::Matrix<double, 9, 15> F = Eigen::Matrix<double, 9, 15>::Zero();
    const Matrix3 I = Matrix3::Identity(), lever = se3::skew(u_0);
    F.block<3, 3>(0, 3) = F.block<3, 3>(6, 0) = -I;
    F.block<3, 6>(3, 3) << lever, I;
    F.block<3, 6>(6, 3) << tau * lever, tau * I;
    F.block<9, 3>(0, 9) = -found.G.topRows<9>();
    F.block<3, 3>(3, 12) = -found.G.topRows<3>();
    F.block<3, 3>(6, 12) = -found.G.bottomRows<3>();
    F = (after * F).eval();
    Step out{{}, Matrix::Zero(15, e.columns.body), Matrix::Zero(15, 15), {}};
    Index row = 0;
    for (const Index first : {Index{0}, Index{3}, process.velocity.at, process.gyro_bias.at, process.accel_bias.at}) {
        for (Index i = 0; i < 3; ++i) out.columns.push_back(first + i);
        out.Phi.block<9, 3>(0, first) = F.middleCols<3>(row);
        if (row >= 9) out.Phi.block<3, 3>(row, first) = I;
        row += 3;
    }
    const auto [Q, with_biases] = noise_of(found, process, interval);
    out.Q.topLeftCorner<9, 9>() = after * Q * after.transpose();
    out.Q.topRightCorner<9, 6>() = after * with_biases;
    out.Q.bottomLeftCorner<6, 9>() = out.Q.topRightCorner<9, 6>().transpose();
    const double walks[] = {interval.doubt * process.gyro_walk, interval.doubt * process.accel_walk};
    for (Index i = 0; i < 6; ++i) out.Q(9 + i, 9 + i) = walks[i / 3] * walks[i / 3] * tau;
    out.imu_twist << u, rate_at_end(interval) - flat.segment<3>(process.gyro_bias.value_at);
    return out;
}

}  // namespace ekfslam
