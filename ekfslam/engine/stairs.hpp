// Columns of a staircase.
#pragma once

#include <algorithm>

#include "gaussian.hpp"

namespace ekfslam {

// Neighbouring columns of T^T that are zero before row `begin`.
struct Stair {
    Index begin, column, width;
};

inline Slots ascending(const Slots& begin) {
    Slots order = range(0, size_of(begin));
    std::stable_sort(order.begin(), order.end(), [&](Index i, Index j) { return begin[i] < begin[j]; });
    return order;
}

// Steps of a few landmarks at least: calls of BLAS for fewer cost more than they spare.
inline std::vector<Stair> stairs(const Projection& at) {
    constexpr Index few = 8;
    const Index d = at.rows.dimension();
    std::vector<Stair> found;
    Slots begins(at.begin.size());
    for (Index i = 0; i < size_of(begins); ++i) begins[at.place[i]] = at.begin[i];
    for (Index p = 0; p < size_of(begins); ++p) {
        const bool is_next = found.empty() || (begins[p] != begins[p - 1] && found.back().width >= few * d);
        if (is_next) found.push_back({begins[p], p * d, 0});
        found.back().width += d;
    }
    return found;
}

// X <- L^-1 X for a lower triangle of a few rows.
template <class Rows>
void divide_rows(const Eigen::Map<const Matrix>& L, Rows&& X) {
    for (Index j = 0; j < L.rows(); ++j) {
        for (Index l = 0; l < j; ++l) X.row(j) -= L(j, l) * X.row(l);
        X.row(j) /= L(j, j);
    }
}

}  // namespace ekfslam
