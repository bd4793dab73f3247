// The joint filter; predictions by processes other than `Process` come from Python. A frame on one page:
// `Filter::update`.
#pragma once

#include <unordered_set>

#include "correction.hpp"
#include "lifecycle.hpp"
#include "process.hpp"
#include "starting.hpp"

namespace ekfslam {

// Accepted observations (j) of known landmarks, for the log: `LogBook.corrected`.
struct Taken {
    Ids landmark, previous;             // rows of the log; place of the observation in the frame before, or -1
    Matrix rows, variance, position_m;  // (d, j), (d, j), (3, j)
    Vector values, coordinates;         // at which the update was linearised: Values::flat, (body)
    Vector6 imu_twist;
};

// What a frame did: everything that the log, the books on retired landmarks, and `FrameReport` take in.
struct Report {
    std::vector<Retired> retired;  // in the order in which they left
    std::vector<int> reason;       // (n)
    double nis = 0, log_det = 0;
    Index dof = 0;
    double doubt = 1;   // factor of the inputs' standard deviations
    Ids split, moving;  // tracks that start again, and that were found to move
    FrameInnovations innovations;
    Taken taken;
    Vector updated_values, updated_coordinates;  // after the correction, before new landmarks start
    Started begun;                               // new landmarks; their rows of the log follow each other
};

class Filter {
   public:
    // `next_landmark`, `next_observation`: entries of the log so far.
    explicit Filter(Estimate estimate, std::int64_t next_landmark = 0, std::int64_t next_observation = 0);

    // Retire landmarks out of view, correct with known ones (6), start new ones (5), for ids (n), distinct, and their
    // measurements (4 or 2, n). The same as `rest`, then `take`.
    Report update(Index frame, const Ids& ids, const Matrix& measured);
    // Let landmarks out of view sleep or retire; between both phases, landmarks may be revived by `revive`.
    Retired rest(Index frame, const Ids& ids);
    Report take(Index frame, const Ids& ids, const Matrix& measured);

    // Append revived landmarks to the table; `adopt` must follow.
    void revive(const Table& more);
    // Replace mean and covariance: Values::flat, (body), (3, n), (body + 3n). Considered columns become zero.
    void adopt(const Vector& values, const Vector& coordinates, const Matrix& position_m, const Matrix& P);

    Estimate e;
    std::optional<Process> process;           // none: predictions come from Python
    Uniform uniform;                          // of Python: `numpy.random.default_rng(frame).random`
    Waiting waiting;                          // of one camera
    std::unordered_set<std::int64_t> moving;  // ids of tracks that were found to move; they are not used again
    std::int64_t next_landmark, next_observation;

   private:
    void take_in(Correction& found, Index frame, Report& report);
    void split(const Slots& moves, Report& report);
    Flags start_new(Index frame, const Ids& ids, const Matrix& rows, Report& report);
};

}  // namespace ekfslam
