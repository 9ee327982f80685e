#include "alarm/coverage.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <numbers>
#include <random>
#include <vector>

#include "check.hpp"

using namespace tauext;

namespace {

constexpr std::int64_t kMs = 1'000'000;
constexpr double kFades = 20.0, kTurn = 2 * std::numbers::pi;

struct Pose {
  double q[3], dq[3];
};

// Three joints, the last one slides; nothing was seen yet.
CoverageSettings blank(std::uint8_t reach, std::uint8_t reach_together) {
  CoverageSettings s;
  s.fastest_rad_s = {2.0, 1.0, 0.5};
  s.turns = {1, 1, 0};
  s.centre_rad = {0, 0, 0.25};
  s.span_rad = {kTurn, kTurn, 1.0};
  s.seen.assign(3, 0);
  s.reach.assign(3, reach);
  s.seen_together.assign(reach_together > 0 ? 3 * 32 : 0, 0);
  s.reach_together = reach_together;
  return s;
}

int cell_of(const CoverageSettings& s, std::size_t j, double q, int cells) {
  double x = (q - s.centre_rad[j]) / s.span_rad[j];
  if (s.turns[j]) x -= std::floor(x + 0.5);
  return static_cast<int>(std::fmin(std::fmax((x + 0.5) * cells, 0), cells - 0.5));
}

int cells_apart(const CoverageSettings& s, std::size_t j, double a, double b, int cells) {
  const int apart = std::abs(cell_of(s, j, a, cells) - cell_of(s, j, b, cells));
  return s.turns[j] ? std::min(apart, cells - apart) : apart;
}

Unfamiliar evaluate(const CoverageSettings& s, const Pose& pose) { return Coverage(3, s, kFades).evaluate(pose.q, pose.dq); }

bool is(const Unfamiliar& u, double share, Unseen what, int joint, int other) {
  return std::fabs(u.share - share) < 1e-12 && u.what == what && u.joint == joint && u.other == other;
}

void without_training_motion_nothing_is_unfamiliar() {
  const Pose anywhere{{1e9, -7, 0}, {1e9, 0, 0}};
  CHECK(is(Coverage(3, {}, kFades).evaluate(anywhere.q, anywhere.dq), 0, Unseen::nothing, -1, -1));
}

// A 64th of a turn is 0.098 rad.
void positions_count_by_cells_from_seen_ones_also_round_the_turn() {
  CoverageSettings s = blank(2, 0);
  const double cell = kTurn / 64, seen[] = {3.1, 0.01, 0.25};
  s.see(seen);
  const auto at = [&](double q0, double q1, double q2) { return evaluate(s, {{q0, q1, q2}, {}}); };
  CHECK(is(at(3.1, 0.01, 0.25), 0, Unseen::nothing, -1, -1));
  CHECK(is(at(3.1 + 2 * cell, 0.01, 0.25), 0, Unseen::nothing, -1, -1));  // beyond pi: the second cell
  CHECK(is(at(3.1 + 3 * cell, 0.01, 0.25), 0.5, Unseen::position, 0, -1));
  CHECK(is(at(3.1 + 3 * cell - 3 * kTurn, 0.01, 0.25), 0.5, Unseen::position, 0, -1));
  CHECK(is(at(3.1 - 4 * cell, 0.01, 0.25), 1, Unseen::position, 0, -1));
  CHECK(is(at(3.1, 0.01 + 3 * cell, 0.25), 0.5, Unseen::position, 1, -1));
  CHECK(is(at(3.1, 0.01, 0.25 + 3.0 / 64), 0.5, Unseen::position, 2, -1));
  CHECK(is(at(3.1, 0.01, 99), 1, Unseen::position, 2, -1));  // a sliding joint has ends
  CHECK(is(at(3.1, 0.01, -99), 1, Unseen::position, 2, -1));
}

void pairs_detect_untrained_combinations_of_positions() {
  CoverageSettings s = blank(4, 1);
  const double apart[] = {-2, -2, 0.25}, again[] = {2, 2, 0.25};
  s.see(apart);
  s.see(again);
  CHECK(is(evaluate(s, {{-2, -2, 0.25}, {}}), 0, Unseen::nothing, -1, -1));
  CHECK(is(evaluate(s, {{-2, 2, 0.25}, {}}), 1, Unseen::positions, 0, 1));
  CHECK(is(evaluate(s, {{2, -2 + kTurn / 32, 0.25}, {}}), 1, Unseen::positions, 0, 1));
  CHECK(is(evaluate(s, {{-2, -2 + kTurn / 32, 0.25}, {}}), 0, Unseen::nothing, -1, -1));
  CHECK(is(evaluate(s, {{-2, -2 + 2 * kTurn / 32, 0.25}, {}}), 0.5, Unseen::positions, 0, 1));
  CHECK(is(evaluate(s, {{-2, -2 + 2 * kTurn / 32, 9}, {}}), 1, Unseen::position, 2, -1));  // first in order
  s.reach[2] = 0;  // alone it is not checked
  CHECK(is(evaluate(s, {{-2, -2, 9}, {}}), 1, Unseen::positions, 0, 2));
}

void speeds_count_by_their_share_over_the_fastest() {
  CoverageSettings s = blank(0, 0);
  CHECK(is(evaluate(s, {{0, 0, 0}, {2, -1, 0.5}}), 0, Unseen::nothing, -1, -1));
  CHECK(is(evaluate(s, {{0, 0, 0}, {2, -1.06, 0.5}}), 0.24, Unseen::speed, 1, -1));
  CHECK(is(evaluate(s, {{0, 0, 0}, {-3, 1.06, 0.5}}), 1, Unseen::speed, 0, -1));
}

void ties_are_reported_in_the_order_of_speeds_positions_and_pairs() {
  CoverageSettings s = blank(2, 2);
  const double seen[] = {-2, -2, 0.25};
  s.see(seen);
  CHECK(is(evaluate(s, {{1, -2, 0.25}, {0, 9, 0}}), 1, Unseen::speed, 1, -1));
  CHECK(is(evaluate(s, {{1, -2, 0.25}, {0, 0, 0}}), 1, Unseen::position, 0, -1));
}

void what_was_unfamiliar_fades_as_the_residual_forgets_it() {
  CoverageSettings s = blank(0, 0);
  Coverage coverage(3, s, kFades);
  const double q[3] = {}, fast[3] = {4, 0, 0}, faster[3] = {2.1, 0, 0}, slow[3] = {};
  std::int64_t t_ns = 5 * kMs;
  CHECK(is(coverage.step(t_ns, q, slow), 0, Unseen::nothing, -1, -1));
  CHECK(is(coverage.step(t_ns += kMs, q, fast), 1, Unseen::speed, 0, -1));
  const Coverage::State kept = coverage.state();
  for (int k = 1; k <= 80; ++k)
    CHECK(is(coverage.step(t_ns += kMs, q, slow), std::exp(-kFades * 1e-3 * k), Unseen::speed, 0, -1));
  CHECK(is(coverage.step(t_ns += kMs, q, faster), 0.2, Unseen::speed, 0, -1));  // 0.05 / 0.25
  // Steps of any length, and from a state that was kept; what is below a hundredth is gone.
  coverage.restore(kept);
  CHECK(is(coverage.step(6 * kMs + 40 * kMs, q, slow), std::exp(-0.8), Unseen::speed, 0, -1));
  CHECK(is(coverage.step(6 * kMs + 240 * kMs, q, slow), 0, Unseen::nothing, -1, -1));
  coverage.restore(kept);
  coverage.reset();
  CHECK(is(coverage.step(7 * kMs, q, slow), 0, Unseen::nothing, -1, -1));
}

// The shares are those of a twin that measures the way to every sample that was seen.
void shares_are_those_of_the_nearest_seen_cells() {
  std::mt19937_64 rng(2);
  std::uniform_real_distribution<double> angle(-10, 10), place(-0.2, 0.7);
  for (const auto& [reach, together] : {std::pair{2, 3}, {16, 16}, {1, 1}, {0, 5}, {3, 0}}) {
    CoverageSettings s = blank(static_cast<std::uint8_t>(reach), static_cast<std::uint8_t>(together));
    std::vector<Pose> seen;
    for (int k = 0; k < 6; ++k) {
      seen.push_back({{angle(rng), angle(rng), place(rng)}, {}});
      s.see(seen.back().q);
    }
    const Coverage coverage(3, s, kFades);
    for (int k = 0; k < 500; ++k) {
      const Pose pose{{angle(rng), angle(rng), place(rng)}, {}};
      double share = 0;
      const auto count = [&](int within, auto apart) {
        int nearest = 64;
        for (const Pose& one : seen) nearest = std::min(nearest, apart(one));
        if (within > 0) share = std::max(share, std::clamp((nearest - within) / 2.0, 0.0, 1.0));
      };
      for (std::size_t j = 0; j < 3; ++j)
        count(reach, [&](const Pose& one) { return cells_apart(s, j, one.q[j], pose.q[j], 64); });
      for (std::size_t i = 0; i < 3; ++i)
        for (std::size_t j = i + 1; j < 3; ++j)
          count(together, [&](const Pose& one) {
            return std::max(cells_apart(s, i, one.q[i], pose.q[i], 32), cells_apart(s, j, one.q[j], pose.q[j], 32));
          });
      CHECK_CLOSE(coverage.evaluate(pose.q, pose.dq).share, share, 1e-12);
    }
  }
}

// Whatever finite numbers come: the share is one, and the tables are never left (the sanitizers watch that).
void any_finite_numbers_have_a_share() {
  CoverageSettings s = blank(3, 2);
  s.span_rad = {1e-9, 1e9, 1e-9};
  s.fastest_rad_s = {1e-9, 1e9, 1.0};
  std::mt19937_64 rng(1);
  std::uniform_real_distribution<double> exponent(-320, 308), sign(-1, 1);
  const auto any = [&] { return std::copysign(std::pow(10.0, exponent(rng)), sign(rng)); };
  for (int k = 0; k < 20; ++k) {
    const double q[] = {any(), any(), any()};
    s.see(q);
  }
  const Coverage coverage(3, s, kFades);
  for (int k = 0; k < 20'000; ++k) {
    const double q[] = {any(), any(), any()}, dq[] = {any(), any(), any()};
    const double share = coverage.evaluate(q, dq).share;
    CHECK(share >= 0 && share <= 1);
  }
  const double largest = std::numeric_limits<double>::max(), q[3] = {largest, -largest, largest}, dq[3] = {};
  CHECK(coverage.evaluate(q, dq).share >= 0);
}

void settings_that_do_not_fit_are_named() {
  const auto broken = [](auto change) {
    CoverageSettings s = blank(4, 2);
    change(s);
    CHECK_THROWS(s.validate(3), Error);
  };
  blank(4, 2).validate(3);
  blank(0, 0).validate(3);
  CoverageSettings{}.validate(3);
  CHECK_THROWS(blank(4, 2).validate(2), Error);
  broken([](CoverageSettings& s) { s.fastest_rad_s[1] = 0; });
  broken([](CoverageSettings& s) { s.fastest_rad_s[1] = std::nan(""); });
  broken([](CoverageSettings& s) { s.span_rad[1] = -1; });
  broken([](CoverageSettings& s) { s.centre_rad[1] = std::nan(""); });
  broken([](CoverageSettings& s) { s.turns[1] = 2; });
  broken([](CoverageSettings& s) { s.reach[2] = 17; });
  broken([](CoverageSettings& s) { s.reach_together = 17; });
  broken([](CoverageSettings& s) { s.seen.pop_back(); });
  broken([](CoverageSettings& s) { s.seen_together.push_back(0); });
  broken([](CoverageSettings& s) { s.reach_together = 0; });
  broken([](CoverageSettings& s) { s.fastest_rad_s.clear(); });
}

}  // namespace

int main() {
  without_training_motion_nothing_is_unfamiliar();
  positions_count_by_cells_from_seen_ones_also_round_the_turn();
  pairs_detect_untrained_combinations_of_positions();
  speeds_count_by_their_share_over_the_fastest();
  ties_are_reported_in_the_order_of_speeds_positions_and_pairs();
  what_was_unfamiliar_fades_as_the_residual_forgets_it();
  shares_are_those_of_the_nearest_seen_cells();
  any_finite_numbers_have_a_share();
  settings_that_do_not_fit_are_named();
  return check::result();
}
