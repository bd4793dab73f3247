// What the files of the binding share: settings from dictionaries, arrays in and out.
#pragma once

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

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
nb::class_<Filter> bind_process(nb::class_<Filter> filter);

// Throws ValueError that names the array.
void require_shape(const char* name, const Eigen::Ref<const Matrix>& found, Index rows, Index columns);
void require_finite(const char* name, const Eigen::Ref<const Matrix>& found);
void require_covariance(const Eigen::Ref<const Matrix>& P);

// Arrays for Python, which own their numbers: a vector, whole numbers, and a matrix whose columns become rows.
nb::object array(Vector values);
nb::object array(Ids values);
nb::object rows(Matrix values);
nb::object blocks(const std::vector<Matrix3>& values);  // (k, 3, 3), symmetric

nb::dict table_of(const Table& table);
Table table_from(const nb::dict& from, Index dimension);
nb::dict report_of(Report report, const Filter& filter);
nb::object retired_of(const Retired& retired);  // None: there is none

}  // namespace ekfslam::binding
