// Time of ranking links and of locating touches, over poses and touches by chance, with given and with guessed shapes; one
// JSON object on stdout.
//   touch_place_bench [joints 7] [calls 2000]
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <string>
#include <vector>

#include "force_bundle.hpp"
#include "tauext/touch_place.hpp"

namespace {


// Prints the times and returns a sum of the results.
double time(const tauext::Bundle& bundle, const std::string& shapes, int calls) {
  const auto n = static_cast<std::size_t>(bundle.joints());
  tauext::PlaceModel model(bundle);
  std::mt19937 random(1);
  std::uniform_real_distribution<double> pose(-2, 2);
  std::normal_distribution<double> torque(0, 5);
  std::vector<double> q(n), tau(n), sigma(n, 0.5), ranking, locating;
  tauext::TouchPlaces told;
  double sum = 0;
  using clock = std::chrono::steady_clock;
  const auto ns = [](clock::time_point from, clock::time_point to) { return std::chrono::duration<double, std::nano>(to - from).count(); };
  for (int k = 0; k < calls; ++k) {
    for (double& x : q) x = pose(random);
    for (double& x : tau) x = torque(random);
    const auto start = clock::now();
    model.rank(q, tau, sigma, {}, told);
    const auto ranked = clock::now();
    model.locate(told);
    ranking.push_back(ns(start, ranked));
    locating.push_back(ns(ranked, clock::now()));
    sum += told.probability[0] + told.place[0].point[0];
  }
  made::print_quantiles((shapes + "_rank").c_str(), ranking);
  made::print_quantiles((shapes + "_locate").c_str(), locating);
  return sum;
}

}  // namespace

int main(int argc, char** argv) {
  const int joints = argc > 1 ? std::atoi(argv[1]) : 7, calls = argc > 2 ? std::atoi(argv[2]) : 2'000;
  tauext::Bundle bundle = made::force_bundle(joints);
  std::printf("{\"joints\": %d", joints);
  double sum = time(bundle, "guessed", calls);
  for (int link = 0; link < joints; ++link) bundle.capsules.push_back({link, {}, {0, 0, 0.3}, 0.05});
  sum += time(bundle, "given", calls);
  std::printf("}\n");
  return sum == sum ? 0 : 1;
}
