#include "table.hpp"

#include <algorithm>
#include <array>
#include <numeric>

namespace ekfslam {
namespace {

constexpr std::array whole = {&Table::id,        &Table::first_frame,      &Table::last_frame, &Table::observations,
                              &Table::misses,    &Table::log_row,          &Table::stay_until, &Table::first_step,
                              &Table::last_step, &Table::last_observation, &Table::asleep};
constexpr std::array real = {&Table::position_m, &Table::initial_m, &Table::evidence, &Table::seen_rows};

// Ids in ascending order, each with its place.
std::vector<std::pair<std::int64_t, Index>> ascending(const Ids& ids) {
    std::vector<std::pair<std::int64_t, Index>> order;
    order.reserve(ids.size());
    for (Index i = 0; i < static_cast<Index>(ids.size()); ++i) order.emplace_back(ids[i], i);
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
    for (auto column : whole) (table.*column).assign(n, 0);
    const Index heights[] = {3, 3, 2, d};
    for (std::size_t i = 0; i < real.size(); ++i) (table.*real[i]).setZero(heights[i], n);
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
    for (auto column : whole) {
        (table.*column).insert((table.*column).end(), (more.*column).begin(), (more.*column).end());
    }
    for (auto column : real) {
        Matrix& to = table.*column;
        const Matrix& from = more.*column;
        const Index n = to.cols();
        to.conservativeResize(from.rows(), n + from.cols());
        to.rightCols(from.cols()) = from;
    }
}

Table only(const Table& table, const Slots& slots) {
    Table some;
    for (auto column : whole) some.*column = picked(table.*column, slots);
    for (auto column : real) some.*column = columns(table.*column, slots);
    return some;
}

void keep(Table& table, const Flags& stay) {
    if (std::all_of(stay.begin(), stay.end(), [](bool flag) { return flag; })) return;
    table = only(table, where(stay));
}

void observed(Table& table, const Slots& slots, Index step, const Matrix& rows, std::int64_t place) {
    for (Index i = 0; i < static_cast<Index>(slots.size()); ++i) {
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

Slots where(const Flags& flags, bool value) {
    Slots which;
    for (std::size_t i = 0; i < flags.size(); ++i) {
        if (flags[i] == value) which.push_back(static_cast<Index>(i));
    }
    return which;
}

Matrix columns(const Matrix& values, const Slots& which) {
    Matrix some(values.rows(), static_cast<Index>(which.size()));
    for (Index i = 0; i < some.cols(); ++i) some.col(i) = values.col(which[i]);
    return some;
}

}  // namespace ekfslam
