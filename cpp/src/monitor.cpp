#include "tauext/monitor.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <type_traits>

namespace tauext {
namespace {

constexpr std::uint32_t kStateVersion = 1;

// What a saved state begins with.
struct StateHead {
  std::uint32_t version, fingerprint;
  std::uint64_t bytes;
  std::uint32_t crc, unused;
};

std::span<const char> as_chars(std::span<const std::byte> bytes) noexcept {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

// Validates the bundle, too, before anything is made of it.
std::uint32_t fingerprint(const Bundle& bundle, NetworkRate rate) {
  const char how = static_cast<char>(rate);
  const std::vector<char> bytes = to_bytes(bundle);
  return crc32(std::span(&how, 1), crc32(bytes));
}

}  // namespace

Monitor::Monitor(const Bundle& bundle, NetworkRate rate)
    : sample_period_ns_(bundle.observer.sample_period_ns),
      load_settings_(bundle.load),
      fingerprint_(fingerprint(bundle, rate)),
      observe_(bundle, rate == NetworkRate::every_sample ? 1 : bundle.observer.network_stride),
      judge_(bundle),
      wrench_(bundle) {
  forget_q();
  for (int j = 0; j < bundle.joints(); ++j) {
    friction_.push_back(friction_line(bundle.prior, static_cast<std::size_t>(j)));
    joint_names_.push_back(bundle.links[static_cast<std::size_t>(j)].joint_name);
    torque_units_.push_back(bundle.torque_unit(j));
    estimate_units_.push_back(bundle.estimate_unit(j));
  }
  if (Weighing::possible(bundle)) weighing_.emplace(bundle);
  if (load_settings_.settable()) {
    observe_.allow_loads(load_settings_, bundle.most_units_per_nm());
    judge_.allow_loads();
    if (ExpectedLoad::possible(bundle)) expected_.emplace(bundle);
  }
  if (!bundle.has_network()) return;
  network_.emplace(bundle.shape, bundle.parameters, bundle.inputs, bundle.columns(), bundle.observer.network_stride,
                   bundle.window_steps, rate);
  network_out_.resize(bundle.links.size());
}

void Monitor::reset() noexcept {
  forget_q();
  observe_.reset();
  if (network_) network_->restart();
  judge_.reset();
  if (expected_) expected_->reset();
  refit_motion_.stop();
  end_weighing();
}

bool Monitor::start_weighing(double reach_m) noexcept {
  if (!weighing_ || !(reach_m > 0) || !std::isfinite(reach_m)) return false;
  advance();
  weighing_->start(reach_m, observe_.load());
  judge_.hold_drift(true);
  return true;
}

void Monitor::stop_weighing() noexcept {
  if (!weighing()) return;
  advance();
  weighing_->stop();
  judge_.hold_drift(false);
}

// And nothing was found.
void Monitor::end_weighing() noexcept {
  if (weighing_) weighing_->reset();
  judge_.hold_drift(false);
}

std::string Monitor::why_no_weighing() const {
  if (weighing_) return "";
  if (load_settings_.link < 0) return "no load can be weighed: " + load_settings_.refused;
  return "no load can be weighed: the bundle's residual is not that of the momentum observer without filters";
}

void Monitor::reserve_refit(double seconds) {
  if (!(seconds > 0 && seconds <= 600)) throw Error("a refit's motion of " + to_text(seconds) + " s must be above 0, at most 600");
  finish_refit();
  refit_motion_.reserve(joints(), std::llround(std::ceil(1e9 * seconds / static_cast<double>(sample_period_ns_))));
}

bool Monitor::start_refit(double friction_share) noexcept {
  const auto any = [](const FrictionLine& line) noexcept { return line.at_rest_nm > 0 || line.per_speed > 0; };
  if (!refit_motion_.reserved() || !(friction_share >= 0 && friction_share <= 2) || !std::ranges::any_of(friction_, any))
    return false;
  JointVector at_rest{}, per_speed{};
  for (std::size_t j = 0; j < friction_.size(); ++j) {
    at_rest[j] = friction_share * friction_[j].at_rest_nm;
    per_speed[j] = friction_share * friction_[j].per_speed;
  }
  judge_.widen_limits(at_rest, per_speed);
  refit_motion_.start();
  return true;
}

RecordingView Monitor::finish_refit() noexcept {
  judge_.widen_limits({}, {});
  refit_motion_.stop();
  return refit_motion_.view();
}

void Monitor::resume() noexcept {
  observe_.forget_friction(last().near_stiction);
  if (observe_.tells_friction()) judge_.forget_pushes();  // the doubt stands for them
  acknowledge();
}

bool Monitor::set_temperature(std::span<const double> celsius) noexcept {
  if (celsius.size() != static_cast<std::size_t>(joints())) return false;
  observe_.follow_temperature(celsius);
  return true;
}

const Estimate& Monitor::estimate(const Sample& sample) noexcept {
  advance();
  const Observed& observed = observe_.step(sample);
  if (network_ && observed.passage == Passage::entered) predict(observed);
  if (observed.passage == Passage::entered) {
    refit_motion_.push(sample);
    std::copy(sample.q.begin(), sample.q.end(), q_.begin());
    std::copy(sample.dq.begin(), sample.dq.end(), dq_.begin());
  }
  const Estimate& answer = judge_.step(observed, sample, network_out_, expected_ ? &*expected_ : nullptr);
  if (weighing()) weighing_->look(sample, observed, answer);
  return answer;
}

// The network's answer for the window that ends at this sample, in network_out_; what stood there while none is full.
void Monitor::predict(const Observed& observed) noexcept {
  if (observed.restarted) network_->restart();
  network_->push(observe_.features(), observed.ticks);
  network_->answer(network_out_);
}

void Monitor::advance() noexcept {
  observe_.keep();
  judge_.advance();
  if (observe_.progress().started) judge_.keep(observe_.progress().t_ns);
  if (network_) network_->advance();
  if (weighing()) weighing_->advance(observe_.beta());
  if (expected_ && expected_->on()) follow_expected();
}

// What the last sample decided about a load that is expected.
void Monitor::follow_expected() noexcept {
  const ExpectedLoad::Decision decision = expected_->decide();
  if (decision.alarm != Alarm::none) judge_.raise(decision.alarm, decision.joint);
  if (decision.sets) put_load(decision.load, decision.since_ns);
}

bool Monitor::expect_load(double seconds, double at_most_kg) noexcept {
  if (!expected_) return false;
  advance();
  return expected_->start(seconds, at_most_kg, load(), judge_.alarm());
}

std::string Monitor::why_not_expected(double seconds, double at_most_kg) const {
  if (expected_) return expected_->why_not(seconds, at_most_kg);
  return load_settings_.words(load_settings_.settable() ? LoadFault::no_past : LoadFault::not_settable, {});
}

LoadFault Monitor::load_fault(const Load& load, std::int64_t since_ns) const noexcept {
  const LoadFault fault = load_settings_.fault(load);
  if (fault != LoadFault::none || since_ns == kFromNow || observe_.can_go_back()) return fault;
  return LoadFault::no_past;
}

bool Monitor::set_load(const Load& load, std::int64_t since_ns) noexcept {
  if (load_fault(load, since_ns) != LoadFault::none) return false;
  advance();
  if (expected_) expected_->stop();
  put_load(load, since_ns);
  return true;
}

void Monitor::put_load(const Load& load, std::int64_t since_ns) noexcept {
  observe_.set_load(load, since_ns);
  judge_.set_load(observe_.load());
  if (since_ns < observe_.progress().t_ns) judge_.take_back_drift(since_ns);
  if (weighing()) weighing_->start(weighing_->settings().reach_m, observe_.load());
}

const Estimate& Monitor::no_sample(std::int64_t now_ns) noexcept {
  advance();
  return judge_.step(observe_.no_sample(now_ns), {}, {}, expected_ ? &*expected_ : nullptr);
}

// What a state holds, in this order; all of it plain bytes.
std::size_t Monitor::state_bytes() const noexcept {
  return sizeof(StateHead) + sizeof(ObserveStage::State) + sizeof(JudgeStage::State) +
         (expected_ ? expected_->state_bytes() : 0) + (network_ ? network_->state_bytes() : 0);
}

bool Monitor::save_state(std::span<std::byte> state) const noexcept {
  if (state.size() != state_bytes()) return false;
  std::span<std::byte> left = state.subspan(sizeof(StateHead));
  const auto put = [&](const auto& part) noexcept {
    static_assert(std::is_trivially_copyable_v<std::remove_cvref_t<decltype(part)>>);
    std::memcpy(left.data(), &part, sizeof part);
    left = left.subspan(sizeof part);
  };
  put(observe_.state());
  put(judge_.state());
  if (expected_) {
    expected_->save(left);
    left = left.subspan(expected_->state_bytes());
  }
  if (network_) network_->save(left);
  const StateHead head{kStateVersion, fingerprint_, state.size(), crc32(as_chars(state.subspan(sizeof head))), 0};
  std::memcpy(state.data(), &head, sizeof head);
  return true;
}

bool Monitor::restore_state(std::span<const std::byte> state) noexcept {
  StateHead head;
  if (state.size() != state_bytes()) return false;
  std::memcpy(&head, state.data(), sizeof head);
  std::span<const std::byte> left = state.subspan(sizeof head);
  if (head.version != kStateVersion || head.fingerprint != fingerprint_ || head.bytes != state.size() ||
      head.crc != crc32(as_chars(left)))
    return false;
  const auto take = [&](auto part) noexcept {  // a copy of what stands there gives it its type
    std::memcpy(&part, left.data(), sizeof part);
    left = left.subspan(sizeof part);
    return part;
  };
  observe_.restore(take(observe_.state()));
  judge_.restore(take(judge_.state()));
  if (expected_) {
    expected_->restore(left);
    left = left.subspan(expected_->state_bytes());
  }
  if (network_) network_->restore(left);
  finish_refit();
  end_weighing();
  forget_q();
  return true;
}

}  // namespace tauext
