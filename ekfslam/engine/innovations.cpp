#include "innovations.hpp"

#include <limits>

namespace ekfslam {
namespace {

using Few = Eigen::Matrix<double, Eigen::Dynamic, 6, 0, 3, 6>;  // (d, 6), without allocation

// The inverse of an information matrix; NaN if it leaves a direction undetermined.
Matrix6 inverse(const Matrix6& information) {
    const Vector6 std = information.diagonal().cwiseMax(std::numeric_limits<double>::min()).cwiseSqrt();
    const Matrix6 scale = std.cwiseInverse().asDiagonal();
    const Eigen::SelfAdjointEigenSolver<Matrix6> own(scale * information * scale);
    if (!(own.eigenvalues()[0] > 1e-12)) return Matrix6::Constant(std::numeric_limits<double>::quiet_NaN());
    const Matrix6 axes = own.eigenvectors();
    return scale * axes * own.eigenvalues().cwiseInverse().asDiagonal() * axes.transpose() * scale;
}

}  // namespace

Matrix by_pose(const Estimate& e, const Rows& rows) {
    const Lead lead = e.gaussian.lead();
    const Index pose = e.block("pose")->at;
    Matrix J = rows.H_x.middleRows(lead.view, 6).transpose() * e.opened.Y.middleCols(pose, 6);
    if (lead.drifted >= 0) J += rows.H_x.middleRows(lead.drifted, 6).transpose() * e.drifted->Y.middleCols(pose, 6);
    return J;
}

FrameInnovations innovations_of(const Estimate& e, const Gaussian& gaussian, const Solution& solution, const Rows& rows,
                                const Blocks& S, const Matrix& left) {
    const Index d = rows.dimension(), k = rows.count();
    FrameInnovations found;
    if (!k) {
        found.alone = found.apart = Matrix(d, 0);
        return found;
    }
    const Matrix J = by_pose(e, rows), weighted = left.cwiseQuotient(rows.variance);
    found.landmark = picked(e.table.log_row, rows.slot);
    found.information = gaussian.information(solution, J);
    found.score = J.transpose() * weighted.reshaped();
    const Matrix6 shared = inverse(found.information);
    const Vector moved = J * (shared * found.score);
    Blocks S_apart(S);
    for (Index i = 0; i < k; ++i) {
        const Few J_i = J.middleRows(i * d, d), J_shared = J_i.lazyProduct(shared);
        S_apart[i] -= J_shared.lazyProduct(J_i.transpose());
    }
    found.alone = whitened(S, rows.residual);
    found.apart = whitened(S_apart, rows.residual - moved.reshaped(d, k));
    return found;
}

}  // namespace ekfslam
