#include "correction.hpp"

#include <algorithm>
#include <cmath>

#include "retraction.hpp"
#include "se3.hpp"

namespace ekfslam {
namespace {

// Largest variance of an innovation, in those of the measurement, at which linearising still means anything.
constexpr double MOST_BLURRED = 1e8;
constexpr Index MOST_AVERAGED = 250;  // landmarks

// Landmarks (j) of a frame that are tried, their rows, and S of each by itself.
struct Tried {
    Slots some;
    Projection projection;
    Blocks S;
    Index outside = 0;  // landmarks outside of the gate by themselves

    void keep(const Flags& inside) {
        const Slots which = where(inside);
        if (which.size() == inside.size()) return;
        some = picked(some, which);
        projection.keep(which);
        S = picked(S, which);
    }
};

// Whether tracks are tested for motion: if they have errors, from the second frame on.
// For one camera a wrong depth looks like a motion along the way.
bool judges_motion(const Estimate& e) { return e.track_error && e.motion.tau_s > 0 && e.sensor.type == Sensor::rig; }

// The last step of the rig in world.
Vector3 last_step(const Estimate& e) {
    return se3::rotation(e.values.pose()).transpose() * (e.imu_twist.head<3>() * e.motion.tau_s);
}

// Derivative (d, j) of the rows by a motion of their landmarks along a step.
Matrix along(const Vector3& step, const Observed& seen, const Slots& some) {
    const Index d = seen.rows.dimension();
    Matrix h(d, size_of(some));
    for (Index i = 0; i < h.cols(); ++i) h.col(i) = seen.H_m.middleCols(some[i] * d, d).transpose() * step;
    return h;
}

// So near to the camera plane that its image may be anywhere: linearised, it would spoil the whole frame.
void reject_blurred(Tried& tried, Verdicts& verdict) {
    const Matrix& variance = tried.projection.rows.variance;
    Flags sharp(tried.some.size());
    for (Index i = 0; i < size_of(sharp); ++i) {
        const Vector own = tried.S[i].diagonal(), most = MOST_BLURRED * variance.col(i);
        sharp[i] = !(own.array() > most.array()).any();
        if (!sharp[i]) verdict[tried.some[i]] = BEHIND_CAMERA;
    }
    tried.keep(sharp);
}

// The landmarks that pass the gate by themselves; verdicts are written on others.
Tried gate_alone(Estimate& e, const Observed& seen, Verdicts& verdict) {
    const Slots some = where(verdict, ACCEPTED);
    Tried tried{some, e.gaussian.project(some.size() == verdict.size() ? seen.rows : seen.rows.only(some)), {}};
    tried.S = own_covariances(tried.projection);
    reject_blurred(tried, verdict);
    const Rows& rows = tried.projection.rows;
    const Vector squares = normalised_squares(tried.S, rows.residual, rows.slot);
    Flags inside(tried.some.size());
    for (Index i = 0; i < squares.size(); ++i) {
        inside[i] = squares[i] <= e.config.gate;
        if (!inside[i]) verdict[tried.some[i]] = GATE;
    }
    tried.outside = std::count(inside.begin(), inside.end(), false);
    if (judges_motion(e) && !e.config.estimates_velocity) {
        const Evidence evidence = evidence_alone(rows.residual, tried.S, along(last_step(e), seen, tried.some));
        const Flags moves = moves_along(e.table, rows.slot, evidence, squares, e.config.gate, e.config);
        for (Index i : where(moves)) {
            verdict[tried.some[i]] = MOVING;
            inside[i] = false;
        }
    }
    tried.keep(inside);
    return tried;
}

// Verdicts on tried landmarks by all others, given the last step of the rig.
Verdicts gate_by_others(Estimate& e, const Solution& solution, const Tried& tried, const Observed& seen,
                        const Vector3& step) {
    Verdicts verdict(tried.some.size(), ACCEPTED);
    const bool judges = judges_motion(e) && e.config.estimates_velocity;
    const double gate = e.config.gate;
    if (!std::isfinite(gate) && !judges) return verdict;
    const Rows& rows = solution.at.rows;
    const Matrix left_by_all = solution.residual();
    Slots doubtful = judges ? range(0, size_of(verdict)) : Slots();
    if (!judges) {
        const Vector most = most_given_others(left_by_all, rows.variance, tried.S);
        for (Index i = 0; i < most.size(); ++i) {
            if (!(most[i] <= gate)) doubtful.push_back(i);
        }
    }
    if (doubtful.empty()) return verdict;
    const Matrix left = columns_of(left_by_all, doubtful), variance = columns_of(rows.variance, doubtful);
    const std::vector<Matrix> C = e.gaussian.given_others(solution, doubtful);
    const Judged found = agrees_with_others(left, variance, C);
    Flags moves(doubtful.size(), false);
    if (judges) {
        // Noisy velocities would accuse all tracks of a frame alike: only what others leave counts.
        const Evidence evidence = evidence_given_others(left, variance, C, along(step, seen, tried.some));
        moves = moves_along(e.table, rows.slot, evidence, found.squares, gate, e.config);
    }
    for (Index i = 0; i < size_of(doubtful); ++i) {
        if (found.squares[i] > gate) verdict[doubtful[i]] = GATE;
        if (moves[i] && found.judged[i]) verdict[doubtful[i]] = MOVING;
    }
    return verdict;
}

// Solve eq. (6) for tried rows, and remove those that others reject. The projection of the rows moves to the solution.
void gate_jointly(Estimate& e, Tried& tried, const Observed& seen, const Vector3& step, Correction& found) {
    Solution solution = e.gaussian.solve(std::move(tried.projection));
    const Verdicts verdict = gate_by_others(e, solution, tried, seen, step);
    Flags out(verdict.size());
    for (Index i = 0; i < size_of(verdict); ++i) {
        out[i] = verdict[i] != ACCEPTED;
        found.verdict[tried.some[i]] = verdict[i];
        found.outside += verdict[i] == GATE;
    }
    const Slots inside = where(out, false);
    const Rows& rows = solution.at.rows;
    if (inside.size() < out.size()) {
        solution = e.gaussian.without(std::move(solution), out);
        const Matrix left = columns_of(solution.residual(), inside);
        found.innovations = innovations_of(e, e.gaussian, solution, rows.only(inside), picked(tried.S, inside), left);
    } else {
        found.innovations = innovations_of(e, e.gaussian, solution, rows, tried.S, solution.residual());
    }
    found.change = e.gaussian.correction(solution);
    found.nis = solution.nis;
    found.log_det = solution.log_det;
    found.solution = std::move(solution);
}

double median(std::vector<double> values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    if (values.size() % 2) return *middle;
    return 0.5 * (*middle + *std::max_element(values.begin(), middle));
}

// Whether the prior spreads rows so far that linearising them once costs more than their noise. A rotation that moves a
// row by s px has a term of second order of s^2 / (2 f) there, f being the row's derivative by the rotation. All
// landmarks share most of it, and their noise averages out: wide means that in the median it exceeds half of
// sigma / sqrt(k). Of more than 250 landmarks the errors that they share are larger than what averages out.
bool is_wide(const Estimate& e, const Rows& rows, const Blocks& S) {
    const Vector focal = focal_lengths(by_pose(e, rows), rows.dimension());
    std::vector<double> spread;
    for (Index i = 0; i < rows.count(); ++i) {
        const double most = (S[i].diagonal() - rows.variance.col(i)).maxCoeff();
        spread.push_back(most / (focal[i] * std::sqrt(rows.variance.col(i).minCoeff())));
    }
    return median(spread) > 1.0 / std::sqrt(static_cast<double>(std::min<Index>(rows.count(), MOST_AVERAGED)));
}

// The velocity at this frame as corrected by its observations, for eq. (9). With the measured velocity a time offset
// would be estimated far too small: its noise is in the innovations, too.
Vector6 corrected_twist(const Estimate& e, const Tried& tried) {
    const Vector change = e.gaussian.correction(e.gaussian.solve(tried.projection));
    return e.twist_after(retract_values(e, change));
}

}  // namespace

Vector focal_lengths(const Matrix& by_pose, Index dimension) {
    const Vector squares = by_pose.rightCols(3).rowwise().squaredNorm();
    return squares.reshaped(dimension, squares.size() / dimension).colwise().maxCoeff().cwiseSqrt();
}

void look_at(Estimate& e, const Vector6& imu_twist) {
    e.imu_twist = imu_twist;
    open_views(e);
}

Correction correct_plainly(Estimate& e, const Slots& slots, const Matrix& measured) {
    Correction found;
    found.verdict.assign(slots.size(), ACCEPTED);
    found.innovations.alone = found.innovations.apart = Matrix(measured.rows(), 0);
    Observed seen = observe(e, e.mean(), slots, measured);
    for (Index i = 0; i < seen.q.cols(); ++i) {
        if (!e.sensor.in_view(seen.q.col(i), e.config.min_depth_m)) found.verdict[i] = BEHIND_CAMERA;
    }
    const Vector3 step = last_step(e);
    Tried tried = gate_alone(e, seen, found.verdict);
    found.outside = tried.outside;
    if (!tried.some.empty()) {
        if (e.has_time_offset() && e.motion.tau_s) {
            look_at(e, corrected_twist(e, tried));
            seen.rows = observe(e, e.mean(), slots, measured).rows;
            tried.projection = e.gaussian.project(seen.rows.only(tried.some));
            tried.S = own_covariances(tried.projection);
        }
        gate_jointly(e, tried, seen, step, found);
    } else {
        found.change = Vector::Zero(e.gaussian.considered() + e.columns.body + 3 * e.gaussian.landmarks());
    }
    const Slots taken = where(found.verdict, ACCEPTED);
    found.slot = picked(slots, taken);
    found.measured = columns_of(measured, taken);
    found.variance = columns_of(seen.rows.variance, taken);
    found.dof = found.variance.size();
    found.linear = e.mean();
    found.coordinates = e.coordinates;
    found.is_wide = found.solution && is_wide(e, found.solution->at.rows, tried.S);
    return found;
}

Relinearised relinearised(const Estimate& e, const Vector& change, const Slots& slots, const Matrix& measured) {
    const Moved moved = retracted(e, change);
    Relinearised found{moved.mean, e.coordinates + change.head(e.coordinates.size()), {}};
    found.seen = observe(e, found.linear, slots, measured);
    found.seen.rows = carried_back(e, std::move(found.seen.rows), moved);
    Parts back = parts(e, change);
    back.x = -back.x;
    back.d = -back.d;
    found.seen.rows.residual = left_by(found.seen.rows, back);
    return found;
}

}  // namespace ekfslam
