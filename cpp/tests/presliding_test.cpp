#include "chain/motion.hpp"

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include "check.hpp"
#include "refused.hpp"

using namespace tauext;

namespace {

// A random walk of every joint: strides as long as the widest width, rests, and stretches that only tremble.
std::vector<double> random_walk(int joints, int samples, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal(0, 1);
  std::vector<double> q(static_cast<std::size_t>(joints) * samples);
  for (int j = 0; j < joints; ++j) {
    double at = normal(random);
    for (int k = 0; k < samples; ++k) {
      const double size = (k / 97) % 3 == 0 ? 1e-5 : (k / 97) % 3 == 1 ? 1e-3 : 1e-2;
      if (random() % 8 != 0) at += size * normal(random);
      q[static_cast<std::size_t>(k * joints + j)] = at;
    }
  }
  return q;
}

std::span<const double> row(const std::vector<double>& q, int joints, int k) {
  return std::span(q).subspan(static_cast<std::size_t>(k * joints), static_cast<std::size_t>(joints));
}

std::vector<double> states(const Presliding& bank) {
  std::vector<double> out(static_cast<std::size_t>(bank.columns()));
  bank.write(out);
  return out;
}

// One stop operator in its textbook form, in radians, from a known start.
struct Stop {
  double width, z;
  void move(double by) { z = std::clamp(z + by, -width, width); }
};

// Up by 3 w and down again in steps of w/64: powers of two, so that every sum is exact. While nothing is known but the
// two ends, -1 rises and 1 stays: the mean is d/2w, until they meet at d = 2 w. Back it goes linearly, from 1 to -1.
void a_triangle_motion_gives_the_closed_form() {
  constexpr int kPerWidth = 64;
  const double width = std::ldexp(1.0, -7), step = width / kPerWidth;
  Presliding bank(1, std::span(&width, 1));
  double q[1];
  for (int k = 0; k <= 3 * kPerWidth; ++k) {
    q[0] = 0.5 + k * step;
    bank.step(q);
    CHECK(bank.value(0, 0) == std::min(1.0, k / (2.0 * kPerWidth)));
    CHECK(bank.determined(0, 0) == (k >= 2 * kPerWidth));
  }
  for (int k = 1; k <= 3 * kPerWidth; ++k) {
    q[0] = 0.5 + (3 * kPerWidth - k) * step;
    bank.step(q);
    CHECK(bank.value(0, 0) == std::max(-1.0, 1.0 - static_cast<double>(k) / kPerWidth));
    CHECK(bank.determined(0, 0));
  }
}

// 2 w is the covered span, not the path length: small oscillations within it add no information.
void trembling_within_twice_the_width_leaves_the_state_undetermined() {
  const double width = std::ldexp(1.0, -7);
  Presliding bank(1, std::span(&width, 1));
  for (int k = 0; k < 1000; ++k) {
    const double q[1] = {k % 2 ? 1.5 * width : 0.0};
    bank.step(q);
    CHECK(!bank.determined(0, 0));
    // Up by 1.5 w, the ends are 0.5 and 1; down again -1 and -0.5.
    if (k > 0) CHECK(bank.value(0, 0) == (k % 2 ? 0.75 : -0.75));
  }
}

void until_determined_the_state_brackets_every_start_and_from_then_on_equals_it() {
  constexpr int kJoints = 3, kSamples = 4000;
  const double widths[] = {1e-4, 1e-3, 1e-2, 0.2};
  const std::vector<double> q = random_walk(kJoints, kSamples, 1);
  Presliding bank(kJoints, widths);
  int determined_early = 0;
  std::vector<std::vector<Stop>> starts;  // by joint and width: begun at -w, 0, w and somewhere in between
  std::vector<double> lowest, highest;
  for (int j = 0; j < kJoints; ++j) {
    for (double w : widths) starts.push_back({{w, -w}, {w, 0}, {w, w}, {w, 0.3 * w}});
    lowest.push_back(q[static_cast<std::size_t>(j)]);
    highest.push_back(q[static_cast<std::size_t>(j)]);
  }
  for (int k = 0; k < kSamples; ++k) {
    bank.step(row(q, kJoints, k));
    for (int j = 0; j < kJoints; ++j) {
      const double now = row(q, kJoints, k)[j], moved = k ? now - row(q, kJoints, k - 1)[j] : 0.0;
      lowest[j] = std::min(lowest[j], now);
      highest[j] = std::max(highest[j], now);
      for (int w = 0; w < 4; ++w) {
        std::vector<Stop>& stops = starts[static_cast<std::size_t>(4 * j + w)];
        for (Stop& stop : stops) stop.move(moved);
        const double covered = (highest[j] - lowest[j]) / widths[w];
        // Both add the same rounded steps, one in radians and one in widths: 4000 roundings of 1e-16 at the most.
        constexpr double kRounding = 1e-12;
        if (covered < 2 - kRounding) CHECK(!bank.determined(j, w));
        if (covered > 2 + kRounding) CHECK(bank.determined(j, w));
        // The two extreme starts enclose what is possible and the state is their mean; once determined, all are one.
        const double low = stops[0].z / widths[w], high = stops[2].z / widths[w];
        CHECK_CLOSE(bank.value(j, w), 0.5 * (low + high), kRounding);
        for (const Stop& stop : stops) {
          CHECK(stop.z / widths[w] >= low - kRounding && stop.z / widths[w] <= high + kRounding);
          if (bank.determined(j, w)) CHECK_CLOSE(stop.z / widths[w], bank.value(j, w), kRounding);
        }
        determined_early += bank.determined(j, w) && k < kSamples / 4;
      }
    }
  }
  CHECK(determined_early > 0);
  CHECK(bank.determined(0, 0) && bank.determined(0, 1));
}

// That of the other joint is not touched.
void a_forgotten_joint_restarts() {
  constexpr int kJoints = 2, kSamples = 1000, kForget = 500;
  const double widths[] = {1e-4, 1e-2};
  const std::vector<double> q = random_walk(kJoints, kSamples, 4);
  Presliding kept(kJoints, widths), forgetful(kJoints, widths), fresh(kJoints, widths);
  int apart = 0;
  for (int k = 0; k < kSamples; ++k) {
    kept.step(row(q, kJoints, k));
    forgetful.step(row(q, kJoints, k));
    if (k == kForget) forgetful.forget(1);
    if (k >= kForget) fresh.step(row(q, kJoints, k));
    for (int w = 0; w < 2; ++w) {
      CHECK(forgetful.value(0, w) == kept.value(0, w) && forgetful.doubt(0, w) == kept.doubt(0, w));
      const Presliding& like = k < kForget ? kept : fresh;
      CHECK(forgetful.value(1, w) == like.value(1, w) && forgetful.doubt(1, w) == like.doubt(1, w));
      apart += forgetful.doubt(1, w) != kept.doubt(1, w);
    }
  }
  CHECK(apart > 0);
}

void states_stay_within_one_whatever_the_motion() {
  const double widths[] = {1e-12, 1e-4, 1e3};
  Presliding bank(1, widths);
  for (double q : {0.0, 1e-13, -1e300, 1e300, -1e308, 1e308, -1e308, 0.0, 1e-4, -500.0, 3000.0, 1e-300}) {
    bank.step(std::span(&q, 1));
    for (double z : states(bank)) CHECK(z >= -1 && z <= 1);
  }
}

void a_shift_of_all_positions_changes_nothing_beyond_rounding() {
  constexpr int kJoints = 2, kSamples = 3000;
  const double widths[] = {1e-4, 1e-3, 1e-2};
  std::vector<double> here = random_walk(kJoints, kSamples, 2), there(here.size());
  // On a grid of 2^-40 rad every sum and difference with 64 rad is exact, and so is the comparison.
  for (double& q : here) q = std::ldexp(std::round(std::ldexp(q, 40)), -40);
  for (std::size_t k = 0; k < here.size(); ++k) there[k] = here[k] + 64.0;
  Presliding one(kJoints, widths), exact(kJoints, widths), other(kJoints, widths);
  for (int k = 0; k < kSamples; ++k) {
    double near[kJoints];
    for (int j = 0; j < kJoints; ++j) near[j] = row(here, kJoints, k)[j] + 1.2345678;
    one.step(row(here, kJoints, k));
    exact.step(row(there, kJoints, k));
    other.step(near);
    const std::vector<double> a = states(one), b = states(exact), c = states(other);
    CHECK(a == b);
    // A shift by another number rounds each position by up to 2.2e-16 rad, which is 2.2e-12 of the narrowest width; a
    // stop operator adds such errors up, but never makes them larger.
    for (std::size_t s = 0; s < a.size(); ++s) CHECK_CLOSE(a[s], c[s], 5e-12 * (k + 1));
  }
}

void joints_do_not_touch_each_other_and_states_are_ordered_by_joint() {
  const double widths[] = {1e-4, 3e-3};
  const std::vector<double> q = random_walk(2, 500, 3);
  Presliding both(2, widths), first(1, widths), second(1, widths), swapped(2, widths);
  CHECK(both.columns() == 4 && both.width_count() == 2);
  for (int k = 0; k < 500; ++k) {
    const auto now = row(q, 2, k);
    const double turned[2] = {now[1], now[0]};
    both.step(now);
    swapped.step(turned);
    first.step(now.first(1));
    second.step(now.last(1));
    const std::vector<double> all = states(both), exchanged = states(swapped), a = states(first), b = states(second);
    CHECK(all == (std::vector<double>{a[0], a[1], b[0], b[1]}));
    CHECK(exchanged == (std::vector<double>{b[0], b[1], a[0], a[1]}));
    CHECK(all[3] == both.value(1, 1));
  }
}

void reset_equals_fresh() {
  const double widths[] = {1e-3, 1e-2};
  const std::vector<double> before = random_walk(2, 400, 4), after = random_walk(2, 400, 5);
  Presliding used(2, widths), fresh(2, widths);
  for (int k = 0; k < 400; ++k) used.step(row(before, 2, k));
  used.reset();
  for (int k = 0; k < 400; ++k) {
    used.step(row(after, 2, k));
    fresh.step(row(after, 2, k));
    CHECK(states(used) == states(fresh));
    for (int w = 0; w < 2; ++w) CHECK(used.determined(1, w) == fresh.determined(1, w));
    if (k == 0) CHECK(states(used) == std::vector<double>(4, 0.0) && !used.determined(0, 0));
  }
}

void a_restored_bank_goes_on_as_if_nothing_had_been() {
  const double widths[] = {1e-3, 1e-2, 3e-1};
  const std::vector<double> q = random_walk(2, 1000, 6), elsewhere = random_walk(2, 50, 7);
  for (int stop : {0, 1, 33, 700}) {
    Presliding straight(2, widths), other(2, widths);
    for (int k = 0; k < stop; ++k) straight.step(row(q, 2, k));
    const Presliding::State kept = straight.state();
    for (int k = 0; k < 50; ++k) other.step(row(elsewhere, 2, k));
    other.restore(kept);
    for (int k = stop; k < 1000; ++k) {
      straight.step(row(q, 2, k));
      other.step(row(q, 2, k));
      CHECK(states(straight) == states(other) && straight.determined(1, 2) == other.determined(1, 2));
    }
  }
}

void no_widths_make_no_states() {
  Presliding bank(3, {});
  const double q[3] = {1, 2, 3};
  bank.step(q);
  CHECK(bank.columns() == 0 && bank.width_count() == 0);
  bank.write({});
}

void bad_widths_are_refused() {
  const auto refuses = [](const char* part_of_message, int joints, const std::vector<double>& widths) {
    refused(part_of_message, [&] { Presliding(joints, widths); });
  };
  refuses("need 1 to 32 joints, not 0", 0, {1e-3});
  refuses("need 1 to 32 joints, not 33", kMaxJoints + 1, {1e-3});
  refuses("at most 8 presliding states, not 9", 1, {1, 2, 3, 4, 5, 6, 7, 8, 9});
  refuses("must be > 0", 1, {0.0});
  refuses("must be > 0", 1, {-1e-3});
  refuses("presliding width nan", 1, {NAN});
  refuses("presliding width inf", 1, {INFINITY});
  refuses("must be > 0.003", 1, {3e-3, 1e-3});
  refuses("must be > 0.003", 1, {3e-3, 3e-3});
  const Presliding largest(kMaxJoints, std::vector<double>{1, 2, 3, 4, 5, 6, 7, 8});
  CHECK(largest.columns() == kMaxJoints * kMaxWidths);
}

// Of two widths 1 and 3 with half of the friction each: f rises from -1 by 2/3 a unit up to 1/3 at 2, then by 1/6 to 1 at 6.
void local_memory_follows_the_branch_and_leaves_the_bank_at_the_second_reversal() {
  const double unit = std::ldexp(1.0, -10), widths[] = {unit, 3 * unit}, branches[] = {0.5, 0.5};
  Presliding bank(1, widths, branches);
  double q = 0;
  const auto move = [&](double units) {
    for (int k = 0; k < 64; ++k) {
      q += units * unit / 64;
      bank.step(std::span(&q, 1));
    }
  };
  const auto local = [&] { return bank.state().local[0]; };
  bank.step(std::span(&q, 1));
  CHECK(local() == 0 && bank.memory_gap(0) == 0);
  move(8);
  CHECK(local() == 1 && bank.memory_gap(0) == 0);
  move(-3);  // after sliding both are the branch itself
  CHECK_CLOSE(local(), -(1.0 / 3 + 1.0 / 6), 1e-12);
  CHECK_CLOSE(bank.memory_gap(0), 0, 1e-12);
  move(2);  // from -1/2 by 2/3 up to 1/3 after 1.25, the rest by 1/6; the bank bends both by 2: 1/2 * 1 + 1/2 * 2/3
  CHECK_CLOSE(local(), 1.0 / 3 + 0.75 / 6, 1e-12);
  CHECK_CLOSE(bank.memory_gap(0), 1.0 / 3 + 0.75 / 6 - 5.0 / 6, 1e-12);
  move(8);
  CHECK(local() == 1 && bank.memory_gap(0) == 0);
}

// One width has one slope: both kinds of memory are equal.
void a_branch_of_one_width_is_the_bank_once_that_is_determined() {
  const double width = 3e-4;
  const double one[] = {1};
  Presliding bank(1, std::span(&width, 1), one);
  const std::vector<double> q = random_walk(1, 3000, 7);
  int determined = 0;
  for (int k = 0; k < 3000; ++k) {
    bank.step(row(q, 1, k));
    if (!bank.determined(0, 0)) continue;
    ++determined;
    CHECK_CLOSE(bank.memory_gap(0), 0, 1e-9);
  }
  CHECK(determined > 1000);
}

void states_with_local_memory_are_bounded_symmetric_and_kept() {
  const double widths[] = {1e-4, 1e-3, 1e-2};
  const double branches[] = {0.2, 0.5, 0.3, 0, 0, 0, 0, 1, 0};  // the second joint has none
  Presliding bank(3, widths, branches), turned(3, widths, branches), other(3, widths, branches);
  CHECK(bank.has_branches() && bank.kept_columns() == bank.columns() + 3 && !Presliding(3, widths).has_branches());
  const std::vector<double> q = random_walk(3, 4000, 8);
  std::vector<double> low(12), high(12);
  double apart = 0;
  for (int k = 0; k < 4000; ++k) {
    const auto now = row(q, 3, k);
    const double back[] = {-now[0], -now[1], -now[2]};
    bank.step(now);
    turned.step(back);
    for (std::size_t j = 0; j < 3; ++j) {
      const double state = bank.state().local[j];
      CHECK(std::fabs(state) <= 1 && turned.state().local[j] == -state);
      apart = std::max(apart, std::fabs(bank.memory_gap(static_cast<int>(j))));
    }
    CHECK(bank.memory_gap(1) == 0);
    if (k % 100 != 0) continue;
    bank.write_ends(low, high);
    other.read_ends(low, high);
    for (int j = 0; j < 3; ++j) CHECK(other.memory_gap(j) == bank.memory_gap(j));
  }
  CHECK(apart > 0.2);
  bank.forget(0);
  CHECK(bank.state().local[0] == 0 && bank.state().local[2] != 0);
}

void bad_branches_are_refused() {
  const double widths[] = {1e-3, 1e-2};
  const auto refuses = [&](const char* part_of_message, std::vector<double> branches) {
    refused(part_of_message, [&] { Presliding(1, widths, branches); });
  };
  refuses("presliding branches are 3 where 2 belong", {0.5, 0.5, 0});
  refuses("presliding branch -0.5 must be 0 to 1", {-0.5, 1});
  refuses("presliding branch nan must be 0 to 1", {NAN, 1});
  refuses("sum to 0.7", {0.5, 0.2});
}

}  // namespace

int main() {
  local_memory_follows_the_branch_and_leaves_the_bank_at_the_second_reversal();
  a_branch_of_one_width_is_the_bank_once_that_is_determined();
  states_with_local_memory_are_bounded_symmetric_and_kept();
  bad_branches_are_refused();
  a_triangle_motion_gives_the_closed_form();
  trembling_within_twice_the_width_leaves_the_state_undetermined();
  until_determined_the_state_brackets_every_start_and_from_then_on_equals_it();
  a_forgotten_joint_restarts();
  states_stay_within_one_whatever_the_motion();
  a_shift_of_all_positions_changes_nothing_beyond_rounding();
  joints_do_not_touch_each_other_and_states_are_ordered_by_joint();
  reset_equals_fresh();
  a_restored_bank_goes_on_as_if_nothing_had_been();
  no_widths_make_no_states();
  bad_widths_are_refused();
  return check::result();
}
