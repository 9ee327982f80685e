// The activations against the standard library in long double, over all that a float can hold and for every number of
// lanes, and the cell that is made of them.
#include <cmath>
#include <cstdio>
#include <limits>
#include <vector>

#include "check.hpp"
#include "network/lstm.hpp"
#include "network/lstm_lanes.hpp"

using namespace tauext;

namespace {

// A bound on the absolute error of sigmoid and tanh, in units of 2^-24 = 6e-8, half the last bit of a number below 1.
// With s the sigmoid, e = exp(-x) and its relative error of r: s is off by s (1 - s) r <= r / 4. The polynomial gives r
// 1.1e-7, its rounding 1.2e-7, and log2(e) as a float |x| 3e-8, of which s (1 - s) leaves 0.7e-8: one unit and a half. Then
// 1 + e, three products over the common denominator and the quotient are rounded, a unit each of a number below 1 at
// most: 6 units, all that could add up. tanh(x) = 2 sigmoid(2 x) - 1 has twice the first part, and one rounding more: 8.
constexpr double kUnit = 0x1p-24, kSigmoidBound = 6 * kUnit, kTanhBound = 8 * kUnit;

std::vector<float> everywhere() {
  std::vector<float> x = {0.0f, -0.0f};
  for (int k = -40000; k <= 40000; ++k) x.push_back(static_cast<float>(k) * 6.5e-4f);  // past the saturation at 20
  for (float magnitude = 1e-44f; magnitude < 1e38f; magnitude *= 1.7f) {  // from seven times the smallest
    x.push_back(magnitude);
    x.push_back(-magnitude);
  }
  for (const float limit : {std::numeric_limits<float>::max(), std::numeric_limits<float>::infinity()}) {
    x.push_back(limit);
    x.push_back(-limit);
  }
  return x;
}

template <class Body>
void for_every_number_of_lanes(Body&& body) {
  for (const int lanes : {4, 8, 16}) {
    lanes::limit_lane_count(lanes);
    if (lanes::lane_count() == lanes) body(lanes);  // this machine may have fewer
  }
  lanes::limit_lane_count(0);
}

void sigmoid_and_tanh_stay_within_their_bounds_over_the_whole_range() {
  const std::vector<float> x = everywhere();
  std::vector<float> sigmoid(x.size()), tangent(x.size());
  for_every_number_of_lanes([&](int lanes) {
    lstm_activations(x, sigmoid, tangent);
    double worst_sigmoid = 0, worst_tanh = 0;
    for (std::size_t k = 0; k < x.size(); ++k) {
      const long double exact = x[k];
      const auto off = static_cast<double>(std::fabs(sigmoid[k] - 1 / (1 + std::exp(-exact))));
      const auto off_tanh = static_cast<double>(std::fabs(tangent[k] - std::tanh(exact)));
      worst_sigmoid = std::fmax(worst_sigmoid, off);
      worst_tanh = std::fmax(worst_tanh, off_tanh);
      CHECK(std::isfinite(sigmoid[k]) && std::isfinite(tangent[k]));
    }
    CHECK(worst_sigmoid <= kSigmoidBound && worst_tanh <= kTanhBound);
    std::printf("%d lanes: sigmoid within %.2g, tanh within %.2g\n", lanes, worst_sigmoid, worst_tanh);
  });
}

void what_is_no_number_stays_none() {
  const std::vector<float> x = {std::numeric_limits<float>::quiet_NaN(), -std::numeric_limits<float>::quiet_NaN()};
  std::vector<float> sigmoid(2), tangent(2);
  for_every_number_of_lanes([&](int) {
    lstm_activations(x, sigmoid, tangent);
    for (int k = 0; k < 2; ++k) CHECK(std::isnan(sigmoid[k]) && std::isnan(tangent[k]));
  });
}

// One unit over two steps, its four sums given by its inputs: the second step has a cell before it. The last output is
// sigmoid(o) tanh(sigmoid(f) sigmoid(i) tanh(g) + sigmoid(i) tanh(g)).
void a_cell_is_made_of_them() {
  const LstmShape shape{4, 1, 1};
  std::vector<float> parameters(shape.parameter_count(), 0.0f);
  for (int gate = 0; gate < 4; ++gate) parameters[gate * 4 + gate] = 1;  // W_x: gate k sums input k
  parameters[16 + 4 + 4] = 1;                                            // the head passes h on
  const std::vector<LstmInput> inputs = {{0, 0}, {1, 0}, {2, 0}, {3, 0}};
  const float values[] = {-1e30f, -19.9f, -3.0f, 0.0f, 1e-4f, 0.7f, 20.1f};
  for_every_number_of_lanes([&](int) {
    for (const float i : values)
      for (const float f : values)
        for (const float g : values)
          for (const float o : values) {
            const float rows[] = {i, f, g, o, i, f, g, o};
            const WindowRows windows{rows, 2, 4, 1, 2, inputs};
            const std::int64_t end = 1;
            float out = 0;
            lstm_forward(shape, parameters, windows, std::span(&end, 1), std::span(&out, 1), 1);
            const auto sigmoid = [](long double x) { return 1 / (1 + std::exp(-x)); };
            const long double added = sigmoid(i) * std::tanh(static_cast<long double>(g));
            const long double exact = sigmoid(o) * std::tanh(sigmoid(f) * added + added);
            CHECK_CLOSE(out, static_cast<double>(exact), 2 * kTanhBound);  // tanh(g) and tanh(cell), each at most 1
          }
  });
}

}  // namespace

int main() {
  sigmoid_and_tanh_stay_within_their_bounds_over_the_whole_range();
  what_is_no_number_stays_none();
  a_cell_is_made_of_them();
  return check::result();
}
