// The prediction by velocities for Python: laws of blocks from plain data.
#include <cmath>

#include "binding.hpp"

namespace ekfslam::binding {

namespace {

void require_vector(const Block& block) {
    require(block.kind == Kind::vector && block.value_size == block.size, "block " + block.name + " must be a vector");
}

Law law_of(const nb::dict& from, const Block& block) {
    Law law;
    const std::string transition = get<std::string>(from, "transition");
    law.transition = transition == "gauss_markov" ? Law::gauss_markov : transition == "walk" ? Law::walk : Law::stays;
    law.turns = get<std::string>(from, "turn_velocities") == "up";
    const std::string share = get<std::string>(from, "camera_share");
    law.share = share == "one" ? Law::one : share == "way" ? Law::way : Law::none;
    law.offset = get<Matrix>(from, "offset");
    if (law.offset.cols() != 0) require_shape("offset", law.offset, 6, block.size);
    require(!law.turns || block.kind == Kind::direction, "only a direction turns velocities");
    if (law.transition == Law::stays) return law;
    require_vector(block);
    law.std = get<Vector>(from, "std");
    require_shape("std", law.std, block.size, 1);
    if (law.transition == Law::walk) return law;
    law.time_s = get<Vector>(from, "time_s");
    law.length_m = get<Vector>(from, "length_m");
    law.least_way_m = get<double>(from, "least_way_m");
    for (const Vector* one : {&law.time_s, &law.length_m}) require_shape("scales", *one, block.size, 1);
    return law;
}

Place place_of(const Filter& filter, const char* name, Index size) {
    const Block* block = filter.e.block(name);
    require(block && block->size == size, std::string(name) + " is no block of it");
    require_vector(*block);
    return {block->at, block->value_at};
}

Velocities velocities_of(const Filter& filter, const nb::dict& from) {
    Velocities out{get<Vector6>(from, "pose_std"), get<Vector6>(from, "gap_std"), {}};
    if (!get<bool>(from, "walks")) return out;
    out.twist = place_of(filter, "twist", 6);
    out.twist_std = get<Vector6>(from, "twist_std");
    out.is_measured = get<bool>(from, "is_measured");
    return out;
}

Inertial inertial_of(const Filter& filter, const nb::dict& from) {
    return {get<double>(from, "gyro"),        get<double>(from, "accel"),        get<double>(from, "gyro_walk"),
            get<double>(from, "accel_walk"),  get<double>(from, "gravity_m_s2"), place_of(filter, "velocity", 3),
            place_of(filter, "gyro_bias", 3), place_of(filter, "accel_bias", 3)};
}

void set_process(Filter& filter, const nb::list& laws, const nb::dict& settings) {
    require(laws.size() == filter.e.blocks.size(), "laws must have one item for each block");
    Process process;
    for (std::size_t i = 0; i < laws.size(); ++i) {
        process.laws.push_back(law_of(nb::cast<nb::dict>(laws[i]), filter.e.blocks[i]));
        require(process.laws[i].share == Law::none || filter.e.blocks[i].moves_camera,
                "only a block that moves the camera has a share");
    }
    const std::string kind = get<std::string>(settings, "kind");
    require(kind == "inertial" || kind == "velocities", "unknown kind of a process: " + kind);
    if (kind == "inertial")
        process.inertial = inertial_of(filter, settings);
    else
        process.velocities = velocities_of(filter, settings);
    filter.process = process;
}

nb::dict predict(Filter& filter, double tau_s, const Vector& dt_s, const Matrix& inputs, bool is_gap, double doubt) {
    require(filter.process.has_value(), "predictions of this filter come from Python");
    whole(filter);
    require_shape("inputs", inputs, dt_s.size(), 6);
    require_finite("inputs", inputs);
    require_finite("dt_s", dt_s);
    require(dt_s.size() > 0 && (dt_s.array() >= 0.0).all(), "dt_s must be durations, at least one");
    require(std::isfinite(tau_s) && tau_s >= 0.0, "tau_s must be a duration");
    require(std::isfinite(doubt) && doubt > 0.0, "doubt must be positive");
    const Departed departed = guarded(filter, filter.e.step + 1, [&] {
        return ekfslam::predict(filter.e, *filter.process, {tau_s, dt_s, inputs, is_gap, doubt});
    });
    const Matrix4 transposed = departed.T_cam_imu.transpose(), T_departed = filter.e.motion.T_departed.transpose();
    nb::dict out;
    out["values"] = array(filter.e.values.flat);
    out["coordinates"] = array(filter.e.coordinates);
    out["departed"] = array(departed.coordinates);
    out["imu_twist"] = array(filter.e.imu_twist);
    out["way_m"] = filter.e.motion.way_m;
    out["T_cam_imu"] = array(Vector(transposed.reshaped()));
    out["T_departed"] = array(Vector(T_departed.reshaped()));
    out["nis"] = departed.nis;
    out["log_det"] = departed.log_det;
    out["doubt"] = departed.doubt;
    return out;
}

}  // namespace

void bind_process(nb::class_<Shared>& bound) {
    bound.def("set_process", changing(&set_process), arg("laws"), arg("settings"))
        .def("predict", changing(&predict), arg("tau_s"), arg("dt_s"), arg("inputs"), arg("is_gap"), arg("doubt"));
}

}  // namespace ekfslam::binding
