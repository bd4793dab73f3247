// Aliases, rows of observations, and errors that cross the border to Python.
#pragma once

#include <Eigen/Dense>
#include <cstdint>
#include <numeric>
#include <stdexcept>
#include <string>
#include <vector>

namespace ekfslam {

using Index = Eigen::Index;
using Matrix = Eigen::MatrixXd;  // column-major
using Vector = Eigen::VectorXd;
using Vector3 = Eigen::Vector3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix3 = Eigen::Matrix3d;
using Matrix4 = Eigen::Matrix4d;
using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Matrix36 = Eigen::Matrix<double, 3, 6>;
using Slots = std::vector<Index>;  // places of landmarks in the table, of rows, or of columns
using Ids = std::vector<std::int64_t>;
using Flags = std::vector<bool>;

template <class Some>
Index size_of(const Some& some) {
    return static_cast<Index>(some.size());
}
// The numbers from `begin` to `end`, the latter excluded.
inline Slots range(Index begin, Index end) {
    Slots places(end - begin);
    std::iota(places.begin(), places.end(), begin);
    return places;
}
inline void append_range(Slots& places, Index begin, Index end) {
    for (Index i = begin; i < end; ++i) places.push_back(i);
}
// Indices at which a value stands, such as a flag that is set.
template <class T>
Slots where(const std::vector<T>& values, typename std::vector<T>::value_type wanted = true) {
    Slots which;
    for (Index i = 0; i < size_of(values); ++i)
        if (values[i] == wanted) which.push_back(i);
    return which;
}
template <class T>
std::vector<T> picked(const std::vector<T>& values, const Slots& which) {
    std::vector<T> some;
    some.reserve(which.size());
    for (Index i : which) some.push_back(values[i]);
    return some;
}
// Columns of a matrix, in groups of d.
inline Matrix columns_of(const Matrix& M, const Slots& which, Index d = 1) {
    Matrix some(M.rows(), size_of(which) * d);
    for (Index i = 0; i < size_of(which); ++i) some.middleCols(i * d, d) = M.middleCols(which[i] * d, d);
    return some;
}

// A computation that cannot go on; the binding raises `InnovationError(frame, ids)` or `FilterError`.
struct Error : std::runtime_error {
    explicit Error(const std::string& what, Slots at = {}) : std::runtime_error(what), slots(std::move(at)) {}
    Slots slots;  // landmarks at fault, if known
};

// Leading columns of X that rows may depend on: [front | drifted view zd | view z | view of the frame before z'].
struct Lead {
    Index front = 0;  // columns of the body on which landmarks depend directly: Columns::front, then the anchor's view
    Index drifted = -1;   // first column of zd; -1: there is none
    Index view = -1;      // of z
    Index previous = -1;  // of z'
    Index width = 0;
};

// Linearised rows r = H_x x_lead + H_m d + v of k landmarks, d rows each: eq. (4), (10). One column a row.
struct Rows {
    Slots slot;       // (k)
    Matrix H_x;       // (lead, k d)
    Matrix H_m;       // (3, k d)
    Matrix residual;  // (d, k)
    Matrix variance;  // (d, k)

    Index count() const { return residual.cols(); }
    Index dimension() const { return residual.rows(); }
    Rows only(const Slots& which) const;
};

}  // namespace ekfslam
