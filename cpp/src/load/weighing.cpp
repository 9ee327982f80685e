#include "load/weighing.hpp"

#include <algorithm>
#include <cmath>

#include "tauext/bundle.hpp"

namespace tauext {
namespace {

constexpr double kLeastSigma = 1e-9;       // [N m]
constexpr double kDriftOfLimit = 0.3;      // of a limit: largest drift if no drift is tracked

}  // namespace

void Standstill::step(std::int64_t t_ns, std::uint32_t near_stiction, int joints) noexcept {
  const double step_s = timed_ && t_ns > t_ns_ ? elapsed_s(t_ns, t_ns_) : 0.0;
  timed_ = true;
  t_ns_ = t_ns;
  for (std::size_t j = 0; j < static_cast<std::size_t>(joints); ++j)
    stood_s_[j] = near_stiction >> j & 1 ? stood_s_[j] + step_s : 0.0;
}

double Standstill::worth(int joint) const noexcept {
  const double stood = 1 + stood_s_[static_cast<std::size_t>(joint)] / kStand_s;
  return 1 / (stood * stood);
}

bool Weighing::possible(const Bundle& bundle) noexcept {
  return bundle.load.link >= 0 && bundle.observer.unfiltered_momentum();
}

Weighing::Weighing(const Bundle& bundle)
    : joints_(bundle.joints()),
      period_ns_(bundle.observer.sample_period_ns * bundle.observer.network_stride),
      half_sample_ns_(bundle.observer.sample_period_ns / 2),
      loads_(bundle.load),
      has_sigma_(bundle.error_scale.on()),
      limits_(bundle.limits),
      columns_(Tree(bundle.links, bundle.gravity), bundle.prior, load_frame(bundle.load), bundle.observer.gain_per_s),
      sums_(bundle.joints()),
      settings_(settings_of(bundle)) {
  for (int j = 0; j < joints_; ++j) {
    counts_[static_cast<std::size_t>(j)] = bundle.in_newtons(j);
    factor_[static_cast<std::size_t>(j)] = bundle.wrench.factor(static_cast<std::size_t>(j));
  }
  if (!possible(bundle)) throw Error("payload identification needs the unfiltered momentum observer and a load frame in the bundle");
}

// Standard deviations of the offset and the Coulomb friction that are found beside a load: 2 % and 6 % of a joint's
// friction, of which the most that drift may be is 0.3. Warming up is 10 to 15 %.
WeighSettings Weighing::settings_of(const Bundle& bundle) {
  WeighSettings settings;
  settings.gravity = bundle.gravity;
  settings.row_s = 1e-9 * static_cast<double>(bundle.observer.sample_period_ns * bundle.observer.network_stride);
  for (std::size_t j = 0; j < bundle.links.size(); ++j) {
    const double drift = bundle.drift.on() ? bundle.drift.size_nm[j] : kDriftOfLimit * bundle.limits.collision.sliding_nm[j];
    settings.offset_nm[j] = kOffsetShare * drift;
    settings.coulomb_nm[j] = kCoulombShare * drift;
    for (std::size_t k = 0; k < bundle.links.size(); ++k)
      settings.torque_covariance.push_back(bundle.wrench.constants_covariance(j, k));
  }
  return settings;
}

void Weighing::start(double reach_m, const Load& set) noexcept {
  settings_.reach_m = reach_m;
  set_ = set;
  columns_.carry(loads_.link, set.mass > 0 ? loads_.in_link(set) : Carried{});
  columns_.reset();
  phi_ = {};
  noise_ = LoadNoise::unknown();
  standstill_.restart();
  on_ = true;
  pending_ = false;
  row_due_ = true;
  sums_.clear();
  unsolved_rows_ = 0;
}

void Weighing::reset() noexcept {
  start(kUsualReach_m, {});
  stop();
}

void Weighing::take(const Sample& sample, const Observed& observed, const Estimate& estimate) noexcept {
  standstill_.step(estimate.t_ns, estimate.near_stiction, joints_);
  entered_ = observed.passage == Passage::entered;
  restarted_ = observed.restarted;
  healthy_ = estimate.health == Health::ok && estimate.declared == Declared::none;
  pending_ = true;
  t_ns_ = estimate.t_ns;
  if (!entered_) return;
  std::ranges::copy(sample.q, q_.begin());
  std::ranges::copy(sample.dq, dq_.begin());
  for (std::size_t j = 0; j < static_cast<std::size_t>(joints_); ++j) {
    const bool near = estimate.near_stiction >> j & 1;
    const double limit = limits_.limit_nm(limits_.collision, static_cast<int>(j), near);
    const double sigma = has_sigma_ ? estimate.sigma_nm[j]
                                    : kSigmaOfLimit * (estimate.limit_scale[j] * limit + estimate.doubt[j]);
    sigma_nm_[j] = std::max(sigma, kLeastSigma);
    tau_ext_[j] = estimate.tau_ext[j];
  }
}

void Weighing::advance(std::span<const double> beta) noexcept {
  if (!pending_) return;
  pending_ = false;
  if (!entered_) return;
  const auto n = static_cast<std::size_t>(joints_);
  if (restarted_) {
    columns_.reset();
    row_due_ = true;
  }
  columns_.step(t_ns_, std::span(q_).first(n), std::span(dq_).first(n), beta, phi_);
  if (!row_due_ && elapsed_ns(t_ns_, row_ns_) < static_cast<std::uint64_t>(period_ns_ - half_sample_ns_)) return;
  row_due_ = false;
  row_ns_ = t_ns_;
  if (!healthy_ || !columns_.warm()) return;
  add_row();
  if (++unsolved_rows_ >= kRefreshRows) refresh();
}

void Weighing::add_row() noexcept {
  std::array<LoadSums::Row, kMaxJoints> rows;
  JointVector worth;
  for (int joint = 0; joint < joints_; ++joint) {
    const auto j = static_cast<std::size_t>(joint);
    rows[j] = columns_.row(joint, tau_ext_[j] / factor_[j]);
    worth[j] = counts_[j] * standstill_.worth(joint);
  }
  const auto n = static_cast<std::size_t>(joints_);
  sums_.add(std::span(rows).first(n), std::span(sigma_nm_).first(n), std::span(worth).first(n));
}

// One step of what weigh() does to the end.
void Weighing::refresh() noexcept {
  unsolved_rows_ = 0;
  const LoadFit fit = solve_load(sums_, LoadCause::load, phi_, before_weighing(settings_, std::fabs(phi_[0])), noise_);
  noise_ = noise_left(sums_, LoadCause::load, phi_, fit);
  phi_ = beside(fit.values, set_, settings_.reach_m);
}

}  // namespace tauext
