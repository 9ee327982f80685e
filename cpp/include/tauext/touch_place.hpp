// Estimates which link is touched, where, and with what force: hypotheses with their probabilities.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "tauext/settings.hpp"
#include "tauext/wrench.hpp"

namespace tauext {

// Points spread evenly over a link's surface, in the link's frame; one element per point.
struct LinkSurface {
  std::vector<double> x, y, z;     // [m]
  std::vector<double> nx, ny, nz;  // unit vectors into the link
  std::vector<double> share;       // share of the surface's area that the point represents; they sum to 1

  std::size_t size() const noexcept { return x.size(); }
};

// About `points` points on the union of capsules of one link. Parts inside another capsule are no surface.
LinkSurface surface_of(std::span<const Capsule> capsules, int points);

// The bundle's capsules, with a guess for each link that has none: kGuessedRadius_m wide, from its joint to the joints
// that it carries, else to the load frame, else to the farthest frame that the robot file fixes to it.
inline constexpr double kGuessedRadius_m = 0.05;
std::vector<Capsule> capsules_or_guess(const Bundle& bundle);

// A force at a point of a link's surface that explains tau_ext.
struct TouchPlace {
  int link = -1;
  double probability = 0;          // that the touch is on this part of the link
  std::array<double, 3> point{};   // in the base's frame, [m]
  std::array<double, 3> on_link{};  // in the link's frame, [m]
  std::array<double, 3> force{};   // that the environment exerts on the arm, along the base's axes, [N]
  double spread_m = 0;             // root mean square distance from the point, if the touch is at this place
};

// Links and places that explain tau_ext, the most probable first.
struct TouchPlaces {
  static constexpr int kMost = 6;

  bool known = false;                               // the sample had torques with a standard error
  std::array<double, kMaxJoints> probability{};     // per link; they sum to 1
  std::array<std::int32_t, kMaxJoints> ranked{};    // links, the most probable first
  int places = 0;
  std::array<TouchPlace, kMost> place{};
  // Probability that a force at the first place leaves such a remainder or a larger one. Small: two touches, a moment
  // without a force, or no touch.
  double consistent = 1;
};

// Estimates which link is touched, and where. For a touch on link k, tau_ext = J_p^T f + e, with p on the link's
// surface and e ~ N(0, S), S as in WrenchModel. The probability of the link is
//
//   P(k | tau_ext) ~ sum over points p of share_p * sum over sizes s of  int N(tau_ext; J_p^T f, S) N(f; m_s, P_s) df,
//   m_s = s n,  P_s = s^2 (a^2 n n^T + b^2 (1 - n n^T)),
//
// with n the surface's inward normal. A touch pushes, mostly within a friction cone of coefficient 1 (b). Its size is
// unknown; the sizes are a constant factor apart. One touch in ten holds the link and may pull in any direction. All
// integrals have a closed form. A link farther out explains all torques that a nearer one explains; its probability is
// lower because it could also have caused torques that are not there (Occam). Ranking uses about 60 points per link,
// places many more.
class PlaceModel {
 public:
  static constexpr int kRankingPoints = 64, kPlacePoints = 320;  // per link
  static constexpr std::array<double, 5> kSizes_n{3, 9, 27, 81, 243};
  // Standard deviations of the force, as shares of the size: along the normal from one size to the next, and across it
  // as for directions spread evenly within 45 degrees.
  static constexpr double kAlong = 0.5, kAcross = 0.4;
  static constexpr double kHolds = 0.1, kHolds_n = 50;  // share of touches that may pull, and their standard deviation
                                                        // per axis
  static constexpr double kLeast = 0.02;                // less probable links and places are not reported
  static constexpr double kApart_m = 0.08;              // smallest distance between places on a link: a hand's width

  // The bundle must be valid. Allocates all memory.
  explicit PlaceModel(const Bundle& bundle);

  // Reason for which places cannot be estimated; empty: none.
  const std::string& refused() const noexcept { return wrench_.refused(); }
  int joints() const noexcept { return wrench_.joints(); }
  const std::vector<Capsule>& capsules() const noexcept { return capsules_; }

  // Estimates the links and their probabilities for a sample. Spans have one value per joint; contact_sigma_nm: empty
  // in free motion. dq: the friction that a touch adds to moving joints is subtracted (WrenchModel); empty: joints at
  // rest. Allocates and throws nothing, but takes as long as many samples: not for the control loop. One thread at a
  // time.
  void rank(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
            std::span<const double> contact_sigma_nm, TouchPlaces& into, std::span<const double> dq = {}) noexcept;
  // Estimates the places for the sample that was ranked last. given: the link that is touched, whose places alone are
  // reported; -1: unknown.
  void locate(TouchPlaces& into, int given = -1) noexcept;
  // Probability, for the sample that was ranked last, of a force in any direction at this frame's origin, compared with
  // a touch elsewhere on the arm; both have the same prior probability. NaN if no sample was ranked.
  double at_frame(int frame) const noexcept;
  const WrenchModel& wrench_model() const noexcept { return wrench_; }

 private:
  // Likelihood of a wrench (f, m) in a link's frame, given tau_ext: exp(eta^T w - w^T Lambda w / 2), in blocks.
  struct Information {
    std::array<double, 9> ff, fm, mm;
    std::array<double, 3> f, m;
  };
  double evidence(const LinkSurface& surface, const Information& of, std::span<double> logs) noexcept;
  std::array<double, 3> force_at(const LinkSurface& surface, std::size_t point, const Information& of) const noexcept;
  void place_on(std::size_t link, double probability, TouchPlaces& into) noexcept;
  void add(const TouchPlace& place, TouchPlaces& into) const noexcept;

  WrenchModel wrench_;
  std::vector<Capsule> capsules_;
  std::vector<LinkSurface> coarse_, fine_;  // per link
  std::vector<std::vector<std::vector<std::uint32_t>>> near_;  // per link and fine point: the points within half of
                                                               // kApart_m
  std::vector<double> seen_at_, quadratic_, scale_, logs_, weights_;
  // Of the sample that was ranked last.
  std::vector<Information> seen_;  // per link
  std::vector<double> q_;
  double log_elsewhere_ = 0;       // evidence of a touch on any link
  std::array<double, kMaxJoints> whitened_tau_{};
  std::array<double, kMaxJoints * kMaxJoints> factor_{};  // of S, lower triangle
};

}  // namespace tauext
