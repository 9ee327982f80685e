// Time of one sweep (p and beta) of a 7-axis arm: median, extremes and 99th percentile over batches of random states.
//   tree_bench [states a batch 4096] [batches 301]
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "tauext/tree.hpp"

namespace {

// A 17 kg arm of 0.85 m reach with quarter turns between its axes, offset centres of mass and full inertia tensors.
tauext::Tree seven_axis_arm() {
  constexpr double kMass[] = {3.7, 3.2, 3.4, 3.1, 2.2, 1.6, 0.9};
  constexpr double kAlong[] = {0.333, 0.0, 0.316, 0.083, 0.384, 0.0, 0.107};
  std::mt19937 random(7);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  std::vector<tauext::Link> links(7);
  for (int i = 0; i < 7; ++i) {
    tauext::Link& link = links[i];
    link.joint_name = "joint" + std::to_string(i + 1);
    link.parent = i - 1;
    if (i == 0)
      link.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    else if (i % 2)
      link.rotation = {1, 0, 0, 0, 0, 1, 0, -1, 0};
    else
      link.rotation = {1, 0, 0, 0, 0, -1, 0, 1, 0};
    link.translation = {i == 3 ? 0.0825 : 0.0, i % 2 ? kAlong[i] : 0.0, i % 2 ? 0.0 : kAlong[i]};
    link.mass = kMass[i];
    for (double& c : link.com) c = 0.08 * uniform(random);
    const double size = 0.01 * link.mass;
    link.inertia = {size, 1.1 * size, 0.6 * size, 0.1 * size * uniform(random), 0.1 * size * uniform(random),
                    0.1 * size * uniform(random)};
    link.rotor_inertia = 0.4 / (i + 1);
  }
  return {links, {0, 0, -9.81}};
}

}  // namespace

int main(int argc, char** argv) {
  const int states = argc > 1 ? std::atoi(argv[1]) : 4096, batches = argc > 2 ? std::atoi(argv[2]) : 301;
  const tauext::Tree arm = seven_axis_arm();
  const std::size_t n = arm.size();
  std::mt19937 random(1);
  std::uniform_real_distribution<double> position(-3.0, 3.0), speed(-2.0, 2.0);
  std::vector<double> q(states * n), dq(states * n), p(states * n), beta(states * n), ns;
  for (double& x : q) x = position(random);
  for (double& x : dq) x = speed(random);

  for (int batch = -3; batch < batches; ++batch) {  // the first three warm up
    const auto start = std::chrono::steady_clock::now();
    for (int k = 0; k < states; ++k) {
      const std::size_t at = k * n;
      arm.momentum({&q[at], n}, {&dq[at], n}, {&p[at], n}, {&beta[at], n});
    }
    const std::chrono::duration<double, std::nano> time = std::chrono::steady_clock::now() - start;
    if (batch >= 0) ns.push_back(time.count() / states);
  }
  std::sort(ns.begin(), ns.end());
  double sum = 0;
  for (std::size_t k = 0; k < p.size(); ++k) sum += p[k] + beta[k];
  std::printf("sweep of a 7-axis arm, %d batches of %d states: median %.0f ns, min %.0f, p99 %.0f, max %.0f (sum %.6g)\n",
              batches, states, ns[ns.size() / 2], ns[0], ns[ns.size() * 99 / 100], ns.back(), sum);
}
