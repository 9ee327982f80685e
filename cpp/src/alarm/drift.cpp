#include "alarm/drift.hpp"

#include <algorithm>
#include <cmath>

namespace tauext {
DriftTracker::DriftTracker(const DriftSettings& settings, const Limits& limits, int joints, double gain_per_s)
    : settings_(settings), limits_(limits), joints_(joints), gain_per_s_(gain_per_s), freeze_ns_(0), forget_ns_(0) {
  settings.validate(joints);
  if (!on()) return;
  freeze_ns_ = std::llround(1e9 * settings.freeze_s);
  forget_ns_ = std::llround(1e9 * std::min(kForgottenShare / gain_per_s, 60.0));
}

void DriftTracker::step(std::int64_t t_ns, std::span<const double> dq, std::span<double> drift) noexcept {
  if (!on()) {
    std::fill_n(drift.begin(), joints_, 0.0);
    return;
  }
  State& s = state_;
  s.step_ns = s.started ? static_cast<std::int64_t>(elapsed_ns(t_ns, s.t_ns)) : 0;
  const double weight = s.share.of(s.step_ns, -gain_per_s_ * 1e-9 * static_cast<double>(s.step_ns));
  for (int j = 0; j < joints_; ++j) {
    const double now[kTerms] = {1.0, std::tanh(dq[j] / kCoulombSpeed), std::clamp(dq[j] / kViscousSpeed, -1.0, 1.0)};
    double sum = 0;
    for (int m = 0; m < kTerms; ++m) {
      double& filtered = s.filtered[m][j];
      filtered = s.started ? filtered + weight * (0.5 * (s.phi[m][j] + now[m]) - filtered) : 0.0;
      s.phi[m][j] = now[m];
      sum += s.coefficients[m][j] * filtered;
    }
    drift[j] = sum;
  }
  s.started = true;
  s.t_ns = t_ns;
}

bool DriftTracker::touched(std::span<const double> tau_ext, std::span<const double> scale,
                           std::span<const double> doubt, std::uint32_t near_stiction) const noexcept {
  for (int j = 0; settings_.freeze_share > 0 && j < joints_; ++j) {
    const bool near = near_stiction >> j & 1;
    const double limit =
        std::min(limits_.limit_nm(limits_.contact, j, near), limits_.limit_nm(limits_.collision, j, near));
    const double floor = settings_.freeze_floor_nm.empty() ? 0.0 : settings_.freeze_floor_nm[static_cast<std::size_t>(j)];
    if (std::fabs(tau_ext[j]) > std::max(settings_.freeze_share * limit * scale[j], floor) + doubt[j]) return true;
  }
  return false;
}

void DriftTracker::learn(std::span<const double> tau_ext, std::span<const double> scale, std::span<const double> doubt,
                         std::uint32_t near_stiction, bool trusted) noexcept {
  if (!on() || !trusted) return;
  State& s = state_;
  const auto left = [&](std::int64_t& left_ns, bool again, std::int64_t for_ns) noexcept {
    left_ns = again ? for_ns : std::max<std::int64_t>(left_ns - s.step_ns, 0);
    return again || left_ns > 0;
  };
  const bool frozen = left(s.touched_ns, touched(tau_ext, scale, doubt, near_stiction), freeze_ns_);
  for (int j = 0; j < joints_; ++j) {
    const bool stuck = left(s.stuck_ns[j], near_stiction >> j & 1, forget_ns_);
    if (!frozen && !stuck) follow(j, tau_ext[j], 1e-9 * static_cast<double>(s.step_ns));
  }
}

void DriftTracker::follow(int j, double error, double dt) noexcept {
  State& s = state_;
  const double size = settings_.size_nm[j], most = settings_.rate_share_per_s * size * dt;
  double squares = 0;
  for (const JointVector& filtered : s.filtered) squares += filtered[j] * filtered[j];
  const double gain = std::min(dt / settings_.time_constant_s, 1.0) * error / std::max(squares, 1.0);
  bool at_bound = false;
  for (int m = 0; m < kTerms; ++m) {
    double& b = s.coefficients[m][j];
    b = std::clamp(b + std::clamp(gain * s.filtered[m][j], -most, most), -size, size);
    at_bound = at_bound || std::fabs(b) >= size;
  }
  const std::uint32_t bit = std::uint32_t{1} << j;
  s.saturated = at_bound && size > 0 ? s.saturated | bit : s.saturated & ~bit;
}

namespace {

constexpr double kMostDoubt = 0.5;  // of sigma: with a larger doubt of the prior the factor is not observable

double seconds(std::int64_t ns) noexcept { return 1e-9 * static_cast<double>(ns); }

// cc x_c^2 + 2 cv x_c x_v + vv x_v^2
double square(const FrictionFactors::Stroke& s, double c, double v) noexcept {
  return s.cc * c * c + 2 * s.cv * c * v + s.vv * v * v;
}

}  // namespace

FrictionFactors::FrictionFactors(double share, int joints, double gain_per_s)
    : share_(share),
      joints_(joints),
      gain_per_s_(gain_per_s),
      forget_ns_(share > 0 ? std::llround(1e9 * std::min(kForgottenShare / gain_per_s, 60.0)) : 0) {}

void FrictionFactors::restart() noexcept {
  state_.started = false;
  for (Joint& joint : state_.joints) joint.open = {};
}

void FrictionFactors::forget_strokes() noexcept {
  for (Joint& joint : state_.joints) {
    joint.strokes = {};
    joint.open = {};
  }
}

FrictionFactors::Learned FrictionFactors::learned() const noexcept {
  Learned factors;
  std::ranges::transform(state_.joints, factors.begin(), &Joint::wanted);
  return factors;
}

void FrictionFactors::put_learned(const Learned& factors) noexcept {
  forget_strokes();
  for (std::size_t j = 0; j < factors.size(); ++j)
    for (std::size_t m = 0; m < kParts; ++m)
      state_.joints[j].factors[m] = state_.joints[j].wanted[m] = std::clamp(factors[j][m], -2 * share_, 2 * share_);
}

void FrictionFactors::step(std::int64_t t_ns, std::span<const double> coulomb, std::span<const double> viscous,
                           std::span<double> drift) noexcept {
  if (!on() || coulomb.empty()) return;
  State& s = state_;
  s.step_ns = s.started ? static_cast<std::int64_t>(elapsed_ns(t_ns, s.t_ns)) : 0;
  const double dt = seconds(s.step_ns), weight = s.share.of(s.step_ns, -gain_per_s_ * dt), glide = kGlidePerSecond * dt;
  for (int j = 0; j < joints_; ++j) {
    Joint& joint = s.joints[static_cast<std::size_t>(j)];
    const Parts now{coulomb[j], viscous[j]};
    for (std::size_t m = 0; m < kParts; ++m) {
      double& filtered = joint.filtered[m];
      filtered = s.started ? filtered + weight * (0.5 * (joint.now[m] + now[m]) - filtered) : 0.0;
      joint.now[m] = now[m];
      joint.factors[m] += std::clamp(joint.wanted[m] - joint.factors[m], -glide, glide);
      drift[j] += joint.factors[m] * filtered;
    }
  }
  s.started = true;
  s.t_ns = t_ns;
}

void FrictionFactors::learn(std::span<const double> dq, std::span<const double> tau_ext, std::span<const double> sigma,
                            std::span<const double> doubt, std::uint32_t near_stiction, bool trusted,
                            DriftTracker& slow) noexcept {
  if (!on() || !state_.started) return;
  for (int j = 0; j < joints_; ++j) {
    Joint& joint = state_.joints[static_cast<std::size_t>(j)];
    if (!trusted) {
      joint.open = {};
      continue;
    }
    const bool near = near_stiction >> j & 1;
    joint.stuck_ns = near ? forget_ns_ : std::max<std::int64_t>(joint.stuck_ns - state_.step_ns, 0);
    const bool turned = joint.open.seconds > 0 && joint.open.travel * dq[j] < 0;
    if (near || turned) close(j, slow);
    // NaN compares false: without an error scale nothing is learned.
    if (!near && joint.stuck_ns == 0 && sigma[j] > 0 && doubt[j] <= kMostDoubt * sigma[j])
      add(j, dq[j], tau_ext[j], sigma[j], slow);
  }
}

void FrictionFactors::add(int j, double dq, double tau_ext, double sigma, const DriftTracker& slow) noexcept {
  Joint& joint = state_.joints[static_cast<std::size_t>(j)];
  const double dt = seconds(state_.step_ns), c = joint.filtered[0], v = joint.filtered[1];
  const double e = tau_ext + joint.factors[0] * c + joint.factors[1] * v;
  Stroke& s = joint.open;
  s.seconds += dt;
  s.travel += dq * dt;
  s.cc += c * c * dt;
  s.cv += c * v * dt;
  s.vv += v * v * dt;
  s.ce += c * e * dt;
  s.ve += v * e * dt;
  s.ee += e * e * dt;
  s.sigma2 += sigma * sigma * dt;
  for (std::size_t m = 0; m < kParts; ++m)
    s.slow[m] += joint.filtered[m] * slow.part(j, DriftTracker::kFriction + static_cast<int>(m)) * dt;
}

// Ends the stroke of a joint.
void FrictionFactors::close(int j, DriftTracker& slow) noexcept {
  Joint& joint = state_.joints[static_cast<std::size_t>(j)];
  const Stroke ended = joint.open;
  joint.open = {};
  if (!(ended.seconds >= kLeastSeconds && std::fabs(ended.travel) >= kLeastTravel && std::isfinite(ended.ee + ended.cc + ended.vv + ended.sigma2)))
    return;
  joint.strokes[static_cast<std::size_t>(joint.next)] = ended;
  joint.strokes[static_cast<std::size_t>(joint.next)].end_ns = state_.t_ns;
  joint.next = (joint.next + 1) % kStrokes;
  cancel(j, ended, slow);
  conclude(j);
}

void FrictionFactors::cancel(int j, const Stroke& ended, DriftTracker& slow) noexcept {
  Joint& joint = state_.joints[static_cast<std::size_t>(j)];
  const double share = std::min(ended.seconds / kCancel_s, 1.0);
  Parts more{};
  for (std::size_t m = 0; m < kParts; ++m) {
    const double squares = m == 0 ? ended.cc : ended.vv, factor = ended.slow[m] / squares, wanted = joint.wanted[m];
    // NaN compares false: a joint without this part of friction.
    if (!(squares > kWorth * kWorth * square(ended, 1, 1)) || !(factor * wanted < 0)) continue;
    more[m] = std::clamp(share * factor, -std::fabs(wanted), std::fabs(wanted));
    joint.wanted[m] += more[m];
    slow.give(j, DriftTracker::kFriction + static_cast<int>(m), more[m] / factor);
  }
  // tau_ext without the factors now has more of this friction, in earlier strokes, too.
  for (Stroke& s : joint.strokes) {
    const double ce = s.ce, ve = s.ve;
    s.ce += more[0] * s.cc + more[1] * s.cv;
    s.ve += more[0] * s.cv + more[1] * s.vv;
    s.ee += 2 * (more[0] * ce + more[1] * ve) + square(s, more[0], more[1]);
  }
}

FrictionFactors::Evidence FrictionFactors::evidence(const Joint& joint) const noexcept {
  Evidence found;
  Stroke all;
  for (const Stroke& s : joint.strokes) {
    if (s.seconds == 0 || elapsed_ns(state_.t_ns, s.end_ns) > static_cast<std::uint64_t>(1e9 * kOld_s)) continue;
    ++found.strokes;
    found.forward += s.travel > 0;
    all.seconds += s.seconds;
    all.cc += s.cc;
    all.cv += s.cv;
    all.vv += s.vv;
    all.ce += s.ce;
    all.ve += s.ve;
    all.ee += s.ee;
    all.sigma2 += s.sigma2;
  }
  if (found.strokes == 0) return found;
  found.sigma2 = all.sigma2 / all.seconds;
  const double known = found.sigma2 * kMemory_s, together = known / (kApart * kApart);
  const double cc = all.cc + known + together, vv = all.vv + known + together, cv = all.cv - together;
  const double determinant = cc * vv - cv * cv;  // > 0: positive definite
  const double c = (vv * all.ce - cv * all.ve) / determinant, v = (cc * all.ve - cv * all.ce) / determinant;
  found.factors = {c, v};
  found.whole2 = square(all, c, v) / all.seconds;
  found.friction2 = square(all, 1, 1) / all.seconds;
  found.change2 = square(all, c - joint.wanted[0], v - joint.wanted[1]) / all.seconds;
  const double left2 = (all.ee - 2 * (c * all.ce + v * all.ve)) / all.seconds + found.whole2;
  found.fits = left2 <= kFits * kFits * found.sigma2 + kFitsShare * kFitsShare * found.whole2;
  return found;
}

void FrictionFactors::conclude(int j) noexcept {
  const std::uint32_t bit = std::uint32_t{1} << j;
  Joint& joint = state_.joints[static_cast<std::size_t>(j)];
  const Evidence own = evidence(joint);
  if (own.strokes < kLeast || own.forward == 0 || own.forward == own.strokes || !own.fits) return;
  for (int k = 0; k < joints_; ++k) {
    const Evidence other = evidence(state_.joints[static_cast<std::size_t>(k)]);
    if (other.strokes > 0 && (other.strokes < kLeast || !other.fits)) return;
  }
  if (!(own.change2 >= kFound * kFound * own.sigma2)) return;
  if (!(own.whole2 <= share_ * share_ * own.friction2)) {
    state_.saturated |= bit;
    return;
  }
  state_.saturated &= ~bit;
  for (std::size_t m = 0; m < kParts; ++m) joint.wanted[m] = std::clamp(own.factors[m], -2 * share_, 2 * share_);
}

}  // namespace tauext
