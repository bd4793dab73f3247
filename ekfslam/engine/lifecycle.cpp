#include "lifecycle.hpp"

#include <algorithm>

namespace ekfslam {

Flags out_of_view(const Table& table, const Ids& ids, Index frame, Index after) {
    Flags out = is_among(table, ids);
    for (Index i = 0; i < table.size(); ++i) {
        const auto unseen_for = frame - std::max(table.last_frame[i], table.stay_until[i]);
        out[i] = !out[i] && unseen_for >= after;
    }
    return out;
}

Flags at_rest(const Flags& out, const Table& table, Index limit) {
    Slots slots = where(out);
    const Index excess = size_of(slots) - limit;
    if (limit < 0 || excess <= 0) return out;
    std::stable_sort(slots.begin(), slots.end(),
                     [&](Index a, Index b) { return table.last_frame[a] < table.last_frame[b]; });
    Flags stay = out;
    for (Index i = 0; i < excess; ++i) stay[slots[i]] = false;
    return stay;
}

Retired retire(Estimate& e, const Flags& gone, bool may_return) {
    const Slots slots = where(gone);
    if (slots.empty()) return {only(e.table, slots), {}, may_return};
    Retired retired{only(e.table, slots), e.gaussian.landmark_blocks(slots), may_return};
    Flags stay(gone);
    stay.flip();
    e.gaussian.marginalise(stay);
    keep(e.table, stay);
    return retired;
}

}  // namespace ekfslam
