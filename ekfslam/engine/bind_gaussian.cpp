// The covariance in Python: arrays are copies, and stacks have the landmark first, as those of the reference filter.
#include "bind_gaussian.hpp"

#include <nanobind/eigen/dense.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include "gaussian.hpp"

namespace nb = nanobind;

namespace ekfslam {

namespace {
using Stack = nb::ndarray<const double, nb::ndim<3>, nb::c_contig>;
using NumPy = nb::ndarray<nb::numpy, double>;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

NumPy array(std::vector<double> numbers, std::vector<std::size_t> shape) {
    auto* kept = new std::vector<double>(std::move(numbers));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
    return NumPy(kept->data(), shape.size(), shape.data(), owner);
}

// (k, r, c) of matrices (r, c).
template <class Some>
NumPy stacked(const std::vector<Some>& blocks, Index rows, Index columns) {
    std::vector<double> numbers;
    for (const Some& block : blocks) {
        const RowMajor rowwise = block;
        numbers.insert(numbers.end(), rowwise.data(), rowwise.data() + rowwise.size());
    }
    return array(std::move(numbers),
                 {blocks.size(), static_cast<std::size_t>(rows), static_cast<std::size_t>(columns)});
}

// One column for each row of the blocks: (c, k r) of (k, r, c).
Matrix columns_of(const Stack& blocks) {
    const Index rows = static_cast<Index>(blocks.shape(0) * blocks.shape(1)),
                columns = static_cast<Index>(blocks.shape(2));
    return Eigen::Map<const Matrix>(blocks.data(), columns, rows);
}

template <class Block>
std::vector<Block> blocks_of(const Stack& stack) {
    if (static_cast<Index>(stack.shape(1)) != Block::RowsAtCompileTime ||
        static_cast<Index>(stack.shape(2)) != Block::ColsAtCompileTime)
        throw Error("a stack of blocks of another shape");
    std::vector<Block> blocks;
    for (std::size_t i = 0; i < stack.shape(0); ++i)
        blocks.push_back(
            Eigen::Map<
                const Eigen::Matrix<double, Block::RowsAtCompileTime, Block::ColsAtCompileTime, Eigen::RowMajor>>(
                stack.data() + i * stack.shape(1) * stack.shape(2)));
    return blocks;
}

Rows rows_of(const Slots& slot, const Stack& H_x, const Stack& H_m, const RowMajor& residual,
             const RowMajor& variance) {
    Rows rows{slot, columns_of(H_x), columns_of(H_m), residual.transpose(), variance.transpose()};
    const Index k = static_cast<Index>(slot.size()), d = residual.cols();
    if (residual.rows() != k || variance.rows() != k || variance.cols() != d || rows.H_x.cols() != k * d ||
        rows.H_m.cols() != k * d || rows.H_m.rows() != 3)
        throw Error("rows of different lengths");
    return rows;
}

void bind_projection(nb::module_& m) {
    nb::class_<Projection>(m, "Projection")
        .def("only", &Projection::only)
        .def_prop_ro("S", &Projection::S)
        .def_prop_ro(
            "variances",
            [](const Projection& self) {
                std::vector<Matrix> blocks;
                for (Index i = 0; i < self.rows.count(); ++i) blocks.push_back(self.own_variance(i));
                return stacked(blocks, self.rows.dimension(), self.rows.dimension());
            },
            nb::rv_policy::move);
    nb::class_<Solution>(m, "Solution")
        .def_ro("nis", &Solution::nis)
        .def_ro("log_det", &Solution::log_det)
        .def_ro("left", &Solution::left)
        .def_prop_ro("residual", [](const Solution& self) -> RowMajor { return self.residual().transpose(); });
}

// Matrices of a frame come and go. What glibc may return to the system at once costs a fifth of the frame in page
// faults.
void keep_memory() {
#if defined(__GLIBC__)
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 64 << 20);
#endif
}
void bind_updates(nb::class_<Gaussian>& bound) {
    bound
        .def("project",
             [](const Gaussian& self, const Slots& slot, const Stack& H_x, const Stack& H_m, const RowMajor& residual,
                const RowMajor& variance) { return self.project(rows_of(slot, H_x, H_m, residual, variance)); })
        .def("solve", &Gaussian::solve)
        .def("without", &Gaussian::without)
        .def("solve_body", &Gaussian::solve_body)
        .def("correction", &Gaussian::correction)
        .def("given_others",
             [](const Gaussian& self, const Solution& solution, const Slots& which) {
                 const Index d = solution.at.rows.dimension();
                 return stacked(self.given_others(solution, which), d, d);
             })
        .def("information", &Gaussian::information)
        .def("apply", &Gaussian::apply);
}

void bind_changes(nb::class_<Gaussian>& bound) {
    bound.def("propagate", &Gaussian::propagate)
        .def("close_view", &Gaussian::close_view)
        .def("open_view", &Gaussian::open_view, nb::arg("Y"), nb::arg("Yd") = nb::none())
        .def("hold_anchor", &Gaussian::hold_anchor)
        .def("add_noise", &Gaussian::add_noise)
        .def("augment", [](Gaussian& self, const Stack& G,
                           const Stack& covariance) { self.augment(columns_of(G), blocks_of<Matrix3>(covariance)); })
        .def("transform_body", &Gaussian::transform_body)
        .def("transform_landmarks",
             [](Gaussian& self, const Slots& slots, const std::optional<Stack>& M, const Stack& B, Index at) {
                 self.transform_landmarks(slots, M ? blocks_of<Matrix3>(*M) : std::vector<Matrix3>(),
                                          blocks_of<Matrix36>(B), at);
             })
        .def("rest", &Gaussian::rest)
        .def("marginalise", &Gaussian::marginalise)
        .def("replace", &Gaussian::replace)
        .def("consider", &Gaussian::consider)
        .def("clone", &Gaussian::clone);
}
}  // namespace

void bind_gaussian(nb::module_& m) {
    keep_memory();
    bind_projection(m);
    nb::class_<Gaussian> bound(m, "Gaussian");
    bound
        .def(
            "__init__",
            [](Gaussian* self, const Matrix& P, Index view, Index previous, Index anchor, std::vector<Index> front) {
                new (self) Gaussian(P, Columns{P.rows(), view, previous, anchor, std::move(front)});
            },
            nb::arg("P"), nb::arg("view") = -1, nb::arg("previous") = -1, nb::arg("anchor") = -1,
            nb::arg("front") = std::vector<Index>())
        .def("__copy__", [](const Gaussian& self) { return Gaussian(self); })
        .def("__deepcopy__", [](const Gaussian& self, const nb::object&) { return Gaussian(self); })
        .def_prop_ro("lead",
                     [](const Gaussian& self) {
                         const Lead at = self.lead();
                         return std::make_tuple(at.front, at.drifted, at.view, at.previous, at.width);
                     })
        .def_prop_ro("landmarks", &Gaussian::landmarks)
        .def_prop_ro("considered", &Gaussian::considered)
        .def_prop_ro("width", &Gaussian::width)
        .def_prop_ro("body_covariance", &Gaussian::body_covariance)
        .def("covariance_of", &Gaussian::covariance_of)
        .def("landmark_blocks",
             [](const Gaussian& self, const Slots& slots) { return stacked(self.landmark_blocks(slots), 3, 3); });
    bind_updates(bound);
    bind_changes(bound);
}

}  // namespace ekfslam
