#include "chain/load_regressor.hpp"

#include <cmath>
#include <random>

#include "check.hpp"
#include "momentum_of.hpp"

using namespace tauext;

namespace {

constexpr std::array<double, 9> kTurned = {0, -1, 0, 1, 0, 0, 0, 0, 1};      // about z
constexpr std::array<double, 9> kQuarterTurn = {1, 0, 0, 0, 0, -1, 0, 1, 0};  // about x

// Branched, with a slide in the chain of the load, links out of order.
std::vector<Link> arm() {
  std::vector<Link> links(5);
  const int parents[] = {2, 0, -1, 2, 1};
  std::mt19937 random(4);
  std::uniform_real_distribution<double> uniform(-0.5, 0.5);
  for (std::size_t k = 0; k < links.size(); ++k) {
    Link& link = links[k];
    link.joint_name = "joint" + std::to_string(k);
    link.parent = parents[k];
    link.type = k == 1 ? JointType::prismatic : JointType::revolute;
    link.rotation = k % 2 ? kQuarterTurn : kTurned;
    for (double& x : link.translation) x = uniform(random);
    for (double& x : link.com) x = uniform(random);
    link.mass = 2 + uniform(random);
    link.inertia = {0.05, 0.06, 0.07, 0.001, 0.002, 0.003};
    link.rotor_inertia = 0.2;
  }
  return links;
}

// Its mass, first moment and inertia, about the frame's origin.
std::array<double, LoadRegressor::kParameters> parameters(const Load& load) {
  const auto& [x, y, z] = load.com;
  const double m = load.mass;
  const auto& i = load.inertia;
  return {m, m * x, m * y, m * z,
          i[0] + m * (y * y + z * z), i[1] + m * (x * x + z * z), i[2] + m * (x * x + y * y),
          i[3] - m * x * y, i[4] - m * x * z, i[5] - m * y * z};
}

void columns_are_what_a_load_adds_to_p_and_beta() {
  const Tree tree(arm(), {1.0, -2.0, -9.0});
  const Load body{1.7, {0.03, -0.05, 0.11}, {0.004, 0.005, 0.006, 0.0003, -0.0002, 0.0001}};
  const auto phi = parameters(body);
  std::mt19937 random(1);
  std::uniform_real_distribution<double> uniform(-2, 2);
  for (const LoadFrame& frame : {LoadFrame{4, kQuarterTurn, {0.1, 0.2, -0.3}}, LoadFrame{4, kTurned, {}},
                                 LoadFrame{3, kQuarterTurn, {0, 0, 0.1}}, LoadFrame{2, kTurned, {0.4, 0, 0}}}) {
    const Tree loaded(with_fixed_body(arm(), frame, body), tree.gravity());
    LoadRegressor regressor(tree, frame);
    for (int trial = 0; trial < 50; ++trial) {
      JointVector q{}, dq{};
      for (std::size_t j = 0; j < 5; ++j) q[j] = uniform(random), dq[j] = uniform(random);
      const Momentum with = momentum_of(loaded, q, dq), without = momentum_of(tree, q, dq);
      regressor.compute({q.data(), 5}, {dq.data(), 5});
      for (std::size_t j = 0; j < 5; ++j) {
        double p = 0, beta = 0;
        for (std::size_t k = 0; k < phi.size(); ++k) {
          p += regressor.momentum()[k][j] * phi[k];
          beta += regressor.beta()[k][j] * phi[k];
        }
        CHECK_CLOSE(p, with.p[j] - without.p[j], 1e-12);
        CHECK_CLOSE(beta, with.beta[j] - without.beta[j], 1e-11);
      }
    }
  }
}

// At rest a weight is a force along gravity: beta of a mass is minus the torque of it.
void a_mass_at_the_origin_weighs_what_a_force_along_gravity_pulls() {
  const Tree tree(arm(), {1.0, -2.0, -9.0});
  const LoadFrame frame{4, kQuarterTurn, {0.1, 0.2, -0.3}};
  LoadRegressor regressor(tree, frame);
  const JointVector q{0.3, 0.4, -1.2, 0.7, 0.9}, dq{};
  regressor.compute({q.data(), 5}, {dq.data(), 5});
  for (std::size_t j = 0; j < 5; ++j) {
    const double torque = regressor.base_forces()[0][j] - 2 * regressor.base_forces()[1][j] -
                          9 * regressor.base_forces()[2][j];
    CHECK_CLOSE(regressor.beta()[0][j], -torque, 1e-13);
  }
}

// The force's direction is the frame's own: its part along the base's axes turns with the arm.
void forces_along_frame_and_base_are_one_force_turned() {
  std::vector<Link> links(1);
  links[0].joint_name = "turn";
  links[0].rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  const Tree tree(links, {0, 0, -9.81});
  LoadRegressor regressor(tree, {0, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {0.5, 0, 0}});
  const double q = 0.7, dq = 0;
  regressor.compute({&q, 1}, {&dq, 1});
  CHECK_CLOSE(regressor.frame_forces()[0][0], 0, 1e-15);
  CHECK_CLOSE(regressor.frame_forces()[1][0], 0.5, 1e-15);
  CHECK_CLOSE(regressor.base_forces()[0][0], -0.5 * std::sin(q), 1e-15);
  CHECK_CLOSE(regressor.base_forces()[1][0], 0.5 * std::cos(q), 1e-15);
}

void what_is_no_frame_of_the_arm_is_refused() {
  const Tree tree(arm(), {0, 0, -9.81});
  CHECK_THROWS(LoadRegressor(tree, LoadFrame{}), Error);
  CHECK_THROWS(LoadRegressor(tree, LoadFrame{5}), Error);
  CHECK_THROWS(LoadRegressor(tree, LoadFrame{0, {1, 0, 0, 0, 1, 0, 0, 0, -1}, {}}), Error);
  CHECK_THROWS(LoadRegressor(tree, LoadFrame{0, kTurned, {std::nan(""), 0, 0}}), Error);
}

}  // namespace

int main() {
  columns_are_what_a_load_adds_to_p_and_beta();
  a_mass_at_the_origin_weighs_what_a_force_along_gravity_pulls();
  forces_along_frame_and_base_are_one_force_turned();
  what_is_no_frame_of_the_arm_is_refused();
  return check::result();
}
