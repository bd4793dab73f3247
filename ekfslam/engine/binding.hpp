// What the files of the binding share: settings from dictionaries, arrays in and out.
#pragma once

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <atomic>

#include "filter.hpp"

namespace ekfslam {

// Adds what tests compare: SE(3), cameras, rows, corrections.
void bind_model(nanobind::module_& module);

}  // namespace ekfslam

namespace ekfslam::binding {

namespace nb = nanobind;

using Integers = Eigen::Matrix<std::int64_t, Eigen::Dynamic, 1>;

// The entry of a dictionary.
template <class T>
T get(const nb::dict& from, const char* key) {
    if (!from.contains(key)) throw nb::key_error(key);
    return nb::cast<T>(from[key]);
}

template <class T>
std::vector<T> listed(const Eigen::Matrix<T, Eigen::Dynamic, 1>& values) {
    return {values.data(), values.data() + values.size()};
}
inline Ids ids_of(const Integers& values) { return listed<std::int64_t>(values); }
Slots slots_of(const Integers& values, Index count);  // checked: from 0 to count - 1

// Adds `Filter` to the module, and its predictions.
void bind_filter(nb::module_& module);
struct Shared;
void bind_process(nb::class_<Shared>& bound);

// Throws ValueError that names the array.
void require_shape(const char* name, const Eigen::Ref<const Matrix>& found, Index rows, Index columns);
void require_finite(const char* name, const Eigen::Ref<const Matrix>& found);
void require_covariance(const Eigen::Ref<const Matrix>& P);

// The filter of Python: one call at a time, and a call that fails leaves it as it was.
struct Shared {
    Filter filter;
    mutable std::atomic<bool> is_busy{false};

    explicit Shared(Filter made) : filter(std::move(made)) {}
};

// Raises `FilterError`: the filter is in use by another thread.
[[noreturn]] void refuse();

class Hold {
   public:
    explicit Hold(const Shared& shared) : shared_(shared) {
        if (shared.is_busy.exchange(true)) refuse();
    }
    ~Hold() { shared_.is_busy = false; }
    Hold(const Hold&) = delete;
    Hold& operator=(const Hold&) = delete;

   private:
    const Shared& shared_;
};

// A verb of Python that reads the filter.
template <class Result, class... Arguments>
auto reading(Result (*verb)(const Filter&, Arguments...)) {
    return [verb](const Shared& shared, Arguments... arguments) -> Result {
        const Hold hold(shared);
        return verb(shared.filter, std::forward<Arguments>(arguments)...);
    };
}

// The filter, unless landmarks were revived and not adopted: then its table and its covariance do not fit.
template <class Some>
Some& whole(Some& filter) {
    if (filter.e.table.size() == filter.e.gaussian.landmarks()) return filter;
    throw nb::value_error("landmarks were revived: adopt must follow");
}

// Raises `InnovationError` for landmarks of the table.
[[noreturn]] void raise_innovation_error(const Filter& filter, Index frame, const Error& error);

// Calls a function of the filter that may find an innovation covariance without an inverse.
template <class Function>
auto guarded(const Filter& filter, Index frame, Function&& function) {
    try {
        return function();
    } catch (const Error& error) {
        raise_innovation_error(filter, frame, error);
    }
}

// A verb that changes the filter, or fails and leaves it as it was.
template <class Result, class... Arguments>
auto changing(Result (*verb)(Filter&, Arguments...)) {
    return [verb](Shared& shared, Arguments... arguments) -> Result {
        const Hold hold(shared);
        Filter& filter = shared.filter;
        Filter::State before = filter.state();
        try {
            return verb(filter, std::forward<Arguments>(arguments)...);
        } catch (...) {
            filter.restore(std::move(before));
            throw;
        }
    };
}

// Arrays for Python, which own their numbers: a vector, whole numbers, and a matrix whose columns become rows.
nb::object array(Vector values);
nb::object array(Ids values);
nb::object rows(Matrix values);
nb::object blocks(const std::vector<Matrix3>& values);  // (k, 3, 3), symmetric

nb::dict table_of(const Table& table);
Table table_from(const nb::dict& from, Index dimension);
// Tuples for ekfslam/engine/report.py. None: no landmark has retired.
nb::object report_of(const Report& report, const Filter& filter);
nb::object retired_of(const Retired& retired);

}  // namespace ekfslam::binding
