// Contribution of an unknown load to tau_ext per unit of its parameters, and of other possible causes.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "chain/load_regressor.hpp"
#include "chain/momentum_observer.hpp"
#include "load/load_solve.hpp"
#include "prior/prior.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"
#include "tauext/types.hpp"

namespace tauext {

// All columns are passed through the observer's filter, in phase with tau_ext:
//   load       -(dP_k/dt + B_k) - s tanh(dq / v) sign(beta + B phi) B_k      for a unit of phi_k
//   offset     part of the load's friction that is constant in phi: -s tanh(dq / v) (sign(beta + B phi) beta - |beta|)
//   frame, base force   torque of 1 N at the load frame's origin along its own axes and along the base's
//   coulomb    tanh(dq / v): friction that is not what training saw
// with phi the load as known so far, which decides only on the side that the gear is loaded on.
class LoadColumns {
 public:
  static constexpr int kParameters = LoadRegressor::kParameters;

  // Of the last sample.
  struct Shown {
    LoadRegressor::Columns load{};
    LoadRegressor::Forces frame_forces{}, base_forces{};
    JointVector offset{}, coulomb{};
  };

  // Throws Error if the frame or the shares do not fit the tree.
  LoadColumns(const Tree& tree, const PriorSettings& prior, const LoadFrame& frame, double gain_per_s);

  // Restarts at the next sample.
  void reset() noexcept;
  // One sample, with beta of the estimated model; phi: (kParameters), of the load.
  void step(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, std::span<const double> beta,
            std::span<const double> phi) noexcept;
  // First sample while r is already running: filters start in steady state.
  void begin(std::int64_t t_ns, std::span<const double> q, std::span<const double> dq, std::span<const double> beta,
             std::span<const double> phi) noexcept;
  bool started() const noexcept { return filters_.front().started(); }
  // The filters and what they showed last, as plain bytes.
  std::size_t state_bytes() const noexcept;
  void save(std::span<std::byte> to) const noexcept;
  void restore(std::span<const std::byte> from) noexcept;

  // The arm carries that already, on this link: the model that the prior's load terms go by has it too.
  void carry(int link, const Carried& what) noexcept {
    if (corrected_) corrected_->carry(link, what);
  }

  const Shown& shown() const noexcept { return shown_; }
  bool warm() const noexcept { return filters_.front().warm(); }  // the filters have forgotten how they began
  // A joint's row of LoadSums at the last sample.
  LoadSums::Row row(int joint, double tau_ext) const noexcept;

 private:
  std::size_t filter_bytes() const noexcept { return filters_.size() * sizeof(MomentumObserver); }
  void filter(std::size_t which, std::int64_t t_ns, const JointVector& p, const JointVector& v, JointVector& out) noexcept;

  int joints_;
  LoadRegressor regressor_;
  std::optional<Tree> corrected_;  // whose beta the prior's load terms go by; none: the estimated model's
  std::vector<double> shares_;
  std::vector<MomentumObserver> filters_;
  Shown shown_;
  bool settled_ = false;  // filters are in steady state
};

}  // namespace tauext
