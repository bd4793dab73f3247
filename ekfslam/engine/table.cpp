#include "table.hpp"

#include <algorithm>

namespace ekfslam {
namespace {

// Ids in ascending order, each with its place.
std::vector<std::pair<std::int64_t, Index>> ascending(const Ids& ids) {
    std::vector<std::pair<std::int64_t, Index>> order;
    order.reserve(ids.size());
    for (Index i = 0; i < size_of(ids); ++i) order.emplace_back(ids[i], i);
    std::sort(order.begin(), order.end());
    return order;
}

// Calls f(slot, place) for each landmark of the table that is at a place of the ids.
template <class F>
void each_match(const Table& table, const Ids& ids, F f) {
    const auto order = ascending(ids);
    if (order.empty()) return;
    const std::int64_t least = order.front().first, most = order.back().first;
    for (Index slot = 0; slot < table.size(); ++slot) {
        const std::int64_t id = table.id[slot];
        if (id < least || id > most) continue;
        auto found = std::lower_bound(order.begin(), order.end(), std::make_pair(id, Index{0}));
        for (; found != order.end() && found->first == id; ++found) f(slot, found->second);
    }
}

}  // namespace

Table blank(Index n, Index d) {
    Table table;
    for (const auto& column : WHOLE) (table.*column.values).assign(n, 0);
    for (const auto& column : REAL) (table.*column.values).setZero(column.height ? column.height : d, n);
    return table;
}

Lookup lookup(const Table& table, const Ids& ids) {
    Lookup found{Slots(ids.size(), 0), Flags(ids.size(), false)};
    each_match(table, ids, [&](Index slot, Index place) {
        found.slot[place] = slot;
        found.known[place] = true;
    });
    return found;
}

Flags is_among(const Table& table, const Ids& ids) {
    Flags among(table.id.size(), false);
    each_match(table, ids, [&](Index slot, Index) { among[slot] = true; });
    return among;
}

void append(Table& table, const Table& more) {
    for (const auto& column : WHOLE) {
        Ids& to = table.*column.values;
        to.insert(to.end(), (more.*column.values).begin(), (more.*column.values).end());
    }
    for (const auto& column : REAL) {
        Matrix& to = table.*column.values;
        const Matrix& from = more.*column.values;
        const Index n = to.cols();
        to.conservativeResize(from.rows(), n + from.cols());
        to.rightCols(from.cols()) = from;
    }
}

Table only(const Table& table, const Slots& slots) {
    Table some;
    for (const auto& column : WHOLE) some.*column.values = picked(table.*column.values, slots);
    for (const auto& column : REAL) some.*column.values = columns_of(table.*column.values, slots);
    return some;
}

void keep(Table& table, const Flags& stay) {
    if (std::all_of(stay.begin(), stay.end(), [](bool flag) { return flag; })) return;
    table = only(table, where(stay));
}

void observed(Table& table, const Slots& slots, Index step, const Matrix& rows, std::int64_t place) {
    for (Index i = 0; i < size_of(slots); ++i) {
        table.last_step[slots[i]] = step;
        table.seen_rows.col(slots[i]) = rows.col(i);
        table.last_observation[slots[i]] = place + i;
    }
}

void accepted(Table& table, const Slots& slots, Index frame) {
    for (Index slot : slots) {
        table.last_frame[slot] = frame;
        ++table.observations[slot];
        table.misses[slot] = 0;
    }
}

}  // namespace ekfslam
