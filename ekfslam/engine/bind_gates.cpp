// Gates and consensus in Python, as submodule `gates`: stacks have the landmark first, as those of the reference
// filter.
#include "bind_gates.hpp"

#include <nanobind/eigen/dense.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/function.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tuple>

#include "consensus.hpp"

namespace nb = nanobind;

namespace ekfslam {
namespace {

using Stack = nb::ndarray<const double, nb::ndim<3>, nb::c_contig>;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// Symmetric blocks (k, d, d).
template <class Block>
std::vector<Block> blocks_of(const Stack& stack, const RowMajor& like) {
    const auto k = static_cast<Index>(stack.shape(0)), d = static_cast<Index>(stack.shape(1));
    if (k != like.rows() || d != like.cols() || d > 3 || stack.shape(2) != stack.shape(1)) {
        throw nb::value_error("blocks (k, d, d), d at most 3, do not fit to rows (k, d)");
    }
    std::vector<Block> blocks;
    for (Index i = 0; i < k; ++i) blocks.push_back(Eigen::Map<const Matrix>(stack.data() + i * d * d, d, d));
    return blocks;
}

void require(bool holds, const char* what) {
    if (!holds) throw nb::value_error(what);
}

void require_joint(const Matrix& S, const RowMajor& residual, Index count) {
    require(S.rows() == residual.size() && S.cols() == S.rows(), "S must be (k d, k d) for residuals (k, d)");
    require(count == residual.rows(), "there must be one number a landmark");
}

}  // namespace

void bind_gates(nb::module_& m) {
    nb::module_ gates = m.def_submodule("gates");
    gates.def("normalised_squares", [](const Stack& S, const RowMajor& residual) {
        return normalised_squares(blocks_of<Block3>(S, residual), residual.transpose(), Slots(residual.rows()));
    });
    gates.def("agrees_with_others", [](const RowMajor& left, const RowMajor& variance, const Stack& C) {
        const Judged found = agrees_with_others(left.transpose(), variance.transpose(), blocks_of<Matrix>(C, left));
        return std::make_tuple(found.squares, found.judged);
    });
    gates.def("most_given_others", [](const RowMajor& left, const RowMajor& variance, const Stack& S) {
        return most_given_others(left.transpose(), variance.transpose(), blocks_of<Block3>(S, left));
    });
    gates.def("whitened", [](const Stack& S, const RowMajor& residual) -> RowMajor {
        return whitened(blocks_of<Block3>(S, residual), residual.transpose()).transpose();
    });
    gates.def("samples_of", &samples_of);
    gates.def("agreeing", [](const Matrix& S, const RowMajor& residual, const Vector& focal, double gate,
                             const std::vector<Slots>& samples) {
        require_joint(S, residual, focal.size());
        for (const Slots& sample : samples) {
            for (Index i : sample) require(i >= 0 && i < residual.rows(), "a sample of landmarks that are not there");
        }
        require(!samples.empty(), "there must be a sample");
        return agreeing(S, residual.transpose(), focal, gate, samples);
    });
    gates.def("refined", [](const Matrix& S, const RowMajor& residual, const Flags& inside, double gate) {
        require_joint(S, residual, static_cast<Index>(inside.size()));
        return refined(S, residual.transpose(), inside, gate);
    });
}

}  // namespace ekfslam
