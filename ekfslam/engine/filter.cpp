#include "filter.hpp"

#include <algorithm>

#include "retraction.hpp"

namespace ekfslam {
namespace {

// Whether an observation is evidence against its landmark, not merely against itself.
bool missed(int reason) { return reason == GATE || reason == BEHIND_CAMERA; }

// What the log takes in of a correction, before the estimate takes it.
Taken taken_by(const Estimate& e, const Correction& found) {
    const Mean& linear = found.linear;
    Taken taken{picked(e.table.log_row, found.slot),
                picked(e.table.last_observation, found.slot),
                found.measured,
                found.variance,
                columns_of(linear.position_m, found.slot),
                linear.values.flat,
                found.coordinates,
                linear.imu_twist};
    for (Index i = 0; i < size_of(found.slot); ++i) {
        const bool follows = e.track_error && e.table.last_step[found.slot[i]] == e.step - 1;
        if (!follows) taken.previous[i] = -1;
    }
    return taken;
}

// Whether a view without a block has another derivative after a correction: by a calibration, or blocks that move it.
bool has_blocks_of_camera(const Estimate& e) {
    const auto is_of_camera = [](const Block& block) { return block.moves_camera || block.kind == Kind::calibration; };
    return std::any_of(e.blocks.begin(), e.blocks.end(), is_of_camera);
}

}  // namespace

Filter::Filter(Estimate estimate, std::int64_t landmark, std::int64_t observation)
    : e(std::move(estimate)), next_landmark(landmark), next_observation(observation) {}

Report Filter::update(Index frame, const Ids& ids, const Matrix& measured) {
    Retired out = rest(frame, ids);
    Report report = take(frame, ids, measured);
    report.retired.insert(report.retired.begin(), std::move(out));
    return report;
}

Retired Filter::rest(Index frame, const Ids& ids) {
    const Flags out = out_of_view(e.table, ids, frame, e.config.retire_after);
    Flags asleep = at_rest(out, e.table, e.config.dormant), gone(out.size());
    for (Index i = 0; i < size_of(gone); ++i) gone[i] = out[i] && !asleep[i];
    Retired retired = retire(e, gone, true);
    Flags still;
    for (Index i : where(gone, false)) still.push_back(asleep[i]);
    e.table.asleep.assign(still.begin(), still.end());
    e.gaussian.rest(still);
    return retired;
}

Report Filter::take(Index frame, const Ids& ids, const Matrix& measured) {
    Report report;
    // 1. Screen observations that cannot be used at all.
    const Matrix rows = e.sensor.rows(measured);
    report.reason = e.sensor.screen(measured);
    const Lookup at = lookup(e.table, ids);
    Slots known;
    for (Index i = 0; i < size_of(ids); ++i) {
        if (moving.count(ids[i])) report.reason[i] = MOVING;
        if (at.known[i] && report.reason[i] == ACCEPTED) known.push_back(i);
    }
    // 2. Correct with known landmarks: solve eq. (6) for rows (3), (4), (10), then apply (6), (7) and (7').
    const Slots slots = picked(at.slot, known);
    Correction found = correct(e, frame, slots, columns_of(rows, known), uniform);
    take_in(found, frame, report);
    // 3. Retire tracks that move for good, and start tracks that jumped again.
    Slots moves;
    for (Index i = 0; i < size_of(known); ++i) {
        report.reason[known[i]] = found.verdict[i];
        if (missed(found.verdict[i])) ++e.table.misses[slots[i]];
        if (found.verdict[i] == MOVING) moves.push_back(slots[i]);
    }
    split(moves, report);
    Slots fresh;
    for (Index i = 0; i < size_of(ids); ++i) {
        const bool jumped = std::count(report.split.begin(), report.split.end(), ids[i]);
        if (jumped || (!at.known[i] && report.reason[i] == ACCEPTED)) fresh.push_back(i);
    }
    report.updated_values = e.values.flat;
    report.updated_coordinates = e.coordinates;
    // 4. Start new landmarks, eq. (5), or let them wait.
    const Flags started = start_new(frame, picked(ids, fresh), columns_of(rows, fresh), report);
    for (Index i = 0; i < size_of(fresh); ++i) {
        const int waits = e.sensor.type == Sensor::rig ? DISPARITY : WAITING;
        report.reason[fresh[i]] = started[i] ? ACCEPTED : waits;
    }
    moving.insert(report.moving.begin(), report.moving.end());
    return report;
}

void Filter::take_in(Correction& found, Index frame, Report& report) {
    if (found.prior) {
        found.prior->table = std::move(e.table);
        e = std::move(*found.prior);
    }
    report.taken = taken_by(e, found);
    observed(e.table, found.slot, e.step, found.measured, next_observation);
    next_observation += static_cast<std::int64_t>(found.slot.size());
    if (found.solution) e.gaussian.apply(*found.solution);
    e.imu_twist = found.linear.imu_twist;
    retract(e, found.change);
    if (e.columns.view < 0 && has_blocks_of_camera(e)) open_views(e);
    if (found.dof) e.updated = Updated::view;
    accepted(e.table, found.slot, frame);
    report.nis = found.nis;
    report.log_det = found.log_det;
    report.dof = found.dof;
    report.doubt = e.motion.doubt;
    report.innovations = std::move(found.innovations);
}

void Filter::split(const Slots& moves, Report& report) {
    Flags gone(e.table.id.size(), false);
    for (Index slot : moves) gone[slot] = true;
    report.moving = picked(e.table.id, where(gone));
    const std::int64_t after = e.config.misses_to_split;
    for (Index i = 0; i < e.table.size(); ++i) {
        if (after <= 0 || e.table.misses[i] < after || gone[i]) continue;
        gone[i] = true;
        report.split.push_back(e.table.id[i]);
    }
    report.retired.push_back(retire(e, gone, false));
}

Flags Filter::start_new(Index frame, const Ids& ids, const Matrix& rows, Report& report) {
    const bool is_rig = e.sensor.type == Sensor::rig;
    Started found = is_rig ? start(e, frame, ids, rows) : waiting.start(e, frame, ids, rows);
    const Slots which = where(found.which);
    const auto count = size_of(which), first = e.table.size() - count;
    if (found.step_before >= 0) next_observation += count;
    for (Index i = 0; i < count; ++i) {
        e.table.log_row[first + i] = next_landmark++;
        e.table.last_observation[first + i] = next_observation++;
    }
    // No update: but if every active landmark is new, its image coordinates refer to this view.
    if (!report.dof) {
        bool any = false, all_new = true;
        for (Index i = 0; i < e.table.size(); ++i) {
            if (e.table.asleep[i]) continue;
            any = true;
            all_new = all_new && e.table.first_step[i] == e.step;
        }
        e.updated = any && all_new ? Updated::view : Updated::none;
    }
    found.ids = picked(ids, which);
    report.begun = std::move(found);
    return report.begun.which;
}

void Filter::revive(const Table& more) { append(e.table, more); }

void Filter::adopt(const Vector& values, const Vector& coordinates, const Matrix& position_m, const Matrix& P) {
    e.values.flat = values;
    e.coordinates = coordinates;
    e.table.position_m = position_m;
    const Index body = e.columns.body, considered = e.gaussian.considered(), landmarks = P.rows() - body;
    Matrix whole = Matrix::Zero(P.rows() + considered, P.rows() + considered);
    whole.topLeftCorner(body, body) = P.topLeftCorner(body, body);
    whole.bottomRightCorner(landmarks, landmarks) = P.bottomRightCorner(landmarks, landmarks);
    whole.bottomLeftCorner(landmarks, body) = P.bottomLeftCorner(landmarks, body);
    whole.topRightCorner(body, landmarks) = P.topRightCorner(body, landmarks);
    e.gaussian.replace(whole);
    open_views(e);
}

}  // namespace ekfslam
