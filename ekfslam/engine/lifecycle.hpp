// How landmarks leave the state: filters/lifecycle.py.
#pragma once

#include "table.hpp"

namespace ekfslam {

// Landmarks (k) that left the state, with their last estimates.
struct Retired {
    Table table;
    std::vector<Matrix3> covariance;
    bool may_return = false;
};

// Which landmarks (n) have not been seen for `after` frames; `ids` are seen now.
Flags out_of_view(const Table& table, const Ids& ids, Index frame, Index after);
// Which landmarks out of view (n) stay, dormant: the last seen up to a limit; -1: all.
Flags at_rest(const Flags& out, const Table& table, Index limit);
// Marginalise landmarks (n): drop their rows and columns, and return their last estimates.
Retired retire(Estimate& e, const Flags& gone, bool may_return);

}  // namespace ekfslam
