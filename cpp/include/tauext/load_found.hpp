// What the sums say: mass and centre of mass, how sure they are, and whether it is a load at all.
#pragma once
#include <array>
#include <cstdint>

#include "tauext/load.hpp"
#include "tauext/load_solve.hpp"
#include "tauext/load_sums.hpp"
#include "tauext/types.hpp"

namespace tauext {

// What is set of a load beside its columns.
struct WeighSettings {
  static constexpr double kUsualReach_m = 0.3;

  JointVector offset_nm{}, coulomb_nm{};     // as LoadBefore
  std::array<double, 3> gravity{};           // in the base frame, [m/s^2]
  double row_s = 0.01;                       // between rows
  double reach_m = kUsualReach_m;            // the centre of mass is within it of the frame's origin
};

enum class LoadVerdict : std::uint8_t {
  too_little,  // fewer than kLeastLoadRows rows: no measurement
  nothing,     // no load shows
  load,
  contact,     // a constant force fits better than any load
  lifts,       // what shows pulls up
  unclear,     // neither explains it
};
const char* name(LoadVerdict verdict) noexcept;
inline constexpr int kLeastLoadRows = 30;  // three tenths of a second

inline constexpr double kSigmaOfLimit = 0.2;  // where there is no error scale, whose limits are some five of it

// Lengths and axes of the load frame. Numbers without `load` are of what was found BESIDE the load that is set.
struct LoadFound {
  LoadVerdict verdict = LoadVerdict::too_little;
  Load load;                // both together, for set_load(); a ball's inertia, the error share of its standard errors
  double mass_kg = 0;       // may be below 0 only where a load is set, which is less then
  double mass_error_kg = 0; // standard error
  std::array<double, 3> com_m{}, com_error_m{};
  std::array<double, 9> com_covariance{};   // (3, 3), [m^2]
  std::array<double, 16> covariance{};      // (4, 4) of mass and first moment
  LoadParameters phi{};     // mass, first moment and inertia about the frame's origin
  double seconds = 0;       // of motion
  double reach_m = 0;       // that was believed
  double misfit = 0;        // squared standard errors a row that the load leaves: 1 where nothing else is
  bool mass_seen = false;   // else the mass is not told apart from its lever
  bool at_bound = false;    // the centre of mass is as far away as was said to be possible
  int unseen_count = 0;     // directions of the centre of mass that the motion did not tell, unit vectors:
  std::array<std::array<double, 3>, 3> unseen{};
  std::array<LoadFit, kLoadCauses> fits{};  // by LoadCause: what each of them would explain
};

// In rounds, the inertia following from the load found in the round before.
//   set: what the arm is taken to carry, which tau_ext is without
//   phi: what is known so far of what there is beside it, all 0 where that is nothing
inline constexpr int kLoadRounds = 3;
LoadFound weigh(const LoadSums& sums, const WeighSettings& settings, const Load& set, const LoadParameters& phi,
                int rounds = kLoadRounds) noexcept;

// What is known of (m, h) of a load of so much mass before any motion: each of h within m reach / 2 of 0.
LoadBefore before_weighing(const WeighSettings& settings, double mass_kg) noexcept;
// All parameters that follow from (m, h) found beside a load that is set: with it, the mass is at least 0 and its centre
// within the reach. The inertia of what came is that of a ball about its centre; where something was taken off, what is
// left keeps its radii of gyration.
LoadParameters beside(const std::array<double, 4>& found, const Load& set, double reach_m) noexcept;

// About the frame's origin.
LoadParameters parameters_of(const Load& load) noexcept;
// Of such parameters, mass above 0; else no load.
Load load_of(const LoadParameters& phi, double error_share) noexcept;
// A body of this mass above 0 as a ball of aluminium: its inertia is little beside m c^2. It has no error.
Load ball(double mass, const std::array<double, 3>& com) noexcept;
// Two bodies as one; the error share is that of their torques where they pull alike.
Load together(const Load& a, const Load& b) noexcept;

}  // namespace tauext
