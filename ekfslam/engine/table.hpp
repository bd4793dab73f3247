// The table of landmarks: one entry a landmark, in the order of the covariance; ekfslam/filters/landmarks.py.
#pragma once

#include "estimate.hpp"

namespace ekfslam {

using Flags = std::vector<bool>;

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

// Indices at which a flag is set, or is not.
Slots where(const Flags& flags, bool value = true);
template <class T>
std::vector<T> picked(const std::vector<T>& values, const Slots& which) {
    std::vector<T> some;
    some.reserve(which.size());
    for (Index i : which) some.push_back(values[i]);
    return some;
}
// Columns of a matrix.
Matrix columns(const Matrix& values, const Slots& which);

}  // namespace ekfslam
