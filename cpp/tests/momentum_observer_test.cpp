#include "chain/momentum_observer.hpp"

#include <cmath>

#include "check.hpp"

using namespace tauext;

namespace {

// A mass of 2 kg pushed by 5 N from rest, in steps of varying length: r(t) = (1 - exp(-K0 t)) 5 N.
void a_constant_push_gives_the_closed_form() {
  MomentumObserver observer(1, 20.0, TorqueTiming::held);
  const double zero[1] = {0};
  double residual[1];
  std::int64_t t_ns = 0;
  for (int k = 0; k < 1000; ++k) {
    const double t = 1e-9 * static_cast<double>(t_ns), momentum[1] = {5.0 * t};
    CHECK(observer.step(t_ns, momentum, zero, zero, residual));
    CHECK_CLOSE(residual[0], 5.0 * (1 - std::exp(-20.0 * t)), 1e-9);
    t_ns += 300'000 + 1'400'000 * (k % 3) / 2;
  }
  CHECK(observer.warm());
}

void time_that_does_not_increase_changes_nothing() {
  MomentumObserver observer(1, 20.0, TorqueTiming::instant);
  const double zero[1] = {0}, one[1] = {1};
  double before[1], after[1] = {-7};
  CHECK(observer.step(1000, zero, zero, zero, before));
  CHECK(!observer.step(1000, one, one, one, after));
  CHECK(!observer.step(999, one, one, one, after));
  CHECK(after[0] == -7);
  MomentumObserver fresh = observer;
  double a[1], b[1];
  CHECK(observer.step(2'000'000, one, zero, zero, a));
  CHECK(fresh.step(2'000'000, one, zero, zero, b));
  CHECK(a[0] == b[0]);
}

// Where nothing pushes any more, r(t) = exp(-K0 t) r(0) of each; what is higher already stays.
void a_raised_observer_goes_on_from_there() {
  MomentumObserver observer(2, 20.0, TorqueTiming::held);
  const double zero[2] = {0, 0}, from[2] = {3, 7}, less[2] = {2, 6};
  double residual[2];
  observer.step(0, zero, zero, zero, residual);
  observer.raise(from, residual);
  CHECK(residual[0] == 3 && residual[1] == 7);
  observer.raise(less, residual);
  for (std::int64_t k = 1; k <= 100; ++k) {
    observer.step(k * 1'000'000, zero, zero, zero, residual);
    for (int j = 0; j < 2; ++j) CHECK_CLOSE(residual[j], from[j] * std::exp(-20.0 * 1e-3 * static_cast<double>(k)), 1e-12);
  }
}

void reset_equals_fresh() {
  MomentumObserver used(2, 20.0, TorqueTiming::averaged), fresh(2, 20.0, TorqueTiming::averaged);
  const double p[2] = {1, 2}, beta[2] = {3, 4}, tau[2] = {5, 6};
  double a[2], b[2];
  for (std::int64_t t = 0; t < 50; ++t) used.step(t * 1'000'000, p, beta, tau, a);
  used.reset();
  CHECK(!used.warm());
  for (std::int64_t t = 0; t < 50; ++t) {
    used.step(t * 1'000'000, p, beta, tau, a);
    fresh.step(t * 1'000'000, p, beta, tau, b);
    CHECK(a[0] == b[0] && a[1] == b[1]);
  }
}

void a_nan_stays_a_nan() {
  MomentumObserver observer(1, 20.0, TorqueTiming::held);
  const double zero[1] = {0}, nan[1] = {NAN};
  double r[1];
  observer.step(0, zero, zero, zero, r);
  observer.step(1'000'000, nan, zero, zero, r);
  CHECK(std::isnan(r[0]));  // would be false under -ffast-math
}

void bad_settings_are_refused() {
  CHECK_THROWS(MomentumObserver(0, 20.0, TorqueTiming::held), Error);
  CHECK_THROWS(MomentumObserver(kMaxJoints + 1, 20.0, TorqueTiming::held), Error);
  CHECK_THROWS(MomentumObserver(1, 0.0, TorqueTiming::held), Error);
  CHECK_THROWS(MomentumObserver(1, NAN, TorqueTiming::held), Error);
}

}  // namespace

int main() {
  a_constant_push_gives_the_closed_form();
  time_that_does_not_increase_changes_nothing();
  a_raised_observer_goes_on_from_there();
  reset_equals_fresh();
  a_nan_stays_a_nan();
  bad_settings_are_refused();
  return check::result();
}
