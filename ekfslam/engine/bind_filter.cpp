// `Filter` for Python: made from plain data, predicted by Python, updated in C++ with the GIL released.
#include <cmath>
#include <unordered_set>

#include "binding.hpp"
#include "model.hpp"
#include "retraction.hpp"

namespace ekfslam::binding {

namespace {

Kind kind_of(const std::string& name) {
    const std::pair<const char*, Kind> kinds[] = {{"vector", Kind::vector},
                                                  {"pose", Kind::pose},
                                                  {"direction", Kind::direction},
                                                  {"calibration", Kind::calibration}};
    for (const auto& [known, kind] : kinds)
        if (name == known) return kind;
    throw nb::value_error(("unknown kind of a block: " + name).c_str());
}

using Numbers = std::vector<std::pair<const char*, double*>>;

std::vector<Block> blocks_of(const nb::list& given) {
    std::vector<Block> blocks;
    for (const nb::handle item : given) {
        const nb::dict from = nb::cast<nb::dict>(item);
        blocks.push_back({get<std::string>(from, "name"), kind_of(get<std::string>(from, "kind")),
                          get<Index>(from, "at"), get<Index>(from, "size"), get<Index>(from, "value_at"),
                          get<Index>(from, "value_size"), get<bool>(from, "moves_camera"), 0.0, 0.0,
                          get<Slots>(from, "free")});
    }
    return blocks;
}

constexpr Index MOST_COLUMNS = 10000;

// The value of a kind of block has so many numbers.
Index value_size(const Block& block) {
    return block.kind == Kind::pose ? 16 : block.kind == Kind::calibration ? 9 : block.size;
}

// Blocks that follow each other in columns and values, the pose first, each of the size of its kind.
void require_places(const std::vector<Block>& blocks) {
    require(!blocks.empty() && blocks[0].name == "pose", "the first block must be the pose");
    Index at = 0, value_at = 0;
    std::unordered_set<std::string> names;
    for (const Block& block : blocks) {
        const std::string named = "block " + block.name;
        require(names.insert(block.name).second, named + " is there twice");
        require(block.size >= 0 && block.size <= MOST_COLUMNS, named + " has an impossible size");
        require(block.at == at && block.value_at == value_at, named + " must follow the one before");
        require(block.value_size == value_size(block), named + " has a value of another size than its kind");
        const bool is_view = block.name == "view" || block.name == "previous_view" || block.name == "anchor";
        const bool is_pose = block.kind == Kind::pose;
        require(is_pose == (is_view || block.name == "pose"), named + " has the kind of another");
        require(!(is_pose || block.moves_camera) || block.size == 6, named + " must have six columns");
        require(!block.moves_camera || block.kind == Kind::vector, named + " must be a vector to move the camera");
        require(block.kind != Kind::direction || block.size == 3, named + " must have three columns");
        const bool is_calibration = block.kind == Kind::calibration;
        require(size_of(block.free) == (is_calibration ? block.size : 0),
                named + " must have one free parameter for each column");
        Index last = -1;
        for (const Index parameter : block.free) {
            require(parameter > last && parameter < 9, named + " has free parameters that do not ascend");
            last = parameter;
        }
        at += block.size;
        value_at += block.value_size;
    }
    require(names.count("view") || !(names.count("previous_view") || names.count("anchor")),
            "a view of the past needs one of the present");
}

Sensor sensor_of(const nb::dict& from) {
    Sensor sensor;
    sensor.type = get<bool>(from, "is_monocular") ? Sensor::monocular : Sensor::rig;
    const Numbers numbers = {{"fu_px", &sensor.fu_px},
                             {"fv_px", &sensor.fv_px},
                             {"cu_px", &sensor.cu_px},
                             {"cv_px", &sensor.cv_px},
                             {"baseline_m", &sensor.baseline_m},
                             {"disparity_offset_px", &sensor.disparity_offset_px},
                             {"least_disparity_px", &sensor.least_disparity_px},
                             {"weight_left", &sensor.weight_left},
                             {"parallax_rad", &sensor.parallax_rad}};
    for (const auto& [name, number] : numbers) {
        *number = get<double>(from, name);
        require(std::isfinite(*number), "numbers of the sensor must be finite");
    }
    sensor.sees_disparity = get<bool>(from, "sees_disparity");
    sensor.T_cam_imu = get<Matrix4>(from, "T_cam_imu");
    sensor.variance_px2 = get<Vector3>(from, "variance_px2");
    sensor.patience = whole_number("patience", get<Index>(from, "patience"));
    require_finite("T_cam_imu", sensor.T_cam_imu);
    require_finite("variance_px2", sensor.variance_px2);
    return sensor;
}

std::optional<TrackError> track_error_of(const nb::object& given) {
    if (given.is_none()) return std::nullopt;
    const nb::dict from = nb::cast<nb::dict>(given);
    const TrackError error{get<Vector3>(from, "first_std"), get<Vector3>(from, "walk_std"),
                           get<double>(from, "flow_px"), get<double>(from, "parallax")};
    require_finite("first_std", error.first_std);
    require_finite("walk_std", error.walk_std);
    return error;
}

Config config_of(const nb::dict& from) {
    Config config;
    config.variant = get<bool>(from, "is_invariant") ? Variant::invariant : Variant::standard;
    config.image_coordinates = get<bool>(from, "image_coordinates");
    const Numbers numbers = {{"gate", &config.gate},
                             {"gate_probability", &config.gate_probability},
                             {"waiting_gate", &config.waiting_gate},
                             {"min_depth_m", &config.min_depth_m},
                             {"moving_sigma", &config.moving_sigma},
                             {"moving_share", &config.moving_share},
                             {"input_gate", &config.input_gate},
                             {"doubt", &config.doubt}};
    for (const auto& [name, number] : numbers) {
        *number = get<double>(from, name);
        require(!std::isnan(*number), "numbers of the settings must not be NaN");
    }
    config.estimates_velocity = get<bool>(from, "estimates_velocity");
    config.retire_after = whole_number("retire_after", get<Index>(from, "retire_after"));
    config.misses_to_split = whole_number("misses_to_split", get<Index>(from, "misses_to_split"));
    config.dormant = whole_number("dormant", get<Index>(from, "dormant"));
    return config;
}

// Samples of the consensus are those of NumPy's generator.
Matrix uniform(Index frame, Index rows, Index columns) {
    const nb::gil_scoped_acquire held;
    const nb::object generator = nb::module_::import_("numpy.random").attr("default_rng")(frame);
    return nb::cast<Matrix>(generator.attr("random")(nb::make_tuple(rows, columns)));
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
    require_places(parts);
    Index body = 0, size = 0;
    for (const Block& block : parts) {
        body += block.size;
        size += block.value_size;
    }
    require_vector("values", values, size);
    require_vector("coordinates", coordinates, body);
    require_finite("shares", shares);
    require_covariance(P, body);
    Filter filter(
        Estimate(config_of(config), sensor_of(sensor), track_error_of(track_error), parts, values, coordinates, P));
    filter.uniform = &uniform;
    set_shares(filter.e, shares);
    open_views(filter.e);
    return filter;
}

void set_mean(Filter& filter, const Vector& values, const Vector& coordinates) {
    require_vector("values", values, filter.e.values.flat.size());
    require_vector("coordinates", coordinates, filter.e.coordinates.size());
    filter.e.values.flat = values;
    filter.e.coordinates = coordinates;
}

void propagate(Filter& filter, const Matrix& Phi, const Matrix& Q) {
    const Index body = filter.e.columns.body;
    require_shape("Phi", Phi, body, body);
    require_shape("Q", Q, body, body);
    require_finite("Phi", Phi);
    require_finite("Q", Q);
    if (filter.e.is_open) close_views(filter.e);
    filter.e.gaussian.propagate(Phi, Q);
}

// Condition on measurements of blocks during a prediction, eq. (6) and (7').
nb::tuple measure(Filter& filter, const Vector& values, const Vector& coordinates, const Matrix& H,
                  const Vector& residual, const Vector& variance) {
    Estimate& e = whole(filter).e;
    require_shape("H", H, residual.size(), e.columns.body);
    require_shape("variance", variance, residual.size(), 1);
    require_finite("H", H);
    require_finite("residual", residual);
    require_finite("variance", variance);
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
    for (const Eigen::Ref<const Matrix>& one :
         {Eigen::Ref<const Matrix>(imu_twist), Eigen::Ref<const Matrix>(noise), Eigen::Ref<const Matrix>(T_departed),
          Eigen::Ref<const Matrix>(T_predicted)})
        require_finite("an array", one);
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
    require_finite("imu_twist", imu_twist);
    filter.e.imu_twist = imu_twist;
    open_views(filter.e);
    return mean_of(filter);
}

nb::object update(Filter& filter, Index frame, const Integers& ids, const Matrix& measured, bool is_rested,
                  const nb::object& twist_after) {
    whole(filter);
    whole_number("frame", frame);
    const Ids seen = ids_of(ids);
    const Matrix columns = measured.transpose();
    if (std::unordered_set<std::int64_t>(seen.begin(), seen.end()).size() != seen.size())
        throw nb::value_error("ids must be distinct");
    if (columns.cols() != size_of(seen) || columns.rows() < (filter.e.sensor.type == Sensor::rig ? 4 : 2))
        throw nb::value_error("measured must have one row of pixels for each id");
    require_finite("measured", columns);
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
    require_vector("values", values, filter.e.values.flat.size());
    require_vector("coordinates", coordinates, body);
    require_shape("position_m", position_m, count, 3);
    require_finite("position_m", position_m);
    require_covariance(P, body + 3 * count);
    filter.adopt(values, coordinates, position_m.transpose(), P);
    return mean_of(filter);
}

// Landmarks at some slots, checked, or all of them.
Slots slots_of(const Filter& filter, const std::optional<Integers>& given) {
    const Index count = whole(filter).e.table.size();
    if (!given) return range(0, count);
    for (const std::int64_t slot : *given)
        if (slot < 0 || slot >= count) throw nb::index_error("a slot is not in the table");
    return {given->data(), given->data() + given->size()};
}

void bind_reading(nb::class_<Shared>& bound) {
    bound.def("values", reading(+[](const Filter& filter) { return array(filter.e.values.flat); }))
        .def("table", reading(+[](const Filter& filter) { return table_of(filter.e.table); }))
        .def("landmarks", reading(+[](const Filter& filter) { return filter.e.table.size(); }))
        .def("considered", reading(+[](const Filter& filter) { return filter.e.gaussian.considered(); }))
        .def("body_covariance",
             reading(+[](const Filter& filter) { return rows(filter.e.gaussian.body_covariance()); }))
        .def("covariance", reading(+[](const Filter& filter, const std::optional<Integers>& slots) {
                 return rows(filter.e.gaussian.covariance_of(slots_of(filter, slots)));
             }),
             arg("slots") = nb::none())
        .def("landmark_blocks", reading(+[](const Filter& filter, const std::optional<Integers>& slots) {
                 return blocks(filter.e.gaussian.landmark_blocks(slots_of(filter, slots)));
             }),
             arg("slots") = nb::none())
        .def("consider", changing(+[](Filter& filter, Index columns) {
                 require_range("considered columns", 0, columns, MOST_CONSIDERED);
                 return filter.e.gaussian.consider(columns);
             }),
             arg("columns"))
        .def("clone", changing(+[](Filter& filter, Index source, Index size, Index to) {
                 const Index body = filter.e.columns.body;
                 require_range("columns of blocks", source, size, body);
                 require_range("considered columns", to - body, size, filter.e.gaussian.considered());
                 filter.e.gaussian.clone(source, size, to);
             }),
             arg("source"), arg("size"), arg("to"));
}

}  // namespace

void Shared::undo() {
    filter = *saved;
    for (const auto& again : since) again(filter);
}

void refuse() {
    const nb::object type = nb::module_::import_("ekfslam.errors").attr("FilterError");
    PyErr_SetString(type.ptr(), "the filter is in use by another thread");
    throw nb::python_error();
}

void raise_innovation_error(const Filter& filter, Index frame, const Error& error) {
    Ids ids;
    for (const Index slot : error.slots)
        if (slot < filter.e.table.size()) ids.push_back(filter.e.table.id[slot]);
    const nb::object type = nb::module_::import_("ekfslam.errors").attr("InnovationError");
    const nb::object raised = type(frame, array(ids).attr("tolist")());
    PyErr_SetObject(type.ptr(), raised.ptr());
    throw nb::python_error();
}

void bind_filter(nb::module_& module) {
    nb::class_<Shared> bound(module, "Filter", "The joint filter; predictions may come from Python.");
    bound
        .def(
            "__init__",
            [](Shared* self, const nb::list& blocks, const nb::dict& sensor, const nb::object& track_error,
               const nb::dict& config, const Vector& values, const Vector& coordinates, const Matrix& P,
               const Matrix& shares) {
                new (self) Shared(make(blocks, sensor, track_error, config, values, coordinates, P, shares));
            },
            arg("blocks"), arg("sensor"), arg("track_error").none(), arg("config"), arg("values"), arg("coordinates"),
            arg("P"), arg("shares"))
        .def("copy",
             [](const Shared& shared) {
                 const Hold hold(shared);
                 return std::make_unique<Shared>(shared.filter);
             })
        .def("propagate", changing(&propagate), arg("Phi"), arg("Q"))
        .def("measure", changing(&measure), arg("values"), arg("coordinates"), arg("H"), arg("residual"),
             arg("variance"))
        .def("arrive", changing(&arrive), arg("values"), arg("coordinates"), arg("imu_twist"), arg("Phi"), arg("Q"),
             arg("T_departed"), arg("T_predicted"), arg("noise"), arg("numbers"), arg("last").none(), arg("shares"))
        .def("rest", changing(+[](Filter& filter, Index frame, const Integers& ids) {
                 return retired_of(whole(filter).rest(whole_number("frame", frame), ids_of(ids)));
             }),
             arg("frame"), arg("ids"))
        .def("update", changing(&update), arg("frame"), arg("ids"), arg("measured"), arg("is_rested"),
             arg("twist_after").none())
        .def("revive", changing(+[](Filter& filter, const nb::dict& more) {
                 whole(filter).revive(table_from(more, filter.e.sensor.dimension()));
             }),
             arg("more"))
        .def("adopt", changing(&adopt), arg("values"), arg("coordinates"), arg("position_m"), arg("P"))
        .def("look_again", changing(&look_again), arg("imu_twist"))
        .def("replace", changing(+[](Filter& filter, const Matrix& P) {
                 const Index size = filter.e.columns.body + filter.e.gaussian.considered() + 3 * filter.e.table.size();
                 require_covariance(P, size);
                 filter.e.gaussian.replace(P);
             }),
             arg("P"));
    bind_process(bound);
    bind_reading(bound);
}

}  // namespace ekfslam::binding
