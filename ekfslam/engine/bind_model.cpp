// The observation side for the tests of Python: functions of SE(3), cameras, rows, corrections.
#include "binding.hpp"
#include "model.hpp"
#include "retraction.hpp"
#include "se3.hpp"

namespace ekfslam::binding {

namespace {

void require_correction(const Estimate& e, const Vector& correction) {
    const Index size = e.columns.body + e.gaussian.considered() + 3 * e.table.size();
    require_shape("correction", correction, size, 1);
}

// Measurements of landmarks (k) in rows of the sensor's dimension.
Matrix rows_for(const Estimate& e, Index count, const Matrix& measured) {
    require_shape("measured", measured, count, e.sensor.dimension());
    return measured.transpose();
}

nb::tuple camera_of(const Filter& filter, bool is_difference) {
    const View view = camera(filter.e, filter.e.mean(), is_difference);
    return nb::make_tuple(Matrix(view.W), view.Y);
}

// Points (k, 3), rows by leading columns (k d, lead) and landmarks (k d, 3), residuals and variances (k, d), and the
// derivative (k d, 3) of single observations by landmarks.
nb::tuple observe_from(const Filter& filter, const Integers& slots, const Matrix& measured) {
    const Estimate& e = whole(filter).e;
    Observed seen = observe(e, e.mean(), slots_of(slots, e.table.size()), rows_for(e, slots.size(), measured));
    return nb::make_tuple(rows(seen.q), rows(seen.rows.H_x), rows(seen.rows.H_m), rows(seen.rows.residual),
                          rows(seen.rows.variance), rows(seen.H_m));
}

// Rows at the mean after a correction, in the errors before it, as of `observe`.
nb::tuple observe_after(const Filter& filter, const Vector& correction, const Integers& slots, const Matrix& measured) {
    const Estimate& e = whole(filter).e;
    require_correction(e, correction);
    const Moved moved = retracted(e, correction);
    const Slots some = slots_of(slots, e.table.size());
    Observed seen = observe(e, moved.mean, some, rows_for(e, slots.size(), measured));
    const Rows back = carried_back(e, seen.rows, moved);
    return nb::make_tuple(rows(back.H_x), rows(back.H_m), rows(back.residual));
}

// Starts new tracks with rows (n, d); returns whether (n,) each has a landmark.
std::vector<bool> start_from(Filter& filter, Index frame, const Integers& ids, const Matrix& rows_seen) {
    const bool is_rig = whole(filter).e.sensor.type == Sensor::rig;
    const Matrix columns = rows_for(filter.e, ids.size(), rows_seen);
    return (is_rig ? start(filter.e, whole_number("frame", frame), ids_of(ids), columns)
                   : filter.waiting.start(filter.e, whole_number("frame", frame), ids_of(ids), columns))
        .which;
}

nb::dict lead_of(const Filter& filter) {
    const Lead lead = filter.e.gaussian.lead();
    nb::dict out;
    out["front"] = lead.front;
    out["drifted"] = lead.drifted;
    out["view"] = lead.view;
    out["previous"] = lead.previous;
    out["width"] = lead.width;
    return out;
}

}  // namespace

void bind_model(nb::module_& module) {
    nb::module_ group = module.def_submodule("se3", "Functions of `ekfslam.geometry.se3` for one pose.");
    group.def("exp", [](const Vector6& xi) { return Matrix(se3::exp(xi)); }, arg("xi"));
    group.def("log", [](const Matrix4& T) { return Vector(se3::log(T)); }, arg("T"));
    group.def("inverse", [](const Matrix4& T) { return Matrix(se3::inverse(T)); }, arg("T"));
    group.def("adjoint", [](const Matrix4& T) { return Matrix(se3::adjoint(T)); }, arg("T"));
    group.def("left_jacobian", [](const Vector6& xi) { return Matrix(se3::left_jacobian(xi)); }, arg("xi"));
    group.def(
        "left_jacobian_inverse", [](const Vector6& xi) { return Matrix(se3::left_jacobian_inverse(xi)); }, arg("xi"));
    module.def("camera", reading(&camera_of), arg("filter"), arg("is_difference"));
    module.def("observe", reading(&observe_from), arg("filter"), arg("slots"), arg("measured"));
    module.def("observe_after", reading(&observe_after), arg("filter"), arg("correction"), arg("slots"),
               arg("measured"));
    module.def("retract", changing(+[](Filter& filter, const Vector& correction) {
                   require_correction(whole(filter).e, correction);
                   retract(filter.e, correction);
               }),
               arg("filter"), arg("correction"));
    module.def("set_updated", changing(+[](Filter& filter, const std::string& name) {
                   filter.e.updated = name == "view"            ? Updated::view
                                      : name == "previous_view" ? Updated::previous
                                                                : Updated::none;
               }),
               arg("filter"), arg("view"));
    module.def("start", changing(&start_from), arg("filter"), arg("frame"), arg("ids"), arg("rows"));
    module.def("lead", reading(&lead_of), arg("filter"));
}

}  // namespace ekfslam::binding
