#include "lstm_gradient.hpp"

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include "check.hpp"
#include "network/lstm_lanes.hpp"

using namespace tauext;

namespace {

struct Case {
  LstmShape shape;
  std::vector<float> parameters, rows, targets;
  std::vector<LstmInput> inputs;
  std::vector<std::int64_t> ends;
  WindowRows windows;

  Case(int hidden, int features, int outputs, int length, int count) : shape{features, hidden, outputs} {
    std::mt19937 random(7);
    std::normal_distribution<float> normal(0, 0.4f);
    for (std::size_t k = 0; k < shape.parameter_count(); ++k) parameters.push_back(normal(random));
    const int row_count = length * (count + 1);
    for (int k = 0; k < row_count * features; ++k) rows.push_back(normal(random));
    for (int k = 0; k < row_count * outputs; ++k) targets.push_back(normal(random));
    for (int f = 0; f < features; ++f) inputs.push_back({f, f % 2});
    for (int k = 0; k < count; ++k) ends.push_back(length + k * (length - 1));
    windows = {rows.data(), row_count, features, 1, length, inputs};
  }
};

// Sizes that are no multiple of any tile, lane or chunk: every remainder loop runs, also under the sanitizers.
void gradient_equals_finite_differences_at_odd_sizes() {
  for (int targets : {1, 2, 11})
    for (int count : {1, 17, 65, 131}) {
    Case c(9, 5, 3, 11, count);
    std::vector<float> gradient(c.parameters.size()), scratch(gradient.size());
    learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, targets, gradient, 2);
    for (std::size_t k = 0; k < gradient.size(); k += 53) {
      const float before = c.parameters[k], h = 4e-3f;
      c.parameters[k] = before + h;
      const double up = learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, targets, scratch, 1);
      c.parameters[k] = before - h;
      const double down = learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, targets, scratch, 1);
      c.parameters[k] = before;
      CHECK_CLOSE(gradient[k], (up - down) / (2 * static_cast<double>(h)), 2e-4);  // float rounding 1e-7 over h
    }
  }
}

void an_exact_fit_has_no_loss_and_no_gradient() {
  Case c(20, 6, 2, 100, 40);
  std::vector<float> out(c.ends.size() * 2);
  lstm_forward(c.shape, c.parameters, c.windows, c.ends, out, 1);
  for (std::size_t k = 0; k < c.ends.size(); ++k)
    for (int o = 0; o < 2; ++o) c.targets[c.ends[k] * 2 + o] = out[k * 2 + o];
  std::vector<float> gradient(c.parameters.size());
  const double loss = learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, 1, gradient, 1);
  CHECK(loss == 0.0);  // forward and gradient run the same step, so the outputs are the same to the last bit
  for (float g : gradient) CHECK(g == 0.0f);
}

void a_row_without_a_target_counts_as_no_error() {
  Case c(4, 3, 2, 6, 20);
  std::vector<float> gradient(c.parameters.size());
  for (float& y : c.targets) y = NAN;
  CHECK(learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, 3, gradient, 1) == 0.0);
  for (float g : gradient) CHECK(g == 0.0f);
  c.parameters[0] = NAN;  // a NaN output must not count as a small loss
  CHECK(std::isnan(learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, 3, gradient, 1)));
}

// The order of summation is that of the windows for 8 and for 16 lanes: AVX2 and AVX-512 give the same bits.
void eight_and_sixteen_lanes_give_the_same_bits() {
  for (int count : {1, 17, 65, 300}) {
    Case c(9, 5, 3, 11, count);
    std::vector<std::vector<float>> found;
    std::vector<double> losses;
    for (const int lanes : {4, 8, 16}) {
      lanes::limit_lane_count(lanes);
      if (lanes::lane_count() != lanes) continue;  // this machine has fewer
      found.emplace_back(c.parameters.size());
      losses.push_back(learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, 2, found.back(), 1));
    }
    lanes::limit_lane_count(0);
    double size = 0;
    for (const float g : found[0]) size = std::max(size, std::fabs(static_cast<double>(g)));
    for (std::size_t other = 1; other < found.size(); ++other)
      for (std::size_t k = 0; k < found[0].size(); ++k) CHECK_CLOSE(found[other][k], found[0][k], 3e-6 * size);
    if (found.size() == 3) CHECK(found[1] == found[2] && losses[1] == losses[2]);  // 4 lanes cannot fuse
  }
}

void sizes_that_do_not_fit_are_refused() {
  Case c(4, 3, 2, 5, 8);
  std::vector<float> gradient(c.parameters.size());
  const auto call = [&] { return learn::lstm_gradient(c.shape, c.parameters, c.windows, c.ends, c.targets, 1, gradient, 1); };
  c.ends.back() = 3;  // reaches back before the first row: length 5 and a lag
  CHECK_THROWS(call(), Error);
  CHECK_THROWS(learn::lstm_gradient(c.shape, c.parameters, c.windows, std::span(c.ends).first(2), c.targets, 6, gradient, 1),
               Error);  // more targets than steps
  c.ends.clear();
  CHECK_THROWS(call(), Error);
}

}  // namespace

int main() {
  gradient_equals_finite_differences_at_odd_sizes();
  an_exact_fit_has_no_loss_and_no_gradient();
  a_row_without_a_target_counts_as_no_error();
  eight_and_sixteen_lanes_give_the_same_bits();
  sizes_that_do_not_fit_are_refused();
  return check::result();
}
