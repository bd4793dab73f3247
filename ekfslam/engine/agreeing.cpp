#include <algorithm>
#include <limits>
#include <optional>

#include "blas.hpp"
#include "consensus.hpp"

namespace ekfslam {
namespace {

constexpr Index SAMPLES = 100;

using Sample = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 9, 9>;  // of three landmarks
using ByOne = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, 9, 3>;
using OfSample = Eigen::Matrix<double, Eigen::Dynamic, 1, Eigen::ColMajor, 9, 1>;
using OfOne = Eigen::Matrix<double, Eigen::Dynamic, 1, Eigen::ColMajor, 3, 1>;

// e^T C^-1 e, by C = L D L^T.
double square(const Block3& C, const OfOne& e) {
    Block3 L = C;  // D on its diagonal
    OfOne y = e;
    double sum = 0.0;
    for (Index j = 0; j < C.rows(); ++j) {
        for (Index l = 0; l < j; ++l) {
            L(j, j) -= L(j, l) * L(j, l) * L(l, l);
            y[j] -= L(j, l) * y[l];
        }
        sum += y[j] * y[j] / L(j, j);
        for (Index i = j + 1; i < C.rows(); ++i) {
            for (Index l = 0; l < j; ++l) L(i, j) -= L(i, l) * L(j, l) * L(l, l);
            L(i, j) /= L(j, j);
        }
    }
    return sum;
}

// Rows of landmarks, d each.
Slots rows_of(const Slots& landmarks, Index d) {
    Slots rows;
    rows.reserve(landmarks.size() * d);
    for (Index i : landmarks) append_range(rows, i * d, i * d + d);
    return rows;
}

// The inverse of a covariance, by Cholesky.
Matrix inverse(Matrix S) {
    int n = blas::size(S.rows()), failed = 0;
    char lower = 'L';
    if (!n) return S;
    const bool is_regular = blas::factorise(S);
    if (is_regular) lapack::dpotri(&lower, &n, S.data(), &n, &failed);
    if (!is_regular || failed) throw Error("the innovation covariance is not positive definite");
    S.triangularView<Eigen::StrictlyUpper>() = S.transpose();
    return S;
}

std::vector<Slots> combinations(Index k, Index size) {
    std::vector<Slots> all;
    Slots one = range(0, size);
    while (true) {
        all.push_back(one);
        Index last = size - 1;
        while (last >= 0 && one[last] == k - size + last) --last;
        if (last < 0) return all;
        ++one[last];
        for (Index i = last + 1; i < size; ++i) one[i] = one[i - 1] + 1;
    }
}

// The cost of a sample, and the squares (k) of all landmarks given it: 0 for its own.
struct Tally {
    double cost;
    Vector squares;
};

// Nothing if the cost exceeds `most`.
std::optional<Tally> tally(const Matrix& S, const Matrix& residual, const Vector& focal, double gate,
                           const Slots& sample, double most) {
    const Index d = residual.rows(), k = residual.cols();
    const Slots rows = rows_of(sample, d);
    const Index size = size_of(rows);
    const Eigen::LLT<Sample> factor(S(rows, rows));
    if (factor.info() != Eigen::Success) return std::nullopt;
    const Sample U = factor.matrixU();
    OfSample w(size);
    for (Index j = 0; j < size; ++j) w[j] = (residual.data()[rows[j]] - U.col(j).head(j).dot(w.head(j))) / U(j, j);
    Tally found{w.squaredNorm(), Vector::Zero(k)};
    double cost = found.cost;
    for (Index i = 0; i < k && cost <= most; ++i) {
        if (std::find(sample.begin(), sample.end(), i) != sample.end()) continue;
        ByOne W(size, d);
        for (Index c = 0; c < d; ++c)
            for (Index j = 0; j < size; ++j)
                W(j, c) = (S(rows[j], i * d + c) - U.col(j).head(j).dot(W.col(c).head(j))) / U(j, j);
        const OfOne by = W.transpose().lazyProduct(w);
        const double bend = by.squaredNorm() / focal[i];
        Block3 left = S.block(i * d, i * d, d, d);
        left -= W.transpose().lazyProduct(W);
        left.diagonal().array() += bend * bend;
        found.squares[i] = square(left, residual.col(i) - by);
        cost += std::min(found.squares[i], gate);
    }
    if (cost > most) return std::nullopt;
    found.cost += found.squares.cwiseMin(gate).sum();
    return found;
}

// Inverse covariance of the landmarks A, from which the worst one can be taken out.
struct Agreeing {
    Index d;
    Slots some;
    Matrix K;

    // The largest y_i^T K_ii^-1 y_i, y = K r_A, and its place.
    std::pair<double, Index> worst(const Matrix& residual) const {
        const Vector y = K * columns_of(residual, some).reshaped();
        Vector squares(size_of(some));
        for (Index i = 0; i < squares.size(); ++i) {
            squares[i] = square(K.block(i * d, i * d, d, d), y.segment(i * d, d));
        }
        Index at = 0;
        const double most = squares.maxCoeff(&at);
        return {most, at};
    }

    // Without rows i the inverse is K - K_:i K_ii^-1 K_i: .
    void drop(Index i) {
        const Block3 own = K.block(i * d, i * d, d, d);
        K -= (K.middleCols(i * d, d) * own.partialPivLu().solve(Matrix(K.middleRows(i * d, d)))).eval();
        some.erase(some.begin() + i);
        Slots left = range(0, i);
        append_range(left, i + 1, size_of(some) + 1);
        const Slots rows = rows_of(left, d);
        K = Matrix(K(rows, rows));
    }
};

}  // namespace

std::vector<Slots> samples_of(Index k, Index frame, const Uniform& uniform) {
    const Index size = std::max<Index>(std::min<Index>(3, k - 1), 1);
    const Index combined = size == 3 ? k * (k - 1) * (k - 2) / 6 : size == 2 ? k * (k - 1) / 2 : k;
    if (combined <= SAMPLES) return combinations(k, size);
    const Matrix numbers = uniform(frame, SAMPLES, k);
    std::vector<Slots> samples;
    for (Index i = 0; i < SAMPLES; ++i) {
        Slots order = range(0, k);
        std::partial_sort(order.begin(), order.begin() + size, order.end(),
                          [&](Index a, Index b) { return numbers(i, a) < numbers(i, b); });
        samples.emplace_back(order.begin(), order.begin() + size);
    }
    return samples;
}

Flags agreeing(const Matrix& S, const Matrix& residual, const Vector& focal, double gate,
               const std::vector<Slots>& samples) {
    // Costs only grow from landmark to landmark; the margin is for sums in another order.
    constexpr double margin = 1.0 + 1e-9;
    Tally best{std::numeric_limits<double>::infinity(), Vector::Constant(residual.cols(), gate + 1.0)};
    for (const Slots& sample : samples) {
        std::optional<Tally> next = tally(S, residual, focal, gate, sample, margin * best.cost);
        if (next && next->cost < best.cost) best = std::move(*next);
    }
    Flags agree(residual.cols());
    for (Index i = 0; i < residual.cols(); ++i) agree[i] = best.squares[i] <= gate;
    return agree;
}

Flags refined(const Matrix& S, const Matrix& residual, const Flags& inside, double gate) {
    const Index d = residual.rows();
    Slots rows = rows_of(where(inside), d);
    Agreeing with{d, where(inside), inverse(S(rows, rows))};
    while (!with.some.empty()) {
        const auto [most, at] = with.worst(residual);
        if (most <= gate) break;
        with.drop(at);
    }
    Flags agree(inside.size(), false);
    for (Index i : with.some) agree[i] = true;
    rows = rows_of(with.some, d);
    const Vector r_a = columns_of(residual, with.some).reshaped();
    for (Index i : where(agree, false)) {
        const Matrix S_ia = S.middleRows(i * d, d)(Eigen::all, rows), gain = S_ia * with.K;
        const Block3 C = S.block(i * d, i * d, d, d) - gain * S_ia.transpose();
        agree[i] = square(C, residual.col(i) - gain * r_a) <= gate;
    }
    return agree;
}

}  // namespace ekfslam
