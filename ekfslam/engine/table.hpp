// The table of landmarks: one entry a landmark, in the order of the covariance; ekfslam/filters/landmarks.py.
#pragma once

#include "estimate.hpp"

namespace ekfslam {

// Columns of the table by name. A height of 0 is that of an observation.
template <class Values>
struct Column {
    const char* name;
    Values Table::* values;
    Index height = 1;
};
constexpr Column<Ids> WHOLE[] = {
    {"id", &Table::id},
    {"first_frame", &Table::first_frame},
    {"last_frame", &Table::last_frame},
    {"observations", &Table::observations},
    {"misses", &Table::misses},
    {"log_row", &Table::log_row},
    {"stay_until", &Table::stay_until},
    {"first_step", &Table::first_step},
    {"last_step", &Table::last_step},
    {"last_observation", &Table::last_observation},
    {"asleep", &Table::asleep},
};
constexpr Column<Matrix> REAL[] = {
    {"position_m", &Table::position_m, 3},
    {"initial_m", &Table::initial_m, 3},
    {"evidence", &Table::evidence, 2},
    {"seen_rows", &Table::seen_rows, 0},
};

struct Lookup {
    Slots slot;   // of each id; 0 if it is unknown
    Flags known;  // whether the id is in the table
};

// Entries for n new landmarks with d rows an observation: all columns are 0.
Table blank(Index n, Index d);
Lookup lookup(const Table& table, const Ids& ids);
// Which landmarks (n) have one of these ids.
Flags is_among(const Table& table, const Ids& ids);
void append(Table& table, const Table& more);
Table only(const Table& table, const Slots& slots);
// Drops the landmarks that do not stay (n).
void keep(Table& table, const Flags& stay);
// Keeps the last observation of landmarks (k): its step, rows (d, k), and places in the log from `place` on.
void observed(Table& table, const Slots& slots, Index step, const Matrix& rows, std::int64_t place);
// Counts an accepted observation of the landmarks.
void accepted(Table& table, const Slots& slots, Index frame);

}  // namespace ekfslam
