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
#include <functional>
#include <type_traits>

#include "filter.hpp"

namespace ekfslam::binding {

namespace nb = nanobind;

using nb::arg;
using Integers = Eigen::Matrix<std::int64_t, Eigen::Dynamic, 1>;

// `Filter`, and its predictions.
struct Shared;
void bind_filter(nb::module_& module);
void bind_process(nb::class_<Shared>& bound);

// The entry of a dictionary.
template <class T>
T get(const nb::dict& from, const char* key) {
    if (!from.contains(key)) throw nb::key_error(key);
    return nb::cast<T>(from[key]);
}

inline Ids ids_of(const Integers& values) { return {values.data(), values.data() + values.size()}; }

constexpr Index MOST_CONSIDERED = 10000;

// Throw ValueError in these words, or one that names the array.
void require(bool holds, const std::string& what);
// Numbers of frames, steps and landmarks: differences of two of them fit into 64 bits.
Index whole_number(const std::string& name, Index value);
void require_range(const std::string& name, Index first, Index size, Index count);
void require_shape(const char* name, const Eigen::Ref<const Matrix>& found, Index rows, Index columns);
void require_finite(const char* name, const Eigen::Ref<const Matrix>& found);
void require_vector(const char* name, const Vector& found, Index size);
void require_covariance(const Matrix& P, Index size);

// The filter of Python: one call at a time, and a call that fails leaves it as it was. A copy of the filter before each
// call would cost a twentieth of a frame, and far more with many dormant landmarks: one in a while has to do, and
// after a failure the calls since then are repeated.
struct Shared {
    Filter filter;
    std::optional<Filter> saved;
    std::vector<std::function<void(Filter&)>> since;
    std::size_t kept = 0;  // numbers in the arguments of these calls
    mutable std::atomic<bool> is_busy{false};

    explicit Shared(Filter made) : filter(std::move(made)) {}
    void undo();  // restores the filter as it was after the last call
    void forget() { saved.reset(), since.clear(), kept = 0; }
};

// Numbers that it takes to keep an argument of a call; an object of Python is not kept.
constexpr std::size_t MOST_KEPT = 64000;
template <class Argument>
std::size_t numbers_of(const Argument& argument) {
    if constexpr (std::is_base_of_v<nb::handle, Argument>)
        return argument.is_none() ? 0 : MOST_KEPT;
    else if constexpr (std::is_base_of_v<Eigen::EigenBase<Argument>, Argument>)
        return argument.size();
    return 0;
}

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
        if (!shared.saved) shared.saved = shared.filter;
        shared.kept += ((MOST_KEPT / 64) + ... + numbers_of(arguments));
        const bool is_kept = shared.kept < MOST_KEPT;
        std::function<void(Filter&)> again;
        if (is_kept) {
            again = [verb, some = std::tuple<std::decay_t<Arguments>...>(arguments...)](Filter& filter) {
                std::apply([&](const auto&... one) { verb(filter, one...); }, some);
            };
        }
        const auto keep = [&] { is_kept ? shared.since.push_back(std::move(again)) : shared.forget(); };
        try {
            if constexpr (std::is_void_v<Result>) {
                verb(shared.filter, std::forward<Arguments>(arguments)...);
                keep();
            } else {
                Result result = verb(shared.filter, std::forward<Arguments>(arguments)...);
                keep();
                return result;
            }
        } catch (...) {
            shared.undo();
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
