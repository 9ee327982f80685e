// The made motion as samples one by one and as a recording, and that a monitor gives the same on both.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <span>
#include <vector>

#include "check.hpp"
#include "made_bundle.hpp"
#include "tauext/monitor.hpp"

namespace made {

inline constexpr std::int64_t kMs = 1'000'000;

struct Signals {
  int joints;
  std::vector<std::int64_t> t_ns;
  std::vector<double> q, dq, tau;

  std::int64_t samples() const { return static_cast<std::int64_t>(t_ns.size()); }
  tauext::Sample at(std::int64_t k) const {
    const auto n = static_cast<std::size_t>(joints), from = static_cast<std::size_t>(k) * n;
    return {t_ns[static_cast<std::size_t>(k)], std::span(q).subspan(from, n), std::span(dq).subspan(from, n),
            std::span(tau).subspan(from, n)};
  }
  tauext::RecordingView view() const { return from(0); }
  // Without the samples before k.
  tauext::RecordingView from(std::int64_t k) const {
    const std::int64_t cell = k * joints;
    return {samples() - k, joints, t_ns.data() + k, q.data() + cell, dq.data() + cell, tau.data() + cell};
  }
};

// The made motion, sampled at these times.
inline Signals sampled(int joints, const std::vector<std::int64_t>& t_ns) {
  Signals s{joints, t_ns, {}, {}, {}};
  for (std::int64_t t : t_ns) {
    double q[tauext::kMaxJoints], dq[tauext::kMaxJoints], tau[tauext::kMaxJoints];
    made::signal(t / kMs, joints, q, dq, tau);
    s.q.insert(s.q.end(), q, q + joints);
    s.dq.insert(s.dq.end(), dq, dq + joints);
    s.tau.insert(s.tau.end(), tau, tau + joints);
  }
  return s;
}

// Jittering stamps, bridged gaps of one to ten ticks, and some gaps that restart.
inline Signals irregular(int joints, std::size_t samples) {
  std::mt19937 random(5);
  std::vector<std::int64_t> t_ns{12345};
  while (t_ns.size() < samples) {
    const auto draw = random() % 400;
    std::int64_t step = kMs - 100'000 + static_cast<std::int64_t>(random() % 200'000);
    if (draw < 6) step += static_cast<std::int64_t>(1 + random() % 10) * kMs;
    if (draw == 399 && t_ns.size() % 3 == 0) step += 50 * kMs;
    t_ns.push_back(t_ns.back() + step);
  }
  return sampled(joints, t_ns);
}

inline bool same(double a, double b) { return a == b || (std::isnan(a) && std::isnan(b)); }

struct Replayed {
  int healthy = 0, detections = 0;
};

// Steps a new monitor through the recording: every estimate must equal the offline one to the last bit.
// also(estimate, joint, index of sample and joint) checks what only some bundles have.
template <class Also>
Replayed online_equals_offline(tauext::Monitor& monitor, const Signals& s, const tauext::Estimates& offline, Also also) {
  Replayed counts;
  for (std::int64_t k = 0; k < s.samples(); ++k) {
    const tauext::Estimate& e = monitor.step(s.at(k));
    const auto row = static_cast<std::size_t>(k);
    CHECK(static_cast<std::uint8_t>(e.health) == offline.health[row] && e.causes == offline.causes[row]);
    CHECK(e.detection == (offline.detection[row] == 1));
    counts.healthy += e.health == tauext::Health::ok;
    counts.detections += e.detection;
    for (std::size_t j = 0; j < static_cast<std::size_t>(s.joints); ++j) {
      const std::size_t at = row * static_cast<std::size_t>(s.joints) + j;
      CHECK(e.residual[j] == offline.residual[at]);
      CHECK(same(e.tau_ext[j], offline.tau_ext[at]));
      CHECK(e.limit_nm[j] == offline.limit_nm[at]);
      CHECK((e.near_stiction >> j & 1) == offline.near_stiction[at]);
      also(e, j, at);
    }
  }
  return counts;
}

// As if training had seen the first 0.2 s of the made motion, and none that is quite as fast.
inline tauext::CoverageSettings half_seen(int joints) {
  tauext::CoverageSettings s;
  const auto n = static_cast<std::size_t>(joints);
  double q[tauext::kMaxJoints], dq[tauext::kMaxJoints], tau[tauext::kMaxJoints];
  s.turns.assign(n, 1);
  s.centre_rad.assign(n, 0);
  s.span_rad.assign(n, 2);  // a turn here, so that the motion is of many cells
  s.seen.assign(n, 0);
  for (std::size_t j = 0; j < n; ++j) s.reach.push_back(j + 1 < n ? 2 : 0);  // the last joint counts in pairs only
  s.reach_together = 1;
  s.seen_together.assign(n * (n - 1) / 2 * tauext::CoverageSettings::kPairCells, 0);
  s.fastest_rad_s.assign(n, 1e-3);
  for (int k = 0; k < 200; ++k) {
    made::signal(k, joints, q, dq, tau);
    s.see({q, n});
    for (std::size_t j = 0; j < n; ++j) s.fastest_rad_s[j] = std::max(s.fastest_rad_s[j], 0.9 * std::fabs(dq[j]));
  }
  return s;
}

}  // namespace made
