// The force within a cone is the best one, and a monitor's alarm uses only what no declared contact explains.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "alarm/contact_errors.hpp"
#include "check.hpp"
#include "made_bundle.hpp"
#include "made_signals.hpp"
#include "tauext/monitor.hpp"
#include "touch/cone_fit.hpp"
#include "touch/declared_contacts.hpp"

using namespace tauext;

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN(), kInf = std::numeric_limits<double>::infinity();

double length(Vector3 v) { return std::sqrt(dot(v, v)); }

// A problem of random columns, as of `rows` joints, and the cost of a solution of it without the constant.
struct Problem {
  std::vector<std::array<double, 6>> columns;
  std::vector<double> torque;
  WrenchEquations equations;

  Problem(std::mt19937& random, int rows) {
    std::normal_distribution<double> normal;
    for (int j = 0; j < rows; ++j) {
      std::array<double, 6> one;
      for (std::size_t i = 0; i < 6; ++i) one[i] = normal(random) * (i < 3 ? 1.0 : 3.0);
      columns.push_back(one);
      torque.push_back(10 * normal(random));
      const Vector3 f{one[0], one[1], one[2]}, m{one[3], one[4], one[5]};
      Symmetric3* square[] = {&equations.force, &equations.moment};
      const Vector3 part[] = {f, m};
      for (int k = 0; k < 2; ++k) {
        const Vector3 v = part[k];
        square[k]->xx += v.x * v.x, square[k]->yy += v.y * v.y, square[k]->zz += v.z * v.z;
        square[k]->xy += v.x * v.y, square[k]->xz += v.x * v.z, square[k]->yz += v.y * v.z;
      }
      equations.mixed[0] = equations.mixed[0] + f.x * m;
      equations.mixed[1] = equations.mixed[1] + f.y * m;
      equations.mixed[2] = equations.mixed[2] + f.z * m;
      equations.force_seen = equations.force_seen + torque.back() * f;
      equations.moment_seen = equations.moment_seen + torque.back() * m;
    }
  }
  double cost(Vector3 f, Vector3 m) const {
    double sum = 0;
    for (std::size_t j = 0; j < columns.size(); ++j) {
      const auto& c = columns[j];
      const double left = torque[j] - c[0] * f.x - c[1] * f.y - c[2] * f.z - c[3] * m.x - c[4] * m.y - c[5] * m.z;
      sum += left * left / 2;
    }
    return sum;
  }
};

// Projection onto a cone of this half angle, then onto the ball: onto both, since the cone's tip is the ball's middle.
Vector3 projected(Vector3 f, const ForceCone& cone) {
  if (!cone.any()) {
    const double along = dot(f, cone.axis);
    const Vector3 across = f - along * cone.axis;
    const double aside = length(across);
    if (along * cone.cosine + aside * cone.sine <= 0 && !(along > 0 && cone.holds(f))) {
      f = {0, 0, 0};
    } else if (!cone.holds(f)) {
      const double size = along * cone.cosine + aside * cone.sine;
      f = size * (cone.cosine * cone.axis + (aside > 0 ? cone.sine / aside : 0.0) * across);
    }
  }
  const double size = length(f);
  return size > cone.most_n ? cone.most_n / size * f : f;
}

// The slow way: projected gradient steps with momentum, far beyond convergence.
std::pair<Vector3, Vector3> slowly(const Problem& p, const ForceCone& cone, double most_nm) {
  double steep = 0;
  for (const auto& c : p.columns)
    for (double value : c) steep += value * value;
  Vector3 f{0, 0, 0}, m{0, 0, 0}, at_f = f, at_m = m;
  for (int k = 1; k <= 4000; ++k) {
    Vector3 df{0, 0, 0}, dm{0, 0, 0};
    for (std::size_t j = 0; j < p.columns.size(); ++j) {
      const auto& c = p.columns[j];
      const double left = p.torque[j] - c[0] * at_f.x - c[1] * at_f.y - c[2] * at_f.z - c[3] * at_m.x - c[4] * at_m.y - c[5] * at_m.z;
      df = df + left * Vector3{c[0], c[1], c[2]};
      dm = dm + left * Vector3{c[3], c[4], c[5]};
    }
    const Vector3 f_before = f, m_before = m;
    f = projected(at_f + (1 / steep) * df, cone);
    m = at_m + (1 / steep) * dm;
    if (const double size = length(m); size > most_nm) m = most_nm > 0 ? most_nm / size * m : Vector3{0, 0, 0};
    const double speed = (k % 200) / (k % 200 + 3.0);  // restarted, so that it cannot circle
    at_f = f + speed * (f - f_before);
    at_m = m + speed * (m - m_before);
  }
  return {f, m};
}

void the_force_is_the_best_of_its_cone() {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  for (int k = 0; k < 120; ++k) {
    const Problem problem(random, 4 + k % 4);
    ForceCone cone;
    const double half_angle = k % 3 == 0 ? 0.0 : (k % 3 == 1 ? 0.5 : kPi / 2);
    const Vector3 axis{normal(random), normal(random), normal(random)};
    if (k % 5 != 4) cone = {1 / length(axis) * axis, std::cos(half_angle), k % 3 ? std::sin(half_angle) : 0.0, 0};
    cone.most_n = k % 2 ? 2.0 : 50.0;
    const double most_nm = k % 4 < 2 ? 0.0 : (k % 4 == 2 ? 0.3 : 30.0);
    const ConeFit fit = fit_cone(problem.equations, cone, most_nm);
    CHECK(length(fit.force) <= cone.most_n * (1 + 1e-9) && length(fit.moment) <= most_nm * (1 + 1e-9));
    CHECK(length(fit.force) < 1e-9 || (cone.any() ? true : dot(fit.force, cone.axis) >= cone.cosine * length(fit.force) - 1e-9 * cone.most_n));
    const auto [f, m] = slowly(problem, cone, most_nm);
    // Exact up to the ridge and the angle's grid; the bound of the moment is met within 1 %.
    const double slow = problem.cost(f, m), none = problem.cost({0, 0, 0}, {0, 0, 0});
    CHECK_CLOSE(problem.cost(fit.force, fit.moment), slow, (most_nm > 0 ? 5e-3 : 2e-5) * none);
  }
}

// --- A monitor.

struct Watch {
  Bundle bundle;
  Monitor monitor;
  made::Signals signals;
  std::int64_t k = 0;

  explicit Watch(int joints = 7, double limit_nm = 3)
      : bundle(limited(joints, limit_nm)), monitor(bundle), signals(made::sampled(joints, times())) {}

  static Bundle limited(int joints, double limit_nm) {
    Bundle b = made::force_bundle(joints);
    for (Level* level : {&b.limits.collision, &b.limits.contact})
      level->sliding_nm = level->near_stiction_nm = std::vector<double>(static_cast<std::size_t>(joints), limit_nm);
    b.error_scale.sigma_weights = b.error_scale.sigma_near_weights = b.error_scale.largest_sigma = std::vector<double>(static_cast<std::size_t>(joints), 0.2);
    b.gravity = {0, -9.81, 0};
    return b;
  }
  static std::vector<std::int64_t> times() {
    std::vector<std::int64_t> t_ns;
    for (std::int64_t at = 0; at < 20000; ++at) t_ns.push_back(at * made::kMs);
    return t_ns;
  }
};

// A stage of declared contacts alone, with torques that are given: tau_ext = F^T w + more.
struct Alone {
  Bundle bundle;
  WrenchModel model;
  ContactErrors errors;
  DeclaredContacts contacts;
  Estimate e;
  JointVector spread{};
  std::int64_t t_ns = 0;

  explicit Alone(int joints = 7, Bundle made = {}) : bundle(made.links.empty() ? Watch::limited(joints, 3) : std::move(made)), model(bundle), errors(bundle), contacts(bundle, model) {
    e.joints = joints;
  }
  // One sample; force in the base's axes at the contact's point, resting for long enough that the filter has settled.
  bool step(const std::vector<double>& q, int frame, const std::array<double, 3>& point, Vector3 force, Vector3 moment = {0, 0, 0},
            int hit_joint = -1, double hit_nm = 0) {
    const auto n = static_cast<std::size_t>(e.joints);
    std::array<double, 6 * kMaxJoints> columns;
    model.columns(frame, q, point, WrenchAxes::base, columns);
    for (std::size_t j = 0; j < n; ++j) {
      e.tau_ext[j] = dot({columns[j], columns[n + j], columns[2 * n + j]}, force) +
                     dot({columns[3 * n + j], columns[4 * n + j], columns[5 * n + j]}, moment) + (static_cast<int>(j) == hit_joint ? hit_nm : 0);
      e.sigma_nm[j] = 0.2;
      e.load_nm[j] = e.declared_nm[j] = 0;
    }
    e.declared = Declared::none;
    e.declared_contact = -1;
    spread = {};
    Observed o;
    o.t_ns = t_ns += made::kMs;
    o.judged = true;
    contacts.explain_joints(o, q, errors, e);
    return contacts.explain_frame(o, q, errors, true, e, spread);
  }
  double left(int joint) const { return e.tau_ext[static_cast<std::size_t>(joint)] - e.declared_nm[static_cast<std::size_t>(joint)]; }
  double most_left() const {
    double most = 0;
    for (int j = 0; j < e.joints; ++j) most = std::max(most, std::fabs(left(j)));
    return most;
  }
};

const std::vector<double> kPose{0.3, -0.5, 0.8, 1.1, -0.4, 0.9, 0.2};

DeclaredContact press(double most_n = 30, double half_angle_rad = 0.5) {
  DeclaredContact c;
  c.frame = 6;
  c.point = {0.02, 0.01, 0.1};
  c.axis = {0, 0, 2};
  c.axes = WrenchAxes::base;
  c.half_angle_rad = half_angle_rad;
  c.at_most_n = most_n;
  return c;
}

void what_is_declared_is_explained_and_nothing_else() {
  Alone a;
  const DeclaredContact contact = press();
  CHECK(a.contacts.start(contact, kAlways_s) == 0);
  CHECK(a.step(kPose, 6, contact.point, {3, 2, 20}));  // inside the cone
  CHECK(a.e.declared == Declared::within && a.e.declared_contact == 0);
  CHECK_CLOSE(a.e.declared_size, std::sqrt(413.0), 0.01);
  CHECK(a.most_left() < 0.01);
  CHECK(a.e.declared_sigma > 0 && a.e.declared_sigma < 20);
  for (int j = 0; j < 7; ++j) CHECK(a.spread[static_cast<std::size_t>(j)] > 0);

  // A hit on an earlier link is left over, mostly: the three directions of the force take a share of it.
  a.step(kPose, 6, contact.point, {3, 2, 20}, {0, 0, 0}, 1, 8);
  CHECK(std::fabs(a.left(1)) > 2);
  // A pull against the cone is not explained, nor a force aside.
  CHECK(!a.step(kPose, 6, contact.point, {0, 0, -20}));
  for (int j = 0; j < 7; ++j) CHECK_CLOSE(a.e.declared_nm[static_cast<std::size_t>(j)], 0, 1e-9);
  a.step(kPose, 6, contact.point, {20, 0, 0.1});
  CHECK(a.most_left() > 1);
  // Beyond its size: the rest is left over, and said.
  a.step(kPose, 6, contact.point, {0, 0, 60});
  CHECK(a.e.declared == Declared::beyond);
  CHECK_CLOSE(a.e.declared_size, 60, 0.1);
  Alone half;
  half.contacts.start(contact, kAlways_s);
  half.step(kPose, 6, contact.point, {0, 0, 30});
  for (int j = 0; j < 7; ++j)  // explained is a force of at most 30 N
    CHECK(std::fabs(a.e.declared_nm[static_cast<std::size_t>(j)]) < 1.5 * std::fabs(half.e.declared_nm[static_cast<std::size_t>(j)]) + 1);
  CHECK(a.most_left() > 1);
}

void a_moment_is_explained_only_where_it_is_declared() {
  Alone a;
  DeclaredContact contact = press(30, 0);
  CHECK(a.contacts.start(contact, kAlways_s) == 0);
  a.step(kPose, 6, contact.point, {0, 0, 20}, {0, 1.5, 0});
  const double without = a.most_left();
  contact.at_most_nm = 2;
  CHECK(a.contacts.start(contact, kAlways_s) == 1);  // the newer one counts
  a.step(kPose, 6, contact.point, {0, 0, 20}, {0, 1.5, 0});
  CHECK(a.e.declared_contact == 1 && a.most_left() < 0.02 && without > 0.2);
  CHECK_CLOSE(a.e.declared_moment_nm, 1.5, 0.02);
  a.step(kPose, 6, contact.point, {0, 0, 20}, {0, 30, 0});
  CHECK(a.e.declared == Declared::beyond);
}

// The Jacobian passes the observer's filter, as r does: a constant force is explained while the arm moves fast.
void a_constant_force_is_explained_in_motion() {
  Alone a;
  const DeclaredContact contact = press();
  const auto n = std::size_t{7};
  CHECK(a.contacts.start(contact, kAlways_s) == 0);
  JointVector r{};
  double most = 0, plain = 0;
  const double kept = std::exp(-a.bundle.observer.gain_per_s * 1e-3);
  for (int k = 0; k < 2000; ++k) {
    std::vector<double> q = kPose, dq(n);
    for (std::size_t j = 0; j < n; ++j) q[j] += 0.5 * std::sin(3e-3 * k + static_cast<double>(j));
    std::array<double, 6 * kMaxJoints> columns;
    a.model.columns(6, q, contact.point, WrenchAxes::base, columns);
    const Vector3 force{1, 2, 20};
    std::array<double, kMaxJoints> now;
    for (std::size_t j = 0; j < n; ++j) {
      now[j] = dot({columns[j], columns[n + j], columns[2 * n + j]}, force);
      r[j] = k == 0 ? now[j] : r[j] + (1 - kept) * (now[j] - r[j]);
    }
    for (std::size_t j = 0; j < n; ++j) {
      a.e.tau_ext[j] = r[j];
      a.e.sigma_nm[j] = 0.2;
      a.e.declared_nm[j] = a.e.load_nm[j] = 0;
    }
    Observed o;
    o.t_ns = a.t_ns += made::kMs;
    o.judged = true;
    a.contacts.explain_joints(o, q, a.errors, a.e);
    a.contacts.explain_frame(o, q, a.errors, true, a.e, a.spread);
    if (k < 300) continue;
    most = std::max(most, a.most_left());
    for (std::size_t j = 0; j < n; ++j) plain = std::max(plain, std::fabs(r[j] - now[j]));
  }
  CHECK(most < 1e-3 && plain > 0.3);  // without the filter the force could not explain this lag
}

void a_joint_has_a_contact_of_its_own() {
  Alone a;
  DeclaredContact grip;
  grip.joint = 6;
  grip.at_most_nm = 1.5;
  CHECK(a.contacts.start(grip, kAlways_s) == 0);
  a.step(kPose, 6, {}, {0, 0, 0}, {0, 0, 0}, 6, -1.2);
  CHECK(a.left(6) == 0 && a.e.declared == Declared::within && a.spread[6] > 0);
  CHECK_CLOSE(a.e.declared_size, 1.2, 1e-12);
  a.step(kPose, 6, {}, {0, 0, 0}, {0, 0, 0}, 6, -4);
  CHECK_CLOSE(a.left(6), -2.5, 1e-12);
  CHECK(a.e.declared == Declared::beyond);
  a.step(kPose, 6, {}, {0, 0, 0}, {0, 0, 0}, 3, 5);
  CHECK_CLOSE(a.left(3), 5, 1e-12);
  grip.axis = {1, 0, 0};  // one sign only
  CHECK(a.contacts.end(0) && !a.contacts.end(0));
  CHECK(a.contacts.start(grip, kAlways_s) == 0);
  a.step(kPose, 6, {}, {0, 0, 0}, {0, 0, 0}, 6, -1.2);
  CHECK_CLOSE(a.left(6), -1.2, 1e-12);
  // Beside a contact at a frame, which explains the rest.
  CHECK(a.contacts.start(press(), kAlways_s) == 1);
  a.step(kPose, 6, press().point, {0, 0, 15}, {0, 0, 0});
  CHECK(a.e.declared_contact == 1);
  CHECK(a.most_left() < 0.5);
}

void time_box_and_travel_end_it() {
  Alone a;
  const DeclaredContact contact = press();
  const double lasts_s = DeclaredContacts::kForgotten / a.bundle.observer.gain_per_s;
  CHECK(a.contacts.start(contact, 0.1) == 0);
  int explained = 0;
  for (int k = 0; k < 1000; ++k) {
    a.step(kPose, 6, contact.point, {0, 0, 10});
    explained += a.e.declared == Declared::within;
  }
  CHECK(explained == 1 + 100 + static_cast<int>(std::round(1000 * lasts_s)));  // as long as r holds it, too
  CHECK(!a.contacts.any() && !a.contacts.in_effect() && a.left(1) == a.e.tau_ext[1]);

  DeclaredContact boxed = contact;
  boxed.boxed = true;
  const auto origin = a.model.pose(6, kPose).origin;
  for (std::size_t i = 0; i < 3; ++i) {
    boxed.lowest_m[i] = origin[i] - 0.01;
    boxed.highest_m[i] = origin[i] + 0.01;
  }
  CHECK(a.contacts.start(boxed, kAlways_s) == 0);
  std::vector<double> away = kPose;
  away[0] += 1;
  a.step(away, 6, contact.point, {0, 0, 10});
  CHECK(a.e.declared == Declared::none && a.contacts.any() && !a.contacts.in_effect());
  a.step(kPose, 6, contact.point, {0, 0, 10});
  CHECK(a.e.declared == Declared::within);
  for (int k = 0; k < 300; ++k) a.step(away, 6, contact.point, {0, 0, 10});
  CHECK(a.e.declared == Declared::none);
  a.step(kPose, 6, contact.point, {0, 0, 10});
  CHECK(a.contacts.in_effect() && a.contacts.end(0) && !a.contacts.in_effect());  // a refit learns again

  // The wall gives way: the tool goes along the axis by more than declared.
  DeclaredContact short_way = contact;
  short_way.at_most_travel_m = 0.02;
  CHECK(a.contacts.start(short_way, kAlways_s) == 0);
  const double from = a.model.pose(6, kPose).origin[2];
  std::vector<double> q = kPose;
  for (int k = 0; k < 400 && a.e.declared != Declared::moved; ++k) {
    a.step(q, 6, contact.point, {0, 0, 10});
    q[1] += 1e-3;
  }
  CHECK(a.e.declared == Declared::moved && a.left(1) == a.e.tau_ext[1]);
  CHECK_CLOSE(std::fabs(a.e.declared_travel_m), 0.02, 2e-3);
  CHECK(std::fabs(a.model.pose(6, q).origin[2] - from) > 0.005);
  a.step(q, 6, contact.point, {0, 0, 0});  // the force has gone
  a.step(q, 6, contact.point, {0, 0, 10});
  CHECK(a.e.declared == Declared::within);
}

// While the arm stands in a contact, what a joint hides becomes the standing rest, up to its friction, even where no force is
// seen: with the rest's time constant up to half a limit, and by a share of the friction in a second beyond. A joint that slides
// hides nothing, nor does one that rests while another moves.
void a_joint_that_stands_hides_its_friction() {
  Bundle bundle = Watch::limited(7, 0.5);
  const double friction = 2, half_limit = 0.25, per_s = DeclaredContacts::kFrees * friction;
  const double slow_from = std::max(half_limit, per_s * DeclaredContacts::kStandsS);  // left, above which the bound counts
  bundle.prior.terms = {{TermKind::coulomb, 2, 0, 0, 0, 0.001}};
  bundle.prior.weights = {0, 0, friction, 0, 0, 0, 0};
  const DeclaredContact line = press(30, 0);
  const auto step = [&](Alone& a, double nm) { a.step(kPose, 6, line.point, {0, 0, 0}, {0, 0, 0}, 2, nm); };
  Alone probe(7, bundle);
  CHECK(probe.contacts.start(line, kAlways_s) == 0);
  step(probe, 1);
  const double sign = probe.e.declared_nm[2] == 0 ? 1 : -1;  // the line explains no torque of this sign
  for (const std::uint32_t resting : {0x7fu, 0x7bu, 0x6fu})  // all joints; all but the third; all but the fifth
    for (const double hidden : {0.2, 1.6, 5.0}) {
      Alone a(7, bundle);
      a.e.near_stiction = resting;
      std::fill_n(a.e.limit_nm.begin(), 7, 2 * half_limit);
      CHECK(a.contacts.start(line, kAlways_s) == 0);
      for (int k = 0; k < 600; ++k) step(a, 0);
      for (int k = 1; k <= 6000; ++k) {
        step(a, sign * hidden);
        const double left = sign * a.left(2);
        if (resting != 0x7fu) CHECK_CLOSE(left, hidden, 1e-9);
        else if (hidden < half_limit) CHECK_CLOSE(left, hidden * std::exp(-1e-3 * k / DeclaredContacts::kStandsS), 1e-6);
        else if (hidden - 1e-3 * k * per_s > slow_from || hidden - friction > slow_from)
          CHECK_CLOSE(left, hidden - std::min(1e-3 * k * per_s, friction), 1e-6);
        else CHECK(left < slow_from + 1e-6);
      }
      step(a, 0);  // it is gone at once
      CHECK_CLOSE(a.left(2), 0, 1e-9);
    }
}

void bad_contacts_are_refused() {
  Watch w;
  const Monitor& m = w.monitor;
  const auto refused = [&](const char* part, const auto& change, double seconds = 1, const Monitor* by = nullptr) {
    DeclaredContact contact = press();
    change(contact);
    Monitor& monitor = by ? const_cast<Monitor&>(*by) : w.monitor;
    const std::string why = monitor.why_no_contact(contact, seconds);
    CHECK(why.find(part) != std::string::npos);
    if (why.find(part) == std::string::npos) std::printf("'%s' instead of '%s'\n", why.c_str(), part);
    CHECK(monitor.expect_contact(contact, seconds) == -1);
  };
  CHECK(m.why_no_contact(press(), 1).empty());
  refused("one frame of the bundle", [](DeclaredContact& c) { c.frame = 99; });
  refused("one frame of the bundle", [](DeclaredContact& c) { c.joint = 2; });
  refused("one frame of the bundle", [](DeclaredContact& c) { c.frame = -1; });
  for (double bad : {kNan, kInf}) {
    refused("finite", [&](DeclaredContact& c) { c.at_most_n = bad; });
    refused("finite", [&](DeclaredContact& c) { c.at_most_nm = bad; });
    refused("finite", [&](DeclaredContact& c) { c.point[1] = bad; });
    refused("finite", [&](DeclaredContact& c) { c.axis[2] = bad; });
    refused("finite", [&](DeclaredContact& c) { c.half_angle_rad = bad; });
    refused("finite", [&](DeclaredContact& c) { c.boxed = true, c.lowest_m[0] = bad; });
  }
  refused("finite", [](DeclaredContact&) {}, kNan);
  refused("pi/2", [](DeclaredContact& c) { c.half_angle_rad = 1.6; });
  refused("pi/2", [](DeclaredContact& c) { c.half_angle_rad = -0.1; });
  refused("pi/2", [](DeclaredContact& c) { c.axis = {}; });  // no axis, but an angle
  refused("above 0", [](DeclaredContact& c) { c.at_most_n = 0; });
  refused("above 0", [](DeclaredContact& c) { c.at_most_n = -3; });
  refused("above 0", [](DeclaredContact& c) { c.frame = -1, c.joint = 2; });  // a joint has no force
  refused("at_most_travel", [](DeclaredContact& c) { c.at_most_travel_m = 0; });
  refused("box", [](DeclaredContact& c) { c.boxed = true; });
  refused("0 s must be above 0", [](DeclaredContact&) {}, 0);
  refused("any torque of the joints before it", [](DeclaredContact& c) { c.frame = 2; });  // three joints, three directions
  const Monitor two(Watch::limited(2, 3));
  refused("any torque", [](DeclaredContact& c) { c.frame = 1; }, 1, &two);
  DeclaredContact line = press(30, 0);
  line.frame = 1;
  line.axis = {1, 1, 0};  // the second joint moves in a plane of its own
  CHECK(two.why_no_contact(line, 1).empty());
  const Monitor blind(made::bundle(7, 0, 30, 10, 1));  // no standard errors
  refused("error scale", [](DeclaredContact&) {}, 1, &blind);
  DeclaredContact grip;
  grip.joint = 1;
  grip.at_most_nm = 1;
  CHECK(blind.why_no_contact(grip, 1).empty());
  for (int k = 0; k < kMostContacts; ++k) {
    DeclaredContact other = press(1 + k);
    CHECK(w.monitor.expect_contact(other, 1) == k);
  }
  CHECK(w.monitor.expect_contact(press(3), 5) == 2);  // declared already: it starts again
  refused("at most 8", [](DeclaredContact& c) { c.at_most_n = 99; });
  refused("at most 8", [](DeclaredContact& c) { c.frame = -1, c.joint = 2, c.at_most_n = 0, c.at_most_nm = 1; });
  CHECK(w.monitor.declared_contact(2)->at_most_n == 3 && !w.monitor.declared_contact(8) && !w.monitor.declared_contact(-1));
  w.monitor.reset();
  CHECK(!w.monitor.declared_contact(2));
}

// A contact that admits whatever the arm can exert would hide everything, so it is refused: by its force, its moment, or its lever.
void a_contact_admits_less_than_the_drives_can_exert() {
  Bundle bundle = Watch::limited(7, 3);
  bundle.signals.torque_limit_nm = {87, 87, 87, 87, 12, 12, 12};
  bundle.signals.largest_torque_nm = {40, 60, 30, 30, 4, 20, 2};  // joint 6 passed its limit: that is no limit
  bundle.signals.possible_torque_nm = {174, 174, 174, 174, 24, 200, 24};
  Monitor monitor(bundle);
  const auto why = [&](const DeclaredContact& contact) {
    const std::string reason = monitor.why_no_contact(contact, 1);
    CHECK(reason.empty() == (monitor.contact_fault(contact, 1) == ContactFault::none));
    CHECK(reason.empty() || reason.find("must be below") != std::string::npos);
    CHECK(reason.empty() || (monitor.expect_contact(contact, 1) == -1 && monitor.unmonitored(contact).empty()));
    return reason;
  };
  const double most_nm[] = {87, 87, 87, 87, 12, 200, 12};
  for (int j = 0; j < 7; ++j) {
    DeclaredContact own;
    own.joint = j;
    for (const double at_most : {most_nm[j], 1e6, 1e300}) {
      own.at_most_nm = at_most;
      CHECK(!why(own).empty());
    }
    own.at_most_nm = 0.99 * most_nm[j];
    CHECK(why(own).empty());
  }
  for (const double half_angle : {0.0, 0.5}) {
    CHECK(why(press(30, half_angle)).empty());
    for (const double at_most : {1e4, 1e6, 1e300}) CHECK(!why(press(at_most, half_angle)).empty());
    for (const double far_m : {1e3, 1e9, 1e300}) {
      DeclaredContact far = press(30, half_angle);
      far.point = {far_m, far_m, 0};
      CHECK(!why(far).empty());
    }
  }
  DeclaredContact turned = press(30, 0.5);
  for (const double at_most : {5.0, 250.0, 1e6, 1e300}) {
    turned.at_most_nm = at_most;
    CHECK(why(turned).empty() == (at_most < 10));
  }
  // Beyond the bound, the drives hold the force in few poses and directions; a tenth of it in most.
  double bound = 1;
  while (why(press(1.02 * bound, 0.5)).empty()) bound *= 1.02;
  const WrenchModel model(bundle);
  std::mt19937 random(5);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> turn(-3, 3);
  int held = 0, held_tenth = 0;
  for (int k = 0; k < 2000; ++k) {
    std::vector<double> q(7);
    for (double& one : q) one = turn(random);
    std::array<double, 6 * kMaxJoints> columns;
    model.columns(6, q, press().point, WrenchAxes::base, columns);
    Vector3 u{normal(random), normal(random), normal(random)};
    u = 1 / length(u) * u;
    double most_n = kInf;
    for (std::size_t j = 0; j < 7; ++j)
      most_n = std::min(most_n, most_nm[j] / std::fabs(dot(u, {columns[j], columns[7 + j], columns[14 + j]})));
    held += most_n > bound;
    held_tenth += most_n > bound / 10;
  }
  CHECK(held < 100 && held_tenth > 1000);
  if (!(held < 100 && held_tenth > 1000)) std::printf("bound %g N: held in %d, a tenth in %d\n", bound, held, held_tenth);
}

void what_is_hidden_is_stated() {
  const Watch w;
  CHECK(w.monitor.unmonitored(press()).empty());
  DeclaredContact all = press();
  all.axis = {};
  all.half_angle_rad = 0;
  all.at_most_nm = 2;
  CHECK(w.monitor.why_no_contact(all, 1).empty());  // six directions of seven joints
  const std::string said = w.monitor.unmonitored(all);
  CHECK(said.find("joint7") != std::string::npos && said.find("joint2") == std::string::npos);
  DeclaredContact grip;
  grip.joint = 2;
  grip.at_most_nm = 1.5;
  CHECK(w.monitor.unmonitored(grip) == "within its bound of 1.5 N m, nothing is monitored on joint 'joint3' meanwhile");
  Bundle mixed = Watch::limited(7, 3);
  mixed.units.given = TorqueUnit::ampere;
  mixed.observer.unknown_constant = {0, 0, 0, 0, 1, 0, 0};
  mixed.observer.nm_per_unit = std::vector<double>(7, 1.0);
  answer_reference(mixed);
  const Monitor amperes(mixed);
  CHECK(amperes.unmonitored(press()).find("not in N m: joint5") != std::string::npos);
}

// A monitor that restores a state goes on alike, to the last bit; the margin is that of what is left.
void a_monitor_keeps_what_is_declared() {
  Watch w;
  for (; w.k < 2000; ++w.k) w.monitor.step(w.signals.at(w.k));
  CHECK(w.monitor.expect_contact(press(), 10) == 0);
  for (; w.k < 2100; ++w.k) w.monitor.step(w.signals.at(w.k));
  std::vector<std::byte> state(w.monitor.state_bytes());
  CHECK(w.monitor.save_state(state));
  Monitor other(w.bundle);
  CHECK(other.restore_state(state));
  for (int k = 0; k < 500; ++k, ++w.k) {
    const Sample sample = w.signals.at(w.k);
    const Estimate& a = w.monitor.step(sample);
    const Estimate& b = other.step(sample);
    bool same = a.declared == b.declared && a.declared_size == b.declared_size && a.alarm == b.alarm;
    for (std::size_t j = 0; j < 7; ++j) same = same && a.declared_nm[j] == b.declared_nm[j] && a.limit_nm[j] == b.limit_nm[j];
    CHECK(same && a.declared != Declared::none);
    for (std::size_t j = 0; j < 7; ++j)
      CHECK_CLOSE(a.margin_nm[j], a.limit_nm[j] - std::fabs(a.tau_ext[j] - a.declared_nm[j]), 1e-12);
  }
}

// The tool's force with its parts by cause: their squares sum to the variance along the force.
void the_tool_force_has_its_errors_by_cause() {
  Watch w;
  for (; w.k < 2000; ++w.k) w.monitor.step(w.signals.at(w.k));
  CHECK(w.monitor.tool_force().frame == w.monitor.wrench_model().find(w.monitor.load_settings().frame));
  for (const double half_angle : {0.0, 0.5}) {
    const DeclaredContact contact = press(30, half_angle);
    const int which = w.monitor.expect_contact(contact, 10);
    w.monitor.step(w.signals.at(w.k++));
    const ToolForce tool = w.monitor.tool_force();
    CHECK(tool.declared && tool.frame == 6 && tool.wrench.known);
    const Vector3 f{tool.wrench.force[0], tool.wrench.force[1], tool.wrench.force[2]}, u = 1 / length(f) * f;
    if (half_angle == 0) CHECK(std::fabs(f.x) + std::fabs(f.y) < 1e-9 * std::fabs(f.z));  // along the line
    double variance = 0;
    for (std::size_t i = 0; i < 3; ++i)
      for (std::size_t k = 0; k < 3; ++k) variance += (i == 0 ? u.x : i == 1 ? u.y : u.z) * tool.wrench.covariance[3 * i + k] * (k == 0 ? u.x : k == 1 ? u.y : u.z);
    CHECK_CLOSE(std::hypot(std::hypot(tool.motion_n, tool.rest_n), tool.constants_n), std::sqrt(variance), 1e-6 * std::sqrt(variance));
    CHECK(tool.constants_n > 0 && tool.motion_n > 0);
    // In the frame's own axes it is the same force.
    const ToolForce own = w.monitor.tool_force(WrenchAxes::frame);
    CHECK_CLOSE(std::hypot(std::hypot(own.wrench.force[0], own.wrench.force[1]), own.wrench.force[2]), length(f), 1e-9 * length(f));
    // The moment is about the frame's origin, though the force acts at the point.
    const Vector3 moment = cross({contact.point[0], contact.point[1], contact.point[2]}, {own.wrench.force[0], own.wrench.force[1], own.wrench.force[2]});
    CHECK_CLOSE(length(Vector3{own.wrench.moment[0], own.wrench.moment[1], own.wrench.moment[2]} - moment), 0, 1e-12 * length(f));
    CHECK(w.monitor.end_contact(which));
  }
  // So it is where a moment is declared: the wrench that is estimated at the origin, but for the prior of its size.
  DeclaredContact contact = press(30, 0.5);
  contact.at_most_nm = 2;
  CHECK(w.monitor.expect_contact(contact, 10) >= 0);
  w.monitor.step(w.signals.at(w.k++));
  for (const WrenchAxes axes : {WrenchAxes::base, WrenchAxes::frame}) {
    const Wrench at = w.monitor.tool_force(axes).wrench, wanted = w.monitor.wrench(6, axes);
    CHECK(at.unknowns == 6 && at.known);
    for (std::size_t i = 0; i < 3; ++i) CHECK_CLOSE(at.moment[i], wanted.moment[i], 0.05);  // of 30 N m
    for (std::size_t i = 0; i < 36; ++i)
      CHECK_CLOSE(at.covariance[i], wanted.covariance[i], 1e-2 * std::sqrt(wanted.covariance[7 * (i / 6)] * wanted.covariance[7 * (i % 6)]));
  }
}

}  // namespace

int main() {
  the_force_is_the_best_of_its_cone();
  what_is_declared_is_explained_and_nothing_else();
  a_moment_is_explained_only_where_it_is_declared();
  a_constant_force_is_explained_in_motion();
  a_joint_has_a_contact_of_its_own();
  time_box_and_travel_end_it();
  a_joint_that_stands_hides_its_friction();
  bad_contacts_are_refused();
  a_contact_admits_less_than_the_drives_can_exert();
  what_is_hidden_is_stated();
  a_monitor_keeps_what_is_declared();
  the_tool_force_has_its_errors_by_cause();
  return check::result();
}
