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

// Points spread over a link's surface, in the link's frame; one element per point.
struct LinkSurface {
  std::vector<double> x, y, z;     // [m]
  std::vector<double> nx, ny, nz;  // unit vectors into the link
  std::vector<double> share;       // probability that a touch on the link is at this point; they sum to 1
  double area_m2 = 0;              // of a guessed shape the mean

  std::size_t size() const noexcept { return x.size(); }
};

// About `points` points on the union of capsules of one link. Parts inside another capsule are no surface.
LinkSurface surface_of(std::span<const Capsule> capsules, int points);

// Points of as many shapes that the link may have, one of each; some are dropped, as they are inside their shape. Shapes
// are capsules from the link's joint along its axis to where the next axis is nearest, and along that axis to the next
// joint; at the end of the arm, to the load frame, else to the farthest frame that the robot file fixes to the link.
// Uncertain are the radius (2 to 8 % of the arm's length), where on its axis a joint is (in half of the shapes at its
// frame's origin), where a body meets an axis that is parallel to its own, and how far the shape extends beyond (one
// radius; at the end, a tool). Points that do not agree with the file's centre of mass and inertia have a smaller share.
LinkSurface guessed_surface(const Bundle& bundle, int link, int points);

// A force at a point of a link's surface that explains tau_ext.
struct TouchPlace {
  int link = -1;
  double probability = 0;          // that the touch is on this part of the link
  std::array<double, 3> point{};   // in the base's frame, [m]
  std::array<double, 3> on_link{};  // in the link's frame, [m]
  std::array<double, 3> force{};   // that the environment exerts on the arm, along the base's axes, [N]
  double spread_m = 0;             // root mean square distance from the point, if the touch is at this place
  bool guessed = false;            // whether the shape of the link is guessed
};

// Links and places that explain tau_ext, the most probable first.
struct TouchPlaces {
  static constexpr int kMost = 6;

  bool known = false;                               // the sample had torques with a standard error
  std::array<double, kMaxJoints> probability{};     // per link; they sum to 1
  std::array<std::int32_t, kMaxJoints> ranked{};    // links, the most probable first
  int places = 0;
  std::array<TouchPlace, kMost> place{};
  int best = -1;  // the most probable place on the most probable link, else on any link; -1: no place
  // Of all places and links together: median of the force, and an interval that it is in with kStated, [N].
  double force_n = 0, force_low_n = 0, force_high_n = 0;
  double within_m = 0;  // the touch is within this distance of the best place with kStated
  static constexpr double kStated = 0.9;
  // Probability that a force at the first place leaves such a remainder or a larger one. Small: two touches, a moment
  // without a force, or no touch.
  double consistent = 1;
};

// Estimates which link is touched, where and how hard. For a touch on link k, tau_ext = J_p^T f + e, with p on the link's
// surface and e ~ N(0, S), S as in WrenchModel. The probability of the link is
//
//   P(k | tau_ext) ~ area_k L_k^c,
//   L_k = sum over p of share_p sum over s, b of w_s / 2 int N(tau_ext; J_p^T f, S) N(f; s n, P_sb) df,
//   P_sb = s^2 (a^2 n n^T + b^2 (1 - n n^T)),
//
// with n the surface's inward normal. Each point of the arm's surface is as likely as its area. A touch pushes along the
// normal, within a cone of friction: b is that of a smooth or of a rough surface. Forces s, a constant factor apart, are
// those of people, tables and clamps: w_s is Student's distribution of log s, with heavy tails. One touch in ten holds the
// link and may pull in any direction. All integrals have a closed form. A force near an axis explains any torque of this
// axis, but must be large; one far from it must have the right direction. Shapes, friction and errors are not exactly as
// assumed, so L_k counts to the power c [Miller2019]. A link of which the bundle has no capsule gets
// guessed_surface(), and a force spread wider about the normal, because the normal is uncertain, too.
class PlaceModel {
 public:
  static constexpr int kPoints = 320, kGuessPoints = 512;  // per link, of given and of guessed shapes
  static constexpr std::array<double, 7> kSizes_n{6, 12, 24, 48, 96, 192, 384};
  // Student's distribution of the logarithm of the force: median, standard deviation of the logarithm but for the tails,
  // and degrees of freedom. 68 % lie within 26 to 96 N, 90 % within 14 to 180 N.
  static constexpr double kMedian_n = 50, kLogSpread = 0.5, kFreedom = 4;
  // Standard deviations of the force, as shares of the size: along the normal from one size to the next, and across it,
  // per axis, on smooth and on rough surfaces. Normals of capsules are wrong by some 6 degrees about each axis, guessed ones by 17.
  static constexpr double kAlong = 0.35, kNormalGiven = 0.1, kNormalGuessed = 0.3;
  static constexpr std::array<double, 2> kAcross{0.12, 0.4};
  static constexpr double kHolds = 0.1, kHolds_n = 50;  // share of touches that may pull, and their standard deviation
                                                        // per axis
  static constexpr double kTrust = 0.85;                // the power c
  static constexpr double kOff_m = 0.015;  // standard error of a point: of the shape, and from one point to the next
  static constexpr double kLeast = 0.02;                // less probable links and places are not reported
  static constexpr double kApart_m = 0.08;              // smallest distance between places on a link: a hand's width

  // The bundle must be valid. Allocates all memory.
  explicit PlaceModel(const Bundle& bundle);

  // Reason for which places cannot be estimated; empty: none.
  const std::string& refused() const noexcept { return wrench_.refused(); }
  int joints() const noexcept { return wrench_.joints(); }
  // Whether the shape of a link is guessed, because the bundle has no capsule of it.
  bool guessed(int link) const noexcept { return guessed_[static_cast<std::size_t>(link)] != 0; }

  // Estimates the links and their probabilities for a sample. Spans have one value per joint; contact_sigma_nm: empty
  // in free motion. dq: the friction that a touch adds to moving joints is subtracted (WrenchModel); empty: joints at
  // rest. Allocates and throws nothing, but takes as long as many samples: not for the control loop. One thread at a
  // time.
  void rank(std::span<const double> q, std::span<const double> tau_ext, std::span<const double> sigma_nm,
            std::span<const double> contact_sigma_nm, TouchPlaces& into, std::span<const double> dq = {}) noexcept;
  // Estimates places and force for the sample that was ranked last. given: the link that is touched, whose places alone
  // are reported; -1: unknown.
  void locate(TouchPlaces& into, int given = -1) noexcept;
  // Probability, for the sample that was ranked last, of a force in any direction at this frame's origin, compared with
  // a touch elsewhere on the arm; both have the same prior probability. NaN if no sample was ranked.
  double at_frame(int frame) const noexcept;
  const WrenchModel& wrench_model() const noexcept { return wrench_; }

 private:
  // Probability of forces by their size: steps of 6 %, from kLeast_n on.
  struct ForceSizes {
    static constexpr double kLeast_n = 1, kStep = 0.06;
    std::array<double, 128> probability{};
    void add(double n, double weight) noexcept;
    double quantile(double share) const noexcept;
  };
  // Likelihood of a wrench (f, m) in a link's frame, given tau_ext: exp(eta^T w - w^T Lambda w / 2), in blocks.
  struct Information {
    std::array<double, 9> ff, fm, mm;
    std::array<double, 3> f, m;
  };
  double evidence(std::size_t link) noexcept;
  std::array<double, 3> add_forces(std::size_t link, std::size_t point, double weight, ForceSizes& sizes) const noexcept;
  void place_on(std::size_t link, double probability, ForceSizes& sizes, TouchPlaces& into) noexcept;
  void add(const TouchPlace& place, TouchPlaces& into) const noexcept;
  void bound(int given, const ForceSizes& sizes, TouchPlaces& into) const noexcept;
  std::span<double> of(std::size_t link, std::vector<double>& values) const noexcept;

  WrenchModel wrench_;
  std::vector<std::uint8_t> guessed_;                          // per link
  std::vector<LinkSurface> surfaces_;                          // per link
  std::vector<double> log_prior_;                              // per link
  std::vector<std::vector<std::vector<std::uint32_t>>> near_;  // per link and point: the points within half of kApart_m
  std::size_t most_ = 0;                                       // points of a link
  std::vector<double> seen_at_, quadratic_, scale_, left_;
  // Of the sample that was ranked last.
  std::vector<Information> seen_;  // per link
  std::vector<double> q_, logs_, weights_;  // logs_: per link and point, their sum is the link's; weights_: probabilities
  double log_elsewhere_ = 0;       // evidence of a touch on any link
  std::array<double, kMaxJoints> tau_{}, log_link_{};   // tau_: of the joints in told()
  std::array<double, kMaxJoints * kMaxJoints> s_{};    // S of these joints
};

}  // namespace tauext
