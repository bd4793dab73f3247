// Tables, reports and plain arrays between C++ and Python.
#include "binding.hpp"

namespace ekfslam::binding {

namespace {

template <class T>
nb::object owned(T values, std::initializer_list<std::size_t> shape) {
    using Scalar = typename T::value_type;
    auto* kept = new T(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<T*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, Scalar>(kept->data(), shape, owner));
}

}  // namespace

void require(bool holds, const std::string& what) {
    if (!holds) throw nb::value_error(what.c_str());
}

Index whole_number(const std::string& name, Index value) {
    constexpr Index largest = Index{1} << 60;
    require(value >= -largest && value <= largest, name + " must be at most 2^60");
    return value;
}

void require_range(const std::string& name, Index first, Index size, Index count) {
    require(first >= 0 && size >= 0 && first <= count && size <= count - first,
            name + " must be among " + std::to_string(count));
}

void require_shape(const char* name, const Eigen::Ref<const Matrix>& found, Index rows, Index columns) {
    if (found.rows() == rows && found.cols() == columns) return;
    const auto of = [](Index r, Index c) { return "(" + std::to_string(r) + ", " + std::to_string(c) + ")"; };
    require(false, std::string(name) + " must have the shape " + of(rows, columns) + ", found " +
                       of(found.rows(), found.cols()));
}

void require_finite(const char* name, const Eigen::Ref<const Matrix>& found) {
    require(found.allFinite(), std::string(name) + " must be finite");
}

void require_vector(const char* name, const Vector& found, Index size) {
    require_shape(name, found, size, 1);
    require_finite(name, found);
}

void require_covariance(const Matrix& P, Index size) {
    require_shape("P", P, size, size);
    require_finite("P", P);
    require(!(P.diagonal().array() < 0.0).any(), "P must have no negative variance");
}

nb::object array(Vector values) {
    const std::size_t size = values.size();
    return owned(std::move(values), {size});
}

nb::object array(Ids values) {
    const std::size_t size = values.size();
    return owned(std::move(values), {size});
}

nb::object rows(Matrix values) {
    const std::size_t columns = values.cols(), rows = values.rows();
    return owned(std::move(values), {columns, rows});
}

nb::object blocks(const std::vector<Matrix3>& values) {
    std::vector<double> flat;
    flat.reserve(9 * values.size());
    for (const Matrix3& block : values) flat.insert(flat.end(), block.data(), block.data() + 9);
    return owned(std::move(flat), {values.size(), 3, 3});
}

nb::dict table_of(const Table& table) {
    nb::dict out;
    for (const auto& column : WHOLE) out[column.name] = array(table.*column.values);
    for (const auto& column : REAL) out[column.name] = rows(table.*column.values);
    return out;
}

Table table_from(const nb::dict& from, Index dimension) {
    Table table;
    for (const auto& column : WHOLE) {
        table.*column.values = ids_of(get<Integers>(from, column.name));
        require(size_of(table.*column.values) == table.size(),
                std::string(column.name) + " must have one number a landmark");
        for (const std::int64_t value : table.*column.values)
            if (column.values != &Table::id) whole_number(column.name, value);
    }
    for (const auto& column : REAL) {
        const Matrix given = get<Matrix>(from, column.name);
        require_shape(column.name, given, table.size(), column.height ? column.height : dimension);
        table.*column.values = given.transpose();
    }
    return table;
}

namespace {

// Numbers of a report one after another: two arrays cross the border in place of fifty. Their order is that of
// ekfslam/engine/report.py.
struct Packed {
    Ids whole;
    std::vector<double> real;

    template <class Values>
    void add_whole(const Values& values) {
        whole.insert(whole.end(), values.begin(), values.end());
    }
    void add(const Eigen::Ref<const Matrix>& values) {
        for (Index j = 0; j < values.cols(); ++j)
            real.insert(real.end(), values.col(j).data(), values.col(j).data() + values.rows());
    }
    // Matrices with one column a landmark, side by side: their numbers for each landmark follow each other.
    void add_beside(std::initializer_list<const Matrix*> parts) {
        for (Index j = 0; j < (*parts.begin())->cols(); ++j)
            for (const Matrix* part : parts)
                real.insert(real.end(), part->col(j).data(), part->col(j).data() + part->rows());
    }
    // Returns the number of landmarks, and whether they may return.
    nb::tuple add(const Retired& retired) {
        const Table& table = retired.table;
        for (auto column : {&Table::id, &Table::first_frame, &Table::last_frame, &Table::observations, &Table::log_row,
                            &Table::misses})
            add_whole(table.*column);
        add_beside({&table.position_m, &table.initial_m, &table.evidence});
        for (const Matrix3& covariance : retired.covariance) add(covariance);
        return nb::make_tuple(table.size(), retired.may_return);
    }
    nb::tuple arrays() {
        const std::size_t count = real.size();
        return nb::make_tuple(array(std::move(whole)), owned(std::move(real), {count}));
    }
};

}  // namespace

nb::object retired_of(const Retired& retired) {
    if (retired.table.size() == 0) return nb::none();
    Packed packed;
    const nb::tuple part = packed.add(retired);
    return nb::make_tuple(packed.arrays(), part);
}

nb::object report_of(const Report& report, const Filter& filter) {
    const Taken& taken = report.taken;
    const Started& begun = report.begun;
    const FrameInnovations& innovations = report.innovations;
    const auto count = size_of(begun.ids);
    Packed packed;
    for (const Ids* ids : {&report.split, &report.moving, &begun.ids, &innovations.landmark}) packed.add_whole(*ids);
    packed.add_whole(report.reason);
    packed.add_whole(taken.landmark);
    for (std::int64_t i = 0; i < count; ++i) packed.whole.push_back(filter.next_landmark - count + i);
    packed.add_whole(taken.previous);
    packed.whole.insert(packed.whole.end(), begun.ids.size(), -1);
    for (const Vector* values : {&filter.e.values.flat, &report.updated_values, &taken.values}) packed.add(*values);
    for (const Vector* values : {&filter.e.coordinates, &report.updated_coordinates, &taken.coordinates})
        packed.add(*values);
    packed.add(filter.e.imu_twist);
    packed.add(taken.imu_twist);
    packed.add_beside({&taken.rows, &taken.variance, &taken.position_m});
    if (count) packed.add_beside({&begun.rows, &begun.variance, &begun.position_m});
    if (begun.step_before >= 0) packed.add_beside({&begun.rows_before, &begun.variance_before});
    packed.add(innovations.score);
    packed.add(innovations.information);
    packed.add_beside({&innovations.alone, &innovations.apart});
    nb::list retired;
    for (const Retired& part : report.retired)
        if (part.table.size() > 0) retired.append(packed.add(part));
    const nb::tuple counts = nb::make_tuple(report.split.size(), report.moving.size(), begun.ids.size(),
                                            innovations.landmark.size(), report.reason.size(), taken.landmark.size());
    return nb::make_tuple(packed.arrays(), counts, retired, begun.step_before, report.nis, report.log_det, report.dof,
                          report.doubt);
}

}  // namespace ekfslam::binding
