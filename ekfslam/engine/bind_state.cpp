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

struct Column {
    const char* name;
    Ids Table::* values;
};
struct Block {
    const char* name;
    Matrix Table::* values;
};
constexpr Column COLUMNS[] = {
    {"id", &Table::id},
    {"first_frame", &Table::first_frame},
    {"last_frame", &Table::last_frame},
    {"observations", &Table::observations},
    {"misses", &Table::misses},
    {"log_row", &Table::log_row},
    {"stay_until", &Table::stay_until},
    {"first_step", &Table::first_step},
    {"last_step", &Table::last_step},
    {"last_observation", &Table::last_observation},
    {"asleep", &Table::asleep},
};
constexpr Block BLOCKS[] = {
    {"position_m", &Table::position_m},
    {"initial_m", &Table::initial_m},
    {"evidence", &Table::evidence},
    {"seen_rows", &Table::seen_rows},
};

}  // namespace

Slots slots_of(const Integers& values, Index count) {
    for (const std::int64_t slot : values)
        if (slot < 0 || slot >= count) throw nb::index_error("a slot is not in the table");
    return {values.data(), values.data() + values.size()};
}

void require_shape(const char* name, const Eigen::Ref<const Matrix>& found, Index rows, Index columns) {
    if (found.rows() == rows && found.cols() == columns) return;
    const std::string wanted = std::to_string(rows) + ", " + std::to_string(columns);
    const std::string has = std::to_string(found.rows()) + ", " + std::to_string(found.cols());
    throw nb::value_error((std::string(name) + " must have the shape (" + wanted + "), found (" + has + ")").c_str());
}

void require_finite(const char* name, const Eigen::Ref<const Matrix>& found) {
    if (!found.allFinite()) throw nb::value_error((std::string(name) + " must be finite").c_str());
}

void require_covariance(const Eigen::Ref<const Matrix>& P) {
    require_finite("P", P);
    if ((P.diagonal().array() < 0.0).any()) throw nb::value_error("P must have no negative variance");
}

nb::object array(Vector values) {
    const auto size = static_cast<std::size_t>(values.size());
    return owned(std::move(values), {size});
}

nb::object array(Ids values) {
    const std::size_t size = values.size();
    return owned(std::move(values), {size});
}

nb::object rows(Matrix values) {
    const auto columns = static_cast<std::size_t>(values.cols()), rows = static_cast<std::size_t>(values.rows());
    return owned(std::move(values), {columns, rows});
}

nb::object blocks(const std::vector<Matrix3>& values) {
    std::vector<double> flat;
    flat.reserve(9 * values.size());
    for (const Matrix3& block : values) flat.insert(flat.end(), block.data(), block.data() + 9);
    const std::size_t count = values.size();
    return owned(std::move(flat), {count, 3, 3});
}

nb::dict table_of(const Table& table) {
    nb::dict out;
    for (const Column& column : COLUMNS) out[column.name] = array(table.*column.values);
    for (const Block& block : BLOCKS) out[block.name] = rows(table.*block.values);
    return out;
}

Table table_from(const nb::dict& from, Index dimension) {
    Table table;
    for (const Column& column : COLUMNS) table.*column.values = ids_of(get<Integers>(from, column.name));
    const Index count = table.size(), heights[] = {3, 3, 2, dimension};
    for (const Column& column : COLUMNS)
        if (static_cast<Index>((table.*column.values).size()) != count)
            throw nb::value_error((std::string(column.name) + " must have one number a landmark").c_str());
    for (std::size_t i = 0; i < 4; ++i) {
        const Matrix given = get<Matrix>(from, BLOCKS[i].name);
        require_shape(BLOCKS[i].name, given, count, heights[i]);
        table.*BLOCKS[i].values = given.transpose();
    }
    return table;
}

nb::object retired_of(const Retired& retired) {
    if (retired.table.size() == 0) return nb::none();
    nb::dict out;
    out["table"] = table_of(retired.table);
    out["covariance"] = blocks(retired.covariance);
    out["may_return"] = retired.may_return;
    return out;
}

nb::dict report_of(Report report, const Filter& filter) {
    nb::dict out, taken, begun, innovations;
    nb::list retired;
    for (const Retired& part : report.retired)
        if (part.table.size() > 0) retired.append(retired_of(part));
    out["retired"] = retired;
    out["reason"] = array(Ids(report.reason.begin(), report.reason.end()));
    out["nis"] = report.nis;
    out["log_det"] = report.log_det;
    out["dof"] = report.dof;
    out["doubt"] = report.doubt;
    out["split"] = array(std::move(report.split));
    out["moving"] = array(std::move(report.moving));
    innovations["landmark"] = array(std::move(report.innovations.landmark));
    innovations["alone"] = rows(std::move(report.innovations.alone));
    innovations["apart"] = rows(std::move(report.innovations.apart));
    innovations["score"] = array(report.innovations.score);
    innovations["information"] = rows(report.innovations.information);
    out["innovations"] = innovations;
    taken["landmark"] = array(std::move(report.taken.landmark));
    taken["previous"] = array(std::move(report.taken.previous));
    taken["rows"] = rows(std::move(report.taken.rows));
    taken["variance"] = rows(std::move(report.taken.variance));
    taken["position_m"] = rows(std::move(report.taken.position_m));
    taken["values"] = array(std::move(report.taken.values));
    taken["coordinates"] = array(std::move(report.taken.coordinates));
    taken["imu_twist"] = array(report.taken.imu_twist);
    out["taken"] = taken;
    out["updated_values"] = array(std::move(report.updated_values));
    out["updated_coordinates"] = array(std::move(report.updated_coordinates));
    begun["ids"] = array(std::move(report.begun.ids));
    begun["position_m"] = rows(std::move(report.begun.position_m));
    begun["rows"] = rows(std::move(report.begun.rows));
    begun["variance"] = rows(std::move(report.begun.variance));
    begun["step_before"] = report.begun.step_before;
    begun["rows_before"] = rows(std::move(report.begun.rows_before));
    out["begun"] = begun;
    out["values"] = array(filter.e.values.flat);
    out["coordinates"] = array(filter.e.coordinates);
    out["imu_twist"] = array(filter.e.imu_twist);
    return out;
}

}  // namespace ekfslam::binding
