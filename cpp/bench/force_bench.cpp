// Time of a wrench and of a force alone at the last link, of ranking links and of locating touches with given and with
// guessed shapes, over poses and touches by chance; one JSON object on stdout.
//   force_bench [joints 7] [wrenches 200000] [touches 2000]
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <string>
#include <vector>

#include "../tests/made_bundle.hpp"
#include "tauext/touch_place.hpp"
#include "tauext/wrench.hpp"

namespace {

using Clock = std::chrono::steady_clock;

double ns_since(Clock::time_point start) { return std::chrono::duration<double, std::nano>(Clock::now() - start).count(); }

// A member of the JSON object on stdout.
void print_quantiles(const std::string& name, std::vector<double>& ns) {
  std::ranges::sort(ns);
  const auto at = [&](double share) { return ns[static_cast<std::size_t>(share * static_cast<double>(ns.size() - 1))]; };
  std::printf(", \"%s_ns\": {\"p50\": %.0f, \"p99\": %.0f, \"p99_9\": %.0f}", name.c_str(), at(0.5), at(0.99), at(0.999));
}

// Poses and torques by chance.
struct Chance {
  std::mt19937 random{1};
  std::uniform_real_distribution<double> pose{-2, 2};
  std::normal_distribution<double> torque{0, 5};
  std::vector<double> q, dq, tau, sigma;
  explicit Chance(int joints) : q(joints), dq(joints, 0.1), tau(joints), sigma(joints, 0.5) {}
  void draw() {
    for (double& x : q) x = pose(random);
    for (double& x : tau) x = torque(random);
  }
};

// Each prints its times and returns a sum of its results, which is no number if one of them is none.
double time_wrenches(const tauext::Bundle& bundle, bool alone, int calls) {
  const tauext::WrenchModel model(bundle);
  Chance c(bundle.joints());
  std::vector<double> ns;
  double sum = 0;
  for (int k = 0; k < calls; ++k) {
    c.draw();
    const auto start = Clock::now();
    const auto axes = tauext::WrenchAxes::base;
    const int last = bundle.joints() - 1;
    const tauext::Wrench w = alone ? model.force(last, {0, 0, 0.1}, c.q, c.tau, c.sigma, axes, {}, c.dq)
                                   : model.wrench(last, c.q, c.tau, c.sigma, axes, {}, c.dq);
    ns.push_back(ns_since(start));
    sum += w.force[0];
  }
  print_quantiles(alone ? "force" : "wrench", ns);
  return sum;
}

double time_places(const tauext::Bundle& bundle, const std::string& shapes, int calls) {
  tauext::PlaceModel model(bundle);
  Chance c(bundle.joints());
  std::vector<double> ranking, locating;
  tauext::TouchPlaces told;
  double sum = 0;
  for (int k = 0; k < calls; ++k) {
    c.draw();
    auto start = Clock::now();
    model.rank(c.q, c.tau, c.sigma, {}, told);
    ranking.push_back(ns_since(start));
    start = Clock::now();
    model.locate(told);
    locating.push_back(ns_since(start));
    sum += told.probability[0] + told.place[0].point[0];
  }
  print_quantiles(shapes + "_rank", ranking);
  print_quantiles(shapes + "_locate", locating);
  return sum;
}

}  // namespace

int main(int argc, char** argv) {
  const auto argument = [&](int at, int otherwise) { return argc > at ? std::atoi(argv[at]) : otherwise; };
  const int joints = argument(1, 7), wrenches = argument(2, 200'000), touches = argument(3, 2'000);
  tauext::Bundle bundle = made::force_bundle(joints);
  std::printf("{\"joints\": %d", joints);
  double sum = time_wrenches(bundle, false, wrenches) + time_wrenches(bundle, true, wrenches);
  sum += time_places(bundle, "guessed", touches);
  for (int link = 0; link < joints; ++link) bundle.capsules.push_back({link, {}, {0, 0, 0.3}, 0.05});
  sum += time_places(bundle, "given", touches);
  std::printf("}\n");
  return sum == sum ? 0 : 1;
}
