// Time of ranking links and of locating touches, over poses and touches by chance; one JSON object on stdout.
//   touch_place_bench [joints 7] [calls 2000]
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "force_bundle.hpp"
#include "tauext/touch_place.hpp"

int main(int argc, char** argv) {
  const int joints = argc > 1 ? std::atoi(argv[1]) : 7, calls = argc > 2 ? std::atoi(argv[2]) : 2'000;
  const auto n = static_cast<std::size_t>(joints);
  tauext::PlaceModel model(made::force_bundle(joints));
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
  std::printf("{\"joints\": %d", joints);
  made::print_quantiles("rank", ranking);
  made::print_quantiles("locate", locating);
  std::printf("}\n");
  return sum == sum ? 0 : 1;
}
