// Columns of a staircase, and landmarks by columns.
#pragma once

#include <algorithm>
#include <numeric>

#include "gaussian.hpp"

namespace ekfslam {

// Neighbouring columns of T^T that are zero before row `begin`.
struct Stair {
    Index begin, column, width;
};

inline Slots ascending(const std::vector<Index>& begin) {
    Slots order(begin.size());
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](Index i, Index j) {
        return begin[static_cast<std::size_t>(i)] < begin[static_cast<std::size_t>(j)];
    });
    return order;
}

// Steps of a few landmarks at least: calls of BLAS for fewer cost more than they spare.
inline std::vector<Stair> stairs(const Projection& at) {
    constexpr Index few = 8;
    const Index d = at.rows.dimension();
    std::vector<Stair> found;
    std::vector<Index> begins(at.begin.size());
    for (std::size_t i = 0; i < begins.size(); ++i) begins[static_cast<std::size_t>(at.place[i])] = at.begin[i];
    for (std::size_t p = 0; p < begins.size(); ++p) {
        const bool is_next = found.empty() || (begins[p] != begins[p - 1] && found.back().width >= few * d);
        if (is_next) found.push_back({begins[p], static_cast<Index>(p) * d, 0});
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

inline Matrix columns_of(const Matrix& M, const Slots& which, Index d) {
    Matrix some(M.rows(), static_cast<Index>(which.size()) * d);
    for (std::size_t i = 0; i < which.size(); ++i)
        some.middleCols(static_cast<Index>(i) * d, d) = M.middleCols(which[i] * d, d);
    return some;
}

inline Slots places_of(const std::vector<bool>& flags) {
    Slots some;
    for (std::size_t i = 0; i < flags.size(); ++i)
        if (flags[i]) some.push_back(static_cast<Index>(i));
    return some;
}

}  // namespace ekfslam
