#include "network/sliding_lstm.hpp"

#include <cmath>
#include <random>
#include <vector>

#include "chain/motion.hpp"
#include "check.hpp"
#include "network/lstm_lanes.hpp"

using namespace tauext;

namespace {

struct Network {
  LstmShape shape;
  std::vector<float> parameters;
  std::vector<LstmInput> inputs;
  int columns, stride, length;
};

Network make_network(int joints, int hidden, int stride, int length, int lag, unsigned seed) {
  Network n{{3 * joints, hidden, joints}, {}, {}, 2 * joints, stride, length};
  for (int c = 0; c < 2 * joints; ++c) n.inputs.push_back({c, 0});
  for (int c = joints; c < 2 * joints; ++c) n.inputs.push_back({c, lag});
  std::mt19937 random(seed);
  std::normal_distribution<float> normal(0, 0.4f);
  for (std::size_t k = 0; k < n.shape.parameter_count(); ++k) n.parameters.push_back(normal(random));
  return n;
}

SlidingLstm make_sliding(const Network& n, NetworkRate rate = NetworkRate::every_sample) {
  return SlidingLstm(n.shape, n.parameters, n.inputs, n.columns, n.stride, n.length, rate);
}

// Rows of a random walk; `ticks` is each sample's distance to the one before, held ticks repeat a row.
std::vector<float> make_rows(int columns, const std::vector<int>& ticks, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal(0, 0.1f);
  std::vector<float> rows, row(static_cast<std::size_t>(columns));
  for (int tick : ticks) {
    for (int held = 1; held < tick; ++held) rows.insert(rows.end(), row.begin(), row.end());
    for (float& x : row) x += normal(random);
    rows.insert(rows.end(), row.begin(), row.end());
  }
  return rows;
}

std::vector<float> batch(const Network& n, const std::vector<float>& rows, std::int64_t end) {
  const WindowRows windows{rows.data(), static_cast<std::int64_t>(rows.size()) / n.columns, n.columns, n.stride,
                           n.length,    n.inputs};
  std::vector<float> out(static_cast<std::size_t>(n.shape.outputs));
  lstm_forward(n.shape, n.parameters, windows, std::span(&end, 1), out, 1);
  return out;
}

std::span<const float> row_of(const Network& n, const std::vector<float>& rows, std::int64_t row) {
  return std::span(rows).subspan(static_cast<std::size_t>(row * n.columns), static_cast<std::size_t>(n.columns));
}

// Every answer equals the recomputed window to the last bit, whatever the gaps, the order of calls and the rate.
void check_answers(const Network& n, NetworkRate rate, const std::vector<int>& ticks, bool with_advance) {
  const std::vector<float> rows = make_rows(n.columns, ticks, 7);
  SlidingLstm sliding = make_sliding(n, rate);
  std::vector<float> out(static_cast<std::size_t>(n.shape.outputs));
  std::int64_t row = -1;
  const std::int64_t reach = WindowRows{nullptr, 0, n.columns, n.stride, n.length, n.inputs}.reach();
  int answers = 0;
  for (int tick : ticks) {
    row += row < 0 ? 1 : tick;
    sliding.push(row_of(n, rows, row), tick);
    const std::int64_t end = rate == NetworkRate::every_sample ? row : row - row % n.stride;
    CHECK(sliding.answer(out) == (end >= reach));
    if (end >= reach) {
      CHECK(out == batch(n, rows, end));
      ++answers;
    }
    if (with_advance) sliding.advance();
  }
  CHECK(answers > 0);
}

void every_answer_is_the_recomputed_window() {
  const std::vector<int> regular(320, 1);
  std::vector<int> gaps(320, 1);  // without a sample for as long as is bridged: all ticks from 1 on
  std::mt19937 random(3);
  for (std::size_t k = 1; k < gaps.size(); ++k)
    if (random() % 7 == 0) gaps[k] = 1 + static_cast<int>(random() % 6);
  for (const int lanes : {4, 8, 16}) {
    lanes::limit_lane_count(lanes);
    if (lanes::lane_count() != lanes) continue;  // this machine has fewer
    for (const int joints : {1, 2, 7})
      for (const int hidden : {3, 20})
        for (const NetworkRate rate : {NetworkRate::every_sample, NetworkRate::network_period}) {
          const Network n = make_network(joints, hidden, 5, 40, 1, 11);
          check_answers(n, rate, regular, true);
          check_answers(n, rate, gaps, true);
          check_answers(n, rate, gaps, false);
        }
    for (const int length : {1, 2, 3, 17})
      for (const int stride : {1, 5})
        for (const int lag : {0, 1, 3}) {
          const Network n = make_network(2, 5, stride, length, lag, 5);
          std::vector<int> ticks = gaps;
          for (int& tick : ticks) tick = std::min(tick, std::max(stride, kMostBridged) + 1);
          check_answers(n, NetworkRate::every_sample, ticks, true);
          check_answers(n, NetworkRate::network_period, ticks, true);
        }
  }
  lanes::limit_lane_count(0);
}

void a_restarted_one_equals_a_fresh_one() {
  const Network n = make_network(2, 20, 5, 30, 1, 4);
  const std::vector<int> ticks(400, 1);
  const std::vector<float> before = make_rows(n.columns, ticks, 1), after = make_rows(n.columns, ticks, 2);
  SlidingLstm used = make_sliding(n), fresh = make_sliding(n);
  for (int k = 0; k < 333; ++k) used.push(row_of(n, before, k), 1);
  used.restart();
  std::vector<float> a(2), b(2);
  for (int k = 0; k < 400; ++k) {
    used.push(row_of(n, after, k), 1);
    fresh.push(row_of(n, after, k), 1);
    const bool full = fresh.answer(b);
    CHECK(used.answer(a) == full);
    CHECK(!full || a == b);
  }
}

void a_restored_one_goes_on_as_if_nothing_had_been() {
  const Network n = make_network(2, 20, 5, 30, 1, 4);
  const std::vector<float> rows = make_rows(n.columns, std::vector<int>(500, 1), 1);
  SlidingLstm one = make_sliding(n), other = make_sliding(n);
  std::vector<float> a(2), b(2);
  for (int k = 0; k < 333; ++k) one.push(row_of(n, rows, k), 1);
  std::vector<std::byte> state(one.state_bytes());
  one.save(state);
  other.push(row_of(n, rows, 400), 1);
  other.restore(state);
  for (int k = 333; k < 500; ++k) {
    one.push(row_of(n, rows, k), 1);
    other.push(row_of(n, rows, k), 1);
    CHECK(one.answer(a) && other.answer(b));
    CHECK(a == b);
  }
}

void inputs_without_bounds_leave_with_their_windows() {
  const Network n = make_network(1, 4, 2, 10, 1, 4);
  std::vector<float> rows = make_rows(n.columns, std::vector<int>(100, 1), 1);
  rows[31 * 2] = INFINITY;  // times a weight of zero it is a NaN
  SlidingLstm sliding = make_sliding(n);
  std::vector<float> out(1);
  for (int k = 0; k < 100; ++k) {
    sliding.push(row_of(n, rows, k), 1);
    const bool full = sliding.answer(out);
    if (full && k > 31 + 20) CHECK(out == batch(n, rows, k) && std::isfinite(out[0]));
  }
}

void sizes_that_do_not_fit_are_refused() {
  const Network n = make_network(2, 20, 10, 100, 1, 1);
  const auto make = [&](std::span<const float> parameters, int columns, int stride, int length) {
    return SlidingLstm(n.shape, parameters, n.inputs, columns, stride, length, NetworkRate::every_sample);
  };
  CHECK_THROWS(make(std::span(n.parameters).first(5), 4, 10, 100), Error);
  CHECK_THROWS(make(n.parameters, 3, 10, 100), Error);
  CHECK_THROWS(make(n.parameters, 4, 0, 100), Error);
  CHECK_THROWS(make(n.parameters, 4, 10, 0), Error);
  CHECK_THROWS(make(n.parameters, 4, 10, kMaxWindowSteps + 1), Error);
  CHECK_THROWS(make(n.parameters, 4, kMaxNetworkStride, 5000), Error);  // gigabytes of state
}

}  // namespace

int main() {
  every_answer_is_the_recomputed_window();
  a_restarted_one_equals_a_fresh_one();
  a_restored_one_goes_on_as_if_nothing_had_been();
  inputs_without_bounds_leave_with_their_windows();
  sizes_that_do_not_fit_are_refused();
  return check::result();
}
