// tauext.h over tauext::Monitor: checks pointers, turns exceptions into status codes, copies.
#include "tauext/tauext.h"

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <exception>
#include <memory>
#include <new>
#include <span>
#include <string>

#include "tauext/monitor.hpp"
#include "tauext/refit.hpp"

struct tauext_monitor {
  tauext::Monitor monitor;
};

namespace {

using tauext::Alarm;
using tauext::Health;
using tauext::NetworkRate;

// The C names are numbers of their own: they may not drift from the C++ ones.
static_assert(TAUEXT_MAX_JOINTS == tauext::kMaxJoints);
static_assert(TAUEXT_EVERY_SAMPLE == static_cast<int>(NetworkRate::every_sample));
static_assert(TAUEXT_NETWORK_PERIOD == static_cast<int>(NetworkRate::network_period));
static_assert(TAUEXT_USUAL_LOAD_ERROR == tauext::Load::kUsualError);
static_assert(TAUEXT_WEIGHING_LOAD == static_cast<int>(tauext::LoadPhase::weighing));
static_assert(TAUEXT_FROM_NOW == tauext::kFromNow);
static_assert(TAUEXT_USUAL_REACH_M == tauext::kUsualReach_m);
static_assert(TAUEXT_TOO_LITTLE_MOTION == static_cast<int>(tauext::LoadVerdict::too_little));
static_assert(TAUEXT_NO_LOAD_SHOWS == static_cast<int>(tauext::LoadVerdict::nothing));
static_assert(TAUEXT_LOAD_SHOWS == static_cast<int>(tauext::LoadVerdict::load));
static_assert(TAUEXT_CONTACT_FITS_BETTER == static_cast<int>(tauext::LoadVerdict::contact));
static_assert(TAUEXT_PULLS_UP == static_cast<int>(tauext::LoadVerdict::lifts));
static_assert(TAUEXT_LOAD_UNCLEAR == static_cast<int>(tauext::LoadVerdict::unclear));
static_assert(TAUEXT_BASE_AXES == static_cast<int>(tauext::WrenchAxes::base));
static_assert(TAUEXT_FRAME_AXES == static_cast<int>(tauext::WrenchAxes::frame));
static_assert(TAUEXT_MOVED == static_cast<int>(tauext::Declared::moved));
static_assert(TAUEXT_BEYOND == static_cast<int>(tauext::Declared::beyond));
static_assert(TAUEXT_WARMING_UP == static_cast<int>(Health::warming_up));
static_assert(TAUEXT_HEALTHY == static_cast<int>(Health::ok));
static_assert(TAUEXT_STALE == static_cast<int>(Health::stale));
static_assert(TAUEXT_FAULT == static_cast<int>(Health::fault));
static_assert(TAUEXT_NO_ALARM == static_cast<int>(Alarm::none));
static_assert(TAUEXT_CONTACT == static_cast<int>(Alarm::contact));
static_assert(TAUEXT_COLLISION == static_cast<int>(Alarm::collision));
static_assert(+TAUEXT_NOT_FINITE == +tauext::kNotFinite);
static_assert(+TAUEXT_WRONG_SIZE == +tauext::kWrongSize);
static_assert(+TAUEXT_LATE_SAMPLE == +tauext::kLateSample);
static_assert(+TAUEXT_TIME_BACKWARDS == +tauext::kTimeBackwards);
static_assert(+TAUEXT_MISSING_SAMPLE == +tauext::kMissingSample);
static_assert(+TAUEXT_GAP == +tauext::kGap);
static_assert(+TAUEXT_WRONG_RATE == +tauext::kWrongRate);
static_assert(+TAUEXT_TORQUE_SATURATED == +tauext::kTorqueSaturated);
static_assert(+TAUEXT_ENCODER_STILL == +tauext::kEncoderStill);
static_assert(+TAUEXT_IMPOSSIBLE_TORQUE == +tauext::kImpossibleTorque);
static_assert(+TAUEXT_IMPOSSIBLE_VELOCITY == +tauext::kImpossibleVelocity);
static_assert(+TAUEXT_IMPOSSIBLE_POSITION == +tauext::kImpossiblePosition);
static_assert(TAUEXT_IMPOSSIBLE_POSITION == 1 << (tauext::kCauseCount - 1), "a cause has been added");

// A caller with a shorter tauext_estimate gets as many fields as fit, but at least those needed to judge whether the
// rest is valid.
constexpr std::size_t kLeastSize = offsetof(tauext_estimate, residual);

bool has_room(const tauext_estimate* to) noexcept { return !to || to->size >= kLeastSize; }

void write(const tauext::Estimate& from, tauext_estimate* to) noexcept {
  if (!to) return;
  tauext_estimate e{};
  e.size = to->size;
  e.t_ns = from.t_ns;
  e.joints = from.joints;
  e.health = static_cast<std::int32_t>(from.health);
  e.causes = from.causes;
  e.cause_joint = from.cause_joint;
  e.alarm = static_cast<std::int32_t>(from.alarm);
  e.alarm_joint = from.alarm_joint;
  e.alarm_t_ns = from.alarm_t_ns;
  e.detection = from.detection;
  e.near_stiction = from.near_stiction;
  std::ranges::copy(from.residual, e.residual);
  std::ranges::copy(from.uncertainty, e.uncertainty);
  std::ranges::copy(from.tau_ext, e.tau_ext);
  std::ranges::copy(from.limit_nm, e.limit_nm);
  std::ranges::copy(from.margin_nm, e.margin_nm);
  std::ranges::copy(from.drift, e.drift);
  e.drift_saturated = from.drift_saturated;
  std::ranges::copy(from.sigma_nm, e.sigma_nm);
  e.unfamiliar = from.unfamiliar;
  e.load_kg = from.load.mass;
  e.load_phase = static_cast<std::int32_t>(from.load_phase);
  e.touch = static_cast<std::int32_t>(from.touch);
  e.load_found_ns = from.load_found_ns;
  e.load_error_kg = from.load_error_kg;
  std::ranges::copy(from.load_nm, e.load_nm);
  std::ranges::copy(from.contact_sigma_nm, e.contact_sigma_nm);
  e.alarm_number = from.alarm_number;
  e.touch_over = from.touch_over;
  e.touch_t_ns = from.touch_t_ns;
  e.declared = static_cast<std::int32_t>(from.declared);
  e.declared_contact = from.declared_contact;
  e.declared_size = from.declared_size;
  e.declared_sigma = from.declared_sigma;
  e.declared_moment_nm = from.declared_moment_nm;
  e.declared_travel_m = from.declared_travel_m;
  std::ranges::copy(from.declared_nm, e.declared_nm);
  std::memcpy(to, &e, std::min(to->size, sizeof e));
}

tauext::Sample sample(const tauext_monitor* m, std::int64_t t_ns, const double* q, const double* dq,
                      const double* tau) noexcept {
  const auto n = static_cast<std::size_t>(m->monitor.joints());
  return {t_ns, {q, n}, {dq, n}, {tau, n}};
}

tauext::Load load_of(const tauext_load& from) noexcept {
  tauext::Load to;
  to.mass = from.mass;
  std::ranges::copy(from.com, to.com.begin());
  std::ranges::copy(from.inertia, to.inertia.begin());
  to.error_share = from.error_share;
  return to;
}

bool sound(const tauext_contact_bounds* from) noexcept {
  return from && from->size == sizeof *from && (from->axes == TAUEXT_BASE_AXES || from->axes == TAUEXT_FRAME_AXES);
}

tauext::DeclaredContact contact_of(const tauext_contact_bounds& from) noexcept {
  tauext::DeclaredContact to;
  to.frame = from.frame;
  to.joint = from.joint;
  std::ranges::copy(from.point, to.point.begin());
  std::ranges::copy(from.axis, to.axis.begin());
  to.axes = static_cast<tauext::WrenchAxes>(from.axes);
  to.half_angle_rad = from.half_angle_rad;
  to.at_most_n = from.at_most_n;
  to.at_most_nm = from.at_most_nm;
  to.at_most_travel_m = from.at_most_travel_m;
  to.boxed = from.boxed != 0;
  std::ranges::copy(from.lowest_m, to.lowest_m.begin());
  std::ranges::copy(from.highest_m, to.highest_m.begin());
  return to;
}

tauext_load in_c(const tauext::Load& from) noexcept {
  tauext_load to;
  to.mass = from.mass;
  std::ranges::copy(from.com, to.com);
  std::ranges::copy(from.inertia, to.inertia);
  to.error_share = from.error_share;
  return to;
}

// See kLeastSize: the fields needed to judge whether the rest is valid.
constexpr std::size_t kLeastFound = offsetof(tauext_load_found, load);

constexpr std::size_t kLeastWrench = offsetof(tauext_wrench, force);

bool sound(const tauext_monitor* monitor, std::int32_t frame, tauext_axes axes, const tauext_wrench* wrench) noexcept {
  return monitor && wrench && wrench->size >= kLeastWrench && frame >= 0 && frame < monitor->monitor.wrench_model().frames() &&
         (axes == TAUEXT_BASE_AXES || axes == TAUEXT_FRAME_AXES);
}

tauext_status put(const tauext::Wrench& from, tauext_wrench* wrench) noexcept {
  tauext_wrench to{};
  to.size = wrench->size;
  to.known = from.known;
  to.unknowns = from.unknowns;
  std::ranges::copy(from.force, to.force);
  std::ranges::copy(from.moment, to.moment);
  std::ranges::copy(from.covariance, to.covariance);
  to.blind_count = from.blind;
  to.freedom = from.freedom;
  for (std::size_t k = 0; k < from.blind_directions.size(); ++k) std::ranges::copy(from.blind_directions[k], to.blind + 6 * k);
  to.chi_square = from.chi_square;
  to.consistent = from.consistent;
  std::memcpy(wrench, &to, std::min(wrench->size, sizeof to));
  return TAUEXT_OK;
}

void say(const char* text, char* message, std::size_t message_size) noexcept {
  if (!message || message_size == 0) return;
  const std::size_t length = std::min(std::strlen(text), message_size - 1);
  std::memcpy(message, text, length);
  message[length] = '\0';
}

// TAUEXT_OK once `act` returns; else the status and the message of what it threw.
template <class Act>
tauext_status attempt(Act act, const char* no_memory, const char* failed, char* message, std::size_t message_size) noexcept {
  try {
    act();
    return TAUEXT_OK;
  } catch (const std::bad_alloc&) {
    say(no_memory, message, message_size);
    return TAUEXT_NO_MEMORY;
  } catch (const std::exception& e) {
    say(e.what(), message, message_size);
  } catch (...) {
    say(failed, message, message_size);
  }
  return TAUEXT_BAD_BUNDLE;
}

// What both ways to open have in common; load() gives the bundle, or throws.
template <class Load>
tauext_status open(Load load, bool arguments, tauext_network_rate rate, tauext_monitor** monitor, char* message,
                   std::size_t message_size) noexcept {
  say("", message, message_size);
  if (monitor) *monitor = nullptr;
  if (!monitor || !arguments) {
    say("a null pointer where the bundle or the monitor belongs", message, message_size);
    return TAUEXT_BAD_ARGUMENT;
  }
  if (rate != TAUEXT_EVERY_SAMPLE && rate != TAUEXT_NETWORK_PERIOD) {
    say("the network rate must be TAUEXT_EVERY_SAMPLE (0) or TAUEXT_NETWORK_PERIOD (1)", message, message_size);
    return TAUEXT_BAD_ARGUMENT;
  }
  return attempt([&] { *monitor = new tauext_monitor{tauext::Monitor(load(), static_cast<NetworkRate>(rate))}; },
                 "not enough memory for the monitor", "the bundle cannot be read", message, message_size);
}

}  // namespace

const char* tauext_version(void) { return TAUEXT_VERSION; }

const char* tauext_status_name(tauext_status status) {
  switch (status) {
    case TAUEXT_OK: return "ok";
    case TAUEXT_BAD_ARGUMENT: return "bad argument";
    case TAUEXT_BAD_BUNDLE: return "bad bundle";
    case TAUEXT_NO_MEMORY: return "no memory";
    case TAUEXT_BAD_STATE: return "bad state";
    case TAUEXT_BAD_LOAD: return "bad payload";
    case TAUEXT_BAD_CONTACT: return "bad contact";
  }
  return "";
}

const char* tauext_health_name(int32_t health) {
  return health < TAUEXT_WARMING_UP || health > TAUEXT_FAULT ? "" : tauext::name(static_cast<Health>(health));
}

const char* tauext_alarm_name(int32_t alarm) {
  return alarm < TAUEXT_NO_ALARM || alarm > TAUEXT_COLLISION ? "" : tauext::name(static_cast<Alarm>(alarm));
}

const char* tauext_touch_name(int32_t touch) {
  return touch < TAUEXT_NO_TOUCH || touch > TAUEXT_LOAD_TOUCH ? "" : tauext::name(static_cast<tauext::Touch>(touch));
}

const char* tauext_cause_name(uint32_t cause) { return tauext::name(static_cast<tauext::Cause>(cause)); }

tauext_status tauext_monitor_open(const char* bundle_path, tauext_network_rate rate, tauext_monitor** monitor,
                                  char* message, size_t message_size) {
  return open([&] { return tauext::load_bundle(bundle_path); }, bundle_path != nullptr, rate, monitor, message, message_size);
}

tauext_status tauext_monitor_open_bytes(const void* bundle, size_t bundle_size, tauext_network_rate rate,
                                        tauext_monitor** monitor, char* message, size_t message_size) {
  const auto load = [&] { return tauext::from_bytes({static_cast<const char*>(bundle), bundle_size}); };
  return open(load, bundle != nullptr, rate, monitor, message, message_size);
}

void tauext_monitor_close(tauext_monitor* monitor) { delete monitor; }

int32_t tauext_monitor_joints(const tauext_monitor* monitor) { return monitor ? monitor->monitor.joints() : 0; }

const char* tauext_monitor_joint_name(const tauext_monitor* monitor, int32_t joint) {
  if (!monitor || joint < 0 || joint >= monitor->monitor.joints()) return nullptr;
  return monitor->monitor.joint_name(joint).c_str();
}

const char* tauext_monitor_torque_unit(const tauext_monitor* monitor, int32_t joint) {
  if (!monitor || joint < 0 || joint >= monitor->monitor.joints()) return nullptr;
  return monitor->monitor.torque_unit(joint).c_str();
}

const char* tauext_monitor_estimate_unit(const tauext_monitor* monitor, int32_t joint) {
  if (!monitor || joint < 0 || joint >= monitor->monitor.joints()) return nullptr;
  return monitor->monitor.estimate_unit(joint).c_str();
}

int64_t tauext_monitor_sample_period_ns(const tauext_monitor* monitor) {
  return monitor ? monitor->monitor.sample_period_ns() : 0;
}

tauext_status tauext_monitor_step(tauext_monitor* monitor, int64_t t_ns, const double* q, const double* dq,
                                  const double* tau, tauext_estimate* estimate) {
  const tauext_status status = tauext_monitor_estimate(monitor, t_ns, q, dq, tau, estimate);
  return status == TAUEXT_OK ? tauext_monitor_advance(monitor) : status;
}

tauext_status tauext_monitor_estimate(tauext_monitor* monitor, int64_t t_ns, const double* q, const double* dq,
                                      const double* tau, tauext_estimate* estimate) {
  if (!monitor || !q || !dq || !tau || !has_room(estimate)) return TAUEXT_BAD_ARGUMENT;
  write(monitor->monitor.estimate(sample(monitor, t_ns, q, dq, tau)), estimate);
  return TAUEXT_OK;
}

tauext_status tauext_monitor_advance(tauext_monitor* monitor) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.advance();
  return TAUEXT_OK;
}

tauext_status tauext_monitor_no_sample(tauext_monitor* monitor, int64_t now_ns, tauext_estimate* estimate) {
  if (!monitor || !has_room(estimate)) return TAUEXT_BAD_ARGUMENT;
  write(monitor->monitor.no_sample(now_ns), estimate);
  return TAUEXT_OK;
}

tauext_status tauext_monitor_acknowledge(tauext_monitor* monitor) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.acknowledge();
  return TAUEXT_OK;
}

tauext_status tauext_monitor_resume(tauext_monitor* monitor) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.resume();
  return TAUEXT_OK;
}

tauext_status tauext_monitor_set_limit_factors(tauext_monitor* monitor, const double* collision,
                                               const double* contact) {
  if (!monitor || !collision || !contact) return TAUEXT_BAD_ARGUMENT;
  const auto n = static_cast<std::size_t>(monitor->monitor.joints());
  return monitor->monitor.set_limit_factors({collision, n}, {contact, n}) ? TAUEXT_OK : TAUEXT_BAD_ARGUMENT;
}

tauext_status tauext_monitor_set_load(tauext_monitor* monitor, const tauext_load* load, int64_t since_ns) {
  if (!monitor || !load) return TAUEXT_BAD_ARGUMENT;
  return monitor->monitor.set_load(load_of(*load), since_ns) ? TAUEXT_OK : TAUEXT_BAD_LOAD;
}

tauext_status tauext_monitor_clear_load(tauext_monitor* monitor, int64_t since_ns) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  return monitor->monitor.clear_load(since_ns) ? TAUEXT_OK : TAUEXT_BAD_LOAD;
}

tauext_status tauext_monitor_load(const tauext_monitor* monitor, tauext_load* load) {
  if (!monitor || !load) return TAUEXT_BAD_ARGUMENT;
  *load = in_c(monitor->monitor.load());
  return TAUEXT_OK;
}

tauext_status tauext_monitor_start_weighing(tauext_monitor* monitor, double reach_m) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  if (monitor->monitor.start_weighing(reach_m)) return TAUEXT_OK;
  return monitor->monitor.can_weigh() ? TAUEXT_BAD_ARGUMENT : TAUEXT_BAD_LOAD;
}

tauext_status tauext_monitor_stop_weighing(tauext_monitor* monitor) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.stop_weighing();
  return TAUEXT_OK;
}

int32_t tauext_monitor_weighing(const tauext_monitor* monitor) { return monitor && monitor->monitor.weighing(); }

tauext_status tauext_monitor_estimate_load(const tauext_monitor* monitor, tauext_load_found* found) {
  if (!monitor || !found || found->size < kLeastFound) return TAUEXT_BAD_ARGUMENT;
  const tauext::LoadFound from = monitor->monitor.estimate_load();
  tauext_load_found to{};
  to.size = found->size;
  to.verdict = static_cast<std::int32_t>(from.verdict);
  to.mass_seen = from.mass_seen;
  to.load = in_c(from.load);
  to.mass_kg = from.mass_kg;
  to.mass_error_kg = from.mass_error_kg;
  to.constants_error_kg = from.constants_error_kg;
  std::ranges::copy(from.com_m, to.com_m);
  std::ranges::copy(from.com_error_m, to.com_error_m);
  std::ranges::copy(from.com_covariance, to.com_covariance);
  to.seconds = from.seconds;
  to.misfit = from.misfit;
  to.unseen_count = from.unseen_count;
  to.at_bound = from.at_bound;
  for (std::size_t k = 0; k < from.unseen.size(); ++k) std::ranges::copy(from.unseen[k], to.unseen + 3 * k);
  std::memcpy(found, &to, std::min(found->size, sizeof to));
  return TAUEXT_OK;
}

int32_t tauext_monitor_find_frame(const tauext_monitor* monitor, const char* name) {
  return monitor && name ? monitor->monitor.wrench_model().find(name) : -1;
}

const char* tauext_monitor_why_no_wrench(const tauext_monitor* monitor) {
  return monitor ? monitor->monitor.wrench_model().refused().c_str() : "";
}

tauext_status tauext_monitor_wrench(const tauext_monitor* monitor, int32_t frame, tauext_axes axes, tauext_wrench* wrench) {
  if (!sound(monitor, frame, axes, wrench)) return TAUEXT_BAD_ARGUMENT;
  return put(monitor->monitor.wrench(frame, static_cast<tauext::WrenchAxes>(axes)), wrench);
}

tauext_status tauext_monitor_force(const tauext_monitor* monitor, int32_t frame, const double* point, tauext_axes axes,
                                   tauext_wrench* wrench) {
  if (!point || !sound(monitor, frame, axes, wrench)) return TAUEXT_BAD_ARGUMENT;
  return put(monitor->monitor.force(frame, {point[0], point[1], point[2]}, static_cast<tauext::WrenchAxes>(axes)), wrench);
}

tauext_status tauext_monitor_expect_contact(tauext_monitor* monitor, const tauext_contact_bounds* contact, double seconds,
                                            int32_t* which) {
  if (!monitor || !which || !sound(contact)) return TAUEXT_BAD_ARGUMENT;
  *which = monitor->monitor.expect_contact(contact_of(*contact), seconds);
  return *which >= 0 ? TAUEXT_OK : TAUEXT_BAD_CONTACT;
}

tauext_status tauext_monitor_end_contact(tauext_monitor* monitor, int32_t which) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  return monitor->monitor.end_contact(which) ? TAUEXT_OK : TAUEXT_BAD_CONTACT;
}

tauext_status tauext_monitor_why_no_contact(const tauext_monitor* monitor, const tauext_contact_bounds* contact,
                                            double seconds, char* message, size_t message_size) {
  say("", message, message_size);
  if (!monitor || !sound(contact)) return TAUEXT_BAD_ARGUMENT;
  try {
    say(monitor->monitor.why_no_contact(contact_of(*contact), seconds).c_str(), message, message_size);
    return TAUEXT_OK;
  } catch (...) {
    return TAUEXT_NO_MEMORY;
  }
}

tauext_status tauext_monitor_unmonitored(const tauext_monitor* monitor, const tauext_contact_bounds* contact, char* message,
                                         size_t message_size) {
  say("", message, message_size);
  if (!monitor || !sound(contact)) return TAUEXT_BAD_ARGUMENT;
  try {
    say(monitor->monitor.unmonitored(contact_of(*contact)).c_str(), message, message_size);
    return TAUEXT_OK;
  } catch (...) {
    return TAUEXT_NO_MEMORY;
  }
}

tauext_status tauext_monitor_tool_force(const tauext_monitor* monitor, tauext_axes axes, tauext_tool_force* tool) {
  if (!monitor || !tool || tool->size != sizeof *tool || (axes != TAUEXT_BASE_AXES && axes != TAUEXT_FRAME_AXES))
    return TAUEXT_BAD_ARGUMENT;
  const tauext::ToolForce found = monitor->monitor.tool_force(static_cast<tauext::WrenchAxes>(axes));
  tool->frame = found.frame;
  tool->declared = found.declared;
  tool->motion_n = found.motion_n;
  tool->rest_n = found.rest_n;
  tool->constants_n = found.constants_n;
  tool->wrench.size = sizeof tool->wrench;
  return put(found.wrench, &tool->wrench);
}

tauext_status tauext_monitor_expect_load(tauext_monitor* monitor, double seconds, double at_most_kg) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  return monitor->monitor.expect_load(seconds, at_most_kg) ? TAUEXT_OK : TAUEXT_BAD_LOAD;
}

tauext_status tauext_monitor_why_not_expected(const tauext_monitor* monitor, double seconds, double at_most_kg,
                                              char* message, size_t message_size) {
  say("", message, message_size);
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  try {
    say(monitor->monitor.why_not_expected(seconds, at_most_kg).c_str(), message, message_size);
    return TAUEXT_OK;
  } catch (...) {
    return TAUEXT_NO_MEMORY;
  }
}

tauext_status tauext_monitor_why_no_load(const tauext_monitor* monitor, const tauext_load* load, int64_t since_ns,
                                         char* message, size_t message_size) {
  say("", message, message_size);
  if (!monitor || !load) return TAUEXT_BAD_ARGUMENT;
  try {
    say(monitor->monitor.why_no_load(load_of(*load), since_ns).c_str(), message, message_size);
    return TAUEXT_OK;
  } catch (...) {
    return TAUEXT_NO_MEMORY;
  }
}

const char* tauext_monitor_load_frame(const tauext_monitor* monitor) {
  return monitor && monitor->monitor.load_settings().settable() ? monitor->monitor.load_settings().frame.c_str() : "";
}

tauext_status tauext_monitor_set_temperature(tauext_monitor* monitor, const double* celsius) {
  if (!monitor || !celsius) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.set_temperature({celsius, static_cast<std::size_t>(monitor->monitor.joints())});
  return TAUEXT_OK;
}

tauext_status tauext_monitor_reset(tauext_monitor* monitor) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.reset();
  return TAUEXT_OK;
}

size_t tauext_monitor_state_bytes(const tauext_monitor* monitor) {
  return monitor ? monitor->monitor.state_bytes() : 0;
}

tauext_status tauext_monitor_reserve_refit(tauext_monitor* monitor, double seconds) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  try {
    monitor->monitor.reserve_refit(seconds);
    return TAUEXT_OK;
  } catch (const std::bad_alloc&) {
    return TAUEXT_NO_MEMORY;
  } catch (...) {
    return TAUEXT_BAD_ARGUMENT;
  }
}

tauext_status tauext_monitor_start_refit(tauext_monitor* monitor, double friction_share) {
  return monitor && monitor->monitor.start_refit(friction_share) ? TAUEXT_OK : TAUEXT_BAD_ARGUMENT;
}

uint64_t tauext_monitor_clock_jumps(const tauext_monitor* monitor) { return monitor ? monitor->monitor.clock_jumps() : 0; }

int32_t tauext_monitor_refit_full(const tauext_monitor* monitor) { return monitor && monitor->monitor.refit_full(); }

tauext_status tauext_monitor_finish_refit(tauext_monitor* monitor) {
  if (!monitor) return TAUEXT_BAD_ARGUMENT;
  monitor->monitor.finish_refit();
  return TAUEXT_OK;
}

tauext_status tauext_refit(const char* bundle_path, const tauext_monitor* monitor, const char* out_path, char* message,
                           size_t message_size) {
  say("", message, message_size);
  if (!bundle_path || !monitor || !out_path) {
    say("a null pointer where the bundle, the monitor or the new bundle belongs", message, message_size);
    return TAUEXT_BAD_ARGUMENT;
  }
  const auto refit = [&] {
    const tauext::RefitSource source{monitor->monitor.refit_motion(), {}};
    tauext::save_bundle(tauext::refit(tauext::load_bundle(bundle_path), {&source, 1}).bundle, out_path);
  };
  return attempt(refit, "not enough memory for the refit", "the refit failed", message, message_size);
}

tauext_status tauext_monitor_save_state(const tauext_monitor* monitor, void* state, size_t size) {
  if (!monitor || !state) return TAUEXT_BAD_ARGUMENT;
  return monitor->monitor.save_state({static_cast<std::byte*>(state), size}) ? TAUEXT_OK : TAUEXT_BAD_ARGUMENT;
}

tauext_status tauext_monitor_restore_state(tauext_monitor* monitor, const void* state, size_t size) {
  if (!monitor || !state) return TAUEXT_BAD_ARGUMENT;
  return monitor->monitor.restore_state({static_cast<const std::byte*>(state), size}) ? TAUEXT_OK : TAUEXT_BAD_STATE;
}
