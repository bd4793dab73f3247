// Aliases, rows of observations, and errors that cross the border to Python.
#pragma once

#include <Eigen/Dense>
#include <cstdint>
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
using Slots = std::vector<Index>;  // places of landmarks in the table
using Ids = std::vector<std::int64_t>;

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
