#include <algorithm>

#include "estimates.hpp"
#include "observation.hpp"

namespace tauext {
namespace {

// Results of ObserveStage for every sample, as columns; residual, prior and doubt are already in the answer.
struct Seen {
  struct Row {
    std::uint32_t causes, near_stiction;
    std::int32_t ticks;
    Passage passage;
    Health health;
    std::int8_t cause_joint;
    bool restarted, overflowed, judged, teaches;
  };
  std::vector<Row> rows;                      // (samples)
  std::vector<float> features;                // (clock rows, columns)
  std::vector<double> friction;               // (samples, Coulomb and viscous, joints), if the drift tracker needs it
  std::vector<double> memory_gap;             // (samples, joints), if the prior has branches
  std::vector<std::int64_t> judged_ends;      // clock rows of the samples that are judged
  std::int64_t clock_rows = 0;
};

Seen observe_all(const Bundle& bundle, const RecordingView& recording, Estimates& out) {
  const auto N = static_cast<std::size_t>(recording.samples), n = static_cast<std::size_t>(recording.joints);
  Seen seen;
  seen.rows.reserve(N);
  ObserveStage stage(bundle, 1);
  const std::size_t columns = stage.features().size();
  seen.features.reserve(N * columns);
  RowCount at;
  for (std::size_t k = 0; k < N; ++k) {
    const Observed& o = stage.step(recording.at(static_cast<std::int64_t>(k)));
    seen.rows.push_back({o.causes, o.near_stiction, static_cast<std::int32_t>(o.ticks), o.passage, o.health,
                         static_cast<std::int8_t>(o.cause_joint), o.restarted, o.overflowed, o.judged, o.teaches});
    if (o.passage != Passage::entered) continue;
    for (std::size_t j = 0; j < n; ++j) {
      out.residual[k * n + j] = o.residual[j];
      out.prior[k * n + j] = o.prior[j];
      out.doubt[k * n + j] = o.doubt[j];
    }
    if (!o.coulomb.empty()) {
      seen.friction.resize(2 * N * n);
      std::ranges::copy(o.coulomb, seen.friction.begin() + static_cast<std::ptrdiff_t>(2 * k * n));
      std::ranges::copy(o.viscous, seen.friction.begin() + static_cast<std::ptrdiff_t>((2 * k + 1) * n));
    }
    if (!o.memory_gap.empty()) {
      seen.memory_gap.resize(N * n);
      std::ranges::copy(o.memory_gap, seen.memory_gap.begin() + static_cast<std::ptrdiff_t>(k * n));
    }
    at.add(o.restarted, o.ticks);
    // Bridged ticks hold the sample before.
    const std::size_t before = seen.features.size();
    for (std::int64_t held = 1; !o.restarted && held < o.ticks && columns > 0; ++held)
      for (std::size_t c = 0; c < columns; ++c) seen.features.push_back(seen.features[before - columns + c]);
    seen.features.insert(seen.features.end(), stage.features().begin(), stage.features().end());
    if (o.judged) seen.judged_ends.push_back(at.row);
  }
  seen.clock_rows = at.row + 1;
  return seen;
}

// The network's outputs for the judged samples, (judged, joints); none without a network.
std::vector<float> predict_all(const Bundle& bundle, const Seen& seen, int threads) {
  if (!bundle.has_network()) return {};
  WindowRows windows = windows_of(bundle);
  windows.rows = seen.features.data();
  windows.row_count = seen.clock_rows;
  std::vector<float> outputs(seen.judged_ends.size() * bundle.links.size());
  lstm_forward(bundle.shape, bundle.parameters, windows, seen.judged_ends, outputs, threads);
  return outputs;
}

void judge_all(const Bundle& bundle, const RecordingView& recording, const Seen& seen, std::span<const float> outputs,
               Estimates& out) {
  const auto N = static_cast<std::size_t>(recording.samples), n = static_cast<std::size_t>(recording.joints);
  JudgeStage stage(bundle);
  Observed o;
  for (std::size_t k = 0, judged = 0; k < N; ++k) {
    const Seen::Row& row = seen.rows[k];
    const Sample sample = recording.at(static_cast<std::int64_t>(k));
    o.t_ns = sample.t_ns;
    o.passage = row.passage;
    o.health = row.health;
    o.causes = row.causes;
    o.cause_joint = row.cause_joint;
    o.restarted = row.restarted;
    o.ticks = row.ticks;
    o.overflowed = row.overflowed;
    o.judged = row.judged;
    o.teaches = row.teaches;
    o.near_stiction = row.near_stiction;
    o.residual = std::span(out.residual).subspan(k * n, n);
    o.prior = std::span(out.prior).subspan(k * n, n);
    o.doubt = std::span(out.doubt).subspan(k * n, n);
    if (!seen.friction.empty()) {
      o.coulomb = std::span(seen.friction).subspan(2 * k * n, n);
      o.viscous = std::span(seen.friction).subspan((2 * k + 1) * n, n);
    }
    if (!seen.memory_gap.empty()) o.memory_gap = std::span(seen.memory_gap).subspan(k * n, n);
    const bool entered = row.passage == Passage::entered;
    const std::span<const float> network =
        entered && row.judged && !outputs.empty() ? outputs.subspan(n * judged, n) : std::span<const float>();
    judged += entered && row.judged;
    const Estimate& e = stage.step(o, sample, network);
    for (std::size_t j = 0, cell = k * n; j < n; ++j, ++cell) {
      out.residual[cell] = e.residual[j];
      out.prior[cell] = e.prior[j];
      out.doubt[cell] = e.doubt[j];
      out.network[cell] = e.network[j];
      out.drift[cell] = e.drift[j];
      out.tau_ext[cell] = e.tau_ext[j];
      out.sigma_nm[cell] = e.sigma_nm[j];
      out.contact_sigma_nm[cell] = e.contact_sigma_nm[j];
      out.limit_scale[cell] = e.limit_scale[j];
      out.limit_nm[cell] = e.limit_nm[j];
      out.contact_limit_nm[cell] = e.contact_limit_nm[j];
      out.near_stiction[cell] = e.near_stiction >> j & 1;
    }
    out.health[k] = static_cast<std::uint8_t>(e.health);
    out.causes[k] = e.causes;
    out.cause_joint[k] = static_cast<std::int8_t>(e.cause_joint);
    out.alarm_joint[k] = static_cast<std::int8_t>(e.alarm_joint);
    out.detection[k] = e.detection;
    out.unfamiliar[k] = e.unfamiliar;
    out.unseen[k] = static_cast<std::uint8_t>(e.unseen);
    out.unseen_joint[k] = static_cast<std::int8_t>(e.unseen_joint);
    out.unseen_other[k] = static_cast<std::int8_t>(e.unseen_other);
    out.alarm[k] = static_cast<std::uint8_t>(e.alarm);
    out.held_alarm[k] = static_cast<std::uint8_t>(e.held_alarm);
    out.touch[k] = static_cast<std::uint8_t>(e.touch);
    stage.advance(sample.q, sample.dq);
    out.entered[k] = entered;
    out.restarted[k] = row.restarted;
  }
}

// Memory for what observe_all() writes.
void resize_observed(Estimates& out, std::size_t cells) {
  for (auto* torque : {&out.residual, &out.prior, &out.doubt}) torque->resize(cells);
}

void expect_joints(const Bundle& bundle, const RecordingView& recording) {
  if (recording.joints != bundle.joints())
    throw Error("the bundle has " + std::to_string(bundle.joints()) + " joints, the recording " +
                std::to_string(recording.joints));
}

}  // namespace

std::vector<float> network_outputs(const Bundle& bundle, const RecordingView& recording, int threads) {
  expect_joints(bundle, recording);
  if (!bundle.has_network()) return {};
  Estimates out;
  resize_observed(out, static_cast<std::size_t>(recording.samples) * static_cast<std::size_t>(recording.joints));
  return predict_all(bundle, observe_all(bundle, recording, out), threads);
}

Estimates estimate(const Bundle& bundle, const RecordingView& recording, int threads, std::span<const float> outputs) {
  expect_joints(bundle, recording);
  const auto N = static_cast<std::size_t>(recording.samples), n = static_cast<std::size_t>(recording.joints);
  Estimates out;
  resize_observed(out, N * n);
  for (auto* torque : {&out.network, &out.drift, &out.tau_ext, &out.sigma_nm, &out.contact_sigma_nm, &out.limit_scale,
                       &out.limit_nm, &out.contact_limit_nm})
    torque->resize(N * n);
  out.near_stiction.resize(N * n);
  for (auto* flags : {&out.health, &out.detection, &out.alarm, &out.held_alarm, &out.unseen, &out.touch, &out.entered,
                      &out.restarted})
    flags->resize(N);
  for (auto* which : {&out.cause_joint, &out.alarm_joint, &out.unseen_joint, &out.unseen_other}) which->resize(N);
  out.unfamiliar.resize(N);
  out.causes.resize(N);
  const Seen seen = observe_all(bundle, recording, out);
  if (outputs.empty()) {
    judge_all(bundle, recording, seen, predict_all(bundle, seen, threads), out);
    return out;
  }
  if (!bundle.has_network() || outputs.size() != seen.judged_ends.size() * n)
    throw Error("the outputs are not of this bundle's network for this recording");
  judge_all(bundle, recording, seen, outputs, out);
  return out;
}

MotionErrors motion_errors(const Bundle& bundle, const MotionView& motion, std::span<const std::int64_t> rows) {
  if (!bundle.error_scale.on()) throw Error("the bundle has no error scale");
  const auto n = static_cast<std::size_t>(bundle.joints()), samples = motion.t_ns.size();
  if (motion.dq.size() != samples * n || motion.near_stiction.size() != samples * n ||
      motion.entered.size() != samples || motion.restarted.size() != samples)
    throw Error("dq and near_stiction must hold a value a sample and joint, entered and restarted one a sample");
  const int features = static_cast<int>(bundle.error_scale.features.size());
  ErrorScale stage(bundle.error_scale, bundle.joints(), bundle.observer.gain_per_s);
  MotionErrors out;
  std::vector<double> scale(n, 1.0), sigma_nm(n);
  std::size_t next = 0;
  for (std::size_t k = 0; k < samples && next < rows.size(); ++k) {
    std::uint32_t near = 0;
    for (std::size_t j = 0; j < n; ++j) near |= std::uint32_t{motion.near_stiction[k * n + j] != 0} << j;
    if (motion.entered[k] != 0) {
      if (motion.restarted[k] != 0) stage.restart();
      stage.step(motion.t_ns[k], motion.dq.subspan(k * n, n), near, scale, sigma_nm);
    }
    if (rows[next] != static_cast<std::int64_t>(k)) continue;
    ++next;
    for (int j = 0; j < bundle.joints(); ++j)
      for (int m = 0; m < features; ++m) out.features.push_back(stage.feature(j, m));
    out.scale.insert(out.scale.end(), scale.begin(), scale.end());
    out.sigma_nm.insert(out.sigma_nm.end(), sigma_nm.begin(), sigma_nm.end());
  }
  if (next != rows.size()) throw Error("rows must be ascending and within the motion");
  return out;
}

}  // namespace tauext
