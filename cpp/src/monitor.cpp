#include "tauext/monitor.hpp"

#include <cstring>
#include <type_traits>

namespace tauext {
namespace {

constexpr std::uint32_t kStateVersion = 7;

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
      judge_(bundle) {
  for (int j = 0; j < bundle.joints(); ++j) {
    joint_names_.push_back(bundle.links[static_cast<std::size_t>(j)].joint_name);
    torque_units_.push_back(bundle.torque_unit(j));
    estimate_units_.push_back(bundle.estimate_unit(j));
  }
  if (load_settings_.settable()) {
    observe_.allow_loads(load_settings_);
    judge_.allow_loads();
  }
  if (!bundle.has_network()) return;
  network_.emplace(bundle.shape, bundle.parameters, bundle.inputs, bundle.columns(), bundle.observer.network_stride,
                   bundle.window_steps, rate);
  network_out_.resize(bundle.links.size());
}

void Monitor::reset() noexcept {
  observe_.reset();
  if (network_) network_->restart();
  judge_.reset();
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
  return judge_.step(observed, sample, network_out_);
}

// The network's answer for the window that ends at this sample, in network_out_; what stood there while none is full.
void Monitor::predict(const Observed& observed) noexcept {
  if (observed.restarted) network_->restart();
  network_->push(observe_.features(), observed.ticks);
  network_->answer(network_out_);
}

void Monitor::advance() noexcept {
  observe_.keep();
  if (observe_.progress().started) judge_.keep(observe_.progress().t_ns);
  if (network_) network_->advance();
}

LoadFault Monitor::load_fault(const Load& load, std::int64_t since_ns) const noexcept {
  const LoadFault fault = load_settings_.fault(load);
  if (fault != LoadFault::none || since_ns == kFromNow || observe_.can_go_back()) return fault;
  return LoadFault::no_past;
}

bool Monitor::set_load(const Load& load, std::int64_t since_ns) noexcept {
  if (load_fault(load, since_ns) != LoadFault::none) return false;
  advance();
  observe_.set_load(load, since_ns);
  judge_.set_load(observe_.load());
  if (since_ns < observe_.progress().t_ns) judge_.take_back_drift(since_ns);
  return true;
}

const Estimate& Monitor::no_sample(std::int64_t now_ns) noexcept {
  advance();
  return judge_.step(observe_.no_sample(now_ns), {}, {});
}

// What a state holds, in this order; all of it plain bytes.
std::size_t Monitor::state_bytes() const noexcept {
  return sizeof(StateHead) + sizeof(ObserveStage::State) + sizeof(JudgeStage::State) +
         (network_ ? network_->state_bytes() : 0);
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
  if (network_) network_->restore(left);
  return true;
}

}  // namespace tauext
