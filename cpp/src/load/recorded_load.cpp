#include "load/recorded_load.hpp"

#include <algorithm>
#include <string>

#include "chain/motion.hpp"
#include "load/load_columns.hpp"
#include "load/weighing.hpp"
#include "tauext/bundle.hpp"

namespace tauext {

std::vector<double> worth_of_samples(std::span<const std::int64_t> t_ns, std::span<const std::uint8_t> near_stiction) {
  const std::size_t joints = t_ns.empty() ? 0 : near_stiction.size() / t_ns.size();
  Standstill standstill;
  std::vector<double> worth;
  worth.reserve(near_stiction.size());
  for (std::size_t k = 0; k < t_ns.size(); ++k) {
    std::uint32_t near = 0;
    for (std::size_t j = 0; j < joints; ++j) near |= std::uint32_t{near_stiction[k * joints + j] != 0} << j;
    standstill.step(t_ns[k], near, static_cast<int>(joints));
    for (std::size_t j = 0; j < joints; ++j) worth.push_back(standstill.worth(static_cast<int>(j)));
  }
  return worth;
}

std::vector<LoadSums::Row> load_rows(const Bundle& bundle, const LoadFrame& frame, const LoadParameters& phi,
                                     const RecordingView& recording, std::span<const std::int64_t> samples) {
  if (recording.joints != bundle.joints())
    throw Error("the bundle has " + std::to_string(bundle.joints()) + " joints, the recording " +
                std::to_string(recording.joints));
  const Tree tree(bundle.links, bundle.gravity);
  MotionStage motion(tree, bundle.observer.sample_period_ns, bundle.observer.network_stride, {});
  LoadColumns columns(tree, bundle.prior, frame, bundle.observer.gain_per_s);
  std::vector<LoadSums::Row> rows;
  rows.reserve(samples.size() * static_cast<std::size_t>(bundle.joints()));
  std::size_t next = 0;
  for (std::int64_t k = 0; k < recording.samples && next < samples.size(); ++k) {
    const Sample sample = recording.at(k);
    const SampleClock::Tick tick = motion.step(sample.t_ns, sample.q, sample.dq);
    if (tick.kind == SampleClock::Kind::restart) columns.reset();
    if (tick.kind != SampleClock::Kind::not_later)
      columns.step(sample.t_ns, sample.q, sample.dq, motion.beta(), phi);
    if (samples[next] != k) continue;
    ++next;
    for (int j = 0; j < bundle.joints(); ++j) rows.push_back(columns.row(j, 0.0));
  }
  if (next != samples.size()) throw Error("samples must be ascending and within the recording");
  return rows;
}

LoadSums load_sums(const Bundle& bundle, const LoadFrame& frame, const LoadParameters& phi,
                   std::span<const WeighedMotion> motions) {
  const auto n = static_cast<std::size_t>(bundle.joints());
  LoadSums sums(bundle.joints());
  for (const WeighedMotion& motion : motions) {
    std::vector<LoadSums::Row> rows = load_rows(bundle, frame, phi, motion.recording, motion.samples);
    for (std::size_t k = 0; k < rows.size(); ++k) rows[k][LoadSums::kTauExt] = motion.tau_ext[k] / bundle.wrench.factor(k % n);
    for (std::size_t first = 0; first < rows.size(); first += n)
      sums.add(std::span(rows).subspan(first, n), motion.sigma_nm.subspan(first, n), motion.worth.subspan(first, n));
    sums.end_block();
  }
  return sums;
}

LoadFound weigh(const Bundle& bundle, const LoadFrame& frame, std::span<const WeighedMotion> motions, double reach_m,
                const LoadParameters& phi, const Load& set) {
  WeighSettings settings = Weighing::settings_of(bundle);
  settings.reach_m = reach_m;
  LoadFound found;
  found.phi = phi;
  for (int round = 0; round < kLoadRounds; ++round)
    found = weigh(load_sums(bundle, frame, found.phi, motions), settings, set, found.phi, 1);
  return found;
}

}  // namespace tauext
