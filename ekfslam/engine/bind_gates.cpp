// Gates and consensus in Python, as submodule `gates`: stacks have the landmark first, as those of the reference
// filter.
#include <nanobind/stl/function.h>

#include "binding.hpp"
#include "consensus.hpp"

namespace ekfslam::binding {
namespace {

// Blocks (k, d, d).
template <class Block>
std::vector<Block> blocks_of(const Stack& stack, const RowMajor& like) {
    require(static_cast<Index>(stack.shape(0)) == like.rows() && like.cols() <= 3,
            "blocks (k, d, d), d at most 3, do not fit to rows (k, d)");
    return binding::blocks_of<Block>(stack, like.cols(), like.cols());
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

}  // namespace ekfslam::binding
