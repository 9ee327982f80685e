// A load announced by a gripper: its torques are excluded from contact detection until it is confirmed or rejected.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "alarm/alarm.hpp"
#include "chain/observed.hpp"
#include "load/load_change.hpp"
#include "load/load_columns.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"

namespace tauext {

struct Bundle;

// While a load is expected, every sample's tau_ext is fitted by a load change (LoadColumns, weights 1/limit^2). A
// sudden load and its columns pass the same filter, so the fit rises monotonically. The alarm uses the unexplained
// rest. An alarm that tau_ext itself would raise is held back, and ends in one of two ways:
//   - the load is set: over two stretches of kStretch_s the fits agree, and fit well;
//   - the alarm is raised: the fit fell by a third, neither settled nor grew for kDecide_s, or exceeds kLongest_s.
// After the window nothing is held back. Where the stamps jump, the window ends and an alarm that is held back is raised.
// The estimate of a set load is refined for kWeigh_s, since a few poses do not determine the centre of mass. Meanwhile
// limits are higher by kRaise standard errors of its torques.
// After the first load was set, the window accepts more load (a table releases slowly). It accepts less only within the
// error of the first estimate: a load that gets lighter is a push that ends.
class ExpectedLoad {
 public:
  static constexpr double kLongestWindow_s = 60;
  static constexpr double kBlock_s = 0.05;
  static constexpr std::size_t kStretchBlocks = 3, kBlocks = 64;
  static constexpr double kStretch_s = kBlock_s * kStretchBlocks;
  static constexpr double kDecide_s = 0.5;   // settling takes two stretches; twice that for moving loads
  static constexpr double kLongest_s = 2.5;  // a table that releases in 1.5 s, plus the decision
  static constexpr double kReach_m = 0.3;    // of a load's centre of mass from the frame's origin
  static constexpr double kPoor = 4;         // squared sigmas per row that a load may leave: twice the usual error
  static constexpr double kUnexplained = 0.5;   // a load must explain more than half of the torque
  static constexpr double kRest = 0.1;       // of a load: a rest below this, within its error, counts as none
  static constexpr double kLeastMisfit = 0.25;  // of the estimated error: a few seconds may have small errors
  static constexpr double kSameShare = 0.01; // squared: fits whose torques differ by a tenth are equal
  static constexpr double kKept = 0.7;       // of the first estimate: a load does not get lighter by a third
  static constexpr double kGrowth = 1.2;     // squared: growth by at least a tenth
  static constexpr double kHeavier_kg = 0.02;  // and by at least this mass
  static constexpr double kSure = 3;         // standard errors
  static constexpr double kWorth = 0.1;      // of a limit: least improvement for which the load is updated
  static constexpr double kErrorLasts_s = 0.3;  // friction errors of one direction of motion last so long
  static constexpr double kWeigh_s = 30;     // after the window: a working arm has moved its wrist by then
  static constexpr double kRaise = 2;        // standard errors of the load's torques by which limits rise meanwhile

  // If loads can be set retroactively.
  static bool possible(const Bundle& bundle) noexcept;
  // Throws Error if that is not possible.
  explicit ExpectedLoad(const Bundle& bundle);

  // Starts a window at the next sample: the whole load is at most at_most_kg, including what is carried.
  // Returns false without a change if why_not() gives a reason.
  bool start(double seconds, double at_most_kg, const Load& carried, const AlarmStage& alarm) noexcept;
  std::string why_not(double seconds, double at_most_kg) const;
  void stop() noexcept { state_.phase = LoadPhase::none; }
  bool on() const noexcept { return state_.phase != LoadPhase::none; }
  LoadPhase phase() const noexcept { return state_.phase; }

  // Call for each entered sample before its alarm. Writes the torques attributed to a load; adds the rise of the limits
  // to `raised`, [N m]. limit_nm: of the sample before, used as weights.
  void explain(const Sample& sample, const Observed& observed, std::span<const double> tau_ext,
               std::span<const double> limit_nm, std::span<double> explained, std::span<double> raised) noexcept;
  // Runs the usual alarm, without a load, for the same sample. alarm: the alarm of the unexplained torque.
  void follow(std::int64_t t_ns, const JointVector& tau_ext, const JointVector& scale, const JointVector& doubt,
              std::uint32_t near_stiction, bool trusted, const AlarmStage& alarm) noexcept;

  // Actions after a sample; call once per sample.
  struct Decision {
    bool sets = false;           // set this load, retroactively
    Load load;
    std::int64_t since_ns = kFromNow;
    Alarm alarm = Alarm::none;   // a held-back alarm to be raised
    int joint = -1;
  };
  Decision decide() noexcept;

  void acknowledge() noexcept { usual_.acknowledge(); }
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
    return usual_.set_factors(collision, contact);
  }
  // Of the last load found, until the next one is expected: the sample of the decision (0: none) and the standard error
  // of its mass or mass change.
  std::int64_t found_ns() const noexcept { return state_.found_ns; }
  double error_kg() const noexcept { return state_.error_kg; }
  void reset() noexcept;

  std::size_t state_bytes() const noexcept;
  void save(std::span<std::byte> to) const noexcept;
  void restore(std::span<const std::byte> from) noexcept;

 private:
  // Sums over consecutive samples, in kBlocks short blocks that are added up.
  struct Stretch {
    std::int64_t begin_ns = 0;
    double samples = 0;
    ChangeSums sums;
  };
  struct State {
    LoadPhase phase = LoadPhase::none;
    bool timed = false, fresh = false, jumped = false;
    bool fails = false, failed = false;  // the unexplained torque is over its limit; the alarm was raised
    bool has_set = false;
    double seconds = 0;
    std::int64_t t_ns = 0, end_ns = 0, block_end_ns = 0, held_ns = 0, grown_ns = 0, refine_ns = 0, begin_ns = 0;
    std::int64_t found_ns = 0;
    double error_kg = 0;
    Load carried;                        // at the start of the window
    std::array<double, LoadRegressor::kParameters> carried_ten{};
    std::array<double, 16> covariance{};  // of the load that is set
    ChangeSums past;                     // of that load, before the stored blocks
    LoadChange set{}, change{}, most{};  // since it was set; of the last sample; the largest one held back
    double most_size = 0;
    LoadBounds bounds;
    Alarm held = Alarm::none;
    int joint = -1;
    std::array<Stretch, kBlocks> blocks{};
    std::size_t next = 0, count = 0;
    AlarmStage::State usual;
    LimitFactors factors;
    std::array<double, kMaxJoints> limit_nm{};
  };

  void fit(std::span<const double> tau_ext, std::span<double> explained) noexcept;
  void raise(std::span<double> raised) const noexcept;
  double alike() const noexcept;
  void close_block() noexcept;
  Decision decide_held() noexcept;
  Decision refine() noexcept;
  Decision finish() noexcept;
  Decision give_alarm() noexcept;
  Decision end_by_jump() noexcept;
  Decision take_back() noexcept;
  Decision take(const Stretch& stretch, LoadChange change) noexcept;
  Stretch last_blocks(std::size_t from, std::size_t count) const noexcept;
  Stretch agreeing() const noexcept;
  bool same(const Stretch& stretch, const LoadChange& one, const LoadChange& other) const noexcept;
  std::array<double, 16> covariance_of(const Stretch& stretch, const LoadChange& change) const noexcept;
  double error_of(const Stretch& stretch, const LoadChange& change) const noexcept;
  const Stretch& block(std::size_t back) const noexcept { return state_.blocks[(state_.next + kBlocks - 1 - back) % kBlocks]; }
  bool shows(const LoadChange& one, const LoadChange& other, double share) const noexcept;

  int joints_, newton_joints_ = 0;         // number of joints that answer in N m
  double constants_share_ = 0;  // relative standard error of a mass from the torque constants, as if three joints weighed it
  JointVector units_per_nm_{};    // Bundle::most_units_per_nm()
  LoadSettings settings_;
  double gain_per_s_, period_s_;
  Tree bare_;
  LoadColumns columns_;
  AlarmStage usual_;
  State state_;
};

}  // namespace tauext
