// The covariance in Python: arrays are copies, and stacks have the landmark first, as those of the reference filter.
#include "binding.hpp"

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace ekfslam::binding {

namespace {

// One column for each row of the blocks: (c, k r) of (k, r, c).
Matrix columns_of(const Stack& blocks) {
    const Index rows = static_cast<Index>(blocks.shape(0) * blocks.shape(1)),
                columns = static_cast<Index>(blocks.shape(2));
    return Eigen::Map<const Matrix>(blocks.data(), columns, rows);
}

// The covariance of Python. Projections and solutions of another one, or of one that has changed since, are refused.
struct Held {
    Gaussian value;
    std::uint64_t stamp = next();

    explicit Held(Gaussian made) : value(std::move(made)) {}
    static std::uint64_t next() {
        static std::atomic<std::uint64_t> count{0};
        return ++count;
    }
};

template <class T>
struct Stamped {
    T value;
    std::uint64_t stamp;

    const T& of(const Held& held) const {
        require(stamp == held.stamp, "rows of another covariance, or of one that has changed since");
        return value;
    }
};
using HeldProjection = Stamped<Projection>;
using HeldSolution = Stamped<Solution>;

// A verb that changes the covariance: all or nothing.
template <class... Arguments>
auto changing(void (*verb)(Gaussian&, Arguments...)) {
    return [verb](Held& held, Arguments... arguments) {
        Gaussian changed = held.value;
        verb(changed, std::forward<Arguments>(arguments)...);
        held.value = std::move(changed);
        held.stamp = Held::next();
    };
}

void require_square(const Matrix& A, Index size, const char* what) {
    require(A.rows() == size && A.cols() == size, what);
}

void require_slots(const Slots& slots, Index count, bool may_repeat = true) {
    std::vector<bool> seen(static_cast<std::size_t>(count));
    for (const Index slot : slots) {
        if (slot < 0 || slot >= count) throw nb::index_error("a slot is not in the state");
        require(may_repeat || !seen[static_cast<std::size_t>(slot)], "slots must be distinct");
        seen[static_cast<std::size_t>(slot)] = true;
    }
}

// Rows of awake landmarks in the present frame.
Rows rows_of(const Gaussian& P, const Slots& slot, const Stack& H_x, const Stack& H_m, const RowMajor& residual,
             const RowMajor& variance) {
    Rows rows{slot, columns_of(H_x), columns_of(H_m), residual.transpose(), variance.transpose()};
    const Index k = static_cast<Index>(slot.size()), d = residual.cols();
    require(residual.rows() == k && variance.rows() == k && variance.cols() == d && rows.H_x.cols() == k * d &&
                rows.H_m.cols() == k * d && rows.H_m.rows() == 3,
            "rows of different lengths");
    require(d >= 1 && d <= 3, "a landmark has one to three rows");
    require(rows.H_x.rows() == P.lead().width, "H_x must have the width of the leading columns");
    require((variance.array() > 0.0).all(), "variances must be positive");
    require_slots(slot, P.landmarks(), false);
    for (const Index one : slot) require(!P.is_dormant(one), "a landmark is dormant");
    return rows;
}

void bind_projection(nb::module_& m) {
    nb::class_<HeldProjection>(m, "Projection")
        .def("only",
             [](const HeldProjection& self, const Slots& which) {
                 require_slots(which, self.value.rows.count(), false);
                 return HeldProjection{self.value.only(which), self.stamp};
             })
        .def_prop_ro("S", [](const HeldProjection& self) { return self.value.S(); })
        .def_prop_ro(
            "variances",
            [](const HeldProjection& self) {
                const Projection& at = self.value;
                std::vector<Matrix> blocks;
                for (Index i = 0; i < at.rows.count(); ++i) blocks.push_back(at.own_variance(i));
                return binding::blocks(blocks, at.rows.dimension());
            },
            nb::rv_policy::move);
    nb::class_<HeldSolution>(m, "Solution")
        .def_prop_ro("nis", [](const HeldSolution& self) { return self.value.nis; })
        .def_prop_ro("log_det", [](const HeldSolution& self) { return self.value.log_det; })
        .def_prop_ro("left", [](const HeldSolution& self) { return self.value.left; })
        .def_prop_ro("residual",
                     [](const HeldSolution& self) -> RowMajor { return self.value.residual().transpose(); });
}

// Matrices of a frame come and go. What glibc may return to the system at once costs a fifth of the frame in page
// faults.
void keep_memory() {
#if defined(__GLIBC__)
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 64 << 20);
#endif
}

// Rows of landmarks of a solution; rows of the body alone have none.
Index rows_in(const Solution& s) { return s.at.rows.count(); }

void bind_updates(nb::class_<Held>& bound) {
    bound
        .def("project",
             [](const Held& self, const Slots& slot, const Stack& H_x, const Stack& H_m, const RowMajor& residual,
                const RowMajor& variance) {
                 Rows rows = rows_of(self.value, slot, H_x, H_m, residual, variance);
                 return HeldProjection{self.value.project(std::move(rows)), self.stamp};
             })
        .def("solve", [](const Held& self,
                         const HeldProjection& at) { return HeldSolution{self.value.solve(at.of(self)), self.stamp}; })
        .def("without",
             [](const Held& self, const HeldSolution& from, const Flags& out) {
                 const Solution& solution = from.of(self);
                 require(static_cast<Index>(out.size()) == rows_in(solution), "one flag for each landmark");
                 return HeldSolution{self.value.without(solution, out), self.stamp};
             })
        .def("solve_body",
             [](const Held& self, const Matrix& H, const Vector& residual, const Vector& variance) {
                 require(H.rows() == residual.size() && H.rows() == variance.size(), "rows of different lengths");
                 require(H.cols() == self.value.columns().body, "H must have the width of the body");
                 return HeldSolution{self.value.solve_body(H, residual, variance), self.stamp};
             })
        .def("correction",
             [](const Held& self, const HeldSolution& solution) { return self.value.correction(solution.of(self)); })
        .def("given_others",
             [](const Held& self, const HeldSolution& from, const Slots& which) {
                 const Solution& solution = from.of(self);
                 const Index d = solution.at.rows.dimension();
                 require_slots(which, rows_in(solution));
                 return blocks(self.value.given_others(solution, which), d);
             })
        .def("information",
             [](const Held& self, const HeldSolution& from, const Matrix& J) {
                 const Solution& solution = from.of(self);
                 const auto left = std::count(solution.left.begin(), solution.left.end(), true);
                 require(J.rows() == static_cast<Index>(left) * solution.at.rows.dimension(), "one row of J for each");
                 return self.value.information(solution, J);
             })
        .def("apply", [](Held& self, const HeldSolution& solution) {
            self.value.apply(solution.of(self));
            self.stamp = Held::next();
        });
}

void propagate(Gaussian& P, const Matrix& Phi, const Matrix& Q) {
    require_square(Phi, P.columns().body, "Phi must be (body, body)");
    require_square(Q, P.columns().body, "Q must be (body, body)");
    P.propagate(Phi, Q);
}

void open_view(Gaussian& P, const Matrix& Y, const std::optional<Matrix>& Yd) {
    for (const Matrix* one : {&Y, Yd ? &*Yd : &Y})
        require(one->rows() == 6 && one->cols() == P.columns().body, "Y must be (6, body)");
    P.open_view(Y, Yd);
}

void augment(Gaussian& P, const Stack& G, const Stack& covariance) {
    const Matrix columns = columns_of(G);
    require(G.shape(1) == 3 && G.shape(0) == covariance.shape(0), "one G (3, lead) and covariance for each landmark");
    require(columns.rows() == P.lead().width, "G must have the width of the leading columns");
    P.augment(columns, blocks_of<Matrix3>(covariance, 3, 3));
}

void transform_body(Gaussian& P, Index at, const Matrix& A) {
    const Columns& c = P.columns();
    const bool is_view = at >= 0 && (at == c.view || at == c.previous || at == c.anchor);
    require(at >= 0 && at <= c.body && A.rows() <= c.body - at, "columns of the body");
    require_square(A, is_view ? 6 : A.rows(), "a square matrix for the columns of the body");
    P.transform_body(at, A);
}

void transform_landmarks(Gaussian& P, const Slots& slots, const std::optional<Stack>& M, const Stack& B, Index at) {
    require_slots(slots, P.landmarks(), false);
    require(B.shape(0) == slots.size() && (!M || M->shape(0) == slots.size()), "one M and B for each landmark");
    P.transform_landmarks(slots, M ? blocks_of<Matrix3>(*M, 3, 3) : std::vector<Matrix3>(),
                          blocks_of<Matrix36>(B, 3, 6), at);
}

void require_flags(const Gaussian& P, const Flags& flags) {
    require(static_cast<Index>(flags.size()) == P.landmarks(), "one flag for each landmark");
}

void replace(Gaussian& P, const Matrix& by) {
    require_square(by, P.columns().body + P.considered() + 3 * P.landmarks(), "P must be (body+3n, body+3n)");
    P.replace(by);
}

void clone(Gaussian& P, Index source, Index size, Index to) {
    const Index body = P.columns().body, first = to - body;
    require_range("columns of the body", source, size, body);
    require_range("considered columns", first, size, P.considered());
    P.clone(source, size, to);
}

void bind_changes(nb::class_<Held>& bound) {
    bound.def("propagate", changing(&propagate))
        .def("close_view", changing(+[](Gaussian& P) { P.close_view(); }))
        .def("open_view", changing(&open_view), arg("Y"), arg("Yd") = nb::none())
        .def("hold_anchor", changing(+[](Gaussian& P) {
                 require(P.columns().anchor >= 0, "there is no anchor");
                 P.hold_anchor();
             }))
        .def("add_noise", changing(+[](Gaussian& P, const Matrix& Q) {
                 require_square(Q, P.columns().body, "Q must be (body, body)");
                 P.add_noise(Q);
             }))
        .def("augment", changing(&augment))
        .def("transform_body", changing(&transform_body))
        .def("transform_landmarks", changing(&transform_landmarks))
        .def("rest", changing(+[](Gaussian& P, const Flags& asleep) {
                 require_flags(P, asleep);
                 P.rest(asleep);
             }))
        .def("marginalise", changing(+[](Gaussian& P, const Flags& stay) {
                 require_flags(P, stay);
                 P.marginalise(stay);
             }))
        .def("replace", changing(&replace))
        .def("consider",
             [](Held& self, Index columns) {
                 require(columns >= 0 && columns <= MOST_CONSIDERED, "an impossible number of considered columns");
                 self.stamp = Held::next();
                 return self.value.consider(columns);
             })
        .def("clone", changing(&clone));
}

Held made(const Matrix& P, Index view, Index previous, Index anchor, const std::vector<Index>& front) {
    const Index body = P.rows();
    require_square(P, body, "P must be square");
    std::vector<int> used(static_cast<std::size_t>(body));
    const auto use = [&](Index at, Index size) {
        require(at >= 0 && at <= body - size, "a view or a column of the front is not in the body");
        for (Index i = 0; i < size; ++i)
            require(used[static_cast<std::size_t>(at + i)]++ == 0, "columns must be distinct");
    };
    for (const Index at : {view, previous, anchor})
        if (at >= 0) use(at, 6);
    for (const Index column : front) use(column, 1);
    require(view >= 0 || (previous < 0 && anchor < 0), "a view of the past needs one of the present");
    return Held(Gaussian(P, Columns{body, view, previous, anchor, front}));
}
}  // namespace

void bind_gaussian(nb::module_& m) {
    keep_memory();
    bind_projection(m);
    nb::class_<Held> bound(m, "Gaussian");
    bound
        .def(
            "__init__",
            [](Held* self, const Matrix& P, Index view, Index previous, Index anchor, std::vector<Index> front) {
                new (self) Held(made(P, view, previous, anchor, front));
            },
            arg("P"), arg("view") = -1, arg("previous") = -1, arg("anchor") = -1, arg("front") = std::vector<Index>())
        .def("__copy__", [](const Held& self) { return Held(self.value); })
        .def("__deepcopy__", [](const Held& self, const nb::object&) { return Held(self.value); })
        .def_prop_ro("lead",
                     [](const Held& self) {
                         const Lead at = self.value.lead();
                         return std::make_tuple(at.front, at.drifted, at.view, at.previous, at.width);
                     })
        .def_prop_ro("landmarks", [](const Held& self) { return self.value.landmarks(); })
        .def_prop_ro("considered", [](const Held& self) { return self.value.considered(); })
        .def_prop_ro("width", [](const Held& self) { return self.value.width(); })
        .def_prop_ro("body_covariance", [](const Held& self) { return self.value.body_covariance(); })
        .def("covariance_of",
             [](const Held& self, const Slots& slots) {
                 require_slots(slots, self.value.landmarks());
                 return self.value.covariance_of(slots);
             })
        .def("landmark_blocks", [](const Held& self, const Slots& slots) {
            require_slots(slots, self.value.landmarks());
            return blocks(self.value.landmark_blocks(slots));
        });
    bind_updates(bound);
    bind_changes(bound);
}

}  // namespace ekfslam::binding
