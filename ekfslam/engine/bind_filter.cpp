// `Filter` for Python: made from plain data, predicted by Python, updated in C++ with the GIL released.
#include <unordered_set>

#include "binding.hpp"
#include "model.hpp"
#include "retraction.hpp"

namespace ekfslam::binding {

namespace {

using nb::arg;

Kind kind_of(const std::string& name) {
    const std::pair<const char*, Kind> kinds[] = {{"vector", Kind::vector},
                                                  {"pose", Kind::pose},
                                                  {"direction", Kind::direction},
                                                  {"calibration", Kind::calibration}};
    for (const auto& [known, kind] : kinds)
        if (name == known) return kind;
    throw nb::value_error(("unknown kind of a block: " + name).c_str());
}

std::vector<Block> blocks_of(const nb::list& given) {
    std::vector<Block> blocks;
    for (const nb::handle item : given) {
        const nb::dict from = nb::cast<nb::dict>(item);
        Block block;
        block.name = get<std::string>(from, "name");
        block.kind = kind_of(get<std::string>(from, "kind"));
        block.at = get<Index>(from, "at");
        block.size = get<Index>(from, "size");
        block.value_at = get<Index>(from, "value_at");
        block.value_size = get<Index>(from, "value_size");
        block.moves_camera = get<bool>(from, "moves_camera");
        block.free = get<std::vector<Index>>(from, "free");
        blocks.push_back(block);
    }
    return blocks;
}

constexpr Index MOST_CONSIDERED = 10000;

void require_range(const std::string& name, Index first, Index size, Index count) {
    if (first >= 0 && size >= 0 && first <= count && size <= count - first) return;
    throw nb::value_error((name + " must be among " + std::to_string(count)).c_str());
}

// Blocks whose columns and values are those of a state.
void require_places(const std::vector<Block>& blocks, Index body, Index values) {
    for (const Block& block : blocks) {
        require_range("columns of block " + block.name, block.at, block.size, body);
        require_range("values of block " + block.name, block.value_at, block.value_size, values);
        for (const Index parameter : block.free) require_range("free parameters", parameter, 1, block.value_size);
    }
}

Sensor sensor_of(const nb::dict& from) {
    Sensor sensor;
    sensor.type = get<bool>(from, "is_monocular") ? Sensor::monocular : Sensor::rig;
    sensor.fu_px = get<double>(from, "fu_px");
    sensor.fv_px = get<double>(from, "fv_px");
    sensor.cu_px = get<double>(from, "cu_px");
    sensor.cv_px = get<double>(from, "cv_px");
    sensor.baseline_m = get<double>(from, "baseline_m");
    sensor.disparity_offset_px = get<double>(from, "disparity_offset_px");
    sensor.least_disparity_px = get<double>(from, "least_disparity_px");
    sensor.sees_disparity = get<bool>(from, "sees_disparity");
    sensor.weight_left = get<double>(from, "weight_left");
    sensor.T_cam_imu = get<Matrix4>(from, "T_cam_imu");
    sensor.variance_px2 = get<Vector3>(from, "variance_px2");
    sensor.parallax_rad = get<double>(from, "parallax_rad");
    sensor.patience = get<Index>(from, "patience");
    return sensor;
}

std::optional<TrackError> track_error_of(const nb::object& given) {
    if (given.is_none()) return std::nullopt;
    const nb::dict from = nb::cast<nb::dict>(given);
    TrackError error;
    error.first_std = get<Vector3>(from, "first_std");
    error.walk_std = get<Vector3>(from, "walk_std");
    error.flow_px = get<double>(from, "flow_px");
    error.parallax = get<double>(from, "parallax");
    return error;
}

Config config_of(const nb::dict& from) {
    Config config;
    config.variant = get<bool>(from, "is_invariant") ? Variant::invariant : Variant::standard;
    config.image_coordinates = get<bool>(from, "image_coordinates");
    config.gate = get<double>(from, "gate");
    config.gate_probability = get<double>(from, "gate_probability");
    config.waiting_gate = get<double>(from, "waiting_gate");
    config.min_depth_m = get<double>(from, "min_depth_m");
    config.moving_sigma = get<double>(from, "moving_sigma");
    config.moving_share = get<double>(from, "moving_share");
    config.estimates_velocity = get<bool>(from, "estimates_velocity");
    config.retire_after = get<Index>(from, "retire_after");
    config.misses_to_split = get<Index>(from, "misses_to_split");
    config.dormant = get<Index>(from, "dormant");
    config.input_gate = get<double>(from, "input_gate");
    config.doubt = get<double>(from, "doubt");
    return config;
}

// Samples of the consensus are those of NumPy's generator.
Matrix uniform(Index frame, Index rows, Index columns) {
    const nb::gil_scoped_acquire held;
    const nb::object generator = nb::module_::import_("numpy.random").attr("default_rng")(frame);
    return nb::cast<Matrix>(generator.attr("random")(nb::make_tuple(rows, columns)));
}

[[noreturn]] void raise_innovation_error(Index frame, const Ids& ids) {
    const nb::object type = nb::module_::import_("ekfslam.errors").attr("InnovationError");
    const nb::object error = type(frame, array(ids).attr("tolist")());
    PyErr_SetObject(type.ptr(), error.ptr());
    throw nb::python_error();
}

// Calls a function of the filter that may find an innovation covariance without an inverse.
template <class Function>
auto guarded(const Filter& filter, Index frame, Function&& function) {
    try {
        return function();
    } catch (const Error& error) {
        Ids ids;
        for (const Index slot : error.slots)
            if (slot < filter.e.table.size()) ids.push_back(filter.e.table.id[static_cast<std::size_t>(slot)]);
        raise_innovation_error(frame, ids);
    }
}

// Shares (2, b) of the blocks that move the camera, of single observations and of differences.
void set_shares(Estimate& e, const Matrix& shares) {
    Index camera = 0;
    for (const Block& block : e.blocks) camera += block.moves_camera;
    require_shape("shares", shares, 2, camera);
    camera = 0;
    for (Block& block : e.blocks) {
        if (!block.moves_camera) continue;
        block.share = shares(0, camera);
        block.share_of_difference = shares(1, camera++);
    }
}

Filter make(const nb::list& blocks, const nb::dict& sensor, const nb::object& track_error, const nb::dict& config,
            const Vector& values, const Vector& coordinates, const Matrix& P, const Matrix& shares) {
    const std::vector<Block> parts = blocks_of(blocks);
    Index body = 0, size = 0;
    for (const Block& block : parts) {
        body += block.size;
        size += block.value_size;
    }
    require_places(parts, body, size);
    require_shape("values", values, size, 1);
    require_shape("coordinates", coordinates, body, 1);
    require_shape("P", P, body, body);
    require_finite("values", values);
    require_covariance(P);
    Filter filter(
        Estimate(config_of(config), sensor_of(sensor), track_error_of(track_error), parts, values, coordinates, P));
    filter.uniform = &uniform;
    set_shares(filter.e, shares);
    open_views(filter.e);
    return filter;
}

void set_mean(Filter& filter, const Vector& values, const Vector& coordinates) {
    require_shape("values", values, filter.e.values.flat.size(), 1);
    require_shape("coordinates", coordinates, filter.e.coordinates.size(), 1);
    filter.e.values.flat = values;
    filter.e.coordinates = coordinates;
}

void propagate(Filter& filter, const Matrix& Phi, const Matrix& Q) {
    const Index body = filter.e.columns.body;
    require_shape("Phi", Phi, body, body);
    require_shape("Q", Q, body, body);
    if (filter.e.is_open) close_views(filter.e);
    filter.e.gaussian.propagate(Phi, Q);
}

// Condition on measurements of blocks during a prediction, eq. (6) and (7').
nb::tuple measure(Filter& filter, const Vector& values, const Vector& coordinates, const Matrix& H,
                  const Vector& residual, const Vector& variance) {
    Estimate& e = filter.e;
    require_shape("H", H, residual.size(), e.columns.body);
    require_shape("variance", variance, residual.size(), 1);
    if (e.is_open) close_views(e);
    set_mean(filter, values, coordinates);
    return guarded(filter, e.step + 1, [&] {
        const Solution solution = e.gaussian.solve_body(H, residual, variance);
        const Vector correction = e.gaussian.correction(solution);
        e.gaussian.apply(solution);
        retract(e, correction);
        return nb::make_tuple(array(e.values.flat), array(e.coordinates), solution.nis, solution.log_det);
    });
}

nb::tuple mean_of(const Filter& filter) {
    return nb::make_tuple(array(filter.e.values.flat), array(filter.e.coordinates));
}

// Arrive at the next frame: the covariance follows Phi and Q, the mean is that of Python, and the view opens.
// `numbers` are tau_s, way_m and doubt; `last` is the motion of the interval before and its duration, or None.
nb::tuple arrive(Filter& filter, const Vector& values, const Vector& coordinates, const Vector6& imu_twist,
                 const Matrix& Phi, const Matrix& Q, const Matrix4& T_departed, const Matrix4& T_predicted,
                 const Matrix& noise, const std::tuple<double, double, double>& numbers,
                 const std::optional<std::pair<Matrix4, double>>& last, const Matrix& shares) {
    Estimate& e = filter.e;
    require_shape("noise", noise, e.columns.body, e.columns.body);
    propagate(filter, Phi, Q);
    set_mean(filter, values, coordinates);
    e.imu_twist = imu_twist;
    e.motion.T_departed = T_departed;
    e.motion.T_predicted = T_predicted;
    e.motion.Q = noise;
    std::tie(e.motion.tau_s, e.motion.way_m, e.motion.doubt) = numbers;
    e.motion.has_last = last.has_value();
    if (last) std::tie(e.motion.moved_last, e.motion.tau_last_s) = *last;
    set_shares(e, shares);
    ++e.step;
    open_views(e);
    return mean_of(filter);
}

nb::tuple look_again(Filter& filter, const Vector6& imu_twist) {
    filter.e.imu_twist = imu_twist;
    open_views(filter.e);
    return mean_of(filter);
}

nb::dict update(Filter& filter, Index frame, const Integers& ids, const Matrix& measured, bool is_rested,
                const nb::object& twist_after) {
    const Ids seen = ids_of(ids);
    const Matrix columns = measured.transpose();
    if (std::unordered_set<std::int64_t>(seen.begin(), seen.end()).size() != seen.size())
        throw nb::value_error("ids must be distinct");
    if (columns.cols() != static_cast<Index>(seen.size()) ||
        columns.rows() < (filter.e.sensor.type == Sensor::rig ? 4 : 2))
        throw nb::value_error("measured must have one row of pixels for each id");
    filter.e.twist_after = [&](const Values& after) {
        const nb::gil_scoped_acquire held;
        if (twist_after.is_none()) throw nb::value_error("twist_after must be a function for a time offset");
        return nb::cast<Vector6>(twist_after(array(after.flat)));
    };
    struct Reset {
        Estimate& e;
        ~Reset() { e.twist_after = nullptr; }
    } reset{filter.e};
    return report_of(guarded(filter, frame,
                             [&] {
                                 const nb::gil_scoped_release released;
                                 return is_rested ? filter.take(frame, seen, columns)
                                                  : filter.update(frame, seen, columns);
                             }),
                     filter);
}

nb::tuple adopt(Filter& filter, const Vector& values, const Vector& coordinates, const Matrix& position_m,
                const Matrix& P) {
    const Index body = filter.e.columns.body, count = filter.e.table.size();
    require_shape("values", values, filter.e.values.flat.size(), 1);
    require_shape("coordinates", coordinates, body, 1);
    require_shape("position_m", position_m, count, 3);
    require_shape("P", P, body + 3 * count, body + 3 * count);
    require_covariance(P);
    filter.adopt(values, coordinates, position_m.transpose(), P);
    return mean_of(filter);
}

Slots all(const Filter& filter) {
    Slots slots(static_cast<std::size_t>(filter.e.table.size()));
    for (std::size_t i = 0; i < slots.size(); ++i) slots[i] = static_cast<Index>(i);
    return slots;
}

void bind_reading(nb::class_<Filter>& bound) {
    bound.def("values", [](const Filter& filter) { return array(filter.e.values.flat); })
        .def("table", [](const Filter& filter) { return table_of(filter.e.table); })
        .def("landmarks", [](const Filter& filter) { return filter.e.table.size(); })
        .def("considered", [](const Filter& filter) { return filter.e.gaussian.considered(); })
        .def("body_covariance", [](const Filter& filter) { return rows(filter.e.gaussian.body_covariance()); })
        .def("covariance", [](const Filter& filter) { return rows(filter.e.gaussian.covariance_of(all(filter))); })
        .def(
            "covariance_of",
            [](const Filter& filter, const Integers& slots) {
                return rows(filter.e.gaussian.covariance_of(slots_of(slots, filter.e.table.size())));
            },
            arg("slots"))
        .def("landmark_blocks",
             [](const Filter& filter) { return blocks(filter.e.gaussian.landmark_blocks(all(filter))); })
        .def(
            "landmark_blocks_of",
            [](const Filter& filter, const Integers& slots) {
                return blocks(filter.e.gaussian.landmark_blocks(slots_of(slots, filter.e.table.size())));
            },
            arg("slots"))
        .def(
            "consider",
            [](Filter& filter, Index columns) {
                require_range("considered columns", 0, columns, MOST_CONSIDERED);
                return filter.e.gaussian.consider(columns);
            },
            arg("columns"))
        .def(
            "clone",
            [](Filter& filter, Index source, Index size, Index to) {
                const Index body = filter.e.columns.body;
                require_range("columns of blocks", source, size, body);
                require_range("considered columns", to - body, size, filter.e.gaussian.considered());
                filter.e.gaussian.clone(source, size, to);
            },
            arg("source"), arg("size"), arg("to"));
}

}  // namespace

void bind_filter(nb::module_& module) {
    nb::class_<Filter> bound(module, "Filter", "The joint filter; predictions may come from Python.");
    bound
        .def(
            "__init__",
            [](Filter* self, const nb::list& blocks, const nb::dict& sensor, const nb::object& track_error,
               const nb::dict& config, const Vector& values, const Vector& coordinates, const Matrix& P,
               const Matrix& shares) {
                new (self) Filter(make(blocks, sensor, track_error, config, values, coordinates, P, shares));
            },
            arg("blocks"), arg("sensor"), arg("track_error").none(), arg("config"), arg("values"), arg("coordinates"),
            arg("P"), arg("shares"))
        .def("copy", [](const Filter& filter) { return Filter(filter); })
        .def("propagate", &propagate, arg("Phi"), arg("Q"))
        .def("measure", &measure, arg("values"), arg("coordinates"), arg("H"), arg("residual"), arg("variance"))
        .def("arrive", &arrive, arg("values"), arg("coordinates"), arg("imu_twist"), arg("Phi"), arg("Q"),
             arg("T_departed"), arg("T_predicted"), arg("noise"), arg("numbers"), arg("last").none(), arg("shares"))
        .def(
            "rest",
            [](Filter& filter, Index frame, const Integers& ids) {
                return retired_of(filter.rest(frame, ids_of(ids)));
            },
            arg("frame"), arg("ids"))
        .def("update", &update, arg("frame"), arg("ids"), arg("measured"), arg("is_rested"), arg("twist_after").none())
        .def(
            "revive",
            [](Filter& filter, const nb::dict& more) { filter.revive(table_from(more, filter.e.sensor.dimension())); },
            arg("more"))
        .def("adopt", &adopt, arg("values"), arg("coordinates"), arg("position_m"), arg("P"))
        .def("look_again", &look_again, arg("imu_twist"))
        .def(
            "replace",
            [](Filter& filter, const Matrix& P) {
                const Index size = filter.e.columns.body + filter.e.gaussian.considered() + 3 * filter.e.table.size();
                require_shape("P", P, size, size);
                require_covariance(P);
                filter.e.gaussian.replace(P);
            },
            arg("P"));
    bind_process(bound);
    bind_reading(bound);
}

}  // namespace ekfslam::binding
