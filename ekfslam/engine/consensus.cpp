#include "consensus.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "retraction.hpp"
#include "se3.hpp"

namespace ekfslam {
namespace {

constexpr double SHARE = 1.0 / 3.0;  // of rejected landmarks, from which a frame is looked at
constexpr int ROUNDS = 4;
constexpr double BENT = 0.05;  // error of the linearisation, in deviations of a pixel: below, a round would be in vain

// A frame solved under one hypothesis: `inside` (k) of its candidates agree, and `rows` are theirs.
struct Settled {
    Slots candidates;  // among the landmarks of the frame
    Solution solution;
    Vector change;
    Flags inside;
    Rows rows;
    Matrix left;  // residuals (d, j) of the rows
    Blocks S;
    Mean linear;
    Vector coordinates;
    std::optional<Estimate> prior;
    double cost = 0;

    Index agree() const { return std::count(inside.begin(), inside.end(), true); }
    bool is_majority() const { return 2 * agree() > size_of(inside); }
};

// The observations of a frame.
struct Frame {
    Index frame;
    const Slots& slots;
    const Matrix& measured;
    const Uniform& uniform;
};

// Whether the trigger holds: many landmarks are rejected, or those that pass agree on an error of the inputs.
bool is_suspect(const Estimate& e, const Correction& found) {
    const Vector6& c = found.innovations.score;
    const Matrix6& C = found.innovations.information;
    const Matrix6 Q = (e.config.doubt * e.config.doubt - 1.0) * e.motion.Q.topLeftCorner<6, 6>();
    const Matrix6 M = Matrix6::Identity() + C * Q;
    const double shared = c.dot(Q * M.partialPivLu().solve(c)), most = e.config.input_gate;
    const auto outside = static_cast<double>(found.outside);
    return shared > most ||
           (outside > SHARE * static_cast<double>(found.verdict.size()) && shared + e.config.gate * outside > most);
}

// A motion in units of the noise of the inputs; directions without noise count as nothing.
Vector6 in_noise(const Estimate& e, const Vector6& xi) {
    const Matrix6 Q = e.motion.Q.topLeftCorner<6, 6>();
    const Eigen::SelfAdjointEigenSolver<Matrix6> own(Q);
    const Vector6 variances = own.eigenvalues(), along = own.eigenvectors().transpose() * xi;
    Vector6 units = Vector6::Zero();
    for (int i = 0; i < 6; ++i) {
        if (variances[i] > 1e-12 * variances[5]) units[i] = along[i] / std::sqrt(variances[i]);
    }
    return units;
}

// The motion from the predicted pose to that of a rig that moves as in the interval before, in units of the noise of
// the inputs; NaN if there was no interval before.
Vector6 jump(const Estimate& e) {
    const Motion& motion = e.motion;
    if (!motion.has_last) return Vector6::Constant(std::numeric_limits<double>::quiet_NaN());
    const Vector6 xi = motion.tau_s / motion.tau_last_s * se3::log(motion.moved_last);
    const Matrix4 as_before = se3::exp(xi) * motion.T_departed;
    return in_noise(e, se3::log(as_before * se3::inverse(motion.T_predicted)));
}

// Solves eq. (6) under a prior for the candidates that agree.
class Settling {
   public:
    Settling(Estimate prior, const Frame& at, Slots candidates, const Flags* begin)
        : e_(std::move(prior)), at_(at), begin_(begin) {
        slots_ = picked(at.slots, candidates);
        measured_ = columns_of(at.measured, candidates);
        found_.candidates = std::move(candidates);
    }

    // At most so many linearisations; nothing if no candidates agree.
    std::optional<Settled> run(int rounds) {
        Rows rows = observe(e_, e_.mean(), slots_, measured_).rows;
        Slots some = range(0, size_of(slots_));
        found_.inside = begin_ ? picked(*begin_, found_.candidates) : Flags(slots_.size(), false);
        Mean linear = e_.mean();
        Vector coordinates = e_.coordinates;
        for (int round = 0; round < rounds; ++round) {
            if (some.empty() || !settle(rows, some, round == 0)) return std::nullopt;
            found_.linear = std::move(linear);
            found_.coordinates = std::move(coordinates);
            if (round + 1 == rounds) break;
            std::optional<Settled> before;  // another velocity turns the estimate
            if (e_.has_time_offset()) {
                before = found_;
                before->prior = e_;
                turn(e_.twist_after(retract_values(e_, found_.change)));
            }
            Relinearised next = relinearised(e_, found_.change, slots_, measured_);
            if (is_straight(next.seen.rows.only(where(found_.inside)))) {
                if (before) return before;
                break;
            }
            some.clear();
            for (Index i = 0; i < next.seen.q.cols(); ++i) {
                if (e_.sensor.in_view(next.seen.q.col(i), e_.config.min_depth_m)) some.push_back(i);
            }
            rows = next.seen.rows.only(some);
            linear = std::move(next.linear);
            coordinates = std::move(next.coordinates);
        }
        found_.prior = std::move(e_);
        return std::move(found_);
    }

   private:
    // Takes another velocity at the image; the error of the view, and the correction in it, are those with it.
    void turn(const Vector6& imu_twist) {
        look_at(e_, imu_twist);
        if (e_.columns.view < 0) return;
        const Vector6 z = e_.opened.Y * found_.change.head(e_.columns.body);
        found_.change.segment<6>(e_.columns.view) = z;
    }

    // Whether rows that are linearised at a solution agree with those that it was found with.
    bool is_straight(const Rows& rows) const {
        const Matrix bent = left_by(rows, parts(e_, found_.change)) - found_.left;
        return bent.cwiseAbs2().cwiseQuotient(found_.rows.variance).mean() < BENT * BENT;
    }

    // One linearisation: rows of `some` candidates; false if none of them agree.
    bool settle(const Rows& rows, const Slots& some, bool is_first) {
        const double gate = e_.config.gate;
        const Gaussian& gaussian = e_.gaussian;
        const Projection projection = gaussian.project(rows);
        const Matrix S = projection.S();
        if (is_first && !begin_) {
            const Vector focal = focal_lengths(by_pose(e_, rows), rows.dimension());
            found_.inside = agreeing(S, rows.residual, focal, gate, samples_of(rows.count(), at_.frame, at_.uniform));
        }
        const Slots agree = where(refined(S, rows.residual, picked(found_.inside, some), gate));
        if (agree.empty()) return false;
        found_.inside.assign(slots_.size(), false);
        for (Index i : agree) found_.inside[some[i]] = true;
        found_.solution = gaussian.solve(projection.only(agree));
        found_.change = gaussian.correction(found_.solution);
        found_.rows = rows.only(agree);
        found_.left = found_.solution.residual();
        found_.S.clear();
        const Index d = rows.dimension();
        for (Index i : agree) found_.S.push_back(S.block(i * d, i * d, d, d));
        found_.cost = found_.solution.nis + gate * static_cast<double>(slots_.size() - agree.size());
        return true;
    }

    Estimate e_;
    const Frame& at_;
    const Flags* begin_;  // landmarks of the frame that agree to begin with; null: they are found from samples
    Slots slots_;
    Matrix measured_;
    Settled found_;
};

// The candidates with some verdicts, settled.
std::optional<Settled> settled(Estimate prior, const Frame& at, const Verdicts& verdict, int rounds, const Flags* begin,
                               std::initializer_list<int> verdicts) {
    Slots candidates;
    for (Index i = 0; i < size_of(verdict); ++i)
        if (std::find(verdicts.begin(), verdicts.end(), verdict[i]) != verdicts.end()) candidates.push_back(i);
    return Settling(std::move(prior), at, std::move(candidates), begin).run(rounds);
}

// A correction by the landmarks that agree among the candidates.
void take(Correction& found, const Frame& at, Settled settled) {
    for (Index i = 0; i < size_of(settled.inside); ++i) {
        found.verdict[settled.candidates[i]] = settled.inside[i] ? ACCEPTED : GATE;
    }
    const Estimate& prior = *settled.prior;
    found.innovations = innovations_of(prior, prior.gaussian, settled.solution, settled.rows, settled.S, settled.left);
    found.outside = size_of(settled.inside) - settled.agree();
    found.nis = settled.solution.nis;
    found.log_det = settled.solution.log_det;
    found.dof = settled.rows.residual.size();
    found.slot = settled.rows.slot;
    found.variance = settled.rows.variance;
    found.measured = columns_of(at.measured, where(found.verdict, ACCEPTED));
    found.solution = std::move(settled.solution);
    found.change = std::move(settled.change);
    found.linear = std::move(settled.linear);
    found.coordinates = std::move(settled.coordinates);
    found.prior = std::move(settled.prior);
}

std::optional<double> cost_of(const std::optional<Settled>& settled) {
    return settled ? std::optional<double>(settled->cost) : std::nullopt;
}

// Whether the inputs are rejected: at the cost of their gate, with most landmarks, and towards the motion before.
bool rejects_inputs(const Estimate& e, const Settled& doubtful, std::optional<double> trusted, const Vector6& jump) {
    const double most = trusted ? *trusted : e.config.gate * static_cast<double>(doubtful.inside.size());
    if (!doubtful.is_majority() || doubtful.cost + e.config.input_gate >= most) return false;
    const Vector6 error = in_noise(e, doubtful.change.head<6>());
    return !(error.dot(jump) < 0.5 * error.squaredNorm());
}

}  // namespace

Correction correct(Estimate& e, Index frame, const Slots& slots, const Matrix& measured, const Uniform& uniform) {
    const Matrix evidence = e.table.evidence;
    const Vector6 predicted = e.imu_twist;
    Correction found = correct_plainly(e, slots, measured);
    if (slots.empty() || !e.motion.tau_s || !std::isfinite(e.config.gate)) return found;
    const bool suspect = is_suspect(e, found);
    if (!found.is_wide && !suspect) return found;
    const Frame at{frame, slots, measured, uniform};
    const int rounds = found.is_wide ? ROUNDS : 1;
    Estimate prior = e;
    if (e.has_time_offset()) look_at(prior, predicted);
    Flags accepted(slots.size());
    for (Index i = 0; i < size_of(accepted); ++i) accepted[i] = found.verdict[i] == ACCEPTED;
    const Flags* begin = suspect ? nullptr : &accepted;
    auto trusted = settled(prior, at, found.verdict, rounds, begin, {ACCEPTED, GATE});
    auto cost = cost_of(trusted);
    if (trusted && trusted->is_majority()) take(found, at, std::move(*trusted));
    if (e.config.estimates_velocity || !is_suspect(e, found)) return found;
    const Vector6 jumped = jump(e);
    if (4.0 * jumped.squaredNorm() < e.config.input_gate) return found;
    // Tracks that seem to move may be made to by the inputs: both hypotheses are judged by all.
    if (std::count(found.verdict.begin(), found.verdict.end(), MOVING)) {
        cost = cost_of(settled(prior, at, found.verdict, rounds, nullptr, {ACCEPTED, GATE, MOVING}));
    }
    const double doubt = e.config.doubt * e.config.doubt;
    prior.gaussian.add_noise((doubt - 1.0) * e.motion.Q);
    prior.motion.Q *= doubt;
    prior.motion.doubt = e.config.doubt;
    auto doubtful = settled(std::move(prior), at, found.verdict, ROUNDS, nullptr, {ACCEPTED, GATE, MOVING});
    if (!doubtful || !rejects_inputs(e, *doubtful, cost, jumped)) return found;
    e.table.evidence = evidence;
    take(found, at, std::move(*doubtful));
    return found;
}

}  // namespace ekfslam
