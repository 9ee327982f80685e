// Which link is touched, where on it and with what force: the hypotheses that explain tau_ext, with their probabilities.
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

// Spread evenly over a link's surface, in the link's frame; a column a quantity, one value a point.
struct LinkSurface {
  std::vector<double> x, y, z;     // [m]
  std::vector<double> nx, ny, nz;  // unit vectors into the link
  std::vector<double> share;       // of the surface's area that the point stands for; they sum to 1

  std::size_t size() const noexcept { return x.size(); }
};

// About so many points on the union of these capsules, which are of one link; parts of one within another are no surface.
LinkSurface surface_of(std::span<const Capsule> capsules, int points);

// The bundle's capsules, and for each link that has none a guess: from its joint to those that it carries, or to the load's
// frame, else to the furthest frame that the robot file fixes to it, kGuessedRadius_m wide.
inline constexpr double kGuessedRadius_m = 0.05;
std::vector<Capsule> capsules_or_guess(const Bundle& bundle);

// A force at a point of a link's surface.
struct TouchPlace {
  int link = -1;
  double probability = 0;          // that the touch is here, on this part of the link
  std::array<double, 3> point{};   // in the base's frame, [m]
  std::array<double, 3> on_link{};  // the same in the link's frame
  std::array<double, 3> force{};   // what the surroundings exert on the arm, along the base's axes, [N]
  double spread_m = 0;             // root mean square distance from the point, should the touch be here
};

// What explains tau_ext, best first.
struct TouchPlaces {
  static constexpr int kMost = 6;

  bool known = false;                               // the sample had torques with a standard error
  std::array<double, kMaxJoints> probability{};     // a link; they sum to 1
  std::array<std::int32_t, kMaxJoints> ranked{};    // links, the most probable first
  int places = 0;
  std::array<TouchPlace, kMost> place{};
  // Probability that one force at the first place leaves so much of tau_ext unexplained or more. Small: two touches at once, a
  // moment without a force, or no touch at all.
  double consistent = 1;
};

// Of a touch on link k, tau_ext = J_p^T f + e with p on the link's surface and e ~ N(0, S), S that of WrenchModel. Its
// probability is
//
//   P(k | tau_ext) ~ sum over points p of share_p * sum over sizes s of  int N(tau_ext; J_p^T f, S) N(f; m_s, P_s) df,
//   m_s = s n,  P_s = s^2 (a^2 n n^T + b^2 (1 - n n^T)),
//
// n being the surface's inward normal: a touch pushes, mostly within the cone of a friction of 1 (b), of unknown strength
// (sizes a factor apart); one in ten holds on to the link and may pull any way. All integrals are closed. A further link can
// explain whatever a nearer one does, and pays for it by all the torques that it could have caused and did not (Occam).
// Ranking takes some 60 points of each link, places many more.
class PlaceModel {
 public:
  static constexpr int kRankingPoints = 64, kPlacePoints = 320;  // a link
  static constexpr std::array<double, 5> kSizes_n{3, 9, 27, 81, 243};
  // Standard deviations as shares of the size: along the normal from one size to the next; across it as of directions that are
  // even within 45 degrees.
  static constexpr double kAlong = 0.5, kAcross = 0.4;
  static constexpr double kHolds = 0.1, kHolds_n = 50;  // share of touches that may pull, and their standard deviation an axis
  static constexpr double kLeast = 0.02;                // a less probable link or place is not reported
  static constexpr double kApart_m = 0.08;              // places on a link are at least so far apart: a hand's width

  // Of a bundle that holds together. Allocates all it needs.
  explicit PlaceModel(const Bundle& bundle);

  // Why places cannot be estimated; empty: they can.
  const std::string& refused() const noexcept { return wrench_.refused(); }
  int joints() const noexcept { return wrench_.joints(); }
  const std::vector<Capsule>& capsules() const noexcept { return capsules_; }

  // Of a sample: links and their probabilities alone. Each has a value a joint; no contact_sigma_nm: as in free motion. Neither
  // allocates nor throws, but takes as long as many samples: not for the control loop. One thread at a time.
  // dq: what a touch adds to the friction of joints that move is taken off (WrenchModel); none: as where they stand.
  void rank(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
            std::span<const double> contact_sigma_nm, TouchPlaces& into, std::span<const double> dq = {}) noexcept;
  // Of the sample that was ranked last: the places too. given: a link that the touch is known to be on, only its places are
  // then reported; -1: unknown.
  void locate(TouchPlaces& into, int given = -1) noexcept;
  // Of the sample that was ranked last: probability that it is a force at the origin of this frame, which may pull any way, and
  // not a touch anywhere else on the arm; both have the same prior probability. NaN where nothing was ranked.
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
  std::vector<LinkSurface> coarse_, fine_;  // a link
  std::vector<std::vector<std::vector<std::uint32_t>>> near_;  // a link and a fine point: those within half of kApart_m
  std::vector<double> seen_at_, quadratic_, scale_, logs_, weights_;
  // Of the sample that was ranked last.
  std::vector<Information> seen_;  // a link
  std::vector<double> q_;
  double log_elsewhere_ = 0;       // evidence of a touch on any link
  std::array<double, kMaxJoints> whitened_tau_{};
  std::array<double, kMaxJoints * kMaxJoints> factor_{};  // of S, lower
};

}  // namespace tauext
