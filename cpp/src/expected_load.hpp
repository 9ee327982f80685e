// A load that a gripper announced: what of tau_ext is taken for it, until it is known to be one or known to be none.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "alarm.hpp"
#include "load_change.hpp"
#include "load_columns.hpp"
#include "observe_stage.hpp"
#include "tauext/estimate.hpp"
#include "tauext/load.hpp"
#include "tauext/sample.hpp"
#include "tauext/settings.hpp"
#include "tauext/tree.hpp"

namespace tauext {

struct Bundle;

// While a load is expected, every sample's tau_ext is fitted by a change of the load (LoadColumns, weights 1/limit^2). A
// sudden load and its columns pass the same filter, so the fit only rises. The alarm looks at what no load explains. An
// alarm that tau_ext itself would have raised is held back, and ends in one of two ways:
//   - a load that is set: over two stretches of kStretch_s the fit explains the same, and explains it well;
//   - the alarm: what showed has gone by half again, or has neither settled nor grown for kDecide_s, or takes longer than
//     kLongest_s in all.
// Once the window is over nothing is held back. A load that was set is weighed on for kWeigh_s, since a few poses do not
// tell where its centre of mass is; meanwhile limits are higher by kRaise standard errors of its torques.
// After the first load was set the window takes more of the same (a table lets go slowly), and less of it only within what
// a first estimate may be wrong: a load that gets lighter is a push that ends.
class ExpectedLoad {
 public:
  static constexpr double kLongestWindow_s = 60;
  static constexpr double kBlock_s = 0.05;
  static constexpr std::size_t kStretchBlocks = 3, kBlocks = 64;
  static constexpr double kStretch_s = kBlock_s * kStretchBlocks;
  static constexpr double kDecide_s = 0.5;   // settling takes two stretches; as much again for what moves about
  static constexpr double kLongest_s = 2.5;  // a table that lets go in 1.5 s, and the decision
  static constexpr double kReach_m = 0.3;    // of a load's centre of mass from the frame's origin
  static constexpr double kPoor = 4;         // squared sigmas a row that a load may leave: twice the usual error
  static constexpr double kUnexplained = 0.5;   // of what shows: a load explains more than half
  static constexpr double kRest = 0.1;       // of a load: what may be left, within its error, and is taken for nothing
  static constexpr double kLeastMisfit = 0.25;  // of the estimated error: a few seconds may happen to be easy
  static constexpr double kSameShare = 0.01; // squared: two fits whose torques differ by a tenth are the same
  static constexpr double kKept = 0.7;       // of the first estimate: a load does not get lighter by a third
  static constexpr double kGrowth = 1.2;     // squared: it grows while it grows by a tenth
  static constexpr double kHeavier_kg = 0.02;  // and by this
  static constexpr double kSure = 3;         // standard errors
  static constexpr double kWorth = 0.1;      // of a limit: so much better a load must be to be set anew
  static constexpr double kErrorLasts_s = 0.3;  // errors of friction go with the direction of a move, and last as long
  static constexpr double kWeigh_s = 30;     // after the window: by then an arm that works has turned its wrist
  static constexpr double kRaise = 2;        // standard errors of the load's torques, by which limits rise meanwhile

  // Where loads can be set, and since an earlier time.
  static bool possible(const Bundle& bundle) noexcept;
  // Throws Error where it is not possible.
  explicit ExpectedLoad(const Bundle& bundle);

  // From the next sample on, for so long: the whole load is at most at_most_kg, beside or instead of what is carried.
  // false, and nothing changed, where why_not() says why.
  bool start(double seconds, double at_most_kg, const Load& carried, const AlarmStage& alarm) noexcept;
  std::string why_not(double seconds, double at_most_kg) const;
  void stop() noexcept { state_.phase = LoadPhase::none; }
  bool on() const noexcept { return state_.phase != LoadPhase::none; }
  LoadPhase phase() const noexcept { return state_.phase; }

  // A sample that entered the chain, before its alarm: writes what of tau_ext is taken for a load, and adds to `raised` by
  // how much limits rise, [N m]. limit_nm: of the sample before, which is as good a weight.
  void explain(const Sample& sample, const Observed& observed, std::span<const double> tau_ext,
               std::span<const double> limit_nm, std::span<double> explained, std::span<double> raised) noexcept;
  // The same sample's alarm without any of that; alarm: how it went with what was left.
  void follow(std::int64_t t_ns, const JointVector& tau_ext, const JointVector& scale, const JointVector& doubt,
              std::uint32_t near_stiction, bool trusted, const AlarmStage& alarm) noexcept;

  // What is to be done after a sample; once each.
  struct Decision {
    bool sets = false;           // this load, since then
    Load load;
    std::int64_t since_ns = kFromNow;
    Alarm alarm = Alarm::none;   // that was held back, and is one
    int joint = -1;
  };
  Decision decide() noexcept;

  void acknowledge() noexcept { usual_.acknowledge(); }
  bool set_limit_factors(std::span<const double> collision, std::span<const double> contact) noexcept {
    return usual_.set_factors(collision, contact);
  }
  // Of the last load that was found, until the next one is expected: the sample at which it was told, 0: none; and the
  // standard error of its mass, or of the change.
  std::int64_t found_ns() const noexcept { return state_.found_ns; }
  double error_kg() const noexcept { return state_.error_kg; }
  void reset() noexcept;

  std::size_t state_bytes() const noexcept;
  void save(std::span<std::byte> to) const noexcept;
  void restore(std::span<const std::byte> from) noexcept;

 private:
  // What samples in a row show; kBlocks short ones are kept, and added up.
  struct Stretch {
    std::int64_t begin_ns = 0;
    double samples = 0;
    ChangeSums sums;
  };
  struct State {
    LoadPhase phase = LoadPhase::none;
    bool timed = false, fresh = false;
    bool fails = false, failed = false;  // what no load explains is over its limit; the alarm has been given
    bool has_set = false;
    double seconds = 0;
    std::int64_t t_ns = 0, end_ns = 0, block_end_ns = 0, held_ns = 0, grown_ns = 0, refine_ns = 0, begin_ns = 0;
    std::int64_t found_ns = 0;
    double error_kg = 0;
    Load carried;                        // when it began
    std::array<double, LoadRegressor::kParameters> carried_ten{};
    std::array<double, 16> covariance{};  // of what is set
    ChangeSums past;                     // of that load, before the blocks that are kept
    LoadChange set{}, change{}, most{};  // told since; of the last sample; the largest that was held back
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
  Decision take_back() noexcept;
  Decision take(const Stretch& stretch, LoadChange change) noexcept;
  Stretch last_blocks(std::size_t from, std::size_t count) const noexcept;
  Stretch agreeing() const noexcept;
  bool same(const Stretch& stretch, const LoadChange& one, const LoadChange& other) const noexcept;
  std::array<double, 16> covariance_of(const Stretch& stretch, const LoadChange& change) const noexcept;
  double error_of(const Stretch& stretch, const LoadChange& change) const noexcept;
  const Stretch& block(std::size_t back) const noexcept { return state_.blocks[(state_.next + kBlocks - 1 - back) % kBlocks]; }
  bool shows(const LoadChange& one, const LoadChange& other, double share) const noexcept;

  int joints_, newton_joints_ = 0;         // of them, those that answer in N m
  JointVector units_per_nm_{};    // Bundle::most_units_per_nm()
  LoadSettings settings_;
  double gain_per_s_, period_s_;
  Tree bare_;
  LoadColumns columns_;
  AlarmStage usual_;
  State state_;
};

}  // namespace tauext
