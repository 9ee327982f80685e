// The monitor's answers to recorded samples, in full precision:   05_answers ARM.tauext < SAMPLES.csv
//
// To hold a controller's build against `tauext evaluate`: the same samples must give the same numbers, to the last bit
// where one compiler made both (tauext --version names Python's).
// A line of SAMPLES.csv is t_ns,q...,dq...,tau..., a value for each joint, tau as the arm gives it; a header is passed
// over. A line of the output is t_ns,health,alarm,tau_ext...; stderr says which units the bundle takes and answers in.
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include "tauext/monitor.hpp"

namespace {

// q, dq and tau one after the other; false where the line is none.
bool read_line(const std::string& line, std::int64_t& t_ns, std::vector<double>& values) {
  std::istringstream cells(line);
  std::string cell;
  if (!std::getline(cells, cell, ',')) return false;
  t_ns = std::strtoll(cell.c_str(), nullptr, 10);
  for (double& value : values) {
    if (!std::getline(cells, cell, ',')) return false;
    char* end;
    value = std::strtod(cell.c_str(), &end);
    if (end == cell.c_str()) return false;
  }
  return true;
}

int answer(const char* path) {
  tauext::Monitor monitor(tauext::load_bundle(path));
  const auto n = static_cast<std::size_t>(monitor.joints());
  for (int j = 0; j < monitor.joints(); ++j)
    std::fprintf(stderr, "%s takes tau in %s, answers in %s\n", monitor.joint_name(j).c_str(),
                 monitor.torque_unit(j).c_str(), monitor.estimate_unit(j).c_str());
  std::vector<double> values(3 * n);
  std::int64_t t_ns = 0;
  long long samples = 0;
  for (std::string line; std::getline(std::cin, line);) {
    if (line.empty() || (line[0] != '-' && (line[0] < '0' || line[0] > '9'))) continue;
    if (!read_line(line, t_ns, values)) {
      std::fprintf(stderr, "line after sample %lld: t_ns and %zu values belong there\n", samples, values.size());
      return 2;
    }
    const std::span<const double> all(values);
    const tauext::Estimate& e = monitor.step({t_ns, all.first(n), all.subspan(n, n), all.last(n)});
    std::printf("%lld,%s,%s", static_cast<long long>(e.t_ns), tauext::name(e.health), tauext::name(e.alarm));
    for (std::size_t j = 0; j < n; ++j) std::printf(",%.17g", e.tau_ext[j]);
    std::printf("\n");
    ++samples;
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: 05_answers ARM.tauext < SAMPLES.csv\n");
    return 2;
  }
  try {
    return answer(argv[1]);
  } catch (const std::exception& e) {  // a bundle that is missing or damaged
    std::fprintf(stderr, "%s\n", e.what());
    return 2;
  }
}
