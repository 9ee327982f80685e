// A bundle and a smooth motion for tests, fuzz seeds and benchmarks: an arm of any size with a random network. Its
// numbers mean nothing; its chain is complete.
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "stages/estimates.hpp"
#include "tauext/bundle.hpp"

namespace made {

inline constexpr std::int64_t kPeriodNs = 1'000'000;

// Sample k of a motion: a sine for each joint, with its true velocity and a torque that goes with neither.
inline void signal(std::int64_t k, int joints, double* q, double* dq, double* tau) {
  const double t = 1e-3 * static_cast<double>(k);
  for (int j = 0; j < joints; ++j) {
    const double speed = 1.5 + 0.37 * (j % 7), size = 0.8 / (1 + 0.1 * j), phase = 0.9 * j;
    q[j] = size * std::sin(speed * t + phase);
    dq[j] = size * speed * std::cos(speed * t + phase);
    tau[j] = 6.0 / (1 + j) * std::sin(0.7 * t + 0.4 * j) + 2.0 * dq[j];
  }
}

// A chain of 1 to 32 revolute joints, its axes alternating, sampled at 1 kHz, with a window of window_steps network
// steps of `stride` samples; hidden = 0 makes the plain observer. The reference fills one window.
inline tauext::Bundle bundle(int joints, int hidden, int window_steps, int stride, unsigned seed) {
  tauext::Bundle b;
  b.name = "made";
  b.provenance = "{}";
  const auto n = static_cast<std::size_t>(joints);
  for (int i = 0; i < joints; ++i) {
    tauext::Link link;
    link.joint_name = "joint" + std::to_string(i + 1);
    link.parent = i - 1;
    if (i % 2 == 0)
      link.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    else
      link.rotation = {1, 0, 0, 0, 0, -1, 0, 1, 0};  // a quarter turn about x
    link.translation = {i ? 0.3 / (1 + 0.2 * i) : 0.0, 0.01 * i, 0.02};
    link.mass = 0.5 + 4.0 / (1 + i);
    link.com = {0.1 / (1 + 0.3 * i), 0.02, 0.001 * i};
    const double inertia = 0.1 / (1 + i);
    link.inertia = {inertia, 1.1 * inertia, 0.9 * inertia, 0.01 * inertia, 0, 0};
    link.rotor_inertia = 0.1 + 0.01 * i;
    b.links.push_back(link);
  }
  b.gravity = {0, -9.81, 0};
  b.observer = {20.0, tauext::TorqueTiming::held, kPeriodNs, stride};
  b.window_steps = window_steps;
  if (hidden > 0) {
    for (int column = 0; column < 2 * joints; ++column) b.inputs.push_back({column, 0});
    for (int column = joints; column < 2 * joints; ++column) b.inputs.push_back({column, 1});
    for (int column = 0; column < 2 * joints; ++column)
      b.input_factors.push_back(0.3f + 0.1f * static_cast<float>(column % 5));
    b.shape = {3 * joints, hidden, joints};
    std::mt19937 random(seed);
    std::normal_distribution<float> normal(0, 0.4f);
    for (std::size_t k = 0; k < b.shape.parameter_count(); ++k) b.parameters.push_back(normal(random));
    for (int j = 0; j < joints; ++j) b.output_scale_nm.push_back(10.0 / (1 + j));
  }
  b.limits.near_stiction_rad_s = 0.02;
  for (tauext::Level* level : {&b.limits.collision, &b.limits.contact})
    level->sliding_nm = level->near_stiction_nm = std::vector<double>(n, 1.0);
  b.limits.collision.hold_s = 0.01;
  b.limits.contact_release_s = 0.1;
  b.signals.torque_limit_nm.assign(n, std::numeric_limits<double>::infinity());
  b.signals.largest_torque_nm.assign(n, 100.0);
  b.signals.possible_torque_nm.assign(n, std::numeric_limits<double>::infinity());
  b.signals.possible_speed_rad_s.assign(n, std::numeric_limits<double>::infinity());
  b.assume_load();
  const auto append = [&](tauext::Reference& to, int k) {
    double q[tauext::kMaxJoints], dq[tauext::kMaxJoints], tau[tauext::kMaxJoints];
    signal(k, joints, q, dq, tau);
    to.t_ns.push_back(k * kPeriodNs);
    to.q.insert(to.q.end(), q, q + n);
    to.dq.insert(to.dq.end(), dq, dq + n);
    to.tau.insert(to.tau.end(), tau, tau + n);
  };
  for (int k = 0; k <= window_steps * stride; ++k) append(b.reference, k);  // a step more than the window, for the lag
  tauext::answer_reference(b);

  // Limits that the motion is over now and then.
  tauext::Reference motion;
  const int samples = 3000 + window_steps * stride;
  for (int k = 0; k < samples; ++k) append(motion, k);
  const tauext::Estimates answer = tauext::estimate(
      b, {samples, joints, motion.t_ns.data(), motion.q.data(), motion.dq.data(), motion.tau.data()}, 1);
  for (std::size_t j = 0; j < n; ++j) {
    double largest = 0;
    for (std::size_t at = j; at < answer.tau_ext.size(); at += n)
      if (std::fabs(answer.tau_ext[at]) > largest) largest = std::fabs(answer.tau_ext[at]);
    for (tauext::Level* level : {&b.limits.collision, &b.limits.contact}) {
      level->sliding_nm[j] = 0.97 * largest;
      level->near_stiction_nm[j] = 0.99 * largest;
    }
  }
  return b;
}

// An arm without a network whose joints have an error scale of 1 N m, and errors that correlate by 0.2.
inline tauext::Bundle force_bundle(int joints) {
  tauext::Bundle bundle = made::bundle(joints, 0, 30, 10, 1);
  const auto n = static_cast<std::size_t>(joints);
  bundle.error_scale.features = {tauext::MotionFeature::constant};
  bundle.error_scale.limit_weights = bundle.error_scale.sigma_weights = bundle.error_scale.sigma_near_weights =
      bundle.error_scale.largest = bundle.error_scale.largest_sigma = std::vector<double>(n, 1.0);
  bundle.wrench.correlation.assign(n * n, 0.2);
  for (std::size_t j = 0; j < n; ++j) bundle.wrench.correlation[j * n + j] = 1;
  return bundle;
}

}  // namespace made
