// A sample before the network has spoken: whether it can be used, residual and prior, health.
#pragma once
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "lstm.hpp"
#include "residual.hpp"
#include "signal_watch.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"

namespace tauext {

struct Bundle;

// What became of a sample.
enum class Passage : std::uint8_t {
  entered,  // it went through the chain
  held,     // left out; what was said before it stands
  refused,  // left out as a fault; nothing that was said before it stands
};

// What is known of one sample before the network has spoken. Where it did not enter, only its time, passage, health and
// causes hold.
struct Observed {
  std::int64_t t_ns = 0;            // stamp of the sample
  Passage passage = Passage::refused;  // what became of it
  Health health = Health::warming_up;  // nothing later changes it
  std::uint32_t causes = 0;         // bits of Cause
  int cause_joint = -1;             // the first joint that a cause concerns
  bool restarted = false;           // the chain began anew with this sample
  std::int64_t ticks = 0;           // since the last one that entered; 0 where restarted
  bool warm = false;                // the residual is
  bool overflowed = false;          // a number of the chain did: there is no residual either
  bool judged = false;              // tau_ext exists, and is held against its limits
  bool teaches = false;             // and the drift tracker may learn from it
  std::uint32_t near_stiction = 0;  // a bit a joint: which of its limits holds
  std::span<const double> residual, prior, doubt;  // a joint, [N m]; of whoever made this, until its next sample
  std::span<const double> coulomb, viscous;  // what of the prior is friction, before its filter; empty where nobody asks
  std::span<const double> memory_gap;  // Presliding::memory_gap of each joint; empty where the prior has no branches
};

// Everything of the chain that does not depend on what the network says, one sample at a time: checks, clock, dynamics,
// residual, prior, signal watch, health. Nothing here ever depends on the network, since every number that enters it is
// kept small enough for its answer to be finite (largest_lstm_input): so a whole recording can be observed first and its
// windows answered in bulk afterwards, and the answers are the control loop's.
class ObserveStage {
 public:
  static constexpr double kLargest = 1e306;  // a torque beyond it counts as not finite: sums of a few would overflow

  // Of training: nothing is watched but that numbers are finite and times increase; impossible_samples() have been left
  // out before. Throws Error as ResidualStage.
  ObserveStage(const Tree& tree, const ObserverSettings& observer, const PriorSettings& prior);
  // Of a bundle that holds together. answer_every: rows between two answers of its network.
  ObserveStage(const Bundle& bundle, int answer_every);

  // Nothing is skipped: a fault is told, and the chain begins anew with the next good sample.
  const Observed& step(const Sample& sample) noexcept;
  // The loop ran and no sample came: held for as long as samples are bridged, then a fault.
  const Observed& no_sample(std::int64_t now_ns) noexcept;
  // As ResidualStage's calls of these names; a bit a joint.
  void forget_friction(std::uint32_t joints) noexcept;
  bool tells_friction() const noexcept { return residual_.tells_friction(); }
  // Loads as ResidualStage: allowed once, before the first sample; keep() once a sample, before the next one.
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
  // As Prior.
  void follow_temperature(std::span<const double> celsius) noexcept { residual_.follow_temperature(celsius); }
  // As newly made.
  void reset() noexcept;

  // Of the last sample that entered: the network's features, q, dq and presliding states times their factors; none where
  // the bundle has no network.
  std::span<const float> features() const noexcept { return row_; }
  const Presliding& presliding() const noexcept { return residual_.presliding(); }  // after it

  // Plain bytes, so that a monitor's state can be saved.
  struct Progress {
    std::uint64_t samples = 0, bridged = 0, restarts = 0;
    bool started = false;           // a stretch is running or is to be continued
    bool restart_next = false;      // a fault broke the chain
    std::uint32_t causes = 0;       // of the warm-up that is running
    int cause_joint = -1;
    std::int64_t t_ns = 0;          // of the last sample that entered
    std::int64_t row = 0;           // where it stands in its stretch, in ticks
    std::int64_t saturated_ns = 0;  // last sample with a drive at its limit
    bool saturated = false;         // and the observer has not forgotten it
    std::array<std::int64_t, kMaxJoints> near_ns{};  // left of limits.near_memory_s, a joint
    Health told = Health::warming_up;  // of the last sample, entered or not
    std::uint32_t told_causes = 0;
    int told_joint = -1;
  };
  const Progress& progress() const noexcept { return progress_; }
  struct State {
    Progress progress;
    ResidualStage::State residual;
    SignalWatch::State watch;
  };
  // All that it remembers; restore() goes on from there, in a stage of the same settings.
  State state() const noexcept { return {progress_, residual_.state(), watch_ ? watch_->state() : SignalWatch::State{}}; }
  void restore(const State& state) noexcept;

 private:
  // What was found wrong at one sample, and whether tau_ext can be judged.
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
  void find_overflow(Findings& findings) noexcept;
  void watch(const Sample& sample, Findings& findings) noexcept;
  void conclude(const Findings& findings) noexcept;
  void refuse(std::int64_t t_ns, std::uint32_t cause, int joint) noexcept;
  void hold(std::int64_t t_ns, std::uint32_t cause) noexcept;
  void tell() noexcept;
  void write_features(const Sample& sample) noexcept;
  void tell_region(const Sample& sample, std::int64_t step_ns) noexcept;
  std::span<const double> tau() const noexcept { return {tau_.data(), static_cast<std::size_t>(joints_)}; }

  int joints_;
  std::int64_t bridged_ns_;  // longest time without a sample that is no gap
  double slowest_per_s_;
  std::vector<double> nm_per_unit_;
  ResidualStage residual_;
  std::optional<SignalWatch> watch_;
  std::optional<Limits> limits_;
  std::int64_t near_memory_ns_ = 0;
  std::vector<float> input_factors_, row_;
  std::vector<double> states_;
  float largest_input_ = 0;
  std::int64_t reach_ = 0;  // rows that a window reaches back from its end; 0 without a network
  std::int64_t answer_every_ = 1;
  Progress progress_;
  Observed observed_;
  JointVector residual_nm_{}, prior_nm_{}, doubt_nm_{};  // that observed_ shows
  JointVector coulomb_nm_{}, viscous_nm_{}, memory_gap_{};
  bool tells_parts_ = false;  // of the friction
  JointVector tau_{};  // of the sample, in the unit of the answers
};

// Features of a network from one sample: q, dq and presliding states, each times its factor, in float.
void write_features(std::span<const double> q, std::span<const double> dq, std::span<const double> presliding,
                    std::span<const float> factors, std::span<float> row) noexcept;

}  // namespace tauext
