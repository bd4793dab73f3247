#include "model.hpp"

#include "se3.hpp"

namespace ekfslam {

namespace {

using RowMajor4 = Eigen::Matrix<double, 4, 4, Eigen::RowMajor>;

// C and D of eq. (9), and the tangent o of eq. (11) by which blocks move the camera: W = C D exp(o) T.
struct Chain {
    Matrix4 C, D;
    Vector6 o = Vector6::Zero();
    bool moves = false;
};

double share_of(const Block& block, bool is_difference) {
    return is_difference ? block.share_of_difference : block.share;
}

Chain chain(const Estimate& e, const Values& values, const Vector6& imu_twist, bool is_difference) {
    Chain out{e.sensor.T_cam_imu, Matrix4::Identity()};
    if (values.places.calibration >= 0) {
        const Parameters c = values.calibration();
        out.C = se3::exp(c.head<6>()) * e.sensor.T_cam_imu;
        out.D = se3::exp(-c[TIME_OFFSET] * imu_twist);
    }
    for (const Block& block : e.blocks) {
        if (!block.moves_camera) continue;
        out.o += share_of(block, is_difference) * values.flat.segment<6>(block.value_at);
        out.moves = true;
    }
    return out;
}

// The derivative (6, size) of a camera in world by the free parameters of a calibration.
Matrix by_calibration(const Block& block, const Parameters& c, const Matrix4& C, const Vector6& imu_twist) {
    Matrix Y = Matrix::Zero(6, block.size);
    const Matrix6 J = se3::left_jacobian(c.head<6>());
    for (Index j = 0; j < block.size; ++j) {
        const Index parameter = block.free[j];
        if (parameter < LOG_BASELINE) Y.col(j) = J.col(parameter);
        if (parameter == TIME_OFFSET) Y.col(j) = -(se3::adjoint(C) * imu_twist);
    }
    return Y;
}

void retract_block(const Block& block, const Vector& correction, Values& values) {
    const auto d = correction.segment(block.at, block.size);
    switch (block.kind) {
        case Kind::vector:
            values.flat.segment(block.value_at, block.size) += d;
            break;
        case Kind::pose:
            values.set(block.value_at, se3::exp(d) * values.matrix(block.value_at));
            break;
        case Kind::direction: {
            const Vector3 turned = se3::so3_exp(d) * values.flat.segment<3>(block.value_at);
            values.flat.segment<3>(block.value_at) = turned;
            break;
        }
        case Kind::calibration:
            for (Index j = 0; j < block.size; ++j) values.flat[block.value_at + block.free[j]] += d[j];
            break;
    }
}

bool has_drift(const Estimate& e) {
    if (!e.track_error) return false;
    for (const Block& block : e.blocks)
        if (block.moves_camera && block.share != block.share_of_difference) return true;
    return false;
}

}  // namespace

Places::Places(const std::vector<Block>& blocks) {
    for (const Block& block : blocks) {
        if (block.name == "pose") pose = block.value_at;
        if (block.name == "view") view = block.value_at;
        if (block.name == "previous_view") previous = block.value_at;
        if (block.name == "anchor") anchor = block.value_at;
        if (block.kind == Kind::calibration) calibration = block.value_at;
    }
}

Matrix4 Values::matrix(Index at) const { return Eigen::Map<const RowMajor4>(flat.data() + at); }

void Values::set(Index at, const Matrix4& T) { Eigen::Map<RowMajor4>(flat.data() + at) = T; }

Parameters Values::calibration() const {
    if (places.calibration < 0) return Parameters::Zero();
    return flat.segment<9>(places.calibration);
}

Columns columns_of(const std::vector<Block>& blocks) {
    Columns out;
    for (const Block& block : blocks) {
        out.body = std::max(out.body, block.at + block.size);
        if (block.name == "view") out.view = block.at;
        if (block.name == "previous_view") out.previous = block.at;
        if (block.name == "anchor") out.anchor = block.at;
        for (Index j = 0; j < size_of(block.free); ++j)
            if (block.free[j] == LOG_BASELINE || block.free[j] == DISPARITY_OFFSET) out.front.push_back(block.at + j);
    }
    return out;
}

Estimate::Estimate(Config config_, Sensor sensor_, std::optional<TrackError> track_error_, std::vector<Block> blocks_,
                   const Vector& values_, Vector coordinates_, const Matrix& P)
    : config(config_),
      sensor(sensor_),
      track_error(track_error_),
      blocks(std::move(blocks_)),
      columns(columns_of(blocks)),
      values{values_, Places(blocks)},
      coordinates(std::move(coordinates_)),
      gaussian(P, columns) {
    const Index d = sensor.dimension();
    for (Matrix* column : {&table.position_m, &table.initial_m}) column->resize(3, 0);
    table.evidence.resize(2, 0);
    table.seen_rows.resize(d, 0);
}

const Block* Estimate::block(const std::string& name) const {
    for (const Block& block : blocks)
        if (block.name == name) return &block;
    return nullptr;
}

bool Estimate::has_time_offset() const {
    for (const Block& block : blocks)
        for (const Index parameter : block.free)
            if (parameter == TIME_OFFSET) return true;
    return false;
}

Matrix4 camera_pose(const Estimate& e, const Values& values, const Vector6& imu_twist, bool is_difference) {
    const Chain c = chain(e, values, imu_twist, is_difference);
    const Matrix4 moved = c.moves ? Matrix4(se3::exp(c.o) * values.pose()) : values.pose();
    return c.C * (c.D * moved);
}

View camera(const Estimate& e, const Mean& at, bool is_difference) {
    const Chain c = chain(e, at.values, at.imu_twist, is_difference);
    const Matrix4 M = c.C * c.D, X = se3::exp(c.o);
    View out{M * (X * at.values.pose()), Matrix::Zero(6, e.columns.body)};
    const Matrix6 by_offset = se3::adjoint(M) * se3::left_jacobian(c.o);
    for (const Block& block : e.blocks) {
        auto Y = out.Y.middleCols(block.at, block.size);
        if (block.name == "pose") Y = se3::adjoint(M * X);
        if (block.moves_camera) Y = share_of(block, is_difference) * by_offset;
        if (block.kind == Kind::calibration) Y = by_calibration(block, at.values.calibration(), c.C, at.imu_twist);
    }
    return out;
}

void close_views(Estimate& e) {
    if (e.columns.previous >= 0) {
        e.values.set(e.values.places.previous, e.values.view());
        e.coordinates.segment<6>(e.columns.previous) = e.coordinates.segment<6>(e.columns.view);
    }
    e.gaussian.close_view();
    e.updated = e.updated == Updated::view ? Updated::previous : Updated::none;
    e.is_open = false;
}

void open_views(Estimate& e) {
    const Mean at = e.mean();
    e.opened = camera(e, at, false);
    e.drifted.reset();
    std::optional<Matrix> Y_drifted;
    if (has_drift(e)) {
        e.drifted = camera(e, at, true);
        Y_drifted = e.drifted->Y;
    }
    if (e.columns.view >= 0) {
        e.values.set(e.values.places.view, e.opened.W);
        e.coordinates.segment<6>(e.columns.view) = e.opened.Y * e.coordinates;
    }
    e.gaussian.open_view(e.opened.Y, Y_drifted);
    e.is_open = true;
}

Values retract_values(const Estimate& e, const Vector& correction) {
    Values after = e.values;
    for (const Block& block : e.blocks) retract_block(block, correction, after);
    if (e.is_open && e.columns.view >= 0) after.set(after.places.view, camera_pose(e, after, e.imu_twist, false));
    return after;
}

}  // namespace ekfslam
