// Runs a function over the states of a file, writes its p and beta to another, prints the median time per state in ns.
#pragma once
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <vector>

// argv: model, states (doubles: q then dq, each count x n), results, n, count, batches.
// momentum(q, dq, p, beta) handles one state.
template <class Momentum>
int run_timed(char** argv, Momentum&& momentum) {
  const std::size_t n = std::strtoul(argv[4], nullptr, 10), count = std::strtoul(argv[5], nullptr, 10);
  const int batches = std::atoi(argv[6]);
  std::vector<double> states(2 * n * count), results(2 * n * count), ns;
  std::FILE* file = std::fopen(argv[2], "rb");
  if (!file || std::fread(states.data(), sizeof(double), states.size(), file) != states.size()) return 1;
  std::fclose(file);
  const double *q = states.data(), *dq = q + n * count;
  double *p = results.data(), *beta = p + n * count;
  for (int batch = -2; batch < batches; ++batch) {  // the first two warm up
    const auto start = std::chrono::steady_clock::now();
    for (std::size_t k = 0; k < n * count; k += n) momentum(q + k, dq + k, p + k, beta + k);
    const std::chrono::duration<double, std::nano> time = std::chrono::steady_clock::now() - start;
    if (batch >= 0) ns.push_back(time.count() / static_cast<double>(count));
  }
  std::sort(ns.begin(), ns.end());
  std::printf("%.1f\n", ns[ns.size() / 2]);
  file = std::fopen(argv[3], "wb");
  if (!file || std::fwrite(results.data(), sizeof(double), results.size(), file) != results.size()) return 1;
  return std::fclose(file);
}
