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

// Motion has shown that the factors are off by a share, of a variance.
void narrow(FrictionFactors::Joint& joint, double off, double variance) noexcept {
  const double error = std::sqrt(off * off + variance);
  if (error < joint.known.error) joint.known.error = error;  // NaN compares false
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
  std::ranges::transform(state_.joints, factors.begin(), &Joint::known);
  return factors;
}

void FrictionFactors::put_learned(const Learned& factors) noexcept {
  forget_strokes();
  for (std::size_t j = 0; j < factors.size(); ++j) {
    Joint& joint = state_.joints[j];
    joint.known = factors[j];
    for (double& wanted : joint.known.wanted) wanted = std::clamp(wanted, least(), share_);
    joint.factors = joint.known.wanted;
  }
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
      joint.factors[m] += std::clamp(joint.known.wanted[m] - joint.factors[m], -glide, glide);
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
    if (joint.near && !near) {
      joint.known.error = grown(joint);
      if (joint.known.moved) joint.stiff = std::max(joint.stiff, kStiff * joint.known.error);
      joint.known.moved = true;
      joint.known.since_ns = state_.t_ns;
    }
    joint.near = near;
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
  if (!(ended.seconds >= kLeastSeconds && std::isfinite(ended.ee + ended.cc + ended.vv + ended.sigma2))) return;
  // The stroke alone shows that friction is off by a share, of a variance.
  const double friction2 = square(ended, 1, 1), variance = kMemory_s * ended.sigma2 / (ended.seconds * friction2);
  const double left_c = ended.ce - joint.known.wanted[0] * ended.cc - joint.known.wanted[1] * ended.cv;
  const double left_v = ended.ve - joint.known.wanted[0] * ended.cv - joint.known.wanted[1] * ended.vv;
  const double off = (left_c + left_v) / friction2;
  joint.stiff *= std::max(1 - ended.seconds / kRunsIn_s, 0.0);
  if (std::fabs(ended.travel) >= kLeastTravel) {
    joint.level = std::sqrt(friction2 / ended.seconds);
    joint.strokes[static_cast<std::size_t>(joint.next)] = ended;
    joint.strokes[static_cast<std::size_t>(joint.next)].end_ns = state_.t_ns;
    joint.next = (joint.next + 1) % kStrokes;
    cancel(j, ended, slow);
    std::array<Evidence, kMaxJoints> found;
    for (int k = 0; k < joints_; ++k) found[static_cast<std::size_t>(k)] = evidence(state_.joints[static_cast<std::size_t>(k)]);
    for (int k = 0; k < joints_; ++k) conclude(k, k == j ? variance : 0.0, std::span(found).first(static_cast<std::size_t>(joints_)));
  }
  narrow(joint, off, variance);
}

// Friction may have changed since the last stroke.
double FrictionFactors::grown(const Joint& joint) const noexcept {
  const Factor& known = joint.known;
  if (!known.moved || state_.t_ns < known.since_ns) return kStart;
  return std::min(std::sqrt(known.error * known.error + kChanges_s * seconds(state_.t_ns - known.since_ns)), kMost);
}

// Near stiction, presliding friction changes its shape with its size, and after a rest it is harder to break away.
void FrictionFactors::raise(std::span<const double> dq, std::span<double> limit_nm) const noexcept {
  if (!on()) return;
  for (std::size_t j = 0; j < limit_nm.size(); ++j) {
    const Joint& joint = state_.joints[j];
    double error = joint.known.error;
    if (joint.stuck_ns > 0) {
      if (joint.near && std::fabs(dq[j]) > kMoves) error = grown(joint);
      limit_nm[j] += (std::max(std::fabs(joint.factors[0]) - kBent, 0.0) + joint.stiff) * joint.level;
    }
    if (error > kUsual) limit_nm[j] += kWide * (error - kUsual) * (std::fabs(joint.filtered[0]) + std::fabs(joint.filtered[1]));
  }
}

void FrictionFactors::spread(std::span<double> sigma_nm) const noexcept {
  if (!on()) return;
  for (std::size_t j = 0; j < sigma_nm.size(); ++j) {
    const Joint& joint = state_.joints[j];
    const double unknown = joint.known.error * (std::fabs(joint.filtered[0]) + std::fabs(joint.filtered[1]));
    sigma_nm[j] = std::sqrt(sigma_nm[j] * sigma_nm[j] + unknown * unknown);
  }
}

void FrictionFactors::cancel(int j, const Stroke& ended, DriftTracker& slow) noexcept {
  Joint& joint = state_.joints[static_cast<std::size_t>(j)];
  const double share = std::min(ended.seconds / kCancel_s, 1.0);
  Parts more{};
  for (std::size_t m = 0; m < kParts; ++m) {
    const double squares = m == 0 ? ended.cc : ended.vv, factor = ended.slow[m] / squares, wanted = joint.known.wanted[m];
    // NaN compares false: a joint without this part of friction.
    if (!(squares > kWorth * kWorth * square(ended, 1, 1)) || !(factor * wanted < 0)) continue;
    more[m] = std::clamp(share * factor, -std::fabs(wanted), std::fabs(wanted));
    joint.known.wanted[m] += more[m];
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

// Of the strokes that count. Up to kTouched of them that fit worst are left out where the others fit.
FrictionFactors::Evidence FrictionFactors::evidence(const Joint& joint) const noexcept {
  std::array<bool, kStrokes> counts{};
  for (std::size_t k = 0; k < counts.size(); ++k) {
    const Stroke& s = joint.strokes[k];
    counts[k] = s.seconds > 0 && elapsed_ns(state_.t_ns, s.end_ns) <= static_cast<std::uint64_t>(1e9 * kOld_s);
  }
  const Evidence all = evidence(joint, counts);
  Evidence found = all;
  for (int k = 0; k < kTouched && !found.fits && found.strokes > kLeast; ++k) {
    counts[found.worst] = false;
    found = evidence(joint, counts);
  }
  return found.fits ? found : all;
}

FrictionFactors::Evidence FrictionFactors::evidence(const Joint& joint, const std::array<bool, kStrokes>& counts) const noexcept {
  Evidence found;
  Stroke all;
  for (std::size_t k = 0; k < counts.size(); ++k) {
    if (!counts[k]) continue;
    const Stroke& s = joint.strokes[k];
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
  found.seconds = all.seconds;
  found.sigma2 = all.sigma2 / all.seconds;
  const double known = found.sigma2 * kMemory_s, together = known / (kApart * kApart);
  const double cc = all.cc + known + together, vv = all.vv + known + together, cv = all.cv - together;
  const double determinant = cc * vv - cv * cv;  // > 0: positive definite
  const double c = (vv * all.ce - cv * all.ve) / determinant, v = (cc * all.ve - cv * all.ce) / determinant;
  found.factors = {c, v};
  const double whole2 = square(all, c, v) / all.seconds;
  found.along = (c * (all.cc + all.cv) + v * (all.cv + all.vv)) / all.seconds;
  found.friction2 = square(all, 1, 1) / all.seconds;
  found.change2 = square(all, c - joint.known.wanted[0], v - joint.known.wanted[1]) / all.seconds;
  const auto left = [&](const Stroke& s) noexcept { return s.ee - 2 * (c * s.ce + v * s.ve) + square(s, c, v); };
  found.left2 = left(all) / all.seconds;
  found.fits = found.left2 <= kFits * kFits * found.sigma2 + kFitsShare * kFitsShare * whole2;
  double most = -1;
  for (std::size_t k = 0; k < counts.size(); ++k) {
    const Stroke& s = joint.strokes[k];
    if (!counts[k] || left(s) <= most * s.sigma2) continue;
    most = left(s) / s.sigma2;
    found.worst = k;
  }
  return found;
}

// variance: of the factor by the stroke that has ended; 0: another joint's stroke.
void FrictionFactors::conclude(int j, double variance, std::span<const Evidence> found) noexcept {
  const std::uint32_t bit = std::uint32_t{1} << j;
  Joint& joint = state_.joints[static_cast<std::size_t>(j)];
  const Evidence& own = found[static_cast<std::size_t>(j)];
  if (own.strokes < kLeast || own.forward == 0 || own.forward == own.strokes) return;
  const double of_all = kMemory_s * std::max(own.left2, own.sigma2) / (own.friction2 * own.seconds);
  narrow(joint, std::sqrt(own.change2 / own.friction2), of_all);
  if (!own.fits) return;
  for (const Evidence& other : found)
    if (other.strokes > 0 && (other.strokes < kLeast || !other.fits)) return;
  const double change = own.along / own.friction2;  // of both parts together
  if (!(change <= share_ && change >= least())) {
    state_.saturated |= bit;
    return;
  }
  state_.saturated &= ~bit;
  const bool sudden = own.change2 >= kFound * kFound * own.sigma2;
  if (!sudden && variance == 0) return;
  const double known = joint.known.error * joint.known.error, gain = sudden ? 1.0 : known / (known + variance);
  for (std::size_t m = 0; m < kParts; ++m)
    joint.known.wanted[m] = std::clamp(joint.known.wanted[m] + gain * (own.factors[m] - joint.known.wanted[m]), least(), share_);
  joint.known.error = std::sqrt(sudden ? of_all : gain * variance);
}

}  // namespace tauext
