// The prediction by velocities for Python: laws of blocks from plain data.
#include "binding.hpp"

namespace ekfslam::binding {

namespace {

Law law_of(const nb::dict& from, const Block& block) {
    Law law;
    law.walks = get<std::string>(from, "transition") == "gauss_markov";
    law.turns = get<std::string>(from, "turn_velocities") == "up";
    const std::string share = get<std::string>(from, "camera_share");
    law.share = share == "one" ? Law::one : share == "way" ? Law::way : Law::none;
    law.offset = get<Matrix>(from, "offset");
    if (law.offset.cols() != 0) require_shape("offset", law.offset, 6, block.size);
    if (!law.walks) return law;
    law.std = get<Vector>(from, "std");
    law.time_s = get<Vector>(from, "time_s");
    law.length_m = get<Vector>(from, "length_m");
    law.least_way_m = get<double>(from, "least_way_m");
    for (const Vector* one : {&law.std, &law.time_s, &law.length_m}) require_shape("walk", *one, block.size, 1);
    return law;
}

void set_process(Filter& filter, const nb::list& laws, const Vector6& pose_std, const Vector6& gap_std) {
    if (laws.size() != filter.e.blocks.size()) throw nb::value_error("laws must have one item for each block");
    Process process{{}, pose_std, gap_std};
    for (std::size_t i = 0; i < laws.size(); ++i)
        process.laws.push_back(law_of(nb::cast<nb::dict>(laws[i]), filter.e.blocks[i]));
    filter.process = process;
}

nb::dict predict(Filter& filter, double tau_s, const Vector& dt_s, const Matrix& inputs, bool is_gap, double doubt) {
    if (!filter.process) throw nb::value_error("predictions of this filter come from Python");
    require_shape("inputs", inputs, dt_s.size(), 6);
    const Departed departed = ekfslam::predict(filter.e, *filter.process, {tau_s, dt_s, inputs, is_gap, doubt});
    const Matrix4 transposed = departed.T_cam_imu.transpose();
    nb::dict out;
    out["values"] = array(filter.e.values.flat);
    out["coordinates"] = array(filter.e.coordinates);
    out["departed"] = array(departed.coordinates);
    out["imu_twist"] = array(filter.e.imu_twist);
    out["way_m"] = filter.e.motion.way_m;
    out["T_cam_imu"] = array(Vector(transposed.reshaped()));
    return out;
}

}  // namespace

nb::class_<Filter> bind_process(nb::class_<Filter> filter) {
    using nb::arg;
    filter.def("set_process", &set_process, arg("laws"), arg("pose_std"), arg("gap_std"))
        .def("predict", &predict, arg("tau_s"), arg("dt_s"), arg("inputs"), arg("is_gap"), arg("doubt"));
    return filter;
}

}  // namespace ekfslam::binding
