// Time of one gradient, of one forward pass of windows from anywhere, and of one over a recording: median, minimum and maximum over repetitions.
//   lstm_bench [batch 1000] [length 100] [inputs 6] [hidden 20] [outputs 2] [threads 1] [repetitions 21]
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "lstm_gradient.hpp"

int main(int argc, char** argv) {
  int option[] = {1000, 100, 6, 20, 2, 1, 21};
  for (int k = 1; k < argc && k <= 7; ++k) option[k - 1] = std::atoi(argv[k]);
  const auto [batch, length, inputs, hidden, outputs, threads, repetitions] = option;
  const tauext::LstmShape shape{inputs, hidden, outputs};
  std::mt19937 random(1);
  std::uniform_real_distribution<float> uniform(-0.5f, 0.5f);
  std::vector<float> parameters(shape.parameter_count()), gradient(parameters.size());
  for (float& p : parameters) p = uniform(random);
  const std::int64_t row_count = 300000;
  std::vector<float> rows(row_count * inputs), targets(row_count * outputs), out(static_cast<std::size_t>(batch) * outputs);
  for (float& x : rows) x = uniform(random);
  for (float& y : targets) y = uniform(random);
  std::vector<tauext::LstmInput> map(inputs);
  for (int f = 0; f < inputs; ++f) map[f] = {f, 0};
  const tauext::WindowRows windows{rows.data(), row_count, inputs, 1, length, map};
  std::vector<std::int64_t> ends(batch);
  for (auto& e : ends) e = length + random() % (row_count - length);

  const auto time = [&](const char* name, auto&& body) {
    std::vector<double> ms;
    for (int k = 0; k < repetitions + 2; ++k) {
      const auto start = std::chrono::steady_clock::now();
      body();
      ms.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count());
    }
    std::sort(ms.begin() + 2, ms.end());  // the first two warm up
    std::printf("%-9s batch %d, length %d, F %d, H %d, outputs %d, threads %d: median %.3f ms (min %.3f, max %.3f)\n",
                name, batch, length, inputs, hidden, outputs, threads, ms[2 + repetitions / 2], ms[2], ms.back());
  };
  time("gradient", [&] { tauext::learn::lstm_gradient(shape, parameters, windows, ends, targets, 1, gradient, threads); });
  time("random", [&] { tauext::lstm_forward(shape, parameters, windows, ends, out, threads); });
  for (int k = 0; k < batch; ++k) ends[k] = length + k;
  time("recording", [&] { tauext::lstm_forward(shape, parameters, windows, ends, out, threads); });
}
