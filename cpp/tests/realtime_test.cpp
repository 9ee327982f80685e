// What runs once a sample must not allocate and must not call the system: counted and enforced, on the optimised build,
// each with a positive control. Left out under the sanitizers, which allocate themselves, and the second check under an
// emulator, which passes no filter on.
#include <cerrno>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <new>

#include "check.hpp"
#include "made_bundle.hpp"
#include "made_signals.hpp"
#include "tauext/flight_recorder.hpp"
#include "tauext/monitor.hpp"
#include "tauext/touch_place.hpp"

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define TAUEXT_SANITIZED
#elif defined(__has_feature)  // clang
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define TAUEXT_SANITIZED
#endif
#endif

#if defined(__linux__) && !defined(TAUEXT_SANITIZED)
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <malloc.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

static std::size_t allocations = 0;

// glibc's own allocator under its other names; every new, malloc, realloc and aligned_alloc ends in one of these.
extern "C" {
void* __libc_malloc(std::size_t);
void* __libc_calloc(std::size_t, std::size_t);
void* __libc_realloc(void*, std::size_t);
void* __libc_memalign(std::size_t, std::size_t);
void* malloc(std::size_t size) { return ++allocations, __libc_malloc(size); }
void* calloc(std::size_t count, std::size_t size) { return ++allocations, __libc_calloc(count, size); }
void* realloc(void* p, std::size_t size) { return ++allocations, __libc_realloc(p, size); }
void* memalign(std::size_t alignment, std::size_t size) { return ++allocations, __libc_memalign(alignment, size); }
void* aligned_alloc(std::size_t alignment, std::size_t size) { return memalign(alignment, size); }
int posix_memalign(void** p, std::size_t alignment, std::size_t size) {
  *p = memalign(alignment, size);
  return *p ? 0 : ENOMEM;
}
}

using namespace tauext;

namespace {

// The residual that does most: a mass matrix and a system of equations a sample, and both filters.
Bundle compared(int joints) {
  Bundle bundle = made::bundle(joints, 0, 30, 10, 1);
  bundle.observer.method = ResidualMethod::velocity;
  bundle.observer.high_pass_per_s = 2;
  bundle.observer.low_pass_per_s = 40;
  answer_reference(bundle);
  return bundle;
}

Bundle tracking(int joints) {
  Bundle bundle = made::bundle(joints, 20, 30, 10, 1);
  for (int j = 0; j < joints; ++j) {
    bundle.prior.terms.push_back({TermKind::load, j, 0, 0, 1, 0.1});
    bundle.prior.terms.push_back({TermKind::load_presliding, j, 0, 0, 0, 0});
    bundle.prior.terms.push_back({TermKind::coulomb, j, 0, 0, 0, 0.05});
    bundle.prior.terms.push_back({TermKind::viscous, j, 0, 0, 0, 0});
  }
  const auto n = static_cast<std::size_t>(joints);
  bundle.prior.widths_rad = {0.01};
  bundle.prior.weights.assign(4 * n * n, 0.05);
  for (std::size_t j = 0; j < n; ++j) bundle.prior.weights[4 * n * j + 4 * j + 2] = bundle.prior.weights[4 * n * j + 4 * j + 3] = -1;
  bundle.prior.corrected_links = bundle.links;
  bundle.input_factors.resize(static_cast<std::size_t>(bundle.columns()), 0.3f);
  answer_reference(bundle);
  bundle.drift = {10, std::vector<double>(static_cast<std::size_t>(joints), 2.0), 0.02, 0.9, 0.1};
  bundle.drift.friction_share = 0.4;
  bundle.coverage = made::half_seen(joints);
  bundle.prior.temperature = {std::vector<double>(n, 30), std::vector<double>(n, 20), std::vector<double>(n, -0.1),
                              std::vector<double>(n, -0.2)};
  bundle.error_scale.features = {MotionFeature::constant};
  bundle.error_scale.limit_weights = bundle.error_scale.sigma_weights = bundle.error_scale.sigma_near_weights =
      bundle.error_scale.largest = bundle.error_scale.largest_sigma = std::vector<double>(n, 1.0);
  answer_reference(bundle);
  return bundle;
}

struct Everything {
  Monitor every, own, plain, velocity;
  FlightRecorder recorder;
  double weighed = 0;
  int touched = 0, placed = 0, declared = 0;
  std::vector<std::byte> state, carried;
  PlaceModel places;
  TouchPlaces told;
  ServoInput servo;

  explicit Everything(int joints)
      : every(tracking(joints)),
        own(made::bundle(joints, 20, 30, 10, 1), NetworkRate::network_period),
        plain(made::bundle(joints, 0, 30, 10, 1)),
        velocity(compared(joints)),
        recorder(joints, 1'000'000, {0.5, 0.1, true}),
        state(every.state_bytes()),
        carried(Monitor::carried_bytes()),
        places(tracking(joints)),
        servo({TorqueFrom::supply_current, 16, 1'000'000, 30'000'000,
               std::vector<ServoConstants>(static_cast<std::size_t>(joints), {7.4, 2.7, 1.3, 1.3, 3, 0.97, 0.0015})}) {
    every.reserve_refit(1.0);
  }

  // Every path that a control loop can take: health, warm-up, gaps, bad samples, alarms, flights, saving.
  void run(std::int64_t samples) noexcept {
    double q[kMaxJoints], dq[kMaxJoints], tau[kMaxJoints];
    const int joints = every.joints();
    std::int64_t t_ns = 0;
    for (std::int64_t k = 0; k < samples; ++k) {
      made::signal(k, joints, q, dq, tau);
      t_ns += 1'000'000;
      if (k % 997 == 0) t_ns += 4'000'000;
      if (k % 3001 == 0) t_ns += 40'000'000;
      if (k % 2003 == 0) q[0] = std::nan("");
      if (k % 2500 == 0) t_ns -= 100'000'000;
      if (k % 1500 > 1400) tau[0] += 80;
      Sample sample{t_ns, {q, static_cast<std::size_t>(joints)}, {dq, static_cast<std::size_t>(joints)},
                    {tau, static_cast<std::size_t>(k % 1777 ? joints : 1)}};
      servo.step({sample.t_ns, sample.q, {}, {}, sample.dq, sample.tau});
      if (k % 13 == 0) sample.temperature = {tau, static_cast<std::size_t>(joints)};
      recorder.push(sample, every.step(sample));
      own.estimate(sample);
      plain.estimate(sample);
      velocity.estimate(sample);
      if (k % 10 == 0) own.advance();
      if (k % 700 == 0) every.no_sample(t_ns + 3'000'000);
      if (k % 1600 == 0) every.acknowledge();
      if (k % 1100 == 0) every.resume();
      if (k % 1300 == 0) every.set_limit_factors(std::span(q).first(1), std::span(q).first(1));
      if (k % 1700 == 0) own.set_limit_factors(own.limit_factors().contact, own.limit_factors().collision);
      if (k % 800 == 0) every.set_load({1.0, {0.1, 0, 0}, {}}, k % 1600 ? kFromNow : t_ns - 300'000'000);
      if (k % 900 == 0) every.set_load({-1.0});
      if (k % 640 == 0) CHECK(every.expect_load(0.4, 1.0)), own.expect_load(3, 0.5), velocity.expect_load(1, 1);
      if (k % 850 == 0) velocity.set_load({1.0}), plain.set_load({1.0}, 0);
      if (k % 1750 == 0) every.clear_load(), plain.clear_load(t_ns - 30'000'000);
      if (k % 300 == 0) every.set_temperature(sample.dq);
      if (k % 1900 == 0) every.save_state(state), every.restore_state(state);
      if (k % 1400 == 0) CHECK(every.save_carried(carried) && every.carry(carried) && every.carry_alarm(carried));
      if (k % 2100 == 0) CHECK(every.start_refit());
      if (k % 2200 == 0) CHECK(every.start_weighing() && own.start_weighing(0.4) && !velocity.start_weighing());
      if (k % 3 == 0)
        touched += every.wrench(joints - 1).covariance[0] + every.force(0, {0, 0, 0.1}, WrenchAxes::frame).consistent > 0;
      if (k % 100 == 0) {
        const double sigma[kMaxJoints] = {1, 1, 1, 1, 1, 1, 1};
        places.rank(sample.q, sample.dq, std::span(sigma).first(sample.q.size()), std::span(sigma).first(sample.q.size()), told);
        places.locate(told);
        placed += told.places;
      }
      if (k % 1000 == 500) {
        DeclaredContact contact;
        contact.frame = joints - 1;
        contact.axis = {1, 0.5, 0};
        contact.half_angle_rad = joints > 3 ? 0.4 : 0.0;
        contact.at_most_n = 5;
        contact.at_most_nm = joints == 7 && k % 2000 == 500 ? 0.5 : 0.0;
        contact.boxed = k % 2000 == 1500;
        contact.lowest_m = {-9, -9, -9}, contact.highest_m = {9, 9, 9};
        CHECK(every.expect_contact(contact, 0.3) >= 0);
        contact.frame = -1;
        CHECK(every.expect_contact(contact, 0.3) == -1 && !every.end_contact(6));
      }
      declared += every.last().declared_nm[0] != 0;
      if (k % 50 == 0) declared += every.tool_force().declared;
      if (k % 450 == 0) weighed += every.estimate_load().misfit + own.estimate_load().misfit;
      if (k % 3700 == 3699) own.stop_weighing();
      if (k % 3600 == 0) every.finish_refit();
      if (k % 5000 == 0) every.reset();
    }
    recorder.finish();
  }
};

void nothing_is_allocated() {
  allocations = 0;
  auto* volatile one = new int(1);
  delete one;
  std::vector<double>(100).swap(*std::make_unique<std::vector<double>>());
  CHECK(allocations >= 3);  // the positive control
  for (const int joints : {2, 7}) {
    Everything everything(joints);
    allocations = 0;
    everything.run(6'000);
    CHECK(allocations == 0);
    CHECK(everything.declared > 100 && everything.weighed != 0 && everything.touched > 0 && everything.placed > 0);
  }
}

// In a child whose every system call but its exit kills it.
int exit_status_without_system_calls(void (*body)()) {
  const pid_t child = fork();
  if (child == 0) {
    sock_filter program[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, nr)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_exit_group, 0, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
    };
    const sock_fprog filter{4, program};
    if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0 || prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &filter) != 0)
      _exit(77);
    body();
    _exit(0);
  }
  int status = 0;
  waitpid(child, &status, 0);
  return status;
}

Everything* subject = nullptr;

void the_system_is_not_called() {
  const int control = exit_status_without_system_calls([] { syscall(SYS_getpid); });
  if (WIFEXITED(control) && WEXITSTATUS(control) != 0) {
    std::printf("no system call filter here (an emulator?): that check is left out\n");
    return;
  }
  if (WIFEXITED(control)) {
    std::printf("the system call filter does nothing here (an emulator?): that check is left out\n");
    return;
  }
  CHECK(WIFSIGNALED(control) && WTERMSIG(control) == SIGSYS);  // the positive control
  for (const int joints : {2, 7}) {
    Everything everything(joints);
    subject = &everything;
    const int status = exit_status_without_system_calls([] { subject->run(6'000); });
    CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 0);
  }
}

}  // namespace

int main() {
  nothing_is_allocated();
  the_system_is_not_called();
  return check::result();
}

#else
int main() {
  std::printf("left out: this build is sanitized, or not for Linux\n");
  return 0;
}
#endif
