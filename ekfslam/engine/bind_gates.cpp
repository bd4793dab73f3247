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

// More landmarks than a frame can have.
constexpr Index MOST_LANDMARKS = 1000000;

void require_joint(const Matrix& S, const RowMajor& residual, Index count) {
    require(residual.cols() >= 1 && residual.cols() <= 3, "a landmark has one to three rows");
    require(S.rows() == residual.size() && S.cols() == S.rows(), "S must be (k d, k d) for residuals (k, d)");
    require(count == residual.rows(), "there must be one number a landmark");
}

void require_alike(const RowMajor& variance, const RowMajor& left) {
    require(variance.rows() == left.rows() && variance.cols() == left.cols(), "variance must have the shape of left");
}

void require_sample(const Slots& sample, Index count) {
    require(!sample.empty() && sample.size() <= 3, "a sample has one to three landmarks");
    for (std::size_t i = 0; i < sample.size(); ++i) {
        require(sample[i] >= 0 && sample[i] < count, "a sample of landmarks that are not there");
        for (std::size_t j = 0; j < i; ++j) require(sample[i] != sample[j], "landmarks of a sample must be distinct");
    }
}

std::vector<Slots> samples(Index k, Index frame, const Uniform& uniform) {
    require(k >= 1 && k <= MOST_LANDMARKS, "an impossible number of landmarks");
    return samples_of(k, frame, [&](Index of, Index rows, Index columns) {
        const Matrix numbers = uniform(of, rows, columns);
        require(numbers.rows() == rows && numbers.cols() == columns, "random numbers must have the shape (rows, k)");
        return numbers;
    });
}

}  // namespace

void bind_gates(nb::module_& m) {
    nb::module_ gates = m.def_submodule("gates");
    gates.def("normalised_squares", [](const Stack& S, const RowMajor& residual) {
        return normalised_squares(blocks_of<Block3>(S, residual), residual.transpose(), Slots(residual.rows()));
    });
    gates.def("agrees_with_others", [](const RowMajor& left, const RowMajor& variance, const Stack& C) {
        require_alike(variance, left);
        const Judged found = agrees_with_others(left.transpose(), variance.transpose(), blocks_of<Matrix>(C, left));
        return std::make_tuple(found.squares, found.judged);
    });
    gates.def("most_given_others", [](const RowMajor& left, const RowMajor& variance, const Stack& S) {
        require_alike(variance, left);
        return most_given_others(left.transpose(), variance.transpose(), blocks_of<Block3>(S, left));
    });
    gates.def("whitened", [](const Stack& S, const RowMajor& residual) -> RowMajor {
        return whitened(blocks_of<Block3>(S, residual), residual.transpose()).transpose();
    });
    gates.def("samples_of", &samples);
    gates.def("agreeing", [](const Matrix& S, const RowMajor& residual, const Vector& focal, double gate,
                             const std::vector<Slots>& samples) {
        require_joint(S, residual, focal.size());
        for (const Slots& sample : samples) require_sample(sample, residual.rows());
        require(!samples.empty(), "there must be a sample");
        return agreeing(S, residual.transpose(), focal, gate, samples);
    });
    gates.def("refined", [](const Matrix& S, const RowMajor& residual, const Flags& inside, double gate) {
        require_joint(S, residual, static_cast<Index>(inside.size()));
        return refined(S, residual.transpose(), inside, gate);
    });
}

}  // namespace ekfslam::binding
