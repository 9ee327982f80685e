#include "tauext/monitor.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <optional>
#include <type_traits>
#include <vector>

#include "fit/refit_motion.hpp"
#include "load/expected_load.hpp"
#include "load/weighing.hpp"
#include "network/sliding_lstm.hpp"
#include "prior/prior.hpp"
#include "stages/judge_stage.hpp"
#include "stages/observe_stage.hpp"
#include "tauext/wrench.hpp"
#include "touch/declared_contacts.hpp"

namespace tauext {
namespace {

constexpr std::uint32_t kStateVersion = 1, kCarriedVersion = 1;

// Header of a saved state.
struct StateHead {
  std::uint32_t version, fingerprint;
  std::uint64_t bytes;
  std::uint32_t crc, unused;
};

// What one bundle's monitor leaves to another's.
struct Handover {
  std::uint32_t version, crc;  // crc: of all that follows
  std::uint32_t joints, model;
  JudgeStage::Carried judge;
  Load load;
};

std::span<const char> as_chars(std::span<const std::byte> bytes) noexcept {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

std::uint32_t crc_of(std::span<const std::byte> carried) noexcept {
  return crc32(as_chars(carried.subspan(offsetof(Handover, joints))));
}

// Reads what was carried; false: damaged, or of another build or number of joints.
bool read(std::span<const std::byte> bytes, int joints, Handover& carried) noexcept {
  if (bytes.size() != sizeof carried) return false;
  std::memcpy(&carried, bytes.data(), sizeof carried);
  return carried.version == kCarriedVersion && carried.joints == static_cast<std::uint32_t>(joints) && carried.crc == crc_of(bytes);
}

// Also validates the bundle before anything is built from it.
std::uint32_t fingerprint_of(const Bundle& bundle, NetworkRate rate) {
  const char how = static_cast<char>(rate);
  const std::vector<char> bytes = to_bytes(bundle);
  return crc32(std::span(&how, 1), crc32(bytes));
}

}  // namespace

struct Monitor::Chain {
  std::vector<std::string> joint_names, torque_units, estimate_units;
  std::int64_t sample_period_ns;
  LoadSettings load_settings;
  std::uint32_t fingerprint;  // CRC-32 of the bundle and of all else that determines a state's layout
  std::uint32_t model;        // model_digest()
  ObserveStage observe;
  std::optional<SlidingLstm> network;
  std::vector<float> network_out;
  JudgeStage judge;
  std::vector<FrictionLine> friction;  // per joint
  RefitMotion refit_motion;
  std::optional<ExpectedLoad> expected;  // if loads are enabled
  std::optional<Weighing> weighing;      // if supported
  WrenchModel wrench;
  DeclaredContacts contacts;
  bool pending = true;  // advance() has not followed the last sample yet

  Chain(const Bundle& bundle, NetworkRate rate);

  ExpectedLoad* expected_load() noexcept { return expected ? &*expected : nullptr; }
  bool weighs() const noexcept { return weighing && weighing->on(); }
  std::span<const double> of_joints(const JointVector& values) const noexcept {
    return std::span(values).first(static_cast<std::size_t>(judge.last().joints));
  }
  // tau_ext that no expected load explains.
  JointVector left() const noexcept {
    const Estimate& last = judge.last();
    JointVector left{};
    for (int j = 0; j < last.joints; ++j) left[j] = last.tau_ext[j] - last.load_nm[j];
    return left;
  }
  void predict(const Observed& observed) noexcept;
  void finish() noexcept;
  void follow_expected() noexcept;
  void put_load(const Load& load, std::int64_t since_ns) noexcept;
  void end_weighing() noexcept;
  void end_by_jump() noexcept;
};

Monitor::Chain::Chain(const Bundle& bundle, NetworkRate rate)
    : sample_period_ns(bundle.observer.sample_period_ns),
      load_settings(bundle.load),
      fingerprint(fingerprint_of(bundle, rate)),
      model(model_digest(bundle)),
      observe(bundle, rate == NetworkRate::every_sample ? 1 : bundle.observer.network_stride),
      judge(bundle),
      wrench(bundle),
      contacts(bundle, wrench) {
  for (int j = 0; j < bundle.joints(); ++j) {
    friction.push_back(friction_line(bundle.prior, static_cast<std::size_t>(j)));
    joint_names.push_back(bundle.links[static_cast<std::size_t>(j)].joint_name);
    torque_units.push_back(bundle.torque_unit(j));
    estimate_units.push_back(bundle.estimate_unit(j));
  }
  if (Weighing::possible(bundle)) weighing.emplace(bundle);
  if (load_settings.settable()) {
    observe.allow_loads(load_settings, bundle.most_units_per_nm());
    judge.allow_loads();
    if (ExpectedLoad::possible(bundle)) expected.emplace(bundle);
  }
  if (!bundle.has_network()) return;
  network.emplace(bundle.shape, bundle.parameters, bundle.inputs, bundle.columns(), bundle.observer.network_stride,
                   bundle.window_steps, rate);
  network_out.resize(bundle.links.size());
}

Monitor::Monitor(const Bundle& bundle, NetworkRate rate)
    : chain_(std::make_unique<Chain>(bundle, rate)), last_(&chain_->judge.last()) {}
Monitor::Monitor(Monitor&&) noexcept = default;
Monitor& Monitor::operator=(Monitor&&) noexcept = default;
Monitor::~Monitor() = default;

void Monitor::reset() noexcept {
  chain_->observe.reset();
  if (chain_->network) chain_->network->restart();
  chain_->judge.reset();
  if (chain_->expected) chain_->expected->reset();
  chain_->contacts.reset();
  chain_->refit_motion.stop();
  chain_->end_weighing();
}

bool Monitor::start_weighing(double reach_m) noexcept {
  if (!chain_->weighing || !(reach_m > 0) || !std::isfinite(reach_m)) return false;
  advance();
  chain_->weighing->start(reach_m, chain_->observe.load());
  chain_->judge.hold_drift(true);
  return true;
}

void Monitor::stop_weighing() noexcept {
  if (!weighing()) return;
  advance();
  chain_->weighing->stop();
  chain_->judge.hold_drift(false);
}

// Evaluation ended, and no load was found.
void Monitor::Chain::end_weighing() noexcept {
  if (weighing) weighing->reset();
  judge.hold_drift(false);
}

// The stamps jumped: what lasts until somebody ends it, and holds drift or raises limits, ends if it has begun before. Declared
// contacts and an expected load end themselves (Observed::jumped).
void Monitor::Chain::end_by_jump() noexcept {
  if (weighs() && weighing->begun()) {
    weighing->stop();
    judge.hold_drift(false);
  }
  if (refit_motion.view().samples == 0) return;
  judge.widen_limits({}, {});
  refit_motion.stop();
}

std::string Monitor::why_no_weighing() const {
  if (chain_->weighing) return "";
  if (chain_->load_settings.link < 0) return "no payload can be identified: " + chain_->load_settings.refused;
  return "no payload can be identified: the bundle's residual is not that of the momentum observer without filters";
}

void Monitor::reserve_refit(double seconds) {
  if (!(seconds > 0 && seconds <= 600)) throw Error("a refit's motion of " + to_text(seconds) + " s must be above 0, at most 600");
  finish_refit();
  chain_->refit_motion.reserve(joints(), std::llround(std::ceil(1e9 * seconds / static_cast<double>(chain_->sample_period_ns))));
}

bool Monitor::start_refit(double friction_share) noexcept {
  const auto any = [](const FrictionLine& line) noexcept { return line.at_rest_nm > 0 || line.per_speed > 0; };
  if (!chain_->refit_motion.reserved() || !(friction_share >= 0 && friction_share <= 2) || !std::ranges::any_of(chain_->friction, any))
    return false;
  JointVector at_rest{}, per_speed{};
  for (std::size_t j = 0; j < chain_->friction.size(); ++j) {
    at_rest[j] = friction_share * chain_->friction[j].at_rest_nm;
    per_speed[j] = friction_share * chain_->friction[j].per_speed;
  }
  chain_->judge.widen_limits(at_rest, per_speed);
  chain_->refit_motion.start();
  return true;
}

bool Monitor::refit_full() const noexcept { return chain_->refit_motion.running() && chain_->refit_motion.full(); }
RecordingView Monitor::refit_motion() const noexcept { return chain_->refit_motion.view(); }

RecordingView Monitor::finish_refit() noexcept {
  chain_->judge.widen_limits({}, {});
  chain_->refit_motion.stop();
  return chain_->refit_motion.view();
}

void Monitor::resume() noexcept {
  chain_->observe.forget_friction(last().near_stiction);
  if (chain_->observe.models_friction()) chain_->judge.forget_pushes();  // the doubt covers them
  acknowledge();
}

void Monitor::count_alarms_from(std::uint32_t number) noexcept { chain_->judge.count_alarms_from(number); }

void Monitor::acknowledge() noexcept {
  chain_->judge.acknowledge();
  if (chain_->expected) chain_->expected->acknowledge();
}

bool Monitor::set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
  if (chain_->expected) chain_->expected->set_limit_factors(collision, contact);
  return chain_->judge.set_limit_factors(collision, contact);
}
const LimitFactors& Monitor::limit_factors() const noexcept { return chain_->judge.limit_factors(); }

bool Monitor::set_temperature(std::span<const double> celsius) noexcept {
  if (celsius.size() != static_cast<std::size_t>(joints())) return false;
  chain_->observe.follow_temperature(celsius);
  return true;
}

const Estimate& Monitor::estimate(const Sample& sample) noexcept {
  advance();
  const Observed& observed = chain_->observe.step(sample);
  if (observed.passage == Passage::entered) {
    if (observed.jumped) chain_->end_by_jump();
    if (chain_->network) chain_->predict(observed);
  }
  const Estimate& answer = chain_->judge.step(observed, sample, chain_->network_out, chain_->expected_load(), &chain_->contacts);
  const bool learns = observed.passage == Passage::entered && !chain_->contacts.in_effect();
  if (learns) chain_->refit_motion.push(sample);  // the refit's chain restarts after the gap that a contact leaves
  if (weighing()) chain_->weighing->take(sample, observed, answer);
  chain_->pending = true;
  return answer;
}

// Writes the network's output for the window ending at this sample to network_out; unchanged while no window is full.
void Monitor::Chain::predict(const Observed& observed) noexcept {
  if (observed.restarted) network->restart();
  network->push(observe.features(), observed.ticks);
  network->answer(network_out);
}

void Monitor::advance() noexcept {
  if (chain_->pending) chain_->finish();
  if (chain_->expected && chain_->expected->on()) chain_->follow_expected();
}

// Does for the last sample what its answer did not need.
void Monitor::Chain::finish() noexcept {
  pending = false;
  observe.keep();
  judge.advance(observe.q(), observe.dq());
  if (observe.progress().started) judge.keep(observe.progress().t_ns);
  if (network) network->advance();
  if (weighs()) weighing->advance(observe.beta());
}

// Applies what the last sample decided about an expected load.
void Monitor::Chain::follow_expected() noexcept {
  const ExpectedLoad::Decision decision = expected->decide();
  if (decision.alarm != Alarm::none) judge.raise(decision.alarm, decision.joint);
  if (decision.sets) put_load(decision.load, decision.since_ns);
}

bool Monitor::expect_load(double seconds, double at_most_kg) noexcept {
  if (!chain_->expected) return false;
  advance();
  return chain_->expected->start(seconds, at_most_kg, load(), chain_->judge.alarm());
}

std::string Monitor::why_not_expected(double seconds, double at_most_kg) const {
  if (chain_->expected) return chain_->expected->why_not(seconds, at_most_kg);
  return chain_->load_settings.words(chain_->load_settings.settable() ? LoadFault::no_past : LoadFault::not_settable, {});
}

LoadFault Monitor::load_fault(const Load& load, std::int64_t since_ns) const noexcept {
  const LoadFault fault = chain_->load_settings.fault(load);
  if (fault != LoadFault::none || since_ns == kFromNow || chain_->observe.can_go_back()) return fault;
  return LoadFault::no_past;
}

bool Monitor::set_load(const Load& load, std::int64_t since_ns) noexcept {
  if (load_fault(load, since_ns) != LoadFault::none) return false;
  advance();
  if (chain_->expected) chain_->expected->stop();
  chain_->put_load(load, since_ns);
  return true;
}

void Monitor::Chain::put_load(const Load& load, std::int64_t since_ns) noexcept {
  observe.set_load(load, since_ns);
  judge.set_load(observe.load());
  if (since_ns < observe.progress().t_ns) judge.take_back_drift(since_ns);
  if (weighs()) weighing->start(weighing->settings().reach_m, observe.load());
}

int Monitor::expect_contact(const DeclaredContact& contact, double seconds) noexcept {
  advance();
  return chain_->contacts.start(contact, seconds);
}
bool Monitor::end_contact(int which) noexcept {
  advance();
  return chain_->contacts.end(which);
}
const DeclaredContact* Monitor::declared_contact(int which) const noexcept { return chain_->contacts.contact(which); }
ContactFault Monitor::contact_fault(const DeclaredContact& contact, double seconds) const noexcept {
  return chain_->contacts.fault(contact, seconds);
}
std::string Monitor::why_no_contact(const DeclaredContact& contact, double seconds) const {
  return chain_->contacts.words(chain_->contacts.fault(contact, seconds), contact, seconds);
}
std::string Monitor::unmonitored(const DeclaredContact& contact) const { return chain_->contacts.unmonitored(contact); }

ToolForce Monitor::tool_force(WrenchAxes axes) const noexcept {
  const Chain& c = *chain_;
  return c.contacts.tool({c.observe.q(), c.observe.dq(), c.of_joints(c.left()), c.of_joints(last().sigma_nm), c.of_joints(last().contact_sigma_nm)},
                         c.judge.contact_errors(), c.wrench.find(c.load_settings.frame), axes);
}

const Estimate& Monitor::no_sample(std::int64_t now_ns) noexcept {
  advance();
  return chain_->judge.step(chain_->observe.no_sample(now_ns), {}, {}, chain_->expected_load());
}

const Load& Monitor::load() const noexcept { return chain_->observe.load(); }
const LoadSettings& Monitor::load_settings() const noexcept { return chain_->load_settings; }
bool Monitor::can_weigh() const noexcept { return chain_->weighing.has_value(); }
bool Monitor::weighing() const noexcept { return chain_->weighs(); }
LoadFound Monitor::estimate_load() const noexcept { return can_weigh() ? chain_->weighing->found() : LoadFound{}; }

Wrench Monitor::wrench(int frame, WrenchAxes axes) const noexcept {
  const Chain& c = *chain_;
  return c.wrench.wrench(frame, c.observe.q(), c.of_joints(c.left()), c.of_joints(last().sigma_nm), axes,
                         c.of_joints(last().contact_sigma_nm), c.observe.dq());
}
Wrench Monitor::force(int frame, const std::array<double, 3>& point, WrenchAxes axes) const noexcept {
  const Chain& c = *chain_;
  return c.wrench.force(frame, point, c.observe.q(), c.of_joints(c.left()), c.of_joints(last().sigma_nm), axes,
                        c.of_joints(last().contact_sigma_nm), c.observe.dq());
}
const WrenchModel& Monitor::wrench_model() const noexcept { return chain_->wrench; }

const std::string& Monitor::joint_name(int joint) const { return chain_->joint_names.at(static_cast<std::size_t>(joint)); }
const std::string& Monitor::torque_unit(int joint) const { return chain_->torque_units.at(static_cast<std::size_t>(joint)); }
const std::string& Monitor::estimate_unit(int joint) const {
  return chain_->estimate_units.at(static_cast<std::size_t>(joint));
}
std::int64_t Monitor::sample_period_ns() const noexcept { return chain_->sample_period_ns; }
std::uint64_t Monitor::samples() const noexcept { return chain_->observe.progress().samples; }
std::uint64_t Monitor::bridged_ticks() const noexcept { return chain_->observe.progress().bridged; }
std::uint64_t Monitor::restarts() const noexcept { return chain_->observe.progress().restarts; }
std::uint64_t Monitor::clock_jumps() const noexcept { return chain_->observe.progress().jumps; }

// Parts of a saved state, in this order; all trivially copyable.
std::size_t Monitor::state_bytes() const noexcept {
  return sizeof(StateHead) + sizeof(ObserveStage::State) + sizeof(JudgeStage::State) + sizeof(DeclaredContacts::State) +
         (chain_->expected ? chain_->expected->state_bytes() : 0) + (chain_->network ? chain_->network->state_bytes() : 0);
}

bool Monitor::save_state(std::span<std::byte> state) const noexcept {
  if (state.size() != state_bytes()) return false;
  std::span<std::byte> left = state.subspan(sizeof(StateHead));
  const auto put = [&](const auto& part) noexcept {
    static_assert(std::is_trivially_copyable_v<std::remove_cvref_t<decltype(part)>>);
    std::memcpy(left.data(), &part, sizeof part);
    left = left.subspan(sizeof part);
  };
  put(chain_->observe.state());
  put(chain_->judge.state());
  put(chain_->contacts.state());
  if (chain_->expected) {
    chain_->expected->save(left);
    left = left.subspan(chain_->expected->state_bytes());
  }
  if (chain_->network) chain_->network->save(left);
  const StateHead head{kStateVersion, chain_->fingerprint, state.size(), crc32(as_chars(state.subspan(sizeof head))), 0};
  std::memcpy(state.data(), &head, sizeof head);
  return true;
}

bool Monitor::restore_state(std::span<const std::byte> state) noexcept {
  StateHead head;
  if (state.size() != state_bytes()) return false;
  std::memcpy(&head, state.data(), sizeof head);
  std::span<const std::byte> left = state.subspan(sizeof head);
  if (head.version != kStateVersion || head.fingerprint != chain_->fingerprint || head.bytes != state.size() ||
      head.crc != crc32(as_chars(left)))
    return false;
  const auto take = [&](auto part) noexcept {  // a copy of the current part gives it its type
    std::memcpy(&part, left.data(), sizeof part);
    left = left.subspan(sizeof part);
    return part;
  };
  chain_->observe.restore(take(chain_->observe.state()));
  chain_->judge.restore(take(chain_->judge.state()));
  chain_->contacts.restore(take(chain_->contacts.state()));
  if (chain_->expected) {
    chain_->expected->restore(left);
    left = left.subspan(chain_->expected->state_bytes());
  }
  if (chain_->network) chain_->network->restore(left);
  finish_refit();
  chain_->end_weighing();
  chain_->pending = true;
  return true;
}

std::size_t Monitor::carried_bytes() noexcept { return sizeof(Handover); }

bool Monitor::save_carried(std::span<std::byte> bytes) const noexcept {
  static_assert(std::is_trivially_copyable_v<Handover>);
  if (bytes.size() != sizeof(Handover)) return false;
  Handover carried;
  std::memset(static_cast<void*>(&carried), 0, sizeof carried);
  carried.version = kCarriedVersion;
  carried.joints = static_cast<std::uint32_t>(joints());
  carried.model = chain_->model;
  carried.judge = chain_->judge.carried();
  carried.load = load();
  std::memcpy(bytes.data(), &carried, sizeof carried);
  const std::uint32_t crc = crc_of(bytes);
  std::memcpy(bytes.data() + offsetof(Handover, crc), &crc, sizeof crc);
  return true;
}

bool Monitor::carry(std::span<const std::byte> bytes) noexcept {
  Handover carried;
  if (!read(bytes, joints(), carried)) return false;
  const bool loaded = carried.load.mass > 0;
  if (loaded && load_fault(carried.load) != LoadFault::none) return false;
  const auto n = static_cast<std::size_t>(joints());
  const LimitFactors& factors = carried.judge.factors;
  if (!set_limit_factors(std::span(factors.collision).first(n), std::span(factors.contact).first(n))) return false;
  if (loaded) set_load(carried.load);
  if (carried.model == chain_->model) chain_->judge.carry_drift(carried.judge);
  return true;
}

bool Monitor::carry_alarm(std::span<const std::byte> bytes) noexcept {
  Handover carried;
  if (!read(bytes, joints(), carried)) return false;
  advance();
  chain_->judge.carry_alarm(carried.judge);
  return true;
}

}  // namespace tauext
