// Time of a wrench and of a force alone at the last link, over poses by chance; one JSON object on stdout.
//   wrench_bench [joints 7] [calls 200000]
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "force_bundle.hpp"
#include "tauext/wrench.hpp"

int main(int argc, char** argv) {
  const int joints = argc > 1 ? std::atoi(argv[1]) : 7, calls = argc > 2 ? std::atoi(argv[2]) : 200'000;
  const auto n = static_cast<std::size_t>(joints);
  const tauext::WrenchModel model(made::force_bundle(joints));
  std::mt19937 random(1);
  std::uniform_real_distribution<double> pose(-2, 2);
  std::normal_distribution<double> torque(0, 5);
  std::vector<double> q(n), dq(n, 0.1), tau(n), sigma(n, 0.5);
  std::printf("{\"joints\": %d", joints);
  for (const bool alone : {false, true}) {
    std::vector<double> ns;
    double sum = 0;
    for (int k = 0; k < calls; ++k) {
      for (double& x : q) x = pose(random);
      for (double& x : tau) x = torque(random);
      const auto start = std::chrono::steady_clock::now();
      const auto axes = tauext::WrenchAxes::base;
      const tauext::Wrench w = alone ? model.force(joints - 1, {0, 0, 0.1}, q, tau, sigma, axes, {}, dq)
                                     : model.wrench(joints - 1, q, tau, sigma, axes, {}, dq);
      ns.push_back(std::chrono::duration<double, std::nano>(std::chrono::steady_clock::now() - start).count());
      sum += w.force[0];
    }
    made::print_quantiles(alone ? "force" : "wrench", ns);
    if (!(sum == sum)) return 1;
  }
  std::printf("}\n");
}
