#include "tauext/tree.hpp"

#include <cmath>
#include <cstdlib>
#include <limits>
#include <new>
#include <random>

#include "check.hpp"
#include "momentum_of.hpp"

using namespace tauext;

namespace {
int allocations = 0;
}

void* operator new(std::size_t bytes) {
  ++allocations;
  if (void* memory = std::malloc(bytes)) return memory;
  throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

namespace {

constexpr double kGravity = 9.81;
constexpr double kQuarterTurn[] = {1, 0, 0, 0, 0, -1, 0, 1, 0};  // about x: the link's z is the parent's -y

Link make_link(const std::string& name, int parent, JointType type, double mass, std::array<double, 3> com) {
  Link link;
  link.joint_name = name;
  link.parent = parent;
  link.type = type;
  link.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  link.mass = mass;
  link.com = com;
  return link;
}

// Two links in the x-y plane, gravity along -y, the second joint 0.3 m out on the first link.
std::vector<Link> planar_links() {
  std::vector<Link> links{make_link("shoulder", -1, JointType::revolute, 8.191, {0.12079, 0, 0}),
                          make_link("elbow", 0, JointType::revolute, 9.920, {0.16078, 0, 0})};
  links[1].translation = {0.3, 0, 0};
  links[0].inertia = {0.05, 0.06, 0.07, 0.001, 0.002, 0.003};
  links[1].inertia = {0.04, 0.05, 0.08, 0.001, 0.002, 0.003};
  links[0].rotor_inertia = 0.6;
  links[1].rotor_inertia = 0.3;
  return links;
}

void two_links_in_a_plane_follow_their_closed_form() {
  const Tree tree(planar_links(), {0, -kGravity, 0});
  std::mt19937 random(1);
  std::uniform_real_distribution<double> uniform(-3, 3);
  for (int k = 0; k < 100; ++k) {
    const double q1 = uniform(random), q2 = uniform(random), w1 = uniform(random), w2 = uniform(random);
    const double m1 = 8.191, m2 = 9.920, c1 = 0.12079, c2 = 0.16078, l = 0.3;
    const double coupling = m2 * l * c2 * std::cos(q2), distal = 0.08 + m2 * c2 * c2;
    const double m11 = 0.07 + m1 * c1 * c1 + m2 * l * l + distal + 2 * coupling + 0.6, m12 = distal + coupling;
    const Momentum a = momentum_of(tree, {q1, q2}, {w1, w2});
    CHECK_CLOSE(a.p[0], m11 * w1 + m12 * w2, 1e-13);
    CHECK_CLOSE(a.p[1], m12 * w1 + (distal + 0.3) * w2, 1e-13);
    const double outer = m2 * c2 * kGravity * std::cos(q1 + q2);
    CHECK_CLOSE(a.beta[0], (m1 * c1 + m2 * l) * kGravity * std::cos(q1) + outer, 1e-12);
    CHECK_CLOSE(a.beta[1], m2 * l * c2 * std::sin(q2) * w1 * (w1 + w2) + outer, 1e-12);
  }
}

void a_vertical_slide_feels_its_weight_and_that_of_what_it_carries() {
  std::vector<Link> links{make_link("lift", -1, JointType::prismatic, 3, {0.1, 0.2, 0.3}),
                          make_link("turn", 0, JointType::revolute, 2, {0, 0, 0.4})};
  links[0].rotor_inertia = 5;
  const Momentum a = momentum_of(Tree(links, {0, 0, -kGravity}), {0.7, 0.2}, {1.5, 0});
  CHECK_CLOSE(a.p[0], (3 + 2 + 5) * 1.5, 1e-14);
  CHECK_CLOSE(a.beta[0], (3 + 2) * kGravity, 1e-14);
  CHECK_CLOSE(a.p[1], 0, 1e-14);
  CHECK_CLOSE(a.beta[1], 0, 1e-14);
}

void a_mass_sliding_on_a_turning_arm_feels_the_centrifugal_force() {
  std::vector<Link> links{make_link("turn", -1, JointType::revolute, 0, {}),
                          make_link("slide", 0, JointType::prismatic, 2, {})};
  links[1].rotation = {0, 0, 1, 0, 1, 0, -1, 0, 0};  // the slide's z is the arm's x
  const Momentum a = momentum_of(Tree(links, {0, 0, 0}), {0.4, 0.5}, {3, 0.7});
  CHECK_CLOSE(a.p[0], 2 * 0.5 * 0.5 * 3, 1e-14);
  CHECK_CLOSE(a.p[1], 2 * 0.7, 1e-14);
  CHECK_CLOSE(a.beta[0], 0, 1e-14);
  CHECK_CLOSE(a.beta[1], -2 * 0.5 * 9, 1e-14);  // -dL/dx of L = m x^2 w^2 / 2
}

void links_may_have_any_order() {
  std::vector<Link> links = planar_links();
  links.push_back(make_link("wrist", 1, JointType::revolute, 1.5, {0.1, 0.02, 0.03}));
  std::copy(std::begin(kQuarterTurn), std::end(kQuarterTurn), links[2].rotation.begin());
  links.push_back(make_link("second arm", 0, JointType::prismatic, 1.2, {0.05, 0, 0.1}));
  const int order[] = {3, 2, 0, 1};  // new index -> old index
  const int place[] = {2, 3, 1, 0};
  std::vector<Link> shuffled;
  for (int old : order) {
    shuffled.push_back(links[old]);
    if (shuffled.back().parent >= 0) shuffled.back().parent = place[shuffled.back().parent];
  }
  const JointVector q{0.3, -0.8, 1.1, 0.2}, dq{1, -2, 0.5, 0.3};
  JointVector shuffled_q{}, shuffled_dq{};
  for (int i = 0; i < 4; ++i) {
    shuffled_q[i] = q[order[i]];
    shuffled_dq[i] = dq[order[i]];
  }
  const Momentum a = momentum_of(Tree(links, {1, -9, 2}), q, dq);
  const Momentum b = momentum_of(Tree(shuffled, {1, -9, 2}), shuffled_q, shuffled_dq);
  for (int i = 0; i < 4; ++i) {
    CHECK_CLOSE(b.p[i], a.p[order[i]], 1e-13);
    CHECK_CLOSE(b.beta[i], a.beta[order[i]], 1e-13);
  }
}

void no_model_gives_zero_and_a_faulty_state_no_number() {
  std::vector<Link> links = planar_links();
  const Momentum faulty = momentum_of(Tree(links, {0, -kGravity, 0}), {std::nan(""), 0}, {1, 1});
  CHECK(std::isnan(faulty.beta[0]));
  for (Link& link : links) {
    link.mass = link.rotor_inertia = 0;
    link.inertia = {};
  }
  const Momentum a = momentum_of(Tree(links, {0, -kGravity, 0}), {0.3, 0.4}, {1, 2});
  CHECK(a.p[0] == 0 && a.p[1] == 0 && a.beta[0] == 0 && a.beta[1] == 0);
}

void the_sweep_does_not_allocate() {
  allocations = 0;
  const Tree tree(planar_links(), {0, -kGravity, 0});
  CHECK(allocations > 0);  // the counter counts
  allocations = 0;
  momentum_of(tree, {0.3, 0.4}, {1, 2});
  CHECK(allocations == 0);
}

void bad_links_are_refused() {
  const auto refused = [](auto&& change) {
    std::vector<Link> links = planar_links();
    change(links);
    CHECK_THROWS(Tree(links, {0, 0, -kGravity}), Error);
  };
  refused([](auto& links) { links.clear(); });
  refused([](auto& links) { links.resize(kMaxJoints + 1, links[1]); });
  refused([](auto& links) { links[1].parent = 2; });
  refused([](auto& links) { links[1].parent = -2; });
  refused([](auto& links) { links[1].parent = 1; });  // its own parent
  refused([](auto& links) { links[0].parent = 1; });  // a ring of two
  refused([](auto& links) { links[1].mass = -1; });
  refused([](auto& links) { links[1].rotor_inertia = -1; });
  refused([](auto& links) { links[1].com[2] = std::nan(""); });
  refused([](auto& links) { links[1].inertia[5] = std::numeric_limits<double>::infinity(); });
  refused([](auto& links) { links[1].mass = 1e308; });  // finite, and no torque of it is
  refused([](auto& links) { links[1].translation[0] = -2e9; });
  refused([](auto& links) { links[1].rotation[0] = 0.999; });
  refused([](auto& links) { links[1].rotation = {1, 0, 0, 0, 1, 0, 0, 0, -1}; });  // a reflection
  refused([](auto& links) { links[1].rotation[1] = 1e-8; });                       // a shear
  refused([](auto& links) { links[1].type = static_cast<JointType>(7); });
  CHECK_THROWS(Tree(planar_links(), {0, 0, std::nan("")}), Error);
}

}  // namespace

int main() {
  two_links_in_a_plane_follow_their_closed_form();
  a_vertical_slide_feels_its_weight_and_that_of_what_it_carries();
  a_mass_sliding_on_a_turning_arm_feels_the_centrifugal_force();
  links_may_have_any_order();
  no_model_gives_zero_and_a_faulty_state_no_number();
  the_sweep_does_not_allocate();
  bad_links_are_refused();
  return check::result();
}
