// First half of the chain, before the network: input checks, residual, prior, health.
#pragma once
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "chain/observed.hpp"
#include "chain/signal_watch.hpp"
#include "network/lstm.hpp"
#include "stages/residual.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"

namespace tauext {

struct Bundle;

// All parts of the chain that do not depend on the network: checks, clock, dynamics, residual, prior, signal watch,
// health. Inputs are bounded so that the network's output is finite (largest_lstm_input). So a whole recording can be
// observed first and its windows evaluated in bulk, with the same results as in the control loop.
class ObserveStage {
 public:
  static constexpr double kLargest = 1e306;  // a larger torque counts as not finite: sums of a few would overflow
  static constexpr std::int64_t kJumpNs = 10'000'000'000;  // a gap of more is a jump: what the arm did meanwhile is unknown
  static constexpr int kMostHeld = 100;  // samples in a row without a newer stamp: the clock has stopped. A loop may be
                                         // so many times as fast as its arm.

  // For training: checks only finite values and increasing times; impossible_samples() were removed before. Throws
  // Error as ResidualStage.
  ObserveStage(const Tree& tree, const ObserverSettings& observer, const PriorSettings& prior);
  // The bundle must be valid. answer_every: rows between two outputs of its network.
  ObserveStage(const Bundle& bundle, int answer_every);

  // Reports a fault; the chain then restarts at the next good sample.
  const Observed& step(const Sample& sample) noexcept;
  // For a loop cycle without a sample: held while the clock bridges gaps, then a fault.
  const Observed& no_sample(std::int64_t now_ns) noexcept;
  // See ResidualStage; joints: one bit per joint.
  void forget_friction(std::uint32_t joints) noexcept;
  bool models_friction() const noexcept { return residual_.models_friction(); }
  // See ResidualStage: enable loads before the first sample; call keep() once per sample, before the next.
  void allow_loads(const LoadSettings& settings, std::span<const double> units_per_nm = {}) {
    residual_.allow_loads(settings, units_per_nm);
  }
  bool can_go_back() const noexcept { return residual_.can_go_back(); }
  void set_load(const Load& load, std::int64_t since_ns) noexcept { residual_.set_load(load, since_ns); }
  const Load& load() const noexcept { return residual_.load(); }
  std::span<const double> beta() const noexcept { return residual_.beta(); }  // as ResidualStage
  void keep() noexcept { residual_.keep(); }
  std::span<const double> q() const noexcept { return residual_.q(); }  // as ResidualStage
  std::span<const double> dq() const noexcept { return residual_.dq(); }
  // See Prior.
  void follow_temperature(std::span<const double> celsius) noexcept { residual_.follow_temperature(celsius); }
  // Back to the state after construction.
  void reset() noexcept;

  // Network features of the last entered sample: q, dq and presliding states times their factors. Empty without a
  // network.
  std::span<const float> features() const noexcept { return row_; }
  const Presliding& presliding() const noexcept { return residual_.presliding(); }  // after that sample

  // Trivially copyable, so that a monitor's state can be saved.
  struct Progress {
    std::uint64_t samples = 0, bridged = 0, restarts = 0, jumps = 0;
    int held = 0;                   // samples since the last entered one that brought no newer stamp
    bool started = false;           // a stretch is running or may be continued
    bool restart_next = false;      // a fault broke the chain
    std::uint32_t causes = 0;       // of the current warm-up
    int cause_joint = -1;
    std::int64_t t_ns = 0;          // of the last entered sample
    std::int64_t row = 0;           // its position in the stretch, in ticks
    std::int64_t saturated_ns = 0;  // last sample with a saturated drive
    bool saturated = false;         // the observer's memory still contains it
    std::array<std::int64_t, kMaxJoints> near_ns{};  // remaining limits.near_memory_s per joint
    Health reported = Health::warming_up;  // of the last sample, entered or not
    std::uint32_t reported_causes = 0;
    int reported_joint = -1;
  };
  const Progress& progress() const noexcept { return progress_; }
  struct State {
    Progress progress;
    ResidualStage::State residual;
    SignalWatch::State watch;
  };
  // Complete state; restore() continues from it in a stage of the same settings.
  State state() const noexcept { return {progress_, residual_.state(), watch_ ? watch_->state() : SignalWatch::State{}}; }
  void restore(const State& state) noexcept;

 private:
  // Causes found at one sample, and whether tau_ext can be judged.
  struct Findings {
    std::uint32_t causes = 0;
    int joint = -1;  // the first one concerned
    bool trusted = true;
    void add(Cause cause, int which) noexcept {
      causes |= cause;
      if (joint < 0) joint = which;
    }
  };

  bool usable(const Sample& sample) noexcept;
  Impossible impossible(const Sample& sample) const noexcept;
  void enter(const Sample& sample) noexcept;
  bool all_finite() const noexcept;
  void find_overflow(Findings& findings) noexcept;
  void watch(const Sample& sample, Findings& findings) noexcept;
  void conclude(const Findings& findings) noexcept;
  void refuse(std::int64_t t_ns, std::uint32_t cause, int joint) noexcept;
  void hold(std::int64_t t_ns, std::uint32_t cause) noexcept;
  bool stands_still(std::int64_t t_ns) noexcept;
  void record_health() noexcept;
  void write_features(const Sample& sample) noexcept;
  void update_region(const Sample& sample, std::int64_t step_ns) noexcept;
  std::span<const double> tau() const noexcept { return {tau_.data(), static_cast<std::size_t>(joints_)}; }

  int joints_;
  std::int64_t bridged_ns_;  // longest time without a sample that is not a gap
  double slowest_per_s_;
  std::vector<double> nm_per_unit_;
  ResidualStage residual_;
  std::optional<SignalWatch> watch_;
  std::optional<Limits> limits_;
  std::int64_t near_memory_ns_ = 0;
  std::vector<float> input_factors_, row_;
  std::vector<double> states_;
  float largest_input_ = 0;
  std::int64_t reach_ = 0;  // rows from the end of a window to its start; 0 without a network
  std::int64_t answer_every_ = 1;
  Progress progress_;
  Observed observed_;
  JointVector residual_nm_{}, prior_nm_{}, doubt_nm_{};  // viewed by observed_
  JointVector coulomb_nm_{}, viscous_nm_{}, memory_gap_{};
  bool reports_friction_parts_ = false;  // fill Observed::coulomb and viscous
  JointVector tau_{};  // of the sample, in the unit of the answers
};

// Network features of one sample: q, dq and presliding states, each times its factor, as float.
void write_features(std::span<const double> q, std::span<const double> dq, std::span<const double> presliding,
                    std::span<const float> factors, std::span<float> row) noexcept;

}  // namespace tauext
